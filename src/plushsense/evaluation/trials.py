"""What rules, network and both together say of the trials of one sitting: who answers which gesture, how soon.

`evaluation/protocol` adds it up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.recfile import Frames
from plushsense.evaluation.sittings import Sitting, Trial
from plushsense.live.decide import DecideSpec
from plushsense.live.stream import Event
from plushsense.live.trace import replay, trace_of
from plushsense.models.bundle import Bundle
from plushsense.models.events import AFFECTS, KINDS, NO_GESTURE, ONE, SOURCES, Update
from plushsense.models.fixed import smoothing_weight
from plushsense.models.gate import GatePlan
from plushsense.models.image import IntegerModel

SYSTEMS = {"rules": "Rules only", "cnn": "Network only", "hybrid": "Hybrid: rules and network"}
GROUPS = {
    "broad": "Broad strokes",
    "fine": "Fine scratches",
    "taps": "Taps",
    "hug": "Hug",
    "energetic": "Blows and pulls",
    "neutral": "Holding",
    "fast": "Energetic gestures",
    "other": "Other gestures",
}
_GROUP_OF = {
    "back stroke": "broad",
    "head stroke": "broad",
    "ear scratch": "fine",
    "neck scratch": "fine",
    "tail scratch": "fine",
    "tail tap": "taps",
    "tail hit": "energetic",
    "tail pull": "energetic",
    "hold strong": "hug",
    "hold in hands": "neutral",
}

EARLY_S = 0.3
"""An answer may come so long before the hand touches: it is felt when it comes near."""
LATE_S = 2.0
"""An answer counts until so long after the hand has left: a network that looks back 2.5 s names a blow of 1 s late."""
AFTER_S = 0.3
"""A gentle gesture that is called negative until so long after its end was called so; later it is something else."""
QUICK_S = 0.2
"""The paper's rules answered blows within 0.1 to 0.2 s."""

JUDGED = ("right", "family", "affect", "wrong", "unnamed")

Heuristic = Callable[[Frames], Sequence[Event]]


def group_of(gesture: Gesture) -> str:
    """The protocol's group of a gesture, as the paper's section 4.6 has them; gestures of other toys have two."""
    return _GROUP_OF.get(gesture.family.casefold(), "fast" if gesture.energetic else "other")


@dataclass(frozen=True, eq=False)
class Heard:
    """What a system said about a stream: ``events`` in order; a network's steps as (time in s, best class, share)."""

    events: tuple[Event, ...]
    answers: tuple[tuple[float, int, float], ...] = ()


def hear(frames: Frames, model: Bundle | IntegerModel, heuristic: Heuristic | None = None) -> dict[str, Heard]:
    """What each system says about a stream, by the keys of `SYSTEMS`.

    The network's settings, and the gate's, are the model's own; a model without a gate makes no hybrid. ``heuristic``
    are the old rules; None: they are not asked.
    """
    trace = trace_of(frames, model)
    if isinstance(model, IntegerModel):
        rules, weight = model.rules, model.smoothing
    else:
        spec = DecideSpec.from_dict(model.decision)
        step_s = model.arch.step * model.layout.period_us / 1e6
        rules, weight = spec.rules(step_s), smoothing_weight(spec.smoothing_s, step_s)
    heard = {} if heuristic is None else {"rules": Heard(tuple(heuristic(frames)))}
    ways = {"cnn": replace(rules, gate=GatePlan())}
    if rules.gate.rules:
        ways["hybrid"] = rules
    for key, way in ways.items():
        done = replay(trace, way, weight, answers=True)
        answers = tuple((now / 1e6, answer.best, answer.share / ONE) for now, answer in done.answers)
        heard[key] = Heard(tuple(events_of(done.updates, trace.gestures)), answers)
    return heard


def events_of(updates: Iterable[Update], gestures: GestureSet) -> list[Event]:
    """Updates as a `StreamReader` tells them."""
    return [
        Event(
            KINDS[u.kind],
            u.number,
            AFFECTS[u.affect],
            None if u.gesture == NO_GESTURE else gestures.labels[u.gesture],
            SOURCES[u.source],
            u.since / 1e6,
            u.now / 1e6,
        )
        for u in updates
    ]


@dataclass
class _Spell:
    """One event from its beginning to its end; ``gesture`` since ``named_s``."""

    affect: str
    source: str
    begun_s: float
    gesture: str | None
    named_s: float
    ended_s: float = math.inf


def _spells(events: Sequence[Event]) -> list[_Spell]:
    spells: dict[int, _Spell] = {}
    for event in events:
        if event.what == "begun":
            spells[event.number] = _Spell(event.affect, event.source, event.t_s, event.gesture, event.t_s)
        elif event.what == "named":
            spells[event.number].gesture, spells[event.number].named_s = event.gesture, event.t_s
            spells[event.number].affect = event.affect
        else:
            spells[event.number].ended_s = event.t_s
    return list(spells.values())


