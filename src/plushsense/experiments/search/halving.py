"""Successive halving: train all networks for a few epochs, the better ones for more, and the best to the end.

After Jamieson and Talwalkar, "Non-stochastic best arm identification and hyperparameter optimization", AISTATS 2016.
In addition, networks differ in cost, the total cost is bounded before anything runs, and networks within one standard
error of the cut continue as long as the budget allows. A training continues from where it stopped, so that a complete
one costs the same as in a sweep of the grid.

Costs are in multiply-accumulates (MAC), forward and backward: MAC per window × windows × epochs.
"""

from __future__ import annotations

import math
import os
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, TrainingError
from plushsense.core.sentences import join_names
from plushsense.models.arch import MAX_LAYERS, Arch, slashed
from plushsense.trials.grid import GRIDS, GridSpec, grid_tables, over

Scores = NDArray[np.float64]

# Default share of the grid's cost.
QUARTER = 0.25

# Tolerance for the rounding of sums, which depends on their order.
_SLACK = 1 + 1e-9

# Limits of a search by key: the property of a network, and its unit.
LIMITS: dict[str, tuple[str, str]] = {
    "max_parameters": ("parameters", "parameters"),
    "max_state_bytes": ("state_bytes_int8", "bytes of state"),
    "max_macs_per_step": ("macs_per_step", "MAC a step"),
}


@dataclass(frozen=True)
class SearchSpec:
    """Settings of a search. The constructor checks nothing; `problems` reports all errors at once.

    Attributes:
        rungs: numbers of epochs after which networks are compared, ascending, each from 1; the last is the length of a
            complete training.
        folds: number of folds for each rung but the last, not falling, each from 1 (default: all folds in every rung).
        share: limit on the cost, as a share of the whole grid's: all allowed networks, folds and seeds, to the last
            rung (above 0 to 1; default: a quarter, or if that cannot pay for one complete training, the cost of the
            first rung and of training two networks to the end).
        eta: one in this many networks of a rung continues, but at least two, if the cost allows (above 1).
        max_parameters: networks with more parameters are left out before anything runs (from 1; default: no limit).
        max_state_bytes: the same for the bytes of state of streaming in 8 bits (from 1; default: no limit).
        max_macs_per_step: the same for the multiplications in a step of 50 ms (from 1; default: no limit).
    """

    rungs: tuple[int, ...] = (4, 15, 60)
    folds: tuple[int, ...] = ()
    share: float | None = None
    eta: float = 2.0
    max_parameters: int | None = None
    max_state_bytes: int | None = None
    max_macs_per_step: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)

    def over(self, arch: Arch) -> dict[str, tuple[int, int]]:
        """Return (value, limit) for each limit that a network exceeds."""
        found = {}
        for key, (name, _) in LIMITS.items():
            limit = getattr(self, key)
            if limit is not None and getattr(arch, name) > limit:
                found[key] = (getattr(arch, name), limit)
        return found


def problems(spec: SearchSpec, folds: int | None = None) -> list[str]:
    """Return a sentence for each setting with which a search cannot run."""
    found = []
    rungs = spec.rungs
    if not rungs or min(rungs) < 1 or list(rungs) != sorted(set(rungs)):
        found.append(f"The rungs {join_names(rungs)} cannot be used: accepted are whole numbers from 1 that ascend.")
    if spec.folds:
        if len(spec.folds) != len(rungs) - 1:
            found.append(
                f"The folds {join_names(spec.folds)} do not fit {len(rungs)} rungs: give one number for each rung but "
                "the last, which looks at all folds."
            )
        elif min(spec.folds) < 1 or list(spec.folds) != sorted(spec.folds):
            found.append(f"The folds {join_names(spec.folds)} cannot be used: whole numbers from 1 that do not fall.")
        elif folds is not None and spec.folds[-1] > folds:
            found.append(f"The folds {join_names(spec.folds)} are more than the split has: it has {folds}.")
    if spec.share is not None and not 0.0 < spec.share <= 1.0:
        found.append(f"The share {spec.share:g} cannot be used: accepted is above 0, up to 1.")
    if not (math.isfinite(spec.eta) and spec.eta > 1.0):
        found.append(f"eta is {spec.eta:g}: accepted is above 1.")
    for key in LIMITS:
        value = getattr(spec, key)
        if value is not None and value < 1:
            found.append(f"{key} is {value}: accepted are whole numbers from 1.")
    return found


