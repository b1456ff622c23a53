"""One toy read by one bundle, for every page that looks: what it feels now, and what it felt in the last minutes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plushsense.apps.engines import classifier_of
from plushsense.apps.studio.felt import Choice, Now, Span, Voice
from plushsense.apps.studio.house import Bell, House
from plushsense.apps.studio.signals import TappedDevice
from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError
from plushsense.dataset.sources import is_simulation
from plushsense.devices.opening import open_device, parse_url
from plushsense.live.decide import DecideSpec
from plushsense.live.loop import Run
from plushsense.live.loop import run as run_on
from plushsense.live.react import Reactor, load_reactions
from plushsense.live.stream import Decision, Event
from plushsense.models.bundle import Bundle
from plushsense.recording.sessionfile import SessionHead
from plushsense.recording.toy import is_virtual, with_speed

KEPT_SPANS = 200
KEPT_SPAN_S = 600.0
_BETWEEN_S = 0.06
"""Pages hear of samples at least so often, however rarely a bundle decides."""
_JOIN_S = 10.0
ALONE_S = 60.0
"""After so long without a page that looks, the toy is let go, for whoever else wants it."""
_UNREADABLE = 30
"""Lines without one frame among them."""


@dataclass
class _Reader:
    """A bundle at work; ``offset_s``: the toy's time at its first frame, None before that."""

    bundle: Bundle
    run: Run
    reactor: Reactor | None
    offset_s: float | None = None


