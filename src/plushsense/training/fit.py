"""Train one network: from windows to weights, scaling and history."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DivergedError, TrainingError
from plushsense.models.arch import Arch
from plushsense.models.net import Net
from plushsense.scoring.metrics import accuracy_over_people
from plushsense.training.augment import Channels, augmentations
from plushsense.training.engine import (
    Adam,
    Engine,
    FitState,
    Windows,
    engine,
    is_fast,
    repeatable,
    slices,
    torch_threads,
)
from plushsense.training.spec import EpochProgress, EpochRow, TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler

import torch  # isort: skip - after models.net, which says how to install it
from torch import Tensor
from torch.nn import functional as F

Weights = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class FittedNetwork:
    """A trained network.

    Attributes:
        weights: arrays by name, for `plushsense.models.reference.Network`.
        history: a row for each epoch: epoch (from 1), train_loss and train_accuracy (means over the batches, measured
            while training), validation_loss and validation_accuracy (None without validation) over all windows,
            validation_accuracy_people (see `accuracy_over_people`), learning_rate.
        best_epoch: the epoch of ``weights``.
        kept: weights after each epoch in `StoreSpec.keep`.
        state: state to continue the training from; None with early stopping.
    """

    weights: dict[str, NDArray[np.float32]]
    scaler: Scaler
    history: list[EpochRow]
    best_epoch: int
    seconds: float
    kept: dict[int, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    state: FitState | None = None


@dataclass(frozen=True)
class StoreSpec:
    """What of a training is stored, and what it begins with.

    Attributes:
        start: state to continue from, with the same windows and settings but more epochs; the result is bit for bit
            that of an uninterrupted training.
        keep: epochs after which a copy of the weights is stored. With a constant learning rate, these equal the weights
            of trainings with fewer epochs.
        save: called with the state every ``save_every_s`` seconds.
        initial: weights to begin with, as of the same network trained on fewer people; None: drawn by the seed.
    """

    start: FitState | None = None
    keep: Collection[int] = ()
    save: Callable[[FitState], None] | None = None
    save_every_s: float = 60.0
    initial: Weights | None = None


def fit(
    train: WindowSet,
    validation: WindowSet | None,
    arch: Arch,
    spec: TrainSpec,
    progress: EpochProgress | None = None,
    store: StoreSpec | None = None,
    weights: NDArray[np.float64] | None = None,
) -> FittedNetwork:
    """Train a network; the same seed gives the same weights.

    Args:
        train: windows to train on.
        validation: windows that decide when to stop; None or empty: train all epochs.
        weights: how often each window of ``train`` counts in an epoch, (N,). Whole numbers give the same network as
            windows that are repeated; of fractions, each epoch draws whether the window counts once more.

    Raises:
        TrainingError: when the windows do not fit the network, or the loss is no longer a number.
    """
    began = saved = time.perf_counter()
    store = store or StoreSpec()
    validation = validation if validation is not None and len(validation) else None
    _check(train, arch, "train on")
    _check(validation, arch, "validate on")
    device, scaler = _device(spec.device), _scaler(train, arch, spec, weights)
    data = _tensors(train, scaler, arch, device)
    val_data = None if validation is None else _tensors(validation, scaler, arch, device)
    # The fast engine starts its own threads, in each of which PyTorch uses one.
    threads = 1 if is_fast(arch, device) else spec.threads
    with torch.random.fork_rng(devices=[]), repeatable(allow_tf32=True), torch_threads(threads):
        channels = Channels(train.vectors, scaler, device, arch.vector is not None)
        most = len(train) if weights is None else int(np.ceil(weights.sum()))
        training = _Training(arch, spec, channels, most, val_data is not None, store)
        with closing(training.net):
            for epoch in range(len(training.history) + 1, spec.epochs + 1):
                rate = spec.learning_rate_at(epoch)
                loss, accuracy = training.train(rate, *data, weights)
                row: EpochRow = {"epoch": epoch, "train_loss": loss, "train_accuracy": accuracy}
                _measure(row, training.net, val_data, validation)
                row["learning_rate"] = rate
                _refuse_not_finite(row, spec)
                training.history.append(row)
                if epoch in store.keep:
                    training.kept[epoch] = training.net.export_weights()
                if progress is not None:
                    progress(epoch, spec.epochs, row)
                if training.is_over(row):
                    break
                if store.save is not None and time.perf_counter() - saved >= store.save_every_s:
                    store.save(training.state())
                    saved = time.perf_counter()
            return training.finished(scaler, time.perf_counter() - began)


def _scaler(train: WindowSet, arch: Arch, spec: TrainSpec, weights: NDArray[np.float64] | None) -> Scaler:
    """Return the scaling of the inputs, fitted to the training windows as often as they count."""
    vectors = train.vectors if arch.vector is not None else ()
    if spec.scaling == "none":
        return Scaler.none(train.units, vectors)
    return Scaler.fit(train.integers if weights is None else train.integers[repeated(weights)], vectors)


class _Training:
    """A training under way: the network, its optimiser, the order of the windows, and what is kept of the epochs.

    Args:
        most: largest number of windows in an epoch.
        validated: whether there are windows for early stopping.
        store: weights or state to begin with.
    """

    def __init__(
        self, arch: Arch, spec: TrainSpec, channels: Channels, most: int, validated: bool, store: StoreSpec
    ) -> None:
        self._spec, self._stops, start = spec, validated and spec.patience is not None, store.start
        if start is not None and self._stops and not start.best:
            raise TrainingError(
                "A training with early stopping cannot go on from a state that holds no best weights: leave patience "
                "out."
            )
        torch.manual_seed(spec.seed)
        net = Net(arch)
        if (weights := store.initial if start is None else start.weights) is not None:
            net.import_weights(weights)
        self.net = engine(arch, net, channels.device, min(spec.batch, most), spec.threads, spec.stride)
        self._order = torch.Generator().manual_seed(spec.seed)
        self._augment = augmentations(spec.augment, channels)
        self._adam = Adam(self.net.parameters, fused=True, weight_decay=spec.weight_decay, decayed=self.net.decayed)
        self.history: list[EpochRow] = []
        self.kept: dict[int, Weights] = {}
        self._best_epoch, self._best_score, self._best = 0, float("-inf"), self.net.export_weights()
        if start is None:
            return
        self._adam.restore(
            start.steps, *([torch.from_numpy(m.copy()) for m in ms] for ms in (start.means, start.squares))
        )
        self._order.set_state(torch.from_numpy(start.random.copy()))
        self.history = [row.copy() for row in start.history]
        self.kept = {epoch: dict(weights) for epoch, weights in start.kept.items()}
        if self._stops:
            scores = [self._score(row) for row in self.history]
            self._best_epoch, self._best_score = int(np.argmax(scores)) + 1, max(scores)
            self._best = dict(start.best)

    def train(self, rate: float, x: Windows, y: Tensor, weights: NDArray[np.float64] | None) -> tuple[float, float]:
        """Train one epoch at a learning rate; return mean loss and accuracy over its batches."""
        # Sum on the device: reading a number from a GPU in every batch would make the CPU wait.
        sums, n_windows = torch.zeros(2, device=y.device), 0
        if weights is None:
            shuffled = torch.randperm(len(x), generator=self._order)
        else:
            # Whole numbers draw nothing, so that the order is that of windows that are repeated.
            offset = 0.5 if (weights == np.rint(weights)).all() else float(torch.rand(1, generator=self._order))
            counted = torch.from_numpy(repeated(weights, offset))
            shuffled = counted[torch.randperm(len(counted), generator=self._order)]
        shuffled = shuffled.to(y.device)
        for at in slices(len(shuffled), self._spec.batch):
            batch = shuffled[at]
            # The batch statistics of a few remaining windows would be noisy; they are used in other epochs.
            if n_windows and len(batch) < min(8, self._spec.batch):
                continue
            truth = y[batch]
            loss, logits = self.net.step(x, batch, truth, self._augment, self._order)
            self._adam.step(rate)
            sums[0] += loss * len(batch)
            sums[1] += (logits.argmax(dim=1) == truth).sum()
            n_windows += len(batch)
        return float(sums[0]) / n_windows, float(sums[1]) / n_windows

    def is_over(self, row: EpochRow) -> bool:
        """Keep the weights if the epoch is the best so far; return whether early stopping ends the training."""
        if self._spec.patience is None or not self._stops:
            return False
        epoch, score = len(self.history), self._score(row)
        if score > self._best_score:
            self._best_epoch, self._best_score, self._best = epoch, score, self.net.export_weights()
            return False
        return epoch - self._best_epoch >= self._spec.patience

    def state(self) -> FitState:
        """Return the state to continue from after the last epoch."""
        return FitState(
            epoch=len(self.history),
            steps=self._adam.steps,
            weights=self.net.export_weights(),
            means=[mean.cpu().numpy().copy() for mean in self._adam.means],
            squares=[square.cpu().numpy().copy() for square in self._adam.squares],
            random=self._order.get_state().numpy().copy(),
            history=[row.copy() for row in self.history],
            kept=dict(self.kept),
            best=dict(self._best) if self._best_epoch else {},
        )

    def finished(self, scaler: Scaler, seconds: float) -> FittedNetwork:
        """Return the network with the best weights, or without early stopping with the last."""
        if not self._best_epoch:
            self._best_epoch, self._best = len(self.history), self.net.export_weights()
        state = None if self._spec.patience is not None else replace(self.state(), best={})
        return FittedNetwork(self._best, scaler, self.history, self._best_epoch, seconds, self.kept, state)

    def _score(self, row: EpochRow) -> float:
        """Return the score of an epoch for early stopping; higher is better."""
        loss, accuracy = row["validation_loss"], row["validation_accuracy"]
        return float((accuracy or 0.0) if self._spec.stop_on == "accuracy" else -(loss or 0.0))


def repeated(weights: NDArray[np.float64], offset: float = 0.5) -> NDArray[np.int64]:
    """Return the index of each window as often as its weight (N,) says: the counts add up to rounded sums of weights.

    With a random ``offset`` between 0 and 1, the weight of a window is the mean of its count.
    """
    counts = np.diff(np.floor(np.cumsum(weights) + offset), prepend=0.0)
    return np.repeat(np.arange(len(weights)), counts.astype(np.int64))


def predict(
    arch: Arch, weights: dict[str, NDArray[np.float32]], scaler: Scaler, windows: WindowSet, device: str = "auto"
) -> NDArray[np.float32]:
    """Compute the class probabilities (N, K) of windows."""
    _check(windows, arch, "read", some=False)
    place = _device(device)
    net = Net(arch)
    net.import_weights(weights)
    x, _ = _tensors(windows, scaler, arch, place)
    with repeatable(), torch_threads(1):
        reader = engine(arch, net, place, 1, 1)
        return np.asarray(F.softmax(reader.logits(x), dim=1).cpu().numpy())


def _measure(row: EpochRow, net: Engine, data: tuple[Windows, Tensor] | None, windows: WindowSet | None) -> None:
    """Compute loss and accuracies of validation without training, and write them into the row."""
    row["validation_loss"] = row["validation_accuracy"] = row["validation_accuracy_people"] = None
    if data is None or windows is None:
        return
    x, y = data
    logits = net.logits(x)
    predicted = logits.argmax(dim=1)
    row["validation_loss"] = float(F.cross_entropy(logits, y))
    row["validation_accuracy"] = float((predicted == y).float().mean())
    row["validation_accuracy_people"] = accuracy_over_people(windows.y, predicted.cpu().numpy(), windows.subject)


def _tensors(windows: WindowSet, scaler: Scaler, arch: Arch, device: torch.device) -> tuple[Windows, Tensor]:
    """Return scaled windows (N, C, span or window) and classes (N,) on the device."""
    x = scaler.apply(windows.integers[:, :, windows.integers.shape[2] - arch.span :])
    return Windows(x, arch, device), torch.from_numpy(windows.y.astype(np.int64)).to(device)


def _check(windows: WindowSet | None, arch: Arch, purpose: str, some: bool = True) -> None:
    if windows is None:
        return
    if some and not len(windows):
        raise TrainingError(
            "There are no windows to {purpose}: check the data set, the gestures and the split.", purpose=purpose
        )
    _, channels, samples = windows.integers.shape
    if channels != arch.channels or len(windows.labels) != arch.classes:
        raise TrainingError(
            f"The windows have {channels} channels and {len(windows.labels)} classes, but the network "
            f"{arch.symbol} reads {arch.channels} and {arch.classes}: make the network for these windows."
        )
    if samples < arch.span:
        raise TrainingError(
            f"The windows hold {samples} samples, but the network {arch.symbol} needs {arch.span} for a decision: "
            "cut windows with that span."
        )


def _refuse_not_finite(row: EpochRow, spec: TrainSpec) -> None:
    for name, loss in (("train_loss", row["train_loss"]), ("validation_loss", row["validation_loss"])):
        if loss is not None and not np.isfinite(loss):
            raise DivergedError(
                "The {name} is no longer a number in epoch {epoch} at the learning rate {learning_rate:g}: try a "
                "lower one, such as {learning_rate_2:g}.",
                name=name.replace("_", " "),
                epoch=row["epoch"],
                learning_rate=row["learning_rate"],
                learning_rate_2=spec.learning_rate / 10,
            )


def resolve_device(spec: TrainSpec) -> TrainSpec:
    """Replace the device "auto" by the one that it means on this machine, for the id of a job.

    Raises:
        TrainingError: if the device does not exist.
    """
    return replace(spec, device=_device(spec.device).type)


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainingError("There is no CUDA device to train on: use the device 'auto' or 'cpu'.")
    return torch.device(name)
