"""The recorder's commands and states, on the virtual toy as fast as it goes."""

from __future__ import annotations

import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError, DeviceError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, read_recording, read_stream
from plushsense.devices.base import Device, Frame, ReconnectingDevice, now_ms
from plushsense.devices.opening import open_device
from plushsense.recording import recorder as machine
from plushsense.recording import takes
from plushsense.recording.plan import load_protocol
from plushsense.recording.recorder import AutoRecording, Recorder, prompt_virtual
from plushsense.recording.session import OpenSession
from plushsense.recording.status import RecorderStatus
from plushsense.recording.writer import SessionHead, StreamFile, discarded_recordings, read_events

pytestmark = pytest.mark.slow

LAYOUT = load_layout("plush-15")
PROTOCOL = load_protocol("quick")
SPEED = 50.0
URL = f"virtual://?speed={SPEED:g}&lost=0&garbled=0&glitch=0"


def head(**changes: Any) -> SessionHead:
    protocol = replace(PROTOCOL, **changes)
    return SessionHead("S01", "1", 5, LAYOUT.to_dict(), protocol.to_dict(), simulated=True)


@contextmanager
def recorder(
    folder: Path, device: Device | None = None, auto: AutoRecording | None = None, **changes: Any
) -> Iterator[Recorder]:
    with (
        device or open_device(URL) as toy,
        Recorder.open(folder, toy, head(**changes), speed=SPEED, auto=auto) as made,
    ):
        until(lambda: made.status().signal != "none")
        yield made


def until(true: Callable[[], bool]) -> None:
    limit = time.monotonic() + 20
    while not true():
        assert time.monotonic() < limit
        time.sleep(0.002)


def take(r: Recorder, seconds: float = 1.0) -> RecorderStatus:
    """Make the recording that is asked for; returns what the screen shows then."""
    r.space()
    assert r.status().state == "countdown"
    assert r.wait("recording", timeout_s=20)
    until(lambda: r.status().elapsed_s >= seconds)
    r.space()
    assert r.wait("idle", "finished", timeout_s=20)
    return r.status()


def whats(folder: Path) -> list[str]:
    return [e.kind for e in read_events(folder)]


