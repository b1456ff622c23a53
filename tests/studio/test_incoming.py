"""Files of the visitor become data sets and networks, with a preview, in the page's language."""

from __future__ import annotations

import io
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.sentences import Message
from plushsense.dataset.backup import backup
from plushsense.dataset.importing.importers import ADOPTED
from plushsense.dataset.importing.results import SIMULATED
from plushsense.dataset.importing.sources import LAYOUT_GUESSED
from plushsense.dataset.index import open_dataset
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import DATASETS
from plushsense.studio.tasks import TASKS, TaskReporter
from support.accelerometers import analogue
from support.browsing import LONG_MS, TABLET, axe, marked

Fixture = Callable[..., Any]


def recordings(furniture: Path, person: str, count: int = 3) -> list[Path]:
    folder = furniture / "datasets" / "virtual" / "recordings" / person
    return sorted(folder.rglob("*.csv"))[:count]


def people(furniture: Path, folder: Path, *codes: str) -> Path:
    """Copy some recordings of each person into a folder of theirs."""
    for code in codes:
        (folder / code).mkdir(parents=True)
        for path in recordings(furniture, code):
            shutil.copy(path, folder / code)
    return folder


def zipped(folder: Path, target: Path) -> Path:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*.csv")):
            archive.write(path, path.relative_to(folder))
    return target


def inspect(dest: Path, *sources: Path, layout: str = "", person: str = "") -> dict[str, Any]:
    spec = {"sources": [str(s) for s in sources], "dest": str(dest), "layout": layout, "person": person}
    return TASKS["inspect"](spec, TaskReporter(io.StringIO()))


def drop(page: Any, *paths: Path) -> None:
    """Drop files or folders onto the page, as a person does with the mouse."""
    session = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(p) for p in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 300, "data": data})


def choose(page: Any, button: str, *paths: Path) -> None:
    with page.expect_file_chooser() as chooser:
        marked(page, button).click()
    chooser.value.set_files([str(p) for p in paths] if button == "choose_files" else str(paths[0]))


def test_sources_are_imported_together_and_what_is_refused_is_named(furniture: Path, tmp_path: Path) -> None:
    folder = people(furniture, tmp_path / "files", "P01")
    (folder / "notes.txt").write_text("hello")
    packed = zipped(people(furniture, tmp_path / "more", "P02"), tmp_path / "more.zip")
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip")
    found = inspect(tmp_path / "D", broken, packed, folder)
    assert found["people"] == {"P01": 3, "P02": 3}
    assert (found["layout"], found["recordings"], found["simulated"]) == ("plush-15", 6, True)
    reasons = {r["file"]: Words("en").sentence(r["reason"]) for r in found["rejected"]}
    assert reasons["notes.txt"] == "no recording" and "is no zip, or a damaged one" in reasons["broken.zip"]
    told = [note.template for note in found["notes"] if isinstance(note, Message)]
    assert (told[0], len(told), told[2]) == (SIMULATED.template, 3, LAYOUT_GUESSED)


def test_what_all_sources_prove_is_adopted_and_told(tmp_path: Path) -> None:
    folders = [analogue(tmp_path / f"R{p}", 330, 68, people=range(p, p + 1)) for p in range(2)]
    found = inspect(tmp_path / "D", *folders)
    (note,) = (n for n in found["notes"] if isinstance(n, Message) and n.template == ADOPTED)
    assert "which stands for zero" in note and found["people"] == {"P0": 6, "P1": 6}
    assert [round(c.offset, -1) for c in open_dataset(tmp_path / "D").layout.channels] == [330] * 3
    for language in ("en", "lv"):
        assert "offset: x 3" in Words(language).sentence(note) != note
    assert [n.template for n in inspect(tmp_path / "E", folders[0])["notes"]] == [LAYOUT_GUESSED, ADOPTED]


def test_the_person_of_loose_files_and_of_folders_of_gestures_can_be_given(furniture: Path, tmp_path: Path) -> None:
    loose = tmp_path / "loose"
    loose.mkdir()
    for path in recordings(furniture, "P01"):
        shutil.copy(path, loose)
    with pytest.raises(Exception, match="holds no recording") as refused:
        inspect(tmp_path / "D", loose)
    assert refused.value.message.values["needs"] == "person"
    assert inspect(tmp_path / "D", loose, person="S01")["people"] == {"S01": 3}
    for path in list(loose.iterdir()):
        (loose / path.name.split("_")[0]).mkdir(exist_ok=True)
        path.rename(loose / path.name.split("_")[0] / path.name)
    assert inspect(tmp_path / "E", loose)["people"] == {"unknown": 3}
    assert inspect(tmp_path / "F", loose, person="S01")["people"] == {"S01": 3}


