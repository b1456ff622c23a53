"""Where a session goes is asked, with the last choice preselected; it is shown afterwards, and can be undone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks, read_marks
from plushsense.dataset.privacy.forget import take_out
from plushsense.dataset.store import read_people
from plushsense.studio.app.workspace import Workspace
from plushsense.workflow.api import import_recordings
from support.browsing import LONG_MS, PHONE, axe, connected, english, marked
from support.recorded import record
from support.recording_pages import choose

if TYPE_CHECKING:
    from playwright.sync_api import Page

Fixture = Callable[..., Any]


def collected(page: Page, session: str, dataset: str) -> None:
    """Press the button of the ended session; the review page shows its recordings only, and where they are."""
    marked(page, "collect").click()
    page.wait_for_url("**/review?dataset=**", timeout=LONG_MS)
    connected(page)
    marked(page, "selection").get_by_text(f"Only the linked recordings (4). {session} → {dataset}").wait_for()


def undone(page: Page) -> None:
    marked(page, "selection").get_by_role("button", name="Undo").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)


def test_where_a_session_goes_is_asked_shown_and_undone(studio: Fixture, look: Fixture, few: Path) -> None:
    workspace = Workspace(few)
    trial = few / "datasets" / "virtual"
    before = sorted(r.id for r in open_dataset(trial).recordings)
    record(workspace, "S01")
    record(workspace, "S02")
    server, browser = studio(home=few), look()
    # The first child does not land in the trial set, but in a data set of its own name.
    page = browser.open(f"{server.url}/record?ended=S01/1")
    assert marked(page, "destination").input_value() == "a new data set"
    marked(page, "new-name").fill("Class A")
    assert axe(page) == []
    collected(page, "S01/1", "Class A")
    assert axe(page) == []
    page.reload()
    connected(page)
    undone(page)
    assert not (few / "datasets" / "Class A").exists()
    # From a data set that holds more, only this session is taken out again.
    choose(page, "destination", "virtual toy")
    marked(page, "new-name").wait_for(state="hidden")
    collected(page, "S01/1", "virtual toy")
    assert len(open_dataset(trial).recordings) == len(before) + 4
    # What was decided about the recordings since is not dropped without a question.
    mine = next(r.id for r in open_dataset(trial).recordings if r.subject == "S01")
    append_marks(trial, [Mark(mine, "trim", "A", "", start=3, stop=90)])
    marked(page, "selection").get_by_role("button", name="Undo").click()
    question = marked(page, "ask")
    question.get_by_text("1 recording is trimmed, left out or decided otherwise since").wait_for()
    assert axe(page) == []
    question.get_by_role("button", name="Cancel").click()
    question.wait_for(state="hidden")
    assert read_marks(trial)[mine].trimmed
    marked(page, "selection").get_by_role("button", name="Undo").click()
    marked(page, "ask-go").click()
    page.wait_for_url("**/record?ended=S01/1")
    connected(page)
    assert sorted(r.id for r in open_dataset(trial).recordings) == before
    assert marked(page, "destination").input_value() == "virtual toy", "the last choice"
    choose(page, "destination", "a new data set")
    marked(page, "new-name").fill("Class A")
    collected(page, "S01/1", "Class A")
    # The next child: the last choice is preselected at Home, too, and one click is enough.
    page.goto(server.url)
    connected(page)
    assert marked(page, "next").get_by_role("combobox").input_value() == "Class A"
    marked(page, "next-button").click()
    message = marked(page, "message")
    message.get_by_text("S02/1 → Class A").wait_for(timeout=LONG_MS)
    assert axe(page) == []
    message.get_by_role("button", name="Undo").click()
    message.get_by_text("Undone.").wait_for()
    assert {r.subject for r in open_dataset(few / "datasets" / "Class A").recordings} == {"S01"}
    marked(page, "make").click()
    message.get_by_text("S02/1 → Class A").wait_for(timeout=LONG_MS)
    marked(page, "job-done").first.get_by_role("link", name="Review").click()
    page.wait_for_url("**session=S02/1**")
    connected(page)
    marked(page, "selection").get_by_text("S02/1 → Class A").wait_for()
    latvian = look(PHONE, language="lv", dark=True).open(f"{server.url}/record?ended=S01/1")
    assert english(latvian) == [] and axe(latvian) == []
    assert latvian.evaluate("() => document.documentElement.scrollWidth <= innerWidth")
    assert browser.complaints == []


def test_only_the_session_is_taken_out(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "home")
    first = record(workspace, "S01")
    import_recordings(workspace.recordings, tmp_path / "DS")
    alone = sorted(r.id for r in open_dataset(tmp_path / "DS").recordings)
    second, other = record(workspace, "S01", "2"), record(workspace, "S02")
    import_recordings(workspace.recordings, tmp_path / "DS", add_to=True)
    dataset = open_dataset(tmp_path / "DS")
    for info in dataset.recordings:
        dataset.append_marks([Mark(info.id, "exclude", "S", "test")])
    take_out(tmp_path / "DS", second)
    take_out(tmp_path / "DS", other)
    left = open_dataset(tmp_path / "DS")
    assert sorted(r.id for r in left.recordings) == alone == sorted(read_marks(tmp_path / "DS"))
    assert [s.session for s in left.streams] == ["1"] and "S02" not in read_people(tmp_path / "DS")
    assert len(list(second.glob("*.csv"))) == 5, "the session itself stays"
    with pytest.raises(DatasetError, match="does not hold the session S01/2"):
        take_out(tmp_path / "DS", second)
    next(first.glob("*_*_*.csv")).write_text("0 0 0\n", "utf-8")
    with pytest.raises(DatasetError, match="as it was recorded"):
        take_out(tmp_path / "DS", first)
    import_recordings(workspace.recordings / "S02", tmp_path / "DS", add_to=True)
