"""The gate: threshold rules that detect an energetic gesture within a few samples, in integers only.

This module is the specification that ``deploy/c/plushsense.c`` implements, in 32 bits. The gate gets the raw inputs of
the network, one even sample at a time. It works from the first samples on, before the network has filled its span.

- Inputs are shifted right by the ``shift`` bits of a signal and clipped to ±2^20. A *signal* is computed from one or
  several of them: a ``level`` is the input itself; a ``jerk`` is the sum over its inputs of the absolute change since
  ``lag`` samples ago (0 while there are fewer samples), clipped to 2^20.
- The *baseline* of a signal is its exponential mean with the weight 2^-baseline. Its *noise* is the exponential mean of
  the absolute deviation from the baseline, with the weight 2^-noise; each deviation is limited to 4 · (noise +
  ``floor``), so that one blow does not raise the noise for long. The initial baseline is the first value of the
  signal, the initial noise is 0. Both are stored with 8 extra bits.
- The *size* of a signal is ⌊16 · absolute deviation / (noise + ``floor``)⌋.
- A *term* of a rule holds if the size was at least ``threshold`` for ``times`` samples in a row (``sign`` 1: above
  the baseline only, -1: below only, 0: both), and for ``within`` further samples.
- A *rule* fires when all its terms hold. The first such rule is reported; after it, no rule fires for ``deaf`` samples,
  while signals and terms are still updated.

Suspect samples (see `plushsense.runtime.health`) and samples with the same inputs as the one before (the toy hangs) are
skipped, except that they count for ``deaf``. So terms continue after a blow that saturates a sensor for a moment. After
`DOUBT` suspect samples in a row, the rest of the state is reset: a sensor that jumps to its limit and back is broken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from plushsense.core.errors import BundleError

LEVEL, JERK = 0, 1
HELD = 1 << 20
EXTRA_BITS = 8
THRESHOLD_BITS = 4
NOISE_CLIP = 4
DOUBT = 10
MOST_SIZE = 2 * HELD << THRESHOLD_BITS  # a deviation of 2^21 divided by a floor of 1
MOST_SIGNALS, MOST_RULES, MOST_TERMS, MOST_LAG = 32, 16, 8, 16


@dataclass(frozen=True)
class Signal:
    """A signal of the gate; the docstring of the module has its formulas.

    Attributes:
        kind: 0: the level, the input itself; 1: the jerk, the sum of the changes of its inputs (0 to 1).
        inputs: numbers of the network's inputs, counted from 0; a level has one.
        lag: samples since which a change is measured (1 to 16).
        shift: bits by which the inputs are shifted to the right before all else (0 to 24).
        baseline: binary logarithm of the samples over which the signal's baseline is averaged (1 to 15).
        noise: binary logarithm of the samples over which its noise is averaged (1 to 15).
        floor: what is added to the noise before the deviation is divided by it (1 to 1048576).
    """

    kind: int
    inputs: tuple[int, ...]
    lag: int = 1
    shift: int = 0
    baseline: int = 7
    noise: int = 8
    floor: int = 1


@dataclass(frozen=True)
class Term:
    """A condition of a rule: a signal deviates from its baseline.

    Attributes:
        signal: number of the signal, counted from 0.
        threshold: smallest size, 16 times the deviation divided by the noise (1 to 33554432).
        sign: 1: only above the baseline; -1: only below it; 0: both (-1 to 1).
        times: samples in a row with that size (1 to 255).
    """

    signal: int
    threshold: int
    sign: int = 0
    times: int = 2


@dataclass(frozen=True)
class Rule:
    """A rule of the gate, which fires when all its terms hold within some samples.

    Attributes:
        terms: conditions, 1 to 8.
        affect: affect that it reports: 0 none, 1 positive, 2 neutral, 3 negative (0 to 3).
        gesture: number of the class that it reports, counted from 0; 255: none (0 to 255).
        within: samples for which a term still counts after it held (0 to 255).
        deaf: samples after it fires in which no rule does (0 to 65535).
    """

    terms: tuple[Term, ...]
    affect: int
    gesture: int
    within: int = 5
    deaf: int = 50


@dataclass(frozen=True)
class GateSettings:
    """Signals and rules of a `Gate`; without rules, it never fires.

    Attributes:
        signals: what the rules look at, at most 32 signals.
        rules: at most 16 rules; the first that fires is reported.

    Raises:
        BundleError: for a number outside the range of the toy, or an unknown signal.
    """

    signals: tuple[Signal, ...] = ()
    rules: tuple[Rule, ...] = ()

    def __post_init__(self) -> None:
        _within("signals", len(self.signals), 0, MOST_SIGNALS)
        _within("rules", len(self.rules), 0, MOST_RULES)
        for s in self.signals:
            _all_within(s, kind=(LEVEL, JERK), lag=(1, MOST_LAG), shift=(0, 24), baseline=(1, 15), noise=(1, 15))
            _all_within(s, floor=(1, HELD))
            _within("inputs of a signal", len(s.inputs), 1, 1 if s.kind == LEVEL else 255)
            for i in s.inputs:
                _within("input", i, 0, 254)
        for rule in self.rules:
            _within("terms of a rule", len(rule.terms), 1, MOST_TERMS)
            _all_within(rule, affect=(0, 3), gesture=(0, 255), within=(0, 255), deaf=(0, 65535))
            for term in rule.terms:
                _within("signal of a term", term.signal, 0, len(self.signals) - 1)
                _all_within(term, threshold=(1, MOST_SIZE), sign=(-1, 1), times=(1, 255))


def _all_within(part: Signal | Rule | Term, **ranges: tuple[int, int]) -> None:
    for name, (low, high) in ranges.items():
        _within(name, getattr(part, name), low, high)


def _within(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise BundleError(f"The gate's settings have {name} {value!r}; accepted are {low} to {high}.")


class Gate:
    """The gate of one stream; ``sizes`` and ``deviations`` are those of each signal at the last sample not skipped."""

    def __init__(self, settings: GateSettings) -> None:
        self.settings = settings
        self._longest = max((s.lag for s in settings.signals if s.kind == JERK), default=1)
        self._signals = []
        for at, s in enumerate(settings.signals):
            several, lag = s.inputs if len(s.inputs) > 1 else (), s.lag if s.kind == JERK else 0
            self._signals.append((at, s.inputs[0], several, lag, s.shift, s.baseline, s.noise, s.floor))
        self._rules = [
            (at, [(t.signal, t.threshold, t.sign, t.times) for t in rule.terms], rule.within + 1)
            for at, rule in enumerate(settings.rules)
        ]
        self.reset()

    def reset(self) -> None:
        """Start a new stream, as after a gap, a clock reset or a sensor fault."""
        self._deaf = self._doubt = 0
        self._forget()

    def _forget(self) -> None:
        n = len(self.settings.signals)
        self._past: list[list[int]] = []  # earlier samples, newest last, as many as the longest lag
        self._baseline = [0] * n
        self._noise = [0] * n
        self.deviations, self.sizes = [0] * n, [0] * n
        self._rows = [[0] * len(rule.terms) for rule in self.settings.rules]
        self._holds = [[0] * len(rule.terms) for rule in self.settings.rules]

    def push(self, inputs: Sequence[int], suspect: bool = False) -> int:
        """Add the inputs (I,) of one sample; return the index of the rule that fires, or -1."""
        if not self._rules:
            return -1
        deaf = self._deaf > 0
        if deaf:
            self._deaf -= 1
        now, past = list(inputs), self._past
        if suspect:
            self._doubt += 1
            if self._doubt == DOUBT:
                self._forget()
            return -1
        self._doubt = 0
        if past and past[-1] == now:
            return -1
        self._follow(now)
        past.append(now)
        if len(past) > self._longest:
            del past[0]
        fired = self._judge()
        if deaf or fired < 0:
            return -1
        self._deaf = self.settings.rules[fired].deaf
        return fired

    def _follow(self, now: list[int]) -> None:
        # Optimised: clipping is inlined and the usual case comes first, as this runs for every sample.
        past, baseline, noise = self._past, self._baseline, self._noise
        for at, one, several, lag, shift, slow, slower, floor in self._signals:
            if lag == 0:
                value = now[one] >> shift
                if not -HELD <= value <= HELD:
                    value = _held(value)
            elif len(past) < lag:
                value = 0
            else:
                before, value = past[-lag], 0
                for i in several or (one,):
                    a, b = now[i] >> shift, before[i] >> shift
                    if -HELD <= a <= HELD and -HELD <= b <= HELD:
                        value += a - b if a > b else b - a
                    else:
                        value += abs(_held(a) - _held(b))
                if value > HELD:
                    value = HELD
            high = value << EXTRA_BITS
            if not past:
                baseline[at] = high
            base = baseline[at]
            deviation = value - (base >> EXTRA_BITS)
            size = -deviation if deviation < 0 else deviation
            level = (noise[at] >> EXTRA_BITS) + floor
            self.deviations[at] = deviation
            self.sizes[at] = (size << THRESHOLD_BITS) // level
            baseline[at] = base + ((high - base) >> slow)
            if size > NOISE_CLIP * level:
                size = NOISE_CLIP * level
            noise[at] += ((size << EXTRA_BITS) - noise[at]) >> slower

    def _judge(self) -> int:
        sizes, deviations, fired = self.sizes, self.deviations, -1
        for at, terms, hold in self._rules:
            rows, holds = self._rows[at], self._holds[at]
            every = True
            for n, (signal, threshold, sign, times) in enumerate(terms):
                if sizes[signal] >= threshold and (sign == 0 or (deviations[signal] > 0) == (sign > 0)):
                    if rows[n] < times:
                        rows[n] += 1
                    if rows[n] == times:
                        holds[n] = hold
                else:
                    rows[n] = 0
                if holds[n]:
                    holds[n] -= 1
                else:
                    every = False
            if every and fired < 0:
                fired = at
        return fired


def _held(value: int) -> int:
    return value if -HELD <= value <= HELD else HELD if value > 0 else -HELD
