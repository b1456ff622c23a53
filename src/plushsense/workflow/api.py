"""Train, evaluate and load networks, and simulate recordings: the main functions of the Python API."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Sentence
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import UNKNOWN_SUBJECT, Dataset, Generation
from plushsense.deploy.quantize import (
    QUANTIZE_VERSION,
    Ranges,
    calibration,
    integer_probabilities,
    quantize,
    refuse_undeployable,
)
from plushsense.evaluation.crossval import EpochProgress, Evaluation, FoldOutput, windows_fingerprint
from plushsense.evaluation.crossval import evaluate as crossvalidate
from plushsense.evaluation.leakage import warn_of_copies
from plushsense.evaluation.scores import FoldRecord, Predictions, gather_predictions, with_accuracy
from plushsense.evaluation.scores import compute_scores as score_predictions
from plushsense.jobs.journal import UNFINISHED, Journal, job_id, keep_if_possible
from plushsense.jobs.progress import JobProgress
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle, known_people
from plushsense.models.reference import softmax
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import TrainSpec
from plushsense.tuning.decisions import fit_decisions as fit_on_people
from plushsense.windows.cut import ANYWHERE, WindowSet, whole_gestures
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import (
    WHOLE_PEOPLE,
    Warn,
    add_hard_negatives,
    classes_for,
    divide,
    network_inputs_of,
    outside_streams,
    silent,
    warn_of_files_twice,
    warn_of_single_people,
    windows_for,
)
from plushsense.workflow.reporting import check_place, journal_of, save_evaluation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from plushsense.training.engine import FitState


# Age at which unfinished trainings are deleted: most are never resumed, and they contain data on people.
_KEPT_S = 30 * 24 * 3600.0
_SAVE_EVERY_S = 0.5
# Number of windows that are predicted at once.
_BATCH = 256
FIRST_NETWORK = "first network"
# Training warns if float and 8-bit predictions agree on a smaller share of the validation windows than this.
_AGREEMENT = 0.95


def unfinished(dataset: Dataset | str | os.PathLike[str]) -> Journal:
    """Return the journal of unfinished trainings in a data set's cache."""
    if isinstance(dataset, Dataset):
        return journal_of(dataset, UNFINISHED)
    folder = Path(dataset)
    return Journal(folder / CACHE / UNFINISHED, Generation.of(folder).writing)


class ResumableTraining:
    """The state of one training in a journal, under an id derived from everything that the outcome depends on."""

    def __init__(self, journal: Journal, network: Arch, spec: TrainSpec, train: WindowSet, watched: WindowSet) -> None:
        from plushsense.training.fit import resolve_device

        self._journal, self.before_s, self._began = journal, 0.0, time.monotonic()

        settings = {"arch": network.to_dict(), "training": resolve_device(spec).key(), "vectors": train.vectors}
        journal.prune(_KEPT_S)
        fingerprints = [windows_fingerprint(train), windows_fingerprint(watched)]
        self._job = job_id({"what": "training", **settings, "windows": fingerprints})

    def load(self) -> FitState | None:
        """Return the saved state, or None."""
        entry = self._journal.find(self._job)
        if entry is None:
            return None
        from plushsense.training.engine import FitState

        self.before_s = float(entry["seconds"])
        return FitState.from_arrays(entry)

    def save(self, state: FitState) -> None:
        """Save the state; do nothing if the journal cannot be written."""
        spent = self.before_s + time.monotonic() - self._began
        keep_if_possible(self._journal, self._job, {**state.to_arrays(), "seconds": spent})

    def discard(self) -> None:
        """Delete the saved state."""
        self._journal.discard(self._job)


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
            kept = calibration(self.arch, fitted.weights, fitted.scaler, train.x)
            network = quantize(self.arch, fitted.weights, fitted.scaler, Ranges.from_dict(kept))
            deployed = integer_probabilities(network, test.x)
        return FoldOutput(probabilities, fitted.history, fitted.seconds, fitted.best_epoch, deployed)


@dataclass(frozen=True)
class Trained:
    """A trained network: its ``bundle``, the ``history`` of its epochs, and its validation ``scores``.

    ``seconds`` is the training time, including that before an interruption. The bundle does not contain it, so that
    equal data, settings and seed give the same file, byte for byte.
    """

    bundle: Bundle
    history: list[dict[str, Any]]
    scores: dict[str, Any]
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
        return f"Trained({self.bundle!r}; {self.scores['said']})"


