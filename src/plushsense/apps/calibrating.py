"""A calibration for a bundle that has none: from the data set that it was trained on, and only its training people."""

from __future__ import annotations

import os
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.preparation import Warn, opened, silent, windows_for
from plushsense.core.errors import BundleError
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import Dataset
from plushsense.deploy.calibration import calibrated
from plushsense.deploy.quantize import refuse_undeployable
from plushsense.models.bundle import Bundle
from plushsense.windows.anywhere import AnywhereSpec
from plushsense.windows.cut import WindowSpec

# Splits that hold whole people back: their windows are told from the others by the person.
_BY_PERSON = "validation-subjects"


def calibrated_on(bundle: Bundle, dataset: Dataset | str | os.PathLike[str], warn: Warn = silent) -> Bundle:
    """The bundle with the ranges of its `training_windows`; one that was fine-tuned for its ranges keeps them.

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
    """The raw windows (N, C, T) of the people that a bundle was trained on, cut as its own were.

    Args:
        dataset: the one that it was trained on; warned of when its content is another by now.

    Raises:
        ArchError: for a network that cannot be deployed.
        BundleError: when the training windows cannot be told from those that were held back, or are not there.
    """
    refuse_undeployable(bundle.arch)
    dataset = opened(dataset)
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
