"""Folders of other projects come in by a TOML alone, and what a TOML or a file has wrong is named with its line."""

from __future__ import annotations

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError, DatasetError
from plushsense.core.toml import line_of
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.pattern import ImportPattern, path_expression, read_pattern
from plushsense.dataset.importing.results import ImportResult
from plushsense.dataset.quality.checking import check
from support.foreign_folders import FOLDERS, PATTERNS

pytestmark = pytest.mark.slow

LAYOUT = {
    "rate_hz": 100.0,
    "channels": [{"name": name, "unit": "", "kind": "sensor"} for name in ("a", "b")],
}
# Recordings, people, labels, streams, rows of all recordings, and checks that find something.
EXPECTED = {
    "touch-cells": (8, ["S01", "S02"], ["long_hug", "pat"], 0, 480, set()),
    "multimeter": (6, ["ana", "ben"], ["pull", "squeeze"], 3, 3 * 189, {"garbage"}),
    "taps": (8, ["u1", "u2"], ["double tap", "tap"], 0, 428, set()),
    "strokes": (8, ["subj03", "subj04"], ["Fast stroke", "Slow stroke"], 0, 960, set()),
    "phone-watch": (4, ["P1", "P2"], ["knock", "wave"], 2, 300, set()),
}


def files(folder: Path) -> list[str]:
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_of_another_project_comes_in_by_its_toml(name: str, tmp_path: Path) -> None:
    FOLDERS[name](tmp_path / "src")
    before = files(tmp_path / "src")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=PATTERNS / f"{name}.toml")
    recordings, people, labels, streams, rows, found = EXPECTED[name]
    assert (done.recordings, done.dataset.subjects, done.gestures, done.streams) == (
        recordings,
        people,
        labels,
        streams,
    )
    assert sum(r.rows for r in done.dataset.recordings) == rows
    assert done.rejected == ()
    assert files(tmp_path / "src") == before, "the source is only read"
    report = check(done.dataset)
    assert {f.check for f in report.findings} == found
    assert report.ok
    # Every recording is traced back to its file.
    origins = [json.loads(p.read_text()) for p in (tmp_path / "DS").rglob("origin.json")]
    named = {r: text for o in origins for s in o["sources"] for r, text in s["recordings"].items()}
    assert {Path(r.file).name for r in done.dataset.recordings} == set(named)
    sources = {s["source"] for o in origins for s in o["sources"]}
    assert sources == set(before) - {f.file for f in done.left_out}
    again = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=PATTERNS / f"{name}.toml", add_to=True)
    assert (again.added_recordings, again.added_streams, again.recordings) == (0, 0, recordings)


@pytest.mark.parametrize("name", FOLDERS)
def test_a_guess_reads_what_was_written_by_hand(name: str, tmp_path: Path) -> None:
    FOLDERS[name](tmp_path / "src")
    guessed = guess_pattern(tmp_path / "src")
    guessed.write(tmp_path / "guess.toml")
    with pytest.raises(ConfigError, match="exists already"):
        guessed.write(tmp_path / "guess.toml")
    found = preview_import(tmp_path / "src", pattern=tmp_path / "guess.toml")
    recordings, people, labels, streams, _, _ = EXPECTED[name]
    assert (found.recordings, found.subjects, len(found.gestures), found.streams) == (
        recordings,
        people,
        len(labels),
        streams,
    )
    assert found.rejected == ()
    assert len(found.rows) == 10
    by_hand = tomllib.loads((PATTERNS / f"{name}.toml").read_text())["layout"]
    assert len(found.rows[0].values) == len(by_hand["channels"])


