"""Successive halving on made-up learning curves: who goes on, what it costs, and what is refused before anything."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import ConfigError, TrainingError
from plushsense.experiments.search.halving import (
    DEFAULTS,
    Costs,
    Halved,
    Rung,
    Scores,
    SearchSpec,
    Space,
    drawn,
    halving,
    limits_text,
    load_search,
    none_left,
    problems,
    standard_error,
)
from plushsense.experiments.search.halving import problems_space as space_problems
from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.scoring.metrics import pareto_front

ALIKE = np.ones((26, 3))


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
        units = self._units if rung.folds == 3 else rung.folds
        return np.asarray(means[:, None] + hard[:units] + random.normal(0, self._noise, (len(means), units)))


def steady(network: int, epochs: int) -> float:
    return (0.5 + 0.01 * network) * (1 - math.exp(-epochs / 20))


def search(curves: Curves, costs: Scores = ALIKE, **changes: object) -> Halved:
    return halving(Costs(costs, SearchSpec(**changes)), curves)  # type: ignore[arg-type]


def test_the_best_is_found_for_a_quarter_of_the_cost() -> None:
    curves = Curves(steady)
    found = search(curves)
    assert found.best == 25 and found.spent <= found.bound == pytest.approx(0.25 * 26 * 3 * 60)
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
    folds=st.sampled_from([(), (1, 2), (1, 3)]),
)
def test_never_more_than_the_bound(
    costs: list[float], seed: int, noise: float, eta: float, share: float, folds: tuple[int, ...]
) -> None:
    random = np.random.default_rng(seed)
    table = np.outer(costs, random.uniform(0.9, 1.1, 3))
    skill = random.uniform(0.3, 0.9, len(costs))
    curves = Curves(lambda network, epochs: skill[network] * epochs / (epochs + 9), noise)
    made = Costs(table, SearchSpec(eta=eta, share=share, folds=folds))
    if made.least > share * (1 + 1e-9):
        with pytest.raises(ConfigError, match="too small"):
            halving(made, curves)
        assert not curves.rungs, "refused before anything is trained"
        return
    found = halving(made, curves)
    assert found.spent <= found.bound * (1 + 1e-9)
    # What was spent, counted training by training.
    done: dict[tuple[int, int], int] = {}
    for rung in curves.rungs:
        for network in rung.entered:
            for fold in range(rung.folds):
                done[network, fold] = rung.epochs
    assert found.spent == pytest.approx(sum(table[network, fold] * e for (network, fold), e in done.items()))
    for compared, after in zip(found.rungs, [*curves.rungs[1:], None], strict=True):
        assert set(compared.kept) | set(compared.left) == set(compared.rung.entered)
        assert not set(compared.kept) & set(compared.left)
        assert compared.kept[0] == max(compared.means, key=lambda n: compared.means[n]), "the leader always goes on"
        assert after is None or after.entered == compared.kept
    assert found.rungs[-1].rung.folds == 3
    assert found.best == found.rungs[-1].kept[0]


def test_a_share_that_is_too_small_says_which_suffices() -> None:
    costs = np.array([[8.0], [1.0], [1.0]])
    with pytest.raises(
        ConfigError, match=r"all 3 networks up to epoch 4 and one of them to the end may take 0\.813"
    ) as refused:
        search(Curves(steady, units=1), costs, rungs=(4, 60), share=0.25)
    share = float(str(refused.value).split("share of ")[-1].split(",")[0])
    curves = Curves(lambda network, epochs: 1.0 - network / 10, units=1)
    assert search(curves, costs, rungs=(4, 60), share=share).best == 0
    # Where none is given: two can be trained to the end.
    few = search(Curves(steady), np.ones((4, 3)))
    assert few.bound / few.whole == pytest.approx(0.534) and len(few.rungs[-1].rung.entered) == 2
    assert search(Curves(steady), np.ones((1, 3))).spent == 60 * 3


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


def test_folds_that_come_later_are_trained_from_the_start() -> None:
    costs = Costs(np.array([[1.0, 2.0, 4.0], [1.0, 1.0, 1.0]]), SearchSpec(folds=(1, 2), share=1.0), seeds=2)
    assert costs.folds == (1, 2, 3)
    assert costs.step(0).tolist() == [2 * 4, 2 * 4]
    assert costs.step(1).tolist() == [2 * (11 + 2 * 15), 2 * (11 + 15)]
    assert (costs.step(0) + costs.step(1) + costs.step(2)).tolist() == [2 * 60 * 7, 2 * 60 * 3]
    assert costs.rest(1).tolist() == costs.step(2).tolist()
    assert costs.whole == 2 * 60 * 10


def test_all_problems_at_once() -> None:
    assert problems(SearchSpec(), 5) == [] and problems(SearchSpec(folds=(2, 5)), 5) == []
    bad = SearchSpec(rungs=(4, 4, 60), folds=(1,), share=0.0, eta=1.0, max_parameters=0)
    assert len(problems(bad)) == 5
    assert "do not fall" in problems(SearchSpec(folds=(3, 1)))[0]
    assert "it has 3" in problems(SearchSpec(folds=(1, 4)), 3)[0]
    assert problems(SearchSpec(rungs=())) and problems(SearchSpec(eta=math.nan)) and problems(SearchSpec(share=1.1))


def test_limits_name_what_is_over() -> None:
    archs = [Arch.parse(s, f, channels=4, classes=10) for s in PAPER_ARCHITECTURES for f in PAPER_FILTERS[:2]]
    spec = SearchSpec(max_parameters=4000, max_state_bytes=2150, max_macs_per_step=16_000)
    within = [arch for arch in archs if not spec.over(arch)]
    assert 0 < len(within) < len(archs)
    for arch in archs:
        ok = arch.parameters <= 4000 and arch.state_bytes_int8 <= 2150 and arch.macs_per_step <= 16_000
        assert (arch in within) == ok
    big = Arch.parse("70_90_91", (8, 12, 16), channels=4, classes=10)
    assert limits_text(spec.over(big)).startswith("28,630 parameters, 24,630 over 4,000, 3,692 bytes of state")
    tight = SearchSpec(max_parameters=1500)
    smallest = min(arch.parameters for arch in archs)
    assert f"{smallest:,} parameters, {smallest - 1500:,} over 1,500" in none_left(tight, archs)


@pytest.mark.parametrize(
    ("points", "on"),
    [
        ([(0.5, 1), (0.6, 2), (0.55, 3)], [True, True, False]),
        ([(0.5, 1), (0.5, 1)], [True, True]),
        ([(0.5, 1), (0.6, 1)], [False, True]),
        ([(0.5, 1), (0.5, 2)], [True, False]),
        ([], []),
    ],
)
def test_the_front_of_two_and_its_ties(points: list[tuple[float, ...]], on: list[bool]) -> None:
    assert pareto_front(points) == on


def test_the_pareto_front() -> None:
    rows = [(0.7, 100, 10), (0.7, 100, 10), (0.6, 50, 10), (0.6, 100, 10), (0.5, 60, 5), (0.5, 50, 20)]
    assert pareto_front(rows) == [True, True, True, False, True, False]


def test_networks_drawn_from_a_space() -> None:
    space = Space(networks=40)
    symbols = drawn(space)
    assert len(symbols) == len(set(symbols)) == 40 and symbols == drawn(space)
    assert symbols != drawn(Space(networks=40, seed=1))
    archs = [Arch.parse(symbol, (4, 6, 8, 8)) for symbol in symbols]
    assert all(100 <= arch.receptive_field <= 260 for arch in archs)
    assert [arch.symbol for arch in archs] == list(symbols), "spelt as everywhere"
    few = Space(layers=(1,), kernels=(101, 126), dilations=(1, 2))
    assert set(drawn(few)) == {"101", "126", "101d2", "126d2"}
    assert space_problems(space) == space_problems(few) == []
    assert len(space_problems(Space(layers=(5,), kernels=(), receptive_field=(9,), networks=1))) == 4
    assert "no two networks" in space_problems(Space(receptive_field=(4000, 5000)))[0]


def test_a_search_in_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        '[grid]\nfilters = [[4, 6, 8, 8]]\nsplit = "by-subject:3"\nepochs = [7]\n'
        "[search]\nrungs = [2, 9]\nshare = 0.5\nmax_parameters = 9000\n"
        "[search.space]\nkernels = [5, 9, 19, 39]\ndilations = [1, 2, 4]\nnetworks = 6\n"
    )
    grid, spec, found = load_search(path, {"batches": "32", "share": 0.75, "eta": None})
    assert found == []
    assert (spec.rungs, spec.share, spec.max_parameters) == ((2, 9), 0.75, 9000)
    assert (grid.name, grid.epochs, grid.split, grid.batches) == ("mine", (2, 9), "by-subject:3", (32,))
    assert (grid.preset, grid.padding, grid.context) == tuple(DEFAULTS[k] for k in ("preset", "padding", "context"))
    assert len(grid.architectures) == 6 and grid.filters == ((4, 6, 8, 8),)
    paper, plain, found = load_search("paper")
    assert found == [] and plain == SearchSpec() and paper.architectures == PAPER_ARCHITECTURES
    assert (paper.epochs, paper.batches, paper.split) == ((4, 15, 60), (64,), "by-subject:5")
    path.write_text('[grid]\nx = 1\n[search]\nrung = [2]\nshare = "half"\n[search.space]\nkernel = [2]\n[other]\n')
    _, _, found = load_search(path)
    assert len(found) == 5, found
    assert any("'rung' in [search]" in line and "'rungs'" in line for line in found)
    assert any("Unknown key 'other'" in line for line in found)
    path.write_text("[grid]\n[search]\nspace = 3\n")
    assert "it is a table" in load_search(path)[2][0]
