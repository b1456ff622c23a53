"""What goes wrong while recording is one sentence on the page, and nothing is lost by it."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, read_stream
from plushsense.devices.opening import open_device
from support.browsing import axe, connected, marked
from support.pty_toys import pty_toy
from support.recording_pages import (
    CALM,
    begun,
    choose,
    events,
    files,
    heard,
    sat,
    showing,
    take,
    tcp_toy,
    whats,
)
from support.waiting import until

pytestmark = pytest.mark.early

Fixture = Callable[..., Any]


def said(page: Any, text: str) -> None:
    """A sentence of this kind stands on the page, as an alert."""
    page.get_by_role("alert").filter(has_text=text).wait_for()


def beside(page: Any, field: str) -> Any:
    """The field with this name, if an error stands beside it."""
    return page.locator(".q-field--error", has=marked(page, field))


def fill(page: Any, code: str, toy: str = "") -> None:
    """The form, and the button."""
    marked(page, "code").fill(code)
    marked(page, "other_toy").fill(toy)
    marked(page, "begin").click()


def reconnected(page: Any) -> int:
    """How often the toy came back, as the page counts it."""
    found = re.search(r"reconnected (\d+)", marked(page, "counters").inner_text())
    assert found is not None
    return int(found[1])


@pytest.mark.exhaustive
def test_a_session_that_cannot_begin(studio: Fixture, look: Fixture, pty_possible: None, tmp_path: Path) -> None:
    home = tmp_path / "home"
    server, browser = studio("--device", CALM, "--speed", "10"), look()
    page = browser.open(server.url + "/record")
    fill(page, "Anna Bērziņa")
    said(page, "“Anna Bērziņa” is no code for a person")
    assert marked(page, "code").input_value() == "Anna Bērziņa", "what was typed stays"
    assert beside(page, "code").count() == 1
    assert axe(page) == []
    # A dead port, a port in use, and a toy of another layout, each beside the field of the toy.
    fill(page, "S01", "serial:///dev/nowhere7")
    said(page, "There is no port /dev/nowhere7")
    assert beside(page, "other_toy").filter(has_text="There is no port").count() == 1
    with pty_toy(tmp_path / "none.jsonl", 1.0) as toy, open_device(toy.url):
        fill(page, "S01", toy.url)
        said(page, "Another program is using")
    with tcp_toy(layout="plush-14") as url:
        fill(page, "S01", url)
        said(page, "not of the layout plush-15")
        assert not (home / "recordings").exists(), "no session begins with a toy that does not work"
        page.get_by_text("More settings").click()
        choose(page, "layout", "plush-14")
        marked(page, "begin").click()
        sat(page, "S01/1")
        assert "There is no consent number" in marked(page, "notice").inner_text()
        marked(page, "end").click()
        marked(page, "end-yes").click()
        page.wait_for_url("**/record?ended=S01/1")
    shutil.rmtree(home / "recordings")
    page.goto(server.url + "/record?new=1")
    connected(page)
    # A file where the folder should be.
    (home / "recordings").write_text("not a folder", encoding="utf-8")
    fill(page, "S01", CALM)
    said(page, "cannot be used")
    assert (home / "recordings").read_text("utf-8") == "not a folder"
    (home / "recordings").unlink()
    fill(page, "S01", CALM)
    sat(page, "S01/1")
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)
    fill(page, "S01")
    said(page, "has an unfinished session")
    page.get_by_role("button", name="Continue: S01/1").click()
    sat(page, "S01/1")
    page.goto(server.url + "/record?session=S09/1")
    connected(page)
    assert "no unfinished session S09/1" in marked(page, "message").inner_text()
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_a_toy_that_goes_away_and_comes_back(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    with tcp_toy() as url:
        server, browser = studio("--device", url), look()
        page = begun(browser.open(server.url + "/record"), server.url, "S01")
        before = reconnected(page)
        page.keyboard.press("Space")
        showing(page, "recording.0.")
    marked(page, "state").get_by_text("THE TOY IS AWAY").wait_for()
    page.wait_for_selector('[data-signal="none"]')
    # It cannot be exchanged for one that does not answer either, nor for a virtual one.
    marked(page, "change-toy").click()
    marked(page, "exchange-other_toy").fill("tcp://127.0.0.1:9")
    marked(page, "exchange-go").click()
    said(page, "The device 127.0.0.1 does not answer on port 9")
    marked(page, "exchange-other_toy").fill(CALM)
    marked(page, "exchange-go").click()
    said(page, "was begun with a real toy")
    assert axe(page) == []
    marked(page, "exchange-no").click()
    page.wait_for_timeout(1000)
    with tcp_toy(int(url.rpartition(":")[2])):
        heard(page)
        page.get_by_text("this recording has a gap").wait_for()
        page.wait_for_timeout(300)
        page.keyboard.press("Space")
        showing(page, "idle.1.1.")
        take(page, 1, 0.8)
        # A machine that stands still for a while may have lost it more than once.
        assert reconnected(page) > before
        with tcp_toy() as other:
            page.keyboard.press("p")
            showing(page, "paused.2.2.")
            marked(page, "change-toy").click()
            marked(page, "exchange-other_toy").fill(other)
            marked(page, "exchange-go").click()
            marked(page, "recorder-message").get_by_text("The session goes on with another toy").wait_for()
            page.wait_for_load_state("load")
            connected(page)
            heard(page)
            marked(page, "main").click()
            take(page, 2, 0.8)
    assert [e.details["device"] for e in events(home) if e.kind == "exchange"] == [other]
    assert [b["device"] for b in files(home)] == [url, url, other]
    gaps = [len(b["gaps"]) for b in files(home)]
    assert gaps == [1, 0, 0]
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    assert browser.complaints == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets another process's files be limited")
def test_a_full_disk(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    import resource

    home = tmp_path / "home"
    server, browser = studio("--device", CALM, "--speed", "10"), look()
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    take(page, 0)
    take(page, 1)
    stream = home / "recordings" / "S01" / "1" / STREAM_NAME
    # No file of the studio may grow beyond this: the same refusal as a full disk's, also for root.
    free = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (stream.stat().st_size + 20_000, free[1]))
    showing(page, "stopped.")
    page.get_by_text("cannot be written any more").first.wait_for()
    page.get_by_text("The session has stopped; recordings saved: 2").first.wait_for()
    assert axe(page) == []
    assert len(files(home)) == 2
    resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, free)
    marked(page, "main").click()
    page.wait_for_load_state("load")
    showing(page, "idle.2.2.")
    connected(page)
    heard(page)
    take(page, 2)
    take(page, 3)
    showing(page, "finished.")
    assert len(files(home)) == 4
    until(lambda: "finished" in whats(home))
    assert read_stream(stream, load_layout("plush-15")).malformed == 0
    assert browser.complaints == []
