"""Train, evaluate and load networks, and simulate recordings: the main functions of the Python API."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError, python_warning
from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Message
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.quality.copies import copied_recordings
from plushsense.dataset.readings import Readings
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, Generation
from plushsense.deploy.quantize import (
    QUANTIZE_VERSION,
    Ranges,
    calibration,
    integer_probabilities,
    quantize,
    refuse_undeployable,
)
from plushsense.evaluation.crossval import CrossvalSpec, EvaluationResult, FoldOutput
from plushsense.evaluation.crossval import evaluate as crossvalidate
from plushsense.evaluation.leakage import warn_of_copies
from plushsense.evaluation.scores import FoldRecord, PartResult, Predictions, Scores, gather_predictions, with_accuracy
from plushsense.evaluation.scores import compute_scores as score_predictions
from plushsense.jobs.journal import UNFINISHED, Journal, job_id, keep_if_possible
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.progress import JobProgress
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle, is_training_content
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.temperature import check_temperature
from plushsense.training.spec import EpochProgress, EpochRow, TrainSpec
from plushsense.tuning.decisions import fit_decisions as fit_on_people
from plushsense.windows.cut import ANYWHERE, WindowSet
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.networks import KEPT_S, NetworkTrainer, TrainedNetwork
from plushsense.workflow.preparation import (
    WHOLE_PEOPLE,
    PreparedTraining,
    Run,
    Warn,
    prepare,
    prepare_training,
    warn_of_files_twice,
    warn_of_single_people,
)
from plushsense.workflow.reporting import check_place, journal_of, save_evaluation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from plushsense.recording.simulate import SimulationResult


# Number of windows that are predicted at once.
_BATCH = 256
_PREDICTIONS = "validation"
# Training warns if float and 8-bit predictions agree on a smaller share of the validation windows than this.
_AGREEMENT = 0.95


def unfinished(dataset: Dataset | str | os.PathLike[str]) -> Journal:
    """Return the journal of unfinished trainings in a data set's cache."""
    if isinstance(dataset, Dataset):
        return journal_of(dataset, UNFINISHED)
    folder = Path(dataset)
    return Journal(folder / CACHE / UNFINISHED, Generation.of(folder).writing)


@dataclass(frozen=True)
class TrainAndPredict:
    """The work of one fold of a cross-validation: train a network and predict the test windows.

    With ``int8``, the network is also quantized with the value ranges of its training windows and predicts in 8 bits.
    With ``people``, it is trained on that many of the people, drawn by the seed; a larger number includes a smaller.
    """

    arch: Arch
    spec: TrainSpec
    int8: bool = False
    people: int | None = None

    def __call__(
        self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: EpochProgress, /
    ) -> FoldOutput:
        from plushsense.training.fit import fit, predict

        if self.people is not None:
            names = sorted(set(train.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT})
            # Folds draw differently, so that the outcome does not depend on a few people.
            rng = np.random.default_rng([self.spec.seed, crc32(" ".join(names).encode())])
            left_out = rng.permutation(names)[self.people :]
            train = train.take(np.flatnonzero(~np.isin(train.subject, left_out)))
        fitted = fit(train, validation, self.arch, self.spec, progress)
        probabilities = predict(self.arch, fitted.weights, fitted.scaler, test, self.spec.device)
        deployed = None
        if self.int8:
            kept = calibration(self.arch, fitted.weights, fitted.scaler, train.integers)
            network = quantize(self.arch, fitted.weights, fitted.scaler, Ranges.from_dict(kept))
            deployed = integer_probabilities(network, test.integers)
        return FoldOutput(probabilities, fitted.history, fitted.seconds, fitted.best_epoch, deployed)


class DeployedScores(NamedTuple):
    """Scores of a network in 8 bits; ``agreement`` is the share of the windows with the answer of the float network."""

    accuracy: float | None
    macro_f1: float | None
    agreement: float


