"""Score one network under several splits side by side, calibrate it, and describe each person it was scored on.

The leaky split by windows, splits by recording and splits by person answer different questions. Here all means and
intervals are over people, whatever the split, so that they can be compared.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, python_warning
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.version import __version__
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset, read_people
from plushsense.evaluation.crossval import EvaluationResult
from plushsense.evaluation.scores import Predictions
from plushsense.experiments.people.traits import measure_people, trait_correlations, unusual_traits
from plushsense.jobs.journal import job_id
from plushsense.jobs.progress import JobProgress
from plushsense.scoring.calibration import cross_fitted_temperature, reliability
from plushsense.scoring.metrics import class_scores, column_metrics, confusion, summary
from plushsense.scoring.splits import parse_split
from plushsense.workflow.api import evaluate
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import Run, Warn, prepare, silent
from plushsense.workflow.reporting import check_results

SPLITS = ("windows:5", "by-recording:5", "by-subject:5", "leave-one-subject-out")
TABLE, PAGE = "lens.json", "lens.html"


def lens(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    splits: Sequence[str] = SPLITS,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    cluster: str | None = None,
    progress: Callable[[JobProgress], None] | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> dict[str, Any]:
    """Evaluate one network under each split; describe people and calibration under the last split by person.

    Finished folds are stored as by `evaluate`, so that a stopped run, or an earlier evaluation, is continued.

    Args:
        config, settings: as for `evaluate`; its split is not used.
        splits: at least one, such as "windows:5" (leaky) and "leave-one-subject-out".
        out: a folder for ``lens.json`` and ``lens.html``; an error if it holds one of other settings or data, unless
            ``overwrite``.

    Returns:
        ``splits``: {split, leaky, folds, train_windows, people, accuracy {mean, sd, ci95}, macro_f1 {…}, by_recording,
        pooled, leakage} of each; ``calibration`` (see `calibration_of`), ``people`` (see `people_of`) and ``traits``
        (see `trait_correlations`), which are None without a split by person.
    """
    dataset = as_dataset(dataset)
    config = config or from_settings(**settings)
    if not splits:
        raise ConfigError(f"The lens needs at least one split: for example --splits {','.join(SPLITS)}.")
    parsed = [parse_split(text) for text in splits]
    made = prepare(dataset, config)
    identity = lens_id(made, splits)
    if out is not None:
        check_results(Path(out), "A lens", TABLE, identity, replace=overwrite)
    rows, honest = [], None
    for number, split in enumerate(parsed):
        done = evaluate(
            dataset, config, split=split.text, cluster=cluster, progress=progress, warn=silent if number else warn
        )
        rows.append(_split_row(done))
        honest = done if split.separates_people else honest
    result: dict[str, Any] = {
        "splits": rows,
        "by_person": None if honest is None else honest.split.text,
        "calibration": None,
        "people": None,
        "traits": None,
    }
    if honest is not None:
        measured = measure_people(dataset, honest.predictions.labels)
        people = people_of(honest, measured, dataset)
        scores = {row["subject"]: row["accuracy"] for row in people}
        result |= {
            "calibration": calibration_of(honest.predictions),
            "people": people,
            "traits": trait_correlations({p: measured[p] for p in scores if p in measured}, scores),
        }
    result |= {
        "id": identity,
        "name": made.model.arch,
        "model": {"arch": made.model.arch, "filters": made.model.filters, "preset": made.preset},
        "seed": made.evaluation.seed,
        "dataset": dataset.head.name,
        "dataset_hash": dataset.hash,
        "simulated": dataset.head.simulated,
        "code_version": __version__,
    }
    if out is not None:
        with dataset.generation.writing():
            _save(result, Path(out))
    return result


def lens_id(run: Run, splits: Sequence[str]) -> str:
    """Return an identifier of 20 hexadecimal digits, equal for equal settings and data."""
    outcome = run.outcome() | {"splits": [parse_split(text).text for text in splits]}
    return job_id({"lens": outcome, "data": run.dataset.hash})


def _split_row(done: EvaluationResult) -> dict[str, Any]:
    """Return the scores of an evaluation with means over its people, whatever the split."""
    scores, people = done.scores, done.scores.subjects
    return {
        "split": done.split.text,
        "leaky": done.split.leaky,
        "apart": done.split.separates_people,
        "folds": len(scores.folds),
        "train_windows": round(np.mean([fold.record.windows[0] for fold in scores.folds])),
        "people": len(people),
        **{
            key: summary([at for row in people if (at := row.metrics[key]) is not None]).to_json()
            for key in column_metrics()
        },
        "by_recording": scores.by_recording.to_json(),
        "pooled": scores.pooled,
        "leakage": done.leakage,
    }


def calibration_of(predictions: Predictions) -> dict[str, Any]:
    """Return the reliability of predictions on people left out, as they are and scaled by a temperature.

    Each person's temperature is fitted on the predictions of all other people; recordings of nobody are left out.

    Returns:
        ``before`` and ``after``: results of `reliability`; ``temperature``: the median over the people.
    """
    people = predictions.subject != NOBODY
    p, truth = predictions.probabilities[people], predictions.truth[people]
    scaled, temperatures = cross_fitted_temperature(p, truth, predictions.subject[people])
    return {
        "before": reliability(p, truth),
        "after": reliability(scaled, truth),
        "temperature": float(np.median(list(temperatures.values()))) if temperatures else None,
    }


def people_of(
    done: EvaluationResult, measured: Mapping[str, Mapping[str, float | None]], dataset: Dataset
) -> list[dict[str, Any]]:
    """Describe each person of an evaluation, the worst read first.

    Returns:
        {subject, windows, recordings, accuracy, macro_f1, by_recording_accuracy, known (what subjects.csv says),
        traits, unusual (sentences), gestures: {gesture, windows, recall, read_as, share}} of each; the gestures in the
        order of their recall, with the one that most often is read instead and its share of the windows.
    """
    predictions, labels = done.predictions, done.predictions.labels
    files = read_people(dataset.path)
    unusual = unusual_traits(measured)
    rows = []
    for row in done.scores.subjects:
        name = row.subject
        mine = predictions.subject == name
        counts = confusion(predictions.truth[mine], predictions.predicted[mine], len(labels))
        recall, made = class_scores(counts).recall, counts.sum(axis=1)
        gestures = []
        for k in sorted(np.flatnonzero(made > 0).tolist(), key=lambda k: recall[k]):
            wrong = counts[k].copy()
            wrong[k] = 0
            read_as, share = labels[int(wrong.argmax())], float(wrong.max() / made[k])
            gestures.append({"gesture": labels[k], "windows": int(made[k]), "recall": float(recall[k])})
            gestures[-1] |= {"read_as": read_as if share else None, "share": share}
        known = {}
        if name in files:
            person = files[name]
            known = {"age_group": person.age_group, "gender": person.gender, **person.more}
        rows.append(
            {
                **row.to_json(),
                "known": {key: value for key, value in known.items() if value},
                "traits": dict(measured.get(name, {})),
                "unusual": unusual.get(name, []),
                "gestures": gestures,
            }
        )
    return sorted(rows, key=lambda row: -1.0 if row["accuracy"] is None else row["accuracy"])


def _save(result: dict[str, Any], out: Path) -> None:
    from plushsense.experiments.people.report import lens_page

    out.mkdir(parents=True, exist_ok=True)
    write_file(out / PAGE, lens_page(result))
    write_file(out / TABLE, json.dumps(result, ensure_ascii=False, indent=1))
