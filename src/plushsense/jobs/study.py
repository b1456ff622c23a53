"""Run a study: the same work on each of its folds or trials, and one summary of all results.

Only this module gives the parts of a study their ids in the journal, starts them in processes or on a cluster, and
reports their progress. An experiment is a module that makes the parts, the work and the summary, and calls `run_study`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from plushsense.jobs.journal import JobWork, Result, job_id
from plushsense.jobs.pool import Job, JobCallbacks, JobsSpec, run_jobs
from plushsense.jobs.progress import JobInfo, JobProgress, JobsReporter

Progress = Callable[[JobProgress], None]
MakeReporter = Callable[[Mapping[str, JobInfo]], JobsReporter]
S = TypeVar("S")


@dataclass(frozen=True)
class StudyPart:
    """A fold or trial of a study.

    Attributes:
        name: what progress shows.
        key: JSON values that distinguish this part's result from those of other parts.
        task: the second argument of the work.
        cost: in any unit that all parts share.
    """

    name: str
    key: Mapping[str, Any]
    task: Any
    cost: float = 1.0


@dataclass(frozen=True)
class StudyResults:
    """The parts that are done, with their results, in the order of the study.

    ``resumed`` is the number of results that the journal held already.
    """

    done: tuple[tuple[StudyPart, Result], ...]
    resumed: int

    @property
    def results(self) -> list[Result]:
        """The results without their parts."""
        return [result for _, result in self.done]


def run_study(
    parts: Sequence[StudyPart],
    work: JobWork,
    summary: Callable[[StudyResults], S],
    *,
    key: Mapping[str, Any],
    shared: Any = None,
    spec: JobsSpec | None = None,
    progress: Progress | None = None,
    reporter: MakeReporter | None = None,
) -> S:
    """Do the work of every part whose result is not in the journal yet, and return the summary of all results.

    Args:
        work: called as ``work(shared, part.task, report)``; its reports begin with (epoch, epochs).
        summary: called once with all results.
        key: JSON values on which every result depends: version, data, settings.
        spec: processes or cluster, and the journal; by default this process and no journal.
        progress: called when a part reports or is done.
        reporter: makes the reporter from the name and cost of each part by its id, instead of ``progress``. Parts that
            fail are then given to its ``on_failed``, and the others continue.

    Raises:
        PlushSenseError: what the work or `run_jobs` raises. Finished parts are kept in the journal.
    """
    ids = [job_id({**key, **part.key}) for part in parts]
    follower = (reporter or partial(JobsReporter, progress=progress))(
        {job: JobInfo(part.name, part.cost) for job, part in zip(ids, parts, strict=True)}
    )
    found = run_jobs(
        [Job(job, part.task) for job, part in dict(zip(ids, parts, strict=True)).items()],
        work,
        shared=shared,
        spec=spec,
        callbacks=JobCallbacks(
            follower.on_start, follower.on_report, follower.on_done, follower.on_failed if reporter else None
        ),
    )
    done = tuple((part, found[job]) for job, part in zip(ids, parts, strict=True) if job in found)
    return summary(StudyResults(done, len(follower.state.resumed)))
