"""Every page opens, in both languages and lights, and nothing on it is beyond reach."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from browsing import DESK, TABLET, Studio, axe, connected, marked
from plushsense.apps.studio.shell import LIGHT_COOKIE, PAGES

Fixture = Callable[..., Any]


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of an empty studio that all tests may look at."""
    one = Studio(tmp_path_factory.mktemp("empty") / "home").start()
    yield one.url
    one.stop()
    assert not [line for line in one.errors if "Traceback" in line], "".join(one.errors)


def test_pages_open_without_complaint(empty: str, look: Fixture, shots: Fixture) -> None:
    for language, dark, size in (("en", False, DESK), ("lv", True, TABLET)):
        browser = look(size, dark, language)
        for name, path in PAGES.items():
            page = browser.open(empty + path)
            assert marked(page, "title").inner_text()
            assert axe(page) == [], name
            shots(page, f"{name}-{language}-{'dark' if dark else 'light'}")
            page.close()
        assert browser.complaints == []


def test_language_and_light_are_kept(empty: str, look: Fixture) -> None:
    browser = look()
    page = browser.open(empty)
    assert marked(page, "title").inner_text() == "Home"
    assert page.title() == "Home · PlushSense"
    with page.expect_navigation():
        marked(page, "language").get_by_text("LV").click()
    assert marked(page, "title").inner_text() == "Sākums"
    assert page.title() == "Sākums · PlushSense"
    assert page.evaluate("document.documentElement.lang") == "lv"
    marked(page, "light").click()
    marked(page, "light-dark").wait_for()
    assert axe(page) == []
    with page.expect_navigation():
        marked(page, "light-dark").click()
    page.wait_for_selector("body.body--dark")
    page.reload()
    assert marked(page, "title").inner_text() == "Sākums"
    assert page.locator("body.body--dark").count() == 1
    connected(page)
    marked(page, "light").click()
    with page.expect_navigation():
        marked(page, "light-system").click()
    page.wait_for_selector("body.body--light")
    assert browser.complaints == []


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("chosen", ["", "light", "dark"])
def test_no_flash_of_the_wrong_light(dark: bool, chosen: str, empty: str, look: Fixture) -> None:
    """What stands there before any script has run is of the right light already."""
    browser = look(dark=dark)
    if chosen:
        browser.context.add_cookies([{"name": LIGHT_COOKIE, "value": chosen, "url": empty}])
    browser.context.route("**/*.js", lambda route: route.abort())
    page = browser.context.new_page()
    page.goto(empty, wait_until="commit")
    page.wait_for_selector("html > head > style", state="attached")
    page.wait_for_selector("#app", state="attached")
    night = page.evaluate("getComputedStyle(document.documentElement).backgroundColor") == "rgb(18, 18, 18)"
    assert night is (chosen == "dark" or (dark and not chosen))


def test_a_lost_connection_is_said_and_found_again(studio: Fixture, look: Fixture) -> None:
    one = studio()
    said = {"en": "connection to the studio is lost", "lv": "ir zudis"}
    pages = {language: look(language=language).open(one.url) for language in said}
    one.kill()
    for language, page in pages.items():
        box = page.locator('#popup[aria-hidden="false"]')
        box.wait_for()
        assert said[language] in box.inner_text()
        assert box.get_attribute("role") == "alert"
    one.start()
    for page in pages.values():
        connected(page)
        assert marked(page, "title").count() == 1


def test_the_first_key_leads_to_the_content(empty: str, look: Fixture) -> None:
    page = look().open(empty + PAGES["publish"])
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "content"
    assert page.get_by_role("main").count() == 1
    assert page.locator("[aria-current=page]").inner_text() == "Publish"


def test_the_bar_is_one_row_on_a_tablet(empty: str, look: Fixture) -> None:
    for language in ("en", "lv"):
        page = look(TABLET, language=language, touch=True).open(empty)
        tops = page.evaluate("[...document.querySelectorAll('.ps-bar a')].map(a => a.getBoundingClientRect().top)")
        assert len(set(tops)) == 1, language
        box = page.locator(".ps-header").bounding_box()
        assert box is not None and box["height"] < 70
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_nothing_is_made_where_the_studio_was_started(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    one = studio()
    look().open(one.url)
    assert [p.name for p in tmp_path.iterdir()] == ["home"]
    assert [p.name for p in (tmp_path / "home").iterdir()] == ["work"]


@pytest.mark.parametrize("header", ["origin", "host"])
def test_a_foreign_page_is_refused(header: str, empty: str) -> None:
    import urllib.error
    import urllib.request

    asked = urllib.request.Request(
        empty, headers={header: "http://evil.example" if header == "origin" else "evil.example"}
    )
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(asked, timeout=20)
    assert refused.value.code == 400


def test_a_furnished_home_opens(studio: Fixture, look: Fixture, home: Path) -> None:
    page = look().open(studio(home=home).url)
    assert marked(page, "title").inner_text() == "Home"
