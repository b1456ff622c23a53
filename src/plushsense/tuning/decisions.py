"""Fit decision settings on people to whom the network's weights were not fitted.

This covers all settings between network and events, on training people only: event settings by a search over traces
(`plushsense.tuning.events`), the conformal threshold and the threshold for known gestures on recordings of the same
people, and the limits of the sensors (`fit_health`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.core.row_times import kept_rows
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import ONE
from plushsense.runtime.fixed import Ints, integer_logits, known_score, smoothing_weight, softmax
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.trace import trace_of
from plushsense.scoring.events import ErrorCosts
from plushsense.tuning.events import OTHER, MarkedStream, Truth, tune
from plushsense.tuning.gate import fit_gate
from plushsense.windows.clock import row_times_us
from plushsense.windows.cut import cut_windows, whole_gestures

_MARGIN = 0.1  # of the range of the data
_SAFETY = 2  # fault_ms is at least this many times the longest duration in the data
_STILL_SAFETY = 4  # and still_ms this many times
_STILL_MS = 500
_QUIET_SHARE = 0.1  # of the people; if more of them had a sensor still for _STILL_MS, it is one that rests at one value
_STILL_MOST_MS = 10_000
_INT32 = -(1 << 31), (1 << 31) - 1

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class HealthFit:
    """Fitted ``settings`` and the amount of data; ``widened`` names channels whose limits had to be moved outwards."""

    settings: HealthSettings
    frames: int
    seconds: float
    widened: tuple[str, ...]
    still_ms: int

    def to_json(self) -> dict[str, object]:
        """Return what a bundle keeps of the fit."""
        hours = round(self.seconds / 3600, 3)
        return {"hours": hours, "end_stops": list(self.widened), "longest_still_ms": self.still_ms}


def fit_health(dataset: Dataset, subjects: Iterable[str], settings: HealthSettings | None = None) -> HealthFit:
    """Fit limits with which the sensors of ``subjects`` are never at fault.

    A channel's limits are the lowest and the highest valid value in the data, moved outwards by a tenth of the range
    between them. If such a limit is not within the valid range, touch can saturate the sensor; the limit is then one
    step inside the extreme value, because touch saturates it only for a few frames and a broken sensor permanently. If
    values beyond the limits were repeated for half of ``fault_ms``, the limits are moved to include them. ``still_ms``
    is four times the longest time in which all channels repeated, at least 500 ms. Above 10 s the rule is disabled; so
    it is if they repeated for 500 ms with more than a tenth of the people: at rest such quiet sensors repeat for ever.

    Args:
        settings: those from which ``fault_ms`` and ``recover_ms`` are taken.
    """
    settings = settings or HealthSettings()
    layout = dataset.layout
    everybody = ([f for f in dataset.read_people([subject]) if len(f)] for subject in sorted(set(subjects)))
    people = [[f.take(kept_rows(f.device_ms, layout.gap_ms)) for f in person] for person in everybody if person]
    parts = [f for person in people for f in person]
    if not parts:
        return HealthFit(settings, 0, 0.0, (), 0)
    values = np.concatenate([f.values for f in parts])
    valid = np.stack([np.maximum(layout.valid_min_int, _INT32[0]), np.minimum(layout.valid_max_int, _INT32[1])])
    valid = valid.astype(np.int64)
    low, high = (edge.copy() for edge in valid)
    for c in range(values.shape[1]):
        channel = values[:, c]
        channel = channel[(channel >= valid[0, c]) & (channel <= valid[1, c])]
        if len(channel):
            first, last = int(channel.min()), int(channel.max())
            margin = int(np.ceil(_MARGIN * (last - first)))
            inside = 1 if last - first > 1 else 0
            low[c] = first - margin if first - margin > valid[0, c] else first + inside
            high[c] = last + margin if last + margin < valid[1, c] else last - inside
    usual = low.copy(), high.copy()
    for frames in parts:
        for rows, wrong in _long_wrong(frames, usual, valid, settings.fault_ms / _SAFETY, layout.gap_ms):
            low = np.minimum(low, np.where(wrong, rows, low).min(axis=0))
            high = np.maximum(high, np.where(wrong, rows, high).max(axis=0))
    moved = (low != usual[0]) | (high != usual[1])
    widened = [name for name, other in zip(layout.names, moved.tolist(), strict=True) if other]
    still = [max(_longest_still(f, layout.gap_ms) for f in person) for person in people]
    fitted = replace(settings, low=tuple(low.tolist()), high=tuple(high.tolist()), still_ms=_still_ms(still))
    steps = [np.diff(f.device_ms) for f in parts]
    passed_ms = sum(int(s[(s > 0) & (s <= layout.gap_ms)].sum()) for s in steps)
    return HealthFit(fitted, len(values), passed_ms / 1000, tuple(widened), max(still))


def _runs(at: Bools) -> list[tuple[int, int]]:
    """Return the indices (first, last) of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], at, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _repeats(values: NDArray[np.int64], ms: NDArray[np.int64], gap_ms: int) -> Bools:
    """Return which frames (T,) repeat the one before in all channels; False after a gap or a clock reset."""
    out = np.zeros(len(values), dtype=bool)
    step = np.diff(ms)
    out[1:] = (values[1:] == values[:-1]).all(axis=1) & (step >= 0) & (step <= gap_ms)
    return out


