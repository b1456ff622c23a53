"""The record page proposes a code, and asks before two people become one or a name is recorded."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.privacy.removed import remember_removed
from plushsense.studio.app.workspace import Workspace
from support.browsing import PHONE, axe, connected, marked
from support.recorded import record
from support.recording_pages import CALM, choose, sat

Fixture = Callable[..., Any]


@pytest.mark.slow
def test_codes_are_proposed_compared_and_questioned(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    record(Workspace(home), "S01")
    remember_removed(home, "S02")
    url = studio("--device", CALM, "--speed", "10", home=home).url
    browser = look(PHONE)
    page = browser.open(url + "/record?new=1")
    code, question = marked(page, "code"), marked(page, "ask")
    assert code.input_value() == "S03"
    # Nobody touches the toy at rest: there is no code to propose.
    choose(page, "protocol", "The toy at rest")
    page.wait_for_function("() => document.querySelector('[data-test=code]').value === ''")
    choose(page, "protocol", "Short trial")
    page.wait_for_function("() => document.querySelector('[data-test=code]').value === 'S03'")
    for typed, sentence in (("s1", "almost like S01"), ("Anna2015", "looks like a name"), ("S02", "removed for good")):
        code.fill(typed)
        marked(page, "begin").click()
        question.get_by_text(sentence).wait_for()
        assert axe(page) == []
        if typed != "S02":
            question.get_by_role("button", name="Cancel").click()
            question.wait_for(state="detached")
    question.get_by_role("button", name="Take S03").click()
    sat(page, "S03/1")
    assert sorted(p.name for p in (home / "recordings").iterdir()) == ["S01", "S03"]
    marked(page, "end").click()
    marked(page, "end-yes").click()
    page.wait_for_url("**/record?ended=S03/1")
    connected(page)
    # It was S01 after all.
    marked(page, "unfinished-S03/1").locator("[data-test=menu]").click()
    page.get_by_role("menuitem", name="Correct the person's code").click()
    marked(page, "ask-text").fill("s01")
    marked(page, "ask-go").click()
    question.get_by_role("button", name="Yes, it is S01").click()
    marked(page, "unfinished-S01/2").wait_for()
    assert sorted(p.name for p in (home / "recordings").iterdir()) == ["S01"]
    assert browser.complaints == []
