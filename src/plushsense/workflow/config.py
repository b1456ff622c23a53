"""Settings of one run, which a TOML file can contain: network, training, windows and split.

`TABLES` has the tables of the file by name; their keys are the attributes of the classes.
Options of the command line override the file. An unknown key is an error that names the most similar known key.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from plushsense.core.errors import ArchError, ConfigError, check_known, check_seed
from plushsense.core.toml import check_table, read_toml, refuse_unknown
from plushsense.models.arch import NORMS, PADDINGS, POOLINGS, parse_filters
from plushsense.runtime.decisions import DecideSpec
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import CONTEXT, TrainSpec, preset
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import TRAIN_CONTEXTS, WindowSpec

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
        pooling: statistics over that time: ``mean``, or ``mean+deviation``, as well how much the means of its steps
            differ (default: ``mean+deviation`` with a vector layer and 10 steps or more, else ``mean``).
    """

    arch: str | None = None
    filters: tuple[int, ...] | None = None
    padding: str | None = None
    norm: str = "batch"
    step_s: float = 0.05
    pool_s: float | None = None
    pooling: str | None = None

    def __post_init__(self) -> None:
        for name, seconds in (("step_s", self.step_s), ("pool_s", self.pool_s)):
            if seconds is not None and not 0.0 < seconds <= 60.0:
                raise ConfigError(f"{name} is {seconds}: accepted is above 0 and up to 60 seconds.")
        if self.padding is not None:
            check_known(self.padding, PADDINGS, "padding", ArchError)
        check_known(self.norm, NORMS, "norm", ArchError)
        if self.pooling is not None:
            check_known(self.pooling, POOLINGS, "pooling", ArchError)

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON, without the pooling ``mean``, of which earlier versions did not tell."""
        return {key: value for key, value in asdict(self).items() if key != "pooling" or value != "mean"}


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
    """Settings of a run as they were given; `plushsense.workflow.preparation.prepare` resolves the rest for a data set.

    ``given``: names of the settings of the training that were not left to the preset.
    """

    preset: str = "people"
    windows: WindowSpec = field(default_factory=WindowSpec)
    model: ModelSpec = field(default_factory=ModelSpec)
    training: TrainSpec = field(default_factory=TrainSpec)
    evaluation: EvaluationSpec = field(default_factory=EvaluationSpec)
    live: DecideSpec = field(default_factory=DecideSpec)
    anywhere: AnywhereSpec = field(default_factory=AnywhereSpec)
    given: frozenset[str] = frozenset()


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
    chosen = frozenset("augment" if key == "turn_deg" else key for key in tables["training"])
    specs = {table: make[table](**values) for table, values in tables.items()}
    return RunConfig(name, **specs, given=chosen)


# The table of each setting of `train`, `evaluate` and `baselines`.
_SETTINGS: dict[str, tuple[str, ...]] = {
    "windows": ("context", "window_s", "step_s", "longest_factor"),
    "model": ("arch", "filters", "padding", "norm", "pool_s", "pooling"),
    "training": (
        *("preset", "epochs", "batch", "learning_rate", "halve_every", "patience", "device"),
        *("augment", "turn_deg", "scaling", "weight_decay", "stride"),
    ),
    "evaluation": ("split", "classes", "train_context", "workers"),
    "live": ("smoothing_s",),
    "anywhere": ("every_s", "onset_s", "after_s", "settle_s", "idle_share", "busy_share"),
}


def from_stored(config: Mapping[str, Any]) -> RunConfig:
    """Return the settings for a training from those that an evaluation stored (`plushsense.workflow.preparation.Run`).

    Raises:
        ConfigError: if a table is missing, or has an unknown key or an invalid value.
    """
    try:
        tables = {name: dict(config[name]) for name in ("windows", "model", "training", "evaluation", "anywhere")}
        tables["training"]["preset"] = config["preset"]
        # `to_dict` leaves them out, and so did earlier versions.
        tables["training"].setdefault("stride", TrainSpec.stride)
        tables["model"].setdefault("pooling", "mean")
    except (KeyError, TypeError, ValueError):
        raise ConfigError("The settings of this evaluation are incomplete. Evaluate again.") from None
    tables["windows"].pop("span_s", None)
    if context := tables["evaluation"].pop("train_context", None):
        tables["windows"]["context"] = context
    return resolve(None, **tables)


def from_settings(config: RunConfig | None = None, /, **settings: Any) -> RunConfig:
    """Return ``config``, or build one from settings: ``arch="14d1_39d2_41d4", preset="loso"``; None: not given.

    Raises:
        ConfigError: for an unknown setting (the message suggests the nearest known one) or an invalid value, and for
            settings beside a ``config``.
    """
    if config is not None:
        if settings:
            raise ConfigError(f"Both a config and settings ({', '.join(settings)}) are given: give one of them.")
        return config
    known = [key for keys in _SETTINGS.values() for key in keys] + ["seed"]
    for key in settings:
        check_known(key, known, "setting", ConfigError)
    tables: dict[str, dict[str, Any]] = {
        table: {key: settings[key] for key in keys if key in settings} for table, keys in _SETTINGS.items()
    }
    tables["training"]["seed"] = tables["evaluation"]["seed"] = settings.get("seed")
    return resolve(None, **tables)
