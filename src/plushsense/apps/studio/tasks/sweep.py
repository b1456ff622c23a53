"""Train and score all networks of a grid, as ``plushsense sweep`` does; ``dry``: only what it would take.

dataset      path
grid         "paper", or the path of a TOML file
changes      keys of the grid, as the command's options: split, epochs, seeds, …
"""

from __future__ import annotations

from typing import Any

from plushsense.apps.studio.tasks.telling import Clock
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """``out`` and the summary's main figures; of a dry run what `plushsense.apps.sweeping.preview` says."""
    from plushsense.apps.sweeping import preview, sweep

    changes = dict(spec.get("changes", {}))
    if spec.get("dry"):
        return preview(spec["dataset"], spec["grid"], measure=True, warn=tell.warn, **changes)
    tell.progress(stage="reading", share=0.0)
    clock = Clock()

    def training(at: Any) -> None:
        best = at.best and {key: at.best[key] for key in ("arch", "filters", "accuracy", "macro_f1")}
        where = {"done": at.done, "trainings": at.trainings, "resumed": at.resumed, "what": at.what}
        tell.progress(stage="training", epoch=at.epoch, epochs=at.epochs, best=best, **where, **clock.at(at.share))

    found = sweep(spec["dataset"], spec["grid"], progress=training, warn=tell.warn, **changes)
    s = found.summary
    for lost in s["failed"]:
        tell.warn(f"{lost['arch']} with {lost['filters']} was given up: {lost['why']}")
    keys = ("name", "split", "leaky", "context", "simulated", "trials", "done", "trainings_lost", "best", "seconds")
    return {"out": str(found.out), **{key: s[key] for key in keys}}
