"""The frames that are made up for golden vectors and scenarios: what they hold, and how sensors fail in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.deploy.golden import FrameGenerator, measured
from plushsense.deploy.quantize import integer_network
from plushsense.runtime.fixed import Ints
from plushsense.runtime.health import Health, HealthSettings
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler
from support.exports import bundle_of

BUNDLE = bundle_of("accel-3")
LAYOUT = BUNDLE.layout
LOW, HIGH = LAYOUT.valid_min_int.tolist(), LAYOUT.valid_max_int.tolist()


def generator(seed: int = 1) -> FrameGenerator:
    return FrameGenerator(LAYOUT, BUNDLE.scaler, np.random.default_rng(seed))


def rows(made: FrameGenerator) -> Ints:
    return np.array(made.rows, dtype=np.int64)


def test_touches_wander_about_the_mean_of_the_training() -> None:
    made = generator()
    made.touches(4000)
    frames = rows(made)
    assert frames[0, 0] == 1000 and np.diff(frames[:, 0]).mean() == pytest.approx(10, abs=0.1), "100 Hz, on average"
    assert set(np.diff(frames[:, 0]).tolist()) == {8, 9, 10, 11, 12}
    away = (frames[:, 1:] - made.mean) / made.spread
    assert np.abs(away.mean(axis=0)).max() < 0.5 and np.all((away.std(axis=0) > 0.8) & (away.std(axis=0) < 2.0))
    # A drift: over ten frames they go much less far than over a thousand, also where nothing oscillates.
    calm = np.flatnonzero((np.arange(3000) // 61 % 3 == 0) & ((np.arange(3000) + 10) // 61 % 3 == 0))
    near, far = (np.abs(away[calm + step] - away[calm]).mean() for step in (10, 15 * 61))
    assert near < 0.75 * far


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_troubles_come_as_often_as_asked(share: float) -> None:
    def frames(**trouble: float) -> Ints:
        made = generator()
        made.touches(2000, **trouble)  # type: ignore[arg-type]
        return rows(made)

    assert len(frames(lost=share)) == pytest.approx(2000 * (1 - share), abs=60 * (share > 0))
    assert (np.diff(frames(equal=share)[:, 0]) == 0).mean() == pytest.approx(share, abs=0.03 * (share > 0))
    garbage = frames(garbage=share)[:, 1:]
    outside = (garbage < LOW) | (garbage > HIGH)
    assert outside.mean(axis=0) == pytest.approx([share] * 3, abs=0.03 * (share > 0))
    quiet, struck = (np.abs(frames(blows=blows)[:, 1:] - generator().mean).max() for blows in (0.0, share))
    assert struck > 3 * quiet if share else struck == quiet


def test_one_channel_is_stuck_or_garbage_and_the_others_go_on() -> None:
    made = generator()
    made.touches(200, stuck={1: 77})
    made.touches(200, garbage_channel=2)
    values = rows(made)[:, 1:]
    assert set(values[:200, 1]) == {77} and len(set(values[200:, 1])) > 50
    outside = (values < LOW) | (values > HIGH)
    assert not outside[:, :2].any() and outside[200:, 2].all() and not outside[:200].any()


@pytest.mark.parametrize(("low", "high"), [(a, b) for a in (LOW[0], -20_000) for b in (20_000, HIGH[0])])
def test_sensors_fail_whichever_limits_tell_it(low: int, high: int) -> None:
    """Stuck above the usual values or below them, else out of the valid range; then gone; then frozen."""
    settings = HealthSettings((low,) * 3, (high,) * 3, fault_ms=200, still_ms=300, recover_ms=100)
    made = generator()
    made.touches(50)
    made.troubles(settings, 60)
    health, faults, last = Health(settings, LAYOUT), list[str](), None
    for ms, *values in made.rows:
        if last is not None and not 0 <= ms - last <= LAYOUT.gap_ms:
            health.clear()
        last, said = ms, health.push(ms, values)
        faults += [said] if said else []
    assert faults == ["fault", "recovered"] * 3


def test_halves_lie_between_two_values_with_different_codes() -> None:
    network = integer_network(BUNDLE)
    made = generator()
    made.halves(400, network.inputs)
    frames = rows(made)
    assert len(frames) == 200 and set(np.diff(frames[:, 0]).tolist()) == {20}
    (segment,) = resample(Frames(frames[:, 1:], frames[:, 0]), LAYOUT)
    between = segment.data[1::4]  # from the first of a pair to the second
    assert len(between) == 100
    codes = [network.inputs.apply(between - down)[:, :3] for down in (0, 1)]
    assert (codes[0] != codes[1]).all(), "rounding down would be seen"


def test_means_and_spreads_are_those_of_the_inputs_in_raw_numbers() -> None:
    layout = load_layout("plush-15")
    scaler = Scaler(np.array([*range(100, 110), 320.0]), np.array([*[0.5] * 9, 4.0, 0.01]))
    mean, spread = measured(layout, scaler)
    at = {name: layout.index(name) for name in layout.names}
    direct = [at[name] for name in layout.inputs[:10]]
    assert mean[direct].tolist() == list(range(100, 110)) and spread[direct].tolist() == [*[2.0] * 9, 1.0]
    # A magnitude of 320 / 16 in all is 20 / √3 an axis.
    axes = [at[name] for name in layout.derived[0].of]
    assert mean[axes] == pytest.approx([20 / 3**0.5] * 3) and spread[axes] == pytest.approx([100 / 16 / 3**0.5] * 3)
    shifted = replace(layout, channels=tuple(replace(c, offset=c.offset + 5) for c in layout.channels))
    assert (measured(shifted, scaler)[0] - mean).tolist() == pytest.approx([5.0] * len(mean))
