"""Propose merges of gestures that a network confuses, within one affect, and score merges that are named beforehand.

The paper suggests both for future trainings (sections 4.3 and 4.4), and does neither. The confusion is taken person by
person, so that a few people with many windows do not decide, and nothing is trained: the probabilities of merged
gestures are added. Merges that are chosen and scored on the same people look too good, so the scores are also given
with the merges of each person chosen on all other people.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.files import check_output_file, write_file
from plushsense.core.gestures import AFFECT, NOBODY, Gesture, GestureSet, merge_names
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.evaluation.scores import Predictions, read_predictions
from plushsense.experiments.analysis.results import Grouping, MergeResult, MergeStep
from plushsense.scoring.metrics import column_metrics, confusion, summary
from plushsense.workflow.reporting import PREDICTIONS, load_evaluation

Groups = tuple[tuple[int, ...], ...]
"""A partition of the classes."""

Floats = NDArray[np.float64]


class Merge(NamedTuple):
    """The groups after a merge, with its confusion, and in how many people it occurs (None before the first)."""

    groups: Groups
    confusion: float | None
    people: int | None


def propose_merges(
    dataset: Dataset | str | os.PathLike[str],
    evaluation: str | os.PathLike[str],
    *,
    merges: int | None = None,
    groups: str | None = None,
    out: str | os.PathLike[str] | None = None,
) -> MergeResult:
    """Merge the two groups of gestures that people's windows are most confused between, again and again.

    Only gestures of one affect are merged, and never one that is recorded without a person or means that nothing
    happens.

    Args:
        evaluation: a folder that `evaluate` wrote, of gestures of ``dataset``.
        merges: how many merges the gesture set in ``out`` has.
        groups: the merged gestures to write instead: "family", "affect", a built-in merge, or a file, which is scored
            as well (see `GestureSet.merged_by`).
        out: a TOML file to write, for ``--classes`` of `train` and `evaluate`.

    Raises:
        BadInput: for an evaluation of other gestures; GestureError: for unknown ``groups``; ConfigError: for a number
            of merges that is not possible, or ``groups`` that merge nothing.
    """
    if out is not None:
        check_output_file(Path(out), "[[gestures]]", "a gesture set", ConfigError)
        if merges is None and groups is None:
            raise ConfigError(
                "A gesture set is written for a number of merges, or for named ones: give --merges or --groups."
            )
    folder = Path(evaluation)
    table, predictions = load_evaluation(folder), read_predictions(folder / PREDICTIONS)
    gestures = _gestures_of(as_dataset(dataset), predictions.labels)
    people = np.array(sorted(set(predictions.subject.tolist()) - {NOBODY}), dtype=np.str_)
    if len(people) < 2:
        raise BadInput(f"'{folder}' has one person, but merges are chosen by several: evaluate more people.")
    counts = np.stack([_counts(predictions, predictions.subject == person) for person in people])
    path = merge_path(counts, gestures)
    named = _named(gestures, groups)
    if out is not None:
        if groups is not None:
            merged_set = named[groups]
        elif merges is not None and 0 < merges < len(path):
            merged_set = gestures.merged(path[merges].groups)
        else:
            raise ConfigError(f"merges is {merges}: accepted are 1 to {len(path) - 1}, the steps that are possible.")
        write_file(Path(out), tomli_w.dumps(_without_defaults(merged_set)))
    return MergeResult(
        steps=_steps(predictions, people, counts, path, gestures),
        groupings={n: _grouping(predictions, people, gestures.groups_of(merged)) for n, merged in named.items()},
        split=table["split"],
        leaky=table["leaky"],
        simulated=table["simulated"],
        people=len(people),
        gestures=None if out is None else str(out),
    )


def _steps(
    predictions: Predictions,
    people: NDArray[np.str_],
    counts: NDArray[np.int64],
    path: Sequence[Merge],
    gestures: GestureSet,
) -> tuple[MergeStep, ...]:
    """Score the groups of ``path``, with each person's merges chosen on all people, and on all others."""
    # Without a person, another order of merges may follow, of another length.
    others = [merge_path(np.delete(counts, i, axis=0), gestures) for i in range(len(people))]
    steps = []
    for number, merge in enumerate(path):
        chosen = [other[min(number, len(other) - 1)].groups for other in others]
        grouping = _grouping(predictions, people, merge.groups)
        steps.append(MergeStep(grouping, _scores(predictions, people, chosen), merge.confusion, merge.people))
    return tuple(steps)


def _named(gestures: GestureSet, groups: str | None) -> dict[str, GestureSet]:
    """Return the merges named beforehand that merge some of the gestures, and ``groups``, which must be one of them."""
    found = {}
    for name in dict.fromkeys((*merge_names(), *([] if groups is None else [groups]))):
        if name == AFFECT != groups and not gestures.has_affect:
            continue
        merged = gestures.merged_by(name)
        if 1 < len(gestures.groups_of(merged)) < len(gestures):
            found[name] = merged
    if groups is not None and groups not in found:
        raise ConfigError(
            f"'{groups}' merges none of the {len(gestures)} gestures of the evaluation, or all of them to one: "
            f"{', '.join(gestures.labels)}."
        )
    return found


