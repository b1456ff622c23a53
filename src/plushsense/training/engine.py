"""What `fit` drives: a network that takes batches, and is read. Two ways, chosen by network and device alone.

`Fast` (``training/fast``) on the CPU for batch normalisation under ``mirror`` and ``stream``; `Plain`, PyTorch's own
layers and gradients, for all else: layer normalisation, ``causal`` padding, a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from plushsense.models.arch import Arch
from plushsense.models.net import Net
from plushsense.training.augment import Turn
from plushsense.training.fast.net import FastNet, can
from plushsense.training.fast.plan import plan_net
from plushsense.training.spec import TrainSpec

import torch  # isort: skip - after models.net, which says how to install it
from torch import Tensor
from torch.nn import functional as F

# Windows at a time where no gradient is kept.
_READ = 512


class Engine(Protocol):
    """A network on its device, with the optimizer's view of it."""

    @property
    def parameters(self) -> Sequence[Tensor]:
        """What the optimizer moves."""
        ...

    def step(self, x: Windows, batch: Tensor, y: Tensor, turn: Turn, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Mean loss and logits (n, K) of the windows ``batch`` with truth ``y``; the gradients are then in place."""
        ...

    def logits(self, x: Windows) -> Tensor:
        """Logits (N, K), as the finished network would give them."""
        ...

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        """A copy of the weights, as ``models/reference`` takes them."""
        ...

    def close(self) -> None:
        """Give back threads."""
        ...


class Windows:
    """Scaled windows (N, C, T), held whole where they are needed; time first where the engine wants it so."""

    def __init__(self, x: NDArray[np.float32], arch: Arch, device: torch.device) -> None:
        whole = torch.from_numpy(x)
        self.time_first = whole.permute(2, 0, 1).contiguous() if is_fast(arch, device) else None
        self.whole = whole.to(device) if self.time_first is None else self.time_first.permute(1, 2, 0)

    def __len__(self) -> int:
        return len(self.whole)


def is_fast(arch: Arch, device: torch.device) -> bool:
    """Whether a network trains the fast way on a device."""
    return device.type == "cpu" and can(arch)


def step_bytes(arch: Arch, spec: TrainSpec) -> int | None:
    """What a training step holds beside the data; None where PyTorch's own layers train, which do not say.

    ``spec.device`` is settled (see `plushsense.training.fit.placed`).
    """
    return plan_net(arch, spec.batch).bytes if is_fast(arch, torch.device(spec.device)) else None


def engine(arch: Arch, net: Net, device: torch.device, batch: int, threads: int) -> Engine:
    """The engine of a network; the weights are taken from ``net``.

    Args:
        batch: windows in a batch, at most.
        threads: on the CPU.
    """
    return Fast(net, batch, threads) if is_fast(arch, device) else Plain(net, device)


class Plain:
    """PyTorch's own layers."""

    def __init__(self, net: Net, device: torch.device) -> None:
        self._net = net.to(device)

    @property
    def parameters(self) -> Sequence[Tensor]:
        return list(self._net.parameters())

    def step(self, x: Windows, batch: Tensor, y: Tensor, turn: Turn, random: torch.Generator) -> tuple[Tensor, Tensor]:
        self._net.train()
        logits = self._net(turn(x.whole[batch], random))
        loss = F.cross_entropy(logits, y)
        self._net.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        return loss.detach(), logits.detach()

    def logits(self, x: Windows) -> Tensor:
        self._net.eval()
        with torch.no_grad():
            parts = [self._net(x.whole[at]) for at in slices(len(x), _READ)]
        return torch.cat(parts) if parts else torch.zeros(0, self._net.arch.classes)

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        return self._net.export_weights()

    def close(self) -> None:
        """Nothing is held."""


class Fast:
    """``training/fast``."""

    def __init__(self, net: Net, batch: int, threads: int) -> None:
        self._net = FastNet(net, batch, threads)

    @property
    def parameters(self) -> Sequence[Tensor]:
        return self._net.parameters

    def step(self, x: Windows, batch: Tensor, y: Tensor, turn: Turn, random: torch.Generator) -> tuple[Tensor, Tensor]:
        if turn.idle:
            source = x.time_first
            assert source is not None

            def fill(out: Tensor, start: int, end: int) -> None:
                torch.index_select(source, 1, batch[start:end], out=out)
        else:
            turned = turn(x.whole[batch], random)

            def fill(out: Tensor, start: int, end: int) -> None:
                out.copy_(turned[start:end].permute(2, 0, 1))

        return self._net.step(fill, y)

    def logits(self, x: Windows) -> Tensor:
        source = x.time_first
        assert source is not None

        def fill(out: Tensor, start: int, end: int) -> None:
            out.copy_(source[:, start:end])

        return self._net.logits(fill, len(x))

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        return self._net.export_weights()

    def close(self) -> None:
        self._net.close()


def slices(n: int, size: int) -> Iterator[slice]:
    """The parts of ``n`` things, ``size`` at a time."""
    return (slice(start, start + size) for start in range(0, n, size))
