"""Measure the cost of one decision every 50 ms: our C against the same network in other runtimes.

    THERE/bin/pip install tflite-micro ai-edge-litert ai-edge-quantizer onnxruntime onnx
    python bench/peers.py --python THERE/bin/python --cmsis-nn DIR [--save]

Install the other runtimes in an environment of their own (they install PyTorch and other large packages); `--python`
names its interpreter (default: the one that runs this program). `--cmsis-nn` is a copy of
github.com/ARM-software/CMSIS-NN. What is missing is listed with how to get it, and the rest is measured. gcc is
required, valgrind with its headers to count instructions, and gcc-arm-none-eabi, libnewlib-arm-none-eabi and
qemu-system-arm for the Cortex-M4. `--save` measures the two networks of docs/measurements/peers.md, and writes
bench/peers.json and from it the tables of the page.

Every runtime gets the same weights, with the normalisation folded in, quantized by its own tool on the same decisions,
and two graphs. That of the `stream` is our algorithm: it computes the 5 new samples of a step, and has each layer's
history and the means of earlier steps as further inputs and outputs. That of the `window` computes everything again, in
the form that takes fewer multiply-accumulates (`--form`): `window`, 250 samples with zeros before the first, or `span`,
exactly the samples that a decision of the stream reads. Where the two differ, each answer is checked against the float
answer of its own form. It runs on one thread, warm, with the input already in place; only its own call is timed and
counted. Our C also has a row with all that a toy does: five frames (validity, clock, magnitude, scaling), network,
smoothing and decision. The runtimes are timed in turn, and ratios are taken within a round. Instructions are counted
by callgrind for 2N decisions less those for N (its processor has AVX2 at most), and on the Cortex-M4 by QEMU: they are
not cycles. All frames and (without `--bundle`) all weights are generated: costs hardly depend on them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import plushsense
from plushsense.core.errors import PlushSenseError

sys.path.insert(0, str(Path(__file__).resolve().parent))

from opponents import programs
from opponents.case import FORMS, Case, make_case
from opponents.programs import CannotBuild, ChipRow, Entry, Workshop
from opponents.running import Died, Running, instructions
from opponents.tables import OUR_ROW, lines, page_of

WORKER = Path(__file__).resolve().parent / "opponents" / "worker.py"
RESULTS = Path(__file__).resolve().with_suffix(".json")
PAGE = RESULTS.parents[1] / "docs" / "measurements" / "peers.md"
LITERT = "ai-edge-litert ai-edge-quantizer"
# name: title, packages
PEERS: dict[str, tuple[str, str]] = {
    "tflite-micro": ("TensorFlow Lite Micro, int8, reference kernels", f"tflite-micro {LITERT}"),
    "litert": ("LiteRT, int8, XNNPACK", LITERT),
    "onnxruntime": ("onnxruntime, float", "onnxruntime onnx"),
    "onnxruntime-int8": ("onnxruntime, int8 (QDQ)", "onnxruntime onnx"),
}
C_PEERS = ("cmsis-nn",)
ALGORITHMS = ("stream", "window")
NETWORKS = {"paper": "14d1_39d2_41d4", "default": "14d1_19d2_19d4"}


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def made(peer: str, packages: str, algorithm: str, python: str, shop: Workshop) -> dict[str, Any]:
    """Let a Python runtime build its own model; return its facts."""
    command = [python, str(WORKER), "make", peer, algorithm, str(shop.folder)]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError as cause:
        raise CannotBuild(f"the interpreter {python} cannot be run ({cause.strerror}): give --python PATH") from None
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or [f"ended with {done.returncode}"])[-1]
        if last.startswith(("ModuleNotFoundError", "ImportError")):
            raise CannotBuild(f"not here: pip install {packages}")
        raise CannotBuild(f"could not be built: {last[:200]}")
    return dict(json.loads(done.stdout))


def python_entry(peer: str, algorithm: str, python: str, shop: Workshop) -> Entry:
    """Return the entry of a Python runtime."""
    title, packages = PEERS[peer]
    facts = made(peer, packages, algorithm, python, shop)
    return Entry(
        title, algorithm, [python, str(WORKER), "run", peer, algorithm, str(shop.folder)], facts["model_bytes"],
        memory_bytes=facts.get("memory_bytes"), versions=facts["versions"],
    )  # fmt: skip


def entries(args: argparse.Namespace, case: Case, shop: Workshop) -> tuple[list[Entry], list[ChipRow], dict[str, str]]:
    """Return what can run on this machine and on the emulated chip, and for each other one the reason."""
    peers = args.only.split(",") if args.only else [*PEERS, *C_PEERS]
    found, chip, absent = programs.ours(case, shop), list[Any](), dict[str, str]()

    def attempt(into: list[Any], name: str, algorithm: str, build: Callable[..., Any], *given: Any) -> None:
        say(f"{name}, {algorithm} …")
        try:
            into.append(build(*given))
        except (CannotBuild, PlushSenseError) as reason:
            absent[f"{name}, {algorithm}"] = str(reason)

    def cmsis_nn(algorithm: str) -> ChipRow:
        root = programs.require_cmsis_nn(Path(args.cmsis_nn) if args.cmsis_nn else None)
        facts = made("cmsis-nn", LITERT, algorithm, args.python, shop)
        header = shop.folder / f"cmsis-nn-{algorithm}.model"
        return programs.cmsis_nn(case, shop, algorithm, root, header, tuple(facts["logits"]))

    if "cmsis-nn" in peers:
        attempt(chip, "PlushSense C on the Cortex-M4", "stream", programs.ours_on_chip, case, shop)
    for algorithm in ALGORITHMS:
        for peer in (p for p in PEERS if p in peers):
            attempt(found, PEERS[peer][0], algorithm, python_entry, peer, algorithm, args.python, shop)
        if chip:
            attempt(chip, "CMSIS-NN int8", algorithm, cmsis_nn, algorithm)
    return found, [row for part in chip for row in (part if isinstance(part, list) else [part])], absent


def compared(reads: str, logits: NDArray[np.float64], case: Case) -> dict[str, float]:
    """Compare logits with the float ones of the same decisions."""
    if reads == "window":
        expected = case.window_logits[: len(logits)]
    else:
        expected, logits = case.stream_logits, logits[case.compared]
    return {
        "decisions": len(expected),
        "agreement": float((logits.argmax(axis=1) == expected.argmax(axis=1)).mean()),
        "logit_error": float(np.sqrt(np.square(logits - expected).mean()) / expected.std(axis=0).mean()),
    }


def checked(entry: Entry, process: Running, case: Case) -> dict[str, float] | None:
    """Check a program's answers; None for our network alone, which reads random inputs."""
    if entry.reads == "inputs":
        return None
    return compared(entry.reads, process.check(Path(entry.command[-1]), case.arch.classes), case)