def limits_text(over: Mapping[str, tuple[int, int]]) -> str:
    """Describe the limits that a network exceeds, given as `SearchSpec.over` returns them."""
    return ", ".join(f"{has:,} {LIMITS[key][1]}, {has - may:,} over {may:,}" for key, (has, may) in over.items())


def none_left(spec: SearchSpec, archs: Sequence[Arch]) -> str:
    """Return the message that no network is within the limits, and by how much the nearest exceeds them."""

    def excess(arch: Arch) -> float:
        return max(has / may for has, may in spec.over(arch).values())

    near = min(archs, key=excess)
    return (
        f"None of the {len(archs)} networks is within the limits; the nearest, {near.symbol} with "
        f"{slashed(near.filters)}, has {limits_text(spec.over(near))}: allow more, or give smaller networks."
    )


class Rung(NamedTuple):
    """A stage of the search: train the networks ``entered`` (indices) up to ``epochs`` on the first ``folds`` folds."""

    number: int
    epochs: int
    folds: int
    entered: tuple[int, ...]
    cost: float


@dataclass(frozen=True)
class FinishedRung:
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
    left: dict[int, Literal["score", "cost", "failed"]]


@dataclass(frozen=True)
class Halved:
    """A finished search: best network, ``equals`` within one standard error, cost, its limit, and the grid's cost."""

    rungs: tuple[FinishedRung, ...]
    best: int
    equals: tuple[int, ...]
    spent: float
    bound: float
    whole: float


class Costs:
    """The costs of the networks in each rung of a search, computed from the MAC of one ``epoch`` (networks, folds)."""

    def __init__(self, epoch: Scores, spec: SearchSpec, seeds: int = 1) -> None:
        self.spec = spec
        self.epoch = epoch
        folds = [*spec.folds, *[epoch.shape[1]] * (len(spec.rungs) - len(spec.folds))]
        self.folds = tuple(folds)
        # (networks, rungs): cost of a network up to the end of a rung.
        self.until = np.stack(
            [seeds * e * epoch[:, :f].sum(axis=1) for e, f in zip(spec.rungs, folds, strict=True)], axis=1
        )
        self.whole = float(self.until[:, -1].sum())
        self.share = self._usual() if spec.share is None else spec.share
        self.bound = self.share * self.whole

    def _usual(self) -> float:
        if self.least <= QUARTER:
            return QUARTER
        two = np.sort(self.rest(0))[-2:].sum()
        return min(1.0, _up(float(self.step(0).sum() + two) / self.whole))

    def step(self, rung: int) -> Scores:
        """Return for each network the cost of training it from the previous rung to this one."""
        before = self.until[:, rung - 1] if rung else 0.0
        found: Scores = self.until[:, rung] - before
        return found

    def rest(self, rung: int) -> Scores:
        """Return for each network the cost of training it from this rung to the end."""
        found: Scores = self.until[:, -1] - self.until[:, rung]
        return found

    @property
    def least(self) -> float:
        """The smallest share that pays for the first rung and for training any one network to the end."""
        return float(self.step(0).sum() + self.rest(0).max()) / self.whole

    def check(self) -> None:
        """Check that the share suffices for a search.

        Raises:
            ConfigError: if not; the message gives a share that suffices.
        """
        if self.least > self.share * _SLACK:
            raise ConfigError(
                f"A share of {self.share:g} of the grid's cost is too small: all {len(self.until)} networks up to "
                f"epoch {self.spec.rungs[0]} and one of them to the end may take {self.least:.3f}; allow a share of "
                f"{_up(self.least):g}, or begin with fewer epochs."
            )


