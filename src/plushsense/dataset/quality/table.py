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
    """

    scope: tuple[str, ...]
    severity: Severity
    action: str
    each: EachLook | None = None
    whole: WholeLook | None = None
    door: bool = False


_R, _S, _P, _D = "recording", "stream", "subject", "dataset"
_LOOK = "look at the plot; trim or exclude it, or accept"

CHECKS: dict[str, Check] = {
    "never-stopped": Check(
        (_R,), "error", "trim it to the gesture, or exclude it", each=content.never_stopped, door=True
    ),
    "duration": Check((_R,), "warning", _LOOK, whole=compared.duration),
    "no-onset": Check(
        (_R,), "warning", "look whether the gesture was made; exclude it if not", whole=compared.no_onset
    ),
    "several-gestures": Check(
        (_R,), "warning", "trim it to one gesture, or exclude it", whole=compared.several_gestures
    ),
    "clock-reset": Check(
        (_R, _S), "error", "trim it to one side of the reset, or exclude it", each=timing.clock_reset, door=True
    ),
    "gaps": Check((_R, _S), "warning", "look whether the gesture is hit; exclude it or accept", timing.gaps, door=True),
    "lost-frames": Check(
        (_R, _S), "warning", "check cable and radio; exclude it if the gesture is hit", timing.lost_frames
    ),
    "rate": Check((_R, _S), "warning", "check firmware and layout; training resamples it", timing.rate, door=True),
    "jitter": Check((_R, _S), "info", "nothing: the clock rule evens it out", timing.jitter),
    "resumed": Check((_S,), "warning", "nothing: what comes after counts as a new start", timing.resumed, door=True),
    "cut-line": Check((_S, _R), "info", "nothing: that line is left out", content.cut_line),
    "malformed": Check((_S, _R), "info", "nothing: these lines are left out", content.malformed),
    "rows": Check(
        (_R,),
        "warning",
        "compare with the original file; accept if it was trimmed",
        content.rows_against_name,
        door=True,
    ),
    "garbage": Check(
        (_R, _S), "warning", "check the sensor; exclude it if the gesture is hit", content.garbage, door=True
    ),
    "blank-rows": Check((_R, _S), "warning", "check the sensor; exclude it if the gesture is hit", content.blank_rows),
    "flat": Check(
        (_R, _S, _D), "error", "check the sensor's cable; exclude what was recorded with it", whole=compared.flat
    ),
    "stuck": Check((_R, _S), "warning", "check the sensor; exclude it if the gesture is hit", whole=compared.stuck),
    "saturated": Check(
        (_R,), "warning", "check the sensor's range; accept if the touch was that strong", whole=compared.saturated
    ),
    "drift": Check(
        (_S, _P), "warning", "calibrate anew between gestures; training may need a baseline", whole=compared.drift
    ),
    "duplicate": Check((_R, _S), "error", "exclude one of the two", whole=counted.duplicate),
    "overlap": Check((_R,), "warning", "trim or exclude one of the two", whole=counted.overlap),
    "not-in-stream": Check((_R,), "warning", "check that the stream is this session's", whole=counted.not_in_stream),
    "missing": Check(
        (_P,), "warning", "record it again if the person is there; else accept", whole=counted.missing_repetitions
    ),
    "label": Check(
        (_D,), "warning", "correct the file's label, or give a gesture set that has it", whole=counted.unknown_label
    ),
    "class-balance": Check((_D,), "info", "weight classes, or leave the odd ones out", whole=counted.class_balance),
    "subject-balance": Check((_D,), "info", "weight people, or record more", whole=counted.subject_balance),
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
