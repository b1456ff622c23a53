"""Prove a network on what it was not trained on, as ``plushsense evaluate`` does; ``dry``: only what it would take.

dataset      path
settings     as `plushsense.apps.config.from_settings` takes them
split        as the command's
int8         also score the networks deployed in 8 bits
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from plushsense.apps.config import from_settings
from plushsense.apps.studio.tasks.telling import Clock
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """``out`` (the folder with scores and predictions), ``report`` and the main scores; or what `estimating` says."""
    config = from_settings(**spec.get("settings", {}))
    if spec.get("split"):
        config = replace(config, evaluation=replace(config.evaluation, split=spec["split"]))
    if spec.get("dry"):
        from plushsense.apps.estimating import preview_evaluation

        return preview_evaluation(spec["dataset"], config, warn=tell.warn)
    tell.progress(stage="reading", share=0.0)

    from plushsense.apps.api import evaluate
    from plushsense.apps.cli.evaluate import name_of
    from plushsense.apps.reporting import PAGE, write_report
    from plushsense.dataset.index import open_dataset

    dataset = open_dataset(spec["dataset"])
    out = dataset.path / "evaluations" / name_of(config, dataset)
    clock, running = Clock(), dict[str, float]()

    def fold(at: Any) -> None:
        if at.epoch:
            running[at.fold] = at.epoch / at.epochs
        else:
            running.pop(at.fold, None)
        share = (at.done + sum(running.values())) / at.folds
        row = at.row or {}
        shown = {k: row.get(k) for k in ("train_loss", "validation_loss", "validation_accuracy")}
        where = {"done": at.done, "folds": at.folds, "resumed": at.resumed, "fold": at.fold}
        tell.progress(stage="training", epoch=at.epoch, epochs=at.epochs, **where, **shown, **clock.at(share))

    result = evaluate(dataset, config, out=out, int8=bool(spec.get("int8")), progress=fold, warn=tell.warn)
    report = write_report(out / PAGE, dataset, [out])
    table = result.table
    return {
        "out": str(out),
        "report": str(report),
        "split": result.split.text,
        "leaky": result.split.leaky,
        "context": result.context,
        "simulated": dataset.head.simulated,
        "seeds": result.seeds,
        "over": table["over"],
        "units": len(table[table["over"]]),
        "accuracy": table["accuracy"],
        "macro_f1": table["macro_f1"],
    }
