"""What is recorded in a session, in which order, and what the person reads: a protocol is a TOML file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.gestures import GestureSet, load_gestures, plain_label
from plushsense.core.recfile import parse_name, recording_filename
from plushsense.core.tomlfile import builtin_names, read_named, refuse_unknown

ORDERS = {
    "gesture": "all repetitions of a gesture one after another, as in the paper",
    "round": "every gesture once, then every gesture again",
}
DEFAULT = "default"
"""The wording that is read where the chosen one is missing; without it, the gesture's description."""

_LIMITS = {"countdown_s": (0.0, 60.0), "shortest_s": (0.0, 60.0), "longest_s": (1.0, 36_000.0)}


@dataclass(frozen=True)
class Step:
    """One recording to be made: its number in the session from 0, and what the person reads."""

    number: int
    gesture: str
    repetition: int
    prompt: str


@dataclass(frozen=True)
class Protocol:
    """A session's plan, resolved: every gesture has its prompt.

    Attributes:
        gestures: labels in the order in which they are asked for.
        prompts: what the person reads, one a gesture.
        repetitions: recordings of each gesture.
        order: see `ORDERS`.
        countdown_s: from the first press of the space bar to the first row.
        shortest_s: a second press within it is a slip and does not stop.
        longest_s: a recording that nobody stopped ends here by itself; nothing is lost by that.
        words: the wording that was chosen.
        nobody: gestures that are recorded without a person.
    """

    name: str
    title: str
    gesture_set: str
    gestures: tuple[str, ...]
    prompts: dict[str, str]
    repetitions: int = 3
    order: str = "gesture"
    countdown_s: float = 3.0
    shortest_s: float = 0.5
    longest_s: float = 60.0
    words: str = DEFAULT
    nobody: tuple[str, ...] = ()

    @property
    def needs_nobody(self) -> bool:
        """Whether the whole session is the toy's alone."""
        return set(self.nobody) >= set(self.gestures)

    def steps(self) -> tuple[Step, ...]:
        """All recordings of the session, in order."""
        times = range(1, self.repetitions + 1)
        if self.order == "round":
            pairs = [(g, r) for r in times for g in self.gestures]
        else:
            pairs = [(g, r) for g in self.gestures for r in times]
        return tuple(Step(n, g, r, self.prompts[g]) for n, (g, r) in enumerate(pairs))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_dict` makes the same protocol of them, without any other file."""
        return asdict(self) | {"gestures": list(self.gestures), "nobody": list(self.nobody)}

    @classmethod
    def from_dict(
        cls, table: Mapping[str, Any], where: str = "protocol", words: str | None = None, beside: Path | None = None
    ) -> Protocol:
        """A protocol from plain values: a TOML file, or what `to_dict` gave.

        Args:
            where: to quote in messages.
            words: the wording to read; None: the one that the table names, else "default".
            beside: a folder in which the gesture set's file is looked for, too.

        Raises:
            ConfigError: for an unknown key, or a value that does not fit.
            GestureError: for a gesture that is not in the set.
        """
        refuse_unknown(table, [f.name for f in fields(cls)], where, ConfigError)
        for key in ("name", "gesture_set"):
            if key not in table:
                raise ConfigError(f"The {where} lacks the key {key}: add it.")
        for key in ("name", "title", "gesture_set", "order", "words"):
            if not isinstance(table.get(key, ""), str):
                raise ConfigError(f"The {where}: {key} is {table[key]!r}; it must be a text.")
        if not table["name"].strip():
            raise ConfigError(f"The {where} has an empty name: give it one.")
        order = table.get("order", "gesture")
        if order not in ORDERS:
            raise ConfigError(
                f"The {where}: order is '{order}'; accepted are {', '.join(ORDERS)}.{nearest(order, ORDERS)}"
            )
        repetitions = table.get("repetitions", 3)
        if type(repetitions) is not int or not 1 <= repetitions <= 1000:
            raise ConfigError(f"The {where}: repetitions is {repetitions!r}; a whole number, 1 to 1000, is accepted.")
        gestures, prompts, nobody, chosen = _resolved(table, where, words or table.get("words") or DEFAULT, beside)
        seconds = {key: _seconds(table, key, where) for key in _LIMITS if key in table}
        made = cls(
            name=table["name"],
            title=table.get("title") or table["name"],
            gesture_set=table["gesture_set"],
            gestures=gestures,
            prompts=prompts,
            repetitions=repetitions,
            order=order,
            words=chosen,
            nobody=nobody,
            **seconds,
        )
        if made.shortest_s >= made.longest_s:
            raise ConfigError(
                f"The {where}: shortest_s is {made.shortest_s:g} and longest_s {made.longest_s:g}; "
                "the shortest must be below the longest."
            )
        return made


def _seconds(table: Mapping[str, Any], key: str, where: str) -> float:
    value, (low, high) = table[key], _LIMITS[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"The {where}: {key} is {value!r}; it must be a number of seconds.")
    if not low <= value <= high:
        raise ConfigError(f"The {where}: {key} is {value:g}; {low:g} to {high:g} seconds are accepted.")
    return float(value)


def _texts(table: Mapping[str, Any], key: str, where: str) -> list[str]:
    value = table.get(key, [])
    if not isinstance(value, Sequence) or isinstance(value, str) or not all(isinstance(v, str) for v in value):
        raise ConfigError(f"The {where}: {key} is {value!r}; it must be a list of labels.")
    return list(value)


def _resolved(
    table: Mapping[str, Any], where: str, words: str, beside: Path | None
) -> tuple[tuple[str, ...], dict[str, str], tuple[str, ...], str]:
    """Gestures in order, the prompt of each, those that are nobody's, and the wording."""
    given = table.get("prompts", {})
    if not isinstance(given, Mapping):
        raise ConfigError(f"The {where}: prompts is {given!r}; it must be a table of label = text.")
    labels, nobody = _texts(table, "gestures", where), _texts(table, "nobody", where)
    if "nobody" in table and labels and all(isinstance(given.get(label), str) for label in labels):
        # As `to_dict` left it: the file of the gesture set may be gone.
        return tuple(labels), {label: given[label] for label in labels}, tuple(nobody), words
    gesture_set = _gesture_set(table["gesture_set"], beside)
    found = [gesture_set.get(label) for label in labels] or [g for g in gesture_set.gestures if not g.nobody]
    if len({g.label for g in found}) < len(found) or not found or ("gestures" in table and not labels):
        raise ConfigError(f"The {where} must name every gesture once, and at least one: see its gestures.")
    wordings = {DEFAULT, *(w for text in given.values() if isinstance(text, Mapping) for w in text)}
    if words not in wordings:
        raise ConfigError(
            f"The {where} has no wording '{words}'; it has {', '.join(sorted(wordings))}.{nearest(words, wordings)}"
        )
    prompts = {}
    texts = {gesture_set.get(label).label: text for label, text in given.items()}
    for gesture in found:
        text = texts.get(gesture.label, {})
        if isinstance(text, Mapping):
            text = text.get(words) or text.get(DEFAULT) or gesture.description or gesture.label
        if not isinstance(text, str) or not text.strip():
            raise ConfigError(f"The {where}: the prompt of '{gesture.label}' is {text!r}; it must be a text.")
        named = parse_name(recording_filename(gesture.label, 0, 0))
        if named is None or plain_label(named.label) != plain_label(gesture.label):
            raise ConfigError(
                f"The {where}: '{gesture.label}' cannot stand in a file name; "
                'take a label without  \\ / : * ? " < > | ( )  and without a point at its end.'
            )
        prompts[gesture.label] = text.strip()
    return tuple(prompts), prompts, tuple(g.label for g in found if g.nobody), words


def _gesture_set(name: str, beside: Path | None) -> GestureSet:
    if beside is not None and name.endswith(".toml") and (beside / name).is_file():
        return load_gestures(beside / name)
    return load_gestures(name)


def protocol_names() -> tuple[str, ...]:
    """Names of the built-in protocols."""
    return builtin_names("protocols")


def wordings(name_or_path: str | Path) -> tuple[str, ...]:
    """The wordings of a protocol's prompts, `DEFAULT` first.

    Raises:
        ConfigError: for an unknown name or an unusable file.
    """
    table, _ = read_named(name_or_path, "protocols", "protocol", ConfigError)
    prompts = table.get("prompts")
    texts = prompts.values() if isinstance(prompts, Mapping) else ()
    others = {str(w) for text in texts if isinstance(text, Mapping) for w in text}
    return (DEFAULT, *sorted(others - {DEFAULT}))


def load_protocol(name_or_path: str | Path, words: str | None = None) -> Protocol:
    """A built-in protocol by name, or one of the user's own by the path of its TOML file.

    Raises:
        ConfigError: for an unknown name or an unusable file.
    """
    table, source = read_named(name_or_path, "protocols", "protocol", ConfigError)
    beside = None if source in protocol_names() else Path(source).parent
    return Protocol.from_dict(table, f"protocol '{source}'", words, beside)
