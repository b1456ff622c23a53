"""Split recordings, or windows, into training, validation and test sets.

A unit is a recording, or a window in splits of windows. Those are leaky: overlapping windows of one recording can be in
training and test. So are the sets in which an imported file held its windows (`SAVED`). A split by subject keeps the
people of test, validation (which decides when training stops) and training apart. Units of nobody (subject "none": the
toy at rest) are spread over the folds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plushsense.core.errors import ArrayError, BadInput, ConfigError, nearest
from plushsense.core.gestures import NOBODY
from plushsense.core.recorder_csv import parse_name
from plushsense.dataset.store import SAVED_SETS, sets_of_session

Index = NDArray[np.int64]

UNKNOWN = "unknown"
VALIDATION_SHARE = 0.15
# The paper trains on 70 %, validates on 15 % and tests on 15 % of the windows (section 3.6.1). The authors' script
# takes these shares of each gesture in the order of the files, which is random, as it has renamed them.
HOLDOUT_SHARE = 0.15
_FIRST_SHARES = (0.7, 0.85)
# Their names are numbers of seven digits; the recorder's are milliseconds since 1970.
_MOST_RANDOM_NUMBER = 10**8


@dataclass(frozen=True)
class Fold:
    """One fold: three disjoint index arrays into the units, each in ascending order.

    ``subjects`` are the people in the test set; only splits by subject exclude them from training.
    """

    name: str
    subjects: tuple[str, ...]
    train: Index
    validation: Index
    test: Index


@dataclass(frozen=True)
class Split:
    """A method of splitting: ``by-subject:5`` has the kind "by-subject" and ``k`` = 5 folds.

    A split without ``k`` has one fold: 70 % of each gesture for training, 15 % for validation and 15 % for test. Its
    ``order`` is random or that of the files.
    """

    kind: str
    k: int | None = None
    order: str = ""

    @property
    def text(self) -> str:
        """Name of the split, as on the command line."""
        if self in _HOLDOUTS.values():
            return next(name for name, split in _HOLDOUTS.items() if split == self)
        return self.kind if self.k is None else f"{self.kind}:{self.k}"

    @property
    def leaky(self) -> bool:
        """Whether overlapping windows of one recording can be in both training and test."""
        return self.kind in ("windows", SAVED)

    @property
    def unit(self) -> str:
        """Unit that is split: "recording" or "window"."""
        return "window" if self.leaky else "recording"

    @property
    def separates_people(self) -> bool:
        """Whether no person is in both training and test."""
        return self.kind in ("leave-one-subject-out", "by-subject")


SAVED = "saved"
_FILES, _RANDOM = "files", "random"
_HOLDOUTS = {
    "recordings:holdout": Split("recordings", order=_FILES),
    "recordings:random": Split("recordings", order=_RANDOM),
    "windows:holdout": Split("windows", order=_RANDOM),
    "windows:file-order": Split("windows", order=_FILES),
}
EXAMPLES = (
    "leave-one-subject-out",
    "by-subject:5",
    "by-recording:5",
    "windows:5",
    *_HOLDOUTS,
    SAVED,
)


def parse_split(text: str) -> Split:
    """Parse the name of a split.

    Raises:
        ConfigError: for an unknown name, with the accepted forms and the nearest of them.
    """
    kind, colon, number = text.strip().partition(":")
    if kind in ("leave-one-subject-out", SAVED) and not colon:
        return Split(kind)
    if text.strip() in _HOLDOUTS:
        return _HOLDOUTS[text.strip()]
    if kind in ("by-subject", "by-recording", "windows"):
        if number.isascii() and number.isdigit() and 2 <= int(number) <= 1000:
            return Split(kind, int(number))
        raise ConfigError(
            f"Split '{text}' needs a number of folds from 2 to 1000 after the colon: for example {kind}:5"
        )
    similar = nearest(text.replace("person", "subject"), EXAMPLES)
    raise ConfigError(f"Unknown split '{text}': accepted are {', '.join(EXAMPLES)}.{similar}")


def make_folds(
    split: Split, subject: NDArray[np.str_], label: Index, seed: int = 0, names: NDArray[Any] | None = None
) -> list[Fold]:
    """Return the folds of ``split`` for units with these people and classes, both (n,). Deterministic for a ``seed``.

    Args:
        names: the recording of each unit (n,), for splits in the order of the files (see `file_order`); by default the
            order of the units. For the split `SAVED`, those of an imported file.

    Raises:
        BadInput: if there are too few people or units for the split, or, when splitting by people, unknown ones; for
            `SAVED`, if the recordings name no sets.
    """
    if len(subject) != len(label):
        raise BadInput(f"A split needs one class for each unit: got {len(subject)} people and {len(label)} classes.")
    if split.kind == "leave-one-subject-out":
        people = _people(subject, split.kind, 3)
        # The folds are in the order of the codes; 15 % of the other people, at least one, are for validation.
        return _by_people(subject, [(person,) for person in people], people, seed)
    if split.kind == "by-subject":
        return by_subject(subject, split.k or 5, seed)
    if split.kind == "by-recording":
        return by_recording(subject, label, split.k or 5, seed)
    if split.k is not None:
        return windows(subject, label, split.k, seed)
    if split.kind == SAVED:
        return [_saved(subject, np.full(len(label), "") if names is None else names)]
    _enough(len(label), 3, split.text, f"{split.unit}s")
    if split.order == _FILES:
        ranks, name = (np.arange(len(label)), "holdout") if names is None else file_order(names, seed)
        return [_first_shares(subject, label, ranks, name)]
    if split.kind == "recordings":
        order = np.random.default_rng([seed, 7]).permutation(len(label))
        return [_first_shares(subject, label, order, "holdout")]
    return [_random_holdout(subject, label, seed)]


class Splitter:
    """A split as a splitter of scikit-learn, with the folds of `evaluate`; scikit-learn is not needed.

        cv = Splitter("leave-one-subject-out", windows.subject, windows.recording)
        cross_val_score(model, windows.x, windows.y, cv=cv)

    The people whom `evaluate` holds out for validation are among those to train on. Windows that overlap a test
    recording in its stream, which `evaluate` leaves out, are not known here: with splits by recording, use windows of
    the context ``loop``. ``recordings:holdout`` and ``windows:file-order`` take ``recordings`` for the names of files.

    Args:
        split: the name of a split (see `parse_split`).
        groups: the person of each window (N,), "none" for nobody; without it, that given to `split`.
        recordings: the recording of each window (N,), to keep its windows together. It can be left out if the split is
            by person and every window has one, or if it is of windows.
    """

    def __init__(
        self,
        split: str = "leave-one-subject-out",
        groups: ArrayLike | None = None,
        recordings: ArrayLike | None = None,
        seed: int = 0,
    ) -> None:
        self.kind, self.seed = parse_split(split), seed
        self.groups, self.recordings = groups, recordings

    def split(
        self, X: Any, y: ArrayLike | None = None, groups: ArrayLike | None = None
    ) -> Iterator[tuple[Index, Index]]:
        """Return pairs of indices of windows, to train on and to test on.

        Raises:
            ArrayError: if people or recordings are missing, or there are more or fewer than windows.
            BadInput: like `make_folds`.
        """
        people = self.groups if self.groups is not None else groups
        n = len(X if X is not None else people if people is not None else [])
        subject = np.asarray(np.full(n, UNKNOWN) if people is None else people).astype(str)
        units = np.arange(n) if self.recordings is None else np.unique(self.recordings, return_inverse=True)[1]
        for name, values in (("groups", subject), ("recordings", units)):
            if values.shape != (n,):
                raise ArrayError(f"{name} has the shape {values.shape}: expected ({n},), one a window.")
        together = not self.kind.separates_people or NOBODY in subject
        if self.recordings is None and together and not self.kind.leaky:
            raise ArrayError(
                f"The split {self.kind.text} must know which windows are of one recording: give recordings, such as "
                "windows.recording."
            )
        if self.kind.leaky:
            units = np.arange(n)
        first = np.unique(units, return_index=True)[1]
        label = np.zeros(n, dtype=np.int64) if y is None else np.unique(y, return_inverse=True)[1]
        names = None if self.recordings is None else np.asarray(self.recordings)[first]
        for fold in make_folds(self.kind, subject[first], label[first], self.seed, names):
            tested = np.isin(units, fold.test)
            yield np.flatnonzero(~tested), np.flatnonzero(tested)

    def get_n_splits(self, X: Any = None, y: ArrayLike | None = None, groups: ArrayLike | None = None) -> int:
        """Return the number of folds; for leave-one-subject-out that of the people, who must be known."""
        if self.kind.kind != "leave-one-subject-out":
            return self.kind.k or 1
        people = self.groups if self.groups is not None else groups
        return len(_people(np.asarray([] if people is None else people).astype(str), self.kind.text, 3))


def by_subject(subject: NDArray[np.str_], k: int, seed: int = 0) -> list[Fold]:
    """Divide the people into ``k`` test groups; 15 % of the other people, at least one, are for validation."""
    people = _people(subject, f"by-subject:{k}", max(k, 3))
    dealt = np.random.default_rng([seed, 1]).permutation(people).tolist()
    groups = [tuple(sorted(dealt[i::k])) for i in range(k)]
    if min(len(people) - len(group) for group in groups) < 2:
        raise BadInput(
            f"by-subject:{k} leaves one person to train and validate: use leave-one-subject-out.",
            reason="one_person_left",
        )
    return _by_people(subject, groups, people, seed)


def by_recording(subject: NDArray[np.str_], label: Index, k: int, seed: int = 0) -> list[Fold]:
    """Divide the recordings into ``k`` test groups, balanced by class and person; validate on 15 % of the others."""
    _enough(len(label), max(k, 3), f"by-recording:{k}", "recordings")
    return _stratified(subject, label, k, seed, strata=subject)


def windows(subject: NDArray[np.str_], label: Index, k: int, seed: int = 0) -> list[Fold]:
    """Divide the windows into ``k`` test groups, balanced by class; validate on 15 % of the others. Leaky."""
    _enough(len(label), max(k, 3), f"windows:{k}", "windows")
    return _stratified(subject, label, k, seed, strata=np.full(len(label), ""))


def _random_holdout(subject: NDArray[np.str_], label: Index, seed: int = 0) -> Fold:
    """Return the paper's split: 70 % of the windows for training, 15 % validation, 15 % test, by class. Leaky."""
    everything = np.arange(len(label), dtype=np.int64)
    rng = np.random.default_rng([seed, 3])
    test = _stratified_share(everything, label, HOLDOUT_SHARE, rng)
    rest = np.setdiff1d(everything, test)
    validation = _stratified_share(rest, label, VALIDATION_SHARE / (1.0 - HOLDOUT_SHARE), rng)
    return Fold("holdout", _named(subject[test]), np.setdiff1d(rest, validation), validation, test)


