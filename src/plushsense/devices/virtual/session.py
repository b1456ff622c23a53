"""Simulate a person's session with the toy: waiting, picking it up, gestures, putting it down, and the sensor signals.

A session is a sequence of episodes. Each begins and ends with the toy on the table and no hand near, so that episodes
can be joined in any order; sample numbers, device clock and humidity drift continue from one to the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, nearest
from plushsense.devices.virtual.motions import (
    APPROACH_S,
    AT_REST,
    MOTIONS,
    PICK_S,
    PUT_S,
    RATE_HZ,
    Canvas,
    Climate,
    Floats,
    Hands,
    Performance,
    RepetitionPlan,
    samples,
    sense,
    split_label,
)
from plushsense.devices.virtual.world import WORLD, Pair, Person, World, draw_person

GESTURES = (
    "Back stroke 1", "Back stroke 2", "Ear scratch 1", "Ear scratch 2", "Head stroke 1", "Head stroke 2",
    "Hold in hands", "Hold strong", "Neck scratch 1", "Neck scratch 2", "Tail hit 1", "Tail hit 2", "Tail pull",
    "Tail scratch 1", "Tail scratch 2", "Tail tap 1", "Tail tap 2",
)  # fmt: skip
"""The 17 gestures of the paper that a person makes, in class order."""


def check_gesture(label: str) -> None:
    """Raise ConfigError for a gesture that simulated people cannot perform."""
    known = (AT_REST, *GESTURES)
    if label not in known:
        raise ConfigError(
            f"The virtual toy's people know no gesture '{label}'; they know {', '.join(known)}.{nearest(label, known)}"
        )


_POSTURES = np.array([(0, 0, 1.0), (0, 0, -1.0), (0, 1.0, 0.1), (0, -1.0, 0.1), (1.0, 0, 0.2), (-1.0, 0, 0.2)])


@dataclass(frozen=True)
class GestureMark:
    """A performed gesture, in samples of the session.

    The movement lasts from ``start`` to ``stop``; a recording started and stopped by hand, from ``record_start`` to
    ``record_stop``. ``struck`` is the sample of the impact or jerk of a rough gesture; None for other gestures.
    """

    label: str
    record_start: int
    start: int
    stop: int
    record_stop: int
    struck: int | None = None


@dataclass(frozen=True)
class Episode:
    """A section of a session.

    ``first`` is the number of its first sample; ``values`` (n, 13) are raw, in the order of `CHANNELS`;
    ``device_ms``, ``delay_ms`` (n,) are device clock and time since the frame before; ``marks`` are the gestures in it.
    """

    first: int
    values: NDArray[np.int64]
    device_ms: NDArray[np.int64]
    delay_ms: NDArray[np.int64]
    marks: tuple[GestureMark, ...] = ()

    def __len__(self) -> int:
        return len(self.device_ms)


@dataclass
class VirtualSession:
    """A person's session with the toy. The same person, seed and number give the same session.

    Args:
        person: the person; None for recordings of the toy at rest (somebody turns the toy over and goes away).
        seed: seed of the population and of all random numbers.
        number: number of the session of this person.
        wait_s: time between two gestures (low, high); by default a little longer than the recorder's countdown.
    """

    person: Person | None
    seed: int = 1
    number: int = 0
    world: World = WORLD
    wait_s: Pair | None = None
    samples: int = field(default=0, init=False)
    clock_ms: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        key = 10**9 + 1 if self.person is None else self.person.number
        self._rng = np.random.default_rng([self.seed, key, 0xA1, self.number])
        self._who = draw_person(0, self.seed, self.world) if self.person is None else self.person
        self._hands = Hands(self._who, self.world, self._rng)
        spread = self.world.rest_humidity if self.person is None else 1.0
        self._climate = Climate.draw(self._rng, self.world, spread)
        self._down: Floats = self._hands.upright()
        self.clock_ms = int(self._rng.integers(5_000, 60_000))

    def hand_over(self, person: Person) -> None:
        """Let another person take the toy; clock, humidity and the toy's position continue."""
        if person.number != self._who.number:
            self.person = self._who = person
            self._hands = Hands(person, self.world, self._rng)

    def set_humidity(self, course: Iterable[tuple[float, float]]) -> None:
        """Let the humidity follow pairs of a time in seconds and a level, instead of the level of the session."""
        self._climate = replace(self._climate, course=tuple(course))

    # Episodes -------------------------------------------------------------------------------------------------

    def perform(self, label: str, repetitions: int = 1) -> Episode:
        """Perform a gesture of plush-18 ``repetitions`` times; "At rest" turns the toy over and leaves it alone."""
        check_gesture(label)
        if label == AT_REST:
            return self._rest(repetitions)
        family, in_hands = split_label(label)
        rng, who, world = self._rng, self._who, self.world
        plans, at, picked_once = [], samples(0.6), in_hands and family != "Hold in hands"
        first_pick = at
        at += samples(PICK_S) if picked_once else 0
        for _ in range(repetitions):
            at += self._wait()
            plan = self._plan(family, at)
            plans.append(plan)
            at = plan.record_stop
            if family == "Hold in hands":
                at += samples(PUT_S + 0.4)
        put = at + samples(0.3)
        n = put + samples(PUT_S + 0.6 if in_hands else 0.5)
        canvas = Canvas(n, self._down)
        if picked_once:
            share = world.grip_tail if family.startswith("Tail") else 1.0
            self._down = self._hands.hold(canvas, first_pick, put, plans, share)
        for plan in plans:
            trial = Performance(
                person=who,
                family=family,
                in_hands=in_hands,
                at=plan.at,
                n=plan.n,
                force=who.force * math.exp(world.force_trial_log * rng.standard_normal()),
                tempo=math.exp(world.tempo_trial_log * rng.standard_normal()),
                shift=world.place_trial * rng.standard_normal(),
            )
            if family == "Hold in hands":
                self._down = self._hands.hold(canvas, plan.at, plan.record_stop + samples(0.2), [plan], 1.0)
            elif family != "Hold strong":
                self._hands.approach(canvas, plan)
            if plan.steadied and not in_hands:
                self._hands.steady(canvas, plan)
            MOTIONS[family][1](canvas, trial, rng, world)
        at = self.samples
        marks = []
        for p in plans:
            blow = next((at + s for s in canvas.struck if p.at <= s < p.at + p.n), None)
            marks.append(GestureMark(label, at + p.record_start, at + p.at, at + p.at + p.n, at + p.record_stop, blow))
        return self._sense(canvas, tuple(marks))

    def idle(self, seconds: float) -> Episode:
        """Leave the toy untouched on the table."""
        return self._sense(Canvas(max(1, samples(seconds)), self._down), ())

    def handle(self) -> Episode:
        """Lift the toy, turn it and put it down, without any gesture."""
        n_hold = samples(0.6 + 1.2 * self._rng.random())
        start = samples(0.4)
        put = start + samples(PICK_S) + n_hold
        canvas = Canvas(put + samples(PUT_S + 0.5), self._down)
        self._down = self._hands.hold(canvas, start, put, [], 1.0)
        return self._sense(canvas, ())

    def play(self, gestures: Iterable[str] | None = None) -> Iterator[Episode]:
        """Yield endless episodes: idle time, sometimes handling, and the ``gestures`` in turn, or random ones."""
        script = tuple(gestures or ())
        turn = 0
        while True:
            yield self.idle(0.6 + 2.0 * self._rng.random())
            if self._rng.random() < 0.12:
                yield self.handle()
            label = script[turn % len(script)] if script else GESTURES[int(self._rng.integers(len(GESTURES)))]
            turn += 1
            yield self.perform(label)

    # Simulation -----------------------------------------------------------------------------------------------

    def _wait(self) -> int:
        low, high = self.wait_s or (self.world.countdown_s + 0.5, self.world.countdown_s + 2.0)
        return samples(low + (high - low) * self._rng.random())

    def _plan(self, family: str, record_start: int) -> RepetitionPlan:
        rng, who, world = self._rng, self._who, self.world
        median, spread = getattr(world, MOTIONS[family][0])
        latency = max(0.1, who.latency_s + 0.5 * world.latency_s[1] * rng.standard_normal())
        active = max(0.5, median * who.pace * math.exp(spread * rng.standard_normal()))
        stop = max(0.05, world.stop_s[0] + world.stop_s[1] * rng.standard_normal())
        at = record_start + samples(latency + APPROACH_S)
        n = samples(active)
        blur = world.blur_head if family == "Head stroke" else 1.0
        blur = world.blur_tail if family.startswith("Tail") else blur
        blur = world.blur_hit if family == "Tail hit" else blur
        lap, steadied = rng.random() < blur * who.lap, rng.random() < blur * who.steadies
        return RepetitionPlan(record_start, at, n, at + n + samples(stop), lap, steadied, self._hands.light())

    def _rest(self, repetitions: int) -> Episode:
        """Lay the toy down in a random posture each time, and leave it alone."""
        rng, world = self._rng, self.world
        pieces, marks = [], []
        for _ in range(repetitions):
            pieces.append(self._lay(_POSTURES[int(rng.integers(len(_POSTURES)))]))
            pieces.append(self.idle(self._wait() / RATE_HZ))
            seconds = max(3.0, world.rest_s[0] * math.exp(world.rest_s[1] * rng.standard_normal()))
            start = self.samples
            pieces.append(self.idle(seconds))
            marks.append(GestureMark(AT_REST, start, start, self.samples, self.samples))
        return Episode(
            pieces[0].first,
            np.concatenate([p.values for p in pieces]),
            np.concatenate([p.device_ms for p in pieces]),
            np.concatenate([p.delay_ms for p in pieces]),
            tuple(marks),
        )

    def _lay(self, posture: Floats) -> Episode:
        """Lift the toy and lay it down, so that gravity is about along ``posture``."""
        start = samples(0.3)
        put = start + samples(1.4)
        canvas = Canvas(put + samples(PUT_S + 0.6), self._down)
        self._hands.hold(canvas, start, put, [], 1.0)
        self._down = posture + 0.15 * self._rng.standard_normal(3)
        canvas.turn(put, samples(PUT_S), self._down)
        return self._sense(canvas, ())

    def _sense(self, canvas: Canvas, marks: tuple[GestureMark, ...]) -> Episode:
        rng, world, n = self._rng, self.world, len(canvas)
        first = self.samples
        values = sense(canvas, first, self._climate, self._who.coupling, rng, world)
        nonsense = np.flatnonzero(rng.random(n) < world.glitch)
        if len(nonsense):
            values[nonsense, rng.integers(0, 10, len(nonsense))] = -rng.integers(2001, 32000, len(nonsense))
        draw = rng.random(n)
        late, early = draw > 1.0 - world.delay_jitter, draw < world.delay_jitter
        delay = 10 + late.astype(np.int64) - early.astype(np.int64)
        clock = self.clock_ms + np.cumsum(delay)
        self.samples += n
        self.clock_ms = int(clock[-1])
        return Episode(first, values, clock, delay, marks)
