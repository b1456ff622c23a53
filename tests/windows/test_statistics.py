"""Statistics of windows against values worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.windows.features import NAMES, statistics, statistics_in_order

RATE = 100.0


def of(*channels: np.ndarray) -> dict[str, np.ndarray]:
    """The statistics of one window, each (C,) by its name."""
    row = statistics(np.stack(channels)[None], RATE)[0]
    return dict(zip(NAMES, row.reshape(len(NAMES), len(channels)), strict=True))


def test_a_constant_has_a_level_and_nothing_else() -> None:
    found = of(np.full(250, 7), np.full(250, -3))
    for name, values in {
        "mean": (7, -3), "sd": (0, 0), "min": (7, -3), "max": (7, -3), "rms": (7, 3), "energy": (250 * 49, 250 * 9),
        "power 0-1 Hz": (0, 0), "power 1-3 Hz": (0, 0),
    }.items():  # fmt: skip
        assert found[name] == pytest.approx(values, abs=1e-9), name


@pytest.mark.parametrize(("hz", "band"), [(0.5, "power 0-1 Hz"), (2.0, "power 1-3 Hz"), (5.0, None)])
def test_a_sine_has_half_its_amplitude_squared_in_its_band(hz: float, band: str | None) -> None:
    # Ten seconds hold whole periods of each.
    time = np.arange(1000) / RATE
    found = of(40 + 6 * np.sin(2 * np.pi * hz * time))
    for name in ("power 0-1 Hz", "power 1-3 Hz"):
        assert found[name] == pytest.approx([18.0 if name == band else 0.0], abs=1e-9)
    assert found["mean"] == pytest.approx([40])
    assert found["sd"] == pytest.approx([np.sqrt(18)])
    assert found["rms"] == pytest.approx([np.sqrt(40**2 + 18)])
    assert found["energy"] == pytest.approx([1000 * (40**2 + 18)])


def test_a_frequency_on_the_border_counts_once_above_it() -> None:
    found = of(np.cos(2 * np.pi * np.arange(1000) / RATE))
    assert found["power 0-1 Hz"] == pytest.approx([0.0], abs=1e-9)
    assert found["power 1-3 Hz"] == pytest.approx([0.5])


@pytest.mark.parametrize("samples", [4, 5])
def test_all_bands_together_are_the_variance(samples: int) -> None:
    # At 4 Hz the bands 0–1 and 1–3 Hz hold every frequency up to half the rate, its highest one included.
    x = np.random.default_rng(1).integers(-9, 9, (3, 2, samples))
    found = statistics(x, 4.0).reshape(3, len(NAMES), 2)
    assert found[:, 6] + found[:, 7] == pytest.approx(x.var(axis=2))


def test_eleven_channels_give_88_in_a_stated_order_and_an_integer_is_as_good_as_a_float() -> None:
    x = np.random.default_rng(0).integers(-8000, 8000, (3, 11, 250)).astype(np.int32)
    found = statistics(x, RATE)
    names = [f"c{i} {name}" for name in NAMES for i in range(11)]
    assert found.shape == (3, 88) == (3, len(names))
    assert found[1, names.index("c4 max")] == x[1, 4].max()
    assert found[2, names.index("c10 rms")] == pytest.approx(np.sqrt((x[2, 10].astype(float) ** 2).mean()))
    assert np.array_equal(found, statistics(x.astype(np.float64), RATE))


def test_only_the_quarters_tell_a_rise_from_a_fall() -> None:
    rise = np.stack([np.arange(250), np.full(250, 3)])[None]
    fall = rise[:, :, ::-1]
    assert np.allclose(statistics(rise, RATE), statistics(fall, RATE))
    found = [statistics_in_order(x, RATE)[0] for x in (rise, fall)]
    assert found[0].shape == (32 * 2,) and np.array_equal(found[0][:16], statistics(rise, RATE)[0])
    quarters = found[0][16:].reshape(4, 6, 2)
    assert quarters[:, 0, 0] == pytest.approx([31, 94, 156.5, 218.5]) and (quarters[:, 0, 1] == 3).all()
    assert found[1][16:].reshape(4, 6, 2)[:, 0, 0] == pytest.approx(quarters[::-1, 0, 0], abs=2)
    assert statistics_in_order(rise[:, :, :2], RATE).shape == (1, (8 + 2 * 6) * 2)


def test_windows_of_nothing_are_refused() -> None:
    with pytest.raises(BadInput, match=r"\(2, 3, 0\)"):
        statistics(np.zeros((2, 3, 0)), RATE)
    with pytest.raises(BadInput, match="shape"):
        statistics(np.zeros((3, 250)), RATE)
