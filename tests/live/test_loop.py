"""A device and a model together: what comes out, when it stops, what is counted."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from tests.support.sent_lines import DAMAGED, toy_of_lines

from plushsense.core.errors import ConfigError, PlushSenseWarning
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.devices.base import Device, Frame
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.runtime.classifier import StreamClassifier


@pytest.fixture()
def recording(tmp_path, frames):
    """A recording of 400 rows with gaps, a clock reset and garbage, as a URL."""
    path = tmp_path / "tap_1700000000000_400.csv"
    write_recording(path, frames(), load_layout("accel-3"))
    return f"replay://{path.as_posix()}?speed=0&layout=accel-3"


def test_a_replay_gives_what_pushing_its_frames_gives(bundle, recording):
    classifier = StreamClassifier(bundle())
    with open_device(recording) as device:
        wanted = [d for frame in device for d in classifier.push(frame)]
    assert classifier.in_event, "at the end of the file"
    wanted.append(classifier.silence())
    with open_device(recording) as device:
        live = run_live(device, classifier)
        assert live.latency_s is None
        assert list(live) == wanted
        assert live.latency_s in live.latencies_s
        summary = live.summary()
    assert summary.decisions == len(wanted) > 80
    assert summary.warming == sum(d.state == "warming" for d in wanted)
    assert summary.restarts == 2
    assert summary.invalid == 14
    assert summary.counters["frames"] == 400
    assert summary.counters["garbage"] == 14
    assert summary.seconds == pytest.approx(wanted[-1].t_s, abs=0.06)
    assert summary.decisions_per_s == pytest.approx(len(wanted) / summary.seconds)
    assert 0 < summary.latency_ms["p50"] <= summary.latency_ms["p95"] <= summary.latency_ms["p99"]
    assert summary.events == sum(e.kind == "begun" for d in wanted for e in d.events) > 0
    assert (summary.no_signal, summary.faults) == (3, 0)
    assert [e.kind for e in wanted[-1].events] == ["ended"]
    assert summary.to_dict()["counters"] == summary.counters


def test_a_slow_toy_is_seen_from_the_summary(bundle, tmp_path):
    """A frame of every 40 ms instead of 10: three of four samples are made up. One stamp goes back, one repeats."""
    clock = np.arange(310) * 40
    clock[[90, 100]] = clock[[89, 99]] - [1, 0]
    values = np.random.default_rng(1).integers(-900, 900, (310, 3))
    slow = Frames(values, clock, 1_700_000_000_000 + clock)
    write_recording(tmp_path / "tap_1700000000000_310.csv", slow, load_layout("accel-3"))
    warnings = []
    with open_device(f"replay://{tmp_path}/tap_1700000000000_310.csv?speed=0&layout=accel-3") as device:
        live = run_live(device, StreamClassifier(bundle()), warn=warnings.append)
        assert live.summary().rate_hz is None
        list(live)
        summary = live.summary()
    assert (summary.rate_hz, summary.bad_stamps) == (pytest.approx(25, abs=0.5), 2)
    assert summary.interpolated == pytest.approx(3 * 309, abs=10)
    assert warnings[0].startswith("The toy sends 25 frames a second by its clock, but the model reads 100")


def test_it_stops_by_device_time_and_begins_anew(bundle, recording):
    classifier = StreamClassifier(bundle())
    for _ in range(2):
        with open_device(recording) as device:
            times = [d.t_s for d in run_live(device, classifier, seconds=1.5)]
        assert 1.4 < times[-1] < 1.5


@pytest.mark.parametrize("seconds", [0, -1, float("nan")])
def test_a_duration_is_positive(bundle, recording, seconds):
    with open_device(recording) as device, pytest.raises(ConfigError, match="seconds"):
        run_live(device, StreamClassifier(bundle()), seconds=seconds)


def test_another_layout_is_refused_before_anything_is_read(bundle, recording):
    with open_device(recording) as device:
        with pytest.raises(ConfigError, match=r"'accel-3'.*'plush-15'"):
            run_live(device, StreamClassifier(bundle(layout="plush-15")))
        assert device.counters.frames == 0


def test_lost_and_garbled_lines_are_counted_and_survived(bundle):
    lines = []
    for i in range(300):
        if i in (150, 151):
            continue
        lines.append(
            b"hello toy\r\n" if i == 100 else b"%d %d %d %d\r\n" % (i * 10, i % 60, 40_000 if i == 200 else 5, -i)
        )
    lines.insert(60, b"12 1\n\xff\xfe\x00 7 7 7\n")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            peer, _ = server.accept()
            with peer:
                for line in lines:
                    peer.sendall(line)

        thread = threading.Thread(target=serve)
        thread.start()
        classifier = StreamClassifier(bundle())
        with open_device(f"tcp://127.0.0.1:{server.getsockname()[1]}?layout=accel-3") as device:
            live = run_live(device, classifier)
            found = list(live)
        thread.join()
    summary = live.summary()
    assert len([d for d in found if d.state != "no signal"]) == 300 // 5
    assert summary.counters["malformed"] == 3
    assert summary.counters["lost"] == 3
    assert summary.counters["garbage"] == summary.invalid == 1
    assert summary.restarts == 0
    assert [d.state for d in found if d.state != "no signal"][-1] == "tracking"


class Silent(Device):
    """A toy that says one thing and then nothing."""

    def read(self):
        time.sleep(0.01)
        first = not self.counters.frames
        self.counters.frames = 1
        return [Frame(0, 0, (0, 0, 0))] if first else []


def test_a_silent_toy_ends_a_run_of_given_length(bundle):
    model = bundle()
    live = run_live(Silent("silent://", model.layout), StreamClassifier(model), seconds=0.1)
    began = time.perf_counter()
    assert not list(live)
    assert time.perf_counter() - began < 2
    assert live.summary().latency_ms == {"p50": None, "p95": None, "p99": None}
    assert live.summary().decisions_per_s == 0


def test_closing_the_device_ends_the_run(bundle):
    model = bundle()
    device = Silent("silent://", model.layout)
    threading.Timer(0.05, device.close).start()
    assert not list(run_live(device, StreamClassifier(model)))


@contextmanager
def talking(*pieces: bytes, pause_s: float = 0.0) -> Iterator[str]:
    """A toy that sends these bytes to whoever connects, with pauses between them, and hangs up."""
    server = socket.create_server(("127.0.0.1", 0))

    def talk() -> None:
        connection, _ = server.accept()
        with connection:
            for piece in pieces:
                connection.sendall(piece)
                time.sleep(pause_s)

    thread = threading.Thread(target=talk, daemon=True)
    thread.start()
    yield f"tcp://127.0.0.1:{server.getsockname()[1]}?layout=accel-3"
    thread.join(10)
    server.close()


NAMED = b"ms:0,X:1,Y:2,Z:3\r\n"


@pytest.mark.parametrize("pieces", [(NAMED * 40, b""), (b"", NAMED * 40, b""), (NAMED,)])
def test_unreadable_lines_are_quoted_also_after_a_silence_and_at_the_end(bundle, pieces):
    warned: list[str] = []
    with talking(*pieces, pause_s=0.3 if len(pieces) > 1 else 0.0) as url, open_device(url) as device:
        live = run_live(device, StreamClassifier(bundle()), silence_s=0.1, warn=warned.append)
        states = [d.state for d in live]
    assert states[-1] == "unreadable" and states in (["unreadable"], ["no signal", "unreadable"])
    assert len(warned) == 1 and "the first is 'ms:0,X:1,Y:2,Z:3': it has names before the numbers" in warned[0]
    assert live.summary().no_signal == 1


def test_frames_after_the_messages_of_a_board_that_starts(bundle):
    frames = b"".join(b"%d 1 2 3\n" % (10 * k) for k in range(60))
    with talking(b"rst: power on\nready\n", frames) as url, open_device(url) as device:
        live = run_live(device, StreamClassifier(bundle()), silence_s=5.0, warn=pytest.fail)
        assert {d.state for d in live} >= {"warming", "tracking"}
    assert live.summary().counters["malformed"] == 2


def test_many_damaged_lines_among_frames_are_reported_once(bundle):
    warned: list[str] = []
    with toy_of_lines(DAMAGED) as device:
        live = run_live(device, StreamClassifier(bundle()), silence_s=5.0, warn=warned.append)
        assert "unreadable" not in {d.state for d in live}
    assert len(warned) == 1 and "lines of the toy cannot be read, such as" in warned[0] and "'1F' for z" in warned[0]
    with toy_of_lines(DAMAGED) as device, pytest.warns(PlushSenseWarning) as issued:
        assert sum(1 for _ in device) == 201
    assert len(issued) == 1
