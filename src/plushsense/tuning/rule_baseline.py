"""The rule baseline: positive or negative events from amplitude and timing, with thresholds in fixed counts.

The paper (sections 2, 3.1, 4.6) describes what its first toys did, but not how: "signal timing and amplitude analysis",
a positive or a negative answer, none to neutral gestures, immediately to an abrupt change of large amplitude, after
about 3 s to broad strokes, hardly ever to fine scratches, sensitive to humidity and hand size. This is the simplest
program that fits this description, not the authors':

- *negative*: the acceleration, or the touch of all electrodes together, changes within 50 ms by so many counts.
- *positive*: an electrode, smoothed over 0.3 s, goes up or down by so many counts, ``swings`` times in ``window_s``.

The thresholds do not adapt to humidity, hand or person. They are tuned on training people as if by hand
(`fit_rule_baseline`): as sensitive as possible without answers to other gestures.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import Dataset
from plushsense.devices.base import Frame
from plushsense.runtime.classifier import GestureEvent
from plushsense.runtime.events import AFFECT_CODES, AFFECTS, BEGUN, ENDED, GATE, KINDS, NO_GESTURE, SOURCES, Update
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.machine import FrameReader, Sample
from plushsense.windows.clock import resample
from plushsense.windows.cut import recordings_in_time
from plushsense.windows.features import network_inputs

_LAG_S = 0.05
_SLOW_S = 0.3
# Share of other gestures that may be answered.
_WRONG = 0.02
_NEGATIVE, _POSITIVE = AFFECT_CODES["negative"], AFFECT_CODES["positive"]


@dataclass(frozen=True)
class BaselineSettings:
    """Settings of the rule baseline, in raw counts and seconds; a count of 0 switches its rule off.

    Attributes:
        shock: change of the acceleration within 50 ms for a blow; touch_shock: the same of all electrodes.
        swing: how far an electrode must go up or down; swings: how often within window_s.
        negative_s, positive_s: time after the rule last held at which an event ends.
    """

    shock: int = 0
    touch_shock: int = 0
    swing: int = 0
    swings: int = 3
    window_s: float = 4.0
    negative_s: float = 1.0
    positive_s: float = 1.5

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


class _Swings:
    """Counts the swings of one electrode: how often it turned after going at least ``size`` one way."""

    def __init__(self, size: int, weight: float) -> None:
        self._size, self._weight = size, weight
        self._slow: float | None = None
        self._low = self._high = 0.0
        self._way = 0
        self.times: list[int] = []

    def push(self, value: int, now: int, window: int) -> int:
        """Return the number of swings within the last ``window`` samples, including this one."""
        slow = self._slow
        slow = float(value) if slow is None else slow + self._weight * (value - slow)
        if self._slow is None:
            self._low = self._high = slow
        self._slow = slow
        self._low, self._high = min(self._low, slow), max(self._high, slow)
        # A swing counts once it has gone far enough; the next one must go the other way.
        if self._way <= 0 and slow - self._low >= self._size:
            self._way, self._high = 1, slow
            self.times.append(now)
        elif self._way >= 0 and self._high - slow >= self._size:
            self._way, self._low = -1, slow
            self.times.append(now)
        while self.times and now - self.times[0] > window:
            del self.times[0]
        return len(self.times)


class _Rules:
    """The rules on even samples of inputs."""

    def __init__(self, layout: Layout, plan: BaselineSettings) -> None:
        touch, shock = sensors_of(layout)
        self.plan = plan
        self._touch, self._shock = touch, shock
        self._lag = layout.samples(_LAG_S)
        self._window = layout.samples(plan.window_s)
        self._last = {
            _NEGATIVE: layout.samples(plan.negative_s),
            _POSITIVE: layout.samples(plan.positive_s),
        }
        self._weight = -math.expm1(-1.0 / (_SLOW_S * layout.rate_hz))
        self.number = 0
        self.forget()

    def forget(self) -> None:
        """Forget the past, after a break of the stream."""
        self._past: list[list[int]] = []
        self._swings = [_Swings(self.plan.swing, self._weight) for _ in self._touch]
        self._sample = 0
        self.affect = 0
        self._held = 0

    def _affect_of(self, row: list[int]) -> int:
        """Return the affect whose rule holds now, 0 for none."""
        plan, past = self.plan, self._past
        self._sample += 1
        past.append(row)
        affect = 0
        if len(past) > self._lag:
            before = past.pop(0)
            shock = sum(abs(row[i] - before[i]) for i in self._shock)
            pressed = abs(sum(row[i] - before[i] for i in self._touch))
            if 0 < plan.shock <= shock or 0 < plan.touch_shock <= pressed:
                affect = _NEGATIVE
        if plan.swing > 0:
            most = max(
                (s.push(row[i], self._sample, self._window) for s, i in zip(self._swings, self._touch, strict=True)),
                default=0,
            )
            if most >= plan.swings and not affect:
                affect = _POSITIVE
        return affect

    def push(self, row: list[int], now: int) -> list[Update]:
        """Read one sample and return its updates. A blow replaces a caress; a caress waits until a blow has ended."""
        affect = self._affect_of(row)
        updates: list[Update] = []
        if affect and affect == self.affect:
            self._held = self._sample
        elif self.affect and (affect == _NEGATIVE or self._sample - self._held > self._last[self.affect]):
            updates.append(self.end(now))
        if affect and not self.affect:
            self.number += 1
            self.affect, self._held = affect, self._sample
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
    kinds = {c.name: c.kind for c in layout.channels}
    kinds |= {d.name: kinds[d.of[0]] for d in layout.derived}
    touch = [i for i, n in enumerate(layout.inputs) if kinds[n] == "capacitive" and n != "cap_all"]
    return tuple(touch), tuple(i for i, n in enumerate(layout.inputs) if kinds[n] == "acceleration")


class BaselineReader:
    """Reads the frames of one toy by the rule baseline: events with an affect, no gesture and source ``gate``."""

    def __init__(self, layout: Layout, plan: BaselineSettings) -> None:
        self.layout, self.plan = layout, plan
        self.reset()

    def reset(self) -> None:
        """Begin a new stream at time 0."""
        self._frames = FrameReader(self.layout, HealthSettings(fault_ms=0))
        self._rules = _Rules(self.layout, self.plan)

    def push(self, frame: Frame) -> list[GestureEvent]:
        """Read one frame; return what happened to events, times in seconds since the stream's first frame."""
        updates: list[Update] = []
        for item in self._frames.push(frame.device_ms, frame.values):
            if isinstance(item, Sample):
                updates += self._rules.push(item.inputs, item.time_us)
                continue
            if self._rules.affect:
                updates.append(self._rules.end(item.time_us))
            self._rules.forget()
        return [_to_event(update) for update in updates]

    def silence(self) -> list[GestureEvent]:
        """End the current event, as no frames arrive."""
        return [_to_event(self._rules.end(self._frames.time_us))] if self._rules.affect else []


