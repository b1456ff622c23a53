"""What a gate is fitted on: even samples of people's streams, with what was going on in each of them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.windows.clock import Segment, resample
from plushsense.windows.cut import recordings_in_time
from plushsense.windows.features import inputs

BETWEEN, CALM, LEFT_OUT = -1, -2, -3
"""Of a sample: between recordings; in one of a gesture that is not energetic; what nobody can tell."""

GUARD_S = 0.7
"""So long before and after an energetic recording nobody can tell: the hand may begin early and end late."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Even samples without a break: ``x`` (T, I) raw inputs, ``what`` (T,) an index of `Material.trials` or one of
    `BETWEEN`, `CALM`, `LEFT_OUT`, ``calm`` (T,) the recording of a calm sample (an index into ``Material.calm``), else
    -1."""

    subject: str
    x: NDArray[np.int64]
    what: NDArray[np.int64]
    calm: NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """Stretches of some people; ``trials`` are their energetic recordings, ``calm`` the others, as (id, gesture)."""

    stretches: tuple[Stretch, ...]
    trials: tuple[tuple[str, str], ...]
    calm: tuple[tuple[str, str], ...]
    rate_hz: float

    def hours(self, what: int) -> float:
        """How long something went on, all stretches together."""
        return sum(int((s.what == what).sum()) for s in self.stretches) / self.rate_hz / 3600


def material_of(dataset: Dataset, gestures: GestureSet, subjects: Collection[str]) -> Material:
    """The streams of ``subjects``, and their recordings that lie in no stream.

    What is energetic ``gestures`` say. Free choice, labels that are not among them, excluded recordings and those
    that nobody stopped in time are left out: nobody knows what they hold.
    """
    layout = dataset.layout
    people = set(subjects)
    mine = [r for r in dataset.recordings if r.subject in people]
    in_time = {r.id for r in recordings_in_time([r for r in mine if not r.excluded])}
    trials: list[tuple[str, str]] = []
    calm: list[tuple[str, str]] = []
    stretches: list[Stretch] = []

    def kind(r: RecordingInfo) -> int:
        found = gestures.find(r.gesture)
        if r.id not in in_time or found is None or found.free_choice:
            return LEFT_OUT
        if found.energetic:
            trials.append((r.id, found.label))
            return len(trials) - 1
        calm.append((r.id, found.label))
        return CALM

    def add(subject: str, segments: list[Segment], rows: list[tuple[int, int, RecordingInfo]], rest: int) -> None:
        guard = layout.samples(GUARD_S)
        kinds = [(first, last, kind(r)) for first, last, r in rows]
        at_calm, numbers = len(calm) - sum(k == CALM for _, _, k in kinds), []
        for _, _, k in kinds:
            numbers.append(at_calm if k == CALM else -1)
            at_calm += k == CALM
        for segment in segments:
            what = np.full(len(segment), rest)
            which = np.full(len(segment), -1)
            spans = [np.searchsorted(segment.row_of, edge, side="left").tolist() for edge in [k[:2] for k in kinds]]
            for (first, last), (_, _, k) in zip(spans, kinds, strict=True):
                if k >= 0 and last > first:
                    around = what[max(0, first - guard) : last + guard]
                    around[around == BETWEEN] = LEFT_OUT
            for (first, last), (_, _, k), number in zip(spans, kinds, numbers, strict=True):
                what[first:last], which[first:last] = k, number
            stretches.append(Stretch(subject, inputs(segment.data, layout), what, which))

    for stream in dataset.streams:
        if stream.subject in people:
            located = [
                (r.stream_row + r.start, r.stream_row + r.stop, r)
                for r in mine
                if r.stream == stream.id and r.stream_row >= 0
            ]
            add(stream.subject, resample(dataset.read_stream(stream.id), layout), located, BETWEEN)
    for r in mine:
        if r.stream_row < 0 and r.id in in_time:
            frames = dataset.read(r)
            add(r.subject, resample(frames, layout), [(0, len(frames), r)], LEFT_OUT)
    return Material(tuple(stretches), tuple(trials), tuple(calm), layout.rate_hz)
