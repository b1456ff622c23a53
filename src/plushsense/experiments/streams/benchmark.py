"""Run the continuous benchmark: a bundle or predictions on whole streams, or every system on people left out."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import (
    BadInput,
    BundleError,
    ConfigError,
    DatasetError,
    FileFormatError,
    check_known,
    nearest,
    need,
    python_warning,
)
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.store import Dataset, StreamInfo
from plushsense.deploy.quantize import calibration
from plushsense.experiments.recordings import opened
from plushsense.experiments.streams.predictions import (
    StreamPredictions,
    check_events_path,
    read_predictions,
    shortened,
    write_events,
)
from plushsense.experiments.streams.replay import (
    EventCounts,
    StreamScore,
    StreamTruth,
    count_matches,
    model_events,
    people_scores,
    people_with_streams,
    scored_streams,
    truth_of,
)
from plushsense.experiments.streams.score import (
    BenchmarkResult,
    Fitted,
    Folds,
    PeopleFold,
    Settings,
    crossvalidated_streams,
    people_folds,
    pooled_scores,
    summed,
)
from plushsense.experiments.streams.systems import ANYWHERE, SYSTEMS, WINDOWS
from plushsense.jobs.journal import job_id
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.study import Progress
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle, known_people, trained_people
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.events import LATE_S
from plushsense.training.spec import EpochProgress, TrainSpec
from plushsense.tuning.gate import GateSpec, fit_gate
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSpec
from plushsense.workflow.config import SHARED, RunConfig, from_settings
from plushsense.workflow.preparation import (
    Run,
    Warn,
    choose_classes,
    classes_for,
    named_classes,
    outside_streams,
    prepare,
    silent,
    windows_for,
    with_preset,
)
from plushsense.workflow.reporting import check_results, journal_of, keep_bundle


@dataclass(frozen=True)
class Recipe:
    """Settings with which one of a fold's networks is trained and its windows are cut."""

    arch: Arch
    training: TrainSpec
    windows: WindowSpec
    gestures: GestureSet
    anywhere: AnywhereSpec | None = None

    def key(self) -> dict[str, object]:
        """Return the settings that a network depends on besides the data and the fold."""
        return {
            "arch": self.arch.to_dict(),
            "training": self.training.key(),
            "windows": vars(self.windows),
            "gestures": self.gestures.to_dict(),
            "anywhere": None if self.anywhere is None else vars(self.anywhere),
        }


@dataclass(frozen=True)
class TrainStreams:
    """A function that fits the networks and the gate of a fold; it stores trained networks in ``folder``."""

    recipes: Mapping[str, Recipe]
    gate: bool
    folder: Path

    def __call__(self, dataset: Dataset, fold: PeopleFold, progress: EpochProgress, /) -> Fitted:
        networks = {name: self._network(recipe, dataset, fold, progress) for name, recipe in self.recipes.items()}
        if not self.gate:
            return Fitted(networks)
        fitted = fit_gate(dataset, next(iter(networks.values())).gestures, fold.train)
        return Fitted(networks, fitted.settings, {"gate": fitted.report, "plan": asdict(fitted.settings)})

    def _network(self, recipe: Recipe, dataset: Dataset, fold: PeopleFold, progress: EpochProgress) -> Bundle:
        path = self.folder / f"{job_id({**recipe.key(), 'data': dataset.hash, 'fold': vars(fold)})}.plush"
        if path.is_file():
            return Bundle.load(path)
        from plushsense.training.fit import fit

        arch, gestures = recipe.arch, recipe.gestures
        cut = scored = windows_for(dataset, arch, recipe.windows, gestures, anywhere=recipe.anywhere)
        if recipe.anywhere is not None:
            scored = windows_for(dataset, arch, replace(recipe.windows, context="stream"), gestures)
        # Recordings at rest belong to no person and are used for training in every fold.
        mine = np.isin(cut.subject, [*fold.train, NOBODY])
        train = cut.take(np.flatnonzero(mine & outside_streams(cut, dataset, {*fold.validation, *fold.test})))
        validation = scored.take(np.flatnonzero(np.isin(scored.subject, fold.validation)))
        fitted = fit(train, validation, arch, recipe.training, progress)
        calibrated = calibration(arch, fitted.weights, fitted.scaler, train.integers)
        people = {"subjects": list(fold.train), "validation_subjects": list(fold.validation)}
        origin = {"dataset": dataset.head.name, "dataset_hash": dataset.hash, "code_version": __version__, **people}
        bundle = Bundle(
            arch,
            fitted.weights,
            dataset.layout,
            fitted.scaler,
            gestures,
            dict(vars(recipe.windows)),
            {},
            origin,
            calibrated,
        )
        keep_bundle(bundle, path, dataset)
        return bundle

    def key(self) -> dict[str, object]:
        """Return the settings that the fit depends on besides the data and the fold."""
        return {
            "gate": str(GateSpec()) if self.gate else None,
            **{name: recipe.key() for name, recipe in self.recipes.items()},
        }


