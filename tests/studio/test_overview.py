"""What is there is counted truly, and what comes next follows from it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.marks import Mark, append_marks
from plushsense.studio.app.workspace import BUNDLES, DATASETS, WORK, Workspace
from plushsense.studio.pages.home.overview import (
    BundleEntry,
    DatasetEntry,
    Overview,
    SessionEntry,
    WorkspaceSummary,
    next_step,
)
from plushsense.studio.tasks import TASKS, TaskReporter
from plushsense.workflow.api import simulate
from support.recorded import record
from support.results import row


class Quiet:
    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass


REPORTER = TaskReporter(Quiet())


def take_in(workspace: Workspace, sessions: list[Path], name: str, **more: Any) -> dict[str, Any]:
    spec = {
        "sessions": [str(s) for s in sessions],
        "recordings": str(workspace.recordings),
        "work": str(workspace.folder / WORK),
        "dest": str(workspace.folder / DATASETS / name),
        "name": name,
        **more,
    }
    return TASKS["import"](spec, REPORTER)


def test_sessions_wait_until_a_data_set_holds_all_of_them(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "home")
    overview = Overview(workspace)
    assert overview.look() == WorkspaceSummary()
    first, second = record(workspace, "S01"), record(workspace, "S02")
    raw = {p: p.read_bytes() for p in workspace.recordings.rglob("*") if p.is_file()}
    seen = overview.look()
    assert [(s.subject, s.session, s.recordings, s.finished, s.waiting) for s in seen.sessions] == [
        ("S01", "1", 4, True, True),
        ("S02", "1", 4, True, True),
    ]
    assert next_step(seen).values == {"n": 2, "recordings": 8}
    done = take_in(workspace, [first], "mine")
    assert (done["recordings"], done["rejected"]) == (4, [])
    seen = overview.look()
    assert [s.datasets for s in seen.sessions] == [("mine",), ()]
    assert (seen.datasets[0].people, seen.datasets[0].recordings, seen.datasets[0].simulated) == (1, 4, True)
    done = take_in(workspace, [first, second], "mine", add=True)
    assert done["added"]["recordings"] == 4
    seen = overview.look()
    assert not any(s.waiting for s in seen.sessions)
    assert seen.datasets[0].recordings == 8
    assert {p: p.read_bytes() for p in workspace.recordings.rglob("*") if p.is_file()} == raw
    assert list((workspace.folder / WORK).iterdir()) == []


def test_real_and_virtual_sessions_are_kept_apart(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "home")
    record(workspace, "S01")
    record(workspace, "S02", simulated=False)
    batches = Overview(workspace).look().batches()
    assert [[s.subject for s in b] for b in batches] == [["S02"], ["S01"]]


def test_what_cannot_be_read_is_listed_with_its_sentence(furniture: Path, tmp_path: Path) -> None:
    home = Path(shutil.copytree(furniture, tmp_path / "home"))
    for name, text in (("head", "not = [toml"), ("empty", "")):
        (home / DATASETS / name).mkdir()
        (home / DATASETS / name / "dataset.toml").write_text(text)
    shutil.copytree(home / DATASETS / "virtual", home / DATASETS / "index")
    (home / DATASETS / "index" / "recordings.csv").write_text("id,subject\n1,2\n")
    shutil.copytree(home / DATASETS / "virtual", home / DATASETS / "bytes")
    (home / DATASETS / "bytes" / "recordings.csv").write_bytes(b"\xff\xfe\x00" * 40)
    (home / BUNDLES / "bad.plush").write_bytes(b"nothing")
    (home / "recordings" / "S01" / "1").mkdir(parents=True)
    (home / "recordings" / "S01" / "1" / "session.json").write_text("{")
    seen = Overview(Workspace(home)).look()
    assert {d.path.name for d in seen.datasets if d.refused} == {"head", "empty", "index", "bytes"}
    assert all(d.refused.endswith((".", ")")) for d in seen.datasets if d.refused)
    assert [d.recordings for d in seen.datasets if not d.refused] == [106]
    assert [b.name for b in seen.bundles if b.refused] == ["bad"]
    assert seen.sessions[0].refused
    assert seen.batches() == []
    good = next(b for b in seen.bundles if not b.refused)
    assert (good.dataset, good.simulated, good.gestures) == ("virtual toy", True, 18)


def test_changes_on_disk_are_seen(furniture: Path, tmp_path: Path) -> None:
    home = Path(shutil.copytree(furniture, tmp_path / "home"))
    overview = Overview(Workspace(home))
    before = overview.look().datasets[0]
    assert not before.reviewed and before.bytes > 1_000_000
    dataset = home / DATASETS / "virtual"
    append_marks(dataset, [Mark("x", "exclude", "recorder", "made again")])
    assert not overview.look().datasets[0].reviewed
    append_marks(dataset, [Mark("x", "exclude", "ilze", "a cough")])
    assert overview.look().datasets[0].reviewed
    shutil.rmtree(dataset)
    assert overview.look().datasets == ()


def test_a_simulation_imported_from_elsewhere_stays_one(tmp_path: Path) -> None:
    simulate(tmp_path / "made", people=2, repetitions=1, dataset=tmp_path / "home" / DATASETS / "v")
    assert Overview(Workspace(tmp_path / "home")).look().datasets[0].simulated


REAL = DatasetEntry(Path("d"), "real", recordings=9)
LOOKED = DatasetEntry(Path("d"), "real", recordings=9, reviewed=True)
ALONE = DatasetEntry(Path("a"), "alone", people=1, recordings=4, reviewed=True)
MANY = DatasetEntry(Path("v"), "many", people=6, recordings=50, reviewed=True)
TRIED = DatasetEntry(Path("v"), "virtual", simulated=True, recordings=9)
BROKEN = DatasetEntry(Path("b"), "broken", "It is broken.")
PROVEN = replace(row("m", 100, 0.5), interval=(0.4, 0.6), chance=0.1)
GUESSING = replace(PROVEN, interval=(0.1, 0.9))
LEAKY = replace(PROVEN, leaky=True)
NET = BundleEntry(Path("m.plush"), "m", score=PROVEN)
GUESS = BundleEntry(Path("g.plush"), "g", score=GUESSING)
UNTESTED = BundleEntry(Path("u.plush"), "u", score=replace(PROVEN, kind="training", accuracy=None, interval=None))
TOY_NET = BundleEntry(Path("v.plush"), "v", simulated=True, score=PROVEN)
BROKEN_NET = BundleEntry(Path("b.plush"), "b", refused="It is broken.")
OPEN = SessionEntry(Path("s"), "S01", "1")
MADE = SessionEntry(Path("s"), "S01", "1", recordings=4)
KEPT = SessionEntry(Path("s"), "S01", "1", recordings=4, finished=True, datasets=("real",))


@pytest.mark.parametrize(
    ("seen", "toy", "key", "page"),
    [
        (WorkspaceSummary(), "", "try", ""),
        (WorkspaceSummary(), "virtual://", "try", ""),
        (WorkspaceSummary(), "serial://COM3", "record", "record"),
        (WorkspaceSummary(sessions=(OPEN,)), "", "go_on", "record"),
        (WorkspaceSummary(sessions=(MADE,)), "", "collect", ""),
        (WorkspaceSummary(datasets=(LOOKED,), sessions=(MADE,), bundles=(NET,)), "", "collect", ""),
        (WorkspaceSummary(datasets=(BROKEN,)), "", "try", ""),
        (WorkspaceSummary(datasets=(BROKEN, REAL)), "", "review", "review"),
        (WorkspaceSummary(datasets=(REAL,), sessions=(KEPT,)), "", "review", "review"),
        (WorkspaceSummary(datasets=(LOOKED,)), "", "train", "train"),
        (WorkspaceSummary(datasets=(ALONE,)), "", "more", "record"),
        (WorkspaceSummary(datasets=(ALONE, MANY)), "", "train", "train"),
        (WorkspaceSummary(datasets=(TRIED,)), "", "train", "train"),
        (WorkspaceSummary(datasets=(TRIED,), bundles=(TOY_NET,)), "", "live", "live"),
        (WorkspaceSummary(datasets=(TRIED,), bundles=(GUESS, UNTESTED)), "", "test", "live"),
        (WorkspaceSummary(datasets=(TRIED, REAL), bundles=(TOY_NET,)), "", "review", "review"),
        (WorkspaceSummary(datasets=(REAL,), bundles=(NET,)), "", "live", "live"),
        (WorkspaceSummary(bundles=(NET,)), "", "live", "live"),
        (WorkspaceSummary(datasets=(LOOKED,), bundles=(GUESS,)), "", "improve", "record"),
        (WorkspaceSummary(datasets=(LOOKED,), bundles=(replace(NET, score=LEAKY),)), "", "improve", "record"),
        (WorkspaceSummary(bundles=(replace(NET, score=None),)), "", "improve", "record"),
        (WorkspaceSummary(bundles=(BROKEN_NET,)), "", "try", ""),
        (WorkspaceSummary(datasets=(LOOKED,), bundles=(BROKEN_NET,)), "", "train", "train"),
    ],
)
def test_what_to_do_next(seen: WorkspaceSummary, toy: str, key: str, page: str) -> None:
    step = next_step(seen, toy=toy, virtual=toy.startswith("virtual"))
    assert (step.key, step.page) == (key, page)


def test_a_network_that_guesses_is_passed_over() -> None:
    step = next_step(WorkspaceSummary(datasets=(LOOKED,), bundles=(GUESS, NET)))
    assert (step.key, step.values) == ("live", {"name": "m", "model": Path("m.plush")})


def test_while_a_data_set_is_made_nothing_else_is_next() -> None:
    assert next_step(WorkspaceSummary(), making=True).key == "making"
