"""The C library: bit for bit the answers of ``models/integer``, whatever comes; quiet whatever it is given."""

from __future__ import annotations

import ctypes
import math
import struct
import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

TESTS = Path(__file__).parents[1]

from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.deploy.golden import ANSWER, COLUMNS, EVENT, FAULT, HEALTH, answers_of, column
from plushsense.deploy.quantize import integer_model
from plushsense.models.arch import ConvLayer
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import BEGUN, NO_GESTURE, EventSettings
from plushsense.runtime.fixed import InputScale, Requantize, exponentials, split_ratio
from plushsense.runtime.gate import DOUBT, JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import IntegerModel, memory_bytes
from plushsense.runtime.integer import MOST_REACH
from plushsense.runtime.machine import Sample, ToyMachine
from plushsense.tuning.decisions import fit_health
from plushsense.windows.clock import burst_ms
from support.c_toy import answers, seat
from support.exports import bundle_of
from support.integers import INT32, any_frames, any_network, edged_model, models, plain_model, ruled_model

OK, TOO_SMALL, NOT_ALIGNED, MEMORY_NOT_ALIGNED = 0, 4, 7, 8


# ---- The same answers ------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(models(), st.integers(0, 1 << 30))
def test_any_network_any_stream(c_library: Any, plain_c_library: Any, model: IntegerModel, seed: int) -> None:
    frames = any_frames(model, seed)
    expected = answers_of(model, frames)
    for library in (c_library, plain_c_library):
        toy = seat(library, model)
        assert toy.status == OK
        assert np.array_equal(toy.push(frames), expected)
        assert library.seat_answers(toy.toy) == len(answers(expected))


def test_most_random_streams_are_answered(c_library: Any) -> None:
    """The test above is worth something only while its models get through the warming and decide this and that."""
    tracked, gestures = 0, set()
    for seed in range(6):
        model = plain_model(seed)
        rows = seat(c_library, model).push(any_frames(model, seed, 2000))
        assert np.array_equal(rows, answers_of(model, any_frames(model, seed, 2000)))
        found = answers(rows)
        tracked += int((found[:, 3] == 1).sum())
        gestures |= set(found[found[:, 3] == 1, 4].tolist())
    assert tracked > 500
    assert len(gestures) == 3


def test_sensors_in_doubt(c_library: Any) -> None:
    """Runs of suspect samples, too short and long enough for the gate to begin anew."""
    events, longest = 0, 0
    blow = Rule((Term(0, 24, times=1),), 3, NO_GESTURE, within=2, deaf=3)
    gate = GateSettings((Signal(JERK, (1,), lag=3, shift=4, baseline=4, noise=4),), (blow,))
    for seed in range(8):
        model, rng = ruled_model(seed), np.random.default_rng(seed)
        rules = Rules(EventSettings(hold=0, rest=0), gate, HealthSettings(fault_ms=2000 * (seed % 2)))
        model = replace(model, rules=rules)
        frames, at = any_frames(model, seed, 700), 30
        while at < len(frames):
            run = int(rng.integers(1, 26))
            frames[at : at + run, 2] = 30_001  # out of its range
            at, longest = at + run + int(rng.integers(3, 60)), max(longest, run)
        rows = seat(c_library, model).push(frames)
        assert np.array_equal(rows, answers_of(model, frames))
        events += int((column(rows, "source", EVENT) == 1).sum())
    assert longest > 2 * DOUBT and events > 500, "events of the gate"


def test_every_edge(c_library: Any, plain_c_library: Any) -> None:
    model = edged_model()
    for seed in range(4):
        frames = any_frames(model, seed, 700)
        expected = answers_of(model, frames)
        for library in (c_library, plain_c_library):
            assert np.array_equal(seat(library, model).push(frames), expected)
        expected = answers(expected)
        logits, best = expected[expected[:, 3] == 1][:, 9:18], expected[expected[:, 3] == 1][:, 4]
        # Held within their limits; a tie goes to the first.
        assert (logits.min(), logits.max()) == (-16384, 16384)
        assert np.array_equal(logits[:, 0], logits[:, 1])
        assert 1 not in best


