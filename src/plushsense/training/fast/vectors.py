"""The vector layer with an explicit forward and backward pass, of which nothing but two matrix products is costly.

Values are (L, K, B, N): position in a block, kernel, block, window. A product with a band matrix (L · K, L + taps - 1;
wider with a stride) computes all kernels at L positions; windows come last, so that what follows runs over contiguous
memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from plushsense.models.arch import NORM_EPSILON
from plushsense.models.net import MOMENTUM, VectorNet
from plushsense.models.vectors import LENGTH_EPSILON, TURN_EPSILON
from plushsense.training.fast.plan import CHUNK

# Samples from the first to the last position of a block, about: the band matrix is sparser in longer ones.
_BLOCK = 32


@dataclass
class _Pass:
    """Values of the forward pass of one vector that the backward pass needs; vectors are (L, K, 3, B · N)."""

    taps: Tensor
    up: Tensor
    vertical: Tensor
    h: Tensor
    following: Tensor
    length: Tensor
    turn: Tensor


class FastVectors:
    """A trainable vector layer: `forward` and `backward` do what `VectorNet` and autograd do.

    Args:
        net: the layer, whose weights and running statistics are updated in place.
        samples: T, number of samples of a window.
        stride: samples between two positions that are computed.
    """

    def __init__(self, net: VectorNet, samples: int, stride: int = 1) -> None:
        layer = net.layer
        self.net, self.rows, self._stride = net, (samples - layer.reach - 1) // stride + 1, stride
        self._blocks = -(-self.rows * stride // _BLOCK)
        self._long = -(-self.rows // self._blocks)
        self._others = len(net.mean) - layer.vectors * layer.invariants
        self._held: list[tuple[list[_Pass], Tensor]] = []
        self._gain = torch.empty(0)

    @property
    def parameters(self) -> list[Tensor]:
        """The tensors that the optimizer updates."""
        return list(self.net.parameters())

    @torch.no_grad()
    def forward(self, x: Tensor) -> None:
        """Compute the outputs of a batch (N, C, T) and their statistics, and update the running ones."""
        self._held = [self._invariants(x[at : at + CHUNK]) for at in range(0, len(x), CHUNK)]
        count = len(x) * self.rows
        mean = _total([z for _, z in self._held]) / count
        for _, z in self._held:
            z -= mean
        var = _total([z * z for _, z in self._held]) / count
        self.net.mean.lerp_(mean, MOMENTUM)
        self.net.var.lerp_(var * (count / max(1, count - 1)), MOMENTUM)
        self._gain = (var + NORM_EPSILON).rsqrt()

    def fill(self, out: Tensor, start: int, end: int) -> None:
        """Write the standardized outputs of the windows [start, end) of the batch into ``out`` (T', n, M)."""
        torch.mul(self._held[start // CHUNK][1], self._gain, out=out)

    @torch.no_grad()
    def read(self, x: Tensor) -> Tensor:
        """Compute the outputs (T', n, M) of at most `CHUNK` windows (n, C, T) with the running statistics."""
        return (self._invariants(x)[1] - self.net.mean) * (self.net.var + NORM_EPSILON).rsqrt()

    @torch.no_grad()
    def backward(self, gradient: Tensor) -> None:
        """Set the gradient of the weights from that of the standardized outputs (T', N, M)."""
        count, parts = gradient.shape[0] * gradient.shape[1], torch.split(gradient, CHUNK, dim=1)
        # Mean and variance of the batch change with each output: by the same for all, and in proportion to it.
        level = self._gain * _total(parts) / -count
        products = [part * z for part, (_, z) in zip(parts, self._held, strict=True)]
        slope = self._gain.pow(3) * _total(products) / -count
        total = torch.zeros_like(self.net.weight)
        for part, (passes, z) in zip(parts, self._held, strict=True):
            dz = torch.addcmul(level, part, self._gain).addcmul_(z, slope)
            for number, held in enumerate(passes):
                total[number] += self._backward(held, dz[:, :, self._columns(number)])
        self.net.weight.grad = total

    def _columns(self, number: int) -> slice:
        """Return the outputs of a vector."""
        width = self.net.layer.invariants
        return slice(self._others + number * width, self._others + (number + 1) * width)

    def _invariants(self, x: Tensor) -> tuple[list[_Pass], Tensor]:
        """Return the values of each vector in windows (n, C, T), and the outputs (T', n, M), not standardized."""
        layer, n = self.net.layer, len(x)
        z = torch.empty(self.rows, n, len(self.net.mean))
        newest = x[:, :, layer.reach :: self._stride].permute(2, 0, 1)
        z[:, :, : self._others] = newest[:, :, : self._others]
        gravity = newest[:, :, -3:]
        up = gravity * (gravity.square().sum(2, keepdim=True) + LENGTH_EPSILON).rsqrt()
        up = self._blocked(up.permute(2, 0, 1), self._long, self._long)[:, None]
        passes = []
        for number, weight in enumerate(self.net.weight):
            first = self._others + 3 * number
            axes = x[:, first : first + 3].permute(1, 2, 0)
            taps = self._blocked(axes, self._reads, self._long * self._stride)
            held = _turned(taps, self._band(weight), up)
            sense = held.turn * (held.turn.square() + TURN_EPSILON).rsqrt_().sqrt_()
            for place, values in enumerate((held.vertical, held.length, sense)):
                at = self._columns(number).start + place * layer.filters
                z[:, :, at : at + layer.filters] = self._in_order(values, n)
            passes.append(held)
        return passes, z

    @property
    def _reads(self) -> int:
        """Number of samples that the positions of a block depend on."""
        return (self._long - 1) * self._stride + self.net.layer.kernel

    def _blocked(self, x: Tensor, reads: int, apart: int) -> Tensor:
        """Return rows (3, T, n) as blocks (``reads``, 3, B · n), one every ``apart`` rows; then zeros follow."""
        blocks, (axes, rows, n) = self._blocks, x.shape
        size = max(rows, (blocks - 1) * apart + reads)
        whole = torch.zeros(axes, size, n)
        whole[:, :rows] = x
        split = whole.as_strided((reads, axes, blocks, n), (n, size * n, apart * n, 1)).contiguous()
        return split.view(reads, axes, blocks * n)

    def _in_order(self, values: Tensor, n: int) -> Tensor:
        """Return values (L, K, B · n) in the order of time, (T', n, K)."""
        split = values.view(self._long, -1, self._blocks, n).permute(2, 0, 3, 1)
        return split.reshape(self._long * self._blocks, n, -1)[: self.rows]

    def _band(self, weight: Tensor) -> Tensor:
        """Return the matrix (L · K, reads) with a shifted copy of the weights (K, taps) for each position."""
        band = torch.zeros(self._long * len(weight), self._reads)
        self._diagonal(band, len(weight)).copy_(weight.expand(self._long, -1, -1))
        return band

    def _diagonal(self, band: Tensor, kernels: int) -> Tensor:
        """Return the view (L, K, taps) of what is not always zero in such a matrix."""
        wide = band.shape[1]
        return band.as_strided((self._long, kernels, self.net.layer.kernel), (kernels * wide + self._stride, wide, 1))

    def _backward(self, held: _Pass, dz: Tensor) -> Tensor:
        """Return the gradient of the weights (K, taps) of a vector from that of its outputs (T', n, 3 K)."""
        kernels, up = self.net.layer.filters, held.up
        n, shape = dz.shape[1], held.vertical.shape
        whole = torch.zeros(self._long * self._blocks, n, 3 * kernels)
        whole[: self.rows] = dz
        split = whole.view(self._blocks, self._long, n, 3, kernels).permute(3, 1, 4, 0, 2)
        dv, dn, dc = split.reshape(3, *shape)
        squared = held.turn.square() + TURN_EPSILON
        turned = dc.mul_(squared.rsqrt().sqrt_()).mul_((TURN_EPSILON / squared).add_(1.0)).mul_(0.5)
        along = dn.div_(held.length)
        # u · (h × h') changes by (h' × u) · dh and (u × h) · dh'.
        across = (turned[:, :, None] * held.h).roll(1, 1).addcmul_(turned[:, :, None], held.following, value=-1)
        upward = dv.addcmul_(along * held.vertical, 1.0 - up.square().sum(2), value=-1)
        d = along[:, :, None] * held.h
        d.addcmul_(upward[:, :, None], up)
        for axis in range(3):
            b, c = (axis + 1) % 3, (axis + 2) % 3
            d[:, :, axis].addcmul_(up[:, :, b], across[:, :, c]).addcmul_(up[:, :, c], across[:, :, b], value=-1)
        band = d.view(self._long * kernels, -1) @ held.taps.view(len(held.taps), -1).t()
        return self._diagonal(band, kernels).sum(0)


def _turned(taps: Tensor, band: Tensor, up: Tensor) -> _Pass:
    """Apply the kernels to ``taps`` (L + reach, 3, B · n), and relate the results to ``up`` (L, 1, 3, B · n)."""
    h = (band @ taps.view(len(taps), -1)).view(len(up), -1, *taps.shape[1:])
    vertical = h[:, :, 0] * up[:, :, 0]
    vertical.addcmul_(h[:, :, 1], up[:, :, 1]).addcmul_(h[:, :, 2], up[:, :, 2])
    h.addcmul_(vertical[:, :, None], up, value=-1)
    length = h[:, :, 0].square()
    length.addcmul_(h[:, :, 1], h[:, :, 1]).addcmul_(h[:, :, 2], h[:, :, 2]).add_(LENGTH_EPSILON).sqrt_()
    following = h.roll(-1, 1)
    turn = torch.zeros_like(length)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        crossed = (up[:, :, b] * h[:, :, c]).addcmul_(up[:, :, c], h[:, :, b], value=-1)
        turn.addcmul_(crossed, following[:, :, axis])
    return _Pass(taps, up, vertical, h, following, length, turn)


def _total(parts: Sequence[Tensor]) -> Tensor:
    """Return the sum (M,) of all rows of parts (T', n, M)."""
    return torch.stack([part.sum((0, 1)) for part in parts]).sum(0)
