"""The rule baseline: positive or negative events from amplitude and timing, with thresholds in fixed counts.

The paper (sections 2, 3.1, 4.6) describes what its first toys did, but not how: "signal timing and amplitude analysis",
a positive or a negative answer, none to neutral gestures, immediately to an abrupt change of large amplitude, after
about 3 s to broad strokes, hardly ever to fine scratches, sensitive to humidity and hand size. This is the simplest
program that fits this description, not the authors':

- *negative*: the acceleration changes by ``shock`` counts in 50 ms, or the sum of electrodes by ``touch_shock``.
- *positive*: an electrode, smoothed over 0.3 s, rises or falls by ``swing`` counts, ``swings`` times in ``window_s``.

The thresholds do not adapt to humidity, hand or person. `fit_rule_baseline` sets them as one would by hand, on training
people: as sensitive as possible with almost no answers to other gestures.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import ACCELERATION, Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import Dataset
from plushsense.devices.base import Frame
from plushsense.runtime.classifier import GestureEvent
from plushsense.runtime.events import AFFECT_CODES, AFFECTS, BEGUN, ENDED, GATE, KINDS, NO_GESTURE, SOURCES, Update
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.machine import FrameReader, Sample
from plushsense.windows.cut import recordings_in_time
from plushsense.windows.features import network_inputs
from plushsense.windows.sessions import SessionReader

_LAG_S = 0.05
_SMOOTHING_S = 0.3
# Largest share of the recordings of other gestures that a rule may answer.
_MAX_WRONG = 0.02
_NEGATIVE, _POSITIVE = AFFECT_CODES["negative"], AFFECT_CODES["positive"]


@dataclass(frozen=True)
class RuleBaselineSettings:
    """Settings of the rule baseline, in raw counts and seconds; a count of 0 switches its rule off.

    Attributes:
        shock: change of the acceleration within 50 ms that is a blow; touch_shock: the same for the sum of electrodes.
        swing: how far an electrode must rise or fall; swings: how often within window_s.
        negative_s, positive_s: how long an event lasts after its rule was last met.
    """

    shock: int = 0
    touch_shock: int = 0
    swing: int = 0
    swings: int = 3
    window_s: float = 4.0
    negative_s: float = 1.0
    positive_s: float = 1.5


class _Swings:
    """Counts the swings of one electrode: rises and falls in turn, of at least ``size`` counts each."""

    def __init__(self, size: int, weight: float) -> None:
        self._size, self._weight = size, weight
        self._smoothed: float | None = None
        self._low = self._high = 0.0
        self._direction = 0
        self.times: list[int] = []

    def push(self, value: int, now: int, window: int) -> int:
        """Return the number of swings within the last ``window`` samples, including this one."""
        smoothed = self._smoothed
        smoothed = float(value) if smoothed is None else smoothed + self._weight * (value - smoothed)
        if self._smoothed is None:
            self._low = self._high = smoothed
        self._smoothed = smoothed
        self._low, self._high = min(self._low, smoothed), max(self._high, smoothed)
        # A swing counts once it has gone far enough; the next one must go the other way.
        if self._direction <= 0 and smoothed - self._low >= self._size:
            self._direction, self._high = 1, smoothed
            self.times.append(now)
        elif self._direction >= 0 and self._high - smoothed >= self._size:
            self._direction, self._low = -1, smoothed
            self.times.append(now)
        while self.times and now - self.times[0] > window:
            del self.times[0]
        return len(self.times)


class _Rules:
    """Applies the rules to evenly sampled inputs."""

    def __init__(self, layout: Layout, settings: RuleBaselineSettings) -> None:
        touch, shock = sensors_of(layout)
        self.settings = settings
        self._touch, self._shock = touch, shock
        self._lag = layout.samples(_LAG_S)
        self._window = layout.samples(settings.window_s)
        self._timeout = {
            _NEGATIVE: layout.samples(settings.negative_s),
            _POSITIVE: layout.samples(settings.positive_s),
        }
        self._weight = -math.expm1(-1.0 / (_SMOOTHING_S * layout.rate_hz))
        self.number = 0
        self.forget()

    def forget(self) -> None:
        """Discard earlier samples, after a break of the stream."""
        self._past: list[list[int]] = []
        self._swings = [_Swings(self.settings.swing, self._weight) for _ in self._touch]
        self._sample = 0
        self.affect = 0
        self._met_at = 0

    def _affect_of(self, row: list[int]) -> int:
        """Return the affect whose rule is met at this sample, 0 for none."""
        settings, past = self.settings, self._past
        self._sample += 1
        past.append(row)
        affect = 0
        if len(past) > self._lag:
            before = past.pop(0)
            shock = sum(abs(row[i] - before[i]) for i in self._shock)
            pressed = abs(sum(row[i] - before[i] for i in self._touch))
            if 0 < settings.shock <= shock or 0 < settings.touch_shock <= pressed:
                affect = _NEGATIVE
        if settings.swing > 0:
            most = max(
                (s.push(row[i], self._sample, self._window) for s, i in zip(self._swings, self._touch, strict=True)),
                default=0,
            )
            if most >= settings.swings and not affect:
                affect = _POSITIVE
        return affect

    def push(self, row: list[int], now: int) -> list[Update]:
        """Process one sample and return the event updates. A negative event ends a positive one, but not vice versa."""
        affect = self._affect_of(row)
        updates: list[Update] = []
        if affect and affect == self.affect:
            self._met_at = self._sample
        elif self.affect and (affect == _NEGATIVE or self._sample - self._met_at > self._timeout[self.affect]):
            updates.append(self.end(now))
        if affect and not self.affect:
            self.number += 1
            self.affect, self._met_at = affect, self._sample
            updates.append(Update(BEGUN, self.number, affect, NO_GESTURE, GATE, now, now))
        return updates

    def end(self, now: int) -> Update:
        """End the current event."""
        update = Update(ENDED, self.number, self.affect, NO_GESTURE, GATE, now, now)
        self.affect = 0
        return update


def sensors_of(layout: Layout) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the indices of the electrodes and of the acceleration among a layout's inputs.

    Proximity and the sum of all electrodes do not count as electrodes.
    """
    kinds = layout.input_kinds
    touch = [i for i, n in enumerate(layout.inputs) if kinds[i] == "capacitive" and n != "cap_all"]
    return tuple(touch), tuple(i for i, kind in enumerate(kinds) if kind == ACCELERATION)


