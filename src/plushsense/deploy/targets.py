"""Machines on which an exported C program can be built and run: this computer and emulated ones.

QEMU runs with ``-icount``, so that instruction counts are the same in every run; they are not the cycles of a real
chip. Each target is a table in ``targets.toml``; start-up code and linker scripts are in ``c/runtime``. Package names
are those of Debian 12.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256
from pathlib import Path

from plushsense.core.errors import BuildError, ConfigError, ProgramError, ToolError, check_known
from plushsense.core.templates import fill_text
from plushsense.core.toml import load_table, read_toml

C_FOLDER = Path(__file__).parent / "c"
RUNTIME = C_FOLDER / "runtime"


@dataclass(frozen=True)
class Target:
    """A machine to compile for and to run programs on; ``targets.toml`` describes the fields."""

    name: str
    title: str
    compiler: str
    packages: Mapping[str, str]
    runtime: tuple[str, ...]
    flags: tuple[str, ...] = ()
    link: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    libraries: Mapping[str, str] = field(default_factory=dict)
    emulator: tuple[str, ...] = ()
    assembler: str = ""
    optimise: tuple[str, ...] = ("-O2", "-Os")
    counts: bool = True
    slow: bool = False


def _read_targets() -> dict[str, Target]:
    path = Path(__file__).with_name("targets.toml")
    rows = read_toml(path, "targets", ConfigError)["targets"]
    listed = [load_table(row, Target, path.name, ConfigError) for row in rows]

    def with_runtime_path(words: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(word.replace("{runtime}", str(RUNTIME)) for word in words)

    return {t.name: replace(t, flags=with_runtime_path(t.flags), link=with_runtime_path(t.link)) for t in listed}


TARGETS = _read_targets()


@dataclass(frozen=True)
class Program:
    """A built program: its ``file``, and the object file of each source, in order."""

    target: Target
    file: Path
    objects: tuple[Path, ...]

    def run(self, *, timeout_s: float = 120.0, given: Path | None = None) -> bytes:
        """Run the program, with the file ``given`` as standard input, and return its standard output.

        Raises:
            ProgramError: for an exit status other than 0 (98 for a crash in an emulator), or a timeout.
        """
        where = f"The test program on {self.target.name}"
        command = [*self.target.run, str(self.file)]
        return run_program(where, command, cwd=self.file.parent, given=given, timeout_s=timeout_s)


def run_program(
    where: str, command: Sequence[str], *, cwd: Path | None = None, given: Path | None = None, timeout_s: float
) -> bytes:
    """Run a command, with the file ``given`` as standard input, and return its standard output; errors name ``where``.

    Raises:
        ProgramError: for an exit status other than 0, or a timeout. ToolError: if it cannot be started.
    """
    try:
        with open(given or os.devnull, "rb") as file:
            result = subprocess.run(command, cwd=cwd, stdin=file, capture_output=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise ProgramError(f"{where} did not end within {timeout_s:g} s: it was stopped.", "") from None
    except OSError as cause:
        raise ToolError(f"{where} cannot be started with {command[0]}: {cause.strerror or cause}.") from None
    if result.returncode != 0:
        errors = result.stderr.decode(errors="replace").strip()
        last = f" Its error: {_error_line(errors)}" if errors else ""
        raise ProgramError(f"{where} ended with status {result.returncode} instead of 0.{last}", errors)
    return result.stdout


def target_named(name: str) -> Target:
    """Return the target of this name; raise ConfigError for an unknown one."""
    check_known(name, TARGETS, "target", ConfigError)
    return TARGETS[name]


def missing_tools(target: str, *, cc: str | None = None) -> list[str]:
    """Return the Debian packages that are missing for building and running programs of a target.

    ``cc`` replaces the target's own compiler.
    """
    machine = target_named(target)
    tools = dict(machine.packages)
    if cc is not None:
        tools = {cc: Path(cc).name} | {t: p for t, p in tools.items() if t != machine.compiler}
    missing = [package for tool, package in tools.items() if shutil.which(tool) is None]
    for file, package in machine.libraries.items():
        compiler = "gcc" if file.endswith(".so") else machine.compiler
        if shutil.which(compiler) is None or not _compiler_has(compiler, file):
            missing.append(package)
    return list(dict.fromkeys(missing))


def require(target: str, *, cc: str | None = None) -> None:
    """Raise ToolError, naming the packages to install, when a tool or library for this target is missing."""
    if missing := missing_tools(target, cc=cc):
        packages = " ".join(missing)
        raise ToolError(
            f"The target {target} ({target_named(target).title}) needs compilers or emulators that are not installed "
            f"here: install Debian's {packages} (apt-get install {packages}), or leave this target out."
        )


@dataclass(frozen=True)
class CompileSpec:
    """Compiler (None: that of the target) and options for the sources of a program and for linking it."""

    cc: str | None = None
    optimise: str = "-O2"
    flags: tuple[str, ...] = ()


def build(
    target: str,
    sources: Sequence[Path],
    out_dir: Path,
    spec: CompileSpec = CompileSpec(),
    *,
    include: Iterable[Path] = (),
    blobs: Mapping[str, Path] | None = None,
    object_folder: Path | None = None,
) -> Program:
    """Build a program in ``out_dir`` from C or assembly sources, one of which defines ``main``.

    ``target.h`` is on the include path. Each file of ``blobs`` becomes bytes from the symbol NAME to NAME_end
    (``extern const uint8_t NAME[], NAME_end[]``), aligned to 16 bytes. The options do not apply to the
    runtime. ``object_folder`` keeps object files, with the compiler's reports, for later builds.

    Raises:
        ToolError: when a compiler or emulator is missing.
        BuildError: when the compiler or linker fails; its ``output`` holds all messages.
    """
    machine = target_named(target)
    require(target, cc=spec.cc)
    compiler = spec.cc or machine.compiler
    out_dir = Path(out_dir).resolve()
    out_dir.mkdir(parents=True, exist_ok=True)
    included = [f"-I{folder.resolve()}" for folder in (RUNTIME, *include)]
    source_flags = [spec.optimise, *spec.flags]
    # Otherwise the compiler replaces the loop inside memset() by a call of memset().
    runtime_flags = ["-O2", "-fno-tree-loop-distribute-patterns"] if machine.run else ["-O2"]
    parts = [(source, source_flags) for source in sources]
    parts += [(RUNTIME / name, runtime_flags) for name in machine.runtime]
    with tempfile.TemporaryDirectory(prefix="plushsense-", dir=out_dir) as work:
        listing = Path(work) / "blobs.S"
        if blobs:
            paths = {name: str(Path(path).resolve()) for name, path in blobs.items()}
            listing.write_text(fill_text("plushsense.deploy", "c/runtime/blobs.S.j2", blobs=paths))
            # -w, because macros in it may be empty.
            parts.append((listing, ["-w"]))
        objects = []
        for n, (source, options) in enumerate(parts):
            assembling = machine.assembler if source is listing else ""
            compiling = [assembling or compiler, *machine.flags, *options]
            if not object_folder:
                name = f"{n}-{source.stem}.o"
            elif blobs and source is listing:
                name = _blobs_name(blobs, compiling)
            else:
                name = _object_name(source, compiling, include)
            objects.append((object_folder or out_dir) / name)
            if not (object_folder and objects[-1].exists()):
                _compile_object(source, [*compiling, *included], objects[-1], Path(work))
        inputs = [str(file) for file in objects]
        file = out_dir / f"program-{target}{'.exe' if sys.platform == 'win32' and not machine.run else ''}"
        collect = ["-Wl,--gc-sections"] if machine.run else []
        command = [compiler, *machine.flags, *source_flags, *collect, *inputs, "-o", str(file), *machine.link]
        _compile(command, Path(work), "the program")
        if machine.emulator:
            machine = replace(machine, run=(str(_build_emulator(machine, out_dir, Path(work))),))
    return Program(machine, file, tuple(objects[: len(sources)]))


def _build_emulator(machine: Target, out_dir: Path, work: Path) -> Path:
    """Compile the program of this computer that runs the programs of ``machine``; return its file."""
    code, *words = machine.emulator
    emulator = out_dir / Path(code).stem
    _compile(["gcc", "-O2", str(RUNTIME / code), "-o", str(emulator), *words], work, code)
    return emulator


def _compile_object(source: Path, compiling: Sequence[str], out: Path, work: Path) -> None:
    """Compile ``source`` to ``out``, with the compiler's reports beside it; ``work`` is an own folder."""
    made = work / out.name
    _compile([*compiling, "-c", str(source.resolve()), "-o", str(made)], work, source.name)
    # Programs that are built at the same time share the folder: a file appears there complete, and the object file
    # after the reports.
    for file in sorted(work.glob(f"{made.stem}.*"), reverse=True):
        file.replace(out.with_name(file.name))