def train(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    arch: str | None = None,
    filters: Sequence[int] | str | None = None,
    quantize_aware: int = 0,
    fit_decisions: bool = True,
    journal: Journal | None = None,
    progress: EpochProgress | None = None,
    warn: Warn = silent,
    **settings: Any,
) -> Trained:
    """Train one network on a data set.

    15 % of the people, chosen by the seed, are held out for validation, and the network is scored on them. With early
    stopping they also determine when to stop, so that the scores are slightly too high; `evaluate` scores all people.
    The preset ``search`` splits windows as the paper does (70/15/15), which is leaky and marked as such.
    ``context="anywhere"`` trains for live use (see `windows.anywhere`): idleness is a class, and the scored windows are
    those of whole gestures with the real signal before them.

    Args:
        config: resolved settings; alternatively give ``arch``, ``filters`` and settings such as ``preset="loso"``,
            ``context="loop"``, ``epochs=20``, ``seed=1``, ``classes="all"``, ``padding``, ``norm``.
        quantize_aware: epochs of fine-tuning for 8 bits after the training (see `training.quantized`).
        fit_decisions: also fit the decision settings on the validation people (see `tuning.decisions`). Settings in
            ``config.live`` that differ from the defaults are kept.
        journal: stores the progress of the training (see `unfinished`), so that an interrupted one resumes and gives
            the same bundle. The steps after the training are repeated.
        progress: called with (epoch, maximum of epochs, the epoch's row), first for the epochs before an interruption.
            Rows of the first network that finds hard negatives (``hard_share`` of the context "anywhere"), and of the
            fine-tuning, have ``what``. The others have ``accuracy``, that of validation as ``scores`` counts it.
        warn: called with a sentence for everything that is left out, and if 8-bit arithmetic changes many predictions.
    """
    given = config or from_settings(arch=arch, filters=filters, **settings)
    dataset, config = network_inputs_of(as_dataset(dataset), given)
    if quantize_aware < 0:
        raise ConfigError(f"quantize_aware is {quantize_aware}: accepted are 0 (off) and more epochs.")
    gestures = classes_for(dataset, config.evaluation.classes, config.windows.context, warn)
    network = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    if quantize_aware:
        refuse_undeployable(network)
    warn_of_files_twice(dataset, gestures, warn)
    windows = windows_for(dataset, network, config.windows, gestures, warn, config.anywhere)
    scored = windows
    if config.scored_on != config.windows:
        scored = windows_for(dataset, network, config.scored_on, gestures)
    division = divide(windows, config, scored)
    train_at, test_at = division.train, division.fold.test
    if division.kind == WHOLE_PEOPLE:
        # Decisions are fitted on whole streams of the validation people, which may contain recordings at rest.
        train_at = train_at[outside_streams(windows, dataset, division.fold.subjects)[train_at]]
    from plushsense.training.fit import fit, predict

    train_on, watched = windows.take(train_at), scored.take(division.watch)
    apart = division.split.apart
    epoch_done = _reporting(progress, apart)
    if division.kind == WHOLE_PEOPLE:
        train_on = add_hard_negatives(
            train_on, dataset, network, config.windows, config.anywhere, gestures, config.training,
            division.fold.subjects, _reporting(progress, apart, what=FIRST_NETWORK),
        )  # fmt: skip
    state = None if journal is None else ResumableTraining(journal, network, config.training, train_on, watched)
    start = state.load() if state else None
    for row in start.history if start is not None else ():
        epoch_done(row["epoch"], config.training.epochs, row)
    fitted = fit(
        train_on, watched, network, config.training, epoch_done,
        start=start, save=state.save if state else None, save_every_s=_SAVE_EVERY_S,
    )  # fmt: skip
    weights, scaler = fitted.weights, fitted.scaler
    kept = calibration(network, weights, scaler, windows.x[train_at])
    if quantize_aware:
        from plushsense.training.quantized import fine_tune

        tuned = fine_tune(train_on, network, weights, scaler, kept, config.training, quantize_aware, epoch_done)
        weights = tuned.weights
    test = scored.take(test_at)
    sizes = (len(train_at), len(division.watch), len(test_at))
    record = FoldRecord(division.fold.name, division.fold.subjects, sizes, len(fitted.history), fitted.seconds)

    def score(probabilities: NDArray[np.float32]) -> tuple[NDArray[np.int64], dict[str, Any], dict[str, Any]]:
        predictions = gather_predictions(scored, [(division.fold.name, test_at)], [probabilities])
        found = score_predictions(predictions, [record], scored.affects, division.split.apart)
        return predictions.predicted, {name: found[name]["mean"] for name in ("accuracy", "macro_f1")}, found["nobody"]

    predicted, means, nobody = score(predict(network, weights, scaler, test, config.training.device))
    scores: dict[str, Any] = {
        "split": division.kind,
        "leaky": division.split.leaky,
        "said": division.description,
        "windows": len(test_at),
        **means,
        "nobody": nobody,
        "best_epoch": fitted.best_epoch,
        "simulated": dataset.head.simulated,
        "int8": None,
    }
    if kept:
        integer = quantize(network, weights, scaler, Ranges.from_dict(kept))
        deployed, means, _ = score(integer_probabilities(integer, test.x))
        agreement = float((deployed == predicted).mean())
        scores["int8"] = {**means, "agreement": agreement}
        if agreement < _AGREEMENT:
            advice = "more epochs of --quantize-aware" if quantize_aware else "--quantize-aware 10"
            changed = 100 * (1 - agreement)
            sentence = f"8 bits change {changed:.1f} % of the answers on the validation windows: try {advice}"
            warn(Sentence(sentence, "bits_change", percent=changed))
    bundle = Bundle(
        arch=network,
        weights=weights,
        layout=dataset.layout,
        scaler=scaler,
        gestures=gestures,
        windowing=_windowing(config),
        decision=config.live.to_dict(),
        provenance={
            "dataset": dataset.head.name,
            "dataset_hash": dataset.hash,
            "simulated": dataset.head.simulated,
            "subjects": sorted({str(s) for s in windows.subject[train_at]}),
            "validation_subjects": sorted({str(s) for s in scored.subject[division.watch]}),
            "split": division.kind,
            "context": dict(sorted(Counter(windows.context.tolist()).items())),
            "preset": config.preset,
            "training": config.training.to_dict(),
            "quantize_aware": quantize_aware,
            "scores": scores,
            "code_version": __version__,
        },
        calibration=kept,
    )
    if fit_decisions:
        bundle = _with_decisions(bundle, dataset, config.live, warn)
    if state:
        state.discard()
    # `forget` cannot find an unsaved bundle: raise an error if a person was removed during the training.
    dataset.generation.check()
    history = with_accuracy(fitted.history, apart)
    seconds = fitted.seconds + (state.before_s if state else 0.0)
    return Trained(bundle, history, scores, seconds, dataset.generation)


