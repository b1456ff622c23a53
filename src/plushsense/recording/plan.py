"""Recording protocols: which gestures a session records, in which order, with which prompts (TOML files)."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import tomli_w

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.core.files import write_file
from plushsense.core.gestures import Gesture, GestureSet, load_gestures, plain_label
from plushsense.core.recorder_csv import parse_name, recording_filename
from plushsense.core.toml import builtin_names, load_table, read_named

ORDERS = {
    "gesture": "all repetitions of a gesture one after another, as in the paper",
    "round": "every gesture once, then every gesture again",
    "random": "all recordings in an order that is drawn for each session, whose head stores the seed",
}
DEFAULT = "default"
"""Wording used where a prompt lacks the chosen one.

A gesture without a prompt in a protocol has that of the built-in protocols, or else its description."""

_MOST_REPETITIONS = 1000
_LIMITS = {"countdown_s": (0.0, 60.0), "shortest_s": (0.0, 60.0), "longest_s": (1.0, 36_000.0)}


@dataclass(frozen=True)
class Step:
    """One planned recording: its number in the session from 0, its gesture and its prompt."""

    number: int
    gesture: str
    repetition: int
    prompt: str


@dataclass(frozen=True)
class Protocol:
    """The plan of a session; `ProtocolFile` describes the keys, which here have their values.

    ``prompts`` has one text for each gesture: that of the wording ``words``.
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
    affects: dict[str, str] = field(default_factory=dict)
    seed: int = 0

    @property
    def needs_nobody(self) -> bool:
        """Return whether all gestures of the session are recorded without a person."""
        return set(self.nobody) >= set(self.gestures)

    def steps(self) -> tuple[Step, ...]:
        """Return all planned recordings of the session, in order."""
        repetitions = range(1, self.repetitions + 1)
        if self.order == "round":
            pairs = [(g, r) for r in repetitions for g in self.gestures]
        else:
            pairs = [(g, r) for g in self.gestures for r in repetitions]
        if self.order == "random":
            # Python promises the same `random` for a seed in every version, but not the same `shuffle`.
            draw = random.Random(self.seed).random
            pairs = [pair for _, pair in sorted((draw(), pair) for pair in pairs)]
        return tuple(Step(n, g, r, self.prompts[g]) for n, (g, r) in enumerate(pairs))

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON, from which `from_dict` builds the same protocol without other files."""
        table = asdict(self) | {"gestures": list(self.gestures), "nobody": list(self.nobody)}
        return {key: value for key, value in table.items() if key not in ("affects", "seed") or value}

    @classmethod
    def from_dict(
        cls, table: Mapping[str, Any], where: str = "protocol", words: str | None = None, beside: Path | None = None
    ) -> Protocol:
        """Return the protocol that plain values describe: a TOML file, or the result of `to_dict`.

        Args:
            where: description of the source for error messages.
            words: wording to use; None: the one that the table names, else "default".
            beside: folder in which the file of the gesture set is looked up first.

        Raises:
            ConfigError: for an unknown key or an invalid value.
            GestureError: for a gesture that is not in the set.
        """
        file = load_table(table, ProtocolFile, where, ConfigError)
        if not file.name.strip():
            raise ConfigError(f"The {where} has an empty name: give it one.")
        if file.order not in ORDERS:
            raise ConfigError(
                f"The {where}: order is '{file.order}'; accepted are {', '.join(ORDERS)}.{nearest(file.order, ORDERS)}"
            )
        if not 1 <= file.repetitions <= _MOST_REPETITIONS:
            message = f"The {where}: repetitions is {file.repetitions}; accepted are 1 to {_MOST_REPETITIONS}."
            raise ConfigError(message)
        for key, (low, high) in _LIMITS.items():
            if not low <= (value := getattr(file, key)) <= high:
                raise ConfigError(f"The {where}: {key} is {value:g}; {low:g} to {high:g} seconds are accepted.")
        if file.shortest_s >= file.longest_s:
            raise ConfigError(
                f"The {where}: shortest_s is {file.shortest_s:g}; it must be below longest_s, {file.longest_s:g}."
            )
        return cls(**vars(file) | _resolved(file, where, words or file.words or DEFAULT, beside))


@dataclass(frozen=True)
class ProtocolFile:
    """Keys of a protocol file, and of `Protocol.to_dict`, in which ``prompts`` has one text for each gesture.

    Attributes:
        name: name of the protocol, which sessions store.
        gesture_set: name of a built-in gesture set, or path of a gesture set file beside the protocol.
        title: what the protocol is, for people (default: the name).
        gestures: labels of the gestures to record, in this order (default: all of the set that need a person).
        prompts: text shown to the person for each gesture: a text, or a table of texts by wording, of which
            ``default`` is used where the chosen one is missing. A gesture without an entry has the prompt of the
            built-in protocols, else its description.
        repetitions: how often each gesture is recorded (1 to 1000).
        order: order of the recordings: ``gesture``: all repetitions of a gesture one after another, as in the paper;
            ``round``: every gesture once, then every gesture again; ``random``: drawn for each session (one of
            `ORDERS`).
        countdown_s: time from the first press of the space bar to the first row of the recording (0 to 60).
        shortest_s: time within which the second press does not stop the recording; below ``longest_s`` (0 to 60).
        longest_s: time after which the recording ends by itself (1 to 36000).
        words: wording of the prompts to use, such as ``lv`` where prompts have an entry of that name.
        nobody: labels of the gestures recorded without a person; a session stores it (default: by the gesture set).
        affects: affects of gestures that the set has not, by their labels, as in ``{ kiss = "positive" }``.
        seed: number that a random order is drawn from; a session stores it.
    """

    name: str
    gesture_set: str
    title: str = ""
    gestures: tuple[str, ...] | None = None
    prompts: dict[str, str | dict[str, str]] = field(default_factory=dict)
    repetitions: int = 3
    order: str = "gesture"
    countdown_s: float = 3.0
    shortest_s: float = 0.5
    longest_s: float = 60.0
    words: str = DEFAULT
    nobody: tuple[str, ...] | None = None
    affects: dict[str, str] = field(default_factory=dict)
    seed: int = 0


def _resolved(file: ProtocolFile, where: str, words: str, beside: Path | None) -> dict[str, Any]:
    """Return the fields of `Protocol` that depend on the gesture set and the wording."""
    title = file.title or file.name
    file_prompts, labels = file.prompts, file.gestures or ()
    if file.nobody is not None and labels and all(isinstance(file_prompts.get(label), str) for label in labels):
        # Written by `to_dict`: do not load the gesture set, whose file may no longer exist.
        return {"title": title, "prompts": {label: file_prompts[label] for label in labels}, "words": words}
    own_file = beside / file.gesture_set if beside is not None and file.gesture_set.endswith(".toml") else None
    gesture_set = load_gestures(own_file if own_file is not None and own_file.is_file() else file.gesture_set)
    own = tuple(Gesture(label, affect) for label, affect in file.affects.items())
    gesture_set = GestureSet(gesture_set.name, gesture_set.gestures + own)
    gestures = [gesture_set.get(label) for label in labels] or [g for g in gesture_set.gestures if not g.nobody]
    if len({g.label for g in gestures}) < len(gestures) or not gestures or file.gestures == ():
        raise ConfigError(f"The {where} must name every gesture once, and at least one: see its gestures.")
    known = _builtin_prompts(file.gesture_set)
    wordings = _wordings_of(file_prompts, [g.label for g in gestures], known)
    if words not in wordings:
        raise ConfigError(
            f"The {where} has no wording '{words}'; it has {', '.join(sorted(wordings))}.{nearest(words, wordings)}"
        )
    prompts = {}
    texts = {gesture_set.get(label).label: text for label, text in file_prompts.items()}
    for gesture in gestures:
        text = texts.get(gesture.label, {})
        if isinstance(text, Mapping):
            builtin = known.get(gesture.label, {})
            text = text.get(words) or text.get(DEFAULT) or builtin.get(words) or builtin.get(DEFAULT) or ""
            text = text or gesture.description or gesture.label
        if not text.strip():
            raise ConfigError(f"The {where}: the prompt of '{gesture.label}' is {text!r}; it must be a text.")
        parsed = parse_name(recording_filename(gesture.label, 0, 0))
        if parsed is None or plain_label(parsed.label) != plain_label(gesture.label):
            raise ConfigError(
                f"The {where}: '{gesture.label}' cannot be part of a file name; "
                'choose a label without  \\ / : * ? " < > | ( )  and without a point at its end.'
            )
        prompts[gesture.label] = text.strip()
    nobody = tuple(g.label for g in gestures if g.nobody)
    return {"title": title, "gestures": tuple(prompts), "prompts": prompts, "nobody": nobody, "words": words}


def protocol_names() -> tuple[str, ...]:
    """Return the names of the built-in protocols."""
    return builtin_names("protocols")


def wordings(name_or_path: str | Path) -> tuple[str, ...]:
    """Return the wordings of a protocol's prompts, `DEFAULT` first; raise ConfigError like `load_protocol`."""
    with _naming(name_or_path):
        table, _ = read_named(name_or_path, "protocols", "protocol", ConfigError)
    prompts, gestures = table.get("prompts"), table.get("gestures")
    known = _builtin_prompts(str(table.get("gesture_set", "")))
    labels = gestures if isinstance(gestures, list) else list(known)
    others = _wordings_of(prompts if isinstance(prompts, Mapping) else {}, labels, known)
    return (DEFAULT, *sorted(others - {DEFAULT}))


