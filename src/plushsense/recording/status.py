"""What a screen shows of a session: one immutable snapshot."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from plushsense.recording.protocol import Step

State = Literal["idle", "countdown", "recording", "saving", "paused", "finished", "stopped"]


@dataclass(frozen=True)
class StepStanding:
    """One recording of the plan and what came of it: the file that counts ("" when there is none yet), whether it was
    passed over, and how many files were set aside."""

    step: Step
    file: str
    skipped: bool
    aside: int


@dataclass(frozen=True)
class Status:
    """A session at one moment.

    Attributes:
        state: what it is doing; "finished": all is recorded or skipped; "stopped": nothing comes or is written
            any more (``failed`` says why where the disk is the reason, else ``message``).
        step: the recording that is asked for, or being made; ``following``: the next one.
        done, skipped, steps: of all recordings; ``redone``: files that were set aside.
        already: the file of this step where it is recorded already.
        countdown_s: left; ``elapsed_s`` of this recording; ``left_s`` until it ends by itself.
        rate_hz, jitter_ms, signal: of the last seconds (see `plushsense.recording.meter.SIGNAL`).
        lost, malformed, garbage, reconnects, gaps: since this program began.
        rows: of the session's stream.
        file: the last recording that was finished.
        heard: frames since this program began.
        bad_share: of the last seconds' lines, how many were lost, spoilt or out of range, 0 to 1; ``bad_ever`` since
            this program began.
    """

    state: State
    step: Step
    steps: int
    repetitions: int
    following: Step | None
    done: int
    skipped: int
    redone: int
    already: str
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
    heard: int = 0
    bad_share: float = 0.0

    @property
    def bad_ever(self) -> float:
        """See above."""
        bad = self.lost + self.malformed + self.garbage
        return bad / max(1, self.heard + bad)

    @property
    def seen(self) -> str:
        """A word for what this snapshot asks for: a command given upon it means nothing any more once it differs."""
        return f"{self.state}.{self.step.number}.{self.done}.{self.skipped}.{self.redone}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)