def test_sums_at_the_ends_of_their_24_bits(c_library: Any, plain_c_library: Any) -> None:
    """Inputs are 0 or 255, and the weights of each filter add up to as much as is allowed."""
    plain = plain_model()
    arch = replace(plain.network.arch, layers=(ConvLayer(130, 1, 6), ConvLayer(4, 3, 5)))
    network = any_network(arch, plain.layout, np.random.default_rng(1))
    first, n = network.layers[0], np.arange(260)
    rows = [n * 0 + 127, n * 0 - 128, (-1) ** n * 127, n * 0 - 127, np.where(n < 130, 127, -128), n * 0 - 128]
    weights = np.array([row * (np.abs(row).cumsum() <= MOST_REACH) for row in rows], dtype=np.int8).reshape(6, 2, 130)
    assert MOST_REACH - np.abs(weights.astype(int)).sum(axis=(1, 2)).max() == 0
    inputs = InputScale(*np.array([[0, 0, 32767, 0, 0]] * 2).T)
    scale = Requantize(*np.array([split_ratio(1 / MOST_REACH, 255 * MOST_REACH)] * 6).T)
    first = replace(first, weights=weights, scale=scale)
    model = replace(plain, network=replace(network, inputs=inputs, layers=(first, network.layers[1])))
    touched = np.repeat(np.random.default_rng(1).integers(0, 2, (30, 4)), np.arange(1, 31) * 2, axis=0) * 2000 - 1000
    frames = np.column_stack([10 * np.arange(len(touched)), touched])
    expected = answers_of(model, frames)
    assert len(np.unique(answers(expected)[:, 9:12])) > 50
    for library in (c_library, plain_c_library):
        assert np.array_equal(seat(library, model).push(frames), expected)


@settings(max_examples=30)
@given(models(longest=200))
def test_memory_is_what_python_says(c_library: Any, model: IntegerModel) -> None:
    image = model.to_bytes()
    assert c_library.plush_memory_bytes(image, len(image)) == memory_bytes(model)
    assert seat(c_library, model, too_few=1).status == TOO_SMALL
    assert seat(c_library, model).status == OK


def test_misaligned_or_no_memory(c_library: Any) -> None:
    for off in (1, 2, 3):
        assert seat(c_library, plain_model(), off=off).status == MEMORY_NOT_ALIGNED
    image = plain_model().to_bytes()
    toy = (ctypes.c_uint64 * 256)()
    assert c_library.plush_begin(toy, image, len(image), None, 1 << 20) == TOO_SMALL
    room = ctypes.create_string_buffer(len(image) + 4)
    for off in range(5):
        at = ctypes.addressof(room) + off
        ctypes.memmove(at, image, len(image))
        aligned = at % 4 == 0
        status = c_library.plush_begin(toy, ctypes.c_void_p(at), len(image), None, 1 << 20)
        assert status == (TOO_SMALL if aligned else NOT_ALIGNED)
        size = c_library.plush_memory_bytes(ctypes.c_void_p(at), len(image))
        assert size == (memory_bytes(plain_model()) if aligned else 0)


# ---- Stamps, priming, probabilities ----------------------------------------------------------------------------------


