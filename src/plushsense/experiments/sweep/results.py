"""Read the results folder of a sweep, which may still be running, for tables and figures."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, need
from plushsense.experiments.sweep.folder import BEST, CURVES, RUNS, SUMMARY, TRIALS, prediction_files
from plushsense.experiments.sweep.trials import listed_columns
from plushsense.reports.table import Row, Table

_NEEDED = ("trial", "arch", "filters", "filter_set", "epochs", "batch_asked", "parameters", "accuracy", "macro_f1")


def finite(value: Any) -> bool:
    """Return whether a cell holds a finite number, which it does not before the trial has a score."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def scored(trial: Row, measure: str = "accuracy") -> bool:
    """Return whether a trial is complete and has the score ``measure``; partial trials cannot be compared."""
    return finite(trial.get(measure)) and trial.get("status", "done") == "done"


@dataclass(frozen=True)
class SweepNetwork:
    """One architecture with one filter set; its trials differ only in epochs and batch."""

    label: str
    arch: str
    filters: str
    filter_set: str
    parameters: int
    trials: tuple[Row, ...]

    @property
    def done(self) -> list[Row]:
        return [t for t in self.trials if scored(t)]

    def best(self, measure: str = "accuracy") -> Row | None:
        """Return the trial with the highest value of ``measure``; of equal ones the first of the grid."""
        there = [t for t in self.trials if scored(t, measure)]
        return max(there, key=lambda t: float(t[measure])) if there else None

    def mean(self, measure: str = "accuracy") -> float | None:
        there = [float(t[measure]) for t in self.trials if scored(t, measure)]
        return sum(there) / len(there) if there else None


@dataclass(frozen=True)
class SweepResult:
    """The results of a sweep, which may still be running, as its folder ``out`` has them.

    ``head`` is the content of sweep.json; ``rows`` and ``run_rows`` are the rows of the tables of trials and of runs.
    """

    out: Path
    head: Row
    rows: tuple[Row, ...]
    run_rows: tuple[Row, ...] = ()

    @cached_property
    def networks(self) -> tuple[SweepNetwork, ...]:
        """The networks, in the grid's order."""
        return _networks(self.rows)

    @property
    def trials(self) -> Any:
        """The table of trials, a polars frame with a row for each network, number of epochs and batch."""
        return need("polars", "tables").read_parquet(self.out / TRIALS)

    @property
    def runs(self) -> Any:
        """The table of runs, a polars frame with a row for each trial, seed and fold."""
        return need("polars", "tables").read_parquet(self.out / RUNS)

    @property
    def name(self) -> str:
        return str(self.head.get("name") or self.out.name)

    @property
    def leaky(self) -> bool:
        return bool(self.head.get("leaky"))

    @property
    def simulated(self) -> bool:
        return bool(self.head.get("simulated"))

    @property
    def total(self) -> int:
        """Number of trials, without those that halving dropped."""
        return len(self.rows) - self.dropped

    @property
    def dropped(self) -> int:
        """Number of trials that halving did not train."""
        return sum(trial.get("status") == "dropped" for trial in self.rows)

    @cached_property
    def ranked(self) -> list[Row]:
        """The complete trials, the most accurate first; of equal ones that of the smallest network."""
        return sorted(self.done, key=lambda t: (-float(t["accuracy"]), int(t["parameters"])))

    @property
    def done(self) -> list[Row]:
        """The complete trials, which are ranked, drawn and averaged."""
        return [t for t in self.rows if scored(t)]

    @property
    def archs(self) -> list[str]:
        return list(dict.fromkeys(str(t["arch"]) for t in self.rows))

    @property
    def filter_sets(self) -> list[str]:
        """The filter sets, from the smallest to the largest."""
        return sorted({str(t["filter_set"]) for t in self.rows}, key=lambda s: [int(n) for n in s.split("/")])

    @property
    def labels(self) -> list[str]:
        return [str(label) for label in self.head.get("labels") or ()]

    @property
    def affects(self) -> list[str]:
        """The affect of each class; "none" where the data set has none."""
        affects = [str(a) for a in self.head.get("affects") or ()]
        return affects if len(affects) == len(self.labels) else ["none"] * len(self.labels)

    def confusion(self, trial: str) -> list[list[int]] | None:
        """Return a trial's confusion matrix (K, K) in windows, true classes in rows; None if it was not stored."""
        table = (self.head.get("confusions") or {}).get(trial)
        k = len(self.labels)
        return table if table and k and len(table) == k and all(len(row) == k for row in table) else None

    def histories(self, trial: Row) -> list[list[Row]]:
        """Return the rows of epochs of each run of a trial, only up to its own number of epochs."""
        jobs = {r["run"] for r in self.run_rows if r["trial"] == trial["trial"]}
        path = self.out / CURVES
        if not jobs or not path.exists():
            return []
        polars = need("polars", "tables")
        try:
            # A whole grid has half a million rows, so read only those of the trial.
            mine = polars.scan_parquet(path).filter(
                polars.col("run").is_in(sorted(jobs)) & (polars.col("epoch") <= trial["epochs"])
            )
            parts = mine.sort("epoch").collect().partition_by("run", "seed", "fold", maintain_order=True)
        except (OSError, polars.exceptions.PolarsError) as cause:
            raise _unread(path, cause) from None
        return [part.to_dicts() for part in parts]

    def best_of(self, arch: str, filters: str) -> Row | None:
        """Return the trial of a network with the highest accuracy; None if it has no score."""
        return next((t for t in self.ranked if (t["arch"], t["filters"]) == (arch, filters)), None)

    @property
    def kept(self) -> list[Row]:
        """The trials whose predictions were kept, the most accurate first."""
        files = prediction_files(self.head)
        return [t for t in self.ranked if t["trial"] in files]

    @property
    def best(self) -> Row | None:
        """The trial with the highest test accuracy."""
        return self.ranked[0] if self.ranked else None

    def best_table(self, *, terminal: bool = False) -> Table:
        """Return the table of the `BEST` trials, which the page, the command line and notebooks show."""
        rows = tuple(self.ranked[:BEST])
        columns = tuple(c for c in listed_columns(terminal=terminal) if any(t.get(c.key) is not None for t in rows))
        note = "Ranked on the test part itself, as the paper did: the first of many is flattered by luck."
        marks = {"leaky": self.leaky, "simulated": self.simulated}
        return Table("best-trials", "The best trials", columns, rows, (note,), **marks)

    def __repr__(self) -> str:
        marks = ", leaky" * self.leaky + ", SIMULATION" * self.simulated
        text = f"{len(self.done)} of {self.total} trials of '{self.name}', {self.head.get('split')}{marks}"
        first = f"; best {self.best['arch']} {self.best['filters']}: {self.best['accuracy']:.3f}" if self.best else ""
        return f"SweepResult({text}{first}; {self.out})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.best_table(terminal=True).html()}"


