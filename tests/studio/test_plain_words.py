"""What the pages call things, and what a toy at rest looks like, as somebody who does not program reads it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from plushsense.studio.app.words import Words
from plushsense.studio.pages.live.event_log import log_csv
from plushsense.studio.pages.live.live_state import EventSpan
from support.browsing import LONG_MS, axe, connected, in_sight, marked
from support.recording_pages import begun

Fixture = Callable[..., Any]
_SPREAD = """name => {
  const u = document.querySelector(`[data-test="${name}"]`).psPlot.u, { min, max } = u.scales.y;
  return Math.max(...u.data.slice(1).map((y) => Math.max(...y) - Math.min(...y))) / (max - min) }"""
"""What share of a plot's height its highest curve takes."""

_TWICE = """() => {
  const twice = (all, name) => {
    const names = [...document.querySelectorAll(all)].filter((e) => e.checkVisibility()).map(name).filter(Boolean);
    return names.filter((each, n) => names.indexOf(each) !== n);
  };
  const label = (e) => e.getAttribute('aria-label') || e.closest('label')?.innerText.trim();
  return [...twice('h1, h2, h3, [role=heading]', (e) => e.innerText.trim()),
    ...twice('[role=combobox], input:not([type=file])', label)] }"""
"""Names of headings and fields that a page has twice."""


def test_the_log_of_a_session_opens_in_a_latvian_spreadsheet() -> None:
    named = EventSpan(1, 1, 1, 2.5, "positive", "Tail tap 1", "cnn", 4.0, 0.75)
    events = (named, EventSpan(2, 2, 2, 9.0, "none", None, "gate"))
    head, first, second = log_csv(Words("lv"), events).splitlines()
    assert head.startswith("\ufefftime;toy_s;lasted_s;")
    assert first.split(";")[1:7] == ["2,50", "1,50", "Tail tap 1", "positive", "0,750", "tīkls"]
    assert second.split(";")[2:7] == ["", "", "none", "", "noteikumi"]
    assert ",2.50,1.50,Tail tap 1,positive,0.750,network," in log_csv(Words("en"), events)


def test_no_heading_or_field_has_the_name_of_another(studio: Fixture, look: Fixture, home: Path) -> None:
    server, browser = studio(home=home), look()
    page = browser.open(server.url)
    for path in ("/", "/record?new=1", "/review", "/train", "/live", "/export", "/publish"):
        page.goto(server.url + path)
        connected(page)
        assert page.evaluate(_TWICE) == [], path
    page.goto(server.url + "/train")
    connected(page)
    assert page.get_by_role("region", name="Results", exact=True).count() == 1
    # Two trainings at once on two cores take twice as long: a question first.
    marked(page, "facts").get_by_text("Simulation:").wait_for()
    marked(page, "make").click()
    assert in_sight(page, "job")
    marked(page, "more").click()
    marked(page, "start").click()
    marked(page, "ask").get_by_text("two jobs at once").wait_for()
    assert axe(page) == []
    page.get_by_role("button", name="Cancel").click()
    marked(page, "stop").click()
    page.locator("[data-state=stopped]").wait_for(timeout=LONG_MS)
    assert page.locator("[data-job]").count() == 1
    assert browser.complaints == []


def test_a_session_is_named_in_plain_words_and_rests_quietly(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio("--device", "virtual://?person=7&lost=0&garbled=0&glitch=0", "--speed", "4"), look()
    page = browser.open(server.url)
    marked(page, "chosen").get_by_text("Chosen: Virtual toy (simulation), person 7").wait_for()
    page.goto(server.url + "/record?new=1")
    connected(page)
    assert marked(page, "toy").input_value() == "Virtual toy (simulation), person 7"
    begun(page, server.url, "S01")
    texts = page.locator("body").inner_text()
    assert "extremities" in texts and "cap_" not in texts and "acc_" not in texts
    marked(page, "steps").locator("summary").click()
    assert "✓ recorded · – skipped · ○ not recorded yet · ▶ now" in marked(page, "steps").inner_text()
    # The proximity sensor at rest: a flat line, unless small changes are enlarged.
    marked(page, "plot-proximity").locator(".u-marker").wait_for()
    page.wait_for_function(f"() => ({_SPREAD})('plot-proximity') < 0.35")
    marked(page, "enlarge").click()
    page.wait_for_function(f"() => ({_SPREAD})('plot-proximity') > 0.8")
    markers = page.locator(".u-marker").evaluate_all("all => all.map(m => m.getBoundingClientRect().height)")
    assert markers and max(markers) < 6, "the legend is no row of check boxes"
    assert axe(page) == []
    assert browser.complaints == []


def test_a_review_is_named_in_plain_words_and_rest_is_flat(studio: Fixture, look: Fixture, home: Path) -> None:
    server, browser = studio(home=home), look()
    at = f"{server.url}/review?dataset={home / 'datasets' / 'virtual'}"
    page = browser.open(at)
    assert marked(page, "who").input_value() not in ("root", "administrator")
    table = page.locator("caption").first.inner_text()
    assert table == "Recordings (+ positive, ○ neutral, − negative, · none)"
    marked(page, "making").get_by_text("Checking").wait_for(state="detached", timeout=LONG_MS)
    marked(page, "accept-sure").click()
    message = marked(page, "message")
    message.get_by_text("Starts accepted: ").wait_for()
    assert "Still to decide: " in message.inner_text() and "Choose “One by one”" in message.inner_text()
    page.goto(f"{at}&gesture=At%20rest&view=one")
    connected(page)
    marked(page, "plot").locator("canvas").wait_for()
    page.wait_for_function(f"() => ({_SPREAD})('plot') < 0.06")
    assert "At rest, neutral" in marked(page, "one").inner_text()
    marked(page, "enlarge").click()
    page.wait_for_function(f"() => ({_SPREAD})('plot') > 0.15")
    assert axe(page) == []
    assert browser.complaints == []
