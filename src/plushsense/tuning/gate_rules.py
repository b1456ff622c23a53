"""Collect the samples that a gate is fitted on, and choose rules of one or two terms by recall and false alarms."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.runtime.fixed import Ints
from plushsense.windows.clock import Segment
from plushsense.windows.cut import recordings_in_time
from plushsense.windows.features import network_inputs
from plushsense.windows.sessions import SessionReader

BETWEEN, CALM, LEFT_OUT = -1, -2, -3
"""Kinds of samples: between recordings; in a recording of a gesture that is not energetic; of unknown content."""

GUARD_S = 0.7
"""Margin around an energetic recording that is left out: the gesture may begin early and end late."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Evenly spaced samples of one person without a break.

    ``x`` (T, I): raw inputs. ``trial`` (T,): index of the energetic recording in `Material.trials`, or `BETWEEN`,
    `CALM` or `LEFT_OUT`. ``calm`` (T,): index of the recording of a calm sample in `Material.calm`, else -1.
    """

    subject: str
    x: NDArray[np.int64]
    trial: NDArray[np.int64]
    calm: NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """Stretches of some people; ``trials`` are their energetic recordings, ``calm`` their others, as (id, gesture)."""

    stretches: tuple[Stretch, ...]
    trials: tuple[tuple[str, str], ...]
    calm: tuple[tuple[str, str], ...]
    rate_hz: float

    def hours(self, kind: int) -> float:
        """Return the total duration of samples of one kind, in hours."""
        return sum(int((s.trial == kind).sum()) for s in self.stretches) / self.rate_hz / 3600


def material_of(dataset: Dataset, gestures: GestureSet, subjects: Collection[str]) -> Material:
    """Read the streams of ``subjects``, and their recordings that lie in no stream.

    ``gestures`` define what is energetic. Recordings of free choice or of other labels, excluded ones and those that
    were not stopped in time are marked `LEFT_OUT`, as their content is unknown.
    """
    layout = dataset.layout
    people = set(subjects)
    mine = [r for r in dataset.recordings if r.subject in people]
    in_time = {r.id for r in recordings_in_time([r for r in mine if not r.excluded])}
    trials: list[tuple[str, str]] = []
    calm: list[tuple[str, str]] = []
    stretches: list[Stretch] = []

    def register(r: RecordingInfo) -> int:
        gesture = gestures.find(r.gesture)
        if r.id not in in_time or gesture is None or gesture.free_choice:
            return LEFT_OUT
        if gesture.energetic:
            trials.append((r.id, gesture.label))
            return len(trials) - 1
        calm.append((r.id, gesture.label))
        return CALM

    def add(subject: str, segments: list[Segment], rows: list[tuple[int, int, RecordingInfo]], rest: int) -> None:
        guard = layout.samples(GUARD_S)
        kinds = [(first, last, register(r)) for first, last, r in rows]
        calm_index, numbers = len(calm) - sum(k == CALM for _, _, k in kinds), []
        for _, _, k in kinds:
            numbers.append(calm_index if k == CALM else -1)
            calm_index += k == CALM
        for segment in segments:
            trial = np.full(len(segment), rest)
            which = np.full(len(segment), -1)
            spans = [np.searchsorted(segment.row_of, edge, side="left").tolist() for edge in [k[:2] for k in kinds]]
            for (first, last), (_, _, k) in zip(spans, kinds, strict=True):
                if k >= 0 and last > first:
                    around = trial[max(0, first - guard) : last + guard]
                    around[around == BETWEEN] = LEFT_OUT
            for (first, last), (_, _, k), number in zip(spans, kinds, numbers, strict=True):
                trial[first:last], which[first:last] = k, number
            stretches.append(Stretch(subject, network_inputs(segment.data, layout), trial, which))

    sessions = SessionReader(dataset)
    for stream in dataset.streams:
        if stream.subject in people:
            located = [
                (r.stream_row + r.start, r.stream_row + r.stop, r)
                for r in mine
                if r.stream == stream.id and r.stream_row >= 0
            ]
            add(stream.subject, sessions.stream(stream.id), located, BETWEEN)
    for r in mine:
        if r.stream_row < 0 and r.id in in_time:
            add(r.subject, sessions.recording(r), [(0, r.stop - r.start, r)], LEFT_OUT)
    return Material(tuple(stretches), tuple(trials), tuple(calm), layout.rate_hz)


Ints32 = NDArray[np.int32]

_PERCENTILES = (0.5, 1, 2, 4, 7, 10, 15, 20, 30, 40, 50, 65, 80)
"""Percentiles of the trials' highest values to try as thresholds of the first term."""
_MAX_CALM_SHARE = 0.05
"""Largest share of the calm samples at which a first term may be true."""
_SHORTLIST = 60
_FACTORS = (0.85, 1.0, 1.18)
"""Factors on the thresholds over which a rule's recall is averaged, because people differ."""
_MAX_ALARM_FACTOR = 2
"""With the lowest of these factors, a rule may cause this many times the allowed false alarms, and one more."""
_WORTH_PER_SECOND = 0.1
"""Share of the trials that a delay shorter by one second is worth."""


