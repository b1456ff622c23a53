"""Adaptation of a bundle to one person, and its effect on people whom the network was not trained on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError, DatasetError, nearest, python_warning
from plushsense.core.files import temporary_folder
from plushsense.dataset.files import CACHE
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import HEAD, Dataset
from plushsense.deploy.quantize import calibration, integer_network, integer_probabilities, refuse_undeployable
from plushsense.evaluation.crossval import context_of, fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import JobsSpec, Report
from plushsense.jobs.study import Progress, StudyPart, StudyResults, run_study
from plushsense.live.adaptation import (
    Personal,
    PersonalSpec,
    RecordingScores,
    judge,
    personalise,
    restore_original,
)
from plushsense.models.bundle import Bundle
from plushsense.scoring import metrics
from plushsense.scoring.splits import Fold, parse_split, purge
from plushsense.windows.cut import WindowSet, whole_gestures
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import Run, Warn, prepare, windows_for
from plushsense.workflow.reporting import journal_of, keep_bundle

Predictor = Callable[[WindowSet], NDArray[np.floating[Any]]]
"""Returns the probabilities (N, K) of windows."""
Predictors = Mapping[str, Predictor]
"""A predictor for each engine, "float" first."""

_SCORES = ("accuracy", "macro_f1")


@dataclass(frozen=True)
class HeldOutPerson:
    """A person with a network that was not trained on them.

    ``adapt`` takes the windows of the recordings to adapt to; it returns the adapted predictors, or None where the
    network stays as it is.
    """

    subject: str
    predictors: Predictors
    adapt: Callable[[WindowSet], Predictors | None]


@dataclass(frozen=True)
class ChoiceSpec:
    """Which recordings a network is adapted to.

    The choices are all sets of ``use`` numbers, the same for all gestures (10 of 5 recordings), where the recordings of
    a gesture are numbered by time; the first choice is the first recordings of each gesture. ``random`` further choices
    are drawn for each gesture on its own, with ``seed``.
    """

    use: int = 2
    random: int = 0
    seed: int = 0


@dataclass(frozen=True)
class PersonGain:
    """What adaptation changed for one person: means over the ``choices``.

    ``right_change`` counts correct recordings, after minus before; ``choices_worse`` the choices that lost more than
    one. ``scores`` has for accuracy and macro-F1 the value ``before`` and ``after``, and the gain of the ``first``
    choice.
    """

    subject: str
    choices: int
    recordings: float
    right_change: float
    right_change_worst: int
    choices_worse: int
    scores: Mapping[str, Mapping[str, float]]

    def to_json(self) -> dict[str, Any]:
        """Return plain values, the scores as keys such as ``accuracy_before``."""
        row = {name: value for name, value in vars(self).items() if name != "scores"}
        return row | {f"{score}_{when}": value for score, at in self.scores.items() for when, value in at.items()}


@dataclass(frozen=True)
class PersonTrial:
    """The outcome of all choices for one person.

    Attributes:
        refused: of each choice, whether the network stayed as it was.
        gains: by engine.
        agreement: of each choice, the share of the windows on which the engines agree, before and after.
    """

    refused: tuple[bool, ...]
    gains: Mapping[str, PersonGain]
    agreement: tuple[tuple[float, float], ...]

    @classmethod
    def from_journal(cls, row: Mapping[str, Any]) -> PersonTrial:
        """Restore what ``asdict`` returned."""
        gains = {name: PersonGain(**gain) for name, gain in row["gains"].items()}
        return cls(tuple(row["refused"]), gains, tuple((one, other) for one, other in row["agreement"]))


@dataclass(frozen=True)
class EngineGains:
    """The gains of one engine over people.

    ``scores``: of accuracy and macro-F1 ``before``, ``after``, ``gain``, and ``first``, the gain of the first choice.
    ``right``: correct recordings after minus before: ``mean``, ``worst_mean`` of a person, ``worst`` of a choice,
    ``worse_people`` (less by more than one on average), ``worse_choices`` (share of choices).
    """

    scores: Mapping[str, Mapping[str, Any]]
    right: Mapping[str, float]
    people: tuple[PersonGain, ...]

    @classmethod
    def over(cls, people: Sequence[PersonGain]) -> EngineGains:
        scores = {}
        for score in _SCORES:
            before, after, first = (
                np.array([row.scores[score][when] for row in people]) for when in ("before", "after", "first")
            )
            scores[score] = {
                "before": metrics.summary(before).to_json(),
                "after": metrics.summary(after).to_json(),
                "gain": metrics.summary(after - before).to_json(),
                "first": metrics.summary(first).to_json(),
            }
        changes = [row.right_change for row in people]
        right = {
            "mean": float(np.mean(changes)),
            "worst_mean": min(changes),
            "worst": min(row.right_change_worst for row in people),
            "worse_people": sum(change < -1 for change in changes),
            "worse_choices": sum(row.choices_worse for row in people) / sum(row.choices for row in people),
        }
        return cls(scores, right, tuple(people))

    def to_json(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {**self.scores, "right": dict(self.right), "people": [row.to_json() for row in self.people]}


@dataclass(frozen=True)
class AdaptationScores:
    """Scores of people before and after adaptation.

    Attributes:
        choices: number of them in all; ``refused``: share of them in which the network stayed as it was.
        agreement: share of the test windows on which the engines agree, before and after; None with one engine.
    """

    context: str
    choice: ChoiceSpec
    choices: int
    refused: float
    engines: Mapping[str, EngineGains]
    agreement: Mapping[str, float] | None

    @classmethod
    def over(cls, context: str, choice: ChoiceSpec, trials: Sequence[PersonTrial]) -> AdaptationScores:
        """Return the scores over the trials of all people.

        Raises:
            BadInput: when nobody has more than ``choice.use`` recordings of a gesture.
        """
        names = list(dict.fromkeys(name for trial in trials for name in trial.gains))
        if not names:
            raise BadInput(
                f"Nobody has more than {choice.use} recordings of a gesture (--use), so none is left to test on."
            )
        refused = [one for trial in trials for one in trial.refused]
        same = [pair for trial in trials for pair in trial.agreement]
        return cls(
            context,
            choice,
            len(refused),
            float(np.mean(refused)),
            {name: EngineGains.over([t.gains[name] for t in trials if name in t.gains]) for name in names},
            {when: float(np.mean([pair[i] for pair in same])) for i, when in enumerate(("before", "after"))}
            if same
            else None,
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "context": self.context,
            "use": self.choice.use,
            "random": self.choice.random,
            "choices": self.choices,
            "refused": self.refused,
            "engines": {name: gains.to_json() for name, gains in self.engines.items()},
            "agreement": self.agreement,
        }


def try_adapting(
    windows: WindowSet, person: HeldOutPerson, times: Mapping[str, int], choice: ChoiceSpec
) -> PersonTrial:
    """Adapt to each choice of one person's recordings, and compare the scores on the others before and after.

    Args:
        windows: of everybody.
        times: when each recording was made, by its id.
    """
    mine = windows.take(np.flatnonzero(windows.subject == person.subject))
    tried: dict[str, list[_Change]] = {name: [] for name in person.predictors}
    refused: list[bool] = []
    same: list[tuple[float, float]] = []
    for chosen in _choices(mine, times, choice):
        own, test = _divide(mine, chosen)
        if not len(own) or not len(test):
            continue
        adapted = person.adapt(own)
        refused.append(adapted is None)
        before = {name: predict(test) for name, predict in person.predictors.items()}
        after = before if adapted is None else {name: predict(test) for name, predict in adapted.items()}
        for name in before:
            tried[name].append(_Change.of(test, before[name], after[name]))
        if len(before) > 1:
            same.append((_agreement(list(before.values())), _agreement(list(after.values()))))
    gains = {name: _gain(person.subject, changes) for name, changes in tried.items() if changes}
    return PersonTrial(tuple(refused), gains, tuple(same))


@dataclass(frozen=True)
class _Change:
    """Tested recordings of one choice, how many were correct, and both scores, before and after."""

    recordings: int
    right: tuple[int, int]
    accuracy: tuple[float, float]
    macro_f1: tuple[float, float]

    @classmethod
    def of(cls, test: WindowSet, *probabilities: NDArray[np.floating[Any]]) -> _Change:
        ids, first = np.unique(test.recording, return_index=True)
        truth = test.y[first]
        counts = [
            metrics.confusion(truth, metrics.vote(each, test.recording)[1], len(test.labels)) for each in probabilities
        ]
        before, after = counts
        return cls(
            len(ids),
            (int(np.trace(before)), int(np.trace(after))),
            (metrics.accuracy(before), metrics.accuracy(after)),
            (metrics.macro_f1(before), metrics.macro_f1(after)),
        )


def _choices(windows: WindowSet, times: Mapping[str, int], choice: ChoiceSpec) -> Iterator[set[int]]:
    """Yield the recordings to adapt to, as numbers of ``windows.recording``."""
    by_class = []
    for k in np.unique(windows.y):
        mine = sorted(
            {int(r) for r in windows.recording[windows.y == k]},
            key=lambda r: (times.get(windows.recording_ids[r], 0), windows.recording_ids[r]),
        )
        by_class.append(mine)
    for numbers in itertools.combinations(range(max(map(len, by_class), default=0)), choice.use):
        yield {mine[n] for mine in by_class for n in numbers if n < len(mine)}
    draw = np.random.default_rng(choice.seed)
    for _ in range(choice.random):
        yield {int(r) for mine in by_class for r in draw.permutation(mine)[: choice.use]}


def _divide(windows: WindowSet, chosen: set[int]) -> tuple[WindowSet, WindowSet]:
    """Return the windows to adapt to, none of which touches a tested recording, and those to test on."""
    adapts = np.isin(windows.recording, sorted(chosen))
    test = windows.take(np.flatnonzero(~adapts))
    keep = purge(windows.stream, windows.window_rows, test.stream, test.recording_rows)
    return windows.take(np.flatnonzero(adapts & keep)), test


def _agreement(probabilities: list[NDArray[np.floating[Any]]]) -> float:
    one, other = (each.argmax(axis=1) for each in probabilities[:2])
    return float((one == other).mean())


def _gain(subject: str, changes: list[_Change]) -> PersonGain:
    difference = [c.right[1] - c.right[0] for c in changes]
    scores = {}
    for score in _SCORES:
        pairs = np.array([getattr(c, score) for c in changes])
        first = float(pairs[0, 1] - pairs[0, 0])
        scores[score] = {"before": float(pairs[:, 0].mean()), "after": float(pairs[:, 1].mean()), "first": first}
    return PersonGain(
        subject,
        len(changes),
        float(np.mean([c.recordings for c in changes])),
        float(np.mean(difference)),
        min(difference),
        sum(d < -1 for d in difference),
        scores,
    )


@dataclass(frozen=True, eq=False)
class Adapted:
    """The outcome of `adapt`.

    ``tested``: with ``use``, the scores on the other recordings, before and after; None where all were used.
    ``left_out`` maps each label to the reason why recordings could not be used.
    """

    personal: Personal
    subject: str
    use: int | None
    tested: tuple[RecordingScores, RecordingScores] | None
    left_out: dict[str, str]
    simulated: bool

    @property
    def accepted(self) -> bool:
        """Whether the recordings changed the bundle."""
        return self.personal.accepted

    @property
    def bundle(self) -> Bundle:
        """The adapted bundle, or the given one where it was left as it is."""
        return self.personal.bundle

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save the adapted bundle.

        Raises:
            BundleError: when the bundle was left as it is: there is nothing new to save.
        """
        if not self.accepted:
            raise BundleError(f"The bundle was left as it is: {self.personal.reason}.")
        return self.bundle.save(Path(path))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        done = self.personal
        return {
            "adapted": self.accepted,
            "subject": self.subject,
            "reason": done.reason,
            "strength": done.strength,
            "use": self.use,
            "gestures": list(done.used),
            "gestures_not_shown": list(done.without),
            "left_out": self.left_out,
            "leave_one_recording_out": {"before": done.before.to_dict(), "after": done.after.to_dict()},
            "tested": None
            if self.tested is None
            else {"before": self.tested[0].to_dict(), "after": self.tested[1].to_dict()},
            "simulated": self.simulated,
        }

    def __repr__(self) -> str:
        return f"Adapted(to {self.subject}: {'yes' if self.accepted else 'no'}, {self.personal.reason})"


