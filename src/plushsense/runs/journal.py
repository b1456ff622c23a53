"""Results of jobs on disk, one file a job: what is there need not be done again.

A job is known by the hash of what it depends on, so that a changed setting is another job. A file is written
beside and moved into place: a run that is killed leaves whole results or none.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import time
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import BaseFileLock, FileLock, Timeout

from plushsense.core.errors import PlushSenseError

# A result: arrays, and values that JSON can hold.
Result = Mapping[str, Any]

_JSON = "json"


def job_id(job: Mapping[str, Any]) -> str:
    """The id of a job: a hash of its description as canonical JSON, 20 hexadecimal digits."""
    text = json.dumps(job, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


@dataclass(frozen=True)
class Claim:
    """A run's word that it is at a job. It ends with the process at the latest, however that ends."""

    _lock: BaseFileLock | None

    def release(self) -> None:
        if self._lock is not None:
            # Whoever opened the file before it went looks in the journal before it begins.
            with suppress(OSError):
                Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock.release()


class Journal:
    """A folder of results. It is made with the first result; deleting it forgets them all."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def __repr__(self) -> str:
        return f"Journal({str(self.folder)!r})"

    def path(self, job: str) -> Path:
        """The file of a job."""
        return self.folder / f"{job}.npz"

    def has(self, job: str) -> bool:
        """Whether the job is done: its file is there and whole."""
        return self.find(job) is not None

    def load(self, job: str) -> dict[str, Any]:
        """The result of a job that is done; KeyError for one that is not."""
        found = self.find(job)
        if found is None:
            raise KeyError(job)
        return found

    def find(self, job: str) -> dict[str, Any] | None:
        """The result of a job; None when there is none or its file is damaged (then the job is not done)."""
        try:
            with np.load(self.path(job), allow_pickle=False) as file:
                result = {name: file[name] for name in file.files}
            values = json.loads(result.pop(_JSON).tobytes())
        # zipfile checks a CRC of every member; what a damaged header raises depends on the byte.
        except (OSError, EOFError, KeyError, ValueError, NotImplementedError, zipfile.BadZipFile):
            return None
        return result | values if isinstance(values, dict) else None

    def claim(self, job: str) -> Claim | None:
        """Say that this process is at the job; None when another one is. A file system without locks lets everybody."""
        lock = FileLock(self.folder / f".{job}.lock", timeout=0, thread_local=False)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock.acquire()
        except Timeout:
            return None
        except (OSError, NotImplementedError):
            return Claim(None)
        return Claim(lock)

    def save(self, job: str, result: Result) -> None:
        """Keep the result of a job, whole or not at all. Arrays stay arrays; all else must fit JSON.

        Raises:
            PlushSenseError: when the folder cannot be written to; TypeError, ValueError: for what cannot be kept.
        """
        arrays = {name: value for name, value in result.items() if isinstance(value, np.ndarray)}
        values = {name: value for name, value in result.items() if name not in arrays}
        packed = np.frombuffer(json.dumps(values).encode(), dtype=np.uint8)
        # Random, since processes of several machines may write here.
        part = self.folder / f".{job}.{secrets.token_hex(4)}.part"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                with part.open("wb") as file:
                    np.savez(file, allow_pickle=False, **{_JSON: packed}, **arrays)
                os.replace(part, self.path(job))
            finally:
                part.unlink(missing_ok=True)
        except OSError as cause:
            # Windows refuses to replace a file that is being read: then it is there already.
            if self.find(job) is None:
                raise PlushSenseError(
                    f"A result cannot be kept in {self.folder} ({cause.strerror or cause}): make room or the folder "
                    "writable, then run again; finished jobs are kept."
                ) from cause

    def prune(self, older_s: float) -> None:
        """Discard what nobody has touched for so many seconds, also unfinished writes of those that were killed."""
        with suppress(OSError):
            for path in [*self.folder.glob("*.npz"), *self.folder.glob(".*.part")]:
                with suppress(OSError):
                    if time.time() - path.stat().st_mtime > older_s:
                        path.unlink()

    def discard(self, job: str) -> None:
        """Forget the result of a job, if there is one and it lets itself be removed (Windows: nobody reads it)."""
        with suppress(OSError):
            self.path(job).unlink()