def test_a_buffer_of_readings_is_stamped_as_in_python(c_library: Any) -> None:
    """Read 8 at a time at 104 Hz, by an interrupt that is up to 27 ms late: nothing restarts."""
    model, times, last_ms, rows = plain_model(), list[int](), 20, []
    toy = seat(c_library, model)
    toy.push(np.empty((0, 5), dtype=np.int64))
    frames = any_frames(model, 3, 400)
    frames[:, 1:] = np.clip(frames[:, 1:], 0, 100)
    for at, late in zip(range(0, 400, 8), (0, 19, 3, 27, 0, 14) * 9, strict=False):
        times += (burst := burst_ms(8, last_ms + late, 9615))
        frames[at : at + 8, 0] = [-1] * (8 - len(burst)) + burst
        rows.append(toy.push_many(frames[at : at + 8, 1:], last_ms + late, 9615))
        last_ms += 77
    expected = answers_of(model, frames[frames[:, 0] >= 0])
    assert len(times) < 400, "some come from before the clock's beginning"
    assert np.array_equal(np.delete(np.concatenate(rows), 1, axis=1), np.delete(expected, 1, axis=1))
    assert expected[-1, COLUMNS[ANSWER].index("restarts")] == 0 < expected[-1, COLUMNS[ANSWER].index("bad_stamps")]


