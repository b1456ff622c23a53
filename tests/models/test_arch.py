"""The symbol of a network: what it parses to, what is counted from it, and what it says when it is wrong."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plushsense.core.errors import ArchError
from plushsense.models.arch import (
    DEFAULT_FILTERS,
    DEFAULT_SYMBOL,
    NORMS,
    PADDINGS,
    PAPER_ARCHITECTURES,
    PAPER_FILTERS,
    TABLE3,
    TABLE3_MISPRINT,
    VECTOR_SYMBOL,
    Arch,
    ConvLayer,
    parse_filters,
    parse_symbol,
    reflected,
    symbol_at_rate,
    symbol_within,
)

CELLS = [
    (symbol, filters, TABLE3[symbol][column])
    for symbol in PAPER_ARCHITECTURES
    for column, filters in enumerate(PAPER_FILTERS)
]


def agrees(count: int, printed: str) -> bool:
    """Whether a count meets a cell such as 13.2k to its printed digits, rounded or cut off."""
    digits = len(printed.removesuffix("k").partition(".")[2])
    thousands, unit = float(printed.removesuffix("k")), 10.0**digits
    return thousands in (round(count / 1000 * unit) / unit, math.floor(count / 1000 * unit) / unit)


def test_the_papers_table_3() -> None:
    assert len(CELLS) == 52
    counts = {(s, f): Arch.parse(s, f).parameters for s, f, _ in CELLS}
    assert sum(agrees(counts[s, f], printed) for s, f, printed in CELLS) == 36
    far = {
        (s, f[: len(parse_symbol(s))])
        for s, f, printed in CELLS
        if abs(counts[s, f] / (1000 * float(printed.removesuffix("k"))) - 1) > 0.04
    }
    assert far == {TABLE3_MISPRINT} == {("100_151", (32, 48))}
    assert Arch.parse("100_151", (32, 48)).parameters == 268_258


def test_the_papers_choice() -> None:
    arch = Arch.parse("14d1_39d2_41d4", (8, 12, 16), padding="mirror")
    assert arch.layers == (ConvLayer(14, 1, 8), ConvLayer(39, 2, 12), ConvLayer(41, 4, 16))
    assert (arch.parameters, arch.receptive_field, arch.span) == (13_262, 250, 250)
    assert arch.macs_per_window == arch.macs_per_step == 3_212_000
    assert arch.table3 == "13.2k"
    assert Arch.parse("14d1_39d2_41d4", (32, 48, 64)).parameters == 192_386
    streaming = Arch.parse("14d1_39d2_41d4", (8, 12, 16))
    assert (streaming.macs_per_sample, streaming.macs_per_step) == (12_848, 64_240)
    assert (streaming.pool, streaming.span) == (250, 499)


def test_our_default() -> None:
    arch = Arch.parse(DEFAULT_SYMBOL, DEFAULT_FILTERS)
    assert (arch.padding, arch.norm, arch.receptive_field) == ("stream", "batch", 122)
    assert (arch.pool, arch.span) == (125, 246)
    assert (arch.macs_per_sample, arch.macs_per_step) == (6_704, 33_520)
    # Rings of 14 x 11, 37 x 8, 73 x 12 bytes; 25 sums of 16 features in two bytes each.
    assert arch.state_bytes_int8 == 14 * 11 + 37 * 8 + 73 * 12 + 2 * 25 * 16
    # Layers compute 246 - 13, - 36, - 72 positions.
    assert arch.macs_per_window == 233 * 1232 + 197 * 1824 + 125 * 3648
    assert Arch.parse(DEFAULT_SYMBOL, DEFAULT_FILTERS, padding="causal").state_bytes_int8 == 250 * 11
    assert arch.table3 is None


@pytest.mark.parametrize(("kernel", "pool"), [(245, 5), (246, 5), (247, 250), (1, 250), (241, 10)])
def test_the_default_pool_takes_the_room_there_is(kernel: int, pool: int) -> None:
    assert Arch.parse(str(kernel), (4,)).pool == pool


def test_table3_belongs_to_the_papers_channels_and_filters() -> None:
    assert Arch.parse("250", (4,)).table3 == "11.2k"
    assert Arch.parse("250", (5,)).table3 is None
    assert Arch.parse("250", (4,), channels=3).table3 is None
    assert Arch.parse("19d1_19d2_19d4_17d8", (32, 48, 64, 64)).table3 == "165k"


@pytest.mark.parametrize("symbol", PAPER_ARCHITECTURES)
def test_symbols_are_spelt_as_in_the_paper(symbol: str) -> None:
    arch = Arch.parse(symbol, PAPER_FILTERS[1])
    assert arch.symbol == symbol
    assert 249 <= arch.receptive_field <= 255
    assert arch.pool == 250, "its receptive field leaves no room within the window"


BAD = [
    ("", 1), ("_14", 1), ("14__39", 4), ("14_", 4), ("14d", 4), ("14d_3", 4), ("0", 1), ("14_00d2", 4),
    ("14d1_39d0", 9), ("14x2", 3), ("14d2d3", 5), ("d2", 1), ("14 d2", 3), ("14D2", 3), ("-14", 1), ("1.5", 2),
    ("٣", 1), ("14\n", 3), ("1_2_3_4_5", 8), ("14d99999", 8), ("9" * 5000, 5), ("v14", 4), ("v_3", 2),
]  # fmt: skip


@pytest.mark.parametrize(("spec", "place"), BAD)
def test_errors_show_the_symbol_and_a_caret_at_the_place(spec: str, place: int) -> None:
    with pytest.raises(ArchError) as caught:
        Arch.parse(spec, (8, 12, 16))
    sentence, (shown, caret) = str(caught.value), caught.value.__notes__[0].split("\n")
    assert f"place {place}: accepted are up to 4 kernel lengths" in sentence
    assert shown == "    " + spec.replace("\n", "?")
    assert caret == " " * (4 + place - 1) + "^"


def test_too_few_filters_and_a_kernel_that_is_too_long() -> None:
    with pytest.raises(ArchError, match=r"place 10: 4 layers but only 3 filter counts \(8,12,16\)"):
        Arch.parse("14_39_41_17", (8, 12, 16))
    with pytest.raises(ArchError, match="kernel of layer 1 is 5000: accepted are whole numbers from 1 to 4096"):
        Arch.parse("5000", (8,))


@pytest.mark.parametrize(
    ("text", "place"), [("", 1), ("8,,12", 3), ("8,a", 3), ("8;12", 2), ("8,0", 3), ("8,", 3), ("8,-1", 3)]
)
def test_filters_as_text(text: str, place: int) -> None:
    assert parse_filters("8, 12 ,16") == parse_filters("8/12/16") == (8, 12, 16)
    with pytest.raises(ArchError, match=f"Filters .* place {place}:"):
        Arch.parse("14", text)


@pytest.mark.parametrize(
    ("setting", "why"),
    [
        ({"padding": "miror"}, "Did you mean 'mirror'"),
        ({"norm": "group"}, "accepted are batch, layer, none"),
        ({"channels": 0}, "channels is 0"),
        ({"classes": 1}, "classes is 1"),
        ({"window": 1}, "window is 1"),
        ({"step": 0}, "step is 0"),
        ({"step": 251}, "step is 251"),
        ({"pool": 127}, "give 125 or 130"),
        ({"pool": 0}, "pool is 0"),
        ({"pool": 125, "padding": "mirror"}, "leave pool out"),
        ({"channels": 2.0}, "channels is 2.0"),
        ({"pooling": "max"}, "accepted are mean, mean+deviation"),
        ({"pooling": "mean+deviation", "padding": "mirror"}, "needs the padding 'stream', not 'mirror'"),
    ],
)
def test_settings_that_do_not_fit(setting: dict[str, object], why: str) -> None:
    with pytest.raises(ArchError) as caught:
        Arch.parse("14", (8,), **setting)  # type: ignore[arg-type]
    assert why in str(caught.value)


numbers = st.integers(1, 60)
shapes = st.lists(st.tuples(numbers, st.integers(1, 9)), min_size=1, max_size=4)


@given(shapes, st.sampled_from(PADDINGS), st.sampled_from(NORMS), st.integers(1, 20), st.integers(20, 400))
@pytest.mark.slow
def test_what_is_written_is_read_back(
    shape: list[tuple[int, int]], padding: str, norm: str, step: int, window: int
) -> None:
    spec = "_".join(f"{k}d{d}" for k, d in shape)
    arch = Arch.parse(spec, (4, 6, 8, 8), padding=padding, norm=norm, step=step, window=window)
    assert parse_symbol(arch.symbol) == (None, tuple(shape))
    assert Arch.from_dict(json.loads(json.dumps(arch.to_dict()))) == arch
    if padding == "stream":
        assert arch.pooled % step == 0
        room = arch.receptive_field + step - 1 <= window
        assert (arch.span <= window < arch.span + step) if room else (window - step < arch.pooled <= window)
        assert arch.positions[-1] == arch.pooled
    assert sum(m * n for m, n in zip(arch.macs_per_position, arch.positions, strict=True)) == arch.macs_per_window


def test_parameters_are_the_learnable_tensors() -> None:
    batch, layer, none = (Arch.parse("5_3d2", (2, 3), channels=4, classes=6, norm=n) for n in NORMS)
    assert none.parameters == layer.parameters - 2 * (2 + 3)
    assert batch.parameters == layer.parameters == (5 * 4 * 2 + 2) + (3 * 2 * 3 + 3) + 2 * (2 + 3) + (3 * 6 + 6)
    assert set(batch.weight_shapes) - set(layer.weight_shapes) == {
        "norm0.mean",
        "norm0.var",
        "norm1.mean",
        "norm1.var",
    }


def test_networks_with_a_vector_layer_pool_deviations_too_and_earlier_ones_do_not() -> None:
    arch = Arch.parse("v14_17d2_19d4", (6, 16, 16), channels=6)
    assert (arch.pooling, arch.features, arch.weight_shapes["dense.weight"]) == ("mean+deviation", 32, (18, 32))
    plain = Arch.parse("v14_17d2_19d4", (6, 16, 16), channels=6, pooling="mean")
    assert arch.parameters == plain.parameters + 16 * 18
    table = arch.to_dict()
    assert Arch.from_dict(table) == arch and table.pop("pooling") == "mean+deviation"
    # As bundles from before have it.
    assert Arch.from_dict(table) == plain and plain.to_dict() == table
    assert Arch.parse("14", (8,)).pooling == "mean"


@pytest.mark.parametrize("table", [{"filters": [8]}, {"symbol": "14"}, {"symbol": 14, "filters": [8]}])
def test_from_dict_refuses_what_is_incomplete(table: dict[str, object]) -> None:
    with pytest.raises(ArchError):
        Arch.from_dict(table)
    with pytest.raises(ArchError, match="Did you mean 'window'"):
        Arch.from_dict({"symbol": "14", "filters": [8], "windw": 250})


@given(st.integers(2, 40), st.integers(0, 200))
def test_reflection_is_numpys(length: int, left: int) -> None:
    expected = np.pad(np.arange(length), (left, 0), mode="reflect")
    assert reflected(length, left).tolist() == expected.tolist()


def test_default_kernels_last_as_long_at_other_rates() -> None:
    assert symbol_at_rate(DEFAULT_SYMBOL, 100) == symbol_at_rate(DEFAULT_SYMBOL, 90) == DEFAULT_SYMBOL
    assert symbol_at_rate(VECTOR_SYMBOL, 25) == "v4_9d1_19d1"
    assert symbol_at_rate("14d1_19d2_19d4", 200) == "14d2_19d4_19d8"
    for rate in (10, 20, 25, 50, 60, 200, 1000):
        arch = Arch.parse(symbol_at_rate(DEFAULT_SYMBOL, rate), (8, 12, 16), window=round(2.5 * rate))
        assert 1.0 <= arch.receptive_field / rate <= 1.35 and arch.span <= 2.5 * rate
        assert arch.parameters <= Arch.parse(DEFAULT_SYMBOL, (8, 12, 16)).parameters


@pytest.mark.slow
def test_a_network_is_shortened_to_what_a_window_holds() -> None:
    assert symbol_within(DEFAULT_SYMBOL, 122) == DEFAULT_SYMBOL
    assert symbol_within(VECTOR_SYMBOL, 30) == "v4_9d1_19d1"
    assert [symbol_within(DEFAULT_SYMBOL, n) for n in (1, 2, 4)] == ["1d1", "2d1", "2d1_3d1"]
    for samples in range(2, 122):
        arch = Arch.parse(symbol_within(DEFAULT_SYMBOL, samples), (8, 12, 16), window=samples, step=1)
        assert 0.78 * samples <= arch.receptive_field <= arch.span <= samples
