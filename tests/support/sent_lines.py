"""Lines as a toy sends them, and a toy whose lines arrive one at a time, without waiting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from plushsense.core.layouts import DELAY_MS, DEVICE_MS, Layout, load_layout
from plushsense.devices.bytestreams import LineDevice, Link


class LinesLink(Link):
    """Hands over a line a call, then ends."""

    def __init__(self, lines: Iterable[bytes]) -> None:
        super().__init__("tcp://lines")
        self._lines = iter(lines)

    def receive(self, wait_s: float) -> bytes | None:
        return next(self._lines, None)

    def send(self, data: bytes) -> None:
        raise NotImplementedError

    def close(self) -> None:
        pass


def toy_of_lines(lines: Iterable[bytes]) -> LineDevice:
    """Return a toy with the layout accel-3 that sends these lines."""
    return LineDevice("tcp://lines", load_layout("accel-3"), LinesLink(lines), joining=False)


DAMAGED = [b"%d 1 2 %s\n" % (10 * k, b"1F" if k % 3 == 2 else b"3") for k in range(301)]
"""Lines of which every third cannot be read."""
NAMED = [b"ms:%d,X:1,Y:2,Z:3\r\n" % (10 * k) for k in range(60)]
"""Lines as the plotter of the Arduino IDE reads them."""


def format_line(layout: Layout, values: Sequence[int], device_ms: int, delay_ms: int) -> bytes:
    """Format a frame as the toy sends it, with a line feed; ``values`` (C,) are in integer steps, in layout order."""
    fields = []
    for name in layout.wire:
        if name == DEVICE_MS:
            fields.append(str(device_ms))
        elif name == DELAY_MS:
            fields.append(str(delay_ms))
        else:
            at = layout.names.index(name)
            step = layout.channels[at].step
            fields.append(str(int(values[at])) if step == 1.0 else repr(round(values[at] * step, 9)))
    return (" ".join(fields) + "\n").encode("ascii")
