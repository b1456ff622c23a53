"""Propose settings that fit the recordings of a data set.

Zero, scale and unit of accelerometers are measured for each session; rate, gap, valid ranges and window over all.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import LayoutError
from plushsense.core.layouts import ACCELERATION, MEASURED, MOST_CALIBRATED_OTHER, Layout
from plushsense.core.sentences import join_names
from plushsense.dataset.quality.measurements import zeroing_limit
from plushsense.dataset.quality.outliers import find_failed_readings
from plushsense.dataset.statistics import fitting_window_s, median_gesture_s
from plushsense.dataset.store import Dataset, RecordingInfo

DEFAULT_WINDOW_S = 2.5
# Clocks have whole milliseconds: a faster one has rows in another unit than it says.
_FASTEST_HZ = 1000.0
# A rate is proposed if the measured one differs by this factor, a zero if it is this share of the radius away.
_RATE_FACTOR = 1.25
_ZERO_SHARE = 0.15
# Zeros are fitted to the stillest blocks of some recordings, at least of so many of each session, if their standard
# error is small.
_RECORDINGS = 400
_LEAST_RECORDINGS = 6
_BLOCK_S = 0.3
_STILLEST = 0.2
_LEAST_BLOCKS = 12
_STANDARD_ERROR = 0.05
# A sphere has four unknowns. What moves slowly while held is off by this share of the radius in each direction, and
# directions less than this share apart are one.
_UNKNOWNS = 4
_MOTION = 0.01
_DIRECTION = 0.3
# A session lies on a sphere if half of its still blocks are at most this share of the radius away; it needs so many.
_ON_SPHERE = 0.1
_LEAST_POINTS = 3
# Sensors are different if their zeros are this share of 1 g apart, or their scales differ by this factor.
_OTHER_ZERO = 0.5
_OTHER_SCALE = 1.25
# Where gravity is subtracted, what a sensor reads at rest is a smaller share of what it reads on average.
_GRAVITY = 0.3
# 1 g in units and in steps of usual digital sensors, recognised within 5 % if no other is nearly as close.
_UNITS = {
    "g": 1.0,
    "m/s²": 9.80665,
    "mg": 1000.0,
    **{f"{counts} counts a g": float(counts) for counts in (256, 512, 1024, 2048, 4096, 8192, 16384)},
}
_UNIT_SHARE = 0.05
_NAMED = 8
# A channel drifts if a quarter of the sessions, of three or more, rest further from the usual rest than touch leads.
_FAR = 0.25
_LEAST_SESSIONS = 3
_TOUCH = 0.9  # quantile of the distances from rest

SELF_CALIBRATION, WINDOW = "self_calibration", "window_s"
BY_LAYOUT = "give a layout with {settings}, or import anew with --adopt"

Floats = NDArray[np.float64]
Sphere = tuple[Floats, float]
"""Centre (3,) and radius, in steps of the layout."""


@dataclass(frozen=True)
class SensorSession:
    """The sensor of a session: the values that stand for zero, and 1 g, None where it was not turned enough to tell."""

    subject: str
    session: str
    zero: dict[str, float] | None
    one_g: float | None


@dataclass(frozen=True)
class Sensor:
    """The accelerometer of some sessions: the values in the files that stand for zero, and 1 g in the unit ``unit``.

    ``recognised`` is the unit that 1 g tells, "" if it is not plain. ``radius`` is 1 g in the values of the files.
    """

    axes: tuple[str, ...]
    zero: dict[str, float]
    radius: float
    one_g: float
    unit: str
    recognised: str
    sessions: tuple[SensorSession, ...]

    @classmethod
    def of(
        cls,
        layout: Layout,
        axes: tuple[str, ...],
        steps: Floats,
        fit: Sphere,
        sessions: Mapping[tuple[str, str], Sphere | None],
    ) -> Sensor:
        """Describe a fitted sphere, and those of single sessions, in the units of the layout."""
        channel = layout.channels[layout.index(axes[0])]

        def zero(fit: Sphere) -> dict[str, float]:
            return {n: float(f"{c * step:.4g}") for n, c, step in zip(axes, fit[0], steps, strict=True)}

        def one_g(fit: Sphere) -> float:
            return float(f"{fit[1] * steps[0] * abs(channel.scale):.4g}")

        known = tuple(
            SensorSession(subject, session, own and zero(own), own and one_g(own))
            for (subject, session), own in sorted(sessions.items())
        )
        radius = float(fit[1] * steps[0])
        return cls(axes, zero(fit), radius, one_g(fit), channel.unit, _recognised(one_g(fit)), known)

    @property
    def sphere(self) -> str:
        """1 g and zero in words."""
        zero = ", ".join(f"{name} {value:g}" for name, value in self.zero.items())
        return f"1 g is about {self.one_g:g} {self.unit}".rstrip() + f" away from {zero}"

    @property
    def people(self) -> str:
        """The people, the first of many, and the number of sessions if it is another."""
        names = list(dict.fromkeys(s.subject for s in self.sessions))
        total = f" ({len(self.sessions)} sessions)" if len(self.sessions) > len(names) else ""
        return join_names(names, most=_NAMED) + total

    @property
    def summary(self) -> str:
        """What is known in one sentence."""
        text = f"{self.sphere}, for {self.people}"
        if self.recognised:
            text += f"; that is {self.recognised}"
            if self.unit in _UNITS and self.recognised in _UNITS and self.unit != self.recognised:
                text += f", but the layout says {self.unit}"
        own = [s.zero for s in self.sessions if s.zero]
        if own and len(self.sessions) > 1:
            away = max(math.dist(zero.values(), self.zero.values()) for zero in own) / self.radius
            text += (
                f"; the zeros of {len(own)} of {len(self.sessions)} sessions are known, at most {away:.2f} g from it"
            )
        return text

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        values = asdict(self)
        del values["radius"]
        return {**values, "axes": list(self.axes), "sessions": list(values["sessions"]), "summary": self.summary}


@dataclass(frozen=True)
class Proposal:
    """A setting that fits the recordings better: the ``key`` of a layout or of window settings, and the reason.

    ``groups`` are the sensors that differ, if that is the reason. ``proven``: whether the recordings leave no doubt, so
    that a layout may adopt it; ``adopted``: whether it did.
    """

    key: str
    value: Any
    reason: str
    groups: tuple[Sensor, ...] = ()
    proven: bool = True
    adopted: bool = False

    @property
    def setting(self) -> str:
        """The key and its value in words."""
        if isinstance(self.value, dict):
            texts = (f"{k} {v if isinstance(v, str) else format(v, 'g')}" for k, v in self.value.items())
            return f"{self.key}: {', '.join(texts)}"
        plain = isinstance(self.value, int | float)
        return f"{self.key} = {format(self.value, 'g') if plain else json.dumps(self.value, ensure_ascii=False)}"

    @property
    def advice(self) -> str:
        """What to do, or what was done if the layout adopted the proposal."""
        if self.key == WINDOW:
            return f"try  --window-s {self.value:g}  of train and evaluate"
        if self.adopted:
            return f"adopted {self.setting}"
        return BY_LAYOUT.format(settings=self.setting)

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON; ``groups`` only if there are any."""
        groups = {"groups": [sensor.to_json() for sensor in self.groups]} if self.groups else {}
        return {
            "key": self.key,
            "value": self.value,
            "reason": self.reason,
            **groups,
            "proven": self.proven,
            "advice": self.advice,
            "adopted": self.adopted,
        }


