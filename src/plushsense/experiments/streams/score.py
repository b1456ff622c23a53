"""The continuous benchmark: tune systems on some people, score them on whole streams of others, and pool the counts.

The function that fits the networks and the gate of a fold is a picklable argument, so that this module does not need
PyTorch. The journal stores a finished fold as counts (some kilobytes), without streams and traces.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.replay import (
    StreamScore,
    StreamTrace,
    count_events,
    people_with_streams,
    read_streams,
)
from plushsense.experiments.streams.systems import (
    ANYWHERE,
    REFERENCE,
    SMOOTHINGS,
    SYSTEMS,
    TARGETS,
    WINDOWS,
    System,
    TunedPoint,
    balanced,
    cheapest,
    fewest,
    gated,
    prompt,
    quiet,
    searched,
    total,
)
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import JobsSpec, Report
from plushsense.jobs.study import Progress, StudyPart, run_study
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec, argmax_spec
from plushsense.runtime.gate import GateSettings
from plushsense.scoring.events import LATE_S, ErrorCosts, at_recall
from plushsense.scoring.metrics import BOOTSTRAP_SEED, summary
from plushsense.scoring.splits import make_folds, parse_split
from plushsense.training.spec import EpochProgress, EpochRow

# Part of every job's id: increase it when the meaning of a stored fold changes.
_VERSION = 5
SMOOTHING_S = 0.3
CHOICES = ("balanced", "prompt", "quiet", "cheapest")


@dataclass(frozen=True)
class PeopleFold:
    """The people of a fold: ``train`` for training, ``validation`` for tuning and early stopping, ``test`` to score."""

    name: str
    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True)
class Fitted:
    """Models fitted to a fold's training people: ``networks`` by name (`WINDOWS`, `ANYWHERE`) and a gate.

    Systems that need a gate are left out if ``gate`` is None. ``report`` describes the fit in plain values.
    """

    networks: Mapping[str, Bundle]
    gate: GateSettings | None = None
    report: Mapping[str, Any] = field(default_factory=dict)


FitStreams = Callable[[Dataset, PeopleFold, EpochProgress], Fitted]
"""A function that fits networks and gate to the training people of a fold; the validation people may stop it early.

