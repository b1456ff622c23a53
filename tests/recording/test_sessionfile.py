import json
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.recording.writer import (
    SESSION_HEAD,
    SESSION_LOG,
    SessionEvent,
    SessionHead,
    discarded_recordings,
    read_events,
)

HEAD = SessionHead("P1", "session-1", 5, {"name": "l"}, {"name": "p"}, "child", consent="C-3", simulated=True)


def test_the_head_comes_back(tmp_path: Path) -> None:
    assert SessionHead.read(tmp_path) is None
    HEAD.write(tmp_path)
    assert SessionHead.read(tmp_path) == HEAD
    assert [p.name for p in tmp_path.iterdir()] == [SESSION_HEAD]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 9}, "format 1"),
        ({"subject": None}, "subject is None"),
        ({"simulated": 1}, "simulated is 1: accepted is true or false"),
        ({"colour": "red"}, "Unknown key 'colour'"),
    ],
)
def test_a_damaged_head_is_refused(tmp_path: Path, change: dict[str, object], said: str) -> None:
    HEAD.write(tmp_path)
    table = json.loads((tmp_path / SESSION_HEAD).read_text())
    (tmp_path / SESSION_HEAD).write_text(json.dumps(table | change))
    with pytest.raises(DatasetError, match=said):
        SessionHead.read(tmp_path)


def test_the_log_says_what_was_recorded_again(tmp_path: Path) -> None:
    assert list(read_events(tmp_path)) == []
    events = [
        SessionEvent("take", 1, {"file": "a.csv"}),
        SessionEvent("redo", 2, {"file": "a.csv"}),
        SessionEvent("redo", 3, {"file": "b.csv", "why": "sneezed"}),
    ]
    torn = b'{"what": "redo", "at_ms": 4, "file": "c.c'
    (tmp_path / SESSION_LOG).write_bytes("".join(e.to_line() for e in events).encode() + b"[]\n" + torn)
    assert list(read_events(tmp_path)) == events
    assert discarded_recordings(tmp_path) == {"a.csv": "recorded again", "b.csv": "sneezed"}
