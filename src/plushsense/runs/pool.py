"""Many jobs, whatever they are: in this process, in several, or on a cluster. Each result is kept once it is done.

A job is looked for in the journal before anything begins and again before it is handed out, and one that another run
on the same journal is at comes last: two runs at a time share the work.
"""

from __future__ import annotations

import pickle
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.runs.jobs import Engine, Event, Job, Report, Take, Work
from plushsense.runs.journal import Claim, Journal, Result
from plushsense.runs.processes import in_processes

__all__ = ["Job", "Report", "Work", "run_jobs"]


def run_jobs(
    jobs: Sequence[Job],
    work: Work,
    *,
    shared: Any = None,
    workers: int = 1,
    threads: int = 1,
    journal: Journal | None = None,
    cluster: str | None = None,
    gpus: float = 0.0,
    on_start: Callable[[Job], None] | None = None,
    on_report: Callable[[Job, Any], None] | None = None,
    on_done: Callable[[Job, Result, bool], None] | None = None,
    on_failed: Callable[[Job, Exception], None] | None = None,
) -> dict[str, Result]:
    """Do every job that the journal does not hold yet. Every callback is called here, in the caller's thread.

    Args:
        shared: given to every job, and sent to each process once. A job must leave it as it is.
        workers: processes at a time; 1 works in this one. A cluster does as many as its processors hold.
        threads: that each process computes on; has no effect on this one (``workers=1``).
        cluster: do the jobs as Ray tasks there: "auto", "host:6379", "ray://host:10001", or "local" to start Ray here.
        gpus: of a cluster, the share of a graphics processor that each job takes.
        on_start: called with the job when it is begun; twice for one whose process or node was lost.
        on_report: called with (job, what its work reported); on a cluster some reports may be left out.
        on_done: called with (job, result, whether it came from the journal), in the order of completion.
        on_failed: called with (job, the exception that it raised); the other jobs go on, and this one is in neither
            the journal nor the answer. Without it the first failure ends the run.

    Returns:
        the result of each job by its id.

    Raises:
        PlushSenseError: what the work raised, as itself; or a process that died twice at the same job; a result that
            cannot be kept; a cluster that does not answer. Finished jobs are kept.
        KeyboardInterrupt: on Ctrl-C, after the workers have been ended. Finished jobs are kept.
    """
    if workers < 1:
        raise ConfigError(f"{workers} workers cannot do anything: give 1 or more.")
    if threads < 1:
        raise ConfigError(f"{threads} threads cannot do anything: give 1 or more.")
    results: dict[str, Result] = {}

    def done(job: Job, result: Result, resumed: bool) -> None:
        results[job.id] = result
        if on_done is not None:
            on_done(job, result, resumed)

    with ExitStack() as stack:
        left = _Left(jobs, journal, done, stack)
        engine: Engine
        if not left.jobs:
            return results
        if cluster is not None:
            from plushsense.runs.cluster import on_cluster

            engine = on_cluster(left.take, (work, shared), cluster, threads=threads, gpus=gpus)
        elif workers == 1:
            engine = _here(left.take, work, shared, on_report)
        else:
            # Also for a single job: what it computes may depend on the threads of its process.
            setup = pickle.dumps((work, shared, journal))
            engine = in_processes(left.take, setup, min(workers, len(left.jobs)), threads)
        saved = cluster is None and workers > 1
        # Closed at once, not when it is collected: an engine ends its processes.
        with closing(engine):  # type: ignore[type-var]
            for job, kind, what in engine:
                if kind == "started" and on_start is not None:
                    on_start(job)
                elif kind == "report" and on_report is not None:
                    on_report(job, what)
                elif kind == "done":
                    if journal is not None and not saved:
                        journal.save(job.id, what)
                    left.release(job)
                    done(job, what, False)
                elif kind == "failed":
                    left.release(job)
                    if on_failed is None:
                        raise what
                    on_failed(job, what)
    return results


def _here(take: Take, work: Work, shared: Any, on_report: Callable[[Job, Any], None] | None) -> Engine:
    """The jobs in this process, one after the other."""

    def told(job: Job, message: Any) -> None:
        if on_report is not None:
            on_report(job, message)

    while (job := take()) is not None:
        yield Event(job, "started")
        try:
            result = work(shared, job.task, partial(told, job))
        except Exception as error:  # noqa: BLE001 - the caller decides whether it ends the run
            yield Event(job, "failed", error)
        else:
            yield Event(job, "done", result)


class _Left:
    """The jobs still to be handed out, and the claims on those that are."""

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
        """The next job that nobody has done or is at; when another run is at all that are left, one of these."""
        elsewhere: deque[Job] = deque()
        try:
            while self.jobs:
                job = self.jobs.popleft()
                claim = None if self._journal is None else self._journal.claim(job.id)
                if self._journal is not None and claim is None:
                    elsewhere.append(job)
                    continue
                # Looked for after it was claimed: whoever had the claim before us may have done it.
                if self._found(job):
                    if claim is not None:
                        claim.release()
                    continue
                if claim is not None:
                    self._claims[job.id] = claim
                return job
            while elsewhere:
                job = elsewhere.popleft()
                # Not waited for: the other run may take long, may stop, and the result is the same.
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
        kept = None if self._journal is None else self._journal.find(job.id)
        if kept is None:
            return False
        self._done(job, kept, True)
        return True

    def _release_all(self) -> None:
        while self._claims:
            self._claims.popitem()[1].release()
