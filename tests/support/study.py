"""A made-up but plausible input for the report: as many gestures, people and evaluations as a real study."""

from __future__ import annotations

import copy
from functools import cache
from typing import Any

import numpy as np
import pytest

from plushsense.core.gestures import load_gestures


def metric(values: Any) -> dict[str, Any]:
    """{mean, sd, ci95} of values a person."""
    table = np.asarray(values, dtype=float)
    half = 1.96 * float(table.std()) / len(table) ** 0.5
    return {
        "mean": float(table.mean()),
        "sd": float(table.std()),
        "ci95": [float(table.mean()) - half, float(table.mean()) + half],
    }


def evaluation(
    split: str, context: str, train_context: str, skill: float, *, people: int = 25, seed: int = 0
) -> dict[str, Any]:
    """One evaluation as ``EvaluationResult.to_json()`` gives it."""
    draw = np.random.default_rng(seed)
    gestures = load_gestures("plush-18")
    labels = [g.label for g in gestures.gestures]
    affects = [g.affect for g in gestures.gestures]
    k = len(labels)
    counts = np.zeros((k, k), dtype=int)
    for i in range(k):
        odds = np.full(k, (1 - skill) / k)
        odds[i] += skill * 0.7
        odds[i - 1 if i % 2 == 0 else (i + 1) % k] += skill * 0.3
        counts[i] = draw.multinomial(draw.integers(180, 1400 if i == 0 else 340), odds / odds.sum())
    groups = ["positive", "neutral", "negative"]
    onto = np.array([[affect == group for group in groups] for affect in affects], dtype=int)
    subjects = [f"P{i:02d}" for i in range(1, people + 1)]
    scores = np.clip(draw.normal(skill, 0.09, people), 0, 1)
    right = counts.diagonal()
    precision, recall = right / np.maximum(counts.sum(0), 1), right / counts.sum(1)
    f1 = 2 * precision * recall / np.maximum(precision + recall, 1e-9)
    folds = [
        {
            "fold": name,
            "subject": name,
            "subjects": [name],
            "train_windows": 4800,
            "validation_windows": 600,
            "test_windows": 220,
            "accuracy": float(a),
            "macro_f1": float(a) - 0.05,
            "macro_recall": float(a) - 0.03,
            "by_recording_accuracy": float(a) + 0.03,
            "epochs": 60,
            "seconds": 12.0,
        }
        for name, a in zip(subjects, scores, strict=True)
    ]
    histories = []
    for _ in folds:
        epochs = int(draw.integers(25, 90))
        fall = np.exp(-np.arange(epochs) / 14)
        noise = draw.normal(0, 0.03, (2, epochs))
        histories.append(
            [
                {
                    "epoch": e + 1,
                    "train_loss": float(0.5 + 2.3 * fall[e]),
                    "train_accuracy": float(0.85 - 0.75 * fall[e]),
                    "validation_loss": float(1.1 + 1.7 * fall[e] + noise[0, e]),
                    "validation_accuracy": float(skill - 0.6 * fall[e] + noise[1, e]),
                    "learning_rate": 0.003,
                }
                for e in range(epochs)
            ]
        )
    leaky = split.startswith("windows")
    return {
        "split": split,
        "context": context,
        "train_context": train_context,
        "leaky": leaky,
        "seeds": [1],
        "accuracy": metric(scores),
        "macro_f1": metric(scores - 0.05),
        "macro_recall": metric(scores - 0.03),
        "macro_f1_all_classes": metric(scores - 0.06),
        "by_recording": {"accuracy": skill + 0.03, "macro_f1": skill},
        "pooled": {
            "accuracy": float(right.sum() / counts.sum()),
            "macro_recall": float(recall.mean()),
            "macro_f1": float(f1.mean()),
        },
        "per_class": [
            {
                "label": labels[i],
                "affect": affects[i],
                "precision": float(precision[i]),
                "recall": float(recall[i]),
                "f1": float(f1[i]),
                "support": int(counts[i].sum()),
            }
            for i in range(k)
        ],
        "confusion": {"labels": labels, "counts": counts.tolist()},
        "confusion_affect": {"labels": groups, "counts": (onto.T @ counts @ onto).tolist()},
        "by_context": {
            "stream": {"windows": 4100, "recordings": 990, "accuracy": skill},
            "loop": {"windows": 1521, "recordings": 336, "accuracy": skill - 0.04},
        },
        "nobody": {"recordings": 51, "windows": 1020, "accuracy": 0.97},
        "folds": folds,
        "subjects": [
            {
                "subject": f["subject"],
                "windows": 220,
                "recordings": 51,
                "accuracy": f["accuracy"],
                "macro_f1": f["macro_f1"],
                "by_recording_accuracy": f["by_recording_accuracy"],
            }
            for f in folds
        ],
        "histories": histories,
        "predictions": "scores/predictions-loso-stream.parquet",
    }


@cache
def made_study() -> dict[str, Any]:
    """The keyword arguments of ``write_report`` for a study of 25 people, 18 gestures, three evaluations.

    Only the second evaluation has training curves: they take most of the time of a page.
    """
    labels = load_gestures("plush-18").labels
    return {
        "title": "Plush companion, 18 touch gestures of 25 virtual people",
        "dataset": {
            "name": "virtual-plush",
            "subjects": 25,
            "recordings": 1326,
            "gestures": list(labels),
            "streams": 28,
            "layout": "plush-15",
            "licence": "CC BY 4.0",
            "hash": "9f2c4e0b7d1a" * 5 + "ab12",
            "warnings": 17,
        },
        "evaluations": [
            {
                **evaluation("leave-one-subject-out", "stream", "stream", 0.71),
                "model": "14d1_19d2_19d4",
                "histories": [],
            },
            {
                **evaluation("leave-one-subject-out", "stream", "loop", 0.48, seed=1),
                "model": "14d1_39d2_41d4 (mirror)",
            },
            {**evaluation("windows:5", "stream", "stream", 0.9, seed=2), "model": "14d1_19d2_19d4", "histories": []},
        ],
        "models": [
            {
                "name": "default",
                "symbol": "14d1_19d2_19d4",
                "filters": [8, 12, 16],
                "padding": "stream",
                "norm": "batch",
                "parameters": 6650,
                "receptive_field": 122,
                "span": 247,
                "pool": 125,
                "macs_per_window": 1234567,
                "macs_per_step": 33520,
                "state_bytes_int8": 1432,
                "channels": 11,
                "classes": 18,
                "rate_hz": 100.0,
                "provenance": {
                    "dataset": "virtual-plush",
                    "dataset_hash": "9f2c4e0b7d1a" * 5 + "ab12",
                    "subjects": [f"P{i:02d}" for i in range(1, 26)],
                    "preset": "loso",
                    "code_version": "0.1.0",
                    "split": "leave-one-subject-out",
                },
            }
        ],
        "simulated": True,
    }


@pytest.fixture
def study() -> dict[str, Any]:
    """A study that a test may change."""
    return copy.deepcopy(made_study())
