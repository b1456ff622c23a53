"""Every page opens, in both languages and lights, and nothing on it is beyond reach."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from browsing import DESK, TABLET, axe, marked
from plushsense.apps.studio.shell import PAGES

Fixture = Callable[..., Any]


def test_pages_open_without_complaint(studio: Fixture, look: Fixture, shots: Fixture) -> None:
    url = studio().url
    for language, dark, size in (("en", False, DESK), ("lv", True, TABLET)):
        browser = look(size, dark, language)
        for name, path in PAGES.items():
            page = browser.open(url + path)
            assert marked(page, "title").inner_text()
            assert axe(page) == [], name
            shots(page, f"{name}-{language}-{'dark' if dark else 'light'}")
            page.close()
        assert browser.complaints == []


def test_language_and_light_are_kept(studio: Fixture, look: Fixture) -> None:
    page = look().open(studio().url)
    assert marked(page, "title").inner_text() == "Home"
    with page.expect_navigation():
        marked(page, "language").get_by_text("LV").click()
    assert marked(page, "title").inner_text() == "Sākums"
    with page.expect_navigation():
        marked(page, "light").click()
    page.wait_for_selector("body.body--dark")
    page.reload()
    assert marked(page, "title").inner_text() == "Sākums"
    assert page.locator("body.body--dark").count() == 1


@pytest.mark.parametrize("header", ["origin", "host"])
def test_a_foreign_page_is_refused(header: str, studio: Fixture) -> None:
    import urllib.error
    import urllib.request

    asked = urllib.request.Request(
        studio().url, headers={header: "http://evil.example" if header == "origin" else "evil.example"}
    )
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(asked, timeout=20)
    assert refused.value.code == 400


def test_a_furnished_home_opens(studio: Fixture, look: Fixture, home: Path) -> None:
    page = look().open(studio(home=home).url)
    assert marked(page, "title").inner_text() == "Home"
