"""The written-out step is PyTorch's: loss, every gradient, running statistics, predictions; whatever the threads."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.models.arch import Arch

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
from plushsense.models.net import Net
from plushsense.training.fast import plan
from plushsense.training.fast.net import FastNet, can_train

pytestmark = pytest.mark.apart("trainings")


def pair(symbol: str, filters: str, padding: str, batch: int, window: int = 250, threads: int = 1, **more: int):  # type: ignore[no-untyped-def]
    arch = Arch.parse(symbol, filters, channels=5, classes=4, padding=padding, window=window, **more)
    torch.manual_seed(3)
    net = Net(arch)
    for block in net.blocks:  # not the identity, so that nothing cancels
        torch.nn.init.uniform_(block.gain, 0.5, 1.5)
        torch.nn.init.normal_(block.shift)
    x, y = torch.randn(batch, 5, arch.span), torch.randint(0, 4, (batch,))
    return arch, net, FastNet(net, batch, threads), x, y


def fill(x):  # type: ignore[no-untyped-def]
    return lambda out, start, end: out.copy_(x[start:end].permute(2, 0, 1))


def by_name(net: Net, arch: Arch) -> dict[str, np.ndarray]:
    """The gradients under the names of the weights."""
    shapes = arch.weight_shapes
    return {
        name: tensor.grad.numpy().reshape(shapes[name])
        for name, tensor in net._tensors().items()
        if tensor.grad is not None
    }


def gradients(fast: FastNet) -> dict[str, np.ndarray]:
    names = [f"{part}" for i in range(len(fast.arch.layers)) for part in
             (f"conv{i}.weight", f"conv{i}.bias", f"norm{i}.gain", f"norm{i}.shift")]  # fmt: skip
    found = dict(zip([*names, "dense.weight", "dense.bias"], fast.parameters, strict=True))
    return {n: (t.grad.permute(2, 1, 0) if t.grad.dim() == 3 else t.grad).numpy() for n, t in found.items()}


@pytest.mark.parametrize(
    ("symbol", "filters", "padding", "batch", "window"),
    [
        ("14d1_39d2_41d4", "8,12,16", "mirror", 20, 250),
        ("19d1_19d2_19d4_17d8", "4,6,8,8", "mirror", 70, 250),
        ("126d2", "6", "mirror", 9, 250),
        ("1d1_84d3_1d1", "8,7,5", "mirror", 130, 250),
        ("14d1_19d2_19d4", "8,12,16", "stream", 66, 250),
        ("20d2_16d4_20d8", "4,6,8", "stream", 8, 250),
        ("5_5d2", "6,8", "stream", 33, 60),
        ("3_1_3d2", "6,8,4", "mirror", 33, 61),
        ("1", "3", "mirror", 10, 7),
        ("9", "3", "stream", 1, 30),
    ],
)
def test_a_step_is_pytorchs(symbol: str, filters: str, padding: str, batch: int, window: int) -> None:
    arch, net, fast, x, y = pair(symbol, filters, padding, batch, window)
    before = {name: value.copy() for name, value in net.export_weights().items()}
    for name, value in fast.export_weights().items():
        assert np.array_equal(value, before[name])
    loss, logits, _ = fast.step(fill(x), y)
    # The same in double precision: what differs is rounding, and windows where a ReLU is all but zero.
    net.double().train()
    wanted = net(x.double())
    truth = torch.nn.functional.cross_entropy(wanted, y)
    torch.autograd.backward(truth)
    assert float(loss) == pytest.approx(float(truth.detach()), rel=1e-5)
    assert np.abs(logits.numpy() - wanted.detach().numpy()).max() < 1e-4
    expected, found = by_name(net, arch), gradients(fast)
    assert set(expected) == set(found)
    scale = max(np.abs(e).max() for e in expected.values())
    for name, value in expected.items():
        assert np.abs(found[name] - value).max() <= 2e-3 * np.abs(value).max() + 1e-5 * scale, name
    running = net.float().export_weights()
    for name, value in fast.export_weights().items():
        if name.endswith((".mean", ".var")):
            assert np.allclose(value, running[name], rtol=1e-4, atol=1e-5), name


@pytest.mark.parametrize("padding", ["mirror", "stream"])
def test_logits_are_those_of_the_finished_network(padding: str) -> None:
    _, net, fast, x, y = pair("14d1_39d2_41d4", "8,12,16", padding, 40)
    fast.step(fill(x), y)
    net.import_weights(fast.export_weights())
    net.eval()
    with torch.no_grad():
        wanted = net(x[:7]).numpy()
    assert np.abs(fast.logits(fill(x), 7).numpy() - wanted).max() < 1e-5
    assert fast.logits(fill(x), 0).shape == (0, 4)


def test_any_number_of_threads_gives_the_same_bits() -> None:
    steps = []
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for threads in (1, 2, 3):
            _, _, fast, x, y = pair("9_9d2", "6,8", "mirror", 10 * plan.CHUNK + 5, 100, threads)
            fast.step(fill(x), y)
            steps.append(gradients(fast))
            fast.close()
    finally:
        torch.set_num_threads(before)
    for other in steps[1:]:
        assert all(np.array_equal(value, other[name]) for name, value in steps[0].items())


def test_spectra_that_are_not_kept_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, fast, x, y = pair("14d1_39d2_41d4", "4,6,8", "mirror", 70)
    kept, _ = fast.step(fill(x), y), None
    with monkeypatch.context() as m:
        m.setattr(plan, "SPECTRA_BYTES", 0)
        _, _, other, _, _ = pair("14d1_39d2_41d4", "4,6,8", "mirror", 70)
    assert not any(other.plan.keeps)
    assert torch.equal(other.step(fill(x), y)[1], kept[1])
    one, two = gradients(fast), gradients(other)
    assert all(np.array_equal(one[name], two[name]) for name in one)


def test_memory_that_is_used_again_keeps_nothing_of_the_last_batch() -> None:
    _, _, fast, x, y = pair("14d1_39d2_41d4", "4,6,8", "mirror", 70)
    _, _, fresh, _, _ = pair("14d1_39d2_41d4", "4,6,8", "mirror", 70)
    fast.step(fill(x * 1e3), y)
    fast.logits(fill(x), 66)
    fast.step(fill(x[:9]), y[:9])
    fresh.step(fill(x[:9]), y[:9])
    one, two = gradients(fast), gradients(fresh)
    assert all(np.array_equal(one[name], two[name]) for name in one)


def test_what_it_can_train() -> None:
    assert can_train(Arch.parse("3", "4", padding="stream")) and can_train(Arch.parse("3", "4", padding="mirror"))
    assert not can_train(Arch.parse("3", "4", padding="causal"))
    assert not can_train(Arch.parse("3", "4", padding="stream", norm="layer"))
