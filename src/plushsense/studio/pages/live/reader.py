"""Read one toy and classify its signals with one bundle, for all live pages; keep the events of recent minutes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, DatasetError, PlushSenseError
from plushsense.dataset.importing.sources import is_simulation
from plushsense.deploy.quantize import classifier_of
from plushsense.devices.opening import open_device, parse_url
from plushsense.live.loop import LiveRun
from plushsense.live.loop import run_live as run_on
from plushsense.live.reactions import Reaction, Reactor, load_reactions
from plushsense.models.bundle import Bundle
from plushsense.recording.recorder import is_virtual, with_speed
from plushsense.recording.session_files import SessionHead
from plushsense.runtime.classifier import Decision, GestureEvent
from plushsense.runtime.decisions import DecideSpec
from plushsense.studio.app.toys import TappedDevice
from plushsense.studio.app.workspace import ChangeSignal, Workspace


@dataclass(frozen=True)
class LiveChoice:
    """The toy, bundle, engine and reactions in use.

    Attributes:
        toy: URL of the toy.
        engine: arithmetic of the network, "float" or "int8".
        reactions: name of a set of reactions, or "" for none.
        simulated: whether the toy is virtual, even if it is connected through a port.
    """

    toy: str = ""
    bundle: Path | None = None
    engine: str = "float"
    reactions: str = "standard"
    simulated: bool = False


@dataclass(frozen=True)
class LatestAnswer:
    """Latest result of the network (at every step) or of the gate's rules (whenever a rule matches)."""

    t_s: float
    affect: str | None
    gesture: str | None
    confidence: float | None = None
    answer: str | None = None


@dataclass(frozen=True)
class EventSpan:
    """An event on the time line.

    Attributes:
        number: consecutive number from 1, continued when the bundle changes.
        change: number of the latest change of this event; all changes of all events are numbered consecutively.
        end_s: time of its end, None while it lasts.
        named_s, closed_s: times at which its gesture and its end were reported, None before that.
    """

    number: int
    change: int
    begin_s: float
    affect: str
    gesture: str | None
    source: str
    end_s: float | None = None
    named_s: float | None = None
    closed_s: float | None = None


@dataclass(frozen=True)
class LiveState:
    """State that pages display next to the signals. Times ``t_s`` are seconds by the toy's clock since it was opened.

    Attributes:
        generation: increases with every new toy or bundle; pages then redraw everything.
        running: whether a toy is being read.
        message: the reason why reading ended, or "".
        problem: the reason why no data arrive at present, or "".
        state: state in the last decision; "" if no toy is being read.
        probabilities: class probabilities in the order of the bundle; None while there is no prediction.
        event: the current event, if any.
        reaction: the current reaction of the toy, if any; it ends at ``reaction_ends_s``.
        latency_s: time from the arrival of the bytes to the newest decision.
        arrived: time of arrival of those bytes, in seconds since 1970.
        changes: number of the newest change of any event, see `EventSpan`.
    """

    generation: int = 0
    running: bool = False
    message: str = ""
    problem: str = ""
    state: str = ""
    t_s: float = 0.0
    probabilities: tuple[float, ...] | None = None
    network: LatestAnswer | None = None
    gate: LatestAnswer | None = None
    event: EventSpan | None = None
    reaction: Reaction | None = None
    reaction_ends_s: float = 0.0
    latency_s: float | None = None
    arrived: float = 0.0
    changes: int = 0


KEPT_SPANS = 200
KEPT_SPAN_S = 600.0
_BETWEEN_S = 0.06
"""Time in seconds after which new samples cause a notification even without a decision."""
_JOIN_S = 10.0
ALONE_S = 60.0
"""Time without an open page, in seconds, after which the toy is closed so that other programs can use it."""
_UNREADABLE = 30
"""Number of malformed lines, before any frame has arrived, that indicates a wrong layout."""


@dataclass
class _BundleRun:
    """A bundle in use; ``offset_s`` is the toy's time at the first frame read with it, None before that frame."""

    bundle: Bundle
    run: LiveRun
    reactor: Reactor | None
    offset_s: float | None = None


