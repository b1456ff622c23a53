"""Find the best network within limits, as ``plushsense search`` does; ``dry``: only what it would take.

dataset      path
grid         "paper", or the path of a TOML file
asked        of the search: max_parameters, max_state_bytes, max_macs_per_step, share, rungs, …
changes      keys of the grid: split, seeds, …
"""

from __future__ import annotations

from typing import Any

from plushsense.apps.studio.tasks.telling import Clock
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """``out`` and the summary's main figures; of a dry run what `plushsense.apps.searching.preview_search` says."""
    from plushsense.apps.searching import preview_search, search

    asked, changes = dict(spec.get("asked", {})), dict(spec.get("changes", {}))
    if spec.get("dry"):
        return preview_search(spec["dataset"], spec["grid"], asked=asked, changes=changes, measure=True, warn=tell.warn)
    tell.progress(stage="reading", share=0.0)
    clock = Clock()

    def training(at: Any) -> None:
        best = at.best and {"title": at.best[0], "macro_f1": at.best[1]}
        where = {"rung": at.rung, "rungs": at.rungs, "networks": at.networks, "what": at.what}
        where |= {"done": at.done, "trainings": at.trainings, "resumed": at.resumed}
        share = min(1.0, at.share)
        tell.progress(stage="training", epoch=at.epoch, epochs=at.epochs, best=best, **where, **clock.at(share))

    found = search(spec["dataset"], spec["grid"], **asked, progress=training, warn=tell.warn, **changes)
    s = found.summary
    keys = ("name", "split", "leaky", "context", "simulated", "candidates", "winner", "smallest_equal", "seconds")
    return {"out": str(found.out), **{key: s[key] for key in keys}, "command": s["command"]}
