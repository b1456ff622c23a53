"""Training: it learns, repeats, stops where validation says, and refuses what cannot be trained."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import TrainingError
from plushsense.jobs.journal import Journal
from plushsense.models.arch import Arch
from plushsense.models.reference import Network
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet

torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra train)")
from plushsense.training.engine import Adam, FitState
from plushsense.training.fit import StoreSpec, fit, predict

pytestmark = pytest.mark.apart("trainings")

Make = Callable[..., WindowSet]
SPEC = TrainSpec(epochs=12, batch=16, device="cpu")


def arch(**changes: object) -> Arch:
    settings: dict[str, object] = {"channels": 2, "classes": 3, "window": 60, "step": 5} | changes
    return Arch.parse("5_5d2", "6,8", **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("padding", ["stream", "mirror"])
@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_it_learns_and_the_reference_reads_the_same(made: Make, padding: str, norm: str) -> None:
    net, test = arch(padding=padding, norm=norm), made(90, seed=2, person="P03")
    out = fit(made(150), made(60, seed=1, person="P02"), net, replace(SPEC, epochs=25))
    found = predict(net, out.weights, out.scaler, test, device="cpu")
    assert found.dtype == np.float32 and found.sum(axis=1) == pytest.approx(np.ones(90), abs=1e-5)
    assert (found.argmax(axis=1) == test.y).mean() > 0.9
    network = Network(net, out.weights)
    assert np.abs(found - network.probabilities(out.scaler.apply(test.integers))).max() < 1e-5


def test_the_same_seed_gives_the_same_weights_and_leaves_the_global_seed_alone(made: Make) -> None:
    train, validation = made(60), made(30, seed=1)
    torch.manual_seed(5)
    first = fit(train, validation, arch(), SPEC)
    after = torch.rand(1)
    torch.manual_seed(5)
    assert torch.equal(after, torch.rand(1))
    again = fit(train, validation, arch(), SPEC)
    other = fit(train, validation, arch(), replace(SPEC, seed=1))
    assert all(np.array_equal(first.weights[name], again.weights[name]) for name in first.weights)
    assert first.history == again.history
    assert not np.array_equal(first.weights["dense.weight"], other.weights["dense.weight"])


@pytest.mark.parametrize("fused", [True, None])
def test_adam_follows_its_formula(fused: bool | None) -> None:
    parameter = torch.arange(6.0).reshape(2, 3)
    adam, expected = Adam([parameter], fused=fused), parameter.numpy().astype(float)
    mean, square = np.zeros((2, 3)), np.zeros((2, 3))
    for t in range(1, 21):
        gradient = np.random.default_rng(t).normal(size=(2, 3)).astype(np.float32)
        parameter.grad = torch.from_numpy(gradient)
        rate = 0.1 / t
        adam.step(rate)
        mean, square = 0.9 * mean + 0.1 * gradient, 0.999 * square + 0.001 * gradient**2
        expected -= rate * (mean / (1 - 0.9**t)) / (np.sqrt(square / (1 - 0.999**t)) + 1e-8)
        assert adam.steps == t
        assert parameter.numpy() == pytest.approx(expected, abs=1e-5)
        assert adam.means[0].numpy() == pytest.approx(mean, abs=1e-5)
        assert adam.squares[0].numpy() == pytest.approx(square, abs=1e-5)
    adam.zero_grad()
    assert parameter.grad is None


@pytest.mark.parametrize("padding", ["mirror", "stream"])
@pytest.mark.parametrize("norm", ["batch", "layer", "none"])
def test_weight_decay_is_that_of_pytorch_on_all_but_biases(norm: str, padding: str) -> None:
    import torch

    from plushsense.models.net import Net
    from plushsense.training.engine import Fast, Plain, Windows

    network = arch(norm=norm, padding=padding)
    torch.manual_seed(3)
    initial, x, y = Net(network), torch.randn(16, network.channels, network.span), torch.randint(network.classes, (16,))
    results = []
    for kind in (Fast, Plain) if norm == "batch" else (Plain,):
        net = Net(network)
        net.import_weights(initial.export_weights())
        engine = Fast(net, 16, 1) if kind is Fast else Plain(net, torch.device("cpu"))
        adam = Adam(engine.parameters, fused=True, weight_decay=0.5, decayed=engine.decayed)
        windows = Windows(x.numpy(), network, torch.device("cpu"))
        for _ in range(3):
            engine.step(windows, torch.arange(16), y, None, torch.Generator())
            adam.step(0.01)
        results.append(engine.export_weights())
        engine.close()
    net = Net(network)
    net.import_weights(initial.export_weights())
    biases, others = [], []
    for name, parameter in net.named_parameters():
        (biases if name.endswith("bias") else others).append(parameter)
    groups = [{"params": biases, "weight_decay": 0.0}, {"params": others, "weight_decay": 0.5}]
    theirs = torch.optim.Adam(groups, lr=0.01)
    for _ in range(3):
        theirs.zero_grad()
        torch.nn.functional.cross_entropy(net(x), y).backward()
        theirs.step()
    for name, tensor in net.export_weights().items():
        for mine in results:
            np.testing.assert_allclose(mine[name], tensor, rtol=2e-4, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("norm", ["batch", "layer"])
def test_training_does_not_import_the_compiler_of_pytorch(
    made: Make, norm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would take more than a second, and 100 MB."""
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)
    assert len(fit(made(60), None, arch(norm=norm), replace(SPEC, epochs=1)).history) == 1


