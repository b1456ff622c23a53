"""The recorder's screen: whatever the terminal's size, what is to be done stays on it."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
from rich.console import Console
from rich.screen import Screen as RichScreen

from plushsense.cli.terminal import KEYS, view
from plushsense.recording.plan import load_protocol
from plushsense.recording.status import RecorderStatus
from plushsense.recording.takes import SIGNAL

STEPS = load_protocol("plush-17").steps()
STATUS = RecorderStatus(
    state="idle", step=STEPS[3], steps=51, repetitions=3, next_step=STEPS[4], done=3, skipped=1, redone=0, existing="",
    countdown_s=0.0, elapsed_s=0.0, left_s=0.0, rate_hz=100.0, jitter_ms=0.5, signal="good", away=False, lost=1,
    malformed=2, garbage=3, reconnects=0, gaps=0, rows=4711, file="Back stroke 1_1795282393216_301.csv",
    message="This recording has a gap of 5.0 s; it is kept, r records it again.", failed="", folder="R/S01/1",
)  # fmt: skip


def shown(width: int, height: int, status: RecorderStatus = STATUS) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height)
    screen = view(status, "S01, session 1", ["No consent"], None)
    rows = console.render_lines(RichScreen(screen), console.options)
    return ["".join(part.text for part in row).rstrip() for row in rows]


@pytest.mark.parametrize(("width", "height"), [(1, 1), (2, 9), (20, 2), (39, 60), (90, 23)])
def test_any_size_is_survived(width: int, height: int) -> None:
    for state in KEYS:
        for signal in SIGNAL:
            assert len(shown(width, height, replace(STATUS, state=state, signal=signal))) == height


def test_narrow_lines_are_broken_not_cut() -> None:
    found = shown(39, 60)
    assert all(len(line) <= 39 for line in found)
    assert "q quit" in " ".join(found)
    assert "reconnected 0" in " ".join(found)


def test_a_low_screen_keeps_what_is_to_be_done_and_the_keys() -> None:
    found = " ".join(shown(79, 8))
    for needed in (STEPS[3].gesture, "READY", "gap of 5.0 s", "SPACE start", "3 of 51 recorded"):
        assert needed in found


def test_lines_that_cannot_be_read_are_no_silence() -> None:
    found = " ".join(shown(90, 30, replace(STATUS, signal="unreadable")))
    assert "CANNOT BE READ: is --layout right" in found
    assert "silent" not in found
