"""One toy and one bundle for all pages: swapped while it runs, refused in a sentence, bounded in what is kept."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from plushsense.core.errors import BundleError, ConfigError, DeviceError, PlushSenseError
from plushsense.devices.virtual.server import ToyServer
from plushsense.devices.virtual.stream import ToySpec
from plushsense.live.reactions import Reactor, load_reactions
from plushsense.runtime.classifier import Decision, GestureEvent
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.live import reader as live
from plushsense.studio.pages.live.page import STRIP_S, WINDOW_S, Feed
from plushsense.studio.pages.live.reader import LiveChoice, LiveReader
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
    # An answer is set just before the time of the newest frame.
    until(lambda: (now := reader.now).network is not None and now.t_s >= now.network.t_s > before)
    now = reader.now
    assert now.network is not None
    assert now.t_s - now.network.t_s < 3.0


@pytest.mark.parametrize(
    ("name", "engine", "reactions", "kind", "told"),
    [
        ("accel", "float", "", ConfigError, "'plush-15'.*'accel-3'"),
        ("circus", "float", "", ConfigError, "'circus'"),
        ("one", "int8", "", BundleError, "calibration"),
        ("one", "float", "wild", ConfigError, "wild"),
        ("gone", "float", "", BundleError, "no bundle"),
        ("../../elsewhere", "float", "", ConfigError, "outside"),
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


def test_a_bundle_of_another_layout_says_both(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    # The same labels, so that only the channels differ.
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    with pytest.raises(ConfigError, match=r"'plush-15'.*'accel-3'"):
        reader.choose(bundle(workspace, "accel"), "float", "")
    with pytest.raises(PlushSenseError, match="plush-15"):
        reader.start(LiveChoice(f"{VIRTUAL}&layout=plush-15", bundle(workspace, "accel")))


def test_it_starts_with_sentences_or_not_at_all(workspace: Workspace) -> None:
    reader = workspace.part(LiveReader)
    with pytest.raises(ConfigError, match="No bundle"):
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
    assert reader.now.message == "The toy's data have ended."
    assert reader.now.event is None
    reader.start(LiveChoice(VIRTUAL, bundle(workspace)))
    until(lambda: reader.now.t_s > 1.0)
    reader.stop()
    assert not reader.now.running
    assert reader.now.message == ""
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
    until(lambda: reader.now.state == "no signal")
    until(lambda: "closed the connection" in reader.now.problem or "went away" in reader.now.problem)
    assert reader.now.running
    heard = reader.now.t_s
    serve(int(urls[0].rsplit(":", 1)[1]), second, urls.append)
    until(lambda: reader.now.state == "tracking")
    assert reader.now.problem == ""
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
    until(lambda: "none is a frame of the layout 'accel-3'" in reader.now.problem)
    stop.set()


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
    assert scene["simulated"] is True
    seconds = list(scene["first"]["x"])
    assert WINDOW_S - 0.2 < seconds[-1] - seconds[0] <= WINDOW_S + 0.2
    while seconds[-1] < scene["first"]["x"][-1] + 3.0:
        time.sleep(feed.wait_s())
        what, message = feed.message() or ("", {})
        assert what == "update"
        assert message["n"] > 0
        assert len(message["y"]) == 13
        assert {len(column) for column in message["y"]} == {len(message["x"])}
        seconds += message["x"]
        feed.seen(message["n"])
    assert message["round"] > 0.0
    assert seconds == sorted(set(seconds)), "each sample once, none left out"
    assert max(b - a for a, b in pairwise(seconds)) < 0.1
    for name in ("hidden", "away"):
        setattr(feed, name, True)
        assert feed.message() is None
        setattr(feed, name, False)
    while not feed.holds:
        feed.message()
    assert feed.message() is None, "a page that says nothing is sent nothing more"
    feed.again()
    assert (feed.message() or ("",))[0] == "scene"


def test_the_reaction_ends_in_its_time(workspace: Workspace) -> None:
    reader = LiveReader(workspace)
    reader.now = replace(reader.now, state="tracking")
    bundle_run = live._BundleRun(None, None, Reactor(load_reactions("standard")), 10.0)  # type: ignore[arg-type]

    def decide(t_s: float, *events: GestureEvent) -> None:
        reader._take_in(
            Decision(t_s, "Tail pull", "negative", 0.9, "cnn", "tracking", None, "sure", events), bundle_run
        )

    decide(1.0, GestureEvent("begun", 1, "negative", None, "gate", 0.9, 1.0))
    assert reader.now.reaction is not None
    assert (reader.now.reaction.eyes, reader.now.reaction.sound) == ("red", "shriek")
    assert reader.now.reaction_ends_s == 12.0
    decide(1.95)
    assert reader.now.reaction is not None
    decide(2.0)
    assert reader.now.reaction is None
    assert reader.now.event is not None
    assert reader.now.event.begin_s == 10.9
