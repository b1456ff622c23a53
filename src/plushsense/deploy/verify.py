"""The proof: the C in an export folder gives, number for number, the answers that ``models/integer`` gives.

What is compiled is what lies in the folder, so that a file edited by hand is what is tested. Golden vectors always
run, and drills, in which the same network has rules that speak up; real recordings, or more made-up frames, on demand.
Every number of every answer, event and change of health is compared.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import BuildError, ProgramError, ToolError
from plushsense.deploy.emit import IMAGE, LIBRARY, MODEL
from plushsense.deploy.faults import Fault, faults_of
from plushsense.deploy.rule_faults import RULES
from plushsense.deploy.targets import C_FOLDER, TARGETS, build, missing_tools, require, target_named
from plushsense.deploy.vectors import Compared, Counts, Export, Vectors, compare, counted

Progress = Callable[[int, int], None]
Stream = tuple[Vectors, ...]  # what one program runs, one after the other
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
HARNESS = C_FOLDER / "harness.c"
MORE_DRILLS = 3
_ANY = "latin-1"  # whatever a hand left in the C must survive


@dataclass(frozen=True)
class Setting:
    """One way to compile: a line of the table.

    ``image``: the model is read from plush_model.bin and not compiled in; ``cpp``: the caller is C++, the library C.
    """

    target: str
    cc: str | None = None
    optimise: str = "-O2"
    flags: tuple[str, ...] = STRICT
    image: bool = False
    cpp: bool = False

    @property
    def compiler(self) -> str:
        return self.cc or TARGETS[self.target].compiler

    @property
    def said(self) -> str:
        """The flags in a few words; the warnings are the same everywhere."""
        also = [("sanitizers", SANITIZERS[0] in self.flags), ("called from C++", self.cpp), (IMAGE, self.image)]
        return " ".join([self.optimise, *(word for word, is_so in also if is_so)])


def settings_of(target: str) -> list[Setting]:
    """How a target's programs are compiled."""
    if target != "host":
        return [Setting(target, optimise=o) for o in ("-O2", "-Os")]
    found = [Setting(target, cc, o) for cc in ("gcc", "clang") for o in ("-O0", "-O2", "-O3")]
    found += [Setting(target, cc, "-O1", (*STRICT, *SANITIZERS)) for cc in ("gcc", "clang")]
    # -std=c99 is not for C++; exceptions would need its library.
    found.append(Setting(target, "gcc", "-O2", (*STRICT[1:], "-fno-exceptions"), cpp=True))
    found.append(Setting(target, "gcc", "-O2", image=True))
    return found


@dataclass(frozen=True)
class Run:
    """What one line of the table found; ``vectors`` are answers, ``first`` tells the first that differs."""

    target: str
    compiler: str
    flags: str
    vectors: int
    mismatches: int
    max_abs_diff: int
    seconds: float
    first: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {**vars(self), "seconds": round(self.seconds, 2)}


@dataclass(frozen=True)
class Caught:
    """Whether one planted fault was noticed on one target."""

    target: str
    kind: str
    fault: str
    caught: bool
    first: str | None

    @property
    def silent(self) -> bool:
        """A wrong line of the rules on which no drill of this network hangs, as with two classes only: the network
        cannot show it, which says nothing about the C."""
        return not self.caught and self.kind in RULES

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {**vars(self), "silent": self.silent}


@dataclass(frozen=True)
class Verified:
    """What was checked; ``passed`` when nothing differs and no planted fault slipped through that the model can show.

    ``decisions`` are the answers that were not of a warming toy: without any, nothing was proven. ``own``: the model
    and its golden vectors are what this PlushSense makes of the bundle beside them; else it is only known that the C
    and the vectors agree.
    """

    title: str
    own: bool
    decisions: int
    counts: tuple[Counts, ...]
    runs: tuple[Run, ...]
    not_run: tuple[tuple[str, str], ...]
    faults: tuple[Caught, ...]

    @property
    def mismatches(self) -> int:
        return sum(r.mismatches for r in self.runs)

    @property
    def first(self) -> str | None:
        """The first answer that differs, in a sentence."""
        return next((r.first for r in self.runs if r.first), None)

    @property
    def passed(self) -> bool:
        return self.mismatches == 0 and self.decisions > 0 and all(f.caught or f.silent for f in self.faults)

    def to_dict(self) -> dict[str, Any]:
        """The object that ``plushsense verify --json`` prints."""
        return {
            "title": self.title,
            "passed": self.passed,
            "own": self.own,
            "decisions": self.decisions,
            "vectors": sum(r.vectors for r in self.runs),
            "mismatches": self.mismatches,
            "max_abs_diff": max((r.max_abs_diff for r in self.runs), default=0),
            "first": self.first,
            "streams": [dict(vars(c)) for c in self.counts],
            "runs": [r.to_dict() for r in self.runs],
            "not_run": [{"what": what, "why": why} for what, why in self.not_run],
            "faults": [f.to_dict() for f in self.faults],
        }


