"""Mutants: copies of the model or the C with one deliberate error each, which `plushsense verify` must detect.

A mutant changes a number in the model's bytes (a weight, a shift, a range; with a new checksum), or replaces a text in
``plushsense.c`` (an index, a rounding, a clamp). The texts are in ``mutants.toml``.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.core.toml import load_table, read_toml
from plushsense.runtime.fixed import PROBABILITY_BITS
from plushsense.runtime.image import GROUP, HEAD_BYTES, image_head

Kind = Literal["weight", "shift", "index", "rounding", "clamp", "rule", "constant", "patch", "event", "gate", "health"]
RULES: tuple[Kind, ...] = ("event", "gate", "health")  # kinds that the test scenarios are made to detect


@dataclass(frozen=True)
class SourceMutant:
    """A replacement of text in plushsense.c.

    ``name`` describes the error, ``when`` the models it affects.
    """

    kind: Kind
    name: str
    find: str
    replace: str
    when: Literal["always", "dilated", "magnitude", "paired", "ranged", "smoothed", "stepped", "ties", "vectors"] = (
        "always"
    )


@cache
def source_mutants() -> tuple[SourceMutant, ...]:
    """Read the mutants of plushsense.c from ``mutants.toml``."""
    path = Path(__file__).with_name("mutants.toml")
    rows = read_toml(path, "mutants", BadInput)["mutants"]
    return tuple(load_table(row, SourceMutant, path.name, BadInput) for row in rows)


_FIXED_BYTES, _RANGE_BYTES, _INPUT_BYTES, _SCALE_BYTES = 28, 12, 12, 8
_GAP_AT, _SMOOTHING_AT = 16, 24
_INT32 = (1 << 31) - 1
_MOST_SHIFT = 30


@dataclass(frozen=True)
class Mutant:
    """A program with one error: either in the model, ``image``, or in the C, ``source``; the other is None."""

    kind: Kind
    name: str
    image: bytes | None = None
    source: str | None = None


def mutants_of(image: bytes, source: str) -> list[Mutant]:
    """Return the mutants of the image and of ``plushsense.c`` that change results of this model.

    Raises:
        BadInput: when a text to replace does not occur in the C exactly once.
    """
    at = _ImageOffsets(image)
    mutants = []
    for n, layer in enumerate([*at.layers, at.dense], 1):
        part = f"layer {n}" if layer is not at.dense else "the dense layer"
        weight, filter_ = layer.largest_weight()
        mutants.append(_in_image("weight", f"one weight of {part} by one", image, weight, "B"))
        shift = layer.scales_at + _SCALE_BYTES * filter_ + 7
        mutants.append(_in_image("shift", f"one shift of {part} by one", image, shift, "B", _MOST_SHIFT))
    mutants.append(_in_image("shift", "one input's shift by one", image, at.input_scales + 11, "B", _MOST_SHIFT))
    if at.vectors:
        mutants.append(_in_image("weight", "one weight of the vector layer by one", image, at.vector_weight, "B"))
    mutants.append(
        _in_image("constant", "the longest gap by one", image, HEAD_BYTES + _GAP_AT, "I", by=at.units_per_ms)
    )
    where = HEAD_BYTES + _SMOOTHING_AT
    mutants.append(_in_image("constant", "the smoothing's weight by one", image, where, "H", 1 << PROBABILITY_BITS))
    ranged = [n for n, (_, high) in enumerate(at.ranges) if high < _INT32]
    for n in ranged[:1]:
        where = HEAD_BYTES + _FIXED_BYTES + _RANGE_BYTES * n + 4
        mutants.append(_in_image("constant", f"the valid range of channel {n + 1} by one", image, where, "i"))
    shows = {
        "always": True,
        "dilated": any(layer.dilation > 1 for layer in at.layers),
        "magnitude": at.magnitudes,
        "vectors": bool(at.vectors),
        "ranged": bool(ranged),
        # With a step of one sample, every sample has an answer, and none waits for the next.
        "stepped": at.step > 1,
        "paired": at.step > 1 and any(layer.dilation > 1 for layer in at.layers),
        # Without smoothing nothing is rounded.
        "smoothed": at.smoothing < 1 << PROBABILITY_BITS,
        # With smaller time units, ties are rare.
        "ties": at.units_per_ms <= 10,
    }
    for mutant in source_mutants():
        if source.count(mutant.find) != 1:
            raise BadInput(
                f"The mutant '{mutant.name}' cannot be applied: its text ({mutant.find.strip()!r}) occurs "
                f"{source.count(mutant.find)} times in plushsense.c, and not once; export the model again with this "
                "PlushSense, or undo your changes to that file."
            )
        if shows[mutant.when]:
            mutants.append(Mutant(mutant.kind, mutant.name, source=source.replace(mutant.find, mutant.replace)))
    return mutants


def _in_image(kind: Kind, name: str, image: bytes, at: int, form: str, most: int | None = None, by: int = 1) -> Mutant:
    """Increase the number at offset ``at`` by ``by`` (decrease it at its maximum) and renew the checksum."""
    most = most if most is not None else (1 << (8 * struct.calcsize(form) - form.islower())) - 1
    (value,) = struct.unpack_from("<" + form, image, at)
    changed = bytearray(image)
    struct.pack_into("<" + form, changed, at, value + by if value + by <= most else value - by)
    body = bytes(changed[HEAD_BYTES:])
    (version,) = struct.unpack_from("<H", image, 4)
    return Mutant(kind, name, image=image_head(body, version=version) + body)


@dataclass(frozen=True, eq=False)
class _LayerOffsets:
    """Scales and weights of a layer in an image. ``index`` (F, C, K): offsets of the weights; ``after``: next layer."""

    dilation: int
    scales_at: int
    weights: NDArray[np.int64]
    index: NDArray[np.int64]
    after: list[_LayerOffsets]

    def largest_weight(self) -> tuple[int, int]:
        """Return offset and filter of the largest weight in the filter that the next layer weights most."""
        sums = np.abs(self.after[0].weights).sum(axis=(0, 2)) if self.after else np.abs(self.weights).sum(axis=(1, 2))
        filter_ = int(sums[: len(self.weights)].argmax())
        largest = int(np.abs(self.weights[filter_]).argmax())
        return int(self.index[filter_].flat[largest]), filter_


class _ImageOffsets:
    """Offsets and settings in an image; `plushsense.runtime.image` defines the format."""

    def __init__(self, image: bytes) -> None:
        count, channels, inputs, classes, self.step = struct.unpack_from("<BBBBH", image, HEAD_BYTES)
        (self.units_per_ms,) = struct.unpack_from("<I", image, HEAD_BYTES + 20)
        (self.smoothing,) = struct.unpack_from("<H", image, HEAD_BYTES + _SMOOTHING_AT)
        at = HEAD_BYTES + _FIXED_BYTES
        self.ranges = [struct.unpack_from("<ii", image, at + _RANGE_BYTES * i) for i in range(channels)]
        at += _RANGE_BYTES * channels
        kinds = []
        for _ in range(inputs):
            kinds.append(image[at])
            at += 3 + image[at + 1]
        self.magnitudes = 1 in kinds
        self.vectors, kernels, taps = struct.unpack_from("<BBH", image, at)
        at += 4
        first = np.frombuffer(image, np.uint8, taps, at + 2).astype(np.int64) - 128
        self.vector_weight = at + 2 + int(np.abs(first).argmax()) if taps else 0
        at += self.vectors * (1 + kernels * (1 + taps))
        at += -at % GROUP  # what fills up to a multiple of 4
        self.input_scales = at
        outputs = inputs - 3 * self.vectors - 3 + 3 * self.vectors * kernels if self.vectors else inputs
        at += _INPUT_BYTES * outputs
        self.layers: list[_LayerOffsets] = []
        stored = np.frombuffer(image, dtype=np.uint8).astype(np.int64) - 128
        filters = 0
        for _ in range(count):
            kernel, dilation, read, filters = struct.unpack_from("<HHHH", image, at)
            scales = at + 8
            at = scales + _SCALE_BYTES * filters
            shape = (-(-filters // GROUP), kernel, -(-read // GROUP), GROUP, GROUP)
            index = at + np.arange(np.prod(shape)).reshape(shape)
            index = index.transpose(0, 3, 2, 4, 1).reshape(shape[0] * GROUP, shape[2] * GROUP, kernel)
            index = index[:filters, :read]
            self.layers.append(_LayerOffsets(dilation, scales, stored[index], index, []))
            at += int(np.prod(shape))
        scales = at
        at += _SCALE_BYTES * classes
        index = at + np.arange(classes * filters).reshape(classes, filters, 1)
        self.dense = _LayerOffsets(1, scales, stored[index], index, [])
        for one, other in zip(self.layers, [*self.layers[1:], self.dense], strict=True):
            one.after.append(other)
