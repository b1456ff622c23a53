"""Findings of the quality checks, and the limits above which they are reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal, Self

from plushsense.core.errors import ConfigError, nearest

Severity = Literal["info", "warning", "error"]
PARTLY_THERE = "only its first"
"""Start of the index's flag for a recording whose end is not in the stream."""

# Most urgent first. An error needs a decision: until it is accepted, or the recording excluded, the check fails.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class CheckLimits:
    """Limits of the checks; docs/checks.md gives the reason for each."""

    duration: float = 0.4
    """Share of the gesture's mean duration by which a recording may differ (the paper: 0.4)."""
    rate: float = 0.2
    """Share of the layout's rate by which the measured one may differ."""
    jitter: float = 0.3
    """Half the spread (5 to 95 %) of the time between frames, as a share of its median."""
    gap_ms: float = 50.0
    """Time without a frame; where frames come slower than 20 a second, 2.5 periods."""
    long_gap_ms: float = 1000.0
    """A gap in a recording that needs a decision."""
    pause_s: float = 60.0
    """A stream that stood still this long goes on afterwards as another session."""
    lost: float = 0.02
    """Share of frames that the device clock misses."""
    garbage: float = 0.2
    """Share of rows with an invalid value that needs a decision."""
    spike: float = 6.0
    """A jump of one row away and back, as a multiple of the channel's 95 % step in the recording."""
    stuck_s: float = 0.5
    """A channel that holds one value; at least 10 times what is usual for the channel."""
    saturated_s: float = 0.1
    """A channel that stays at its highest or lowest value; at least 4 times what is usual for the channel. Half of it
    where several recordings end at that value."""
    drift: float = 0.5
    """Change of a capacitive channel's baseline within a session, as a share of its signal when touched."""
    onset: float = 0.1
    """Activity of a recording as a share of what is usual for its gesture."""
    quiet_s: float = 0.7
    """Stillness that separates two gestures."""
    balance: float = 2.0
    """Times more or fewer recordings than the median gesture or person."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e9:
                raise ConfigError(f"The limit {f.name} is {value!r}; it must be a number above 0.")

    def changed(self, given: Mapping[str, float]) -> Self:
        """Return these limits with some replaced; raise ConfigError for an unknown name."""
        known = [f.name for f in fields(self)]
        for name in given:
            if name not in known:
                raise ConfigError(f"There is no limit '{name}': accepted are {', '.join(known)}.{nearest(name, known)}")
        return replace(self, **given)


@dataclass(frozen=True)
class Issue:
    """A finding as a check yields it.

    ``rows`` are ranges (first, last + 1) of the recording or stream, ``channels`` are positions in the layout. Checks
    that compare set ``about`` to the id of the recording, stream or person. ``severity`` is set if it differs from the
    check's.
    """

    message: str
    rows: tuple[tuple[int, int], ...] = ()
    channels: tuple[int, ...] = ()
    about: str = ""
    severity: Severity | None = None


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A finding as it is reported.

    ``recording``, ``stream``, ``subject`` and ``gesture`` are "" if they do not apply. ``accepted``: a mark states that
    it is known and no fault.
    """

    recording: str = ""
    stream: str = ""
    subject: str = ""
    gesture: str = ""
    check: str
    severity: Severity
    message: str
    action: str
    accepted: bool = False
    rows: tuple[tuple[int, int], ...] = ()
    channels: tuple[int, ...] = ()

    @property
    def about(self) -> str:
        """The id that marks use: of a recording, a stream, a person, or "" for the data set."""
        return self.recording or self.stream or self.subject
