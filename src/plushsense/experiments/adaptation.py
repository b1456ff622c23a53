"""A bundle adapted to one person, from a data set or a recorder's folder; and how much that helps strangers."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError, DatasetError, nearest
from plushsense.dataset.files import CACHE
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import HEAD, Dataset
from plushsense.deploy.quantize import calibration, integer_network, integer_probabilities, refuse_undeployable
from plushsense.evaluation.crossval import context_of, fold_fingerprint, fold_windows, windows_fingerprint
from plushsense.live.adaptation import Personal, PersonalSpec, RecordingScores, judge, personalise, restore_original
from plushsense.models.bundle import Bundle
from plushsense.scoring import metrics
from plushsense.scoring.splits import Fold, parse_split, purge
from plushsense.windows.cut import WindowSet, whole_gestures
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import Warn, choose_classes, silent, windows_for

Index = NDArray[np.int64]
Reader = Callable[[WindowSet], NDArray[np.floating[Any]]]  # windows → probabilities (N, K)

_SCORES = ("accuracy", "macro_f1")


@dataclass(frozen=True)
class Touched:
    """Result of adapting: a reader by engine; ``accepted`` false: they read as before."""

    readers: Mapping[str, Reader]
    accepted: bool


@dataclass(frozen=True)
class Stranger:
    """A person with a network that was not trained on them: ``readers`` by engine ("float" first), ``adapt`` is given
    the windows of the recordings that adapt it.
    """

    subject: str
    readers: Mapping[str, Reader]
    adapt: Callable[[WindowSet], Touched]


def evaluate_adapting_adapting(
    windows: WindowSet,
    strangers: Iterable[Stranger],
    times: Mapping[str, int],
    *,
    use: int = 2,
    random: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Before and after, person by person.

    Args:
        windows: of everybody.
        strangers: the people, each with their network.
        times: when each recording was made, by its id: recordings of a gesture are numbered in this order.
        use: recordings of each gesture that adapt. The choices are all sets of so many numbers, the same for all
            gestures (10 of 5 recordings); the first is the first recordings of each gesture.
        random: so many choices more, drawn for each gesture on its own.
        progress: told each person who is done.

    Returns:
        ``context``, ``use``, ``random``, ``choices`` in all, ``refused`` (share of the choices in which the bundle
        stayed as it was); ``engines``: of each ``accuracy`` and ``macro_f1`` with ``before``, ``after`` and ``gain``
        (mean, sd, ci95 over people), ``first`` (the same gain when the first recordings adapt), ``right`` (recordings
        right, after less before: ``mean``, ``worst_mean`` of a person, ``worst`` of a choice, ``worse_people``: less by
        more than one on average, ``worse_choices``: share of choices) and ``people``, a row each; ``agreement``, the
        share of the test windows on which the engines say the same, before and after (None with one engine).

    Raises:
        BadInput: when nobody has more recordings of a gesture than adapt.
    """
    rows: dict[str, list[dict[str, Any]]] = {}
    same: list[tuple[float, float]] = []
    refused: list[bool] = []
    for stranger in strangers:
        mine = windows.take(np.flatnonzero(windows.subject == stranger.subject))
        tried: dict[str, list[_Change]] = {name: [] for name in stranger.readers}
        for chosen in _choices(mine, times, use, random, seed):
            own, test = _parts(mine, chosen)
            if not len(own) or not len(test):
                continue
            touched = stranger.adapt(own)
            refused.append(not touched.accepted)
            before = {name: reader(test) for name, reader in stranger.readers.items()}
            after = {name: reader(test) for name, reader in touched.readers.items()} if touched.accepted else before
            for name in stranger.readers:
                tried[name].append(_Change.of(test, before[name], after[name]))
            if len(before) > 1:
                same.append((_agreement(list(before.values())), _agreement(list(after.values()))))
        for name, changes in tried.items():
            if changes:
                rows.setdefault(name, []).append(_row(stranger.subject, changes))
        if progress is not None:
            progress(stranger.subject)
    if not rows:
        raise BadInput(f"Nobody has more than {use} recordings of a gesture: none is left to test on with --use {use}.")
    return {
        "context": context_of(windows),
        "use": use,
        "random": random,
        "choices": len(refused),
        "refused": float(np.mean(refused)),
        "engines": {name: _summed(people) for name, people in rows.items()},
        "agreement": {when: float(np.mean([each[i] for each in same])) for i, when in enumerate(("before", "after"))}
        if same
        else None,
    }