def adapt(
    bundle: Bundle | str | os.PathLike[str],
    recordings: Dataset | str | os.PathLike[str],
    *,
    subject: str | None = None,
    use: int | None = None,
    spec: PersonalSpec | None = None,
    warn: Warn = python_warning,
) -> Adapted:
    """Adapt a bundle's last layer to one person, or leave it as it is where their own recordings do not show a gain.

    Args:
        recordings: a data set, or the folder of a recorder.
        subject: the person; may be left out where there is only one.
        use: number of recordings of each gesture to adapt to, the first ones; the rest are scored before and after.
        warn: called with what was left out, and what limits the meaning of the scores.

    Raises:
        BadInput: for too few recordings; DatasetError: for an unknown person or another layout;
        ConfigError: for a ``use`` that is too small; ForgottenError: when a person was removed during the run.
    """
    spec = spec or PersonalSpec()
    if use is not None and use < spec.least:
        raise ConfigError(f"--use {use} is too few: accepted are {spec.least} and more recordings of each gesture.")
    given = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    if (before := given.adapted_to) is not None:
        warn(f"the bundle is adapted to {before}: it is adapted again from its original")
    with temporary_folder() as place:
        dataset = _dataset(recordings, given, place)
        person = _person(dataset, subject)
        dataset = dataset.with_inputs(given.layout).with_gestures(given.gestures)
        _same_layout(given, dataset)
        _warn_of_training(given, person, warn)
        own, left_out = _recordings_of(dataset, person, given, warn)
        windows = windows_for(own, given.arch, whole_gestures(given.windowing), given.gestures, warn)
        times = {r.id: r.epoch_ms for r in own.recordings}
    adapting, test = windows, None
    if use is not None:
        everything = set(windows.recording.tolist())
        adapting, test = _divide(windows, next(_choices(windows, times, ChoiceSpec(use)), everything))
        if not len(test):
            raise BadInput(
                f"No recording of {person} is left to test on: {use} of each gesture are used to adapt; use fewer."
            )
    done = personalise(given, adapting.integers, adapting.y, adapting.recording, subject=person, spec=spec)
    for label in done.without:
        warn(f"{label}: fewer than {spec.least} recordings, so the network recognises it as before")
    tested = None
    if test is not None:
        original = restore_original(given) if before is not None else given
        predictors = (_float_predictor(original), _float_predictor(done.bundle if done.accepted else original))
        one, other = (judge(predict(test), test.y, test.recording).scores for predict in predictors)
        tested = (one, other)
    if not dataset.path.is_relative_to(place):  # the one made of a folder is gone by now
        dataset.generation.check()
    return Adapted(done, person, use, tested, left_out, dataset.head.simulated)


