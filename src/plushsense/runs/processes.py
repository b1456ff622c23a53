"""Jobs in several processes of this machine, each started fresh (the same on every system).

A worker keeps its result in the journal itself, before it tells anybody, so that a run killed at any moment goes on
from there. A worker whose starter is gone ends at its next word. One that dies is replaced and its job done again once.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from plushsense.core.errors import PlushSenseError
from plushsense.runs.jobs import Engine, Event, Job, Take, portable, thread_settings
from plushsense.runs.journal import Journal

# How often a job whose worker died is begun, in all.
_TRIES = 2


@dataclass
class _Worker:
    """One process, the pipe to it, and the job it is at; it is ready once it has read what all jobs share."""

    process: BaseProcess
    pipe: Connection
    job: Job | None = None
    ready: bool = False


def in_processes(take: Take, setup: bytes, workers: int, threads: int) -> Engine:
    """Do the jobs that ``take`` gives in so many processes, each on so many threads.

    Args:
        setup: the pickled (work, shared, journal or None).

    Raises:
        PlushSenseError: a worker that dies before it can begin, or a result that cannot be kept.
    """
    crew: list[_Worker] = []
    try:
        for _ in range(workers):
            crew.append(_start(threads))
        for worker in crew:
            _send(worker, setup)
        yield from _conduct(crew, take, setup, threads)
        for worker in crew:
            _send(worker, None)
            worker.process.join(5)
    finally:
        for worker in crew:
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
    # Only the worker may hold its end: then each side sees the other one go.
    there.close()
    return _Worker(process, here)


@contextmanager
def _inherited(threads: int) -> Iterator[None]:
    """What a process that is started now takes over: its threads, and no ear for Ctrl-C while it loads."""
    settings = thread_settings(threads)
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


def _conduct(crew: list[_Worker], take: Take, setup: bytes, threads: int) -> Engine:
    """Hand out the jobs and pass on what comes back, until nothing is left and nobody is busy."""
    again: list[Job] = []
    tries: Counter[str] = Counter()
    finished = False
    while True:
        for worker in crew:
            if worker.ready and worker.job is None and not (finished and not again):
                worker.job = again.pop() if again else take()
                if worker.job is None:
                    finished = True
                else:
                    tries[worker.job.id] += 1
                    _send(worker, (worker.job.id, worker.job.task))
                    yield Event(worker.job, "started")
        busy = {worker.pipe: worker for worker in crew if worker.job is not None or not worker.ready}
        if finished and not again and all(worker.job is None for worker in busy.values()):
            return
        for pipe in connection.wait(list(busy)):
            worker = busy[pipe]  # type: ignore[index]
            job = worker.job
            try:
                kind, message = worker.pipe.recv()
            except (EOFError, OSError):
                worker.process.join(5)
                if job is None or not worker.ready:
                    raise _stillborn(worker.process.exitcode) from None
                worker.pipe.close()
                # In the same place, so that whoever ends the crew ends this one too.
                crew[crew.index(worker)] = replaced = _start(threads)
                _send(replaced, setup)
                if tries[job.id] < _TRIES:
                    again.append(job)
                else:
                    yield Event(job, "failed", _gone(worker.process.exitcode))
                continue
            if kind == "ready":
                worker.ready = True
            elif kind == "lost":
                raise message
            else:
                assert job is not None
                if kind != "report":
                    worker.job = None
                yield Event(job, kind, message)


def _send(worker: _Worker, message: Any) -> None:
    # That a worker is gone is heard at its pipe's other direction.
    with suppress(OSError):
        worker.pipe.send(message)


def _stillborn(code: int | None) -> PlushSenseError:
    return PlushSenseError(
        f"A worker process ended unexpectedly while it started (exit code {code}), perhaps for lack of memory: "
        "run again, finished jobs are kept; try fewer workers. In a script of your own, more than one worker needs "
        "the code under  if __name__ == '__main__':"
    )


def _gone(code: int | None) -> PlushSenseError:
    return PlushSenseError(
        f"This job was given up: the worker process at it ended unexpectedly {_TRIES} times (exit code {code}), "
        "perhaps for lack of memory: run again, finished jobs are kept; try fewer workers."
    )


def _serve(pipe: Connection) -> None:
    """A worker's life: one job after the other, until it is sent None or the other side is gone."""
    # Ctrl-C reaches every process of the terminal: the one that started us decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    journal: Journal | None
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        try:
            work, shared, journal = pickle.loads(pipe.recv())
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return
        except Exception as error:  # noqa: BLE001 - whatever it is, it is raised again where the jobs came from
            pipe.send(("lost", portable(error)))
            return
        pipe.send(("ready", None))
        while (message := pipe.recv()) is not None:
            job, task = message
            try:
                result = work(shared, task, lambda said: pipe.send(("report", said)))
            except (EOFError, BrokenPipeError, ConnectionResetError):
                raise
            except Exception as error:  # noqa: BLE001 - as above
                pipe.send(("failed", portable(error)))
                continue
            try:
                if journal is not None:
                    journal.save(job, result)
            except Exception as error:  # noqa: BLE001 - as above
                pipe.send(("lost", portable(error)))
                return
            pipe.send(("done", result))
