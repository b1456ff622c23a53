"""A study: ids from what a result depends on, the parts in their order, progress, and parts that fail."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import work

from plushsense.core.errors import TrainingError
from plushsense.jobs.journal import Journal, job_id
from plushsense.jobs.pool import Job, JobsSpec
from plushsense.jobs.progress import JobInfo, JobProgress, JobsReporter
from plushsense.jobs.study import StudyPart, StudyResults, run_study

PARTS = [StudyPart(f"fold {n}", {"fold": n}, n) for n in (2, 0, 1)]


def everything(study: StudyResults) -> StudyResults:
    return study


@pytest.mark.parametrize("workers", [1, 2])
def test_parts_keep_their_order_and_are_resumed(tmp_path: Path, workers: int) -> None:
    journal = Journal(tmp_path)
    seen: list[JobProgress] = []

    def run(seed: int) -> StudyResults:
        spec = JobsSpec(workers, journal=journal)
        return run_study(
            PARTS, work.number, everything, key={"seed": seed}, shared=100, spec=spec, progress=seen.append
        )

    first = run(0)
    assert first.results == [{"value": 102}, {"value": 100}, {"value": 101}] and first.resumed == 0
    assert [part for part, _ in first.done] == PARTS
    assert {at.name for at in seen if at.epoch} == {part.name for part in PARTS}
    assert (seen[-1].done, seen[-1].total) == (3, 3)
    assert journal.has(job_id({"seed": 0, "fold": 2}))
    assert run(0) == StudyResults(first.done, resumed=3)
    assert run(1).resumed == 0
    total: int = run_study(PARTS, work.number, lambda s: sum(r["value"] for r in s.results), key={}, shared=0)
    assert total == 3


def test_a_part_that_fails_ends_the_study_or_is_given_to_the_reporter() -> None:
    class Counting(JobsReporter):
        def __init__(self, jobs: Mapping[str, JobInfo]) -> None:
            super().__init__(jobs)
            self.lost: list[str] = []

        def on_failed(self, job: Job, error: Exception) -> None:
            super().on_failed(job, error)
            self.lost.append(self.state.jobs[job.id].name)

    made: list[Counting] = []

    def reporter(jobs: Mapping[str, JobInfo]) -> Counting:
        made.append(Counting(jobs))
        return made[0]

    study: Any = run_study(PARTS, work.diverge, everything, key={}, reporter=reporter)
    assert [part.name for part, _ in study.done] == ["fold 0", "fold 1"] and made[0].lost == ["fold 2"]
    with pytest.raises(TrainingError, match="no more"):
        run_study(PARTS, work.diverge, everything, key={})