It must be picklable and deterministic, must not use the test people, and calls its last argument with (epoch, maximum
of epochs, the epoch's row).
"""


def people_folds(dataset: Dataset, split: str, seed: int = 0) -> list[PeopleFold]:
    """Return the folds of a split by person, with the people as in `evaluate`; folds without test streams are omitted.

    Raises:
        ConfigError: for a split that does not keep people apart.
        BadInput: where there are too few people, or nobody has a stream.
    """
    asked = parse_split(split)
    if not asked.separates_people:
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
                f"In {fold.name} none of the people to tune on ({', '.join(validation)}) has a stream: use another "
                "--seed, or fewer folds."
            )
        folds.append(PeopleFold(fold.name, train, validation, test))
    return folds


@dataclass(frozen=True)
class Settings:
    """Settings of every fold."""

    systems: tuple[str, ...]
    targets: tuple[float, ...] = TARGETS
    late_s: float = LATE_S
    weights: ErrorCosts = field(default_factory=ErrorCosts)

    def key(self, gestures: GestureSet) -> dict[str, object]:
        """Return the values that a stored fold depends on, including the settings that are tried."""
        grids = {}
        for name in self.systems:
            system = SYSTEMS[name]
            tried_first = [asdict(spec) for spec in system.grid(gestures)]
            grids[name] = [system.network, system.rounds, system.gate_to, tried_first]
        return {"systems": grids, "targets": self.targets, "late_s": self.late_s, "weights": vars(self.weights)}


def crossvalidated_streams(
    dataset: Dataset,
    split: str,
    fit: FitStreams,
    *,
    settings: Settings | None = None,
    spec: JobsSpec | None = None,
    key: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Result]:
    """Fit, tune and score each fold; return the counts of each, from which `summed` makes the scores.

    Args:
        split: "by-subject:5", "leave-one-subject-out".
        key: everything that ``fit`` depends on besides data, folds and settings.

    Raises:
        ConfigError, BadInput: for a split that cannot be made; PlushSenseError: what ``fit`` raises.
    """
    settings = settings or Settings(tuple(SYSTEMS))
    return run_study(
        [StudyPart(fold.name, {"fold": vars(fold)}, fold) for fold in people_folds(dataset, split, seed)],
        _FoldWork(fit, settings),
        lambda study: study.results,
        key={
            "streams": _VERSION,
            "key": dict(key or {}),
            "data": dataset.hash,
            "gestures": dataset.gestures.to_dict(),
            "asked": settings.key(dataset.gestures),
        },
        shared=dataset,
        spec=spec,
        progress=progress,
    )


@dataclass(frozen=True)
class _FoldWork:
    """The work of one job: fit, tune and score one fold."""

    fit: FitStreams
    settings: Settings

    def __call__(self, shared: Any, task: PeopleFold, report: Report, /) -> Result:
        began = time.perf_counter()

        def progress(epoch: int, epochs: int, row: EpochRow) -> None:
            report((epoch, epochs))

        fitted = self.fit(shared, task, progress)
        fitted_s = time.perf_counter() - began
        table = _scored_fold(shared, task, fitted, self.settings)
        seconds = {"fit": round(fitted_s, 1), "score": round(time.perf_counter() - began - fitted_s, 1)}
        return {**table, "fitted": dict(fitted.report), "seconds": seconds}


def _scored_fold(dataset: Dataset, fold: PeopleFold, fitted: Fitted, settings: Settings) -> dict[str, Any]:
    """Tune every system on a fold's validation people and score it on the test people; return counts for JSON."""
    systems: dict[str, Any] = {}
    for network in (WINDOWS, ANYWHERE):
        if network not in fitted.networks:
            continue
        names = [n for n in settings.systems if SYSTEMS[n].network == network]
        names = [n for n in names if fitted.gate is not None or SYSTEMS[n].gate_to is None]
        if not names:
            continue
        tuning = read_streams(dataset, fitted.networks[network], fold.validation)
        testing = read_streams(dataset, fitted.networks[network], fold.test)
        searches: dict[str, list[TunedPoint]] = {}
        for name in names:
            system = SYSTEMS[name]
            base = system.gate_to or name
            if base not in searches:
                searches[base] = searched(tuning, SYSTEMS[base], settings.late_s)
            points = searches[base]
            if system.gate_to is not None:
                points = gated(tuning, points, fitted.gate or GateSettings(), settings.late_s)
            systems[name] = _scored(system, points, tuning, testing, settings)
    people = {"train": list(fold.train), "validation": list(fold.validation), "test": list(fold.test)}
    return {"name": fold.name, **people, "systems": {n: systems[n] for n in settings.systems if n in systems}}


def _scored(
    system: System,
    points: Sequence[TunedPoint],
    tuning: Sequence[StreamTrace],
    testing: Sequence[StreamTrace],
    settings: Settings,
) -> dict[str, Any]:
    """Return the counts of one system in one fold; ``points`` are the settings tried on the tuning people."""
    late_s = settings.late_s
    by_person: dict[str, list[StreamTrace]] = {}
    for h in testing:
        by_person.setdefault(h.truth.subject, []).append(h)

    def outcome(spec: DecideSpec) -> Mapping[str, Mapping[str, Any]]:
        return {who: total(mine, spec, settings.weights, late_s).to_journal() for who, mine in by_person.items()}

    curve: list[dict[str, Any]] = []
    of_spec: dict[int, dict[str, Any]] = {}
    for target in settings.targets:
        point = fewest(points, target)
        if id(point) not in of_spec:
            of_spec[id(point)] = {
                person: [n.hits, n.truths, n.insertions, n.hours]
                for person, streams in by_person.items()
                for n in [count_events(streams, point.spec, late_s)]
            }
        curve.append({"target": target, "tuned": _tuned_setting(point), "people": of_spec[id(point)]})
    chosen = {
        "balanced": balanced(points),
        "prompt": prompt(points),
        "quiet": quiet(points),
        "cheapest": cheapest(tuning, points, settings.weights, late_s),
    }
    table: dict[str, Any] = {
        "tried": len(points),
        "reach": max(p.recall for p in points),
        "curve": curve,
        **{how: {"tuned": _tuned_setting(point), "people": outcome(point.spec)} for how, point in chosen.items()},
    }
    if not system.rounds:
        # The system without a threshold, with the default smoothing of a bundle.
        smoothing_s = SMOOTHING_S if any(p.spec.smoothing_s in SMOOTHINGS for p in points) else 0.0
        table["plain"] = {"tuned": None, "people": outcome(argmax_spec(smoothing_s))}
    for h in (*tuning, *testing):
        h.replayer.clear_cache()
    return table


def _tuned_setting(point: TunedPoint) -> dict[str, Any]:
    """Return a chosen setting, without its gate, and its scores on the tuning people."""
    spec = {k: v for k, v in vars(point.spec).items() if k not in ("gate", "health", "fitted")}
    return {"spec": spec, "recall": point.recall, "false_events_per_hour": point.false_per_hour, "f1": point.f1}


HITS, TRUTHS, FALSE, HOURS = range(4)
RECALLS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9)
_RESAMPLES = 500
LATENCY_SHARES = tuple(n / 20 for n in range(21))

