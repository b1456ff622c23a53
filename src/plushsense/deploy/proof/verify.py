"""Verify that the C in an export folder gives exactly the results of the integer model in Python.

The files in the folder must be those that this version writes, unless ``trust`` is given. Golden vectors
and test scenarios (`plushsense.deploy.proof.scenarios`) are always run; recordings or further generated frames are
optional. Every number of every answer, change of an event and change of sensor health is compared.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plushsense.core.errors import BuildError, ProgramError, ToolError
from plushsense.core.sentences import Message
from plushsense.deploy.code import IMAGE, LIBRARY, MODEL
from plushsense.deploy.golden import Counts, Vectors, counted
from plushsense.deploy.proof.vectors import Export, RowComparison, compare
from plushsense.deploy.targets import (
    C_FOLDER,
    TARGETS,
    CompileSpec,
    Program,
    build,
    missing_tools,
    require,
    target_named,
)
from plushsense.deploy.web import MODULE, WASM, run_module

Progress = Callable[[int, int], None]
Stream = tuple[Vectors, ...]  # run by one program, one after the other
Cases = tuple[Stream, Path]  # a stream, and the file with it for the harness
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
HARNESS = C_FOLDER / "harness.c"
CHIP = "device"  # the target of the result of a connected chip


@dataclass(frozen=True)
class Setting:
    """A compiler with its options: one row of the report.

    ``image``: the model is read from plush_model.bin instead of compiled in; ``cpp``: the C library is called from C++.
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
    def options(self) -> str:
        """Flags as text, without those for warnings, which all settings have."""
        also = [("sanitizers", SANITIZERS[0] in self.flags), ("called from C++", self.cpp), (IMAGE, self.image)]
        return " ".join([self.optimise, *(word for word, is_so in also if is_so)])


def settings_of(target: str) -> list[Setting]:
    """Return the compiler settings to verify on a target."""
    if target != "host":
        return [Setting(target, optimise=o) for o in TARGETS[target].optimise]
    settings = [Setting(target, cc, o) for cc in ("gcc", "clang") for o in ("-O0", "-O2", "-O3")]
    settings += [Setting(target, cc, "-O1", (*STRICT, *SANITIZERS)) for cc in ("gcc", "clang")]
    # C++ has no -std=c99, and exceptions would need its library.
    settings.append(Setting(target, "gcc", "-O2", (*STRICT[1:], "-fno-exceptions"), cpp=True))
    settings.append(Setting(target, "gcc", "-O2", image=True))
    return settings


@dataclass(frozen=True)
class Cycles:
    """Cycles of ``plush_push`` on a chip while the toy was tracking: per step on average, and of the longest call."""

    counter: str
    steps: int
    per_step: float
    longest: int


@dataclass(frozen=True)
class SettingResult:
    """Result of one setting: ``vectors`` counts rows, ``first`` describes the first one that differs.

    ``cycles``: of a connected chip that counts them.
    """

    target: str
    compiler: str
    flags: str
    vectors: int
    mismatches: int
    max_abs_diff: int
    seconds: float
    first: str | None = None
    cycles: Cycles | None = None

    def to_json(self) -> dict[str, object]:
        """Return the result as plain values for JSON."""
        cycles = dict(vars(self.cycles)) if self.cycles else None
        return {**vars(self), "seconds": round(self.seconds, 2), "cycles": cycles}


@dataclass(frozen=True)
class VerificationResult:
    """Result of a verification; ``passed`` if nothing differs.

    ``decisions`` counts the answers after the warm-up, of which there must be some. ``changed`` names the files of the
    folder that are not what this version writes for the bundle, also in packages and examples. Then ``own`` is False,
    and ``passed`` means only that the C that was compiled agrees with the vectors.
    """

    title: str
    changed: tuple[str, ...]
    decisions: int
    counts: tuple[Counts, ...]
    runs: tuple[SettingResult, ...]
    not_run: tuple[tuple[str, str], ...]

    @property
    def own(self) -> bool | None:
        """Whether all code in the folder is what this version writes for the bundle.

        None for a chip, whose program cannot be read from here, unless it is known that files were changed.
        """
        return False if self.changed else None if any(r.target == CHIP for r in self.runs) else True

    @property
    def mismatches(self) -> int:
        return sum(r.mismatches for r in self.runs)

    @property
    def first(self) -> str | None:
        """Description of the first answer that differs, as a sentence."""
        return next((r.first for r in self.runs if r.first), None)

    @property
    def passed(self) -> bool:
        return self.mismatches == 0 and self.decisions > 0

    def to_json(self) -> dict[str, object]:
        """Return the object that ``plushsense verify --json`` prints."""
        return {
            "title": self.title,
            "passed": self.passed,
            "own": self.own,
            "changed": list(self.changed),
            "decisions": self.decisions,
            "vectors": sum(r.vectors for r in self.runs),
            "mismatches": self.mismatches,
            "max_abs_diff": max((r.max_abs_diff for r in self.runs), default=0),
            "first": self.first,
            "streams": [dict(vars(c)) for c in self.counts],
            "runs": [r.to_json() for r in self.runs],
            "not_run": [{"what": part, "why": reason} for part, reason in self.not_run],
        }


