"""Run a command in a process that is killed, or finds the disk full, at one of its own operations on files.

The process is forked from a server that has imported what the commands need, so that a drill costs what the command
itself costs. An audit hook counts what the process does to the files below its folder: opening for writing, renaming,
making and removing; flushing is counted too. At the chosen operation the process kills itself (SIGKILL), or from there
on everything that needs room fails with ENOSPC.
"""

from __future__ import annotations

import errno
import faulthandler
import hashlib
import importlib
import json
import multiprocessing
import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any, Literal

from plushsense.core.files import is_unfinished
from plushsense.dataset.marks import Mark, append_marks

REPETITIONS = int(os.environ.get("PLUSHSENSE_DRILLS", "1"))
"""Drills of each command; ``make soak`` sets more."""

Fault = Literal["", "kill", "full"]
# Not Polars, which starts threads: a process forked beside them may wait for a lock that one of them held.
_PRELOADED = (
    *(
        "plushsense.cli.main",
        "plushsense.workflow.api",
        "plushsense.experiments.sweep.run_sweep",
        "plushsense.deploy.package",
    ),
    *("plushsense.dataset.publishing.package", "pytest", "torch"),
    *("mlcroissant", "frictionless", "datacite"),
)
# A command that hangs ends, with the stacks of its threads as its error output.
_LONGEST_S = 500
_NEEDS_ROOM = ("open", "os.mkdir", "fsync")
_OTHER = ("os.rename", "os.remove", "os.rmdir", "os.truncate")
_WRITING = os.O_WRONLY | os.O_RDWR


@dataclass(frozen=True)
class Ran:
    """How a command ended: its exit status (-9: killed), what it printed, and its operations on files."""

    status: int
    out: str
    err: str
    operations: int

    @property
    def json(self) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.out)
        return found

    @property
    def sentence(self) -> str:
        """The one sentence of a refusal; empty if there is none, or more than one."""
        said = [line for line in self.err.splitlines() if line.startswith("plushsense: ")]
        return said[0] if len(said) == 1 and "Traceback" not in self.err else ""


def server() -> ForkServerContext:
    """The server that processes are forked from; it starts with the first."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_PRELOADED))
    return context


def run(words: list[str], place: Path, fault: Fault = "", at: int = 0) -> Ran:
    """Run a command whose files are all below ``place``, with a fault at its operation number ``at``."""
    return start(words, place, fault, at)()


def start(words: list[str], place: Path, fault: Fault = "", at: int = 0) -> Callable[[], Ran]:
    """Start a command as `run` does; the returned function waits for its end."""
    said = Path(tempfile.mkdtemp(dir=place.parent))
    child = server().Process(target=_run, args=(words, place, said, fault, at))
    child.start()

    def end() -> Ran:
        child.join()
        texts = {path.name: path.read_text() for path in said.iterdir()}
        shutil.rmtree(said)
        assert child.exitcode is not None
        return Ran(child.exitcode, texts["out"], texts["err"], int(texts.get("operations", 0)))

    return end


def _run(words: list[str], place: Path, said: Path, fault: Fault, at: int) -> None:
    for number, name in ((1, "out"), (2, "err")):
        descriptor = os.open(said / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(descriptor, number)
    sys.stdout, sys.stderr = (os.fdopen(os.dup(n), "w", buffering=1) for n in (1, 2))
    faulthandler.dump_traceback_later(_LONGEST_S, exit=True)
    (place / "tmp").mkdir(exist_ok=True)
    tempfile.tempdir = str(place / "tmp")
    os.environ["TMPDIR"] = str(place / "tmp")
    over, count, below = False, 0, os.fspath(place) + os.sep

    def operation(kind: str) -> None:
        nonlocal count
        if over:
            return
        count += 1
        if fault == "kill" and count == at:
            os.kill(os.getpid(), signal.SIGKILL)
        if fault == "full" and count >= at and kind in _NEEDS_ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def hook(event: str, args: tuple[Any, ...]) -> None:
        if event in _NEEDS_ROOM or event in _OTHER:
            if event == "open" and not (isinstance(args[2], int) and args[2] & _WRITING):
                return
            path = args[0]
            if isinstance(path, bytes | str) and os.fsdecode(path).startswith(below):
                operation(event)

    fsync = os.fsync

    def flush(descriptor: int) -> None:
        operation("fsync")
        fsync(descriptor)

    os.fsync = flush
    sys.addaudithook(hook)
    status = importlib.import_module("plushsense.cli.main").main(words)
    over = True
    sys.stdout.flush()
    (said / "operations").write_text(str(count))
    os._exit(status)


@dataclass(frozen=True)
class Drill:
    """A command to drill.

    ``words`` are its arguments, with DIR for the folder of its files; ``outcome`` returns, from the folder and the last
    run, what must be the same after any fault as after an undisturbed run. Files in the folders ``raw`` must never
    change. The names of what ``names_differ`` begins with differ from run to run. With ``once``, the command does
    something else, or refuses, when it is given again although it was done; its outcome is that of the files alone.
    ``done`` says whether it was done although it was killed.
    """

    words: str
    outcome: Callable[[Path, Ran], Any]
    raw: tuple[str, ...] = ("src", "DS/recordings", "DS/streams")
    names_differ: tuple[str, ...] = ()
    once: bool = False
    done: Callable[[Path], bool] = lambda place: False

    def command(self, place: Path) -> list[str]:
        return [word.replace("DIR", str(place)) for word in shlex.split(self.words)]


def appending(folder: Path, who: str, count: int) -> None:
    """Append marks of ``who`` one by one, as a program of its own does."""
    for number in range(count):
        append_marks(folder, [Mark("P1/Slow_1", "trim", who, start=number, stop=500 + number)])


def contents(folder: Path, *, without: tuple[str, ...] = ()) -> dict[str, str]:
    """The SHA-256 of every file below a folder, but those whose name or top folder is in ``without``."""
    found = {}
    for path in sorted(folder.rglob("*")):
        where = path.relative_to(folder)
        if path.is_file() and path.name not in without and where.parts[0] not in without:
            found[where.as_posix()] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def names(folder: Path, without: tuple[str, ...] = ()) -> set[str]:
    """The path of everything below a folder, but what is in the folders ``without``, and empty work folders.

    A program that is killed while it deletes its work folder leaves one with nothing but its lock.
    """
    works = [left for left in folder.rglob("*") if is_unfinished(left.name) and left.is_dir()]
    empty = {left for left in works if [path.name for path in left.iterdir()] in ([], ["owner.lock"])}
    paths = [path for path in folder.rglob("*") if not empty & {path, path.parent}]
    found = {path.relative_to(folder).as_posix() for path in paths}
    return {name for name in found if not name.startswith(without)} if without else found