def _recognised(one_g: float) -> str:
    """Return the unit in which 1 g is about ``one_g``, "" if none or several come close."""
    off = sorted((abs(math.log(one_g / value)), unit) for unit, value in _UNITS.items())
    plain = off[0][0] <= _UNIT_SHARE and 2 * off[0][0] <= off[1][0]
    return off[0][1] if plain else ""


def propose_settings(dataset: Dataset, sensors: Sequence[Sensor] | None = None) -> list[Proposal]:
    """Measure the recordings, and return what fits them better than the layout and the default window.

    ``sensors`` are those of `find_sensors`, if they are known.
    """
    sensors = find_sensors(dataset) if sensors is None else sensors
    return [
        *_rate_and_gap(dataset),
        *_zeros(dataset.layout, sensors),
        *_units(dataset.layout, sensors),
        *_drifts(dataset),
        *_valid_ranges(dataset),
        *_window(dataset),
    ]


def adopt(layout: Layout, proposals: Sequence[Proposal], doubtful: bool = False) -> Layout:
    """Return the layout with the proposals that are proven, or with the ``doubtful`` ones as well.

    Axes whose valid range is too wide for a self-calibration stay without.
    """
    taken = [p for p in proposals if p.proven or doubtful]
    of_channels = [(p.key, p.value) for p in taken if p.key in MEASURED]
    channels = tuple(
        replace(c, **{key: named[c.name] for key, named in of_channels if c.name in named}) for c in layout.channels
    )
    same = {p.key: p.value for p in taken if p.key in ("rate_hz", "gap_ms")}
    calibrated = (*layout.self_calibration, *(name for p in taken if p.key == SELF_CALIBRATION for name in p.value))
    adopted = replace(layout, channels=channels, **same)
    try:
        return replace(adopted, self_calibration=calibrated)
    except LayoutError:
        return adopted