def measure(found: list[Entry], absent: dict[str, str], args: argparse.Namespace, case: Case) -> list[dict[str, Any]]:
    """Check, time and count every entry; return one row for each."""
    rows: list[dict[str, Any]] = []
    running: list[tuple[Entry, Running, int, list[float]]] = []
    with contextlib.ExitStack() as open_:
        for entry in found:
            process = open_.enter_context(Running(entry.command, Path(entry.command[-1])))
            try:
                near = checked(entry, process, case)
                process.run(3)
                each = max(process.run(3), 1e-7)
            except Died as reason:
                absent[f"{entry.name}, {entry.reads}"] = f"ended while it ran: {reason}"
                continue
            rows.append({
                "name": entry.name, "reads": entry.reads, "check": near, "model_bytes": entry.model_bytes,
                "code_bytes": entry.code_bytes, "memory_bytes": entry.memory_bytes, "instructions": None,
            })  # fmt: skip
            running.append((entry, process, max(1, round(args.slice_ms / 1000 / each)), []))
        say(f"{args.rounds} rounds of {len(running)} …")
        for _ in range(args.rounds):
            for _, process, decisions, seconds in running:
                seconds.append(process.run(decisions))
    ours = next(seconds for entry, _, _, seconds in running if entry.name == OUR_ROW)
    for row, (entry, _, _, seconds) in zip(rows, running, strict=True):
        low, middle, high = (float(v) for v in np.quantile(1e6 * np.array(seconds), (0.1, 0.5, 0.9)))
        row["us"] = {"median": middle, "p10": low, "p90": high}
        row["times_slower"] = statistics.median(theirs / mine for theirs, mine in zip(seconds, ours, strict=True))
        if args.decisions:
            say(f"callgrind: {entry.name}, {entry.reads} …")
            try:
                row["instructions"] = instructions(entry.command, Path(entry.command[-1]), args.decisions)
            except Died as reason:
                absent[f"instructions of {entry.name}, {entry.reads}"] = str(reason)
    return rows


