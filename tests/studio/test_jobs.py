"""Long work is begun, stopped, taken up, and never outlives its studio."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError
from plushsense.studio.app.jobs import DONE, INCOMING, REFUSED, RUNNING, STOPPED, UNFINISHED, WARM, Jobs, StudioJob
from plushsense.studio.app.workspace import WORK, Workspace

SIMULATE = {"people": 2, "repetitions": 1}
LONG = {"people": 400, "repetitions": 3}


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "home")


@pytest.fixture
def jobs(workspace: Workspace) -> Iterator[Jobs]:
    made = Jobs(workspace)
    yield made
    made.close()


def spec(workspace: Workspace, name: str, size: dict[str, int]) -> dict[str, object]:
    return {**size, "dest": str(workspace.folder / "datasets" / name), "work": str(workspace.folder / WORK)}


def until(what: Callable[[], object], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def ended(job: StudioJob) -> StudioJob:
    until(lambda: job.state != RUNNING)
    return job


def on_disk(workspace: Workspace, job: StudioJob) -> dict[str, object]:
    read: dict[str, object] = json.loads((workspace.folder / WORK / f"{job.id}.json").read_text(encoding="utf-8"))
    return read


def alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    if stat.exists():
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True


def test_work_reports_and_ends_with_its_result(workspace: Workspace, jobs: Jobs) -> None:
    job = ended(jobs.start("simulate", spec(workspace, "a", SIMULATE), "Trying"))
    assert job.state == DONE, job.message
    assert job.result["people"] == 2
    assert (workspace.folder / "datasets" / "a" / "dataset.toml").is_file()
    assert {r["what"] for r in job.reports} == {"recording", "importing"}
    assert job.progress == job.reports[-1]
    assert 0 < job.begun_s <= job.ended_s
    until(lambda: on_disk(workspace, job)["state"] == DONE)
    assert [p for p in (workspace.folder / WORK).iterdir() if p.name.startswith(UNFINISHED)] == []
    # Another studio on the same folder knows of it.
    again = Jobs(workspace).get(job.id)
    assert (again.state, again.result, again.title) == (DONE, job.result, "Trying")


def test_what_a_task_refuses_is_a_sentence(
    workspace: Workspace, jobs: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Nothing is imported from the working folder.
    (tmp_path / "re.py").write_text("raise SystemExit(1)")
    monkeypatch.chdir(tmp_path)
    job = ended(jobs.start("check", {"dataset": str(workspace.folder / "nothing")}, "Check"))
    assert job.state == REFUSED
    assert job.message.startswith("There is no folder")
    until(lambda: on_disk(workspace, job)["state"] == REFUSED)


@pytest.mark.parametrize(("task", "asked"), [("nothing", {}), ("check", {}), ("simulate", {"people": "many"})])
def test_a_task_that_cannot_be_is_refused(jobs: Jobs, task: str, asked: dict[str, object]) -> None:
    job = ended(jobs.start(task, asked, "x"))
    assert job.state == REFUSED
    assert job.message.startswith("The work broke off")


def test_stopped_work_ends_soon_and_can_be_begun_again(workspace: Workspace, jobs: Jobs) -> None:
    job = jobs.start("simulate", spec(workspace, "long", LONG), "Long")
    until(lambda: job.progress)
    assert jobs.resume(job.id) is job
    with pytest.raises(ConfigError, match="Stop it first"):
        jobs.drop(job.id)
    jobs.stop(job.id)
    ended(job)
    assert job.state == STOPPED
    assert not (workspace.folder / "datasets" / "long").exists()
    jobs.stop(job.id)
    job.spec = spec(workspace, "long", SIMULATE)
    jobs.resume(job.id)
    assert ended(job).state == DONE
    jobs.drop(job.id)
    assert jobs.all() == [] and not (workspace.folder / WORK / f"{job.id}.json").exists()


def test_ids_are_unique_in_order_also_when_the_clock_goes_back(
    workspace: Workspace, jobs: Jobs, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 5_000_000_000)
    made = [jobs.start("check", {}, str(n)) for n in range(3)]
    monkeypatch.setattr(time, "time_ns", lambda: 1_000_000_000)
    made.append(jobs.start("check", {}, "3"))
    assert [int(j.id) for j in made] == sorted({int(j.id) for j in made})
    assert [j.title for j in jobs.all()] == ["3", "2", "1", "0"]
    assert jobs.all("train") == []
    for job in made:
        ended(job)


def test_an_id_that_is_none_is_refused(jobs: Jobs) -> None:
    for call in (jobs.get, jobs.resume, jobs.drop):
        with pytest.raises(ConfigError, match="not in the list any more"):
            call("nothing")
    jobs.stop("nothing")


def test_uploaded_files_that_were_not_imported_are_removed(workspace: Workspace) -> None:
    sent = workspace.folder / WORK / INCOMING / "1"
    sent.mkdir(parents=True)
    (sent / "half.zip").write_bytes(b"PK")
    assert Jobs(workspace).all() == []
    assert not sent.exists()


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "7", "null", '{"id": "bad"}', "[" * 100_000, '{"id":"other","task":"check","spec":{},"title":""}'],
    ids=lambda t: ascii(t)[:12],
)
def test_a_broken_file_is_passed_over(workspace: Workspace, text: str) -> None:
    (workspace.folder / WORK).mkdir(parents=True)
    (workspace.folder / WORK / "bad.json").write_text(text, encoding="utf-8")
    good = {"id": "1", "task": "check", "spec": {}, "title": "x", "state": DONE}
    (workspace.folder / WORK / "1.json").write_text(json.dumps(good), encoding="utf-8")
    assert [j.id for j in Jobs(workspace).all()] == ["1"]
    assert (workspace.folder / WORK / "bad.json").exists()


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="the folder could be written to all the same")
def test_a_folder_that_cannot_be_written_to(workspace: Workspace) -> None:
    workspace.folder.mkdir()
    workspace.folder.chmod(0o500)
    try:
        job = Jobs(workspace).start("check", {"dataset": "x"}, "Check")
        assert job.state == REFUSED
        assert "The computer refused" in job.message and "Permission" in job.message
    finally:
        workspace.folder.chmod(0o700)


def test_a_file_where_the_folder_should_be(workspace: Workspace) -> None:
    workspace.folder.mkdir()
    (workspace.folder / WORK).write_text("a file")
    job = Jobs(workspace).start("check", {"dataset": "x"}, "Check")
    assert job.state == REFUSED
    assert str(workspace.folder / WORK) in job.message


STUDIO = """
import sys, time
from pathlib import Path
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.app.jobs import Jobs
workspace = Workspace(Path(sys.argv[1]))
jobs = Jobs(workspace)
job = jobs.start("simulate", {"people": 400, "repetitions": 3, "dest": str(workspace.folder / "d"),
                              "work": str(workspace.folder / "work")}, "Long")
