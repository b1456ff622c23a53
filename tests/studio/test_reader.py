"""One toy and one bundle for all pages: swapped while it runs, refused in a sentence, bounded in what is kept."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from plushsense.core.errors import BundleError, ConfigError, DeviceError, PlushSenseError
from plushsense.core.gestures import load_gestures
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import ToySpec
from plushsense.live.reactions import ReactionRule, Reactions, Reactor, load_reactions
from plushsense.runtime.classifier import Decision, GestureEvent
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live import reader as live
from plushsense.studio.pages.live.feed import STRIP_S, WINDOW_S, Feed
from plushsense.studio.pages.live.live_state import EventSpan, LiveChoice, LiveState, Situation, quiet_reason
from plushsense.studio.pages.live.reader import LiveReader
from support.bundles import OTHER, odd_bundle
from support.waiting import until

VIRTUAL = "virtual://?person=31"


@pytest.fixture
def workspace(tmp_path: Path) -> Iterator[Workspace]:
    """A studio's folder with bundles that say nothing sensible, its virtual toys at twenty times the speed."""
    places = tmp_path / "home" / "bundles"
    odd_bundle(places / "one.plush")
    odd_bundle(places / "two.plush")
    odd_bundle(places / "circus.plush", gestures=OTHER)
    odd_bundle(places / "accel.plush", "accel-3")
    made = Workspace(tmp_path / "home", speed=20.0)
    yield made
    made.close()


def bundle(workspace: Workspace, name: str = "one") -> Path:
    return workspace.folder / "bundles" / f"{name}.plush"


def test_a_bundle_is_swapped_without_opening_the_toy_again(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.state == "tracking")
    device, generation, before = reader.device, reader.now.generation, reader.now.t_s
    reader.choose(bundle(workspace, "two"), "float", "gentle")
    until(lambda: reader.now.generation == generation + 1)
    until(lambda: reader.now.state == "tracking")
    assert reader.device is device
    assert device is not None
    assert not device.closed
    assert reader.choice == LiveChoice(VIRTUAL, bundle(workspace, "two"), "float", "gentle", True)
    # Time goes on: the second bundle's own clock began with its first frame.
    until(lambda: reader.now.probabilities is not None and reader.now.t_s > before + 1.0)


@pytest.mark.parametrize(
    ("name", "engine", "reactions", "kind", "told"),
    [
        ("accel", "float", "", ConfigError, "'plush-15'.*'accel-3'"),
        ("circus", "float", "", ConfigError, "circus"),
        ("one", "int8", "", BundleError, "calibration"),
        ("one", "float", "wild", ConfigError, "wild"),
        ("gone", "float", "", BundleError, "cannot be read"),
        ("../../elsewhere", "float", "", ConfigError, "not in the studio's folder"),
    ],
)
def test_what_does_not_fit_is_refused_and_what_ran_goes_on(
    name: str, engine: str, reactions: str, kind: type[PlushSenseError], told: str, workspace: Workspace
) -> None:
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.state == "tracking")
    before, generation = reader.choice, reader.now.generation
    with pytest.raises(kind, match=told):
        reader.choose(bundle(workspace, name), engine, reactions)
    at = reader.now.t_s
    until(lambda: reader.now.t_s > at + 1.0)
    assert (reader.choice, reader.now.generation) == (before, generation)
    assert reader.now.running


def test_it_starts_with_sentences_or_not_at_all(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    with pytest.raises(ConfigError, match="No network is chosen"):
        reader.start(LiveChoice(VIRTUAL))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match="nobody listens"):
        reader.start(LiveChoice(f"tcp://127.0.0.1:{port}", bundle(workspace)))
    assert not reader.now.running
    reader.choose(bundle(workspace, "two"), "float", "")
    assert reader.choice.bundle == bundle(workspace, "two"), "for the next start"


def test_it_ends_with_the_toy_and_by_command(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(f"{VIRTUAL}&seconds=5", bundle(workspace)))
    until(lambda: not reader.now.running)
    assert reader.now.ended is not None and "have ended" in str(reader.now.ended)
    assert reader.now.event is None
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.t_s > 1.0)
    reader.stop()
    assert not reader.now.running
    assert reader.now.ended is None
    assert reader.now.situation.kind == "stopped"
    assert not [t for t in threading.enumerate() if t.name == "plushsense-live"]


