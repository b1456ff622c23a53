"""A calibration for a bundle that has none: from the data set that it was trained on, and only its training people."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BundleError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.deploy.convert import CONVERTERS, check_format, convert
from plushsense.deploy.emit import ExportResult, emit, without_people
from plushsense.deploy.package import package
from plushsense.deploy.quantize import calibrated, integer_model, refuse_undeployable
from plushsense.models.bundle import Bundle
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSpec
from plushsense.workflow.preparation import Warn, silent, windows_for

if TYPE_CHECKING:
    from plushsense.models.bundle import Bundle
    from plushsense.runtime.classifier import StreamReader
    from plushsense.runtime.decisions import DecideSpec


# Splits that hold whole people back: their windows are told from the others by the person.
_BY_PERSON = "validation-subjects"


def calibrated_on(bundle: Bundle, dataset: Dataset | str | os.PathLike[str], warn: Warn = silent) -> Bundle:
    """Return the bundle with the value ranges of its `training_windows`; a fine-tuned bundle keeps its own.

    Raises:
        ArchError, BundleError: as `training_windows`.
    """
    refuse_undeployable(bundle.arch)
    if bundle.calibration and bundle.provenance.get("quantize_aware"):
        warn("the bundle was fine-tuned for the calibration that it holds, so that it keeps it")
        return bundle
    return calibrated(bundle, training_windows(bundle, dataset, warn))


def training_windows(
    bundle: Bundle, dataset: Dataset | str | os.PathLike[str], warn: Warn = silent
) -> NDArray[np.int32]:
    """Cut the raw windows (N, C, T) of the people that a bundle was trained on, as its training did.

    Args:
        dataset: the one that it was trained on; warned of when its content is another by now.

    Raises:
        ArchError: for a network that cannot be deployed.
        BundleError: when the training windows cannot be told from those that were held back, or are not there.
    """
    refuse_undeployable(bundle.arch)
    dataset = as_dataset(dataset)
    origin = bundle.provenance
    # Nobody's windows stand in every fold, held-back ones too.
    if isinstance(origin.get("subjects"), int):
        raise BundleError(
            "The bundle belongs to an export and does not say who it was trained on, so that people held back could "
            "slip in: give the bundle that plushsense train wrote."
        )
    people = {str(s) for s in origin.get("subjects", ())} - {NOBODY}
    if origin.get("split") != _BY_PERSON or not people:
        raise BundleError(
            "The bundle does not say which people its training windows came from "
            f"(split '{origin.get('split', 'unknown')}'), so that held-back ones could slip in: train it again."
        )
    if dataset.layout.inputs != bundle.layout.inputs or dataset.layout.period_us != bundle.layout.period_us:
        raise BundleError(
            f"The data set '{dataset.head.name}' has the layout '{dataset.layout.name}', the bundle "
            f"'{bundle.layout.name}': give the data set that it was trained on."
        )
    if origin.get("dataset_hash") != dataset.hash:
        warn(f"'{dataset.head.name}' has not the content that the bundle was trained on: the ranges are of what it has")
    known = {field.name for field in fields(WindowSpec)}
    spec = WindowSpec(**{k: v for k, v in bundle.windowing.items() if k in known})
    anywhere = AnywhereSpec(**bundle.windowing.get("anywhere", {}))
    windows = windows_for(dataset, bundle.arch, spec, bundle.gestures, warn, anywhere)
    mine = np.flatnonzero(np.isin(windows.subject, sorted(people)))
    if not len(mine):
        raise BundleError(
            f"The data set '{dataset.head.name}' holds no window of the {len(people)} people the bundle was trained "
            "on: give the data set that it was trained on."
        )
    missing = sorted(people - set(windows.subject[mine].tolist()))
    if missing:
        warn(f"not in '{dataset.head.name}' any more: {', '.join(missing)}")
    return windows.x[mine]


_TRIED = 512  # windows


def export(
    bundle: Bundle | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    dataset: Dataset | str | os.PathLike[str] | None = None,
    also: Sequence[str] = (),
    warn: Warn = silent,
) -> ExportResult:
    """Write what a toy needs to run a bundle's network: C99, the model as data, golden vectors, packages.

    Args:
        bundle: with ``stream`` padding and batch normalisation.
        out: a folder that does not exist yet, or is empty.
        dataset: the one that the bundle was trained on; calibrates anew, or for the first time where the bundle
            holds no calibration.
        also: formats for other runtimes (`plushsense.deploy.convert.CONVERTERS`), as ``onnx``.
        warn: told what may matter.

    Raises:
        ArchError: for a network that has no meaning in the toy, with the nearest that has.
        BundleError: for a bundle without calibration, and a conversion that does not give the network's answers.
        ConfigError, MissingExtraError: for an unknown format, and one whose package is not installed.
        BadInput: for a folder that is taken.
    """
    given = bundle if isinstance(bundle, Bundle) else Bundle.load(Path(bundle))
    windows = None
    if dataset is not None:
        dataset = as_dataset(dataset)
        windows = training_windows(given, dataset, warn) if also else None
        # Some tell as much to a converter, which tries them one by one.
        windows = None if windows is None else windows[:: -(-len(windows) // _TRIED)]
        given = calibrated_on(given, dataset, warn if windows is None else silent)
    model = integer_model(given)
    given = replace(given, provenance=without_people(given.provenance))

    def converted(folder: Path, facts: dict[str, Any]) -> None:
        for name in dict.fromkeys(also):
            done = convert(given, folder / CONVERTERS[name].file_name, name, windows=windows)
            facts.setdefault("conversions", {})[name] = {
                "file": done.path.name,
                "bytes": done.bytes,
                "largest_difference": done.largest_difference,
                "notes": list(done.notes),
            }

    for name in also:
        check_format(name)
    return emit(model, given, Path(out), extras=[converted, package])


ENGINES = ("float", "int8", "both")


def classifier_of(bundle: Bundle, decide: DecideSpec | None, engine: str) -> StreamReader:
    """Build the stream classifier of a bundle; ``engine`` is one of `ENGINES`.

    Raises:
        BundleError: for ``int8`` and ``both``, where the network cannot be deployed.
    """
    from plushsense.deploy.quantize import integer_model
    from plushsense.runtime.classifier import BothEngines, IntegerClassifier, StreamClassifier

    if engine == "float":
        return StreamClassifier(bundle, decide)
    model = integer_model(bundle, decide)
    return IntegerClassifier(model) if engine == "int8" else BothEngines(model, StreamClassifier(bundle, decide))
