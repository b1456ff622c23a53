"""A layout and a gesture set are one TOML file each, and a verb is a module and a table in ``verbs.toml``."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import plushsense.core
from plushsense import cli as verbs
from plushsense.cli.options import VERBS
from plushsense.core import toml
from support.small_dataset import Cli

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
