"""The live page in a real browser: what the toy does is seen, whatever happens to bundles, toys, tabs and server."""

from __future__ import annotations

import contextlib
import csv
import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.layouts import load_layout
from plushsense.recording.plan import load_protocol
from plushsense.recording.session import OpenSession
from plushsense.recording.writer import SessionHead
from support.browsing import Look, axe, connected, marked
from support.bundles import OTHER, odd_bundle

pytestmark = pytest.mark.early

Fixture = Callable[..., Any]
PHONE = (390, 844)
VIRTUAL = ("--device", "virtual://?person=31", "--speed", "2")


def live(browser: Look, url: str) -> Any:
    """The live page, its view standing."""
    page = browser.open(f"{url}/live")
    page.wait_for_function("() => window.plushsenseLive && window.plushsenseLive.scenes > 0")
    return page


def started(browser: Look, url: str) -> Any:
    """The same, and a toy that is being read."""
    page = live(browser, url)
    marked(page, "start").click()
    situation(page, *READING)
    return page


READING = ("nothing", "unsure", "unknown", "event")


def situation(page: Any, *kinds: str) -> None:
    """Wait for one of the situations."""
    page.wait_for_function(
        "(kinds) => kinds.includes(document.querySelector('[data-test=state]').dataset.kind)", arg=list(kinds)
    )


def settings(page: Any) -> None:
    """Unfold the fields, which are folded while a toy is read."""
    page.wait_for_function("() => !document.querySelector('[data-test=settings]').open")
    marked(page, "settings").locator("summary").click()


def choose(page: Any, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=option, exact=True).click()
    # While it closes the list is empty, which axe would call a fault.
    page.locator(".q-menu").wait_for(state="detached")


def look_at(page: Any) -> dict[str, Any]:
    found: dict[str, Any] = page.evaluate("() => { const {delays, painted, ...s} = window.plushsenseLive; return s; }")
    return found


def no_sideways(page: Any) -> bool:
    return bool(page.evaluate("() => document.documentElement.scrollWidth <= innerWidth"))


