"""Taking up a session's folder: new, finished, interrupted, damaged, held by somebody else."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME
from plushsense.devices.base import Frame
from plushsense.recording.plan import load_protocol
from plushsense.recording.session import (
    LOCK,
    OpenSession,
    check_session,
    check_subject,
    is_finished,
    new_session,
    next_session,
    session_names,
)
from plushsense.recording.writer import (
    SESSION_LOG,
    SessionEvent,
    SessionHead,
    StreamFile,
    discarded_recordings,
    read_events,
    save_take,
    to_frames,
)

ACCEL = load_layout("accel-3")
HEAD = SessionHead(
    "S01", "1", 5, json.loads(json.dumps(ACCEL.to_dict())), load_protocol("quick").to_dict(), consent="C-1"
)
ROWS = [Frame(1000 + i, 10 * i, (i, i, i)) for i in range(20)]


def made(folder: Path, key: tuple[str, int], saved_ms: int, log: bool = True) -> Path:
    """A recording as the recorder leaves it."""
    more = {"gesture": key[0], "repetition": key[1]}
    path = save_take(folder, to_frames(ROWS[5:9], 3), ACCEL, key[0], saved_ms, more)
    if log:
        with (folder / SESSION_LOG).open("a", encoding="utf-8") as file:
            file.write(SessionEvent("take", saved_ms, more | {"file": path.name}).to_line())
    return path


def opened(folder: Path, *events: SessionEvent) -> OpenSession:
    """Take the session up, with these events in its log before."""
    with (folder / SESSION_LOG).open("a", encoding="utf-8") as file:
        file.writelines(e.to_line() for e in events)
    session = OpenSession(folder)
    session.close()
    return session


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session that was begun and has a stream."""
    folder = tmp_path / "S01" / "1"
    OpenSession(folder, HEAD).close()
    stream = StreamFile(folder / STREAM_NAME, ACCEL)
    stream.write(ROWS)
    stream.close()
    return folder


def test_a_new_one(tmp_path: Path) -> None:
    session = OpenSession(tmp_path / "S01" / "1", HEAD)
    assert (session.progress.resumed, session.progress.takes, session.progress.repairs) == (False, {}, [])
    assert session.protocol.name == "quick"
    session.close()
    session.close()
    assert SessionHead.read(tmp_path / "S01" / "1") == HEAD
    assert not (tmp_path / "S01" / "1" / LOCK).exists()


def test_it_goes_on_where_it_stood(folder: Path) -> None:
    first, second = made(folder, ("Back stroke 1", 1), 50), made(folder, ("Head stroke 1", 1), 60)
    skip = SessionEvent("skip", 70, {"gesture": "Hold strong", "repetition": 1})
    progress = opened(folder, skip, SessionEvent("redo", 80, {"file": second.name})).progress
    assert progress.takes == {("Back stroke 1", 1): first.name}
    assert progress.skipped == {("Hold strong", 1)}
    assert progress.discarded == {("Head stroke 1", 1): [second.name]}
    assert (progress.rows, progress.host_ms, progress.resumed, progress.repairs) == (20, 1019, True, [])
    assert (
        opened(folder, SessionEvent("keep", 90, {"file": second.name})).progress.takes[("Head stroke 1", 1)]
        == second.name
    )


def test_a_torn_stream_is_cut_to_whole_lines_and_the_log_keeps_the_rest(folder: Path) -> None:
    path = folder / STREAM_NAME
    whole = path.read_bytes()
    path.write_bytes(whole + b"1020, 20")
    progress = OpenSession(folder)
    progress.close()
    assert path.read_bytes() == whole
    (event,) = [e for e in read_events(folder) if e.kind == "mended"]
    assert (event.details["bytes"], event.details["text"]) == (8, "1020, 20")
    assert len(progress.progress.repairs) == 1
    path.write_bytes(b"10")
    assert opened(folder).progress.rows == 0


