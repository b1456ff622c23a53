"""Trimming: what is suggested for each recording, and accepting, adjusting or undoing it. Marks only.

By default the start alone is trimmed, as in the paper: what comes before the onset is a person's reaction time, while
where a gesture ends is often a matter of taste (docs/trim.md has both errors). A mark that a person set by hand is
never replaced by a suggestion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.recfile import Frames
from plushsense.dataset.marks import BY_HAND, SUGGESTED, Mark, Standing, append_marks, matching, read_marks
from plushsense.dataset.onset import CONTEXT_S, Suggestion, suggest
from plushsense.dataset.store import Dataset, RecordingInfo

STATES = ("none", "suggested", "accepted", "adjusted")


@dataclass(frozen=True)
class Trim:
    """One recording: what is suggested, and what stands.

    ``seconds`` (rows + 1,): the device clock since the first row, at each row and at the end; a clock that was reset
    goes on from there. ``state``: "none" (nothing to suggest, no mark), "suggested", "accepted" (a suggestion was),
    "adjusted" (a person set it).
    """

    recording: RecordingInfo
    suggestion: Suggestion
    standing: Standing
    seconds: NDArray[np.float64]

    @property
    def state(self) -> str:
        """One of `STATES`."""
        if self.standing.trimmed:
            return "accepted" if self.standing.how == SUGGESTED else "adjusted"
        return "suggested" if self.suggestion.onset_visible else "none"

    def rows(self, offset: bool = False, above: float = 0.0) -> tuple[int, int]:
        """The rows that accepting would keep, all of them where the start is not visible or less sure than ``above``.

        With ``offset`` the end goes too, where it is visible and as sure.
        """
        s = self.suggestion
        if not s.onset_visible or s.onset_confidence < above:
            return 0, self.recording.rows
        ends = offset and s.offset_visible and s.offset_confidence >= above
        return s.start, s.stop if ends else self.recording.rows

    def shown(self, offset: bool = False) -> tuple[int, int]:
        """The rows that a mark keeps, or else those suggested."""
        if not self.standing.trimmed:
            return self.rows(offset)
        stop = self.recording.rows if self.standing.stop < 0 else min(self.standing.stop, self.recording.rows)
        return min(self.standing.start, stop), stop

    def to_dict(self, offset: bool = False) -> dict[str, Any]:
        """Plain values, ready for JSON: what stands (or is suggested), and the whole suggestion beside it."""
        start, stop = self.shown(offset)
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
class Accepted:
    """What accepting did: ids marked, already so, without a visible onset (or below the confidence), kept by hand."""

    marked: tuple[str, ...] = ()
    already: tuple[str, ...] = ()
    not_visible: tuple[str, ...] = ()
    kept_by_hand: tuple[str, ...] = ()


def trims(
    dataset: Dataset,
    recordings: Iterable[RecordingInfo] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Trim]:
    """The suggestion and the state of each recording, in the order of the index.

    Args:
        recordings: which; by default those that no mark excludes.

    Raises:
        DatasetError: for a data set whose recordings are cut from labels, which need no trimming.
    """
    if dataset.layout.is_labelled:
        raise DatasetError(
            f"The recordings of '{dataset.head.name}' are cut where the label on the rows changes (layout "
            f"'{dataset.layout.name}'), so there is no reaction time to trim: trim data sets of single recordings."
        )
    chosen = list(dataset.used if recordings is None else recordings)
    standing = read_marks(dataset.path)
    nobody = {g.label for g in dataset.gestures.gestures if g.nobody}
    found = {}
    # By stream: the data set keeps the one that was read last.
    for done, info in enumerate(sorted(chosen, key=lambda r: (r.stream, r.id)), 1):
        frames = dataset.read(replace(info, start=0, stop=info.rows))
        if info.gesture in nobody:
            said = Suggestion(0, info.rows, False, False, 0.0, 0.0, 1.0, "rest: all of it is the gesture")
        else:
            said = suggest(frames, dataset.layout, _before(dataset, info))
        found[info.id] = Trim(info, said, standing.get(info.id, Standing()), seconds_of_rows(frames))
        if progress is not None:
            progress(done, len(chosen))
    return [found[info.id] for info in chosen]


def _before(dataset: Dataset, info: RecordingInfo) -> Frames | None:
    """What the stream held just before the recording; None where it is in no stream."""
    if info.stream_row <= 0:
        return None
    first = info.stream_row - math.ceil(CONTEXT_S * max(info.rate_hz, 1.0))
    return dataset.read_stream(info.stream).slice(max(0, first), info.stream_row)


def seconds_of_rows(frames: Frames) -> NDArray[np.float64]:
    """The device clock since the first row, at each row and at the end, (T + 1,); one that was reset goes on."""
    steps = np.maximum(np.diff(frames.device_ms), 0)
    usual = float(np.median(steps)) if len(steps) else 0.0
    return np.concatenate([[0.0], np.cumsum(steps), [float(steps.sum()) + usual]]) / 1000.0


def choose(dataset: Dataset, pattern: str) -> list[RecordingInfo]:
    """The recordings that an id or a pattern with ``*`` and ``?`` names.

    Raises:
        DatasetError: when it names none.
    """
    ids = {r.id: r for r in dataset.recordings}
    return [ids[identity] for identity in matching(pattern, ids, "recording")]


def accept(
    dataset: Dataset, chosen: Iterable[Trim], who: str, why: str = "", *, above: float = 0.0, offset: bool = False
) -> Accepted:
    """Mark `Trim.rows` of what is suggested: starts of at least the confidence ``above``, with ``offset`` ends too.

    A mark set by hand stays, and a mark that is there already is not made again. The data set that was opened does not
    change: open it anew.
    """
    marks, already, not_visible, by_hand = [], [], [], []
    for trim in chosen:
        info = trim.recording
        start, stop = trim.rows(offset, above)
        if trim.state == "adjusted":
            by_hand.append(info.id)
        elif (start, stop) == (0, info.rows):
            not_visible.append(info.id)
        elif trim.standing.how == SUGGESTED and trim.shown() == (start, stop):
            already.append(info.id)
        else:
            end = stop if stop < info.rows else -1
            marks.append(Mark(info.id, "trim", who, why, start=start, stop=end, how=SUGGESTED))
    _append(dataset, marks)
    return Accepted(tuple(m.recording for m in marks), tuple(already), tuple(not_visible), tuple(by_hand))


def kept_rows(trim: Trim, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
    """The rows of a recording from ``start_s`` to ``stop_s`` (None: its edge).

    Raises:
        DatasetError: for times outside the recording, or that keep nothing.
    """
    info, end_s = trim.recording, float(trim.seconds[-1])
    for value in (start_s, stop_s):
        if value is not None and not 0.0 <= value <= end_s + 1e-3:
            raise DatasetError(f"'{info.id}' cannot be trimmed at {value:g} s: it runs from 0 to {end_s:.3f} s.")
    # Half a millisecond: what is printed is rounded to whole ones.
    start = 0 if start_s is None else int(np.searchsorted(trim.seconds, start_s - 5e-4))
    stop = info.rows if stop_s is None else int(np.searchsorted(trim.seconds, stop_s - 5e-4))
    start, stop = min(start, info.rows), min(stop, info.rows)
    if stop <= start:
        raise DatasetError(
            f"'{info.id}' has no row from {start_s or 0:g} to {end_s if stop_s is None else stop_s:g} s: give a later "
            "end or an earlier start."
        )
    return start, stop


def set_trim(
    dataset: Dataset, trim: Trim, start_s: float | None, stop_s: float | None, who: str, why: str = ""
) -> bool:
    """Mark `kept_rows` of a recording, as set by hand; False where that stood already."""
    return set_rows(dataset, trim, *kept_rows(trim, start_s, stop_s), who, why)


def set_rows(dataset: Dataset, trim: Trim, start: int, stop: int, who: str, why: str = "") -> bool:
    """Mark rows ``start`` to ``stop`` of a recording, all of them too, as set by hand; False where that stood already.

    Raises:
        DatasetError: for rows that are not there, or none.
    """
    info = trim.recording
    if not 0 <= start < stop <= info.rows:
        raise DatasetError(f"'{info.id}' has rows 0 to {info.rows}: {start} to {stop} cannot be kept.")
    if trim.state == "adjusted" and trim.shown() == (start, stop):
        return False
    end = stop if stop < info.rows else -1
    _append(dataset, [Mark(info.id, "trim", who, why, start=start, stop=end, how=BY_HAND)])
    return True


def renewed(dataset: Dataset, trims: Iterable[Trim]) -> list[Trim]:
    """The same suggestions with the marks as they stand now."""
    standing = read_marks(dataset.path)
    return [replace(t, standing=standing.get(t.recording.id, Standing())) for t in trims]


def undo(dataset: Dataset, recordings: Sequence[RecordingInfo], who: str, why: str = "") -> tuple[str, ...]:
    """Take back the trim of recordings, however it came about; returns the ids of those that had one."""
    standing = read_marks(dataset.path)
    marked = [r.id for r in recordings if standing.get(r.id, Standing()).trimmed]
    _append(dataset, [Mark(identity, "untrim", who, why) for identity in marked])
    return tuple(marked)


def _append(dataset: Dataset, marks: list[Mark]) -> None:
    if marks:
        append_marks(dataset.path, marks)
