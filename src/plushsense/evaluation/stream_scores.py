"""Finished folds of the continuous benchmark as one table: curves over everybody, and systems at equal recall."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.evaluation.heard import StreamScore
from plushsense.evaluation.systems import REFERENCE, SYSTEMS
from plushsense.scoring.events import at_recall
from plushsense.scoring.metrics import BOOTSTRAP_SEED, summary

HITS, TRUTHS, FALSE, HOURS = range(4)
RECALLS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9)
_RESAMPLES = 500
LATENCY_SHARES = tuple(n / 20 for n in range(21))

Folds = Sequence[Mapping[str, Any]]


def summed(folds: Folds) -> dict[str, Any]:
    """The benchmark's table, ready for JSON.

    ``systems``: of each the ``curve`` (a point a target: recall and false events an hour over all people left out),
    ``balanced`` and ``cheapest`` (the setting of the highest F1, and of the lowest cost, on those who tune) with all
    figures, ``plain`` where there is one, ``people``; ``at_recall``: false events an hour of every system at the same
    recall, and the ratio to smoothed argmax with a 95 % bootstrap interval over people.
    """
    names = [n for n in SYSTEMS if all(n in fold["systems"] for fold in folds)]
    counts = {n: _counts(folds, n) for n in names}
    systems = {}
    for n in names:
        parts: dict[str, Any] = {"title": SYSTEMS[n].title, "curve": _curve(folds, n, counts[n])}
        for how in ("plain", "balanced", "cheapest"):
            if all(how in fold["systems"][n] for fold in folds):
                parts[how] = _outcome(folds, n, how)
        systems[n] = parts
    return {
        "systems": systems,
        "reference": REFERENCE if REFERENCE in names else None,
        "at_recall": _at_recall(counts) if REFERENCE in names else [],
        "folds": [
            {k: v for k, v in fold.items() if k != "systems"}
            | {
                "settings": {
                    n: {how: fold["systems"][n][how]["tuned"] for how in ("balanced", "cheapest")} for n in names
                }
            }
            for fold in folds
        ],
    }


def _counts(folds: Folds, name: str) -> NDArray[np.float64]:
    """(targets, people, 4) hits, truths, insertions, hours."""
    rows = []
    for fold in folds:
        curve = fold["systems"][name]["curve"]
        rows += [[point["people"][person] for point in curve] for person in sorted(curve[0]["people"])]
    return np.array(rows, dtype=np.float64).transpose(1, 0, 2)


def _points(counts: NDArray[np.float64]) -> list[tuple[float, float]]:
    """(recall, false events an hour) of each target, over the people of (targets, people, 4)."""
    sums = counts.sum(axis=1)
    return [(float(s[HITS] / max(s[TRUTHS], 1)), float(s[FALSE] / s[HOURS])) for s in sums]


def _curve(folds: Folds, name: str, counts: NDArray[np.float64]) -> list[dict[str, Any]]:
    """The points of a curve; targets that no fold's tuning people reach are left out."""
    found = []
    targets = [point["target"] for point in folds[0]["systems"][name]["curve"]]
    reach = max(fold["systems"][name]["reach"] for fold in folds)
    for target, (recall, false) in zip(targets, _points(counts), strict=True):
        if target <= reach:
            found.append({"target": target, "recall": recall, "false_events_per_hour": false})
    return found


def _outcome(folds: Folds, name: str, how: str) -> dict[str, Any]:
    """One choice of setting over everybody, and person by person."""
    whole, people = StreamScore(), []
    for fold in folds:
        for person, kept in sorted(fold["systems"][name][how]["people"].items()):
            mine = StreamScore.from_kept(kept)
            whole.add(mine)
            said = mine.to_dict()
            people.append(
                {"subject": person, "fold": fold["name"]}
                | {k: said[k] for k in ("truths", "events", "recall", "precision", "f1", "false_events_per_hour")}
                | {"latency_s": said["latency_s"]["median"]}
            )
    latencies = {level: _shares(whole.total(level).latencies) for level in whole.levels if whole.levels[level]}
    return {
        **whole.to_dict(),
        "latency_shares": latencies,
        "f1_people": summary([p["f1"] for p in people if p["f1"] is not None]),
        "recall_people": summary([p["recall"] for p in people if p["recall"] is not None]),
        "people": sorted(people, key=lambda p: p["subject"]),
    }


def _shares(latencies: Sequence[float]) -> list[float]:
    """The latencies' quantiles at `LATENCY_SHARES`."""
    return [round(float(q), 3) for q in np.quantile(latencies, LATENCY_SHARES)] if latencies else []


def _at_recall(counts: Mapping[str, NDArray[np.float64]]) -> list[dict[str, Any]]:
    """Every system beside the reference at equal recall, straight between the points of its curve."""
    people = counts[REFERENCE].shape[1]
    drawn = np.random.default_rng(BOOTSTRAP_SEED).integers(0, people, size=(_RESAMPLES, people))
    curves = {name: _points(table) for name, table in counts.items()}
    again = {name: [_points(table[:, draw]) for draw in drawn] for name, table in counts.items()}
    found = []
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
                # Of too few resamples that reach the recall an interval would say too little.
                if len(ratios) >= 0.9 * _RESAMPLES:
                    ci = [float(q) for q in np.percentile(ratios, [2.5, 97.5])]
            row["systems"][name] = {"false_events_per_hour": false, "ratio": ratio, "ci95": ci}
        found.append(row)
    return found


def pooled_scores(scores: Mapping[str, StreamScore]) -> dict[str, Any]:
    """Several people's `StreamScore` as one table, with a row a person."""
    whole = StreamScore()
    for mine in scores.values():
        whole.add(mine)
    return {**whole.to_dict(), "people": {person: mine.to_dict() for person, mine in scores.items()}}
