"""Score rules, network and both together on the trials of recorded or virtual sessions."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import mean

import numpy as np

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.core.toml import load_table, read_toml
from plushsense.experiments.protocol.sittings import GestureTrial, LeftOut, Sitting, VirtualSitting
from plushsense.jobs.journal import Result
from plushsense.jobs.pool import Report
from plushsense.jobs.study import Progress, StudyPart, StudyResults, run_study
from plushsense.models.bundle import Bundle
from plushsense.runtime.classifier import GestureEvent, events_of
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import AFFECTS, ONE
from plushsense.runtime.fixed import smoothing_weight
from plushsense.runtime.gate import GateSettings
from plushsense.runtime.image import IntegerModel
from plushsense.runtime.trace import replay, trace_of
from plushsense.scoring.events import latency_summary

SYSTEMS = {
    "toy": "The toy's own rules, noted by hand",
    "rules": "Rules only",
    "cnn": "Network only",
    "hybrid": "Hybrid: rules and network",
}
NAMELESS = ("toy", "rules")
"""Systems that answer with an affect and never name a gesture."""


@dataclass(frozen=True)
class PrintedFigures:
    """Figures of one group and system as the paper prints them; "" where it prints none.

    ``reaction_s``: the reaction time as a range (low, high).
    """

    answered: str = ""
    time: str = ""
    likelihood: str = ""
    reaction_s: tuple[float, ...] = ()


@dataclass(frozen=True)
class GestureGroup:
    """A group of gesture families, with the paper's figures for each system."""

    title: str
    families: tuple[str, ...] = ()
    paper: Mapping[str, PrintedFigures] = field(default_factory=dict)


@dataclass(frozen=True)
class _ProtocolFile:
    groups: Mapping[str, GestureGroup]
    notes: Mapping[str, str]


def _read_protocol() -> _ProtocolFile:
    path = Path(__file__).with_name("protocol.toml")
    return load_table(read_toml(path, "protocol", ConfigError), _ProtocolFile, path.name, ConfigError)


_PROTOCOL = _read_protocol()
GROUPS, NOTES = _PROTOCOL.groups, _PROTOCOL.notes

EARLY_S = 0.3
"""How long before the touch an answer counts; the sensors already detect the approaching hand."""
LATE_S = 2.0
"""How long after the gesture an answer counts; a network with windows of 2.5 s recognises short blows late."""
AFTER_S = 0.3
"""How long after the end of a gentle gesture a negative event is still counted as an error on that gesture."""
QUICK_S = 0.2
"""Longest reaction time that counts as quick; the paper's rules answered blows within 0.1 to 0.2 s."""

JUDGED = ("right", "family", "affect", "wrong", "unnamed")

RuleBaseline = Callable[[Frames], Sequence[GestureEvent]]


def group_of(gesture: Gesture) -> str:
    """Return a gesture's group in the protocol (paper, section 4.6); families outside it are "fast" or "other"."""
    groups = (name for name, group in GROUPS.items() if gesture.family.casefold() in group.families)
    return next(groups, "fast" if gesture.energetic else "other")


@dataclass(frozen=True, eq=False)
class SystemOutput:
    """Events of a system on a stream, in order, and for networks each step's (time in s, best class, its share)."""

    events: tuple[GestureEvent, ...]
    answers: tuple[tuple[float, int, float], ...] = ()


def system_outputs(
    frames: Frames, model: Bundle | IntegerModel, baseline: RuleBaseline | None = None
) -> dict[str, SystemOutput]:
    """Return the output of each system on a stream, by the keys of `SYSTEMS`.

    Network and gate use the model's own settings; without a gate there is no hybrid. ``baseline`` is the rule
    baseline; None leaves it out.
    """
    trace = trace_of(frames, model)
    if isinstance(model, IntegerModel):
        rules, weight = model.rules, model.smoothing
    else:
        spec = DecideSpec.from_dict(model.decision)
        step_s = model.arch.step * model.layout.period_us / 1e6
        rules, weight = spec.rules(step_s), smoothing_weight(spec.smoothing_s, step_s)
    outputs = {} if baseline is None else {"rules": SystemOutput(tuple(baseline(frames)))}
    ways = {"cnn": replace(rules, gate=GateSettings())}
    if rules.gate.rules:
        ways["hybrid"] = rules
    for key, way in ways.items():
        done = replay(trace, way, weight)
        answers = tuple((now / 1e6, answer.best, answer.share / ONE) for now, answer in done.answers)
        outputs[key] = SystemOutput(events_of(done.updates, trace.gestures), answers)
    return outputs


