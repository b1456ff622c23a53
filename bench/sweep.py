"""Compare our training with a plain PyTorch loop: cost of the paper's grid, losses, and final accuracies.

    python bench/sweep.py steps [--cores 1] [--filters 0,1,2,3] [--batches 64,256,3936] [--repeats 5] [--json]
    python bench/sweep.py losses DATASET        first 50 steps of all 52 networks, from the same weights and batches
    python bench/sweep.py trials DATASET        20 paired trainings: are the final accuracies different?
    python bench/sweep.py gpu [--cores 1] [--seconds 60] [--json]

The plain loop is a careful standard implementation: nn.Conv1d, nn.ReLU, nn.BatchNorm1d, F.pad with reflection, the data
in memory as one tensor, fused Adam, no value read out within an epoch, one training at a time. Both are timed in turn,
step by step, with the same batch and number of cores. On one core each uses one thread, and its processor time is
taken. On several cores, the plain loop runs one training with that many threads, and ours runs that many trainings side
by side, as a sweep does, and the wall clock is taken. The fastest step of each is used, because other programs on the
machine can only slow it down. The grid has 52 networks ×
batch 64, 256, full × 100, 250 and 1000 epochs; trained separately these are 1350 epochs, nested 1000.

``gpu`` times the same networks and batches on a graphics card with CUDA, one training alone, as `fit` trains there, and
beside it ours on ``--cores`` and on two cores. The card gets ``--seconds``, the largest networks first; networks for
which no time is left are missing in both sums. On the processor, only batches of 64 and 256 are timed for all networks:
a full batch is computed in chunks and taken as so many times one of 256, which is checked with every ninth network.
"""

import argparse
import copy
import json
import math
import multiprocessing
import platform
import sys
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import plushsense as ps
from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.models.net import Net
from plushsense.training import fit as training
from plushsense.training.engine import Adam, Windows, engine, repeatable
from plushsense.training.fast.net import FastNet
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSpec

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

    def take_plain(self, model: Plain) -> None:
        """Copy the plain loop's weights into ours."""
        tensors = iter(self.fast.parameters)
        with torch.no_grad():
            convs = [m for m in model.blocks if isinstance(m, nn.Conv1d)]
            norms = [m for m in model.blocks if isinstance(m, nn.BatchNorm1d)]
            for conv, norm in zip(convs, norms, strict=True):
                for value in (conv.weight.permute(2, 1, 0), conv.bias, norm.weight, norm.bias):
                    next(tensors).copy_(value)
            for value in (model.dense.weight, model.dense.bias):
                next(tensors).copy_(value)

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
    say = partial(print, file=sys.stderr if args.json else sys.stdout, flush=True)
    say(f"{platform.machine()}, {args.cores} core(s), torch {torch.__version__}; the fastest of interleaved steps")
    if beside is not None:
        say(f"plain: one training on {args.cores} threads; ours: {args.cores} trainings side by side, a thread each")
    say(f"{'network':38s} {'batch':>5s} {'plain ms':>9s} {'ours ms':>9s} {'ratio':>6s} {'MB':>6s}")
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
            say(
                f"{named(arch):38s} {batch:5d} {1e3 * plain:9.1f} {1e3 * ours:9.1f} {plain / ours:6.2f} "
                f"{loops.fast.plan.bytes / 1e6:6.0f}",
            )
    if beside is not None:
        beside.close()
    hours = {"plain": plain_s * APART / 3600, "ours": ours_s * NESTED / 3600}
    if args.json:
        print(json.dumps({"rows": rows, "step_ratio": plain_s / ours_s, "hours": hours}))
        return
    print(f"an epoch of everything: plain {plain_s:.1f} s, ours {ours_s:.1f} s")
    print(f"step for step:                       {plain_s / ours_s:.2f} times less")
    print(f"nested epochs (1350 → 1000):         {APART / NESTED:.2f} times less")
    print(f"the whole grid:                      {hours['plain'] / hours['ours']:.2f} times less")
    print(f"in hours: plain {hours['plain']:.1f}, ours {hours['ours']:.1f}")


class OnGpu:
    """Trains networks on random windows on the graphics card, one after the other."""

    def __init__(self) -> None:
        if not torch.cuda.is_available():
            raise SystemExit("There is no graphics card with CUDA.")
        self._device = torch.device("cuda")
        x, y = noise()
        any_network = Arch.parse("1", "1", channels=CHANNELS, classes=CLASSES, padding="mirror")
        self._x, self._y = Windows(x.numpy(), any_network, self._device), y.to(self._device)

    def epoch_s(self, arch: Arch, batch: int, most_s: float = 0.5) -> float:
        """Return the median time of an epoch, without the first; two to five epochs are trained."""
        torch.manual_seed(0)
        net, order = engine(arch, Net(arch), self._device, batch, 1), torch.Generator().manual_seed(2)
        adam, spec, took = Adam(net.parameters, fused=True), TrainSpec(batch=batch, device="cuda"), list[float]()
        with closing(net), repeatable(allow_tf32=True):
            while len(took) < 2 or (len(took) < 5 and sum(took) < most_s):
                began = time.perf_counter()
                # It ends with reading the loss, so it waits for the card.
                training._train(net, adam, RATE, self._x, self._y, spec, order, None, None)
                took.append(time.perf_counter() - began)
        return median(took[1:])


