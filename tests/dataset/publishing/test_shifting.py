import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from plushsense.core.recorder_csv import Frames
from plushsense.dataset.publishing.contents import LATEST_MS, YEAR_2000_MS, shift_of

NOW = 1_700_000_000_000


@given(st.lists(st.integers(NOW, NOW + 10**9), min_size=1, max_size=5), st.binary(min_size=16, max_size=16))
def test_distances_stay_and_the_first_falls_into_the_year_2000(times: list[int], key: bytes) -> None:
    shifted = shift_of("P1", times, False, key).times(np.array(times))
    assert np.array_equal(np.diff(shifted), np.diff(times))
    assert YEAR_2000_MS <= shifted.min() < YEAR_2000_MS + 366 * 86_400_000
    assert shifted.max() < LATEST_MS


def test_the_instant_does_not_depend_on_the_true_day() -> None:
    """So that it tells nothing of it: the same key sends two days a century apart to the same instant."""
    early, late = (shift_of("P1", [t], False, b"k" * 16).time(t) for t in (NOW, NOW + 3_000_000_000_000))
    assert early == late
    assert shift_of("P2", [NOW], False, b"k" * 16).time(NOW) != early
    assert shift_of("P1", [NOW], False, b"l" * 16).time(NOW) != early


def test_a_damaged_time_does_not_tell_the_shift() -> None:
    shift = shift_of("P1", [NOW, NOW + 5000, 0], False, b"k" * 16)
    shifted = shift.times(np.array([0, NOW, 17, NOW + 10, 9 * 10**15]))
    first = shift.target_ms
    assert shifted.tolist() == [first, first, first, first + 10, first + 10]
    assert shift.time(1234567) is None
    assert shift.times(np.array([1, 2, 3])).tolist() == [first] * 3


def test_a_toy_s_clock_is_kept_unless_it_is_a_wall_clock() -> None:
    frames = Frames(np.zeros((2, 1), dtype=np.int64), np.array([5, 15]), np.array([NOW, NOW + 10]))
    kept = shift_of("P1", [NOW], False, b"k" * 16).frames(frames, keep_host=True)
    assert kept.device_ms.tolist() == [5, 15]
    assert kept.host_ms is not None
    assert np.diff(kept.host_ms).tolist() == [10]
    wall = Frames(frames.values, np.array([NOW, NOW + 10]))
    moved = shift_of("P1", [NOW], True, b"k" * 16).frames(wall, keep_host=False)
    assert moved.device_ms[0] == shift_of("P1", [NOW], True, b"k" * 16).target_ms
    assert moved.host_ms is None
