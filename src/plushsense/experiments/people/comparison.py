"""Compare saved evaluations of two or more networks on the same people: paired tests, ranks and calibration."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput
from plushsense.core.files import write_file
from plushsense.core.version import __version__
from plushsense.dataset.store import writing_around
from plushsense.evaluation.scores import Predictions, read_predictions, votes_by_person
from plushsense.experiments.people.lens import calibration_of
from plushsense.jobs.journal import job_id
from plushsense.scoring.comparison import average_ranks, cliques, compare_pairs
from plushsense.scoring.metrics import column_metrics, summary
from plushsense.workflow.reporting import PREDICTIONS, check_results, load_evaluation

TABLE, PAGE = "comparison.json", "comparison.html"
# What all evaluations must have in common, as a key of evaluation.json and in words.
_SHARED = (("data", "data"), ("split", "split"), ("context", "context"), ("labels", "gestures"))
# The context of an evaluation of which all windows lie in their recordings; it can be compared with any other.
_INSIDE = "inside"


def compare(
    evaluations: Sequence[str | os.PathLike[str]],
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Compare saved evaluations person by person: their windows, or if these are not the same ones, their recordings.

    Args:
        evaluations: at least two folders that `evaluate` wrote, of the same data, split, context and gestures.
        out: a folder for ``comparison.json`` and ``comparison.html``; an error if it holds another comparison, unless
            ``overwrite``.

    Returns:
        ``models``: {name, title, parameters, folder, accuracy {mean, sd, ci95}, macro_f1 {…}, rank, calibration} of
        each, the best rank first; ``pairs``: the results of `compare_pairs` for each metric; ``cliques``: for each
        metric, models that do not differ significantly; ``people``: the scores of each person by model; ``scored``:
        "windows", or "recordings" if those are compared, each classified by the vote of its windows.

    Raises:
        BadInput: for folders without an evaluation or its predictions, or evaluations that cannot be compared.
    """
    folders = [Path(folder) for folder in evaluations]
    if len(folders) < 2:
        raise BadInput("A comparison needs at least two evaluations: give two folders written by  plushsense evaluate")
    writing = writing_around(folders[0])
    tables = [load_evaluation(folder) for folder in folders]
    _require_same(folders, tables)
    names = [f"M{i}" for i in range(1, len(tables) + 1)]
    predictions = [read_predictions(folder / PREDICTIONS) for folder in folders]
    same = len({_scored_windows(each) for each in predictions}) == 1
    if same:
        of = [{row["subject"]: row for row in table["subjects"]} for table in tables]
    else:
        _require_same_recordings(folders, predictions)
        of = [{p: vote.metrics for p, vote in votes_by_person(each).items()} for each in predictions]
    people = sorted(set.intersection(*(set(rows) for rows in of)))
    if len(people) < 2:
        raise BadInput("The evaluations have fewer than two people in common, so nothing can be paired.")
    identity = job_id({"comparison": [table["id"] for table in tables]})
    if out is not None:
        check_results(Path(out), "A comparison", TABLE, identity, replace=overwrite)
    keys = tuple(column_metrics())
    scores = {key: np.array([[rows[p][key] for rows in of] for p in people], dtype=np.float64) for key in keys}
    ranks = {key: average_ranks(-values).mean(axis=0) for key, values in scores.items()}
    models = [
        {
            "name": name,
            "title": table["title"],
            "parameters": table["model"]["parameters"],
            "folder": str(folder),
            "seeds": table["seeds"],
            **{key: summary(scores[key][:, i]).to_json() for key in keys},
            "rank": {key: float(ranks[key][i]) for key in keys},
            "calibration": calibration_of(predictions[i]),
        }
        for i, (name, table, folder) in enumerate(zip(names, tables, folders, strict=True))
    ]
    models.sort(key=lambda model: model["rank"][keys[0]])
    pairs = {key: compare_pairs(names, scores[key]) for key in keys}
    ordered = {key: [m["name"] for m in sorted(models, key=lambda m: m["rank"][key])] for key in keys}
    result = {
        "models": models,
        "pairs": {key: [pair.to_json() for pair in found] for key, found in pairs.items()},
        "cliques": {key: cliques(ordered[key], pairs[key]) for key in keys},
        "people": [
            {"subject": p, **{n: {key: float(scores[key][i, j]) for key in keys} for j, n in enumerate(names)}}
            for i, p in enumerate(people)
        ],
        "scored": "windows" if same else "recordings",
        "split": tables[0]["split"],
        "leaky": tables[0]["leaky"],
        "context": next((table["context"] for table in tables if table["context"] != _INSIDE), _INSIDE),
        "simulated": any(table["simulated"] for table in tables),
        "dataset": tables[0]["dataset"]["name"],
        "id": identity,
        "name": " and ".join(names),
        "code_version": __version__,
    }
    if out is not None:
        from plushsense.experiments.people.report import comparison_page

        with writing():
            Path(out).mkdir(parents=True, exist_ok=True)
            write_file(Path(out) / PAGE, comparison_page(result))
            write_file(Path(out) / TABLE, json.dumps(result, ensure_ascii=False, indent=1))
    return result


def _scored_windows(predictions: Predictions) -> tuple[tuple[str, int], ...]:
    """Return recording and number of each scored window, sorted."""
    return tuple(sorted(zip(predictions.recording.tolist(), predictions.window.tolist(), strict=True)))


def _require_same_recordings(folders: Sequence[Path], predictions: Sequence[Predictions]) -> None:
    """Raise BadInput if the evaluations scored different recordings."""
    recordings = [set(each.recording.tolist()) for each in predictions]
    for folder, other in zip(folders, recordings, strict=True):
        if other != recordings[0]:
            raise BadInput(
                f"'{folders[0]}' and '{folder}' scored different recordings ({len(recordings[0])} and {len(other)}): "
                "only evaluations of the same recordings can be compared."
            )


def _require_same(folders: Sequence[Path], tables: Sequence[dict[str, Any]]) -> None:
    """Raise BadInput if the evaluations differ in what a comparison holds constant."""
    found = []
    for folder, table in zip(folders, tables, strict=True):
        try:
            data = table["dataset"]["hash"]
            found.append({"data": data, "labels": table["confusion"]["labels"], **table})
        except (KeyError, TypeError):
            raise BadInput(f"'{folder}' is an evaluation of an older kind: evaluate again.") from None
    for key, noun in _SHARED:
        first = next((table.get(key) for table in found if table.get(key) != _INSIDE), _INSIDE)
        for folder, table in zip(folders, found, strict=True):
            if table.get(key) not in (first, _INSIDE):
                raise BadInput(
                    f"'{folders[0]}' and '{folder}' are evaluations of different {noun}: only evaluations of the same "
                    "data, split, context and gestures can be compared."
                )
