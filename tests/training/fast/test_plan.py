"""The way of a layer depends on its shape alone, and what is said of memory holds."""

from __future__ import annotations

import pytest

from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS, Arch
from plushsense.training.fast.plan import SPECTRA_BYTES, plan_layer, plan_net


def test_ways_of_layers() -> None:
    assert plan_layer(1, 1, 11, 8, 0, 250).way == "pointwise"
    assert plan_layer(3, 1, 64, 64, 2, 250).way == "direct"
    for taps, dilation in ((14, 1), (41, 4), (17, 8), (250, 1), (126, 2)):
        assert plan_layer(taps, dilation, 48, 64, (taps - 1) * dilation, 250).way == "spectral"


@pytest.mark.parametrize("padding", ["mirror", "stream"])
@pytest.mark.parametrize("symbol", PAPER_ARCHITECTURES)
def test_rows_fit_for_every_network_of_the_paper(symbol: str, padding: str) -> None:
    arch = Arch.parse(symbol, PAPER_FILTERS[3], padding=padding)
    plan = plan_net(arch, 64)
    assert tuple(layer.after for layer in plan.layers) == arch.positions
    buffers = plan.buffers
    for layer, held, written in zip(plan.layers, buffers, buffers[1:], strict=False):
        assert layer.needs <= held and layer.front + layer.before <= held
        assert layer.after <= layer.writes <= written


def test_spectra_stay_within_their_bound_and_memory_grows_with_the_batch() -> None:
    arch = Arch.parse("70_90_91", PAPER_FILTERS[3], padding="mirror")
    small, large = plan_net(arch, 64), plan_net(arch, 20_000)
    assert all(small.keeps) and not all(large.keeps)
    kept = sum(4 * p.spectra_floats * 20_000 for p, keep in zip(large.layers, large.keeps, strict=True) if keep)
    assert kept <= SPECTRA_BYTES
    assert small.bytes < 100e6 < large.bytes
    assert sum(layer.macs for layer in small.layers) < arch.macs_per_window / 10
