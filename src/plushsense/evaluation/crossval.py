"""Cross-validate a model: train once for each fold, or load the fold from the journal, and score all predictions.

Training is passed in as a picklable callable, so that this package needs no PyTorch and folds can run in parallel. The
split is made over recordings, so that the windows to train on and those to score may have different contexts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.gestures import NOBODY
from plushsense.evaluation.confidence import ConfidenceResult, assess_confidence
from plushsense.evaluation.leakage import LeakageResult, audit_leakage
from plushsense.evaluation.scores import (
    FoldRecord,
    Metrics,
    Predictions,
    Scores,
    compute_scores,
    gather_predictions,
    with_accuracy,
    write_predictions,
)
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import JobsSpec, Report
from plushsense.jobs.progress import JobProgress
from plushsense.jobs.study import StudyPart, run_study
from plushsense.scoring import metrics
from plushsense.scoring.metrics import Summary
from plushsense.scoring.splits import Fold, Index, Split, make_folds, purge
from plushsense.training.spec import EpochProgress, EpochRow
from plushsense.windows.cut import WindowSet

SharedRows = Callable[[], Collection[tuple[str, str]]]

# Part of every job's id: raise it when the meaning of a stored fold changes.
_VERSION = 1


def fold_windows(train: WindowSet, score: WindowSet, split: Split, seed: int = 0) -> list[Fold]:
    """Return the folds of ``split`` as indices of windows: train and validation into ``train``, test into ``score``.

    Unless the split is leaky, windows that overlap a test recording in its stream are not used for training. Where
    people are on both sides, all others of recordings that are not scored, as the idle parts of streams, are.

    Raises:
        BadInput: when the two sets have different labels or inputs, or are too small for the split.
    """
    if train.labels != score.labels or train.inputs != score.inputs:
        raise BadInput("The windows to train on and those to score differ in gestures or channels: cut both alike.")
    if split.leaky:
        if train is not score and not _same(train, score):
            raise ConfigError(
                f"The split {split.text} divides windows, so it scores the very windows it drew from: "
                "cut both with the same context, or use by-recording:5."
            )
        return make_folds(split, score.subject, score.y, seed, _ids(score))
    recordings = _Recordings.of(train, score)
    of_train, of_score = recordings.place(train), recordings.place(score)
    # The idle parts of a stream count as one recording: held back, a network would learn no idleness from that stream.
    only_trained = ~np.isin(of_train, of_score) & (not split.separates_people)
    divided = []
    for fold in make_folds(split, recordings.subject, recordings.y, seed, recordings.ids):
        keep = purge(train.stream, train.window_rows, *recordings.rows(fold.test))
        windows = Fold(
            fold.name,
            fold.subjects,
            np.flatnonzero((np.isin(of_train, fold.train) | only_trained) & keep),
            np.flatnonzero(np.isin(of_train, fold.validation) & ~only_trained & keep),
            np.flatnonzero(np.isin(of_score, fold.test)),
        )
        _require_windows(windows, fold, split)
        divided.append(windows)
    return divided


def train_on_validation(folds: Sequence[Fold]) -> list[Fold]:
    """Return the folds with their validation windows among those to train on."""
    none = np.empty(0, dtype=np.int64)
    return [replace(f, train=np.sort(np.concatenate([f.train, f.validation])), validation=none) for f in folds]


@dataclass(frozen=True)
class _Recordings:
    """The recordings (R,) of both sets; ``stream_rows`` (R, 2) are −1 for a recording that lies in no stream."""

    ids: NDArray[np.str_]
    subject: NDArray[np.str_]
    y: Index
    stream: NDArray[np.str_]
    stream_rows: Index

    @classmethod
    def of(cls, *sets: WindowSet) -> _Recordings:
        ids = np.concatenate([_ids(s) for s in sets])
        subject, stream = (np.concatenate([getattr(s, name) for s in sets]) for name in ("subject", "stream"))
        y = np.concatenate([s.y for s in sets])
        rows = np.concatenate([s.recording_rows for s in sets])
        # Of all windows of a recording, take one with known rows in a stream, if there is one.
        order = np.lexsort((rows[:, 0] < 0, ids))
        unique, first = np.unique(ids[order], return_index=True)
        pick = order[first]
        return cls(unique, subject[pick], y[pick], stream[pick], rows[pick])

    def place(self, windows: WindowSet) -> Index:
        """Return the index of each window's recording, (N,)."""
        return np.searchsorted(self.ids, _ids(windows)).astype(np.int64)

    def rows(self, index: Index) -> tuple[NDArray[np.str_], Index]:
        """Return stream and rows of the recordings at ``index``, as arguments of `purge`."""
        return self.stream[index], self.stream_rows[index]


