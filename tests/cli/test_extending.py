"""A layout and a gesture set are one TOML file each; a verb or experiment is a module and a table in ``verbs.toml``."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import plushsense.core
from plushsense import cli as verbs
from plushsense.cli.options import VERBS
from plushsense.core import toml
from plushsense.dataset.store import Dataset
from support.small_dataset import Cli

pytestmark = pytest.mark.apart("trainings")

LAYOUT = """
name = "tilt-2"
rate_hz = 50.0
channels = [
    { name = "pitch", unit = "degree", kind = "angle", valid_min = -180.0, valid_max = 180.0 },
    { name = "roll", unit = "degree", kind = "angle", valid_min = -180.0, valid_max = 180.0 },
]
wire = ["device_ms", "pitch", "roll"]
inputs = ["pitch", "roll"]
"""
GESTURES = """
name = "nod-2"
gestures = [
    { label = "Nod", affect = "positive", family = "Nod", description = "Tip the toy forwards" },
    { label = "Shake", affect = "negative", family = "Shake", description = "Tip the toy to both sides" },
]
"""
VERB = """
import json


def run(args):
    print(json.dumps({"hello": args.name}) if args.json else f"Hello {args.name}.")
    return 0
"""
EXPERIMENT = """
from plushsense.cli.output import emit
from plushsense.cli.settings import report_jobs
from plushsense.dataset.index import open_dataset
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.study import StudyPart, run_study
from plushsense.workflow.reporting import journal_of


def count(dataset, person, report):
    return {"person": person, "recordings": sum(r.subject == person for r in dataset.used)}


def summarise(study):
    return {"people": study.results, "resumed": study.resumed}


def run(args):
    dataset = open_dataset(args.dataset)
    parts = [StudyPart(person, {"person": person}, person) for person in dataset.subjects]
    spec = JobsSpec(journal=journal_of(dataset, "counting"))
    progress = report_jobs("counting", "people")
    key = {"data": dataset.hash}
    result = run_study(parts, count, summarise, key=key, shared=dataset, spec=spec, progress=progress)
    emit(args, result, [f"{row['person']}: {row['recordings']}" for row in result["people"]])
    return 0
"""


def test_a_layout_and_a_gesture_set_are_one_file_each(
    cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package = tmp_path / "core"
    shutil.copytree(Path(plushsense.core.__file__).parent / "data", package / "data")
    (package / "data" / "layouts" / "tilt-2.toml").write_text(LAYOUT)
    (package / "data" / "gestures" / "nod-2.toml").write_text(GESTURES)
    installed = toml.resources.files
    monkeypatch.setattr(toml.resources, "files", lambda name: package if name == "plushsense.core" else installed(name))
    rows = [
        f"{person},{gesture},{i * 20},{(i * step) % 90},{-i % 60}"
        for person in ("P1", "P2", "P3")
        for gesture, step in (("Nod", 3), ("Shake", 7))
        for i in range(200)
    ]
    table = tmp_path / "t.csv"
    table.write_text("\n".join(["who,gesture,time_ms,pitch,roll", *rows]) + "\n")
    ds, model, export = tmp_path / "DS", tmp_path / "m.plush", tmp_path / "export"
    assert "tilt-2" in cli("import", table, ds, "--layout", "tilt").err
    with pytest.raises(SystemExit):
        cli("import", "--help")
    described = capsys.readouterr().out
    assert "tilt-2" in described and "nod-2" in described
    columns = ("--column", "subject=who", "--layout", "tilt-2", "--gestures", "nod-2")
    assert cli("import", table, ds, *columns, "--json").json["recordings"] == 6
    trained = cli("train", ds, "--out", model, "--filters", "4,4,4", "--epochs", "1", "--json")
    assert trained.json["bundle"] == str(model)
    bundle = cli("info", model, "--json").json
    assert (bundle["layout"], bundle["gestures"]) == ("tilt-2", ["Nod", "Shake"])
    assert cli("export", model, export, "--json").status == 0
    assert "pitch" in (export / "plush_model.h").read_text()


def test_a_verb_is_a_module_and_a_table(cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "hello_extension.py").write_text(VERB)
    monkeypatch.setattr(verbs, "__path__", [*verbs.__path__, str(tmp_path)])
    table = {"summary": "greet somebody", "module": "hello_extension", "name": {"help": "whom to greet"}}
    monkeypatch.setitem(VERBS, "hello", table)
    assert "greet somebody" in cli("--help").out
    assert cli("hello", "Ana").out == "Hello Ana.\n"
    assert cli("hello", "Ana", "--json").json == {"hello": "Ana"}
    assert "helo" in (refused := cli("helo", "Ana").err) and "Did you mean 'hello'?" in refused


def test_an_experiment_is_a_module_and_a_table(
    cli: Cli, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "counting_extension.py").write_text(EXPERIMENT)
    monkeypatch.setattr(verbs, "__path__", [*verbs.__path__, str(tmp_path)])
    table = {"summary": "count recordings", "module": "counting_extension", "dataset": {"help": "a data set"}}
    monkeypatch.setitem(VERBS, "count", table)
    people = [{"person": p, "recordings": sum(r.subject == p for r in dataset.used)} for p in dataset.subjects]
    assert cli("count", dataset.path, "--json").json == {"people": people, "resumed": 0}
    again = cli("count", dataset.path, "--json")
    assert again.json == {"people": people, "resumed": len(people)}
    assert f"counting: {len(people)} of {len(people)} people ({len(people)} from before)" in again.err
