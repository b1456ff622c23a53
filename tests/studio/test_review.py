"""Reviewing in a real browser: by real clicks, by keys alone, and when something stands in the way."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks, read_marks
from plushsense.dataset.trimming import row_times_s, suggest_trims
from support.browsing import DESK, PHONE, TABLET, axe, connected, marked
from support.reviewed import ROW_S, made, marks, raw_hash, streamed

pytestmark = pytest.mark.early

if TYPE_CHECKING:
    from playwright.sync_api import Page

Fixture = Callable[..., Any]
PLOT = "[data-test=plot]"


@pytest.fixture
def waves(tmp_path: Path) -> Path:
    """The data set of `reviewed.made` in a studio's folder: 24 recordings."""
    made(tmp_path / "home" / "datasets" / "waves")
    return tmp_path / "home" / "datasets" / "waves"


def opened(page: Page) -> str:
    """The id of the recording that is drawn."""
    page.wait_for_function(
        f"() => document.querySelector('{PLOT}')?.psPlot?.u && document.querySelector('{PLOT}').dataset.recording"
    )
    return shown(page)


def shown(page: Page) -> str:
    return str(page.locator(PLOT).get_attribute("data-recording"))


def pressed(page: Page, key: str) -> str:
    """Press a key and wait for another recording."""
    was = shown(page)
    page.keyboard.press(key)
    page.wait_for_function("([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, was])
    return shown(page)


def checked(page: Page) -> None:
    """Until everything was looked at in the background."""
    page.wait_for_function("() => document.querySelector('[data-test=making]')?.textContent === ''")


def state(page: Page, key: str) -> None:
    page.wait_for_selector(f"[data-test=state][data-state={key}]")


def x_of(page: Page, fraction: float) -> tuple[float, dict[str, int]]:
    """A place in the plot: its second by the axis, and where to click, in pixels of the plot."""
    box = page.locator(f"{PLOT} .u-over").bounding_box()
    assert box is not None
    low, high = page.evaluate(
        f"() => {{ const s = document.querySelector('{PLOT}').psPlot.u.scales.x; return [s.min, s.max] }}"
    )
    pixel = round(fraction * box["width"])
    return low + (high - low) * pixel / box["width"], {"x": pixel, "y": int(box["height"] // 2)}


@pytest.mark.parametrize("size", [DESK, TABLET, (1600, 900)])
@pytest.mark.exhaustive
def test_a_click_moves_the_mark_to_within_a_sample(
    size: tuple[int, int], waves: Path, studio: Fixture, look: Fixture
) -> None:
    browser = look(size, touch=size == TABLET)
    page = browser.open(studio(home=waves.parents[1]).url + "/review?view=one&gesture=Wave")
    over = page.locator(f"{PLOT} .u-over")
    wanted = {}

    def click(fraction: float, **how: Any) -> float:
        second, at = x_of(page, fraction)
        over.click(position=at, **how)
        return second

    first = opened(page)
    checked(page)
    start = click(0.217)
    state(page, "draft")
    wanted[first] = (start, click(0.83, modifiers=["Shift"]))
    wait_for_kept(page, wanted[first][1])
    second = pressed(page, "Enter")
    # Closer: fewer rows a pixel; then in another width.
    page.keyboard.press("+")
    page.keyboard.press("+")
    page.wait_for_function(
        "() => { const {min, max} = document.querySelector('[data-test=plot]').psPlot.u.scales.x;"
        " return max - min < 1 }"
    )
    start = click(0.341)
    state(page, "draft")
    page.keyboard.press("0")
    wanted[second] = (start, click(0.9, button="right"))
    wait_for_kept(page, wanted[second][1])
    page.set_viewport_size({"width": size[0] - 133, "height": size[1]})
    third = pressed(page, "Enter")
    page.wait_for_function(
        f"() => document.querySelector('{PLOT}').psPlot.u.width === document.querySelector('{PLOT}').clientWidth"
    )
    start = click(0.5)
    state(page, "draft")
    marked(page, "side").get_by_text("End").click()
    wanted[third] = (start, click(0.77))
    wait_for_kept(page, wanted[third][1])
    marked(page, "accept").click()
    page.wait_for_function("([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, third])

    dataset, standing = open_dataset(waves), read_marks(waves)
    assert set(standing) == set(wanted)
    infos = {r.id: r for r in dataset.recordings}
    for identity, (begin_s, end_s) in wanted.items():
        seconds = row_times_s(dataset.read(infos[identity]), dataset.layout.gap_ms)
        begin = next(r for r in suggest_trims(dataset, [infos[identity]])).current_rows()
        at = (read_marks(waves)[identity].start, read_marks(waves)[identity].stop)
        assert at == begin
        assert abs(at[0] * ROW_S - begin_s) <= ROW_S, (identity, at, begin_s)
        assert abs(at[1] * ROW_S - end_s) <= ROW_S, (identity, at, end_s)
        assert seconds[1] == pytest.approx(ROW_S)
        assert standing[identity].how == "hand"
    assert browser.complaints == []


def wait_for_kept(page: Page, stop_s: float) -> None:
    """Until the page says that what is kept ends there, to a sample."""
    page.wait_for_function(
        """(stop) => { const said = document.querySelector('[data-test=about]').textContent.match(/to ([0-9.]+) s/);
                       return said && Math.abs(parseFloat(said[1]) - stop) <= 0.0151 }""",
        arg=stop_s,
    )


def test_twenty_recordings_by_keyboard_alone(waves: Path, studio: Fixture, look: Fixture) -> None:
    before = raw_hash(waves)
    suggestions = {t.recording.id: t for t in suggest_trims(open_dataset(waves))}
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review")
    page.wait_for_selector("[data-test=table] tbody tr")
    checked(page)
    # To the button and through it with keys alone.
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.dataset.test") == "start":
            break
    page.keyboard.press("Enter")
    at = opened(page)
    expected = []
    for number in range(20):
        suggested = suggestions[at].suggestion
        rows = suggestions[at].recording.rows
        start, how = (suggested.start, "suggested") if suggested.onset_visible else (0, "hand")
        if number % 5 == 3:
            page.keyboard.press("x")
            page.wait_for_selector("[data-test=reason]")
            page.wait_for_function("() => document.activeElement.closest('[data-test=reason]')")
            expected.append((at, "exclude", 0, -1, "", "wrong gesture"))
            at = pressed(page, "Enter")
            continue
        stop = -1
        if number % 4 == 1:
            page.keyboard.press("ArrowRight")
            page.keyboard.press("ArrowRight")
            page.keyboard.press("Shift+ArrowLeft")
            page.wait_for_function(
                "end => document.querySelector('[data-test=about]').textContent.includes(`to ${end} s`)",
                arg=f"{(rows - 1) * ROW_S:.2f}",
            )
            start, stop, how = start + 2, rows - 1, "hand"
        expected.append((at, "trim", start, stop, how, ""))
        at = pressed(page, "Enter")
    said = [(m["recording"], m["action"], m["start"], m["stop"], m["how"], m["why"]) for m in marks(waves)]
    assert said == expected
    assert len({recording for recording, *_ in said}) == 20
    assert marked(page, "counts").inner_text() == "20 of 24 decided, 4 to do"
    # Back through them, and everything taken back one by one.
    for recording, *_ in reversed(expected):
        assert pressed(page, "Backspace") == recording
    for left in range(19, -1, -1):
        page.keyboard.press("u")
        page.wait_for_function(
            "said => document.querySelector('[data-test=counts]').textContent === said",
            arg=f"{left} of 24 decided, {24 - left} to do",
        )
    assert not any(s.trimmed or s.excluded for s in read_marks(waves).values())
    assert raw_hash(waves) == before
    page.keyboard.press("u")
    page.get_by_text("There is nothing left to undo").wait_for()
    assert browser.complaints == []


def test_keys_are_no_commands_while_something_else_has_them(waves: Path, studio: Fixture, look: Fixture) -> None:
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review?view=one&gesture=Wave")
    first = opened(page)
    checked(page)
    name = marked(page, "who")
    name.fill("Ruta")
    name.press("x")
    name.press("Enter")
    name.press("Backspace")
    page.wait_for_timeout(300)
    assert shown(page) == first and marks(waves) == []
    # A button that has the focus does its own, once.
    marked(page, "accept").focus()
    second = pressed(page, "Enter")
    page.wait_for_timeout(300)
    assert shown(page) == second
    assert [(m["recording"], m["who"]) for m in marks(waves)] == [(first, "Ruta")]
    # After a click of the mouse, keys are commands again.
    marked(page, "accept").click()
    page.wait_for_function(
        "([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, second]
    )
    third = shown(page)
    assert pressed(page, "Enter") != third
    page.wait_for_timeout(300)
    assert [m["recording"] for m in marks(waves)] == [first, second, third]
    # Held down, nothing is decided unseen; twice at once, only what was seen.
    fourth = shown(page)
    page.evaluate(
        """() => { for (const repeat of [false, true, true]) document.body.dispatchEvent(
                   new KeyboardEvent('keydown', {key: 'Enter', repeat, bubbles: true})) }"""
    )
    page.wait_for_function(
        "([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, fourth]
    )
    page.wait_for_timeout(300)
    assert [m["recording"] for m in marks(waves)] == [first, second, third, fourth]
    # The name is kept by the browser; the place by the address.
    at = shown(page)
    page.reload()
    connected(page)
    assert opened(page) == at
    assert marked(page, "who").input_value() == "Ruta"
    page.keyboard.press("u")
    page.wait_for_function(
        "([plot, was]) => document.querySelector(plot).dataset.recording === was", arg=[PLOT, fourth]
    )
    assert marks(waves)[-1]["action"] == "untrim", "a visit goes on after a reload"
    assert browser.complaints == []


def test_excluding_needs_a_reason_and_is_taken_back(waves: Path, studio: Fixture, look: Fixture) -> None:
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review?view=one")
    first = opened(page)
    checked(page)
    page.keyboard.press("x")
    marked(page, "reason-go").click()
    page.get_by_text("A reason is missing").wait_for()
    assert axe(page) == []
    marked(page, "own-reason").fill("a dog barked")
    marked(page, "own-reason").press("Enter")
    page.wait_for_function("([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, first])
    assert [(m["recording"], m["action"], m["why"]) for m in marks(waves)] == [(first, "exclude", "a dog barked")]
    assert pressed(page, "Backspace") == first
    state(page, "excluded")
    page.keyboard.press("x")
    state(page, "none" if "Rest" in first else "suggested")
    page.keyboard.press("u")
    state(page, "excluded")
    page.keyboard.press("u")
    page.wait_for_selector("[data-test=state]:not([data-state=excluded])")
    assert [m["action"] for m in marks(waves)] == ["exclude", "include", "exclude", "include"]
    page.keyboard.press("x")
    page.wait_for_selector("[data-test=reason]")
    page.keyboard.press("Escape")
    page.wait_for_selector("[data-test=reason]", state="detached")
    assert len(marks(waves)) == 4
    assert browser.complaints == []


def test_a_finding_is_accepted_with_a_reason(waves: Path, studio: Fixture, look: Fixture) -> None:
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review?check=duration&severity=warning")
    page.wait_for_selector("[data-test=table]")
    checked(page)
    page.wait_for_selector("[data-test=table] tbody tr")
    page.locator(".ps-open").first.click()
    odd = opened(page)
    found = page.locator("[data-check=duration]")
    assert "more than the mean" in found.inner_text()
    found.get_by_role("button").click()
    page.get_by_role("button", name="this person's way").click()
    page.wait_for_selector("[data-check=duration]:has-text('accepted as harmless')")
    assert [(m["recording"], m["action"], m["check"], m["why"]) for m in marks(waves)] == [
        (odd, "accept", "duration", "this person's way of doing it")
    ]
    page.locator("[data-check=duration]").get_by_role("button").click()
    page.wait_for_selector("[data-check=duration]:has-text('Harmless …')")
    assert marks(waves)[-1]["action"] == "unaccept"
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_the_table_filters_sorts_and_says_what_it_shows(waves: Path, studio: Fixture, look: Fixture) -> None:
    append_marks(waves, [Mark(open_dataset(waves).recordings[0].id, "exclude", "x", "y")])
    url = studio(home=waves.parents[1]).url
    for language, dark, size in (("en", False, DESK), ("lv", True, TABLET)):
        browser = look(size, dark, language)
        page = browser.open(url + "/review")
        page.wait_for_selector("[data-test=table] tbody tr")
        checked(page)
        assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth"), "no sideways scrolling"
        assert axe(page) == []
        assert browser.complaints == []
    page = look().open(url + "/review")
    rows = page.locator("[data-test=table] tbody tr")
    rows.first.wait_for()
    checked(page)
    assert rows.count() == 24
    marked(page, "filters").click()
    marked(page, "filter-person").click()
    page.get_by_role("option", name="P2", exact=True).click()
    page.wait_for_function("() => document.querySelectorAll('[data-test=table] tbody tr').length === 8")
    marked(page, "filter-text").fill("wave")
    page.wait_for_function("() => document.querySelectorAll('[data-test=table] tbody tr').length === 7")
    assert marked(page, "range").inner_text() == "1–7 of 7"
    page.wait_for_function("() => location.search.includes('person=P2') && location.search.includes('text=wave')")
    page.reload()
    connected(page)
    page.wait_for_function("() => document.querySelectorAll('[data-test=table] tbody tr').length === 7")
    page = look().open(url + "/review?state=excluded")
    page.wait_for_function("() => document.querySelectorAll('[data-test=table] tbody tr').length === 1")
    assert "✕ excluded" in page.locator("[data-test=table] tbody").inner_text()
    page = look().open(url + "/review")
    page.locator("thead").get_by_role("button", name="Duration").click()
    page.wait_for_selector("th[aria-sort=ascending]:has-text('Duration')")
    page.locator("thead").get_by_role("button", name="Duration").click()
    page.wait_for_selector("th[aria-sort=descending]")
    assert "7.50 s" in page.locator("[data-test=table] tbody tr").first.inner_text()


@pytest.mark.exhaustive
def test_decisions_about_many_recordings(waves: Path, studio: Fixture, look: Fixture) -> None:
    raw = raw_hash(waves)
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review")
    boxes = page.locator("tbody .ps-check input")
    boxes.first.wait_for()
    checked(page)

    def done(text: str) -> None:
        marked(page, "message").get_by_text(text).wait_for()

    # A click, and a Shift-click that selects what lies between.
    boxes.nth(1).click()
    boxes.nth(4).click(modifiers=["Shift"])
    marked(page, "chosen").get_by_text("Selected: 4").wait_for()
    marked(page, "relabel-selected").click()
    marked(page, "relabel-go").wait_for()
    assert axe(page) == []
    marked(page, "new-gesture").click()
    page.get_by_role("option", name="Rest").click()
    marked(page, "relabel-go").click()
    done("Set to another gesture: 4.")
    assert page.get_by_text("recorded as Wave").count() == 4
    assert {m["action"] for m in marks(waves)} == {"relabel"} and len(marks(waves)) == 4
    assert axe(page) == []
    marked(page, "message").get_by_role("button", name="Undo").click()
    done("Undone: setting another gesture. Recordings: 4")
    assert all(r.gesture == r.recorded for r in open_dataset(waves).recordings)
    # All that the filter shows; excluded with one reason, and included again.
    marked(page, "filters").click()
    marked(page, "filter-person").click()
    page.get_by_role("option", name="P2", exact=True).click()
    marked(page, "select-none").click()
    marked(page, "select-all").get_by_text("(8)").click()
    marked(page, "chosen").get_by_text("Selected: 8").wait_for()
    marked(page, "exclude-selected").click()
    page.get_by_role("button", name="recorded twice").click()
    done("Excluded: 8.")
    assert sum(r.excluded for r in open_dataset(waves).recordings) == 8
    marked(page, "include-selected").click()
    done("Included again: 8.")
    marked(page, "undo-list").click()
    done("Undone: including again. Recordings: 8")
    marked(page, "undo-list").click()
    done("Undone: excluding. Recordings: 8")
    assert not any(r.excluded for r in open_dataset(waves).recordings)
    # How many, before the click; and the same number is taken back.
    many = int(marked(page, "accept-sure").inner_text().rpartition(" ")[2])
    marked(page, "sure").fill("0")
    page.wait_for_function(
        "(n) => Number(document.querySelector('[data-test=accept-sure]').textContent.split(': ')[1]) > n", arg=many - 1
    )
    all_of_them = int(marked(page, "accept-sure").inner_text().rpartition(" ")[2])
    assert all_of_them == 7
    marked(page, "accept-sure").click()
    done("Starts accepted: 7.")
    assert sum(r.start > 0 for r in open_dataset(waves).recordings) == 7
    marked(page, "message").get_by_role("button", name="Undo").click()
    done("Undone: setting start and end. Recordings: 7")
    assert not any(r.start for r in open_dataset(waves).recordings) and raw_hash(waves) == raw
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_durations_with_an_adjustable_band(waves: Path, studio: Fixture, look: Fixture) -> None:
    url = studio(home=waves.parents[1]).url
    longest = max(open_dataset(waves).recordings, key=lambda r: r.rows).id
    for language, dark, size in (("lv", True, PHONE), ("en", False, DESK)):
        browser = look(size, dark, language)
        page = browser.open(url + "/review?view=durations&gesture=Wave")
        marked(page, "duration-outliers").get_by_text(longest).wait_for()
        assert axe(page) == []
        assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
        assert browser.complaints == []
    assert "Recordings: 21. Mean 2.74 s, median 2.50 s" in marked(page, "durations-summary").inner_text()
    marked(page, "band").fill("190")
    marked(page, "duration-outliers").get_by_text("There are no outliers").wait_for()
    marked(page, "band").fill("40")
    marked(page, "select-outliers").click()
    marked(page, "chosen").get_by_text("Selected: 1").wait_for()
    marked(page, "view").get_by_role("button", name="Durations").click()
    over = page.locator("[data-test=durations-plot] .u-over")
    over.wait_for()
    box = over.bounding_box()
    assert box is not None
    # The longest was recorded last.
    over.click(position={"x": int(box["width"]) - 2, "y": int(box["height"] * 0.3)})
    assert opened(page) == longest
    # The plot has half of the window, and what decides is in sight.
    plot = page.locator(f"{PLOT} canvas").bounding_box()
    assert plot is not None and plot["height"] >= 400
    marked(page, "relabel").click()
    marked(page, "new-gesture").click()
    page.get_by_role("option", name="Rest").click()
    marked(page, "relabel-go").click()
    page.get_by_text("Rest (recorded as Wave)").wait_for()
    page.keyboard.press("u")
    page.get_by_text("Undone: setting another gesture").wait_for()


@pytest.mark.exhaustive
def test_overlays_name_what_stands_out(waves: Path, studio: Fixture, look: Fixture) -> None:
    url = studio(home=waves.parents[1]).url
    longest = max(open_dataset(waves).recordings, key=lambda r: r.rows).id
    page = look(TABLET, True, "lv").open(url + "/review?view=overlay&gesture=Wave")
    page.wait_for_selector(f"[data-test=outliers] :text('{longest}')")
    assert axe(page) == []
    assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
    marked(page, "outliers").get_by_role("button").first.click()
    assert opened(page) == longest
    page = look().open(url + "/review?view=overlay&gesture=Wave")
    page.wait_for_selector(f"[data-test=outliers] :text('{longest}')")
    over = page.locator("[data-test=overlay-plot] .u-over")
    box = over.bounding_box()
    assert box is not None
    # Where all others have ended, only one is left.
    over.click(position={"x": int(box["width"] * 0.75), "y": int(box["height"] * 0.5)})
    assert opened(page) == longest


def test_a_folder_that_cannot_be_written(waves: Path, studio: Fixture, look: Fixture) -> None:
    browser = look()
    page = browser.open(studio(home=waves.parents[1]).url + "/review?view=one&gesture=Wave")
    first = opened(page)
    checked(page)
    before = raw_hash(waves)
    # Root may write anywhere: a folder in the lock's place refuses everybody.
    lock = waves / "marks.jsonl.lock"
    lock.unlink(missing_ok=True)
    lock.mkdir()
    page.keyboard.press("ArrowRight")
    state(page, "draft")
    page.keyboard.press("Enter")
    page.locator("[role=alert]:has-text('cannot be written')").wait_for()
    assert "cannot be written" in marked(page, "message").inner_text()
    assert axe(page) == []
    assert shown(page) == first
    state(page, "draft")
    assert marks(waves) == [] and raw_hash(waves) == before
    lock.rmdir()
    pressed(page, "Enter")
    assert [m["recording"] for m in marks(waves)] == [first]
    assert marked(page, "message").count() == 0
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_two_tabs_show_the_same_and_do_not_fight(waves: Path, studio: Fixture, look: Fixture) -> None:
    browser = look()
    url = studio(home=waves.parents[1]).url + "/review?view=one&gesture=Wave"
    left = browser.open(url)
    first = opened(left)
    checked(left)
    right = browser.open(url)
    assert opened(right) == first
    left.keyboard.press("ArrowRight")
    state(right, "draft")
    second = pressed(left, "Enter")
    state(right, "adjusted")
    # What stands already is not marked again.
    assert pressed(right, "Enter") == second
    assert [m["recording"] for m in marks(waves)] == [first]
    right.keyboard.press("u")
    right.get_by_text("There is nothing left to undo").wait_for()
    left.keyboard.press("u")
    left.wait_for_function("([plot, was]) => document.querySelector(plot).dataset.recording === was", arg=[PLOT, first])
    # Another program's mark is seen by itself.
    append_marks(waves, [Mark(first, "exclude", "cli", "noise")])
    state(left, "excluded")
    assert browser.complaints == []


def test_a_broken_data_set_is_a_sentence(waves: Path, studio: Fixture, look: Fixture) -> None:
    broken = waves.parent / "broken"
    shutil.copytree(waves, broken)
    (broken / "dataset.toml").write_text("this is no TOML =")
    torn = waves.parent / "torn"
    shutil.copytree(waves, torn)
    (torn / "marks.jsonl").write_text("[1]\n")
    browser = look()
    started = studio(home=waves.parents[1])
    for name, said in (("broken", "dataset.toml"), ("torn", "marks.jsonl is damaged")):
        page = browser.open(f"{started.url}/review?dataset=datasets/{name}")
        assert said in marked(page, "message").inner_text()
        assert axe(page) == []
    marked(page, "dataset").click()
    page.get_by_role("option", name="(waves)").click()
    page.wait_for_selector("[data-test=table] tbody tr")
    assert browser.complaints == []


def test_labelled_recordings_need_no_trimming(real_data: Path, tmp_path: Path, studio: Fixture, look: Fixture) -> None:
    source = tmp_path / "har"
    source.mkdir()
    for subject in ("s01", "s02"):
        shutil.copytree(real_data / "har-phone" / subject, source / subject)
    place = tmp_path / "home" / "datasets" / "har"
    place.parent.mkdir(parents=True)
    import_recordings(source, place, layout="phone-6")
    browser = look()
    page = browser.open(studio(home=tmp_path / "home").url + "/review?view=one")
    first = opened(page)
    checked(page)
    assert "cannot be trimmed" in marked(page, "labelled").inner_text()
    assert marked(page, "ends").count() == 0
    page.keyboard.press("ArrowRight")
    second = pressed(page, "Enter")
    assert marks(place) == []
    page.keyboard.press("x")
    page.get_by_role("button", name="sensor fault").click()
    page.wait_for_function(
        "([plot, was]) => document.querySelector(plot).dataset.recording !== was", arg=[PLOT, second]
    )
    assert [(m["recording"], m["action"], m["why"]) for m in marks(place)] == [(second, "exclude", "sensor fault")]
    assert first != second
    assert axe(page) == []
    assert browser.complaints == []


STREAM = "[data-test=stream-plot]"


def test_a_stretch_of_a_stream_is_labelled_by_mouse_and_keys(tmp_path: Path, studio: Fixture, look: Fixture) -> None:
    place = streamed(tmp_path / "home" / "datasets" / "streams")
    browser = look()
    page = browser.open(studio(home=tmp_path / "home").url + "/review?view=stream")
    page.wait_for_function(
        f"() => document.querySelector('{STREAM}')?.psPlot?.u && document.querySelector('{STREAM}').dataset.recording"
    )
    checked(page)
    assert "20 s · labelled stretches: 0" in marked(page, "stream-about").inner_text()
    marked(page, "label-rest").click()
    page.get_by_text("Select a stretch first").wait_for()
    low, high = page.evaluate(
        f"() => {{ const s = document.querySelector('{STREAM}').psPlot.u.scales.x; return [s.min, s.max] }}"
    )

    def at(second: float) -> tuple[float, float]:
        """Where in the window a second of the plot is; the page may have scrolled."""
        box = page.locator(f"{STREAM} .u-over").bounding_box()
        assert box is not None
        return box["x"] + box["width"] * (second - low) / (high - low), box["y"] + 60

    def drag(first: float, last: float) -> None:
        page.mouse.move(*at(first))
        page.mouse.down()
        page.mouse.move(*at((first + last) / 2))
        page.mouse.move(*at(last))
        page.mouse.up()
        page.wait_for_selector("[data-test=stream-about]:has-text('selected')")

    drag(1.0, 4.0)
    marked(page, "label-rest").click()
    page.wait_for_selector("[data-test=stretches] :text('Rest')")
    drag(8.0, 10.0)
    page.keyboard.press("p")
    page.wait_for_selector("[data-test=stretches] :text('Practised gesture: Wave')")
    # By clicks: the beginning, and with Shift the end.
    page.mouse.click(*at(14.0))
    page.keyboard.down("Shift")
    page.mouse.click(*at(16.0))
    page.keyboard.up("Shift")
    page.get_by_text(re.compile(r"selected 1[34][.][0-9]+ to 1[56][.]")).wait_for()
    page.keyboard.press("h")
    page.wait_for_selector("[data-test=stretches] :text('Handling')")
    assert axe(page) == []
    lines = [(m["recording"], m["action"], m["label"]) for m in marks(place)]
    assert lines == [("P1/fulldatastream", "label", k) for k in ("rest", "practice:Wave", "handling")]
    assert [(m["start"], m["stop"]) for m in marks(place)] == [
        (pytest.approx(first, abs=5), pytest.approx(last, abs=5))
        for first, last in ((100, 400), (800, 1000), (1400, 1600))
    ]
    assert "labelled stretches: 3" in marked(page, "stream-about").inner_text()
    page.keyboard.press("u")
    page.wait_for_selector("[data-test=stretches] :text('Handling')", state="detached")
    drag(2.0, 3.0)
    page.keyboard.press("d")
    page.wait_for_function("() => document.querySelectorAll('[data-test=stretches] button').length === 3")
    page.keyboard.press("u")
    page.wait_for_function("() => document.querySelectorAll('[data-test=stretches] button').length === 2")
    stretches = [s.label for s in open_dataset(place).stretches]
    assert stretches == ["rest", "practice:Wave"]
    # Labels of other programs are seen, and the address opens the same stream.
    append_marks(place, [Mark("P2/fulldatastream", "label", "cli", start=1700, stop=1800, label="rest")])
    marked(page, "stream-choice").click()
    page.get_by_role("option", name="P2/fulldatastream").click()
    page.wait_for_selector("[data-test=stretches] :text('17')")
    page.wait_for_function("() => location.search.includes('P2')")
    page.reload()
    connected(page)
    page.wait_for_function(f"() => document.querySelector('{STREAM}')?.dataset.recording === 'P2/fulldatastream'")
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_real_recordings_one_after_the_other(real_data: Path, tmp_path: Path, studio: Fixture, look: Fixture) -> None:
    place = tmp_path / "home" / "datasets" / "real"
    place.parent.mkdir(parents=True)
    import_recordings(real_data / "makeability-gestures", place, layout="accel-3")
    before = raw_hash(place)
    browser = look()
    page = browser.open(studio(home=tmp_path / "home").url + "/review?view=one")
    opened(page)
    seen = [shown(page)]
    for _ in range(25):
        # One can begin before all is looked at.
        page.wait_for_selector("[data-test=state]:not([data-state=looking])")
        seen.append(pressed(page, "Enter"))
    assert [m["recording"] for m in marks(place)] == seen[:25]
    times = page.evaluate(f"() => document.querySelector('{PLOT}').psPlot.times")
    assert len(times) == 25
    # The one that nobody stopped, 18907 rows: drawn thinned, closer in full.
    longest = max(open_dataset(place).recordings, key=lambda r: r.rows)
    page.goto(page.url.split("?")[0] + f"?recording={longest.id.replace(' ', '%20')}")
    connected(page)
    assert opened(page) == longest.id
    points = "() => document.querySelector('[data-test=plot]').psPlot.p.data[0].length"
    assert page.evaluate(points) < 3500
    for _ in range(6):
        page.keyboard.press("+")
    page.wait_for_function(
        "(rate) => { const p = document.querySelector('[data-test=plot]').psPlot, {min, max} = p.u.scales.x;"
        " return p.p.data[0].filter((x) => x >= min && x <= max).length"
        " > 0.9 * rate * (max - min) }",
        arg=longest.rate_hz,
    )
    assert raw_hash(place) == before
    assert browser.complaints == []