def test_what_a_guess_leaves_out_and_refuses(tmp_path: Path) -> None:
    src = tmp_path / "src"
    for person in range(1, 13):
        (src / f"P{person:02}").mkdir(parents=True)
        rows = [f"{k},{10 * k},{5000 + 10 * k},{k % 7}.25,{'Tap' if k < 30 else 'Hold'}" for k in range(60)]
        (src / f"P{person:02}" / "all day.csv").write_text("\n".join(["index,time_ms,time_host,force,gesture", *rows]))
    (src / "people.csv").write_text("code,age\nP01,30\n")
    (src / "notes.txt").write_text("12 people\n")
    guessed = guess_pattern(src)
    found = tomllib.loads(guessed.toml)
    assert found["paths"] == ["{subject}/*.csv"], "the next recording may have another name"
    assert found["exclude"] == ["people.csv"]
    wide = 10485.76  # 2^20 steps, with which the channel may calibrate itself
    force = {"name": "force", "unit": "", "kind": "sensor", "step": 0.01, "valid_min": -wide, "valid_max": wide}
    assert found["layout"]["channels"] == [force]
    assert found["layout"]["rate_hz"] == 100.0
    assert guessed.doubts[0] == "files that do not end in '.csv' are left out: 1"
    assert [doubt.partition(":")[0] for doubt in guessed.doubts[1:]] == [
        "the column 'index' is taken for a number of the row, not for a channel",
        "the column 'time_host' is taken for a second clock, not for a channel",
        "files without such rows are left out",
        "the person is taken from the path",
    ]
    assert preview_import(src, pattern=guessed.pattern).gestures == {"Hold": 12, "Tap": 12}
    shutil.copy(src / "P01" / "all day.csv", src / "P02" / "evening.csv")
    assert preview_import(src, pattern=guessed.pattern).gestures == {"Hold": 13, "Tap": 13}
    one = tomllib.loads(guess_pattern(src / "P01" / "all day.csv").toml)
    assert (one["paths"], one["layout"]["name"]) == (["*.csv"], "all-day")
    for path in src.rglob("*.*"):
        path.rename(path.with_name(f"Tap_{10**12}_60.csv"))
    with pytest.raises(DatasetError, match="recordings of the GestureRecorder: import it without a pattern"):
        guess_pattern(src)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="holds no table: a pattern"):
        guess_pattern(tmp_path / "empty")
    with pytest.raises(DatasetError, match="There is no"):
        guess_pattern(tmp_path / "none")


def test_a_guess_takes_the_characters_of_patterns_in_names_for_themselves(tmp_path: Path) -> None:
    for person in ("P01", "P02"):
        (tmp_path / "{raw}" / person).mkdir(parents=True)
        for take in ("1", "2"):
            rows = [f"{10 * k},{k % 7}.25,{'AB'[k // 30]}" for k in range(60)]
            lines = "\n".join(["time_ms,force,gesture", *rows])
            (tmp_path / "{raw}" / person / f"take{{x}}_{take}.csv").write_text(lines)
    found = tomllib.loads(guess_pattern(tmp_path).toml)
    assert found["paths"][0].startswith("?raw?/{subject}/take?x?_")
    assert preview_import(tmp_path, pattern=ImportPattern(**found)).gestures == {"A": 4, "B": 4}


def test_one_of_two_devices_in_folders_and_lines_that_end_in_a_semicolon(tmp_path: Path) -> None:
    for device in ("phone", "watch"):
        (tmp_path / "src" / device).mkdir(parents=True)
        for person in ("1600", "1601"):
            rows = [f"{person},{'AB'[k // 40]},{252207666810782 + 50_000_000 * k},{k}.5,-1.25;" for k in range(80)]
            (tmp_path / "src" / device / f"data_{person}_{device}.txt").write_text("\n".join(rows))
    guessed = guess_pattern(tmp_path / "src")
    assert any("all of the folders phone, watch are imported" in doubt for doubt in guessed.doubts)
    pattern = ImportPattern(
        layout={**LAYOUT, "rate_hz": 20.0},
        paths=("watch/data_{subject}_watch.txt",),
        names=("code", "label", "time", "a", "b"),
        time_unit="ns",
    )
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=pattern)
    assert [(r.subject, r.gesture, r.rows) for r in done.dataset.recordings] == [
        (person, label, 40) for person in ("1600", "1601") for label in "AB"
    ]
    assert len(done.left_out) == 2
    assert "fits no path of the pattern" in done.left_out[0].reason


