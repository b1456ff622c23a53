"""Compare the search with the whole grid: does it find the same network for a quarter of the cost?

    python bench/search.py DATASET [--epochs 60] [--rungs 4,15,60] [--split by-subject:3] [--seeds 3] [--workers 2]

The paper's 13 networks × 2 filter sets are trained by subject with the preset people: the whole grid with three seeds,
one search with the same three seeds, and for each seed one search with that seed alone. All trainings are kept in the
journal of the data set, so the program can be killed at any time and resumed. The grid is trained separately from the
searches and is scored at the rungs too, so that the two can be compared number by number, and other settings of the
search can be replayed without training.

F(n, s) is the macro-F1 of network n with seed s after all epochs, averaged over the folds. The best network of the grid
has the highest mean of F over the seeds, and the result of a search is scored by the same mean. The standard error is
that of such a mean, estimated from the spread of F over seeds, pooled over all networks. The verdict is on the search
with all seeds, which has the same data, folds and seeds as the grid and a quarter of its cost. The grid's best is the
highest of 26 noisy means, so its score, and thus the gap, is too large rather than too small. The searches with one
seed are reported too; they lack two thirds of the information of the grid. For them there is also an unbiased gap: the
network that the whole grid would choose with that seed against the one that the search chose, both scored with the
other seeds. All scores are on people who took no part in the training of that fold, but who did influence the choice of
the network, in the grid as in the search.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars
from numpy.typing import NDArray

import plushsense as ps
from plushsense.cli.sweep import report_search
from plushsense.core.errors import PlushSenseError
from plushsense.experiments.search.halving import Costs, Rung, Scores, SearchSpec, halving
from plushsense.experiments.search.run import prepare, search
from plushsense.experiments.sweep.run import Sweep, sweep
from plushsense.models.arch import PAPER_ARCHITECTURES
from plushsense.experiments.sweep.grid import GridSpec

FILTERS = "4/6/8/8,8/12/16/16"
# Other settings, replayed where the grid was scored at their rungs: rungs as (first, second), eta, folds.
OTHERS: tuple[tuple[tuple[int, ...], float, tuple[int, ...]], ...] = (
    ((4, 15), 3.0, ()),
    ((4, 15), 2.0, (1, 3)),
    ((4, 30), 2.0, ()),
    ((8, 30), 2.0, ()),
    ((8,), 2.0, ()),
    ((4,), 2.0, ()),
    ((15,), 2.0, (1,)),
)
DRAWS = 20_000


def numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(","))


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Scored:
    """Macro-F1 of the whole grid by epochs: (networks, seeds, folds)."""

    def __init__(self, found: Sweep, names: list[tuple[str, str]], folds: list[str], seeds: int) -> None:
        runs = polars.read_parquet(found.out / "runs.parquet")
        self.by_epochs: dict[int, NDArray[np.float64]] = {}
        for epochs in sorted(runs["epochs"].unique()):
            table = np.full((len(names), seeds, len(folds)), np.nan)
            for row in runs.filter(polars.col("epochs") == epochs).iter_rows(named=True):
                at = names.index((row["arch"], row["filters"])), row["seed"], folds.index(row["fold"])
                table[at] = row["macro_f1"]
            self.by_epochs[int(epochs)] = table
        self.seconds = {
            int(seed): float(s) for seed, s in runs.group_by("seed").agg(polars.col("seconds").sum()).rows()
        }

    def replay(self, costs: Costs, seeds: list[int]) -> tuple[int, float]:
        """Return what a search with some of the seeds would have chosen, and its share of the grid's cost."""

        def score(rung: Rung) -> Scores:
            found = self.by_epochs[rung.epochs][list(rung.entered)][:, seeds, : rung.folds]
            scores: Scores = found.reshape(len(found), -1)
            return scores

        done = halving(costs, score)
        return done.best, done.spent / done.whole


def compare(final: NDArray[np.float64], joint: int, chosen: list[int]) -> dict[str, Any]:
    """Compare ``final`` F1 (networks, seeds), ``joint`` chosen with all seeds and ``chosen`` with each alone."""
    seeds = final.shape[1]
    means = final.mean(axis=1)
    best = int(means.argmax())
    pooled = math.sqrt(float(final.var(axis=1, ddof=1).mean()) / seeds)
    gaps = [float(means[best] - means[network]) for network in chosen]
    fair = []
    for seed, network in enumerate(chosen):
        others = [s for s in range(seeds) if s != seed]
        fair.append(float((final[int(final[:, seed].argmax())] - final[network])[others].mean()))
    return {
        "best": best,
        "best_mean": float(means[best]),
        "standard_error": pooled,
        "standard_error_of_best": float(final[best].std(ddof=1)) / math.sqrt(seeds),
        "gap": float(means[best] - means[joint]),
        "rank": int((means > means[joint]).sum()) + 1,
        "single_gaps": gaps,
        "single_gap": float(np.mean(gaps)),
        "single_ranks": [int((means > means[network]).sum()) + 1 for network in chosen],
        # The loss from choosing with one seed, even after the whole grid.
        "single_gap_of_grid": float(np.mean([means[best] - means[int(of.argmax())] for of in final.T])),
        "fair_gaps": fair,
        "fair_gap": float(np.mean(fair)),
    }