def halving(costs: Costs, train: Callable[[Rung], Scores]) -> Halved:
    """Run the search. ``train`` returns the scores (entered, seeds × folds) of a rung: higher is better, NaN is failed.

    The bound is never exceeded: of the networks that continue, any one can be trained to the end within it.

    Raises:
        ConfigError: when the bound is too small for any search; TrainingError: when every training failed.
    """
    costs.check()
    spec, alive, spent = costs.spec, tuple(range(len(costs.until))), 0.0
    done: list[FinishedRung] = []
    for level, epochs in enumerate(spec.rungs):
        cost = float(costs.step(level)[list(alive)].sum())
        rung = Rung(level, epochs, costs.folds[level], alive, cost)
        scores = np.asarray(train(rung), dtype=np.float64)
        spent += cost
        # The mean of a network that failed on any fold is NaN, because that of its other folds would be biased.
        means = {network: float(scores[i].mean()) for i, network in enumerate(alive)}
        well = [network for network in alive if math.isfinite(means[network])]
        if not well:
            raise TrainingError(
                f"Every training failed by epoch {epochs}: try a lower learning_rate, such as a tenth of it."
            )
        error = standard_error(scores[[i for i, network in enumerate(alive) if network in well]])
        order = sorted(well, key=lambda network: (-means[network], costs.until[network, -1]))
        left: dict[int, Literal["score", "cost", "failed"]] = dict.fromkeys(set(alive) - set(well), "failed")
        kept = tuple(order)
        if level + 1 < len(spec.rungs):
            kept = _go_on(costs, level + 1, order, means, error or 0.0, costs.bound - spent, len(alive), left)
        done.append(FinishedRung(rung, scores, means, error, kept, left))
        alive = kept
    last = done[-1]
    reach = last.means[alive[0]] - (last.error or 0.0)
    equals = tuple(network for network in alive[1:] if last.means[network] >= reach)
    return Halved(tuple(done), alive[0], equals, spent, costs.bound, costs.whole)


def _go_on(
    costs: Costs,
    rung: int,
    order: Sequence[int],
    means: Mapping[int, float],
    error: float,
    money: float,
    entered: int,
    left: dict[int, Literal["score", "cost", "failed"]],
) -> tuple[int, ...]:
    """Return the networks that continue to ``rung``, the best first, and record in ``left`` why the others do not."""
    allowed = money / (len(costs.spec.rungs) - rung)
    step, rest = costs.step(rung), costs.rest(rung)
    # At least two, so that the winner is compared with another network in the last rung.
    wanted = max(2, math.ceil(entered / costs.spec.eta))
    cut = means[order[min(len(order), wanted) - 1]]
    kept: list[int] = []
    paid, dearest = 0.0, 0.0
    for network in order:
        if means[network] < cut - error:
            left[network] = "score"
            continue
        total, end = paid + step[network], max(dearest, rest[network])
        if kept and (total > allowed * _SLACK or total + end > money * _SLACK):
            left[network] = "cost"
            continue
        kept.append(network)
        paid, dearest = total, end
    return tuple(kept)


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


def _up(share: float) -> float:
    return math.ceil(share * 1000) / 1000


# Number of draws per wanted network after which the space counts as exhausted.
_TRIES = 2000


@dataclass(frozen=True)
class Space:
    """A space of networks to draw from.

    Attributes:
        layers: numbers of layers to draw from, each from 1.
        kernels: lengths of kernels to draw from, in samples, each from 1.
        dilations: dilations to draw from, each from 1; they never decrease from layer to layer, as in all networks of
            the paper.
        receptive_field: shortest and longest receptive field that is accepted, in samples, as those of kernels and
            symbols: they divided by the layout's rate are seconds, which the tables of trials state (the paper's window
            has 250 samples, 2.5 s at 100 Hz).
        networks: number of different networks to draw (from 2).
        seed: number that they are drawn from (from 0).
    """

    layers: tuple[int, ...] = (2, 3, 4)
    kernels: tuple[int, ...] = (1, 5, 9, 14, 19, 24, 29, 39, 59, 84)
    dilations: tuple[int, ...] = (1, 2, 3, 4, 8, 9)
    receptive_field: tuple[int, ...] = (100, 260)
    networks: int = 26
    seed: int = 0