def test_values_of_the_five_folders(tmp_path: Path) -> None:
    def read(name: str) -> ImportResult:
        FOLDERS[name](tmp_path / name)
        return import_recordings(tmp_path / name, tmp_path / f"{name}-DS", pattern=PATTERNS / f"{name}.toml")

    done = read("touch-cells")
    frames = done.dataset.read(done.dataset.recordings[0])
    assert frames.device_ms[:3].tolist() == [0, 50, 100], "a row each 1/20 s"
    text = (tmp_path / "touch-cells/S01/long_hug_1.txt").read_text().splitlines()
    assert [" ".join(map(str, row)) for row in frames.values.tolist()] == text
    done = read("multimeter")
    assert list(done.notes) == [
        "3 files, for instance ana_1.csv: 2 rows of another width than the header left out (the first: line 51: "
        "'0,96;11')",
        "3 files, for instance ana_1.csv: 4 values are missing ('OL'): they count as invalid",
    ]
    squeeze = next(r for r in done.dataset.recordings if r.gesture == "squeeze")
    values = done.dataset.read(squeeze).values
    # A row before was cut, so that row 60 of the file is the 40th.
    assert values[39:43, 1].tolist() == [2001] * 4
    assert np.all(values[np.r_[:39, 43:99], 1] <= 2000)
    done = read("strokes")
    assert "subj03/StrokeSlow/take 1.csv: 2 rows put into the order of their times" in done.notes
    assert np.all(np.diff(done.dataset.read(done.dataset.recordings[2]).device_ms) == 10)
    assert done.dataset.head.gestures.get("Slow stroke").affect == "positive"
    origin = (tmp_path / "strokes-DS/streams/subj04/origin.json").read_text()
    assert "'stroke-slow'" in origin, "the original spelling is kept"
    done = read("phone-watch")
    line = (tmp_path / "phone-watch/P1/session 1.csv").read_text().splitlines()[76].split(",")
    wave = next(r for r in done.dataset.recordings if r.gesture == "wave")
    assert (done.dataset.read(wave).values[0] / 1000).tolist() == [float(cell) for cell in line[1:7]]
    assert wave.epoch_ms == 1_700_000_001_500


def test_a_line_of_json_ends_where_a_line_ends(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    rows = [{"t": 10 * n, "a": n, "b": n, "label": "pat\u2028and\x85hit"} for n in range(4)]
    text = "\r\n".join(json.dumps(row, ensure_ascii=False) for row in rows)
    (tmp_path / "src" / "P1.jsonl").write_text(text, encoding="utf-8", newline="")
    found = preview_import(tmp_path / "src", pattern=ImportPattern(layout=LAYOUT, paths=("{subject}.jsonl",)))
    assert len(found.rows) == 4 and not any("left out" in note for note in found.messages)


@pytest.mark.filterwarnings("error")
def test_missing_times_and_numbers_of_hundreds_of_digits(tmp_path: Path) -> None:
    rows = ["1,1,hit", "OL,2,hit", "OL,3,hit", "1.02,4,hit", "1.04,5,hit"]
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "P1.csv").write_text("\n".join(["t,a,label", *rows]))
    layout = {**LAYOUT, "channels": LAYOUT["channels"][:1]}
    pattern = ImportPattern(layout=layout, missing=("OL",), paths=("{subject}.csv",), columns={"time": "t"})
    found = preview_import(tmp_path / "src", pattern=pattern)
    assert [row.values["a"] for row in found.rows] == [1.0, 4.0, 5.0]
    (tmp_path / "src" / "P1.csv").write_text("\n".join(["t,acc_x,label", f"0.01,1{'0' * 400},hit", *rows]))
    assert "acc_x" in guess_pattern(tmp_path / "src").toml


def test_a_preview_shows_rows_and_writes_nothing(tmp_path: Path) -> None:
    FOLDERS["multimeter"](tmp_path / "src")
    found = preview_import(tmp_path / "src", pattern=PATTERNS / "multimeter.toml")
    assert found.gestures == {"pull": 3, "squeeze": 3}
    first = found.rows[0]
    assert (first.subject, first.session, first.gesture, first.time_ms) == ("ana", "1", "squeeze", 400)
    line = (tmp_path / "src/ana_1.csv").read_text().splitlines()[22].split(";")
    assert [f"{first.values[name]:.1f}".replace(".", ",") for name in ("ears", "belly")] == line[1:3]
    assert [p.name for p in tmp_path.iterdir()] == ["src"]


def test_a_pattern_reads_a_zip_and_gets_people_from_a_mapping(tmp_path: Path) -> None:
    FOLDERS["taps"](tmp_path / "src")
    shutil.make_archive(str(tmp_path / "taps"), "zip", tmp_path / "src")
    (tmp_path / "map.csv").write_text("file,subject\ntaps.jsonl,eve\n")
    (tmp_path / "p.toml").write_text((PATTERNS / "taps.toml").read_text().replace('subject = "user.id"\n', ""))
    unknown = preview_import(tmp_path / "taps.zip", pattern=tmp_path / "p.toml")
    assert unknown.subjects == ["unknown"] and "--subjects map.csv" in unknown.messages[-1]
    with pytest.raises(DatasetError, match="no column 'subject'.*--subjects map.csv"):
        import_recordings(tmp_path / "src", tmp_path / "DS", pattern=tmp_path / "p.toml", person="")
    done = import_recordings(
        tmp_path / "taps.zip", tmp_path / "DS", pattern=tmp_path / "p.toml", subjects=tmp_path / "map.csv"
    )
    assert (done.recordings, done.dataset.subjects) == (8, ["eve"])


