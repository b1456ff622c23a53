"""Write the report of evaluations: protocol, scores, people, gestures, confusions, training curves, model cards."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.reports import wording
from plushsense.reports.figures import data_uri, row_shares, shade, training_curves
from plushsense.reports.page import check_page_path, render_page, write_page
from plushsense.reports.table import DASH, Column, Table, count, interval, mean_sd, number, text
from plushsense.scoring.metrics import METRICS, column_metrics

if TYPE_CHECKING:
    from plushsense.reports.quality import RecordingPictures

# With more labels, a list of the most frequent confusions takes the place of the matrix, whose cells are their square.
_MOST_LABELS = 60
_MOST_CONFUSIONS = 60
AFFECT_MARKS = {"positive": "+ positive", "neutral": "o neutral", "negative": "− negative", "none": "none"}


def write_evaluation_report(path: str | Path, **content: Any) -> Path:
    """Write one self-contained HTML report and return its path; an earlier report is replaced in one step.

    Args:
        path: the .html file to write; its folder is created.
        content: the arguments of `render`.

    Raises:
        ConfigError: when the file cannot be written, or exists and is not a report.
        MissingExtraError: when jinja2 or matplotlib is not installed.
    """
    target = check_page_path(path)
    return write_page(target, render(**content))


def render(
    *,
    title: str,
    dataset: Mapping[str, Any],
    evaluations: Sequence[Mapping[str, Any]],
    models: Sequence[Mapping[str, Any]],
    simulated: bool,
    recordings: RecordingPictures | None = None,
) -> str:
    """Return the report as HTML. Any key of the mappings may be missing; the report then shows a dash.

    Args:
        title: heading of the page.
        dataset: name, subjects, recordings, gestures, streams, layout, licence, hash, warnings (numbers or lists).
        evaluations: ``EvaluationResult.to_json()`` of each, optionally with ``title`` and ``model`` as its name, and
            ``simulated`` and ``dataset`` (name, hash) for its data.
        models: a model card of each (symbol, filters, …, provenance, optional ``title``).
        recordings: pictures of the recordings, from `plushsense.reports.quality.describe_recordings`.
        simulated: whether the data set is a simulation. The page has a banner if the data set, an evaluation or a model
            is simulated.
    """
    named = [
        {
            **evaluation,
            "title": wording.evaluation_title(evaluation),
            "simulated": wording.is_simulated(evaluation, simulated),
            "foreign": wording.describe_other_data(evaluation, dataset),
        }
        for evaluation in evaluations
    ]
    cards = [_model(model) for model in models]
    # If all scores are simulated, the banner is enough; otherwise every simulated row is marked.
    wholly = simulated and all(evaluation["simulated"] for evaluation in named)
    any_simulated = simulated or any(part["simulated"] for part in (*named, *cards))
    return render_page(
        "report.html.j2",
        title=title,
        simulated=any_simulated,
        wholly_simulated=wholly,
        any_leaky=any(evaluation.get("leaky") for evaluation in named),
        dataset=dataset_rows(dataset),
        recordings=recordings,
        metrics=column_metrics(),
        comparison=_comparison_rows(named),
        subjects=_subject_rows(named),
        evaluations=[_evaluation(f"E{i}", evaluation) for i, evaluation in enumerate(named, start=1)],
        models=cards,
    )


def _evaluation(key: str, evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of one evaluation for the template."""
    nobody = evaluation.get("nobody")
    histories = [history for history in evaluation.get("histories") or () if history]
    return {
        "key": key,
        "title": evaluation["title"],
        "leaky": bool(evaluation.get("leaky")),
        "simulated": bool(evaluation["simulated"]),
        "foreign": evaluation["foreign"],
        "protocol": wording.describe_protocol(evaluation),
        "spread": wording.describe_spread(evaluation),
        "metrics": metric_table(evaluation),
        "contexts": context_table(evaluation),
        "deployed": _deployed_values(evaluation),
        "rest_apart": wording.averaged_over(evaluation) == "subjects",
        "nobody": nobody
        and {name: count(nobody.get(name)) for name in ("recordings", "windows")}
        | {"accuracy": number(nobody.get("accuracy"))},
        "classes": class_rows(evaluation),
        "confusions": [
            (name, rows, frequent)
            for name, confusion in (
                ("by gesture", evaluation.get("confusion")),
                ("by affect", evaluation.get("confusion_affect")),
            )
            for rows, frequent in [(_confusion_rows(confusion), frequent_confusions(confusion))]
            if frequent or (rows and len(rows["labels"]) > 1)
        ],
        "curves": data_uri(training_curves(histories)) if histories else None,
        "predictions": evaluation.get("predictions"),
    }


