"""Onset suggestions on signals whose truth is known, and against marks made by eye on real recordings."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.onset import suggest
from plushsense.dataset.trimming import suggest_trims
from plushsense.devices.virtual.session import VirtualSession
from plushsense.devices.virtual.stream import channel_columns
from plushsense.devices.virtual.world import WORLD, draw_person

ACCEL, PLUSH, PHONE = load_layout("accel-3"), load_layout("plush-15"), load_layout("phone-6")
MARKS = Path(__file__).with_name("onsets.csv")


def wave(rate_hz: float, begin_s: float, end_s: float, total_s: float, size: float, channels: int = 3) -> Frames:
    """Rest with noise, a movement from ``begin_s`` to ``end_s``, and rest in another posture."""
    rng = np.random.default_rng(round(rate_hz))
    t = np.arange(round(total_s * rate_hz)) / rate_hz
    moving = (t >= begin_s) & (t < end_s)
    x = np.where(moving, size * np.sin(2 * np.pi * 3.0 * (t - begin_s)), 0.0) + np.where(t >= end_s, 1500.0, 0.0)
    values = x[:, None] * np.linspace(1.0, -0.4, channels) + 8000 + rng.normal(0, 60, (len(t), channels))
    return Frames(np.rint(values).astype(np.int64), np.rint(1000 * t).astype(np.int64) + 77)


def cut(frames: Frames, at_s: float) -> tuple[Frames, Frames]:
    row = int(np.searchsorted(frames.device_ms, frames.device_ms[0] + 1000 * at_s))
    return frames.slice(0, row), frames.slice(row, len(frames))


def at(frames: Frames, row: int) -> float:
    return float(frames.device_ms[min(row, len(frames) - 1)] - frames.device_ms[0]) / 1000


@pytest.mark.parametrize("rate_hz", [31.0, 91.0, 200.0])
@pytest.mark.parametrize("layout", [ACCEL, PHONE], ids=lambda v: v.name)
def test_begin_and_end_are_found_at_any_rate(rate_hz: float, layout: Layout) -> None:
    whole = wave(rate_hz, 3.5, 5.2, 6.0, 6000, layout.n_channels)
    before, frames = cut(whole, 3.0)
    for context in (before, None):
        found = suggest(frames, layout, context)
        assert found.onset_visible
        assert found.offset_visible
        assert at(frames, found.start) == pytest.approx(0.5, abs=0.08)
        assert at(frames, found.stop) == pytest.approx(2.2, abs=0.12)
        assert found.onset_confidence > 0.8, "a sharp begin, far above the noise"


def test_a_faint_or_slow_begin_is_less_sure() -> None:
    def sure(size: float, slow: bool = False) -> float:
        before, frames = cut(wave(91.0, 3.5, 5.2, 6.0, size), 3.0)
        if slow:
            ramp = np.clip(np.arange(len(frames)) / 91.0 - 0.1, 0.0, None) * 4000
            frames = Frames(frames.values + np.rint(np.minimum(ramp, 2400))[:, None].astype(np.int64), frames.device_ms)
        return suggest(frames, ACCEL, before).onset_confidence

    assert sure(6000) > sure(300) > 0.0
    assert sure(6000) > sure(6000, slow=True) + 0.05


def test_moving_at_the_first_row_is_no_visible_onset() -> None:
    before, frames = cut(wave(91.0, 2.6, 4.5, 5.5, 6000), 3.0)
    found = suggest(frames, ACCEL, before)
    assert (found.start, found.onset_visible, found.onset_confidence) == (0, False, 0.0)
    assert "first row" in found.why
    assert found.offset_visible


@pytest.mark.parametrize("layout", [ACCEL, PLUSH, PHONE], ids=lambda v: v.name)
def test_nothing_happens(layout: Layout) -> None:
    before, frames = cut(wave(91.0, 9.0, 9.0, 6.0, 0.0, layout.n_channels), 3.0)
    for context in (before, None):
        found = suggest(frames, layout, context)
        assert (found.start, found.stop, found.onset_confidence) == (0, len(frames), 0.0)
        assert "nothing" in found.why


def test_the_knock_of_a_key_is_no_gesture() -> None:
    before, frames = cut(wave(91.0, 9.0, 9.0, 5.0, 0.0), 3.0)
    frames.values[-7:-3] += 9000
    assert not suggest(frames, ACCEL, before).onset_visible


def test_garbage_and_a_row_out_of_line_do_not_count() -> None:
    before, frames = cut(wave(91.0, 3.8, 5.2, 6.0, 6000), 3.0)
    clean = suggest(frames, ACCEL, before)
    frames.values[20, 0] = 31_000
    frames.values[40:43, 1] = 90_000
    dirty = suggest(frames, ACCEL, before)
    assert abs(dirty.start - clean.start) <= 2


def test_rows_before_a_gap_are_no_context() -> None:
    before, frames = cut(wave(91.0, 3.5, 5.2, 6.0, 6000), 3.0)
    wild: NDArray[np.int64] = before.values + np.random.default_rng(1).integers(-9000, 9000, before.values.shape)
    apart = Frames(wild, before.device_ms - 60_000)
    assert suggest(frames, ACCEL, apart) == suggest(frames, ACCEL, None)


@pytest.mark.parametrize("rows", [1, 2, 5, 20])
def test_a_few_rows_are_too_short(rows: int) -> None:
    frames = wave(91.0, 0.0, 1.0, 1.0, 6000).slice(0, rows)
    found = suggest(frames, ACCEL)
    assert (found.start, found.stop, found.why) == (0, rows, "too short")


def test_a_clock_that_stands_still_is_no_crash() -> None:
    frames = wave(91.0, 0.5, 1.5, 2.5, 6000)
    stuck = Frames(frames.values, np.zeros_like(frames.device_ms))
    assert 0 <= suggest(stuck, ACCEL).start <= len(frames)
    flat = Frames(np.zeros_like(frames.values), frames.device_ms)
    assert not suggest(flat, ACCEL).onset_visible


def test_a_hand_that_lies_still_is_no_rest() -> None:
    """On the toy's electrodes a hold is the gesture: its end is where the hand leaves, not where it stops moving."""
    session = VirtualSession(draw_person(2, 1, WORLD), 1, 0, WORLD)
    session.idle(2.0)
    ends = []
    for label in ("Hold strong", "Back stroke 1"):
        episode = session.perform(label, 3)
        values = episode.values[:, channel_columns(PLUSH)]
        for mark in episode.marks:
            first, last = (row - episode.first for row in (mark.record_start, mark.record_stop))
            whole = Frames(values, episode.device_ms)
            found = suggest(whole.slice(first, last), PLUSH, whole.slice(max(0, first - 250), first))
            assert found.onset_visible
            # The toy's field feels the hand come near before it works, and until it is away again.
            assert -0.4 <= (found.start - (mark.start - mark.record_start)) / 100 <= 0.1
            ends.append((found.stop - (mark.stop - mark.record_start)) / 100)
    assert -0.2 <= float(np.median(ends)) <= 0.4
    assert min(ends) > -1.0


