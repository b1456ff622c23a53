"""Three methods of convolution, forward and backward, on chunks of windows in several threads and reused memory.

Rows are (T, N, C), weights (taps, input channels, filters). In each training step the weights are prepared once; then
each chunk is passed forward and backward, and the gradients of the weights are summed over the chunks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

from plushsense.training.fast.plan import LayerPlan
from plushsense.training.fast.transform import matrices


class BufferPool:
    """Reusable buffers by name: allocating megabytes takes longer than the computation in them."""

    def __init__(self) -> None:
        self._held: dict[object, Tensor] = {}

    def take(self, name: object, *shape: int) -> Tensor:
        """Return the buffer ``name`` as a tensor of ``shape``, with the values that were last written to it."""
        size = 1
        for n in shape:
            size *= n
        held = self._held.get(name)
        if held is None or held.numel() < size:
            held = self._held[name] = torch.zeros(size)
        return held[:size].view(shape)


# Sums over chunks are formed in this many lanes and then added in order: equal for any number of threads.
LANES = 8

Out = TypeVar("Out")


def _alone() -> None:
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)


class ThreadPool:
    """Threads that call a function with (chunk, lane, thread) for each chunk."""

    def __init__(self, threads: int) -> None:
        self.threads = min(threads, LANES)
        self._pool = ThreadPoolExecutor(self.threads, "plushsense-chunks", _alone) if self.threads > 1 else None

    def each(self, work: Callable[[int, int, int], Out], chunks: int) -> list[Out]:
        """Call ``work`` for each chunk and return the results in their order."""
        if self._pool is None or chunks == 1:
            return [work(i, i % LANES, 0) for i in range(chunks)]

        def share(thread: int) -> list[tuple[int, Out]]:
            return [(i, work(i, i % LANES, thread)) for i in range(chunks) if i % LANES % self.threads == thread]

        found = [pair for part in self._pool.map(share, range(self.threads)) for pair in part]
        return [out for _, out in sorted(found, key=lambda pair: pair[0])]

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()


class Way(ABC):
    """A method of computing a layer; ``spectrum`` is what the forward pass stores for the backward pass."""

    def __init__(self, plan: LayerPlan) -> None:
        self.plan = plan

    def weights(self, w: Tensor, space: BufferPool, name: object) -> Tensor:
        """Transform the weights (taps, C, F) into the form that this method uses."""
        return w

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        """Return the shape of the spectrum of a chunk of ``windows`` windows."""
        return (0,)

    def spectrum(self, x: Tensor, scratch: BufferPool, out: Tensor) -> None:  # noqa: B027
        """Compute the spectrum of ``x`` into ``out``, if it was not kept."""

    @abstractmethod
    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: BufferPool, spectrum: Tensor) -> None:
        """Compute ``out`` (writes, N, F) from ``x`` (at least needs, N, C)."""

    @abstractmethod
    def backward(
        self,
        dz: Tensor,
        x: Tensor,
        w: Tensor,
        total: Tensor,
        fresh: bool,
        dx: Tensor | None,
        scratch: BufferPool,
        spectrum: Tensor,
    ) -> Tensor:
        """Compute the gradients from ``dz`` (writes, N, F), which is zero beyond ``after``.

        The gradient of the weights, in the form of `weights`, is added to ``total`` (``fresh``: replaces it); that of
        the input rows is written to ``dx`` (needs, N, C); that of the bias (F,) is returned.
        """

    def gradient(self, total: Tensor) -> Tensor:
        """Transform ``total`` back into the gradient of the weights (taps, C, F)."""
        return total


class Pointwise(Way):
    """A convolution with one tap: a matrix product of all rows."""

    def weights(self, w: Tensor, space: BufferPool, name: object) -> Tensor:
        return w[0]

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: BufferPool, spectrum: Tensor) -> None:
        p = self.plan
        torch.addmm(bias, x[: p.before].view(-1, p.reads), w, out=out.view(-1, p.filters))

    def backward(
        self,
        dz: Tensor,
        x: Tensor,
        w: Tensor,
        total: Tensor,
        fresh: bool,
        dx: Tensor | None,
        scratch: BufferPool,
        spectrum: Tensor,
    ) -> Tensor:
        p = self.plan
        rows = dz.view(-1, p.filters)
        total.addmm_(x[: p.before].view(-1, p.reads).t(), rows, beta=0 if fresh else 1)
        if dx is not None:
            torch.mm(rows, w.t(), out=dx.view(-1, p.reads))
        return rows.sum(0)

    def gradient(self, total: Tensor) -> Tensor:
        return total[None]


class Direct(Way):
    """A convolution with few taps: one matrix product for each, on shifted views of the rows."""

    def _rows(self, x: Tensor, tap: int) -> Tensor:
        start = tap * self.plan.dilation
        return x[start : start + self.plan.after].view(-1, self.plan.reads)

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: BufferPool, spectrum: Tensor) -> None:
        rows = out.view(-1, self.plan.filters)
        torch.addmm(bias, self._rows(x, 0), w[0], out=rows)
        for tap in range(1, self.plan.taps):
            rows.addmm_(self._rows(x, tap), w[tap])

    def backward(
        self,
        dz: Tensor,
        x: Tensor,
        w: Tensor,
        total: Tensor,
        fresh: bool,
        dx: Tensor | None,
        scratch: BufferPool,
        spectrum: Tensor,
    ) -> Tensor:
        rows = dz.view(-1, self.plan.filters)
        if dx is not None:
            dx.zero_()
        for tap in range(self.plan.taps):
            total[tap].addmm_(self._rows(x, tap).t(), rows, beta=0 if fresh else 1)
            if dx is not None:
                self._rows(dx, tap).addmm_(rows, w[tap].t())
        return rows.sum(0)


class Spectral(Way):
    """A convolution with many taps: transform, one product for each plane, inverse transform."""

    def __init__(self, plan: LayerPlan) -> None:
        super().__init__(plan)
        assert plan.lengths is not None
        self.lengths = plan.lengths
        found = matrices(plan.lengths, plan.taps, plan.rows)
        self.d1, self.d2, self.g, self.a2, self.a1 = (
            torch.from_numpy(m) for m in (found.d1, found.d2, found.g, found.a2, found.a1)
        )

    def weights(self, w: Tensor, space: BufferPool, name: object) -> Tensor:
        p = self.plan
        out = space.take(name, self.lengths.planes, p.reads * p.filters)
        return torch.mm(self.g, w.reshape(p.taps, -1), out=out).view(-1, p.reads, p.filters)

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        return (self.lengths.planes, self.plan.dilation * windows, self.plan.reads)

    def spectrum(self, x: Tensor, scratch: BufferPool, out: Tensor) -> None:
        n, (pairs, short, long) = self.lengths, (self.lengths.pairs, self.lengths.short, self.lengths.long)
        wide = out.shape[1] * out.shape[2]
        half = torch.mm(
            self.d1, x[: self.plan.needs].view(long, short * wide), out=scratch.take("half", long, short * wide)
        )
        torch.bmm(self.d2, half.view(pairs, 2 * short, wide), out=out.view(pairs, n.planes // pairs, wide))

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: BufferPool, spectrum: Tensor) -> None:
        p, (pairs, short, long) = self.plan, (self.lengths.pairs, self.lengths.short, self.lengths.long)
        self.spectrum(x, scratch, spectrum)
        side = spectrum.shape[1]
        wide = side * p.filters
        product = torch.bmm(spectrum, w, out=scratch.take("product", self.lengths.planes, side, p.filters))
        half = scratch.take("half", long + 1, short * wide)
        torch.bmm(self.a2, product.view(pairs, 3 * short, wide), out=half[:long].view(pairs, 2 * short, wide))
        # The bias is one more row of the last product.
        half[long].view(short * side, p.filters).copy_(bias)
        torch.mm(self.a1, half, out=out.view(p.rows, short * wide))

    def backward(
        self,
        dz: Tensor,
        x: Tensor,
        w: Tensor,
        total: Tensor,
        fresh: bool,
        dx: Tensor | None,
        scratch: BufferPool,
        spectrum: Tensor,
    ) -> Tensor:
        p, (pairs, short, long) = self.plan, (self.lengths.pairs, self.lengths.short, self.lengths.long)
        side = spectrum.shape[1]
        wide = side * p.filters
        half = scratch.take("half", long + 1, short * wide)
        torch.mm(self.a1.t(), dz.view(p.rows, short * wide), out=half)
        bias = half[long].view(-1, p.filters).sum(0)
        product = scratch.take("product", self.lengths.planes, side, p.filters)
        torch.bmm(
            self.a2.transpose(1, 2), half[:long].view(pairs, 2 * short, wide), out=product.view(pairs, 3 * short, wide)
        )
        if fresh:
            torch.bmm(spectrum.transpose(1, 2), product, out=total)
        else:
            total.baddbmm_(spectrum.transpose(1, 2), product)
        if dx is not None:
            # The spectrum is no longer needed: its gradient replaces it.
            torch.bmm(product, w.transpose(1, 2), out=spectrum)
            wide = side * p.reads
            half = scratch.take("half", long, short * wide)
            torch.bmm(
                self.d2.transpose(1, 2), spectrum.view(pairs, 3 * short, wide), out=half.view(pairs, 2 * short, wide)
            )
            torch.mm(self.d1.t(), half, out=dx.view(long, short * wide))
        return bias

    def gradient(self, total: Tensor) -> Tensor:
        p = self.plan
        return torch.mm(self.g.t(), total.view(self.lengths.planes, -1)).view(p.taps, p.reads, p.filters)


def way(plan: LayerPlan) -> Way:
    """Create the method that ``plan`` names."""
    ways: dict[str, type[Way]] = {"pointwise": Pointwise, "direct": Direct, "spectral": Spectral}
    return ways[plan.way](plan)
