"""Read one toy and classify its signals with one bundle, for all live pages; keep the events of recent minutes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from plushsense.core.errors import ArchError, BundleError, ConfigError, DatasetError, DeviceError, PlushSenseError
from plushsense.dataset.importing.sources import is_simulation
from plushsense.deploy.quantize import classifier_of
from plushsense.devices.opening import is_virtual, open_device, parse_url, with_speed
from plushsense.devices.virtual.stream import PerformedGesture, VirtualDevice
from plushsense.live.loop import LiveRun
from plushsense.live.loop import run_live as run_on
from plushsense.live.reactions import Reactor, load_reactions
from plushsense.models.bundle import Bundle
from plushsense.recording.writer import SessionHead
from plushsense.runtime.classifier import Decision, GestureEvent
from plushsense.runtime.decisions import DecideSpec
from plushsense.studio.app.toys import TappedDevice, Toys, ToyUse
from plushsense.studio.app.workspace import ChangeSignal, Workspace
from plushsense.studio.pages.live.live_state import (
    Connection,
    EventSpan,
    LiveChoice,
    LiveState,
    SimulationKind,
    quiet_reason,
)

KEPT_SPANS = 200
KEPT_SPAN_S = 600.0
KEPT_EVENTS = 20_000
"""Number of events in the log; with a touch every three seconds, those of 16 hours."""
_BETWEEN_S = 0.06
"""Time in seconds after which new samples cause a notification even without a decision."""
_JOIN_S = 10.0
_EARLY_S, _LATE_S = 0.3, 2.0
"""How long before the hand touches, and after it has left, an event belongs to a gesture, as in the protocol."""
ALONE_S = 60.0
"""Time without an open page, in seconds, after which the toy is closed so that other programs can use it."""
_UNREADABLE = 30
"""Number of malformed lines without a frame between them that indicates a wrong layout."""


@dataclass
class _BundleRun:
    """A bundle in use; ``offset_s`` is the toy's time at the first frame read with it, None before that frame."""

    bundle: Bundle
    run: LiveRun
    reactor: Reactor | None
    offset_s: float | None = None


