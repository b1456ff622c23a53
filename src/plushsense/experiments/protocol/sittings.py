"""Sessions with known gestures for the real-time protocol, played by virtual people or read from a data set."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from plushsense.core.errors import ConfigError, DatasetError, nearest
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import Dataset
from plushsense.devices.virtual.session import GESTURES, VirtualSession
from plushsense.devices.virtual.stream import channel_columns
from plushsense.devices.virtual.world import WORLD, World, draw_person
from plushsense.models.bundle import known_people
from plushsense.windows.clock import row_times_us

FIRST_STRANGER = 1001
"""Number of the first virtual person in the protocol; data sets of virtual people number theirs from 1."""
_SESSION = 46  # no other use of the virtual toy has this session number
_IDLE_S = (1.0, 3.0)
_VIRTUAL_CODE = re.compile(r"P0*(\d{1,9})")


@dataclass(frozen=True)
class GestureTrial:
    """A gesture that a person made; times in seconds since the stream's first frame.

    The gesture lasts from ``start_s`` to ``stop_s``. Reaction times count from ``onset_s``, which equals ``start_s``
    except for blows of virtual people, where it is the moment of impact.
    """

    label: str
    repetition: int
    start_s: float
    onset_s: float
    stop_s: float


@dataclass(frozen=True, eq=False)
class Sitting:
    """A session of one person: the whole stream and the gestures in it, in order.

    ``reactions`` are the toy's own, (time in s since the first frame, affect), as a person noted them; None: not noted.
    """

    who: str
    frames: Frames
    trials: tuple[GestureTrial, ...]
    reactions: tuple[tuple[float, str], ...] | None = None

    def play(self) -> Sitting:
        """Return this sitting; one of a virtual person is played first."""
        return self


@dataclass(frozen=True)
class LeftOut:
    """A person who was left out, and why."""

    who: str
    why: str


def virtual_numbers(people: int, first: int, provenance: Mapping[str, Any]) -> list[int]:
    """Return the numbers of ``people`` virtual people from ``first`` on, none of whom the network was trained on.

    A bundle does not record the seed of its virtual people, so that the numbers of its training and validation people
    are refused for every seed.

    Raises:
        ConfigError: for a value out of range, or a number among the bundle's training or validation people.
    """
    for name, value, low, high in (("people", people, 1, 1000), ("first", first, 1, 2**31)):
        if not low <= value <= high:
            raise ConfigError(f"{name} is {value}; a whole number from {low} to {high} is accepted.")
    numbers = list(range(first, first + people))
    if provenance.get("simulated") is not True:
        return numbers
    met = {int(m[1]) for code in known_people(provenance) if (m := _VIRTUAL_CODE.fullmatch(code)) is not None}
    if known := [n for n in numbers if n in met]:
        raise ConfigError(
            f"Virtual person {known[0]} is one of the {len(met)} that this network was trained on or chosen by: use "
            f"other people, for instance --first {max(met) + 1}."
        )
    return numbers


def virtual_sittings(
    numbers: Sequence[int],
    seed: int,
    repetitions: int,
    layout: Layout,
    *,
    gestures: Sequence[str] = GESTURES,
    world: World = WORLD,
) -> list[VirtualSitting]:
    """Return the paper's protocol for each virtual person: 17 gestures, each ``repetitions`` times in a row.

    Raises:
        ConfigError: for a number out of range, or a layout that the virtual toy does not support.
    """
    for name, value, low, high in (("repetitions", repetitions, 1, 100), ("seed", seed, 0, 2**31)):
        if not low <= value <= high:
            raise ConfigError(f"{name} is {value}; a whole number from {low} to {high} is accepted.")
    columns = tuple(channel_columns(layout))
    return [VirtualSitting(number, seed, repetitions, columns, tuple(gestures), world) for number in numbers]


@dataclass(frozen=True)
class VirtualSitting:
    """A session of one virtual person, which is played when it is scored.

    Between two gestures the toy stands idle, is picked up and turned without a gesture, and stands idle again.
    Between two repetitions the person waits for the recorder's countdown.
    """

    number: int
    seed: int
    repetitions: int
    columns: tuple[int, ...]
    gestures: tuple[str, ...]
    world: World

    @property
    def who(self) -> str:
        """Name of the person."""
        return f"virtual {self.number}"

    def play(self) -> Sitting:
        """Return the session of this person."""
        number, seed, repetitions, world = self.number, self.seed, self.repetitions, self.world
        session = VirtualSession(draw_person(number, seed, world), seed, _SESSION, world)
        rng = np.random.default_rng([seed, number, _SESSION])
        episodes = [session.idle(4.0)]
        for label in self.gestures:
            episodes.append(session.handle())
            episodes.append(session.idle(float(rng.uniform(*_IDLE_S))))
            episodes.append(session.perform(label, repetitions))
            episodes.append(session.idle(float(rng.uniform(*_IDLE_S))))
        device_ms = np.concatenate([e.device_ms for e in episodes])
        values = np.concatenate([e.values for e in episodes])[:, list(self.columns)]
        received = rng.random(len(values)) >= world.lost + world.garbled
        frames = Frames(values[received], device_ms[received])
        first_ms = int(frames.device_ms[0])
        trials = []
        for n, mark in enumerate(m for e in episodes for m in e.marks):
            onset = mark.start if mark.struck is None else mark.struck
            start_s, onset_s, stop_s = (
                (int(device_ms[min(sample, len(device_ms) - 1)]) - first_ms) / 1000.0
                for sample in (mark.start, onset, mark.stop)
            )
            trials.append(GestureTrial(mark.label, n % repetitions + 1, start_s, onset_s, stop_s))
        return Sitting(self.who, frames, tuple(trials))


def recorded_people(dataset: Dataset, asked: Sequence[str] | None, provenance: Mapping[str, Any]) -> list[str]:
    """Return the people of a data set to score: those in ``asked``, or all on whom the network was not trained.

    Raises:
        ConfigError: for a person who is not in the data set, or on whom the network was trained or chosen.
    """
    same = provenance.get("dataset_hash") == dataset.hash or provenance.get("dataset") == dataset.head.name
    met = known_people(provenance) if same else set()
    if asked is None:
        strangers = [code for code in dataset.subjects if code not in met]
        if not strangers:
            raise ConfigError(
                f"This network was trained on, or chosen by, everybody in '{dataset.head.name}': take one that was "
                "trained without some of them."
            )
        return strangers
    for code in asked:
        if code not in dataset.subjects:
            raise ConfigError(
                f"There is no '{code}' in '{dataset.head.name}', which holds {', '.join(dataset.subjects)}."
                f"{nearest(code, dataset.subjects)}"
            )
        if code in met:
            raise ConfigError(
                f"'{code}' is among the people that this network was trained on or chosen by: leave that person out."
            )
    return list(dict.fromkeys(asked))


def recorded_sittings(
    dataset: Dataset, people: Sequence[str], gestures: GestureSet
) -> tuple[list[Sitting], list[LeftOut]]:
    """Return each person's streams with the recordings of ``gestures`` in them as trials, onset at the start mark.

    Recordings at rest are not trials. A person with several streams has a sitting for each.

    Returns:
        the sittings, and the people left out because no stream of theirs has such a recording.

    Raises:
        DatasetError: when nobody is left.
    """
    sittings: list[Sitting] = []
    left: list[LeftOut] = []
    for who in people:
        streams = [s for s in dataset.streams if s.subject == who]
        if not streams:
            left.append(LeftOut(who, "has no session stream, only single recordings"))
            continue
        trials_made = 0
        for stream in streams:
            located = [r for r in dataset.used if r.stream == stream.id and r.stream_row >= 0]
            known = [r for r in located if (g := gestures.find(r.gesture)) is not None and not g.idle]
            mine = sorted(known, key=lambda r: r.stream_row)
            if not mine:
                continue
            frames = dataset.read_stream(stream.id)
            times = row_times_us(frames, dataset.layout) / 1e6
            made: dict[str, int] = {}
            trials = []
            for r in mine:
                label = gestures.get(r.gesture).label
                made[label] = made.get(label, 0) + 1
                first, last = (min(r.stream_row + row, len(times) - 1) for row in (r.start, r.stop - 1))
                trials.append(
                    GestureTrial(label, made[label], float(times[first]), float(times[first]), float(times[last]))
                )
            trials_made += len(trials)
            name = who if len(streams) == 1 else f"{who}, {stream.session}"
            sittings.append(Sitting(name, frames, tuple(trials)))
        if not trials_made:
            left.append(LeftOut(who, "has a session stream, but none of the recordings was found in it"))
    if not sittings:
        why = f" ('{left[0].who}' {left[0].why})" if left else ""
        raise DatasetError(
            f"Nobody in '{dataset.head.name}' has a session stream with recordings in it{why}: the protocol needs "
            "fulldatastream.csv beside the recordings, from the recorder or from  plushsense record."
        )
    return sittings, left
