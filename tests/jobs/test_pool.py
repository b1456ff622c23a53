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
import work

from plushsense.core.errors import ConfigError, PlushSenseError, TrainingError
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import Job, JobCallbacks, JobsSpec, run_jobs

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent

JOBS = [Job(f"job{n}", n) for n in range(5)]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_reports_and_resuming(tmp_path: Path, workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    journal = Journal(tmp_path)
    journal.save("job3", {"value": -1})
    # A process that is killed after it has saved the result leaves its lock.
    (tmp_path / ".job3.lock").touch()
    done: list[tuple[str, bool]] = []
    said: list[Any] = []
    results = run_jobs(
        JOBS,
        work.square,
        shared=100,
        spec=JobsSpec(workers, journal=journal),
        callbacks=JobCallbacks(
            on_done=lambda job, result, resumed: done.append((job.id, resumed)),
            on_report=lambda job, message: said.append((job.id, *message)),
        ),
    )
    assert {job: r["value"] for job, r in results.items()} == {
        "job0": 100, "job1": 101, "job2": 104, "job3": -1, "job4": 116,
    }  # fmt: skip
    assert done[0] == ("job3", True) and sorted(done[1:]) == [(f"job{n}", False) for n in (0, 1, 2, 4)]
    assert sorted(said) == [(f"job{n}", "at", n) for n in (0, 1, 2, 4)]
    assert all(journal.has(job.id) for job in JOBS)
    assert not list(tmp_path.glob(".*.lock"))
    made_by = {r["process"] for job, r in results.items() if job != "job3"}
    assert (os.getpid() in made_by) == (workers == 1)
    assert os.environ["OPENBLAS_NUM_THREADS"] == "2"
    if workers == 2:
        assert all(r["threads"] == "1" for job, r in results.items() if job != "job3")


def test_workers_import_nothing_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("re", "random", "multiprocessing"):
        (tmp_path / f"{name}.py").write_text("import pathlib; pathlib.Path('ran').touch(); raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    assert run_jobs(JOBS[:1], work.square, shared=1, spec=JobsSpec(2))["job0"]["value"] == 1
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_of_the_work_comes_through_as_itself(tmp_path: Path, workers: int) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(TrainingError, match="^no more$"):
        run_jobs(JOBS, work.refuse, shared=str(tmp_path), spec=JobsSpec(workers, journal=journal))
    assert journal.has("job0") and not journal.has("job2")
    with pytest.raises(ZeroDivisionError, match="in the work"):
        run_jobs(JOBS, work.stumble, spec=JobsSpec(workers))


def test_a_worker_that_dies_is_said_and_finished_jobs_are_kept(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(PlushSenseError, match=r"exit code 9.*finished jobs are kept"):
        run_jobs(JOBS, work.die, shared=str(tmp_path), spec=JobsSpec(2, journal=journal))
    assert not journal.has("job2") and journal.has("job0")


@pytest.mark.skipif(os.name == "nt", reason="kill -9 is another thing on Windows")
def test_a_killed_worker_is_replaced_and_one_job_that_kills_is_given_up(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal")
    failed: list[tuple[str, str]] = []
    began: list[str] = []
    results = run_jobs(
        JOBS,
        work.killed_once,
        shared=str(tmp_path),
        spec=JobsSpec(2, journal=journal),
        callbacks=JobCallbacks(
            on_start=lambda job: began.append(job.id),
            on_report=lambda job, process: os.kill(process, signal.SIGKILL),
            on_failed=lambda job, error: failed.append((job.id, str(error))),
        ),
    )
    assert sorted(results) == ["job0", "job1", "job2", "job4"]
    assert [job for job, _ in failed] == ["job3"]
    assert "given up" in failed[0][1] and "2 times (exit code 9)" in failed[0][1]
    assert sorted(began) == ["job0", "job1", "job1", "job2", "job3", "job3", "job4"]
    assert len((tmp_path / "started-1").read_text()) == 2 and not journal.has("job3")
    # No claims are left, and the run can be made again.
    assert sorted(p.name for p in journal.folder.iterdir()) == [f"job{n}.npz" for n in (0, 1, 2, 4)]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failed_job_is_told_and_the_others_go_on(tmp_path: Path, workers: int) -> None:
    journal = Journal(tmp_path)
    failed: list[tuple[str, type[Exception]]] = []
    results = run_jobs(
        JOBS,
        work.diverge,
        spec=JobsSpec(workers, threads=2, journal=journal),
        callbacks=JobCallbacks(on_failed=lambda job, error: failed.append((job.id, type(error)))),
    )
    assert sorted(results) == ["job0", "job1", "job3", "job4"] and failed == [("job2", TrainingError)]
    assert not journal.has("job2") and journal.has("job4")
    if workers == 2:
        assert all(result["threads"] == "2" for result in results.values())


def test_a_journal_where_no_folder_can_be_ends_the_run(tmp_path: Path) -> None:
    (tmp_path / "journal").write_text("a file")
    for workers in (1, 2):
        with pytest.raises(PlushSenseError, match="cannot be kept in.*finished jobs are kept"):
            run_jobs(
                JOBS[:2],
                work.diverge,
                spec=JobsSpec(workers, journal=Journal(tmp_path / "journal")),
                callbacks=JobCallbacks(on_failed=lambda job, error: None),
            )


def test_two_runs_on_one_journal_share_the_work(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(here=str(HERE), folder=str(tmp_path), workers=1))
    runs = [subprocess.Popen([sys.executable, str(script)]) for _ in range(2)]
    assert [run.wait(60) for run in runs] == [0, 0]
    journal = Journal(tmp_path / "journal")
    assert all(journal.load(f"job{n}")["value"] == n for n in range(6))
    assert sorted(p.name for p in journal.folder.iterdir()) == [f"job{n}.npz" for n in range(6)]
    starts = [len((tmp_path / f"started-{n}").read_text()) for n in range(6)]
    # Only of the last job each run has no other one to turn to.
    assert starts[:5] == [1] * 5 or sum(starts) <= 7


def test_no_workers_are_refused() -> None:
    with pytest.raises(ConfigError, match="0 workers"):
        JobsSpec(workers=0)
    with pytest.raises(ConfigError, match="0 threads"):
        JobsSpec(threads=0)


SCRIPT = """
import sys
sys.path.insert(0, {here!r})
import work
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import Job, JobsSpec, run_jobs

if __name__ == "__main__":
    run_jobs([Job(f"job{{n}}", n) for n in range(6)], work.tick, shared={folder!r},
             spec=JobsSpec({workers}, journal=Journal({folder!r} + "/journal")))
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
    # So many jobs that a busy machine, too, is still at work when the signal comes.
    text = script.read_text().replace("range(6)", "range(200)")
    # Programs that a shell starts in the background ignore the signal.
    heed = "import signal\nif __name__ == '__main__':\n    signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    script.write_text(heed + text)
    run = subprocess.Popen([sys.executable, str(script)], start_new_session=True, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 30
    while not journal.has("job0"):
        assert time.monotonic() < until and run.poll() is None
        time.sleep(0.02)
    os.killpg(run.pid, signal.SIGINT)
    _, told = run.communicate(timeout=90)
    # Of one process only; the signal may come while it handles another exception.
    assert told.count("\nKeyboardInterrupt") == 1
    assert journal.has("job0") and not journal.has("job199")


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    script = tmp_path / "bare.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(HERE)!r})\n"
        "import work\nfrom plushsense.jobs.pool import Job, JobsSpec, run_jobs\n"
        "run_jobs([Job('a', 1), Job('b', 2)], work.square, shared=0, spec=JobsSpec(2))\n"
    )
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert ended.returncode != 0
    assert "if __name__ == '__main__':" in ended.stderr
