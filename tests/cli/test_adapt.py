"""``plushsense adapt``: a stranger's habits, what is refused, undo, and how much it helps people left out."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.experiments.adaptation import adapt
from plushsense.models.bundle import Bundle

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]
Make = Callable[[Path, int], None]
SWAPPED = {"Slow": "Fast", "Fast": "Slow"}


def person(session: Make, folder: Path, seeds: tuple[int, ...], labels: dict[str, str] | None = None) -> Path:
    """The recordings of several sessions in one folder, without their streams; labels may be changed."""
    folder.mkdir(parents=True)
    for seed in seeds:
        place = folder.parent / f"session{seed}"
        session(place, seed)
        for path in place.glob("*_*.csv"):
            label, rest = path.name.split("_", 1)
            path.rename(folder / f"{(labels or {}).get(label, label)}_{rest}")
        shutil.rmtree(place)
    return folder


@pytest.fixture(scope="module")
def stranger(make_session: Make, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Somebody who calls slow fast and fast slow: six recordings a gesture."""
    return person(make_session, tmp_path_factory.mktemp("stranger") / "S99", (101, 102, 103), SWAPPED)


def test_before_and_after_on_other_recordings(cli: Cli, bundle: Path, stranger: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine.plush"
    ran = cli("adapt", bundle, stranger, "--use", "3", "--out", out, "--json")
    assert ran.status == 0, ran.err
    found = ran.json
    assert found["adapted"] and found["bundle"] == str(out) and found["subject"] == "S99" and found["use"] == 3
    before, after = found["tested"]["before"], found["tested"]["after"]
    assert before["recordings"] == after["recordings"] == 9
    assert before["right"] <= 5 and after["right"] >= 8
    assert Bundle.load(out).adapted_to == "S99"
    said = cli("info", out)
    assert "S99" in said.out and "original" not in said.out


def test_the_bundle_of_an_export_can_be_adapted_for_its_toy(
    cli: Cli, bundle: Path, stranger: Path, tmp_path: Path
) -> None:
    """By a patch: quantized, only the dense layer of the adapted bundle differs from the export."""
    out, mine, patch = (tmp_path / name for name in ("out", "mine.plush", "patch.bin"))
    assert cli("export", bundle, out).status == 0
    assert cli("adapt", out / "model.plush", stranger, "--out", mine).status == 0
    ran = cli("export", mine, patch, "--patch-for", out, "--json")
    assert ran.status == 0 and ran.json["bytes"] == len(patch.read_bytes()) < 500, ran.err
    assert cli("export", bundle, tmp_path / "no.bin", "--patch-for", out).status == 2


def test_all_adapt_and_each_is_read_without_it(cli: Cli, bundle: Path, stranger: Path, tmp_path: Path) -> None:
    ran = cli("adapt", bundle, stranger, "--out", tmp_path / "mine.plush")
    assert ran.status == 0 and "of 18 own recordings, each left out once" in ran.out


def test_undo_brings_back_the_bytes(cli: Cli, bundle: Path, stranger: Path, tmp_path: Path) -> None:
    mine, back = tmp_path / "mine.plush", tmp_path / "back.plush"
    before = bundle.read_bytes()
    assert cli("adapt", bundle, stranger, "--out", mine).status == 0
    assert bundle.read_bytes() == before and mine.read_bytes() != before
    ran = cli("adapt", mine, "--undo", "--out", back, "--json")
    assert ran.status == 0 and ran.json["undone"] and back.read_bytes() == before


def test_where_it_would_not_help_nothing_is_written(
    cli: Cli, bundle: Path, stranger: Path, make_session: Make, tmp_path: Path
) -> None:
    known, out = tmp_path / "known.plush", tmp_path / "mine.plush"
    replace(adapt(bundle, stranger).bundle, personal={}).save(known)
    again = person(make_session, tmp_path / "R" / "S99", (104, 105), SWAPPED)
    ran = cli("adapt", known, again, "--out", out, "--json")
    assert ran.status == 1 and not out.exists()
    assert ran.json["adapted"] is False and ran.json["bundle"] is None and "not clearly help" in ran.json["reason"]
    assert "stays as it is" in cli("adapt", known, again, "--out", out).out


def test_the_bundle_that_is_given_is_never_replaced(cli: Cli, bundle: Path, stranger: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine.plush"
    shutil.copy(bundle, mine)
    ran = cli("adapt", mine, stranger, "--out", mine, "--force")
    assert ran.status == 2 and "never changed" in ran.err and mine.read_bytes() == bundle.read_bytes()
    other = tmp_path / "other.plush"
    shutil.copy(bundle, other)
    assert cli("adapt", mine, stranger, "--out", other).status == 2 and other.read_bytes() == bundle.read_bytes()
    assert cli("adapt", mine, stranger, "--out", other, "--force").status == 0


def test_gestures_that_the_bundle_does_not_know_are_named(
    cli: Cli, bundle: Path, stranger: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "S99"
    shutil.copytree(stranger, folder)
    for path in sorted(folder.glob("Slow_*"))[:2]:
        shutil.copy(path, folder / path.name.replace("Slow", "Tickle"))
    ran = cli("adapt", bundle, folder, "--out", tmp_path / "mine.plush", "--json")
    assert ran.status == 0 and "Tickle" in ran.err and "2 recordings" in ran.json["left_out"]["Tickle"]


def test_a_person_of_the_training_is_warned_of(cli: Cli, bundle: Path, recordings: Path, tmp_path: Path) -> None:
    who = Bundle.load(bundle).provenance["subjects"][0]
    ran = cli("adapt", bundle, recordings / who, "--out", tmp_path / "mine.plush")
    assert f"trained on a person {who}" in ran.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--subject", "P77"), "no recording of 'P77'"),
        ((), "choose a person with --subject"),
        (("--subject", "P1", "--use", "1"), "--use 1 is too few"),
        (("--subject", "P1", "--use", "2"), "left to test on"),
    ],
)
def test_refusals(cli: Cli, bundle: Path, recordings: Path, tmp_path: Path, words: tuple[str, ...], said: str) -> None:
    ran = cli("adapt", bundle, recordings, *words, "--out", tmp_path / "mine.plush")
    assert ran.status == 2 and said in ran.err and "Traceback" not in ran.err


def test_too_few_recordings_and_another_layout(cli: Cli, bundle: Path, stranger: Path, tmp_path: Path) -> None:
    folder = tmp_path / "S99"
    folder.mkdir()
    for path in sorted(stranger.glob("*.csv"))[:1]:
        shutil.copy(path, folder)
    out = tmp_path / "mine.plush"
    ran = cli("adapt", bundle, folder, "--out", out)
    assert ran.status == 2 and "too few" in ran.err
    ran = cli("adapt", bundle, tmp_path / "nowhere", "--out", out)
    assert ran.status == 2 and "There is no folder" in ran.err
    assert cli("adapt", bundle, stranger).status == 2 and cli("adapt", bundle, "--out", out).status == 2
    ran = cli("adapt", bundle, "--undo", "--out", out)
    assert ran.status == 2 and "nothing to undo" in ran.err and not out.exists()


def test_without_pytorch(bundle: Path, stranger: Path, tmp_path: Path) -> None:
    words = ["adapt", str(bundle), str(stranger), "--use", "3", "--out", str(tmp_path / "mine.plush")]
    code = f"import sys; sys.modules['torch'] = None\nfrom plushsense.cli.main import main\nsys.exit(main({words!r}))"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "mine.plush").exists()


