"""``plushsense profile OUT [--target NAME …] [--optimise -O2|-O3|-Os] [--trust]``."""

from __future__ import annotations

import argparse
import textwrap
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say, table
from plushsense.cli.settings import listed
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.deploy.profile import Cost, Profile

_STAGES = {
    "clock": "clock, validity",
    "health": "health of the sensors",
    "inputs": "inputs, magnitude",
    "gate": "gate",
    "network": "network",
    "dense": "dense layer",
    "decision": "softmax, smoothing",
    "events": "events",
    "pooling": "pooling, answer",
}


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", metavar="OUT", help="folder written by plushsense export")
    parser.add_argument(
        "--target",
        action="append",
        default=[],
        metavar="NAME",
        help="xtensa, cortex-m4, cortex-m0, riscv32, or host for sizes only; several joined by commas (default: every "
        "installed emulator)",
    )
    parser.add_argument("--optimise", default="O2", choices=("O2", "O3", "Os"), help="compiler optimisation (O2)")
    parser.add_argument(
        "--trust", action="store_true", help="compile and run C files of OUT that this version would not write"
    )


def run(args: argparse.Namespace) -> int:
    from plushsense.deploy.profile import profile

    result = profile(
        args.out,
        listed(*args.target),
        optimise=f"-{args.optimise}",
        trust=args.trust,
        progress=ProgressReporter("targets"),
    )
    for name, packages in result.missing.items():
        say(f"left out: {name}, which needs Debian's {' '.join(packages)}")
    emit(args, result.to_dict(), format_profile(result))
    return 0


def format_profile(profile: Profile) -> list[str]:
    """Format the profile as text."""
    arch = profile.arch
    layers = ", ".join(f"{name} {macs:,}" for name, macs in profile.macs_by_layer.items())
    return [
        f"{arch.title}: a step is {arch.step} samples, {profile.step_ms:g} ms; compiled with {profile.optimise}",
        f"  MACs a step  {arch.macs_per_step:,} ({layers})",
        *_counts(profile),
        "",
        *_bytes(list(profile.costs.values())),
        *_times(profile),
    ]


def _counts(profile: Profile) -> list[str]:
    from plushsense.deploy.profile import STEPS

    costs = [c for c in profile.costs.values() if c.stages]
    if not costs:
        return []
    rows: list[list[str]] = [[words, *(f"{c.stages[key]:,}" for c in costs)] for key, words in _STAGES.items()]
    rows += [
        ["whole step", *(f"{c.step:,}" for c in costs)],
        ["dearest step", *(f"{c.step_most:,}" for c in costs)],
        [f"longest gap ({profile.facts['gap_ms']} ms), one call", *(f"{c.gap:,}" for c in costs)],
        ["plush_begin, once", *(f"{c.begin:,}" for c in costs)],
        ["network, for each MAC", *(f"{c.stages['network'] / profile.arch.macs_per_step:.2f}" for c in costs)],
    ]
    window, times = profile.window_instructions, profile.arch.macs_per_window / profile.arch.macs_per_step
    again = (
        f"Recomputing all {profile.arch.span} samples of the span at every step takes {profile.arch.macs_per_window:,} "
        f"MACs, {times:.0f} times as many; with the same instructions for each MAC about "
        + ", ".join(f"{window[c.target] / 1e6:.1f} M on {c.target}" for c in costs)
        + " (estimate)."
    )
    return [
        "",
        f"Instructions, counted (mean of {STEPS} steps; frames come up to a fifth of a period early or late)",
        table(["", *(c.target for c in costs)], rows),
        *textwrap.wrap(again, 118),
    ]


def _bytes(costs: list[Cost]) -> list[str]:
    def part(cost: Cost, file: str, *names: str) -> str:
        return f"{sum(cost.sections[file][n] for n in names):,}"

    def known(value: int | None) -> str:
        return "not measured" if value is None else f"{value:,}"

    rows = [
        ["flash: code", *(part(c, "plushsense", "text") for c in costs)],
        ["flash: its tables", *(part(c, "plushsense", "rodata", "data") for c in costs)],
        ["flash: model", *(part(c, "plush_model", "text", "rodata", "data") for c in costs)],
        ["flash, all", *(f"{c.flash_bytes:,}" for c in costs)],
        ["RAM: toy", *(f"{c.toy_bytes:,}" for c in costs)],
        ["RAM: its memory", *(f"{c.memory_bytes:,}" for c in costs)],
        ["RAM, all", *(f"{c.ram_bytes:,}" for c in costs)],
        ["stack: plush_push", *(known(c.stack_push) for c in costs)],
        ["stack: plush_begin", *(known(c.stack_begin) for c in costs)],
        ["stack: plush_memory_bytes", *(known(c.stack_memory_bytes) for c in costs)],
    ]
    needs = "; ".join(f"{c.target}: {', '.join(c.needs) or 'nothing'}" for c in costs)
    heap = sorted({s for c in costs for s in c.heap})
    floats = sorted({s for c in costs for s in c.floats})
    proof = (
        f"Heap: {', '.join(heap) or 'none'}. Floating point: {', '.join(floats) or 'none'}. All that plushsense.o "
        f"needs from outside, on {needs}."
    )
    frames = "; ".join(
        f"{c.target}: " + ", ".join(f"{f} {n}" for f, n in list(c.stack_functions.items())[:4])
        for c in costs
        if c.stack_functions
    )
    proof += f" Largest frames, as the compiler says: {frames}." if frames else ""
    proof += " Stack comes on top of RAM; an ESP32, S2 or S3 has windows of registers and needs more than xtensa here."
    return ["Bytes", table(["", *(c.target for c in costs)], rows), *textwrap.wrap(proof, 118)]


def _times(profile: Profile) -> list[str]:
    from plushsense.deploy.profile import SUMMARY

    if not profile.estimates:
        return []
    rows = [
        [
            e.core.title,
            e.core.mhz,
            e.core.target,
            f"{e.core.cycles_low:g} to {e.core.cycles_high:g}",
            f"{e.low_ms:.2g} to {e.high_ms:.2g}",
            e.answer,
        ]
        for e in profile.estimates.values()
    ]
    why: dict[str, list[str]] = {}
    for e in profile.estimates.values():
        why.setdefault(e.core.reasons, []).append(e.core.title.partition(" (")[0])
    return [
        "",
        *textwrap.wrap(f"Time of a step, ESTIMATED. {SUMMARY}", 118),
        table(
            ["chip", "MHz", "counted on", "cycles an instruction", "ms a step", f"fits {1000 / profile.step_ms:g} Hz"],
            rows,
        ),
        "Where the bounds come from:",
        *(line for words, names in why.items() for line in _wrapped(f"{', '.join(names)}: {words}.")),
    ]


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 116, initial_indent="  ", subsequent_indent="    ")
