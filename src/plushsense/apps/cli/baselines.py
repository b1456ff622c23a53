"""``plushsense baselines DATASET --split leave-one-subject-out,windows:5``"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from plushsense.apps.cli.output import emit, say, table
from plushsense.apps.cli.settings import add_settings, add_work, listed, settings, warn


def add(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", metavar="DATASET", help="data set folder")
    parser.add_argument(
        "--split",
        default="leave-one-subject-out,windows:5",
        metavar="SPLIT,...",
        help="splits side by side (default: leave-one-subject-out,windows:5, the second leaky); as for evaluate",
    )
    parser.add_argument(
        "--models",
        default="all",
        metavar="NAME,...",
        help="all (default), classical, quick, or names: forest, extra-trees, knn, subspace-knn, cubic-svm, rbf-svm, "
        "tree, boosting, mlp, lstm, bilstm, network (ours, see --arch), minirocket, multirocket-hydra (extra rocket)",
    )
    parser.add_argument(
        "--features",
        default="statistics,flattened",
        metavar="NAME,...",
        help="what classical models read: statistics, 8 a channel, flattened, all samples, or both (default)",
    )
    parser.add_argument("--pca", default="both", help="for classical models: both (default), no or yes")
    add_work(parser, "folds")
    parser.add_argument(
        "--out",
        metavar="DIR",
        help="folder for baselines.json, .csv, .html and .png (default: one in DATASET/evaluations/ for each settings)",
    )
    parser.add_argument("--force", action="store_true", help="replace a comparison of other settings or data in --out")
    add_settings(parser)


def run(args: argparse.Namespace) -> int:
    from plushsense.apps.baselining import PAGE, baselines, comparison_id
    from plushsense.dataset.index import open_dataset

    config = settings(args, workers=args.workers)
    dataset = open_dataset(args.dataset)
    asked: dict[str, Any] = {"splits": listed(args.split), "models": listed(args.models)}
    asked |= {"features": listed(args.features), "pca": args.pca}
    name = f"baselines_{comparison_id(dataset, config, **asked)[:8]}"
    out = Path(args.out) if args.out else dataset.path / "evaluations" / name
    result = baselines(
        dataset, config, **asked, out=out, overwrite=args.force, cluster=args.cluster, progress=_shown(), warn=warn
    )
    result |= {"out": str(out), "report": str(out / PAGE)}
    say(f"written: {out}")
    emit(args, result, lines(result))
    return 0


def lines(result: dict[str, Any]) -> list[str]:
    """The table as text, a line a program, and what it means."""
    from plushsense.reports.baselines import COUNTS, LEAKY, SIMULATION, cost_words, headings, rows_of, said

    gap = ("gap",) if result["gaps"] else ()
    both = []
    for heading, split in zip(headings(result), result["splits"], strict=True):
        both += [f"accuracy, {heading}", "macro-F1 (leaky)" if split["leaky"] else "macro-F1"]
    head = ("program", "reads", *both, *gap, "size", "ms alone", "ms batch", "train s")
    rows = []
    for row in rows_of(result):
        scores = [text for s in row["scores"] for text in (s["accuracy"], s["macro_f1_mean"])]
        costs = [row[name] for name in ("size", "predict", "batch", "train")]
        rows.append((row["title"], row["reads"], *scores, *([row["gap"]] if gap else []), *costs))
    out = [SIMULATION, ""] if result["simulated"] else []
    out += [said(result), "", table(head, rows), "", cost_words(result)]
    if any(split["leaky"] for split in result["splits"]):
        out += ["", COUNTS if gap else LEAKY]
    return out


def _shown() -> Callable[[Any], None]:
    """Progress of a comparison: a line that is rewritten on a terminal, else one every few seconds."""
    import time

    rewritten = sys.stderr.isatty()
    began = last = time.monotonic()

    def show(at: Any) -> None:
        nonlocal last
        now = time.monotonic()
        fresh = at.done - at.resumed
        text = f"comparing: {at.done} of {at.jobs} fits" + (f" ({at.resumed} from before)" if at.resumed else "")
        if rewritten:
            sys.stderr.write(f"\r\x1b[K{text}: {at.what}" + ("\n" if at.done == at.jobs else ""))
            sys.stderr.flush()
        elif at.done == at.jobs or (fresh and now - last >= 10.0):
            last = now
            say(f"{text}, {now - began:.0f} s: {at.what}")

    return show