def on_processor(archs: list[Arch], cores: int, say: Callable[[str], None]) -> dict[tuple[str, int], float]:
    """Return the time of an epoch by network and batch: of one of ``cores`` trainings side by side, over ``cores``."""
    beside, took, checked = Beside(cores), dict[tuple[str, int], float](), list[float]()
    for n, arch in enumerate(archs):
        for batch in (64, 256, *([] if n % 9 else [WINDOWS])):
            beside.all((arch, batch))
            if batch < WINDOWS:
                beside.all(1)
            took[named(arch), batch] = beside.step_s(1 + (batch == 64)) * WINDOWS / batch
        full, parts = took.get((named(arch), WINDOWS)), took[named(arch), 256]
        if full is not None:
            checked.append(full / parts)
        took[named(arch), WINDOWS] = parts if full is None else full
    beside.close()
    say(f"{cores} cores: a full batch takes {min(checked):.2f} to {max(checked):.2f} times 15.4 batches of 256")
    return took


def gpu(args: argparse.Namespace) -> None:
    filters, batches = [int(i) for i in args.filters.split(",")], [int(b) for b in args.batches.split(",")]
    say = partial(print, file=sys.stderr if args.json else sys.stdout, flush=True)
    archs = sorted(networks(filters), key=lambda arch: arch.macs_per_window, reverse=True)
    card, rows, until = OnGpu(), list[dict[str, Any]](), time.monotonic() + args.seconds
    name = torch.cuda.get_device_name()
    say(f"{name}, {platform.machine()}, torch {torch.__version__}; ms for an epoch of {WINDOWS} windows")
    for arch in archs:
        for batch in batches:
            row: dict[str, Any] = {"network": named(arch), "batch": batch, "gpu_s": None}
            rows.append(row)
            if time.monotonic() < until:
                try:
                    row["gpu_s"] = card.epoch_s(arch, batch)
                except RuntimeError as cause:
                    row["failed"] = str(cause).splitlines()[0]
                took = row.get("failed") or f"{1e3 * row['gpu_s']:9.1f}"
                say(f"{named(arch):38s} {batch:5d} {took}")
    sums = epoch_sums(rows, ["gpu_s"], say)
    for cores in sorted({2, args.cores}, reverse=True):
        found = on_processor(archs, cores, say)
        for row in rows:
            row[f"cores_{cores}_s"] = found.get((row["network"], row["batch"]))
        sums = epoch_sums(rows, ["gpu_s", f"cores_{cores}_s"], say) | sums
    if args.json:
        print(json.dumps({"card": name, "rows": rows, "sums": sums}))


def epoch_sums(rows: list[dict[str, Any]], keys: list[str], say: Callable[[str], None]) -> dict[str, Any]:
    """Sum up the epochs of the networks that were timed on the card, by batch, and the hours of the nested grid."""
    timed = [row for row in rows if row["gpu_s"] is not None and row.get(keys[-1]) is not None]
    sums: dict[str, Any] = {}
    for key in keys:
        by_batch = dict.fromkeys((row["batch"] for row in rows), 0.0)
        for row in timed:
            by_batch[row["batch"]] += row[key]
        whole = sum(by_batch.values())
        sums[key] = {"timed": len(timed), "of": len(rows), "epoch_s": by_batch, "hours": whole * NESTED / 3600}
        parts = ", ".join(f"{s:.2f} s with {batch}" for batch, s in by_batch.items())
        say(
            f"{key}: an epoch of {len(timed)} of {len(rows)} trainings takes {whole:.2f} s ({parts}); "
            f"{NESTED} epochs {whole * NESTED / 3600:.2f} h"
        )
    return sums


def data(path: str) -> tuple[Tensor, Tensor, Any]:
    """Return the looped windows of a data set, scaled; their classes; and the windows."""
    from plushsense.windows.features import Scaler

    windows = ps.cut_windows(ps.open_dataset(Path(path)), WindowSpec(context="loop"))
    scaled = Scaler.fit(windows.integers).apply(windows.integers)
    return torch.from_numpy(scaled), torch.from_numpy(windows.y.astype(np.int64)), windows


