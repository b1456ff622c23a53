"""The people of the virtual toy: hand size, force, tempo and style, each drawn from a seed and a number."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from plushsense.devices.virtual.world import WORLD, Pair, World

PLACES = (
    *("Back stroke", "Head stroke", "Ear scratch", "Neck scratch"),
    *("Tail scratch", "Tail tap", "Tail hit", "Tail pull"),
)
GROUPS = ("child", "teen", "adult")
# 8 kindergarten children, 9 teenagers, 8 adults of 25 (section 3.2 of the paper).
GROUP_SHARE = (8 / 25, 17 / 25)


@dataclass(frozen=True)
class Person:
    """One simulated person. Sizes and forces are relative to an average adult; rates in hertz.

    Attributes:
        place: where this person puts each of `PLACES`, as an offset along the toy's back.
        scratch_lift, tap_dwell: style; a lifted scratch and a dwelling tap look alike.
        lap, steadies: chance that "in hands" is on the lap, that a toy on the table is steadied.
        grip_belly, grip_limbs, grip_back, grip_neck: where the holding hand lies.
    """

    number: int
    group: str
    hand: float
    force: float
    coupling: float
    tempo: float
    pace: float
    place: tuple[float, ...]
    stroke_period_s: float
    stroke_lift: float
    scratch_hz: float
    scratch_lift: float
    tap_hz: float
    tap_dwell: float
    hit: float
    hug: float
    grip: float
    grip_belly: float
    grip_limbs: float
    grip_back: float
    grip_neck: float
    lap: float
    steadies: float
    sway_g: float
    latency_s: float

    def offset(self, family: str) -> float:
        """This person's offset along the back for a gesture family; 0 for one without a place."""
        return self.place[PLACES.index(family)] if family in PLACES else 0.0


def draw_person(number: int, seed: int = 1, world: World = WORLD) -> Person:
    """The person with this number in the population of this seed: always the same one."""
    rng = np.random.default_rng([abs(int(seed)), abs(int(number)), 0x5EED])
    share = rng.random()
    group = GROUPS[0] if share < GROUP_SHARE[0] else GROUPS[1] if share < GROUP_SHARE[1] else GROUPS[2]
    hands = {"child": world.hand_child, "teen": world.hand_teen, "adult": world.hand_adult}
    hand_mean, hand_sd = hands[group]
    hand = max(0.5, hand_mean + hand_sd * rng.standard_normal())

    def log(spread: float) -> float:
        return math.exp(spread * rng.standard_normal())

    def between(pair: Pair) -> float:
        return pair[0] + (pair[1] - pair[0]) * rng.random()

    def around(pair: Pair) -> float:
        return pair[0] + pair[1] * rng.standard_normal()

    force = hand**0.5 * log(world.force_log)
    tempo = log(world.tempo_log)
    return Person(
        number=number,
        group=group,
        hand=hand,
        force=force,
        coupling=log(world.coupling_log),
        tempo=tempo,
        pace=log(world.person_pace_log),
        place=tuple(float(world.place_person * rng.standard_normal()) for _ in PLACES),
        stroke_period_s=max(0.6, around(world.stroke_period_s)) / tempo,
        stroke_lift=rng.random(),
        scratch_hz=max(1.2, around(world.scratch_hz)) * tempo,
        scratch_lift=between(world.scratch_lift),
        tap_hz=max(1.0, around(world.tap_hz)) * tempo,
        tap_dwell=between(world.tap_dwell),
        hit=force**0.5 * log(world.hit_shake_g[1]),
        hug=world.hug[0] * log(world.hug[1]),
        grip=world.grip[0] * log(world.grip[1]),
        grip_belly=between((0.5, 1.2)),
        grip_limbs=between((0.2, 1.0)),
        grip_back=between((0.05, 0.45)),
        grip_neck=between((0.0, 0.30)),
        lap=between(world.lap),
        steadies=between(world.steady),
        sway_g=world.sway_g[0] * log(world.sway_g[1]),
        latency_s=max(0.15, around(world.latency_s)),
    )
