"""Reproduce the tables of docs/streams.md on whole streams of people left out, with one resumable command.

    plushsense import ../shared/data/makeability-gestures DS --layout accel-3
    plushsense trim DS --accept-above 0.5 --who K
    python bench/streams.py DS                          # every row, seeds 0 to 2
    python bench/streams.py DS --rows easy,hard --seeds 0

On two cores, the row ``easy`` takes 14 minutes for three seeds; others of one training take about as long.
A seed decides both the folds by person and the training. Finished folds and networks are kept in DS/cache, so that the
same command resumes.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from statistics import fmean, stdev
from typing import Any

import plushsense as ps
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.benchmark import BenchmarkSpec, stream_benchmark
from plushsense.experiments.streams.score import CHOICES
from plushsense.experiments.streams.systems import ANYWHERE
from plushsense.workflow.config import from_settings

RECALLS = (0.3, 0.4, 0.5, 0.6, 0.7)


@dataclass(frozen=True)
class Row:
    """A row: the system of the benchmark, and the settings of its training."""

    title: str
    system: str = ANYWHERE
    pool_s: float | None = None


ROWS = {
    "windows": Row("gestures only, smoothed argmax", system="smoothed"),
    "windows-hysteresis": Row("gestures only, hysteresis", system="hysteresis"),
    "smoothed": Row("anywhere, smoothed argmax", system="anywhere-smoothed"),
    "easy": Row("anywhere, hysteresis"),
    "pool-0.8": Row("anywhere, hysteresis, pool 0.8 s", pool_s=0.8),
    "pool-0.5": Row("anywhere, hysteresis, pool 0.5 s", pool_s=0.5),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", metavar="DS")
    parser.add_argument("--rows", default=",".join(ROWS), help="rows to compute, joined by commas")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--workers", type=int, default=0, help="folds in parallel (default: one per processor)")
    parser.add_argument("--json", action="store_true", help="one JSON object: of each row the result of each seed")
    args = parser.parse_args()
    dataset = ps.open_dataset(args.dataset)
    seeds = [int(seed) for seed in args.seeds.split(",")]
    chosen = args.rows.split(",")
    if unknown := [name for name in chosen if name not in ROWS]:
        parser.error(f"there is no row {', '.join(unknown)}: accepted are {', '.join(ROWS)}")
    table: dict[str, Any] = {}
    for name in chosen:
        results = [benchmark(dataset, ROWS[name], seed, args.workers) for seed in seeds]
        table[name] = [figures(ROWS[name], result) for result in results]
        if not args.json:
            print(line(name, ROWS[name], results), flush=True)
    if args.json:
        print(json.dumps({"seeds": seeds, "rows": table}))


def benchmark(dataset: Dataset, row: Row, seed: int, workers: int) -> dict[str, Any]:
    config = from_settings(seed=seed)
    config = replace(config, evaluation=replace(config.evaluation, workers=workers))
    # The reference is needed for the interpolation at equal recall.
    systems = list(dict.fromkeys(["smoothed", row.system]))
    return stream_benchmark(dataset, config, BenchmarkSpec(systems=systems, anywhere_pool_s=row.pool_s))


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


if __name__ == "__main__":
    main()
