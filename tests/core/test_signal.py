from pathlib import Path

import pytest

from plushsense.core.errors import LayoutError
from plushsense.core.layouts import Layout, StreamColumns, layout_names, load_layout

OWN = """
name = "pad"
rate_hz = 50.0
channels = [
    { name = "a", unit = "count", kind = "capacitive" },
    { name = "b", unit = "V", kind = "capacitive", step = 0.5 },
]
wire = ["a", "b", "device_ms"]
"""


def test_built_in_layouts_have_the_shapes_of_the_design() -> None:
    shapes = {n: (load_layout(n).n_channels, load_layout(n).n_inputs, len(load_layout(n).wire)) for n in layout_names()}
    assert shapes == {
        "plush-15": (13, 11, 15),
        "plush-14": (13, 11, 14),
        "accel-3": (3, 3, 4),
        "phone-6": (6, 6, 7),
    }


def test_plush_15_is_table_1_of_the_paper() -> None:
    layout = load_layout("plush-15")
    assert layout.wire[:2] == ("cap_all", "cap_extremities")
    assert layout.wire[2:10] == ("ears", "head", "neck", "proximity", "nose", "tail", "back", "belly")
    assert layout.wire[10:] == ("acc_x", "acc_y", "acc_z", "device_ms", "delay_ms")
    assert layout.inputs == (*layout.names[:10], "acc_magnitude")
    assert layout.valid_min_int[0] == -2000
    assert load_layout("accel-3").valid_min_int[0] < -6992, "at rest an axis reads -6992"


def test_a_users_own_layout(tmp_path: Path) -> None:
    path = tmp_path / "pad.toml"
    path.write_text(OWN)
    layout = load_layout(path)
    assert layout.inputs == ("a", "b")
    assert layout.period_us == 20_000
    assert layout.csv.columns == ("host_ms", "device_ms", "a", "b")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("rate_hs = 1.0", r"Unknown key 'rate_hs' .* Did you mean 'rate_hz'\?"),
        ('inputs = ["c"]', r"inputs names 'c'; known are a, b"),
        ("rate_hz = 0.0", "not valid TOML"),
        ('csv = { colums = ["a"] }', r"'colums'.*Did you mean 'columns'"),
        ('derived = [{ name = "m", kind = "norm", of = ["a"] }]', "is the norm of a: accepted"),
        ('derived = [{ name = "m", kind = "magnitude", of = ["a"] }]', "'a' feeds 'm'.*valid_min and valid_max"),
        ('csv = { columns = ["a", "b", "device_ms"], header = ["A", "B"] }', "csv.header has 2 texts for 3 columns"),
        ("inputs = [1]", "inputs.0. is 1: accepted is text"),
        ('inputs = "ab"', "inputs is 'ab': accepted is a list of texts"),
        ("csv = { separator = 5 }", "csv.separator is 5: accepted is text"),
        ('derived = ["m"]', "derived.0. is 'm': accepted is a table"),
    ],
)
def test_a_wrong_layout_is_refused_in_one_sentence(tmp_path: Path, change: str, said: str) -> None:
    path = tmp_path / "pad.toml"
    path.write_text(OWN + change + "\n")
    with pytest.raises(LayoutError, match=said) as refusal:
        load_layout(path)
    assert "\n" not in str(refusal.value)


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(LayoutError, match=r"Unknown layout 'plush15'.*Did you mean 'plush-15'\?"):
        load_layout("plush15")


def test_a_layout_without_a_clock_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pad.toml"
    path.write_text(OWN.replace(', "device_ms"]', "]"))
    with pytest.raises(LayoutError, match="no clock"):
        load_layout(path)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"name": 5}, "name is 5"),
        ({"valid_min": "low"}, "valid_min is 'low'"),
        ({"step": 0.0}, "step is 0"),
        ({"step": float("nan")}, "step is nan"),
        ({"valid_min": 5.0, "valid_max": 1.0}, "must rise"),
        ({"valid_min": -200.0, "valid_max": 200.0, "step": 1e-8}, "fit 32-bit"),
    ],
)
def test_a_channel_that_cannot_be_is_refused(entry: dict[str, object], said: str) -> None:
    table = load_layout("accel-3").to_dict()
    table["channels"][0].update(entry)
    with pytest.raises(LayoutError, match=said):
        Layout.from_dict(table)


