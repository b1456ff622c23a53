"""Three people find their whole way by what the pages say: a teacher, a researcher and a hurried student.

``PLUSHSENSE_LOOKS=FOLDER`` keeps a picture of the page after each step, and the table of clicks, keys and seconds in
``people.txt``. A click chooses, presses or ticks one thing; keys are counted while recording; a text that is filled in
or a file that is chosen counts as one click. The virtual toy runs at ten times its speed.
"""

from __future__ import annotations

import os
import re
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from support.browsing import LONG_MS, axe, connected, marked
from support.foreign_folders import glove
from support.recording_pages import heard, showing, start_recording

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = [pytest.mark.exhaustive, pytest.mark.slow]
Fixture = Callable[..., Any]
SPEED = "10"
LOOKS = os.environ.get("PLUSHSENSE_LOOKS")


class Person:
    """Somebody at a page, who clicks on what is written there; counts clicks and keys, and times each step."""

    def __init__(self, page: Page, name: str) -> None:
        self.page, self._name = page, name
        self.clicks = self.keys = 0
        self._rows: list[str] = []

    @contextmanager
    def step(self, what: str) -> Iterator[None]:
        """Count a step, and check the page that it ends at."""
        before, began = (self.clicks, self.keys), time.monotonic()
        yield
        seconds, row = time.monotonic() - began, f"{self._name:<11}{what:<38}"
        self._rows.append(f"{row}{self.clicks - before[0]:>7}{self.keys - before[1]:>6}{seconds:>8.1f}")
        connected(self.page)
        if LOOKS:
            name = f"people-{self._name}-{len(self._rows)}.png"
            self.page.screenshot(path=f"{LOOKS}/{name}", full_page=True)
        assert axe(self.page) == [], what
        assert self.page.evaluate("document.documentElement.scrollWidth <= innerWidth"), what

    def click(self, target: Locator | str) -> None:
        """Click on something, or on the button or link that begins with this text."""
        self.clicks += 1
        if isinstance(target, str):
            name = re.compile(f"^{re.escape(target)}")
            roles = ("button", "link", "checkbox", "radio", "option")
            found = [self.page.get_by_role(role, name=name) for role in roles]  # type: ignore[arg-type]
            target = found[0].or_(found[1]).or_(found[2]).or_(found[3]).or_(found[4])
        target.first.click()

    def fill(self, label: str, text: str) -> None:
        """Fill in the field whose label begins so."""
        self.clicks += 1
        self.page.get_by_label(re.compile(f"^{re.escape(label)}")).first.fill(text)

    def fill_mark(self, mark: str, text: str) -> None:
        """Fill in a marked field."""
        self.clicks += 1
        marked(self.page, mark).fill(text)

    def choose(self, mark: str, text: str) -> None:
        """Choose from a list."""
        self.click(marked(self.page, mark))
        self.click(self.page.get_by_role("option").filter(has_text=text))

    def bring(self, button: str, file: Path) -> None:
        """Choose a file in the dialog of a button."""
        with self.page.expect_file_chooser() as chooser:
            self.click(button)
        chooser.value.set_files(str(file))

    def take_away(self, button: str) -> Path:
        """Download by a button; the file."""
        with self.page.expect_download() as loaded:
            self.click(button)
        return Path(loaded.value.path())

    def record(self, takes: int) -> None:
        """Record with the space bar: one press begins, another ends a recording of some seconds."""
        heard(self.page)
        for number in range(takes):
            self.keys += 2
            if start_recording(self.page, number):
                self.page.wait_for_timeout(500)
                self.page.keyboard.press("Space")
            showing(self.page, f"idle.{number + 1}.", "finished.")

    def done(self) -> None:
        """Print the table."""
        table = "\n".join([*self._rows, f"{self._name:<11}{'in all, but takes':<38}{self.clicks:>7}{self.keys:>6}", ""])
        print(f"\n{table}")  # noqa: T201
        if LOOKS:
            with Path(LOOKS, "people.txt").open("a", encoding="utf-8") as file:
                file.write(table)