def _model(model: Mapping[str, Any]) -> dict[str, Any]:
    symbol, filters = text(model.get("symbol")), text(model.get("filters"))
    return {
        "title": str(model.get("title") or f"{symbol}, filters {filters}"),
        "rows": model_rows(model),
        "simulated": (model.get("provenance") or {}).get("simulated") is True,
        "streams": model.get("padding") == "stream",
        "padding": text(model.get("padding")),
    }


def _comparison_rows(evaluations: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each evaluation with its contexts and scores."""
    rows = []
    for i, evaluation in enumerate(evaluations, start=1):
        recordings, pooled = evaluation.get("by_recording") or {}, evaluation.get("pooled") or {}
        rows.append(
            {
                "key": f"E{i}",
                "title": evaluation["title"],
                "leaky": bool(evaluation.get("leaky")),
                "split": text(evaluation.get("split")),
                "trained": text(evaluation.get("train_context") or evaluation.get("context")),
                "scored": text(evaluation.get("context")),
                "scores": [(mean_sd(evaluation.get(key)), interval(evaluation.get(key))) for key in column_metrics()],
                "recording": number(recordings.get("accuracy")),
                "pooled": number(pooled.get("accuracy")),
                "over": wording.count_of(evaluation, wording.averaged_over(evaluation)),
                "simulated": bool(evaluation.get("simulated")),
                "foreign": bool(evaluation.get("foreign")),
            }
        )
    return rows


def metric_table(evaluation: Mapping[str, Any]) -> Table:
    """Return one row for each metric. The paper's, with recordings at rest, are averaged over folds in any split."""
    names = {key: f"{m.title} ({m.note})" if m.note else m.title for key, m in METRICS.items()}
    folds = wording.count_of(evaluation, "folds")
    names["macro_f1_all_classes"] = f"Macro-F1, all classes (as the paper), over {folds}"
    names["accuracy_with_rest"] = f"Accuracy, with recordings at rest (as the paper), over {folds}"
    names["macro_recall_with_rest"] = f"Macro recall, all classes, with recordings at rest (as the paper), over {folds}"
    evaluation = {**evaluation, **{f"{key}_with_rest": of for key, of in (evaluation.get("with_rest") or {}).items()}}
    pooled, recordings = evaluation.get("pooled") or {}, evaluation.get("by_recording") or {}
    columns = (
        Column("name", "Metric"),
        Column("mean_sd", "Mean ± sd\nby windows", "right"),
        Column("interval", "95 % interval\nof the mean", "right"),
        Column("pooled", "Pooled\nwindows", "share"),
        Column("by_recording", "Vote by\nrecording", "share"),
    )
    rows = tuple(
        {
            "name": name,
            "mean_sd": mean_sd(evaluation.get(key)),
            "interval": interval(evaluation.get(key)),
            "pooled": pooled.get(key),
            "by_recording": recordings.get(key),
        }
        for key, name in names.items()
        if evaluation.get(key) is not None or pooled.get(key) is not None
    )
    return Table("metrics", "Scores", columns, rows)


def context_table(evaluation: Mapping[str, Any]) -> Table | None:
    """Return one row for each kind of context among the scored windows; None if it is unknown."""
    columns = (
        Column("context", "Context of the window"),
        Column("windows", "Windows", "count"),
        Column("recordings", "Recordings", "count"),
        Column("accuracy", "Accuracy", "share"),
    )
    rows = tuple(
        {**row, "context": f"{name} – {wording.CONTEXT_WORDS[name]}" if name in wording.CONTEXT_WORDS else str(name)}
        for name, row in (evaluation.get("by_context") or {}).items()
    )
    return Table("contexts", "By context", columns, rows) if rows else None


def _deployed_values(evaluation: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return means of the 8-bit networks' scores and a table by person or fold; None if they were not evaluated."""
    int8 = evaluation.get("int8")
    if not isinstance(int8, Mapping):
        return None
    unit = "subject" if int8.get("over") == "subjects" else "fold"
    columns = (
        Column(unit, "Person" if unit == "subject" else "Fold"),
        *(
            Column(f"{key}{part}", f"{metric.title}\n{engine}", "share")
            for key, metric in column_metrics().items()
            for part, engine in (("", "float"), ("_int8", "8 bits"))
        ),
        Column("macro_f1_loss", "Macro-F1\nlost", "share"),
        Column("agreement", "Same\nanswer", "share"),
    )
    loss = int8.get("loss") or {}
    return {
        "table": Table("deployed", "Deployed in 8 bits", columns, tuple(int8["rows"])),
        "macro_f1": mean_sd(int8.get("macro_f1")),
        "loss": mean_sd(loss.get("macro_f1")),
        "interval": interval(loss.get("macro_f1")),
        "agreement": number(int8.get("agreement")),
    }


def _subject_rows(evaluations: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each person with the scores in each evaluation, or dashes if it does not have the person."""
    tables = [{str(row.get("subject")): row for row in evaluation.get("subjects") or []} for evaluation in evaluations]
    names = sorted({name for table in tables for name in table}, key=_natural)
    return [
        {
            "subject": name,
            "cells": [
                {key: number(table.get(name, {}).get(key), 2) for key in (*column_metrics(), "by_recording_accuracy")}
                for table in tables
            ],
        }
        for name in names
    ]


def _natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key for natural order, with P2 before P10."""
    pieces = ("".join(letters) for _, letters in groupby(name, str.isdecimal))
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces)


def class_rows(evaluation: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return one row for each gesture with affect, precision, recall, F1 and number of windows."""
    return [
        {
            "label": text(row.get("label")),
            "affect": AFFECT_MARKS.get(str(row.get("affect")), text(row.get("affect"))),
            "precision": number(row.get("precision")),
            "recall": number(row.get("recall")),
            "f1": number(row.get("f1")),
            "bar": f"{100 * row['f1']:.0f}" if number(row.get("f1")) != DASH else "0",
            "support": count(row.get("support")),
        }
        for row in evaluation.get("per_class") or []
    ]


def _confusion(confusion: Any) -> tuple[list[str], NDArray[Any]]:
    """Return labels (K) and counts (K, K) of a confusion matrix; no labels if it is unknown or not of that shape."""
    if not isinstance(confusion, Mapping) or not confusion.get("labels"):
        return [], np.empty((0, 0))
    labels, counts = [str(label) for label in confusion["labels"]], np.asarray(confusion["counts"])
    return (labels if counts.shape == (len(labels), len(labels)) else []), counts


def _confusion_rows(confusion: Any) -> dict[str, Any] | None:
    """Return a confusion matrix ({labels, counts}) as rows of cells with count, percent and shade.

    None without a matrix, and with too many labels (see `frequent_confusions`).
    """
    labels, counts = _confusion(confusion)
    if not 0 < len(labels) <= _MOST_LABELS:
        return None
    rows = []
    for i, share in enumerate(row_shares(counts)):
        cells = [
            {
                "count": count(int(counts[i, j])) if counts[i, j] else "·",
                "percent": f"{100 * part:.0f}" if part >= 0.005 else "<1",
                **dict(zip(("bg", "ink"), shade(float(part)), strict=True)),
                "right": i == j,
                "title": f"{labels[i]} read as {labels[j]}: {int(counts[i, j])} windows, {100 * part:.1f} %",
            }
            for j, part in enumerate(share)
        ]
        rows.append({"label": labels[i], "cells": cells, "total": count(int(counts[i].sum()))})
    return {"labels": labels, "rows": rows}


def frequent_confusions(confusion: Any) -> Table | None:
    """Return the most frequent confusions of a matrix that is too large to be shown; None for every other."""
    labels, counts = _confusion(confusion)
    if len(labels) <= _MOST_LABELS:
        return None
    wrong = np.where(np.eye(len(labels), dtype=bool), 0, counts)
    truth, predicted = np.nonzero(wrong)
    shares = row_shares(counts)
    order = np.argsort(-wrong[truth, predicted], kind="stable")[:_MOST_CONFUSIONS]
    columns = (
        Column("truth", "What was done"),
        Column("predicted", "What the network read"),
        Column("windows", "Windows", "count"),
        Column("share", "Percent of what was done", "percent"),
    )
    rows = tuple(
        {"truth": labels[i], "predicted": labels[j], "windows": int(wrong[i, j]), "share": float(shares[i, j])}
        for i, j in zip(truth[order], predicted[order], strict=True)
    )
    return Table("confusions", "Most frequent confusions", columns, rows)


def dataset_rows(dataset: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the data set as (name, value) pairs: the known keys in order, then all others."""
    gestures = dataset.get("gestures")
    named = f" ({text(gestures)})" if isinstance(gestures, Sequence) and not isinstance(gestures, str) else ""
    rows = [
        ("Name", text(dataset.get("name"))),
        ("People", count(dataset.get("subjects", dataset.get("people")))),
        ("Recordings", count(dataset.get("recordings"))),
        ("Gestures", count(gestures) + named),
        ("Session streams", count(dataset.get("streams"))),
        ("Layout", text(dataset.get("layout"))),
        ("Licence", text(dataset.get("licence"))),
        ("Hash (SHA-256)", text(dataset.get("hash"))),
        ("Warnings at import", count(dataset.get("warnings"))),
    ]
    known = {"name", "subjects", "people", "recordings", "gestures", "streams", "layout", "licence", "hash", "warnings"}
    return rows + [
        (key.replace("_", " ").capitalize(), text(value)) for key, value in dataset.items() if key not in known
    ]


def model_rows(model: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the card of a model as (name, value) pairs; a missing value is a dash."""
    rate = model.get("rate_hz")

    def samples(key: str) -> str:
        value = model.get(key)
        if count(value) == DASH:
            return DASH
        seconds = f" = {value / rate:.2f} s" if isinstance(rate, int | float) and rate > 0 and value is not None else ""
        return f"{count(value, 'samples')}{seconds}"

    sampled = f" at {rate:g} Hz" if isinstance(rate, int | float) else ""
    provenance: Mapping[str, Any] = model.get("provenance") or {}
    state = model.get("state_bytes_int8")
    rows = [
        ("Symbol", text(model.get("symbol"))),
        ("Filters", text(model.get("filters"))),
        ("Padding", text(model.get("padding"))),
        ("Normalisation", text(model.get("norm"))),
        ("Parameters", count(model.get("parameters"))),
        ("Input", count(model.get("channels"), "channels") + sampled),
        ("Classes", count(model.get("classes"))),
        ("Receptive field", samples("receptive_field")),
        ("Pooling", samples("pool")),
        ("Pooled statistics", text(model.get("pooling"))),
        ("Span (past a decision sees)", samples("span")),
        ("Multiply-accumulates a window", count(model.get("macs_per_window"))),
        ("Multiply-accumulates a step", count(model.get("macs_per_step"))),
        ("State on the chip (int8)", count(state, "bytes") if state else DASH),
    ]
    # The main keys come first; if there is no hash, the page shows a dash for it.
    hash_key = "data_hash" if "data_hash" in provenance else "dataset_hash"
    first = ["dataset", hash_key, "subjects", "preset", "code_version"]
    others = [key for key in provenance if key not in first and key != "scores"]
    return rows + [
        (_PROVENANCE.get(key, key.replace("_", " ").capitalize()), _provenance(provenance.get(key)))
        for key in first + others
    ]


_PROVENANCE = {
    "dataset": "Trained on",
    "dataset_hash": "Data hash",
    "data_hash": "Data hash",
    "subjects": "Training people",
    "preset": "Training preset",
    "code_version": "Code version",
}


def _provenance(value: Any) -> str:
    if isinstance(value, Iterable) and not isinstance(value, str | Mapping):
        items = [text(item) for item in value]
        return f"{len(items)}: {', '.join(items)}" if items else DASH
    return text(value)