def _rate_and_gap(dataset: Dataset) -> Iterator[Proposal]:
    layout = dataset.layout
    rates = [r.rate_hz for r in dataset.used if r.rate_hz > 0]
    if not rates:
        return
    rate = float(np.median(rates))
    if rate > _FASTEST_HZ:
        return
    if not 1 / _RATE_FACTOR < rate / layout.rate_hz < _RATE_FACTOR:
        yield Proposal(
            "rate_hz",
            float(max(1.0, round(rate))),
            f"the recordings have about {rate:.3g} frames a second (median), the layout says {layout.rate_hz:g}",
        )
    period_ms = 1000 / rate
    if layout.gap_ms < 2 * period_ms:
        yield Proposal(
            "gap_ms",
            round(4 * period_ms),
            f"frames are about {period_ms:.0f} ms apart, and the layout takes more than {layout.gap_ms} ms for a gap",
        )


def find_sensors(dataset: Dataset) -> list[Sensor]:
    """Measure the zero and 1 g of each session's accelerometer; return one `Sensor` for each group of like sessions.

    Held still in different directions, an acceleration lies on a sphere of 1 g around its zero. Spheres are fitted to
    the stillest blocks of each session, and of all of them; the one that most sessions lie on is a group, then the one
    that most of the others lie on, if it is clearly another. Nothing is found where no sphere is determined.
    """
    layout = dataset.layout
    kinds = {c.name: c.kind for c in layout.channels}
    vectors = [vector for vector in layout.vectors if kinds[vector[0]] == ACCELERATION]
    return [sensor for vector in vectors for sensor in _sensors_of(dataset, vector)]


def _sensors_of(dataset: Dataset, vector: tuple[str, ...]) -> Iterator[Sensor]:
    layout = dataset.layout
    axes = [layout.index(name) for name in vector]
    sessions, measured, owner = _blocks(dataset, axes, zeroing_limit(layout) is not None)
    if not sessions:
        return
    means, noise = measured[:, 0], measured[:, 1].max(axis=1)
    stillest = np.zeros(len(means), dtype=np.bool_)
    for k in range(len(sessions)):
        mine = np.flatnonzero(owner == k)
        stillest[mine[noise[mine] <= np.quantile(noise[mine], _STILLEST)]] = True
    points, at = means[stillest], owner[stillest]
    own = [_sphere(points[at == k]) for k in range(len(sessions))]
    for k, fit in enumerate(own):
        # Blocks of a session that is never still are not on a sphere.
        if fit is not None and np.median(noise[stillest][at == k]) > _ON_SPHERE * fit[1]:
            own[k] = None
    people = {subject: [k for k, session in enumerate(sessions) if session[0] == subject] for subject, _ in sessions}
    pooled = [_sphere(points[np.isin(at, mine)]) for mine in people.values() if len(mine) > 1]
    everything = _sphere(means[noise <= np.quantile(noise, _STILLEST)])
    enough = np.bincount(at, minlength=len(sessions)) >= _LEAST_POINTS
    groups: list[Sphere] = []
    left = enough.copy()
    fits = [fit for fit in (everything, *pooled, *own) if fit is not None]
    lies = list[NDArray[np.bool_]]()
    for fit in fits:
        lies.append(_errors(fit, points, at, len(sessions)) <= _ON_SPHERE)
        if lies[-1][enough].all():
            # No other fit has more sessions; with hundreds of sessions, their own would take seconds.
            break
    on = np.array(lies)
    while fits and (on & left).any():
        best = int((on & left).sum(axis=1).argmax())
        fit = _sphere(points[(on[best] & left)[at]]) or fits[best]
        left &= ~on[best]
        if all(_differ(fit, other) for other in groups):
            groups.append(fit)
    if not groups:
        return
    errors = np.array([_errors(fit, points, at, len(sessions)) for fit in groups])
    nearest = np.where(enough & (errors.min(axis=0) <= _ON_SPHERE), errors.argmin(axis=0), -1)
    # Spheres that most sessions do not lie on are chance.
    if 2 * (nearest >= 0).sum() < enough.sum():
        return
    steps = np.array([layout.channels[axis].step for axis in axes])
    for n, fit in enumerate(groups):
        if len(members := np.flatnonzero(nearest == n)):
            yield Sensor.of(layout, vector, steps, fit, {sessions[k]: own[k] for k in members.tolist()})


