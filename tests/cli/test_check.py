"""``plushsense check`` as a session leader uses it: what needs a decision, decisions as marks, taking them back."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import plushsense as ps
from plushsense.core.errors import ConfigError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import format_header, format_rows, read_recording
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.marks import read_marks
from plushsense.workflow.advice import unused_advice

Cli = Callable[..., Any]
ACCEL = load_layout("accel-3")


@pytest.fixture(scope="module")
def sound(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("check") / "DS"
    import_recordings(recordings, folder, layout="accel-3")
    return folder


@pytest.fixture
def folder(sound: Path, tmp_path: Path) -> Path:
    """A data set in which the clock of two recordings of P2 is reset."""
    shutil.copytree(sound, tmp_path / "DS")
    for path in sorted((tmp_path / "DS" / "recordings" / "P2").glob("Slow_*.csv")):
        frames = read_recording(path, ACCEL).frames
        frames.device_ms[80:] -= 900
        path.write_text(format_header(ACCEL) + format_rows(frames, ACCEL), newline="\n")
    (tmp_path / "DS" / "index.json").unlink()
    return tmp_path / "DS"


def ids(folder: Path) -> list[str]:
    return sorted(f"P2/{p.stem}" for p in (folder / "recordings" / "P2").glob("Slow_*.csv"))


def test_a_sound_data_set_passes(cli: Cli, sound: Path) -> None:
    ran = cli("check", sound, "--json")
    assert ran.status == 0
    found = ran.json
    assert (found["recordings"], found["excluded"], found["undecided"], found["findings"]) == (30, 0, 0, [])
    assert found["counts"]["by_severity"] == {"error": 0, "warning": 0, "info": 0}
    text = cli("check", sound)
    assert text.status == 0
    assert "Nothing was found." in text.out


def test_what_needs_a_decision_comes_first_and_fails_the_check(cli: Cli, folder: Path) -> None:
    ran = cli("check", folder, "--json")
    assert ran.status == 1
    errors = [f for f in ran.json["findings"] if f["severity"] == "error"]
    assert [(f["recording"], f["check"]) for f in errors] == [(i, "clock-reset") for i in ids(folder)]
    for f in errors:
        assert set(f) >= {
            "recording",
            "stream",
            "subject",
            "gesture",
            "check",
            "severity",
            "message",
            "action",
            "accepted",
        }
        assert "after row 80" in f["message"]
    text = cli("check", folder)
    assert text.status == 1
    lines = text.out.splitlines()
    assert lines[2] == "To decide: 2"
    assert lines[3].split() == ["clock-reset", *ids(folder)[0].split()]
    assert "-> trim it to one side, or exclude it" in text.out


def test_accepting_is_a_mark_that_can_be_taken_back(cli: Cli, folder: Path) -> None:
    first, second = ids(folder)
    raw = {p: p.read_bytes() for p in (folder / "recordings").rglob("*.csv")}
    ran = cli("check", folder, "--accept", f"clock-reset:{first}", "--why", "the toy fell", "--who", "Kim", "--json")
    assert (ran.status, ran.json["marked"], ran.json["undecided"]) == (1, 1, 1)
    assert "1 mark added" in ran.err
    ran = cli("check", folder, "--accept", "clock-reset:P2/*", "--why", "the toy fell", "--json")
    assert (ran.status, ran.json["marked"], ran.json["undecided"]) == (0, 1, 0), "the first was accepted already"
    assert [f["accepted"] for f in ran.json["findings"] if f["check"] == "clock-reset"] == [True, True]
    assert "2 findings were accepted earlier" in cli("check", folder).out
    said = [json.loads(line) for line in (folder / "marks.jsonl").read_text().splitlines()]
    assert [(m["recording"], m["check"], m["why"]) for m in said] == [
        (first, "clock-reset", "the toy fell"),
        (second, "clock-reset", "the toy fell"),
    ]
    assert said[0]["who"] == "Kim"
    assert said[1]["who"], "by default who is logged in"
    assert cli("check", folder, "--unaccept", f"clock-reset:{second}").status == 1
    assert read_marks(folder)[second].accepted == frozenset()
    assert {p: p.read_bytes() for p in raw} == raw, "raw files never change"


def test_excluding_is_a_mark_that_can_be_taken_back(cli: Cli, folder: Path) -> None:
    ran = cli("check", folder, "--exclude", "P2/Slow_*", "--why", "the toy fell", "--json")
    assert (ran.status, ran.json["marked"], ran.json["recordings"], ran.json["excluded"]) == (0, 2, 28, 2)
    assert "clock-reset" not in ran.json["counts"]["by_check"]
    assert ", 2 excluded" in cli("check", folder).out
    again = cli("check", folder, "--exclude", "P2/Slow_*", "--why", "twice", "--json")
    assert again.json["marked"] == 0
    assert "all were there already" in again.err
    ran = cli("check", folder, "--include", ids(folder)[0], "--json")
    assert (ran.status, ran.json["excluded"], ran.json["undecided"]) == (1, 1, 1)
    ran = cli("check", folder, "--exclude", "clock-reset:*", "--why", "it restarted", "--json")
    assert (ran.status, ran.json["marked"], ran.json["excluded"]) == (0, 1, 2)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--accept", "clock-reset:P2/*"], "need a reason"),
        (["--exclude", "P2/*"], "need a reason"),
        (["--exclude", "P9/*", "--why", "x"], "There is no recording 'P9/*'"),
        (["--exclude", "gapps:P2/*", "--why", "x"], "There is no check 'gapps'"),
        (["--exclude", "gaps:P2/*", "--why", "x"], "There is no recording with a finding of 'gaps' 'P2/*'"),
        (["--accept", "clock-reset:P3/*", "--why", "x"], "no finding of 'clock-reset' about 'P3/*'"),
        (["--accept", "clock-rest:P2/*", "--why", "x"], "Did you mean 'clock-reset'"),
        (["--accept", "gaps:P2/*", "--why", "x"], "found nothing"),
        (["--unaccept", "gaps:P2/*"], "No finding of 'gaps' is accepted"),
        (["--only", "gap"], "Did you mean 'gaps'"),
        (["--limit", "duraton=0.3"], "Did you mean 'duration'"),
        (["--limit", "duration=much"], "give a name and a number"),
        (["--limit", "duration=-1"], "it must be a number above 0"),
        (["--limit", "duration=nan"], "it must be a number above 0"),
        (["--report", "page.txt"], "does not end in .html"),
    ],
)
def test_a_refusal_is_one_sentence_and_marks_nothing(words: list[str], said: str, cli: Cli, folder: Path) -> None:
    ran = cli("check", folder, *words)
    assert (ran.status, ran.out) == (2, "")
    assert said in ran.err
    assert "Traceback" not in ran.err
    assert not (folder / "marks.jsonl").exists()


def test_one_wrong_pattern_leaves_no_half_of_a_decision(cli: Cli, folder: Path) -> None:
    ran = cli("check", folder, "--exclude", ids(folder)[0], "--accept", "clock-reset:P4/*", "--why", "x")
    assert ran.status == 2
    assert not (folder / "marks.jsonl").exists()


@pytest.mark.exhaustive
def test_the_page_replaces_its_own_kind_only(cli: Cli, folder: Path, tmp_path: Path) -> None:
    page = tmp_path / "check.html"
    ran = cli("check", folder, "--report", page, "--json")
    assert (ran.status, ran.json["report"]) == (1, str(page))
    assert ids(folder)[0] in page.read_text(encoding="utf-8")
    assert cli("check", folder, "--report", page, "--json").json["report"] == str(page)
    page.write_text("my notes")
    ran = cli("check", folder, "--report", page)
    assert ran.status == 2
    assert page.read_text() == "my notes"


def test_from_python(folder: Path) -> None:
    from plushsense.workflow.datasets import DecisionSpec, decide

    result = ps.check_dataset(folder)
    assert "CheckResult" in repr(result)
    assert "2 errors" in repr(result)
    assert "clock-reset" in result._repr_html_()
    figure = result.figure("slow")
    assert len(figure.axes) == 2
    with pytest.raises(ConfigError, match="no limit 'durations'"):
        ps.check_dataset(ps.open_dataset(folder), limits={"durations": 1})
    after, marked = decide(folder, DecisionSpec(exclude=["P2/Slow_*"], why="fell", who="Kim"))
    assert (marked, after.excluded, after.ok) == (2, 2, True)


def test_a_simulation_says_so_whatever_simulated_it(cli: Cli, folder: Path) -> None:
    assert "SIMULATION" not in cli("check", folder).out
    head = folder / "dataset.toml"
    head.write_text(head.read_text().replace("simulated = false", "simulated = true"))
    told = cli("check", folder).out
    assert "SIMULATION: these recordings say nothing about a real toy." in told and "virtual" not in told


@pytest.mark.slow
def test_a_training_says_once_which_advice_is_not_used(cli: Cli, folder: Path, tmp_path: Path) -> None:
    given = ("train", folder, "--epochs", "1", "--arch", "4", "--filters", "2", "--window-s", "1.5", "--force")
    ran = cli(*given, "--out", tmp_path / "m.plush")
    assert ps.load(tmp_path / "m.plush").windowing["window_s"] == 1.5
    (line,) = (line for line in ran.err.splitlines() if line.startswith("not used: "))
    assert f"check marks 2 recordings: to leave them out, try  check {folder} --exclude clock-reset: --why" in line
    cli("check", folder, "--accept", f"clock-reset:{ids(folder)[0]}", "--why", "the toy fell")
    assert "check marks 1 recording:" in unused_advice(folder, 1.5)[0].text
    cli("check", folder, "--exclude", "clock-reset:", "--why", "it restarted")
    assert "not used" not in cli(*given, "--out", tmp_path / "m.plush").err
