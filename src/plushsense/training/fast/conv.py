"""The three ways of a convolution on a chunk of windows, forward and backward, into memory that is used again.

Rows are (T, N, C). Weights are (taps, channels read, filters). A way prepares its weights once a step; then each chunk
goes forward, and backward, where the gradient of the weights is added up over chunks.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from plushsense.training.fast.plan import LayerPlan
from plushsense.training.fast.transform import matrices


class Space:
    """Memory by name, used again: a fresh allocation of megabytes costs more than the work done in it."""

    def __init__(self) -> None:
        self._held: dict[object, Tensor] = {}

    def take(self, name: object, *shape: int) -> Tensor:
        """A tensor of ``shape`` with whatever the last user of ``name`` left in it."""
        size = 1
        for n in shape:
            size *= n
        held = self._held.get(name)
        if held is None or held.numel() < size:
            held = self._held[name] = torch.zeros(size)
        return held[:size].view(shape)


class Way(Protocol):
    """How a layer is computed. ``spectrum`` names the memory that forward leaves for backward."""

    plan: LayerPlan

    def weights(self, w: Tensor, space: Space, name: object) -> Tensor:
        """The weights (taps, C, F) as this way uses them."""
        ...

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: Space, spectrum: Tensor) -> None:
        """``out`` (writes, N, F) from ``x`` (needs or more, N, C)."""
        ...

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        """The shape of the memory that forward leaves."""
        ...

    def spectrum(self, x: Tensor, scratch: Space, out: Tensor) -> None:
        """Fill that memory again, where it was not kept."""
        ...

    def backward(
        self,
        dz: Tensor,
        x: Tensor,
        w: Tensor,
        total: Tensor,
        fresh: bool,
        dx: Tensor | None,
        scratch: Space,
        spectrum: Tensor,
    ) -> Tensor:
        """From ``dz`` (writes, N, F), zero beyond ``after``: the gradient of the weights into ``total`` (as `weights`
        made them; ``fresh``: the first chunk), of the input rows into ``dx`` (needs, N, C), and of the bias (F,)."""
        ...

    def gradient(self, total: Tensor) -> Tensor:
        """The gradient of the weights (taps, C, F) from ``total``."""
        ...


class Pointwise:
    """One tap: a matrix product of all rows."""

    def __init__(self, plan: LayerPlan) -> None:
        self.plan = plan

    def weights(self, w: Tensor, space: Space, name: object) -> Tensor:
        return w[0]

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        return (0,)

    def spectrum(self, x: Tensor, scratch: Space, out: Tensor) -> None:
        """Nothing: the input itself is all that backward needs."""

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: Space, spectrum: Tensor) -> None:
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
        scratch: Space,
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


class Direct:
    """A few taps: one matrix product each, on rows that are shifted views."""

    def __init__(self, plan: LayerPlan) -> None:
        self.plan = plan

    def weights(self, w: Tensor, space: Space, name: object) -> Tensor:
        return w

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        return (0,)

    def spectrum(self, x: Tensor, scratch: Space, out: Tensor) -> None:
        """Nothing: the input itself is all that backward needs."""

    def _rows(self, x: Tensor, tap: int) -> Tensor:
        start = tap * self.plan.dilation
        return x[start : start + self.plan.after].view(-1, self.plan.reads)

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: Space, spectrum: Tensor) -> None:
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
        scratch: Space,
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

    def gradient(self, total: Tensor) -> Tensor:
        return total


class Spectral:
    """Many taps: transforms, one product for each plane, and back."""

    def __init__(self, plan: LayerPlan) -> None:
        assert plan.lengths is not None
        self.plan, self.lengths = plan, plan.lengths
        found = matrices(plan.lengths, plan.taps, plan.rows)
        self.d1, self.d2, self.g, self.a2, self.a1 = (
            torch.from_numpy(m) for m in (found.d1, found.d2, found.g, found.a2, found.a1)
        )

    def weights(self, w: Tensor, space: Space, name: object) -> Tensor:
        p = self.plan
        out = space.take(name, self.lengths.planes, p.reads * p.filters)
        return torch.mm(self.g, w.reshape(p.taps, -1), out=out).view(-1, p.reads, p.filters)

    def spectrum_shape(self, windows: int) -> tuple[int, ...]:
        return (self.lengths.planes, self.plan.dilation * windows, self.plan.reads)

    def spectrum(self, x: Tensor, scratch: Space, out: Tensor) -> None:
        n, (pairs, short, long) = self.lengths, (self.lengths.pairs, self.lengths.short, self.lengths.long)
        wide = out.shape[1] * out.shape[2]
        half = torch.mm(
            self.d1, x[: self.plan.needs].view(long, short * wide), out=scratch.take("half", long, short * wide)
        )
        torch.bmm(self.d2, half.view(pairs, 2 * short, wide), out=out.view(pairs, n.planes // pairs, wide))

    def forward(self, x: Tensor, w: Tensor, bias: Tensor, out: Tensor, scratch: Space, spectrum: Tensor) -> None:
        p, (pairs, short, long) = self.plan, (self.lengths.pairs, self.lengths.short, self.lengths.long)
        self.spectrum(x, scratch, spectrum)
        side = spectrum.shape[1]
        wide = side * p.filters
        product = torch.bmm(spectrum, w, out=scratch.take("product", self.lengths.planes, side, p.filters))
        half = scratch.take("half", long + 1, short * wide)
        torch.bmm(self.a2, product.view(pairs, 3 * short, wide), out=half[:long].view(pairs, 2 * short, wide))
        # The bias rides along as one more row of the last product.
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
        scratch: Space,
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
            # The spectrum is not needed any more: its gradient takes its place.
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
    """The way that a plan chose."""
    made: dict[str, type[Pointwise] | type[Direct] | type[Spectral]] = {
        "pointwise": Pointwise,
        "direct": Direct,
        "spectral": Spectral,
    }
    return made[plan.way](plan)
