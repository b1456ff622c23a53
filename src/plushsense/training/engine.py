"""Training engines, with which `fit` trains and evaluates a network.

Network and device determine which engine is used.

`Fast` (``training/fast``) is for batch normalisation with ``mirror`` or ``stream`` padding on the CPU. `Plain` uses
PyTorch's layers and gradients for everything else: layer normalisation, ``causal`` padding, or a GPU.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from plushsense.models.arch import Arch
from plushsense.models.net import Net
from plushsense.training.augment import Transform
from plushsense.training.fast.net import FastNet, can_train
from plushsense.training.fast.plan import plan_net
from plushsense.training.fast.stride import Stride, stride_for
from plushsense.training.fast.vectors import FastVectors
from plushsense.training.spec import EpochRow, TrainSpec

import torch  # isort: skip - after models.net, which says how to install it
from torch import Tensor
from torch.nn import functional as F
from torch.optim.adam import adam

_WEIGHT, _MEAN, _SQUARE, _KEPT, _BEST = "weight:", "mean:", "square:", "kept:", "best:"


@dataclass(frozen=True)
class FitState:
    """State of a training after ``epoch``, from which it can continue.

    ``means`` and ``squares`` are Adam's, of each parameter, after ``steps`` steps; ``random`` is the generator's state;
    ``kept`` the weights after earlier epochs; ``best`` the best weights so far, with early stopping.
    """

    epoch: int
    steps: int
    weights: dict[str, NDArray[np.float32]]
    means: Sequence[NDArray[np.float32]]
    squares: Sequence[NDArray[np.float32]]
    random: NDArray[np.uint8]
    history: list[EpochRow]
    kept: dict[int, dict[str, NDArray[np.float32]]] = field(default_factory=dict)
    best: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    def to_arrays(self) -> dict[str, object]:
        """Return the state as arrays and plain values by name, for a journal."""
        arrays: dict[str, Any] = {"epoch": self.epoch, "steps": self.steps, "history": self.history}
        for prefix, weights in ((_WEIGHT, self.weights), (_BEST, self.best)):
            arrays |= {prefix + name: values for name, values in weights.items()}
        for prefix, several in ((_MEAN, self.means), (_SQUARE, self.squares)):
            arrays |= {f"{prefix}{i}": values for i, values in enumerate(several)}
        for epoch, weights in self.kept.items():
            arrays |= {f"{_KEPT}{epoch}:{name}": values for name, values in weights.items()}
        return arrays | {"random": self.random}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Any]) -> FitState:
        """Build the state from the result of `to_arrays`; other names are ignored."""

        def several(prefix: str) -> list[NDArray[np.float32]]:
            return [arrays[f"{prefix}{i}"] for i in range(sum(name.startswith(prefix) for name in arrays))]

        def named(prefix: str) -> dict[str, NDArray[np.float32]]:
            return {name.removeprefix(prefix): v for name, v in arrays.items() if name.startswith(prefix)}

        kept: dict[int, dict[str, NDArray[np.float32]]] = {}
        for name, values in arrays.items():
            if name.startswith(_KEPT):
                epoch, _, weight = name.removeprefix(_KEPT).partition(":")
                kept.setdefault(int(epoch), {})[weight] = values
        return cls(
            epoch=int(arrays["epoch"]),
            steps=int(arrays["steps"]),
            weights=named(_WEIGHT),
            means=several(_MEAN),
            squares=several(_SQUARE),
            random=arrays["random"],
            history=list(arrays["history"]),
            kept=kept,
            best=named(_BEST),
        )


# Windows at a time without gradients.
_EVAL_BATCH = 512

# Values that a vector layer keeps for its gradient and needs to compute it, for each of its outputs.
_VECTOR_VALUES = 8


class Windows:
    """Scaled windows (N, C, T) on the device, in the memory layout of the engine."""

    def __init__(self, x: NDArray[np.float32], arch: Arch, device: torch.device) -> None:
        whole = torch.from_numpy(x)
        fills = is_fast(arch, device) and arch.vector is None
        self.time_first = whole.permute(2, 0, 1).contiguous() if fills else None
        self.whole = whole.to(device) if self.time_first is None else self.time_first.permute(1, 2, 0)

    def __len__(self) -> int:
        return len(self.whole)


def is_fast(arch: Arch, device: torch.device) -> bool:
    """Return whether `Fast` is used for a network on a device."""
    return device.type == "cpu" and can_train(arch)


def step_bytes(arch: Arch, spec: TrainSpec) -> int | None:
    """Return the memory of a training step without the data, in bytes; None for `Plain`, where it is unknown.

    ``spec.device`` is not "auto" (see `plushsense.training.fit.resolve_device`).
    """
    if not is_fast(arch, torch.device(spec.device)):
        return None
    vectors = 0 if arch.vector is None else _VECTOR_VALUES * arch.inputs[0] * arch.span * spec.batch * 4
    return plan_net(stride_for(arch, spec.stride).applied(arch), spec.batch).bytes + vectors


# Batches on a GPU up to this size are captured: for larger ones, launching kernels costs little, and memory is kept.
_CAPTURED_BATCH = 512
# Steps before one is captured, in which libraries choose their kernels and allocate their memory.
_WARM_STEPS = 3


class CapturedStep:
    """A step on a GPU, captured as a CUDA graph for one batch size: all its kernels are launched at once."""

    def __init__(
        self, compute: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], net: Net, windows: Tensor, y: Tensor
    ) -> None:
        self._windows, self._y, self._parameters = windows.clone(), y.clone(), list(net.parameters())
        self._graph = torch.cuda.CUDAGraph()
        net.zero_grad(set_to_none=True)
        with torch.cuda.graph(self._graph):
            self._result = compute(self._windows, self._y)
        self._gradients = [p.grad for p in self._parameters]

    def __call__(self, windows: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the gradients; return mean loss and logits, which the next call overwrites."""
        self._windows.copy_(windows)
        self._y.copy_(y)
        self._graph.replay()
        for p, gradient in zip(self._parameters, self._gradients, strict=True):
            p.grad = gradient
        return self._result


