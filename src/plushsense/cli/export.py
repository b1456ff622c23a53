"""Implement ``plushsense export BUNDLE OUT [--patch-for …]``, ``verify OUT`` and ``profile OUT``."""

from __future__ import annotations

import argparse
import textwrap
from typing import TYPE_CHECKING

from plushsense.cli.output import emit, say, table, warn
from plushsense.cli.settings import listed
from plushsense.core.errors import ConfigError
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.deploy.code import ConversionFacts
    from plushsense.deploy.profile import Cost, PaperComparison, Profile
    from plushsense.deploy.proof.verify import VerificationResult

_SAMPLES = 100_000
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


def _conversion(entry: ConversionFacts) -> str:
    largest = entry.largest_difference
    difference = "" if largest is None else f"; logits differ from the original by at most {largest:.1g}"
    return f"  {entry.file:<17} {entry.bytes:,} bytes{difference}"


def run(args: argparse.Namespace) -> int:
    from plushsense.workflow.export import PackageNames, export

    if args.patch_for is not None:
        return _patch(args)
    also = listed(args.also)
    package = PackageNames(args.name, args.model_version, args.url)
    done = export(args.bundle, args.out, dataset=args.dataset, also=also, package=package, warn=warn)
    facts = done.facts
    simulated = ["  SIMULATION: trained on a virtual toy, not on real touch"] if facts.simulated else []
    emit(
        args,
        done.to_json(),
        [
            f"{args.out}: {facts.title}, {facts.classes} gestures, layout {facts.layout}",
            *simulated,
            f"  model             {facts.flash_bytes:,} bytes of flash, without the code (see plushsense profile)",
            f"  memory            {facts.ram_bytes:,} bytes of RAM",
            *(f"  accelerometer     {rest.sentence}" for rest in facts.rest),
            f"  a step            {facts.step_ms:g} ms, {facts.macs_per_step:,} MACs",
            *(_conversion(entry) for entry in facts.conversions.values()),
            f"  prove it          plushsense verify {args.out}",
        ],
    )
    return 0


def _patch(args: argparse.Namespace) -> int:
    from plushsense.workflow.export import export_patch

    if args.also:
        raise ConfigError("--also writes formats of a whole export: leave it out, or leave out --patch-for.")
    for option in ("name", "model_version", "url"):
        if getattr(args, option):
            words = f"--{option.replace('_', '-')}"
            raise ConfigError(f"{words} is for a whole export: a patch holds no names or versions, so leave it out.")
    done = export_patch(args.bundle, args.out, export=args.patch_for, dataset=args.dataset, warn=warn)
    emit(args, done.to_json(), [f"{done.path}: {done.bytes:,} bytes, for plush_patch on a toy with {args.patch_for}"])
    return 0


def run_verify(args: argparse.Namespace) -> int:
    from plushsense.dataset.index import open_dataset
    from plushsense.deploy.proof.device import verify_device
    from plushsense.deploy.proof.vectors import Export
    from plushsense.deploy.proof.verify import verify
    from plushsense.devices.virtual.scenario import load_scenario
    from plushsense.devices.virtual.stream import ToySpec

    if args.subject and not args.dataset:
        raise ConfigError("--subject chooses people of a data set: give --dataset too.")
    if args.samples is not None and args.samples < 1:
        raise ConfigError(f"--samples is {args.samples}: give 1 or more.")
    for option in ("target", "trust") if args.device else ():
        if getattr(args, option):
            message = f"--{option} is for programs that are compiled here: leave it out, or leave out --device."
            raise ConfigError(message)
    export = Export(args.export)
    if args.dataset:
        vectors = export.recorded(open_dataset(args.dataset), listed(*args.subject), args.samples or _SAMPLES)
        if args.samples and sum(v.samples for v in vectors) < args.samples:
            warn(f"these recordings make {sum(v.samples for v in vectors):,} samples, not {args.samples:,}")
    else:
        vectors = export.made_up(args.samples or 0)
    if args.scenario:
        vectors += export.played(ToySpec.of(load_scenario(args.scenario)))
    progress = ProgressReporter("verify")
    if args.device:
        done = verify_device(export, args.device, vectors, progress=progress)
    else:
        done = verify(export, listed(*args.target), vectors, trust=args.trust, progress=progress)
    emit(args, {"export": args.export, **done.to_json()}, verification_lines(done))
    return 0 if done.passed else 1


