"""Compare baselines with our network on the same windows under several splits, and save the results."""

from __future__ import annotations

import json
import os
import platform
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, check_known, nearest, need, python_warning
from plushsense.core.files import write_file
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.core.version import __version__
from plushsense.dataset.index import as_dataset
from plushsense.dataset.quality.copies import copied_recordings
from plushsense.dataset.store import Dataset
from plushsense.evaluation.leakage import warn_of_copies
from plushsense.experiments.baselines.models import (
    BASELINES,
    DEFAULT_FEATURES,
    RECURRENT,
    TOO_LONG,
    classical,
    parse_recurrent,
    recurrent,
)
from plushsense.experiments.baselines.score import (
    UNSCALED,
    BaselinesResult,
    ComparisonResult,
    Contender,
    Fit,
    Pca,
    Reader,
    compare,
)
from plushsense.jobs.journal import job_id
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.study import Progress
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import Network
from plushsense.scoring.splits import parse_split
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import ANYWHERE, WindowSet
from plushsense.windows.features import Scaler
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import Run, Warn, prepare
from plushsense.workflow.reporting import check_results, journal_of, machine

SPLITS = ("leave-one-subject-out", "windows:5")
TABLE, SHEET, PAGE, PICTURE = "baselines.json", "baselines.csv", "baselines.html", "baselines.png"

NETWORK = "network"
# By name: classical programs, recurrent networks, and our own network.
MODELS = (*BASELINES, *RECURRENT, NETWORK)
# "quick" takes seconds per fold in all.
SETS: dict[str, tuple[str, ...]] = {
    "quick": ("forest", "extra-trees", "knn", "rbf-svm", "tree"),
    "classical": tuple(BASELINES),
    "all": MODELS,
}
# "yes" scales before PCA, "unscaled" after it, as MATLAB's Classification Learner does.
PCA: dict[str, tuple[Pca, ...]] = {
    "both": (False, True),
    "no": (False,),
    "yes": (True,),
    UNSCALED: (UNSCALED,),
    "all": (False, True, UNSCALED),
}


@dataclass(frozen=True)
class NetworkFit:
    """A function that trains one of our networks; the size of the network is that of its bundle file."""

    arch: Arch
    spec: TrainSpec
    layout: Layout
    gestures: GestureSet

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        from plushsense.training.fit import fit

        fitted = fit(train, validation, self.arch, self.spec)
        bundle = Bundle(self.arch, fitted.weights, self.layout, fitted.scaler, self.gestures)
        with tempfile.TemporaryDirectory() as folder:
            size = bundle.save(Path(folder, "network.plush")).stat().st_size
        return NetworkReader(bundle.network(), fitted.scaler, size)


@dataclass(frozen=True)
class NetworkReader:
    """A trained network, run by the NumPy engine that also reads a connected toy."""

    network: Network
    scaler: Scaler
    size_bytes: int

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        x = self.scaler.apply(windows.integers[:, :, windows.integers.shape[2] - self.network.arch.span :])
        return self.network.probabilities(x).astype(np.float32)


@dataclass(frozen=True)
class OnInputs:
    """A function that trains a program on some of the inputs of the windows."""

    fit: Fit
    inputs: tuple[str, ...]

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> Reader:
        return OnInputsReader(self.fit(train.only(self.inputs), validation.only(self.inputs)), self.inputs)


@dataclass(frozen=True)
class OnInputsReader:
    """A trained program that reads some of the inputs of the windows."""

    reader: Reader
    inputs: tuple[str, ...]

    @property
    def size_bytes(self) -> int:
        return self.reader.size_bytes

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        return self.reader(windows.only(self.inputs))


def chosen(models: str | Sequence[str]) -> tuple[str, ...]:
    """Return the programs in ``models`` in the order of `MODELS`.

    Args:
        models: names of `MODELS` and `SETS`, or recurrent networks with settings (see `parse_recurrent`); a text has
            commas.

    Raises:
        ConfigError: for an unknown name or setting; the message suggests the nearest one.
    """
    given = [m.strip() for m in models.split(",")] if isinstance(models, str) else list(models)
    names: set[str] = set()
    for one in given:
        if _kind(one) in RECURRENT:
            names.add(parse_recurrent(one).name)
        else:
            check_known(one, (*SETS, *MODELS), "model", ConfigError)
            names |= set(SETS.get(one, (one,)))
    return tuple(sorted(names, key=lambda name: (MODELS.index(_kind(name)), name)))


def _kind(model: str) -> str:
    """Return the name of a program without settings."""
    return model.partition(":")[0]


@dataclass(frozen=True)
class ComparisonSpec:
    """Which programs to compare under which splits.

    Attributes:
        splits: such as "leave-one-subject-out", "by-subject:5", "windows:5" (leaky); the gap between them is reported.
        models: names of `MODELS` and `SETS`, or such as "lstm:units=128:dropout=0.5" (see `chosen`).
        features: names of `FEATURES`, for the classical programs.
        pca: key of `PCA`, for the classical programs.
    """

    splits: Sequence[str] = SPLITS
    models: str | Sequence[str] = "all"
    features: Sequence[str] = DEFAULT_FEATURES
    pca: str = "both"

    def __post_init__(self) -> None:
        if self.pca not in PCA:
            raise ConfigError(
                f"Unknown choice '{self.pca}' for PCA: accepted are {', '.join(PCA)}.{nearest(self.pca, PCA)}"
            )

    def warn_of_long(self, warn: Warn) -> None:
        """Warn of each program that is left out because it takes too long."""
        names = chosen(self.models)
        for name, view, reduced in TOO_LONG:
            if name in names and view in self.features and reduced in PCA[self.pca]:
                how = "with" if reduced else "without"
                warn(f"left out: {BASELINES[name].title} on {view} windows {how} PCA, which takes too long")


