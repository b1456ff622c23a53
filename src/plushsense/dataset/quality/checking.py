"""Run the quality checks on a data set, and make the marks that accept findings or exclude recordings."""

from __future__ import annotations

import getpass
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, nearest
from plushsense.core.recorder_csv import Frames, ReadResult, parse_name, read_recording, read_stream
from plushsense.core.sentences import Message
from plushsense.dataset.marks import Mark, match_ids, read_marks
from plushsense.dataset.quality import comparisons, recordings
from plushsense.dataset.quality.findings import SEVERITIES, CheckLimits, Finding, Issue, Severity
from plushsense.dataset.quality.measurements import DatasetSummary, Examination, RecordingSummary, summarize, usual_rows
from plushsense.dataset.store import Dataset, Progress, RecordingInfo, StreamInfo


@dataclass(frozen=True)
class Check:
    """Quality check.

    ``run`` is a function of the module `recordings`, called with the `Examination` of one recording or stream, or of
    the module `comparisons`, called once with the `DatasetSummary`. ``scope`` lists what its findings can be about:
    recording, stream, subject, dataset. A check with ``at_import`` also runs whenever the index is built, and its
    messages become flags of the index. ``action`` is the advice to the user; ``stream_action`` replaces it for streams.
    """

    run: Callable[[Any], Iterator[Issue]]
    scope: tuple[str, ...]
    severity: Severity
    action: str
    at_import: bool = False
    stream_action: str = ""

    @property
    def compares(self) -> bool:
        """Whether the check is one of `comparisons`, which examine all recordings together."""
        return self.run.__module__ == comparisons.__name__


_R, _S, _P, _D = "recording", "stream", "subject", "dataset"
_LOOK = "look at its plot; trim or exclude it, or accept"
_TO_ONE = "trim it to one gesture, or exclude it"
_SENSOR = "check the sensor; exclude it if the gesture is hit"
_RADIO = "check cable and radio; exclude it if the gesture is hit"
_OVERTAKEN = "check the radio; readers leave out a single such row, and restart at several"
_RESTART = "nothing: readers restart there"
_DIGITS = "import it again, with all digits of its times or with row_rate_hz in a pattern"
_LEFT_OUT = "nothing: that line is left out"
_MIXED = "record each gesture in several sessions, and several gestures in each"

