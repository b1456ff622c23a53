"""Adapt the last layer of a bundle to one person, with about a minute of that person's gestures.

The convolution layers do not change. The dense layer is fitted again on their features (means over time) of the
person's recordings: a logistic regression with a penalty of ``strength`` times the squared distance from the trained
weights (maximum a posteriori under a Gaussian prior around them). All gestures have the same weight, and so have all
recordings of a gesture.

The rows of gestures without recordings are not changed. The other rows are fitted among themselves; then one number is
added to their biases, so that the log-sum-exp of their logits stays the same on average over the person's recordings.
Otherwise gestures without recordings would be taken for recorded ones, and the decision settings would no longer fit
the logits.

The strength, and whether to adapt at all, are decided by leave-one-out cross-validation on the person's recordings. The
bundle is adapted only if more of them are predicted correctly, their log loss clearly falls, and they can be separated
(not with wrong labels, for example). Only NumPy is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError
from plushsense.models.bundle import Bundle
from plushsense.models.reference import DENSE, softmax

Floats = NDArray[np.float64]
Index = NDArray[np.int64]

_LEAST_PROBABILITY = 1e-9
_ITERATIONS = 320  # logits are then within 1e-4 of the optimum on makeability, with the smallest strength


@dataclass(frozen=True)
class PersonalSpec:
    """Settings of the adaptation of a bundle.

    Attributes:
        strengths: penalties to choose from. At 1, a change of a weight by 1 costs half as much as a log loss of 1 on
            all recordings of a gesture.
        least: fewest recordings of a gesture to use it; at least 2, as cross-validation leaves one out.
        margin: number of standard errors by which the log loss must fall.
        separation: cross-validated accuracy that is needed, from that of guessing among the recorded gestures (0) to
            all correct (1).
    """

    strengths: tuple[float, ...] = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
    least: int = 2
    margin: float = 1.0
    separation: float = 0.5

    def __post_init__(self) -> None:
        if not self.strengths or not all(0.01 <= s <= 1e6 for s in self.strengths):
            raise ConfigError(f"The strengths are {self.strengths}: give one or more from 0.01 to 1e6.")
        if self.least < 2:
            raise ConfigError(f"least is {self.least}: accepted are 2 and more recordings of a gesture.")
        if not 0.0 <= self.margin <= 100.0:
            raise ConfigError(f"margin is {self.margin}: accepted are 0 to 100 standard errors.")
        if not 0.0 <= self.separation < 1.0:
            raise ConfigError(f"separation is {self.separation}: accepted are 0 to below 1.")


@dataclass(frozen=True, eq=False)
class Examples:
    """N windows of one person: ``features`` (N, F), class indices ``y`` (N,), ids of their ``recording`` (N,)."""

    features: Floats
    y: Index
    recording: Index

    def take(self, index: NDArray[Any]) -> Examples:
        """Return the windows at ``index``."""
        return Examples(self.features[index], self.y[index], self.recording[index])


@dataclass(frozen=True)
class RecordingScores:
    """Scores over recordings; the probabilities of a recording are the mean over its windows."""

    recordings: int
    right: int
    log_loss: float

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "recordings": self.recordings,
            "right": self.right,
            "accuracy": self.right / self.recordings if self.recordings else None,
            "log_loss": self.log_loss if self.recordings else None,
        }


@dataclass(frozen=True, eq=False)
class Personal:
    """Result of an adaptation: ``bundle`` is the adapted one, or the given one if ``accepted`` is false.

    ``before`` and ``after`` are scores on the person's recordings; ``after`` is cross-validated, with the best of the
    strengths, and therefore slightly optimistic. ``reason`` explains the decision as text. ``used`` and ``without`` are
    the labels of gestures that were and were not used. ``refusal`` is "" if it is accepted, else "inseparable" or
    "no_gain".
    """

    bundle: Bundle
    accepted: bool
    reason: str
    strength: float
    before: RecordingScores
    after: RecordingScores
    used: tuple[str, ...]
    without: tuple[str, ...]
    refusal: str = ""


def personalise(
    bundle: Bundle,
    x: NDArray[np.integer[Any]],
    y: Index,
    recording: Index,
    *,
    subject: str,
    spec: PersonalSpec | None = None,
) -> Personal:
    """Adapt a bundle to one person, or return it unchanged if that does not help.

    Args:
        bundle: an adapted bundle is first restored to its original weights.
        x: windows (N, C, T) of the person, `WindowSet.integers`.
        y: (N,) class index of each, in the bundle's gestures.
        recording: (N,) id of the recording of each window.
        subject: the person's code, which is stored in the bundle, as are the weights but no recordings.

    Raises:
        BadInput: when fewer than two gestures, or than half of the bundle's, have ``spec.least`` recordings.
    """
    spec = spec or PersonalSpec()
    original = restore_original(bundle) if bundle.personal else bundle
    examples = Examples(original.network().features(original.scaler.apply(x)), y, recording)
    weight, bias = (np.asarray(original.weights[name], dtype=np.float64) for name in DENSE)
    recorded = [k for k in np.unique(y) if len(np.unique(recording[y == k])) >= spec.least]
    used_examples = examples.take(np.isin(y, recorded))
    labels = original.gestures.labels
    used = tuple(labels[k] for k in np.unique(used_examples.y))
    _require_gestures(used, labels, subject, spec)
    own = judge(softmax(used_examples.features @ weight.T + bias), used_examples.y, used_examples.recording)
    tried = [(s, _cross_validate(weight, bias, used_examples, s)) for s in spec.strengths]
    strength, adapted_scores = min(tried, key=lambda each: float(each[1].losses.mean()))
    fell = own.losses - adapted_scores.losses
    needed_fall = spec.margin * float(fell.std(ddof=1)) / np.sqrt(len(fell))
    before, after = own.scores, adapted_scores.scores
    figures = (
        f"of {before.recordings} own recordings, each left out once, {after.right} instead of {before.right} are "
        f"read right, log loss {after.log_loss:.3f} instead of {before.log_loss:.3f}"
    )
    without = tuple(label for label in labels if label not in used)
    guess = 1.0 / len(used)
    if after.right < (guess + (1.0 - guess) * spec.separation) * after.recordings:
        reason = f"the recordings cannot be told apart, so their labels or the sensors may be wrong: {figures}"
        return Personal(bundle, False, reason, strength, before, after, used, without, "inseparable")
    if fell.mean() <= needed_fall or after.right <= before.right:
        reason = f"it would not clearly help: {figures}"
        return Personal(bundle, False, reason, strength, before, after, used, without, "no_gain")
    dense = dict(zip(DENSE, fit_dense(weight, bias, used_examples, strength), strict=True))
    table = {
        "subject": subject,
        "recordings": before.recordings,
        "gestures": list(used),
        "strength": strength,
        "leave_one_recording_out": {"before": before.to_dict(), "after": after.to_dict()},
        "original": {name: np.asarray(original.weights[name]).tolist() for name in DENSE},
    }
    weights = {**original.weights, **{name: part.astype(np.float32) for name, part in dense.items()}}
    adapted = replace(original, weights=weights, personal=table)
    return Personal(adapted, True, figures, strength, before, after, used, without)


def _require_gestures(used: Sequence[str], labels: Sequence[str], subject: str, spec: PersonalSpec) -> None:
    """Raise `BadInput` if fewer than two gestures, or than half of the ``labels``, are ``used``."""
    # Fewer gestures make the others worse: on makeability, up to 5 of 10 cost nobody more than one recording.
    needed = max(2, -(-len(labels) // 2))
    if len(used) < needed:
        raise BadInput(
            "The recordings of {subject} are too few to adapt to: {needed} of the bundle's {gestures} gestures with "
            "{least} recordings each are needed, better all; there are {used}. Record more of: {missing}.",
            subject=subject,
            needed=needed,
            gestures=len(labels),
            least=spec.least,
            used=len(used),
            missing=[label for label in labels if label not in used],
        )


@dataclass(frozen=True, eq=False)
class _Judged:
    """Scores over all recordings, and the log loss of each, (R,)."""

    scores: RecordingScores
    losses: Floats


def judge(probabilities: NDArray[np.floating[Any]], y: Index, recording: Index) -> _Judged:
    """Score recordings by the mean of the probabilities (N, K) of their windows."""
    ids, first, place = np.unique(recording, return_index=True, return_inverse=True)
    mean = np.zeros((len(ids), probabilities.shape[1]))
    np.add.at(mean, place, probabilities)
    mean /= np.bincount(place)[:, None]
    truth = y[first]
    losses = -np.log(np.maximum(mean[np.arange(len(ids)), truth], _LEAST_PROBABILITY))
    right = int((mean.argmax(axis=1) == truth).sum())
    return _Judged(RecordingScores(len(ids), right, float(losses.mean())), losses)


def fit_dense(weight: Floats, bias: Floats, examples: Examples, strength: float) -> tuple[Floats, Floats]:
    """Fit the dense layer to the examples and return its weights (K, F) and biases (K,)."""
    start, moved = _fit_rows(weight, bias, examples, _weights(examples)[None], strength)
    start[np.unique(examples.y)] = moved[0]
    return start[:, :-1], start[:, -1]


def _cross_validate(weight: Floats, bias: Floats, examples: Examples, strength: float) -> _Judged:
    """Score each recording with a layer that was fitted without it (leave-one-out cross-validation)."""
    ids, place = np.unique(examples.recording, return_inverse=True)
    weights = np.stack([_weights(examples, without=i) for i in ids])
    start, moved = _fit_rows(weight, bias, examples, weights, strength)
    layers = np.repeat(start[None], len(ids), axis=0)
    layers[:, np.unique(examples.y)] = moved
    logits = np.einsum("nd,nkd->nk", with_one(examples.features), layers[place])
    return judge(softmax(logits), examples.y, examples.recording)


def _weights(examples: Examples, without: int | None = None) -> Floats:
    """Return weights of windows that sum to 1 for each gesture, divided equally by recordings; 0 for ``without``."""
    weights = np.zeros(len(examples.y))
    for k in np.unique(examples.y):
        recordings = [r for r in np.unique(examples.recording[examples.y == k]) if r != without]
        for r in recordings:
            at = examples.recording == r
            weights[at] = 1.0 / (len(recordings) * at.sum())
    return weights


def with_one(features: Floats) -> Floats:
    """Return features (N, F) with a column of ones for the bias, (N, F + 1)."""
    return np.concatenate([features, np.ones((len(features), 1))], axis=1)


def _fit_rows(
    weight: Floats, bias: Floats, examples: Examples, weights: Floats, strength: float
) -> tuple[Floats, Floats]:
    """Return the trained layer (K, F + 1), and the S fitted rows of the classes in the examples, (J, S, F + 1).

    Fits one layer for each of the J ``weights`` (J, N), by steps with a fixed upper bound of the Hessian (Böhning 1992:
    half of the features' second moment) and Nesterov momentum, which is restarted if it points uphill.
    """
    start = np.concatenate([weight, bias[:, None]], axis=1)
    present, y = np.unique(examples.y, return_inverse=True)
    x, truth = with_one(examples.features), np.eye(len(present))[y]
    bound = 0.5 * np.einsum("jn,nd,ne->jde", weights, x, x, optimize=True) + strength * np.eye(x.shape[1])
    inverse = np.linalg.inv(bound)
    rows = ahead = np.repeat(start[present][None], len(weights), axis=0)
    momentum = np.ones((len(weights), 1, 1))
    for _ in range(_ITERATIONS):
        errors = (softmax(x @ ahead.transpose(0, 2, 1)) - truth) * weights[:, :, None]
        gradient = errors.transpose(0, 2, 1) @ x + strength * (ahead - start[present])
        updated = ahead - gradient @ inverse
        step = updated - rows
        momentum[(gradient * step).sum(axis=(1, 2)) > 0] = 1.0
        next_momentum = (1.0 + np.sqrt(1.0 + 4.0 * momentum * momentum)) / 2.0
        rows, ahead, momentum = updated, updated + (momentum - 1.0) / next_momentum * step, next_momentum
        if float(np.abs(step).max()) < 1e-7:
            break
    drift = _log_sum_exp(x @ start[present].T) - _log_sum_exp(x @ rows.transpose(0, 2, 1))
    rows[:, :, -1] += ((weights * drift).sum(axis=1) / weights.sum(axis=1))[:, None]
    return start, rows


def _log_sum_exp(logits: Floats) -> Floats:
    """Compute the logarithm of the summed exponentials over the last axis."""
    top = logits.max(axis=-1, keepdims=True)
    return np.asarray(np.log(np.exp(logits - top).sum(axis=-1)) + top[..., 0])


def restore_original(bundle: Bundle) -> Bundle:
    """Undo an adaptation: return the bundle with exactly its original weights.

    Raises:
        BundleError: for a bundle that was not adapted, or does not hold its original weights.
    """
    if not bundle.personal:
        raise BundleError("The bundle was not adapted to anybody: there is nothing to undo.")
    before = bundle.personal.get("original")
    try:
        dense = {name: np.array(before[name], dtype=np.float32) for name in DENSE}  # type: ignore[index]
    except (TypeError, KeyError, ValueError):
        raise BundleError(
            "The bundle does not hold what it was before it was adapted (an export leaves that out): give the bundle "
            "that plushsense adapt wrote."
        ) from None
    return replace(bundle, weights={**bundle.weights, **dense}, personal={})
