"""Measure a step of an export in a browser's engine against the native C, and against onnxruntime-web, side by side.

    npm install --prefix THERE onnxruntime-web
    python bench/web.py EXPORT [--ort THERE] [--rounds 5] [--json]

The library compiled natively by gcc and clang (-O2) and the module of the export in Node, by way of its plushsense.js,
read the same frames in turn. Of an export written with `--also onnx`, onnxruntime-web computes the network of a step:
the whole span, as it keeps no state. All run on one thread; times are the best of the rounds.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from plushsense.deploy.code import LIBRARY, MODEL
from plushsense.deploy.golden import FrameGenerator, Vectors
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.web import run_module

FRAMES = 10_000
NATIVE = r"""
#include <stdio.h>
#include <time.h>
#include "plushsense.h"
#include "plush_model.h"
#define WORDS (1 + PLUSH_MODEL_CHANNELS)
static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static int32_t frames[FRAMES * WORDS];
static plush_toy toy;
int main(void) {
    struct timespec a, b;
    double steps = 0;
    if (fread(frames, sizeof frames, 1, stdin) != 1
        || plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory))
        return 1;
    clock_gettime(CLOCK_MONOTONIC, &a);
    for (int i = 0; i < FRAMES; i++)
        steps += plush_push(&toy, (uint32_t)frames[i * WORDS], frames + i * WORDS + 1);
    clock_gettime(CLOCK_MONOTONIC, &b);
    printf("%f", ((b.tv_sec - a.tv_sec) * 1e6 + (b.tv_nsec - a.tv_nsec) / 1e3) / steps);
    return 0;
}
"""
ORT = r"""
import * as ort from "onnxruntime-web";
ort.env.wasm.numThreads = 1;
const session = await ort.InferenceSession.create(process.argv[2], { executionProviders: ["wasm"] });
const shape = [1, ...session.inputMetadata[0].shape.slice(1)], length = shape.reduce((a, b) => a * b);
const input = { [session.inputNames[0]]: new ort.Tensor("float32", Float32Array.from({ length }, Math.random), shape) };
for (let n = 0; n < 100; n++) await session.run(input);
const began = performance.now();
for (let n = 0; n < 200; n++) await session.run(input);
console.log((performance.now() - began) * 5);
"""


def natively(cc: str, code: Path, frames: Path, work: Path) -> Callable[[], float]:
    """Return what measures the microseconds of a step of the C, compiled by ``cc``."""
    (work / "main.c").write_text(NATIVE)
    program, sources = work / cc, [work / "main.c", code / LIBRARY[1], code / MODEL[1]]
    subprocess.run([cc, "-O2", f"-DFRAMES={FRAMES}", f"-I{code}", *map(str, sources), "-o", str(program)], check=True)
    return lambda: float(subprocess.run([program], stdin=frames.open("rb"), capture_output=True, check=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("export", type=Path)
    parser.add_argument("--ort", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    export = Export(args.export)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        code = export.code(work / "code")
        generator = FrameGenerator(export.model.layout, export.bundle.scaler, np.random.default_rng(1))
        generator.touches(FRAMES)
        frames = np.array(generator.rows, dtype=np.int64)
        (work / "frames").write_bytes((frames & 0xFFFFFFFF).astype("<u4").tobytes())
        cases = work / "cases"
        cases.write_bytes(Vectors("frames", frames, np.empty((0, 0), np.int32), FRAMES).to_bytes())
        image = export.folder / "plush_model.bin"
        ways: dict[str, Callable[[], float]] = {
            **{
                f"native, {cc}": natively(cc, code, work / "frames", work)
                for cc in ("gcc", "clang")
                if shutil.which(cc)
            },
            "plushsense.js": lambda: json.loads(run_module(export.folder, image, cases, "time"))["step_us"],
        }
        if args.ort:
            script = args.ort / "plushsense-bench.mjs"
            script.write_text(ORT)
            node = ["node", str(script.resolve()), str((export.folder / "model.onnx").resolve())]
            ways["onnxruntime-web"] = lambda: float(subprocess.run(node, capture_output=True, check=True).stdout)
        times = {way: [] for way in ways}
        for _ in range(args.rounds):
            for way, measure in ways.items():
                times[way].append(measure())
    best = {way: round(min(found), 2) for way, found in times.items()}
    print(json.dumps({"title": export.title, "us_a_step": best}, indent=None if args.json else 1))


if __name__ == "__main__":
    main()