def by_chance(final: NDArray[np.float64], cost: NDArray[np.float64], share: float) -> float:
    """Return the mean gap of training networks drawn at random to the end within a share of the cost."""
    random, gaps, means = np.random.default_rng(0), [], final.mean(axis=1)
    for _ in range(DRAWS):
        order = random.permutation(len(cost))
        taken = order[np.cumsum(cost[order]) <= share * cost.sum()]
        if len(taken):
            gaps.append(means.max() - means[taken].max())
    return float(np.mean(gaps)) if gaps else float("nan")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--rungs", type=numbers, default=(4, 15, 60))
    parser.add_argument("--at", type=numbers, default=(8, 30), help="score the grid there too, for replays")
    parser.add_argument("--split", default="by-subject:3")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--share", type=float, default=0.25)
    parser.add_argument("--eta", type=float, default=2.0)
    parser.add_argument("--architectures", default=",".join(PAPER_ARCHITECTURES))
    parser.add_argument("--filters", default=FILTERS)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--out", help="JSON of all figures (default: DATASET/evaluations/search-proof.json)")
    args = parser.parse_args()
    if args.seeds < 2:
        parser.error("--seeds is at least 2: a standard error over seeds needs two")
    try:
        return prove(args)
    except PlushSenseError as refusal:
        say(f"bench/search.py: {refusal}")
        return 2


