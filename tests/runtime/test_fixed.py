"""The arithmetic of a deployed model, against plain whole numbers that leave no 32 bits on their way."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import BundleError
from plushsense.runtime.fixed import (
    InputScale,
    LogitScale,
    Requantize,
    exponentials,
    smooth,
    smoothing_weight,
    softmax,
    split_ratio,
)

pytestmark = pytest.mark.slow

ONE = 1 << 15


def s32(v: int) -> int:
    """A step of a computation in signed 32 bits."""
    assert -(1 << 31) <= v < 1 << 31
    return v


def u32(v: int) -> int:
    """A step of a computation in unsigned 32 bits."""
    assert 0 <= v < 1 << 32
    return v


def edged(low: int, high: int) -> st.SearchStrategy[int]:
    """Whole numbers of a range, its ends often."""
    return st.sampled_from((low, low + 1, high - 1, high)) | st.integers(low, high)


int32s = edged(-(1 << 31), (1 << 31) - 1)
shifts = edged(0, 30)
multipliers = edged(0, ONE - 1)


@settings(max_examples=200)
@given(int32s, int32s, edged(0, 16), multipliers, edged(-(1 << 30), (1 << 30) - 1), shifts)
def test_inputs(x: int, offset: int, before: int, multiplier: int, bias: int, after: int) -> None:
    scale = InputScale(*([v] for v in (offset, before, multiplier, bias, after)))  # type: ignore[arg-type]
    limit = s32((1 << (15 + before)) - 1)
    # The difference itself may need 33 bits: its size fits 32, and is held within the limit before it gets a sign.
    d = min(u32(abs(x - offset)), limit)
    d = s32(d if x >= offset else -d)
    wanted = s32(s32((d >> before) * multiplier) + bias) >> after
    assert scale.apply([x]).tolist() == [max(0, min(255, wanted))]


@settings(max_examples=200)
@given(int32s, shifts, multipliers, shifts)
def test_requantize(total: int, before: int, multiplier: int, after: int) -> None:
    scale = Requantize(*([v] for v in (before, multiplier, after)))  # type: ignore[arg-type]
    if total < 0:
        wanted = 0
    else:
        t = min(u32(total) >> before, 65535)
        wanted = min(u32(u32(t * multiplier) + (1 << (after - 1) if after else 0)) >> after, 255)
    assert scale.apply(np.array([total])).tolist() == [wanted]


@settings(max_examples=200)
@given(int32s, shifts, multipliers, shifts)
def test_logits(total: int, before: int, multiplier: int, after: int) -> None:
    scale = LogitScale(*([v] for v in (before, multiplier, after)))  # type: ignore[arg-type]
    t = max(-32768, min(32767, s32(total) >> before))
    wanted = s32(s32(t * multiplier) + (1 << (after - 1) if after else 0)) >> after
    assert scale.apply(np.array([total])).tolist() == [max(-16384, min(16384, wanted))]


def test_exponentials() -> None:
    coarse, fine = exponentials()
    assert coarse.tolist() == [round(65535 * math.exp(-i / 4)) for i in range(64)]
    assert fine.tolist() == [round(65535 * math.exp(-i / 256)) for i in range(64)]
    assert 0 <= coarse.min() <= coarse.max() < 1 << 16


logit_rows = st.lists(edged(-16384, 16384), min_size=2, max_size=255)


@settings(max_examples=150)
@given(logit_rows)
def test_softmax(logits: list[int]) -> None:
    coarse, fine = (table.tolist() for table in exponentials())
    top = max(logits)
    e = [0 if top - v >= 4096 else u32(coarse[(top - v) >> 6] * fine[(top - v) & 63]) >> 16 for v in logits]
    total = u32(sum(e))
    wanted = [u32(u32(v << 15) + (total >> 1)) // total for v in e]
    got = softmax(np.array(logits))
    assert got.tolist() == wanted
    # Each is rounded by itself, so that the sum is 1 up to half a step a class.
    assert abs(int(got.sum()) - ONE) <= len(logits) / 2
    exact = np.exp(np.array(logits) / 256 - top / 256)
    assert np.abs(got / ONE - exact / exact.sum()).max() < 2e-4 + len(logits) * 1e-5


def test_softmax_of_all_the_same_and_of_one_winner() -> None:
    assert softmax(np.full(255, 16384)).tolist() == [round(ONE / 255)] * 255
    assert softmax(np.array([-16384, 16384, -16384])).tolist() == [0, ONE, 0]


@settings(max_examples=150)
@given(edged(0, ONE << 12), edged(0, ONE), edged(1, ONE))
def test_smoothing(mean: int, probability: int, weight: int) -> None:
    d = s32((probability << 12) - mean)
    # As the C does it: in two halves, each of which fits 32 bits.
    high, low = s32(d >> 16), u32(d & 0xFFFF)
    part = s32(high * 2 * weight), u32(u32(low * weight) + (1 << 14)) >> 15
    wanted = s32(mean + part[0] + part[1])
    assert wanted == mean + ((d * weight + (1 << 14)) >> 15)
    assert smooth(np.array([mean]), np.array([probability]), weight).tolist() == [wanted]
    assert 0 <= wanted <= ONE << 12
    assert min(mean, probability << 12) <= wanted <= max(mean, probability << 12)


def test_smoothing_of_full_weight_follows_at_once() -> None:
    mean = smooth(None, np.array([100, 32668]), ONE)
    assert mean.tolist() == [100 << 12, 32668 << 12]
    assert smooth(mean, np.array([32768, 0]), ONE).tolist() == [1 << 27, 0]


def test_smoothing_of_the_least_weight_still_arrives() -> None:
    """With 12 more bits than a probability has, weight 1 moves the mean until it is within a probability's step."""
    mean, target = np.array([0, 1 << 27]), np.array([20000, 12768])
    for _ in range(500_000):
        mean = smooth(mean, target, 1)
    assert np.abs(mean - (target << 12)).max() <= ONE / 2
    assert np.abs((mean >> 12) - target).max() <= 4


