"""Read stored results of evaluations, sweeps, searches and trainings as rows of one table."""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from markupsafe import Markup

from plushsense.core.errors import BadInput, PlushSenseError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import MARKS
from plushsense.dataset.store import HEAD
from plushsense.evaluation.scores import Predictions, read_predictions
from plushsense.experiments.sweep.folder import SUMMARY as SWEEP
from plushsense.experiments.sweep.folder import TRIALS_CSV, prediction_files
from plushsense.experiments.sweep.grid import GRID_TRAINING
from plushsense.models.bundle import Bundle, known_people
from plushsense.scoring import metrics
from plushsense.studio.app.shell import AFFECT_SIGNS
from plushsense.studio.app.words import Texts, Words, in_context
from plushsense.studio.app.workspace import Workspace, file_stamps
from plushsense.windows.cut import ANYWHERE
from plushsense.workflow.preparation import WHOLE_PEOPLE
from plushsense.workflow.reporting import LEARNING, PAGE, PREDICTIONS, SCORES, load_evaluation

_OVER: Texts = {"trainings": "{n} (folds × seeds)", "held_back": "{n} held back"}
_MARKS: Texts = {"simulation": "simulation", "leaky": "leaky"}
_SPLITS: Texts = {
    "leave-one-subject-out": "each person left out",
    "by-subject": "people in {k} groups",
    "by-recording": "recordings in {k} groups, known people",
    "windows": "windows in {k} groups",
    "windows:holdout": "15 % of the windows",
    "validation-subjects": "people held back",
    "validation-recordings": "recordings held back, known people",
    "personal": "adapted to one person",
}

_CONTEXTS: Texts = {
    "stream": "real past",
    "rest": "rest before the gesture",
    "loop": "repeated gesture",
    "rows": "repeated rows",
    "anywhere": "for live use",
    "inside": "within the gesture",
}


def figure(words: Words, value: float | None) -> str:
    """Format a score with three decimal places, or as a dash if it is None."""
    return "–" if value is None else words.number(value, 3)


def score_text(words: Words, mean: float | None, sd: float | None) -> str:
    """Format a mean and standard deviation, as in ``0.573 ± 0.120``."""
    return figure(words, mean) + ("" if mean is None or sd is None else f" ± {figure(words, sd)}")


def counted(words: Words, kind: str, n: int) -> str:
    """Return a number with its noun in the right form, such as 5 folds, or 21 cilvēks."""
    return words(_COUNTS[kind], n=n)


