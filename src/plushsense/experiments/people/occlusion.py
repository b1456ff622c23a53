"""Explain which channels and moments decided: occlusion of one channel in one block of time, checked by deletion.

The attribution of a block is the loss of the log-probability of the gesture, in nats, when "nothing happened" there:

- an acceleration keeps its gravity and loses its movement: the three axes of a vector together, or a magnitude. Gravity
  is that which the network reads (divided by its fraction bits), else the mean over 0.64 s before and after;
- any other channel has the mean of the training windows (with the scaling "none", the reading that stands for zero); a
  vector that is no acceleration has zero.

Gravity, where it is an input, never changes. Blocks (Zeiler and Fergus 2014, 10.1007/978-3-319-10590-1_53) are computed
with the float network in NumPy. Deletion (Petsiuk et al. 2018, arXiv:1806.07421) replaces the blocks one after the
other, those of the highest attribution first: if they decided, the probability of the gesture falls faster than with
blocks in random order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import ACCELERATION, GRAVITY_FRACTION_BITS, GRAVITY_S, Layout
from plushsense.models.bundle import Bundle
from plushsense.models.reference import Network, softmax
from plushsense.windows.features import Scaler

Floats = NDArray[np.float64]

BLOCK_S = 0.25
_DELETIONS = 20  # points of a deletion curve after its start
_ORDERS = 5  # random orders of each window


@dataclass(frozen=True)
class Blocks:
    """The division of windows of ``samples`` into cells: (S) channels or vectors in (B) blocks of time.

    The blocks are counted from the end of the window, so that the first may be shorter. ``source_of`` (C,) is the
    channel or vector that each input belongs to, S for gravity; ``block_of`` (T,) is the block of each sample.
    """

    names: tuple[str, ...]
    inputs: tuple[tuple[int, ...], ...]
    source_of: NDArray[np.int64]
    block_of: NDArray[np.int64]

    @classmethod
    def of(cls, layout: Layout, samples: int, block_s: float = BLOCK_S) -> Blocks:
        """Divide windows with the inputs of ``layout``."""
        kinds = layout.input_kinds
        vectors = [axes for axes in layout.input_vectors if kinds[axes[0]] != "gravity"]
        in_vectors = {at for axes in vectors for at in axes}
        alone = [(at,) for at, kind in enumerate(kinds) if kind != "gravity" and at not in in_vectors]
        inputs = tuple(sorted([*vectors, *alone]))
        source_of = np.full(len(kinds), len(inputs), dtype=np.int64)
        for source, at in enumerate(inputs):
            source_of[list(at)] = source
        before_end = (samples - 1 - np.arange(samples)) // layout.samples(block_s)
        names = tuple(", ".join(layout.inputs[i] for i in at) for at in inputs)
        return cls(names, inputs, source_of, before_end[0] - before_end)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of channels or vectors, and number of blocks of time: (S, B)."""
        return len(self.inputs), int(self.block_of[-1]) + 1

    @property
    def starts(self) -> NDArray[np.int64]:
        """First sample of each block, and the number of samples: (B + 1,)."""
        return np.append(np.searchsorted(self.block_of, np.arange(self.shape[1])), len(self.block_of))

    def replace(self, x: Floats, quiet: Floats, cells: NDArray[np.bool_]) -> Floats:
        """Return windows (N, C, T) with the values of ``quiet`` (N, C, T) in the marked ``cells`` (N, S, B)."""
        gravity = np.zeros((len(cells), 1, cells.shape[2]), dtype=np.bool_)
        marked = np.concatenate([cells, gravity], axis=1)[:, self.source_of][:, :, self.block_of]
        return np.where(marked, quiet, x)


def quiet_windows(x: NDArray[np.integer[Any]], layout: Layout, scaler: Scaler) -> Floats:
    """Return unscaled windows (N, C, T) in which nothing happens, as this module describes, for windows ``x``."""
    means = scaler.offset if scaler.knows_training(layout) else np.zeros(len(scaler.offset))
    quiet = np.broadcast_to(means[:, None], x.shape).copy()
    # Movement along the axes of a vector; accelerations and gravity follow.
    for axes in layout.input_vectors:
        quiet[:, list(axes)] = 0.0
    gravity = {d.of[0]: layout.inputs.index(d.name) for d in layout.derived if d.name in layout.inputs}
    for at, (name, kind) in enumerate(zip(layout.inputs, layout.input_kinds, strict=True)):
        if kind == "gravity":
            quiet[:, at] = x[:, at]
        elif name in gravity and layout.input_kinds[gravity[name]] == "gravity":
            quiet[:, at] = x[:, gravity[name]] / 2**GRAVITY_FRACTION_BITS
        elif kind == ACCELERATION:
            quiet[:, at] = _moving_mean(x[:, at], layout.samples(GRAVITY_S))
    return quiet


