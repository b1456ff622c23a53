import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import bridged_ms, kept_rows, stray_rows
from plushsense.windows.clock import SampleClock, burst_ms, resample, row_times_us

pytestmark = pytest.mark.slow

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


def test_gaps_and_resets_start_again_at_the_second_frame() -> None:
    given_frames = frames([0, 100, 201, 311, 110, 120], [[i, 0, 0] for i in range(6)])
    out = resample(given_frames, ACCEL)
    assert [s.first_row for s in out] == [0, 3, 5], "100 ms are bridged, 101 ms are not, nor two steps back"
    assert [s.last_row for s in out] == [2, 4, 6]
    assert [len(s) for s in out] == [11, 1, 1]


@pytest.mark.parametrize("wrong", [[0], [20_000], [1_017, 0], [1_009]])
def test_one_impossible_time_is_bridged(wrong: list[int]) -> None:
    """As of the authors' recorder, which writes 0 for what it cannot read: alone, or with zeros for all values."""
    times = [1000, 1010, *wrong, 1030, 1040]
    rows = [[0, 0, 7], [10, 0, 7], *[[0, 0, 0]] * len(wrong), [30, 0, 7], [40, 0, 7]]
    (segment,) = resample(frames(times, rows), ACCEL)
    if len(wrong) == 1:
        assert segment.data.tolist() == [[at, 0, 7] for at in (0, 10, 20, 30, 40)]
        assert segment.row_of.tolist() == [0, 1, 3, 3, 4]
    assert (segment.first_row, segment.last_row) == (0, len(times))
    clock = SampleClock(ACCEL)
    kept = [(len(clock.push(t, row)), clock.left_out)[1] for t, row in zip(times, rows, strict=True)]
    assert kept.count(True) == 1 and clock.restarts == 0


def test_a_buffer_whose_stamps_overlap_costs_nothing() -> None:
    """A driver reads 8 readings at 104 Hz at a time, and stamps them from the time at which it reads them."""
    times, read = list[int](), 1000
    for late in (0, 19, 3, 27, 0, 14) * 4:
        read += 77
        times += burst_ms(8, read + late, 9615)
    given_frames = frames(times, [[t, 0, 0] for t in times])
    (segment,) = resample(given_frames, ACCEL)
    assert np.array_equal(segment.data[:, 0], times[0] + 10 * np.arange(len(segment))), "a ramp stays one"
    clock = SampleClock(ACCEL)
    for t in times:
        clock.push(t, (t, 0, 0))
    assert (clock.restarts, clock.bad_stamps) == (0, len(times) - len(kept_rows(given_frames.device_ms, 100)))
    assert clock.bad_stamps == 15 and not clock.sparse
    assert burst_ms(3, 15, 9615) == [5, 15], "none before the clock's beginning"


def test_equal_stamps_are_counted() -> None:
    clock = SampleClock(ACCEL)
    for t in (0, 10, 10, 10, 20):
        clock.push(t, (0, 0, 0))
    assert clock.bad_stamps == 2


@pytest.mark.parametrize(
    ("every_ms", "jitter", "sparse"), [(10, 2, False), (15, 0, False), (25, 0, True), (40, 3, True)]
)
def test_the_interval_is_measured_and_missing_readings_are_counted(every_ms: int, jitter: int, sparse: bool) -> None:
    clock, rng, made = SampleClock(ACCEL), np.random.default_rng(0), 0
    for t in range(0, 4000, every_ms):
        made += len(clock.push(t + int(rng.integers(-jitter, jitter + 1)) + jitter, (0, 0, 0)))
    assert abs(clock.interval / 256 - every_ms) < 0.1 + jitter / 4 and clock.sparse == sparse
    if jitter == 0:
        assert clock.interpolated == {15: 133, 25: made - 160}[every_ms], "every other interval of 15 ms holds two"
    assert (clock.interpolated > 0) == (every_ms > 10)


