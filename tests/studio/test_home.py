"""The home page says what is next, shows what is there, and takes recordings in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.privacy.removed import remember_removed
from plushsense.models.bundle import Bundle
from plushsense.studio.app.workspace import DATASETS, Workspace
from support.browsing import DESK, LONG_MS, TABLET, axe, marked
from support.bundles import odd_bundle
from support.recorded import record

pytestmark = pytest.mark.early

Fixture = Callable[..., Any]


def test_from_nothing_to_a_data_set_by_one_click(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    one = studio()
    browser = look()
    page = browser.open(one.url)
    assert axe(page) == []
    assert "virtual toy" in marked(page, "next-sentence").inner_text()
    marked(page, "next-button").click()
    page.get_by_text("A data set is being made").wait_for()
    # WorkSection goes on without the page, and is there again on the next.
    page.reload()
    marked(page, "job-done").wait_for(timeout=LONG_MS)
    sentence = marked(page, "next-sentence")
    sentence.get_by_text("train a network").wait_for()
    row = marked(page, "dataset")
    assert "people: 6" in row.inner_text() and "recordings: 212" in row.inner_text()
    assert "Simulation" in row.inner_text()
    assert "Virtual toy (simulation), person 7" in marked(page, "chosen").inner_text()
    row.get_by_role("button", name="Check").click()
    row.get_by_text("Checked:").wait_for(timeout=LONG_MS)
    assert axe(page) == []
    with page.expect_navigation():
        row.get_by_role("link", name="Review").click()
    assert "dataset=" in page.url
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_stopping_work(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    page = look().open(studio().url)
    marked(page, "next-button").click()
    marked(page, "job-stop").click()
    marked(page, "job-stopped").wait_for()
    assert not (tmp_path / "home" / "datasets" / "virtual toy").exists()
    marked(page, "job-again").click()
    marked(page, "job-done").wait_for(timeout=LONG_MS)
    marked(page, "job-drop").click()
    marked(page, "work").get_by_text("Nothing is running.").wait_for()
    assert (tmp_path / "home" / "datasets" / "virtual toy" / "dataset.toml").is_file()


@pytest.mark.exhaustive
def test_sessions_become_a_data_set_and_what_is_new_is_added(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path / "home")
    record(workspace, "S01")
    url = studio().url
    browser = look(TABLET)
    page = browser.open(url)
    assert "Some sessions are not in a data set yet: 1" in marked(page, "next-sentence").inner_text()
    name = marked(page, "batch").locator("[data-test=new-name]")
    assert name.input_value() == "recordings"
    name.fill("autumn & co")
    marked(page, "make").click()
    marked(page, "sessions").get_by_role("alert").get_by_text("cannot be a name").wait_for()
    assert axe(page) == []
    name.fill("autumn")
    marked(page, "make").click()
    marked(page, "dataset").get_by_text("recordings: 4").wait_for()
    marked(page, "message").get_by_text("S01/1 → autumn").wait_for()
    marked(page, "sessions").get_by_text("in the data sets “autumn”").wait_for()
    record(workspace, "S02")
    page.reload()
    marked(page, "next-button").get_by_text("Put them into a data set").click()
    marked(page, "job-done").get_by_text("new: 4").wait_for()
    marked(page, "dataset").get_by_text("recordings: 8").wait_for()
    page.locator("[data-test=batch] .q-checkbox").first.wait_for()
    # Nothing is ticked any more, for all is kept.
    marked(page, "make").click()
    marked(page, "message").get_by_text("No session is chosen").wait_for()
    assert axe(page) == []
    assert browser.complaints == []


def test_data_sets_and_networks_are_renamed_discarded_and_deleted(studio: Fixture, look: Fixture, home: Path) -> None:
    browser = look(TABLET)
    page = browser.open(studio(home=home).url)
    name = marked(page, "dataset").first.locator(".text-bold").inner_text()

    def menu(kind: str, item: str) -> None:
        marked(page, kind).first.locator("[data-test=menu]").click()
        page.get_by_role("menuitem", name=item).click()

    menu("dataset", "Rename")
    marked(page, "ask-text").fill("spring")
    marked(page, "ask-go").click()
    marked(page, "dataset").get_by_text("spring", exact=True).wait_for()
    marked(page, "undo").click()
    marked(page, "dataset").get_by_text(name, exact=True).first.wait_for()
    bundle = marked(page, "bundle").first.locator(".text-bold").inner_text()
    menu("bundle", "Rename")
    marked(page, "ask-text").fill("../network")
    marked(page, "ask-go").click()
    marked(page, "message").get_by_text("cannot be a name").wait_for()
    menu("bundle", "Discard")
    marked(page, "message").get_by_text("is discarded").wait_for()
    assert (home / "discarded" / "bundles" / f"{bundle}.plush").is_file()
    menu("dataset", "Discard")
    marked(page, "message").get_by_text(f"“{name}” is discarded").wait_for()
    marked(page, "discarded").locator("summary").click()
    assert axe(page) == []
    row = marked(page, "discarded").locator(".ps-row").filter(has_text="Network")
    row.get_by_role("button", name="Delete for good").click()
    marked(page, "ask").get_by_role("button", name="Cancel").click()
    row.get_by_role("button", name="Delete for good").click()
    marked(page, "ask-go").click()
    marked(page, "message").get_by_text("is deleted").wait_for()
    assert not (home / "discarded" / "bundles" / f"{bundle}.plush").exists()
    marked(page, "discarded").get_by_role("button", name="Restore").click()
    marked(page, "dataset").get_by_text(name, exact=True).first.wait_for()
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_the_toy_is_chosen_and_tested(studio: Fixture, look: Fixture, server: Callable[[bytes], str]) -> None:
    one = studio("--speed", "10")
    browser = look()
    page = browser.open(one.url)
    page.get_by_text("Looking for toys").wait_for(state="detached")
    assert "No toy is chosen yet." in marked(page, "toy").inner_text()
    page.get_by_role("combobox", name="Person who uses the virtual toy").click()
    page.get_by_role("option", name="Person 12").click()
    marked(page, "virtual").click()
    marked(page, "chosen").get_by_text("person 12").wait_for()
    marked(page, "trial").get_by_text("The toy works").wait_for()
    # Another tab shows the same toy, and hears of a change.
    second = browser.open(one.url)
    marked(second, "chosen").get_by_text("person 12").wait_for()
    wrong = {"http://x": "is no kind of toy", "tcp://10.0.0.1:99999": "from 1 to 65535", "": "Enter the address"}
    wrong |= {"serial:///dev/nothing": "There is no port /dev/nothing", "replay:///etc/passwd": "/etc/passwd"}
    for address, reason in wrong.items():
        marked(page, "address").fill(address)
        marked(page, "use").click()
        marked(page, "toy").get_by_role("alert").get_by_text(reason).wait_for()
    marked(page, "address").fill("virtual://?person=3")
    marked(page, "use").click()
    marked(second, "chosen").get_by_text("person 3").wait_for()
    marked(page, "address").fill("tcp://127.0.0.1:9")
    page.keyboard.press("Enter")
    marked(page, "chosen").get_by_text("Toy in the network 127.0.0.1:9").wait_for()
    marked(page, "trial").get_by_text("does not answer on port 9").wait_for()
    assert axe(page) == []
    # A toy with older firmware: its layout is found, and one press uses it.
    address = server(b" ".join([b"1"] * 13) + b" 10\n")
    marked(page, "address").fill(address)
    marked(page, "use").click()
    marked(page, "use-layout").click()
    marked(page, "trial").get_by_text("layout plush-14 fits").wait_for()
    assert browser.complaints == []


def test_a_full_home_with_broken_things(studio: Fixture, look: Fixture, home: Path) -> None:
    (home / DATASETS / "broken").mkdir()
    (home / DATASETS / "broken" / "dataset.toml").write_text("not = [toml")
    (home / "bundles" / "bad.plush").write_bytes(b"nothing")
    (home / "work").mkdir()
    (home / "work" / "1.json").write_text("{")
    url = studio("--device", "virtual://?person=2", home=home).url
    for language, dark, size in (("en", False, DESK), ("lv", True, TABLET)):
        browser = look(size, dark, language)
        page = browser.open(url)
        assert marked(page, "dataset").count() == 2
        assert marked(page, "bundle").count() == 2
        assert page.locator(".ps-bad").count() == 2
        assert "little" in marked(page, "next-sentence").inner_text()
        assert axe(page) == []
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert browser.complaints == []


@pytest.mark.parametrize("what", ["pages", "controls"])
def test_everything_is_within_reach_of_the_keyboard(what: str, studio: Fixture, look: Fixture, home: Path) -> None:
    page = look().open(studio(home=home).url)
    page.get_by_text("Looking for toys").wait_for(state="detached")
    reached = []
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "(e => (e.getAttribute('aria-label') || e.innerText || e.placeholder || e.dataset.test || '')"
                ".trim())(document.activeElement)"
            )
        )
    assert reached[0] == "Skip to the content"
    if what == "pages":
        assert reached[1:8] == ["Home", "Record", "Review", "Train", "Live", "Export", "Publish"]
    else:
        for name in ("Watch it live", "Review: virtual toy", "Check: virtual toy", "Use the virtual toy"):
            assert name in reached, reached


def test_everything_is_saved_in_one_file_and_opened_where_nothing_is_replaced(
    studio: Fixture, look: Fixture, few: Path, tmp_path: Path
) -> None:
    (few / "bundles").mkdir(exist_ok=True)
    odd_bundle(few / "bundles" / "net.plush")
    here = studio(home=few)
    page = look().open(here.url)
    marked(page, "save-everything").click()
    saved = marked(page, "job-done").filter(has_text="Saving")
    saved.get_by_text("data sets: 1 · networks: 1").wait_for(timeout=LONG_MS)
    with page.expect_download() as download:
        saved.locator('[data-test="download"]').click()
    file = tmp_path / "project.zip"
    download.value.save_as(file)
    # In the same studio: a second data set, and the same network once.
    with page.expect_file_chooser() as chooser:
        marked(page, "open-everything").click()
    chooser.value.set_files(file)
    marked(page, "job-done").filter(has_text="Opening").get_by_text("data sets: 1 · networks: 1").wait_for()
    page.wait_for_function("() => document.querySelectorAll('[data-test=dataset]').length === 2")
    assert sorted(p.name for p in (few / "datasets").iterdir() if p.is_dir()) == ["virtual", "virtual 2"]
    assert [p.name for p in (few / "bundles").iterdir()] == ["net.plush"]
    # A person who was removed comes back after a question only, by the data sets as by a network.
    remember_removed(few, "P01")
    network = Bundle.load(few / "bundles" / "net.plush")
    network = replace(network, provenance={**network.provenance, "subjects": ["P01"]})
    network.save(tmp_path / "of P01.plush")
    for answer, datasets, networks in (("ask-other", 2, 1), ("ask-go", 3, 2)):
        for chosen in (file, tmp_path / "of P01.plush"):
            with page.expect_file_chooser() as chooser:
                marked(page, "choose_files").click()
            chooser.value.set_files(chosen)
            question = marked(page, "ask").filter(has_text="P01 was removed")
            question.wait_for()
            if answer == "ask-other" and chosen != file:
                question.get_by_role("button", name="Cancel").click()
            else:
                marked(page, answer).click()
            question.wait_for(state="detached")
        page.wait_for_function(f"() => document.querySelectorAll('[data-test=dataset]').length === {datasets}")
        assert len(list((few / "bundles").iterdir())) == networks
