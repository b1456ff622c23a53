from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.errors import LayoutError
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.machine import FrameReader, Sample
from plushsense.windows import self_calibration
from plushsense.windows.clock import resample
from plushsense.windows.cut import cut_windows
from plushsense.windows.features import network_inputs
from plushsense.windows.self_calibration import UNIT, SelfCalibration
from plushsense.windows.sessions import SessionReader

pytestmark = pytest.mark.slow

PLAIN = load_layout("accel-3")
WIDE = tuple(replace(c, valid_min=-262144.0, valid_max=262143.0) for c in PLAIN.channels)
LAYOUT = replace(PLAIN, channels=WIDE, self_calibration=("x", "y", "z"))


def readings(n: int, seed: int, radius: float = 8000.0) -> NDArray[np.int64]:
    """Readings (n, 3) of a sensor that is held still in one direction after the other, and shaken between them."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n // 150 + 1, 3))
    x = np.repeat(x / np.linalg.norm(x, axis=1, keepdims=True), 150, axis=0)[:n]
    shaken = (np.arange(n) // 75 % 2)[:, None]
    return np.rint(radius * (x + rng.normal(size=(n, 3)) * np.where(shaken, 0.5, 0.004))).astype(np.int64)


def frames(x: NDArray[np.int64], start: int = 0) -> Frames:
    return Frames(x, start + 10 * np.arange(len(x)), 1_000_000 + start + 10 * np.arange(len(x)))


@settings(max_examples=10)
@given(st.integers(0, 1 << 20), st.lists(st.integers(0, 700), max_size=4), st.integers(-60_000, 60_000), st.booleans())
def test_blocks_and_single_samples_give_the_same(seed: int, cuts: list[int], offset: int, coarse: bool) -> None:
    x = readings(700, seed, 60.0 if coarse else 9000.0) + offset
    edges = [0, *sorted(cuts), len(x)]
    batch, stream = SelfCalibration(LAYOUT), SelfCalibration(LAYOUT)
    parts = [batch.apply(x[a:b]) for a, b in itertools.pairwise(edges)]
    assert np.concatenate(parts).tolist() == [stream.push(row) for row in x.tolist()]


@pytest.mark.parametrize(("gain", "offset"), [(0.2, (330, 511, -900)), (5.0, (-60_000, 20_000, 9)), (1.37, (1, 2, 3))])
def test_gain_and_offset_change_nothing(gain: float, offset: tuple[int, int, int]) -> None:
    x = readings(4000, 3)
    plain = SelfCalibration(LAYOUT).apply(x)
    other = SelfCalibration(LAYOUT).apply(np.rint(x * gain + np.array(offset)).astype(np.int64))
    # While there are hardly any directions, a rounded reading weighs more.
    assert np.abs(other - plain)[1000:].max() <= 0.01 * UNIT
    assert np.abs(other - plain).mean() < 3.0
    still = plain[3000:].reshape(-1, 25, 3)[(np.arange(40) // 3) % 2 == 0]
    assert np.median(np.linalg.norm(still, axis=2)) == pytest.approx(UNIT, rel=0.02), "held still, it reads 1 g"


def test_at_rest_from_the_start_noise_is_not_movement() -> None:
    x = np.rint(np.random.default_rng(1).normal((330, 512, 400), 0.7, (3000, 3))).astype(np.int64)
    assert np.abs(SelfCalibration(LAYOUT).apply(x)).max() < 0.35 * UNIT


def test_streams_and_segments_have_the_same_inputs_also_after_a_gap() -> None:
    layout = replace(LAYOUT, inputs=("x", "y", "z")).for_vectors()
    x = readings(1500, 4) + 700
    stream = frames(x)
    stream.device_ms[900:] += 3000
    state = SelfCalibration(layout)
    batch = [network_inputs(state.apply(s.data), layout) for s in resample(stream, layout)]
    assert len(batch) == 2
    reader = FrameReader(layout, HealthSettings(fault_ms=0))
    rows = zip(stream.device_ms.tolist(), x.tolist(), strict=True)
    samples = [item.inputs for ms, row in rows for item in reader.push(ms, row) if isinstance(item, Sample)]
    assert samples == np.concatenate(batch).tolist()
    reader.reset()
    first = [item.inputs for item in reader.push(0, x[0].tolist()) if isinstance(item, Sample)]
    assert first == [[0] * 6], "a new stream begins anew"


def written(folder: Path, layout: Layout, gain: float = 1.0, offset: int = 0, pause_ms: int = 0) -> Dataset:
    """Ana has a stream with two recordings, Ben three recordings alone, before the last of which the toy may be off."""
    ana, ben = folder / "src" / "ana", folder / "src" / "ben"
    for place in (ana, ben):
        place.mkdir(parents=True)
    stream = frames(np.rint(readings(1600, 5) * gain + offset).astype(np.int64))
    (ana / "fulldatastream.csv").write_text(format_rows(stream, PLAIN))
    for label, first, rows in (("Wave", 700, 120), ("Shake", 1100, 300)):
        part = stream.slice(first, first + rows)
        name = recording_filename(label, 1_000_000 + 10 * (first + rows - 1), rows)
        write_recording(ana / name, part, PLAIN)
    alone = np.rint(readings(1200, 6) * gain + offset).astype(np.int64)
    for label, at in (("Wave", 0), ("Shake", 1), ("Wave", 2)):
        part = frames(alone[400 * at : 400 * at + 400], 100_000 * at)
        if at == 2 and pause_ms:
            part = replace(part, device_ms=part.device_ms - 200_000, host_ms=part.host_ms + pause_ms)
        write_recording(ben / recording_filename(label, int(part.host_ms[-1]), 400), part, PLAIN)
    return import_recordings(folder / "src", folder / "DS", layout=layout).dataset


def test_the_past_of_the_session_is_used_and_nothing_else(tmp_path: Path) -> None:
    dataset = written(tmp_path / "a", LAYOUT)
    sessions = SessionReader(dataset)
    stream = sessions.stream("ana/fulldatastream")[0].data
    state = SelfCalibration(LAYOUT)
    assert np.array_equal(stream, state.apply(resample(dataset.read_stream("ana/fulldatastream"), LAYOUT)[0].data))
    for r in (r for r in dataset.used if r.subject == "ana"):
        own = SessionReader(dataset).recording(r)[0].data
        assert np.array_equal(own, stream[r.stream_row : r.stream_row + r.rows])
    ben = sorted((r for r in dataset.used if r.subject == "ben"), key=lambda r: r.epoch_ms)
    state = SelfCalibration(LAYOUT)
    expected = [state.apply(resample(dataset.read(r), LAYOUT)[0].data) for r in ben]
    for r, data in reversed(list(zip(ben, expected, strict=True))):
        assert np.array_equal(sessions.recording(r)[0].data, data)
    # An excluded recording is read with what came before it, and leaves nothing to those after it.
    without = Dataset(dataset.path, dataset.head, [replace(r, excluded=r == ben[1]) for r in dataset.recordings], [])
    assert np.array_equal(SessionReader(without).recording(ben[1])[0].data, expected[1])
    state = SelfCalibration(LAYOUT)
    for r in (ben[0], ben[2]):
        kept = state.apply(resample(dataset.read(r), LAYOUT)[0].data)
        assert np.array_equal(SessionReader(without).recording(r)[0].data, kept)
    windows = cut_windows(dataset)
    assert windows.self_calibration == "causal"
    assert cut_windows(dataset.with_inputs(replace(LAYOUT, self_calibration=()))).self_calibration == ""
    other = cut_windows(written(tmp_path / "b", LAYOUT, 4.0, -20_000))
    assert np.abs(windows.integers - other.integers).max() <= 0.02 * UNIT


DAY_MS = 24 * 3_600_000


def over_a_boundary(device_step_ms: int, host_step_ms: int, stale: int) -> tuple[Frames, int]:
    """Frames of a sensor with another gain and offset, and of the usual one after a boundary, at the row returned.

    The last ``stale`` frames of the other one come after the pause.
    """
    other, own = frames(np.rint(readings(3000, 8) * 0.2 + 9000).astype(np.int64)), frames(readings(1500, 9))
    device = own.device_ms + other.device_ms[-1] + device_step_ms
    assert other.host_ms is not None
    values, clock = np.concatenate([other.values, own.values]), np.concatenate([other.device_ms, device])
    host = np.concatenate([other.host_ms, own.device_ms + other.host_ms[-1] + host_step_ms])
    host[len(other) - stale : len(other)] += host_step_ms
    return Frames(values, clock, host), len(other)


def gravity_error(inputs: NDArray[np.int64], wanted: NDArray[np.int64]) -> float:
    """The median angle, in degrees, between the directions of gravity among the inputs (T, 6) of two readers."""
    one, other = (np.median(rows[-1000:].reshape(-1, 100, 6)[:, :, 3:], axis=1) for rows in (inputs, wanted))
    cosine = (one * other).sum(axis=1) / np.linalg.norm(one, axis=1) / np.linalg.norm(other, axis=1)
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0)))))


@pytest.mark.parametrize(
    ("boundary", "device_step_ms", "host_step_ms", "stale", "anew"),
    [
        ("a reboot and a pause of 17 hours", -25_000, 17 * 3_600_000, 0, True),
        ("frames that the driver had kept from before the pause", -25_000, 17 * 3_600_000, 70, True),
        ("a clock that had gone on from a reboot that nobody read", 60_000, DAY_MS, 0, True),
        ("a pause on both clocks", DAY_MS, DAY_MS, 0, False),
        ("a reset of the clock alone", -25_000, 300, 0, False),
        ("a reset with a short pause", -25_000, 120_000, 0, False),
    ],
)
def test_a_reboot_with_a_long_pause_begins_anew(
    boundary: str, device_step_ms: int, host_step_ms: int, stale: int, anew: bool, tmp_path: Path
) -> None:
    layout = replace(LAYOUT, inputs=("x", "y", "z")).for_vectors()
    whole, at = over_a_boundary(device_step_ms, host_step_ms, stale)
    folder = tmp_path / "src" / "ana"
    folder.mkdir(parents=True)
    (folder / "fulldatastream.csv").write_text(format_rows(whole, PLAIN))
    part = whole.slice(at + 1000, at + 1400)
    write_recording(folder / recording_filename("Wave", int(part.host_ms[-1]), 400), part, PLAIN)
    dataset = import_recordings(tmp_path / "src", tmp_path / "DS", layout=layout).dataset
    offline = [network_inputs(s.data, layout) for s in SessionReader(dataset).stream("ana/fulldatastream")]
    # The first frame after the boundary is left out.
    fresh = network_inputs(SelfCalibration(layout).apply(whole.values[at + 1 :]), layout)
    assert np.array_equal(offline[-1], fresh) == anew
    assert (gravity_error(offline[-1], fresh) < 1.0) == anew, boundary
    reader, live = FrameReader(layout, HealthSettings(fault_ms=0)), list[list[int]]()
    for ms, row, host_ms in zip(whole.device_ms.tolist(), whole.values.tolist(), whole.host_ms.tolist(), strict=True):
        live += [item.inputs for item in reader.push(ms, row, host_ms) if isinstance(item, Sample)]
    assert live == np.concatenate(offline).tolist(), "live is the stream"
    (recording,) = dataset.used
    own = network_inputs(SessionReader(dataset).recording(recording)[0].data, layout)[:, :3]
    assert np.array_equal(own, offline[-1][999:1399, :3]), "and so is a recording in it"


@pytest.mark.parametrize(("pause_ms", "anew"), [(DAY_MS, True), (60_000, False)])
def test_recordings_alone_begin_anew_after_a_reboot(tmp_path: Path, pause_ms: int, anew: bool) -> None:
    dataset = written(tmp_path, LAYOUT, pause_ms=pause_ms)
    *_, last = sorted((r for r in dataset.used if r.subject == "ben"), key=lambda r: r.epoch_ms)
    fresh = SelfCalibration(LAYOUT).apply(resample(dataset.read(last), LAYOUT)[0].data)
    assert np.array_equal(SessionReader(dataset).recording(last)[0].data, fresh) == anew


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"self_calibration": ("x", "y")}, "accepted are all three axes"),
        ({"self_calibration": ("x", "y", "z"), "vectors": ()}, "here none"),
        (
            {"self_calibration": ("x", "y", "z"), "vectors": (tuple("xyz"), tuple("zyx"))},
            "has x, y, z twice, by name or as axes of two vectors",
        ),
        ({"self_calibration": tuple("xxyz")}, "has x twice"),
        ({"self_calibration": ("x", "y", "z", "w")}, "'w'"),
        (
            {"self_calibration": ("x",), "vectors": (), "channels": (replace(WIDE[0], kind="count"), *WIDE[1:])},
            "has no scale to find",
        ),
        ({"channels": tuple(replace(c, valid_max=1e6) for c in WIDE)}, "within ±524288"),
    ],
)
def test_what_cannot_calibrate_itself_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(LayoutError, match=words):
        replace(LAYOUT, **change)


def test_a_layout_without_it_is_written_as_before() -> None:
    assert "self_calibration" not in PLAIN.to_dict()
    assert Layout.from_dict(PLAIN.to_dict()) == PLAIN
    assert Layout.from_dict(LAYOUT.to_dict()) == LAYOUT


def test_a_long_stream_halves_its_sums_and_reads_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is asked for is a ratio of sums, so that halving all of them changes nothing while the readings repeat."""
    x = np.tile(readings(1500, 3), (6, 1))
    long = SelfCalibration(LAYOUT).apply(x)
    monkeypatch.setattr(self_calibration, "MOST_WEIGHT", 1 << 16)
    halving = SelfCalibration(LAYOUT)
    out = halving.apply(x)
    (fit,) = halving._fits
    assert isinstance(fit, self_calibration.SphereFit) and 1 << 14 < fit._weight <= 1 << 16
    assert np.abs(out - long)[-1500:].mean() < 0.01 * UNIT and not np.array_equal(out, long)
    one_by_one = SelfCalibration(LAYOUT)
    assert [one_by_one.push(row) for row in x.tolist()] == out.tolist()


