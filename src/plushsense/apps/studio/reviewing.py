"""Cleaning a data set: its recordings as they stand, decisions as marks, and taking them back one by one.

Pages share one `Review` a data set. What a person set but has not accepted yet is a draft, kept here until it is
accepted or dropped, so that a reload or a second tab shows it. Every decision is a mark at once.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.apps.studio.house import Bell
from plushsense.apps.studio.review_prepared import Prepared
from plushsense.apps.studio.review_row import (
    ACCEPTED,
    ADJUSTED,
    DRAFT,
    EXCLUDED,
    LABELLED,
    LOOKING,
    NONE,
    SUGGESTED,
    Decision,
    Row,
    aspect,
)
from plushsense.apps.studio.review_shown import Overlay, Signals, curve, overlay, signals
from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset import trim
from plushsense.dataset.freshness import taken
from plushsense.dataset.index import open_dataset, with_marks
from plushsense.dataset.marks import SUGGESTED as BY_SUGGESTION
from plushsense.dataset.marks import FollowedMarks, Mark, Standing, append_marks, taking_back
from plushsense.dataset.onset import Suggestion
from plushsense.dataset.quality.finding import Finding
from plushsense.dataset.store import Dataset, RecordingInfo

ODD = ("never-stopped", "duration", "no-onset", "several-gestures", "stuck", "flat")
"""Checks whose findings make a recording stand out among the others of its gesture."""
_SIGNALS_KEPT = 48
_VISITS_KEPT = 50


class Review:
    """A data set under review. Its methods may be called from any thread; those that read files take their time.

    ``bell`` rings after every change; ``version`` counts them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.bell = Bell()
        self.version = 0
        self._lock = threading.RLock()
        self._reading = threading.Lock()
        self._histories: OrderedDict[str, list[Decision]] = OrderedDict()
        self._drafts: dict[str, tuple[int, int]] = {}
        self._read: OrderedDict[str, Signals] = OrderedDict()
        self._rows: dict[str, Row] = {}
        self._marks = FollowedMarks(path)
        self._open()
        self.prepared = Prepared(self.bell)
        self._seen: Any = None
        self.prepared.begin(self.as_marked())

    def _open(self) -> None:
        self._stamp = taken(self.path)
        self.dataset = open_dataset(self.path)
        self.infos = {r.id: r for r in self.dataset.recordings}
        self._affects = {g.label: g.affect for g in self.dataset.gestures.gestures}
        self._standing = self._marks.standing()

    def close(self) -> None:
        """Stop what goes on in the background."""
        self.prepared.close()

    def renew(self) -> None:
        """Take in recordings that came since, and check again what was decided since; for a page that opens."""
        with self._lock:
            now = taken(self.path)
            new = now | {"marks": ""} != self._stamp | {"marks": ""}
            if new:
                self._open()
                self._read.clear()
        self.look()
        if new or self.unchecked:
            self.check()

    @property
    def is_labelled(self) -> bool:
        """Whether the recordings are cut from labels, so that there is nothing to trim."""
        return self.dataset.layout.is_labelled

    # What stands --------------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Take in marks that other programs made; rings where there are any.

        Raises:
            DatasetError: for a marks file that cannot be understood.
        """
        with self._lock:
            before = self._standing
            self._standing = self._marks.standing()
            if self._standing is before:
                return
        self._changed()

    def _changed(self) -> None:
        self.version += 1
        self.bell.ring()

    def standing(self, identity: str) -> Standing:
        """Where the marks leave a recording (or stream, or person)."""
        return self._standing.get(identity, Standing())

    def as_marked(self) -> Dataset:
        """The data set with the marks as they stand now; its own reader, for another thread."""
        bare = [replace(r, start=0, stop=r.rows, excluded=False) for r in self.dataset.recordings]
        return Dataset(self.path, self.dataset.head, with_marks(bare, dict(self._standing)), self.dataset.streams)

    def check(self) -> None:
        """Check anew in the background."""
        self.prepared.begin(self.as_marked())

    @property
    def unchecked(self) -> int:
        """Recordings that were decided since they were checked."""
        checked = self.prepared.checked
        if checked is None:
            return 0
        now = {r.id: (r.start, r.stop, r.excluded) for r in self.as_marked().recordings}
        return sum(now.get(r.id) != (r.start, r.stop, r.excluded) for r in checked.dataset.recordings)

    @property
    def rows(self) -> dict[str, Row]:
        """All recordings in the order of the index; the same dictionary while nothing changed."""
        with self._lock:
            made_of = (self.version, id(self.prepared.checked), len(self.prepared.shapes), id(self.dataset))
            if made_of != self._seen:
                found: dict[str, list[Finding]] = {}
                for f in self._findings():
                    found.setdefault(f.recording, []).append(f)
                self._rows = {i: self._row(info, tuple(found.get(i, ()))) for i, info in self.infos.items()}
                self._seen = made_of
            return self._rows

    def _row(self, info: RecordingInfo, findings: tuple[Finding, ...]) -> Row:
        suggestion, shape = self.prepared.suggestions.get(info.id), self.prepared.shapes.get(info.id)
        seconds = shape.seconds if shape is not None else info.rows / info.rate_hz if info.rate_hz > 0 else 0.0
        return Row(
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
        """The findings, accepted as the marks say now."""
        for f in self.prepared.checked.findings if self.prepared.checked is not None else ():
            accepted = f.check in self.standing(f.about).accepted
            yield f if f.accepted == accepted else replace(f, accepted=accepted)

    def findings_elsewhere(self) -> list[Finding]:
        """Findings about sessions, people and the data set as a whole."""
        return [f for f in self._findings() if not f.recording]

    def info(self, identity: str) -> RecordingInfo:
        """One recording.

        Raises:
            DatasetError: for an id that is none.
        """
        try:
            return self.infos[identity]
        except KeyError:
            raise DatasetError(f"There is no recording '{identity}' in '{self.dataset.head.name}'.") from None

    # One recording ------------------------------------------------------------------------------------------------

    def signals(self, identity: str) -> Signals:
        """A recording, read; the last ones are kept."""
        self.prepared.step_back()
        info = self.info(identity)
        known = self._read.get(identity)
        if known is not None and (not len(self.prepared.scale) or not np.isnan(known.activity).any()):
            return known
        with self._reading:
            made = signals(self.dataset, info, self.prepared.scale)
            self._read[identity] = made
            self._read.move_to_end(identity)
            while len(self._read) > _SIGNALS_KEPT:
                self._read.popitem(last=False)
        return made

    def is_read(self, identity: str) -> bool:
        """Whether `signals` would answer at once."""
        return identity in self._read

    def trim(self, identity: str) -> trim.Trim:
        """What is suggested for a recording, and what stands; it has no suggestion while that is being made."""
        info = self.info(identity)
        nothing = Suggestion(0, info.rows, False, False, 0.0, 0.0, 1.0)
        suggestion = self.prepared.suggestions.get(identity, nothing)
        return trim.Trim(info, suggestion, self.standing(identity), self.signals(identity).seconds)

    def draft(self, identity: str) -> tuple[int, int] | None:
        """The rows that somebody set and nobody accepted yet."""
        return self._drafts.get(identity)

    def shown(self, identity: str, ends: bool = False) -> tuple[int, int]:
        """The rows that `accept` would keep: those of the draft, else those that stand, else those suggested."""
        return self._drafts.get(identity) or self.trim(identity).shown(ends)

    def set(self, identity: str, start: int | None = None, stop: int | None = None, ends: bool = False) -> None:
        """Move the draft's start or end to a row; they stay inside the recording.

        Raises:
            DatasetError: where the start would not come before the end, or nothing can be trimmed.
        """
        info = self.info(identity)
        if self.is_labelled:
            raise DatasetError(f"'{identity}' is cut where the label changes, so there is nothing to trim.")
        with self._lock:
            if self.standing(identity).excluded:
                raise DatasetError(f"'{identity}' is excluded: take it back in before you trim it.")
            was = self.shown(identity, ends)
            first = was[0] if start is None else min(max(0, start), info.rows - 1)
            last = was[1] if stop is None else min(max(1, stop), info.rows)
            if last <= first:
                raise DatasetError(
                    f"Nothing of '{identity}' would be left: set the start before the end, and the end after the start."
                )
            self._drafts.pop(identity, None)
            if (first, last) != self.trim(identity).shown(ends):
                self._drafts[identity] = (first, last)
        self._changed()

    def drop(self, identity: str) -> bool:
        """Forget a draft; whether there was one."""
        with self._lock:
            gone = self._drafts.pop(identity, None) is not None
        if gone:
            self._changed()
        return gone

    # Decisions ----------------------------------------------------------------------------------------------------

    def _decide(self, visit: str, about: str, action: str, make: Callable[[], object], check: str = "") -> bool:
        """Make marks and remember how to take them back; whether anything changed."""
        with self._lock:
            self._standing = self._marks.standing()
            before = self.standing(about)
            make()
            self._standing = self._marks.standing()
            now = self.standing(about)
            if now != before:
                history = self._histories.setdefault(visit, [])
                history.append(Decision(about, action, before, now, check))
                self._histories.move_to_end(visit)
                while len(self._histories) > _VISITS_KEPT:
                    self._histories.popitem(last=False)
        self._changed()
        return now != before

    def accept(self, visit: str, identity: str, who: str, ends: bool = False) -> bool:
        """Mark what is shown; False where that stands already, or nothing is to be trimmed.

        What was suggested is marked as such. Where no start is visible and nobody set one, all of it is marked, as set
        by hand.

        Raises:
            DatasetError: where the marks cannot be written, or the suggestion is still being made.
        """
        with self._lock:
            found, draft = self.trim(identity), self._drafts.get(identity)
            state = self._state(found.recording, self.prepared.suggestions.get(identity))
            if state in (EXCLUDED, LABELLED, ACCEPTED, ADJUSTED):
                return False
            if state == LOOKING:
                raise DatasetError(f"'{identity}' is still being looked at: wait a moment, or set its start yourself.")
            rows = draft or found.rows(ends)
            as_suggested = rows == found.rows(ends) and rows != (0, found.recording.rows)

            def make() -> None:
                if as_suggested and found.state != ADJUSTED:
                    trim.accept(self.dataset, [found], who, offset=ends)
                else:
                    trim.set_rows(self.dataset, found, *rows, who)

            made = self._decide(visit, identity, "trim", make)
            self._drafts.pop(identity, None)
        self._changed()
        return made

    def exclude(self, visit: str, identity: str, who: str, why: str) -> bool:
        """Take a recording out of use; ConfigError without a reason."""
        return self._mark(visit, Mark(self.info(identity).id, "exclude", who, _reason(why)))

    def include(self, visit: str, identity: str, who: str) -> bool:
        """Take a recording back in."""
        return self._mark(visit, Mark(self.info(identity).id, "include", who))

    def untrim(self, visit: str, identity: str, who: str) -> bool:
        """Take a trim back, so that the suggestion is open again."""
        return self._mark(visit, Mark(self.info(identity).id, "untrim", who))

    def accept_finding(self, visit: str, finding: Finding, who: str, why: str) -> bool:
        """Say that what a check found is known and no fault; ConfigError without a reason."""
        return self._mark(visit, Mark(finding.about, "accept", who, _reason(why), check=finding.check))

    def reopen_finding(self, visit: str, finding: Finding, who: str) -> bool:
        """Take that back."""
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
        make = lambda: append_marks(self.path, [mark])  # noqa: E731
        return self._decide(visit, mark.recording, mark.action, make, mark.check)

    def history(self, visit: str) -> Sequence[Decision]:
        """The decisions of a visit that can be taken back, the oldest first."""
        return tuple(self._histories.get(visit, ()))

    def undo(self, visit: str, who: str, why: str = "") -> Decision | None:
        """Take the last decision of a visit back, by a mark; None where there is none.

        Raises:
            DatasetError: where somebody decided anew since: that stays, and the older decisions can be taken back.
        """
        with self._lock:
            history = self._histories.get(visit)
            if not history:
                return None
            self._standing = self._marks.standing()
            last, now = history[-1], self.standing(history[-1].recording)
            if aspect(last, now) != aspect(last, last.after):
                history.pop()
                raise DatasetError(
                    f"'{last.recording}' was decided anew since, in another window or program: that stays as it is."
                )
            mark = Mark(last.recording, last.action, who, check=last.check)
            append_marks(self.path, [taking_back(mark, last.before, who, why)])
            history.pop()
            self._standing = self._marks.standing()
        self._changed()
        return last

    # Side by side -------------------------------------------------------------------------------------------------

    def overlay(self, gesture: str) -> Overlay:
        """All used recordings of a gesture over each other, with what is odd about some."""
        curves = []
        for identity, row in self.rows.items():
            shape = self.prepared.shapes.get(identity)
            if row.info.gesture != gesture or row.state == EXCLUDED or shape is None:
                continue
            standing = self.standing(identity)
            # Even steps: near enough for a picture, and no file is read.
            per_row = shape.seconds / max(1, row.info.rows)
            stop = row.info.rows if standing.stop < 0 else standing.stop
            odd = dict.fromkeys(f.check for f in row.open if f.check in ODD)
            curves.append(curve(identity, shape, standing.start * per_row, stop * per_row, ", ".join(odd)))
        return overlay(curves)


def _reason(why: str) -> str:
    if not why.strip():
        raise ConfigError("This needs a reason: say why, in a few words.")
    return why.strip()