def test_a_primed_toy_answers_with_the_next_step(c_library: Any) -> None:
    model = plain_model()
    arch, frames = model.network.arch, any_frames(model, 3, 300)
    frames[:, 1:] = np.clip(frames[:, 1:], 0, 100)
    rest = frames[0, 1:].astype(np.int32)
    toy = seat(c_library, model)
    assert toy.prime(int(frames[0, 0]), rest) == 1
    rows = answers(toy.push(frames[1 : 2 + arch.step]))
    assert rows[0, 3] == 1, "tracking"
    # As if the reading had come all the time.
    still = np.concatenate([np.tile(frames[:1], (arch.span - arch.step, 1)), frames[1:]])
    still[:, 0] = 1000 + 10 * np.arange(len(still))
    assert (
        np.array_equal(rows[:, 9:], answers(seat(c_library, model).push(still))[-len(rows) :, 9:]) or model.rules.gate
    )
    shares = [c_library.seat_probability(toy.toy, k) for k in range(arch.classes)]
    bytes_ = [int(v) * 255 // (1 << 27) for v in rows[-1, 9 + arch.classes :]]
    assert shares == bytes_ and c_library.seat_probability(toy.toy, 255) == 0
    wrong = rest.copy()
    wrong[0] = INT32[0]
    assert toy.prime(0, wrong) == 0 and seat(c_library, model).prime(0, rest) == 1


def test_beginning_again_ends_what_goes_on_and_keeps_the_callbacks(c_library: Any) -> None:
    blow = Rule((Term(0, 24, times=1),), 3, NO_GESTURE, within=2, deaf=3)
    gate = GateSettings((Signal(JERK, (1,), lag=3, shift=4, baseline=4, noise=4),), (blow,))
    model, frames = replace(ruled_model(1), rules=Rules(gate=gate)), any_frames(ruled_model(1), 1, 700)
    toy, image = seat(c_library, model), model.to_bytes()
    rows = answers_of(model, frames)
    begun = rows[(rows[:, 0] == EVENT) & (rows[:, 4] == BEGUN)][-1]
    toy.push(frames[: begun[1] + 1])
    assert c_library.seat_begin_again(toy.toy, image, len(image)) == OK
    assert c_library.seat_made(toy.toy) == 1, "the end, by the callback set before"
    frames = any_frames(model, 4, 500)
    assert np.array_equal(toy.push(frames), answers_of(model, frames))


# ---- Restarts, several toys, other models ----------------------------------------------------------------------------


def test_a_restart_is_a_fresh_toy(c_library: Any) -> None:
    model = plain_model()
    before, after = any_frames(model, 1, 400, start=0), any_frames(model, 2, 400, start=90_000)
    used, fresh = seat(c_library, model), seat(c_library, model)
    used.push(before)
    c_library.seat_restart(used.toy)
    got, expected = answers(used.push(after)), answers(fresh.push(after))
    # The counts of restarts and invalid values, and the frames' numbers, go on.
    for count in (0, 7, 8):
        got[:, count] -= got[0, count] - expected[0, count]
    assert np.array_equal(got, expected)
    assert (expected[:, 3] == 1).any()


def test_a_gap_is_a_fresh_toy(c_library: Any) -> None:
    model = plain_model()
    before, after = any_frames(model, 1, 400, start=0), any_frames(model, 2, 400, start=90_000)
    together = answers(seat(c_library, model).push(np.concatenate([before, after])))
    alone = answers(seat(c_library, model).push(after[1:]))  # the first frame after a gap is left out
    later = together[together[:, 0] >= 400]
    assert np.array_equal(later[:, 1:7], alone[:, 1:7])
    assert np.array_equal(later[:, 9:], alone[:, 9:])
    assert later[0, 7] == together[together[:, 0] < 400][-1, 7] + 1


def test_what_became_of_a_reading(c_library: Any) -> None:
    """By what Python's machine knows after each frame: gaps, resets, values never valid, faults and recoveries."""
    found: Counter[int] = Counter()
    for seed in range(6):
        model = replace(ruled_model(seed), rules=Rules(health=HealthSettings(fault_ms=60 * (seed % 2), recover_ms=90)))
        frames = any_frames(model, seed, 400)
        frames[:9, 2] = frames[150:170, 2] = 1 << 30  # out of its range
        machine = ToyMachine(model.network.stepper(), model.layout, model.gestures, model.rules, model.smoothing)
        toy = seat(c_library, model)
        assert c_library.seat_reading(toy.toy) == 0
        for frame in frames:
            items = list(machine.frames.push(int(frame[0]), frame[1:].tolist()))
            steps = [m for m in machine.samples.read(items) if m.cause == "step"]
            waiting = machine.frames.clock.now_us is None
            first = machine.samples.samples == 1 and any(isinstance(item, Sample) for item in items)
            left_out = machine.frames.clock.left_out
            expected = 5 if left_out else 2 if machine.frames.health.fault else 1 if waiting else 3 if first else 4
            rows = toy.push(frame[None])
            assert c_library.seat_reading(toy.toy) == expected, (seed, frame[0])
            assert len(answers(rows)) == len(steps) and (expected in (3, 4) or not steps)
            found[expected] += 1
    assert min(found[kind] for kind in (1, 2, 3, 4)) > 12 and found[5] > 8, found


@pytest.mark.parametrize("ms", [0, 1, 2**31, 2**32 - 1])
def test_a_single_impossible_time_is_as_a_lost_frame(c_library: Any, ms: int) -> None:
    """Also all zeros, as the authors' recorder writes for a line that it cannot read; two in turn are a reset."""
    model = plain_model()
    frames = any_frames(model, 1, 400, start=10_000)
    frames[:, 0] = 10_000 + 10 * np.arange(400)
    stray = frames.copy()
    stray[[150, 250, 300], 0] = ms
    stray[250, 1:] = 0
    lost = np.delete(frames, [150, 250, 300], axis=0)
    whole, without = (answers(seat(c_library, model).push(some))[:, 1:] for some in (stray, lost))
    assert np.array_equal(whole, without) and len(without) > 30 and without[-1, 6] == 0
    assert np.array_equal(seat(c_library, model).push(stray), answers_of(model, stray))
    stray[301, 0] = ms
    reset = seat(c_library, model).push(stray)
    assert np.array_equal(reset, answers_of(model, stray)) and answers(reset)[-1, 7] == 2


@pytest.mark.parametrize("quiet", [True, False])
def test_a_quiet_sensor_rests_without_a_fault(c_library: Any, tmp_path: Path, quiet: bool) -> None:
    """A filtered sensor of 8 bits rests at one value for 2 s in training, and for a minute in the toy."""
    rng = np.random.default_rng(0)
    touch = np.rint(np.cumsum(rng.normal(size=(800, 3)), axis=0)).astype(np.int64) * 8
    touch[200:400] = touch[200]
    values = touch if quiet else touch + rng.integers(-4, 5, touch.shape)
    clock = 1000 + 10 * np.arange(len(values))
    frames = Frames(values, clock, clock + 1_700_000_000_000)
    (tmp_path / "raw" / "A").mkdir(parents=True)
    model = integer_model(bundle_of("accel-3"))
    write_recording(tmp_path / "raw" / "A" / "tap_1700000001000_800.csv", frames, model.layout)
    imported = import_recordings(tmp_path / "raw", tmp_path / "ds", layout="accel-3", adopt_proposals=False)
    health = fit_health(imported.dataset, ["A"]).settings
    model = replace(model, rules=replace(model.rules, health=health))
    still = np.column_stack([10 * np.arange(6800), np.concatenate([values, np.tile(values[:1], (6000, 1))])])
    rows = seat(c_library, model).push(still)
    assert np.array_equal(rows, answers_of(model, still))
    assert (FAULT in column(rows, "state", HEALTH)) == (not quiet), health


def test_toys_side_by_side(c_library: Any) -> None:
    """Two models and four toys, fed in turns: each as if it were alone."""
    all_models = [plain_model(1), plain_model(2, step=3, pool=9, classes=5)] * 2
    frames = [any_frames(m, 10 + i, 600) for i, m in enumerate(all_models)]
    toys = [seat(c_library, m) for m in all_models]
    got: list[list[np.ndarray]] = [[] for _ in toys]
    for at in range(0, 600, 7):
        for pieces, toy, rows in zip(got, toys, frames, strict=True):
            pieces.append(toy.push(rows[at : at + 7]))
    for pieces, model, rows in zip(got, all_models, frames, strict=True):
        assert np.array_equal(np.concatenate(pieces), answers_of(model, rows))


def test_another_model_in_the_same_toy(c_library: Any) -> None:
    """The bytes are swapped while the program runs; nothing is compiled again."""
    first, second = plain_model(1), plain_model(7, classes=6, step=2, pool=14)
    toy = seat(c_library, first)
    toy.push(any_frames(first, 3, 300))
    for model in (second, first):
        image = model.to_bytes()
        assert c_library.seat_begin_again(toy.toy, image, len(image)) == OK
        toy.classes = model.network.arch.classes
        frames = any_frames(model, 4, 500)
        assert np.array_equal(toy.push(frames), answers_of(model, frames))


def test_names(c_library: Any) -> None:
    model = plain_model()
    toy = seat(c_library, model)
    assert [c_library.seat_name(toy.toy, i) for i in range(4)] == [b"gesture 0", b"gesture 1", b"gesture 2", b""]
    assert c_library.seat_title(toy.toy).decode() == model.network.arch.title


# ---- Counts near 2^32 ------------------------------------------------------------------------------------------------


def test_counts_wrap_and_nothing_else_changes(c_library: Any) -> None:
    model = plain_model()
    frames = any_frames(model, 12, 1500, start=5)
    frames[::50, 1] = INT32[0]  # invalid values
    frames[700:, 0] += 5000  # a gap
    young, old = seat(c_library, model), seat(c_library, model)
    by = 2**32 - 40
    c_library.seat_age(old.toy, ctypes.c_uint32(by))
    expected, got = answers(young.push(frames)), answers(old.push(frames))
    assert c_library.seat_answers(old.toy) == (c_library.seat_answers(young.toy) + by) % 2**32
    assert c_library.seat_answers(old.toy) < c_library.seat_answers(young.toy)
    for count in (7, 8):
        assert np.array_equal(got[:, count].view(np.uint32), (expected[:, count].astype(np.int64) + by) % 2**32)
    # A restart sets the samples to 0, whatever they were.
    since = expected[:, 2].astype(np.int64) + np.where(expected[:, 7] == 0, by, 0)
    assert np.array_equal(got[:, 2].view(np.uint32), since % 2**32)
    same = [0, 1, 3, 4, 5, 6, *range(9, expected.shape[1])]
    assert np.array_equal(got[:, same], expected[:, same])
    assert (got[:, 2].view(np.uint32) < 1000).any()


def test_late_and_early_times_are_alike(c_library: Any) -> None:
    """The last minute before the clock's wrap gives the answers of the first one."""
    model = plain_model()
    frames = any_frames(model, 5, 1500, start=0)
    early = answers(seat(c_library, model).push(frames))
    shift = 2**32 - 1 - int(frames[:, 0].max())
    frames[:, 0] += shift
    late = answers(seat(c_library, model).push(frames))
    assert np.array_equal(late[:, 1].view(np.uint32), early[:, 1].view(np.uint32) + np.uint32(shift))
    early[:, 1] = late[:, 1]
    assert np.array_equal(late, early)


def test_the_clocks_wrap_is_a_restart(c_library: Any) -> None:
    model = plain_model()
    frames = any_frames(model, 5, 1000, start=0)
    frames[:, 0] = (np.arange(1000) * 10 + 2**32 - 5000) & 0xFFFFFFFF
    rows = seat(c_library, model).push(frames)
    assert np.array_equal(rows, answers_of(model, frames))
    found = answers(rows)
    assert found[0, 7] == 0
    assert found[-1, 7] == 1
    warming = found[found[:, 7] == 1][:, 3]
    assert warming[0] == 0
    assert warming[-1] == 1


# ---- The small functions ---------------------------------------------------------------------------------------------

int32s = st.integers(*INT32) | st.sampled_from((*INT32, 0, -1, 1))


@settings(max_examples=300)
@given(int32s, st.integers(0, 30))
def test_shift_down(c_library: Any, v: int, n: int) -> None:
    assert c_library.try_shift_down(v, n) == v >> n
    assert c_library.try_as_signed(ctypes.c_uint32(v)) == v


@settings(max_examples=300)
@given(
    st.integers(0, 2**64 - 1)
    | st.integers(0, 2**32 - 1).map(lambda r: r * r)
    | st.integers(1, 2**32 - 1).map(lambda r: r * r - 1)
)
def test_square_root(c_library: Any, v: int) -> None:
    assert c_library.try_root(v) == math.isqrt(v)


@settings(max_examples=200)
@given(int32s)
def test_square(c_library: Any, v: int) -> None:
    assert c_library.try_square(v) == v * v


@settings(max_examples=400)
@given(st.data())
def test_interpolation_in_32_bits(c_library: Any, data: st.DataObject) -> None:
    """Of any distance and any gap that a model may have; ``add`` is at most half of ``by``."""
    gap = data.draw(st.sampled_from((1, 30, 20_000, 1 << 22)) | st.integers(1, 1 << 22))
    between = data.draw(st.integers(1, gap) | st.just(gap))
    into = data.draw(st.integers(0, between) | st.just(between))
    distance = data.draw(st.integers(0, 2**32 - 1) | st.just(2**32 - 1))
    add = data.draw(st.sampled_from((between, between - 1)))
    narrow = (2**32 - 1 - gap) // (2 * gap)
    got = c_library.try_part_of(ctypes.c_uint32(distance), 2 * into, 2 * between, add, ctypes.c_uint32(narrow))
    assert got == (distance * 2 * into + add) // (2 * between)


def test_exponentials(c_library: Any) -> None:
    coarse, fine = exponentials()
    for d in range(4200):
        assert c_library.try_exponential(d) == (int(coarse[d >> 6] * fine[d & 63]) >> 16 if d < 4096 else 0)
    assert c_library.try_exponential(2 * (1 << 14)) == 0


def test_the_checksum_is_the_one_of_zip(c_library: Any) -> None:
    """Of any length, at any address."""
    image = plain_model().to_bytes()
    assert struct.unpack_from("<I", image, 12)[0] == zlib.crc32(image[16:])
    data = np.random.default_rng(3).integers(0, 256, 900, dtype=np.uint8).tobytes()
    held = ctypes.create_string_buffer(data)
    for n, length in enumerate([*range(40), 255, 256, 257, 890]):
        start = n % 7
        found = c_library.try_checksum(ctypes.c_void_p(ctypes.addressof(held) + start), length)
        assert found == zlib.crc32(data[start : start + length]), (start, length)
