"""Events that a person marks as wrong on the live page, and the bundle that is fitted to these marks."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput, BundleError, ConfigError, DatasetError
from plushsense.live.feedback import LEAD_S, Correction, correct, cut_correction, read_corrections
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import GestureEvent
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live.feedback import EVENT_S, WAIT_S, Feedback
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.state import LiveChoice
from support.bundles import OTHER, odd_bundle
from support.waiting import until

HIT, PULL = "Tail hit 1", "Tail pull"


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    """A studio's folder in which a virtual toy was read for 45 s; no event of it is kept."""
    bundle = odd_bundle(tmp_path / "home" / "bundles" / "one.plush")
    made = Workspace(tmp_path / "home", speed=20.0)
    reader = made.part(LiveReader)
    reader.start(LiveChoice("virtual://?person=31&seconds=45", bundle))
    until(lambda: not reader.now.running)
    reader._events.clear()
    reader.now = replace(reader.now, event=None)
    yield made
    made.close()


def report(workspace: Workspace, begun_s: float, ended_s: float | None, gesture: str | None = HIT) -> None:
    """Report an event: begun 0.2 s before it is named, its end 0.3 s after it was first likely."""
    reader = workspace.part(LiveReader)
    events = [GestureEvent("begun", 1, "negative", None, "cnn", begun_s - 0.4, begun_s - 0.2)]
    if gesture is not None:
        events.append(GestureEvent("named", 1, "negative", gesture, "cnn", begun_s - 0.4, begun_s))
    if ended_s is not None:
        events.append(GestureEvent("ended", 1, "negative", gesture, "cnn", ended_s - 0.3, ended_s))
    with reader._lock:
        for event in events:
            reader._take_event(event, 0.0)


def marked(workspace: Workspace, subject: str = "S07", right: str = "") -> int:
    """Mark the last event."""
    feedback = workspace.part(Feedback)
    event = feedback.last_event()
    assert event is not None
    return feedback.mark(event.number, subject, right)


def kept(workspace: Workspace, subject: str = "S07") -> list[Correction]:
    return read_corrections(workspace.folder / "feedback" / f"{subject}.jsonl")


def test_the_last_named_event_is_kept_with_the_rows_before_it(workspace: Workspace) -> None:
    reader, feedback = workspace.part(LiveReader), workspace.part(Feedback)
    assert feedback.last_event() is None
    report(workspace, 25.0, 26.5)
    report(workspace, 30.0, 31.0, gesture=None)
    event = feedback.last_event()
    assert event is not None and (event.gesture, event.named_s, event.closed_s) == (HIT, 25.0, 26.5)
    assert marked(workspace, " S07 ", PULL) == 1
    (found,) = kept(workspace)
    assert (found.subject, found.gesture, found.right) == ("S07", HIT, PULL)
    assert (found.begun_s, found.ended_s) == (pytest.approx(LEAD_S, abs=0.02), pytest.approx(LEAD_S + 1.5, abs=0.02))
    # The very rows of the toy, with its own clock.
    assert reader.device is not None
    rows = {f.device_ms: f.values for f in reader.device.buffer.frames(60.0)}
    assert len(found.frames) == pytest.approx(950, abs=3)
    assert all(rows[ms] == tuple(v) for ms, v in zip(found.frames.device_ms, found.frames.values.tolist(), strict=True))
    file = workspace.folder / "feedback" / "S07.jsonl"
    assert os.name != "posix" or stat.S_IMODE(file.stat().st_mode) == 0o600
    assert feedback.last_event() is None, "it is marked"
    with pytest.raises(ConfigError, match="marked already"):
        feedback.mark(event.number, "S07")


