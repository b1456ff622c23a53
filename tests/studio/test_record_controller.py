"""The controller without a browser: sessions that are begun, taken up and ended, and commands that come late."""

from __future__ import annotations

import asyncio
import itertools
import shutil
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, DatasetError, DeviceError, PlushSenseError
from plushsense.devices.virtual.stream import VirtualDevice
from plushsense.recording.session import OpenSession, SessionRequest
from plushsense.recording.writer import SessionEvent, SessionHead, read_events
from plushsense.studio.app import toys
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.record.controller import MARKERS, NO_CONSENT, PSEUDO, ActiveSession, RecordController
from plushsense.studio.pages.record.last_recording import measure_result
from support.recording_pages import CALM, tcp_toy
from support.waiting import until

SPEED = 30.0
QUICK = SessionRequest(CALM, "S01", "quick", speed=SPEED)


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[RecordController]:
    """An empty studio's."""
    workspace = Workspace(tmp_path, toy=CALM, speed=SPEED)
    made = workspace.part(RecordController)
    yield made
    workspace.close()
    assert made.active_sessions() == []


def press(session: ActiveSession, key: str = " ") -> bool:
    """Upon what is to be seen now."""
    return session.press(key, session.recorder.status().seen)


def take(session: ActiveSession, label: str = "") -> None:
    """One recording of at least two seconds, in which the toy's person performs the gesture (``label``)."""
    toy = session.device.inner
    assert isinstance(toy, VirtualDevice)
    before = len(toy.performed)
    until(lambda: session.recorder.status().signal not in ("none", "unreadable"))
    assert press(session)
    until(lambda: session.recorder.status().state == "recording" and session.recorder.status().elapsed_s > 2)
    # The gesture of the recording before may have been performed again just now.
    until(lambda: any(label in ("", p.label) for p in toy.performed[before:]))
    assert press(session)
    until(lambda: session.recorder.status().state in ("idle", "finished"))


def test_a_session_from_its_beginning_to_its_end(controller: RecordController, tmp_path: Path) -> None:
    changes: list[int] = []
    loop = asyncio.new_event_loop()
    # In a thread of its own, as Playwright's loop may run in this one.
    hearing = threading.Thread(target=loop.run_forever)
    hearing.start()
    end = controller.changed.subscribe(lambda: changes.append(1), loop)
    session = controller.begin(QUICK)
    assert (session.name, session.head.simulated, session.notices, session.repairs) == ("S01/1", True, (), ())
    assert controller.begin(QUICK) is session, "a second tab gets the same session"
    assert controller.resume("S01/1") is session
    assert controller.get("S01/1") is session
    toy = session.device.inner
    assert isinstance(toy, VirtualDevice)
    until(lambda: bool(changes))
    begun = len(changes)
    made = ["Back stroke 1", "Head stroke 1", "Hold strong", "Tail tap 1"]
    for label in made:
        take(session, label)
    assert session.recorder.status().state == "finished"
    until(lambda: len(changes) > begun)
    end()
    loop.call_soon_threadsafe(loop.stop)
    hearing.join(10)
    loop.close()
    # During a recording that takes longer on a busy machine, the person performs its gesture again.
    labels = [label for label, _ in itertools.groupby(p.label for p in toy.performed)]
    assert labels == made
    assert [bool(s.file) for s in session.recorder.steps()] == [True] * 4
    # The tap sees what the recorder gets.
    assert session.device.buffer.count == pytest.approx(session.recorder.status().rows, abs=400)
    # The next session of this person makes the finished one way.
    again = controller.begin(QUICK)
    assert (again.name, [s.name for s in controller.active_sessions()]) == ("S01/2", ["S01/2"])
    controller.close_session("S01/2")
    controller.close_session("S01/2")
    assert [(s.folder.name, s.finished) for s in controller.sessions()] == [("2", False), ("1", True)]
    with pytest.raises(ConfigError, match="finished"):
        controller.resume("S01/1")