@dataclass(frozen=True, eq=False)
class Heights:
    """Values that terms compare with their thresholds: a row for each sample, a column for each of S candidate terms.

    ``calm`` (n, S): samples without an energetic gesture, in ``chunks`` (n,), each of which counts as one false alarm
    at most. ``rough`` (m, S): samples of the ``trials`` (m,), ``delays`` (m,) samples after the trial's beginning. Both
    are sorted, by chunk and by trial. ``least`` (S,): lowest threshold allowed for a first term; calm samples below all
    of them are dropped. ``apart`` (S, S): whether two candidates may be combined in a rule.
    """

    calm: Ints32
    chunks: Ints
    rough: Ints32
    trials: Ints
    delays: Ints
    least: Ints
    apart: NDArray[np.bool_]

    @classmethod
    def of(
        cls, calm: Ints32, chunks: Ints, rough: Ints32, trials: Ints, delays: Ints, apart: NDArray[np.bool_]
    ) -> Heights:
        """Set ``least``, and drop the calm samples at which no rule can fire."""
        least = np.ones(rough.shape[1], dtype=np.int64)
        if len(calm):
            rank = min(len(calm) - 1, int(len(calm) * (1.0 - _MAX_CALM_SHARE)))
            for column in range(len(least)):
                least[column] = max(1, np.partition(calm[:, column], rank)[rank] + 1)
        if len(trials):
            least = np.maximum(least, _highest(rough, trials)[0].min(axis=0))
        loud = (calm >= least).any(axis=1)
        return cls(calm[loud], chunks[loud], rough, trials, delays, least, apart)

    def without(self, rule: FoundRule) -> Heights:
        """Return a copy without the chunks and trials in which a rule fires already."""
        calm = ~np.isin(self.chunks, self.chunks[rule.holds(self.calm)])
        rough = ~np.isin(self.trials, self.trials[rule.holds(self.rough)])
        left = self.rough[rough], self.trials[rough], self.delays[rough]
        return Heights(self.calm[calm], self.chunks[calm], *left, self.least, self.apart)


@dataclass(frozen=True)
class FoundRule:
    """A rule of one or two ``terms`` (column, threshold), with its results on the samples it was chosen on.

    ``hits``: trials detected; ``near``: their mean number with thresholds a little higher and lower; ``alarms``: chunks
    with a false alarm; ``delay``: median in samples.
    """

    terms: tuple[tuple[int, int], ...]
    hits: int = 0
    near: float = 0.0
    alarms: int = 0
    delay: float = 0.0

    def holds(self, heights: Ints32) -> NDArray[np.bool_]:
        """Return whether the rule is true at each row of ``heights``, (n,)."""
        every: NDArray[np.bool_] = np.ones(len(heights), dtype=np.bool_)
        for column, threshold in self.terms:
            every &= heights[:, column] >= threshold
        return every

    def times(self, factor: float) -> FoundRule:
        """Return the rule with its thresholds multiplied by ``factor``, without results."""
        return FoundRule(tuple((column, max(1, round(factor * threshold))) for column, threshold in self.terms))

    def alarms_in(self, heights: Heights) -> int:
        """Return the number of chunks in which the rule causes a false alarm."""
        return len(np.unique(heights.chunks[self.holds(heights.calm)]))


