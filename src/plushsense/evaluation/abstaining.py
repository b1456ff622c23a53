"""Whether a model knows when it does not know, on people left out: in streams, when each gesture has just been made.

One answer a recording, that of the last step in it: a person's steps within one are hardly more than one witness.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.dataset.store import Dataset
from plushsense.live.decide import DecideSpec
from plushsense.live.fitting import covered, known_threshold, labelled_steps, streams_heard, sure_threshold
from plushsense.live.replaying import Listener
from plushsense.models.bundle import Bundle
from plushsense.models.events import ONE
from plushsense.models.fixed import smoothing_weight
from plushsense.scoring.abstaining import RiskCoverage, auroc, confidences, risk_coverage

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ends:
    """The last answer in each of n recordings.

    ``logits`` (n, K) of that step and ``shares`` (n, K) smoothed, of the network's K classes; ``highest`` (n,) smoothed
    logit; ``label`` (n,) the gesture that was made, of the network's or not; ``person`` (n,).
    """

    logits: Floats
    shares: Floats
    highest: Floats
    label: NDArray[np.str_]
    person: NDArray[np.str_]


def ends(bundle: Bundle, dataset: Dataset, subjects: Iterable[str], spec: DecideSpec, gestures: GestureSet) -> Ends:
    """The answers at the ends of the recordings of ``gestures`` in some people's streams."""
    weight = smoothing_weight(spec.smoothing_s, bundle.arch.step * bundle.layout.period_us / 1e6)
    rows: list[tuple[NDArray[Any], NDArray[Any], Any, str, str]] = []
    for heard in streams_heard(bundle, dataset, subjects, spec, gestures):
        parts = heard.trace.parts
        smoothed = Listener(heard.trace).smoothed(weight)
        for truth in heard.truths:
            if truth.gesture < 0:
                continue
            for part, after in zip(parts, smoothed, strict=True):
                times = heard.trace.step_times_us(part)
                at = int(np.searchsorted(times, truth.stop_us, side="right")) - 1
                if at >= 0 and times[at] > truth.start_us:
                    label = gestures.labels[truth.gesture]
                    rows.append((part.logits[at], after.shares[at], after.highest[at], label, heard.person))
    k = len(bundle.gestures)
    logits = np.array([r[0] for r in rows], dtype=np.float64).reshape(len(rows), k) / 256
    return Ends(
        logits,
        np.array([r[1] for r in rows], dtype=np.int64).reshape(len(rows), k) / ONE,
        np.array([r[2] for r in rows], dtype=np.int64) / 256,
        np.array([r[3] for r in rows], dtype=np.str_),
        np.array([r[4] for r in rows], dtype=np.str_),
    )


def fold_answers(
    bundle: Bundle,
    dataset: Dataset,
    validation: Sequence[str],
    test: Sequence[str],
    *,
    coverage: float,
    known_share: float,
) -> dict[str, Any]:
    """What one fold's network answers on people left out, with thresholds of those who validated; for a journal."""
    spec = DecideSpec()
    calibration = labelled_steps(bundle, streams_heard(bundle, dataset, validation, spec), spec)
    if not len(calibration.truth):
        return {"people": [], "covered": [], "size": [], "sure": 1.0, "known": None, **_arrays(None)}
    sure, known = sure_threshold(calibration, coverage), known_threshold(calibration, known_share)
    steps = labelled_steps(bundle, streams_heard(bundle, dataset, test, spec), spec)
    people = sorted(set(steps.person.tolist()))
    each = [steps.take(steps.person == person) for person in people]
    return {
        "people": people,
        "covered": [covered(mine, sure) for mine in each],
        "size": [float((mine.shares >= sure * ONE).sum(axis=1).mean()) for mine in each],
        "sure": sure,
        "known": known,
        **_arrays(ends(bundle, dataset, test, spec, dataset.gestures)),
    }


def _arrays(found: Ends | None) -> dict[str, Any]:
    names = ("logits", "shares", "highest", "label", "person")
    return {name: np.zeros(0) if found is None else getattr(found, name) for name in names}


@dataclass(frozen=True)
class Told:
    """A fold's answers as kept: with the labels of its network, and the one that was withheld from it or ""."""

    fold: str
    withheld: str
    labels: tuple[str, ...]
    result: Mapping[str, Any]

    @property
    def scores(self) -> dict[str, Floats]:
        """Confidences of every recording, (n,) each."""
        r = self.result
        return confidences(r["logits"], r["shares"], r["highest"], float(r["sure"]))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n,) recordings of a gesture that the network was trained on."""
        return np.isin(self.result["label"], self.labels)

    @property
    def right(self) -> NDArray[np.bool_]:
        """(n,) recordings whose most likely class, smoothed, is what was made."""
        best = np.array(self.labels, dtype=np.str_)[self.result["shares"].argmax(axis=1)]
        return np.asarray(best == self.result["label"])


@dataclass(frozen=True)
class Abstaining:
    """The outcome: ``table`` as ``--json`` shows it, and the pooled ``curves`` by confidence."""

    table: dict[str, Any]
    curves: dict[str, RiskCoverage]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return self.table


def summarise(told: Sequence[Told], coverage: float, known_share: float) -> Abstaining:
    """Curves and figures of all folds together, by person and by withheld gesture."""
    whole = [t for t in told if not t.withheld and len(t.result["label"])]
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
    for label in dict.fromkeys(t.withheld for t in told if t.withheld):
        made = [t for t in told if t.withheld == label and (t.result["label"] == label).any()]
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


def _against(told: Sequence[Told], known_share: float) -> dict[str, Any]:
    """Known against unknown: AUROC by confidence over folds, and what the fitted threshold calls unknown."""
    auc: dict[str, list[float]] = {}
    passed, caught, count = [], [], 0
    for t in told:
        other = np.asarray(t.result["label"] == t.withheld) if t.withheld else ~t.known
        count += int(other.sum())
        for name, score in t.scores.items():
            auc.setdefault(name, []).append(auroc(score[t.known], score[other]))
        if t.result["known"] is not None:
            under = np.asarray(t.result["highest"] < t.result["known"])
            passed.append(float((~under[t.known]).mean()))
            caught.append(float(under[other].mean()))
    return {
        "recordings": count,
        "folds": len(told),
        "auroc": {name: _spread(values) for name, values in auc.items()},
        "known_share_stated": known_share,
        "known_passed": _spread(passed),
        "unknown_caught": _spread(caught),
    }


def _spread(values: Sequence[float]) -> dict[str, float | None]:
    """Mean and standard deviation of what is a number."""
    real = [v for v in values if np.isfinite(v)]
    return {
        "mean": float(np.mean(real)) if real else None,
        "sd": float(np.std(real, ddof=1)) if len(real) > 1 else None,
        "n": len(real),
    }
