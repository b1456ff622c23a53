"""The table of all checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from plushsense.dataset.quality import compared, content, counted, timing
from plushsense.dataset.quality.examined import Examined
from plushsense.dataset.quality.finding import Said, Severity
from plushsense.dataset.quality.outline import Whole

EachLook = Callable[[Examined], Iterator[Said]]
WholeLook = Callable[[Whole], Iterator[Said]]


@dataclass(frozen=True)
class Check:
    """One check.

    ``scope``: what it is about: recording, stream, subject, dataset. ``each`` looks at one recording or stream at a
    time, ``whole`` compares all. ``door``: cheap enough for every import, where what it says becomes a flag.
    ``stream_action``: what to do about a stream, where that is something else.
    """

    scope: tuple[str, ...]
    severity: Severity
    action: str
    each: EachLook | None = None
    whole: WholeLook | None = None
    door: bool = False
    stream_action: str = ""


_R, _S, _P, _D = "recording", "stream", "subject", "dataset"
_LOOK = "look at its plot; trim or exclude it, or accept"
_TO_ONE = "trim it to one gesture, or exclude it"
_SENSOR = "check the sensor; exclude it if the gesture is hit"
_RADIO = "check cable and radio; exclude it if the gesture is hit"
_ANEW = "nothing: readers start anew there"
_LEFT_OUT = "nothing: that line is left out"

CHECKS: dict[str, Check] = {
    "never-stopped": Check((_R,), "error", "trim it to the gesture, or exclude it", content.never_stopped, door=True),
    "duration": Check((_R,), "warning", _LOOK, whole=compared.duration),
    "no-onset": Check(
        (_R,), "warning", "look whether the gesture was made; exclude it if not", whole=compared.no_onset
    ),
    "several-gestures": Check((_R,), "warning", _TO_ONE, whole=compared.several_gestures),
    "clock-reset": Check(
        (_R, _S), "error", "trim it to one side, or exclude it", timing.clock_reset, None, True, _ANEW
    ),
    "gaps": Check((_R, _S), "warning", "exclude it if the gesture is hit, or accept", timing.gaps, None, True, _ANEW),
    "lost-frames": Check((_R, _S), "warning", _RADIO, timing.lost_frames),
    "rate": Check((_R, _S), "warning", "check firmware and layout; training resamples it", timing.rate, door=True),
    "jitter": Check((_R, _S), "info", "nothing: the clock rule evens it out", timing.jitter),
    "resumed": Check((_S,), "warning", _ANEW, timing.resumed, door=True),
    "cut-line": Check((_S,), "info", _LEFT_OUT, content.cut_line),
    "malformed": Check((_R, _S), "info", _LEFT_OUT, content.malformed),
    "rows": Check((_R,), "warning", "compare with the original file, or accept", content.rows_against_name, door=True),
    "garbage": Check((_R, _S), "warning", _SENSOR, content.garbage, door=True),
    "blank-rows": Check((_R, _S), "warning", _SENSOR, content.blank_rows),
    "spikes": Check((_R,), "warning", _SENSOR, content.spikes),
    "flat": Check((_R, _S, _D), "error", "check the sensor's cable; exclude what it spoiled", whole=compared.flat),
    "stuck": Check((_R, _S), "warning", _SENSOR, whole=compared.stuck),
    "saturated": Check((_R,), "warning", "widen the sensor's range, or accept strong touch", whole=compared.saturated),
    "drift": Check((_S, _P), "warning", "let the toy calibrate anew between gestures", whole=compared.drift),
    "duplicate": Check((_R, _S), "error", "exclude one of the two", whole=counted.duplicate),
    "overlap": Check((_R,), "warning", "trim or exclude one of the two", whole=counted.overlap),
    "not-in-stream": Check((_R,), "warning", "check that the stream is this session's", whole=counted.not_in_stream),
    "missing": Check((_P,), "warning", "record it if the person is still there, or accept", whole=counted.missing),
    "label": Check(
        (_D,), "warning", "give a gesture set that has it, or rename the files", whole=counted.unknown_label
    ),
    "class-balance": Check((_D,), "info", "weight the classes, or leave odd ones out", whole=counted.class_balance),
    "subject-balance": Check((_D,), "info", "weight the people, or record more", whole=counted.subject_balance),
}


def findings(examined: Examined) -> list[str]:
    """What the checks of the door say of one recording or stream: faults, not notes."""
    scope = _S if examined.stream else _R
    return [
        said.message
        for check in CHECKS.values()
        if check.door and check.each is not None and scope in check.scope
        for said in check.each(examined)
        if (said.severity or check.severity) != "info"
    ]
