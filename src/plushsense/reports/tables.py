"""The tables of a report as rows of finished text: comparison, people, gestures, confusion, models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.reports.words import DASH, count, interval, mean_sd, number, number_of, over, text

METRICS = (
    ("accuracy", "Accuracy"),
    ("macro_recall", "Macro recall"),
    ("macro_f1", "Macro-F1 (gestures present)"),
    ("macro_f1_all_classes", "Macro-F1, all classes (as the paper)"),
)
AFFECT_MARKS = {"positive": "+ positive", "neutral": "o neutral", "negative": "− negative", "none": "none"}

# The ends of a single-hue scale (ColorBrewer "Blues"): lightness alone carries the order, so it prints in
# grey and reads with any colour vision. The count in each cell says the same in figures.
_LIGHT, _DARK = (247, 251, 255), (8, 64, 129)


def shade(share: float) -> tuple[str, str]:
    """Background and text colour (CSS) for a share of 0 to 1; the text has at least 4.5 : 1 against it."""
    share = min(max(share, 0.0), 1.0)
    rgb = tuple(round(a + (b - a) * share) for a, b in zip(_LIGHT, _DARK, strict=True))
    ink = "#ffffff" if _contrast(rgb, (255, 255, 255)) > _contrast(rgb, (0, 0, 0)) else "#000000"
    return "#{:02x}{:02x}{:02x}".format(*rgb), ink


def _contrast(one: Sequence[int], other: Sequence[int]) -> float:
    """Contrast ratio of two colours, 1 to 21 (WCAG 2.1)."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(rgb: Sequence[int]) -> float:
    linear = [c / 12.92 if c <= 0.03928 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def row_shares(counts: NDArray[Any]) -> NDArray[np.float64]:
    """Each row of a confusion matrix (K, K) as shares of its truth; a row without windows stays zero."""
    table = np.asarray(counts, dtype=np.float64)
    totals = table.sum(axis=1, keepdims=True)
    shares = np.zeros_like(table)
    np.divide(table, totals, out=shares, where=totals > 0)
    return shares


def confusion_rows(confusion: Any) -> dict[str, Any] | None:
    """A confusion matrix ({labels, counts}) as rows of cells: count, percent, shade; None without one."""
    if not isinstance(confusion, Mapping) or not confusion.get("labels"):
        return None
    labels = [str(label) for label in confusion["labels"]]
    counts = np.asarray(confusion["counts"])
    if counts.shape != (len(labels), len(labels)):
        return None
    rows = []
    for i, share in enumerate(row_shares(counts)):
        cells = []
        for j, part in enumerate(share):
            background, ink = shade(float(part))
            shown = count(int(counts[i, j])) if counts[i, j] else "·"
            words = f"{labels[i]} read as {labels[j]}: {int(counts[i, j])} windows, {100 * part:.1f} %"
            cells.append(
                {
                    "count": shown,
                    "percent": f"{100 * part:.0f}" if part >= 0.005 else "<1",
                    "bg": background,
                    "ink": ink,
                    "right": i == j,
                    "words": words,
                }
            )
        rows.append({"label": labels[i], "cells": cells, "total": count(int(counts[i].sum()))})
    return {"labels": labels, "rows": rows}


def comparison_rows(evaluations: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row an evaluation: contexts and the figures that are compared."""
    rows = []
    for number_, evaluation in enumerate(evaluations, start=1):
        recordings, pooled = evaluation.get("by_recording") or {}, evaluation.get("pooled") or {}
        rows.append(
            {
                "key": f"E{number_}",
                "title": evaluation["title"],
                "leaky": bool(evaluation.get("leaky")),
                "split": text(evaluation.get("split")),
                "trained": text(evaluation.get("train_context") or evaluation.get("context")),
                "scored": text(evaluation.get("context")),
                "accuracy": mean_sd(evaluation.get("accuracy")),
                "accuracy_interval": interval(evaluation.get("accuracy")),
                "f1": mean_sd(evaluation.get("macro_f1")),
                "f1_interval": interval(evaluation.get("macro_f1")),
                "recording": number(recordings.get("accuracy")),
                "pooled": number(pooled.get("accuracy")),
                "over": number_of(evaluation, over(evaluation)),
                "simulated": bool(evaluation.get("simulated")),
                "foreign": bool(evaluation.get("foreign")),
            }
        )
    return rows


def metric_rows(evaluation: Mapping[str, Any]) -> list[dict[str, str]]:
    """One row a metric: mean ± sd, interval, pooled, by recording; the paper's average is always over folds."""
    folds = f", over {number_of(evaluation, 'folds')}"
    pooled, recordings = evaluation.get("pooled") or {}, evaluation.get("by_recording") or {}
    return [
        {
            "name": name + folds * (key == "macro_f1_all_classes"),
            "mean_sd": mean_sd(evaluation.get(key)),
            "interval": interval(evaluation.get(key)),
            "pooled": number(pooled.get(key)),
            "recording": number(recordings.get(key)),
        }
        for key, name in METRICS
        if evaluation.get(key) is not None or pooled.get(key) is not None
    ]


def subject_rows(evaluations: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row a person, with the scores in each evaluation; dashes where one lacks the person."""
    tables = [{str(row.get("subject")): row for row in evaluation.get("subjects") or []} for evaluation in evaluations]
    names = sorted({name for table in tables for name in table}, key=_natural)
    return [
        {
            "subject": name,
            "cells": [
                {
                    key: number(table.get(name, {}).get(key), 2)
                    for key in ("accuracy", "macro_f1", "by_recording_accuracy")
                }
                for table in tables
            ],
        }
        for name in names
    ]


def _natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sort key that puts P2 before P10."""
    pieces: list[str] = []
    for letter in name:
        if pieces and pieces[-1][-1].isdecimal() == letter.isdecimal():
            pieces[-1] += letter
        else:
            pieces.append(letter)
    return tuple((0, int(p), "") if p.isdecimal() else (1, 0, p) for p in pieces)


def class_rows(evaluation: Mapping[str, Any]) -> list[dict[str, str]]:
    """One row a gesture: affect, precision, recall, F1, windows."""
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


def context_rows(evaluation: Mapping[str, Any]) -> list[dict[str, str]]:
    """One row for each kind of context among the scored windows."""
    return [
        {
            "context": str(name),
            "windows": count(row.get("windows")),
            "recordings": count(row.get("recordings")),
            "accuracy": number(row.get("accuracy")),
        }
        for name, row in (evaluation.get("by_context") or {}).items()
    ]


def dataset_rows(dataset: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The data set as (what, value) pairs: the known keys in order, then the others as they stand."""
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
    known = (
        "name",
        "subjects",
        "people",
        "recordings",
        "gestures",
        "streams",
        "layout",
        "licence",
        "hash",
        "warnings",
    )
    return rows + [
        (key.replace("_", " ").capitalize(), text(value)) for key, value in dataset.items() if key not in known
    ]


def model_rows(model: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The card of a model as (what, value) pairs; what is missing is a dash."""
    rate = model.get("rate_hz")

    def samples(key: str) -> str:
        value = model.get(key)
        if count(value) == DASH:
            return DASH
        seconds = f" = {value / rate:.2f} s" if isinstance(rate, int | float) and rate > 0 and value is not None else ""
        return f"{count(value, 'samples')}{seconds}"

    sampled = f" at {rate:g} Hz" if isinstance(rate, int | float) else ""
    made: Mapping[str, Any] = model.get("provenance") or {}
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
        ("Span (past a decision sees)", samples("span")),
        ("Multiply-accumulates a window", count(model.get("macs_per_window"))),
        ("Multiply-accumulates a step", count(model.get("macs_per_step"))),
        ("State on the chip (int8)", count(state, "bytes") if state else DASH),
    ]
    return rows + [
        (_PROVENANCE.get(key, key.replace("_", " ").capitalize()), _provenance(made.get(key))) for key in _order(made)
    ]


_PROVENANCE = {
    "dataset": "Trained on",
    "dataset_hash": "Data hash",
    "data_hash": "Data hash",
    "subjects": "Training people",
    "preset": "Training preset",
    "code_version": "Code version",
}


def _order(made: Mapping[str, Any]) -> list[str]:
    """Provenance keys: the known ones first (data, people, preset, code), then the rest as they stand."""
    hash_key = "data_hash" if "data_hash" in made else "dataset_hash"
    first = ["dataset", hash_key, "subjects", "preset", "code_version"]
    return first + [key for key in made if key not in first and key != "scores"]


def _provenance(value: Any) -> str:
    if isinstance(value, Iterable) and not isinstance(value, str | Mapping):
        items = [text(item) for item in value]
        return f"{len(items)}: {', '.join(items)}" if items else DASH
    return text(value)


def deployed_rows(evaluation: Mapping[str, Any]) -> dict[str, Any] | None:
    """What deploying in 8 bits costs: the means, and a row a person (or fold); None where it was not asked."""
    found = evaluation.get("int8")
    if not isinstance(found, Mapping):
        return None
    unit = "subject" if found.get("over") == "subjects" else "fold"
    shown = ("accuracy", "accuracy_int8", "macro_f1", "macro_f1_int8", "macro_f1_loss", "agreement")
    loss = found.get("loss") or {}
    return {
        "unit": "Person" if unit == "subject" else "Fold",
        "rows": [{"name": text(row.get(unit)), "cells": [number(row.get(k)) for k in shown]} for row in found["rows"]],
        "macro_f1": mean_sd(found.get("macro_f1")),
        "loss": mean_sd(loss.get("macro_f1")),
        "interval": interval(loss.get("macro_f1")),
        "agreement": number(found.get("agreement")),
    }
