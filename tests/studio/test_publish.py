"""What the publish page stands on: facts of data sets and packages, tasks, what figures mean; no browser."""

from __future__ import annotations

import io
import json
import os
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from plushsense.apps.studio.house import PACKAGES, House
from plushsense.apps.studio.jobs import DONE, Job, Jobs
from plushsense.apps.studio.packages import DatasetFacts, PackageFacts, missing_extras, packages_of
from plushsense.apps.studio.pages.publish_package import checked_by, recognised
from plushsense.apps.studio.tasks import pseudonymise as pseudonymise_task
from plushsense.apps.studio.tasks import publish as publish_task
from plushsense.apps.studio.tasks import validate as validate_task
from plushsense.apps.studio.words import LANGUAGES, Words
from plushsense.apps.studio.worker import Tell
from plushsense.core.errors import DatasetError
from plushsense.dataset.keyfile import is_drawn
from plushsense.dataset.people import PEOPLE
from plushsense.dataset.publish.checking import VALIDATORS

SAID = {"licence": "CC-BY-4.0", "contact": "Ada <ada@example.org>", "consent": "all agreed"}


def told(task: Any, **spec: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a task returned, and what it told on the way."""
    out = io.StringIO()
    result = task.run(spec, Tell(out))
    return result, [json.loads(line) for line in out.getvalue().splitlines()]


def test_pseudonyms_then_the_advice_is_gone(few: Path) -> None:
    house = House(few)
    found = DatasetFacts.of(house.datasets()[0])
    assert (found.people, found.recordings, found.simulated, found.problem) == (3, 9, True, "")
    assert found.own_codes == ("P01", "P02", "P03") and found.own_dates
    place, key = house.new("datasets", "shared"), house.folder / "keys" / "people.csv"
    result, reports = told(pseudonymise_task, dataset=str(found.path), place=str(place), key=str(key), words=[])
    renamed = DatasetFacts.of(place)
    assert (renamed.own_codes, renamed.own_dates, renamed.recordings) == ((), False, 9)
    assert reports[-1]["progress"] == {"stage": "rewriting", "done": 9, "total": 9}
    assert result["key"] == str(key)
    if sys.platform != "win32":
        assert key.stat().st_mode & 0o77 == 0


def test_codes_that_were_drawn() -> None:
    assert is_drawn("S7K2Q")
    assert not any(is_drawn(code) for code in ("P01", "Anna", "S7K2", "S7K2Q1", "s7k2q", "S0K2Q"))


def test_columns_and_a_broken_data_set(few: Path) -> None:
    folder = few / "datasets" / "virtual"
    (folder / PEOPLE).write_text("subject,age_group,gender,consent,handedness\nP01,10-12,f,A1,left\n", "utf-8")
    assert DatasetFacts.of(folder).columns == ("handedness",)
    (folder / "dataset.toml").write_text("format = 9\n", "utf-8")
    assert "has the format 9" in DatasetFacts.of(folder).problem


def test_a_package_by_the_tasks(few: Path, publish_tools: None) -> None:
    house = House(few)
    place, key = house.new(PACKAGES, "one"), house.folder / "keys" / "virtual.key"
    spec = {"dataset": str(house.datasets()[0]), "place": str(place), "key": str(key), "reidentification": False}
    # Where the statements cannot be kept, the package stands all the same, and says so.
    (house.datasets()[0] / f"dataset.toml.{os.getpid()}-{threading.get_ident()}.part").mkdir()
    result, reports = told(publish_task, **spec, **SAID, save=True)
    assert any("could not be written into" in said for said in result["warnings"])
    assert result["valid"] and [v["validator"] for v in result["validators"]] == list(VALIDATORS)
    stages = {r["progress"]["stage"] for r in reports}
    assert "writing" in stages and "validating: croissant" in stages
    found = PackageFacts.of(house, "one")
    assert packages_of(house) == ["one"] and found.place == place.with_name("one.zip")
    assert "Ada (" in found.citation and found.simulated and found.reidentification == {}
    assert found.contents["data/recordings/"][0] == 9
    assert sum(files for files, _ in found.contents.values()) == result["files"]
    with pytest.raises(DatasetError, match="already holds something"):
        told(publish_task, **spec, **SAID)
    with pytest.raises(DatasetError, match="lies in"):
        told(publish_task, **{**spec, "place": f"{place}2", "key": str(house.datasets()[0] / "k")}, **SAID)
    # The zip alone says the same; a damaged folder is found out.
    (place / "gestures.csv").write_text("Shake\n", "utf-8")
    assert not told(validate_task, place=str(place))[0]["valid"]
    shutil.rmtree(place)
    alone = PackageFacts.of(house, "one")
    assert (alone.folder, alone.citation, alone.contents) == (None, found.citation, found.contents)
    work = few / "work"
    work.mkdir()
    job = Job("1", "validate", {"place": str(alone.place)}, "t", state=DONE, ended_s=alone.made_s + 5)
    old = Job("0", "publish", {"place": str(place)}, "t", state=DONE, ended_s=alone.made_s - 60)
    for each in (old, job):
        (work / f"{each.id}.json").write_text(json.dumps(vars(each)))
    proved = checked_by(house.part(Jobs), alone)
    assert proved is not None and proved.id == "1"
    job.ended_s = alone.made_s - 30
    (work / "1.json").write_text(json.dumps(vars(job)))
    assert checked_by(Jobs(house), alone) is None, "what was proved before it was made anew is not shown as its proof"


def trial(design: str, sees: str, mean: float, low: float) -> dict[str, Any]:
    top = {"mean": mean, "sd": 0.1, "ci95": [low, mean + 0.02]}
    return {"design": design, "sees": sees, "people": 27, "recordings": 1485, "top1": top, "top5": top, "chance": 0.037}


@pytest.mark.parametrize("language", LANGUAGES)
def test_what_the_figures_mean(language: str) -> None:
    words = Words(language)
    trials = [trial("recordings", "everything", 0.929, 0.884), trial("gestures", "everything", 0.532, 0.44)]
    said = recognised(words, {"trials": trials, "simulated": False})
    assert "93" in said[0] and "27" in said[0] and "88" in said[0] and "3.7" in said[0] and "53" in said[1]
    assert words("publish.means_personal") in said and words("publish.no_sessions") in said
    guessed = recognised(words, {"trials": [trial("recordings", "everything", 0.04, 0.01)], "simulated": False})
    assert words("publish.means_guessing") in guessed
    virtual = recognised(words, {"trials": trials, "simulated": True})
    assert words("publish.means_simulated") in virtual and words("publish.means_personal") not in virtual
    assert recognised(words, {}) == [words("publish.nobody_looked")]


def test_every_validator_has_words() -> None:
    assert all(Words(language).has(f"publish.v_{name}") for language in LANGUAGES for name in VALIDATORS)


def test_missing_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plushsense.apps.studio.packages.importlib.util.find_spec", lambda name: None)
    assert missing_extras() == ["publish", "baselines"]