def test_a_torn_line_of_the_log_is_passed_over(folder: Path) -> None:
    path = made(folder, ("Back stroke 1", 1), 50)
    with (folder / SESSION_LOG).open("ab") as file:
        file.write(b'{"what": "take", "at_ms": 4, "fil')
    session = OpenSession(folder)
    session.log.write([SessionEvent("note", 1, {"text": "after"})])
    session.close()
    assert session.progress.takes == {("Back stroke 1", 1): path.name}
    assert [e.kind for e in read_events(folder)] == ["take", "note"]


def test_a_recording_that_the_log_does_not_know_is_taken_in(folder: Path) -> None:
    """Killed between the recording and its line in the log; it was made again, so the earlier one is set aside."""
    earlier = made(folder, ("Back stroke 1", 1), 50)
    later = made(folder, ("Back stroke 1", 1), 60, log=False)
    assert opened(folder).progress.takes == {("Back stroke 1", 1): later.name}
    assert discarded_recordings(folder) == {earlier.name: "recorded again"}
    assert opened(folder).progress.takes == {("Back stroke 1", 1): later.name}


def test_what_was_begun_is_to_be_made_again(folder: Path) -> None:
    start = SessionEvent("start", 50, {"gesture": "Hold strong", "repetition": 1, "row": 3})
    progress = opened(folder, start).progress
    assert progress.takes == {}
    assert "record it again" in progress.repairs[0]
    assert [e.kind for e in read_events(folder)] == ["start", "unfinished"]
    assert opened(folder).progress.repairs == []


def test_what_is_half_goes_and_what_is_damaged_is_set_aside(folder: Path) -> None:
    for name in ("Hold strong_9_4.json.part", "Hold strong_9_4.csv.new", "Hold strong_9_4.json"):
        (folder / name).write_text("{}")
    cut = made(folder, ("Head stroke 1", 1), 60)
    cut.write_bytes(cut.read_bytes()[:-20])
    gone = made(folder, ("Tail tap 1", 1), 70)
    gone.unlink()
    progress = opened(folder).progress
    assert progress.takes == {}
    assert len(progress.repairs) == 2
    assert sorted(p.name for p in folder.iterdir()) == [
        cut.name + ".torn", cut.with_suffix(".json").name, gone.with_suffix(".json").name, STREAM_NAME,
        "session.json", "session.jsonl",
    ]  # fmt: skip


def test_a_recording_that_was_away_and_is_back_does_not_replace_the_newer(folder: Path) -> None:
    first = made(folder, ("Back stroke 1", 1), 50)
    rows = first.read_bytes()
    first.unlink()
    assert opened(folder).progress.takes == {}
    assert first.with_suffix(".json").exists()
    second = made(folder, ("Back stroke 1", 1), 60)
    first.write_bytes(rows)
    for _ in range(2):
        progress = opened(folder).progress
        assert progress.takes == {("Back stroke 1", 1): second.name}
        assert progress.discarded == {("Back stroke 1", 1): [first.name]}
    assert discarded_recordings(folder) == {first.name: "made again"}


def test_a_log_that_lost_lines_is_survived(folder: Path) -> None:
    """Whatever is left of a log, in whatever order: a session opens, and no recording on disk is forgotten."""
    a, b = made(folder, ("Back stroke 1", 1), 50), made(folder, ("Back stroke 1", 1), 60)
    words = [
        SessionEvent(what, 70, {"file": file, "gesture": "Back stroke 1", "repetition": 1}).to_line()
        for what in ("take", "redo", "keep", "start", "skip", "abandon", "go")
        for file in (a.name, b.name, "x", "")
    ] + ["{}\n", "[]\n", "\x00\x00", '{"what": "keep", "at_ms": "x"}\n']
    rng = random.Random(5)
    for _ in range(60):
        (folder / SESSION_LOG).write_text("".join(rng.choices(words, k=rng.randrange(12))))
        progress = opened(folder).progress
        known = set(progress.takes.values()) | {f for files in progress.discarded.values() for f in files}
        assert {a.name, b.name} <= known
        assert set(progress.takes.values()) <= {a.name, b.name}
        assert a.exists() and b.exists()


