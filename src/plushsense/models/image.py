"""A deployed model as the bytes that the toy reads: the image, which the C library takes as it is.

All numbers are little-endian. Fixed head (16 bytes): ``PLSH``, u16 version, u16 0, u32 length of the whole, u32 CRC-32
of all that follows the head. Then, one after the other:

- u8 layers, u8 measured channels, u8 inputs, u8 classes, u16 step, u16 blocks of the pooling, u32 span (samples),
  u32 period and u32 gap of the clock in its own units, u32 milliseconds to units, u16 smoothing weight, u16 0
- a measured channel: i32 lowest and i32 highest valid value
- an input: u8 kind (0 a channel, 1 a magnitude), u8 n, n × u8 measured channels, then i32 offset, i32 bias,
  u16 multiplier, u8 before, u8 after
- a layer: u16 kernel, u16 dilation, u16 channels read, u16 filters; a filter: i32 bias, u16 multiplier, u8 before,
  u8 after; then the weights, each as weight + 128, for every 4 filters (the last ones filled up), tap and 4 channels
  (filled up): 4 filters × 4 channels
- a class: i32 bias, u16 multiplier, u8 before, u8 after; then classes × features weights, each as weight + 128
- a class: u8 affect (0 none, 1 positive, 2 neutral, 3 negative), its label in UTF-8 and a 0
- the model's title in UTF-8 and a 0
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.core.gestures import GestureSet
from plushsense.core.signal import Layout
from plushsense.models.fixed import LogitScale, Requantize
from plushsense.models.integer import IntegerNetwork

MAGIC = b"PLSH"
IMAGE_VERSION = 1
HEAD_BYTES = 16
AFFECT_CODES = {"none": 0, "positive": 1, "neutral": 2, "negative": 3}
GROUP = 4  # filters computed together, and channels read together


@dataclass(frozen=True, eq=False)
class IntegerModel:
    """All that the toy computes with: network, layout (clock, validity, inputs), gestures, weight of a new step.

    ``smoothing`` is in steps of 2^-15 (`plushsense.models.fixed.smoothing_weight`).
    """

    network: IntegerNetwork
    layout: Layout
    gestures: GestureSet
    smoothing: int

    def __post_init__(self) -> None:
        arch = self.network.arch
        if (self.layout.n_inputs, len(self.gestures)) != (arch.channels, arch.classes):
            raise BundleError(
                f"The model does not fit together: {self.layout.n_inputs} inputs and {len(self.gestures)} gestures, "
                f"{arch.title} needs {arch.channels} and {arch.classes}."
            )
        for what, found in (
            ("measured channels", len(self.layout.channels)),
            ("inputs", arch.channels),
            ("gestures", arch.classes),
        ):
            if found > 255:
                raise BundleError(f"The model has {found} {what}: in the toy there may be at most 255.")

    def sections(self) -> list[tuple[str, bytes]]:
        """What follows the head, piece by piece with what each is."""
        arch, layout = self.network.arch, self.layout
        unit = math.gcd(1000, layout.period_us)
        found = [
            (
                "layers, measured channels, inputs, classes; step, blocks; span; period, gap, units a ms; smoothing, 0",
                struct.pack(
                    "<BBBBHHIIIIHH",
                    len(arch.layers),
                    len(layout.channels),
                    arch.channels,
                    arch.classes,
                    arch.step,
                    arch.pooled // arch.step,
                    arch.span,
                    layout.period_us // unit,
                    layout.gap_ms * (1000 // unit),
                    1000 // unit,
                    self.smoothing,
                    0,
                ),
            )
        ]
        for name, low, high in zip(layout.names, layout.valid_min_int, layout.valid_max_int, strict=True):
            found.append((f"channel '{name}': valid from {low} to {high}", struct.pack("<ii", low, high)))
        derived = {d.name: tuple(layout.index(part) for part in d.of) for d in layout.derived}
        scale = self.network.inputs
        for i, name in enumerate(layout.inputs):
            parts = derived.get(name) or (layout.index(name),)
            row = (int(getattr(scale, n)[i]) for n in ("offset", "bias", "multiplier", "before", "after"))
            plan = bytes([name in derived, len(parts), *parts])
            found.append((f"input '{name}': where from; offset, bias, multiplier, shifts", plan))
            found.append(("", struct.pack("<iiHBB", *row)))
        for n, (layer, read, part) in enumerate(zip(arch.layers, arch.inputs, self.network.layers, strict=True), 1):
            shape = struct.pack("<HHHH", layer.kernel, layer.dilation, read, layer.filters)
            what = f"kernel {layer.kernel}, dilation {layer.dilation}, reads {read} channels, {layer.filters} filters"
            found.append((f"layer {n}: {what}", shape))
            found.append((f"layer {n}: bias, multiplier, shifts of each filter", _scales(part.bias, part.scale)))
            for first, group in enumerate(grouped(part.weights)):
                last = min(GROUP * first + GROUP, layer.filters)
                what = f"layer {n}: weights of filters {GROUP * first + 1} to {last}, tap by tap"
                found.append((what, group.tobytes()))
        dense = self.network.dense
        found.append(("dense layer: bias, multiplier, shifts of each class", _scales(dense.bias, dense.scale)))
        found.append(
            ("dense layer: weights of each class", (dense.weights.astype(np.int16) + 128).astype(np.uint8).tobytes())
        )
        for gesture in self.gestures.gestures:
            label = bytes([AFFECT_CODES[gesture.affect]]) + gesture.label.encode() + b"\0"
            found.append((f"class '{gesture.label}', {gesture.affect}", label))
        found.append((f"title '{arch.title}'", arch.title.encode() + b"\0"))
        return found

    def to_bytes(self) -> bytes:
        """The image."""
        body = b"".join(piece for _, piece in self.sections())
        return head(body) + body


def head(body: bytes) -> bytes:
    """The 16 bytes that stand before a body of an image."""
    return MAGIC + struct.pack("<HHII", IMAGE_VERSION, 0, len(body) + HEAD_BYTES, zlib.crc32(body))


def _scales(bias: NDArray[np.int64], scale: Requantize | LogitScale) -> bytes:
    rows = zip(bias, scale.multiplier, scale.before, scale.after, strict=True)
    return b"".join(struct.pack("<iHBB", *(int(v) for v in row)) for row in rows)


def grouped(weights: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Weights (F, C, K) as the toy reads them, each + 128 and filled up with 128: (F / 4, K, C / 4, 4, 4)."""
    f, c, k = weights.shape
    full = np.zeros((-(-f // GROUP) * GROUP, -(-c // GROUP) * GROUP, k), dtype=np.int16)
    full[:f, :c] = weights
    split = full.reshape(len(full) // GROUP, GROUP, full.shape[1] // GROUP, GROUP, k)
    return np.ascontiguousarray(split.transpose(0, 4, 2, 1, 3) + 128).astype(np.uint8)


def memory_bytes(model: IntegerModel) -> int:
    """Bytes that the toy remembers in: what ``plush_memory_bytes`` says of the model's image."""
    arch, measured = model.network.arch, len(model.layout.channels)

    def whole(n: int) -> int:
        return -(-n // GROUP) * GROUP

    rings = sum(
        (layer.reach + 1) * whole(read) + whole(2 * (layer.reach + 1))
        for layer, read in zip(arch.layers, arch.inputs, strict=True)
    )
    features = arch.filters[-1]
    pooling = whole(2 * features * (arch.pooled // arch.step)) + 4 * features + whole(features)
    return 3 * 4 * measured + rings + pooling + 2 * 4 * arch.classes + whole(measured)