def problems_space(space: Space) -> list[str]:
    """Return a sentence for each setting with which networks cannot be drawn."""
    found = []
    for key, high in (("layers", MAX_LAYERS), ("kernels", None), ("dilations", None)):
        values = getattr(space, key)
        if not values or min(values) < 1 or (high is not None and max(values) > high):
            to = "" if high is None else f" to {high}"
            found.append(f"{key} of the space are {list(values)}: accepted are whole numbers from 1{to}.")
    field = space.receptive_field
    if len(field) != 2 or not 1 <= field[0] <= field[1]:
        found.append(f"receptive_field of the space is {list(field)}: accepted are two numbers, as [100, 260].")
    for key, low in (("networks", 2), ("seed", 0)):
        if getattr(space, key) < low:
            found.append(f"{key} of the space is {getattr(space, key)}: accepted are whole numbers from {low}.")
    if not found and len(drawn(space)) < 2:
        found.append(
            f"The space holds no two networks with a receptive field of {field[0]} to {field[1]} samples: give other "
            "kernels or dilations."
        )
    return found


def drawn(space: Space) -> tuple[str, ...]:
    """Draw ``networks`` different networks, or fewer if the space has no more; return their symbols."""
    chance = random.Random(space.seed)
    found: dict[str, None] = {}
    for _ in range(_TRIES * space.networks):
        if len(found) == space.networks:
            break
        layers = chance.choice(space.layers)
        kernels = [chance.choice(space.kernels) for _ in range(layers)]
        # The dilation of a kernel of one tap has no effect.
        widths = sorted(chance.choice(space.dilations) for _ in range(layers))
        dilations = [1 if k == 1 else d for k, d in zip(kernels, widths, strict=True)]
        field = 1 + sum((k - 1) * d for k, d in zip(kernels, dilations, strict=True))
        if space.receptive_field[0] <= field <= space.receptive_field[1]:
            dilated = max(dilations) > 1
            parts = (f"{k}d{d}" if dilated else f"{k}" for k, d in zip(kernels, dilations, strict=True))
            found["_".join(parts)] = None
    return tuple(found)


DEFAULTS: dict[str, Any] = {
    "split": "by-subject:5",
    "preset": "people",
    "padding": "stream",
    "context": "stream",
    "classes": "shared",
    "batches": (64,),
}


def load_search(
    grid: GridSpec | str | os.PathLike[str], changes: Mapping[str, Any] | None = None
) -> tuple[GridSpec, SearchSpec, list[str]]:
    """Read a grid and its search settings and apply ``changes``; the grid's epochs become the rungs.

    Args:
        grid: a grid, its name or the path of a TOML file.
        changes: new values of keys of `SearchSpec` and of the grid; None leaves a key as it is.

    Returns:
        the grid, the settings, and a sentence for each key or value that cannot be read and is therefore ignored.

    Raises:
        ConfigError: for an unknown name, or a file that is missing or not TOML.
    """
    table, settings, found = dict[str, Any](), dict[str, Any](), list[str]()
    if isinstance(grid, GridSpec):
        path, base = grid.name, grid
    else:
        path = os.fspath(grid)
        base = GRIDS.get(path, GridSpec(name=Path(path).stem))
        if path not in GRIDS:
            tables, found = grid_tables(path)
            table, settings = dict(tables["grid"]), dict(tables["search"])
        table = DEFAULTS | table
    space = settings.pop("space", None)
    spec, more = over(SearchSpec(), settings, f"[search] in '{path}'")
    found += more
    names = {field.name for field in fields(SearchSpec)}
    spec, more = over(spec, {key: value for key, value in (changes or {}).items() if key in names}, "the search")
    found += more
    if space is not None:
        symbols, more = _symbols(space, f"[search.space] in '{path}'")
        found += more
        table |= {"architectures": symbols} if symbols else {}
    base, more = over(base, table, f"[grid] in '{path}'")
    found += more
    of_grid = {key: value for key, value in (changes or {}).items() if key not in names}
    base, more = over(base, of_grid | {"epochs": spec.rungs}, "the grid")
    return base, spec, found + more


def _symbols(space: Any, where: str) -> tuple[tuple[str, ...], list[str]]:
    if not isinstance(space, Mapping):
        return (), [f"space of {where.replace('.space', '')} is one value, but it is a table: write  [search.space]"]
    made, found = over(Space(), space, where)
    found += problems_space(made)
    return (() if found else drawn(made)), found
