"""How much a personal touch helps people whom a network never met: some of their recordings adapt it, the rest test it.

Every way to choose the adapting recordings that is tried is a *choice*; a person's figures are means over the choices.
A recording is read as the class of the highest mean probability over its windows. All recordings of a person are
usually of one session: what is gained until another day is not shown by these figures.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.evaluation.crossval import context_of
from plushsense.scoring import metrics
from plushsense.scoring.splits import purge
from plushsense.windows.cut import WindowSet

Index = NDArray[np.int64]
Reader = Callable[[WindowSet], NDArray[np.floating[Any]]]  # windows → probabilities (N, K)

_SCORES = ("accuracy", "macro_f1")


@dataclass(frozen=True)
class Touched:
    """What came of adapting: a reader by engine; ``accepted`` false: they read as before."""

    readers: Mapping[str, Reader]
    accepted: bool


@dataclass(frozen=True)
class Stranger:
    """A person with a network that was not trained on them: ``readers`` by engine ("float" first), ``adapt`` is given
    the windows of the recordings that adapt it."""

    subject: str
    readers: Mapping[str, Reader]
    adapt: Callable[[WindowSet], Touched]


def evaluate_adapting(
    windows: WindowSet,
    strangers: Iterable[Stranger],
    times: Mapping[str, int],
    *,
    use: int = 2,
    random: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Before and after, person by person.

    Args:
        windows: of everybody.
        strangers: the people, each with their network.
        times: when each recording was made, by its id: recordings of a gesture are numbered in this order.
        use: recordings of each gesture that adapt. The choices are all sets of so many numbers, the same for all
            gestures (10 of 5 recordings); the first is the first recordings of each gesture.
        random: so many choices more, drawn for each gesture on its own.
        progress: told each person who is done.

    Returns:
        ``context``, ``use``, ``random``, ``choices`` in all, ``refused`` (share of the choices in which the bundle
        stayed as it was); ``engines``: of each ``accuracy`` and ``macro_f1`` with ``before``, ``after`` and ``gain``
        (mean, sd, ci95 over people), ``first`` (the same gain when the first recordings adapt), ``right`` (recordings
        right, after less before: ``mean``, ``worst_mean`` of a person, ``worst`` of a choice, ``worse_people``: less by
        more than one on average, ``worse_choices``: share of choices) and ``people``, a row each; ``agreement``, the
        share of the test windows on which the engines say the same, before and after (None with one engine).

    Raises:
        BadInput: when nobody has more recordings of a gesture than adapt.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    same: list[tuple[float, float]] = []
    refused: list[bool] = []
    for stranger in strangers:
        mine = windows.take(np.flatnonzero(windows.subject == stranger.subject))
        tried: dict[str, list[_Change]] = {name: [] for name in stranger.readers}
        for chosen in _choices(mine, times, use, random, seed):
            own, test = _parts(mine, chosen)
            if not len(own) or not len(test):
                continue
            touched = stranger.adapt(own)
            refused.append(not touched.accepted)
            before = {name: reader(test) for name, reader in stranger.readers.items()}
            after = {name: reader(test) for name, reader in touched.readers.items()} if touched.accepted else before
            for name in stranger.readers:
                tried[name].append(_Change.of(test, before[name], after[name]))
            if len(before) > 1:
                same.append((_agreement(list(before.values())), _agreement(list(after.values()))))
        for name, changes in tried.items():
            if changes:
                rows.setdefault(name, []).append(_row(stranger.subject, changes))
        if progress is not None:
            progress(stranger.subject)
    if not rows:
        raise BadInput(f"Nobody has more than {use} recordings of a gesture: none is left to test on with --use {use}.")
    return {
        "context": context_of(windows),
        "use": use,
        "random": random,
        "choices": len(refused),
        "refused": float(np.mean(refused)),
        "engines": {name: _summed(people) for name, people in rows.items()},
        "agreement": {when: float(np.mean([each[i] for each in same])) for i, when in enumerate(("before", "after"))}
        if same
        else None,
    }


@dataclass(frozen=True)
class _Change:
    """One choice: recordings tested, how many were right, and both scores; before and after."""

    recordings: int
    right: tuple[int, int]
    accuracy: tuple[float, float]
    macro_f1: tuple[float, float]

    @classmethod
    def of(cls, test: WindowSet, *probabilities: NDArray[np.floating[Any]]) -> _Change:
        ids, first = np.unique(test.recording, return_index=True)
        truth = test.y[first]
        counts = [
            metrics.confusion(truth, metrics.vote(each, test.recording)[1], len(test.labels)) for each in probabilities
        ]
        before, after = counts
        return cls(
            len(ids),
            (int(np.trace(before)), int(np.trace(after))),
            (metrics.accuracy(before), metrics.accuracy(after)),
            (metrics.macro_f1(before), metrics.macro_f1(after)),
        )


def _choices(windows: WindowSet, times: Mapping[str, int], use: int, random: int, seed: int) -> Iterator[set[int]]:
    """The recordings that adapt, as numbers of ``windows.recording``."""
    by_class = []
    for k in np.unique(windows.y):
        mine = sorted(
            {int(r) for r in windows.recording[windows.y == k]},
            key=lambda r: (times.get(windows.recording_ids[r], 0), windows.recording_ids[r]),
        )
        by_class.append(mine)
    for numbers in itertools.combinations(range(max(map(len, by_class), default=0)), use):
        yield {mine[n] for mine in by_class for n in numbers if n < len(mine)}
    draw = np.random.default_rng(seed)
    for _ in range(random):
        yield {int(r) for mine in by_class for r in draw.permutation(mine)[:use]}


def _parts(windows: WindowSet, chosen: set[int]) -> tuple[WindowSet, WindowSet]:
    """The windows that adapt and those that test. None that adapts touches a tested recording in the stream."""
    adapts = np.isin(windows.recording, sorted(chosen))
    test = windows.take(np.flatnonzero(~adapts))
    keep = purge(windows.stream, windows.window_rows, test.stream, test.recording_rows)
    return windows.take(np.flatnonzero(adapts & keep)), test


def _agreement(probabilities: list[NDArray[np.floating[Any]]]) -> float:
    one, other = (each.argmax(axis=1) for each in probabilities[:2])
    return float((one == other).mean())


def _row(subject: str, changes: list[_Change]) -> dict[str, Any]:
    difference = [c.right[1] - c.right[0] for c in changes]
    row: dict[str, Any] = {
        "subject": subject,
        "choices": len(changes),
        "recordings": float(np.mean([c.recordings for c in changes])),
        "right_change": float(np.mean(difference)),
        "right_change_worst": min(difference),
        "choices_worse": sum(d < -1 for d in difference),
    }
    for score in _SCORES:
        pairs = np.array([getattr(c, score) for c in changes])
        row |= {f"{score}_before": float(pairs[:, 0].mean()), f"{score}_after": float(pairs[:, 1].mean())}
        row[f"{score}_first"] = float(pairs[0, 1] - pairs[0, 0])
    return row


def _summed(people: list[dict[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for score in _SCORES:
        before, after, first = (
            np.array([row[f"{score}_{when}"] for row in people]) for when in ("before", "after", "first")
        )
        out[score] = {
            "before": metrics.summary(before),
            "after": metrics.summary(after),
            "gain": metrics.summary(after - before),
            "first": metrics.summary(first),
        }
    changes = [row["right_change"] for row in people]
    out["right"] = {
        "mean": float(np.mean(changes)),
        "worst_mean": min(changes),
        "worst": min(row["right_change_worst"] for row in people),
        "worse_people": sum(change < -1 for change in changes),
        "worse_choices": sum(row["choices_worse"] for row in people) / sum(row["choices"] for row in people),
    }
    return out | {"people": people}
