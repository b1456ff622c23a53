"""Augmentations: changes of training windows that could have been recorded with the toy held or worn otherwise.

A setting names them in a list, each with its strength: ``augment = ["random-rotation:45"]``. It replaces the list
of the preset.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from plushsense.core.errors import ConfigError, check_known
from plushsense.windows.features import Scaler

if TYPE_CHECKING:
    import torch
    from torch import Tensor

# Returns changed copies of scaled windows (N, C, T), drawing its random numbers from the generator. The generator is on
# the CPU, the windows are on `Channels.device`.
Transform = Callable[["Tensor", "torch.Generator"], "Tensor"]


@dataclass(frozen=True)
class Channels:
    """The channels of the windows, as augmentations need to know them.

    ``vectors``: the channels of each three-axis sensor (accelerometer, gyroscope). ``scaler``: from raw to scaled.
    """

    vectors: tuple[tuple[int, ...], ...]
    scaler: Scaler
    device: torch.device

    def scaling(self, channels: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Return offset and scale (n, 1) of some channels: scaled = (raw - offset) * scale."""
        import torch

        at = list(channels)
        offset, scale = self.scaler.offset[at], self.scaler.scale[at]
        return (
            torch.tensor(offset, dtype=torch.float32, device=self.device)[:, None],
            torch.tensor(scale, dtype=torch.float32, device=self.device)[:, None],
        )


def random_rotation(degrees: float, channels: Channels) -> Transform | None:
    """Rotate the vectors of every window by a random angle about a random axis.

    People hold the toy as they like: on the makeability recordings the mean direction of gravity at rest differs by
    up to 90° between people. All vectors of a window rotate alike, as they sit in one toy. Magnitudes do not change,
    so a layout that gives a network only magnitudes is left as it is.

    Args:
        degrees: standard deviation of the angle, which is normal.
    """
    import torch

    if not channels.vectors:
        return None
    vectors = [(torch.tensor(axes, device=channels.device), *channels.scaling(axes)) for axes in channels.vectors]

    def rotate(x: Tensor, random: torch.Generator) -> Tensor:
        matrices = rotations(len(x), degrees, random).to(x.device)
        out = x.clone()
        for axes, offset, scale in vectors:
            raw = x[:, axes] / scale + offset
            out[:, axes] = (matrices @ raw - offset) * scale
        return out

    return rotate


class Augmentation(NamedTuple):
    """An augmentation: ``make`` prepares it for the windows, or returns None where it would change nothing.

    ``make`` is called with a strength above 0 and up to ``strongest``. ``unit`` is the unit of the strength in
    messages; "" for a number without one, such as a probability.
    """

    make: Callable[[float, Channels], Transform | None]
    strongest: float
    unit: str = ""


# An augmentation is a function and a line here.
AUGMENTATIONS: dict[str, Augmentation] = {
    "random-rotation": Augmentation(random_rotation, 180.0, "degrees"),
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
    """Return the augmentations of a list as one, applied in their order; None where nothing would change."""
    made = []
    for name, strength in map(parse_augmentation, names):
        transform = AUGMENTATIONS[name].make(strength, channels) if strength > 0.0 else None
        if transform is not None:
            made.append(transform)
    if not made:
        return None

    def apply(x: Tensor, random: torch.Generator) -> Tensor:
        for transform in made:
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
