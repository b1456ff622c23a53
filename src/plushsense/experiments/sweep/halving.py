"""Successive halving: train all networks for a few epochs, the better ones for more, and the best to the end.

After Jamieson and Talwalkar, "Non-stochastic best arm identification and hyperparameter optimization", AISTATS 2016.
In addition, networks differ in cost, the total cost is bounded before anything runs, and networks within one standard
error of the cut continue as long as the budget allows. A training continues from where it stopped, so that a complete
one costs the same as in a sweep of the whole grid. The numbers of epochs of the grid are the rungs.

Costs are in multiply-accumulates (MAC), forward and backward: MAC per window × windows × epochs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, TrainingError
from plushsense.experiments.sweep.grid import GRID_TRAINING
from plushsense.experiments.sweep.trials import TrialResult

Scores = NDArray[np.float64]
Reason = Literal["score", "cost", "failed"]

# Default share of the grid's cost.
QUARTER = 0.25
# Tolerance for the rounding of sums, which depends on their order.
_SLACK = 1 + 1e-9


@dataclass(frozen=True)
class Rung:
    """A stage, numbered from 0: the networks ``entered`` (indices) are trained up to ``epochs``."""

    number: int
    epochs: int
    entered: tuple[int, ...]
    cost: float


@dataclass(frozen=True)
class RungResult:
    """A finished rung.

    ``scores`` has shape (entered, seeds × folds); ``means`` has one mean for each network (NaN: its training failed).
    ``error`` is the standard error of the difference of two means, or None. ``kept`` are the networks that continue,
    best first (after the last rung, all that did not fail); ``left`` maps each other network to the reason.
    """

    rung: Rung
    scores: Scores
    means: dict[int, float]
    error: float | None
    kept: tuple[int, ...]
    left: dict[int, Reason]

    @property
    def ranked(self) -> list[int]:
        """The networks that entered: those that continue, then the others by score, those without a score last."""
        return [*self.kept, *sorted(self.left, key=lambda n: -np.nan_to_num(self.means[n], nan=-np.inf))]


@dataclass(frozen=True)
class HalvingResult:
    """Finished halving: the best network, ``equals`` within one standard error of it, and the cost in MAC."""

    rungs: tuple[RungResult, ...]
    best: int
    equals: tuple[int, ...]
    spent: float


class HalvingCosts:
    """The costs of the networks in each rung.

    Args:
        epoch: MAC of one epoch of each network, for all folds and seeds.
        rungs: numbers of epochs, ascending.
        share: limit on the cost, as a share of the cost of all networks to the last rung; None: a quarter, or if that
            cannot pay for one complete training, the cost of the first rung and of training two networks to the end.
        eta: one in this many networks of a rung continues, but at least two, if the cost allows.
    """

    def __init__(self, epoch: Scores, rungs: Sequence[int], share: float | None = None, eta: float = 2.0) -> None:
        self.rungs, self.eta = tuple(rungs), eta
        self._until = np.outer(epoch, self.rungs)
        self.whole = float(self._until[:, -1].sum())
        self.share = self._usual_share() if share is None else share
        self.bound = self.share * self.whole

    def _usual_share(self) -> float:
        if self.least <= QUARTER:
            return QUARTER
        two = np.sort(self.rest(0))[-2:].sum()
        return min(1.0, _round_up(float(self.step(0).sum() + two) / self.whole))

    def step(self, rung: int) -> Scores:
        """Return for each network the cost of training it from the previous rung to this one."""
        return np.asarray(self._until[:, rung] - (self._until[:, rung - 1] if rung else 0.0))

    def rest(self, rung: int) -> Scores:
        """Return for each network the cost of training it from this rung to the end."""
        return np.asarray(self._until[:, -1] - self._until[:, rung])

    @property
    def least(self) -> float:
        """The smallest share that pays for the first rung and for training any one network to the end."""
        return float(self.step(0).sum() + self.rest(0).max()) / self.whole

    def check(self) -> None:
        """Raise ConfigError if the share does not suffice; the message gives one that does."""
        if self.least > self.share * _SLACK:
            raise ConfigError(
                f"A share of {self.share:g} of the grid's cost is too small: all {len(self._until)} networks up to "
                f"epoch {self.rungs[0]} and one of them to the end may take {self.least:.3f}; allow a share of "
                f"{_round_up(self.least):g}, or begin with fewer epochs."
            )

    def to_json(self) -> dict[str, object]:
        """Return the bound, and what it is compared with, as plain values."""
        return {
            "networks": len(self._until),
            "rungs": list(self.rungs),
            "bound_macs": self.bound,
            "bound_share": self.share,
            "first_share": float(self.step(0).sum()) / self.whole,
            "least_share": self.least,
            "grid_macs": self.whole,
        }


def halve(costs: HalvingCosts, train: Callable[[Rung], Scores]) -> HalvingResult:
    """Run the rungs. ``train`` returns the scores (entered, seeds × folds) of one: higher is better, NaN is failed.

    The bound is never exceeded: of the networks that continue, any one can be trained to the end within it.

    Raises:
        ConfigError: when the bound is too small; TrainingError: when every training failed.
    """
    costs.check()
    alive, spent, done = tuple(range(len(costs.step(0)))), 0.0, list[RungResult]()
    for level, epochs in enumerate(costs.rungs):
        rung = Rung(level, epochs, alive, float(costs.step(level)[list(alive)].sum()))
        scores = np.asarray(train(rung), dtype=np.float64)
        spent += rung.cost
        # The mean of a network that failed on any fold is NaN, because that of its other folds would be biased.
        means = {network: float(scores[i].mean()) for i, network in enumerate(alive)}
        well = [network for network in alive if math.isfinite(means[network])]
        if not well:
            raise TrainingError(
                f"Every training failed by epoch {epochs}: try a lower learning_rate, such as a tenth of it."
            )
        error = standard_error(scores[[i for i, network in enumerate(alive) if network in well]])
        order = sorted(well, key=lambda network: (-means[network], costs.step(0)[network]))
        left: dict[int, Reason] = dict.fromkeys(set(alive) - set(well), "failed")
        kept = tuple(order)
        if level + 1 < len(costs.rungs):
            kept, dropped = _select(costs, rung, order, means, error or 0.0, costs.bound - spent)
            left |= dropped
        done.append(RungResult(rung, scores, means, error, kept, left))
        alive = kept
    last = done[-1]
    reach = last.means[alive[0]] - (last.error or 0.0)
    equals = tuple(network for network in alive[1:] if last.means[network] >= reach)
    return HalvingResult(tuple(done), alive[0], equals, spent)


def _select(
    costs: HalvingCosts, rung: Rung, order: Sequence[int], means: Mapping[int, float], error: float, budget: float
) -> tuple[tuple[int, ...], dict[int, Reason]]:
    """Return the networks that continue after ``rung``, the best first, and why the others do not."""
    following = rung.number + 1
    allowed = budget / (len(costs.rungs) - following)
    step, rest = costs.step(following), costs.rest(following)
    # At least two, so that the winner is compared with another network in the last rung.
    wanted = max(2, math.ceil(len(rung.entered) / costs.eta))
    cut = means[order[min(len(order), wanted) - 1]]
    kept: list[int] = []
    left: dict[int, Reason] = {}
    paid, dearest = 0.0, 0.0
    for network in order:
        if means[network] < cut - error:
            left[network] = "score"
            continue
        total, end = paid + step[network], max(dearest, rest[network])
        if kept and (total > allowed * _SLACK or total + end > budget * _SLACK):
            left[network] = "cost"
            continue
        kept.append(network)
        paid, dearest = total, end
    return tuple(kept), left


def standard_error(scores: Scores) -> float | None:
    """Return the standard error of the difference of two networks' means; None for a single network or score.

    All networks were scored on the same folds with the same seeds, so that effects common to all networks cancel. The
    error is estimated from the residuals of an additive model (network + fold), pooled over the networks.
    """
    networks, units = scores.shape
    if networks < 2 or units < 2:
        return None
    residuals = scores - scores.mean(axis=1, keepdims=True) - scores.mean(axis=0, keepdims=True) + scores.mean()
    variance = float((residuals**2).sum()) / ((networks - 1) * (units - 1))
    return math.sqrt(2 * variance / units)


def _round_up(share: float) -> float:
    return math.ceil(share * 1000) / 1000


_REASONS = {
    "score": "below the cut",
    "cost": "no budget left for it",
    "failed": "its training failed",
}


@dataclass(frozen=True)
class Halving:
    """Finished halving of a sweep.

    Attributes:
        networks: the results of each network, one for each rung.
        command: the command line that trains the best network on all people.
    """

    costs: HalvingCosts
    found: HalvingResult
    networks: tuple[tuple[TrialResult, ...], ...]
    command: str

    @property
    def winner(self) -> TrialResult:
        """The network with the highest macro-F1 among those that were trained to the end."""
        return self.networks[self.found.best][-1]

    def training_config(self) -> str:
        """Return the configuration file with which ``plushsense train`` trains the winner."""
        trial, grid = self.winner.trial, self.winner.head.grid
        given = {"augment" if key == "turn_deg" else key for key in GRID_TRAINING if getattr(grid, key) is not None}
        tables: dict[str, dict[str, Any]] = {
            "windows": {key: getattr(grid, key) for key in ("context", "window_s", "step_s")},
            "model": {"arch": trial.arch.symbol, "filters": trial.arch.filters}
            | {key: getattr(grid, key) for key in ("padding", "norm")},
            "training": {"preset": grid.preset, "epochs": trial.epochs, "batch": max(run.batch for run in trial.runs)}
            | {"threads": grid.threads}
            | {key: getattr(grid.training, key) for key in sorted(given | {"augment"})},
            "evaluation": {"classes": grid.classes},
        }
        # Numbers, texts and lists are written alike in TOML and JSON.
        return "\n".join(
            f"[{name}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())
            for name, table in tables.items()
        )

    def to_json(self) -> dict[str, object]:
        """Return plain values, as in ``sweep.json``."""
        equal = [self.networks[n][-1] for n in (self.found.best, *self.found.equals)]
        return {
            "rungs": [self._rung(finished) for finished in self.found.rungs],
            "winner": self.winner.row(),
            "smallest_equal": min(equal, key=lambda result: result.trial.arch.parameters).row(),
            "equal": [result.trial.id for result in equal[1:]],
            "cost": {
                "macs": self.found.spent,
                "bound_macs": self.costs.bound,
                "grid_macs": self.costs.whole,
                "share": self.found.spent / self.costs.whole,
                "bound_share": self.costs.share,
            },
            "command": self.command,
        }

    def _rung(self, finished: RungResult) -> dict[str, Any]:
        number, goes_on = finished.rung.number, "to the end" if finished is self.found.rungs[-1] else "on"
        networks = []
        for network in finished.ranked:
            trial, mean = self.networks[network][number].trial, finished.means[network]
            reason = _REASONS[finished.left[network]] if network in finished.left else goes_on
            named = {"trial": trial.id, **dict(zip(("arch", "filters"), trial.network, strict=True))}
            score = None if math.isnan(mean) else mean
            networks.append({**named, "batch_asked": str(trial.batch), "macro_f1": score, "went": reason})
        return {
            "epochs": finished.rung.epochs,
            "entered": len(finished.rung.entered),
            "kept": len(finished.kept),
            "macs": finished.rung.cost,
            "share": finished.rung.cost / self.costs.whole,
            "standard_error": finished.error,
            "networks": networks,
        }
