"""Simulated sessions: folders exactly as the authors' recorder leaves them."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import parse_name, read_recording, read_stream
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.devices.opening import open_device
from plushsense.devices.virtual.motions import split_label
from plushsense.devices.virtual.scenario import load_scenario
from plushsense.devices.virtual.session import GESTURES, VirtualSession
from plushsense.devices.virtual.stream import ToySpec
from plushsense.devices.virtual.world import draw_person
from plushsense.recording.simulate import SimulationSpec, play_to_folder, repetitions_made, simulate

pytestmark = pytest.mark.slow

PLUSH = load_layout("plush-15")
SCENARIO = Path(__file__).resolve().parents[2] / "examples" / "files" / "scenario.toml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sim") / "people"
    seen: list[tuple[int, int, str]] = []
    summary = simulate(out, SimulationSpec(people=2, repetitions=1, at_rest=3), progress=lambda *a: seen.append(a))
    assert seen == [(1, 3, "P01"), (2, 3, "P02"), (3, 3, "none")]
    assert summary.recordings == 2 * 17 + 3
    assert summary.people == 2
    return out


def test_one_folder_a_person(folder: Path) -> None:
    assert sorted(p.name for p in folder.iterdir()) == ["P01", "P02", "SIMULATION.txt", "none"]
    for person in ("P01", "P02"):
        names = [parse_name(p.name) for p in (folder / person).glob("*_*.csv")]
        assert Counter(n.label for n in names if n) == Counter(GESTURES)
    assert {parse_name(p.name).label for p in (folder / "none").glob("*_*.csv")} == {"At rest"}  # type: ignore[union-attr]


def test_recordings_are_rows_of_the_stream(folder: Path) -> None:
    for person in ("P01", "none"):
        stream = read_stream(folder / person / "fulldatastream.csv", PLUSH)
        assert stream.warnings == [] and stream.malformed == 0
        host = stream.frames.host_ms
        assert host is not None and np.all(np.diff(host) >= 0) and np.all(np.diff(stream.frames.device_ms) >= 9)
        for path in (folder / person).glob("*_*.csv"):
            read = read_recording(path, PLUSH)
            name = parse_name(path.name)
            assert name is not None and name.rows == len(read.frames)
            assert read.frames.host_ms is not None
            assert 0 <= name.epoch_ms - read.frames.host_ms[-1] < 1000
            start = int(np.searchsorted(stream.frames.device_ms, read.frames.device_ms[0]))
            part = stream.frames.slice(start, start + len(read.frames))
            assert np.array_equal(part.values, read.frames.values)
            assert part.host_ms is not None
            assert np.array_equal(part.host_ms, read.frames.host_ms)


def test_streams_hold_more_than_the_recordings(folder: Path) -> None:
    stream = len(read_stream(folder / "P01" / "fulldatastream.csv", PLUSH).frames)
    recorded = sum(n.rows for p in (folder / "P01").glob("*_*.csv") if (n := parse_name(p.name)))
    assert stream > 1.5 * recorded


def test_handling_at_the_end_is_in_the_stream_alone(folder: Path) -> None:
    frames = read_stream(folder / "P01" / "fulldatastream.csv", PLUSH).frames
    ends = [read_recording(p, PLUSH).frames.device_ms[-1] for p in (folder / "P01").glob("*_*.csv")]
    after = frames.values[np.searchsorted(frames.device_ms, max(ends) + 3000) :]
    assert len(after) > 1500, "six times up and down again, and a rest after each"
    z = PLUSH.index("acc_z")
    turned = np.abs(after[:, z] - np.median(after[:, z])) > 3 * np.std(frames.values[:50, z])
    runs = np.flatnonzero(np.diff(turned.astype(int)) == 1)
    assert len(set((runs // 300).tolist())) >= 6, "it moves again and again"


def test_file_form(folder: Path) -> None:
    first, second = next((folder / "P01").glob("Tail pull_*.csv")).read_text(encoding="utf-8").split("\n")[:2]
    assert first.startswith("Cumulative capacitive; C1; ") and first.endswith("Arduino Timestamp (ms)")
    assert len(second.split("; ")) == 15 and all(c.lstrip("-").isdigit() for c in second.split("; "))
    assert not (folder / "P01" / "fulldatastream.csv").read_text(encoding="utf-8").startswith("Cum")


def test_the_same_seed_writes_the_same_files(folder: Path, tmp_path: Path) -> None:
    def digest(root: Path) -> dict[str, str]:
        return {str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest() for p in root.rglob("*.csv")}

    simulate(tmp_path / "again", SimulationSpec(people=2, repetitions=1, at_rest=3))
    assert digest(tmp_path / "again") == digest(folder)
    simulate(tmp_path / "other", SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail pull",), seed=2))
    assert sorted(p.name for p in (tmp_path / "other").iterdir()) == ["P01", "SIMULATION.txt"]
    assert digest(tmp_path / "other").items().isdisjoint(digest(folder).items())


def test_other_layouts(tmp_path: Path) -> None:
    for name in ("plush-14", "accel-3"):
        layout = load_layout(name)
        simulate(
            tmp_path / name, SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail hit 1",), layout=name)
        )
        frames = read_stream(tmp_path / name / "P01" / "fulldatastream.csv", layout).frames
        assert frames.values.shape[1] == layout.n_channels


def test_refusals(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("x", encoding="utf-8")
    with pytest.raises(DatasetError, match="empty folder"):
        simulate(tmp_path / "full")
    with pytest.raises(ConfigError, match="people"):
        simulate(tmp_path / "none", SimulationSpec(people=0))
    with pytest.raises(ConfigError, match="Tail kick"):
        simulate(tmp_path / "none", SimulationSpec(gestures=("Tail kick",)))
    assert not (tmp_path / "none").exists()


def test_older_firmware_leaves_delays_in_the_clock_column(tmp_path: Path) -> None:
    layout = load_layout("plush-14")
    simulate(
        tmp_path / "old", SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail hit 1",), layout=layout)
    )
    path = tmp_path / "old" / "P01" / "fulldatastream.csv"
    last = [int(line.split("; ")[-1]) for line in path.read_text(encoding="utf-8").splitlines()]
    assert max(last) < 1000
    read = read_stream(path, layout)
    assert read.integrated
    assert read.frames.host_ms is not None
    passed = int(read.frames.host_ms[-1] - read.frames.host_ms[0])
    assert abs(int(read.frames.device_ms[-1]) - passed) < 0.05 * passed


def test_a_users_folder_beside_is_left_alone(tmp_path: Path) -> None:
    mine = tmp_path / "out.simulating"
    mine.mkdir()
    (mine / "thesis.txt").write_text("x", encoding="utf-8")
    simulate(tmp_path / "out", SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail hit 1",)))
    assert (mine / "thesis.txt").is_file()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "out.simulating"]
    (tmp_path / "afile").write_text("x", encoding="utf-8")
    with pytest.raises(DatasetError, match="cannot be created"):
        simulate(tmp_path / "afile" / "x", SimulationSpec(people=1, repetitions=1, at_rest=0, gestures=("Tail hit 1",)))


def test_a_virtual_toy_of_a_negative_person_is_refused() -> None:
    for given in ({"person": -1}, {"seed": -1}, {"session": -1}):
        with pytest.raises(ConfigError, match=r"is -1; a whole number from 0"):
            ToySpec(**given)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("played") / "afternoon"
    result = play_to_folder(ToySpec.of(load_scenario(SCENARIO)), out)
    assert (result.people, result.counters.reconnects) == ((1, 7, 12), 1)
    return out


def test_a_scenario_in_a_folder_is_what_the_device_reads(played: Path) -> None:
    with open_device(f"virtual://?scenario={SCENARIO}&speed=0", reconnect=True) as toy:
        frames = [(frame.device_ms, frame.values) for frame in toy]
    with open_device(f"replay://{played}?speed=0") as replay:
        assert [(frame.device_ms, frame.values) for frame in replay] == frames
    other = played.parent / "again"
    play_to_folder(ToySpec.of(load_scenario(SCENARIO)), other)
    for path in sorted(played.rglob("*")):
        if path.is_file():
            assert (other / path.relative_to(played)).read_bytes() == path.read_bytes(), path.name


def test_the_truth_of_a_scenario_is_imported_person_by_person(played: Path, tmp_path: Path) -> None:
    truth = [json.loads(line) for line in (played / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    assert Counter(made["person"] for made in truth) == {7: 4, 12: 4}
    result = import_recordings(played / "recordings", tmp_path / "ds", layout="plush-15")
    dataset = open_dataset(tmp_path / "ds")
    assert dataset.head.simulated and not result.rejected
    found = Counter((r.subject, r.gesture) for r in dataset.recordings)
    assert found == Counter((f"P{made['person']:02d}", made["label"]) for made in truth)
    starts = {r.start_ms for r in dataset.recordings}
    # Two begin while the toy is disconnected or silent, before a restart: of them, only the rest was received.
    received = [made for made in truth if not (38.0 <= made["start_s"] < 41.0 or 55.0 <= made["start_s"] < 57.0)]
    assert len(received) == len(truth) - 2
    assert all(any(0 <= start - made["start_ms"] < 100 for start in starts) for made in received), "but for lost frames"
    assert all(r.stream_row >= 0 for r in dataset.recordings), "each lies in the stream of its person"
    assert len(dataset.streams) == 3


def test_a_toy_without_an_end_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give it a scenario"):
        play_to_folder(ToySpec(), tmp_path / "out")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("here")
    with pytest.raises(DatasetError, match="empty"):
        play_to_folder(ToySpec.of(load_scenario(SCENARIO)), tmp_path / "full")


# As the authors printed them: recordings of each class in class order, windows of all, rows of ten recordings at rest.
RECORDINGS_OF_EACH = (72, 73, 73, 75, 74, 74, 73, 74, 73, 75, 72, 72, 73, 74, 74, 74, 75)
WINDOWS = 5621
ROWS_AT_REST = (666, 543, 328, 572, 503, 590, 568, 530, 551, 492)


def windows(rows: int) -> int:
    """Return the number of windows of 250 rows every 50; a shorter recording is looped to one."""
    return 1 + max(0, rows - 250) // 50


def test_the_default_data_set_has_the_counts_of_the_authors_archive() -> None:
    for seed in (1, 2):
        made = {label: repetitions_made(label, 25, 3, seed) for label in GESTURES}
        assert tuple(sum(times) for times in made.values()) == RECORDINGS_OF_EACH
        assert {len(times) for times in made.values()} == {25}
        assert min(min(times) for times in made.values()) >= 1
    assert sum(RECORDINGS_OF_EACH) + 51 == 1301
    assert repetitions_made("Tail hit 1", 25, 3, 1) != repetitions_made("Tail hit 1", 25, 3, 2)
    assert repetitions_made("Tail hit 1", 8, 3, 1) == [3] * 8, "a small data set is complete"


def test_the_default_data_set_has_the_windows_of_the_authors_archive() -> None:
    """Lengths alone, without the signals: of the default people, and of the toy at rest."""
    people = [VirtualSession(draw_person(who)) for who in range(1, 26)]
    gestures = 0
    for label in GESTURES:
        for session, times in zip(people, repetitions_made(label, 25, 3, 1), strict=True):
            plans = [session._plan(split_label(label)[0], 0) for _ in range(times)]
            gestures += sum(windows(plan.record_stop) for plan in plans)
    rows = [m.record_stop - m.record_start for m in VirtualSession(None).perform("At rest", 51).marks]
    resting = sum(windows(n) for n in rows)
    assert gestures + resting == pytest.approx(WINDOWS, rel=0.03)
    assert resting / (gestures + resting) == pytest.approx(0.056, abs=0.01)
    assert 0.7 * min(ROWS_AT_REST) <= min(rows) and max(rows) <= 1.3 * max(ROWS_AT_REST)
    assert np.mean(rows) == pytest.approx(np.mean(ROWS_AT_REST), rel=0.05)


def test_missing_recordings_are_gestures_that_nobody_made(tmp_path: Path) -> None:
    summary = simulate(
        tmp_path / "many", SimulationSpec(people=4, repetitions=10, gestures=("Tail hit 1", "Tail pull"))
    )
    names = [parse_name(p.name) for p in (tmp_path / "many").glob("*/*_*.csv")]
    made = {"Tail hit 1": 39, "Tail pull": 39, "At rest": 3}  # at rest is 2 × 10 × 4 / 25, rounded
    assert Counter(n.label for n in names if n) == made
    assert summary.recordings == 81