def _longest_still(frames: Frames, gap_ms: int) -> int:
    """Return the longest duration in ms of a run of repeats, from the frame that is repeated."""
    ms = frames.device_ms
    return max((int(ms[b] - ms[a - 1]) for a, b in _runs(_repeats(frames.values, ms, gap_ms))), default=0)


def _still_ms(longest: Sequence[int]) -> int:
    """Return the time after which repeats are a fault, or 0 for never, given the longest time of each person."""
    quiet = sum(ms >= _STILL_MS for ms in longest)
    still_ms = max(_STILL_MS, _STILL_SAFETY * max(longest))
    return 0 if quiet > _QUIET_SHARE * len(longest) or still_ms > _STILL_MOST_MS else still_ms


def _long_wrong(
    frames: Frames, usual: tuple[Ints, Ints], valid: Ints, longest_ms: float, gap_ms: int
) -> Iterator[tuple[Ints, NDArray[np.bool_]]]:
    """Yield stretches of at least ``longest_ms`` in which some channel is wrong throughout.

    Yields:
        the frames (n, C) of a stretch, and where in them a channel repeated a valid value beyond the ``usual`` limits.
    """
    x, ms = frames.values, frames.device_ms
    step = np.diff(ms, prepend=ms[:1])
    invalid = (x < valid[0]) | (x > valid[1])
    again = np.zeros(x.shape, dtype=bool)
    again[1:] = (x[1:] == x[:-1]) & ((step[1:] >= 0) & (step[1:] <= gap_ms))[:, None]
    beyond = again & ((x < usual[0]) | (x > usual[1])) & ~invalid
    for a, b in _runs((invalid | beyond).any(axis=1)):
        if ms[b] - ms[a] >= longest_ms:
            yield x[a : b + 1], beyond[a : b + 1]


COVERAGE = 0.9
"""Share of the labelled steps whose set of classes is to hold the true one."""
KNOWN_SHARE = 0.95
"""Share of these steps that are to count as a known gesture."""
FALSE_ALARMS_PER_HOUR = 1.0
# The search uses at most this much of the streams, for which it takes about 15 s.
MOST_SEARCHED_S = 3600.0


@dataclass(frozen=True, eq=False)
class LabelledSteps:
    """Steps (or windows) with known classes, (n,) each.

    ``shares`` (n, K): probabilities in steps of 2^-15; ``known``: known score in steps of 1/256 (both smoothed);
    ``truth``: class index.
    """

    shares: Ints
    known: Ints
    truth: Ints
    person: NDArray[np.str_]
    recording: Ints

    @property
    def of_truth(self) -> Ints:
        """Probabilities (n,) of the true class."""
        return self.shares[np.arange(len(self.truth)), self.truth]

    def take(self, at: NDArray[np.bool_]) -> LabelledSteps:
        """Return the steps at which ``at`` is true."""
        return LabelledSteps(*(getattr(self, f.name)[at] for f in fields(self)))


