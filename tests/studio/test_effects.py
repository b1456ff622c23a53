"""The effect of a click is in sight and has the focus, wherever on the page it appears."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from support.browsing import LONG_MS, PHONE, axe, connected, in_sight, marked

Fixture = Callable[..., Any]


@pytest.mark.usefixtures("publish_tools")
def test_the_effect_of_a_click_is_in_sight(studio: Fixture, look: Fixture, few: Path) -> None:
    server, browser = studio(home=few), look()
    page = browser.open(f"{server.url}/publish")
    for name in ("data-title", "description", "contact-name", "creator-name"):
        marked(page, name).fill("Ada")
    marked(page, "contact-mail").fill("ada@example.org")
    marked(page, "with-reidentification").click()
    marked(page, "name").fill("one")
    marked(page, "do").click()
    assert in_sight(page, "work"), "the progress of the package"
    marked(page, "validators").wait_for(timeout=LONG_MS)
    assert in_sight(page, "package"), "the package that was made"
    with page.expect_navigation():
        marked(page, "packages").get_by_role("link").first.click()
    connected(page)
    assert in_sight(page, "package"), "the package that was opened"
    # A job that takes long: its card has the focus, and what is said of it ends with it.
    page.goto(f"{server.url}/train")
    connected(page)
    marked(page, "more").click()
    marked(page, "make").click()
    assert in_sight(page, "job")
    going_on = page.get_by_text("You may close this page")
    going_on.wait_for()
    marked(page, "stop").click()
    page.locator("[data-state=stopped]").wait_for(timeout=LONG_MS)
    assert going_on.count() == 0 and marked(page, "message").count() == 0
    # On a phone, everything is in one column.
    phone = look(PHONE).open(server.url)
    marked(phone, "check").click()
    assert in_sight(phone, "work")
    assert axe(phone) == []
    assert browser.complaints == []


def test_the_page_does_not_move_under_a_pressed_button(studio: Fixture, look: Fixture, home: Path) -> None:
    server, browser = studio(home=home), look()
    page = browser.open(f"{server.url}/train")
    marked(page, "facts").get_by_text("Simulation:").wait_for()
    more = marked(page, "more")
    more.hover()
    page.mouse.down()
    marked(page, "make").press("Enter")
    marked(page, "job").get_by_text("testing on people left out").wait_for(timeout=LONG_MS)
    page.mouse.up()
    assert in_sight(page, "job"), "as soon as the button is released"
    marked(page, "start").wait_for()
    marked(page, "stop").click()
    page.locator("[data-state=stopped]").wait_for(timeout=LONG_MS)
    assert browser.complaints == []