def read_sweep(folder: str | os.PathLike[str]) -> SweepResult:
    """Read the results folder of a sweep.

    Raises:
        BadInput: when there is none, or its files cannot be read or lack what a report needs.
        MissingExtraError: when polars is not installed.
    """
    place = Path(folder)
    try:
        head = json.loads((place / SUMMARY).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(
            f"There is no sweep at '{place}' (no {SUMMARY}): give a folder that  plushsense sweep  wrote."
        ) from None
    except (OSError, ValueError) as cause:
        raise BadInput(
            f"'{place / SUMMARY}' is not a sweep ({cause}): run the sweep again, which rebuilds it."
        ) from None
    if not isinstance(head, dict):
        raise BadInput(f"'{place / SUMMARY}' is not a sweep (no object): run the sweep again to rebuild it.")
    trials = _table(place / TRIALS, needed=_NEEDED)
    return SweepResult(place, head, trials, _table(place / RUNS, missing=True))


def _table(path: Path, needed: Sequence[str] = (), *, missing: bool = False) -> tuple[Row, ...]:
    polars = need("polars", "tables")
    if missing and not path.exists():
        return ()
    try:
        frame = polars.read_parquet(path)
    except (OSError, polars.exceptions.PolarsError) as cause:
        raise _unread(path, cause) from None
    lacks = [name for name in needed if name not in frame.columns]
    if lacks:
        raise BadInput(f"'{path}' lacks the column '{lacks[0]}': run the sweep again, which rebuilds it.")
    return tuple(frame.to_dicts())


def _unread(path: Path, cause: Exception) -> BadInput:
    reason = str(cause).splitlines()[0] if str(cause) else type(cause).__name__
    return BadInput(f"'{path}' cannot be read ({reason}): run the sweep again, which rebuilds it.")


def _networks(trials: Sequence[Row]) -> tuple[SweepNetwork, ...]:
    """Group the trials by network, in the grid's order; labels include padding and norm if these vary."""
    varying = [key for key in ("padding", "norm") if len({t.get(key) for t in trials}) > 1]
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for trial in trials:
        key = (trial["arch"], trial["filters"], trial["filter_set"], *(trial.get(k) for k in varying))
        groups.setdefault(key, []).append(trial)
    return tuple(
        SweepNetwork(
            " ".join(map(str, (arch, *more))), arch, filters, filter_set, int(rows[0]["parameters"]), tuple(rows)
        )
        for (arch, filters, filter_set, *more), rows in groups.items()
    )


def schedule(trial: Row) -> str:
    """Return ``250, 64``: epochs and batch of a trial."""
    return f"{trial['epochs']}, {trial['batch_asked']}"


def name_of(trial: Row) -> str:
    return f"{trial['arch']} {trial['filters']}, {trial['epochs']} epochs, batch {trial['batch_asked']}"


def file_name_of(trial: Row) -> str:
    """Return the part of file names that identifies a trial and names its network."""
    return f"{trial['arch']}-{str(trial['filters']).replace('/', '-')}-{trial['trial']}"


def spread(values: Sequence[float]) -> float | None:
    """Return the standard deviation (n − 1); None for fewer than two values."""
    return statistics.stdev(values) if len(values) > 1 else None
