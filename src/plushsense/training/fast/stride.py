"""A training step at every n-th position of a pool only, since neighbouring positions hold almost the same.

A layer of dilation d reads every d-th row. Where n divides the dilations of all layers but the first, no layer computes
the rows between: each becomes a convolution with dilation d / n on an n-th of the rows. The first layer reads every
gcd(n, d)-th row of the inputs; if it still has to skip positions, its rows hold several of these side by side as
channels, and its kernel is as many times shorter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import gcd

from plushsense.models.arch import Arch, ConvLayer


@dataclass(frozen=True)
class Stride:
    """Every ``inputs``-th input row is read, of which ``phases`` become one row of the first layer."""

    inputs: int = 1
    phases: int = 1

    @property
    def samples(self) -> int:
        """Samples between two positions of the pool that are computed, and the number of samples to begin at."""
        return self.inputs * self.phases

    def applied(self, arch: Arch) -> Arch:
        """Return the convolutions of an architecture, its trunk, on the rows of the first layer."""
        trunk, n = arch.trunk, self.samples
        if n == 1:
            return trunk
        first, *later = trunk.layers
        dilation = 1 if self.phases > 1 else max(1, first.dilation // n)
        layers = (
            ConvLayer(-(-first.kernel // self.phases), dilation, first.filters),
            *(replace(layer, dilation=max(1, layer.dilation // n)) for layer in later),
        )
        channels = trunk.channels * self.phases
        made = replace(trunk, layers=layers, channels=channels, step=1, pool=trunk.pooled // n)
        # Rows beyond the last position are read where the kernel is no multiple of the phases.
        return made if self._last(made) + n <= trunk.span else replace(made, pool=made.pooled - 1)

    def covers(self, arch: Arch) -> int:
        """Return the number of rows of the trunk of ``arch`` from the first to the last that is read."""
        return self._last(self.applied(arch)) + 1

    def _last(self, made: Arch) -> int:
        return self.inputs * (made.span * self.phases - 1)


def stride_for(arch: Arch, most: int) -> Stride:
    """Return the longest stride of at most ``most`` samples that the layers of a network allow."""
    if arch.padding != "stream":
        return Stride()
    # The dilation of a kernel of one tap is that of any other.
    first, *later = (layer.dilation if layer.kernel > 1 else 0 for layer in arch.layers)
    for n in range(min(most, arch.pooled // 2), 1, -1):
        inputs = gcd(n, first)
        if all(dilation % n == 0 for dilation in later) and inputs in (n, first):
            return Stride(inputs, n // inputs)
    return Stride()
