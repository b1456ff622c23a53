"""What people do with the toy: gestures, their affect and family, and the set that fixes their class order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import GestureError, nearest
from plushsense.core.tomlfile import builtin_names, read_named, refuse_unknown

AFFECTS = ("positive", "neutral", "negative", "none")
NOBODY = "none"


def plain_label(label: str) -> str:
    """A label as it is compared: without case, and with ``_`` and runs of space as one space."""
    return " ".join(label.replace("_", " ").split()).casefold()


@dataclass(frozen=True)
class Gesture:
    """One gesture: its label, the affect it carries ("none" where nobody said), and its family of look-alikes.

    ``free_choice`` marks a label under which everybody did something else; ``nobody`` one that is recorded without a
    person (the toy at rest). ``idle``: it means that nothing happens, so that it never makes an event; ``energetic``:
    so abrupt that threshold rules may notice it before the network does.
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
        for key in ("label", "affect", "family", "description"):
            if not isinstance(getattr(self, key), str):
                raise GestureError(f"Gesture {self.label!r}: {key} is {getattr(self, key)!r}; it must be a text.")
        for key in ("free_choice", "nobody", "idle", "energetic"):
            if not isinstance(getattr(self, key), bool):
                raise GestureError(
                    f"Gesture '{self.label}': {key} is {getattr(self, key)!r}; it must be true or false."
                )
        if not plain_label(self.label):
            raise GestureError("A gesture has an empty label: give it a word.")
        if self.affect not in AFFECTS:
            raise GestureError(
                f"Gesture '{self.label}' has the affect '{self.affect}'; accepted are {', '.join(AFFECTS)}."
                f"{nearest(self.affect, AFFECTS)}"
            )
        if not self.family:
            object.__setattr__(self, "family", self.label)


@dataclass(frozen=True)
class GestureSet:
    """An ordered set of gestures; the order is the class index."""

    name: str
    gestures: tuple[Gesture, ...]
    inferred: bool = False

    def __post_init__(self) -> None:
        plain = [plain_label(g.label) for g in self.gestures]
        doubled = sorted({g.label for g in self.gestures if plain.count(plain_label(g.label)) > 1})
        if doubled:
            raise GestureError(f"Gesture set '{self.name}' holds '{doubled[0]}' twice: labels must differ.")

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
    def tells_affect(self) -> bool:
        """Whether any gesture carries an affect; in a set where none does, a gesture without one is nothing odd."""
        return any(g.affect != "none" for g in self.gestures)

    @property
    def families(self) -> tuple[str, ...]:
        """Family of each class."""
        return tuple(g.family for g in self.gestures)

    def find(self, label: str) -> Gesture | None:
        """The gesture of a label, ignoring case and ``_`` against space; None when it is not in the set."""
        wanted = plain_label(label)
        return next((g for g in self.gestures if plain_label(g.label) == wanted), None)

    def get(self, label: str) -> Gesture:
        """The gesture of a label; GestureError with the nearest one when it is not in the set."""
        found = self.find(label)
        if found is None:
            raise GestureError(
                f"'{label}' is not in the gesture set '{self.name}', which holds: {', '.join(self.labels)}."
                f"{nearest(label, self.labels)}"
            )
        return found

    def index(self, label: str) -> int:
        """Class index of a label."""
        return self.gestures.index(self.get(label))

    def subset(self, labels: Iterable[str]) -> GestureSet:
        """The gestures of ``labels``, in this set's order."""
        wanted = {self.get(label) for label in labels}
        return GestureSet(self.name, tuple(g for g in self.gestures if g in wanted), self.inferred)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: dict[str, Any], where: str = "gesture set") -> GestureSet:
        """A gesture set from plain values (a TOML file, a bundle)."""
        refuse_unknown(table, cls.__dataclass_fields__, where, GestureError)
        gestures = []
        try:
            for entry in table["gestures"]:
                if not isinstance(entry, dict):
                    raise TypeError(f"{entry!r} is not a table")
                refuse_unknown(entry, Gesture.__dataclass_fields__, f"{where}, gestures", GestureError)
                gestures.append(Gesture(**entry))
            return cls(str(table["name"]), tuple(gestures), bool(table.get("inferred", False)))
        except KeyError as missing:
            raise GestureError(f"The {where} lacks the key {missing}: add it.") from None
        except TypeError as cause:
            raise GestureError(f"The {where} holds an entry that does not fit: {cause}.") from None

    @classmethod
    def infer(cls, labels: Iterable[str], name: str = "inferred") -> GestureSet:
        """The set that a folder of recordings implies: its labels in alphabetical order, affect unknown.

        Labels that differ only in case, or ``_`` against space, are one gesture; the first spelling wins.
        ``Custom`` is the GestureRecorder's own word for a gesture of the recorder's choice: free choice.
        """
        spellings: dict[str, str] = {}
        for label in labels:
            spellings.setdefault(plain_label(label), label)
        gestures = tuple(Gesture(s, free_choice=plain_label(s) == "custom") for s in sorted(spellings.values()))
        return cls(name, gestures, inferred=True)


def gesture_set_names() -> tuple[str, ...]:
    """Names of the built-in gesture sets."""
    return builtin_names("gestures")


def load_gestures(name_or_path: str | Path) -> GestureSet:
    """A built-in gesture set by name, or one of the user's own by the path of its TOML file."""
    table, source = read_named(name_or_path, "gestures", "gesture set", GestureError)
    return GestureSet.from_dict(table, f"gesture set '{source}'")