@cache
def _builtin_prompts(gesture_set: str) -> dict[str, Mapping[str, str]]:
    """Return the prompts of the built-in protocols for the gestures of a set, by label and wording."""
    tables = [read_named(name, "protocols", "protocol", ConfigError)[0] for name in protocol_names()]
    return {g: texts for t in tables if t["gesture_set"] == gesture_set for g, texts in t.get("prompts", {}).items()}


def _wordings_of(prompts: Mapping[str, Any], labels: Sequence[str], known: Mapping[str, Mapping[str, str]]) -> set[str]:
    """Return the wordings of a protocol's own prompts, and of the built-in ones for gestures that have no own text."""
    own = {plain_label(label) for label, text in prompts.items() if isinstance(text, str)}
    tables = [text for text in prompts.values() if isinstance(text, Mapping)]
    tables += [known[g] for g in known if plain_label(g) in {plain_label(str(n)) for n in labels} - own]
    return {DEFAULT, *(str(w) for table in tables for w in table)}


def save_protocol(
    path: Path, gestures: Sequence[str], repetitions: int, order: str, affects: Mapping[str, str] | None = None
) -> Protocol:
    """Write a protocol with the built-in prompts to the new file ``path``, whose stem is its name; return it.

    Args:
        gestures: labels of gestures of plush-18 and of ``affects``.
        affects: the affect of each gesture that plush-18 has not.

    Raises:
        ConfigError: if no gesture is given, or a value is out of range.
    """
    if not gestures:
        raise ConfigError("A protocol needs at least one gesture: choose one.")
    if not 1 <= repetitions <= _MOST_REPETITIONS:
        raise ConfigError(
            "repetitions is {repetitions}; accepted are 1 to {most}.",
            repetitions=repetitions,
            most=_MOST_REPETITIONS,
            field="repetitions",
        )
    table: dict[str, Any] = {"name": path.stem, "title": path.stem, "gesture_set": "plush-18"}
    table |= {"gestures": list(gestures), "repetitions": repetitions, "order": order}
    table |= {"affects": dict(affects)} if affects else {}
    protocol = Protocol.from_dict(table)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, tomli_w.dumps(table))
    return protocol


def load_protocol(name_or_path: str | Path, words: str | None = None) -> Protocol:
    """Load a built-in protocol by name, or any other by the path of its TOML file.

    Raises:
        ConfigError: for an unknown name or an unusable file.
    """
    with _naming(name_or_path):
        table, source = read_named(name_or_path, "protocols", "protocol", ConfigError)
        beside = None if source in protocol_names() else Path(source).parent
        return Protocol.from_dict(table, f"protocol '{source}'", words, beside)


@contextmanager
def _naming(name_or_path: str | Path) -> Iterator[None]:
    """Let errors in the block name the protocol."""
    try:
        yield
    except BadInput as cause:
        raise type(cause)(
            "Protocol '{path}': {problem}", path=Path(name_or_path), problem=str(cause), field="protocol"
        ) from None
