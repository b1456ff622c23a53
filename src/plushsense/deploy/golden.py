"""Golden vectors: frames that a toy may meet at its worst, and what the rooms that define a toy say to them.

The frames are made up: an export is given away, and no person's recording belongs in it.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.signal import MAGNITUDE_FRACTION_BITS, Layout
from plushsense.models.events import AFFECT_CODES, EventMachine, Update
from plushsense.models.fixed import InputScale
from plushsense.models.gate import Gate
from plushsense.models.health import Health, HealthPlan
from plushsense.models.image import IntegerModel
from plushsense.windows.clock import Clock
from plushsense.windows.features import SampleInputs, Scaler

FRAMES, ANSWERS = "frames.bin", "answers.bin"
ANSWER, EVENT, HEALTH = range(3)
# The columns of a row by its kind; those of logits and probabilities follow, 0 but in an answer.
COLUMNS = {
    ANSWER: (
        *("kind", "frame", "ms", "sample", "state", "gesture", "affect", "confidence", "answer", "known"),
        *("restarts", "invalid"),
    ),
    EVENT: (
        *("kind", "frame", "ms", "number", "what", "gesture", "affect", "source", "since", "unused"),
        *("restarts", "invalid"),
    ),
    HEALTH: (
        *("kind", "frame", "ms", "faults", "state", "suspect", "unused", "unused", "unused", "unused"),
        *("restarts", "invalid"),
    ),
}
HEAD = len(COLUMNS[ANSWER])
WARMING, TRACKING, FAULT = range(3)
_KINDS = {
    ANSWER: "an answer",
    EVENT: "something that happened to an event",
    HEALTH: "health says something else than at the frame before",
}
Ints = NDArray[np.int64]
_MS_BITS = 32
_SEARCHED = 4096  # numbers on each side of a channel's mean
_INT32 = -(1 << 31), (1 << 31) - 1


def column(rows: NDArray[Any], name: str, kind: int = ANSWER) -> NDArray[Any]:
    """One column of the rows of a kind."""
    found: NDArray[Any] = rows[rows[:, 0] == kind][:, COLUMNS[kind].index(name)]
    return found


def answers_of(model: IntegerModel, frames: Ints, silences: Container[int] = ()) -> NDArray[np.int32]:
    """What the toy says to frames (n, 1 + C), the first column its clock in ms: rows (m, 12 + 2 K) int32.

    A row is an answer, something that happened to an event, or a change of what health says; its columns are those of
    `COLUMNS`, then the K logits in steps of 1/256 and the K smoothed probabilities in steps of 2^-27, which are 0 but
    in an answer of a toy that tracks, as everything from gesture to known. ``frame`` is the row of the frame that
    brought it about, ``restarts`` and ``invalid`` the counts until then; times and counts wrap at 2^32. What happens to
    an event in a step stands before the step's answer, what health says after all else of its frame.

    Args:
        silences: the frames after which nothing is heard for a while (``plush_silence``).
    """
    return _Toy(model).rows_of(frames, silences)


class _Toy:
    """Drives the rooms that define a toy as `plushsense.live.stream.StreamReader` does, in the C's own clock."""

    def __init__(self, model: IntegerModel) -> None:
        arch, rules = model.network.arch, model.rules
        self.model, self.arch = model, arch
        self.affects = [AFFECT_CODES[g.affect] for g in model.gestures.gestures]
        self.clock, self.inputs, self.stepper = Clock(model.layout), SampleInputs(model.layout), model.network.stepper()
        self.health, self.gate = Health(rules.health, model.layout), Gate(rules.gate)
        self.machine = EventMachine(rules.events, model.smoothing, model.gestures)
        self.rows: list[list[int]] = []
        self.frame = self.seen = 0
        self.restart()

    def restart(self) -> None:
        self.stepper.reset()
        self.gate.reset()
        self.block: list[list[int]] = []
        self.count = 0

    def rows_of(self, frames: Ints, silences: Container[int]) -> NDArray[np.int32]:
        for self.frame, (ms, *values) in enumerate(frames.tolist()):
            said = self.health.fault, self.health.suspect
            self.push(ms, values)
            now = self.health.fault, self.health.suspect
            if now != said:
                state = FAULT if now[0] else TRACKING if self.count >= self.arch.span else WARMING
                self.say(HEALTH, ms, self.health.faults, state, int(now[1]))
            if self.frame in silences:
                self.tell(self.machine.lost(self.seen))
        table = np.array(self.rows, dtype=np.int64).reshape(len(self.rows), HEAD + 2 * self.arch.classes)
        return (table & 0xFFFFFFFF).astype(np.uint32).view(np.int32)

    def say(self, kind: int, ms: int, *what: int, logits: Sequence[int] = (), mean: Sequence[int] = ()) -> None:
        counts = self.clock.restarts, self.clock.invalid
        blank = [0] * self.arch.classes
        row = [
            kind,
            self.frame,
            ms,
            *what,
            *[0] * (HEAD - 5 - len(what)),
            *counts,
            *(logits or blank),
            *(mean or blank),
        ]
        self.rows.append(row)

    def tell(self, updates: Sequence[Update]) -> None:
        for u in updates:
            self.say(EVENT, u.now, u.number, u.kind, u.gesture, u.affect, u.source, u.since)

    def push(self, ms: int, values: list[int]) -> None:
        clock, health, layout = self.clock, self.health, self.model.layout
        if ms < self.seen or ms - self.seen > layout.gap_ms:
            self.tell(self.machine.lost(self.seen))
            health.clear()
        self.seen = ms
        found = health.push(ms, values)
        if found == "fault":
            self.tell(self.machine.lost(ms))
        if found:
            clock.forget()
            self.restart()
        if health.fault:
            return
        samples = clock.push(ms, values)
        if clock.restarted:
            self.restart()
        for later, sample in zip(range(len(samples) - 1, -1, -1), samples, strict=True):
            self.sample(((clock.now_us or 0) - later * layout.period_us) // 1000, sample)

    def sample(self, ms: int, sample: Ints) -> None:
        arch, suspect = self.arch, self.health.suspect
        self.count += 1
        inputs = self.inputs(sample)
        fired = self.gate.push(inputs, suspect)
        if fired >= 0:
            rule = self.model.rules.gate.rules[fired]
            self.tell(self.machine.gate(rule.affect, rule.gesture, ms))
        self.block.append(inputs)
        if self.count % arch.step != arch.span % arch.step:
            return
        logits = self.stepper.push(np.array(self.block, dtype=np.int64))
        self.block = []
        if not logits:
            self.tell(self.machine.blind_step(ms))
            self.say(ANSWER, ms, self.count, WARMING)
            return
        answer, updates = self.machine.step(logits[-1], ms, suspect)
        self.tell(updates)
        best = answer.best, self.affects[answer.best], answer.share, answer.kind, answer.known
        mean = self.machine.mean
        assert mean is not None
        self.say(ANSWER, ms, self.count, TRACKING, *best, logits=logits[-1].tolist(), mean=mean[:-1].tolist())


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


def write_golden(model: IntegerModel, scaler: Scaler, folder: Path) -> list[Path]:
    """Write the golden vectors into a folder: `FRAMES`, `ANSWERS` and what they hold."""
    span, inputs = model.network.arch.span, model.network.inputs
    frames = golden_frames(model.layout, scaler, span, inputs=inputs, health=model.rules.health)
    answers = answers_of(model, frames)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / FRAMES).write_bytes((frames & 0xFFFFFFFF).astype("<u4").tobytes())
    (folder / ANSWERS).write_bytes(answers.astype("<i4").tobytes())
    classes = model.network.arch.classes
    kinds = "\n".join(f"  - {kind}, {what}: {', '.join(COLUMNS[kind][1:])}" for kind, what in _KINDS.items())
    (folder / "README.md").write_text(
        f"""# Golden vectors

Made up, no person's recording: {len(frames)} frames with blows, lost frames, garbage, gaps, clock resets, sensors that
fail and a wrap of the clock, and the {len(answers)} rows that PlushSense says to them. `plushsense verify` feeds them
to the C in this export and compares every number.

- `{FRAMES}`: rows of 32-bit little-endian numbers: the toy's clock in ms (unsigned), then the measured channels
  ({", ".join(model.layout.names)}).
- `{ANSWERS}`: rows of {HEAD + 2 * classes} 32-bit little-endian numbers. The first is the row's kind, and tells what
  the next {HEAD - 1} are:
{kinds}

  `frame` is the frame that brought it about. After them stand {classes} logits in steps of 1/256 and {classes} smoothed
  probabilities in steps of 2^-27. From gesture to known, logits and probabilities are 0 while warming; the last two are
  0 in rows of another kind than {ANSWER}.
""",
        encoding="utf-8",
        newline="\n",
    )
    return [folder / FRAMES, folder / ANSWERS, folder / "README.md"]


def read_golden(folder: Path, channels: int, classes: int) -> tuple[Ints, NDArray[np.int32]]:
    """The frames (n, 1 + C) and rows (m, 12 + 2 K) of a folder.

    Raises:
        BadInput: for a file that is missing or does not hold whole rows.
    """
    found = []
    for name, columns, kind in ((FRAMES, 1 + channels, "<i4"), (ANSWERS, HEAD + 2 * classes, "<i4")):
        path = folder / name
        try:
            data = path.read_bytes()
        except OSError as cause:
            raise BadInput(f"The golden vectors '{path}' cannot be read ({cause}): export the model again.") from None
        if not data or len(data) % (4 * columns):
            raise BadInput(
                f"The golden vectors '{path}' have {len(data)} bytes, which are no whole rows of {columns} numbers: "
                "export the model again."
            )
        found.append(np.frombuffer(data, dtype=kind).reshape(-1, columns))
    frames = found[0].astype(np.int64)
    frames[:, 0] &= 0xFFFFFFFF
    return frames, found[1].astype(np.int32)