@dataclass(frozen=True)
class TrainingScores:
    """The scores of a training on what was held back.

    Attributes:
        split: how it was divided; description: what was held back, as a sentence.
        windows: number of scored windows.
        nobody: the accuracy on recordings of nobody, which do not count otherwise; None without them.
        simulated: whether the data are those of a virtual toy.
        int8: the scores in 8 bits; None where the network cannot be deployed.
    """

    split: str
    leaky: bool
    description: str
    windows: int
    accuracy: float | None
    macro_f1: float | None
    nobody: PartResult | None
    best_epoch: int
    simulated: bool
    int8: DeployedScores | None

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON, as bundles store them; the description has the key ``said``."""
        return {
            "split": self.split,
            "leaky": self.leaky,
            "said": self.description,
            "windows": self.windows,
            "accuracy": self.accuracy,
            "macro_f1": self.macro_f1,
            "nobody": None if self.nobody is None else self.nobody._asdict(),
            "best_epoch": self.best_epoch,
            "simulated": self.simulated,
            "int8": None if self.int8 is None else self.int8._asdict(),
        }


@dataclass(frozen=True)
class Trained:
    """A trained network: its ``bundle``, the ``history`` of its epochs, and its validation ``scores``.

    ``seconds`` is the training time, including that before an interruption. The bundle does not contain it, so that
    equal data, settings and seed give the same file, byte for byte.
    """

    bundle: Bundle
    history: list[EpochRow]
    scores: TrainingScores
    seconds: float = 0.0
    generation: Generation | None = None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save the bundle; raise ForgottenError if a person was removed from the data set since it was opened."""
        with nullcontext() if self.generation is None else self.generation.writing():
            return self.bundle.save(Path(path))

    def figure(self) -> Figure:
        """Draw loss and accuracy over the epochs."""
        from plushsense.reports.figures import training_curves

        return training_curves([self.history], title=self.bundle.arch.symbol)

    def __repr__(self) -> str:
        return f"Trained({self.bundle!r}; {self.scores.description})"


