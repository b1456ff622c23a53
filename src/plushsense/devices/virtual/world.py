"""The constants of the virtual toy, its environment, people and gestures, which determine how difficult it is.

They are frozen, so that scores on the virtual toy stay comparable: `tests/devices/test_virtual_frozen.py` checks their
hash. Such scores do not predict scores on a real toy.

Units: seconds, hertz, g (gravity), counts (raw integers of the toy). Places run along the toy's back,
0 at the nose and 1 at the end of the tail. Pairs are (mean, spread) unless a comment says (low, high).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

ZONES = ("cap_extremities", "ears", "head", "neck", "proximity", "nose", "tail", "back", "belly")
"""The capacitive electrodes, in the order of Table 1 of the paper; `cap_all` is summed from them."""

CHANNELS = ("cap_all", *ZONES, "acc_x", "acc_y", "acc_z")
"""All channels of the virtual toy, in wire order."""

Pair = tuple[float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True)
class World:
    """The constants of the simulation. The defaults are the frozen ones."""

    # The toy. One value an electrode, in the order of ZONES.
    baseline: Nine = (820.0, 460.0, 540.0, 610.0, 380.0, 310.0, 450.0, 760.0, 690.0)
    gain: Nine = (3600.0, 2300.0, 3100.0, 2700.0, 2600.0, 1700.0, 2400.0, 4200.0, 3900.0)
    # Limbs, proximity and belly have no place along the back, so their reach is 0.
    place: Nine = (0.0, 0.24, 0.17, 0.36, 0.0, 0.02, 0.93, 0.62, 0.0)
    reach: Nine = (0.0, 0.06, 0.08, 0.08, 0.0, 0.05, 0.08, 0.15, 0.0)
    all_share: float = 0.30  # cap_all = this share of the sum of the electrodes
    cross_talk: float = 0.07  # of a neighbour's touch signal
    noise_counts: float = 9.0
    hum_counts: float = 10.0  # slow wander of an electrode, 0.05 to 0.6 Hz
    acc_counts_per_g: float = 16384.0
    acc_noise_counts: float = 70.0
    acc_axis_error: float = 0.008  # gain error of an axis, by toy

    # The environment.
    humidity_session: float = 0.16  # baseline, relative, from session to session
    humidity_drift: float = 0.05  # within a session, over minutes
    humidity_electrode: float = 0.08  # each electrode's own share
    humidity_gain: float = 0.18  # sensitivity, relative, at one unit of humidity_session
    rest_humidity: float = 1.3  # factor for recordings without a person, made on more varied days

    # The people.
    hand_child: Pair = (0.72, 0.06)
    hand_teen: Pair = (0.90, 0.06)
    hand_adult: Pair = (1.02, 0.07)
    force_log: float = 0.26
    coupling_log: float = 0.22
    tempo_log: float = 0.18
    place_person: float = 0.040  # spread between people of the place of a gesture
    place_trial: float = 0.014
    force_trial_log: float = 0.15
    tempo_trial_log: float = 0.10

    # How a gesture is made.
    stroke_period_s: Pair = (1.35, 0.18)
    back_path: Pair = (0.44, 0.86)  # from, to
    head_path: Pair = (0.09, 0.33)
    ear_place: float = 0.215
    neck_place: float = 0.365
    tail_place: float = 0.83
    hit_place: float = 0.80
    pull_place: float = 0.97
    palm_width: float = 0.085
    finger_width: float = 0.045
    stroke_press: float = 0.75
    scratch_press: float = 0.60
    tap_press: float = 0.55
    hit_press: float = 2.3
    pull_press: float = 1.5
    scratch_hz: Pair = (3.5, 0.60)
    tap_hz: Pair = (2.45, 0.50)
    scratch_lift: Pair = (0.0, 0.74)  # low, high: share of the pressure that goes between two scratches
    tap_dwell: Pair = (0.0, 0.48)  # low, high: share of the pressure that stays between two taps
    scratch_travel: float = 0.022
    tap_shake_g: float = 0.030
    scratch_shake_g: float = 0.012
    hit_shake_g: Pair = (1.5, 0.30)  # median, log spread
    pull_shake_g: Pair = (0.70, 0.35)

    # Toy on the table (gestures "... 1") or in the hands ("... 2"): the differences, and what reduces them.
    grip: Pair = (0.62, 0.28)  # median, log spread of a person's grip
    grip_tail: float = 0.75  # one hand holds while the other works at the tail
    lap: Pair = (0.08, 0.70)  # low, high over people: how often "in hands" is on the lap
    steady: Pair = (0.08, 0.70)  # and how often the other hand steadies the toy on the table
    blur_tail: float = 1.3  # both more often for what is done at the tail
    blur_hit: float = 2.5  # more so for a strike: the toy would fly away
    blur_head: float = 0.5  # and less often at the head
    light_grip: Pair = (0.30, 0.40)  # median, log spread: the hand on the lap, and the one that steadies
    light_sway: float = 0.12  # of the free sway, lap and steadied alike
    sway_g: Pair = (0.030, 0.35)  # median, log spread
    hug: Pair = (1.55, 0.20)
    table_shake: float = 0.55  # a strike shakes a toy on the table less

    # Time. Long gestures and rest are as long as gives the number of windows that the authors printed (5621 of 1301
    # recordings), and the mean and spread of the ten lengths at rest that they printed (328 to 666 rows).
    latency_s: Pair = (0.45, 0.15)
    stop_s: Pair = (0.35, 0.12)
    stroke_s: Pair = (3.85, 0.26)  # median, log spread, as are the next
    scratch_s: Pair = (3.4, 0.26)
    tap_s: Pair = (3.0, 0.26)
    hold_s: Pair = (3.85, 0.26)
    hit_s: Pair = (1.0, 0.20)
    pull_s: Pair = (1.2, 0.22)
    rest_s: Pair = (5.27, 0.16)
    person_pace_log: float = 0.14
    countdown_s: float = 3.0

    # The line.
    delay_jitter: float = 0.12  # chance of 9 ms and, as often, of 11 ms instead of 10
    lost: float = 0.0005  # share of the lines that never arrive
    garbled: float = 0.0003
    glitch: float = 0.00002  # share of the frames in which an electrode reads nonsense


WORLD = World()


PLACES = (
    *("Back stroke", "Head stroke", "Ear scratch", "Neck scratch"),
    *("Tail scratch", "Tail tap", "Tail hit", "Tail pull"),
)
GROUPS = ("child", "teen", "adult")
# Cumulative shares; the 25 people were 8 kindergarten children, 9 teenagers, 8 adults (section 3.2 of the paper).
GROUP_SHARE = (8 / 25, 17 / 25)


@dataclass(frozen=True)
class Person:
    """A simulated person. Sizes and forces are relative to an average adult; rates in hertz.

    Attributes:
        place: this person's offset along the toy's back for each gesture family of `PLACES`.
        scratch_lift, tap_dwell: style; a scratch with lifting and a tap with dwelling are alike.
        lap, steadies: probability that a toy "in hands" is on the lap, and that one on the table is steadied.
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
        """Return this person's offset along the back for a gesture family; 0 for one without a place."""
        return self.place[PLACES.index(family)] if family in PLACES else 0.0


def draw_person(number: int, seed: int = 1, world: World = WORLD) -> Person:
    """Draw the person with this ``number`` from the population of this ``seed``; deterministic."""
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
