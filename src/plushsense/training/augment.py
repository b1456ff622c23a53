"""Augmentations: change training windows as if the toy had been held or worn differently.

The setting ``augment`` is a list of names, each with a strength: ``augment = ["random-rotation:45"]``. It replaces the
list of the preset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from plushsense.core.errors import ConfigError, check_known
from plushsense.core.layouts import GRAVITY_FRACTION_BITS
from plushsense.windows.features import Scaler

if TYPE_CHECKING:
    import torch
    from torch import Tensor

# Returns changed copies of scaled windows (N, C, T), drawing its random numbers from the generator. The generator is on
# the CPU, the windows are on `Channels.device`; random numbers are copied there without waiting (non_blocking).
Transform = Callable[["Tensor", "torch.Generator"], "Tensor"]

_WARP_KNOTS = 6


@dataclass(frozen=True)
class Channels:
    """What augmentations need to know about the channels.

    ``vectors``: indices of the channels of each three-axis sensor (accelerometer, gyroscope); with ``has_gravity``, the
    first is the accelerometer and the last is gravity. ``scaler``: scaling of the windows.
    """

    vectors: tuple[tuple[int, ...], ...]
    scaler: Scaler
    device: torch.device
    has_gravity: bool = False

    def index(self, channels: Sequence[int]) -> Tensor:
        """Return channels as an index on the device; with a list, the CPU would wait for a GPU in every batch."""
        import torch

        return torch.tensor(channels, device=self.device)

    def scaling(self, channels: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return offset and scale (n, 1) of some channels: scaled = (raw - offset) * scale."""
        import torch

        index = list(channels)
        offset, scale = self.scaler.offset[index], self.scaler.scale[index]
        return (
            torch.tensor(offset, dtype=torch.float32, device=self.device)[:, None],
            torch.tensor(scale, dtype=torch.float32, device=self.device)[:, None],
        )


def random_rotation(degrees: float, channels: Channels) -> Transform | None:
    """Rotate the vectors of every window by a random angle about a random axis.

    People hold the toy differently: in the makeability recordings the mean direction of gravity at rest differs by up
    to 90° between people. All vectors of a window are rotated alike, as the sensors are in one toy. Magnitudes do not
    change; None if the layout has only magnitudes as inputs.

    Args:
        degrees: standard deviation of the angle, which is normally distributed.
    """
    if not channels.vectors:
        return None
    vectors = [(channels.index(axes), *channels.scaling(axes)) for axes in channels.vectors]

    def rotate(x: Tensor, random: torch.Generator) -> Tensor:
        matrices = rotations(len(x), degrees, random).to(x.device, non_blocking=True)
        out = x.clone()
        for axes, offset, scale in vectors:
            raw = x[:, axes] / scale + offset
            out[:, axes] = (matrices @ raw - offset) * scale
        return out

    return rotate


def random_gain(share: float, channels: Channels) -> Transform | None:
    """Make the movement of every window stronger or weaker by a random factor, up to ``share`` more or less.

    The factor multiplies the difference of the acceleration from gravity, and all other vectors; its logarithm is
    uniform. None without gravity among the inputs.
    """
    if not channels.has_gravity:
        return None
    offset, scale = channels.scaling(channels.vectors[0])
    gravity_offset, gravity_scale = channels.scaling(channels.vectors[-1])
    acceleration, *others, gravity = map(channels.index, channels.vectors)

    def strengthen(x: Tensor, random: torch.Generator) -> Tensor:
        factor = _factors(len(x), share, random).to(x.device, non_blocking=True)[:, None, None]
        out = x.clone()
        rest = (x[:, gravity] / gravity_scale + gravity_offset) / (1 << GRAVITY_FRACTION_BITS)
        raw = x[:, acceleration] / scale + offset
        out[:, acceleration] = (rest + factor * (raw - rest) - offset) * scale
        for axes in others:
            out[:, axes] = x[:, axes] * factor
        return out

    return strengthen


def random_tilt(degrees: float, channels: Channels) -> Transform | None:
    """Turn gravity in every window by a random angle about a random axis, as if it were not exactly known.

    None without gravity among the inputs.

    Args:
        degrees: standard deviation of the angle, which is normally distributed.
    """
    if not channels.has_gravity:
        return None
    axes = channels.index(channels.vectors[-1])

    def tilt(x: Tensor, random: torch.Generator) -> Tensor:
        out = x.clone()
        out[:, axes] = rotations(len(x), degrees, random).to(x.device, non_blocking=True) @ x[:, axes]
        return out

    return tilt


class Playing:
    """Play windows at the product of several speeds, so that samples are interpolated once; `Transform`.

    Each of ``speeds`` draws the speed of windows (N, C, T) between each two samples, (N, T - 1) or (N, 1).
    """

    def __init__(self, *speeds: Transform) -> None:
        self.speeds = speeds

    def __call__(self, x: Tensor, random: torch.Generator) -> Tensor:
        drawn = [speed(x, random) for speed in self.speeds]
        return _played(x, math.prod(drawn[1:], start=drawn[0]).expand(-1, x.shape[2] - 1))


