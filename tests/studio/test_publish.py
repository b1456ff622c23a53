"""What the publish page stands on: facts of data sets and packages, tasks, what figures mean; no browser."""

from __future__ import annotations

import io
import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.publishing.checking import VALIDATORS
from plushsense.studio.app.jobs import DONE, Jobs, StudioJob
from plushsense.studio.app.words import LANGUAGES, Words
from plushsense.studio.app.workspace import PACKAGES, Workspace
from plushsense.studio.pages.publish.packages import (
    MEANINGS,
    DatasetFacts,
    PackageFacts,
    missing_extras,
    newest_validation,
    packages_of,
    reidentification_text,
)
from plushsense.studio.tasks import TASKS, TaskReporter

SAID = {"licence": "CC-BY-4.0", "contact": "Ada <ada@example.org>", "consent": "all agreed"}


def run_task(task: Any, **spec: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the result of a task and its progress reports."""
    out = io.StringIO()
    result = task(spec, TaskReporter(out))
    return result, [json.loads(line) for line in out.getvalue().splitlines()]


def test_a_broken_data_set(few: Path) -> None:
    folder = few / "datasets" / "virtual"
    (folder / "dataset.toml").write_text("format = 9\n", "utf-8")
    assert "has the format 9" in str(DatasetFacts.of(folder).problem)


def test_a_package_by_the_tasks(few: Path, publish_tools: None, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = Workspace(few)
    assert DatasetFacts.of(workspace.datasets()[0]).own_codes == ("P01", "P02", "P03")
    place, key = workspace.new(PACKAGES, "one"), workspace.folder / "keys" / "virtual.key"
    spec = {"dataset": str(workspace.datasets()[0]), "place": str(place), "key": str(key), "reidentification": False}
    # Where the statements cannot be kept, the package stands all the same, and says so.
    head, replace = workspace.datasets()[0] / "dataset.toml", os.replace

    def refuse(source: Path, target: Path) -> None:
        if target == head:
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    result, reports = run_task(TASKS["publish"], **spec, **SAID, save=True)
    assert any("could not be written into" in said for said in result["warnings"])
    assert result["valid"] and [v["validator"] for v in result["validators"]] == list(VALIDATORS)
    stages = {r["progress"]["stage"] for r in reports}
    assert "writing" in stages and "validating: croissant" in stages
    found = PackageFacts.of(workspace, "one")
    assert packages_of(workspace) == ["one"] and found.place == place.with_name("one.zip")
    assert "Ada (" in found.citation and found.simulated and found.reidentification == {}
    assert found.contents["data/recordings/"][0] == 9
    assert sum(files for files, _ in found.contents.values()) == result["files"]
    with pytest.raises(DatasetError, match="already holds something"):
        run_task(TASKS["publish"], **spec, **SAID)
    with pytest.raises(DatasetError, match="lies in"):
        run_task(TASKS["publish"], **{**spec, "place": f"{place}2", "key": str(workspace.datasets()[0] / "k")}, **SAID)
    # The zip alone says the same; a damaged folder is found out.
    (place / "gestures.csv").write_text("Shake\n", "utf-8")
    assert not run_task(TASKS["validate"], place=str(place))[0]["valid"]
    shutil.rmtree(place)
    alone = PackageFacts.of(workspace, "one")
    assert (alone.folder, alone.citation, alone.contents) == (None, found.citation, found.contents)
    work = few / "work"
    work.mkdir()
    job = StudioJob("1", "validate", {"place": str(alone.place)}, "t", state=DONE, ended_s=alone.made_s + 5)
    old = StudioJob("0", "publish", {"place": str(place)}, "t", state=DONE, ended_s=alone.made_s - 60)
    for each in (old, job):
        (work / f"{each.id}.json").write_text(json.dumps(vars(each)))
    proved = newest_validation(workspace.part(Jobs), alone)
    assert proved is not None and proved.id == "1"
    job.ended_s = alone.made_s - 30
    (work / "1.json").write_text(json.dumps(vars(job)))
    assert newest_validation(Jobs(workspace), alone) is None, (
        "what was proved before it was made anew is not shown as its proof"
    )


def trial(design: str, sees: str, mean: float, low: float) -> dict[str, Any]:
    top = {"mean": mean, "sd": 0.1, "ci95": [low, mean + 0.02]}
    return {"design": design, "sees": sees, "people": 27, "recordings": 1485, "top1": top, "top5": top, "chance": 0.037}


@pytest.mark.parametrize("language", LANGUAGES)
def test_what_the_figures_mean(language: str) -> None:
    words = Words(language)
    personal, guessing, simulated = (words(MEANINGS[key]) for key in ("personal", "guessing", "simulated"))
    trials = [trial("recordings", "everything", 0.929, 0.884), trial("gestures", "everything", 0.532, 0.44)]
    found = reidentification_text(words, {"trials": trials, "simulated": False})
    assert all(figure in found[0] for figure in ("93", "27", "88", words.number(3.7, 1))) and "53" in found[1]
    assert personal in found and len(found) == 5
    chance = [trial("recordings", "everything", 0.04, 0.01)]
    assert guessing in reidentification_text(words, {"trials": chance, "simulated": False})
    virtual = reidentification_text(words, {"trials": trials, "simulated": True})
    assert simulated in virtual and personal not in virtual
    assert len(reidentification_text(words, {})) == 1


def test_missing_extras(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plushsense.studio.pages.publish.packages.importlib.util.find_spec", lambda name: None)
    assert missing_extras() == ["publish", "baselines"]
