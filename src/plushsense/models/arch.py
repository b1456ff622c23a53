"""Parse the symbol of a network (``14d1_39d2_41d4``), and count its parameters, operations and memory.

Layers are joined by ``_``; each is a kernel length, and ``d`` with a dilation (paper, section 3.6.2). A layer is
Conv1d → ReLU → normalisation; statistics over time and one dense layer follow the last one.

A first token ``v`` with a kernel length, as in ``v14_19d2_19d4``, is a vector layer (see `VectorLayer`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple, NoReturn, TypedDict, Unpack, cast, get_args

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArchError, check_known
from plushsense.core.toml import refuse_unknown

MAX_LAYERS = 4
MAX_NUMBER = 4096  # of a kernel, a dilation, a filter count: limits memory; far above any useful value


class Symbol(NamedTuple):
    """A parsed symbol: the kernel length of the vector layer, if there is one, and (kernel, dilation) of the others."""

    vector: int | None
    layers: tuple[tuple[int, int], ...]

    @property
    def filter_counts(self) -> int:
        """Number of filter counts that the network needs."""
        return len(self.layers) + (self.vector is not None)


_N = "[1-9][0-9]{0,3}"
_LAYER = f"{_N}(?:d{_N})?"
_SYMBOL = re.compile(f"(?:v({_N})_)?({_LAYER}(?:_{_LAYER}){{0,{MAX_LAYERS - 1}}})")
_LAYERS_BEGIN = f"(?:{_LAYER}_){{0,{MAX_LAYERS - 1}}}(?:{_N}(?:d(?:{_N})?)?)?"
_SYMBOL_BEGIN = re.compile(f"v(?:{_N}(?:_{_LAYERS_BEGIN})?)?|{_LAYERS_BEGIN}")
_SYMBOL_FORM = (
    f"accepted are up to {MAX_LAYERS} kernel lengths joined by '_', each with d and its dilation where it has one, as "
    f"in 14d1_39d2_41d4, and before them v and the kernel length of a vector layer; numbers are 1 to {MAX_NUMBER}"
)
_FILTERS_BEGIN = re.compile(f"(?: *{_N} *,)* *(?:{_N} *)?")


def parse_symbol(spec: str) -> Symbol:
    """Return the layers of a symbol.

    Raises:
        ArchError: with the symbol and a caret under the first invalid character.
    """
    found = _SYMBOL.fullmatch(spec)
    if found is None:
        fail(_SYMBOL_FORM, spec, _end(_SYMBOL_BEGIN, spec))
    layers = (layer.partition("d") for layer in found[2].split("_"))
    return Symbol(int(found[1]) if found[1] else None, tuple((int(k), int(d or 1)) for k, _, d in layers))


def _end(begin: re.Pattern[str], text: str) -> int:
    match = begin.match(text)
    return match.end() if match else 0


def symbol_at_rate(spec: str, rate_hz: float) -> str:
    """Return a symbol made for 100 Hz with kernels that last as long at another rate; itself from 67 to 150 Hz.

    Dilations follow the rate as far as whole numbers can; then kernels become shorter, never longer.
    """
    if 2 / 3 <= (factor := rate_hz / DEFAULT_RATE_HZ) <= 1.5:
        return spec
    return _scaled(spec, factor, 2)


def symbol_within(spec: str, samples: int) -> str:
    """Return a symbol with a receptive field of at most ``samples``, from 1: itself, or one with shorter layers.

    All layers are shortened by the same factor, the largest that fits. Those of one tap are then left out, but not all.
    """
    for factor in np.linspace(1.0, 0.0, 501).tolist():
        shorter = spec if factor == 1.0 else _scaled(spec, factor, 1)
        vector, layers = parse_symbol(shorter)
        if (vector or 1) + sum((kernel - 1) * dilation for kernel, dilation in layers) <= samples:
            break
    return shorter


def _scaled(spec: str, factor: float, shortest: int) -> str:
    """Return a symbol whose layers reach ``factor`` times as far, with kernels of at least ``shortest``."""
    symbol = parse_symbol(spec)

    def scaled(kernel: int, dilation: int) -> tuple[int, int]:
        spacing = max(1, round(dilation * factor))
        return max(shortest, min(kernel, 1 + round((kernel - 1) * dilation * factor / spacing))), spacing

    layers = [scaled(*layer) for layer in symbol.layers]
    if shortest == 1:
        layers = [layer for layer in layers if layer[0] > 1] or layers[-1:]
    vector = [] if symbol.vector is None else [f"{VECTOR}{scaled(symbol.vector, 1)[0]}"]
    return "_".join([*vector, *(f"{kernel}d{dilation}" for kernel, dilation in layers)])


def parse_filters(text: str) -> tuple[int, ...]:
    """Return the filter counts of ``"8,12,16"`` or, as `slashed` writes them, ``"8/12/16"``.

    Raises:
        ArchError: for anything but whole numbers from 1.
    """
    if not re.fullmatch(f" *{_N} *(?:[,/] *{_N} *)*", text):
        fail("write counts joined by commas, as in 8,12,16", text, _end(_FILTERS_BEGIN, text), symbol=False)
    return tuple(map(int, re.split("[,/]", text)))


def slashed(filters: Iterable[int]) -> str:
    """Return filter counts joined by slashes: ``8/12/16``."""
    return "/".join(map(str, filters))


def fail(why: str, text: str, at: int, symbol: bool = True) -> NoReturn:
    """Raise ArchError with the reason; its note is the text, with a caret under position ``at``."""
    shown = "".join(c if c.isprintable() else "?" for c in text)
    kind = "Architecture" if symbol else "Filters"
    error = ArchError(f"{kind} '{shown}', place {at + 1}: {why}.")
    error.add_note(f"    {shown}\n    {' ' * at}^")
    raise error


Padding = Literal["stream", "causal", "mirror"]
Norm = Literal["batch", "layer", "none"]
Pooling = Literal["mean", "mean+deviation"]
PADDINGS: tuple[str, ...] = get_args(Padding)
NORMS: tuple[str, ...] = get_args(Norm)
POOLINGS: tuple[str, ...] = get_args(Pooling)

NORM_TENSORS: dict[Norm, tuple[str, ...]] = {
    "batch": ("gain", "shift", "mean", "var"),
    "layer": ("gain", "shift"),
    "none": (),
}
"""Names of the tensors of each normalisation: the paper has batch, the authors' training script layer, and their live
network none.
"""
NORM_EPSILON = 1e-5
DEFAULT_SYMBOL = "14d1_19d2_19d4"  # at DEFAULT_RATE_HZ
DEFAULT_RATE_HZ = 100.0
DEFAULT_FILTERS = (8, 12, 16)
VECTOR = "v"  # before the kernel length of a vector layer
VECTOR_SYMBOL = "v14_17d2_19d4"
VECTOR_FILTERS = (6, 16, 16)
_FEWEST_STEPS = 10  # of a pool whose deviation is read by default: half a second

PAPER_FILTERS: tuple[tuple[int, ...], ...] = (
    (4, 6, 8, 8),
    (8, 12, 16, 16),
    (16, 24, 32, 32),
    (32, 48, 64, 64),
)

# Paper, Table 3, as printed; columns in the order of PAPER_FILTERS (the paper has them from large to small).
TABLE3: dict[str, tuple[str, str, str, str]] = {
    "250": ("11.2k", "22.4k", "44.8k", "90k"),
    "126d2": ("5.7k", "11.4k", "22.9k", "46k"),
    "100_151": ("8.2k", "23.6k", "76.3k", "169k"),
    "83d1_84d2": ("5.8k", "15.7k", "47.6k", "160k"),
    "1d1_126d2": ("3.2k", "12.5k", "49.3k", "195k"),
    "70_90_91": ("9.8k", "32.6k", "117.5k", "444k"),
    "14d1_39d2_41d4": ("3.7k", "13.2k", "49.7k", "192k"),
    "28d1_32d2_41d4": ("4.1k", "13.8k", "49.5k", "186k"),
    "20d2_16d4_20d8": ("2.4k", "7.5k", "25.8k", "95k"),
    "19d1_24d3_19d9": ("2.5k", "8k", "27.9k", "103k"),
    "1d1_84d3_1d1": ("2.3k", "8.7k", "34k", "134k"),
    "1d1_27d3_20d9": ("1.8k", "6.9k", "26.7k", "105k"),
    "19d1_19d2_19d4_17d8": ("3.4k", "11.8k", "43.4k", "165k"),
}
PAPER_ARCHITECTURES: tuple[str, ...] = tuple(TABLE3)
# A misprint in the paper: this network has 268 258 parameters, not 169k.
TABLE3_MISPRINT = ("100_151", (32, 48))


@dataclass(frozen=True)
class ConvLayer:
    """Convolution layer: ``filters`` kernels of ``kernel`` taps, ``dilation`` samples apart."""

    kernel: int
    dilation: int
    filters: int

    @property
    def reach(self) -> int:
        """Number of samples before the current one that the layer reads: (kernel − 1) · dilation."""
        return (self.kernel - 1) * self.dilation


@dataclass(frozen=True)
class VectorLayer:
    """First layer for the axes of vectors, such as those of an accelerometer, that turn with the toy.

    The last inputs of the network are the axes (x, y, z) of each of the ``vectors``, then gravity. ``filters`` kernels
    of ``kernel`` taps are the same for all axes of a vector, so that each gives a vector d (Vector Neurons, Deng et al.
    2021, 10.1109/ICCV48922.2021.01198). With the unit vector u of gravity, the outputs do not depend on how the toy is
    held:

    - v = u · d, the vertical part,
    - n = |d − v u|, the length of the horizontal part h,
    - c = ±√|u · (h × h')|, the sense of rotation from h to h', that of the next kernel (after the last, the first).

    The outputs are the other inputs at the newest sample, then for each vector all v, all n and all c; they are then
    standardized, with running means and variances and no gain.
    """

    kernel: int
    filters: int
    vectors: int

    @property
    def reach(self) -> int:
        """Number of samples before the current one that the layer reads."""
        return self.kernel - 1

    @property
    def axes(self) -> int:
        """Number of inputs that are axes, including those of gravity."""
        return 3 * self.vectors + 3

    @property
    def invariants(self) -> int:
        """Number of outputs for each vector."""
        return 3 * self.filters

    @property
    def macs(self) -> int:
        """Multiply-accumulates of the kernels at one position."""
        return 3 * self.vectors * self.filters * self.kernel


class ArchSettings(TypedDict, total=False):
    """The settings of `Arch` that have a default and are no layers."""

    channels: int
    classes: int
    padding: str
    norm: str
    window: int
    step: int
    pool: int | None
    pooling: str | None


@dataclass(frozen=True)
class Arch:
    """The structure of a network, without its weights.

    ``window`` and ``step`` are in samples. ``pool`` is the number of positions that the mean is taken over, only for
    the padding ``stream``. By default it is the largest multiple of ``step`` with which the span fits into the window,
    or, if the receptive field is too long for that, the window rounded down to a multiple of ``step``.

    ``pooling`` names the statistics over the pool that the dense layer reads: ``mean``, or ``mean+deviation``, the mean
    of each filter and then the mean absolute deviation of its means of each step, only for the padding ``stream``.
    """

    layers: tuple[ConvLayer, ...]
    channels: int = 11
    classes: int = 18
    padding: Padding = "stream"
    norm: Norm = "batch"
    window: int = 250
    step: int = 5
    pool: int | None = None
    vector: VectorLayer | None = None
    pooling: Pooling = "mean"

    def __post_init__(self) -> None:
        if not self.layers or len(self.layers) > MAX_LAYERS:
            raise ArchError(f"A network has 1 to {MAX_LAYERS} layers, not {len(self.layers)}: change the architecture.")
        for n, layer in enumerate(self.layers, 1):
            _in_range(f"the kernel of layer {n}", layer.kernel, 1, MAX_NUMBER)
            _in_range(f"the dilation of layer {n}", layer.dilation, 1, MAX_NUMBER)
            _in_range(f"the filter count of layer {n}", layer.filters, 1, MAX_NUMBER)
        check_known(self.padding, PADDINGS, "padding", ArchError)
        check_known(self.norm, NORMS, "norm", ArchError)
        check_known(self.pooling, POOLINGS, "pooling", ArchError)
        _in_range("channels", self.channels, 1, MAX_NUMBER)
        if self.vector is not None:
            self._check_vector(self.vector)
        _in_range("classes", self.classes, 2, MAX_NUMBER)
        _in_range("window", self.window, 2, 1_000_000)
        _in_range("step", self.step, 1, self.window, " (the window)")
        if self.padding != "stream":
            if self.pooling != "mean":
                raise ArchError(
                    f"The pooling '{self.pooling}' needs the padding 'stream', not '{self.padding}': change the "
                    "padding, or use the pooling 'mean'."
                )
            if self.pool is not None:
                raise ArchError(
                    f"pool belongs to the padding 'stream'; under '{self.padding}' the mean runs over the "
                    "whole window: leave pool out."
                )
        elif self.pool is None:
            free = self.window - self.receptive_field + 1
            object.__setattr__(self, "pool", (free if free >= self.step else self.window) // self.step * self.step)
        else:
            _in_range("pool", self.pool, self.step, 1_000_000)
            if self.pool % self.step:
                below = self.pool // self.step * self.step
                raise ArchError(
                    f"pool is {self.pool}, which the step of {self.step} samples does not divide: "
                    f"give {below} or {below + self.step}."
                )

    def _check_vector(self, vector: VectorLayer) -> None:
        _in_range("the kernel of the vector layer", vector.kernel, 1, MAX_NUMBER)
        _in_range("the filter count of the vector layer", vector.filters, 2, 64)
        _in_range("the number of vectors", vector.vectors, 1, 8)
        if self.padding != "stream":
            raise ArchError(f"A vector layer needs the padding 'stream', not '{self.padding}': change the padding.")
        if self.channels < vector.axes:
            raise ArchError(
                f"A vector layer for {vector.vectors} vectors reads {vector.axes} axes, with those of gravity, but "
                f"there are {self.channels} channels: give the inputs of a layout with vectors."
            )

    @classmethod
    def parse(
        cls, spec: str, filters: str | Sequence[int], *, vectors: int = 1, **settings: Unpack[ArchSettings]
    ) -> Arch:
        """Build a network from its symbol and its filter counts (``(8, 12)`` or ``"8,12"``; extra ones are ignored).

        ``vectors`` is their number, besides gravity, for a symbol with a vector layer; ``settings`` are the others. The
        pooling is by default that of `default_pooling`.

        Raises:
            ArchError: for an invalid symbol (with a caret under the character) or setting.
        """
        shape = parse_symbol(spec)
        counts = (
            parse_filters(filters)
            if isinstance(filters, str)
            else tuple(int(f) if isinstance(f, np.integer) else f for f in filters)
        )
        if len(counts) < shape.filter_counts:
            given = ",".join(str(f) for f in counts) or "nothing"
            example = ",".join(str(f) for f in (*PAPER_FILTERS[1], 16)[: shape.filter_counts])
            fail(
                f"{shape.filter_counts} layers but only {len(counts)} filter counts ({given}): "
                f"give one count a layer, for example {example}",
                spec,
                sum(len(part) + 1 for part in spec.split("_")[: len(counts)]),
            )
        vector = None
        if shape.vector is not None:
            vector, counts = VectorLayer(shape.vector, counts[0], vectors), counts[1:]
        layers = tuple(ConvLayer(k, d, f) for (k, d), f in zip(shape.layers, counts, strict=False))
        pooling = settings.pop("pooling", None)
        arch = cls(layers, vector=vector, **cast(Any, settings))
        return replace(arch, pooling=cast(Any, pooling or default_pooling(arch)))

    @property
    def symbol(self) -> str:
        """The symbol as the paper writes it: with dilations if any of them is not 1."""
        dilated = any(layer.dilation > 1 for layer in self.layers)
        first = [] if self.vector is None else [f"{VECTOR}{self.vector.kernel}"]
        return "_".join(
            first + [f"{layer.kernel}d{layer.dilation}" if dilated else f"{layer.kernel}" for layer in self.layers]
        )

    @property
    def title(self) -> str:
        """Symbol and filters: ``14d1_39d2_41d4 8/12/16``."""
        return f"{self.symbol} {slashed(self.filters)}"

    @property
    def filters(self) -> tuple[int, ...]:
        """Filter count of each layer, beginning with the vector layer if there is one."""
        first = [] if self.vector is None else [self.vector.filters]
        return (*first, *(layer.filters for layer in self.layers))

    @property
    def inputs(self) -> tuple[int, ...]:
        """Number of input channels of each convolution layer."""
        first = self.channels
        if self.vector is not None:
            first += self.vector.vectors * self.vector.invariants - self.vector.axes
        return (first, *(layer.filters for layer in self.layers[:-1]))

    @property
    def features(self) -> int:
        """Number of inputs of the dense layer."""
        return self.layers[-1].filters * (2 if self.pooling == "mean+deviation" else 1)

    @property
    def trunk(self) -> Arch:
        """The network after its vector layer; the network itself if it has none."""
        return self if self.vector is None else replace(self, channels=self.inputs[0], vector=None)

    @property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each tensor of the network by name; a dict of weights has exactly these keys."""
        shapes: dict[str, tuple[int, ...]] = {}
        if self.vector is not None:
            shapes["vector.weight"] = (self.vector.vectors, self.vector.filters, self.vector.kernel)
            shapes["vector.mean"] = shapes["vector.var"] = (self.inputs[0],)
        for i, (layer, read) in enumerate(zip(self.layers, self.inputs, strict=True)):
            shapes[f"conv{i}.weight"] = (layer.filters, read, layer.kernel)
            shapes[f"conv{i}.bias"] = (layer.filters,)
            for name in NORM_TENSORS[self.norm]:
                shapes[f"norm{i}.{name}"] = (layer.filters,)
        shapes["dense.weight"] = (self.classes, self.features)
        shapes["dense.bias"] = (self.classes,)
        return shapes

    @property
    def parameters(self) -> int:
        """Number of learnable parameters, as in the paper's Table 3: without running means and variances."""
        learnt = (s for name, s in self.weight_shapes.items() if not name.endswith((".mean", ".var")))
        return sum(int(np.prod(shape)) for shape in learnt)

    @property
    def receptive_field(self) -> int:
        """Number of samples that one position of the last layer depends on."""
        first = 0 if self.vector is None else self.vector.reach
        return 1 + first + sum(layer.reach for layer in self.layers)

    @property
    def pooled(self) -> int:
        """Number of positions of the last layer that the mean is taken over."""
        return self.window if self.pool is None else self.pool

    @property
    def blocks(self) -> int:
        """Number of whole steps in the pool."""
        return self.pooled // self.step

    @property
    def span(self) -> int:
        """Number of samples that a decision depends on: with ``stream`` receptive field + pool − 1, else the window."""
        return self.window if self.pool is None else self.receptive_field + self.pool - 1

    @property
    def positions(self) -> tuple[int, ...]:
        """Number of positions that each convolution layer computes for one decision from ``span`` samples."""
        if self.padding != "stream":
            return (self.window,) * len(self.layers)
        after, left = [], self.trunk.span
        for layer in self.layers:
            left -= layer.reach
            after.append(left)
        return tuple(after)

    @property
    def macs_per_position(self) -> tuple[int, ...]:
        """Multiply-accumulates of each convolution layer at one position (without others, as the paper counts)."""
        return tuple(k.kernel * read * k.filters for k, read in zip(self.layers, self.inputs, strict=True))

    @property
    def macs_per_sample(self) -> int:
        """Multiply-accumulates for one new sample when the network runs sample by sample."""
        first = 0 if self.vector is None else self.vector.macs
        return first + sum(self.macs_per_position)

    @property
    def macs_per_window(self) -> int:
        """Multiply-accumulates of one decision from a whole window (``stream``: from ``span`` samples)."""
        first = 0 if self.vector is None else self.vector.macs * self.trunk.span
        return first + sum(m * n for m, n in zip(self.macs_per_position, self.positions, strict=True))

    @property
    def macs_per_step(self) -> int:
        """Multiply-accumulates for each decision: with ``stream`` of the new samples only, else of the whole window."""
        return self.step * self.macs_per_sample if self.padding == "stream" else self.macs_per_window

    @property
    def state_bytes_int8(self) -> int:
        """Bytes of state that the network keeps between samples with 8-bit activations.

        ``stream``: a ring buffer of reach + 1 samples before each layer, and pool / step block sums of 16 bits for
        each filter; before a vector layer, a ring buffer of its axes with 16 bits. Otherwise a ring buffer of the
        window, from which all activations are computed again.
        `plushsense.runtime.image.memory_bytes` gives all memory of a toy: also padding of the buffers to a multiple of
        4, the clock, sums and probabilities.
        """
        if self.pool is None:
            return self.window * self.channels
        rings = sum((layer.reach + 1) * read for layer, read in zip(self.layers, self.inputs, strict=True))
        axes = 0 if self.vector is None else 2 * 3 * self.vector.vectors * self.vector.kernel
        return axes + rings + 2 * self.layers[-1].filters * self.blocks

    @property
    def table3(self) -> str | None:
        """Parameter count of this network in the paper's Table 3 ("13.2k"); None if it is not in the table."""
        if (self.channels, self.classes) != (11, 18):
            return None
        for row, spec in enumerate(PAPER_FILTERS):
            if self.symbol in TABLE3 and spec[: len(self.layers)] == self.filters:
                return TABLE3[self.symbol][row]
        return None

    def to_dict(self) -> dict[str, object]:
        """Return plain values, ready for JSON; the layers as their symbol."""
        apart = ("layers", "vector", "pooling")
        others = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in apart}
        vectors = {} if self.vector is None else {"vectors": self.vector.vectors}
        # Left out for the mean, as in bundles from before there was another.
        pooling = {} if self.pooling == "mean" else {"pooling": self.pooling}
        return {"symbol": self.symbol, "filters": list(self.filters), **others, **vectors, **pooling}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Arch:
        """Build the network that ``to_dict`` described; raise ArchError for a missing, unknown or invalid key."""
        settings = ("channels", "classes", "padding", "norm", "window", "step", "pool", "vectors", "pooling")
        known = ("symbol", "filters", *settings)
        refuse_unknown(table, known, "an architecture", ArchError)
        missing = [key for key in known[:2] if key not in table]
        if missing:
            raise ArchError(f"An architecture lacks the key '{missing[0]}': add it.")
        spec, filters = table["symbol"], table["filters"]
        if not isinstance(spec, str) or not isinstance(filters, str | Sequence):
            raise ArchError("An architecture needs its symbol as text and its filters as a list of whole numbers.")
        return cls.parse(spec, filters, **{"pooling": "mean"} | {k: v for k, v in table.items() if k in settings})


def default_pooling(arch: Arch) -> Pooling:
    """Return the pooling for a network where none is given: ``mean+deviation`` with a vector layer, else ``mean``.

    With a vector layer, the deviation reads people left out better (docs/measurements/people.md), but for a pool of few
    steps. Without one it was not measured on real recordings, and networks have the mean alone, as in the paper.
    """
    return "mean+deviation" if arch.vector is not None and arch.blocks >= _FEWEST_STEPS else "mean"


def reflected(length: int, left: int) -> NDArray[np.intp]:
    """Return the indices (left + length,) that extend ``length`` samples by ``left`` mirrored ones.

    The edge sample is not repeated; if there are too few samples they are reflected repeatedly, like
    ``numpy.pad`` with mode ``reflect``.
    """
    folded = np.abs(np.arange(-left, length)) % (2 * (length - 1))
    return np.asarray(np.minimum(folded, 2 * (length - 1) - folded), dtype=np.intp)


def _in_range(name: str, value: object, low: int, high: int, of_high: str = "") -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise ArchError(f"{name} is {value!r}: accepted are whole numbers from {low} to {high}{of_high}.")