def _dataset(recordings: Dataset | str | os.PathLike[str], bundle: Bundle, place: Path) -> Dataset:
    """Return the data set, or one made of a recorder's folder in the folder ``place``."""
    if isinstance(recordings, Dataset) or (Path(recordings) / HEAD).is_file():
        return as_dataset(recordings)
    if not Path(recordings).exists():
        raise DatasetError(f"There is no folder '{recordings}': give a data set, or a person's folder of recordings.")
    return import_recordings(
        Path(recordings), place / "DS", layout=bundle.layout, gestures=bundle.gestures, adopt_proposals=False
    ).dataset


def _person(dataset: Dataset, subject: str | None) -> str:
    people = dataset.subjects
    if subject is None and len(people) == 1:
        return people[0]
    listed = ", ".join(people) or "nobody"
    if subject is None:
        raise DatasetError(f"'{dataset.head.name}' holds recordings of {listed}: choose a person with --subject CODE.")
    if subject not in people:
        raise DatasetError(
            f"'{dataset.head.name}' holds no recording of '{subject}': there are {listed}.{nearest(subject, people)}"
        )
    return subject


def _same_layout(bundle: Bundle, dataset: Dataset) -> None:
    one, other = bundle.layout, dataset.layout

    def signature(layout: Any) -> tuple[Any, ...]:
        return tuple((c.name, c.unit, c.step) for c in layout.channels), layout.inputs, layout.period_us

    if signature(one) != signature(other):
        raise DatasetError(
            "'{dataset}' has the layout '{other}', the bundle '{one}': a bundle can only be adapted to recordings of "
            "the sensors that it reads.",
            dataset=dataset.head.name,
            other=other.name,
            one=one.name,
        )


