"""Measure the cost of one decision every 50 ms: our C against the same network in other runtimes.

    THERE/bin/pip install tflite-micro ai-edge-litert ai-edge-quantizer torch==2.13.0 executorch onnxruntime onnx
    python bench/peers.py --python THERE/bin/python [--onnx2c PATH] [--json]

Install the other runtimes in an environment of their own (they install PyTorch and other large packages); `--python`
names its interpreter (default: the one that runs this program). Runtimes that are not installed are listed as "not
here". gcc is required, and valgrind with its headers to count instructions; onnx2c is built from
github.com/kraiskil/onnx2c.

Every runtime gets the same weights, with the normalisation folded in, quantized by its own tool on the same windows. It
runs on one thread, warm, with the input already in place; only its own call is timed and counted. The other runtimes
get the windowed network, which computes its window again at each decision. They could stream too, with the state as
variables or as inputs and outputs, in another graph; that is not measured. They read the window in the form that takes
fewer multiply-accumulates (`--form`): `window`, 250 samples with zeros before the first, or `span`, exactly the samples
that our streaming decision reads. Where the two differ, each answer is checked against the float answer of its own
form. Our C reads five frames (validity, clock, magnitude, scaling), runs the network, smooths and decides. The runtimes
are timed in turn, and ratios are taken within a round. Instructions are counted by callgrind for 2N decisions less
those for N; callgrind's processor has AVX2 at most. All frames and (without `--bundle`) all weights are generated:
costs hardly depend on them.
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
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

import plushsense
from plushsense.core.errors import PlushSenseError

sys.path.insert(0, str(Path(__file__).resolve().parent))

from opponents import programs
from opponents.case import FORMS, Case, make_case
from opponents.programs import CannotBuild, Entry, Workshop
from opponents.running import Died, Running, instructions

WORKER = Path(__file__).resolve().parent / "opponents" / "worker.py"
LITERT = "ai-edge-litert ai-edge-quantizer"
# name: title, family, packages
PEERS: dict[str, tuple[str, str, str]] = {
    "tflite-micro": ("TensorFlow Lite Micro, int8, reference kernels", "portable C", f"tflite-micro {LITERT}"),
    "litert": ("LiteRT, int8, XNNPACK", "xnnpack", LITERT),
    "executorch": ("ExecuTorch, int8, XNNPACK", "xnnpack", "executorch"),
    "onnxruntime": ("onnxruntime, float", "mlas", "onnxruntime onnx"),
    "onnxruntime-int8": ("onnxruntime, int8 (QDQ)", "mlas", "onnxruntime onnx"),
}
OUR_ROW = "PlushSense C -O2, frames to answer"
PLAIN_ROW = f"{OUR_ROW}, plain C"
# family, target ratio of instructions, what is compared, which of our programs: plain C against plain C
TARGETS = (
    ("portable C", 20.0, "the best portable C of a peer (onnx2c, TensorFlow Lite Micro)", PLAIN_ROW),
    ("xnnpack", 5.0, "XNNPACK's hand-vectorised window (LiteRT, ExecuTorch)", OUR_ROW),
    ("xnnpack", 5.0, "XNNPACK's hand-vectorised window, by our plain C", PLAIN_ROW),
)
FAITHFUL = 0.8  # share of decisions that equal the float ones, below which a runtime is reported as broken


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def python_entry(peer: str, python: str, shop: Workshop) -> Entry:
    """Return the entry of a Python runtime that builds its own model."""
    title, family, packages = PEERS[peer]
    command = [python, str(WORKER)]
    try:
        made = subprocess.run([*command, "make", peer, str(shop.folder)], capture_output=True, text=True)
    except OSError as cause:
        raise CannotBuild(f"the interpreter {python} cannot be run ({cause.strerror}): give --python PATH") from None
    if made.returncode != 0:
        last = (made.stderr.strip().splitlines() or [f"ended with {made.returncode}"])[-1]
        if last.startswith(("ModuleNotFoundError", "ImportError")):
            raise CannotBuild(f"not here: pip install {packages}")
        raise CannotBuild(f"could not be built: {last[:200]}")
    facts = json.loads(made.stdout)
    if facts.get("outside_xnnpack"):
        title += f", {len(facts['outside_xnnpack'])} operators outside"
    return Entry(
        title, family, "window", [*command, "run", peer, str(shop.folder)], facts["model_bytes"],
        memory_bytes=facts.get("memory_bytes"), versions=facts["versions"],
    )  # fmt: skip


def entries(args: argparse.Namespace, case: Case, shop: Workshop) -> tuple[list[Entry], dict[str, str]]:
    """Return the entries that can run on this machine, and for each other one the reason."""
    peers = args.only.split(",") if args.only else [*PEERS, "onnx2c", "plain"]
    found, absent = programs.ours(case, shop), {}
    for peer in (p for p in PEERS if p in peers):
        say(f"{PEERS[peer][0]} …")
        try:
            found.append(python_entry(peer, args.python, shop))
        except CannotBuild as reason:
            absent[PEERS[peer][0]] = str(reason)
    if "plain" in peers:
        found += programs.plain_window(case, shop)
    if "onnx2c" in peers:
        model = shop.folder / "float.onnx"
        try:
            if not model.exists():
                python_entry("onnxruntime", args.python, shop)
            found += programs.onnx2c(case, shop, args.onnx2c, model)
        except CannotBuild as reason:
            absent["onnx2c, float C"] = str(reason)
    return found, absent


def checked(entry: Entry, process: Running, case: Case) -> dict[str, float] | None:
    """Compare the logits of an entry with the float ones; None for the network alone, which reads random inputs."""
    if entry.reads == "stream":
        return None
    logits = process.check(Path(entry.command[-1]), case.arch.classes)
    if entry.reads == "frames":
        expected, logits = case.stream_logits, logits[case.ours]
    else:
        expected = case.window_logits
    return {
        "decisions": len(expected),
        "agreement": float((logits.argmax(axis=1) == expected.argmax(axis=1)).mean()),
        "logit_error": float(np.sqrt(np.square(logits - expected).mean()) / expected.std(axis=0).mean()),
    }


def measure(found: list[Entry], absent: dict[str, str], args: argparse.Namespace, case: Case) -> list[dict[str, Any]]:
    """Check, time and count every entry; return one row for each."""
    rows: list[dict[str, Any]] = []
    with contextlib.ExitStack() as open_:
        running: list[tuple[dict[str, Any], Running, int]] = []
        for entry in found:
            process = open_.enter_context(Running(entry.command, Path(entry.command[-1])))
            try:
                near = checked(entry, process, case)
                process.run(3)
                each = max(process.run(3), 1e-7)
            except Died as reason:
                absent[entry.name] = f"ended while it ran: {reason}"
                continue
            row: dict[str, Any] = {
                "name": entry.name, "family": entry.family, "reads": entry.reads, "check": near,
                "model_bytes": entry.model_bytes, "code_bytes": entry.code_bytes, "memory_bytes": entry.memory_bytes,
                "seconds": [],
            }  # fmt: skip
            rows.append(row)
            running.append((row, process, max(1, round(args.slice_ms / 1000 / each))))
        say(f"{args.rounds} rounds of {len(running)} …")
        for _ in range(args.rounds):
            for row, process, decisions in running:
                row["seconds"].append(process.run(decisions))
    for row in rows:
        row["instructions"], entry = None, next(e for e in found if e.name == row["name"])
        if args.decisions:
            say(f"callgrind: {entry.name} …")
            try:
                row["instructions"] = instructions(entry.command, Path(entry.command[-1]), args.decisions)
            except Died as reason:
                absent[f"instructions of {entry.name}"] = str(reason)
    compare(rows)
    return rows


def compare(rows: list[dict[str, Any]]) -> None:
    """Return medians, spreads, and ratios to our C."""
    ours = next(row for row in rows if row["name"] == OUR_ROW)
    for row in rows:
        us = 1e6 * np.array(row["seconds"])
        row["us"] = {
            "median": float(np.median(us)),
            "p10": float(np.quantile(us, 0.1)),
            "p90": float(np.quantile(us, 0.9)),
        }
        pairs = zip(row["seconds"], ours["seconds"], strict=True)
        row["times_slower"] = statistics.median(theirs / mine for theirs, mine in pairs)
        counts = row["instructions"], ours["instructions"]
        row["times_instructions"] = None if None in counts else counts[0] / counts[1]


def verdicts(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Compare with the targets of our C, by the runtime of each family that takes the fewest instructions."""
    results = []
    for family, least, who, ours in TARGETS:
        mine = next(row for row in rows if row["name"] == ours)["instructions"]
        them = [row for row in rows if row["family"] == family and row["instructions"] is not None]
        nearest = min(them, key=lambda row: row["instructions"], default=None)
        known = nearest is not None and mine is not None
        ratio = nearest["instructions"] / mine if known else None
        results.append(
            {
                "who": who,
                "at_least": least,
                "ratio": ratio,
                "ours": ours,
                "against": nearest["name"] if known else None,
                "reached": ratio >= least if known else None,
            }
        )
    return results


