"""The publish page in a real browser: the same package as the command's, the validators' answers, every refusal."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.about import Creator
from plushsense.dataset.publishing.checking import VALIDATORS
from plushsense.dataset.store import DatasetHead
from support.browsing import LONG_MS, TABLET, axe, connected, marked

Fixture = Callable[..., Any]
pytestmark = pytest.mark.usefixtures("publish_tools")


@pytest.mark.exhaustive
def test_publish_check_and_break(studio: Fixture, look: Fixture, few: Path, tmp_path: Path) -> None:
    url = studio(home=few).url
    browser = look()
    page = browser.open(f"{url}/publish")
    assert "Nothing is uploaded" in marked(page, "danger").inner_text()
    assert "does not state yet: title, description, authors, contact" in marked(page, "lacks").inner_text()
    marked(page, "do").click()
    page.get_by_text("Give a title.").wait_for()
    for missing in ("Describe the data", "Name at least one author", "A name and an e-mail address"):
        assert page.locator(".q-field--error").filter(has_text=missing).count() == 1
    assert not (few / "packages").exists()
    assert axe(page) == []
    statements = {"data-title": "Touch", "description": "Virtual people touch a toy.", "contact-name": "Ada"}
    for name, value in (
        statements | {"creator-name": "Byron, Ada", "creator-orcid": "1234", "contact-mail": "x"}
    ).items():
        marked(page, name).fill(value)
    marked(page, "save").click()
    page.get_by_text("“1234” is no ORCID iD").wait_for()
    page.get_by_text("“x” is no e-mail address").wait_for()
    marked(page, "creator-orcid").fill("0000-0002-1825-0097")
    marked(page, "contact-mail").fill("ada@example.org")
    marked(page, "creator-add").click()
    marked(page, "creator-name").nth(1).fill("Institute of Touch")
    marked(page, "with-key").click()
    marked(page, "name").fill("one")
    marked(page, "do").click()
    # What runs is there again after a reload.
    marked(page, "stop").wait_for()
    page.reload()
    connected(page)
    marked(page, "validators").wait_for(timeout=LONG_MS)
    answers = marked(page, "validators").inner_text()
    assert all(name in answers for name in VALIDATORS) and answers.count("✓ passed") == len(VALIDATORS)
    assert "recognises the right one of 3 people" in marked(page, "recognised").inner_text()
    assert "These people are virtual" in marked(page, "recognised").inner_text()
    assert "Byron, Ada; Institute of Touch (" in marked(page, "citation").inner_text()
    # What was entered is stored in the data set, is there after the reload, and can be changed again.
    assert marked(page, "creator-orcid").nth(0).input_value() == "0000-0002-1825-0097"
    marked(page, "creator-remove").nth(1).click()
    marked(page, "save").click()
    marked(page, "message").get_by_text("Saved in the data set").wait_for()
    about = DatasetHead.read(few / "datasets" / "virtual").about
    assert about.creators == (Creator("Byron, Ada", "0000-0002-1825-0097"),) and about.title == "Touch"
    assert axe(page) == []
    key, made = few / "keys" / "virtual.key", few / "packages" / "one.zip"
    command = [sys.executable, "-m", "plushsense", "publish", str(few / "datasets" / "virtual")]
    marked(page, "creator-add").click()
    marked(page, "creator-name").nth(1).fill("Institute of Touch")
    marked(page, "save").click()
    marked(page, "message").get_by_text("Saved in the data set").wait_for()
    subprocess.run([*command, str(tmp_path / "two"), "--key", str(key)], check=True, capture_output=True)
    assert made.read_bytes() == (tmp_path / "two.zip").read_bytes(), "the command makes the same package, byte for byte"
    with page.expect_download() as loaded:
        marked(page, "download").click()
    assert Path(loaded.value.path()).read_bytes() == made.read_bytes()

    # Taken names, also that of a zip alone; then a package that somebody changed.
    for name in ("one", "two"):
        shutil.copy(made, few / "packages" / "two.zip")
        marked(page, "name").fill(name)
        marked(page, "do").click()
        page.locator(".q-field--error").get_by_text(f"“{name}").wait_for()
        marked(page, "message").get_by_role("button").click()
    made.unlink()
    (few / "packages" / "one" / "gestures.csv").write_text("Shake\n", "utf-8")
    other = look(TABLET, dark=True, language="lv", touch=True)
    tablet = other.open(f"{url}/publish?name=one")
    marked(tablet, "check").click()
    marked(tablet, "problems").wait_for(timeout=LONG_MS)
    assert "✗ nederīga" in marked(tablet, "answers").inner_text()
    assert "gestures.csv" in marked(tablet, "problems").inner_text()
    assert axe(tablet) == []
    assert tablet.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
    assert browser.complaints == [] and other.complaints == []


@pytest.mark.exhaustive
def test_pseudonyms_refusals_and_stop(studio: Fixture, look: Fixture, few: Path) -> None:
    head = few / "datasets" / "virtual" / "dataset.toml"
    silent = head.read_text("utf-8").replace('consent = "nobody: a simulation"', 'consent = ""')
    head.write_text(silent.replace('licence = "MIT"', 'licence = ""'), "utf-8")
    url = studio(home=few).url
    browser = look()
    page = browser.open(f"{url}/publish")
    marked(page, "do").click()
    page.get_by_text("State what the people consented to.").wait_for()
    page.get_by_text("Choose a licence.").wait_for()
    assert "P01, P02, P03" in marked(page, "advice").inner_text()
    marked(page, "with-pseudonyms").click()
    assert marked(page, "with-key").get_attribute("aria-checked") == "true"
    marked(page, "key").fill("../people.csv")
    assert axe(page) == []
    marked(page, "licence").click()
    page.get_by_role("option", name="CC-BY-4.0: ").click()
    for name in ("data-title", "description", "creator-name", "contact-name", "consent"):
        marked(page, name).fill("all agreed")
    marked(page, "contact-mail").fill("ada@example.org")
    marked(page, "do").click()
    page.get_by_text("“../people.csv” cannot be a name").wait_for()
    marked(page, "key").fill("people.csv")
    marked(page, "name").fill("stopped")
    marked(page, "do").click()
    marked(page, "stop").click()
    marked(page, "ended").get_by_text("Stopped").wait_for(timeout=LONG_MS)
    assert not (few / "packages" / "stopped.zip").exists()
    # What was said is still there, and the disk's refusal is a sentence.
    shutil.rmtree(few / "packages", ignore_errors=True)
    (few / "packages").write_text("")
    page.reload()
    connected(page)
    assert marked(page, "contact-mail").input_value() == "ada@example.org"
    marked(page, "with-reidentification").click()
    marked(page, "do").click()
    marked(page, "ended").get_by_text("cannot be created").wait_for(timeout=LONG_MS)
    page.goto(f"{url}/publish?name=nothing")
    connected(page)
    assert "There is no package “nothing”" in marked(page, "message").inner_text()
    assert browser.complaints == []


def test_missing_extras_are_named(studio: Fixture, look: Fixture, few: Path) -> None:
    page = look().open(f"{studio(home=few, without=('mlcroissant', 'sklearn')).url}/publish")
    assert "pip install 'plushsense[publish]'" in marked(page, "missing-publish").inner_text()
    assert "pip install 'plushsense[baselines]'" in marked(page, "missing-baselines").inner_text()
    assert marked(page, "do").is_disabled()
    assert axe(page) == []
