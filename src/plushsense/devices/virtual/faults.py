"""Faults of a toy and its connection: of the sensors, of the clock, and of the lines that it sends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, nearest
from plushsense.devices.virtual.motions import Floats
from plushsense.devices.virtual.world import CHANNELS

Ints = NDArray[np.int64]

CLOCK = 1 << 32
"""The clock of the toy counts milliseconds in 32 bits, and begins again at 0 after 49.7 days."""

_NOISE = bytes(range(128, 256)) + b"#?~\x00\x7f"


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: what happens, and the effect, which is what a program that reads the toy counts and reports.

    ``keys`` are those that it has besides ``kind``, ``at_s``, ``duration_s`` and ``every_s``.
    """

    keys: tuple[str, ...]
    what: str
    effect: str


FAULTS: dict[str, FaultKind] = {
    # Sensors.
    "stuck": FaultKind(
        ("channels",),
        "the channels keep the reading that they had at the beginning",
        "every frame is read; if all channels are stuck, `live` reports a sensor fault with bundles that have "
        "`still_ms`",
    ),
    "dead": FaultKind(
        ("channels", "value"),
        "the channels read `value`",
        "a value outside the valid range of the channel: each frame counts as garbage, and `live` reports a sensor "
        "fault; any other value: every frame is read",
    ),
    "noisy": FaultKind(
        ("channels", "counts"),
        "random noise is added to the channels",
        "every frame is read; values that leave the valid range count as garbage",
    ),
    "glitch": FaultKind(
        ("share", "channels"),
        "in this share of the frames, one of the channels reads nonsense below the valid range of electrodes",
        "each such frame counts as garbage if the channel is an electrode",
    ),
    # Lines.
    "torn": FaultKind(
        ("share",),
        "this share of the lines ends after some of its numbers",
        "each counts as malformed, and its frame as lost",
    ),
    "garbled": FaultKind(
        ("share",),
        "this share of the lines is cut, joined to the next line, or has noise in it",
        "most count as malformed, and their frames as lost; joined lines sometimes have as many numbers as a frame, "
        "but wrong ones, which no reader notices",
    ),
    "junk": FaultKind(
        ("share",),
        "before this share of the lines comes another one of random bytes, such as the messages of a boot loader",
        "each such line counts as malformed; every frame is read",
    ),
    "duplicated": FaultKind(
        ("share",),
        "this share of the lines is sent twice",
        "every frame is read, the doubled ones twice with the same clock; none counts as lost",
    ),
    "flood": FaultKind(
        ("times",),
        "each line is sent many times, far more than the 100 lines a second that are expected",
        "every line is read, with equal clocks; none counts as lost",
    ),
    "unended": FaultKind(
        ("bytes",),
        "lines are sent without their ends, as one long line",
        "one malformed line, with the first line after it; the frames count as lost",
    ),
    "lost": FaultKind(
        ("share",),
        "this share of the lines does not arrive",
        "the frames count as lost, unless more than 10 s are missing at once; `live` restarts after a gap of over "
        "0.1 s",
    ),
    "stall": FaultKind(
        (),
        "no line arrives, and in the end all at once",
        "every frame is read, the held ones late; none counts as lost; `live` reports no signal after 0.75 s",
    ),
    # Clock and connection.
    "reset": FaultKind(
        (),
        "the toy restarts: it is silent for `duration_s`, then its clock begins at 0",
        "none counts as lost; `live` restarts; with firmware that sends no clock, the frames go on",
    ),
    "disconnect": FaultKind(
        (),
        "the connection is lost and comes back after `duration_s`; the toy's clock goes on",
        "readers that reconnect count a reconnection and a gap, and no frame as lost; for others the toy has ended",
    ),
}
"""The faults by name. Those of one moment apply in this order, whatever their order in a file."""

_SENSORS = ("stuck", "dead", "noisy", "glitch")
_DEFAULTS = {"duration_s": 1.0, "share": 1.0, "times": 10, "value": 0, "counts": 300.0}
_RANGES = {"times": (2, 1000), "bytes": (1, 100_000), "value": (-1_000_000, 1_000_000)}
_LONGEST_S = 1e6
_MOST_BYTES = 1_000_000  # in place of one line, if floods multiply
_HELD_BYTES = 64_000_000  # in a stall; what comes after that is lost


