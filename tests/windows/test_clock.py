from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.windows.clock import SampleClock, resample

ACCEL = load_layout("accel-3")


def frames(clock: list[int], values: list[list[int]]) -> Frames:
    return Frames(np.array(values, dtype=np.int64).reshape(-1, 3), np.array(clock, dtype=np.int64))


def streamed(given_frames: Frames, layout: Layout = ACCEL) -> list[NDArray[np.int64]]:
    clock = SampleClock(layout)
    segments: list[list[NDArray[np.int64]]] = [[]]
    for moment, row in zip(given_frames.device_ms.tolist(), given_frames.values.tolist(), strict=True):
        made = clock.push(moment, row)
        if clock.restarted:
            segments.append([])
        segments[-1] += made
    return [np.array(s) for s in segments if s]


def test_linear_between_frames_rounded_half_up() -> None:
    out = resample(frames([0, 20, 31], [[0, 0, 7], [5, -5, 7], [16, 0, 7]]), ACCEL)
    assert len(out) == 1
    # 10 ms: 2.5 -> 3 and -2.5 -> -2 (half goes up); 30 ms: 5 + 11·10/11 and -5 + 5·10/11 = -0.45 -> 0.
    assert out[0].data.tolist() == [[0, 0, 7], [3, -2, 7], [5, -5, 7], [15, 0, 7]]
    assert out[0].row_of.tolist() == [0, 1, 1, 2]


def test_gaps_and_resets_start_again() -> None:
    given_frames = frames([0, 100, 201, 150, 160], [[i, 0, 0] for i in range(5)])
    out = resample(given_frames, ACCEL)
    assert [s.first_row for s in out] == [0, 2, 3], "100 ms are bridged, 101 ms are not, nor a step back"
    assert [len(s) for s in out] == [11, 1, 2]


def test_equal_stamps_first_closes_last_opens() -> None:
    out = resample(frames([0, 10, 10, 10, 20], [[0, 0, 0], [1, 0, 0], [50, 0, 0], [9, 0, 0], [19, 0, 0]]), ACCEL)
    assert out[0].data[:, 0].tolist() == [0, 1, 19]
    out = resample(frames([0, 5, 5, 15], [[0, 0, 0], [1, 0, 0], [9, 0, 0], [19, 0, 0]]), ACCEL)
    assert out[0].data[:, 0].tolist() == [0, 14]


def test_invalid_values_hold_the_last_valid_one_a_channel() -> None:
    big = 99_999
    out = resample(frames([0, 10, 20, 30], [[big, 1, 1], [2, 2, 2], [3, big, 3], [4, 4, -big]]), ACCEL)
    assert out[0].first_row == 1, "passed over until every channel has had a valid value"
    assert out[0].data.tolist() == [[2, 2, 2], [3, 2, 3], [4, 4, 3]]
    assert out[0].invalid == 3


def test_nothing_valid_gives_nothing() -> None:
    assert resample(frames([0, 10], [[99_999, 0, 0]] * 2), ACCEL) == []
    assert resample(frames([], []), ACCEL) == []


def test_a_causal_rule_does_not_wait_longer_than_one_frame() -> None:
    clock = SampleClock(ACCEL)
    assert (clock.now_us, clock.restarts, clock.restarted) == (None, 0, False)
    assert [len(clock.push(t, (0, 0, 0))) for t in (0, 9, 18, 45)] == [1, 0, 1, 3]
    assert clock.now_us == 40_000


steps = st.lists(st.one_of(st.integers(0, 40), st.integers(90, 130), st.integers(-50, -1)), min_size=1, max_size=60)
value = st.one_of(st.integers(-40_000, 40_000), st.sampled_from([-32768, 32767, 32768, -32769]))


@settings(max_examples=200)
@given(st.data(), steps)
def test_stream_equals_batch_in_every_bit(data: st.DataObject, moves: list[int]) -> None:
    clock = np.cumsum([0, *moves]).tolist()
    rows = data.draw(st.lists(st.lists(value, min_size=3, max_size=3), min_size=len(clock), max_size=len(clock)))
    given_frames = frames(clock, rows)
    layout = replace(ACCEL, rate_hz=data.draw(st.sampled_from([100.0, 60.0])))
    batch = resample(given_frames, layout)
    live = streamed(given_frames, layout)
    assert len(batch) == len(live)
    for segment, samples in zip(batch, live, strict=True):
        assert np.array_equal(segment.data, samples)


def test_a_sample_due_a_microsecond_later_waits_for_the_next_frame() -> None:
    layout = replace(ACCEL, rate_hz=60.0)
    assert layout.period_us == 16_667
    until = frames([0, 20, 50], [[0, 0, 0], [20, 0, 0], [50, 0, 0]])
    (segment,) = resample(until, layout)
    assert segment.data[:, 0].tolist() == [0, 17, 33], "the next one is due at 50.001 ms"
    assert np.array_equal(streamed(until, layout)[0], segment.data)


@pytest.mark.parametrize("rate", [11, 30, 10, 7])
def test_a_ramp_stays_a_ramp_at_any_device_rate(rate: int) -> None:
    clock = list(range(0, 3000, rate))
    out = resample(frames(clock, [[4 * t, 0, 0] for t in clock]), ACCEL)
    assert np.array_equal(out[0].data[:, 0], 40 * np.arange(len(out[0])))
