"""Scenarios: what happens to a virtual toy in an afternoon, played the same way every time (TOML files)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.toml import load_table, read_toml
from plushsense.devices.virtual.faults import Fault
from plushsense.devices.virtual.session import GESTURES, Episode, VirtualSession
from plushsense.devices.virtual.world import draw_person

ACTIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "idle": (("duration_s",), "nobody touches the toy"),
    "perform": (("gestures", "repetitions"), "the person makes each of `gestures`, `repetitions` times"),
    "play": (
        ("duration_s", "gestures"),
        "the person makes `gestures` in turn, or any at random, with pauses, and sometimes lifts the toy; the last "
        "gesture is ended after `duration_s`",
    ),
    "handle": (("repetitions",), "the person lifts the toy, turns it and puts it down: no gesture"),
}
"""What happens in a part: its keys besides ``do`` and ``person``, and the description."""

_LONGEST_S = 1e6
_MOST_REPETITIONS = 1000
_MOST_PERSON = 1_000_000_000
_PIECE_S = 10.0


def _number(name: str, value: float | None, low: float, high: float) -> None:
    if value is not None and not low <= value <= high:
        raise ConfigError(f"{name} is {value:g}; accepted are {low:.0f} to {high:.0f}.")


def _length(name: str, value: float | None) -> None:
    if value is not None and not 0.0 < value <= _LONGEST_S:
        raise ConfigError(f"{name} is {value:g}; accepted are above 0 to {_LONGEST_S:.0f} seconds.")


@dataclass(frozen=True)
class ScenarioPart:
    """A part of an afternoon. Parts follow each other.

    Attributes:
        do: what happens, see below (one of `ACTIONS`).
        person: number of the virtual person who is with the toy from now on; the same number and ``seed`` are always
            the same person (0 to 1000000000; default: that of the part before, and 1 at the beginning).
        duration_s: how long it lasts (above 0 to 1000000; default: 10).
        gestures: labels of gestures of the paper (default: all 17).
        repetitions: how often it is done (1 to 1000; default: once).

    Raises:
        ConfigError: for an unknown action or gesture, a key that the action does not have, or a value out of range.
    """

    do: str
    person: int | None = None
    duration_s: float | None = None
    gestures: tuple[str, ...] = ()
    repetitions: int | None = None

    def __post_init__(self) -> None:
        if self.do not in ACTIONS:
            raise ConfigError(f"do is '{self.do}'; accepted are {', '.join(ACTIONS)}.{nearest(self.do, ACTIONS)}")
        own = ACTIONS[self.do][0]
        for key in ("duration_s", "gestures", "repetitions"):
            if key not in own and getattr(self, key) not in (None, ()):
                raise ConfigError(f"a part that does '{self.do}' has no {key}; it has {', '.join(own)}: leave it out.")
        _number("person", self.person, 0, _MOST_PERSON)
        _number("repetitions", self.repetitions, 1, _MOST_REPETITIONS)
        _length("duration_s", self.duration_s)
        for label in self.gestures:
            if label not in GESTURES:
                raise ConfigError(
                    f"the virtual toy's people make no gesture '{label}'; they make {', '.join(GESTURES)}."
                    f"{nearest(label, GESTURES)}"
                )

    def episodes(self, session: VirtualSession) -> Iterator[Episode]:
        """Play this part in a session."""
        times = self.repetitions or 1
        length_ms = round(1000.0 * (10.0 if self.duration_s is None else self.duration_s))
        stop_ms = session.clock_ms + length_ms
        if self.do == "idle":
            while session.clock_ms < stop_ms:
                yield session.idle(min(_PIECE_S, (stop_ms - session.clock_ms) / 1000.0))
        elif self.do == "play":
            playing = session.play(self.gestures)
            while session.clock_ms < stop_ms:
                yield next(playing)
        elif self.do == "handle":
            for _ in range(times):
                yield session.handle()
        else:
            for _ in range(times):
                for label in self.gestures or GESTURES:
                    yield session.perform(label)


@dataclass(frozen=True)
class HumidityPoint:
    """The humidity at one moment; between two moments it changes evenly.

    Attributes:
        at_s: seconds from the first line (0 to 1000000).
        level: 0 is a usual day, 1 a humid and -1 a dry one, by the spread between sessions (-3 to 3).

    Raises:
        ConfigError: for a value out of its range.
    """

    at_s: float
    level: float

    def __post_init__(self) -> None:
        _number("at_s", self.at_s, 0, _LONGEST_S)
        _number("level", self.level, -3, 3)


@dataclass(frozen=True)
class ToyScenario:
    """What happens to a virtual toy from its first line to its last: people, gestures, humidity and faults.

    Attributes:
        parts: what happens, one after another.
        name: name of the scenario.
        title: what it is, for people.
        seed: seed of everything that is drawn at random, also of the people (0 to 2147483647).
        repeat: how often all parts are played; faults and humidity count from the first line (1 to 1000000).
        lost: share of the lines that are always lost (0 to 0.9; default: 0.0005).
        garbled: share of the lines that are always garbled (0 to 0.9; default: 0.0003).
        glitch: share of the frames in which an electrode always reads nonsense (0 to 0.9; default: 0.00002).
        wrap_s: time from the first line to the wrap of the toy's clock, which counts milliseconds in 32 bits, as after
            49.7 days; a reset before it begins at 0 again (above 0 to 1000000; default: no wrap).
        humidity: moments with their humidity (default: drawn with the seed).
        faults: what goes wrong, and when.

    Raises:
        ConfigError: for a value out of its range, or no part.
    """

    parts: tuple[ScenarioPart, ...]
    name: str = "own"
    title: str = ""
    seed: int = 1
    repeat: int = 1
    lost: float | None = None
    garbled: float | None = None
    glitch: float | None = None
    wrap_s: float | None = None
    humidity: tuple[HumidityPoint, ...] = ()
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        if not self.parts:
            raise ConfigError("there is no part: add [[parts]] with what happens.")
        _number("seed", self.seed, 0, 2**31 - 1)
        _number("repeat", self.repeat, 1, 1_000_000)
        for key in ("lost", "garbled", "glitch"):
            value = getattr(self, key)
            if value is not None and not 0.0 <= value <= 0.9:
                raise ConfigError(f"{key} is {value:g}; accepted is a share from 0 to 0.9.")
        _length("wrap_s", self.wrap_s)

    @property
    def people(self) -> tuple[int, ...]:
        """The number of the person of each part."""
        numbers: list[int] = []
        for part in self.parts:
            numbers.append(part.person if part.person is not None else numbers[-1] if numbers else 1)
        return tuple(numbers)

    def episodes(self, session: VirtualSession) -> Iterator[Episode]:
        """Play the scenario in a session, from its beginning to its end."""
        for _ in range(self.repeat):
            for part, number in zip(self.parts, self.people, strict=True):
                session.hand_over(draw_person(number, session.seed, session.world))
                yield from part.episodes(session)


def load_scenario(path: str | Path) -> ToyScenario:
    """Load the TOML file of a scenario.

    Raises:
        ConfigError: for a missing file, an unknown key or an invalid value.
    """
    return load_table(read_toml(Path(path), "scenario", ConfigError), ToyScenario, f"scenario '{path}'", ConfigError)