def _moving_mean(x: NDArray[np.integer[Any]], reach: int) -> Floats:
    """Return the means of ``reach`` samples before and after each sample (N, T), of fewer at the ends."""
    sums = np.concatenate([np.zeros((len(x), 1)), np.cumsum(x, axis=1, dtype=np.float64)], axis=1)
    at = np.arange(x.shape[1])
    first, last = np.maximum(at - reach, 0), np.minimum(at + reach + 1, x.shape[1])
    return np.asarray((sums[:, last] - sums[:, first]) / (last - first))


def attributions(network: Network, x: Floats, quiet: Floats, blocks: Blocks, label: int) -> Floats:
    """Return the loss of the log-probability of class ``label`` (N, S, B) when each cell alone is replaced.

    ``x`` and ``quiet`` are scaled windows (N, C, T).
    """
    whole = _log_probability(network, x, label)
    lost = np.empty((len(x), *blocks.shape))
    for source, block in np.ndindex(blocks.shape):
        cells = np.zeros(lost.shape, dtype=np.bool_)
        cells[:, source, block] = True
        lost[:, source, block] = whole - _log_probability(network, blocks.replace(x, quiet, cells), label)
    return lost


def _log_probability(network: Network, x: Floats, label: int) -> Floats:
    logits = network.forward(x)
    highest = logits.max(axis=1)
    return np.asarray(logits[:, label] - highest - np.log(np.exp(logits - highest[:, None]).sum(axis=1)))


def deletion_curve(
    network: Network, x: Floats, quiet: Floats, blocks: Blocks, label: int, order: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Replace more and more cells of each window in an order, and return the mean probability of class ``label``.

    Args:
        order: (N, S · B) indices of the cells, the first to be replaced first.

    Returns:
        the shares of the cells that are replaced, from 0 to 1, and the mean probability at each.
    """
    rank = np.argsort(order, axis=1).reshape(len(x), *blocks.shape)
    counts = np.unique(np.linspace(0, order.shape[1], min(order.shape[1], _DELETIONS) + 1).round())
    means = [softmax(network.forward(blocks.replace(x, quiet, rank < n)))[:, label].mean() for n in counts]
    return counts / order.shape[1], np.array(means)


def area(shares: Floats, values: Floats) -> float:
    """Return the area under a curve over 0 to 1, by trapezoids."""
    return float(((values[1:] + values[:-1]) / 2 * np.diff(shares)).sum())


@dataclass(frozen=True)
class ExplainedGesture:
    """The explanation of one gesture.

    ``row`` is its entry of the table; ``signals`` and ``quiet`` (C, T) are an example window, unscaled, and what
    replaces it. The example is the window whose attribution is nearest to the mean.
    """

    row: dict[str, Any]
    signals: NDArray[np.int32]
    quiet: Floats


def explain_gesture(network: Network, x: NDArray[np.int32], bundle: Bundle, label: int, seed: int) -> ExplainedGesture:
    """Explain windows (N, C, T) of class ``label``, unscaled; ``seed`` draws the random orders of deletion."""
    blocks = Blocks.of(bundle.layout, x.shape[2])
    quiet = quiet_windows(x, bundle.layout, bundle.scaler)
    # Quiet values need not be integers.
    scaled, replaced = (bundle.scaler.apply(values).astype(np.float64) for values in (x, quiet))  # type: ignore[arg-type]
    lost = attributions(network, scaled, replaced, blocks, label)
    mean = lost.mean(axis=0)
    flat = lost.reshape(len(lost), -1)
    by_attribution = np.argsort(-flat, axis=1, kind="stable")
    shares, attributed = deletion_curve(network, scaled, replaced, blocks, label, by_attribution)
    random = np.random.default_rng(seed)
    orders = [np.argsort(random.random(flat.shape), axis=1) for _ in range(_ORDERS)]
    chance = [deletion_curve(network, scaled, replaced, blocks, label, order)[1] for order in orders]
    by_chance = np.mean(chance, axis=0)
    helped = np.maximum(mean, 0.0)
    source_shares = helped.sum(axis=1) / max(float(helped.sum()), 1e-12)
    ends = (blocks.starts - x.shape[2]) / bundle.layout.rate_hz
    peak = int(mean.sum(axis=0).argmax())
    example = int(((lost - mean) ** 2).sum(axis=(1, 2)).argmin())
    row = {
        "gesture": bundle.gestures.labels[label],
        "windows": len(x),
        "probability": float(attributed[0]),
        "attribution": mean.tolist(),
        "shares": dict(zip(blocks.names, source_shares.tolist(), strict=True)),
        "decided_s": [float(ends[peak]), float(ends[peak + 1])] if helped.any() else None,
        "deletion": {"shares": shares.tolist(), "attributed": attributed.tolist(), "random": by_chance.tolist()},
        "area": area(shares, attributed),
        "area_random": area(shares, by_chance),
        "example": example,
    }
    return ExplainedGesture(row, x[example], quiet[example])
