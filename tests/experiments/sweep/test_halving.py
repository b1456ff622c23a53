"""Successive halving on made-up learning curves: who goes on, what it costs, and what is refused before anything."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import ConfigError, TrainingError
from plushsense.experiments.sweep.halving import HalvingCosts, HalvingResult, Rung, Scores, halve, standard_error

ALIKE = np.full(26, 3.0)
RUNGS = (4, 15, 60)


class Curves:
    """Networks that learn as ``score(network, epochs)`` says, with noise on every fold; keeps what was asked."""

    def __init__(self, curve: object, noise: float = 0.0, units: int = 3) -> None:
        self._curve, self._noise, self._units = curve, noise, units
        self.rungs: list[Rung] = []

    def __call__(self, rung: Rung) -> Scores:
        self.rungs.append(rung)
        random = np.random.default_rng(rung.epochs)
        hard = random.normal(0, 0.1, self._units)
        means = np.array([self._curve(network, rung.epochs) for network in rung.entered])  # type: ignore[operator]
        return np.asarray(means[:, None] + hard + random.normal(0, self._noise, (len(means), self._units)))


def steady(network: int, epochs: int) -> float:
    return (0.5 + 0.01 * network) * (1 - math.exp(-epochs / 20))


def search(
    curves: Curves, costs: Scores = ALIKE, rungs: tuple[int, ...] = RUNGS, share: float | None = None
) -> HalvingResult:
    return halve(HalvingCosts(costs, rungs, share), curves)


def test_the_best_is_found_for_a_quarter_of_the_cost() -> None:
    curves = Curves(steady)
    found = search(curves)
    assert found.best == 25 and found.spent <= 0.25 * 26 * 3 * 60
    assert [rung.epochs for rung in curves.rungs] == [4, 15, 60]
    sizes = [len(rung.entered) for rung in curves.rungs]
    assert sizes == [26, 13, 3], "what is left is shared alike among the rungs to come"
    assert found.spent == pytest.approx(3 * (26 * 4 + 13 * 11 + 3 * 45))
    assert set(found.rungs[0].left.values()) == {"score"}
    assert {network for network, why in found.rungs[1].left.items() if why == "cost"} == {19, 20, 21, 22}
    assert found.rungs[-1].left == {} and found.rungs[-1].kept == (25, 24, 23)
    assert found.equals == ()


def test_curves_that_cross() -> None:
    """One that starts late is kept where the noise cannot tell it from the cut, and lost where it can."""

    def late(network: int, epochs: int) -> float:
        if network == 3:
            return {4: 0.1, 15: 0.55, 60: 0.9}[epochs]
        return steady(network, epochs)

    assert late(3, 4) < steady(13, 4) - 0.01
    assert search(Curves(late)).best == 25, "this far behind it is gone: no search sees what it did not train"
    # Cheap ones leave room within the budget for all that the noise cannot tell apart.
    cheap = ALIKE.copy()
    cheap[:10] = 0.1
    noisy = search(Curves(late, noise=0.03), cheap)
    first = noisy.rungs[0]
    assert first.error is not None and 0.01 < first.error < 0.04
    assert first.means[3] < sorted(first.means.values())[12], "it was behind the cut"
    assert noisy.best == 3


def test_within_one_standard_error_of_the_best_is_said() -> None:
    found = search(Curves(lambda network, epochs: 0.5 + 1e-4 * network, noise=0.05))
    last = found.rungs[-1]
    assert last.error is not None
    apart = {n: last.means[found.best] - mean for n, mean in last.means.items() if n != found.best}
    assert set(found.equals) == {n for n, gap in apart.items() if gap <= last.error}


@settings(max_examples=150)
@given(
    costs=st.lists(st.floats(0.05, 20.0), min_size=2, max_size=30),
    seed=st.integers(0, 10_000),
    noise=st.sampled_from([0.0, 0.02, 0.2]),
    eta=st.sampled_from([1.5, 2.0, 3.0]),
    share=st.sampled_from([0.15, 0.25, 0.6, 1.0]),
)
def test_never_more_than_the_bound(costs: list[float], seed: int, noise: float, eta: float, share: float) -> None:
    table = np.array(costs)
    skill = np.random.default_rng(seed).uniform(0.3, 0.9, len(costs))
    curves = Curves(lambda network, epochs: skill[network] * epochs / (epochs + 9), noise)
    made = HalvingCosts(table, RUNGS, share, eta)
    if made.least > share * (1 + 1e-9):
        with pytest.raises(ConfigError, match="too small"):
            halve(made, curves)
        assert not curves.rungs, "refused before anything is trained"
        return
    found = halve(made, curves)
    assert found.spent <= made.bound * (1 + 1e-9)
    # What was spent, counted network by network.
    done = {network: rung.epochs for rung in curves.rungs for network in rung.entered}
    assert found.spent == pytest.approx(sum(table[network] * epochs for network, epochs in done.items()))
    for compared, after in zip(found.rungs, [*curves.rungs[1:], None], strict=True):
        assert set(compared.kept) | set(compared.left) == set(compared.rung.entered)
        assert not set(compared.kept) & set(compared.left)
        assert compared.kept[0] == max(compared.means, key=lambda n: compared.means[n]), "the leader always goes on"
        assert after is None or after.entered == compared.kept
    assert found.best == found.rungs[-1].kept[0]


def test_a_share_that_is_too_small_says_which_suffices() -> None:
    costs = np.array([8.0, 1.0, 1.0])
    with pytest.raises(
        ConfigError, match=r"all 3 networks up to epoch 4 and one of them to the end may take 0\.813"
    ) as refused:
        search(Curves(steady, units=1), costs, rungs=(4, 60), share=0.25)
    share = float(str(refused.value).split("share of ")[-1].split(",")[0])
    curves = Curves(lambda network, epochs: 1.0 - network / 10, units=1)
    assert search(curves, costs, rungs=(4, 60), share=share).best == 0
    # Where none is given: two can be trained to the end.
    few = HalvingCosts(np.ones(4), RUNGS)
    assert few.share == pytest.approx(0.534) and len(halve(few, Curves(steady)).rungs[-1].rung.entered) == 2
    assert search(Curves(steady), np.full(1, 3.0)).spent == 60 * 3


def test_what_fails_is_left_out() -> None:
    def breaks(network: int, epochs: int) -> float:
        return math.nan if network == 25 and epochs > 4 else steady(network, epochs)

    found = search(Curves(breaks))
    assert found.best == 24 and found.rungs[1].left[25] == "failed" and found.rungs[1].error is not None
    with pytest.raises(TrainingError, match="Every training failed by epoch 4"):
        search(Curves(lambda network, epochs: math.nan))


def test_the_standard_error_is_that_of_a_difference() -> None:
    random = np.random.default_rng(0)
    draws = [
        0.5 + random.normal(0, 0.1, (26, 1)) + random.normal(0, 0.2, (1, 6)) + random.normal(0, 0.03, (26, 6))
        for _ in range(200)
    ]
    assert np.mean([standard_error(d) for d in draws]) == pytest.approx(0.03 * math.sqrt(2 / 6), rel=0.03)
    assert standard_error(np.ones((1, 6))) is None and standard_error(np.ones((6, 1))) is None
