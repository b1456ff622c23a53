"""Deployed models and frames out of thin air, for the tests of the fixed point and of the C: nothing is trained."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from plushsense.core.gestures import AFFECTS, Gesture, GestureSet
from plushsense.core.layouts import MOST_CALIBRATED_OTHER, Channel, CsvFormat, Derived, Layout, magnitude_limit
from plushsense.models.arch import POOLINGS, Arch, ConvLayer, VectorLayer
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import NO_GESTURE, EventSettings
from plushsense.runtime.fixed import InputScale, LogitScale, Requantize, split_ratio
from plushsense.runtime.gate import JERK, LEVEL, MOST_SIZE, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.integer import (
    MOST_DOWN,
    MOST_REACH,
    IntegerDense,
    IntegerLayer,
    IntegerNetwork,
    IntegerVectors,
    down_for,
)

Ints = NDArray[np.int64]
INT32 = -(1 << 31), (1 << 31) - 1
RANGES = (INT32, (-2000, INT32[1]), (0, 1023), (-3, 3), (5, 5), (-40_000, 70_000), (-2000, 1_000_000))
GRAVITY_RANGES = ((0, 1023), (-3, 3), (5, 5), (-32_768, 32_767), (-262_000, 262_000))
# In no decade round, in a whole number of ms, and where a period is a whole number of 1/100 or 1/200 ms.
RATES = (50.0, 62.5, 99.7, 100.0, 104.0, 333.3)


def any_layout(draw: st.DrawFn, calibrated: bool = False) -> Layout:
    """1 to 8 measured channels, up to 3 magnitudes, 1 to 11 inputs, each rate and gap; at times 1 or 2 vectors.

    With ``calibrated`` there is a vector, and the last or all calibrate themselves, beside any of the other channels.
    """
    ranges = draw(st.lists(st.sampled_from(RANGES), min_size=1, max_size=8))
    magnitudes = draw(st.lists(st.lists(st.integers(0, len(ranges) - 1), min_size=1, max_size=4), max_size=3))
    for of in magnitudes:
        limit = magnitude_limit(len(of))
        for i in of:
            ranges[i] = max(ranges[i][0], -limit), min(ranges[i][1], limit)
    channels = tuple(
        Channel(f"c{i}", "raw", "touch", valid_min=low, valid_max=high) for i, (low, high) in enumerate(ranges)
    )
    vectors = []
    for v in range(draw(st.sampled_from((1, 2) if calibrated else (0, 0, 1, 2)))):
        low, high = draw(st.sampled_from(GRAVITY_RANGES))
        zero = draw(st.integers(low, high))
        kind = draw(st.sampled_from(("acceleration", "angular rate"))) if calibrated and v == 1 else "acceleration"
        channels += tuple(Channel(f"v{v}{a}", "raw", kind, offset=zero, valid_min=low, valid_max=high) for a in "xyz")
        vectors.append(tuple(f"v{v}{a}" for a in "xyz"))
    themselves: tuple[str, ...] = ()
    if calibrated:
        themselves = tuple(a for v in vectors[-draw(st.integers(1, 2)) :] for a in v)
        fitting = [i for i, edges in enumerate(ranges) if max(map(abs, edges)) <= MOST_CALIBRATED_OTHER]
        themselves += tuple(f"c{i}" for i in fitting if draw(st.booleans()))
    derived = tuple(Derived(f"m{i}", "magnitude", tuple(f"c{k}" for k in of)) for i, of in enumerate(magnitudes))
    names = [c.name for c in channels] + [d.name for d in derived]
    inputs = draw(st.lists(st.sampled_from(names), min_size=1, max_size=11))
    layout = Layout(
        name="any",
        title="Any toy",
        rate_hz=draw(st.sampled_from(RATES)),
        channels=channels,
        wire=("device_ms", *(c.name for c in channels)),
        derived=derived,
        inputs=tuple(inputs),
        csv=CsvFormat(("device_ms",), ("device_ms",), ","),
        gap_ms=draw(st.sampled_from((30, 100, 250, 3000))),
        vectors=tuple(vectors),
        self_calibration=themselves,
    )
    return layout.for_vectors() if vectors else layout


def any_vectors(layer: VectorLayer, rng: np.random.Generator) -> IntegerVectors:
    """Random kernels, and shifts that leave the axes between some bits and too many."""
    shape = layer.vectors, layer.filters, layer.kernel
    weights = rng.integers(-128, 128, shape).astype(np.int8)
    if rng.random() < 0.2:
        weights = rng.choice(np.array([-128, 127], dtype=np.int8), shape)
    down = np.minimum(down_for(weights) + rng.choice([0, 0, 1, 12], shape[:2]), MOST_DOWN)
    return IntegerVectors(layer, rng.choice([-16, -2, 0, 3, 8, 16], layer.vectors), weights, down)


def any_network(arch: Arch, layout: Layout, rng: np.random.Generator) -> IntegerNetwork:
    """Random weights, with scales that mostly leave activations between 0 and 255, and at times anything allowed."""

    def scales(ratios: Ints | NDArray[np.float64], full: int) -> Ints:
        rows = [split_ratio(float(r), full / float(r)) for r in ratios]
        for i in np.flatnonzero(rng.random(len(rows)) < 0.05):
            rows[i] = int(rng.integers(31)), int(rng.integers(1 << 15)), int(rng.integers(31))
        return np.array(rows, dtype=np.int64).T

    def weights(*shape: int) -> NDArray[np.int8]:
        if rng.random() < 0.1:
            return rng.choice(np.array([-128, 127], dtype=np.int8), shape)
        return rng.integers(-128, 128, shape).astype(np.int8)

    def fitting(whole: NDArray[np.int8]) -> NDArray[np.int8]:
        """Weights whose sums fit, some of them just so."""
        inside = np.cumsum(np.abs(whole.astype(np.int64)).reshape(len(whole), -1), axis=1) <= MOST_REACH
        return whole * inside.reshape(whole.shape).astype(np.int8)

    def bias(typical: float, n: int) -> Ints:
        return np.asarray(rng.normal(size=n) * typical).astype(np.int64)

    columns = []
    vectors = None if arch.vector is None else any_vectors(arch.vector, rng)
    others = layout.inputs if arch.vector is None else layout.inputs[: arch.channels - arch.vector.axes]
    for _ in range(arch.inputs[0] - len(others)):
        ratio = 255 / 2 ** rng.uniform(6, 16)
        before, multiplier, after = split_ratio(ratio, 128 / ratio + 1, most_after=22)
        columns.append((int(rng.integers(-500, 500)), min(before, 16), multiplier, 100 << after, after))
    for name in others:
        derived = next((d for d in layout.derived if d.name == name), None)
        of = [layout.index(part) for part in (derived.of if derived else (name,))]
        low, high = int(layout.valid_min_int[of[0]]), int(layout.valid_max_int[of[0]])
        if derived:
            low, high = 0, int(16 * np.sqrt(len(of)) * max(abs(low), abs(high)))
        offset = int(rng.choice([low, high, (low + high) // 2, *INT32])) if rng.random() < 0.3 else (low + high) // 2
        ratio = 255 / max(high - low, 1) * float(np.exp(rng.normal()))
        before, multiplier, after = split_ratio(ratio, 128 / ratio + 1, most_after=22)
        before = min(before, 16)
        columns.append((offset, before, multiplier, int(rng.integers(-100, 255) * (1 << after)), after))
    layers = []
    for read, layer in zip(arch.inputs, arch.layers, strict=True):
        typical = 74 * 60 * np.sqrt(layer.kernel * read)
        ratios = 255 / (3 * typical) * np.exp(rng.normal(size=layer.filters) / 2)
        whole = fitting(weights(layer.filters, read, layer.kernel))
        layers.append(IntegerLayer(whole, bias(typical, layer.filters), Requantize(*scales(ratios, 255))))
    typical = 74 * 60 * np.sqrt(arch.features) * arch.pooled
    ratios = 1500 / typical * np.exp(rng.normal(size=arch.classes) / 2)
    dense = IntegerDense(
        weights(arch.classes, arch.features), bias(typical, arch.classes), LogitScale(*scales(ratios, 1 << 14))
    )
    return IntegerNetwork(arch, InputScale(*np.array(columns, dtype=np.int64).T), tuple(layers), dense, vectors)


def any_events(rng: np.random.Generator) -> EventSettings:
    """Settings that a random network reaches now and then."""

    def one(*of: int) -> int:
        return int(rng.choice(of))

    return EventSettings(
        enter=one(0, 8000, 16000, 30000, 32769),
        leave=one(0, 8000, 16000, 32769),
        enter_affect=one(0, 10000, 20000, 32769),
        leave_affect=one(0, 10000, 20000),
        sure=int(rng.integers(2000, 20000)),
        known=one(-(1 << 14), 0, 300, 1000, 1 << 14) if rng.random() < 0.5 else -(1 << 14),
        least=one(1, 2, 4),
        switch=one(1, 2, 5),
        end=one(1, 2, 5),
        hold=one(0, 1, 6),
        rest=one(0, 1, 6),
        wait=one(0, 3, 8),
    )


def any_health(layout: Layout, rng: np.random.Generator) -> HealthSettings:
    """With limits within the middle third of the ranges, or without; short times, some switched off."""
    low, high = layout.valid_min_int, layout.valid_max_int
    third = (high - low) // 3
    limits = (tuple((low + third).tolist()), tuple((high - third).tolist())) if rng.random() < 0.6 else ((), ())
    times = {"fault_ms": (0, 30, 100, 500), "still_ms": (0, 20, 41, 100), "recover_ms": (0, 50, 300)}
    return HealthSettings(*limits, **{name: int(rng.choice(some)) for name, some in times.items()})


def any_gate(arch: Arch, rng: np.random.Generator) -> GateSettings:
    """Up to 4 signals and 3 rules, also with the narrowest and widest of every setting."""

    def one(*of: int) -> int:
        return int(rng.choice(of))

    def signal() -> Signal:
        kind = one(LEVEL, JERK)
        several = tuple(int(i) for i in rng.integers(0, arch.channels, 1 if kind == LEVEL else one(1, 2, 5)))
        how = one(1, 2, 16), one(0, 3, 8, 20, 24), one(1, 3, 7, 15), one(1, 4, 8, 15), one(1, 10, 1000, 1 << 20)
        return Signal(kind, several, *how)

    signals = tuple(signal() for _ in range(one(1, 2, 4)))

    def rule() -> Rule:
        most = len(signals) - 1
        size = one(1, 8, 30, 100, MOST_SIZE)
        terms = [Term(int(rng.integers(0, most + 1)), size, one(-1, 0, 1), one(1, 2, 3)) for _ in range(one(1, 1, 2))]
        gesture = one(NO_GESTURE, int(rng.integers(0, arch.classes)))
        return Rule(tuple(terms), one(0, 1, 2, 3), gesture, one(0, 4, 255), one(0, 10, 50))

    return GateSettings(signals, tuple(rule() for _ in range(one(1, 2, 3))))


def any_rules(arch: Arch, layout: Layout, rng: np.random.Generator) -> Rules:
    """All, some or none of the rules."""
    gate = any_gate(arch, rng) if rng.random() < 0.7 else GateSettings()
    health = any_health(layout, rng) if rng.random() < 0.7 else HealthSettings(fault_ms=0)
    return Rules(any_events(rng) if rng.random() < 0.8 else EventSettings(), gate, health)


@st.composite
def models(draw: st.DrawFn, longest: int = 700, window: bool = False, calibrated: bool = False) -> IntegerModel:
    """Any model that fits the toy and whose span is at most ``longest`` samples; a ``window`` network has padding."""
    layout = any_layout(draw, calibrated)
    layers: list[ConvLayer] = []
    left = longest - 100
    vector = None
    if layout.vectors and not window:
        vector = VectorLayer(draw(st.integers(1, min(40, left // 2))), draw(st.integers(2, 9)), len(layout.vectors))
        left -= vector.reach
    for _ in range(draw(st.integers(1, 4))):
        dilation = draw(st.integers(1, 9))
        kernel = draw(st.integers(1, min(60, left // dilation + 1)))
        layers.append(ConvLayer(kernel, dilation, draw(st.integers(1, 20))))
        left -= layers[-1].reach
    step = draw(st.integers(1, 10))
    pooling = draw(st.sampled_from(POOLINGS))
    settings: dict[str, Any] = {"pool": step * draw(st.integers(1, 10)), "vector": vector, "pooling": pooling}
    if window:
        # Most reach back further than the shorter windows, so that samples are reflected again.
        samples = draw(st.integers(2, 40) | st.integers(2, longest))
        step, settings = min(step, samples), {"padding": "mirror", "window": samples}
    arch = Arch(tuple(layers), channels=layout.n_inputs, classes=draw(st.integers(2, 20)), step=step, **settings)
    rng = np.random.default_rng(draw(st.integers(0, 1 << 30)))
    idle = rng.random(arch.classes) < 0.2
    gestures = tuple(Gesture(f"gèste {i}", AFFECTS[i % 4], idle=bool(idle[i])) for i in range(arch.classes))
    smoothing = draw(st.sampled_from((1, 2, 5000, 32767, 1 << 15)))
    network, rules = any_network(arch, layout, rng), any_rules(arch, layout, rng)
    return IntegerModel(network, layout, GestureSet("any", gestures), smoothing, rules)


def any_frames(model: IntegerModel, seed: int, n: int | None = None, start: int | None = None) -> Ints:
    """Frames (n, 1 + C): a jittering clock that at times stands still, jumps, starts again or wraps, or has a single
    impossible time; values that wander, jump between the ends of their range, and leave it. Never so unruly that
    nothing is ever answered."""
    layout, rng = model.layout, np.random.default_rng(seed)
    low, high = layout.valid_min_int, layout.valid_max_int
    n = 2 * model.network.arch.span + 150 if n is None else n
    period = layout.period_us / 1000
    now = float(rng.choice([0, 1000, 2**31, 2**32 - n * period * 0.7])) if start is None else float(start)
    unruly, garbage = float(rng.choice([0, 0.5, 3])) / n, float(rng.choice([0, 0.01, 0.1]))
    wander = (low + high) / 2
    rows = []
    for row in range(n):
        kind = rng.random()
        if kind < unruly:
            now += float(rng.choice([layout.gap_ms, layout.gap_ms + 1, -30, -now, 10_000]))
        elif kind > 0.9:
            now += period * float(rng.choice([0, 0, 0.2, 2, 2.6]))
        else:
            now += period * float(rng.uniform(0.8, 1.2))
        wander = np.clip(wander + rng.normal(size=len(low)) * (high - low) / 30, low, high)
        values = np.rint(wander).astype(np.int64)
        ends = rng.random(len(low))
        values[ends < 0.02] = low[ends < 0.02]
        values[ends > 0.98] = high[ends > 0.98]
        for i in np.flatnonzero(rng.random(len(low)) < (0.5 if garbage and row < 4 else garbage)):
            values[i] = int(rng.choice([INT32[0], INT32[1], max(low[i] - 1, INT32[0]), min(high[i] + 1, INT32[1]), 0]))
        now = max(now, 0.0)
        rows.append([int(now) & 0xFFFFFFFF, *values.tolist()])
    strays = np.random.default_rng([seed, 1])
    for row in np.flatnonzero(strays.random(n) < unruly):
        rows[row][0] = int(strays.choice([0, 1, 2**31, 2**32 - 1]))
    return np.array(rows, dtype=np.int64)


def plain_model(seed: int = 1, **changes: Any) -> IntegerModel:
    """A small model of a plain toy: 4 channels, of which 3 are an accelerometer; changes go to its `Arch`."""
    axes = tuple(Channel(a, "mg", "motion", valid_min=-30_000, valid_max=30_000) for a in "xyz")
    layout = Layout(
        name="plain",
        title="A plain toy",
        rate_hz=100.0,
        channels=(Channel("ear", "raw", "touch", valid_min=-2000), *axes),
        wire=("device_ms", "ear", "x", "y", "z"),
        derived=(Derived("motion", "magnitude", ("x", "y", "z")),),
        inputs=("ear", "motion"),
        csv=CsvFormat(("device_ms",), ("device_ms",), ","),
    )
    settings: dict[str, Any] = {"channels": 2, "classes": 3, "step": 5, "pool": 20} | changes
    arch = Arch((ConvLayer(5, 2, 6), ConvLayer(4, 3, 5)), **settings)
    gestures = GestureSet("plain", tuple(Gesture(f"gesture {i}", AFFECTS[i % 4]) for i in range(arch.classes)))
    return IntegerModel(any_network(arch, layout, np.random.default_rng(seed)), layout, gestures, 5000)


def window_model(seed: int = 1, window: int = 40, **changes: Any) -> IntegerModel:
    """`plain_model` as a window network: its layers reach 8 and 9 samples back."""
    return plain_model(seed, **({"padding": "mirror", "window": window, "pool": None} | changes))


def vector_model(seed: int = 1) -> IntegerModel:
    """`plain_model` with a vector layer: 2 kernels of 3 taps with the largest weights."""
    plain = plain_model(seed)
    axes = tuple(replace(c, kind="acceleration") for c in plain.layout.channels[1:])
    layout = replace(plain.layout, channels=(plain.layout.channels[0], *axes), vectors=(("x", "y", "z"),)).for_vectors()
    made = {"vector": VectorLayer(3, 2, 1), "pooling": "mean+deviation"}
    arch = replace(plain.network.arch, channels=layout.n_inputs, **made)
    network = any_network(arch, layout, np.random.default_rng(seed))
    weights = np.full((1, 2, 3), 127, dtype=np.int8)
    vectors = IntegerVectors(VectorLayer(3, 2, 1), np.array([0]), weights, down_for(weights))
    return replace(plain, network=replace(network, vectors=vectors), layout=layout)


def ruled_model(seed: int = 1, **changes: Any) -> IntegerModel:
    """`plain_model` with every kind of rule, and an idle class."""
    model, rng = plain_model(seed, **changes), np.random.default_rng(seed)
    arch, gestures = model.network.arch, list(model.gestures.gestures)
    gestures[0] = replace(gestures[0], idle=True)
    low, high = model.layout.valid_min_int // 2, model.layout.valid_max_int // 2
    health = HealthSettings(tuple(low.tolist()), tuple(high.tolist()), fault_ms=200, still_ms=90, recover_ms=150)
    rules = Rules(any_events(rng), any_gate(arch, rng), health)
    return replace(model, gestures=GestureSet("ruled", tuple(gestures)), rules=rules)


def edged_model() -> IntegerModel:
    """A toy of two tiny channels in which every clamp and every rounding shows, and two classes always tie."""
    layout = Layout(
        name="edged",
        title="At every edge",
        rate_hz=100.0,
        channels=(
            Channel("small", "raw", "touch", valid_min=-3, valid_max=3),
            Channel("wide", "raw", "touch", valid_min=-40_000),
        ),
        wire=("device_ms", "small", "wide"),
        derived=(Derived("size", "magnitude", ("small", "small")),),
        inputs=("small", "wide", "size"),
        csv=CsvFormat(("device_ms",), ("device_ms",), ","),
    )
    arch = Arch((ConvLayer(1, 7, 9), ConvLayer(2, 3, 4)), channels=3, classes=9, step=1, pool=2)
    inputs = InputScale(
        offset=np.array([0, INT32[0], 24]),
        before=np.array([0, 16, 0]),
        multiplier=np.array([160, 32767, 32767]),
        bias=np.array([512, (1 << 30) - 1, -(1 << 30)]),
        after=np.array([2, 22, 11]),
    )
    weights = np.zeros((9, 3, 1), dtype=np.int8)
    weights[:4, 0, 0] = 1, 127, -128, 5
    weights[4:, 1:, 0] = [[1, 2], [127, 127], [-128, -128], [3, -3], [-2, 1]]
    bias = np.array([0, 3_000_000, 40_000, -700, 5, 60_000_000, -1, 300, 100])
    # Among them sums beyond 16 bits, halves that round up, no scaling at all, and the widest shifts.
    first = Requantize(
        before=np.array([0, 0, 0, 1, 0, 0, 30, 0, 2]),
        multiplier=np.array([1, 32767, 32767, 3, 16384, 7, 32767, 12345, 32767]),
        after=np.array([0, 30, 28, 2, 15, 10, 30, 13, 15]),
    )
    rng = np.random.default_rng(4)
    second = IntegerLayer(
        rng.integers(-128, 128, (4, 9, 2)).astype(np.int8),
        np.array([0, 20_000, -20_000, 4_000]),
        Requantize(np.array([0, 2, 1, 5]), np.array([300, 20_000, 9_999, 32_767]), np.array([16, 20, 19, 15])),
    )
    rows = rng.integers(-128, 128, (9, 4)).astype(np.int8)
    rows[1], rows[8] = rows[0], 0
    dense = IntegerDense(
        rows,
        np.array([9, 9, 0, 5_000_000, -5_000_000, 70_000, -70_000, 1, -3]),
        LogitScale(
            before=np.array([0, 0, 3, 0, 0, 0, 0, 30, 0]),
            multiplier=np.array([6000, 6000, 9000, 3000, 3000, 32767, 32767, 5, 3]),
            after=np.array([15, 15, 12, 15, 15, 15, 15, 0, 1]),
        ),
    )
    network = IntegerNetwork(arch, inputs, (IntegerLayer(weights, bias, first), second), dense)
    gestures = GestureSet("edged", tuple(Gesture(f"gesture {i}", AFFECTS[i % 4]) for i in range(9)))
    return IntegerModel(network, layout, gestures, 20_000)
