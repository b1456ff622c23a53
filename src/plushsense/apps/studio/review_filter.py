"""Which recordings of a review are shown, in which order."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, fields
from typing import Any

from plushsense.apps.studio.review_row import STATES, Row
from plushsense.dataset.quality.finding import SEVERITIES

TO_DO, DONE = "todo", "done"
NO_FINDING = "no-finding"


@dataclass(frozen=True)
class Filter:
    """What a recording must be to be shown; "" takes all.

    ``state``: one of `STATES`, or `TO_DO`, `DONE`. ``severity``: the most urgent open finding is at least so urgent,
    or `NO_FINDING`. ``check``: one that found something, accepted or not. ``text``: in its id or in a finding.
    """

    person: str = ""
    gesture: str = ""
    state: str = ""
    severity: str = ""
    check: str = ""
    text: str = ""

    def fits(self, row: Row) -> bool:
        """Whether a recording is shown."""
        return (
            self.person in ("", row.info.subject)
            and self.gesture in ("", row.info.gesture)
            and self._state_fits(row)
            and self._severity_fits(row)
            and (not self.check or any(f.check == self.check for f in row.findings))
            and self._text_fits(row)
        )

    def _state_fits(self, row: Row) -> bool:
        if self.state in (TO_DO, DONE):
            return row.done == (self.state == DONE)
        return self.state in ("", row.state)

    def _severity_fits(self, row: Row) -> bool:
        if self.severity == NO_FINDING:
            return not row.worst
        if not self.severity:
            return True
        return bool(row.worst) and SEVERITIES.index(row.worst) <= SEVERITIES.index(self.severity)

    def _text_fits(self, row: Row) -> bool:
        wanted = self.text.strip().casefold()
        return not wanted or any(wanted in s.casefold() for s in (row.id, *(f.message for f in row.findings)))

    @classmethod
    def of(cls, said: dict[str, str]) -> Filter:
        """From the words of an address; what does not make sense is left out."""
        known = {f.name: said[f.name] for f in fields(cls) if said.get(f.name)}
        if known.get("state", "") not in ("", TO_DO, DONE, *STATES):
            del known["state"]
        if known.get("severity", "") not in ("", NO_FINDING, *SEVERITIES):
            del known["severity"]
        return cls(**known)

    def said(self) -> dict[str, str]:
        """For the address."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name))}


_URGENCY = {s: i for i, s in enumerate((*SEVERITIES, ""))}
SORTS: dict[str, Callable[[Row], Any]] = {
    "recording": lambda r: (),
    "person": lambda r: r.info.subject,
    "gesture": lambda r: r.info.gesture,
    "seconds": lambda r: r.seconds,
    "findings": lambda r: (_URGENCY[r.worst], -len(r.open)),
    "state": lambda r: (STATES.index(r.state), r.confidence),
}
"""By what the table can be sorted; after that, by id."""


def chosen(
    rows: Iterable[Row], wanted: Filter, only: Collection[str] | None = None, by: str = "recording", down: bool = False
) -> list[str]:
    """The ids of the recordings that are shown, in order. ``only``: a selection that a link named."""
    fitting = [r for r in rows if (only is None or r.id in only) and wanted.fits(r)]
    fitting.sort(key=lambda r: r.id, reverse=down and by == "recording")
    if by != "recording":
        fitting.sort(key=SORTS[by], reverse=down)
    return [r.id for r in fitting]
