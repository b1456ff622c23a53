"""Settings of one run, which a TOML file can contain: network, training, windows and split.

`TABLES` has the tables of the file by name; their keys are the attributes of the classes.
Options of the command line override the file. An unknown key is an error that names the most similar known key.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ArchError, ConfigError, check_known, check_seed
from plushsense.core.layouts import Layout
from plushsense.core.toml import check_table, read_toml, refuse_unknown
from plushsense.models.arch import (
    DEFAULT_FILTERS,
    DEFAULT_SYMBOL,
    NORMS,
    PADDINGS,
    VECTOR_FILTERS,
    VECTOR_SYMBOL,
    Arch,
    parse_filters,
    parse_symbol,
    symbol_at_rate,
)
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import CONTEXT, PADDING, PRESETS, VECTOR_AUGMENT, TrainSpec, preset
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import ANYWHERE, TRAIN_CONTEXTS, WindowSpec

SHARED, ALL = "shared", "all"


@dataclass(frozen=True)
class ModelSpec:
    """Settings of the network.

    Attributes:
        arch: the layers, joined by ``_``: each has its kernel length in samples, and after ``d`` its dilation, as in
            ``14d1_39d2_41d4``; ``v`` before the first is a vector layer (default: by layout and preset).
        filters: number of filters of each layer; also as text, ``8,12,16`` (default: those of the network).
        padding: what a network reads before the start of a window. ``stream``: nothing, so that it can read a live
            signal sample by sample; ``causal``: zeros; ``mirror``: the window in reverse, as the paper (one of
            `PADDINGS`; default: by the preset).
        norm: normalisation after each layer (one of `NORMS`).
        step_s: time between two live decisions (above 0 to 60).
        pool_s: time over which a decision averages, with the padding ``stream`` (above 0 to 60; default: what fills the
            window).
    """

    arch: str | None = None
    filters: tuple[int, ...] | None = None
    padding: str | None = None
    norm: str = "batch"
    step_s: float = 0.05
    pool_s: float | None = None

    def __post_init__(self) -> None:
        for name, seconds in (("step_s", self.step_s), ("pool_s", self.pool_s)):
            if seconds is not None and not 0.0 < seconds <= 60.0:
                raise ConfigError(f"{name} is {seconds}: accepted is above 0 and up to 60 seconds.")
        if self.padding is not None:
            check_known(self.padding, PADDINGS, "padding", ArchError)
        check_known(self.norm, NORMS, "norm", ArchError)

    def build(self, layout: Layout, classes: int, window_s: float, padding: str) -> Arch:
        """Build the network for the inputs of a layout and a number of classes."""
        arch = self.arch or symbol_at_rate(DEFAULT_SYMBOL, layout.rate_hz)
        return Arch.parse(
            arch,
            self.filters or default_filters(arch),
            channels=layout.n_inputs,
            classes=classes,
            padding=self.padding or padding,
            norm=self.norm,
            window=layout.samples(window_s),
            step=layout.samples(self.step_s),
            pool=None if self.pool_s is None else layout.samples(self.pool_s),
            vectors=len(layout.vectors),
        )


def default_filters(symbol: str) -> tuple[int, ...]:
    """Return the filters of a network for which none are given."""
    return DEFAULT_FILTERS if parse_symbol(symbol).vector is None else VECTOR_FILTERS


@dataclass(frozen=True)
class EvaluationSpec:
    """Settings of an evaluation.

    Attributes:
        split: which recordings are scored and which are learned from: ``leave-one-subject-out``, ``by-subject:5`` (by
            people), ``by-recording:5``, ``recordings:holdout``, ``recordings:random``; leaky, as in the paper:
            ``windows:5``, ``windows:holdout``, ``windows:file-order``, ``saved`` (the sets of an imported .mat). The
            numbers are those of the folds.
        classes: ``shared`` (gestures that at least 90 % of the people made, without free choice), ``all``, a list of
            labels, or merged gestures: ``family``, ``affect``, the name of a built-in merge or the path of a gesture
            set file.
        train_context: context of the training windows, if it is not that of the scored ones (one of `TRAIN_CONTEXTS`;
            default: as ``context``).
        workers: number of processes; 0: one for each processor (from 0).
        seed: number that the folds are drawn from (from 0).
    """

    split: str = "leave-one-subject-out"
    classes: str | tuple[str, ...] = SHARED
    train_context: str | None = None
    workers: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        parse_split(self.split)
        for name, value in (("workers", self.workers), ("seed", self.seed)):
            if value < 0:
                raise ConfigError(f"{name} is {value}: accepted are whole numbers from 0 up.")
        check_seed(self.seed)
        if self.train_context is not None:
            check_known(self.train_context, TRAIN_CONTEXTS, "train_context", ConfigError)

    @property
    def processes(self) -> int:
        """Number of worker processes."""
        return self.workers or os.cpu_count() or 1


@dataclass(frozen=True)
class RunConfig:
    """Resolved settings of a run; ``augment_given``: the augmentations were not left to the preset."""

    preset: str = "people"
    windows: WindowSpec = field(default_factory=WindowSpec)
    model: ModelSpec = field(default_factory=ModelSpec)
    training: TrainSpec = field(default_factory=TrainSpec)
    evaluation: EvaluationSpec = field(default_factory=EvaluationSpec)
    live: DecideSpec = field(default_factory=DecideSpec)
    anywhere: AnywhereSpec = field(default_factory=AnywhereSpec)
    augment_given: bool = False

    @property
    def trained_on(self) -> WindowSpec:
        """Settings of the training windows."""
        return replace(self.windows, context=self.evaluation.train_context or self.windows.context)

    @property
    def scored_on(self) -> WindowSpec:
        """Settings of the scored windows; the context "stream" (gestures with their real past) replaces "anywhere"."""
        return replace(self.windows, context="stream") if self.windows.context == ANYWHERE else self.windows

    @property
    def holds_back(self) -> bool:
        """Whether an evaluation holds people back for validation: not if nothing depends on them."""
        return self.training.patience is not None or not parse_split(self.evaluation.split).separates_people

    @property
    def padding(self) -> str:
        """The padding of ``model``, or if that is None, of the preset."""
        return self.model.padding or PADDING[self.preset]

    def for_layout(self, layout: Layout) -> RunConfig:
        """Return the settings with the default network for a layout, its filters and augmentations, where not given.

        With the preset ``people`` and a layout of vectors alone, one of them an acceleration, that is a network with a
        vector layer. Beside other sensors it was no better (on the virtual toy; no real recordings were at hand).
        Kernels of default networks last as long at any rate.
        """
        axes = {axis for vector in layout.vectors for axis in vector}
        turns = layout.has_gravity and set(layout.inputs) <= axes
        fits = self.preset == "people" and self.padding == "stream"
        default = VECTOR_SYMBOL if turns and fits else DEFAULT_SYMBOL
        arch = self.model.arch or symbol_at_rate(default, layout.rate_hz)
        model = replace(self.model, arch=arch, filters=self.model.filters or default_filters(arch))
        training = self.training
        by_preset = not self.augment_given and training.augment == PRESETS["people"].augment
        if parse_symbol(arch).vector is not None and by_preset:
            training = replace(training, augment=VECTOR_AUGMENT)
        return replace(self, model=model, training=training)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, as a bundle stores them."""
        values = asdict(self) | {"training": self.training.to_dict()}
        del values["augment_given"]
        return values

    def changes(self, layout: Layout) -> dict[str, Any]:
        """Return the settings of windows, network and training that differ from the preset's for this network.

        The symbol of the network, its filters and padding, the context and the seed are left out.
        """
        told = ("arch", "filters", "padding", "seed", "context")
        network = {key: getattr(self.model, key) for key in ("arch", "filters", "padding")}
        usual = resolve(model=network, training={"preset": self.preset}).for_layout(layout).outcome()
        return {
            key: value
            for table in ("windows", "model", "training")
            for key, value in self.outcome()[table].items()
            if value != usual[table].get(key) and key not in told
        }

    def outcome(self) -> dict[str, Any]:
        """Return the settings that an evaluation's scores depend on, as plain values for JSON."""
        evaluation = asdict(self.evaluation) | {"train_context": self.trained_on.context}
        del evaluation["workers"]
        training = {k: v for k, v in self.training.key().items() if k not in ("device", "threads")}
        anywhere = {"anywhere": asdict(self.anywhere)} if self.trained_on.context == ANYWHERE else {}
        return {
            **anywhere,
            "windows": asdict(self.windows),
            "model": asdict(self.model) | {"padding": self.padding},
            "training": training,
            "evaluation": evaluation,
        }


