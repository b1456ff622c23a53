"""The C library's entry points under libFuzzer: ``make fuzz``. In CI each of them reads a few inputs."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.deploy.package import ARDUINO, emit
from plushsense.deploy.proof.scenarios import patches_of
from plushsense.deploy.quantize import integer_model
from support.c_toy import C_FOLDER
from support.exports import bundle_of
from support.integers import vector_model

ENTRIES = ("model", "calibrated", "frames", "swap", "patch", "lines")
FUZZ = int(os.environ.get("PLUSHSENSE_FUZZ", "0"))
DRIVER = Path(__file__).with_name("fuzz.c")


def corpus(folder: Path) -> tuple[dict[str, list[bytes]], Path]:
    """Good inputs of each entry, and the folder of an export whose lines and model are used."""
    bundle = bundle_of("phone-6", "3d1_2d2", "3,4", window=40)
    model = integer_model(bundle)
    out = emit(model, bundle, folder / "out").folder
    others = (bundle_of("phone-6", *shape, window=40) for shape in (("v5_3d2", "2,4"), ("2", "5")))
    images = [image.to_bytes() for image in (model, *map(integer_model, others))]
    patches = [patch for _, patch in patches_of(model, bundle.scaler).patches]
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 256, 400, dtype=np.uint8).tobytes() for _ in range(4)]
    width = load_layout("phone-6").n_channels
    lines = "".join(f"{' '.join(f'{v:.6g}' for v in rng.normal(size=width))} {10 * k}\n" for k in range(40))
    lines += "1e-9 +2.5E+7 .5 -0 7. 1 2\r\n"
    axes = vector_model()
    channels = tuple(replace(c, valid_min=-1000.0, valid_max=1000.0) for c in axes.layout.channels)
    themselves = replace(axes.layout, channels=channels, self_calibration=axes.layout.names)
    calibrated = replace(axes, layout=themselves).to_bytes()
    found = {
        "model": images,
        "calibrated": [calibrated],
        "frames": frames,
        "swap": images,
        "patch": patches,
        "lines": [lines.encode()],
    }
    return {entry: [*inputs, *(i + b"\0" for i in inputs)] for entry, inputs in found.items()}, out


def environment(out: Path, entry: str) -> dict[str, str]:
    return os.environ | {"PLUSHSENSE_ENTRY": entry, "PLUSHSENSE_MODEL": str(out / "plush_model.bin")}


def built(compiler: str, out: Path, folder: Path, entry: str, *flags: str) -> Path:
    """Return the program of an entry, compiled once for all entries of one library."""
    flags = (*flags, "-DPLUSH_CALIBRATE") if entry == "calibrated" else flags
    program = folder / ("of-calibrated" if entry == "calibrated" else "program")
    if program.exists():
        return program
    includes = [f"-I{folder}" for folder in (C_FOLDER, DRIVER.parent, out, out / ARDUINO / "src")]
    sources = [str(DRIVER), str(out / ARDUINO / "src" / "plush_wire.c")]
    subprocess.run([compiler, "-std=c99", *flags, *includes, *sources, "-o", str(program)], check=True)
    return program


def test_every_entry_survives_a_few_broken_inputs(tmp_path: Path, c_compiler: str) -> None:
    inputs, out = corpus(tmp_path)
    rng = random.Random(3)
    for entry in ENTRIES:
        folder = tmp_path / entry
        folder.mkdir()
        for n in range(60):
            data = bytearray(rng.choice(inputs[entry]))
            for _ in range(rng.randrange(4) if data else 0):
                data[rng.randrange(len(data))] = rng.randrange(256)
            (folder / f"{n}").write_bytes(data)
        program = built(c_compiler, out, tmp_path, entry, "-O0", "-DFILES")
        subprocess.run([program, *map(str, folder.iterdir())], env=environment(out, entry), check=True)


@pytest.mark.skipif(not FUZZ, reason="takes minutes: make fuzz, or PLUSHSENSE_FUZZ=N for N times 10 000 executions")
def test_libfuzzer_finds_nothing(tmp_path: Path, needs: Callable[..., None]) -> None:
    needs("clang")
    inputs, out = corpus(tmp_path)
    flags = ("-O1", "-g", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")
    for entry in ENTRIES:
        folder = tmp_path / entry
        folder.mkdir()
        for n, data in enumerate(inputs[entry]):
            (folder / f"{n}").write_bytes(data)
        program = built("clang", out, tmp_path, entry, *flags)
        options = [f"-runs={10_000 * FUZZ}", "-seed=1", "-max_len=4096", "-timeout=20", "-print_final_stats=1"]
        done = subprocess.run(
            [program, *options, str(folder)], env=environment(out, entry), cwd=tmp_path, capture_output=True, text=True
        )
        figures = [line for line in done.stderr.splitlines() if "executed_units" in line or "peak_rss" in line]
        sys.stderr.write(f"{entry}: {' '.join(figures)}\n")
        if done.returncode:
            for crash in (*tmp_path.glob("crash-*"), *tmp_path.glob("timeout-*"), *tmp_path.glob("oom-*")):
                shutil.copy(crash, Path(os.environ.get("PLUSHSENSE_FUZZ_OUT", ".")) / f"{entry}-{crash.name}")
        assert done.returncode == 0, done.stderr[-4000:]
