"""A bundle carries what its toy needs: ranges of training windows, and from them always the same whole numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from plushsense.core.errors import ArchError, BundleError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import load_layout
from plushsense.deploy.quantize import Ranges, calibrated, calibration, integer_model, integer_network, quantize
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.reference import divide_logits, random_weights
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.fixed import LOGIT_LIMIT
from plushsense.runtime.integer import MOST_REACH
from plushsense.windows.features import Scaler

GESTURES = GestureSet("three", (Gesture("tap", "positive"), Gesture("hold", "neutral"), Gesture("hit", "negative")))


def windows(seed: int = 0, n: int = 30, samples: int = 60) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.rint(np.cumsum(rng.normal(size=(n, 3, samples)), axis=2) * 300).astype(np.int32)


def make(padding: str = "stream", norm: str = "batch", pooling: str = "mean") -> Bundle:
    sizes = {"channels": 3, "classes": 3, "window": 48, "step": 4}
    arch = Arch.parse("5d1_4d3", (6, 5), padding=padding, norm=norm, pooling=pooling, **sizes)
    weights = random_weights(arch, 3)
    if pooling != "mean" and norm != "none":
        weights["norm1.gain"][0] *= -1
    return Bundle(arch, weights, load_layout("accel-3"), Scaler.fit(windows()), GESTURES)


def test_the_same_bundle_gives_the_same_image_also_once_it_was_saved() -> None:
    one, two = calibrated(make(), windows()), calibrated(make(), windows())
    image = integer_model(one).to_bytes()
    assert image == integer_model(two).to_bytes()
    assert image == integer_model(Bundle.from_bytes(one.to_bytes())).to_bytes()
    assert image != integer_model(calibrated(make(), windows() * 2)).to_bytes(), "the ranges matter"


@pytest.mark.parametrize(
    ("padding", "norm", "pooling"),
    [
        ("stream", "batch", "mean"),
        ("stream", "batch", "mean+deviation"),
        ("stream", "none", "mean+deviation"),
        ("mirror", "batch", "mean"),
        ("mirror", "none", "mean"),
    ],
)
def test_the_whole_numbers_answer_as_the_floats_do(padding: str, norm: str, pooling: str) -> None:
    bundle = calibrated(make(padding, norm, pooling), windows())
    x = windows(seed=1, n=200)
    expected = bundle.network().forward(bundle.scaler.apply(x))
    found = integer_network(bundle).forward(x) / 256
    assert (expected.argmax(axis=1) == found.argmax(axis=1)).mean() > 0.95
    assert np.abs(expected - found).max() < 0.15 * np.abs(expected).max()


@pytest.mark.parametrize("temperature", [0.4, 1.7, 6.0])
def test_a_temperature_divides_the_logits_and_changes_no_answer(temperature: float) -> None:
    plain = calibrated(make(), windows())
    bundle = replace(plain, weights=divide_logits(plain.weights, temperature))
    x = windows(seed=1, n=200)
    before, after = (b.network().forward(b.scaler.apply(x)) for b in (plain, bundle))
    np.testing.assert_allclose(after, before / temperature, rtol=1e-5, atol=1e-5)
    assert (after.argmax(axis=1) == before.argmax(axis=1)).all()
    one, other = integer_network(plain), integer_network(bundle)
    # Only the scale of the last sums changes, so the resolution of 8 bits stays what it is.
    assert np.array_equal(one.dense.weights, other.dense.weights) and np.array_equal(one.dense.bias, other.dense.bias)
    exact = np.clip(one.forward(x) / temperature, -LOGIT_LIMIT, LOGIT_LIMIT)
    np.testing.assert_allclose(other.forward(x), exact, rtol=1e-3, atol=1.5 + 1.5 / temperature)  # steps of 1/256


def test_the_biases_undo_what_rounding_the_weights_does_to_the_mean() -> None:
    bundle = calibrated(make(), windows())
    ranges = Ranges.from_dict(bundle.calibration)
    # Read as if every mean lay where 8 bits begin, nothing is undone.
    idle = replace(ranges, means=(ranges.low, *(np.zeros_like(m) for m in ranges.means[1:])))
    x = windows(seed=1, n=200)
    expected = bundle.network().forward(bundle.scaler.apply(x))
    far = [
        np.abs((quantize(bundle.arch, bundle.weights, bundle.scaler, r).forward(x) / 256 - expected).mean(axis=0)).max()
        for r in (ranges, idle)
    ]
    assert far[0] < far[1], far


def test_long_kernels_answer_nearly_as_in_floats() -> None:
    arch = Arch.parse("60d1_60d1", (4, 4), channels=3, classes=3, window=200, step=5)
    learnt, new = windows(0, 40, arch.span), windows(1, 40, arch.span)
    errors = []
    for seed in range(5):
        bundle = Bundle(arch, random_weights(arch, seed), load_layout("accel-3"), Scaler.fit(learnt), GESTURES)
        expected = bundle.network().forward(bundle.scaler.apply(new))
        found = integer_network(calibrated(bundle, learnt)).forward(new) / 256
        errors.append(np.sqrt(np.square(found - expected).mean()) / expected.std(axis=0).mean())
    # 1.2 % now; 2.6 % if the rounding errors are not carried to the next tap, 2.7 % if the ranges leave no room.
    assert np.mean(errors) < 0.018, errors


def test_many_large_weights_get_a_coarser_scale() -> None:
    """The sums of a filter stay within 24 bits, as the toy needs it."""
    arch = Arch.parse("130d1", (2,), channels=3, classes=3, window=200, step=5)
    even = random_weights(arch, 1)
    even["conv0.weight"] = np.sign(even["conv0.weight"])
    learnt = windows(0, 10, arch.span)
    bundle = Bundle(arch, even, load_layout("accel-3"), Scaler.fit(learnt), GESTURES)
    sums = np.abs(integer_network(calibrated(bundle, learnt)).layers[0].weights.astype(int)).sum(axis=(1, 2))
    assert 0.97 * MOST_REACH < sums.min() <= sums.max() <= MOST_REACH


def test_the_smoothing_is_the_bundles_by_default() -> None:
    bundle = calibrated(replace(make(), decision={"smoothing_s": 0.0}), windows())
    assert integer_model(bundle).smoothing == 1 << 15
    step_s = bundle.arch.step / bundle.layout.rate_hz
    assert integer_model(bundle, DecideSpec(0.3)).smoothing == round(-np.expm1(-step_s / 0.3) * 2**15)


def test_no_more_than_ranges_is_kept() -> None:
    bundle = make()
    kept = calibration(bundle.arch, bundle.weights, bundle.scaler, windows(n=500))
    again = calibration(bundle.arch, bundle.weights, bundle.scaler, windows(n=30))
    shapes = [{name: [np.shape(v) for v in values] for name, values in table.items()} for table in (kept, again)]
    assert shapes[0] == shapes[1], "what is kept does not grow with the recordings"
    assert Ranges.from_dict(kept).to_dict() == kept


@pytest.mark.parametrize(("padding", "norm", "named"), [("causal", "batch", "causal"), ("mirror", "layer", "layer")])
def test_what_cannot_be_deployed_has_no_calibration_and_says_why(padding: str, norm: str, named: str) -> None:
    bundle = make(padding, norm)
    assert calibration(bundle.arch, bundle.weights, bundle.scaler, windows()) == {}
    for refused in (integer_model, lambda b: calibrated(b, windows())):
        with pytest.raises(ArchError, match=named):
            refused(bundle)


def test_a_bundle_without_calibration_says_what_to_do() -> None:
    with pytest.raises(BundleError, match=r"no calibration.*train it again.*--dataset"):
        integer_model(make())
    old = calibrated(make(), windows())
    with pytest.raises(BundleError, match=r"lacks 'means'.*train it again.*--dataset"):
        integer_model(replace(old, calibration={k: v for k, v in old.calibration.items() if k != "means"}))
    with pytest.raises(BundleError, match="no windows to calibrate on"):
        calibrated(make(), windows()[:0])


@pytest.mark.parametrize(
    "broken",
    [
        {"means": None},
        {"low": [0.0] * 2},
        {"tops": [[1.0] * 6]},
        {"means": [[0.0] * 3, [1.0] * 6, [1.0] * 4]},
        {"high": [1.0, 2.0, None]},
        {"low": "x"},
    ],
)
def test_a_calibration_of_another_network_or_of_no_numbers_is_refused(broken: dict[str, object]) -> None:
    bundle = calibrated(make(), windows())
    kept = {name: value for name, value in (bundle.calibration | broken).items() if value is not None}
    with pytest.raises(BundleError, match="train (it )?again"):
        integer_model(replace(bundle, calibration=kept))


def test_inputs_that_spread_over_all_32_bits_are_scaled_too() -> None:
    bundle = make()
    rng = np.random.default_rng(4)
    x = rng.integers(-(1 << 31), 1 << 31, size=(20, bundle.arch.channels, bundle.arch.span + 10))
    wide = replace(bundle, scaler=Scaler.fit(x))
    network = integer_network(calibrated(wide, x))
    codes = network.inputs.apply(x.transpose(0, 2, 1))
    assert codes.min() < 8 and codes.max() > 247 and 120 < codes.mean() < 135


@pytest.mark.parametrize("key", ["low", "high", "tops", "means"])
@pytest.mark.parametrize("value", [1e19, -1e19, 1e300, -1e300, 10**400, 1e-300])
def test_a_calibration_out_of_range_gives_a_sentence_and_no_wrong_number(key: str, value: float) -> None:
    bundle = calibrated(make(), windows())
    table = bundle.calibration | {key: [*bundle.calibration[key]]}
    if key in ("low", "high"):
        table[key][1] = value
    else:
        table[key][1] = [value, *table[key][1][1:]]
    try:
        with np.errstate(all="ignore"):
            image = integer_model(replace(bundle, calibration=table)).to_bytes()
    except BundleError as refused:
        assert "again" in str(refused) or "fewer taps" in str(refused) or "accepted are" in str(refused)
    else:
        assert len(image) == len(integer_model(bundle).to_bytes()), "a value that saturates is no fault"