@dataclass(frozen=True)
class _Change:
    """One choice: recordings tested, how many were right, and both scores; before and after."""

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
    """Return the recordings that adapt, as numbers of ``windows.recording``."""
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


def _parts(windows: WindowSet, chosen: set[int]) -> tuple[WindowSet, WindowSet]:
    """Return the windows that adapt and those that test."""
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


def _summed(people: list[dict[str, Any]]) -> dict[str, Any]:
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


Given = Dataset | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Adapted:
    """A bundle after a personal touch, with what it was tried on.

    ``tested``: with ``use``, the recordings that did not adapt it, before and after; None where all of them did.
    ``left_out`` counts recordings by label that could not be used, with the reason.
    """

    personal: Personal
    subject: str
    use: int | None
    tested: tuple[RecordingScores, RecordingScores] | None
    left_out: dict[str, str]
    simulated: bool

    @property
    def bundle(self) -> Bundle:
        """The adapted bundle, or the one that was given where it was left as it is."""
        return self.personal.bundle

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Save the adapted bundle.

        Raises:
            BundleError: when the bundle was left as it is: there is nothing new to save.
        """
        if not self.personal.accepted:
            raise BundleError(f"The bundle was left as it is: {self.personal.reason}.")
        return self.bundle.save(Path(path))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        done = self.personal
        return {
            "adapted": done.accepted,
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
        return f"Adapted(to {self.subject}: {'yes' if self.personal.accepted else 'no'}, {self.personal.reason})"


def adapt(
    bundle: Bundle | str | os.PathLike[str],
    recordings: Given,
    *,
    subject: str | None = None,
    use: int | None = None,
    spec: PersonalSpec | None = None,
    warn: Warn = silent,
) -> Adapted:
    """Adapt a bundle's last layer to one person, or leave it as it is where their own recordings do not show a gain.

    Args:
        recordings: a data set, or a folder as a recorder left it.
        subject: whose; may be left out where there is one person.
        use: only the first so many recordings of each gesture adapt, and the rest are scored before and after.
        warn: told what was left out, and what makes the figures say less than they seem to.

    Raises:
        BadInput: for too few recordings; DatasetError: for an unknown person or another layout;
        ConfigError: for a ``use`` that is too small; ForgottenError: when somebody was taken out of it meanwhile.
    """
    spec = spec or PersonalSpec()
    if use is not None and use < spec.least:
        raise ConfigError(f"--use {use} is too few: accepted are {spec.least} and more recordings of each gesture.")
    given = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    if (before := given.adapted_to) is not None:
        warn(f"the bundle is adapted to {before}: it is adapted anew, from what it was before")
    with tempfile.TemporaryDirectory(prefix="plushsense-") as place:
        dataset = _dataset(recordings, given, Path(place))
        person = _person(dataset, subject)
        _same_layout(given, dataset)
        _tell_of_training(given, person, warn)
        own, left_out = _only(dataset, person, given, warn)
        windows = windows_for(own, given.arch, whole_gestures(given.windowing), given.gestures, warn)
        times = {r.id: r.epoch_ms for r in own.recordings}
    adapting, test = windows, None
    if use is not None:
        first = _first(windows, times, use)
        test = windows.take(np.flatnonzero(~first))
        if not len(test):
            raise BadInput(
                f"No recording of {person} is left to test on: there are at most {use} of each gesture; use fewer."
            )
        keep = purge(windows.stream, windows.window_rows, test.stream, test.recording_rows)
        adapting = windows.take(np.flatnonzero(first & keep))
    done = personalise(given, adapting.x, adapting.y, adapting.recording, subject=person, spec=spec)
    for label in done.without:
        warn(f"{label}: fewer than {spec.least} recordings adapt it, so it is told apart as before")
    tested = None
    if test is not None:
        original = restore_original(given) if before is not None else given
        readers = (_float_reader(original), _float_reader(done.bundle if done.accepted else original))
        one, other = (judge(reader(test), test.y, test.recording).judged for reader in readers)
        tested = (one, other)
    dataset.generation.check()
    return Adapted(done, person, use, tested, left_out, dataset.head.simulated)


def _dataset(recordings: Given, bundle: Bundle, place: Path) -> Dataset:
    """Yield the data set, or a temporary one made of a recorder's folder."""
    if isinstance(recordings, Dataset) or (Path(recordings) / HEAD).is_file():
        return as_dataset(recordings)
    if not Path(recordings).exists():
        raise DatasetError(f"There is no folder '{recordings}': give a data set, or a person's folder of recordings.")
    return import_recordings(Path(recordings), place / "DS", layout=bundle.layout, gestures=bundle.gestures).dataset


