"""What was found out so far: evaluations, sweeps, searches and trained bundles, as rows of one table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from plushsense.apps.reporting import PREDICTIONS, SCORES
from plushsense.apps.studio.house import House
from plushsense.apps.studio.result_rows import EVALUATION, TRIAL, Row, of_bundle, of_evaluation, of_trials, read_json
from plushsense.apps.sweep_tables import SUMMARY as SWEEP
from plushsense.apps.sweep_tables import TRIALS_CSV
from plushsense.core.errors import BadInput, PlushSenseError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import HEAD, DatasetHead
from plushsense.evaluation.predictions import Predictions, read_predictions
from plushsense.models.bundle import Bundle

T = TypeVar("T")


class Confusion(NamedTuple):
    """``counts[i][j]``: windows of ``labels[i]`` read as ``labels[j]``."""

    labels: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class Details:
    """What a row opens to. ``clickable``: whether the single predictions are there."""

    row: Row
    by_gesture: Confusion | None = None
    by_affect: Confusion | None = None
    affects: dict[str, str | None] = field(default_factory=dict)
    people: tuple[dict[str, Any], ...] = ()
    clickable: bool = False
    facts: dict[str, Any] = field(default_factory=dict)


class Misread(NamedTuple):
    """A recording in a cell: ``windows`` of its ``of`` windows were read so."""

    recording: str
    subject: str
    gesture: str
    predicted: tuple[str, ...]
    windows: int
    of: int


@dataclass(frozen=True)
class DataFacts:
    """What stands beside a data set's name."""

    name: str
    people: int
    recordings: int
    gestures: tuple[str, ...]
    streams: int
    simulated: bool


class Results:
    """All results in a house, each file read once until it changes. Called from worker threads."""

    def __init__(self, house: House) -> None:
        self._house = house
        self._read: dict[tuple[str, Path], tuple[Any, Any]] = {}

    def rows(self) -> list[Row]:
        """Every result, the newest first. What cannot be read is left out."""
        return sorted(self._rows(), key=lambda row: -row.when_s)

    def _rows(self) -> Iterator[Row]:
        for dataset in self._house.datasets():
            for folder in sorted((dataset / "evaluations").glob("*/")):
                for name, read in ((SCORES, of_evaluation), (TRIALS_CSV, of_trials)):
                    path = folder / name
                    if path.is_file():
                        yield from self._once(path, read, dataset) or ()
        known = self._known()
        for path in self._house.bundles():
            yield from self._once(path, of_bundle, known) or ()

    def _known(self) -> dict[str, str]:
        """The data sets by name, to know those of bundles again."""
        return {self._house.title(path): str(path) for path in reversed(self._house.datasets())}

    def row(self, identity: str) -> Row:
        """One row.

        Raises:
            BadInput: where it is gone.
        """
        for row in self._rows():
            if row.id == identity:
                return row
        raise BadInput("This result is no longer there: its folder was moved or deleted.")

    def details(self, row: Row) -> Details:
        """What the row opens to.

        Raises:
            PlushSenseError: where its files cannot be read.
        """
        if row.kind == EVALUATION:
            table = read_json(row.path / SCORES)
            affects = {one["label"]: one["affect"] for one in table["per_class"]}
            return Details(
                row,
                _confusion(table["confusion"]),
                _confusion(table["confusion_affect"]),
                affects,
                tuple(table["subjects"]),
                (row.path / PREDICTIONS).is_file(),
                {"code_version": table["code_version"], "hash": table["dataset"]["hash"]},
            )
        if row.kind == TRIAL:
            table = read_json(row.path / SWEEP)
            counts = table.get("confusions", {}).get(row.trial)
            affects = dict(zip(table["labels"], table["affects"], strict=True))
            if counts is None:
                return Details(row, affects=affects)
            by_gesture = _confusion({"labels": table["labels"], "counts": counts})
            return Details(row, by_gesture, grouped(by_gesture, affects), affects)
        bundle = Bundle.load(row.path)
        kept = bundle.provenance
        affects = {g.label: g.affect for g in bundle.gestures.gestures}
        return Details(row, affects=affects, facts={**kept, "fitted": bundle.decision.get("fitted")})

    def misread(self, row: Row, truth: Sequence[str], predicted: Sequence[str]) -> list[Misread]:
        """The recordings of a cell: those of the gestures ``truth`` with a window read as one of ``predicted``.

        The most windows first.

        Raises:
            MissingExtraError: without polars; BadInput: where the predictions are gone.
        """
        found = self._once(row.path / PREDICTIONS, lambda path, _: read_predictions(path), None, refuse=True)
        assert isinstance(found, Predictions)
        return in_cell(found, truth, predicted)

    def facts(self, dataset: Path) -> DataFacts:
        """Counts of a data set.

        Raises:
            PlushSenseError: where it is none, or gone.
        """
        seen = tuple(_stamp(dataset / name) for name in (HEAD, "recordings.csv", MARKS))
        key = ("facts", dataset)
        if key not in self._read or self._read[key][0] != seen:
            data = open_dataset(dataset)
            people = {r.subject for r in data.used} & set(data.subjects)
            made = {r.gesture for r in data.used}
            labels = tuple(label for label in data.gestures.labels if label in made)
            told = DataFacts(
                data.head.name, len(people), len(data.used), labels, len(data.streams), data.head.simulated
            )
            # Opening may have renewed the index.
            seen = tuple(_stamp(dataset / name) for name in (HEAD, "recordings.csv", MARKS))
            self._read[key] = (seen, told)
        found: DataFacts = self._read[key][1]
        return found

    def is_simulated(self, dataset: Path) -> bool:
        """Whether a data set's recordings are a virtual toy's."""
        try:
            return DatasetHead.read(dataset).simulated
        except PlushSenseError:
            return False

    def _once(self, path: Path, read: Callable[[Path, Any], T], more: Any, refuse: bool = False) -> T | None:
        key, stamp = (read.__name__, path), (_stamp(path), repr(more))
        held = self._read.get(key)
        if held is None or held[0] != stamp:
            try:
                held = (stamp, read(path, more))
            except (PlushSenseError, OSError, KeyError, ValueError, TypeError):
                if refuse:
                    raise
                held = (stamp, None)
            self._read[key] = held
        found: T | None = held[1]
        return found


