"""The leakage audit finds what a split shares between training and test, and copies under other names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.dataset.quality.outliers import far_inputs
from plushsense.evaluation.crossval import fold_windows
from plushsense.evaluation.leakage import KINDS, CopiedRecording, LeakageResult, audit_leakage, warn_of_copies
from plushsense.scoring.splits import Fold, parse_split
from plushsense.windows.cut import WindowSet
from plushsense.workflow.preparation import warn_of_far_readings
from support.fakes import study


def moving(people: int = 4, samples: int = 100) -> WindowSet:
    """Windows of smooth noise, no two alike."""
    windows = study(people=people, nobody=2)
    noise = np.random.default_rng(0).normal(size=(len(windows), 2, samples + 9))
    smooth = np.stack([noise[:, :, i : i + samples] for i in range(10)]).sum(axis=0)
    return replace(windows, integers=np.round(1000 * smooth).astype(np.int32))


def audited(windows: WindowSet, split: str) -> LeakageResult:
    return audit_leakage(windows, windows, fold_windows(windows, windows, parse_split(split)))


def test_each_split_shares_what_it_must() -> None:
    windows = moving()
    by_window, by_recording, by_subject = (audited(windows, s) for s in ("windows:4", "by-recording:4", "by-subject:4"))
    assert all(found.windows == len(windows) for found in (by_window, by_recording, by_subject))
    assert by_window.same_recording > 0 and by_window.overlapping > 0
    people = int((windows.subject != "none").sum())
    assert by_recording.same_recording == 0 and by_recording.same_person == people
    # The past of a recording at rest may reach into another one of its stream, which nobody made either.
    assert not any(getattr(by_subject, key) for key in KINDS if key != "overlapping")
    assert not any(found.near_duplicates for found in (by_window, by_recording))


def test_overlap_is_found_in_the_stream() -> None:
    windows = study(people=3, nobody=0)
    first = np.flatnonzero(windows.recording == 1)
    other = np.flatnonzero(windows.subject == "P02")
    none = np.empty(0, dtype=np.int64)
    # Rows 80 to 160 and 120 to 200 of one recording; the windows of another stream have the same numbers of rows.
    apart = Fold("f", ("P00",), other, none, first[:1])
    assert audit_leakage(windows, windows, [apart]).overlapping == 0
    together = Fold("f", ("P00",), np.append(other, first[1]), none, first[:1])
    assert audit_leakage(windows, windows, [together]).overlapping == 1


@pytest.mark.parametrize(
    ("change", "copies", "near"),
    [
        (lambda x: x, 1, 1),
        (lambda x: np.concatenate([x[:, 20:], x[:, :20] * 0], axis=1), 0, 1),
        (lambda x: x + np.random.default_rng(1).integers(-150, 151, x.shape), 0, 1),
        (lambda x: x * 3 // 2, 0, 0),
        (lambda x: x[:, ::-1], 0, 0),
    ],
    ids=["equal", "shifted by 0.2 s", "with a little noise", "stronger", "reversed"],
)
def test_a_copy_of_another_person_is_found(change: object, copies: int, near: int) -> None:
    windows = moving()
    mine, theirs = (int(np.flatnonzero(windows.subject == who)[0]) for who in ("P01", "P03"))
    x = windows.integers.copy()
    x[theirs] = change(x[mine])  # type: ignore[operator]
    planted = replace(windows, integers=x)
    fold = Fold("P01", ("P01",), np.flatnonzero(windows.subject != "P01"), np.empty(0, np.int64), np.array([mine]))
    found = audit_leakage(planted, planted, [fold])
    assert (found.copies, found.near_duplicates) == (copies, near)
    said: list[str] = []
    warn_of_copies(found, said.append)
    assert len(said) == near and all("P01/" in line and "P03/" in line for line in said)


def test_neighbours_in_a_stream_are_no_copies() -> None:
    windows = moving()
    mine, theirs = (np.flatnonzero(windows.subject == "P01")[at] for at in (0, -1))
    x, rows, stream = windows.integers.copy(), windows.window_rows.copy(), windows.stream.copy()
    x[theirs], stream[theirs] = x[mine], stream[mine]
    fold = Fold("f", ("P01",), np.array([theirs]), np.empty(0, np.int64), np.array([mine]))
    for first, near in ((rows[mine, 0] + 20, 0), (rows[mine, 1], 1)):
        rows[theirs] = (first, first + np.diff(rows[mine])[0])
        planted = replace(windows, integers=x, stream=stream, window_rows=rows)
        assert audit_leakage(planted, planted, [fold]).near_duplicates == near


def test_recordings_that_rarely_change_are_no_copies() -> None:
    windows = moving()
    pressed = (np.arange(windows.integers.shape[2]) > 60).astype(np.int32)
    for x in (np.zeros_like(windows.integers), windows.integers * 0 + pressed):
        assert audited(replace(windows, integers=x), "by-subject:4").near_duplicates == 0


def test_recordings_with_rows_of_one_trained_on_are_counted() -> None:
    windows = moving()
    mine, theirs = (np.flatnonzero(windows.subject == who) for who in ("P01", "P03"))
    one, other = (windows.recording_ids[windows.recording[at[0]]] for at in (mine, theirs))
    n = int((windows.recording == windows.recording[mine[0]]).sum())
    none = np.empty(0, dtype=np.int64)
    pairs = {(one, other), (other, one)}
    found = audit_leakage(windows, windows, [Fold("f", ("P01",), theirs, none, mine)], pairs)
    assert (found.shared_rows, found.near_duplicates) == (n, 0)
    assert found.pairs == (CopiedRecording(one, other, n),)
    assert LeakageResult.from_json(found.to_json()) == found
    said: list[str] = []
    warn_of_copies(found, said.append)
    assert said[0].startswith(f"{n} of {len(mine)} scored windows are of recordings that have rows of one trained on")
    apart = Fold("f", ("P01",), np.flatnonzero(windows.subject == "P02"), none, mine)
    assert not audit_leakage(windows, windows, [apart], pairs).shared_rows


def test_windows_that_only_share_a_failed_reading_are_no_copies() -> None:
    windows = moving()
    x = windows.integers.copy()
    at = np.flatnonzero(windows.subject != "none")[::3]
    x[at, 0, 40] = 2**31 - 1
    failed = replace(windows, integers=x)
    assert far_inputs(windows.integers) == {} and far_inputs(x)[0].sum() == len(at)
    assert audited(failed, "by-subject:4").near_duplicates == 0
    said: list[str] = []
    warn_of_far_readings(failed, said.append)
    assert len(said) == 1 and f"is set by {len(at)} samples" in said[0] and "P01" in said[0]
    warn_of_far_readings(windows, said.append)
    assert len(said) == 1
