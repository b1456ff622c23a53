"""Every page in both lights, on four sizes of screens, in both languages: whole, legible, and nothing foreign.

With ``PLUSHSENSE_SHOTS=docs/pictures/studio`` the pictures are kept, small, for the README. A page's scene is one
function in `SCENES`: it gets the open page, has something happen on it, and returns when that is to be seen.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from plushsense.studio.app.shell import PAGES
from plushsense.studio.app.workspace import Workspace
from support.browsing import (
    DESK,
    KEPT,
    LONG_MS,
    PHONE,
    TABLET,
    Look,
    Studio,
    axe,
    connected,
    english,
    keep_picture,
    marked,
)
from support.recorded import record
from support.recording_pages import begun, sat, showing
from support.sharing import built_once
from support.trainings import evaluate_apart

pytestmark = pytest.mark.early

Fixture = Callable[..., Any]


@dataclass(frozen=True)
class View:
    """How a page is looked at."""

    name: str
    size: tuple[int, int]
    dark: bool
    language: str


VIEWS = (
    View("desk-light-en", DESK, False, "en"),
    View("wide-dark-en", (1920, 1080), True, "en"),
    View("tablet-light-lv", TABLET, False, "lv"),
    View("phone-dark-lv", PHONE, True, "lv"),
)


def _home(page: Any, studio: Studio) -> None:
    """A toy that was tested, a data set that was checked, a session that waits."""
    page.locator("[data-test=toy] .q-spinner").wait_for(state="detached")
    if not marked(page, "chosen").count():
        marked(page, "virtual").click()
        marked(page, "chosen").wait_for()
    if not marked(page, "job-done").count():
        marked(page, "check").click()
    marked(page, "job-done").first.wait_for(timeout=LONG_MS)
    if not marked(page, "trial").count():
        marked(page, "test").click()
    page.locator("[data-test=trial].ps-message-good").wait_for()


def _record(page: Any, studio: Studio) -> None:
    """A session whose third recording is asked for, in the words of the page's language."""
    code = _code(page.evaluate("document.documentElement.lang")[:2])
    if not marked(page, "state-box").count():
        begun(page, studio.url, code, "plush-17")
        for _ in range(2):
            page.keyboard.press("Space")
            showing(page, "recording.")
            page.wait_for_timeout(200)
            page.keyboard.press("Space")
            showing(page, "idle.")
        page.reload()
    sat(page, f"{code}/1")
    page.wait_for_timeout(300)


def _code(language: str) -> str:
    """Who is recorded in this language."""
    return "S02" if language == "en" else "S03"


def _review(page: Any, studio: Studio) -> None:
    """One recording, with what is suggested for it."""
    page.wait_for_function("() => document.querySelector('[data-test=making]')?.textContent === ''")
    page.wait_for_selector("[data-test=plot][data-recording] .uplot")


def _train(page: Any, studio: Studio) -> None:
    """What a proof on people left out came to."""
    page.locator('[data-do^="open:"], tr[data-row] button').first.click()
    page.locator("[data-cell]").first.wait_for()
    marked(page, "results").scroll_into_view_if_needed()


def _live(page: Any, studio: Studio) -> None:
    """A virtual toy is read, and something was felt."""
    if marked(page, "start").is_visible():
        marked(page, "start").click()
    marked(page, "events").locator("li[data-id]").first.wait_for(state="attached")
    page.wait_for_timeout(500)


def _export(page: Any, studio: Studio) -> None:
    """An export, with what it costs."""
    if not (studio.home / "exports" / "little").exists():
        marked(page, "name").fill("little")
        marked(page, "do").click()
        marked(page, "export-facts").wait_for(timeout=LONG_MS)
        page.goto(f"{studio.url}/export?name=little")
        connected(page)
    marked(page, "export-facts").wait_for()


def _publish(page: Any, studio: Studio) -> None:
    """What the data set does not say yet."""
    marked(page, "new").wait_for()


SCENES: dict[str, Callable[[Any, Studio], None]] = {
    "home": _home,
    "record": _record,
    "review": _review,
    "train": _train,
    "live": _live,
    "export": _export,
    "publish": _publish,
}