def _ids(windows: WindowSet) -> NDArray[np.str_]:
    return np.array(windows.recording_ids, dtype=np.str_)[windows.recording]


def _same(one: WindowSet, other: WindowSet) -> bool:
    return one.integers.shape == other.integers.shape and bool(
        np.array_equal(one.integers, other.integers) and np.array_equal(_ids(one), _ids(other))
    )


def _require_windows(fold: Fold, recordings: Fold, split: Split) -> None:
    for name in ("train", "test"):
        if not len(getattr(fold, name)):
            touched = ": every window that could train touches a tested recording in its stream"
            reason = touched if len(getattr(recordings, name)) else ""
            raise BadInput(
                "Split {split} leaves {fold} no windows to {name} with{reason}: use fewer folds.",
                split=split.text,
                fold=fold.name,
                name=name,
                reason=reason,
            )


@dataclass(frozen=True)
class FoldOutput:
    """The outcome of one training: probabilities (N, K) of the test windows, history, seconds and best epoch.

    ``deployed`` (N, K): probabilities of the same network in 8 bits; None where they are not computed.
    """

    probabilities: NDArray[np.float32]
    history: list[EpochRow] = field(default_factory=list)
    seconds: float = 0.0
    best_epoch: int = 0
    deployed: NDArray[np.float32] | None = None


class FitPredict(Protocol):
    """A picklable callable that trains on the first windows, validates on the second and predicts the third."""

    def __call__(
        self, train: WindowSet, validation: WindowSet, test: WindowSet, progress: EpochProgress, /
    ) -> FoldOutput:
        """Train and predict; call ``progress`` with (epoch, maximum epochs, row of the history)."""
        ...


@dataclass
class EvaluationResult:
    """The outcome of `evaluate`.

    ``leakage`` is the result of `audit_leakage`; ``int8`` compares the deployed networks with the float ones;
    ``confidence`` is None if no window is of a person; ``self_calibration`` is that of the windows; ``histories`` has
    the epochs of each fold.
    """

    split: Split
    context: str
    train_context: str
    seeds: list[int]
    scores: Scores
    leakage: LeakageResult
    self_calibration: str
    confidence: ConfidenceResult | None
    int8: DeployedResult | None
    histories: list[list[EpochRow]]
    predictions: Predictions
    predictions_path: Path | None = None

    def write_predictions(self, path: str | Path) -> Path:
        """Write all predictions to a Parquet file and set ``predictions_path``."""
        self.predictions_path = write_predictions(path, self.predictions)
        return self.predictions_path

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "split": self.split.text,
            "context": self.context,
            "train_context": self.train_context,
            "leaky": self.split.leaky,
            "seeds": self.seeds,
            **self.scores.to_json(),
            "leakage": self.leakage.to_json(),
            "confidence": None if self.confidence is None else self.confidence.to_json(),
            **({"self_calibration": self.self_calibration} if self.self_calibration else {}),
            **({"int8": self.int8.to_json()} if self.int8 is not None else {}),
            "histories": self.histories,
            "predictions": None if self.predictions_path is None else str(self.predictions_path),
        }

    def __repr__(self) -> str:
        leaky = ", leaky" if self.split.leaky else ""
        return (
            f"EvaluationResult({self.split.text}{leaky}, trained on {self.train_context}, scored on {self.context}: "
            f"accuracy {self.scores.mean('accuracy'):.3f} over {len(self.predictions)} windows)"
        )


@dataclass(frozen=True)
class CrossvalSpec:
    """Settings of a cross-validation.

    Attributes:
        seed: seed of the split.
        validation: whether to hold back windows for validation; without it they are trained on.
        jobs: folds at a time, and the journal of finished folds, which are looked up first.
        key: with a journal, everything that ``fit_predict`` depends on besides windows and folds (network, schedule,
            its seed).
    """

    seed: int = 0
    validation: bool = True
    jobs: JobsSpec = field(default_factory=JobsSpec)
    key: Mapping[str, Any] | None = None


