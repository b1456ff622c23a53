"""Receive and publish frames of toys and other sensors with the lab streaming layer (LSL, with pylsl)."""

from __future__ import annotations

import math
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote, unquote

from plushsense.core.errors import ConfigError, DeviceError, need, python_warning
from plushsense.core.layouts import DEVICE_MS, Layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Device, Frame, LossCounter, now_ms
from plushsense.devices.opening import DeviceAddress, DeviceInfo, DeviceListing

FIND_S = 5.0
KEYS = {"name": "name", "type": "type", "source": "source_id", "uid": "uid"}
"""Search keys of a URL, and the LSL stream property for each."""
_SECOND_S = 1.0
"""Time to search for a second stream: liblsl asks known computers, one by one, only 0.5 s after the multicast."""

_LIMIT = 2**53
_BACK_MS = 1000
_FRACTIONS = 100
_lock = threading.Lock()


def load_pylsl() -> ModuleType:
    """Import pylsl and turn off liblsl's messages on standard error, unless the user has configured liblsl.

    Raises:
        MissingExtraError: if pylsl is not installed.
        DeviceError: if pylsl does not find liblsl.
    """
    with _lock:
        try:
            pylsl = need("pylsl", extra="lsl")
        except RuntimeError as cause:
            raise DeviceError(
                "LSL cannot be used here: {split}.", split=" ".join(str(cause).split()).rstrip(".")
            ) from None
        paths = ("lsl_api.cfg", "~/lsl_api/lsl_api.cfg", "/etc/lsl_api/lsl_api.cfg")
        configured = os.environ.get("LSLAPICFG") or any(Path(p).expanduser().exists() for p in paths)
        if not configured and hasattr(pylsl, "set_config_content") and not hasattr(pylsl, "_plushsense_quiet"):
            pylsl.set_config_content("[log]\nlevel = -3\n")
            pylsl._plushsense_quiet = True  # type: ignore[attr-defined]
        return pylsl


class LslDevice(Device):
    """A device that receives an LSL stream. Reading raises DeviceError when the source is gone.

    ``device_ms`` is the channel of that name, if there is one (the toy's own clock; `LslOutlet` sends it). Else it is
    the LSL time stamp, from the sender's clock, in whole milliseconds. A time stamp up to 1 s earlier than the previous
    one is replaced by that, so that the clock does not go back; a larger step back is a restart. Values are converted
    to integer steps. A sample with a value that is not finite, or is a fraction for a step of 1, counts as malformed.
    A `device_ms` of float32 is not used, since it is exact for less than five hours.
    """

    def __init__(self, url: str, layout: Layout, key: str, value: str, find_s: float = FIND_S) -> None:
        super().__init__(url, layout)
        self._pylsl = load_pylsl()
        self._lock = threading.Lock()
        self._loss = LossCounter()
        self._last_ms: int | None = None
        low, high = layout.valid_min_int.tolist(), layout.valid_max_int.tolist()
        self._valid = list(zip(low, high, strict=True))
        self._steps = [c.step for c in layout.channels]
        found = self._find(key, value, find_s)
        if found.channel_format() == self._pylsl.cf_string:
            raise DeviceError(f"'{url}' is a stream of texts; a toy sends numbers: name another stream.")
        # liblsl must not recover lost streams, since ReconnectingDevice does that.
        self._inlet: Any = self._pylsl.StreamInlet(found, recover=False)
        try:
            labels = stream_labels(self._inlet.info(timeout=FIND_S))
            exact = found.channel_format() != self._pylsl.cf_float32
            columns = layout.match_columns(labels, found.channel_count(), exact)
            if isinstance(columns, str):
                raise DeviceError(f"The stream '{url}' does not fit: {columns}; choose another layout with ?layout=.")
            self._columns = columns
            self.notes = columns.notes
            self._inlet.open_stream(timeout=FIND_S)
        except RuntimeError:  # pylsl's TimeoutError and LostError, which it keeps elsewhere in each version
            raise DeviceError(
                f"'{url}' is announced but does not answer: is its program still running, and no firewall between?"
            ) from None

    def _find(self, key: str, value: str, find_s: float) -> Any:
        mark = '"' if "'" in value else "'"
        predicate = f"{KEYS[key]}={mark}{value}{mark}"
        found = self._pylsl.resolve_bypred(predicate, 1, find_s)
        if found and key != "uid":  # search for a second one, since it must be unique
            found = {s.uid(): s for s in (*found, *self._pylsl.resolve_bypred(predicate, 2, _SECOND_S))}.values()
        if len(found) == 1:
            return next(iter(found))
        if found:
            choices = ", ".join(f"{u} on {s.hostname()}" for u, s in zip(stream_urls(found), found, strict=True))
            raise DeviceError("'{url}' fits {n} streams: open one of {urls}.", url=self.url, n=len(found), urls=choices)
        there = ", ".join(f"{s.name()} ({s.type() or 'no type'})" for s in self._pylsl.resolve_streams(0.5))
        raise DeviceError(
            "'{url}': no LSL stream has the {key} '{name}' within {find_s:g} s; {more}.",
            url=self.url,
            key=key,
            name=value,
            find_s=find_s,
            more=f"there are {there}" if there else "there is none on this network",
        )

    def read(self) -> list[Frame] | None:
        """Return the received frames, waiting at most ``wait_s``."""
        with self._lock:
            if self.closed:
                return None
            try:
                first, stamp = self._inlet.pull_sample(timeout=self.wait_s)
                if first is None:
                    return []
                samples, stamps = self._inlet.pull_chunk(timeout=0.0, max_samples=512)
            except RuntimeError:
                raise DeviceError(
                    "'{url}' went away: has its program ended, or is it out of reach?", url=self.url
                ) from None
        self.arrived_s = time.perf_counter()
        host = now_ms()
        frames = [
            frame
            for sample, at in zip((first, *samples), (stamp, *stamps), strict=True)
            if (frame := self._frame(host, sample, at)) is not None
        ]
        if not self.counters.frames and self.counters.malformed >= _FRACTIONS:
            raise ConfigError(
                f"'{self.url}' sends values that layout {self.layout.name} cannot count in its steps (fractions, or no "
                "numbers): write a layout whose channels have a step that is small enough."
            )
        return frames

    def _frame(self, host: int, sample: list[float], stamp: float) -> Frame | None:
        columns = self._columns
        values = [_steps(sample[at], step) for at, step in zip(columns.channels, self._steps, strict=True)]
        device_ms: int | None
        if columns.clock is None:
            device_ms = round(stamp * 1000.0) if math.isfinite(stamp) else None
            last = self._last_ms
            if device_ms is not None and last is not None and 0 < last - device_ms <= _BACK_MS:
                device_ms = last
        else:
            device_ms = _steps(sample[columns.clock], 1.0)
        if device_ms is None or not 0 <= device_ms <= _LIMIT or None in values:
            self.counters.malformed += 1
            return None
        self._last_ms = device_ms
        whole = tuple(v for v in values if v is not None)
        self.counters.frames += 1
        self.counters.garbage += any(not low <= v <= high for v, (low, high) in zip(whole, self._valid, strict=True))
        self.counters.lost += self._loss.push(device_ms)
        return Frame(host, device_ms, whole)

    def _shut(self) -> None:
        with self._lock:  # liblsl must not lose an inlet that is being read
            self._inlet.close_stream()
            self._inlet = None


