"""The gate: threshold rules that notice an energetic event within a few samples, in whole numbers only.

This room defines when a toy's gate fires; ``deploy/c/plushsense.c`` repeats it. It reads the network's inputs, raw, one
even sample at a time, and works from the first samples on, while the network is still warming.

- A *signal* is made of one input, or of several: ``level`` is the input itself; ``jerk`` the sum over the inputs of the
  absolute change from ``lag`` samples ago. Each is shifted down by ``shift`` bits and held within ± 2^20.
- Its *baseline* is an exponential mean with the weight 2^-baseline, its *noise* that of the deviation from the
  baseline with the weight 2^-noise; a deviation counts there with at most 4 times noise plus floor, so that one blow
  does not deafen the gate. Both begin with the signal's first value, and a noise of 0. They are kept with 8 more bits.
- A *term* of a rule holds while the deviation (``sign`` 1: above the baseline only, -1: below only, 0: either way) is
  at least ``threshold`` / 16 times noise plus ``floor`` for ``times`` samples in a row, and ``within`` samples longer.
- A *rule* fires when all its terms hold; then it is deaf for ``deaf`` samples. The first rule that fires speaks.

Samples that repeat the one before exactly, and suspect ones, break every row and hold nothing: a sensor that jumps and
stays exactly there is broken, not hit (see ``models/health``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from plushsense.core.errors import BundleError

LEVEL, JERK = 0, 1
HELD = 1 << 20
EXTRA_BITS = 8
THRESHOLD_BITS = 4
NOISE_CLIP = 4
MOST_SIGNALS, MOST_RULES, MOST_TERMS, MOST_LAG = 32, 16, 8, 16


@dataclass(frozen=True)
class Signal:
    """What is watched: ``kind`` `LEVEL` or `JERK` of ``inputs``, and how its baseline and noise follow it."""

    kind: int
    inputs: tuple[int, ...]
    lag: int = 1
    shift: int = 0
    baseline: int = 7
    noise: int = 8
    floor: int = 1


@dataclass(frozen=True)
class Term:
    """``signal`` (an index) deviates by ``threshold`` / 16 times noise plus floor."""

    signal: int
    threshold: int
    sign: int = 0
    times: int = 2


@dataclass(frozen=True)
class Rule:
    """All ``terms`` within ``within`` samples; it says ``affect`` and ``gesture`` (a class index, 255: none)."""

    terms: tuple[Term, ...]
    affect: int
    gesture: int
    within: int = 5
    deaf: int = 50


@dataclass(frozen=True)
class GatePlan:
    """Signals and rules of `Gate`; none at all is a gate that never fires.

    Raises:
        BundleError: for a number that the toy could not hold, or a signal that there is not.
    """

    signals: tuple[Signal, ...] = ()
    rules: tuple[Rule, ...] = ()

    def __post_init__(self) -> None:
        _within("signals", len(self.signals), 0, MOST_SIGNALS)
        _within("rules", len(self.rules), 0, MOST_RULES)
        for s in self.signals:
            _within("signal kind", s.kind, LEVEL, JERK)
            _within("inputs of a signal", len(s.inputs), 1, 1 if s.kind == LEVEL else 255)
            for i in s.inputs:
                _within("input", i, 0, 254)
            _within("lag", s.lag, 1, MOST_LAG)
            _within("shift", s.shift, 0, 24)
            _within("baseline", s.baseline, 1, 15)
            _within("noise", s.noise, 1, 15)
            _within("floor", s.floor, 1, HELD)
        for rule in self.rules:
            _within("terms of a rule", len(rule.terms), 1, MOST_TERMS)
            _within("affect", rule.affect, 0, 3)
            _within("gesture", rule.gesture, 0, 255)
            _within("within", rule.within, 0, 255)
            _within("deaf", rule.deaf, 0, 65535)
            for term in rule.terms:
                _within("signal of a term", term.signal, 0, len(self.signals) - 1)
                _within("threshold", term.threshold, 0, 65535)
                _within("sign", term.sign, -1, 1)
                _within("times", term.times, 1, 255)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> GatePlan:
        """A plan from plain values.

        Raises:
            BundleError: for values that do not fit.
        """
        try:
            signals = tuple(Signal(**{**s, "inputs": tuple(s["inputs"])}) for s in table.get("signals", ()))
            rules = tuple(Rule(**{**r, "terms": tuple(Term(**t) for t in r["terms"])}) for r in table.get("rules", ()))
            return cls(signals, rules)
        except (KeyError, TypeError, AttributeError) as cause:
            raise BundleError(f"The gate's plan does not fit ({cause}): train again.") from None


def _within(what: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise BundleError(f"The gate's plan has {what} {value!r}; accepted are {low} to {high}.")


class Gate:
    """Follows one stream of inputs."""

    def __init__(self, plan: GatePlan) -> None:
        self.plan = plan
        self.reset()

    def reset(self) -> None:
        """Forget everything: after a gap, a clock reset, a fault."""
        n = len(self.plan.signals)
        self._past: list[Sequence[int]] = []  # the newest last, as many as the longest lag needs
        self._baseline = [0] * n
        self._noise = [0] * n
        self._begun = [False] * n
        self.deviation = [0] * n
        self.level = [1] * n
        self._rows = [[0] * len(rule.terms) for rule in self.plan.rules]
        self._holds = [[0] * len(rule.terms) for rule in self.plan.rules]
        self._deaf = [0] * len(self.plan.rules)
        self._longest = max((s.lag for s in self.plan.signals if s.kind == JERK), default=1)

    def push(self, inputs: Sequence[int], suspect: bool = False) -> int:
        """One sample's inputs (I,): the index of the rule that fires, or -1."""
        plan = self.plan
        if not plan.rules:
            return -1
        past = self._past
        suspect = suspect or (bool(past) and list(past[-1]) == list(inputs))
        for at, signal in enumerate(plan.signals):
            self._follow(at, signal, inputs)
        past.append(inputs)
        if len(past) > self._longest:
            del past[0]
        fired = -1
        for at, rule in enumerate(plan.rules):
            if self._holding(at, rule, suspect) and self._deaf[at] == 0 and fired < 0:
                fired = at
                self._deaf[at] = rule.deaf
            elif self._deaf[at] > 0:
                self._deaf[at] -= 1
        return fired

    def _follow(self, at: int, signal: Signal, inputs: Sequence[int]) -> None:
        if signal.kind == LEVEL:
            value = inputs[signal.inputs[0]]
        elif len(self._past) >= signal.lag:
            before = self._past[-signal.lag]
            value = sum(abs(inputs[i] - before[i]) for i in signal.inputs)
        else:
            value = 0
        value = max(-HELD, min(HELD, value >> signal.shift))
        if not self._begun[at]:
            self._begun[at] = True
            self._baseline[at] = value << EXTRA_BITS
        base = self._baseline[at]
        deviation = value - (base >> EXTRA_BITS)
        level = (self._noise[at] >> EXTRA_BITS) + signal.floor
        self.deviation[at], self.level[at] = deviation, level
        self._baseline[at] = base + (((value << EXTRA_BITS) - base) >> signal.baseline)
        size = min(abs(deviation), NOISE_CLIP * level)
        self._noise[at] += ((size << EXTRA_BITS) - self._noise[at]) >> signal.noise

    def _holding(self, at: int, rule: Rule, suspect: bool) -> bool:
        rows, holds = self._rows[at], self._holds[at]
        every = True
        for n, term in enumerate(rule.terms):
            deviation, level = self.deviation[term.signal], self.level[term.signal]
            size = deviation if term.sign > 0 else -deviation if term.sign < 0 else abs(deviation)
            if suspect:
                rows[n] = holds[n] = 0
            elif size > 0 and (size << THRESHOLD_BITS) >= term.threshold * level:
                rows[n] = min(rows[n] + 1, 255)
            else:
                rows[n] = 0
            if rows[n] >= term.times:
                holds[n] = rule.within + 1
            if holds[n] == 0:
                every = False
            else:
                holds[n] -= 1
        return every
