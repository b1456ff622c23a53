"""Choose the convolution method of each layer from its shape alone, so that every machine makes the same choice.

Activations are (T, N, C), time first. A dilated layer then needs no copy: row q · d + p is row q of phase p, and the
phases are a further batch dimension.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from plushsense.models.arch import Arch
from plushsense.training.fast.transform import Lengths, lengths_for

Way = Literal["pointwise", "direct", "spectral"]

# Windows computed at a time: large enough for full matrix products, small enough for the caches.
CHUNK = 64

# Largest size of the spectra that are kept for the backward pass; the others are computed again.
SPECTRA_BYTES = 1 << 30

_FLOAT_BYTES = 4

# A matrix product over fewer channels than this is no faster.
_NARROW = 16


@dataclass(frozen=True)
class LayerPlan:
    """Method and sizes of a layer: ``before`` input rows after ``front`` mirrored ones, ``after`` output rows.

    It reads ``needs`` rows (zeros beyond the input) and writes ``writes`` rows (undefined beyond ``after``).
    """

    way: Way
    taps: int
    dilation: int
    reads: int
    filters: int
    front: int
    before: int
    after: int
    lengths: Lengths | None = None

    @property
    def _steps(self) -> int:
        """Number of output positions of one phase."""
        return -(-self.after // self.dilation)

    @property
    def rows(self) -> int:
        """Number of rows of the last stage of a spectral layer."""
        assert self.lengths is not None
        return -(-self._steps // self.lengths.short)

    @property
    def needs(self) -> int:
        """Number of input rows read."""
        return self.front + self.before if self.lengths is None else self.lengths.samples * self.dilation

    @property
    def writes(self) -> int:
        """Number of output rows written."""
        return self.after if self.lengths is None else self.rows * self.lengths.short * self.dilation

    @property
    def spectra_floats(self) -> int:
        """Size of the transform of one window's input, in floats."""
        return 0 if self.lengths is None else self.lengths.planes * self.dilation * self.reads

    @property
    def macs(self) -> int:
        """Multiplications of the forward pass of one window with the chosen method."""
        if self.lengths is None:
            return self.taps * self.after * self.reads * self.filters
        return _spectral_macs(self.lengths, self.dilation, self.reads, self.filters)


@dataclass(frozen=True)
class NetPlan:
    """Plans of all layers, and whether each keeps its spectra from the forward to the backward pass."""

    layers: tuple[LayerPlan, ...]
    keeps: tuple[bool, ...]
    batch: int

    @property
    def buffers(self) -> tuple[int, ...]:
        """Number of rows of each layer's input buffer, and of the last layer's output."""
        rows, written = [], self.layers[0].before
        for layer in self.layers:
            rows.append(max(layer.needs, layer.front + written))
            written = layer.writes
        return (*rows, written)

    @property
    def bytes(self) -> int:
        """Memory of a training step without the data: activations, gradients, spectra and the scratch of one thread."""
        windows, chunk = self.batch, min(self.batch, CHUNK)
        widths = (*(layer.reads for layer in self.layers), self.layers[-1].filters)
        kept = sum(r * w for r, w in zip(self.buffers, widths, strict=True)) * windows
        gradients = max(layer.needs * layer.reads for layer in self.layers) * windows
        spectra = sum(layer.spectra_floats for layer, keep in zip(self.layers, self.keeps, strict=True) if keep)
        scratch = max(
            (layer.spectra_floats + 3 * max(layer.needs, layer.writes) * max(layer.reads, layer.filters)) * chunk
            for layer in self.layers
        )
        return _FLOAT_BYTES * (kept + gradients + spectra * windows + scratch)


def plan_layer(taps: int, dilation: int, reads: int, filters: int, front: int, before: int) -> LayerPlan:
    """Choose the method of one layer with ``front`` mirrored rows before its ``before`` input rows."""
    reach = (taps - 1) * dilation
    after = before + front - reach
    if taps == 1:
        return LayerPlan("pointwise", 1, 1, reads, filters, front, before, after)
    lengths = lengths_for(-(-after // dilation) + taps - 1)
    direct = taps * after * max(reads, _NARROW) * max(filters, _NARROW)
    if direct <= _spectral_macs(lengths, dilation, max(reads, _NARROW), max(filters, _NARROW)):
        return LayerPlan("direct", taps, dilation, reads, filters, front, before, after)
    return LayerPlan("spectral", taps, dilation, reads, filters, front, before, after, lengths)


def plan_net(arch: Arch, batch: int) -> NetPlan:
    """Choose the methods of all layers for batches of at most ``batch`` windows."""
    layers, before = [], arch.span
    for layer, reads in zip(arch.layers, arch.inputs, strict=True):
        front = layer.reach if arch.padding == "mirror" else 0
        layers.append(plan_layer(layer.kernel, layer.dilation, reads, layer.filters, front, before))
        before = layers[-1].after
    left, keeps = SPECTRA_BYTES // _FLOAT_BYTES, []
    for planned in layers:
        keeps.append(planned.spectra_floats * batch <= left)
        left -= planned.spectra_floats * batch if keeps[-1] else 0
    return NetPlan(tuple(layers), tuple(keeps), batch)


def _spectral_macs(lengths: Lengths, dilation: int, reads: int, filters: int) -> int:
    transforms = lengths.macs * (reads + filters)
    return dilation * (transforms + lengths.planes * reads * filters)