def _steps(value: float, step: float) -> int | None:
    """Return a value in integer steps; None when it is not finite or, at a step of 1, not whole."""
    if not math.isfinite(value):
        return None
    number = value / step
    if not -_LIMIT <= number <= _LIMIT or (step == 1.0 and number != round(number)):
        return None
    return round(number)


def stream_labels(info: Any) -> list[str]:
    """Return the labels in a full stream description, in order; none if all are empty."""
    labels: list[str] = []
    channel = info.desc().child("channels").child("channel")
    while not channel.empty() and len(labels) < 10_000:
        labels.append(channel.child_value("label"))
        channel = channel.next_sibling("channel")
    return labels if any(labels) else []


def name_url(name: str) -> str:
    """Return the URL that opens a stream by its name."""
    prefix = "name:" if name.partition(":")[0].lower() in KEYS else ""
    return f"lsl://{prefix}{quote(name)}"


def stream_urls(streams: Iterable[Any]) -> list[str]:
    """Return for each stream the URL that opens only this one: its name, else its source, else its uid.

    A uid changes with every start of the program that sends the stream.
    """
    streams = list(streams)
    names, sources = Counter(s.name() for s in streams), Counter(s.source_id() for s in streams)
    return [
        name_url(s.name())
        if names[s.name()] == 1
        else f"lsl://source:{quote(s.source_id())}"
        if s.source_id() and sources[s.source_id()] == 1
        else f"lsl://uid:{s.uid()}"
        for s in streams
    ]


def search_streams(scan_s: float) -> DeviceListing:
    """List all LSL streams."""
    streams = {s.uid(): s for s in load_pylsl().resolve_streams(scan_s)}.values()
    devices = [
        DeviceInfo(
            url,
            "lsl",
            s.name(),
            Message(
                "{type}, {n} channels, {hz:g} Hz, on {host}",
                type=s.type() or "no type",
                n=s.channel_count(),
                hz=s.nominal_srate(),
                host=s.hostname(),
            ),
        )
        for url, s in zip(stream_urls(streams), streams, strict=True)
    ]
    return DeviceListing(sorted(devices, key=lambda d: (d.name, d.url)))