def contenders(spec: ComparisonSpec, run: Run, windows: WindowSet, inputs: Sequence[str]) -> list[Contender]:
    """Return the requested programs for `compare`; all use the seed of ``run.training``.

    All read as many samples as our network; only it reads inputs that are not in ``inputs``.
    """
    arch = run.network
    models, training, samples = chosen(spec.models), run.training, arch.span
    made = classical([m for m in models if m in BASELINES], spec.features, PCA[spec.pca], samples, training.seed)
    recurrent_names = [m for m in models if _kind(m) in RECURRENT]
    if NETWORK in models or recurrent_names:
        need("torch", extra="train")
        from plushsense.training.fit import resolve_device

        training = resolve_device(training)
    vectors = [list(v) for v in windows.vectors]
    made += recurrent(recurrent_names, samples, training, vectors)
    if tuple(inputs) != windows.inputs:
        made = [replace(one, fit=OnInputs(one.fit, tuple(inputs))) for one in made]
    if NETWORK in models:
        key = {"arch": arch.to_dict(), "training": training.key(), "vectors": vectors}
        title = f"{arch.title} {arch.padding} (ours)"
        gestures = run.gestures
        network = NetworkFit(arch, training, run.dataset.layout, gestures)
        made.append(Contender(NETWORK, title, "windows", False, network, key, samples))
    return made


def baselines(
    dataset: Dataset | str | os.PathLike[str],
    config: RunConfig | None = None,
    spec: ComparisonSpec | None = None,
    *,
    out: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    cluster: str | None = None,
    progress: Progress | None = None,
    warn: Warn = python_warning,
    **settings: Any,
) -> BaselinesResult:
    """Compare classical programs, recurrent networks and our own network on the same windows, under several splits.

    Windows are cut as for the network, and every program reads the span that the network reads: ``window_s`` seconds or
    little less, and more if its receptive field is too long for that. Finished folds are kept in the data set's
    ``cache`` folder, so that a stopped comparison can be continued.

    Args:
        config, settings: as for `evaluate`; its split is not used.
        cluster: address of a Ray cluster that does the work instead of this machine's processes.
        out: a folder for the table as JSON and CSV, a page and a figure. If it holds a comparison of other settings or
            data, an error is raised unless ``overwrite``.
    """
    spec, dataset = spec or ComparisonSpec(), as_dataset(dataset)
    if (given := from_settings(config, **settings)).windows.context == ANYWHERE:
        raise ConfigError("Programs are compared on windows of gestures: choose the context stream or loop.")
    run = prepare(dataset, given, warn)
    inputs, dataset, identity = dataset.layout.inputs, run.dataset, comparison_id(run, spec)
    if out is not None:
        _require_reports()
        check_results(Path(out), "A comparison", TABLE, identity, replace=overwrite)
    windows = run.scored_windows(warn)
    spec.warn_of_long(warn)
    compared = compare(
        windows,
        contenders(spec, run, windows, inputs),
        spec.splits,
        spec=JobsSpec(run.evaluation.processes, journal=journal_of(dataset, "baselines"), cluster=cluster),
        seed=run.evaluation.seed,
        shared_rows=partial(copied_recordings, dataset, windows.recording_ids),
        progress=progress,
    )
    _warn_of_leaks(compared, warn)
    result = BaselinesResult(
        **vars(compared),
        dataset=dataset.head.name,
        dataset_hash=dataset.hash,
        simulated=dataset.head.simulated,
        preset=run.preset,
        training=run.training.to_dict(),
        window_s=run.windows.window_s,
        id=identity,
        machine=machine("one thread a program", f"Python {platform.python_version()}"),
        code_version=__version__,
    )
    if out is not None:
        with dataset.generation.writing():
            save_baselines(result, Path(out))
    return result


def _warn_of_leaks(compared: ComparisonResult, warn: Warn) -> None:
    """Warn of copies on both sides of a split that is not leaky anyway."""
    for split in compared.splits:
        if not split.leaky:
            warn_of_copies(split.leakage, warn)


def _require_reports() -> None:
    for library in ("matplotlib", "jinja2"):
        need(library, extra="reports")


def comparison_id(run: Run, spec: ComparisonSpec) -> str:
    """Return an identifier of 20 hexadecimal digits, equal for equal settings and data.

    Raises:
        ConfigError: for an unknown setting.
    """
    outcome: dict[str, object] = {key: value for key, value in run.outcome().items() if key != "evaluation"}
    outcome |= {"seed": run.evaluation.seed, "classes": run.evaluation.classes}
    outcome |= {"splits": [parse_split(text).text for text in spec.splits], "models": chosen(spec.models)}
    outcome |= {"features": list(spec.features), "pca": spec.pca}
    return job_id({"settings": outcome, "data": run.dataset.hash})


def save_baselines(result: BaselinesResult, out: Path) -> None:
    """Write the comparison to a folder: JSON, CSV with a row for each program and split, a page and the figure."""
    from plushsense.experiments.baselines.baselines_page import figure, page, score_table
    from plushsense.reports.figures import png

    out.mkdir(parents=True, exist_ok=True)
    write_file(out / SHEET, score_table(result).csv())
    (out / PICTURE).write_bytes(png(figure(result), dpi=130))
    write_file(out / PAGE, page(result))
    write_file(out / TABLE, json.dumps(result.to_json(), ensure_ascii=False, indent=1))
