"""What is fitted in a fold of the continuous benchmark: networks, on windows and anywhere in a stream, and a gate."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plushsense import __version__
from plushsense.apps.config import RunConfig
from plushsense.apps.preparation import Warn, choose_classes, classes_for, outside_streams, silent, windows_for
from plushsense.core.errors import ConfigError
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.dataset.store import Dataset
from plushsense.deploy.calibration import calibration
from plushsense.evaluation.streams import Fitted, PeopleFold
from plushsense.evaluation.systems import ANYWHERE, WINDOWS
from plushsense.live.gate import GateSpec, fit_gate
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runs.journal import job_id
from plushsense.training.spec import TrainSpec
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSpec

EpochProgress = Callable[[int, int, dict[str, Any]], None]


@dataclass(frozen=True)
class Recipe:
    """One of a fold's networks: how it is trained, on which windows."""

    arch: Arch
    training: TrainSpec
    windows: WindowSpec
    gestures: GestureSet
    anywhere: AnywhereSpec | None = None

    def key(self) -> dict[str, Any]:
        """What a network depends on, beside the data and the fold."""
        return {
            "arch": self.arch.to_dict(),
            "training": self.training.key(),
            "windows": vars(self.windows),
            "gestures": self.gestures.to_dict(),
            "anywhere": None if self.anywhere is None else vars(self.anywhere),
        }


@dataclass(frozen=True)
class TrainStreams:
    """Fits what a fold of the benchmark needs; a network that was trained once is kept in ``folder``."""

    recipes: Mapping[str, Recipe]
    gate: bool
    folder: Path

    def __call__(self, dataset: Dataset, fold: PeopleFold, progress: EpochProgress, /) -> Fitted:
        networks = {name: self._network(recipe, dataset, fold, progress) for name, recipe in self.recipes.items()}
        if not self.gate:
            return Fitted(networks)
        fitted = fit_gate(dataset, next(iter(networks.values())).gestures, fold.train)
        return Fitted(networks, fitted.plan, {"gate": fitted.report, "plan": fitted.plan.to_dict()})

    def _network(self, recipe: Recipe, dataset: Dataset, fold: PeopleFold, progress: EpochProgress) -> Bundle:
        path = self.folder / f"{job_id({**recipe.key(), 'data': dataset.hash, 'fold': vars(fold)})}.plush"
        if path.is_file():
            return Bundle.load(path)
        from plushsense.training.fit import fit

        arch, gestures = recipe.arch, recipe.gestures
        cut = scored = windows_for(dataset, arch, recipe.windows, gestures, anywhere=recipe.anywhere)
        if recipe.anywhere is not None:
            scored = windows_for(dataset, arch, replace(recipe.windows, context="stream"), gestures)
        # What nobody made (the toy at rest) belongs to no fold, and is trained on in every one.
        mine = np.isin(cut.subject, [*fold.train, NOBODY])
        train = cut.take(np.flatnonzero(mine & outside_streams(cut, dataset, {*fold.validation, *fold.test})))
        watch = scored.take(np.flatnonzero(np.isin(scored.subject, fold.validation)))
        fitted = fit(train, watch, arch, recipe.training, progress)
        kept = calibration(arch, fitted.weights, fitted.scaler, train.x)
        people = {"subjects": list(fold.train), "validation_subjects": list(fold.validation)}
        told = {"dataset": dataset.head.name, "dataset_hash": dataset.hash, "code_version": __version__, **people}
        bundle = Bundle(
            arch, fitted.weights, dataset.layout, fitted.scaler, gestures, dict(vars(recipe.windows)), {}, told, kept
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        bundle.save(path)
        return bundle

    def key(self) -> dict[str, Any]:
        """What all of it depends on, beside the data and the fold."""
        return {
            "gate": str(GateSpec()) if self.gate else None,
            **{name: recipe.key() for name, recipe in self.recipes.items()},
        }


def recipes_for(
    dataset: Dataset, config: RunConfig, networks: Collection[str], anywhere_pool_s: float | None, warn: Warn = silent
) -> dict[str, Recipe]:
    """How each network is trained: both alike but for the windows, the epochs and, where it is given, the pool.

    There are several times as many windows anywhere in a stream, so half the epochs are more steps all the same.
    """
    from plushsense.training.fit import placed

    if config.padding != "stream":
        raise ConfigError(f"A network with {config.padding} padding cannot follow a stream: use --padding stream.")
    training = placed(config.training)
    wanted, found = config.evaluation.classes, {}
    if WINDOWS in networks:
        gestures = choose_classes(dataset, wanted, warn)
        windows = replace(
            config.windows, context="stream" if config.windows.context == "anywhere" else config.windows.context
        )
        arch = config.model.build(dataset.layout, len(gestures), windows.window_s, config.padding)
        found[WINDOWS] = Recipe(arch, training, windows, gestures)
    if ANYWHERE in networks:
        gestures = classes_for(dataset, wanted, "anywhere", warn if WINDOWS not in networks else silent)
        model = config.model if anywhere_pool_s is None else replace(config.model, pool_s=anywhere_pool_s)
        arch = model.build(dataset.layout, len(gestures), config.windows.window_s, config.padding)
        halved = replace(training, epochs=-(-training.epochs // 2))
        if training.halve_every:
            halved = replace(halved, halve_every=-(-training.halve_every // 2))
        found[ANYWHERE] = Recipe(arch, halved, replace(config.windows, context="anywhere"), gestures, config.anywhere)
    return found
