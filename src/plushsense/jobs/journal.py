"""Jobs, and a journal that stores their results on disk, so that a finished job is not computed again.

A job's id is a hash of all that its result depends on, so that a changed setting makes another job. Files are replaced
atomically: a run that is killed leaves complete results or none.
"""

from __future__ import annotations

import errno
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

# Numeric libraries read these when they are loaded.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@dataclass(frozen=True)
class Job:
    """A job: its id in the journal, and the ``task`` argument of `JobWork`."""

    id: str
    task: Any


class JobWork(Protocol):
    """The function that computes jobs: a picklable callable, such as a module's function or a dataclass."""

    def __call__(self, shared: Any, task: Any, report: Report, /) -> Result:
        """Return the result of one job.

        ``report`` passes a message to ``on_report`` while the job runs.
        """
        ...


class JobEvent(NamedTuple):
    """An event of a job: it started (again), or sent a ``payload``: a message, a result or an exception."""

    job: Job
    kind: Literal["started", "report", "done", "failed"]
    payload: Any = None


# Returns the next job, or None if there are no more; called only when the job can start immediately.
Take = Callable[[], Job | None]
Engine = Iterator[JobEvent]


def thread_settings(threads: int) -> dict[str, str]:
    """Return the environment variables for a process that computes in ``threads`` threads."""
    return dict.fromkeys(_THREADS, str(threads))


def portable(error: Exception) -> Exception:
    """Make an exception picklable and add the traceback, which a `PlushSenseError` does not need."""
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
_NOT_WRITABLE = (errno.EROFS, errno.EACCES, errno.EPERM)


def job_id(job: Mapping[str, Any]) -> str:
    """Return the id of a job: a hash of its description as canonical JSON, 20 hexadecimal digits."""
    text = json.dumps(job, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@dataclass(frozen=True)
class Claim:
    """A lock on a job for the process that runs it; it is released with the process at the latest."""

    _lock: BaseFileLock | None

    def release(self) -> None:
        if self._lock is not None:
            # A process that already opened this file will find the result in the journal before it starts the job.
            with suppress(OSError):
                Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release()


class Journal:
    """A folder of results, created with the first one; it may be deleted at any time.

    Args:
        writing: returns the context manager for writing files, which raises PlushSenseError on entry if writing is no
            longer allowed. It is pickled with the journal.
    """

    def __init__(self, folder: str | Path, writing: Callable[[], AbstractContextManager[object]] = nullcontext) -> None:
        self.folder = Path(folder)
        self._writing = writing

    def __repr__(self) -> str:
        return f"Journal({str(self.folder)!r})"

    def path(self, job: str) -> Path:
        """Return the path of a job's result."""
        return self.folder / f"{job}.npz"

    def has(self, job: str) -> bool:
        """Return whether the job is done: its file exists and is complete."""
        return self.find(job) is not None

    def load(self, job: str) -> dict[str, Any]:
        """Return the result of a job; raise KeyError if it is not done."""
        result = self.find(job)
        if result is None:
            raise KeyError(job)
        return result

    def find(self, job: str) -> dict[str, Any] | None:
        """Return the result of a job; None when there is none or its file is damaged (then the job is not done)."""
        try:
            with np.load(self.path(job), allow_pickle=False) as file:
                result = {name: file[name] for name in file.files}
            values = json.loads(result.pop(_JSON).tobytes())
        # A damaged file raises any of these, depending on the position; zipfile checks a CRC of each member.
        except (OSError, EOFError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile):
            return None
        return result | values if isinstance(values, dict) else None

    def claim(self, job: str) -> Claim | None:
        """Lock a job for this process; return None if another process has locked it.

        On a file system without locks, every process can claim it.

        Raises:
            PlushSenseError: if writing is no longer allowed, so that the result could not be saved.
        """
        lock = FileLock(self._lock_path(job), timeout=0, thread_local=False)
        try:
            with self._writing():
                self.folder.mkdir(parents=True, exist_ok=True)
                lock.acquire()
        except Timeout:
            return None
        except (OSError, NotImplementedError):
            return Claim(None)
        return Claim(lock)

    def delete_lock(self, job: str) -> None:
        """Delete the lock of a job that is done: a process that was killed after it had saved the result left it."""
        with suppress(OSError):
            self._lock_path(job).unlink(missing_ok=True)

    def _lock_path(self, job: str) -> Path:
        return self.folder / f".{job}.lock"

    def save(self, job: str, result: Result) -> None:
        """Save the result of a job atomically. Values other than arrays must be JSON-serialisable.

        A folder that cannot be written, as on a read-only disk, stores nothing: what is interrupted begins again.

        Raises:
            PlushSenseError: if the disk is full or fails, or writing is no longer allowed.
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
            # Windows does not replace a file that is open, but then the result exists already.
            if cause.errno not in _NOT_WRITABLE and self.find(job) is None:
                raise PlushSenseError(
                    f"A result cannot be kept in {self.folder} ({cause.strerror or cause}): make room or the folder "
                    "writable, then run again; finished jobs are kept."
                ) from cause

    def prune(self, older_s: float) -> None:
        """Delete results, and files left by killed processes, that are older than ``older_s`` seconds."""
        with suppress(OSError):
            for path in [*self.folder.glob("*.npz"), *self.folder.glob(f".*{PART}")]:
                with suppress(OSError):
                    if time.time() - path.stat().st_mtime > older_s:
                        path.unlink()

    def discard(self, job: str) -> None:
        """Delete the result of a job, if there is one; on Windows, not while a process reads it."""
        with suppress(OSError):
            self.path(job).unlink()


# Folders of journals in a data set's cache: finished trainings, and states of unfinished ones.
JOURNAL, UNFINISHED = "sweeps", "unfinished"


def keep_if_possible(journal: Journal, job: str, state: Result) -> None:
    """Save the state of a training; ignore errors such as a full disk, which only cost time later.

    Raises:
        ForgottenError: if one of its people was removed from the data set.
    """
    try:
        journal.save(job, state)
    except ForgottenError:
        raise
    except PlushSenseError:
        pass
