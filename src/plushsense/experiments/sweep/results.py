"""Read the results folder of a sweep, which may still be running, for tables and figures."""

from __future__ import annotations

import json
import math
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, need
from plushsense.experiments.sweep.folder import CURVES, RUNS, SUMMARY, TRIALS, prediction_files
from plushsense.reports.table import Row

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
class StoredSweep:
    """The content of a sweep's results folder: ``head`` is sweep.json; the tables are rows."""

    folder: Path
    head: Row
    trials: tuple[Row, ...]
    runs: tuple[Row, ...] = ()
    networks: tuple[SweepNetwork, ...] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "networks", _networks(self.trials))

    @property
    def name(self) -> str:
        return str(self.head.get("name") or self.folder.name)

    @property
    def leaky(self) -> bool:
        return bool(self.head.get("leaky"))

    @property
    def simulated(self) -> bool:
        return bool(self.head.get("simulated"))

    @property
    def total(self) -> int:
        """Number of trials, without those that halving dropped."""
        return len(self.trials) - self.dropped

    @property
    def dropped(self) -> int:
        """Number of trials that halving did not train."""
        return sum(trial.get("status") == "dropped" for trial in self.trials)

    @property
    def done(self) -> list[Row]:
        """The complete trials, which are ranked, drawn and averaged."""
        return [t for t in self.trials if scored(t)]

    @property
    def archs(self) -> list[str]:
        return list(dict.fromkeys(str(t["arch"]) for t in self.trials))

    @property
    def filter_sets(self) -> list[str]:
        """The filter sets, from the smallest to the largest."""
        return sorted({str(t["filter_set"]) for t in self.trials}, key=lambda s: [int(n) for n in s.split("/")])

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
        jobs = sorted({r["run"] for r in self.runs if r["trial"] == trial["trial"]})
        path = self.folder / CURVES
        if not jobs or not path.exists():
            return []
        polars = need("polars", "tables")
        try:
            # A whole grid has half a million rows, so read only those of the trial.
            mine = polars.scan_parquet(path).filter(
                polars.col("run").is_in(jobs) & (polars.col("epoch") <= trial["epochs"])
            )
            rows = mine.sort("epoch").collect().to_dicts()
        except (OSError, polars.exceptions.PolarsError) as cause:
            raise _unread(path, cause) from None
        by_run: dict[tuple[Any, ...], list[Row]] = {}
        for row in rows:
            by_run.setdefault((row["run"], row.get("seed"), row.get("fold")), []).append(row)
        return list(by_run.values())

    def best_of(self, arch: str, filters: str) -> Row | None:
        """Return the trial of a network with the highest accuracy; None if it has no score."""
        mine = [t for t in self.done if (t["arch"], t["filters"]) == (arch, filters)]
        return max(mine, key=lambda t: float(t["accuracy"])) if mine else None

    @property
    def kept(self) -> list[Row]:
        """The trials whose predictions were kept, the most accurate first."""
        files = prediction_files(self.head)
        return sorted((t for t in self.done if t["trial"] in files), key=lambda t: -float(t["accuracy"]))

    @property
    def best(self) -> Row | None:
        """The trial with the highest test accuracy; of equal ones that of the smallest network."""
        return max(self.done, key=lambda t: (float(t["accuracy"]), -int(t["parameters"])), default=None)


def read_sweep(folder: str | os.PathLike[str]) -> StoredSweep:
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
    return StoredSweep(place, head, trials, _table(place / RUNS, missing=True))


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