def machine() -> dict[str, Any]:
    """Describe the computer."""
    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    load = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    return {"cpu": cpu, "cores": os.cpu_count(), "system": platform.platform(), "load": load}


def bench(args: argparse.Namespace, symbol: str) -> dict[str, Any]:
    """Run everything and return plain values."""
    case = make_case(
        symbol, args.filters, layout=args.layout, gestures=args.gestures, window=args.window, form=args.form,
        bundle=args.bundle,
    )  # fmt: skip
    before = machine()
    with tempfile.TemporaryDirectory(prefix="peers-") as folder:
        case.save(Path(folder))
        shop = Workshop(Path(folder), args.cc)
        found, chip, absent = entries(args, case, shop)
        rows = measure(found, absent, args, case)
        versions = {"plushsense": plushsense.__version__}
        for entry in found:
            versions.update(entry.versions)
        arch = case.arch
        return {
            "case": {
                "symbol": arch.symbol, "channels": arch.channels, "classes": arch.classes, "form": case.form,
                "samples": case.length, "macs": case.macs, "macs_ours": arch.macs_per_step,
                "step_ms": arch.step * case.model.layout.period_us / 1000,
            },
            "rows": rows, "absent": absent, "versions": versions, "compiler": shop.version(), "machine": before,
            "chip": [
                {
                    "name": row.name, "reads": row.reads, "instructions": row.instructions,
                    "check": None if row.logits is None else compared(row.reads, row.logits, case),
                } for row in chip
            ],
        }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", default=NETWORKS["paper"])
    parser.add_argument("--filters", default="8,12,16")
    parser.add_argument("--layout", default="plush-15")
    parser.add_argument("--gestures", default="plush-18")
    parser.add_argument("--window", type=int, default=250)
    parser.add_argument("--bundle", help="a trained network in place of random weights")
    parser.add_argument("--form", choices=FORMS, default="cheapest", help="what the graph of the window reads")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the other runtimes")
    parser.add_argument("--cmsis-nn", help="folder of CMSIS-NN's sources")
    parser.add_argument("--cc", default="gcc")
    parser.add_argument("--only", help=f"of {','.join((*PEERS, *C_PEERS))}; 'none': ours alone")
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--slice-ms", type=float, default=10.0, help="how long each runs in a round")
    parser.add_argument("--decisions", type=int, default=10, help="to count instructions of; 0: do not count")
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--save", action="store_true", help="measure both networks, write bench/peers.json and the page"
    )
    args = parser.parse_args()
    if args.rounds < 1 or args.decisions < 0 or args.slice_ms <= 0:
        parser.error("--rounds is at least 1, --decisions at least 0, --slice-ms above 0")
    for name in (args.only or "none").split(","):
        if name not in (*PEERS, *C_PEERS, "none"):
            parser.error(f"--only names '{name}': known are {', '.join((*PEERS, *C_PEERS))} and none")
    try:
        if args.save:
            results = json.loads(RESULTS.read_text("utf-8")) if RESULTS.exists() else {}
            for name, symbol in NETWORKS.items():
                results[name] = bench(args, symbol)
                RESULTS.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", "utf-8")
                PAGE.write_text(page_of(PAGE.read_text("utf-8"), {name: results[name]}), "utf-8")
            return 0
        report = bench(args, args.arch)
    except (PlushSenseError, CannotBuild, Died) as refusal:
        say(f"bench/peers.py: {refusal}")
        return 2
    print(json.dumps(report) if args.json else "\n".join(lines(report)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
