"""Manage the review of a data set: states of its recordings, drafts, and decisions with undo.

All pages share one `Review` per data set. A start or stop that was set but not yet accepted is a draft, which other
tabs display too and which survives a reload. Every decision is written immediately as a mark.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset import labelling
from plushsense.dataset import trimming as trim
from plushsense.dataset.files import IndexStamp
from plushsense.dataset.index import apply_marks, open_dataset
from plushsense.dataset.marks import SUGGESTED as BY_SUGGESTION
from plushsense.dataset.marks import (
    LabelledStretch,
    Mark,
    MarksFollower,
    MarkState,
    append_marks,
    apply_mark,
    inverse_marks,
)
from plushsense.dataset.onset import Suggestion
from plushsense.dataset.quality.findings import SEVERITIES, Finding
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.studio.pages.review.signals import (
    GestureOverlay,
    RecordingSignals,
    ReviewPreparation,
    build_overlay,
    read_signals,
    read_stream_signals,
    trimmed_curve,
)

STATE_TEXTS: Texts = {
    "todo": "to do",
    "done": "decided",
    "looking": "being computed",
    "suggested": "suggested",
    "none": "no visible start",
    "draft": "set, not accepted",
    "accepted": "accepted",
    "adjusted": "set by hand",
    "excluded": "excluded",
    "labelled": "labelled",
}
"""Names of the states of a recording, and of the filters on them."""

LOOKING, NONE, SUGGESTED, DRAFT = "looking", "none", "suggested", "draft"
ACCEPTED, ADJUSTED, EXCLUDED, LABELLED = "accepted", "adjusted", "excluded", "labelled"
STATES = (LOOKING, SUGGESTED, NONE, DRAFT, ACCEPTED, ADJUSTED, EXCLUDED, LABELLED)
DECIDED = (ACCEPTED, ADJUSTED, EXCLUDED)


@dataclass(frozen=True)
class ReviewedRecording:
    """A recording as listed in the review table."""

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
        """Errors and warnings that have not been accepted."""
        return [f for f in self.findings if not f.accepted and f.severity != "info"]

    @property
    def worst(self) -> str:
        """Severity of the most urgent finding that has not been accepted, or ""."""
        return min((f.severity for f in self.findings if not f.accepted), key=SEVERITIES.index, default="")

    @property
    def done(self) -> bool:
        """True if the recording needs no further decision."""
        return self.state in DECIDED or (self.state == LABELLED and not self.open)


ODD = ("never-stopped", "too-short", "duration", "no-onset", "several-gestures", "stuck", "flat")
"""Checks whose findings make a recording stand out among the others of its gesture."""
_MAX_SIGNALS, _MAX_VISITS = 48, 50


@dataclass(frozen=True)
class ReviewDecision:
    """A decision made in a browser tab about recordings, with the states of their marks before and after it."""

    action: str
    before: Mapping[str, MarkState]
    after: Mapping[str, MarkState]
    check: str = ""
    rows: tuple[int, int] = (0, -1)

    @property
    def recording(self) -> str:
        """The only recording, stream or person that the decision is about, or the first one."""
        return next(iter(self.before))

    def _changed_part(self, marks: MarkState) -> Any:
        """Return the part of a mark state that the decision changes."""
        if self.check:
            return self.check in marks.accepted
        if self.action in ("exclude", "include"):
            return marks.excluded
        if self.action in ("label", "unlabel"):
            return marks.stretches
        if self.action == "relabel":
            return marks.gesture
        return marks.start, marks.stop, marks.how

    def stands(self, identity: str, now: MarkState) -> bool:
        """Return whether the marks still state for ``identity`` what the decision made them state."""
        return bool(self._changed_part(now) == self._changed_part(self.after[identity]))

    def inverse(self, who: str, why: str) -> list[Mark]:
        """Return the marks that undo the decision."""
        start, stop = self.rows
        marks: list[Mark] = []
        for identity, before in self.before.items():
            mark = Mark(identity, self.action, who, start=start, stop=stop, check=self.check)
            marks += inverse_marks(mark, before, who, why)
        return marks


class Review:
    """A data set under review, shared by all pages.

    Methods may be called from any thread; those that read files may take seconds. Each change notifies `changed` and
    increases ``version``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.changed = ChangeSignal()
        self.version = 0
        self._lock = threading.RLock()
        self._reading = threading.Lock()
        self._drafts: dict[str, tuple[int, int]] = {}
        self._read: OrderedDict[str, RecordingSignals] = OrderedDict()
        self._stream: RecordingSignals | None = None
        self._marked_source: Any = None
        self._rows: dict[str, ReviewedRecording] = {}
        self._marks = MarksFollower(path)
        self._states = self._marks.states()
        # The decisions of each browser tab.
        self._histories: OrderedDict[str, list[ReviewDecision]] = OrderedDict()
        self._open()
        self.prepared = ReviewPreparation(self.changed)
        self._rows_source: Any = None
        self.prepared.begin(self.as_marked())

    def _open(self) -> None:
        self._stamp = IndexStamp.of(self.path)
        self.dataset = open_dataset(self.path)
        self.infos = {r.id: r for r in self.dataset.recordings}
        self._affects = {g.label: g.affect for g in self.dataset.gestures.gestures}

    def close(self) -> None:
        """Stop the background thread."""
        self.prepared.close()

    def renew(self) -> None:
        """Read the data set again if files were added; repeat the checks if files or decisions are new."""
        with self._lock:
            now = IndexStamp.of(self.path)
            # What is compared are the raw files and the head.
            new = (now.files, now.head) != (self._stamp.files, self._stamp.head)
            if new:
                self._open()
                self._read.clear()
                self._stream = None
        self.look()
        if new or self.unchecked:
            self.check()

    @property
    def is_labelled(self) -> bool:
        """True if labels define where recordings start and stop, so that they cannot be trimmed."""
        return self.dataset.layout.is_labelled

    # Marks and findings -------------------------------------------------------------------------------------------

    def look(self) -> None:
        """Read marks written by other programs, and notify subscribers if there are new ones.

        Raises:
            DatasetError: if the file of marks is invalid.
        """
        if self._read_marks():
            self._changed()

    def _read_marks(self) -> bool:
        with self._lock:
            before, self._states = self._states, self._marks.states()
            return self._states is not before

    def _changed(self) -> None:
        self.version += 1
        self.changed.notify()

    def standing(self, identity: str) -> MarkState:
        """Return the state of a recording, stream or person according to the marks."""
        return self._states.get(identity, MarkState())

    def as_marked(self) -> Dataset:
        """Return a copy of the data set with the current marks applied, for use in another thread."""
        infos = apply_marks(self.dataset.recordings, dict(self._states), self.dataset.gestures)
        return Dataset(self.path, self.dataset.head, infos, self.dataset.streams)

    def check(self) -> None:
        """Start to repeat the checks in the background."""
        self.prepared.begin(self.as_marked())

    @property
    def unchecked(self) -> int:
        """Number of recordings whose trim, exclusion or gesture has changed since the last check."""
        checked = self.prepared.checked
        if checked is None:
            return 0
        now = {r.id: (r.start, r.stop, r.excluded, r.gesture) for r in self._marked().recordings}
        return sum(now.get(r.id) != (r.start, r.stop, r.excluded, r.gesture) for r in checked.dataset.recordings)

    @property
    def rows(self) -> dict[str, ReviewedRecording]:
        """Recordings by id, in the order of the index; the same dictionary object until something changes."""
        with self._lock:
            source = (self.version, id(self.prepared.checked), len(self.prepared.shapes), id(self.dataset))
            if source != self._rows_source:
                findings: dict[str, list[Finding]] = {}
                for f in self._findings():
                    findings.setdefault(f.recording, []).append(f)
                marked = self._marked().recordings
                self._rows = {info.id: self._row(info, tuple(findings.get(info.id, ()))) for info in marked}
                self._rows_source = source
            return self._rows

    def _row(self, info: RecordingInfo, findings: tuple[Finding, ...]) -> ReviewedRecording:
        suggestion = self.prepared.suggestions.get(info.id)
        return ReviewedRecording(
            info,
            self._state(info, suggestion),
            info.whole_seconds,
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
        """Return the findings about sessions, people and the whole data set."""
        return [f for f in self._findings() if not f.recording]

    def gestures(self) -> list[str]:
        """Return the gestures of the recordings, in the order of the gesture set."""
        present = {info.gesture for info in self._marked().recordings}
        known = [g.label for g in self.dataset.gestures.gestures if g.label in present]
        return [*known, *sorted(present - set(known))]

    def info(self, identity: str) -> RecordingInfo:
        """Return the index entry of a recording; raise DatasetError for an unknown id."""
        try:
            return self.infos[identity]
        except KeyError:
            raise DatasetError("There is no recording “{recording}” in this data set.", recording=identity) from None

    # One recording ------------------------------------------------------------------------------------------------

    def signals(self, identity: str) -> RecordingSignals:
        """Return the signals of a recording; those read last are cached."""
        self.prepared.step_back()
        info = self.info(identity)
        cached = self._read.get(identity)
        if cached is not None and (not len(self.prepared.scale) or not np.isnan(cached.activity).any()):
            return cached
        with self._reading:
            signals = self._read[identity] = read_signals(self.dataset, info, self.prepared.scale)
            self._read.move_to_end(identity)
            while len(self._read) > _MAX_SIGNALS:
                self._read.popitem(last=False)
        return signals

    def stream_signals(self, stream: str) -> RecordingSignals:
        """Return the signals of a stream; those of the last one are cached."""
        if self._stream is None or self._stream.info.id != stream:
            (found,) = labelling.find_streams(self.dataset, stream)
            with self._reading:
                self._stream = read_stream_signals(self.dataset, found)
        return self._stream

    def stream_if_read(self, stream: str) -> RecordingSignals | None:
        """Return the signals of a stream if they are cached."""
        return self._stream if self._stream is not None and self._stream.info.id == stream else None

    def recordings_in(self, stream: str) -> list[RecordingInfo]:
        """Return the recordings that lie in a stream and are not excluded, as the marks trim them."""
        return [r for r in self._marked().used if r.stream == stream and r.stream_row >= 0]

    def stretches(self, stream: str) -> list[LabelledStretch]:
        """Return the labelled stretches of a stream."""
        return [s for s in self._marked().stretches if s.stream == stream]

    def _marked(self) -> Dataset:
        """Return `as_marked`, computed again only after a change."""
        with self._lock:
            source = (self.version, id(self._states), id(self.dataset))
            if self._marked_source != source:
                self._marked_source, self._marked_dataset = source, self.as_marked()
            return self._marked_dataset

    def is_read(self, identity: str) -> bool:
        """Return whether the signals of a recording are cached."""
        return identity in self._read

    def trim(self, identity: str) -> trim.Trim:
        """Return the marks of a recording and its suggestion, which is empty until it has been computed."""
        info = self.info(identity)
        empty = Suggestion(0, info.rows, False, False, 0.0, 0.0, 1.0)
        suggestion = self.prepared.suggestions.get(identity, empty)
        return trim.Trim(info, suggestion, self.standing(identity), self.signals(identity).seconds)

    def draft(self, identity: str) -> tuple[int, int] | None:
        """Return the rows (start, stop) that were set but not yet accepted, or None."""
        return self._drafts.get(identity)

    def kept_rows(self, identity: str, ends: bool = False) -> tuple[int, int]:
        """Return the rows (start, stop) to keep: those of the draft, else the marks, else the suggestion."""
        return self._drafts.get(identity) or self.trim(identity).current_rows(ends)

    def set(self, identity: str, start: int | None = None, stop: int | None = None, ends: bool = False) -> None:
        """Set the start or stop of the draft to a row; rows outside the recording are moved to its edge.

        Raises:
            DatasetError: if the start is not before the stop, or the recording is excluded or cannot be trimmed.
        """
        info = self.info(identity)
        if self.is_labelled:
            raise DatasetError(
                "“{recording}” is cut where the label changes, so there is nothing to trim.", recording=identity
            )
        with self._lock:
            if self.standing(identity).excluded:
                raise DatasetError(
                    "“{recording}” is excluded. Include it again before you trim it.", recording=identity
                )
            first, last = self.kept_rows(identity, ends)
            first = first if start is None else min(max(0, start), info.rows - 1)
            last = last if stop is None else min(max(1, stop), info.rows)
            if last <= first:
                raise DatasetError(
                    "Nothing of “{recording}” would be left. Set the start before the end.", recording=identity
                )
            self._drafts.pop(identity, None)
            if (first, last) != self.trim(identity).current_rows(ends):
                self._drafts[identity] = (first, last)
        self._changed()

    def drop(self, identity: str) -> bool:
        """Discard the draft of a recording, and return whether there was one."""
        with self._lock:
            dropped = self._drafts.pop(identity, None) is not None
        if dropped:
            self._changed()
        return dropped

    # Decisions ----------------------------------------------------------------------------------------------------

    def _decide(
        self,
        visit: str,
        about: Iterable[str],
        action: str,
        make: Callable[[], object],
        check: str = "",
        rows: tuple[int, int] = (0, -1),
    ) -> int:
        """Call ``make`` to write marks, store how to undo them as one decision, and return how many states changed."""
        with self._lock:
            self._read_marks()
            before = {identity: self.standing(identity) for identity in about}
            make()
            self._read_marks()
            after = {i: now for i, then in before.items() if (now := self.standing(i)) != then}
            if after:
                earlier = {i: before[i] for i in after}
                history = self._histories.setdefault(visit, [])
                history.append(ReviewDecision(action, earlier, after, check, rows))
                self._histories.move_to_end(visit)
                while len(self._histories) > _MAX_VISITS:
                    self._histories.popitem(last=False)
        self._changed()
        return len(after)

    def accept(self, visit: str, identity: str, who: str, ends: bool = False) -> bool:
        """Mark the draft or the suggested rows as the rows to keep; return whether the marks changed.

        Rows that equal the suggestion are marked as accepted suggestion, all others as set by hand. Without a draft or
        a suggested start, the whole recording is kept.

        Raises:
            DatasetError: if the marks cannot be written, or the suggestion has not been computed yet.
        """
        with self._lock:
            current, draft = self.trim(identity), self._drafts.get(identity)
            state = self._state(current.recording, self.prepared.suggestions.get(identity))
            if state in (EXCLUDED, LABELLED, ACCEPTED, ADJUSTED):
                return False
            if state == LOOKING:
                raise DatasetError(
                    "The start of “{recording}” is still being computed. Wait a moment, or set it yourself.",
                    recording=identity,
                )
            suggested = current.suggested_rows(ends)
            rows = draft or suggested
            as_suggested = rows == suggested and rows != (0, current.recording.rows)

            def make() -> None:
                if as_suggested and current.state != ADJUSTED:
                    trim.accept_suggestions(self.dataset, [current], who, offset=ends)
                else:
                    trim.set_rows(self.dataset, current, *rows, who)

            changed = self._decide(visit, [identity], "trim", make)
            self._drafts.pop(identity, None)
        self._changed()
        return bool(changed)

    def surer_than(self, above: float, identities: Iterable[str]) -> list[str]:
        """Return those of ``identities`` that have a suggestion of at least this confidence and no decision yet."""
        rows = self.rows
        return [i for i in identities if i in rows and rows[i].state == SUGGESTED and rows[i].confidence >= above]

    def accept_above(
        self, visit: str, identities: Iterable[str], who: str, above: float = 0.0, ends: bool = False
    ) -> int:
        """Accept the suggestions `surer_than` ``above`` as one decision; return how many were accepted."""
        trims = [
            trim.Trim(self.info(i), self.prepared.suggestions[i], self.standing(i), np.empty(0))
            for i in self.surer_than(above, identities)
        ]
        make = partial(trim.accept_suggestions, self.dataset, trims, who, above=above, offset=ends)
        return self._decide(visit, [t.recording.id for t in trims], "trim", make)

    def exclude(self, visit: str, identities: Iterable[str], who: str, why: str) -> int:
        """Exclude recordings as one decision; raise ConfigError if the reason ``why`` is empty."""
        return self._mark(visit, [Mark(self.info(i).id, "exclude", who, _check_reason(why)) for i in identities])

    def include(self, visit: str, identities: Iterable[str], who: str) -> int:
        """Take excluded recordings back into use, as one decision."""
        return self._mark(visit, [Mark(self.info(i).id, "include", who) for i in identities])

    def untrim(self, visit: str, identity: str, who: str) -> int:
        """Remove the trim marks of a recording, so that the suggestion applies again."""
        return self._mark(visit, [Mark(self.info(identity).id, "untrim", who)])

    def relabel(self, visit: str, identities: Sequence[str], gesture: str, who: str, why: str = "") -> int:
        """State as one decision that ``gesture`` was made in recordings; "" restores the recorded one.

        Raises:
            DatasetError: for a gesture that is not in the gesture set.
        """
        make = partial(labelling.relabel_recordings, self.dataset, identities, gesture, who, why)
        return self._decide(visit, identities, "relabel", make)

    def accept_finding(self, visit: str, finding: Finding, who: str, why: str) -> int:
        """Mark a finding as known and harmless; raise ConfigError if the reason ``why`` is empty."""
        return self._mark(visit, [Mark(finding.about, "accept", who, _check_reason(why), check=finding.check)])

    def reopen_finding(self, visit: str, finding: Finding, who: str) -> int:
        """Reopen an accepted finding."""
        return self._mark(visit, [Mark(finding.about, "unaccept", who, check=finding.check)])

    def label(self, visit: str, stream: str, rows: tuple[int, int], label: str, who: str) -> int:
        """Label rows of a stream, or with the label "" remove their labels; return whether the marks changed.

        Raises:
            DatasetError: for an unknown stream or label, or rows that do not exist.
        """
        (found,) = labelling.find_streams(self.dataset, stream)
        if label:
            new = [LabelledStretch(stream, *rows, label)]
            make: Callable[[], object] = partial(labelling.label_stretches, self.dataset, new, who)
        else:
            make = partial(labelling.remove_labels, self.dataset, found.id, rows, who)
        return self._decide(visit, [stream], "label" if label else "unlabel", make, rows=rows)

    def _mark(self, visit: str, marks: Iterable[Mark]) -> int:
        """Write the marks that change something as one decision, and return how many that are."""
        new = [m for m in marks if apply_mark(self.standing(m.recording), m) != self.standing(m.recording)]
        if not new:
            return 0
        make = partial(self.dataset.append_marks, new)
        return self._decide(visit, [m.recording for m in new], new[0].action, make, new[0].check)

    def undo(self, visit: str, who: str, why: str = "") -> ReviewDecision | None:
        """Undo the last decision of a browser tab by writing the inverse marks; return None if there is none.

        What was changed elsewhere since stays; the returned decision is about the other recordings only.

        Raises:
            DatasetError: if everything was changed elsewhere since. The next call undoes an older decision.
        """
        with self._lock:
            if not (history := self._histories.get(visit)):
                return None
            self._read_marks()
            last = history[-1]
            standing = {i: b for i, b in last.before.items() if last.stands(i, self.standing(i))}
            if not standing:
                history.pop()
                raise DatasetError(
                    "“{recording}” has been changed in another window or program since then, so nothing is undone.",
                    recording=last.recording,
                )
            undone = replace(last, before=standing)
            append_marks(self.path, undone.inverse(who, why), self.dataset.generation.check)
            history.pop()
            self._read_marks()
        self._changed()
        return undone

    # Overlay ------------------------------------------------------------------------------------------------------

    def overlay(self, gesture: str) -> GestureOverlay:
        """Return the overlay of all recordings of a gesture that are not excluded; name the checks that flag them."""
        curves = []
        for identity, row in self.rows.items():
            shape = self.prepared.shapes.get(identity)
            if row.info.gesture != gesture or row.state == EXCLUDED or shape is None:
                continue
            standing = self.standing(identity)
            # Assume evenly spaced rows: this is accurate enough for a plot and needs no file access.
            per_row = shape.seconds / max(1, row.info.rows)
            stop = row.info.rows if standing.stop < 0 else standing.stop
            odd = dict.fromkeys(f.check for f in row.open if f.check in ODD)
            curves.append(trimmed_curve(identity, shape, standing.start * per_row, stop * per_row, ", ".join(odd)))
        return build_overlay(curves)


def _check_reason(why: str) -> str:
    if not why.strip():
        raise ConfigError("A reason is missing. Give it in a few words.")
    return why.strip()


_MAX_REVIEWS = 3


class Reviews:
    """Service that provides the reviews, one per data set."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._lock = threading.Lock()
        self._opened: OrderedDict[Path, Review] = OrderedDict()

    def open(self, path: str | os.PathLike[str]) -> Review:
        """Open or update the review of a data set; this may take seconds.

        Raises:
            ConfigError: for a folder outside the studio. DatasetError: if the folder is not a valid data set.
        """
        place = self._workspace.inside(path)
        with self._lock:
            review = self._opened.get(place)
            if review is None:
                review = self._opened[place] = Review(place)
            else:
                review.renew()
            self._opened.move_to_end(place)
            oldest = [self._opened.popitem(last=False)[1] for _ in range(len(self._opened) - _MAX_REVIEWS)]
        for each in oldest:
            each.close()
        return review

    def close(self) -> None:
        """Stop the background threads of all reviews."""
        for review in self._opened.values():
            review.close()
