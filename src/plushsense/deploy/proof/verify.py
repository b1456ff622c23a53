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
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from plushsense.core.errors import BuildError, ProgramError, ToolError
from plushsense.core.sentences import Message
from plushsense.deploy.code import IMAGE, LIBRARY, MODEL
from plushsense.deploy.golden import Counts, Vectors, counted
from plushsense.deploy.proof.mutants import RULES, Mutant, mutants_of
from plushsense.deploy.proof.vectors import Export, RowComparison, compare
from plushsense.deploy.targets import C_FOLDER, TARGETS, build, missing_tools, require, target_named

T = TypeVar("T")
Progress = Callable[[int, int], None]
Stream = tuple[Vectors, ...]  # run by one program, one after the other
Cases = tuple[Stream, Path]  # a stream, and the file with it for the harness
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
HARNESS = C_FOLDER / "harness.c"
MORE_SCENARIOS = 3
CHIP = "device"  # the target of the result of a connected chip
_ENCODING = "latin-1"  # reads any bytes


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
        return [Setting(target, optimise=o) for o in ("-O2", "-Os")]
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

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values for JSON."""
        cycles = dict(vars(self.cycles)) if self.cycles else None
        return {**vars(self), "seconds": round(self.seconds, 2), "cycles": cycles}


@dataclass(frozen=True)
class MutantResult:
    """Result of one mutant on one target."""

    target: str
    kind: str
    name: str
    caught: bool
    first: str | None

    @property
    def silent(self) -> bool:
        """Whether this is an undetected mutant of the rules, which no test scenario of this network reaches.

        This can happen with two classes, for example; it is no error in the C.
        """
        return not self.caught and self.kind in RULES

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values for JSON."""
        values = {"fault" if key == "name" else key: value for key, value in vars(self).items()}
        return values | {"silent": self.silent}


