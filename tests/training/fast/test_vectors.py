"""The written-out pass of the vector layer is PyTorch's: outputs, gradient, running statistics."""

from __future__ import annotations

import copy

import pytest

from plushsense.models.arch import Arch

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
from plushsense.models.net import Net, VectorNet
from plushsense.training.fast.plan import CHUNK
from plushsense.training.fast.vectors import FastVectors

pytestmark = pytest.mark.apart("trainings")


def layer(symbol: str, channels: int, vectors: int, **more: int) -> tuple[VectorNet, int]:
    arch = Arch.parse(symbol, "6,16,16", channels=channels, classes=4, vectors=vectors, **more)
    torch.manual_seed(1)
    net = Net(arch).vectors
    assert net is not None
    return net, arch.span


def windows(n: int, channels: int, samples: int):  # type: ignore[no-untyped-def]
    """Moving vectors of any size, and gravity that is never zero."""
    x = torch.randn(n, channels, samples)
    x[:, -3:] = 0.2 * x[:, -3:] + torch.tensor([0.3, -0.4, 0.9])[:, None]
    return x


@pytest.mark.parametrize(
    ("symbol", "channels", "vectors", "batch", "window"),
    [
        ("v14_17d2_19d4", 6, 1, CHUNK, 250),
        ("v14_17d2_19d4", 11, 2, CHUNK + 7, 250),
        ("v14_17d2_19d4", 10, 2, 2, 250),
        ("v3_5_3d2", 6, 1, 33, 25),
        ("v2_5_3d2", 7, 1, 2 * CHUNK + 1, 60),
    ],
)
def test_a_pass_is_pytorchs(symbol: str, channels: int, vectors: int, batch: int, window: int) -> None:
    net, samples = layer(symbol, channels, vectors, window=window)
    fast = FastVectors(copy.deepcopy(net), samples)
    x = windows(batch, channels, samples)
    plain, exact = copy.deepcopy(net).train(), copy.deepcopy(net).double().train()
    out, wanted = plain(x), exact(x.double())
    slope = torch.randn_like(out)
    out.backward(slope)
    wanted.backward(slope.double())
    fast.forward(x)
    found = torch.empty(fast.rows, batch, wanted.shape[1])
    for at in range(0, batch, CHUNK):
        fast.fill(found[:, at : at + CHUNK], at, min(at + CHUNK, batch))
    fast.backward(slope.permute(2, 0, 1))

    def error(of: torch.Tensor, truth: torch.Tensor) -> float:
        return float((of - truth).detach().abs().max())

    # The sense of rotation has no derivative at zero, where rounding is enlarged: for PyTorch as much as here.
    assert error(found.permute(1, 2, 0), wanted) < 4 * error(out, wanted) + 1e-5
    assert plain.weight.grad is not None and exact.weight.grad is not None and fast.net.weight.grad is not None
    scale = float(exact.weight.grad.abs().max())
    assert (
        error(fast.net.weight.grad, exact.weight.grad) < 4 * error(plain.weight.grad, exact.weight.grad) + 1e-4 * scale
    )
    assert error(plain.weight.grad, exact.weight.grad) < 0.01 * scale
    for name in ("mean", "var"):
        assert torch.allclose(getattr(fast.net, name), getattr(plain, name), rtol=1e-5, atol=1e-6)
    some = x[:CHUNK]
    assert error(fast.read(some).permute(1, 2, 0), plain.eval()(some)) < 1e-3


def test_large_inputs_that_hardly_vary_are_standardized() -> None:
    """As with ``scaling = "none"``: sums of squares in single precision would lose the variance."""
    net, samples = layer("v3_5_3d2", 7, 1, window=40)
    fast = FastVectors(copy.deepcopy(net), samples)
    x = windows(20, 7, samples)
    x[:, 0] = 8192.0 + torch.randint(0, 3, (20, samples))
    fast.forward(x)
    found = torch.empty(fast.rows, 20, 19)
    fast.fill(found, 0, 20)
    assert found[:, :, 0].std() == pytest.approx(1.0, abs=0.01)
    assert found[:, :, 0].mean() == pytest.approx(0.0, abs=0.01)
