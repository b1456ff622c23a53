"""Made-up frames: what a toy may meet at its worst, for golden vectors and drills. Nobody's recording."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from plushsense.core.signal import MAGNITUDE_FRACTION_BITS, Layout
from plushsense.models.fixed import InputScale
from plushsense.models.health import HealthPlan
from plushsense.windows.features import Scaler

Ints = NDArray[np.int64]
_MS_BITS = 32
_SEARCHED = 4096  # numbers on each side of a channel's mean
_INT32 = -(1 << 31), (1 << 31) - 1


def golden_frames(
    layout: Layout,
    scaler: Scaler,
    span: int,
    seed: int = 1,
    inputs: InputScale | None = None,
    health: HealthPlan | None = None,
) -> Ints:
    """Frames (n, 1 + C) that try what can go wrong: the first column is the toy's clock in ms.

    Each part lasts longer than ``span``, so that every restart is followed by answers: touches and blows with a
    jittering clock and lost frames; values out of range (also from the start, where there is no valid one yet); gaps
    just bridged and just too long; equal stamps; a clock that starts again; channels at the ends of their range, and
    jumping between them; sensors that fail and recover as the ``health`` settings tell it; the clock's wrap at 2^32.
    With the scale of the ``inputs``, also samples in the middle between two whole numbers of which one is read as the
    next 8-bit number: there a wrong rounding shows.
    """
    make = Maker(layout, scaler, np.random.default_rng(seed))
    part = span + 150
    make.touches(6, garbage_channel=0)
    make.touches(part + 300, lost=0.03, blows=0.02)
    make.touches(part, garbage=0.05)
    make.wait(layout.gap_ms)
    make.touches(60)
    make.wait(layout.gap_ms + 1)
    make.touches(part, equal=0.1, blows=0.01)
    make.now = 5
    make.touches(part)
    for kind in ("low", "high", "jump"):
        make.extremes(span + 30, kind)
    if inputs is not None:
        make.wait(layout.gap_ms + 1)
        make.halves(part, inputs)
    make.touches(part)
    if health is not None:
        make.troubles(health, part)
    make.now = (1 << _MS_BITS) - 1 - part * 6
    make.touches(part + 300, blows=0.02)
    return np.array(make.rows, dtype=np.int64)


class Maker:
    """Frames one after the other; ``now`` is the next one's time in ms."""

    def __init__(self, layout: Layout, scaler: Scaler, rng: np.random.Generator) -> None:
        self.layout, self.rng = layout, rng
        self.low, self.high = layout.valid_min_int, layout.valid_max_int
        self.mean, self.spread = measured(layout, scaler)
        self.rows: list[list[int]] = []
        self.now = 1000
        self._owed = 0.0
        self._walk = np.zeros(len(self.mean))
        self._blow = np.zeros(len(self.mean))
        self._phase = rng.uniform(0, 6, len(self.mean))

    def pace(self) -> int:
        """Milliseconds to the next frame, on the average one period."""
        self._owed += self.layout.period_us / 1000
        whole = int(self._owed)
        self._owed -= whole
        return whole

    def wait(self, ms: int) -> None:
        """The next frame comes so long after the last one."""
        self.now = self.rows[-1][0] + ms

    def put(self, values: Ints) -> None:
        self.rows.append([self.now & 0xFFFFFFFF, *values.tolist()])

    def touches(
        self,
        n: int,
        *,
        lost: float = 0.0,
        garbage: float = 0.0,
        equal: float = 0.0,
        blows: float = 0.0,
        garbage_channel: int | None = None,
        stuck: dict[int, int] | None = None,
    ) -> None:
        """Something like gestures: a slow wandering, at times a rhythm, noise, and blows that die away.

        ``lost``, ``garbage`` (of a channel), ``equal`` (stamps) and ``blows`` are how likely each is in a frame;
        ``stuck`` holds channels at one value.
        """
        rng, c = self.rng, len(self.mean)
        for k in range(n):
            self._walk = 0.98 * self._walk + 0.2 * rng.normal(size=c)
            self._blow *= 0.6
            if blows and rng.random() < blows:
                self._blow = rng.normal(size=c) * 12
            rhythm = np.sin(len(self.rows) * (0.05 + 0.02 * (k // 97 % 9)) + self._phase) * (k // 61 % 3)
            wanted = self.mean + self.spread * (self._walk + self._blow + rhythm + 0.1 * rng.normal(size=c))
            values = np.clip(np.rint(wanted), self.low, self.high).astype(np.int64)
            spoilt = np.flatnonzero(rng.random(c) < garbage)
            if garbage_channel is not None:
                spoilt = np.array([garbage_channel])
            for channel in spoilt:
                values[channel] = self._garbage(int(channel))
            for held, value in (stuck or {}).items():
                values[held] = value
            if rng.random() >= lost:
                self.put(values)
            if rng.random() >= equal:
                self.now += max(0, self.pace() + int(rng.integers(-2, 3)))

    def frozen(self, n: int) -> None:
        """The same frame again and again."""
        for _ in range(n):
            self.put(np.array(self.rows[-1][1:], dtype=np.int64))
            self.now += self.pace()

    def frames_of(self, ms: int) -> int:
        """How many frames come in so long a time."""
        return -(-ms * 1000 // self.layout.period_us)

    def troubles(self, health: HealthPlan, after: int) -> None:
        """Sensors that fail for long enough, and recover: ``after`` frames of touches stand after each failure.

        A channel out of range or stuck beyond what touches reach, first for a moment only; then all of them frozen;
        then good frames too few to be believed, and a gap amid the failure.
        """
        few, enough = self.frames_of(health.fault_ms) // 2, self.frames_of(health.fault_ms + health.recover_ms) + 20
        back = self.frames_of(health.recover_ms) + after
        if health.fault_ms:
            ends = self._beyond(health)
            self.touches(few + 3, stuck=ends)
            self.touches(30)
            self.touches(enough, stuck=ends)
            self.touches(self.frames_of(health.recover_ms) // 2)
            self.touches(20, garbage=0.5)
            self.touches(back, blows=0.02)
            self.touches(enough, garbage_channel=len(self.mean) - 1)
            self.wait(self.layout.gap_ms + 40)
            self.touches(back)
        if health.still_ms:
            self.frozen(self.frames_of(health.still_ms) * 3 // 4)
            self.wait(self.layout.gap_ms + 10)
            self.frozen(4)
            self.touches(self.frames_of(health.still_ms) // 2)
            self.frozen(self.frames_of(health.still_ms) + 20)
            self.now = 40
            self.touches(back, blows=0.02)

    def _beyond(self, health: HealthPlan) -> dict[int, int]:
        """A channel and a value at which it cannot be stuck; where every value may be, one that is out of range."""
        for channel, (high, most) in enumerate(zip(health.high, self.high.tolist(), strict=False)):
            if high < most:
                return {channel: min(int(most), high + 3)}
        for channel, (low, least) in enumerate(zip(health.low, self.low.tolist(), strict=False)):
            if low > least:
                return {channel: max(int(least), low - 3)}
        return {0: self._garbage(0)}

    def extremes(self, n: int, kind: str) -> None:
        """At the ends of the ranges, and beside them: sensors that repeat an end exactly would be at fault."""
        for k in range(n):
            top = kind == "high" or (kind == "jump" and bool(k // 3 % 2))
            beside = np.minimum(k % 2, self.high - self.low)
            self.put(self.high - beside if top else self.low + beside)
            self.now += self.pace()

    def halves(self, n: int, inputs: InputScale) -> None:
        """Frames two periods apart, for n samples: those between two frames lie half a number beside an edge."""
        apart, rest = divmod(2 * self.layout.period_us, 1000)
        if rest or not 0 < apart <= self.layout.gap_ms:
            return
        edges = self._edges(inputs)
        for _ in range(n // 4):
            first = np.rint(np.clip(self.mean, self.low, self.high)).astype(np.int64)
            second = first.copy()
            for channel, found in edges.items():
                edge, swing = int(self.rng.choice(found)), int(self.rng.integers(0, 40))
                first[channel], second[channel] = edge + swing, edge - 1 - swing
            for values in (first, second):
                self.put(np.clip(values, self.low, self.high))
                self.now += apart

    def _edges(self, inputs: InputScale) -> dict[int, Ints]:
        """For each measured channel that is an input, the numbers near its mean that are the first of an 8-bit one."""
        names = self.layout.inputs
        around = np.zeros((2 * _SEARCHED, len(names)), dtype=np.int64)
        direct = {i: self.layout.index(n) for i, n in enumerate(names) if n in self.layout.names}
        for i, channel in direct.items():
            around[:, i] = np.arange(-_SEARCHED, _SEARCHED) + round(float(self.mean[channel]))
        codes = inputs.apply(around)
        found = {}
        for i, channel in direct.items():
            edges = around[1:, i][codes[1:, i] != codes[:-1, i]]
            inside = edges[(edges > self.low[channel] + 41) & (edges < self.high[channel] - 41)]
            if len(inside):
                found[channel] = inside
        return found

    def _garbage(self, channel: int) -> int:
        """A value out of the channel's range, where 32 bits have one."""
        low, high = int(self.low[channel]), int(self.high[channel])
        outside = [v for v in (low - 1, high + 1, *_INT32) if not low <= v <= high and _INT32[0] <= v <= _INT32[1]]
        return int(self.rng.choice(outside)) if outside else int(self.rng.integers(low, high))


def measured(layout: Layout, scaler: Scaler) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and spread of each measured channel that the scaling of the inputs speaks of."""
    c = len(layout.channels)
    mean, spread = np.zeros(c), np.full(c, 100.0)
    derived = {d.name: d.of for d in layout.derived}
    for name, offset, scale in zip(layout.inputs, scaler.offset, scaler.scale, strict=True):
        parts = derived.get(name, (name,))
        unit = len(parts) ** 0.5 * (1 << MAGNITUDE_FRACTION_BITS) if name in derived else 1.0
        for part in parts:
            mean[layout.index(part)] = offset / unit
            spread[layout.index(part)] = max(1.0, 1 / scale / unit)
    return mean, spread
