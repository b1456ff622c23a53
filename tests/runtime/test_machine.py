"""Stream = batch: a decision is the network's answer to the window that ends at the same even sample."""

from __future__ import annotations

import math

import numpy as np
import pytest

from plushsense.core.errors import ArrayError, BundleError, ConfigError
from plushsense.core.layouts import Layout, load_layout
from plushsense.devices.base import Frame
from plushsense.runtime.classifier import StreamClassifier, check_layout, whole_frame
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ONE
from plushsense.runtime.fixed import integer_logits, smooth, smoothing_weight, softmax
from plushsense.windows.clock import resample
from plushsense.windows.features import network_inputs

OFF = DecideSpec(smoothing_s=0)


def played(frames):
    for host, device, values in zip(frames.host_ms, frames.device_ms, frames.values, strict=True):
        yield Frame(int(host), int(device), tuple(int(v) for v in values))


def decisions(classifier, frames):
    """Those of the steps: that the signal was lost is said between them."""
    every = [decision for frame in played(frames) for decision in classifier.push(frame)]
    return [d for d in every if d.state != "no signal"]


def expected(bundle, frames):
    """(segment, sample, probabilities or None) of each decision, from the batch clock and whole windows; the
    probabilities (K,) in steps of 2^-15 as the toy computes them from rounded logits."""
    network, arch = bundle.network(), bundle.arch
    for segment in resample(frames, bundle.layout):
        x = bundle.scaler.apply(network_inputs(segment.data, bundle.layout).T[None])
        for n in range(1, len(segment) + 1):
            if n >= arch.span and (n - arch.span) % arch.step == 0:
                yield segment, n - 1, softmax(integer_logits(network.forward(x[:, :, n - arch.span : n])[0]))
            elif n < arch.span and (arch.span - n) % arch.step == 0:
                yield segment, n - 1, None


@pytest.mark.parametrize("padding", ["stream", "causal", "mirror"])
@pytest.mark.parametrize("layout", ["accel-3", "plush-15"])
@pytest.mark.slow
def test_decisions_are_those_of_whole_windows_across_gaps_and_resets(bundle, frames, padding, layout):
    model, source = bundle(padding, layout), frames(layout)
    found = decisions(StreamClassifier(model, OFF), source)
    wanted = list(expected(model, source))
    assert len(found) == len(wanted)
    assert len({segment.start_us for segment, _, _ in wanted}) == 3
    assert sum(probabilities is not None for _, _, probabilities in wanted) > 50
    for decision, (_, _, probabilities) in zip(found, wanted, strict=True):
        if probabilities is None:
            assert decision.state == "warming"
            assert decision.gesture is decision.affect is decision.confidence is decision.probabilities is None
        else:
            assert decision.state == "tracking"
            np.testing.assert_array_equal(np.array(decision.probabilities) * ONE, probabilities)
            best = int(np.argmax(probabilities))
            assert decision.gesture == model.gestures.labels[best]
            assert decision.affect == model.gestures.affects[best]
            assert decision.confidence == probabilities.max() / ONE


def test_the_answers_are_worth_comparing(bundle, frames):
    found = [d for d in decisions(StreamClassifier(bundle(), OFF), frames()) if d.state == "tracking"]
    assert len({d.gesture for d in found}) > 1
    table = np.array([d.probabilities for d in found])
    assert np.abs(np.diff(table, axis=0)).max(axis=1).min() > 1e-6


def test_time_is_that_of_the_newest_sample_and_goes_on_over_a_clock_reset(bundle, frames):
    model, source = bundle(), frames()
    found = decisions(StreamClassifier(model, OFF), source)
    first = int(source.device_ms[0])
    for decision, (segment, n, _) in zip(found, expected(model, source), strict=True):
        at_ms = (segment.start_us + n * segment.period_us) / 1000
        if segment.first_row >= 331:  # row 330 is left out
            at_ms += int(source.device_ms[329]) - int(source.device_ms[331]) + model.layout.period_us / 1000
        assert decision.t_s == pytest.approx((at_ms - first) / 1000, abs=1e-9)
    times = [d.t_s for d in found]
    assert times == sorted(times)


def test_a_restart_warms_up_again_for_the_whole_span_and_forgets_the_smoothing(bundle, frames):
    model, source = bundle(), frames()
    spec = DecideSpec(smoothing_s=2.0)
    classifier = StreamClassifier(model, spec)
    found = decisions(classifier, source)
    assert classifier.restarts == 2
    weight, mean, last = smoothing_weight(2.0, classifier.step_s), None, None
    for decision, (segment, _, raw) in zip(found, expected(model, source), strict=True):
        if segment.start_us != last:
            mean, last = None, segment.start_us
            assert decision.state == "warming"
        if raw is not None:
            mean = smooth(mean, raw, weight)
            np.testing.assert_array_equal(np.array(decision.probabilities) * 2.0**27, mean)


def test_a_stream_of_even_frames_decides_every_step(bundle):
    classifier = StreamClassifier(bundle(), OFF)
    out = [(i, d) for i in range(400) for d in classifier.push(Frame(0, i * 10, (i % 50, 3, -i % 9)))]
    ticks = [i for i, _ in out]
    assert set(np.diff(ticks)) == {5}
    first = next(i for i, d in out if d.state == "tracking")
    assert first == classifier.bundle.arch.span - 1
    assert np.allclose(np.diff([d.t_s for _, d in out]), classifier.step_s)
    assert classifier.step_s == 0.05