def test_what_the_toy_feels_is_seen(studio: Fixture, look: Fixture, home: Path) -> None:
    url = studio(*VIRTUAL, home=home).url
    browser = look()
    page = live(browser, url)
    assert marked(page, "state").inner_text() == "Not started"
    assert axe(page) == []
    assert not marked(page, "simulation").is_visible()
    marked(page, "start").click()
    page.wait_for_function("() => window.plushsenseLive.updates > 90")
    seen = look_at(page)
    # Twenty messages in a second of the toy, on a machine that does other things: at twice the speed twice as many
    # samples come, and a message holds those that came since the one before.
    assert seen["samples"] / seen["updates"] < 2 * 100 / 15
    assert seen["drawn"] > 0
    situation(page, *READING)
    assert marked(page, "simulation").is_visible()
    shares = marked(page, "bars").locator("li > span:last-child").all_inner_texts()
    assert len(shares) == 18
    assert sum(int(s.removesuffix(" %")) for s in shares) == pytest.approx(100, abs=9)
    groups = marked(page, "bars").locator("h3").all_inner_texts()
    assert [g.split()[:2] for g in groups] == [["+", "positive"], ["○", "neutral"], ["−", "negative"]]
    marked(page, "events").locator("li[data-id]").first.wait_for()
    row = marked(page, "events").locator("li[data-id]").last
    assert row.locator(".lv-badge").inner_text().split()[1] == row.get_attribute("data-affect")
    marked(page, "latency").get_by_text("to this page").wait_for()
    # What the virtual person really does, by itself and when asked; the newest event of the log says so, too.
    settings(page)
    choose(page, "Draw the signals", "2 times a second")
    page.get_by_role("button", name="Tail pull", exact=True).click()
    page.wait_for_function("() => document.querySelector('[data-test=really]').dataset.label === 'Tail pull'")
    assert marked(page, "really").inner_text() == "Really: Tail pull"
    marked(page, "do-nothing").click()
    marked(page, "really").get_by_text("the virtual person does nothing").wait_for()
    with page.expect_download() as saved:
        marked(page, "log-save").click()
    assert saved.value.suggested_filename.startswith("live-20")
    rows = list(csv.DictReader(Path(saved.value.path()).read_text(encoding="utf-8-sig").splitlines()))
    assert {row["source"] for row in rows} <= {"network", "rules"}
    assert f"{len(rows)} event" in marked(page, "log-count").inner_text()
    assert {row["simulated"] for row in rows} == {"yes"} and {row["network"] for row in rows} == {"little"}
    assert {row["person"] for row in rows} == {""} and any(row["really"] for row in rows)
    page.evaluate(
        "() => { window.print = () => { window.printed = document.querySelectorAll('.lv-print tr').length; }; }"
    )
    marked(page, "log-print").click()
    page.wait_for_function("(n) => window.printed > n", arg=len(rows))
    page.emulate_media(media="print")
    assert page.locator(".lv-print table").is_visible() and not marked(page, "state").is_visible()
    page.emulate_media(media="screen")
    label = page.locator('[data-test="signals"] canvas').get_attribute("aria-label")
    assert label.startswith("The 13 signals of the toy")
    assert page.locator('[data-test="now"] [aria-live="polite"]').count() == 1
    assert axe(page) == []
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_another_bundle_while_it_runs_and_one_that_does_not_fit(studio: Fixture, look: Fixture, home: Path) -> None:
    import plushsense as ps

    whole = ps.load(home / "bundles" / "little.plush").gestures
    odd_bundle(home / "bundles" / "few.plush", gestures=whole.subset(["Tail pull", "Back stroke 1"]))
    odd_bundle(home / "bundles" / "circus.plush", gestures=OTHER)
    url = studio(*VIRTUAL, home=home).url
    browser = look()
    page = live(browser, url)
    choose(page, "Network", "little")
    marked(page, "start").click()
    situation(page, *READING)
    settings(page)
    choose(page, "Network", "circus")
    # Beside the field.
    page.get_by_role("alert").get_by_text("no gesture in common").wait_for()
    assert axe(page) == []
    page.wait_for_function("(n) => window.plushsenseLive.updates > n + 20", arg=look_at(page)["updates"])
    assert (
        marked(page, "bundle").locator("span", has_text="little").count()
        or page.get_by_label("Network", exact=True).input_value() == "little"
    )
    scenes = look_at(page)["scenes"]
    choose(page, "Network", "few")
    page.wait_for_function("(n) => window.plushsenseLive.scenes > n", arg=scenes)
    marked(page, "bars").locator("li").nth(2).wait_for(state="detached")
    assert sorted(marked(page, "bars").locator("li").evaluate_all("rows => rows.map(r => r.dataset.label)")) == [
        "Back stroke 1",
        "Tail pull",
    ]
    situation(page, *READING)
    choose(page, "Arithmetic", "as on the chip (int8)")
    page.get_by_role("alert").get_by_text("calibration").wait_for()
    choose(page, "Network", "little")
    marked(page, "bars").locator("li").nth(17).wait_for()
    choose(page, "Arithmetic", "as on the chip (int8)")
    page.wait_for_function("(n) => window.plushsenseLive.scenes > n + 2", arg=scenes)
    choose(page, "Reactions of the toy", "none")
    situation(page, *READING)
    assert browser.complaints == []


