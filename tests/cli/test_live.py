"""A toy in one process, ``plushsense live`` in another: over a pseudo-terminal, over TCP, and from a real recording."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from support.traced import SocketTrace

pytestmark = pytest.mark.apart("trainings")

COMMAND = [sys.executable, "-m", "plushsense"]
KEYS = ["t_s", "gesture", "affect", "confidence", "source", "state", "answer", "events"]


@pytest.fixture(scope="module")
def plush_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default network with random weights on the plush layout: what it says does not matter here."""
    from plushsense.core.gestures import load_gestures
    from plushsense.core.layouts import load_layout
    from plushsense.models.arch import Arch
    from plushsense.models.bundle import Bundle
    from plushsense.models.reference import random_weights
    from plushsense.windows.features import Scaler

    arch = Arch.parse("14d1_19d2_19d4", (8, 12, 16))
    bundle = Bundle(
        arch, random_weights(arch, 3), load_layout("plush-15"), Scaler(np.zeros(11), np.full(11, 1e-3)),
        load_gestures("plush-18"),
    )  # fmt: skip
    return bundle.save(tmp_path_factory.mktemp("plush") / "m.plush")


@contextmanager
def toy(*words: str) -> Iterator[str]:
    """A toy that runs beside the test; yields its URL."""
    process = subprocess.Popen(
        [*COMMAND, "toy", *words, "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert process.stdout is not None
        yield json.loads(process.stdout.readline())["url"]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(10)


def live(*words: str, before: Sequence[str] = ()) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The decisions and the closing summary of a live run."""
    command = [*before, *COMMAND, "live", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()], json.loads(done.stderr.splitlines()[-1])


def check(decisions: list[dict[str, Any]], summary: dict[str, Any], seconds: float) -> None:
    assert all(list(d) == KEYS for d in decisions)
    assert abs(len(decisions) - 20 * seconds) <= 2, "20 decisions a second of the toy's clock"
    states = [d["state"] for d in decisions]
    assert states[0] == "warming"
    assert decisions[0]["gesture"] is None
    assert "tracking" in states
    assert all(0 < d["confidence"] <= 1 for d in decisions if d["state"] == "tracking")
    assert summary["counters"]["lost"] > 0
    assert summary["counters"]["malformed"] > 0


def test_over_a_serial_port(plush_bundle: Path, pty_possible: None, tmp_path: Path) -> None:
    truth = tmp_path / "truth.jsonl"
    with toy("--serial-pty", "--speed", "4", "--lost", "0.02", "--garbled", "0.02", "--truth", str(truth)) as url:
        assert url.startswith("serial://")
        decisions, summary = live("--device", url, "--model", str(plush_bundle), "--seconds", "16")
    check(decisions, summary, 16)
    performed = [json.loads(line) for line in truth.read_text().splitlines()]
    assert performed
    assert set(performed[0]) == {"label", "start_ms", "end_ms", "person", "start_s", "end_s"}


def test_over_tcp(plush_bundle: Path, tmp_path: Path) -> None:
    trace = SocketTrace(tmp_path)
    with toy("--tcp", "0", "--speed", "4", "--lost", "0.02", "--garbled", "0.02") as url:
        words = ("--device", url, "--model", str(plush_bundle), "--seconds", "16")
        decisions, summary = live(*words, before=trace.words)
    check(decisions, summary, 16)
    assert trace.used() == {"connect 127.0.0.1"}


def test_a_toy_of_another_layout_says_which_one_fits(plush_bundle: Path) -> None:
    with toy("--tcp", "0", "--layout", "plush-14") as url:
        lines, summary = live("--device", url, "--model", str(plush_bundle), "--seconds", "1")
        assert [line["state"] for line in lines] == ["unreadable"]
        assert lines[0]["warnings"] == summary["warnings"] == [lines[0]["mismatch"]]
        assert lines[0]["mismatch"].endswith(f"'plush-14' has 14: open it as {url}?layout=plush-14")
        assert (summary["counters"]["frames"], summary["no_signal"]) == (0, 1)
        lines, _ = live("--device", f"{url}?layout=plush-14", "--model", str(plush_bundle), "--seconds", "1")
        assert {line["state"] for line in lines} == {"warming"}
        assert all("mismatch" not in line for line in lines)


def test_from_a_real_stream(bundle: Path, real_data: Path) -> None:
    stream = real_data / "makeability-gestures" / "P01" / "fulldatastream.csv"
    decisions, summary = live("--device", f"replay://{stream}?speed=0", "--model", str(bundle))
    assert summary["counters"]["frames"] == 47957
    assert summary["restarts"] == 2, "the device clock of this session was reset twice"
    assert abs(summary["decisions_per_s"] - 20) < 0.1
    states = [d["state"] for d in decisions]
    for pair in (("tracking", "no signal"), ("no signal", "warming")):
        assert list(pairwise(states[:-1])).count(pair) == 2, (
            "at each restart the signal is lost, then it is warming again"
        )


def test_the_default_layout_is_the_bundles(bundle: Path) -> None:
    decisions, _ = live("--device", "virtual://?speed=0", "--model", str(bundle), "--seconds", "4")
    assert abs(len(decisions) - 80) <= 2


def test_in_whole_numbers_and_beside_the_floats(bundle: Path, recordings: Path) -> None:
    stream = recordings / "P1" / "fulldatastream.csv"
    words = ("--device", f"replay://{stream}?speed=0", "--model", str(bundle), "--seconds", "20")
    whole, summary = live(*words, "--engine", "int8")
    assert "agreement" not in summary
    assert all(list(d) == KEYS for d in whole)
    known = [d["confidence"] for d in whole if d["state"] == "tracking"]
    assert len(known) > 200
    both, summary = live(*words, "--engine", "both")
    assert both == whole
    easily, more = live(*words, "--engine", "int8", "--sensitivity", "127")
    assert [d["confidence"] for d in easily] == [d["confidence"] for d in whole]
    assert more["events"] > summary["events"]
    assert summary["agreement"]["gesture"] > 0.8
    floats, _ = live(*words, "--engine", "float")
    assert [(d["t_s"], d["state"]) for d in floats] == [(d["t_s"], d["state"]) for d in whole]


def test_a_bundle_of_before_says_what_to_do(plush_bundle: Path) -> None:
    words = ["live", "--device", "virtual://", "--model", str(plush_bundle), "--engine", "int8"]
    done = subprocess.run([*COMMAND, *words], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert "no calibration" in done.stderr and "Traceback" not in done.stderr


def spoilt(tmp_path: Path) -> str:
    """A replay of a stream with a gap of 10 s and a sensor that sends garbage for a second."""
    from plushsense.core.layouts import load_layout
    from plushsense.core.recorder_csv import Frames, write_recording

    draw = np.random.default_rng(0)
    times = 1000 + 10 * np.arange(2000)
    times[1500:] += 10_000
    values = draw.integers(0, 500, (2000, 13))
    values[800:900, 3] = -30_000
    path = tmp_path / "tap_1700000000000_2000.csv"
    write_recording(path, Frames(values, times, times + 1_700_000_000_000), load_layout("plush-15"))
    return f"replay://{path.as_posix()}?speed=0"


def test_events_only_and_text_for_people(plush_bundle: Path, tmp_path: Path) -> None:
    words = ("--device", spoilt(tmp_path), "--model", str(plush_bundle))
    every, summary = live(*words)
    assert (summary["faults"], summary["no_signal"]) == (1, 2), "the gap, and the end of the file within an event"
    few, _ = live(*words, "--events")
    state, wanted = None, []
    for line in every:
        if line["events"] or line["state"] != state:
            wanted.append(line)
        state = line["state"]
    assert few == wanted and len(few) < len(every) / 2
    done = subprocess.run(
        [*COMMAND, "live", *words, "--text"], capture_output=True, text=True, check=False, timeout=120
    )
    text = done.stdout.splitlines()
    assert len([t for t in text if "no signal" in t]) == 2
    assert len([t for t in text if "sensor fault" in t]) == 1
    begun = [e for line in every for e in line["events"] if e["what"] == "begun"]
    ended = [e for line in every for e in line["events"] if e["what"] == "ended"]
    assert summary["events"] == len(begun) == len(ended) > 0
    assert len([t for t in text if "end of" in t]) == len(ended)
    first = begun[0]
    assert any(f"{first['t_s']:9.2f} s  1 {first['affect']}" in t for t in text)
    both = subprocess.run(
        [*COMMAND, "live", *words, "--text", "--events"], capture_output=True, text=True, check=False, timeout=60
    )
    assert both.returncode == 2 and "Traceback" not in both.stderr


def test_what_was_assumed_about_a_stream_is_said(
    plush_bundle: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from plushsense.cli.main import main
    from plushsense.devices import opening
    from plushsense.devices.base import Device

    open_virtual = opening.open_device

    def open_unnamed(*args: Any, **settings: Any) -> Device:
        device = open_virtual(*args, **settings)
        device.notes = ("its channels have no names",)
        return device

    monkeypatch.setattr(opening, "open_device", open_unnamed)
    assert main(["live", "--device", "virtual://?speed=0&seconds=1", "--model", str(plush_bundle)]) == 0
    assert "warning: virtual://?speed=0&seconds=1: its channels have no names" in capsys.readouterr().err
