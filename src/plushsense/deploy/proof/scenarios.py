"""Test scenarios: variants of an exported model whose decision rules often apply, to test the rules in the C; patches.

On generated frames the rules of a trained model rarely apply, so that an error in their C would not be detected. A
scenario keeps the layers and the input scale of the model. It shifts and scales the logits so that each class is
sometimes the best one, changes affects and idle classes, and chooses the thresholds of health, gate and events from
quantiles of the generated frames. Patches of the last layer are offered to the model itself, and its sensors, if they
calibrate themselves, are exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.deploy.golden import (
    ANSWER,
    COLUMNS,
    HEAD,
    TRACKING,
    Call,
    FrameGenerator,
    Vectors,
    answers_of,
    answers_over_patches,
    measured,
    samples_of,
)
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import NO_GESTURE, ONE, EventSettings
from plushsense.runtime.fixed import LOGIT_LIMIT, PROBABILITY_BITS, Ints, LogitScale, known_score, split_ratio
from plushsense.runtime.gate import JERK, LEVEL, Gate, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import HEAD_BYTES, MAGIC, PATCH_MAGIC, IntegerModel, image_head, patch_bytes
from plushsense.runtime.integer import IntegerDense
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler, network_inputs

_SPREAD = 450  # of a logit over the frames, in steps of 1/256
_INSIDE = 8  # margin at each end of a valid range, in which a sensor can be stuck
_AFFECTS: tuple[tuple[str, bool], ...] = (
    ("positive", False),
    ("neutral", True),
    ("negative", False),
    ("none", False),
    ("neutral", False),
)


@dataclass(frozen=True)
class _ScenarioSettings:
    """Settings of a scenario.

    Attributes:
        gate: whether the model has a gate.
        often: whether the gate fires often.
        near: whether events end just below the probability at which they begin; else far below it, so that most are
            replaced by other events.
        end, hold: lowest and highest value of these event settings, in steps.
        smoothing: weight of a new step, in steps of 2^-15.
    """

    gate: bool
    often: bool
    near: bool
    end: tuple[int, int]
    hold: tuple[int, int]
    smoothing: int


SCENARIO_SETTINGS = (
    _ScenarioSettings(True, False, True, (1, 2), (5, 9), 12_000),
    _ScenarioSettings(True, True, False, (3, 4), (1, 4), 6000),
    _ScenarioSettings(False, False, True, (3, 3), (0, 2), 1 << PROBABILITY_BITS),
    _ScenarioSettings(False, False, False, (4, 8), (1, 4), 16_000),
)


def scenarios_of(model: IntegerModel, scaler: Scaler, repeat: int = 0) -> list[Vectors]:
    """Generate a scenario for each of `SCENARIO_SETTINGS`; deterministic, different for each ``repeat``."""
    return [
        _scenario(replace(model, rules=Rules(), gestures=_gestures(model, settings)), scaler, settings, seed)
        for seed, settings in enumerate(SCENARIO_SETTINGS, 1 + repeat * len(SCENARIO_SETTINGS))
    ]


# What ``plush_patch`` returns.
OK, NOT_A_MODEL, DAMAGED, OTHER_MODEL = 0, 1, 3, 6


def patches_of(model: IntegerModel, scaler: Scaler) -> Vectors:
    """Generate frames between which patches of the model's last layer are used, refused and undone."""
    dense, arch = model.network.dense, model.network.arch
    scale = LogitScale(*(np.roll(getattr(dense.scale, name), 1) for name in ("before", "multiplier", "after")))
    rolled = IntegerDense(np.roll(dense.weights, 1, axis=0), np.roll(dense.bias, 1), scale)
    halved = replace(rolled, weights=(rolled.weights // 2).astype(np.int8), bias=rolled.bias // 2)
    adapted = [replace(model, network=replace(model.network, dense=layer)) for layer in (rolled, halved)]
    first, second = (patch_bytes(model, other) for other in adapted)
    body = second[HEAD_BYTES:]

    def sealed(changed: bytes) -> bytes:
        """Return a patch with a valid checksum."""
        return image_head(changed, PATCH_MAGIC, model.image_version) + changed

    offers: list[tuple[bytes, int, IntegerDense | None]] = [
        (first, OK, rolled),
        (second[:-1] + bytes([second[-1] ^ 1]), DAMAGED, rolled),
        (sealed(bytes([body[0] ^ 1]) + body[1:]), OTHER_MODEL, rolled),
        (sealed(body[:8] + b"\xff\xff" + body[10:]), DAMAGED, rolled),  # a multiplier of more than 15 bits
        (second, OK, halved),
        (sealed(body[:-1]), OTHER_MODEL, halved),
        (MAGIC + first[len(MAGIC) :], NOT_A_MODEL, halved),
        (b"", OK, None),
    ]
    generator = FrameGenerator(model.layout, scaler, np.random.default_rng(1))
    generator.touches(arch.span + 60)
    cuts = []
    for n in range(len(offers)):
        cuts.append(len(generator.rows))
        generator.touches(4 * arch.step + 20)
        if n == 0:  # a restart keeps the patch
            generator.wait(model.layout.gap_ms + 1)
            generator.touches(arch.span + 60)
    frames = np.array(generator.rows, dtype=np.int64)
    layers = [None, *(layer for _, _, layer in offers)]
    parts = list(zip(layers, np.split(frames, cuts), strict=True))
    rows = np.concatenate(answers_over_patches(model, parts, [status for _, status, _ in offers]))
    patches = tuple((cut - 1, patch) for cut, (patch, _, _) in zip(cuts, offers, strict=True))
    return Vectors("patch", frames, rows, samples_of(frames, model.layout), patches=patches)


def exchanges_of(model: IntegerModel, scaler: Scaler) -> Vectors:
    """Generate frames over glitches, resets of the clock, a reboot with another sensor, and an exchange of sensors."""
    generator, part = FrameGenerator(model.layout, scaler, np.random.default_rng(1)), model.network.arch.span + 300
    calls = []
    generator.touches(part)
    generator.strays()
    generator.now = 7
    generator.touches(part)
    generator.now = 3
    for way in (1, -1):  # first with a reboot, then in the middle of the stream
        calls.append(Call(len(generator.rows) - 1, "recalibrate"))
        generator.mean = generator.mean + 3 * way * generator.spread
        generator.spread = generator.spread * 2.0**-way
        generator.touches(part)
    frames = np.array(generator.rows, dtype=np.int64)
    answers = answers_of(model, frames, calls)
    return Vectors("exchange", frames, answers, samples_of(frames, model.layout), calls=tuple(calls))


def _scenario(plain: IntegerModel, scaler: Scaler, settings: _ScenarioSettings, seed: int) -> Vectors:
    rng = np.random.default_rng(seed)
    health = _health(plain, scaler, rng)
    frames, calls = (_troubled if settings.gate else _calm)(plain, scaler, health, rng)
    level = _NormalizedModel(plain, _logits(answers_of(plain, frames)))
    gate = _gate(plain, frames, settings.often, rng) if settings.gate else GateSettings()
    rules = Rules(_events(level, settings, rng), gate, health)
    model = replace(level.model, smoothing=settings.smoothing, rules=rules)
    answers = answers_of(model, frames, calls)
    return Vectors("scenario", frames, answers, samples_of(frames, model.layout), model, calls)


def _logits(rows: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the logits (n, K) of the answers after the warm-up."""
    classes = (rows.shape[1] - HEAD) // 2
    tracking = (rows[:, 0] == ANSWER) & (rows[:, COLUMNS[ANSWER].index("state")] == TRACKING)
    return rows[tracking, HEAD : HEAD + classes].astype(np.float64)


def _gestures(model: IntegerModel, settings: _ScenarioSettings) -> GestureSet:
    # With ``near``, varied affects; else mostly the same, so that most events are replaced by one of the same affect.
    more = (0, 2, 4, 0, 2, 1) if settings.near else (0, 0, 0, 2, 0, 1)
    affects = [_AFFECTS[k if k < 5 else more[k % 6]] for k in range(len(model.gestures))]
    gestures = tuple(
        Gesture(g.label, affect, idle=idle) for g, (affect, idle) in zip(model.gestures.gestures, affects, strict=True)
    )
    return GestureSet(model.gestures.name, gestures)


class _NormalizedModel:
    """A model with a new last layer, so that the logits (n, K) of all classes have mean 0 and the same spread.

    ``shares`` (n,) are the probabilities of the best class, ``known`` (n,) the known scores.
    """

    def __init__(self, model: IntegerModel, logits: NDArray[np.float64]) -> None:
        dense = model.network.dense
        mean, spread = logits.mean(axis=0), np.maximum(logits.std(axis=0), 1.0)
        gain = np.clip(_SPREAD / spread, 1 / 64, 64)
        bias, rows = dense.bias.copy(), []
        for k in range(len(gain)):
            before, multiplier, after = (int(getattr(dense.scale, n)[k]) for n in ("before", "multiplier", "after"))
            ratio = max(multiplier, 1) / 2.0 ** (before + after)
            bias[k] -= round(float(mean[k]) / ratio)
            rows.append(split_ratio(ratio * gain[k], 2 * LOGIT_LIMIT / (ratio * gain[k])))
        try:
            level = IntegerDense(dense.weights, bias, LogitScale(*np.array(rows, dtype=np.int64).T))
            self.model = replace(model, network=replace(model.network, dense=level))
            logits = (logits - mean) * gain
        except BundleError:  # a sum could leave 32 bits
            self.model = model
        logits = np.clip(logits, -LOGIT_LIMIT, LOGIT_LIMIT)
        self.known = known_score(np.rint(logits).astype(np.int64), np.array([g.idle for g in model.gestures.gestures]))
        self.shares = ONE / np.exp((logits - logits.max(axis=1, keepdims=True)) / 256).sum(axis=1)


def _events(level: _NormalizedModel, settings: _ScenarioSettings, rng: np.random.Generator) -> EventSettings:
    def share(low: float, high: float) -> int:
        """Return a random quantile of the shares."""
        return int(np.quantile(level.shares, rng.uniform(low, high)))

    def steps(low: int, high: int) -> int:
        return int(rng.integers(low, high + 1))

    enter = share(0.35, 0.6)
    return EventSettings(
        enter=enter,
        leave=enter if settings.near else share(0.0, 0.05) // 2,
        enter_affect=share(0.4, 0.7),
        leave_affect=share(0.1, 0.4),
        sure=int(rng.integers(ONE // 8, ONE // 3)),
        known=int(np.quantile(level.known, 0.12)),
        least=steps(2, 3),
        switch=steps(2, 4),
        end=steps(*settings.end),
        hold=steps(*settings.hold),
        rest=steps(1, 4),
        wait=steps(2, 6),
    )


def _health(model: IntegerModel, scaler: Scaler, rng: np.random.Generator) -> HealthSettings:
    """Return limits about six spreads from the mean, which do not include the ends of the valid range."""
    layout = model.layout
    mean, spread = measured(layout, scaler)
    inside = np.minimum(_INSIDE, (layout.valid_max_int - layout.valid_min_int) // 2)
    ends = layout.valid_min_int + inside, layout.valid_max_int - inside
    low, high = (np.clip(np.rint(mean + way * spread), *ends).astype(np.int64) for way in (-6, 6))
    times = {name: int(rng.integers(80, 260)) for name in ("fault_ms", "still_ms", "recover_ms")}
    return HealthSettings(tuple(low.tolist()), tuple(high.tolist()), **times)


def _troubled(
    model: IntegerModel, scaler: Scaler, health: HealthSettings, rng: np.random.Generator
) -> tuple[Ints, tuple[Call, ...]]:
    """Generate frames with impacts and failing sensors, also during warm-up; return them and the calls."""
    layout, span = model.layout, model.network.arch.span
    generator, calls = FrameGenerator(layout, scaler, rng), list[Call]()
    part = span + 400
    generator.touches(part, blows=0.02, garbage=0.05 / len(generator.mean))
    for _ in range(4):
        generator.touches(int(rng.integers(20, 60)), blows=0.05)
        calls.append(Call(len(generator.rows) - 1, "silence"))
    generator.touches(200, lost=0.03, blows=0.02)
    generator.strays()
    for n in range(40):
        generator.touches(7)
        generator.frozen(4)
        if n % 2:  # otherwise the gate only prolongs its event
            calls.append(Call(len(generator.rows) - 1, "silence"))
    for _ in range(3):
        generator.touches(30, blows=0.2)
        generator.wait(layout.gap_ms + 1)
    generator.touches(part, blows=0.03)
    generator.troubles(health, span + 250)
    generator.now = 7
    generator.touches(part, garbage=0.15 / len(generator.mean), blows=0.02)
    return np.array(generator.rows, dtype=np.int64), tuple(calls)


def _calm(
    model: IntegerModel, scaler: Scaler, health: HealthSettings, rng: np.random.Generator
) -> tuple[Ints, tuple[Call, ...]]:
    """Generate frames with long touches and some suspect frames; return them and the calls."""
    generator, calls = FrameGenerator(model.layout, scaler, rng), list[Call]()
    generator.touches(model.network.arch.span)
    for n in range(24):
        generator.touches(80, garbage=(0.08 if n % 2 else 0.01) / len(generator.mean))
        # A silence, or another sensitivity; now and then the toy was asleep and is primed.
        calls.append(Call(len(generator.rows) - 1, "silence"))
        generator.touches(1)
        calls.append(Call(len(generator.rows) - 1, "sensitivity", int(rng.integers(-128, 128)) if n % 3 else 0))
        generator.touches(90)
        if n % 8 == 7:
            generator.wait(2 * model.layout.gap_ms)
            generator.touches(1)
            calls.append(Call(len(generator.rows) - 1, "prime"))
    return np.array(generator.rows, dtype=np.int64), tuple(calls)


def _gate(model: IntegerModel, frames: Ints, often: bool, rng: np.random.Generator) -> GateSettings:
    """Return a gate with signals of every kind and thresholds that the frames exceed sometimes, or ``often``."""
    arch, layout = model.network.arch, model.layout
    segments = [network_inputs(s.data, layout) for s in resample(Frames(frames[:, 1:], frames[:, 0]), layout) if len(s)]
    rows = max(segments, key=len)
    reach = int(np.abs(rows).max()).bit_length()

    def some(n: int) -> tuple[int, ...]:
        return tuple(int(i) for i in rng.integers(0, arch.channels, n))

    several, lag = some(min(3, arch.channels)), int(rng.integers(2, 5))
    signals = (
        Signal(JERK, several, lag=lag, shift=max(0, reach - 18), baseline=3, noise=4, floor=2),
        Signal(JERK, some(2), lag=1, shift=max(0, reach - 12), baseline=6, noise=6, floor=1),
        Signal(LEVEL, some(1), shift=max(0, reach - 20), baseline=5, noise=5, floor=3),
        Signal(LEVEL, some(1), shift=max(0, reach - 8), baseline=2, noise=7, floor=4),
    )
    loud = Rule((Term(0, 1 << 25),), 0, NO_GESTURE)
    gate = Gate(GateSettings(signals, (loud,)))
    sizes = np.array([(gate.push(row), list(gate.sizes))[1] for row in rows.tolist()])

    def term(signal: int, quantile: float, sign: int, times: int) -> Term:
        return Term(signal, max(1, int(np.quantile(sizes[:, signal], quantile, method="lower"))), sign, times)

    gesture = int(rng.integers(0, arch.classes))
    more = (Rule((term(1, 0.5, 1, 4),), 2, NO_GESTURE, within=0, deaf=3),) if often else ()
    return GateSettings(
        signals,
        (
            Rule((term(0, 0.97, 1, 2), term(2, 0.8, 0, 1)), 3, NO_GESTURE, within=3, deaf=int(rng.integers(5, 25))),
            Rule((term(3, 0.9, -1, 3), term(1, 0.9, 0, 1)), 1, gesture, within=6, deaf=int(rng.integers(0, 12))),
            Rule((term(2, 0.93, 1, 2), term(3, 0.5, 0, 1), term(1, 0.5, 1, 1)), 0, NO_GESTURE, within=4, deaf=30),
            *more,
        ),
    )
