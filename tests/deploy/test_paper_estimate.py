"""The paper's estimate of the time on the chip, from its own numbers."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from plushsense.deploy.profile import compare_with_paper
from plushsense.models.arch import Arch

MINE = Arch.parse("9d1_5d2", "4,6", channels=3, classes=4)


def profiled(**estimates: Any) -> Any:
    return SimpleNamespace(arch=MINE, estimates=estimates, window_instructions={"xtensa": 3_000_000})


def test_the_papers_network_takes_the_papers_times() -> None:
    """Section 4.7: 3.21 MMAC, 55 ms in floats and 23 ms in 16 bits."""
    found = compare_with_paper(profiled())
    paper, window, step = found.estimates
    assert paper.macs == pytest.approx(3.21e6, rel=0.005)
    assert (round(paper.float_ms), round(paper.int16_ms)) == (55, 23)
    assert (window.macs, step.macs) == (MINE.macs_per_window, MINE.macs_per_step)
    assert str(MINE.span) in window.what and f"{MINE.step} samples" in step.what and "250" in paper.what
    assert found.float_bytes == 4 * MINE.parameters
    table = found.to_json()
    assert (table["ours_step_ms"], table["ours_window_ms"]) == (None, None)
    assert table["mmac_s"] == {"float": 58.0, "int16": 137.0} and table["float_weights_bytes"] == found.float_bytes
    assert table["estimates"][0] == {
        "what": paper.what, "macs": paper.macs, "float_ms": round(paper.macs / 58e3, 3),
        "int16_ms": round(paper.macs / 137e3, 3),
    }  # fmt: skip
    assert len(table["paper_assumes"]) == len(table["ours_assumes"]) == 5 and json.dumps(table)


def test_ours_is_that_of_the_esp32() -> None:
    core = SimpleNamespace(target="xtensa", cycles_low=1.0, cycles_high=2.0, mhz=240)
    esp32 = SimpleNamespace(core=core, low_ms=1.23456, high_ms=2.5)
    found = compare_with_paper(profiled(esp32=esp32, esp8266=None))
    assert found.step_ms == (1.23456, 2.5) and found.window_ms == pytest.approx((12.5, 25.0))
    table = found.to_json()
    assert (table["ours_step_ms"], table["ours_window_ms"]) == ([1.235, 2.5], [12.5, 25.0])
    assert compare_with_paper(profiled(esp8266=esp32)).step_ms is None