def _person(dataset: Dataset, subject: str | None) -> str:
    people = dataset.subjects
    if subject is None and len(people) == 1:
        return people[0]
    listed = ", ".join(people) or "nobody"
    if subject is None:
        raise DatasetError(f"'{dataset.head.name}' holds recordings of {listed}: say whose with --subject CODE.")
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
            "adapted to recordings of the sensors that it reads."
        )


def _tell_of_training(bundle: Bundle, person: str, warn: Warn) -> None:
    for key, what in (("subjects", "trained"), ("validation_subjects", "validated")):
        people = bundle.provenance.get(key, ())
        if isinstance(people, list | tuple) and person in people:
            warn(f"the bundle was {what} on a person {person}: if that is the same one, the scores before flatter")


def _only(dataset: Dataset, person: str, bundle: Bundle, warn: Warn) -> tuple[Dataset, dict[str, str]]:
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
            f"{', '.join(bundle.gestures.labels)}."
        )
    return Dataset(dataset.path, dataset.head, known, dataset.streams), left_out


def _first(windows: WindowSet, times: dict[str, int], use: int) -> NDArray[np.bool_]:
    """Return which windows are of the first ``use`` recordings of their gesture, by the clock."""
    chosen: list[int] = []
    for k in np.unique(windows.y):
        mine = {int(r) for r in windows.recording[windows.y == k]}
        ids = windows.recording_ids
        chosen += sorted(mine, key=lambda r: (times[ids[r]], ids[r]))[:use]
    return np.isin(windows.recording, chosen)


def _float_reader(bundle: Bundle) -> Reader:
    network, scaler = bundle.network(), bundle.scaler
    return lambda windows: network.probabilities(scaler.apply(windows.x))


def _integer_reader(bundle: Bundle) -> Reader:
    network = integer_network(bundle)
    return lambda windows: integer_probabilities(network, windows.x)


def _readers(bundle: Bundle, int8: bool) -> dict[str, Reader]:
    return {"float": _float_reader(bundle)} | ({"int8": _integer_reader(bundle)} if int8 else {})


