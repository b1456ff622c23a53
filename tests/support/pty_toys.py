"""A virtual toy on a pseudo terminal that keeps what it sent, and whether a session's recordings are just that."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, parse_name, read_recording, read_stream
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import LogPrompts, PerformedGesture, ToySpec

LAYOUT = load_layout("plush-15")
QUIET = ToySpec(person=7, lost=0.0, garbled=0.0, glitch=0.0)
"""A toy whose line loses nothing: what is missing then was lost by the recorder."""


@dataclass
class Toy:
    """A toy that runs in a thread: its URL, the bytes it sent, and what its person did."""

    url: str = ""
    pieces: list[bytes] = field(default_factory=list)
    performed: list[PerformedGesture] = field(default_factory=list)
    readers: list[subprocess.Popen[str]] = field(default_factory=list)

    @property
    def last_ms(self) -> int:
        """The toy's clock at the last line that it sent."""
        return int(self.pieces[-1].split(b"\n")[-2].split()[-2])

    def sent(self) -> dict[int, tuple[int, ...]]:
        """The values that were sent, by the toy's clock."""
        rows = [tuple(map(int, line.split())) for line in b"".join(self.pieces).splitlines()]
        return {row[-2]: row[:-2] for row in rows}


@contextmanager
def pty_toy(log: Path, speed: float, spec: ToySpec = QUIET) -> Iterator[Toy]:
    """A toy on a pseudo terminal whose person does what the session in ``log`` asks for."""
    toy, ready, stop = Toy(), threading.Event(), threading.Event()

    def on_ready(url: str) -> None:
        toy.url = url
        ready.set()

    def work() -> None:
        ToyServer(
            spec, speed=speed, on_ready=on_ready, on_sent=toy.pieces.append, on_performed=toy.performed.append,
            prompts=LogPrompts(log), stop=stop,
        ).serve_pty()  # fmt: skip

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    assert ready.wait(5)
    try:
        yield toy
    finally:
        # One that a failed test leaves would wait for its port, and take the next toy's.
        for reader in toy.readers:
            reader.kill()
            reader.wait(10)
        stop.set()
        thread.join(15)
        assert not thread.is_alive()


def recordings(folder: Path) -> list[Path]:
    """The finished recordings of a session."""
    return sorted(p for p in folder.glob("*.csv") if parse_name(p.name) is not None)


def check_whole(folder: Path, toy: Toy) -> int:
    """Every recording is whole, as its name and sidecar say, and is exactly what the toy sent and the stream holds.

    Returns how many there are.
    """
    sent = toy.sent()
    clocks = sorted(sent)
    at = {clock: n for n, clock in enumerate(clocks)}
    stream = (folder / STREAM_NAME).read_text(encoding="utf-8").splitlines()
    for path in recordings(folder):
        lines = path.read_text(encoding="utf-8").splitlines()
        name, beside = parse_name(path.name), json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        assert name is not None
        assert name.rows == len(lines) - 1 == beside["rows"]
        row = beside["stream_row"]
        assert lines[1:] == stream[row : row + name.rows]
        frames = read_recording(path, LAYOUT).frames
        first = at[int(frames.device_ms[0])]
        assert frames.device_ms.tolist() == clocks[first : first + name.rows]
        assert [tuple(v) for v in frames.values.tolist()] == [sent[c] for c in frames.device_ms.tolist()]
        assert (beside["lost"], beside["malformed"], beside["gaps"]) == (0, 0, [])
    whole = read_stream(folder / STREAM_NAME, LAYOUT)
    assert whole.malformed == 0
    assert whole.warnings == []
    for clock, values in zip(whole.frames.device_ms.tolist(), whole.frames.values.tolist(), strict=True):
        assert sent[clock] == tuple(values)
    return len(recordings(folder))
