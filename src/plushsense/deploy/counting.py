"""What the C of an export costs on one target: instructions by stage, bytes by section, stack, symbols it needs."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ProgramError
from plushsense.deploy.emit import GOLDEN, LIBRARY, MODEL
from plushsense.deploy.golden import read_golden
from plushsense.deploy.targets import C_FOLDER, TARGETS, Program, build, said_by, tool

STEPS = 50  # decisions that are counted
STAGES = ("health", "inputs", "gate", "network", "dense", "decision", "events", "pooling")
_HEAP = ("malloc", "calloc", "realloc", "free", "reallocarray", "aligned_alloc", "sbrk", "_sbrk", "_Znw", "_Zna")
# The compiler's helpers for floating point: __addsf3, __mulsf3, __floatsidf, __aeabi_fadd, __aeabi_i2d …
_FLOAT = re.compile(r"^__(\w*[sdt]f\d?$|float|fix|aeabi_[fd](?!iv)|aeabi_u?[il]2[fd])")
_SECTIONS = {"text": (".text", ".literal"), "rodata": (".rodata", ".srodata"), "data": (".data", ".sdata")}
_SECTIONS["bss"] = (".bss", ".sbss")
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Cost:
    """What one target says. Instructions, bytes; None where the target counts nothing (the host).

    ``step`` is the mean over `STEPS` decisions with frames up to a fifth of a period early or late, ``even`` with
    even stamps, ``step_most`` the dearest step; ``gap`` is the dearest single call, which bridges the longest gap;
    ``stages`` add up to ``step``, ``clock`` (with the check of values) being what the others leave of it; ``gate`` is 0
    for a model without one.
    ``stack_push``, ``stack_begin`` and ``stack_memory_bytes`` are how deep the stack went below the caller of these
    functions, without a callback; ``stack_functions`` is the frame that the compiler gives to each function.
    """

    target: str
    step: int | None
    step_most: int | None
    even: int | None
    gap: int | None
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

    @property
    def flash_bytes(self) -> int:
        """Code, tables and model."""
        return sum(part[name] for part in self.sections.values() for name in ("text", "rodata", "data"))

    @property
    def ram_bytes(self) -> int:
        """One toy and its memory, and what the code keeps besides (nothing, as a rule); without stack."""
        kept = sum(part[name] for part in self.sections.values() for name in ("data", "bss"))
        return self.toy_bytes + self.memory_bytes + kept

    @property
    def heap(self) -> tuple[str, ...]:
        """Symbols of a heap that the object needs: none."""
        return tuple(s for s in self.needs if s.startswith(_HEAP))

    @property
    def floats(self) -> tuple[str, ...]:
        """Helpers for floating point that the object needs: none."""
        return tuple(s for s in self.needs if _FLOAT.match(s))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "title": TARGETS[self.target].title,
            "instructions_per_step": self.step,
            "instructions_per_step_most": self.step_most,
            "instructions_per_step_even": self.even,
            "instructions_longest_call": self.gap,
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
            "heap": list(self.heap),
            "floating_point": list(self.floats),
        }


def count(folder: Path, target: str, facts: Mapping[str, Any], optimise: str = "-O2") -> Cost:
    """Build the C in an export folder for a target, run it there and count. The folder is only read.

    Raises:
        ToolError: when a tool is missing, or refuses what stands in the folder.
        BadInput: when a file of the export is missing.
    """
    for name in (*LIBRARY, *MODEL):
        if not (folder / name).is_file():
            raise BadInput(f"'{folder}' lacks {name}: export the model again.")
    step = int(facts["step"])
    even, jittered = _streams(folder, facts)
    with tempfile.TemporaryDirectory(prefix="plushsense-profile-") as place:
        work = Path(place)
        blobs = {"EVEN": _written(even, work / "even"), "JITTERED": _written(jittered, work / "jittered")}
        sources = [C_FOLDER / "profile.c", folder / "plush_model.c"]
        whole = build(
            target,
            [*sources, folder / "plushsense.c"],
            work / "whole",
            include=[folder],
            optimise=optimise,
            blobs=blobs,
            flags=["-fstack-usage"],
        )
        head, rows_even, rows_jittered = _whole(whole, step)
        counts = TARGETS[target].counts
        stages: dict[str, int] = {}
        if counts:
            defines = {"PLUSH_STAGES": 1}
            staged = build(
                target, sources, work / "stages", include=[folder], defines=defines, optimise=optimise, blobs=blobs
            )
            stages = _stages(staged)
            stages = {"clock": _mean(rows_jittered[:-1, 0]) - sum(stages.values()), **stages}
        objects = {"plushsense": whole.objects[2], "plush_model": whole.objects[1]}
        return Cost(
            target=target,
            step=_mean(rows_jittered[:-1, 0]) if counts else None,
            step_most=int(rows_jittered[:-1, 0].max()) if counts else None,
            even=_mean(rows_even[:, 0]) if counts else None,
            gap=int(rows_jittered[-1, 1]) if counts else None,
            begin=head[2] if counts else None,
            stages=stages,
            sections={name: _sections(target, file) for name, file in objects.items()},
            toy_bytes=head[0],
            memory_bytes=head[1],
            stack_push=head[5] if counts else None,
            stack_begin=head[4] if counts else None,
            stack_memory_bytes=head[3] if counts else None,
            stack_functions=_stack_usage(objects["plushsense"].with_suffix(".su")),
            needs=_needs(target, objects["plushsense"]),
        )


def _mean(counts: Ints) -> int:
    return round(float(counts.mean()))


def _streams(folder: Path, facts: Mapping[str, Any]) -> tuple[Ints, Ints]:
    """Frames at even times, and the same readings with jitter and, at the end, the longest gap that is bridged.

    The readings are the clean touches near the beginning of the golden frames. What is counted begins and ends with a
    frame without jitter, so that it holds whole samples only.
    """
    span, step, period_us = int(facts["span"]), int(facts["step"]), int(facts["period_us"])
    frames, _ = read_golden(folder / GOLDEN, len(facts["channels"]), int(facts["classes"]))
    clean = frames[6 : 6 + span, 1:]
    if len(clean) < span:
        raise BadInput(f"'{folder / GOLDEN}' holds too few frames: export the model again.")
    n = span + STEPS * step
    values = np.resize(clean, (n, clean.shape[1]))
    at_us = 1_000_000 + np.arange(n) * period_us
    jitter = np.random.default_rng(5).integers(-period_us // 5, period_us // 5 + 1, n)
    jitter[[0, span - 1, n - 1]] = 0
    even = np.column_stack([at_us // 1000, values])
    jittered = np.column_stack([(at_us + jitter) // 1000, values])
    last = np.concatenate([[jittered[-1, 0] + int(facts["gap_ms"])], values[0]])
    return even, np.vstack([jittered, last])


def _written(frames: Ints, file: Path) -> Path:
    file.write_bytes(frames.astype("<i4").tobytes())
    return file


def _whole(program: Program, step: int) -> tuple[list[int], Ints, Ints]:
    """Six numbers about the toy; then the rows (`STEPS`, 3) after the first decision of the even stream, and those of
    the jittered one with the gap's as one more."""
    numbers = np.frombuffer(program.run(), dtype="<u4").astype(np.int64)
    if not len(numbers):
        raise ProgramError(
            f"The C in the export refuses its own model on {program.target.name}: export the model again."
        )
    table = numbers[6:].reshape(-1, 3)
    first = int(np.flatnonzero(table[:, 2] == 2)[0])
    even, jittered = (part[part[:, 2] == 1][1:] for part in (table[:first], table[first + 1 : -1]))
    if (len(even), len(jittered)) != (STEPS, STEPS + 1):
        raise ProgramError(
            f"The C in the export gave {len(even)} answers on {program.target.name} where {STEPS} steps of {step} "
            "samples should: plushsense verify says where it goes wrong."
        )
    return numbers[:6].tolist(), even, jittered


