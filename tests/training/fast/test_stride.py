"""A step with a stride is the whole network's, of which only the positions that it names are averaged."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from plushsense.models.arch import NORM_EPSILON, Arch
from plushsense.training.fast.stride import Stride, stride_for

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
from torch import Tensor
from torch.nn import functional as F

from plushsense.models.net import MOMENTUM, Net
from plushsense.training.engine import Fast, Windows

pytestmark = pytest.mark.apart("trainings")


def whole_pass(net: Net, x: Tensor, stride: Stride, start: int) -> tuple[Tensor, list[Tensor]]:
    """Compute logits from every row of every layer in double precision, and the means of the batch.

    Statistics and the average are over the rows from ``start`` on that the stride names.
    """
    made, means, z = stride.applied(net.arch), [], x

    def standardized(rows: Tensor, every: int, count: int) -> Tensor:
        some = rows[:, :, start::every][:, :, :count]
        means.append(some.mean((0, 2)).detach())
        var = some.var((0, 2), unbiased=False)
        return (rows - some.mean((0, 2))[:, None]) * (var + NORM_EPSILON).rsqrt()[:, None]

    if net.vectors is not None:
        # With the first running statistics, the layer in evaluation mode only divides by a constant.
        z = net.vectors.eval()(z) * (1.0 + NORM_EPSILON) ** 0.5
        z = standardized(z, stride.inputs, made.span * stride.phases)
    for block, count in zip(net.blocks, made.positions, strict=True):
        z = F.relu(F.conv1d(z, block.conv.weight[:, :, 0], block.conv.bias, dilation=block.conv.dilation[1]))
        z = standardized(z, stride.samples, count) * block.gain[:, None] + block.shift[:, None]
    rows = z[:, :, start :: stride.samples][:, :, : made.pooled]
    pooled = rows.mean(2)
    if net.arch.pooling != "mean":
        blocks = min(net.arch.blocks, made.pooled)
        step = torch.arange(made.pooled) * blocks // made.pooled
        steps = torch.stack([rows[:, :, step == k].mean(2) for k in range(blocks)], 2)
        pooled = torch.cat([pooled, (steps - steps.mean(2, keepdim=True)).abs().mean(2)], 1)
    return net.dense(pooled), means


@pytest.mark.parametrize("batch", [20, 70])
@pytest.mark.parametrize(
    ("symbol", "channels", "vectors", "window", "most", "pooling"),
    [
        ("v14_17d2_19d4", 6, 1, 250, 2, "mean+deviation"),
        ("v14_17d2_19d4", 6, 1, 250, 2, "mean"),
        ("v14_17d2_19d4", 11, 2, 250, 4, "mean+deviation"),
        ("14d1_19d2_19d4", 11, 1, 250, 4, "mean"),
        ("20d2_16d4_20d8", 5, 1, 250, 4, "mean+deviation"),
        ("7d3_5d6", 5, 1, 100, 8, "mean"),
        ("5d4", 5, 1, 60, 4, "mean+deviation"),
        ("1_1", 5, 1, 30, 3, "mean"),
    ],
)
def test_gradients_are_those_of_the_whole_network_at_these_positions(
    symbol: str, channels: int, vectors: int, window: int, most: int, pooling: str, batch: int
) -> None:
    sizes = {"channels": channels, "classes": 4, "window": window, "vectors": vectors}
    arch = Arch.parse(symbol, "6,8,8", pooling=pooling, **sizes)
    stride = stride_for(arch, most)
    assert 1 < stride.samples <= most
    torch.manual_seed(3)
    net = Net(arch)
    for block in net.blocks:
        torch.nn.init.uniform_(block.gain, -1.5, 1.5)
        torch.nn.init.normal_(block.shift)
    exact = copy.deepcopy(net).double()
    x, y = torch.randn(batch, channels, arch.span), torch.randint(0, 4, (batch,))
    x[:, -3:] = 0.2 * x[:, -3:] + torch.tensor([0.3, -0.4, 0.9])[:, None]
    fast = Fast(net, batch, 1, stride)
    windows = Windows(x.numpy(), arch, torch.device("cpu"))
    loss, logits = fast.step(windows, torch.arange(batch), y, None, torch.Generator().manual_seed(7))
    start = int(torch.randint(stride.samples, (1,), generator=torch.Generator().manual_seed(7)))
    wanted, means = whole_pass(exact, x.double(), stride, start)
    truth = F.cross_entropy(wanted, y)
    torch.autograd.backward(truth)
    assert float(loss) == pytest.approx(float(truth.detach()), rel=1e-5)
    assert float((logits - wanted).detach().abs().max()) < 1e-4
    expected = [] if exact.vectors is None else [exact.vectors.weight.grad]
    for block in exact.blocks:
        kernel = block.conv.weight.grad[:, :, 0].permute(2, 1, 0)
        expected += [kernel, block.conv.bias.grad, block.gain.grad, block.shift.grad]
    expected += [exact.dense.weight.grad, exact.dense.bias.grad]
    scale = max(float(e.abs().max()) for e in expected)
    for parameter, value in zip(fast.parameters, expected, strict=True):
        assert float((parameter.grad - value).abs().max()) <= 2e-3 * float(value.abs().max()) + 1e-5 * scale
    found = fast.export_weights()
    running = [found[name] for name in arch.weight_shapes if name.endswith(".mean")]
    for one, value in zip(running, means, strict=True):
        assert np.allclose(one, MOMENTUM * value.numpy(), atol=1e-5)


def test_without_gradients_every_position_counts() -> None:
    arch = Arch.parse("v14_17d2_19d4", "6,8,8", channels=6, classes=4)
    torch.manual_seed(3)
    net = Net(arch)
    x, y = torch.randn(20, 6, arch.span), torch.randint(0, 4, (20,))
    windows = Windows(x.numpy(), arch, torch.device("cpu"))
    fast = Fast(net, 20, 1, stride_for(arch, 4))
    fast.step(windows, torch.arange(20), y, None, torch.Generator())
    whole = Net(arch)
    whole.import_weights(fast.export_weights())
    with torch.no_grad():
        assert float((fast.logits(windows) - whole.eval()(x)).abs().max()) < 1e-4


def test_each_step_begins_with_another_sample() -> None:
    arch = Arch.parse("5_5d4", "6,8", channels=2, classes=3, window=60)
    windows = Windows(torch.randn(16, 2, arch.span).numpy(), arch, torch.device("cpu"))
    fast, random = Fast(Net(arch), 16, 1, stride_for(arch, 4)), torch.Generator().manual_seed(0)
    batch, y = torch.arange(16), torch.zeros(16, dtype=torch.int64)
    losses = {float(fast.step(windows, batch, y, None, random)[0]) for _ in range(40)}
    assert len(losses) == 4


@pytest.mark.parametrize(
    ("symbol", "padding", "most", "stride"),
    [
        ("v14_17d2_19d4", "stream", 4, Stride(2, 2)),
        ("v14_17d2_19d4", "stream", 3, Stride(2, 1)),
        ("v14_17d2_19d4", "stream", 1, Stride()),
        ("14d1_19d2_19d4", "stream", 4, Stride(1, 2)),
        ("14d1_19d2_19d4", "mirror", 4, Stride()),
        ("9_9", "stream", 4, Stride()),
        ("5d6_3d4", "stream", 4, Stride(2, 1)),
    ],
)
def test_the_stride_is_the_longest_that_the_dilations_allow(
    symbol: str, padding: str, most: int, stride: Stride
) -> None:
    arch = Arch.parse(symbol, "6,8,8", channels=6, classes=4, padding=padding)
    assert stride_for(arch, most) == stride


def test_no_stride_reads_beyond_the_window() -> None:
    for kernel in range(1, 12):
        for pool in range(2, 40):
            arch = Arch.parse(f"{kernel}_3d12", "2,2", channels=2, classes=2, window=60, step=1, pool=pool)
            for most in range(1, 13):
                stride = stride_for(arch, most)
                assert stride.applied(arch).pooled >= 1
                assert stride.covers(arch) + stride.samples - 1 <= arch.span