def machine() -> dict[str, Any]:
    """Describe the computer."""
    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), cpu)
    load = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    return {"cpu": cpu, "cores": os.cpu_count(), "system": platform.platform(), "load": load}


def _whole(value: int | None) -> str:
    return "–" if value is None else f"{value:,}"


def table(report: dict[str, Any]) -> Iterable[str]:
    """Yield the lines of the table and its notes."""
    case = report["case"]
    yield (
        f"{case['title']}, {case['channels']} channels, {case['classes']} classes: one decision every "
        f"{case['step_ms']:g} ms, one thread"
    )
    yield (
        f"ours: {case['macs_ours']:,} multiply-accumulates per decision; others recompute {case['samples']} samples "
        f"({case['form']}): {case['macs']:,}"
    )
    yield ""
    yield (
        f"{'':<47}{'µs (p10–p90)':>26}{'×':>7}{'instructions':>14}{'×':>8}{'model B':>9}{'code B':>9}{'memory B':>10}"
        f"{'as float':>10}{'error':>8}"
    )
    for row in report["rows"]:
        us, near = row["us"], row["check"]
        times = f"{us['median']:.1f} ({us['p10']:.1f}–{us['p90']:.1f})"
        count = "–" if row["instructions"] is None else f"{row['instructions']:,.0f}"
        ratio = "–" if row["times_instructions"] is None else f"{row['times_instructions']:.2f}"
        agree = "–" if near is None else f"{100 * near['agreement']:.1f} %"
        error = "–" if near is None else f"{100 * near['logit_error']:.1f} %"
        yield (
            f"{row['name']:<47}{times:>26}{row['times_slower']:>7.2f}{count:>14}{ratio:>8}{_whole(row['model_bytes']):>9}"
            f"{_whole(row['code_bytes']):>9}{_whole(row['memory_bytes']):>10}{agree:>10}{error:>8}"
        )
    for name, reason in report["absent"].items():
        yield f"{name:<47}  {reason}"
    yield ""
    yield (
        f"×: ratio to '{OUR_ROW}'. as float: decisions equal to the float network's, of {case['checked']}; error: of "
        "the logits, divided by their spread."
    )
    yield (
        "code B of C without a model file includes the weights; a runtime's own library is not counted, nor memory "
        "that it does not report."
    )
    yield "The others run the windowed network: each decision computes its whole window; streaming was not tried."
    for row in report["rows"]:
        if row["check"] is not None and row["check"]["agreement"] < FAITHFUL:
            yield f"BROKEN: {row['name']} agrees with the floats in {100 * row['check']['agreement']:.0f} % only."
    for target in report["targets"]:
        if target["ratio"] is None:
            yield f"Target, {target['at_least']:g}× fewer instructions than {target['who']}: not measured."
        else:
            word = "reached" if target["reached"] else "MISSED"
            yield (
                f"Target, {target['at_least']:g}× fewer instructions than {target['who']}: {word}, "
                f"{target['ratio']:.2f}× ({target['against']})."
            )
    computer = report["machine"]
    load = "" if computer["load"] is None else f", load {computer['load'][0]:.1f} before"
    yield f"{computer['cpu']}, {computer['cores']} cores{load}; {computer['system']}; {report['compiler']}"
    yield "; ".join(f"{name} {version}" for name, version in report["versions"].items())


