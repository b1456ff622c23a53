"""Events that a person marks as wrong: what is kept of them, what is read again, and what the layer makes of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import BadInput, BundleError, DatasetError
from plushsense.live.adaptation import Examples, restore_original
from plushsense.live.feedback import (
    LEAD_S,
    Correction,
    append_corrections,
    correct,
    correction_of,
    events_of,
    read_corrections,
)
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax
from plushsense.runtime.decisions import argmax_spec
from plushsense.runtime.trace import trace_of
from support.troubles import make_bundle, stream

FRAMES = stream(3, 4000, [])


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return make_bundle(**argmax_spec(0.3).to_dict())


@pytest.fixture(scope="module")
def marks(bundle: Bundle) -> list[Correction]:
    """Three wrong events of the most frequent gesture."""
    events = [e for e in events_of(bundle, FRAMES) if e.stop_s - e.start_s > 0.5]
    often = np.bincount([e.gesture for e in events]).argmax()
    wrong = [e for e in events if e.gesture == often][:3]
    assert len(wrong) == 3
    return [correction_of(bundle, FRAMES, e, subject="S07") for e in wrong]


def shares(bundle: Bundle, mark: Correction) -> np.ndarray:
    """Mean probabilities (K,) during a correction's event, from its own rows."""
    trace = trace_of(mark.frames, bundle)
    rows = [
        part.logits[
            (trace.step_times_us(part) >= 1e6 * mark.begun_s) & (trace.step_times_us(part) <= 1e6 * mark.ended_s)
        ]
        for part in trace.parts
    ]
    return softmax(np.concatenate(rows) / 256).mean(axis=0)


def test_the_stretch_is_kept_with_its_past(bundle: Bundle, marks: list[Correction], tmp_path: Path) -> None:
    path = tmp_path / "S07.jsonl"
    append_corrections(path, marks[:1])
    with path.open("ab") as file:
        file.write(b'{"subject": "S0')  # a crash
    append_corrections(path, marks[1:])
    found = read_corrections(path)
    assert [c.gesture for c in found] == [c.gesture for c in marks] and path.stat().st_mode & 0o077 == 0
    for one, other in zip(found, marks, strict=True):
        assert np.array_equal(one.frames.values, other.frames.values) and one.begun_s == other.begun_s <= LEAD_S
        kept_s = (one.frames.device_ms[-1] - one.frames.device_ms[0]) / 1000
        assert one.ended_s == pytest.approx(kept_s, abs=0.03)


def test_the_reported_gesture_becomes_less_likely(bundle: Bundle, marks: list[Correction]) -> None:
    at = bundle.gestures.index(marks[0].gesture)
    done = correct(bundle, marks)
    assert done.accepted and done.after < done.before and done.corrections == 3
    for mark in marks:
        assert shares(done.bundle, mark)[at] < shares(bundle, mark)[at]
    moved = {name for name in bundle.weights if not np.array_equal(bundle.weights[name], done.bundle.weights[name])}
    assert moved == {"dense.weight", "dense.bias"} and done.bundle.adapted_to == "S07"
    right = next(label for label in bundle.gestures.labels if label != marks[0].gesture)
    named = correct(bundle, [replace(mark, right=right) for mark in marks]).bundle
    assert all(
        shares(named, m)[named.gestures.index(right)] > shares(bundle, m)[named.gestures.index(right)] for m in marks
    )


def test_corrections_replace_earlier_ones_and_are_undone_byte_for_byte(bundle: Bundle, marks: list[Correction]) -> None:
    first = correct(bundle, marks[:1]).bundle
    both = correct(first, marks).bundle
    once = correct(bundle, marks).bundle
    assert np.array_equal(both.weights["dense.weight"], once.weights["dense.weight"])
    assert restore_original(both).to_bytes() == bundle.to_bytes()
    assert not {"subject", "original", "uncorrected"} & set(both.without_people().personal)


def test_what_helps_nobody_is_refused(bundle: Bundle, marks: list[Correction]) -> None:
    network, label = bundle.network(), bundle.gestures.index(marks[0].gesture)
    draw = np.random.default_rng(0)
    features = draw.normal(0, 1, (40, network.arch.features))
    found = softmax(network.classify(features)).argmax(axis=1)
    own = Examples(features, found, np.arange(40))
    assert (found == label).any()
    refused = correct(bundle, marks, own, strength=1e-3)
    assert not refused.accepted and refused.bundle is bundle and "fewer of the person's own" in refused.reason
    assert correct(bundle, marks, own, strength=1e6).accepted


def test_what_cannot_be_corrected_is_said(bundle: Bundle, marks: list[Correction], tmp_path: Path) -> None:
    event = events_of(bundle, FRAMES)[0]
    label = bundle.gestures.labels[event.gesture]
    for words, change in (
        ("has no gesture 'Strok'", {"right": "Strok"}),
        ("reported as", {"right": label}),
    ):
        with pytest.raises(BadInput, match=words):
            correction_of(bundle, FRAMES, event, subject="S07", **change)
    with pytest.raises(BadInput, match="names no gesture"):
        correction_of(bundle, FRAMES, replace(event, gesture=255), subject="S07")
    two = [marks[0], replace(marks[1], subject="S08")]
    for words, given_marks in (
        ("of S07, S08", two),
        ("of nobody", []),
        ("same sensors", [replace(marks[0], channels=("a", "b", "c"))]),
        ("no gesture 'Other'", [replace(marks[0], gesture="Other")]),
        ("no answer during", [replace(marks[0], begun_s=0.0, ended_s=0.1)]),
    ):
        with pytest.raises(BadInput, match=words):
            correct(bundle, given_marks)
    with pytest.raises(BundleError, match="adapted to S07"):
        correct(correct(bundle, marks).bundle, [replace(marks[0], subject="S08")])
    for bad in ('{"a": 1}\n', re.sub(r"\[\[\d+", "[[5E19", marks[0].to_line())):
        (tmp_path / "bad.jsonl").write_text(bad + marks[0].to_line(), encoding="utf-8")
        with pytest.raises(DatasetError, match="line 1 is no correction"):
            read_corrections(tmp_path / "bad.jsonl")
    (tmp_path / "empty.jsonl").write_text("\n", encoding="utf-8")
    with pytest.raises(DatasetError, match="holds no correction"):
        read_corrections(tmp_path / "empty.jsonl")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_corrections(tmp_path / "nowhere.jsonl")
    with pytest.raises(BadInput, match="cannot be written"):
        append_corrections(tmp_path / "nowhere" / "S07.jsonl", marks)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_damaged_line_is_no_correction(marks: list[Correction], tmp_path_factory, data: st.DataObject) -> None:
    line = bytearray(replace(marks[0], frames=marks[0].frames.slice(0, 5)).to_line().encode())
    line[data.draw(st.integers(0, len(line) - 2))] = data.draw(st.integers(32, 126))
    path = tmp_path_factory.mktemp("damaged") / "S07.jsonl"
    path.write_bytes(bytes(line) + marks[0].to_line().encode())
    try:
        # Not JSON any more, or still a correction, of other numbers or words.
        assert len(read_corrections(path)) in (1, 2)
    except DatasetError as said:
        assert "line 1" in str(said)
