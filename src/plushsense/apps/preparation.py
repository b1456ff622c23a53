"""From a data set to what a network is trained on: which gestures, which windows."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.config import ALL, SHARED
from plushsense.core.errors import DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.dataset.index import open_dataset
from plushsense.dataset.store import Dataset
from plushsense.models.arch import Arch
from plushsense.windows.anywhere import AnywhereSpec, cut_anywhere, with_idle
from plushsense.windows.cut import ANYWHERE, WindowSet, WindowSpec, cut_windows, shared_gestures

Warn = Callable[[str], None]


def silent(_: str) -> None:
    """Where warnings go that nobody asked for."""


def choose_classes(dataset: Dataset, wanted: str | Sequence[str], warn: Warn = silent) -> GestureSet:
    """The classes to tell apart: "shared", "all", or labels (a list, or text with commas)."""
    if wanted == SHARED:
        gestures, left_out = shared_gestures(dataset)
        if left_out:
            reasons = "; ".join(f"{label} ({why})" for label, why in left_out.items())
            warn(f"left out of the shared gestures: {reasons}")
    elif wanted == ALL:
        made = {r.gesture for r in dataset.used}
        gestures = dataset.gestures.subset([g for g in dataset.gestures.labels if g in made])
    else:
        labels = wanted.split(",") if isinstance(wanted, str) else wanted
        gestures = dataset.gestures.subset([label.strip() for label in labels])
    if len(gestures) < 2:
        raise DatasetError(
            f"Only {len(gestures)} gesture is left to tell apart ({', '.join(gestures.labels) or 'none'}): "
            "choose others with --classes all or --classes LABEL,LABEL."
        )
    return gestures


def classes_for(dataset: Dataset, wanted: str | Sequence[str], context: str, warn: Warn = silent) -> GestureSet:
    """The classes that were asked for, and one for idleness where it is trained anywhere in a stream."""
    gestures = choose_classes(dataset, wanted, warn)
    if context != ANYWHERE:
        return gestures
    with_one = with_idle(gestures, dataset)
    if added := [g.label for g in with_one.gestures if g not in gestures.gestures]:
        warn(f"added a class for what happens between gestures: {added[0]}")
    return with_one


def windows_for(
    dataset: Dataset,
    arch: Arch,
    spec: WindowSpec,
    gestures: GestureSet,
    warn: Warn = silent,
    anywhere: AnywhereSpec | None = None,
) -> WindowSet:
    """Windows as ``arch`` needs them: with as much past as a decision sees."""
    span_s = arch.span / dataset.layout.rate_hz
    spec = replace(spec, span_s=span_s if span_s > spec.window_s else 0.0)
    if spec.context == ANYWHERE:
        cut = cut_anywhere(dataset, spec, gestures, anywhere)
    else:
        cut = cut_windows(dataset, spec, gestures)
    for line in cut.left_out:
        warn(f"left out: {line}")
    return cut


def outside_streams(windows: WindowSet, dataset: Dataset, people: Collection[str]) -> NDArray[np.bool_]:
    """Which windows lie in no stream of ``people``, (N,).

    The toy at rest is nobody's and trains in every fold, but somebody may have recorded it within a session; whoever
    is heard as a whole stream must not have given any of it.
    """
    theirs = [s.id for s in dataset.streams if s.subject in people]
    return ~np.isin(windows.stream, np.array(theirs, dtype=np.str_))


def opened(dataset: Dataset | str | os.PathLike[str]) -> Dataset:
    """The data set itself, or the one at a path."""
    return dataset if isinstance(dataset, Dataset) else open_dataset(Path(dataset))