def verification_lines(done: VerificationResult) -> list[str]:
    streams = [f"{v.name}: {v.samples:,} samples of {v.frames:,} frames, {v.answers:,} answers" for v in done.counts]
    rows = [
        (r.target, r.compiler, r.flags, f"{r.vectors}", f"{r.mismatches}", f"{r.max_abs_diff}", f"{r.seconds:.1f}")
        for r in done.runs
    ]
    head = ("target", "compiler", "flags", "vectors", "mismatches", "largest difference", "seconds")
    lines = [done.title, *streams, "", table(head, rows)]
    lines += [
        f"cycles of plush_push by {r.cycles.counter}: {r.cycles.per_step:,.0f} a step on average of {r.cycles.steps:,} "
        f"steps; longest call {r.cycles.longest:,}"
        for r in done.runs
        if r.cycles
    ]
    lines += [f"not run: {part} ({reason})" for part, reason in done.not_run]
    if done.first:
        lines += ["", done.first]
    elif done.passed:
        lines += ["", "Every number of every answer is equal."]
    else:
        lines += ["", "Nothing is proven: the toy was still warming up in all answers. Export the model again."]
    if done.own is None:
        lines += ["", "Which program the chip runs cannot be seen from here: it reports the model and its answers."]
    elif not done.own:
        lines += [
            "",
            f"NOT OURS: {', '.join(done.changed)} {'is' if len(done.changed) == 1 else 'are'} not what this PlushSense "
            "writes for the bundle in the folder; equal answers say nothing about what else its code does. Export it "
            "again to be sure.",
        ]
    return lines


def run_profile(args: argparse.Namespace) -> int:
    from plushsense.deploy.profile import profile

    result = profile(
        args.export,
        listed(*args.target),
        optimise=f"-{args.optimise}",
        trust=args.trust,
        progress=ProgressReporter("targets"),
    )
    for name, packages in result.missing.items():
        say(f"left out: {name}, which needs Debian's {' '.join(packages)}")
    if not args.paper:
        emit(args, result.to_json(), format_profile(result))
        return 0
    from plushsense.deploy.profile import compare_with_paper

    paper = compare_with_paper(result)
    emit(args, result.to_json() | {"paper": paper.to_json()}, format_profile(result) + format_paper(paper))
    return 0


def format_paper(paper: PaperComparison) -> list[str]:
    """Format the paper's estimate beside ours as text."""
    from plushsense.deploy.profile import FLOAT_MMAC_S, INT16_MMAC_S, OURS_ASSUMES, PAPER_ASSUMES

    def written(ms: float) -> str:
        return f"{ms:.2f}" if ms < 1 else f"{ms:.1f}" if ms < 10 else f"{ms:.0f}"

    def bounds(ms: tuple[float, float] | None) -> str:
        return "not counted: needs the target xtensa" if ms is None else f"{written(ms[0])} to {written(ms[1])} ms"

    rows = [(e.what, f"{e.macs / 1e6:.3f}", written(e.float_ms), written(e.int16_ms)) for e in paper.estimates]
    head = ("", "MMAC", f"ms at {FLOAT_MMAC_S:g} MMAC/s (float)", f"ms at {INT16_MMAC_S:g} MMAC/s (int16)")
    return [
        "",
        "Section 4.7 of the paper: the time on an ESP32 from its MACs. All are estimates: nothing ran on a chip.",
        table(head, rows),
        f"  ours, a step of this network               {bounds(paper.step_ms)}, 8 bits, from counted instructions",
        f"  ours, if it computed its whole span again  {bounds(paper.window_ms)}, by the same instructions for each "
        "MAC, without waiting for the flash",
        f"  weights in floats, as the paper counts     {paper.float_bytes / 1000:.0f} kB",
        "The paper assumes:",
        *(line for text in PAPER_ASSUMES for line in _wrapped(f"{text}.")),
        "Our estimate assumes:",
        *(line for text in OURS_ASSUMES for line in _wrapped(f"{text}.")),
    ]


def format_profile(profile: Profile) -> list[str]:
    """Format the profile as text."""
    arch = profile.arch
    layers = ", ".join(f"{name} {macs:,}" for name, macs in profile.macs_by_layer.items())
    return [
        f"{arch.title}: a step is {arch.step} samples, {profile.step_ms:g} ms; compiled with {profile.optimise}",
        f"  MACs a step  {arch.macs_per_step:,} ({layers})",
        *_counts(profile),
        *(["", *_bytes(list(profile.costs.values()))] if profile.costs else []),
        *_times(profile),
        *_web(profile),
    ]