def _saved(subject: NDArray[np.str_], names: NDArray[Any]) -> Fold:
    """Return the sets in which the file that was imported held the windows, according to their sessions."""
    found = np.full(len(names), "", dtype="<U10")
    for name in np.unique(names).tolist():
        mine = np.flatnonzero(names == name)
        sets = sets_of_session(str(name).split("/")[-2:][0], len(mine))
        if not sets:
            raise BadInput(
                f"The split {SAVED} takes the sets of a file of windows, and '{name}' is in none: import a .mat file "
                f"with traindata, valdata and testdata, or use {', '.join(_HOLDOUTS)}.",
                reason="no_saved_sets",
                recording=str(name),
            )
        if len(sets) != len(mine):
            raise BadInput(
                f"'{name}' has {len(mine)} windows, but {len(sets)} in the file that was imported: cut windows of the "
                "same length and step (2.5 s, 0.5 s) in the context rows, without trims.",
                reason="saved_sets_differ",
                recording=str(name),
                n=len(mine),
                of=len(sets),
            )
        found[mine] = sets
    train, validation, test = (np.flatnonzero(found == one) for one in SAVED_SETS)
    for part, one in ((train, SAVED_SETS[0]), (test, SAVED_SETS[2])):
        _enough(len(part), 1, f"{SAVED}, set '{one}',", "windows")
    return Fold(SAVED, _named(subject[test]), train, validation, test)