def random_tempo(share: float, channels: Channels) -> Transform | None:
    """Play every window faster or slower by a random factor, up to ``share`` more or less.

    The logarithm of the factor is uniform.
    """
    del channels

    def speed(x: Tensor, random: torch.Generator) -> Tensor:
        return _factors(len(x), share, random)[:, None].to(x.device, non_blocking=True)

    return Playing(speed)


def random_warp(spread: float, channels: Channels) -> Transform | None:
    """Warp the time of every window: some of its movements become faster, others slower.

    The logarithm of the speed is normally distributed at `_WARP_KNOTS` moments, and linear between them.

    Args:
        spread: standard deviation of the logarithm.
    """
    del channels

    def speed(x: Tensor, random: torch.Generator) -> Tensor:
        import torch

        knots = spread * torch.randn(len(x), 1, _WARP_KNOTS, generator=random).to(x.device, non_blocking=True)
        logs = torch.nn.functional.interpolate(knots, size=x.shape[2] - 1, mode="linear", align_corners=True)
        return logs[:, 0].exp()

    return Playing(speed)


def _played(x: Tensor, speed: Tensor) -> Tensor:
    """Play windows (N, C, T) at a speed between each two samples (N, T - 1); they end with the same sample as before.

    Values between samples are interpolated. Where a faster window would begin before its first sample, that sample is
    held: read backwards, a turn would have the other sense of rotation.
    """
    import torch

    last = x.shape[2] - 1
    before_end = torch.nn.functional.pad(speed.flip(1).cumsum(1).flip(1), (0, 1))
    at = (last - before_end).clamp_min(0.0)
    first = at.floor().clamp_max(last - 1)
    index = first.long()[:, None].expand(-1, x.shape[1], -1)
    return torch.lerp(x.gather(2, index), x.gather(2, index + 1), (at - first)[:, None])


def _factors(n: int, share: float, random: torch.Generator) -> Tensor:
    """Draw factors (n,) between 1 / (1 + share) and 1 + share, with a uniform logarithm."""
    import torch

    return torch.exp((2.0 * torch.rand(n, generator=random) - 1.0) * math.log1p(share))


class Augmentation(NamedTuple):
    """An augmentation: ``make`` returns the transform for a strength, or None if it would change nothing.

    The strength is above 0 and at most ``strongest``. ``unit`` is its unit in messages; "" for a number without one,
    such as a probability.
    """

    make: Callable[[float, Channels], Transform | None]
    strongest: float
    unit: str = ""


# To add an augmentation, write a function like `random_rotation` and list it here.
AUGMENTATIONS: dict[str, Augmentation] = {
    "random-rotation": Augmentation(random_rotation, 180.0, "degrees"),
    "random-gain": Augmentation(random_gain, 1.0),
    "random-tilt": Augmentation(random_tilt, 90.0, "degrees"),
    "random-tempo": Augmentation(random_tempo, 1.0),
    "random-warp": Augmentation(random_warp, 1.0),
}


def parse_augmentation(text: str) -> tuple[str, float]:
    """Split ``random-rotation:45`` into the name and the strength.

    Raises:
        ConfigError: for an unknown name (with the nearest known one), or a strength out of range.
    """
    name, _, number = text.partition(":")
    check_known(name, AUGMENTATIONS, "augmentation", ConfigError)
    known = AUGMENTATIONS[name]
    try:
        strength = float(number)
    except ValueError:
        strength = math.nan
    if not 0.0 <= strength <= known.strongest:
        unit = f" {known.unit}" if known.unit else ""
        raise ConfigError(f"Augmentation '{text}': write {name}:NUMBER with 0 (off) to {known.strongest:g}{unit}.")
    return name, strength


def augmentations(names: Sequence[str], channels: Channels) -> Transform | None:
    """Combine augmentations into one transform, applied in order; None if it would change nothing."""
    transforms = list[Transform]()
    for name, strength in map(parse_augmentation, names):
        transform = AUGMENTATIONS[name].make(strength, channels) if strength > 0.0 else None
        if isinstance(transform, Playing) and transforms and isinstance(transforms[-1], Playing):
            transforms[-1] = Playing(*transforms[-1].speeds, *transform.speeds)
        elif transform is not None:
            transforms.append(transform)
    if not transforms:
        return None

    def apply(x: Tensor, random: torch.Generator) -> Tensor:
        for transform in transforms:
            x = transform(x, random)
        return x

    return apply


def rotations(n: int, degrees: float, random: torch.Generator) -> Tensor:
    """Draw rotation matrices (n, 3, 3): axes uniform on the sphere, angles normal (Rodrigues' formula)."""
    import torch

    axis = torch.randn(n, 3, generator=random)
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-12)
    angle = torch.randn(n, generator=random) * math.radians(degrees)
    zero = torch.zeros(n)
    x, y, z = axis.unbind(1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(n, 3, 3)
    sin, cos = angle.sin()[:, None, None], angle.cos()[:, None, None]
    return torch.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross)
