"""What `import --guess` takes for what: labels, people, clocks, counters, ranges, and JSON of other programs."""

from __future__ import annotations

import gzip
import json
import tomllib
from dataclasses import replace
from datetime import UTC, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import DatasetError, FileFormatError
from plushsense.dataset.importing import guessing
from plushsense.dataset.importing.guessing import GuessedPattern, guess_pattern
from plushsense.dataset.importing.importers import preview_import
from plushsense.dataset.importing.results import ImportPreview

pytestmark = pytest.mark.slow

GESTURES = ("hug", "tap")
PEOPLE = ("P01", "P02", "P03")


def guessed(src: Path) -> tuple[dict[str, Any], GuessedPattern, ImportPreview]:
    """Guess the pattern of ``src``; return its keys, the guess, and the preview of an import by it."""
    guess = guess_pattern(src)
    guess.write(src.parent / "guess.toml")
    return tomllib.loads(guess.toml), guess, preview_import(src, pattern=src.parent / "guess.toml")


def names(found: dict[str, Any]) -> list[str]:
    return [channel["name"] for channel in found["layout"]["channels"]]


def noise(rows: int, seed: int) -> list[float]:
    return [round(float(value), 2) for value in np.random.default_rng(seed).normal(0, 3, rows)]


def table(path: Path, columns: dict[str, list[Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [",".join(columns), *(",".join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(rows) + "\n")


def touches(path: Path, seed: int, rows: int = 60, **more: list[Any]) -> None:
    table(path, {"t_ms": [20 * k for k in range(rows)], "left": noise(rows, seed), **more})


def test_parts_of_a_data_set_are_neither_labels_nor_people(tmp_path: Path) -> None:
    for seed, (split, gesture, take) in enumerate(
        (s, g, t) for s in ("Training", "val", "Test") for g in GESTURES for t in range(3)
    ):
        touches(tmp_path / "src" / split / gesture / f"rep{take}.csv", seed)
    found, guess, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["*/{label}/{recording}.csv"]
    assert (seen.gestures, seen.subjects) == ({"hug": 9, "tap": 9}, ["unknown"])
    assert "the label is taken from the path: 'hug' of Test/hug/rep0.csv and 'tap' of Test/tap/rep0.csv" in guess.doubts
    assert "the folders Test, Training, val are parts of a data set, neither labels nor people" in guess.doubts
    assert any("--subjects map.csv" in doubt for doubt in guess.doubts)
    assert any("people are not known" in note for note in seen.messages)


def test_a_part_that_differs_in_every_file_is_the_take(tmp_path: Path) -> None:
    for seed in range(8):
        touches(tmp_path / "src" / f"{GESTURES[seed % 2]}_x{7919 * (seed + 11):x}q.csv", seed)
    found, guess, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{label}_{recording}.csv"]
    assert seen.subjects == ["unknown"]
    assert any("differs in every file, so that it is taken for the take" in doubt for doubt in guess.doubts)


def test_people_by_number_before_or_behind_the_gesture_are_listed(tmp_path: Path) -> None:
    for seed, (person, gesture, take) in enumerate((p, g, t) for p in "123" for g in GESTURES for t in "12"):
        touches(tmp_path / "src" / person / f"{gesture}_{take}.csv", seed)
        touches(tmp_path / "names" / f"{['ann', 'bob', 'cy'][int(person) - 1]}" / f"{gesture}_{take}.csv", seed)
    for src, people in (("src", ["1", "2", "3"]), ("names", ["ann", "bob", "cy"])):
        found, guess, seen = guessed(tmp_path / src)
        (tmp_path / "guess.toml").unlink()
        assert found["paths"] == ["{subject}/{label}_{recording}.csv"]
        assert (seen.subjects, seen.gestures) == (people, {"hug": 6, "tap": 6})
        listed = f"'{people[0]}' of {people[0]}/hug_1.csv and '{people[1]}' of {people[1]}/hug_1.csv"
        assert f"the person is taken from the path: {listed}" in guess.doubts


@pytest.mark.parametrize("word", ["run", "file", "x", "rep"])
def test_numbered_files_in_the_folders_of_people_are_takes(tmp_path: Path, word: str) -> None:
    """More takes than people: the takes of different people are not those of one person."""
    for seed, (person, gesture, take) in enumerate((p, g, t) for p in ("ann", "bob") for g in GESTURES for t in "123"):
        touches(tmp_path / "src" / person / gesture / f"{word}{take}.csv", seed)
    found, _, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{subject}/{label}/{recording}.csv"]
    assert (seen.subjects, seen.gestures) == (["ann", "bob"], {"hug": 6, "tap": 6})


def test_runs_of_unknown_people_are_no_people(tmp_path: Path) -> None:
    for seed, (gesture, take) in enumerate((g, t) for g in GESTURES for t in "123"):
        touches(tmp_path / "src" / gesture / f"run{take}.csv", seed)
    found, _, seen = guessed(tmp_path / "src")
    assert (found["paths"], seen.subjects) == (["{label}/{recording}.csv"], ["unknown"])


def test_clocks_and_counters_are_no_channels_whatever_they_are_called(tmp_path: Path) -> None:
    for seed, gesture in enumerate(GESTURES * 3):
        rows = 300
        jitter = np.random.default_rng(seed).integers(0, 6, rows)
        touches(
            tmp_path / "src" / f"P{seed // 2}" / f"{gesture}.csv",
            seed,
            rows,
            elapsed=[0.02 * k + 0.001 * j for k, j in enumerate(jitter.tolist())],
            packet=[(k + 100 * seed) % 256 for k in range(rows)],
            total=[5 * k + 1000 * seed for k in range(rows)],
            remaining=[9000 - 20 * k for k in range(rows)],
            warmth=[round(20 + 0.3 * seed + 0.001 * (seed + 1) * k, 3) for k in range(rows)],
            wheel=[k % 7 for k in range(rows)],
        )
    found, guess, _ = guessed(tmp_path / "src")
    assert names(found) == ["left", "warmth", "wheel"]
    assert [doubt.split("'")[1] for doubt in guess.doubts if "not for a channel" in doubt] == [
        "elapsed",
        "packet",
        "total",
        "remaining",
    ]


@pytest.mark.parametrize(
    ("name", "said"), [("code", "(4, 5, 6), so that it is taken for the label"), ("Gesture", "are numbers")]
)
def test_few_whole_numbers_that_change_rarely_are_the_label(tmp_path: Path, name: str, said: str) -> None:
    for seed in range(3):
        codes = [k // 100 % 3 + 4 for k in range(900)]
        touches(
            tmp_path / "src" / f"P{seed}.csv", seed, 900, **{name: codes, "belly": [k // 150 % 2 for k in range(900)]}
        )
    found, guess, seen = guessed(tmp_path / "src")
    assert names(found) == ["left", "belly"], "a cell that is touched has two values"
    assert seen.gestures == {"4": 9, "5": 9, "6": 9}
    assert any(said in doubt for doubt in guess.doubts)


def test_whole_numbers_that_change_rarely_are_no_channel_beside_a_label(tmp_path: Path) -> None:
    for seed, (person, gesture) in enumerate((p, g) for p in ("P1", "P2") for g in GESTURES):
        touches(tmp_path / "src" / person / f"{gesture}.csv", seed, trial_number=[seed] * 60)
    found, guess, _ = guessed(tmp_path / "src")
    assert (found["paths"], names(found)) == (["{subject}/{label}.csv"], ["left"])
    assert any("'trial_number' has whole numbers that change rarely (0, 1, 2, 3)" in d for d in guess.doubts)


@pytest.mark.parametrize(
    ("axes", "vector"),
    [
        (("aX", "aY", "aZ"), ["ax", "ay", "az"]),
        (("accX", "accY", "accZ"), ["accx", "accy", "accz"]),
        (("acc_x", "acc_y", "acc_z"), ["acc_x", "acc_y", "acc_z"]),
        (("Accelerometer_x", "Accelerometer_y", "Accelerometer_z"), [f"accelerometer_{a}" for a in "xyz"]),
        (("X", "Y", "Z"), ["x", "y", "z"]),
        (("x_acc", "y_acc", "z_acc"), ["x_acc", "y_acc", "z_acc"]),
        (("ax (m/s2)", "ay (m/s2)", "az (m/s2)"), ["ax_m_s2", "ay_m_s2", "az_m_s2"]),
    ],
)
def test_accelerations_by_their_names_have_one_range(tmp_path: Path, axes: tuple[str, ...], vector: list[str]) -> None:
    for seed, (person, gesture) in enumerate((p, g) for p in ("P1", "P2") for g in GESTURES):
        values = {axis: [round(v * 4**k, 2) for v in noise(60, seed)] for k, axis in enumerate(axes)}
        others = {"gX": noise(60, 9), "accuracy": noise(60, 8), "max_force": noise(60, 7)}
        touches(tmp_path / "src" / person / f"{gesture}.csv", seed, 60, **values, **others)
    found, guess, _ = guessed(tmp_path / "src")
    assert found["layout"]["vectors"] == [vector]
    channels = {channel["name"]: channel for channel in found["layout"]["channels"]}
    assert {name for name, channel in channels.items() if channel["kind"] == "acceleration"} == set(vector)
    assert len({(channels[name]["valid_min"], channels[name]["valid_max"]) for name in vector}) == 1
    assert sum("is guessed (±" in doubt for doubt in guess.doubts) == 1


@pytest.mark.parametrize("axes", [("x_gyro", "y_gyro", "z_gyro"), ("gx", "gy", "gz"), ("GyroX", "GyroY", "GyroZ")])
def test_the_axes_of_a_gyroscope_are_a_vector(tmp_path: Path, axes: tuple[str, ...]) -> None:
    for seed, (person, gesture) in enumerate((p, g) for p in ("P1", "P2") for g in GESTURES):
        values = {axis: noise(60, seed + k) for k, axis in enumerate(("ax", "ay", "az", *axes))}
        touches(tmp_path / "src" / person / f"{gesture}.csv", seed, 60, **values)
    found, *_ = guessed(tmp_path / "src")
    assert found["layout"]["vectors"] == [["ax", "ay", "az"], [axis.lower() for axis in axes]]
    assert {c["kind"] for c in found["layout"]["channels"] if c["name"][-2:] != "ft"} == {
        "acceleration",
        "angular rate",
    }


def test_a_row_that_may_be_a_whole_recording_is_a_doubt(tmp_path: Path) -> None:
    columns = {f"C{k}": noise(40, k) for k in range(1, 31)}
    people = {"person": [f"P{k % 4}" for k in range(40)], "gesture": [GESTURES[k % 2] for k in range(40)]}
    table(tmp_path / "src" / "trials.csv", people | columns)
    _, guess, _ = guessed(tmp_path / "src")
    assert any("the 30 columns from 'c1' to 'c30'" in d and "a row for each sample" in d for d in guess.doubts)


def test_cells_of_files_with_other_columns_are_not_used(tmp_path: Path) -> None:
    for seed, person in enumerate(("P1", "P2", "P3")):
        touches(tmp_path / "src" / person / "touch.csv", seed, 60, gesture=["hug"] * 30 + ["tap"] * 30)
        questions = {"question": [1, 2, 3], "answer": ["yes", "no", "maybe"], "seconds": [3, 4, 2]}
        table(tmp_path / "src" / person / "answers.csv", questions)
    found, guess, seen = guessed(tmp_path / "src")
    assert "missing" not in found
    assert found["exclude"] == [f"{person}/answers.csv" for person in ("P1", "P2", "P3")]
    assert (seen.gestures, seen.rejected) == ({"hug": 3, "tap": 3}, ())
    assert any("files without such rows are left out: P1/answers.csv" in doubt for doubt in guess.doubts)


def test_a_document_of_json_is_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "src").mkdir()
    recordings = [
        {"subject": f"P{k % 2}", "label": GESTURES[k // 2], "time_ms": list(range(0, 5000, 10)), "left": noise(500, k)}
        for k in range(4)
    ]
    text = json.dumps(recordings, indent=1)
    assert text.count("\n") > guessing._LINES
    (tmp_path / "src" / "all.json").write_text(text)
    found, _, seen = guessed(tmp_path / "src")
    assert (names(found), found["layout"]["rate_hz"]) == (["left"], 100.0)
    assert (seen.recordings, seen.subjects, seen.gestures) == (4, ["P0", "P1"], {"hug": 2, "tap": 2})
    monkeypatch.setattr(guessing, "_MOST_JSON", 1000)
    with pytest.raises(DatasetError, match="one JSON document of 0 MB, too long to be guessed from"):
        guess_pattern(tmp_path / "src")


@pytest.mark.parametrize(("key", "rate_hz"), [("ID", 40.0), ("id", 50.0)])
def test_actions_of_microbit_createai(tmp_path: Path, key: str, rate_hz: float) -> None:
    (tmp_path / "src").mkdir()
    for person in (1, 2):
        actions = [
            {
                "icon": icon,
                key: 17 + k,
                "name": gesture,
                "matrix": [True, False] * 12,
                "recordings": [
                    {key: 1000 * k + n, "data": {axis: noise(48 + n, 9 * k + n) for axis in "xyz"}} for n in range(3)
                ],
            }
            for k, (icon, gesture) in enumerate(zip(("Heart", "No", "Yes"), (*GESTURES, "never"), strict=True))
        ]
        actions[2]["recordings"] = []
        (tmp_path / "src" / f"P{person}.json").write_text(json.dumps(actions, indent=2))
    found, guess, seen = guessed(tmp_path / "src")
    assert (names(found), found["layout"]["vectors"]) == (["x", "y", "z"], [["x", "y", "z"]])
    assert found["row_rate_hz"] == found["layout"]["rate_hz"] == rate_hz
    assert (seen.recordings, seen.gestures) == (12, {"hug": 6, "tap": 6})
    assert seen.rows[1].time_ms == 1000 / rate_hz
    assert seen.messages == ()
    assert any("micro:bit CreateAI" in doubt for doubt in guess.doubts)
    assert "lists within objects are taken for recordings: 12 in 6 objects" in guess.doubts
    assert any("'name' is taken for the label: 'hug', 'tap'" in doubt for doubt in guess.doubts)


def test_files_of_edge_impulse_have_their_own_interval_label_and_sensors(tmp_path: Path) -> None:
    sensors = [{"name": "accX", "units": "m/s2"}, {"name": "accY", "units": "m/s2"}, {"name": "accZ", "units": "m/s2"}]
    for number, (split, gesture) in enumerate((s, g) for s in ("training", "testing") for g in (*GESTURES, "at rest")):
        rows = list(zip(*(noise(50, 10 * number + k) for k in range(3)), strict=True))
        order = [2, 1, 0] if number == 5 else [0, 1, 2]
        payload = {
            "device_name": f"aa:bb:{number % 2}",
            "device_type": "TOY",
            "interval_ms": 20 if number == 4 else 10,
            "sensors": [sensors[k] for k in order],
            "values": [[row[k] for k in order] for row in rows],
        }
        (tmp_path / "src" / split).mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / split / f"{gesture}.json.3a{number}f.ingestion-5.json").write_text(
            json.dumps({"protected": {"ver": "v1"}, "signature": "00" * 32, "payload": payload})
        )
    found, guess, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["*/{label:[^.]+}.{recording}.json"]
    assert found["columns"]["interval_ms"] == "payload.interval_ms"
    assert found["columns"]["accx"] == "payload.sensors.accX"
    assert (found["layout"]["rate_hz"], found["layout"]["vectors"]) == (100.0, [["accx", "accy", "accz"]])
    assert seen.gestures == {"at rest": 2, "hug": 2, "tap": 2}
    by_file = {row.file: row for row in seen.rows[1::2]}
    steps = {name.split("/")[0] + "/" + name.split("/")[1].split(".")[0]: row.time_ms for name, row in by_file.items()}
    assert {steps[name] for name in steps if name == "training/tap" or name == "testing/tap"} <= {10, 20}
    assert {row.time_ms for row in seen.rows} == {0, 10, 20}, "each file has its own interval"
    assert any("the label is taken from the path" in doubt for doubt in guess.doubts)
    assert not any("binary channels" in doubt for doubt in guess.doubts)


def test_samples_in_json_are_no_recordings(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    for person in (1, 2):
        lines = [
            {
                "label": gesture,
                "samples": [{"t": 20 * k, "acc": [k, 1, v], "cells": [1] * 9} for k, v in enumerate(noise(40, n))],
            }
            for n, gesture in enumerate(GESTURES)
        ]
        (tmp_path / "src" / f"P{person}.jsonl").write_text("\n".join(map(json.dumps, lines)))
    _, _, seen = guessed(tmp_path / "src")
    assert (seen.recordings, seen.gestures) == (4, {"hug": 2, "tap": 2})


def test_numbers_without_columns_are_refused_with_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "a.json").write_text("[[1, 2], [3, 4]]")
    with pytest.raises(DatasetError, match="it has no columns of one length"):
        guess_pattern(tmp_path / "src")


def test_a_number_of_takes_beside_the_label_tells_recordings_apart(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    for seed in range(2):
        rows = 40 * 50
        columns = {
            "gesture": [GESTURES[k // 1000] for k in range(rows)],
            "sample_id": [k // 40 for k in range(rows)],
            "t_ms": [20 * k for k in range(rows)],
            "left": noise(rows, seed),
        }
        table(tmp_path / "src" / f"P{seed}.csv", columns)
    found, guess, seen = guessed(tmp_path / "src")
    assert (found["columns"], names(found)) == ({"recording": "sample_id"}, ["left"])
    assert seen.recordings == 100
    assert any("'sample_id'" in d and "taken for the take" in d for d in guess.doubts)


def test_a_second_word_for_the_gesture_is_no_person(tmp_path: Path) -> None:
    for seed, (gesture, take) in enumerate((g, t) for g in ("squeeze", "stroke") for t in range(4)):
        other = {"squeeze": "press", "stroke": "slide down"}[gesture]
        touches(tmp_path / "src" / gesture / f"{other}_{take}.csv", seed)
    found, _, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{label}/*_{recording}.csv"]
    assert (seen.gestures, seen.subjects) == ({"squeeze": 4, "stroke": 4}, ["unknown"])


def test_names_that_end_in_a_date_are_not_those_of_the_gesture_recorder(tmp_path: Path) -> None:
    for seed in range(6):
        label = [seed % 3] * 60
        touches(tmp_path / "src" / f"data_{seed % 3}_20251106_21150{seed}.csv", seed, 60, label=label)
    found, _, seen = guessed(tmp_path / "src")
    assert names(found) == ["left"]
    assert (seen.recordings, sorted(seen.gestures)) == (6, ["0", "1", "2"])


def test_a_number_of_the_row_is_no_clock(tmp_path: Path) -> None:
    for seed, (person, gesture) in enumerate((p, g) for p in ("P1", "P2") for g in GESTURES):
        table(tmp_path / "src" / person / f"{gesture}.csv", {"n": list(range(60)), "left": noise(60, seed)})
    found, guess, _ = guessed(tmp_path / "src")
    assert (found["row_rate_hz"], names(found)) == (50.0, ["left"])
    assert any("have no clock" in doubt for doubt in guess.doubts)


def test_recordings_of_which_one_lacks_a_channel_can_be_guessed_from(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    recordings = [
        {"label": GESTURES[k % 2], "t_ms": list(range(0, 600 + 20 * k, 20)), "left": noise(30 + k, k)} for k in range(4)
    ]
    recordings[0]["right"], recordings[2]["right"] = noise(30, 7), noise(32, 8)
    recordings[1]["tags"] = ["a", "b"]
    (tmp_path / "src" / "P1.jsonl").write_text("\n".join(map(json.dumps, recordings)))
    found, _, seen = guessed(tmp_path / "src")
    assert names(found) == ["left", "right"]
    assert any("without a number in every column left out" in note for note in seen.messages)


def test_columns_without_a_name_are_channels_by_their_place(tmp_path: Path) -> None:
    for seed, gesture in enumerate(GESTURES * 2):
        lines = [",Ch1,,Ch2,,Ch3"]
        lines += [
            f"{k},{value},{change},{20 * k},{value * 2 + change},OL"
            for k, (value, change) in enumerate(zip(noise(40, seed), noise(40, seed + 9), strict=True))
        ]
        path = tmp_path / "src" / gesture / f"take{seed}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join(lines) + "\n")
    found, guess, seen = guessed(tmp_path / "src")
    # The third and the fifth column have no name; the first one counts the rows.
    assert [found["columns"].get(name) for name in names(found)] == [None, "#3", "#5"]
    assert names(found) == ["ch1", "c3", "c5"]
    assert found["columns"]["time"] == "Ch2"
    first = next(row for row in seen.rows if row.gesture == "hug")
    assert sorted(first.values.values()) == pytest.approx(sorted(noise_row(0)))
    assert "columns with texts are no channels: 'Ch3' ('OL')" in guess.doubts


def noise_row(seed: int) -> list[float]:
    value, change = noise(40, seed)[0], noise(40, seed + 9)[0]
    return [value, change, value * 2 + change]


def test_names_of_sensors_that_are_read_in_turn_are_no_labels(tmp_path: Path) -> None:
    for seed, (gesture, take) in enumerate((g, t) for g in ("up", "down") for t in range(3)):
        touches(tmp_path / "src" / gesture / f"{gesture}-{take}.csv", seed, tag=["t7", "t9", "t9", "t8"] * 15)
    found, guess, seen = guessed(tmp_path / "src")
    assert "label" not in found.get("columns", {})
    assert (seen.gestures, seen.subjects) == ({"down": 3, "up": 3}, ["unknown"])
    assert any("the column 'tag' changes from row to row ('t7', 't9')" in doubt for doubt in guess.doubts)


@pytest.mark.parametrize("folder", ["", "Trial{}", "all/Trial{}"])
def test_a_number_behind_the_label_is_the_take(tmp_path: Path, folder: str) -> None:
    for seed, (trial, gesture, take) in enumerate((n, g, t) for n in (1, 2) for g in GESTURES for t in (0, 1, 12)):
        if folder or trial == 1:
            touches(tmp_path / "src" / folder.format(trial) / f"emg_{gesture}{take}.csv", seed)
    found, guess, seen = guessed(tmp_path / "src")
    assert seen.gestures == ({"hug": 6, "tap": 6} if folder else {"hug": 3, "tap": 3})
    pattern = r"all/{recording}/emg_{label:.*\D}*.csv" if "all" in folder else r"emg_{label:.*\D}{recording}.csv"
    assert found["paths"] == [("*/" if folder == "Trial{}" else "") + pattern]
    assert seen.subjects == ["unknown"]
    assert any("'hug0' and 'hug1' in the path are taken for one label" in doubt for doubt in guess.doubts)


def test_the_rate_that_json_states_is_used(tmp_path: Path) -> None:
    for seed, gesture in enumerate(GESTURES * 2):
        rows = [[round(x / 9, 2) for x in noise(3, 90 * seed + k)] for k in range(60)]
        path = tmp_path / "src" / gesture / f"take{seed}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"duration": 300, "imu": {"frequency": 200, "data": [{"acceleration": r} for r in rows]}})
        )
    found, guess, seen = guessed(tmp_path / "src")
    assert (found["row_rate_hz"], found["layout"]["rate_hz"]) == (200.0, 200.0)
    assert seen.rows[1].time_ms == 5
    assert "the files have no clock: the rate is that of 'imu.frequency', 200" in guess.doubts
    # A list of three accelerations is a vector, whose axes have one range.
    assert [len(vector) for vector in found["layout"]["vectors"]] == [3]
    assert len({channel["valid_max"] for channel in found["layout"]["channels"]}) == 1


@pytest.mark.parametrize("head", ["0,1,2", ",0,1,2", "1,2,3,label"])
def test_numbers_of_columns_are_no_row(tmp_path: Path, head: str) -> None:
    for seed, (gesture, take) in enumerate((g, t) for g in GESTURES for t in range(3)):
        rows = [f"{x},{y},{z}" for x, y, z in zip(*(noise(60, 3 * seed + k) for k in range(3)), strict=True)]
        rows = [f"{k},{row}" if head.startswith(",") else row for k, row in enumerate(rows)]
        rows = [f"{row},{gesture}" if "label" in head else row for row in rows]
        path = tmp_path / "src" / gesture / f"take{take}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n".join([head, *rows]) + "\n")
    found, guess, seen = guessed(tmp_path / "src")
    assert len(names(found)) == 3 and all(name.startswith("c") for name in names(found))
    assert (seen.gestures, seen.rows[0].time_ms) == ({"hug": 3, "tap": 3}, 0)
    first = [noise(60, k)[0] for k in range(3)]
    assert list(seen.rows[0].values.values()) == pytest.approx(first)
    assert not any("no line of column names" in doubt for doubt in guess.doubts)


@pytest.mark.usefixtures("parquet")
def test_parquet_is_guessed_as_the_same_text_is(tmp_path: Path) -> None:
    import polars as pl

    for seed, (person, gesture, take) in enumerate((p, g, t) for p in "ABC" for g in GESTURES for t in (1, 2)):
        touches(tmp_path / "text" / person / f"{gesture}_{take}.csv", seed)
        (tmp_path / "src" / person).mkdir(parents=True, exist_ok=True)
        text = pl.read_csv(tmp_path / "text" / person / f"{gesture}_{take}.csv")
        text.write_parquet(tmp_path / "src" / person / f"{gesture}_{take}.parquet")
    found, _, seen = guessed(tmp_path / "src")
    (tmp_path / "guess.toml").unlink()
    of_text, _, seen_text = guessed(tmp_path / "text")
    assert found.pop("paths") == ["{subject}/{label}_{recording}.parquet"]
    assert of_text.pop("paths") == ["{subject}/{label}_{recording}.csv"]
    found["layout"]["name"] = of_text["layout"]["name"]
    assert found == of_text
    assert (
        (seen.subjects, seen.gestures)
        == (seen_text.subjects, seen_text.gestures)
        == (list("ABC"), {"hug": 6, "tap": 6})
    )


@pytest.mark.usefixtures("parquet")
def test_parquet_may_hold_dates_and_lists_and_pictures(tmp_path: Path) -> None:
    import polars as pl

    (tmp_path / "src").mkdir()
    rows, lists = [], []
    for take in range(9):
        person, gesture = ("ann", "bob", "cy")[take % 3], GESTURES[take % 2]
        x = [None if k == 5 else value for k, value in enumerate(noise(60, take))]
        at = [datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=10 * take + 0.02 * k) for k in range(60)]
        rows += [{"when": w, "who": person, "gesture": gesture, "x": v} for w, v in zip(at, x, strict=True)]
        lists.append({"who": person, "gesture": gesture, "x": x, "picture": b"\x89PNG", "made": {"by": "hand"}})
    pl.DataFrame(rows).with_columns(pl.col("gesture").cast(pl.Categorical)).write_parquet(
        tmp_path / "src" / "all.parquet"
    )
    found, guess, seen = guessed(tmp_path / "src")
    assert found["time_unit"] == "iso" and found["columns"] == {"subject": "who", "time": "when"}
    assert names(found) == ["x"] and found["layout"]["rate_hz"] == 50.0
    assert (seen.recordings, seen.subjects) == (9, ["ann", "bob", "cy"])
    # One row for each recording, as data sets of Hugging Face have them.
    (tmp_path / "guess.toml").unlink()
    (tmp_path / "src" / "all.parquet").unlink()
    pl.DataFrame(lists).write_parquet(tmp_path / "src" / "train.parquet")
    found, guess, seen = guessed(tmp_path / "src")
    assert names(found) == ["x"] and found["row_rate_hz"] == 50.0
    assert (seen.recordings, seen.subjects) == (9, ["ann", "bob", "cy"])
    assert any("no clock" in doubt for doubt in guess.doubts)
    (tmp_path / "src" / "train.parquet").write_bytes((tmp_path / "src" / "train.parquet").read_bytes()[:200])
    with pytest.raises(FileFormatError, match=r"'train.parquet' cannot be read as Parquet"):
        guess_pattern(tmp_path / "src")


def cues(xdf_stream: Any, name: str, *texts: str) -> Any:
    """A stream of markers: one each second from 0.5 s on."""
    return xdf_stream(name, [0.5 + k for k in range(len(texts))], list(texts), format="string", rate=0.0)


def stream(xdf_stream: Any, name: str, seed: int, *labels: str, rows: int = 600) -> Any:
    values = list(zip(*(noise(rows, seed + k) for k in range(len(labels) or 2)), strict=True))
    return xdf_stream(name, [0.01 * k for k in range(rows)], values, labels=labels)


def test_xdf_of_an_own_sensor_is_guessed(tmp_path: Path, xdf_writer: Any, xdf_stream: Any) -> None:
    for seed, (person, part) in enumerate((p, s) for p in ("ann", "bob", "cy") for s in ("morning", "evening")):
        glove = stream(xdf_stream, "Glove", seed, "Links oben", "bend")
        gaze = stream(xdf_stream, "Gaze", seed, "gx", "gy", rows=200)
        marks = cues(xdf_stream, "Cues", "hug", "end", "Tap", "end", "nothing")
        keys = cues(xdf_stream, "Keys", "a pressed")
        xdf_writer(tmp_path / "src" / person / f"{part}.xdf", [gaze, glove, keys, marks])
    found, guess, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{subject}/*.xdf"]
    assert found["columns"] == {"links_oben": "Links oben", "stream": "Glove", "markers": "Cues"}
    assert names(found) == ["links_oben", "bend"] and found["layout"]["rate_hz"] == 100.0
    assert (seen.subjects, seen.gestures) == (["ann", "bob", "cy"], {"Tap": 6, "hug": 6, "nothing": 6})
    assert sum("there are also Gaze:" in doubt or "there are also Keys:" in doubt for doubt in guess.doubts) == 2
    # Another spelling, and what means that nothing happens.
    pattern = replace(guess.pattern, idle=("nothing",), aliases={"tip": ("Tap",)})
    assert preview_import(tmp_path / "src", pattern=pattern).gestures == {"hug": 6, "tip": 6}
    assert (
        preview_import(tmp_path / "src" / "ann" / "morning.xdf", pattern=replace(pattern, paths=("*.xdf",))).recordings
        == 2
    )


def test_xdf_without_names_and_without_markers(tmp_path: Path, xdf_writer: Any, xdf_stream: Any) -> None:
    for seed, (person, gesture) in enumerate((p, g) for p in ("ann", "bob", "cy") for g in GESTURES for _ in range(2)):
        xdf_writer(tmp_path / "src" / person / f"{gesture}_{seed % 2}.xdf", [stream(xdf_stream, "Glove", seed)])
    (tmp_path / "src" / "ann" / "hug_7.xdf").write_bytes(b"XDF:")
    found, _, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{subject}/{label}_{recording}.xdf"] and names(found) == ["c1", "c2"]
    # Each file is one recording of the gesture in its name.
    assert (seen.recordings, seen.gestures, seen.subjects) == (12, {"hug": 6, "tap": 6}, ["ann", "bob", "cy"])
    with pytest.raises(FileFormatError, match="no stream of numbers"):
        guess_pattern(xdf_writer(tmp_path / "cues.xdf", [cues(xdf_stream, "Cues", "hug", "end")]))


def test_numbers_of_an_xdf_are_labels_where_no_texts_are(tmp_path: Path, xdf_writer: Any, xdf_stream: Any) -> None:
    codes = xdf_stream("Trig", [0.5 + k for k in range(4)], [[1], [0], [7], [0]], format="int32", rate=0.0)
    heart = xdf_stream("Heart", [0.3 + k for k in range(5)], [[60.5 + k] for k in range(5)], rate=0.0)
    marks = cues(xdf_stream, "Cues", "hug", "end")
    for seed, person in enumerate(PEOPLE):
        glove = stream(xdf_stream, "Glove", seed, "force", "bend")
        xdf_writer(tmp_path / "src" / person / "a.xdf", [glove, heart, codes])
        xdf_writer(tmp_path / "texts" / person / "a.xdf", [glove, heart, codes, marks])
    found, guess, seen = guessed(tmp_path / "src")
    assert found["columns"] == {"markers": "Trig"} and seen.gestures == {"1": 3, "7": 3}
    assert any("has the numbers 1, 7" in doubt for doubt in guess.doubts)
    pattern = replace(guess.pattern, aliases={"hug": ("1",), "tap": ("7",)})
    assert preview_import(tmp_path / "src", pattern=pattern).gestures == {"hug": 3, "tap": 3}
    assert set(guess_pattern(tmp_path / "texts").labels) == {"hug"}


def test_compressed_xdf_beside_others_is_taken_too(tmp_path: Path, xdf_writer: Any, xdf_stream: Any) -> None:
    marks = cues(xdf_stream, "Cues", "hug", "end")
    for seed, person in enumerate(PEOPLE):
        glove = stream(xdf_stream, "Glove", seed, "force", "bend")
        plain = xdf_writer(tmp_path / "src" / person / "one.xdf", [glove, marks])
        later = xdf_writer(tmp_path / "two.xdf", [stream(xdf_stream, "Glove", seed + 9, "force", "bend"), marks])
        with gzip.open(plain.with_name("two.xdf.gz"), "wb") as packed:
            packed.write(later.read_bytes())
    found, guess, seen = guessed(tmp_path / "src")
    assert found["paths"] == ["{subject}/*.xdf", "{subject}/*.xdf.gz"]
    assert (seen.recordings, seen.subjects) == (6, list(PEOPLE))
    assert not any("left out" in doubt for doubt in guess.doubts)


def test_channels_of_one_name_are_said_at_the_guess(tmp_path: Path, xdf_writer: Any, xdf_stream: Any) -> None:
    marks = cues(xdf_stream, "Cues", "hug", "end", "tap", "end")
    for seed, person in enumerate(PEOPLE):
        glove = stream(xdf_stream, "Glove", seed, "force", "bend", "Bend")
        xdf_writer(tmp_path / "src" / person / "a.xdf", [glove, marks])
    found, guess, seen = guessed(tmp_path / "src")
    assert names(found) == ["force"] and seen.recordings == 6
    assert any("several channels have the name bend, Bend" in doubt for doubt in guess.doubts)
    glove = stream(xdf_stream, "Glove", 1, "force", "force")
    with pytest.raises(FileFormatError, match="several channels of the stream 'Glove' are called 'force'"):
        guess_pattern(xdf_writer(tmp_path / "all.xdf", [glove, marks]))


@pytest.mark.usefixtures("parquet")
def test_columns_of_parquet_that_are_left_out_are_said(tmp_path: Path) -> None:
    import polars as pl

    for seed, person in enumerate(PEOPLE):
        (tmp_path / "src" / person).mkdir(parents=True)
        force = noise(120, seed)
        frame = {"force": force, "imu": [{"x": value, "y": 1} for value in force], "label": ["hug", "tap"] * 60}
        pl.DataFrame(frame).write_parquet(tmp_path / "src" / person / "all.parquet")
    found, guess, _ = guessed(tmp_path / "src")
    assert names(found) == ["force"]
    assert any("the cells of imu are neither values" in doubt for doubt in guess.doubts)


@pytest.mark.usefixtures("parquet")
def test_parquet_with_axes_truths_and_unlike_files(tmp_path: Path) -> None:
    import polars as pl

    for seed, person in enumerate(PEOPLE):
        (tmp_path / "src" / person).mkdir(parents=True)
        axes = [noise(120, 9 * seed + k) for k in range(3)]
        frame = {
            "t": [time(0, 0, k // 50, 20_000 * (k % 50)) for k in range(120)],
            "acc": [list(sample) for sample in zip(*axes, strict=True)],
            "force": [float("inf") if k == 3 else value for k, value in enumerate(noise(120, seed + 50))],
            "label": [k % 40 >= 20 for k in range(120)],
        }
        pl.DataFrame(frame).write_parquet(tmp_path / "src" / person / "all.parquet")
    pl.DataFrame({"who": ["A"], "age": [7]}).write_parquet(tmp_path / "src" / "people.parquet")
    (tmp_path / "src" / "bad.parquet").write_bytes(b"PAR1 and no more")
    found, _, seen = guessed(tmp_path / "src")
    assert found["columns"]["acc_0"] == "acc.0" and found["layout"]["vectors"] == [["acc_0", "acc_1", "acc_2"]]
    assert names(found) == ["acc_0", "acc_1", "acc_2", "force"] and found["layout"]["rate_hz"] == 50.0
    # The label 0 is idle if the pattern says so.
    assert (seen.recordings, seen.subjects, set(seen.gestures)) == (18, list(PEOPLE), {"0", "1"})
    pattern = replace(guess_pattern(tmp_path / "src").pattern, idle=("0",))
    assert preview_import(tmp_path / "src", pattern=pattern).gestures == {"1": 9}


def test_xdf_that_differs_in_one_file_and_channels_with_names_of_parts(
    tmp_path: Path, xdf_writer: Any, xdf_stream: Any
) -> None:
    marks = cues(xdf_stream, "Cues", "hug", "end", "tap", "end")
    for seed, person in enumerate(PEOPLE):
        labels = ("force", "bend", "subject", "battery")[: 4 if person == "P01" else 3]
        xdf_writer(tmp_path / "src" / person / "a.xdf", [stream(xdf_stream, "Glove", seed, *labels), marks])
    found, guess, seen = guessed(tmp_path / "src")
    assert names(found) == ["force", "bend"] and found["paths"] == ["{subject}/*.xdf"]
    assert (seen.recordings, seen.subjects) == (6, list(PEOPLE))
    assert any(doubt == "the stream 'Cues' names the labels: 'hug', 'tap'" for doubt in guess.doubts)
    # Columns of tables in the same pattern do not disturb.
    mixed = replace(guess.pattern, columns={"label": "what", "time": "t"})
    assert preview_import(tmp_path / "src", pattern=mixed).recordings == 6
    unused = "row_rate_hz of the pattern are for tables, and not used for XDF"
    assert unused in preview_import(tmp_path / "src", pattern=replace(guess.pattern, row_rate_hz=25.0)).messages
