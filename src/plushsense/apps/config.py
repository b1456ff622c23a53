"""One run's settings: which network, trained how, on which windows, scored by which split. A TOML file can hold them.

    [windows]     window_s, step_s, context, longest_factor
    [model]       arch, filters, padding, norm, step_s, pool_s
    [training]    preset, epochs, batch, learning_rate, halve_every, patience, seed, turn_deg, …
    [evaluation]  split, classes, train_context, workers, seed
    [live]        smoothing_s

Flags of the command line go over the file; an unknown key is refused with the nearest known one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.signal import Layout
from plushsense.core.tomlfile import read_toml, refuse_unknown
from plushsense.live.decide import DecideSpec
from plushsense.models.arch import DEFAULT_FILTERS, DEFAULT_SYMBOL, Arch
from plushsense.models.symbol import parse_filters
from plushsense.training.spec import CONTEXT, PADDING, PRESETS, TrainSpec, preset
from plushsense.windows.cut import WindowSpec

SHARED, ALL = "shared", "all"


@dataclass(frozen=True)
class ModelSpec:
    """The network, in the terms of the toy. ``padding`` None is the preset's; ``pool_s`` None fills the window."""

    arch: str = DEFAULT_SYMBOL
    filters: tuple[int, ...] = DEFAULT_FILTERS
    padding: str | None = None
    norm: str = "batch"
    step_s: float = 0.05
    pool_s: float | None = None

    def build(self, layout: Layout, classes: int, window_s: float, padding: str) -> Arch:
        """The network for a toy's layout and a number of classes."""
        return Arch.parse(
            self.arch,
            self.filters,
            channels=layout.n_inputs,
            classes=classes,
            padding=self.padding or padding,
            norm=self.norm,
            window=layout.samples(window_s),
            step=layout.samples(self.step_s),
            pool=None if self.pool_s is None else layout.samples(self.pool_s),
        )


@dataclass(frozen=True)
class EvaluationSpec:
    """How a network is scored. ``train_context`` None: windows to train on are cut as those to score.

    ``classes`` is "shared" (gestures that at least 90 % of the people made and that are not free choice), "all", or
    labels. ``workers`` 0: one a processor.
    """

    split: str = "leave-one-subject-out"
    classes: str | tuple[str, ...] = SHARED
    train_context: str | None = None
    workers: int = 0
    seed: int = 0

    @property
    def processes(self) -> int:
        """Worker processes."""
        return self.workers or os.cpu_count() or 1


@dataclass(frozen=True)
class RunConfig:
    """All settings of a run, resolved."""

    preset: str = "people"
    windows: WindowSpec = field(default_factory=WindowSpec)
    model: ModelSpec = field(default_factory=ModelSpec)
    training: TrainSpec = field(default_factory=TrainSpec)
    evaluation: EvaluationSpec = field(default_factory=EvaluationSpec)
    live: DecideSpec = field(default_factory=DecideSpec)

    @property
    def padding(self) -> str:
        """The padding that is used."""
        return self.model.padding or PADDING[self.preset]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON: what a bundle carries."""
        return asdict(self)


_TABLES: dict[str, type[Any]] = {
    "windows": WindowSpec,
    "model": ModelSpec,
    "training": TrainSpec,
    "evaluation": EvaluationSpec,
    "live": DecideSpec,
}


def resolve(path: str | Path | None = None, **flags: Mapping[str, Any]) -> RunConfig:
    """The settings of a TOML file with ``flags`` over them: ``resolve(None, training={"seed": 3})``.

    A flag of None is not given. ``preset`` stands in the table ``training``.

    Raises:
        ConfigError: for an unknown table or key (with the nearest known one) or a value that does not fit.
    """
    tables: dict[str, dict[str, Any]] = {name: {} for name in _TABLES}
    if path is not None:
        content = read_toml(Path(path), "configuration", ConfigError)
        refuse_unknown(content, _TABLES, f"'{path}'", ConfigError)
        for name, table in content.items():
            if not isinstance(table, dict):
                raise ConfigError(f"'{name}' in '{path}' is a single value; it is a table: write  [{name}]")
            known = [f.name for f in fields(_TABLES[name])] + (["preset"] if name == "training" else [])
            refuse_unknown(table, known, f"[{name}] of '{path}'", ConfigError)
            tables[name].update(table)
    for name, given in flags.items():
        tables[name].update({key: value for key, value in given.items() if value is not None})
    chosen = str(tables["training"].pop("preset", "people"))
    training = preset(chosen)
    tables["windows"].setdefault("context", CONTEXT[chosen])
    if "filters" in tables["model"]:
        wanted = tables["model"]["filters"]
        tables["model"]["filters"] = parse_filters(wanted) if isinstance(wanted, str) else tuple(wanted)
    if isinstance(classes := tables["evaluation"].get("classes"), list):
        tables["evaluation"]["classes"] = tuple(classes)
    try:
        return RunConfig(
            chosen,
            WindowSpec(**tables["windows"]),
            ModelSpec(**tables["model"]),
            replace(training, **tables["training"]),
            EvaluationSpec(**tables["evaluation"]),
            DecideSpec(**tables["live"]),
        )
    except TypeError as cause:
        raise ConfigError(f"A setting has a value of the wrong kind: {cause}.") from None


PRESET_NAMES = tuple(PRESETS)
