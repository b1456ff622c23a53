"""Machines on which an exported C program can be built and run: this computer and chips emulated by QEMU.

The emulators run with ``-icount``, so that counts are the same in every run. They count instructions, not cycles, and
are no real chips. A microcontroller is a table of ``targets.toml``; its start-up code and linker script are in
``c/runtime``. Package names are those of Debian 12.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache as cached
from hashlib import sha256
from pathlib import Path

from plushsense.core.errors import BuildError, ConfigError, ProgramError, ToolError, check_known
from plushsense.core.templates import fill_text
from plushsense.core.toml import load_table, read_toml

C_FOLDER = Path(__file__).parent / "c"
RUNTIME = C_FOLDER / "runtime"


@dataclass(frozen=True)
class Target:
    """A machine, as ``targets.toml`` describes it: how to compile for it and how to run a program there."""

    name: str
    title: str
    compiler: str
    packages: Mapping[str, str]
    runtime: tuple[str, ...]
    flags: tuple[str, ...] = ()
    link: tuple[str, ...] = ()
    run: tuple[str, ...] = ()
    libraries: Mapping[str, str] = field(default_factory=dict)
    counts: bool = True


def _read_targets() -> dict[str, Target]:
    path = Path(__file__).with_name("targets.toml")
    rows = read_toml(path, "targets", ConfigError)["targets"]
    listed = [load_table(row, Target, path.name, ConfigError) for row in rows]

    def placed(words: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(word.replace("{runtime}", str(RUNTIME)) for word in words)

    return {t.name: replace(t, flags=placed(t.flags), link=placed(t.link)) for t in listed}


TARGETS = _read_targets()


@dataclass(frozen=True)
class Program:
    """A built program: its ``file``, and the object file of each source, in order."""

    target: Target
    file: Path
    objects: tuple[Path, ...]

    def run(self, *, timeout_s: float = 120.0) -> bytes:
        """Run the program and return its standard output.

        Raises:
            ProgramError: when it ends with another status than 0, crashes (98 on an emulator), or takes too long.
        """
        command = [*self.target.run, str(self.file)]
        where = f"The test program on {self.target.name}"
        try:
            done = subprocess.run(
                command, cwd=self.file.parent, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout_s
            )
        except subprocess.TimeoutExpired:
            raise ProgramError(f"{where} did not end within {timeout_s:g} s: it was stopped.", "") from None
        except OSError as cause:
            raise ToolError(f"{where} cannot be started with {command[0]}: {cause.strerror or cause}.") from None
        if done.returncode != 0:
            errors = done.stderr.decode(errors="replace").strip()
            last = f" Its error: {_error_line(errors)}" if errors else ""
            raise ProgramError(f"{where} ended with status {done.returncode} instead of 0.{last}", errors)
        return done.stdout


def target_named(name: str) -> Target:
    """Return the target of this name; ConfigError for an unknown one."""
    check_known(name, TARGETS, "target", ConfigError)
    return TARGETS[name]


def missing_tools(target: str, *, cc: str | None = None) -> list[str]:
    """Return the Debian packages that are missing for building and running programs of a target.

    ``cc`` names another compiler than the target's own.
    """
    machine = target_named(target)
    tools = dict(machine.packages)
    if cc is not None:
        tools = {cc: Path(cc).name} | {t: p for t, p in tools.items() if t != machine.compiler}
    missing = [package for tool, package in tools.items() if shutil.which(tool) is None]
    for file, package in machine.libraries.items():
        if shutil.which(machine.compiler) is None or not _finds(machine.compiler, file):
            missing.append(package)
    return list(dict.fromkeys(missing))


def require(target: str, *, cc: str | None = None) -> None:
    """Raise ToolError, with what to install, when something for this target is missing."""
    if missing := missing_tools(target, cc=cc):
        packages = " ".join(missing)
        raise ToolError(
            f"The target {target} ({target_named(target).title}) needs compilers or emulators that are not installed "
            f"here: install Debian's {packages} (apt-get install {packages}), or leave this target out."
        )


def build(
    target: str,
    sources: Sequence[Path],
    out_dir: Path,
    *,
    include: Iterable[Path] = (),
    defines: Mapping[str, object] | None = None,
    optimise: str = "-O2",
    blobs: Mapping[str, Path] | None = None,
    cc: str | None = None,
    flags: Sequence[str] = (),
    cache: Path | None = None,
) -> Program:
    """Build a program from C (or assembly) sources, one of which has ``main``, in ``out_dir``.

    ``target.h`` is on the include path. Each file of ``blobs`` becomes bytes from the symbol NAME to NAME_end
    (``extern const uint8_t NAME[], NAME_end[]``), at a multiple of 16. ``flags`` are for the sources, not for the
    runtime, and for linking. With the folder ``cache``, a source that was compiled before is not compiled again.

    Raises:
        ToolError: when a compiler or emulator is missing.
        BuildError: when the compiler or linker refuses; its ``output`` holds all messages.
    """
    machine = target_named(target)
    require(target, cc=cc)
    compiler = cc or machine.compiler
    out_dir = Path(out_dir).resolve()
    out_dir.mkdir(parents=True, exist_ok=True)
    included = [f"-I{folder.resolve()}" for folder in include]
    own = [optimise, *flags, *(f"-D{name}={value}" for name, value in (defines or {}).items())]
    with tempfile.TemporaryDirectory(prefix="plushsense-", dir=out_dir) as work:
        objects = []
        compiling = [compiler, *machine.flags, *own]
        for n, source in enumerate(sources):
            name = _object_name(source, compiling, include) if cache else f"{n}-{source.stem}.o"
            objects.append((cache or out_dir) / name)
            if cache and objects[-1].exists():
                continue
            # Programs that are built at the same time share the cache: a file appears there complete.
            made = Path(work) / "made.o" if cache else objects[-1]
            command = [*compiling, f"-I{RUNTIME}", *included, "-c", str(source.resolve()), "-o", str(made)]
            _compile(command, Path(work), source.name)
            made.replace(objects[-1])
        around = [str(RUNTIME / name) for name in machine.runtime]
        if blobs:
            paths = {name: str(Path(path).resolve()) for name, path in blobs.items()}
            assembly = fill_text("plushsense.deploy", "c/runtime/blobs.S.j2", blobs=paths)
            (Path(work) / "blobs.S").write_text(assembly)
            around.append("blobs.S")
        # Keeps the compiler from turning a loop of memset() into a call of memset().
        runtime = ["-O2", "-fno-tree-loop-distribute-patterns"] if machine.run else ["-O2"]
        command = [compiler, *machine.flags, f"-I{RUNTIME}", *runtime, "-c", *around]
        _compile(command, Path(work), "the runtime")
        file = out_dir / f"program-{target}{'.exe' if sys.platform == 'win32' and not machine.run else ''}"
        linked = [*map(str, objects), *sorted(p.name for p in Path(work).glob("*.o"))]
        trim = ["-Wl,--gc-sections"] if machine.run else []
        command = [compiler, *machine.flags, optimise, *flags, *trim, *linked, "-o", str(file), *machine.link]
        _compile(command, Path(work), "the program")
    return Program(machine, file, tuple(objects))


def _object_name(source: Path, command: Sequence[str], include: Iterable[Path]) -> str:
    """Return a file name for the object of a source: the same for the same compiler, flags, source and headers."""
    headers = sorted(header for folder in include for header in folder.glob("*.h"))
    key = sha256(repr(command).encode())
    for path in (source, *headers):
        key.update(path.read_bytes())
    return f"{key.hexdigest()}.o"


def tool(target: str, name: str) -> str:
    """Return a tool that comes with the target's compiler, such as ``nm`` or ``size``; ToolError when it is missing."""
    compiler = target_named(target).compiler
    command = compiler.removesuffix("gcc") + name
    if shutil.which(command) is None:
        raise ToolError(f"{command}, which comes with {compiler}, is not installed here: install Debian's binutils.")
    return command