class Listening:
    """The part that all live pages share. `bell` rings after every decision and every change."""

    def __init__(self, house: House) -> None:
        self.bell = Bell()
        self.choice = Choice(toy=house.toy)
        self.bundle: Bundle | None = None
        self.device: TappedDevice | None = None
        self.now = Now()
        self._house = house
        self._changing = threading.RLock()
        self._lock = threading.Lock()
        self._spans: deque[Span] = deque(maxlen=KEPT_SPANS)
        self._spans_begun = self._changes = 0
        self._next: _Reader | None = None
        self._thread: threading.Thread | None = None
        self._ends = threading.Event()
        self._rung = 0.0
        self._pages = 0
        self._alone: threading.Timer | None = None

    # Commands; each may take a second: not on the loop of the pages -------------------------------------------

    def start(self, choice: Choice) -> None:
        """Open a toy and read it with a bundle, once that is known to be one; what was read before ends.

        Raises:
            ConfigError, DeviceError, BundleError: as for `open_device`, `Bundle.load` and `check_layout`.
        """
        with self._changing:
            if choice.bundle is None:
                raise ConfigError("No bundle is chosen: choose one, or train one first.")
            bundle = Bundle.load(self._house.inside(choice.bundle))
            classifier = _classifier(bundle, choice.engine)
            reactor = _reactor(choice.reactions, bundle)
            url = with_speed(choice.toy, self._house.speed)
            self.stop()
            device = TappedDevice(open_device(url, bundle.layout, reconnect=True))
            try:
                reader = _Reader(bundle, run_on(device, classifier), reactor)
            except BaseException:
                device.close()
                raise
            self.choice = replace(choice, simulated=choice.simulated or _simulated(url))
            with self._lock:
                self._spans.clear()
                self.device, self.bundle, self._next = device, bundle, reader
                self.now = Now(self.now.generation + 1, running=True, state="warming", changes=self._changes)
            self._ends = threading.Event()
            self._thread = threading.Thread(
                target=self._read, args=(device, self._ends), name="plushsense-live", daemon=True
            )
            self._thread.start()
        self.bell.ring()

    def choose(self, bundle: Path | None, engine: str, reactions: str) -> None:
        """Go on with another bundle, engine or reactions, without opening the toy again.

        Raises:
            ConfigError, BundleError: for what does not fit the toy or what is being told; what ran goes on.
        """
        with self._changing:
            device = self.device
            before = self._next.bundle if self._next is not None else self.bundle
            if not self.now.running or device is None or before is None:
                self.choice = replace(self.choice, bundle=bundle, engine=engine, reactions=reactions)
                self.bell.ring()
                return
            if bundle is None:
                raise ConfigError("No bundle is chosen: choose one, or train one first.")
            fresh = before
            if bundle != self.choice.bundle:
                fresh = Bundle.load(self._house.inside(bundle))
                _refuse_strange(fresh, before)
            reactor = _reactor(reactions, fresh)
            reader = _Reader(fresh, run_on(device, _classifier(fresh, engine)), reactor)
            with self._lock:
                self._next = reader
            self.choice = replace(self.choice, bundle=bundle, engine=engine, reactions=reactions)
        self.bell.ring()

    def stop(self) -> None:
        """Let go of the toy; what was seen stays to be looked at. Harmless when nothing is read."""
        with self._changing:
            thread, device = self._thread, self.device
            self._ends.set()
            if device is not None:
                device.close()
            if thread is not None and thread is not threading.current_thread():
                thread.join(_JOIN_S)
            self._thread = None

    def close(self) -> None:
        """End with the studio."""
        with self._lock:
            self._pages += 1
        self.stop()

    def look(self, busy: Callable[[], bool]) -> Callable[[], None]:
        """A page looks; call what is returned when it is closed. A toy that nobody has looked at for `ALONE_S` is let
        go, unless ``busy`` says that something still goes on."""
        with self._lock:
            self._pages += 1

        def leave() -> None:
            with self._lock:
                self._pages -= 1
                if self._pages == 0:
                    self._wait_alone(busy)

        return leave

    def _wait_alone(self, busy: Callable[[], bool]) -> None:
        if self._alone is not None:
            self._alone.cancel()
        self._alone = threading.Timer(ALONE_S, self._left_alone, (busy,))
        self._alone.daemon = True
        self._alone.start()

    def _left_alone(self, busy: Callable[[], bool]) -> None:
        if self._pages > 0:
            return
        if busy():
            self._wait_alone(busy)
        else:
            self.stop()

    # For whoever shows it -------------------------------------------------------------------------------------

    def spans(self, since: int = 0) -> list[Span]:
        """Events of the last minutes that changed after change ``since``, the oldest first."""
        with self._lock:
            return [span for span in self._spans if span.change > since]

    # The thread that reads ------------------------------------------------------------------------------------

    def _read(self, device: TappedDevice, ends: threading.Event) -> None:
        said = ""
        reader: _Reader | None = None
        try:
            while not ends.is_set():
                with self._lock:
                    fresh, self._next = self._next, None
                if fresh is not None:
                    if reader is not None:
                        self._swap(fresh)
                    reader = fresh
                assert reader is not None
                self._poll(device, reader)
                if reader.run.over:
                    said = "" if ends.is_set() else "The toy's data have ended."
                    break
        except PlushSenseError as cause:
            said = "" if ends.is_set() else str(cause)
        except Exception as cause:  # noqa: BLE001 (a thread that dies unseen would leave a page that seems to live)
            said = f"Reading the toy failed ({type(cause).__name__}: {cause}): start it again."
        with contextlib.suppress(Exception):
            device.close()
        with self._lock:
            if self.device is device:
                self._end_event(self.now.t_s)
                self.now = replace(
                    self.now, running=False, said=said, trouble="", state="", probabilities=None, reaction=None
                )
        self.bell.ring()

    def _poll(self, device: TappedDevice, reader: _Reader) -> None:
        before = device.ring.count
        decisions = reader.run.poll()
        came = device.ring.count > before
        if came and reader.offset_s is None:
            reader.offset_s = float(device.ring.since(before).seconds[0])
        for decision in decisions:
            self._take_in(decision, reader)
        trouble = "" if came else _trouble(device, self.now.trouble)
        host = time.perf_counter()
        if not decisions and trouble == self.now.trouble and not (came and host - self._rung >= _BETWEEN_S):
            return
        self._rung = host
        newest = device.ring.since(device.ring.count - 1).seconds
        # A device that keeps time itself may name a moment that is still to come.
        age_s = max(0.0, host - device.arrived_s) if device.arrived_s is not None else 0.0
        with self._lock:
            self.now = replace(
                self.now,
                trouble=trouble,
                t_s=float(newest[0]) if len(newest) else 0.0,
                latency_s=reader.run.latency_s,
                arrived=time.time() - age_s,
                changes=self._changes,
            )
        self.bell.ring()

    def _take_in(self, decision: Decision, reader: _Reader) -> None:
        zero = reader.offset_s if reader.offset_s is not None else self.now.t_s
        voice = Voice(zero + decision.t_s, decision.affect, decision.gesture, decision.confidence, decision.answer)
        with self._lock:
            for event in decision.events:
                self._take_event(event, zero)
            now = self.now
            if decision.source == "gate":
                # Between two steps of the network: what that says, stands.
                now = replace(now, gate=voice, state=decision.state)
            else:
                now = replace(now, network=voice, state=decision.state, probabilities=decision.probabilities)
            for reaction in reader.reactor.push(decision) if reader.reactor else []:
                shown = reaction if reaction.eyes != "off" or reaction.sound else None
                now = replace(now, reaction=shown, reaction_ends_s=zero + reaction.t_s + reaction.seconds)
            if now.reaction is not None and zero + decision.t_s >= now.reaction_ends_s:
                now = replace(now, reaction=None)
            self.now = now

    def _take_event(self, event: Event, zero: float) -> None:
        if event.what == "begun":
            self._spans_begun += 1
            self._changes += 1
            span = Span(
                self._spans_begun, self._changes, zero + event.since_s, event.affect, event.gesture, event.source
            )
            while self._spans and self._spans[0].begin_s < span.begin_s - KEPT_SPAN_S:
                self._spans.popleft()
            self._spans.append(span)
            self.now = replace(self.now, event=span)
        elif self.now.event is not None:
            end_s = zero + event.since_s if event.what == "ended" else None
            self._change_event(affect=event.affect, gesture=event.gesture, end_s=end_s)

    def _change_event(self, **changed: Any) -> None:
        """The event that goes on is another one now, or has ended; with the lock."""
        span = self.now.event
        assert span is not None
        self._changes += 1
        fresh = replace(span, change=self._changes, **changed)
        for at in range(len(self._spans) - 1, -1, -1):
            if self._spans[at].number == span.number:
                self._spans[at] = fresh
                break
        self.now = replace(self.now, event=None if fresh.end_s is not None else fresh)

    def _swap(self, fresh: _Reader) -> None:
        """From here on another bundle reads: what the one before said is over."""
        with self._lock:
            self._end_event(self.now.t_s)
            self.bundle = fresh.bundle
            self.now = replace(
                self.now,
                generation=self.now.generation + 1,
                state="warming",
                probabilities=None,
                network=None,
                gate=None,
                reaction=None,
            )
        self.bell.ring()

    def _end_event(self, t_s: float) -> None:
        """With the lock."""
        if self.now.event is not None:
            self._change_event(end_s=max(t_s, self.now.event.begin_s))
            self.now = replace(self.now, changes=self._changes)