def evaluate(
    train: WindowSet,
    score: WindowSet,
    split: Split,
    fit_predict: FitPredict,
    spec: CrossvalSpec | None = None,
    *,
    shared_rows: SharedRows = tuple,
    progress: Callable[[JobProgress], None] | None = None,
) -> EvaluationResult:
    """Train and score a model on each fold of ``split``.

    Args:
        train, score: the same recordings, possibly cut with another context; one set for both is fine.
        split: how the recordings or windows are divided (see `plushsense.scoring.splits.parse_split`).
        shared_rows: called for the argument ``shared_rows`` of `audit_leakage`.
        progress: called when a fold reports an epoch, with (epoch, epochs, row of the history) as its message, or is
            done.

    Raises:
        BadInput: for a split that cannot be made; any error that ``fit_predict`` raises.
    """
    spec = spec or CrossvalSpec()
    if spec.jobs.journal is not None and spec.key is None:
        raise ConfigError("A journal needs a key that identifies what is trained: give CrossvalSpec(key={...}).")
    folds = fold_windows(train, score, split, spec.seed)
    folds = folds if spec.validation else train_on_validation(folds)
    hashes = [windows_fingerprint(train)]
    hashes.append(hashes[0] if score is train else windows_fingerprint(score))
    return run_study(
        [StudyPart(fold.name, {"fold": fold_fingerprint(fold)}, fold) for fold in folds],
        _FoldWork(fit_predict),
        lambda study: _result(study.results, folds, (train, score), split, spec.seed, shared_rows),
        key={"version": _VERSION, "key": dict(spec.key or {}), "windows": hashes},
        shared=(train, None if score is train else score),
        spec=spec.jobs,
        progress=progress,
    )


def _result(
    outcomes: Sequence[Result],
    folds: Sequence[Fold],
    windows: tuple[WindowSet, WindowSet],
    split: Split,
    seed: int,
    shared_rows: SharedRows,
) -> EvaluationResult:
    """Score the outcomes of all folds; ``windows`` are those to train on and those that were scored."""
    train, score = windows
    records = [
        FoldRecord(
            fold.name,
            fold.subjects,
            (len(fold.train), len(fold.validation), len(fold.test)),
            int(outcome["best_epoch"]) if not outcome["history"] else len(outcome["history"]),
            float(outcome["seconds"]),
        )
        for fold, outcome in zip(folds, outcomes, strict=True)
    ]

    def scored(name: str) -> tuple[Predictions, Scores]:
        tested = [(fold.name, fold.test) for fold in folds]
        predictions = gather_predictions(score, tested, [outcome[name] for outcome in outcomes])
        return predictions, compute_scores(predictions, records, score.affects, split.separates_people)

    predictions, scores = scored("probabilities")
    int8 = deployed = None
    if all("deployed" in outcome for outcome in outcomes):
        deployed, after = scored("deployed")
        int8 = compare_deployed(scores, after, predictions, deployed)
    return EvaluationResult(
        split=split,
        context=context_of(score),
        train_context=context_of(train),
        seeds=[seed],
        scores=scores,
        leakage=audit_leakage(train, score, folds, shared_rows()),
        self_calibration=score.self_calibration,
        confidence=assess_confidence(predictions, deployed, split.separates_people),
        int8=int8,
        histories=[with_accuracy(outcome["history"], split.separates_people) for outcome in outcomes],
        predictions=predictions,
    )


@dataclass(frozen=True)
class _FoldWork:
    """The work of one fold, as a job."""

    fit_predict: FitPredict

    def __call__(self, shared: Any, task: Fold, report: Report, /) -> Result:
        train, score = shared
        score = train if score is None else score

        def progress(epoch: int, epochs: int, row: EpochRow) -> None:
            report((epoch, epochs, row))

        out = self.fit_predict(train.take(task.train), train.take(task.validation), score.take(task.test), progress)
        arrays = {"probabilities": out.probabilities}
        if out.deployed is not None:
            arrays["deployed"] = out.deployed
        expected = (len(task.test), len(score.labels))
        for name, probabilities in arrays.items():
            arrays[name] = probabilities = np.asarray(probabilities, dtype=np.float32)
            if probabilities.shape != expected:
                raise ConfigError(
                    f"fit_predict gave {name} of the shape {probabilities.shape}; {expected} (windows, classes) is "
                    "expected."
                )
        return {
            **arrays,
            "history": out.history,
            "seconds": out.seconds,
            "best_epoch": out.best_epoch,
        }


