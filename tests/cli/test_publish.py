"""``plushsense publish`` as a user types it."""

from __future__ import annotations

import json
import stat
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.store import Dataset
from plushsense.evaluation.reidentification import reidentify

Cli = Callable[..., Any]
CONTACT = ("--contact", "Ada <ada@example.org>")
SAID = (*CONTACT, "--licence", "CC-BY-4.0", "--consent", "all agreed")

pytestmark = [pytest.mark.usefixtures("publish_tools"), pytest.mark.apart("publishing")]


@pytest.fixture(autouse=True)
def few_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a smaller forest look for the people: how well it finds them is not tested here."""
    monkeypatch.setattr("plushsense.workflow.datasets.reidentify", partial(reidentify, trees=20))


def test_from_refusal_to_a_valid_package(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "out"
    ran = cli("publish", dataset.path, out)
    assert ran.status == 2
    assert ran.err.count("\n") == 1
    for word in ("licence", "consent", "contact", "dataset.toml", "--contact"):
        assert word in ran.err
    head = (dataset.path / "dataset.toml").read_bytes()
    found = cli("publish", dataset.path, out, *SAID, "--json").json
    assert found["valid"] is True
    assert found["files"] == len([p for p in out.rglob("*") if p.is_file()])
    assert (found["recordings"], found["subjects"], found["problems"]) == (30, 5, [])
    assert (dataset.path / "dataset.toml").read_bytes() == head, "nothing is written back unless asked"
    assert "The right" not in (out / "reidentification.md").read_text()
    assert any("the published title is the data set's name" in w for w in found["warnings"])
    said = (out / "README.md").read_text()
    assert "`reidentification.md`" in said
    assert "a simple program names the right one of 5 people" in said
    assert json.loads((out / "reidentification.json").read_text())["people"] == 5
    checked = cli("publish", "--check", found["zip"], "--json")
    assert (checked.status, checked.json["valid"]) == (0, True)
    (out / "gestures.csv").write_text("Shake\n")
    damaged = cli("publish", "--check", out)
    assert damaged.status == 1
    assert "checksums: gestures.csv: was changed" in damaged.err
    assert "not valid" in damaged.out
    assert cli("publish", dataset.path, out, *SAID).status == 2


@pytest.mark.exhaustive
def test_the_report_says_the_codes_of_the_package(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    for number, code in enumerate(dataset.subjects, 1):
        for kind in ("recordings", "streams"):
            (dataset.path / kind / code).rename(dataset.path / kind / str(number))
    (dataset.path / "index.json").unlink()
    assert cli("publish", dataset.path, tmp_path / "out", *SAID, "--no-streams").status == 0
    table = (tmp_path / "out" / "subjects.csv").read_text().splitlines()[1:]
    published = {line.partition(",")[0] for line in table} - {"none"}
    figures = json.loads((tmp_path / "out" / "reidentification.json").read_text())
    assert set(figures["trials"][0]["by_person"]) == published == {"P1", "P2", "P3", "P4", "P5"}


@pytest.mark.exhaustive
def test_saving_and_leaving_the_report_out(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    key = tmp_path / "key.txt"
    ran = cli("publish", dataset.path, tmp_path / "a", *SAID, "--save", "--no-reidentification", "--key", key)
    assert ran.status == 0, ran.err
    assert "valid" in ran.out
    assert not (tmp_path / "a" / "reidentification.md").exists()
    assert "**not looked at**" in (tmp_path / "a" / "README.md").read_text()
    if sys.platform != "win32":
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    again = cli("publish", dataset.path, tmp_path / "b", "--no-reidentification", "--key", key)
    assert again.status == 0, "licence, contact and consent were saved"
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    assert cli("info", dataset.path, "--json").json["licence"] == "CC-BY-4.0"


def test_new_codes_in_a_copy_without_metadata(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    key = tmp_path / "key.csv"
    ran = cli("publish", dataset.path, tmp_path / "OUT", "--without-metadata", "--pseudonyms", "--key", key, "--json")
    assert {k: ran.json[k] for k in ("subjects", "recordings", "streams")} == {
        "subjects": 5,
        "recordings": 30,
        "streams": 5,
    }
    assert cli("info", tmp_path / "OUT", "--json").json["located_in_stream"] == 30
    assert key.read_text().splitlines()[2].startswith("P1,S")
    ran = cli("publish", dataset.path, tmp_path / "OUT2", "--without-metadata", "--pseudonyms", "--key", key)
    assert "never publish it" in ran.out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("publish",), "needs DATASET and OUT"),
        (("publish", "DS"), "needs DATASET and OUT"),
        (("publish", "DS", "OUT", "--check", "X"), "not both"),
        (("publish", "--check", "nowhere"), "is no package"),
        (("publish", "nowhere", "OUT"), "There is no folder"),
        (("publish", "DS", "OUT", *CONTACT, "--consent", "yes", "--licence", "CC BY"), "Did you mean 'CC-BY-"),
        (("publish", "DS", "OUT", "--contact", "Ada"), "write it as"),
        (("publish", "DS", "OUT", *SAID, "--key", "DS/key"), "store it elsewhere"),
        (("publish", "DS", "OUT", *SAID, "--key", "bad.key"), "is not a key"),
        (("publish", "DS", "OUT", *SAID, "--pseudonyms", "--no-reidentification"), "Pseudonyms need a key"),
        (("publish", "DS", "taken", *SAID), "taken.zip' exists without its folder"),
    ],
)
def test_refusals_are_sentences(
    cli: Cli, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.key").write_text("not hex")
    (tmp_path / "taken.zip").write_text("mine")
    ran = cli(*words)
    assert ran.status == 2
    assert said in ran.err
    assert ran.err.count("\n") == 1
    assert not (tmp_path / "OUT").exists()