def test_files_and_a_folder_are_chosen(studio: Fixture, look: Fixture, furniture: Path, tmp_path: Path) -> None:
    packed = zipped(people(furniture, tmp_path / "two", "P01", "P02"), tmp_path / "mine.zip")
    bad, broken = tmp_path / "bad.plush", tmp_path / "broken.zip"
    bad.write_bytes(b"nothing")
    broken.write_bytes(b"PK no zip")
    bomb = tmp_path / "bomb.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("P01/Tail pull_1700000000000_300.csv", b"0" * 20_000_000)
        archive.writestr("../../outside.csv", b"1")
    browser = look(TABLET)
    page = browser.open(studio().url)
    home = tmp_path / "home"
    choose(page, "choose_files", bad, furniture / "bundles" / "little.plush")
    page.get_by_role("alert").get_by_text("bad.plush: this is no network").wait_for()
    assert "gestures: 18" in marked(page, "bundle").inner_text()
    assert [p.name for p in (home / "bundles").iterdir()] == ["little.plush"]
    choose(page, "choose_files", broken)
    marked(page, "preview-problem").get_by_text("“broken.zip” is no zip").wait_for(timeout=LONG_MS)
    # Further files are added to those that are there.
    choose(page, "choose_files", packed, bomb)
    marked(page, "rejected").locator("summary").get_by_text("2").wait_for(timeout=LONG_MS)
    marked(page, "rejected").locator("summary").click()
    assert "P01 (3), P02 (3)" in marked(page, "preview").inner_text()
    assert axe(page) == []
    marked(page, "incoming-name").fill("brought")
    marked(page, "import").click()
    marked(page, "dataset").get_by_text("recordings: 6").wait_for()
    choose(page, "choose_folder", tmp_path / "two")
    marked(page, "incoming-name").fill("brought", timeout=LONG_MS)
    marked(page, "import").click()
    marked(page, "preview").get_by_role("alert").get_by_text("exists already").wait_for()
    marked(page, "import-cancel").click()
    marked(page, "preview").wait_for(state="detached")
    assert [p.name for p in (home / DATASETS).iterdir()] == ["brought"]
    assert list((home / "work" / "incoming").iterdir()) == []
    assert not (tmp_path / "outside.csv").exists()
    huge = tmp_path / "huge.zip"
    with huge.open("wb") as file:
        file.truncate(500_000_001)
    choose(page, "choose_files", huge)
    page.get_by_role("alert").get_by_text("larger than 500 MB").wait_for()
    assert browser.complaints == []


@pytest.mark.exhaustive
def test_files_are_dropped_and_what_is_missing_is_asked_in_latvian(
    studio: Fixture, look: Fixture, furniture: Path, tmp_path: Path
) -> None:
    browser = look((390, 844), True, "lv")
    page = browser.open(studio().url)
    drop(page, *recordings(furniture, "P01"))
    marked(page, "preview").get_by_text("Nav zināms, kura cilvēka").wait_for(timeout=LONG_MS)
    marked(page, "person-of-files").fill("S05")
    page.keyboard.press("Enter")
    marked(page, "preview").get_by_text("S05 (3)").wait_for(timeout=LONG_MS)
    marked(page, "import").wait_for(timeout=LONG_MS)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert axe(page) == []
    marked(page, "import").click()
    marked(page, "message").get_by_text("ir gatava").wait_for()
    saved = tmp_path / "virtual.zip"
    backup(furniture / "datasets" / "virtual", saved)
    drop(page, saved)
    marked(page, "preview").get_by_text("datu kopas „virtual toy” rezerves kopija").wait_for(timeout=LONG_MS)
    marked(page, "import").click()
    marked(page, "dataset").get_by_text("virtual toy", exact=True).wait_for()
    assert sorted(p.name for p in (tmp_path / "home" / DATASETS).iterdir())[1:] == ["virtual toy"]
    # A large upload shows its progress, and can be cancelled.
    session = page.context.new_cdp_session(page)
    session.send("Network.enable")
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": 100_000}
    session.send("Network.emulateNetworkConditions", slow)
    (tmp_path / "slow.zip").write_bytes(bytes(8_000_000))
    drop(page, tmp_path / "slow.zip")
    marked(page, "uploading").get_by_text("%").wait_for()
    marked(page, "uploading").get_by_role("button").click()
    marked(page, "message").get_by_text("Augšupielāde atcelta").wait_for()
    assert "(Angliski:)" not in page.locator("body").inner_text()
    assert browser.complaints == []