def recipes_for(
    dataset: Dataset, config: RunConfig, run: Run, networks: Collection[str], warn: Warn = silent
) -> dict[str, Recipe]:
    """Return the recipe of each network in ``networks``; they differ in windows, classes, epochs and stride.

    ``run`` are the settings of ``config``, resolved for the data set.
    """
    from plushsense.training.fit import resolve_device

    if run.network.padding != "stream":
        raise ConfigError(f"A network with {run.network.padding} padding cannot follow a stream: use --padding stream.")
    classes, recipes = run.evaluation.classes, dict[str, Recipe]()

    def training(context: str) -> TrainSpec:
        windows = replace(config.windows, context=context)
        evaluation = replace(config.evaluation, train_context=None)
        spec = with_preset(replace(config, windows=windows, evaluation=evaluation), run.network.symbol).training
        apart = {key: getattr(spec, key) for key in ("epochs", "halve_every", "stride")}
        return replace(resolve_device(run.training), **apart)

    if WINDOWS in networks:
        gestures = choose_classes(dataset, classes, warn)
        arch = replace(run.network, classes=len(gestures))
        recipes[WINDOWS] = Recipe(arch, training(run.scored_on.context), run.scored_on, gestures)
    if ANYWHERE in networks:
        gestures = classes_for(dataset, classes, "anywhere", warn if WINDOWS not in networks else silent)
        arch = replace(run.network, classes=len(gestures))
        windows = replace(run.windows, context="anywhere")
        recipes[ANYWHERE] = Recipe(arch, training("anywhere"), windows, gestures, run.anywhere)
    return recipes


TABLE, SHEET, PAGE, CURVES, LATENCIES = "streams.json", "streams.csv", "streams.html", "curves.png", "latencies.png"
SPLIT = "by-subject:5"


UPPER_BOUND = (
    "Events outside of marked recordings count as false, and that is an upper bound: between recordings these people "
    "also practised and handled the device. Stretches at rest are where an event was certainly for no reason."
)
TRUE_RATES = "Every sample of these streams is labelled, so the false events are true ones."
SIMULATED_RATES = (
    "The people of these streams are simulated and make only the recorded gestures, so the false events are true ones."
)

_UNKNOWN_TRAINING = (
    "Predictions do not say on whom their system was trained: if on these people, the scores are too high."
)


LABELLED_RATES = (
    "In {labelled} of {streams} streams, stretches between recordings are labelled: an event that names a practised "
    "gesture is right, and one at rest or while the toy is handled is certainly false. Where there is no label, people "
    "may have practised, so the rate is still an upper bound."
)


