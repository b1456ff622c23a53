"""Run, time and check a program that decides on request, and count its instructions; loop.c has the requests."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

CALLGRIND = ("valgrind", "--tool=callgrind", "--instr-atstart=no")


class Died(Exception):
    """The program ended or gave an unexpected reply; the message contains the end of its output."""


class Running:
    """A process that replies to each line with one line."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, text=True, cwd=folder
        )

    def ask(self, line: str) -> str:
        """Send a request to the program and return its reply."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            self._process.wait()
            self._errors.seek(0)
            said = self._errors.read().decode(errors="replace").strip().splitlines()
            raise Died(said[-1][:300] if said else f"it ended with {self._process.returncode}")
        return answer.strip()

    def run(self, decisions: int) -> float:
        """Return the seconds per decision."""
        return float(self.ask(f"run {decisions}")) / decisions

    def check(self, folder: Path, classes: int) -> NDArray[np.float64]:
        """Return the logits (N, K) of all decisions."""
        path = folder / "logits.bin"
        self.ask(f"check {path}")
        return np.fromfile(path, dtype=np.float64).reshape(-1, classes)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.close()
        try:
            self._process.wait(timeout=60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def __enter__(self) -> Running:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def instructions(command: list[str], folder: Path, decisions: int) -> float:
    """Return the instructions of a decision: those of 2N decisions less those of N, so that overhead cancels.

    Raises:
        Died: when the program ends early or callgrind is not available.
    """
    if shutil.which(CALLGRIND[0]) is None:
        raise Died("valgrind is not installed: apt-get install valgrind")
    out = folder / "callgrind.out"
    for old in folder.glob("callgrind.out*"):
        old.unlink()
    with Running([*CALLGRIND, f"--callgrind-out-file={out}", *command], folder) as process:
        process.ask("run 2")
        process.ask("mark")
        process.ask("run 1")
        process.ask("mark")
        for n in (decisions, 2 * decisions):
            process.ask(f"run {n}")
            process.ask("mark")
    parts = [_total(Path(f"{out}.{part}")) for part in (2, 3)]
    return (parts[1] - parts[0]) / decisions


def _total(path: Path) -> int:
    if not path.exists():
        raise Died("callgrind saw no marks: valgrind's headers (valgrind/callgrind.h) are missing")
    found = re.search(r"^(?:totals|summary): (\d+)", path.read_text(errors="replace"), re.MULTILINE)
    if found is None:
        raise Died(f"callgrind wrote no total into {path.name}")
    return int(found[1])