CHECKS: dict[str, Check] = {
    "never-stopped": Check(recordings.never_stopped, (_R,), "error", "trim it to the gesture, or exclude it", True),
    "too-short": Check(recordings.too_short, (_R,), "error", "exclude it, or record it again"),
    "duration": Check(comparisons.duration, (_R,), "warning", _LOOK),
    "no-onset": Check(comparisons.no_onset, (_R,), "warning", "look whether the gesture was made; exclude it if not"),
    "several-gestures": Check(comparisons.several_gestures, (_R,), "warning", _TO_ONE),
    "clock-still": Check(recordings.clock_still, (_R, _S), "error", _DIGITS, True),
    "clock-reset": Check(
        recordings.clock_reset, (_R, _S), "error", "trim it to one side, or exclude it", True, _RESTART
    ),
    "clock-value": Check(
        recordings.clock_value, (_R, _S), "warning", "check the cable; readers leave out each such row", True
    ),
    "out-of-order": Check(recordings.out_of_order, (_R, _S), "warning", _OVERTAKEN, True),
    "gaps": Check(recordings.gaps, (_R, _S), "warning", "exclude it if the gesture is hit, or accept", True, _RESTART),
    "lost-frames": Check(recordings.lost_frames, (_R, _S), "warning", _RADIO),
    "rate": Check(recordings.rate, (_R, _S), "warning", "check firmware and layout; training resamples it", True),
    "jitter": Check(recordings.jitter, (_R, _S), "info", "nothing: the clock rule evens it out"),
    "resumed": Check(recordings.resumed, (_S,), "warning", _RESTART, True),
    "cut-line": Check(recordings.cut_line, (_S,), "info", _LEFT_OUT),
    "malformed": Check(recordings.malformed, (_R, _S), "info", _LEFT_OUT),
    "rows": Check(recordings.rows_against_name, (_R,), "warning", "compare with the original file, or accept", True),
    "garbage": Check(recordings.garbage, (_R, _S), "warning", _SENSOR, True),
    "blank-rows": Check(recordings.blank_rows, (_R, _S), "warning", _SENSOR),
    "spikes": Check(recordings.spikes, (_R,), "warning", _SENSOR),
    "flat": Check(comparisons.flat, (_R, _S, _D), "error", "check the sensor's cable; exclude what it spoiled"),
    "zeroed": Check(comparisons.zeroed, (_D,), "warning", "record again; the lost values cannot be restored"),
    "stuck": Check(comparisons.stuck, (_R, _S), "warning", _SENSOR),
    "saturated": Check(comparisons.saturated, (_R,), "warning", "widen the sensor's range, or accept strong touch"),
    "drift": Check(comparisons.drift, (_S, _P), "warning", "let the toy calibrate again between gestures"),
    "duplicate": Check(comparisons.duplicate, (_R, _S), "error", "exclude one of the two"),
    "overlap": Check(comparisons.overlap, (_R,), "warning", "trim or exclude one of the two"),
    "not-in-stream": Check(comparisons.not_in_stream, (_R,), "warning", "check that the stream is this session's"),
    "missing": Check(comparisons.missing, (_P,), "warning", "record it if the person is still there, or accept"),
    "label": Check(comparisons.unknown_label, (_D,), "warning", "give a gesture set that has it, or rename the files"),
    "rest-tells": Check(comparisons.rest_tells, (_D,), "warning", _MIXED),
    "one-session": Check(comparisons.one_session, (_D,), "warning", _MIXED),
    "class-balance": Check(comparisons.class_balance, (_D,), "info", "weight the classes, or leave odd ones out"),
    "subject-balance": Check(comparisons.subject_balance, (_D,), "info", "weight the people, or record more"),
}


def import_flags(examined: Examination) -> list[str]:
    """Return the messages of the ``at_import`` checks for one recording or stream, without those of severity info."""
    scope = _S if examined.stream else _R
    return [
        str(issue.message)
        for check in CHECKS.values()
        if check.at_import and not check.compares and scope in check.scope
        for issue in check.run(examined)
        if (issue.severity or check.severity) != "info"
    ]


# A check that finds something in more than this share of the recordings is reported once, for the data set.
_NEARLY_ALL = 0.8
_MANY = 10


@dataclass(frozen=True)
class CheckReport:
    """Result of the checks; ``recordings`` and ``excluded`` are the numbers of examined and of excluded recordings."""

    dataset: Dataset
    findings: tuple[Finding, ...]
    recordings: int
    excluded: int
    checks: tuple[str, ...]
    limits: CheckLimits
    seconds: float

    @property
    def undecided(self) -> list[Finding]:
        """Findings that need a decision: errors that are not accepted."""
        return [f for f in self.findings if f.severity == "error" and not f.accepted]

    @property
    def ok(self) -> bool:
        """Whether no finding needs a decision."""
        return not self.undecided

    def findings_of(self, *checks: str) -> list[Finding]:
        """Return the findings of the checks with the given names."""
        return [f for f in self.findings if f.check in checks]

    def counts(self) -> dict[str, dict[str, int]]:
        """Count the findings by severity and by check; accepted findings are counted separately."""
        standing = [f for f in self.findings if not f.accepted]
        by_severity = Counter(f.severity for f in standing)
        by_check = Counter(f.check for f in standing)
        return {
            "by_severity": {s: by_severity[s] for s in SEVERITIES},
            "by_check": {c: by_check[c] for c in self.checks if by_check[c]},
            "accepted": dict(Counter(f.check for f in self.findings if f.accepted)),
        }

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "ok": self.ok,
            "recordings": self.recordings,
            "excluded": self.excluded,
            "undecided": len(self.undecided),
            "counts": self.counts(),
            "findings": [asdict(f) for f in self.findings],
            "checks": list(self.checks),
            "seconds": round(self.seconds, 2),
            "simulated": self.dataset.head.simulated,
        }