def test_garbage_values_are_counted_and_the_last_valid_one_stands_in(bundle):
    clean, dirty = (StreamClassifier(bundle(), OFF) for _ in range(2))
    for i in range(200):
        good = (i, i // 3, 7)
        held = (i, 31, 7) if 96 <= i < 100 else good
        bad = (i, 99_999, 7) if 96 <= i < 100 else good
        if i == 95:
            good = held = bad = (i, 31, 7)
        a, b = clean.push(Frame(0, i * 10, held)), dirty.push(Frame(0, i * 10, bad))
        assert a == b
    assert (clean.invalid, dirty.invalid) == (0, 4)


def test_a_reset_begins_a_new_stream(bundle, frames):
    source = frames()
    classifier = StreamClassifier(bundle())
    once = decisions(classifier, source)
    classifier.reset()
    assert (classifier.restarts, classifier.invalid, classifier.time_s) == (0, 0, 0.0)
    assert decisions(classifier, source) == once


def test_the_bundle_settles_the_smoothing_unless_told_otherwise(bundle):
    assert StreamClassifier(bundle(smoothing_s=1.5)).spec.smoothing_s == 1.5
    assert StreamClassifier(bundle(smoothing_s=1.5), OFF).spec.smoothing_s == 0
    with pytest.raises(ConfigError, match="smoothing_s"):
        StreamClassifier(bundle(smoothing=1.5))


def test_rules_of_another_model_are_refused(bundle):
    signals = [{"kind": 0, "inputs": [200]}]
    rules = [{"terms": [{"signal": 0, "threshold": 9}], "affect": 1, "gesture": 255}]
    for settings, why in (
        ({"gate": {"signals": signals, "rules": rules}}, "unknown input"),
        ({"gate": {"signals": [{**signals[0], "inputs": [0]}], "rules": [{**rules[0], "gesture": 90}]}}, "gesture"),
        ({"health": {"low": [0], "high": [9]}}, "limits are of 1 channels"),
    ):
        with pytest.raises(BundleError, match=why):
            StreamClassifier(bundle(**settings))


def test_a_line_is_plain_json(bundle, frames):
    lines = [d.to_dict() for d in decisions(StreamClassifier(bundle()), frames())]
    assert list(lines[0]) == ["t_s", "gesture", "affect", "confidence", "source", "state", "answer", "events"]
    assert lines[0]["confidence"] is None and lines[0]["source"] == "cnn"
    assert all(type(v) in (float, str, list, type(None)) for line in lines for v in line.values())
    assert all(0 <= line["confidence"] <= 1 for line in lines if line["confidence"] is not None)
    assert not any(math.isnan(line["t_s"]) for line in lines)


def test_a_device_of_another_layout_is_refused_in_one_sentence():
    accel, plush, older, phone = (load_layout(n) for n in ("accel-3", "plush-15", "plush-14", "phone-6"))
    check_layout(accel, accel)
    check_layout(older, plush)
    with pytest.raises(ConfigError, match=r"'accel-3' \(x, y, z\).*'plush-15'.*\?layout=plush-15"):
        check_layout(accel, plush)
    with pytest.raises(ConfigError, match="phone-6"):
        check_layout(plush, phone)
    table = accel.to_dict()
    table["channels"][1]["step"] = 0.5
    with pytest.raises(ConfigError, match="channel 'y' has another unit, scale, step"):
        check_layout(type(accel).from_dict(table), accel)


def test_push_takes_whole_steps_only() -> None:
    layout = Layout.from_dict(
        {
            "name": "press",
            "rate_hz": 50.0,
            "channels": [{"name": name, "unit": "N", "kind": "force", "step": 0.01} for name in ("left", "right")],
            "wire": ["device_ms", "left", "right"],
        }
    )
    assert layout.in_steps((1.37, -0.02)) == (137, -2)
    frame = whole_frame(Frame(0, 20, (137, -2)), layout)
    assert whole_frame(Frame(0, np.int64(20), tuple(np.array([137, -2]))), layout) == frame  # type: ignore[arg-type]
    for wrong, message in (
        (Frame(0, 20, (1.37, -2)), r"'left' is 1.37 in a frame.*steps, here of 0.01.*layout.in_steps\(sample\)"),
        (Frame(0, 20, (137, -2.0)), "'right' is -2.0 in a frame"),
        (Frame(0, 20, (137,)), "The frame has 1 values, but layout 'press' has 2 channels"),
        (Frame(0, 0.02, (137, -2)), "device_ms is 0.02 in a frame: accepted are whole milliseconds"),
    ):
        with pytest.raises(ArrayError, match=message):
            whole_frame(wrong, layout)  # type: ignore[arg-type]
    for sample in ((1.0,), (1.0, float("nan"))):
        with pytest.raises(ArrayError):
            layout.in_steps(sample)


def test_a_reader_refuses_units(bundle) -> None:
    reader = StreamClassifier(bundle())
    with pytest.raises(ArrayError, match="whole numbers of steps"):
        reader.push(Frame(0, 0, (0.5,) * reader.layout.n_channels))  # type: ignore[arg-type]
    assert reader.time_s == 0.0
