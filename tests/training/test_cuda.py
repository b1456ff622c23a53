"""Training on a graphics card: the same numbers as on the CPU up to rounding, and the same bits again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from plushsense.models.arch import Arch
from plushsense.models.reference import Network
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
if not torch.cuda.is_available():
    pytest.skip("there is no graphics card with CUDA", allow_module_level=True)

from plushsense.training import engine
from plushsense.training.fit import FittedNetwork, StoreSpec, fit, predict

Make = Callable[..., WindowSet]
SPEC = TrainSpec(epochs=12, batch=16, patience=None, device="cuda")


def arch(symbol: str = "5_5d2", **changes: object) -> Arch:
    settings: dict[str, object] = {"channels": 2, "classes": 3, "window": 60, "step": 5} | changes
    return Arch.parse(symbol, "6,8", **settings)  # type: ignore[arg-type]


def same(one: FittedNetwork, other: FittedNetwork) -> bool:
    return one.history == other.history and all(np.array_equal(one.weights[n], other.weights[n]) for n in one.weights)


@pytest.mark.parametrize("padding", ["stream", "mirror", "causal"])
@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_it_learns_and_the_reference_reads_the_same(made: Make, padding: str, norm: str) -> None:
    net, test = arch(padding=padding, norm=norm), made(90, seed=2, person="P03")
    out = fit(made(150), made(60, seed=1, person="P02"), net, replace(SPEC, epochs=25))
    found = predict(net, out.weights, out.scaler, test, device="cuda")
    assert (found.argmax(axis=1) == test.y).mean() > 0.9
    assert np.abs(found - Network(net, out.weights).probabilities(out.scaler.apply(test.integers))).max() < 1e-5
    assert np.abs(found - predict(net, out.weights, out.scaler, test, device="cpu")).max() < 1e-5


@pytest.mark.parametrize("padding", ["stream", "mirror", "causal"])
def test_the_first_losses_are_those_of_the_cpu(made: Make, padding: str) -> None:
    histories = [
        fit(made(150), None, arch(padding=padding), replace(SPEC, epochs=2, device=device)).history
        for device in ("cpu", "cuda")
    ]
    for one, other in zip(*histories, strict=True):
        assert one["train_loss"] == pytest.approx(other["train_loss"], rel=1e-2)


@pytest.mark.parametrize("symbol", ["5_5d2", "v5_5d2"])
def test_the_same_seed_gives_the_same_bits_captured_or_not(
    made: Make, symbol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    channels, vectors = (2, ()) if symbol[0] != "v" else (6, ((0, 1, 2), (3, 4, 5)))
    train = replace(made(150, channels=channels), vectors=vectors)
    net = arch(symbol, channels=channels, vectors=1)
    spec = replace(SPEC, augment=("random-gain:0.3", "random-tilt:8", "random-rotation:10"))
    first = fit(train, train, net, spec)
    assert same(first, fit(train, train, net, spec))
    monkeypatch.setattr(engine, "_CAPTURED_BATCH", 0)
    assert same(first, fit(train, train, net, spec))


def test_a_training_goes_on_as_if_it_had_never_stopped(made: Make) -> None:
    train = made(70)
    whole, short = fit(train, None, arch(), SPEC), fit(train, None, arch(), replace(SPEC, epochs=5))
    assert short.state is not None
    assert same(whole, fit(train, None, arch(), SPEC, store=StoreSpec(short.state)))
