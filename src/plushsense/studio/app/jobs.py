"""Run long tasks as jobs: separate processes that any page can start, follow, stop and resume."""

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
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.files import write_file
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.studio.app.workspace import WORK, ChangeSignal, Workspace, refusal_of

UNFINISHED = ".unfinished-"
"""Prefix of temporary folders in the work folder; leftovers are removed when the studio starts."""
INCOMING = "incoming"
"""Folder in the work folder for uploaded files that are not imported yet; it is removed when the studio starts."""
READY = "ready"
"""File beside the session of a trial, by which its training, which was started before, knows that it is complete."""
RUNNING, DONE, REFUSED, STOPPED = "running", "done", "refused", "stopped"
_MAX_REPORTS = 2000
# Keys of a spec or result that are never stored, because they identify people.
_SECRET_KEYS = ("person", "chosen", "receipt")
_STOP_S = 10.0
WARM = "warm"
"""Argument of a worker process that loads PyTorch before it reads its task."""
WARM_S = 600.0
"""How long such a process waits for a task, in seconds."""
_TRAINING = ("make", "train", "evaluate", "sweep", "search")  # tasks for which a warm process is used


@dataclass
class StudioJob:
    """A task that runs in a separate process, with its progress and outcome.

    Attributes:
        id: unique number as a string; later jobs have larger numbers.
        task: a key of `plushsense.studio.tasks.TASKS`.
        spec: the argument of the task, as JSON values.
        state: `RUNNING`, `DONE`, `REFUSED` or `STOPPED` (by a person, or because the process or the studio ended).
        refusal: why the task failed, as `Message.to_json` has it; {} if it did not.
        warnings: arguments of `plushsense.studio.app.words.Words.sentence`.
        progress: the newest report of the task, as JSON values; ``reports`` has earlier ones too, thinned out if many.
        result: the value that the task returned.
        begun_s, ended_s: seconds since 1970.
    """

    id: str
    task: str
    spec: dict[str, Any]
    title: str
    state: str = RUNNING
    progress: dict[str, Any] = field(default_factory=dict)
    reports: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[Any] = field(default_factory=list)
    result: dict[str, Any] = field(default_factory=dict)
    refusal: dict[str, Any] = field(default_factory=dict)
    begun_s: float = 0.0
    ended_s: float = 0.0

    @property
    def message(self) -> str:
        """Why the task failed, in English; "" if it did not."""
        return str(self.refusal.get("message", ""))


