"""A toy's frames out to the lab streaming layer, where LabRecorder and every other LSL program can take them."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.signal import DEVICE_MS, Layout, load_layout
from plushsense.devices.base import Device, Frame
from plushsense.devices.lsl import load_pylsl, name_url
from plushsense.devices.toy import ToyCounters
from plushsense.devices.virtual.cues import Cues
from plushsense.devices.virtual.device import VirtualDevice
from plushsense.devices.virtual.stream import Performed, ToySpec

STREAM_TYPE = "Touch"
_DRIFT = 200e-6
_FAR_S = 10.0
_LINGER_S = 0.25
"""A reader gets nothing more of a stream that is gone, not even what has arrived: it is given time to take it."""


class LslOutlet:
    """A published stream: the layout's channels by name, in their units, and ``device_ms``, the toy's own clock.

    Doubles carry every value exactly (integers to 2⁵³). Time stamps are the device clock laid on LSL's: the smallest
    delay seen is taken for the delay, and it may grow by 200 ppm, so that they are even and follow a slow drift.

    Raises:
        ConfigError: for an empty name.
        MissingExtraError: without pylsl.
    """

    def __init__(self, layout: Layout, name: str) -> None:
        if not name.strip():
            raise ConfigError("An LSL stream needs a name.")
        self.layout = layout
        self.name = name
        self._pylsl = pylsl = load_pylsl()
        source = f"plushsense:{socket.gethostname()}:{name}"
        labels = (*layout.names, DEVICE_MS)
        info = pylsl.StreamInfo(name, STREAM_TYPE, len(labels), layout.rate_hz, pylsl.cf_double64, source)
        about = info.desc()
        about.append_child_value("manufacturer", "PlushSense")
        about.append_child_value("layout", layout.name)
        channels = about.append_child("channels")
        units = (*(c.unit or "none" for c in layout.channels), "ms")
        kinds = (*(c.kind for c in layout.channels), "clock")
        for label, unit, kind in zip(labels, units, kinds, strict=True):
            channel = channels.append_child("channel")
            for key, value in (("label", label), ("unit", unit), ("type", kind)):
                channel.append_child_value(key, value)
        self._steps = [c.step for c in layout.channels]
        self._delay_s = 0.0
        self._last_ms: int | None = None
        self._last_stamp = 0.0
        self._outlet: Any = pylsl.StreamOutlet(info)

    @property
    def url(self) -> str:
        """The URL that opens this stream."""
        return name_url(self.name)

    def push(self, frames: Sequence[Frame]) -> None:
        """Publish frames that have just come: the last of them now, those before it when the toy's clock says."""
        now = self._pylsl.local_clock()
        begin = 0
        for end in range(1, len(frames) + 1):
            if end < len(frames) and frames[end].device_ms >= frames[end - 1].device_ms:
                continue
            run, begin = frames[begin:end], end  # up to the end, or to a clock that began anew
            self._meet(run[0].device_ms, run[-1].device_ms, now)
            for frame in run:
                self._last_stamp = max(self._last_stamp, self._delay_s + frame.device_ms / 1000.0)
                values = [
                    float(v) if step == 1.0 else round(v * step, 9)
                    for v, step in zip(frame.values, self._steps, strict=True)
                ]
                self._outlet.push_sample([*values, float(frame.device_ms)], self._last_stamp)

    def _meet(self, first_ms: int, last_ms: int, now: float) -> None:
        """Renew the delay of LSL's clock behind the toy's, from a run of frames whose last came now."""
        delay, before_ms = now - last_ms / 1000.0, self._last_ms
        self._last_ms = last_ms
        if before_ms is None or first_ms < before_ms or delay - self._delay_s > _FAR_S:
            self._delay_s = delay
        else:
            self._delay_s = min(delay, self._delay_s + _DRIFT * (last_ms - before_ms) / 1000.0)

    def close(self) -> None:
        """Withdraw the stream. Closing twice is harmless."""
        if self._outlet is not None and self._outlet.have_consumers():
            time.sleep(_LINGER_S)
        self._outlet = None

    def __enter__(self) -> LslOutlet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def forward(device: Device, outlet: LslOutlet, stop: threading.Event | None = None) -> int:
    """Publish what a device says until it ends or ``stop`` is set; returns the number of frames.

    Raises:
        ConfigError: when the device's channels are not the outlet's.
        DeviceError: when the toy went away (one opened with ``reconnect=True`` is waited for).
    """
    if device.layout.channels != outlet.layout.channels:
        raise ConfigError(
            f"'{device.url}' speaks layout {device.layout.name}, and the stream '{outlet.name}' was made for "
            f"{outlet.layout.name}: make both with the same."
        )
    count = 0
    while not device.closed and not (stop is not None and stop.is_set()):
        frames = device.read()
        if frames is None:
            break
        outlet.push(frames)
        count += len(frames)
    return count


def serve_lsl(
    name: str,
    spec: ToySpec | None = None,
    *,
    layout: Layout | None = None,
    speed: float = 1.0,
    seconds: float = 0.0,
    on_ready: Callable[[str], None] | None = None,
    on_performed: Callable[[Performed], None] | None = None,
    cues: Cues | None = None,
    stop: threading.Event | None = None,
) -> ToyCounters:
    """Publish the virtual toy as an LSL stream until ``stop`` is set; arguments as `toy.serve_tcp`.

    What the toy's line loses or garbles is missing from the stream.

    Raises:
        ConfigError: for a speed of 0: a stream has no reader who would hold it back.
    """
    if not speed > 0.0:
        raise ConfigError(f"The toy's speed on LSL is {speed:g}; it must be above 0.")
    counters = ToyCounters()

    def begun(gesture: Performed) -> None:
        counters.gestures += 1
        if on_performed is not None:
            on_performed(gesture)

    toy = VirtualDevice("virtual://", layout or load_layout("plush-15"), spec or ToySpec(), speed, seconds)
    toy.on_performed = begun
    if cues is not None:
        toy.follow(cues)
    with toy, LslOutlet(toy.layout, name) as outlet:
        if on_ready is not None:
            on_ready(outlet.url)
        counters.sent = forward(toy, outlet, stop)
    return counters
