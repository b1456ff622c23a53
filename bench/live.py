"""Measure the cost of a live step from bytes to event, against `continual-inference`, and of a hundred toys at once.

    pip install continual-inference      (installs PyTorch; without it its rows are left out)
    python bench/live.py [--bundle BUNDLE] [--rounds 15] [--toys 100 --seconds 30] [--json]

1. Bytes to event: lines of the virtual toy pass through wire parser, health, clock, derived channels, gate, network and
   events, in float and int8, for one toy on one thread. The time of a step is measured from the bytes of its last frame
   to the decision.
2. Against continual-inference, a PyTorch library for networks that keep their state. Both have the same weights and are
   checked to give the same logits. A step has five samples; continual-inference computes an answer at every sample,
   with `forward_step` or, in one call, `forward_steps`. The methods run in turn, and ratios are taken within a round.
   continual-inference has no dilation in time: the taps of a dilated layer are spread over a longer kernel with zeros
   in between, which takes 2.8 times as many multiply-accumulates for the default network. Therefore a network without
   dilation is measured too.
3. Many toys at 100 Hz in one process and one thread, in real time. A decision is late when it comes more than one step
   after its frame was due. The bytes of the virtual toys are computed beforehand.

Without `--bundle` the weights are random: costs hardly depend on them. The data of the virtual toy are a simulation.
"""

from __future__ import annotations

import argparse
import gc
import importlib.util
import json
import os
import statistics
import time
from collections.abc import Callable
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
from plushsense.models.arch import NORM_EPSILON, Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.classifier import IntegerClassifier, StreamClassifier, StreamReader
from plushsense.windows.clock import SampleClock
from plushsense.windows.features import SampleInputs, Scaler

STEPS = 200  # a round
UNDILATED = "14_19_19"


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


def theirs(bundle: Bundle) -> tuple[Any, Any]:
    """Return the same network built from continual-inference's layers, and PyTorch."""
    import continual as co
    import torch
    from torch import nn

    torch.set_num_threads(1)
    arch, weights = bundle.arch, {name: torch.from_numpy(np.array(w)) for name, w in bundle.weights.items()}
    layers: list[Any] = []
    for i, layer in enumerate(arch.layers):
        conv = co.Conv1d(arch.inputs[i], layer.filters, layer.reach + 1)
        norm = nn.BatchNorm1d(layer.filters, eps=NORM_EPSILON)
        with torch.no_grad():
            conv.weight.zero_()
            conv.weight[:, :, :: layer.dilation].copy_(weights[f"conv{i}.weight"])
            conv.bias.copy_(weights[f"conv{i}.bias"])
            norm.weight.copy_(weights[f"norm{i}.gain"])
            norm.bias.copy_(weights[f"norm{i}.shift"])
            norm.running_mean.copy_(weights[f"norm{i}.mean"])
            norm.running_var.copy_(weights[f"norm{i}.var"])
        layers += [conv, nn.ReLU(), norm]
    dense = co.Linear(arch.filters[-1], arch.classes, channel_dim=1)
    with torch.no_grad():
        dense.weight.copy_(weights["dense.weight"])
        dense.bias.copy_(weights["dense.bias"])
    return co.Sequential(*layers, co.AvgPool1d(arch.pool, stride=1), dense).eval(), torch


