"""Files that label intervals of time cut the recordings of the samples beside them."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.pattern import ImportPattern
from plushsense.dataset.importing.results import ImportResult

LAYOUT = {"rate_hz": 50.0, "channels": [{"name": "left", "unit": "", "kind": "sensor", "step": 0.01}]}


def samples(path: Path, first_ms: int = 0, name: str = "time_ms", unit: float = 1.0, rows: int = 500) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{name},left", *(f"{(first_ms + 20 * k) * unit:g},{k * k % 97 / 8}" for k in range(rows))]
    path.write_text("\n".join(lines) + "\n")


def cuts(done: ImportResult) -> list[tuple[str, int, int]]:
    return sorted((r.gesture, r.stream_row, r.rows) for r in done.dataset.recordings)


@pytest.mark.parametrize(
    ("header", "rows", "first_ms"),
    [
        ("start_ms,end_ms,label", ["1000,3000,hug", "3000,4000,hug", "5000,6000,tap"], 0),
        ("id;begin;stop;gesture;who", ["1;1.0;3.0;hug;me", "2;3;4;hug;me", "3;5;6;tap;"], 0),
        ("onset\tduration\ttrial_type", ["1.0\t2.0\thug", "3\t1\thug", "5\t1\ttap"], 7000),
        ("start,end,label", ["71.0,73.0,hug", "73,74,hug", "75,76,tap"], 70000),
        ("start,end,label", ["1,3,hug", "3,4,hug", "5,6,tap"], 70000),
    ],
)
@pytest.mark.slow
def test_intervals_beside_samples_are_found_and_cut_recordings(
    tmp_path: Path, header: str, rows: list[str], first_ms: int
) -> None:
    in_ms = header.startswith("start_ms")
    for person in ("P1", "P2"):
        name, unit = ("time_ms", 1.0) if in_ms else ("t", 0.001)
        samples(tmp_path / "src" / person / "touch.csv", first_ms, name, unit)
        (tmp_path / "src" / person / "labels.csv").write_text("\n".join([header, *rows]))
    guess = guess_pattern(tmp_path / "src")
    found = tomllib.loads(guess.toml)
    assert (found["paths"], found["intervals"]) == (["{subject}/*.csv"], "{subject}/labels.csv")
    assert any("the labels are the intervals in files such as P1/labels.csv" in doubt for doubt in guess.doubts)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**found))
    assert cuts(done) == sorted([("hug", 50, 100), ("hug", 150, 50), ("tap", 250, 50)] * 2)
    assert (done.streams, done.rejected) == (2, ())
    assert [entry.file for entry in done.left_out] == ["P1/labels.csv", "P2/labels.csv"]
    of_first_row = any("counted from the first row" in note for note in done.notes)
    assert of_first_row == (first_ms > 0 and not rows[0].startswith("71"))


def test_intervals_that_belong_to_names_of_files(tmp_path: Path) -> None:
    for person, day in (("ann", 1), ("ann", 2), ("bob", 1)):
        samples(tmp_path / "src" / f"{person}_{day}.csv")
        (tmp_path / "src" / f"{person}_{day}_events.csv").write_text("start_ms,end_ms,label\n0,1000,hug\n")
    found = tomllib.loads(guess_pattern(tmp_path / "src").toml)
    assert found["intervals"] == "{subject}_{session}_events.csv"
    seen = preview_import(tmp_path / "src", pattern=ImportPattern(**found))
    assert (seen.recordings, seen.subjects) == (3, ["ann", "bob"])


def test_what_intervals_leave_out_is_counted_and_what_is_missing_is_named(tmp_path: Path) -> None:
    samples(tmp_path / "src" / "P1.csv")
    labels = tmp_path / "src" / "P1_labels.csv"
    labels.write_text("start_ms,end_ms,label\n0,1000,hug\n500,1500,tap\n90000,91000,hug\n3,2,hug\n")
    keys = {"layout": LAYOUT, "paths": ("{subject}.csv",), "intervals": "{subject}_labels.csv"}
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**keys))
    assert cuts(done) == [("hug", 0, 25), ("tap", 25, 50)]
    assert "P1.csv: 1 of 3 intervals in 'P1_labels.csv' have no row of their own" in done.notes
    assert "P1.csv: 1 intervals in 'P1_labels.csv' overlap the one before, which ends where they begin" in done.notes
    for text, said in (
        ("start_ms,end_ms,label\n5,4,hug\n", "no interval whose end is after its start"),
        ("from_ms,word\n5,hug\n", "needs columns start, end .or duration. and label.*it has from_ms, word"),
    ):
        labels.write_text(text)
        with pytest.raises(DatasetError, match=said):
            import_recordings(tmp_path / "src", tmp_path / "DS2", pattern=ImportPattern(**keys))
    labels.unlink()
    with pytest.raises(DatasetError, match="has its labels in another file, and no such file belongs to it"):
        import_recordings(tmp_path / "src", tmp_path / "DS2", pattern=ImportPattern(**keys))


def test_labels_of_single_moments_are_listed(tmp_path: Path) -> None:
    for person in ("P1", "P2"):
        samples(tmp_path / "src" / person / "Accelerometer.csv", name="time")
        (tmp_path / "src" / person / "Annotation.csv").write_text("time,seconds_elapsed,text\n40,0.04,hug\n")
    guess = guess_pattern(tmp_path / "src")
    assert any("Annotation.csv have labels of single moments" in doubt for doubt in guess.doubts)
    assert "intervals" not in tomllib.loads(guess.toml)