@pytest.mark.parametrize("stop_on", ["loss", "accuracy"])
def test_it_stops_with_the_best_weights(made: Make, stop_on: str) -> None:
    # Labels of the validation people mean nothing: it can only get worse.
    validation = made(30, seed=1)
    shuffled = replace(validation, y=np.random.default_rng(0).permutation(validation.y))
    spec = replace(SPEC, epochs=150, patience=5, stop_on=stop_on)
    out = fit(made(120), shuffled, arch(), spec)
    watched = [row[f"validation_{stop_on}"] for row in out.history]
    best = int(np.argmin(watched) if stop_on == "loss" else np.argmax(watched))
    assert out.best_epoch == best + 1 == len(out.history) - 5 < 145
    found = predict(arch(), out.weights, out.scaler, shuffled, device="cpu")
    assert (found.argmax(axis=1) == shuffled.y).mean() == pytest.approx(out.history[best]["validation_accuracy"])
    loss = -np.log(found[np.arange(30), shuffled.y]).mean()
    assert loss == pytest.approx(out.history[best]["validation_loss"], rel=1e-4)


def test_without_patience_or_validation_every_epoch_is_trained(made: Make) -> None:
    rows: list[tuple[int, int, dict[str, object]]] = []
    out = fit(made(50), None, arch(), SPEC, progress=lambda *said: rows.append(said))
    assert [said[:2] for said in rows] == [(e, 12) for e in range(1, 13)]
    assert [said[2] for said in rows] == out.history
    assert out.best_epoch == 12 and out.history[0]["validation_loss"] is None
    out = fit(made(50), made(9, seed=1), arch(), replace(SPEC, patience=None))
    assert out.best_epoch == 12 and len(out.history) == 12
    assert out.history[-1]["validation_accuracy"] is not None
    assert set(out.history[0]) == {
        "epoch", "train_loss", "train_accuracy", "validation_loss", "validation_accuracy",
        "validation_accuracy_people", "learning_rate",
    }  # fmt: skip


def test_scaling_is_of_the_training_windows_and_survives_a_constant_channel(made: Make) -> None:
    train, validation = made(40), made(20, seed=1)
    train.integers[:, 1] = 77
    out = fit(train, replace(validation, integers=validation.integers * 3), arch(), replace(SPEC, epochs=2))
    assert out.scaler.offset == pytest.approx(train.integers.mean(axis=(0, 2)))
    assert 1 / out.scaler.scale[0] == pytest.approx(train.integers[:, 0].std())
    assert np.isfinite(out.scaler.scale).all()
    assert all(np.isfinite(w).all() for w in out.weights.values())


@pytest.mark.parametrize("windows", [1, 2, 17, 33])
def test_a_last_tiny_batch_does_no_harm(made: Make, windows: int) -> None:
    out = fit(made(windows), None, arch(), replace(SPEC, epochs=2))
    assert all(np.isfinite(w).all() for w in out.weights.values())


def test_longer_windows_are_read_at_their_end(made: Make) -> None:
    test = made(20)
    longer = replace(test, integers=np.concatenate([np.full((20, 2, 13), 9999, np.int32), test.integers], axis=2))
    out = fit(made(60), None, arch(), replace(SPEC, epochs=2))
    one, other = (predict(arch(), out.weights, out.scaler, w, device="cpu") for w in (test, longer))
    assert np.array_equal(one, other)


def test_no_windows_give_no_predictions(made: Make) -> None:
    out = fit(made(20), None, arch(), replace(SPEC, epochs=1))
    assert predict(arch(), out.weights, out.scaler, made(0)).shape == (0, 3)


def test_what_cannot_be_trained_is_said(made: Make) -> None:
    with pytest.raises(TrainingError, match="no windows to train on"):
        fit(made(0), None, arch(), SPEC)
    with pytest.raises(TrainingError, match="2 channels and 3 classes.*5d1_5d2 reads 3 and 3"):
        fit(made(20), None, arch(channels=3), SPEC)
    with pytest.raises(TrainingError, match="hold 60 samples.*needs 72"):
        fit(made(20), None, arch(window=60, pool=60), SPEC)
    if not torch.cuda.is_available():
        with pytest.raises(TrainingError, match="no CUDA device"):
            fit(made(20), None, arch(), replace(SPEC, device="cuda"))


