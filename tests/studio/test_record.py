"""The record page as a session leader uses it: keys, buttons, tabs, lost connections."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pytest

from plushsense.dataset.store import DatasetHead
from plushsense.recording.session import is_finished
from plushsense.recording.writer import SessionHead
from support.browsing import PHONE, TABLET, ZOOM, axe, connected, marked
from support.recording_pages import CALM, begun, choose, events, files, heard, sat, showing, stop, take, whats
from support.waiting import until

pytestmark = pytest.mark.early

if TYPE_CHECKING:
    from playwright.sync_api import Page, WebSocketRoute

Fixture = Callable[..., Any]
SPEED = ("--device", CALM, "--speed", "10")


@pytest.mark.exhaustive
def test_one_press_is_one_command(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio(*SPEED), look(own=True)
    # What sounds: each tone is an oscillator.
    browser.context.add_init_script(
        "window.tones = []; const start = OscillatorNode.prototype.start; OscillatorNode.prototype.start = "
        "function (...at) { window.tones.push(this.frequency.value); return start.apply(this, at) }"
    )
    page = browser.open(server.url + "/record?new=1")
    page.get_by_text("More settings").click()
    marked(page, "mark-first").click()
    choose(page, "protocol", "Short trial")
    marked(page, "code").fill("S01")
    marked(page, "begin").click()
    sat(page, "S01/1")
    for number in range(3):
        take(page, number)
    # Countdown, start, stop, and the mark for the video at the very first start.
    assert {660, 990, 440, 1320} == set(page.evaluate("() => window.tones"))
    marked(page, "sound").click()
    page.evaluate("() => { window.tones = [] }")
    # The last recording: its signal, its length, and the key that makes it again.
    marked(page, "result-text").get_by_text("Hold strong, 1: ").wait_for()
    assert marked(page, "result-text").get_attribute("data-length") == "first"
    assert marked(page, "result").locator("polyline").count() == 1
    page.keyboard.press("PageUp")
    showing(page, "idle.2.2.0.1")
    marked(page, "result").wait_for(state="hidden")
    # A clicker or pedal.
    page.locator("body").click(position={"x": 2, "y": 400})
    page.keyboard.press("PageDown")
    showing(page, "recording.2.")
    stop(page, key="Enter")
    showing(page, "idle.3.3.0.1")
    # A question is answered by its own buttons, and no recording begins.
    marked(page, "end").focus()
    page.keyboard.press("Space")
    page.wait_for_function("document.activeElement.dataset.test === 'end-no'")
    page.keyboard.press("PageDown")
    page.keyboard.press("Space")
    marked(page, "ending").wait_for(state="hidden")
    page.wait_for_function("document.activeElement.dataset.test === 'end'")
    outline = "() => getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(outline) == "solid", "the focus is visible"
    page.keyboard.press("Space")
    page.wait_for_function("document.activeElement.dataset.test === 'end-no'")
    page.keyboard.press("Enter")
    marked(page, "ending").wait_for(state="hidden")
    assert showing(page, "").startswith("idle.3.3.0.1")
    assert (page.evaluate("() => window.tones"), page.evaluate("() => localStorage.plushsense_sound")) == ([], "off")
    page.reload()
    connected(page)
    assert marked(page, "sound").inner_text() == "Sound: off"
    heard(page)
    marked(page, "mark").click()
    page.get_by_text("Marked for the video.").wait_for()
    mark, second = (e.details for e in events(tmp_path / "home") if e.kind == "mark")
    assert mark["host_ms"] < second["host_ms"] and mark["device_ms"] < second["device_ms"]
    assert whats(tmp_path / "home").count("start") == whats(tmp_path / "home").count("take") == 4
    assert "cancel" not in whats(tmp_path / "home")
    # A held key is one press: it neither stops what it started nor cancels it.
    showing(page, "idle.3.")
    page.keyboard.down("Space")
    for _ in range(10):
        page.keyboard.down("Space")
    showing(page, "recording.3.")
    for _ in range(10):
        page.keyboard.down("Space")
    page.keyboard.up("Space")
    page.wait_for_timeout(300)
    assert showing(page, "").startswith("recording.3.")
    # A held Enter on the big button is one click.
    marked(page, "main").focus()
    for _ in range(5):
        page.keyboard.down("Enter")
    page.keyboard.up("Enter")
    showing(page, "finished.")
    assert whats(tmp_path / "home").count("take") == 5
    assert len(files(tmp_path / "home")) == 5
    assert axe(page) == []
    assert "Next: look at the recordings" in marked(page, "all-done").inner_text()
    marked(page, "collect").click()
    page.wait_for_url("**/review?dataset=**")
    marked(page, "title").wait_for()
    assert "/datasets/recordings&session=S01/1" in unquote(page.url)
    with (tmp_path / "home" / "datasets" / "recordings" / "recordings.csv").open() as index:
        assert len(index.readlines()) == 1 + 5, "the discarded one too, excluded"
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_every_page_names_the_session_that_is_being_recorded(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio(*SPEED), look(TABLET)
    home = browser.open(server.url)
    assert not marked(home, "in-use").is_visible()
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    take(page, 0)
    marked(home, "in-use").get_by_text("Recording now: S01/1.").wait_for()
    assert "is being recorded" in marked(home, "next-sentence").inner_text()
    home.reload()
    assert "being recorded now" in marked(home, "sessions").inner_text()
    assert home.locator("[data-test=batch] .q-checkbox").get_attribute("aria-disabled") == "true"
    assert axe(home) == []
    marked(home, "in-use").get_by_role("link").click()
    home.wait_for_url("**/record?session=S01/1")
    assert not marked(home, "in-use").is_visible()
    home.goto(server.url + "/review")
    marked(home, "in-use").get_by_text("Recording now: S01/1.").wait_for()
    # The session is ended early: its recordings are one button away.
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    marked(home, "in-use").wait_for(state="hidden")
    assert "Recordings of this session: 1." in marked(page, "ended-session").inner_text()
    assert axe(page) == []
    marked(page, "collect").click()
    page.wait_for_url("**/review?dataset=**/recordings&session=**")
    assert browser.complaints == []


def menu(page: Page, place: str, item: str) -> None:
    """Choose an item of the menu in the element ``place``."""
    marked(page, place).locator("[data-test=menu]").click()
    page.get_by_role("menuitem", name=item).click()


def test_an_ended_session_is_finished_renamed_discarded_and_restored(
    studio: Fixture, look: Fixture, tmp_path: Path
) -> None:
    server, browser = studio(*SPEED), look(TABLET)
    recordings = tmp_path / "home" / "recordings"
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    take(page, 0)
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)
    before = {p.name: p.read_bytes() for p in (recordings / "S01/1").glob("*.csv")}
    menu(page, "unfinished-S01/1", "Finished for this child")
    marked(page, "message").get_by_text("S01/1 is marked as finished.").wait_for()
    assert marked(page, "unfinished-S01/1").count() == 0
    assert is_finished(recordings / "S01/1")
    marked(page, "finished-sessions").locator("summary").click()
    assert axe(page) == []
    marked(page, "undo").click()
    marked(page, "unfinished-S01/1").wait_for()
    assert not is_finished(recordings / "S01/1")
    # A wrong code is corrected; a name is refused.
    menu(page, "unfinished-S01/1", "Correct the person's code")
    marked(page, "ask-text").fill("Anna")
    marked(page, "ask-go").click()
    marked(page, "message").get_by_text("never a name").wait_for()
    menu(page, "unfinished-S01/1", "Correct the person's code")
    marked(page, "ask-text").fill("S02")
    # The key comes up when the dialog is gone, over what has the focus then.
    page.keyboard.down("Enter")
    marked(page, "ask-text").wait_for(state="detached")
    page.keyboard.up("Enter")
    marked(page, "unfinished-S02/1").wait_for()
    assert SessionHead.read(recordings / "S02/1").subject == "S02"  # type: ignore[union-attr]
    assert {p.name: p.read_bytes() for p in (recordings / "S02/1").glob("*.csv")} == before
    assert not (recordings / "S01").exists()
    menu(page, "unfinished-S02/1", "Discard")
    marked(page, "message").get_by_text("“S02/1” is discarded").wait_for()
    assert not (recordings / "S02").exists()
    page.goto(server.url)
    connected(page)
    marked(page, "discarded").locator("summary").click()
    assert "Session: S02/1" in marked(page, "discarded").inner_text()
    assert axe(page) == []
    marked(page, "discarded").get_by_role("button", name="Restore").click()
    marked(page, "sessions").get_by_text("S02 · session 1").wait_for()
    assert not marked(page, "discarded").is_visible()
    assert {p.name: p.read_bytes() for p in (recordings / "S02/1").glob("*.csv")} == before
    # A continued session goes on after its recording.
    page.goto(server.url + "/record?new=1")
    connected(page)
    marked(page, "unfinished-S02/1").get_by_role("button", name="Continue").click()
    sat(page, "S02/1")
    take(page, 1)
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_what_is_typed_is_no_command(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio(*SPEED), look()
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    take(page, 0)
    page.keyboard.press("n")
    page.keyboard.type("so soft, paws & bears")
    assert marked(page, "note").input_value() == "so soft, paws & bears"
    page.keyboard.press("Enter")
    until(lambda: "note" in whats(tmp_path / "home"))
    note = next(e.details for e in events(tmp_path / "home") if e.kind == "note")
    assert (note["text"], note["gesture"]) == ("so soft, paws & bears", "Head stroke 1")
    assert note["file"].startswith("Back stroke 1_")
    assert showing(page, "").startswith("idle.1.1.0.0")
    page.wait_for_function("document.activeElement.dataset.test === 'main'")
    page.keyboard.press("Escape")
    page.keyboard.press("Control+p")
    page.keyboard.press("Alt+s")
    page.wait_for_timeout(200)
    assert showing(page, "").startswith("idle.1.1.0.0")
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_redo_skip_back_pause_and_going_to_a_step(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    own = tmp_path / "home" / "protocols" / "mine.toml"
    own.parent.mkdir(parents=True)
    # Long enough to be seen on a busy machine.
    table = 'name = "mine"\ngesture_set = "plush-18"\nrepetitions = 1\ncountdown_s = 15\ngestures = '
    own.write_text(table + '["Back stroke 1", "Head stroke 1", "Hold strong", "Tail tap 1"]\n', encoding="utf-8")
    picture = tmp_path / "home" / "pictures" / "Back stroke 1.svg"
    picture.parent.mkdir()
    drawn = '<svg xmlns="http://www.w3.org/2000/svg" width="32" height="20"><script>alert(1)</script></svg>'
    picture.write_text(drawn, encoding="utf-8")
    server, browser = studio(*SPEED), look()
    page = begun(browser.open(server.url + "/record"), server.url, "S01", "mine")
    # A user's own picture, shown and never run.
    shown = marked(page, "picture").locator("img")
    assert shown.evaluate("async image => { await image.decode(); return image.naturalWidth }") == 32
    assert shown.get_attribute("alt") == "Picture: Back stroke 1"
    take(page, 0)
    first = events(tmp_path / "home")[-1].details["file"]
    marked(page, "last").get_by_text(f"Last: {first}").wait_for()
    page.keyboard.press("r")
    showing(page, "idle.0.0.0.1")
    # Skipped while it is to be made again: the earlier one counts after all.
    page.keyboard.press("s")
    showing(page, "idle.1.1.0.0")
    assert "kept" in marked(page, "recorder-message").inner_text()
    marked(page, "skip").click()
    showing(page, "idle.2.1.1.0")
    marked(page, "back").click()
    showing(page, "idle.1.1.1.0")
    page.keyboard.press("b")
    showing(page, "idle.0.1.1.0")
    assert marked(page, "again").inner_text() != ""
    page.get_by_text("All recordings: go to one").click()
    assert marked(page, "step-0").get_attribute("data-step") == "made"
    assert marked(page, "step-1").get_attribute("data-step") == "skipped"
    assert "Head stroke 1, 1 of 1: skipped" in str(marked(page, "step-1").get_attribute("aria-label"))
    assert axe(page) == []
    marked(page, "step-1").click()
    showing(page, "idle.1.")
    page.keyboard.press("p")
    showing(page, "paused.1.")
    page.keyboard.press("Space")
    page.wait_for_function("() => document.querySelector('[data-test=recorder-message]').innerText.includes('Paused')")
    marked(page, "main").click()
    take(page, 1)
    showing(page, "idle.2.2.0.0")
    # Broken off while it runs, and a countdown that is cancelled.
    page.keyboard.press("Space")
    showing(page, "recording.2.")
    marked(page, "redo").click()
    showing(page, "idle.2.2.0.0")
    page.keyboard.press("Space")
    showing(page, "countdown.2.")
    page.keyboard.press("Space")
    showing(page, "idle.2.2.0.0")
    page.keyboard.press("p")
    showing(page, "paused.2.")
    page.keyboard.press("p")
    showing(page, "idle.2.")
    # A pause breaks off what is running, and going on asks for it again.
    page.keyboard.press("Space")
    showing(page, "recording.2.")
    assert marked(page, "pause").inner_text() == "Discard and pause"
    marked(page, "pause").click()
    showing(page, "paused.2.2.0.0")
    assert "Record it again" in marked(page, "recorder-message").inner_text()
    marked(page, "main").click()
    showing(page, "idle.2.2.0.0")
    assert len(files(tmp_path / "home")) == 2
    assert browser.complaints == []


def test_a_gesture_of_ones_own_keeps_its_affect(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio(*SPEED), look(PHONE)
    page = browser.open(server.url + "/record?new=1")
    own = marked(page, "own-protocol")
    own.locator("summary").click()
    for chosen in (18, 0):
        marked(page, "own-all").click()
        page.wait_for_function(
            "n => document.querySelectorAll('[aria-checked=true][data-test^=own-]').length === n",
            arg=chosen,
        )
    for name, refused in (("a/b", "cannot be a name"), ("tail_pull", "in the list already")):
        marked(page, "own-gesture").fill(name)
        marked(page, "own-add").click()
        own.get_by_role("alert").get_by_text(refused).wait_for()
    assert axe(page) == []
    marked(page, "own-gesture").fill("Angry poke")
    choose(page, "own-affect", "negative")
    marked(page, "own-add").click()
    marked(page, "own-Angry poke").wait_for()
    marked(page, "own-name").fill("mine")
    marked(page, "own-repetitions").fill("1")
    marked(page, "own-save").click()
    marked(page, "discard-protocol").wait_for()
    marked(page, "code").fill("S01")
    marked(page, "begin").click()
    sat(page, "S01/1")
    assert marked(page, "prompt").inner_text() == "Angry poke"
    take(page, 0)
    marked(page, "collect").click()
    page.wait_for_url("**/review?dataset=**")
    (head,) = (tmp_path / "home" / "datasets").glob("*/dataset.toml")
    assert DatasetHead.read(head.parent).gestures.get("angry poke").affect == "negative"
    assert browser.complaints == []


def own_list(page: Page) -> None:
    """Make an own list of gestures; an error stands beside the name; it is discarded and restored."""
    marked(page, "own-protocol").locator("summary").click()
    marked(page, "own-name").fill("Mans saraksts")
    marked(page, "own-save").click()
    page.get_by_role("alert").filter(has_text="Izvēlieties vismaz vienu žestu").wait_for()
    for label in ("Tail pull", "Hold strong"):
        marked(page, f"own-{label}").click()
    choose(page, "own-order", "Jauktā secībā")
    page.get_by_role("listbox").wait_for(state="detached")
    assert axe(page) == []
    marked(page, "own-save").click()
    marked(page, "discard-protocol").wait_for()
    assert marked(page, "protocol").input_value() == "Mans saraksts"
    marked(page, "own-protocol").locator("summary").click()
    marked(page, "own-Tail pull").click()
    marked(page, "own-name").fill("Mans saraksts")
    marked(page, "own-save").click()
    page.get_by_role("alert").filter(has_text="„Mans saraksts” jau ir").wait_for()
    marked(page, "own-protocol").locator("summary").click()
    marked(page, "discard-protocol").click()
    marked(page, "message").get_by_text("„Mans saraksts” ir izmests").wait_for()
    assert not marked(page, "discard-protocol").is_visible()
    marked(page, "undo").click()
    marked(page, "discard-protocol").wait_for()


def test_keys_press_what_has_the_focus_and_zoom_hides_nothing(studio: Fixture, look: Fixture) -> None:
    server, browser = studio(*SPEED), look(ZOOM, language="lv")
    child = browser.open(server.url + "/record?session=S01/1&view=child")
    assert marked(child, "child-gesture").inner_text() == "Sesija S01/1 nav sākta."
    page = browser.open(server.url + "/record?new=1")
    marked(page, "code").fill("S01")
    choose(page, "protocol", "Izmēģināšanai")
    marked(page, "begin").click()
    sat(page, "S01/1")
    # At 200 % zoom, in the language with the longer words.
    for size in (ZOOM, PHONE):
        page.set_viewport_size({"width": size[0], "height": size[1]})
        for name in ("gesture", "prompt", "state-box", "main"):
            box = marked(page, name).bounding_box()
            assert box is not None and box["y"] + box["height"] <= size[1], f"{name} is below the fold"
        assert axe(page) == []
    # The space bar presses the button that has the focus; after a click by mouse it is the command again.
    marked(page, "skip").focus()
    page.keyboard.press("Space")
    showing(page, "idle.1.0.1.0")
    page.keyboard.press("Enter")
    showing(page, "idle.2.0.2.0")
    marked(page, "back").click()
    showing(page, "idle.1.")
    take(page, 1)
    marked(child, "child-prompt").wait_for()
    child.keyboard.press("Tab")
    assert child.evaluate("() => document.activeElement.tagName") == "BODY"
    assert child.locator("a, button, input, nav, header").count() == 0
    assert axe(child) == []
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_two_tabs_show_and_press_the_same_once(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    # At this speed nobody's recording ends by itself before 20 s.
    server, browser = studio("--device", CALM, "--speed", "3"), look(own=True)
    child = browser.open(server.url + "/record?session=S01/1&view=child")
    assert marked(child, "child-gesture").inner_text() == "The session S01/1 has not begun."
    frozen: list[bool] = [False]
    held: list[Callable[[], None]] = []

    def between(page_end: WebSocketRoute) -> None:
        """A slow network: what the studio says reaches the pages later."""
        server_end = page_end.connect_to_server()

        def said(message: str | bytes) -> None:
            if frozen[0]:
                held.append(lambda: page_end.send(message))
            else:
                page_end.send(message)

        server_end.on_message(said)

    browser.context.route_web_socket("**/_nicegui_ws/**", between)
    one = begun(browser.open(server.url + "/record"), server.url, "S01")
    # The only session that is open is what the bare address shows.
    other = browser.open(server.url + "/record")
    heard(other)
    showing(other, "idle.0.")

    def both_press() -> None:
        """Both see the same when they press."""
        frozen[0] = True
        for page in (one, other):
            page.keyboard.press("Space")
        one.wait_for_timeout(500)
        assert held
        frozen[0] = False
        while held:
            held.pop(0)()

    both_press()
    for page in (one, other):
        showing(page, "recording.0.")
    # The child's screen follows, and has nothing to press.
    marked(child, "child-state").get_by_text("Now!").wait_for()
    assert marked(child, "child-gesture").inner_text() == "Back stroke 1"
    assert marked(child, "child-prompt").inner_text().startswith("Stroke the toy's back")
    assert child.locator("a, button, input, nav, header").count() == 0
    assert axe(child) == []
    # The two presses travel on their own connections: either may arrive first.
    until(lambda: any(marked(page, "message").get_by_text("came too late").count() for page in (one, other)))
    both_press()
    for page in (one, other):
        showing(page, "idle.1.1.0.0")
    other.wait_for_timeout(300)
    assert showing(other, "") == "idle.1.1.0.0"
    made = [w for w in whats(tmp_path / "home") if w in ("countdown", "cancel", "start", "take")]
    assert made == ["countdown", "start", "take"]
    # Ended on one, it is ended on the other; what was made is kept, and it is offered again.
    marked(one, "end").click()
    marked(one, "end-yes").click()
    for page in (one, other):
        page.wait_for_url("**/record?ended=S01/1")
        connected(page)
        assert "1 of 4 recorded" in marked(page, "message").inner_text()
    marked(child, "child-gesture").get_by_text("Thank you!").wait_for()
    one.get_by_role("button", name="Continue: S01/1").click()
    sat(one, "S01/1")
    assert showing(one, "idle.") == "idle.1.1.0.0"
    assert browser.complaints == []


def test_a_lost_connection_loses_nothing(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    server, browser = studio(*SPEED), look(own=True)
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    showing(page, "idle.0.")
    page.keyboard.press("Space")
    showing(page, "recording.0.")
    browser.context.set_offline(True)
    page.evaluate("() => window.socket.io.engine.close()")
    page.wait_for_function("() => !window.socket.connected")
    marked(page, "connection-lost").get_by_text("CONNECTION LOST, NOT RECORDING").wait_for()
    # Nobody hears these, now or later.
    for _ in range(3):
        page.keyboard.press("Space")
    page.wait_for_timeout(500)
    assert "take" not in whats(tmp_path / "home")
    browser.context.set_offline(False)
    page.wait_for_function("() => window.socket && window.socket.connected")
    connected(page)
    showing(page, "recording.0.", "idle.1.")
    marked(page, "state-box").wait_for()
    assert marked(page, "connection-lost").inner_text() == ""
    if showing(page, "").startswith("recording"):
        page.keyboard.press("Space")
    showing(page, "idle.1.1.0.0")
    # A browser that is gone for good leaves the recorder running: the protocol ends the recording.
    page.keyboard.press("Space")
    showing(page, "recording.1.")
    page.close()
    until(lambda: whats(tmp_path / "home").count("take") == 2)
    assert [b["ended"] for b in files(tmp_path / "home")][1] == "longest"
    page = look().open(server.url + "/record")
    heard(page)
    assert showing(page, "idle.") == "idle.2.2.0.0"
    assert "Nobody stopped the recording" in marked(page, "recorder-message").inner_text()


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="Windows cannot stop a process for a while")
@pytest.mark.exhaustive
def test_a_studio_that_is_gone_is_not_shown_as_recording(studio: Fixture, look: Fixture) -> None:
    server, browser = studio("--device", CALM), look()
    page = begun(browser.open(server.url + "/record"), server.url, "S01")
    take(page, 0, 0.8)
    page.keyboard.press("Space")
    showing(page, "recording.1.")
    marked(page, "state").get_by_text("RECORDING. Press again").wait_for()
    assert axe(page) == []
    # One that stands still keeps the connection open and answers nothing.
    server.signal(signal.SIGSTOP)
    lost = page.get_by_role("alert").get_by_text(
        "CONNECTION LOST, NOT RECORDING. Kept: 1 of 4 recordings. To be made again: Head stroke 1, 1 of 1."
    )
    lost.wait_for()
    server.signal(signal.SIGCONT)
    lost.wait_for(state="detached")
    marked(page, "state").get_by_text("RECORDING. Press again").wait_for()
    server.kill()
    lost.wait_for()
    for name in ("state-box", "number", "main", "signal"):
        assert not marked(page, name).is_visible()
    assert axe(page) == []
    server.start()
    # Another process knows nothing of this page, which is loaded again: what was broken off is to be taken up.
    page.get_by_text("Unfinished sessions").wait_for()
    assert lost.count() == 0
    page.get_by_role("button", name="Continue: S01/1").click()
    sat(page, "S01/1")
    assert "Head stroke 1, 1, was interrupted: record it again" in marked(page, "notice").first.inner_text()
    assert showing(page, "idle.") == "idle.1.1.0.0"
    assert not [c for c in browser.complaints if "Failed to" not in c and "WebSocket" not in c]


@pytest.mark.exhaustive
def test_it_speaks_latvian_and_fits_a_phone(studio: Fixture, look: Fixture) -> None:
    server, browser = studio("--device", CALM, "--speed", "3"), look(PHONE, True, "lv", touch=True)
    page = browser.open(server.url + "/record?new=1")
    assert axe(page) == []
    marked(page, "code").fill("Anna B")
    marked(page, "begin").click()
    page.get_by_role("alert").filter(has_text="nav dalībnieka kods").wait_for()
    assert axe(page) == []
    own_list(page)
    marked(page, "code").fill("S01")
    choose(page, "protocol", "Izmēģināšanai")
    marked(page, "begin").click()
    sat(page, "S01/1")
    assert marked(page, "prompt").inner_text() == "Glaudi rotaļlietai muguru; rotaļlieta stāv uz galda"
    assert marked(page, "gesture").inner_text() == "Muguras glāstīšana 1"
    assert marked(page, "simulation").is_visible()
    assert marked(page, "picture").locator("svg").get_attribute("aria-label")
    page.wait_for_function("() => document.querySelectorAll('[data-test^=plot-] canvas').length === 3")
    for name in ("gesture", "prompt", "state-box", "main"):
        box = marked(page, name).bounding_box()
        assert box is not None and box["y"] + box["height"] <= PHONE[1], f"{name} is visible without scrolling"
    for state in ("idle", "recording"):
        if state == "recording":
            marked(page, "main").click()
        showing(page, f"{state}.0.")
        assert axe(page) == [], state
    assert page.evaluate("() => document.documentElement.scrollWidth <= window.innerWidth")
    marked(page, "main").click()
    showing(page, "idle.1.")
    for expected in ("idle.2.", "idle.3.", "finished."):
        page.keyboard.press("s")
        showing(page, expected)
    assert axe(page) == []
    marked(page, "redo").click()
    showing(page, "idle.0.")
    page.keyboard.press("p")
    showing(page, "paused.0.")
    marked(page, "end").click()
    marked(page, "end-yes").wait_for()
    assert axe(page) == []
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)
    assert marked(page, "unfinished-S01/1").is_visible()
    assert axe(page) == []
    assert browser.complaints == []
