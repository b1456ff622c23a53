"""Gestures, their affect and family, and gesture sets, which fix the class order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import GestureError, nearest
from plushsense.core.toml import builtin_names, load_table, read_named

AFFECTS = ("positive", "neutral", "negative", "none")
NOBODY = "none"


def plain_label(label: str) -> str:
    """Normalise a label for comparison: lower case, with ``_`` and runs of spaces as one space."""
    return " ".join(label.replace("_", " ").split()).casefold()


@dataclass(frozen=True)
class Gesture:
    """A gesture.

    Attributes:
        affect: one of `AFFECTS`; "none" where unknown.
        family: a name for similar gestures; default: the label.
        free_choice: each person chose what to do.
        nobody: recorded without a person (the toy at rest).
        idle: never starts an event.
        energetic: so abrupt that threshold rules may detect it before the network does.
    """

    label: str
    affect: str = "none"
    family: str = ""
    free_choice: bool = False
    nobody: bool = False
    idle: bool = False
    energetic: bool = False
    description: str = ""

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
    """An ordered set of gestures; the order is the class index.

    A TOML file has the keys ``name`` and ``gestures``, a list of tables with the keys of `Gesture`.
    """

    name: str
    gestures: tuple[Gesture, ...]
    inferred: bool = False

    def __post_init__(self) -> None:
        plain = [plain_label(g.label) for g in self.gestures]
        doubled = sorted({g.label for g in self.gestures if plain.count(plain_label(g.label)) > 1})
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
        """Return the gesture of a label, ignoring case and ``_`` against space; None when it is not in the set."""
        plain = plain_label(label)
        return next((g for g in self.gestures if plain_label(g.label) == plain), None)

    def get(self, label: str) -> Gesture:
        """Return the gesture of a label; raise GestureError with the nearest label when it is not in the set."""
        found = self.find(label)
        if found is None:
            raise GestureError(
                f"'{label}' is not in the gesture set '{self.name}', which has: {', '.join(self.labels)}."
                f"{nearest(label, self.labels)}"
            )
        return found

    def index(self, label: str) -> int:
        """Return the class index of a label."""
        return self.gestures.index(self.get(label))

    def subset(self, labels: Iterable[str]) -> GestureSet:
        """Return the set of the gestures of ``labels``, in this set's order."""
        chosen = {self.get(label) for label in labels}
        return GestureSet(self.name, tuple(g for g in self.gestures if g in chosen), self.inferred)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str = "gesture set") -> GestureSet:
        """Return the gesture set that plain values describe (a TOML file, a bundle).

        Raises:
            GestureError: for an unknown or missing key, or a value that does not fit.
        """
        return load_table(table, cls, where, GestureError)

    @classmethod
    def infer(cls, labels: Iterable[str], name: str = "inferred") -> GestureSet:
        """Return a gesture set for the labels of recordings, in alphabetical order, with unknown affects.

        Labels that differ only in case, or in ``_`` and space, are one gesture in its first spelling. ``Custom`` is the
        GestureRecorder's label for a gesture of free choice.
        """
        spellings: dict[str, str] = {}
        for label in labels:
            spellings.setdefault(plain_label(label), label)
        gestures = tuple(Gesture(s, free_choice=plain_label(s) == "custom") for s in sorted(spellings.values()))
        return cls(name, gestures, inferred=True)


def gesture_set_names() -> tuple[str, ...]:
    """Return the names of the built-in gesture sets."""
    return builtin_names("gestures")


def load_gestures(name_or_path: str | Path) -> GestureSet:
    """Load a built-in gesture set by name, or one of the user's own by the path of its TOML file."""
    table, source = read_named(name_or_path, "gestures", "gesture set", GestureError)
    return GestureSet.from_dict(table, f"gesture set '{source}'")