def test_a_second_program_is_refused(folder: Path) -> None:
    session = OpenSession(folder)
    code = (
        "import sys; from pathlib import Path\n"
        "from plushsense.recording.session import OpenSession\n"
        "from plushsense.core.errors import DatasetError\n"
        "try: OpenSession(Path(sys.argv[1]))\n"
        "except DatasetError as refusal: print(refusal)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True)
    session.close()
    assert "Another program is recording" in done.stdout
    OpenSession(folder).close()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"protocol": load_protocol("rest").to_dict()}, "protocol 'quick', not 'rest'"),
        ({"protocol": load_protocol("quick").to_dict() | {"repetitions": 2}}, "another one of that name"),
        ({"layout": load_layout("plush-15").to_dict()}, "layout 'accel-3', not 'plush-15'"),
        ({"consent": "C-2"}, "consent 'C-1', not 'C-2'"),
        ({"subject": "S02"}, "subject 'S01', not 'S02'"),
        ({"simulated": True}, "real toy"),
    ],
)
def test_another_session_is_not_mixed_in(folder: Path, change: dict[str, object], said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        OpenSession(folder, replace(HEAD, **change))  # type: ignore[arg-type]
    OpenSession(folder, HEAD).close()


def test_what_was_left_out_may_be_said_later(folder: Path) -> None:
    OpenSession(folder, SessionHead("S01", "1", 9, {}, {}, age_group="child")).close()
    assert SessionHead.read(folder) == replace(HEAD, age_group="child")


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "fulldatastream.csv").write_text("1, 2\n")
    with pytest.raises(DatasetError, match="but no session"):
        OpenSession(tmp_path, HEAD)
    with pytest.raises(DatasetError, match="holds no session"):
        OpenSession(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="cannot be used"):
        OpenSession(tmp_path / "file" / "x", HEAD)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "fulldatastream.csv"]


def test_which_session_comes_next(tmp_path: Path) -> None:
    person = tmp_path / "S01"
    assert next_session(person) == "1"
    for name, started in (("1", 5), ("autumn", 4)):
        OpenSession(person / name, replace(HEAD, session=name, started_ms=started)).close()
    assert session_names(person) == ["autumn", "1"]
    other = tmp_path / "S02"
    for name, started in (("9", 50), ("10", 40)):
        OpenSession(other / name, replace(HEAD, subject="S02", session=name, started_ms=started)).close()
    assert session_names(other) == ["9", "10"], "the computer's clock was set back between them"
    assert (next_session(person), new_session(person)) == ("1", "2")
    opened(person / "1", SessionEvent("finished", 9))
    assert next_session(person) == "2"
    opened(person / "1", SessionEvent("redo", 10, {"file": "x"}))
    assert not is_finished(person / "1")


def test_a_folder_in_which_no_session_could_begin_is_used(tmp_path: Path) -> None:
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / ".session.json.0a1b2c3d.part").touch()
    assert new_session(tmp_path) == "1"
    (tmp_path / "1" / "thesis.txt").touch()
    (tmp_path / "2").mkdir()
    with FileLock(tmp_path / "2" / "session.lock"):
        assert new_session(tmp_path) == "3", "another program is about to begin there"


@pytest.mark.parametrize("code", ["S01", "none", "7", "P1-b", "child_3", "AB"])
def test_a_code(code: str) -> None:
    assert check_subject(code) == code


@pytest.mark.parametrize(
    "code", ["Anna", "Anna Miller", "", "../S01", "S01/x", "a" * 16 + "1", "Jürgen1", "COM1", "-1"]
)
def test_no_code(code: str) -> None:
    with pytest.raises(DatasetError, match="is no code for a person"):
        check_subject(code)


def test_a_sessions_name_is_a_folders_name() -> None:
    assert check_session("autumn-2") == "autumn-2"
    for name in ("", "..", "a/b", "a b", "x" * 33, "NUL", "com1"):
        with pytest.raises(DatasetError, match="no name for a session"):
            check_session(name)


def test_the_head_keeps_the_resolved_protocol(folder: Path) -> None:
    table = json.loads((folder / "session.json").read_text())
    assert table["protocol"]["prompts"]["Hold strong"].startswith("Hold the toy")
    assert table["layout"]["name"] == "accel-3"
