"""Define the state of the live view, and the one situation that follows from it: pages display nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from plushsense.core.errors import PlushSenseError
from plushsense.core.sentences import Message
from plushsense.live.reactions import Reaction, Reactions

Connection = Literal["", "connecting", "gone", "unreadable"]
"""What keeps frames from arriving: nothing; none has come yet; the toy disconnected; its lines have another layout."""

SituationKind = Literal[
    "stopped",
    "connecting",
    "gone",
    "unreadable",
    "silent",
    "sensor_fault",
    "warming",
    "nothing",
    "unsure",
    "unknown",
    "event",
]
UNREAD: tuple[SituationKind, ...] = ("stopped", "connecting", "gone", "unreadable", "silent", "sensor_fault")
"""Situations in which no touch is read, so that nothing is known about the person and the toy."""


SimulationKind = Literal["", "toy", "network"]
"""What is virtual: nothing; the toy; the people on whom the network was trained, while the toy is real."""


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
class EventSpan:
    """An event on the time line and in the log.

    Attributes:
        number: consecutive number from 1, continued when the bundle or the toy changes.
        change: number of the latest change of this event; all changes of all events are numbered consecutively.
        in_stream: number of the event in the stream of the classifier, to which its reaction refers.
        end_s: time of its end, None while it lasts.
        confidence: highest probability of its gesture or, before it is named, of its affect; None without an answer.
        eyes, sound: the reaction of the toy; both "" while there is none.
        at: time of its first report, in seconds since 1970.
        network: name of the bundle that reported it.
        simulated: what is virtual.
        session: time of the start of the toy, in seconds since 1970.
        subject: code of the person, "" if none was given.
        really: the gesture that the virtual person made, "" for none; None for any other toy, and before the end.
    """

    number: int
    change: int
    in_stream: int
    begin_s: float
    affect: str
    gesture: str | None
    source: str
    end_s: float | None = None
    confidence: float | None = None
    eyes: str = ""
    sound: str = ""
    at: float = 0.0
    network: str = ""
    simulated: SimulationKind = ""
    session: float = 0.0
    subject: str = ""
    really: str | None = None


@dataclass(frozen=True)
class Situation:
    """Present state of toy and touch, computed once for everything that is displayed, announced and drawn.

    Attributes:
        kind: the situation. In "unsure" and "unknown" somebody touches the toy but no event has begun.
        affect, gesture, confidence, source: those of the event; the gesture is None until it is named.
        eyes, sound: current reaction of the toy, eyes "off" and "" for none.
        reacts_to: gesture, or affect before it is named, of the event to which the toy still reacts.
        quiet: why the toy does not react to the event (see `quiet_reason`), or "".
    """

    kind: SituationKind
    affect: str | None = None
    gesture: str | None = None
    confidence: float | None = None
    source: str = ""
    eyes: str = "off"
    sound: str = ""
    reacts_to: str = ""
    quiet: str = ""


@dataclass(frozen=True)
class LiveState:
    """State of the reader. Times ``t_s`` are seconds by the toy's clock since it was opened.

    Attributes:
        generation: increases with every new toy or bundle; pages then redraw everything.
        running: whether a toy is being read.
        ended: the error that ended the reading, if any.
        connection: what keeps frames from arriving.
        mismatch: why the lines of the toy cannot be read, "" if they can.
        warnings: what differs from the training of the network.
        state: state in the last decision; "" if no toy is being read.
        answer: answer of the network at its last step, see `plushsense.runtime.classifier.Decision`.
        probabilities: class probabilities in the order of the bundle; None while there is no prediction.
        event: the current event, if any.
        reaction: the current reaction of the toy, if any; it ends at ``reaction_ends_s``.
        quiet: why the toy does not react to the current event, or "".
        latency_s: time from the arrival of the bytes to the newest decision.
        arrived: time of arrival of those bytes, in seconds since 1970.
        changes: number of the newest change of any event, see `EventSpan`.
        performed: number of the newest gesture of the virtual person; 0 for any other toy.
        next_gesture: gesture that the virtual person was asked for and has not begun, or "".
    """

    generation: int = 0
    running: bool = False
    ended: PlushSenseError | None = None
    connection: Connection = ""
    mismatch: Message = field(default_factory=Message)
    warnings: tuple[Message, ...] = ()
    state: str = ""
    t_s: float = 0.0
    answer: str | None = None
    probabilities: tuple[float, ...] | None = None
    event: EventSpan | None = None
    reaction: Reaction | None = None
    reaction_ends_s: float = 0.0
    quiet: str = ""
    latency_s: float | None = None
    arrived: float = 0.0
    changes: int = 0
    performed: int = 0
    next_gesture: str = ""

    @property
    def situation(self) -> Situation:
        """The situation, in which an event comes before everything but a lost signal."""
        kind = self._kind()
        if kind in UNREAD:
            return Situation(kind)
        reaction = self.reaction
        eyes, sound = (reaction.eyes, reaction.sound) if reaction is not None else ("off", "")
        reacts_to = (reaction.gesture or reaction.affect) if reaction is not None else ""
        if kind != "event" or self.event is None:
            return Situation(kind, eyes=eyes, sound=sound, reacts_to=reacts_to)
        event, quiet = self.event, "" if reaction is not None else self.quiet
        return Situation(
            kind, event.affect, event.gesture, event.confidence, event.source, eyes, sound, reacts_to, quiet
        )

    def _kind(self) -> SituationKind:
        if not self.running:
            return "stopped"
        if self.connection in ("gone", "unreadable"):
            return self.connection
        if self.state == "no signal":
            return "silent"
        if self.state == "unreadable":
            return "unreadable"
        if self.connection:
            return "connecting"
        if self.state == "sensor fault":
            return "sensor_fault"
        if self.event is not None:
            return "event"
        if self.state == "warming":
            return "warming"
        if self.answer == "unknown":
            return "unknown"
        return "unsure" if self.answer in ("sure", "affect", "unsure") else "nothing"


def quiet_reason(profile: Reactions | None, event: EventSpan) -> str:
    """Return why the toy does not react to an event at present.

    "off": without reactions; "none": the profile has none for it; "dark": the reaction is to stay dark; "over": the
    reaction has ended; "named" and "ended": the toy waits until the event is named or ends; "pause": the reaction
    before was too short a time ago.
    """
    if profile is None:
        return "off"
    if event.eyes or event.sound:
        return "dark" if event.eyes == "off" and not event.sound else "over"
    rule = profile.answer(event.affect, event.gesture)
    if rule is None:
        return "none"
    if rule.when == "ended" or (rule.when == "named" and event.gesture is None):
        return rule.when
    return "pause"