def verify(
    export: Export,
    targets: Sequence[str] = (),
    vectors: Sequence[Vectors] = (),
    *,
    only: Callable[[Setting], bool] = lambda setting: True,
    trust: bool = False,
    progress: Progress | None = None,
) -> VerificationResult:
    """Compile the C of the export folder for each target, run it, and compare every result.

    Args:
        export: the folder.
        targets: names of `TARGETS`; empty: all whose tools are installed, but no slow ones.
        vectors: further vectors to run.
        only: which settings of a target to run.
        trust: also compile and run C and model files that differ from what this version writes, and verify a folder
            with other files that do.

    Raises:
        BadInput: if such files differ and ``trust`` is false.
        ConfigError: for an unknown target; ToolError: for a named one whose tools are missing.
        ProgramError: if a program prints no result.
    """
    if not trust:
        export.require_unchanged()
    settings, not_run = _choose(targets, only, export)
    scenarios = (*export.scenarios(), *export.patched())
    streams: list[Stream] = [(export.golden,), *([scenarios] if scenarios else []), *((v,) for v in vectors)]
    runs = []
    with (
        tempfile.TemporaryDirectory(prefix="plushsense-verify-", ignore_cleanup_errors=True) as work,
        ThreadPoolExecutor(os.cpu_count() or 1) as pool,
    ):
        runner = _Runner(export, Path(work), streams)
        for done, result in enumerate(pool.map(runner.run, settings), 1):
            runs.append(result)
            if progress:
                progress(done, len(settings))
    all_vectors = [v for stream in streams for v in stream]
    decisions = sum(v.decisions for v in all_vectors if v not in scenarios)
    changed = (*export.changed, *export.edited)
    return VerificationResult(export.title, changed, decisions, counted(all_vectors), tuple(runs), tuple(not_run))


def _choose(
    targets: Sequence[str], only: Callable[[Setting], bool], export: Export
) -> tuple[list[Setting], list[tuple[str, str]]]:
    """Return the settings that can run on this computer, and (name, reason) of the others."""
    runnable: list[Setting] = []
    not_run: list[tuple[str, str]] = []
    for name in dict.fromkeys(targets or TARGETS):
        if TARGETS.get(name) and TARGETS[name].slow and not targets:
            not_run.append((name, Message("it takes minutes, and only runs when it is named")))
            continue
        settings = [s for s in settings_of(target_named(name).name) if only(s)]
        lacks = {s: _lacks(s, export) for s in settings}
        here = [s for s in settings if not lacks[s]]
        if targets and not here:
            require(name)
        runnable += here
        if not here:
            not_run.append((name, next(iter(lacks.values()), Message("no setting was selected"))))
        else:
            not_run += [(f"{name}, {s.compiler} {s.options}", why) for s, why in lacks.items() if why]
    if not runnable:
        raise ToolError(
            "Nothing can be checked here, because no compiler is installed: install one ({not_run}).",
            not_run="; ".join(f"{name}: {why}" for name, why in not_run),
        )
    return runnable, not_run


def _lacks(setting: Setting, export: Export) -> str:
    """Return why a setting cannot run on this computer; "" if it can."""
    if setting.target == WASM and not export.has_module:
        return Message("the export holds no {file}: export the model again", file=MODULE)
    missing = missing_tools(setting.target, cc=setting.cc)
    if setting.cpp and shutil.which("g++") is None:
        missing.append("g++")
    if missing:
        packages = " ".join(missing)
        return Message("not installed: Debian's {packages}", packages=packages)
    return _no_sanitizers(setting) if SANITIZERS[0] in setting.flags else ""


def _no_sanitizers(setting: Setting) -> str:
    """Return why sanitizers do not work on this computer (missing libraries, system policy); "" if they do."""
    with tempfile.TemporaryDirectory(prefix="plushsense-verify-") as work:
        source = Path(work) / "nothing.c"
        source.write_text("int main(void)\n{\n    return 0;\n}\n")
        try:
            build(setting.target, [source], Path(work), CompileSpec(setting.cc, flags=setting.flags)).run()
        except ToolError:
            also = " (Debian's libclang-rt-dev)" if setting.compiler == "clang" else ""
            return Message(
                "{compiler} makes no program with sanitizers here{also}", compiler=setting.compiler, also=also
            )
    return ""


