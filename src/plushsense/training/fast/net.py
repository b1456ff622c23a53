"""A network with an explicit forward and backward pass, in which normalisation needs no pass of its own.

Batch normalisation is an affine map a·r + b of each channel. Without zero padding, the map can be folded into the
weights of the next convolution, so that only r = ReLU(z) is stored; the gradients of a and b follow from the gradient
of the folded weights. Batches are processed in chunks of `CHUNK` windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from plushsense.models.arch import NORM_EPSILON, Arch, reflected
from plushsense.models.net import MOMENTUM, Net
from plushsense.training.fast.conv import LANES, BufferPool, ThreadPool, Way, way
from plushsense.training.fast.plan import CHUNK, plan_net
from plushsense.training.fast.stride import Stride

# Function (tensor, start, end) that writes windows [start, end) of a batch into a tensor (rows, windows, channels).
Fill = Callable[[Tensor, int, int], None]


def can_train(arch: Arch) -> bool:
    """Return whether `FastNet` supports an architecture: batch normalisation and no zero padding."""
    return arch.norm == "batch" and arch.padding in ("mirror", "stream")


@dataclass
class _Layer:
    """A layer: method, parameters (``w`` is (taps, C, F)), running statistics, and indices of its mirrored rows."""

    way: Way
    w: Tensor
    bias: Tensor
    gain: Tensor
    shift: Tensor
    mean: Tensor
    var: Tensor
    mirror: Tensor | None
    keeps: bool


@dataclass
class _Pass:
    """Values of the forward pass of a layer that the backward pass needs."""

    w: Tensor
    mean: Tensor
    var: Tensor
    a: Tensor
    b: Tensor


class FastNet:
    """A trainable network; `step` sets the gradients of its ``parameters`` without autograd.

    Args:
        net: a `Net` with the initial weights; a vector layer is not part of this network, but `step` then returns the
            gradient that it needs.
        batch: largest number of windows in a batch.
        threads: number of threads for the chunks of a batch; it does not affect the result.
        stride: positions that are computed; of the inputs, only the rows that are read are then filled in.
    """

    def __init__(self, net: Net, batch: int, threads: int = 1, stride: Stride | None = None) -> None:
        self._phases = 1 if stride is None else stride.phases
        arch = net.arch.trunk if stride is None else stride.applied(net.arch)
        self.arch, self.plan = arch, plan_net(arch, batch)
        self._passes_on = net.arch.vector is not None
        self._layers = [self._layer(net, i) for i in range(len(arch.layers))]
        self._dense, self._dense_bias = net.dense.weight.detach().clone(), net.dense.bias.detach().clone()
        self._threads, self._shared = ThreadPool(threads), BufferPool()
        self._scratch = [BufferPool() for _ in range(self._threads.threads)]
        self._ones = torch.ones(1, arch.span)
        self._steps = _step_means(net.arch, arch.pooled)
        self._edges: list[tuple[int, int]] = []
        self.parameters = [t for one in self._layers for t in (one.w, one.bias, one.gain, one.shift)]
        self.parameters += [self._dense, self._dense_bias]
        self.biases = [*(one.bias for one in self._layers), self._dense_bias]

    def _layer(self, net: Net, i: int) -> _Layer:
        named, planned = net.export_weights(), self.plan.layers[i]

        def tensor(name: str) -> Tensor:
            return torch.from_numpy(named[name])

        rows = reflected(planned.before, planned.front)[: planned.front]
        return _Layer(
            way(planned),
            tensor(f"conv{i}.weight").permute(2, 1, 0).contiguous(),
            tensor(f"conv{i}.bias"),
            tensor(f"norm{i}.gain"),
            tensor(f"norm{i}.shift"),
            tensor(f"norm{i}.mean"),
            tensor(f"norm{i}.var"),
            mirror=torch.from_numpy(rows.astype(np.int64)) if planned.front else None,
            keeps=self.plan.keeps[i],
        )

    @torch.no_grad()
    def step(self, fill: Fill, y: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Compute mean loss and logits (N, K) of a batch with the classes ``y`` (N,), and set the gradients.

        After a vector layer, also return the gradient of the inputs (T, N, C), else None.
        """
        self._cut(len(y))
        passes, pooled = self._forward(fill)
        last = passes[-1]
        features = _features(pooled, last.a, last.b)
        logits = torch.addmm(self._dense_bias, features, self._dense.t())
        logs = F.log_softmax(logits, dim=1)
        loss = F.nll_loss(logs, y)
        slope = logs.exp()
        slope[torch.arange(len(y)), y] -= 1.0
        slope /= len(y)
        self._dense.grad, self._dense_bias.grad = slope.t() @ features, slope.sum(0)
        self._backward(passes, pooled, slope @ self._dense)
        if not self._passes_on:
            return loss, logits, None
        return loss, logits, torch.cat([self._apart(self._gradient(0, i)) for i in range(len(self._edges))], dim=1)

    @torch.no_grad()
    def logits(self, fill: Fill, windows: int) -> Tensor:
        """Return the logits (N, K) of a number of windows, using the running statistics."""
        if not windows:
            return torch.zeros(0, self.arch.classes)
        self._cut(windows)
        folded = []
        for layer in self._layers:
            a = layer.gain * (layer.var + NORM_EPSILON).rsqrt()
            folded.append((a, layer.shift - layer.mean * a))
        ready = [self._folded(i, *(folded[i - 1] if i else (None, None))) for i in range(len(self._layers))]

        def read(i: int, lane: int, thread: int) -> Tensor:
            space, size = self._scratch[thread], self._size(i)
            x = space.take(("read", 0), self.plan.buffers[0], size, self.arch.channels)
            self._input(fill, i, x, space)
            for at, layer in enumerate(self._layers):
                out = space.take(("read", 1 + at % 2), self.plan.buffers[at + 1], size, layer.way.plan.filters)
                spectrum = space.take("spectrum", *layer.way.spectrum_shape(size))
                layer.way.forward(x, *ready[at], self._place(at, out), space, spectrum)
                self._finish(at, out)
                x = out
            rows = self._rows(len(self._layers) - 1, x)
            mean = rows.mean(0)
            return mean if self._steps is None else torch.cat([mean, self._deviations(rows).abs().mean(0)], dim=1)

        pooled = torch.cat(self._threads.each(read, len(self._edges)))
        return torch.addmm(self._dense_bias, _features(pooled, *folded[-1]), self._dense.t())

    def export_weights(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the weights, in the form of ``models/reference`` and of bundles."""
        named: dict[str, Tensor] = {"dense.weight": self._dense, "dense.bias": self._dense_bias}
        for i, layer in enumerate(self._layers):
            named |= {f"conv{i}.weight": layer.w.permute(2, 1, 0), f"conv{i}.bias": layer.bias}
            named |= {f"norm{i}.{name}": getattr(layer, name) for name in ("gain", "shift", "mean", "var")}
        return {
            name: np.array(named[name].detach().numpy(), dtype=np.float32, order="C")
            for name in self.arch.weight_shapes
        }

    def close(self) -> None:
        """Stop the threads."""
        self._threads.close()

    def _cut(self, windows: int) -> None:
        """Divide the windows into chunks [start, end)."""
        self._edges = [(at, min(at + CHUNK, windows)) for at in range(0, windows, CHUNK)]

    def _size(self, i: int) -> int:
        return self._edges[i][1] - self._edges[i][0]

    def _folded(self, at: int, a: Tensor | None, b: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return weights, in the form that the method needs, and bias, with the preceding normalisation folded in."""
        layer = self._layers[at]
        w = self._merged(layer.w) if a is None else layer.w * a[None, :, None]
        bias = layer.bias if b is None else layer.bias + b @ layer.w.sum(0)
        return layer.way.weights(w, self._shared, ("weights", at)), bias

    def _merged(self, w: Tensor) -> Tensor:
        """Return the weights (taps, C, F) of the first layer as a kernel over rows of several phases."""
        if self._phases == 1:
            return w
        taps = self._layers[0].way.plan.taps
        return F.pad(w, (0, 0, 0, 0, 0, taps * self._phases - len(w))).view(taps, -1, w.shape[2])

    def _apart(self, rows: Tensor) -> Tensor:
        """Return rows (T', n, phases · C) as (T' · phases, n, C)."""
        return rows.view(*rows.shape[:2], self._phases, -1).transpose(1, 2).flatten(0, 1)

    def _input(self, fill: Fill, i: int, x: Tensor, space: BufferPool) -> None:
        """Fill the input buffer ``x`` of the first layer for chunk ``i``."""
        front, before, phases = self._layers[0].way.plan.front, self.arch.span, self._phases
        rows = x[front : front + before]
        if phases == 1:
            fill(rows, *self._edges[i])
        else:
            size, width = self._size(i), self.arch.channels // phases
            apart = space.take("apart", before * phases, size, width)
            fill(apart, *self._edges[i])
            rows.view(before, size, phases, width).copy_(apart.view(before, phases, size, width).transpose(1, 2))
        x[front + before :].zero_()
        self._mirror(0, x)

    def _mirror(self, at: int, x: Tensor) -> None:
        """Fill the mirrored rows at the start of the input of layer ``at``."""
        mirror, front = self._layers[at].mirror, self._layers[at].way.plan.front
        if mirror is not None:
            torch.index_select(x[front:], 0, mirror, out=x[:front])

    def _front(self, at: int) -> int:
        """Return the number of mirrored rows that the next layer needs before the output of layer ``at``."""
        return self._layers[at + 1].way.plan.front if at + 1 < len(self._layers) else 0

    def _place(self, at: int, out: Tensor) -> Tensor:
        """Return the part of the output buffer ``out`` to which layer ``at`` writes."""
        front = self._front(at)
        return out[front : front + self._layers[at].way.plan.writes]

    def _rows(self, at: int, out: Tensor) -> Tensor:
        """Return the valid output rows of layer ``at`` in the buffer ``out``."""
        front = self._front(at)
        return out[front : front + self._layers[at].way.plan.after]

    def _finish(self, at: int, out: Tensor) -> Tensor:
        """Apply ReLU to the valid rows of ``out``, clear those behind, fill mirrored ones; return the valid rows."""
        rows = self._rows(at, out)
        rows.relu_()
        out[self._front(at) + len(rows) :].zero_()
        if at + 1 < len(self._layers):
            self._mirror(at + 1, out)
        return rows

    def _held(self, at: int, i: int) -> Tensor:
        """Return the input buffer of layer ``at`` for chunk ``i``; for the number of layers, the output buffer."""
        width = self.arch.channels if at == 0 else self._layers[at - 1].way.plan.filters
        return self._shared.take(("x", at, i), self.plan.buffers[at], self._size(i), width)

    def _spectrum(self, at: int, i: int, thread: int) -> Tensor:
        layer = self._layers[at]
        shape = layer.way.spectrum_shape(self._size(i))
        return (
            self._shared.take(("spectrum", at, i), *shape)
            if layer.keeps
            else self._scratch[thread].take("spectrum", *shape)
        )

    def _deviations(self, rows: Tensor) -> Tensor:
        """Return the deviations (blocks, N, F) of the means of each step from their mean, for rows (T', N, F)."""
        steps, (after, *shape) = cast(Tensor, self._steps), rows.shape
        means = (steps @ rows.reshape(after, -1)).view(-1, *shape)
        return means - means.mean(0)

    def _slope_of_deviation(self, i: int, slope: Tensor) -> Tensor:
        """Return the gradient (T', N, F) of the output rows of chunk ``i`` from that of their deviations (N, F)."""
        last = len(self._layers)
        signs = self._deviations(self._rows(last - 1, self._held(last, i))).sign_()
        steps = cast(Tensor, self._steps)
        each = (signs - signs.mean(0)) * (slope / len(steps))
        return (steps.t() @ each.view(len(steps), -1)).view(-1, *slope.shape)

    def _forward(self, fill: Fill) -> tuple[list[_Pass], Tensor]:
        """Return the values that each layer keeps, and the statistics (N, features) of the output of the last layer."""
        chunks, windows = len(self._edges), self._edges[-1][1]

        def read(i: int, lane: int, thread: int) -> None:
            self._input(fill, i, self._held(0, i), self._scratch[thread])

        self._threads.each(read, chunks)
        passes: list[_Pass] = []
        pooled: list[Tensor] = []
        for at, layer in enumerate(self._layers):
            ready, bias = self._folded(at, *((passes[-1].a, passes[-1].b) if passes else (None, None)))

            sums = self._threads.each(partial(self._forward_chunk, at, ready, bias), chunks)
            count = windows * layer.way.plan.after
            mean = _added([s.sum(0) for s, _ in sums]) / count
            var = (_added([q for _, q in sums]) / count - mean * mean).clamp_min_(0.0)
            layer.mean.lerp_(mean, MOMENTUM)
            layer.var.lerp_(var * (count / max(1, count - 1)), MOMENTUM)
            a = layer.gain * (var + NORM_EPSILON).rsqrt()
            passes.append(_Pass(ready, mean, var, a, layer.shift - mean * a))
            pooled = [s / layer.way.plan.after for s, _ in sums]
        if self._steps is None:
            return passes, torch.cat(pooled)

        def deviation(i: int, lane: int, thread: int) -> Tensor:
            return self._deviations(self._rows(len(self._layers) - 1, self._held(len(self._layers), i))).abs().mean(0)

        return passes, torch.cat([torch.cat(pooled), torch.cat(self._threads.each(deviation, chunks))], dim=1)

    def _forward_chunk(self, at: int, w: Tensor, bias: Tensor, i: int, lane: int, thread: int) -> tuple[Tensor, Tensor]:
        """Compute layer ``at`` for chunk ``i``; return the `_sums` of its output."""
        space, out = self._scratch[thread], self._held(at + 1, i)
        x, spectrum = self._held(at, i), self._spectrum(at, i, thread)
        self._layers[at].way.forward(x, w, bias, self._place(at, out), space, spectrum)
        return self._sums(self._finish(at, out), space)

    def _sums(self, rows: Tensor, space: BufferPool) -> tuple[Tensor, Tensor]:
        """Return the sums of ``rows`` over time (N, F), and the sums of squares over time and windows (F,)."""
        after, windows, width = rows.shape
        flat, ones = rows.view(after, windows * width), self._ones[:, :after]
        squares = torch.mul(flat, flat, out=space.take("squares", after, windows * width))
        return (ones @ flat).view(windows, width), (ones @ squares).view(windows, width).sum(0)

    def _backward(self, passes: list[_Pass], pooled: Tensor, slope: Tensor) -> None:
        """Compute the gradients of all layers from ``slope`` (N, F), the gradient of the inputs of the dense layer."""
        chunks, windows, last = len(self._edges), self._edges[-1][1], passes[-1]
        filters = len(last.a)
        da, db = (slope * pooled).sum(0), slope[:, :filters].sum(0)
        flat, deviation = slope[:, :filters] * last.a / self._layers[-1].way.plan.after, None
        if self._steps is not None:
            # A deviation is multiplied by the size of the gain.
            da = da[:filters] + da[filters:] * last.a.sign()
            deviation = slope[:, filters:] * last.a.abs()
        for at in range(len(self._layers) - 1, -1, -1):
            layer, here = self._layers[at], passes[at]
            count = windows * layer.way.plan.after
            inverse = (here.var + NORM_EPSILON).rsqrt()
            straight = da - here.mean * db
            layer.gain.grad, layer.shift.grad = straight * inverse, db.clone()
            # dL/dr is the gradient from above plus alpha + beta · r, which accounts for the batch's mean and variance.
            beta = straight * layer.gain * inverse.pow(3) / -count
            alpha = -here.a * db / count - beta * here.mean
            totals: dict[int, Tensor] = {}
            above = (flat, deviation) if at + 1 == len(self._layers) else None
            work = partial(self._backward_chunk, at, here.w, above, alpha, beta, totals)
            bias = _added(self._threads.each(work, chunks))
            total = totals[0]
            for lane in range(1, min(LANES, chunks)):
                total += totals[lane]
            dw = layer.way.gradient(total).reshape(-1, *layer.w.shape[1:])[: len(layer.w)]
            layer.bias.grad = bias
            if at:
                before = passes[at - 1]
                da, db = (dw * layer.w).sum((0, 2)), layer.w.sum(0) @ bias
                layer.w.grad = dw * before.a[None, :, None] + before.b[None, :, None] * bias
            else:
                layer.w.grad = dw.clone()

    def _backward_chunk(
        self,
        at: int,
        w: Tensor,
        above: tuple[Tensor, Tensor | None] | None,
        alpha: Tensor,
        beta: Tensor,
        totals: dict[int, Tensor],
        i: int,
        lane: int,
        thread: int,
    ) -> Tensor:
        """Propagate the gradient of chunk ``i`` back through layer ``at``; return the gradient of the bias.

        ``above``, only for the last layer, is the gradient (N, F) of each of its output rows, and that of their
        deviation. The gradient of the weights is added to the tensor of ``lane`` in ``totals``.
        """
        layer, space, size = self._layers[at], self._scratch[thread], self._size(i)
        planned = layer.way.plan
        rows = self._rows(at, self._held(at + 1, i))
        dz = space.take("dz", planned.writes, size, planned.filters)
        inner = dz[: planned.after]
        if above is None:
            torch.addcmul(self._gradient(at + 1, i), rows, beta, out=inner)
            inner += alpha
        else:
            (start, end), (flat, deviation) = self._edges[i], above
            torch.addcmul((flat[start:end] + alpha).expand(rows.shape), rows, beta, out=inner)
            if deviation is not None:
                inner += self._slope_of_deviation(i, deviation[start:end])
        torch.ops.aten.threshold_backward.grad_input(inner, rows, 0, grad_input=inner)
        dz[planned.after :].zero_()
        x, spectrum = self._held(at, i), self._spectrum(at, i, thread)
        if not layer.keeps:
            layer.way.spectrum(x, space, spectrum)
        fresh = lane not in totals
        if fresh:
            totals[lane] = self._shared.take(("total", lane), *w.shape)
        dx = self._slope(at, i) if at or self._passes_on else None
        bias = layer.way.backward(dz, x, w, totals[lane], fresh, dx, space, spectrum)
        if dx is not None and layer.mirror is not None:
            dx[planned.front :].index_add_(0, layer.mirror, dx[: planned.front])
        return bias

    def _slope(self, at: int, i: int) -> Tensor:
        """Return the gradient buffer of the input of layer ``at`` (needs, N, C); all layers share one per chunk."""
        planned = self._layers[at].way.plan
        return self._shared.take(("slope", i), planned.needs, self._size(i), planned.reads)

    def _gradient(self, at: int, i: int) -> Tensor:
        """Return the part of `_slope` that belongs to the output rows of the preceding layer, or to the inputs."""
        planned = self._layers[at].way.plan
        return self._slope(at, i)[planned.front : planned.front + planned.before]


def _step_means(arch: Arch, rows: int) -> Tensor | None:
    """Return a matrix (blocks, rows) that averages the rows of each step of the pool; None if only the mean is needed.

    Where a stride leaves rows out, steps have unequal numbers of rows.
    """
    if arch.pooling == "mean":
        return None
    blocks = min(arch.blocks, rows)
    of = torch.arange(rows) * blocks // rows
    return F.normalize(F.one_hot(of, blocks).t().float(), p=1.0)


def _features(pooled: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the inputs of the dense layer: statistics (N, features) of r become those of a · r + b."""
    if pooled.shape[1] == len(a):
        return pooled * a + b
    return pooled * torch.cat([a, a.abs()]) + torch.cat([b, torch.zeros_like(b)])


def _added(parts: list[Tensor]) -> Tensor:
    total = parts[0].clone()
    for part in parts[1:]:
        total += part
    return total
