"""Train one network: from windows to weights, scaling and history."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import DivergedError, TrainingError
from plushsense.models.arch import Arch
from plushsense.models.net import Net
from plushsense.scoring.metrics import accuracy_over_people
from plushsense.training.augment import Channels, Transform, augmentations
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
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler

import torch  # isort: skip - after models.net, which says how to install it
from torch import Tensor
from torch.nn import functional as F

# Called with (epoch, maximum epochs, row of the history).
Progress = Callable[[int, int, dict[str, Any]], None]

# Probability of a gesture from which an idle window is hard.
_HARD = 0.3


@dataclass(frozen=True)
class FittedNetwork:
    """A trained network.

    Attributes:
        weights: arrays by name, for `plushsense.models.reference.Network`.
        history: a row for each epoch: epoch (from 1), train_loss and train_accuracy (means over the batches, measured
            while training), validation_loss and validation_accuracy (None without validation) over all windows,
            validation_accuracy_people (see `accuracy_over_people`), learning_rate.
        best_epoch: the epoch of ``weights``.
        kept: weights after each epoch in ``keep``.
        state: state to continue the training from; None with early stopping.
    """

    weights: dict[str, NDArray[np.float32]]
    scaler: Scaler
    history: list[dict[str, Any]]
    best_epoch: int
    seconds: float
    kept: dict[int, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    state: FitState | None = None


def fit(
    train: WindowSet,
    validation: WindowSet | None,
    arch: Arch,
    spec: TrainSpec | None = None,
    progress: Progress | None = None,
    keep: Collection[int] = (),
    start: FitState | None = None,
    save: Callable[[FitState], None] | None = None,
    save_every_s: float = 60.0,
    weights: NDArray[np.float64] | None = None,
) -> FittedNetwork:
    """Train a network; the same seed gives the same weights.

    Args:
        train: windows to train on.
        validation: windows that decide when to stop; None or empty: train all epochs.
        keep: epochs after which a copy of the weights is stored. With a constant learning rate, these equal the weights
            of trainings with fewer epochs.
        start: state to continue from, with the same windows and settings but more epochs; the result is bit for bit
            that of an uninterrupted training.
        save: called with such a state every ``save_every_s`` seconds, also with early stopping.
        weights: how often each window of ``train`` counts in an epoch, (N,). Whole numbers give the same network as
            windows that are repeated; of fractions, each epoch draws whether the window counts once more.

    Raises:
        TrainingError: when the windows do not fit the network, or the loss is no longer a number.
    """
    began = time.perf_counter()
    spec = spec or TrainSpec()
    _check(train, arch, "train on")
    if validation is not None and len(validation):
        _check(validation, arch, "validate on")
    device = _device(spec.device)
    vectors = train.vectors if arch.vector is not None else ()
    scaler = (
        Scaler.none(train.units, vectors)
        if spec.scaling == "none"
        else Scaler.fit(train.integers if weights is None else train.integers[repeated(weights)], vectors)
    )
    x, y = _tensors(train, scaler, arch, device)
    val_data = None if validation is None or not len(validation) else _tensors(validation, scaler, arch, device)
    stops = val_data is not None and spec.patience is not None
    if start is not None and stops and not start.best:
        raise TrainingError(
            "A training with early stopping cannot go on from a state that holds no best weights: leave patience out."
        )
    # The fast engine starts its own threads, in each of which PyTorch uses one.
    threads = 1 if is_fast(arch, device) else spec.threads
    with torch.random.fork_rng(devices=[]), repeatable(allow_tf32=True), torch_threads(threads):
        torch.manual_seed(spec.seed)
        initial = Net(arch)
        if start is not None:
            initial.import_weights(start.weights)
        most = len(train) if weights is None else int(np.ceil(weights.sum()))
        net = engine(arch, initial, device, min(spec.batch, most), spec.threads)
        order = torch.Generator().manual_seed(spec.seed)
        augment = augmentations(spec.augment, Channels(train.vectors, scaler, device, arch.vector is not None))
        adam = Adam(net.parameters, fused=True, weight_decay=spec.weight_decay, decayed=net.decayed)
        if start is not None:
            adam.restore(
                start.steps, *([torch.from_numpy(m.copy()) for m in ms] for ms in (start.means, start.squares))
            )
            order.set_state(torch.from_numpy(start.random.copy()))
        with closing(net):
            history: list[dict[str, Any]] = [] if start is None else [dict(row) for row in start.history]
            kept = {} if start is None else {epoch: dict(weights) for epoch, weights in start.kept.items()}
            saved = time.perf_counter()
            best_epoch, best_score, best = 0, float("-inf"), net.export_weights()
            if start is not None and stops:
                best_epoch, best_score, best = *_best(history, spec), dict(start.best)
            for epoch in range(len(history) + 1, spec.epochs + 1):
                row: dict[str, Any] = {"epoch": epoch}
                rate = spec.learning_rate_at(epoch)
                row["train_loss"], row["train_accuracy"] = _train(net, adam, rate, x, y, spec, order, augment, weights)
                row |= _measure(net, val_data, validation)
                row["learning_rate"] = rate
                _refuse_not_finite(row, spec)
                history.append(row)
                if epoch in keep:
                    kept[epoch] = net.export_weights()
                if progress is not None:
                    progress(epoch, spec.epochs, row)
                if spec.patience is not None and stops:
                    if (score := _score(row, spec)) > best_score:
                        best_epoch, best_score, best = epoch, score, net.export_weights()
                    elif epoch - best_epoch >= spec.patience:
                        break
                if save is not None and time.perf_counter() - saved >= save_every_s:
                    save(_state(adam, net, order, history, kept, best if best_epoch else None))
                    saved = time.perf_counter()
            if best_epoch == 0:
                best_epoch, best = len(history), net.export_weights()
            state = None if spec.patience is not None else _state(adam, net, order, history, kept)
    return FittedNetwork(best, scaler, history, best_epoch, time.perf_counter() - began, kept, state)


def repeated(weights: NDArray[np.float64], offset: float = 0.5) -> NDArray[np.int64]:
    """Return the index of each window as often as its weight (N,) says: the counts add up to rounded sums of weights.

    With a random ``offset`` between 0 and 1, the weight of a window is the mean of its count.
    """
    counts = np.diff(np.floor(np.cumsum(weights) + offset), prepend=0.0)
    return np.repeat(np.arange(len(weights)), counts.astype(np.int64))


def _state(
    adam: Adam,
    net: Engine,
    order: torch.Generator,
    history: list[dict[str, Any]],
    kept: Mapping[int, dict[str, NDArray[np.float32]]],
    best: dict[str, NDArray[np.float32]] | None = None,
) -> FitState:
    return FitState(
        epoch=len(history),
        steps=adam.steps,
        weights=net.export_weights(),
        means=[mean.cpu().numpy().copy() for mean in adam.means],
        squares=[square.cpu().numpy().copy() for square in adam.squares],
        random=order.get_state().numpy().copy(),
        history=[dict(row) for row in history],
        kept=dict(kept),
        best=dict(best or {}),
    )


def _score(row: Mapping[str, Any], spec: TrainSpec) -> float:
    """Return the score of an epoch for early stopping; higher is better."""
    return float(row["validation_accuracy"] if spec.stop_on == "accuracy" else -row["validation_loss"])


def _best(history: list[dict[str, Any]], spec: TrainSpec) -> tuple[int, float]:
    """Return the first epoch with the best score, and the score."""
    scores = [_score(row, spec) for row in history]
    return int(np.argmax(scores)) + 1, max(scores)


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


def with_hard_negatives(
    train: WindowSet,
    candidates: WindowSet,
    idle: int,
    reactions: Sequence[int],
    arch: Arch,
    spec: TrainSpec,
    share: float,
    progress: Progress | None = None,
) -> WindowSet:
    """Return the training windows with hard negatives: idle windows that a first network takes for a gesture.

    Most idle windows are easy, and evenly spaced ones hold few of those at which a network reports a gesture for no
    reason. A network is trained on ``train`` and computes the candidates of class ``idle``, which must be of the
    training people. Those in which the classes of ``reactions`` together have a probability of at least 0.3 are added,
    the highest first.

    Args:
        candidates: windows of the same classes; those of other classes are ignored. Windows that are in ``train``
            already may be among them, and then count twice.
        reactions: indices of the classes that must not be reported for no reason.
        share: largest number of added windows, as a share of ``train``.
        progress: as for `fit`.
    """
    at = np.flatnonzero(candidates.y == idle)
    most = int(share * len(train))
    if not len(at) or not most:
        return train
    first = fit(train, None, arch, spec, progress)
    shares = predict(arch, first.weights, first.scaler, candidates.take(at), spec.device)
    gesture = shares[:, list(reactions)].sum(axis=1)
    hardest = np.argsort(-gesture, kind="stable")[:most]
    return train.joined(candidates.take(at[hardest[gesture[hardest] >= _HARD]]))


def _train(
    net: Engine,
    adam: Adam,
    rate: float,
    x: Windows,
    y: Tensor,
    spec: TrainSpec,
    order: torch.Generator,
    augment: Transform | None,
    weights: NDArray[np.float64] | None,
) -> tuple[float, float]:
    """Train one epoch at a learning rate; return mean loss and accuracy over its batches."""
    # Sum on the device: reading a number from a GPU in every batch would make the CPU wait.
    sums, n_windows = torch.zeros(2, device=y.device), 0
    if weights is None:
        shuffled = torch.randperm(len(x), generator=order)
    else:
        # Whole numbers draw nothing, so that the order is that of windows that are repeated.
        offset = 0.5 if (weights == np.rint(weights)).all() else float(torch.rand(1, generator=order))
        counted = torch.from_numpy(repeated(weights, offset))
        shuffled = counted[torch.randperm(len(counted), generator=order)]
    shuffled = shuffled.to(y.device)
    for at in slices(len(shuffled), spec.batch):
        batch = shuffled[at]
        # The batch statistics of a few remaining windows would be noisy; they are used in other epochs.
        if n_windows and len(batch) < min(8, spec.batch):
            continue
        truth = y[batch]
        loss, logits = net.step(x, batch, truth, augment, order)
        adam.step(rate)
        sums[0] += loss * len(batch)
        sums[1] += (logits.argmax(dim=1) == truth).sum()
        n_windows += len(batch)
    return float(sums[0]) / n_windows, float(sums[1]) / n_windows


def _measure(net: Engine, data: tuple[Windows, Tensor] | None, windows: WindowSet | None) -> dict[str, float | None]:
    """Compute loss and accuracies of validation without training, as a part of a row of the history."""
    if data is None or windows is None:
        return dict.fromkeys(("validation_loss", "validation_accuracy", "validation_accuracy_people"))
    x, y = data
    logits = net.logits(x)
    predicted = logits.argmax(dim=1)
    return {
        "validation_loss": float(F.cross_entropy(logits, y)),
        "validation_accuracy": float((predicted == y).float().mean()),
        "validation_accuracy_people": accuracy_over_people(windows.y, predicted.cpu().numpy(), windows.subject),
    }


def _tensors(windows: WindowSet, scaler: Scaler, arch: Arch, device: torch.device) -> tuple[Windows, Tensor]:
    """Return scaled windows (N, C, span or window) and classes (N,) on the device."""
    x = scaler.apply(windows.integers[:, :, windows.integers.shape[2] - arch.span :])
    return Windows(x, arch, device), torch.from_numpy(windows.y.astype(np.int64)).to(device)


def _check(windows: WindowSet, arch: Arch, purpose: str, some: bool = True) -> None:
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


def _refuse_not_finite(row: dict[str, Any], spec: TrainSpec) -> None:
    for name in ("train_loss", "validation_loss"):
        if row[name] is not None and not np.isfinite(row[name]):
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