def length_at_rest(dataset: Dataset, axes: list[int]) -> float | None:
    """Return the median length of an acceleration in the stillest blocks, in steps; None if they show no gravity."""
    _, blocks, _ = _blocks(dataset, axes, zeroing_limit(dataset.layout) is not None)
    if len(blocks) < _LEAST_BLOCKS:
        return None
    means, noise = blocks[:, 0] - dataset.layout.zero_int[axes], blocks[:, 1].max(axis=1)
    still = noise <= np.quantile(noise, _STILLEST)
    length = float(np.median(np.linalg.norm(means[still], axis=1)))
    moving = float(np.sqrt((means**2).sum(axis=1).mean() + 3 * (noise**2).mean()))
    return length if length > max(_GRAVITY * moving, 3 * float(np.median(noise[still]))) else None


def _errors(fit: Sphere, points: Floats, owner: NDArray[np.int64], sessions: int) -> Floats:
    """Return the median distance of each session's points from a sphere as a share of its radius (inf: no points)."""
    centre, radius = fit
    # Half a step is the error of a sensor with coarse steps.
    error = np.maximum(np.abs(np.linalg.norm(points - centre, axis=1) - radius) - 0.5, 0.0) / radius
    order = np.lexsort((error, owner))
    counts = np.bincount(owner, minlength=sessions)
    middle = np.cumsum(counts) - counts + np.maximum(counts - 1, 0) // 2
    return np.where(counts > 0, error[order][np.minimum(middle, len(error) - 1)], np.inf)


def _differ(one: Sphere, other: Sphere) -> bool:
    """Return whether two spheres are clearly those of different sensors."""
    least, most = sorted((one[1], other[1]))
    return bool(np.linalg.norm(one[0] - other[0]) > _OTHER_ZERO * least or most > _OTHER_SCALE * least)


def _zeros(layout: Layout, sensors: Sequence[Sensor]) -> Iterator[Proposal]:
    """Propose an offset of the axes of each accelerometer with one zero, and self-calibration of those with several."""
    offset: dict[str, float] = {}
    reasons, several = [], []
    different: list[Sensor] = []
    for vector in dict.fromkeys(sensor.axes for sensor in sensors):
        if set(vector) <= set(layout.self_calibration):
            continue  # whatever its zero is
        found = [sensor for sensor in sensors if sensor.axes == vector]
        if len(found) > 1:
            different += found
            several.append("; ".join(f"{sensor.sphere}, for {sensor.people}" for sensor in found))
            continue
        (sensor,) = found
        away = [sensor.zero[name] - layout.channels[layout.index(name)].offset for name in vector]
        if float(np.linalg.norm(away)) > _ZERO_SHARE * sensor.radius:
            offset |= sensor.zero
            given = ", ".join(f"{layout.channels[layout.index(name)].offset:g}" for name in vector)
            reasons.append(f"{sensor.sphere}, which stands for zero; the layout says {given}")
    if offset:
        yield Proposal("offset", offset, f"held still, {'; '.join(reasons)}")
    if different:
        axes = list(dict.fromkeys(name for sensor in different for name in sensor.axes))
        reason = f"the accelerometers of the sessions differ in zero or scale: {'; '.join(several)}"
        yield Proposal(SELF_CALIBRATION, axes, reason, tuple(different))