def beside(bundle: Bundle, lines: list[bytes], rounds: int) -> dict[str, Any]:
    """Measure microseconds per step of both libraries, ratios within a round, and the difference of the logits."""
    arch, step = bundle.arch, bundle.arch.step
    raw = samples_of(bundle.layout, lines)
    whole, scaled = raw.astype(np.int64), bundle.scaler.apply_sample(raw)
    first = arch.span + step - arch.span % step
    blocks = [slice(at, at + step) for at in range(first, first + STEPS * step, step)]
    stepper, integer = bundle.network().stepper(), integer_model(bundle).network.stepper()
    ways: dict[str, tuple[Callable[[], object], Callable[[slice], Any]]] = {
        "ours, float (NumPy)": (
            lambda: (stepper.reset(), stepper.push(scaled[: blocks[0].start])),
            lambda at: stepper.push(scaled[at]),
        ),
        "ours, int8 (NumPy)": (
            lambda: (integer.reset(), integer.push(whole[: blocks[0].start])),
            lambda at: integer.push(whole[at]),
        ),
    }
    apart = None
    if importlib.util.find_spec("continual") is not None:
        net, torch = theirs(bundle)
        x = torch.from_numpy(np.ascontiguousarray(scaled.T[None]))

        def begin() -> None:
            net.clean_state()
            net.forward_steps(x[:, :, : blocks[0].start])

        def one_by_one(at: slice) -> Any:
            for t in range(at.start, at.stop):
                last = net.forward_step(x[:, :, t])
            return last

        ways["continual-inference, forward_step"] = begin, one_by_one
        ways["continual-inference, forward_steps"] = begin, lambda at: net.forward_steps(x[:, :, at])
        apart = 0.0
        with torch.inference_mode():
            stepper.reset()
            begin()
            mine = np.array(stepper.push(scaled[: blocks[-1].stop]))
            shift = (arch.span - 1) % step  # PlushSense answers at every step, continual-inference at every sample
            begin()
            for at in blocks:
                out = net.forward_steps(x[:, :, at])[0].numpy().T
                for t in range(at.start, at.stop):
                    if t % step == shift:
                        expected = mine[(t + 1 - arch.span) // step]
                        apart = max(apart, float(np.abs(out[t - at.start] - expected).max()))
            if not apart < 1e-3:
                raise SystemExit(f"The two networks do not agree: their logits differ by {apart}.")
            times = timed(ways, blocks, rounds)
    else:
        times = timed(ways, blocks, rounds)
    ours = times["ours, float (NumPy)"]
    rows = []
    for name, mine_s in times.items():
        ratios = sorted(a / b for a, b in zip(mine_s, ours, strict=True))
        rows.append(
            {
                "name": name,
                "us_a_step": round(1e6 * statistics.median(mine_s), 1),
                "times_slower": [round(r, 2) for r in (ratios[0], statistics.median(ratios), ratios[-1])],
            }
        )
    return {"network": arch.symbol, "rows": rows, "logits_apart": apart}


def timed(ways: dict[str, Any], blocks: list[slice], rounds: int) -> dict[str, list[float]]:
    """Measure seconds per step of each method in each round; the first round is for warming up and is not counted."""
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):
        for name, (begin, push) in ways.items():
            begin()
            began = time.perf_counter()
            for at in blocks:
                push(at)
            times[name].append((time.perf_counter() - began) / len(blocks))
    return {name: found[1:] for name, found in times.items()}


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
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--frames", type=int, default=30_000, help="of part 1")
    parser.add_argument("--toys", type=int, default=100, help="of part 3; 0: leave it out")
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
    report["network_only"] = [
        beside(one, lines_of(one.layout, one.arch.span + (STEPS + 12) * one.arch.step), args.rounds)
        for one in (bundle, made_up(bundle.layout, UNDILATED))
    ]
    report["many"] = many(bundle, args.toys, args.seconds) if args.toys else None
    report["load"] = [round(v, 2) for v in os.getloadavg()] if hasattr(os, "getloadavg") else None
    report["cores"] = os.cpu_count()
    if args.json:
        print(json.dumps(report))
        return
    print(f"{report['network']}, a step of {step_ms:g} ms; load {report['load']} on {report['cores']} cores\n")
    for engine, one in report["bytes_to_event"].items():
        for clock, of in (("ms", "on the wall"), ("processor_ms", "of the processor")):
            ms = one[clock]
            print(
                f"bytes to event, {engine:<6} p50 {ms['p50']} ms, p95 {ms['p95']} ms, p99 {ms['p99']} ms, longest "
                f"{ms['longest']} ms {of}, {one['steps']} steps"
            )
        print(f"{'':<22} {one['us_a_frame']} µs of processor time per frame")
    for one in report["network_only"]:
        title = f"{one['network']} alone, five samples per step"
        print(f"\n{title:<44}{'µs/step':>10}   times our float step (min, median, max)")
        for row in one["rows"]:
            low, middle, high = row["times_slower"]
            print(f"{row['name']:<44}{row['us_a_step']:>10}   {low} {middle} {high}")
        apart = one["logits_apart"]
        print("continual-inference is not installed" if apart is None else f"logits differ by at most {apart:.1e}")
    if report["many"]:
        one = report["many"]
        ms = one["latency_ms"]
        print(
            f"\n{one['toys']} virtual toys at 100 Hz in one thread for {one['wall_s']} s: {one['decisions']} "
            f"decisions, {one['late']} late; p50 {ms['p50']} ms, p99 {ms['p99']} ms, longest {ms['max']} ms; "
            f"{100 * one['busy']:.0f} % of a core"
        )


if __name__ == "__main__":
    main()
