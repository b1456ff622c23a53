"""Fit the gate: choose signals, terms and thresholds that detect the energetic gestures of some people.

Candidates for terms are level and jerk of each input, and the jerk of all inputs of a kind at several lags, each with
several floors. Rules have one or two terms. The thresholds of a rule limit its false alarms per hour on everything
that is not energetic; of the rules that then detect the most, the fastest is chosen. Further rules are added as long as
they detect enough energetic recordings that the earlier ones miss.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.dataset.store import Dataset
from plushsense.runtime.events import AFFECT_CODES, NO_GESTURE
from plushsense.runtime.gate import HELD, JERK, LEVEL, MOST_LAG, GateSettings, Rule, Signal, Term
from plushsense.runtime.replay import firings, follow, raw_signals
from plushsense.tuning.gate_rules import BETWEEN, CALM, LEFT_OUT, FoundRule, Heights, Material, best_rule, material_of

LEAD = 1200
"""Number of samples computed before a piece, in which the baseline settles."""
PIECE = 4800
_CELLS = 12_000  # number of pieces times signals computed together; more do not fit the cache


def signal_sizes(
    xs: Sequence[NDArray[np.int64]], signals: Sequence[Signal], deviations: bool = False
) -> list[NDArray[np.int32]]:
    """Return the sizes of the signals, with the sign of the deviation, as an array (T, S) for each stretch (T, I).

    They are those of `plushsense.runtime.gate.Gate`, with two differences that allow computing many pieces at once:
    the baseline of a piece starts only `LEAD` samples before it, and samples that repeat the previous one are not
    skipped. With ``deviations``, the deviations are returned instead.
    """
    out = [np.zeros((len(x), len(signals)), dtype=np.int32) for x in xs]
    pieces = [(n, at, max(0, at - LEAD)) for n, x in enumerate(xs) for at in range(0, len(x), PIECE)]
    pieces.sort(key=lambda p: p[2] - min(p[1] + PIECE, len(xs[p[0]])))  # the longest first
    per = max(1, _CELLS // max(1, len(signals)))
    for first in range(0, len(pieces), per):
        some = pieces[first : first + per]
        stops = [min(at + PIECE, len(xs[n])) for n, at, _ in some]
        block = np.zeros((stops[0] - some[0][2], len(some), len(signals)), dtype=np.int32)
        for column, ((n, _, begin), stop) in enumerate(zip(some, stops, strict=True)):
            back = max(0, begin - MOST_LAG)
            block[: stop - begin, column] = raw_signals(xs[n][back:stop], signals)[begin - back :]
        sizes = follow(block, signals, deviations)
        for column, ((n, at, begin), stop) in enumerate(zip(some, stops, strict=True)):
            out[n][at:stop] = sizes[at - begin : stop - begin, column]
    return out


_TOGETHER = 6  # number of stretches processed at once with all candidates, which limits memory
_MOST, _FLOORS = 24, 2  # number of candidates to keep, and of those among them that may differ only in the floor


@dataclass(frozen=True)
class GateSpec:
    """Settings for fitting a gate; times in seconds.

    Attributes:
        false_alarms_per_hour: limit for data that is not energetic.
        lags_s: lags of jerks; floors: quantiles of the absolute deviation of a signal, used as its floors.
        times_s: how long the size must reach the threshold; within_s: how long the term holds afterwards.
        deaf_s: time after firing in which no rule fires.
        baseline_s, noise_s: time constants of baseline and noise.
        rules: largest number of rules for one affect.
        least: share of the energetic recordings that the first rule must detect, else there are no rules.
        gain: share that each further rule must add, at least two recordings.
        worth: share of the recordings that must be lost before time between recordings is not counted as calm.
    """

    false_alarms_per_hour: float = 1.0
    lags_s: tuple[float, ...] = (0.02, 0.05, 0.1)
    floors: tuple[float, ...] = (0.5, 0.9, 0.99)
    times_s: float = 0.02
    within_s: float = 0.05
    deaf_s: float = 0.5
    baseline_s: float = 1.28
    noise_s: float = 2.56
    rules: int = 3
    least: float = 0.2
    gain: float = 0.005
    worth: float = 0.05


@dataclass(frozen=True)
class GateFit:
    """A fitted gate (``settings``), and a ``report`` with the data and results of the fit."""

    settings: GateSettings
    report: dict[str, Any] = field(default_factory=dict)


def fit_gate(
    dataset: Dataset,
    gestures: GestureSet,
    subjects: Collection[str],
    *,
    false_alarms_per_hour: float = 1.0,
) -> GateFit:
    """Fit a gate on the streams of ``subjects``, and on their recordings that are in no stream.

    If there is nothing energetic to detect or no rule is good enough, the settings have no rules; the report has the
    reason.

    Args:
        gestures: the classes of the model; they define which gestures are energetic, and their affect.
        false_alarms_per_hour: limit for data that is not energetic.
    """
    spec = GateSpec(false_alarms_per_hour)
    figures = {"people": len(set(subjects)), "false_alarms_per_hour_allowed": spec.false_alarms_per_hour}
    names = [g.label for g in gestures.gestures if g.energetic]
    if not names:
        return GateFit(GateSettings(), {**figures, "reason": f"no gesture of '{gestures.name}' is marked as energetic"})
    material = material_of(dataset, gestures, subjects)
    if not any(label in names for _, label in material.trials):
        return GateFit(GateSettings(), {**figures, "reason": f"nobody here recorded {', '.join(names)}"})
    candidates = _Candidates(dataset.layout, material, spec)
    signals: list[Signal] = []
    rules: list[Rule] = []
    believed = True
    for affect in dict.fromkeys(g.affect for g in gestures.gestures if g.energetic):
        labels = [g.label for g in gestures.gestures if g.energetic and g.affect == affect]
        rules_found, used = _rules_of(candidates, labels, spec)
        believed = believed and used
        gesture = gestures.index(labels[0]) if len(labels) == 1 else NO_GESTURE
        for rule in rules_found:
            terms = []
            for column, threshold in rule.terms:
                signal, sign = candidates.candidates[column]
                if signal not in signals:
                    signals.append(signal)
                terms.append(Term(signals.index(signal), threshold, sign, candidates.times))
            rules.append(
                Rule(
                    tuple(terms), AFFECT_CODES[affect], gesture, candidates.within, dataset.layout.samples(spec.deaf_s)
                )
            )
    settings = GateSettings(tuple(signals), tuple(rules))
    if not rules:
        return GateFit(settings, {**figures, "reason": "no rule detects enough of them at so few false alarms"})
    measured = measure_gate(settings, material, dataset.layout)
    return GateFit(settings, {**figures, "between_recordings_believed": believed, **measured})


def _rules_of(candidates: _Candidates, labels: list[str], spec: GateSpec) -> tuple[list[FoundRule], bool]:
    """Return rules for the gestures ``labels``, and whether the time between recordings was counted as calm.

    It is, unless that costs recall, as when people practised between their recordings.
    """
    best: tuple[int, list[FoundRule], bool] = (-1, [], True)
    for believed in (True, False):
        heights, hours = candidates.heights(labels, believed)
        n_trials = len(np.unique(heights.trials))
        left = int(hours * spec.false_alarms_per_hour)
        rules: list[FoundRule] = []
        while len(rules) < spec.rules:
            rule = best_rule(heights, left, candidates.layout.rate_hz)
            least = spec.least * n_trials if not rules else max(2.0, spec.gain * n_trials)
            if rule is None or rule.near < least:
                break
            rules.append(rule)
            left -= rule.alarms
            heights = heights.without(rule)
        hits = sum(rule.hits for rule in rules)
        if hits > best[0] + spec.worth * n_trials:
            best = hits, rules, believed
        if hits >= 0.9 * n_trials or not candidates.between:
            break
    return best[1], best[2]


class _Candidates:
    """Candidates for terms (signal and sign), with their sizes in the material."""

    def __init__(self, layout: Layout, material: Material, spec: GateSpec) -> None:
        self.layout, self.material = layout, material
        self.times = layout.samples(spec.times_s)
        self.within = round(spec.within_s * layout.rate_hz)
        self.chunk = layout.samples(spec.deaf_s) + 1
        self.between = material.hours(BETWEEN) > 0
        self._xs = [s.x for s in material.stretches]
        candidates = self._signs(self._floors(signals_of(layout, spec), spec))
        promising = self._promising(candidates, spec)
        self.candidates = [candidates[k] for k in promising]
        self._sizes = [self._lasting(sizes) for sizes in self._signed(self._xs, self.candidates)]

    def _signed(self, xs: list[NDArray[np.int64]], candidates: list[tuple[Signal, int]]) -> list[NDArray[np.int32]]:
        signs = np.array([sign for _, sign in candidates], dtype=np.int32)
        sizes = signal_sizes(xs, [signal for signal, _ in candidates])
        return [np.maximum(of * signs, np.where(signs == 0, np.abs(of), 0)) for of in sizes]

    def _lasting(self, sizes: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the largest threshold at which a term holds: minimum over ``times``, then maximum over ``within``."""
        lasting = sizes.copy()
        for back in range(1, self.times):
            lasting[back:] = np.minimum(lasting[back:], sizes[:-back])
            lasting[:back] = 0
        highest = lasting.copy()
        for back in range(1, self.within + 1):
            highest[back:] = np.maximum(highest[back:], lasting[:-back])
        return highest

    def _floors(self, signals: list[Signal], spec: GateSpec) -> list[Signal]:
        """Return each signal with each floor, clipped to the range of the gate."""
        longest = sorted(self._xs, key=len)[-12:]
        sample = np.abs(np.concatenate(signal_sizes([x[: 4 * PIECE] for x in longest], signals, deviations=True)))
        floors = np.percentile(sample, [100 * share for share in spec.floors], axis=0)
        out = []
        for column, signal in enumerate(signals):
            out += [replace(signal, floor=f) for f in sorted({min(HELD, max(1, int(v))) for v in floors[:, column]})]
        return out

    def _signs(self, signals: list[Signal]) -> list[tuple[Signal, int]]:
        """Return each signal with the sign of its deviation in energetic recordings; 0 if unclear, and for jerks."""
        levels = [k for k, s in enumerate(signals) if s.kind == LEVEL]
        pieces, trials = [], []
        for stretch in self.material.stretches:
            for trial in np.unique(stretch.trial[stretch.trial >= 0]).tolist():
                at = np.flatnonzero(stretch.trial == trial)
                pieces.append(stretch.x[max(0, int(at[0]) - 300) : int(at[-1]) + 1])
                trials.append(len(at))
        some = slice(None, None, max(1, len(pieces) // 100))
        sizes = signal_sizes(pieces[some], [signals[k] for k in levels])
        ends = [(s[-n:].max(axis=0), -s[-n:].min(axis=0)) for s, n in zip(sizes, trials[some], strict=True)]
        up, down = (np.median(np.array([e[way] for e in ends]), axis=0) for way in (0, 1))
        sign = dict.fromkeys(range(len(signals)), 0)
        for k, u, d in zip(levels, up, down, strict=True):
            sign[k] = 1 if u > 1.5 * d else -1 if d > 1.5 * u else 0
        return [(signal, sign[k]) for k, signal in enumerate(signals)]

    def _promising(self, candidates: list[tuple[Signal, int]], spec: GateSpec) -> list[int]:
        """Return the indices of the candidates that best separate calm and energetic samples on their own."""
        calm, rough = [], []
        for first in range(0, len(self._xs), _TOGETHER):
            some = self.material.stretches[first : first + _TOGETHER]
            for stretch, sizes in zip(some, self._signed([s.x for s in some], candidates), strict=True):
                kind = np.where(stretch.trial >= 0, stretch.trial, np.where(stretch.trial == LEFT_OUT, -2, -1))
                edges = np.flatnonzero(np.append(True, (np.diff(kind) != 0) | (np.arange(1, len(kind)) % 50 == 0)))
                tops, kinds = np.maximum.reduceat(sizes, edges, axis=0), kind[edges]
                calm.append(tops[kinds == -1])
                for trial in np.unique(kinds[kinds >= 0]).tolist():
                    rough.append(tops[kinds == trial].max(axis=0))
        calms, roughs = np.concatenate(calm), np.array(rough)
        lax = min(len(calms), 1 + 20 * (1 + int(spec.false_alarms_per_hour * len(calms) / 7200)))
        needed = np.partition(calms, len(calms) - lax, axis=0)[len(calms) - lax] if len(calms) else 0
        order = np.argsort(-(roughs > needed).mean(axis=0), kind="stable").tolist()
        best: list[int] = []
        seen: list[Signal] = []
        for k in order:
            signal = replace(candidates[k][0], floor=1)
            if seen.count(signal) < _FLOORS and len(best) < _MOST:
                best.append(k)
                seen.append(signal)
        return best

    def heights(self, labels: list[str], between: bool) -> tuple[Heights, float]:
        """Return the sizes from which rules for ``labels`` are chosen, and the hours of calm samples in them."""
        chosen = np.array([label in labels for _, label in self.material.trials])
        calm, chunks, rough, trials, delays = [], [], [], [], []
        first_chunk = 0
        for stretch, sizes in zip(self.material.stretches, self._sizes, strict=True):
            quiet = (stretch.trial == CALM) | ((stretch.trial == BETWEEN) & between)
            calm.append(sizes[quiet])
            chunks.append(first_chunk + np.flatnonzero(quiet) // self.chunk)
            first_chunk += len(quiet) // self.chunk + 1
            at = np.flatnonzero(stretch.trial >= 0)
            at = at[chosen[stretch.trial[at]]]
            rough.append(sizes[at])
            trials.append(stretch.trial[at])
            delays.append(np.arange(len(at)) - np.searchsorted(stretch.trial[at], stretch.trial[at]))
        together = np.concatenate(trials)
        order = np.argsort(together, kind="stable")
        heights = Heights.of(
            np.concatenate(calm),
            np.concatenate(chunks),
            np.concatenate(rough)[order],
            together[order],
            np.concatenate(delays)[order],
            self._apart(),
        )
        return heights, sum(map(len, calm)) / self.layout.rate_hz / 3600

    def _apart(self) -> NDArray[np.bool_]:
        """Return which pairs of candidates may be combined: those without a common input, if there are several kinds.

        Thus a single broken sensor cannot fire a rule of two terms.
        """
        n = len(self.candidates)
        if len({c.kind for c in self.layout.channels}) == 1:
            return np.ones((n, n), dtype=bool)
        inputs = [set(signal.inputs) for signal, _ in self.candidates]
        return np.array([[not a & b for b in inputs] for a in inputs])


def signals_of(layout: Layout, spec: GateSpec) -> list[Signal]:
    """Return the candidate signals of a layout.

    These are level and jerk of each input, the jerk at one lag, and the jerk of all inputs of a kind at every lag.
    """
    groups: dict[str, list[int]] = {}
    watchable = [at for at, kind in enumerate(layout.input_kinds) if kind != "gravity"]
    for at in watchable:
        groups.setdefault(layout.input_kinds[at], []).append(at)
    lags = sorted({min(MOST_LAG, layout.samples(s)) for s in spec.lags_s})
    slow, slower = (max(1, min(15, round(math.log2(s * layout.rate_hz)))) for s in (spec.baseline_s, spec.noise_s))
    several = [tuple(group) for group in groups.values()]
    watched: list[tuple[int, tuple[int, ...], int]] = [(LEVEL, (at,), 1) for at in watchable]
    watched += [(JERK, (at,), lags[len(lags) // 2]) for at in watchable]
    watched += [(JERK, group, lag) for group in several for lag in lags if (JERK, group, lag) not in watched]
    return [Signal(kind, group, lag, 0, slow, slower) for kind, group, lag in watched]


def measure_gate(settings: GateSettings, material: Material, layout: Layout) -> dict[str, object]:
    """Run the `Gate` on the material of some people; return a report as plain values.

    It has recall by gesture, false alarms per hour in calm recordings and between recordings, and the median time from
    the first sample of a recording to the first firing in it.
    """
    first: dict[int, int] = {}
    wrong = {CALM: 0, BETWEEN: 0}
    calm_hit: set[int] = set()
    wrong_by: dict[str, int] = {}
    hits = firings(settings, [s.x for s in material.stretches])
    for stretch, fired in zip(material.stretches, hits, strict=True):
        begun = {int(t): int(np.argmax(stretch.trial == t)) for t in np.unique(stretch.trial) if t >= 0}
        for at, _ in fired:
            trial = int(stretch.trial[at])
            if trial >= 0:
                first.setdefault(trial, at - begun[trial])
            elif trial != LEFT_OUT:
                wrong[trial] += 1
                if trial == CALM:
                    calm_hit.add(int(stretch.calm[at]))
                    label = material.calm[int(stretch.calm[at])][1]
                    wrong_by[label] = wrong_by.get(label, 0) + 1
    by_gesture: dict[str, list[int]] = {}
    for trial, (_, label) in enumerate(material.trials):
        by_gesture.setdefault(label, []).append(trial)
    hours = {kind: material.hours(kind) for kind in (CALM, BETWEEN)}
    total = sum(hours.values())
    delays = [at / layout.rate_hz for at in first.values()]
    return {
        "recordings": len(material.trials),
        "recall": round(len(first) / max(1, len(material.trials)), 4),
        "recall_by_gesture": {
            label: round(sum(t in first for t in trials) / len(trials), 4) for label, trials in by_gesture.items()
        },
        "median_s_after_recording_began": round(float(np.median(delays)), 3) if delays else None,
        "calm_hours": round(hours[CALM], 3),
        "between_hours": round(hours[BETWEEN], 3),
        "false_alarms_per_hour": round(sum(wrong.values()) / total, 2) if total else None,
        "false_alarms_per_hour_in_calm_recordings": round(wrong[CALM] / hours[CALM], 2) if hours[CALM] else None,
        "false_alarms_per_hour_between": round(wrong[BETWEEN] / hours[BETWEEN], 2) if hours[BETWEEN] else None,
        "calm_recordings": len(material.calm),
        "calm_recordings_with_a_false_alarm": len(calm_hit),
        "false_alarms_by_gesture": dict(sorted(wrong_by.items())),
    }