def in_cell(predictions: Predictions, truth: Sequence[str], predicted: Sequence[str]) -> list[Misread]:
    """The recordings with a window of ``truth`` that was read as one of ``predicted``, the most windows first."""
    labels = np.array(predictions.labels, dtype=np.str_)
    said, was = labels[predictions.predicted], labels[predictions.truth]
    inside = np.isin(was, list(truth)) & np.isin(said, list(predicted))
    found = []
    for recording in np.unique(predictions.recording[inside]).tolist():
        mine = predictions.recording == recording
        hits = mine & inside
        first = int(np.flatnonzero(hits)[0])
        names, counts = np.unique(said[hits], return_counts=True)
        found.append(
            Misread(
                recording,
                str(predictions.subject[first]),
                str(was[first]),
                tuple(names[np.argsort(-counts, kind="stable")].tolist()),
                int(hits.sum()),
                int(mine.sum()),
            )
        )
    return sorted(found, key=lambda one: (-one.windows, one.recording))


def grouped(confusion: Confusion, affects: Mapping[str, str | None]) -> Confusion:
    """A confusion by gesture, summed by affect."""
    of = [affects.get(label) or "none" for label in confusion.labels]
    names = tuple(dict.fromkeys(of))
    counts = np.zeros((len(names), len(names)), dtype=np.int64)
    for i, row in enumerate(confusion.counts):
        for j, n in enumerate(row):
            counts[names.index(of[i]), names.index(of[j])] += n
    return Confusion(names, tuple(tuple(map(int, row)) for row in counts))


def _confusion(table: Mapping[str, Any]) -> Confusion:
    return Confusion(
        tuple(label or "none" for label in table["labels"]), tuple(tuple(map(int, row)) for row in table["counts"])
    )


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        stat = path.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_size
