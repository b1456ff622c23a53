"""Adapt the last layer of a bundle to one person, from about a minute of that person's gestures.

The convolution layers stay as they were trained. The dense layer is fitted again on their features (means over time) of
the person's recordings: a logistic regression with a penalty of ``strength`` times the squared distance from the
trained weights (the maximum a posteriori under a Gaussian prior around them). All gestures have the same weight, and so
have all recordings of a gesture.

The rows of gestures without recordings are not changed. The others are separated from each other and then shifted by
one number, so that the logarithm of their summed exponentials stays the same on average over the person's recordings.
Without that shift, gestures that were not recorded would be taken for recorded ones, and the decision settings would no
longer fit the logits.

The strength, and whether to adapt at all, are chosen on the person's own recordings, each predicted by a layer that was
fitted without it. The bundle stays as it is unless more of them are then predicted correctly and their log loss clearly
falls, and where they cannot be separated (because of wrong labels, for example). Only NumPy is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax

Floats = NDArray[np.float64]
Index = NDArray[np.int64]

_DENSE = ("dense.weight", "dense.bias")
_LEAST_PROBABILITY = 1e-9
_ITERATIONS = 320  # of the weakest pull: 1e-4 of a logit from the optimum on makeability


@dataclass(frozen=True)
class PersonalSpec:
    """Settings of the adaptation of a bundle.

    Attributes:
        strengths: penalties to choose from, in units of one
            gesture: at 1, moving a weight by 1 costs half as much as a log loss of 1 on all recordings of a gesture.
        least: a gesture with fewer recordings is left out; one is left out of two to choose the strength.
        margin: by how many standard errors the log loss must fall for the bundle to be adapted.
        separation: how far from guessing among the recorded gestures (0) to all right (1) the adapted layer must read
            recordings that it was moved without.
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
    """N windows of one person: ``features`` (N, F), ``y`` (N,) class index, ``recording`` (N,) any number of each."""

    features: Floats
    y: Index
    recording: Index

    def take(self, index: NDArray[Any]) -> Examples:
        """Return the windows at ``index``."""
        return Examples(self.features[index], self.y[index], self.recording[index])


@dataclass(frozen=True)
class RecordingScores:
    """Scores of recordings; the probabilities of a recording are the mean over its windows."""

    recordings: int
    right: int
    log_loss: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "recordings": self.recordings,
            "right": self.right,
            "accuracy": self.right / self.recordings if self.recordings else None,
            "log_loss": self.log_loss if self.recordings else None,
        }


@dataclass(frozen=True, eq=False)
class Personal:
    """Result of an adaptation: ``bundle`` is the adapted one, or the given one when ``accepted`` is false.

    ``before`` and ``after`` are of the person's own recordings, each read by a layer moved without it (``after`` at the
    strength that did best among them, which flatters a little); ``reason`` says in words why it was done or refused;
    ``used`` and ``without`` are the labels of gestures that took part and that did not.
    """

    bundle: Bundle
    accepted: bool
    reason: str
    strength: float
    before: RecordingScores
    after: RecordingScores
    used: tuple[str, ...]
    without: tuple[str, ...]


