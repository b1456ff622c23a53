"""One toy and one bundle for all pages: swapped while it runs, refused in a sentence, bounded in what is kept."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from bundles import OTHER, odd_bundle

from plushsense.apps.studio import listening as room
from plushsense.apps.studio.feeding import STRIP_S, WINDOW_S, Feed
from plushsense.apps.studio.felt import Choice
from plushsense.apps.studio.house import House
from plushsense.apps.studio.listening import Listening
from plushsense.core.errors import BundleError, ConfigError, DeviceError, PlushSenseError
from plushsense.devices.toy import serve_tcp
from plushsense.devices.virtual.stream import ToySpec
from plushsense.live.react import Reactor, load_reactions
from plushsense.live.stream import Decision, Event

VIRTUAL = "virtual://?person=31"


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait for something that another thread does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    """A studio's folder with bundles that say nothing sensible, its virtual toys at twenty times the speed."""
    places = tmp_path / "home" / "bundles"
    odd_bundle(places / "one.plush")
    odd_bundle(places / "two.plush")
    odd_bundle(places / "circus.plush", gestures=OTHER)
    odd_bundle(places / "accel.plush", "accel-3")
    made = House(tmp_path / "home", speed=20.0)
    yield made
    made.close()


def bundle(house: House, name: str = "one") -> Path:
    return house.folder / "bundles" / f"{name}.plush"


def test_a_bundle_is_swapped_without_opening_the_toy_again(house: House) -> None:
    listening = house.part(Listening)
    listening.start(Choice(VIRTUAL, bundle(house)))
    until(lambda: listening.now.state == "tracking")
    device, generation, before = listening.device, listening.now.generation, listening.now.t_s
    listening.choose(bundle(house, "two"), "float", "gentle")
    until(lambda: listening.now.generation == generation + 1)
    until(lambda: listening.now.state == "tracking")
    assert listening.device is device
    assert device is not None
    assert not device.closed
    assert listening.choice == Choice(VIRTUAL, bundle(house, "two"), "float", "gentle", True)
    # Time goes on: the second bundle's own clock began with its first frame.
    assert listening.now.network is not None
    assert listening.now.t_s >= listening.now.network.t_s > before
    assert listening.now.t_s - listening.now.network.t_s < 3.0


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
    name: str, engine: str, reactions: str, kind: type[PlushSenseError], told: str, house: House
) -> None:
    listening = house.part(Listening)
    listening.start(Choice(VIRTUAL, bundle(house)))
    until(lambda: listening.now.state == "tracking")
    before, generation = listening.choice, listening.now.generation
    with pytest.raises(kind, match=told):
        listening.choose(bundle(house, name), engine, reactions)
    at = listening.now.t_s
    until(lambda: listening.now.t_s > at + 1.0)
    assert (listening.choice, listening.now.generation) == (before, generation)
    assert listening.now.running


def test_a_bundle_of_another_layout_says_both(house: House) -> None:
    listening = house.part(Listening)
    # The same labels, so that only the channels differ.
    listening.start(Choice(VIRTUAL, bundle(house)))
    with pytest.raises(ConfigError, match=r"'plush-15'.*'accel-3'"):
        listening.choose(bundle(house, "accel"), "float", "")
    with pytest.raises(PlushSenseError, match="plush-15"):
        listening.start(Choice(f"{VIRTUAL}&layout=plush-15", bundle(house, "accel")))


def test_it_starts_with_sentences_or_not_at_all(house: House) -> None:
    listening = house.part(Listening)
    with pytest.raises(ConfigError, match="No bundle"):
        listening.start(Choice(VIRTUAL))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DeviceError, match="nobody listens"):
        listening.start(Choice(f"tcp://127.0.0.1:{port}", bundle(house)))
    assert not listening.now.running
    listening.choose(bundle(house, "two"), "float", "")
    assert listening.choice.bundle == bundle(house, "two"), "for the next start"


def test_it_ends_with_the_toy_and_by_command(house: House) -> None:
    listening = house.part(Listening)
    listening.start(Choice(f"{VIRTUAL}&seconds=5", bundle(house)))
    until(lambda: not listening.now.running)
    assert listening.now.said == "The toy's data have ended."
    assert listening.now.event is None
    listening.start(Choice(VIRTUAL, bundle(house)))
    until(lambda: listening.now.t_s > 1.0)
    listening.stop()
    assert not listening.now.running
    assert listening.now.said == ""
    assert not [t for t in threading.enumerate() if t.name == "plushsense-live"]


