"""Measure the cost of the C code of an export on a target: instructions, bytes by section, stack, required symbols."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from plushsense.core.errors import BadInput, ConfigError, ProgramError, ToolError, check_known
from plushsense.core.toml import load_table, read_toml
from plushsense.deploy.code import GOLDEN, IMAGE, LIBRARY, MODEL, ModelFacts
from plushsense.deploy.golden import Vectors, read_golden
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.targets import (
    C_FOLDER,
    TARGETS,
    CompileSpec,
    Program,
    build,
    missing_tools,
    require,
    tool,
    tool_output,
)
from plushsense.deploy.web import MODULE, WASM, WebCost, web_cost
from plushsense.models.arch import Arch
from plushsense.runtime.fixed import Ints


@dataclass(frozen=True)
class Core:
    """Core of a chip, described in ``cores.toml``; ``cycles_low`` and ``cycles_high`` are per instruction, ``ma`` the
    lowest and highest current in mA while it runs, by ``power``.
    """

    name: str
    title: str
    mhz: int
    target: str
    cycles_low: float
    cycles_high: float
    why: str
    volts: float
    ma: tuple[float, float]
    power: str
    flash_mb_s: float | None = None
    model_in_flash: bool = True


@cache
def cores() -> tuple[Core, ...]:
    """Return the cores of ``cores.toml``."""
    path = Path(__file__).with_name("cores.toml")
    return tuple(load_table(row, Core, path.name, BadInput) for row in read_toml(path, "cores", BadInput)["cores"])


@dataclass(frozen=True)
class Estimate:
    """Estimated time and energy of one step on a core; ``step_ms`` is the time available.

    The core alone needs between ``low_ms`` and ``core_ms``; fetching code and model from the flash adds up to
    ``flash_ms``. ``call_ms`` is what the longest call of ``plush_push`` takes at most, with its share of fetching.
    """

    core: Core
    instructions: int
    step_ms: float
    low_ms: float
    core_ms: float
    flash_ms: float
    call_ms: float

    @property
    def high_ms(self) -> float:
        """Upper bound of the time in ms, with fetching."""
        return self.core_ms + self.flash_ms

    @property
    def energy_uj(self) -> tuple[float, float]:
        """Lower and upper bound of the energy of a step in microjoules: time x voltage x current of the datasheet."""
        low, high = (self.core.volts * ma for ma in self.core.ma)
        return self.low_ms * low, self.high_ms * high

    @property
    def fits(self) -> str:
        """Whether a step fits into ``step_ms``: ``yes``, ``no``, or ``unsure`` if that is between the bounds."""
        return "yes" if self.high_ms <= self.step_ms else "no" if self.low_ms > self.step_ms else "unsure"

    @property
    def answer(self) -> str:
        """Verdict as text, with the share of the core's time and, if it fits, the rest of a step."""
        low, high = (f"{100 * ms / self.step_ms:.2g}" for ms in (self.low_ms, self.high_ms))
        if self.fits == "yes":
            return f"yes, uses about {low} to {high} % of the core, {self.step_ms - self.high_ms:.0f} ms left a step"
        if self.fits == "unsure":
            return f"not sure, it would use about {low} to {float(high):g} % of the core"
        return f"no, it would use {float(low):g} % of the core or more"

    @property
    def verdict(self) -> str:
        """Verdict as text, with the rate of steps."""
        return f"fits {1000 / self.step_ms:g} Hz: {self.answer}"

    def to_json(self) -> dict[str, object]:
        """Return the estimate as plain values for JSON."""
        core = self.core
        return {
            "estimate": True,
            "chip": core.title,
            "mhz": core.mhz,
            "counted_on": core.target,
            "instructions": self.instructions,
            "cycles_per_instruction": [core.cycles_low, core.cycles_high],
            "flash_mb_s": core.flash_mb_s,
            "low": round(self.low_ms, 3),
            "high": round(self.high_ms, 3),
            "of_it_flash": round(self.flash_ms, 3),
            "longest_call": round(self.call_ms, 3),
            "energy_uj": [round(uj, 1) for uj in self.energy_uj],
            "volts": core.volts,
            "current_ma": list(core.ma),
            "current_source": core.power,
            "fits": self.fits,
            "verdict": self.verdict,
            "why": core.why,
        }


