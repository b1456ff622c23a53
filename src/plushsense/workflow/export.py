"""Calibrate a bundle on its training data, and export it, or a patch of an export; save windows for MATLAB."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, BundleError, ConfigError, python_warning
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Message
from plushsense.dataset.importing.saved_windows import SETS, SIMULATED
from plushsense.dataset.index import as_dataset
from plushsense.dataset.readings import Readings
from plushsense.dataset.store import Dataset
from plushsense.deploy.code import IMAGE, check_names, read_facts
from plushsense.deploy.convert import check_format
from plushsense.deploy.convert.matlab import cells, mat_bytes
from plushsense.deploy.package import ExportResult, emit
from plushsense.deploy.quantize import calibrated, integer_model, refuse_undeployable
from plushsense.evaluation.crossval import fold_windows
from plushsense.models.bundle import Bundle, is_training_content
from plushsense.runtime.image import image_check, patch_bytes, refuse_image
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSpec
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import (
    WHOLE_PEOPLE,
    Warn,
    prepare,
    silent,
    windows_for,
)

_TRIED = 512  # maximum of windows on which a conversion is compared with the network


def calibrated_on(bundle: Bundle, dataset: Dataset | str | os.PathLike[str], warn: Warn = silent) -> Bundle:
    """Return the bundle calibrated on its `training_windows`, with the readings of the training people.

    A fine-tuned bundle keeps its calibration.

    Raises:
        ArchError, BundleError: as for `training_windows`.
    """
    refuse_undeployable(bundle.arch)
    dataset, people = as_dataset(dataset).with_inputs(bundle.layout), bundle.provenance.get("subjects")
    if bundle.readings is None and isinstance(people, list) and dataset.layout.reads_as(bundle.layout):
        bundle = replace(bundle, readings=Readings.of(dataset, people))
    if bundle.calibration and bundle.provenance.get("quantize_aware"):
        warn(Message("the bundle was fine-tuned for its own calibration, which is kept"))
        return bundle
    return calibrated(bundle, training_windows(bundle, dataset, warn))


def training_windows(
    bundle: Bundle, dataset: Dataset | str | os.PathLike[str], warn: Warn = silent
) -> NDArray[np.int32]:
    """Cut the integer windows (N, C, T) of the people on whom a bundle was trained, with the settings of the training.

    ``warn`` is called if the content of the data set has changed since then.

    Raises:
        ArchError: for a network that cannot be deployed.
        BundleError: if the training windows are missing, or cannot be distinguished from the validation windows.
    """
    refuse_undeployable(bundle.arch)
    dataset = as_dataset(dataset).with_inputs(bundle.layout).with_gestures(bundle.gestures)
    origin = bundle.provenance
    if isinstance(origin.get("subjects"), int):
        raise BundleError(
            "The bundle belongs to an export and does not name its training people, which calibration needs: give "
            "the bundle that plushsense train wrote."
        )
    # Windows of `NOBODY` are used both for training and for validation.
    people = {str(s) for s in origin.get("subjects", ())} - {NOBODY}
    if origin.get("split") != WHOLE_PEOPLE or not people:
        raise BundleError(
            "The bundle does not name the people of its training windows (split '{split}'), which calibration needs: "
            "train it again.",
            split=origin.get("split", "unknown"),
        )
    if dataset.layout.inputs != bundle.layout.inputs or dataset.layout.period_us != bundle.layout.period_us:
        raise BundleError(
            "The data set '{name}' has the layout '{layout}', the bundle '{bundle_layout}': give the data set that "
            "it was trained on.",
            name=dataset.head.name,
            layout=dataset.layout.name,
            bundle_layout=bundle.layout.name,
        )
    if not is_training_content(bundle, dataset):
        warn(
            Message(
                "'{name}' has changed since the training of the bundle: its present content is used",
                name=dataset.head.name,
            )
        )
    # Keys of earlier versions are left out.
    tables = (bundle.windowing, WindowSpec), (bundle.windowing.get("anywhere", {}), AnywhereSpec)
    known = [{f.name: table[f.name] for f in fields(kind) if f.name in table} for table, kind in tables]
    spec, anywhere = WindowSpec(**known[0]), AnywhereSpec(**known[1])
    windows = windows_for(dataset, bundle.arch, spec, bundle.gestures, warn, anywhere)
    at = np.flatnonzero(np.isin(windows.subject, sorted(people)))
    if not len(at):
        raise BundleError(
            "The data set '{name}' has no window of the {n:person} the bundle was trained on: give the data set that "
            "it was trained on.",
            name=dataset.head.name,
            n=len(people),
        )
    missing = sorted(people - set(windows.subject[at].tolist()))
    if missing:
        warn(Message("no longer in '{name}': {people}", name=dataset.head.name, people=", ".join(missing)))
    return windows.integers[at]


@dataclass(frozen=True)
class PackageNames:
    """What an export is called.

    Attributes:
        name: prefix of all names in the C code, its files and packages, so that several exports link into one program.
        model_version: version of the model, for the manifests and the C code; by default that in the bundle, or that
            of PlushSense.
        url: web page of the model, for the manifests; by default an address that leads nowhere.
    """

    name: str = ""
    model_version: str = ""
    url: str = ""


def export(
    bundle: Bundle | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    dataset: Dataset | str | os.PathLike[str] | None = None,
    also: Sequence[str] = (),
    package: PackageNames | None = None,
    warn: Warn = python_warning,
) -> ExportResult:
    """Write the files that a toy needs to run a bundle's network: C99, the model as data, golden vectors, packages.

    Args:
        bundle: a bundle with the padding ``stream``, and batch normalisation or none.
        out: a new or empty folder.
        dataset: the data set of the training, to calibrate on; required if the bundle has no calibration.
        also: formats for other runtimes (`plushsense.deploy.convert.CONVERTERS`), such as ``onnx``.
        package: what the code and the packages are called.
        warn: called with a sentence for everything unusual.

    Raises:
        ArchError: for a network that has no C; the message suggests the nearest one that has.
        BundleError: for a bundle without calibration, or a conversion whose output differs from the network's.
        ConfigError, MissingExtraError: for an unknown format, or one whose package is not installed; for a name,
            version or address that is not accepted.
        BadInput: for a folder that is not empty.
    """
    package = package or PackageNames()
    check_names(package.name, url=package.url, model_version=package.model_version)
    for other in also:
        check_format(other)
    given = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    refuse_image(given.arch)
    windows = None
    if dataset is not None:
        dataset = as_dataset(dataset)
        if also:
            windows = training_windows(given, dataset, warn)
            windows = windows[:: -(-len(windows) // _TRIED)]
        given = calibrated_on(given, dataset, warn if windows is None else silent)
    if package.model_version:
        given = replace(given, provenance=given.provenance | {"model_version": package.model_version})
    names = {"name": package.name, "url": package.url}
    done = emit(integer_model(given), given, Path(out), **names, also=also, windows=windows)
    if done.page_note:
        warn(done.page_note)
    return done


@dataclass(frozen=True)
class SavedWindows:
    """Result of `save_windows`: the file, its size, and the number of windows in each set."""

    path: Path
    bytes: int
    windows: dict[str, int]

    def to_json(self) -> dict[str, object]:
        """Return the object that ``plushsense evaluate --save-windows --json`` prints."""
        return {"file": str(self.path), "bytes": self.bytes, "windows": self.windows}


def save_windows(
    dataset: Dataset | str | os.PathLike[str],
    path: str | os.PathLike[str],
    config: RunConfig | None = None,
    *,
    overwrite: bool = False,
    warn: Warn = python_warning,
    **settings: Any,
) -> SavedWindows:
    """Write the windows that `api.evaluate` would score, with their labels and sets, as a MATLAB file.

    The variables are those of the authors' ``plush_train_data_5621.mat``: cell arrays ``traindata``, ``valdata`` and
    ``testdata`` of windows (T, C) in the units of the layout, ``trainlabels`` and so on, and the classes ``c``; beside
    them ``trainrecordings`` and so on (ids, which begin with the person), and ``simulated``.

    Args:
        config, settings: as for `api.evaluate`; the split must have one fold, as "windows:file-order" has.
        overwrite: replace an existing file.

    Raises:
        ConfigError: for a split with several folds, a file that does not end in .mat, or one that exists already.
        BadInput: for a split that cannot be made, or a file that cannot be written.
        MissingExtraError: if SciPy is not installed.
    """
    path = Path(path)
    if path.suffix != ".mat":
        raise ConfigError(f"'{path}' is no name of a MATLAB file: give one that ends in .mat.")
    if path.exists() and not overwrite:
        raise ConfigError(f"'{path}' exists already: give the name of a new file, or replace it with --force.")
    run = prepare(dataset, from_settings(config, **settings), warn)
    windows = run.scored_windows(warn)
    folds = fold_windows(windows, windows, run.split, run.evaluation.seed)
    if len(folds) > 1:
        raise ConfigError(
            f"The split '{run.split.text}' has {len(folds)} folds, and a file of windows one: give windows:file-order, "
            "windows:holdout, recordings:holdout, recordings:random or saved."
        )
    values = windows.x.astype(np.float64)
    variables: dict[str, Any] = {"c": cells(windows.labels), SIMULATED: run.dataset.head.simulated}
    sizes = {}
    for name, data, labels in SETS:
        mine = getattr(folds[0], name)
        sizes[name] = len(mine)
        if len(mine):
            variables[data] = cells([values[at].T for at in mine])
            variables[labels] = cells([windows.labels[windows.y[at]] for at in mine])
            ids = [windows.recording_ids[windows.recording[at]] for at in mine]
            variables[labels.replace("labels", "recordings")] = cells(ids)
    content = mat_bytes(variables)
    try:
        with run.dataset.generation.writing():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, content)
    except OSError as cause:
        raise BadInput(f"'{path}' cannot be written ({cause}): choose another path.") from None
    return SavedWindows(path, len(content), sizes)


@dataclass(frozen=True)
class PatchResult:
    """Result of `export_patch`: the file, its size, and the CRC-32 of the image to which the patch belongs."""

    path: Path
    bytes: int
    image_check: int

    def to_json(self) -> dict[str, object]:
        """Return the object that ``plushsense export --patch-for --json`` prints."""
        return {"patch": str(self.path), "bytes": self.bytes, "image_check": self.image_check}


def export_patch(
    bundle: Bundle | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    export: str | os.PathLike[str],
    dataset: Dataset | str | os.PathLike[str] | None = None,
    warn: Warn = python_warning,
) -> PatchResult:
    """Write the dense layer of an adapted bundle as a patch for a toy that runs an export of the same network.

    Args:
        bundle: a bundle that was adapted to a person.
        out: a file that does not exist yet.
        export: folder of the export that the toy runs.
        dataset: the data set of the training, to calibrate on; for an export that was made with it.
        warn: called with a sentence for everything unusual.

    Raises:
        BundleError: for a bundle that was not adapted, or of another network than the export.
        BadInput: if the folder is no export, or ``out`` exists or cannot be written.
        ArchError: for a network that cannot be deployed.
    """
    given = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    out, folder = Path(out), Path(export)
    if out.exists():
        raise BadInput(f"'{out}' is already there: nothing is overwritten, give another file.")
    read_facts(folder)
    try:
        original = (folder / IMAGE).read_bytes()
    except OSError as cause:
        raise BadInput(f"'{folder / IMAGE}' cannot be read ({cause}): export the model again.") from None
    if not given.personal:
        raise BundleError(
            "The bundle was not adapted to anybody, so there is nothing to patch: give one that plushsense adapt wrote."
        )
    if dataset is not None:
        given = calibrated_on(given, dataset, warn)
    patch = patch_bytes(original, integer_model(given))
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_file(out, patch)
    except OSError as cause:
        raise BadInput(f"The patch '{out}' cannot be written ({cause}): choose another place.") from None
    return PatchResult(out, len(patch), image_check(original))