def test_a_toy_that_nobody_looks_at_is_let_go(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "ALONE_S", 0.2)
    listening = house.part(Listening)
    listening.start(Choice(VIRTUAL, bundle(house)))
    going_on = [True]
    first, second = (listening.look(lambda: going_on[0]) for _ in range(2))
    first()
    time.sleep(0.5)
    assert listening.now.running, "one page still looks"
    second()
    reloaded = listening.look(lambda: going_on[0])
    time.sleep(0.5)
    assert listening.now.running, "a page that was loaded again"
    reloaded()
    time.sleep(0.5)
    assert listening.now.running, "a clip is being recorded"
    going_on[0] = False
    until(lambda: not listening.now.running)


def test_a_toy_that_goes_away_comes_back(house: House) -> None:
    def serve(port: int, stop: threading.Event, ready: Callable[[str], None]) -> threading.Thread:
        thread = threading.Thread(
            target=serve_tcp, args=(port, ToySpec(31)), kwargs={"on_ready": ready, "stop": stop}, daemon=True
        )
        thread.start()
        return thread

    urls: list[str] = []
    first, second = threading.Event(), threading.Event()
    thread = serve(0, first, urls.append)
    until(lambda: urls)
    listening = house.part(Listening)
    listening.start(Choice(urls[0], bundle(house)))
    until(lambda: listening.now.state == "tracking")
    first.set()
    thread.join()
    until(lambda: listening.now.state == "no signal")
    until(lambda: "closed the connection" in listening.now.trouble or "went away" in listening.now.trouble)
    assert listening.now.running
    heard = listening.now.t_s
    serve(int(urls[0].rsplit(":", 1)[1]), second, urls.append)
    until(lambda: listening.now.state == "tracking")
    assert listening.now.trouble == ""
    # A toy that was switched on again counts from 0; the page's time goes on.
    assert listening.now.t_s >= heard
    second.set()


def test_lines_that_are_no_frames_are_told(house: House) -> None:
    stop, urls = threading.Event(), list[str]()
    threading.Thread(
        target=serve_tcp,
        args=(0, ToySpec(31)),
        kwargs={"on_ready": urls.append, "stop": stop, "speed": 20.0},
        daemon=True,
    ).start()
    until(lambda: urls)
    listening = house.part(Listening)
    listening.start(Choice(urls[0], bundle(house, "accel")))
    until(lambda: "none is a frame of 'accel-3'" in listening.now.trouble)
    stop.set()


def test_what_is_kept_is_bounded_and_every_event_ends(house: House) -> None:
    listening = Listening(house)
    for n in range(1, 2 * room.KEPT_SPANS):
        for what in ("begun", "named", "ended"):
            gesture = None if what == "begun" else "Tail pull"
            event = Event(what, n, "negative", gesture, "gate", float(n), float(n))  # type: ignore[arg-type]
            with listening._lock:
                listening._take_event(event, 100.0)
    spans = listening.spans()
    assert len(spans) == room.KEPT_SPANS
    assert all(s.end_s is not None and s.gesture == "Tail pull" for s in spans)
    assert [s.number for s in spans] == list(range(room.KEPT_SPANS, 2 * room.KEPT_SPANS))
    assert listening.spans(spans[-2].change) == [spans[-1]]
    late = Event("begun", 9999, "negative", None, "gate", room.KEPT_SPAN_S + 2 * room.KEPT_SPANS - 1.5, 0.0)
    with listening._lock:
        listening._take_event(late, 100.0)
    assert next(s.begin_s for s in listening.spans()) >= late.since_s + 100.0 - room.KEPT_SPAN_S
    listening.close()


def test_a_feed_sends_everything_once_and_anew_when_it_missed_some(house: House) -> None:
    listening = house.part(Listening)
    feed = Feed(listening)
    empty = feed.scene()
    assert (empty["channels"], empty["classes"], empty["strip"]) == ([], [], STRIP_S)
    listening.start(Choice(VIRTUAL, bundle(house)))
    until(lambda: listening.now.t_s > WINDOW_S + 2.0)
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


def test_the_reaction_ends_in_its_time(house: House) -> None:
    listening = Listening(house)
    listening.now = replace(listening.now, state="tracking")
    reader = room._Reader(None, None, Reactor(load_reactions("standard")), 10.0)  # type: ignore[arg-type]

    def decide(t_s: float, *events: Event) -> None:
        listening._take_in(Decision(t_s, "Tail pull", "negative", 0.9, "cnn", "tracking", None, "sure", events), reader)

    decide(1.0, Event("begun", 1, "negative", None, "gate", 0.9, 1.0))
    assert listening.now.reaction is not None
    assert (listening.now.reaction.eyes, listening.now.reaction.sound) == ("red", "shriek")
    assert listening.now.reaction_ends_s == 12.0
    decide(1.95)
    assert listening.now.reaction is not None
    decide(2.0)
    assert listening.now.reaction is None
    assert listening.now.event is not None
    assert listening.now.event.begin_s == 10.9
