"""Planted faults: what `plushsense verify` has to notice, planted one at a time to see whether it does.

A fault is in the model's bytes (a weight, a shift, a range; the checksum made good again) or in the C (an index, a
rounding, a clamp), there by exact text that must stand in ``plushsense.c`` once.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.deploy.rule_faults import RULE_TEXTS, Kind, Text
from plushsense.models.fixed import PROBABILITY_BITS
from plushsense.models.image import GROUP, head
from plushsense.models.image import HEAD_BYTES as BODY

_FIXED_BYTES, _SCALE_BYTES = 28, 8
_GAP_AT, _SMOOTHING_AT = 16, 24
_INT32 = (1 << 31) - 1
_MOST_SHIFT = 30


@dataclass(frozen=True)
class Fault:
    """One fault: the changed bytes of the model, or the changed C; the other is None."""

    kind: Kind
    name: str
    image: bytes | None = None
    source: str | None = None


# Every one stays within the toy's memory, so that it is the answers that give it away, and not a crash.
TEXTS = (
    Text(
        "index",
        "a layer reads from its newest row on, not from its oldest",
        "uint32_t at = oldest(layer) * row, taps = layer->kernel;",
        "uint32_t at = layer->newest * row, taps = layer->kernel;",
    ),
    Text(
        "index",
        "a ring of rows wraps one row too early",
        "layer->newest + 1u < layer->rows ? layer->newest + 1u : 0u",
        "layer->newest + 2u < layer->rows ? layer->newest + 1u : 0u",
    ),
    Text(
        "index",
        "the dilation is ignored",
        "stride = layer->dilation * row;",
        "stride = row;",
        "dilated",
    ),
    Text(
        "index",
        "the ring of the pooling's blocks wraps one block too early",
        "toy->block + 1u < toy->blocks ? toy->block + 1u : 0u",
        "toy->block + 2u < toy->blocks ? toy->block + 1u : 0u",
    ),
    Text(
        "rounding",
        "activations are cut off, not rounded",
        "t = (t * le16(scale + 4) + half(scale[7])) >> scale[7];",
        "t = (t * le16(scale + 4)) >> scale[7];",
    ),
    Text(
        "rounding",
        "logits are cut off, not rounded",
        "shift_down(t * (int32_t)le16(scale + 4) + (int32_t)half(scale[7]), scale[7])",
        "shift_down(t * (int32_t)le16(scale + 4), scale[7])",
    ),
    Text(
        "rounding",
        "negative numbers are rounded towards zero",
        "return v >= 0 ? v >> n : ~(~v >> n);",
        "return v >= 0 ? v >> n : -(-v >> n);",
    ),
    Text(
        "rounding",
        "a falling channel is interpolated with a half rounded down",
        "part_of(from - to, 2 * into, 2 * between, between - 1, toy->narrow)",
        "part_of(from - to, 2 * into, 2 * between, between, toy->narrow)",
        "ties",
    ),
    Text(
        "rounding",
        "a falling channel is interpolated without rounding",
        "part_of(from - to, 2 * into, 2 * between, between - 1, toy->narrow)",
        "part_of(from - to, 2 * into, 2 * between, 0, toy->narrow)",
    ),
    Text(
        "rounding",
        "probabilities are cut off, not rounded",
        "(((e << 15) + (total >> 1)) / total)",
        "((e << 15) / total)",
    ),
    Text(
        "rounding",
        "the smoothing is cut off, not rounded",
        "((low * toy->smoothing + 16384u) >> 15)",
        "((low * toy->smoothing) >> 15)",
        "smoothed",
    ),
    Text(
        "rounding",
        "the magnitude loses its fraction",
        "x = as_signed(square_root(sum << 8));",
        "x = as_signed(square_root(sum) << 4);",
        "magnitude",
    ),
    Text(
        "clamp",
        "activations over 255 wrap",
        "return t < 255u ? t : 255u;",
        "return t & 255u;",
    ),
    Text(
        "clamp",
        "inputs out of 8 bits wrap",
        "(uint8_t)within(shift_down(x * (int32_t)le16(p + 8) + as_signed(le32(p + 4)), p[11]), 0, 255)",
        "(uint8_t)((uint32_t)shift_down(x * (int32_t)le16(p + 8) + as_signed(le32(p + 4)), p[11]) & 255u)",
    ),
    Text(
        "clamp",
        "negative sums pass the ReLU",
        "    if (sum <= 0)\n        return 0;\n    t = (uint32_t)sum >> scale[6];",
        "    t = (uint32_t)(sum < 0 ? -sum : sum) >> scale[6];",
    ),
    Text(
        "rule",
        "values above the valid range are taken",
        "value >= as_signed(le32(range)) && value <= as_signed(le32(range + 4))",
        "value >= as_signed(le32(range))",
        "ranged",
    ),
    Text(
        "rule",
        "what was remembered survives a restart",
        "memset(toy->memory, 0, toy->memory_bytes);",
        "",
    ),
    Text(
        "rule",
        "the oldest block stays in the pooling",
        "toy->total[f] -= sums[f];",
        "toy->total[f] -= 0u;",
    ),
    Text(
        "rule",
        "answers fall due at another phase of the step",
        "toy->filled = (uint16_t)(phase == 0 ? 0 : toy->step - phase);",
        "toy->filled = (uint16_t)(phase == 0 ? 1 : 0);",
        "stepped",
    ),
    *RULE_TEXTS,
)


def faults_of(image: bytes, source: str) -> list[Fault]:
    """The faults that this model can show, planted in its image or in ``plushsense.c``.

    Raises:
        BadInput: when a text to replace does not stand in the C exactly once.
    """
    at = _Places(image)
    found = []
    for n, layer in enumerate([*at.layers, at.dense], 1):
        what = f"layer {n}" if layer is not at.dense else "the dense layer"
        weight, filter_ = layer.telling()
        found.append(_in_image("weight", f"one weight of {what} by one", image, weight, "B"))
        shift = layer.scales_at + _SCALE_BYTES * filter_ + 7
        found.append(_in_image("shift", f"one shift of {what} by one", image, shift, "B", _MOST_SHIFT))
    found.append(_in_image("shift", "one input's shift by one", image, at.inputs[0] + 11, "B", _MOST_SHIFT))
    found.append(_in_image("constant", "the longest gap by one", image, BODY + _GAP_AT, "I", by=at.units_per_ms))
    where = BODY + _SMOOTHING_AT
    found.append(_in_image("constant", "the smoothing's weight by one", image, where, "H", 1 << PROBABILITY_BITS))
    ranged = [n for n, (_, high) in enumerate(at.ranges) if high < _INT32]
    for n in ranged[:1]:
        where = BODY + _FIXED_BYTES + 8 * n + 4
        found.append(_in_image("constant", f"the valid range of channel {n + 1} by one", image, where, "i"))
    shows = {
        "always": True,
        "dilated": any(layer.dilation > 1 for layer in at.layers),
        "magnitude": at.magnitudes,
        "ranged": bool(ranged),
        # Every sample is a step where one makes a step.
        "stepped": at.step > 1,
        # With the whole weight on the new step nothing is left to round.
        "smoothed": at.smoothing < 1 << PROBABILITY_BITS,
        # In fine units of time hardly any value lies just between two whole numbers.
        "ties": at.units_per_ms <= 10,
    }
    for each in TEXTS:
        if source.count(each.text) != 1:
            raise BadInput(
                f"The fault '{each.name}' cannot be planted: its text ({each.text.strip()!r}) stands "
                f"{source.count(each.text)} times in plushsense.c, and not once; export the model again with this "
                "PlushSense, or undo there what was edited."
            )
        if shows[each.when]:
            found.append(Fault(each.kind, each.name, source=source.replace(each.text, each.wrong)))
    return found


def _in_image(kind: Kind, name: str, image: bytes, at: int, form: str, most: int | None = None, by: int = 1) -> Fault:
    """The image with the number at a place greater by one (smaller, where it is the greatest), and a good checksum."""
    most = most if most is not None else (1 << (8 * struct.calcsize(form) - form.islower())) - 1
    (value,) = struct.unpack_from("<" + form, image, at)
    changed = bytearray(image)
    struct.pack_into("<" + form, changed, at, value + by if value + by <= most else value - by)
    body = bytes(changed[BODY:])
    return Fault(kind, name, image=head(body) + body)


@dataclass(frozen=True, eq=False)
class _Layer:
    """Where a layer's scales and weights stand; ``weights`` (F, C, K) as numbers, ``index`` their places."""

    dilation: int
    scales_at: int
    weights: NDArray[np.int64]
    index: NDArray[np.int64]
    after: list[_Layer]

    def telling(self) -> tuple[int, int]:
        """The place of the weight that speaks loudest, and its filter: a dead filter would hide any fault."""
        f = np.abs(self.after[0].weights).sum(axis=(0, 2)) if self.after else np.abs(self.weights).sum(axis=(1, 2))
        filter_ = int(f[: len(self.weights)].argmax())
        own = int(np.abs(self.weights[filter_]).argmax())
        return int(self.index[filter_].flat[own]), filter_


