"""Train the networks of one `plushsense.workflow.api.train`, which can be interrupted and resumed."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.deploy.quantize import calibration
from plushsense.evaluation.crossval import windows_fingerprint
from plushsense.jobs.journal import Journal, job_id, keep_if_possible
from plushsense.models.reference import divide_logits
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


@dataclass(frozen=True)
class TrainedNetwork:
    """A trained network: the indices ``at`` of its windows, its fit, its ``weights``, and ``ranges`` for 8 bits.

    ``weights`` are those of the fit, or if ``tuned``, those after fine-tuning for 8 bits, with the temperature;
    ``ranges`` is the result of `plushsense.deploy.quantize.calibration`; ``seconds`` includes those before an
    interruption.
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
        temperature: number that divides the logits of every network.
        journal: stores unfinished trainings, each under an id of all that its outcome depends on; None for none.
        progress: as for `fit`.
    """

    run: Run
    windows: WindowSet
    by_people: bool
    quantize_aware: int
    temperature: float
    journal: Journal | None
    progress: EpochProgress
    _stored: list[str] = field(default_factory=list)

    def train(
        self,
        at: NDArray[np.int64],
        watched: WindowSet,
        others: Sequence[str] = (),
        start: TrainedNetwork | None = None,
    ) -> TrainedNetwork:
        """Train one network.

        Args:
            at: indices of its windows; watched: windows for validation; others: people who are left out.
            start: network to train further (see `TrainSpec.continued`); the rows of ``progress`` then have `REFIT`.
        """
        from plushsense.training.engine import FitState
        from plushsense.training.fit import StoreSpec, fit

        network, journal, began = self.run.network, self.journal, time.monotonic()
        spec = self.run.training if start is None else self.run.training.continued()
        initial, what = (None, "") if start is None else (start.fitted.weights, REFIT)

        def epoch_done(epoch: int, epochs: int, row: EpochRow) -> None:
            whole = ", ".join(name for name in (what, row.get("what")) if name)
            self.progress(epoch, epochs, {**row, "what": whole} if whole else row)

        if self.by_people:
            # Decisions are fitted on whole streams of the others, which may contain recordings at rest.
            at = at[outside_streams(self.windows, self.run.dataset, others)[at]]
        train_on = self.windows.take(at)
        store, before_s = StoreSpec(initial=initial), 0.0
        if journal is not None:
            job = self._job(train_on, watched, spec, initial)
            journal.prune(KEPT_S)
            self._stored.append(job)
            entry = journal.find(job) or {}
            before_s = float(entry.get("seconds", 0.0))

            def save(state: FitState) -> None:
                seconds = before_s + time.monotonic() - began
                keep_if_possible(journal, job, {**state.to_arrays(), "seconds": seconds})

            state = FitState.from_arrays(entry) if entry else None
            for row in state.history if state is not None else ():
                epoch_done(row["epoch"], spec.epochs, row)
            store = StoreSpec(state, save=save, save_every_s=_SAVE_EVERY_S, initial=initial)
        fitted = fit(train_on, watched, network, spec, epoch_done, store)
        weights = fitted.weights
        ranges = calibration(network, weights, fitted.scaler, self.windows.integers[at])
        if self.quantize_aware:
            from plushsense.training.quantized import fine_tune

            weights = fine_tune(train_on, network, fitted, ranges, spec, self.quantize_aware, epoch_done)
        weights = divide_logits(weights, self.temperature)
        return TrainedNetwork(at, fitted, weights, ranges, fitted.seconds + before_s, self.quantize_aware > 0)

    def _job(
        self, train: WindowSet, watched: WindowSet, spec: TrainSpec, initial: dict[str, NDArray[np.float32]] | None
    ) -> str:
        from plushsense.training.fit import resolve_device

        settings: dict[str, Any] = {"arch": self.run.network.to_dict(), "training": resolve_device(spec).key()}
        if initial is not None:
            settings["initial"] = hashlib.sha256(b"".join(w.tobytes() for w in initial.values())).hexdigest()
        fingerprints = [windows_fingerprint(train), windows_fingerprint(watched)]
        return job_id({"what": "training", **settings, "vectors": train.vectors, "windows": fingerprints})

    def discard(self) -> None:
        """Delete the stored states of all these trainings."""
        if self.journal is not None:
            for job in self._stored:
                self.journal.discard(job)