def describe_false_events(dataset: Dataset) -> str:
    """Return a sentence that explains how to read the false events on this data."""
    if dataset.layout.is_labelled:
        return TRUE_RATES
    if dataset.head.simulated:
        return SIMULATED_RATES
    labelled = {s.stream for s in dataset.stretches}
    return LABELLED_RATES.format(labelled=len(labelled), streams=len(dataset.streams)) if labelled else UPPER_BOUND


def _people_of(dataset: Dataset, path: str | os.PathLike[str], subjects: Sequence[str] | None) -> list[str]:
    """Return the people who have a stream, and raise for one of ``subjects`` who has none, or if they are nobody."""
    if subjects is not None and not subjects:
        raise BadInput("--subjects names nobody: name people, or leave it out for all whom the model does not know.")
    there = people_with_streams(dataset)
    if not there:
        raise DatasetError(
            f"'{path}' has no stream in which a recording is located: give a folder with fulldatastream.csv and "
            "the recordings of that session, or a data set with such streams."
        )
    for person in subjects or ():
        if person not in there:
            raise BadInput(
                f"'{person}' has no stream in '{path}'; there are those of: {', '.join(there)}.{nearest(person, there)}"
            )
    return there


@dataclass(frozen=True)
class ScoredStreams:
    """The scores of the events of one system on whole streams.

    Attributes:
        scores: of each person.
        note: how to read the false events.
        labelled_stretches: number of labels between recordings that were used.
    """

    scores: Mapping[str, StreamScore]
    dataset: str
    simulated: bool
    late_s: float
    labelled_stretches: int
    note: str

    @property
    def whole(self) -> StreamScore:
        """The scores of all people together."""
        return pooled_scores(self.scores.values())


@dataclass(frozen=True)
class StreamEvalResult(ScoredStreams):
    """The result of `stream_eval`; ``trained_on`` names scored people on whom the model was trained."""

    trained_on: tuple[str, ...]
    spec: DecideSpec

    def to_json(self) -> dict[str, object]:
        """Return plain values: the figures over all people, and ``people`` with those of each."""
        rows = {who: {**one.to_dict(), "trained_on": who in self.trained_on} for who, one in self.scores.items()}
        settings = {k: v for k, v in self.spec.to_dict().items() if k not in ("gate", "health", "fitted")}
        return {
            **self.whole.to_dict(),
            "people": rows,
            "dataset": self.dataset,
            "simulated": self.simulated,
            "trained_on": list(self.trained_on),
            "settings": settings,
            "gate_rules": len(self.spec.gate.rules),
            "late_s": self.late_s,
            "labelled_stretches": self.labelled_stretches,
            "note": self.note,
        }


@dataclass(frozen=True)
class ThresholdPoint:
    """Recall, F1 and false events per hour of the predictions whose score is at least ``threshold``."""

    threshold: float
    recall: float
    f1: float
    false_events_per_hour: float


