"""Reproduce the tables of docs/streams.md on whole streams of people left out, with one resumable command.

    plushsense import ../shared/data/makeability-gestures DS --layout accel-3
    plushsense trim DS --accept-above 0.5 --who K
    python bench/streams.py DS                          # every row, seeds 0 to 2
    python bench/streams.py DS --rows easy,feedback --seeds 0

On two cores, the row ``easy`` takes 14 minutes for three seeds; others of one training take about as long.
A seed decides both the folds by person and the training. Finished folds and networks are kept in DS/cache, so that the
same command resumes. The row ``feedback`` simulates three corrections ("that was wrong") of a gesture: the first three
false events of a person's stream that name it are marked, the network is corrected (`plushsense.live.feedback`), and
the rest of the stream is read again. Besides the same settings before and after, that row compares at equal recall: of
all values of ``enter`` and of the settings themselves, those with the fewest false events that find at least as many
gestures as the network did before the correction.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import dataclass, field, replace
from statistics import fmean, stdev
from typing import Any

import numpy as np

import plushsense as ps
from plushsense.dataset.files import CACHE
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.replay import StreamTrace, counted_events, gesture_intervals, read_streams
from plushsense.experiments.streams.run import TrainStreams, recipes_for, stream_benchmark
from plushsense.experiments.streams.score import CHOICES, PeopleFold
from plushsense.experiments.streams.systems import ANYWHERE, ENTERS
from plushsense.live.feedback import correct, correction_of
from plushsense.models.bundle import Bundle
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.trace import ReportedEvent
from plushsense.scoring.events import overlaps
from plushsense.workflow.config import RunConfig, from_settings
from plushsense.workflow.preparation import network_inputs_of

RECALLS = (0.3, 0.4, 0.5, 0.6, 0.7)
MARKS = 3


@dataclass(frozen=True)
class Row:
    """A row: the system of the benchmark, and the settings of its training."""

    title: str
    system: str = ANYWHERE
    pool_s: float | None = None
    anywhere: dict[str, float] = field(default_factory=dict)


ROWS = {
    "windows": Row("gestures only, smoothed argmax", system="smoothed"),
    "windows-hysteresis": Row("gestures only, hysteresis", system="hysteresis"),
    "smoothed": Row("anywhere, smoothed argmax", system="anywhere-smoothed"),
    "easy": Row("anywhere, hysteresis"),
    "hard": Row("anywhere, hysteresis, hard negatives", anywhere={"hard_share": 0.15}),
    "pool-0.8": Row("anywhere, hysteresis, pool 0.8 s", pool_s=0.8),
    "pool-0.5": Row("anywhere, hysteresis, pool 0.5 s", pool_s=0.5),
}
FEEDBACK = "feedback"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DS")
    parser.add_argument("--rows", default=",".join([*ROWS, FEEDBACK]), help="rows to compute, joined by commas")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--workers", type=int, default=0, help="folds in parallel (default: one per processor)")
    parser.add_argument("--json", action="store_true", help="one JSON object: of each row the result of each seed")
    args = parser.parse_args()
    dataset = ps.open_dataset(args.dataset)
    seeds = [int(seed) for seed in args.seeds.split(",")]
    chosen = args.rows.split(",")
    if unknown := [name for name in chosen if name not in ROWS and name != FEEDBACK]:
        parser.error(f"there is no row {', '.join(unknown)}: accepted are {', '.join([*ROWS, FEEDBACK])}")
    if args.json and FEEDBACK in chosen:
        parser.error(f"the row {FEEDBACK} has no --json: leave it out of --rows")
    table: dict[str, Any] = {}
    for name in chosen:
        if name != FEEDBACK:
            results = [benchmark(dataset, ROWS[name], seed, args.workers) for seed in seeds]
            table[name] = [figures(ROWS[name], result) for result in results]
            if not args.json:
                print(line(name, ROWS[name], results), flush=True)
    if args.json:
        print(json.dumps({"seeds": seeds, "rows": table}))
    elif FEEDBACK in chosen:
        for how in ("balanced", "cheapest"):
            for line_of in feedback(dataset, seeds, how, args.workers):
                print(line_of, flush=True)


def config_of(row: Row, seed: int) -> RunConfig:
    config = from_settings(seed=seed)
    return replace(config, anywhere=replace(config.anywhere, **row.anywhere))


def benchmark(dataset: Dataset, row: Row, seed: int, workers: int) -> dict[str, Any]:
    config = config_of(row, seed)
    config = replace(config, evaluation=replace(config.evaluation, workers=workers))
    # The reference is needed for the interpolation at equal recall.
    systems = list(dict.fromkeys(["smoothed", row.system]))
    return stream_benchmark(dataset, config, systems=systems, anywhere_pool_s=row.pool_s)


def figures(row: Row, result: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a row with one seed: false events per hour at each recall, and each choice of settings."""
    at = {f"{r['recall']:g}": r["systems"][row.system]["false_events_per_hour"] for r in result["at_recall"]}
    scores = result["systems"][row.system]
    keys = ("recall", "f1", "false_events_per_hour", "latency_s", "fragmentations", "merges")
    return {"at_recall": at, "choices": {how: {key: scores[how][key] for key in keys} for how in CHOICES}}


