"""What a live page can know: what was chosen, what the network and the gate say, and the events on the time line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from plushsense.live.react import Reaction


@dataclass(frozen=True)
class Choice:
    """What is listened to, and with what. ``reactions``: a name, or "" for a toy that does nothing.

    ``simulated``: the toy is a virtual one, also behind a port.
    """

    toy: str = ""
    bundle: Path | None = None
    engine: str = "float"
    reactions: str = "standard"
    simulated: bool = False


@dataclass(frozen=True)
class Voice:
    """What one of the two said last: the network at every step, the gate when a rule of it fired."""

    t_s: float
    affect: str | None
    gesture: str | None
    confidence: float | None = None
    answer: str | None = None


@dataclass(frozen=True)
class Span:
    """An event on the time line. ``number`` counts from 1 over all bundles; ``change`` grows with every change of any.

    ``end_s`` is None while it lasts.
    """

    number: int
    change: int
    begin_s: float
    affect: str
    gesture: str | None
    source: str
    end_s: float | None = None


@dataclass(frozen=True)
class Now:
    """All that a page shows beside the signals. Times are those of the ring: seconds of the toy since it was opened.

    Attributes:
        generation: grows when the toy or the bundle is another one, and pages begin anew.
        running: whether a toy is being read; ``said``: why not any more, a sentence, or "".
        trouble: why nothing can be read just now, a sentence, or "".
        state: as of a decision; "" before the first.
        probabilities: of the classes, in the bundle's order; None while there is no answer.
        event: what goes on.
        reaction: what the toy does, and until when.
        latency_s: from the bytes to the newest decision; ``arrived``: when those bytes came, seconds since 1970.
        changes: number of the newest change of a span.
    """

    generation: int = 0
    running: bool = False
    said: str = ""
    trouble: str = ""
    state: str = ""
    t_s: float = 0.0
    probabilities: tuple[float, ...] | None = None
    network: Voice | None = None
    gate: Voice | None = None
    event: Span | None = None
    reaction: Reaction | None = None
    reaction_ends_s: float = 0.0
    latency_s: float | None = None
    arrived: float = 0.0
    changes: int = 0