class _Places:
    """Where things stand in an image; the format is that of `plushsense.models.image`."""

    def __init__(self, image: bytes) -> None:
        count, channels, inputs, classes, self.step = struct.unpack_from("<BBBBH", image, BODY)
        (self.units_per_ms,) = struct.unpack_from("<I", image, BODY + 20)
        (self.smoothing,) = struct.unpack_from("<H", image, BODY + _SMOOTHING_AT)
        at = BODY + _FIXED_BYTES
        self.ranges = [struct.unpack_from("<ii", image, at + 8 * i) for i in range(channels)]
        at += 8 * channels
        self.inputs: list[int] = []
        self.magnitudes = False
        for _ in range(inputs):
            self.magnitudes |= image[at] == 1
            self.inputs.append(at + 2 + image[at + 1])
            at = self.inputs[-1] + 12
        self.layers: list[_Layer] = []
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
            self.layers.append(_Layer(dilation, scales, stored[index], index, []))
            at += int(np.prod(shape))
        scales = at
        at += _SCALE_BYTES * classes
        index = at + np.arange(classes * filters).reshape(classes, filters, 1)
        self.dense = _Layer(1, scales, stored[index], index, [])
        for one, other in zip(self.layers, [*self.layers[1:], self.dense], strict=True):
            one.after.append(other)
