"""Test files in a process of their own beside a worker: what they load and keep is gone when it ends.

A worker collects all tests of its run and keeps what one of them has loaded: scikit-learn 120 MB, Ray
more. The files with one mark ``pytestmark = pytest.mark.apart("NAME")`` run in a fork of a server process, which has
collected all marked files. The fork ends when the worker comes to another name, or after a test that leaves more than
`ENOUGH_MB` allocated. Such a file imports what it shares a process for within its tests: see `_refuse_threads`.

Without workers (``pytest tests/...``, coverage) all tests run in the one process.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from support.memory import memory_mb

TESTS = Path(__file__).parents[1]
ENOUGH_MB = 340
_CHANNEL = "TESTS_APART"
SHARED = "TESTS_SHARED"
"""Environment variables: the socket on which a worker asks a process for tests; the folder that all workers share."""

Asked = tuple[str, str | None]  # the test, and the next one of its group, which may use the same fixtures
Answer = tuple[list[dict[str, Any]], float]  # reports, and the most memory so far: see `memory_mb`


class Apart:
    """The server process of a worker, as the worker sees it: it has collected ``files``."""

    def __init__(self, files: list[str], config: pytest.Config, base: Path) -> None:
        self.config = config
        ours, theirs = socket.socketpair()
        with theirs:
            words = [sys.executable, "-m", "pytest", *(str(TESTS / file) for file in files)]
            words += ["-p", "no:xdist", "-p", "no:cacheprovider"]
            # A worker's folder lies in that of the run.
            environment = {**os.environ, _CHANNEL: str(theirs.fileno()), SHARED: str(base.parent)}
            self.process = subprocess.Popen(
                [*words, "--rootdir", str(config.rootpath), f"--basetemp={base / 'apart'}"],
                cwd=config.invocation_params.dir,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        self.channel = Connection(ours.detach())

    def run(self, item: pytest.Item, following: str | None) -> tuple[list[pytest.TestReport], float]:
        """Run a test there; return its reports, or one of a failure if the process ended, and the memory in MB."""
        try:
            self.channel.send((item.nodeid, following))
            answer: Answer = self.channel.recv()
        except (EOFError, OSError):
            said = (
                f"The process of {item.path.name} ended with status {self.process.wait()} (see tests/support/apart.py)."
            )
            words: dict[str, Any] = dict.fromkeys(item.keywords, 1)
            return [pytest.TestReport(item.nodeid, item.location, words, "failed", said, "call")], 0.0
        make = self.config.hook.pytest_report_from_serializable
        return [make(config=self.config, data=report) for report in answer[0]], answer[1]

    def close(self) -> None:
        """End the process."""
        self.channel.close()
        self.process.wait()


class Worker:
    """Plugin of a worker: runs the files in processes of their own."""

    def __init__(self) -> None:
        self.apart: Apart | None = None
        self.peaks: dict[str, float] = {}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
        """Run a test of these files in the process of its group."""
        place, group = _place(item), group_of(item)
        if not group:
            return None
        if self.apart is None or self.apart.process.poll() is not None:
            base = item.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
            files = dict.fromkeys(_place(one) for one in item.session.items if group_of(one))
            self.apart = Apart(list(files), item.config, base)
        following = nextitem.nodeid if nextitem is not None and group_of(nextitem) == group else None
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports, mb = self.apart.run(item, following)
        for report in reports:
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        self.peaks[place] = max(self.peaks.get(place, 0.0), mb)
        # What an earlier test left for others of its folder is not known to what runs in this process after it.
        item.session._setupstate.teardown_exact(nextitem)
        return True

    def pytest_sessionfinish(self) -> None:
        if self.apart is not None:
            self.apart.close()


class Served:
    """Plugin of the server: a fork of it, which has collected all tests already, runs those of one group.

    The server itself runs no test, so that no library has threads when it forks.
    """

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Run what is asked for until the worker closes the channel."""
        items = {item.nodeid: item for item in session.items}
        channel = Connection(int(os.environ.pop(_CHANNEL)))
        # The first to ask for this folder makes it anew.
        session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
        while (asked := _asked(channel)) is not None:
            _refuse_threads()
            if child := os.fork():
                _, status = os.waitpid(child, 0)
                if status:
                    # The worker learns of it, and starts another server.
                    os._exit(os.waitstatus_to_exitcode(status) % 256)
                continue
            status = 1
            try:
                _run_group(session, items, channel, asked)
                status = 0
            finally:
                with contextlib.suppress(Exception):
                    atexit._run_exitfuncs()
                os._exit(status)
        return True


def _refuse_threads() -> None:
    """End this process if it has threads, which a fork would lack: import what starts them within the tests."""
    with contextlib.suppress(OSError):
        tasks = sorted(Path("/proc/self/task").glob("*/comm"))
        if len(tasks) > 1:
            os.write(2, f"{__file__}: threads of {', '.join(p.read_text().strip() for p in tasks)}\n".encode())
            os._exit(3)


def _run_group(session: pytest.Session, items: dict[str, pytest.Item], channel: Connection, asked: Asked) -> None:
    """Run the tests that are asked for, until the next is of another group or too much memory is allocated."""
    while True:
        name, following = asked
        reports = runtestprotocol(items[name], log=False, nextitem=items.get(following or ""))
        to_data = session.config.hook.pytest_report_to_serializable
        data = [to_data(config=session.config, report=report) for report in reports]
        now_mb, most_mb = memory_mb()
        last = following is None or now_mb > ENOUGH_MB
        if last:
            session._setupstate.teardown_exact(None)
        channel.send((data, most_mb))
        if last or (next_asked := _asked(channel)) is None:
            return
        asked = next_asked


def _asked(channel: Connection) -> Asked | None:
    """Return the next test that is asked for; None once the worker has closed the channel."""
    with contextlib.suppress(EOFError, OSError):
        return channel.recv()  # type: ignore[no-any-return]
    return None


def group_of(item: pytest.Item) -> str:
    """Return the name of the processes that a test shares with others, empty if it runs in the worker."""
    mark = item.get_closest_marker("apart")
    return "" if mark is None else str(mark.args[0])


def _place(item: pytest.Item) -> str:
    return item.path.relative_to(TESTS).as_posix() if item.path.is_relative_to(TESTS) else ""


def plugin() -> Worker | Served | None:
    """Return the plugin that this process of pytest needs."""
    if _CHANNEL in os.environ:
        return Served()
    # Sockets are handed to another process as on POSIX.
    return Worker() if "PYTEST_XDIST_WORKER" in os.environ and os.name == "posix" else None
