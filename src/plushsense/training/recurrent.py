"""Recurrent networks for comparison: LSTM and BiLSTM, trained with the same schedule and seed as our networks.

A dense layer reads the last state of the last layer (in a BiLSTM, of both directions). The dropout is where the
authors' script has it, before the dense layer, and between the layers if there are several.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from plushsense.core.errors import TrainingError
from plushsense.training.augment import Channels, augmentations
from plushsense.training.engine import Adam, slices, torch_threads
from plushsense.training.fit import resolve_device
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from plushsense.windows.features import Scaler

import torch  # isort: skip - after training.engine, which says how to install it
from torch import Tensor, nn
from torch.nn import functional as F

# Part of every training's id: increase it when the same settings give another result.
RECURRENT_VERSION = 1
# Windows at a time without gradients; smallest batch to train on, except the first.
_READ, _FEW = 512, 8


class Recurrent(nn.Module):
    """LSTM from scaled windows (N, C, T) to logits (N, K)."""

    def __init__(
        self, channels: int, classes: int, both_ways: bool, units: int, layers: int = 1, dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.directions = 1 + both_ways
        # With one layer, PyTorch's LSTM has no place for a dropout, and warns.
        between = dropout if layers > 1 else 0.0
        self.cell = nn.LSTM(channels, units, layers, batch_first=True, dropout=between, bidirectional=both_ways)
        self.dropout = nn.Dropout(dropout)
        self.dense = nn.Linear(units * self.directions, classes)

    def forward(self, x: Tensor) -> Tensor:
        # States (layers * directions, N, units): those of the last layer are at the end.
        _, (states, _) = self.cell(x.transpose(1, 2).contiguous())
        last = torch.cat(tuple(states[-self.directions :]), dim=1)
        return cast(Tensor, self.dense(self.dropout(last)))


@dataclass(frozen=True)
class RecurrentReader:
    """A trained recurrent network; ``size_bytes`` is the size of its float32 weights as safetensors."""

    net: Recurrent
    scaler: Scaler
    samples: int
    seconds: float

    @property
    def size_bytes(self) -> int:
        return len(save({name: tensor.detach().cpu().numpy() for name, tensor in self.net.state_dict().items()}))

    def __call__(self, windows: WindowSet, /) -> NDArray[np.float32]:
        """Compute the class probabilities (N, K) of windows."""
        device = self.net.dense.weight.device
        x = torch.from_numpy(self.scaler.apply(windows.integers[:, :, -self.samples :])).to(device)
        with torch.no_grad():
            parts = [F.softmax(self.net(x[at]), dim=1) for at in slices(len(x), _READ)]
        if not parts:
            return np.zeros((0, len(windows.labels)), dtype=np.float32)
        return np.asarray(torch.cat(parts).cpu().numpy())


def fit_recurrent(
    train: WindowSet,
    spec: TrainSpec,
    samples: int,
    *,
    both_ways: bool = False,
    units: int,
    layers: int = 1,
    dropout: float = 0.0,
) -> RecurrentReader:
    """Train on the last ``samples`` of each window, for all epochs of ``spec``; the same seed gives the same weights.

    Learning rates, batch size, augmentations, scaling and seed are those of ``spec``; ``patience`` is not used.

    Args:
        both_ways: a BiLSTM instead of an LSTM.
        units: number of units in each layer and direction.
        dropout: share of values set to 0 in training, before the dense layer and between layers.

    Raises:
        TrainingError: without windows, or if the loss becomes NaN or infinite.
    """
    if not len(train):
        raise TrainingError("There are no windows to train on: check the data set, the gestures and the split.")
    began = time.perf_counter()
    device = torch.device(resolve_device(spec).device)
    last = train.integers[:, :, -samples:]
    scaler = Scaler.none(train.units) if spec.scaling == "none" else Scaler.fit(last)
    x = torch.from_numpy(scaler.apply(last)).to(device)
    y = torch.from_numpy(train.y).to(device)
    with torch.random.fork_rng(devices=[]), torch_threads(spec.threads):
        torch.manual_seed(spec.seed)
        net = Recurrent(x.shape[1], len(train.labels), both_ways, units, layers, dropout).to(device)
        order = torch.Generator().manual_seed(spec.seed)
        augment = augmentations(spec.augment, Channels(train.vectors, scaler, device))
        adam = Adam(net.parameters(), fused=True if device.type == "cuda" else None)
        for epoch in range(1, spec.epochs + 1):
            shuffled, total = torch.randperm(len(x), generator=order).to(device), torch.zeros((), device=device)
            for at in slices(len(x), spec.batch):
                batch = shuffled[at]
                if at.start and len(batch) < min(_FEW, spec.batch):
                    continue
                windows = x[batch] if augment is None else augment(x[batch], order)
                loss = F.cross_entropy(net(windows), y[batch])
                adam.zero_grad()
                torch.autograd.backward(loss)
                # Gradients of an LSTM can explode; without clipping, a single window could ruin the weights.
                nn.utils.clip_grad_norm_(net.parameters(), 1.0)
                adam.step(spec.learning_rate_at(epoch))
                total += loss.detach()
            if not torch.isfinite(total):
                raise TrainingError(
                    f"The training loss of the recurrent network is no longer a number in epoch {epoch}: try a lower "
                    "learning rate."
                )
    return RecurrentReader(net.eval(), scaler, samples, time.perf_counter() - began)