def test_an_event_that_lasts_is_kept_until_now_and_a_long_one_in_part(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    report(workspace, 12.0, None)
    assert marked(workspace) == 1
    (found,) = kept(workspace)
    assert found.ended_s == pytest.approx(LEAD_S + EVENT_S, abs=0.02)
    assert found.begun_s == pytest.approx(LEAD_S, abs=0.02)
    assert reader.device is not None
    newest_ms = reader.device.buffer.frames(1.0)[-1].device_ms
    assert found.frames.device_ms[-1] == pytest.approx(newest_ms, abs=100)


def test_an_event_long_ago_cannot_be_marked(workspace: Workspace) -> None:
    report(workspace, 10.0, 12.0)
    feedback, reader = workspace.part(Feedback), workspace.part(LiveReader)
    reader.now = replace(reader.now, t_s=11.6 + WAIT_S)
    assert feedback.last_event() is not None
    reader.now = replace(reader.now, t_s=12.0 + WAIT_S)
    assert feedback.last_event() is None
    with pytest.raises(ConfigError, match="not kept any more"):
        feedback.mark(99, "S07")


def test_what_is_no_code_or_no_gesture_is_refused(workspace: Workspace) -> None:
    report(workspace, 25.0, 26.0)
    for subject in ("", "Anna", "../S07"):
        with pytest.raises(DatasetError, match="no code"):
            marked(workspace, subject)
    for right, words in (("Shake", "no gesture 'Shake'"), (HIT, "already")):
        with pytest.raises(BadInput, match=words):
            marked(workspace, right=right)
    assert not (workspace.folder / "feedback" / "S07.jsonl").exists()
    assert workspace.part(Feedback).last_event() is not None


def test_the_last_mark_is_removed_and_can_be_made_again(workspace: Workspace) -> None:
    feedback, file = workspace.part(Feedback), workspace.folder / "feedback" / "S07.jsonl"
    report(workspace, 20.0, 21.0)
    marked(workspace)
    first = file.read_bytes()
    report(workspace, 30.0, 31.0)
    assert marked(workspace) == feedback.count("S07") == 2
    assert feedback.undo("S07") == 1
    assert file.read_bytes() == first
    assert os.name != "posix" or stat.S_IMODE(file.stat().st_mode) == 0o600
    event = feedback.last_event()
    assert event is not None and event.named_s == 30.0
    assert feedback.undo("S07") == feedback.undo("S07") == feedback.count("S07") == 0
    assert not file.exists()


def test_a_bundle_is_improved_beside_the_former_one(workspace: Workspace) -> None:
    feedback, reader = workspace.part(Feedback), workspace.part(LiveReader)
    former = reader.choice.bundle
    assert former is not None
    before = former.read_bytes()
    report(workspace, 20.0, 21.0)
    marked(workspace, right=PULL)
    done = feedback.improve("S07")
    assert (done.name, done.before.stem) == ("one-for-S07", "one")
    assert done.marks is not None and done.marks.after < done.marks.before
    assert reader.choice.bundle == workspace.folder / "bundles" / "one-for-S07.plush"
    made = Bundle.load(reader.choice.bundle)
    assert made.adapted_to == "S07"
    assert (
        made.weights["dense.bias"].tolist()
        == correct(Bundle.load(former), kept(workspace)).bundle.weights["dense.bias"].tolist()
    )
    # Again, with the improved one in use: another name, from the weights before.
    again = feedback.improve("S07")
    assert (again.name, again.before.stem) == ("one-for-S07-2", "one-for-S07")
    feedback.take_back(again)
    assert reader.choice.bundle == again.before
    assert former.read_bytes() == before
    with pytest.raises(DatasetError, match=r"S08\.jsonl"):
        feedback.improve("S08")
    report(workspace, 30.0, 31.0)
    marked(workspace, "S08")
    with pytest.raises(BundleError, match="adapted to S07"):
        feedback.improve("S08")
    assert len(workspace.bundles()) == 3


def test_marks_that_do_not_help_change_nothing(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    feedback, reader = workspace.part(Feedback), workspace.part(LiveReader)
    report(workspace, 20.0, 21.0)
    marked(workspace)

    def refuse(bundle: Bundle, corrections: list[Correction]) -> object:
        return replace(correct(bundle, corrections), accepted=False, refusal="nothing_in_common")

    monkeypatch.setattr("plushsense.studio.pages.live.feedback.correct", refuse)
    choice = reader.choice
    done = feedback.improve("S07")
    assert done.name == "" and done.marks is not None and done.marks.refusal == "nothing_in_common"
    assert reader.choice == choice and len(workspace.bundles()) == 1


def test_an_event_of_a_gesture_that_the_bundle_in_use_lacks_is_not_offered(workspace: Workspace) -> None:
    report(workspace, 25.0, 26.0)
    reader = workspace.part(LiveReader)
    reader.bundle = Bundle.load(odd_bundle(workspace.folder / "bundles" / "circus.plush", gestures=OTHER))
    assert workspace.part(Feedback).last_event() is None


@pytest.mark.parametrize("ended_s", [20.0, 20.01, 20.04])
def test_the_network_answers_in_the_shortest_event(workspace: Workspace, ended_s: float) -> None:
    reader = workspace.part(LiveReader)
    assert reader.device is not None and reader.bundle is not None
    _, frames = reader.device.buffer.rows()
    cut = cut_correction(reader.bundle, frames, HIT, 20.0, ended_s, subject="S07")
    assert correct(reader.bundle, [cut]).corrections == 1
    with pytest.raises(BadInput, match="not kept any more"):
        cut_correction(reader.bundle, frames.slice(0, 0), HIT, 20.0, 21.0, subject="S07")
    assert np.array_equal(Correction.from_line(cut.to_line()).frames.values, cut.frames.values)