def _warn_of_training(bundle: Bundle, person: str, warn: Warn) -> None:
    for key, used in (("subjects", "trained"), ("validation_subjects", "validated")):
        people = bundle.provenance.get(key, ())
        if isinstance(people, list | tuple) and person in people:
            warn(f"the bundle was {used} on a person {person}: if it is the same one, the scores before are too high")
            return


def _recordings_of(dataset: Dataset, person: str, bundle: Bundle, warn: Warn) -> tuple[Dataset, dict[str, str]]:
    """Return the data set with the person's recordings of known gestures, and what is left out."""
    mine = [r for r in dataset.used if r.subject == person]
    known = [r for r in mine if r.gesture in bundle.gestures.labels]
    strange = Counter(r.gesture for r in mine if r.gesture not in bundle.gestures.labels)
    left_out = {label: f"{n} recordings of a gesture that the bundle does not know" for label, n in strange.items()}
    for label, why in left_out.items():
        warn(f"left out: {label}: {why}")
    if not known:
        raise DatasetError(
            "{subject} has no recording of a gesture that the bundle knows, which are: {labels}.",
            subject=person,
            labels=", ".join(bundle.gestures.labels),
        )
    return Dataset(dataset.path, dataset.head, known, dataset.streams), left_out


def _float_predictor(bundle: Bundle) -> Predictor:
    network, scaler = bundle.network(), bundle.scaler
    return lambda windows: network.probabilities(scaler.apply(windows.integers))


