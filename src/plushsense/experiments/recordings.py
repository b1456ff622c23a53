"""Open what an experiment is run on: a data set, or the folder that a recorder left."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from plushsense.core.files import temporary_folder
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import Layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import HEAD, Dataset


@contextmanager
def opened(
    source: Dataset | str | os.PathLike[str], layout: Layout | None = None, gestures: GestureSet | None = None
) -> Iterator[Dataset]:
    """Open a data set, or import a recorder's folder as a temporary one, which is gone after the context.

    Such a folder gets ``layout`` and ``gestures``; by default those that its files and labels suggest.
    """
    if isinstance(source, Dataset) or not Path(source).is_dir() or (Path(source) / HEAD).is_file():
        yield as_dataset(source)
        return
    folder, name = Path(source), Path(source).resolve().name
    with temporary_folder() as place:
        yield import_recordings(
            folder, place / "DS", layout=layout, gestures=gestures, name=name, adopt_proposals=False
        ).dataset
