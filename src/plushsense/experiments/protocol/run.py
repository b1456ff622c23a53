"""Run the paper's real-time protocol with a bundle, on new virtual people or on recorded sessions of real ones."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.files import temporary_folder, write_file
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.layouts import Layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.deploy.quantize import integer_model
from plushsense.experiments.protocol import score as scoring
from plushsense.experiments.protocol.score import NOTES, RuleBaseline
from plushsense.experiments.protocol.sittings import (
    FIRST_STRANGER,
    Progress,
    Sitting,
    recorded_people,
    recorded_sittings,
    virtual_numbers,
    virtual_sittings,
)
from plushsense.models.arch import slashed
from plushsense.models.bundle import Bundle, known_people
from plushsense.recording.simulate import simulate
from plushsense.runtime.decisions import DecideSpec
from plushsense.tuning.rule_baseline import fit_rule_baseline, rule_baseline_events
from plushsense.workflow.reporting import check_folder

OTHERS = 4
_ELSEWHERE = 1_000_003  # added to the seed, for people of another population


def virtual_rules(seed: int, layout: Layout, gestures: GestureSet, people: int = OTHERS) -> tuple[RuleBaseline, str]:
    """Tune the rule baseline on virtual people of another population; return it and a sentence on the tuning."""
    with tempfile.TemporaryDirectory() as work:
        raw, folder = Path(work) / "raw", Path(work) / "ds"
        simulate(raw, people, (seed + _ELSEWHERE) % 2**31, 2, at_rest=0, layout=layout)
        dataset = import_recordings(raw, folder, layout=layout, gestures=gestures, name="others").dataset
        settings, _ = fit_rule_baseline(dataset, gestures, dataset.subjects)
    baseline = partial(rule_baseline_events, layout=layout, settings=settings)
    return baseline, f"Tuned on {people} other virtual people, of another population."


def recorded_rules(dataset: Dataset, gestures: GestureSet, scored: Collection[str]) -> tuple[RuleBaseline | None, str]:
    """Tune the rule baseline on the people not in ``scored``; return it, or None, and a sentence on the tuning."""
    others: Sequence[str] = [code for code in dataset.subjects if code not in scored]
    if not others:
        return None, "Everybody is scored here, so nobody is left to tune the rule baseline on: it is left out."
    try:
        settings, _ = fit_rule_baseline(dataset, gestures, others)
    except ConfigError as cause:
        return None, f"The rule baseline cannot be tuned: {cause}"
    baseline = partial(rule_baseline_events, layout=dataset.layout, settings=settings)
    return baseline, f"Tuned on people who are not scored here: {len(others)}."


RESULT, TRIALS, TABLE, PAGE = "protocol.json", "trials.csv", "table.csv", "protocol.html"
ENGINES = ("float", "int8")


def protocol(
    model: Bundle | str | os.PathLike[str],
    *,
    people: int = 5,
    first: int = FIRST_STRANGER,
    seed: int = 1,
    repetitions: int = 3,
    dataset: Dataset | str | os.PathLike[str] | None = None,
    session: str | os.PathLike[str] | None = None,
    subjects: Sequence[str] | None = None,
    engine: str = "float",
    rules: bool = True,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Run the protocol, score rules, network and hybrid, and write table, trials and page.

    Args:
        model: a bundle; its own decision settings, including the gate, are used.
        people, first, seed, repetitions: number of virtual people, first number, population, repetitions of a gesture.
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
    asked = integer_model(bundle) if engine == "int8" else bundle
    made: dict[str, Any]
    if dataset is not None:
        dataset = as_dataset(dataset)
        made = _recorded(dataset, bundle, asked, subjects, rules, progress)
    elif session is not None:
        with temporary_folder() as work:
            folder = work / "session"
            import_recordings(
                Path(session),
                folder,
                layout=bundle.layout,
                gestures=bundle.gestures,
                name=Path(session).resolve().name,
                adopt_proposals=False,
            )
            made = _recorded(as_dataset(folder), bundle, asked, subjects, rules, progress)
    else:
        numbers = virtual_numbers(people, first, bundle.provenance)
        sittings = virtual_sittings(numbers, seed, repetitions, bundle.layout)
        baseline, tuned = virtual_rules(seed, bundle.layout, bundle.gestures) if rules else (None, NOTES["no_rules"])
        made = scoring.run(sittings, asked, baseline, progress, len(numbers))
        whom = f"{people} virtual, number {numbers[0]} to {numbers[-1]} of the population of seed {seed}"
        made |= {
            "heading": "The paper's real-time protocol, SIMULATED",
            "simulated": True,
            "left": [],
            "people_text": whom,
            "rules_text": tuned,
            "aims": scoring.aims(made),
            "counted": [NOTES[key] for key in ("answered", "onset_virtual", "likelihood")],
        }
    result = _with_notes(made, bundle, engine)
    if place is not None:
        with nullcontext() if dataset is None else as_dataset(dataset).generation.writing():
            result["files"] = _write(result, place)
    return result


def live_protocol(
    bundle: Bundle,
    sittings: Sequence[Sitting],
    *,
    engine: str = "float",
    tune_on: Dataset | None = None,
    simulated: bool = False,
    out: str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
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
    made = scoring.run(sittings, integer_model(bundle) if engine == "int8" else bundle, baseline)
    result = _with_notes(
        made
        | {
            "heading": f"The paper's real-time protocol, led live{', SIMULATED' if simulated else ''}",
            "simulated": simulated,
            "codes": people,
            "left": [],
            "people_text": ", ".join(people),
            "rules_text": tuned,
            "aims": [],
            "counted": [NOTES[key] for key in ("answered", "onset_live", "likelihood", *noted)],
        },
        bundle,
        engine,
    )
    if place is not None:
        result["files"] = _write(result, place)
    return result


def _recorded(
    dataset: Dataset,
    bundle: Bundle,
    asked: Any,
    subjects: Sequence[str] | None,
    rules: bool,
    progress: Progress | None,
) -> dict[str, Any]:
    """Run the protocol on recorded sessions and return the result."""
    if not dataset.layout.reads_as(bundle.layout):
        raise ConfigError(
            f"'{dataset.head.name}' was recorded with layout '{dataset.layout.name}', but the network reads "
            f"'{bundle.layout.name}': take a network that was made for it."
        )
    people = recorded_people(dataset, subjects, bundle.provenance)
    sittings, left = recorded_sittings(dataset, people, bundle.gestures)
    baseline, tuned = recorded_rules(dataset, bundle.gestures, people) if rules else (None, NOTES["no_rules"])
    made = scoring.run(sittings, asked, baseline, progress, len(sittings))
    virtual = dataset.head.simulated
    source = "recorded sessions of a simulation" if virtual else "recorded sessions"
    return made | {
        "heading": f"The paper's real-time protocol on {source}: {dataset.head.name}",
        "simulated": virtual,
        "codes": people,
        "left": left,
        "people_text": f"{len({s.who.partition(',')[0] for s in sittings})} of {len(dataset.subjects)}: "
        + ", ".join(s.who for s in sittings),
        "rules_text": tuned,
        "aims": [],
        "counted": [NOTES[key] for key in ("answered", "onset_recorded", "likelihood")],
    }


def _with_notes(made: dict[str, Any], bundle: Bundle, engine: str) -> dict[str, Any]:
    """Return the result with ``about``, rows on network and settings, and ``said``, notes on their limits."""
    settings = DecideSpec.from_dict(bundle.decision)
    provenance = bundle.provenance
    notes = []
    if not settings.gate.rules:
        notes.append(NOTES["no_gate"])
    ruled = any(row["system"] == "rules" for row in made["systems"])
    tuned = made.pop("rules_text")
    if not ruled:
        notes.append(tuned)
    if not bundle.gestures.has_affect:
        notes.append(NOTES["no_affect"])
    if not settings.fitted:
        notes.append(NOTES["not_fitted"])
    known = known_people(provenance)
    if not known:
        notes.append(NOTES["unknown_people"])
    known |= {bundle.adapted_to} if bundle.adapted_to is not None else set()
    met = sorted(known & set(made.pop("codes", ())))
    if met:
        notes.append(
            f"This bundle was trained on, or adapted to, people of the codes {', '.join(met)}: if they are the same "
            "people, their figures flatter."
        )
    if provenance.get("simulated") is True and not made["simulated"]:
        notes.append(NOTES["trained_virtual"])
    notes += [f"{entry['who']} {entry['why']}, and was left out." for entry in made["left"]]
    filters, span_s = slashed(bundle.arch.filters), bundle.arch.span / bundle.layout.rate_hz
    subjects = provenance.get("subjects", ())
    who = subjects if isinstance(subjects, int) else len(set(subjects) - {NOBODY})
    trained = f"{provenance['dataset']}, {who} people" if provenance.get("dataset") else "unknown to the bundle"
    times = [o["repetition"] for o in made["outcomes"]]
    about = [
        ["People", made.pop("people_text")],
        ["Trials", f"{made['trials']}: {made['gestures']} gestures, up to {max(times, default=0)} times each a person"],
        ["Network", f"{bundle.arch.symbol}, filters {filters}, {bundle.arch.padding}; span {span_s:.2f} s"],
        ["Trained on", trained],
        ["Arithmetic", "8 bits, the toy's own" if engine == "int8" else "floating point"],
        ["Gate", {0: "none", 1: "1 rule"}.get(len(settings.gate.rules), f"{len(settings.gate.rules)} rules")],
        ["Event settings", "fitted" if settings.fitted else "defaults, not fitted"],
    ]
    if ruled:
        about.append(["Rule baseline", tuned])
    return made | {"said": notes, "about": about, "engine": engine}


def _place(out: Path) -> Path:
    """Check that the output folder is new, empty, or holds the results of an earlier protocol; return it."""
    check_folder(out, "A protocol")
    if out.is_dir() and any(out.iterdir()) and not (out / RESULT).is_file():
        raise ConfigError(f"'{out}' holds something that is not a protocol: give a new or empty folder.")
    return out


def _write(result: dict[str, Any], out: Path) -> list[str]:
    from plushsense.experiments.protocol.report import figure_table, page
    from plushsense.reports.page import write_page
    from plushsense.reports.table import Table

    html = page(result)  # before any file, as it may lack an extra
    out.mkdir(parents=True, exist_ok=True)
    trials = Table.from_rows("trials", "Every trial by each system", result["outcomes"])
    write_file(out / TRIALS, trials.csv({"simulated": "yes" if result["simulated"] else "no"}))
    write_file(out / TABLE, figure_table(result).csv())
    write_page(out / PAGE, html)
    write_file(out / RESULT, json.dumps(result, ensure_ascii=False, indent=1, allow_nan=False) + "\n")
    return [str(out / name) for name in (PAGE, TABLE, TRIALS, RESULT)]