def known_checks(only: Iterable[str]) -> tuple[str, ...]:
    """Return the names in ``only`` without repetitions, all checks if empty; raise ConfigError for an unknown name."""
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
    """Run the quality checks on every recording that is not excluded, and on every stream.

    Args:
        only: names of the checks to run; all by default.
        limits: limits that decide what is reported.
        progress: called with (files done, number of files).

    Raises:
        ConfigError: for an unknown check.
        FileFormatError: for a raw file that can no longer be read.
    """
    began = time.perf_counter()
    checks = known_checks(only)
    limits = limits or CheckLimits()
    used = dataset.used
    usual = usual_rows((r.gesture, r.subject, r.stop - r.start) for r in used)
    findings: list[Finding] = []
    summaries: list[RecordingSummary] = []
    streams: list[RecordingSummary] = []
    for info, result, frames in _read(dataset, used, progress):
        examined = _examination(dataset, info, result, frames, usual, limits)
        if not len(examined.frames) and not examined.stream:
            continue
        scope = _S if examined.stream else _R
        for name in checks:
            if not CHECKS[name].compares and scope in CHECKS[name].scope:
                findings += [_finding(issue, name, info) for issue in CHECKS[name].run(examined)]
        (streams if examined.stream else summaries).append(summarize(info, examined.frames, dataset.layout))
    compared = DatasetSummary(dataset, summaries, streams, limits)
    by_id: dict[str, RecordingInfo | StreamInfo] = {s.id: s for s in dataset.streams} | {r.id: r for r in used}
    for name in checks:
        if CHECKS[name].compares:
            findings += [_finding(issue, name, by_id.get(issue.about)) for issue in CHECKS[name].run(compared)]
    marks = read_marks(dataset.path)
    order = list(CHECKS)
    findings = sorted(
        (
            replace(f, accepted=f.about in marks and f.check in marks[f.about].accepted)
            for f in _merge_common(findings, len(summaries))
        ),
        key=lambda f: (SEVERITIES.index(f.severity), order.index(f.check), f.about),
    )
    excluded = len(dataset.recordings) - len(used)
    seconds = time.perf_counter() - began
    return CheckReport(dataset, tuple(findings), len(summaries), excluded, checks, limits, seconds)


def _examination(
    dataset: Dataset,
    info: RecordingInfo | StreamInfo,
    result: ReadResult,
    frames: Frames,
    usual: dict[str, float],
    limits: CheckLimits,
) -> Examination:
    """Return the input of the checks of one recording or stream; ``usual`` holds the usual rows by gesture."""
    if isinstance(info, StreamInfo):
        malformed = result.malformed - result.cut
        return Examination(
            frames, dataset.layout, limits=limits, malformed=malformed, cut=bool(result.cut), stream=True
        )
    own_file = not info.file.startswith("streams/")
    named = parse_name(info.file.rsplit("/", 1)[-1]) if own_file else None
    return Examination(
        frames.slice(info.start, info.stop),
        dataset.layout,
        named.rows if named else None,
        usual[info.gesture] if own_file else None,
        limits,
        first_row=info.start,
        rows_in_file=len(frames),
        malformed=result.malformed if own_file else 0,
    )


def _read(
    dataset: Dataset, used: Sequence[RecordingInfo], progress: Progress | None
) -> Iterator[tuple[RecordingInfo | StreamInfo, ReadResult, Frames]]:
    """Read every raw file once; yield streams, recordings that are parts of streams, and recordings with own files."""
    own = [r for r in used if not r.file.startswith("streams/")]
    infos: list[StreamInfo | RecordingInfo] = [*dataset.streams, *own]
    for done, info in enumerate(infos, 1):
        read = read_stream if isinstance(info, StreamInfo) else read_recording
        result = read(dataset.path / info.file, dataset.layout)
        yield info, result, result.frames
        if isinstance(info, StreamInfo):
            for r in (r for r in used if r.file == info.file):
                yield r, result, result.frames.slice(r.first_row, r.first_row + r.rows)
        if progress is not None:
            progress(done, len(infos))


