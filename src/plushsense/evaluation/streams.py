"""The continuous benchmark: whole streams of people left out, systems tuned on others, everything pooled.

What fits is handed in: a picklable callable that gives a fold its networks and its gate, so that this room needs no
PyTorch. A finished fold is kept in the journal as counts, some kilobytes; streams and traces are not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import FoldProgress
from plushsense.evaluation.heard import Heard, StreamScore, hear, quick
from plushsense.evaluation.systems import (
    ANYWHERE,
    SMOOTHINGS,
    SYSTEMS,
    TARGETS,
    WINDOWS,
    Point,
    System,
    balanced,
    cheapest,
    fewest,
    gated,
    searched,
    total,
)
from plushsense.evaluation.truth import people_with_streams
from plushsense.live.decide import DecideSpec, argmax_spec
from plushsense.models.bundle import Bundle
from plushsense.models.gate import GatePlan
from plushsense.runs.journal import Journal, Result, job_id
from plushsense.runs.pool import Job, Report, run_jobs
from plushsense.scoring.events import LATE_S, Costs
from plushsense.scoring.splits import make_folds, parse_split

# Part of every job's id: raise it when the meaning of a stored fold changes.
_VERSION = 2
SMOOTHING_S = 0.3


@dataclass(frozen=True)
class PeopleFold:
    """Who trains, who tunes (and stops the training, where anybody does), who is scored."""

    name: str
    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True)
class Fitted:
    """What was made of a fold's training people: ``networks`` by name (`WINDOWS`, `ANYWHERE`) and a gate.

    A gate of None was not asked for: the systems that have one are left out.
    """

    networks: Mapping[str, Bundle]
    gate: GatePlan | None = None
    said: Mapping[str, Any] = field(default_factory=dict)


class FitStreams(Protocol):
    """Fits networks and gate to ``train``; ``validation`` may stop the training. Picklable, the same for the same
    input; ``test`` is for it to leave alone."""

    def __call__(
        self, dataset: Dataset, fold: PeopleFold, progress: Callable[[int, int, dict[str, Any]], None], /
    ) -> Fitted:
        """``progress`` is called with (epoch, epochs at most, the epoch's row)."""
        ...


def people_folds(dataset: Dataset, split: str, seed: int = 0) -> list[PeopleFold]:
    """The folds of a split by person, the same people as `evaluate` has them.

    Raises:
        ConfigError: for a split that does not keep people apart.
        BadInput: where there are too few people, or nobody has a stream.
    """
    asked = parse_split(split)
    if not asked.apart:
        raise ConfigError(
            f"Split '{split}' does not keep people apart, and a stream is one person's: accepted are by-subject:5 and "
            "leave-one-subject-out."
        )
    people = np.array(dataset.subjects, dtype=np.str_)
    with_streams = set(people_with_streams(dataset))
    if not with_streams:
        raise BadInput(
            f"Data set '{dataset.head.name}' has no stream in which a recording is located: there is nothing to replay."
        )
    folds = []
    for fold in make_folds(asked, people, np.zeros(len(people), dtype=np.int64), seed):
        train, validation, test = (tuple(people[i].tolist()) for i in (fold.train, fold.validation, fold.test))
        if not with_streams & set(test):
            continue
        if not with_streams & set(validation):
            raise BadInput(
                f"In {fold.name} nobody of those who tune ({', '.join(validation)}) has a stream: use another --seed, "
                "or fewer folds."
            )
        folds.append(PeopleFold(fold.name, train, validation, test))
    return folds


@dataclass(frozen=True)
class Settings:
    """What is asked of each fold."""

    systems: tuple[str, ...]
    targets: tuple[float, ...] = TARGETS
    late_s: float = LATE_S
    weights: Costs = field(default_factory=Costs)

    def key(self, gestures: GestureSet) -> dict[str, Any]:
        """What a stored fold depends on, the settings that are tried among it."""
        grids = {}
        for name in self.systems:
            system = SYSTEMS[name]
            tried_first = [str(spec) for spec in system.grid(gestures)]
            grids[name] = [system.network, system.rounds, system.gate_to, tried_first]
        return {"systems": grids, "targets": self.targets, "late_s": self.late_s, "weights": vars(self.weights)}


def crossvalidated_streams(
    dataset: Dataset,
    split: str,
    fit: FitStreams,
    *,
    settings: Settings | None = None,
    journal: Journal | None = None,
    key: Mapping[str, Any] | None = None,
    workers: int = 1,
    seed: int = 0,
    progress: Callable[[FoldProgress], None] | None = None,
) -> list[dict[str, Any]]:
    """Fit, tune and score once a fold; what `plushsense.evaluation.stream_scores.summary` makes figures of.

    Args:
        split: "by-subject:5", "leave-one-subject-out".
        journal: where finished folds are kept, and looked for first.
        key: with a journal, everything that ``fit`` depends on. Data, folds and settings go into a job's id by
            themselves.
        workers: folds at a time, each in a process of its own.

    Raises:
        ConfigError, BadInput: for a split that cannot be made; PlushSenseError: what ``fit`` raises.
    """
    if journal is not None and key is None:
        raise ConfigError(
            "A journal needs a key that says what was fitted: give crossvalidated_streams(..., key={...})."
        )
    settings = settings or Settings(tuple(SYSTEMS))
    folds = people_folds(dataset, split, seed)
    base = {
        "streams": _VERSION,
        "key": dict(key or {}),
        "data": dataset.hash,
        "gestures": dataset.gestures.to_dict(),
        "asked": settings.key(dataset.gestures),
    }
    jobs = [Job(job_id({**base, "fold": vars(fold)}), fold) for fold in folds]
    done = resumed = 0

    def tell(job: Job, epoch: int, epochs: int) -> None:
        if progress is not None:
            progress(FoldProgress(done, len(folds), job.task.name, epoch, epochs, resumed))

    def finished(job: Job, _: Result, again: bool) -> None:
        nonlocal done, resumed
        done, resumed = done + 1, resumed + again
        tell(job, 0, 0)

    results = run_jobs(
        jobs,
        _FoldWork(fit, settings),
        shared=dataset,
        workers=workers,
        journal=journal,
        on_done=finished,
        on_report=lambda job, message: tell(job, *message),
    )
    return [dict(results[job.id]) for job in jobs]


@dataclass(frozen=True)
class _FoldWork:
    """One fold as a job."""

    fit: FitStreams
    settings: Settings

    def __call__(self, shared: Any, task: PeopleFold, report: Report, /) -> Result:
        began = time.perf_counter()

        def progress(epoch: int, epochs: int, row: dict[str, Any]) -> None:
            report((epoch, epochs))

        fitted = self.fit(shared, task, progress)
        fitted_s = time.perf_counter() - began
        table = scored_fold(shared, task, fitted, self.settings)
        seconds = {"fit": round(fitted_s, 1), "score": round(time.perf_counter() - began - fitted_s, 1)}
        return {**table, "fitted": dict(fitted.said), "seconds": seconds}


def scored_fold(dataset: Dataset, fold: PeopleFold, fitted: Fitted, settings: Settings) -> dict[str, Any]:
    """Tune every system on a fold's validation people and score it on those left out: counts, ready for JSON."""
    found: dict[str, Any] = {}
    for network in (WINDOWS, ANYWHERE):
        if network not in fitted.networks:
            continue
        names = [n for n in settings.systems if SYSTEMS[n].network == network]
        names = [n for n in names if fitted.gate is not None or SYSTEMS[n].gate_to is None]
        if not names:
            continue
        tuning = hear(dataset, fitted.networks[network], fold.validation)
        testing = hear(dataset, fitted.networks[network], fold.test)
        searches: dict[str, list[Point]] = {}
        for name in names:
            system = SYSTEMS[name]
            base = system.gate_to or name
            if base not in searches:
                searches[base] = searched(tuning, SYSTEMS[base], settings.late_s)
            points = searches[base]
            if system.gate_to is not None:
                points = gated(tuning, points, fitted.gate or GatePlan(), settings.late_s)
            found[name] = _scored(system, points, tuning, testing, settings)
    people = {"train": list(fold.train), "validation": list(fold.validation), "test": list(fold.test)}
    return {"name": fold.name, **people, "systems": {n: found[n] for n in settings.systems if n in found}}


def _scored(
    system: System, points: Sequence[Point], tuning: Sequence[Heard], testing: Sequence[Heard], settings: Settings
) -> dict[str, Any]:
    """One system of one fold, with the settings that were tried on those who tune."""
    late_s = settings.late_s
    by_person: dict[str, list[Heard]] = {}
    for h in testing:
        by_person.setdefault(h.truth.subject, []).append(h)

    def outcome(spec: DecideSpec) -> dict[str, Any]:
        return {person: total(heard, spec, settings.weights, late_s).kept() for person, heard in by_person.items()}

    curve: list[dict[str, Any]] = []
    of_spec: dict[int, dict[str, Any]] = {}
    for target in settings.targets:
        point = fewest(points, target)
        if id(point) not in of_spec:
            of_spec[id(point)] = _curve_counts(by_person, point.spec, settings)
        curve.append({"target": target, "tuned": _told(point), "people": of_spec[id(point)]})
    chosen = {"balanced": balanced(points), "cheapest": cheapest(tuning, points, settings.weights, late_s)}
    table: dict[str, Any] = {
        "tried": len(points),
        "reach": max(p.recall for p in points),
        "curve": curve,
        **{how: {"tuned": _told(point), "people": outcome(point.spec)} for how, point in chosen.items()},
    }
    if not system.rounds:
        # As it is without any threshold; smoothed as a bundle is by default.
        smoothing_s = SMOOTHING_S if any(p.spec.smoothing_s in SMOOTHINGS for p in points) else 0.0
        table["plain"] = {"tuned": None, "people": outcome(argmax_spec(smoothing_s))}
    for h in (*tuning, *testing):
        h.listener.forget()
    return table


def _curve_counts(by_person: Mapping[str, Sequence[Heard]], spec: DecideSpec, settings: Settings) -> dict[str, Any]:
    """Of each person hits, truths, insertions and hours of one setting."""
    found = {}
    for person, heard in by_person.items():
        n = quick(heard, spec, settings.late_s)
        found[person] = [n.hits, n.truths, n.insertions, n.hours]
    return found


def _told(point: Point) -> dict[str, Any]:
    """A chosen setting, and what it gave on those who tuned; the gate stands in ``fitted``."""
    spec = {k: v for k, v in vars(point.spec).items() if k not in ("gate", "health", "fitted")}
    return {"spec": spec, "recall": point.recall, "false_events_per_hour": point.false_per_hour, "f1": point.f1}


def scored_people(
    dataset: Dataset, model: Bundle, subjects: Sequence[str], spec: DecideSpec, settings: Settings | None = None
) -> dict[str, StreamScore]:
    """One model under one setting, person by person: nothing is tuned here."""
    settings = settings or Settings(())
    found: dict[str, StreamScore] = {}
    for person in subjects:
        heard = hear(dataset, model, [person])
        if heard:
            found[person] = total(heard, spec, settings.weights, settings.late_s)
    return found
