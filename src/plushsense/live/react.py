"""What a toy does about what it feels: reactions are data, and their rules need nothing but the events' own times."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.gestures import AFFECTS, GestureSet, plain_label
from plushsense.core.tomlfile import builtin_names, read_named, refuse_unknown
from plushsense.live.stream import Decision, Event

EYES = ("green", "red", "off")
MOMENTS = ("begun", "named", "ended")
_LONGEST_S = {"seconds": 60.0, "refractory_s": 3600.0, "quiet_s": 3600.0}
_SOUND = re.compile(r"[A-Za-z0-9_-]{0,40}")


@dataclass(frozen=True)
class Line:
    """How one affect, or one gesture, is answered.

    Attributes:
        affect, gesture: one of the two; a gesture's line holds in place of its affect's.
        eyes: of `EYES`.
        sound: the name of a sound that the toy knows; empty: none.
        seconds: for how long eyes and sound last.
        refractory_s: after this answer, nothing of the same affect is answered for so long.
        quiet_s: after this answer, nothing of another affect is answered for so long; for what shall stay dark.
        when: ``begun``, as soon as the affect is sure; ``named``, as soon as the gesture is; ``ended``.
    """

    affect: str = ""
    gesture: str = ""
    eyes: str = "off"
    sound: str = ""
    seconds: float = 0.0
    refractory_s: float = 0.0
    quiet_s: float = 0.0
    when: str = "begun"

    @property
    def shows(self) -> bool:
        """Whether there is anything to see or to hear."""
        return self.eyes != "off" or bool(self.sound)


@dataclass(frozen=True)
class Reactions:
    """A profile: what is answered, and how. What has no line is not answered."""

    name: str
    lines: tuple[Line, ...]
    title: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON; `from_dict` makes the same profile of them."""
        return {"name": self.name, "title": self.title, "reactions": [asdict(line) for line in self.lines]}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "reactions") -> Reactions:
        """A profile from plain values, as a TOML file has them.

        Raises:
            ConfigError: for an unknown key, a value that does not fit, or two lines for the same.
        """
        refuse_unknown(table, ("name", "title", "reactions"), where, ConfigError)
        entries = table.get("reactions")
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ConfigError(f"The {where} need a list of tables: reactions = [ {{ affect = …, eyes = … }}, … ].")
        lines = tuple(_line(entry, f"{where}, line {n}") for n, entry in enumerate(entries, 1))
        keys = [line.affect or plain_label(line.gesture) for line in lines]
        doubled = next((line for n, line in enumerate(lines) if keys[n] in keys[:n]), None)
        if doubled is not None:
            raise ConfigError(f"The {where} answer '{doubled.affect or doubled.gesture}' twice: keep one line.")
        for key in ("name", "title"):
            if not isinstance(table.get(key, ""), str):
                raise ConfigError(f"The {where}: {key} is {table[key]!r}; it must be a text.")
        return cls(table.get("name", "own"), lines, table.get("title", ""))

    def answer(self, affect: str, gesture: str | None) -> Line | None:
        """The line for an event; a gesture's goes before its affect's."""
        if gesture is not None:
            plain = plain_label(gesture)
            for line in self.lines:
                if line.gesture and plain_label(line.gesture) == plain:
                    return line
        return next((line for line in self.lines if line.affect == affect), None)


def _line(entry: Mapping[str, Any], where: str) -> Line:
    """One line, checked."""
    refuse_unknown(entry, Line.__dataclass_fields__, where, ConfigError)
    for key in ("affect", "gesture", "eyes", "sound", "when"):
        if not isinstance(entry.get(key, ""), str):
            raise ConfigError(f"In {where}, {key} is {entry[key]!r}; it must be a text.")
    for key, longest in _LONGEST_S.items():
        value = entry.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= longest:
            raise ConfigError(f"In {where}, {key} is {value!r}; accepted are 0 to {longest:g} seconds.")
    line = Line(**entry)
    if bool(line.affect) == bool(line.gesture):
        raise ConfigError(f"In {where} stands {'both' if line.affect else 'neither'}: give an affect or a gesture.")
    for key, value, known in (("affect", line.affect or AFFECTS[0], AFFECTS), ("eyes", line.eyes, EYES)):
        if value not in known:
            raise ConfigError(
                f"In {where}, {key} is '{value}'; accepted are {', '.join(known)}.{nearest(value, known)}"
            )
    if line.when not in MOMENTS:
        raise ConfigError(
            f"In {where}, when is '{line.when}'; accepted are {', '.join(MOMENTS)}.{nearest(line.when, MOMENTS)}"
        )
    if not _SOUND.fullmatch(line.sound):
        raise ConfigError(f"In {where}, sound is '{line.sound}'; a name of letters, digits, - and _ is accepted.")
    if line.shows and not line.seconds > 0:
        raise ConfigError(f"In {where} it is not said how long it lasts: give seconds above 0.")
    return line