def test_a_toy_that_nobody_looks_at_is_let_go(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "ALONE_S", 0.2)
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    going_on = [True]
    first, second = (reader.add_viewer(lambda: going_on[0]) for _ in range(2))
    first()
    time.sleep(0.5)
    assert reader.now.running, "one page still looks"
    second()
    reloaded = reader.add_viewer(lambda: going_on[0])
    time.sleep(0.5)
    assert reader.now.running, "a page that was loaded again"
    reloaded()
    time.sleep(0.5)
    assert reader.now.running, "a clip is being recorded"
    going_on[0] = False
    until(lambda: not reader.now.running)


def test_a_toy_that_goes_away_comes_back(workspace: Workspace) -> None:
    def serve(port: int, stop: threading.Event, ready: Callable[[str], None]) -> threading.Thread:
        thread = threading.Thread(
            target=ToyServer(ToySpec(31), on_ready=ready, stop=stop).serve_tcp, args=(port,), daemon=True
        )
        thread.start()
        return thread

    urls: list[str] = []
    first, second = threading.Event(), threading.Event()
    thread = serve(0, first, urls.append)
    until(lambda: urls)
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(urls[0], bundle(workspace)))
    until(lambda: reader.now.state == "tracking")
    first.set()
    thread.join()
    until(lambda: reader.now.state == "no signal" and reader.now.situation.kind == "gone")
    assert reader.now.running
    assert reader.now.event is None
    heard = reader.now.t_s
    serve(int(urls[0].rsplit(":", 1)[1]), second, urls.append)
    until(lambda: reader.now.state == "tracking")
    assert reader.now.connection == ""
    # A toy that was switched on again counts from 0; the page's time goes on.
    assert reader.now.t_s >= heard
    second.set()


def test_lines_that_are_no_frames_are_told(workspace: Workspace) -> None:
    stop, urls = threading.Event(), list[str]()
    threading.Thread(
        target=ToyServer(ToySpec(31), speed=20.0, on_ready=urls.append, stop=stop).serve_tcp,
        args=(0,),
        daemon=True,
    ).start()
    until(lambda: urls)
    reader = workspace.part(LiveReader)
    reader.start(LiveChoice(urls[0], bundle(workspace, "accel")))
    until(lambda: reader.now.situation.kind == "unreadable")
    scene = Feed(reader).scene()
    assert (scene["layout"], scene["numbers"]) == ("accel-3", 4)
    assert "15 numbers a line, but layout 'accel-3' has 4" in scene["first"]["now"]["why"]
    stop.set()


def test_a_port_that_sends_nothing_is_no_calm_toy(workspace: Workspace) -> None:
    with socket.create_server(("127.0.0.1", 0)) as dead:
        reader = workspace.part(LiveReader)
        reader.start(LiveChoice(f"tcp://127.0.0.1:{dead.getsockname()[1]}", bundle(workspace)))
        assert reader.now.situation.kind == "connecting"
        until(lambda: reader.now.situation.kind == "silent")
        reader.stop()


def test_what_is_kept_is_bounded_and_every_event_ends(workspace: Workspace) -> None:
    reader = LiveReader(workspace)
    for n in range(1, 2 * live.KEPT_SPANS):
        for what in ("begun", "named", "ended"):
            gesture = None if what == "begun" else "Tail pull"
            event = GestureEvent(what, n, "negative", gesture, "gate", float(n), float(n))  # type: ignore[arg-type]
            with reader._lock:
                reader._take_event(event, 100.0)
    spans = reader.spans()
    assert len(spans) == live.KEPT_SPANS
    assert all(s.end_s is not None and s.gesture == "Tail pull" for s in spans)
    assert [s.number for s in spans] == list(range(live.KEPT_SPANS, 2 * live.KEPT_SPANS))
    assert reader.spans(spans[-2].change) == [spans[-1]]
    assert len(reader.events()) == 2 * live.KEPT_SPANS - 1, "the log has them all"
    late = GestureEvent("begun", 9999, "negative", None, "gate", live.KEPT_SPAN_S + 2 * live.KEPT_SPANS - 1.5, 0.0)
    with reader._lock:
        reader._take_event(late, 100.0)
    assert next(s.begin_s for s in reader.spans()) >= late.since_s + 100.0 - live.KEPT_SPAN_S
    reader.close()