class LiveReader:
    """Service, shared by all live pages, that reads and classifies the signals of one toy.

    It notifies `changed` after every decision and every other change of its state. ``subject`` is the code of the
    person who touches the toy, "" if it is not known.
    """

    def __init__(self, workspace: Workspace) -> None:
        self.changed = ChangeSignal()
        self.choice = LiveChoice(toy=workspace.toy)
        self.bundle: Bundle | None = None
        self.device: TappedDevice | None = None
        self.now = LiveState()
        self._workspace = workspace
        self._changing = threading.RLock()
        self._lock = threading.Lock()
        # All events by number, those of earlier toys too; the time line begins with `_first`.
        self._events: dict[int, EventSpan] = {}
        self._begun = self._changes = 0
        self._first = 1
        self._performed: list[PerformedGesture] = []
        self._started = 0.0
        self.subject = ""
        self._next: _BundleRun | None = None
        self._thread: threading.Thread | None = None
        self._ends = threading.Event()
        self._malformed = 0
        self._notified_s = 0.0
        self._pages = 0
        self._occupied: Callable[[], bool] = lambda: False
        self._alone: threading.Timer | None = None

    # Commands. They block, so call them outside the event loop -------------------------------------------

    def start(self, choice: LiveChoice) -> None:
        """Open a toy and classify its signals; first close the current toy, but only if the bundle is usable.

        Raises:
            ConfigError, DeviceError, BundleError: if the toy or bundle cannot be opened, or they do not fit each other.
        """
        with self._changing:
            bundle = _load(self._workspace, choice.bundle)
            classifier = _classifier(bundle, choice.engine)
            reactor = _reactor(choice.reactions, bundle)
            url = with_speed(choice.toy, self._workspace.speed)
            self.stop()
            use = ToyUse(choice.toy, "live", self._stop_for_others)
            toys = self._workspace.part(Toys)
            device = toys.open(use, lambda: open_device(url, bundle.layout, reconnect=True))
            try:
                bundle_run = _BundleRun(bundle, run_on(device, classifier, warn=_kept), reactor)
            except BaseException:
                device.close()
                raise
            self.choice = replace(choice, simulated=choice.simulated or _simulated(url))
            virtual = _virtual(device)
            if virtual is not None:
                virtual.on_performed = partial(self._add_performed, virtual)
            with self._lock:
                self._first, self._performed, self._malformed = self._begun + 1, [], 0
                self._started = time.time()
                self.device, self.bundle, self._next = device, bundle, bundle_run
                fresh = LiveState(self.now.generation + 1, True, connection="connecting", state="warming")
                self.now = replace(fresh, changes=self._changes)
            self._ends = threading.Event()
            self._thread = threading.Thread(
                target=self._read, args=(device, self._ends), name="plushsense-live", daemon=True
            )
            self._thread.start()
        toys.update_uses()
        self.changed.notify()

    def choose(self, bundle: Path | None, engine: str, reactions: str) -> None:
        """Use another bundle, engine or reactions without opening the toy again.

        Raises:
            ConfigError, BundleError: if the bundle cannot be read, does not fit the toy, or has no gesture in common
                with the current one, which then stays in use.
        """
        with self._changing:
            device = self.device
            before = self._next.bundle if self._next is not None else self.bundle
            if not self.now.running or device is None or before is None:
                self.choice = replace(self.choice, bundle=bundle, engine=engine, reactions=reactions)
                self.changed.notify()
                return
            fresh = before
            if bundle != self.choice.bundle:
                fresh = _load(self._workspace, bundle)
                _refuse_strange(fresh, before)
            reactor = _reactor(reactions, fresh)
            bundle_run = _BundleRun(fresh, run_on(device, _classifier(fresh, engine), warn=_kept), reactor)
            with self._lock:
                self._next = bundle_run
            self.choice = replace(self.choice, bundle=bundle, engine=engine, reactions=reactions)
        self.changed.notify()

    def stop(self) -> None:
        """Close the toy, if one is open; its last signals remain visible."""
        with self._changing:
            thread, device = self._thread, self.device
            self._ends.set()
            if device is not None:
                device.close()
            if thread is not None and thread is not threading.current_thread():
                thread.join(_JOIN_S)
            self._thread = None

    def _stop_for_others(self) -> None:
        if self._occupied():
            raise ConfigError("A validation is under way. End it first.")
        self.stop()

    @property
    def simulated(self) -> SimulationKind:
        """What is virtual of the toy that is being read, or was last, and the network."""
        if self.device is None or self.bundle is None:
            return ""
        return "toy" if self.choice.simulated else "network" if self.bundle.simulated else ""

    @property
    def person(self) -> VirtualDevice | None:
        """The toy that is being read, if it is a virtual one of this process, whose person can be directed."""
        return _virtual(self.device) if self.device is not None and self.now.running else None

    def direct(self, label: str | None = "") -> None:
        """Let the virtual person make the gesture ``label``, or nothing if it is ""; None lets the person choose again.

        Raises:
            ConfigError: if no virtual toy is being read.
        """
        person = self.person
        if person is None:
            raise ConfigError("No virtual toy is being read. Start one first.")
        if label is None:
            person.release()
        else:
            person.follow()
            if label:
                person.perform(label)
        with self._lock:
            self.now = replace(self.now, next_gesture=label or "")
        self.changed.notify()

    def close(self) -> None:
        """Close the toy because the studio ends."""
        with self._lock:
            self._pages += 1
        self.stop()

    def add_viewer(self, busy: Callable[[], bool]) -> Callable[[], None]:
        """Register a page that shows the signals; return a function to call when the page is closed.

        If no page is open for `ALONE_S` seconds, the toy is closed, unless ``busy`` returns true.
        """
        with self._lock:
            self._pages += 1
            self._occupied = busy

        def leave() -> None:
            with self._lock:
                self._pages -= 1
                if self._pages == 0:
                    self._wait_alone()

        return leave

    def _wait_alone(self) -> None:
        if self._alone is not None:
            self._alone.cancel()
        self._alone = threading.Timer(ALONE_S, self._left_alone)
        self._alone.daemon = True
        self._alone.start()

    def _left_alone(self) -> None:
        if self._pages > 0:
            return
        if self._occupied():
            self._wait_alone()
        else:
            self.stop()

    # For pages -------------------------------------------------------------------------------------

    def spans(self, since: int = 0) -> list[EventSpan]:
        """Return the events of recent minutes with a change number greater than ``since``, oldest first."""
        found: list[EventSpan] = []
        newest_s: float | None = None
        with self._lock:
            for span in reversed(self._events.values()):
                newest_s = newest_s if newest_s is not None else span.begin_s
                old = span.begin_s < newest_s - KEPT_SPAN_S or self._begun - span.number >= KEPT_SPANS
                if old or span.number < self._first:
                    break
                if span.change > since:
                    found.append(span)
        return found[::-1]

    def events(self) -> list[EventSpan]:
        """Return all events since the studio was started, those of earlier toys too, oldest first."""
        with self._lock:
            return list(self._events.values())

    def performed(self, since: int = 0) -> list[PerformedGesture]:
        """Return the gestures that the virtual person has made since the toy was opened, but the first ``since``."""
        with self._lock:
            return self._performed[since:]

    # The reader thread ------------------------------------------------------------------------------------

    def _read(self, device: TappedDevice, ends: threading.Event) -> None:
        ended: PlushSenseError | None = None
        bundle_run: _BundleRun | None = None
        try:
            while not ends.is_set():
                with self._lock:
                    fresh, self._next = self._next, None
                if fresh is not None:
                    if bundle_run is not None:
                        self._swap(fresh)
                    bundle_run = fresh
                assert bundle_run is not None
                self._poll(device, bundle_run)
                if bundle_run.run.over:
                    ended = DeviceError("The data of the toy have ended. Press Start to begin again.")
                    break
        except PlushSenseError as cause:
            ended = cause
        except Exception as cause:  # noqa: BLE001, RUF100
            what = f"{type(cause).__name__}: {cause}"
            ended = DeviceError("Reading the toy failed ({what}). Press Start to begin again.", what=what)
        with contextlib.suppress(Exception):
            device.close()
        with self._lock:
            if self.device is device:
                self._end_event(self.now.t_s)
                still = replace(self.now, running=False, ended=None if ends.is_set() else ended, next_gesture="")
                self.now = replace(still, connection="", state="", probabilities=None, reaction=None)
        self.changed.notify()

    def _poll(self, device: TappedDevice, bundle_run: _BundleRun) -> None:
        before = device.buffer.count
        decisions = bundle_run.run.poll()
        came = device.buffer.count > before
        if came and bundle_run.offset_s is None:
            bundle_run.offset_s = float(device.buffer.since(before).seconds[0])
        for decision in decisions:
            self._take_in(decision, bundle_run)
        connection = self._connection(device, came)
        host = time.perf_counter()
        if not decisions and connection == self.now.connection and not (came and host - self._notified_s >= _BETWEEN_S):
            return
        self._notified_s = host
        newest = device.buffer.since(device.buffer.count - 1).seconds
        # A device with its own clock may report a time in the future.
        age_s = max(0.0, host - device.arrived_s) if device.arrived_s is not None else 0.0
        with self._lock:
            self.now = replace(
                self.now,
                connection=connection,
                mismatch=device.mismatch,
                warnings=tuple(bundle_run.run.warnings),
                t_s=float(newest[0]) if len(newest) else 0.0,
                latency_s=bundle_run.run.latency_s,
                arrived=time.time() - age_s,
                changes=self._changes,
            )
        self.changed.notify()

    def _connection(self, device: TappedDevice, came: bool) -> Connection:
        """Return what keeps frames from arriving; ``came`` is whether some arrived now."""
        if came:
            self._malformed = device.counters.malformed
            return ""
        if device.state == "waiting":
            return "gone"
        if device.counters.malformed - self._malformed >= _UNREADABLE:
            return "unreadable"
        return self.now.connection if device.buffer.count else "connecting"

    def _take_in(self, decision: Decision, bundle_run: _BundleRun) -> None:
        zero = bundle_run.offset_s if bundle_run.offset_s is not None else self.now.t_s
        reactor = bundle_run.reactor
        with self._lock:
            for event in decision.events:
                self._take_event(event, zero)
            self.now = replace(self.now, state=decision.state)
            if decision.source == "cnn":
                # At a decision of the gate, the network's answer stays until its next step.
                self.now = replace(self.now, answer=decision.answer, probabilities=decision.probabilities)
                self._measure_confidence(bundle_run.bundle, decision)
            for reaction in reactor.push(decision) if reactor is not None else []:
                shows = bool(reaction.eyes != "off" or reaction.sound)
                ends_s = zero + reaction.t_s + reaction.seconds
                self.now = replace(self.now, reaction=reaction if shows else None, reaction_ends_s=ends_s)
                span = next((s for s in reversed(self._events.values()) if s.in_stream == reaction.number), None)
                if span is not None:
                    self._change_event(span, eyes=reaction.eyes, sound=reaction.sound)
            over = self.now.reaction is not None and zero + decision.t_s >= self.now.reaction_ends_s
            if over or decision.state in ("no signal", "unreadable", "sensor fault"):
                self.now = replace(self.now, reaction=None)
            if (current := self.now.event) is not None:
                quiet = quiet_reason(reactor.profile if reactor is not None else None, current)
                self.now = replace(self.now, quiet=quiet)

    def _take_event(self, event: GestureEvent, zero: float) -> None:
        if event.kind == "begun":
            self._begun += 1
            self._changes += 1
            span = EventSpan(
                self._begun,
                self._changes,
                event.number,
                zero + event.since_s,
                event.affect,
                event.gesture,
                event.source,
                at=time.time(),
                network=self.choice.bundle.stem if self.choice.bundle is not None else "",
                simulated=self.simulated,
                session=self._started,
                subject=self.subject,
            )
            self._events.pop(self._begun - KEPT_EVENTS, None)
            self._events[span.number] = span
            self.now = replace(self.now, event=span)
        elif self.now.event is not None:
            changed: dict[str, Any] = {}
            if event.kind == "ended":
                really = self._performed_in(self.now.event.begin_s, zero + event.t_s)
                changed = {"end_s": zero + event.since_s, "really": really}
            elif event.gesture != self.now.event.gesture:
                # From now on it is the probability of the gesture, not of the affect.
                changed["confidence"] = None
            self._change_event(self.now.event, affect=event.affect, gesture=event.gesture, **changed)

    def _change_event(self, span: EventSpan, **changed: Any) -> None:
        """Change or end an event; the caller must hold the lock."""
        self._changes += 1
        fresh = replace(span, change=self._changes, **changed)
        self._events[span.number] = fresh
        if self.now.event is not None and self.now.event.number == span.number:
            self.now = replace(self.now, event=None if fresh.end_s is not None else fresh)

    def _measure_confidence(self, bundle: Bundle, decision: Decision) -> None:
        """Raise the confidence of the current event to that of this step; the caller must hold the lock."""
        event, shares = self.now.event, decision.probabilities
        # Before it is named, an event of the gate is not the network's.
        if event is None or shares is None or (event.source == "gate" and event.gesture is None):
            return
        likely = sum(
            share
            for gesture, share in zip(bundle.gestures.gestures, shares, strict=True)
            if (gesture.affect == event.affect if event.gesture is None else gesture.label == event.gesture)
        )
        if event.confidence is None or likely > event.confidence:
            # Not a change for the pages, which get the confidence with the situation and at the next change.
            fresh = replace(event, confidence=min(1.0, likely))
            self._events[event.number] = fresh
            self.now = replace(self.now, event=fresh)

    def _add_performed(self, device: VirtualDevice, made: PerformedGesture) -> None:
        """Note a gesture that the virtual person begins; called in the reader thread."""
        with self._lock:
            self._performed.append(made)
            self.now = replace(self.now, performed=len(self._performed), next_gesture=device.prompted)

    def _performed_in(self, begin_s: float, end_s: float) -> str | None:
        """Return the gesture of the virtual person that an event reports, "" for none, None for any other toy."""
        if self.device is None or _virtual(self.device) is None:
            return None
        overlaps = {
            min(end_s, made.end_s + _LATE_S) - max(begin_s, made.start_s - _EARLY_S): made.label
            for made in self._performed[-20:]
        }
        longest = max(overlaps, default=0.0)
        return overlaps[longest] if longest > 0.0 else ""

    def _swap(self, fresh: _BundleRun) -> None:
        """Continue with another bundle, and end the current event."""
        with self._lock:
            self._end_event(self.now.t_s)
            self.bundle = fresh.bundle
            self.now = replace(self.now, state="warming", answer=None, probabilities=None, reaction=None)
            self.now = replace(self.now, generation=self.now.generation + 1)
        self.changed.notify()

    def _end_event(self, t_s: float) -> None:
        """End the current event, if any; the caller must hold the lock."""
        if self.now.event is not None:
            self._change_event(self.now.event, end_s=max(t_s, self.now.event.begin_s))
            self.now = replace(self.now, changes=self._changes)


