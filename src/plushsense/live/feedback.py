"""Corrections of reported events by a person ("that was wrong"), and the dense layer that follows from them.

A correction keeps the rows of the stream in which the event was reported, with the `LEAD_S` seconds before them, so
that the network can be computed on them again. Corrections of one person are appended to one file, a JSON object a
line; nothing else reads or changes it.

`correct` fits the dense layer again, as a maximum a posteriori estimate under a Gaussian prior around its weights (as
in `plushsense.live.adaptation`). Each correction weighs 1, shared by the steps of its event. Where the event was wrong,
the target of a step is the network's own answer without the reported gesture; where the right gesture was named, it is
that gesture. Only NumPy is needed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from plushsense.core.errors import BadInput, BundleError, DatasetError, nearest
from plushsense.core.files import check_output_file, write_file
from plushsense.core.recorder_csv import Frames
from plushsense.core.toml import loads_json
from plushsense.live.adaptation import DENSE, Examples, Floats, judge, with_one
from plushsense.models.bundle import Bundle
from plushsense.models.reference import softmax
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import NO_GESTURE
from plushsense.runtime.trace import ReportedEvent, TraceReplayer, trace_of
from plushsense.windows.clock import row_times_us

FOLDER = "feedback"
"""Name of the folder in the studio's home that holds a file of corrections for each person."""
LEAD_S = 8.0
"""Seconds kept before an event: the span of the network, and time for the running mean of gravity."""
STRENGTH = 10.0
"""Penalty of the squared distance from the weights before. Chosen on the validation people of makeability
(by-subject:5, seeds 0 and 1): with 10, three corrections more than halve the false events of the gesture; with 15 they
do not, and the recall falls as much."""
_ITERATIONS = 400


@dataclass(frozen=True, eq=False)
class Correction:
    """A reported event that a person marked as wrong.

    Attributes:
        gesture: label that was reported; ``right`` is the label of the gesture that was really made, "" for none.
        begun_s, ended_s: when the gesture was reported and when the event ended, in seconds since the first of
            ``frames``.
        channels: names of the channels of ``frames``.
        when: date and time of the mark, in ISO 8601.
    """

    subject: str
    gesture: str
    right: str
    begun_s: float
    ended_s: float
    channels: tuple[str, ...]
    frames: Frames
    when: str = ""

    def to_line(self) -> str:
        """Return the correction as a line of a file."""
        rows = np.column_stack([self.frames.device_ms, self.frames.values]).tolist()
        table = {key: value for key, value in vars(self).items() if key != "frames"}
        return json.dumps({**table, "channels": list(self.channels), "rows": rows}, ensure_ascii=False) + "\n"

    @classmethod
    def from_line(cls, line: str) -> Correction:
        """Restore a correction from `to_line`; raise ValueError, TypeError, KeyError or OverflowError if not."""
        table = loads_json(line)
        rows = np.array(table.pop("rows"), dtype=np.int64).reshape(-1, 1 + len(table["channels"]))
        found = cls(**{**table, "channels": tuple(table["channels"])}, frames=Frames(rows[:, 1:], rows[:, 0]))
        if not 0.0 <= found.begun_s <= found.ended_s:
            raise ValueError("times")
        return found


def events_of(bundle: Bundle, frames: Frames) -> list[ReportedEvent]:
    """Return the events that a bundle reports on a stream, with its own decision settings."""
    return TraceReplayer(trace_of(frames, bundle)).events(DecideSpec.from_dict(bundle.decision))


def correction_of(bundle: Bundle, frames: Frames, event: ReportedEvent, *, subject: str, right: str = "") -> Correction:
    """Cut the rows of a reported event from its stream.

    Args:
        frames: the stream on which ``event`` was reported.
        right: label of the gesture that was really made; "" if none was, or it is not known.

    Raises:
        BadInput: if the event has no gesture, or ``right`` is no other gesture of the bundle.
    """
    if event.gesture == NO_GESTURE:
        raise BadInput(
            f"The event at {event.start_s:.1f} s names no gesture, only an affect: there is nothing to correct."
        )
    gesture = bundle.gestures.labels[event.gesture]
    return cut_correction(bundle, frames, gesture, event.named_s, event.stop_s, subject=subject, right=right)