def test_labels_that_the_gesture_set_has_not_are_named(tmp_path: Path) -> None:
    FOLDERS["strokes"](tmp_path / "src")
    (tmp_path / "src/subj03/StrokeFast").rename(tmp_path / "src/subj03/Poke")
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=PATTERNS / "strokes.toml")
    assert any("the gesture set 'strokes' has no gesture 'Poke' (2)" in note for note in done.notes)


def test_cells_and_counts_are_no_faults_unless_they_never_change(tmp_path: Path) -> None:
    FOLDERS["touch-cells"](tmp_path / "src")
    for path in (tmp_path / "src").rglob("*_?.txt"):
        path.write_text("".join(line[:14] + "0\n" for line in path.read_text().splitlines()))
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=PATTERNS / "touch-cells.toml")
    (found,) = check(done.dataset).findings
    assert (found.check, found.severity) == ("flat", "warning")
    assert found.message == "channel nose does not change in 8 of 8 recordings"
    FOLDERS["strokes"](tmp_path / "strokes")
    toml = (PATTERNS / "strokes.toml").read_text()
    (tmp_path / "p.toml").write_text(toml.replace("valid_max = 64", "valid_max = 3"))
    done = import_recordings(tmp_path / "strokes", tmp_path / "DS2", pattern=tmp_path / "p.toml")
    found = check(done.dataset, only=["saturated"]).findings[0]
    assert "touched for" in found.message and "at 3 cells" in found.message


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('paths = ["*"]\nskip_line = 2\n', r"Unknown key 'skip_line' in .*, line 2: accepted are .*skip_before"),
        ("skip_after = true\n", "line 1, skip_after is True: accepted is a whole number"),
        ('missing = "OL"\n', "line 1, missing is 'OL': accepted is a list of texts"),
        ('[columns]\ntime = "t"\nx = 3\n', "line 3, columns.x is 3: accepted is text"),
        ('\npaths = ["{subjct}/*.csv"]\n', "line 2: .*{subject}.*Did you mean 'subject'"),
        ('paths = ["{subject/*.csv"]\n', "has a '{' without its partner"),
        ('paths = ["{label:[}.csv"]\n', "expression that is not valid"),
        ("row_rate_hz = 50\ntime_unit = 's'\n", "line 1: row_rate_hz is for files without a clock"),
        ("row_rate_hz = -1\n", "accepted is a number above 0"),
        ("skip_before = -1\n", "accepted are 0 and more"),
        ('separator = ";;"\n', "accepted is one character"),
        ('decimal = ","\nseparator = ","\n', "line 1: decimal and separator are both"),
        ('encoding = "utf-9"\n', "accepted are names such as utf-8"),
        ('encoding = "utf\\u0000"\n', "accepted are names such as utf-8"),
        ('[aliases]\nTap = ["t"]\nTip = ["t"]\n', "'t' is an alias of 'Tap' and of 'Tip'"),
        ("paths = = 1\n", "is not valid TOML: .*line 1"),
    ],
)
def test_what_is_wrong_in_a_toml_is_named_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(BadInput, match=said):
        read_pattern(tmp_path / "p.toml")


def test_the_line_of_a_key() -> None:
    text = 'a = 1\n[t]\n"b c" = 2\n[t.u]\nd = { e = 1 }\n'
    assert [line_of(text, s) for s in (("a",), ("t", "b c"), ("t", "u", "d", "e"), ("t", "x"), ("z",))] == [
        1,
        3,
        5,
        2,
        0,
    ]


@pytest.mark.parametrize(
    ("pattern", "path", "parts"),
    [
        (
            "{subject}/{label}_{recording}.csv",
            "P1/long_hug_3.csv",
            {"subject": "P1", "label": "long_hug", "recording": "3"},
        ),
        ("**/{label}.csv", "Tap.CSV", {"label": "Tap"}),
        ("**/{label}.csv", "a/b/Tap.csv", {"label": "Tap"}),
        ("{subject}/{subject}-{label}.csv", "P1/P1-Tap.csv", {"subject": "P1", "label": "Tap"}),
        ("{subject}/{subject}-{label}.csv", "P1/P2-Tap.csv", None),
        (
            r"{subject:P\d{2}}{label:[a-z]+}{recording:\d+}.t?t",
            "P01tap03.txt",
            {"subject": "P01", "label": "tap", "recording": "03"},
        ),
        ("*/x.csv", "a/b/x.csv", None),
    ],
)
def test_paths(pattern: str, path: str, parts: dict[str, str] | None) -> None:
    match = path_expression(pattern).fullmatch(path)
    assert (None if match is None else match.groupdict()) == parts


