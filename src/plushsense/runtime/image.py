"""Image of a deployed model: the binary format that the C library reads.

All numbers are little-endian. Head (16 bytes): ``PLSH``, u16 version, u16 0, u32 length of the whole image, u32 CRC-32
of everything after the head. The following sections come in this order:

- u8 layers, u8 measured channels, u8 inputs, u8 classes, u16 step, u16 pooled steps, u32 span (samples), u32 period and
  u32 gap in clock units, u32 clock units per millisecond, u16 smoothing weight, u16 layout checksum (`layout_check`)
- for each measured channel: i32 lowest and i32 highest valid value, i32 zero
- for each input: u8 kind (0 channel, 1 magnitude, 2 gravity), u8 n, u8 shift of the running mean (else 0), n × u8
  measured channels
- self-calibration, only in images of such models: u8 sensors (1 to 64); for each, 3 × u8 measured channels (a single
  one three times), u8 binary logarithm of the samples in a block, plus 128 if it is no accelerometer
- vector layer: u8 vectors, u8 filters, u16 taps (all 0 without one); then for each vector: u8 shift + 16, and for each
  filter: u8 down, taps × u8 weight + 128
- 0 to 3 bytes 0, up to a multiple of 4 bytes from the beginning: scales and weights of all layers are then aligned
- for each input, or with a vector layer each of its outputs: i32 offset, i32 bias, u16 multiplier, u8 before, u8 after
- for each layer: u16 kernel, u16 dilation, u16 input channels, u16 filters; for each filter: i32 bias, u16 multiplier,
  u8 before, u8 after; then the weights, in blocks of 4 channels × 4 filters, ordered by group of 4 filters, tap, and
  group of 4 channels (both padded to a multiple of 4); in a block for the first, third, second and last channel: 3 × u8
  weight + 128, i8 weight of the last filter
- for each class: i32 bias, u16 multiplier, u8 before, u8 after; then classes × features weights + 128 as u8
- for each class: u8 affect (0 none, 1 positive, 2 neutral, 3 negative), plus 4 if the class is idle
- for each class: its label in UTF-8 and a 0; then the title of the model in UTF-8 and a 0
- events: u16 enter, leave, enter_affect, leave_affect, sure, i16 known, u16 least, switch, end, hold, rest, wait
- health: u16 fault_ms, still_ms, recover_ms, u8 whether limits follow, u8 0; then, for each measured channel: i32 low,
  i32 high
- gate: u8 signals, u8 rules (both 0 without rules); for each signal: u8 kind, u8 n, n × u8 inputs, u8 lag, u8 shift,
  u8 baseline, u8 noise, u32 floor; for each rule: u8 terms, u8 affect, u8 gesture, u8 within, u16 deaf; then for each
  of its terms: u8 signal, i8 sign, u8 times, u8 0, u32 threshold

Images with a self-calibration (`plushsense.windows.self_calibration`) have versions of their own, because its code is
compiled for such models only; so have those with the pooling ``mean+deviation``, whose dense layer has the weights of
the means, then of the deviations, for each class. Networks that compute a window again at every step (padding
``mirror``) have no image.

A patch replaces the dense layer of one image. Its head is that of an image with ``PLPT`` for ``PLSH``; then come the
u32 CRC-32 in the head of that image, and the two sections of the new dense layer as in an image.

The C library validates all of it: it refuses an image with an incomplete section, a span that does not fit the layers,
or a number outside the ranges of `IntegerModel`, `plushsense.runtime.fixed` and `plushsense.runtime.decisions`; of a
patch also one for another image.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ArchError, BundleError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import ACCELERATION, Layout
from plushsense.models.arch import Arch
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import AFFECT_CODES
from plushsense.runtime.fixed import PROBABILITY_BITS, LogitScale, Requantize
from plushsense.runtime.gate import JERK
from plushsense.runtime.integer import MOST_AXIS_SHIFT, IntegerNetwork, IntegerVectors

MAGIC = b"PLSH"
PATCH_MAGIC = b"PLPT"
# 2: settings of events, gate and health; 3: zeros and the vector layer; 4: another known score; 6: aligned weights
# 10: four filters in a word
IMAGE_VERSION = 10
CALIBRATED = 1  # added to the version of a model with a self-calibration
DEVIATING = 2  # added to the version of a model with the pooling mean+deviation
_WINDOW_VERSIONS = (7, 9)  # once of networks that computed a window again at every step
_OTHER_SENSOR = 128  # added to the shift of a sensor that is no accelerometer
SENSOR_BYTES = 200  # of the state of a sensor that calibrates itself
HEAD_BYTES = 16
IDLE_BIT = 4
GROUP = 4  # number of filters, and of channels, in a block of weights
_CHANNELS = [0, 2, 1, 3]  # their order in a block
_CODES = np.array([128, 128, 128, 0], dtype=np.uint8)  # what is added to the weights of its filters
SPARE = 4  # rows for new samples in each phase of a streaming layer
MOST_TAPS = 255  # of a vector layer
MOST_ROWS = (1 << 16) - 1 - SPARE  # samples that a layer remembers
_DENSE = "dense layer"  # how the descriptions of its sections begin
_INPUT_KINDS = ("channel", "magnitude", "gravity")
MOST_CLOCK_UNITS = 1 << 22  # limit for gap and period of the clock: interpolation then needs at most 32 bits
MOST_BRIDGED = 1000  # samples in a gap, all of which one call of ``plush_push`` computes


@dataclass(frozen=True, eq=False)
class IntegerModel:
    """A model that can be deployed: integer network, layout, gestures and decision settings.

    ``smoothing`` is the weight of a new step, in units of 2^-15 (`plushsense.runtime.fixed.smoothing_weight`).

    Raises:
        BundleError: if the parts do not fit together, or exceed the limits of the toy.
    """

    network: IntegerNetwork
    layout: Layout
    gestures: GestureSet
    smoothing: int
    rules: Rules = field(default_factory=Rules)

    def __post_init__(self) -> None:
        arch = self.network.arch
        if (self.layout.n_inputs, len(self.gestures)) != (arch.channels, arch.classes):
            raise BundleError(
                f"The model does not fit together: {self.layout.n_inputs} inputs and {len(self.gestures)} gestures, "
                f"{arch.title} needs {arch.channels} and {arch.classes}."
            )
        for name, found in (
            ("measured channels", len(self.layout.channels)),
            ("inputs", arch.channels),
            ("gestures", arch.classes),
        ):
            if found > 255:
                raise BundleError(f"The model has {found} {name}: in the toy there may be at most 255.")
        for n, layer in enumerate(arch.layers, 1):
            if layer.reach + 1 > MOST_ROWS:
                raise BundleError(
                    f"Layer {n} of {arch.title} remembers {layer.reach + 1} samples: in the toy there may be at most "
                    f"{MOST_ROWS}, so take a shorter kernel or a smaller dilation."
                )
        if arch.vector is not None and arch.vector.kernel > MOST_TAPS:
            raise BundleError(
                f"The vector layer of {arch.title} has kernels of {arch.vector.kernel} taps: in the toy there may be "
                f"at most {MOST_TAPS}."
            )
        if arch.blocks >= 1 << 16:
            raise BundleError(
                f"{arch.title} pools {arch.blocks} steps: in the toy there may be at most 65535, so take "
                "a smaller pool or a longer step."
            )
        if not 1 <= self.smoothing <= 1 << PROBABILITY_BITS:
            raise BundleError(
                f"The smoothing weight is {self.smoothing}: accepted are 1 to {1 << PROBABILITY_BITS} (no smoothing)."
            )
        bridged = (MOST_BRIDGED + 1) * self.layout.period_us - 1
        most_ms = min(MOST_CLOCK_UNITS // self._units_per_ms, bridged // 1000)
        if not 1 <= self.layout.gap_ms <= most_ms:
            raise BundleError(
                f"Layout '{self.layout.name}' bridges gaps of {self.layout.gap_ms} ms: at {self.layout.rate_hz:g} Hz "
                f"the toy accepts 1 to {most_ms} ms."
            )
        for derived in self.layout.derived:
            if len(derived.of) > 255:
                raise BundleError(
                    f"Channel '{derived.name}' is made of {len(derived.of)} others: the toy takes at most 255."
                )
        self.rules.check(len(self.layout.channels), arch.channels, arch.classes)
        for gesture in self.gestures.gestures:
            if "\0" in gesture.label or gesture.label.encode(errors="replace").decode() != gesture.label:
                raise BundleError(f"The gesture {gesture.label!r} has a character that the toy cannot keep: rename it.")

    @property
    def image_version(self) -> int:
        """Version of the image, and of a patch of it."""
        version = IMAGE_VERSION + CALIBRATED * bool(self.layout.self_calibration)
        return version + DEVIATING * (self.network.arch.pooling != "mean")

    @property
    def _units_per_ms(self) -> int:
        """Clock units per millisecond: the smallest number for which the period is a whole number of units."""
        return 1000 // math.gcd(1000, self.layout.period_us)

    def sections(self) -> list[tuple[str, bytes]]:
        """Return the sections after the head as pairs of description and bytes.

        Raises:
            ArchError: for a network that has no C (`refuse_image`).
        """
        refuse_image(self.network.arch)
        sections = [*self._sizes(), *self._inputs(), *_vectors(self.network.vectors)]
        sections.append(("filling up to a multiple of 4 bytes", bytes(-sum(len(piece) for _, piece in sections) % 4)))
        return [*sections, *self._layers(), *self._classes(), *_rules(self.rules)]

    def _sizes(self) -> list[tuple[str, bytes]]:
        """Return the section of sizes and times."""
        arch, layout, units_per_ms = self.network.arch, self.layout, self._units_per_ms
        return [
            (
                "layers, channels, inputs, classes; step, blocks; span; period, gap, units a ms; smoothing, layout",
                struct.pack(
                    "<BBBBHHIIIIHH",
                    len(arch.layers),
                    len(layout.channels),
                    arch.channels,
                    arch.classes,
                    arch.step,
                    arch.blocks,
                    arch.span,
                    layout.period_us * units_per_ms // 1000,
                    layout.gap_ms * units_per_ms,
                    units_per_ms,
                    self.smoothing,
                    layout_check(layout),
                ),
            )
        ]

    def _inputs(self) -> list[tuple[str, bytes]]:
        """Return the sections of measured channels and inputs, and of the self-calibration."""
        layout, sections = self.layout, list[tuple[str, bytes]]()
        edges = zip(layout.names, layout.valid_min_int, layout.valid_max_int, layout.zero_int, strict=True)
        for name, low, high, zero in edges:
            title = f"channel '{name}': valid from {low} to {high}, zero at {zero}"
            sections.append((title, struct.pack("<iii", low, high, zero)))
        derived = {d.name: d for d in layout.derived}
        for name in layout.inputs:
            kind = derived[name].kind if name in derived else "channel"
            parts = [layout.index(part) for part in (derived[name].of if name in derived else (name,))]
            shift = layout.gravity_shift if kind == "gravity" else 0
            source = bytes([_INPUT_KINDS.index(kind), len(parts), shift, *parts])
            sections.append((f"input '{name}': {kind}, measured channels", source))
        if layout.self_calibration:
            plan = [bytes([len(layout.calibrated_sensors)])]
            for axes in layout.calibrated_sensors:
                other = _OTHER_SENSOR * (layout.channels[axes[0]].kind != ACCELERATION)
                plan.append(bytes([*(axes if len(axes) > 1 else 3 * axes), layout.calibration_shift + other]))
            title = "self-calibration: sensors; measured channels, shift of a block and kind of each"
            sections.append((title, b"".join(plan)))
        return sections

    def _layers(self) -> list[tuple[str, bytes]]:
        """Return the sections of scaling, layers and dense layer."""
        arch, sections = self.network.arch, list[tuple[str, bytes]]()
        scale = self.network.inputs
        for i in range(len(scale)):
            row = (int(getattr(scale, n)[i]) for n in ("offset", "bias", "multiplier", "before", "after"))
            title = f"channel {i + 1} of the network: offset, bias, multiplier, shifts"
            sections.append((title, struct.pack("<iiHBB", *row)))
        for n, (layer, read, part) in enumerate(zip(arch.layers, arch.inputs, self.network.layers, strict=True), 1):
            shape = struct.pack("<HHHH", layer.kernel, layer.dilation, read, layer.filters)
            sizes = f"kernel {layer.kernel}, dilation {layer.dilation}, reads {read} channels, {layer.filters} filters"
            sections.append((f"layer {n}: {sizes}", shape))
            sections.append((f"layer {n}: bias, multiplier, shifts of each filter", _scales(part.bias, part.scale)))
            for first, group in enumerate(grouped_weights(part.weights)):
                last = min(GROUP * first + GROUP, layer.filters)
                title = f"layer {n}: weights of filters {GROUP * first + 1} to {last}, tap by tap"
                sections.append((title, group.tobytes()))
        dense = self.network.dense
        sections.append((f"{_DENSE}: bias, multiplier, shifts of each class", _scales(dense.bias, dense.scale)))
        sections.append(
            (f"{_DENSE}: weights of each class", (dense.weights.astype(np.int16) + 128).astype(np.uint8).tobytes())
        )
        return sections

    def _classes(self) -> list[tuple[str, bytes]]:
        """Return the sections of affects, labels and title."""
        arch, sections = self.network.arch, list[tuple[str, bytes]]()
        affects = bytes(AFFECT_CODES[g.affect] + (IDLE_BIT if g.idle else 0) for g in self.gestures.gestures)
        sections.append(("affect of each class, 4 more when it is idle", affects))
        for gesture in self.gestures.gestures:
            idle = ", idle" if gesture.idle else ""
            sections.append((f"class '{gesture.label}', {gesture.affect}{idle}", gesture.label.encode() + b"\0"))
        sections.append((f"title '{arch.title}'", arch.title.encode() + b"\0"))
        return sections

    def to_bytes(self) -> bytes:
        """Return the bytes of the image."""
        body = b"".join(piece for _, piece in self.sections())
        return image_head(body, version=self.image_version) + body


def _vectors(vectors: IntegerVectors | None) -> list[tuple[str, bytes]]:
    """Return the sections of the vector layer."""
    if vectors is None:
        return [("no vector layer", bytes(4))]
    layer = vectors.layer
    sections = [("vector layer: vectors, filters, taps", struct.pack("<BBH", *vectors.weights.shape))]
    for number, shift in enumerate(vectors.shift.tolist()):
        sections.append((f"vector {number + 1}: shift of its axes", bytes([shift + MOST_AXIS_SHIFT])))
        for k in range(layer.filters):
            weights = (vectors.weights[number, k].astype(np.int16) + 128).astype(np.uint8)
            title = f"vector {number + 1}: shift and weights of filter {k + 1}"
            sections.append((title, bytes([int(vectors.down[number, k])]) + weights.tobytes()))
    return sections


def _rules(rules: Rules) -> list[tuple[str, bytes]]:
    events, health, gate = rules.events, rules.health, rules.gate
    settings = asdict(events)
    packed = b"".join(struct.pack("<h" if name == "known" else "<H", value) for name, value in settings.items())
    sections = [(f"events: {', '.join(settings)}", packed)]
    times = struct.pack("<HHHBB", health.fault_ms, health.still_ms, health.recover_ms, bool(health.low), 0)
    sections.append(("health: fault, still, recover (ms), whether limits follow", times))
    if health.low:
        limits = b"".join(struct.pack("<ii", *pair) for pair in zip(health.low, health.high, strict=True))
        sections.append(("health: lowest and highest value of each channel that touches reach", limits))
    if not gate.rules:
        return [*sections, ("gate: no signals, no rules", bytes(2))]
    sections.append(("gate: signals, rules", bytes([len(gate.signals), len(gate.rules)])))
    for n, s in enumerate(gate.signals, 1):
        row_head = bytes([s.kind, len(s.inputs), *s.inputs, s.lag, s.shift, s.baseline, s.noise])
        title = f"gate: signal {n}, {'jerk' if s.kind == JERK else 'level'}; inputs, lag, shift, baseline, noise, floor"
        sections.append((title, row_head + struct.pack("<I", s.floor)))
    for n, r in enumerate(gate.rules, 1):
        row_head = struct.pack("<BBBBH", len(r.terms), r.affect, r.gesture, r.within, r.deaf)
        sections.append((f"gate: rule {n}: terms, affect, gesture, within, deaf", row_head))
        terms = b"".join(struct.pack("<BbBBI", t.signal, t.sign, t.times, 0, t.threshold) for t in r.terms)
        sections.append((f"gate: rule {n}: signal, sign, times, threshold of each term", terms))
    return sections


def refuse_image(arch: Arch) -> None:
    """Raise ArchError for a network that has no image, and no C, with the option to train it with."""
    if arch.padding != "stream":
        raise ArchError(
            "{arch} has the padding '{padding}', with which a toy would compute the whole window again at every "
            "step: train --arch {symbol} --filters {filters} --padding stream{value}, and export that.",
            arch=arch.title,
            padding=arch.padding,
            symbol=arch.symbol,
            filters=",".join(map(str, arch.filters)),
            value=" --norm batch" * (arch.norm == "layer"),
        )


def layout_check(layout: Layout) -> int:
    """Return a 16-bit checksum of names, units and steps of the measured channels, in order."""
    channels = json.dumps([[c.name, c.unit, c.step] for c in layout.channels])
    return zlib.crc32(channels.encode()) & 0xFFFF


def image_head(body: bytes, magic: bytes = MAGIC, version: int = IMAGE_VERSION) -> bytes:
    """Return the 16-byte head for the body of an image, or of a patch."""
    return magic + struct.pack("<HHII", version, 0, len(body) + HEAD_BYTES, zlib.crc32(body))


def image_check(image: bytes) -> int:
    """Return the CRC-32 in the head of an image.

    Raises:
        BundleError: for bytes that are no image of this version.
    """
    if image[:6] in [MAGIC + struct.pack("<H", v) for v in _WINDOW_VERSIONS]:
        raise BundleError(
            "The image is that of a window network, which has no C any more: train the network with --padding stream "
            "and export it."
        )
    versions = range(IMAGE_VERSION, IMAGE_VERSION + CALIBRATED + DEVIATING + 1)
    if image[:HEAD_BYTES] not in [image_head(image[HEAD_BYTES:], version=v) for v in versions]:
        raise BundleError("The image is damaged, or of another version of PlushSense: export the model again.")
    return int(struct.unpack_from("<I", image, HEAD_BYTES - 4)[0])


def patch_bytes(original: bytes | IntegerModel, adapted: IntegerModel) -> bytes:
    """Return the patch by which a toy with the image of ``original`` runs the dense layer of ``adapted``.

    Raises:
        BundleError: for bytes that are no image of this version, or if the two differ in more than the dense layer.
    """
    image = original if isinstance(original, bytes) else original.to_bytes()
    body, at = struct.pack("<I", image_check(image)), HEAD_BYTES
    for title, piece in adapted.sections():
        if title.startswith(_DENSE):
            body += piece
        elif image[at : at + len(piece)] != piece:
            raise BundleError(
                f"The adapted model differs from the image in more than the dense layer, first in '{title}': adapt the "
                "bundle from which the image was exported (model.plush beside it)."
            )
        at += len(piece)
    return image_head(body, PATCH_MAGIC, adapted.image_version) + body


def memory_bytes(model: IntegerModel) -> int:
    """Return the bytes that a toy needs besides its ``plush_toy`` struct; equal to ``plush_memory_bytes`` in C."""
    arch, channels = model.network.arch, len(model.layout.channels)
    filters = arch.layers[-1].filters
    gate = model.rules.gate
    pieces = [4 * channels] * 3  # held, before, the sample being made
    pieces.append(4 * model.layout.input_kinds.count("gravity"))  # running means
    if arch.vector is not None:
        pieces.append(0 if gate.rules else 4 * arch.channels)  # inputs
        pieces += [6 * arch.vector.vectors * arch.vector.kernel, 12 * arch.vector.filters]  # axes, horizontal parts
    for layer, read in zip(arch.layers, arch.inputs, strict=True):
        dilation = layer.dilation if layer.kernel > 1 else 1
        pieces.append(dilation * (layer.kernel + SPARE) * _filled(read))
        pieces.append(4 * dilation)  # sums under the taps
    pieces.append(2 * filters * arch.blocks)
    # Inputs of the dense layer, logits, smoothed probabilities and known.
    pieces += [4 * arch.features, 4 * arch.classes, 4 * arch.classes + 4]
    pieces += [channels, 2 * filters]  # which channels are valid, and the newest features of two positions
    health = model.rules.health
    if health.low or health.still_ms:
        pieces.append(4 * channels)  # the frame before
    if sensors := len(model.layout.calibrated_sensors):
        pieces.append(SENSOR_BYTES * sensors + 4)
    if gate.rules:
        past = max((s.lag for s in gate.signals if s.kind == JERK), default=1)
        pieces.append(4 * arch.channels * (past + 1))  # inputs
        pieces.append(12 * len(gate.signals))  # baseline, noise, size
        terms = sum(len(rule.terms) for rule in gate.rules)
        pieces += [2 * terms, terms]  # how long each holds, how many in a row
    return sum(_filled(piece) for piece in pieces)


def _filled(n: int) -> int:
    return -(-n // GROUP) * GROUP


def _scales(bias: NDArray[np.int64], scale: Requantize | LogitScale) -> bytes:
    rows = zip(bias, scale.multiplier, scale.before, scale.after, strict=True)
    return b"".join(struct.pack("<iHBB", *(int(v) for v in row)) for row in rows)


def grouped_weights(weights: NDArray[np.int8]) -> NDArray[np.uint8]:
    """Return weights (F, C, K) in the order and codes of the image, (⌈F/4⌉, K, ⌈C/4⌉, 4, 4); the padding is 0."""
    f, c, k = weights.shape
    full = np.zeros((_filled(f), _filled(c), k), dtype=np.int8)
    full[:f, :c] = weights
    split = full.reshape(len(full) // GROUP, GROUP, full.shape[1] // GROUP, GROUP, k).transpose(0, 4, 2, 3, 1)
    return np.ascontiguousarray(split[..., _CHANNELS, :]).view(np.uint8) ^ _CODES