def _to_event(update: Update) -> GestureEvent:
    affect, source = AFFECTS[update.affect], SOURCES[update.source]
    return GestureEvent(KINDS[update.kind], update.number, affect, None, source, update.since / 1e6, update.now / 1e6)


def baseline_events(frames: Frames, layout: Layout, plan: BaselineSettings) -> list[GestureEvent]:
    """Return the events of a whole stream; an event that continues at its end is ended there."""
    reader = BaselineReader(layout, plan)
    host = frames.host_ms if frames.host_ms is not None else frames.device_ms
    events: list[GestureEvent] = []
    for at, ms, values in zip(host.tolist(), frames.device_ms.tolist(), frames.values.tolist(), strict=True):
        events += reader.push(Frame(at, ms, tuple(values)))
    return events + reader.silence()


def fit_rule_baseline(
    dataset: Dataset,
    gestures: GestureSet,
    subjects: Collection[str],
) -> tuple[BaselineSettings, dict[str, Any]]:
    """Tune the rules on people's recordings, as if by hand.

    The shocks are the lowest counts at which at most 2 % of the recordings that are not negative would be answered as a
    blow (half of it by each rule); the swing is the lowest of a few at which at most 2 % of the neutral and of the
    negative recordings, each, would be answered as a caress. Strokes and scratches are not used.

    Returns:
        The plan, and a report of what it was tuned on.

    Raises:
        ConfigError: for gestures without affects.
    """
    if not gestures.has_affect:
        raise ConfigError(
            f"The gesture set '{gestures.name}' has no affects, which the old rules need: "
            "give each gesture an affect in its TOML file, or use another set."
        )
    layout, people = dataset.layout, set(subjects)
    touch, shock = sensors_of(layout)
    lag = layout.samples(_LAG_S)
    calm: list[tuple[int, int]] = []
    silent: dict[str, list[NDArray[np.int64]]] = {"neutral": [], "negative": []}
    used = recordings_in_time([r for r in dataset.used if r.subject in people and gestures.find(r.gesture)])
    for recording in used:
        affect = gestures.get(recording.gesture).affect
        for segment in resample(dataset.read(recording), layout):
            x = network_inputs(segment.data, layout)
            change = x[lag:] - x[:-lag]
            if affect in ("positive", "neutral") and len(change):
                shaken = int(np.abs(change[:, list(shock)]).sum(axis=1).max()) if shock else 0
                pressed = int(np.abs(change[:, list(touch)].sum(axis=1)).max()) if touch else 0
                calm.append((shaken, pressed))
            if affect in silent:
                silent[affect].append(x)
    if not calm:
        raise ConfigError("None of these people recorded a gesture that is not negative: include other people.")
    high = np.ceil(np.quantile(np.array(calm), 1.0 - _WRONG / 2, axis=0)).astype(int) + 1
    plan = BaselineSettings(int(high[0]) if shock else 0, int(high[1]) if touch else 0)
    shares: dict[str, float] = {}
    for swing in _SWINGS if touch else ():
        tried = BaselineSettings(plan.shock, plan.touch_shock, swing)
        shares = {a: float(np.mean([_caressed(x, layout, tried) for x in xs])) for a, xs in silent.items() if xs}
        if max(shares.values(), default=0.0) <= _WRONG:
            plan = tried
            break
    report = {
        "people": len(people),
        "recordings": len(used),
        "wrong_allowed": _WRONG,
        "answered_as_a_caress": {a: round(s, 4) for a, s in shares.items()},
        **plan.to_dict(),
    }
    return plan, report


_SWINGS = tuple(round(100 * 1.25**n) for n in range(18))


def _caressed(x: NDArray[np.int64], layout: Layout, plan: BaselineSettings) -> bool:
    rules = _Rules(layout, plan)
    return any(u.affect == _POSITIVE for at, row in enumerate(x.tolist()) for u in rules.push(row, at))
