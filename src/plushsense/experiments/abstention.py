"""Measure abstention: how well a network's confidence separates its right answers from its wrong ones, on test people.

Each recording contributes one answer, from its last step, because the steps within a recording depend on each other.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, DatasetError, python_warning
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.layouts import Layout
from plushsense.dataset.index import as_dataset, open_dataset
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset
from plushsense.evaluation.crossval import fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.jobs.journal import Job, Report, Result, job_id
from plushsense.jobs.pool import JobCallbacks, JobsSpec, run_jobs
from plushsense.jobs.progress import JobInfo, JobProgress, JobsReporter
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.reports.figures import new_figure, png
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ONE
from plushsense.runtime.fixed import smoothing_weight
from plushsense.scoring.confidence import RelativeMahalanobis, RiskCoverage, auroc, confidences, risk_coverage
from plushsense.scoring.splits import Fold, parse_split
from plushsense.training.spec import TrainSpec
from plushsense.tuning.decisions import (
    COVERAGE,
    KNOWN_SHARE,
    coverage_of,
    known_threshold,
    labelled_steps,
    marked_streams,
    sure_threshold,
)
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import (
    Warn,
    choose_classes,
    network_inputs_of,
    outside_streams,
    windows_for,
)
from plushsense.workflow.reporting import check_folder, journal_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Floats = NDArray[np.float64]


def last_answers(
    bundle: Bundle,
    dataset: Dataset,
    subjects: Iterable[str],
    spec: DecideSpec,
    gestures: GestureSet,
    typical: RelativeMahalanobis,
) -> dict[str, NDArray[Any]]:
    """Return the network's last answer in each of the n recordings of ``gestures`` in the streams of ``subjects``.

    Args:
        typical: fitted to the inputs of the dense layer on training windows.

    Returns:
        ``logits`` (n, K) of the last step; smoothed ``shares`` (n, K), the probabilities of the network's K classes;
        ``score`` (n,), the smoothed known score; ``typical`` (n,), the mean score of the steps in the second half of
        the recording; ``label`` (n,), the true gesture, which need not be one of the network's classes; ``person``
        (n,).
    """
    network, arch = bundle.network(), bundle.arch
    weight = smoothing_weight(spec.smoothing_s, bundle.arch.step * bundle.layout.period_us / 1e6)
    rows: list[tuple[NDArray[Any], NDArray[Any], Any, str, str, float]] = []
    for stream in marked_streams(bundle, dataset, subjects, spec, gestures):
        smoothed = stream.replayer.smoothed(weight)
        for truth in stream.truths:
            if truth.gesture < 0:
                continue
            for part, after in zip(stream.trace.parts, smoothed, strict=True):
                times = stream.trace.step_times_us(part)
                at = int(np.searchsorted(times, truth.stop_us, side="right")) - 1
                if at >= 0 and times[at] > truth.start_us:
                    label = gestures.labels[truth.gesture]
                    first = int(np.searchsorted(times, truth.start_us, side="right"))
                    steps = range((first + at + 1) // 2, at + 1)
                    windows = [part.inputs[s * arch.step : s * arch.step + arch.span].T for s in steps]
                    features = network.features(bundle.scaler.apply(np.stack(windows)))
                    score = float(typical.scores(features).mean())
                    rows.append((part.logits[at], after.shares[at], after.known[at], label, stream.person, score))
    k = len(bundle.gestures)
    return {
        "logits": np.array([r[0] for r in rows], dtype=np.float64).reshape(len(rows), k) / 256,
        "shares": np.array([r[1] for r in rows], dtype=np.int64).reshape(len(rows), k) / ONE,
        "score": np.array([r[2] for r in rows], dtype=np.float64) / 256,
        "label": np.array([r[3] for r in rows], dtype=np.str_),
        "person": np.array([r[4] for r in rows], dtype=np.str_),
        "typical": np.array([r[5] for r in rows], dtype=np.float64),
    }


def fold_answers(
    bundle: Bundle,
    dataset: Dataset,
    training: WindowSet,
    validation: Sequence[str],
    test: Sequence[str],
    *,
    coverage: float,
    known_share: float,
) -> dict[str, Any]:
    """Return the answers of a fold's network on the test people, and the thresholds fitted to the validation people.

    Args:
        training: the windows to which the network was fitted.
    """
    spec = DecideSpec()
    calibration = labelled_steps(bundle, marked_streams(bundle, dataset, validation, spec), spec)
    if not len(calibration.truth):
        empty = {name: np.zeros(0) for name in ("logits", "shares", "score", "label", "person", "typical")}
        return {"people": [], "covered": [], "size": [], "sure": 1.0, "known": None, **empty}
    sure, known = sure_threshold(calibration, coverage), known_threshold(calibration, bundle.gestures, known_share)
    steps = labelled_steps(bundle, marked_streams(bundle, dataset, test, spec), spec)
    people = sorted(set(steps.person.tolist()))
    features = bundle.network().features(bundle.scaler.apply(training.integers))
    typical = RelativeMahalanobis.fit(features, training.y)
    each = [steps.take(steps.person == person) for person in people]
    return {
        "people": people,
        "covered": [coverage_of(mine, sure) for mine in each],
        "size": [float((mine.shares >= sure * ONE).sum(axis=1).mean()) for mine in each],
        "sure": sure,
        "known": known,
        **last_answers(bundle, dataset, test, spec, dataset.gestures, typical),
    }


@dataclass(frozen=True)
class FoldAnswers:
    """Answers of a fold, the labels of its network, and the label left out of its training ("" for none)."""

    fold: str
    withheld: str
    labels: tuple[str, ...]
    result: Mapping[str, Any]

    @property
    def scores(self) -> dict[str, Floats]:
        """Each kind of confidence by name, an array (n,) with one value for each recording."""
        r = self.result
        found = confidences(r["logits"], r["shares"], r["score"], float(r["sure"]))
        return found | {"relative Mahalanobis": np.asarray(r["typical"], dtype=np.float64)}

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (n,) of the recordings of a gesture that the network was trained on."""
        return np.isin(self.result["label"], self.labels)

    @property
    def right(self) -> NDArray[np.bool_]:
        """Mask (n,) of the recordings whose most likely class after smoothing is the true gesture."""
        best = np.array(self.labels, dtype=np.str_)[self.result["shares"].argmax(axis=1)]
        return np.asarray(best == self.result["label"])