class RuleBaselineReader:
    """Applies the rule baseline to the frames of one toy; its events have an affect, no gesture and source ``gate``."""

    def __init__(self, layout: Layout, settings: RuleBaselineSettings) -> None:
        self.layout, self.settings = layout, settings
        self.reset()

    def reset(self) -> None:
        """Begin a new stream at time 0."""
        self._frames = FrameReader(self.layout, HealthSettings(fault_ms=0))
        self._rules = _Rules(self.layout, self.settings)

    def push(self, frame: Frame) -> list[GestureEvent]:
        """Process one frame; return changes of events, with times in seconds since the stream's first frame."""
        updates: list[Update] = []
        for item in self._frames.push(frame.device_ms, frame.values, frame.host_ms):
            if isinstance(item, Sample):
                updates += self._rules.push(item.inputs, item.time_us)
                continue
            if self._rules.affect:
                updates.append(self._rules.end(item.time_us))
            self._rules.forget()
        return [_to_event(update) for update in updates]

    def silence(self) -> list[GestureEvent]:
        """End the current event when frames have stopped arriving."""
        return [_to_event(self._rules.end(self._frames.time_us))] if self._rules.affect else []


def _to_event(update: Update) -> GestureEvent:
    affect, source = AFFECTS[update.affect], SOURCES[update.source]
    return GestureEvent(KINDS[update.kind], update.number, affect, None, source, update.since / 1e6, update.now / 1e6)


def rule_baseline_events(frames: Frames, layout: Layout, settings: RuleBaselineSettings) -> list[GestureEvent]:
    """Return the events of a whole stream; an event that is open at the end of the stream ends there."""
    reader = RuleBaselineReader(layout, settings)
    host = frames.host_ms if frames.host_ms is not None else frames.device_ms
    events: list[GestureEvent] = []
    for at, ms, values in zip(host.tolist(), frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        events += reader.push(Frame(at, ms, tuple(values)))
    return events + reader.silence()


def fit_rule_baseline(dataset: Dataset, gestures: GestureSet, subjects: Collection[str]) -> RuleBaselineSettings:
    """Tune the thresholds on the recordings of ``subjects``.

    ``shock`` and ``touch_shock`` are the lowest counts at which at most 2 % of the positive and neutral recordings
    would cause a negative event (1 % by each rule). ``swing`` is the lowest of a few values at which at most 2 % of the
    neutral and at most 2 % of the negative recordings would cause a positive event.

    Raises:
        ConfigError: for gestures without affects.
    """
    if not gestures.has_affect:
        raise ConfigError(
            f"The gesture set '{gestures.name}' has no affects, which the rule baseline needs: "
            "give each gesture an affect in its TOML file, or use another set."
        )
    layout, people = dataset.layout, set(subjects)
    touch, shock = sensors_of(layout)
    lag = layout.samples(_LAG_S)
    peaks: list[tuple[int, int]] = []
    unanswered: dict[str, list[NDArray[np.int64]]] = {"neutral": [], "negative": []}
    used = recordings_in_time([r for r in dataset.used if r.subject in people and gestures.find(r.gesture)])
    sessions = SessionReader(dataset)
    for recording in used:
        affect = gestures.get(recording.gesture).affect
        for segment in sessions.recording(recording):
            x = network_inputs(segment.data, layout)
            change = x[lag:] - x[:-lag]
            if affect in ("positive", "neutral") and len(change):
                shaken = int(np.abs(change[:, list(shock)]).sum(axis=1).max()) if shock else 0
                pressed = int(np.abs(change[:, list(touch)].sum(axis=1)).max()) if touch else 0
                peaks.append((shaken, pressed))
            if affect in unanswered:
                unanswered[affect].append(x)
    if not peaks:
        raise ConfigError("None of these people recorded a gesture that is not negative: include other people.")
    thresholds = np.ceil(np.quantile(np.array(peaks), 1.0 - _MAX_WRONG / 2, axis=0)).astype(int) + 1
    settings = RuleBaselineSettings(int(thresholds[0]) if shock else 0, int(thresholds[1]) if touch else 0)
    for swing in _SWINGS if touch else ():
        candidate = RuleBaselineSettings(settings.shock, settings.touch_shock, swing)
        wrong = (np.mean([_is_answered_positive(x, layout, candidate) for x in xs]) for xs in unanswered.values() if xs)
        if all(share <= _MAX_WRONG for share in wrong):
            return candidate
    return settings


_SWINGS = tuple(round(100 * 1.25**n) for n in range(18))


def _is_answered_positive(x: NDArray[np.int64], layout: Layout, settings: RuleBaselineSettings) -> bool:
    rules = _Rules(layout, settings)
    return any(u.affect == _POSITIVE for at, row in enumerate(x.tolist()) for u in rules.push(row, at))