def best_rule(heights: Heights, alarms: int, rate_hz: float) -> FoundRule | None:
    """Return the rule that detects the most trials, and soonest; None if there is no such rule.

    False alarms are allowed in ``alarms`` chunks. A threshold is the geometric mean of the lowest one within that limit
    and the highest one that loses no trials.
    """
    n_trials = len(np.unique(heights.trials))
    if n_trials == 0:
        return None
    tops, _ = _highest(heights.rough, heights.trials)
    candidates: list[tuple[int, int, int, int]] = []
    for first in range(heights.rough.shape[1]):
        for threshold in np.unique(np.percentile(tops[:, first], _PERCENTILES).astype(np.int64)):
            if threshold < heights.least[first]:
                continue
            calm_rows = heights.calm[:, first] >= threshold
            needed = _needed(heights.calm[calm_rows], heights.chunks[calm_rows], alarms)
            trial_rows = heights.rough[:, first] >= threshold
            reached, _ = _highest(heights.rough[trial_rows], heights.trials[trial_rows])
            hits = (reached >= needed).sum(axis=0)
            candidates += [(int(hits[s]), first, int(threshold), int(s)) for s in np.flatnonzero(heights.apart[first])]
    candidates.sort(key=lambda r: -r[0])
    best: tuple[float, FoundRule] | None = None
    pairs: set[tuple[int, int]] = set()
    for _, first, threshold, second in candidates:
        if (first, second) in pairs:
            continue
        pairs.add((first, second))
        if len(pairs) > _SHORTLIST:
            break
        rule = _settle(heights, first, threshold, second, alarms)
        if rule is not None:
            worth = rule.near / n_trials - _WORTH_PER_SECOND * rule.delay / rate_hz
            if best is None or worth > best[0]:
                best = worth, rule
    return best[1] if best else None


def _settle(heights: Heights, first: int, threshold: int, second: int, alarms: int) -> FoundRule | None:
    """Move each threshold in turn to the geometric mean of its range; None if the rule is not acceptable."""
    terms = {first: threshold, second: 1} if first != second else {first: threshold}
    for column in (second, first, second):
        calm, rough = (
            np.logical_and.reduce([h[:, c] >= t for c, t in terms.items() if c != column] or [np.ones(len(h), bool)])
            for h in (heights.calm, heights.rough)
        )
        needed = int(_needed(heights.calm[calm][:, [column]], heights.chunks[calm], alarms)[0])
        if column == first:
            needed = max(needed, int(heights.least[first]))
        reached, _ = _highest(heights.rough[rough][:, [column]], heights.trials[rough])
        passing = reached[reached >= needed]
        if not len(passing):
            return None
        middle = round((needed * float(np.percentile(passing, 1))) ** 0.5)
        terms[column] = max(needed, min(int(passing.min()), middle))
    rule = FoundRule(tuple(terms.items()))
    detected = rule.holds(heights.rough)
    trials, at = np.unique(heights.trials[detected], return_index=True)
    most_alarms = rule.times(_FACTORS[0]).alarms_in(heights)
    if not len(trials) or most_alarms > _MAX_ALARM_FACTOR * alarms + 1:
        return None
    near = [len(np.unique(heights.trials[rule.times(f).holds(heights.rough)])) for f in _FACTORS]
    delay = float(np.median(heights.delays[detected][at]))
    return FoundRule(rule.terms, len(trials), float(np.mean(near)), rule.alarms_in(heights), delay)


def _highest(heights: Ints32, groups: Ints) -> tuple[Ints32, Ints]:
    """Return the highest value in each column of each group of consecutive rows."""
    if not len(groups):
        return heights[:0], groups[:0]
    starts = np.flatnonzero(np.append(True, np.diff(groups) != 0))
    return np.maximum.reduceat(heights, starts, axis=0), groups[starts]


def _needed(calm: Ints32, chunks: Ints, alarms: int) -> Ints:
    """Return the lowest threshold of each column that at most ``alarms`` chunks reach; at least 1."""
    tops, _ = _highest(calm, chunks)
    if len(tops) <= alarms:
        return np.ones(calm.shape[1], dtype=np.int64)
    rank = len(tops) - 1 - alarms
    highest = np.partition(tops, rank, axis=0)[rank]
    return np.array([max(1, int(one) + 1) for one in highest], dtype=np.int64)
