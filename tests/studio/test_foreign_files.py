"""Files of sensors that are new to the studio come in by clicks, and are used to the end."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.importing.pattern import read_pattern
from plushsense.dataset.index import open_dataset
from support.browsing import LONG_MS, PHONE, axe, marked
from support.foreign_folders import diary, glove
from support.requirements import installed
from support.trainings import train_apart
from support.xdf_files import XdfStream, write_xdf

pytestmark = pytest.mark.slow

Fixture = Callable[..., Any]


def packed(folder: Path, target: Path, top: str) -> Path:
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*.csv")):
            archive.write(path, Path(top) / path.relative_to(folder))
        archive.writestr("../../outside.csv", "1")
    return target


def bring(page: Any, *paths: Path, button: str = "choose_files") -> None:
    with page.expect_file_chooser() as chooser:
        marked(page, button).click()
    chooser.value.set_files([str(p) for p in paths] if button == "choose_files" else str(paths[0]))


def pick(page: Any, field: str, *options: str) -> None:
    marked(page, f"map-{field}").click()
    for name in options:
        page.get_by_role("option", name=name).first.click()
    if len(options) > 1 or field in ("channels", "idle"):
        page.keyboard.press("Escape")


def keep(page: Any, name: str) -> None:
    marked(page, "incoming-name").fill(name, timeout=LONG_MS)
    marked(page, "import").click()
    marked(page, "dataset").get_by_text(name, exact=True).first.wait_for()


def test_a_zip_of_a_new_sensor_comes_in_and_is_used_to_the_end(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    browser = look()
    url = studio().url
    page = browser.open(url)
    bring(page, packed(glove(tmp_path / "glove"), tmp_path / "glove.zip", "our study"))
    rows = marked(page, "mapping-rows")
    rows.get_by_text("our study/S01/hug-take1.csv").first.wait_for(timeout=LONG_MS)
    assert [rows.get_by_role("columnheader").nth(k).inner_text() for k in (1, 2, 4, 5)] == [
        "Person", "Gesture", "druck_links", "druck_rechts",
    ]  # fmt: skip
    assert rows.get_by_role("row").count() == 11
    assert marked(page, "doubt").all_inner_texts() == [
        "Guessed. Are these people?", "Guessed. Are these gestures?", "The unit is guessed.",
    ]  # fmt: skip
    marked(page, "rejected").get_by_text("1").first.wait_for()
    assert axe(page) == []
    # A wrong choice can be seen in the rows, and is mended by another.
    pick(page, "subject", "name of the folder: our study")
    rows.get_by_role("cell", name="our study", exact=True).first.wait_for(timeout=LONG_MS)
    pick(page, "subject", "name of the folder: S01")
    rows.get_by_role("cell", name="S02", exact=True).first.wait_for(timeout=LONG_MS)
    assert marked(page, "doubt").count() == 2, "what was chosen is no guess any more"
    pick(page, "channels", "Druck rechts")
    rows.get_by_role("columnheader", name="druck_rechts").wait_for(state="detached", timeout=LONG_MS)
    pick(page, "channels", "Druck rechts")
    rows.get_by_role("columnheader", name="druck_rechts").wait_for(timeout=LONG_MS)
    marked(page, "mapping-right").click()
    marked(page, "preview").get_by_text("S01 (20), S02 (20), S03 (20)").wait_for(timeout=LONG_MS)
    keep(page, "gloves")
    assert not (tmp_path / "outside.csv").exists()
    pattern = home / "patterns" / "glove.toml"
    assert "our study" not in pattern.read_text() and read_pattern(pattern).decimal == ","
    # The next folder of that kind comes in without a question.
    bring(page, glove(tmp_path / "more", ("S04",)), button="choose_folder")
    marked(page, "preview").get_by_text("Read as the files of “glove” were.").wait_for(timeout=LONG_MS)
    keep(page, "more gloves")
    assert open_dataset(home / "datasets" / "more gloves").subjects == ["S04"]
    # It is trained, watched with its recordings, and can be exported.
    options = ("--arch", "3d1_3d1", "--filters", "4,6", "--epochs", "1", "--context", "loop")
    train_apart(home / "datasets" / "gloves", home / "bundles" / "glove.plush", *options)
    page.goto(f"{url}/live?model={home / 'bundles' / 'glove.plush'}")
    marked(page, "start").click()
    page.get_by_text("Choose a toy with the sensors of “glove”, or a recording in this list.").wait_for()
    marked(page, "toy").click()
    page.get_by_role("option", name="Recording of S01: hug (gloves)").click()
    marked(page, "start").click()
    page.get_by_text("The data of the toy have ended.").wait_for(timeout=LONG_MS)
    page.goto(f"{url}/export?model={home / 'bundles' / 'glove.plush'}")
    marked(page, "bundle-facts").get_by_text("glove", exact=True).wait_for(state="attached")
    assert marked(page, "bundle-cannot").count() == 0 and marked(page, "do").is_enabled()
    assert browser.complaints == []


def test_a_label_in_a_column_a_single_file_and_damaged_ones(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    browser = look(PHONE, True, "lv")
    page = browser.open(studio().url)
    folder = diary(tmp_path / "diary")
    bring(page, folder, button="choose_folder")
    rows = marked(page, "mapping-rows")
    rows.get_by_text("diary/nora.txt").first.wait_for(timeout=LONG_MS)
    assert "„nora” katrā failā ir cits: mēģinājums vai cilvēks?" in marked(page, "doubt").all_inner_texts()
    pick(page, "subject", "faila nosaukums: nora")
    rows.get_by_role("cell", name="nora", exact=True).first.wait_for(timeout=LONG_MS)
    pick(page, "idle", "ruhe")
    rows.get_by_role("cell", name="ruhe").first.wait_for(state="detached", timeout=LONG_MS)
    pick(page, "time_unit", "mikrosekundes")
    page.get_by_text("tiem varētu būt cita mērvienība").first.wait_for(timeout=LONG_MS)
    pick(page, "time_unit", "milisekundes")
    rows.get_by_role("cell", name="600", exact=True).first.wait_for(timeout=LONG_MS)
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth") and axe(page) == []
    marked(page, "mapping-right").click()
    keep(page, "diary")
    found = open_dataset(home / "datasets" / "diary")
    assert (found.subjects, len(found.recordings), len(found.streams)) == (["nora", "otto"], 12, 2)
    assert found.layout.names == ("s1", "s2") and found.layout.rate_hz == 50.0
    # A single table without a clock, of one person.
    one = tmp_path / "one.csv"
    lines = [f"{3 * k % 7};{3 * k % 5};{'hug' if k % 100 < 50 else 'poke'}" for k in range(400)]
    one.write_text("\n".join(["Alpha;Beta;was", *lines]))
    bring(page, one)
    marked(page, "map-rate_hz").wait_for(timeout=LONG_MS)
    marked(page, "map-rate_hz").fill("25")
    page.keyboard.press("Enter")
    rows.get_by_role("cell", name="40", exact=True).first.wait_for(timeout=LONG_MS)
    marked(page, "map-person").fill("S09")
    page.keyboard.press("Enter")
    rows.get_by_role("cell", name="S09", exact=True).first.wait_for(timeout=LONG_MS)
    marked(page, "mapping-right").click()
    keep(page, "one")
    assert open_dataset(home / "datasets" / "one").subjects == ["S09"]
    # What cannot be read is one sentence.
    (tmp_path / "noise.csv").write_bytes(bytes(range(256)) * 9)
    (tmp_path / "prose.csv").write_text("Dear diary,\nnothing happened\n")
    for name in ("noise.csv", "prose.csv"):
        bring(page, tmp_path / name)
        marked(page, "preview-problem").get_by_text("Šajos failos nav tabulas").wait_for(timeout=LONG_MS)
        marked(page, "import-cancel").click()
        marked(page, "preview").wait_for(state="detached")
    assert "(Angliski:)" not in page.locator("body").inner_text()
    assert browser.complaints == []


def test_folders_of_parquet_and_of_xdf(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    installed("polars", "tables")
    installed("pyxdf", "lsl")
    import polars as pl

    home, browser = tmp_path / "home", look()
    page = browser.open(studio().url)
    rows = marked(page, "mapping-rows")
    # A folder of Parquet, whose files have one name: person and gesture are in the path.
    for seed, (who, what) in enumerate((p, g) for p in ("A", "B") for g in ("hug", "poke") for _ in range(3)):
        place = tmp_path / "columns" / who / f"{what}_{seed}"
        place.mkdir(parents=True)
        values = [(7 * k + seed) % 11 for k in range(100)]
        pl.DataFrame({"t_ms": [20 * k for k in range(100)], "alpha": values}).write_parquet(place / "data.parquet")
    bring(page, tmp_path / "columns", button="choose_folder")
    rows.get_by_text("columns/A/hug_0/data.parquet").first.wait_for(timeout=LONG_MS)
    marked(page, "mapping-right").click()
    keep(page, "columns")
    assert len(open_dataset(home / "datasets" / "columns").recordings) == 12
    # LabRecorder's files of a sensor that is new, with a stream of markers.
    glove = XdfStream(
        "Glove", [0.01 * k for k in range(600)], [[k % 7, k % 5] for k in range(600)], labels=("left", "right")
    )
    cues = XdfStream("Cues", [0.5, 2.0, 2.5, 4.0], ["hug", "end", "poke", "end"], format="string", rate=0.0)
    for who in ("A", "B"):
        write_xdf(tmp_path / "lab" / who / "monday.xdf", [glove, cues])
    bring(page, tmp_path / "lab", button="choose_folder")
    rows.get_by_text("lab/A/monday.xdf").first.wait_for(timeout=LONG_MS)
    assert marked(page, "map-more").count() == 0, "there are no separators to choose"
    assert axe(page) == []
    marked(page, "mapping-right").click()
    keep(page, "lab")
    assert [r.gesture for r in open_dataset(home / "datasets" / "lab").recordings] == ["hug", "poke"] * 2
    assert browser.complaints == []
