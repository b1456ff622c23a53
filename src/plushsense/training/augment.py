"""Augmentation: training windows that could have been recorded, had the toy lain otherwise.

An accelerometer's axes turn with the toy, and people hold it as they like: on the makeability recordings the mean
direction of gravity at rest differs by up to 90° between people. Turned windows teach the network not to rely on it.
Magnitudes do not change when their vector turns, so a layout that gives a network only magnitudes is not touched.
"""

from __future__ import annotations

import math

from plushsense.core.extras import need
from plushsense.windows.features import Scaler

need("torch", "train")

import torch  # noqa: E402
from torch import Tensor  # noqa: E402


class Turn:
    """Turns the vectors of scaled windows (N, C, T) by a random angle about a random axis, one turn a window.

    The angle is normal with a standard deviation of ``degrees``; all vectors of a window (accelerometer, gyroscope)
    turn alike, as they sit in one toy. The scaling is taken back for the turn and put on again.
    """

    def __init__(
        self, vectors: tuple[tuple[int, ...], ...], scaler: Scaler, degrees: float, device: torch.device
    ) -> None:
        self._degrees = degrees
        self._vectors = [
            (
                torch.tensor(axes, device=device),
                torch.tensor(scaler.offset[list(axes)], dtype=torch.float32, device=device)[:, None],
                torch.tensor(scaler.scale[list(axes)], dtype=torch.float32, device=device)[:, None],
            )
            for axes in (vectors if degrees > 0.0 else ())
        ]

    @property
    def idle(self) -> bool:
        """Whether nothing is turned."""
        return not self._vectors

    def __call__(self, x: Tensor, random: torch.Generator) -> Tensor:
        """Turned copies of the windows ``x``."""
        if self.idle:
            return x
        turns = rotations(len(x), self._degrees, random).to(x.device)
        out = x.clone()
        for axes, offset, scale in self._vectors:
            raw = x[:, axes] / scale + offset
            out[:, axes] = (turns @ raw - offset) * scale
        return out


def rotations(n: int, degrees: float, random: torch.Generator) -> Tensor:
    """Random rotation matrices (n, 3, 3): axes uniform on the sphere, angles normal (Rodrigues' formula)."""
    axis = torch.randn(n, 3, generator=random)
    axis = axis / axis.norm(dim=1, keepdim=True).clamp_min(1e-12)
    angle = torch.randn(n, generator=random) * math.radians(degrees)
    zero = torch.zeros(n)
    x, y, z = axis.unbind(1)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(n, 3, 3)
    sin, cos = angle.sin()[:, None, None], angle.cos()[:, None, None]
    return torch.eye(3) + sin * cross + (1.0 - cos) * (cross @ cross)
