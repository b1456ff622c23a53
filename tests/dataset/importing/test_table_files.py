"""Blocks of rows in tables of text: what separates recordings, and what does not."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.pattern import ImportPattern
from plushsense.dataset.importing.results import ImportResult
from plushsense.windows.anywhere import cut_anywhere
from plushsense.windows.cut import WindowSpec, cut_windows

CHANNELS = [{"name": name, "unit": "", "kind": "sensor"} for name in ("a", "b")]
PATTERN: dict[str, Any] = {
    "paths": ("{subject}/{label}.csv",),
    "row_rate_hz": 100.0,
    "layout": {"rate_hz": 100.0, "channels": CHANNELS},
}
HEAD = "a,b"


def block(rows: int, first: int = 0) -> list[str]:
    return [f"{k * 7 % 17},{first + k * 5 % 23}" for k in range(rows)]


def joined(blocks: Sequence[list[str]], *between: str) -> list[str]:
    return [line for k, rows in enumerate(blocks) for line in ([*between] if k else []) + rows]


def imported(tmp_path: Path, lines: Sequence[str], ends: str = "\n", head: str = HEAD, **keys: Any) -> ImportResult:
    path = tmp_path / "src" / "P1" / "Pat.csv"
    path.parent.mkdir(parents=True)
    path.write_bytes(ends.join([head, *lines, ""]).encode())
    return import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**PATTERN | keys))


def rows_of(done: ImportResult) -> list[int]:
    return [r.rows for r in sorted(done.dataset.recordings, key=lambda r: r.epoch_ms)]


@pytest.mark.parametrize(
    "between",
    [("",), ("", ""), ("  ",), (",",), (",,,",), (HEAD,), ("# take",), ("// take", ""), ("-----",), ("", "x", HEAD)],
)
@pytest.mark.slow
def test_lines_between_blocks_of_rows_end_a_recording(tmp_path: Path, between: tuple[str, ...]) -> None:
    done = imported(tmp_path, ["", *joined([block(40), block(50), block(30)], *between), ",", ""])
    assert rows_of(done) == [40, 50, 30]
    assert sum("3 blocks of rows" in note for note in done.notes) == 1


def test_an_empty_line_after_every_row_is_a_doubled_line_end(tmp_path: Path) -> None:
    done = imported(tmp_path, block(60), ends="\r\r\n")
    assert (rows_of(done), done.notes) == ([60], ())
    done = imported(tmp_path / "2", joined([block(40), block(50)], ""), ends="\r\r\n")
    assert rows_of(done) == [40, 50]


def test_the_pattern_can_name_the_lines_between_recordings(tmp_path: Path) -> None:
    done = imported(tmp_path, joined([block(40), block(50)], ""), between="none")
    assert (rows_of(done), done.notes) == ([90], ())
    lines = joined([block(40), block(50)], "START 2")
    done = imported(tmp_path / "2", lines, between="START.*")
    assert rows_of(done) == [40, 50]
    done = imported(tmp_path / "3", lines)
    assert rows_of(done) == [90]
    assert "line 42: 'START 2'; if such lines separate recordings, describe them with  between" in done.notes[0]
    # A spreadsheet fills a line of text with empty cells.
    done = imported(tmp_path / "4", joined([block(40), block(50)], "Take two,"))
    assert "line 42: 'Take two,'; if such lines separate recordings" in done.notes[0]
    with pytest.raises(ConfigError, match=r"between is '\(', an expression that is not valid"):
        ImportPattern(between="(")


def test_blocks_also_end_recordings_of_a_labelled_table_with_a_clock(tmp_path: Path) -> None:
    rows = [f"ana,{'Pat' if k < 80 else 'Hit'},{10 * k},1,2,{k}" for k in range(120)]
    path = tmp_path / "all.csv"
    path.write_text("\n".join(["subject,label,time_ms,x,y,z", *rows[:30], "", *rows[30:], ""]))
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert rows_of(done) == [30, 50, 40]
    assert "all.csv: 2 blocks of rows" in done.notes[0] and "pattern" not in done.notes[0]


def test_missing_values_may_fill_a_row(tmp_path: Path) -> None:
    done = imported(tmp_path, joined([block(40), block(50)], ","), missing=("",))
    assert rows_of(done) == [91]


def test_a_guess_says_that_files_hold_blocks(tmp_path: Path) -> None:
    for n, label in enumerate(("Pat", "Hit", "Rub", "Hold")):
        for person in ("P1", "P2"):
            (tmp_path / "src" / person).mkdir(parents=True, exist_ok=True)
            lines = joined([block(30 + n), block(31), block(32)], HEAD, "")
            (tmp_path / "src" / person / f"{label}.csv").write_text("\n".join([HEAD, *lines, ""]))
    guessed = guess_pattern(tmp_path / "src")
    assert "(up to 3 in the first lines of a file)" in guessed.doubts[0]
    found = tomllib.loads(guessed.toml)
    assert "missing" not in found, "names of columns are no missing values"
    assert import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**found)).recordings == 24


@pytest.mark.parametrize("clock", [[f"{1.5e12:.5E}"] * 120, [f"{np.float32(1.7e9 + k / 100):.1f}" for k in range(120)]])
@pytest.mark.slow
def test_no_unit_is_guessed_from_a_clock_that_stands_still(tmp_path: Path, clock: list[str]) -> None:
    (tmp_path / "src").mkdir()
    rows = [f"P{p},{t},{'Pat' if k < 60 else 'Hit'},{k * (6 + p) % 17}.5" for p in (1, 2) for k, t in enumerate(clock)]
    (tmp_path / "src" / "t.csv").write_text("\n".join(["subject,timestamp,label,force", *rows]))
    layout = {"rate_hz": 100.0, "channels": [{"name": "force", "unit": "", "kind": "sensor", "step": 0.5}]}
    given = ImportPattern(paths=("*.csv",), layout=layout)
    said = ["column 'timestamp' is read as milliseconds", "the clock stands still: all 60 rows have one time"]
    assert_said(preview_import(tmp_path / "src", pattern=given).messages, said)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=given)
    assert_said(done.messages, said)
    with pytest.raises(DatasetError, match="the clock stands still in 4 recordings"):
        cut_windows(done.dataset)
    with pytest.raises(DatasetError, match="the clock stands still in 4 recordings"):
        cut_anywhere(done.dataset, WindowSpec(context="anywhere"), done.dataset.gestures)
    guessed = guess_pattern(tmp_path / "src")
    assert "the clock in 'timestamp' stands still" in guessed.doubts[0]
    assert tomllib.loads(guessed.toml)["row_rate_hz"] == 50.0
    again = import_recordings(tmp_path / "src", tmp_path / "D2", pattern=ImportPattern(**tomllib.loads(guessed.toml)))
    assert (cut_windows(again.dataset).x.std(axis=2) > 0).all()


def assert_said(warnings: Sequence[str], said: Sequence[str]) -> None:
    assert len(warnings) == len(said) and all(part in text for part, text in zip(said, warnings, strict=True)), warnings


def test_a_recording_whose_clock_stands_still_is_left_out(tmp_path: Path) -> None:
    rows = [
        f"ana,{label},{2000 * n + (10 * k if n < 2 else 0)},1,2,{k % 9}"
        for n, label in enumerate(("Pat", "Hit", "Pat"))
        for k in range(100)
    ]
    (tmp_path / "all.csv").write_text("\n".join(["subject,label,time_ms,x,y,z", *rows]))
    done = import_recordings(tmp_path / "all.csv", tmp_path / "DS", layout="accel-3")
    windows = cut_windows(done.dataset)
    assert [str(text) for text in windows.left_out] == [f"{done.dataset.recordings[2].id}: its clock stands still"]
    assert len(windows) == 2


def test_times_in_another_unit_than_their_name_says(tmp_path: Path) -> None:
    rows = [f"ana,Pat,{k / 100},1,2,{k}" for k in range(100)]
    (tmp_path / "all.csv").write_text("\n".join(["subject,label,time_ms,x,y,z", *rows]))
    done = import_recordings(tmp_path / "all.csv", tmp_path / "DS", layout="accel-3")
    assert "all.csv: by column 'time_ms', rows are 0.01 ms apart" in done.notes[0]


@pytest.mark.parametrize(
    ("clock", "unit"),
    [
        (lambda k: f"12:00:{k // 100:02}.{k % 100:02}", "iso"),
        (lambda k: f"59:{k // 100:02},{k % 100:02}", "iso"),
        (lambda k: f"{46082.5 + k / 8_640_000:.10f}", "d"),
        (lambda k: f"2026-03-01 12:00:{k // 100:02}.{k % 100:02}0", "iso"),
    ],
)
@pytest.mark.slow
def test_clocks_of_spreadsheets(tmp_path: Path, clock: Callable[[int], str], unit: str) -> None:
    guessed, _ = guess_table(tmp_path, clock)
    assert guessed["time_unit"] == unit and guessed["layout"]["rate_hz"] == pytest.approx(100.0, rel=0.01)
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**guessed))
    (recording,) = (r for r in done.dataset.recordings if r.gesture == "Pat")
    assert np.diff(done.dataset.read(recording).device_ms).tolist() == [10] * 149


def test_times_that_are_only_whole_seconds_or_not_read(tmp_path: Path) -> None:
    guessed, doubts = guess_table(tmp_path, lambda k: f"2026-03-01 12:00:{k // 100:02}")
    assert guessed["row_rate_hz"] == 50.0 and "the clock in 'time' stands still (100 rows" in doubts[0]
    guessed, doubts = guess_table(tmp_path / "2", lambda k: f"01/03/2026 12:00:{k // 100:02}.{k % 100:02}")
    assert guessed["row_rate_hz"] == 50.0 and "the times in 'time', such as '01/03/2026" in doubts[0]


def guess_table(folder: Path, clock: Callable[[int], str]) -> tuple[dict[str, Any], list[str]]:
    (folder / "src").mkdir(parents=True)
    rows = [f"ana;{clock(k)};{'Pat' if k < 150 else 'Hit'};{k * 7 % 17}.5" for k in range(300)]
    (folder / "src" / "all.csv").write_text("\n".join(["subject;time;label;force", *rows]))
    guessed = guess_pattern(folder / "src")
    return tomllib.loads(guessed.toml), guessed.doubts


def test_a_guess_asks_about_lines_of_text_between_rows(tmp_path: Path) -> None:
    for label in ("Pat", "Hit", "Rub", "Hold"):
        for person in ("P1", "P2"):
            (tmp_path / "src" / person).mkdir(parents=True, exist_ok=True)
            lines = joined([block(30), block(31), block(32)], "START,")
            (tmp_path / "src" / person / f"{label}.csv").write_text("\n".join([HEAD, *lines, ""]))
    guessed = guess_pattern(tmp_path / "src")
    assert "such as  between = 'START.*'" in guessed.doubts[0]
    found = tomllib.loads(guessed.toml)
    assert "missing" not in found
    done = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=ImportPattern(**found, between="START.*"))
    assert done.recordings == 24


def test_a_guess_asks_about_labels_that_may_mean_idle_time(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    rows = [f"ana,{10 * k},{('null', 'Pat')[k // 30 % 2]},{k * 7 % 17}.5" for k in range(300)]
    (tmp_path / "src" / "all.csv").write_text("\n".join(["subject,time_ms,label,force", *rows]))
    assert any('idle = ["null"]' in doubt for doubt in guess_pattern(tmp_path / "src").doubts)
