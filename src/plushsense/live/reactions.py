"""Reactions of a toy to events: profiles with rules, and the `Reactor` that applies them to a stream."""

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
    """A rule for the reaction to events of one affect or one gesture.

    Attributes:
        affect: react to events of this affect; either this or ``gesture`` is given (one of `AFFECTS`).
        gesture: react to this gesture. Its rule takes precedence over that of its affect.
        eyes: colour of the eyes (one of `EYES`).
        sound: name of a sound stored in the toy, up to 40 letters, digits, ``-`` and ``_``; empty: none.
        seconds: duration of eyes and sound in seconds; above 0 if there are any (0 to 60).
        refractory_s: time after the reaction in which events of the same affect get no reaction (0 to 3600).
        quiet_s: time after the reaction in which events of other affects get none, as when the eyes shall stay off
            (0 to 3600).
        when: react when the event has ``begun`` (its affect is sure), is ``named`` (its gesture is), or has ``ended``
            (one of `MOMENTS`).
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
    """A profile of reactions; events without a rule get no reaction."""

    name: str
    lines: tuple[ReactionRule, ...]
    title: str = ""

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON and `from_dict`."""
        return {"name": self.name, "title": self.title, "reactions": [asdict(line) for line in self.lines]}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any], where: str = "reactions") -> Reactions:
        """Create a profile from plain values, as in a TOML file; ``where`` names it in messages.

        Raises:
            ConfigError: for an unknown key, an invalid value, or two rules for one affect or gesture.
        """
        profile = load_table(table, ReactionsFile, where, ConfigError)
        lines = profile.reactions
        keys = [line.affect or plain_label(line.gesture) for line in lines]
        doubled = next((line for n, line in enumerate(lines) if keys[n] in keys[:n]), None)
        if doubled is not None:
            raise ConfigError(f"The {where} answer '{doubled.affect or doubled.gesture}' twice: keep one line.")
        return cls(profile.name, lines, profile.title)

    def answer(self, affect: str, gesture: str | None) -> ReactionRule | None:
        """Return the rule for an event, preferably that of its gesture; None if there is none."""
        if gesture is not None:
            plain = plain_label(gesture)
            for line in self.lines:
                if line.gesture and plain_label(line.gesture) == plain:
                    return line
        return next((line for line in self.lines if line.affect == affect), None)


@dataclass(frozen=True)
class ReactionsFile:
    """Keys of a profile in a TOML file.

    Attributes:
        reactions: the rules, at most one for an affect or a gesture. Events without a rule get no reaction.
        name: name of the profile.
        title: what the profile does, for people.
    """

    reactions: tuple[ReactionRule, ...]
    name: str = "own"
    title: str = ""


def reaction_names() -> tuple[str, ...]:
    """Return the names of the built-in profiles."""
    return builtin_names("reactions")


def load_reactions(name_or_path: str | Path, gestures: GestureSet | None = None) -> Reactions:
    """Load a built-in profile by its name, or any other by the path of its TOML file.

    Args:
        gestures: gestures of the model; a rule for another gesture is refused, since it would never apply.

    Raises:
        ConfigError: for an unknown name, key or gesture, or an invalid value.
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
    """A reaction of the toy that starts at ``t_s``, lasts ``seconds``, and replaces an earlier one.

    With ``eyes`` off and no sound, it only stops the earlier one. ``number``, ``affect`` and ``gesture`` are those of
    the event.
    """

    t_s: float
    eyes: str
    sound: str
    seconds: float
    number: int
    affect: str
    gesture: str | None

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {**asdict(self), "t_s": round(self.t_s, 4), "sound": self.sound or None}


class Reactor:
    """Reactions to the events of one stream: at most one per event, none within a refractory or quiet time."""

    def __init__(self, profile: Reactions) -> None:
        self.profile = profile
        self.reset()

    def reset(self) -> None:
        """Start a new stream."""
        self._answered = 0
        self._refractory: dict[str, float] = {}
        self._quiet, self._quiet_of = -math.inf, ""

    def push(self, reported: Decision | Iterable[GestureEvent]) -> list[Reaction]:
        """Return the reactions, usually none, to the events of a decision, or to events in order of time.

        There is none to the end of an event that ended because the signal was lost, since nobody did anything.
        """
        if not isinstance(reported, Decision):
            return [r for event in reported if (r := self._react(event)) is not None]
        lost = reported.state in ("no signal", "unreadable", "sensor fault")
        return [
            reaction
            for event in reported.events
            if not (event.kind == "ended" and (lost or (reported.state == "warming" and event.since_s == event.t_s)))
            and (reaction := self._react(event)) is not None
        ]

    def _react(self, event: GestureEvent) -> Reaction | None:
        line = self.profile.answer(event.affect, event.gesture)
        if line is None or event.number <= self._answered or not _due(line, event):
            return None
        # A reaction that is suppressed now does not follow later, when it would no longer fit the event.
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
    """Return whether a rule reacts to this change; an event that begins with a gesture is named at once."""
    if line.when == "named":
        return event.kind != "ended" and event.gesture is not None
    # The rule of a gesture can only be found once the event is named, which may be after it has begun.
    return event.kind == line.when or (line.when == "begun" and bool(line.gesture) and event.kind == "named")