@dataclass(frozen=True)
class Fault:
    """A fault, from its beginning to its end. Each kind has only some of the keys.

    Attributes:
        kind: what goes wrong, see below (one of `FAULTS`).
        at_s: when it begins, in seconds from the first line (0 to 1000000).
        duration_s: how long it lasts (above 0 to 1000000; default: 1).
        every_s: time from one beginning to the next, of a fault that comes again and again (above 0 to 1000000;
            default: it comes once).
        share: share of the lines or frames that are affected, drawn at random (above 0 to 1; default: all of them).
        channels: names of the affected channels, which are those of plush-15 (default: all, of ``glitch`` the
            electrodes).
        value: what dead channels read, in raw counts (-1000000 to 1000000; default: 0).
        counts: standard deviation of the noise of noisy channels, in raw counts (above 0 to 100000; default: 300).
        times: how often each line of a flood is sent (2 to 1000; default: 10).
        bytes: number of bytes that are sent in place of each line without an end (1 to 100000; default: the line).

    Raises:
        ConfigError: for an unknown kind or channel, a key that the kind does not have, or a value out of its range.
    """

    kind: str
    at_s: float
    duration_s: float | None = None
    every_s: float | None = None
    share: float | None = None
    channels: tuple[str, ...] = ()
    value: int | None = None
    counts: float | None = None
    times: int | None = None
    bytes: int | None = None

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise ConfigError(
                f"the kind of fault is '{self.kind}'; accepted are {', '.join(FAULTS)}.{nearest(self.kind, FAULTS)}"
            )
        own = FAULTS[self.kind].keys
        for key in ("share", "channels", "value", "counts", "times", "bytes"):
            if key not in own and getattr(self, key) not in (None, ()):
                has = ", ".join(("at_s", "duration_s", "every_s", *own))
                raise ConfigError(f"a fault of the kind '{self.kind}' has no {key}; it has {has}: leave {key} out.")
        if not 0.0 <= self.at_s <= _LONGEST_S:
            raise ConfigError(f"at_s is {self.at_s:g}; accepted are 0 to {_LONGEST_S:.0f} seconds.")
        for key, most in (("duration_s", _LONGEST_S), ("every_s", _LONGEST_S), ("share", 1.0), ("counts", 100_000.0)):
            value = getattr(self, key)
            if value is not None and not 0.0 < value <= most:
                raise ConfigError(f"{key} is {value:g}; accepted is above 0 to {most:.0f}.")
        for key, (low, high) in _RANGES.items():
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise ConfigError(f"{key} is {value}; accepted are whole numbers from {low} to {high}.")
        for name in self.channels:
            if name not in CHANNELS:
                raise ConfigError(
                    f"the virtual toy has no channel '{name}'; it has {', '.join(CHANNELS)}.{nearest(name, CHANNELS)}"
                )

    def setting(self, key: str) -> float:
        """Return the value of a key, or its default."""
        value = getattr(self, key)
        return float(_DEFAULTS[key] if value is None else value)

    def turns(self, passed_ms: Ints, late_s: float = 0.0) -> Ints:
        """Return how often this fault has begun (n,) at times since the first line, or had begun ``late_s`` before."""
        late = passed_ms - 1000.0 * (self.at_s + late_s)
        turns = late >= 0.0 if self.every_s is None else np.maximum(0, late // (1000.0 * self.every_s) + 1)
        return np.asarray(turns, dtype=np.int64)

    def active(self, passed_ms: Ints) -> NDArray[np.bool_]:
        """Return whether this fault lasts (n,) at times since the first line."""
        return np.asarray(self.turns(passed_ms) > self.turns(passed_ms, self.setting("duration_s")))

    def columns(self) -> Ints:
        """Return the indices of the affected channels among those of the virtual toy."""
        names = self.channels or (CHANNELS[:10] if self.kind == "glitch" else CHANNELS)
        return np.array([CHANNELS.index(name) for name in names])


def garble(line: bytes, rng: np.random.Generator) -> bytes:
    """Corrupt a line so that it is not a valid frame: cut it, insert noise, or join it to the next line."""
    at = int(rng.integers(1, max(2, len(line) - 1)))
    kind = int(rng.integers(3))
    if kind == 0:
        return line[:at].rstrip(b" \n").rpartition(b" ")[0] + b"\n"
    if kind == 1:
        return line[:at] + _noise(rng) + line[at:]
    return line[:at]


def _noise(rng: np.random.Generator) -> bytes:
    return bytes(_NOISE[int(i)] for i in rng.integers(0, len(_NOISE), int(rng.integers(1, 9))))


class FaultyToy:
    """The faults of one toy, applied in turn to its readings, clock and lines, sample by sample from the first line on.

    Args:
        seed: seed of all random choices; each fault has its own, so that another fault changes none of them.
        wrap_s: time from the first line to the wrap of the clock; None: by the session's clock.
    """

    def __init__(self, faults: Sequence[Fault], seed: int, wrap_s: float | None = None) -> None:
        order = list(FAULTS)
        self._faults = sorted(enumerate(faults), key=lambda pair: order.index(pair[1].kind))
        self._rng = {n: np.random.default_rng([seed, n, 0xFA17]) for n, _ in self._faults}
        self._wrap_ms = None if wrap_s is None else round(1000.0 * wrap_s)
        self._shift: int | None = None
        self._started = (-1.0, 0)
        self._kept: dict[int, tuple[int, Ints]] = {}
        self._held: dict[int, bytearray] = {}

    def readings(self, values: Ints, passed_ms: Ints) -> Ints:
        """Return the readings (n, 13) with the faults of the sensors; ``passed_ms`` (n,) is since the first line."""
        changed = values
        for n, fault in self._faults:
            if fault.kind not in _SENSORS:
                continue
            rows = np.flatnonzero(fault.active(passed_ms))
            if not len(rows):
                continue
            changed = changed.copy() if changed is values else changed
            rng, columns = self._rng[n], fault.columns()
            if fault.kind == "stuck":
                turns = fault.turns(passed_ms)[rows]
                for turn in np.unique(turns).tolist():
                    stuck = rows[turns == turn]
                    if n not in self._kept or self._kept[n][0] != turn:
                        self._kept[n] = turn, changed[stuck[0]].copy()
                    changed[np.ix_(stuck, columns)] = self._kept[n][1][columns]
            elif fault.kind == "dead":
                changed[np.ix_(rows, columns)] = int(fault.setting("value"))
            elif fault.kind == "noisy":
                noise: Floats = fault.setting("counts") * rng.standard_normal((len(rows), len(columns)))
                changed[np.ix_(rows, columns)] += np.rint(noise).astype(np.int64)
            else:
                rows = rows[rng.random(len(rows)) < fault.setting("share")]
                changed[rows, rng.choice(columns, len(rows))] = -rng.integers(2001, 32000, len(rows))
        return changed

    def clock(self, session_ms: Ints, passed_ms: Ints) -> Ints:
        """Return the clock that the toy sends (n,), in 32 bits; ``session_ms`` (n,) is one without resets."""
        if self._shift is None:
            self._shift = 0 if self._wrap_ms is None else CLOCK - self._wrap_ms - int(session_ms[0] - passed_ms[0])
        sent = session_ms + self._shift
        started_s = np.full(len(sent), -1.0)  # of the last restart
        for _, fault in self._faults:
            if fault.kind == "reset":
                silent_s = fault.setting("duration_s")
                turns = fault.turns(passed_ms, silent_s)
                ends_s = fault.at_s + silent_s + (turns - 1) * (fault.every_s or 0.0)
                started_s = np.where(turns > 0, np.maximum(started_s, ends_s), started_s)
        for at in np.unique(started_s[started_s >= 0.0]).tolist():
            after = started_s == at
            if self._started[0] != at:
                self._started = at, int(session_ms[np.argmax(after)])
            sent = np.where(after, session_ms - self._started[1], sent)
        return np.asarray(sent % CLOCK)

    def lines(self, lines: list[bytes], passed_ms: Ints) -> list[bool]:
        """Change the lines of these samples in place; return for each whether the toy is connected then."""
        connected = [True] * len(lines)
        for n, fault in self._faults:
            if fault.kind in _SENSORS:
                continue
            if fault.kind == "stall":
                self._hold(n, fault, lines, passed_ms)
                continue
            rows = np.flatnonzero(fault.active(passed_ms))
            if "share" in FAULTS[fault.kind].keys:
                rows = rows[self._rng[n].random(len(rows)) < fault.setting("share")]
            for at in rows.tolist():
                if fault.kind == "disconnect":
                    connected[at] = False
                lines[at] = self._changed(n, fault, lines[at])
        return connected

    def _changed(self, n: int, fault: Fault, line: bytes) -> bytes:
        """Return a line that a fault affects."""
        rng, kind = self._rng[n], fault.kind
        if kind in ("lost", "reset", "disconnect"):
            return b""
        if kind == "junk":
            return _noise(rng) + b"\n" + line
        if not line:
            return b""
        if kind == "garbled":
            return garble(line, rng)
        if kind == "torn":
            fields = line.split()
            # Another fault may have left only one number, or none.
            return b" ".join(fields[: int(rng.integers(1, len(fields)))]) + b"\n" if len(fields) > 1 else line
        if kind in ("duplicated", "flood"):
            times = 2 if kind == "duplicated" else int(fault.setting("times"))
            return line * min(times, max(1, _MOST_BYTES // len(line)))
        if kind == "unended":
            return line.rstrip(b"\n") if fault.bytes is None else b"8" * fault.bytes
        return line

    def _hold(self, n: int, fault: Fault, lines: list[bytes], passed_ms: Ints) -> None:
        """Hold back the lines of a stall, and put them before the first line after it."""
        held = self._held.setdefault(n, bytearray())
        for at, holding in enumerate(fault.active(passed_ms).tolist()):
            if holding:
                held += lines[at] if len(held) < _HELD_BYTES else b""
                lines[at] = b""
            elif held:
                lines[at] = bytes(held) + lines[at]
                held.clear()

    def held(self) -> bytes:
        """Return the lines that a stall still holds back when the toy ends."""
        return b"".join(bytes(held) for held in self._held.values())