def _predictors(bundle: Bundle, int8: bool) -> dict[str, Predictor]:
    predictors = {"float": _float_predictor(bundle)}
    if int8:
        network = integer_network(bundle)
        predictors["int8"] = lambda windows: integer_probabilities(network, windows.integers)
    return predictors


@dataclass(frozen=True)
class AdaptingResult:
    """The result of `evaluate_adapting`."""

    split: str
    simulated: bool
    spec: PersonalSpec
    scores: AdaptationScores

    def to_json(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {
            "split": self.split,
            "simulated": self.simulated,
            "spec": asdict(self.spec),
            **self.scores.to_json(),
        }


def evaluate_adapting(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str = "leave-one-subject-out",
    use: int = 2,
    random: int = 0,
    int8: bool = False,
    spec: PersonalSpec | None = None,
    progress: Progress | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> AdaptingResult:
    """Measure how much adaptation helps people left out: one network for each fold, adapted to each of its people.

    Networks and finished folds are kept in the data set's ``cache`` folder. Adaptation is not tuned here: each person's
    strength, and whether to adapt at all, follow from the recordings that the network is adapted to.

    Args:
        config, settings: as for `plushsense.train`; also ``workers``.
        use, random: as for `ChoiceSpec`.
        int8: also score the deployed networks, before and after.
    """
    run = prepare(dataset, from_settings(config, **settings), warn)
    spec = spec or PersonalSpec()
    if use < spec.least or random < 0:
        raise ConfigError(f"--use {use}, --choices {random}: accepted are {spec.least} and more, 0 and more.")
    division = parse_split(split)
    if not division.separates_people:
        raise ConfigError(f"The split {split} does not keep people apart: use leave-one-subject-out or by-subject:5.")
    if int8:
        refuse_undeployable(run.network)
    windows = windows_for(run.dataset, run.network, run.windows, run.gestures, warn)
    choice = ChoiceSpec(use, random, run.evaluation.seed)
    work = _FoldWork(run, choice, spec, int8)
    context = context_of(windows)

    def summarise(study: StudyResults) -> AdaptationScores:
        trials = [PersonTrial.from_journal(row) for result in study.results for row in result["people"]]
        return AdaptationScores.over(context, choice, trials)

    scores = run_study(
        [
            StudyPart(fold.name, {"fold": fold_fingerprint(fold)}, fold)
            for fold in fold_windows(windows, windows, division, run.evaluation.seed)
        ],
        work,
        summarise,
        key=work.key(windows),
        shared=windows,
        spec=JobsSpec(run.evaluation.processes, journal=journal_of(run.dataset, _FOLDER)),
        progress=progress,
    )
    return AdaptingResult(division.text, run.dataset.head.simulated, spec, scores)


# Part of every job's id: increase it when the meaning of a stored fold changes.
_VERSION = 1
_FOLDER = "adapting"


@dataclass(frozen=True)
class _FoldWork:
    """The work of one fold: train its network, or load it, and adapt it to each person who was left out."""

    run: Run
    choice: ChoiceSpec
    spec: PersonalSpec
    int8: bool

    def key(self, windows: WindowSet) -> dict[str, Any]:
        """Return what the result of every fold depends on."""
        times = sorted((r.id, r.epoch_ms) for r in self.run.dataset.recordings)
        tried = {"choice": vars(self.choice), "spec": asdict(self.spec), "int8": self.int8, "times": times}
        return {"version": _VERSION, **self._network_key(windows), "tried": tried}

    def _network_key(self, windows: WindowSet) -> dict[str, Any]:
        return {
            "windows": windows_fingerprint(windows),
            "arch": self.run.network.to_dict(),
            "layout": self.run.dataset.layout.to_dict(),
            "training": self.run.training.key(),
        }

    def __call__(self, windows: WindowSet, task: Fold, report: Report, /) -> Result:
        bundle = self._bundle_of(windows, task, report)
        predictors = _predictors(bundle, self.int8)
        times = {r.id: r.epoch_ms for r in self.run.dataset.recordings}
        people = [
            HeldOutPerson(who, predictors, partial(_adapt_to, bundle, who, self.spec, self.int8))
            for who in task.subjects
        ]
        return {"people": [asdict(try_adapting(windows, person, times, self.choice)) for person in people]}

    def _bundle_of(self, windows: WindowSet, fold: Fold, report: Report) -> Bundle:
        """Return the fold's network from the cache, or train it."""
        run, dataset, arch = self.run, self.run.dataset, self.run.network
        made = json.dumps({**self._network_key(windows), "fold": fold_fingerprint(fold)}, sort_keys=True)
        path = dataset.path / CACHE / _FOLDER / f"{hashlib.sha256(made.encode()).hexdigest()[:32]}.plush"
        if path.exists():
            return Bundle.load(path)
        from plushsense.training.fit import fit

        mine = windows.take(fold.train)
        fitted = fit(mine, windows.take(fold.validation), arch, run.training, lambda at, of, row: report((at, of)))
        origin = {
            "dataset": dataset.head.name,
            "dataset_hash": dataset.hash,
            "simulated": dataset.head.simulated,
            "subjects": sorted({str(s) for s in mine.subject}),
            "validation_subjects": sorted({str(s) for s in windows.subject[fold.validation]}),
        }
        bundle = Bundle(
            arch,
            fitted.weights,
            dataset.layout,
            fitted.scaler,
            run.gestures,
            asdict(run.windows),
            run.live.to_dict(),
            origin,
            calibration(arch, fitted.weights, fitted.scaler, mine.integers),
        )
        keep_bundle(bundle, path, dataset)
        return bundle


def _adapt_to(bundle: Bundle, person: str, spec: PersonalSpec, int8: bool, own: WindowSet) -> Predictors | None:
    """Return the predictors of the bundle adapted to windows of a person; None where it stays as it is."""
    try:
        done = personalise(bundle, own.integers, own.y, own.recording, subject=person, spec=spec)
    except BadInput:
        return None  # too few recordings
    return _predictors(done.bundle, int8) if done.accepted else None