class _Runner:
    """Compiles the C of an export in a work folder, and runs it on streams; programs may run at the same time."""

    def __init__(self, export: Export, work: Path, streams: Sequence[Stream]) -> None:
        self.export, self.work, self.objects = export, work, work / "objects"
        self.objects.mkdir()
        # That the models of all streams need: one harness for all of them.
        self.memory_bytes = max(v.memory_bytes for stream in streams for v in stream)
        self.code = export.code(work / "code")
        self.cases: list[Cases] = []
        for number, stream in enumerate(streams):
            path = work / f"cases-{number}.bin"
            path.write_bytes(b"".join(v.to_bytes() for v in stream))
            self.cases.append((stream, path))

    def run(self, setting: Setting) -> SettingResult:
        """Compile with one setting, run each stream and compare the results.

        Raises:
            ProgramError: if the program prints nothing, because then every other setting would be compared in vain.
        """
        began, out = time.monotonic(), Path(tempfile.mkdtemp(dir=self.work))
        compared = []
        for cases in self.cases:
            try:
                compared.append(self._attempt(setting, cases, out))
                if compared[-1].is_empty:
                    raise ProgramError(
                        f"On {setting.target} ({setting.compiler} {setting.options}), the program ended without an "
                        "error but printed no result: check that nothing in its code ends it early, and that this "
                        "emulator shows what a program prints."
                    )
            except BuildError as cause:
                count = sum(len(v.answers) for v in cases[0])
                compared.append(RowComparison(count, count, 0, f"On {setting.target} ({setting.options}): {cause}"))
        shutil.rmtree(out, ignore_errors=True)
        return SettingResult(
            setting.target,
            setting.compiler,
            setting.options,
            sum(c.vectors for c in compared),
            sum(c.mismatches for c in compared),
            max(c.max_abs_diff for c in compared),
            time.monotonic() - began,
            next((c.first for c in compared if c.first), None),
        )

    def _attempt(self, setting: Setting, cases: Cases, out: Path) -> RowComparison:
        """Run one program on one stream; ``first`` of the result is a whole sentence.

        A program that reads plush_model.bin also checks that plush_model.c holds the same bytes.
        """
        stream, path = cases
        reads = bool(TARGETS[setting.target].emulator)
        labels = self.export.labels
        names = " and ".join(dict.fromkeys(v.name for v in stream))
        where = f"On {setting.target} ({setting.compiler} {setting.options}), {names}"
        expected = np.concatenate([v.answers for v in stream])
        timeout_s = 60 + 0.02 * sum(len(v.frames) for v in stream) + self.export.seconds(stream)
        try:
            if setting.target == WASM:
                got = run_module(self.export.folder, self.code / IMAGE, path, timeout_s=timeout_s)
            else:
                got = self._program(setting, cases, out).run(timeout_s=timeout_s, given=path if reads else None)
        except ProgramError as cause:
            return RowComparison(len(expected), len(expected), 0, f"{where}: {cause}")
        result = compare(expected, got, labels)
        return replace(result, first=f"{where}: {result.first}.") if result.first else result

    def _program(self, setting: Setting, cases: Cases, out: Path) -> Program:
        """Build the program for one stream."""
        stream, path = cases
        reads = bool(TARGETS[setting.target].emulator)
        defines = {
            "PLUSH_HARNESS_CHANNELS": stream[0].frames.shape[1] - 1,
            "PLUSH_HARNESS_CLASSES": len(self.export.labels),
            "PLUSH_HARNESS_MEMORY_BYTES": self.memory_bytes,
            **({"PLUSH_HARNESS_IMAGE": 1, "PLUSH_HARNESS_BOTH": 1} if setting.image else {}),
            **({"PLUSH_HARNESS_KEPT_BYTES": max(v.kept_bytes for v in stream)} if reads else {}),
        }
        # Compile a copy, because next to the original the compiler would find PlushSense's own plushsense.h. The
        # definitions are in the copy, so that the other sources are compiled only once for all streams.
        harness = out / ("harness.cpp" if setting.cpp else "harness.c")
        lines = [f"#define {name} {value}" for name, value in defines.items()]
        harness.write_text("\n".join([*lines, "#line 1", HARNESS.read_text(encoding="utf-8")]), encoding="utf-8")
        return build(
            setting.target,
            [self.code / LIBRARY[1], harness, self.code / MODEL[1]],
            out,
            CompileSpec(setting.cc, setting.optimise, setting.flags),
            include=[self.code],
            blobs={**({} if reads else {"cases": path}), **({"image": self.code / IMAGE} if setting.image else {})},
            object_folder=self.objects,
        )
