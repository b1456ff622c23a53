"""What is there is counted truly, and what comes next follows from it."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from plushsense.apps.api import simulate
from plushsense.apps.studio.house import BUNDLES, DATASETS, WORK, House
from plushsense.apps.studio.overview import BundleSeen, DatasetSeen, Overview, Seen, SessionSeen, next_step
from plushsense.apps.studio.tasks import importing
from plushsense.apps.studio.worker import Tell
from plushsense.dataset.marks import Mark, append_marks
from recorded import record


class Quiet:
    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass


TELL = Tell(Quiet())


def take_in(house: House, sessions: list[Path], name: str, **more: Any) -> dict[str, Any]:
    spec = {
        "sessions": [str(s) for s in sessions],
        "recordings": str(house.recordings),
        "work": str(house.folder / WORK),
        "dest": str(house.folder / DATASETS / name),
        "name": name,
        **more,
    }
    return importing.run(spec, TELL)


def test_sessions_wait_until_a_data_set_holds_all_of_them(tmp_path: Path) -> None:
    house = House(tmp_path / "home")
    overview = Overview(house)
    assert overview.look() == Seen()
    first, second = record(house, "S01"), record(house, "S02")
    raw = {p: p.read_bytes() for p in house.recordings.rglob("*") if p.is_file()}
    seen = overview.look()
    assert [(s.subject, s.session, s.recordings, s.finished, s.waiting) for s in seen.sessions] == [
        ("S01", "1", 4, True, True),
        ("S02", "1", 4, True, True),
    ]
    assert next_step(seen).about == {"n": 2, "recordings": 8}
    done = take_in(house, [first], "mine")
    assert (done["recordings"], done["rejected"]) == (4, [])
    seen = overview.look()
    assert [s.kept for s in seen.sessions] == [("mine",), ()]
    assert (seen.datasets[0].people, seen.datasets[0].recordings, seen.datasets[0].simulated) == (1, 4, True)
    done = take_in(house, [first, second], "mine", add=True)
    assert done["added"]["recordings"] == 4
    seen = overview.look()
    assert not any(s.waiting for s in seen.sessions)
    assert seen.datasets[0].recordings == 8
    assert {p: p.read_bytes() for p in house.recordings.rglob("*") if p.is_file()} == raw
    assert list((house.folder / WORK).iterdir()) == []


def test_real_and_virtual_sessions_are_kept_apart(tmp_path: Path) -> None:
    house = House(tmp_path / "home")
    record(house, "S01")
    record(house, "S02", simulated=False)
    batches = Overview(house).look().batches()
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
    seen = Overview(House(home)).look()
    assert {d.path.name for d in seen.datasets if d.refused} == {"head", "empty", "index", "bytes"}
    assert all(d.refused.endswith((".", ")")) for d in seen.datasets if d.refused)
    assert [d.recordings for d in seen.datasets if not d.refused] == [119]
    assert [b.name for b in seen.bundles if b.refused] == ["bad"]
    assert seen.sessions[0].refused
    assert seen.batches() == []
    good = next(b for b in seen.bundles if not b.refused)
    assert (good.dataset, good.simulated, good.gestures) == ("virtual toy", True, 18)


def test_changes_on_disk_are_seen(furniture: Path, tmp_path: Path) -> None:
    home = Path(shutil.copytree(furniture, tmp_path / "home"))
    overview = Overview(House(home))
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
    assert Overview(House(tmp_path / "home")).look().datasets[0].simulated


REAL = DatasetSeen(Path("d"), "real", recordings=9)
LOOKED = DatasetSeen(Path("d"), "real", recordings=9, reviewed=True)
ALONE = DatasetSeen(Path("a"), "alone", people=1, recordings=4, reviewed=True)
MANY = DatasetSeen(Path("v"), "many", people=6, recordings=50, reviewed=True)
TRIED = DatasetSeen(Path("v"), "virtual", simulated=True, recordings=9)
BROKEN = DatasetSeen(Path("b"), "broken", "It is broken.")
NET = BundleSeen(Path("m.plush"), "m")
TOY_NET = BundleSeen(Path("v.plush"), "v", simulated=True)
BROKEN_NET = BundleSeen(Path("b.plush"), "b", refused="It is broken.")
OPEN = SessionSeen(Path("s"), "S01", "1")
MADE = SessionSeen(Path("s"), "S01", "1", recordings=4)
KEPT = SessionSeen(Path("s"), "S01", "1", recordings=4, finished=True, kept=("real",))


@pytest.mark.parametrize(
    ("seen", "toy", "key", "page"),
    [
        (Seen(), "", "try", ""),
        (Seen(), "virtual://", "try", ""),
        (Seen(), "serial://COM3", "record", "record"),
        (Seen(sessions=(OPEN,)), "", "go_on", "record"),
        (Seen(sessions=(MADE,)), "", "collect", ""),
        (Seen(datasets=(LOOKED,), sessions=(MADE,), bundles=(NET,)), "", "collect", ""),
        (Seen(datasets=(BROKEN,)), "", "try", ""),
        (Seen(datasets=(BROKEN, REAL)), "", "review", "review"),
        (Seen(datasets=(REAL,), sessions=(KEPT,)), "", "review", "review"),
        (Seen(datasets=(LOOKED,)), "", "train", "train"),
        (Seen(datasets=(ALONE,)), "", "more", "record"),
        (Seen(datasets=(ALONE, MANY)), "", "train", "train"),
        (Seen(datasets=(TRIED,)), "", "train", "train"),
        (Seen(datasets=(TRIED,), bundles=(TOY_NET,)), "", "live", "live"),
        (Seen(datasets=(TRIED, REAL), bundles=(TOY_NET,)), "", "review", "review"),
        (Seen(datasets=(REAL,), bundles=(NET,)), "", "live", "live"),
        (Seen(bundles=(NET,)), "", "live", "live"),
        (Seen(bundles=(BROKEN_NET,)), "", "try", ""),
        (Seen(datasets=(LOOKED,), bundles=(BROKEN_NET,)), "", "train", "train"),
    ],
)
def test_what_to_do_next(seen: Seen, toy: str, key: str, page: str) -> None:
    step = next_step(seen, toy=toy, virtual=toy.startswith("virtual"))
    assert (step.key, step.page) == (key, page)


def test_while_a_data_set_is_made_nothing_else_is_next() -> None:
    assert next_step(Seen(), making=True).key == "making"