def fit_decisions(
    bundle: Bundle,
    dataset: Dataset,
    subjects: Iterable[str],
    *,
    training: Iterable[str] = (),
    spec: DecideSpec | None = None,
    keep: Collection[str] = (),
) -> DecideSpec:
    """Fit all decision settings; ``fitted`` of the result describes the data and the outcome.

    - Events: the settings of least cost in the streams of ``subjects`` (`events.tune`).
    - ``sure``: the split-conformal threshold at which the set of classes holds the true one in `COVERAGE` of the
      labelled steps (least ambiguous sets: Sadinle, Lei and Wasserman 2019), with equal
      weights of people and of their recordings; the finite-sample correction counts recordings, because the steps of
      one recording are not independent.
    - ``known_margin``: the smoothed known score that `KNOWN_SHARE` of the same steps reach, without idle gestures.
    - Gate: thresholds for a rate of false alarms on the streams of all people (`gate.fit_gate`).
    - Health: limits with which no sensor of these people is at fault.

    Labelled steps are in the second half of a recording, as in the first half the network still reads earlier samples.

    Args:
        subjects: training people to whom the weights were not fitted.
        training: people to whom they were fitted, who are used for gate and health only.
        spec: start of the search; ``keep`` names the settings not to change.

    Raises:
        DatasetError: when ``subjects`` is empty.
    """
    spec, people = spec or DecideSpec(), sorted(set(subjects))
    if not people:
        raise DatasetError("Decision settings are fitted on people who were held back, and there are none.")
    everybody = sorted({*people, *training})
    health = fit_health(dataset, everybody, spec.health)
    if "health" not in keep:
        spec = replace(spec, health=health.settings)
    gate: dict[str, Any] = {}
    if "gate" not in keep:
        fitted = fit_gate(dataset, bundle.gestures, everybody, false_alarms_per_hour=FALSE_ALARMS_PER_HOUR)
        spec, gate = replace(spec, gate=fitted.settings), {"gate": fitted.report}
    streams = marked_streams(bundle, dataset, people, spec)
    report = {"people": len(people), **_described(streams, bundle.gestures), "simulated": dataset.head.simulated}
    if streams:
        spec, report["events"] = _fit_events(bundle, dataset, streams, spec, keep)
        labelled = labelled_steps(bundle, streams, spec)
    else:
        labelled = labelled_windows(bundle, dataset, people)
        report["events"] = {"on": "nothing: nobody who was held back has a stream", "moved": {}}
    if len(labelled.truth):
        spec = _fit_answers(labelled, spec, bundle.gestures, keep)
        report["answers"] = _answers(labelled, spec, bool(streams))
    report["health"] = {"people": len(everybody), **health.to_json()}
    return replace(spec, fitted=report | gate)


def _described(streams: Sequence[MarkedStream], gestures: GestureSet) -> dict[str, Any]:
    """Return counts of the streams and of the gestures in them."""
    idle = [k for k, gesture in enumerate(gestures.gestures) if gesture.idle]
    return {
        "streams": len(streams),
        "hours": round(sum(h.trace.seconds for h in streams) / 3600, 3),
        "gestures": sum(t.gesture not in (OTHER, *idle) for h in streams for t in h.truths),
    }


def _fit_events(
    bundle: Bundle,
    dataset: Dataset,
    streams: Sequence[MarkedStream],
    spec: DecideSpec,
    keep: Collection[str],
) -> tuple[DecideSpec, dict[str, Any]]:
    """Return the event settings of least cost, and a report on the search."""
    if "known_margin" not in keep:
        labelled = labelled_steps(bundle, streams, spec)
        spec = replace(spec, known_margin=known_threshold(labelled, bundle.gestures, KNOWN_SHARE))
    costs = ErrorCosts()
    if dataset.head.simulated or dataset.layout.is_labelled:
        # Nobody practises there between the marked gestures, so every event outside of them is false.
        costs = replace(costs, unmarked=costs.outside)
    tuned = tune(streams, spec, bundle.gestures, costs, keep)
    report = {
        "on": "streams",
        "cost": _round(tuned.cost),
        "cost_before": _round(tuned.cost_before),
        "tried": tuned.tried,
        "moved": {name: list(values) for name, values in tuned.moved.items()},
    }
    return tuned.spec, report