class Plain:
    """Training with PyTorch's layers and autograd.

    On a GPU with ``capture``, steps of small batches are replayed (`CapturedStep`); they compute the same.
    """

    def __init__(self, net: Net, device: torch.device, capture: bool = True) -> None:
        self._net = net.to(device)
        self._captures = capture and device.type == "cuda"
        self._steps: Counter[int] = Counter()
        self._captured: dict[int, CapturedStep] = {}

    @property
    def parameters(self) -> Sequence[Tensor]:
        """The tensors that the optimizer updates."""
        return list(self._net.parameters())

    @property
    def decayed(self) -> Sequence[Tensor]:
        """The parameters that weight decay makes smaller: all but biases."""
        return [p for name, p in self._net.named_parameters() if not name.endswith("bias")]

    def step(
        self, x: Windows, batch: Tensor, y: Tensor, augment: Transform | None, random: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Compute the gradients for the windows ``batch`` with classes ``y``; return mean loss and logits (n, K)."""
        self._net.train()
        windows = x.whole[batch]
        if augment is not None:
            windows = augment(windows, random)
        n = len(batch)
        if not self._captures or n > _CAPTURED_BATCH:
            return self._computed(windows, y)
        if n not in self._captured:
            self._steps[n] += 1
            if self._steps[n] <= _WARM_STEPS:
                # On a stream of its own, as PyTorch asks for before a capture.
                own, now = torch.cuda.Stream(), torch.cuda.current_stream()  # type: ignore[no-untyped-call]
                own.wait_stream(now)
                with torch.cuda.stream(own):
                    result = self._computed(windows, y)
                now.wait_stream(own)
                return result
            self._captured[n] = CapturedStep(self._computed, self._net, windows, y)
        return self._captured[n](windows, y)

    def _computed(self, windows: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the gradients for windows (n, C, T) with classes ``y``; return mean loss and logits (n, K)."""
        logits = self._net(windows)
        loss = F.cross_entropy(logits, y)
        self._net.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        return loss.detach(), logits.detach()

    def logits(self, x: Windows) -> Tensor:
        """Compute the logits (N, K) in evaluation mode."""
        self._net.eval()
        with torch.no_grad():
            parts = [self._net(x.whole[at]) for at in slices(len(x), _EVAL_BATCH)]
        return torch.cat(parts) if parts else torch.zeros(0, self._net.arch.classes)

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the weights in the format of ``models/reference``."""
        return self._net.export_weights()

    def close(self) -> None:
        """Free the memory of captured steps."""
        self._captured.clear()


class Fast:
    """Training with ``training/fast``; methods as in `Plain`.

    With a ``stride``, each step begins with another of its samples, and all positions are computed for `logits`.
    """

    def __init__(self, net: Net, batch: int, threads: int, stride: Stride | None = None) -> None:
        self._stride = Stride() if stride is None else stride
        self._whole = None if self._stride.samples == 1 else net
        self._net = FastNet(net, batch, threads, self._stride)
        self._vectors, self._reads = None, self._stride.covers(net.arch)
        if net.vectors is not None:
            self._reads += net.vectors.layer.reach
            self._vectors = FastVectors(net.vectors, self._reads, self._stride.inputs)

    @property
    def parameters(self) -> Sequence[Tensor]:
        return [*([] if self._vectors is None else self._vectors.parameters), *self._net.parameters]

    @property
    def decayed(self) -> Sequence[Tensor]:
        biases = {id(p) for p in self._net.biases}
        return [p for p in self.parameters if id(p) not in biases]

    def step(
        self, x: Windows, batch: Tensor, y: Tensor, augment: Transform | None, random: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        source, vectors, stride = x.time_first, self._vectors, self._stride
        start = int(torch.randint(stride.samples, (1,), generator=random)) if stride.samples > 1 else 0
        read = slice(start, start + self._reads)
        windows = x.whole[batch] if source is None or augment is not None else None
        if augment is not None and windows is not None:
            windows = augment(windows, random)
        if vectors is not None and windows is not None:
            vectors.forward(windows[:, :, read])

        def fill(out: Tensor, first: int, end: int) -> None:
            if vectors is not None:
                vectors.fill(out, first, end)
            elif windows is not None:
                out.copy_(windows[first:end, :, read][:, :, :: stride.inputs].permute(2, 0, 1))
            elif source is not None:
                torch.index_select(source[read][:: stride.inputs], 1, batch[first:end], out=out)

        loss, logits, gradient = self._net.step(fill, y)
        if vectors is not None and gradient is not None:
            vectors.backward(gradient)
        return loss, logits

    def logits(self, x: Windows) -> Tensor:
        if self._whole is not None:
            self._whole.import_weights(self.export_weights())
            return Fast(self._whole, 1, 1).logits(x)
        vectors = self._vectors

        def fill(out: Tensor, start: int, end: int) -> None:
            windows = x.whole[start:end]
            out.copy_(windows.permute(2, 0, 1) if vectors is None else vectors.read(windows))

        return self._net.logits(fill, len(x))

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        return self._net.export_weights() | ({} if self._vectors is None else self._vectors.net.export_weights())

    def close(self) -> None:
        self._net.close()


Engine = Plain | Fast


def engine(arch: Arch, net: Net, device: torch.device, batch: int, threads: int, stride: int = 1) -> Engine:
    """Create the engine for a network, with the weights of ``net``.

    Args:
        batch: maximum number of windows in a batch.
        threads: number of threads on the CPU.
        stride: as in `TrainSpec`.
    """
    return Fast(net, batch, threads, stride_for(arch, stride)) if is_fast(arch, device) else Plain(net, device)


class Adam:
    """Update parameters by Adam (Kingma & Ba 2015) with PyTorch's own step, as `torch.optim.Adam` does.

    That class first imports PyTorch's compiler, which takes more than a second and 100 MB. ``means`` and ``squares``
    are the moments of each parameter; both are empty before the first step. ``decayed`` are those whose gradients get
    ``weight_decay`` times the parameter.
    """

    def __init__(
        self,
        parameters: Iterable[Tensor],
        *,
        fused: bool | None = None,
        weight_decay: float = 0.0,
        decayed: Sequence[Tensor] = (),
    ) -> None:
        self._parameters, self._fused = list(parameters), fused
        self._weight_decay, self._decayed = weight_decay, list(decayed) if weight_decay else []
        self.means: list[Tensor] = []
        self.squares: list[Tensor] = []
        self._counts: list[Tensor] = []

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return int(self._counts[0]) if self._counts else 0

    def restore(self, steps: int, means: Iterable[Tensor], squares: Iterable[Tensor]) -> None:
        """Continue after ``steps`` steps, which left these moments."""
        self.means = [mean.to(p.device) for p, mean in zip(self._parameters, means, strict=True)]
        self.squares = [square.to(p.device) for p, square in zip(self._parameters, squares, strict=True)]
        self._counts = [torch.tensor(float(steps), device=p.device) for p in self._parameters]

    def zero_grad(self) -> None:
        """Remove the gradients."""
        for p in self._parameters:
            p.grad = None

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Update all parameters by their gradients."""
        if not self._counts:
            self.restore(0, map(torch.zeros_like, self._parameters), map(torch.zeros_like, self._parameters))
        for p in self._decayed:
            cast("Tensor", p.grad).add_(p, alpha=self._weight_decay)
        adam(
            self._parameters,
            cast("list[Tensor]", [p.grad for p in self._parameters]),
            self.means,
            self.squares,
            [],
            self._counts,
            fused=self._fused,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=learning_rate,
            weight_decay=0.0,
            eps=1e-8,
            maximize=False,
        )


@contextmanager
def repeatable(allow_tf32: bool = False) -> Iterator[None]:
    """Let a GPU compute the same bits again within the block.

    Args:
        allow_tf32: whether convolutions may round their inputs to TensorFloat-32, which has 10 bits of mantissa. A step
            that must be repeatable is then up to 20 times faster (H200).
    """
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=allow_tf32):
        yield


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set the number of PyTorch threads within the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def slices(n: int, size: int) -> Iterator[slice]:
    """Yield slices of at most ``size`` items that cover ``n`` items."""
    return (slice(start, start + size) for start in range(0, n, size))