def _reporting(progress: EpochProgress | None, apart: bool, **more: str) -> EpochProgress:
    """Return a callback for the epochs of a training, which adds ``accuracy`` and ``more`` to their rows."""

    def report(epoch: int, epochs: int, row: dict[str, Any]) -> None:
        if progress is not None:
            progress(epoch, epochs, with_accuracy([row], apart)[0] | more)

    return report


def _with_decisions(bundle: Bundle, dataset: Dataset, given: DecideSpec, warn: Warn) -> Bundle:
    """Return the bundle with decision settings fitted on its validation people; unchanged if it has none."""
    if bundle.provenance["split"] != WHOLE_PEOPLE:
        sentence = "decision settings are the defaults: fitting them needs whole people held out for validation"
        warn(Sentence(sentence, "no_decisions"))
        return bundle
    validated, trained = (
        set(bundle.provenance[key]) - {NOBODY, UNKNOWN_SUBJECT} for key in ("validation_subjects", "subjects")
    )
    plain = DecideSpec()
    keep = {f.name for f in fields(DecideSpec) if getattr(given, f.name) != getattr(plain, f.name)}
    decided = fit_on_people(bundle, dataset, validated, training=trained, spec=given, keep=keep)
    return replace(bundle, decision=decided.to_dict())


def _windowing(config: RunConfig) -> dict[str, Any]:
    """Return the window settings as a bundle stores them."""
    tables = config.to_dict()
    anywhere = {"anywhere": tables["anywhere"]} if config.windows.context == ANYWHERE else {}
    return {**tables["windows"], **anywhere}


