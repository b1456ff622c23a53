"""The first minute: three gestures are recorded, learnt and watched on one screen, and nothing is left unless kept."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from support.browsing import LONG_MS, PHONE, axe, english, marked

Fixture = Callable[..., Any]


def looked_at(page: Any, name: str) -> None:
    """Check accessibility and width, and keep a picture where wanted."""
    if folder := os.environ.get("PLUSHSENSE_LOOKS"):
        page.screenshot(path=f"{folder}/{name}.png", full_page=True)
    assert axe(page) == [], name
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name


def test_three_gestures_are_recorded_learnt_and_watched_by_two_clicks(
    studio: Fixture, look: Fixture, tmp_path: Path
) -> None:
    here = studio("--speed", "20")
    home = tmp_path / "home"
    browser = look()
    page = browser.open(here.url)
    marked(page, "try-three").click()
    marked(page, "trial-start").wait_for()
    looked_at(page, "choose")
    marked(page, "trial-start").click()
    marked(page, "trial-gesture").get_by_text("of 5").wait_for()
    looked_at(page, "record")
    # Another page shows the same trial, in its own language.
    other = look(PHONE, dark=True, language="lv").open(f"{here.url}/live?trial=1")
    assert english(other) == []
    marked(page, "trial-about").wait_for(timeout=LONG_MS)
    page.locator("[data-test=do-Tail\\ pull]").click()
    page.wait_for_function("() => window.plushsenseLive.updates > 5")
    looked_at(page, "live")
    marked(other, "trial-about").wait_for()
    assert english(other) == []
    looked_at(other, "live-phone")

    # The network is nowhere else, and the recordings are kept only on request, as any session.
    assert not list(home.glob("bundles/*")) and not list(home.glob("recordings/*"))
    marked(page, "trial-code").locator("input").or_(page.locator("input[data-test=trial-code]")).first.fill("Anna")
    marked(page, "trial-keep").click()
    page.get_by_text("is no code for a person").wait_for()
    page.locator("input[data-test=trial-code]").fill("S01")
    marked(page, "trial-keep").click()
    marked(page, "trial-kept").get_by_text("S01/1").wait_for()
    assert len(list((home / "recordings" / "S01" / "1").glob("*_*.csv"))) == 15
    marked(page, "trial-end").click()
    marked(other, "trial-start").wait_for()
    for _ in range(200):
        if not list((home / "work").glob(".unfinished-*")):
            break
        page.wait_for_timeout(50)
    assert not list((home / "work").glob(".unfinished-*")) and not list((home / "work").glob("*.json"))
    page.goto(here.url)
    marked(page, "next-sentence").get_by_text("not in a data set yet: 1 (recordings: 15)").wait_for()
    assert browser.complaints == []


def test_two_equal_gestures_are_refused_beside_their_fields(studio: Fixture, look: Fixture) -> None:
    page = look().open(f"{studio().url}/live?trial=1")
    marked(page, "gesture-2").click()
    page.get_by_role("option", name="Back stroke 1").click()
    marked(page, "trial-start").click()
    page.get_by_text("Choose three different gestures.").wait_for()
