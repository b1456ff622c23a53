"""One result as a row of a table, read from an evaluation, a sweep or a bundle."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.apps.dividing import WHOLE_PEOPLE
from plushsense.apps.sweep_tables import SUMMARY as SWEEP
from plushsense.core.errors import BadInput
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.models.bundle import Bundle
from plushsense.windows.cut import ANYWHERE

EVALUATION, TRIAL, TRAINING = "evaluation", "trial", "training"
SUBJECTS, FOLDS, TRAININGS, HELD_BACK = "subjects", "folds", "trainings", "held_back"
_HASH = 6


@dataclass(frozen=True)
class Row:
    """One result.

    Attributes:
        id: of the row; ``kind``: `EVALUATION`, `TRIAL` (of a sweep or search) or `TRAINING`.
        path: the evaluation's or sweep's folder, or the bundle. ``trial``: within a sweep.
        dataset: its folder, "" where it is not in this studio; ``data``: its name.
        spread: what mean and sd go over: ``units`` of `SUBJECTS`, `FOLDS`, `TRAININGS` (folds times seeds); of a
            single training, the people `HELD_BACK` where there are any.
        macs: multiply-accumulates for a decision, every 50 ms.
        when_s: seconds since 1970.
        apart: what else must be the same where two are compared: the data set's hash, the classes, who was held back.
    """

    id: str
    kind: str
    path: Path
    trial: str
    dataset: str
    data: str
    network: str
    schedule: str
    split: str
    context: str
    leaky: bool
    simulated: bool
    seeds: str
    spread: str
    units: int
    accuracy: float | None
    accuracy_sd: float | None
    macro_f1: float | None
    macro_f1_sd: float | None
    parameters: int
    macs: int
    when_s: float
    apart: tuple[str, ...] = ()


def front(rows: Sequence[Row]) -> list[Row]:
    """Those that none beats: as few parameters and as good, and better in one; the smallest first."""
    best, kept = float("-inf"), []
    for row in sorted(rows, key=lambda r: (r.parameters, -_or_least(r.macro_f1))):
        if row.macro_f1 is not None and row.macro_f1 > best:
            best = row.macro_f1
            kept.append(row)
    return kept


def _or_least(value: float | None) -> float:
    return float("-inf") if value is None else value


def of_evaluation(path: Path, dataset: Any) -> list[Row]:
    """The one row of an ``evaluation.json``."""
    table = read_json(path)
    model, config = table["model"], table["config"]
    training = config["training"]
    context = table["context"]
    if table["train_context"] != context:
        context = f"{table['train_context']} → {context}"
    units = table[table["over"]]
    return [
        Row(
            str(path.parent),
            EVALUATION,
            path.parent,
            "",
            str(dataset),
            table["dataset"]["name"],
            f"{model['symbol']} {'/'.join(map(str, model['filters']))} {model['padding']}",
            f"{config['preset']}, {training['epochs']}",
            table["split"],
            context,
            table["leaky"],
            table["simulated"],
            ", ".join(map(str, table["seeds"])),
            SUBJECTS if table["over"] == SUBJECTS else FOLDS,
            len(units),
            table["accuracy"]["mean"],
            table["accuracy"]["sd"],
            table["macro_f1"]["mean"],
            table["macro_f1"]["sd"],
            model["parameters"],
            model["macs_per_step"],
            path.stat().st_mtime,
            (str(table["dataset"]["hash"])[:_HASH], *(str(one["label"]) for one in table["per_class"])),
        )
    ]


def of_trials(path: Path, dataset: Any) -> list[Row]:
    """The trials of a sweep that are done; of a search, those that went to the end."""
    folder = path.parent
    table = read_json(folder / SWEEP)
    grid, when = table["grid"], path.stat().st_mtime
    seeds = ", ".join(map(str, grid["seeds"]))
    apart = (str(table.get("dataset_hash", ""))[:_HASH], *map(str, table.get("labels", ())))
    rows = []
    with path.open(encoding="utf-8", newline="") as file:
        for trial in csv.DictReader(file):
            if trial["status"] != "done" or not trial["accuracy"]:
                continue
            rows.append(
                Row(
                    f"{folder}#{trial['trial']}",
                    TRIAL,
                    folder,
                    trial["trial"],
                    str(dataset),
                    table["dataset"],
                    f"{trial['arch']} {trial['filters']} {trial['padding']}",
                    f"{table['preset']}, {trial['epochs']} ({trial['batch_asked']})",
                    trial["split"],
                    table["context"],
                    trial["leaky"] == "true",
                    trial["simulated"] == "true",
                    seeds,
                    *over_trainings(trial),
                    float(trial["accuracy"]),
                    _number(trial["accuracy_sd"]),
                    _number(trial["macro_f1"]),
                    _number(trial["macro_f1_sd"]),
                    int(trial["parameters"]),
                    int(trial["macs_per_step"]),
                    when,
                    apart,
                )
            )
    return rows


def of_bundle(path: Path, known: Any) -> list[Row]:
    """The one row of a bundle; ``known``: data sets by name."""
    bundle = Bundle.load(path)
    kept = bundle.provenance
    scores, training = kept.get("scores", {}), kept.get("training", {})
    arch = bundle.arch
    name = str(kept.get("dataset", "?"))
    split = str(scores.get("split", kept.get("split", "?")))
    context = bundle.windowing.get("context", "?")
    if context == ANYWHERE:
        # As an evaluation says it: what is trained anywhere is scored on whole gestures.
        context = f"{ANYWHERE} → stream"
    held_back = sorted(set(kept.get("validation_subjects", ())) - {NOBODY, UNKNOWN_SUBJECT})
    return [
        Row(
            str(path),
            TRAINING,
            path,
            "",
            known.get(name, ""),
            name,
            f"{arch.symbol} {'/'.join(map(str, arch.filters))} {arch.padding}",
            f"{kept.get('preset', '?')}, {training.get('epochs', '?')}",
            split,
            str(context),
            bool(scores.get("leaky")),
            bool(kept.get("simulated")),
            str(training.get("seed", "?")),
            # Where recordings or windows are held back, their people were trained on.
            *((HELD_BACK, len(held_back)) if split == WHOLE_PEOPLE else (TRAININGS, 1)),
            scores.get("accuracy"),
            None,
            scores.get("macro_f1"),
            None,
            arch.parameters,
            arch.macs_per_step,
            path.stat().st_mtime,
            (str(kept.get("dataset_hash", ""))[:_HASH], *bundle.gestures.labels, *held_back),
        )
    ]


def over_trainings(trial: Mapping[str, Any]) -> tuple[str, int]:
    """What a trial's mean and sd go over: a figure of each fold under each seed."""
    folds, seeds = int(trial["folds"]), int(trial["seeds"])
    return (FOLDS, folds) if seeds == 1 else (TRAININGS, folds * seeds)


def read_json(path: Path) -> Any:
    """A JSON file.

    Raises:
        BadInput: where it cannot be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as cause:
        raise BadInput(f"'{path}' cannot be read ({cause}): make this result again.") from None


def _number(text: str) -> float | None:
    return float(text) if text else None