def reaction_names() -> tuple[str, ...]:
    """Names of the built-in profiles."""
    return builtin_names("reactions")


def load_reactions(name_or_path: str | Path, gestures: GestureSet | None = None) -> Reactions:
    """A built-in profile by name, or one of the user's own by the path of its TOML file.

    Args:
        gestures: what the model knows; a line for another gesture is refused, since it would never be read.

    Raises:
        ConfigError: for an unknown name or key, or a value that does not fit.
    """
    table, source = read_named(name_or_path, "reactions", "reactions", ConfigError)
    where = f"reactions '{source}'"
    profile = Reactions.from_dict(table, where)
    for line in profile.lines:
        if gestures is not None and line.gesture and gestures.find(line.gesture) is None:
            raise ConfigError(
                f"The {where} answer '{line.gesture}', which the model does not know; it knows "
                f"{', '.join(gestures.labels)}.{nearest(line.gesture, gestures.labels)}"
            )
    return profile


@dataclass(frozen=True, slots=True)
class Reaction:
    """What the toy does from ``t_s`` on for ``seconds``, in place of what it did before.

    ``eyes`` off and no sound: it stops. ``number``, ``affect`` and ``gesture`` are those of the event that is
    answered.
    """

    t_s: float
    eyes: str
    sound: str
    seconds: float
    number: int
    affect: str
    gesture: str | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {**asdict(self), "t_s": round(self.t_s, 4), "sound": self.sound or None}


class Reactor:
    """Answers the events of one stream: an event at most once, and not while something keeps it from it."""

    def __init__(self, profile: Reactions) -> None:
        self.profile = profile
        self.reset()

    def reset(self) -> None:
        """Begin a new stream."""
        self._answered = 0
        self._refractory: dict[str, float] = {}
        self._quiet, self._quiet_of = -math.inf, ""

    def push(self, said: Decision | Iterable[Event]) -> list[Reaction]:
        """The reactions to a decision, or to events in the order in which they came; mostly none.

        An event that ended because the signal went away is not answered: nobody did anything.
        """
        if not isinstance(said, Decision):
            return [r for event in said if (r := self._react(event)) is not None]
        lost = said.state in ("no signal", "sensor fault")
        return [
            reaction
            for event in said.events
            if not (event.what == "ended" and (lost or (said.state == "warming" and event.since_s == event.t_s)))
            and (reaction := self._react(event)) is not None
        ]

    def _react(self, event: Event) -> Reaction | None:
        line = self.profile.answer(event.affect, event.gesture)
        if line is None or event.number <= self._answered or not _due(line, event):
            return None
        # What is refused now is not made up for later, when nobody knows any more what it is for.
        self._answered = event.number
        if event.t_s < self._refractory.get(event.affect, -math.inf):
            return None
        if event.t_s < self._quiet and event.affect != self._quiet_of:
            return None
        self._refractory[event.affect] = event.t_s + line.refractory_s
        if line.quiet_s > 0:
            self._quiet, self._quiet_of = event.t_s + line.quiet_s, event.affect
        return Reaction(event.t_s, line.eyes, line.sound, line.seconds, event.number, event.affect, event.gesture)


def _due(line: Line, event: Event) -> bool:
    """Whether this is the line's moment; a gesture that is known at once is named when it begins."""
    if line.when == "named":
        return event.what != "ended" and event.gesture is not None
    # The line of a gesture that is named later: its beginning has passed, its name is the first chance.
    return event.what == line.when or (line.when == "begun" and bool(line.gesture) and event.what == "named")
