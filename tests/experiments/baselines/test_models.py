"""Baselines: what is fitted to what, how it is read, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.experiments.baselines.models import (
    BASELINES,
    FEATURES,
    ClassicalFit,
    FittedClassifier,
    RecurrentSpec,
    classical,
    likelihoods,
    parse_recurrent,
    recurrent,
)
from plushsense.experiments.baselines.score import Pca
from plushsense.training.spec import TrainSpec
from plushsense.windows.cut import WindowSet
from support.fakes import rhythms

pytestmark = [pytest.mark.usefixtures("scikit_learn"), pytest.mark.apart("models")]

SAMPLES = 50


def fitted(name: str = "knn", features: str = "statistics", pca: Pca = False, seed: int = 0) -> FittedClassifier:
    reader = ClassicalFit(name, features, pca, SAMPLES, seed)(rhythms(), rhythms(0))
    assert isinstance(reader, FittedClassifier)
    return reader


@pytest.mark.parametrize("name", list(BASELINES))
@pytest.mark.exhaustive_for("extra-trees")
def test_every_baseline_learns_gives_probabilities_and_repeats_itself(name: str) -> None:
    test = rhythms(30, seed=9)
    for features, pca in (("statistics", False), ("statistics", True), ("flattened", True)):
        once, again = fitted(name, features, pca), fitted(name, features, pca)
        read = once(test)
        assert read.shape == (30, 3) and read.dtype == np.float32
        assert read.sum(axis=1) == pytest.approx(np.ones(30), abs=1e-5)
        assert np.array_equal(read, again(test))
        if features == "statistics":
            assert (read.argmax(axis=1) == test.y).mean() > 0.8, (name, pca)
    assert BASELINES[name].title


@pytest.mark.parametrize("name", ["forest", "extra-trees", "mlp", "subspace-knn"])
def test_another_seed_is_another_program(name: str) -> None:
    test = rhythms(30, seed=9)
    noisy = replace(
        test,
        integers=test.integers + np.random.default_rng(3).integers(-400, 400, test.integers.shape).astype(np.int32),
    )
    assert not np.array_equal(fitted(name, seed=0)(noisy), fitted(name, seed=1)(noisy))


def test_scaling_and_pca_are_fitted_to_the_training_windows_only() -> None:
    train = rhythms()
    # Planted: windows to validate and to test of another level and size would show in a mean and in a direction.
    other = replace(rhythms(40, seed=5), integers=rhythms(40, seed=5).integers * 50 + 90_000)
    fit = ClassicalFit("knn", "flattened", True, SAMPLES, 0)
    with_them, without = fit(train, other), fit(train, rhythms(0))
    assert isinstance(with_them, FittedClassifier) and isinstance(without, FittedClassifier)
    with_them(other)
    flat = FEATURES["flattened"](train, SAMPLES)
    for reader in (with_them, without):
        scaler, pca = reader.model[0], reader.model[1]
        assert scaler.mean_ == pytest.approx(flat.mean(axis=0))
        assert scaler.scale_ == pytest.approx(flat.std(axis=0))
        assert scaler.n_samples_seen_ == len(train)
        scaled = (flat - flat.mean(axis=0)) / flat.std(axis=0)
        kept = np.cumsum(np.sort(np.linalg.eigvalsh(np.cov(scaled.T)))[::-1])
        assert pca.n_components_ == int(np.searchsorted(kept / kept[-1], 0.95)) + 1 < flat.shape[1]
    assert np.array_equal(with_them(train), without(train))


def test_an_unscaled_pca_reads_the_features_as_they_are_and_its_components_are_scaled() -> None:
    train = rhythms()
    # Planted: one sample with so much variance that nothing else counts, unless everything is scaled first.
    train = replace(train, integers=train.integers.copy())
    train.integers[:, 0, 0] = np.random.default_rng(2).integers(-(10**6), 10**6, len(train))
    unscaled, scaled = fitted_to(train, "unscaled"), fitted_to(train, True)
    pca, scaler = unscaled.model[0], unscaled.model[1]
    flat = FEATURES["flattened"](train, SAMPLES)
    assert pca.mean_ == pytest.approx(flat.mean(axis=0)) and pca.n_components_ == 1
    assert abs(pca.components_[0, 0]) > 0.999
    assert scaled.model[1].n_components_ > 3
    components = unscaled.model[:2].transform(flat)
    assert components.std(axis=0) == pytest.approx(1.0) and scaler.n_features_in_ == 1


def fitted_to(train: WindowSet, pca: Pca) -> FittedClassifier:
    reader = ClassicalFit("knn", "flattened", pca, SAMPLES, 0)(train, rhythms(0))
    assert isinstance(reader, FittedClassifier)
    return reader


def test_classical_programs_read_the_end_of_a_longer_window() -> None:
    long = rhythms(30, samples=80)
    past = np.random.default_rng(1).integers(-9000, 9000, (30, 2, 80 - SAMPLES))
    other = replace(long, integers=np.concatenate([past, long.integers[:, :, -SAMPLES:]], axis=2).astype(np.int32))
    reader = fitted("rbf-svm")
    assert np.array_equal(reader(long), reader(other))
    assert FEATURES["flattened"](long, SAMPLES).shape == (30, 2 * SAMPLES)
    assert FEATURES["paper-statistics"](long, SAMPLES).shape == (30, 16)
    assert FEATURES["statistics"](long, SAMPLES).shape == (30, 64)


def test_a_size_is_what_the_program_holds() -> None:
    small, large = (ClassicalFit("knn", "flattened", False, SAMPLES, 0)(rhythms(n), rhythms(0)) for n in (60, 600))
    # Nearest neighbours hold their windows: 540 more of 100 values of 8 bytes, and a class each.
    assert large.size_bytes - small.size_bytes == pytest.approx(540 * (100 * 8 + 8), rel=0.05)


def test_a_gesture_that_was_not_trained_on_gets_nothing() -> None:
    train = rhythms()
    two = train.take(np.flatnonzero(train.y != 1))
    for name in ("knn", "rbf-svm", "cubic-svm"):
        read = ClassicalFit(name, "statistics", False, SAMPLES, 0)(two, rhythms(0))(train)
        assert (read[:, 1] == 0).all() and read.sum(axis=1) == pytest.approx(np.ones(60), abs=1e-5)


def test_decision_values_keep_their_order() -> None:
    class Margins:
        classes_ = np.array([0, 2, 3])

        def decision_function(self, x: np.ndarray) -> np.ndarray:
            return x

    x = np.array([[2.2, 0.1, 1.0], [-500.0, 900.0, 3.0]])
    found = likelihoods(Margins(), x, 4)
    assert found.argmax(axis=1).tolist() == [0, 2] and np.isfinite(found).all()
    assert found[0, 3] > found[0, 2] > found[0, 1] == 0


def test_what_takes_too_long_is_left_out() -> None:
    asked = classical(["knn", "boosting"], ["statistics", "flattened"], [False, True], SAMPLES, 3)
    assert len(asked) == 7
    assert ("boosting", "flattened", False) not in {(c.name, c.features, c.pca) for c in asked}
    assert all(c.key["seed"] == 3 and c.key["library"].startswith("scikit-learn ") for c in asked)


@pytest.mark.parametrize(
    ("text", "network", "name", "title"),
    [
        ("lstm", RecurrentSpec("lstm"), "lstm", "LSTM (32)"),
        ("lstm:units=32:dropout=0", RecurrentSpec("lstm"), "lstm", "LSTM (32)"),
        (
            "lstm:dropout=.5:units=128", RecurrentSpec("lstm", 128, 1, 0.5),
            "lstm:units=128:dropout=0.5", "LSTM (128, dropout 0.5)",
        ),
        (
            "bilstm:units=512:layers=2:dropout=0.5", RecurrentSpec("bilstm", 512, 2, 0.5),
            "bilstm:units=512:layers=2:dropout=0.5", "BiLSTM (512, 2 layers, dropout 0.5)",
        ),
    ],
)  # fmt: skip
def test_a_recurrent_network_is_written_with_its_settings(
    text: str, network: RecurrentSpec, name: str, title: str
) -> None:
    assert parse_recurrent(text) == network == parse_recurrent(network.name)
    assert (network.name, network.title) == (name, title)


WRONG = (
    "512",
    "512:2:0.5",
    "unit=64",
    "dropot=.5",
    "units=0",
    "units=9999",
    "layers=9",
    "dropout=nan",
    "units=8:units=9",
)


@pytest.mark.parametrize("settings", WRONG)
def test_a_wrong_setting_of_a_recurrent_network_gets_one_sentence(settings: str) -> None:
    text = f"lstm:{settings}"
    with pytest.raises(ConfigError) as refused:
        parse_recurrent(text)
    said = str(refused.value)
    assert said.startswith(f"Model '{text}': after lstm, accepted are :units=NUMBER (1 to 4096), ")
    assert said.endswith("each at most once.")


def test_ids_of_recurrent_trainings_hold_every_setting_and_the_default_is_that_of_before() -> None:
    spec = TrainSpec(device="cpu")
    names = ["lstm", "lstm:units=8", "lstm:layers=2", "lstm:dropout=0.5"]
    default, *others = recurrent(names, 40, spec, [[0, 1]])
    assert default.key == {"version": 1, "units": 32, "samples": 40, "vectors": [[0, 1]], "training": spec.key()}
    assert [dict(other.key) for other in others] == [
        {**default.key, **change} for change in ({"units": 8}, {"layers": 2}, {"dropout": 0.5})
    ]
    assert [c.name for c in (default, *others)] == names and default.title == "LSTM (32)"
    (made,) = recurrent(["bilstm:units=6:layers=2:dropout=0.25"], 40, TrainSpec(epochs=1, device="cpu"), [])
    reader: Any = made.fit(rhythms(30), rhythms(0))
    cell = reader.net.cell
    assert (cell.hidden_size, cell.num_layers, cell.bidirectional, cell.dropout) == (6, 2, True, 0.25)
    assert reader.net.dropout.p == 0.25 and reader.samples == 40


def test_what_is_refused() -> None:
    train = rhythms()
    with pytest.raises(BadInput, match="gesture 1 only"):
        ClassicalFit("knn", "statistics", False, SAMPLES, 0)(train.take(np.flatnonzero(train.y == 1)), rhythms(0))
    with pytest.raises(ConfigError, match="Unknown baseline 'forrest'.* Did you mean 'forest'"):
        classical(["forrest"], ["statistics"], [False], SAMPLES, 0)
    with pytest.raises(ConfigError, match="Unknown features 'statistic'.* Did you mean 'statistics'"):
        classical(["forest"], ["statistic"], [False], SAMPLES, 0)
