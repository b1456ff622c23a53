"""Adaptation of a bundle to one person, and its effect on people whom the network was not trained on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from plushsense.workflow.preparation import Warn, prepare, windows_for
from plushsense.workflow.reporting import keep_bundle

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


def score_adaptation(
    windows: WindowSet,
    people: Iterable[HeldOutPerson],
    times: Mapping[str, int],
    *,
    use: int = 2,
    random: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Compare the scores of people before and after adaptation.

    Args:
        windows: of everybody.
        times: when each recording was made, by its id: recordings of a gesture are numbered in this order.
        use: recordings of each gesture to adapt to. The choices are all sets of ``use`` numbers, the same for all
            gestures (10 of 5 recordings); the first choice is the first recordings of each gesture.
        random: further choices, drawn for each gesture on its own.
        progress: called with each person who is done.

    Returns:
        ``context``, ``use``, ``random``, ``choices`` in all, ``refused`` (share of the choices in which the bundle
        stayed as it was); ``engines``: of each ``accuracy`` and ``macro_f1`` with ``before``, ``after`` and ``gain``
        (mean, sd, ci95 over people), ``first`` (the same gain for the first choice), ``right`` (correct recordings
        after minus before: ``mean``, ``worst_mean`` of a person, ``worst`` of a choice, ``worse_people``: less by
        more than one on average, ``worse_choices``: share of choices) and ``people``, a row each; ``agreement``, the
        share of the test windows on which the engines agree, before and after (None with one engine).

    Raises:
        BadInput: when nobody has more than ``use`` recordings of a gesture.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    same: list[tuple[float, float]] = []
    refused: list[bool] = []
    for person in people:
        mine = windows.take(np.flatnonzero(windows.subject == person.subject))
        tried: dict[str, list[_Change]] = {name: [] for name in person.predictors}
        for chosen in _choices(mine, times, use, random, seed):
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
        for name, changes in tried.items():
            if changes:
                rows.setdefault(name, []).append(_row(person.subject, changes))
        if progress is not None:
            progress(person.subject)
    if not rows:
        raise BadInput(f"Nobody has more than {use} recordings of a gesture (--use), so none is left to test on.")
    return {
        "context": context_of(windows),
        "use": use,
        "random": random,
        "choices": len(refused),
        "refused": float(np.mean(refused)),
        "engines": {name: _summary(people) for name, people in rows.items()},
        "agreement": {when: float(np.mean([each[i] for each in same])) for i, when in enumerate(("before", "after"))}
        if same
        else None,
    }


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


def _choices(windows: WindowSet, times: Mapping[str, int], use: int, random: int, seed: int) -> Iterator[set[int]]:
    """Yield the recordings to adapt to, as numbers of ``windows.recording``."""
    by_class = []
    for k in np.unique(windows.y):
        mine = sorted(
            {int(r) for r in windows.recording[windows.y == k]},
            key=lambda r: (times.get(windows.recording_ids[r], 0), windows.recording_ids[r]),
        )
        by_class.append(mine)
    for numbers in itertools.combinations(range(max(map(len, by_class), default=0)), use):
        yield {mine[n] for mine in by_class for n in numbers if n < len(mine)}
    draw = np.random.default_rng(seed)
    for _ in range(random):
        yield {int(r) for mine in by_class for r in draw.permutation(mine)[:use]}


def _divide(windows: WindowSet, chosen: set[int]) -> tuple[WindowSet, WindowSet]:
    """Return the windows to adapt to, none of which touches a tested recording, and those to test on."""
    adapts = np.isin(windows.recording, sorted(chosen))
    test = windows.take(np.flatnonzero(~adapts))
    keep = purge(windows.stream, windows.window_rows, test.stream, test.recording_rows)
    return windows.take(np.flatnonzero(adapts & keep)), test


def _agreement(probabilities: list[NDArray[np.floating[Any]]]) -> float:
    one, other = (each.argmax(axis=1) for each in probabilities[:2])
    return float((one == other).mean())


def _row(subject: str, changes: list[_Change]) -> dict[str, Any]:
    difference = [c.right[1] - c.right[0] for c in changes]
    row: dict[str, Any] = {
        "subject": subject,
        "choices": len(changes),
        "recordings": float(np.mean([c.recordings for c in changes])),
        "right_change": float(np.mean(difference)),
        "right_change_worst": min(difference),
        "choices_worse": sum(d < -1 for d in difference),
    }
    for score in _SCORES:
        pairs = np.array([getattr(c, score) for c in changes])
        row |= {f"{score}_before": float(pairs[:, 0].mean()), f"{score}_after": float(pairs[:, 1].mean())}
        row[f"{score}_first"] = float(pairs[0, 1] - pairs[0, 0])
    return row


def _summary(people: list[dict[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for score in _SCORES:
        before, after, first = (
            np.array([row[f"{score}_{when}"] for row in people]) for when in ("before", "after", "first")
        )
        out[score] = {
            "before": metrics.summary(before),
            "after": metrics.summary(after),
            "gain": metrics.summary(after - before),
            "first": metrics.summary(first),
        }
    changes = [row["right_change"] for row in people]
    out["right"] = {
        "mean": float(np.mean(changes)),
        "worst_mean": min(changes),
        "worst": min(row["right_change_worst"] for row in people),
        "worse_people": sum(change < -1 for change in changes),
        "worse_choices": sum(row["choices_worse"] for row in people) / sum(row["choices"] for row in people),
    }
    return out | {"people": people}


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
        adapting, test = _divide(windows, next(_choices(windows, times, use, 0, 0), everything))
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
            f"'{dataset.head.name}' has the layout '{other.name}', the bundle '{one.name}': a bundle can only be "
            "adapted to recordings of the sensors that it reads.",
            reason="other_sensors",
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
            f"{person} has no recording of a gesture that the bundle knows, which are: "
            f"{', '.join(bundle.gestures.labels)}.",
            reason="no_known_recording",
            subject=person,
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


def evaluate_adapting(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    split: str = "leave-one-subject-out",
    use: int = 2,
    random: int = 0,
    int8: bool = False,
    spec: PersonalSpec | None = None,
    progress: Callable[[str], None] | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> dict[str, Any]:
    """Measure how much adaptation helps people left out: one network for each fold, adapted to each of its people.

    The networks are kept in the data set's ``cache`` folder. Adaptation is not tuned here: each person's strength, and
    whether to adapt at all, follow from the recordings that the network is adapted to.

    Args:
        config, settings: as for `plushsense.train`.
        use, random: as for `score_adaptation`.
        int8: also score the deployed networks, before and after.
        progress: called with a sentence on each finished training or person.

    Returns:
        What `score_adaptation` returns, and ``split``, ``simulated``, ``spec``.
    """
    run = prepare(dataset, config or from_settings(**settings), warn)
    dataset, gestures, arch = run.dataset, run.gestures, run.network
    spec = spec or PersonalSpec()
    if use < spec.least or random < 0:
        raise ConfigError(f"--use {use}, --choices {random}: accepted are {spec.least} and more, 0 and more.")
    division = parse_split(split)
    if not division.separates_people:
        raise ConfigError(f"The split {split} does not keep people apart: use leave-one-subject-out or by-subject:5.")
    if int8:
        refuse_undeployable(arch)
    windows = windows_for(dataset, arch, run.windows, gestures, warn)
    folds = fold_windows(windows, windows, division, run.evaluation.seed)
    key = {"windows": windows_fingerprint(windows), "arch": arch.to_dict(), "layout": dataset.layout.to_dict()}
    tell = progress or (lambda _: None)

    def bundle_of(fold: Fold) -> Bundle:
        made = json.dumps({**key, "fold": fold_fingerprint(fold), "training": run.training.key()}, sort_keys=True)
        path = dataset.path / CACHE / "adapting" / f"{hashlib.sha256(made.encode()).hexdigest()[:32]}.plush"
        if path.exists():
            return Bundle.load(path)
        from plushsense.training.fit import fit

        mine = windows.take(fold.train)
        fitted = fit(mine, windows.take(fold.validation), arch, run.training)
        kept = calibration(arch, fitted.weights, fitted.scaler, mine.integers)
        bundle = Bundle(
            arch,
            fitted.weights,
            dataset.layout,
            fitted.scaler,
            gestures,
            asdict(run.windows),
            run.live.to_dict(),
            {
                "dataset": dataset.head.name,
                "dataset_hash": dataset.hash,
                "simulated": dataset.head.simulated,
                "subjects": sorted({str(s) for s in mine.subject}),
                "validation_subjects": sorted({str(s) for s in windows.subject[fold.validation]}),
            },
            kept,
        )
        keep_bundle(bundle, path, dataset)
        tell(f"trained for {fold.name}, {fitted.seconds:.0f} s")
        return bundle

    def people() -> Iterator[HeldOutPerson]:
        for fold in folds:
            bundle = bundle_of(fold)
            before = _predictors(bundle, int8)
            for person in fold.subjects:
                yield HeldOutPerson(person, before, partial(_adapt_to, bundle, person, spec, int8))

    result = score_adaptation(
        windows,
        people(),
        {r.id: r.epoch_ms for r in dataset.recordings},
        use=use,
        random=random,
        seed=run.evaluation.seed,
        progress=lambda person: tell(f"adapted to {person}"),
    )
    return {"split": division.text, "simulated": dataset.head.simulated, "spec": asdict(spec), **result}


def _adapt_to(bundle: Bundle, person: str, spec: PersonalSpec, int8: bool, own: WindowSet) -> Predictors | None:
    """Return the predictors of the bundle adapted to windows of a person; None where it stays as it is."""
    try:
        done = personalise(bundle, own.integers, own.y, own.recording, subject=person, spec=spec)
    except BadInput:
        return None  # too few recordings
    return _predictors(done.bundle, int8) if done.accepted else None
