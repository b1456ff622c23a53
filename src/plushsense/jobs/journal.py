"""Jobs, and a journal of their results on disk, so that a finished job is not computed again.

A job's id is the hash of what it depends on, so that a changed setting is another job. Files are replaced atomically: a
run that is killed leaves complete results or none.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from filelock import BaseFileLock, FileLock, Timeout

from plushsense.core.errors import ForgottenError, PlushSenseError
from plushsense.core.files import PART, replacing_file

Report = Callable[[Any], None]

# Read by the numeric libraries when they are loaded.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@dataclass(frozen=True)
class Job:
    """A job: its id in the journal, and the task that the work is given."""

    id: str
    task: Any


class JobWork(Protocol):
    """The work of every job: a picklable callable (a function of a module, a dataclass with ``__call__``)."""

    def __call__(self, shared: Any, task: Any, report: Report, /) -> Result:
        """Return the result of one job.

        ``report`` takes any message on the way; it reaches ``on_report``.
        """
        ...


class JobEvent(NamedTuple):
    """A report of an engine on a job: that it started (again), a message, its result, or its exception."""

    job: Job
    kind: Literal["started", "report", "done", "failed"]
    what: Any = None


# Returns the next job to start, or None when there are no more; called only when the job can start at once.
Take = Callable[[], Job | None]
Engine = Iterator[JobEvent]


def thread_settings(threads: int) -> dict[str, str]:
    """Return the environment variables of a process that computes on so many threads."""
    return dict.fromkeys(_THREADS, str(threads))


def portable(error: Exception) -> Exception:
    """Return an exception that can be pickled, with the traceback of this process unless it is a `PlushSenseError`."""
    trace = traceback.format_exc()
    if not isinstance(error, PlushSenseError):
        error.add_note(f"In a worker process:\n{trace}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001, RUF100
        return RuntimeError(f"A job failed in a worker process:\n{trace}")
    return error


# Arrays, and values that JSON can hold.
Result = Mapping[str, Any]

_JSON = "json"


def job_id(job: Mapping[str, Any]) -> str:
    """Return the id of a job: a hash of its description as canonical JSON, 20 hexadecimal digits."""
    text = json.dumps(job, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@dataclass(frozen=True)
class Claim:
    """A lock on a job for the process that works on it; it ends with the process at the latest."""

    _lock: BaseFileLock | None

    def release(self) -> None:
        if self._lock is not None:
            # A process that opened the file before looks in the journal before it begins.
            with suppress(OSError):
                Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release()


class Journal:
    """A folder of results, made with the first one; it may be deleted at any time.

    Args:
        writing: returns the context in which files are written; entering it raises PlushSenseError when that is no
            longer allowed. It is pickled with the journal.
    """

    def __init__(self, folder: str | Path, writing: Callable[[], AbstractContextManager[object]] = nullcontext) -> None:
        self.folder = Path(folder)
        self._writing = writing

    def __repr__(self) -> str:
        return f"Journal({str(self.folder)!r})"

    def path(self, job: str) -> Path:
        """Return the file of a job."""
        return self.folder / f"{job}.npz"

    def has(self, job: str) -> bool:
        """Return whether the job is done: its file exists and is complete."""
        return self.find(job) is not None

    def load(self, job: str) -> dict[str, Any]:
        """Return the result of a job that is done; KeyError for one that is not."""
        found = self.find(job)
        if found is None:
            raise KeyError(job)
        return found

    def find(self, job: str) -> dict[str, Any] | None:
        """Return the result of a job; None when there is none or its file is damaged (then the job is not done)."""
        try:
            with np.load(self.path(job), allow_pickle=False) as file:
                result = {name: file[name] for name in file.files}
            values = json.loads(result.pop(_JSON).tobytes())
        # zipfile checks a CRC of every member; the exception for a damaged header depends on the byte.
        except (OSError, EOFError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile):
            return None
        return result | values if isinstance(values, dict) else None

    def claim(self, job: str) -> Claim | None:
        """Claim a job for this process; None when another process has it.

        On a file system without locks every process gets the job.

        Raises:
            PlushSenseError: when the result could not be saved, as nothing may be written any more.
        """
        lock = FileLock(self.folder / f".{job}.lock", timeout=0, thread_local=False)
        try:
            with self._writing():
                self.folder.mkdir(parents=True, exist_ok=True)
                lock.acquire()
        except Timeout:
            return None
        except (OSError, NotImplementedError):
            return Claim(None)
        return Claim(lock)

    def save(self, job: str, result: Result) -> None:
        """Save the result of a job in one step. Arrays stay arrays; other values must fit JSON.

        Raises:
            PlushSenseError: when the folder cannot be written to, or nothing may be written there any more;
            TypeError, ValueError: for values that cannot be saved.
        """
        arrays = {name: value for name, value in result.items() if isinstance(value, np.ndarray)}
        values = {name: value for name, value in result.items() if name not in arrays}
        packed = np.frombuffer(json.dumps(values).encode(), dtype=np.uint8)
        try:
            with self._writing():
                self.folder.mkdir(parents=True, exist_ok=True)
                with replacing_file(self.path(job)) as part, part.open("wb") as file:
                    np.savez(file, allow_pickle=False, **{_JSON: packed}, **arrays)
        except OSError as cause:
            # Windows does not replace a file that is being read: then the result exists already.
            if self.find(job) is None:
                raise PlushSenseError(
                    f"A result cannot be kept in {self.folder} ({cause.strerror or cause}): make room or the folder "
                    "writable, then run again; finished jobs are kept."
                ) from cause

    def prune(self, older_s: float) -> None:
        """Delete results, and files left by killed processes, that are older than so many seconds."""
        with suppress(OSError):
            for path in [*self.folder.glob("*.npz"), *self.folder.glob(f".*{PART}")]:
                with suppress(OSError):
                    if time.time() - path.stat().st_mtime > older_s:
                        path.unlink()

    def discard(self, job: str) -> None:
        """Delete the result of a job, if there is one; on Windows only if no process reads it."""
        with suppress(OSError):
            self.path(job).unlink()


# Kinds of journals in a data set's cache: finished trainings, and states of unfinished ones.
JOURNAL, UNFINISHED = "sweeps", "unfinished"


def keep_if_possible(journal: Journal, job: str, state: Result) -> None:
    """Save the state of a training; without space on the disk it is not saved, which only costs time later.

    Raises:
        ForgottenError: when one of its people was removed from the data set.
    """
    try:
        journal.save(job, state)
    except ForgottenError:
        raise
    except PlushSenseError:
        pass