def file_order(names: NDArray[Any], seed: int = 0) -> tuple[Index, str]:
    """Return the ranks (n,) of recordings in the order of the authors' script, and the name of the fold.

    The script takes the files by name, after it has replaced the time in each name by a random number. Recordings with
    such names are taken by name; others, whose names sort person by person, in a random order of the ``seed``.

    Args:
        names: file names of the recordings (n,), with or without folder, or numbers that stand for them; the windows
            of a recording have the same.
    """
    unique, place = np.unique(names, return_inverse=True)
    files = [str(name).rpartition("/")[2].removesuffix(".csv") + ".csv" for name in unique.tolist()]
    parsed = [name for name in map(parse_name, files) if name is not None]
    if 2 * sum(name.epoch_ms < _MOST_RANDOM_NUMBER for name in parsed) > len(files):
        order, how = np.argsort(np.array(files), kind="stable"), "holdout, files by name"
    else:
        order, how = np.random.default_rng([seed, 7]).permutation(len(files)), "holdout, files shuffled"
    return np.argsort(order)[place].astype(np.int64), how


def _first_shares(subject: NDArray[np.str_], label: Index, ranks: Index, name: str) -> Fold:
    """Train on the first 70 % of each class, validate on the next 15 % and test on the rest, rounded half up."""
    parts: list[list[Index]] = [[], [], []]
    for one in np.unique(label):
        units = np.flatnonzero(label == one)
        units = units[np.argsort(ranks[units], kind="stable")]
        ends = [math.floor(share * len(units) + 0.5) for share in _FIRST_SHARES]
        for part, of in zip(parts, np.split(units, ends), strict=True):
            part.append(of)
    train, validation, test = (np.sort(np.concatenate(part)) for part in parts)
    return Fold(name, _named(subject[test]), train, validation, test)


