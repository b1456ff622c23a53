"""Hands that hold, steady, approach: what makes "on a table" and "in hands" differ, and what blurs it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from plushsense.devices.virtual.canvas import BACK, BELLY, LIMBS, NECK, RATE_HZ, Canvas, Floats, ramp, wander
from plushsense.devices.virtual.people import Person
from plushsense.devices.virtual.world import World

PICK_S, PUT_S, APPROACH_S, LEAVE_S = 0.8, 0.8, 0.30, 0.25
_UPRIGHT = np.array([0.05, 0.0, 1.0])


def samples(seconds: float) -> int:
    """Whole samples in a duration."""
    return round(seconds * RATE_HZ)


@dataclass(frozen=True)
class Plan:
    """One repetition of a gesture, in samples from the start of its episode.

    The hand works for ``n`` samples from ``at`` on; ``lap``: the toy is on the lap instead of in the hands;
    ``steadied``: the other hand lies on the toy on the table; ``light_grip``: how firm either then is.
    """

    record_start: int
    at: int
    n: int
    record_stop: int
    lap: bool
    steadied: bool
    light_grip: float


class Hands:
    """The holding hands of one person."""

    def __init__(self, who: Person, world: World, rng: np.random.Generator) -> None:
        self._who = who
        self._world = world
        self._rng = rng

    def upright(self) -> Floats:
        """How the toy happens to stand on the table: direction of gravity, (3,)."""
        stand: Floats = _UPRIGHT + 0.06 * self._rng.standard_normal(3)
        return stand

    def light(self) -> float:
        """A light grip, as of a hand that steadies or of a toy on the lap: the same for both."""
        median, spread = self._world.light_grip
        return median * math.exp(spread * self._rng.standard_normal())

    def approach(self, canvas: Canvas, plan: Plan) -> None:
        """The working hand comes near before it touches, and leaves after."""
        n = len(canvas)
        near = ramp(n, plan.at - samples(APPROACH_S), samples(APPROACH_S))
        near *= 1.0 - ramp(n, plan.at + plan.n, samples(LEAVE_S))
        canvas.near += 0.8 * self._who.hand * near

    def steady(self, canvas: Canvas, plan: Plan) -> None:
        """The other hand lies on the toy that stands on the table."""
        n = len(canvas)
        early = samples(0.5 * self._rng.random())
        level = ramp(n, plan.record_start - early, 40) * (1.0 - ramp(n, plan.record_stop, 40))
        self._grip(canvas, plan.light_grip * level)
        self._sway(canvas, self._world.light_sway * level)

    def hold(self, canvas: Canvas, pick: int, put: int, plans: list[Plan], share: float) -> Floats:
        """The toy is taken from the table, held (now and then on the lap), and put down again.

        ``share`` weakens the grip, as when one hand is busy. Returns how the toy stands afterwards, (3,).
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
        held = ramp(n, pick, 35) * (1.0 - ramp(n, put + 25, 40))
        self._grip(canvas, level * held)
        self._sway(canvas, sway * held)
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
        """A hand is never quite still."""
        for axis in range(3):
            slow = wander(self._rng, len(canvas), 0.25, 2.5)
            slow += 0.25 * wander(self._rng, len(canvas), 5.0, 10.0)
            canvas.shake[:, axis] += self._who.sway_g * level * slow
