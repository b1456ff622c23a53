"""Reactions of a toy to events: profiles as data, and the rules for when an event is answered."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.gestures import AFFECTS, GestureSet, plain_label
from plushsense.core.toml import builtin_names, load_table, read_named
from plushsense.runtime.classifier import Decision, GestureEvent

EYES = ("green", "red", "off")
MOMENTS = ("begun", "named", "ended")
_LONGEST_S = {"seconds": 60.0, "refractory_s": 3600.0, "quiet_s": 3600.0}
_SOUND = re.compile(r"[A-Za-z0-9_-]{0,40}")


@dataclass(frozen=True)
class ReactionRule:
    """Reaction to one affect or one gesture.

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

    def __post_init__(self) -> None:
        for key, longest in _LONGEST_S.items():
            if not 0.0 <= (value := getattr(self, key)) <= longest:
                raise ConfigError(f"{key} is {value!r}; accepted are 0 to {longest:g} seconds.")
        if bool(self.affect) == bool(self.gesture):
            given = "both an affect and a gesture are" if self.affect else "neither an affect nor a gesture is"
            raise ConfigError(f"{given} given: give one of them.")
        for key, known in (("affect", AFFECTS), ("eyes", EYES), ("when", MOMENTS)):
            value = getattr(self, key)
            if value not in known and not (key == "affect" and self.gesture):
                raise ConfigError(f"{key} is '{value}'; accepted are {', '.join(known)}.{nearest(value, known)}")
        if not _SOUND.fullmatch(self.sound):
            raise ConfigError(f"sound is '{self.sound}'; a name of letters, digits, - and _ is accepted.")
        if self.shows and not self.seconds > 0:
            raise ConfigError("it has eyes or a sound but no duration: give seconds above 0.")

    @property
    def shows(self) -> bool:
        """Whether the reaction has eyes or a sound."""
        return self.eyes != "off" or bool(self.sound)


@dataclass(frozen=True)
class Reactions:
    """Profile of reactions; what has no rule is not answered."""

    name: str
    lines: tuple[ReactionRule, ...]
    title: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; `from_dict` makes the same profile of them."""
        return {"name": self.name, "title": self.title, "reactions": [asdict(line) for line in self.lines]}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "reactions") -> Reactions:
        """Return a profile from plain values, as a TOML file has them.

        Raises:
            ConfigError: for an unknown key, a value that does not fit, or two lines for the same.
        """
        profile = load_table(table, _ReactionsFile, where, ConfigError)
        lines = profile.reactions
        keys = [line.affect or plain_label(line.gesture) for line in lines]
        doubled = next((line for n, line in enumerate(lines) if keys[n] in keys[:n]), None)
        if doubled is not None:
            raise ConfigError(f"The {where} answer '{doubled.affect or doubled.gesture}' twice: keep one line.")
        return cls(profile.name, lines, profile.title)

    def answer(self, affect: str, gesture: str | None) -> ReactionRule | None:
        """Return the rule for an event; a gesture's takes precedence over its affect's."""
        if gesture is not None:
            plain = plain_label(gesture)
            for line in self.lines:
                if line.gesture and plain_label(line.gesture) == plain:
                    return line
        return next((line for line in self.lines if line.affect == affect), None)


@dataclass(frozen=True)
class _ReactionsFile:
    """The keys of a profile in a file."""

    reactions: tuple[ReactionRule, ...]
    name: str = "own"
    title: str = ""


def reaction_names() -> tuple[str, ...]:
    """Return the names of the built-in profiles."""
    return builtin_names("reactions")


def load_reactions(name_or_path: str | Path, gestures: GestureSet | None = None) -> Reactions:
    """Return a built-in profile by name, or one of the user's own by the path of its TOML file.

    Args:
        gestures: what the model knows; a line for another gesture is refused, since it would never apply.

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
    """Reaction of the toy from ``t_s`` on for ``seconds``, in place of what it did before.

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
        """Return plain values, ready for JSON."""
        return {**asdict(self), "t_s": round(self.t_s, 4), "sound": self.sound or None}


class Reactor:
    """Answers the events of one stream: an event at most once, and not within a refractory or quiet time."""

    def __init__(self, profile: Reactions) -> None:
        self.profile = profile
        self.reset()

    def reset(self) -> None:
        """Begin a new stream."""
        self._answered = 0
        self._refractory: dict[str, float] = {}
        self._quiet, self._quiet_of = -math.inf, ""

    def push(self, reported: Decision | Iterable[GestureEvent]) -> list[Reaction]:
        """Return the reactions to a decision, or to events in the order in which they came; mostly none.

        An event that ended because the signal went away is not answered: nobody did anything.
        """
        if not isinstance(reported, Decision):
            return [r for event in reported if (r := self._react(event)) is not None]
        lost = reported.state in ("no signal", "sensor fault")
        return [
            reaction
            for event in reported.events
            if not (event.what == "ended" and (lost or (reported.state == "warming" and event.since_s == event.t_s)))
            and (reaction := self._react(event)) is not None
        ]

    def _react(self, event: GestureEvent) -> Reaction | None:
        line = self.profile.answer(event.affect, event.gesture)
        if line is None or event.number <= self._answered or not _due(line, event):
            return None
        # A reaction that is refused now is not made up for later: it would no longer fit the event.
        self._answered = event.number
        if event.t_s < self._refractory.get(event.affect, -math.inf):
            return None
        if event.t_s < self._quiet and event.affect != self._quiet_of:
            return None
        self._refractory[event.affect] = event.t_s + line.refractory_s
        if line.quiet_s > 0:
            self._quiet, self._quiet_of = event.t_s + line.quiet_s, event.affect
        return Reaction(event.t_s, line.eyes, line.sound, line.seconds, event.number, event.affect, event.gesture)


def _due(line: ReactionRule, event: GestureEvent) -> bool:
    """Return whether a rule answers this change; a gesture that is known at once is named when it begins."""
    if line.when == "named":
        return event.what != "ended" and event.gesture is not None
    # The line of a gesture that is named later: its beginning has passed, its name is the first chance.
    return event.what == line.when or (line.when == "begun" and bool(line.gesture) and event.what == "named")
