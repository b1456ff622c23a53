"""The demo and the quickstart, small: that they run, say that they simulate, and can be run again."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.workflow import demo
from plushsense.workflow.demo import DemoSize
from support.traced import SocketTrace

pytestmark = pytest.mark.apart("demo")

REPO = Path(__file__).resolve().parents[2]
TINY = DemoSize(people=4, repetitions=1, epochs=1, folds=2, live_s=15.0)


PROGRAM = f"""
import sys
from plushsense.cli.main import main
from plushsense.workflow import demo

demo.QUICK = demo.{TINY!r}
sys.exit(main(sys.argv[1:]))
"""


def test_demo_twice(cli: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It imports, trains, evaluates, runs live and exports, and opens no socket."""
    monkeypatch.setattr(demo, "QUICK", TINY)
    out, trace = tmp_path / "demo", SocketTrace(tmp_path)
    command = [*trace.words, sys.executable, "-c", PROGRAM, "demo", "--quick", "--out", str(out), "--json"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    found = json.loads(ran.stdout)
    assert {"dataset", "bundle", "report", "export", "scores"} <= set(found)
    assert found["scores"]["split"] == "by-subject:2"
    assert [g["affect"] for g in found["live"]["gestures"]]
    assert (Path(found["export"]) / "plushsense.c").is_file()
    assert "say nothing about a real toy" in ran.stderr
    assert "2/6  train 14d1_19d2_19d4 on " in ran.stderr and "None" not in ran.stderr
    assert "simulation" in Path(found["report"]).read_text().lower()
    again = cli("demo", "--quick", "--out", out)
    assert again.status == 0
    assert again.out.count("SIMULATION") >= 1
    leftovers = [p.name for p in out.rglob("*") if p.name.endswith(".part") or "-unfinished-" in p.name]
    assert leftovers == []
    assert trace.used() == set()


def test_demo_touches_no_folder_of_yours(cli: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("x")
    ran = cli("demo", "--quick", "--out", tmp_path)
    assert ran.status == 2
    assert "not a demo" in ran.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["thesis.txt"]


@pytest.mark.exhaustive
def test_the_quickstart_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = REPO / "examples" / "quickstart.py"
    assert len(path.read_text().splitlines()) <= 40
    spec = importlib.util.spec_from_file_location("quickstart", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(tmp_path, people=4, epochs=1, seconds=4.0)
    said = capsys.readouterr().out
    assert "33520 multiply-accumulates" in said
    assert (tmp_path / "model.plush").is_file()
    assert (tmp_path / "report.html").is_file()
    assert json.loads((tmp_path / "evaluation" / "evaluation.json").read_text())["split"] == "by-subject:2"
