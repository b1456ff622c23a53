"""Networks made of PyTorch layers, whose logits equal those of `plushsense.models.reference` to 1e-5.

Training starts from the weights of such a network. Architectures that ``training/fast`` does not support (see
``training/engine``) are also trained with it.

Activations are (N, C, 1, T) with the channels last in memory: on a CPU, a training step then takes 0.5 to 0.75 of the
time that it takes with Conv1d on (N, C, T), measured with kernels of 14 to 126 taps. On a GPU, it lets PyTorch use
cuDNN for dilated convolutions that must be repeatable; with other orders it computes them window by window.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import need
from plushsense.models.arch import NORM_EPSILON, NORM_TENSORS, Arch, VectorLayer
from plushsense.models.reference import check_weights, check_windows
from plushsense.models.vectors import LENGTH_EPSILON, TURN_EPSILON

try:
    import torch
except ModuleNotFoundError:
    need("torch", extra="train")
    raise
from torch import Tensor, nn
from torch.nn import functional as F

MOMENTUM = 0.1  # of running means and variances
FORMAT = torch.channels_last


def _mirrored(x: Tensor, left: int) -> Tensor:
    """Extend ``x`` (N, C, 1, T) as `models.arch.reflected` does; training is faster with flips than with an index."""
    while left:
        some = min(left, x.shape[3] - 1)
        x = torch.cat([x[..., 1 : some + 1].flip(3), x], dim=3)
        left -= some
    return x.contiguous(memory_format=FORMAT)


class _Block(nn.Module):
    """A layer on (N, C, 1, T): padding, convolution over time, ReLU and normalisation."""

    def __init__(self, arch: Arch, i: int) -> None:
        super().__init__()
        layer = arch.layers[i]
        self.reach, self.padding, self.norm = layer.reach, arch.padding, arch.norm
        self.conv = nn.Conv2d(arch.inputs[i], layer.filters, (1, layer.kernel), dilation=(1, layer.dilation))
        if arch.norm != "none":
            self.gain = nn.Parameter(torch.ones(layer.filters))
            self.shift = nn.Parameter(torch.zeros(layer.filters))
        self.mean: Tensor
        self.var: Tensor
        self.register_buffer("mean", torch.zeros(layer.filters))
        self.register_buffer("var", torch.ones(layer.filters))

    def forward(self, x: Tensor) -> Tensor:
        if self.padding == "mirror":
            x = _mirrored(x, self.reach)
        elif self.reach and self.padding == "causal":
            x = F.pad(x, (self.reach, 0))
        z = F.relu(self.conv(x))
        if self.norm == "none":
            return z
        if self.norm == "layer":
            rows = F.layer_norm(z.permute(0, 2, 3, 1), (z.shape[1],), self.gain, self.shift, NORM_EPSILON)
            return rows.permute(0, 3, 1, 2)
        return F.batch_norm(z, self.mean, self.var, self.gain, self.shift, self.training, MOMENTUM, NORM_EPSILON)


class VectorNet(nn.Module):
    """The vector layer of `plushsense.models.arch.VectorLayer`: inputs (N, C, T) → outputs (N, M, T')."""

    def __init__(self, layer: VectorLayer, arch: Arch) -> None:
        super().__init__()
        self.layer, self._others = layer, arch.channels - layer.axes
        shape = layer.vectors, layer.filters, layer.kernel
        # About half of the usual variance: lengths add three axes.
        self.weight = nn.Parameter(torch.randn(shape) * (0.5 / layer.kernel) ** 0.5)
        self.mean: Tensor
        self.var: Tensor
        self.register_buffer("mean", torch.zeros(arch.inputs[0]))
        self.register_buffer("var", torch.ones(arch.inputs[0]))

    def forward(self, x: Tensor) -> Tensor:
        """Compute the outputs; in training mode, standardize them by the batch and update the running statistics."""
        n, _, t = x.shape
        newest = x[:, :, self.layer.reach :]
        gravity = newest[:, -3:]
        up = (gravity * (gravity.square().sum(1, keepdim=True) + LENGTH_EPSILON).rsqrt())[:, :, None]
        parts = [newest[:, : self._others]]
        for number, weight in enumerate(self.weight):
            first = self._others + 3 * number
            axes = x[:, first : first + 3]
            d = F.conv1d(axes.reshape(3 * n, 1, t), weight[:, None]).view(n, 3, len(weight), -1)
            vertical = (d * up).sum(1)
            h = d - vertical[:, None] * up
            length = (h.square().sum(1) + LENGTH_EPSILON).sqrt()
            turn = (torch.linalg.cross(h, h.roll(-1, 2), dim=1) * up).sum(1)
            parts += [vertical, length, self.sense(turn, length)]
        z = torch.cat(parts, dim=1)
        return F.batch_norm(z, self.mean, self.var, None, None, self.training, MOMENTUM, NORM_EPSILON)

    def sense(self, turn: Tensor, length: Tensor) -> Tensor:
        """Return the sense of rotation (N, K, T') from u · (h × h') and the lengths of h, both (N, K, T')."""
        return turn * (turn.square() + TURN_EPSILON).pow(-0.25)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by their names in a weights dict."""
        return {f"vector.{name}": getattr(self, name) for name in ("weight", "mean", "var")}

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the weights as float32 arrays."""
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.tensors().items()}

    def import_weights(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Load the layer's part of a weights dict."""
        _copy(self.tensors(), weights)


def deviation(z: Tensor, step: int) -> Tensor:
    """Return the mean absolute deviation (N, F) of the means of each step of the pool (N, F, T)."""
    means = z.reshape(*z.shape[:2], -1, step).mean(dim=3)
    return (means - means.mean(dim=2, keepdim=True)).abs().mean(dim=2)


class Net(nn.Module):
    """A trainable network that computes logits (N, K) from scaled windows (N, C, T).

    The initial weights are drawn from PyTorch's global random state, so seed it first.
    """

    def __init__(self, arch: Arch) -> None:
        super().__init__()
        self.arch = arch
        self.vectors = None if arch.vector is None else VectorNet(arch.vector, arch)
        self.blocks = nn.ModuleList(_Block(arch, i) for i in range(len(arch.layers)))
        self.dense = nn.Linear(arch.features, arch.classes)

    def forward(self, x: Tensor) -> Tensor:
        """Return logits (N, K); only the last ``arch.span`` samples of each window are used."""
        check_windows(self.arch, tuple(x.shape))
        z = x[:, :, x.shape[2] - self.arch.span :]
        if self.vectors is not None:
            z = self.vectors(z)
        z = z.unsqueeze(2).contiguous(memory_format=FORMAT)
        for block in self.blocks:
            z = block(z)
        mean = z.mean(dim=(2, 3))
        if self.arch.pooling == "mean":
            return cast(Tensor, self.dense(mean))
        return cast(Tensor, self.dense(torch.cat([mean, deviation(z[:, :, 0], self.arch.step)], dim=1)))

    def _tensors(self) -> dict[str, Tensor]:
        """Return the tensors by their names in a weights dict; here a ``conv{i}.weight`` is (F, C, 1, K)."""
        named: dict[str, Tensor] = {"dense.weight": self.dense.weight, "dense.bias": self.dense.bias}
        if self.vectors is not None:
            named |= self.vectors.tensors()
        for i, module in enumerate(self.blocks):
            block = cast(_Block, module)
            named |= {f"conv{i}.weight": block.conv.weight, f"conv{i}.bias": cast(Tensor, block.conv.bias)}
            named |= {f"norm{i}.{name}": getattr(block, name) for name in NORM_TENSORS[self.arch.norm]}
        return {name: named[name] for name in self.arch.weight_shapes}

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the weights as float32 arrays, in the form of ``models.reference`` and of bundles."""
        shapes = self.arch.weight_shapes
        return {
            name: np.array(tensor.detach().cpu().numpy(), dtype=np.float32).reshape(shapes[name])
            for name, tensor in self._tensors().items()
        }

    def import_weights(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Load a weights dict; raise BundleError if it belongs to another architecture."""
        check_weights(self.arch, weights)
        _copy(self._tensors(), weights)


def _copy(tensors: Mapping[str, Tensor], weights: Mapping[str, NDArray[Any]]) -> None:
    with torch.no_grad():
        for name, tensor in tensors.items():
            values = torch.from_numpy(np.array(weights[name], dtype=np.float32))
            tensor.copy_(values.reshape(tensor.shape))