def _units(layout: Layout, sensors: Sequence[Sensor]) -> Iterator[Proposal]:
    """Propose the unit that 1 g tells, where the layout names another one of acceleration."""
    wrong = [s for s in sensors if s.unit in _UNITS and s.recognised in _UNITS and s.unit != s.recognised]
    units = {name: sensor.recognised for sensor in wrong for name in sensor.axes}
    if units and all(s.recognised == units.get(s.axes[0], s.recognised) for s in sensors):
        reason = "; ".join(dict.fromkeys(f"1 g is about {s.one_g:g}, and the layout says {s.unit}" for s in wrong))
        yield Proposal("unit", units, f"held still, {reason}")


def _valid_ranges(dataset: Dataset) -> Iterator[Proposal]:
    """Propose valid ranges without failed readings: the range of all others, and as much again on both sides."""
    failed = find_failed_readings(dataset)
    for proven in (True, False):
        mine = [f for f in failed if proven == (not f.doubt)]
        reason = "; ".join(
            f"{f.n} of {f.of} readings of {f.channel} ({join_names(f.people, most=_NAMED)}) are far beyond all others, "
            f"which are {f.low:g} to {f.high:g}" + (f.doubt and f", {f.doubt}")
            for f in mine
        )
        if mine:
            edges = {f.channel: (2 * f.low - f.high, 2 * f.high - f.low) for f in mine}
            given = {c.name: (c.valid_min, c.valid_max) for c in dataset.layout.channels}
            for at, key, narrower in ((0, "valid_min", max), (1, "valid_max", min)):
                limits = {name: float(f"{narrower(pair[at], given[name][at]):.9g}") for name, pair in edges.items()}
                yield Proposal(key, limits, reason, proven=proven)


def _drifts(dataset: Dataset) -> Iterator[Proposal]:
    """Propose self-calibration of channels, other than accelerations, whose rest differs between sessions.

    Scaled over the training people, rest of such a session reads like touch of another. Sessions of one gesture tell
    nothing: what differs may be the gesture.
    """
    layout = dataset.layout
    named = {axis: vector for vector in layout.vectors for axis in vector}
    may_drift = [
        c.name
        for c in layout.channels
        if c.kind != ACCELERATION and not c.is_discrete and c.name not in layout.self_calibration
    ]
    gestures: dict[tuple[str, str], set[str]] = {}
    for r in dataset.used:
        gestures.setdefault((r.subject, r.session), set()).add(r.gesture)
    if not may_drift or sum(len(made) > 1 for made in gestures.values()) < _LEAST_SESSIONS:
        return
    sessions, blocks, owner = _blocks(dataset, [layout.index(name) for name in may_drift], replaced=False)
    fits = (2 * np.abs(blocks[:, 0]).max(axis=0, initial=0) <= MOST_CALIBRATED_OTHER).tolist()
    mine = [blocks[owner == k] for k, session in enumerate(sessions) if len(gestures[session]) > 1]
    drifting = list[str]()
    for axes in dict.fromkeys(named.get(name, (name,)) for name in may_drift):
        at = [may_drift.index(name) for name in axes]
        if all(fits[i] for i in at) and _differs([part[:, :, at] for part in mine]):
            drifting += axes
    if not drifting:
        return
    least = f"a quarter of {len(mine)} sessions rest further from the others than touch leads away from rest"
    reason = f"{join_names(drifting, most=_NAMED)}: {least}"
    for key, sign in (("valid_min", -1), ("valid_max", 1)):
        limits = {c.name: sign * MOST_CALIBRATED_OTHER * c.step for c in layout.channels if c.name in drifting}
        given = {c.name: getattr(c, key) for c in layout.channels}
        if narrower := {name: v for name, v in limits.items() if abs(given[name]) > abs(v)}:
            yield Proposal(key, narrower, reason, proven=False)
    yield Proposal(SELF_CALIBRATION, drifting, reason, proven=False)


def _differs(sessions: Sequence[Floats]) -> bool:
    """Return whether rest differs between sessions, each blocks (n, 2, A) of one sensor, by more than touch."""
    rests, touches = list[Floats](), list[float]()
    for blocks in sessions:
        noise = np.square(blocks[:, 1]).sum(axis=1)
        rests.append(np.median(blocks[noise <= np.quantile(noise, _STILLEST), 0], axis=0))
        distance = np.square(blocks[:, 0] - rests[-1]).sum(axis=1) + noise
        touches.append(float(np.sqrt(np.quantile(distance, _TOUCH))))
    touch = float(np.median(touches))
    away = np.linalg.norm(np.array(rests) - np.median(rests, axis=0), axis=1)
    return len(rests) >= _LEAST_SESSIONS and 0.0 < touch < float(np.quantile(away, 1 - _FAR))


