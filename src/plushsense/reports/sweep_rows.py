"""A table of a sweep: raw values with their columns, as text for a page and as CSV."""

from __future__ import annotations

import csv
import io
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from plushsense.reports.sweep_results import Row, Sweep
from plushsense.reports.words import DASH, count, number, text

Kind = Literal["text", "count", "percent", "share"]


@dataclass(frozen=True)
class Column:
    """``score`` says that the values depend on the split, and bear its mark."""

    key: str
    head: str
    kind: Kind = "text"
    score: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of raw values; a missing one is None."""

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    shown: int | None = None

    def cells(self) -> list[list[str]]:
        """The rows as finished text."""
        return [[_cell(row.get(c.key), c.kind) for c in self.columns] for row in self.rows[: self.shown]]

    def csv(self, sweep: Sweep) -> str:
        """All rows with raw values, and in each what the scores are of."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*(c.key for c in self.columns), "dataset", "split", "leaky", "simulated"])
        said = [sweep.head.get("dataset"), sweep.head.get("split"), yes(sweep.leaky), yes(sweep.simulated)]
        writer.writerows(
            [*("" if row.get(c.key) is None else row[c.key] for c in self.columns), *said] for row in self.rows
        )
        return out.getvalue()


def yes(flag: bool) -> str:
    return "yes" if flag else "no"


def _cell(value: Any, kind: Kind) -> str:
    if kind == "text":
        return text(value)
    if kind == "count":
        return count(value)
    if kind == "percent":
        return DASH if number(value) == DASH else f"{number(100 * value, 1)} %"
    return number(value)


def schedule(trial: Row) -> str:
    """``250, 64``: epochs and batch of a trial."""
    return f"{trial['epochs']}, {trial['batch_asked']}"


def name_of(trial: Row) -> str:
    return f"{trial['arch']} {trial['filters']}, {trial['epochs']} epochs, batch {trial['batch_asked']}"


def spread(values: Sequence[float]) -> float | None:
    """Standard deviation (n − 1); None for fewer than two."""
    return statistics.stdev(values) if len(values) > 1 else None