@dataclass(frozen=True)
class VerificationResult:
    """Result of a verification; ``passed`` if nothing differs and all mutants that affect the model were caught.

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
    mutants: tuple[MutantResult, ...]

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
        return self.mismatches == 0 and self.decisions > 0 and all(m.caught or m.silent for m in self.mutants)

    def to_json(self) -> dict[str, Any]:
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
            "faults": [m.to_json() for m in self.mutants],
        }


def verify(
    export: Export,
    targets: Sequence[str] = (),
    vectors: Sequence[Vectors] = (),
    *,
    mutants: Callable[[Mutant], bool] | None = None,
    only: Callable[[Setting], bool] = lambda setting: True,
    trust: bool = False,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> VerificationResult:
    """Compile the C of the export folder for each target, run it, and compare every result.

    Args:
        export: the folder.
        targets: names of `TARGETS`; empty: all whose tools are installed.
        vectors: further vectors to run.
        mutants: selects the mutants to apply, one at a time; each must be detected on every target. None: no mutants.
            For undetected mutants of the rules, new scenarios are generated, up to `MORE_SCENARIOS` times.
        only: which settings of a target to run.
        trust: also compile and run C and model files that differ from what this version writes, and verify a folder
            with other files that do.
        jobs: number of programs at a time; None: one per core.

    Raises:
        BadInput: if such files differ and ``trust`` is false.
        ConfigError: for an unknown target; ToolError: for a named one whose tools are missing.
        ProgramError: if a program prints no result.
    """
    if not trust:
        export.require_unchanged()
    settings, not_run = _choose(targets, only)
    scenarios = (*export.scenarios(), *export.patched())
    streams: list[Stream] = [(export.golden,), *([scenarios] if scenarios else []), *((v,) for v in vectors)]
    selected: list[Mutant] = []
    if mutants:
        export.require_own()
        selected = [m for m in mutants_of(export.image, export.source.decode(_ENCODING)) if mutants(m)]
    first_of: dict[str, Setting] = {}
    for setting in settings:
        first_of.setdefault(setting.target, setting)
    pairs = [(mutant, setting) for mutant in selected for setting in first_of.values()]
    results: list[MutantResult] = []
    with (
        tempfile.TemporaryDirectory(prefix="plushsense-verify-", ignore_cleanup_errors=True) as work,
        ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool,
    ):
        runner = _Runner(export, Path(work), pool, progress, len(settings) + len(pairs))
        cases = [runner.write_cases(stream) for stream in streams]
        runs = runner.report(pool.map(runner.run, settings, repeat(cases)))
        # If the C differs already, every mutant would count as caught.
        if pairs and not any(r.mismatches for r in runs):
            results = _run_mutants(runner, pairs, cases[: 1 + bool(scenarios)], runs)
    all_vectors = [v for stream in streams for v in stream]
    decisions = sum(v.decisions for v in all_vectors if v not in scenarios)
    changed, counts = (*export.changed, *export.edited), counted(all_vectors)
    return VerificationResult(export.title, changed, decisions, counts, tuple(runs), tuple(not_run), tuple(results))


def _run_mutants(
    runner: _Runner, pairs: Sequence[tuple[Mutant, Setting]], cases: Sequence[Cases], runs: list[SettingResult]
) -> list[MutantResult]:
    """Run each mutant with its setting on the cases, and silent ones on other scenarios too.

    These may contain the rare sequences of steps that a mutant affects. If the unchanged C differs on one of them, that
    is added to ``runs``.
    """
    patches = [runner.write_cases(tuple(runner.export.patched()))]

    def outcome(pair: tuple[Mutant, Setting]) -> MutantResult:
        return runner.run_mutant(*pair, patches if pair[0].kind == "patch" else cases)

    results = runner.report(runner.pool.map(outcome, pairs))
    for again in range(1, 1 + MORE_SCENARIOS):
        missed = [n for n, result in enumerate(results) if result.silent]
        if not missed:
            break
        more = [runner.write_cases(tuple(runner.export.scenarios(again)))]
        unchanged = [runner.run(setting, more) for setting in dict.fromkeys(setting for _, setting in pairs)]
        if any(r.mismatches for r in unchanged):
            runs += unchanged
            break
        repeated = runner.pool.map(lambda n: runner.run_mutant(*pairs[n], more), missed)  # noqa: B023
        for at, result in zip(missed, repeated, strict=True):
            results[at] = result
    return results


def _choose(targets: Sequence[str], only: Callable[[Setting], bool]) -> tuple[list[Setting], list[tuple[str, str]]]:
    """Return the settings that can run on this computer, and (name, reason) of the others."""
    runnable: list[Setting] = []
    not_run: list[tuple[str, str]] = []
    for name in dict.fromkeys(targets or TARGETS):
        settings = [s for s in settings_of(target_named(name).name) if only(s)]
        lacks = {s: _lacks(s) for s in settings}
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


def _lacks(setting: Setting) -> str:
    """Return why a setting cannot run on this computer; "" if it can."""
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
            build(setting.target, [source], Path(work), cc=setting.cc, flags=setting.flags).run()
        except ToolError:
            also = " (Debian's libclang-rt-dev)" if setting.compiler == "clang" else ""
            return Message(
                "{compiler} makes no program with sanitizers here{also}", compiler=setting.compiler, also=also
            )
    return ""


class _Runner:
    """Compiles and runs the C of an export in a work folder; programs may run at the same time."""

    def __init__(
        self, export: Export, work: Path, pool: ThreadPoolExecutor, progress: Progress | None, total: int
    ) -> None:
        self.export, self.work, self.objects = export, work, work / "objects"
        self.pool, self.progress, self.done, self.total = pool, progress, 0, total
        self.objects.mkdir()
        self.memory_bytes = 0  # that the models of all streams need: one harness for all of them
        self.code = export.code(work / "code")

    def write_cases(self, stream: Stream) -> Cases:
        """Write a stream to a file as the harness reads it."""
        path = self._new_folder() / "cases.bin"
        self.memory_bytes = max(self.memory_bytes, *(v.memory_bytes for v in stream))
        path.write_bytes(b"".join(v.to_bytes() for v in stream))
        return stream, path

    def report(self, results: Iterable[T]) -> list[T]:
        """Return the results, and report the progress as each is there."""
        finished = []
        for result in results:
            finished.append(result)
            self.done += 1
            if self.progress:
                self.progress(self.done, self.total)
        return finished

    def _new_folder(self) -> Path:
        return Path(tempfile.mkdtemp(dir=self.work))

    def run(self, setting: Setting, streams: Iterable[Cases]) -> SettingResult:
        """Compile with one setting, run each stream and compare the results.

        Raises:
            ProgramError: if the program prints nothing, because then every other setting would be compared in vain.
        """
        began, out = time.monotonic(), self._new_folder()
        compared = []
        for cases in streams:
            try:
                compared.append(self._attempt(self.code, setting, cases, out, both=True))
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

    def run_mutant(self, mutant: Mutant, setting: Setting, streams: Sequence[Cases]) -> MutantResult:
        """Build a copy with one mutant and compare its results for the golden vectors and the test scenarios.

        Scenarios have their own models, so that only golden vectors can detect a mutant of the export's model. A mutant
        of patches has frames of its own.
        """
        out = self._new_folder()
        copy = out / "export"
        copy.mkdir()
        for name in self.export.code_names:
            shutil.copyfile(self.code / name, copy / name)
        if mutant.image is not None:
            (copy / IMAGE).write_bytes(mutant.image)
        if mutant.source is not None:
            (copy / LIBRARY[1]).write_text(mutant.source, _ENCODING)
        # On the host compiling takes longer than running.
        optimise = "-O0" if setting.target == "host" else "-O2"
        plain = replace(setting, optimise=optimise, flags=("-std=c99",), image=mutant.image is not None)
        streams = streams[: 1 if mutant.image is not None else None]
        # Scenarios are most likely to detect mutants of the rules.
        for cases in reversed(streams) if mutant.kind in RULES else streams:
            result = self._attempt(copy, plain, cases, out)
            if result.mismatches:
                break
        shutil.rmtree(out, ignore_errors=True)
        return MutantResult(setting.target, mutant.kind, mutant.name, result.mismatches > 0, result.first)

    def _attempt(self, code: Path, setting: Setting, cases: Cases, out: Path, *, both: bool = False) -> RowComparison:
        """Run one program on one stream; ``first`` of the result is a whole sentence.

        ``both``: a program that reads plush_model.bin also checks that plush_model.c holds the same bytes.
        """
        stream, path = cases
        labels = self.export.labels
        names = " and ".join(dict.fromkeys(v.name for v in stream))
        where = f"On {setting.target} ({setting.compiler} {setting.options}), {names}"
        expected = np.concatenate([v.answers for v in stream])
        both = both and setting.image
        defines = {
            "PLUSH_HARNESS_CHANNELS": stream[0].frames.shape[1] - 1,
            "PLUSH_HARNESS_CLASSES": len(labels),
            "PLUSH_HARNESS_MEMORY_BYTES": self.memory_bytes,
            **({"PLUSH_HARNESS_IMAGE": 1} if setting.image else {}),
            **({"PLUSH_HARNESS_BOTH": 1} if both else {}),
        }
        # Compile a copy, because next to the original the compiler would find PlushSense's own plushsense.h. The
        # definitions are in the copy, so that the other sources are compiled only once for all streams.
        harness = out / ("harness.cpp" if setting.cpp else "harness.c")
        lines = [f"#define {name} {value}" for name, value in defines.items()]
        harness.write_text("\n".join([*lines, "#line 1", HARNESS.read_text(encoding="utf-8")]), encoding="utf-8")
        program = build(
            setting.target,
            [code / LIBRARY[1], harness, *([code / MODEL[1]] if both or not setting.image else [])],
            out,
            include=[code],
            optimise=setting.optimise,
            blobs={"cases": path, **({"image": code / IMAGE} if setting.image else {})},
            cc=setting.cc,
            flags=setting.flags,
            object_folder=self.objects,
        )
        try:
            got = program.run(timeout_s=60 + 0.02 * sum(len(v.frames) for v in stream) + self.export.seconds(stream))
        except ProgramError as cause:
            return RowComparison(len(expected), len(expected), 0, f"{where}: {cause}")
        result = compare(expected, got, labels)
        return replace(result, first=f"{where}: {result.first}.") if result.first else result
