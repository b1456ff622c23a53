"""Generate frames for golden vectors and test scenarios, and compute the expected answers.

No recordings are used, because exports are given to others and must not contain a person's data.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.files import read_bytes
from plushsense.core.layouts import MAGNITUDE_FRACTION_BITS, Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.templates import fill_text
from plushsense.runtime.events import AFFECT_CODES
from plushsense.runtime.fixed import InputScale, Ints
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import IntegerModel, memory_bytes
from plushsense.runtime.integer import IntegerDense
from plushsense.runtime.machine import Moment, ToyMachine
from plushsense.windows.clock import resample
from plushsense.windows.features import Scaler

_MS_BITS = 32
_MOST_BYTES = 256 << 20  # of a file of golden vectors
_SEARCHED = 4096  # numbers on each side of a channel's mean
_INT32 = -(1 << 31), (1 << 31) - 1


def golden_frames(
    layout: Layout,
    scaler: Scaler,
    span: int,
    seed: int = 1,
    inputs: InputScale | None = None,
    health: HealthSettings | None = None,
) -> Ints:
    """Generate frames (n, 1 + C) that cover the edge cases; the first column is the toy's clock in ms.

    The parts are touches and blows with clock jitter and lost frames; values out of range (also before the first valid
    one); gaps that are just short enough and just too long; equal time stamps; impossible times; a clock that is reset;
    channels at the ends of their ranges and jumping between them; sensors that fail and recover by the ``health``
    settings; the clock's wrap at 2^32. If ``inputs`` is given, also interpolated samples half-way between two values
    with different 8-bit codes, where a rounding error has effect. Each part is longer than ``span``, so that answers
    follow every restart.
    """
    generator = FrameGenerator(layout, scaler, np.random.default_rng(seed))
    part = span + 150
    generator.touches(6, garbage_channel=0)
    generator.touches(part + 300, lost=0.03, blows=0.02)
    generator.touches(part, garbage=0.05)
    generator.touches(60, lost=0.6)
    generator.strays()
    generator.touches(part)
    generator.wait(layout.gap_ms)
    generator.touches(60)
    generator.wait(layout.gap_ms + 1)
    generator.touches(part, equal=0.1, blows=0.01)
    generator.now = 5
    generator.touches(part)
    for kind in ("low", "high", "jump"):
        generator.extremes(span + 30, kind)
    if inputs is not None:
        generator.wait(layout.gap_ms + 1)
        generator.halves(part, inputs)
    generator.touches(part)
    if health is not None:
        generator.troubles(health, part)
    generator.now = (1 << _MS_BITS) - 1 - part * 6
    generator.touches(part + 300, blows=0.02)
    return np.array(generator.rows, dtype=np.int64)


class FrameGenerator:
    """Generates frames into ``rows``; ``now`` is the time of the next one in ms."""

    def __init__(self, layout: Layout, scaler: Scaler, rng: np.random.Generator) -> None:
        self.layout, self.rng = layout, rng
        self.low, self.high = layout.valid_min_int, layout.valid_max_int
        self.mean, self.spread = measured(layout, scaler)
        self.rows: list[list[int]] = []
        self.now = 1000
        self._period_ms = layout.period_us / 1000
        self._fraction = 0.0
        self._walk = np.zeros(len(self.mean))
        self._blow = np.zeros(len(self.mean))
        self._phase = rng.uniform(0, 6, len(self.mean))

    def pace(self) -> int:
        """Return the milliseconds to the next frame, one period on average."""
        self._fraction += self._period_ms
        whole = int(self._fraction)
        self._fraction -= whole
        return whole

    def wait(self, ms: int) -> None:
        """Set the next frame's time to ``ms`` after the last one."""
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
        """Add ``n`` frames similar to gestures: a slow drift, temporary oscillation, noise, and decaying impacts.

        ``lost``, ``garbage`` (for each channel), ``equal`` (time stamps) and ``blows`` are probabilities per frame;
        ``stuck`` maps channels to constant values.
        """
        rng, c = self.rng, len(self.mean)
        low, high = self.low.astype(np.float64), self.high.astype(np.float64)
        for k in range(n):
            self._walk = 0.98 * self._walk + 0.2 * rng.normal(size=c)
            self._blow *= 0.6
            if blows and rng.random() < blows:
                self._blow = rng.normal(size=c) * 12
            rhythm = np.sin(len(self.rows) * (0.05 + 0.02 * (k // 97 % 9)) + self._phase) * (k // 61 % 3)
            signal = self.mean + self.spread * (self._walk + self._blow + rhythm + 0.1 * rng.normal(size=c))
            values = np.minimum(np.maximum(np.rint(signal), low), high).astype(np.int64)
            drawn = rng.random(c)
            if garbage_channel is not None:
                values[garbage_channel] = self._garbage(garbage_channel)
            elif garbage:
                for channel in np.flatnonzero(drawn < garbage).tolist():
                    values[channel] = self._garbage(channel)
            for stuck_channel, value in (stuck or {}).items():
                values[stuck_channel] = value
            if rng.random() >= lost:
                self.put(values)
            if rng.random() >= equal:
                self.now += max(0, self.pace() + int(rng.integers(-2, 3)))

    def stray(self, ms: int, *, zeros: bool = False) -> None:
        """Add a frame with the impossible time ``ms``, of a touch or of ``zeros``; then time goes on as before it."""
        following = self.now
        self.now = ms
        self.touches(1)
        if zeros:
            self.rows[-1][1:] = [0] * len(self.mean)
        self.now = following + self.pace()

    def strays(self) -> None:
        """Add frames with impossible times: three single ones, which are bridged, some a little early, which are left
        out however many they are, and two in turn, which restart.
        """
        for zeros in (False, True):
            self.touches(20)
            self.stray(0, zeros=zeros)
        self.touches(20)
        self.stray(self.now + 40_000)
        self.touches(20)
        gap = self.layout.gap_ms
        for early_ms in ((1, 8), (gap, gap), (3, gap + 1), (gap + 1, 2)):
            seen = self.rows[-1][0]
            for ms in early_ms:
                self.stray(seen - ms)
            self.touches(2)
        self.touches(20)
        self.stray(0)
        self.stray(self.now + 80_000)

    def frozen(self, n: int) -> None:
        """Repeat the last frame ``n`` times."""
        for _ in range(n):
            self.put(np.array(self.rows[-1][1:], dtype=np.int64))
            self.now += self.pace()

    def frames_in(self, ms: int) -> int:
        """Return the number of frames in ``ms`` milliseconds, rounded up."""
        return -(-ms * 1000 // self.layout.period_us)

    def troubles(self, health: HealthSettings, after: int) -> None:
        """Add sensor failures long enough to be detected, each followed by recovery and ``after`` frames of touches.

        A channel is out of range, or stuck outside the range of touches, first only briefly; then all channels are
        frozen. There are also too few good frames for a recovery, and a gap during a failure.
        """
        few, enough = self.frames_in(health.fault_ms) // 2, self.frames_in(health.fault_ms + health.recover_ms) + 20
        back = self.frames_in(health.recover_ms) + after
        if health.fault_ms:
            ends = self._beyond(health)
            self.touches(few + 3, stuck=ends)
            self.touches(30)
            self.touches(enough, stuck=ends)
            self.touches(self.frames_in(health.recover_ms) // 2)
            self.touches(20, garbage=0.5)
            self.touches(back, blows=0.02)
            self.touches(enough, garbage_channel=len(self.mean) - 1)
            self.wait(self.layout.gap_ms + 40)
            self.touches(back)
        if health.still_ms:
            self.frozen(self.frames_in(health.still_ms) * 3 // 4)
            self.wait(self.layout.gap_ms + 10)
            self.frozen(4)
            self.touches(self.frames_in(health.still_ms) // 2)
            self.frozen(self.frames_in(health.still_ms) + 20)
            self.now = 40
            self.touches(back, blows=0.02)

    def _beyond(self, health: HealthSettings) -> dict[int, int]:
        """Return a channel and a value at which it counts as stuck, or, if there is none, one out of range."""
        for channel, (high, most) in enumerate(zip(health.high, self.high.tolist(), strict=False)):
            if high < most:
                return {channel: min(int(most), high + 3)}
        for channel, (low, least) in enumerate(zip(health.low, self.low.tolist(), strict=False)):
            if low > least:
                return {channel: max(int(least), low - 3)}
        return {0: self._garbage(0)}

    def extremes(self, n: int, kind: str) -> None:
        """Add frames at the ends of the valid ranges; every other one is 1 away, so that none counts as stuck."""
        for k in range(n):
            top = kind == "high" or (kind == "jump" and bool(k // 3 % 2))
            beside = np.minimum(k % 2, self.high - self.low)
            self.put(self.high - beside if top else self.low + beside)
            self.now += self.pace()

    def halves(self, n: int, inputs: InputScale) -> None:
        """Add frames two periods apart, for ``n`` samples, so that interpolated values lie half a step from an edge."""
        interval_ms, rest = divmod(2 * self.layout.period_us, 1000)
        if rest or not 0 < interval_ms <= self.layout.gap_ms:
            return
        edges = self._edges(inputs)
        for _ in range(n // 4):
            first = np.rint(np.clip(self.mean, self.low, self.high)).astype(np.int64)
            second = first.copy()
            for channel, values_at_edges in edges.items():
                edge, swing = int(self.rng.choice(values_at_edges)), int(self.rng.integers(0, 40))
                first[channel], second[channel] = edge + swing, edge - 1 - swing
            for values in (first, second):
                self.put(np.clip(values, self.low, self.high))
                self.now += interval_ms

    def _edges(self, inputs: InputScale) -> dict[int, Ints]:
        """Return, for each input channel, the values near its mean at which the 8-bit code changes."""
        names = self.layout.inputs
        around = np.zeros((2 * _SEARCHED, len(inputs)), dtype=np.int64)
        axes = {i for vector in self.layout.input_vectors for i in vector} if len(inputs) != len(names) else set()
        direct = {i: self.layout.index(n) for i, n in enumerate(names) if n in self.layout.names and i not in axes}
        for i, channel in direct.items():
            around[:, i] = np.arange(-_SEARCHED, _SEARCHED) + round(float(self.mean[channel]))
        codes = inputs.apply(around)
        by_channel = {}
        for i, channel in direct.items():
            edges = around[1:, i][codes[1:, i] != codes[:-1, i]]
            inside = edges[(edges > self.low[channel] + 41) & (edges < self.high[channel] - 41)]
            if len(inside):
                by_channel[channel] = inside
        return by_channel

    def _garbage(self, channel: int) -> int:
        """Return a value out of the channel's range, if there is one in 32 bits."""
        low, high = int(self.low[channel]), int(self.high[channel])
        outside = [v for v in (low - 1, high + 1, *_INT32) if not low <= v <= high and _INT32[0] <= v <= _INT32[1]]
        return int(self.rng.choice(outside)) if outside else int(self.rng.integers(low, high))


def measured(layout: Layout, scaler: Scaler) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and spread of each measured channel, from the scaler of the inputs; 0 and a unit if it has none."""
    c = len(layout.channels)
    mean, spread = np.zeros(c), np.full(c, 100.0)
    derived = {d.name: d.of for d in layout.derived}
    means = scaler.offset if scaler.knows_training(layout) else np.zeros(len(scaler.offset))
    kinds = zip(layout.inputs, layout.input_kinds, means, scaler.scale, strict=True)
    for name, kind, offset, scale in kinds:
        if kind == "gravity":
            continue
        parts = derived.get(name, (name,))
        unit = len(parts) ** 0.5 * (1 << MAGNITUDE_FRACTION_BITS) if name in derived else 1.0
        for part in parts:
            mean[layout.index(part)] = offset / unit
            spread[layout.index(part)] = max(1.0, 1 / scale / unit)
    if "gravity" in layout.input_kinds:
        # Vectors are scaled from zero: the toy stands upright.
        for vector in layout.vectors:
            mean[layout.index(vector[-1])] = spread[layout.index(vector[-1])]
    return mean + layout.zero_int, spread


FRAMES, ANSWERS = "frames.bin", "answers.bin"
ANSWER, EVENT, HEALTH, PATCH = range(4)
_COUNTS = ("restarts", "invalid", "bad_stamps", "interpolated", "interval", "sparse")
# The columns of each kind of row; logits and probabilities follow, which are 0 except in answers.
COLUMNS = {
    kind: ("kind", "frame", "ms", *own, *["unused"] * (7 - len(own)), *_COUNTS)
    for kind, own in {
        ANSWER: ("sample", "state", "gesture", "affect", "confidence", "answer", "known"),
        EVENT: ("number", "what", "gesture", "affect", "source", "since"),
        HEALTH: ("faults", "state", "suspect"),
        PATCH: ("status",),
    }.items()
}
HEAD = len(COLUMNS[ANSWER])
WARMING, TRACKING, FAULT = range(3)
_KINDS = {
    ANSWER: "an answer",
    EVENT: "a change of an event",
    HEALTH: "a change of the sensor health",
}


def column(rows: NDArray[Any], name: str, kind: int = ANSWER) -> NDArray[Any]:
    """Return one column of the rows of a kind."""
    return np.asarray(rows[rows[:, 0] == kind][:, COLUMNS[kind].index(name)])


class Call(NamedTuple):
    """A call of the toy after the frame with the index ``frame``; ``value`` is the sensitivity that is set."""

    frame: int
    action: Literal["silence", "prime", "sensitivity", "recalibrate"]
    value: int = 0


def answers_of(model: IntegerModel, frames: Ints, calls: Sequence[Call] = ()) -> NDArray[np.int32]:
    """Compute the rows (m, 16 + 2 K) int32 that the toy returns for frames (n, 1 + C), whose first column is in ms.

    A row is an answer, a change of an event, or a change of the sensor health. It has the columns of `COLUMNS`, then K
    logits in steps of 1/256 and K smoothed probabilities in steps of 2^-27. These and the columns ``gesture`` to
    ``known`` are 0 in an answer before the toy tracks. ``frame`` is the index of the frame that caused the row,
    ``restarts`` to ``sparse`` are those of the clock up to then; times and counts wrap at 2^32. Changes of events come
    before the answer of the same step, changes of health after all other rows of the frame.

    Args:
        calls: what is called between the frames: ``plush_silence``, ``plush_prime`` with the frame before,
            ``plush_recalibrate``, or a change of the sensitivity.
    """
    return ToyRows(model).read(frames, calls)


def answers_over_patches(
    model: IntegerModel, parts: Sequence[tuple[IntegerDense | None, Ints]], statuses: Sequence[int] = ()
) -> list[NDArray[np.int32]]:
    """Compute the toy's rows when the dense layer of its model is replaced during a stream (``plush_patch``).

    Args:
        parts: each dense layer, None for the model's own, with the frames (n, 1 + C) that are read with it.
        statuses: what ``plush_patch`` returns before each part but the first; each is a row after the rows of the part
            before, with the kind `PATCH` and the index and time of its last frame. Empty: no such rows.

    Returns:
        The rows of each part, as from `answers_of`. The state is kept, so that the next step uses the new layer.
    """
    rows, tables = ToyRows(model), list[NDArray[np.int32]]()
    for n, (dense, frames) in enumerate(parts):
        rows.network.patch(dense)
        rows.feed(frames)
        if n < len(statuses):
            rows.add_patch(int(frames[-1, 0]), statuses[n])
        tables.append(rows.take())
    return tables


class ToyRows:
    """The rows of `answers_of` for one stream, piece by piece; ``frame`` is the index of the current frame."""

    def __init__(self, model: IntegerModel, frame: int = 0) -> None:
        self.network = model.network.stepper()
        self.toy = ToyMachine(self.network, model.layout, model.gestures, model.rules, model.smoothing)
        self.frame = frame
        self._affects = [AFFECT_CODES[a] for a in model.gestures.affects]
        self._rows: list[list[int]] = []

    def read(self, frames: Ints, calls: Sequence[Call] = ()) -> NDArray[np.int32]:
        """Return the rows for further frames."""
        self.feed(frames, calls)
        return self.take()

    def feed(self, frames: Ints, calls: Sequence[Call] = ()) -> None:
        """Feed frames to the toy and add the resulting rows."""
        health = self.toy.frames.health
        after = {call.frame: call for call in calls}
        for ms, *values in frames.tolist():
            before = health.fault, health.suspect
            for moment in self.toy.push(ms, values):
                self.add(moment)
            if (health.fault, health.suspect) != before:
                state = FAULT if health.fault else WARMING if self.toy.samples.warming else TRACKING
                self._add(HEALTH, ms, health.faults, state, int(health.suspect))
            call = after.get(self.frame)
            if call is not None and call.action == "sensitivity":
                self.toy.samples.sensitivity = call.value
            elif call is not None and call.action == "recalibrate":
                self.toy.frames.recalibrate()
            elif call is not None:
                moments = self.toy.prime(ms, values) if call.action == "prime" else [self.toy.silence()]
                for moment in moments:
                    self.add(moment)
            self.frame += 1

    def take(self) -> NDArray[np.int32]:
        """Return the rows since the last call as 32-bit integers."""
        made, self._rows = self._rows, []
        rows = np.array(made, dtype=np.int64).reshape(len(made), HEAD + 2 * len(self._affects))
        return (rows & 0xFFFFFFFF).astype(np.uint32).view(np.int32)

    def add(self, moment: Moment) -> None:
        """Add the changes of events at a moment, and the answer if it is a step."""
        for u in moment.updates:
            self._add(EVENT, self._ms(u.now), u.number, u.kind, u.gesture, u.affect, u.source, self._ms(u.since))
        if moment.cause != "step":
            return
        ms, count, answer = self._ms(moment.time_us), self.toy.samples.samples, moment.answer
        if answer is None or moment.logits is None or moment.smoothed is None:
            self._add(ANSWER, ms, count, WARMING)
            return
        values = answer.best, self._affects[answer.best], answer.share, answer.kind, answer.known
        numbers = [*moment.logits.tolist(), *moment.smoothed.tolist()]
        self._add(ANSWER, ms, count, TRACKING, *values, numbers=numbers)

    def add_patch(self, ms: int, status: int) -> None:
        """Add what ``plush_patch`` returned after the last frame, of time ``ms``."""
        self.frame -= 1
        self._add(PATCH, ms, status)
        self.frame += 1

    def _ms(self, time_us: int) -> int:
        return (time_us + self.toy.frames.zero_us) // 1000

    def _add(self, kind: int, ms: int, *values: int, numbers: Sequence[int] = ()) -> None:
        counts = (int(getattr(self.toy.frames.clock, name)) for name in _COUNTS)
        row = [kind, self.frame, ms, *values, *[0] * (7 - len(values)), *counts, *numbers]
        self._rows.append(row + [0] * (HEAD + 2 * len(self._affects) - len(row)))


def write_golden(model: IntegerModel, scaler: Scaler, folder: Path) -> list[Path]:
    """Write golden vectors and a README into a folder; return the paths."""
    span, inputs = model.network.arch.span, model.network.inputs
    frames = golden_frames(model.layout, scaler, span, inputs=inputs, health=model.rules.health)
    answers = answers_of(model, frames)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / FRAMES).write_bytes((frames & 0xFFFFFFFF).astype("<u4").tobytes())
    (folder / ANSWERS).write_bytes(answers.astype("<i4").tobytes())
    readme = fill_text(
        "plushsense.deploy",
        "templates/golden.md.j2",
        frames=len(frames),
        rows=len(answers),
        frames_file=FRAMES,
        answers_file=ANSWERS,
        channels=model.layout.names,
        classes=model.network.arch.classes,
        head=HEAD,
        kinds=[(kind, description, COLUMNS[kind][1:]) for kind, description in _KINDS.items()],
    )
    (folder / "README.md").write_text(readme, "utf-8", newline="\n")
    return [folder / FRAMES, folder / ANSWERS, folder / "README.md"]


def read_golden(folder: Path, channels: int, classes: int) -> tuple[Ints, NDArray[np.int32]]:
    """Read the frames (n, 1 + C) and rows (m, 16 + 2 K) of a folder.

    Raises:
        BadInput: if a file is missing or its size is not a multiple of the row size.
    """
    tables = []
    for name, columns, kind in ((FRAMES, 1 + channels, "<i4"), (ANSWERS, HEAD + 2 * classes, "<i4")):
        path = folder / name
        try:
            data = read_bytes(path, _MOST_BYTES)
        except OSError as cause:
            raise BadInput(f"The golden vectors '{path}' cannot be read ({cause}): export the model again.") from None
        if not data or len(data) % (4 * columns):
            raise BadInput(
                f"The golden vectors '{path}' have {len(data)} bytes, which are no whole rows of {columns} numbers: "
                "export the model again."
            )
        tables.append(np.frombuffer(data, dtype=kind).reshape(-1, columns))
    frames = tables[0].astype(np.int64)
    frames[:, 0] &= 0xFFFFFFFF
    return frames, tables[1].astype(np.int32)


def samples_of(frames: Ints, layout: Layout) -> int:
    """Return the number of samples that frames are resampled to."""
    return sum(map(len, resample(Frames(frames[:, 1:], frames[:, 0]), layout)))


@dataclass(frozen=True, eq=False)
class Vectors:
    """A test case for the C: frames to feed to it, and the expected answers.

    Attributes:
        frames: (n, 1 + C), the time in ms and the channels.
        answers: (m, 16 + 2 K), as `answers_of` computes them.
        samples: length of the resampled frames.
        model: model to run, if not that of the export.
        calls: what is called between the frames.
        patches: indices of the frames after which a patch is offered, and its bytes; none: the patch is undone.
    """

    name: str
    frames: Ints
    answers: NDArray[np.int32]
    samples: int
    model: IntegerModel | None = None
    calls: tuple[Call, ...] = ()
    patches: tuple[tuple[int, bytes], ...] = ()

    @property
    def decisions(self) -> int:
        """Number of answers after the warm-up."""
        return int((column(self.answers, "state") == TRACKING).sum())

    @property
    def memory_bytes(self) -> int:
        """Bytes of memory that ``model`` needs; 0 for the model of the export."""
        return memory_bytes(self.model) if self.model else 0

    @property
    def kept_bytes(self) -> int:
        """Bytes of the model and the patches, which the test program keeps until the end."""
        model = len(self.model.to_bytes()) if self.model else 0
        return sum(-(-n // 4) * 4 for n in (model, *(len(patch) for _, patch in self.patches)))

    def to_bytes(self) -> bytes:
        """Serialise for the test program, whose source describes the format: model, frames, calls and patches."""
        pieces = [_counted(self.model.to_bytes() if self.model else b"")]
        frames = (self.frames & 0xFFFFFFFF).astype("<u4")
        between = [(at, struct.pack("<I", _PATCH) + _counted(patch)) for at, patch in self.patches]
        for at, called, value in self.calls:
            more = {"prime": frames[at].tolist(), "sensitivity": [value & 0xFFFFFFFF]}.get(called, [])
            between.append((at, struct.pack(f"<{1 + len(more)}I", _ACTIONS[called], *more)))
        begin = 0
        for at, action in (*sorted(between), (len(frames) - 1, struct.pack("<I", _END))):
            pieces += [struct.pack("<I", at + 1 - begin), frames[begin : at + 1].tobytes(), action]
            begin = at + 1
        return b"".join(pieces)


# What comes after frames.
_END, _PATCH = 0, 2
_ACTIONS = {"silence": 1, "prime": 3, "sensitivity": 4, "recalibrate": 5}


def _counted(data: bytes) -> bytes:
    """Return the number of bytes, and the bytes, filled up to whole 32-bit numbers."""
    return struct.pack("<I", len(data)) + data + bytes(-len(data) % 4)


@dataclass(frozen=True)
class Counts:
    """Number of frames, samples and answers streamed under one name."""

    name: str
    frames: int
    samples: int
    answers: int


def counted(streams: Sequence[Vectors]) -> tuple[Counts, ...]:
    """Return the total counts of the vectors of each name."""
    return tuple(
        Counts(name, sum(len(v.frames) for v in own), sum(v.samples for v in own), sum(len(v.answers) for v in own))
        for name in dict.fromkeys(v.name for v in streams)
        for own in [[v for v in streams if v.name == name]]
    )
