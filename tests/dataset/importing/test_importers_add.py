"""Adding to a data set: only what is new by content, and nothing that is there is touched."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.importing import build
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks, read_marks
from plushsense.dataset.store import PersonInfo, read_people, write_people
from plushsense.recording.writer import SessionEvent

pytestmark = pytest.mark.slow

Writer = Callable[..., Path]
ACCEL = load_layout("accel-3")


def put(folder: Path, label: str, seed: int, epoch: int | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    clock = np.arange(60, dtype=np.int64) * 10 + seed * 100_000
    values = np.random.default_rng(seed).integers(0, 900, (60, 3))
    path = folder / recording_filename(label, 1000 + seed if epoch is None else epoch, 60)
    write_recording(path, Frames(values, clock, clock + 10**12), ACCEL)
    return path


def raw(dataset: Path) -> dict[str, bytes]:
    return {
        p.relative_to(dataset).as_posix(): p.read_bytes()
        for kind in ("recordings", "streams")
        for p in (dataset / kind).rglob("*")
        if p.is_file()
    }


def test_what_is_new_is_added_and_the_rest_counted(tmp_path: Path) -> None:
    first = put(tmp_path / "src" / "ana", "Shake", 1)
    made = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    append_marks(tmp_path / "DS", [Mark("ana/Shake_1001_60", "trim", "me", start=5)])
    write_people(tmp_path / "DS", [PersonInfo("ana", "adult")])
    before = raw(tmp_path / "DS")
    put(tmp_path / "src" / "ana", "Wave", 2)
    put(tmp_path / "src" / "ben", "Shake", 3)
    (tmp_path / "more" / "ana").mkdir(parents=True)
    put(tmp_path / "more" / "ana", "Shake", 9, epoch=1001)
    for source, counts in (("src", (3, 2, 1)), ("src", (3, 0, 3)), ("more", (4, 1, 0))):
        done = import_recordings(tmp_path / source, tmp_path / "DS", add_to=True)
        assert (done.recordings, done.added_recordings, done.already_there) == counts
        assert done.rejected == ()
    assert (tmp_path / "DS" / "recordings" / "ana" / "again-2" / first.name).is_file()
    after = raw(tmp_path / "DS")
    assert before.items() <= after.items()
    assert len(after) == 4
    dataset = open_dataset(tmp_path / "DS")
    assert dataset.recordings == done.dataset.recordings
    assert dataset.gestures.labels == ("Shake", "Wave")
    assert dataset.gestures.inferred
    assert next(r for r in dataset.recordings if r.id == "ana/Shake_1001_60").start == 5
    assert read_people(tmp_path / "DS")["ana"].age_group == "adult"
    assert dataset.head.name == made.dataset.head.name == "src"


def test_what_cannot_be_added_is_refused(tmp_path: Path, session_writer: Writer) -> None:
    put(tmp_path / "src" / "ana", "Shake", 1)
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    before = raw(tmp_path / "DS")
    with pytest.raises(DatasetError, match="is a data set already"):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    with pytest.raises(DatasetError, match="has the layout 'accel-3', not 'plush-15'"):
        import_recordings(tmp_path / "src", tmp_path / "DS", layout="plush-15", add_to=True)
    session_writer(tmp_path / "out")
    with pytest.raises(DatasetError, match="'plush-15', but that of the data set is 'accel-3'"):
        import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    with pytest.raises(DatasetError, match="real toy, the source those of a virtual one"):
        import_recordings(tmp_path / "src", tmp_path / "DS", add_to=True, simulated=True)
    with pytest.raises(ConfigError, match="--add keeps the layout, name"):
        import_recordings(tmp_path / "src", tmp_path / "DS", add_to=True, name="new")
    with pytest.raises(DatasetError, match="There is no folder"):
        import_recordings(tmp_path / "src", tmp_path / "nowhere", add_to=True)
    put(tmp_path / "upper" / "ANA", "Shake", 5)
    with pytest.raises(DatasetError, match="would share the folder"):
        import_recordings(tmp_path / "upper", tmp_path / "DS", add_to=True)
    (tmp_path / "wide" / "bo").mkdir(parents=True)
    (tmp_path / "wide" / "bo" / "Shake_1_1.csv").write_text("a, b\n1, 2\n")
    with pytest.raises(DatasetError, match=r"Nothing of the source fits.*all files \(1\)\. The first: .*has 2 columns"):
        import_recordings(tmp_path / "wide", tmp_path / "DS", add_to=True)
    assert raw(tmp_path / "DS") == before
    assert not [p for p in (tmp_path / "DS" / "cache").iterdir() if p.is_dir()]


@pytest.mark.parametrize("writes", range(1, 9))
def test_a_crash_at_any_write_leaves_a_valid_data_set(
    tmp_path: Path, session_writer: Writer, monkeypatch: pytest.MonkeyPatch, writes: int
) -> None:
    session_writer(tmp_path / "out", "P01")
    import_recordings(tmp_path / "out", tmp_path / "DS")
    before = raw(tmp_path / "DS")
    session_writer(tmp_path / "out", "P02", seed=1, redo=[0], gestures=("Tail pull", "Ear tickle"))
    left = writes
    replace = os.replace

    def dies(a: object, b: object) -> None:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        replace(a, b)  # type: ignore[arg-type]

    monkeypatch.setattr(os, "replace", dies)
    with pytest.raises(KeyboardInterrupt):
        import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    monkeypatch.undo()
    half = open_dataset(tmp_path / "DS")
    assert before.items() <= raw(tmp_path / "DS").items()
    assert all(r.excluded == (r.subject == "P02" and r.gesture == "Tail pull") for r in half.recordings)
    done = import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    assert (done.recordings, done.streams) == (4, 2)
    whole = import_recordings(tmp_path / "out", tmp_path / "whole")
    assert [r.id for r in done.dataset.recordings] == [r.id for r in whole.dataset.recordings]
    assert [r.excluded for r in done.dataset.recordings] == [r.excluded for r in whole.dataset.recordings]
    assert raw(tmp_path / "DS") == raw(tmp_path / "whole")
    assert read_people(tmp_path / "DS") == read_people(tmp_path / "whole")


def test_a_take_made_again_later_is_set_aside_once(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out")
    import_recordings(tmp_path / "out", tmp_path / "DS")
    name = next(folder.glob("Tail*.csv")).name
    with (folder / "session.jsonl").open("a") as log:
        log.write(SessionEvent("redo", 5, {"file": name}).to_line())
    done = import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    (aside,) = [r for r in done.dataset.recordings if r.excluded]
    assert aside.file.endswith(name)
    append_marks(tmp_path / "DS", [Mark(aside.id, "include", "me", "it is good")])
    done = import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    assert not any(r.excluded for r in done.dataset.recordings), "what a person decided since stands"
    (log_there,) = (tmp_path / "DS" / "streams").rglob("session.jsonl")
    assert log_there.read_bytes() == (folder / "session.jsonl").read_bytes(), "the log went on"
    assert len((tmp_path / "DS" / "marks.jsonl").read_text().splitlines()) == 2


def test_two_imports_at_once(tmp_path: Path) -> None:
    put(tmp_path / "src" / "ana", "Shake", 1)
    import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3")
    with build._locked_work_folder(tmp_path / "DS"), pytest.raises(DatasetError, match="Another import is adding"):
        import_recordings(tmp_path / "src", tmp_path / "DS", add_to=True)


def test_gestures_that_are_new_keep_their_affect(tmp_path: Path, session_writer: Writer) -> None:
    session_writer(tmp_path / "out", "P01")
    import_recordings(tmp_path / "out", tmp_path / "DS")
    session_writer(tmp_path / "out", "P02", seed=1, gestures=("Kiss",))
    own = tmp_path / "own.toml"
    own.write_text('name = "own"\n[[gestures]]\nlabel = "Kiss"\naffect = "positive"\n')
    done = import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True, gestures=own)
    assert done.dataset.gestures.labels[-1] == "Kiss"
    assert done.dataset.gestures.get("Kiss").affect == "positive"
    assert done.warnings == ()
    assert json.loads(json.dumps(done.to_json()))["added"] == {"recordings": 1, "streams": 1}


def test_what_the_recorder_says_anew_is_marked_anew(tmp_path: Path) -> None:
    aside = {"a": "sneezed", "b": "sneezed", "c": "", "d": "", "e": "sneezed", "f": ""}
    decided = [
        ("b", "exclude", "recorder"),
        ("c", "exclude", "recorder"),
        ("d", "exclude", "me"),
        ("e", "include", "me"),
    ]
    append_marks(tmp_path, [Mark(*one) for one in decided])
    said = [(m.recording, m.action, m.who) for m in build._new_marks(read_marks(tmp_path), aside)]
    assert said == [("a", "exclude", "recorder"), ("c", "include", "recorder")]


def test_a_session_that_was_resumed_has_one_stream(tmp_path: Path, session_writer: Writer) -> None:
    folder = session_writer(tmp_path / "out")
    stream = folder / "fulldatastream.csv"
    whole = stream.read_bytes()
    lines = whole.splitlines(keepends=True)
    last = max(folder.glob("Hold*"), key=lambda p: p.suffix == ".csv")
    late = {p: p.read_bytes() for p in folder.glob("Hold*")}
    for path in late:
        path.unlink()
    # Killed in the middle of a line; the recorder cuts that line off when it goes on.
    stream.write_bytes(b"".join(lines[:140]) + lines[140][:20])
    import_recordings(tmp_path / "out", tmp_path / "DS")
    old = tmp_path / "old"
    (tmp_path / "out").rename(old)
    session_writer(tmp_path / "out")
    done = import_recordings(tmp_path / "out", tmp_path / "DS", add_to=True)
    assert [s.file for s in done.dataset.streams] == ["streams/P01/s1/fulldatastream.csv"]
    assert (tmp_path / "DS" / "streams" / "P01" / "s1" / "fulldatastream.csv").read_bytes() == whole
    assert [r.stream_row for r in done.dataset.recordings] == [160, 40]
    assert any(r.file.endswith(last.name) for r in done.dataset.recordings)
    again = import_recordings(old, tmp_path / "DS", add_to=True)
    assert again.dataset.streams == done.dataset.streams, "the shorter one of before is in it"
    other = [*lines[:3], b"1; 2\n", *lines[4:], *lines[:9]]
    (old / "P01" / "s1" / "fulldatastream.csv").write_bytes(b"".join(other))
    again = import_recordings(old, tmp_path / "DS", add_to=True)
    assert len(again.dataset.streams) == 2, "another stream of the same name is kept beside it"