def estimate(core: Core, cost: Cost, arch: Arch, step_ms: float) -> Estimate | None:
    """Estimate the time of a step on a core from its counts; None if there are none.

    A serial flash adds fetching what runs and is read (`Cost.running_bytes`): once for each frame of a step, as other
    code may run between two of them.
    """
    if cost.step is None or cost.call_bound is None:
        return None
    low, high = (cost.step * cycles / core.mhz / 1000 for cycles in (core.cycles_low, core.cycles_high))
    once = flash = 0.0
    if core.flash_mb_s is not None:
        running = cost.running_bytes(with_model=core.model_in_flash)
        once = running / core.flash_mb_s / 1000
        flash = once * arch.step
    call = cost.call_bound * core.cycles_high / core.mhz / 1000 + once
    return Estimate(core, cost.step, step_ms, low, high, flash, call)


STEPS = 50  # number of decisions whose instructions are counted
_STRESS = 100  # frames
STAGES = ("health", "inputs", "gate", "network", "dense", "decision", "events", "pooling")
_HEAP = ("malloc", "calloc", "realloc", "free", "reallocarray", "aligned_alloc", "sbrk", "_sbrk", "_Znw", "_Zna")
# Helper functions of compilers for floating point: __addsf3, __mulsf3, __floatsidf, __aeabi_fadd, __aeabi_i2d …
_FLOAT = re.compile(r"^__(\w*[sdt]f\d?$|float|fix|aeabi_[fd](?!iv)|aeabi_u?[il]2[fd])")
# Instructions of Arm, Xtensa, RISC-V and x86 that change the state of interrupts or wait.
_MASKING = re.compile(r"\t(cpsi[de]|msr|rsil|[wx]sr(?:\.\w+)?|waiti|csr[rwsc]\w*|wfi|wfe|cli|hlt)\b")
_SECTIONS: dict[str, tuple[str, ...]] = {
    "text": (".text", ".literal"),
    "rodata": (".rodata", ".srodata"),
    "data": (".data", ".sdata"),
}
_SECTIONS["bss"] = (".bss", ".sbss")
# Part of text: functions of plush_begin and its like, which no plush_push calls.
_OTHERS = "checksum check word_at next_bytes next_fill next_text next_scales read_head take share_out prepare"
_OTHERS += " bytes_needed take_over plush_memory_bytes plush_begin plush_swap plush_patch plush_model_id"
_SECTIONS["others"] = tuple(f"{kind}.unlikely.{name}" for name in _OTHERS.split() for kind in (".text", ".literal"))