@pytest.mark.parametrize("wrong", [[0, 0], [0, 5], [0, 20_000], [20_000, 0]])
def test_two_impossible_times_in_turn_are_taken_for_a_reset(wrong: list[int]) -> None:
    times = [1000, 1010, *wrong, 1040, 1050, 1060]
    out = resample(frames(times, [[at, 0, 0] for at in range(len(times))]), ACCEL)
    assert [s.first_row for s in out] == [0, 3, 5]
    clock = SampleClock(ACCEL)
    for t in times:
        clock.push(t, (0, 0, 0))
    assert clock.restarts == 2


def test_an_impossible_time_at_the_beginning_or_end() -> None:
    out = resample(frames([0, 1000, 1010, 1020, 3], [[at, 0, 0] for at in range(5)]), ACCEL)
    assert [(s.first_row, s.last_row) for s in out] == [(0, 1), (2, 4)]


def test_times_of_rows_go_on_over_impossible_ones_and_resets() -> None:
    times = row_times_us(frames([1000, 1010, 0, 1030, 5000, 5010, 3, 13, 23, 9], [[0, 0, 0]] * 10), ACCEL)
    assert times.tolist() == [t * 1000 for t in (0, 10, 30, 30, 4010, 4010, 4020, 4020, 4030, 4030)]
    assert len(row_times_us(frames([], []), ACCEL)) == 0


def test_the_authors_recordings_give_their_windows_in_spite_of_one_wrong_time() -> None:
    """Row 100 of 502 has the clock 0, as after a token that their recorder could not read."""
    times = [40_000 + 10 * at for at in range(502)]
    times[100] = 0
    (segment,) = resample(frames(times, [[at, 0, 0] for at in range(502)]), ACCEL)
    assert len(segment) == 502 and segment.data[:, 0].tolist() == list(range(502)), "row 100 is half-way between"


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


steps = st.lists(st.one_of(st.integers(0, 40), st.integers(90, 130), st.integers(-120, -1)), min_size=1, max_size=60)
value = st.one_of(st.integers(-40_000, 40_000), st.sampled_from([-32768, 32767, 32768, -32769]))
strays = st.lists(st.tuples(st.integers(0, 60), st.sampled_from([0, 0, 1, 9_000, 1 << 31])), max_size=12)


def in_turn(clock: list[int], gap_ms: int) -> list[int]:
    """Return the rows that rule 1 keeps, one after the other, as it is worded."""
    kept, left_out = [0], False
    for at in range(1, len(clock)):
        step = clock[at] - clock[kept[-1]]
        if -gap_ms <= step < 0:
            continue
        left_out = not 0 <= step <= gap_ms and not left_out
        if not left_out:
            kept.append(at)
    return kept


@settings(max_examples=200)
@given(st.data(), steps, strays)
def test_stream_equals_batch_in_every_bit(data: st.DataObject, moves: list[int], wrong: list[tuple[int, int]]) -> None:
    clock = np.cumsum([1000, *moves]).tolist()
    for at, time in wrong:  # single ones, some in turn, some beside gaps
        clock[at % len(clock)] = time
    rows = data.draw(st.lists(st.lists(value, min_size=3, max_size=3), min_size=len(clock), max_size=len(clock)))
    given_frames = frames(clock, rows)
    layout = replace(ACCEL, rate_hz=data.draw(st.sampled_from([100.0, 60.0])))
    kept = kept_rows(given_frames.device_ms, layout.gap_ms)
    assert kept.tolist() == in_turn(clock, layout.gap_ms)
    bridged = bridged_ms(given_frames.device_ms, stray_rows(given_frames.device_ms, layout.gap_ms))
    assert np.array_equal(bridged[kept], given_frames.device_ms[kept])
    for a, b in itertools.pairwise(kept.tolist()):
        if 0 <= bridged[b] - bridged[a] <= layout.gap_ms:
            assert (np.diff(bridged[a : b + 1]) >= 0).all(), "rows left out between two that follow each other"
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