def prove(args: argparse.Namespace) -> int:
    dataset, last = ps.open_dataset(args.dataset), args.rungs[-1]
    grid = GridSpec(
        name="proof", batches=(64,), seeds=(0,), split=args.split, preset="people", padding="stream",
        context="stream", classes="shared",
    )  # fmt: skip
    changes = {"architectures": args.architectures, "filters": args.filters}
    limits = {"rungs": args.rungs, "share": args.share, "eta": args.eta}
    ready = prepare(dataset, grid, {**changes, **limits})
    names = [(p.trial.arch.symbol, "/".join(map(str, p.trial.arch.filters))) for p in ready.plans[-1].trials]
    labels = [f"{arch} {filters}" for arch, filters in names]

    every = tuple(range(args.seeds))
    began, searches = time.monotonic(), []
    for seeds in (every, *((seed,) for seed in every)):
        say(f"search with {'seed' if len(seeds) == 1 else 'seeds'} {', '.join(map(str, seeds))}")
        found = search(dataset, grid, **limits, **changes, seeds=seeds, workers=args.workers, progress=report_search())
        searches.append(found.summary)
    say(f"searches: {time.monotonic() - began:.0f} s; now the grid")
    at = tuple(sorted({*args.rungs, *(e for e in args.at if e < last)}))
    swept = sweep(
        dataset, grid, **changes, epochs=at, seeds=every, workers=args.workers, display=True,
    )  # fmt: skip
    if swept.summary["done"] < swept.summary["trials"]:
        say(f"{swept.summary['trials'] - swept.summary['done']} trials of the grid failed: no comparison.")
        return 1
    folds = [run.fold for run in ready.plans[-1].trials[0].runs]
    scored = Scored(swept, names, folds, args.seeds)
    final = scored.by_epochs[last].mean(axis=2)

    joint, *chosen = [names.index((s["winner"]["arch"], s["winner"]["filters"])) for s in searches]
    found_of = compare(final, joint, chosen)
    # Compare every score of a search with the grid's own uninterrupted training.
    apart = 0.0
    for seeds, s in zip((list(every), *([seed] for seed in every)), searches, strict=True):
        for rung in s["rungs"]:
            table = scored.by_epochs[rung["epochs"]][:, seeds].mean(axis=(1, 2))
            for row in (n for n in rung["networks"] if n["macro_f1"] is not None):
                apart = max(apart, abs(table[names.index((row["arch"], row["filters"]))] - row["macro_f1"]))
    shares = [s["cost"]["share"] for s in searches]
    seconds = [
        s["cost"]["training_seconds"] / sum(scored.seconds[seed] for seed in seeds)
        for seeds, s in zip((every, *((seed,) for seed in every)), searches, strict=True)
    ]
    chance = by_chance(final, ready.costs.until[:, -1], args.share)

    mark = " (SIMULATION)" * dataset.head.simulated
    print(
        f"{ready.grid.split}, {len(names)} networks, {last} epochs, {args.seeds} seeds, data set {dataset.head.name}"
        f"{mark}: macro-F1, mean over seeds (each seed: mean over folds)"
    )
    order = np.argsort(-final.mean(axis=1))
    for rank, n in enumerate(order, 1):
        marks = ["search with all seeds"] * int(n == joint)
        marks += [f"search with seed {seed}" for seed, network in enumerate(chosen) if network == n]
        each = " ".join(f"{value:.4f}" for value in final[n])
        print(f"  {rank:2} {labels[n]:34} {final[n].mean():.4f}  ({each})  {', '.join(marks)}")
    print("replayed from the grid's scores, the searches with all seeds, and with one (mean of them):")
    replays = []
    for rungs, eta, folds in ((args.rungs[:-1], args.eta, ()), *OTHERS):
        replayed = _replayed(args, ready.costs, scored, final, (*rungs, last), eta, folds)
        if replayed is not None:
            replays.append(replayed)
            print(
                "  rungs {rungs}, eta {eta:g}, folds {folds}: gap {gap:.4f}, one seed {single:.4f}, "
                "share {share:.3f}".format(**replayed)
            )
    print(f"networks at random, trained to the end for the same cost: gap {chance:.4f} on average")
    print(f"scores of the searches against the grid's own trainings: {apart:.1e} apart at most")
    if dataset.head.simulated:
        print("SIMULATION: these scores are of the virtual toy and say nothing about a real one.")
    reached = found_of["gap"] <= found_of["standard_error"] and max(shares) <= args.share + 1e-9
    figures = {
        "reached": reached, "names": labels, "final": final.tolist(), "joint": joint, "chosen": chosen, **found_of,
        "shares": shares, "seconds_shares": seconds, "gap_by_chance": chance, "apart": apart, "replays": replays,
        "search": ready.spec.to_dict(), "grid": ready.grid.to_dict(), "machine": swept.summary["machine"],
        "dataset": dataset.head.name, "dataset_hash": dataset.hash, "simulated": dataset.head.simulated,
    }  # fmt: skip
    out = Path(args.out) if args.out else dataset.path / "evaluations" / "search-proof.json"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(figures, indent=1), encoding="utf-8")
    f = found_of
    print(
        f"VERDICT {'reached' if reached else 'NOT reached'}: the search with all {args.seeds} seeds found "
        f"{labels[joint]} (rank {f['rank']} of {len(names)}), {f['gap']:.4f} below the grid's best {labels[f['best']]} "
        f"{f['best_mean']:.4f}, one standard error {f['standard_error']:.4f} (of the best alone "
        f"{f['standard_error_of_best']:.4f}), for {shares[0]:.1%} of the grid's multiply-accumulates and "
        f"{seconds[0]:.1%} of its seconds of training; networks drawn at random for that cost: {chance:.4f} below. "
        f"With one seed each (ranks {', '.join(map(str, f['single_ranks']))}): {f['single_gap']:.4f} below on average, "
        f"where the whole grid with one seed is {f['single_gap_of_grid']:.4f} below; judged by the other seeds, search "
        f"below grid by {f['fair_gap']:+.4f}; share at most {max(shares):.1%}, in seconds {max(seconds):.1%}"
    )
    return 0 if reached else 1


def _replayed(
    args: argparse.Namespace,
    costs: Costs,
    scored: Scored,
    final: NDArray[np.float64],
    rungs: tuple[int, ...],
    eta: float,
    folds: tuple[int, ...],
) -> dict[str, Any] | None:
    """Replay other settings of the search; None where the grid was not scored for them or the share is too small."""
    spec = replace(SearchSpec(), rungs=rungs, eta=eta, folds=folds, share=args.share)
    if any(rung not in scored.by_epochs for rung in rungs) or any(f > costs.epoch.shape[1] for f in folds):
        return None
    try:
        whole, share = scored.replay(Costs(costs.epoch, spec, args.seeds), list(range(args.seeds)))
        found = [scored.replay(Costs(costs.epoch, spec), [seed]) for seed in range(args.seeds)]
    except PlushSenseError:
        return None
    means = final.mean(axis=1)
    single = float(np.mean([means.max() - means[network] for network, _ in found]))
    settings = {"rungs": list(rungs), "eta": eta, "folds": list(folds) or "all"}
    return {**settings, "gap": float(means.max() - means[whole]), "single": single, "share": share}


if __name__ == "__main__":
    sys.exit(main())