def spread(values: list[float | None], digits: int) -> str:
    real = [v for v in values if v is not None]
    if not real or len(real) < len(values):
        return "–"
    return f"{fmean(real):.{digits}f}" + (f" ± {stdev(real):.{digits}f}" if len(real) > 1 else "")


def line(name: str, row: Row, results: list[dict[str, Any]]) -> str:
    at: dict[float, list[float | None]] = {r["recall"]: [] for r in results[0]["at_recall"]}
    for result in results:
        for found in result["at_recall"]:
            at[found["recall"]].append(found["systems"][row.system]["false_events_per_hour"])
    parts = [
        f"{name}: {row.title}",
        "  false an hour at recall " + ", ".join(f"{r}: {spread(at[r], 0)}" for r in RECALLS),
    ]
    for how in CHOICES:
        scores = [result["systems"][row.system][how] for result in results]
        values = {k: spread([s[k] for s in scores], 2) for k in ("recall", "f1")}
        false = spread([s["false_events_per_hour"] for s in scores], 0)
        latency = {k: spread([s["latency_s"][k] for s in scores], 2) for k in ("median", "p90")}
        broken = {k: spread([s[k] for s in scores], 0) for k in ("fragmentations", "merges")}
        parts.append(
            f"  {how:9} recall {values['recall']}, F1 {values['f1']}, false an hour {false}, "
            f"median {latency['median']} s, 90 % {latency['p90']} s, "
            f"fragmented {broken['fragmentations']}, merged {broken['merges']}"
        )
    return "\n".join(parts)


@dataclass
class Change:
    """Counts on the rest of a stream, before and after: false events of the gesture, all false events, hits.

    ``equal_kind`` and ``equal_false`` are the false events at equal recall.
    """

    kind: tuple[int, int] = (0, 0)
    false: tuple[int, int] = (0, 0)
    hits: tuple[int, int] = (0, 0)
    equal_kind: tuple[int, int] = (0, 0)
    equal_false: tuple[int, int] = (0, 0)
    truths: int = 0

    def add(self, other: Change) -> None:
        for name in ("kind", "false", "hits", "equal_kind", "equal_false"):
            one, two = getattr(self, name), getattr(other, name)
            setattr(self, name, (one[0] + two[0], one[1] + two[1]))
        self.truths += other.truths


def feedback(dataset: Dataset, seeds: list[int], how: str, workers: int) -> list[str]:
    """Return lines on the corrections of all people left out, with the settings chosen by ``how``."""
    people: dict[str, Change] = defaultdict(Change)
    whole, cases, refused = Change(), 0, 0
    for seed in seeds:
        row = ROWS["easy"]
        result = benchmark(dataset, row, seed, workers)
        read, config = network_inputs_of(dataset, config_of(row, seed))
        recipes = recipes_for(read, config, {ANYWHERE}, None)
        train = TrainStreams(recipes, False, dataset.path / CACHE / "stream-networks")
        for fold in result["folds"]:
            parts = PeopleFold(fold["name"], *(tuple(fold[k]) for k in ("train", "validation", "test")))
            bundle = train(read, parts, lambda *_: None).networks[ANYWHERE]
            spec = DecideSpec.from_dict(fold["settings"][ANYWHERE][how]["spec"])
            bundle = replace(bundle, decision=spec.to_dict())
            for person in parts.test:
                for stream in read_streams(read, bundle, [person]):
                    for change in corrected(read, bundle, spec, stream):
                        cases += 1
                        if change is None:
                            refused += 1
                            continue
                        people[person].add(change)
                        whole.add(change)
    recalls = [(c.hits[1] - c.hits[0]) / c.truths for c in people.values() if c.truths]
    worse = {p: c.equal_false[1] / c.equal_false[0] - 1 for p, c in people.items() if c.equal_false[0]}
    worst = max(worse, key=lambda p: worse[p])
    return [
        f"feedback, settings {how}: {cases} corrected gestures of {len(people)} people, {refused} refused",
        f"  false events of the gesture {whole.kind[0]} -> {whole.kind[1]}, all false events {whole.false[0]} -> "
        f"{whole.false[1]}, hits {whole.hits[0]} -> {whole.hits[1]} of {whole.truths}",
        f"  change of the recall by person: mean {fmean(recalls):+.3f}, worst {min(recalls):+.3f}",
        f"  at equal recall: false events of the gesture {whole.equal_kind[0]} -> {whole.equal_kind[1]}, all false "
        f"events {whole.equal_false[0]} -> {whole.equal_false[1]}; by person {fmean(worse.values()):+.1%}, "
        f"worst {worse[worst]:+.1%} ({people[worst].equal_false[0]} -> {people[worst].equal_false[1]})",
    ]


