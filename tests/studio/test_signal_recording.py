"""The session of a validation on the live page: written at once, labelled to the row, and ended by itself."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import read_recording
from plushsense.devices.base import Frame
from plushsense.recording import writer
from plushsense.recording.session import next_session
from plushsense.recording.writer import SessionHead, StreamFile, read_events
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live.live_state import LiveChoice
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.signal_recording import SignalRecording
from support.bundles import odd_bundle
from support.waiting import until


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    """A studio's folder in which a virtual toy is being read at twenty times the speed."""
    bundle = odd_bundle(tmp_path / "home" / "bundles" / "one.plush")
    made = Workspace(tmp_path / "home", speed=20.0)
    made.part(LiveReader).start(LiveChoice("virtual://?person=31", bundle))
    until(lambda: made.part(LiveReader).now.t_s > 1.0)
    yield made
    made.close()


def test_rows_are_on_disk_within_a_second_and_are_labelled_to_the_row(workspace: Workspace) -> None:
    reader, recording = workspace.part(LiveReader), workspace.part(SignalRecording)
    key = recording.begin(reader, " S01 ", 600.0)
    assert key == recording.key == "S01/live-1"
    folder = workspace.recordings / key
    until(lambda: recording.recorded_s > 20.0)
    until(lambda: (folder / "fulldatastream.csv").read_bytes().count(b"\n") > 1500, 2.0)
    recording.end()
    recording.end()
    assert recording.key == "" and recording.failed is None
    rows, layout = recording.read(key)
    head = SessionHead.read(folder)
    assert head is not None and head.simulated and head.device.startswith("virtual://")
    # Twenty times as fast as real time: rows carry the toy's time, not the computer's.
    steps = np.diff(rows.device_ms)
    assert steps.min() > 0 and steps.max() < 60
    assert rows.host_ms is not None and np.abs(np.diff(rows.host_ms) - steps).max() <= 1
    events = list(read_events(folder))
    assert [e.kind for e in events if e.kind != "gap"] == ["open", "finished", "close"]
    assert events[-1].details["rows"] == len(rows)
    # No recorder takes it up as a session that it would have to go on with.
    assert next_session(workspace.recordings / "S01") == "1"
    stream = (folder / "fulldatastream.csv").read_bytes()
    recording.label(key, [("Tail hit 1", 200, 450), ("Tail pull", 500, 640), ("Tail hit 1", 700, 800)])
    takes = [e.details for e in read_events(folder) if e.kind == "take"]
    assert [(t["gesture"], t["repetition"], t["rows"]) for t in takes] == [
        ("Tail hit 1", 1, 250), ("Tail pull", 1, 140), ("Tail hit 1", 2, 100),
    ]  # fmt: skip
    cut = read_recording(folder / takes[1]["file"], load_layout("plush-15")).frames
    assert layout == load_layout("plush-15") and np.array_equal(cut.values, rows.values[500:640])
    assert np.array_equal(cut.device_ms, rows.device_ms[500:640])
    assert (folder / "fulldatastream.csv").read_bytes() == stream, "the stream itself never changes"
    with pytest.raises(ConfigError, match="cannot be the name of a gesture"):
        recording.label(key, [("a/b", 0, 50)])


def test_what_cannot_be_recorded_is_refused(workspace: Workspace) -> None:
    reader, recording = workspace.part(LiveReader), workspace.part(SignalRecording)
    for subject in ("Anna Kalniņa", ""):
        with pytest.raises(DatasetError, match="no code for a person"):
            recording.begin(reader, subject, 600.0)
    reader.stop()
    with pytest.raises(ConfigError, match="No toy is being read"):
        recording.begin(reader, "S01", 600.0)


def test_a_full_disk_ends_the_recording_with_a_sentence_and_the_toy_is_read_on(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, recording = workspace.part(LiveReader), workspace.part(SignalRecording)
    write, written = StreamFile.write, [0]

    def counted(file: StreamFile, frames: Sequence[Frame]) -> None:
        write(file, frames)
        written.append(written[-1] + len(frames))

    # Rows that are in the file but not yet flushed are removed again when the flush fails, so count the flushed ones.
    monkeypatch.setattr(StreamFile, "write", counted)
    key = recording.begin(reader, "S01", 600.0)
    until(lambda: written[-1] > 300)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer.os, "fsync", full)
    until(lambda: not recording.key)
    until(lambda: bool(recording.failed))
    assert "No space left" in str(recording.failed)
    monkeypatch.undo()
    at = reader.now.t_s
    until(lambda: reader.now.t_s > at + 1.0)
    assert len(recording.read(key)[0]) == written[-1] > 300
    recording.label(key, [("Tail pull", 0, 200)])


def test_a_recording_that_nobody_ends_ends_by_itself(workspace: Workspace) -> None:
    reader, recording = workspace.part(LiveReader), workspace.part(SignalRecording)
    key = recording.begin(reader, "S01", 5.0)
    until(lambda: not recording.key)
    assert 500 <= len(recording.read(key)[0]) < 800
