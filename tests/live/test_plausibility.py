"""What differs between a toy and the training is reported once, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.deploy.quantize import Ranges
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.live.plausibility import PlausibilityMonitor, gravity_in_training, ranges_in_training
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import StreamClassifier
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.health import HealthSettings
from plushsense.windows.features import InputUnits, Scaler, network_inputs

RATE_HZ = 50.0
HAND = Layout.from_dict(
    {
        "name": "hand",
        "rate_hz": RATE_HZ,
        "channels": [
            {"name": "press", "unit": "N", "kind": "force", "step": 0.01},
            *(
                {"name": name, "unit": "m/s²", "kind": "acceleration", "step": 0.001, "valid_min": -80, "valid_max": 80}
                for name in ("x", "y", "z")
            ),
        ],
        "wire": ["device_ms", "press", "x", "y", "z"],
        "vectors": [["x", "y", "z"]],
    }
)


def movement(seed: int, n: int = 1500, gravity: float = 9.81) -> np.ndarray:
    """Steps (n, 4): a press of 0 to 5 N, and a toy that lies, is turned and lies again, shaken in between."""
    rng = np.random.default_rng(seed)
    angle = np.interp(np.arange(n), (0, n / 3, n / 2, n), (0.0, 0.0, 1.5, 1.5))
    shaken = np.where((np.arange(n) > n / 3) & (np.arange(n) < n / 2), 6.0, 0.02)
    axes = gravity * np.stack([np.sin(angle), 0.1 + 0 * angle, np.cos(angle)], axis=1)
    axes += rng.normal(0.0, 1.0, (n, 3)) * shaken[:, None] * gravity / 9.81
    press = np.maximum(0.0, 5.0 * np.sin(np.arange(n) / 25.0)) + rng.normal(0.0, 0.01, n)
    return np.rint(np.column_stack([press / 0.01, axes / 0.001])).astype(np.int64)


def bundle_of(layout: Layout, values: np.ndarray, *, health: bool = True) -> Bundle:
    """A bundle whose scaling and ranges are those of ``values``, with random weights."""
    inputs = network_inputs(values, layout).T[None]
    scaler = Scaler.fit(inputs, layout.input_vectors)
    gestures = load_gestures("plush-18")
    arch = Arch.parse("5d1_4d3", (6, 5), channels=layout.n_inputs, classes=len(gestures), window=48, step=5)
    bundle = Bundle(arch, random_weights(arch, 3), layout, scaler, gestures)
    if health:
        low, high = (tuple(edge.tolist()) for edge in (values.min(axis=0), values.max(axis=0)))
        return replace(bundle, decision=DecideSpec(health=HealthSettings(low, high)).to_dict())
    scaled = scaler.apply(inputs)[0]
    ranges = Ranges(scaled.min(axis=1), scaled.max(axis=1), (), (), np.empty(0))
    return replace(bundle, calibration=ranges.to_dict())


def reported(bundle: Bundle, values: np.ndarray, period_ms: float = 20.0) -> list[str]:
    monitor = PlausibilityMonitor(bundle.layout, bundle)
    frames = [Frame(0, round(k * period_ms), tuple(row)) for k, row in enumerate(values.tolist())]
    # As in real time, a few frames come at once.
    return [str(s) for at in range(0, len(frames), 7) for s in monitor.push(frames[at : at + 7])]


LAYOUTS = {"axes": HAND, "gravity": HAND.for_vectors()}


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_same_toy_is_not_reported(name: str) -> None:
    bundle = bundle_of(LAYOUTS[name], movement(1))
    assert reported(bundle, movement(2)) == []
    assert gravity_in_training(bundle, [1, 2, 3]) == (pytest.approx(9860, rel=0.15), name == "gravity")


def test_gravity_of_another_unit_or_range_is_reported_once() -> None:
    bundle = bundle_of(HAND.for_vectors(), movement(1))
    for gravity, reads, why in (
        (0.98, "0.98", "it seems to send g, not m/s²"),
        (19.62, "19.7", "its unit or measuring range is another"),
        (0.0, "0", "gravity seems to be subtracted, or the sensor is dead"),
    ):
        told = reported(bundle, np.concatenate([movement(seed, gravity=gravity) for seed in (2, 3)]))
        assert len(told) == 1, told
        assert told[0].startswith(f"At rest the accelerometer (x, y, z) reads {reads}")
        assert why in told[0]
        assert "in the training it read 9.8" in told[0] or "in the training it read 9.9" in told[0]


def test_another_unit_is_reported_for_a_network_without_gravity_too() -> None:
    bundle = bundle_of(replace(HAND, vectors=()), movement(1))
    assert reported(bundle, movement(2)) == []
    told = [text for text in reported(bundle, movement(2, gravity=0.98)) if text.startswith("At rest")]
    assert len(told) == 1 and "it seems to send g" in told[0]


@pytest.mark.parametrize("scaled", [True, False])
def test_a_toy_that_is_held_the_other_way_round_is_not_reported(scaled: bool) -> None:
    values = movement(1)
    bundle = bundle_of(HAND, np.concatenate([values[:450], values[800:]]))  # lying, in two directions
    if not scaled:
        bundle = replace(bundle, scaler=Scaler.none(InputUnits.of(HAND), HAND.input_vectors))
    held = movement(2)
    held[:, 1:] *= -1
    assert reported(bundle, held) == []


def test_gravity_that_the_training_did_not_have_is_not_compared() -> None:
    values = movement(1, gravity=0.0)
    values[:, 1:] += np.rint(np.random.default_rng(5).normal(0, 3000, (len(values), 3))).astype(int)
    bundle = bundle_of(HAND.for_vectors(), values)
    assert gravity_in_training(bundle, [1, 2, 3]) is None
    assert reported(bundle, movement(2, gravity=0.0)) == []


def test_gravity_is_known_from_a_magnitude() -> None:
    plush = load_layout("plush-15")
    values = np.zeros((2000, plush.n_channels), dtype=np.int64)
    axes = [plush.index(name) for name in ("acc_x", "acc_y", "acc_z")]
    values[:, axes] = np.random.default_rng(1).normal((0, 0, 16384), 900, (2000, 3)).astype(int)
    assert gravity_in_training(bundle_of(plush, values), axes) == (pytest.approx(16384, rel=0.02), True)


def test_a_self_calibrated_sensor_is_not_compared() -> None:
    layout = replace(HAND.for_vectors(), self_calibration=("x", "y", "z"))
    bundle = replace(bundle_of(HAND.for_vectors(), movement(1)), layout=layout)
    assert reported(bundle, movement(2, gravity=0.98)) == []


@pytest.mark.parametrize("health", [True, False])
def test_a_channel_out_of_the_range_of_the_training_for_seconds_is_reported_once(health: bool) -> None:
    bundle = bundle_of(HAND, movement(1), health=health)
    low, high = ranges_in_training(bundle)
    assert low[0] < 0 and 500 < high[0] < 600
    values = movement(2)
    values[200:320, 0] = 900  # 2.4 s
    assert reported(bundle, values) == [], "a moment is no other sensor"
    values[400:, 0] = 900 + values[400:, 0]
    told = reported(bundle, values)
    assert len(told) == 1
    assert told[0].startswith("For 3 s press reads ") and f"outside {low[0] / 100:g} to" in told[0]


def test_an_end_stop_that_the_training_reached_is_in_range() -> None:
    values = movement(1)
    bundle = bundle_of(HAND, values)
    held = movement(2)
    held[300:, 0] = values[:, 0].max() + 1
    assert reported(bundle, held) == []


def test_another_rate_and_a_clock_that_stands_are_reported() -> None:
    bundle = bundle_of(HAND, movement(1))
    assert reported(bundle, movement(2), period_ms=21.0) == []
    assert reported(bundle, movement(2), period_ms=100.0)[0].startswith("The toy sends 10 frames a second by its clock")
    assert reported(bundle, movement(2), period_ms=20_000.0)[0].startswith("The toy sends 0.05 frames a second")
    assert reported(bundle, movement(2), period_ms=0.0)[0].startswith("The toy's clock stands still")


@pytest.mark.slow
def test_live_warns_and_sums_up(tmp_path: Path) -> None:
    bundle = bundle_of(HAND.for_vectors(), movement(1))
    values = movement(2, gravity=0.98)
    clock = np.arange(len(values), dtype=np.int64) * 20
    path = tmp_path / "tap_1700000000000_1500.csv"
    write_recording(path, Frames(values, clock, clock + 1_700_000_000_000), HAND)
    warned: list[str] = []
    with open_device(f"replay://{path.as_posix()}?speed=0", bundle.layout) as device:
        live = run_live(device, StreamClassifier(bundle), warn=warned.append)
        decisions = list(live)
    assert len(decisions) > 100, "nothing is refused"
    assert len(warned) == 1 and "it seems to send g" in warned[0]
    assert live.summary().warnings == tuple(warned)
    with (
        open_device(f"replay://{path.as_posix()}?speed=0", bundle.layout) as device,
        pytest.warns(UserWarning, match="At rest the accelerometer"),
    ):
        assert list(run_live(device, StreamClassifier(bundle))) == decisions
