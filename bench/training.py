"""Compare a training step of ours with one of a plain PyTorch loop, on the networks of the paper's grid.

    python bench/training.py [--cores 1] [--filters 0,1,2,3] [--batches 64,256,3936] [--repeats 5] [--json]

The plain loop is a careful standard implementation: nn.Conv1d, nn.ReLU, nn.BatchNorm1d, F.pad with reflection, the data
in memory as one tensor, fused Adam, no value read out within an epoch, one training at a time. Both are timed in turn,
step by step, with the same batch and number of cores. On one core each uses one thread, and its processor time is
taken. On several cores, the plain loop runs one training with that many threads, and ours runs that many trainings side
by side, as a sweep does, and the wall clock is taken. The fastest step of each is used, because other programs on the
machine can only slow it down. The grid has 52 networks ×
batch 64, 256, full × 100, 250 and 1000 epochs; trained separately these are 1350 epochs, nested 1000.
"""

import argparse
import json
import math
import multiprocessing
import sys
import time
from multiprocessing.connection import Connection
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.models.net import Net
from plushsense.training.engine import Adam
from plushsense.training.fast.net import FastNet

WINDOWS, CHANNELS, CLASSES, SAMPLES = 3936, 11, 18, 250
APART, NESTED = 100 + 250 + 1000, 1000
RATE = 0.001


class Mirror(nn.Module):
    """Left padding by reflection, repeated where there are not enough samples."""

    def __init__(self, reach: int) -> None:
        super().__init__()
        self.reach = reach

    def forward(self, x: Tensor) -> Tensor:
        left = self.reach
        while left:
            some = min(left, x.shape[2] - 1)
            x = F.pad(x, (some, 0), mode="reflect")
            left -= some
        return x


class Plain(nn.Module):
    """The paper's network, layer by layer."""

    def __init__(self, arch: Arch) -> None:
        super().__init__()
        parts: list[nn.Module] = []
        for layer, reads in zip(arch.layers, arch.inputs, strict=True):
            parts += [Mirror(layer.reach)] if layer.reach else []
            parts.append(nn.Conv1d(reads, layer.filters, layer.kernel, dilation=layer.dilation))
            parts += [nn.ReLU(), nn.BatchNorm1d(layer.filters)]
        self.blocks, self.dense = nn.Sequential(*parts), nn.Linear(arch.filters[-1], arch.classes)

    def forward(self, x: Tensor) -> Tensor:
        return self.dense(self.blocks(x).mean(2))

    def take(self, net: Net) -> None:
        """Copy the weights of one of our networks."""
        weights = {name: torch.from_numpy(values) for name, values in net.export_weights().items()}
        with torch.no_grad():
            for i, conv in enumerate(m for m in self.blocks if isinstance(m, nn.Conv1d)):
                conv.weight.copy_(weights[f"conv{i}.weight"])
                conv.bias.copy_(weights[f"conv{i}.bias"])
            self.dense.weight.copy_(weights["dense.weight"])
            self.dense.bias.copy_(weights["dense.bias"])


class Loops:
    """Two training loops that step from the same weights on the same batch."""

    def __init__(self, arch: Arch, x: Tensor, y: Tensor, batch: int, threads: int, seed: int = 0) -> None:
        torch.manual_seed(seed)
        net = Net(arch)
        self.arch, self.x, self.y, self.threads = arch, x, y, threads
        self.time_first = x.permute(2, 0, 1).contiguous()
        self.model, self.fast = Plain(arch), FastNet(net, batch, threads)
        self.model.take(net)
        self.adam = torch.optim.Adam(self.model.parameters(), lr=RATE, fused=True)
        self.fast_adam = Adam(self.fast.parameters, fused=True)

    def plain(self, batch: Tensor) -> Tensor:
        torch.set_num_threads(self.threads)
        loss = F.cross_entropy(self.model(self.x[batch]), self.y[batch])
        self.adam.zero_grad(set_to_none=True)
        loss.backward()
        self.adam.step()
        return loss.detach()

    def ours(self, batch: Tensor) -> Tensor:
        torch.set_num_threads(1)

        def fill(out: Tensor, start: int, end: int) -> None:
            torch.index_select(self.time_first, 1, batch[start:end], out=out)

        loss, _, _ = self.fast.step(fill, self.y[batch])
        self.fast_adam.step(RATE)
        return loss