@dataclass(frozen=True)
class Abstaining:
    """The result of `abstaining`: ``table`` as ``--json`` prints it, and the ``curves`` of all folds by confidence."""

    table: dict[str, Any]
    curves: dict[str, RiskCoverage]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return self.table


def summarise(folds: Sequence[FoldAnswers], coverage: float, known_share: float) -> Abstaining:
    """Compute risk-coverage curves and scores over all folds, by person, and by withheld gesture."""
    whole = [t for t in folds if not t.withheld and len(t.result["label"])]
    right = np.concatenate([t.right[t.known] for t in whole])
    person = np.concatenate([t.result["person"][t.known] for t in whole])
    pooled = {name: np.concatenate([t.scores[name][t.known] for t in whole]) for name in whole[0].scores}
    curves = {name: risk_coverage(score, right) for name, score in pooled.items()}
    rows = []
    for name, curve in curves.items():
        gains = [risk_coverage(pooled[name][person == who], right[person == who]).gain for who in np.unique(person)]
        rows.append(
            {
                "confidence": name,
                "aurc": curve.area,
                "gain": curve.gain,
                "gain_by_person": _spread(gains),
                "coverage_at_risk_20": curve.coverage_at(0.2),
                "auroc_right": auroc(pooled[name][right], pooled[name][~right]),
            }
        )
    by_person = [share for t in whole for share in t.result["covered"]]
    unknown = [t for t in whole if (~t.known).any()]
    withheld: dict[str, dict[str, Any]] = {}
    for label in dict.fromkeys(t.withheld for t in folds if t.withheld):
        made = [t for t in folds if t.withheld == label and (t.result["label"] == label).any()]
        if made:
            withheld[label] = _against(made, known_share)
    table = {
        "recordings": len(right),
        "people": len(np.unique(person)),
        "accuracy": float(right.mean()),
        "aurc_random": curves["softmax"].random,
        "aurc_oracle": curves["softmax"].oracle,
        "confidences": rows,
        "stated_coverage": {
            "stated": coverage,
            "by_person": _spread(by_person),
            "least": min(by_person),
            "by_fold": [float(np.mean(t.result["covered"])) for t in whole],
            "classes_in_set": float(np.mean([size for t in whole for size in t.result["size"]])),
            "on": "steps in the second half of a recording",
        },
        "free_choice": _against(unknown, known_share) if unknown else None,
        "withheld": withheld,
        "withheld_mean": {
            name: _spread([row["auroc"][name]["mean"] for row in withheld.values()]) for name in curves if withheld
        },
    }
    return Abstaining(table, curves)


