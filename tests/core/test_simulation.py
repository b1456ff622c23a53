"""The mark of simulated recordings in the times of their rows."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.recorder_csv import Frames
from plushsense.core.simulation import is_marked, mark_times

RNG = np.random.default_rng(0)
VALUES = RNG.integers(-3000, 20_000, (400, 13))
CLOCK = np.arange(400, dtype=np.int64) * 10


@pytest.mark.parametrize("together", [1, 5], ids=["one by one", "in bursts"])
def test_marked_times_are_in_order_and_a_little_later(together: int) -> None:
    host = 10**12 + CLOCK // (10 * together) * 10 * together
    marked = mark_times(host, VALUES)
    assert np.all(np.diff(marked) >= 0)
    assert marked.min() >= 10**12 and (marked - host).max() <= 7 * together
    assert is_marked(Frames(VALUES, CLOCK, marked))
    assert is_marked(Frames(VALUES[100:160], CLOCK[100:160], marked[100:160])), "a part"
    assert np.array_equal(mark_times(marked, VALUES), marked)


def test_some_changed_rows_leave_the_mark_and_no_other_recording_has_it() -> None:
    marked = mark_times(10**12 + CLOCK, VALUES)
    changed = VALUES.copy()
    changed[::6] = 0
    assert is_marked(Frames(changed, CLOCK, marked))
    assert is_marked(Frames(np.where(VALUES < -2000, 0, VALUES), CLOCK, marked)), "the authors' recorder wrote it"
    assert not is_marked(Frames(VALUES, CLOCK, None)) and not is_marked(Frames(VALUES[:30], CLOCK[:30], marked[:30]))
    assert not any(is_marked(Frames(VALUES, CLOCK, marked + shift)) for shift in range(1, 7))
    # Values that stand still have one checksum, which times in steps of 7 ms fit by chance.
    still = np.full((400, 13), 5)
    assert not any(is_marked(Frames(still, CLOCK, 10**12 + shift + np.arange(400) * 7)) for shift in range(7))
