"""Findings of the quality checks, and the limits that decide what is reported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal, Self

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.sentences import Message

Severity = Literal["info", "warning", "error"]
PARTLY_THERE = "only its first"
"""First words of the index flag of a recording whose last rows are not in its stream."""

# Most urgent first. An error needs a decision: the check fails until it is accepted or the recording is excluded.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True)
class CheckLimits:
    """Limits of the checks; docs/checks.md gives the reason for each."""

    duration: float = 0.4
    """Largest difference of a recording's duration from the mean of its gesture, as a share of it (the paper: 0.4)."""
    short_s: float = 0.1
    """Duration below which a recording is too short for a gesture."""
    rate: float = 0.2
    """Largest difference of the measured frame rate from the layout's, as a share of the latter."""
    jitter: float = 0.3
    """Half the range from the 5th to the 95th percentile of the time between frames, as a share of its median."""
    gap_ms: float = 50.0
    """Longest time without a frame; 2.5 periods if that is longer (below 50 frames a second)."""
    long_gap_ms: float = 1000.0
    """Duration above which a gap in a recording is an error."""
    pause_s: float = 60.0
    """Longest pause of a stream, by the computer's clock; after a longer one it was resumed."""
    lost: float = 0.02
    """Largest share of lost frames, by the device clock."""
    garbage: float = 0.2
    """Share of bad rows (invalid values, blank rows, spikes) above which these are an error."""
    spike: float = 6.0
    """Size of a jump away and back within one row, as a multiple of the channel's 95th percentile of steps."""
    stuck_s: float = 0.5
    """Longest time that a channel may keep one value; 10 times what is usual for the channel if that is longer."""
    saturated_s: float = 0.1
    """Longest time that a channel may stay at its highest or lowest value; 4 times what is usual for the channel if
    that is longer. Half of it for a value that several recordings reach."""
    drift: float = 0.5
    """Largest change of a contact channel's baseline within a session, as a share of its signal when touched."""
    onset: float = 0.1
    """Least activity of a recording, as a share of what is usual for its gesture."""
    quiet_s: float = 0.7
    """Duration of stillness that separates two gestures."""
    balance: float = 2.0
    """Largest ratio, up or down, of the recordings of a gesture or person to the median."""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e9:
                raise ConfigError(f"The limit {f.name} is {value!r}; it must be a number above 0.")

    def changed(self, given: Mapping[str, float]) -> Self:
        """Return a copy with the limits of ``given`` replaced; raise ConfigError for an unknown name."""
        known = [f.name for f in fields(self)]
        for name in given:
            if name not in known:
                raise ConfigError(f"There is no limit '{name}': accepted are {', '.join(known)}.{nearest(name, known)}")
        return replace(self, **given)


@dataclass(frozen=True)
class Issue:
    """Result that a check yields; `Finding` adds the check, its severity and the subject.

    ``rows`` are ranges (first, last + 1) of the recording or stream, ``channels`` are positions in the layout. Checks
    that compare recordings set ``about`` to the id of the recording, stream or person concerned. ``severity`` is None
    unless it differs from that of the check.
    """

    message: Message
    rows: tuple[tuple[int, int], ...] = ()
    channels: tuple[int, ...] = ()
    about: str = ""
    severity: Severity | None = None


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Finding of the report.

    ``recording``, ``stream``, ``subject`` and ``gesture`` are "" if they do not apply. ``action`` is the advice to the
    user. ``accepted`` is whether a mark states that the finding is known and no fault.
    """

    recording: str = ""
    stream: str = ""
    subject: str = ""
    gesture: str = ""
    check: str
    severity: Severity
    message: Message
    action: str
    accepted: bool = False
    rows: tuple[tuple[int, int], ...] = ()
    channels: tuple[int, ...] = ()

    @property
    def about(self) -> str:
        """Id that marks use: of the recording, stream or person concerned, or "" for the whole data set."""
        return self.recording or self.stream or self.subject