def _against(folds: Sequence[FoldAnswers], known_share: float) -> dict[str, Any]:
    """Return the AUROC of known against unknown gestures by confidence, and the shares that the threshold separates."""
    auc: dict[str, list[float]] = {}
    passed, caught, count = [], [], 0
    for t in folds:
        other = np.asarray(t.result["label"] == t.withheld) if t.withheld else ~t.known
        count += int(other.sum())
        for name, score in t.scores.items():
            auc.setdefault(name, []).append(auroc(score[t.known], score[other]))
        if t.result["known"] is not None:
            under = np.asarray(t.result["score"] < t.result["known"])
            passed.append(float((~under[t.known]).mean()))
            caught.append(float(under[other].mean()))
    return {
        "recordings": count,
        "folds": len(folds),
        "auroc": {name: _spread(values) for name, values in auc.items()},
        "known_share_stated": known_share,
        "known_passed": _spread(passed),
        "unknown_caught": _spread(caught),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """Return the mean, the standard deviation and the number of the finite values."""
    real = [v for v in values if np.isfinite(v)]
    return {
        "mean": float(np.mean(real)) if real else None,
        "sd": float(np.std(real, ddof=1)) if len(real) > 1 else None,
        "n": len(real),
    }


# Okabe and Ito's colours with line styles, so that colour-blind readers can distinguish the curves.
_STYLES = (
    ("#0072b2", "-"),
    ("#d55e00", "--"),
    ("#009e73", "-."),
    ("#cc79a7", ":"),
    ("#e69f00", "-"),
    ("#56b4e9", "--"),
    ("#000000", "-."),
    ("#999999", "--"),
    ("#8a8a00", "-."),
)


def curves(measured: Mapping[str, RiskCoverage], *, title: str = "") -> Figure:
    """Draw the risk-coverage curve of each confidence, and those of random and of perfect ranking for comparison."""
    figure = new_figure(6.4, 4.2)
    axes = figure.add_subplot()
    ranked = sorted(measured.items(), key=lambda item: item[1].area)
    first = ranked[0][1]
    axes.axhline(100 * first.random, color="#888888", linewidth=1.0, label=f"chance (area {first.random:.3f})")
    for (name, curve), (colour, style) in zip(ranked, _STYLES, strict=False):
        label = f"{name} ({curve.area:.3f}; {100 * curve.gain:.0f} % of the oracle's gain)"
        axes.plot(100 * curve.coverage, 100 * curve.risk, style, color=colour, linewidth=1.5, label=label)
    right = 1 - first.random
    coverage = np.linspace(0.001, 1, 400)
    axes.plot(
        100 * coverage,
        100 * np.maximum(coverage - right, 0) / coverage,
        color="#888888",
        linewidth=1.0,
        linestyle=(0, (1, 1)),
        label=f"oracle ({first.oracle:.3f})",
    )
    axes.set(xlim=(0, 100), ylim=(0, None), xlabel="Coverage (% of gestures answered, the surest first)")
    axes.set_ylabel("Risk (% of the answers that are wrong)")
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(0, 1.0))
    axes.set_ylim(0, 100 * max(first.random, *(float(c.risk.max()) for c in measured.values())) * 2.0)
    if title:
        axes.set_title(title, fontsize=10, parse_math=False)
    return figure


# Increase it when the meaning of a stored fold changes, also when the default smoothing does.
_VERSION = 4
FIGURE, TABLE = "risk-coverage.png", "abstaining.json"


@dataclass(frozen=True)
class _AnswerWork:
    """The work of one job: train on a fold without a label ("" for none), and return the answers on its test people."""

    dataset: str
    arch: Arch
    spec: TrainSpec
    gestures: GestureSet
    layout: Layout
    coverage: float
    known_share: float

    def __call__(self, shared: WindowSet, task: tuple[Fold, str], report: Report, /) -> Result:
        from plushsense.training.fit import fit

        fold, withheld = task
        dataset = _opened(self.dataset).with_inputs(self.layout).with_gestures(self.gestures)
        gestures = self.gestures.subset([g for g in self.gestures.labels if g != withheld])
        train, validation = (_without(shared.take(at), withheld) for at in (fold.train, fold.validation))
        arch = replace(self.arch, classes=len(gestures))
        fitted = fit(train, validation, arch, self.spec, lambda epoch, epochs, _: report((epoch, epochs)))
        bundle = Bundle(arch, fitted.weights, dataset.layout, fitted.scaler, gestures)
        validation_people, test_people = (
            sorted(set(shared.subject[at].tolist()) - {NOBODY, UNKNOWN_SUBJECT}) for at in (fold.validation, fold.test)
        )
        return fold_answers(
            bundle, dataset, train, validation_people, test_people, coverage=self.coverage, known_share=self.known_share
        )


@lru_cache(maxsize=1)
def _opened(path: str) -> Dataset:
    return open_dataset(Path(path))


def _without_other_people(fold: Fold, windows: WindowSet, dataset: Dataset) -> Fold:
    """Return the fold without those training windows that lie in streams of its validation and test people."""
    people = set(windows.subject[np.concatenate([fold.validation, fold.test])].tolist()) - {NOBODY}
    return replace(fold, train=fold.train[outside_streams(windows, dataset, people)[fold.train]])


