"""How each of the paper's 17 gestures is made by one person: presses and shakes drawn on a canvas."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plushsense.devices.virtual.canvas import (
    BACK,
    BELLY,
    HEAD,
    LIMBS,
    NECK,
    NOSE,
    RATE_HZ,
    Canvas,
    Floats,
    ramp,
    wander,
)
from plushsense.devices.virtual.people import Person
from plushsense.devices.virtual.world import Pair, World


@dataclass(frozen=True)
class Trial:
    """One performance: who, which family, where in the canvas, how strong and fast this time.

    ``at`` and ``n``: the hand works for ``n`` samples from ``at`` on.
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
    length = max(1, min(n // 3, round(rise_s * RATE_HZ)))
    return ramp(n, 0, length) * (1.0 - ramp(n, n - length, length))


def _cycles(rng: np.random.Generator, n: int, hz: float, jitter: float) -> Floats:
    """Running phase in cycles, (n,), each cycle's length off by a relative ``jitter``."""
    count = int(n / RATE_HZ * hz * 2) + 4
    lengths = RATE_HZ / hz * np.exp(jitter * rng.standard_normal(count))
    ends = np.concatenate(([0.0], np.cumsum(lengths)))
    return np.asarray(np.interp(np.arange(n), ends, np.arange(count + 1.0)) + rng.random())


def _place(trial: Trial, centre: float) -> float:
    return centre + trial.person.offset(trial.family) + trial.shift


def _stroke(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World, path: Pair) -> None:
    """The palm goes along a path and comes back, lifted or not."""
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


def _rub(canvas: Canvas, trial: Trial, rng: np.random.Generator, press: Floats, size_g: float, world: World) -> None:
    """Rubbing shakes the toy a little, as strong as the hand presses."""
    loose = 1.0 if trial.in_hands else world.table_shake
    noise = rng.standard_normal((trial.n, 3)) * np.array([1.0, 0.6, 0.6])
    canvas.shake[trial.at : trial.at + trial.n] += loose * size_g * press[:, None] * noise


def _scratch(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World, centre: float) -> None:
    """Fingertips move to and fro on the spot; people who lift them between two scratches nearly tap."""
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


def _tap(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World, centre: float) -> None:
    """Fingertips come down again and again; people whose fingers stay between two taps nearly scratch."""
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


def _beats(canvas: Canvas, trial: Trial, phase: Floats, size_g: float, rng: np.random.Generator, world: World) -> None:
    """A small knock each time the fingers come down."""
    loose = 1.0 if trial.in_hands else world.table_shake
    for at in np.flatnonzero(np.diff(np.floor(phase + 0.1)) > 0):
        direction = np.array([0.4, 0.3, 1.0]) * rng.standard_normal(3)
        canvas.knock(trial.at + int(at), direction, loose * size_g * trial.force, 9.0, 0.05)


def _hit(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World) -> None:
    """One strike: a short hard press, a blow, and the toy rocks."""
    who = trial.person
    contact = round(RATE_HZ * (0.07 + 0.14 * rng.random()))
    at = min(trial.n - 1, round(trial.n * (0.15 + 0.2 * rng.random())))
    t = np.arange(trial.n) - at
    press = np.where((t >= 0) & (t < contact), 1.0, 0.0) * world.hit_press * trial.force
    press = np.where(t >= contact, world.hit_press * trial.force * np.exp(-(t - contact) / 5.0), press)
    if rng.random() < 0.3:  # some leave the hand there for a while
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


def _pull(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World) -> None:
    """The tail is grasped, jerked once, let go."""
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


def _hug(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World) -> None:
    """The toy is pressed against the body and stays there; breathing moves it."""
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


def _hold(canvas: Canvas, trial: Trial, rng: np.random.Generator, world: World) -> None:
    """Nothing but holding: the grip is the session's business."""


Motion = Callable[[Canvas, Trial, np.random.Generator, World], None]

MOTIONS: dict[str, Motion] = {
    "Back stroke": lambda c, t, r, w: _stroke(c, t, r, w, w.back_path),
    "Head stroke": lambda c, t, r, w: _stroke(c, t, r, w, w.head_path),
    "Ear scratch": lambda c, t, r, w: _scratch(c, t, r, w, w.ear_place),
    "Neck scratch": lambda c, t, r, w: _scratch(c, t, r, w, w.neck_place),
    "Tail scratch": lambda c, t, r, w: _scratch(c, t, r, w, w.tail_place),
    "Tail tap": lambda c, t, r, w: _tap(c, t, r, w, w.tail_place),
    "Tail hit": _hit,
    "Tail pull": _pull,
    "Hold strong": _hug,
    "Hold in hands": _hold,
}

DURATIONS: dict[str, str] = {
    "Back stroke": "stroke_s",
    "Head stroke": "stroke_s",
    "Ear scratch": "scratch_s",
    "Neck scratch": "scratch_s",
    "Tail scratch": "scratch_s",
    "Tail tap": "tap_s",
    "Tail hit": "hit_s",
    "Tail pull": "pull_s",
    "Hold strong": "hold_s",
    "Hold in hands": "hold_s",
}

AT_REST = "At rest"


def split_label(label: str) -> tuple[str, bool]:
    """The family of a gesture of plush-18, and whether the toy is in the hands; ("At rest", False) for nobody's."""
    if label.endswith((" 1", " 2")):
        return label[:-2], label.endswith("2")
    return label, label != AT_REST