@dataclass(frozen=True)
class PredictionsResult(ScoredStreams):
    """The result of `score_predictions`; ``form`` is "events" or "decisions"."""

    curve: tuple[ThresholdPoint, ...]
    predictions: str
    form: str
    threshold: float
    classes: tuple[str, ...]
    streams: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values: the figures over all people, and ``people`` with those of each."""
        table: dict[str, Any] = {**self.whole.to_dict(), "people": {p: one.to_dict() for p, one in self.scores.items()}}
        for row in (table, *table["people"].values()):
            del row["gate_events"]  # predictions do not say what began an event
        return {
            **table,
            "curve": [dict(vars(point)) for point in self.curve],
            "dataset": self.dataset,
            "simulated": self.simulated,
            "predictions": self.predictions,
            "form": self.form,
            "threshold": self.threshold,
            "classes": list(self.classes),
            "streams": list(self.streams),
            "late_s": self.late_s,
            "labelled_stretches": self.labelled_stretches,
            "note": self.note,
        }


def stream_eval(
    path: str | os.PathLike[str],
    model: Bundle | str | os.PathLike[str],
    *,
    subjects: Sequence[str] | None = None,
    late_s: float = LATE_S,
    events: str | os.PathLike[str] | None = None,
    labels: bool = True,
    warn: Warn = python_warning,
) -> StreamEvalResult:
    """Replay whole streams through one bundle with its own decision settings, and score its events.

    Args:
        path: a data set, or a folder of recordings with their stream.
        subjects: people to score; by default all on whom the bundle was not trained. A person on whom it was trained is
            scored only if named here, and is marked in the result.
        late_s: longest time in seconds after a gesture's end at which an event still counts as its answer.
        events: a CSV file to write the events to, which `score_predictions` reads.
        labels: whether to use the labels of stretches between recordings (`Dataset.stretches`).
        warn: called with a sentence on the people who are left out or were trained on.

    Raises:
        DatasetError: where no stream has a recording in it; BundleError: where the model has other inputs.
        BadInput: for a person without a stream, or if nobody is left to score.
    """
    if events is not None:
        check_events_path(events)
    bundle = model if isinstance(model, Bundle) else Bundle.load(Path(model))
    with opened(path, bundle.layout, bundle.gestures) as dataset:
        dataset = dataset if labels else dataset.without_stretches()
        dataset = dataset.with_inputs(bundle.layout).with_gestures(bundle.gestures)
        if dataset.layout.inputs != bundle.layout.inputs:
            raise BundleError(
                f"The model reads {', '.join(bundle.layout.inputs)}, and '{dataset.head.name}' has "
                f"{', '.join(dataset.layout.inputs)}: give streams of the same sensors."
            )
        people, met = _scored_people(_people_of(dataset, path, subjects), subjects, bundle, dataset, warn)
        spec = DecideSpec.from_dict(bundle.decision)
        found = list(model_events(dataset, bundle, people, spec))
        if events is not None:
            write_events(events, found, bundle.gestures)
        return StreamEvalResult(
            people_scores(found, bundle.gestures, late_s=late_s),
            dataset.head.name,
            dataset.head.simulated,
            late_s,
            len(dataset.stretches),
            describe_false_events(dataset),
            tuple(met),
            spec,
        )


def _scored_people(
    there: Sequence[str], subjects: Sequence[str] | None, bundle: Bundle, dataset: Dataset, warn: Warn
) -> tuple[list[str], list[str]]:
    """Return the people to score, and those of them on whom the model was trained; warn of what limits the scores."""
    trained = trained_people(bundle, dataset)
    people = [p for p in there if p not in trained] if subjects is None else list(dict.fromkeys(subjects))
    if subjects is None:
        left_out = [p for p in there if p in trained]
        if left_out:
            warn(f"left out, since the model was TRAINED ON them: {', '.join(left_out)}")
        if not people:
            raise BadInput(
                "The model was trained on everybody who has a stream here, so the scores would be too high: use "
                "--split by-subject:5, or name people with --subjects to score them anyway."
            )
    met = [p for p in people if p in trained]
    if met:
        warn(f"TRAINED ON: the model was trained on {', '.join(met)}; their scores are too high and are no result")
    known = known_people(bundle.provenance)
    if alike := [p for p in people if p not in trained and p in known]:
        warn(
            f"the model was trained on people of the same codes in '{bundle.provenance.get('dataset', '?')}': if "
            f"{', '.join(alike)} are the same people, their scores are too high"
        )
    if bundle.simulated and not dataset.head.simulated:
        warn("SIMULATION: the model was trained on virtual people, so its scores on real ones are no result")
    if not known:
        warn("the bundle does not say on whom it was trained: if on these people, the scores are too high")
    return people, met


def score_predictions(
    path: str | os.PathLike[str],
    predictions: str | os.PathLike[str],
    *,
    subjects: Sequence[str] | None = None,
    classes: str | Sequence[str] = SHARED,
    threshold: float = 0.0,
    late_s: float = LATE_S,
    labels: bool = True,
    warn: Warn = python_warning,
) -> PredictionsResult:
    """Score the predictions of any system against the true gestures of whole streams.

    Args:
        path: a data set, or a folder of recordings with their stream.
        predictions: a CSV file of decisions or events, as `plushsense.experiments.streams.predictions` describes it.
        subjects: people whose streams are scored, also those that the file does not name; by default the streams that
            it names.
        classes: gestures to score, as for `train`: "shared", "all", labels, or the TOML file of a gesture set.
        threshold: lowest score of a prediction that counts.
        late_s: longest time in seconds after a gesture's end at which an event still counts as its answer.
        labels: whether to use the labels of stretches between recordings (`Dataset.stretches`).
        warn: called with a sentence on streams and gestures that are left out.

    Returns:
        the scores, with a ``curve`` of up to 21 thresholds if the file has scores.

    Raises:
        FileFormatError: for a file that cannot be used, with the line; DatasetError: where no stream has a recording
            in it; ConfigError: for a threshold outside 0 to 1; BadInput: for a person without a stream.
    """
    if not 0.0 <= threshold <= 1.0:
        raise ConfigError(f"The threshold is {threshold:g}: accepted are 0 to 1, as for scores.")
    with opened(path) as dataset:
        dataset, classes = named_classes(dataset if labels else dataset.without_stretches(), classes)
        gestures = choose_classes(dataset, classes, warn)
        there = scored_streams(dataset, _people_of(dataset, path, subjects))
        asked = [s for s in there if subjects is None or s.subject in subjects]
        alone = asked[0].id if len(asked) == 1 else None
        read = read_predictions(predictions, gestures, dataset.gestures, there, alone)
        if threshold > 0 and not read.scored:
            raise FileFormatError(f"'{predictions}' has no column 'score': add one, or give no threshold.")
        if subjects is None:
            asked = _named_in(read, asked, f"'{predictions}'", warn)
        truths = [truth_of(dataset, s, dataset.read_stream(s.id), gestures) for s in asked]
        read.check_ends(truths)
        return PredictionsResult(
            people_scores([(t, read.events(t.stream, threshold)) for t in truths], gestures, late_s=late_s),
            dataset.head.name,
            dataset.head.simulated,
            late_s,
            len(dataset.stretches),
            f"{describe_false_events(dataset)} {_UNKNOWN_TRAINING}",
            _threshold_curve(read, truths, gestures, late_s),
            str(predictions),
            "events" if read.are_events else "decisions",
            threshold,
            tuple(gestures.labels),
            tuple(truth.stream for truth in truths),
        )


def _named_in(read: StreamPredictions, streams: Sequence[StreamInfo], file: str, warn: Warn) -> list[StreamInfo]:
    """Return the streams that a file of predictions names, and warn of the others."""
    if left_out := [s.id for s in streams if s.id not in read.rows]:
        warn(
            f"not scored, as {file} has no row of them: {shortened(left_out)}; for a stream without events give one "
            "row with an empty label, or name the people with --subjects"
        )
    return [s for s in streams if s.id in read.rows]


def _threshold_curve(
    read: StreamPredictions, truths: Sequence[StreamTruth], gestures: GestureSet, late_s: float
) -> tuple[ThresholdPoint, ...]:
    curve = []
    for value in read.thresholds():
        counts = EventCounts()
        for truth in truths:
            counts.add(count_matches(truth, read.events(truth.stream, value), gestures, late_s))
        curve.append(ThresholdPoint(value, counts.recall, counts.f1, counts.false_per_hour))
    return tuple(curve)


@dataclass(frozen=True)
class BenchmarkSpec:
    """Settings of `stream_benchmark`: the split, and the systems that are compared on the streams of people left out.

    Attributes:
        split: "by-subject:5" or "leave-one-subject-out".
        systems: names of `plushsense.experiments.streams.systems.SYSTEMS`; by default all.
        late_s: longest time in seconds after a gesture's end at which an event still counts as its answer.
        labels: whether to train and score with the labels of stretches between recordings (`Dataset.stretches`).
    """

    split: str = SPLIT
    systems: Sequence[str] | None = None
    late_s: float = LATE_S
    labels: bool = True

    @property
    def names(self) -> tuple[str, ...]:
        """The systems in the order of `SYSTEMS`."""
        for name in self.systems or ():
            check_known(name, SYSTEMS, "system", ConfigError)
        return tuple(name for name in SYSTEMS if self.systems is None or name in self.systems)


def save_benchmark(result: BenchmarkResult, out: Path) -> None:
    """Write JSON, CSV with a row for each point of a curve, a page and its figures to a folder."""
    from plushsense.experiments.streams.benchmark_page import curves, latencies, page, point_table
    from plushsense.reports.figures import png

    out.mkdir(parents=True, exist_ok=True)
    write_file(out / SHEET, point_table(result).csv())
    (out / CURVES).write_bytes(png(curves(result), dpi=130))
    (out / LATENCIES).write_bytes(png(latencies(result), dpi=130))
    write_file(out / PAGE, page(result))
    write_file(out / TABLE, json.dumps(vars(result), ensure_ascii=False, indent=1))


def stream_benchmark(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    spec: BenchmarkSpec | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> BenchmarkResult:
    """Score every system on the streams of people left out, with settings tuned on other people.

    In each fold, networks are trained on the training people, every system is tuned on the validation people, and
    scored on the test people. Finished folds and networks are kept in the data set's ``cache`` folder.

    Args:
        config, settings, warn: as for `train`; also ``workers``.
        out: a folder for the table as JSON and CSV, a page, and its figures.
    """
    spec = spec or BenchmarkSpec()
    config = from_settings(config, **settings)
    run = prepare(dataset, config)
    dataset = run.dataset if spec.labels else run.dataset.without_stretches()
    names, seed = spec.names, run.evaluation.seed
    if out is not None:
        need("matplotlib", extra="reports")
        need("jinja2", extra="reports")
        check_results(Path(out), "A benchmark", TABLE, replace=overwrite)
    people_folds(dataset, spec.split, seed)  # raises before anything is trained
    recipes = recipes_for(dataset, config, run, {SYSTEMS[n].network for n in names}, warn)
    fit = TrainStreams(recipes, any(SYSTEMS[n].gate_to for n in names), dataset.path / CACHE / "stream-networks")
    folds = crossvalidated_streams(
        dataset,
        spec.split,
        fit,
        settings=Settings(names, late_s=spec.late_s),
        spec=JobsSpec(run.evaluation.processes, journal=journal_of(dataset, "streams")),
        key=fit.key(),
        seed=seed,
        progress=progress,
    )
    result = _benchmark_result(run, dataset, spec, folds, recipes)
    if out is not None:
        with dataset.generation.writing():
            save_benchmark(result, Path(out))
    return result


def _benchmark_result(
    run: Run, dataset: Dataset, spec: BenchmarkSpec, folds: Folds, recipes: Mapping[str, Recipe]
) -> BenchmarkResult:
    """Add up the folds, and say what they were scored on."""
    tested = {person for fold in folds for person in fold["test"]}
    return BenchmarkResult(
        **vars(summed(folds)),
        split=spec.split,
        dataset=dataset.head.name,
        dataset_hash=dataset.hash,
        simulated=dataset.head.simulated,
        labelled=dataset.layout.is_labelled,
        note=describe_false_events(dataset),
        late_s=spec.late_s,
        labelled_stretches=len(dataset.stretches),
        subjects=sorted(tested & set(people_with_streams(dataset))),
        code_version=__version__,
        seed=run.evaluation.seed,
        networks={name: recipe.arch.title for name, recipe in recipes.items()},
        anywhere=dict(vars(run.anywhere)),
        preset=run.preset,
        training=run.training.to_dict(),
    )
