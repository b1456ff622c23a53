"""The paper's live validation: prompts by the clock of the toy, trials kept in a session, scores in files."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.gestures import load_gestures
from plushsense.recording.writer import read_events
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live.live_state import LiveChoice
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.signal_recording import SignalRecording
from plushsense.studio.pages.live.validation import GESTURE_S, Validation
from support.bundles import odd_bundle
from support.waiting import until

GESTURES = ["At rest", "Ear scratch 1", "Tail pull"]


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    """A studio's folder in which a virtual toy is read at twenty times the speed."""
    bundle = odd_bundle(
        tmp_path / "home" / "bundles" / "one.plush", gestures=load_gestures("plush-18").subset(GESTURES)
    )
    made = Workspace(tmp_path / "home", speed=20.0)
    made.part(LiveReader).start(LiveChoice("virtual://?person=31", bundle))
    yield made
    made.close()


def test_every_gesture_is_prompted_made_kept_and_scored(workspace: Workspace) -> None:
    validation, reader = workspace.part(Validation), workspace.part(LiveReader)
    with pytest.raises(DatasetError, match="no code"):
        validation.begin("Anna", 1, None)
    commands = [
        # The toy's own reaction is noted just after the gesture.
        (lambda status: status.phase == "after", lambda: validation.react("positive")),
        # A pause in that moment waits for the next trial: the one that was made is not repeated.
        (lambda status: status.phase == "after", validation.pause),
        (lambda status: (status.done, status.phase) == (1, "doing"), validation.pause),
        # A trial that is skipped does not count.
        (lambda status: (status.label, status.phase) == ("Tail pull", "countdown"), validation.skip),
    ]

    def command() -> None:
        """Give the next command at once, in the thread of the reader: on a busy machine a test would be late."""
        if commands and commands[0][0](validation.status):
            commands.pop(0)[1]()

    validation.changed = SimpleNamespace(notify=command)  # type: ignore[assignment]
    validation.begin("S31", 2, None, noted=True)
    with pytest.raises(ConfigError, match="under way"):
        validation.begin("S31", 2, None)
    assert validation.status.total == 4
    until(lambda: validation.status.phase == "paused")
    at = reader.now.t_s
    until(lambda: reader.now.t_s > at + 2.0 * GESTURE_S)
    status = validation.status
    assert (status.phase, status.done, status.at) == ("paused", 1, 1)
    validation.pause()
    until(lambda: validation.status.phase == "paused")
    assert (validation.status.done, validation.status.at) == (1, 1)
    validation.pause()
    until(lambda: validation.status.phase == "")
    assert commands == []
    assert validation.status.failed is None
    assert validation.status.result == workspace.folder / "validations" / "S31"
    result = validation.read(validation.status.result)
    assert result["simulated"] is True and result["people"] == ["S31"]
    trials = {(o["gesture"], o["repetition"]) for o in result["outcomes"]}
    assert ("Tail pull", 1) not in trials and ("Tail pull", 2) in trials and ("Ear scratch 1", 1) in trials
    # At this speed a press is up to seconds of the toy late, so that it may belong to the trial or not.
    in_trials = [o["reaction_s"] for o in result["outcomes"] if o["system"] == "toy"]
    outside = next(row["positive"] for row in result["between"] if row["system"] == "toy")
    assert len(in_trials) == 3 and sum(s is not None for s in in_trials) + outside == 1
    assert "noted by a person" in (validation.status.result / "protocol.html").read_text("utf-8")
    takes = [e.details for e in read_events(workspace.recordings / "S31" / "live-1") if e.kind == "take"]
    assert (takes[0]["gesture"], takes[-1]["gesture"]) == ("Ear scratch 1", "Tail pull")
    assert all(take["rows"] > 50 for take in takes)
    with (validation.status.result / "trials.csv").open(encoding="utf-8") as file:
        assert {row["simulated"] for row in csv.DictReader(file)} == {"yes"}
    # The person does as they like again.
    made = len(reader.performed())
    until(lambda: len(reader.performed()) > made)


def test_a_validation_that_ends_early_keeps_what_was_made(workspace: Workspace) -> None:
    validation, recording, reader = (workspace.part(kind) for kind in (Validation, SignalRecording, LiveReader))
    validation.begin("S31", 1, None)
    validation.react("positive")
    assert validation.status.reactions is None
    validation.stop()
    until(lambda: validation.status.phase == "")
    assert (validation.status.result, validation.status.failed, recording.key) == (None, None, "")
    validation.begin("S31", 1, None)
    until(lambda: validation.status.done)
    recording.end()
    until(lambda: validation.status.phase == "" and validation.status.result is not None)
    assert validation.results() == [workspace.folder / "validations" / "S31"]
    reader.stop()
    with pytest.raises(ConfigError, match="No toy is being read"):
        validation.begin("S31", 1, None)
    (workspace.folder / "validations" / "S31" / "protocol.json").write_text("{", encoding="utf-8")
    with pytest.raises(ConfigError, match="cannot be read"):
        validation.read(validation.results()[0])