@dataclass(frozen=True)
class Cost:
    """Cost on one target in instructions and bytes; counts are None if the target does not count (the host).

    ``step`` is the mean over `STEPS` decisions with frames up to a fifth of a period early or late, ``step_most``
    their maximum, ``even`` the mean with even time stamps; ``gap`` is a call that bridges the longest gap.
    ``call_most`` is the longest call of ``plush_push`` that was seen, also with readings at the ends of their ranges,
    ``call_bound`` a bound of it (`_bound`). ``stages`` add up to ``step``: ``clock`` (with the check of values) is the
    remainder, ``gate`` is 0 for a model without one. ``stack_push``, ``stack_begin`` and ``stack_memory_bytes`` are the
    stack depths of these functions, without a callback; ``stack_functions`` is the stack frame of each function as the
    compiler reports it. ``masking`` are the instructions that switch interrupts off or wait for one.
    """

    target: str
    step: int | None
    step_most: int | None
    even: int | None
    gap: int | None
    call_most: int | None
    call_bound: int | None
    begin: int | None
    stages: Mapping[str, int]
    sections: Mapping[str, Mapping[str, int]]
    toy_bytes: int
    memory_bytes: int
    stack_push: int | None
    stack_begin: int | None
    stack_memory_bytes: int | None
    stack_functions: Mapping[str, int]
    needs: tuple[str, ...]
    masking: tuple[str, ...]

    @property
    def flash_bytes(self) -> int:
        """Bytes of code, tables and model."""
        return sum(part[name] for part in self.sections.values() for name in ("text", "rodata", "data"))

    def running_bytes(self, *, with_model: bool = True) -> int:
        """Return the bytes that ``plush_push`` may run and read: all but the code of ``plush_begin`` and its like."""
        code, model = (self.sections[name] for name in ("plushsense", "plush_model"))
        own = code["text"] - code["others"] + code["rodata"] + code["data"]
        return own + (model["rodata"] + model["data"] if with_model else 0)

    @property
    def ram_bytes(self) -> int:
        """Bytes of one toy object, its memory and static data, without the stack."""
        static = sum(part[name] for part in self.sections.values() for name in ("data", "bss"))
        return self.toy_bytes + self.memory_bytes + static

    @property
    def heap(self) -> tuple[str, ...]:
        """Symbols of a heap that the library requires; should be empty."""
        return tuple(s for s in self.needs if s.startswith(_HEAP))

    @property
    def floats(self) -> tuple[str, ...]:
        """Helper functions for floating point that the library requires; should be empty."""
        return tuple(s for s in self.needs if _FLOAT.match(s))

    def to_json(self) -> dict[str, object]:
        """Return the cost as plain values for JSON."""
        return {
            "title": TARGETS[self.target].title,
            "instructions_per_step": self.step,
            "instructions_per_step_most": self.step_most,
            "instructions_per_step_even": self.even,
            "instructions_longest_call": self.gap,
            "instructions_call_most": self.call_most,
            "instructions_call_bound": self.call_bound,
            "instructions_begin": self.begin,
            "stages": dict(self.stages),
            "sections": {name: dict(part) for name, part in self.sections.items()},
            "flash_bytes": self.flash_bytes,
            "ram_bytes": self.ram_bytes,
            "toy_bytes": self.toy_bytes,
            "memory_bytes": self.memory_bytes,
            "stack_push_bytes": self.stack_push,
            "stack_begin_bytes": self.stack_begin,
            "stack_memory_bytes_call": self.stack_memory_bytes,
            "stack_functions": dict(self.stack_functions),
            "needs": list(self.needs),
            "interrupts_off": list(self.masking),
            "heap": list(self.heap),
            "floating_point": list(self.floats),
        }


def count(folder: Path, target: str, facts: ModelFacts, optimise: str = "-O2", *, code: Path | None = None) -> Cost:
    """Build the C code of an export folder for a target, run it there, and count instructions.

    The folder is only read. ``code`` is another folder from which to take the C code.

    Raises:
        ToolError: if a tool is missing or fails.
        BadInput: if there are too few golden frames.
    """
    code = code or folder
    even, jittered, stress = _streams(folder, facts)
    with tempfile.TemporaryDirectory(prefix="plushsense-profile-") as temporary:
        work = Path(temporary)
        blobs = {name: work / name.lower() for name in ("EVEN", "JITTERED", "STRESS")}
        for frames, file in zip((even, jittered, stress), blobs.values(), strict=True):
            file.write_bytes(frames.astype("<i4").tobytes())
        sources = [C_FOLDER / "profile.c", code / MODEL[1]]
        same = partial(build, target, include=[code], blobs=blobs)
        stacks, stages_too = (CompileSpec(optimise=optimise, flags=(f,)) for f in ("-fstack-usage", "-DPLUSH_STAGES=1"))
        whole = same([*sources, code / LIBRARY[1]], work / "whole", stacks)
        head, rows_even, rows_jittered = _whole(whole, facts)
        counts = TARGETS[target].counts
        stages: dict[str, int] = {}
        bound = None
        if counts:
            staged = same(sources, work / "stages", stages_too)
            rows = np.frombuffer(staged.run(), dtype="<i4").astype(np.int64).reshape(-1, len(STAGES))
            bound, rows = _bound(rows[-2], rows[-1], facts.step), rows[:-2]
            stages = {name: _mean(rows[:, i]) for i, name in enumerate(STAGES)}
            stages = {"clock": _mean(rows_jittered[:-1, 0]) - sum(stages.values()), **stages}
        objects = {"plushsense": whole.objects[2], "plush_model": whole.objects[1]}
        steps = rows_jittered[:-1, 0]
        counted = {
            "step": _mean(steps),
            "step_most": int(steps.max()),
            "even": _mean(rows_even[:, 0]),
            "gap": int(rows_jittered[-1, 1]),
            "call_most": max(head[6], int(rows_jittered[:, 1].max())),
            "call_bound": bound,
            "begin": head[2],
            "stack_memory_bytes": head[3],
            "stack_begin": head[4],
            "stack_push": head[5],
        }
        return Cost(
            target=target,
            **{name: value if counts else None for name, value in counted.items()},
            stages=stages,
            sections={name: _sections(target, file) for name, file in objects.items()},
            toy_bytes=head[0],
            memory_bytes=head[1],
            stack_functions=_stack_usage(objects["plushsense"].with_suffix(".su")),
            needs=_needs(target, objects["plushsense"]),
            masking=_masking(target, objects["plushsense"]),
        )