def open_lsl(address: DeviceAddress, layout: Layout) -> LslDevice:
    """Open ``lsl://NAME``, or by another of the `KEYS`, as ``lsl://source:ID``; ``?find_s=5`` bounds the search."""
    address.check_keys(("find_s",))
    place = unquote(address.place).removesuffix("/")
    key, colon, value = place.partition(":")
    if not colon or key.lower() not in KEYS:
        key, value = "name", place  # a name may hold a colon of its own
    if not value or ("'" in value and '"' in value):
        raise DeviceError(
            f"'{address.url}' names no LSL stream: write lsl://NAME, lsl://type:EEG or lsl://source:ID "
            "(plushsense devices lists them)."
        )
    return LslDevice(address.url, layout, key.lower(), value, address.number("find_s", FIND_S, 0.1, 600.0))


STREAM_TYPE = "Touch"
MARKERS, MARK = "PlushSense markers", "mark"
"""Name of the LSL stream of the studio's markers, and the marker of `Recorder.mark`, which is no gesture."""
_DRIFT = 200e-6
_FAR_S = 10.0
_LINGER_S = 0.25
"""Time for readers to get the last samples, which are lost when the stream ends."""


class LslOutlet:
    """A published LSL stream with the layout's channels, in their units, and ``device_ms``, the toy's own clock.

    Values are doubles, which are exact (integers to 2⁵³). Time stamps are the device clock plus an offset to LSL's
    clock: the smallest seen, which may grow by 200 ppm. So they are evenly spaced and follow a slow drift.

    Raises:
        ConfigError: for an empty name.
        MissingExtraError: if pylsl is not installed.
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
        # Readers must not space the time stamps evenly across frames that were lost between the toy and here.
        about.append_child("synchronization").append_child_value("can_drop_samples", "true")
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
        """Publish frames that have just arrived, with time stamps from the toy's clock."""
        now = self._pylsl.local_clock()
        begin = 0
        for end in range(1, len(frames) + 1):
            if end < len(frames) and frames[end].device_ms >= frames[end - 1].device_ms:
                continue
            run, begin = frames[begin:end], end  # frames up to a reset of the clock, or to the end
            self._update_delay(run[0].device_ms, run[-1].device_ms, now)
            for frame in run:
                self._last_stamp = max(self._last_stamp, self._delay_s + frame.device_ms / 1000.0)
                values = [
                    float(v) if step == 1.0 else round(v * step, 9)
                    for v, step in zip(frame.values, self._steps, strict=True)
                ]
                self._outlet.push_sample([*values, float(frame.device_ms)], self._last_stamp)

    def _update_delay(self, first_ms: int, last_ms: int, now: float) -> None:
        """Update the offset of LSL's clock to the toy's with a run of frames, the last of which arrived ``now``."""
        delay, before_ms = now - last_ms / 1000.0, self._last_ms
        self._last_ms = last_ms
        if before_ms is None or first_ms < before_ms or delay - self._delay_s > _FAR_S:
            self._delay_s = delay
        else:
            self._delay_s = min(delay, self._delay_s + _DRIFT * (last_ms - before_ms) / 1000.0)

    def close(self) -> None:
        """Close the stream. Closing it again has no effect."""
        if self._outlet is not None and self._outlet.have_consumers():
            time.sleep(_LINGER_S)
        self._outlet = None

    def __enter__(self) -> LslOutlet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class LslMarkers:
    """A published LSL stream of markers, which LabRecorder stores beside the streams of other devices.

    Raises:
        MissingExtraError: if pylsl is not installed.
        DeviceError: if LSL cannot be used here.
    """

    def __init__(self, name: str) -> None:
        pylsl = load_pylsl()
        source = f"plushsense-markers:{socket.gethostname()}:{name}"
        info = pylsl.StreamInfo(name, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, source)
        self._outlet: Any = pylsl.StreamOutlet(info)

    def push(self, text: str) -> None:
        """Publish a marker with the present time; nothing after `close`."""
        if self._outlet is not None:
            self._outlet.push_sample([text])

    def close(self) -> None:
        """Close the stream. Closing it again has no effect."""
        self._outlet = None


def forward(
    device: Device,
    outlet: LslOutlet,
    stop: threading.Event | None = None,
    warn: Callable[[str], None] = python_warning,
) -> int:
    """Publish the frames of a device until it ends or ``stop`` is set; return their number.

    ``warn`` is called with a sentence on lines that cannot be read.

    Raises:
        ConfigError: if the channels of the device are not those of the outlet.
        DeviceError: if the connection is lost (devices opened with ``reconnect=True`` wait for the toy).
    """
    if device.layout.channels != outlet.layout.channels:
        raise ConfigError(
            f"'{device.url}' has the layout {device.layout.name}, and the stream '{outlet.name}' was made for "
            f"{outlet.layout.name}: make both with the same."
        )
    count = 0
    for frames in device.batches(warn):
        outlet.push(frames)
        count += len(frames)
        if stop is not None and stop.is_set():
            break
    return count
