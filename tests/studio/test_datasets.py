"""Backups of a data set; a person is forgotten everywhere, and comes back only if somebody says so."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.backup import check_backup
from plushsense.dataset.publishing.description import CHECKSUMS
from plushsense.studio.app.workspace import Workspace
from support.browsing import LONG_MS, axe, connected, marked
from support.recorded import record

Fixture = Callable[..., Any]


@pytest.mark.slow
def test_a_person_is_forgotten_everywhere_and_comes_back_by_no_single_click(
    studio: Fixture, look: Fixture, home: Path, tmp_path: Path
) -> None:
    record(Workspace(home), "P02")
    dataset = home / "datasets" / "virtual"
    browser = look((390, 844), False, "lv")
    page = browser.open(studio(home=home).url)
    box, traces = marked(page, "forget"), marked(page, "forget-traces")

    def choose_to_forget(person: str) -> None:
        marked(page, "forget-open").click()
        box.get_by_role("combobox").click()
        page.get_by_role("option", name=person, exact=True).click()
        traces.wait_for()

    def removed(sentence: str) -> None:
        marked(page, "job-done").get_by_text(sentence).wait_for(timeout=LONG_MS)

    marked(page, "dataset").first.locator("[data-test=menu]").click()
    page.get_by_role("menuitem", name="Izveidot rezerves kopiju").click()
    removed("Uzrakstīta un pārbaudīta")
    with page.expect_download() as loaded:
        marked(page, "download").click()
    assert check_backup(loaded.value.path()).subjects == 6
    # Everything is listed with ticks; what is not ticked stays.
    assert "nav nevienā datu kopā: 1" in marked(page, "next-sentence").inner_text()
    choose_to_forget("P02")
    assert traces.get_by_role("checkbox", checked=True).count() == 4
    listed = traces.inner_text()
    assert [text in listed for text in ("Datu kopa", "„little”", "P02: ierakst", ".zip”")] == [True] * 4, listed
    assert marked(page, "forget-backup").get_by_text("kas nav atzīmēta, šis cilvēks paliek").count() == 1
    assert axe(page) == []
    for kept in ("ierakstītās sesijas", "Rezerves kopija"):
        traces.get_by_role("checkbox", name=kept).click()
    marked(page, "forget-code").fill("P01")
    marked(page, "forget-go").click()
    box.get_by_text("nav izvēlētā cilvēka kods").wait_for()
    assert (dataset / "recordings" / "P02").is_dir()
    marked(page, "forget-code").fill("P02")
    page.keyboard.press("Enter")
    removed("izdzēsts: 2. Nav izdzēsts: 2.")
    assert not (dataset / "recordings" / "P02").exists() and not list((home / "bundles").iterdir())
    with page.expect_download() as loaded:
        marked(page, "receipt").click()
    receipt = loaded.value.path().read_text(encoding="utf-8")
    assert "P02" in receipt and str(home / "recordings" / "P02") in receipt.partition("Nav izdzēsts:")[2]
    # The studio does not keep the code, but knows it again.
    assert not [p for p in (home / "work").glob("*.json") if "P02" in p.read_text(encoding="utf-8")]
    # No step, and no single click, brings the person back.
    marked(page, "next-sentence").filter(has_not_text="nav nevienā datu kopā").wait_for()
    sessions = marked(page, "sessions")
    sessions.get_by_text("cilvēks ir izdzēsts").click()
    sessions.locator("[data-test=make]").click()
    marked(page, "ask").get_by_text("P02 ir neatgriezeniski izdzēsts").wait_for()
    marked(page, "ask").get_by_role("button", name="Atcelt").click()
    with page.expect_file_chooser() as chooser:
        marked(page, "choose_folder").click()
    chooser.value.set_files(str(home / "recordings" / "P02"))
    marked(page, "preview").get_by_text("P02 ir neatgriezeniski izdzēsts").wait_for(timeout=LONG_MS)
    marked(page, "import-readmit").click()
    marked(page, "preview").get_by_text("P02 (4)").wait_for(timeout=LONG_MS)
    marked(page, "import-cancel").click()
    assert not (dataset / "recordings" / "P02").exists()
    marked(page, "backups").locator("summary").click()
    marked(page, "backups").get_by_role("button", name="Atjaunot").click()
    marked(page, "ask-go").click()
    marked(page, "dataset").get_by_text("cilvēki: 6").wait_for(timeout=LONG_MS)
    assert axe(page) == []
    # Once more, with all ticks: nothing of the person is left.
    page.reload()
    connected(page)
    choose_to_forget("P02")
    marked(page, "forget-code").fill("P02")
    marked(page, "forget-go").click()
    removed("izdzēsts: 3. Nav izdzēsts: 0.")
    assert [path for path in home.rglob("*") if "P02" in path.name] == [] == list((home / "backups").iterdir())
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert axe(page) == []
    # A package is deleted with its zip.
    (home / "packages" / "old").mkdir(parents=True)
    for file in (home / "packages" / "old" / CHECKSUMS, home / "packages" / "old.zip"):
        file.write_bytes(b"")
    page.goto(page.url.rstrip("/") + "/publish?name=old")
    connected(page)
    marked(page, "delete").click()
    marked(page, "ask-go").click()
    marked(page, "message").get_by_text("old” ir izdzēst").wait_for()
    assert list((home / "packages").iterdir()) == [] and not marked(page, "take").count()
    assert browser.complaints == []