def _stages(program: Program) -> dict[str, int]:
    rows = np.frombuffer(program.run(), dtype="<i4").astype(np.int64).reshape(-1, len(STAGES))
    return {name: _mean(rows[:, i]) for i, name in enumerate(STAGES)}


def _sections(target: str, file: Path) -> dict[str, int]:
    """Bytes of an object file by the kind of section."""
    found = dict.fromkeys(_SECTIONS, 0)
    for line in said_by([tool(target, "size"), "-A", str(file)]).splitlines():
        words = line.split()
        for name, begins in _SECTIONS.items():
            if len(words) == 3 and any(words[0] == b or words[0].startswith(b + ".") for b in begins):
                found[name] += int(words[1])
    return found


def _needs(target: str, file: Path) -> tuple[str, ...]:
    """Symbols that an object file does not bring along."""
    lines = said_by([tool(target, "nm"), "-u", str(file)]).splitlines()
    return tuple(sorted(words[-1] for line in lines if (words := line.split())))


def _stack_usage(file: Path) -> dict[str, int]:
    """What the compiler says about the stack of each function, the largest first; a dynamic frame is refused."""
    found: dict[str, int] = {}
    lines: Sequence[str] = file.read_text().splitlines() if file.is_file() else ()
    for line in lines:
        place, size, kind = line.split("\t")
        if kind != "static":
            raise BadInput(f"The stack of {place} is not known when compiling ({kind}): take out what makes it so.")
        found[place.rsplit(":", 1)[-1]] = int(size)
    return dict(sorted(found.items(), key=lambda item: -item[1]))
