"""Every command that writes is killed, or finds the disk full, at random operations on files, and is given again.

What was there before is not changed; the command given again does what it does undisturbed, and leaves nothing else.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import sys
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, parse_name, read_stream
from plushsense.recording.session import is_finished
from plushsense.recording.writer import read_events
from support.drills import REPETITIONS, Drill, Fault, Ran, appending, contents, names, run, server, start

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="a process cannot be forked there"),
    pytest.mark.apart("trainings"),
]
PROTOCOL = 'name = "short"\ngesture_set = "plush-18"\ngestures = ["Tail tap 1", "Hold strong"]\nrepetitions = 2\n'
SHORT = "--epochs 1 --workers 1 --context loop --json"


def recorded(place: Path, ran: Ran) -> Any:
    """What was recorded of which gesture, after a look at every row: none is torn, doubled or elsewhere."""
    folder = place / "out" / "S01" / "1"
    stream = (folder / STREAM_NAME).read_text().splitlines()
    read = read_stream(folder / STREAM_NAME, load_layout("plush-15"))
    opened = {e.details["row"] for e in read_events(folder) if e.kind == "open"}
    assert read.malformed == 0
    assert set((np.flatnonzero(np.diff(read.frames.device_ms) > 15) + 1).tolist()) <= opened, "rows lack between runs"
    assert set((np.flatnonzero(np.diff(read.frames.device_ms) <= 0) + 1).tolist()) <= opened, "a row is there twice"
    labels = []
    for path in folder.glob("* *_*.csv"):
        beside, rows = json.loads(path.with_suffix(".json").read_text()), path.read_text().splitlines()[1:]
        name = parse_name(path.name)
        assert name is not None and name.rows == beside["rows"] == len(rows)
        assert rows == stream[beside["stream_row"] : beside["stream_row"] + len(rows)]
        labels.append(name.label)
    return Counter(labels)


def packed(place: Path, ran: Ran) -> Any:
    """The files of a backup, but those that hold times."""
    with zipfile.ZipFile(place / "copy.zip") as archive:
        members = [info for info in archive.infolist() if info.filename.startswith(("recordings", "streams"))]
        return {info.filename: info.CRC for info in members}


def evaluated(place: Path, ran: Ran) -> Any:
    return {key: value for key, value in ran.json.items() if key in ("accuracy", "macro_f1", "confusion", "per_class")}


def swept(place: Path, ran: Ran) -> Any:
    best = [{key: value for key, value in row.items() if "second" not in key} for row in ran.json["best"]]
    return best, ran.json["trials"], ran.json["done"]


def data_set(name: str) -> Callable[[Path, Ran], Any]:
    return lambda place, ran: contents(place / name, without=("index.json", "cache"))


DRILLS = {
    "record": Drill(
        "record DIR/out --device 'virtual://?person=3&speed=0&lost=0&garbled=0' --speed 0 --auto 0.5 --subject S01 "
        "--protocol DIR/short.toml --json",
        recorded,
        names_differ=("out/S01/1/",),
        once=True,
        # Given again after that, it records a second session.
        done=lambda place: is_finished(place / "out" / "S01" / "1"),
    ),
    "import": Drill("import DIR/src DIR/new --layout accel-3", data_set("new"), once=True),
    "check": Drill("check DIR/DS --json", lambda place, ran: (ran.json["findings"], data_set("DS")(place, ran))),
    "evaluate": Drill(f"evaluate DIR/DS --filters 2,3,3 --split by-subject:2 {SHORT}", evaluated),
    "sweep": Drill(
        "sweep DIR/DS --set architectures=126d2,83d1_84d2 --set filters=4,6,8,8 --set batches=full --set context=loop "
        "--split by-subject:2 --epochs 1 --workers 1 --json",
        swept,
    ),
    "publish": Drill(
        "publish DIR/DS DIR/package --licence CC-BY-4.0 --contact 'Ada <a@example.org>' --consent 'all agreed' "
        "--key DIR/key --no-reidentification",
        lambda place, ran: contents(place / "package" / "data", without=("index.json",)),
        once=True,
    ),
    "export": Drill("export DIR/model.plush DIR/C", lambda place, ran: contents(place / "C"), once=True),
    "adapt": Drill(
        "adapt DIR/model.plush DIR/S99 --out DIR/me.plush",
        lambda place, ran: contents(place, without=("src", "DS", "tmp", "S99")),
        once=True,
    ),
    "forget": Drill(
        "forget DIR/DS P2 --yes", data_set("DS"), raw=("src", "DS/recordings/P1", "DS/streams/P1", "DS/recordings/P3")
    ),
    "backup": Drill("backup DIR/DS DIR/copy.zip", packed, once=True),
}


@pytest.fixture(scope="module")
def base(recordings: Path, imported: Path, bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings, their data set without an index, a bundle, a protocol."""
    folder = tmp_path_factory.mktemp("drills") / "base"
    shutil.copytree(recordings, folder / "src")
    shutil.copytree(imported, folder / "DS", ignore=shutil.ignore_patterns("index.json", "cache"))
    shutil.copy(bundle, folder / "model.plush")
    (folder / "key").write_text("5a" * 32)
    # Somebody who calls slow fast.
    (folder / "S99").mkdir()
    for path in [*folder.glob("src/P[1-3]/Rest_*.csv"), *folder.glob("src/P[1-3]/Slow_*.csv")]:
        shutil.copy(path, folder / "S99" / path.name.replace("Slow", "Fast"))
    (folder / "short.toml").write_text(PROTOCOL)
    (folder / "tmp").mkdir()
    return folder


