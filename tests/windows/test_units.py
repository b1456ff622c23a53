"""Windows, networks and programs without scaling read values in the units of the layout, as the files have them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import plushsense as ps
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import Channel, CsvFormat, Derived, Layout, load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.store import Dataset
from plushsense.deploy.golden import measured
from plushsense.deploy.quantize import integer_network, integer_probabilities
from plushsense.experiments.baselines.models import FEATURES, ClassicalFit, FittedClassifier
from plushsense.live.plausibility import gravity_in_training
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import random_weights
from plushsense.runtime.machine import FloatLogits
from plushsense.windows.cut import WindowSet, WindowSpec
from plushsense.windows.features import InputUnits, Scaler, statistics
from plushsense.workflow.exchange import to_panel, to_torch

pytestmark = pytest.mark.apart("units")

Floats = NDArray[np.float64]
ROWS = WindowSpec(context="rows", window_s=1.0)

# A force of which 512 is none and 4 are a newton, and an acceleration in m/s², with an offset on one axis, whose
# magnitude is an input.
CHANNELS = (
    Channel("force", "N", "force", offset=512.0, scale=0.25),
    Channel("x", "m/s²", "acceleration", offset=0.5, step=0.01, valid_min=-99.0, valid_max=99.0),
    Channel("y", "m/s²", "acceleration", step=0.01, valid_min=-99.0, valid_max=99.0),
    Channel("z", "m/s²", "acceleration", step=0.01, valid_min=-99.0, valid_max=99.0),
)
COLUMNS = ("host_ms", "device_ms", "force", "x", "y", "z")
FORCE = Layout(
    name="force-4",
    title="A force and an acceleration",
    rate_hz=100.0,
    channels=CHANNELS,
    wire=COLUMNS[1:],
    derived=(Derived("size", "magnitude", ("x", "y", "z")),),
    inputs=("force", "x", "size"),
    csv=CsvFormat(COLUMNS, COLUMNS, ", "),
)
ACCEL = replace(
    load_layout("accel-3"),
    name="accel-fine",
    channels=tuple(
        replace(c, unit="m/s²", step=0.001, valid_min=-200.0, valid_max=200.0) for c in load_layout("accel-3").channels
    ),
)


def made(folder: Path, layout: Layout) -> Dataset:
    """Two people, each two recordings of two gestures, with gravity along z."""
    rng = np.random.default_rng(3)
    steps = np.array([c.step for c in layout.channels])
    rest = np.array([{"force": 600.0, "z": 9.81}.get(name, 0.5) for name in layout.names])
    size = np.array([40.0 if name == "force" else 2.0 for name in layout.names])
    for number in range(8):
        person, gesture = f"P{number % 2}", ("Shake", "Turn")[number // 4]
        wave = np.sin(np.arange(150)[:, None] * (0.1 + 0.2 * (number // 4)) + rng.uniform(0, 6, len(rest)))
        values = np.rint((rest + size * wave + rng.normal(0, 0.1, (150, len(rest)))) / steps).astype(np.int64)
        (folder / "src" / person).mkdir(parents=True, exist_ok=True)
        clock = np.arange(150, dtype=np.int64) * 10
        frames = Frames(values, clock, clock)
        write_recording(folder / "src" / person / f"{gesture}_{1000 + number}_150.csv", frames, layout)
    return ps.import_recordings(folder / "src", folder / "DS", layout=layout).dataset


@pytest.fixture(scope="module")
def force(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return made(tmp_path_factory.mktemp("force"), FORCE)


@pytest.fixture(scope="module")
def accel(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return made(tmp_path_factory.mktemp("accel"), ACCEL)


def from_files(dataset: Dataset, windows: WindowSet) -> Floats:
    """Return the measured channels (N, C, T) of windows that begin with their recording, read from the CSV."""
    read = [np.loadtxt(dataset.path / r.file, delimiter=",", skiprows=1)[:, 2:] for r in dataset.recordings]
    values = dict(zip((r.id for r in dataset.recordings), read, strict=True))
    return np.stack([values[windows.recording_ids[k]][:100].T for k in windows.recording])


def first_of_each(dataset: Dataset) -> tuple[WindowSet, Floats]:
    windows = ps.cut_windows(dataset, ROWS)
    windows = windows.take(np.unique(windows.recording, return_index=True)[1])
    assert len(windows) == 8
    return windows, from_files(dataset, windows)


def test_channels_are_as_in_the_file_and_a_magnitude_is_a_root(force: Dataset) -> None:
    windows, sent = first_of_each(force)
    assert windows.x.dtype == np.float32 and windows.units.names[1:] == ("m/s²", "m/s²")
    assert np.abs(windows.x[:, 0] - sent[:, 0]).max() == 0.0
    assert np.abs(windows.x[:, 1] - sent[:, 1]).max() < 1e-5
    apart = np.sqrt((sent[:, 1] - 0.5) ** 2 + sent[:, 2] ** 2 + sent[:, 3] ** 2) - windows.x[:, 2]
    assert apart.min() > -1e-5 and apart.max() < 0.01 / 16 + 1e-5
    only = windows.only(["size", "x"])
    assert np.array_equal(only.x, windows.x[:, [2, 1]]) and np.array_equal(
        windows.take(np.array([3])).x, windows.x[3:4]
    )


def test_vectors_and_gravity_are_in_the_unit_of_the_sensor(accel: Dataset) -> None:
    dataset = accel.with_inputs(accel.layout.for_vectors())
    windows, sent = first_of_each(dataset)
    assert windows.inputs[3:] == ("x_gravity", "y_gravity", "z_gravity")
    assert np.abs(windows.x[:, :3] - sent).max() < 1e-5
    mean = np.zeros(sent.shape[:2])
    for at in range(sent.shape[2]):
        # The running mean of the layout: its time constant is 64 samples, at the start the power of two below them.
        mean += (sent[:, :, at] - mean) * 2.0 ** -min(int(np.log2(at + 1)), dataset.layout.gravity_shift)
        assert np.abs(windows.x[:, 3:, at] - mean).max() < 2 * 0.001 / 16
    assert 7 < windows.x[:, 5].mean() < 11


def test_the_values_for_other_libraries_are_these(force: Dataset) -> None:
    windows, _ = first_of_each(force)
    assert np.array_equal(to_panel(windows)[0], windows.x)
    assert np.array_equal(to_torch(windows).tensors[0].numpy(), windows.x)


def test_all_steps_of_large_values_are_kept() -> None:
    units = InputUnits(np.array([100.0]), np.array([7.0]), ("V",))
    for peak, kind in ((1 << 20, np.float32), (1 << 30, np.float64)):
        x = np.array([[[peak, peak + 1, -peak, 0]]])
        values = units.values(x)
        assert values.dtype == kind and np.array_equal(np.rint(units.counted(values)), x)


@pytest.mark.parametrize("vectors", [False, True])
def test_a_classifier_with_a_layout_reads_these_values(force: Dataset, accel: Dataset, vectors: bool) -> None:
    # Imports scikit-learn, whose threads must not run where the tests are collected: see support/apart.py.
    from plushsense.workflow.estimator import to_integers

    dataset = accel.with_inputs(accel.layout.for_vectors()) if vectors else force
    windows, sent = first_of_each(dataset)
    assert np.array_equal(to_integers(windows.x, dataset.layout), windows.integers)
    assert np.array_equal(to_integers(windows.x.astype(np.float64), dataset.layout), windows.integers)
    if not vectors:
        root = np.sqrt((sent[:, 1] - 0.5) ** 2 + sent[:, 2] ** 2 + sent[:, 3] ** 2)
        given = np.stack([sent[:, 0], sent[:, 1], root], axis=1)
        assert np.abs(to_integers(given, dataset.layout) - windows.integers).max() <= 1
        given[:, 1, 7] /= 30  # scaled already
        with pytest.raises(ValueError, match=r"in 'x', which the layout 'force-4' counts in steps of 0.01: give x of"):
            to_integers(given, dataset.layout)


def unscaled(dataset: Dataset, arch: str = "5d1_3d2", norm: str = "batch") -> Bundle:
    """Train a network with ``--scaling none`` for an epoch."""
    trained = ps.train(
        dataset, arch=arch, filters="4,5", norm=norm, preset="search", context="rows", window_s=1.0, scaling="none",
        epochs=1, warn=lambda _: None,
    )  # fmt: skip
    return trained.bundle


@pytest.fixture(scope="module")
def reads_force(force: Dataset) -> Bundle:
    return unscaled(force)


def test_a_network_without_scaling_reads_these_values(force: Dataset, reads_force: Bundle) -> None:
    windows, sent = first_of_each(force)
    read = reads_force.scaler.apply(windows.integers)
    assert np.allclose(read, windows.x, rtol=1e-6, atol=0.0)
    assert np.abs(read[:, :2] - sent[:, :2]).max() < 1e-4, "as the file has them, with their offsets"
    again = Bundle.from_bytes(reads_force.to_bytes())
    expected = again.network().probabilities(windows.x[:, :, -again.arch.span :])
    classifier = ps.PlushClassifier.from_bundle(again)
    assert np.abs(classifier.predict_proba(windows.x) - expected).max() < 1e-5
    streamed = FloatLogits(again).push(windows.integers[0, :, -again.arch.span :].T)
    assert len(streamed) == 1 and np.abs(streamed / 256 - again.network().forward(read)[0]).max() <= 1 / 256


def test_its_eight_bits_read_the_same_inputs(force: Dataset, reads_force: Bundle) -> None:
    windows = ps.cut_windows(force, ROWS)
    expected = reads_force.network().probabilities(windows.x)
    found = integer_probabilities(integer_network(reads_force), windows.integers)
    assert np.abs(found - expected).max() < 0.05


def test_its_onnx_file_gives_its_answers_for_roots(force: Dataset, reads_force: Bundle) -> None:
    pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    from plushsense.deploy.convert import onnx

    windows, sent = first_of_each(force)
    root = np.sqrt((sent[:, 1] - 0.5) ** 2 + sent[:, 2] ** 2 + sent[:, 3] ** 2)
    given = np.stack([sent[:, 0], sent[:, 1], root], axis=1)[:, :, -reads_force.arch.span :].astype(np.float32)
    (found,) = ReferenceEvaluator(onnx.float_model(reads_force)).run(["logits"], {"raw": given})
    expected = reads_force.network().forward(windows.x[:, :, -reads_force.arch.span :])
    assert np.abs(np.asarray(found) - expected).max() < 1e-3 * max(1.0, np.abs(expected).max())


def test_a_vector_layer_without_scaling_reads_the_unit_of_the_sensor(accel: Dataset) -> None:
    bundle = unscaled(accel, arch="v9_5d2")
    windows = ps.cut_windows(accel.with_inputs(bundle.layout), ROWS)
    assert bundle.arch.vector is not None and bundle.layout.inputs[-1] == "z_gravity"
    assert np.allclose(bundle.scaler.apply(windows.integers), windows.x, rtol=1e-6)
    # Axes are read less their offset, whatever it is, so that they turn about zero, with one scale for all three.
    units = InputUnits(np.array([1.0, 100.0, 100.0, 100.0]), np.array([5.0, 7.0, 8.0, 9.0]), ("",) * 4)
    scaler = Scaler.none(units, [(1, 2, 3)])
    assert scaler.offset.tolist() == [-5.0, 0.0, 0.0, 0.0] and scaler.scale.tolist() == [1.0, 0.01, 0.01, 0.01]


def test_programs_without_scaling_read_these_values(force: Dataset) -> None:
    windows, sent = first_of_each(force)
    x = np.stack([sent[:, 0] - 512.0, sent[:, 1] - 0.5, windows.x[:, 2]], axis=1)
    samples = x.shape[2]
    assert np.allclose(FEATURES["paper-statistics"](windows, samples), statistics(x, 100.0), rtol=1e-4, atol=1e-4)
    assert np.allclose(FEATURES["flattened"](windows, samples), x.reshape(8, -1), rtol=1e-6)
    reader = ClassicalFit("knn", "paper-statistics", "unscaled", samples, 0)(windows, windows.take(np.arange(0)))
    assert isinstance(reader, FittedClassifier)
    # The component of the largest variance is that of the energy of the force, in the unit of the file.
    assert reader.model[0].mean_ == pytest.approx(statistics(x, 100.0).mean(axis=0), rel=1e-4, abs=1e-4)


def test_recurrent_networks_without_scaling_read_these_values(force: Dataset) -> None:
    from plushsense.training.recurrent import fit_recurrent
    from plushsense.training.spec import TrainSpec

    windows, _ = first_of_each(force)
    read = fit_recurrent(windows, TrainSpec(epochs=1, patience=None, scaling="none"), 40, units=2)
    assert np.allclose(read.scaler.apply(windows.integers), windows.x, rtol=1e-6)


def test_stored_results_of_integers_are_not_taken_for_these() -> None:
    from plushsense.experiments.baselines.models import classical
    from plushsense.training.spec import TrainSpec

    assert "reads" in TrainSpec(scaling="none").key() and "reads" not in TrainSpec().key()
    unscaled_pca, scaled_pca = classical(["knn"], ["flattened"], ["unscaled", True], 40, 0)
    assert "reads" in unscaled_pca.key and "reads" not in scaled_pca.key


def test_no_scaling_says_nothing_of_the_training(force: Dataset) -> None:
    layout = force.layout
    none = Scaler.none(InputUnits.of(layout))
    arch = Arch.parse("5d1_3d2", (4, 5), channels=3, classes=2, window=100)
    gestures = GestureSet("two", (Gesture("Shake"), Gesture("Turn")))
    for scaler in (none, Scaler(np.zeros(3), np.ones(3))):  # the second is that of earlier versions
        assert not scaler.knows_training(layout)
    windows = ps.cut_windows(force, ROWS)
    fitted = Scaler.fit(windows.integers)
    assert fitted.knows_training(layout)
    mean, spread = measured(layout, none)
    assert mean.tolist() == layout.zero_int.tolist() and spread[1] == pytest.approx(100.0 / np.sqrt(3), rel=1e-6)
    bundle = Bundle(arch, random_weights(arch, 1), ACCEL, Scaler.none(InputUnits.of(ACCEL)), gestures)
    assert gravity_in_training(bundle, [0, 1, 2]) is None
