"""Run jobs in several processes of this machine, which are spawned on every operating system.

A worker saves its result in the journal before it reports it, so that a run killed at any moment can be continued. If
the parent process ends, a worker ends at its next message. A worker that dies is replaced, and its job started again.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.jobs.journal import (
    Claim,
    Engine,
    Job,
    JobEvent,
    JobWork,
    Journal,
    Report,
    Result,
    Take,
    portable,
    thread_settings,
)

__all__ = ["Job", "JobCallbacks", "JobWork", "JobsSpec", "Report", "run_jobs"]

# Number of times that a job is started in all if its worker dies.
_TRIES = 2


@dataclass(frozen=True)
class JobsSpec:
    """Where jobs run, and where their results are stored.

    Attributes:
        workers: number of processes; 1 runs the jobs in this process. A cluster uses all of its processors instead.
        threads: number of threads of each process; has no effect on this one (``workers=1``).
        journal: stores the results; jobs that are in it are not run.
        cluster: run the jobs as Ray tasks: "auto", "host:6379", "ray://host:10001", or "local" to start Ray here.
        gpus: number of graphics processors for each job of a cluster, which may be a fraction.
    """

    workers: int = 1
    threads: int = 1
    journal: Journal | None = None
    cluster: str | None = None
    gpus: float = 0.0

    def __post_init__(self) -> None:
        for name, number in (("workers", self.workers), ("threads", self.threads)):
            if number < 1:
                raise ConfigError(f"{number} {name} cannot do anything: give 1 or more.")


@dataclass(frozen=True)
class JobCallbacks:
    """Functions that `run_jobs` calls in the caller's thread.

    Attributes:
        on_start: called with each job that starts; twice if its process or node was lost.
        on_report: called with (job, message of its work); a cluster may leave out messages.
        on_done: called with (job, result, whether it came from the journal), in the order of completion.
        on_failed: called with (job, its exception), and the other jobs continue; the job is in neither the journal nor
            the returned results. By default the first failure ends the run.
    """

    on_start: Callable[[Job], None] | None = None
    on_report: Callable[[Job, Any], None] | None = None
    on_done: Callable[[Job, Result, bool], None] | None = None
    on_failed: Callable[[Job, Exception], None] | None = None


def run_jobs(
    jobs: Sequence[Job],
    work: JobWork,
    *,
    shared: Any = None,
    spec: JobsSpec | None = None,
    callbacks: JobCallbacks | None = None,
) -> dict[str, Result]:
    """Run all jobs whose results are not in the journal yet.

    Args:
        work: called as ``work(shared, task, report)`` for each job; picklable unless it runs in this process.
        shared: passed to every job, and sent to each process once. A job must not change it.

    Returns:
        the result of each job by its id.

    Raises:
        PlushSenseError: an exception of the work; a process that died twice at the same job; a result that cannot be
            saved; a cluster that does not answer. Finished jobs are kept.
        KeyboardInterrupt: on Ctrl-C, after the workers have ended. Finished jobs are kept.
    """
    spec, on = spec or JobsSpec(), callbacks or JobCallbacks()
    results: dict[str, Result] = {}

    def done(job: Job, result: Result, resumed: bool) -> None:
        results[job.id] = result
        if on.on_done is not None:
            on.on_done(job, result, resumed)

    with ExitStack() as stack:
        left = _Left(jobs, spec.journal, done, stack)
        if not left.jobs:
            return results
        saved = spec.cluster is None and spec.workers > 1
        # Close the engine explicitly, which ends its processes.
        with closing(_engine(left, work, shared, spec, on)) as engine:  # type: ignore[type-var]
            for job, kind, payload in engine:
                if kind == "started" and on.on_start is not None:
                    on.on_start(job)
                elif kind == "report" and on.on_report is not None:
                    on.on_report(job, payload)
                elif kind == "done":
                    if spec.journal is not None and not saved:
                        spec.journal.save(job.id, payload)
                    left.release(job)
                    done(job, payload, False)
                elif kind == "failed":
                    left.release(job)
                    if on.on_failed is None:
                        raise payload
                    on.on_failed(job, payload)
    return results


def _engine(left: _Left, work: JobWork, shared: Any, spec: JobsSpec, on: JobCallbacks) -> Engine:
    """Return the iterator that runs the jobs, in this process, in several, or on a cluster, and yields their events."""
    if spec.cluster is not None:
        from plushsense.jobs.cluster import on_cluster

        return on_cluster(left.take, (work, shared), spec.cluster, threads=spec.threads, gpus=spec.gpus)
    if spec.workers == 1:
        return _here(left.take, work, shared, on.on_report)
    # Use a process even for a single job, as its result may depend on the number of threads.
    setup = pickle.dumps((work, shared, spec.journal))
    return in_processes(left.take, setup, min(spec.workers, len(left.jobs)), spec.threads)


def _here(take: Take, work: JobWork, shared: Any, on_report: Callable[[Job, Any], None] | None) -> Engine:
    """Run the jobs in this process, one after the other."""

    def report(job: Job, message: Any) -> None:
        if on_report is not None:
            on_report(job, message)

    while (job := take()) is not None:
        yield JobEvent(job, "started")
        try:
            result = work(shared, job.task, partial(report, job))
        except Exception as error:  # noqa: BLE001, RUF100
            yield JobEvent(job, "failed", error)
        else:
            yield JobEvent(job, "done", result)


class _Left:
    """The jobs that have not been started, and the journal's claims on those that have."""

    def __init__(
        self,
        jobs: Sequence[Job],
        journal: Journal | None,
        done: Callable[[Job, Result, bool], None],
        stack: ExitStack,
    ) -> None:
        self.jobs: deque[Job] = deque()
        self._journal = journal
        self._done = done
        self._claims: dict[str, Claim] = {}
        stack.callback(self._release_all)
        for job in jobs:
            if not self._found(job):
                self.jobs.append(job)

    def take(self) -> Job | None:
        """Return the next job that is neither done nor claimed; if there is none, one that another process claimed."""
        elsewhere: deque[Job] = deque()
        try:
            while self.jobs:
                job = self.jobs.popleft()
                claim = None if self._journal is None else self._journal.claim(job.id)
                if self._journal is not None and claim is None:
                    elsewhere.append(job)
                    continue
                # Check again after the claim, as another process may have finished the job.
                if self._found(job):
                    if claim is not None:
                        claim.release()
                    continue
                if claim is not None:
                    self._claims[job.id] = claim
                return job
            while elsewhere:
                job = elsewhere.popleft()
                # Run the job here too instead of waiting: the other process may be slow or stop.
                if not self._found(job):
                    return job
            return None
        finally:
            self.jobs.extendleft(reversed(elsewhere))

    def release(self, job: Job) -> None:
        claim = self._claims.pop(job.id, None)
        if claim is not None:
            claim.release()

    def _found(self, job: Job) -> bool:
        if self._journal is None or (kept := self._journal.find(job.id)) is None:
            return False
        self._journal.delete_lock(job.id)
        self._done(job, kept, True)
        return True

    def _release_all(self) -> None:
        while self._claims:
            self._claims.popitem()[1].release()


