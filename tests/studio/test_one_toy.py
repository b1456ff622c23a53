"""Two pages that need the same toy: every page names the use, and one button stops it and goes on."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plushsense.core.errors import ConfigError
from plushsense.studio.app.toys import ToyInUseError, Toys, ToyUse
from plushsense.studio.app.workspace import Workspace
from support.browsing import PHONE, axe, connected, english, marked
from support.recording_pages import choose, sat, showing, tcp_toy

if TYPE_CHECKING:
    from playwright.sync_api import Page

Fixture = Callable[..., Any]


def stop_and_go_on(page: Page, reason: str) -> None:
    """Press the button of the message that names the use of the toy."""
    message = marked(page, "message")
    message.get_by_text(reason).wait_for()
    message.get_by_role("button", name="Stop that and use the toy here").click()


def test_a_toy_in_use_is_named_and_freed_by_one_click(studio: Fixture, look: Fixture, home: Path) -> None:
    with tcp_toy() as toy:
        server, browser = studio("--device", toy, home=home), look()
        live, page = browser.open(f"{server.url}/live"), browser.open(f"{server.url}/record")
        assert not marked(page, "in-use").is_visible()
        marked(live, "start").click()
        marked(live, "stop").wait_for()
        marked(page, "in-use").get_by_text("Live now: Toy in the network ").wait_for()
        assert not marked(live, "in-use").is_visible()
        # The network was trained on virtual people, which the mark and the log say although the toy is real.
        marked(live, "simulation").get_by_text("this network was trained on virtual people").wait_for()
        marked(live, "events").locator("li[data-id]").first.wait_for()
        with live.expect_download() as saved:
            marked(live, "log-save").click()
        rows = list(csv.DictReader(Path(saved.value.path()).read_text("utf-8-sig").splitlines()))
        assert {row["simulated"] for row in rows} == {"yes"}
        # A test of the toy says why it cannot be made, and can be made after one click.
        page.goto(server.url)
        connected(page)
        marked(page, "test").click()
        marked(page, "trial").get_by_text(" is in use: the page Live reads it.").wait_for()
        assert axe(page) == []
        marked(page, "toy").get_by_role("button", name="Stop that and use the toy here").click()
        marked(page, "trial").get_by_text("The toy works").wait_for()
        marked(live, "start").click()
        marked(live, "stop").wait_for()
        # Record takes it from Live, and Live from Record, but not within a recording.
        page.goto(f"{server.url}/record")
        connected(page)
        marked(page, "code").fill("S01")
        choose(page, "protocol", "Short trial")
        marked(page, "begin").click()
        stop_and_go_on(page, "the page Live reads it")
        sat(page, "S01/1")
        marked(live, "in-use").get_by_text("Recording now: S01/1.").wait_for()
        page.keyboard.press("Space")
        showing(page, "recording.0.")
        marked(live, "start").click()
        stop_and_go_on(live, "the session S01/1 on the page Record reads it")
        marked(live, "message").get_by_text("S01/1 is recording a gesture just now").wait_for()
        page.wait_for_timeout(600)
        page.keyboard.press("Space")
        showing(page, "idle.1.")
        marked(live, "start").click()
        stop_and_go_on(live, "the session S01/1")
        marked(live, "stop").wait_for()
        page.wait_for_url("**/record?ended=S01/1")
        # The banner stops it from any page.
        marked(page, "in-use").get_by_role("button", name="Stop").click()
        marked(live, "start").wait_for()
        marked(page, "in-use").wait_for(state="hidden")
        marked(live, "start").click()
        latvian = look(PHONE, language="lv").open(server.url)
        marked(latvian, "test").click()
        marked(latvian, "trial").get_by_text("Tiešraide").wait_for()
        assert english(latvian) == [] and axe(latvian) == []
        assert latvian.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
        assert browser.complaints == []


@pytest.mark.early
def test_who_is_not_busy_makes_way(tmp_path: Path) -> None:
    toys = Toys(Workspace(tmp_path / "home"))
    with tcp_toy() as url:
        from plushsense.devices.opening import open_device

        def use(page: str, busy: bool, name: str = "") -> tuple[Any, list[str]]:
            stopped: list[str] = []

            def stop() -> None:
                stopped.append(page)
                device.close()

            opened = ToyUse(f"{url}?layout=plush-15", page, stop, name, lambda: busy)
            device = toys.open(opened, lambda: open_device(url))
            toys.update_uses()
            return device, stopped

        finished, ended = use("record", False, "S01/1")
        assert toys.in_use == ()
        assert toys.test(url).fits and ended == ["record"] and finished.closed
        device, kept = use("live", True)
        assert [each.page for each in toys.in_use] == ["live"]
        with pytest.raises(ToyInUseError, match="the page Live reads it"):
            toys.test(url)
        # A virtual toy is another one each time it is opened.
        assert toys.test("virtual://?speed=20").fits and kept == []
        device.close()
        assert toys.in_use == ()
        with pytest.raises(ConfigError):
            toys.open(ToyUse(url, "live", lambda: None), lambda: open_device("http://x"))
        assert toys.test(url).fits
