"""Grids: networks × epochs × batches to train and compare, checked as a whole before anything runs.

A long training includes the shorter ones of the same network: learning rate, order of windows and rotations of an epoch
depend on its number and the seed, not on the number of epochs to follow. With early stopping (``patience``), each
number of epochs needs its own training.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

from plushsense.core.errors import ArchError, BadInput, ConfigError, nearest
from plushsense.core.layouts import Layout
from plushsense.core.sentences import join_names
from plushsense.core.toml import check_table, read_toml, unknown_key
from plushsense.models.arch import (
    DEFAULT_FILTERS,
    NORMS,
    PADDINGS,
    PAPER_ARCHITECTURES,
    PAPER_FILTERS,
    Arch,
    parse_filters,
    parse_symbol,
    slashed,
    symbol_at_rate,
    symbol_within,
)
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import DEVICES, PRESETS, TrainSpec, preset
from plushsense.windows.cut import CONTEXTS, WindowSpec

FULL: Literal["full"] = "full"
# Time between decisions, 50 ms as in all of PlushSense.
_STEP_S = 0.05
# Training settings that a grid may change; None keeps the value of the preset.
GRID_TRAINING = ("learning_rate", "halve_every", "patience", "augment", "turn_deg", "scaling", "weight_decay")
# Limits on the networks: the property of a network, and its unit.
LIMITS: dict[str, tuple[str, str]] = {
    "max_parameters": ("parameters", "parameters"),
    "max_state_bytes": ("state_bytes_int8", "bytes of state"),
    "max_macs_per_step": ("macs_per_step", "MAC a step"),
}
# Settings that earlier grids do not have.
_NEW = ("augment", "scaling", "weight_decay", "halving", "share", "eta", *LIMITS)


class Excess(NamedTuple):
    """A limit that a network exceeds, and its value."""

    value: int
    limit: int
    unit: str

    def __str__(self) -> str:
        return f"{self.value:,} {self.unit}, {self.value - self.limit:,} over {self.limit:,}"


@dataclass(frozen=True)
class GridSpec:
    """Settings of a grid. The constructor checks nothing; `problems` reports all errors at once.

    ``threads`` is part of a training's id, because the order of sums in PyTorch's layers depends on it.

    Attributes:
        name: name of the grid, and of its folder: letters, digits, ``.``, ``_`` and ``-`` (default: that of the file).
        architectures: networks, each written as in ``14d1_39d2_41d4``: kernel lengths in samples, dilations after
            ``d`` (default: the paper's 13).
        filters: sets of filters, ``[[4, 6, 8, 8], [8, 12, 16, 16]]``; a network of n layers uses the first n numbers of
            each set (default: the paper's 4).
        epochs: numbers of epochs after which a training is scored, ascending, each from 1.
        batches: windows for each step of the optimiser, each from 2; ``full``: all windows.
        seeds: numbers that the random choices of a training are drawn from, each from 0; one training for each.
        split: which recordings are scored and which are learned from, as in a configuration file.
        split_seed: number that the folds are drawn from, the same for all trainings (from 0).
        preset: training settings to begin with (one of `PRESETS`).
        padding: what a network reads before the start of a window, as in a configuration file (one of `PADDINGS`).
        norm: normalisation after each layer (one of `NORMS`).
        context: what fills the windows of short recordings: ``stream``: the session before; ``rest``: its first
            reading, held; ``loop``: the recording again; ``rows``: the same, with its rows as even samples, as by the
            authors' scripts (one of `CONTEXTS`).
        classes: ``all``, ``shared``, labels as a list or joined by commas, or merged gestures, as in a configuration
            file.
        window_s: length of the windows (above 0 to 60).
        step_s: time from the start of a window to that of the next one in the same recording (above 0 to 60).
        learning_rate: step size of the optimiser, Adam (above 0 to 1; default: by the preset).
        halve_every: epochs after which the learning rate is halved (from 1; default: by the preset).
        patience: epochs without a better result after which a training stops (from 1; default: by the preset).
        augment: changes of the training windows, as in a configuration file (default: by the preset).
        turn_deg: the same as ``augment = ["random-rotation:…"]``, in degrees; only one of the two may be given
            (0 to 180; default: by the preset).
        scaling: ``z-score`` or ``none``, as in a configuration file (default: by the preset).
        weight_decay: factor of the L2 regularisation, as in a configuration file (0 to 1; default: by the preset).
        device: what computes; ``auto``: a graphics card with CUDA if there is one (one of `DEVICES`).
        threads: threads of the processor for one training (from 1).
        max_parameters: networks with more parameters are left out before anything runs (from 1; default: no limit).
        max_state_bytes: the same for the bytes of state of streaming in 8 bits (from 1; default: no limit).
        max_macs_per_step: the same for the multiplications in a step of 50 ms (from 1; default: no limit).
        halving: whether to drop the worse networks after each of ``epochs`` but the last (successive halving).
        share: with halving, the limit on the cost, as a share of the cost of training all networks to the last of
            ``epochs`` (above 0 to 1; default: a quarter, or if that cannot pay for one complete training, the cost of
            the first number of epochs and of training two networks to the end).
        eta: with halving, one in this many networks continues, but at least two, if the cost allows (above 1).
    """

    name: str = "grid"
    architectures: tuple[str, ...] = PAPER_ARCHITECTURES
    filters: tuple[tuple[int, ...], ...] = PAPER_FILTERS
    epochs: tuple[int, ...] = (100, 250, 1000)
    batches: tuple[int | Literal["full"], ...] = (64, 256, FULL)
    seeds: tuple[int, ...] = (0,)
    split: str = "windows:holdout"
    split_seed: int = 0
    preset: str = "search"
    padding: str = "mirror"
    norm: str = "batch"
    context: str = "loop"
    classes: str = "all"
    window_s: float = 2.5
    step_s: float = 0.5
    learning_rate: float | None = None
    halve_every: int | None = None
    patience: int | None = None
    augment: tuple[str, ...] | None = None
    turn_deg: float | None = None
    scaling: str | None = None
    weight_decay: float | None = None
    device: str = "auto"
    threads: int = 1
    max_parameters: int | None = None
    max_state_bytes: int | None = None
    max_macs_per_step: int | None = None
    halving: bool = False
    share: float | None = None
    eta: float = 2.0

    @property
    def training(self) -> TrainSpec:
        """Training settings; epochs, batch and seed differ by training and are set in the plan."""
        changes = {key: getattr(self, key) for key in GRID_TRAINING if getattr(self, key) is not None}
        # All networks of a grid have a vector layer, or none.
        has_vectors = any(parse_symbol(symbol).vector is not None for symbol in self.architectures)
        return preset(self.preset, has_vectors, device=self.device, threads=self.threads, **changes)

    @property
    def windows(self) -> WindowSpec:
        """The settings of the windows."""
        return WindowSpec(window_s=self.window_s, step_s=self.step_s, context=self.context)

    @property
    def schedules(self) -> list[tuple[int, ...]]:
        """The numbers of epochs that each training of a network covers."""
        together = self.training.patience is None and not self.halving
        return [self.epochs] if together else [(epochs,) for epochs in self.epochs]

    def exceeded(self, arch: Arch) -> list[Excess]:
        """Return the limits that a network exceeds."""
        found = []
        for key, (name, unit) in LIMITS.items():
            value, limit = getattr(arch, name), getattr(self, key)
            if limit is not None and value > limit:
                found.append(Excess(value, limit, unit))
        return found

    def to_json(self) -> dict[str, object]:
        """Return plain values, without newer settings that have their defaults, which keeps the ids of old grids."""
        usual = {field.name: field.default for field in fields(self)}
        return {key: value for key, value in asdict(self).items() if key not in _NEW or value != usual[key]}


# 13 architectures × 4 filter sets × 3 epochs × 3 batches = 468 trials: "paper" as its section 3.6 describes them, and
# "scripts" as the authors' published experiment trains them. Its weight decay is MATLAB's default, which the paper does
# not mention. "people" has the same networks, trained for live use, to find a small one with halving.
GRIDS: dict[str, GridSpec] = {
    "paper": GridSpec(name="paper", context="rows"),
    "scripts": GridSpec(
        name="scripts", context="rows", split="windows:file-order", norm="layer", scaling="none", weight_decay=1e-4
    ),
    "people": GridSpec(
        name="people",
        epochs=(4, 15, 60),
        batches=(64,),
        split="by-subject:5",
        preset="people",
        padding="stream",
        context="stream",
        classes="shared",
    ),
}
# The network that the paper chose (section 3.6.2 and Figure 10), which was best with 250 epochs and batches of 64, and
# the second network that it shows (Figure 11).
CHOSEN = ("14d1_39d2_41d4", slashed(DEFAULT_FILTERS))
SECOND = ("19d1_19d2_19d4_17d8", "4/6/8/8")


def networks(grid: GridSpec, layout: Layout, classes: int) -> list[tuple[Arch, tuple[int, ...]]]:
    """Return each network of a grid, which must have no `problems`, with its filter set."""
    return [
        (_network(grid, symbol, filters, layout, classes), filters)
        for symbol in grid.architectures
        for filters in grid.filters
    ]


def _network(grid: GridSpec, symbol: str, filters: Sequence[int], layout: Layout, classes: int) -> Arch:
    return Arch.parse(
        symbol,
        filters,
        channels=layout.n_inputs,
        classes=classes,
        padding=grid.padding,
        norm=grid.norm,
        window=layout.samples(grid.window_s),
        step=layout.samples(_STEP_S),
        vectors=len(layout.vectors),
    )


def problems(
    grid: GridSpec, layout: Layout | None = None, past: int | None = None, windows: int | None = None
) -> list[str]:
    """Return a sentence for each reason why a grid cannot be trained.

    Args:
        layout: layout of the toy, for the length of a window in samples.
        past: median over the recordings of the number of samples in the stream up to the recording's end.
        windows: smallest number of training windows in a fold; if the split cannot be made, the number of all windows.
    """
    wrong = _of_settings(grid)
    shapes: dict[str, int] = {}
    for symbol in grid.architectures:
        try:
            shapes[symbol] = parse_symbol(symbol).filter_counts
        except ArchError as cause:
            wrong.append(first_line(cause))
    for filters in grid.filters:
        if not filters or min(filters) < 1:
            wrong.append(
                f"The filters {slashed(filters) or '(none)'} cannot be used: accepted are whole numbers from 1."
            )
            continue
        for symbol, layers in shapes.items():
            if len(filters) < layers:
                wrong.append(
                    f"{symbol} has {layers} layers, but the filters {slashed(filters)} are only {len(filters)}: "
                    "give one a layer."
                )
    wrong += _twice(grid)
    wrong += _mixed(list(shapes))
    for epochs in grid.epochs:
        if epochs < 1:
            wrong.append(f"Epochs {epochs} cannot be trained: accepted are whole numbers from 1.")
    if list(grid.epochs) != sorted(grid.epochs):
        wrong.append(
            f"The epochs {join_names(grid.epochs)} do not ascend: give {join_names(sorted(set(grid.epochs)))}."
        )
    for batch in grid.batches:
        if isinstance(batch, int) and batch < 2:
            wrong.append(f"A batch of {batch} cannot be used: accepted are whole numbers from 2 and '{FULL}'.")
        elif isinstance(batch, int) and windows is not None and batch > windows:
            wrong.append(
                f"A batch of {batch} is larger than the {windows} windows to train on with the split {grid.split}: "
                f"give at most {windows}, or '{FULL}'."
            )
    wrong += [f"Seed {seed} cannot be used: accepted are whole numbers from 0." for seed in grid.seeds if seed < 0]
    if layout is not None:
        wrong += [line for symbol in shapes for line in _too_long(grid, symbol, layout, past)]
    return list(dict.fromkeys(wrong))


def _of_settings(grid: GridSpec) -> list[str]:
    wrong = []
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", grid.name):
        wrong.append(f"The name '{grid.name}' cannot be a folder's: accepted are letters, digits and . _ - between.")
    for key in ("architectures", "filters", "epochs", "batches", "seeds"):
        if not getattr(grid, key):
            wrong.append(f"The grid has no {key}: give at least one.")
    for key, known in (
        ("preset", tuple(PRESETS)),
        ("padding", PADDINGS),
        ("norm", NORMS),
        ("context", CONTEXTS),
        ("device", DEVICES),
    ):
        value = getattr(grid, key)
        if value not in known:
            wrong.append(f"Unknown {key} '{value}': accepted are {', '.join(known)}.{nearest(value, known)}")
    for key in (*GRID_TRAINING, "threads"):
        if getattr(grid, key) is not None:
            wrong += _refused(partial(TrainSpec().changed, **{key: getattr(grid, key)}))
    wrong += _refused(lambda: WindowSpec(window_s=grid.window_s, step_s=grid.step_s))
    wrong += _refused(lambda: parse_split(grid.split))
    if grid.split_seed < 0:
        wrong.append(f"split_seed is {grid.split_seed}: accepted are whole numbers from 0.")
    for key in LIMITS:
        limit = getattr(grid, key)
        if limit is not None and limit < 1:
            wrong.append(f"{key} is {limit}: accepted are whole numbers from 1.")
    return wrong + _of_halving(grid)


def _of_halving(grid: GridSpec) -> list[str]:
    wrong = []
    if grid.share is not None and not 0.0 < grid.share <= 1.0:
        wrong.append(f"The share {grid.share:g} cannot be used: accepted is above 0, up to 1.")
    if not (math.isfinite(grid.eta) and grid.eta > 1.0):
        wrong.append(f"eta is {grid.eta:g}: accepted is above 1.")
    patience = grid.patience or (PRESETS[grid.preset].patience if grid.preset in PRESETS else None)
    if grid.halving and patience is not None:
        wrong.append(
            f"Trainings that stop early (patience {patience}, preset {grid.preset}) cannot be continued after halving: "
            "use the preset people or search, without patience."
        )
    return wrong


def _mixed(symbols: Sequence[str]) -> list[str]:
    """Report that only some of the networks begin with a vector layer."""
    turning = [symbol for symbol in symbols if parse_symbol(symbol).vector is not None]
    other = next((symbol for symbol in symbols if symbol not in turning), None)
    if not turning or other is None:
        return []
    return [
        f"{turning[0]} begins with a vector layer, {other} does not, so they read different inputs: make a grid of "
        "each kind."
    ]


def _refused(make: Callable[[], object]) -> list[str]:
    try:
        make()
    except BadInput as cause:
        return [first_line(cause)]
    return []


def _twice(grid: GridSpec) -> list[str]:
    """Report trials that are in the grid more than once: repeated values, or one network under several names."""
    wrong = []
    for key in ("epochs", "batches", "seeds"):
        values = getattr(grid, key)
        again = [value for value in dict.fromkeys(values) if values.count(value) > 1]
        wrong += [f"The grid has {value} among its {key} {values.count(value)} times: give it once." for value in again]
    seen: dict[object, str] = {}
    for symbol in grid.architectures:
        for filters in grid.filters:
            try:
                shape = parse_symbol(symbol)
            except ArchError:
                continue
            network, name = (shape, filters[: shape.filter_counts]), f"{symbol} with {slashed(filters) or '(none)'}"
            if network in seen:
                other = f"as {seen[network]}" if seen[network] != name else "twice"
                wrong.append(f"{name} is the same network {other}: leave one out.")
            seen.setdefault(network, name)
    return wrong


def _too_long(grid: GridSpec, symbol: str, layout: Layout, past: int | None) -> list[str]:
    """Report a network that needs more samples than a window, or with padding and context "stream" the real past, has.

    Without a real past, a receptive field may exceed the window by less than its widest dilation, as the paper's 126d2.
    """
    # `_of_settings` reports an unknown padding or norm.
    known = replace(grid, padding=grid.padding if grid.padding in PADDINGS else "mirror", norm="batch")
    try:
        arch = _network(known, symbol, (2,) * 5, layout, 2)
    except BadInput as cause:
        # The window is wrong; report it unless `_of_settings` already does.
        return [] if _of_settings(grid) else [first_line(cause)]
    field, window = arch.receptive_field, arch.window
    if grid.padding == "stream" and grid.context == "stream":
        if past is None or arch.span <= max(past, window):
            return []
        return [
            f"{symbol} sees {arch.span} samples for a decision (receptive field {field}), but half of the recordings "
            f"have fewer than {past + 1} samples of real past up to their end: take shorter kernels."
        ]
    if field - window < max(layer.dilation for layer in arch.layers):
        return []
    real = "only padding 'stream' with context 'stream' reads more"
    # The networks of grids are mostly made for 100 Hz.
    fitting = symbol_within(symbol_at_rate(symbol, layout.rate_hz), window)
    return [
        f"{symbol} has a receptive field of {field} samples ({field / layout.rate_hz:.2g} s), longer than the window "
        f"of {window} ({real}): take shorter kernels, such as {fitting}, or a window_s of {field / layout.rate_hz:g}."
    ]


def first_line(cause: Exception) -> str:
    """Return the first line of an error message, without the drawing that may follow."""
    return (str(cause) or type(cause).__name__).splitlines()[0]


def load_grid(
    grid: GridSpec | str | os.PathLike[str], changes: Mapping[str, Any] | None = None
) -> tuple[GridSpec, list[str]]:
    """Read a grid and apply ``changes``.

    Args:
        grid: a `GridSpec`, the name of one of `GRIDS`, or the path of a TOML file.
        changes: new values of keys, also as text: TOML, or items joined by commas (filters: ``4/6/8/8,8/12/16/16``);
            None leaves a key as it is.

    Returns:
        the grid, and a sentence for each key or value that cannot be read and is therefore ignored.

    Raises:
        ConfigError: for an unknown name, or a file that is missing or not TOML.
    """
    wrong: list[str] = []
    if not isinstance(grid, GridSpec):
        path = os.fspath(grid)
        if path in GRIDS:
            grid = GRIDS[path]
        else:
            table, wrong = _read_table(Path(path))
            grid, more = _changed(GridSpec(name=Path(path).stem), table, f"[grid] in '{path}'")
            wrong += more
    changes = changes or {}
    grid, more = _changed(grid, changes, "the grid")
    if not grid.halving and any(changes.get(key) is not None for key in ("share", "eta")):
        more.append("share and eta are for halving only: give --halving (in a file: halving = true), too.")
    return grid, wrong + more


def _read_table(path: Path) -> tuple[Mapping[str, Any], list[str]]:
    """Return the table of a grid's file, and a sentence for each other one, or if there is none."""
    if path.suffix != ".toml" and not path.is_file():
        raise ConfigError(
            f"Unknown grid '{path}': accepted are {', '.join(GRIDS)} and the path of a TOML file."
            f"{nearest(str(path), GRIDS)}"
        )
    content = read_toml(path, "grid", ConfigError)
    wrong = [unknown_key(key, ("grid",), f"'{path}'") for key in content if key != "grid"]
    table = content.get("grid")
    if isinstance(table, Mapping):
        return table, wrong
    return {}, [*wrong, f"'{path}' has no table [grid]: write  [grid]  and its keys below."]


def _changed(grid: GridSpec, table: Mapping[str, Any], where: str) -> tuple[GridSpec, list[str]]:
    """Return ``grid`` with the values of ``table``, and a message for each wrong key or value; None keeps a value.

    If one item of a list is wrong, the others are kept, so that their problems are found as well.
    """
    kinds = get_type_hints(GridSpec)
    parsed = {key: _parsed(key, value, kinds.get(key)) for key, value in table.items() if value is not None}
    values, wrong = check_table(parsed, GridSpec, where)
    return replace(grid, **values), wrong


def _parsed(key: str, value: Any, kind: Any) -> Any:
    """Return a value as the type ``kind`` needs it; a text may be TOML, or the items of a list joined by commas."""
    listed = next((one for one in (kind, *get_args(kind)) if get_origin(one) is tuple), None)
    texts = str in (kind, *get_args(kind), *get_args(listed))
    if isinstance(value, str) and listed is not None and "[" not in value:
        parts = [value] if key == "filters" and "/" not in value else value.split(",")
        value = [part.strip() if texts or key == "filters" else _toml(part) for part in parts]
    elif isinstance(value, str) and (listed is not None or not texts):
        value = _toml(value)
    if key == "classes" and isinstance(value, list | tuple) and all(isinstance(item, str) for item in value):
        return ",".join(value)
    if key == "filters" and isinstance(value, list | tuple):
        return [_filter_set(item) for item in value]
    return value


def _toml(text: str) -> Any:
    """Return the value of a TOML text; one that is not TOML is the value itself."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _filter_set(item: Any) -> Any:
    """Return one set of filters, also from a text such as ``4/6/8/8``."""
    with contextlib.suppress(ArchError):
        return parse_filters(str(item).replace("/", ",")) if isinstance(item, str | int) else item
    return item