def _object_name(source: Path, command: Sequence[str], include: Iterable[Path]) -> str:
    """Return a file name for an object file: a hash of compiler, flags, source and every file it may include."""
    files = [file for folder in (source.parent, *include) for file in sorted(folder.glob("*.[ch]"))]
    key, texts, seen = sha256(repr(command).encode()), [source.read_bytes()], set[str]()
    for text in texts:
        key.update(text)
        included = re.findall(r'#\s*include\s*[<"]([^>"]+)', text.decode("latin-1"))
        names = {Path(name).name for name in included} - seen
        seen |= names
        texts += [file.read_bytes() for file in files if file.name in names]
    return f"{key.hexdigest()}.o"


def _blobs_name(blobs: Mapping[str, Path], command: Sequence[str]) -> str:
    """Return a file name for the object file of blobs: a hash of compiler, flags, symbols and contents."""
    contents = [(symbol, sha256(Path(path).read_bytes()).hexdigest()) for symbol, path in blobs.items()]
    return f"{sha256(repr((command, contents)).encode()).hexdigest()}.o"


def tool(target: str, name: str) -> str:
    """Return a tool that comes with the target's compiler, such as ``nm`` or ``size``; ToolError if it is missing."""
    compiler = target_named(target).compiler
    command = compiler.removesuffix("gcc") + name
    if shutil.which(command) is None:
        raise ToolError(f"{command}, which comes with {compiler}, is not installed here: install Debian's binutils.")
    return command


