"""``plushsense profile``: its JSON, its text, and refusals in one sentence."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.cli.main import main
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.deploy.quantize import calibrated
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.windows.features import Scaler
from support.kept_objects import keeping_objects


@pytest.fixture(scope="module", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The library is the same for all models."""
    with keeping_objects(tmp_path_factory):
        yield


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    arch = Arch.parse("5d1_4d3", "4,6", channels=3, classes=18, window=48)
    scaler = Scaler(np.array([0.0, 5.0, 10.0]), np.array([0.01, 0.02, 0.03]))
    bundle = Bundle(arch, random_weights(arch, 1), load_layout("accel-3"), scaler, load_gestures("plush-18"))
    x = np.random.default_rng(1).normal(scale=80, size=(9, 3, 60)).round().astype(np.int64)
    return ps.export(calibrated(bundle, x), tmp_path_factory.mktemp("exports") / "out").folder


def test_json_and_text(export: Path, capsys: pytest.CaptureFixture[str], target_here: Callable[[str], str]) -> None:
    wanted = ["--target", f"{target_here('xtensa')}, {target_here('cortex-m4')}"]
    assert main(["profile", str(export), *wanted, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"instructions_per_step", "macs_per_step", "flash_bytes", "ram_bytes", "estimated_ms"} <= set(told)
    assert set(told["instructions_per_step"]) == {"xtensa", "cortex-m4"} == set(told["flash_bytes"])
    assert told["macs_per_step"] == sum(v for k, v in told["macs_by_layer"].items() if k != "dense")
    assert set(told["estimated_ms"]) == {"esp8266", "esp32", "esp32-s2", "esp32-s3", "nrf52"}
    assert all(c["instructions_call_most"] <= c["instructions_call_bound"] for c in told["targets"].values())
    esp32 = told["estimated_ms"]["esp32"]
    assert esp32["estimate"] and 0 < esp32["low"] < esp32["high"] < 50 and esp32["why"]
    assert esp32["verdict"].startswith("fits 20 Hz: yes")
    assert 0 < esp32["energy_uj"][0] < esp32["energy_uj"][1] and esp32["current_source"]
    assert "nothing ran on a real chip" in told["said"]

    assert main(["profile", str(export), "--target", "xtensa"]) == 0
    text = capsys.readouterr().out
    count = told["instructions_per_step"]["xtensa"]
    assert f"{count:,}" in text
    for part in (
        "ESTIMATED",
        "nothing ran on a real chip",
        "Heap: none",
        "Interrupts switched off: never",
        "longest call, bound",
        "uJ a step",
        "whole step",
        "stack: plush_push",
        "fits 20 Hz",
    ):
        assert part in " ".join(text.split())


@pytest.mark.exhaustive
def test_how_it_is_compiled_matters(
    export: Path, capsys: pytest.CaptureFixture[str], target_here: Callable[[str], str]
) -> None:
    told = {}
    for level in ("O2", "Os"):
        assert main(["profile", str(export), "--target", target_here("riscv32"), "--optimise", level, "--json"]) == 0
        told[level] = json.loads(capsys.readouterr().out)
    assert told["Os"]["flash_bytes"]["riscv32"] < told["O2"]["flash_bytes"]["riscv32"]
    assert told["Os"]["instructions_per_step"]["riscv32"] > told["O2"]["instructions_per_step"]["riscv32"]


def test_refusals(
    export: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["profile", str(export), "--target", "host, xtens"]) == 2
    assert "Did you mean 'xtensa'?" in capsys.readouterr().err
    assert main(["profile", str(tmp_path), "--json"]) == 2
    told = capsys.readouterr()
    assert told.out == "" and "is no export: make one with plushsense export BUNDLE OUT" in told.err
    for none, words in ((tmp_path / "nowhere", "There is no export"), (export / "README.md", "is no export")):
        assert main(["profile", str(none)]) == 2
        assert words in capsys.readouterr().err
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["profile", str(export), "--target", "cortex-m4"]) == 2
    assert "install Debian's gcc-arm-none-eabi qemu-system-arm libnewlib-arm-none-eabi" in capsys.readouterr().err


def test_the_papers_estimate_beside_ours(
    export: Path, capsys: pytest.CaptureFixture[str], target_here: Callable[[str], str]
) -> None:
    assert main(["profile", str(export), "--target", target_here("xtensa"), "--paper", "--json"]) == 0
    paper = json.loads(capsys.readouterr().out)["paper"]
    window, whole, step = paper["estimates"]
    # Section 4.7: "around 3.2 MMAC", 55 ms in floats, 23 ms in 16-bit integers.
    assert (round(window["macs"] / 1e6, 1), int(window["float_ms"]), int(window["int16_ms"])) == (3.2, 55, 23)
    assert whole["macs"] > step["macs"] > 0
    assert paper["ours_step_ms"][0] < paper["ours_step_ms"][1]
    assert paper["ours_window_ms"][0] > paper["ours_step_ms"][0]
    assert paper["paper_assumes"] and paper["ours_assumes"]


def test_the_papers_estimate_needs_no_emulator(export: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["profile", str(export), "--target", "host", "--paper"]) == 0
    text = capsys.readouterr().out
    assert "the paper's network, a window of 250 samples  3.212" in text
    assert "not counted: needs the target xtensa" in text
    assert "nothing ran on a chip" in text
    assert main(["profile", str(export), "--target", "host"]) == 0
    assert "Section 4.7" not in capsys.readouterr().out