def test_a_session_begins_although_the_last_event_of_the_one_before_is_not_yet_written(
    controller: RecordController, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = controller.begin(QUICK)
    log, closing = session.recorder.session.log, threading.Event()
    write, close = log.write, session.recorder.close

    def write_late(events: list[SessionEvent]) -> None:
        if any(e.kind == "finished" for e in events):
            closing.wait(60)
        write(events)

    def close_it() -> None:
        closing.set()
        close()

    monkeypatch.setattr(log, "write", write_late)
    monkeypatch.setattr(session.recorder, "close", close_it)
    for number in range(4):
        press(session, "go:" + str(number))
        press(session, "s")
    assert session.recorder.status().state == "finished"
    assert controller.begin(QUICK).name == "S01/2"


def test_a_command_counts_once(controller: RecordController, tmp_path: Path) -> None:
    session = controller.begin(QUICK)
    until(lambda: session.recorder.status().signal not in ("none", "unreadable"))
    seen = session.recorder.status().seen
    answers: list[bool] = []
    threads = [threading.Thread(target=lambda: answers.append(session.press(" ", seen))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(answers) == [False] * 7 + [True]
    until(lambda: session.recorder.status().state == "recording")
    for stale in (seen, "", "recording.1.0.0.0"):
        assert not session.press(" ", stale)
    assert session.recorder.status().state == "recording"
    for key in ("x", "", "go:", "go:4", "go:-1", "q"):
        with pytest.raises(ConfigError, match="is no command here"):
            session.press(key, session.recorder.status().seen)
    assert press(session, "r")
    assert press(session, "go:2")
    assert session.recorder.status().step.number == 2
    assert press(session, "b")
    assert press(session, "p")
    assert session.recorder.status().state == "paused"
    assert press(session, "p")
    assert press(session, "s")
    assert [e.kind for e in read_events(tmp_path / "recordings" / "S01" / "1")].count("countdown") <= 1


def test_a_session_is_finished_renamed_and_discarded_only_when_it_is_closed(
    controller: RecordController, tmp_path: Path
) -> None:
    session = controller.begin(QUICK)
    for change in (
        lambda: controller.finish("S01/1"),
        lambda: controller.rename_person("S01/1", "S02"),
        lambda: controller.discard("S01/1"),
    ):
        with pytest.raises(ConfigError, match="is being recorded. End it first"):
            change()
    take(session)
    controller.close_session("S01/1")
    controller.finish("S01/1")
    with pytest.raises(ConfigError, match="is finished"):
        controller.resume("S01/1")
    controller.finish("S01/1", finished=False)
    assert not controller.sessions()[0].finished
    with pytest.raises(DatasetError, match="no code for a person"):
        controller.rename_person("S01/1", "Anna")
    controller.close_session(controller.begin(SessionRequest(CALM, "S02", "quick", speed=SPEED)).name)
    assert controller.rename_person("S01/1", "S01") == "S01/1"
    assert controller.rename_person("S01/1", "S02") == "S02/2"
    head = SessionHead.read(tmp_path / "recordings/S02/2")
    assert head is not None and (head.subject, head.session) == ("S02", "2")
    assert [e.details for e in read_events(tmp_path / "recordings/S02/2") if e.kind == "renamed"] == [
        {"subject": "S01", "session": "1"}
    ]
    assert len(take_files := list((tmp_path / "recordings/S02/2").glob("*_*_*.csv"))) == 1
    discarded = controller.discard("S02/2")
    assert (discarded / take_files[0].name).is_file()
    assert [s.name for s in controller.sessions()] == ["S02/1"]
    with pytest.raises(ConfigError, match="no session"):
        controller.finish("S02/2")


def test_two_tabs_begin_one_session(controller: RecordController) -> None:
    made: list[ActiveSession] = []
    threads = [threading.Thread(target=lambda: made.append(controller.begin(QUICK, anew=True))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 4
    assert {id(s) for s in made} == {id(made[0])}
    assert len(controller.sessions()) == 1


def test_an_unfinished_session_is_gone_on_with(controller: RecordController, tmp_path: Path) -> None:
    session = controller.begin(QUICK)
    take(session)
    press(session)
    until(lambda: session.recorder.status().state == "recording")
    controller.close_session("S01/1")
    with pytest.raises(ConfigError, match="S01 has an unfinished session, S01/1"):
        controller.begin(QUICK)
    assert controller.active_sessions() == []
    again = controller.resume("S01/1")
    assert (again.recorder.status().done, again.request.speed, again.request.device) == (1, SPEED, CALM)
    controller.close_session("S01/1")
    assert controller.begin(QUICK, anew=True).name == "S01/2"


def test_what_is_refused_leaves_nothing(controller: RecordController, tmp_path: Path) -> None:
    outside = tmp_path.parent / "outside.toml"
    outside.write_text('name = "x"\ngesture_set = "plush-18"\n', encoding="utf-8")
    refused: list[tuple[SessionRequest, str]] = [
        (SessionRequest(CALM, "Anna", "quick"), "no code"),
        (SessionRequest(CALM, "../S01", "quick"), "no code"),
        (SessionRequest(CALM, "", "quick"), "The session has no person"),
        (SessionRequest(CALM, "S01", str(outside)), "list of gestures is gone"),
        (SessionRequest(CALM, "S01", "quick", layout=str(outside)), "sensor layout is gone"),
        (SessionRequest(CALM, "S01", "quick", words="xx"), "no wording"),
        (SessionRequest(f"{CALM}&layout={outside}", "S01"), "is a file"),
        (SessionRequest("replay:///etc/passwd", "S01"), "is a file"),
        (SessionRequest("/etc/passwd", "S01"), "is a file"),
        (SessionRequest("serial:///dev/nowhere", "S01"), "there is no port"),
        (SessionRequest("telepathy://x", "S01"), "no scheme"),
        (SessionRequest(CALM, "S01", speed=-1.0), "0 .* to 1000"),
    ]
    for wanted, said in refused:
        with pytest.raises(PlushSenseError, match=said):
            controller.begin(wanted)
    for name in ("S01/1", "../x", "..", "/etc", "S01", ""):
        with pytest.raises(ConfigError):
            controller.resume(name)
    assert controller.active_sessions() == []
    assert controller.sessions() == []


def test_a_users_own_protocol_and_layout(controller: RecordController, tmp_path: Path) -> None:
    (tmp_path / "protocols").mkdir()
    own = tmp_path / "protocols" / "mine.toml"
    own.write_text('name = "mine"\ngesture_set = "plush-18"\ngestures = ["Tail pull"]\nrepetitions = 2\n', "utf-8")
    assert next(iter(controller.protocols())) == "plush-17"
    assert controller.protocols()[str(own)] == "mine"
    assert "plush-14" in controller.layouts()
    session = controller.begin(SessionRequest(CALM, "S02", str(own), layout="plush-14", speed=SPEED))
    assert [s.step.gesture for s in session.recorder.steps()] == ["Tail pull"] * 2
    assert session.device.layout.name == "plush-14"
    controller.close_session("S02/1")
    # The protocol and the layout are the session's: the files may be gone.
    own.unlink()
    assert controller.resume("S02/1").device.layout.name == "plush-14"


def test_a_real_session_never_goes_on_with_a_virtual_toy(controller: RecordController, tmp_path: Path) -> None:
    with tcp_toy() as url:
        assert controller.speed_for(url, False) == 1.0
        assert controller.speed_for(url, True) == SPEED
        assert controller.speed_for("virtual://?speed=3", False) == 3.0
        session = controller.begin(SessionRequest(url, "S03", "quick"))
        assert (session.head.simulated, session.notices) == (False, (NO_CONSENT,))
        with pytest.raises(DatasetError, match="begun with a real toy"):
            controller.exchange("S03/1", CALM)
        controller.close_session("S03/1")
        with pytest.raises(DatasetError, match="begun with a real toy"):
            controller.resume("S03/1", CALM)
        assert controller.active_sessions() == []
        assert controller.resume("S03/1").name == "S03/1"
        controller.close_session("S03/1")
    with pytest.raises(DeviceError):
        controller.resume("S03/1")
    assert PSEUDO == "pseudo"


def test_a_toy_is_tried_first_and_exchanged(controller: RecordController, tmp_path: Path) -> None:
    with tcp_toy(layout="plush-14") as other_layout, socket.create_server(("127.0.0.1", 0)) as silent:
        silent_url = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        for url, why in ((other_layout, "that are not of the layout"), (silent_url, "sent nothing")):
            with pytest.raises(DeviceError) as refused, pytest.MonkeyPatch.context() as patch:
                if url == silent_url:
                    patch.setattr(toys, "_TIMEOUT_S", 0.3)
                controller.begin(SessionRequest(url, "S01", "quick"))
            assert why in str(refused.value)
        assert not (tmp_path / "recordings").exists(), "no session begins with a toy that does not work"
        session = controller.begin(replace(QUICK, device=f"{CALM}&seed=2"))
        take(session)
        press(session, "p")
        former = session.device
        for url, why in (
            (f"virtual://?person=7&seed=2&lost=0&garbled=0&glitch=0&speed={SPEED + 1:g}", "at another speed"),
            (f"{CALM}&seed=2", "already"),
            ("virtual://?persons=7", "unknown setting"),
        ):
            with pytest.raises(PlushSenseError) as refused:
                controller.exchange("S01/1", url)
            assert why in str(refused.value) and not session.device.closed
    controller.exchange("S01/1", "virtual://?person=9")
    assert (former.closed, session.device.url.startswith("virtual://?person=9")) == (True, True)
    assert (session.recorder.status().state, session.recorder.status().done) == ("paused", 1)
    press(session, "p")
    take(session)
    kinds = [e.kind for e in read_events(tmp_path / "recordings/S01/1")]
    assert [k for k in kinds if k in ("open", "take", "exchange")] == ["open", "take", "exchange", "take"]
    # The result of the last recording, compared with the only earlier one of its gesture.
    press(session, "go:0")
    take(session)
    files = sorted((tmp_path / "recordings/S01/1").glob("Back*.csv"))
    result = measure_result(session, files[-1].name, tmp_path / "recordings")
    assert (result.gesture, result.length, max(result.size)) == ("Back stroke 1", "first", 1.0)
    (tmp_path / "recordings/S02/1").mkdir(parents=True)
    for beside in (files[0], files[0].with_suffix(".json")):
        shutil.copy(beside, tmp_path / "recordings/S02/1" / beside.name)
    assert measure_result(session, files[-1].name, tmp_path / "recordings").length in ("usual", "short", "long")
    assert [replace(result, seconds=s, usual_s=2.0).length for s in (1.19, 1.21, 2.79, 2.81)] == [
        "short", "usual", "usual", "long",
    ]  # fmt: skip


@pytest.mark.usefixtures("lsl_possible")
def test_the_markers_of_a_session_are_sent_by_lsl(controller: RecordController) -> None:
    import pylsl

    session = controller.begin(QUICK, lsl=True)
    (stream,) = pylsl.resolve_byprop("name", MARKERS, timeout=20.0)
    inlet = pylsl.StreamInlet(stream)
    inlet.open_stream(timeout=20.0)
    assert session.markers is not None
    take(session)
    session.recorder.mark()
    assert [inlet.pull_sample(timeout=20.0)[0] for _ in range(3)] == [["Back stroke 1"], ["end"], ["mark"]]


def test_an_own_list_of_gestures_is_saved_chosen_and_discarded(controller: RecordController, tmp_path: Path) -> None:
    path = controller.save_protocol("Mixed", ["Tail pull", "At rest"], 2, "random")
    assert controller.protocols()[str(path)] == "Mixed"
    for name, gestures, repetitions, why in (
        ("Mixed", ["Tail pull"], 1, "exists already"),
        ("a/b", ["Tail pull"], 1, "cannot be a name"),
        ("", ["Tail pull"], 1, "cannot be a name"),
        ("none", [], 1, "at least one gesture"),
        ("none", ["Tail pull"], 0, "repetitions is 0"),
    ):
        with pytest.raises(ConfigError) as refused:
            controller.save_protocol(name, gestures, repetitions, "gesture")
        assert why in str(refused.value)
    orders = []
    for code in ("S01", "S02", "S03"):
        session = controller.begin(SessionRequest(CALM, code, str(path), words="lv", speed=SPEED))
        orders.append([(s.step.gesture, s.step.repetition) for s in session.recorder.steps()])
        assert session.recorder.steps()[0].step.prompt.startswith(("Vienreiz", "Noliec"))
        controller.close_session(session.name)
        again = controller.resume(session.name)
        assert [(s.step.gesture, s.step.repetition) for s in again.recorder.steps()] == orders[-1]
        controller.close_session(session.name)
    seeds = {SessionHead.read(s.folder).protocol["seed"] for s in controller.sessions()}  # type: ignore[union-attr]
    assert len(seeds) == 3
    place = controller._workspace.discard(path)
    assert (str(path) in controller.protocols(), controller._workspace.discarded()) == (False, [place])
    assert controller._workspace.restore(place) == path
    path.write_text("repetitions = 3", encoding="utf-8")
    with pytest.raises(ConfigError) as refused:
        controller.begin(SessionRequest(CALM, "S04", str(path), speed=SPEED))
    assert (refused.value.message.values["field"], controller.get("S04/1")) == ("protocol", None)


def test_a_session_that_another_program_has(controller: RecordController, tmp_path: Path) -> None:
    controller.begin(QUICK)
    controller.close_session("S01/1")
    held = OpenSession(tmp_path / "recordings" / "S01" / "1")
    try:
        with pytest.raises(DatasetError, match="Another program is recording"):
            controller.resume("S01/1")
        assert controller.active_sessions() == []
    finally:
        held.close()
    assert controller.resume("S01/1").recorder.status().state == "idle"
