"""Immutable snapshots of a recording session, for display."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from plushsense.recording.plan import Step

RecorderState = Literal["idle", "countdown", "recording", "saving", "paused", "finished", "stopped"]


@dataclass(frozen=True)
class StepResult:
    """The state of one planned recording.

    ``file`` is the recording in use ("" when there is none yet), ``discarded`` the number of discarded files.
    """

    step: Step
    file: str
    skipped: bool
    discarded: int


@dataclass(frozen=True)
class RecorderStatus:
    """A snapshot of a session.

    Attributes:
        state: current state; "finished": all steps are recorded or skipped; "stopped": no more data come or can be
            written (``failed`` is the reason when the disk is the cause, else ``message``).
        step: the current step; ``next_step``: the one after it.
        done, skipped, steps: numbers of steps; ``redone``: number of discarded files.
        existing: the file of this step if it is recorded already.
        countdown_s: time left; ``elapsed_s`` of this recording; ``left_s`` until it ends automatically.
        rate_hz, jitter_ms, signal: signal quality of the last seconds (see `plushsense.recording.takes.SIGNAL`).
        away: whether the toy is disconnected.
        frames, lost, malformed, garbage, reconnects, gaps: numbers since this program began.
        rows: rows of the session's stream.
        file: the last finished recording.
        bad_share: share of the last seconds' lines that were lost, malformed or out of range, 0 to 1.
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
    message: str
    failed: str
    folder: str
    frames: int = 0
    bad_share: float = 0.0

    @property
    def bad_share_total(self) -> float:
        """Share of all lines since this program began that were lost, malformed or out of range, 0 to 1."""
        bad = self.lost + self.malformed + self.garbage
        return bad / max(1, self.frames + bad)

    @property
    def seen(self) -> str:
        """An identifier of what is displayed: a command given to another display is outdated."""
        return f"{self.state}.{self.step.number}.{self.done}.{self.skipped}.{self.redone}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)