def purge(
    stream: NDArray[np.str_], rows: Index, tested_stream: NDArray[np.str_], tested_rows: Index
) -> NDArray[np.bool_]:
    """Return which windows (n,) may be used for training: those that overlap no test recording in their stream.

    Args:
        stream, rows: stream id (n,) and row range (n, 2), with exclusive end, of each window; "" and −1 mean none.
        tested_stream, tested_rows: the same for the test recordings, (m,) and (m, 2).
    """
    keep = np.ones(len(stream), dtype=np.bool_)
    for name in np.unique(tested_stream[tested_rows[:, 0] >= 0]):
        mine = np.flatnonzero((stream == name) & (rows[:, 0] >= 0))
        there = tested_rows[(tested_stream == name) & (tested_rows[:, 0] >= 0)]
        if name == "" or not len(mine):
            continue
        first, last = rows[mine, 0, None], rows[mine, 1, None]
        keep[mine] = ~((first < there[:, 1]) & (there[:, 0] < last)).any(axis=1)
    return keep


def _named(subject: NDArray[np.str_]) -> tuple[str, ...]:
    return tuple(sorted({str(s) for s in subject} - {NOBODY}))


def _people(subject: NDArray[np.str_], split: str, needed: int) -> list[str]:
    people = list(_named(subject))
    if UNKNOWN in people:
        raise BadInput(
            f"{split} needs to know who made each recording, but {int((subject == UNKNOWN).sum())} lack it: "
            "import them again with a mapping file (--subjects map.csv), or use by-recording:5.",
            reason="split_needs_people",
            n=int((subject == UNKNOWN).sum()),
        )
    if len(people) < needed:
        raise BadInput(
            f"{split} needs at least {needed} people (test, validation, training); there are {len(people)} "
            f"({', '.join(people) or 'nobody'}): record more people, or use by-recording:5, which says nothing about "
            "new people.",
            reason="few_people",
            n=len(people),
            needed=needed,
        )
    return people


def _enough(n: int, needed: int, split: str, units: str) -> None:
    if n < needed:
        raise BadInput(
            f"{split} needs at least {needed} {units}; there are {n}.", reason="few_units", n=n, needed=needed
        )


def _by_people(subject: NDArray[np.str_], groups: list[tuple[str, ...]], people: list[str], seed: int) -> list[Fold]:
    nobody = np.flatnonzero(subject == NOBODY)
    dealt = np.random.default_rng([seed, 2]).permutation(nobody)
    folds = []
    for i, group in enumerate(groups):
        rng = np.random.default_rng([seed, 4, i])
        others = [person for person in people if person not in group]
        held_back = rng.permutation(others)[: max(1, round(VALIDATION_SHARE * len(others)))]
        at_rest = dealt[i :: len(groups)]
        rest = rng.permutation(np.setdiff1d(nobody, at_rest))
        resting = rest[: round(VALIDATION_SHARE * len(rest)) or int(len(rest) > 1)]
        test = np.union1d(np.flatnonzero(np.isin(subject, group)), at_rest)
        validation = np.union1d(np.flatnonzero(np.isin(subject, held_back)), resting)
        name = group[0] if len(group) == 1 else f"fold {i + 1}"
        train = np.setdiff1d(np.arange(len(subject)), np.union1d(test, validation))
        folds.append(Fold(name, group, train, validation, test))
    return folds


def _stratified(subject: NDArray[np.str_], label: Index, k: int, seed: int, strata: NDArray[np.str_]) -> list[Fold]:
    """Divide units into ``k`` random test groups with equal shares of each class, and within it of each stratum."""
    rng = np.random.default_rng([seed, 5])
    order = np.lexsort((rng.random(len(label)), strata, label))
    group = np.empty(len(label), dtype=np.int64)
    group[order] = np.arange(len(label)) % k
    folds = []
    for i in range(k):
        test, rest = np.flatnonzero(group == i), np.flatnonzero(group != i)
        validation = _stratified_share(rest, label, VALIDATION_SHARE, np.random.default_rng([seed, 6, i]))
        train = np.setdiff1d(rest, validation)
        folds.append(Fold(f"fold {i + 1}", _named(subject[test]), train, validation, test))
    return folds


def _stratified_share(units: Index, label: Index, share: float, rng: np.random.Generator) -> Index:
    """Draw about ``share`` of ``units``, at least one, balanced by class; return them in ascending order."""
    order = units[np.lexsort((rng.random(len(units)), label[units]))]
    count = max(1, round(share * len(units)))
    # Evenly spaced in class order from a random offset, so that each class has its share, give or take one.
    places = (np.arange(count) + rng.random()) * len(units) / count
    return np.sort(order[places.astype(np.int64)])
