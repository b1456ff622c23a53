"""The review of a data set: states of its recordings, drafts, and decisions with undo.

All pages share one `Review` of a data set. Rows that were set but not accepted are a draft, which a reload or a second
tab displays, too. Every decision is written as a mark at once.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset import trimming as trim
from plushsense.dataset.files import current_stamp
from plushsense.dataset.index import apply_marks, open_dataset
from plushsense.dataset.marks import SUGGESTED as BY_SUGGESTION
from plushsense.dataset.marks import Mark, MarksFollower, MarkState, append_marks, inverse_mark
from plushsense.dataset.onset import Suggestion
from plushsense.dataset.quality.findings import SEVERITIES, Finding
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.studio.app.workspace import ChangeSignal
from plushsense.studio.pages.review.plots import (
    GestureOverlay,
    RecordingSignals,
    build_overlay,
    read_signals,
    trimmed_curve,
)
from plushsense.studio.pages.review.preparation import ReviewPreparation

LOOKING, NONE, SUGGESTED, DRAFT = "looking", "none", "suggested", "draft"
ACCEPTED, ADJUSTED, EXCLUDED, LABELLED = "accepted", "adjusted", "excluded", "labelled"
STATES = (LOOKING, SUGGESTED, NONE, DRAFT, ACCEPTED, ADJUSTED, EXCLUDED, LABELLED)
DECIDED = (ACCEPTED, ADJUSTED, EXCLUDED)


@dataclass(frozen=True)
class ReviewedRecording:
    """A recording in the review table."""

    info: RecordingInfo
    state: str
    seconds: float
    findings: tuple[Finding, ...]
    confidence: float
    affect: str

    @property
    def id(self) -> str:
        """Id of the recording."""
        return self.info.id

    @property
    def open(self) -> list[Finding]:
        """Findings of errors and warnings that nobody accepted."""
        return [f for f in self.findings if not f.accepted and f.severity != "info"]

    @property
    def worst(self) -> str:
        """Severity of the most urgent finding that nobody accepted, or ""."""
        return min((f.severity for f in self.findings if not f.accepted), key=SEVERITIES.index, default="")

    @property
    def done(self) -> bool:
        """True if no decision about the recording is open."""
        return self.state in DECIDED or (self.state == LABELLED and not self.open)


@dataclass(frozen=True)
class ReviewDecision:
    """A decision of a browser tab, with the standing before and after it."""

    recording: str
    action: str
    before: MarkState
    after: MarkState
    check: str = ""


def aspect(decision: ReviewDecision, standing: MarkState) -> Any:
    """Return the part of a standing that a decision changes."""
    if decision.check:
        return decision.check in standing.accepted
    if decision.action in ("exclude", "include"):
        return standing.excluded
    return standing.start, standing.stop, standing.how


ODD = ("never-stopped", "duration", "no-onset", "several-gestures", "stuck", "flat")
"""Checks whose findings make a recording stand out among the others of its gesture."""
_SIGNALS_KEPT = 48
_VISITS_KEPT = 50


class Review:
    """A data set under review, shared by all pages.

    Methods may be called from any thread; those that read files may take seconds. `changed` notifies of each change;
    ``version`` counts the changes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.changed = ChangeSignal()
        self.version = 0
        self._lock = threading.RLock()
        self._reading = threading.Lock()
        self._histories: OrderedDict[str, list[ReviewDecision]] = OrderedDict()
        self._drafts: dict[str, tuple[int, int]] = {}
        self._read: OrderedDict[str, RecordingSignals] = OrderedDict()
        self._rows: dict[str, ReviewedRecording] = {}
        self._marks = MarksFollower(path)
        self._open()
        self.prepared = ReviewPreparation(self.changed)
        self._seen: Any = None
        self.prepared.begin(self.as_marked())

    def _open(self) -> None:
        self._stamp = current_stamp(self.path)
        self.dataset = open_dataset(self.path)
        self.infos = {r.id: r for r in self.dataset.recordings}
        self._affects = {g.label: g.affect for g in self.dataset.gestures.gestures}
        self._standing = self._marks.states()

    def close(self) -> None:
        """Stop the background thread."""
        self.prepared.close()

    def renew(self) -> None:
        """Read recordings added since, and check again if decisions were made since."""
        with self._lock:
            now = current_stamp(self.path)
            new = now | {"marks": ""} != self._stamp | {"marks": ""}
            if new:
                self._open()
                self._read.clear()
        self.look()
        if new or self.unchecked:
            self.check()

    @property
    def is_labelled(self) -> bool:
        """True if the recordings are cut from labels, so that they cannot be trimmed."""
        return self.dataset.layout.is_labelled

    # What stands --------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Read marks that other programs wrote, and notify subscribers if there are any.

        Raises:
            DatasetError: if the file of marks is invalid.
        """
        with self._lock:
            before = self._standing
            self._standing = self._marks.states()
            if self._standing is before:
                return
        self._changed()

    def _changed(self) -> None:
        self.version += 1
        self.changed.notify()

    def standing(self, identity: str) -> MarkState:
        """Return the standing of a recording, stream or person according to the marks."""
        return self._standing.get(identity, MarkState())

    def as_marked(self) -> Dataset:
        """Return the data set with the current marks and its own reader, for another thread."""
        bare = [replace(r, start=0, stop=r.rows, excluded=False) for r in self.dataset.recordings]
        return Dataset(self.path, self.dataset.head, apply_marks(bare, dict(self._standing)), self.dataset.streams)

    def check(self) -> None:
        """Start the checks again in the background."""
        self.prepared.begin(self.as_marked())

    @property
    def unchecked(self) -> int:
        """Number of recordings decided since their last check."""
        checked = self.prepared.checked
        if checked is None:
            return 0
        now = {r.id: (r.start, r.stop, r.excluded) for r in self.as_marked().recordings}
        return sum(now.get(r.id) != (r.start, r.stop, r.excluded) for r in checked.dataset.recordings)

    @property
    def rows(self) -> dict[str, ReviewedRecording]:
        """Recordings by id in the order of the index; the same dictionary until something changes."""
        with self._lock:
            made_of = (self.version, id(self.prepared.checked), len(self.prepared.shapes), id(self.dataset))
            if made_of != self._seen:
                found: dict[str, list[Finding]] = {}
                for f in self._findings():
                    found.setdefault(f.recording, []).append(f)
                self._rows = {i: self._row(info, tuple(found.get(i, ()))) for i, info in self.infos.items()}
                self._seen = made_of
            return self._rows

    def _row(self, info: RecordingInfo, findings: tuple[Finding, ...]) -> ReviewedRecording:
        suggestion, shape = self.prepared.suggestions.get(info.id), self.prepared.shapes.get(info.id)
        seconds = shape.seconds if shape is not None else info.rows / info.rate_hz if info.rate_hz > 0 else 0.0
        return ReviewedRecording(
            info,
            self._state(info, suggestion),
            seconds,
            findings,
            suggestion.onset_confidence if suggestion is not None else 0.0,
            self._affects.get(info.gesture, "none"),
        )

    def _state(self, info: RecordingInfo, suggestion: Suggestion | None) -> str:
        standing = self.standing(info.id)
        if standing.excluded:
            return EXCLUDED
        if self.is_labelled:
            return LABELLED
        if info.id in self._drafts:
            return DRAFT
        if standing.trimmed:
            return ACCEPTED if standing.how == BY_SUGGESTION else ADJUSTED
        if suggestion is None:
            return LOOKING
        return SUGGESTED if suggestion.onset_visible else NONE

    def _findings(self) -> Iterable[Finding]:
        """Yield the findings, with ``accepted`` set from the current marks."""
        for f in self.prepared.checked.findings if self.prepared.checked is not None else ():
            accepted = f.check in self.standing(f.about).accepted
            yield f if f.accepted == accepted else replace(f, accepted=accepted)

    def findings_elsewhere(self) -> list[Finding]:
        """Return the findings about sessions, people and the data set as a whole."""
        return [f for f in self._findings() if not f.recording]

    def info(self, identity: str) -> RecordingInfo:
        """Return the index entry of a recording.

        Raises:
            DatasetError: for an unknown id.
        """
        try:
            return self.infos[identity]
        except KeyError:
            raise DatasetError(f"There is no recording '{identity}' in '{self.dataset.head.name}'.") from None

    # One recording ------------------------------------------------------------------------------------------------

    def signals(self, identity: str) -> RecordingSignals:
        """Read the signals of a recording; the last 48 are cached."""
        self.prepared.step_back()
        info = self.info(identity)
        known = self._read.get(identity)
        if known is not None and (not len(self.prepared.scale) or not np.isnan(known.activity).any()):
            return known
        with self._reading:
            made = read_signals(self.dataset, info, self.prepared.scale)
            self._read[identity] = made
            self._read.move_to_end(identity)
            while len(self._read) > _SIGNALS_KEPT:
                self._read.popitem(last=False)
        return made

    def is_read(self, identity: str) -> bool:
        """Return whether the signals of a recording are cached."""
        return identity in self._read

    def trim(self, identity: str) -> trim.Trim:
        """Return the suggestion and the standing of a recording; without a suggestion while that is computed."""
        info = self.info(identity)
        nothing = Suggestion(0, info.rows, False, False, 0.0, 0.0, 1.0)
        suggestion = self.prepared.suggestions.get(identity, nothing)
        return trim.Trim(info, suggestion, self.standing(identity), self.signals(identity).seconds)

    def draft(self, identity: str) -> tuple[int, int] | None:
        """Return the rows (start, stop) that are set but not accepted yet."""
        return self._drafts.get(identity)

    def kept_rows(self, identity: str, ends: bool = False) -> tuple[int, int]:
        """Return the rows that `accept` would keep: the draft, else the marked rows, else the suggestion."""
        return self._drafts.get(identity) or self.trim(identity).current_rows(ends)

    def set(self, identity: str, start: int | None = None, stop: int | None = None, ends: bool = False) -> None:
        """Set the start or the stop of the draft to a row, limited to the recording.

        Raises:
            DatasetError: if the start is not before the stop, or the recording cannot be trimmed.
        """
        info = self.info(identity)
        if self.is_labelled:
            raise DatasetError(f"'{identity}' is cut where the label changes, so there is nothing to trim.")
        with self._lock:
            if self.standing(identity).excluded:
                raise DatasetError(f"'{identity}' is excluded: take it back in before you trim it.")
            was = self.kept_rows(identity, ends)
            first = was[0] if start is None else min(max(0, start), info.rows - 1)
            last = was[1] if stop is None else min(max(1, stop), info.rows)
            if last <= first:
                raise DatasetError(
                    f"Nothing of '{identity}' would be left: set the start before the end, and the end after the start."
                )
            self._drafts.pop(identity, None)
            if (first, last) != self.trim(identity).current_rows(ends):
                self._drafts[identity] = (first, last)
        self._changed()

    def drop(self, identity: str) -> bool:
        """Discard a draft, and return whether there was one."""
        with self._lock:
            gone = self._drafts.pop(identity, None) is not None
        if gone:
            self._changed()
        return gone

    # Decisions ----------------------------------------------------------------------------------------------------

    def _decide(self, visit: str, about: str, action: str, make: Callable[[], object], check: str = "") -> bool:
        """Write marks, remember how to undo them, and return whether the standing changed."""
        with self._lock:
            self._standing = self._marks.states()
            before = self.standing(about)
            make()
            self._standing = self._marks.states()
            now = self.standing(about)
            if now != before:
                history = self._histories.setdefault(visit, [])
                history.append(ReviewDecision(about, action, before, now, check))
                self._histories.move_to_end(visit)
                while len(self._histories) > _VISITS_KEPT:
                    self._histories.popitem(last=False)
        self._changed()
        return now != before

    def accept(self, visit: str, identity: str, who: str, ends: bool = False) -> bool:
        """Mark the rows to keep, and return False if there is nothing to mark.

        Suggested rows are marked as suggested. Without a visible or a set start, the whole recording is marked as set
        by hand.

        Raises:
            DatasetError: if the marks cannot be written, or the suggestion is still being computed.
        """
        with self._lock:
            found, draft = self.trim(identity), self._drafts.get(identity)
            state = self._state(found.recording, self.prepared.suggestions.get(identity))
            if state in (EXCLUDED, LABELLED, ACCEPTED, ADJUSTED):
                return False
            if state == LOOKING:
                raise DatasetError(f"'{identity}' is still being looked at: wait a moment, or set its start yourself.")
            rows = draft or found.suggested_rows(ends)
            as_suggested = rows == found.suggested_rows(ends) and rows != (0, found.recording.rows)

            def make() -> None:
                if as_suggested and found.state != ADJUSTED:
                    trim.accept_suggestions(self.dataset, [found], who, offset=ends)
                else:
                    trim.set_rows(self.dataset, found, *rows, who)

            made = self._decide(visit, identity, "trim", make)
            self._drafts.pop(identity, None)
        self._changed()
        return made

    def exclude(self, visit: str, identity: str, who: str, why: str) -> bool:
        """Exclude a recording; raise ConfigError without a reason."""
        return self._mark(visit, Mark(self.info(identity).id, "exclude", who, _reason(why)))

    def include(self, visit: str, identity: str, who: str) -> bool:
        """Take an excluded recording back into use."""
        return self._mark(visit, Mark(self.info(identity).id, "include", who))

    def untrim(self, visit: str, identity: str, who: str) -> bool:
        """Remove a trim, so that the suggestion applies again."""
        return self._mark(visit, Mark(self.info(identity).id, "untrim", who))

    def accept_finding(self, visit: str, finding: Finding, who: str, why: str) -> bool:
        """Mark a finding as known and harmless; raise ConfigError without a reason."""
        return self._mark(visit, Mark(finding.about, "accept", who, _reason(why), check=finding.check))

    def reopen_finding(self, visit: str, finding: Finding, who: str) -> bool:
        """Reopen an accepted finding."""
        return self._mark(visit, Mark(finding.about, "unaccept", who, check=finding.check))

    def _mark(self, visit: str, mark: Mark) -> bool:
        before = self.standing(mark.recording)
        if {
            "exclude": before.excluded,
            "include": not before.excluded,
            "untrim": not before.trimmed,
            "accept": mark.check in before.accepted,
            "unaccept": mark.check not in before.accepted,
        }[mark.action]:
            return False
        make = lambda: append_marks(self.path, [mark])  # noqa: E731, RUF100
        return self._decide(visit, mark.recording, mark.action, make, mark.check)

    def history(self, visit: str) -> Sequence[ReviewDecision]:
        """Return the decisions of a browser tab that can be undone, the oldest first."""
        return tuple(self._histories.get(visit, ()))

    def undo(self, visit: str, who: str, why: str = "") -> ReviewDecision | None:
        """Undo the last decision of a browser tab by a new mark; return None if there is none.

        Raises:
            DatasetError: if there is a newer decision; that one stays, and older ones can be undone.
        """
        with self._lock:
            history = self._histories.get(visit)
            if not history:
                return None
            self._standing = self._marks.states()
            last, now = history[-1], self.standing(history[-1].recording)
            if aspect(last, now) != aspect(last, last.after):
                history.pop()
                raise DatasetError(
                    f"'{last.recording}' was decided anew since, in another window or program: that stays as it is."
                )
            mark = Mark(last.recording, last.action, who, check=last.check)
            append_marks(self.path, [inverse_mark(mark, last.before, who, why)])
            history.pop()
            self._standing = self._marks.states()
        self._changed()
        return last

    # Side by side -------------------------------------------------------------------------------------------------

    def overlay(self, gesture: str) -> GestureOverlay:
        """Return the overlay of all used recordings of a gesture, with the checks that flagged some."""
        curves = []
        for identity, row in self.rows.items():
            shape = self.prepared.shapes.get(identity)
            if row.info.gesture != gesture or row.state == EXCLUDED or shape is None:
                continue
            standing = self.standing(identity)
            # Assume even steps: accurate enough for a plot, and no file is read.
            per_row = shape.seconds / max(1, row.info.rows)
            stop = row.info.rows if standing.stop < 0 else standing.stop
            odd = dict.fromkeys(f.check for f in row.open if f.check in ODD)
            curves.append(trimmed_curve(identity, shape, standing.start * per_row, stop * per_row, ", ".join(odd)))
        return build_overlay(curves)


def _reason(why: str) -> str:
    if not why.strip():
        raise ConfigError("This needs a reason: say why, in a few words.")
    return why.strip()