def test_valid_ranges_fit_32_bits_and_so_does_the_magnitude() -> None:
    for layout in map(load_layout, layout_names()):
        assert (layout.valid_min_int >= -(2**31)).all() and (layout.valid_max_int < 2**31).all()
    table = load_layout("plush-15").to_dict()
    for entry in table["channels"]:
        if entry["name"].startswith("acc"):
            entry.update(valid_min=-7.7e7, valid_max=7.7e7)
    layout = Layout.from_dict(table)
    widest = int(layout.valid_max_int[-1])
    assert 16 * widest * 3**0.5 < 2**31
    table["channels"][-1]["valid_max"] = 7.8e7
    with pytest.raises(LayoutError, match="'acc_z' feeds"):
        Layout.from_dict(table)


def test_a_range_that_nobody_gave_is_that_of_the_integers(tmp_path: Path) -> None:
    path = tmp_path / "pad.toml"
    path.write_text(OWN)
    layout = load_layout(path)
    assert (layout.valid_min_int == -(2**31)).all() and (layout.valid_max_int == 2**31 - 1).all()
    assert Layout.from_dict(layout.to_dict()) == layout


def test_columns_by_label_by_header_and_by_position() -> None:
    plush, accel = load_layout("plush-15"), load_layout("accel-3")
    names, first = plush.names, tuple(range(13))

    def match(layout: Layout, labels: list[str], width: int, exact: bool = True) -> tuple[object, ...]:
        found = layout.match_columns(labels, width, exact)
        assert isinstance(found, StreamColumns)
        return found.channels, found.clock, len(found.notes)

    assert match(plush, [*reversed(names)], 13) == (tuple(reversed(first)), None, 0)
    headed = [" Device_MS", "other", *(n.upper() for n in names)]
    assert match(plush, headed, 15) == (tuple(range(2, 15)), 0, 0)
    assert match(plush, headed, 15, exact=False) == (tuple(range(2, 15)), None, 1)
    assert match(accel, ["Arduino Timestamp (ms)", "Z", "Y", "X"], 4) == ((3, 2, 1), 0, 0)
    assert match(plush, [], 13) == match(plush, [f"Ch{i}" for i in first], 13) == (first, None, 1)
    assert match(plush, ["?"] * 15, 15) == match(plush, [f"Channel {i}" for i in range(15)], 15) == (first, 13, 1)
    assert match(load_layout("plush-14"), [], 14) == (first, None, 1)
    assert match(accel, [], 4) == ((1, 2, 3), 0, 1), "device_ms comes first on this layout's wire"
    found = accel.match_columns(["1", "2", "3"], 3)
    assert isinstance(found, StreamColumns)
    assert found.notes[0] == "its channels have no names: its 3 values are taken for x, y, z, in this order"


@pytest.mark.parametrize(
    ("labels", "width", "reason"),
    [
        ([], 8, "it has 8 channels, and layout 'accel-3' needs 3, or the 4 of its wire format"),
        (["Fp1", "Fp2"], 2, "its 2 channels are Fp1, Fp2, and those of layout 'accel-3' x, y, z"),
        (["gx", "gy", "gz"], 3, "its 3 channels are gx, gy, gz, and those of layout 'accel-3' x, y, z"),
        (["device_ms", "gx", "gy", "gz"], 4, "its 4 channels are device_ms, gx, gy, gz, and those of"),
        (["x", "y", "z"], 4, "its header names 3 channels (x, y, z), and its samples have 4 values"),
        (["x", "y", "q"], 3, "its labels do not name z exactly once"),
        (["x", "y", "z", "x"], 4, "its labels do not name x exactly once"),
    ],
)
def test_a_stream_that_does_not_fit(labels: list[str], width: int, reason: str) -> None:
    assert str(load_layout("accel-3").match_columns(labels, width)).startswith(reason)


@pytest.mark.parametrize(
    ("rate_hz", "gap_ms"), [(50.0, 0), (50.0, -1), (50.0, 60_001), (10_000.0, 6_001), (50.0, 10**12)]
)
def test_a_gap_that_would_fill_the_memory_is_refused(rate_hz: float, gap_ms: int) -> None:
    table = load_layout("accel-3").to_dict()
    with pytest.raises(LayoutError, match="gap_ms"):
        Layout.from_dict(table | {"rate_hz": rate_hz, "gap_ms": gap_ms})
    assert Layout.from_dict(table | {"rate_hz": 100.0, "gap_ms": 60_000}).gap_ms == 60_000


def test_the_axes_of_a_vector_are_of_one_kind() -> None:
    table = load_layout("accel-3").to_dict()
    channels = [dict(c) for c in table["channels"]]
    channels[0]["kind"] = "other"
    with pytest.raises(LayoutError, match="different kinds"):
        Layout.from_dict(table | {"channels": channels})
