"""The last choice is preselected on every page: after a child, on another page, and after a restart."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.studio.app.choices import FILE, Choices
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.workspace import Workspace
from support.browsing import connected, marked
from support.recording_pages import CALM, choose

Fixture = Callable[..., Any]


def test_the_last_choice_is_kept_on_every_page_and_over_a_restart(studio: Fixture, look: Fixture, few: Path) -> None:
    shutil.copytree(few / "datasets" / "virtual", few / "datasets" / "class-b")
    head = few / "datasets" / "class-b" / "dataset.toml"
    head.write_text(head.read_text("utf-8").replace('name = "virtual toy"', 'name = "Class B"'), "utf-8")
    server, browser = studio("--speed", "5", home=few), look()
    page = browser.open(f"{server.url}/train")
    field = marked(page, "dataset")
    first = field.input_value()
    choose(page, "dataset", "virtual toy" if first == "Class B" else "Class B")
    page.wait_for_function("first => document.querySelector('[data-test=dataset] input').value !== first", arg=first)
    chosen = marked(page, "dataset").input_value()
    for other in ("publish", "review", "train"):
        page.goto(f"{server.url}/{other}")
        connected(page)
        assert chosen in marked(page, "dataset").input_value()
    # The toy, the protocol and the wording of the child before.
    page.goto(f"{server.url}/record")
    connected(page)
    choose(page, "protocol", "Short trial")
    choose(page, "wording", "For children, English")
    marked(page, "other_toy").fill(CALM)
    marked(page, "code").fill("S01")
    marked(page, "begin").click()
    page.wait_for_url("**/record?session=S01/1")
    for restarted in (False, True):
        if restarted:
            page.goto("about:blank")
            server.stop()
            server.start()
        page.goto(f"{server.url}/record?new=1")
        connected(page)
        assert marked(page, "protocol").input_value().startswith("Short trial")
        assert marked(page, "wording").input_value() == "For children, English"
        assert marked(page, "toy").input_value() == "Virtual toy (simulation), person 7"
    page.goto(f"{server.url}/publish")
    connected(page)
    assert chosen in marked(page, "dataset").input_value()
    # A page in another language proposes its own words.
    latvian = look(language="lv").open(f"{server.url}/record?new=1")
    assert marked(latvian, "wording").input_value() == "Latviski"
    assert browser.complaints == []


@pytest.mark.early
def test_a_choice_that_is_gone_is_not_preselected(tmp_path: Path) -> None:
    choices = Choices(Workspace(tmp_path))
    assert choices.last("dataset", ["a", "b"]) == "a" and choices.last("dataset", []) == "" == choices.last("toy")
    choices.keep(dataset="b", toy="virtual://?person=3")
    again = Choices(Workspace(tmp_path))
    assert again.last("dataset", ["a", "b"]) == "b" and again.last("dataset", ["a", "c"], "c") == "c"
    assert Toys(Workspace(tmp_path)).simulated
    assert Workspace(tmp_path, devices=("serial:///dev/given",)).toy == "serial:///dev/given"
    choices.keep(toy="replay:///etc/passwd")
    assert not Toys(Workspace(tmp_path)).simulated, "a file outside of the studio's folder is not opened"
    (tmp_path / FILE).write_text("[", "utf-8")
    assert Choices(Workspace(tmp_path)).last("toy") == ""