def evaluate(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str | None = None,
    arch: str | None = None,
    filters: Sequence[int] | str | None = None,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    cluster: str | None = None,
    int8: bool = False,
    training_people: int | None = None,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = silent,
    **settings: Any,
) -> Evaluation:
    """Train and score one network for each fold of ``split``.

    Finished folds are stored in the data set's ``cache`` folder, so that an interrupted evaluation can be resumed.

    Args:
        config, arch, filters, settings, warn: as for `train`; also ``train_context`` and ``workers``.
        split: "leave-one-subject-out" (default), "by-subject:5", "by-recording:5", "windows:5" (leaky).
        out: a folder for ``evaluation.json`` and ``predictions.parquet``. A folder with an evaluation of other settings
            or data is refused unless ``overwrite``.
        cluster: address of a Ray cluster that trains the folds.
        int8: also score each fold's network in 8 bits on the same windows, as ``int8`` of the result. Folds that were
            stored without it are trained again.
        training_people: train each fold on so many of its people only, for a learning curve; not with ``out``.
    """
    given = config or from_settings(arch=arch, filters=filters, **settings)
    dataset, config = network_inputs_of(as_dataset(dataset), given)
    if split is not None:
        config = replace(config, evaluation=replace(config.evaluation, split=split))
    parse_split(config.evaluation.split)
    if out is not None:
        check_place(Path(out), config, dataset, replace=overwrite)
    gestures = classes_for(dataset, config.evaluation.classes, config.trained_on.context, warn)
    network = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    if int8:
        refuse_undeployable(network)
    warn_of_files_twice(dataset, gestures, warn)
    score = fit_on = windows_for(dataset, network, config.scored_on, gestures, warn)
    if parse_split(config.evaluation.split).apart:
        warn_of_single_people(score, warn)
    if config.trained_on != config.scored_on:
        fit_on = windows_for(dataset, network, config.trained_on, gestures, anywhere=config.anywhere)
    from plushsense.training.fit import resolve_device

    result = crossvalidate(
        fit_on,
        score,
        config.evaluation.split,
        TrainAndPredict(network, config.training, int8, training_people),
        journal=journal_of(dataset, "folds"),
        key={
            "arch": network.to_dict(),
            "training": resolve_device(config.training).key(),
            "vectors": fit_on.vectors,
            **({"int8": QUANTIZE_VERSION} if int8 else {}),
            **({"people": training_people} if training_people is not None else {}),
        },
        workers=config.evaluation.processes,
        cluster=cluster,
        seed=config.evaluation.seed,
        validation=config.holds_back,
        progress=progress,
    )
    warn_of_copies(result.table["leakage"], warn)
    if out is not None:
        with dataset.generation.writing():
            save_evaluation(result, dataset, config, network, Path(out))
    return result


def validation_predictions(bundle: Bundle, dataset: Dataset | str | os.PathLike[str]) -> Predictions:
    """Compute what a trained network answers on the recordings of its validation people, as `train` scored it.

    Recordings at rest are left out: which of them were held out is not stored.

    Raises:
        DatasetError: if the bundle has no validation people, the data set was changed since the training (reason
            ``data_changed``), or has none of their recordings.
    """
    dataset = as_dataset(dataset)
    people = known_people(bundle.provenance, ["validation_subjects"])
    if bundle.provenance.get("split") != WHOLE_PEOPLE or not people:
        raise DatasetError("This network has no validation people: evaluate it instead.", reason="no_validation_people")
    if bundle.provenance.get("dataset_hash") != dataset.hash:
        raise DatasetError(
            f"The data set '{dataset.head.name}' was changed since this network was trained: evaluate it instead.",
            reason="data_changed",
            name=dataset.head.name,
        )
    dataset = dataset.with_inputs(bundle.layout).with_gestures(bundle.gestures)
    # All recordings are cut, because how long a gesture usually is depends on them.
    every = windows_for(dataset, bundle.arch, whole_gestures(bundle.windowing), bundle.gestures)
    windows = every.take(np.flatnonzero(np.isin(every.subject, list(people))))
    network = bundle.network()
    parts = [windows.x[at : at + _BATCH] for at in range(0, len(windows), _BATCH)]
    logits = np.concatenate([network.forward(bundle.scaler.apply(part)) for part in parts])
    return gather_predictions(windows, [("validation", np.arange(len(windows)))], [softmax(logits).astype(np.float32)])


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
    progress: Callable[[str, int, int], None] | None = None,
) -> dict[str, Any]:
    """Write recordings of virtual people in the format of the paper's recorder, by default as many as in the paper.

    Args:
        out: a new or empty folder.
        dataset: a folder in which to import the recordings as a data set; default: none.
        progress: called with ("recording" or "importing", done, total).
    """
    from plushsense.recording.simulate import simulate as run

    report = progress or (lambda *_: None)
    done = run(
        Path(out),
        people=people,
        repetitions=repetitions,
        seed=seed,
        progress=lambda at, total, _: report("recording", at, total),
    )
    summary: dict[str, Any] = asdict(done)
    if dataset is not None:
        import_simulation(out, dataset, report)
        summary["dataset"] = str(dataset)
    return summary


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
    ).dataset
