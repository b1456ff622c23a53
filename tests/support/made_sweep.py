"""A made-up results folder of a sweep: the contract's files with numbers that nobody measured."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.gestures import load_gestures
from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS, Arch

MADE_UP = "MADE-UP numbers of a test"
TRAIN = 3936


def make_sweep(
    folder: Path,
    *,
    archs: tuple[str, ...] = PAPER_ARCHITECTURES,
    filter_sets: tuple[tuple[int, ...], ...] = PAPER_FILTERS,
    epochs: tuple[int, ...] = (100, 250, 1000),
    batches: tuple[str, ...] = ("64", "256", "full"),
    seeds: int = 1,
    folds: int = 1,
    padding: str = "mirror",
    labels: tuple[str, ...] | None = None,
    affects: tuple[str, ...] | None = None,
    channels: int = 11,
    split: str = "windows:holdout",
    leaky: bool = True,
    simulated: bool = False,
    waiting: float = 0.0,
    dataset: str = MADE_UP,
    name: str = "made-up",
    draw: int = 0,
) -> Path:
    """Write the folder; ``waiting`` is the share of trials that have no score yet. Returns it."""
    import polars

    random = np.random.default_rng(draw)
    if labels is None:
        gestures = load_gestures("plush-18").gestures
        labels, affects = tuple(g.label for g in gestures), tuple(g.affect for g in gestures)
    k = len(labels)
    trials, runs, curves, networks = [], [], [], []
    confusions: dict[str, Any] = {}
    per_class: dict[str, Any] = {}
    for symbol in archs:
        for filters in filter_sets:
            arch = Arch.parse(symbol, filters[: symbol.count("_") + 1], channels=channels, classes=k, padding=padding)
            skill = 0.42 + 0.05 * math.log10(arch.parameters) + 0.08 * (symbol.count("d") > 2) + random.normal(0, 0.03)
            networks.append((arch, filters, skill))
    for number, (arch, filters, skill) in enumerate(networks):
        for batch in batches:
            job = hashlib.sha256(f"{number} {batch}".encode()).hexdigest()[:20]
            for length in epochs:
                trial = hashlib.sha256(f"{number} {batch} {length}".encode()).hexdigest()[:20]
                waits = random.random() < waiting
                scores = skill + 0.04 * math.log10(length / 250) - 0.05 * (batch == "full")
                values = np.clip(scores + random.normal(0, 0.012, seeds * folds), 0.02, 0.98)
                accuracy, f1 = float(values.mean()), float(values.mean() - 0.04)
                trials.append(
                    {
                        "trial": trial,
                        "arch": arch.symbol,
                        "filters": "/".join(map(str, arch.filters)),
                        "filter_set": "/".join(map(str, filters)),
                        "padding": arch.padding,
                        "norm": arch.norm,
                        "epochs": length,
                        "batch": TRAIN if batch == "full" else int(batch),
                        "batch_asked": batch,
                        "seeds": seeds,
                        "folds": folds,
                        "parameters": arch.parameters,
                        "receptive_field": arch.receptive_field,
                        "span": arch.span,
                        "macs_per_window": arch.macs_per_window,
                        "macs_per_step": arch.macs_per_step,
                        "state_bytes_int8": arch.state_bytes_int8,
                        "accuracy": None if waits else accuracy,
                        "accuracy_sd": None if waits else (float(values.std(ddof=1)) if values.size > 1 else 0.0),
                        "macro_f1": None if waits else f1,
                        "macro_f1_sd": None if waits else (float(values.std(ddof=1)) if values.size > 1 else 0.0),
                        "validation_accuracy": None if waits else accuracy + float(random.normal(0, 0.01)),
                        "validation_macro_f1": None if waits else f1,
                        "train_loss": None if waits else 0.4,
                        "acr": None if waits else accuracy / math.log10(arch.parameters),
                        "seconds": None if waits else 60.0,
                        "status": "waiting" if waits else "done",
                    }
                )
                if waits:
                    continue
                for run in range(seeds * folds):
                    seed, fold = run // folds, run % folds
                    runs.append(
                        {
                            "trial": trial,
                            "run": f"{job}{run:02d}",
                            "arch": arch.symbol,
                            "filters": "/".join(map(str, arch.filters)),
                            "epochs": length,
                            "batch": batch,
                            "seed": seed,
                            "fold": str(fold),
                            "test_windows": 843,
                            "accuracy": float(values[run]),
                            "macro_f1": float(values[run]) - 0.04,
                            "validation_accuracy": accuracy,
                            "train_loss": 0.4,
                            "seconds": 60.0,
                        }
                    )
            for run in range(seeds * folds):
                fall = np.exp(-np.arange(max(epochs)) / 60)
                curves += [
                    {
                        "run": f"{job}{run:02d}",
                        "arch": arch.symbol,
                        "filters": "/".join(map(str, arch.filters)),
                        "batch": batch,
                        "seed": run // folds,
                        "fold": str(run % folds),
                        "epoch": e + 1,
                        "train_loss": 0.3 + 2.4 * fall[e],
                        "train_accuracy": 0.95 - 0.85 * fall[e],
                        "validation_loss": 1.0 + 1.8 * fall[e] + random.normal(0, 0.04),
                        "validation_accuracy": skill - 0.6 * fall[e] + random.normal(0, 0.01),
                        "learning_rate": 0.001,
                    }
                    for e in range(max(epochs) if number < 60 else 0)
                ]
    done = [t for t in trials if t["status"] == "done"]
    kept = {}
    for row in done:
        key = row["filter_set"]
        if key not in kept or row["accuracy"] > kept[key]["accuracy"]:
            kept[key] = row
    for arch_filters in (("14d1_39d2_41d4", "8/12/16"), ("19d1_19d2_19d4_17d8", "4/6/8/8")):
        mine = [t for t in done if (t["arch"], t["filters"]) == arch_filters]
        if mine:
            kept["".join(arch_filters)] = max(mine, key=lambda t: t["accuracy"])
    for row in kept.values():
        counts = np.zeros((k, k), dtype=int)
        for i in range(k):
            odds = np.full(k, (1 - row["accuracy"]) / max(k - 1, 1))
            odds[i] = row["accuracy"]
            counts[i] = random.multinomial(40 + 5 * i, odds / odds.sum())
        confusions[row["trial"]] = counts.tolist()
        right, true, read = counts.diagonal(), counts.sum(1), np.maximum(counts.sum(0), 1)
        per_class[row["trial"]] = [
            {
                "label": labels[i],
                "f1": float(2 * right[i] / max(true[i] + read[i], 1)),
                "recall": float(right[i] / true[i]),
                "precision": float(right[i] / read[i]),
                "support": int(true[i]),
            }
            for i in range(k)
        ]
    folder.mkdir(parents=True, exist_ok=True)
    nulls = {"accuracy": polars.Float64, "macro_f1": polars.Float64}
    frame = polars.DataFrame(trials, infer_schema_length=None).cast(nulls)
    frame.write_parquet(folder / "trials.parquet")
    frame.write_csv(folder / "trials.csv")
    polars.DataFrame(runs, infer_schema_length=None).write_parquet(folder / "runs.parquet")
    polars.DataFrame(curves, infer_schema_length=None).write_parquet(folder / "curves.parquet")
    head = {
        "name": name,
        "dataset": dataset,
        "dataset_hash": "0" * 64,
        "simulated": simulated,
        "split": split,
        "leaky": leaky,
        "context": "loop",
        "preset": "search",
        "grid": {"archs": list(archs), "epochs": list(epochs), "batches": list(batches)},
        "labels": list(labels),
        "affects": list(affects or ["none"] * k),
        "trials": len(trials),
        "done": len(done),
        "resumed": 0,
        "seconds": 3600.0,
        "machine": "a made-up processor, 2 threads, torch 0",
        "code_version": "0",
        "best": sorted(done, key=lambda t: -t["accuracy"])[:5],
        "confusions": confusions,
        "per_class": per_class,
    }
    (folder / "sweep.json").write_text(json.dumps(head), encoding="utf-8")
    return folder
