"""The virtual toy in this process (``virtual://``), with the same bytes and the same parser as a real one."""

from __future__ import annotations

import time
from collections.abc import Callable

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import Layout
from plushsense.devices.base import Device, Frame, Pacer, now_ms
from plushsense.devices.opening import DeviceAddress
from plushsense.devices.virtual.stream import PerformedGesture, Prompt, Prompts, ToyLine, ToySpec, ToyStream
from plushsense.devices.wire import LineParser

_BLOCK = 200


class VirtualDevice(Device):
    """A virtual toy. ``performed`` lists the gestures that its person made; ``on_performed`` is called with each.

    Args:
        speed: 1 real time, 0 as fast as frames are taken.
        seconds: of device time after which the frames end; 0: never.
    """

    def __init__(self, url: str, layout: Layout, spec: ToySpec, speed: float = 1.0, seconds: float = 0.0) -> None:
        super().__init__(url, layout)
        self.spec = spec
        self.performed: list[PerformedGesture] = []
        self.on_performed: Callable[[PerformedGesture], None] | None = None
        self._stream = ToyStream(spec, layout)
        self._lines = iter(self._stream)
        self._prompt: Prompt | None = None
        self._parser = LineParser(layout, self.counters)
        self._pacer = Pacer(speed)
        self._seconds = seconds
        self._first_ms: int | None = None
        self._next: ToyLine | None = None
        self._due = 0.0

    @property
    def first_ms(self) -> int | None:
        """The device clock at the first line, from which a live run counts its times; None before it."""
        return self._first_ms

    def play_ahead(self) -> None:
        """Compute all lines now, so that reading is as fast as with a real toy. It needs ``seconds``.

        Raises:
            ConfigError: for a toy without an end.
        """
        if not self._seconds:
            raise ConfigError(f"'{self.url}' has no end to play ahead to: give it seconds=.")
        lines: list[ToyLine] = []
        for line in self._lines:
            lines.append(line)
            if line.device_ms - lines[0].device_ms >= self._seconds * 1000.0:
                break
        self._lines = iter(lines)

    def follow(self, prompts: Prompts | None = None) -> None:
        """Make the person do only what ``prompts`` or `perform` ask for; call it before the first `read`."""
        self._stream.prompts = prompts or self._next_prompt

    def perform(self, label: str, begin_ms: int | None = None) -> None:
        """Make the person perform a gesture that begins when the toy's clock is ``begin_ms``."""
        self._prompt = Prompt(label, begin_ms)

    def _next_prompt(self) -> Prompt | None:
        prompt, self._prompt = self._prompt, None
        return prompt

    def read(self) -> list[Frame] | None:
        """Return the frames that are due, waiting at most about ``wait_s``; return None after ``seconds``."""
        until = time.monotonic() + self.wait_s
        data = bytearray()
        count = 0
        while count < _BLOCK and not self.closed:
            if self._next is None:
                self._next = next(self._lines)
                self._due = time.monotonic() + self._pacer.due_s(self._next.device_ms)
            line = self._next
            if self._first_ms is None:
                self._first_ms = line.device_ms
            if self._seconds and line.device_ms - self._first_ms >= self._seconds * 1000.0:
                if not data:
                    self._parser.finish()
                    return None
                break
            wait = self._due - time.monotonic()
            if wait > 0.0:
                if data:
                    break
                time.sleep(min(wait, max(0.0, until - time.monotonic())))
                if time.monotonic() >= until:
                    break
                continue
            self._next = None
            if not data:
                self.arrived_s = time.perf_counter() + wait
            count += 1
            data += line.data
            if line.begins is not None:
                self.performed.append(line.begins)
                if self.on_performed is not None:
                    self.on_performed(line.begins)
        host = now_ms()
        return [Frame(host, p.device_ms, p.values) for p in self._parser.feed(bytes(data))]


def open_virtual(address: DeviceAddress, layout: Layout) -> VirtualDevice:
    """Open ``virtual://?person=7&seed=1&speed=1``; also session, lost, garbled, glitch, seconds,
    gestures (with commas).
    """
    address.check_keys(("person", "seed", "session", "speed", "lost", "garbled", "glitch", "seconds", "gestures"))
    text = address.query.get("gestures", "")
    spec = ToySpec(
        person=address.whole("person", 1),
        seed=address.whole("seed", 1),
        session=address.whole("session", 1000),
        lost=address.number("lost", 0.0, 0.0, 0.9) if "lost" in address.query else None,
        garbled=address.number("garbled", 0.0, 0.0, 0.9) if "garbled" in address.query else None,
        glitch=address.number("glitch", 0.0, 0.0, 0.9) if "glitch" in address.query else None,
        gestures=tuple(g.strip() for g in text.split(",") if g.strip()),
    )
    return VirtualDevice(
        address.url, layout, spec, address.number("speed", 1.0), address.number("seconds", 0.0, 0.0, 1e9)
    )
