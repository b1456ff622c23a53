"""Trim recordings by marks: suggest trims from the detected onset, and accept, adjust or undo them.

By default only the start is trimmed, as in the paper: the rows before the onset are reaction time, whereas people
disagree about the end of a gesture (docs/trim.md reports both errors). A suggestion never replaces a trim that a person
set by hand.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import bridged_ms, stray_rows
from plushsense.dataset.index import as_dataset
from plushsense.dataset.marks import BY_HAND, SUGGESTED, Mark, MarkState, match_ids, read_marks
from plushsense.dataset.onset import CONTEXT_S, Suggestion, suggest
from plushsense.dataset.quality.checking import author_name
from plushsense.dataset.store import Dataset, Progress, RecordingInfo

STATES = ("none", "suggested", "accepted", "adjusted")


@dataclass(frozen=True)
class Trim:
    """Suggested trim of one recording, and its current state by the marks.

    ``seconds`` (rows + 1,) are the times of its rows and its end, see `row_times_s`.
    """

    recording: RecordingInfo
    suggestion: Suggestion
    mark_state: MarkState
    seconds: NDArray[np.float64]

    @property
    def state(self) -> str:
        """One of `STATES`: "accepted" for a trim that was suggested, "adjusted" for one that a person set by hand."""
        if self.mark_state.trimmed:
            return "accepted" if self.mark_state.how == SUGGESTED else "adjusted"
        return "suggested" if self.suggestion.onset_visible else "none"

    def suggested_rows(self, offset: bool = False, above: float = 0.0) -> tuple[int, int]:
        """Return the rows that the suggestion keeps: all if the onset is not visible or its confidence below ``above``.

        With ``offset`` the end is trimmed too, if the offset is visible and its confidence at least ``above``.
        """
        s = self.suggestion
        if not s.onset_visible or s.onset_confidence < above:
            return 0, self.recording.rows
        ends = offset and s.offset_visible and s.offset_confidence >= above
        return s.start, s.stop if ends else self.recording.rows

    def current_rows(self, offset: bool = False) -> tuple[int, int]:
        """Return the rows that the current mark keeps; without a mark, those that the suggestion keeps."""
        if not self.mark_state.trimmed:
            return self.suggested_rows(offset)
        stop = self.recording.rows if self.mark_state.stop < 0 else min(self.mark_state.stop, self.recording.rows)
        return min(self.mark_state.start, stop), stop

    def to_dict(self, offset: bool = False) -> dict[str, object]:
        """Return plain values for JSON: `current_rows` and the suggestion."""
        start, stop = self.current_rows(offset)
        s = self.suggestion
        return {
            "recording": self.recording.id,
            "gesture": self.recording.gesture,
            "rows": self.recording.rows,
            "start": start,
            "stop": stop,
            "start_s": round(float(self.seconds[start]), 3),
            "stop_s": round(float(self.seconds[stop]), 3),
            "confidence": s.onset_confidence,
            "state": self.state,
            "suggested_start_s": round(float(self.seconds[s.start]), 3) if s.onset_visible else None,
            "suggested_stop_s": round(float(self.seconds[s.stop]), 3) if s.offset_visible else None,
            "offset_confidence": s.offset_confidence,
            "note": s.why,
        }


@dataclass(frozen=True)
class AcceptedTrims:
    """Ids of recordings by the result of accepting: marked, marked before, no sure onset, trimmed by hand."""

    marked: tuple[str, ...] = ()
    already: tuple[str, ...] = ()
    not_visible: tuple[str, ...] = ()
    kept_by_hand: tuple[str, ...] = ()


def suggest_trims(
    dataset: Dataset, recordings: Iterable[RecordingInfo] | None = None, progress: Progress | None = None
) -> list[Trim]:
    """Return the suggestion and the state of each of ``recordings``, by default of all that are not excluded.

    Raises:
        DatasetError: for a data set with a label on every row, whose recordings need no trimming.
    """
    if dataset.layout.is_labelled:
        raise DatasetError(
            "The recordings of '{dataset}' are cut where the label on the rows changes (layout '{layout}'), so there "
            "is no reaction time to trim: trim data sets of single recordings.",
            dataset=dataset.head.name,
            layout=dataset.layout.name,
        )
    chosen = list(dataset.used if recordings is None else recordings)
    marks = read_marks(dataset.path)
    nobody = {g.label for g in dataset.gestures.gestures if g.nobody}
    trims = {}
    # Sort by stream, since the data set caches only the last one.
    for done, info in enumerate(sorted(chosen, key=lambda r: (r.stream, r.id)), 1):
        frames = dataset.read(replace(info, start=0, stop=info.rows))
        if info.gesture in nobody:
            suggestion = Suggestion(0, info.rows, False, False, 0.0, 0.0, 1.0, "rest: all of it is the gesture")
        else:
            suggestion = suggest(frames, dataset.layout, _before(dataset, info))
        trims[info.id] = Trim(
            info, suggestion, marks.get(info.id, MarkState()), row_times_s(frames, dataset.layout.gap_ms)
        )
        if progress is not None:
            progress(done, len(chosen))
    return [trims[info.id] for info in chosen]


def _before(dataset: Dataset, info: RecordingInfo) -> Frames | None:
    """Return the rows of the stream just before the recording; None if it is in no stream."""
    if info.stream_row <= 0:
        return None
    first = info.stream_row - math.ceil(CONTEXT_S * max(info.rate_hz, 1.0))
    return dataset.read_stream(info.stream).slice(max(0, first), info.stream_row)


def row_times_s(frames: Frames, gap_ms: float) -> NDArray[np.float64]:
    """Return the device time in s since the first row, of each row and of the end, (T + 1,).

    Clock resets are 0 s. The times of `stray_rows` are evenly between those around them.
    """
    clock = bridged_ms(frames.device_ms, stray_rows(frames.device_ms, gap_ms))
    steps = np.maximum(np.diff(clock), 0)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.concatenate([[0.0], np.cumsum(steps), [float(steps.sum()) + usual]]) / 1000.0


def find_recordings(dataset: Dataset, pattern: str) -> list[RecordingInfo]:
    """Return the recordings that ``pattern`` (an id, or with ``*`` and ``?``) matches; raise DatasetError if none."""
    ids = {r.id: r for r in dataset.recordings}
    return [ids[identity] for identity in match_ids(pattern, ids, "recording")]


def accept_suggestions(
    dataset: Dataset, chosen: Iterable[Trim], who: str, why: str = "", *, above: float = 0.0, offset: bool = False
) -> AcceptedTrims:
    """Accept suggestions by marks: onsets of at least confidence ``above``, with ``offset`` also such offsets.

    Trims set by hand stay, and existing marks are not written again. ``dataset`` is not updated: open it again.
    """
    marks, not_visible, by_hand = [], [], []
    for trim in chosen:
        info, rows = trim.recording, trim.suggested_rows(offset, above)
        if trim.state == "adjusted":
            by_hand.append(info.id)
        elif rows == (0, info.rows):
            not_visible.append(info.id)
        else:
            marks.append(_trim_mark(info, rows, who, why, SUGGESTED))
    marked = tuple(m.recording for m in dataset.append_marks(marks))
    already = tuple(m.recording for m in marks if m.recording not in marked)
    return AcceptedTrims(marked, already, tuple(not_visible), tuple(by_hand))


def _trim_mark(info: RecordingInfo, rows: tuple[int, int], who: str, why: str, how: str) -> Mark:
    start, stop = rows
    return Mark(info.id, "trim", who, why, start=start, stop=stop if stop < info.rows else -1, how=how)


def kept_rows(trim: Trim, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
    """Return the rows of a recording from ``start_s`` to ``stop_s`` (None: its start or end).

    Raises:
        DatasetError: for times outside the recording, or without a row between them.
    """
    info, end_s = trim.recording, float(trim.seconds[-1])
    for value in (start_s, stop_s):
        if value is not None and not 0.0 <= value <= end_s + 1e-3:
            raise DatasetError(f"'{info.id}' cannot be trimmed at {value:g} s: it runs from 0 to {end_s:.3f} s.")
    # Allow half a millisecond, since displayed times are rounded to milliseconds.
    start = 0 if start_s is None else int(np.searchsorted(trim.seconds, start_s - 5e-4))
    stop = info.rows if stop_s is None else int(np.searchsorted(trim.seconds, stop_s - 5e-4))
    start, stop = min(start, info.rows), min(stop, info.rows)
    if stop <= start:
        raise DatasetError(
            f"'{info.id}' has no row from {start_s or 0:g} to {end_s if stop_s is None else stop_s:g} s: keep more."
        )
    return start, stop


def set_rows(dataset: Dataset, trim: Trim, start: int, stop: int, who: str, why: str = "") -> bool:
    """Trim a recording by hand to the rows ``start`` to ``stop``; return False if that is its current mark.

    Raises:
        DatasetError: for an empty range, or rows that do not exist.
    """
    info = trim.recording
    if not 0 <= start < stop <= info.rows:
        raise DatasetError(
            "'{recording}' has rows 0 to {rows}: {start} to {stop} cannot be kept.",
            recording=info.id,
            rows=info.rows,
            start=start,
            stop=stop,
        )
    return bool(dataset.append_marks([_trim_mark(info, (start, stop), who, why, BY_HAND)]))


def refresh_trims(dataset: Dataset, trims: Iterable[Trim]) -> list[Trim]:
    """Return ``trims`` with the state by the marks on disk."""
    marks = read_marks(dataset.path)
    return [replace(t, mark_state=marks.get(t.recording.id, MarkState())) for t in trims]


@dataclass(frozen=True)
class TrimResult:
    """Result of `decide_trims`: the new state of the recordings, and the ids of those that got a mark."""

    dataset: Dataset
    trims: tuple[Trim, ...]
    accepted: AcceptedTrims
    adjusted: tuple[str, ...]
    undone: tuple[str, ...]

    @property
    def changed(self) -> frozenset[str]:
        """Ids of the recordings that got a mark."""
        return frozenset((*self.accepted.marked, *self.adjusted, *self.undone))

    @property
    def states(self) -> dict[str, int]:
        """Number of recordings in each of `STATES`."""
        return dict(Counter(t.state for t in self.trims))


@dataclass(frozen=True)
class TrimDecisions:
    """Decisions on trims.

    Attributes:
        only: id or pattern of the recordings to suggest trims for; by default all that are not excluded.
        accept: ids or patterns of the recordings whose suggestion is accepted.
        above: least confidence to accept, 0 to 1; without ``accept``, suggestions for all of ``only`` are accepted.
        keep: (id, from, to) in seconds to set by hand; None for the start or end of the recording.
        undo: ids or patterns of the recordings whose trim is undone.
        offset: whether to accept suggested ends, too.
        who, why: name (by default the login name) and reason for the marks.
    """

    only: str = "*"
    accept: Sequence[str] = ()
    above: float | None = None
    keep: Sequence[tuple[str, float | None, float | None]] = ()
    undo: Sequence[str] = ()
    offset: bool = False
    who: str | None = None
    why: str = ""

    def __post_init__(self) -> None:
        if self.above is not None and not 0.0 <= self.above <= 1.0:
            raise ConfigError(f"Accepting above {self.above:g}: a confidence from 0 to 1 is accepted.")


def decide_trims(
    dataset: Dataset | str | os.PathLike[str], decisions: TrimDecisions | None = None, progress: Progress | None = None
) -> TrimResult:
    """Suggest trims, and write marks for the given decisions.

    Args:
        progress: called with (recordings done, number of recordings).

    Raises:
        ConfigError: for an id in ``keep`` that matches several recordings.
        DatasetError: for unknown recordings, or times outside a recording. In both cases no mark is written.
    """
    dataset, d = as_dataset(dataset), decisions or TrimDecisions()
    chosen = dataset.used if d.only == "*" else find_recordings(dataset, d.only)
    listed = {t.recording.id: t for t in suggest_trims(dataset, chosen, progress)}
    undone = {r.id: r for pattern in d.undo for r in find_recordings(dataset, pattern)}
    by_name = {r.id: r for pattern in d.accept for r in find_recordings(dataset, pattern)}
    to_keep = []
    for identity, start_s, stop_s in d.keep:
        (info, *others) = find_recordings(dataset, identity)
        if others:
            raise ConfigError(f"One recording is set at a time, and '{identity}' names {1 + len(others)}: give an id.")
        to_keep.append((info, start_s, stop_s))
    more = [r for r in [*by_name.values(), *(i for i, _, _ in to_keep)] if r.id not in listed]
    every = listed | {t.recording.id: t for t in suggest_trims(dataset, more)}
    rows = [(info, kept_rows(every[info.id], start_s, stop_s)) for info, start_s, stop_s in to_keep]
    accepting = bool(by_name) or d.above is not None
    name = author_name(d.who) if accepting or undone or to_keep else ""
    # All arguments are valid: write the marks.
    undoing = dataset.append_marks([Mark(identity, "untrim", name, d.why) for identity in undone])
    adjusting = dataset.append_marks([_trim_mark(info, kept, name, d.why, BY_HAND) for info, kept in rows])
    accepted = AcceptedTrims()
    if accepting:
        again = refresh_trims(dataset, [every[identity] for identity in (by_name or listed)])
        accepted = accept_suggestions(dataset, again, name, d.why, above=d.above or 0.0, offset=d.offset)
    adjusted, undone_ids = (tuple(mark.recording for mark in marks) for marks in (adjusting, undoing))
    return TrimResult(dataset, tuple(refresh_trims(dataset, listed.values())), accepted, adjusted, undone_ids)