Folds = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class SystemScores:
    """The scores of the systems of the benchmark over all test people, as plain values.

    Each of ``systems`` has a ``curve`` (for each target, recall and false events per hour over all test people) and the
    figures of the settings ``balanced`` (highest F1 on the tuning people), ``prompt`` (shortest median latency, at
    nearly the highest F1), ``quiet`` (highest F1 with at most 60 false events per hour), ``cheapest`` (lowest cost) and
    perhaps ``plain`` (no threshold). ``at_recall`` has the false events per hour of all systems at equal recall, and
    their ratio to the reference with a 95 % bootstrap interval over people.
    """

    systems: Mapping[str, Mapping[str, Any]]
    reference: str | None
    at_recall: Sequence[Mapping[str, Any]]
    folds: Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class BenchmarkResult(SystemScores):
    """The result of `stream_benchmark`: the scores of the systems, and what they were made of.

    ``labelled`` tells whether every sample of the streams has a label; ``networks`` has the title of each network.
    """

    split: str
    dataset: str
    dataset_hash: str
    simulated: bool
    labelled: bool
    note: str
    late_s: float
    labelled_stretches: int
    subjects: Sequence[str]
    code_version: str
    seed: int
    networks: Mapping[str, str]
    anywhere: Mapping[str, Any]
    preset: str
    training: Mapping[str, Any]

    @property
    def title(self) -> str:
        """Data, people and split in one line."""
        people = f"{len(self.subjects)} people left out in turn ({self.split})"
        return f"{self.dataset}, {people}{': SIMULATION' * self.simulated}"


def summed(folds: Folds) -> SystemScores:
    """Sum the counts of all folds."""
    names = [n for n in SYSTEMS if all(n in fold["systems"] for fold in folds)]
    counts = {n: _counts(folds, n) for n in names}
    systems = {}
    for n in names:
        parts: dict[str, Any] = {"title": SYSTEMS[n].title, "curve": _curve(folds, n, counts[n])}
        for how in ("plain", *CHOICES):
            if all(how in fold["systems"][n] for fold in folds):
                parts[how] = _outcome(folds, n, how)
        systems[n] = parts
    described = [
        {k: v for k, v in fold.items() if k != "systems"}
        | {"settings": {n: {how: fold["systems"][n][how]["tuned"] for how in CHOICES} for n in names}}
        for fold in folds
    ]
    if REFERENCE not in names:
        return SystemScores(systems, None, [], described)
    return SystemScores(systems, REFERENCE, _at_recall(counts), described)


