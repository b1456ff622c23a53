"""``plushsense trim`` and ``plushsense info --durations`` as a user types them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import PersonInfo, write_people
from plushsense.dataset.trimming import decide_trims
from plushsense.windows.cut import WindowSpec, cut_windows

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]
ACCEL = load_layout("accel-3")


@pytest.fixture
def waves(tmp_path: Path) -> Path:
    """Three people who wait half a second before they wave, at one of two speeds."""
    rng = np.random.default_rng(4)
    for person in range(3):
        folder = tmp_path / "raw" / f"P{person + 1}"
        folder.mkdir(parents=True)
        for number, (label, hz) in enumerate((("Fast", 5.0), ("Fast", 5.0), ("Slow", 2.0), ("Slow", 2.0))):
            t = np.arange(400) / 100 - 0.5
            x = np.where(t >= 0, 6000 * np.sin(2 * np.pi * hz * t), 0.0)
            values = np.rint(x[:, None] * [1.0, 0.6, 0.3] + rng.normal(0, 50, (400, 3))).astype(np.int64)
            clock = np.arange(400, dtype=np.int64) * 10 + 10_000 * (4 * person + number)
            frames = Frames(values, clock, clock + 1_700_000_000_000)
            name = recording_filename(label, int(clock[-1]) + 1_700_000_000_000, 400)
            write_recording(folder / name, frames, ACCEL)
    import_recordings(tmp_path / "raw", tmp_path / "DS", layout="accel-3")
    return tmp_path / "DS"


def test_suggest_accept_adjust_undo(cli: Cli, waves: Path) -> None:
    shown = cli("trim", waves, "--json").json
    assert shown["states"] == {"suggested": 12}
    first = shown["recordings"][0]
    assert first["start_s"] == pytest.approx(0.5, abs=0.06)
    assert first["stop_s"] == 4.0
    assert not (waves / MARKS).exists(), "showing marks nothing"
    windows = len(cut_windows(open_dataset(waves), WindowSpec()))
    hashed = open_dataset(waves).hash

    one = first["recording"]
    ran = cli("trim", waves, "--set", one, "0.7:", "--who", "K")
    assert "adjusted 1" in ran.err
    assert [line.split()[0] for line in ran.out.splitlines() if line.startswith("P")] == [one]
    done = cli("trim", waves, "--accept-above", "0.5", "--json").json
    assert (len(done["accepted"]), done["kept_by_hand"]) == (11, [one])
    assert done["states"] == {"accepted": 11, "adjusted": 1}
    again = cli("trim", waves, "--accept-above", "0.5", "--json").json
    assert (again["accepted"], again["already"]) == ([], 11)
    assert len((waves / MARKS).read_text().splitlines()) == 12

    dataset = open_dataset(waves)
    assert dataset.hash != hashed
    assert len(cut_windows(dataset, WindowSpec())) < windows
    scored = cli("evaluate", waves, "--filters", "4,4,4", "--epochs", "2", "--workers", "1", "--json").json
    assert scored["split"] == "leave-one-subject-out"

    undone = cli("trim", waves, "--undo", "*", "--json").json
    assert (len(undone["undone"]), undone["states"]) == (12, {"suggested": 12})
    assert open_dataset(waves).hash == hashed


def test_only_and_accept_by_pattern(cli: Cli, waves: Path) -> None:
    done = cli("trim", waves, "--only", "P1/*", "--accept", "P2/Fast*", "--json").json
    assert len(done["accepted"]) == 2
    assert {r["recording"][:3] for r in done["recordings"]} == {"P1/"}
    assert cli("trim", waves, "--json").json["states"] == {"accepted": 2, "suggested": 10}
    text = cli("trim", waves, "--only", "P2/*")
    assert "4 recordings: 2 accepted, 2 suggested" in text.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--accept-above", "1.5"), "confidence from 0 to 1"),
        (("--accept", "P9/*"), "no recording 'P9/*'"),
        (("--set", "P1/*", "0.1:1"), "names 4"),
        (("--set", "P1/Fast*3989", "soon"), "FROM:TO"),
        (("--set", "P1/nothing", "0:1"), "no recording 'P1/nothing'"),
        (("--only", "P9/*"), "no recording 'P9/*'"),
    ],
)
def test_refusals_are_sentences_and_mark_nothing(cli: Cli, waves: Path, words: tuple[str, ...], said: str) -> None:
    ran = cli("trim", waves, *words)
    assert ran.status == 2
    assert said in ran.err
    assert ran.err.count("\n") == 1
    assert not (waves / MARKS).exists()


def test_one_bad_request_stops_all(cli: Cli, waves: Path) -> None:
    one = open_dataset(waves).recordings[0].id
    assert cli("trim", waves, "--accept", "*", "--set", one, "9:10").status == 2
    assert not (waves / MARKS).exists()


def test_a_place_that_cannot_be_drawn_to_is_refused_before_the_first_mark(cli: Cli, waves: Path) -> None:
    ran = cli("trim", waves, "--accept", "*", "--plot", waves / "dataset.toml")
    assert (ran.status, ran.err.count("\n")) == (2, 1)
    assert "is a file" in ran.err
    assert not (waves / MARKS).exists()


def test_from_python(waves: Path) -> None:
    done = decide_trims(waves, only="P1/*", above=0.5, who="K")
    assert (len(done.changed), done.states) == (4, {"accepted": 4})
    assert decide_trims(waves, undo=["P1/*"], who="K").states == {"suggested": 12}
    assert {json.loads(line)["who"] for line in (waves / MARKS).read_text().splitlines()} == {"K"}


def test_plot(cli: Cli, waves: Path, tmp_path: Path) -> None:
    done = cli("trim", waves, "--only", "P1/*", "--plot", tmp_path / "p.png", "--json").json
    assert done["plots"] == [str(tmp_path / "p.png")]
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_stats(cli: Cli, waves: Path) -> None:
    found = cli("info", waves, "--durations", "--json").json
    assert [d["gesture"] for d in found["durations"]] == ["Fast", "Slow"]
    assert found["durations"][0]["before_s"]["mean"] == pytest.approx(4.0, rel=1e-3)
    assert "After trimming" not in cli("info", waves, "--durations").out
    cli("trim", waves, "--accept", "*")
    after = cli("info", waves, "--durations", "--json").json["durations"][0]
    assert after["after_s"]["mean"] == pytest.approx(3.5, abs=0.06)
    assert "After trimming" in cli("info", waves, "--durations").out
    assert cli("info", waves, "--by", "gender").status == 2
    write_people(waves, [PersonInfo("P1", "child", "f"), PersonInfo("P2", "adult", "f")])
    by = cli("info", waves, "--by", "age_group", "--json").json["durations"]
    assert [(d["gesture"], d["group"]) for d in by][:3] == [("Fast", "adult"), ("Fast", "child"), ("Fast", "not said")]
