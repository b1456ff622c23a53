"""What markers mean, and which rows of a stream they delimit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.dataset.importing.markers import MarkerCuts, cut_by_markers, read_marker

PLUSH = load_gestures("plush-18")


def cut(
    texts: Sequence[Any],
    gestures: GestureSet | None = PLUSH,
    times_s: Sequence[float] | None = None,
    rows_s: Sequence[float] | None = None,
) -> MarkerCuts:
    """Cut 50 rows (0.01 s apart) by one marker each 0.1 s, or at the given times."""
    samples = [text if isinstance(text, list | np.ndarray) else [text] for text in texts]
    times_s = [0.1 * (i + 1) for i in range(len(texts))] if times_s is None else times_s
    read = (read_marker(t, sample, gestures) for t, sample in zip(times_s, samples, strict=True))
    rows = np.arange(50) / 100.0 if rows_s is None else np.array(rows_s, dtype=float)
    return cut_by_markers([m for m in read if m is not None], rows + 1e-9)


def places(cuts: MarkerCuts) -> list[tuple[str, int, int]]:
    return [(c.label, c.start, c.stop) for c in cuts.segments]


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["Tail pull", "x"], [("Tail pull", 10, 20)]),
        (["tail_pull", "Tail  pull"], [("Tail pull", 10, 20), ("Tail pull", 20, 50)]),
        (["start Tail pull", "end Tail pull"], [("Tail pull", 10, 20)]),
        (["Tail pull/begin", "Tail pull/stop"], [("Tail pull", 10, 20)]),
        (["begin:Tail pull"], [("Tail pull", 10, 50)]),
        (["Tail pull onset", "Tail pull offset"], [("Tail pull", 10, 20)]),
        (["END", "stop"], []),
        (["sneeze"], []),
        ([["start", "Tail pull"], ["end", "Tail pull"]], [("Tail pull", 10, 20)]),
        ([["Tail pull", "on", "7"], ["Tail pull", "off", "7"]], [("Tail pull", 10, 20)]),
        ([["trial 3", "Tail pull"], ["", ""], ["stop", ""]], [("Tail pull", 10, 30)]),
        (
            ['{"event": "onset", "what": {"gesture": "Tail pull"}, "trial": 3}', '{"event": "offset"}'],
            [("Tail pull", 10, 20)],
        ),
        (["Tail pull\0\0\x07", "stop\0"], [("Tail pull", 10, 20)]),
        ([["Tail pull", "Hold strong"]], []),
        (
            ['{"event": "trial_start", "cue": "Tail pull"}', '{"event": "trial_end", "cue": "Tail pull"}'],
            [("Tail pull", 10, 20)],
        ),
    ],
)
def test_what_markers_mean(texts: Sequence[Any], expected: list[tuple[str, int, int]]) -> None:
    assert places(cut(texts)) == expected


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["Shake", "end", "Wave"], [("Shake", 10, 20), ("Wave", 30, 50)]),
        ([["start", "Shake"], ["end", "Shake"]], [("Shake", 10, 20)]),
        ([["Shake", "12"], ["end", "13"]], [("Shake", 10, 20)]),
        ([["Shake", "left hand"]], []),  # which of the two is the gesture?
        (['{"state": 2, "cue": "Shake"}', '{"cue": "stop"}'], [("Shake", 10, 20)]),
        ([np.array([4]), np.array([0]), np.array([2.5])], [("4", 10, 20), ("2.5", 30, 50)]),
        (['{"event": "trial_start", "cue": "Shake"}', '{"event": "trial_end", "cue": "Shake"}'], [("Shake", 10, 20)]),
        (["experiment_start", "Shake_start", "Shake_end", "experiment_end"], [("Shake", 20, 30)]),
        (["{not JSON", "[]", "...", "\0"], [("{not JSON", 10, 30)]),
    ],
)
def test_without_a_gesture_set_any_single_text_is_a_gesture(
    texts: Sequence[Any], expected: list[tuple[str, int, int]]
) -> None:
    assert places(cut(texts, None)) == expected


def test_markers_of_other_things_do_not_end_a_gesture_where_its_end_is_marked() -> None:
    cuts = cut(["Tail pull", "key A", "stop", "key B"])
    assert (places(cuts), cuts.unknown, cuts.shortened) == ([("Tail pull", 10, 30)], ["key A", "key B"], [])
    # "rest" is the end of a gesture here, though one "stop" ends all.
    cuts = cut(["Tail pull", "rest", "Hold strong", "rest"], times_s=[0.1, 0.2, 0.3, 0.4])
    assert places(cuts) == [("Tail pull", 10, 20), ("Hold strong", 30, 40)]
    assert cuts.shortened == ["Tail pull", "Hold strong"]
    assert places(
        cut(["Tail pull", "rest", "Hold strong", "rest", "stop"], times_s=[0.1, 0.2, 0.3, 0.4, 0.45])
    ) == places(cuts)


def test_markers_outside_of_the_stream_are_counted() -> None:
    cuts = cut(
        ["Tail pull", "Hold strong", "end", "Tail pull", "end", "Tail pull"], times_s=[-9, -1, 0.2, 0.3, 0.9, 1.5]
    )
    assert places(cuts) == [("Hold strong", 0, 20), ("Tail pull", 30, 50)]
    assert cuts.empty == ["Tail pull", "Tail pull"]
    assert cut(["Tail pull", "0"]).zeros == ["0"]
    assert cuts.shortened == ["Hold strong", "Tail pull"]


def test_rows_and_markers_after_a_reset_of_the_clock_belong_together() -> None:
    rows = [100 + i / 100 for i in range(50)] + [3 + i / 100 for i in range(50)]
    both = cut(["Tail pull", "end"] * 2, times_s=[100.1, 100.2, 3.1, 3.3], rows_s=rows)
    assert (places(both), both.empty) == ([("Tail pull", 10, 20), ("Tail pull", 60, 80)], [])
    # The markers came from another computer, whose clock went on: those after the reset lie nowhere.
    alone = cut(["Tail pull", "end"] * 2, times_s=[100.1, 100.2, 103.1, 103.3], rows_s=rows)
    assert (places(alone), alone.empty) == ([("Tail pull", 10, 20)], ["Tail pull"])
    # The times were corrected: the recording ends with the reset.
    markers = [m for m in (read_marker(t, ["Tail pull"], PLUSH) for t in (0.1, 0.3)) if m is not None]
    cuts = cut_by_markers(markers, np.arange(50) / 100.0, [20])
    assert (places(cuts), cuts.shortened) == ([("Tail pull", 10, 20), ("Tail pull", 30, 50)], ["Tail pull"])
    cuts = cut_by_markers(markers, np.array([i / 100 + 9 * (i >= 20) for i in range(50)]), [20])
    assert places(cuts) == [("Tail pull", 10, 20), ("Tail pull", 20, 50)]
    assert cuts.shortened == ["Tail pull", "Tail pull"]
    # Times that lie in both parts are ambiguous.
    rows = [100 + i / 100 for i in range(500)] + [102 + i / 100 for i in range(50)]
    assert cut(["Tail pull", "end"], times_s=[102.1, 102.2], rows_s=rows).empty == ["Tail pull"]