def tool_output(command: Sequence[str]) -> str:
    """Return the standard output of a tool; ToolError when it fails."""
    done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode != 0:
        errors = done.stderr.decode(errors="replace").strip()
        raise ToolError(f"{command[0]} failed: {_error_line(errors)}")
    return done.stdout.decode(errors="replace")


def _compile(command: Sequence[str], cwd: Path, what: str) -> None:
    try:
        # English messages in every locale.
        env = os.environ | {"LC_ALL": "C"}
        done = subprocess.run(command, cwd=cwd, stdin=subprocess.DEVNULL, capture_output=True, env=env)
    except OSError as cause:
        raise ToolError(f"{command[0]} cannot be started: {cause.strerror or cause}.") from None
    if done.returncode != 0:
        errors = done.stderr.decode(errors="replace").strip()
        raise BuildError(f"{command[0]} refused {what}: {_error_line(errors)}", errors)


def _error_line(output: str) -> str:
    """Return the first line of a tool's output that names an error, else the last line."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    words = (" error:", "undefined reference", "multiple definition", "overflowed", "ERROR:")
    matching = [line for line in lines if any(w in line for w in words) and not line.startswith("collect2")]
    return (matching or lines[-1:] or ["no output"])[0]


@cached
def _finds(compiler: str, file: str) -> bool:
    return Path(tool_output([compiler, f"-print-file-name={file}"]).strip()).is_absolute()
