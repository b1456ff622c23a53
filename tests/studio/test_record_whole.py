"""The paper's gestures with the space bar of a real browser, over a pseudo terminal: reloaded and the server killed on
the way. Each once; with PLUSHSENSE_SOAK it is the paper's session, 51 recordings, which the command makes in CI, too
(`tests/recording/test_whole_session.py`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.recorder_csv import parse_name
from plushsense.devices.virtual.session import GESTURES
from plushsense.recording.writer import SESSION_LOG, SessionHead, read_events
from support.browsing import connected, marked
from support.pty_toys import check_whole, pty_toy, recordings
from support.recording_pages import choose, showing, start_recording, stop
from support.requirements import LONG
from support.waiting import until

Fixture = Callable[..., Any]
pytestmark = [pytest.mark.usefixtures("pty_possible"), pytest.mark.early]
SPEED = 20.0
REPETITIONS = 3 if LONG else 1
TOTAL = REPETITIONS * len(GESTURES)
RELOADED, KILLED = TOTAL // 3, 2 * TOTAL // 3


def logged(folder: Path) -> list[str]:
    """What the log says so far."""
    return [e.kind for e in read_events(folder)]


@pytest.mark.exhaustive
def test_a_whole_session_by_the_space_bar(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    folder = tmp_path / "home" / "recordings" / "S01" / "1"
    own = tmp_path / "home" / "protocols" / "whole.toml"
    own.parent.mkdir(parents=True)
    own.write_text(f'name = "whole"\ngesture_set = "plush-18"\nrepetitions = {REPETITIONS}\n', encoding="utf-8")
    with pty_toy(folder / SESSION_LOG, SPEED) as toy:
        server = studio("--device", toy.url, "--speed", f"{SPEED:g}")
        browser = look()
        page = browser.open(server.url + "/record")
        marked(page, "code").fill("S01")
        choose(page, "protocol", "whole")
        page.get_by_text("More settings").click()
        page.get_by_text("This is a virtual toy").click()
        marked(page, "begin").click()
        page.wait_for_url("**/record?session=S01/1")
        connected(page)
        killed = False
        for number in range(TOTAL):
            runs = start_recording(page, number)
            if number == RELOADED:
                page.reload()
                connected(page)
                # It went on all the while; only a slow machine lets it end by itself.
                if showing(page, "recording.", "idle.").startswith("idle."):
                    continue
            elif number >= KILLED and not killed and runs:
                # The page shows the recording before the background thread has written its start to the log.
                until(lambda: logged(folder).count("start") > number)  # noqa: B023
                if logged(folder)[-1] != "start":
                    # A slow machine let it end by itself: another one is interrupted.
                    continue
                killed = True
                server.kill()
                server.start()
                # The page comes back by itself and offers to go on.
                page.get_by_role("button", name="Continue: S01/1").click()
                page.wait_for_selector('[data-test="state-box"]')
                connected(page)
                assert "interrupted" in marked(page, "notice").first.inner_text()
                runs = start_recording(page, number)
            if runs:
                stop(page)
            showing(page, f"idle.{number + 1}.", "finished.")
        showing(page, f"finished.{TOTAL - 1}.{TOTAL}.0.0")
        assert marked(page, "progress").inner_text() == f"{TOTAL} of {TOTAL} recorded"
        marked(page, "main").click()
        page.wait_for_url("**/record?ended=S01/1")
        assert f"S01/1 is finished: {TOTAL} of {TOTAL}" in marked(page, "message").inner_text()
    assert check_whole(folder, toy) == TOTAL
    made = Counter(n.label for p in recordings(folder) if (n := parse_name(p.name)) is not None)
    assert made == dict.fromkeys(GESTURES, REPETITIONS)
    events = Counter(e.kind for e in read_events(folder))
    assert (events["take"], events["redo"], events["unfinished"], events["finished"]) == (TOTAL, 0, 1, 1)
    head = SessionHead.read(folder)
    assert head is not None and head.simulated
    # The connection broke once; nothing else was wrong.
    assert [c for c in browser.complaints if "ERR_CONNECTION_REFUSED" not in c and "WebSocket" not in c] == []