def _fit_answers(labelled: LabelledSteps, spec: DecideSpec, gestures: GestureSet, keep: Collection[str]) -> DecideSpec:
    """Return the settings with the thresholds for known gestures and for the set of classes."""
    if "known_margin" not in keep:
        spec = replace(spec, known_margin=known_threshold(labelled, gestures, KNOWN_SHARE))
    if "sure" not in keep:
        spec = replace(spec, sure=sure_threshold(labelled, COVERAGE))
    return spec


def _round(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None


def _answers(labelled: LabelledSteps, spec: DecideSpec, steps: bool) -> dict[str, Any]:
    by_person = left_out_coverage(labelled, COVERAGE)
    people = len(set(labelled.person.tolist()))
    return {
        "on": "steps in the second half of a recording" if steps else "windows, not smoothed",
        "coverage": COVERAGE,
        "recordings": len(np.unique(labelled.recording)),
        # Coverage of each person with the threshold fitted to the others, as for a new person.
        "coverage_left_out": _round(float(np.mean(by_person))) if by_person else None,
        "coverage_left_out_worst": _round(min(by_person)) if by_person else None,
        # Largest share of new people for which n people can give a guarantee: n / (n + 1).
        "people_bound": _round(people / (people + 1)),
        "classes_in_set": _round(float((labelled.shares >= spec.sure * ONE).sum(axis=1).mean())),
        "known_share": KNOWN_SHARE,
    }


def marked_streams(
    bundle: Bundle,
    dataset: Dataset,
    subjects: Iterable[str],
    spec: DecideSpec,
) -> list[MarkedStream]:
    """Compute the traces of the streams of some people, with their marked recordings.

    Streams without a marked recording are left out. Of more than an hour, an equal part is used for each person.
    """
    people = set(subjects)
    marked: dict[str, list[RecordingInfo]] = {}
    for r in dataset.recordings:
        if r.stream_row >= 0:
            marked.setdefault(r.stream, []).append(r)
    streams = [s for s in dataset.streams if s.subject in people and s.id in marked]
    share_s = MOST_SEARCHED_S / max(len({s.subject for s in streams}), 1)
    left = {s.subject: round(share_s * dataset.layout.rate_hz) for s in streams}
    out = []
    for stream in streams:
        frames = dataset.read_stream(stream.id)
        frames = frames.slice(0, min(len(frames), left[stream.subject]))
        left[stream.subject] -= len(frames)
        truths = truths_of(frames, marked[stream.id], bundle.gestures, dataset.layout)
        if any(t.gesture != OTHER for t in truths):
            out.append(MarkedStream(stream.subject, trace_of(frames, bundle, spec.health), truths))
    return out


def truths_of(
    frames: Frames, recordings: Sequence[RecordingInfo], gestures: GestureSet, layout: Layout
) -> tuple[Truth, ...]:
    """Return the marked stretches of a stream in order of time; excluded recordings and other gestures are `OTHER`."""
    times = row_times_us(frames, layout)
    out = []
    for r in recordings:
        first, last = r.stream_row + r.start, r.stream_row + r.stop
        if last <= len(times) and first < last:
            known = not r.excluded and r.gesture in gestures.labels
            gesture = gestures.index(r.gesture) if known else OTHER
            out.append(Truth(int(times[first]), int(times[last - 1]), gesture))
    return tuple(sorted(out, key=lambda t: t.start_us))


def labelled_steps(bundle: Bundle, streams: Sequence[MarkedStream], spec: DecideSpec) -> LabelledSteps:
    """Return the steps in the second half of each recording of a known gesture, smoothed according to ``spec``."""
    weight = smoothing_weight(spec.smoothing_s, bundle.arch.step * bundle.layout.period_us / 1e6)
    shares = [np.zeros((0, len(bundle.gestures)), dtype=np.int64)]
    known = [_ints(())]
    truth: list[int] = []
    person: list[str] = []
    recording: list[int] = []
    number = 0
    for h in streams:
        parts = h.replayer.smoothed(weight)
        times = [h.trace.step_times_us(part) for part in h.trace.parts]
        for t in h.truths:
            if t.gesture == OTHER:
                continue
            number += 1
            for part, at in zip(parts, times, strict=True):
                selected = (at >= (t.start_us + t.stop_us) // 2) & (at <= t.stop_us)
                shares.append(part.shares[selected])
                known.append(part.known[selected])
                n = int(selected.sum())
                truth += [t.gesture] * n
                person += [h.person] * n
                recording += [number] * n
    return LabelledSteps(
        np.concatenate(shares), np.concatenate(known), _ints(truth), np.array(person, dtype=np.str_), _ints(recording)
    )


def labelled_windows(bundle: Bundle, dataset: Dataset, subjects: Iterable[str]) -> LabelledSteps:
    """Compute the network on windows of some people's recordings, for data without streams."""
    people = set(subjects)
    recordings = [r for r in dataset.recordings if r.subject in people]
    spec = whole_gestures(bundle.windowing)
    span_s = bundle.arch.span / bundle.layout.rate_hz
    spec = replace(spec, span_s=span_s if span_s > spec.window_s else 0.0)
    try:
        windows = cut_windows(Dataset(dataset.path, dataset.head, recordings, dataset.streams), spec, bundle.gestures)
    except DatasetError:
        empty = np.zeros((0, len(bundle.gestures)), dtype=np.int64)
        return LabelledSteps(empty, _ints(()), _ints(()), np.zeros(0, dtype=np.str_), _ints(()))
    logits = integer_logits(bundle.network().forward(bundle.scaler.apply(windows.integers)))
    shares = softmax(logits)
    known = known_score(logits, np.array([g.idle for g in bundle.gestures.gestures]))
    return LabelledSteps(shares, known, windows.y, windows.subject, windows.recording)


def _ints(values: Sequence[int]) -> Ints:
    return np.array(values, dtype=np.int64)


def weights_of(labelled: LabelledSteps) -> NDArray[np.float64]:
    """Return weights (n,) that sum to 1, equal for all people and for all recordings of a person."""
    weight = np.zeros(len(labelled.truth))
    people = np.unique(labelled.person)
    for person in people:
        selected = labelled.person == person
        recordings = np.unique(labelled.recording[selected])
        for recording in recordings:
            at = selected & (labelled.recording == recording)
            weight[at] = 1.0 / (len(people) * len(recordings) * at.sum())
    return weight


def _threshold(scores: Ints, labelled: LabelledSteps, share: float) -> int:
    """Return the largest threshold that ``share`` of the scores reach, weighted and with finite-sample correction."""
    n = len(np.unique(labelled.recording))
    under = max(0.0, ((1.0 - share) * (n + 1) - 1.0) / n)
    order = np.argsort(scores, kind="stable")
    before = np.cumsum(weights_of(labelled)[order]) - weights_of(labelled)[order]
    at = int(np.flatnonzero(before <= under + 1e-12)[-1])
    return int(scores[order[at]])


def sure_threshold(labelled: LabelledSteps, coverage: float) -> float:
    """Return the conformal threshold of smoothed probabilities for a coverage, a multiple of 2^-15."""
    return _threshold(labelled.of_truth, labelled, coverage) / ONE


def known_threshold(labelled: LabelledSteps, gestures: GestureSet, share: float) -> float | None:
    """Return the smoothed known score, in logits, that a share of the steps reach in gestures that are not idle.

    It is None without such steps.
    """
    idle = np.array([g.idle for g in gestures.gestures])
    active = labelled.take(~idle[labelled.truth])
    return _threshold(active.known, active, share) / 256 if len(active.truth) else None


def left_out_coverage(labelled: LabelledSteps, coverage: float) -> list[float]:
    """Return each person's coverage with the threshold fitted to the others.

    Recordings have equal weights. Empty for fewer than two people.
    """
    people = np.unique(labelled.person)
    if len(people) < 2:
        return []
    out = []
    for person in people:
        own_steps = labelled.take(labelled.person == person)
        threshold = sure_threshold(labelled.take(labelled.person != person), coverage)
        out.append(coverage_of(own_steps, threshold))
    return out


def coverage_of(labelled: LabelledSteps, threshold: float) -> float:
    """Return the share of steps whose set contains the true class; people and recordings have equal weights."""
    return float((weights_of(labelled) * (labelled.of_truth >= threshold * ONE)).sum())
