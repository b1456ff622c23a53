"""One recording under review: how it stands, and what was decided about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from plushsense.dataset.marks import Standing
from plushsense.dataset.quality.finding import SEVERITIES, Finding
from plushsense.dataset.store import RecordingInfo

LOOKING, NONE, SUGGESTED, DRAFT = "looking", "none", "suggested", "draft"
ACCEPTED, ADJUSTED, EXCLUDED, LABELLED = "accepted", "adjusted", "excluded", "labelled"
STATES = (LOOKING, SUGGESTED, NONE, DRAFT, ACCEPTED, ADJUSTED, EXCLUDED, LABELLED)
DECIDED = (ACCEPTED, ADJUSTED, EXCLUDED)


@dataclass(frozen=True)
class Row:
    """One recording as the table shows it. ``open``: findings of errors and warnings that nobody accepted."""

    info: RecordingInfo
    state: str
    seconds: float
    findings: tuple[Finding, ...]
    confidence: float
    affect: str

    @property
    def id(self) -> str:
        """The recording's."""
        return self.info.id

    @property
    def open(self) -> list[Finding]:
        """Findings that ask for a look."""
        return [f for f in self.findings if not f.accepted and f.severity != "info"]

    @property
    def worst(self) -> str:
        """The severity of the most urgent finding that nobody accepted; "" for none."""
        return min((f.severity for f in self.findings if not f.accepted), key=SEVERITIES.index, default="")

    @property
    def done(self) -> bool:
        """Whether nothing is to be decided any more."""
        return self.state in DECIDED or (self.state == LABELLED and not self.open)


@dataclass(frozen=True)
class Decision:
    """One decision of a visit: what stood before, and after it."""

    recording: str
    action: str
    before: Standing
    after: Standing
    check: str = ""


def aspect(decision: Decision, standing: Standing) -> Any:
    """What a decision is about, of all that stands."""
    if decision.check:
        return decision.check in standing.accepted
    if decision.action in ("exclude", "include"):
        return standing.excluded
    return standing.start, standing.stop, standing.how