def noted_output(reactions: Sequence[tuple[float, str]]) -> SystemOutput:
    """Return the toy's own reactions, (time in s, affect), as events that last no time."""
    events = (
        GestureEvent(kind, number, affect, None, "gate", at_s, at_s)
        for number, (at_s, affect) in enumerate(reactions, 1)
        for kind in ("begun", "ended")
    )
    return SystemOutput(tuple(events))


@dataclass
class _EventSpan:
    """An event with its times in seconds; its ``gesture`` was named at ``named_s``, None if it never was."""

    affect: str
    source: str
    begun_s: float
    gesture: str | None
    named_s: float
    ended_s: float = math.inf


def _event_spans(events: Sequence[GestureEvent]) -> list[_EventSpan]:
    spans: dict[int, _EventSpan] = {}
    for event in events:
        if event.kind == "begun":
            spans[event.number] = _EventSpan(event.affect, event.source, event.t_s, event.gesture, event.t_s)
        elif event.kind == "named":
            spans[event.number].gesture, spans[event.number].named_s = event.gesture, event.t_s
            spans[event.number].affect = event.affect
        else:
            spans[event.number].ended_s = event.t_s
    return list(spans.values())


@dataclass(frozen=True)
class TrialOutcome:
    """Outcome of one trial for a system; times in seconds after the onset, None where there was no such event.

    Attributes:
        reaction_s: when an event of the right affect began.
        gesture_s: when the right gesture was named, in an event that began in the trial or before it.
        called: the gesture of the first event that began in the trial, or else of one already active; None: not named.
        judged: ``right``; ``family``, another of its family; ``affect``, another of its affect; ``wrong``; ``unnamed``.
        likelihood: highest smoothed probability of ``called`` while it was the best class; None for the rules.
        negative: whether an event of negative affect began during the gesture or within `AFTER_S` of its end.
        already: whether an event of the right affect was active when the trial began, so that none could begin.
        source: what began the event of the right affect, ``gate`` or ``cnn``.
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


@dataclass(frozen=True)
class Between:
    """Numbers of events in one stream that began outside all trials, by affect; ``hours`` is the time outside them."""

    hours: float
    positive: int
    neutral: int
    negative: int
    none: int


def windows_of(trials: Sequence[GestureTrial]) -> list[tuple[float, float]]:
    """Return for each trial the interval in which answers count; intervals overlap only where the gestures do."""
    windows = []
    for n, trial in enumerate(trials):
        before = trials[n - 1].stop_s if n else -math.inf
        after = trials[n + 1].start_s if n + 1 < len(trials) else math.inf
        first = max(trial.start_s - EARLY_S, min(before, trial.start_s))
        windows.append((first, max(trial.stop_s, min(trial.stop_s + LATE_S, after - EARLY_S))))
    return windows


def score(
    sitting: Sitting, system: str, output: SystemOutput, gestures: GestureSet
) -> tuple[list[TrialOutcome], Between]:
    """Return the outcome of every trial, and the events between the trials; idle gestures are not trials."""
    trials = [t for t in sitting.trials if not gestures.get(t.label).idle]
    windows = windows_of(trials)
    spans = _event_spans(output.events)
    outcomes = [
        _outcome(sitting.who, system, trial, window, spans, output, gestures)
        for trial, window in zip(trials, windows, strict=True)
    ]
    stray = [s for s in spans if not any(a <= s.begun_s <= b for a, b in windows)]
    ms = sitting.frames.device_ms.astype(np.int64)
    steps = np.diff(ms)
    whole_s = float(steps[(steps > 0) & (steps < 1000)].sum()) / 1000.0
    hours = max(0.0, whole_s - sum(b - a for a, b in windows)) / 3600.0
    by_affect = {affect: sum(s.affect == affect for s in stray) for affect in AFFECTS}
    return outcomes, Between(hours, *(by_affect[a] for a in ("positive", "neutral", "negative", "none")))


def _outcome(
    who: str,
    system: str,
    trial: GestureTrial,
    window: tuple[float, float],
    spans: Sequence[_EventSpan],
    output: SystemOutput,
    gestures: GestureSet,
) -> TrialOutcome:
    gesture = gestures.get(trial.label)
    first, last = window
    here = [s for s in spans if s.ended_s > first and s.begun_s <= last]
    begun = [s for s in here if s.begun_s >= first]
    right = next((s for s in begun if s.affect == gesture.affect), None)
    named = next((s for s in here if s.gesture == gesture.label and first <= s.named_s <= last), None)
    # The first event of the trial counts; where none began, the event that continued.
    answer = begun[0] if begun else here[0] if here else None
    called = answer.gesture if answer is not None and answer.named_s <= last else None
    likelihood = None
    if called is not None and output.answers:
        best = gestures.index(called)
        shares = [share for t, k, share in output.answers if k == best and first <= t <= last]
        likelihood = max(shares, default=None)
    return TrialOutcome(
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


@dataclass(frozen=True)
class TrialSummary:
    """Figures of the trials of one system: shares are of all ``trials``, times only of those that were answered.

    ``called`` counts the values of `TrialOutcome.judged`; ``reaction_s`` and ``gesture_s`` hold median and p90.
    """

    trials: int
    activated: int
    activation: float | None
    already: int
    reaction_s: Mapping[str, float | None]
    within_200_ms: int
    quick: float | None
    named: int
    gesture_activation: float | None
    gesture_s: Mapping[str, float | None]
    likelihood: float | None
    gentle: int
    called_negative: int
    negative: float | None
    called: Mapping[str, int]
    from_gate: int


def summary(outcomes: Sequence[TrialOutcome]) -> TrialSummary:
    """Summarise the trials of one system."""
    n = len(outcomes)
    reactions = sorted(o.reaction_s for o in outcomes if o.reaction_s is not None)
    named = sorted(o.gesture_s for o in outcomes if o.gesture_s is not None)
    likely = [o.likelihood for o in outcomes if o.likelihood is not None]
    quick = sum(r <= QUICK_S for r in reactions)
    gentle = [o for o in outcomes if o.affect != "negative"]
    return TrialSummary(
        trials=n,
        activated=len(reactions),
        activation=_share(len(reactions), n),
        already=sum(o.already and o.reaction_s is None for o in outcomes),
        reaction_s=_times(reactions),
        within_200_ms=quick,
        quick=_share(quick, n),
        named=len(named),
        gesture_activation=_share(len(named), n),
        gesture_s=_times(named),
        likelihood=round(mean(likely), 4) if likely else None,
        gentle=len(gentle),
        called_negative=sum(o.negative for o in gentle),
        negative=_share(sum(o.negative for o in gentle), len(gentle)),
        called={word: sum(o.judged == word for o in outcomes) for word in JUDGED},
        from_gate=sum(o.source == "gate" for o in outcomes),
    )


def _share(part: int, of: int) -> float | None:
    return round(part / of, 4) if of else None


def _times(values: Sequence[float]) -> dict[str, float | None]:
    return {name: None if value is None else round(value, 3) for name, value in latency_summary(values).items()}


@dataclass(frozen=True)
class SummaryRow:
    """The figures of one system: of a ``group`` of gestures ("all": of all), or of one ``gesture``."""

    group: str
    title: str
    gesture: str | None
    system: str
    figures: TrialSummary

    def to_json(self) -> dict[str, object]:
        """Return plain values, the figures beside what they are of."""
        of = {"group": self.group, "title": self.title} if self.gesture is None else {"gesture": self.gesture}
        return {**of, "system": self.system, **vars(self.figures)}


@dataclass(frozen=True)
class FamilyConfusion:
    """How many trials of a true family (``did``) were recognised as another (``called``; None: not named)."""

    system: str
    did: str
    called: str | None
    trials: int
    share: float | None


def confusions(outcomes: Sequence[TrialOutcome]) -> list[FamilyConfusion]:
    """Count for each true family the recognised families, the most frequent first."""
    counts = Counter((o.family, o.called_family) for o in outcomes)
    totals = Counter(o.family for o in outcomes)
    order = list(totals)
    return [
        FamilyConfusion(outcomes[0].system, did, called, n, _share(n, totals[did]))
        for (did, called), n in sorted(counts.items(), key=lambda item: (order.index(item[0][0]), -item[1]))
    ]


@dataclass(frozen=True)
class StrayEvents:
    """Events of a system between the trials, in all streams; all but neutral ones are reactions."""

    system: str
    hours: float
    positive: int
    neutral: int
    negative: int
    none: int
    reactions_per_hour: float | None
    negative_per_hour: float | None

    @classmethod
    def summed(cls, system: str, between: Sequence[Between]) -> StrayEvents:
        hours = sum(b.hours for b in between)
        counts = {name: sum(getattr(b, name) for b in between) for name in ("positive", "neutral", "negative", "none")}
        reactions = counts["positive"] + counts["negative"] + counts["none"]
        rates = [round(n / hours, 2) if hours else None for n in (reactions, counts["negative"])]
        return cls(system, round(hours, 4), **counts, reactions_per_hour=rates[0], negative_per_hour=rates[1])


@dataclass(frozen=True)
class ScoredTrials:
    """The outcome of every trial by each system, and what follows from them.

    ``rows`` are of each group and of all trials; ``between`` are the events outside all trials.
    """

    people: tuple[str, ...]
    trials: int
    gestures: int
    systems: tuple[str, ...]
    rows: tuple[SummaryRow, ...]
    by_gesture: tuple[SummaryRow, ...]
    confusions: tuple[FamilyConfusion, ...]
    between: tuple[StrayEvents, ...]
    outcomes: tuple[TrialOutcome, ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "people": list(self.people),
            "trials": self.trials,
            "gestures": self.gestures,
            "systems": [{"system": key, "title": SYSTEMS[key]} for key in self.systems],
            "rows": [row.to_json() for row in self.rows],
            "by_gesture": [row.to_json() for row in self.by_gesture],
            "confusions": [dict(vars(row)) for row in self.confusions],
            "between": [dict(vars(row)) for row in self.between],
            "outcomes": [dict(vars(outcome)) for outcome in self.outcomes],
        }


@dataclass(frozen=True)
class _SittingWork:
    """The work on one sitting: run every system on it, and score its trials."""

    model: Bundle | IntegerModel
    baseline: RuleBaseline | None

    def __call__(self, gestures: GestureSet, task: Sitting | VirtualSitting, report: Report, /) -> Result:
        sitting = task.play()
        outputs = system_outputs(sitting.frames, self.model, self.baseline)
        if sitting.reactions is not None:
            outputs["toy"] = noted_output(sitting.reactions)
        scored = {system: score(sitting, system, output, gestures) for system, output in outputs.items()}
        return {
            "outcomes": [asdict(outcome) for outcomes, _ in scored.values() for outcome in outcomes],
            "between": {system: asdict(between) for system, (_, between) in scored.items()},
        }


def score_sittings(
    sittings: Sequence[Sitting | VirtualSitting],
    model: Bundle | IntegerModel,
    baseline: RuleBaseline | None = None,
    progress: Progress | None = None,
) -> ScoredTrials:
    """Run every system on every sitting, and summarise the outcomes."""
    labels = model.gestures.labels

    def summarise(study: StudyResults) -> ScoredTrials:
        outcomes = [TrialOutcome(**row) for result in study.results for row in result["outcomes"]]
        between: dict[str, list[Between]] = {}
        for result in study.results:
            for system, stray in result["between"].items():
                between.setdefault(system, []).append(Between(**stray))
        systems = tuple(key for key in SYSTEMS if key in between)
        by_system = {key: [o for o in outcomes if o.system == key] for key in systems}
        groups = [g for g in GROUPS if any(o.group == g for o in outcomes)]
        made = [label for label in labels if any(o.gesture == label for o in outcomes)]
        rows = [
            SummaryRow(g, GROUPS[g].title, None, key, summary([o for o in by_system[key] if o.group == g]))
            for g in groups
            for key in systems
        ]
        rows += [SummaryRow("all", "All gestures", None, key, summary(by_system[key])) for key in systems]
        by_gesture = [
            SummaryRow("", "", label, key, summary([o for o in by_system[key] if o.gesture == label]))
            for label in made
            for key in systems
        ]
        return ScoredTrials(
            tuple(sitting.who for sitting in sittings),
            len(by_system[systems[0]]),
            len(made),
            systems,
            tuple(rows),
            tuple(by_gesture),
            tuple(c for key in systems for c in confusions(by_system[key])),
            tuple(StrayEvents.summed(key, between[key]) for key in systems),
            tuple(outcomes),
        )

    parts = [StudyPart(sitting.who, {"sitting": n}, sitting) for n, sitting in enumerate(sittings)]
    work = _SittingWork(model, baseline)
    return run_study(parts, work, summarise, key={}, shared=model.gestures, progress=progress)


@dataclass(frozen=True)
class ProtocolResult:
    """The result of the protocol, as its page shows it.

    Attributes:
        simulated: whether the people or their toy were virtual.
        left: people who were left out.
        counted: notes on how figures are counted.
        said: notes on the limits of the figures.
        about: rows (name, value) on people, network and settings.
        files: what was written.
    """

    scored: ScoredTrials
    heading: str
    simulated: bool
    left: tuple[LeftOut, ...]
    counted: tuple[str, ...]
    said: tuple[str, ...]
    about: tuple[tuple[str, str], ...]
    engine: str
    files: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            **self.scored.to_json(),
            "heading": self.heading,
            "simulated": self.simulated,
            "left": [dict(vars(one)) for one in self.left],
            "counted": list(self.counted),
            "said": list(self.said),
            "about": [list(row) for row in self.about],
            "engine": self.engine,
            **({"files": list(self.files)} if self.files else {}),
        }