def duration_text(words: Words, seconds: float) -> str:
    """Describe a duration in words, in minutes or hours."""
    if seconds < 60:
        return words("under a minute")
    minutes = round(seconds / 60)
    if minutes < 90:
        return words("about {n} min", n=minutes)
    return words("about {h} h {n} min", h=minutes // 60, n=minutes % 60)


def leaky_warning(words: Words) -> str:
    """Return the warning about a score of a leaky split."""
    return words(
        "Leaky: parts of one recording are on both sides of this split, so the score is too good. Never report it as "
        "the score for new people."
    )


def score_labels(words: Words, leaky: bool, simulated: bool) -> Markup:
    """Render the labels *simulation* and *leaky* if they apply to a score."""
    kinds = [kind for kind, true in (("simulation", simulated), ("leaky", leaky)) if true]
    mark = Markup('<span class="ps-mark ps-mark-{}">{}</span>')
    return Markup(" ").join(mark.format(kind, words(_MARKS[kind])) for kind in kinds)


def averaged_over(words: Words, kind: str, units: int) -> str:
    """Describe over what a mean was computed, such as 5 folds."""
    return words(_OVER.get(kind, "{n}"), n=counted(words, _UNITS[kind], units))


def split_text(words: Words, split: str) -> str:
    """Describe in a few words how people, recordings or windows were left out."""
    kind, _, k = split.partition(":")
    text = _SPLITS.get(split) or _SPLITS.get(kind)
    return words(text, k=k) if text else split


def context_text(words: Words, context: str) -> str:
    """Describe what comes before the scored gestures, and before those to train on if that differs."""
    return " → ".join(words(_CONTEXTS.get(part, part)) for part in context.split(" → "))


EVALUATION, TRIAL, TRAINING = "evaluation", "trial", "training"
PERSONAL = "personal"
"""Split of a network that is adapted to a person: nothing was tested on others."""
SUBJECTS, FOLDS, TRAININGS, HELD_BACK = "subjects", "folds", "trainings", "held_back"
_COUNTS: Texts = {
    "people": "{n:person}",
    "with_people": in_context("dative", "{n:person}"),
    "more_people": "{n:more person}",
    "recordings": "{n:recording}",
    "gestures": "{n:gesture}",
    "folds": "{n:fold}",
    "trainings": "{n:training}",
    "networks": "{n:network}",
    "epochs": "{n:epoch}",
    "minutes": "{n:minute}",
}
_UNITS = {SUBJECTS: "people", FOLDS: "folds", TRAININGS: "trainings", HELD_BACK: "people"}
_HASH = 6
# 97.5th percentile of the normal distribution.
_Z95 = 1.959964
# Limits of results that are read: a folder of results may come from elsewhere.
_MOST_BYTES, _MOST_LABELS, _LONGEST_TEXT, _LAST_S = 1 << 26, 256, 1000, 1e11
_READ_ERRORS = (
    OSError, KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError, OverflowError, csv.Error,
)  # fmt: skip


@dataclass(frozen=True)
class ResultRow:
    """A row of the table of results.

    Attributes:
        kind: `EVALUATION`, `TRIAL` (of a sweep or search) or `TRAINING`.
        path: folder of the evaluation or sweep, or path of the bundle.
        trial: number within a sweep, or "".
        dataset: folder of the data set, "" if it is not in this studio; ``data`` is its name.
        spread: over what mean and standard deviation are computed: ``units`` of `SUBJECTS`, `FOLDS` or `TRAININGS`
            (folds times seeds), or for a single training the people `HELD_BACK`.
        macs: number of multiply-accumulate operations per decision, every 50 ms.
        when_s: time of the result, in seconds since 1970.
        classes: number of gestures that the network tells apart.
        chance: accuracy of guessing: one of the gestures, or always the most frequent one if rest is counted.
        interval: 95 % interval of the mean accuracy, see `score_interval`.
        people: accuracy of each person of an evaluation.
        rest: accuracy of recordings at rest if they are scored apart, as where whole people are left out.
        learning: see `plushsense.workflow.learning.learning_curve`.
        apart: further values that are equal in comparable results: hash of the data set, classes, held-back people.
        settings: hash of the data set and all settings of the training; equal for a network and its evaluation.
        proof: folder of the evaluation that gives the score; None if it is that of a training or a trial.
        bundle: the network, of an evaluation the newest one with its settings; None if there is none.
    """

    id: str
    kind: str
    path: Path
    trial: str
    dataset: str
    data: str
    network: str
    schedule: str
    split: str
    context: str
    leaky: bool
    simulated: bool
    seeds: str
    spread: str
    units: int
    accuracy: float | None
    accuracy_sd: float | None
    macro_f1: float | None
    macro_f1_sd: float | None
    parameters: int
    macs: int
    when_s: float
    apart: tuple[str, ...] = ()
    classes: int = 0
    chance: float = 0.0
    interval: tuple[float, float] | None = None
    people: tuple[tuple[str, float | None], ...] = ()
    rest: float | None = None
    learning: dict[str, Any] | None = None
    settings: str = ""
    proof: Path | None = None
    bundle: Path | None = None

    @property
    def usable(self) -> bool:
        """Return whether the network may be recommended.

        The lower end of the 95 % interval of its accuracy is above guessing, also as pages print both: with one decimal
        place, of ten. A leaky score is never enough.
        """
        return (
            not self.leaky
            and self.interval is not None
            and round(10 * self.interval[0], 1) > round(10 * self.chance, 1)
        )

    @property
    def untested(self) -> bool:
        """Return whether this is a network for everybody without a score, as one that was stopped before its test."""
        return self.kind == TRAINING and self.accuracy is None and self.split != PERSONAL

    @property
    def subject_independent(self) -> bool:
        """Return whether the people of the test are others than those of the training."""
        return self.split.startswith(("leave-one-subject-out", "by-subject", WHOLE_PEOPLE))

    @property
    def has_subject_scores(self) -> bool:
        """Return whether an evaluation scored several people one by one, who are not those of the training."""
        return self.proof is not None and self.subject_independent and len(self.people) > 1

    def __post_init__(self) -> None:
        """Raise ValueError if a value, which a file may have given, has another type or range."""
        people = dict(self.people)
        texts = (self.data, self.network, self.schedule, self.split, self.context, self.seeds, *self.apart, *people)
        scores = (self.accuracy, self.accuracy_sd, self.macro_f1, self.macro_f1_sd, self.rest, self.chance)
        shares = (*scores, *people.values())
        counts = (self.units, self.macs, self.classes, self.parameters - 1)
        right = all(isinstance(text, str) and len(text) <= _LONGEST_TEXT for text in texts)
        right &= all(value is None or (_is_number(value) and 0.0 <= value <= 1.0) for value in shares)
        right &= all(isinstance(n, int) and 0 <= n < 1 << 53 for n in counts)
        right &= 0.0 <= self.when_s < _LAST_S
        right &= self.interval is None or (len(self.interval) == 2 and all(map(_is_number, self.interval)))
        if self.learning is not None and self.learning.get("ci95") is not None:
            low, high = self.learning["ci95"]
            right &= all(map(_is_number, (low, high, self.learning["gain"]))) and isinstance(self.learning["more"], int)
        if not right:
            raise ValueError("a value of another type or range")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def score_interval(accuracy: Any, trials: float, over_people: Any = None) -> tuple[float, float] | None:
    """Return the 95 % interval of an accuracy; None if nothing was tested.

    It is the wider one, at each end, of Wilson's interval for ``trials`` independent answers, and of the interval over
    people or folds, which is too narrow, or a single point, if there are few of them.
    """
    if accuracy is None or trials < 1.0:
        return None
    z2 = _Z95**2
    middle = (accuracy + z2 / (2.0 * trials)) / (1.0 + z2 / trials)
    half = _Z95 * math.sqrt(accuracy * (1.0 - accuracy) / trials + z2 / (4.0 * trials**2)) / (1.0 + z2 / trials)
    low, high = over_people or (middle, middle)
    return max(0.0, min(low, middle - half)), min(1.0, max(high, middle + half))


def _settings(hash_: object, context: object, preset: object, training: Mapping[str, Any], network: object) -> str:
    """Return a text for the data and the settings of a training, without those of the computer."""
    how = sorted((key, value) for key, value in training.items() if key not in ("device", "threads"))
    return repr((hash_, context, preset, how, network))


def of_evaluation(path: Path, dataset: Any) -> list[ResultRow]:
    """Read the result in the scores file ``path`` of an evaluation, as a list of one row."""
    table = load_evaluation(path)
    model, config = table["model"], table["config"]
    training = config["training"]
    context = table["context"]
    if table["train_context"] != context:
        context = f"{table['train_context']} → {context}"
    units = len(table[table["over"]])
    accuracy, apart = table["accuracy"], table["over"] == SUBJECTS
    classes, support = len(table["per_class"]), [one["support"] for one in table["per_class"]]
    people = table["subjects"]
    # Recordings at rest, of which there are more, are scored apart where people are left out.
    recordings = sum(one["recordings"] for one in people) if apart else table["by_recording"]["recordings"]
    network = (model["symbol"], *model["filters"], model["padding"], model.get("norm"), model.get("pooling", "mean"))
    # The context that was asked for, as a bundle states it; without streams, another one is used.
    asked = config["evaluation"]["train_context"] or config["windows"]["context"]
    return [
        ResultRow(
            str(path.parent),
            EVALUATION,
            path.parent,
            "",
            str(dataset),
            table["dataset"]["name"],
            f"{model['symbol']} {'/'.join(map(str, model['filters']))} {model['padding']}",
            f"{config['preset']}, {training['epochs']}",
            table["split"],
            context,
            bool(table["leaky"]),
            bool(table["simulated"]),
            ", ".join(map(str, table["seeds"])),
            SUBJECTS if apart else FOLDS,
            units,
            accuracy["mean"],
            accuracy["sd"],
            table["macro_f1"]["mean"],
            table["macro_f1"]["sd"],
            model["parameters"],
            model["macs_per_step"],
            path.stat().st_mtime,
            (str(table["dataset"]["hash"])[:_HASH], *(str(one["label"]) for one in table["per_class"])),
            classes,
            1 / classes if apart else max(support) / max(1, sum(support)),
            score_interval(accuracy["mean"], recordings, accuracy["ci95"]),
            tuple((one["subject"], one["accuracy"]) for one in people),
            _rest(table["nobody"], apart),
            table["learning"],
            _settings(table["dataset"]["hash"], asked, config["preset"], training, network),
            path.parent,
        )
    ]


def of_trials(path: Path, dataset: Any) -> list[ResultRow]:
    """Read the results of finished trials of a sweep or search from the CSV file ``path``."""
    folder = path.parent
    table = read_json(folder / SWEEP)
    grid, when = table["grid"], path.stat().st_mtime
    seeds = ", ".join(map(str, grid["seeds"]))
    apart = (str(table.get("dataset_hash", ""))[:_HASH], *map(str, table.get("labels", ())))
    rows = []
    with path.open(encoding="utf-8", newline="") as file:
        for trial in csv.DictReader(file):
            if trial["status"] != "done" or not trial["accuracy"]:
                continue
            rows.append(
                ResultRow(
                    f"{folder}#{trial['trial']}",
                    TRIAL,
                    folder,
                    trial["trial"],
                    str(dataset),
                    table["dataset"],
                    f"{trial['arch']} {trial['filters']} {trial['padding']}",
                    f"{table['preset']}, {trial['epochs']} ({trial['batch_asked']})",
                    trial["split"],
                    table["context"],
                    trial["leaky"] == "true",
                    trial["simulated"] == "true",
                    seeds,
                    *over_trainings(trial),
                    float(trial["accuracy"]),
                    _number(trial["accuracy_sd"]),
                    _number(trial["macro_f1"]),
                    _number(trial["macro_f1_sd"]),
                    int(trial["parameters"]),
                    int(trial["macs_per_step"]),
                    when,
                    apart,
                    len(table["labels"]),
                    1 / len(table["labels"]),
                )
            )
    return rows


def trial_settings(row: ResultRow) -> dict[str, object]:
    """Return the settings with which a trial of a sweep or search was trained, for another training.

    Raises:
        BadInput: if the files of the sweep cannot be read.
    """
    grid = read_json(row.path / SWEEP)["grid"]
    with (row.path / TRIALS_CSV).open(encoding="utf-8", newline="") as file:
        trial = next(each for each in csv.DictReader(file) if each["trial"] == row.trial)
    kept = ("preset", "context", "padding", "norm", "classes", "window_s", "step_s", *GRID_TRAINING)
    settings = {key: grid[key] for key in kept if grid.get(key) is not None}
    network = {"arch": trial["arch"], "filters": trial["filters"].replace("/", ",")}
    return {**settings, **network, "epochs": int(trial["epochs"]), "batch": int(trial["batch"])}


def of_bundle(path: Path, known: Any) -> list[ResultRow]:
    """Read the result stored in a bundle, as a list of one row; ``known`` maps names of data sets to folders."""
    bundle = Bundle.load(path)
    origin = bundle.provenance
    # What is known about a network before it was adapted to a person does not hold for it.
    scores: dict[str, Any] = {"split": PERSONAL} if bundle.personal else origin.get("scores", {})
    arch, training = bundle.arch, origin.get("training", {})
    name = str(origin.get("dataset", "?"))
    split = str(scores.get("split", origin.get("split", "?")))
    context = bundle.windowing.get("context", "?")
    if context == ANYWHERE:
        # As in evaluations, networks trained on any context are scored in the context "stream".
        context = f"{ANYWHERE} → stream"
    held_back = sorted(known_people(origin, ["validation_subjects"]))
    window_s, step_s = (float(bundle.windowing.get(key) or 1.0) for key in ("window_s", "step_s"))
    trials = scores.get("windows", 0) * min(1.0, step_s / window_s)
    network = (arch.symbol, *arch.filters, arch.padding, arch.norm, arch.pooling)
    used = (origin.get("dataset_hash"), bundle.windowing.get("context"), origin.get("preset"), training, network)
    return [
        ResultRow(
            str(path),
            TRAINING,
            path,
            "",
            known.get(name, ""),
            name,
            f"{arch.symbol} {'/'.join(map(str, arch.filters))} {arch.padding}",
            f"{origin.get('preset', '?')}, {training.get('epochs', '?')}",
            split,
            str(context),
            bool(scores.get("leaky")),
            bundle.simulated,
            str(training.get("seed", "?")),
            # Unless whole people were held back, the network was trained on the people it was scored on.
            *((HELD_BACK, len(held_back)) if split == WHOLE_PEOPLE else (TRAININGS, 1)),
            scores.get("accuracy"),
            None,
            scores.get("macro_f1"),
            None,
            arch.parameters,
            arch.macs_per_step,
            path.stat().st_mtime,
            (str(origin.get("dataset_hash", ""))[:_HASH], *bundle.gestures.labels, *held_back),
            len(bundle.gestures),
            1 / len(bundle.gestures),
            # Windows that overlap do not count as independent answers.
            score_interval(scores.get("accuracy"), trials),
            rest=_rest(scores.get("nobody"), split == WHOLE_PEOPLE),
            settings="" if bundle.personal else _settings(*used),
            bundle=path,
        )
    ]


def _proven(row: ResultRow, proof: ResultRow | None) -> ResultRow:
    """Return the result of a network, with the score of the evaluation of its settings if there is one."""
    if proof is None or proof.apart[1:] != row.apart[1 : 1 + row.classes]:
        return row
    return replace(proof, id=row.id, kind=TRAINING, path=row.path, when_s=row.when_s, bundle=row.path)


def _rest(nobody: Mapping[str, Any] | None, apart: bool) -> float | None:
    return nobody.get("accuracy") if nobody and apart else None


def over_trainings(trial: Mapping[str, Any]) -> tuple[str, int]:
    """Return over what the mean of a trial is computed (`FOLDS` or `TRAININGS`), and their number."""
    folds, seeds = int(trial["folds"]), int(trial["seeds"])
    return (FOLDS, folds) if seeds == 1 else (TRAININGS, folds * seeds)


def read_json(path: Path) -> Any:
    """Read a JSON file; raise BadInput if it cannot be read."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise _unreadable(path) from None


def _unreadable(path: Path) -> BadInput:
    return BadInput("The result “{name}” cannot be read. Compute it again.", name=path.parent.name)


def _number(text: str) -> float | None:
    return float(text) if text else None


T = TypeVar("T")


class Confusion(NamedTuple):
    """Confusion matrix: ``counts[i][j]`` windows of ``labels[i]`` were classified as ``labels[j]``."""

    labels: tuple[str, ...]
    counts: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class ResultDetails:
    """Details of a result.

    ``clickable`` is true if the prediction for each window is known, so that the recordings of a cell can be listed;
    ``later`` if it can be computed from the recordings (see `StoredResults.with_predictions`).
    """

    row: ResultRow
    by_gesture: Confusion | None = None
    by_affect: Confusion | None = None
    affects: dict[str, str | None] = field(default_factory=dict)
    people: tuple[dict[str, Any], ...] = ()
    clickable: bool = False
    later: bool = False
    pooled: float | None = None
    report: Path | None = None
    facts: dict[str, Any] = field(default_factory=dict)


class MisreadRecording(NamedTuple):
    """A recording in a cell of a confusion matrix, which contains ``windows`` of its ``of`` windows."""

    recording: str
    subject: str
    gesture: str
    predicted: tuple[str, ...]
    windows: int
    of: int


@dataclass(frozen=True)
class DatasetCounts:
    """Counts of a data set, without excluded recordings; ``once`` are the gestures with a single recording."""

    people: int
    recordings: int
    gestures: tuple[str, ...]
    once: tuple[str, ...]
    streams: int
    simulated: bool


def recommended(networks: Mapping[Path, ResultRow], to_try: bool = False) -> str:
    """Return the path of the newest of `StoredResults.networks` that may be recommended, or "".

    With ``to_try``, that of the newest one that nobody has tested takes its place if there is none.
    """
    usable = (str(path) for path, row in networks.items() if row.usable)
    return next(usable, next((str(path) for path, row in networks.items() if to_try and row.untested), ""))


class StoredResults:
    """Service that reads the results of a workspace and caches each file until it changes; call it in a thread."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._read: dict[tuple[str, Path], tuple[Any, Any]] = {}

    def rows(self) -> list[ResultRow]:
        """Return all readable results, newest first.

        A network has the score of its strictest evaluation, if it has any: leave-one-subject-out before other splits by
        people, these before splits of recordings; the newest of equal ones.
        """
        rows = sorted(self._rows(), key=lambda row: -row.when_s)
        proofs: dict[str, ResultRow] = {}
        for row in sorted(
            rows, key=lambda row: (row.subject_independent, row.split.startswith("leave-one"), row.when_s)
        ):
            if row.kind == EVALUATION and not row.leaky:
                proofs[row.settings] = row
        bundles = {row.settings: row.path for row in reversed(rows) if row.kind == TRAINING}
        return [
            _proven(row, proofs.get(row.settings))
            if row.kind == TRAINING
            else replace(row, bundle=bundles.get(row.settings) if row.settings else None)
            for row in rows
        ]

    def comparable(self, row: ResultRow) -> list[ResultRow]:
        """Return the other evaluations that can be compared with that of ``row`` person by person."""
        return [
            other
            for other in self.rows()
            if other.kind == EVALUATION
            and other.proof != row.proof
            and other.has_subject_scores
            and row.has_subject_scores
            if (other.apart, other.context.split()[-1]) == (row.apart, row.context.split()[-1])
        ]

    def networks(self) -> dict[Path, ResultRow]:
        """Return the result of each readable bundle, the newest first."""
        return {row.path: row for row in self.rows() if row.kind == TRAINING}

    def _rows(self) -> Iterator[ResultRow]:
        for dataset in self._workspace.datasets():
            for folder in sorted((dataset / "evaluations").glob("*/")):
                for name, read in ((SCORES, of_evaluation), (TRIALS_CSV, of_trials)):
                    path = folder / name
                    if path.is_file():
                        yield from self._once(path, read, dataset) or ()
        known = {self._workspace.title(path): str(path) for path in reversed(self._workspace.datasets())}
        for path in self._workspace.bundles():
            yield from self._once(path, of_bundle, known) or ()

    def row(self, identity: str) -> ResultRow:
        """Return the result with this id; raise BadInput if there is none."""
        if (found := self.find(identity)) is None:
            raise BadInput("This result does not exist any more: its folder was moved or deleted.")
        return found

    def find(self, identity: str) -> ResultRow | None:
        """Return the result with this id, or None."""
        return next((row for row in self.rows() if row.id == identity), None)

    def details(self, row: ResultRow) -> ResultDetails:
        """Read the details of a result; raise PlushSenseError if its files cannot be read."""
        try:
            return self._details(row)
        except _READ_ERRORS:
            raise _unreadable(row.path / SCORES) from None

    def _details(self, row: ResultRow) -> ResultDetails:
        facts: dict[str, Any] = {}
        if row.kind == TRAINING:
            bundle = Bundle.load(row.path)
            facts = {**bundle.provenance, "fitted": bundle.decision.get("fitted")}
        if row.proof is not None:
            table = read_json(self._inside(row.proof / SCORES))
            affects = _affects((one["label"], one["affect"]) for one in table["per_class"])
            by_affect = _confusion(table["confusion_affect"])
            _affects((label, label) for label in by_affect.labels)
            return ResultDetails(
                row,
                _confusion(table["confusion"]),
                by_affect,
                affects,
                tuple(map(_scores_of_person, table["subjects"])),
                (row.proof / PREDICTIONS).is_file(),
                facts=facts or {"code_version": table["code_version"], "hash": table["dataset"]["hash"]},
                report=report if (report := self._inside(row.proof / PAGE)).is_file() else None,
                pooled=replace(row, accuracy=table["pooled"]["accuracy"]).accuracy,
            )
        if row.kind == TRIAL:
            table = read_json(self._inside(row.path / SWEEP))
            counts = table.get("confusions", {}).get(row.trial)
            affects = _affects(zip(table["labels"], table["affects"], strict=True))
            if counts is None:
                return ResultDetails(row, affects=affects)
            by_gesture = _confusion({"labels": table["labels"], "counts": counts})
            stored = prediction_files(table).get(row.trial, "")
            clickable = bool(stored) and (row.path / stored).is_file()
            return ResultDetails(row, by_gesture, sum_by_affect(by_gesture, affects), affects, clickable=clickable)
        affects = {g.label: g.affect for g in bundle.gestures.gestures}
        later = bool(row.dataset) and row.spread == HELD_BACK
        return ResultDetails(row, affects=affects, facts=facts, later=later)

    def with_predictions(self, details: ResultDetails) -> ResultDetails:
        """Return the details of a training with the confusions of its validation people.

        Raises:
            PlushSenseError: as `plushsense.workflow.api.validation_predictions`.
        """
        predictions = self._predictions(details.row)
        counts = metrics.confusion(predictions.truth, predictions.predicted, len(predictions.labels))
        by_gesture = _confusion({"labels": predictions.labels, "counts": counts.tolist()})
        by_affect = sum_by_affect(by_gesture, details.affects)
        return replace(details, by_gesture=by_gesture, by_affect=by_affect, clickable=True, later=False)

    def _predictions(self, row: ResultRow) -> Predictions:
        if row.kind == TRAINING and row.proof is None:
            dataset = Path(row.dataset)
            key, stamp = ("validation", row.path), file_stamps(row.path, dataset / HEAD, dataset / "recordings.csv")
            cached = self._read.get(key)
            if cached is None or cached[0] != stamp:
                from plushsense.workflow.api import validation_predictions

                cached = self._read[key] = (stamp, validation_predictions(Bundle.load(row.path), dataset))
            predictions: Predictions = cached[1]
            return predictions
        files = prediction_files(read_json(self._inside(row.path / SWEEP))) if row.kind == TRIAL else {}
        file = self._inside((row.proof or row.path) / files.get(row.trial, PREDICTIONS))
        stored = self._once(file, _read_apart, None, refuse=True)
        assert stored is not None
        return stored

    def misread(self, row: ResultRow, truth: Sequence[str], predicted: Sequence[str]) -> list[MisreadRecording]:
        """Return the recordings with windows of ``truth`` classified as ``predicted``, most windows first.

        Raises:
            MissingExtraError: if polars is not installed. BadInput: if the predictions are missing.
        """
        return recordings_of_cell(self._predictions(row), truth, predicted)

    def facts(self, dataset: Path) -> DatasetCounts:
        """Return the counts of a data set, cached until its files change.

        Raises:
            PlushSenseError: if the folder is not a valid data set.
        """
        files = [dataset / name for name in (HEAD, "recordings.csv", MARKS)]
        key = ("facts", dataset)
        if self._read.get(key, (None,))[0] != file_stamps(*files):
            data = open_dataset(dataset)
            people = {r.subject for r in data.used} & set(data.subjects)
            used = Counter(r.gesture for r in data.used)
            labels = tuple(label for label in data.gestures.labels if label in used)
            once = tuple(label for label in labels if used[label] == 1)
            counts = DatasetCounts(len(people), len(data.used), labels, once, len(data.streams), data.head.simulated)
            # Read the time stamps now, because opening the data set may have rewritten the index.
            self._read[key] = (file_stamps(*files), counts)
        found: DatasetCounts = self._read[key][1]
        return found

    def _inside(self, path: Path) -> Path:
        """Return the path of a file; raise PlushSenseError if it leads out of the workspace, or is too large."""
        self._workspace.inside(path)
        if path.is_file() and path.stat().st_size > _MOST_BYTES:
            raise _unreadable(path)
        return path

    def _once(self, path: Path, read: Callable[[Path, Any], T], more: Any, refuse: bool = False) -> T | None:
        """Return ``read(path, more)``, cached until the file changes; return None on errors unless ``refuse``."""
        # A learning curve is written after its evaluation.
        key, stamp = (read.__name__, path), (file_stamps(path, path.with_name(LEARNING)), repr(more))
        cached = self._read.get(key)
        if cached is None or cached[0] != stamp:
            try:
                cached = (stamp, read(self._inside(path), more))
            except (PlushSenseError, *_READ_ERRORS) as cause:
                if refuse:
                    raise cause if isinstance(cause, PlushSenseError) else _unreadable(path) from None
                cached = (stamp, None)
            self._read[key] = cached
        result: T | None = cached[1]
        return result


def _read_apart(path: Path, _: None) -> Predictions:
    """Read stored predictions in a process of its own, because the reader of Parquet takes 45 MB until its end."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(read_predictions, path).result()


def recordings_of_cell(
    predictions: Predictions, truth: Sequence[str], predicted: Sequence[str]
) -> list[MisreadRecording]:
    """Return the recordings with windows of ``truth`` classified as ``predicted``, most windows first."""
    labels = np.array(predictions.labels, dtype=np.str_)
    answers, gestures = labels[predictions.predicted], labels[predictions.truth]
    inside = np.isin(gestures, list(truth)) & np.isin(answers, list(predicted))
    rows = []
    for recording in np.unique(predictions.recording[inside]).tolist():
        mine = predictions.recording == recording
        hits = mine & inside
        first = int(np.flatnonzero(hits)[0])
        names, counts = np.unique(answers[hits], return_counts=True)
        rows.append(
            MisreadRecording(
                recording,
                str(predictions.subject[first]),
                str(gestures[first]),
                tuple(names[np.argsort(-counts, kind="stable")].tolist()),
                int(hits.sum()),
                int(mine.sum()),
            )
        )
    return sorted(rows, key=lambda row: (-row.windows, row.recording))


def sum_by_affect(confusion: Confusion, affects: Mapping[str, str | None]) -> Confusion:
    """Combine the gestures of a confusion matrix into affects."""
    of = [affects.get(label) or "none" for label in confusion.labels]
    names, counts = metrics.grouped(np.array(confusion.counts, dtype=np.int64), of)
    return Confusion(names, tuple(tuple(map(int, row)) for row in counts))


def _confusion(table: Mapping[str, Any]) -> Confusion:
    labels = tuple(str(label or "none") for label in table["labels"])
    counts = tuple(tuple(map(int, row)) for row in table["counts"])
    square = len(labels) <= _MOST_LABELS and {len(counts), *map(len, counts)} <= {len(labels)}
    if not square or any(n < 0 for row in counts for n in row):
        raise ValueError("a confusion matrix of another size, or with negative counts")
    return Confusion(labels, counts)


def _affects(pairs: Iterable[tuple[Any, Any]]) -> dict[str, str | None]:
    """Return affects by gesture; raise ValueError for one that does not exist."""
    affects = {str(label): affect for label, affect in pairs}
    if not {affect or "none" for affect in affects.values()} <= AFFECT_SIGNS.keys():
        raise ValueError("an affect that does not exist")
    return affects


def _scores_of_person(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scores of a person that are displayed; raise ValueError for one of another type."""
    scores = {key: given[key] for key in ("accuracy", "macro_f1", "by_recording_accuracy")}
    if not all(value is None or _is_number(value) for value in scores.values()):
        raise ValueError("a score that is no number")
    return scores | {"subject": str(given["subject"]), **{key: int(given[key]) for key in ("recordings", "windows")}}
