"""Implement ``plushsense stream-eval DATASET|FOLDER`` with --model, --predictions or --split, and ``protocol``."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plushsense.cli.options import options
from plushsense.cli.output import emit, figure, say, table, warn
from plushsense.cli.settings import listed, marks, report_jobs, settings
from plushsense.core.errors import ConfigError
from plushsense.core.sentences import plural
from plushsense.jobs.progress import ProgressReporter

if TYPE_CHECKING:
    from plushsense.experiments.protocol.score import ProtocolResult
    from plushsense.experiments.streams.benchmark import PredictionsResult, StreamEvalResult
    from plushsense.experiments.streams.score import BenchmarkResult


def run_stream_eval(args: argparse.Namespace) -> int:
    if args.model is None and args.predictions is None and args.split is None:
        raise ConfigError(
            "Give either --model BUNDLE, to replay streams through it, or --predictions FILE.csv, to score another "
            "system, or --split by-subject:5, to compare systems."
        )
    if not 0.0 <= args.late <= 10.0:
        raise ConfigError(f"--late is {args.late:g}: accepted are 0 to 10 seconds.")
    if args.threshold is not None and args.predictions is None:
        raise ConfigError("--threshold belongs to --predictions: leave it out.")
    if args.events is not None and args.model is None:
        raise ConfigError("--events belongs to --model: leave it out.")
    if args.split is not None:
        return _run_split(args)
    if args.out or args.systems:
        raise ConfigError("--out and --systems belong to --split: leave them out, or give --split.")
    from plushsense.experiments.streams.benchmark import score_predictions, stream_eval

    people: dict[str, Any] = {"subjects": None if args.subjects is None else listed(args.subjects)}
    people |= {"late_s": args.late, "labels": args.labels == "use", "warn": warn}
    scored: PredictionsResult | StreamEvalResult
    if args.model is not None:
        scored = stream_eval(args.source, args.model, events=args.events, **people)
    else:
        classes, threshold = settings(args).evaluation.classes, args.threshold or 0.0
        scored = score_predictions(args.source, args.predictions, classes=classes, threshold=threshold, **people)
    result = scored.to_json()
    emit(args, result, _format_scores(result))
    return 0


def _run_split(args: argparse.Namespace) -> int:
    from plushsense.experiments.streams.benchmark import PAGE, BenchmarkSpec, stream_benchmark

    if args.subjects:
        raise ConfigError("--subjects belongs to --model and --predictions: a split scores all people.")
    config = settings(args, workers=args.workers)
    result = stream_benchmark(
        args.source,
        config,
        BenchmarkSpec(
            args.split,
            None if args.systems is None else listed(args.systems),
            args.late,
            args.labels == "use",
        ),
        out=args.out,
        overwrite=args.force,
        progress=report_jobs("streams"),
        warn=warn,
    )
    if args.out:
        say(f"written: {Path(args.out) / PAGE}")
    emit(args, {**vars(result), **({"out": args.out} if args.out else {})}, _format_systems(result))
    return 0


_number = partial(figure, digits=2)


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"


_COUNTS = ("truths", "hits", "deleted", "events", "false", "fragmented", "merged")
_HEAD = (*_COUNTS, "recall", "F1", "false/h", "median s", "90 % s")


def _row(s: dict[str, Any]) -> tuple[object, ...]:
    late = s["latency_s"]
    return (
        *(s[k] for k in ("truths", "hits", "deletions", "events", "insertions", "fragmentations", "merges")),
        _number(s["recall"]),
        _number(s["f1"]),
        _rate(s.get("false_events_per_hour")),
        _number(late["median"]),
        _number(late["p90"]),
    )


def _marks(result: dict[str, Any]) -> list[str]:
    return [*marks({**result, "leaky": False}), ""] if result["simulated"] else []


def _format_scores(result: dict[str, Any]) -> list[str]:
    """Format the scores of one system as text: a table by person and one by gesture, then false events."""
    trained_on = result.get("trained_on", [])
    people = [
        (person + (" TRAINED ON" if person in trained_on else ""), *_row(row))
        for person, row in result["people"].items()
    ]
    curve = [
        (f"{p['threshold']:.3g}", _number(p["recall"]), _number(p["f1"]), _rate(p["false_events_per_hour"]))
        for p in result.get("curve", [])
    ]
    gestures = [(label, *_row(row)) for label, row in result["per_class"].items()]
    place = result["outside"]
    labels = [
        f"{plural(result['practised'], 'event')} named a gesture that was being practised: right, but no hits",
        f"where a recording or a label says what happened ({result['known_hours']:.2f} h): "
        f"{_rate(result['false_events_per_known_hour'])} false events an hour",
    ]
    return [
        *_marks(result),
        table(("person", *_HEAD), [*people, ("all", *_row(result))]),
        "",
        table(("gesture", *_HEAD), gestures),
        "",
        *([table(("threshold", "recall", "F1", "false/h"), curve), ""] if curve else []),
        f"{result['hours']:.2f} h of streams, {result['uncovered_hours']:.2f} h outside of any true gesture",
        f"false events: {result['confused']} within another gesture; outside {place['all']}, of these "
        f"{place['rest']} at rest ({_rate(result['at_rest_per_hour'])} an hour), {place['other']} in gestures that are "
        f"not among the classes, {place['handling']} while the toy was handled",
        *(labels if result["labelled_stretches"] else []),
        f"outside of true gestures {_rate(result['outside_per_uncovered_hour'])} an hour",
        result["note"],
        *([f"TRAINED ON {', '.join(trained_on)}: no result"] if trained_on else []),
    ]


def _format_systems(result: BenchmarkResult) -> list[str]:
    """Format the scores of the systems as text: a row for each setting, then false events at equal recall."""
    from plushsense.experiments.streams.benchmark_page import SETTINGS

    rows = [
        (system["title"], how, *_row(system[how]))
        for system in result.systems.values()
        for how in SETTINGS
        if how in system
    ]
    names = list(result.systems)
    equal = []
    for row in result.at_recall:
        cells = [f"{row['recall']:.2f}"]
        for name in names:
            cell = row["systems"][name]
            ratio = "" if cell["ratio"] is None or name == result.reference else f" (x {cell['ratio']:.2f})"
            cells.append(_rate(cell["false_events_per_hour"]) + ratio)
        equal.append(cells)
    return [
        *_marks(vars(result)),
        f"split {result.split}, {plural(len(result.subjects), 'person')} left out in turn, seed {result.seed}",
        "",
        table(("system", "setting", *_HEAD), rows),
        "",
        *(f"{how}: {words}" for how, words in SETTINGS.items()),
        "",
        *(["false events an hour at equal recall:", "", table(("recall", *names), equal), ""] if equal else []),
        result.note,
    ]


def run_protocol(args: argparse.Namespace) -> int:
    from plushsense.experiments.protocol.run_protocol import VirtualPeople, protocol

    virtual = options(args, "people", "first", "seed", "repetitions")
    virtual = {name: value for name, value in virtual.items() if value is not None}
    if virtual and (args.dataset or args.session):
        raise ConfigError(f"--{next(iter(virtual))} is for virtual people: leave it out, or --dataset and --session.")
    reporter = ProgressReporter("people")
    result = protocol(
        args.model,
        virtual=VirtualPeople(**virtual),
        **options(args, "dataset", "session", "engine", "out"),
        subjects=listed(args.subjects) if args.subjects else None,
        rules=not args.no_rules,
        progress=lambda at: reporter(at.done, at.total),
    )
    emit(args, result.to_json(), _protocol_lines(result))
    return 0


def _protocol_lines(result: ProtocolResult) -> list[str]:
    """Format the outcome of the protocol as text: the table and the notes."""
    from plushsense.experiments.protocol.protocol_page import SIMULATION, between_table, group_table

    out = [result.heading, *([SIMULATION] if result.simulated else [])]
    out += [f"{name}: {value}" for name, value in result.about]
    out += ["", group_table(result).text(), ""]
    out += [
        f"{row['system']}, {row['minutes']} minutes between the gestures: {row['positive']} positive and "
        f"{row['negative']} negative events, {row['none']} without affect: {row['reactions']} an hour"
        for row in between_table(result).rows
    ]
    out += ["", *result.said]
    return [*out, f"written: {result.files[0]}"] if result.files else out