def _finding(issue: Issue, name: str, info: RecordingInfo | StreamInfo | None) -> Finding:
    check = CHECKS[name]
    return Finding(
        recording=info.id if isinstance(info, RecordingInfo) else "",
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


def _merge_common(findings: list[Finding], recordings: int) -> Iterator[Finding]:
    """Yield the findings; those of a check that concerns nearly every recording are merged into one of the data set."""
    concerned = Counter(check for check, _ in {(f.check, f.recording) for f in findings if f.recording})
    common = {c for c, n in concerned.items() if n >= _MANY and n > _NEARLY_ALL * recordings}
    yield from (f for f in findings if f.check not in common or not (f.recording or f.stream))
    for check in sorted(common):
        first = next(f for f in findings if f.check == check and f.recording)
        yield Finding(
            check=check,
            severity=min((f.severity for f in findings if f.check == check), key=SEVERITIES.index),
            message=Message(
                "so in {n} of {of} recordings, for instance {recording}: {message}",
                n=concerned[check],
                of=recordings,
                recording=first.recording,
                message=first.message,
            ),
            action=first.action,
        )


def author_name(who: str | None) -> str:
    """Return the name of the person who makes a mark: ``who``, by default the login name.

    Raises:
        ConfigError: if both are missing.
    """
    try:
        return who or getpass.getuser()
    except (OSError, KeyError, ImportError):
        raise ConfigError("This computer gives no login name: name the person who decides with --who NAME.") from None


def exclusions(
    dataset: Dataset, exclude: Sequence[str], include: Sequence[str], findings: Sequence[Finding], *, who: str, why: str
) -> list[Mark]:
    """Return marks for the recordings to exclude or include, given as ids or patterns.

    ``CHECK:PATTERN`` in ``exclude`` means those of which ``findings`` has one of the check that is not accepted.
    """
    known = [r.id for r in dataset.recordings]
    marks = []
    for entry in exclude:
        check, pattern = parse_acceptance(entry) if ":" in entry else ("", entry)
        found = [f.recording for f in findings if f.check == check and f.recording and not f.accepted]
        kind = f"recording with a finding of '{check}'" if check else "recording"
        marks += [Mark(i, "exclude", who, why) for i in match_ids(pattern or "*", found if check else known, kind)]
    return marks + [Mark(i, "include", who, why) for entry in include for i in match_ids(entry, known, "recording")]


def parse_acceptance(text: str) -> tuple[str, str]:
    """Split ``CHECK:PATTERN``; the pattern is "" if there is none. Raise ConfigError for an unknown check."""
    check, _, pattern = text.partition(":")
    known_checks([check])
    return check, pattern


def acceptances(checked: CheckReport, accept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Return marks that accept findings, given as ``CHECK:PATTERN``; the pattern matches recordings, streams or people.

    Raises:
        DatasetError: if there is no such finding. Accepting in advance would hide a later fault.
    """
    marks = []
    for entry in accept:
        check, pattern = parse_acceptance(entry)
        present = {f.about: f for f in checked.findings_of(check)}
        if not present:
            raise DatasetError(f"The check '{check}' found nothing, so there is nothing to accept.")
        ids = [""] if not pattern and "" in present else match_ids(pattern, present, f"finding of '{check}' about")
        marks += [Mark(i, "accept", who, why, check=check) for i in ids]
    return marks


def withdrawals(dataset: Dataset, unaccept: Sequence[str], *, who: str, why: str) -> list[Mark]:
    """Return marks that undo acceptances (``CHECK:PATTERN``); raise DatasetError if no such finding is accepted."""
    marks = []
    standing = read_marks(dataset.path)
    for entry in unaccept:
        check, pattern = parse_acceptance(entry)
        accepted = [i for i, mark in standing.items() if check in mark.accepted]
        if not accepted:
            raise DatasetError(f"No finding of '{check}' is accepted, so there is nothing to withdraw.")
        all_of_it = not pattern and "" in accepted
        ids = [""] if all_of_it else match_ids(pattern, accepted, f"accepted finding of '{check}' on")
        marks += [Mark(i, "unaccept", who, why, check=check) for i in ids]
    return marks
