"""Understand the markers of a stream, and cut another stream into recordings by them.

A marker that names a gesture begins a recording. ``start Tail pull`` and ``Tail pull/begin`` begin one too; ``end``,
``stop``, ``end Tail pull`` and the like, and 0 if it is no gesture, only end one. All channels of a marker are read,
and the values of JSON. Without a gesture set, every other marker is the name of a gesture.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet, plain_label
from plushsense.core.recorder_csv import LONGEST_LABEL, parse_name, recording_filename
from plushsense.dataset.importing.tables import LabelledSegment

# After clock synchronisation, equal times may differ by this much.
_SAME_S = 1e-6
# A time earlier than the one before by more than this is that of a clock that was reset.
_RESET_S = 1.0
_BEGIN_WORDS, _END_WORDS = r"start(?:ed)?|begin|onset", r"end(?:ed)?|stop(?:ped)?|finish(?:ed)?|offset"
_BEGIN = re.compile(rf"^(?:{_BEGIN_WORDS})[\s_:/-]+(?P<a>.+)$|^(?P<b>.+)[\s_:/-]+(?:{_BEGIN_WORDS})$", re.IGNORECASE)
_END = re.compile(rf"^(?:{_END_WORDS})(?:[\s_:/-].*)?$|^.*[\s_:/-](?:{_END_WORDS})$", re.IGNORECASE)
# Words that say no gesture: in one of several channels or in JSON, and for a whole experiment.
_PARTS = r"(?:(?:experiment|session|block|task|trial|event|stim(?:ulus)?|cue|gesture|marker)[\s_:/-]*)?"
_ON = re.compile(rf"{_PARTS}(?:{_BEGIN_WORDS}|on)", re.IGNORECASE)
_OFF = re.compile(rf"{_PARTS}(?:{_END_WORDS}|off)", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?[\d.]+(?:e[+-]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class Marker:
    """Time of a marker in seconds, its text, the gesture that it begins ("" for none), and whether it ends one."""

    time_s: float
    text: str
    label: str = ""
    ends: bool = False


@dataclass
class MarkerCuts:
    """The recordings that markers delimit, and the texts of markers that are not quite one.

    Attributes:
        segments: the recordings, in the order of the rows.
        unknown: markers that neither name a gesture nor end one.
        zeros: markers 0, which end a recording.
        empty: markers that name a gesture at a time of which the stream has no rows.
        shortened: markers of recordings that begin before the stream or end after it, or that end at an unknown marker.
    """

    segments: list[LabelledSegment] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)
    zeros: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    shortened: list[str] = field(default_factory=list)


def read_marker(time_s: float, sample: Sequence[Any], gestures: GestureSet | None) -> Marker | None:
    """Return what the channels ``sample`` of a marker mean; None if they are empty."""
    parts = [part for value in sample for part in _texts(value)]
    if not parts:
        return None
    text = " ".join(parts)
    words = [part for part in parts if not _NUMBER.fullmatch(part)] or parts
    several = len(parts) > 1
    ends = bool(_END.match(text)) or text == "0" or (several and any(map(_OFF.fullmatch, parts)))
    if gestures is None:
        names = [part for part in words if not _ON.fullmatch(part)]
        name = _without_begin(names[0]) if len(names) == 1 and not ends else ""
        label = name if not _END.match(name) and _is_usable(name) else ""
    else:
        label = _gesture(gestures, [text]) or ("" if ends else _gesture(gestures, parts))
    return Marker(time_s, text, label, ends and not label)


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in a channel of a marker: itself, or the values of JSON."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)
    elif isinstance(value, str):
        # Texts of fixed length are filled up with NUL.
        text = " ".join("".join(c if c.isprintable() else " " for c in value.partition("\0")[0]).split())
        try:
            found = json.loads(text) if text[:1] in ("{", "[") else None
        except (ValueError, RecursionError):
            found = None
        if found is not None:
            yield from _texts(found)
        elif text:
            yield text
    elif isinstance(value, int | float | np.number) and not isinstance(value, bool):
        yield f"{value:.15g}"


def _without_begin(text: str) -> str:
    begin = _BEGIN.match(text)
    return (begin["a"] or begin["b"]) if begin else text


def _gesture(gestures: GestureSet, texts: Sequence[str]) -> str:
    """Return the label of the only gesture that ``texts`` name, with or without a word for its begin; else ""."""
    found = [gestures.find(text) or gestures.find(_without_begin(text)) for text in texts]
    labels = {gesture.label for gesture in found if gesture is not None}
    return labels.pop() if len(labels) == 1 else ""


def _is_usable(label: str) -> bool:
    """Return whether a label can be the name of a gesture and of a file."""
    name = parse_name(recording_filename(label, 0, 0)) if label else None
    return name is not None and bool(plain_label(name.label)) and len(label) <= LONGEST_LABEL // 2


def cut_by_markers(
    markers: Sequence[Marker], times_s: NDArray[np.float64], resets: Sequence[int] = (), tolerance_s: float = 0.1
) -> MarkerCuts:
    """Return the recordings that ``markers`` delimit in a stream with rows at ``times_s`` (T,).

    A recording ends at the next marker that begins or ends one, or with the stream; at one that does neither, if the
    markers name no ends. Where a clock was reset, it ends too, and the rows and markers before and after are apart: if
    the times of both go back as often, their parts belong together in order, else by time.

    Args:
        resets: rows that are the first after a reset of the clock, though their times may be later than those before.
        tolerance_s: how far a recording may reach beyond the rows without being shortened.
    """
    cuts = MarkerCuts(unknown=[m.text for m in markers if not m.label and not m.ends])
    cuts.zeros += [m.text for m in markers if m.ends and m.text == "0"]
    rows, groups = _runs(times_s, resets), _runs(np.array([m.time_s for m in markers]), ())
    paired = len(rows) == len(groups)
    for at, group in enumerate(groups if paired else [slice(0, len(markers))]):
        for begin, end_s, early in _intervals(sorted(markers[group], key=lambda m: m.time_s)):
            found = _place(begin.time_s, end_s, times_s, [rows[at]] if paired else rows, tolerance_s)
            if found is None:
                cuts.empty.append(begin.text)
                continue
            first, last, shortened = found
            cuts.segments.append(LabelledSegment(begin.label, first, last))
            if shortened or early:
                cuts.shortened.append(begin.text)
    cuts.segments.sort(key=lambda segment: segment.start)
    return cuts


def _runs(times_s: NDArray[np.float64], resets: Sequence[int]) -> list[slice]:
    """Return the parts of ``times_s`` in which no clock was reset: before ``resets``, and where times go back."""
    back = np.flatnonzero(np.diff(times_s) < -_RESET_S) + 1
    edges = sorted({0, *resets, *back.tolist(), len(times_s)})
    return [slice(a, b) for a, b in itertools.pairwise(edges) if b > a]


def _intervals(markers: Sequence[Marker]) -> Iterator[tuple[Marker, float, bool]]:
    """Yield the marker that begins each recording, the time of its end, and whether an unknown marker ends it."""
    closed = 2 * sum(m.ends for m in markers) > sum(m.label != "" for m in markers)
    ends_next = [False] * len(markers)
    for i in range(len(markers) - 2, -1, -1):
        after = markers[i + 1]
        ends_next[i] = after.ends or (not after.label and ends_next[i + 1])
    begin: Marker | None = None
    for marker, ended_later in zip(markers, ends_next, strict=True):
        known = marker.label != "" or marker.ends
        if begin is not None and (known or not (closed and ended_later)):
            yield begin, marker.time_s, not known
            begin = None
        if marker.label:
            begin = marker
    if begin is not None:
        yield begin, np.inf, False


def _place(
    begin_s: float, end_s: float, times_s: NDArray[np.float64], runs: Sequence[slice], tolerance_s: float
) -> tuple[int, int, bool] | None:
    """Return the rows of an interval that lies in one run, first and last (exclusive), and whether it is longer."""
    inside = [r for r in runs if times_s[r.start] - _SAME_S <= begin_s <= times_s[r.stop - 1]]
    inside = inside or [r for r in runs if begin_s < times_s[r.start] < end_s][:1]
    if len(inside) != 1:
        return None
    (run,) = inside
    rising = np.maximum.accumulate(times_s[run])
    first, last = (run.start + int(np.searchsorted(rising, t - _SAME_S)) for t in (begin_s, end_s))
    if first >= last:
        return None
    beyond = begin_s < rising[0] - tolerance_s or rising[-1] + tolerance_s < end_s < np.inf
    return first, last, bool(beyond)