@pytest.fixture
def toy() -> Iterator[Callable[[int], tuple[subprocess.Popen[str], str]]]:
    """``toy(port)`` begins a virtual toy in a process of its own: the process and its address."""
    begun: list[subprocess.Popen[str]] = []

    def begin(port: int = 0) -> tuple[subprocess.Popen[str], str]:
        command = [sys.executable, "-m", "plushsense", "toy", "--tcp", str(port), "--json"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        begun.append(process)
        assert process.stdout is not None
        return process, json.loads(process.stdout.readline())["url"]

    yield begin
    for process in begun:
        process.kill()
        process.wait(20.0)


@pytest.mark.exhaustive
def test_a_toy_that_goes_away_and_comes_back(studio: Fixture, look: Fixture, home: Path, toy: Fixture) -> None:
    process, address = toy()
    browser = look()
    page = started(browser, studio("--device", address, home=home).url)
    mark = marked(page, "simulation").inner_text()
    assert "this network was trained on virtual people" in mark, "nobody said that this port is a virtual toy"
    process.kill()
    process.wait(20.0)
    situation(page, "gone")
    assert marked(page, "state").inner_text() == "The toy is gone"
    assert "connects again by itself" in marked(page, "about").inner_text()
    assert axe(page) == []
    toy(int(address.rsplit(":", 1)[1]))
    situation(page, *READING)
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_a_toy_that_goes_away_while_the_page_is_behind(
    studio: Fixture, look: Fixture, home: Path, toy: Fixture
) -> None:
    process, address = toy()
    browser = look()
    page = started(browser, studio("--device", address, home=home).url)
    # A page that reports nothing is sent nothing after some messages. It reports nothing while it is hidden.
    hide = "(on) => Object.defineProperty(document, 'hidden', {get: () => on, configurable: true})"
    page.evaluate(hide, True)
    page.wait_for_function(
        "() => { const n = window.plushsenseLive.updates, now = performance.now();"
        " if (n !== window.before) { window.before = n; window.at = now; } return now - window.at > 2000; }"
    )
    process.kill()
    process.wait(20.0)
    page.wait_for_timeout(1500)
    page.evaluate(hide, False)
    situation(page, "gone")
    assert browser.complaints == []


def test_a_toy_that_is_not_there_is_a_sentence(studio: Fixture, look: Fixture, home: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as dead:
        port = dead.getsockname()[1]
        browser = look(PHONE, True, "lv", touch=True)
        page = live(browser, studio("--device", "tcp://127.0.0.1:9", home=home).url)
        box = page.get_by_role("combobox", name="Rotaļlieta", exact=True)
        field = page.locator(".q-field", has=box)
        marked(page, "start").click()
        field.get_by_role("alert").get_by_text("9").wait_for()
        for typed, why in (("replay:///etc/passwd", "nav studijas mapē"), ("nonsense://x", "nonsense")):
            box.fill(typed)
            box.press("Enter")
            marked(page, "start").click()
            field.get_by_role("alert").get_by_text(why).wait_for()
        assert axe(page) == []
        assert marked(page, "state").inner_text() == "Nav sākts"
        # A port that is open but sends nothing is not a calm toy.
        box.fill(f"tcp://127.0.0.1:{port}")
        box.press("Enter")
        marked(page, "start").click()
        situation(page, "silent")
        assert marked(page, "state").inner_text() == "No rotaļlietas nav signāla"
        assert "neko nesūta" in marked(page, "about").inner_text()
        assert axe(page) == []
        assert no_sideways(page)
        for name in ("stop", "eyes", "state"):
            box_of = marked(page, name).bounding_box()
            assert box_of["y"] + box_of["height"] <= PHONE[1], f"{name} is visible without scrolling"
        assert browser.complaints == []


@pytest.mark.exhaustive
def test_two_tabs_and_a_reload_show_the_present(studio: Fixture, look: Fixture, home: Path) -> None:
    url = studio(*VIRTUAL, home=home).url
    browser = look()
    page = started(browser, url)
    events = marked(page, "events").locator("li[data-id]")
    events.first.wait_for()
    first = events.last.get_attribute("data-from")
    second = live(browser, url)
    situation(second, *READING)
    assert look_at(second)["samples"] > 100, "the last seconds are there at once"
    assert marked(second, "events").locator(f'li[data-from="{first}"]').count() == 1
    page.reload()
    connected(page)
    page.wait_for_function("() => window.plushsenseLive && window.plushsenseLive.updates > 5")
    assert marked(page, "events").locator(f'li[data-from="{first}"]').count() == 1
    # A page in the background is sent nothing, and everything when it is seen again.
    hide = "(on) => { Object.defineProperty(document, 'hidden', {get: () => on, configurable: true}); "
    hide += "document.dispatchEvent(new Event('visibilitychange')); }"
    second.evaluate(hide, True)
    second.wait_for_timeout(500)
    before = look_at(second)
    page.wait_for_function("(n) => window.plushsenseLive.updates > n + 30", arg=look_at(page)["updates"])
    assert look_at(second)["updates"] == before["updates"]
    second.evaluate(hide, False)
    second.wait_for_function("(n) => window.plushsenseLive.scenes > n", arg=before["scenes"])
    second.wait_for_function("(n) => window.plushsenseLive.updates > n + 5", arg=before["updates"])
    marked(second, "stop").click()
    for tab in (page, second):
        situation(tab, "stopped")
        marked(tab, "start").wait_for()
    assert browser.complaints == []


def record_simulated(folder: Path) -> None:
    """Write a session of a virtual person who made every gesture twice, as the recorder leaves it."""
    from plushsense.recording.simulate import SimulationSpec, simulate

    simulate(folder.parent / "made", SimulationSpec(people=1, seed=5, repetitions=2, at_rest=0))
    layout, protocol = load_layout("plush-15").to_dict(), load_protocol("plush-17").to_dict()
    head = SessionHead(folder.parent.name, folder.name, 0, layout, protocol, simulated=True)
    with contextlib.closing(OpenSession(folder, head)):
        for file in (folder.parent / "made" / "P01").glob("*.csv"):
            file.rename(folder / file.name)
    shutil.rmtree(folder.parent / "made")


@pytest.mark.exhaustive
def test_the_network_is_adapted_to_recordings_of_the_person(studio: Fixture, look: Fixture, home: Path) -> None:
    import plushsense as ps

    little = home / "bundles" / "little.plush"
    before = little.read_bytes()
    record_simulated(home / "recordings" / "S08" / "1")
    browser = look()
    page = live(browser, studio("--device", "virtual://?person=2", "--speed", "4", home=home).url)
    assert marked(page, "adapt").is_disabled(), "no person is named"
    marked(page, "start").click()
    situation(page, *READING)
    marked(page, "stop").click()
    situation(page, "stopped")
    marked(page, "adapt-person").fill("S08")
    page.wait_for_function("!document.querySelector('[data-test=adapt]').disabled")
    marked(page, "adapt").click()
    message = marked(page, "now").locator('[data-test="message"]')
    message.get_by_text("Now in use for S08: little-for-S08.").wait_for()
    assert "recordings, each left out once, it reads" in message.inner_text()
    marked(page, "bundle").get_by_text("little-for-S08").wait_for()
    assert axe(page) == []
    assert no_sideways(page)
    message.get_by_role("button", name="Undo").click()
    message.get_by_text("The network little is in use again.").wait_for()
    assert ps.load(home / "bundles" / "little-for-S08.plush").adapted_to == "S08"
    assert little.read_bytes() == before
    # The network of S08 is the newest, but the one for everybody is recommended.
    other = browser.open(page.url.partition("/live")[0] + "/export")
    assert "little-for-S08" not in other.locator('[data-test="bundle"] input').input_value() != ""
    marked(page, "start").click()
    situation(page, *READING)
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_a_new_person_is_led_through_the_validation(studio: Fixture, look: Fixture, home: Path) -> None:
    url = studio("--device", "virtual://?person=31", "--speed", "3", home=home).url
    browser = look(PHONE, True, "lv", touch=True)
    page = live(browser, url)
    assert marked(page, "validate").is_disabled()
    marked(page, "start").click()
    situation(page, *READING)
    marked(page, "validate").click()
    page.get_by_role("alert").get_by_text("Vispirms norādiet").wait_for()
    page.wait_for_function("document.activeElement.dataset.test === 'validation-person'")
    page.keyboard.type("S31")
    marked(page, "validation-noted").click()
    marked(page, "validate").click()
    trial = "() => parseInt(document.querySelector('[data-test=validation-trial]').textContent.match(/[0-9]+/))"
    page.wait_for_function(f"() => ({trial})() > 2")
    marked(page, "validation-negative").click()
    marked(page, "validation-noted-count").get_by_text("Atzīmētas reakcijas: 1").wait_for()
    marked(page, "validation-pause").click()
    marked(page, "validation-prompt").get_by_text("Pauze. Nākamais: ").wait_for()
    marked(page, "validation-trial").get_by_text("no 51").wait_for()
    assert axe(page) == []
    assert no_sideways(page)
    at = page.evaluate(trial)
    marked(page, "validation-pause").click()
    page.wait_for_function(f"(at) => ({trial})() > at", arg=at)
    # The rest is left out.
    marked(page, "validation-stop").click()
    marked(page, "message").get_by_text("Pārbaude ir beigusies").wait_for()
    table = marked(page, "validation-table").locator("table")
    table.get_by_text("Visi žesti").wait_for()
    assert "," in table.inner_text() and "." not in table.locator("tbody").inner_text()
    assert axe(page) == []
    assert no_sideways(page)
    with page.expect_download() as saved:
        marked(page, "validation-trials").click()
    rows = list(csv.DictReader(Path(saved.value.path()).read_text(encoding="utf-8").splitlines()))
    assert {row["who"] for row in rows} == {"S31"} and {row["system"] for row in rows} >= {"toy", "rules", "cnn"}
    assert browser.complaints == []