def verify(
    export: Export,
    targets: Sequence[str] = (),
    vectors: Sequence[Vectors] = (),
    *,
    plant: Callable[[Fault], bool] | None = None,
    only: Callable[[Setting], bool] = lambda setting: True,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> Verified:
    """Compile what is in the export folder for each target, run it, and compare every answer.

    Args:
        export: the folder.
        targets: names of `TARGETS`; empty: all for which the tools are here.
        vectors: what to run besides the golden vectors.
        plant: which faults to plant, one at a time: each must be noticed on every target; None: none. For a fault of
            the rules that the drills do not show, `MORE_DRILLS` times as many are made.
        only: which settings of a target to run.
        jobs: programs at a time; None: one a core.

    Raises:
        ConfigError: for an unknown target; ToolError: for one asked for by name whose tools are missing.
    """
    settings, not_run = _choose(targets, only)
    drills = export.drills()
    streams = [(export.golden,), *([tuple(drills)] if drills else []), *((v,) for v in vectors)]
    planted: list[Fault] = []
    if plant:
        export.require_own()
        planted = [f for f in faults_of(export.image, (export.folder / LIBRARY[1]).read_text(_ANY)) if plant(f)]
    chosen = list(dict.fromkeys(s.target for s in settings))
    total, done = len(settings) + len(planted) * len(chosen), 0
    jobs = jobs or os.cpu_count() or 1
    runs: list[Run] = []
    caught: list[Caught] = []
    with (
        tempfile.TemporaryDirectory(prefix="plushsense-verify-", ignore_cleanup_errors=True) as work,
        ThreadPoolExecutor(jobs) as pool,
    ):
        room = Path(work)
        for n, stream in enumerate(streams):
            (room / f"cases-{n}.bin").write_bytes(b"".join(v.to_bytes() for v in stream))

        def tell() -> None:
            nonlocal done
            done += 1
            if progress:
                progress(done, total)

        def run(n: int, setting: Setting) -> Run:
            return _run(export, setting, list(enumerate(streams)), room, room / f"run-{n}")

        for found in pool.map(run, range(len(settings)), settings):
            runs.append(found)
            tell()
        # A fault in C that is wrong already would be noticed for nothing.
        if any(r.mismatches for r in runs):
            planted = []

        first_of = {target: next(s for s in settings if s.target == target) for target in chosen}

        def spoil(n: int, asked: Sequence[tuple[int, Stream]]) -> Caught:
            fault, target = pairs[n]
            return _plant(export, fault, first_of[target], asked, room, room / f"fault-{n}")

        pairs = [(fault, target) for fault in planted for target in chosen]
        for each in pool.map(spoil, range(len(pairs)), repeat(list(enumerate(streams))[: 1 + bool(drills)])):
            caught.append(each)
            tell()
        # What hangs on a row of steps that these drills happened not to have may show in others.
        for again in range(1, 1 + MORE_DRILLS):
            missed = [n for n, one in enumerate(caught) if one.silent]
            if not missed:
                break
            n, stream = len(streams) + again, tuple(export.drills(again))
            (room / f"cases-{n}.bin").write_bytes(b"".join(v.to_bytes() for v in stream))
            sound = [_run(export, first_of[target], [(n, stream)], room, room / f"again-{target}") for target in chosen]
            if any(r.mismatches for r in sound):
                runs += sound
                break
            for at, each in zip(missed, pool.map(spoil, missed, repeat([(n, stream)])), strict=True):
                caught[at] = each
    every = [v for stream in streams for v in stream]
    # Of drills it is not the export's own model that decides.
    decisions = sum(v.decisions for v in every if v.model is None)
    return Verified(export.title, export.is_own, decisions, counted(every), tuple(runs), tuple(not_run), tuple(caught))


def _choose(targets: Sequence[str], only: Callable[[Setting], bool]) -> tuple[list[Setting], list[tuple[str, str]]]:
    """The settings that can run here, and what cannot with the reason."""
    found: list[Setting] = []
    not_run: list[tuple[str, str]] = []
    for name in dict.fromkeys(targets or TARGETS):
        wanted = [s for s in settings_of(target_named(name).name) if only(s)]
        lacks = {s: _lacks(s) for s in wanted}
        here = [s for s in wanted if not lacks[s]]
        if targets and not here:
            require(name)
        found += here
        if not here:
            not_run.append((name, next(iter(lacks.values()), "nothing of it was asked for")))
        else:
            not_run += [(f"{name}, {s.compiler} {s.said}", why) for s, why in lacks.items() if why]
    if not found:
        raise ToolError(
            "Nothing can be checked here, for want of a compiler: install one "
            f"({'; '.join(f'{name}: {why}' for name, why in not_run)})."
        )
    return found, not_run


def _lacks(setting: Setting) -> str:
    """Why a setting cannot be run here; empty when it can."""
    missing = missing_tools(setting.target, cc=setting.cc)
    if setting.cpp and shutil.which("g++") is None:
        missing.append("g++")
    if missing:
        return f"not installed: Debian's {' '.join(missing)}"
    return _no_sanitizers(setting) if SANITIZERS[0] in setting.flags else ""


def _no_sanitizers(setting: Setting) -> str:
    """The sanitizers' libraries are apart from the compiler, and some systems forbid what they do."""
    with tempfile.TemporaryDirectory(prefix="plushsense-verify-") as work:
        source = Path(work) / "nothing.c"
        source.write_text("int main(void)\n{\n    return 0;\n}\n")
        try:
            build(setting.target, [source], Path(work), cc=setting.cc, flags=setting.flags).run()
        except ToolError:
            also = " (Debian's libclang-rt-dev)" if setting.compiler == "clang" else ""
            return f"{setting.compiler} makes no program with sanitizers here{also}"
    return ""


def _run(export: Export, setting: Setting, streams: Iterable[tuple[int, Stream]], room: Path, out: Path) -> Run:
    began = time.monotonic()
    compared = []
    for n, stream in streams:
        try:
            compared.append(_attempt(export, export.folder, setting, stream, room / f"cases-{n}.bin", out))
        except BuildError as cause:
            lost = sum(len(v.answers) for v in stream)
            compared.append(Compared(lost, lost, 0, f"On {setting.target} ({setting.said}): {cause}"))
    shutil.rmtree(out, ignore_errors=True)
    return Run(
        setting.target,
        setting.compiler,
        setting.said,
        sum(c.vectors for c in compared),
        sum(c.mismatches for c in compared),
        max(c.max_abs_diff for c in compared),
        time.monotonic() - began,
        next((c.first for c in compared if c.first), None),
    )


def _attempt(export: Export, folder: Path, setting: Setting, stream: Stream, cases: Path, out: Path) -> Compared:
    """One program on one stream; ``first`` is a whole sentence."""
    where = f"On {setting.target} ({setting.compiler} {setting.said}), {stream[0].name}"
    expected = np.concatenate([v.answers for v in stream])
    out.mkdir(parents=True, exist_ok=True)
    # A copy: beside its original stands PlushSense's own plushsense.h, which a compiler would find first.
    harness = out / ("harness.cpp" if setting.cpp else "harness.c")
    shutil.copyfile(HARNESS, harness)
    # Of the export itself both forms of the model are there, and must be the same bytes.
    both = setting.image and folder == export.folder
    sources = [folder / LIBRARY[1], harness] + ([folder / MODEL[1]] if both or not setting.image else [])
    blobs = {"cases": cases} | ({"image": folder / IMAGE} if setting.image else {})
    classes = len(export.labels)
    defines = {"PLUSH_HARNESS_CHANNELS": stream[0].frames.shape[1] - 1, "PLUSH_HARNESS_CLASSES": classes}
    defines["PLUSH_HARNESS_MEMORY_BYTES"] = max(v.memory_bytes for v in stream)
    defines |= {"PLUSH_HARNESS_IMAGE": 1} if setting.image else {}
    if both:
        defines["PLUSH_HARNESS_BOTH"] = 1
    program = build(
        setting.target,
        sources,
        out,
        include=[folder],
        defines=defines,
        optimise=setting.optimise,
        blobs=blobs,
        cc=setting.cc,
        flags=setting.flags,
    )
    try:
        got = program.run(timeout_s=60 + 0.02 * sum(len(v.frames) for v in stream))
    except ProgramError as cause:
        # None of the answers was given.
        return Compared(len(expected), len(expected), 0, f"{where}: {cause}")
    seen = compare(expected, got, export.labels)
    return replace(seen, first=f"{where}: {seen.first}.") if seen.first else seen


def _plant(
    export: Export, fault: Fault, setting: Setting, streams: Sequence[tuple[int, Stream]], room: Path, out: Path
) -> Caught:
    """Plant one fault in a copy, and see whether the golden vectors notice it, or the drills, which have models of
    their own: a fault in the export's they cannot notice."""
    copy = out / "export"
    copy.mkdir(parents=True)
    for name in (*LIBRARY, *MODEL, IMAGE):
        shutil.copyfile(export.folder / name, copy / name)
    if fault.image is not None:
        (copy / IMAGE).write_bytes(fault.image)
    if fault.source is not None:
        (copy / LIBRARY[1]).write_text(fault.source, _ANY)
    # Where compiling takes longer than running, less of it.
    optimise = "-O1" if setting.target == "host" else "-O2"
    plain = replace(setting, optimise=optimise, flags=("-std=c99",), image=fault.image is not None)
    asked = streams[: 1 if fault.image is not None else None]
    # First whom it concerns.
    for n, stream in reversed(asked) if fault.kind in RULES else asked:
        seen = _attempt(export, copy, plain, stream, room / f"cases-{n}.bin", out)
        if seen.mismatches:
            break
    shutil.rmtree(out, ignore_errors=True)
    return Caught(setting.target, fault.kind, fault.name, seen.mismatches > 0, seen.first)
