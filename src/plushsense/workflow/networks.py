"""Train the networks of one `plushsense.workflow.api.train`, which can be interrupted and resumed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.deploy.quantize import calibration
from plushsense.evaluation.crossval import windows_fingerprint
from plushsense.jobs.journal import Journal, job_id, keep_if_possible
from plushsense.models.arch import Arch
from plushsense.training.spec import EpochProgress, EpochRow, TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.workflow.preparation import Run, outside_streams

if TYPE_CHECKING:
    from plushsense.training.engine import FitState
    from plushsense.training.fit import FittedNetwork

# Age at which unfinished trainings are deleted: most are never resumed, and they contain data on people.
KEPT_S = 30 * 24 * 3600.0
_SAVE_EVERY_S = 0.5
REFIT = "training again, on everybody"
"""``what`` of the rows of a network that is trained again on everybody."""


class ResumableTraining:
    """The state of one training in a journal, under an id derived from everything that the outcome depends on."""

    def __init__(self, journal: Journal, network: Arch, spec: TrainSpec, train: WindowSet, watched: WindowSet) -> None:
        from plushsense.training.fit import resolve_device

        self._journal, self.before_s, self._began = journal, 0.0, time.monotonic()

        settings = {"arch": network.to_dict(), "training": resolve_device(spec).key(), "vectors": train.vectors}
        journal.prune(KEPT_S)
        fingerprints = [windows_fingerprint(train), windows_fingerprint(watched)]
        self._job = job_id({"what": "training", **settings, "windows": fingerprints})

    def load(self) -> FitState | None:
        """Return the saved state, or None."""
        entry = self._journal.find(self._job)
        if entry is None:
            return None
        from plushsense.training.engine import FitState

        self.before_s = float(entry["seconds"])
        return FitState.from_arrays(entry)

    def save(self, state: FitState) -> None:
        """Save the state; do nothing if the journal cannot be written."""
        spent = self.before_s + time.monotonic() - self._began
        keep_if_possible(self._journal, self._job, {**state.to_arrays(), "seconds": spent})

    def discard(self) -> None:
        """Delete the saved state."""
        self._journal.discard(self._job)


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network: the indices ``at`` of its windows, its fit, its ``weights``, and ``ranges`` for 8 bits.

    ``weights`` are those of the fit, or if ``tuned``, those after fine-tuning for 8 bits; ``ranges`` is the result of
    `plushsense.deploy.quantize.calibration`; ``seconds`` includes those before an interruption.
    """

    at: NDArray[np.int64]
    fitted: FittedNetwork
    weights: dict[str, NDArray[np.float32]]
    ranges: dict[str, Any]
    seconds: float
    tuned: bool


@dataclass(frozen=True)
class NetworkTrainer:
    """Trains networks of one kind on different windows of ``windows``.

    Attributes:
        by_people: whether nothing from the streams of people who are left out may be used.
        quantize_aware: epochs of fine-tuning for 8 bits.
        journal: stores unfinished trainings; None for none.
        progress: as for `fit`.
    """

    run: Run
    windows: WindowSet
    by_people: bool
    quantize_aware: int
    journal: Journal | None
    progress: EpochProgress
    _states: list[ResumableTraining] = field(default_factory=list)

    def train(
        self, at: NDArray[np.int64], watched: WindowSet, others: Sequence[str] = (), what: str = ""
    ) -> TrainedNetwork:
        """Train one network.

        Args:
            at: indices of its windows; watched: windows for validation; others: people who are left out.
            what: describes the network in the rows of ``progress``.
        """
        from plushsense.training.fit import fit

        run, spec, network = self.run, self.run.training, self.run.network

        def epoch_done(epoch: int, epochs: int, row: EpochRow) -> None:
            whole = ", ".join(name for name in (what, row.get("what")) if name)
            self.progress(epoch, epochs, {**row, "what": whole} if whole else row)

        if self.by_people:
            # Decisions are fitted on whole streams of the others, which may contain recordings at rest.
            at = at[outside_streams(self.windows, run.dataset, others)[at]]
        train_on = self.windows.take(at)
        state = None if self.journal is None else ResumableTraining(self.journal, network, spec, train_on, watched)
        self._states.extend([state] if state else [])
        start = state.load() if state else None
        for row in start.history if start is not None else ():
            epoch_done(row["epoch"], spec.epochs, row)
        fitted = fit(
            train_on, watched, network, spec, epoch_done,
            start=start, save=state.save if state else None, save_every_s=_SAVE_EVERY_S,
        )  # fmt: skip
        weights = fitted.weights
        ranges = calibration(network, weights, fitted.scaler, self.windows.integers[at])
        if self.quantize_aware:
            from plushsense.training.quantized import fine_tune

            tuned = fine_tune(train_on, network, weights, fitted.scaler, ranges, spec, self.quantize_aware, epoch_done)
            weights = tuned.weights
        seconds = fitted.seconds + (state.before_s if state else 0.0)
        return TrainedNetwork(at, fitted, weights, ranges, seconds, self.quantize_aware > 0)

    def discard(self) -> None:
        """Delete the stored states of all these trainings."""
        for state in self._states:
            state.discard()
