"""What goes wrong while recording is one sentence on the page, and nothing is lost by it."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, read_stream
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import ToySpec
from plushsense.recording.session import OpenSession
from support.browsing import axe, connected, marked
from support.pty_toys import QUIET, pty_toy
from support.recording_pages import CALM, begun, choose, files, heard, sat, showing, take, until, whats

Fixture = Callable[..., Any]


@contextmanager
def tcp_toy(port: int = 0, speed: float = 1.0, layout: str = "plush-15", spec: ToySpec = QUIET) -> Iterator[str]:
    """A toy on a port of this machine: its URL."""
    stop, ready, urls = threading.Event(), threading.Event(), list[str]()

    def on_ready(url: str) -> None:
        urls.append(url)
        ready.set()

    options: dict[str, Any] = {"layout": load_layout(layout), "speed": speed, "on_ready": on_ready, "stop": stop}
    thread = threading.Thread(target=lambda: ToyServer(spec, **options).serve_tcp(port), daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield urls[0]
    finally:
        stop.set()
        thread.join(15)


def said(page: Any, text: str) -> None:
    """A sentence of this kind stands on the page, as an alert."""
    page.get_by_role("alert").filter(has_text=text).wait_for()


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


def test_a_session_that_cannot_begin(
    studio: Fixture, look: Fixture, pty_possible: None, tmp_path: Path, shots: Fixture
) -> None:
    home = tmp_path / "home"
    server, browser = studio("--device", CALM, "--speed", "10"), look()
    page = browser.open(server.url + "/record")
    for code in ("", "Anna Bērziņa", "Anna", "../../x1", "S01/2"):
        fill(page, code)
        said(page, "The session has no person" if not code else "is no code for a person")
        assert marked(page, "code").input_value() == code, "what was typed stays"
    assert axe(page) == []
    shots(page, "record-refused")
    fill(page, "S01", "replay:///etc/passwd")
    said(page, "refers to a file")
    fill(page, "S01", "serial:///dev/nowhere7")
    said(page, "there is no port")
    with pty_toy(tmp_path / "none.jsonl", 1.0) as toy, open_device(toy.url):
        fill(page, "S01", toy.url)
        said(page, "another program is using")
    assert not (home / "recordings").exists()
    # A file where the folder should be.
    home.mkdir(exist_ok=True)
    (home / "recordings").write_text("not a folder", encoding="utf-8")
    fill(page, "S01")
    said(page, "cannot be used")
    assert (home / "recordings").read_text("utf-8") == "not a folder"
    (home / "recordings").unlink()
    fill(page, "S01")
    sat(page, "S01/1")
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)
    # A terminal has it.
    held = OpenSession(home / "recordings" / "S01" / "1")
    try:
        page.get_by_role("button", name="Continue: S01/1").click()
        said(page, "Another program is recording")
    finally:
        held.close()
    fill(page, "S01")
    said(page, "has an unfinished session")
    page.get_by_role("button", name="Continue: S01/1").click()
    sat(page, "S01/1")
    page.goto(server.url + "/record?session=S09/1")
    connected(page)
    assert "no unfinished session S09/1" in marked(page, "message").inner_text()
    assert browser.complaints == []


def test_another_layout(studio: Fixture, look: Fixture, tmp_path: Path, shots: Fixture) -> None:
    with tcp_toy(layout="plush-14") as url:
        server, browser = studio("--device", url), look()
        page = browser.open(server.url + "/record")
        fill(page, "S01")
        page.wait_for_url("**/record?session=S01/1")
        page.wait_for_selector('[data-signal="unreadable"]')
        connected(page)
        assert "CANNOT BE READ" in marked(page, "state").inner_text()
        assert "There is no consent number" in marked(page, "notice").inner_text()
        page.keyboard.press("Space")
        page.get_by_text("none is a frame of plush-15").wait_for()
        assert axe(page) == []
        shots(page, "record-unreadable")
        marked(page, "end").click()
        marked(page, "end-yes").click()
        page.wait_for_url("**/record?ended=S01/1")
        connected(page)
        # The session keeps its layout; with the right one, a new session.
        page.get_by_text("More settings").click()
        choose(page, "layout", "plush-14")
        page.get_by_text("Begin a new session even if").click()
        fill(page, "S01")
        sat(page, "S01/2")
        assert browser.complaints == []


def test_a_toy_that_goes_away_and_comes_back(studio: Fixture, look: Fixture, tmp_path: Path, shots: Fixture) -> None:
    home = tmp_path / "home"
    with tcp_toy() as url:
        server, browser = studio("--device", url), look()
        page = begun(browser.open(server.url + "/record"), server.url, "S01")
        before = reconnected(page)
        page.keyboard.press("Space")
        showing(page, "recording.0.")
    marked(page, "state").get_by_text("THE TOY IS AWAY").wait_for()
    page.wait_for_selector('[data-signal="none"]')
    shots(page, "record-away")
    assert axe(page) == []
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
    gaps = [len(b["gaps"]) for b in files(home)]
    assert gaps == [1, 0]
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    assert browser.complaints == []


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets another process's files be limited")
def test_a_full_disk(studio: Fixture, look: Fixture, tmp_path: Path, shots: Fixture) -> None:
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
    page.get_by_text("the session has stopped, with 2 recordings saved").first.wait_for()
    assert axe(page) == []
    shots(page, "record-full-disk")
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
