"""The three matrices are a correlation, for every length, and the choice of lengths holds what it must."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.training.fast.transform import Lengths, lengths_for, matrices


@pytest.mark.parametrize(("outputs", "taps"), [(250, 14), (63, 41), (1, 3), (125, 126), (250, 250), (28, 19), (7, 2)])
def test_three_matrices_are_a_correlation(outputs: int, taps: int) -> None:
    lengths = lengths_for(outputs + taps - 1)
    rows = -(-outputs // lengths.short)
    m = matrices(lengths, taps, rows)
    random = np.random.default_rng(outputs)
    x, w = np.zeros(lengths.samples), random.normal(size=taps)
    x[: outputs + taps - 1] = random.normal(size=outputs + taps - 1)
    bias = 0.7
    half = (m.d1 @ x.reshape(lengths.long, lengths.short)).reshape(lengths.pairs, -1, 1)
    spectrum = (m.d2 @ half).reshape(-1)
    product = (spectrum * (m.g @ w)).reshape(lengths.pairs, -1, 1)
    back = (m.a2 @ product).reshape(lengths.long, lengths.short)
    y = (m.a1 @ np.vstack([back, np.full(lengths.short, bias)])).reshape(-1)[:outputs]
    expected = np.correlate(x[: outputs + taps - 1], w, "valid") + bias
    assert np.abs(y - expected).max() < 2e-6 * taps


def test_lengths_hold_the_samples_and_are_even_where_they_must() -> None:
    for samples in range(1, 600):
        found = lengths_for(samples)
        assert found.samples >= samples and found.long % 2 == 0
        assert found.samples < samples + 2 * found.short + 2
        assert found.planes * 2 == 3 * found.samples


def test_a_transform_costs_far_less_than_its_square() -> None:
    assert lengths_for(499).macs < 499 * 499 / 4
    assert Lengths(4, 26).macs == 104 * (26 + 12)
