"""Results of analyses, and the saved evaluations that they read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput
from plushsense.core.version import __version__
from plushsense.evaluation.leakage import LeakageResult
from plushsense.evaluation.scores import Predictions, read_predictions
from plushsense.scoring.comparison import PairResult
from plushsense.workflow.reporting import PREDICTIONS, load_evaluation

Scores = Mapping[str, Mapping[str, Any]]
"""The metrics of each person by code."""

_AS_SAVED = ("id", "title", "seeds", "simulated", "split", "leaky", "context", "by_recording")


@dataclass(frozen=True)
class SavedEvaluation:
    """An evaluation read from its folder: settings, predictions, and scores by person.

    ``data`` is the hash of the data set, ``people`` the metrics of each person over windows, ``train_windows`` the mean
    number of training windows of a fold.
    """

    folder: Path
    id: str
    title: str
    parameters: int
    seeds: list[int]
    dataset: str
    data: str
    simulated: bool
    split: str
    leaky: bool
    context: str
    labels: tuple[str, ...]
    people: Scores
    train_windows: int
    by_recording: Mapping[str, Any]
    leakage: LeakageResult
    predictions: Predictions

    @classmethod
    def read(cls, source: str | os.PathLike[str]) -> SavedEvaluation:
        """Read the folder of an evaluation.

        Raises:
            BadInput: for a folder without an evaluation or its predictions, or with one of an older version.
        """
        folder = Path(source)
        table = load_evaluation(folder)
        try:
            return cls(
                folder=folder,
                parameters=table["model"]["parameters"],
                dataset=table["dataset"]["name"],
                data=table["dataset"]["hash"],
                labels=tuple(table["confusion"]["labels"]),
                people={row["subject"]: row for row in table["subjects"]},
                train_windows=round(np.mean([fold["train_windows"] for fold in table["folds"]])),
                predictions=read_predictions(folder / PREDICTIONS),
                leakage=LeakageResult.from_json(table["leakage"]),
                **{key: table[key] for key in _AS_SAVED},
            )
        except (KeyError, TypeError):
            raise BadInput(f"'{folder}' is an evaluation of an older kind: evaluate again.") from None


@dataclass(frozen=True)
class ComparedModel:
    """An evaluation in a comparison, with its place among the others.

    ``scores`` has a summary over people, ``rank`` the mean rank over people, both by metric.
    """

    name: str
    evaluation: SavedEvaluation
    scores: Mapping[str, Mapping[str, Any]]
    rank: Mapping[str, float]
    calibration_error: float

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        e = self.evaluation
        return {
            "name": self.name,
            "title": e.title,
            "parameters": e.parameters,
            "folder": str(e.folder),
            "seeds": e.seeds,
            **self.scores,
            "rank": self.rank,
            "calibration_error": self.calibration_error,
            "split": e.split,
            "leaky": e.leaky,
            "train_windows": e.train_windows,
            "by_recording": e.by_recording,
            "leakage": e.leakage.to_json(),
        }


@dataclass(frozen=True)
class PairedComparisonResult:
    """Evaluations compared person by person.

    Attributes:
        models: the best mean rank first.
        pairs, cliques: by metric, the paired tests, and the models that do not differ significantly.
        people: by person and name of the model, the value of each metric.
        scored: what is compared of each person: "windows", the same ones; "recordings", classified by the vote of their
            windows; or "own", where splits score different recordings.
        context: that of the windows; "inside" if all lie in their recordings.
    """

    models: tuple[ComparedModel, ...]
    pairs: Mapping[str, tuple[PairResult, ...]]
    cliques: Mapping[str, list[tuple[str, ...]]]
    people: Mapping[str, Mapping[str, Mapping[str, float]]]
    scored: str
    context: str
    id: str

    @property
    def splits(self) -> tuple[str, ...]:
        """The different splits of the models."""
        return tuple(dict.fromkeys(model.evaluation.split for model in self.models))

    @property
    def leaky(self) -> bool:
        """Whether any of the evaluations has a leaky split (`plushsense.scoring.splits`)."""
        return any(model.evaluation.leaky for model in self.models)

    @property
    def simulated(self) -> bool:
        """Whether any of the evaluations is of virtual people, so that its scores say nothing about a real toy."""
        return any(model.evaluation.simulated for model in self.models)

    @property
    def dataset(self) -> str:
        """The name of the data set."""
        return self.models[0].evaluation.dataset

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "models": [model.to_json() for model in self.models],
            "pairs": {key: [pair.to_json() for pair in pairs] for key, pairs in self.pairs.items()},
            "cliques": self.cliques,
            "people": [{"subject": person, **scores} for person, scores in self.people.items()],
            "scored": self.scored,
            "split": ", ".join(self.splits),
            "leaky": self.leaky,
            "context": self.context,
            "simulated": self.simulated,
            "dataset": self.dataset,
            "id": self.id,
            "name": " and ".join(sorted(model.name for model in self.models)),
            "code_version": __version__,
        }


@dataclass(frozen=True)
class Grouping:
    """Scores of people with some gestures merged.

    Attributes:
        classes: the number of classes that are left.
        merged: the labels of each group of several gestures.
        largest: the share of the most frequent class in the windows of people.
        scores: the summary of each metric over people.
    """

    classes: int
    merged: tuple[tuple[str, ...], ...]
    largest: float
    scores: dict[str, dict[str, Any]]

    def named(self, joined: str) -> list[str]:
        """Return a name for each merged group, its labels with ``joined`` between them."""
        return [joined.join(group) for group in self.merged]


@dataclass(frozen=True)
class MergeStep:
    """The grouping after some merges; the last merge is described by ``confusion`` and ``people``.

    Attributes:
        crossfitted: as the scores of the grouping, with each person's merges chosen on all other people.
        confusion: the mean over people of the share of windows that the two merged groups exchanged; None before the
            first merge.
        people: the number of people in whom they did.
    """

    grouping: Grouping
    crossfitted: dict[str, dict[str, Any]]
    confusion: float | None
    people: int | None


@dataclass(frozen=True)
class MergeResult:
    """Merges of the gestures of an evaluation.

    Attributes:
        steps: one for each number of merges from 0.
        groupings: by name, the merges named beforehand that apply: nothing is chosen, so nothing is cross-fitted.
        people: the number of people.
        gestures: the file that was written.
    """

    steps: tuple[MergeStep, ...]
    groupings: dict[str, Grouping]
    split: str
    leaky: bool
    simulated: bool
    people: int
    gestures: str | None

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "steps": [
                {
                    "merges": number,
                    **asdict(step.grouping),
                    "confusion": step.confusion,
                    "people": step.people,
                    "crossfitted": step.crossfitted,
                }
                for number, step in enumerate(self.steps)
            ],
            "groupings": [{"name": name, **asdict(grouping)} for name, grouping in self.groupings.items()],
            **{key: getattr(self, key) for key in ("split", "leaky", "simulated", "people", "gestures")},
        }
