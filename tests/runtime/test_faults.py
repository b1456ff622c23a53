"""Bad input: the state says what is wrong, nothing is begun because of it, and all is well again by itself."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import Decision
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from support.troubles import BAD, events_of, knowing_bundle, lived, reader_of, toy_frames

pytestmark = pytest.mark.slow

GATE = GateSettings((Signal(JERK, (0, 1, 2), lag=2, floor=20),), (Rule((Term(0, 160),), 3, 255, deaf=100),))
HEALTH = HealthSettings((-1200, -1200, -1200), (1200, 1200, 1500), still_ms=400)
SAFE = DecideSpec(smoothing_s=0.1, gate=GATE, health=HEALTH)
TOUCHES = "rest stroke rest hit rest hit rest"
MAXIMUM = 32_767  # of a sensor at its end stop: valid, and beyond what people reach


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return knowing_bundle()


def stream(values: np.ndarray, step_ms: int = 10) -> Frames:
    return Frames(values, 1000 + step_ms * np.arange(len(values)), None)


def begun(decisions: list[Decision]) -> list[tuple[Any, ...]]:
    """(seconds, affect, source) of every event."""
    return [(e.t_s, e.affect, e.source) for d in decisions for e in d.events if e.kind == "begun"]


def spoil(values: np.ndarray, kind: str, first: int, last: int) -> None:
    """Rows first to last of what the sensors say become wrong, in place."""
    if kind == "maximum":
        values[first:last, 1] = MAXIMUM
    elif kind == "minimum":
        values[first:last, 0] = -MAXIMUM
    elif kind == "out of range":
        values[first:last, 2] = BAD
    elif kind == "here and there out of range":
        rows = np.arange(first, last)
        values[rows, rows % 3] = BAD
    elif kind == "hung":
        values[first:last] = values[first]


KINDS = ("maximum", "minimum", "out of range", "here and there out of range", "hung")


def test_without_trouble_the_touches_are_known(bundle: Bundle) -> None:
    for engine in ("float", "int8"):
        found = lived(reader_of(bundle, SAFE, engine), stream(toy_frames(TOUCHES)))
        assert [affect for _, affect, _ in begun(found)] == ["positive", "negative", "negative"]
        assert begun(found)[1][2] == "gate"
        assert {d.state for d in found[:-1]} == {"warming", "tracking"}
        # The network names what the gate began: one event, not two.
        of_gate = [e[0] for e in events_of(found) if e[1] == 2]
        assert of_gate == ["begun", "named", "ended"]


@pytest.fixture(scope="module")
def untroubled(bundle: Bundle) -> dict[str, list[tuple[Any, ...]]]:
    """What begins without trouble, for each engine."""
    clean = toy_frames(TOUCHES)
    return {engine: begun(lived(reader_of(bundle, SAFE, engine), stream(clean))) for engine in ("float", "int8")}


@pytest.mark.parametrize("engine", ["float", "int8"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("when", ["from the start", "in a stroke", "in a blow", "while idle"])
def test_a_sensor_that_fails(
    bundle: Bundle, untroubled: dict[str, list[tuple[Any, ...]]], engine: str, kind: str, when: str
) -> None:
    for phase in range(5):  # of the fault in a step
        first = {"from the start": 0, "in a stroke": 300, "in a blow": 700, "while idle": 550}[when]
        first += phase if first else 0
        last = 930 + phase
        values = toy_frames(TOUCHES)
        spoil(values, kind, first, last)
        found = lived(reader_of(bundle, SAFE, engine), stream(values))
        faults = [d for d in found if d.state == "sensor fault"]
        assert len(faults) == 1
        onset, recovered = first / 100, last / 100
        assert onset + 0.35 <= faults[0].t_s <= onset + 0.55
        # Before it, all as ever; from then until all is well again, nothing begins.
        times = [entry for entry in begun(found) if entry[0] < recovered + 0.3]
        assert times == [entry for entry in untroubled[engine] if entry[0] < onset]
        ends = [e for d in found for e in d.events if e.kind == "ended" and onset <= e.t_s <= faults[0].t_s + 1e-9]
        assert len(ends) == (when in ("in a stroke", "in a blow")), "what was going on ended"
        # It recovers by itself: 0.3 s of good frames, the span again, and then the next blow is felt.
        after = [d for d in found if d.t_s > faults[0].t_s][:-1]
        assert after[0].state == "warming" and recovered + 0.29 <= after[0].t_s <= recovered + 0.36
        assert all(d.state == "tracking" for d in after[12:])
        assert next((affect, by) for t, affect, by in begun(found) if t > recovered) == ("negative", "gate")


def test_without_limits_the_same_would_be_a_false_reaction(bundle: Bundle) -> None:
    """That the tests above are worth something."""
    values = toy_frames("rest rest rest")
    spoil(values, "maximum", 300, 450)
    spec = DecideSpec(smoothing_s=0.1, health=HealthSettings(fault_ms=0))
    assert begun(lived(reader_of(bundle, spec, "float"), stream(values))) != []
    assert begun(lived(reader_of(bundle, SAFE, "float"), stream(values))) == []


def test_a_clock_that_runs_backwards(bundle: Bundle) -> None:
    values = toy_frames(TOUCHES)
    frames = stream(values)
    frames.device_ms[400:560] = frames.device_ms[400:560][::-1]
    found = lived(reader_of(bundle, SAFE, "int8"), frames)
    wrong = [d for d in found if 4.05 < d.t_s < 5.6]
    assert "no signal" in {d.state for d in wrong} and {d.state for d in wrong} <= {"no signal", "warming"}
    assert not begun(wrong)
    assert [d.t_s for d in found] == sorted(d.t_s for d in found)
    assert [affect for _, affect, _ in begun(found)] == ["positive", "negative", "negative"]
    assert found[-2].state == "tracking"


def test_ten_seconds_of_nothing_and_a_clock_reset(bundle: Bundle) -> None:
    for jump in (10_000, -5_000):
        values = toy_frames("rest hit hit rest hit rest")
        frames = stream(values)
        frames.device_ms[300:] += jump
        found = lived(reader_of(bundle, SAFE, "float"), frames)
        lost = [d for d in found[:-1] if d.state == "no signal"]
        assert [round(d.t_s, 3) for d in lost] == [2.99], "the time of the last frame before"
        assert [e.kind for e in lost[0].events] == ["ended"]
        at = found.index(lost[0])
        assert [d.state for d in found[at + 1 : at + 10]] == ["warming"] * 9
        assert found[at + 11].state == "tracking"
        assert begun(found)[-1][1] == "negative"


# The loop, over real bytes and the host's time


@contextmanager
def toy(play: Callable[[Callable[[bytes], None]], None]) -> Iterator[str]:
    """A toy on a socket that does what ``play(send)`` does, then closes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer:
                play(peer.sendall)

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}?layout=accel-3"
        thread.join()


