"""Hard cases kept from the live page: written at once, cut to the row, added to a data set, and never lost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.recorder_csv import read_recording
from plushsense.dataset.importing.build import ImportSummary
from plushsense.dataset.index import open_dataset
from plushsense.devices.base import Frame
from plushsense.recording import writer
from plushsense.recording.session import next_session
from plushsense.recording.session_files import SESSION_LOG, read_events
from plushsense.recording.writer import StreamFile
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live.clips import LONGEST_S, PROTOCOL, Clips
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.state import LiveChoice
from support.bundles import odd_bundle
from support.waiting import until


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    """A studio's folder in which a virtual toy is being read at twenty times the speed."""
    bundle = odd_bundle(tmp_path / "home" / "bundles" / "one.plush")
    made = Workspace(tmp_path / "home", speed=20.0)
    made.part(LiveReader).start(LiveChoice("virtual://?person=31", bundle))
    until(lambda: made.part(LiveReader).now.t_s > 12.0)
    yield made
    made.close()


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of two virtual people; read only."""
    from plushsense.workflow.api import simulate

    folder = tmp_path_factory.mktemp("virtual")
    simulate(folder / "made", people=2, repetitions=1, dataset=folder / "set")
    return folder / "set"


def test_the_last_seconds_are_kept_as_they_came(workspace: Workspace) -> None:
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    key = clips.keep(reader, 10.0, " S01 ")
    assert key == "S01/live-1"
    clip = clips.get(key)
    assert clip.head.simulated
    assert clip.head.protocol["name"] == PROTOCOL
    assert clip.head.device.startswith("virtual://")
    assert (clip.labels, clip.added) == ((), ())
    rows = clips.rows(clip)
    assert len(rows) == clip.rows
    assert clip.seconds == pytest.approx((rows.device_ms[-1] - rows.device_ms[0]) / 1000.0, abs=0.02)
    assert 9_900 <= rows.device_ms[-1] - rows.device_ms[0] <= 10_000
    # The very rows that the ring held, in the order of the toy's clock.
    assert reader.device is not None
    held = {f.device_ms: f.values for f in reader.device.buffer.frames(60.0)}
    assert [held[int(d)] for d in rows.device_ms] == [tuple(v) for v in rows.values.tolist()]
    # Twenty times as fast as real time: rows carry the toy's time, not the computer's.
    assert rows.host_ms is not None
    assert np.abs(np.diff(rows.host_ms) - np.diff(rows.device_ms)).max() <= 1
    assert clips.keep(reader, 5.0, "S01") == "S01/live-2"
    assert [c.key for c in clips.all()] == ["S01/live-2", "S01/live-1"]
    # No recorder takes it up as a session that it would have to go on with.
    assert next_session(workspace.recordings / "S01") == "1"
    # A log that somebody spoilt hides no other clip.
    with (workspace.recordings / "S01" / "live-2" / SESSION_LOG).open("a", encoding="utf-8") as log:
        log.write('{"what": "take", "at_ms": 1, "file": 7, "gesture": [], "rows": "many"}\n')
    assert "S01/live-1" in [c.key for c in clips.all()]


def test_from_now_on_rows_are_on_disk_within_a_second(workspace: Workspace) -> None:
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    key = clips.begin(reader, "S01")
    stream = workspace.recordings / key / "fulldatastream.csv"
    until(lambda: clips.recorded_s > 20.0)
    until(lambda: stream.read_bytes().count(b"\n") > 1500, 2.0)
    with pytest.raises(ConfigError, match="is being recorded already"):
        clips.begin(reader, "S02")
    with pytest.raises(ConfigError, match="still being recorded"):
        clips.label(key, "Tail pull", 0, 100)
    assert clips.end() == key
    assert clips.end() == ""
    clip, rows = clips.get(key), clips.rows(clips.get(key))
    assert len(rows) == clip.rows
    steps = np.diff(rows.device_ms)
    assert steps.min() > 0
    assert steps.max() < 60
    events = list(read_events(clip.folder))
    assert [e.kind for e in events if e.kind != "gap"] == ["open", "finished", "close"]
    assert events[-1].details["rows"] == clip.rows


def test_a_part_is_labelled_and_added_with_exactly_its_rows(workspace: Workspace, virtual: Path) -> None:
    import shutil

    there = workspace.folder / "datasets" / "virtual"
    shutil.copytree(virtual, there)
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    key = clips.keep(reader, 10.0, "S77")
    stream = (workspace.recordings / key / "fulldatastream.csv").read_bytes()
    with pytest.raises(ConfigError, match="no label yet"):
        clips.add(key, there)
    label = clips.label(key, "Tail hit 1", 200, 450)
    assert (label.first, label.last) == (200, 450)
    made = clips.add(key, there)
    assert isinstance(made, ImportSummary)
    assert made.added["recordings"] == 1
    clips.label(key, "my own", 500, 640)
    assert clips.get(key).added == (), "the second is not there yet"
    assert clips.add(key, there).added["recordings"] == 1
    clip = clips.get(key)
    assert clip.added == ("virtual",)
    assert [(x.gesture, x.first, x.last) for x in clip.labels] == [("Tail hit 1", 200, 450), ("my own", 500, 640)]
    dataset = open_dataset(there)
    mine = [r for r in dataset.recordings if r.subject == "S77"]
    assert sorted((r.gesture, r.rows) for r in mine) == [("Tail hit 1", 250), ("my own", 140)]
    assert {r.session for r in mine} == {"live-1"}
    rows = clips.rows(clip)
    for label in clip.labels:
        found = next(r for r in mine if r.gesture == label.gesture)
        cut = read_recording(there / found.file, dataset.layout).frames
        part = rows.slice(label.first, label.last)
        assert np.array_equal(cut.values, part.values)
        assert np.array_equal(cut.device_ms, part.device_ms)
    assert (workspace.recordings / key / "fulldatastream.csv").read_bytes() == stream, "the clip itself never changes"
    assert clips.add(key, there).added["recordings"] == 0, "nothing twice"


def test_what_cannot_be_is_refused_in_a_sentence(workspace: Workspace, virtual: Path, tmp_path: Path) -> None:
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    with pytest.raises(DatasetError, match="no code for a person"):
        clips.keep(reader, 5.0, "Anna Kalniņa")
    with pytest.raises(DatasetError, match="no code for a person"):
        clips.begin(reader, "")
    key = clips.keep(reader, 5.0, "S01")
    size = clips.get(key).rows
    for first, last in ((-1, 5), (5, 5), (0, size + 1), (9, 3)):
        with pytest.raises(ConfigError, match="not a part of the clip"):
            clips.label(key, "Tail pull", first, last)
    for odd in ("", "  ", "a/b", "c?"):
        with pytest.raises(ConfigError, match="cannot be the label of a gesture"):
            clips.label(key, odd, 0, 50)
    for name in ("S01/live-9", "../../other", "S01"):
        with pytest.raises(ConfigError):
            clips.get(name)
    clips.label(key, "Tail pull", 0, 100)
    with pytest.raises(ConfigError, match="outside"):
        clips.add(key, virtual)
    # A simulated clip does not go among real recordings.
    import shutil

    real = workspace.folder / "datasets" / "real"
    shutil.copytree(virtual, real)
    head = real / "dataset.toml"
    head.write_text(head.read_text(encoding="utf-8").replace("simulated = true", "simulated = false"), encoding="utf-8")
    with pytest.raises(DatasetError, match="virtual"):
        clips.add(key, real)
    reader.stop()
    with pytest.raises(ConfigError, match="No toy is being read"):
        clips.begin(reader, "S01")
    assert clips.keep(reader, 5.0, "S01") == "S01/live-2", "also after the end, while it is on the screen"


def test_a_replay_of_a_simulation_stays_one(workspace: Workspace) -> None:
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    key = clips.keep(reader, 10.0, "S01")
    reader.start(
        LiveChoice(f"replay://{(workspace.recordings / key).as_posix()}/fulldatastream.csv", reader.choice.bundle)
    )
    until(lambda: not reader.now.running)
    again = clips.get(clips.keep(reader, 5.0, "S02"))
    assert again.head.device.startswith("replay://")
    assert again.head.simulated


def test_a_full_disk_ends_the_clip_with_a_sentence_and_the_toy_is_read_on(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    write, written = StreamFile.write, [0]

    def counted(file: StreamFile, frames: Sequence[Frame]) -> None:
        write(file, frames)
        written.append(written[-1] + len(frames))

    # Rows that are in the file but not yet flushed are removed again when the flush fails, so count the flushed ones.
    monkeypatch.setattr(StreamFile, "write", counted)
    key = clips.begin(reader, "S01")
    until(lambda: written[-1] > 300)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer.os, "fsync", full)
    until(lambda: not clips.recording)
    until(lambda: bool(clips.failed))
    assert "No space left" in str(clips.failed)
    monkeypatch.undo()
    at = reader.now.t_s
    until(lambda: reader.now.t_s > at + 1.0)
    clip = clips.get(key)
    assert len(clips.rows(clip)) == clip.rows == written[-1] > 300
    assert clips.label(key, "Tail pull", 0, 200).gesture == "Tail pull", "what is there can be used"


def test_a_clip_that_nobody_ends_ends_by_itself(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    from plushsense.studio.pages.live import clips as room

    assert LONGEST_S >= 60.0
    monkeypatch.setattr(room, "LONGEST_S", 5.0)
    reader, clips = workspace.part(LiveReader), workspace.part(Clips)
    key = clips.begin(reader, "S01")
    until(lambda: not clips.recording)
    time.sleep(0.2)
    assert 500 <= clips.get(key).rows < 800