def personalise(
    bundle: Bundle,
    x: NDArray[np.integer[Any]],
    y: Index,
    recording: Index,
    *,
    subject: str,
    spec: PersonalSpec | None = None,
) -> Personal:
    """Adapt a bundle to one person, or return it unchanged where that does not help.

    Args:
        bundle: one that was adapted before is adapted anew, from what it was trained as.
        x: raw windows (N, C, T) of the person, as `windows.cut` gives them.
        y: (N,) class index of each, in the bundle's gestures.
        recording: (N,) which recording each window belongs to.
        subject: the person's code, which the bundle keeps; it keeps nothing else of them but the moved weights.

    Raises:
        BadInput: when fewer than two gestures, or than half of the bundle's, have ``spec.least`` recordings.
    """
    spec = spec or PersonalSpec()
    original = restore_original(bundle) if bundle.personal else bundle
    examples = Examples(original.network().features(original.scaler.apply(x)), y, recording)
    weight, bias = (np.asarray(original.weights[name], dtype=np.float64) for name in _DENSE)
    enough = [k for k in np.unique(y) if len(np.unique(recording[y == k])) >= spec.least]
    used_examples = examples.take(np.isin(y, enough))
    labels = original.gestures.labels
    used = tuple(labels[k] for k in np.unique(used_examples.y))
    # With fewer recorded gestures, the others suffer: on makeability up to 5 of 10 cost nobody more than one recording.
    needed = max(2, -(-len(labels) // 2))
    if len(used) < needed:
        missing = ", ".join(label for label in labels if label not in used)
        raise BadInput(
            f"The recordings of {subject} are too few to adapt to: {needed} of the bundle's {len(labels)} gestures "
            f"with {spec.least} recordings each are needed, better all; there are {len(used)}. Record more of: "
            f"{missing}."
        )
    own = judge(softmax(used_examples.features @ weight.T + bias), used_examples.y, used_examples.recording)
    tried = [(s, _left_out(weight, bias, used_examples, s)) for s in spec.strengths]
    strength, adapted_scores = min(tried, key=lambda each: float(each[1].losses.mean()))
    fell = own.losses - adapted_scores.losses
    least = spec.margin * float(fell.std(ddof=1)) / np.sqrt(len(fell))
    before, after = own.judged, adapted_scores.judged
    figures = (
        f"of {before.recordings} own recordings, each left out once, {after.right} instead of {before.right} are "
        f"read right, log loss {after.log_loss:.3f} instead of {before.log_loss:.3f}"
    )
    without = tuple(label for label in labels if label not in used)
    guess = 1.0 / len(used)
    if after.right < (guess + (1.0 - guess) * spec.separation) * after.recordings:
        reason = f"the recordings cannot be told apart, so their labels or the sensors may be wrong: {figures}"
        return Personal(bundle, False, reason, strength, before, after, used, without)
    if fell.mean() <= least or after.right <= before.right:
        reason = f"it would not clearly help: {figures}"
        return Personal(bundle, False, reason, strength, before, after, used, without)
    dense = dict(zip(_DENSE, fit_dense(weight, bias, used_examples, strength), strict=True))
    table = {
        "subject": subject,
        "recordings": before.recordings,
        "gestures": list(used),
        "strength": strength,
        "leave_one_recording_out": {"before": before.to_dict(), "after": after.to_dict()},
        "original": {name: np.asarray(original.weights[name]).tolist() for name in _DENSE},
    }
    weights = {**original.weights, **{name: part.astype(np.float32) for name, part in dense.items()}}
    adapted = replace(original, weights=weights, personal=table)
    return Personal(adapted, True, figures, strength, before, after, used, without)


@dataclass(frozen=True, eq=False)
class _Read:
    judged: RecordingScores
    losses: Floats


def judge(probabilities: NDArray[np.floating[Any]], y: Index, recording: Index) -> _Read:
    """Score recordings by the probabilities (N, K) of their windows: counts, and the log loss of each recording."""
    ids, first, place = np.unique(recording, return_index=True, return_inverse=True)
    mean = np.zeros((len(ids), probabilities.shape[1]))
    np.add.at(mean, place, probabilities)
    mean /= np.bincount(place)[:, None]
    truth = y[first]
    losses = -np.log(np.maximum(mean[np.arange(len(ids)), truth], _LEAST_PROBABILITY))
    right = int((mean.argmax(axis=1) == truth).sum())
    return _Read(RecordingScores(len(ids), right, float(losses.mean())), losses)


def fit_dense(weight: Floats, bias: Floats, examples: Examples, strength: float) -> tuple[Floats, Floats]:
    """Return the dense layer (K, F), (K,) moved towards the examples."""
    start, moved = _solved(weight, bias, examples, _weights(examples)[None], strength)
    start[np.unique(examples.y)] = moved[0]
    return start[:, :-1], start[:, -1]


def _left_out(weight: Floats, bias: Floats, examples: Examples, strength: float) -> _Read:
    """Score every recording by a layer that was fitted without it."""
    ids, place = np.unique(examples.recording, return_inverse=True)
    weights = np.stack([_weights(examples, without=i) for i in ids])
    start, moved = _solved(weight, bias, examples, weights, strength)
    layers = np.repeat(start[None], len(ids), axis=0)
    layers[:, np.unique(examples.y)] = moved
    logits = np.einsum("nd,nkd->nk", _with_one(examples.features), layers[place])
    return judge(softmax(logits), examples.y, examples.recording)


def _weights(examples: Examples, without: int | None = None) -> Floats:
    """Return the weight of each window: 1 for all of a gesture together, its recordings alike; one left out 0."""
    weights = np.zeros(len(examples.y))
    for k in np.unique(examples.y):
        recordings = [r for r in np.unique(examples.recording[examples.y == k]) if r != without]
        for r in recordings:
            at = examples.recording == r
            weights[at] = 1.0 / (len(recordings) * at.sum())
    return weights


def _with_one(features: Floats) -> Floats:
    return np.concatenate([features, np.ones((len(features), 1))], axis=1)


def _solved(
    weight: Floats, bias: Floats, examples: Examples, weights: Floats, strength: float
) -> tuple[Floats, Floats]:
    """Return the trained layer (K, F + 1), and the moved rows of the example classes (J, S, F + 1) for J
    ``weights`` (J, N).

    Steps under a fixed bound of the curvature (Böhning 1992: half of the features' second moment), with Nesterov's
    momentum, begun anew wherever it points uphill.
    """
    start = np.concatenate([weight, bias[:, None]], axis=1)
    present, y = np.unique(examples.y, return_inverse=True)
    x, truth = _with_one(examples.features), np.eye(len(present))[y]
    bound = 0.5 * np.einsum("jn,nd,ne->jde", weights, x, x, optimize=True) + strength * np.eye(x.shape[1])
    inverse = np.linalg.inv(bound)
    here = ahead = np.repeat(start[present][None], len(weights), axis=0)
    pace = np.ones((len(weights), 1, 1))
    for _ in range(_ITERATIONS):
        wrong = (softmax(x @ ahead.transpose(0, 2, 1)) - truth) * weights[:, :, None]
        slope = wrong.transpose(0, 2, 1) @ x + strength * (ahead - start[present])
        there = ahead - slope @ inverse
        step = there - here
        pace[(slope * step).sum(axis=(1, 2)) > 0] = 1.0
        faster = (1.0 + np.sqrt(1.0 + 4.0 * pace * pace)) / 2.0
        here, ahead, pace = there, there + (pace - 1.0) / faster * step, faster
        if float(np.abs(step).max()) < 1e-7:
            break
    spoke = _together(x @ start[present].T) - _together(x @ here.transpose(0, 2, 1))
    here[:, :, -1] += ((weights * spoke).sum(axis=1) / weights.sum(axis=1))[:, None]
    return start, here


def _together(logits: Floats) -> Floats:
    """Return the logarithm of the summed exponentials over the last axis."""
    top = logits.max(axis=-1, keepdims=True)
    return np.asarray(np.log(np.exp(logits - top).sum(axis=-1)) + top[..., 0])


def restore_original(bundle: Bundle) -> Bundle:
    """Return the bundle as it was before it was adapted, byte for byte.

    Raises:
        BundleError: for a bundle that was not adapted, or no longer holds what it was.
    """
    if not bundle.personal:
        raise BundleError("The bundle was not adapted to anybody: there is nothing to undo.")
    before = bundle.personal.get("original")
    try:
        dense = {name: np.array(before[name], dtype=np.float32) for name in _DENSE}  # type: ignore[index]
    except (TypeError, KeyError, ValueError):
        raise BundleError(
            "The bundle does not hold what it was before it was adapted (an export leaves that out): give the bundle "
            "that plushsense adapt wrote."
        ) from None
    return replace(bundle, weights={**bundle.weights, **dense}, personal={})


def without_subject(personal: Mapping[str, Any]) -> dict[str, Any]:
    """Return a bundle's ``personal`` for an export: that it was adapted and how well that did, not to whom."""
    return {key: value for key, value in personal.items() if key not in ("subject", "original")}