def _web(profile: Profile) -> list[str]:
    if (web := profile.web) is None:
        return []
    return [
        "",
        "In a browser",
        f"  module            {web.module_bytes:,} bytes; {web.memory_bytes:,} bytes of memory while it runs",
        f"  script            {web.script_bytes:,} bytes",
        f"  page of one file  {web.page_bytes:,} bytes",
        f"  a step            {web.step_us:.1f} µs in Node on this computer, by way of plushsense.js",
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
        [f"longest gap ({profile.facts.gap_ms} ms), one call", *(f"{c.gap:,}" for c in costs)],
        ["longest call seen", *(f"{c.call_most:,}" for c in costs)],
        ["longest call, bound", *(f"{c.call_bound:,}" for c in costs)],
        ["plush_begin, once", *(f"{c.begin:,}" for c in costs)],
        ["network, for each MAC", *(f"{c.stages['network'] / profile.arch.macs_per_step:.2f}" for c in costs)],
    ]
    arch, window = profile.arch, profile.window_instructions
    again = (
        f"Recomputing all {arch.span} samples of the span at every step takes {arch.macs_per_window:,} MACs, "
        f"{arch.macs_per_window / arch.macs_per_step:.0f} times as many; with the same instructions for each MAC about "
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
    masking = sorted({s for c in costs for s in c.masking})
    proof = (
        f"Heap: {', '.join(heap) or 'none'}. Floating point: {', '.join(floats) or 'none'}. "
        f"Interrupts switched off: {', '.join(masking) or 'never'}. All that plushsense.o "
        f"needs from outside, on {needs}."
    )
    frames = "; ".join(
        f"{c.target}: " + ", ".join(f"{f} {n}" for f, n in list(c.stack_functions.items())[:4])
        for c in costs
        if c.stack_functions
    )
    proof += f" Largest frames, as reported by the compiler: {frames}." if frames else ""
    proof += " Stack comes on top of RAM; an ESP32, S2 or S3 has windows of registers and needs more than xtensa here."
    return ["Bytes", table(["", *(c.target for c in costs)], rows), *textwrap.wrap(proof, 118)]


def _times(profile: Profile) -> list[str]:
    from plushsense.deploy.profile import FETCHING, SUMMARY

    if not profile.estimates:
        return []
    rows = [
        [
            e.core.title,
            e.core.mhz,
            e.core.target,
            f"{e.core.cycles_low:g} to {e.core.cycles_high:g}",
            f"{_two_digits(e.low_ms)} to {_two_digits(e.core_ms)}",
            _two_digits(e.flash_ms) if e.flash_ms else "-",
            _two_digits(e.call_ms),
            e.answer,
        ]
        for e in profile.estimates.values()
    ]
    head = ["chip", "MHz", "counted on", "cycles", "ms a step", "flash, up to", "longest call"]
    head += [f"fits {1000 / profile.step_ms:g} Hz"]
    why: dict[str, list[str]] = {}
    for e in profile.estimates.values():
        core = e.core
        flash = "" if core.flash_mb_s is None else f"; flash at {core.flash_mb_s:g} MB/s"
        why.setdefault(f"{core.why}{flash}; current: {core.power}", []).append(core.title.partition(" (")[0])
    return [
        "",
        *textwrap.wrap(f"Time of a step, ESTIMATED. {SUMMARY}", 118),
        table(head, rows),
        *textwrap.wrap(
            "cycles: of an instruction. longest call: ms at most, by the bound above and with fetching; so long the "
            "caller of plush_push is busy, while interrupts are served. " + FETCHING,
            118,
        ),
        *_energy(profile),
        "Where the bounds come from:",
        *(line for words, names in why.items() for line in _wrapped(f"{', '.join(names)}: {words}.")),
    ]


def _energy(profile: Profile) -> list[str]:
    rows = [
        [
            e.core.title,
            f"{e.core.volts:g}",
            " to ".join(f"{ma:g}" for ma in dict.fromkeys(e.core.ma)),
            " to ".join(map(_two_digits, e.energy_uj)),
            " to ".join(_two_digits(uj / profile.step_ms) for uj in e.energy_uj),
        ]
        for e in profile.estimates.values()
    ]
    return [
        "",
        *textwrap.wrap(
            "Energy of a step, ESTIMATED: time x voltage x the datasheet's current of the whole chip while its core "
            "runs, radio off. What it needs between two steps, and sensors, radio and regulator, come on top.",
            118,
        ),
        table(["chip", "V", "mA", "uJ a step", "mW on average"], rows),
    ]


def _two_digits(number: float) -> str:
    return f"{number:.2g}" if number < 99.5 else f"{number:.0f}"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, 116, initial_indent="  ", subsequent_indent="    ")