def cut_correction(
    bundle: Bundle, frames: Frames, gesture: str, begun_s: float, ended_s: float, *, subject: str, right: str = ""
) -> Correction:
    """Cut the rows of an event, and the `LEAD_S` before them, from a stream.

    The event is taken to last at least two steps, so that the network answers in it.

    Args:
        frames: the stream, or the part of it that is still kept.
        gesture: label that was reported from ``begun_s`` to ``ended_s``, in seconds since the first of ``frames``.
        right: as in `correction_of`.

    Raises:
        BadInput: if ``right`` is no other gesture of the bundle, or no rows are left.
    """
    labels = bundle.gestures.labels
    if right and right not in labels:
        raise BadInput(f"The bundle has no gesture '{right}': it has {', '.join(labels)}.{nearest(right, labels)}")
    if right == gesture:
        message = f"The event was reported as '{right}' already: choose what it really was."
        raise BadInput(message, reason="mark_same", gesture=right)
    begun_s = min(begun_s, ended_s - 2 * bundle.arch.step * bundle.layout.period_us / 1e6)
    passed_s = row_times_us(frames, bundle.layout) / 1e6
    first, last = np.searchsorted(passed_s, (begun_s - LEAD_S, ended_s + 1e-6)).tolist()
    if first == last:
        message = f"The rows of the event '{gesture}' are not kept any more: mark an event soon after it."
        raise BadInput(message, reason="event_not_kept")
    zero_s = float(passed_s[first])
    return Correction(
        subject,
        gesture,
        right,
        round(max(0.0, begun_s - zero_s), 3),
        round(max(0.0, ended_s - zero_s), 3),
        bundle.layout.names,
        Frames(frames.values[first:last], frames.device_ms[first:last]),
        datetime.now(timezone.utc).isoformat(timespec="seconds"),
    )


def check_corrections_path(path: str | os.PathLike[str]) -> None:
    """Raise BadInput if corrections cannot be appended to a file, or it is one of another kind."""
    check_output_file(Path(path), '{"subject": ', "a file of corrections", BadInput, append=True)


def append_corrections(path: str | os.PathLike[str], corrections: Sequence[Correction]) -> None:
    """Append corrections to a file, which is created if it is missing, readable by its owner only.

    Raises:
        BadInput: if the file cannot be written, or is one of another kind.
    """
    check_corrections_path(path)
    lines = "".join(c.to_line() for c in corrections)
    try:
        with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600), "r+b") as file:
            # An incomplete last line must not merge with the next correction.
            if file.seek(0, os.SEEK_END) > 0:
                file.seek(-1, os.SEEK_END)
                lines = lines if file.read(1) == b"\n" else "\n" + lines
            file.write(lines.encode())
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written: {cause.strerror or cause}.") from None


