"""The trainable network against its meaning in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.errors import BadInput, BundleError
from plushsense.models.arch import NORMS, PADDINGS, PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.models.reference import Network, random_weights

torch = pytest.importorskip("torch")

from plushsense.models.net import Net

pytestmark = pytest.mark.apart("trainings")


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("padding", PADDINGS)
@pytest.mark.parametrize("symbol", PAPER_ARCHITECTURES)
def test_the_same_numbers_as_the_reference(symbol: str, padding: str, norm: str) -> None:
    arch = Arch.parse(symbol, PAPER_FILTERS[1], padding=padding, norm=norm)
    weights = random_weights(arch, 11)
    net = Net(arch)
    net.import_weights(weights)
    net.eval()
    x = np.random.default_rng(12).normal(size=(4, arch.channels, arch.span)).astype(np.float32)
    expected = Network(arch, weights).forward(x)
    with torch.no_grad():
        found = net(torch.from_numpy(x)).numpy()
        assert np.abs(found - expected).max() < 1e-5
        # A weight that moved by a thousandth is seen: the comparison can fail.
        net.blocks[0].conv.weight += 1e-3
        assert np.abs(net(torch.from_numpy(x)).numpy() - expected).max() > 1e-4
    out = net.export_weights()
    assert {name: w.shape for name, w in out.items()} == arch.weight_shapes
    assert all((out[name] == weights[name]).all() for name in out if name != "conv0.weight")


@pytest.mark.parametrize("norm", NORMS)
def test_deviations_are_those_of_the_reference(norm: str) -> None:
    arch = Arch.parse("14d1_19d2", (6, 8), norm=norm, pooling="mean+deviation")
    weights = random_weights(arch, 5)
    if norm != "none":
        weights["norm1.gain"][::2] *= -1
    net = Net(arch).double().eval()
    net.import_weights(weights)
    x = np.random.default_rng(1).normal(size=(3, arch.channels, arch.span))
    with torch.no_grad():
        found = net(torch.from_numpy(x)).numpy()
    assert np.abs(found - Network(arch, weights).forward(x)).max() < 1e-9


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("padding", PADDINGS)
def test_in_double_precision_nothing_is_left(padding: str, norm: str) -> None:
    # The layer norm of few filters may enlarge float32 rounding beyond 1e-5: in float64 only an error would show.
    for symbol in PAPER_ARCHITECTURES:
        arch = Arch.parse(symbol, PAPER_FILTERS[0], padding=padding, norm=norm)
        weights = random_weights(arch, 1)
        net = Net(arch).double().eval()
        net.import_weights(weights)
        x = np.random.default_rng(1).normal(size=(2, arch.channels, arch.span))
        with torch.no_grad():
            found = net(torch.from_numpy(x)).numpy()
        assert np.abs(found - Network(arch, weights).forward(x)).max() < 1e-9, symbol


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("padding", PADDINGS)
def test_what_training_leaves_means_the_same(padding: str, norm: str) -> None:
    arch = Arch.parse("6d1_5d3", (6, 8), channels=3, classes=4, window=60, padding=padding, norm=norm)
    torch.manual_seed(1)
    net = Net(arch)
    rng = np.random.default_rng(2)
    y = rng.integers(0, 4, size=96)
    x = (rng.normal(size=(96, 3, arch.span)) + 2.0 * y[:, None, None]).astype(np.float32)
    before = net.export_weights()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.02)
    losses = []
    for _ in range(60):
        optimizer.zero_grad()
        loss = torch.nn.functional.cross_entropy(net(torch.from_numpy(x)), torch.from_numpy(y))
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]
    after = net.export_weights()
    assert all((before[name] != after[name]).any() for name in after), "a tensor did not train"
    net.eval()
    with torch.no_grad():
        found = net(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(found, Network(arch, after).forward(x), atol=1e-5)


def test_exported_weights_are_a_copy_and_windows_may_be_longer() -> None:
    arch = Arch.parse("6d1_5d3", (6, 8), channels=3, classes=4, window=60)
    net = Net(arch).eval()
    out = net.export_weights()
    out["dense.bias"] += 1
    assert (net.export_weights()["dense.bias"] != out["dense.bias"]).all()
    x = torch.randn(2, 3, arch.span + 9)
    with torch.no_grad():
        torch.testing.assert_close(net(x), net(x[:, :, 9:]))


def test_what_does_not_fit_is_refused() -> None:
    arch = Arch.parse("6d1_5d3", (6, 8), channels=3, classes=4, window=60)
    net = Net(arch)
    with pytest.raises(BadInput, match="3 channels"):
        net(torch.zeros(1, 4, 60))
    with pytest.raises(BundleError, match="another network"):
        net.import_weights(random_weights(Arch.parse("6", (6,), channels=3, classes=4), 1))
