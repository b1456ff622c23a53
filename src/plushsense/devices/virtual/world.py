"""Every number that sets how hard the virtual toy is: the toy, its room, its people, how they touch.

Frozen: `tests/devices/test_virtual_frozen.py` holds a hash of these numbers, so that scores on the
virtual toy stay comparable. A score on it says nothing about a real toy.

Units: seconds, hertz, g (gravity), counts (raw integers of the toy). Places run along the toy's back,
0 at the nose and 1 at the end of the tail. Pairs are (mean, spread) unless a comment says (low, high).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass

ZONES = ("cap_extremities", "ears", "head", "neck", "proximity", "nose", "tail", "back", "belly")
"""The capacitive electrodes, in the order of Table 1 of the paper; `cap_all` is summed from them."""

CHANNELS = ("cap_all", *ZONES, "acc_x", "acc_y", "acc_z")
"""All that the virtual toy measures, in wire order."""

Pair = tuple[float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


@dataclass(frozen=True)
class World:
    """The virtual toy's world. The defaults are the frozen difficulty."""

    # The toy. One value an electrode, in the order of ZONES.
    baseline: Nine = (820.0, 460.0, 540.0, 610.0, 380.0, 310.0, 450.0, 760.0, 690.0)
    gain: Nine = (3600.0, 2300.0, 3100.0, 2700.0, 2600.0, 1700.0, 2400.0, 4200.0, 3900.0)
    # Limbs, proximity and belly have no place on the back: reach 0.
    place: Nine = (0.0, 0.24, 0.17, 0.36, 0.0, 0.02, 0.93, 0.62, 0.0)
    reach: Nine = (0.0, 0.06, 0.08, 0.08, 0.0, 0.05, 0.08, 0.15, 0.0)
    all_share: float = 0.30  # cap_all = this share of the sum of the electrodes
    cross_talk: float = 0.07  # of a neighbour's touch signal
    noise_counts: float = 9.0
    hum_counts: float = 10.0  # slow wander of an electrode, 0.05 to 0.6 Hz
    acc_counts_per_g: float = 16384.0
    acc_noise_counts: float = 70.0
    acc_axis_error: float = 0.008  # gain error of an axis, by toy

    # The room.
    humidity_session: float = 0.16  # baseline, relative, from session to session
    humidity_drift: float = 0.05  # within a session, over minutes
    humidity_electrode: float = 0.08  # each electrode's own share
    humidity_gain: float = 0.18  # sensitivity, relative, at one unit of humidity_session
    rest_humidity: float = 1.3  # nobody's recordings were made on more kinds of days

    # The people.
    hand_child: Pair = (0.72, 0.06)
    hand_teen: Pair = (0.90, 0.06)
    hand_adult: Pair = (1.02, 0.07)
    force_log: float = 0.26
    coupling_log: float = 0.22
    tempo_log: float = 0.18
    place_person: float = 0.040  # a person's own idea of where a gesture belongs
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

    # Table or hands: what tells 1 from 2, and what blurs it.
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

    # Time.
    latency_s: Pair = (0.45, 0.15)
    stop_s: Pair = (0.35, 0.12)
    stroke_s: Pair = (3.3, 0.26)  # median, log spread, as are the next
    scratch_s: Pair = (2.9, 0.26)
    tap_s: Pair = (2.6, 0.26)
    hold_s: Pair = (3.3, 0.26)
    hit_s: Pair = (1.0, 0.20)
    pull_s: Pair = (1.2, 0.22)
    rest_s: Pair = (15.0, 0.15)
    person_pace_log: float = 0.14
    countdown_s: float = 3.0

    # The line.
    delay_jitter: float = 0.12  # chance of 9 ms and, as often, of 11 ms instead of 10
    lost: float = 0.0005  # share of the lines that never arrive
    garbled: float = 0.0003
    glitch: float = 0.00002  # share of the frames in which an electrode reads nonsense

    def fingerprint(self) -> str:
        """SHA-256 of all the numbers, in a fixed writing."""
        text = json.dumps(dataclasses.asdict(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


WORLD = World()