def test_forget_names_a_bundle_that_was_adapted_to_the_person(
    cli: Cli, bundle: Path, stranger: Path, tmp_path: Path
) -> None:
    made = import_recordings(stranger, tmp_path / "DS", layout="accel-3").dataset
    assert cli("adapt", bundle, made.path, "--out", tmp_path / "kept" / "mine.plush").status == 0
    ran = cli("forget", made.path, "S99", "--bundles", tmp_path / "kept", "--json")
    assert any("adapted to this code" in str(found) for found in ran.json["bundles"]), ran.out


def test_forget_names_the_recordings_that_the_studio_discarded(cli: Cli, stranger: Path, tmp_path: Path) -> None:
    made = import_recordings(stranger, tmp_path / "home" / "datasets" / "DS", layout="accel-3").dataset
    discarded = [tmp_path / "home" / "discarded" / p / "S99" for p in ("datasets/old/recordings", "recordings")]
    for folder in discarded:
        folder.mkdir(parents=True)
    ran = cli("forget", made.path, "S99", "--json")
    assert ran.json["discarded"] == [str(folder) for folder in discarded]
    ran = cli("forget", made.path, "S99")
    assert f"discarded recordings of this code, delete them: {discarded[0]}" in ran.out


@pytest.mark.exhaustive
def test_people_left_out(cli: Cli, make_session: Make, tmp_path: Path) -> None:
    source = tmp_path / "R"
    for n, labels in enumerate((None, None, SWAPPED)):
        person(make_session, source / f"P{n}", (200 + 3 * n, 201 + 3 * n, 202 + 3 * n), labels)
    made = import_recordings(source, tmp_path / "DS", layout="accel-3").dataset
    words = ("adapt", "--evaluate", made.path, "--use", "4", "--epochs", "15", "--json")
    ran = cli(*words)
    assert ran.status == 0, ran.err
    found = ran.json
    assert found["split"] == "leave-one-subject-out" and found["choices"] == 45 and not found["simulated"]
    rows = {row["subject"]: row for row in found["people"]}
    assert rows["P2"]["right_change"] > 1.0 and rows["P2"]["recordings"] == 6.0
    assert "adapting: 3 of 3 folds, 100%" in ran.err
    assert cli(*words).json == found
    again = cli(*words[:-1])
    assert again.status == 0 and "3 of 3 folds (3 from before)" in again.err and "macro-F1 gain" in again.out
    assert cli("adapt", "--evaluate", made.path, "--split", "by-recording:2").status == 2
    assert cli("adapt", "model.plush", "--evaluate", made.path).status == 2
    few = cli("adapt", "--evaluate", made.path, "--use", "9", "--epochs", "1")
    assert few.status == 2 and "Nobody has more than 9 recordings" in few.err


