"""Long work in processes of its own: begun, watched, stopped and taken up again, whatever page is open."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass, field
from typing import Any

from plushsense.apps.studio.house import WORK, Bell, House
from plushsense.core.errors import ConfigError
from plushsense.dataset.store import write_atomically

UNFINISHED = ".unfinished-"
"""How folders in the work folder begin that hold what is made on the way; they are removed at the next start."""
INCOMING = "incoming"
"""In the work folder: files that visitors sent, until they are settled; nobody's are removed at the next start."""
RUNNING, DONE, REFUSED, STOPPED = "running", "done", "refused", "stopped"
_KEPT = 2000
# Of a spec, what is for the worker's ears only: words that may not be left anywhere, such as people's names.
_UNKEPT = ("words",)
_STOP_S = 10.0


@dataclass
class Job:
    """One piece of work.

    Attributes:
        id: unique, in the order of beginning. ``task``: a key of `plushsense.apps.studio.worker.TASKS`.
        spec: what the task is given, plain values. ``title``: for people.
        state: `RUNNING`, `DONE`, `REFUSED` (``said`` is the sentence), or `STOPPED` (by a person, or with the studio).
        progress: the newest report of the task; ``reports``: all of them, up to some thousands. Plain values.
        warnings: sentences. ``result``: what the task returned.
        begun_s, ended_s: seconds since 1970.
    """

    id: str
    task: str
    spec: dict[str, Any]
    title: str
    state: str = RUNNING
    progress: dict[str, Any] = field(default_factory=dict)
    reports: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    said: str = ""
    begun_s: float = 0.0
    ended_s: float = 0.0


class Jobs:
    """All work of a studio, kept in ``<house>/work/<id>.json``. `bell` rings at every report.

    Work whose spec says ``dry`` only looks: once it has ended, it is in the hands of whoever began it, and not kept.
    """

    def __init__(self, house: House) -> None:
        self.bell = Bell()
        self._folder = house.folder / WORK
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._lock = threading.RLock()
        self._jobs: dict[str, Job] = {}
        for left in self._folder.glob(f"{UNFINISHED}*"):
            shutil.rmtree(left, ignore_errors=True)
        for path in sorted(self._folder.glob("*.json")):
            with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
                job = Job(**json.loads(path.read_text(encoding="utf-8")))
                if job.id != path.stem:
                    continue
                if job.spec.get("dry"):
                    path.unlink()
                    continue
                # What was running ended with the studio that ran it.
                job.state = STOPPED if job.state == RUNNING else job.state
                self._jobs[job.id] = job
        # Sent while the studio was killed; what stopped work would go on with stays.
        wanted = {str(job.spec.get("archive")) for job in self._jobs.values() if job.state == STOPPED}
        for sent in self._folder.glob(f"{INCOMING}/*"):
            if str(sent) not in wanted:
                with contextlib.suppress(OSError):
                    sent.unlink()

    def all(self, *tasks: str) -> list[Job]:
        """The newest first; of these tasks, or of all."""
        with self._lock:
            return [job for job in reversed(self._jobs.values()) if not tasks or job.task in tasks]

    def get(self, identity: str) -> Job:
        """One job.

        Raises:
            ConfigError: for an id that is none.
        """
        try:
            return self._jobs[identity]
        except KeyError:
            raise ConfigError(f"There is no work '{identity}': it may have been removed.") from None

    def start(self, task: str, spec: dict[str, Any], title: str) -> Job:
        """Begin work in a process of its own."""
        with self._lock:
            # Ids stay in the order of beginning, also when the clock was set back.
            last = max((int(i) for i in self._jobs if i.isdecimal()), default=0)
            identity = str(max(time.time_ns() // 1_000_000, last + 1))
            job = Job(identity, task, spec, title)
            self._jobs[identity] = job
        self._run(job)
        return job

    def resume(self, identity: str) -> Job:
        """Begin a stopped job again with the same settings; the task itself goes on from what it kept."""
        job = self.get(identity)
        with self._lock:
            if job.state == RUNNING:
                return job
            job.state, job.said, job.result, job.reports, job.warnings = RUNNING, "", {}, [], []
        self._run(job)
        return job

    def drop(self, identity: str) -> None:
        """Take work that has ended out of the list; what it made stays.

        Raises:
            ConfigError: for work that is running, or an id that is none.
        """
        job = self.get(identity)
        with self._lock:
            if job.state == RUNNING:
                raise ConfigError(f"'{job.title}' is running: stop it first.")
            (self._folder / f"{job.id}.json").unlink(missing_ok=True)
            self._jobs.pop(job.id, None)
        self.bell.ring()

    def stop(self, identity: str) -> None:
        """Have a job end as Ctrl-C would; harmless for one that has ended. Does not wait."""
        process = self._processes.get(identity)
        if process is None or process.poll() is not None:
            return
        threading.Thread(target=_end, args=(process,), daemon=True).start()

    def close(self) -> None:
        """Stop all."""
        processes = [p for p in self._processes.values() if p.poll() is None]
        for process in processes:
            threading.Thread(target=_end, args=(process,), daemon=True).start()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_S)

    def _run(self, job: Job) -> None:
        job.begun_s, job.ended_s, job.progress = time.time(), 0.0, {}
        new_group: dict[str, Any] = (
            {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
            if sys.platform == "win32"
            else {"start_new_session": True}
        )
        try:
            # First, so that nothing works that nobody could find again.
            self._keep(job)
            process = subprocess.Popen(
                [sys.executable, "-m", "plushsense.apps.studio.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                encoding="utf-8",
                **new_group,
            )
        except OSError as cause:
            where = cause.filename or self._folder
            job.state, job.said = REFUSED, f"The work cannot begin: '{where}': {cause.strerror or cause}."
            job.ended_s = time.time()
            self.bell.ring()
            return
        self._processes[job.id] = process
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            # Its standard input stays open: the worker ends when the studio is gone.
            process.stdin.write(json.dumps({"task": job.task, "spec": job.spec}, default=str) + "\n")
            process.stdin.flush()
        self.bell.ring()
        threading.Thread(target=self._follow, args=(job, process), daemon=True).start()

    def _follow(self, job: Job, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        outcome: dict[str, Any] = {}
        for line in process.stdout:
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if not isinstance(message, dict):
                continue
            if "progress" in message:
                job.progress = message["progress"]
                if len(job.reports) >= _KEPT:
                    del job.reports[::2]
                job.reports.append(job.progress)
            elif "warning" in message:
                job.warnings.append(str(message["warning"]))
            else:
                outcome = message
            self.bell.ring()
        process.wait()
        for end in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if end is not None:
                    end.close()
        job.ended_s = time.time()
        if "result" in outcome:
            job.state, job.result = DONE, outcome["result"]
        elif "refused" in outcome:
            job.state, job.said = REFUSED, str(outcome["refused"])
        else:
            job.state = STOPPED
        with contextlib.suppress(OSError):
            # Done is done, also where the disk has no room to say so.
            if job.spec.get("dry"):
                self.drop(job.id)
            else:
                self._keep(job)
        self.bell.ring()

    def _keep(self, job: Job) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        said = asdict(job)
        for key in _UNKEPT:
            said["spec"].pop(key, None)
        write_atomically(self._folder / f"{job.id}.json", json.dumps(said, default=str))


def _end(process: subprocess.Popen[str]) -> None:
    """As Ctrl-C; then less kindly."""
    for polite in (True, False):
        with contextlib.suppress(OSError, ValueError):
            if sys.platform == "win32":
                process.terminate()
            else:
                os.killpg(process.pid, signal.SIGINT if polite else signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_STOP_S / 2)
            return