def test_a_loss_that_is_no_number_ends_the_training(made: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plushsense.training.fit._Training.train", lambda *_: (float("nan"), 0.1))
    with pytest.raises(TrainingError, match="train loss is no longer a number in epoch 1.*such as 0.0003"):
        fit(made(20), None, arch(), SPEC)


def test_the_number_of_threads_is_put_back(made: Make) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        fit(made(20), None, arch(), replace(SPEC, epochs=1))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_a_long_training_passes_through_the_end_of_a_short_one(made: Make) -> None:
    spec = replace(SPEC, epochs=4, halve_every=None, patience=None)
    long = fit(made(40), None, arch(), spec, store=StoreSpec(keep=(2, 4)))
    short = fit(made(40), None, arch(), replace(spec, epochs=2))
    assert sorted(long.kept) == [2, 4]
    for name, values in short.weights.items():
        assert np.array_equal(values, long.kept[2][name])
        assert np.array_equal(long.weights[name], long.kept[4][name])


@pytest.mark.parametrize("padding", ["stream", "causal"])
def test_a_training_goes_on_as_if_it_had_never_stopped(made: Make, tmp_path: Path, padding: str) -> None:
    spec = replace(SPEC, epochs=7, halve_every=2, patience=None, augment=("random-rotation:20",))
    train = replace(made(50), vectors=())
    whole = fit(train, made(20, seed=4), arch(padding=padding), spec, store=StoreSpec(keep=(3, 5)))
    saved: list[FitState] = []
    store = StoreSpec(keep=(3,), save=saved.append, save_every_s=0.0)
    short = fit(train, made(20, seed=4), arch(padding=padding), replace(spec, epochs=3), store=store)
    assert [state.epoch for state in saved] == [1, 2, 3]
    journal = Journal(tmp_path)
    journal.save("short", short.state.to_arrays())  # type: ignore[union-attr]
    state = FitState.from_arrays(journal.load("short"))
    assert state.epoch == 3
    went_on = fit(train, made(20, seed=4), arch(padding=padding), spec, store=StoreSpec(state, (3, 5)))
    assert went_on.history == whole.history
    assert sorted(went_on.kept) == sorted(whole.kept) == [3, 5]
    for name, values in whole.weights.items():
        assert np.array_equal(values, went_on.weights[name])
        assert all(np.array_equal(whole.kept[epoch][name], went_on.kept[epoch][name]) for epoch in (3, 5))
    with pytest.raises(TrainingError, match="leave patience out"):
        fit(train, made(20, seed=4), arch(padding=padding), replace(spec, patience=3), store=StoreSpec(state))


def test_a_training_can_begin_with_given_weights(made: Make) -> None:
    first = fit(made(60), None, arch(), SPEC)
    still = replace(SPEC, epochs=1, learning_rate=1e-9)
    further = fit(made(90, seed=4), None, arch(), still, store=StoreSpec(initial=first.weights))
    anew = fit(made(90, seed=4), None, arch(), still)
    learned = [name for name in first.weights if not name.endswith(("mean", "var"))]
    assert all(np.allclose(further.weights[name], first.weights[name], atol=1e-6) for name in learned)
    assert not all(np.allclose(anew.weights[name], first.weights[name], atol=1e-6) for name in learned)
    assert further.history[0]["train_loss"] < anew.history[0]["train_loss"]


def test_a_training_on_more_people_takes_a_third_of_the_epochs() -> None:
    whole, short = TrainSpec(epochs=60, halve_every=15).continued(), TrainSpec(epochs=1, halve_every=None).continued()
    assert (whole.epochs, whole.halve_every, short.epochs, short.halve_every) == (20, 5, 1, None)


@pytest.mark.parametrize("stop_on", ["loss", "accuracy"])
def test_a_training_that_stops_early_goes_on_as_well(made: Make, tmp_path: Path, stop_on: str) -> None:
    spec = replace(SPEC, epochs=40, learning_rate=0.05, patience=3, stop_on=stop_on)
    train, validation, journal = made(30), made(20, seed=4), Journal(tmp_path)
    states: list[FitState] = []
    whole = fit(train, validation, arch(), spec, store=StoreSpec(save=states.append, save_every_s=0.0))
    assert len(whole.history) == whole.best_epoch + 3 < 40
    # Stopped after any epoch, also between the best one and the end.
    for state in states:
        journal.save("stopped", state.to_arrays())
        store = StoreSpec(FitState.from_arrays(journal.load("stopped")))
        went_on = fit(train, validation, arch(), spec, store=store)
        assert (went_on.history, went_on.best_epoch) == (whole.history, whole.best_epoch)
        assert all(np.array_equal(values, went_on.weights[name]) for name, values in whole.weights.items())