@pytest.mark.parametrize(
    ("content", "keys", "said"),
    [
        ("t,label,a\n1,x,2\n", {}, "no column 'b'; it has t, label, a: .*b = \"NAME\"  under .columns. of the pattern"),
        ("t,a,b\n1,2,3\n", {}, "no column 'label'.*let {label} stand in paths"),
        ("label,a,b\nx,2,3\n", {}, "no column 'time'.*row_rate_hz if there is no clock"),
        ("t,label,a,a\n1,x,2,3\n", {"columns": {"b": "t"}}, "two columns 'a'.*a#1 and a#2"),
        ("", {}, "no line of column names: a table needs a header, or names in the pattern"),
        ("t,label,a,b\n1,x,k,m\n", {}, "no usable row"),
        ("[1, 2]", {"format": "json"}, "no JSON object"),
        ("\udcff", {}, "is not UTF-8: save it as UTF-8, or name its encoding"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(tmp_path: Path, content: str, keys: dict[str, Any], said: str) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "P1.csv").write_bytes(content.encode("utf-8", "surrogateescape"))
    pattern = ImportPattern(layout=LAYOUT, paths=("{subject}.csv",), **keys)
    with pytest.raises(DatasetError, match=said):
        import_recordings(tmp_path / "src", tmp_path / "DS", pattern=pattern)
    assert not (tmp_path / "DS").exists()


def test_dates_white_space_columns_by_number_and_rows_in_json(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    rows = [f"2026-03-01T10:00:00.{k:02}0Z  {k}   {-k}" for k in range(40)]
    (tmp_path / "src" / "P1_tap.txt").write_text("# made up\n" + "\n".join(rows))
    numbered = ImportPattern(
        layout=LAYOUT,
        paths=("{subject}_{label}.txt",),
        names=("when", "a", "k"),
        skip_before=1,
        time_unit="iso",
        columns={"time": "when", "b": "#3"},
    )
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=numbered)
    (recording,) = done.dataset.recordings
    frames = done.dataset.read(recording)
    assert frames.values[:3].tolist() == [[0, 0], [1, -1], [2, -2]]
    assert (recording.epoch_ms, np.diff(frames.device_ms).tolist()) == (1_772_359_200_000, [10] * 39)
    (tmp_path / "json").mkdir()
    objects = [{"who": "P2", "label": "Tap", "t_ms": 10 * k, "touch": [k, None if k == 5 else 7]} for k in range(30)]
    (tmp_path / "json" / "all.json").write_text(json.dumps(objects))
    by_item = ImportPattern(
        layout=LAYOUT, columns={"subject": "who", "a": "touch.0", "b": "touch.1"}, missing=("",), paths=("*.json",)
    )
    done = import_recordings(tmp_path / "json", tmp_path / "DS2", pattern=by_item)
    (recording,) = done.dataset.recordings
    values = done.dataset.read(recording).values
    assert values[:, 0].tolist() == list(range(30))
    assert (values[:, 1] == 7).sum() == 29
    assert recording.flags == ("1 value outside the valid range (b; first in row 6)",)


def test_parquet_has_types_and_may_have_no_clock(tmp_path: Path, parquet: None) -> None:
    import polars as pl

    (tmp_path / "src").mkdir()
    pl.DataFrame({"label": ["Tap"] * 30, "a": range(30), "b": [1.0] * 30}).write_parquet(
        tmp_path / "src" / "P1.parquet"
    )
    keys: dict[str, Any] = {"layout": LAYOUT, "paths": ("{subject}.parquet",), "row_rate_hz": 100.0}
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**keys))
    assert done.dataset.read(done.dataset.recordings[0]).device_ms[:3].tolist() == [0, 10, 20]
    with pytest.raises(DatasetError, match="missing is for text"):
        import_recordings(tmp_path / "src", tmp_path / "DS2", pattern=ImportPattern(**keys, missing=("OL",)))
    dates = {**keys, "row_rate_hz": 0.0, "time_unit": "iso", "columns": {"time": "a"}}
    with pytest.raises(DatasetError, match="no dates in column 'a'"):
        import_recordings(tmp_path / "src", tmp_path / "DS3", pattern=ImportPattern(**dates))
