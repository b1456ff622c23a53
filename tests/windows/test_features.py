import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plushsense.core.errors import BadInput
from plushsense.core.layouts import load_layout, magnitude_limit
from plushsense.windows.features import RunningMean, SampleInputs, Scaler, magnitude, network_inputs
from support.fakes import plain_units

LIMIT = magnitude_limit(3)


@given(st.lists(st.integers(-LIMIT, LIMIT) | st.sampled_from([LIMIT, -LIMIT]), min_size=3, max_size=3))
@pytest.mark.slow
def test_magnitude_is_the_exact_floor(parts: list[int]) -> None:
    assert int(magnitude(np.array([parts]))[0]) == math.isqrt(sum(v * v for v in parts) << 8)


def test_magnitude_has_four_fraction_bits() -> None:
    assert magnitude(np.array([[3, 4, 0], [1, 1, 0]])).tolist() == [80, 22]
    assert int(magnitude(np.full((1, 3), LIMIT))[0]) < 2**31
    with pytest.raises(BadInput, match="32 bits"):
        magnitude(np.array([[LIMIT + 1, 0, 0]]))


def test_plush_inputs_replace_the_axes_by_their_magnitude() -> None:
    layout = load_layout("plush-15")
    rng = np.random.default_rng(0)
    values = rng.integers(-32768, 32768, (50, 13))
    batch = network_inputs(values, layout)
    assert batch.shape == (50, 11)
    assert np.array_equal(batch[:, :10], values[:, :10])
    one = SampleInputs(layout)
    assert [one(v) for v in values] == batch.tolist(), "sample by sample is the same"


def test_scaler_is_the_z_score_and_survives_constant_channels() -> None:
    rng = np.random.default_rng(0)
    x = rng.integers(-100, 100, (40, 3, 25)).astype(np.int32)
    x[:, 1] = 7
    scaler = Scaler.fit(x)
    out = scaler.apply(x)
    assert out.dtype == np.float32
    assert np.allclose(out[:, [0, 2]].mean(axis=(0, 2)), 0, atol=1e-5)
    assert np.allclose(out[:, [0, 2]].std(axis=(0, 2)), 1, atol=1e-5)
    assert np.all(out[:, 1] == 0)
    assert np.array_equal(scaler.apply_sample(x[3, :, 4]), out[3, :, 4])
    again = Scaler.from_dict(scaler.to_dict())
    assert np.array_equal(again.apply(x), out)


def test_gravity_is_the_running_mean_in_plain_integers() -> None:
    """A stream, a segment and the rule of the docstring agree; the state begins again with a segment."""
    layout = load_layout("accel-3").for_vectors()
    rng = np.random.default_rng(0)
    values = rng.integers(-32768, 32768, (400, 3))
    rows = network_inputs(values, layout)
    inputs = SampleInputs(layout)
    for _ in range(2):
        assert [inputs(sample) for sample in values.tolist()] == rows.tolist()
        inputs.reset()
    state = 0
    for n, x in enumerate(values[:, 0].tolist(), 1):
        shift = min(int(np.log2(n)), layout.gravity_shift)
        state += ((x << 10) - state) >> shift
        assert -(1 << 31) <= state < 1 << 31
        assert rows[n - 1, 3] == state >> 6


def test_a_running_mean_of_many_samples_is_that_of_one_at_a_time() -> None:
    x = np.random.default_rng(0).integers(-32768, 32768, 700)
    for cuts in ([], [3, 200], [64, 64, 650]):
        one, many = RunningMean(6), RunningMean(6)
        means = [many.push_all(part) for part in np.split(x, cuts)]
        assert np.concatenate(means).tolist() == [one.push(v) for v in x.tolist()], cuts


def test_gravity_is_known_soon_follows_a_turn_and_survives_shaking() -> None:
    layout = load_layout("accel-3").for_vectors()
    still = np.tile([0, 0, 8000], (50, 1))
    turned = np.tile([8000, 0, 0], (400, 1))
    shaken = turned + np.rint(20_000 * np.sin(np.arange(400) / 3))[:, None].astype(np.int64) * [0, 1, 1]
    gravity = network_inputs(np.concatenate([still, turned, shaken]), layout)[:, 3:] / 16
    assert np.allclose(gravity[0], [0, 0, 8000])
    assert np.allclose(gravity[449], [8000, 0, 0], atol=400)
    away = np.degrees(np.arccos(gravity[500:, 0] / np.linalg.norm(gravity[500:], axis=1)))
    assert away.mean() < 12


def test_inputs_are_distances_from_the_offset_of_a_channel() -> None:
    """An analogue accelerometer rests at some hundred counts."""
    plain = load_layout("accel-3")
    channels = tuple(replace(c, offset=330.0, valid_min=0.0, valid_max=1023.0) for c in plain.channels)
    layout = replace(plain, channels=channels).for_vectors()
    values = np.array([[330, 330, 430], [330, 430, 330]])
    assert network_inputs(values, layout)[:, :3].tolist() == [[0, 0, 100], [0, 100, 0]]
    assert network_inputs(values, layout)[0, 3:].tolist() == [0, 0, 1600]


def test_no_scaling_changes_nothing_and_vectors_keep_their_zero() -> None:
    x = np.array([[[3, 4, 5], [10, 10, 10], [0, 30, 0]]], dtype=np.int32)
    assert np.array_equal(Scaler.none(plain_units(3)).apply(x), x)
    scaler = Scaler.fit(x, [(1, 2)])
    assert scaler.offset.tolist() == [4.0, 0.0, 0.0]
    # Mean squares of the two axes: 100 and 300.
    assert scaler.scale == pytest.approx([1 / np.sqrt(2 / 3), 1 / np.sqrt(200), 1 / np.sqrt(200)])
