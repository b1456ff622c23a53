"""Checking a whole data set: every raw file is read once, and what its people accepted is marked."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.recfile import Frames, ReadResult, parse_name, read_recording, read_stream
from plushsense.dataset.marks import read_marks
from plushsense.dataset.quality.examined import Examined, usual_rows
from plushsense.dataset.quality.finding import SEVERITIES, Finding, Limits, Said
from plushsense.dataset.quality.outline import Outline, Whole, outline
from plushsense.dataset.quality.table import CHECKS
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo

Progress = Callable[[int, int], None]
# What is true of nearly all recordings is said once, of the data set.
_NEARLY_ALL = 0.8
_MANY = 10


@dataclass(frozen=True)
class Checked:
    """What the checks found. ``recordings`` were looked at; ``excluded`` are not looked at any more."""

    dataset: Dataset
    findings: tuple[Finding, ...]
    recordings: int
    excluded: int
    checks: tuple[str, ...]
    limits: Limits
    seconds: float

    @property
    def undecided(self) -> list[Finding]:
        """Findings that ask for a decision: errors that nobody accepted."""
        return [f for f in self.findings if f.severity == "error" and not f.accepted]

    @property
    def ok(self) -> bool:
        """Whether nothing asks for a decision."""
        return not self.undecided

    def of(self, *checks: str) -> list[Finding]:
        """The findings of some checks."""
        return [f for f in self.findings if f.check in checks]

    def counts(self) -> dict[str, dict[str, int]]:
        """Findings by severity and by check; those accepted count apart."""
        standing = [f for f in self.findings if not f.accepted]
        by_severity = Counter(f.severity for f in standing)
        by_check = Counter(f.check for f in standing)
        return {
            "by_severity": {s: by_severity[s] for s in SEVERITIES},
            "by_check": {c: by_check[c] for c in self.checks if by_check[c]},
            "accepted": dict(Counter(f.check for f in self.findings if f.accepted)),
        }

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "ok": self.ok,
            "recordings": self.recordings,
            "excluded": self.excluded,
            "undecided": len(self.undecided),
            "counts": self.counts(),
            "findings": [f.to_dict() for f in self.findings],
            "checks": list(self.checks),
            "seconds": round(self.seconds, 2),
            "simulated": self.dataset.head.simulated,
        }


def known_checks(only: Iterable[str]) -> tuple[str, ...]:
    """The checks asked for, all where none is; ConfigError with the nearest name for one that is not known."""
    asked = tuple(dict.fromkeys(only))
    for name in asked:
        if name not in CHECKS:
            raise ConfigError(f"There is no check '{name}': accepted are {', '.join(CHECKS)}.{nearest(name, CHECKS)}")
    return asked or tuple(CHECKS)


def check(
    dataset: Dataset,
    *,
    only: Iterable[str] = (),
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Checked:
    """Look at every recording that is not excluded, and at every stream.

    Args:
        only: names of checks; all by default.
        limits: from where on something is worth saying.
        progress: called with (files done, files in all).

    Raises:
        ConfigError: for a check that is not known.
        FileFormatError: for a raw file that can no longer be read.
    """
    began = time.perf_counter()
    checks = known_checks(only)
    limits = limits or Limits()
    used = dataset.used
    usual = usual_rows((r.gesture, r.stop - r.start) for r in used)
    found: list[Finding] = []
    recordings: list[Outline] = []
    streams: list[Outline] = []

    def look(examined: Examined, info: RecordingInfo | StreamInfo) -> None:
        scope = "stream" if examined.stream else "recording"
        for name in checks:
            each = CHECKS[name].each
            if each is not None and scope in CHECKS[name].scope:
                found.extend(_finding(one, name, info) for one in each(examined))
        (streams if examined.stream else recordings).append(outline(info, examined.frames, dataset.layout))

    for info, result, frames in _read(dataset, used, progress):
        if isinstance(info, StreamInfo):
            bad = result.malformed - result.cut
            whole = Examined(frames, dataset.layout, None, None, limits, malformed=bad, cut=result.cut, stream=True)
            look(whole, info)
            continue
        own_file = not info.file.startswith("streams/")
        said = parse_name(info.file.rsplit("/", 1)[-1]) if own_file else None
        examined = Examined(
            frames.slice(info.start, info.stop),
            dataset.layout,
            said.rows if said else None,
            usual[info.gesture] if own_file else None,
            limits,
            first_row=info.start,
            rows_in_file=len(frames),
            malformed=result.malformed if own_file else 0,
        )
        if len(examined.frames):
            look(examined, info)
    compared = Whole(dataset, recordings, streams, limits)
    by_id: dict[str, RecordingInfo | StreamInfo] = {s.id: s for s in dataset.streams}
    by_id |= {r.id: r for r in used}
    for name in checks:
        check_all = CHECKS[name].whole
        if check_all is not None:
            found.extend(_finding(one, name, by_id.get(one.about)) for one in check_all(compared))
    found = list(_said_once(found, len(recordings)))
    marks = read_marks(dataset.path)
    found = [
        replace(f, accepted=True) if (m := marks.get(f.about)) is not None and f.check in m.accepted else f
        for f in found
    ]
    order = {name: i for i, name in enumerate(CHECKS)}
    found.sort(key=lambda f: (SEVERITIES.index(f.severity), order[f.check], f.about))
    return Checked(
        dataset,
        tuple(found),
        len(recordings),
        len(dataset.recordings) - len(used),
        checks,
        limits,
        time.perf_counter() - began,
    )


def _read(
    dataset: Dataset, used: Sequence[RecordingInfo], progress: Progress | None
) -> Iterator[tuple[RecordingInfo | StreamInfo, ReadResult, Frames]]:
    """Every raw file once: streams, with the recordings that are stretches of them, and the recordings' own files."""
    inside: dict[str, list[RecordingInfo]] = {}
    own = []
    for r in used:
        if r.file.startswith("streams/"):
            inside.setdefault(r.file, []).append(r)
        else:
            own.append(r)
    total, done = len(dataset.streams) + len(own), 0
    for s in dataset.streams:
        result = read_stream(dataset.path / s.file, dataset.layout)
        yield s, result, result.frames
        for r in inside.get(s.file, ()):
            yield r, result, result.frames.slice(r.first_row, r.first_row + r.rows)
        done += 1
        if progress is not None:
            progress(done, total)
    for r in own:
        result = read_recording(dataset.path / r.file, dataset.layout)
        yield r, result, result.frames
        done += 1
        if progress is not None:
            progress(done, total)


