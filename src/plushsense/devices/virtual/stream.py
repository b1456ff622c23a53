"""The virtual toy as lines in the wire format, some lost or corrupted, and as a device (``virtual://``)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from plushsense.core.errors import AddressError, ConfigError, DeviceError
from plushsense.core.layouts import DELAY_MS, DEVICE_MS, Layout
from plushsense.devices.base import Counters, Frame, PacedDevice, now_ms
from plushsense.devices.opening import DeviceAddress
from plushsense.devices.virtual.faults import FaultyToy, garble
from plushsense.devices.virtual.motions import PICK_S, split_label
from plushsense.devices.virtual.scenario import ToyScenario, load_scenario
from plushsense.devices.virtual.session import GESTURES, Episode, VirtualSession, check_gesture
from plushsense.devices.virtual.world import CHANNELS, WORLD, World, draw_person
from plushsense.devices.wire import LineParser, ParsedLine


@dataclass(frozen=True)
class Prompt:
    """A gesture to perform, and the toy's clock (ms) at the start of its recording; None: as soon as possible."""

    label: str
    begin_ms: int | None = None


Prompts = Callable[[], Prompt | None]
"""A function, called repeatedly, that returns the newest prompt since the last call, or None."""


class LogPrompts:
    """Read new prompts from a session's log (``session.jsonl``) while a recorder writes it.

    They are not sent to the toy, since a real one would not understand them. The file need not exist yet. A prompt is a
    ``countdown`` event with ``gesture``, ``device_ms`` and ``countdown_s``.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        try:
            self._at = self._path.stat().st_size
        except OSError:
            self._at = 0
        self._rest = b""

    def __call__(self) -> Prompt | None:
        """Return the newest prompt since the last call; None when there is none."""
        try:
            if self._path.stat().st_size <= self._at:
                return None
            with self._path.open("rb") as file:
                file.seek(self._at)
                data = file.read()
        except OSError:
            return None
        self._at += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        prompt = None
        for line in lines:
            try:
                event = json.loads(line)
                if event["what"] == "countdown":
                    at = event.get("device_ms")
                    begin = None if at is None else int(at) + round(1000.0 * float(event.get("countdown_s", 0.0)))
                    prompt = Prompt(str(event["gesture"]), begin)
            except (ValueError, KeyError, TypeError):
                continue
        return prompt


_ALIASES = {"x": "acc_x", "y": "acc_y", "z": "acc_z"}
_LIVE_WAIT_S = (0.4, 1.6)
_LISTEN_S = 0.1
_LONGEST_WAIT_S = 10.0
_LEAD_S = 0.6


@dataclass(frozen=True)
class PerformedGesture:
    """A performed gesture: the truth about a part of a stream.

    ``start_ms`` and ``end_ms`` are the device clock at its start and end, as sent; ``start_s`` and ``end_s`` are
    seconds since the first line, in spite of resets and wraps of the clock. ``person`` is the number of who made it.
    """

    label: str
    start_ms: int
    end_ms: int
    person: int
    start_s: float
    end_s: float

    def to_dict(self) -> dict[str, str | int | float]:
        """Return plain values, ready for JSON."""
        return dataclasses.asdict(self)


@dataclass(frozen=True)
class ToyLine:
    """What the toy sends at the time of one frame: usually a line, after a fault none or more, or any bytes.

    ``device_ms`` is the clock in the line, ``passed_ms`` the time since the first line, which goes on through resets;
    ``person`` is the number of who has the toy, ``begins`` the gesture that begins with it, and ``connected`` whether
    the toy is connected then.
    """

    data: bytes
    device_ms: int
    passed_ms: int
    person: int
    begins: PerformedGesture | None = None
    connected: bool = True


@dataclass(frozen=True)
class ToySpec:
    """Settings of a virtual toy: its person and what it performs.

    Attributes:
        person, seed, session: numbers of the person, population and session; equal ones give equal bytes.
        lost, garbled: shares of lines that are lost or corrupted, 0 to 0.9; None: those of ``world``.
        glitch: share of frames in which an electrode has a nonsensical value; None: that of ``world``.
        gestures: gestures to perform repeatedly in this order; if empty, random ones of the paper.
        scenario: people, gestures, humidity and faults until the end; ``person`` and ``gestures`` are not used then.
    """

    person: int = 1
    seed: int = 1
    session: int = 1000
    lost: float | None = None
    garbled: float | None = None
    glitch: float | None = None
    gestures: tuple[str, ...] = ()
    world: World = WORLD
    scenario: ToyScenario | None = None

    @classmethod
    def of(
        cls,
        scenario: ToyScenario,
        seed: int | None = None,
        lost: float | None = None,
        garbled: float | None = None,
        glitch: float | None = None,
    ) -> Self:
        """Return the settings of a toy that plays a scenario, with another seed or other shares where given."""
        return cls(
            scenario.people[0],
            scenario.seed if seed is None else seed,
            lost=scenario.lost if lost is None else lost,
            garbled=scenario.garbled if garbled is None else garbled,
            glitch=scenario.glitch if glitch is None else glitch,
            scenario=scenario,
        )

    def __post_init__(self) -> None:
        for name, number in (("person", self.person), ("seed", self.seed), ("session", self.session)):
            if number < 0:
                raise ConfigError(f"The virtual toy's {name} is {number}; a whole number from 0 on is accepted.")
        for name, value in (("lost", self.lost), ("garbled", self.garbled), ("glitch", self.glitch)):
            if value is not None and not 0.0 <= value <= 0.9:
                raise ConfigError(f"The virtual toy's {name} is {value}; a share from 0 to 0.9 is accepted.")
        for label in self.gestures:
            check_gesture(label)


def channel_columns(layout: Layout) -> list[int]:
    """Return the index of each channel of the layout among the channels of the virtual toy.

    Raises:
        ConfigError: for a layout with sensors that the virtual toy does not have.
    """
    columns = []
    for name in layout.names:
        name = _ALIASES.get(name, name)
        if name not in CHANNELS:
            raise ConfigError(
                "The virtual toy has no sensor '{name}' of layout '{layout}'; it supports plush-15, plush-14 and "
                "accel-3.",
                name=name,
                layout=layout.name,
            )
        columns.append(CHANNELS.index(name))
    return columns


class ToyStream:
    """The lines of a virtual toy, which only a scenario ends.

    With ``prompts``, its person performs the prompted gestures; else those of ``spec``. They may be set or removed at
    any time; the person first ends what was begun. Meanwhile the parts of a scenario wait; its humidity and its faults
    go on.
    """

    def __init__(self, spec: ToySpec, layout: Layout, prompts: Prompts | None = None) -> None:
        self.spec = spec
        self.layout = layout
        self.prompts = prompts
        self._columns = channel_columns(layout)
        person = draw_person(spec.person, spec.seed, spec.world)
        world = spec.world if spec.glitch is None else dataclasses.replace(spec.world, glitch=spec.glitch)
        self._session = VirtualSession(person, spec.seed, spec.session, world, wait_s=_LIVE_WAIT_S)
        self._rng = np.random.default_rng([spec.seed, spec.person, spec.session, 0x10])
        self._faults = FaultyToy((), spec.seed)
        if (scenario := spec.scenario) is not None:
            self._faults = FaultyToy(scenario.faults, spec.seed, scenario.wrap_s)
            self._session.set_humidity(sorted((point.at_s, point.level) for point in scenario.humidity))
        self._first_ms: int | None = None
        self._clock_shift = 0

    def __iter__(self) -> Iterator[ToyLine]:
        session, scenario = self._session, self.spec.scenario
        alone = session.play(self.spec.gestures) if scenario is None else scenario.episodes(session)
        line: ToyLine | None = None
        while True:
            episode = next(alone, None) if self.prompts is None else self._prompted(self.prompts)
            if episode is None:
                break
            for line in self._lines(episode):
                yield line
        if line is not None and (held := self._faults.held()):
            yield ToyLine(held, line.device_ms, line.passed_ms, line.person)

    def _prompted(self, prompts: Prompts) -> Episode:
        """Return the gesture of a new prompt, timed to the start of the recording, or a short idle episode."""
        session = self._session
        prompt = prompts()
        if prompt is None or prompt.label not in GESTURES:  # nobody touches a toy at rest
            return session.idle(_LISTEN_S)
        family, in_hands = split_label(prompt.label)
        lead = _LEAD_S + (PICK_S if in_hands and family != "Hold in hands" else 0.0)
        wait = (
            0.0 if prompt.begin_ms is None else (prompt.begin_ms - self._clock_shift - session.clock_ms) / 1000.0 - lead
        )
        wait = min(max(0.0, wait), _LONGEST_WAIT_S)
        usual, session.wait_s = session.wait_s, (wait, wait)
        try:
            return session.perform(prompt.label)
        finally:
            session.wait_s = usual

    def _lines(self, episode: Episode) -> Iterator[ToyLine]:
        world, n = self.spec.world, len(episode)
        lost = world.lost if self.spec.lost is None else self.spec.lost
        garbled = world.garbled if self.spec.garbled is None else self.spec.garbled
        is_lost = self._rng.random(n) < lost
        is_garbled = self._rng.random(n) < garbled
        if self._first_ms is None:
            self._first_ms = int(episode.device_ms[0])
        passed_ms = episode.device_ms - self._first_ms
        values = self._faults.readings(episode.values, passed_ms)
        device_ms = self._faults.clock(episode.device_ms, passed_ms)
        clock, passed = device_ms.tolist(), passed_ms.tolist()
        self._clock_shift = clock[-1] - int(episode.device_ms[-1])
        person = 0 if self._session.person is None else self._session.person.number
        begins = {}
        for mark in episode.marks:
            start, stop = mark.start - episode.first, mark.stop - episode.first - 1
            begins[start] = PerformedGesture(
                mark.label, clock[start], clock[stop], person, passed[start] / 1000.0, passed[stop] / 1000.0
            )
        order: Sequence[int] = [
            -1 if name == DEVICE_MS else -2 if name == DELAY_MS else self._columns[self.layout.index(name)]
            for name in self.layout.wire
        ]
        clocks = {-1: device_ms, -2: episode.delay_ms}
        rows = np.column_stack([clocks[at] if at < 0 else values[:, at] for at in order]).tolist()
        lines = []
        for i, row in enumerate(rows):
            data = b"" if is_lost[i] else (" ".join(map(str, row)) + "\n").encode("ascii")
            lines.append(garble(data, self._rng) if data and is_garbled[i] else data)
        connected = self._faults.lines(lines, passed_ms)
        for i, data in enumerate(lines):
            yield ToyLine(data, clock[i], passed[i], person, begins.get(i), connected[i])


def received(spec: ToySpec, layout: Layout) -> Iterator[tuple[ToyLine, list[ParsedLine], Counters]]:
    """Yield what a virtual toy sends, the frames that a reader gets from it, and its counters so far.

    The reader reconnects at once. Frames are lost or malformed for it as over a serial port, or TCP.
    """
    counters = Counters()
    parser, connected = LineParser(layout, counters), True
    for line in ToyStream(spec, layout):
        if line.connected != connected:
            connected = line.connected
            counters.reconnects += connected
            parser.finish()
            parser = LineParser(layout, counters)
        yield line, parser.feed(line.data), counters
    parser.finish()


_BLOCK = 200


class VirtualDevice(PacedDevice):
    """A virtual toy in this process, with the same wire format and parser as a real one.

    Its frames end after ``seconds`` or with its scenario. Reading raises DeviceError while a scenario disconnects it.

    ``performed`` are the gestures that its person has made; ``on_performed`` is called with each.

    Args:
        speed: 1 for real time, 0 for as fast as frames are read.
        seconds: device time after which the frames end; 0: never.
    """

    def __init__(self, url: str, layout: Layout, spec: ToySpec, speed: float = 1.0, seconds: float = 0.0) -> None:
        super().__init__(url, layout, speed)
        self.spec = spec
        self.performed: list[PerformedGesture] = []
        self.on_performed: Callable[[PerformedGesture], None] | None = None
        self._stream = ToyStream(spec, layout)
        self._lines = iter(self._stream)
        self._prompt: Prompt | None = None
        self._parser = LineParser(layout, self.counters)
        self._seconds = seconds
        self._next: ToyLine | None = None

    def play_ahead(self) -> None:
        """Compute all lines now, so that reading is as fast as with a real toy.

        Raises:
            ConfigError: if there is neither ``seconds`` nor a scenario, as the toy then has no end.
        """
        if not self._seconds and self.spec.scenario is None:
            raise ConfigError(f"'{self.url}' has no end to play ahead to: give it seconds=.")
        lines: list[ToyLine] = []
        for line in self._lines:
            lines.append(line)
            if self._seconds and line.passed_ms >= self._seconds * 1000.0:
                break
        self._lines = iter(lines)

    def follow(self, prompts: Prompts | None = None) -> None:
        """Let the person make only gestures of ``prompts``, by default of `perform`, after ending what was begun."""
        self._prompt = None
        self._stream.prompts = prompts or self._next_prompt

    def release(self) -> None:
        """Undo `follow`: let the person make gestures of their own again."""
        self._stream.prompts = None

    @property
    def prompted(self) -> str:
        """The gesture that was prompted with `perform` and has not been taken up yet, or ""."""
        return self._prompt.label if self._prompt is not None else ""

    @property
    def following(self) -> bool:
        """Whether the person makes only prompted gestures."""
        return self._stream.prompts is not None

    def perform(self, label: str, begin_ms: int | None = None) -> None:
        """Prompt a gesture whose recording begins when the toy's clock is ``begin_ms``; call `follow` first."""
        self._prompt = Prompt(label, begin_ms)

    def _next_prompt(self) -> Prompt | None:
        prompt, self._prompt = self._prompt, None
        return prompt

    def _next_ms(self) -> int | None:
        if self._next is None:
            self._next = next(self._lines, None)
            if self._next is None:
                return None
        at = self._next.passed_ms
        return None if self._seconds and at >= self._seconds * 1000.0 else at

    def read(self) -> list[Frame] | None:
        """Return the frames that are due, waiting at most about ``wait_s``; return None at the end.

        Raises:
            DeviceError: while the scenario has disconnected the toy.
        """
        lines: list[ToyLine] = []
        for _ in self._due(_BLOCK):
            assert self._next is not None
            if not self._next.connected:
                break
            lines.append(self._take())
        if not lines and not self.closed:
            if self._next_ms() is None:
                self._parser.finish()
                return None
            if self._next is not None and not self._next.connected:
                self._parser.finish()
                raise DeviceError("'{url}' went away: so its scenario says.", url=self.url)
        return self._parser.frames(b"".join(line.data for line in lines), now_ms())

    def _take(self) -> ToyLine:
        """Take the next line, and note the gesture that begins with it."""
        assert self._next is not None
        line, self._next = self._next, None
        if line.begins is not None:
            self.performed.append(line.begins)
            if self.on_performed is not None:
                self.on_performed(line.begins)
        return line

    def reopen(self) -> Self | None:
        """Return this device, open again and with new counters, once the toy is connected again or has ended.

        Return None if it had ended before the connection was lost.

        Raises:
            DeviceError: while the toy is not connected.
        """
        if self._next_ms() is None:
            return None
        while self._next_ms() is not None and self._next is not None and not self._next.connected:
            if self._pacer.due_s(self._next.passed_ms) > 0.0:
                raise DeviceError("'{url}' is not connected.", url=self.url)
            self._take()
        self.closed = False
        self.counters = Counters()
        self._parser = LineParser(self.layout, self.counters)
        return self


