"""The pool: the same results in one process and in several, and nothing finished is ever lost."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import ConfigError, PlushSenseError, TrainingError
from plushsense.runs.journal import Journal
from plushsense.runs.pool import Job, run_jobs

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import work  # noqa: E402 - fresh processes import it by this path too

JOBS = [Job(f"job{n}", n) for n in range(5)]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_reports_and_resuming(tmp_path: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    journal = Journal(tmp_path)
    journal.save("job3", {"value": -1})
    done: list[tuple[str, bool]] = []
    said: list[Any] = []
    results = run_jobs(
        JOBS,
        work.square,
        shared=100,
        workers=workers,
        journal=journal,
        on_done=lambda job, result, resumed: done.append((job.id, resumed)),
        on_report=lambda job, message: said.append((job.id, *message)),
    )
    assert {job: r["value"] for job, r in results.items()} == {
        "job0": 100, "job1": 101, "job2": 104, "job3": -1, "job4": 116,
    }  # fmt: skip
    assert done[0] == ("job3", True) and sorted(done[1:]) == [(f"job{n}", False) for n in (0, 1, 2, 4)]
    assert sorted(said) == [(f"job{n}", "at", n) for n in (0, 1, 2, 4)]
    assert all(journal.has(job.id) for job in JOBS)
    made_by = {r["process"] for job, r in results.items() if job != "job3"}
    assert (os.getpid() in made_by) == (workers == 1)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"
    if workers == 2:
        assert all(r["threads"] == "1" for job, r in results.items() if job != "job3")


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_work_comes_through_as_itself(tmp_path: Path, workers: int) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(TrainingError, match="^no more$"):
        run_jobs(JOBS, work.refuse, shared=str(tmp_path), workers=workers, journal=journal)
    assert journal.has("job0") and not journal.has("job2")
    with pytest.raises(ZeroDivisionError, match="in the work"):
        run_jobs(JOBS, work.stumble, workers=workers)


def test_a_worker_that_dies_is_said_and_finished_jobs_are_kept(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(PlushSenseError, match=r"exit code 9.*finished jobs are kept"):
        run_jobs(JOBS, work.die, shared=str(tmp_path), workers=2, journal=journal)
    assert not journal.has("job2") and journal.has("job0")


def test_no_workers_are_refused() -> None:
    with pytest.raises(ConfigError, match="0 workers"):
        run_jobs(JOBS, work.square, workers=0)


SCRIPT = """
import sys
sys.path.insert(0, {here!r})
import work
from plushsense.runs.journal import Journal
from plushsense.runs.pool import Job, run_jobs

if __name__ == "__main__":
    run_jobs([Job(f"job{{n}}", n) for n in range(6)], work.tick, shared={folder!r}, workers={workers},
             journal=Journal({folder!r} + "/journal"))
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_run_goes_on_where_it_stood(tmp_path: Path, workers: int) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(here=str(HERE), folder=str(tmp_path), workers=workers))
    journal = Journal(tmp_path / "journal")
    run = subprocess.Popen([sys.executable, str(script)])
    until = time.monotonic() + 30
    while not any(journal.has(f"job{n}") for n in range(6)):
        assert time.monotonic() < until and run.poll() is None
        time.sleep(0.02)
    run.kill()
    run.wait()
    if workers == 2:
        # The orphans notice at their next word.
        time.sleep(0.4)
    finished = [n for n in range(6) if journal.has(f"job{n}")]
    assert 1 <= len(finished) < 6
    starts = {n: len((tmp_path / f"started-{n}").read_text()) for n in finished}
    assert subprocess.run([sys.executable, str(script)], timeout=60).returncode == 0
    assert all(journal.load(f"job{n}")["value"] == n for n in range(6))
    assert {n: len((tmp_path / f"started-{n}").read_text()) for n in finished} == starts


@pytest.mark.skipif(os.name == "nt", reason="Ctrl-C is sent in another way on Windows")
def test_ctrl_c_ends_the_workers_and_keeps_what_is_done(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(here=str(HERE), folder=str(tmp_path), workers=2))
    journal = Journal(tmp_path / "journal")
    run = subprocess.Popen([sys.executable, str(script)], start_new_session=True, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 30
    while not journal.has("job0"):
        assert time.monotonic() < until and run.poll() is None
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGINT)
    _, told = run.communicate(timeout=20)
    assert "KeyboardInterrupt" in told and told.count("Traceback") == 1
    assert journal.has("job0") and not journal.has("job5")


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "bare.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(HERE)!r})\n"
        "import work\nfrom plushsense.runs.pool import Job, run_jobs\n"
        "run_jobs([Job('a', 1), Job('b', 2)], work.square, shared=0, workers=2)\n"
    )
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert ended.returncode != 0
    assert "if __name__ == '__main__':" in ended.stderr
