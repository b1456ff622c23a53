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
from plushsense.deploy.made_frames import golden_frames
from plushsense.models.events import AFFECT_CODES, EventMachine, Update
from plushsense.models.gate import Gate
from plushsense.models.health import Health
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