def _kept(_: str) -> None:
    """Leave a warning to `LiveRun.warnings`, which the pages show."""


def _virtual(device: TappedDevice) -> VirtualDevice | None:
    inner = device.inner
    return inner if isinstance(inner, VirtualDevice) else None


def _simulated(url: str) -> bool:
    """Return whether a URL belongs to a virtual toy, or to a recording of one."""
    address = parse_url(url)
    if address.scheme != "replay":
        return is_virtual(url)
    place = Path(address.place).resolve().parent
    head = None
    with contextlib.suppress(DatasetError):
        head = SessionHead.read(place)
    return head.simulated if head is not None else is_simulation(place, [])


def _load(workspace: Workspace, path: Path | None) -> Bundle:
    """Read a bundle; an error has a message of the studio's own."""
    if path is None:
        raise ConfigError("No network is chosen. Choose one, or train one first.", field="network")
    try:
        return Bundle.load(workspace.inside(path))
    except BundleError as cause:
        raise BundleError(
            "The network {name} cannot be read: the file is missing or damaged, or another version wrote it. Choose "
            "another one, or train again.",
            name=path.stem,
        ) from cause


def _classifier(bundle: Bundle, engine: str) -> Any:
    try:
        return classifier_of(bundle, DecideSpec.from_dict(bundle.decision), engine)
    except (BundleError, ArchError) as cause:
        if cause.message.values:
            raise
        raise BundleError(
            "This network cannot be computed as on the chip, because it lacks the calibration for it. Train it "
            "again, or compute as trained."
        ) from None


def _reactor(reactions: str, bundle: Bundle) -> Reactor | None:
    return Reactor(load_reactions(reactions, bundle.gestures)) if reactions else None


def _refuse_strange(fresh: Bundle, running: Bundle) -> None:
    """Raise ConfigError if two bundles have no gesture in common."""
    if not any(running.gestures.find(label) for label in fresh.gestures.labels):
        raise ConfigError(
            "This network knows none of the gestures of the one in use (its gesture set: {name}; no gesture in "
            "common). Stop the toy before you choose it.",
            name=fresh.gestures.name,
            field="network",
        )