def test_a_feed_sends_everything_once_and_anew_when_it_missed_some(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    feed = Feed(reader)
    empty = feed.scene()
    assert (empty["channels"], empty["classes"], empty["strip"]) == ([], [], STRIP_S)
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.t_s > WINDOW_S + 2.0)
    due = feed.message()
    assert due is not None
    what, scene = due
    assert what == "scene", "another toy is another scene"
    assert len(scene["channels"]) == 13
    assert len(scene["classes"]) == 18
    assert reader.simulated == "toy"
    seconds = list(scene["first"]["x"])
    assert WINDOW_S - 0.2 < seconds[-1] - seconds[0] <= WINDOW_S + 0.2
    while seconds[-1] < scene["first"]["x"][-1] + 3.0:
        time.sleep(feed.wait_s())
        what, message = feed.message() or ("", {})
        assert what == "update"
        assert message["n"] > 0
        feed.seen(message["n"])
        # The signals are sent less often than the decision.
        if "x" in message:
            assert len(message["y"]) == 13
            assert {len(column) for column in message["y"]} == {len(message["x"])}
            seconds += message["x"]
    assert message["round"] > 0.0
    assert seconds == sorted(set(seconds)), "each sample once, none left out"
    assert max(b - a for a, b in pairwise(seconds)) < 0.1
    for name in ("hidden", "away"):
        setattr(feed, name, True)
        assert feed.message() is None
        setattr(feed, name, False)
    feed.seen(10**9)  # a page cannot have drawn what was not sent
    begun = time.monotonic()
    while not feed.holds:
        assert time.monotonic() - begun < 60.0
        feed.message()
    assert feed.message() is None, "a page that says nothing is sent nothing more"
    feed.again()
    assert (feed.message() or ("",))[0] == "scene"


def decided(reader: LiveReader, profile: str = "standard") -> Callable[..., None]:
    """Return a function that gives the reader a decision, of a toy whose first frame came at 10 s."""
    reader.now = replace(reader.now, running=True, state="tracking")
    gestures = load_gestures("plush-18")
    reactor = Reactor(load_reactions(profile)) if profile else None
    bundle_run = live._BundleRun(SimpleNamespace(gestures=gestures), None, reactor, 10.0)  # type: ignore[arg-type]

    def decide(
        t_s: float, *events: GestureEvent, answer: str = "idle", state: Any = "tracking", **likely: float
    ) -> None:
        shares = tuple(likely.get(g.label.replace(" ", "_"), 0.0) for g in gestures.gestures)
        decision = Decision(t_s, None, None, None, "cnn", state, shares if likely else None, answer, events)
        reader._take_in(decision, bundle_run)

    return decide


def test_the_reaction_ends_in_its_time(workspace: Workspace) -> None:
    reader = LiveReader(workspace)
    decide = decided(reader)
    decide(1.0, GestureEvent("begun", 1, "negative", None, "gate", 0.9, 1.0))
    now = reader.now.situation
    assert (now.kind, now.affect, now.gesture, now.eyes, now.sound) == ("event", "negative", None, "red", "shriek")
    assert reader.now.reaction_ends_s == 12.0
    decide(1.95)
    assert reader.now.situation.eyes == "red"
    decide(2.0)
    now = reader.now.situation
    assert (now.kind, now.eyes, now.quiet) == ("event", "off", "over")
    assert reader.now.event is not None
    assert reader.now.event.begin_s == 10.9
    decide(2.1, GestureEvent("ended", 1, "negative", None, "gate", 2.0, 2.1))
    decide(2.2, GestureEvent("begun", 2, "negative", None, "gate", 2.2, 2.2))
    assert reader.now.situation.quiet == "pause"
    decide(2.3, state="no signal")
    assert reader.now.situation == Situation("silent")


