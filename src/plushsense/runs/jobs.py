"""What a job is, what works on it, and what an engine (processes, a cluster) tells on the way."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from plushsense.core.errors import PlushSenseError
from plushsense.runs.journal import Result

Report = Callable[[Any], None]

# Read by the numeric libraries when they are loaded.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@dataclass(frozen=True)
class Job:
    """One job: its id in the journal, and what the work is given."""

    id: str
    task: Any


class Work(Protocol):
    """What is done for each job; a picklable callable (a function of a module, a dataclass with ``__call__``)."""

    def __call__(self, shared: Any, task: Any, report: Report, /) -> Result:
        """The result of one job. ``report`` may be given anything on the way; it reaches ``on_report``."""
        ...


class Event(NamedTuple):
    """What an engine tells of a job: it began (again), it said something, its result, or what it ended with."""

    job: Job
    kind: Literal["started", "report", "done", "failed"]
    what: Any = None


# Gives the next job that is still to be done, None when there is no more; asked only when it can begin at once.
Take = Callable[[], Job | None]
Engine = Iterator[Event]


def thread_settings(threads: int) -> dict[str, str]:
    """The environment of a process that computes on so many threads."""
    return dict.fromkeys(_THREADS, str(threads))


def portable(error: Exception) -> Exception:
    """The exception itself where it can be pickled, with this process's traceback as a note if it is no refusal."""
    told = traceback.format_exc()
    if not isinstance(error, PlushSenseError):
        error.add_note(f"In a worker process:\n{told}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - an exception class may refuse in any way
        return RuntimeError(f"A job failed in a worker process:\n{told}")
    return error
