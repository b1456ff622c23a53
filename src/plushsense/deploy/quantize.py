"""Quantization of a trained network: folded batch normalisation, 8-bit weights and activations, fixed-point scales.

Folding is exact, also where a layer reads reflected samples: each normalisation moves into the weights of the next
layer, the last one into those of the dense layer. `calibrate` measures the 8-bit ranges of inputs and activations, on
windows of the training people only.

Two measures reduce the error of the rounded weights, the largest one, at no cost in the toy: the rounding error of each
tap is carried to the next (`plushsense.runtime.integer.rounded_weights`), and the bias of each layer compensates the
mean error that remains, which is computed from the mean input. On makeability's held-out people the error of the logits
falls from 2.0–4.3 % of their spread (bias alone, no headroom of the ranges) to 0.8–1.6 %.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArchError, BundleError
from plushsense.models.arch import NORM_EPSILON, Arch, VectorLayer
from plushsense.models.bundle import Bundle
from plushsense.models.reference import Network, affine, step_sums
from plushsense.runtime.classifier import BothEngines, IntegerClassifier, StreamClassifier, StreamReader
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.fixed import (
    PROBABILITY_BITS,
    InputScale,
    LogitScale,
    Requantize,
    smoothing_weight,
    softmax,
    split_ratio,
)
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.integer import (
    AXIS_LIMIT,
    MOST_AXIS_SHIFT,
    MOST_REACH,
    IntegerDense,
    IntegerLayer,
    IntegerNetwork,
    IntegerVectors,
    deployable,
    down_for,
    rounded_weights,
)
from plushsense.windows.features import Scaler

Floats = NDArray[np.float64]

# Part of the key of stored results: increase it when the same windows and weights give other integers.
QUANTIZE_VERSION = 2

_BATCH = 16  # windows

# Share of the training values outside the ranges. For new people it is larger, and clipping costs more than coarser
# steps. Chosen on 5 of makeability's 27 folds, by the smallest change of the outputs (Kullback-Leibler, 5e-4).
_INPUTS_OUTSIDE = 1e-4
_OUTSIDE = 1e-5
# What the ranges of activations leave for new people. Chosen on makeability's training people, with the ranges of one
# half and the windows of the other.
_HEADROOM = 1.25


@dataclass(frozen=True, eq=False)
class Ranges:
    """Value ranges of a network: scaled inputs ``low`` to ``high`` (C,), activations of each layer 0 to ``tops`` (F,).

    Activations are before normalisation; ``means`` holds the means of the inputs (C,), then of each layer (F,). With a
    vector layer, the inputs are its outputs; ``axes`` (V,) holds the largest scaled value of an axis of each vector.
    ``deviation`` (F,), with the pooling ``mean+deviation``, holds the mean of that statistic of the last layer.
    """

    low: Floats
    high: Floats
    tops: tuple[Floats, ...]
    means: tuple[Floats, ...]
    axes: Floats
    deviation: Floats = field(default_factory=lambda: np.empty(0))

    def to_dict(self) -> dict[str, object]:
        """Return the ranges as plain values for JSON."""
        lists = {name: [part.tolist() for part in getattr(self, name)] for name in ("tops", "means")}
        others = {name: getattr(self, name).tolist() for name in ("axes", "deviation") if len(getattr(self, name))}
        return {"low": self.low.tolist(), "high": self.high.tolist(), **lists, **others}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Ranges:
        """Read ranges from plain values.

        Raises:
            BundleError: for a missing key or values that are no numbers.
        """
        try:
            low, high = (np.asarray(table[name], dtype=np.float64) for name in ("low", "high"))
            tops, means = (tuple(np.asarray(t, dtype=np.float64) for t in table[name]) for name in ("tops", "means"))
            axes, deviation = (np.asarray(table.get(name, ()), dtype=np.float64) for name in ("axes", "deviation"))
            return cls(low, high, tops, means, axes, deviation)
        except KeyError as missing:
            raise BundleError(
                f"The calibration in the bundle lacks {missing} (it was made by an earlier PlushSense): train it "
                "again, or give the data set that it was trained on, with plushsense export BUNDLE OUT --dataset DS."
            ) from None
        except (TypeError, ValueError, OverflowError) as cause:
            raise BundleError(f"The calibration in the bundle cannot be read ({cause}): train again.") from None

    def check(self, arch: Arch) -> None:
        """Raise BundleError if the ranges do not fit the network ``arch``."""
        inputs, filters = arch.inputs[0], arch.trunk.filters
        needed = [inputs, inputs, *filters, inputs, *filters, 0 if arch.vector is None else arch.vector.vectors]
        needed.append(arch.features - filters[-1])
        parts = [self.low, self.high, *self.tops, *self.means, self.axes, self.deviation]
        if [p.shape for p in parts] != [(n,) for n in needed] or not all(np.isfinite(p).all() for p in parts):
            raise BundleError(f"The calibration is not that of {arch.title}, or holds no numbers: train again.")


def calibrate(network: Network, x: NDArray[np.floating[Any]]) -> Ranges:
    """Measure the ranges of scaled training windows (N, C, T) in every layer of the network."""
    axes, first, inner = np.empty(0), np.asarray(x), None
    if network.vectors is not None:
        layer = network.vectors.layer
        vectors = x[:, x.shape[1] - layer.axes : -3].reshape(len(x), layer.vectors, 3, -1)
        axes = np.abs(vectors).max(axis=(0, 2, 3)).astype(np.float64)
        inner = np.concatenate([network.convolved(x[at : at + _BATCH]) for at in range(0, len(x), _BATCH)])
        first = inner.transpose(0, 2, 1)
    low, high = np.quantile(first, [_INPUTS_OUTSIDE, 1 - _INPUTS_OUTSIDE], axis=(0, 2))
    activations: list[list[Floats]] = [[] for _ in network.blocks]
    deviations: list[Floats] = []
    for at in range(0, len(x), _BATCH):
        part = network.convolved(x[at : at + _BATCH]) if inner is None else inner[at : at + _BATCH]
        for values, z in zip(activations, network.rectified(part), strict=True):
            values.append(z.reshape(-1, z.shape[2]))
        if network.arch.pooling != "mean":
            deviations.append(network.pooled(step_sums(z, network.arch))[:, z.shape[2] :])
    rows = [np.concatenate(values) for values in activations]
    tops = tuple(_HEADROOM * np.quantile(row, 1 - _OUTSIDE, axis=0) for row in rows)
    inputs = np.asarray(first.mean(axis=(0, 2), dtype=np.float64))
    deviation = np.concatenate(deviations).mean(axis=0) if deviations else np.empty(0)
    return Ranges(low, high, tops, (inputs, *(row.mean(axis=0) for row in rows)), axes, deviation)


def refuse_undeployable(arch: Arch) -> None:
    """Raise ArchError for a network that cannot run in integers, with the reason and the option to train it with."""
    if arch.padding == "causal":
        raise ArchError(
            "{arch} has the padding '{padding}', whose zeros cannot be folded with the normalisation: train {symbol} "
            "with --padding stream.",
            arch=arch.title,
            padding=arch.padding,
            symbol=arch.symbol,
        )
    if arch.norm == "layer":
        raise ArchError(
            "{arch} has {norm} normalisation, which cannot be folded into a convolution: train {symbol} with --norm "
            "batch or none.",
            arch=arch.title,
            norm=arch.norm,
            symbol=arch.symbol,
        )


def quantize(arch: Arch, weights: Mapping[str, NDArray[Any]], scaler: Scaler, ranges: Ranges) -> IntegerNetwork:
    """Quantize the network.

    Raises:
        ArchError: for a network that cannot be deployed.
        BundleError: for ranges of another network, or sums beyond 32 bits.
    """
    refuse_undeployable(arch)
    ranges.check(arch)
    span = np.maximum(ranges.high - ranges.low, 1e-6)
    unit, start, mean = span / 255, ranges.low, ranges.means[0]
    layers = []
    for i, top in enumerate(ranges.tops):
        w, b = weights[f"conv{i}.weight"].astype(np.float64), weights[f"conv{i}.bias"].astype(np.float64)
        whole, bias, size = _eight_bits(w * unit[:, None], b + w.sum(axis=2) @ start, _codes(mean, start, unit))
        top = np.maximum(top, 1e-6)
        layers.append(IntegerLayer(whole, bias, Requantize(*_split(size / (top / 255), 255))))
        gain, start = affine(arch, i, weights)
        unit = gain * top / 255
        mean = gain * ranges.means[i + 1] + start
    if arch.pooling != "mean":
        unit, start = np.concatenate([unit, np.abs(unit)]), np.concatenate([start, np.zeros(len(start))])
        mean = np.concatenate([mean, np.abs(gain) * ranges.deviation])
    w, b = weights["dense.weight"].astype(np.float64), weights["dense.bias"].astype(np.float64)
    whole, bias, size = _eight_bits(w * unit / arch.pooled, b + w @ start, _codes(mean, start, unit) * arch.pooled)
    dense = IntegerDense(whole, bias, LogitScale(*_split(size * 256, 1 << 14)))
    vectors = None
    if arch.vector is not None:
        vectors, scaler = _vectors(arch, arch.vector, weights, scaler, ranges.axes)
    return IntegerNetwork(arch, _input_scale(scaler, ranges.low, span / 255), tuple(layers), dense, vectors)


def _vectors(
    arch: Arch, layer: VectorLayer, weights: Mapping[str, NDArray[Any]], scaler: Scaler, most: Floats
) -> tuple[IntegerVectors, Scaler]:
    """Quantize the vector layer; also return the scaling from its integers to its standardized outputs.

    The shifts leave twice the range of the training windows; values beyond it are clamped.
    """
    others = arch.channels - layer.axes
    w = weights["vector.weight"].astype(np.float64)
    step = np.maximum(np.abs(w).max(axis=2) / 127, 1e-30)
    whole = np.rint(w / step[:, :, None]).astype(np.int8)
    down = down_for(whole)
    units, shifts = [scaler.scale[:others]], list[int]()
    for number in range(layer.vectors):
        scale = float(scaler.scale[others + 3 * number])
        room = np.log2(AXIS_LIMIT / max(2.0 * float(most[number]) / scale, 1.0))
        shift = int(min(max(np.floor(room), -MOST_AXIS_SHIFT), MOST_AXIS_SHIFT))
        unit = scale * 2.0**-shift
        lengths = step[number] * unit * 2.0 ** down[number]
        units += [lengths, lengths, np.sqrt(lengths * np.roll(lengths, -1))]
        shifts.append(shift)
    vectors = IntegerVectors(layer, np.array(shifts, dtype=np.int64), whole, down)
    size = np.concatenate(units)
    offset = np.concatenate([scaler.offset[:others], np.zeros(len(size) - others)])
    gain = 1.0 / np.sqrt(weights["vector.var"].astype(np.float64) + NORM_EPSILON)
    return vectors, Scaler(offset + weights["vector.mean"].astype(np.float64) / size, size * gain)


def _codes(mean: Floats, start: Floats, unit: Floats) -> Floats:
    """Return the mean 8-bit code of each input of a layer (0 for a constant one)."""
    return np.clip(np.divide(mean - start, unit, out=np.zeros_like(mean), where=unit != 0), 0.0, 255.0)


def _eight_bits(w: Floats, b: Floats, mean_input: Floats) -> tuple[NDArray[np.int8], NDArray[np.int64], Floats]:
    """Quantize weights (F, C, K) or (F, C) and biases (F,) per filter: the largest weight becomes ±127, or less if all
    of a convolution would exceed `MOST_REACH`.

    ``mean_input`` (C,) is the mean input; the bias compensates the mean error of the rounded weights.
    """
    rows = np.abs(w).reshape(len(w), -1)
    scale = np.maximum(np.maximum(rows.max(axis=1) / 127, np.abs(b) / (1 << 29)), 1e-30)
    if w.ndim > 2:  # rounding adds at most 1 to each
        scale = np.maximum(scale, rows.sum(axis=1) / max(MOST_REACH - rows.shape[1], 1))
    scales = scale.reshape(-1, *[1] * (w.ndim - 1))
    whole = rounded_weights(w / scales)
    mean_error = (w - whole * scales).reshape(*w.shape[:2], -1).sum(axis=2) @ mean_input
    return whole, np.rint((b + mean_error) / scale).astype(np.int64), scale


def _split(ratios: Floats, full: int) -> NDArray[np.int64]:
    """Return rows before, multiplier and after (3, F) of `split_ratio`, for sums up to ``full`` / ratio."""
    return np.array([split_ratio(float(r), full / float(r)) for r in ratios], dtype=np.int64).T


def _input_scale(scaler: Scaler, low: Floats, unit: Floats) -> InputScale:
    rows = []
    for offset, scale, start, size in zip(scaler.offset, scaler.scale, low, unit, strict=True):
        ratio = float(scale / size)
        center = float(offset + (start + 127.5 * size) / scale)
        if not abs(center) < 1 << 31:
            raise BundleError(
                f"The scaling and the calibration of an input do not fit (offset {center:g}): train again."
            )
        middle = round(center)
        before, multiplier, after = split_ratio(ratio, 128 / ratio + 1, 22, 16)
        there = ((middle - offset) * scale - start) / size
        rows.append((middle, before, multiplier, round((there + 0.5) * 2.0**after), after))
    return InputScale(*np.array(rows, dtype=np.int64).T)


_MAX_WINDOWS = 1024


def calibration(
    arch: Arch, weights: Mapping[str, NDArray[np.float32]], scaler: Scaler, x: NDArray[np.integer[Any]]
) -> dict[str, object]:
    """Calibrate on integer training windows (N, C, T); return plain values for the bundle, without samples.

    Empty for a network that cannot be deployed, or without windows.
    """
    if not deployable(arch) or not len(x):
        return {}
    # Evenly spaced, so that every person is included.
    chosen = np.unique(np.linspace(0, len(x) - 1, min(len(x), _MAX_WINDOWS)).round().astype(np.int64))
    return calibrate(Network(arch, weights), scaler.apply(x[chosen, :, x.shape[2] - arch.span :])).to_dict()


def calibrated(bundle: Bundle, x: NDArray[np.integer[Any]]) -> Bundle:
    """Return the bundle with the calibration of integer windows (N, C, T) of its training people.

    Raises:
        ArchError: for a network that cannot be deployed; BundleError: without windows.
    """
    refuse_undeployable(bundle.arch)
    if not len(x):
        raise BundleError("There are no windows to calibrate on: give those that the network was trained on.")
    return replace(bundle, calibration=calibration(bundle.arch, bundle.weights, bundle.scaler, x))


def integer_network(bundle: Bundle) -> IntegerNetwork:
    """Quantize the bundle's network; deterministic.

    Raises:
        ArchError: for a network that cannot be deployed; BundleError: for a bundle without calibration.
    """
    refuse_undeployable(bundle.arch)
    if not bundle.calibration:
        raise BundleError(
            "The bundle holds no calibration (it was made by an earlier PlushSense): train it again, or give the data "
            "set that it was trained on, with plushsense export BUNDLE OUT --dataset DS."
        )
    return quantize(bundle.arch, bundle.weights, bundle.scaler, Ranges.from_dict(bundle.calibration))


def integer_model(bundle: Bundle, decide: DecideSpec | None = None) -> IntegerModel:
    """Build the model that the toy runs. ``decide``: decision settings, by default those of the bundle.

    Raises:
        ArchError, BundleError: as for `integer_network`; ConfigError: for unknown decision settings.
    """
    spec = decide or DecideSpec.from_dict(bundle.decision)
    step_s = bundle.arch.step * bundle.layout.period_us / 1e6
    weight = smoothing_weight(spec.smoothing_s, step_s)
    return IntegerModel(integer_network(bundle), bundle.layout, bundle.gestures, weight, spec.rules(step_s))


def classifier_of(bundle: Bundle, decide: DecideSpec | None, engine: str) -> StreamReader:
    """Build the stream classifier of a bundle for the engine ``float``, ``int8`` or ``both``.

    Raises:
        BundleError: for ``int8`` and ``both``, if the network cannot be deployed.
    """
    if engine == "float":
        return StreamClassifier(bundle, decide)
    model = integer_model(bundle, decide)
    one = IntegerClassifier(model) if engine == "int8" else BothEngines(model, StreamClassifier(bundle, decide))
    one.bundle = bundle
    return one


def integer_probabilities(network: IntegerNetwork, x: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
    """Compute the probabilities (N, K) of integer windows (N, C, T) with a deployed network, without smoothing."""
    return softmax(network.forward(x)).astype(np.float32) / np.float32(1 << PROBABILITY_BITS)