while not job.progress:
    time.sleep(0.02)
print(job.id, jobs._processes[job.id].pid, flush=True)
time.sleep(600)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="kill is for POSIX")
def test_the_work_of_a_killed_studio_ends_and_reads_as_stopped(workspace: Workspace) -> None:
    workspace.folder.mkdir()
    studio = subprocess.Popen(
        [sys.executable, "-c", STUDIO, str(workspace.folder)], stdout=subprocess.PIPE, text=True, env=os.environ
    )
    assert studio.stdout is not None
    identity, pid = studio.stdout.readline().split()
    assert alive(int(pid))
    studio.send_signal(signal.SIGKILL)
    studio.wait()
    studio.stdout.close()
    until(lambda: not alive(int(pid)))
    assert list((workspace.folder / WORK).glob(f"{UNFINISHED}*"))
    jobs = Jobs(workspace)
    assert jobs.get(identity).state == STOPPED
    assert not (workspace.folder / "d").exists()
    assert not list((workspace.folder / WORK).glob(f"{UNFINISHED}*"))


WORKER_WITH_CHILD = """
import subprocess, sys
from plushsense.studio import tasks
def run(spec, reporter):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    reporter.progress(pid=child.pid)
    child.wait()
tasks.TASKS["child"] = run
sys.exit(tasks.main())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="process groups are of POSIX")
def test_a_worker_ends_with_its_studio_and_takes_its_own_processes_along() -> None:
    worker = subprocess.Popen(
        [sys.executable, "-c", WORKER_WITH_CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write('{"task": "child", "spec": {}}\n')
    worker.stdin.flush()
    child = json.loads(worker.stdout.readline())["progress"]["pid"]
    assert alive(child)
    worker.stdin.close()
    worker.wait(20)
    worker.stdout.close()
    until(lambda: not alive(child))


@pytest.mark.parametrize("line", ["\n", "nonsense\n", "[]\n", '{"task": 5, "spec": {}}\n'])
def test_a_worker_that_is_asked_nonsense_refuses(line: str) -> None:
    worker = subprocess.Popen(
        [sys.executable, "-m", "plushsense.studio.tasks"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert worker.stdin is not None and worker.stdout is not None
    # It stays open: its end would be the studio's.
    worker.stdin.write(line)
    worker.stdin.flush()
    refused = json.loads(worker.stdout.readline())["refused"]["message"]
    assert "broke off" in refused
    assert worker.wait(60) == 2
    worker.stdin.close()
    worker.stdout.close()


def test_a_person_to_remove_is_not_stored_in_the_work_folder(workspace: Workspace, jobs: Jobs) -> None:
    spec = {"home": str(workspace.folder), "given": [], "chosen": ["sessions Annabelle"], "person": "Annabelle"}
    job = ended(jobs.start("forget", spec, "Remove"))
    assert job.state == DONE and job.result["receipt"]["person"] == "Annabelle"
    assert not [p for p in workspace.folder.rglob("*") if p.is_file() and "Annabelle" in p.read_text(encoding="utf-8")]
    # A studio that was started again does not know the person any more.
    again = ended(Jobs(workspace).resume(job.id))
    assert (again.state, again.message) == (
        REFUSED,
        "The person's code is not stored. Choose the person again on the home page.",
    )


def test_what_only_looks_is_not_kept(workspace: Workspace, jobs: Jobs) -> None:
    job = ended(jobs.start("train", {"dataset": str(workspace.folder), "dry": True}, "Looking"))
    assert job.state == REFUSED and job.message
    until(lambda: job not in jobs.all())
    assert not list((workspace.folder / WORK).glob("*.json"))


def test_a_training_begins_in_the_process_that_has_loaded_pytorch(workspace: Workspace, jobs: Jobs) -> None:
    jobs.warm_up()
    warm = jobs._warm
    assert warm is not None
    jobs.warm_up()
    assert jobs._warm is warm, "one is enough"
    other = jobs.start("simulate", spec(workspace, "d", SIMULATE), "simulate")
    assert jobs._warm is warm
    first, second = (jobs.start("train", {"dataset": "nowhere"}, "train") for _ in range(2))
    assert jobs._processes[first.id] is warm and jobs._warm is None
    assert jobs._processes[second.id] is not warm
    assert [ended(job).state for job in (other, first, second)] == [DONE, REFUSED, REFUSED]
    jobs.warm_up()
    unused = jobs._warm
    assert unused is not None
    jobs.close()
    assert unused.poll() is not None


def test_a_warm_process_ends_with_its_studio() -> None:
    worker = subprocess.Popen(
        [sys.executable, "-m", "plushsense.studio.tasks", WARM], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    out, _ = worker.communicate(timeout=120)
    assert (worker.returncode, out) == (0, b"")


def test_a_warm_process_without_pytorch_leaves_the_refusal_to_the_task() -> None:
    code = (
        "import sys; sys.modules['torch'] = None; sys.argv = ['tasks', 'warm']; "
        "from plushsense.studio import tasks; sys.exit(tasks.main())"
    )
    worker = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write('{"task": "check", "spec": {"dataset": "nowhere"}}\n')
    worker.stdin.flush()
    assert "refused" in json.loads(worker.stdout.readline())
    assert worker.wait(60) == 2
    worker.stdin.close()
    worker.stdout.close()