@pytest.mark.parametrize("weight", [2, 100, 5000, 32767])
def test_smoothing_arrives(weight: int) -> None:
    mean = smooth(None, np.array([0, ONE]), weight)
    for _ in range(20 * ONE // weight):
        mean = smooth(mean, np.array([30000, 2768]), weight)
    assert np.abs(mean - (np.array([30000, 2768]) << 12)).max() <= ONE / weight / 2 + 1


def test_smoothing_weight() -> None:
    assert smoothing_weight(0, 0.05) == ONE
    assert smoothing_weight(1e9, 0.05) == 1
    assert smoothing_weight(0.3, 0.05) == round((1 - math.exp(-0.05 / 0.3)) * ONE)
    assert smoothing_weight(1e-6, 0.05) == ONE


@settings(max_examples=200)
@given(st.floats(1e-12, 1e4), st.floats(1, 1e6), st.sampled_from((22, 30)))
def test_a_ratio_is_kept_to_15_bits(ratio: float, full: float, most_after: int) -> None:
    highest = full / ratio
    before, multiplier, after = split_ratio(ratio, highest, most_after)
    assert 0 <= before <= 30
    assert 0 <= multiplier < ONE
    assert 0 <= after <= most_after
    if highest < 1 << 31:
        assert int(highest) >> before < ONE  # within the clamps of `Requantize` and `LogitScale`
    if multiplier >= 1 << 14:
        kept = multiplier / 2.0 ** (before + after)
        assert abs(kept / ratio - 1) <= 2**-15 or (multiplier == ONE - 1 and kept <= ratio)
    else:  # as fine as ``after`` allows
        assert after == most_after
        assert abs(multiplier - ratio * 2.0 ** (before + after)) <= 0.5


@settings(max_examples=150)
@given(st.floats(1e-7, 1.0), st.integers(0, (1 << 31) - 1))
def test_a_requantized_sum_is_the_product_rounded(ratio: float, total: int) -> None:
    row = split_ratio(ratio, 255 / ratio)
    got = int(Requantize(*([v] for v in row)).apply(np.array([total]))[0])  # type: ignore[arg-type]
    exact = min(total * ratio, 255)
    # Rounded, and 255 times what the two parts of the scale are off: one bit in 2^14 each.
    assert abs(got - exact) <= 0.5 + 255 * 2**-13


def test_nothing_to_scale() -> None:
    for ratio in (0.0, -1.0, math.inf, math.nan):
        assert split_ratio(ratio, 10.0) == (0, 0, 0)
    assert split_ratio(1e6, 255 / 1e6) == (0, ONE - 1, 0)  # whatever is above 0 saturates


def table(**changes: Any) -> dict[str, Any]:
    return {"before": [0, 1], "multiplier": [5, 6], "after": [7, 8]} | changes


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"before": [0, 31]}, "accepted are whole numbers from 0 to 30"),
        ({"multiplier": [5, 1 << 15]}, "from 0 to 32767"),
        ({"multiplier": [5, -1]}, "from 0 to 32767"),
        ({"after": [7]}, "1 after for 2 rows"),
        ({"after": [7.5, 8.0]}, "whole numbers"),
        ({"after": [[7, 8]]}, "whole numbers"),
    ],
)
def test_scales_that_the_toy_cannot_hold(changes: dict[str, Any], words: str) -> None:
    for kind in (Requantize, LogitScale):
        with pytest.raises(BundleError, match=words):
            kind(**{name: np.asarray(values) for name, values in table(**changes).items()})


@pytest.mark.parametrize("kind", [InputScale, Requantize, LogitScale])
def test_every_column_of_a_scale_at_the_ends_of_its_range(kind: type) -> None:
    ends = {
        "offset": (-(1 << 31), (1 << 31) - 1), "multiplier": (0, 32767), "bias": (-(1 << 30), (1 << 30) - 1),
        "before": (0, 16 if kind is InputScale else 30), "after": (0, 30),
    }  # fmt: skip
    for name in kind.RANGES:
        low, high = ends[name]
        columns = {other: np.array([0, 0]) for other in kind.RANGES}
        scale = kind(**columns | {name: np.array([low, high])})
        assert len(scale) == 2 and getattr(scale, name).tolist() == [low, high]
        for wrong in (low - 1, high + 1):
            with pytest.raises(BundleError, match=f"has {name} .0, {wrong}.; accepted are whole numbers from {low}"):
                kind(**columns | {name: np.array([0, wrong])})


def test_a_ratio_just_below_a_power_of_two_is_that_power() -> None:
    for power in (-15, -1, 0, 1, 14):
        before, multiplier, after = split_ratio(2.0**power * (1 - 1e-6), 1000.0)
        assert (before, multiplier, after) == (0, 1 << 14, 14 - power)
    assert split_ratio(1 - 1e-6, 1 << 20) == (6, 1 << 14, 8), "21 bits become 15"
    assert split_ratio(1 - 1e-6, 1 << 20, most_before=3) == (3, 1 << 14, 11)
    assert split_ratio(2.0**-14, 10.0, most_after=5) == (0, 0, 5) and split_ratio(2.0**-40, 10.0) == (0, 0, 30)
    assert split_ratio(32767.6, 0.0) == split_ratio(32767.0, 0.0) == (0, 32767, 0)
