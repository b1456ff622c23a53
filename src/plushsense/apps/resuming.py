"""How far a single training is, kept while it runs: stopped or killed, it goes on from there."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense.apps.sweep_job import UNFINISHED
from plushsense.core.errors import PlushSenseError
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import windows_print
from plushsense.models.arch import Arch
from plushsense.runs.journal import Journal, job_id
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

if TYPE_CHECKING:
    from plushsense.training.state import FitState


# So long a training that was stopped can go on.
_KEPT_S = 30 * 24 * 3600.0


def unfinished(dataset: Dataset | str | os.PathLike[str]) -> Journal:
    """Where trainings on a data set keep how far they are: in its cache."""
    return Journal((dataset.path if isinstance(dataset, Dataset) else Path(dataset)).joinpath(*UNFINISHED))


class Kept:
    """How far one training is, in a journal, under all that its outcome depends on."""

    def __init__(
        self, journal: Journal | None, network: Arch, spec: TrainSpec, train: WindowSet, watched: WindowSet
    ) -> None:
        self._journal, self.before_s, self._began = journal, 0.0, time.monotonic()
        if journal is None:
            return
        from plushsense.training.fit import placed

        settings = {"arch": network.to_dict(), "training": placed(spec).key(), "vectors": train.vectors}
        # Most that was given up is never taken up again, and it was trained on people.
        journal.prune(_KEPT_S)
        prints = [windows_print(train), windows_print(watched)]
        self._job = job_id({"what": "training", **settings, "windows": prints})

    def found(self) -> FitState | None:
        held = None if self._journal is None else self._journal.find(self._job)
        if held is None:
            return None
        from plushsense.training.state import FitState

        self.before_s = float(held["seconds"])
        return FitState.from_arrays(held)

    def save(self, state: FitState) -> None:
        if self._journal is not None:
            spent = self.before_s + time.monotonic() - self._began
            # What cannot be kept (a full disk) costs time if it is stopped now; giving it up costs all of it.
            with suppress(PlushSenseError):
                self._journal.save(self._job, {**state.to_arrays(), "seconds": spent})

    def forget(self) -> None:
        if self._journal is not None:
            self._journal.discard(self._job)