def _mean(counts: Ints) -> int:
    return round(float(counts.mean()))


def _bound(most: Ints, least: Ints, step: int) -> int:
    """Return a bound of the instructions of one call of ``plush_push``, without callbacks, from those of its parts.

    The call reads one frame, forgets the past at most once, and interpolates, reads and passes through gate and network
    as many samples as the longest gap of the model asks for, with the answers that fall due: these numbers follow from
    the image. ``most`` and ``least`` (8,) are the counts of each part over forced states (`count_parts` in profile.c),
    of the network for several samples together; the last columns are the samples of the gap, and how many were counted
    together. Each part is taken as its most and, as no forced state need be the worst, once more what it varies by; the
    network also with what rounding and the turns of its rings may add.
    """
    frame, forget, *sample, network, answer = (2 * most[:-1] - least[:-1]).tolist()
    samples, together = int(most[-1]), int(least[-1])
    answers = -(-samples // step)
    return int(frame + forget + samples * sum(sample) + -(-samples // together) * network + answers * answer)


def _streams(folder: Path, facts: ModelFacts) -> tuple[Ints, Ints, Ints]:
    """Return frames at even times, the same readings with jitter and the longest bridged gap at the end, and stress.

    The latter are readings at the ends of all golden frames, valid or not, mostly after gaps. The other readings are
    touches near the beginning of the golden frames, which have no faults. Their counted part begins and ends with a
    frame without jitter, so that it contains a whole number of samples. The gap completes a step.
    """
    span, step, period_us = facts.span, facts.step, facts.period_us
    gap_ms = facts.gap_ms
    frames, _ = read_golden(folder / GOLDEN, len(facts.channels), facts.classes)
    clean = frames[6 : 6 + span, 1:]
    if len(clean) < span:
        raise BadInput(f"'{folder / GOLDEN}' holds too few frames: export the model again.")
    n = span + STEPS * step + max(0, step - gap_ms * 1000 // period_us)
    values = np.resize(clean, (n, clean.shape[1]))
    at_us = 1_000_000 + np.arange(n) * period_us
    jitter = np.random.default_rng(5).integers(-period_us // 5, period_us // 5 + 1, n)
    jitter[[0, span - 1, *range(span + STEPS * step - 1, n)]] = 0
    even = np.column_stack([at_us // 1000, values])
    jittered = np.column_stack([(at_us + jitter) // 1000, values])
    last = np.concatenate([[jittered[-1, 0] + gap_ms], values[0]])
    rng = np.random.default_rng(6)
    ends = np.stack([clean.min(axis=0), clean.max(axis=0), frames[:, 1:].min(axis=0), frames[:, 1:].max(axis=0)])
    which = rng.choice(4, (_STRESS, clean.shape[1]), p=[0.49, 0.49, 0.01, 0.01])
    waits = rng.choice([0, period_us // 1000, gap_ms - 1, gap_ms, gap_ms + 1], _STRESS, p=[0.05, 0.2, 0.2, 0.54, 0.01])
    stress = np.column_stack([1000 + np.cumsum(waits), np.take_along_axis(ends, which, axis=0)])
    return even, np.vstack([jittered, last]), stress


def _whole(program: Program, facts: ModelFacts) -> tuple[list[int], Ints, Ints]:
    """Run the program; return its seven numbers about the toy, and a table of the steps of each stream.

    The tables, even (n, 3) and jittered (n + 1, 3), omit the first decision; the latter ends with the gap.
    """
    numbers = np.frombuffer(program.run(), dtype="<u4").astype(np.int64)
    if not len(numbers):
        raise ProgramError(
            f"The C in the export refuses its own model on {program.target.name}: export the model again."
        )
    table = numbers[7:].reshape(-1, 3)
    first = int(np.flatnonzero(table[:, 2] == 2)[0])
    even, jittered = (part[part[:, 2] == 1][1:] for part in (table[:first], table[first + 1 : -1]))
    n = STEPS
    if (len(even), len(jittered)) != (n, n + 1):
        raise ProgramError(
            f"The C in the export gave {len(even)} answers on {program.target.name} where {n} steps of {facts.step} "
            "samples should: plushsense verify shows where it goes wrong."
        )
    return numbers[:7].tolist(), even, jittered


def _sections(target: str, file: Path) -> dict[str, int]:
    """Return the bytes of an object file by kind of section."""
    sizes = dict.fromkeys(_SECTIONS, 0)
    for line in tool_output([tool(target, "size"), "-A", str(file)]).splitlines():
        words = line.split()
        for name, begins in _SECTIONS.items():
            if len(words) == 3 and any(words[0] == b or words[0].startswith(b + ".") for b in begins):
                sizes[name] += int(words[1])
    return sizes


def _needs(target: str, file: Path) -> tuple[str, ...]:
    """Return the undefined symbols of an object file."""
    lines = tool_output([tool(target, "nm"), "-u", str(file)]).splitlines()
    return tuple(sorted(words[-1] for line in lines if (words := line.split())))


def _masking(target: str, file: Path) -> tuple[str, ...]:
    """Return the instructions of an object file that switch interrupts off, or wait for one."""
    listing = tool_output([tool(target, "objdump"), "-d", str(file)])
    return tuple(sorted({match[1] for match in _MASKING.finditer(listing)}))


def _stack_usage(file: Path) -> dict[str, int]:
    """Read each function's stack frame from the compiler's report, largest first; raise BadInput for one without limit.

    Of a frame that is "dynamic,bounded", such as one that arguments of a call are pushed onto, the size is the maximum.
    """
    frames: dict[str, int] = {}
    for line in file.read_text().splitlines() if file.is_file() else ():
        place, size, kind = line.split("\t")
        if kind not in ("static", "dynamic,bounded"):
            raise BadInput(f"The stack of {place} is not known when compiling ({kind}): take out what makes it so.")
        frames[place.rsplit(":", 1)[-1]] = int(size)
    return dict(sorted(frames.items(), key=lambda item: -item[1]))


FETCHING = (
    "flash: what runs and is read is fetched again for every frame, as if other code had emptied the cache since the "
    "frame before; in RAM (IRAM_ATTR, or a section that your linker copies) nothing is fetched."
)
SUMMARY = (
    "Instructions are counted on emulators and exact. Times are estimates from them, between two bounds: nothing ran "
    "on a real chip."
)


@dataclass(frozen=True)
class Profile:
    """Costs by target, and estimates for the cores whose target was counted.

    ``missing`` maps each target that is not installed to the Debian packages that it needs. ``web`` is the cost of the
    module, if that was asked for.
    """

    facts: ModelFacts
    arch: Arch
    optimise: str
    costs: Mapping[str, Cost]
    estimates: Mapping[str, Estimate]
    missing: Mapping[str, Sequence[str]]
    web: WebCost | None = None

    @property
    def step_ms(self) -> float:
        """Time between two decisions."""
        return self.facts.step_ms

    @property
    def macs_by_layer(self) -> dict[str, int]:
        """Multiply-accumulates of a step by layer; the dense layer is computed once per step."""
        names = (f"layer {n}" for n in range(1, len(self.arch.layers) + 1))
        macs = {name: m * self.arch.step for name, m in zip(names, self.arch.macs_per_position, strict=True)}
        return macs | {"dense": self.arch.classes * self.arch.features}

    @property
    def window_instructions(self) -> dict[str, int]:
        """Estimated instructions of a step, by target, if the network recomputed its whole span each time.

        The number of instructions per multiply-accumulate is assumed to be that of the counted step.
        """
        ratio = self.arch.macs_per_window / self.arch.macs_per_step
        return {name: round(c.stages["network"] * ratio) for name, c in self.costs.items() if c.stages}

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON, as ``plushsense profile --json`` prints them."""
        counted = {name: c for name, c in self.costs.items() if c.step is not None}
        return {
            "title": self.arch.title,
            "said": SUMMARY,
            "optimise": self.optimise,
            "step": self.arch.step,
            "step_ms": self.step_ms,
            "decisions_counted": STEPS,
            "instructions_per_step": {name: c.step for name, c in counted.items()},
            "network_instructions_per_step": {name: c.stages["network"] for name, c in counted.items()},
            "macs_per_step": self.arch.macs_per_step,
            "macs_per_window": self.arch.macs_per_window,
            "macs_by_layer": self.macs_by_layer,
            "flash_bytes": {name: c.flash_bytes for name, c in self.costs.items()},
            "ram_bytes": {name: c.ram_bytes for name, c in self.costs.items()},
            "estimated_ms": {name: e.to_json() for name, e in self.estimates.items()},
            "estimated_window_instructions": self.window_instructions,
            "targets": {name: c.to_json() for name, c in self.costs.items()},
            "missing": {name: list(packages) for name, packages in self.missing.items()},
            **({WASM: vars(self.web)} if self.web else {}),
        }


def profile(
    folder: str | Path,
    targets: Sequence[str] = (),
    *,
    optimise: str = "-O2",
    trust: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Profile:
    """Measure the cost of the C code in an export folder, which is only read.

    Args:
        folder: the folder that ``plushsense export`` wrote.
        targets: names of `TARGETS` that count instructions, "host" or "wasm"; by default all of the former that are
            installed.
        optimise: optimisation flag of the compilers.
        trust: whether to compile and run code in a folder with files that differ from what this version writes.
        progress: called with (targets done, number of targets).

    Raises:
        BadInput: if the folder is no export or incomplete, or its code was changed and ``trust`` is false.
        ToolError: if a requested target, or every target, is not installed, or a compiler fails.
    """
    progress = progress or (lambda done, total: None)
    folder = Path(folder)
    export = Export(folder)
    facts = export.facts
    arch = export.model.network.arch
    if not trust:
        export.require_unchanged()
    installed, missing = _choose_targets(targets)
    costs, web = {}, None
    with tempfile.TemporaryDirectory(prefix="plushsense-profile-") as work:
        code = export.code(Path(work) / "code")
        for done, name in enumerate(installed):
            progress(done, len(installed))
            if name == WASM:
                web = _web(export, Path(work), code / IMAGE)
                continue
            costs[name] = count(folder, name, facts, optimise, code=code)
    progress(len(installed), len(installed))
    estimates = {
        core.name: found
        for core in cores()
        if core.target in costs and (found := estimate(core, costs[core.target], arch, facts.step_ms))
    }
    return Profile(facts, arch, optimise, costs, estimates, missing, web)


def _choose_targets(targets: Sequence[str]) -> tuple[list[str], dict[str, list[str]]]:
    """Return the targets to profile, and the Debian packages that the others lack; ``targets`` as in `profile`."""
    counting = [name for name, target in TARGETS.items() if target.counts]
    for name in targets:
        check_known(name, [*counting, "host", WASM], "target to profile", ConfigError)
    names = list(dict.fromkeys(targets)) or counting
    missing = {name: lacks for name in names if (lacks := missing_tools(name))}
    if targets:
        for name in missing:
            require(name)
    installed = [name for name in names if name not in missing]
    if not installed:
        packages = " ".join(dict.fromkeys(p for lacks in missing.values() for p in lacks))
        raise ToolError(
            "No emulator to count on is installed here: install Debian's {packages} (or some of them), or give "
            "--target host for sizes on this computer only.",
            packages=packages,
        )
    return installed, missing


def _web(export: Export, work: Path, image: Path) -> WebCost:
    if not export.has_module:
        raise BadInput("The export '{path}' lacks {file}: export the model again.", path=export.folder, file=MODULE)
    even, _, _ = _streams(export.folder, export.facts)
    cases = work / "cases.bin"
    cases.write_bytes(Vectors("even", even, np.empty((0, 0), np.int32), len(even)).to_bytes())
    return web_cost(export.folder, image, cases)


FLOAT_MMAC_S = 58.0
INT16_MMAC_S = 137.0
"""Rates of the ESP32 in millions of MACs per second, as the paper states them (section 4.7)."""

PAPER_NETWORK = "14d1_39d2_41d4", (8, 12, 16)
_CORE = "esp32"
_FLOAT_BYTES = 4

PAPER_ASSUMES = (
    "the time is the number of MACs divided by a rate: 58 MMAC/s in floats, 137 MMAC/s in 16-bit integers",
    "each decision computes a whole window of 250 samples again",
    "all other work takes no time: activation, normalisation, scaling, softmax, reading the sensors",
    "the rates are calculated from published benchmarks of the ESP32; the paper does not say of which code",
    "the ESP32 has no floating-point unit: it does have one, for single precision",
)
OURS_ASSUMES = (
    "the instructions of our C for one step are counted on an emulator, with everything from frame to event",
    "each decision computes the new samples only, with the state of the layers kept",
    "weights and activations have 8 bits, sums 32",
    "cycles per instruction lie between two bounds, of which the upper one adds waiting for the flash",
    "the instructions are those of lx106, a sibling of the ESP32's core: rather too many",
)


@dataclass(frozen=True)
class PaperEstimate:
    """MACs of one decision, and the times that the paper's rates give for them."""

    what: str
    macs: int

    @property
    def float_ms(self) -> float:
        """Time in ms at the rate of floats."""
        return self.macs / FLOAT_MMAC_S / 1000

    @property
    def int16_ms(self) -> float:
        """Time in ms at the rate of 16-bit integers."""
        return self.macs / INT16_MMAC_S / 1000

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "what": self.what,
            "macs": self.macs,
            "float_ms": round(self.float_ms, 3),
            "int16_ms": round(self.int16_ms, 3),
        }


@dataclass(frozen=True)
class PaperComparison:
    """The paper's estimates, and ours for the ESP32 as (low, high) in ms; None if it was not counted.

    ``window_ms`` is ours for the whole span at each decision, by the instructions for each MAC of the counted step.
    ``float_bytes`` is the size of the weights in floats, by which the paper states the memory.
    """

    estimates: Sequence[PaperEstimate]
    step_ms: tuple[float, float] | None
    window_ms: tuple[float, float] | None
    float_bytes: int

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "mmac_s": {"float": FLOAT_MMAC_S, "int16": INT16_MMAC_S},
            "estimates": [e.to_json() for e in self.estimates],
            "ours_step_ms": None if self.step_ms is None else [round(ms, 3) for ms in self.step_ms],
            "ours_window_ms": None if self.window_ms is None else [round(ms, 1) for ms in self.window_ms],
            "float_weights_bytes": self.float_bytes,
            "paper_assumes": list(PAPER_ASSUMES),
            "ours_assumes": list(OURS_ASSUMES),
        }


def compare_with_paper(profile: Profile) -> PaperComparison:
    """Apply the paper's rates to its network and to the exported one, beside our estimates for the ESP32."""
    symbol, filters = PAPER_NETWORK
    paper = Arch.parse(symbol, filters, padding="mirror")
    mine = profile.arch
    estimates = (
        PaperEstimate("the paper's network, a window of 250 samples", paper.macs_per_window),
        PaperEstimate(f"this network, its whole span of {mine.span} samples", mine.macs_per_window),
        PaperEstimate(f"this network, a step of {mine.step} samples", mine.macs_per_step),
    )
    esp32 = profile.estimates.get(_CORE)
    step = window = None
    if esp32 is not None:
        core = esp32.core
        step = (esp32.low_ms, esp32.high_ms)
        count = profile.window_instructions[core.target]
        window = (count * core.cycles_low / core.mhz / 1000, count * core.cycles_high / core.mhz / 1000)
    return PaperComparison(estimates, step, window, mine.parameters * _FLOAT_BYTES)
