"""Adaptation of a bundle to one person, and its effect on people whom the network was not trained on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError, DatasetError, nearest, python_warning
from plushsense.dataset.files import CACHE
from plushsense.dataset.store import Dataset
from plushsense.deploy.quantize import calibration
from plushsense.evaluation.crossval import context_of, fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.experiments.recordings import opened
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
_SCORES = ("accuracy", "macro_f1")


@dataclass(frozen=True)
class PersonGain:
    """What adaptation changed for one person: means over the ``choices`` of recordings.

    ``refused`` counts the choices that left the network as it is. ``right_change`` counts correct recordings, after
    minus before; ``choices_worse`` the choices that lost more than one. ``scores`` has for accuracy and macro-F1 the
    value ``before`` and ``after``, and the gain of the ``first`` choice.
    """

    subject: str
    choices: int
    refused: int
    recordings: float
    right_change: float
    right_change_worst: int
    choices_worse: int
    scores: Mapping[str, Mapping[str, float]]

    def to_json(self) -> dict[str, object]:
        """Return plain values, the scores as keys such as ``accuracy_before``."""
        row = {name: value for name, value in vars(self).items() if name != "scores"}
        return row | {f"{score}_{when}": value for score, at in self.scores.items() for when, value in at.items()}


def try_adapting(
    windows: WindowSet,
    subject: str,
    predict: Predictor,
    adapt: Callable[[WindowSet], Predictor | None],
    times: Mapping[str, int],
    use: int,
) -> PersonGain | None:
    """Adapt to each choice of one person's recordings, and compare the scores on the others before and after.

    The choices are all sets of ``use`` numbers, the same for all gestures (10 of 5 recordings), where the recordings of
    a gesture are numbered by time; the first choice is the first recordings of each gesture.

    Args:
        windows: of everybody.
        predict: the network, which was not trained on ``subject``.
        adapt: returns the network adapted to windows, or None where it stays as it is.
        times: when each recording was made, by its id.

    Returns:
        None where no choice leaves a recording to test on.
    """
    mine = windows.take(np.flatnonzero(windows.subject == subject))
    refused, recordings, counts = 0, list[int](), list[tuple[metrics.Counts, metrics.Counts]]()
    for chosen in _choices(mine, times, use):
        own, test = _divide(mine, chosen)
        if not len(own) or not len(test):
            continue
        adapted = adapt(own)
        refused += adapted is None
        before = _votes(test, predict)
        counts.append((before, before if adapted is None else _votes(test, adapted)))
        recordings.append(len(np.unique(test.recording)))
    if not counts:
        return None
    right = [int(np.trace(after)) - int(np.trace(before)) for before, after in counts]
    scores = {}
    for name in _SCORES:
        pairs = np.array([[getattr(metrics, name)(one) for one in pair] for pair in counts])
        first = float(pairs[0, 1] - pairs[0, 0])
        scores[name] = {"before": float(pairs[:, 0].mean()), "after": float(pairs[:, 1].mean()), "first": first}
    return PersonGain(
        subject=subject,
        choices=len(counts),
        refused=refused,
        recordings=float(np.mean(recordings)),
        right_change=float(np.mean(right)),
        right_change_worst=min(right),
        choices_worse=sum(change < -1 for change in right),
        scores=scores,
    )


def _votes(test: WindowSet, predict: Predictor) -> metrics.Counts:
    """Return the confusion matrix of the recordings, each of which its windows vote on."""
    _, first = np.unique(test.recording, return_index=True)
    return metrics.confusion(test.y[first], metrics.vote(predict(test), test.recording)[1], len(test.labels))


def _choices(windows: WindowSet, times: Mapping[str, int], use: int) -> Iterator[set[int]]:
    """Yield the recordings to adapt to, as numbers of ``windows.recording``."""
    ids = windows.recording_ids
    by_class = [
        sorted(set(windows.recording[windows.y == k].tolist()), key=lambda r: (times.get(ids[r], 0), ids[r]))
        for k in np.unique(windows.y)
    ]
    for numbers in itertools.combinations(range(max(map(len, by_class), default=0)), use):
        yield {mine[n] for mine in by_class for n in numbers if n < len(mine)}


def _divide(windows: WindowSet, chosen: set[int]) -> tuple[WindowSet, WindowSet]:
    """Return the windows to adapt to, none of which touches a tested recording, and those to test on."""
    adapts = np.isin(windows.recording, sorted(chosen))
    test = windows.take(np.flatnonzero(~adapts))
    keep = purge(windows.stream, windows.window_rows, test.stream, test.recording_rows)
    return windows.take(np.flatnonzero(adapts & keep)), test


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

    def to_dict(self) -> dict[str, object]:
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
    with opened(recordings, given.layout, given.gestures) as dataset:
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
            adapting, test = _divide(windows, next(_choices(windows, times, use), everything))
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
            predictors = (_predictor(original), _predictor(done.bundle if done.accepted else original))
            one, other = (judge(predict(test), test.y, test.recording).scores for predict in predictors)
            tested = (one, other)
        dataset.generation.check()
    return Adapted(done, person, use, tested, left_out, dataset.head.simulated)


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
    signatures = [([(c.name, c.unit, c.step) for c in at.channels], at.inputs, at.period_us) for at in (one, other)]
    if signatures[0] != signatures[1]:
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


def _predictor(bundle: Bundle) -> Predictor:
    network, scaler = bundle.network(), bundle.scaler
    return lambda windows: network.probabilities(scaler.apply(windows.integers))


@dataclass(frozen=True)
class AdaptingResult:
    """The result of `evaluate_adapting`: what adaptation to ``use`` recordings of each gesture changed for people."""

    split: str
    simulated: bool
    context: str
    use: int
    spec: PersonalSpec
    people: tuple[PersonGain, ...]

    @property
    def choices(self) -> int:
        """Number of choices of recordings of all people."""
        return sum(row.choices for row in self.people)

    @property
    def refused(self) -> float:
        """Share of the choices that left the network as it is."""
        return sum(row.refused for row in self.people) / self.choices

    def score(self, name: str) -> dict[str, metrics.Summary]:
        """Return a score ``before``, ``after``, their difference ``gain``, and ``first``, that of the first choice."""
        before, after, first = (
            np.array([row.scores[name][when] for row in self.people]) for when in ("before", "after", "first")
        )
        values = {"before": before, "after": after, "gain": after - before, "first": first}
        return {when: metrics.summary(value) for when, value in values.items()}

    @property
    def right(self) -> dict[str, float]:
        """Correct recordings, after minus before: the ``mean``, that of the worst person, the ``worst`` choice, people
        who lost more than one on average, and the share of such choices.
        """
        changes = [row.right_change for row in self.people]
        return {
            "mean": float(np.mean(changes)),
            "worst_mean": min(changes),
            "worst": min(row.right_change_worst for row in self.people),
            "worse_people": sum(change < -1 for change in changes),
            "worse_choices": sum(row.choices_worse for row in self.people) / self.choices,
        }

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            **{key: getattr(self, key) for key in ("split", "simulated", "context", "use", "choices", "refused")},
            "spec": asdict(self.spec),
            **{name: {when: one.to_json() for when, one in self.score(name).items()} for name in _SCORES},
            "right": self.right,
            "people": [row.to_json() for row in self.people],
        }


def evaluate_adapting(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str = "leave-one-subject-out",
    use: int = 2,
    progress: Progress | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> AdaptingResult:
    """Measure how much adaptation helps people left out: one network for each fold, adapted to each of its people.

    Networks and finished folds are kept in the data set's ``cache`` folder. Adaptation is not tuned here: each person's
    strength, and whether to adapt at all, follow from the recordings that the network is adapted to.

    Args:
        config, settings: as for `plushsense.train`; also ``workers``.
        use: number of recordings of each gesture to adapt to; see `try_adapting`.

    Raises:
        ConfigError: for a split that does not keep people apart, or too small a ``use``.
        BadInput: when nobody has more than ``use`` recordings of a gesture.
    """
    run = prepare(dataset, from_settings(config, **settings), warn)
    spec = PersonalSpec()
    if use < spec.least:
        raise ConfigError(f"--use {use} is too few: accepted are {spec.least} and more recordings of each gesture.")
    division = parse_split(split)
    if not division.separates_people:
        raise ConfigError(f"The split {split} does not keep people apart: use leave-one-subject-out or by-subject:5.")
    windows = windows_for(run.dataset, run.network, run.windows, run.gestures, warn)
    work = _FoldWork(run, use, spec)

    def summarise(study: StudyResults) -> AdaptingResult:
        people = tuple(PersonGain(**row) for result in study.results for row in result["people"])
        if not people:
            raise BadInput(f"Nobody has more than {use} recordings of a gesture (--use), so none is left to test on.")
        simulated = run.dataset.head.simulated
        return AdaptingResult(division.text, simulated, context_of(windows), use, spec, people)

    return run_study(
        [
            StudyPart(fold.name, {"fold": fold_fingerprint(fold)}, fold)
            for fold in fold_windows(windows, windows, division, run.evaluation.seed)
        ],
        work,
        summarise,
        key={
            "version": _VERSION,
            **work.network_key(windows),
            "use": use,
            "spec": asdict(spec),
            "times": sorted((r.id, r.epoch_ms) for r in run.dataset.recordings),
        },
        shared=windows,
        spec=JobsSpec(run.evaluation.processes, journal=journal_of(run.dataset, _FOLDER)),
        progress=progress,
    )


# Part of every job's id: increase it when the meaning of a stored fold changes.
_VERSION = 2
_FOLDER = "adapting"


@dataclass(frozen=True)
class _FoldWork:
    """The work of one fold: train its network, or load it, and adapt it to each person who was left out."""

    run: Run
    use: int
    spec: PersonalSpec

    def network_key(self, windows: WindowSet) -> dict[str, object]:
        return {
            "windows": windows_fingerprint(windows),
            "arch": self.run.network.to_dict(),
            "layout": self.run.dataset.layout.to_dict(),
            "training": self.run.training.key(),
        }

    def __call__(self, windows: WindowSet, task: Fold, report: Report, /) -> Result:
        bundle = self._bundle_of(windows, task, report)
        times = {r.id: r.epoch_ms for r in self.run.dataset.recordings}
        predict = _predictor(bundle)

        def adapt_to(person: str, own: WindowSet) -> Predictor | None:
            try:
                done = personalise(bundle, own.integers, own.y, own.recording, subject=person, spec=self.spec)
            except BadInput:
                return None  # too few recordings
            return _predictor(done.bundle) if done.accepted else None

        tried = (try_adapting(windows, p, predict, partial(adapt_to, p), times, self.use) for p in task.subjects)
        return {"people": [asdict(gain) for gain in tried if gain is not None]}

    def _bundle_of(self, windows: WindowSet, fold: Fold, report: Report) -> Bundle:
        """Return the fold's network from the cache, or train it."""
        run, dataset, arch = self.run, self.run.dataset, self.run.network
        made = json.dumps({**self.network_key(windows), "fold": fold_fingerprint(fold)}, sort_keys=True)
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