def _without(windows: WindowSet, label: str) -> WindowSet:
    """Return the windows of all gestures but ``label``, with the class indices renumbered."""
    if not label:
        return windows
    at = windows.labels.index(label)
    mine = windows.take(np.flatnonzero(windows.y != at))
    names = {key: getattr(mine, key)[:at] + getattr(mine, key)[at + 1 :] for key in ("labels", "affects", "families")}
    return replace(mine, y=mine.y - (mine.y > at), **names)


def abstaining(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str = "by-subject:5",
    withhold: bool = False,
    coverage: float = COVERAGE,
    known_share: float = KNOWN_SHARE,
    out: str | os.PathLike[str] | None = None,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> Abstaining:
    """Evaluate abstention: risk against coverage, the stated coverage, and known against unknown gestures.

    A network is trained for each fold of people. Its thresholds are fitted to the validation people, and all scores
    come from the streams of the test people. Finished trainings are kept in the data set's ``cache`` folder.

    Args:
        split: by whole people: "by-subject:5", "leave-one-subject-out".
        withhold: also train without each gesture in turn, and measure whether it is recognised as unknown.
        coverage: share of steps for which the fitted conformal set of classes should contain the true one.
        known_share: share of the known gestures that should lie above the threshold for unknown ones.
        out: a folder for ``abstaining.json`` and the figure.
        progress: called when a training is done.

    Raises:
        ConfigError: for a split of windows or recordings, a share that is not between 0 and 1, or where ``out`` cannot
            be written; DatasetError: for a data set without streams.
        BadInput: when the test or the validation people have no recordings in streams.
    """
    for name, share in (("coverage", coverage), ("known_share", known_share)):
        if not 0.0 < share < 1.0:
            raise ConfigError(f"{name} is {share}: accepted is between 0 and 1, such as 0.9.")
    if out is not None:
        check_folder(Path(out), "An evaluation of abstention")
    dataset, config = network_inputs_of(as_dataset(dataset), config or from_settings(**settings))
    parsed = parse_split(split)
    if not parsed.separates_people:
        raise ConfigError(
            f"The split '{split}' does not keep people apart: accepted are by-subject:K and leave-one-subject-out."
        )
    if not any(r.stream_row >= 0 for r in dataset.used):
        raise DatasetError(
            f"No recording of '{dataset.head.name}' lies in a stream: import the recorder's fulldatastream.csv as well."
        )
    gestures = choose_classes(dataset, config.evaluation.classes, warn)
    arch = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    windows = windows_for(dataset, arch, config.windows, gestures, warn)
    folds = [
        _without_other_people(fold, windows, dataset)
        for fold in fold_windows(windows, windows, parsed, config.evaluation.seed)
    ]
    from plushsense.training.fit import resolve_device

    key = {
        "version": _VERSION,
        "dataset": dataset.hash,
        "windows": windows_fingerprint(windows),
        "arch": arch.to_dict(),
        "training": resolve_device(config.training).key(),
        "shares": [coverage, known_share],
    }
    # Fold by fold, so that a run that is stopped has results for every gesture.
    without = [(fold, label) for fold in folds for label in gestures.labels if withhold and len(gestures) > 2]
    jobs = [
        Job(job_id({**key, "fold": fold_fingerprint(fold), "withheld": label}), (fold, label))
        for fold, label in [*((fold, "") for fold in folds), *without]
    ]
    reporter = JobsReporter({job.id: JobInfo(job.task[0].name, 1.0) for job in jobs}, progress=progress)
    results = run_jobs(
        jobs,
        _AnswerWork(str(dataset.path), arch, config.training, gestures, dataset.layout, coverage, known_share),
        shared=windows,
        spec=JobsSpec(config.evaluation.processes, journal=journal_of(dataset, "abstaining")),
        callbacks=JobCallbacks(on_done=reporter.on_done),
    )
    answers = [
        FoldAnswers(
            job.task[0].name, job.task[1], tuple(g for g in gestures.labels if g != job.task[1]), results[job.id]
        )
        for job in jobs
    ]
    if not any(len(t.result["label"]) for t in answers if not t.withheld):
        raise BadInput(
            "None of the test people, or none of the validation people, has a stream with recordings in it: use other "
            "folds."
        )
    done = summarise(answers, coverage, known_share)
    done.table.update(split=parsed.text, simulated=dataset.head.simulated, dataset=dataset.head.name)
    if out is not None:
        with dataset.generation.writing():
            save(done, Path(out))
    return done


def save(done: Abstaining, out: Path) -> None:
    """Write the table as JSON and the curves as a picture."""
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / TABLE, json.dumps(done.table, indent=1, ensure_ascii=False))
    title = f"{done.table['dataset']}, {done.table['people']} people left out ({done.table['split']})"
    title += "  [SIMULATION]" if done.table["simulated"] else ""
    write_file(out / FIGURE, png(curves(done.curves, title=title), dpi=110))