def read_corrections(path: str | os.PathLike[str]) -> list[Correction]:
    """Read the corrections of a file; a line that is not JSON (cut off by a crash) is skipped.

    Raises:
        DatasetError: if the file cannot be read, or a line of it is no correction.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as cause:
        message = f"'{path}' cannot be read ({cause}): give a file that plushsense feedback wrote."
        raise DatasetError(message, reason="no_marks") from None
    found = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            found.append(Correction.from_line(line))
        except json.JSONDecodeError:
            continue
        except (ValueError, TypeError, KeyError, OverflowError):
            raise DatasetError(
                f"'{path}' line {number} is no correction: give a file that plushsense feedback wrote."
            ) from None
    if not found:
        message = f"'{path}' holds no correction: make some with plushsense feedback."
        raise DatasetError(message, reason="no_marks")
    return found


def remove_last_correction(path: str | os.PathLike[str]) -> bool:
    """Remove the last line of a file of corrections, and the file with its only line; return whether there was one.

    Raises:
        BadInput: if the file cannot be read or written.
    """
    try:
        lines = Path(path).read_bytes().splitlines(keepends=True)
        if len(lines) > 1:
            write_file(Path(path), b"".join(lines[:-1]), private=True)
        else:
            Path(path).unlink()
    except FileNotFoundError:
        return False
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written: {cause.strerror or cause}.") from None
    return True


@dataclass(frozen=True, eq=False)
class Corrected:
    """Result of `correct`: ``bundle`` is the corrected one, or the given one if ``accepted`` is false.

    ``before`` and ``after`` are the mean probability of a wrong answer in the events: of the reported gesture or, where
    the right one was named, of any other. ``reason`` explains the decision as text; ``refusal`` is "" if it is
    accepted, else "no_fall", "nothing_in_common" or "fewer_right".
    """

    bundle: Bundle
    accepted: bool
    reason: str
    corrections: int
    before: float
    after: float
    refusal: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return {key: value for key, value in vars(self).items() if key not in ("bundle", "refusal")}


def correct(
    bundle: Bundle, corrections: Sequence[Correction], own: Examples | None = None, strength: float = STRENGTH
) -> Corrected:
    """Fit the dense layer of a bundle to corrections, or return the bundle unchanged if that does not help.

    Corrections of an earlier call are replaced. It does not help if the probability of a wrong answer in the events
    does not fall, also when an event is left out of the fit, or if fewer of the person's own recordings are read right
    than before.

    Args:
        corrections: of one person.
        own: recordings of the person.

    Raises:
        BadInput: for corrections of several people or of other sensors, of a gesture that the bundle does not have, or
            in which the network gives no answer.
        BundleError: for a bundle that was adapted to somebody else.
    """
    subject = _subject_of(bundle, corrections)
    table = dict(bundle.personal)
    start = table.get("uncorrected") or {name: np.asarray(bundle.weights[name]).tolist() for name in DENSE}
    weight, bias = (np.array(start[name], dtype=np.float64) for name in DENSE)
    layer = np.concatenate([weight, bias[:, None]], axis=1)
    marks = [with_one(_features(bundle, c)) for c in corrections]
    reported = [bundle.gestures.index(c.gesture) for c in corrections]
    targets = [_target(layer, x, bundle, c) for x, c in zip(marks, corrections, strict=True)]
    fitted = _fit(layer, marks, targets, strength)

    def wrong(rows: Floats, at: int) -> float:
        """Return the mean probability of the reported gesture, or of any other than the right one, in an event."""
        shares = softmax(marks[at] @ rows.T)
        right = corrections[at].right
        wrong = 1.0 - shares[:, bundle.gestures.index(right)] if right else shares[:, reported[at]]
        return float(wrong.mean())

    everything = range(len(marks))
    before = float(np.mean([wrong(layer, at) for at in everything]))
    after = float(np.mean([wrong(fitted, at) for at in everything]))
    figures = (
        f"the probability of a wrong answer is {after:.2f} instead of {before:.2f} in {len(marks)} "
        f"event{'s' if len(marks) > 1 else ''} that {'were' if len(marks) > 1 else 'was'} corrected"
    )
    refusal = why = ""
    if after >= before:
        refusal, why = "a wrong answer would not become less likely", "no_fall"
    elif len(marks) > 1:
        others = [[n for n in everything if n != at] for at in everything]
        left_out = [
            wrong(_fit(layer, [marks[n] for n in rest], [targets[n] for n in rest], strength), at)
            for at, rest in zip(everything, others, strict=True)
        ]
        if np.mean(left_out) >= before:
            refusal = "the corrections have nothing in common: each becomes more likely if it is left out"
            why = "nothing_in_common"
    if own is not None and not refusal:
        one, other = (
            judge(softmax(with_one(own.features) @ r.T), own.y, own.recording).scores for r in (layer, fitted)
        )
        figures += f"; of {one.recordings} own recordings {other.right} instead of {one.right} are read right"
        if other.right < one.right:
            refusal, why = "fewer of the person's own recordings would be read right", "fewer_right"
    if refusal:
        return Corrected(bundle, False, f"{refusal}: {figures}", len(marks), before, after, why)
    dense = dict(zip(DENSE, (fitted[:, :-1], fitted[:, -1]), strict=True))
    table |= {"subject": subject, "corrections": len(marks), "uncorrected": start}
    table.setdefault("original", start)
    weights = {**bundle.weights, **{name: part.astype(np.float32) for name, part in dense.items()}}
    return Corrected(replace(bundle, weights=weights, personal=table), True, figures, len(marks), before, after)


def _subject_of(bundle: Bundle, corrections: Sequence[Correction]) -> str:
    people = sorted({c.subject for c in corrections})
    if len(people) != 1:
        raise BadInput(f"The corrections are of {', '.join(people) or 'nobody'}: give those of one person.")
    if bundle.adapted_to not in (None, people[0]):
        raise BundleError(
            f"The bundle was adapted to {bundle.adapted_to}, the corrections are of {people[0]}: give a bundle that "
            "was not adapted, or undo it first (plushsense adapt BUNDLE --undo).",
            reason="adapted_to_other",
            other=bundle.adapted_to,
            subject=people[0],
        )
    for c in corrections:
        if c.channels != bundle.layout.names:
            raise BadInput(
                f"The corrections have the channels {', '.join(c.channels)}, the bundle reads "
                f"{', '.join(bundle.layout.names)}: give corrections of the same sensors."
            )
        for label in (c.gesture, *([c.right] if c.right else [])):
            if label not in bundle.gestures.labels:
                raise BadInput(
                    f"The bundle has no gesture '{label}', which a correction names; it has "
                    f"{', '.join(bundle.gestures.labels)}.{nearest(label, bundle.gestures.labels)}"
                )
    return people[0]


def _features(bundle: Bundle, correction: Correction) -> Floats:
    """Return the inputs of the dense layer (n, F) at the steps of the event of a correction."""
    arch = bundle.arch
    trace = trace_of(correction.frames, bundle)
    windows = []
    for part in trace.parts:
        times_s = trace.step_times_us(part) / 1e6
        for step in np.flatnonzero((times_s >= correction.begun_s) & (times_s <= correction.ended_s)).tolist():
            windows.append(part.inputs[step * arch.step : step * arch.step + arch.span].T)
    if not windows:
        raise BadInput(
            f"The network gives no answer during the event '{correction.gesture}' that was marked at "
            f"{correction.when or 'an unknown time'}: the rows before it are missing. Leave that line out."
        )
    return bundle.network().features(bundle.scaler.apply(np.stack(windows)))


def _target(layer: Floats, x: Floats, bundle: Bundle, correction: Correction) -> Floats:
    """Return the probabilities (n, K) that the corrected layer should give at the steps ``x`` (n, F + 1)."""
    gestures = bundle.gestures
    if correction.right:
        return np.repeat(np.eye(len(gestures))[gestures.index(correction.right)][None], len(x), axis=0)
    target = softmax(x @ layer.T)
    target[:, gestures.index(correction.gesture)] = 0.0
    return np.asarray(target / np.maximum(target.sum(axis=1, keepdims=True), 1e-12))


def _fit(start: Floats, marks: Sequence[Floats], targets: Sequence[Floats], strength: float) -> Floats:
    """Return the layer (K, F + 1) of least cross-entropy to the targets, plus half the penalty.

    The steps have a fixed upper bound of the Hessian (Böhning 1992) and Nesterov momentum, restarted if it points
    uphill.
    """
    x, y = np.concatenate(marks), np.concatenate(targets)
    weights = np.concatenate([np.full(len(m), 1.0 / len(m)) for m in marks])[:, None]
    inverse = np.linalg.inv(0.5 * (x * weights).T @ x + strength * np.eye(x.shape[1]))
    rows = ahead = start
    momentum = 1.0
    for _ in range(_ITERATIONS):
        gradient = ((softmax(x @ ahead.T) - y) * weights).T @ x + strength * (ahead - start)
        updated = ahead - gradient @ inverse
        step = updated - rows
        momentum = 1.0 if float((gradient * step).sum()) > 0 else momentum
        following = (1.0 + np.sqrt(1.0 + 4.0 * momentum * momentum)) / 2.0
        rows, ahead, momentum = updated, updated + (momentum - 1.0) / following * step, following
        if float(np.abs(step).max()) < 1e-9:
            break
    return rows
