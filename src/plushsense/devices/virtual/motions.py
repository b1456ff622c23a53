"""Simulate the 17 gestures of the paper, made by one person, as pressure and acceleration over time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.devices.virtual.world import ZONES, Pair, Person, World

Floats = NDArray[np.float64]

RATE_HZ = 100
LIMBS, EARS, HEAD, NECK, PROXIMITY, NOSE, TAIL, BACK, BELLY = range(len(ZONES))
# Adjacent electrodes, for cross-talk.
_NEIGHBOURS = (
    *((EARS, HEAD), (HEAD, NECK), (HEAD, NOSE), (EARS, NECK)),
    *((NECK, BACK), (BACK, TAIL), (LIMBS, BELLY), (BACK, BELLY)),
)


def wander(rng: np.random.Generator, n: int, low_hz: float, high_hz: float, parts: int = 5) -> Floats:
    """Return a smooth random signal (n,) of about unit variance, with frequencies from ``low_hz`` to ``high_hz``."""
    hz = low_hz * (high_hz / low_hz) ** rng.random(parts)
    phase = 2 * math.pi * rng.random(parts)
    t = np.arange(n) / RATE_HZ
    waves = np.sin(2 * math.pi * hz[:, None] * t + phase[:, None])
    return np.asarray(waves.sum(axis=0) * math.sqrt(2.0 / parts))


def ramp(n: int, at: int, length: int) -> Floats:
    """Return a smooth step (n,): 0 before ``at``, 1 from ``at + length`` on."""
    x = np.clip((np.arange(n) - at) / max(1, length), 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


class Canvas:
    """Pressure on the toy and its movement over ``n`` samples, before the sensors measure them.

    Attributes:
        press: (n, 9) pressure on each electrode of `ZONES`; 1 is that of a firm adult palm.
        near: (n,) nearness of a hand, 0 to 1, for the proximity electrode.
        shake: (n, 3) acceleration without gravity, in g.
        down: (n, 3) direction of gravity, a unit vector.
        struck: indices of the samples in which a rough gesture hits or jerks the toy.
    """

    def __init__(self, n: int, down: Floats) -> None:
        self.press: Floats = np.zeros((n, len(ZONES)))
        self.near: Floats = np.zeros(n)
        self.shake: Floats = np.zeros((n, 3))
        self.struck: list[int] = []
        self.down: Floats = np.tile(down / np.linalg.norm(down), (n, 1))

    def __len__(self) -> int:
        return len(self.near)

    def touch(self, start: int, place: Floats, press: Floats, width: float, world: World) -> None:
        """Add a contact that moves along the back, with ``place`` and ``press`` (m,) from sample ``start`` on.

        The signal of an electrode depends on its distance to the contact, and on the width of both.
        """
        stop = min(len(self), start + len(press))
        place, press = place[: stop - start], press[: stop - start]
        for zone, reach in enumerate(world.reach):
            if reach > 0.0:
                spread = width * width + reach * reach
                cover = width / math.sqrt(spread)
                near = np.exp(-((place - world.place[zone]) ** 2) / (2.0 * spread))
                self.press[start:stop, zone] += 1.4 * cover * press * near

    def knock(self, at: int, direction: Floats, size_g: float, hz: float, decay_s: float) -> None:
        """Add an impact: a decaying oscillation of the whole toy from sample ``at`` on."""
        n = min(len(self) - at, int(6 * decay_s * RATE_HZ) + 1)
        if n <= 0:
            return
        t = np.arange(n) / RATE_HZ
        wave = size_g * np.exp(-t / decay_s) * np.cos(2 * math.pi * hz * t)
        self.shake[at : at + n] += wave[:, None] * direction

    def turn(self, at: int, length: int, down: Floats) -> None:
        """Turn the toy so that gravity points along ``down``, over ``length`` samples from ``at`` on."""
        mix = ramp(len(self), at, length)[:, None]
        turned = (1.0 - mix) * self.down + mix * (down / np.linalg.norm(down))
        self.down = turned / np.maximum(1e-6, np.linalg.norm(turned, axis=1, keepdims=True))


@dataclass(frozen=True)
class Climate:
    """Conditions of one session: humidity, with a slow drift that is a fixed function of time, and sensor errors.

    Attributes:
        level: offset of the humidity, in units of ``World.humidity_session``.
        electrode: (9,) relative offset of each electrode in this session.
        waves: (k, 3) amplitude, frequency in hertz, and phase of each part of the drift.
        axis: (3,) gain of each accelerometer axis.
        course: times in seconds with their level, in order, between which the level changes evenly; () for a constant
            ``level``.
    """

    level: float
    electrode: Floats
    waves: Floats
    axis: Floats
    course: tuple[tuple[float, float], ...] = ()

    @classmethod
    def draw(cls, rng: np.random.Generator, world: World, spread: float = 1.0) -> Climate:
        """Draw the conditions of a session; ``spread`` scales level and drift of the humidity."""
        periods_s = np.array([1900.0, 700.0, 260.0, 95.0]) * (0.7 + 0.6 * rng.random(4))
        share = np.array([0.75, 0.5, 0.3, 0.15])
        return cls(
            level=spread * float(rng.standard_normal()),
            electrode=world.humidity_electrode * rng.standard_normal(len(ZONES)),
            waves=np.column_stack((spread * share, 1.0 / periods_s, 2 * math.pi * rng.random(4))),
            axis=1.0 + world.acc_axis_error * rng.standard_normal(3),
        )

    def humidity(self, seconds: Floats, world: World) -> Floats:
        """Return the relative change of the baselines (n,) at the times ``seconds`` (n,)."""
        amplitude, hz, phase = self.waves.T
        drift = (amplitude * np.sin(2 * math.pi * seconds[:, None] * hz + phase)).sum(axis=1)
        level: Floats | float = self.level
        if self.course:
            level = np.interp(seconds, [at for at, _ in self.course], [level for _, level in self.course])
        return np.asarray(world.humidity_session * level + world.humidity_drift * drift)


def _mixing(world: World) -> Floats:
    mixing = np.eye(len(ZONES))
    for a, b in _NEIGHBOURS:
        mixing[a, b] = mixing[b, a] = world.cross_talk
    return mixing


def sense(
    canvas: Canvas,
    first: int,
    climate: Climate,
    coupling: float,
    rng: np.random.Generator,
    world: World,
) -> NDArray[np.int64]:
    """Return the sensor readings of a canvas, (n, 13) raw integers in the order of `CHANNELS`.

    ``first`` is the number of the first sample in the session (for the drift); ``coupling`` is the person's strength of
    electrical coupling to the electrodes.
    """
    n = len(canvas)
    humidity = climate.humidity((first + np.arange(n)) / RATE_HZ, world)
    press = canvas.press.copy()
    press[:, PROXIMITY] += canvas.near + 0.25 * canvas.press.sum(axis=1)
    touch = (1.0 - np.exp(-press)) @ _mixing(world)
    units = humidity / max(1e-9, world.humidity_session)
    sensitivity = coupling * np.maximum(0.2, 1.0 + world.humidity_gain * units)
    base = np.asarray(world.baseline) * (1.0 + humidity[:, None] + climate.electrode)
    hum = np.column_stack([wander(rng, n, 0.05, 0.6, 3) for _ in ZONES])
    zones = base + touch * np.asarray(world.gain) * sensitivity[:, None]
    zones += world.hum_counts * hum + world.noise_counts * rng.standard_normal((n, len(ZONES)))
    total = world.all_share * zones.sum(axis=1) + world.noise_counts * rng.standard_normal(n)
    acc = (canvas.down + canvas.shake) * climate.axis * world.acc_counts_per_g
    acc += world.acc_noise_counts * rng.standard_normal((n, 3))
    raw = np.column_stack((total, zones, np.clip(acc, -32768, 32767)))
    return np.asarray(np.rint(raw), dtype=np.int64)


PICK_S, PUT_S, APPROACH_S, LEAVE_S = 0.8, 0.8, 0.30, 0.25
_UPRIGHT = np.array([0.05, 0.0, 1.0])


def samples(seconds: float) -> int:
    """Return the number of samples in a duration."""
    return round(seconds * RATE_HZ)


@dataclass(frozen=True)
class RepetitionPlan:
    """The timing of one repetition of a gesture, in samples from the start of its episode.

    Attributes:
        record_start, record_stop: start and stop of a recording that is started and stopped by hand.
        at, n: first sample and number of samples of the movement.
        lap: whether a toy "in the hands" lies on the lap.
        steadied: whether the other hand steadies a toy on the table.
        light_grip: strength of the grip in these two cases.
    """

    record_start: int
    at: int
    n: int
    record_stop: int
    lap: bool
    steadied: bool
    light_grip: float


@dataclass(frozen=True)
class Hands:
    """Simulate the holding hands of one person."""

    _who: Person
    _world: World
    _rng: np.random.Generator

    def upright(self) -> Floats:
        """Draw the direction of gravity (3,) for the toy standing on the table."""
        return np.asarray(_UPRIGHT + 0.06 * self._rng.standard_normal(3))

    def light(self) -> float:
        """Draw the strength of a light grip, as of a hand that steadies the toy or holds it on the lap."""
        median, spread = self._world.light_grip
        return median * math.exp(spread * self._rng.standard_normal())

    def approach(self, canvas: Canvas, plan: RepetitionPlan) -> None:
        """Add the approach of the hand before the touch, and its withdrawal after it."""
        n = len(canvas)
        near = ramp(n, plan.at - samples(APPROACH_S), samples(APPROACH_S))
        near *= 1.0 - ramp(n, plan.at + plan.n, samples(LEAVE_S))
        canvas.near += 0.8 * self._who.hand * near

    def steady(self, canvas: Canvas, plan: RepetitionPlan) -> None:
        """Add the other hand, which steadies the toy on the table."""
        n = len(canvas)
        early = samples(0.5 * self._rng.random())
        level = ramp(n, plan.record_start - early, 40) * (1.0 - ramp(n, plan.record_stop, 40))
        self._grip(canvas, plan.light_grip * level)
        self._sway(canvas, self._world.light_sway * level)

    def hold(self, canvas: Canvas, pick: int, put: int, plans: list[RepetitionPlan], share: float) -> Floats:
        """Lift the toy from the table, hold it (sometimes on the lap) and put it down again.

        ``share`` weakens the grip, as when one hand is busy. Returns the direction of gravity (3,) afterwards.
        """
        rng, who, world = self._rng, self._who, self._world
        n = len(canvas)
        grip = share * who.grip
        level, sway = np.full(n, grip), np.ones(n)
        for plan in plans:
            here = ramp(n, plan.record_start - 60, 50) * (1.0 - ramp(n, plan.record_stop, 50))
            if plan.lap:
                level += (plan.light_grip - grip) * here
                sway *= 1.0 - (1.0 - world.light_sway) * here
            level *= np.exp(0.15 * rng.standard_normal() * here)
        lifted = ramp(n, pick, 35) * (1.0 - ramp(n, put + 25, 40))
        self._grip(canvas, level * lifted)
        self._sway(canvas, sway * lifted)
        lift = 0.12 + 0.16 * rng.random()
        canvas.shake[:, 2] += lift * np.sin(2 * math.pi * np.clip((np.arange(n) - pick) / samples(PICK_S), 0, 1))
        canvas.shake[:, 2] -= 0.6 * lift * np.sin(2 * math.pi * np.clip((np.arange(n) - put) / samples(PUT_S), 0, 1))
        canvas.knock(put + samples(PUT_S), np.array([0.1, 0.1, 1.0]), 0.10 + 0.15 * rng.random(), 9.0, 0.05)
        canvas.turn(pick, samples(PICK_S), _UPRIGHT + np.array([0.55, 0.35, 0.2]) * rng.standard_normal(3))
        stand = self.upright()
        canvas.turn(put, samples(PUT_S), stand)
        return stand

    def _grip(self, canvas: Canvas, level: Floats) -> None:
        who, rng = self._who, self._rng
        shares = {BELLY: who.grip_belly, LIMBS: who.grip_limbs, BACK: who.grip_back, NECK: who.grip_neck}
        for zone, share in shares.items():
            here = who.hand * share * math.exp(0.25 * rng.standard_normal())
            moving = 1.0 + 0.12 * wander(rng, len(canvas), 0.1, 1.5)
            canvas.press[:, zone] += here * level * np.maximum(0.0, moving)
        canvas.near += 0.5 * level

    def _sway(self, canvas: Canvas, level: Floats) -> None:
        """Add the small movements of a holding hand."""
        for axis in range(3):
            slow = wander(self._rng, len(canvas), 0.25, 2.5)
            slow += 0.25 * wander(self._rng, len(canvas), 5.0, 10.0)
            canvas.shake[:, axis] += self._who.sway_g * level * slow


@dataclass(frozen=True)
class Performance:
    """One performance of a gesture by a person.

    Attributes:
        family: label of the gesture without its number, such as "Tail tap".
        in_hands: whether the toy is held in the hands.
        at, n: first sample of the movement in the canvas, and number of samples.
        force, tempo: force relative to an average adult; tempo relative to what is usual for this person.
        shift: offset of the place along the toy's back, in addition to the person's own.
    """

    person: Person
    family: str
    in_hands: bool
    at: int
    n: int
    force: float
    tempo: float
    shift: float


def _edges(n: int, rise_s: float = 0.12) -> Floats:
    """Return an envelope (n,) that rises from 0 to 1 within ``rise_s`` and falls again at the end."""
    length = max(1, min(n // 3, round(rise_s * RATE_HZ)))
    return ramp(n, 0, length) * (1.0 - ramp(n, n - length, length))


def _cycles(rng: np.random.Generator, n: int, hz: float, jitter: float) -> Floats:
    """Return the phase in cycles (n,) at about ``hz``; the length of each cycle varies by the relative ``jitter``."""
    count = int(n / RATE_HZ * hz * 2) + 4
    lengths = RATE_HZ / hz * np.exp(jitter * rng.standard_normal(count))
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    return np.asarray(np.interp(np.arange(n), ends, np.arange(count + 1.0)) + rng.random())


def _place(trial: Performance, centre: float) -> float:
    return centre + trial.person.offset(trial.family) + trial.shift


def _stroke(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World, path: Pair) -> None:
    """Add a palm that moves along a path and returns, lifted or not."""
    who = trial.person
    phase = _cycles(rng, trial.n, trial.tempo / who.stroke_period_s, 0.10) % 1.0
    forward = phase < 0.68
    along = np.where(forward, phase / 0.68, (1.0 - phase) / 0.32)
    along = along * along * (3.0 - 2.0 * along)
    start, stop = (_place(trial, p) for p in path)
    place = start + (stop - start) * along
    lift = np.where(forward, 0.0, who.stroke_lift * np.sin(math.pi * np.clip((phase - 0.68) / 0.32, 0, 1)))
    press = world.stroke_press * trial.force * (1.0 - lift) * (1.0 + 0.10 * wander(rng, trial.n, 0.4, 3.0))
    press = np.maximum(0.0, press) * _edges(trial.n)
    canvas.touch(trial.at, place, press, world.palm_width * who.hand, world)
    _rub(canvas, trial, rng, press, 0.4 * world.scratch_shake_g, world)


def _rub(
    canvas: Canvas, trial: Performance, rng: np.random.Generator, press: Floats, size_g: float, world: World
) -> None:
    """Add the vibration of rubbing, in proportion to the pressure."""
    loose = 1.0 if trial.in_hands else world.table_shake
    noise = rng.standard_normal((trial.n, 3)) * np.array([1.0, 0.6, 0.6])
    canvas.shake[trial.at : trial.at + trial.n] += loose * size_g * press[:, None] * noise


def _scratch(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World, centre: float) -> None:
    """Add fingertips that move to and fro on one place; lifted between scratches they resemble a tap."""
    who = trial.person
    phase = _cycles(rng, trial.n, who.scratch_hz * trial.tempo, 0.14)
    lift = who.scratch_lift * (0.5 + 0.5 * np.cos(2 * math.pi * phase)) ** 1.5
    place = _place(trial, centre) + world.scratch_travel * np.sin(2 * math.pi * phase)
    place = place + 0.012 * wander(rng, trial.n, 0.2, 0.8)
    press = world.scratch_press * trial.force * (1.0 - lift) * (1.0 + 0.15 * wander(rng, trial.n, 0.3, 2.0))
    press = np.maximum(0.0, press) * _edges(trial.n)
    canvas.touch(trial.at, place, press, world.finger_width * who.hand, world)
    _rub(canvas, trial, rng, press, world.scratch_shake_g, world)
    _beats(canvas, trial, phase, 0.8 * who.scratch_lift * world.tap_shake_g, rng, world)


def _tap(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World, centre: float) -> None:
    """Add fingertips that come down again and again; resting between taps they resemble a scratch."""
    who = trial.person
    phase = _cycles(rng, trial.n, who.tap_hz * trial.tempo, 0.14)
    pulse = (0.5 + 0.5 * np.cos(2 * math.pi * phase)) ** 1.5
    strength = np.exp(0.18 * rng.standard_normal(int(phase[-1]) + 3))[np.floor(phase + 0.5).astype(np.int64)]
    place = _place(trial, centre) + 0.010 * wander(rng, trial.n, 0.2, 0.8)
    press = world.tap_press * trial.force * (who.tap_dwell + (1.0 - who.tap_dwell) * pulse * strength)
    press = press * _edges(trial.n)
    canvas.touch(trial.at, place, press, world.finger_width * 1.15 * who.hand, world)
    _rub(canvas, trial, rng, press, 0.6 * who.tap_dwell * world.scratch_shake_g, world)
    _beats(canvas, trial, phase, (1.0 - who.tap_dwell) * world.tap_shake_g, rng, world)


def _beats(
    canvas: Canvas, trial: Performance, phase: Floats, size_g: float, rng: np.random.Generator, world: World
) -> None:
    """Add a small impact each time the fingers come down."""
    loose = 1.0 if trial.in_hands else world.table_shake
    for at in np.flatnonzero(np.diff(np.floor(phase + 0.1)) > 0):
        direction = np.array([0.4, 0.3, 1.0]) * rng.standard_normal(3)
        canvas.knock(trial.at + int(at), direction, loose * size_g * trial.force, 9.0, 0.05)


def _hit(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World) -> None:
    """Add a strike: a short strong press and an impact, after which the toy rocks."""
    who = trial.person
    contact = round(RATE_HZ * (0.07 + 0.14 * rng.random()))
    at = min(trial.n - 1, round(trial.n * (0.15 + 0.2 * rng.random())))
    t = np.arange(trial.n) - at
    press = np.where((t >= 0) & (t < contact), 1.0, 0.0) * world.hit_press * trial.force
    press = np.where(t >= contact, world.hit_press * trial.force * np.exp(-(t - contact) / 5.0), press)
    if rng.random() < 0.3:  # some people leave the hand there for a while
        press = press + 0.25 * trial.force * ((t >= contact) & (t < contact + 40))
    place = np.full(trial.n, _place(trial, world.hit_place))
    canvas.touch(trial.at, place, press, world.palm_width * who.hand, world)
    size = world.hit_shake_g[0] * who.hit * trial.force**0.5
    size *= 1.0 if trial.in_hands else 0.5 + 0.5 * world.table_shake
    blow = np.array([0.7, 0.3, -1.0]) * (1.0 + 0.25 * rng.standard_normal(3))
    canvas.struck.append(trial.at + at)
    canvas.knock(trial.at + at, blow, size, 7.0 + 5.0 * rng.random(), 0.05 + 0.03 * rng.random())
    rock = np.array([1.0, 0.5, 0.3]) * (1.0 + 0.3 * rng.standard_normal(3))
    canvas.knock(trial.at + at, rock, 0.16 * size, 1.8 + 1.6 * rng.random(), 0.28)


def _pull(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World) -> None:
    """Add a grasp of the tail, one jerk and the release."""
    who = trial.person
    grasp = _edges(trial.n, 0.15)
    press = world.pull_press * trial.force * grasp * (1.0 + 0.08 * wander(rng, trial.n, 0.5, 4.0))
    place = np.full(trial.n, _place(trial, world.pull_place))
    canvas.touch(trial.at, place, np.maximum(0.0, press), world.finger_width * 1.3 * who.hand, world)
    at = round(trial.n * (0.25 + 0.25 * rng.random()))
    size = world.pull_shake_g[0] * math.exp(world.pull_shake_g[1] * rng.standard_normal()) * who.hit
    jerk = np.array([-1.0, 0.3, 0.4]) * (1.0 + 0.25 * rng.standard_normal(3))
    canvas.struck.append(trial.at + at)
    canvas.knock(trial.at + at, jerk, size, 2.5 + 2.5 * rng.random(), 0.14 + 0.08 * rng.random())


def _hug(canvas: Canvas, trial: Performance, rng: np.random.Generator, world: World) -> None:
    """Add a hug: the toy is pressed against the body, and breathing moves it."""
    who = trial.person
    shape = _edges(trial.n, 0.5) * (1.0 + 0.10 * wander(rng, trial.n, 0.2, 1.2))
    level = who.hug * trial.force
    share = {BELLY: 1.0, LIMBS: 0.8, BACK: 0.55, NOSE: 0.35, HEAD: 0.25, NECK: 0.25}
    for zone, part in share.items():
        part *= math.exp(0.25 * rng.standard_normal())
        canvas.press[trial.at : trial.at + trial.n, zone] += level * part * shape
    breath = 0.012 * np.sin(2 * math.pi * 0.28 * np.arange(trial.n) / RATE_HZ)
    canvas.shake[trial.at : trial.at + trial.n, 2] += breath
    canvas.knock(trial.at + 20, np.array([0.5, 0.2, 0.6]), 0.25 * trial.force, 1.5, 0.25)


Motion = Callable[[Canvas, Performance, np.random.Generator, World], None]

MOTIONS: dict[str, tuple[str, Motion]] = {
    "Back stroke": ("stroke_s", lambda c, t, r, w: _stroke(c, t, r, w, w.back_path)),
    "Head stroke": ("stroke_s", lambda c, t, r, w: _stroke(c, t, r, w, w.head_path)),
    "Ear scratch": ("scratch_s", lambda c, t, r, w: _scratch(c, t, r, w, w.ear_place)),
    "Neck scratch": ("scratch_s", lambda c, t, r, w: _scratch(c, t, r, w, w.neck_place)),
    "Tail scratch": ("scratch_s", lambda c, t, r, w: _scratch(c, t, r, w, w.tail_place)),
    "Tail tap": ("tap_s", lambda c, t, r, w: _tap(c, t, r, w, w.tail_place)),
    "Tail hit": ("hit_s", _hit),
    "Tail pull": ("pull_s", _pull),
    "Hold strong": ("hold_s", _hug),
    "Hold in hands": ("hold_s", lambda c, t, r, w: None),  # the session simulates the grip
}
"""For each family, the field of `World` with its duration, and the function that simulates it."""

AT_REST = "At rest"


def split_label(label: str) -> tuple[str, bool]:
    """Return the family of a gesture of plush-18, and whether the toy is in the hands."""
    if label.endswith((" 1", " 2")):
        return label[:-2], label.endswith("2")
    return label, label != AT_REST