def test_suggestions_lie_near_the_marks_made_by_eye(imported_study: Any) -> None:
    """The figures are in docs/trim.md; these floors are well below them."""
    with MARKS.open(encoding="utf-8", newline="") as file:
        marked = {row["recording"]: row for row in csv.DictReader(file)}
    dataset = imported_study.dataset
    found = suggest_trims(dataset, [r for r in dataset.recordings if r.id in marked])
    assert len(found) == len(marked) >= 60

    def errors(edge: str, sure: float) -> NDArray[np.float64]:
        out = []
        for t in found:
            row, s = marked[t.recording.id], t.suggestion
            confidence = s.onset_confidence if edge == "onset" else s.offset_confidence
            if row[f"{edge}_visible"] == "yes" and confidence >= sure:
                suggested = t.seconds[s.start if edge == "onset" else s.stop]
                out.append(abs(float(suggested) - float(row[f"{edge}_s"])))
        return np.array(out)

    onset, offset, sure = errors("onset", 0.0), errors("offset", 0.0), errors("onset", 0.8)
    assert np.median(onset) < 0.1
    assert np.mean(onset <= 0.2) > 0.9
    assert np.median(offset) < 0.15
    assert len(sure) > 0.5 * len(onset)
    assert sure.max() <= 0.2
    at_rest = [t for t in found if t.recording.gesture == "At Rest"]
    assert len(at_rest) == 8
    assert all(t.suggestion.onset_confidence < 0.5 for t in at_rest)
