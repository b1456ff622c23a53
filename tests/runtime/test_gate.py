"""The gate: what makes it fire, what does not, and that a toy's 32 bits hold all of it."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from plushsense.core.errors import BundleError, ConfigError
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.gate import (
    HELD,
    JERK,
    LEVEL,
    Gate,
    GateSettings,
    Rule,
    Signal,
    Term,
)
from plushsense.runtime.replay import firings, follow, raw_signals
from plushsense.tuning.gate import signal_sizes

pytestmark = pytest.mark.slow

BLOW = Rule((Term(0, 32, times=2),), affect=3, gesture=255, within=3, deaf=5)
LEVELS = GateSettings((Signal(LEVEL, (0,), floor=10),), (BLOW,))


def fired(settings: GateSettings, rows: list[list[int]], suspects: set[int] = frozenset()) -> list[tuple[int, int]]:
    """(sample, rule) of every firing, which is the same for a stretch among several."""
    gate = Gate(settings)
    heard = [(at, gate.push(row, at in suspects)) for at, row in enumerate(rows)]
    found = [(at, rule) for at, rule in heard if rule >= 0]
    x, doubts = np.array(rows), np.isin(np.arange(len(rows)), list(suspects))
    assert firings(settings, [x[:0], x, x[: len(x) // 3], x], [doubts[:0], doubts, doubts[: len(x) // 3], doubts]) == [
        [], found, [hit for hit in found if hit[0] < len(x) // 3], found
    ]  # fmt: skip
    assert firings(settings, [x], [doubts]) == [found]
    return found


def tremble(values: list[int]) -> list[list[int]]:
    """One input beside another that trembles, as real sensors do: no sample repeats the one before."""
    return [[value, at % 2] for at, value in enumerate(values)]


def test_it_fires_at_the_second_high_sample_and_is_then_deaf() -> None:
    # 32 sixteenths of a floor of 10: from a deviation of 20 on.
    assert fired(LEVELS, tremble([100] * 20 + [119] * 5)) == []
    assert fired(LEVELS, tremble([100] * 20 + [121] * 3)) == [(21, 0)]
    assert fired(LEVELS, tremble([100] * 20 + [400] + [100] * 10)) == []  # one sample is no row
    assert fired(LEVELS, tremble([100] * 20 + [2000] * 9)) == [(21, 0), (27, 0)]  # deaf for five between


def test_the_second_sample_may_be_a_blow() -> None:
    at_once = GateSettings(LEVELS.signals, (Rule((Term(0, 32),), 3, 255), Rule((Term(0, 32, times=1),), 3, 255, 0, 2)))
    assert fired(at_once, tremble([100] + [400] * 4)) == [(1, 1), (4, 0)]


def test_a_slow_drift_of_any_size_is_followed() -> None:
    """Humidity: the baseline goes with it."""
    assert fired(LEVELS, tremble([100 + at // 12 for at in range(60_000)])) == []


def test_what_trembles_more_must_stand_out_further() -> None:
    quiet, loud = np.random.default_rng(1).integers(-3, 4, 1500), np.random.default_rng(1).integers(-90, 91, 1500)
    blow = np.r_[np.zeros(1400), np.full(100, 60)]
    settled = 1000  # until then the noise is still being learnt
    for noise, heard in ((quiet, True), (loud, False)):
        strict = GateSettings(LEVELS.signals, (Rule((Term(0, 48),), 3, 255),))
        late = [at for at, _ in fired(strict, tremble((noise + blow).astype(int).tolist())) if at > settled]
        assert (1401 in late) is heard


@pytest.mark.parametrize(("sign", "up", "down"), [(0, 1, 1), (1, 1, 0), (-1, 0, 1)])
def test_a_sign_hears_one_way_only(sign: int, up: int, down: int) -> None:
    settings = GateSettings(LEVELS.signals, (Rule((Term(0, 32, sign),), 3, 255),))
    assert len(fired(settings, tremble([100] * 9 + [200] * 9))) == up
    assert len(fired(settings, tremble([100] * 9 + [0] * 9))) == down


def test_terms_must_hold_together_but_may_come_a_little_apart() -> None:
    both = Rule((Term(0, 32, times=1), Term(1, 32, times=1)), 3, 7, within=3)
    settings = GateSettings((Signal(JERK, (0,), floor=10), Signal(JERK, (1,), floor=10)), (both,))

    def rows(apart: int) -> list[list[int]]:
        return [[100 * (at >= 10), 100 * (at >= 10 + apart), at % 2] for at in range(40)]

    assert fired(settings, rows(0)) == [(10, 0)]
    assert fired(settings, rows(3)) == [(13, 0)]
    assert fired(settings, rows(4)) == []


def test_the_first_of_two_rules_speaks() -> None:
    settings = GateSettings(LEVELS.signals, (Rule((Term(0, 999),), 1, 255), BLOW, BLOW))
    assert fired(settings, tremble([100] * 9 + [200] * 4)) == [(10, 1)]


def test_jerk_adds_the_changes_of_several_inputs() -> None:
    settings = GateSettings((Signal(JERK, (0, 1), lag=2, floor=10),), (Rule((Term(0, 32, times=2),), 3, 255),))
    gate = Gate(settings)
    for row in ([0, 0], [1, 1], [2, 2], [15, -13]):
        gate.push(row)
    assert gate.deviations == [14 + 14 - (4 >> 7)] and gate.sizes == [28 * 16 // 10]


def test_a_hung_toy_is_not_read() -> None:
    rows = [[100, at % 2] for at in range(20)] + [[900, 5]] * 50 + [[100, at % 2] for at in range(20)]
    assert fired(LEVELS, rows) == []


def test_suspect_samples_are_not_read_and_after_some_it_begins_anew() -> None:
    """A sensor at its end stop: neither the jump there nor the one back is a blow."""
    jump = [100] * 30 + [30_000] * 20 + [100] * 30
    jerks = GateSettings((Signal(JERK, (0,), lag=4, floor=10),), (BLOW,))
    for settings in (LEVELS, jerks):
        assert fired(settings, tremble(jump))  # nobody said that it is broken
        assert fired(settings, tremble(jump), set(range(31, 50))) == []
        assert fired(settings, tremble([*jump, 900, 900]), set(range(31, 50)))[0][0] == 81


def test_a_blow_that_touches_the_end_stop_is_one() -> None:
    hit = [100] * 30 + [30_000, 30_000, 30_000, 20_000] + [100] * 30
    assert fired(LEVELS, tremble(hit), {31, 32})[0][0] == 33
    # Up to nine suspect samples in its middle; after ten, all begins anew.
    for doubts, heard in ((9, [(40, 0)]), (10, [])):
        longer = tremble([100] * 30 + [30_000] * (1 + doubts) + [20_000])
        assert fired(LEVELS, longer, set(range(31, 31 + doubts))) == heard


def test_a_reset_forgets_the_deafness_too() -> None:
    gate = Gate(LEVELS)
    rows = tremble([100] * 9 + [200] * 2)
    assert [gate.push(r) for r in rows][-1] == 0
    gate.reset()
    assert [gate.push(r) for r in rows][-1] == 0


def test_no_rule_never_fires() -> None:
    assert fired(GateSettings(), [[1], [99999]] * 9) == []


def test_32_bits_hold_it() -> None:
    """`follow` computes in int32 throughout: with the largest inputs it gives what unbounded integers give."""
    draw = np.random.default_rng(2)
    ends = np.array([-(2**31), 2**31 - 1, 0, HELD, -HELD - 1])
    x = ends[draw.integers(0, 5, (3000, 40))]
    x[1000:2000] = draw.integers(-(2**31), 2**31, (1000, 40))
    signals = tuple(
        Signal(kind, inputs, lag, shift, baseline, noise, floor)
        for kind, inputs in ((LEVEL, (3,)), (JERK, (0,)), (JERK, tuple(range(40)) * 6))
        for lag, shift, baseline, noise, floor in ((1, 0, 1, 1, 1), (16, 0, 15, 15, HELD), (3, 11, 7, 8, 50))
    )
    gate = Gate(GateSettings(signals, (BLOW,)))
    slow = []
    for row in x.tolist():
        gate.push(row)
        slow.append([s if d > 0 else -s for s, d in zip(gate.sizes, gate.deviations, strict=True)])
    assert (np.array(slow) == signal_sizes([x], signals)[0]).all()
    assert np.abs(slow).max() < 2**31


@pytest.mark.parametrize(
    "change",
    [{"floor": 0}, {"lag": 17}, {"shift": 25}, {"inputs": (0, 1)}, {"kind": 2}, {"noise": 0}, {"inputs": (255,)}],
)
def test_a_signal_that_no_toy_could_hold_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(BundleError, match="accepted are"):
        GateSettings((Signal(**{"kind": LEVEL, "inputs": (0,), **change}),))


def test_a_term_of_a_signal_that_is_not_there_is_refused() -> None:
    with pytest.raises(BundleError, match="signal of a term 1"):
        GateSettings(LEVELS.signals, (Rule((Term(1, 32),), 3, 255),))


def test_plain_values_and_back() -> None:
    assert DecideSpec.from_dict({"gate": asdict(LEVELS)}).gate == LEVELS
    assert DecideSpec.from_dict({"gate": {}}).gate == GateSettings()
    with pytest.raises(ConfigError, match=r"gate\.signals\[0\]\.inputs is missing"):
        DecideSpec.from_dict({"gate": {"signals": [{"kind": 0}]}})


def test_no_sample_is_suspect_unless_named_and_stretches_together_fire_as_alone() -> None:
    x = np.array(tremble([100] * 20 + [121] * 3))
    assert firings(LEVELS, [x]) == firings(LEVELS, [x], [np.zeros(23, dtype=np.bool_)]) == [[(21, 0)]]
    assert firings(LEVELS, [x, x, x[:3]]) == [[(21, 0)], [(21, 0)], []]
    assert firings(LEVELS, []) == [] and firings(LEVELS, [x[:0]]) == [[]]
    assert firings(GateSettings(), [x, x]) == [[], []]


def test_raw_signals_are_computed_once_for_signals_that_differ_only_later() -> None:
    x = np.array([[0, 5], [-8, 1], [-40, 1], [2**30, -3]])
    signals = (
        Signal(LEVEL, (0,), floor=10), Signal(LEVEL, (0,), floor=99), Signal(LEVEL, (0,), shift=3),
        Signal(JERK, (0, 1), lag=2), Signal(JERK, (1,)),
    )  # fmt: skip
    assert raw_signals(x, signals).T.tolist() == [
        [0, -8, -40, HELD], [0, -8, -40, HELD], [0, -1, -5, HELD], [0, 0, 44, HELD], [0, 4, 0, 4]
    ]  # fmt: skip
    block = raw_signals(x[:2], signals).astype(np.int32)[:, None]
    assert follow(block[:0].copy(), signals).shape == (0, 1, 5)
    # The baseline begins with the first sample, and the size is in sixteenths of the floor.
    assert follow(block.copy(), signals, deviations=True)[:, 0].tolist() == [[0] * 5, [-8, -8, -1, 0, 4]]
    assert follow(block[..., :2].copy(), signals[:2])[1, 0].tolist() == [-(8 * 16 // 10), -(8 * 16 // 99)]


RANGES = [
    (Signal, "kind", 0, 1), (Signal, "lag", 1, 16), (Signal, "shift", 0, 24), (Signal, "baseline", 1, 15),
    (Signal, "noise", 1, 15), (Signal, "floor", 1, 1 << 20), (Rule, "affect", 0, 3), (Rule, "gesture", 0, 255),
    (Rule, "within", 0, 255), (Rule, "deaf", 0, 65535), (Term, "signal", 0, 0), (Term, "threshold", 1, 1 << 25),
    (Term, "sign", -1, 1), (Term, "times", 1, 255),
]  # fmt: skip


@pytest.mark.parametrize(("part", "name", "low", "high"), RANGES)
def test_every_setting_at_the_ends_of_its_range(part: type, name: str, low: int, high: int) -> None:
    def made(value: object) -> GateSettings:
        change = {name: value}
        signal = replace(LEVELS.signals[0], **change) if part is Signal else LEVELS.signals[0]
        term = replace(BLOW.terms[0], **change) if part is Term else BLOW.terms[0]
        rule = replace(BLOW, **change) if part is Rule else BLOW
        return GateSettings((signal,), (replace(rule, terms=(term,)),))

    assert made(low) and made(high)
    for wrong in (low - 1, high + 1, True, float(high)):
        with pytest.raises(BundleError, match=f"accepted are {low} to {high}"):
            made(wrong)


def test_how_many_signals_rules_terms_and_inputs_there_may_be() -> None:
    signal, term = LEVELS.signals[0], BLOW.terms[0]
    jerk = Signal(JERK, (254,) * 255, floor=10)
    assert GateSettings((signal,) * 31 + (jerk,), (replace(BLOW, terms=(term,) * 8),) * 16)
    for settings in (
        ((signal,) * 33, ()), ((signal,), (BLOW,) * 17), ((signal,), (replace(BLOW, terms=(term,) * 9),)),
        ((signal,), (replace(BLOW, terms=()),)), ((replace(jerk, inputs=(0,) * 256),), ()),
        ((replace(signal, inputs=()),), ()), ((replace(signal, inputs=(-1,)),), ()),
    ):  # fmt: skip
        with pytest.raises(BundleError, match="The gate's settings have .*accepted are"):
            GateSettings(*settings)