@pytest.fixture(scope="module")
def undisturbed(base: Path, request: pytest.FixtureRequest) -> Callable[[str], tuple[Path, Ran, Any]]:
    """The folder after an undisturbed run of a command, the run, and its outcome."""
    done: dict[str, tuple[Path, Ran, Any]] = {}

    def found(name: str) -> tuple[Path, Ran, Any]:
        if name not in done:
            if name == "publish":
                request.getfixturevalue("publish_tools")
            place = Path(shutil.copytree(base, base.parent / name))
            ran = run(DRILLS[name].command(place), place)
            assert ran.status == 0, ran.err
            done[name] = place, ran, DRILLS[name].outcome(place, ran)
        return done[name]

    return found


# What takes longest finds a full disk in `make soak` only, where each drill also has two faults in a row.
LONG = REPETITIONS > 1
SLOWEST = ("evaluate", "sweep", "publish")


@pytest.mark.parametrize("repetition", range(REPETITIONS))
@pytest.mark.parametrize(
    ("name", "fault"), [(n, f) for n in DRILLS for f in ("kill", "full") if LONG or f == "kill" or n not in SLOWEST]
)
@pytest.mark.exhaustive_for(
    "adapt-full-0", "backup-full-0", "check-full-0", "export-full-0", "forget-full-0", "publish-kill-0", "export-kill-0"
)
def test_given_again_it_does_what_it_does_undisturbed(
    name: str, fault: Fault, repetition: int, base: Path, undisturbed: Callable[[str], Any], tmp_path: Path
) -> None:
    drill, drawn = DRILLS[name], random.Random(f"{name} {fault} {repetition}")
    reference, whole, expected = undisturbed(name)
    place = Path(shutil.copytree(base, tmp_path / name))
    raw = {folder: contents(place / folder) for folder in drill.raw}
    points = sorted(drawn.sample(range(1, whole.operations + 1), min(1 + LONG, whole.operations)))
    for at in [*points, 0]:
        ran = run(drill.command(place), place, fault if at else "", at)
        # A run may need fewer operations than the one that was counted, and then ends before its point.
        assert ran.status in (0, -signal.SIGKILL) or ran.sentence, (points, at, ran)
        assert {folder: contents(place / folder) for folder in drill.raw} == raw, at
        if drill.once and (ran.status == 0 or drill.done(place)):
            break
    assert ran.status == 0 or drill.done(place) or (drill.once and "already" in ran.sentence), (points, ran)
    assert drill.outcome(place, ran) == expected, points
    assert names(place, drill.names_differ) == names(reference, drill.names_differ), points


@pytest.mark.parametrize("name", DRILLS if LONG else ("record", "import", "check", "evaluate"))
def test_two_at_once_leave_what_one_leaves(
    name: str, base: Path, undisturbed: Callable[[str], Any], tmp_path: Path
) -> None:
    """Two programs do the same at the same time: each does it, or says in one sentence that another one does."""
    drill, (reference, _, expected) = DRILLS[name], undisturbed(name)
    place = Path(shutil.copytree(base, tmp_path / name))
    both = [start(drill.command(place), place) for _ in range(2)]
    ran = [end() for end in both]
    assert all(r.status == 0 or r.sentence for r in ran), ran
    done = [r for r in ran if r.status == 0]
    assert done, ran
    assert all(drill.outcome(place, r) == expected for r in done)
    # A recorder that begins after the other one has ended records a second session.
    second = place / "out" / "S01" / "2"
    assert not second.exists() or (is_finished(second) and len(done) == 2)
    assert names(place, (*drill.names_differ, "out/S01/2")) == names(reference, drill.names_differ)


def test_marks_of_several_programs_are_all_kept(tmp_path: Path) -> None:
    count = 40 * REPETITIONS
    programs = [server().Process(target=appending, args=(tmp_path, who, count)) for who in "abc"]
    for program in programs:
        program.start()
    for program in programs:
        program.join()
    marks = [json.loads(line) for line in (tmp_path / "marks.jsonl").read_text().splitlines()]
    for who in "abc":
        assert [m["start"] for m in marks if m["who"] == who] == list(range(count))