def test_without_such_sensors_samples_stay_as_they_are() -> None:
    x = readings(50, 1)
    plain = SelfCalibration(PLAIN)
    assert plain.apply(x).tolist() == x.tolist()
    assert list(plain.push(x[0].tolist())) == x[0].tolist()


PLUSH = load_layout("plush-15")
TOUCH = replace(PLUSH, self_calibration=PLUSH.names)  # ten channels alone, and an accelerometer


def touches(n: int, seed: int) -> NDArray[np.int64]:
    """Readings (n, 13): channels that are touched for one second of four, and an accelerometer."""
    rng = np.random.default_rng(seed)
    touched = (np.arange(n)[:, None] // 100 + np.arange(10)) % 4 == 1
    # A hand is less still than nothing; where it is not, what is rest may depend on rounding.
    x = 4000.0 + 20_000.0 * touched + rng.normal(size=(n, 10)) * np.where(touched, 1500.0, 40.0)
    return np.concatenate([np.rint(x).astype(np.int64), readings(n, seed)], axis=1)


@settings(max_examples=8)
@given(st.integers(0, 1 << 20), st.floats(0.2, 5.0), st.integers(-100_000, 100_000))
def test_other_channels_with_any_gain_and_offset_give_the_same(seed: int, gain: float, offset: int) -> None:
    x = touches(2500, seed)
    plain = SelfCalibration(TOUCH).apply(x)[:, :10]
    changed = x.copy()
    changed[:, :10] = np.rint(x[:, :10] * gain + offset)
    other = SelfCalibration(TOUCH).apply(changed)[:, :10]
    # Until the spread is that of touch, it is a multiple of the noise, which is rounded more where the gain is small.
    assert np.abs(other - plain)[2000:].max() <= 0.02 * UNIT
    state = SelfCalibration(TOUCH)
    assert [state.push(row)[:10] for row in changed.tolist()] == other.tolist()


def test_a_touched_channel_reads_zero_at_rest_and_one_when_touched() -> None:
    x = touches(6000, 1)
    out = SelfCalibration(TOUCH).apply(x)[3000:, 0]
    touched = x[3000:, 0] > 14_000
    assert abs(np.median(out[~touched])) < 0.02 * UNIT
    assert np.median(out[touched]) == pytest.approx(UNIT, rel=0.1)
    still = np.rint(np.random.default_rng(1).normal(700.0, 6.0, (3000, 13))).astype(np.int64)
    assert np.abs(SelfCalibration(TOUCH).apply(still)[:, :10]).max() < 0.8 * UNIT, "noise is no touch"