def test_there_is_one_situation_whatever_the_network_computes(workspace: Workspace) -> None:
    reader = LiveReader(workspace)
    decide = decided(reader, "gentle")
    # The network is as sure as can be, and yet there is no event.
    decide(1.0, answer="unknown", Back_stroke_1=0.93)
    assert reader.now.situation == Situation("unknown")
    for answer, kind in (("idle", "nothing"), ("unsure", "unsure"), ("sure", "unsure")):
        decide(1.1, answer=answer, Back_stroke_1=0.93)
        assert reader.now.situation == Situation(kind)  # type: ignore[arg-type]
    begun = GestureEvent("begun", 1, "positive", None, "cnn", 1.0, 1.2)
    decide(1.2, begun, answer="affect", Back_stroke_1=0.5, Ear_scratch_1=0.3)
    assert (now := reader.now.situation).kind == "event"
    assert now.confidence == pytest.approx(0.8)
    decide(
        1.3, GestureEvent("named", 1, "positive", "Back stroke 1", "cnn", 1.0, 1.3), answer="sure", Back_stroke_1=0.6
    )
    decide(1.4, answer="unknown", Back_stroke_1=0.7)
    decide(1.5, answer="unknown", Back_stroke_1=0.2)
    now = reader.now.situation
    assert (now.kind, now.gesture, now.eyes, now.sound) == ("event", "Back stroke 1", "green", "purr")
    assert now.confidence == pytest.approx(0.7)
    decide(1.6, GestureEvent("ended", 1, "positive", "Back stroke 1", "cnn", 1.5, 1.6))
    now = reader.now.situation
    assert (now.kind, now.eyes, now.reacts_to) == ("nothing", "green", "positive")
    (event,) = reader.events()
    assert (event.eyes, event.sound, event.gesture, event.end_s) == ("green", "purr", "Back stroke 1", 11.5)
    assert event.confidence == pytest.approx(0.7)
    decide(5.0, GestureEvent("begun", 2, "negative", None, "gate", 5.0, 5.0), Back_stroke_1=0.9)
    now = reader.now.situation
    assert (now.quiet, now.confidence, now.eyes) == ("dark", None, "off"), "the gate decided, not the network"


def test_why_the_toy_does_not_react() -> None:
    standard, event = load_reactions("standard"), EventSpan(1, 1, 1, 0.0, "positive", None, "cnn")
    assert quiet_reason(None, event) == "off"
    assert quiet_reason(standard, replace(event, affect="neutral")) == "none"
    own = Reactions("own", (ReactionRule("positive", eyes="green", seconds=1.0, when="named"),))
    assert quiet_reason(own, event) == "named"
    assert quiet_reason(own, replace(event, gesture="Back stroke 1")) == "pause"
    for state, kind in (
        (LiveState(), "stopped"),
        (LiveState(running=True, connection="connecting", state="warming"), "connecting"),
        (LiveState(running=True, connection="gone", state="tracking", event=event), "gone"),
        (LiveState(running=True, state="sensor fault"), "sensor_fault"),
        (LiveState(running=True, state="warming"), "warming"),
        (LiveState(running=True, state="warming", event=event), "event"),
    ):
        assert state.situation.kind == kind


def test_the_virtual_person_does_what_is_asked(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    with pytest.raises(ConfigError, match="No virtual toy"):
        reader.direct("Tail pull")
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.performed())
    reader.direct("Tail pull")
    assert reader.now.next_gesture == "Tail pull"
    until(lambda: reader.performed()[-1].label == "Tail pull" and reader.now.next_gesture == "")
    made = reader.performed()
    until(lambda: reader.now.t_s > made[-1].end_s + 10.0)
    assert reader.performed() == made, "and then nothing more"
    reader.direct(None)
    until(lambda: len(reader.performed()) > len(made) + 1)
    reader.direct("")
    until(lambda: reader.now.t_s > reader.performed()[-1].end_s + 10.0)
    reader.stop()
    assert reader.person is None


def test_a_feed_keeps_the_rates_that_were_chosen(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    feed = Feed(reader)
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.state == "tracking")
    assert (feed.message() or ("",))[0] == "scene"
    feed.plot_s, feed.decision_s = 3600.0, 0.0
    _, message = feed.message() or ("", {})
    assert "p" in message and "x" not in message
    feed.plot_s, feed.decision_s = 0.0, 3600.0
    _, message = feed.message() or ("", {})
    assert "x" in message and "p" not in message
    reader.stop()
    _, message = feed.message() or ("", {})
    assert message["now"]["kind"] == "stopped", "that no toy is read is displayed at once"
