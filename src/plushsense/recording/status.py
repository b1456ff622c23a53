"""State of a session for its displays, and its plan with the recordings of each step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from plushsense.core.sentences import Message
from plushsense.recording.plan import Step
from plushsense.recording.session import Key, SessionProgress

RecorderState = Literal["idle", "countdown", "recording", "saving", "paused", "finished", "stopped"]


@dataclass(frozen=True)
class StepResult:
    """State of one planned recording.

    ``file`` is the recording in use ("" if there is none), ``discarded`` the number of discarded files.
    """

    step: Step
    file: str
    skipped: bool
    discarded: int


@dataclass(frozen=True)
class RecorderStatus:
    """Snapshot of a session.

    ``state`` is "finished" if all steps are recorded or skipped, "stopped" if no more data can be received or written
    (the reason is ``failed`` for errors of the disk, else ``message``). ``done``, ``skipped`` and ``steps`` are numbers
    of steps, ``redone`` is the number of discarded files, ``existing`` the file of the current step if it is recorded,
    ``file`` the last recording in use. ``countdown_s`` and ``left_s`` are the remaining times of countdown and
    recording, ``elapsed_s`` is the duration of the recording so far. ``rate_hz``, ``jitter_ms``, ``signal`` and
    ``bad_share`` are those of `SignalQuality`; ``away`` is whether the toy is disconnected. ``rows`` counts the
    session's stream; the other counts begin with this program.
    """

    state: RecorderState
    step: Step
    steps: int
    repetitions: int
    next_step: Step | None
    done: int
    skipped: int
    redone: int
    existing: str
    countdown_s: float
    elapsed_s: float
    left_s: float
    rate_hz: float
    jitter_ms: float
    signal: str
    away: bool
    lost: int
    malformed: int
    garbage: int
    reconnects: int
    gaps: int
    rows: int
    file: str
    message: Message
    failed: str
    folder: str
    frames: int = 0
    bad_share: float = 0.0

    @property
    def bad_share_total(self) -> float:
        """Share of all lines since the start of this program that were lost, malformed or out of range, 0 to 1."""
        bad = self.lost + self.malformed + self.garbage
        return bad / max(1, self.frames + bad)

    @property
    def seen(self) -> str:
        """Identifier of the displayed state, by which a command for an outdated display can be recognised."""
        return f"{self.state}.{self.step.number}.{self.done}.{self.skipped}.{self.redone}"


def key_of(step: Step) -> Key:
    """Return the key of a planned recording: its gesture and repetition."""
    return step.gesture, step.repetition


class PlanProgress:
    """Steps of a session in their order, and the recordings of each.

    ``takes`` maps a step to its file in use, the newest last; ``discarded`` maps it to its other files. ``at`` is the
    number of the current step.
    """

    def __init__(self, steps: tuple[Step, ...], progress: SessionProgress) -> None:
        self.steps = steps
        self.takes = dict(progress.takes)
        self.skipped = set(progress.skipped)
        self.discarded = {key: list(files) for key, files in progress.discarded.items()}
        self.at = 0
        self._last: Key | None = next(reversed(self.takes), None)

    @property
    def step(self) -> Step:
        """The current step."""
        return self.steps[self.at]

    @property
    def last(self) -> Key | None:
        """Step of the last recording; None if there is none, or it is to be recorded again."""
        return self._last if self._last in self.takes else None

    @property
    def last_file(self) -> str:
        """File of the last recording; "" if there is none, or it is to be recorded again."""
        return self.takes[self.last] if self.last is not None else ""

    @property
    def redone(self) -> int:
        """Number of discarded files."""
        return sum(map(len, self.discarded.values()))

    def _left(self, order: tuple[Step, ...]) -> Step | None:
        return next((s for s in order if key_of(s) not in self.takes and key_of(s) not in self.skipped), None)

    def next_step(self) -> Step | None:
        """Return the next step to record after the current one; None if no other is left."""
        return self._left(self.steps[self.at + 1 :] + self.steps[: self.at])

    def advance(self, from_start: bool = False) -> bool:
        """Go to the next step to record, wrapping around at the end; return False if none is left."""
        at = 0 if from_start else self.at + 1
        left = self._left(self.steps[at:] + self.steps[:at])
        self.at = left.number if left is not None else len(self.steps) - 1
        return left is not None

    def discard(self, key: Key) -> str:
        """Discard the recording of a step and go to that step, to record it again; return the file."""
        file = self.takes.pop(key)
        self.discarded.setdefault(key, []).append(file)
        self.at = next(s.number for s in self.steps if key_of(s) == key)
        return file

    def keep(self, key: Key) -> str:
        """Use the newest discarded file of a step again; return it, or "" if there is none or another file is used."""
        if key in self.takes or not self.discarded.get(key):
            return ""
        file = self.takes[key] = self.discarded[key].pop()
        self._last = key
        return file

    def record(self, key: Key, file: str) -> None:
        """Store the file of a finished recording; discard an earlier one of the same step."""
        earlier = self.takes.pop(key, "")
        if earlier:
            self.discarded.setdefault(key, []).append(earlier)
        self.takes[key] = file
        self.skipped.discard(key)
        self._last = key
