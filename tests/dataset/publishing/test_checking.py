"""Planted damage, each caught by the validators named; checksums are made anew where the damage is a careful one."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.files import sha256_of
from plushsense.dataset.publishing import checking
from plushsense.dataset.publishing.checking import VALIDATORS, PackageView, check_folder, validate_package
from plushsense.dataset.publishing.package import PublishResult
from plushsense.dataset.publishing.tables import write_checksums, write_zip
from support.requirements import LONG

pytestmark = pytest.mark.apart("publishing")

Damage = Callable[[Path], None]


def first_csv(root: Path) -> Path:
    return sorted((root / "data" / "recordings").rglob("*.csv"))[0]


def change(path: Path, old: str, new: str, count: int = 1) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8")


def edit(root: Path, file: str, how: Callable[[dict[str, Any]], None]) -> None:
    table = json.loads((root / file).read_text(encoding="utf-8"))
    how(table)
    (root / file).write_text(json.dumps(table), encoding="utf-8")


def flip_a_digit(root: Path) -> None:
    path = first_csv(root)
    lines = path.read_text().splitlines()
    cells = lines[7].split(",")
    cells[-1] = str(int(cells[-1]) + 1)
    lines[7] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def remove_a_file(root: Path) -> None:
    first_csv(root).unlink()


def add_a_file(root: Path) -> None:
    (root / "names.txt").write_text("P1 is Anna")


def cut_a_file(root: Path) -> None:
    path = first_csv(root)
    path.write_bytes(path.read_bytes()[:-9])


def words_for_a_number(root: Path) -> None:
    change(root / "recordings.csv", ",60,", ",sixty,")


def another_gesture(root: Path) -> None:
    change(root / "recordings.csv", ",Pat,", ",Pet,")


def swap_columns(root: Path) -> None:
    def how(table: dict[str, Any]) -> None:
        samples = next(r for r in table["recordSet"] if r["@id"] == "samples")
        x, y = (next(f for f in samples["field"] if f["@id"] == f"samples/{n}") for n in "xy")
        x["source"], y["source"] = y["source"], x["source"]

    edit(root, "croissant.json", how)


def lose_a_record_set(root: Path) -> None:
    edit(root, "croissant.json", lambda t: t["recordSet"].pop())


def break_a_field(root: Path) -> None:
    edit(root, "croissant.json", lambda t: t["recordSet"][0]["field"][0]["source"]["fileObject"].update({"@id": "no"}))


def croissant_is_no_json(root: Path) -> None:
    path = root / "croissant.json"
    path.write_text(path.read_text()[:-20])


def croissant_would_fetch(root: Path) -> None:
    edit(root, "croissant.json", lambda t: t["distribution"][0].update(contentUrl="https://example.org/x.csv"))


def context_would_be_fetched(root: Path) -> None:
    edit(root, "croissant.json", lambda t: t.update({"@context": "https://example.org/context"}))


def croissant_leaves_the_package(root: Path) -> None:
    edit(root, "croissant.json", lambda t: t["distribution"][0].update(contentUrl="../../x.csv"))


def frictionless_would_fetch(root: Path) -> None:
    edit(root, "datapackage.json", lambda t: t["resources"][0].update(schema="https://example.org/schema.json"))


def another_type(root: Path) -> None:
    def how(table: dict[str, Any]) -> None:
        next(f for f in table["fields"] if f["name"] == "gesture")["type"] = "integer"

    edit(root, "schemas/recordings.json", how)


def an_unknown_type(root: Path) -> None:
    edit(root, "schemas/samples.json", lambda t: t["fields"][0].update(type="integre"))


def no_publisher(root: Path) -> None:
    edit(root, "datacite.json", lambda t: t.pop("publisher"))


def an_unknown_kind(root: Path) -> None:
    edit(root, "datacite.json", lambda t: t["types"].update(resourceTypeGeneral="Touch"))


def a_true_time(root: Path) -> None:
    path = first_csv(root)
    lines = path.read_text().splitlines()
    cells = lines[7].split(",")
    cells[0] = "1700000012345"
    lines[7] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


def a_true_time_in_a_name(root: Path) -> None:
    path = first_csv(root)
    path.rename(path.with_name("Pat_1700000012345_60.csv"))


def reseal(root: Path, before: dict[str, str]) -> None:
    """Every checksum and size made anew, in the metadata too: as one does who knows the format."""
    for _ in range(3):
        for path in sorted(p for p in root.rglob("*") if p.is_file()):
            file = path.relative_to(root).as_posix()
            old, new = before.get(file, ""), sha256_of(path)
            if old and old != new:
                for other in ("recordings.csv", "streams.csv", "croissant.json", "datapackage.json"):
                    (root / other).write_text((root / other).read_text("utf-8").replace(old, new), "utf-8")
                before[file] = new

        def size(entry: dict[str, Any], file: str, key: str) -> None:
            entry[key] = type(entry[key])((root / file).stat().st_size)

        edit(root, "datapackage.json", lambda t: [size(r, r["path"], "bytes") for r in t["resources"]])
    write_checksums(root)


def cell(root: Path, file: str, column: str, value: str) -> None:
    with (root / file).open(encoding="utf-8", newline="") as table:
        rows = list(csv.DictReader(table))
    assert rows[0][column] != value
    rows[0][column] = value
    with (root / file).open("w", encoding="utf-8", newline="") as table:
        out = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


CONTRADICTIONS: dict[str, tuple[str, Damage]] = {
    "a person's age group": ("data", lambda r: cell(r, "subjects.csv", "age_group", "senior")),
    "a person's age group in the data": ("data", lambda r: cell(r, "data/subjects.csv", "age_group", "senior")),
    "a column of names": ("data", lambda r: change(r / "data/subjects.csv", "consent\n", "consent,name\n")),
    "a consent form": ("data", lambda r: cell(r, "data/subjects.csv", "consent", "C-77")),
    "who trimmed": ("data", lambda r: change(r / "data/marks.jsonl", '"who": ""', '"who": "Anna"')),
    "a stream's rows": ("data", lambda r: cell(r, "streams.csv", "rows", "7")),
    "a stream's person": ("data", lambda r: cell(r, "streams.csv", "subject", "P2")),
    "a place in the stream": ("data", lambda r: cell(r, "recordings.csv", "stream_row", "7")),
    "an affect": ("data", lambda r: cell(r, "recordings.csv", "affect", "negative")),
    "a gesture's affect": ("data", lambda r: cell(r, "gestures.csv", "affect", "negative")),
    "a channel's scale": ("data", lambda r: cell(r, "channels.csv", "scale", "2.0")),
    "the layout's scale": ("data", lambda r: change(r / "data/dataset.toml", "scale = 1.0", "scale = 2.0")),
    "the licence of the data": (
        "metadata",
        lambda r: change(r / "data/dataset.toml", '"CC-BY-4.0"', '"CC0-1.0"'),
    ),
    "the licence for machines": ("metadata", lambda r: edit(r, "croissant.json", lambda t: t.update(license="x"))),
    "a version": ("metadata", lambda r: edit(r, "croissant.json", lambda t: t.update(version="2.0.0"))),
    "a title": ("metadata", lambda r: edit(r, "datapackage.json", lambda t: t.update(title="Another"))),
    "a day": ("metadata", lambda r: edit(r, "croissant.json", lambda t: t.update(datePublished="2001-01-01"))),
    "nobody is virtual": (
        "metadata",
        lambda r: change(r / "data/dataset.toml", "simulated = false", "simulated = true"),
    ),
}


@pytest.mark.parametrize("what", CONTRADICTIONS)
def test_a_contradiction_is_caught_whatever_the_checksums_say(
    package: PublishResult, tmp_path: Path, what: str
) -> None:
    root = tmp_path / "package"
    shutil.copytree(package.folder, root)
    before = {p.relative_to(root).as_posix(): sha256_of(p) for p in root.rglob("*") if p.is_file()}
    by, damage = CONTRADICTIONS[what]
    damage(root)
    reseal(root, before)
    found = PackageView(root)
    VALIDATORS["checksums"](found)
    assert not found.problems, "the test reseals everything"
    VALIDATORS[by](found)
    assert found.problems


def test_what_plushsense_leaves_in_an_opened_folder_is_no_part_of_a_zip(package: PublishResult, tmp_path: Path) -> None:
    root = tmp_path / "package"
    shutil.copytree(package.folder, root)
    (root / "data" / "cache").mkdir()
    (root / "data" / "cache" / "who.txt").write_text("P1 is Anna")
    assert check_folder(root).valid
    write_zip(root, tmp_path / "p.zip")
    found = validate_package(tmp_path / "p.zip")
    assert [(p.validator, p.file) for p in found.problems] == [("checksums", "data/cache/who.txt")]


@pytest.mark.parametrize(
    ("damage", "by"),
    [
        (flip_a_digit, {"data", "frictionless"}),
        (remove_a_file, {"data", "frictionless"}),
        (add_a_file, set()),
        (cut_a_file, {"data", "croissant", "frictionless"}),
        (words_for_a_number, {"data", "croissant", "frictionless"}),
        (another_gesture, {"data", "croissant", "frictionless"}),
        (swap_columns, {"croissant"}),
        (lose_a_record_set, {"croissant"}),
        (break_a_field, {"croissant"}),
        (croissant_is_no_json, {"croissant"}),
        (croissant_would_fetch, {"croissant"}),
        (context_would_be_fetched, {"croissant"}),
        (croissant_leaves_the_package, {"croissant"}),
        (frictionless_would_fetch, {"frictionless"}),
        (another_type, {"frictionless"}),
        (an_unknown_type, {"frictionless"}),
        (no_publisher, {"datacite"}),
        (an_unknown_kind, {"datacite"}),
        (a_true_time, {"times", "data", "frictionless"}),
        (a_true_time_in_a_name, {"times", "data"}),
    ],
)
def test_planted_damage_is_caught(
    package: PublishResult, tmp_path: Path, damage: Damage, by: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "package"
    shutil.copytree(package.folder, root)
    damage(root)
    careless = PackageView(root)
    VALIDATORS["checksums"](careless)
    assert careless.problems, "not even a careless damage may pass"
    # Whoever makes the checksums anew is still caught, by what they cannot know.
    write_checksums(root)
    if not LONG:
        # The others read a package for a second; each of them is here for some damage.
        monkeypatch.setattr(checking, "VALIDATORS", {name: VALIDATORS[name] for name in VALIDATORS if name in by})
    found = check_folder(root)
    caught = {p.validator for p in found.problems}
    assert by <= caught, found.problems
    assert all(p.problem and "\n" not in p.problem for p in found.problems)
    assert all("Traceback" not in p.problem and "network" not in p.problem for p in found.problems)


def test_every_recording_and_the_first_rows_of_streams_are_loaded(package: PublishResult, tmp_path: Path) -> None:
    root = tmp_path / "package"
    shutil.copytree(package.folder, root)
    found = check_folder(root)
    assert found.problems == []
    said = next(v.looked_at for v in found.validators if v.validator == "croissant")
    assert "3000 records of stream-samples" in said
    assert "1260 records of samples" in said


def test_what_is_no_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.zip").write_text("no zip")
    for path in (tmp_path / "x.zip", tmp_path / "nothing"):
        with pytest.raises(DatasetError, match="is no package"):
            validate_package(path)
    empty = tmp_path / "empty"
    empty.mkdir()
    found = validate_package(empty)
    assert {p.validator for p in found.problems} >= {"checksums", "data", "croissant", "frictionless", "datacite"}
