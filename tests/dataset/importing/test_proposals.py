"""What an import finds out by itself: layout, rate, gap, zero of an accelerometer, window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.core.sentences import Message
from plushsense.dataset.importing.guessing import guess_pattern
from plushsense.dataset.importing.importers import ADOPTED, import_recordings
from plushsense.dataset.importing.proposals import Sensor, find_sensors
from plushsense.dataset.importing.sources import readable_layouts
from plushsense.dataset.index import open_dataset
from plushsense.dataset.quality.checking import check
from plushsense.dataset.quality.outliers import far_inputs, find_failed_readings
from plushsense.dataset.readings import Readings
from plushsense.runtime.classifier import check_layout
from plushsense.windows.clock import SampleClock, resample
from plushsense.windows.cut import WindowSpec, cut_windows
from plushsense.windows.features import Scaler
from support.accelerometers import ACCEL, analogue

pytestmark = pytest.mark.apart("real-recordings")


@pytest.mark.parametrize(("zero", "one_g"), [(330.0, 68.0), (511.0, 102.0)])
def test_the_zero_of_an_analogue_accelerometer_is_found_and_adopted(tmp_path: Path, zero: float, one_g: float) -> None:
    source = analogue(tmp_path / "R", zero, one_g)
    done = import_recordings(source, tmp_path / "DS", layout="accel-3", adopt_proposals=False)
    offset = next(p for p in done.proposals if p.key == "offset")
    assert all(abs(value - zero) < 0.05 * one_g for value in offset.value.values())
    assert "give a layout with offset" in offset.advice and not offset.adopted and not done.notes
    assert [c.offset for c in done.dataset.layout.channels] == [0, 0, 0]
    adopted = import_recordings(source, tmp_path / "ADOPTED", layout="accel-3")
    assert "adopted" in adopted.proposals[0].advice and adopted.proposals[0].adopted
    (note,) = (n for n in adopted.notes if isinstance(n, Message) and n.template == ADOPTED)
    assert adopted.proposals[0].reason in note and note.values["settings"][0].startswith("offset: x ")
    for dataset in (adopted.dataset, open_dataset(tmp_path / "ADOPTED")):
        assert [c.offset for c in dataset.layout.channels] == list(offset.value.values())
    assert not [p for p in import_recordings(source, tmp_path / "AGAIN", layout=adopted.dataset.layout).proposals
                if p.key == "offset"]  # fmt: skip


def test_a_zero_that_cannot_be_known_is_not_proposed(tmp_path: Path) -> None:
    flat = import_recordings(analogue(tmp_path / "R", 330, 68, turned=False), tmp_path / "DS", layout="accel-3")
    assert "offset" not in {p.key for p in flat.proposals}
    right = import_recordings(analogue(tmp_path / "Q", 0, 8000), tmp_path / "DS2", layout="accel-3")
    assert "offset" not in {p.key for p in right.proposals}


@pytest.mark.parametrize("person", range(8))
def test_a_zero_does_not_follow_from_a_few_directions_near_each_other(tmp_path: Path, person: int) -> None:
    """A toy that stands, tilted by up to 25°: four to six directions lie on many spheres, most of them wrong."""
    source = tmp_path / "R" / "P0"
    source.mkdir(parents=True)
    rng, clock = np.random.default_rng(person), np.arange(300, dtype=np.int64) * 10
    for take in range(6):
        tilt, around = rng.uniform(0, np.deg2rad(25)), rng.uniform(0, 2 * np.pi)
        up = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
        values = 16384 * rng.normal(1, 0.01) * up + rng.normal(0, 20, (300, 3))
        frames = Frames(np.round(values).astype(np.int64), clock, clock + 1_700_000_000_000)
        write_recording(source / f"Stand_{1_700_000_000_000 + take}_300.csv", frames, ACCEL)
    done = import_recordings(tmp_path / "R", tmp_path / "DS", layout="accel-3")
    assert not done.sensors and not {p.key for p in done.proposals} & {"offset", "unit"}
    (rest,) = Readings.of(done.dataset, ["P0"]).rest
    assert rest.is_estimated and rest.one_g == pytest.approx(16384, rel=0.05)


def test_two_references_of_an_analogue_converter_are_named(tmp_path: Path, cli: Callable[..., Any]) -> None:
    source = analogue(tmp_path / "R", 330, 68)
    ran = cli("import", source, tmp_path / "DS", "--layout", "accel-3", "--no-adopt")
    assert "suggestion: held still" in ran.err and "offset: x 3" in ran.err and "adopted" not in ran.err
    ran = cli("import", analogue(source, 511, 102, people=range(3, 5)), tmp_path / "DS", "--add")
    assert "suggestion: the accelerometers of the sessions differ in zero or scale: 1 g is about 68" in ran.err
    assert "for P0, P1, P2; 1 g is about 10" in ran.err
    assert 'give a layout with self_calibration = ["x", "y", "z"]' in ran.err
    adopted = import_recordings(source, tmp_path / "DS2", layout="accel-3")
    assert [c.offset for c in adopted.dataset.layout.channels] == [0, 0, 0], "no zero fits both"
    assert open_dataset(tmp_path / "DS2").layout.self_calibration == ("x", "y", "z")
    assert adopted.proposals[0].advice == 'adopted self_calibration = ["x", "y", "z"]'
    wide = load_layout("accel-3")
    wide = replace(wide, channels=tuple(replace(c, valid_max=1e6) for c in wide.channels))
    kept = import_recordings(source, tmp_path / "WIDE", layout=wide)
    assert kept.dataset.layout == wide and "give a layout" in kept.proposals[0].advice
    (found,) = (p for p in adopted.proposals if p.key in ("offset", "self_calibration"))
    assert found.value == ["x", "y", "z"] and found.groups == adopted.sensors
    for group, zero, one_g, people in zip(
        found.groups, (330, 511), (68, 102), (["P0", "P1", "P2"], ["P3", "P4"]), strict=True
    ):
        assert [s.subject for s in group.sessions] == people and group.recognised == ""
        for at in (group, *(s for s in group.sessions if s.zero)):
            assert at.one_g == pytest.approx(one_g, rel=0.1)
            assert list(at.zero.values()) == pytest.approx([zero] * 3, abs=0.1 * one_g)
    assert any(s.zero for s in found.groups[1].sessions)


def test_axes_that_are_turned_by_a_negative_scale_have_a_positive_g(tmp_path: Path) -> None:
    turned = replace(ACCEL, channels=tuple(replace(c, scale=-0.015) for c in ACCEL.channels))
    (sensor,) = import_recordings(analogue(tmp_path / "R", 330, 65), tmp_path / "DS", layout=turned).sensors
    assert sensor.one_g == pytest.approx(0.98, rel=0.1)


def test_each_session_of_a_person_has_its_own_sensor(tmp_path: Path) -> None:
    source = analogue(analogue(tmp_path / "R", 330, 68), 511, 102, people=range(3, 6))
    dataset = import_recordings(source, tmp_path / "DS", layout="accel-3").dataset
    dataset.recordings = [
        replace(r, subject=f"Q{int(r.subject[1]) % 3}", session=r.subject) for r in dataset.recordings
    ]
    groups = [[(s.subject, s.session) for s in sensor.sessions] for sensor in find_sensors(dataset)]
    assert groups == [[("Q0", "P0"), ("Q1", "P1"), ("Q2", "P2")], [("Q0", "P3"), ("Q1", "P4"), ("Q2", "P5")]]


@pytest.mark.parametrize(
    ("one_g", "unit"),
    [(1.02, "g"), (9.7, "m/s²"), (1003, "mg"), (1020, "1024 counts a g"), (16100, "16384 counts a g"), (1012, ""),
     (68, ""), (102, ""), (5000, "")],
)  # fmt: skip
def test_the_unit_is_recognised_where_it_is_plain(one_g: float, unit: str) -> None:
    sphere = (np.zeros(3), one_g / 0.01)
    layout = replace(ACCEL, channels=tuple(replace(c, step=0.01, unit="g") for c in ACCEL.channels))
    sensor = Sensor.of(layout, ("x", "y", "z"), np.full(3, 0.01), sphere, {("P1", ""): None})
    assert sensor.recognised == unit and sensor.one_g == one_g
    assert ("but the layout says g" in sensor.summary) == (unit not in ("", "g"))


def test_the_unit_that_1_g_tells_is_adopted_and_the_model_still_reads_the_device(tmp_path: Path) -> None:
    given = replace(
        ACCEL, channels=tuple(replace(c, unit="g", valid_min=-8000, valid_max=8000) for c in ACCEL.channels)
    )
    milli = import_recordings(analogue(tmp_path / "R", 0, 1000), tmp_path / "DS", layout=given)
    (unit,) = (p for p in milli.proposals if p.key == "unit")
    assert unit.value == dict.fromkeys("xyz", "mg") and unit.adopted
    adopted = milli.dataset.layout
    assert [c.unit for c in adopted.channels] == ["mg"] * 3
    check_layout(given, adopted)  # the device as its owner describes it, and the model made of the data set
    assert import_recordings(tmp_path / "R", tmp_path / "DS", layout=given, add_to=True).already_there == 18
    other = replace(given, name="other")
    with pytest.raises(ConfigError, match="channel 'x' has another unit, scale, step"):
        check_layout(other, adopted)


def test_two_data_sets_of_one_sensor_are_read_alike(tmp_path: Path) -> None:
    first = import_recordings(analogue(tmp_path / "R", 330, 68), tmp_path / "DS", layout="accel-3").dataset
    second = import_recordings(analogue(tmp_path / "Q", 340, 68), tmp_path / "DS2", layout="accel-3").dataset
    assert first.layout.channels != second.layout.channels
    read = second.with_inputs(first.layout.for_vectors())
    assert read.layout.channels == first.layout.channels and read.layout.inputs[-1] == "z_gravity"
    assert read.hash == second.hash


def failing(folder: Path, value: float, rows: int = 1, every: int = 3, times: int = 1) -> Path:
    """Write recordings of two force sensors at 50 Hz, some with readings ``value`` of the first for ``rows`` rows."""
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    lines = ["subject,time_ms,left,right,label"]
    for take in range(24):
        left = 10 * np.sin(np.arange(100) / 9) ** 2 + rng.normal(0, 0.1, 100)
        if take % every == 0:
            for at in range(20, 20 + 20 * times, 20):
                left[at : at + rows] = value
        lines += [
            f"P{take % 3},{10**12 + 10000 * take + 20 * i},{x:.2f},{y:.2f},{'push' if take % 2 else 'pull'}"
            for i, (x, y) in enumerate(zip(left, rng.normal(5, 1, 100), strict=True))
        ]
    (folder / "t.csv").write_text("\n".join(lines) + "\n")
    return folder / "t.csv"


FORCE = Layout.from_dict(
    {
        "name": "force",
        "rate_hz": 50.0,
        "channels": [{"name": n, "unit": "N", "kind": "force", "step": 0.01} for n in ("left", "right")],
        "wire": ["device_ms", "left", "right"],
    },
    "the test",
)


@pytest.mark.parametrize("value", [838860.7, -838860.8, 32767, -32768, 65535])
def test_failed_readings_are_outside_the_valid_range_that_is_adopted(tmp_path: Path, value: float) -> None:
    done = import_recordings(failing(tmp_path / "R", value), tmp_path / "DS", layout=FORCE)
    left, right = done.dataset.layout.channels
    assert right == FORCE.channels[1]
    assert -15 < left.valid_min < -8 and 18 < left.valid_max < 25
    (note,) = (n for n in done.notes if isinstance(n, Message) and n.template == ADOPTED)
    assert "8 of 2400 readings of left (P0) are far beyond all others" in note
    found = [f for f in check(done.dataset).findings if f.check == "garbage" and f.recording]
    assert len(found) == 8 and all(f.severity == "error" for f in found)
    kept = import_recordings(tmp_path / "R" / "t.csv", tmp_path / "KEPT", layout=FORCE, adopt_proposals=False)
    assert kept.dataset.layout == FORCE and "give a layout with valid_m" in kept.proposals[0].advice
    added = import_recordings(failing(tmp_path / "MORE", value), tmp_path / "KEPT", add_to=True)
    assert {p.key for p in added.proposals} >= {"valid_min", "valid_max"} and added.dataset.layout == FORCE
    assert len(find_failed_readings(done.dataset)) == 0


def test_a_model_reads_failed_readings_as_the_last_good_one(tmp_path: Path) -> None:
    done = import_recordings(failing(tmp_path / "R", 838860.7), tmp_path / "DS", layout=FORCE)
    good = import_recordings(failing(tmp_path / "Q", 5.0), tmp_path / "GOOD", layout=FORCE)
    spec = WindowSpec(window_s=1.0)
    windows, expected = cut_windows(done.dataset, spec), cut_windows(good.dataset, spec)
    scaler, usual = Scaler.fit(windows.x), Scaler.fit(expected.x)
    assert np.allclose(scaler.scale, usual.scale, rtol=0.05) and not far_inputs(windows.x)
    clock, frames = SampleClock(done.dataset.layout), done.dataset.read(done.dataset.used[0])
    streamed = np.concatenate([clock.push(int(t), row) for t, row in zip(frames.device_ms, frames.values, strict=True)])
    assert clock.invalid == 1 and np.array_equal(streamed, resample(frames, done.dataset.layout)[0].data)
    assert streamed[20, 0] == frames.values[19, 0]


@pytest.mark.parametrize(
    ("value", "rows", "every", "times"),
    [(838860.7, 20, 24, 1), (90, 1, 3, 1), (65535.01 / 300, 1, 3, 1), (838860.7, 1, 1, 4)],
    ids=["in succession", "not far", "no limit of integers", "many"],
)
def test_what_may_be_real_is_not_taken_for_failed(
    tmp_path: Path, value: float, rows: int, every: int, times: int
) -> None:
    done = import_recordings(failing(tmp_path / "R", value, rows, every, times), tmp_path / "DS", layout=FORCE)
    assert done.dataset.layout == FORCE
    # What lasts is a touch or a disconnected sensor: the user decides.
    assert {p.key for p in done.proposals} & {"valid_max"} == ({"valid_max"} if rows == 20 else set())


@pytest.mark.parametrize(
    ("value", "adopted"),
    [(30_000, False), (32_767, False), (83_886_070, True)],
    ids=["far", "end of the converter", "error code"],
)
def test_single_rows_of_one_gesture_may_be_hits(tmp_path: Path, value: int, adopted: bool) -> None:
    # A piezo disc or an accelerometer at its end stop: nothing between rest and a hit, which lasts one row.
    rng = np.random.default_rng(0)
    lines = ["subject,time_ms,left,right,label"]
    for take in range(24):
        x = rng.integers(-12, 13, (100, 2))
        x[50, 0] = value if take % 3 == 0 else 0
        label = ("tap", "rest", "stroke")[take % 3]
        lines += [
            f"P{take % 2},{10**12 + 10000 * take + 20 * i},{a},{b},{label}" for i, (a, b) in enumerate(x.tolist())
        ]
    (tmp_path / "t.csv").write_text("\n".join(lines) + "\n")
    # A valid range that is left out depends on the step: that of FORCE would already exclude the error code.
    whole = {"step": 1.0, "valid_min": -(2**31), "valid_max": 2**31 - 1}
    layout = replace(FORCE, channels=tuple(replace(c, **whole) for c in FORCE.channels))
    done = import_recordings(tmp_path / "t.csv", tmp_path / "DS", layout=layout)
    proposed = {p.key: p for p in done.proposals}
    assert (done.dataset.layout != layout) == proposed["valid_max"].adopted == adopted
    assert ("most of them in tap, so they may be hits" in proposed["valid_max"].reason) != adopted


def test_rate_gap_and_window_are_measured(tmp_path: Path) -> None:
    source = analogue(tmp_path / "R", 0, 8000, period_ms=80)
    done = import_recordings(source, tmp_path / "DS", layout="accel-3", adopt_proposals=False)
    found = {p.key: p.value for p in done.proposals}
    assert found["rate_hz"] == 12.0 and found["gap_ms"] == pytest.approx(320, abs=8)
    assert "window_s" not in found  # the recordings last 3 s
    adopted = import_recordings(source, tmp_path / "DS2", layout="accel-3").dataset.layout
    assert (adopted.rate_hz, adopted.gap_ms) == (12.0, found["gap_ms"])


@pytest.mark.exhaustive
def test_the_real_recordings_need_nothing_but_a_window(real_data: Path, tmp_path: Path) -> None:
    for source, layout in (("makeability-gestures", "accel-3"), ("har-phone", "phone-6")):
        done = import_recordings(real_data / source, tmp_path / layout)
        assert done.dataset.layout.name == layout and f"'{layout}'" in done.notes[0]
        assert not done.dataset.head.simulated
        assert [p.key for p in done.proposals] == ["window_s"]
        (sensor,) = done.sensors
        assert sensor.recognised == {"accel-3": "8192 counts a g", "phone-6": "m/s²"}[layout]
        assert len({s.subject for s in sensor.sessions}) == len(done.dataset.subjects)


def test_headers_that_fit_no_layout(tmp_path: Path, cli: Callable[..., Any]) -> None:
    folder = tmp_path / "R" / "P1"
    folder.mkdir(parents=True)
    path = folder / "Wave_1700000000000_3.csv"
    path.write_text("a, b\n1, 2\n")
    with pytest.raises(ConfigError, match="--layout is needed: accepted are accel-3"):
        import_recordings(tmp_path / "R", tmp_path / "DS")
    ran = cli("import", tmp_path / "R", tmp_path / "DS", "--add", "--adopt")
    assert ran.status == 2


def test_the_layout_is_guessed_by_what_the_files_hold(tmp_path: Path) -> None:
    header = load_layout("plush-15").csv.header
    clock = [[*list(range(13)), 1700000000000 + 10 * i, 5000 + 10 * i] for i in range(40)]
    delays = [[*row[:-1], 9 + i % 3] for i, row in enumerate(clock)]
    for name, rows, first in (("clock", clock, "plush-15"), ("delays", delays, "plush-14")):
        lines = ["; ".join(header), *("; ".join(map(str, row)) for row in rows)]
        for number, text in enumerate((lines, lines[1:])):
            path = tmp_path / name / f"Tail pull_170000000000{number}_40.csv"
            path.parent.mkdir(exist_ok=True)
            path.write_text("\n".join(text) + "\n")
            assert readable_layouts([path])[0].name == first
    assert readable_layouts([tmp_path / "other.txt"]) == []


def recorder_folder(folder: Path, integers: int, *, header: bool = True) -> Path:
    """Write a person's folder as the authors' recorder does: its last column is the 14th integer, whatever that is."""
    rng = np.random.default_rng(0)
    names = load_layout("plush-15").csv.header
    rows = [
        [*rng.integers(0, 900, 13).tolist(), 1700000000000 + 10 * i, 5000 + 10 * i if integers == 15 else 9 + i % 3]
        for i in range(300)
    ]
    rows[77] = [0] * 13 + [rows[77][13], 0]  # a line with commas
    (folder / "Cat_M_01").mkdir(parents=True)
    kept = rows[100:160] if integers > 13 else []
    lines = ["; ".join(names)] * header + ["; ".join(map(str, row)) for row in kept]
    (folder / "Cat_M_01" / f"Tail pull_1700000001600_{len(kept)}.csv").write_text("\n".join(lines) + "\n")
    stream = rows if integers > 13 else []
    (folder / "Cat_M_01" / "fulldatastream.csv").write_text("".join("; ".join(map(str, r)) + "\n" for r in stream))
    return folder


@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("integers", [15, 14])
def test_a_folder_of_the_authors_recorder_needs_no_layout(tmp_path: Path, integers: int, header: bool) -> None:
    done = import_recordings(recorder_folder(tmp_path / "R", integers, header=header), tmp_path / "DS")
    assert (done.dataset.layout.name, done.recordings, done.streams) == (f"plush-{integers}", 1, 1)
    columns = "the header of the files has its channels" if header else "the files have its 15 columns"
    clock = "clock" if integers == 15 else "delay"
    assert done.notes[0] == f"the layout is 'plush-{integers}', as {columns}, the last one a {clock}"
    assert [r.stream_row for r in done.dataset.recordings] == [100]


def test_a_toy_that_sends_no_clock_has_no_rows(tmp_path: Path, cli: Callable[..., Any]) -> None:
    ran = cli("import", recorder_folder(tmp_path / "R", 13), tmp_path / "DS")
    assert ran.status == 2 and len(ran.err.strip().splitlines()) == 1
    assert "'Tail pull_1700000001600_0.csv' has a header but no row" in ran.err
    assert ran.err.rstrip().endswith("if the toy sends fewer than 14 integers a line.")


def test_numbers_without_a_header_are_no_recording_of_the_recorder_unless_a_column_holds_times(tmp_path: Path) -> None:
    folder = tmp_path / "R" / "P1"
    folder.mkdir(parents=True)
    (folder / "Wave_1700000000000_40.csv").write_text("".join(f"{i};1;2;3;4\n" for i in range(40)))
    with pytest.raises(ConfigError, match="--layout is needed"):
        import_recordings(tmp_path / "R", tmp_path / "DS")


def textile(folder: Path, apart: float, gestures: int = 3) -> Path:
    """Write touches of a capacitance and a resistance, whose rest differs by ``apart`` touches between six people."""
    rng = np.random.default_rng(0)
    folder.mkdir(parents=True)
    lines = ["subject,time_ms,capacitance,resistance,count,label"]
    for person in range(6):
        rest = np.array([300.0, 40_000.0]) + apart * np.array([20, 4000]) * (person - 2.5)
        for take in range(4 * gestures):
            touch = np.sin(np.arange(120) * np.pi / 120 * (1 + take % gestures)) ** 2 * (np.arange(120) > 30)
            values = rest + np.outer(touch, [20, -4000]) + rng.normal(0, [0.2, 40], (120, 2))
            begin = 10**12 + 10**6 * person + 10_000 * take
            lines += [
                f"P{person},{begin + 20 * i},{c:.2f},{r:.0f},{i % 7},g{take % gestures}"
                for i, (c, r) in enumerate(values)
            ]
    (folder / "t.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(("apart", "gestures", "proposed"), [(2, 3, True), (0.2, 3, False), (2, 1, False)])
def test_channels_whose_rest_differs_between_people_are_proposed_to_calibrate_themselves(
    tmp_path: Path, cli: Callable[..., Any], apart: float, gestures: int, proposed: bool
) -> None:
    source, pattern = textile(tmp_path / "R", apart, gestures), tmp_path / "p.toml"
    guess_pattern(source).write(pattern)
    ran = cli("import", source, tmp_path / "DS", "--pattern", pattern)
    advice = 'give a layout with self_calibration = ["capacitance", "resistance"], or import anew with --adopt'
    assert (advice in ran.err) == proposed and not open_dataset(tmp_path / "DS").layout.self_calibration
    # A layout without the valid range that the key needs gets it.
    guessed = guess_pattern(source).pattern.known_layout() or ACCEL
    wide = tuple(replace(c, valid_min=-1e6, valid_max=1e6) for c in guessed.channels)
    for given in (guessed.channels, wide):
        place = tmp_path / str(given is wide)
        layout = replace(guessed, channels=given)
        done = import_recordings(source, place, pattern=pattern, layout=layout, adopt_proposals=True)
        found = open_dataset(place).layout
        assert found.self_calibration == (("capacitance", "resistance") if proposed else ())
        assert all(p.adopted for p in done.proposals if p.key != "window_s")
        limits = guessed.channels[0] if proposed else given[0]
        assert found.channels[0].valid_max == -found.channels[0].valid_min == limits.valid_max
