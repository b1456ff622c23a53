"""Many jobs in several processes, whatever they are. Each result is kept the moment its job is done.

With one worker the jobs run in this process, one after the other. With more, processes are started fresh (the same
on every system) and each computes on one thread. A worker keeps its result in the journal itself, before it tells
anybody, so that a run killed at any moment goes on from there. A worker whose starter is gone ends at its next word.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.runs.journal import Journal, Result

Report = Callable[[Any], None]

# Read by the numeric libraries when they are loaded: one process, one thread.
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


def run_jobs(
    jobs: Sequence[Job],
    work: Work,
    *,
    shared: Any = None,
    workers: int = 1,
    journal: Journal | None = None,
    on_done: Callable[[Job, Result, bool], None] | None = None,
    on_report: Callable[[Job, Any], None] | None = None,
) -> dict[str, Result]:
    """Do every job that the journal does not hold yet.

    Args:
        shared: given to every job, and sent to each process once.
        workers: processes at a time; 1 works in this one.
        on_done: called here with (job, result, whether it came from the journal), in the order of completion.
        on_report: called here with (job, what its work reported).

    Returns:
        the result of each job by its id.

    Raises:
        PlushSenseError: what the work raised, as itself; or a worker that died. Finished jobs are kept.
        KeyboardInterrupt: on Ctrl-C, after the workers have been ended. Finished jobs are kept.
    """
    if workers < 1:
        raise ConfigError(f"{workers} workers cannot do anything: give 1 or more.")
    results: dict[str, Result] = {}

    def done(job: Job, result: Result, resumed: bool) -> None:
        results[job.id] = result
        if on_done is not None:
            on_done(job, result, resumed)

    def reported(job: Job, message: Any) -> None:
        if on_report is not None:
            on_report(job, message)

    left = []
    for job in jobs:
        kept = None if journal is None else journal.find(job.id)
        if kept is None:
            left.append(job)
        else:
            done(job, kept, True)
    if workers == 1 or len(left) < 2:
        for job in left:
            result = work(shared, job.task, partial(reported, job))
            if journal is not None:
                journal.save(job.id, result)
            done(job, result, False)
    else:
        with _crew(min(workers, len(left)), pickle.dumps((work, shared, journal))) as crew:
            for job, kind, message in _conduct(crew, left):
                if kind == "done":
                    done(job, message, False)
                else:
                    reported(job, message)
    return results


@dataclass
class _Worker:
    """One process, the pipe to it, and the job it is at."""

    process: BaseProcess
    pipe: Connection
    job: Job | None = field(default=None)


@contextmanager
def _crew(workers: int, setup: bytes) -> Iterator[list[_Worker]]:
    """Started processes, ended again in any case."""
    spawn = multiprocessing.get_context("spawn")
    crew: list[_Worker] = []
    try:
        for _ in range(workers):
            here, there = spawn.Pipe()
            process = spawn.Process(target=_serve, args=(there,), daemon=True)
            with _inherited():
                process.start()
            # Only the worker may hold its end: then each side sees the other one go.
            there.close()
            crew.append(_Worker(process, here))
        for worker in crew:
            _send(worker, setup)
        yield crew
        for worker in crew:
            worker.pipe.send(None)
            worker.process.join(5)
    finally:
        for worker in crew:
            if worker.process.is_alive():
                worker.process.kill()
            worker.process.join()
            worker.pipe.close()


@contextmanager
def _inherited() -> Iterator[None]:
    """What a process that is started now takes over: one thread, and no ear for Ctrl-C while it loads."""
    before = {name: os.environ.get(name) for name in _THREADS}
    # Only the main thread may set a signal's handler.
    ours = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if ours else None
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        if ours:
            signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)


def _conduct(crew: list[_Worker], jobs: Sequence[Job]) -> Iterator[tuple[Job, str, Any]]:
    """Hand out the jobs and pass on what comes back: (job, "done" or "report", what)."""
    waiting = list(reversed(jobs))
    for worker in crew:
        worker.job = waiting.pop()
        _send(worker, (worker.job.id, worker.job.task))
    while busy := {worker.pipe: worker for worker in crew if worker.job is not None}:
        for pipe in connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            job = worker.job
            assert job is not None
            try:
                kind, message = worker.pipe.recv()
            except (EOFError, OSError):
                raise _gone(worker) from None
            if kind == "failed":
                raise message
            if kind == "done":
                worker.job = waiting.pop() if waiting else None
                if worker.job is not None:
                    _send(worker, (worker.job.id, worker.job.task))
            yield job, kind, message


def _send(worker: _Worker, message: Any) -> None:
    try:
        worker.pipe.send(message)
    except OSError:
        raise _gone(worker) from None


def _gone(worker: _Worker) -> PlushSenseError:
    worker.process.join(5)
    return PlushSenseError(
        f"A worker process ended unexpectedly (exit code {worker.process.exitcode}), perhaps for lack of memory: "
        "run again, finished jobs are kept; try fewer workers. In a script of your own, more than one worker needs "
        "the code under  if __name__ == '__main__':"
    )


def _serve(pipe: Connection) -> None:
    """A worker's life: one job after the other, until it is sent None or the other side is gone."""
    # Ctrl-C reaches every process of the terminal: the one that started us decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        work, shared, journal = pickle.loads(pipe.recv())
        while (message := pipe.recv()) is not None:
            job, task = message
            result = work(shared, task, lambda said: pipe.send(("report", said)))
            if journal is not None:
                journal.save(job, result)
            pipe.send(("done", result))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:  # noqa: BLE001 - whatever it is, it is raised again where the jobs came from
        _confess(pipe, error)


def _confess(pipe: Connection, error: Exception) -> None:
    """Send an exception over, itself where it can be pickled, with this process's traceback as a note."""
    told = traceback.format_exc()
    if not isinstance(error, PlushSenseError):
        error.add_note(f"In a worker process:\n{told}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - an exception class may refuse in any way
        error = RuntimeError(f"A job failed in a worker process:\n{told}")
    pipe.send(("failed", error))
