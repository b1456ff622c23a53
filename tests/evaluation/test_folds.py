"""Folds as windows: the same recordings under two contexts, and no context that touches what is tested."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.evaluation.crossval import fold_windows
from plushsense.scoring.splits import parse_split
from plushsense.windows.cut import WindowSet
from support.fakes import study


def touched(windows: WindowSet, index: np.ndarray, tested: WindowSet, test: np.ndarray) -> int:
    """How many of the windows at ``index`` share a stream row with a tested recording, row by row."""
    rows = {(tested.stream[i], r) for i in test if tested.stream[i] for r in range(*tested.recording_rows[i])}
    return sum(any((windows.stream[i], r) in rows for r in range(*windows.window_rows[i])) for i in index)


def recordings(windows: WindowSet, index: np.ndarray) -> set[str]:
    return {windows.recording_ids[r] for r in windows.recording[index]}


@pytest.mark.parametrize("text", ["leave-one-subject-out", "by-subject:3", "by-recording:4"])
@pytest.mark.parametrize("trained_on", ["stream", "loop"])
@pytest.mark.parametrize("scored_on", ["stream", "loop"])
def test_two_contexts_are_divided_by_the_same_recordings(text: str, trained_on: str, scored_on: str) -> None:
    # One window more a recording: the two sets do not line up by position.
    train, score = study(context=trained_on, windows=3), study(context=scored_on, windows=2)
    tested: list[int] = []
    for fold in fold_windows(train, score, parse_split(text), seed=1):
        sides = [recordings(train, fold.train), recordings(train, fold.validation), recordings(score, fold.test)]
        assert not (sides[0] & sides[2] or sides[1] & sides[2] or sides[0] & sides[1])
        for index in (fold.train, fold.validation):
            assert len(index) and touched(train, index, score, fold.test) == 0
        tested += fold.test.tolist()
    assert sorted(tested) == list(range(len(score)))


def test_contexts_that_reach_into_a_tested_recording_are_purged_and_no_others() -> None:
    windows = study(windows=2, nobody=0)
    for fold in fold_windows(windows, windows, parse_split("by-recording:4"), seed=1):
        kept = np.concatenate([fold.train, fold.validation])
        others = np.setdiff1d(np.arange(len(windows)), np.concatenate([kept, fold.test]))
        assert touched(windows, others, windows, fold.test) == len(others) > 0


def test_a_tested_recording_is_protected_even_where_it_was_scored_looped() -> None:
    stream, loop = study(), study(context="loop")
    for fold in fold_windows(stream, loop, parse_split("by-recording:4")):
        where = [i for i in range(len(stream)) if stream.recording[i] in set(loop.recording[fold.test])]
        assert touched(stream, fold.train, stream, np.array(where)) == 0


def test_what_is_not_scored_is_trained_on_in_every_fold_unless_people_are_left_out() -> None:
    # Such as the idle parts of a stream, which count as one recording: without them, nothing would be idle.
    train = study(nobody=0, context="loop")
    score = train.take(np.flatnonzero(train.recording % 4))
    unscored = set(np.flatnonzero(train.recording % 4 == 0).tolist())
    for fold in fold_windows(train, score, parse_split("by-recording:4")):
        assert unscored <= set(fold.train.tolist())
    apart = [set(fold.train.tolist()) for fold in fold_windows(train, score, parse_split("leave-one-subject-out"))]
    assert not any(unscored <= each for each in apart)


def test_whole_people_lose_no_window() -> None:
    windows = study(nobody=0)
    for fold in fold_windows(windows, windows, parse_split("leave-one-subject-out")):
        assert len(fold.train) + len(fold.validation) + len(fold.test) == len(windows)


def test_windows_can_be_divided_only_among_themselves() -> None:
    stream, loop = study(), study(context="loop")
    assert len(fold_windows(stream, replace(stream, integers=stream.integers.copy()), parse_split("windows:3"))) == 3
    other = study(context="loop", windows=3)
    with pytest.raises(ConfigError, match="by-recording:5"):
        fold_windows(other, loop, parse_split("windows:3"))
    with pytest.raises(BadInput, match="differ in gestures or channels"):
        fold_windows(replace(loop, labels=("a", "b", "c")), loop, parse_split("by-subject:3"))


def test_a_fold_that_would_be_empty_is_refused() -> None:
    windows = study(people=1, repetitions=2, nobody=0)
    greedy = replace(windows, window_rows=np.tile([0, 10_000], (len(windows), 1)))
    with pytest.raises(BadInput, match="touches a tested recording"):
        fold_windows(greedy, greedy, parse_split("by-recording:4"))