def lines(values: np.ndarray, begin_ms: int) -> bytes:
    return b"".join(b"%d %d %d %d\n" % (begin_ms + 10 * i, *row) for i, row in enumerate(values.tolist()))


@pytest.mark.parametrize("what", ["silence", "noise", "half lines"])
def test_a_toy_that_says_nothing_that_is_a_frame_has_no_signal(bundle: Bundle, what: str) -> None:
    values = toy_frames("rest stroke rest hit rest")
    noise = {"silence": b"", "noise": b"\xff\x00 12 hello\r\n", "half lines": b"12 -4\n"}[what]

    def play(send: Callable[[bytes], None]) -> None:
        send(lines(values[:300], 0))  # in the middle of the stroke
        for _ in range(30):
            send(noise)
            time.sleep(0.02)
        send(lines(values[300:], 3600))

    with toy(play) as url, open_device(url) as device:
        live = run_live(device, reader_of(bundle, SAFE, "int8"), silence_s=0.3)
        found = list(live)
    lost = [d for d in found if d.state in ("no signal", "unreadable")]
    assert [e.kind for d in lost for e in d.events] == ["ended"]
    assert lost[-1].state == ("no signal" if what == "silence" else "unreadable")
    assert lost[0].t_s == pytest.approx(2.99)
    assert (live.summary().no_signal, live.summary().faults) == (1, 0)
    assert [affect for _, affect, _ in begun(found)] == ["positive", "positive", "negative"], "the stroke goes on"
    assert found[-1].state == "tracking"
    assert (live.summary().counters["malformed"] > 10) == (what != "silence")


def test_a_toy_that_never_says_a_word_has_no_signal_and_one_in_a_fault_says_so_again(bundle: Bundle) -> None:
    values = toy_frames("rest rest")
    values[:, 0] = BAD

    def play(send: Callable[[bytes], None]) -> None:
        time.sleep(0.4)
        send(lines(values[:200], 0))
        time.sleep(0.4)
        send(lines(values[200:], 2000))

    with toy(play) as url, open_device(url) as device:
        found = list(run_live(device, reader_of(bundle, SAFE, "float"), silence_s=0.2))
    assert [d.state for d in found] == ["no signal", "sensor fault", "no signal", "sensor fault"]
    assert not begun(found)


def test_a_replay_that_does_not_wait_is_never_silent(bundle: Bundle, tmp_path: Path) -> None:
    path = tmp_path / "stroke_1700000000000_1400.csv"
    write_recording(path, with_host(toy_frames(TOUCHES)), load_layout("accel-3"))
    with open_device(f"replay://{path.as_posix()}?speed=0&layout=accel-3") as device:
        live = run_live(device, reader_of(bundle, SAFE, "float"), silence_s=0.05)
        found = []
        for decision in live:
            found.append(decision)
            time.sleep(0.1 if len(found) == 5 else 0)  # whoever listens may be slow
    assert "no signal" not in {d.state for d in found}


def with_host(values: np.ndarray) -> Frames:
    times = 1000 + 10 * np.arange(len(values))
    return Frames(values, times, times + 1_700_000_000_000)