def tool_output(command: Sequence[str]) -> str:
    """Run a tool and return its standard output; raise ToolError if it fails."""
    result = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL)
    if result.returncode != 0:
        errors = result.stderr.decode(errors="replace").strip()
        raise ToolError(f"{command[0]} failed: {_error_line(errors)}")
    return result.stdout.decode(errors="replace")


def _compile(command: Sequence[str], cwd: Path, name: str) -> None:
    try:
        # `_error_line` needs English messages.
        env = os.environ | {"LC_ALL": "C"}
        result = subprocess.run(command, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, env=env)
    except OSError as cause:
        raise ToolError(f"{command[0]} cannot be started: {cause.strerror or cause}.") from None
    if result.returncode != 0:
        errors = result.stderr.decode(errors="replace").strip()
        raise BuildError(f"{command[0]} refused {name}: {_error_line(errors)}", errors)


def _error_line(output: str) -> str:
    """Return the first line of a tool's output that reports an error, else the last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    words = (" error:", "undefined reference", "multiple definition", "overflowed", "ERROR:", "Error: ")
    matching = [line for line in lines if any(w in line for w in words) and not line.startswith("collect2")]
    return (matching or lines[-1:] or ["no output"])[0]


@cache
def _compiler_has(compiler: str, file: str) -> bool:
    return Path(tool_output([compiler, f"-print-file-name={file}"]).strip()).is_absolute()