def corrected(dataset: Dataset, bundle: Bundle, spec: DecideSpec, before: StreamTrace) -> list[Change | None]:
    """Correct each gesture with more than `MARKS` false events in a stream; None where the correction is refused."""
    labels = bundle.gestures.labels
    events = counted_events(before.truth, before.replayer.events(spec))
    wrong = false_events(before, events, bundle)
    changes: list[Change | None] = []
    frames = dataset.read_stream(before.truth.stream)
    for label in sorted({labels[e.gesture] for e in wrong}):
        mine = sorted((e for e in wrong if labels[e.gesture] == label), key=lambda e: e.named_s)
        if len(mine) <= MARKS:
            continue
        marks = [correction_of(bundle, frames, e, subject=before.truth.subject) for e in mine[:MARKS]]
        done = correct(bundle, marks)
        if not done.accepted:
            changes.append(None)
            continue
        (after,) = (s for s in read_streams(dataset, done.bundle, [before.truth.subject])
                    if s.truth.stream == before.truth.stream)  # fmt: skip
        since = mine[MARKS - 1].stop_s
        one, other = (counts(s, spec, bundle, label, since) for s in (before, after))
        kind, false, hits, _ = zip(one, other, strict=True)
        equal = [fewest_false(s, spec, bundle, label, since, one[2]) for s in (before, after)]
        equal_kind, equal_false = zip(*equal, strict=True)
        changes.append(Change(kind, false, hits, equal_kind, equal_false, one[3]))
    return changes


def fewest_false(
    stream: StreamTrace, spec: DecideSpec, bundle: Bundle, label: str, since_s: float, hits: int
) -> tuple[int, int]:
    """Return the false events of a gesture, and all, of the best threshold that finds at least ``hits`` gestures.

    If no threshold finds as many, the one that finds most counts.
    """
    ratio = spec.leave / spec.enter if spec.enter else 1.0
    specs = [spec, *(replace(spec, enter=enter, leave=enter * ratio) for enter in ENTERS)]
    found = [counts(stream, each, bundle, label, since_s) for each in specs]
    least = min(hits, max(n[2] for n in found))
    best = min((n for n in found if n[2] >= least), key=lambda n: n[1])
    return best[0], best[1]


def false_events(stream: StreamTrace, events: list[ReportedEvent], bundle: Bundle) -> list[ReportedEvent]:
    """Return the events with a gesture that match no true gesture."""
    right = np.flatnonzero(matches(stream, events, bundle).any(axis=0)).tolist()
    return [e for n, e in enumerate(events) if n not in right and e.gesture < len(bundle.gestures)]


def matches(stream: StreamTrace, events: list[ReportedEvent], bundle: Bundle) -> np.ndarray[Any, np.dtype[np.bool_]]:
    intervals = gesture_intervals(events, bundle.gestures)
    labels = np.array([t.label for t in stream.truth.truths])[:, None]
    same: np.ndarray[Any, np.dtype[np.bool_]] = labels == np.array([i.label for i in intervals])[None]
    return overlaps(stream.truth.truths, intervals) & same


def counts(
    stream: StreamTrace, spec: DecideSpec, bundle: Bundle, label: str, since_s: float
) -> tuple[int, int, int, int]:
    """Count, after a time: false events of a gesture, all false events, hits and true gestures."""
    events = counted_events(stream.truth, stream.replayer.events(spec))
    wrong = [e for e in false_events(stream, events, bundle) if e.named_s > since_s]
    later = np.array([t.start_s > since_s for t in stream.truth.truths])
    hits = matches(stream, events, bundle).any(axis=1) & later
    kind = sum(bundle.gestures.labels[e.gesture] == label for e in wrong)
    return kind, len(wrong), int(hits.sum()), int(later.sum())


if __name__ == "__main__":
    main()