def _blocks(
    dataset: Dataset, axes: list[int], replaced: bool
) -> tuple[list[tuple[str, str]], Floats, NDArray[np.int64]]:
    """Cut some recordings of each session into blocks of 0.3 s.

    With ``replaced``, blocks in which an axis stays at 0 are left out: the authors' recorder replaces values by it.

    Returns:
        The person and session of each session with blocks; the mean and the standard deviation of each axis in each
        block (n, 2, A), in steps of the layout; and the index of its session (n,).
    """
    layout = dataset.layout
    by_session: dict[tuple[str, str], list[RecordingInfo]] = {}
    for recording in dataset.used:
        by_session.setdefault((recording.subject, recording.session), []).append(recording)
    most = max(_LEAST_RECORDINGS, _RECORDINGS // max(1, len(by_session)))
    found: dict[tuple[str, str], Floats] = {}
    for session, recordings in by_session.items():
        blocks = []
        for recording in recordings[:: math.ceil(len(recordings) / most)]:
            values = np.clip(dataset.read(recording).values, layout.valid_min_int, layout.valid_max_int)[:, axes]
            rows = max(3, round(_BLOCK_S * (recording.rate_hz or layout.rate_hz)))
            n = len(values) // rows
            cut = values[: n * rows].reshape(n, rows, len(axes)).astype(np.float64)
            if replaced:
                cut = cut[(cut != 0).any(axis=1).all(axis=1)]
            blocks.append(np.stack([cut.mean(axis=1), cut.std(axis=1)], axis=1))
        joined = np.concatenate(blocks)
        if len(joined):
            found[session] = joined
    owner = np.repeat(np.arange(len(found)), [len(blocks) for blocks in found.values()])
    return list(found), np.concatenate([*found.values()]) if found else np.zeros((0, 2, len(axes))), owner


def _sphere(points: Floats) -> Sphere | None:
    """Fit a sphere to points (n, 3) by least squares without outliers; None if they do not determine its centre."""
    keep = np.ones(len(points), dtype=np.bool_)
    centre, radius, error = np.zeros(3), 0.0, np.zeros(len(points))
    for _ in range(10):
        mine = points[keep]
        if len(mine) < _LEAST_BLOCKS:
            return None
        terms = np.concatenate([2 * mine, np.ones((len(mine), 1))], axis=1)
        solution = np.linalg.lstsq(terms, np.square(mine).sum(axis=1), rcond=None)[0]
        centre = solution[:3]
        radius = float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))
        error = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        # Half a step is the error of a sensor with coarse steps.
        closer = error <= 3 * 1.4826 * np.median(error[keep]) + max(0.5, _MOTION * radius)
        if np.array_equal(closer, keep):
            break
        keep = closer
    return (centre, radius) if radius > 0 and _is_determined(points[keep], (centre, radius)) else None


def _is_determined(points: Floats, fit: Sphere) -> bool:
    """Return whether the directions of points (n, 3) from the centre of a fitted sphere leave little doubt about it.

    Points in one direction count as one, however many: four directions lie on a sphere whatever their error.
    """
    centre, radius = fit
    cells = np.unique(np.round((points - centre) / (_DIRECTION * radius)), axis=0, return_inverse=True)[1].ravel()
    means = np.stack([np.bincount(cells, points[:, i]) for i in range(3)], axis=1) / np.bincount(cells)[:, None]
    if len(means) <= _UNKNOWNS:
        return False
    spread = np.linalg.svd(means - means.mean(axis=0), compute_uv=False)[-1]
    off = np.linalg.norm(means - centre, axis=1) - radius
    error = max(float(np.sqrt(np.square(off).sum() / (len(means) - _UNKNOWNS))), _MOTION * radius)
    return bool(error <= _STANDARD_ERROR * spread)


def _window(dataset: Dataset) -> Iterator[Proposal]:
    seconds = median_gesture_s(dataset)
    if seconds is not None and seconds < DEFAULT_WINDOW_S:
        yield Proposal(
            WINDOW,
            fitting_window_s(seconds),
            f"half of the recordings last less than {seconds:.1f} s, so windows of {DEFAULT_WINDOW_S} s, the default, "
            "mostly begin before their gesture",
            proven=False,
        )
