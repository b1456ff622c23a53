"""Pages whose commands all run, on small data: the paper, every row of which has a verdict too, and the tutorial."""

from __future__ import annotations

import contextlib
import functools
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from plushsense.cli.main import main
from plushsense.dataset.index import open_dataset
from plushsense.deploy.proof.verify import Setting
from plushsense.experiments.protocol.sittings import virtual_sittings
from plushsense.recording.simulate import SimulationSpec
from plushsense.studio.app import serve
from support.archive import make_archive

pytestmark = [pytest.mark.apart("trainings"), pytest.mark.early]

ROOT = Path(__file__).parents[2]
PAGE, TUTORIAL = ROOT / "docs" / "paper.md", ROOT / "docs" / "own-sensor.md"
VERDICTS = ("better", "equal", "not possible here", "weaker")

# What makes a command small: three people instead of 25, some of the gestures, one epoch, and no processes that would
# each load PyTorch (those of `stream-eval` and of `examples/paper.py` remain).
GESTURES = (
    *("Back stroke 1", "Back stroke 2", "Hold strong", "Neck scratch 1", "Neck scratch 2", "Tail hit 1", "Tail pull"),
    "Tail tap 2",
)
SMALL = {
    "simulate": {"--people": "3", "--repetitions": "1"},
    "train": {"--epochs": "1"},
    "evaluate": {"--epochs": "1", "--workers": "1"},
    "baselines": {"--epochs": "1", "--workers": "1"},
    "stream-eval": {"--epochs": "1"},
    "sweep": {
        "--set": "architectures=14d1_39d2_41d4,19d1_19d2_19d4_17d8 --set filters=4/6/8/8 --set batches=64",
        "--epochs": "1",
        "--workers": "1",
    },
}
# A check has findings, which is no error; a network of one epoch is too bad to be adapted, which is refused.
STATUS = {"check": (0, 1), "adapt": (0, 1)}


def blocks(page: Path) -> list[str]:
    """The commands in the blocks of a page, in order."""
    text = page.read_text("utf-8")
    return [line for block in re.findall(r"```sh\n(.*?)```", text, re.S) for line in block.splitlines()]


def commands() -> list[str]:
    """The commands of the page on the paper, in order, each once."""
    return list(dict.fromkeys([*blocks(PAGE), *(cells[-1].strip("`") for cells in rows())]))


def rows() -> list[list[str]]:
    """The rows of the tables of verdicts."""
    tables = PAGE.read_text("utf-8").split("## The verdicts", 1)[1]
    lines = [line.strip("| ") for line in tables.splitlines() if line.startswith("|")]
    return [row for row in ([cell.strip() for cell in line.split(" | ")] for line in lines) if row[-1].startswith("`")]


def test_every_row_has_a_verdict_and_a_command() -> None:
    assert len(rows()) >= 50
    for row in rows():
        assert row[1] in VERDICTS, row
        assert row[-1].startswith(("`plushsense ", "`python examples/paper.py ")), row


def run(command: str) -> tuple[int, str]:
    """Run a command of the page in this process; its exit status, and what it printed."""
    program, *words = shlex.split(command)
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        if program == "python":
            examples = runpy.run_path(str(ROOT / words[0]), run_name="example")
            return examples["main"](words[1:]), said.getvalue()
        small = SMALL.get(words[0], {})
        added = (" ".join(option).split() for option in small.items() if option[0] not in words)
        status = main([*words, *(word for option in added for word in option)])
    return status, said.getvalue()


@pytest.mark.usefixtures("c_compiler")
@pytest.mark.exhaustive
def test_the_tutorial_ends_with_the_same_answers_in_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("plushsense.deploy.proof.verify.settings_of", lambda name: [Setting(name, "gcc", "-O2")])
    said = ""
    for command in blocks(TUTORIAL):
        if not command.startswith(("plushsense ", "python ")):
            continue  # of the shell
        status, said = run(command)
        assert status == 0, f"{command}: exit status {status}\n{said}"
        if "--guess" in command:
            guessed = "".join(re.findall(r"```toml\n(.*?)```", TUTORIAL.read_text("utf-8"), re.S))
            assert guessed in Path("cushion.toml").read_text("utf-8")
        if "--exclude" in command:
            assert [r.id for r in open_dataset("DS").recordings if r.excluded] == ["P03/session1/squeeze_1580_80"]
    assert "Every number of every answer is equal" in said


@pytest.mark.usefixtures("publish_tools", "c_compiler")
@pytest.mark.exhaustive
def test_every_command_runs(tmp_path: Path) -> None:
    """In a process of its own: PyTorch, scikit-learn, the figures and the validators together take 640 MB."""
    paths = [str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    words = [sys.executable, __file__]
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def run_all() -> None:
    """Run every command of the page in the current folder; end with the one that fails."""
    served: list[object] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "cpu_count", lambda: 1)
        fewer_gestures = functools.partial(SimulationSpec, gestures=GESTURES)
        patch.setattr("plushsense.recording.simulate.SimulationSpec", fewer_gestures)
        fewer = functools.partial(virtual_sittings, gestures=GESTURES)
        patch.setattr("plushsense.experiments.protocol.run_protocol.virtual_sittings", fewer)
        patch.setattr("plushsense.deploy.proof.verify.settings_of", lambda name: [Setting(name, "gcc", "-O2")])
        patch.setattr(serve, "run", lambda *given, **options: served.append(given))
        make_archive(Path("made").absolute()).rename("ARCHIVE")
        Path("made", "sessions").rename("Training Data")
        for command in commands():
            status, said = run(command)
            if status not in STATUS.get(shlex.split(command)[1], (0,)):
                sys.exit(f"{command}: exit status {status}\n{said}")
    assert served


if __name__ == "__main__":
    run_all()
