"""The toy's body: presses and shakes are drawn on a canvas, and the canvas becomes the integers that the toy sends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.devices.virtual.world import ZONES, World

Floats = NDArray[np.float64]

RATE_HZ = 100
LIMBS, EARS, HEAD, NECK, PROXIMITY, NOSE, TAIL, BACK, BELLY = range(len(ZONES))
# Electrodes that lie side by side, for cross-talk.
_NEIGHBOURS = (
    *((EARS, HEAD), (HEAD, NECK), (HEAD, NOSE), (EARS, NECK)),
    *((NECK, BACK), (BACK, TAIL), (LIMBS, BELLY), (BACK, BELLY)),
)


def wander(rng: np.random.Generator, n: int, low_hz: float, high_hz: float, parts: int = 5) -> Floats:
    """A smooth random signal of about unit variance between two frequencies, (n,)."""
    hz = low_hz * (high_hz / low_hz) ** rng.random(parts)
    phase = 2 * math.pi * rng.random(parts)
    t = np.arange(n) / RATE_HZ
    waves = np.sin(2 * math.pi * hz[:, None] * t + phase[:, None])
    return np.asarray(waves.sum(axis=0) * math.sqrt(2.0 / parts))


def ramp(n: int, at: int, length: int) -> Floats:
    """0 before ``at``, 1 from ``at + length`` on, smooth in between, (n,)."""
    x = np.clip((np.arange(n) - at) / max(1, length), 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


class Canvas:
    """What hands do to the toy over ``n`` samples, before any sensor has seen it.

    Attributes:
        press: (n, 9) touch on each electrode of `ZONES`, 1 is a firm adult palm.
        near: (n,) how near a hand is, 0 to 1, for the proximity electrode.
        shake: (n, 3) acceleration without gravity, in g.
        down: (n, 3) direction of gravity, of length 1.
        struck: samples at which somebody strikes or jerks the toy: when a rough gesture is felt.
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
        """A contact that moves along the back: place and pressure (m,) from sample ``start`` on.

        An electrode answers by distance; a wide contact covers more of it.
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
        """A blow: a decaying oscillation of the whole toy from sample ``at`` on."""
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
    """Humidity of one session: a level, and a slow drift that is a fixed function of time.

    Attributes:
        level: offset of the session, in units of ``World.humidity_session``.
        electrode: (9,) each electrode's own relative offset in this session.
        waves: (k, 3) amplitude, hertz, phase of the drift.
        axis: (3,) gain of each accelerometer axis.
    """

    level: float
    electrode: Floats
    waves: Floats
    axis: Floats

    @classmethod
    def draw(cls, rng: np.random.Generator, world: World, spread: float = 1.0) -> Climate:
        """A session's climate; ``spread`` widens level and drift."""
        periods_s = np.array([1900.0, 700.0, 260.0, 95.0]) * (0.7 + 0.6 * rng.random(4))
        share = np.array([0.75, 0.5, 0.3, 0.15])
        return cls(
            level=spread * float(rng.standard_normal()),
            electrode=world.humidity_electrode * rng.standard_normal(len(ZONES)),
            waves=np.column_stack((spread * share, 1.0 / periods_s, 2 * math.pi * rng.random(4))),
            axis=1.0 + world.acc_axis_error * rng.standard_normal(3),
        )

    def humidity(self, seconds: Floats, world: World) -> Floats:
        """Relative change of the baselines at these times, (n,)."""
        amplitude, hz, phase = self.waves.T
        drift = (amplitude * np.sin(2 * math.pi * seconds[:, None] * hz + phase)).sum(axis=1)
        return np.asarray(world.humidity_session * self.level + world.humidity_drift * drift)


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
    """What the toy's sensors make of a canvas, (n, 13) raw integers in the order of `CHANNELS`.

    ``first`` is the sample number of the canvas in its session (for the drift), ``coupling`` how well this person's
    skin is sensed.
    """
    n = len(canvas)
    humidity = climate.humidity((first + np.arange(n)) / RATE_HZ, world)
    press = canvas.press.copy()
    press[:, PROXIMITY] += canvas.near + 0.25 * canvas.press.sum(axis=1)
    felt = (1.0 - np.exp(-press)) @ _mixing(world)
    units = humidity / max(1e-9, world.humidity_session)
    sensitivity = coupling * np.maximum(0.2, 1.0 + world.humidity_gain * units)
    base = np.asarray(world.baseline) * (1.0 + humidity[:, None] + climate.electrode)
    hum = np.column_stack([wander(rng, n, 0.05, 0.6, 3) for _ in ZONES])
    zones = base + felt * np.asarray(world.gain) * sensitivity[:, None]
    zones += world.hum_counts * hum + world.noise_counts * rng.standard_normal((n, len(ZONES)))
    total = world.all_share * zones.sum(axis=1) + world.noise_counts * rng.standard_normal(n)
    acc = (canvas.down + canvas.shake) * climate.axis * world.acc_counts_per_g
    acc += world.acc_noise_counts * rng.standard_normal((n, 3))
    raw = np.column_stack((total, zones, np.clip(acc, -32768, 32767)))
    whole: NDArray[np.int64] = np.rint(raw).astype(np.int64)
    return whole
