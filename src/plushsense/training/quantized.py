"""Quantization-aware fine-tuning: adapt weights to their rounding to 8 bits.

The forward pass computes what ``runtime/integer`` computes: weights in steps of 1/127 of the largest in their filter,
activations in 255 steps of a fixed range, biases as in ``deploy/quantize``. Only the fixed-point scales are left out,
which change an activation by less than a hundredth of a step unless it lies on a rounding boundary. Gradients pass
straight through rounding. Batch normalisation and a vector layer are frozen. The targets are the outputs of the float
network, not the labels, so that a few epochs on the training windows do not overfit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import TrainingError
from plushsense.models.arch import NORM_EPSILON, Arch, reflected
from plushsense.models.net import Net, VectorNet, deviation
from plushsense.runtime.integer import deployable, rounded_weights
from plushsense.training.engine import Adam, slices, torch_threads
from plushsense.training.fit import FittedNetwork, Weights
from plushsense.training.spec import EpochProgress, EpochRow, TrainSpec
from plushsense.windows.cut import WindowSet

import torch  # isort: skip - after models.net, which says how to install it
from torch import Tensor
from torch.nn import functional as F

_READ = 256  # windows at a time, without gradients
_SLOWER = 5  # divisor of the last learning rate of the training


def fine_tune(
    train: WindowSet,
    arch: Arch,
    fitted: FittedNetwork,
    calibration: Mapping[str, Any],
    spec: TrainSpec,
    epochs: int,
    progress: EpochProgress = lambda *_: None,
) -> Weights:
    """Fine-tune a network for rounding with the value ranges of ``calibration``, which do not change; return weights.

    Batch size, seed and threads are those of ``spec``; the learning rate falls linearly to 0 from a fifth of the last
    one in its schedule. Windows are not augmented: rotated ones exceed the ranges and would be clipped. Runs on the
    CPU. The same seed gives the same weights. The loss of the rows for ``progress`` is the Kullback-Leibler divergence
    from the float network.

    Raises:
        TrainingError: for a network that cannot be deployed, without calibration, or for less than 1 epoch.
    """
    if not deployable(arch) or not calibration:
        raise TrainingError(
            f"{arch.title} cannot be deployed, so there is nothing to fine-tune it for: train it with --padding stream "
            "and --norm batch or none."
        )
    if epochs < 1:
        raise TrainingError(f"{epochs} epochs of fine-tuning: accepted are 1 and more.")
    weights = fitted.weights
    x = torch.from_numpy(fitted.scaler.apply(train.integers[:, :, train.integers.shape[2] - arch.span :]))
    highest = spec.learning_rate_at(spec.epochs) / _SLOWER
    with torch.random.fork_rng(devices=[]), torch_threads(spec.threads):
        teacher = Net(arch)
        teacher.import_weights(weights)
        teacher.eval()
        network = Rounded(arch, weights, calibration)
        random = torch.Generator().manual_seed(spec.seed)
        adam = Adam(network.parameters)
        for epoch in range(1, epochs + 1):
            rate = highest * (1.0 - (epoch - 1) / epochs)
            order, total = torch.randperm(len(x), generator=random), 0.0
            for at in slices(len(x), spec.batch):
                batch = x[order[at]]
                with torch.no_grad():
                    target = F.log_softmax(teacher(batch), dim=1)
                loss = F.kl_div(F.log_softmax(network(batch), dim=1), target, reduction="batchmean", log_target=True)
                adam.zero_grad()
                torch.autograd.backward(loss)
                adam.step(rate)
                total += float(loss.detach()) * len(batch)
            row: EpochRow = {"epoch": epoch, "train_loss": total / len(x), "learning_rate": rate}
            progress(epoch, epochs, {**row, "what": "fine-tuning for 8 bits", "validation_accuracy": None})
    return network.export_weights()


class Rounded:
    """A network that rounds like the deployed one, with straight-through gradients.

    ``parameters`` are convolutions, gains, shifts and the dense layer; ``mean`` and ``var`` are constant.
    """

    def __init__(self, arch: Arch, weights: Mapping[str, NDArray[Any]], calibration: Mapping[str, Any]) -> None:
        self.arch = arch
        self._tensors = {name: torch.from_numpy(np.array(w, dtype=np.float32)) for name, w in weights.items()}
        # With 16 bits, the rounding of a vector layer changes nothing that could be learnt.
        self._vectors = None if arch.vector is None else VectorNet(arch.vector, arch)
        if self._vectors is not None:
            self._vectors.import_weights(weights)
            self._vectors.eval()
        self.parameters = [
            t.requires_grad_()
            for name, t in self._tensors.items()
            if not name.endswith((".mean", ".var")) and not name.startswith("vector.")
        ]
        self._low, self._high = (torch.tensor(calibration[name], dtype=torch.float32) for name in ("low", "high"))
        self._tops = [torch.tensor(top, dtype=torch.float32).clamp_min(1e-6) for top in calibration["tops"]]
        self._means = [torch.tensor(mean, dtype=torch.float32) for mean in calibration["means"]]
        self._deviation = torch.tensor(calibration.get("deviation", ()), dtype=torch.float32)

    def __call__(self, x: Tensor) -> Tensor:
        """Return the logits (N, K) of scaled windows (N, C, span)."""
        tensors, arch = self._tensors, self.arch
        if self._vectors is not None:
            with torch.no_grad():
                x = self._vectors(x)
        unit = (self._high - self._low).clamp_min(1e-6) / 255
        start, mean = self._low, self._means[0]
        codes = _whole((x - start[:, None]) / unit[:, None])
        for i, (layer, top) in enumerate(zip(arch.layers, self._tops, strict=True)):
            w, b = _rounded(tensors[f"conv{i}.weight"], tensors[f"conv{i}.bias"], unit, start, mean)
            if arch.padding == "mirror":
                codes = codes[:, :, reflected(codes.shape[2], layer.reach)]
            sums = F.conv1d(codes, w, b, dilation=layer.dilation)
            codes = _whole(sums / (top / 255)[:, None])
            gain, start = torch.ones_like(top), torch.zeros_like(top)
            if arch.norm == "batch":
                gain = tensors[f"norm{i}.gain"] / torch.sqrt(tensors[f"norm{i}.var"] + NORM_EPSILON)
                start = tensors[f"norm{i}.shift"] - tensors[f"norm{i}.mean"] * gain
            unit = gain * top / 255
            mean = gain * self._means[i + 1] + start
        pooled = codes.mean(dim=2)
        if arch.pooling != "mean":
            pooled = torch.cat([pooled, deviation(codes, arch.step)], dim=1)
            unit, start = torch.cat([unit, unit.abs()]), torch.cat([start, torch.zeros_like(start)])
            mean = torch.cat([mean, gain.abs() * self._deviation])
        w, b = _rounded(tensors["dense.weight"], tensors["dense.bias"], unit, start, mean)
        return F.linear(pooled, w, b)

    def logits(self, x: Tensor) -> Tensor:
        """Return the logits (N, K) without gradients, computed in parts."""
        with torch.no_grad():
            return torch.cat([self(x[at]) for at in slices(len(x), _READ)])

    def export_weights(self) -> Weights:
        """Return a copy of the weights, as ``models/reference`` takes them."""
        return {name: t.detach().numpy().copy() for name, t in self._tensors.items()}


def _straight(x: Tensor, rounded: Tensor) -> Tensor:
    """Return ``rounded`` with the gradient of ``x`` (straight-through estimator)."""
    return x + (rounded - x).detach()


def _whole(x: Tensor) -> Tensor:
    """Round to whole numbers and clamp to 0…255; clamped values have no gradient."""
    clamped = x.clamp(0.0, 255.0)
    return _straight(clamped, torch.floor(clamped + 0.5))


def _rounded(w: Tensor, b: Tensor, unit: Tensor, start: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return rounded weights (F, C, …) and biases for inputs in steps ``unit`` (C,) from ``start``.

    Weights are rounded as in ``deploy/quantize``; the biases compensate the mean error of the rounding.
    """
    per_channel = (1, -1, *[1] * (w.ndim - 2))
    scaled = w * unit.reshape(per_channel)
    step = (scaled.detach().abs().flatten(1).amax(dim=1) / 127).clamp_min(1e-30).reshape(-1, *[1] * (w.ndim - 1))
    whole = torch.from_numpy(rounded_weights((scaled.detach() / step).double().numpy()))
    rounded = _straight(scaled, whole * step)
    mean_codes = torch.where(unit == 0, torch.zeros_like(unit), (mean - start) / torch.where(unit == 0, 1.0, unit))
    mean_error = (
        (scaled - rounded).flatten(2).sum(dim=2) @ mean_codes.detach()
        if w.ndim > 2
        else (scaled - rounded) @ mean_codes.detach()
    )
    offset = w.flatten(2).sum(dim=2) @ start if w.ndim > 2 else w @ start
    return rounded, b + offset + mean_error