def evaluate_adapting(
    dataset: Given,
    config: RunConfig | None = None,
    *,
    split: str = "leave-one-subject-out",
    use: int = 2,
    random: int = 0,
    int8: bool = False,
    spec: PersonalSpec | None = None,
    progress: Callable[[str], None] | None = None,
    warn: Warn = silent,
    **settings: Any,
) -> dict[str, Any]:
    """Measure how much adapting helps people left out: one network for each fold, adapted to each of its people.

    The networks are kept in the data set's ``cache`` folder. Nothing of how a bundle is adapted is tuned here: each
    person's strength, and whether to adapt at all, comes of the recordings that adapt.

    Args:
        config, settings: as for `plushsense.train`.
        use, random: see `plushsense.experiments.adaptation.evaluate_adapting`.
        int8: also deploy each network, before and after.
        progress: told what is done.

    Returns:
        What `plushsense.experiments.adaptation.evaluate_adapting` returns, and ``split``, ``simulated``, ``spec``.
    """
    dataset = as_dataset(dataset)
    config = config or from_settings(**settings)
    spec = spec or PersonalSpec()
    if use < spec.least or random < 0:
        raise ConfigError(f"--use {use}, --choices {random}: accepted are {spec.least} and more, 0 and more.")
    division = parse_split(split)
    if not division.apart:
        raise ConfigError(f"The split {split} does not keep people apart: use leave-one-subject-out or by-subject:5.")
    gestures = choose_classes(dataset, config.evaluation.classes, warn)
    arch = config.model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
    if int8:
        refuse_undeployable(arch)
    windows = windows_for(dataset, arch, config.windows, gestures, warn)
    folds = fold_windows(windows, windows, division, config.evaluation.seed)
    key = {"windows": windows_fingerprint(windows), "arch": arch.to_dict(), "layout": dataset.layout.to_dict()}
    tell = progress or (lambda _: None)

    def bundle_of(fold: Fold) -> Bundle:
        made = json.dumps({**key, "fold": fold_fingerprint(fold), "training": config.training.key()}, sort_keys=True)
        path = dataset.path / CACHE / "adapting" / f"{hashlib.sha256(made.encode()).hexdigest()[:32]}.plush"
        if path.exists():
            return Bundle.load(path)
        from plushsense.training.fit import fit

        mine = windows.take(fold.train)
        fitted = fit(mine, windows.take(fold.validation), arch, config.training)
        kept = calibration(arch, fitted.weights, fitted.scaler, mine.x)
        people = {str(s) for s in mine.subject}
        bundle = Bundle(
            arch,
            fitted.weights,
            dataset.layout,
            fitted.scaler,
            gestures,
            config.to_dict()["windows"],
            config.live.to_dict(),
            {
                "dataset": dataset.head.name,
                "dataset_hash": dataset.hash,
                "simulated": dataset.head.simulated,
                "subjects": sorted(people),
                "validation_subjects": sorted({str(s) for s in windows.subject[fold.validation]}),
            },
            kept,
        )
        with dataset.generation.writing():
            bundle.save(path)
        tell(f"trained for {fold.name}, {fitted.seconds:.0f} s")
        return bundle

    def strangers() -> Iterator[Stranger]:
        for fold in folds:
            bundle = bundle_of(fold)
            before = _readers(bundle, int8)
            for person in fold.subjects:
                yield Stranger(person, before, _adapter(bundle, before, person, spec, int8))

    result = evaluate_adapting_adapting(
        windows,
        strangers(),
        {r.id: r.epoch_ms for r in dataset.recordings},
        use=use,
        random=random,
        seed=config.evaluation.seed,
        progress=lambda person: tell(f"adapted to {person}"),
    )
    how = {f.name: getattr(spec, f.name) for f in fields(spec)}
    return {"split": division.text, "simulated": dataset.head.simulated, "spec": how, **result}


def _adapter(
    bundle: Bundle, before: dict[str, Reader], person: str, spec: PersonalSpec, int8: bool
) -> Callable[[WindowSet], Touched]:
    def touch(own: WindowSet) -> Touched:
        try:
            done = personalise(bundle, own.x, own.y, own.recording, subject=person, spec=spec)
        except BadInput:
            return Touched(before, False)  # too few recordings: it stays as it is
        return Touched(_readers(done.bundle, int8), True) if done.accepted else Touched(before, False)

    return touch