@dataclass
class _Worker:
    """A process, the pipe to it, and its current job; ``ready`` after it has received the shared data."""

    process: BaseProcess
    pipe: Connection
    job: Job | None = None
    ready: bool = False


def in_processes(take: Take, setup: bytes, workers: int, threads: int) -> Engine:
    """Run the jobs that ``take`` returns in ``workers`` processes, each with ``threads`` threads.

    Args:
        setup: the pickled (work, shared, journal or None).

    Raises:
        PlushSenseError: when a worker dies before its first job, or a result cannot be saved.
    """
    pool: list[_Worker] = []
    try:
        for _ in range(workers):
            pool.append(_start(threads))
        for worker in pool:
            _send(worker, setup)
        yield from _conduct(pool, take, setup, threads)
        for worker in pool:
            _send(worker, None)
            worker.process.join(5)
    finally:
        for worker in pool:
            if worker.process.is_alive():
                worker.process.kill()
            worker.process.join()
            worker.pipe.close()


def _start(threads: int) -> _Worker:
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    process = spawn.Process(target=_serve, args=(there,), daemon=True)
    with _inherited(threads):
        process.start()
    # Close this process's copy of the worker's end, so that reading fails once the worker has ended.
    there.close()
    return _Worker(process, here)


@contextmanager
def _inherited(threads: int) -> Iterator[None]:
    """Make Python processes that are started in this context use ``threads`` threads and ignore Ctrl-C.

    They import nothing from the working folder, which may be a data set of somebody else.
    """
    settings = {**thread_settings(threads), "PYTHONSAFEPATH": "1"}
    before = {name: os.environ.get(name) for name in settings}
    # Only the main thread may set a signal's handler.
    ours = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if ours else None
    os.environ.update(settings)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
        if ours:
            signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)