def _finding(said: Said, name: str, info: RecordingInfo | StreamInfo | None) -> Finding:
    check = CHECKS[name]
    recording = info.id if isinstance(info, RecordingInfo) else ""
    return Finding(
        recording=recording,
        stream=info.id if isinstance(info, StreamInfo) else "",
        subject=info.subject if info is not None else said.about,
        gesture=info.gesture if isinstance(info, RecordingInfo) else "",
        check=name,
        severity=said.severity or check.severity,
        message=said.message,
        action=(isinstance(info, StreamInfo) and check.stream_action) or check.action,
        rows=said.rows,
        channels=said.channels,
    )


def _said_once(found: list[Finding], recordings: int) -> Iterator[Finding]:
    """The findings, those of a check that concerns nearly every recording as one of the data set."""
    concerned = Counter(f.check for f in {(f.check, f.recording): f for f in found if f.recording}.values())
    common = {c for c, n in concerned.items() if n >= _MANY and n > _NEARLY_ALL * recordings}
    for f in found:
        if f.check not in common or not (f.recording or f.stream):
            yield f
    for c in sorted(common):
        first = next(f for f in found if f.check == c and f.recording)
        worst = min((f.severity for f in found if f.check == c), key=SEVERITIES.index)
        yield Finding(
            "",
            "",
            "",
            "",
            c,
            worst,
            f"so in {concerned[c]} of {recordings} recordings, for instance {first.recording}: {first.message}",
            first.action,
        )