def losses(args: argparse.Namespace) -> None:
    """Compare the losses of both loops.

    In lock step, both start each step from the plain loop's weights. Free, each continues from its own, as in a
    training, and rounding errors grow; the plain loop in double precision shows the effect of rounding alone.
    """
    x, y, windows = data(args.dataset)
    table = []
    print(f"{'largest relative difference in 50 steps':38s} {'lock step':>9s} {'free':>9s}   from double precision:")
    print(f"{'network':38s} {'':>9s} {'':>9s} {'plain':>9s} {'ours':>9s}")
    for given in networks([int(i) for i in args.filters.split(",")]):
        arch = Arch.parse(
            given.symbol, given.filters, channels=x.shape[1], classes=len(windows.labels), padding="mirror"
        )
        random = torch.Generator().manual_seed(2)
        loops, locked = Loops(arch, x, y, 64, 1), Loops(arch, x, y, 64, 1)
        double = copy.deepcopy(loops.model).double()
        adam = torch.optim.Adam(double.parameters(), lr=RATE, fused=True)
        apart = []
        for _ in range(50):
            at = torch.randperm(len(x), generator=random)[:64]
            locked.take_plain(loops.model)
            exact = F.cross_entropy(double(x[at].double()), y[at])
            adam.zero_grad(set_to_none=True)
            exact.backward()
            adam.step()
            truth, alike = float(exact.detach()), float(locked.ours(at))
            plain, ours = float(loops.plain(at)), float(loops.ours(at))
            pairs = ((plain, alike), (plain, ours), (truth, plain), (truth, ours))
            apart.append([abs(one - other) / one for one, other in pairs])
        loops.fast.close()
        locked.fast.close()
        table.append(np.max(apart, axis=0))
        print(f"{named(arch):38s} " + " ".join(f"{value:9.1e}" for value in table[-1]), flush=True)
    worst, within = np.max(table, axis=0), (np.array(table) <= 1e-3).sum(axis=0)
    print(f"{'largest':38s} " + " ".join(f"{value:9.1e}" for value in worst))
    print(f"{f'within 1e-3, of {len(table)}':38s} " + " ".join(f"{n:9d}" for n in within))


def trials(args: argparse.Namespace) -> None:
    x, y, windows = data(args.dataset)
    from plushsense.scoring.splits import make_folds, parse_split

    pairs = []
    for n, given in enumerate(networks([0, 1])[:20]):
        arch = Arch.parse(
            given.symbol, given.filters, channels=x.shape[1], classes=len(windows.labels), padding="mirror"
        )
        fold = make_folds(parse_split("windows:holdout"), windows.subject, windows.y, n)[0]
        train, test = torch.from_numpy(fold.train), torch.from_numpy(fold.test)
        loops, random = Loops(arch, x, y, 64, 1, seed=n), torch.Generator().manual_seed(n)
        for _ in range(args.epochs):
            order = train[torch.randperm(len(train), generator=random)]
            for start in range(0, len(order) - 8, 64):
                loops.plain(order[start : start + 64])
                loops.ours(order[start : start + 64])
        loops.model.eval()
        with torch.no_grad():
            plain = float((loops.model(x[test]).argmax(1) == y[test]).float().mean())
        held = loops.time_first[:, test]
        found = loops.fast.logits(lambda out, a, b, held=held: out.copy_(held[:, a:b]), len(test))
        pairs.append((plain, float((found.argmax(1) == y[test]).float().mean())))
        loops.fast.close()
        print(f"{named(arch):38s} plain {pairs[-1][0]:.4f} ours {pairs[-1][1]:.4f}", flush=True)
    apart = np.array([ours - plain for plain, ours in pairs])
    # Which of the two is called ours is exchangeable under the null hypothesis: flip signs at random.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(100_000, len(apart)))
    p = float((np.abs((signs * apart).mean(1)) >= abs(apart.mean()) - 1e-12).mean())
    half = 1.96 * apart.std(ddof=1) / math.sqrt(len(apart))
    print(
        f"{len(apart)} pairs, {args.epochs} epochs, random windows (leaky), test accuracy: ours − plain "
        f"{apart.mean():+.4f} (95 % interval {apart.mean() - half:+.4f} to {apart.mean() + half:+.4f}), "
        f"sign-flip test p = {p:.2f}"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("steps", "losses", "trials", "gpu"))
    parser.add_argument("dataset", nargs="?", help="for losses and trials")
    parser.add_argument("--cores", type=int, default=1, help="for steps and gpu: see above")
    parser.add_argument("--seconds", type=float, default=60.0, help="for gpu: time of the card")
    parser.add_argument("--filters", default="0,1,2,3", help="the paper's filter sets to include: 0 (smallest) to 3")
    parser.add_argument("--batches", default="64,256,3936")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--json", action="store_true", help="for steps and gpu: one JSON object")
    args = parser.parse_args()
    if args.what in ("losses", "trials") and not args.dataset:
        parser.error(f"{args.what} needs a data set")
    {"steps": steps, "losses": losses, "trials": trials, "gpu": gpu}[args.what](args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