class Jobs:
    """The jobs of a studio, stored in ``<workspace>/work/<id>.json``; every report notifies `changed`.

    A job with ``dry`` set in its spec is an estimate or of a trial: it is removed when it ends.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self._workspace, self._folder = workspace, workspace.folder / WORK
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._warm: subprocess.Popen[str] | None = None
        self._warm_until_s = 0.0
        self._lock = threading.RLock()
        self._jobs: dict[str, StudioJob] = {}
        for folder in self._folder.glob(f"{UNFINISHED}*"):
            shutil.rmtree(folder, ignore_errors=True)
        for path in sorted(self._folder.glob("*.json")):
            with contextlib.suppress(OSError, ValueError, TypeError, AttributeError, RecursionError):
                stored = json.loads(path.read_text(encoding="utf-8"))
                job = StudioJob(**stored)
                if job.id != path.stem:
                    continue
                if job.spec.get("dry"):
                    path.unlink()
                    continue
                # A job that was stored as running ended with the studio that started it.
                job.state = STOPPED if job.state == RUNNING else job.state
                self._jobs[job.id] = job
        shutil.rmtree(self._folder / INCOMING, ignore_errors=True)

    def all(self, *tasks: str) -> list[StudioJob]:
        """Return the jobs of the given tasks (by default of all tasks), newest first."""
        with self._lock:
            return [job for job in reversed(self._jobs.values()) if not tasks or job.task in tasks]

    def get(self, identity: str) -> StudioJob:
        """Return the job with this id; raise ConfigError for an unknown id."""
        try:
            return self._jobs[identity]
        except KeyError:
            raise ConfigError("This job is not in the list any more.") from None

    def start(self, task: str, spec: dict[str, Any], title: str) -> StudioJob:
        """Start a task in a separate process."""
        with self._lock:
            # Ids increase even if the clock was set back.
            last = max((int(i) for i in self._jobs if i.isdecimal()), default=0)
            identity = str(max(time.time_ns() // 1_000_000, last + 1))
            job = StudioJob(identity, task, spec, title)
            self._jobs[identity] = job
        self._run(job)
        return job

    def warm_up(self) -> None:
        """Start a process that loads PyTorch for the next training, unless one waits; it ends after `WARM_S`."""
        with self._lock:
            if self._warm is None or self._warm.poll() is not None:
                with contextlib.suppress(OSError):
                    self._warm, self._warm_until_s = _worker(WARM), time.monotonic() + WARM_S

    def _take_warm(self) -> subprocess.Popen[str] | None:
        with self._lock:
            process, self._warm = self._warm, None
        # A process that is about to end is left alone.
        fresh = process is not None and process.poll() is None and time.monotonic() < self._warm_until_s - _STOP_S
        return process if fresh else None

    def check_unused(self, path: Path) -> None:
        """Raise ConfigError if a running job uses the data set or bundle ``path``."""
        for job in self.all():
            if job.state == RUNNING and str(path) in map(str, job.spec.values()):
                raise ConfigError(
                    "“{name}” is in use by the job “{job}”. Wait for it, or stop it first.",
                    job=job.title,
                    name=path.name,
                )

    def import_sessions(self, sessions: Sequence[Path], dest: Path, title: str, readmit: bool = False) -> StudioJob:
        """Start to import recorded sessions into the data set ``dest``, which is created if it does not exist.

        Raises:
            DatasetError: unless ``readmit``, for sessions of a person who was removed from the workspace.
        """
        if not readmit:
            refuse_removed(self._workspace.recordings, {session.parent.name for session in sessions})
        spec: dict[str, Any] = {
            "sessions": [str(session) for session in sessions],
            "readmit": readmit,
            "recordings": str(self._workspace.recordings),
            "work": str(self._folder),
            "dest": str(dest),
        }
        named = {"name": self._workspace.title(dest), **({"add": True} if dest.exists() else {})}
        return self.start("import", spec | named, title)

    def resume(self, identity: str) -> StudioJob:
        """Restart a job that has ended, with the same spec; the task continues from what it has stored."""
        job = self.get(identity)
        with self._lock:
            if job.state == RUNNING:
                return job
            job.state, job.refusal, job.result, job.reports, job.warnings = RUNNING, {}, {}, [], []
        self._run(job)
        return job

    def drop(self, identity: str) -> None:
        """Remove a job that has ended from the list, but keep the files it has created.

        Raises:
            ConfigError: for a running job, or an unknown id.
        """
        job = self.get(identity)
        with self._lock:
            if job.state == RUNNING:
                raise ConfigError("The job “{job}” is running. Stop it first.", job=job.title)
            (self._folder / f"{job.id}.json").unlink(missing_ok=True)
            self._jobs.pop(job.id, None)
        self.changed.notify()

    def stop(self, identity: str) -> None:
        """Interrupt a job as Ctrl-C would, without waiting for its end; do nothing if it has already ended."""
        process = self._processes.get(identity)
        if process is None or process.poll() is not None:
            return
        threading.Thread(target=_end, args=(process,), daemon=True).start()

    def close(self) -> None:
        """Stop all jobs."""
        warm = [self._warm] if self._warm is not None else []
        processes = [p for p in [*self._processes.values(), *warm] if p.poll() is None]
        for process in processes:
            threading.Thread(target=_end, args=(process,), daemon=True).start()
        for process in processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_STOP_S)

    def _run(self, job: StudioJob) -> None:
        job.begun_s, job.ended_s, job.progress = time.time(), 0.0, {}
        try:
            # Store the job first, so that it is found after a crash.
            self._store(job)
            process = (self._take_warm() if job.task in _TRAINING else None) or _worker()
        except OSError as cause:
            job.state, job.refusal, job.ended_s = REFUSED, refusal_of(cause).to_json(), time.time()
            self.changed.notify()
            return
        self._processes[job.id] = process
        assert process.stdin is not None
        with contextlib.suppress(OSError):
            # Keep standard input open: the worker process ends when it is closed.
            process.stdin.write(json.dumps({"task": job.task, "spec": job.spec}, default=str) + "\n")
            process.stdin.flush()
        self.changed.notify()
        threading.Thread(target=self._follow, args=(job, process), daemon=True).start()

    def _follow(self, job: StudioJob, process: subprocess.Popen[str]) -> None:
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
                if len(job.reports) >= _MAX_REPORTS:
                    del job.reports[::2]
                job.reports.append(job.progress)
            elif "warning" in message:
                job.warnings.append(message["warning"])
            else:
                outcome = message
            self.changed.notify()
        process.wait()
        for end in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                if end is not None:
                    end.close()
        job.ended_s = time.time()
        # Hold the lock, so that a job dropped right after its end is not stored afterwards.
        with self._lock:
            if "result" in outcome:
                job.state, job.result = DONE, outcome["result"]
            elif "refused" in outcome:
                job.state, job.refusal = REFUSED, outcome["refused"]
            else:
                job.state = STOPPED
            with contextlib.suppress(OSError):
                # Errors are ignored because the outcome is valid even if it cannot be stored.
                if job.spec.get("dry"):
                    self.drop(job.id)
                else:
                    self._store(job)
        self.changed.notify()

    def _store(self, job: StudioJob) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        stored = asdict(job)
        for key in _SECRET_KEYS:
            stored["spec"].pop(key, None)
            stored["result"].pop(key, None)
        write_file(self._folder / f"{job.id}.json", json.dumps(stored, default=str))


def _worker(*words: str) -> subprocess.Popen[str]:
    # -P: nothing is imported from the working folder, which may be a data set of somebody else.
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "plushsense.studio.tasks", *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        encoding="utf-8",
        start_new_session=True,
        creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
    )


def _end(process: subprocess.Popen[str]) -> None:
    """Interrupt a process as Ctrl-C would; kill it if it does not end in time."""
    for gentle in (True, False):
        with contextlib.suppress(OSError, ValueError):
            if sys.platform == "win32":
                process.terminate()
            else:
                os.killpg(process.pid, signal.SIGINT if gentle else signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_STOP_S / 2)
            return