def context_of(windows: WindowSet) -> str:
    """Return the first of "anywhere", "stream", "rest", "rows", "loop" and "inside" that is the context of a window."""
    present = set(np.unique(windows.context).tolist())
    return next((kind for kind in ("anywhere", "stream", "rest", "rows", "loop") if kind in present), "inside")


def windows_fingerprint(windows: WindowSet) -> str:
    """Return a hash of the windows, for the ids of jobs that use them."""
    digest = hashlib.sha256(repr((windows.integers.shape, windows.labels, windows.recording_ids)).encode())
    for array in (windows.integers, windows.y, windows.recording):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def fold_fingerprint(fold: Fold) -> str:
    """Return a hash of the window indices of a fold."""
    digest = hashlib.sha256()
    for index in (fold.train, fold.validation, fold.test):
        digest.update(len(index).to_bytes(8, "little") + index.astype("<i8").tobytes())
    return digest.hexdigest()


@dataclass(frozen=True)
class DeployedRow:
    """The scores of a person or fold before and after deployment, by the keys of `column_metrics`.

    ``loss`` is float minus 8 bits; ``agreement`` the share of the windows with the same class.
    """

    name: str
    windows: int
    before: Metrics
    after: Metrics
    loss: Metrics
    agreement: float | None


@dataclass(frozen=True)
class DeployedResult:
    """The comparison of the deployed networks with the float ones.

    Attributes:
        over: "subjects" or "folds", as of `Scores`.
        means: summaries of the metrics in 8 bits; loss: those of the losses of the rows.
        agreement: share of the windows with the same class.
        probability_difference: mean over the windows of the largest difference of a probability.
    """

    over: str
    means: dict[str, Summary]
    loss: dict[str, Summary]
    agreement: float | None
    probability_difference: float | None
    rows: tuple[DeployedRow, ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        unit = "subject" if self.over == "subjects" else "fold"
        rows = []
        for row in self.rows:
            scores: dict[str, float | None] = {}
            for key, before in row.before.items():
                scores |= {key: before, f"{key}_int8": row.after[key], f"{key}_loss": row.loss[key]}
            rows.append({unit: row.name, "windows": row.windows, **scores, "agreement": row.agreement})
        return {
            **{key: found.to_json() for key, found in self.means.items()},
            "loss": {key: found.to_json() for key, found in self.loss.items()},
            "over": self.over,
            "agreement": self.agreement,
            "probability_difference": self.probability_difference,
            "rows": rows,
        }


def compare_deployed(before: Scores, after: Scores, predictions: Predictions, deployed: Predictions) -> DeployedResult:
    """Compare the deployed network with the float one.

    Args:
        before, after: scores of the float and the deployed network.
        predictions, deployed: of the same windows, in the same order.
    """
    same = predictions.predicted == deployed.predicted
    people, keys = before.over == "subjects", tuple(metrics.column_metrics())
    if people:
        of, units = predictions.subject, [(row.subject, row.metrics) for row in before.subjects]
        others = [row.metrics for row in after.subjects]
    else:
        of, units = predictions.fold, [(row.record.name, row.metrics) for row in before.folds]
        others = [row.metrics for row in after.folds]
    rows = []
    for (name, one), other in zip(units, others, strict=True):
        selected = of == name
        agreement = float(same[selected].mean()) if selected.any() else None
        loss = {key: _difference(one[key], other[key]) for key in keys}
        one, other = ({key: each[key] for key in keys} for each in (one, other))
        rows.append(DeployedRow(name, int(selected.sum()), one, other, loss, agreement))
    counted = predictions.subject != NOBODY if people else np.ones(len(same), dtype=np.bool_)
    differences = np.abs(predictions.probabilities - deployed.probabilities).max(axis=1)
    return DeployedResult(
        over=before.over,
        means={key: after.means[key] for key in keys},
        loss={key: metrics.summary([at for row in rows if (at := row.loss[key]) is not None]) for key in keys},
        agreement=float(same[counted].mean()) if counted.any() else None,
        probability_difference=float(differences[counted].mean()) if counted.any() else None,
        rows=tuple(rows),
    )


def _difference(before: float | None, after: float | None) -> float | None:
    return None if before is None or after is None else float(before - after)