def _address(name: str, view: View, studio: Studio) -> str:
    """Where the scene is played, so that no page is loaded only to be left again."""
    there = {
        "review": "?dataset=datasets/virtual&view=one&gesture=Back%20stroke%201",
        "export": "?name=little" if (studio.home / "exports" / "little").exists() else "",
        "record": f"?session={_code(view.language)}/1"
        if (studio.home / "recordings" / _code(view.language)).exists()
        else "?new=1",
    }
    return studio.url + PAGES[name] + there.get(name, "")


_SCROLLED = {"train": "results", "export": "detail"}
"""What the picture begins with, where that is not the top."""

# Text that does not fit its box, and boxes that reach over the right edge, but for what may be scrolled.
_CUT = """() => {
  const cut = [];
  const scrolled = e => { for (; e; e = e.parentElement) {
    const s = getComputedStyle(e);
    if (s.overflowX === 'auto' || s.overflowX === 'scroll') return true; } return false; };
  for (const e of document.querySelectorAll('body *')) {
    const box = e.getBoundingClientRect(), style = getComputedStyle(e);
    if (box.width < 3 || box.height < 3 || style.visibility === 'hidden') continue;
    const own = [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim());
    if (!own) continue;
    const hidden = ['hidden', 'clip'].includes(style.overflowX);
    if (hidden && e.scrollWidth > e.clientWidth + 1 || box.right > innerWidth + 1 && !scrolled(e.parentElement))
      cut.push(e.textContent.trim().slice(0, 80));
  }
  return cut;
}"""


@pytest.fixture(scope="module")
def furnished(furniture: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    """One studio for all pictures: a data set, a bundle, a session, a toy at four times the speed."""

    def build(folder: Path) -> None:
        home = Path(shutil.copytree(furniture, folder / "home"))
        record(Workspace(home), "S01")
        data = home / "datasets" / "virtual"
        out = data / "evaluations" / "by-subject-3"
        evaluate_apart(data, out, "--split", "by-subject:3", "--preset", "loso", "--epochs", "8" if KEPT else "1")

    home = built_once(tmp_path_factory, "pictures", build) / "home"
    one = Studio(Path(shutil.copytree(home, tmp_path_factory.mktemp("pictures") / "home")), ("--speed", "4")).start()
    yield one
    one.stop()


def test_every_page_has_a_scene() -> None:
    assert list(SCENES) == list(PAGES)


@pytest.mark.parametrize("view", VIEWS, ids=lambda v: v.name)
# A recording and a live view go on after their pictures and would slow down the other pages.
@pytest.mark.parametrize("name", sorted(SCENES, key=lambda name: name in ("record", "live")))
@pytest.mark.exhaustive_for(
    "*-phone-dark-lv", "*-tablet-light-lv", "*-wide-dark-en", "export-desk-*", "live-desk-*", "record-desk-*"
)
def test_a_page_reads_well(name: str, view: View, furnished: Studio, look: Fixture) -> None:
    browser: Look = look(view.size, view.dark, view.language, touch=view.size in (TABLET, PHONE))
    page = browser.open(_address(name, view, furnished))
    SCENES[name](page, furnished)
    page.evaluate("document.fonts.ready")
    assert axe(page) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), "the page is wider than the screen"
    assert page.evaluate(_CUT) == []
    assert view.language == "en" or english(page) == []
    assert page.evaluate("document.body.classList.contains('body--dark')") is view.dark
    assert page.evaluate("document.documentElement.lang")[:2] == view.language
    page.evaluate("scrollTo(0, 0)")
    if name in _SCROLLED:
        marked(page, _SCROLLED[name]).evaluate("e => scrollTo(0, e.getBoundingClientRect().top + scrollY - 80)")
    png = page.screenshot(animations="disabled")
    if name == "live" and view is VIEWS[-1]:
        # Otherwise the toy would be read for another minute.
        marked(page, "stop").click()
        marked(page, "start").wait_for()
    assert browser.complaints == []
    keep_picture(
        png, f"{name}-{view.name}", 960 if view.size[0] > view.size[1] else 615 if view.size == TABLET else 390
    )