def networks(filters: list[int]) -> list[Arch]:
    return [
        Arch.parse(symbol, PAPER_FILTERS[i], channels=CHANNELS, classes=CLASSES, padding="mirror")
        for i in filters
        for symbol in PAPER_ARCHITECTURES
    ]


def named(arch: Arch) -> str:
    return f"{arch.symbol} {'/'.join(map(str, arch.filters))}"


def noise() -> tuple[Tensor, Tensor]:
    """Return as many random windows as the paper's training set has; their content does not change the time."""
    random = torch.Generator().manual_seed(1)
    x = torch.randn(WINDOWS, CHANNELS, SAMPLES, generator=random)
    return x, torch.randint(0, CLASSES, (WINDOWS,), generator=random)


def training_apart(pipe: Connection) -> None:
    """Run training steps on request, in one of several processes as in a sweep."""
    x, y = noise()
    random = torch.Generator().manual_seed(2)
    loops: Loops | None = None
    while (order := pipe.recv()) is not None:
        if isinstance(order, tuple):
            loops = Loops(*order[:1], x, y, order[1], 1)
            batch = order[1]
        else:
            assert loops is not None
            for _ in range(order):
                loops.ours(torch.randperm(WINDOWS, generator=random)[:batch])
        pipe.send("done")


class Beside:
    """One training for each core, side by side, each on one thread; the time of a step is divided by their number."""

    def __init__(self, cores: int) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipes = []
        for _ in range(cores):
            here, there = context.Pipe()
            context.Process(target=training_apart, args=(there,), daemon=True).start()
            self.pipes.append(here)

    def all(self, order: Any) -> None:
        for pipe in self.pipes:
            pipe.send(order)
        for pipe in self.pipes:
            pipe.recv()

    def step_s(self, steps: int) -> float:
        began = time.perf_counter()
        self.all(steps)
        return (time.perf_counter() - began) / (steps * len(self.pipes))

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send(None)


def steps(args: argparse.Namespace) -> None:
    filters, batches = [int(i) for i in args.filters.split(",")], [int(b) for b in args.batches.split(",")]
    random = torch.Generator().manual_seed(1)
    x, y = noise()
    beside = Beside(args.cores) if args.cores > 1 else None
    clock = time.process_time if beside is None else time.perf_counter
    plain_s = ours_s = 0.0
    rows: list[dict[str, Any]] = []
    for arch in networks(filters):
        for batch in batches:
            loops = Loops(arch, x, y, batch, args.cores)
            if beside is not None:
                beside.all((arch, batch))
            # A full batch of a large network takes half a minute, so fewer of them are timed.
            few = batch > 512
            took: tuple[list[float], list[float]] = ([], [])
            for turn in range(max(1, args.repeats // 3) if few else args.repeats + 1):
                at = torch.randperm(WINDOWS, generator=random)[:batch]
                began = clock()
                loops.plain(at)
                plain = clock() - began
                if beside is not None:
                    ours = beside.step_s(1 if few else 4)
                else:
                    began = clock()
                    loops.ours(at)
                    ours = clock() - began
                if turn or few:
                    took[0].append(plain)
                    took[1].append(ours)
            loops.fast.close()
            plain, ours = (min(t) for t in took)
            each = math.ceil(WINDOWS / batch)
            plain_s += plain * each
            ours_s += ours * each
            rows.append({"network": named(arch), "batch": batch, "plain_s": plain, "ours_s": ours})
    if beside is not None:
        beside.close()
    hours = {"plain": plain_s * APART / 3600, "ours": ours_s * NESTED / 3600}
    found = {"rows": rows, "step_ratio": plain_s / ours_s, "hours": hours, "torch": torch.__version__}
    print(json.dumps(found, indent=None if args.json else 1))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cores", type=int, default=1, help="see above")
    parser.add_argument("--filters", default="0,1,2,3", help="the paper's filter sets to include: 0 (smallest) to 3")
    parser.add_argument("--batches", default="64,256,3936")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    steps(parser.parse_args())
    return 0


if __name__ == "__main__":
    sys.exit(main())
