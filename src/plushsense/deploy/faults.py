"""Planted faults: what `plushsense verify` has to notice, planted one at a time to see whether it does.

A fault is in the model's bytes (a weight, a shift, a range; the checksum made good again) or in the C (an index, a
rounding, a clamp), there by exact text that must stand in ``plushsense.c`` once.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput
from plushsense.models.fixed import PROBABILITY_BITS
from plushsense.models.image import GROUP, head
from plushsense.models.image import HEAD_BYTES as BODY

_FIXED_BYTES, _SCALE_BYTES = 28, 8
_GAP_AT, _SMOOTHING_AT = 16, 24
_INT32 = (1 << 31) - 1
_MOST_SHIFT = 30

Kind = Literal["weight", "shift", "index", "rounding", "clamp", "rule", "constant", "event", "gate", "health"]
RULES: tuple[Kind, ...] = ("event", "gate", "health")  # what drills are for


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
    when: Literal["always", "dilated", "magnitude", "ranged", "smoothed", "ties"] = "always"


# Every one stays within the toy's memory, so that it is the answers that give it away, and not a crash.
TEXTS = (
    _Text(
        "index",
        "a layer reads from its newest row on, not from its oldest",
        "uint32_t at = oldest(layer) * row, taps = layer->kernel;",
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
        "ties",
    ),
    _Text(
        "rounding",
        "a falling channel is interpolated without rounding",
        "part_of(from - to, 2 * into, 2 * between, between - 1, toy->narrow)",
        "part_of(from - to, 2 * into, 2 * between, 0, toy->narrow)",
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
        "smoothed",
    ),
    _Text(
        "rounding",
        "the magnitude loses its fraction",
        "x = as_signed(square_root(sum << 8));",
        "x = as_signed(square_root(sum) << 4);",
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
        "value >= as_signed(le32(range)) && value <= as_signed(le32(range + 4))",
        "value >= as_signed(le32(range))",
        "ranged",
    ),
    _Text(
        "rule",
        "what was remembered survives a restart",
        "memset(toy->memory, 0, toy->memory_bytes);",
        "",
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
    _Text("event", "known is not asked for", "if (toy->answer.known < known_least(toy->event_plan))", "if (toy->answer.known < -LOGIT_LIMIT)"),
    _Text("event", "known is not smoothed", "*known = smoothed(toy, *known, highest * 4096);", "*known = highest * 4096;"),
    _Text("event", "an idle class answers as any other", "    if (is_idle(toy, best))\n        return PLUSH_IDLE;", "    if (is_idle(toy, best) && sure == 0)\n        return PLUSH_IDLE;"),
    _Text("event", "a class just as sure as asked for is left out", "if (share_of(toy, k) >= sure) {", "if (share_of(toy, k) > sure + 200) {"),
    _Text("event", "idle classes count for an affect", "if (toy->classes_told[k] == affect)", "if (affect_of(toy, k) == affect)"),
    _Text("event", "an affect alone never begins an event", "return most >= setting(toy, ENTER_AFFECT) ?", "return most > PLUSH_ONE ?"),
    _Text("event", "a gesture begins at the share at which it may stay", "else if (toy->answer.confidence >= setting(toy, ENTER)) {", "else if (toy->answer.confidence >= setting(toy, LEAVE)) {"),
    _Text("event", "an event begins a step too soon", "toy->wanted_for >= setting(toy, LEAST))\n        begin_event", "toy->wanted_for + 1u >= setting(toy, LEAST))\n        begin_event"),
    _Text("event", "an event begins without resting after the last", "    toy->resting = (uint16_t)setting(toy, REST);\n    tell", "    toy->resting = 0;\n    tell"),
    _Text("event", "a name is given at once", "return toy->named_for >= setting(toy, LEAST) ?", "return toy->named_for >= 1u ?"),
    _Text("event", "a gesture stays at the share at which it begins", "share_of(toy, event->gesture) >= setting(toy, LEAVE)", "share_of(toy, event->gesture) >= setting(toy, ENTER)"),
    _Text("event", "an affect stays at the share at which it begins", "mass_of(toy, event->affect) >= setting(toy, LEAVE_AFFECT)", "mass_of(toy, event->affect) >= setting(toy, ENTER_AFFECT)"),
    _Text("event", "an idle class ends nothing", "if (is_idle(toy, best) && share_of(toy, best) >= setting(toy, ENTER))", "if (is_idle(toy, best) && share_of(toy, best) > PLUSH_ONE)"),
    _Text("event", "an event ends a step too late", "if (toy->away >= setting(toy, END) &&", "if (toy->away > setting(toy, END) &&"),
    _Text("event", "an event ends without being held", "toy->lasted >= setting(toy, HOLD))\n        end_event", "toy->lasted > 0)\n        end_event"),
    _Text("event", "another event comes without the last being held", ">= setting(toy, SWITCH) &&\n           toy->lasted >= setting(toy, HOLD);", ">= setting(toy, SWITCH);"),
    _Text("event", "another event comes a step too soon", ": toy->wanted_for) >= setting(toy, SWITCH)", ": toy->wanted_for) + 1 >= setting(toy, SWITCH)"),
    _Text("event", "another gesture of its affect counts as long as the affect", "(said != PLUSH_NO_GESTURE && its_affect ? toy->named_for : toy->wanted_for)", "(toy->wanted_for)"),
    _Text("event", "misses are counted on after the event was seen again", "    } else if (stays(toy, best)) {\n        toy->away = 0;", "    } else if (stays(toy, best)) {\n        toy->away += 0;"),
    _Text("event", "an event of the gate waits a step less for its name", "    toy->wait = (uint16_t)setting(toy, WAIT);", "    toy->wait = (uint16_t)(setting(toy, WAIT) - 1u);"),
    _Text("event", "while warming nothing ends", "    if (toy->wait > 0)\n        toy->wait--;\n    else\n        miss(toy, ms);", "    if (toy->wait > 0)\n        toy->wait--;"),
    _Text("event", "what was wanted survives silence", "    toy->wanted = toy->wanted_for = toy->named_for = 0;\n", "    toy->resting = 0;\n"),
    _Text("event", "the smoothing survives silence", "    toy->started = 0;\n    toy->resting = 0;", "    toy->resting = 0;"),
    _Text("event", "a suspect step counts", "    if (!toy->suspect) {\n        if (toy->answer.kind", "    if (toy->classes) {\n        if (toy->answer.kind"),
    _Text("event", "a suspect step ends events", "} else if (locked || toy->suspect) {", "} else if (locked) {"),
    _Text("gate", "the gate is never deaf", "toy->gate_deaf = (uint16_t)le16(rule + 4);", "toy->gate_deaf = 0;"),
    _Text("gate", "a blow must come in one sample less", "        if (*row == term[2])", "        if (*row + 1 >= term[2])"),
    _Text("gate", "terms hold a sample longer", "*left = (uint16_t)(longer + 1);", "*left = (uint16_t)(longer + 2);"),
    _Text("gate", "the sign of a deviation is not asked for", "if ((term[1] != SIGN_BELOW && size >= threshold) ||", "if (size >= threshold ||"),
    _Text("gate", "a size just as great as asked for is too small", "(term[1] != SIGN_ABOVE && -size >= threshold)", "(term[1] != SIGN_ABOVE && -size > threshold)"),
    _Text("gate", "the last rule that fires speaks", "if (every && fired == NULL)", "if (every)"),
    _Text("gate", "jerk is the change from one sample before", "*before = past_inputs(toy, lag);", "*before = past_inputs(toy, 1);"),
    _Text("gate", "the baseline follows at the pace of the noise", "shift_down(value * 256 - state[BASELINE], how[2])", "shift_down(value * 256 - state[BASELINE], how[3])"),
    _Text("gate", "one blow deafens the noise", "    if (size > 4 * level)\n        size = 4 * level;\n", "    if (size > 8 * level)\n        size = 8 * level;\n"),
    _Text("gate", "the noise has no floor of its own", "level = (state[NOISE] >> 8) + (int32_t)le32(how + 4);", "level = (state[NOISE] >> 8) + 1;"),
    _Text("gate", "the baseline begins at 0", "    if (toy->gate_seen == 0)\n        state[BASELINE]", "    if (toy->gate_seen > 200)\n        state[BASELINE]"),
    _Text("gate", "samples that repeat the one before are read", "if (toy->gate_seen > 0 && same(past_inputs(toy, 0)", "if (toy->gate_seen > 200 && same(past_inputs(toy, 0)"),
    _Text("gate", "suspect samples are read", "    if (toy->suspect) {\n        toy->gate_seen = 0;", "    if (toy->suspect && deaf > 1) {\n        toy->gate_seen = 0;"),
    _Text("gate", "the gate begins an event in one of its own affect", "if (going_on(toy) && (toy->event.affect == rule[1] ||", "if (going_on(toy) && ("),
    _Text("gate", "the gate takes the place of its own event", "(toy->event.affect == rule[1] || toy->event.source == PLUSH_GATE))", "(toy->event.affect == rule[1]))"),
    _Text("health", "a value stuck beyond the limits is believed", "return toy->limits != NULL && toy->compared &&", "return toy->limits == toy->ranges && toy->compared &&"),
    _Text("health", "a value beyond the limits need not be stuck", "toy->compared && value == toy->last[channel] &&", "toy->compared && value != INT32_MAX &&"),
    _Text("health", "a fault needs no time", "ms - toy->wrong_ms >= fault_ms)", "ms >= toy->wrong_ms)"),
    _Text("health", "the time of a fault goes on after a good frame", "if (wrong && !toy->wrong)", "if (wrong && !toy->wrong && toy->wrong_ms == 0)"),
    _Text("health", "a frozen toy is no fault", "(still && quiet >= frozen_ms));", "(still && quiet > 60000u));"),
    _Text("health", "a frozen toy is suspect at once", "(wrong || (still && quiet >= (frozen_ms + 1) / 2));", "(wrong || still);"),
    _Text("health", "a fault recovers with the first good frame", "if (ms - toy->good_ms < le16(toy->health_plan + RECOVER_MS))", "if (ms < toy->good_ms)"),
    _Text("health", "bad frames do not break the recovery", "    if (toy->suspect) {\n        toy->good = 0;", "    if (toy->suspect) {"),
    _Text("health", "what was frozen before a gap is frozen after it", "toy->suspect = toy->compared = toy->wrong = toy->good = 0;", "toy->suspect = toy->good = 0;"),
    _Text("health", "an event goes on through a fault", "        if (toy->faulty)\n            lose(toy, ms);\n        forget(toy);", "        forget(toy);"),
    _Text("health", "frames are read in a fault", "    if (toy->faulty)\n        return 0;\n    toy->heard", "    toy->heard"),
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
        count, channels, inputs, classes = struct.unpack_from("<BBBB", image, BODY)
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