def train(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    quantize_aware: int = 0,
    temperature: float = 1.0,
    fit_decisions: bool = True,
    journal: Journal | None = None,
    progress: EpochProgress | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> Trained:
    """Train one network on a data set.

    15 % of the people, chosen by the seed, are held out for validation: the network is scored on them, and the decision
    settings are fitted. Then it is trained further on everybody, for a third of the epochs, and this network is
    returned; so the scores are those of a network of fewer people. With early stopping, the validation people determine
    when to stop, so that the scores are slightly too high, and nothing follows. `evaluate` scores all people.
    The preset ``search`` splits windows as the paper does (70/15/15), which is leaky and marked as such.
    ``context="anywhere"`` trains for live use (see `windows.anywhere`): idleness is a class; scored are whole gestures.

    Args:
        config: settings; alternatively give them by name (see `from_settings`), as in ``preset="loso", epochs=20``.
        quantize_aware: epochs of fine-tuning for 8 bits after the training (see `training.quantized`).
        temperature: number that divides the logits, so that the network is as sure as it is right; an evaluation
            proposes it (`plushsense.evaluation.confidence`). It becomes part of the weights, before all fitting.
        fit_decisions: also fit the decision settings on the validation people (see `tuning.decisions`), but for those
            in ``config.live`` that differ from the defaults.
        journal: stores the progress of the training (see `unfinished`), so that an interrupted one resumes and gives
            the same bundle. The steps after the training are repeated.
        progress: called with (epoch, maximum of epochs, row), first for the epochs before an interruption. Rows of the
            fine-tuning and of the training on everybody have ``what``, and others the ``accuracy`` of validation.
        warn: called with a sentence for everything unusual; by default, these are Python warnings.
    """
    if quantize_aware < 0:
        raise ConfigError(f"quantize_aware is {quantize_aware}: accepted are 0 (off) and more epochs.")
    check_temperature(temperature)
    made = prepare_training(dataset, from_settings(config, **settings), warn, deployable=quantize_aware > 0)
    run, scored, dataset, apart = made.run, made.scored, made.run.dataset, made.split.separates_people

    def report(epoch: int, epochs: int, row: EpochRow) -> None:
        if progress is not None:
            progress(epoch, epochs, with_accuracy([row], apart)[0])

    trainer = NetworkTrainer(run, made.windows, made.kind == WHOLE_PEOPLE, quantize_aware, temperature, journal, report)
    checked = trainer.train(made.train, scored.take(made.validation), made.fold.subjects)
    nothing, everything = scored.take(made.validation[:0]), np.arange(len(made.windows))
    final = trainer.train(everything, nothing, start=checked) if made.refit else checked
    predictions, scores = _validated(made, checked, warn)
    bundle = _bundle(made, final, scores, quantize_aware, temperature)
    if fit_decisions:
        reader = replace(bundle, weights=checked.weights, scaler=checked.fitted.scaler)
        bundle = replace(bundle, decision=_decisions(reader, dataset, run.live, warn))
    if made.kind == WHOLE_PEOPLE:
        _keep_predictions(dataset, bundle, predictions)
    trainer.discard()
    # `forget` cannot find an unsaved bundle: raise an error if a person was removed during the training.
    dataset.generation.check()
    seconds = checked.seconds + (final.seconds if made.refit else 0.0)
    return Trained(bundle, with_accuracy(checked.fitted.history, apart), scores, seconds, dataset.generation)


def _keep_predictions(dataset: Dataset, bundle: Bundle, predictions: Predictions) -> None:
    """Store the answers on the people who were held back in the cache of the data set, for `validation_predictions`."""
    kept = journal_of(dataset, _PREDICTIONS)
    kept.prune(KEPT_S)
    keep_if_possible(kept, _predictions_id(bundle), {**vars(predictions)})


def _bundle(
    made: PreparedTraining, final: TrainedNetwork, scores: TrainingScores, quantize_aware: int, temperature: float
) -> Bundle:
    """Return the bundle of a trained network, with the decision settings that were given."""
    run = made.run
    people = sorted({str(s) for s in made.windows.subject[final.at]})
    anywhere = {"anywhere": asdict(run.anywhere)} if run.windows.context == ANYWHERE else {}
    return Bundle(
        arch=run.network,
        weights=final.weights,
        layout=run.dataset.layout,
        scaler=final.fitted.scaler,
        gestures=run.gestures,
        windowing={**asdict(run.windows), **anywhere},
        decision=run.live.to_dict(),
        provenance={
            "dataset": run.dataset.head.name,
            "dataset_hash": run.dataset.hash,
            "simulated": run.dataset.head.simulated,
            "subjects": people,
            "validation_subjects": sorted({str(s) for s in made.scored.subject[made.validation]}),
            "split": made.kind,
            "refit": made.refit,
            "context": dict(sorted(Counter(made.windows.context.tolist()).items())),
            "preset": run.preset,
            "training": run.training.to_dict(),
            "quantize_aware": quantize_aware,
            **({"temperature": temperature} if temperature != 1.0 else {}),
            "scores": scores.to_json(),
            "code_version": __version__,
        },
        calibration=final.ranges,
        readings=Readings.of(run.dataset, people),
    )


def _validated(made: PreparedTraining, trained: TrainedNetwork, warn: Warn) -> tuple[Predictions, TrainingScores]:
    """Return the predictions for the validation windows, and their scores; also those in 8 bits if there are ranges.

    ``warn`` gets a sentence if 8-bit arithmetic changes many predictions.
    """
    from plushsense.training.fit import predict

    run, fold, fitted = made.run, made.fold, trained.fitted
    test = made.scored.take(fold.test)
    sizes = (len(trained.at), len(made.validation), len(test))
    record = FoldRecord(fold.name, fold.subjects, sizes, len(fitted.history), fitted.seconds)

    def score(probabilities: NDArray[np.float32]) -> tuple[Predictions, Scores]:
        predictions = gather_predictions(made.scored, [(fold.name, fold.test)], [probabilities])
        apart = made.split.separates_people
        return predictions, score_predictions(predictions, [record], made.scored.affects, apart)

    predictions, found = score(predict(run.network, trained.weights, fitted.scaler, test, run.training.device))
    int8 = None
    if trained.ranges:
        integer = quantize(run.network, trained.weights, fitted.scaler, Ranges.from_dict(trained.ranges))
        deployed, after = score(integer_probabilities(integer, test.integers))
        agreement = float((deployed.predicted == predictions.predicted).mean())
        int8 = DeployedScores(after.mean("accuracy"), after.mean("macro_f1"), agreement)
        if agreement < _AGREEMENT:
            advice = "more epochs of --quantize-aware" if trained.tuned else "--quantize-aware 10"
            changed = 100 * (1 - agreement)
            warn(
                Message(
                    "8 bits change {percent:.1f} % of the answers on the validation windows: try {advice}",
                    percent=changed,
                    advice=advice,
                )
            )
    return predictions, TrainingScores(
        split=made.kind,
        leaky=made.split.leaky,
        description=made.description,
        windows=len(test),
        accuracy=found.mean("accuracy"),
        macro_f1=found.mean("macro_f1"),
        nobody=found.nobody,
        best_epoch=fitted.best_epoch,
        simulated=run.dataset.head.simulated,
        int8=int8,
    )


def _decisions(bundle: Bundle, dataset: Dataset, given: DecideSpec, warn: Warn) -> dict[str, Any]:
    """Return decision settings fitted on the validation people of the bundle; its own if it has none.

    The weights of ``bundle`` must not have been fitted to these people.
    """
    if bundle.provenance["split"] != WHOLE_PEOPLE:
        warn(Message("decision settings are the defaults: fitting them needs whole people held out for validation"))
        return bundle.decision
    validated, trained = (
        set(bundle.provenance[key]) - {NOBODY, UNKNOWN_SUBJECT} for key in ("validation_subjects", "subjects")
    )
    plain = DecideSpec()
    keep = {f.name for f in fields(DecideSpec) if getattr(given, f.name) != getattr(plain, f.name)}
    return fit_on_people(bundle, dataset, validated, training=trained, spec=given, keep=keep).to_dict()


def _predictions_id(bundle: Bundle) -> str:
    weights = {name: sha256(np.ascontiguousarray(w).tobytes()).hexdigest() for name, w in bundle.weights.items()}
    return job_id({"what": _PREDICTIONS, "dataset": bundle.provenance["dataset_hash"], "weights": weights})


@dataclass(frozen=True)
class FoldsSpec:
    """What `evaluate_run` trains, where, and where it writes the result.

    Attributes:
        out: a folder for ``evaluation.json`` and ``predictions.parquet``. A folder with an evaluation of other settings
            or data is refused unless ``overwrite``.
        cluster: address of a Ray cluster that trains the folds.
        int8: also score each fold's network in 8 bits on the same windows, as ``int8`` of the result. Folds that were
            stored without it are trained again.
        people: train each fold on so many of its people only, for a learning curve; not with ``out``.
    """

    out: str | os.PathLike[str] | None = None
    overwrite: bool = False
    cluster: str | None = None
    int8: bool = False
    people: int | None = None


def evaluate(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    int8: bool = False,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> EvaluationResult:
    """Train and score one network for each fold of a split.

    Finished folds are stored in the data set's ``cache`` folder, so that an interrupted evaluation can be resumed.

    Args:
        config, settings, warn: as for `train`; also ``train_context``, ``workers``, and ``split``:
            "leave-one-subject-out" (default), "by-subject:5", "by-recording:5", "windows:5" (leaky).
        out, overwrite, int8: as in `FoldsSpec`.
    """
    run = prepare(dataset, from_settings(config, **settings), warn)
    return evaluate_run(run, FoldsSpec(out, overwrite, int8=int8), progress=progress, warn=warn)


def evaluate_run(
    run: Run,
    spec: FoldsSpec,
    *,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = python_warning,
) -> EvaluationResult:
    """Train and score one network for each fold of a prepared run."""
    if spec.out is not None:
        check_place(Path(spec.out), run, replace=spec.overwrite)
    if spec.int8:
        refuse_undeployable(run.network)
    warn_of_files_twice(run.dataset, run.gestures, warn)
    score = fit_on = run.scored_windows(warn)
    if run.split.separates_people:
        warn_of_single_people(score, warn)
    if run.trained_on != run.scored_on:
        fit_on = run.training_windows()
    from plushsense.training.fit import resolve_device

    key = {
        "arch": run.network.to_dict(),
        "training": resolve_device(run.training).key(),
        "vectors": fit_on.vectors,
        **({"int8": QUANTIZE_VERSION} if spec.int8 else {}),
        **({"people": spec.people} if spec.people is not None else {}),
    }
    jobs = JobsSpec(run.evaluation.processes, journal=journal_of(run.dataset, "folds"), cluster=spec.cluster)
    result = crossvalidate(
        fit_on,
        score,
        run.split,
        TrainAndPredict(run.network, run.training, spec.int8, spec.people),
        CrossvalSpec(run.evaluation.seed, run.holds_back, jobs, key),
        shared_rows=partial(copied_recordings, run.dataset, score.recording_ids),
        progress=progress,
    )
    warn_of_copies(result.leakage, warn)
    if spec.out is not None:
        with run.dataset.generation.writing():
            save_evaluation(result, run, Path(spec.out))
    return result


def validation_predictions(bundle: Bundle, dataset: Dataset | str | os.PathLike[str]) -> Predictions:
    """Return what a network answered on the recordings of its validation people, as `train` scored it.

    The answers are kept for 30 days; those of a network that was then trained on everybody (``refit``) are of the one
    before. Recordings at rest are left out.

    Raises:
        DatasetError: if the bundle has no validation people or their answers are gone, or the data set was changed
            since the training.
    """
    dataset = as_dataset(dataset)
    if bundle.provenance.get("split") != WHOLE_PEOPLE:
        raise DatasetError("This network has no validation people: evaluate it instead.")
    if not is_training_content(bundle, dataset):
        raise DatasetError(
            "The data set '{name}' was changed since this network was trained: evaluate it instead.",
            name=dataset.head.name,
        )
    if (stored := journal_of(dataset, _PREDICTIONS).find(_predictions_id(bundle))) is None:
        raise DatasetError(
            "The answers of this network on its validation people are no longer stored (they are kept for 30 days in "
            "the data set's cache): evaluate it instead."
        )
    known = ~np.isin(stored["subject"], [NOBODY, UNKNOWN_SUBJECT])
    arrays = {key: value[known] for key, value in stored.items() if key != "labels"}
    return Predictions(labels=tuple(stored["labels"]), **arrays)


def load(path: str | os.PathLike[str]) -> Bundle:
    """Load a model bundle (``*.plush``)."""
    return Bundle.load(Path(path))


def simulate(
    out: str | os.PathLike[str],
    *,
    people: int = 25,
    repetitions: int = 3,
    seed: int = 1,
    dataset: str | os.PathLike[str] | None = None,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> SimulationResult:
    """Write recordings of virtual people in the format of the paper's recorder, by default as many as the authors have.

    Args:
        out: a new or empty folder.
        dataset: a folder in which to import the recordings as a data set; default: none.
        progress: called with ("recording" or "importing", done, total).
    """
    from plushsense.recording.simulate import SimulationSpec
    from plushsense.recording.simulate import simulate as run

    done = run(
        Path(out),
        SimulationSpec(people=people, repetitions=repetitions, seed=seed),
        progress=lambda at, total, _: progress("recording", at, total),
    )
    if dataset is not None:
        import_simulation(out, dataset, progress)
    return done


def import_simulation(
    source: str | os.PathLike[str], dest: str | os.PathLike[str], progress: Callable[[str, int, int], None]
) -> Dataset:
    """Import the recordings that `simulate` wrote as a data set, which is marked as a simulation."""
    return import_recordings(
        Path(source),
        Path(dest),
        layout="plush-15",
        name="virtual toy",
        licence="MIT",
        consent="nobody: a simulation",
        progress=lambda at, total: progress("importing", at, total),
        readmit=True,  # Nobody is behind the codes of virtual people.
    ).dataset
