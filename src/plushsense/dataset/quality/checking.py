"""Checking a whole data set, and the marks that accept findings or exclude recordings."""

from __future__ import annotations

import getpass
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, nearest
from plushsense.core.recorder_csv import Frames, ReadResult, parse_name, read_recording, read_stream
from plushsense.dataset.marks import Mark, match_ids, read_marks
from plushsense.dataset.quality.findings import SEVERITIES, CheckLimits, Finding, Issue
from plushsense.dataset.quality.measurements import DatasetSummary, Examination, RecordingSummary, summarize, usual_rows
from plushsense.dataset.quality.registry import CHECKS
from plushsense.dataset.store import Dataset, RecordingInfo, StreamInfo

Progress = Callable[[int, int], None]
# A finding that concerns this share of the recordings is reported once, for the data set.
_NEARLY_ALL = 0.8
_MANY = 10


@dataclass(frozen=True)
class CheckReport:
    """Result of the checks; ``recordings`` were examined, ``excluded`` ones were not."""

    dataset: Dataset
    findings: tuple[Finding, ...]
    recordings: int
    excluded: int
    checks: tuple[str, ...]
    limits: CheckLimits
    seconds: float

    @property
    def undecided(self) -> list[Finding]:
        """Findings that need a decision: errors that nobody accepted."""
        return [f for f in self.findings if f.severity == "error" and not f.accepted]

    @property
    def ok(self) -> bool:
        """Whether no finding needs a decision."""
        return not self.undecided

    def findings_of(self, *checks: str) -> list[Finding]:
        """Return the findings of some checks."""
        return [f for f in self.findings if f.check in checks]

    def counts(self) -> dict[str, dict[str, int]]:
        """Count findings by severity and by check; accepted ones are counted apart."""
        standing = [f for f in self.findings if not f.accepted]
        by_severity = Counter(f.severity for f in standing)
        by_check = Counter(f.check for f in standing)
        return {
            "by_severity": {s: by_severity[s] for s in SEVERITIES},
            "by_check": {c: by_check[c] for c in self.checks if by_check[c]},
            "accepted": dict(Counter(f.check for f in self.findings if f.accepted)),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
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
    """Return the checks named in ``only``, all if it is empty; raises ConfigError for an unknown name."""
    names = tuple(dict.fromkeys(only))
    for name in names:
        if name not in CHECKS:
            raise ConfigError(f"There is no check '{name}': accepted are {', '.join(CHECKS)}.{nearest(name, CHECKS)}")
    return names or tuple(CHECKS)


def check(
    dataset: Dataset,
    *,
    only: Iterable[str] = (),
    limits: CheckLimits | None = None,
    progress: Progress | None = None,
) -> CheckReport:
    """Examine every recording that is not excluded, and every stream.

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
    limits = limits or CheckLimits()
    used = dataset.used
    usual = usual_rows((r.gesture, r.stop - r.start) for r in used)
    found: list[Finding] = []
    recordings: list[RecordingSummary] = []
    streams: list[RecordingSummary] = []

    def look(examined: Examination, info: RecordingInfo | StreamInfo) -> None:
        scope = "stream" if examined.stream else "recording"
        for name in checks:
            examine = CHECKS[name].examine
            if examine is not None and scope in CHECKS[name].scope:
                found.extend(_finding(one, name, info) for one in examine(examined))
        (streams if examined.stream else recordings).append(summarize(info, examined.frames, dataset.layout))

    for info, result, frames in _read(dataset, used, progress):
        if isinstance(info, StreamInfo):
            bad = result.malformed - result.cut
            whole = Examination(frames, dataset.layout, None, None, limits, malformed=bad, cut=result.cut, stream=True)
            look(whole, info)
            continue
        own_file = not info.file.startswith("streams/")
        named = parse_name(info.file.rsplit("/", 1)[-1]) if own_file else None
        examined = Examination(
            frames.slice(info.start, info.stop),
            dataset.layout,
            named.rows if named else None,
            usual[info.gesture] if own_file else None,
            limits,
            first_row=info.start,
            rows_in_file=len(frames),
            malformed=result.malformed if own_file else 0,
        )
        if len(examined.frames):
            look(examined, info)
    compared = DatasetSummary(dataset, recordings, streams, limits)
    by_id: dict[str, RecordingInfo | StreamInfo] = {s.id: s for s in dataset.streams}
    by_id |= {r.id: r for r in used}
    for name in checks:
        check_all = CHECKS[name].compare
        if check_all is not None:
            found.extend(_finding(one, name, by_id.get(one.about)) for one in check_all(compared))
    found = list(_merge_common(found, len(recordings)))
    marks = read_marks(dataset.path)
    found = [
        replace(f, accepted=True) if (m := marks.get(f.about)) is not None and f.check in m.accepted else f
        for f in found
    ]
    order = {name: i for i, name in enumerate(CHECKS)}
    found.sort(key=lambda f: (SEVERITIES.index(f.severity), order[f.check], f.about))
    return CheckReport(
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
    """Read every raw file once: streams with the recordings that are part of them, and the recordings' own files."""
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


def _finding(issue: Issue, name: str, info: RecordingInfo | StreamInfo | None) -> Finding:
    check = CHECKS[name]
    recording = info.id if isinstance(info, RecordingInfo) else ""
    return Finding(
        recording=recording,
        stream=info.id if isinstance(info, StreamInfo) else "",
        subject=info.subject if info is not None else issue.about,
        gesture=info.gesture if isinstance(info, RecordingInfo) else "",
        check=name,
        severity=issue.severity or check.severity,
        message=issue.message,
        action=(isinstance(info, StreamInfo) and check.stream_action) or check.action,
        rows=issue.rows,
        channels=issue.channels,
    )


def _merge_common(found: list[Finding], recordings: int) -> Iterator[Finding]:
    """Merge the findings of a check that concerns nearly every recording into one of the data set."""
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


def author_name(who: str | None) -> str:
    """Return who decides: the name given, else the login name.

    Raises:
        ConfigError: where nobody is logged in by name.
    """
    if who:
        return who
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        raise ConfigError("Nobody is logged in by name here: say who decides with --who NAME.") from None


def exclusions(
    dataset: Dataset, exclude: Sequence[str] = (), include: Sequence[str] = (), *, who: str, why: str
) -> list[Mark]:
    """Return marks that exclude or include recordings; patterns match ids."""
    marks = []
    used, out = {r.id for r in dataset.used}, {r.id for r in dataset.recordings if r.excluded}
    for pattern in exclude:
        ids = match_ids(pattern, used | out, "recording")
        marks += [Mark(i, "exclude", who, why) for i in ids if i in used]
    for pattern in include:
        ids = match_ids(pattern, used | out, "recording")
        marks += [Mark(i, "include", who, why) for i in ids if i in out]
    return marks


def parse_acceptance(text: str) -> tuple[str, str]:
    """Split ``CHECK:PATTERN``; without a pattern it refers to the whole data set.

    Raises:
        ConfigError: for a check that is not known.
    """
    check, _, pattern = text.partition(":")
    known_checks([check])
    return check, pattern


def acceptances(checked: CheckReport, accept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Return marks that accept findings: ``CHECK:PATTERN``, where the pattern matches recordings, streams or people.

    Only present findings can be accepted, so that a later fault is not hidden.

    Raises:
        DatasetError: when the check found nothing there.
    """
    marks = []
    for entry in accept:
        check, pattern = parse_acceptance(entry)
        found = {f.about: f for f in checked.findings_of(check)}
        if not found:
            raise DatasetError(f"The check '{check}' found nothing, so there is nothing to accept.")
        ids = [""] if not pattern and "" in found else match_ids(pattern, found, f"finding of '{check}' about")
        marks += [Mark(i, "accept", who, why, check=check) for i in ids if not found[i].accepted]
    return marks


def withdrawals(dataset: Dataset, unaccept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Return marks that undo acceptances.

    Raises:
        DatasetError: when none of the kind stands.
    """
    marks = []
    standing = read_marks(dataset.path)
    for entry in unaccept:
        check, pattern = parse_acceptance(entry)
        accepted = [i for i, mark in standing.items() if check in mark.accepted]
        if not accepted:
            raise DatasetError(f"Nothing that '{check}' found was accepted, so there is nothing to take back.")
        ids = (
            [""]
            if not pattern and "" in accepted
            else match_ids(pattern, accepted, f"accepted finding of '{check}' on")
        )
        marks += [Mark(i, "unaccept", who, why, check=check) for i in ids]
    return marks
