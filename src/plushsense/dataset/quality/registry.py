"""Registry of all quality checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from plushsense.dataset.quality import comparisons, recordings
from plushsense.dataset.quality.findings import Issue, Severity
from plushsense.dataset.quality.measurements import DatasetSummary, Examination

ExaminationCheck = Callable[[Examination], Iterator[Issue]]
ComparisonCheck = Callable[[DatasetSummary], Iterator[Issue]]


@dataclass(frozen=True)
class Check:
    """A quality check.

    ``scope`` lists what its findings are about: recording, stream, subject, dataset. ``examine`` looks at one recording
    or stream at a time, ``compare`` at all of them. With ``at_import`` it also runs at every import, and its messages
    become flags of the index. ``stream_action`` replaces ``action`` for a stream.
    """

    scope: tuple[str, ...]
    severity: Severity
    action: str
    examine: ExaminationCheck | None = None
    compare: ComparisonCheck | None = None
    at_import: bool = False
    stream_action: str = ""


_R, _S, _P, _D = "recording", "stream", "subject", "dataset"
_LOOK = "look at its plot; trim or exclude it, or accept"
_TO_ONE = "trim it to one gesture, or exclude it"
_SENSOR = "check the sensor; exclude it if the gesture is hit"
_RADIO = "check cable and radio; exclude it if the gesture is hit"
_ANEW = "nothing: readers start anew there"
_LEFT_OUT = "nothing: that line is left out"

CHECKS: dict[str, Check] = {
    "never-stopped": Check(
        (_R,), "error", "trim it to the gesture, or exclude it", recordings.never_stopped, at_import=True
    ),
    "duration": Check((_R,), "warning", _LOOK, compare=comparisons.duration),
    "no-onset": Check(
        (_R,), "warning", "look whether the gesture was made; exclude it if not", compare=comparisons.no_onset
    ),
    "several-gestures": Check((_R,), "warning", _TO_ONE, compare=comparisons.several_gestures),
    "clock-reset": Check(
        (_R, _S), "error", "trim it to one side, or exclude it", recordings.clock_reset, None, True, _ANEW
    ),
    "gaps": Check(
        (_R, _S), "warning", "exclude it if the gesture is hit, or accept", recordings.gaps, None, True, _ANEW
    ),
    "lost-frames": Check((_R, _S), "warning", _RADIO, recordings.lost_frames),
    "rate": Check(
        (_R, _S), "warning", "check firmware and layout; training resamples it", recordings.rate, at_import=True
    ),
    "jitter": Check((_R, _S), "info", "nothing: the clock rule evens it out", recordings.jitter),
    "resumed": Check((_S,), "warning", _ANEW, recordings.resumed, at_import=True),
    "cut-line": Check((_S,), "info", _LEFT_OUT, recordings.cut_line),
    "malformed": Check((_R, _S), "info", _LEFT_OUT, recordings.malformed),
    "rows": Check(
        (_R,), "warning", "compare with the original file, or accept", recordings.rows_against_name, at_import=True
    ),
    "garbage": Check((_R, _S), "warning", _SENSOR, recordings.garbage, at_import=True),
    "blank-rows": Check((_R, _S), "warning", _SENSOR, recordings.blank_rows),
    "spikes": Check((_R,), "warning", _SENSOR, recordings.spikes),
    "flat": Check((_R, _S, _D), "error", "check the sensor's cable; exclude what it spoiled", compare=comparisons.flat),
    "stuck": Check((_R, _S), "warning", _SENSOR, compare=comparisons.stuck),
    "saturated": Check(
        (_R,), "warning", "widen the sensor's range, or accept strong touch", compare=comparisons.saturated
    ),
    "drift": Check((_S, _P), "warning", "let the toy calibrate anew between gestures", compare=comparisons.drift),
    "duplicate": Check((_R, _S), "error", "exclude one of the two", compare=comparisons.duplicate),
    "overlap": Check((_R,), "warning", "trim or exclude one of the two", compare=comparisons.overlap),
    "not-in-stream": Check(
        (_R,), "warning", "check that the stream is this session's", compare=comparisons.not_in_stream
    ),
    "missing": Check(
        (_P,), "warning", "record it if the person is still there, or accept", compare=comparisons.missing
    ),
    "label": Check(
        (_D,), "warning", "give a gesture set that has it, or rename the files", compare=comparisons.unknown_label
    ),
    "class-balance": Check(
        (_D,), "info", "weight the classes, or leave odd ones out", compare=comparisons.class_balance
    ),
    "subject-balance": Check((_D,), "info", "weight the people, or record more", compare=comparisons.subject_balance),
}


def import_flags(examined: Examination) -> list[str]:
    """Return the messages of the import checks about one recording or stream, without those of severity info."""
    scope = _S if examined.stream else _R
    return [
        issue.message
        for check in CHECKS.values()
        if check.at_import and check.examine is not None and scope in check.scope
        for issue in check.examine(examined)
        if (issue.severity or check.severity) != "info"
    ]
