"""Gestures with their affect and family, and gesture sets, whose order is the class order of a model."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from plushsense.core.errors import GestureError, nearest
from plushsense.core.toml import builtin_names, load_table, read_named

AFFECTS = ("positive", "neutral", "negative", "none")
NOBODY = "none"
FAMILY, AFFECT = "family", "affect"
IDLE_LABELS = frozenset({"at rest", "idle", "no gesture", "no touch", "nothing"})
"""Labels, in the form of `plain_label`, of recordings in which nothing happens, where no gesture set says more.

``rest`` is not among them: a hand may rest on a toy.
"""


@lru_cache(maxsize=1024)
def plain_label(label: str) -> str:
    """Normalise a label for comparison: fold case, and turn ``_`` and runs of white space into one space.

    Accents are composed (NFC): macOS stores them apart from their letters in names of files.
    """
    return unicodedata.normalize("NFC", " ".join(label.replace("_", " ").split()).casefold())


def alike_labels(labels: Iterable[str]) -> list[list[str]]:
    """Return groups of labels that differ in punctuation and spaces only, as ``Midair 'S'`` and ``Midair _S_``."""
    groups: dict[str, dict[str, str]] = {}
    for label in labels:
        groups.setdefault(re.sub(r"[\W_]+", "", label.casefold()), {}).setdefault(plain_label(label), label)
    return [sorted(group.values()) for letters, group in groups.items() if letters and len(group) > 1]


@dataclass(frozen=True)
class Gesture:
    """A gesture that people make on the toy; a class of a model.

    Attributes:
        label: name of the gesture, as recordings have it. Upper and lower case are the same, and ``_`` is a space.
        affect: how the gesture is meant; ``none``: not known (one of `AFFECTS`).
        family: name of a group of similar gestures, such as those of one part of the toy (default: the label).
        free_choice: whether each person chose what to do. Such gestures are not among the shared classes.
        nobody: whether it is recorded without a person, such as the toy at rest.
        idle: whether it means that nothing happens. It never starts an event.
        energetic: whether it is so abrupt that threshold rules may detect it before the network does.
        description: what the person does; shown as the prompt of a session where the protocol has none.
        labels: further labels of recordings that are this gesture, as in a set of merged gestures.
    """

    label: str
    affect: str = "none"
    family: str = ""
    free_choice: bool = False
    nobody: bool = False
    idle: bool = False
    energetic: bool = False
    description: str = ""
    labels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not plain_label(self.label):
            raise GestureError("A gesture has an empty label: give it a label.")
        if self.affect not in AFFECTS:
            raise GestureError(
                f"Gesture '{self.label}' has the affect '{self.affect}'; accepted are {', '.join(AFFECTS)}."
                f"{nearest(self.affect, AFFECTS)}"
            )
        if not self.family:
            object.__setattr__(self, "family", self.label)


@dataclass(frozen=True)
class GestureSet:
    """An ordered set of gestures; the position of a gesture is its class index.

    Attributes:
        name: name of the set.
        gestures: the gestures in class order, which is that of the outputs of a model.
        inferred: whether an import made the set from the labels of the recordings, because none was given.
    """

    name: str
    gestures: tuple[Gesture, ...]
    inferred: bool = False

    def __post_init__(self) -> None:
        names = [(label, plain_label(label)) for g in self.gestures for label in (g.label, *g.labels)]
        counts = Counter(name for _, name in names)
        doubled = sorted({label for label, name in names if counts[name] > 1})
        if doubled:
            raise GestureError(f"Gesture set '{self.name}' has '{doubled[0]}' twice: labels must differ.")

    def __len__(self) -> int:
        return len(self.gestures)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels in class order."""
        return tuple(g.label for g in self.gestures)

    @property
    def affects(self) -> tuple[str, ...]:
        """Affect of each class."""
        return tuple(g.affect for g in self.gestures)

    @property
    def has_affect(self) -> bool:
        """Return whether any gesture of the set has an affect."""
        return any(g.affect != "none" for g in self.gestures)

    @property
    def families(self) -> tuple[str, ...]:
        """Family of each class."""
        return tuple(g.family for g in self.gestures)

    def find(self, label: str) -> Gesture | None:
        """Return the gesture with this label, with case ignored and ``_`` equal to a space; None if not in the set."""
        plain = plain_label(label)
        return next((g for g in self.gestures if plain in map(plain_label, (g.label, *g.labels))), None)

    def get(self, label: str) -> Gesture:
        """Return the gesture with this label; raise GestureError with the nearest label if it is not in the set."""
        found = self.find(label)
        if found is None:
            raise GestureError(
                "'{gesture}' is not in the gesture set '{name}', which has: {labels}.{hint}",
                gesture=label,
                name=self.name,
                labels=", ".join(self.labels),
                hint=nearest(label, self.labels),
            )
        return found

    def index(self, label: str) -> int:
        """Return the class index of a label."""
        return self.gestures.index(self.get(label))

    def subset(self, labels: Iterable[str]) -> GestureSet:
        """Return a set with only the gestures in ``labels``, in the order of this set."""
        chosen = {self.get(label) for label in labels}
        return GestureSet(self.name, tuple(g for g in self.gestures if g in chosen), self.inferred)

    def merged(self, groups: Sequence[Sequence[int]], labels: Mapping[int, str] | None = None) -> GestureSet:
        """Return the set in which the gestures of each group of class indices are one.

        Args:
            labels: label by the first index of a group; by default that of the family if the group is the whole family,
                otherwise the labels of its members joined by "+".
        """
        made = []
        for group in groups:
            members = [self.gestures[k] for k in group]
            first = members[0]
            if len(members) == 1 and group[0] not in (labels or {}):
                made.append(first)
                continue
            family = {g.label for g in self.gestures if g.family == first.family}
            whole = family == {g.label for g in members}
            label = (labels or {}).get(group[0]) or (first.family if whole else " + ".join(g.label for g in members))
            made.append(
                Gesture(
                    label,
                    first.affect,
                    family=label,
                    nobody=all(g.nobody for g in members),
                    idle=all(g.idle for g in members),
                    energetic=all(g.energetic for g in members),
                    description="; ".join(g.description for g in members if g.description),
                    labels=tuple(name for g in members for name in (g.label, *g.labels) if name != label),
                )
            )
        return GestureSet(f"{self.name}, {len(groups)} classes", tuple(made))

    def merged_by(self, choice: str) -> GestureSet:
        """Return the set in which similar gestures are one.

        Args:
            choice: "family": gestures of one family, as on the table and in the hands; "affect": those of one affect,
                but not those of an unknown one; the name of a built-in merge, or the path of the TOML file of a
                gesture set, which may have other gestures than this one.

        Raises:
            GestureError: for an unknown name, a file that cannot be read, or "affect" without any affect.
        """
        if choice == FAMILY:
            return self.merged(_groups(self.families))
        if choice == AFFECT:
            if not self.has_affect:
                raise GestureError(f"The gestures of '{self.name}' have no affect: merge them by family or a file.")
            known = [a if a != "none" else f"\0{k}" for k, a in enumerate(self.affects)]
            groups = _groups(known)
            return self.merged(groups, {g[0]: self.affects[g[0]] for g in groups if self.affects[g[0]] != "none"})
        if choice not in builtin_names("merges") and not choice.endswith(".toml"):
            raise GestureError(
                f"Unknown set of merged gestures '{choice}': accepted are {', '.join(merge_names())}, and the path of "
                f"a TOML file.{nearest(choice, merge_names())}"
            )
        table, source = read_named(choice, "merges", "gesture set", GestureError)
        return GestureSet.from_dict(table, f"gesture set '{source}'")

    def groups_of(self, merged: GestureSet) -> tuple[tuple[int, ...], ...]:
        """Return the class indices that are one gesture of ``merged``; gestures that it does not contain stay alone."""
        found = (merged.find(label) for label in self.labels)
        return _groups(g.label if g else f"\0{k}" for k, g in enumerate(found))

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        table = asdict(self)
        for gesture in table["gestures"]:
            # Files of sets without merged gestures stay as they were.
            if not gesture["labels"]:
                del gesture["labels"]
        return table

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str = "gesture set") -> GestureSet:
        """Create a gesture set from plain values, as in a TOML file or a bundle; ``where`` names it in messages.

        Raises:
            GestureError: for an unknown or missing key, or a value of the wrong type or out of range.
        """
        return load_table(table, cls, where, GestureError)

    @classmethod
    def infer(cls, labels: Iterable[str], name: str = "inferred") -> GestureSet:
        """Create a gesture set from the labels of recordings, in alphabetical order, with unknown affects.

        Labels that differ only in case, or in ``_`` and spaces, become one gesture with the first spelling. ``Custom``
        is the GestureRecorder's label for a gesture of free choice, and the labels of `IDLE_LABELS` are idle.
        """
        spellings: dict[str, str] = {}
        for label in labels:
            spellings.setdefault(plain_label(label), label)
        gestures = tuple(
            Gesture(label, free_choice=plain == "custom", idle=plain in IDLE_LABELS)
            for plain, label in sorted(spellings.items(), key=lambda pair: pair[1])
        )
        return cls(name, gestures, inferred=True)


def _groups(names: Iterable[str]) -> tuple[tuple[int, ...], ...]:
    """Return the indices of equal names, in the order of their first ones."""
    groups: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        groups.setdefault(name, []).append(k)
    return tuple(map(tuple, groups.values()))


def merge_names() -> tuple[str, ...]:
    """Return the choices of `GestureSet.merged_by` besides files."""
    return (FAMILY, AFFECT, *builtin_names("merges"))


def gesture_set_names() -> tuple[str, ...]:
    """Return the names of the built-in gesture sets."""
    return builtin_names("gestures")


def load_gestures(name_or_path: str | Path) -> GestureSet:
    """Load a built-in gesture set by its name, or any other by the path of its TOML file."""
    table, source = read_named(name_or_path, "gestures", "gesture set", GestureError)
    return GestureSet.from_dict(table, f"gesture set '{source}'")
