"""Measure the cost of a live step from bytes to event, and of a hundred toys at once.

    python bench/live.py [--bundle BUNDLE] [--toys 100 --seconds 30] [--json]

1. Bytes to event: lines of the virtual toy pass through wire parser, health, clock, derived channels, gate, network and
   events, in float and int8, for one toy on one thread. The time of a step is measured from the bytes of its last frame
   to the decision.
2. Many toys at 100 Hz in one process and one thread, in real time. A decision is late when it comes more than one step
   after its frame was due. The bytes of the virtual toys are computed beforehand.

Without `--bundle` the weights are random: costs hardly depend on them. The data of the virtual toy are a simulation.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.deploy.quantize import calibrated, integer_model
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.stream import ToySpec, ToyStream, VirtualDevice
from plushsense.devices.wire import LineParser
from plushsense.live.loop import run_many
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import IntegerClassifier, StreamClassifier, StreamReader
from plushsense.windows.clock import SampleClock
from plushsense.windows.features import SampleInputs, Scaler


def lines_of(layout: Layout, count: int) -> list[bytes]:
    """Return the bytes that a virtual toy sends."""
    stream = iter(ToyStream(ToySpec(person=7, seed=3, lost=0.0, garbled=0.0, glitch=0.0), layout))
    return [next(stream).data for _ in range(count)]


def samples_of(layout: Layout, lines: list[bytes]) -> np.ndarray:
    """Return the samples (T, I) that a network reads from these lines."""
    parser, clock, inputs = LineParser(layout), SampleClock(layout), SampleInputs(layout)
    frames = [frame for line in lines for frame in parser.feed(line)]
    return np.array([inputs(row.tolist()) for frame in frames for row in clock.push(frame.device_ms, frame.values)])


def made_up(layout: Layout, symbol: str = "14d1_19d2_19d4") -> Bundle:
    """Return a network with random weights, calibrated on the virtual toy so that it also runs as integers."""
    gestures = load_gestures("plush-18")
    arch = Arch.parse(symbol, (8, 12, 16), channels=layout.n_inputs, classes=len(gestures))
    x = samples_of(layout, lines_of(layout, 6000)).T
    windows = np.stack([x[:, at : at + arch.span] for at in range(0, x.shape[1] - arch.span, 60)]).astype(np.int32)
    return calibrated(Bundle(arch, random_weights(arch, 1), layout, Scaler.fit(windows), gestures), windows)


def bytes_to_event(reader: StreamReader, lines: list[bytes]) -> dict[str, Any]:
    """Measure steps with a decision in ms of wall-clock and processor time, and processor microseconds per frame."""
    parser = LineParser(reader.layout)
    wall, own = [], []
    began = time.process_time()
    for line in lines:
        arrived, worked = time.perf_counter(), time.process_time()
        decisions = [d for f in parser.feed(line) for d in reader.push(Frame(0, f.device_ms, f.values))]
        if any(d.answer is not None for d in decisions):
            own.append(time.process_time() - worked)
            wall.append(time.perf_counter() - arrived)
    each = (time.process_time() - began) / len(lines)
    return {"steps": len(wall), "ms": spread(wall), "processor_ms": spread(own), "us_a_frame": round(1e6 * each, 1)}


def spread(seconds: list[float]) -> dict[str, float]:
    """Return the quantiles in milliseconds."""
    p50, p95, p99 = (round(1000 * float(v), 3) for v in np.percentile(seconds, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99, "longest": round(1000 * max(seconds), 3)}


def many(bundle: Bundle, toys: int, seconds: float) -> dict[str, Any]:
    """Run virtual toys in real time in this thread; their bytes are computed beforehand."""
    urls = [f"virtual://?person={n + 1}&seed={n + 1}&seconds={seconds}" for n in range(toys)]
    devices = [open_device(url, bundle.layout) for url in urls]
    for device in devices:
        assert isinstance(device, VirtualDevice)
        device.play_ahead()
    gc.collect()
    gc.freeze()  # existing objects live on; scanning them at every collection would take tens of ms
    live = run_many([(device, StreamClassifier(bundle)) for device in devices])
    for _ in live:
        pass
    return live.summary().to_dict()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bundle", type=Path)
    parser.add_argument("--frames", type=int, default=30_000, help="of part 1")
    parser.add_argument("--toys", type=int, default=100, help="of part 2; 0: leave it out")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    bundle = Bundle.load(args.bundle) if args.bundle else made_up(load_layout("plush-15"))
    step_ms = bundle.arch.step * bundle.layout.period_us / 1000
    report: dict[str, Any] = {"network": bundle.arch.symbol, "step_ms": step_ms}
    lines = lines_of(bundle.layout, args.frames)
    report["bytes_to_event"] = {
        "float": bytes_to_event(StreamClassifier(bundle), lines),
        "int8": bytes_to_event(IntegerClassifier(integer_model(bundle)), lines),
    }
    report["many"] = many(bundle, args.toys, args.seconds) if args.toys else None
    report["load"] = [round(v, 2) for v in os.getloadavg()] if hasattr(os, "getloadavg") else None
    report["cores"] = os.cpu_count()
    print(json.dumps(report, indent=None if args.json else 1))


if __name__ == "__main__":
    main()
