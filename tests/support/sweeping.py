"""Sweeps of a grid with changed keys, as tests ask for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from plushsense.dataset.store import Dataset
from plushsense.experiments.sweep.results import SweepResult
from plushsense.experiments.sweep.run_sweep import SweepProgress, SweepSpec
from plushsense.experiments.sweep.run_sweep import sweep as sweep_spec

_WHERE = ("out", "overwrite", "workers", "cluster")


def sweep(
    dataset: Dataset | Path,
    grid: str = "paper",
    *,
    progress: Callable[[SweepProgress], None] | None = None,
    **options: Any,
) -> SweepResult:
    """Sweep a grid; ``options`` are fields of `SweepSpec` and new values of the grid's keys."""
    where = {key: options.pop(key) for key in _WHERE if key in options}
    return sweep_spec(dataset, SweepSpec(grid, options, **where), progress=progress)


def keys(**values: str) -> list[str]:
    """Return the words of the command line that change keys of a grid."""
    return [word for key, value in values.items() for word in ("--set", f"{key}={value}")]
