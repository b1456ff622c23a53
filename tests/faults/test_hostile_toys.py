"""Toys that flood, hang up, jump in time or never end a line: every whole frame is recorded once, and live is right."""

from __future__ import annotations

import random
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, read_stream
from plushsense.devices.base import Frame
from plushsense.devices.opening import open_device
from plushsense.live.loop import run_live
from plushsense.models.bundle import Bundle
from plushsense.recording.recorder import Recorder
from plushsense.recording.session import SessionRequest, session_head
from plushsense.runtime.classifier import StreamClassifier
from support.bundles import odd_bundle
from support.drills import REPETITIONS

PLUSH = load_layout("plush-15")
HANG_UP = b""
WRAP = 1 << 32
PATIENCE_S = 120.0


def values(number: int) -> tuple[int, ...]:
    """What the sensors of frame ``number`` show."""
    return tuple(int(v) for v in np.random.default_rng(number).integers(0, 9000, PLUSH.n_channels))


def clock(frames: int, start: int = 1000) -> list[int]:
    return [start + 10 * n for n in range(frames)]


def line(number: int, device_ms: int) -> bytes:
    return (" ".join(map(str, (*values(number), device_ms, 10))) + "\n").encode()


# The clocks of the frames, and what is sent after the frame of each number.
TOYS: dict[str, tuple[list[int], dict[int, bytes]]] = {
    "floods: ten minutes at once": (clock(60_000 if REPETITIONS > 1 else 3000), {}),
    "sends 10 MB without a line end": (clock(600), {300: b"7 " * 5_000_000 + b"\n"}),
    "sends 10 MB of bytes that are no text": (clock(600), {300: random.Random(3).randbytes(10_000_000) + b"\n"}),
    "hangs up every second": (clock(400), {100: HANG_UP, 200: HANG_UP, 300: HANG_UP}),
    "jumps an hour ahead": (clock(300) + clock(300, 3_604_000), {}),
    "jumps back to its start": (clock(300) + clock(300, 0), {}),
    "has single frames with impossible times": (
        [{200: 0, 400: 3_604_000}.get(n, t) for n, t in enumerate(clock(600))],
        {},
    ),
    "passes 2^32 ms after 49.7 days": ([ms % WRAP for ms in clock(600, WRAP - 3000)], {}),
    "stands still for a second": (clock(300) + [3990] * 100 + clock(300, 4000), {}),
}
BREAKS = {"jumps an hour ahead": 1, "jumps back to its start": 1, "passes 2^32 ms after 49.7 days": 1}


@contextmanager
def serving(clocks: Sequence[int], after: dict[int, bytes]) -> Iterator[str]:
    """The toy's URL; each connection begins in the middle of a line, as after a loose cable."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection = server.accept()[0]
            connection.sendall(b"3 4 5\n")
            for number, device_ms in enumerate(clocks):
                connection.sendall(line(number, device_ms))
                if after.get(number) == HANG_UP:
                    connection.close()
                    connection = server.accept()[0]
                    connection.sendall(b"8 10\n")
                elif number in after:
                    connection.sendall(after[number])
            ended.wait(PATIENCE_S)
            connection.close()

        ended = threading.Event()
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        finally:
            ended.set()
            thread.join(PATIENCE_S)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    return Bundle.load(odd_bundle(tmp_path_factory.mktemp("bundle") / "m.plush"))


@pytest.mark.parametrize("toy", TOYS)
def test_every_frame_is_recorded_once_and_classified_as_alone(toy: str, bundle: Bundle, tmp_path: Path) -> None:
    clocks, after = TOYS[toy]
    until = time.monotonic() + PATIENCE_S
    folder = tmp_path / "S01" / "1"
    with serving(clocks, after) as url, open_device(url, reconnect=True) as device:
        head = session_head(SessionRequest(url, subject="S01"), folder, True, PLUSH, "test")
        with Recorder.open(folder, device, head) as recorder:
            while recorder.status().rows < len(clocks) and time.monotonic() < until:
                recorder.wait(timeout_s=0.05)
    frames = read_stream(folder / STREAM_NAME, PLUSH).frames
    assert frames.device_ms.tolist() == clocks
    assert [tuple(row) for row in frames.values.tolist()] == [values(n) for n in range(len(clocks))]

    alone = StreamClassifier(bundle)
    wanted = [d for n, ms in enumerate(clocks) for d in alone.push(Frame(0, ms, values(n)))]
    classifier = StreamClassifier(bundle)
    with serving(clocks, after) as url, open_device(url, reconnect=True) as device:
        run, decisions = run_live(device, classifier, silence_s=PATIENCE_S), []
        while device.counters.frames < len(clocks) and time.monotonic() < until:
            decisions += run.poll()
    assert decisions == wanted
    assert classifier.restarts == BREAKS.get(toy, 0)
    assert device.counters.reconnects == sum(piece == HANG_UP for piece in after.values())