@dataclass(frozen=True)
class _TrainingTable(TrainSpec):
    """The keys of the table ``training``.

    Attributes:
        preset: the settings to begin with, which the other keys change: ``people`` (ours, for people whom the network
            never met), ``loso`` and ``search`` (the paper's schedules), ``paper`` (the paper's, also in the windows and
            the padding) (one of `PRESETS`).
        turn_deg: the same as ``augment = ["random-rotation:…"]``, in degrees; only one of the two may be given
            (0 to 180).
    """

    preset: str = "people"
    turn_deg: float = 0.0


TABLES: dict[str, type[Any]] = {
    "windows": WindowSpec,
    "model": ModelSpec,
    "training": _TrainingTable,
    "evaluation": EvaluationSpec,
    "live": DecideSpec,
    "anywhere": AnywhereSpec,
}


def _checked(name: str, given: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the values of a table; raise ConfigError for an unknown key or a value of the wrong type."""
    if name == "windows" and "span_s" in given:
        raise ConfigError(
            f"In [windows]{source}, span_s cannot be set: it follows from the network; set arch, window_s or pool_s."
        )
    if name == "model" and isinstance(given.get("filters"), str):
        given = {**given, "filters": parse_filters(given["filters"])}
    values, problems = check_table(given, TABLES[name], f"[{name}]{source}")
    if problems:
        raise ConfigError(problems[0])
    return values


def resolve(path: str | Path | None = None, **flags: Mapping[str, Any]) -> RunConfig:
    """Read the settings of a TOML file and override them: ``resolve(None, training={"seed": 3})``.

    Args:
        path: a TOML file; None: only defaults.
        flags: values of each table; None counts as not given. ``preset`` belongs to the table ``training``.

    Raises:
        ConfigError: for an unknown table or key (the message suggests the nearest known one) or an invalid value.
    """
    tables: dict[str, dict[str, Any]] = {name: {} for name in TABLES}
    if path is not None:
        content = read_toml(Path(path), "configuration", ConfigError)
        refuse_unknown(content, TABLES, f"'{path}'", ConfigError)
        for name, table in content.items():
            if not isinstance(table, dict):
                raise ConfigError(f"'{name}' in '{path}' is a single value, but must be a table: write  [{name}]")
            tables[name].update(_checked(name, table, f" of '{path}'"))
    refuse_unknown(flags, TABLES, "the settings", ConfigError)
    for name, given in flags.items():
        tables[name].update(_checked(name, {key: value for key, value in given.items() if value is not None}, ""))
    name = tables["training"].pop("preset", "people")
    make: dict[str, Callable[..., Any]] = {**TABLES, "training": preset(name).changed}
    tables["windows"].setdefault("context", CONTEXT[name])
    augment_given = not {"augment", "turn_deg"}.isdisjoint(tables["training"])
    specs = {table: make[table](**values) for table, values in tables.items()}
    return RunConfig(name, **specs, augment_given=augment_given)


# The table of each setting of `train`, `evaluate` and `baselines`.
_SETTINGS: dict[str, tuple[str, ...]] = {
    "windows": ("context", "window_s", "step_s", "longest_factor"),
    "model": ("arch", "filters", "padding", "norm", "pool_s"),
    "training": (
        *("preset", "epochs", "batch", "learning_rate", "halve_every", "patience", "device"),
        *("augment", "turn_deg", "scaling", "weight_decay"),
    ),
    "evaluation": ("classes", "train_context", "workers"),
    "live": ("smoothing_s",),
    "anywhere": ("every_s", "onset_s", "after_s", "settle_s", "idle_share", "busy_share", "hard_share"),
}


def from_settings(**settings: Any) -> RunConfig:
    """Build a configuration from settings: ``arch="14d1_39d2_41d4", preset="loso"``; None counts as not given.

    Raises:
        ConfigError: for an unknown setting (the message suggests the nearest known one) or an invalid value.
    """
    known = [key for keys in _SETTINGS.values() for key in keys] + ["seed"]
    for key in settings:
        check_known(key, known, "setting", ConfigError)
    tables: dict[str, dict[str, Any]] = {
        table: {key: settings[key] for key in keys if key in settings} for table, keys in _SETTINGS.items()
    }
    tables["training"]["seed"] = tables["evaluation"]["seed"] = settings.get("seed")
    return resolve(None, **tables)