def test_the_first_unreadable_line_is_shown(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        toy = open_device(f"tcp://127.0.0.1:{server.getsockname()[1]}", LAYOUT)
        with server.accept()[0] as connection, toy, Recorder.open(tmp_path, toy, head()) as made:
            connection.sendall(b"head:1,neck:2\r\n" * 20)
            until(lambda: "the first is 'head:1,neck:2': it has names" in made.status().message)
            assert made.status().signal == "unreadable" and "line" in made.status().message.values


def test_one_recording(tmp_path: Path) -> None:
    seen: list[str] = []
    with recorder(tmp_path) as r:
        assert (r.status().state, r.status().step.gesture, r.status().done) == ("idle", "Back stroke 1", 0)
        r.subscribe(lambda what, _: seen.append(what))
        status = take(r)
        assert (status.done, status.step.gesture, status.steps) == (1, "Head stroke 1", 4)
        assert status.next_step is not None and status.next_step.gesture == "Hold strong"
        assert status.rate_hz == pytest.approx(100, abs=3)
        assert 0.2 < status.jitter_ms < 1.0
        assert (status.signal, status.lost, status.malformed, status.garbage) == ("good", 0, 0, 0)
    assert r.status().state == "stopped"
    assert [w for w in seen if w in ("countdown", "recording", "saving", "take")] == [
        "countdown", "countdown", "recording", "saving", "take",
    ]  # fmt: skip
    assert whats(tmp_path) == ["open", "countdown", "start", "take", "close"]
    path = tmp_path / status.file
    beside = json.loads(path.with_suffix(".json").read_text())
    assert beside["ended"] == "space"
    assert beside["rate_hz"] == pytest.approx(100, abs=1)
    lines = path.read_text().splitlines()[1:]
    stream = (tmp_path / STREAM_NAME).read_text().splitlines()
    assert lines == stream[beside["stream_row"] : beside["stream_row"] + len(lines)]
    start = next(e for e in read_events(tmp_path) if e.kind == "start")
    countdown = next(e for e in read_events(tmp_path) if e.kind == "countdown")
    assert start.details["device_ms"] - countdown.details["device_ms"] == pytest.approx(3000, abs=12)
    assert beside["device_ms"][0] == start.details["device_ms"]


def test_space_cancels_a_countdown_and_does_not_stop_too_soon(tmp_path: Path) -> None:
    with recorder(tmp_path, shortest_s=2.0) as r:
        r.space()
        r.space()
        assert (r.status().state, r.status().message) == ("idle", "The countdown was cancelled.")
        r.space()
        r.wait("recording", timeout_s=20)
        r.space()
        assert (r.status().state, r.status().message) == (
            "recording",
            "Too early to stop: still recording.",
        )
        until(lambda: r.status().elapsed_s >= 2.0)
        r.space()
        r.wait("idle", timeout_s=20)
        assert r.status().done == 1


def test_redo_sets_the_last_one_aside_and_skip_brings_it_back(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        first = take(r).file
        r.redo("sneezed")
        assert (r.status().step.gesture, r.status().done, r.status().redone) == ("Back stroke 1", 0, 1)
        r.redo()
        assert "no recording to repeat" in r.status().message
        r.skip()
        assert (r.status().step.gesture, r.status().done, r.status().redone) == ("Head stroke 1", 1, 0)
        r.redo("sneezed")
        again = take(r).file
        assert again != first
    assert discarded_recordings(tmp_path) == {first: "sneezed"}
    assert (tmp_path / first).exists()
    with recorder(tmp_path) as r:
        assert (r.status().step.gesture, r.status().done, r.status().redone) == ("Head stroke 1", 1, 1)


def test_a_running_one_is_broken_off(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        r.space()
        r.wait("recording", timeout_s=20)
        for refused in (r.skip, r.back):
            refused()
            assert (r.status().state, "Recording" in r.status().message) == ("recording", True)
        r.redo()
        assert (r.status().state, r.status().step.gesture, r.status().done) == ("idle", "Back stroke 1", 0)
        r.space()
        r.wait("recording", timeout_s=20)
    assert whats(tmp_path) == ["open", *2 * ["countdown", "start", "abandon"], "close"]
    assert [e.details["why"] for e in read_events(tmp_path) if e.kind == "abandon"] == ["redo", "quit"]
    assert not list(tmp_path.glob("Back*"))


def test_a_pause_breaks_a_recording_off_and_asks_for_it_again(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        first = take(r).file
        before = r.status().rows
        r.space()
        r.wait("recording", timeout_s=20)
        until(lambda: r.status().elapsed_s >= 1.0)
        r.pause()
        status = r.status()
        assert (status.state, status.done, status.file) == ("paused", 1, first)
        assert (status.step.gesture, "record it again" in status.message) == ("Head stroke 1", True)
        r.resume()
        assert (r.status().state, r.status().step.gesture, r.status().done) == ("idle", "Head stroke 1", 1)
        assert take(r).done == 2
    events = list(read_events(tmp_path))
    (abandoned,) = [e.details for e in events if e.kind == "abandon"]
    assert (abandoned["why"], abandoned["gesture"], abandoned["repetition"]) == ("pause", "Head stroke 1", 1)
    # Nothing is lost: the rows of the abandoned recording are in the stream, where the log says.
    started = [e.details["row"] for e in events if e.kind == "start"][1]
    rows = read_stream(tmp_path / STREAM_NAME, LAYOUT).frames
    assert started >= before
    assert abandoned["rows"] >= 95
    assert len(rows) >= started + abandoned["rows"]
    assert [e.details["gesture"] for e in events if e.kind == "take"] == ["Back stroke 1", "Head stroke 1"]
    assert len(list(tmp_path.glob("Head stroke 1_*.csv"))) == 1
    with recorder(tmp_path) as r:
        assert (r.status().done, r.status().step.gesture) == (2, "Hold strong")


def test_back_makes_one_again_only_when_the_new_one_is_there(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        first = take(r).file
        r.skip()
        r.back()
        assert r.status().step.gesture == "Head stroke 1"
        r.back()
        assert (r.status().step.gesture, r.status().existing) == ("Back stroke 1", first)
        r.space()
        r.space()
        assert r.status().existing == first
        status = take(r)
        assert (status.done, status.redone, status.skipped, status.step.gesture) == (1, 1, 1, "Hold strong")
        r.go(1)
        assert take(r).skipped == 0
    assert discarded_recordings(tmp_path) == {first: "recorded again"}


def test_pause_note_and_the_end(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        r.pause()
        r.space()
        assert (r.status().state, r.status().message) == ("paused", "Paused: resume first (p).")
        r.resume()
        r.note("  the child\n laughs ")
        for _ in range(3):
            r.skip()
        assert take(r).state == "finished"
        assert r.wait("finished", timeout_s=0)
    assert next(e.details["text"] for e in read_events(tmp_path) if e.kind == "note") == "the child laughs"
    assert whats(tmp_path)[-2:] == ["finished", "close"]
    with recorder(tmp_path) as r:
        assert (r.status().state, r.status().done, r.status().skipped) == ("finished", 1, 3)
        r.back()
        assert (r.status().state, r.status().step.gesture) == ("idle", "Tail tap 1")


def test_a_recording_that_nobody_stops_ends_by_itself(tmp_path: Path) -> None:
    with recorder(tmp_path, longest_s=2.0) as r:
        r.space()
        r.wait("recording", timeout_s=20)
        r.wait("idle", timeout_s=20)
        status = r.status()
        assert (status.done, "Nobody stopped the recording" in status.message) == (1, True)
    beside = json.loads((tmp_path / status.file).with_suffix(".json").read_text())
    assert (beside["ended"], beside["auto_stopped"]) == ("longest", True)
    assert beside["device_ms"][1] - beside["device_ms"][0] == pytest.approx(2000, abs=12)


def test_it_presses_its_own_space_bar(tmp_path: Path) -> None:
    device = open_device(URL)
    with device, Recorder.open(tmp_path, device, head(), speed=SPEED, auto=AutoRecording(1.5, 0.5)) as r:
        assert r.wait("finished", timeout_s=30)
        assert r.status().done == 4
    for path in tmp_path.glob("*_*.json"):
        beside = json.loads(path.read_text())
        assert beside["ended"] == "auto"
        assert beside["device_ms"][1] - beside["device_ms"][0] == pytest.approx(1500, abs=12)


def test_the_virtual_person_does_what_is_asked_for(tmp_path: Path) -> None:
    # Slowly: a machine that stands still for a moment is seen by the person as toy's time, ten times over.
    with open_device(URL.replace(f"speed={SPEED:g}", "speed=10")) as device:
        r = Recorder.open(tmp_path, device, head(), speed=10, auto=AutoRecording(4.0))
        prompt_virtual(r)
        with r:
            assert r.wait("finished", timeout_s=60)
        performed = list(device.performed)  # type: ignore[attr-defined]
    assert [p.label for p in performed] == list(PROTOCOL.gestures)
    recorded = [json.loads(path.read_text()) for path in tmp_path.glob("*_*.json")]
    begins = {each["gesture"]: each["device_ms"][0] for each in recorded}
    late = [p.start_ms - begins[p.label] for p in performed]
    # Never before its recording, never in the next one; and soon, but for those that fell into such a moment.
    assert all(each > 0 for each in late)
    assert all(p.start_ms < begins[n.label] for p, n in itertools.pairwise(performed))
    assert min(late) < 2000


class Plug(Device):
    """A virtual toy on a plug that is pulled for a while of the toy's time; the toy goes on meanwhile."""

    def __init__(self, toy: Device, from_ms: int, for_ms: int) -> None:
        super().__init__(toy.url, toy.layout)
        self.toy, self._from, self._until = toy, from_ms, from_ms + for_ms
        # Looking for it takes as long as it is away.
        while (now := toy.read() or [Frame(0, 0, ())])[-1].device_ms >= from_ms > 0:
            if now[-1].device_ms >= self._until:
                self._from = sys.maxsize
                break

    def read(self) -> list[Frame] | None:
        frames = self.toy.read() or []
        if frames and frames[-1].device_ms >= self._from:
            raise DeviceError("'x' went away: was it unplugged?")
        return frames


def test_unplugged_for_five_seconds_during_a_gesture(tmp_path: Path) -> None:
    # Slowly: what a busy machine takes to come back counts as the toy's time, ten times over.
    speed = 10.0
    with open_device(URL.replace(f"speed={SPEED:g}", f"speed={speed:g}")) as toy:
        first: list[Frame] = []
        while not first:
            first = toy.read() or []
        # The recording runs from about 4 s on to about 20 s: rest, countdown, and sixteen seconds of gesture.
        from_ms = first[-1].device_ms + 7000
        device = ReconnectingDevice("x", LAYOUT, lambda: Plug(toy, from_ms, 5000))
        seen: list[RecorderStatus] = []
        r = Recorder.open(tmp_path, device, head(), speed=speed, auto=AutoRecording(16.0, 1.0))
        r.subscribe(lambda what, status: seen.append(status))
        with device, r:
            until(lambda: r.status().done == 1)
            status = r.status()
        assert any("this recording has a gap" in s.message for s in seen)
    assert (status.gaps, status.reconnects) == (1, 1)
    beside = json.loads(next(tmp_path.glob("*_*.json")).read_text())
    (gap,) = beside["gaps"]
    # What the toy said just before and just after the plug was pulled may be lost with it.
    assert 5000 <= gap["missing_ms"] < 11_000
    assert (beside["reconnects"], gap["reason"]) == (1, "'x' went away: was it unplugged?")
    (event,) = [e for e in read_events(tmp_path) if e.kind == "gap"]
    assert (event.details["gesture"], event.details["missing_ms"]) == ("Back stroke 1", gap["missing_ms"])
    frames = read_recording(next(tmp_path.glob("Back*.csv")), LAYOUT).frames
    hole = int(np.argmax(np.diff(frames.device_ms)))
    assert hole + 1 == gap["after_row"]
    assert [int(frames.device_ms[hole]), int(frames.device_ms[hole + 1])] == gap["device_ms"]
    assert gap["device_ms"][1] - gap["device_ms"][0] == gap["missing_ms"]
    assert len(frames) == beside["rows"]
    assert frames.device_ms[-1] - frames.device_ms[0] == pytest.approx(16_000, abs=12)


class Pausing(Device):
    """A toy in real time that is silent for a while, once: its clock goes on meanwhile."""

    def __init__(self, from_s: float, pause_s: float) -> None:
        super().__init__("x", LAYOUT)
        self._begin, self._from, self._until = time.monotonic(), from_s, from_s + pause_s
        self._at = 0.0

    def read(self) -> list[Frame] | None:
        time.sleep(0.01)
        now = time.monotonic() - self._begin
        if self._from <= now < self._until:
            return []
        before, self._at = self._at, now
        if before < self._from <= now:
            return [Frame(now_ms(), round(1000 * now), (0,) * LAYOUT.n_channels)]
        return [
            Frame(now_ms(), ms, (0,) * LAYOUT.n_channels)
            for ms in range(-(-round(1000 * before) // 10) * 10, round(1000 * now), 10)
        ]


def test_a_hole_that_ends_a_recording_is_stated_once(tmp_path: Path) -> None:
    """The first frame after a silence may be the one at which the recording ends."""
    with (
        Pausing(1.0, 1.5) as toy,
        Recorder.open(
            tmp_path, toy, head(countdown_s=0.1, gestures=("Hold strong",)), auto=AutoRecording(1.2, 0.3)
        ) as r,
    ):
        assert r.wait("finished", timeout_s=20)
    beside = json.loads(next(tmp_path.glob("*_*.json")).read_text())
    (gap,) = beside["gaps"]
    assert gap["reason"] == "nothing came"
    assert 1400 <= gap["missing_ms"] < 3000


class Standing(Device):
    """A toy in real time whose clock stands still."""

    def read(self) -> list[Frame] | None:
        time.sleep(0.005)
        return [Frame(now_ms(), 7, (0,) * LAYOUT.n_channels)]


def test_a_clock_that_stands_ends_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(takes, "SLOWEST", 0.1)
    with (
        Standing("x", LAYOUT) as toy,
        Recorder.open(tmp_path, toy, head(countdown_s=0.5, shortest_s=0.0, longest_s=1.0)) as r,
    ):
        until(lambda: r.status().rows > 5)
        r.space()
        assert r.wait("recording", timeout_s=5), "the countdown ends, too"
        assert r.wait("idle", timeout_s=5)
        assert json.loads((tmp_path / r.status().file).with_suffix(".json").read_text())["ended"] == "longest"


class Breaking(Device):
    """A toy that goes away for good after some frames."""

    def __init__(self, inner: Device, frames: int) -> None:
        super().__init__(inner.url, inner.layout)
        self.inner, self.counters, self._left = inner, inner.counters, frames

    def read(self) -> list[Frame] | None:
        frames = self.inner.read() or []
        self._left -= len(frames)
        if self._left < 0:
            raise DeviceError("'x' went away: was it unplugged or switched off?")
        return frames


def test_a_toy_that_goes_for_good_leaves_its_recording(tmp_path: Path) -> None:
    with open_device(URL) as inner:
        device = Breaking(inner, 600)
        with Recorder.open(tmp_path, device, head(), speed=SPEED, auto=AutoRecording(30.0, 0.5)) as r:
            assert r.wait(timeout_s=20)
            assert (r.status().message, r.status().done) == ("'x' went away: was it unplugged or switched off?", 1)
    beside = json.loads(next(tmp_path.glob("*_*.json")).read_text())
    assert beside["ended"] == "toy"


def test_space_without_a_signal_is_answered(tmp_path: Path) -> None:
    class Mute(Device):
        def read(self) -> list[Frame] | None:
            time.sleep(0.01)
            return []

    with Mute("x", LAYOUT) as device, Recorder.open(tmp_path, device, head()) as r:
        r.space()
        assert (r.status().state, r.status().signal) == ("idle", "none")
        assert "Nothing comes from the toy" in r.status().message


def test_commands_from_many_threads_lose_nothing(tmp_path: Path) -> None:
    """Two pages and a keyboard at once: whatever they press, files, log and stream agree."""
    with recorder(tmp_path, repetitions=50, countdown_s=0.1, shortest_s=0.1) as r:
        done = time.monotonic() + 2.0

        def press(seed: int) -> None:
            rng = np.random.default_rng(seed)
            commands = [r.space, r.space, r.space, r.redo, r.skip, r.back, r.pause, r.resume, lambda: r.note("x")]
            while time.monotonic() < done:
                commands[int(rng.integers(len(commands)))]()
                r.status()
                time.sleep(0.001)

        threads = [threading.Thread(target=press, args=(n,)) for n in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        r.wait("idle", "paused", "recording", "countdown", "finished", timeout_s=5)
        at_end = r.status()
    assert not at_end.failed
    stream = (tmp_path / STREAM_NAME).read_text().splitlines()
    clock = read_stream(tmp_path / STREAM_NAME, LAYOUT).frames.device_ms
    assert np.diff(clock).max() <= 12
    takes = [e.details for e in read_events(tmp_path) if e.kind == "take"]
    assert takes
    assert {t["file"] for t in takes} == {p.name for p in tmp_path.glob("* *_*.csv")}
    for path in tmp_path.glob("* *_*.csv"):
        beside = json.loads(path.with_suffix(".json").read_text())
        lines = path.read_text().splitlines()[1:]
        assert lines == stream[beside["stream_row"] : beside["stream_row"] + len(lines)]
    session = OpenSession(tmp_path)
    session.close()
    assert session.progress.repairs == []
    assert (len(session.progress.takes), len(session.progress.skipped)) == (at_end.done, at_end.skipped)


def test_a_remark_after_the_end_is_not_said_to_be_kept(tmp_path: Path) -> None:
    with recorder(tmp_path) as r:
        r.note("in time")
        assert r.status().message == "Note saved."
    r.note("too late")
    assert "not saved" in r.status().message
    assert [e.details["text"] for e in read_events(tmp_path) if e.kind == "note"] == ["in time"]


FULL = """
import resource, signal, sys
from pathlib import Path
from plushsense.cli.main import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), resource.RLIM_INFINITY))
sys.exit(main(["record", sys.argv[1], "--device", sys.argv[3], "--subject", "S01", "--auto", "2", "--json"]))
"""


def check_full(done: subprocess.CompletedProcess[str], out: Path) -> None:
    """It stopped with one sentence, what is there is whole, and with room it goes on to the end."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    (sentence,) = [line for line in done.stderr.splitlines() if line.startswith("plushsense: ")]
    assert "cannot be written any more" in sentence
    assert "free disk space, and continue the same session" in sentence
    said = json.loads(done.stdout)
    assert (said["finished"], "cannot be written" in said["stopped"]) == (False, True)
    folder = out / "S01" / "1"
    assert (folder / STREAM_NAME).read_bytes().endswith(b"\n")
    stream = (folder / STREAM_NAME).read_text().splitlines()
    files = sorted(p for p in folder.glob("* *_*.csv"))
    assert len(files) == said["recordings"] > 0
    for path in files:
        beside = json.loads(path.with_suffix(".json").read_text())
        lines = path.read_text().splitlines()[1:]
        assert len(lines) == beside["rows"]
        assert lines == stream[beside["stream_row"] : beside["stream_row"] + len(lines)]
    assert not [p for p in folder.iterdir() if p.name.endswith((".part", ".new"))]


def resumed(out: Path, before: dict[str, bytes]) -> None:
    with open_device(URL) as device:
        session = OpenSession(out / "S01" / "1")
        with Recorder(session, device, speed=SPEED, auto=AutoRecording(1.0, 0.2)) as r:
            assert r.wait("finished", timeout_s=60)
            assert r.status().done == 51
    for name, data in before.items():
        assert (out / "S01" / "1" / name).read_bytes() == data


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of a file")
def test_a_disk_that_takes_no_more(tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk: it is the stream that does not fit any more."""
    words = [sys.executable, "-c", FULL, str(tmp_path), "400000", URL]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60, stdin=subprocess.DEVNULL)
    check_full(done, tmp_path)
    resumed(tmp_path, {p.name: p.read_bytes() for p in (tmp_path / "S01" / "1").glob("* *_*.csv")})


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MB."""
    place = tmp_path / "disk"
    place.mkdir()
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        pytest.skip("only root may mount a small file system")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)], capture_output=True, text=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"no small file system here: {mounted.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk(small_disk: Path) -> None:
    words = [
        sys.executable, "-m", "plushsense", "record", str(small_disk), "--device", URL,
        "--subject", "S01", "--auto", "2", "--json",
    ]  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60, stdin=subprocess.DEVNULL)
    check_full(done, small_disk)
    # Still full: refused in one sentence again, and nothing is lost by trying.
    before = {p.name: p.read_bytes() for p in (small_disk / "S01" / "1").glob("* *_*.csv")}
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60, stdin=subprocess.DEVNULL)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    resumed(small_disk, before)


def test_a_stream_that_fails_while_a_recording_is_saved_stops_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recording is kept, and the screen must not say that the next may begin."""
    full = threading.Event()
    keep, write = machine.store_take, StreamFile.write

    def slowly(*given: Any, **more: Any) -> tuple[str, str]:
        kept = keep(*given, **more)
        full.set()
        until(lambda: bool(r.status().failed))
        return kept

    def refused(self: StreamFile, frames: Sequence[Frame]) -> None:
        if full.is_set():
            raise OSError(28, "No space left on device")
        write(self, frames)

    monkeypatch.setattr(machine, "store_take", slowly)
    monkeypatch.setattr(StreamFile, "write", refused)
    with recorder(tmp_path, auto=AutoRecording(1.0, 0.5)) as r:
        until(lambda: r.status().done == 1)
        assert r.status().state == "stopped"
        assert "cannot be written any more" in r.status().message
    assert len(list(tmp_path.glob("* *_*.csv"))) == 1


def test_a_stream_that_cannot_be_opened_is_one_sentence(tmp_path: Path) -> None:
    with open_device(URL) as device:
        made = Recorder.open(tmp_path, device, head())
        (tmp_path / STREAM_NAME).mkdir()
        with pytest.raises(DatasetError, match="cannot be written"):
            made.start()
    (tmp_path / STREAM_NAME).rmdir()
    OpenSession(tmp_path).close()


NO_DESCRIPTOR = """
import contextlib, errno, json, os, resource, sys, threading
from pathlib import Path
from plushsense.core.layouts import load_layout
from plushsense.devices.opening import open_device
from plushsense.recording.recorder import Recorder
from plushsense.recording.recorder import AutoRecording
from plushsense.recording.plan import load_protocol
from plushsense.recording.writer import SessionHead

head = SessionHead("S01", "1", 5, load_layout("plush-15").to_dict(), load_protocol("quick").to_dict(), simulated=True)
before = resource.getrlimit(resource.RLIMIT_NOFILE)
waits, refused, news = threading.Event(), [], []

def listener(what, status):
    news.append(what)
    if what == "recording" and not refused:
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
        try:
            open(os.devnull)
        except OSError as cause:
            refused.append(cause.errno)
    elif what == "message" and "Too many files are open" in status.message:
        waits.set()

with open_device(sys.argv[2]) as toy:
    folder = Path(sys.argv[1])
    with Recorder.open(folder, toy, head, speed=float(sys.argv[3]), auto=AutoRecording(1.0, 0.2)) as recorder:
        recorder.subscribe(listener)
        waited = waits.wait(60)
        state = recorder.status().state
        if sys.argv[4] == "passes":
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            recorder.wait("finished", timeout_s=60)
    status = recorder.status()
    resource.setrlimit(resource.RLIMIT_NOFILE, before)
said = {"waited": waited, "refused": refused == [errno.EMFILE], "saving": state, "done": status.done}
print(json.dumps(said | {"failed": status.failed, "rows": status.rows, "finished": "finished" in news}))
"""


def without_descriptors(folder: Path, until: str) -> dict[str, Any]:
    words = [sys.executable, "-c", NO_DESCRIPTOR, str(folder), URL, str(SPEED), until]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    said: dict[str, Any] = json.loads(done.stdout)
    assert (said["waited"], said["refused"], said["saving"]) == (True, True, "saving"), said
    stream = (folder / STREAM_NAME).read_text().splitlines()
    assert len(stream) == said["rows"]
    files = sorted(folder.glob("* *_*.csv"))
    assert len(files) == said["done"]
    for path in files:
        beside = json.loads(path.with_suffix(".json").read_text())
        lines = path.read_text().splitlines()[1:]
        assert lines == stream[beside["stream_row"] : beside["stream_row"] + len(lines)]
    assert not [p for p in folder.iterdir() if p.name.endswith((".part", ".new"))]
    return said


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on open files")
def test_a_recording_is_saved_when_a_file_descriptor_is_free_again(tmp_path: Path) -> None:
    said = without_descriptors(tmp_path, "passes")
    assert (said["done"], said["failed"], said["finished"]) == (4, "", True)
    assert whats(tmp_path).count("take") == 4


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on open files")
def test_a_session_can_be_closed_while_no_file_descriptor_is_free(tmp_path: Path) -> None:
    said = without_descriptors(tmp_path, "stays")
    assert said["done"] == 0
    assert "close other programs, and continue the same session" in said["failed"]


def test_a_toy_is_exchanged_within_the_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with recorder(tmp_path) as r, open_device(URL + "&person=9") as other, open_device(URL) as third:
        former = r.device
        r.space()
        assert r.wait("recording", timeout_s=20)
        with pytest.raises(ConfigError, match="between two recordings"):
            r.exchange(other)
        until(lambda: r.status().elapsed_s > 1)
        r.space()
        assert r.wait("idle", timeout_s=20)
        r.pause()
        assert r.exchange(other) is former
        former.close()
        until(lambda: r.status().signal != "none")
        assert (r.status().state, r.status().done, r.status().message) == (
            "paused",
            1,
            "The session goes on with another toy.",
        )
        r.mark()
        # The data of this toy end, and the session goes on with a third one.
        monkeypatch.setattr(other, "read", lambda: None)
        assert r.wait("stopped", timeout_s=20)
        assert r.status().message == "The toy's data have ended."
        r.exchange(third)
        r.resume()
        until(lambda: r.status().signal != "none")
        assert (r.status().state, r.status().done) == ("idle", 1)
        r.space()
        assert r.wait("recording", timeout_s=20)
        until(lambda: r.status().elapsed_s > 1)
        r.space()
        assert r.wait("idle", timeout_s=20)
    events = list(read_events(tmp_path))
    exchanges = [e.details for e in events if e.kind == "exchange"]
    assert [e["device"] for e in exchanges] == [other.url, URL]
    stream = read_stream(tmp_path / STREAM_NAME, LAYOUT).frames
    assert len(stream) == next(e.details["rows"] for e in events if e.kind == "close")
    assert {e.details["after_row"] for e in events if e.kind == "gap"} >= {e["row"] for e in exchanges}
    mark = next(e.details for e in events if e.kind == "mark")
    assert mark["device_ms"] in stream.device_ms and mark["host_ms"] <= now_ms()
    assert [e.details["gesture"] for e in events if e.kind == "take"] == ["Back stroke 1", "Head stroke 1"]