def test_an_export_says_that_it_is_adapted_and_not_to_whom(
    cli: Cli, bundle: Path, stranger: Path, tmp_path: Path
) -> None:
    mine, out = tmp_path / "mine.plush", tmp_path / "out"
    assert cli("adapt", bundle, stranger, "--out", mine).status == 0
    assert cli("export", mine, out).status == 0
    assert "Adapted to one person" in (out / "README.md").read_text(encoding="utf-8")
    assert not [path for path in out.rglob("*") if path.is_file() and b"S99" in path.read_bytes()]
    ran = cli("adapt", out / "model.plush", "--undo", "--out", tmp_path / "back.plush")
    assert ran.status == 2 and "an export leaves that out" in ran.err


def test_a_bundle_that_was_trained_anywhere_in_streams(
    cli: Cli, bundle: Path, make_session: Make, tmp_path: Path
) -> None:
    """Its recordings are read whole, and what its stream holds between them is nobody's gesture."""
    make_session(tmp_path / "R" / "S98", 105)
    trained = Bundle.load(bundle)
    anywhere = replace(trained, windowing=dict(trained.windowing) | {"context": "anywhere", "anywhere": {}})
    anywhere.save(tmp_path / "any.plush")
    ran = cli("adapt", tmp_path / "any.plush", tmp_path / "R" / "S98", "--force", "--out", tmp_path / "mine.plush")
    assert ran.status in (0, 1), ran.err
    same = cli("adapt", bundle, tmp_path / "R" / "S98", "--force", "--out", tmp_path / "other.plush")
    assert ran.out.replace("mine", "other") == same.out
