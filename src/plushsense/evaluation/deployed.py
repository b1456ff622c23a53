"""What deploying a network costs: its float scores and its deployed ones, on the same windows, person by person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from plushsense.core.gestures import NOBODY
from plushsense.evaluation.predictions import Predictions
from plushsense.scoring import metrics

_SCORES = ("accuracy", "macro_f1")


def beside(
    before: Mapping[str, Any], after: Mapping[str, Any], predictions: Predictions, deployed: Predictions
) -> dict[str, Any]:
    """The deployed network beside the float one, as plain values.

    Args:
        before, after: the figures of both (see `plushsense.evaluation.scores.scores`).
        predictions, deployed: of the same windows, in the same order.

    Returns:
        ``accuracy`` and ``macro_f1`` of the deployed network; ``loss``, the same of what each person (or fold, as
        ``over`` says) lost, float minus int8, with the interval of its mean; ``agreement``, the share of the windows
        on which both say the same class; ``probability_difference``, the mean over the windows of the largest one;
        ``rows``, one a person or fold.
    """
    same = predictions.predicted == deployed.predicted
    people = before["over"] == "subjects"
    name, of = ("subject", predictions.subject) if people else ("fold", predictions.fold)
    rows = []
    for one, other in zip(before[before["over"]], after[after["over"]], strict=True):
        mine = of == one[name]
        row = {name: one[name], "windows": int(mine.sum())}
        for score in _SCORES:
            row |= {score: one[score], f"{score}_int8": other[score], f"{score}_loss": _less(one, other, score)}
        rows.append(row | {"agreement": float(same[mine].mean()) if mine.any() else None})
    counted = predictions.subject != NOBODY if people else np.ones(len(same), dtype=np.bool_)
    apart = np.abs(predictions.probabilities - deployed.probabilities).max(axis=1)
    return {
        **{score: after[score] for score in _SCORES},
        "loss": {score: metrics.summary([_number(row[f"{score}_loss"]) for row in rows]) for score in _SCORES},
        "over": before["over"],
        "agreement": float(same[counted].mean()) if counted.any() else None,
        "probability_difference": float(apart[counted].mean()) if counted.any() else None,
        "rows": rows,
    }


def _less(one: Mapping[str, Any], other: Mapping[str, Any], score: str) -> float | None:
    before, after = one[score], other[score]
    return None if before is None or after is None else float(before - after)


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