def bench(args: argparse.Namespace) -> dict[str, Any]:
    """Run everything and return plain values."""
    case = make_case(
        args.arch, args.filters, layout=args.layout, gestures=args.gestures, window=args.window, form=args.form,
        bundle=args.bundle,
    )  # fmt: skip
    before = machine()
    with tempfile.TemporaryDirectory(prefix="peers-") as folder:
        case.save(Path(folder))
        shop = Workshop(Path(folder), args.cc)
        found, absent = entries(args, case, shop)
        rows = measure(found, absent, args, case)
        versions = {"plushsense": plushsense.__version__}
        for entry in found:
            versions.update(entry.versions)
        arch = case.arch
        return {
            "case": {
                "title": arch.title, "channels": arch.channels, "classes": arch.classes, "form": case.form,
                "samples": case.length, "macs": case.macs, "macs_ours": arch.macs_per_step, "span": arch.span,
                "step_ms": arch.step * case.model.layout.period_us / 1000, "checked": len(case.windows),
                "weights": "random" if args.bundle is None else Path(args.bundle).name,
            },
            "rows": rows, "absent": absent, "targets": verdicts(rows), "versions": versions,
            "compiler": shop.version(), "machine": before,
        }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arch", default="14d1_39d2_41d4")
    parser.add_argument("--filters", default="8,12,16")
    parser.add_argument("--layout", default="plush-15")
    parser.add_argument("--gestures", default="plush-18")
    parser.add_argument("--window", type=int, default=250)
    parser.add_argument("--bundle", help="a trained network in place of random weights")
    parser.add_argument("--form", choices=FORMS, default="cheapest", help="what the others read")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has the other runtimes")
    parser.add_argument("--onnx2c", default="onnx2c", help="the program onnx2c")
    parser.add_argument("--cc", default="gcc")
    parser.add_argument("--only", help=f"of {','.join(PEERS)},onnx2c,plain; 'none': ours alone")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--slice-ms", type=float, default=10.0, help="how long each runs in a round")
    parser.add_argument("--decisions", type=int, default=20, help="to count instructions of; 0: do not count")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    if args.rounds < 1 or args.decisions < 0 or args.slice_ms <= 0:
        parser.error("--rounds is at least 1, --decisions at least 0, --slice-ms above 0")
    for name in (args.only or "none").split(","):
        if name not in (*PEERS, "onnx2c", "plain", "none"):
            parser.error(f"--only names '{name}': known are {', '.join(PEERS)}, onnx2c, plain and none")
    try:
        report = bench(args)
    except (PlushSenseError, CannotBuild, Died) as refusal:
        say(f"bench/peers.py: {refusal}")
        return 2
    print(json.dumps(report) if args.json else "\n".join(table(report)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
