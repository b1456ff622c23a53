"""What is said before a session begins, and the sessions that lie there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.devices.opening import open_device
from plushsense.recording.recorder import AutoRecording, Recorder
from plushsense.recording.session import (
    SessionRequest,
    check_speed,
    is_pseudo_terminal,
    lacks_consent,
    list_sessions,
    session_folder,
    session_head,
    session_layout,
)

LAYOUT = load_layout("plush-15")
URL = "virtual://?speed=0&lost=0&garbled=0&glitch=0"


def test_a_head_says_what_was_said(tmp_path: Path) -> None:
    wanted = SessionRequest("serial:///dev/pts/3", "S01", "quick", "lv", consent="C-1", age_group="child")
    folder, known = session_folder(tmp_path, wanted)
    assert (folder, known) == (tmp_path / "S01" / "1", None)
    head = session_head(wanted, folder, True, LAYOUT, "test")
    assert (head.subject, head.session, head.simulated, head.protocol["words"]) == ("S01", "1", False, "lv")
    assert is_pseudo_terminal(wanted, head)
    assert not lacks_consent(head)
    assert session_head(SessionRequest("tcp://x:1", "S01", speed=2.0), folder, True, LAYOUT, "").simulated
    assert session_head(SessionRequest("tcp://x:1", "S01"), folder, True, LAYOUT, "").protocol["name"] == "plush-17"
    assert session_head(SessionRequest("tcp://x:1", "S01"), folder, False, LAYOUT, "").protocol == {}
    assert lacks_consent(session_head(SessionRequest("tcp://x:1", "S01"), folder, True, LAYOUT, ""))
    assert session_layout(SessionRequest(URL), folder, head) == LAYOUT
    assert session_layout(SessionRequest(URL), folder, None) is None


def test_what_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="The session has no person"):
        session_folder(tmp_path, SessionRequest(URL))
    assert session_folder(tmp_path, SessionRequest(URL, protocol="rest"))[0].parent.name == "none"
    with pytest.raises(DatasetError, match="no code"):
        session_folder(tmp_path, SessionRequest(URL, "Anna Berzina"))
    with pytest.raises(ConfigError, match="goes with --protocol"):
        session_head(SessionRequest(URL, "S01", words="lv"), tmp_path / "S01" / "1", False, LAYOUT, "")
    with pytest.raises(ConfigError, match="0 .* to 1000"):
        check_speed(-1)


@pytest.mark.slow
def test_sessions_that_lie_there(tmp_path: Path) -> None:
    wanted = SessionRequest(URL, "S01", "quick")
    folder, _ = session_folder(tmp_path, wanted)
    head = session_head(wanted, folder, True, LAYOUT, "test")
    with (
        open_device(URL) as device,
        Recorder.open(folder, device, head, speed=0, auto=AutoRecording(1.0, 0.1)) as recorder,
    ):
        recorder.wait("finished", timeout_s=30)
        shown = recorder.steps()
        assert shown[-1].file == recorder.status().file
        assert all(s.file and not s.skipped and s.discarded == 0 for s in shown)
        status = recorder.status()
        # Frames that the toy sends between the last step and this line are counted as well.
        assert status.frames >= status.rows > 0
        assert (status.bad_share_total, status.bad_share) == (0.0, 0.0)
        assert replace(status, lost=6, malformed=3, garbage=1, frames=90).bad_share_total == 0.1
        assert replace(status, frames=0).bad_share_total == 0.0
        # What a command may be given upon changes with whatever the command would mean.
        others = [replace(status, **{key: 1}) for key in ("redone", "skipped", "done")]
        assert len({s.seen for s in [status, replace(status, state="idle"), *others]}) == 5
        assert replace(status, rows=1, elapsed_s=2.0, message="x").seen == status.seen
        recorder.redo()
        assert [(bool(s.file), s.discarded) for s in recorder.steps()][-1] == (False, 1)
    before = {p: p.read_bytes() for p in folder.iterdir()}
    broken = tmp_path / "S02" / "1"
    broken.mkdir(parents=True)
    (broken / "session.json").write_text("{", encoding="utf-8")
    found = list_sessions(tmp_path)
    assert [(s.folder, s.done, s.steps, s.finished, bool(s.error)) for s in found] == [
        (folder, 3, 4, False, False), (broken, 0, 0, False, True),
    ]  # fmt: skip
    assert {p: p.read_bytes() for p in folder.iterdir()} == before
    assert list_sessions(tmp_path / "nowhere") == []
