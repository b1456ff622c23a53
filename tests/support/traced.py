"""Run a program under strace and list the sockets that it used, whoever opened them: Python or a library."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from support.requirements import missing
from support.waiting import until

# An address in a traced call; sockets between the processes of a program have none, or a path.
_ADDRESS = re.compile(
    r"^\d+ +(\w+)\(.*\b"
    r'(?:sin_addr=inet_addr\("([^"]+)"\)|inet_pton\(AF_INET6, "([^"]+)"|sun_path=@?"([^"]+)")'
)
# With a family other than these, a socket is raw, of Bluetooth, or speaks with the kernel.
_FAMILY = re.compile(r"^\d+ +socket\((?!AF_INET6?, SOCK_STREAM|AF_UNIX)(\w+, \w+)")
_CALLS = "socket,bind,connect,sendto,sendmsg,sendmmsg"


class SocketTrace:
    """The system calls of one program that concern sockets; put ``words`` before its command."""

    def __init__(self, folder: Path) -> None:
        self._log = folder / "sockets.strace"
        # The program keeps the process and its signals (-D); only these calls are slower (--seccomp-bpf).
        options = [
            "-D",
            "-f",
            "-q",
            "--seccomp-bpf",
            "-e",
            f"trace={_CALLS}",
            "-e",
            "signal=none",
            "-o",
            str(self._log),
        ]
        strace = shutil.which("strace")
        self._missing = None if strace else ("strace", "strace is not installed")
        if strace and subprocess.run([strace, *options, "true"], capture_output=True).returncode != 0:
            self._missing = ("ptrace", "processes may not be traced here")
        self.words = [strace, *options] if strace and not self._missing else []

    def used(self) -> set[str]:
        """Wait for the end of the program; return its addresses as "call address", and the unusual kinds of sockets.

        Call this last: where nothing can be traced, it skips the test.
        """
        if self._missing:
            missing(*self._missing)
        until(lambda: self._log.is_file() and self._ended(), 60.0)
        used = set()
        for line in self._log.read_text().splitlines():
            if found := _ADDRESS.match(line):
                used.add(f"{found[1]} {found[2] or found[3] or found[4]}")
            elif found := _FAMILY.match(line):
                used.add(found[1])
        return used

    def _ended(self) -> bool:
        lines = self._log.read_text().splitlines()
        first = lines[0].split()[0] if lines else ""
        return any(re.match(rf"{first} +\+\+\+ (exited|killed)", line) for line in lines)
