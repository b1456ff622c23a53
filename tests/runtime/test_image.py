"""The image that the toy reads: its bytes, read back by hand, and what a toy could not hold."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from plushsense.core.errors import ArchError, BundleError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import Channel, CsvFormat, Derived, Layout, load_layout
from plushsense.models.arch import Arch, ConvLayer
from plushsense.runtime.decisions import Rules
from plushsense.runtime.events import AFFECT_CODES, NO_GESTURE
from plushsense.runtime.gate import JERK, LEVEL, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import (
    IntegerModel,
    grouped_weights,
    image_check,
    image_head,
    layout_check,
    memory_bytes,
)
from support.integers import any_network, models, plain_model, window_model


class Reader:
    """Bytes one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        found = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return found

    def text(self) -> str:
        end = self.data.index(0, self.at)
        found, self.at = self.data[self.at : end].decode(), end + 1
        return found


@settings(max_examples=25)
@given(models(longest=300))
@pytest.mark.slow
def test_read_back(model: IntegerModel) -> None:
    """By the table of the module's docstring, and by nothing else."""
    image = model.to_bytes()
    network, layout, arch = model.network, model.layout, model.network.arch
    magic, version, zero, length, crc = struct.unpack_from("<4sHHII", image)
    assert (magic, version, zero, length) == (b"PLSH", 10 if arch.pooling == "mean" else 12, 0, len(image))
    assert crc == zlib.crc32(image[16:])
    r = Reader(image[16:])
    head = r.take("BBBBHHIIIIHH")
    assert head[:4] == (len(arch.layers), len(layout.channels), arch.channels, arch.classes)
    assert head[4:7] == (arch.step, arch.pooled // arch.step, arch.span)
    period, gap, units, smoothing, check = head[7:]
    assert period * 1000 == layout.period_us * units
    assert gap == layout.gap_ms * units
    assert (smoothing, check) == (model.smoothing, layout_check(model.layout))
    for channel in layout.channels:
        assert r.take("iii") == (channel.valid_min, channel.valid_max, channel.offset)
    derived = {d.name: d for d in layout.derived}
    for name in layout.inputs:
        kind, n, shift = r.take("BBB")
        parts = r.take(f"{n}B")
        assert ("channel", "magnitude", "gravity")[kind] == (derived[name].kind if name in derived else "channel")
        assert [layout.channels[p].name for p in parts] == list(derived[name].of if name in derived else (name,))
        assert shift == (layout.gravity_shift if kind == 2 else 0)
    vectors = network.vectors
    assert r.take("BBH") == ((0, 0, 0) if vectors is None else vectors.weights.shape)
    for v in range(0 if vectors is None else len(vectors.shift)):
        assert r.take("B")[0] - 16 == vectors.shift[v]
        for k, weights in enumerate(vectors.weights[v]):
            assert r.take("B")[0] == vectors.down[v, k]
            assert [w - 128 for w in r.take(f"{len(weights)}B")] == weights.tolist()
    while (16 + r.at) % 4:
        assert r.take("B") == (0,)
    scale = network.inputs
    for i in range(len(scale)):
        assert r.take("iiHBB") == tuple(
            int(column[i]) for column in (scale.offset, scale.bias, scale.multiplier, scale.before, scale.after)
        )
    for layer, read, part in zip(arch.layers, arch.inputs, network.layers, strict=True):
        assert r.take("HHHH") == (layer.kernel, layer.dilation, read, layer.filters)
        for f in range(layer.filters):
            s = part.scale
            assert r.take("iHBB") == tuple(int(c[f]) for c in (part.bias, s.multiplier, s.before, s.after))
        for group in range(0, layer.filters, 4):
            for tap in range(layer.kernel):
                for channel in range(0, read, 4):
                    for c in (channel, channel + 2, channel + 1, channel + 3):
                        codes = r.take("BBBb")
                        for f, zero in enumerate((128, 128, 128, 0)):
                            inside = group + f < layer.filters and c < read
                            assert codes[f] - zero == (part.weights[group + f, c, tap] if inside else 0)
    for k in range(arch.classes):
        s = network.dense.scale
        assert r.take("iHBB") == tuple(int(c[k]) for c in (network.dense.bias, s.multiplier, s.before, s.after))
    for row in network.dense.weights:
        assert [v - 128 for v in r.take(f"{len(row)}B")] == row.tolist()
    for gesture in model.gestures.gestures:
        assert r.take("B") == (AFFECT_CODES[gesture.affect] + 4 * gesture.idle,)
    assert [r.text() for _ in model.gestures.gestures] == list(model.gestures.labels)
    assert r.text() == arch.title
    events, health, gate = model.rules.events, model.rules.health, model.rules.gate
    assert r.take("HHHHH") == (events.enter, events.leave, events.enter_affect, events.leave_affect, events.sure)
    assert r.take("h") == (events.known,)
    assert r.take("HHHHHH") == (events.least, events.switch, events.end, events.hold, events.rest, events.wait)
    assert r.take("HHHBB") == (health.fault_ms, health.still_ms, health.recover_ms, bool(health.low), 0)
    for limits in zip(health.low, health.high, strict=True):
        assert r.take("ii") == limits
    assert r.take("BB") == ((len(gate.signals), len(gate.rules)) if gate.rules else (0, 0))
    for s in gate.signals:
        assert r.take("BB") == (s.kind, len(s.inputs))
        assert r.take(f"{len(s.inputs)}B") == s.inputs
        assert r.take("BBBBI") == (s.lag, s.shift, s.baseline, s.noise, s.floor)
    for rule in gate.rules:
        assert r.take("BBBBH") == (len(rule.terms), rule.affect, rule.gesture, rule.within, rule.deaf)
        for t in rule.terms:
            assert r.take("BbBBI") == (t.signal, t.sign, t.times, 0, t.threshold)
    assert r.at == len(r.data)
    titles = [title for title, _ in model.sections() if title.startswith("gate: signal ")]
    kinds = [("level", "jerk")[s.kind] for s in gate.signals if gate.rules]
    assert [title.split(";")[0] for title in titles] == [f"gate: signal {n}, {k}" for n, k in enumerate(kinds, 1)]


def test_weights_of_every_size_fit_a_byte() -> None:
    weights = np.arange(-128, 128, dtype=np.int8).reshape(4, 4, 16)
    codes = grouped_weights(weights) ^ np.array([128, 128, 128, 0], dtype=np.uint8)
    assert sorted(codes.view(np.int8).ravel().tolist()) == list(range(-128, 128))


PULL = Rule((Term(0, 16),), 3, NO_GESTURE)


def test_memory_of_the_papers_network() -> None:
    """Issue 5 allows 6 KB, with the bytes of a plush_toy."""
    axes = tuple(Channel(a, "raw", "motion", valid_min=-40_000, valid_max=40_000) for a in "xyz")
    touch = tuple(Channel(f"c{i}", "raw", "touch") for i in range(10))
    names = tuple(c.name for c in (*touch, *axes))
    layout = Layout(
        "plush",
        "Plush",
        100.0,
        (*touch, *axes),
        ("device_ms", *names),
        (Derived("m", "magnitude", ("x", "y", "z")),),
        (*names[:10], "m"),
        CsvFormat(("device_ms",), ("device_ms",), ","),
    )
    arch = Arch.parse("14d1_39d2_41d4", (8, 12, 16))
    gestures = GestureSet("18", tuple(Gesture(f"g{i}") for i in range(18)))
    model = IntegerModel(any_network(arch, layout, np.random.default_rng(1)), layout, gestures, 5000)
    assert memory_bytes(model) == 5108
    most = Rules(
        health=HealthSettings((0,) * 13, (1,) * 13), gate=GateSettings((Signal(JERK, (1, 2), 16),), (PULL, PULL))
    )
    # The frame before; 17 samples of 11 inputs, a signal, and two terms.
    assert memory_bytes(other(model, rules=most)) == 5108 + 4 * 13 + 4 * 11 * 17 + 12 + 4 + 4
    rings = 14 * 12 + 77 * 8 + 161 * 12
    assert memory_bytes(model) > rings + 2 * 16 * 50
    assert arch.state_bytes_int8 < memory_bytes(model)


def other(model: IntegerModel, **changes: Any) -> IntegerModel:
    return dataclasses.replace(model, **changes)


def test_what_a_toy_cannot_hold() -> None:
    model = plain_model()
    layout, gestures = model.layout, model.gestures.gestures
    odd = dataclasses.replace(layout, rate_hz=104.0)  # a period of 9615 us: 200 units a ms
    other(model, layout=dataclasses.replace(odd, gap_ms=9624)).to_bytes()
    with pytest.raises(BundleError, match="at 104 Hz the toy accepts 1 to 9624 ms"):
        other(model, layout=dataclasses.replace(odd, gap_ms=9625))
    for smoothing in (0, -1, 32769):
        with pytest.raises(BundleError, match="accepted are 1 to 32768"):
            other(model, smoothing=smoothing)
    for label in ("a\0b", "half of \ud800"):
        wrong = GestureSet("wrong", (Gesture(label), *gestures[1:]))
        with pytest.raises(BundleError, match="rename it"):
            other(model, gestures=wrong)
    for rules, words in (
        (Rules(health=HealthSettings((0,), (1,))), "limits are of 1 channels, the layout has 4"),
        (Rules(gate=GateSettings((Signal(LEVEL, (2,)),), (PULL,))), "an unknown input: the model has 2"),
        (
            Rules(gate=GateSettings((Signal(LEVEL, (1,)),), (replace(PULL, gesture=3),))),
            "an unknown gesture: the model has 3",
        ),
    ):
        with pytest.raises(BundleError, match=words):
            other(model, rules=rules)
    with pytest.raises(BundleError, match="2 gestures"):
        other(model, gestures=GestureSet("few", gestures[:2]))


def made(layers: tuple[ConvLayer, ...], **settings_: Any) -> IntegerModel:
    plain = plain_model()
    arch = Arch(layers, channels=2, **({"classes": 3, "step": 1, "pool": 1} | settings_))
    gestures = GestureSet("many", tuple(Gesture(f"g{i}") for i in range(arch.classes)))
    return IntegerModel(any_network(arch, plain.layout, np.random.default_rng(1)), plain.layout, gestures, 1)


def test_counts_that_do_not_fit_their_bits() -> None:
    made((ConvLayer(32, 2113, 1),)).to_bytes()  # 65504 samples
    with pytest.raises(BundleError, match="Layer 1 of 18d3855 1 remembers 65536 samples"):
        made((ConvLayer(18, 3855, 1),))
    made((ConvLayer(2, 1, 1),), pool=65535).to_bytes()
    with pytest.raises(BundleError, match="pools 65536 steps"):
        made((ConvLayer(2, 1, 1),), pool=65536)
    made((ConvLayer(2, 1, 1),), classes=255).to_bytes()
    with pytest.raises(BundleError, match="256 gestures: in the toy"):
        made((ConvLayer(2, 1, 1),), classes=256)
    # As many filters as an architecture may have.
    made((ConvLayer(1, 1, 4096), ConvLayer(1, 1, 1))).to_bytes()


def test_a_network_that_computes_windows_again_has_no_image() -> None:
    again = "train --arch 5d2_4d3 --filters 6,5 --padding stream, and export that"
    with pytest.raises(ArchError, match=f"has the padding 'mirror', .* at every step: {again}"):
        window_model().to_bytes()
    body = plain_model().to_bytes()[16:]
    for version in (7, 9):
        with pytest.raises(BundleError, match="that of a window network, .* train the network with --padding stream"):
            image_check(image_head(body, version=version) + body)


def test_the_layout_check_tells_other_channels() -> None:
    plain = load_layout("accel-3")
    assert layout_check(plain) == layout_check(replace(plain, name="mine", rate_hz=50.0, gap_ms=200))
    x, y, z = plain.channels
    others = [(y, x, z), (replace(x, name="w"), y, z), (replace(x, unit="g"), y, z), (replace(x, step=0.5), y, z)]
    seen = {layout_check(SimpleNamespace(channels=each)) for each in others}  # type: ignore[arg-type]
    assert len(seen | {layout_check(plain)}) == 5