@dataclass(frozen=True)
class Outcome:
    """What a system made of one trial; times in seconds after the onset, None where nothing came.

    Attributes:
        reaction_s: when an event of the right affect began.
        gesture_s: when the right gesture was named, in an event that began in the trial or before.
        called: the gesture of the first event that began, or without one of that which stood; None: it was not named.
        judged: ``right``; ``family``, another of its family; ``affect``, another of its affect; ``wrong``; ``unnamed``.
        likelihood: highest smoothed probability of ``called`` while it was the best class; of networks only.
        negative: an event of negative affect began while the hand worked, or right after.
        already: an event of the right affect stood when the trial began, so that none could begin.
        source: who began the right event, ``gate`` or ``cnn``.
    """

    who: str
    system: str
    gesture: str
    family: str
    group: str
    affect: str
    repetition: int
    onset_s: float
    reaction_s: float | None
    gesture_s: float | None
    called: str | None
    called_family: str | None
    judged: str
    likelihood: float | None
    negative: bool
    already: bool
    source: str | None

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON or CSV."""
        return asdict(self)


@dataclass(frozen=True)
class Between:
    """Events of one stream that began outside every trial, by affect, over ``hours``."""

    hours: float
    positive: int
    neutral: int
    negative: int
    none: int


def windows_of(trials: Sequence[Trial]) -> list[tuple[float, float]]:
    """From when to when an answer belongs to each trial; they do not overlap unless the gestures do."""
    found = []
    for n, trial in enumerate(trials):
        before = trials[n - 1].stop_s if n else -math.inf
        after = trials[n + 1].start_s if n + 1 < len(trials) else math.inf
        first = max(trial.start_s - EARLY_S, min(before, trial.start_s))
        found.append((first, max(trial.stop_s, min(trial.stop_s + LATE_S, after - EARLY_S))))
    return found


def score(sitting: Sitting, system: str, heard: Heard, gestures: GestureSet) -> tuple[list[Outcome], Between]:
    """Every trial's outcome, and what was said between them; a trial of an idle gesture is none."""
    trials = [t for t in sitting.trials if not gestures.get(t.label).idle]
    windows = windows_of(trials)
    spells = _spells(heard.events)
    outcomes = [
        _outcome(sitting.who, system, trial, window, spells, heard, gestures)
        for trial, window in zip(trials, windows, strict=True)
    ]
    stray = [s for s in spells if not any(a <= s.begun_s <= b for a, b in windows)]
    ms = sitting.frames.device_ms.astype(np.int64)
    steps = np.diff(ms)
    whole_s = float(steps[(steps > 0) & (steps < 1000)].sum()) / 1000.0
    hours = max(0.0, whole_s - sum(b - a for a, b in windows)) / 3600.0
    by_affect = {affect: sum(s.affect == affect for s in stray) for affect in AFFECTS}
    return outcomes, Between(hours, *(by_affect[a] for a in ("positive", "neutral", "negative", "none")))


def _outcome(
    who: str,
    system: str,
    trial: Trial,
    window: tuple[float, float],
    spells: Sequence[_Spell],
    heard: Heard,
    gestures: GestureSet,
) -> Outcome:
    gesture = gestures.get(trial.label)
    first, last = window
    here = [s for s in spells if s.ended_s > first and s.begun_s <= last]
    begun = [s for s in here if s.begun_s >= first]
    right = next((s for s in begun if s.affect == gesture.affect), None)
    named = next((s for s in here if s.gesture == gesture.label and first <= s.named_s <= last), None)
    # What the toy says first is what the person sees; where nothing began, what it went on saying.
    said = begun[0] if begun else here[0] if here else None
    called = said.gesture if said is not None and said.named_s <= last else None
    likelihood = None
    if called is not None and heard.answers:
        best = gestures.index(called)
        shares = [share for t, k, share in heard.answers if k == best and first <= t <= last]
        likelihood = max(shares, default=None)
    return Outcome(
        who,
        system,
        gesture.label,
        gesture.family,
        group_of(gesture),
        gesture.affect,
        trial.repetition,
        round(trial.onset_s, 3),
        None if right is None else round(right.begun_s - trial.onset_s, 3),
        None if named is None else round(named.named_s - trial.onset_s, 3),
        called,
        None if called is None else gestures.get(called).family,
        _judged(gesture, None if called is None else gestures.get(called)),
        None if likelihood is None else round(likelihood, 4),
        any(s.affect == "negative" and s.begun_s <= trial.stop_s + AFTER_S for s in begun),
        any(s.affect == gesture.affect and s.begun_s < first for s in here),
        None if right is None else right.source,
    )


def _judged(made: Gesture, called: Gesture | None) -> str:
    if called is None:
        return "unnamed"
    if called == made:
        return "right"
    if called.family == made.family:
        return "family"
    return "affect" if called.affect == made.affect != "none" else "wrong"