def test_a_teacher(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    browser = look()
    t = Person(browser.open(studio("--speed", SPEED).url), "teacher")
    page = t.page

    def child(code: str) -> None:
        t.click("Record")
        page.wait_for_url("**/record**")
        connected(page)
        assert marked(page, "code").input_value() == code, "proposed"

    def end() -> None:
        t.click("Look at the recordings")
        page.wait_for_url("**/review?dataset=**", timeout=LONG_MS)
        connected(page)

    with t.step("own list of three gestures"):
        child("S01")
        t.click(page.get_by_text("Make your own list of gestures"))
        for gesture in ("Back stroke 1", "Tail hit 1", "Hold strong"):
            t.click(page.get_by_role("checkbox", name=gesture, exact=True))
        t.fill("Name of the list", "Class list")
        t.click("Save and choose it")
        marked(page, "discard-protocol").wait_for()
    with t.step("first child"):
        t.click("Begin the session")
        marked(page, "state-box").wait_for()
        t.record(9)
        end()
    with t.step("look through"):
        t.click("Accept suggestions")
        page.get_by_text("decided,").wait_for()
    with t.step("second child, another person"):
        t.click("Home")
        connected(page)
        marked(page, "next-sentence").get_by_text("Record more people").wait_for()
        t.choose("person", "Person 12")
        t.click("Use the virtual toy")
        marked(page, "chosen").get_by_text("person 12").wait_for()
        child("S02")
        assert page.locator('[data-test="protocol"]').input_value() == "Class list"
        t.click("Begin the session")
        marked(page, "state-box").wait_for()
        t.record(9)
        end()
    with t.step("network"):
        t.click("Next: train")
        connected(page)
        t.fill("Minutes, at most", "1")
        t.click("Make a network")
        marked(page, "score").first.wait_for(timeout=LONG_MS)
    with t.step("watch live"):
        t.click("Try it live")
        connected(page)
        t.click("Start")
        marked(page, "do-Tail hit 1").wait_for()
        # At rest, the network is at rest: it is not stuck in a gesture.
        t.click(marked(page, "do-nothing"))
        t.click(marked(page, "do-Tail hit 1"))
        marked(page, "events").locator("li[data-id]").filter(has_text="Tail hit 1").first.wait_for()
        t.click("Stop")
    with t.step("forget one child"):
        t.click("Home")
        connected(page)
        t.click("Forget a person everywhere")
        t.choose("forget-person", "S02")
        marked(page, "forget-traces").wait_for()
        t.clicks += 1
        marked(page, "forget-code").fill("S02")
        t.click("Remove for good")
        marked(page, "job-done").get_by_text("Not removed: 0.").wait_for(timeout=LONG_MS)
        assert "S02" in t.take_away("Save the receipt").read_text(encoding="utf-8")
        marked(page, "dataset").get_by_text("people: 1 ").wait_for()
    assert browser.complaints == []
    t.done()


@pytest.mark.usefixtures("publish_tools")
def test_a_researcher(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    archive = tmp_path / "study.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in sorted(glove(tmp_path / "glove", ("A1", "A2", "A3", "A4")).rglob("*.csv")):
            file.write(path, path.relative_to(tmp_path))
    browser = look()
    r = Person(browser.open(studio().url), "researcher")
    page = r.page
    row = marked(page, "dataset").filter(has_text="gloves")

    def evaluate(said: str) -> None:
        r.click(marked(page, "start"))
        first = page.locator("[data-test=job]").first
        first.get_by_text(said).wait_for()
        first.locator("[data-test=score]").wait_for(timeout=LONG_MS)

    with r.step("import a stranger's zip"):
        r.bring("Choose files", archive)
        marked(page, "mapping-rows").get_by_text("A1").first.wait_for(timeout=LONG_MS)
        r.click("The rows are right")
        marked(page, "incoming-name").wait_for(timeout=LONG_MS)
        r.fill("Name of the new data set", "gloves")
        r.click("Import")
        row.wait_for(timeout=LONG_MS)
    with r.step("check"):
        r.click(row.get_by_role("button", name="Check"))
        row.get_by_text("0 to decide").wait_for(timeout=LONG_MS)
    with r.step("evaluate by person"):
        r.click(row.get_by_role("link", name="Train"))
        connected(page)
        r.click(page.get_by_text("More settings and other jobs"))
        r.click(page.get_by_text("Evaluate on people left out"))
        r.fill("Epochs", "12")
        evaluate("Evaluate on people left out: gloves")
    with r.step("another network"):
        r.click(page.get_by_text("Advanced settings"))
        r.fill("Network (kernel lengths)", "5d1_7d1")
        r.fill("Filters", "4,6")
        evaluate("Evaluate on people left out: gloves, 5d1_7d1")
    with r.step("compare"):
        r.click("Open in the results")
        r.choose("compare-with", "7d1_19d1_19d2")
        marked(page, "comparison").get_by_text("Compared on 4 people").wait_for()
    with r.step("take report and table away"):
        assert "<html" in r.take_away("Save the report (HTML)").read_text(encoding="utf-8")
        assert "hug" in r.take_away("Save the confusions (CSV)").read_text(encoding="utf-8")
    better = page.locator('[data-row*="7d1_19d1_19d2"] button').first
    with r.step("train on everybody and export"):
        r.click(better)
        details = marked(page, "details")
        details.get_by_role("heading", name="7d1_19d1_19d2").wait_for()
        score = details.locator('[data-test="score"]').inner_text()
        r.click("Train on everybody and export")
        marked(page, "to-exported").first.wait_for(timeout=LONG_MS)
        r.click(marked(page, "to-exported"))
        page.wait_for_url("**/export?name=**")
        connected(page)
        # It has the score of its evaluation, on this page as on that of the results.
        assert marked(page, "score").inner_text() == score
        with zipfile.ZipFile(r.take_away("Download as a zip")) as made:
            assert any(name.endswith("plush_model.c") for name in made.namelist())
    with r.step("publish"):
        r.click("Publish")
        page.wait_for_url("**/publish**")
        connected(page)
        assert "gloves" in marked(page, "new").inner_text()
        for mark, said in {"data-title": "Gloves", "description": "Four people touch.", "creator-name": "Byron, Ada",
                           "contact-name": "Ada", "contact-mail": "ada@example.org",
                           "consent": "The people agreed to publication."}.items():  # fmt: skip
            r.fill_mark(mark, said)
        r.choose("licence", "CC-BY-4.0")
        r.click(marked(page, "do"))
        marked(page, "validators").wait_for(timeout=LONG_MS)
    assert browser.complaints == []
    r.done()


def test_a_hurried_student(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    browser = look()
    server = studio("--speed", SPEED)
    s = Person(browser.open(server.url), "student")
    page = s.page
    with s.step("trial of three gestures"):
        s.click("Try it with three gestures")
        marked(page, "trial-start").wait_for()
        s.click("Start")
        marked(page, "trial-about").wait_for(timeout=LONG_MS)
        events = marked(page, "events").locator("li[data-id]")
        for gesture in ("Tail pull", "Hold strong", "Back stroke 1") * 2:
            s.click(marked(page, f"do-{gesture}"))
            page.wait_for_timeout(1000)
            if events.count():
                break
        assert events.count(), "of six touches, none was noticed"
    with s.step("keep it"):
        s.click("Keep recordings and network")
        marked(page, "trial-kept").get_by_text("S01/1").wait_for()
        s.click("End the trial")
        marked(page, "trial-start").wait_for()
    with s.step("save everything"):
        s.click("Home")
        connected(page)
        s.click("Save everything")
        # Recordings that would not be saved are named.
        marked(page, "ask").get_by_text("Not in a data set yet, so not saved: S01/1.").wait_for()
        s.click("Cancel")
        s.click("Put them into a data set")
        marked(page, "dataset").get_by_text("recordings: 15").wait_for(timeout=LONG_MS)
        s.click("Save everything")
        marked(page, "download").wait_for(timeout=LONG_MS)
        file = tmp_path / "all.zip"
        s.take_away("Download").rename(file)
    server.stop()
    other = studio("--speed", SPEED, home=tmp_path / "elsewhere")
    page.goto(other.url)
    connected(page)
    with s.step("open it elsewhere"):
        s.bring("Open", file)
        marked(page, "job-done").get_by_text("data sets: 1 · networks: 1").wait_for(timeout=LONG_MS)
        marked(page, "dataset").get_by_text("recordings: 15").wait_for()
    with s.step("watch it there"):
        s.click(marked(page, "bundle").get_by_role("link", name="Live"))
        connected(page)
        s.click("Start")
        marked(page, "do-Tail pull").wait_for()
    assert [c for c in browser.complaints if "ERR_CONNECTION" not in c and "WebSocket" not in c] == []
    s.done()
