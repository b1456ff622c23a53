"""A toy's clock as it comes: what it may say, and what no clock says."""

from __future__ import annotations

import pytest

from plushsense.core.layouts import load_layout
from plushsense.devices.base import Device, Frame
from plushsense.recording.takes import FrameReceiver

LAYOUT = load_layout("plush-15")
VALUES = (0,) * LAYOUT.n_channels


class Silent(Device):
    def read(self) -> list[Frame] | None:
        return []


def taken_in(stamps: list[int], speed: float = 1.0) -> FrameReceiver:
    """These stamps of the toy's clock, each 10 ms after the one before by the computer's."""
    intake = FrameReceiver(Silent("x", LAYOUT), LAYOUT, speed, 0, 0)
    for n, stamp in enumerate(stamps):
        intake.receive(Frame(1_000_000 + 10 * n, stamp, VALUES))
        intake.end_reading()
    return intake


@pytest.mark.parametrize("spoilt", [10_050, 1_000_500, 0, 9_999_999])
def test_a_spoilt_stamp_lets_no_time_pass(spoilt: int) -> None:
    """A digit lost or doubled on the line must not end a recording by itself."""
    stamps = [100_000 + 10 * n for n in range(100)]
    stamps[50] = spoilt
    intake = taken_in(stamps)
    # The computer of the test may be slow by up to a second.
    assert 980 <= intake.toy_ms <= 2500
    assert intake.lost == 0
    assert {gap.reason for gap in intake.gaps} == {"the toy's clock restarted", "the toy's clock jumped"}
    assert max(gap.missing_ms for gap in intake.gaps) <= 20
    assert [gap.device_ms for gap in intake.gaps] == [(100_490, spoilt), (spoilt, 100_510)]


def test_a_hole_that_the_computer_waited_through_counts() -> None:
    intake = FrameReceiver(Silent("x", LAYOUT), LAYOUT, 1.0, 0, 0)
    intake.receive(Frame(1_000_000, 5000, VALUES))
    intake.end_reading()
    intake.receive(Frame(1_005_000, 10_000, VALUES))
    assert intake.toy_ms == 5000
    (gap,) = intake.gaps
    assert (gap.reason, gap.missing_ms) == ("nothing came", 5000)


def test_a_toy_faster_than_time_is_believed() -> None:
    intake = taken_in([0, 10, 20, 60_000], speed=50.0)
    assert intake.toy_ms == 60_000


def test_lines_without_a_frame_are_a_signal() -> None:
    device = Silent("x", LAYOUT)
    intake = FrameReceiver(device, LAYOUT, 1.0, 0, 0)
    assert intake.quality().signal == "none"
    device.counters.malformed += 3
    intake.check_malformed()
    assert intake.quality().signal == "unreadable"
