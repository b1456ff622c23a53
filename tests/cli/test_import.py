"""``plushsense import`` as a user types it: sessions, adding, tables, and what it prints."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, recording_filename, write_recording
from plushsense.recording.writer import SessionHead
from support.foreign_folders import FOLDERS

ACCEL = load_layout("accel-3")
Cli = Callable[..., Any]


def session(folder: Path, subject: str, seed: int) -> Path:
    folder.mkdir(parents=True)
    clock = np.arange(200, dtype=np.int64) * 10
    values = np.random.default_rng(seed).integers(0, 900, (200, 3))
    stream = Frames(values, clock, clock + 10**12 + seed)
    SessionHead(subject, folder.name, 10**12, ACCEL.to_dict(), {"name": "p"}, "child").write(folder)
    (folder / "fulldatastream.csv").write_text(format_rows(stream, ACCEL))
    part = stream.slice(50, 110)
    write_recording(folder / recording_filename("Shake", 10**12 + seed, 60), part, ACCEL)
    return folder


def test_sessions_then_more_of_them(cli: Cli, tmp_path: Path) -> None:
    session(tmp_path / "out" / "P1" / "s1", "P1", 1)
    found = cli("import", tmp_path / "out", tmp_path / "DS", "--json")
    assert found.status == 0
    assert found.json["warnings"] == found.json["rejected"] == found.json["left_out"] == []
    folder = session(tmp_path / "out" / "P2" / "s1", "P2", 2)
    (folder / "Wave_1_2.csv.part").write_text("x")
    again = cli("import", tmp_path / "out", tmp_path / "DS", "--json")
    assert again.status == 2
    assert "is a data set already: add to it with --add" in again.err
    added = cli("import", tmp_path / "out", tmp_path / "DS", "--add", "--json").json
    assert (added["recordings"], added["added"], added["already_there"]) == (2, {"recordings": 1, "streams": 1}, 3)
    text = cli("import", tmp_path / "out", tmp_path / "DS", "--add")
    assert "2 recordings of 2 people, 0 of them new, 6 files already there" in text.out
    assert "left out: P2/s1/Wave_1_2.csv.part: not finished" in text.err
    assert cli("info", tmp_path / "DS", "--json").json["located_in_stream"] == 2


def test_the_source_is_only_read(cli: Cli, tmp_path: Path) -> None:
    session(tmp_path / "out" / "P1" / "s1", "P1", 1)
    ran = cli("import", tmp_path / "out", tmp_path / "out" / "DS")
    assert ran.status == 2
    assert "which is only read" in ran.err
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["P1"]


def test_a_table_with_columns_of_its_own(cli: Cli, tmp_path: Path) -> None:
    rows = "".join(f"ana,Shake,{i * 10},{i},2,3\n" for i in range(50))
    (tmp_path / "t.csv").write_text("who,gesture,time_ms,x,y,z\n" + rows)
    words = ("import", tmp_path / "t.csv", tmp_path / "DS", "--layout", "accel-3", "--json")
    refused = cli(*words)
    assert refused.status == 2
    assert "--column subject=NAME" in refused.err
    assert cli(*words, "--column", "subject=who").json["recordings"] == 1


def test_a_pattern_is_guessed_tried_and_used(cli: Cli, tmp_path: Path) -> None:
    FOLDERS["touch-cells"](tmp_path / "src")
    pattern = tmp_path / "cells.toml"
    guessed = cli("import", tmp_path / "src", "--guess", pattern)
    assert "to check: 5" in guessed.out and "--dry-run" in guessed.out
    assert cli("import", tmp_path / "src", "--guess", pattern).status == 2
    tried = cli("import", tmp_path / "src", "--pattern", pattern, "--dry-run")
    lines = tried.out.splitlines()
    assert lines[0].split()[:6] == ["person", "session", "gesture", "time", "in", "ms"]
    assert len([line for line in lines if line.startswith(("S01", "S02"))]) == 10
    assert "8 recordings of 2 people, 0 streams, layout src; nothing was written" in lines[-2]
    assert "left out: S01/readme.txt: excluded by" in tried.err
    rows = cli("import", tmp_path / "src", "--pattern", pattern, "--dry-run", "--json").json["rows"]
    assert [row["time_ms"] for row in rows[:2]] == [0, 20]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cells.toml", "src"]
    assert "needs DEST" in cli("import", tmp_path / "src", "--pattern", pattern).err
    assert cli("import", tmp_path / "src", tmp_path / "DS", "--pattern", pattern, "--json").json["recordings"] == 8


def test_a_dry_run_counts_no_unknown_person(cli: Cli, tmp_path: Path) -> None:
    for label in ("hug", "tap"):
        rows = "".join(f"{20 * i},{i * i % 7}.5\n" for i in range(50))
        (tmp_path / "src" / label).mkdir(parents=True)
        (tmp_path / "src" / label / "1.csv").write_text("time_ms,left\n" + rows)
    cli("import", tmp_path / "src", "--guess", tmp_path / "p.toml")
    tried = cli("import", tmp_path / "src", "--pattern", tmp_path / "p.toml", "--dry-run")
    assert "2 recordings of 0 people, 0 streams" in tried.out
    assert "the people are not known" in tried.err


def test_a_dry_run_of_sessions(cli: Cli, tmp_path: Path) -> None:
    session(tmp_path / "out" / "P1" / "s1", "P1", 1)
    found = cli("import", tmp_path / "out", "--dry-run", "--json").json
    assert (found["recordings"], found["streams"], found["gestures"], len(found["rows"])) == (1, 1, {"Shake": 1}, 10)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["{src}", "{tmp}/x"], "--layout is needed"),
        (["{src}", "{tmp}/x", "--layout", "accel-3", "--column", "label"], "write ROLE=NAME"),
        (["{src}", "{tmp}/x", "--layout", "accel-3", "--column", "label=x"], "is for a table"),
        (["{src}", "{tmp}/x", "--layout", "accel-3", "--max-gb", "-1"], "give a number above 0"),
        (["{src}", "{tmp}/x", "--layout", "accel-3", "--max-gb", "nan"], "give a number above 0"),
        (["{src}", "{src}", "--add"], "is not a data set"),
        (["{src}/a.rar", "{tmp}/x", "--layout", "accel-3"], "ends in .zip"),
    ],
)
def test_what_is_refused_is_one_sentence(cli: Cli, tmp_path: Path, words: list[str], said: str) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "a.rar").write_bytes(b"Rar!")
    ran = cli("import", *[w.format(src=tmp_path / "src", tmp=tmp_path) for w in words])
    assert ran.status == 2
    assert said in ran.err
    assert len(ran.err.strip().splitlines()) == 1
    assert ran.out == ""
