"""Planted faults: what `plushsense verify` has to notice, planted one at a time to see whether it does.

A fault is in the model's bytes (a weight, a shift, a range; the checksum made good again) or in the C (an index, a
rounding, a clamp), there by exact text that must stand in ``plushsense.c`` once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

_HEAD, _FIXED, _SCALE, _INT32 = 16, 28, 8, (1 << 31) - 1

Kind = Literal["weight", "shift", "index", "rounding", "clamp", "rule", "constant"]


@dataclass(frozen=True)
class Fault:
    """One fault: the changed bytes of the model, or the changed C; the other is None."""

    kind: Kind
    name: str
    image: bytes | None = None
    source: str | None = None


@dataclass(frozen=True)
class _Text:
    """A fault in the C; ``when`` says which models can show it."""

    kind: Kind
    name: str
    text: str
    wrong: str
    when: Literal["always", "dilated", "magnitude", "gap"] = "always"


# Every one stays within the toy's memory, so that it is the answers that give it away, and not a crash.
TEXTS = (
    _Text(
        "index",
        "a layer reads from its newest row on, not from its oldest",
        "uint32_t at = layer->newest * row + row, taps = layer->kernel;",
        "uint32_t at = layer->newest * row, taps = layer->kernel;",
    ),
    _Text(
        "index",
        "a ring of rows wraps one row too early",
        "layer->newest + 1u < layer->rows ? layer->newest + 1u : 0u",
        "layer->newest + 2u < layer->rows ? layer->newest + 1u : 0u",
    ),
    _Text(
        "index",
        "the dilation is ignored",
        "stride = layer->dilation * row;",
        "stride = row;",
        "dilated",
    ),
    _Text(
        "index",
        "the ring of the pooling's blocks wraps one block too early",
        "toy->block + 1u < toy->blocks ? toy->block + 1u : 0u",
        "toy->block + 2u < toy->blocks ? toy->block + 1u : 0u",
    ),
    _Text(
        "rounding",
        "activations are cut off, not rounded",
        "t = (t * le16(scale + 4) + half(scale[7])) >> scale[7];",
        "t = (t * le16(scale + 4)) >> scale[7];",
    ),
    _Text(
        "rounding",
        "logits are cut off, not rounded",
        "shift_down(t * (int32_t)le16(scale + 4) + (int32_t)half(scale[7]), scale[7])",
        "shift_down(t * (int32_t)le16(scale + 4), scale[7])",
    ),
    _Text(
        "rounding",
        "negative numbers are rounded towards zero",
        "return v >= 0 ? v >> n : ~(~v >> n);",
        "return v >= 0 ? v >> n : -(-v >> n);",
    ),
    _Text(
        "rounding",
        "a falling channel is interpolated with a half rounded down",
        "part_of(from - to, 2 * into, 2 * between, between - 1, toy->narrow)",
        "part_of(from - to, 2 * into, 2 * between, between, toy->narrow)",
    ),
    _Text(
        "rounding",
        "probabilities are cut off, not rounded",
        "(((e << 15) + (total >> 1)) / total)",
        "((e << 15) / total)",
    ),
    _Text(
        "rounding",
        "the smoothing is cut off, not rounded",
        "((low * toy->smoothing + 16384u) >> 15)",
        "((low * toy->smoothing) >> 15)",
    ),
    _Text(
        "rounding",
        "the magnitude loses its fraction",
        "x = (int32_t)square_root(sum << 8);",
        "x = (int32_t)(square_root(sum) << 4);",
        "magnitude",
    ),
    _Text(
        "clamp",
        "activations over 255 wrap",
        "return t < 255u ? t : 255u;",
        "return t & 255u;",
    ),
    _Text(
        "clamp",
        "inputs out of 8 bits wrap",
        "(uint8_t)within(shift_down(x * (int32_t)le16(p + 8) + as_signed(le32(p + 4)), p[11]), 0, 255)",
        "(uint8_t)((uint32_t)shift_down(x * (int32_t)le16(p + 8) + as_signed(le32(p + 4)), p[11]) & 255u)",
    ),
    _Text(
        "clamp",
        "negative sums pass the ReLU",
        "    if (sum <= 0)\n        return 0;\n    t = (uint32_t)sum >> scale[6];",
        "    t = (uint32_t)(sum < 0 ? -sum : sum) >> scale[6];",
    ),
    _Text(
        "rule",
        "values above the valid range are taken",
        "values[i] >= as_signed(le32(range)) && values[i] <= as_signed(le32(range + 4))",
        "values[i] >= as_signed(le32(range))",
        "gap",
    ),
    _Text(
        "rule",
        "what was remembered survives a gap",
        "        toy->restarts++;\n        plush_restart(toy);",
        "        toy->restarts++;",
    ),
    _Text(
        "rule",
        "the oldest block stays in the pooling",
        "toy->total[f] -= sums[f];",
        "toy->total[f] -= 0u;",
    ),
    _Text(
        "rule",
        "answers fall due at another phase of the step",
        "toy->filled = (uint16_t)(phase == 0 ? 0 : toy->step - phase);",
        "toy->filled = (uint16_t)(phase == 0 ? 1 : 0);",
    ),
)
