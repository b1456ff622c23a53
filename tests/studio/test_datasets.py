"""The menu of a data set: backups and their restoring, and the removal of a person."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from plushsense.dataset.backup import check_backup
from support.browsing import LONG_MS, axe, marked

Fixture = Callable[..., Any]


def test_a_backup_is_made_a_person_removed_and_the_backup_restored(studio: Fixture, look: Fixture, home: Path) -> None:
    (home / "recordings" / "P02").mkdir(parents=True)
    browser = look((390, 844), False, "lv")
    page = browser.open(studio(home=home).url)

    def menu(item: str) -> None:
        marked(page, "dataset").first.locator("[data-test=menu]").click()
        page.get_by_role("menuitem", name=item).click()

    menu("Izveidot rezerves kopiju")
    marked(page, "job-done").get_by_text("Uzrakstīta un pārbaudīta").wait_for(timeout=LONG_MS)
    with page.expect_download() as loaded:
        marked(page, "download").click()
    assert check_backup(loaded.value.path()).subjects == 6
    menu("Dzēst cilvēku")
    marked(page, "forget").get_by_role("combobox").click()
    page.get_by_role("option", name="P02").click()
    marked(page, "forget").get_by_text("ieraksti un plūsmas").wait_for()
    # What is left elsewhere is listed, too.
    marked(page, "forget").get_by_text(str(home / "recordings" / "P02"), exact=True).wait_for()
    marked(page, "forget").get_by_text("backups").wait_for()
    assert axe(page) == []
    marked(page, "forget-next").click()
    marked(page, "forget-code").fill("P01")
    marked(page, "forget-go").click()
    marked(page, "forget").get_by_text("nav izvēlētā cilvēka kods").wait_for()
    assert (home / "datasets" / "virtual" / "recordings" / "P02").is_dir()
    marked(page, "forget-code").fill("P02")
    page.keyboard.press("Enter")
    marked(page, "job-done").get_by_text("Cilvēks ir izdzēsts").wait_for(timeout=LONG_MS)
    marked(page, "dataset").get_by_text("cilvēki: 5").wait_for()
    assert not (home / "datasets" / "virtual" / "recordings" / "P02").exists()
    # The studio does not keep the code either.
    assert not [p for p in (home / "work").glob("*.json") if "P02" in p.read_text(encoding="utf-8")]
    marked(page, "backups").locator("summary").click()
    marked(page, "backups").get_by_role("button", name="Atjaunot").click()
    marked(page, "dataset").get_by_text("cilvēki: 6").wait_for(timeout=LONG_MS)
    marked(page, "backups").get_by_role("button", name="Izmest").click()
    marked(page, "discarded").wait_for()
    assert list((home / "backups").glob("*")) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert axe(page) == []
    assert browser.complaints == []