def _conduct(pool: list[_Worker], take: Take, setup: bytes, threads: int) -> Engine:
    """Send jobs to the workers and yield their messages, until no job is left and no worker is busy."""
    again: list[Job] = []
    tries: Counter[str] = Counter()
    finished = False
    while True:
        for worker in pool:
            if worker.ready and worker.job is None and not (finished and not again):
                worker.job = again.pop() if again else take()
                if worker.job is None:
                    finished = True
                else:
                    tries[worker.job.id] += 1
                    _send(worker, (worker.job.id, worker.job.task))
                    yield JobEvent(worker.job, "started")
        busy = {worker.pipe: worker for worker in pool if worker.job is not None or not worker.ready}
        if finished and not again and all(worker.job is None for worker in busy.values()):
            return
        for pipe in connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            job = worker.job
            try:
                kind, message = worker.pipe.recv()
            except (EOFError, OSError):
                worker.process.join(5)
                code = worker.process.exitcode
                if job is None or not worker.ready:
                    raise PlushSenseError(
                        f"A worker process ended unexpectedly while it started (exit code {code}). In a script of your "
                        "own, put the code under  if __name__ == '__main__':  or use workers=1. Otherwise, it may lack "
                        "memory: run again, finished jobs are kept; try fewer workers."
                    ) from None
                worker.pipe.close()
                # Put the new worker into the pool, so that it is ended with the others.
                pool[pool.index(worker)] = replaced = _start(threads)
                _send(replaced, setup)
                if tries[job.id] < _TRIES:
                    again.append(job)
                else:
                    given_up = PlushSenseError(
                        f"This job was given up: the worker process at it ended unexpectedly {_TRIES} times (exit code "
                        f"{code}), perhaps for lack of memory: run again, finished jobs are kept; try fewer workers."
                    )
                    yield JobEvent(job, "failed", given_up)
                continue
            if kind == "ready":
                worker.ready = True
            elif kind == "lost":
                raise message
            else:
                assert job is not None
                if kind != "report":
                    worker.job = None
                yield JobEvent(job, kind, message)


def _send(worker: _Worker, message: Any) -> None:
    # If the worker has ended, the next read from the pipe fails and handles that.
    with suppress(OSError):
        worker.pipe.send(message)


def _serve(pipe: Connection) -> None:
    """Run jobs in a worker process until None is received or the parent ends."""
    # Ctrl-C reaches every process of the terminal; the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    journal: Journal | None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            work, shared, journal = pickle.loads(pipe.recv())
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
        except Exception as error:  # noqa: BLE001, RUF100
            pipe.send(("lost", portable(error)))
            return
        pipe.send(("ready", None))
        while (message := pipe.recv()) is not None:
            job, task = message
            try:
                result = work(shared, task, lambda message: pipe.send(("report", message)))
            except (EOFError, BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:  # noqa: BLE001, RUF100
                pipe.send(("failed", portable(error)))
                continue
            try:
                if journal is not None:
                    journal.save(job, result)
            except Exception as error:  # noqa: BLE001, RUF100
                pipe.send(("lost", portable(error)))
                return
            pipe.send(("done", result))