def _grouping(predictions: Predictions, people: NDArray[np.str_], groups: Groups) -> Grouping:
    # Like the scores, of people only: recordings at rest would often be the largest class.
    truth = predictions.truth[np.isin(predictions.subject, people)]
    sizes = np.array([np.isin(truth, group).sum() for group in groups])
    return Grouping(
        classes=len(groups),
        merged=tuple(tuple(predictions.labels[k] for k in group) for group in groups if len(group) > 1),
        largest=float(sizes.max() / sizes.sum()),
        scores=_scores(predictions, people, [groups] * len(people)),
    )


def merge_path(counts: NDArray[np.int64], gestures: GestureSet) -> list[Merge]:
    """Merge the most confused pair of groups until two are left, or none that may be merged and is confused.

    Args:
        counts: confusion matrices of the people, (people, K, K).

    Returns:
        the groups after 0, 1, 2, … merges.
    """
    groups: Groups = tuple((k,) for k in range(len(gestures)))
    path = [Merge(groups, None, None)]
    while len(groups) > 2:
        best: tuple[float, int, int, int] | None = None
        for a, b in combinations(range(len(groups)), 2):
            if _may_merge([gestures.gestures[k] for k in (*groups[a], *groups[b])]):
                exchanged = _exchanged(counts, groups[a], groups[b])
                mean = float(exchanged.mean()) if len(exchanged) else 0.0
                if mean > 0 and (best is None or mean > best[0]):
                    best = (mean, int((exchanged > 0).sum()), a, b)
        if best is None:
            break
        mean, people, a, b = best
        joined = tuple(sorted((*groups[a], *groups[b])))
        groups = tuple(sorted([g for i, g in enumerate(groups) if i not in (a, b)] + [joined]))
        path.append(Merge(groups, mean, people))
    return path


def _gestures_of(dataset: Dataset, labels: Sequence[str]) -> GestureSet:
    missing = [label for label in labels if dataset.gestures.find(label) is None]
    if missing:
        raise BadInput(
            f"The evaluation has the gesture '{missing[0]}', which '{dataset.head.name}' has not: give the data set "
            "that was evaluated."
        )
    return GestureSet(dataset.gestures.name, tuple(dataset.gestures.get(label) for label in labels))


def _may_merge(members: Sequence[Gesture]) -> bool:
    return len({g.affect for g in members}) == 1 and not any(g.nobody or g.idle or g.free_choice for g in members)


def _exchanged(counts: NDArray[np.int64], a: Sequence[int], b: Sequence[int]) -> Floats:
    """Return the mean share of windows of one group that are read as the other, of each person who made both."""
    made_a, made_b = counts[:, a].sum(axis=(1, 2)), counts[:, b].sum(axis=(1, 2))
    both = (made_a > 0) & (made_b > 0)
    there = counts[both][:, a][:, :, b].sum(axis=(1, 2)) / made_a[both]
    back = counts[both][:, b][:, :, a].sum(axis=(1, 2)) / made_b[both]
    return np.asarray((there + back) / 2, dtype=np.float64)


def _counts(predictions: Predictions, mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    return confusion(predictions.truth[mask], predictions.predicted[mask], len(predictions.labels))


def _scores(
    predictions: Predictions, people: NDArray[np.str_], groups_of: Sequence[Groups]
) -> dict[str, dict[str, Any]]:
    """Return the summary over people of each metric, with the groups of each person."""
    values: dict[str, list[float]] = {key: [] for key in column_metrics()}
    for person, groups in zip(people, groups_of, strict=True):
        mine = predictions.subject == person
        member = np.zeros((len(predictions.labels), len(groups)))
        for g, group in enumerate(groups):
            member[list(group), g] = 1
        read = (predictions.probabilities[mine] @ member).argmax(axis=1).astype(np.int64)
        truth = member.argmax(axis=1)[predictions.truth[mine]].astype(np.int64)
        for key, metric in column_metrics().items():
            values[key].append(metric.function(confusion(truth, read, len(groups))))
    return {key: summary(found).to_json() for key, found in values.items()}


def _without_defaults(gestures: GestureSet) -> dict[str, Any]:
    """Return the table of a TOML file, without the keys that have their defaults."""
    table: dict[str, Any] = gestures.to_dict()
    plain = vars(replace(Gesture("x"), family=""))
    rows = [{k: v for k, v in g.items() if k == "label" or v != plain[k]} for g in table["gestures"]]
    return {"name": table["name"], "gestures": rows}
