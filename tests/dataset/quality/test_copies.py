"""Stretches of one recording inside another are found, and equal stretches without information are not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.quality.checking import check
from plushsense.dataset.quality.copies import CopiedStretch, HashedRows, copied_recordings, find_copied_stretches

RNG = np.random.default_rng(3)


def recording(name: str, values: np.ndarray, stream: str = "", stream_row: int = -1) -> HashedRows:
    info: Any = SimpleNamespace(id=name, start=0, stream=stream, stream_row=stream_row)
    return HashedRows.of(info, values.reshape(len(values), -1).astype(np.int64))


def moving(rows: int = 200, channels: int = 3) -> np.ndarray:
    return np.cumsum(RNG.normal(0, 40, (rows, channels)), axis=0).round().astype(np.int64)


def found(*recordings: HashedRows) -> list[tuple[str, str, int, int, int]]:
    def plain(s: CopiedStretch) -> tuple[str, str, int, int, int]:
        return s.first.id, s.second.id, s.first_row, s.second_row, s.rows

    return [plain(s) for s in find_copied_stretches(recordings, 100.0)]


def test_shuffled_copies_in_a_third_file_are_found() -> None:
    gestures = [moving() for _ in range(6)]
    one, other = (np.concatenate([gestures[i] for i in order]) for order in ((0, 1, 2), (4, 2, 5)))
    assert found(recording("b", other), recording("a", one)) == [("a", "b", 400, 200, 200)]
    third = recording("c", np.concatenate([moving(77), gestures[4]]))
    shared = found(recording("a", one), recording("b", other), third)
    assert shared == [("a", "b", 400, 200, 200), ("b", "c", 0, 77, 200)]
    assert not found(recording("a", one), recording("b", moving())), "nothing in common"
    assert not found(recording("a", one), recording("b", one[100:149])), "less than half a second"


def test_rows_of_one_stream_are_no_copies() -> None:
    stream = moving(600)
    first, second = recording("a", stream[:300], "s", 100), recording("b", stream[200:500], "s", 300)
    assert not found(first, second)
    elsewhere = recording("b", stream[200:500], "t", 300)
    assert found(first, elsewhere) == [("a", "b", 200, 0, 100)]
    assert not found(recording("a", np.concatenate([stream[:100], moving(80), stream[:100]])), recording("b", moving()))


@pytest.mark.parametrize(
    "alike",
    [
        lambda i: np.full(300, 7),
        lambda i: np.repeat([0, 1, 0], [100 + i, 90, 110 - i]),
        lambda i: np.interp(np.arange(300), [50 + i, 150 + i], [0, 100]).round(),
        lambda i: np.repeat(np.random.default_rng(i).integers(0, 2, 20), 15),
        lambda i: np.random.default_rng(i).normal(0, 0.3, 300).round(),
    ],
    ids=["constant", "switch", "ramp", "few levels", "rest in steps"],
)
def test_what_is_alike_by_chance_is_no_copy(alike: Callable[[int], np.ndarray]) -> None:
    assert not found(*(recording(f"r{i}", alike(i)) for i in range(20)))
    # Beside recordings that move.
    assert not found(*(recording(f"r{i}", alike(i) if i % 2 else moving(300, 1)) for i in range(20)))


def test_check_names_the_rows_and_the_audit_the_pairs(tmp_path: Path) -> None:
    layout = load_layout("accel-3")
    taken = {name: moving(150) for name in ("P1/Shake", "P1/Wave", "P2/Shake", "P2/Wave")}
    taken["P2/Wave"] = np.concatenate([taken["P2/Wave"][:40], taken["P1/Shake"][20:]])
    for at, (name, values) in enumerate(taken.items()):
        clock = 13 * np.arange(len(values)) + 31 * at
        path = tmp_path / "R" / f"{name}_170000000{at}000_{len(values)}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_recording(path, Frames(values, clock, clock + 17 * 10**11), layout)
    dataset = import_recordings(tmp_path / "R", tmp_path / "DS", layout=layout).dataset
    (finding,) = check(dataset, only=["duplicate"]).findings
    shake, wave = "P1/Shake_1700000000000_150", "P2/Wave_1700000003000_170"
    assert (finding.recording, finding.severity, finding.rows) == (wave, "error", ((40, 170),))
    assert finding.message == f"130 of its 170 rows (from row 41) are also in {shake} (from row 21)"
    assert copied_recordings(dataset, [r.id for r in dataset.used]) == {(shake, wave), (wave, shake)}
    assert not copied_recordings(dataset, [wave])
