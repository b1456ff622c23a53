"""Run the paper's real-time protocol with a bundle, on new virtual people or on recorded sessions of real ones."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.layouts import Layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.deploy.quantize import integer_model
from plushsense.experiments.protocol.score import (
    NOTES,
    ProtocolResult,
    RuleBaseline,
    ScoredTrials,
    score_sittings,
)
from plushsense.experiments.protocol.sittings import (
    FIRST_STRANGER,
    LeftOut,
    Sitting,
    VirtualSitting,
    recorded_people,
    recorded_sittings,
    virtual_numbers,
    virtual_sittings,
)
from plushsense.experiments.recordings import opened
from plushsense.jobs.study import Progress
from plushsense.models.arch import slashed
from plushsense.models.bundle import Bundle, known_people
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.runtime.decisions import DecideSpec
from plushsense.tuning.rule_baseline import fit_rule_baseline, rule_baseline_events
from plushsense.workflow.reporting import check_folder

OTHERS = 4
_ELSEWHERE = 1_000_003  # added to the seed, for people of another population


def virtual_rules(seed: int, layout: Layout, gestures: GestureSet, people: int = OTHERS) -> tuple[RuleBaseline, str]:
    """Tune the rule baseline on virtual people of another population; return it and a sentence on the tuning."""
    with tempfile.TemporaryDirectory() as work:
        raw, folder = Path(work) / "raw", Path(work) / "ds"
        simulate(
            raw,
            SimulationSpec(people=people, seed=(seed + _ELSEWHERE) % 2**31, repetitions=2, at_rest=0, layout=layout),
        )
        dataset = import_recordings(raw, folder, layout=layout, gestures=gestures, name="others").dataset
        settings = fit_rule_baseline(dataset, gestures, dataset.subjects)
    baseline = partial(rule_baseline_events, layout=layout, settings=settings)
    return baseline, f"Tuned on {people} other virtual people, of another population."


def recorded_rules(dataset: Dataset, gestures: GestureSet, scored: Collection[str]) -> tuple[RuleBaseline | None, str]:
    """Tune the rule baseline on the people not in ``scored``; return it, or None, and a sentence on the tuning."""
    others: Sequence[str] = [code for code in dataset.subjects if code not in scored]
    if not others:
        return None, "Everybody is scored here, so nobody is left to tune the rule baseline on: it is left out."
    try:
        settings = fit_rule_baseline(dataset, gestures, others)
    except ConfigError as cause:
        return None, f"The rule baseline cannot be tuned: {cause}"
    baseline = partial(rule_baseline_events, layout=dataset.layout, settings=settings)
    return baseline, f"Tuned on people who are not scored here: {len(others)}."


RESULT, TRIALS, TABLE, PAGE = "protocol.json", "trials.csv", "table.csv", "protocol.html"
ENGINES = ("float", "int8")


def protocol(
    model: Bundle | str | os.PathLike[str],
    *,
    virtual: VirtualPeople | None = None,
    dataset: Dataset | str | os.PathLike[str] | None = None,
    session: str | os.PathLike[str] | None = None,
    subjects: Sequence[str] | None = None,
    engine: str = "float",
    rules: bool = True,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> ProtocolResult:
    """Run the protocol, score rules, network and hybrid, and write table, trials and page.

    Args:
        model: a bundle; its own decision settings, including the gate, are used.
        virtual: the virtual people who touch the toy, unless a data set or session is given.
        dataset, session: recorded sessions instead of virtual people: a data set, or a recorder's output folder.
        subjects: people of that data set or session; default: all on whom the network was neither trained nor chosen.
        engine: ``float``, or ``int8`` for the integer arithmetic of the deployed network.
        rules: also score the rule baseline, after tuning it on people who are not scored.
        out: folder for the JSON, two CSV and the HTML page; None: nothing is written.

    Raises:
        ConfigError: for people on whom the network was trained, a number out of range, or a folder with other files.
        DatasetError: where nobody has a session stream with recordings in it.
    """
    bundle = model if isinstance(model, Bundle) else Bundle.load(Path(model))
    if engine not in ENGINES:
        raise ConfigError(f"The engine is '{engine}'; accepted are {', '.join(ENGINES)}.")
    if dataset is not None and session is not None:
        raise ConfigError("A data set and a session were given: give one of them.")
    if subjects is not None and dataset is None and session is None:
        raise ConfigError("Subjects are people of a data set or session; of virtual people give their number.")
    place = None if out is None else _place(Path(out))
    source = dataset if dataset is not None else session
    if source is None:
        result = _scored(_virtual(virtual or VirtualPeople(), bundle, rules), bundle, engine, progress)
        return result if place is None else _write(result, place)
    with opened(source, bundle.layout, bundle.gestures) as recorded:
        result = _scored(_recorded(recorded, bundle, subjects, rules), bundle, engine, progress)
        if place is not None:
            with recorded.generation.writing():
                result = _write(result, place)
    return result


def live_protocol(
    bundle: Bundle,
    sittings: Sequence[Sitting],
    *,
    engine: str = "float",
    tune_on: Dataset | None = None,
    simulated: bool = False,
    out: str | os.PathLike[str] | None = None,
) -> ProtocolResult:
    """Score sittings in which people were prompted live, and write the same files as `protocol`.

    Args:
        tune_on: data set on whose people, except those of the sittings, the rule baseline is tuned; None leaves it out.
        simulated: whether the toy was a virtual one.
    """
    people = list(dict.fromkeys(s.who for s in sittings))
    baseline, tuned = None, NOTES["no_rules"]
    if tune_on is not None:
        baseline, tuned = recorded_rules(tune_on, bundle.gestures, people)
    place = None if out is None else _place(Path(out))
    noted = ("noted",) if any(s.reactions is not None for s in sittings) else ()
    scene = _Scene(
        tuple(sittings),
        baseline,
        tuned,
        f"The paper's real-time protocol, led live{', SIMULATED' if simulated else ''}",
        simulated,
        ", ".join(people),
        ("answered", "onset_live", "likelihood", *noted),
        tuple(people),
    )
    result = _scored(scene, bundle, engine)
    return result if place is None else _write(result, place)


@dataclass(frozen=True)
class VirtualPeople:
    """Virtual people: how many, the first one's number, the population's seed, and repetitions of each gesture."""

    people: int = 5
    first: int = FIRST_STRANGER
    seed: int = 1
    repetitions: int = 3


@dataclass(frozen=True, eq=False)
class _Scene:
    """Sittings to score with a rule baseline, and how the result describes them.

    ``tuned`` is a sentence on the baseline, ``people`` describes the people, ``counted`` are keys of `NOTES`; ``codes``
    are codes of real people, who may be known to the bundle.
    """

    sittings: tuple[Sitting | VirtualSitting, ...]
    baseline: RuleBaseline | None
    tuned: str
    heading: str
    simulated: bool
    people: str
    counted: tuple[str, ...]
    codes: tuple[str, ...] = ()
    left: tuple[LeftOut, ...] = ()


def _virtual(virtual: VirtualPeople, bundle: Bundle, rules: bool) -> _Scene:
    numbers = virtual_numbers(virtual.people, virtual.first, bundle.provenance)
    sittings = virtual_sittings(numbers, virtual.seed, virtual.repetitions, bundle.layout)
    baseline, tuned = None, NOTES["no_rules"]
    if rules:
        baseline, tuned = virtual_rules(virtual.seed, bundle.layout, bundle.gestures)
    whom = f"{virtual.people} virtual, number {numbers[0]} to {numbers[-1]} of the population of seed {virtual.seed}"
    return _Scene(
        tuple(sittings),
        baseline,
        tuned,
        "The paper's real-time protocol, SIMULATED",
        True,
        whom,
        ("answered", "onset_virtual", "likelihood"),
    )


def _recorded(dataset: Dataset, bundle: Bundle, subjects: Sequence[str] | None, rules: bool) -> _Scene:
    """Return the recorded sessions of people of a data set."""
    if not dataset.layout.reads_as(bundle.layout):
        raise ConfigError(
            f"'{dataset.head.name}' was recorded with layout '{dataset.layout.name}', but the network reads "
            f"'{bundle.layout.name}': take a network that was made for it."
        )
    people = recorded_people(dataset, subjects, bundle.provenance)
    sittings, left = recorded_sittings(dataset, people, bundle.gestures)
    baseline, tuned = recorded_rules(dataset, bundle.gestures, people) if rules else (None, NOTES["no_rules"])
    source = "recorded sessions of a simulation" if dataset.head.simulated else "recorded sessions"
    return _Scene(
        tuple(sittings),
        baseline,
        tuned,
        f"The paper's real-time protocol on {source}: {dataset.head.name}",
        dataset.head.simulated,
        f"{len({s.who.partition(',')[0] for s in sittings})} of {len(dataset.subjects)}: "
        + ", ".join(s.who for s in sittings),
        ("answered", "onset_recorded", "likelihood"),
        tuple(people),
        tuple(left),
    )


def _scored(scene: _Scene, bundle: Bundle, engine: str, progress: Progress | None = None) -> ProtocolResult:
    """Score the sittings, and add rows on network and settings, and notes on their limits."""
    model = integer_model(bundle) if engine == "int8" else bundle
    scored = score_sittings(scene.sittings, model, scene.baseline, progress)
    return ProtocolResult(
        scored,
        scene.heading,
        scene.simulated,
        scene.left,
        tuple(NOTES[key] for key in scene.counted),
        tuple(_notes(scene, scored, bundle)),
        tuple(_about(scene, scored, bundle, engine)),
        engine,
    )


def _notes(scene: _Scene, scored: ScoredTrials, bundle: Bundle) -> list[str]:
    """Return notes on the limits of the figures."""
    settings = DecideSpec.from_dict(bundle.decision)
    notes = []
    if not settings.gate.rules:
        notes.append(NOTES["no_gate"])
    if "rules" not in scored.systems:
        notes.append(scene.tuned)
    if not bundle.gestures.has_affect:
        notes.append(NOTES["no_affect"])
    if not settings.fitted:
        notes.append(NOTES["not_fitted"])
    known = known_people(bundle.provenance)
    if not known:
        notes.append(NOTES["unknown_people"])
    known |= {bundle.adapted_to} if bundle.adapted_to is not None else set()
    met = sorted(known & set(scene.codes))
    if met:
        notes.append(
            f"This bundle was trained on, or adapted to, people of the codes {', '.join(met)}: if they are the same "
            "people, their figures flatter."
        )
    if bundle.simulated and not scene.simulated:
        notes.append(NOTES["trained_virtual"])
    return notes + [f"{one.who} {one.why}, and was left out." for one in scene.left]


def _about(scene: _Scene, scored: ScoredTrials, bundle: Bundle, engine: str) -> list[tuple[str, str]]:
    """Return rows (name, value) on people, network and settings."""
    settings, provenance = DecideSpec.from_dict(bundle.decision), bundle.provenance
    filters, span_s = slashed(bundle.arch.filters), bundle.arch.span / bundle.layout.rate_hz
    subjects = provenance.get("subjects", ())
    who = subjects if isinstance(subjects, int) else len(set(subjects) - {NOBODY})
    trained = f"{provenance['dataset']}, {who} people" if provenance.get("dataset") else "unknown to the bundle"
    times = max((o.repetition for o in scored.outcomes), default=0)
    about = [
        ("People", scene.people),
        ("Trials", f"{scored.trials}: {scored.gestures} gestures, up to {times} times each a person"),
        ("Network", f"{bundle.arch.symbol}, filters {filters}, {bundle.arch.padding}; span {span_s:.2f} s"),
        ("Trained on", trained),
        ("Arithmetic", "8 bits, the toy's own" if engine == "int8" else "floating point"),
        ("Gate", {0: "none", 1: "1 rule"}.get(len(settings.gate.rules), f"{len(settings.gate.rules)} rules")),
        ("Event settings", "fitted" if settings.fitted else "defaults, not fitted"),
    ]
    return about + ([("Rule baseline", scene.tuned)] if "rules" in scored.systems else [])


def _place(out: Path) -> Path:
    """Check that the output folder is new, empty, or holds the results of an earlier protocol; return it."""
    check_folder(out, "A protocol")
    if out.is_dir() and any(out.iterdir()) and not (out / RESULT).is_file():
        raise ConfigError(f"'{out}' holds something that is not a protocol: give a new or empty folder.")
    return out


def _write(result: ProtocolResult, out: Path) -> ProtocolResult:
    """Write the files of a result, and return it with their paths."""
    from plushsense.experiments.protocol.protocol_page import figure_table, page
    from plushsense.reports.page import write_page
    from plushsense.reports.table import Table

    html = page(result)  # before any file, as it may lack an extra
    out.mkdir(parents=True, exist_ok=True)
    trials = Table.from_rows("trials", "Every trial by each system", [dict(vars(o)) for o in result.scored.outcomes])
    write_file(out / TRIALS, trials.csv({"simulated": "yes" if result.simulated else "no"}))
    write_file(out / TABLE, figure_table(result).csv())
    write_page(out / PAGE, html)
    write_file(out / RESULT, json.dumps(result.to_json(), ensure_ascii=False, indent=1, allow_nan=False) + "\n")
    return replace(result, files=tuple(str(out / name) for name in (PAGE, TABLE, TRIALS, RESULT)))
