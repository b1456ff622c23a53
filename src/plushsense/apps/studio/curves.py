"""The curves of running work, from its reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from plushsense.apps.studio.jobs import Job

LOSS, ACCURACY, BEST = "loss", "accuracy", "best"


class Chart(NamedTuple):
    """One plot: ``x`` and a line of the same length for each of ``names``; None is a hole."""

    what: str
    names: tuple[str, ...]
    x: list[float]
    lines: list[list[float | None]]


def charts(job: Job) -> list[Chart]:
    """What can be drawn of a job now: always the same plots for a task, empty at first."""
    if job.task == "train":
        return _of_one(job.reports)
    if job.task == "evaluate":
        return [_by_fold(job.reports, LOSS, "train_loss"), _by_fold(job.reports, ACCURACY, "validation_accuracy")]
    return [_best(job)]


def _of_one(reports: Sequence[dict[str, Any]]) -> list[Chart]:
    rows = {r["epoch"]: r for r in reports if r.get("stage") == "training" and r.get("epoch")}
    x = [float(epoch) for epoch in sorted(rows)]
    return [
        Chart(
            what,
            ("training", "held_back"),
            x,
            [[rows[int(e)].get(f"{part}_{what}") for e in x] for part in ("train", "validation")],
        )
        for what in (LOSS, ACCURACY)
    ]


def _by_fold(reports: Sequence[dict[str, Any]], what: str, key: str) -> Chart:
    folds: dict[str, dict[int, float | None]] = {}
    for r in reports:
        if r.get("epoch") and r.get(key) is not None:
            folds.setdefault(r["fold"], {})[r["epoch"]] = r[key]
    epochs = sorted({epoch for rows in folds.values() for epoch in rows})
    return Chart(
        what, tuple(folds), [float(e) for e in epochs], [[rows.get(e) for e in epochs] for rows in folds.values()]
    )


def _best(job: Job) -> Chart:
    """The best score against the trainings that are done; of a search, after each rung."""
    found: dict[float, float] = {}
    score = "accuracy" if job.task == "sweep" else "macro_f1"
    before = 0
    last = (0, 0)
    for r in job.reports:
        if r.get("best") is None:
            continue
        rung = r.get("rung", 1)
        if rung != last[0]:
            before, last = before + last[1], (rung, 0)
        last = (rung, max(last[1], r.get("done", 0)))
        found[float(before + r.get("done", 0))] = r["best"][score]
    x = sorted(found)
    return Chart(BEST, (score,), x, [[found[at] for at in x]])
