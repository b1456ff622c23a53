"""A bundle becomes a folder for the toy: quantized, printed as C, with golden vectors and packages."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from plushsense.apps.calibrating import calibrated_on, training_windows
from plushsense.apps.preparation import Warn, opened, silent
from plushsense.dataset.store import Dataset
from plushsense.deploy.calibration import integer_model
from plushsense.deploy.convert import CONVERTERS, check_format, convert
from plushsense.deploy.emit import Exported, emit, without_people
from plushsense.deploy.package import package
from plushsense.models.bundle import Bundle

_TRIED = 512  # windows


def export(
    bundle: Bundle | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    dataset: Dataset | str | os.PathLike[str] | None = None,
    also: Sequence[str] = (),
    warn: Warn = silent,
) -> Exported:
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
        dataset = opened(dataset)
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