def _trouble(device: TappedDevice, before: str) -> str:
    """Why no frame comes; ``before``: what was said last, which stands until one does."""
    if getattr(device.device, "state", "connected") == "waiting":
        gaps = getattr(device.device, "gaps", ())
        return str(gaps[-1].reason) if gaps else before
    if device.ring.count == 0 and device.counters.malformed >= _UNREADABLE:
        return (
            f"The toy sends lines, but none is a frame of '{device.layout.name}' ({len(device.layout.wire)} numbers), "
            "which the bundle reads: choose a bundle that was made for this toy, and look whether the cable is sound."
        )
    return before


def _simulated(url: str) -> bool:
    """Whether this is the virtual toy, or a recording of one."""
    address = parse_url(url)
    if address.scheme != "replay":
        return is_virtual(url)
    place = Path(address.place).resolve().parent
    head = None
    with contextlib.suppress(DatasetError):
        head = SessionHead.read(place)
    return head.simulated if head is not None else is_simulation(place, [])


def _classifier(bundle: Bundle, engine: str) -> Any:
    return classifier_of(bundle, DecideSpec.from_dict(bundle.decision), engine)


def _reactor(reactions: str, bundle: Bundle) -> Reactor | None:
    return Reactor(load_reactions(reactions, bundle.gestures)) if reactions else None


def _refuse_strange(fresh: Bundle, running: Bundle) -> None:
    """Refuse a bundle of quite another gesture set, which would read nonsense into this toy.

    Raises:
        ConfigError: where both sets have no gesture in common.
    """
    if not any(running.gestures.find(label) for label in fresh.gestures.labels):
        mine, theirs = ", ".join(fresh.gestures.labels[:4]), ", ".join(running.gestures.labels[:4])
        raise ConfigError(
            f"This bundle is of the gesture set '{fresh.gestures.name}' ({mine}, …) and knows no gesture of "
            f"'{running.gestures.name}' ({theirs}, …), which is being read: the other one goes on; stop it first "
            "if you mean it."
        )