def _counts(folds: Folds, name: str) -> NDArray[np.float64]:
    """Return hits, truths, insertions and hours of a system as an array (targets, people, 4)."""
    rows = []
    for fold in folds:
        curve = fold["systems"][name]["curve"]
        rows += [[point["people"][person] for point in curve] for person in sorted(curve[0]["people"])]
    return np.array(rows, dtype=np.float64).transpose(1, 0, 2)


def _points(counts: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return (recall, false events per hour) of each target, pooled over people; ``counts`` as from `_counts`."""
    sums = counts.sum(axis=1)
    return [(float(s[HITS] / max(s[TRUTHS], 1)), float(s[FALSE] / s[HOURS])) for s in sums]


def _curve(folds: Folds, name: str, counts: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Return the points of a system's curve, without targets that were not reached in the tuning of any fold."""
    points = []
    targets = [point["target"] for point in folds[0]["systems"][name]["curve"]]
    reach = max(fold["systems"][name]["reach"] for fold in folds)
    for target, (recall, false) in zip(targets, _points(counts), strict=True):
        if target <= reach:
            points.append({"target": target, "recall": recall, "false_events_per_hour": false})
    return points


def _outcome(folds: Folds, name: str, how: str) -> dict[str, Any]:
    """Return the scores of one choice of settings (``how``) over all people, and for each person."""
    whole, people = StreamScore(), []
    for fold in folds:
        for person, stored in sorted(fold["systems"][name][how]["people"].items()):
            mine = StreamScore.from_journal(stored)
            whole.add(mine)
            figures: dict[str, Any] = mine.to_dict()
            people.append(
                {"subject": person, "fold": fold["name"]}
                | {k: figures[k] for k in ("truths", "events", "recall", "precision", "f1", "false_events_per_hour")}
                | {"latency_s": figures["latency_s"]["median"]}
            )
    latencies = {level: whole.total(level).latencies for level, tallies in whole.levels.items() if tallies}
    return {
        **whole.to_dict(),
        "latency_shares": {
            level: [round(float(q), 3) for q in np.quantile(values, LATENCY_SHARES)] if values else []
            for level, values in latencies.items()
        },
        "f1_people": summary([p["f1"] for p in people if p["f1"] is not None]).to_json(),
        "recall_people": summary([p["recall"] for p in people if p["recall"] is not None]).to_json(),
        "people": sorted(people, key=lambda p: p["subject"]),
    }


def _at_recall(counts: Mapping[str, NDArray[np.float64]]) -> list[dict[str, Any]]:
    """Compare the false events of every system with the reference at equal recall, interpolated on their curves."""
    people = counts[REFERENCE].shape[1]
    drawn = np.random.default_rng(BOOTSTRAP_SEED).integers(0, people, size=(_RESAMPLES, people))
    curves = {name: _points(table) for name, table in counts.items()}
    again = {name: [_points(table[:, draw]) for draw in drawn] for name, table in counts.items()}
    rows = []
    for recall in RECALLS:
        base = at_recall(curves[REFERENCE], recall)
        row: dict[str, Any] = {"recall": recall, "systems": {}}
        for name in counts:
            false = at_recall(curves[name], recall)
            ratio = ci = None
            if false is not None and base:
                ratio = false / base
                ratios = []
                for mine, reference in zip(again[name], again[REFERENCE], strict=True):
                    one, other = at_recall(mine, recall), at_recall(reference, recall)
                    if one is not None and other:
                        ratios.append(one / other)
                # No interval where too few resamples reach the recall.
                if len(ratios) >= 0.9 * _RESAMPLES:
                    ci = [float(q) for q in np.percentile(ratios, [2.5, 97.5])]
            row["systems"][name] = {"false_events_per_hour": false, "ratio": ratio, "ci95": ci}
        rows.append(row)
    return rows


def pooled_scores(scores: Iterable[StreamScore]) -> StreamScore:
    """Return the scores of all people together."""
    whole = StreamScore()
    for one in scores:
        whole.add(one)
    return whole