class LiveReader:
    """Service, shared by all live pages, that reads and classifies the signals of one toy.

    It notifies `changed` after every decision and every other change of its state.
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
        self._spans: deque[EventSpan] = deque(maxlen=KEPT_SPANS)
        self._spans_begun = self._changes = 0
        self._next: _BundleRun | None = None
        self._thread: threading.Thread | None = None
        self._ends = threading.Event()
        self._notified_s = 0.0
        self._pages = 0
        self._alone: threading.Timer | None = None

    # Commands. They block, so call them outside the event loop -------------------------------------------

    def start(self, choice: LiveChoice) -> None:
        """Open a toy and classify its signals; first close the current toy, but only if the bundle is usable.

        Raises:
            ConfigError, DeviceError, BundleError: if the toy or bundle cannot be opened, or they do not fit each other.
        """
        with self._changing:
            if choice.bundle is None:
                raise ConfigError("No bundle is chosen: choose one, or train one first.")
            bundle = Bundle.load(self._workspace.inside(choice.bundle))
            classifier = _classifier(bundle, choice.engine)
            reactor = _reactor(choice.reactions, bundle)
            url = with_speed(choice.toy, self._workspace.speed)
            self.stop()
            device = TappedDevice(open_device(url, bundle.layout, reconnect=True))
            try:
                bundle_run = _BundleRun(bundle, run_on(device, classifier), reactor)
            except BaseException:
                device.close()
                raise
            self.choice = replace(choice, simulated=choice.simulated or _simulated(url))
            with self._lock:
                self._spans.clear()
                self.device, self.bundle, self._next = device, bundle, bundle_run
                self.now = LiveState(self.now.generation + 1, running=True, state="warming", changes=self._changes)
            self._ends = threading.Event()
            self._thread = threading.Thread(
                target=self._read, args=(device, self._ends), name="plushsense-live", daemon=True
            )
            self._thread.start()
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
            if bundle is None:
                raise ConfigError("No bundle is chosen: choose one, or train one first.")
            fresh = before
            if bundle != self.choice.bundle:
                fresh = Bundle.load(self._workspace.inside(bundle))
                _refuse_strange(fresh, before)
            reactor = _reactor(reactions, fresh)
            bundle_run = _BundleRun(fresh, run_on(device, _classifier(fresh, engine)), reactor)
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

    # For pages -------------------------------------------------------------------------------------

    def spans(self, since: int = 0) -> list[EventSpan]:
        """Return the events of recent minutes with a change number greater than ``since``, oldest first."""
        with self._lock:
            return [span for span in self._spans if span.change > since]

    # The reader thread ------------------------------------------------------------------------------------

    def _read(self, device: TappedDevice, ends: threading.Event) -> None:
        message = ""
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
                    message = "" if ends.is_set() else "The toy's data have ended."
                    break
        except PlushSenseError as cause:
            message = "" if ends.is_set() else str(cause)
        except Exception as cause:  # noqa: BLE001, RUF100
            message = f"Reading the toy failed ({type(cause).__name__}: {cause}): start it again."
        with contextlib.suppress(Exception):
            device.close()
        with self._lock:
            if self.device is device:
                self._end_event(self.now.t_s)
                self.now = replace(
                    self.now, running=False, message=message, problem="", state="", probabilities=None, reaction=None
                )
        self.changed.notify()

    def _poll(self, device: TappedDevice, bundle_run: _BundleRun) -> None:
        before = device.buffer.count
        decisions = bundle_run.run.poll()
        came = device.buffer.count > before
        if came and bundle_run.offset_s is None:
            bundle_run.offset_s = float(device.buffer.since(before).seconds[0])
        for decision in decisions:
            self._take_in(decision, bundle_run)
        problem = "" if came else _problem(device, self.now.problem)
        host = time.perf_counter()
        if not decisions and problem == self.now.problem and not (came and host - self._notified_s >= _BETWEEN_S):
            return
        self._notified_s = host
        newest = device.buffer.since(device.buffer.count - 1).seconds
        # A device with its own clock may report a time in the future.
        age_s = max(0.0, host - device.arrived_s) if device.arrived_s is not None else 0.0
        with self._lock:
            self.now = replace(
                self.now,
                problem=problem,
                t_s=float(newest[0]) if len(newest) else 0.0,
                latency_s=bundle_run.run.latency_s,
                arrived=time.time() - age_s,
                changes=self._changes,
            )
        self.changed.notify()

    def _take_in(self, decision: Decision, bundle_run: _BundleRun) -> None:
        zero = bundle_run.offset_s if bundle_run.offset_s is not None else self.now.t_s
        answer = LatestAnswer(
            zero + decision.t_s, decision.affect, decision.gesture, decision.confidence, decision.answer
        )
        with self._lock:
            for event in decision.events:
                self._take_event(event, zero)
            now = self.now
            if decision.source == "gate":
                # The network's answer stays displayed until its next step.
                now = replace(now, gate=answer, state=decision.state)
            else:
                now = replace(now, network=answer, state=decision.state, probabilities=decision.probabilities)
            for reaction in bundle_run.reactor.push(decision) if bundle_run.reactor else []:
                reaction_now = reaction if reaction.eyes != "off" or reaction.sound else None
                now = replace(now, reaction=reaction_now, reaction_ends_s=zero + reaction.t_s + reaction.seconds)
            if now.reaction is not None and zero + decision.t_s >= now.reaction_ends_s:
                now = replace(now, reaction=None)
            self.now = now

    def _take_event(self, event: GestureEvent, zero: float) -> None:
        if event.kind == "begun":
            self._spans_begun += 1
            self._changes += 1
            span = EventSpan(
                self._spans_begun,
                self._changes,
                zero + event.since_s,
                event.affect,
                event.gesture,
                event.source,
                named_s=None if event.gesture is None else zero + event.t_s,
            )
            while self._spans and self._spans[0].begin_s < span.begin_s - KEPT_SPAN_S:
                self._spans.popleft()
            self._spans.append(span)
            self.now = replace(self.now, event=span)
        elif self.now.event is not None:
            changed = {"named_s": zero + event.t_s}
            if event.kind == "ended":
                changed = {"end_s": zero + event.since_s, "closed_s": zero + event.t_s}
            self._change_event(affect=event.affect, gesture=event.gesture, **changed)

    def _change_event(self, **changed: Any) -> None:
        """Change or end the current event; the caller must hold the lock."""
        span = self.now.event
        assert span is not None
        self._changes += 1
        fresh = replace(span, change=self._changes, **changed)
        at = next((i for i, s in enumerate(self._spans) if s.number == span.number), None)
        if at is not None:
            self._spans[at] = fresh
        self.now = replace(self.now, event=None if fresh.end_s is not None else fresh)

    def _swap(self, fresh: _BundleRun) -> None:
        """Continue with another bundle, and end the current event."""
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
        self.changed.notify()

    def _end_event(self, t_s: float) -> None:
        """End the current event, if any; the caller must hold the lock."""
        if self.now.event is not None:
            self._change_event(end_s=max(t_s, self.now.event.begin_s))
            self.now = replace(self.now, changes=self._changes)


def _problem(device: TappedDevice, before: str) -> str:
    """Return why no frame arrives; without a new reason, return ``before``, the previous one."""
    if device.state == "waiting":
        return str(device.gaps[-1].reason) if device.gaps else before
    if device.buffer.count == 0 and device.counters.malformed >= _UNREADABLE:
        return (
            f"The toy sends lines, but none is a frame of the layout '{device.layout.name}' of the bundle "
            f"({len(device.layout.wire)} numbers): choose a bundle for this toy, and check the cable."
        )
    return before


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


def _classifier(bundle: Bundle, engine: str) -> Any:
    return classifier_of(bundle, DecideSpec.from_dict(bundle.decision), engine)


def _reactor(reactions: str, bundle: Bundle) -> Reactor | None:
    return Reactor(load_reactions(reactions, bundle.gestures)) if reactions else None


def _refuse_strange(fresh: Bundle, running: Bundle) -> None:
    """Raise ConfigError if two bundles have no gesture in common."""
    if not any(running.gestures.find(label) for label in fresh.gestures.labels):
        new, current = ", ".join(fresh.gestures.labels[:4]), ", ".join(running.gestures.labels[:4])
        raise ConfigError(
            f"The gesture set of this bundle, '{fresh.gestures.name}' ({new}, …), has no gesture in common with the "
            f"one in use, '{running.gestures.name}' ({current}, …): stop the toy before you choose this bundle."
        )