_NOT_WITH_SCENARIO = ("person", "session", "gestures")


def open_virtual(address: DeviceAddress, layout: Layout) -> VirtualDevice:
    """Open ``virtual://?person=7&seed=1&speed=1``; also session, lost, garbled, glitch, seconds,
    gestures (with commas).

    ``virtual://?scenario=FILE`` plays the scenario of a TOML file; seed, lost, garbled and glitch replace its own.
    """
    keys = ("person", "seed", "session", "speed", "lost", "garbled", "glitch", "seconds", "gestures", "scenario")
    address.check_keys(keys)
    lost, garbled, glitch = (
        address.number(name, 0.0, 0.0, 0.9) if name in address.query else None for name in ("lost", "garbled", "glitch")
    )
    if "scenario" in address.query:
        for key in _NOT_WITH_SCENARIO:
            if key in address.query:
                raise AddressError(
                    "'{url}': the scenario says the {key}; leave {key} out.", url=address.url, key=key, known="scenario"
                )
        seed = address.whole("seed", 0) if "seed" in address.query else None
        spec = ToySpec.of(load_scenario(address.query["scenario"]), seed, lost, garbled, glitch)
    else:
        text = address.query.get("gestures", "")
        spec = ToySpec(
            person=address.whole("person", 1),
            seed=address.whole("seed", 1),
            session=address.whole("session", 1000),
            lost=lost,
            garbled=garbled,
            glitch=glitch,
            gestures=tuple(g.strip() for g in text.split(",") if g.strip()),
        )
    return VirtualDevice(
        address.url, layout, spec, address.number("speed", 1.0), address.number("seconds", 0.0, 0.0, 1e9)
    )
