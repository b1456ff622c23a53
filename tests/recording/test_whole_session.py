"""The paper's session, 17 gestures three times each, over a pseudo terminal: in one piece, and killed on the way."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.recorder_csv import STREAM_NAME, parse_name, read_stream
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import PersonInfo, read_people
from plushsense.devices.virtual.session import GESTURES
from plushsense.recording.writer import SESSION_LOG, read_events
from plushsense.workflow.datasets import check_dataset
from support.pty_toys import LAYOUT, Toy, check_whole, pty_toy, recordings
from support.traced import SocketTrace

SPEED = 60.0
KILL_SPEED = 8.0
"""For the kills: a second of the toy is then 125 ms, which a busy machine may well take to run the next process."""
pytestmark = pytest.mark.usefixtures("pty_possible")


def recording(out: Path, toy: Toy, speed: float, *words: str, before: Sequence[str] = ()) -> subprocess.Popen[str]:
    """``plushsense record`` as a program of its own, pressing its own space bar."""
    process = subprocess.Popen(
        [
            *before, sys.executable, "-m", "plushsense", "record", str(out), "--device", toy.url,
            "--subject", "S01", "--speed", str(speed), "--auto", "4", "--json", *words,
        ],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    toy.readers.append(process)
    return process


def result(process: subprocess.Popen[str], timeout_s: float = 120.0) -> dict[str, Any]:
    """What the program says at its end."""
    out, err = process.communicate(timeout=timeout_s)
    assert process.returncode == 0, err
    found: dict[str, Any] = json.loads(out)
    return found


def kill(process: subprocess.Popen[str]) -> None:
    """``kill -9``"""
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_51_recordings_that_import_again(tmp_path: Path) -> None:
    out, folder, trace = tmp_path / "out", tmp_path / "out" / "S01" / "1", SocketTrace(tmp_path)
    with pty_toy(folder / SESSION_LOG, SPEED) as toy:
        said = result(recording(out, toy, SPEED, "--age-group", "child", before=trace.words))
    assert {k: said[k] for k in ("recordings", "skipped", "redone", "lost", "gaps", "finished", "resumed")} == {
        "recordings": 51, "skipped": 0, "redone": 0, "lost": 0, "gaps": [], "finished": True, "resumed": False,
    }  # fmt: skip
    assert check_whole(folder, toy) == 51
    made = [n.label for p in recordings(folder) if (n := parse_name(p.name)) is not None]
    assert {label: made.count(label) for label in GESTURES} == dict.fromkeys(GESTURES, 3)
    _hand_follows_prompt(folder, toy)
    summary = import_recordings(out, tmp_path / "ds")
    assert (summary.recordings, summary.streams, summary.rejected, summary.left_out) == (51, 1, (), ())
    assert (summary.warnings, summary.dataset.head.simulated) == ((), True)
    assert {(r.subject, r.session, r.excluded) for r in summary.dataset.recordings} == {("S01", "1", False)}
    assert read_people(tmp_path / "ds") == {"S01": PersonInfo("S01", "child")}
    assert [f for f in check_dataset(summary.dataset).findings if f.severity != "info"] == []
    located = {r.file.rsplit("/", 1)[-1]: r.stream_row for r in summary.dataset.recordings}
    assert located == {p.name: json.loads(p.with_suffix(".json").read_text())["stream_row"] for p in recordings(folder)}
    assert trace.used() == set()


def _hand_follows_prompt(folder: Path, toy: Toy) -> None:
    """The virtual person performs what was prompted, in this order, and at least once while it is recorded.

    At this speed a second of the toy is 17 ms, so on a busy machine a prompt may be missed or read too late.
    """
    prompted = iter([str(e.details["gesture"]) for e in read_events(folder) if e.kind == "countdown"])
    assert all(p.label in prompted for p in toy.performed)
    beside = [json.loads(path.with_suffix(".json").read_text()) for path in recordings(folder)]
    spans = [(b["gesture"], *b["device_ms"]) for b in beside]
    assert any(p.label == label and a <= p.start_ms <= b for p in toy.performed for label, a, b in spans)


def hasty(folder: Path) -> tuple[str, ...]:
    """The paper's 17 gestures three times, each only a second long: options of the recorder."""
    own = folder / "hasty.toml"
    own.write_text('name = "hasty"\ngesture_set = "plush-18"\ncountdown_s = 0.5\n', encoding="utf-8")
    return ("--protocol", str(own), "--auto", "1")


def kill_and_check(out: Path, toy: Toy, after_s: float, speed: float, *words: str) -> dict[str, float]:
    """Record, kill -9 after so long, and look at what is there: how much of the stream is missing, in ms."""
    folder = out / "S01" / "1"
    process = recording(out, toy, speed, *words)
    until = time.monotonic() + 30
    rows = (folder / STREAM_NAME).stat().st_size if (folder / STREAM_NAME).exists() else 0
    while not (folder / STREAM_NAME).exists() or (folder / STREAM_NAME).stat().st_size <= rows:
        assert time.monotonic() < until
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(after_s)
    done = len(recordings(folder))
    sent_ms = toy.last_ms
    kill(process)
    stream = read_stream(folder / STREAM_NAME, LAYOUT)
    before = [e for e in read_events(folder) if e.kind in ("start", "take", "abandon", "unfinished")]
    return {
        "recordings": done,
        "missing_ms": sent_ms - int(stream.frames.device_ms[-1]),
        "torn": float(stream.malformed),
        "in_a_recording": float(bool(before) and before[-1].kind == "start"),
    }


@pytest.mark.exhaustive
def test_killed_three_times(tmp_path: Path) -> None:
    """The last second of the stream may be missing, no finished recording is damaged, and it goes on to the end."""
    out, folder = tmp_path / "out", tmp_path / "out" / "S01" / "1"
    moments = random.Random()
    words = hasty(tmp_path)
    with pty_toy(folder / SESSION_LOG, KILL_SPEED) as toy:
        missing_ms = []
        for _ in range(3):
            found = kill_and_check(out, toy, moments.uniform(0.1, 4.5), KILL_SPEED, *words)
            missing_ms.append(found["missing_ms"])
            assert len(recordings(folder)) >= found["recordings"]
        # A busy machine may halt the toy or the recorder for 125 ms, but not at every kill.
        assert min(missing_ms) <= 1000
        said = result(recording(out, toy, KILL_SPEED, *words))
    assert (said["recordings"], said["finished"], said["resumed"]) == (51, True, True)
    assert check_whole(folder, toy) == 51
    assert not [p.name for p in folder.iterdir() if p.suffix in (".part", ".new", ".torn", ".lock")]
    # What is missing lies between two runs, nowhere else.
    stream = read_stream(folder / STREAM_NAME, LAYOUT).frames
    opened = {e.details["row"] for e in read_events(folder) if e.kind == "open"}
    gaps = set((np.flatnonzero(np.abs(np.diff(stream.device_ms)) > 15) + 1).tolist())
    assert gaps <= opened


def test_killed_at_real_speed(tmp_path: Path) -> None:
    """At real speed rows are collected for half a second: then, too, at most the last second is missing."""
    folder = tmp_path / "out" / "S01" / "1"
    with pty_toy(folder / SESSION_LOG, 1.0) as toy:
        found = kill_and_check(tmp_path / "out", toy, 2.0 + random.random(), 1.0)
    assert found["missing_ms"] <= 1000
    assert len(read_stream(folder / STREAM_NAME, LAYOUT).frames) > 150
