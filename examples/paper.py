"""The table of the paper beside ours, from the paper's published archive.

    python examples/paper.py ARCHIVE [--subjects map.csv] [--out DIR] [--seeds 3] [--quick]

ARCHIVE is the folder as the authors' scripts leave it: a folder a gesture, files <label>_<7 digits>_<rows>.csv. Its
file names hold no person, so that the figures over people need a mapping (CSV: file,subject), if the authors have one.
Stopped, the same command goes on where it stood.

Untested on the original: nobody of this project had the archive. It was tried on one of the same form, of virtual
people.
"""

import argparse
import csv
import html
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import plushsense as ps
from plushsense.core.errors import PlushSenseError

UNTESTED = "Untested on the original archive: nobody of this project had it. Whoever runs this is the first."
LEAKY = "leaky: windows of one recording stand on both sides"
CHOSEN = ("14d1_39d2_41d4", (8, 12, 16))

# Table 4: architecture, filters, the highest accuracy on random test windows, in percent. The paper's is the best of
# nine schedules (3 lengths × 3 batches); ours is one: 250 epochs, batches of 64, which the paper names for 75.0 %.
TABLE4: list[tuple[str, tuple[int, ...], float]] = [
    ("14d1_39d2_41d4", (32, 48, 64), 79.0),
    ("19d1_24d3_19d9", (32, 48, 64), 77.1),
    ("28d1_32d2_41d4", (32, 48, 64), 77.1),
    ("14d1_39d2_41d4", (8, 12, 16), 75.0),
    ("19d1_24d3_19d9", (16, 24, 32), 74.1),
    ("28d1_32d2_41d4", (8, 12, 16), 73.6),
    ("19d1_19d2_19d4_17d8", (4, 6, 8, 8), 72.7),
    ("14d1_39d2_41d4", (16, 24, 32), 72.4),
    ("28d1_32d2_41d4", (16, 24, 32), 72.3),
    ("19d1_24d3_19d9", (8, 12, 16), 71.7),
    ("28d1_32d2_41d4", (4, 6, 8), 69.1),
    ("70_90_91", (4, 6, 8), 68.7),
]
# Section 4.4: the chosen network, leave one subject out over 25 people; mean and standard deviation over the folds.
LOSO = {"accuracy": (0.850, 0.072), "macro_recall": (0.717, 0.111), "macro_f1_all_classes": (0.687, 0.114)}
POOLED = {"accuracy": 0.847, "macro_recall": 0.691, "macro_f1": 0.701}
F1 = {
    "At rest": 0.984,
    "Head stroke 1": 0.892,
    "Neck scratch 1": 0.815,
    "Ear scratch 1": 0.791,
    "Tail tap 2": 0.606,
    "Tail scratch 2": 0.498,
    "Tail hit 2": 0.465,
}
# Section 4.5: 5 random folds over windows, in percent; not trained by this script.
BASELINES = {
    "random forest, 88 features": 95.9,
    "random forest, 88 features, PCA": 66.3,
    "cubic SVM, flattened windows": 90.4,
    "random forest, flattened windows": 89.7,
    "subspace kNN, flattened windows": 89.3,
}
SECTIONS = {"data": "3.2", "search": "4.2, Table 4", "loso": "4.4", "baselines": "4.5"}
MEASURES = {
    "accuracy": "accuracy",
    "macro_recall": "macro recall",
    "macro_f1": "macro-F1",
    "macro_f1_all_classes": "macro-F1",
}


@dataclass(frozen=True)
class Row:
    """A line of the table; ``ours`` and ``paper`` as they are printed, ``n`` what ours were taken over."""

    section: str
    what: str
    paper: str
    ours: str
    n: str = ""


def percent(values: list[float]) -> str:
    spread = f" ± {100 * statistics.stdev(values):.1f}" if len(values) > 1 else ""
    return f"{100 * statistics.mean(values):.1f} %{spread}"


def share(values: list[float]) -> str:
    return f"{statistics.mean(values):.3f}"


def seeds_said(seeds: int) -> str:
    return f"{seeds} seed{'s' if seeds > 1 else ''}"


class Paper:
    """The data set at ``out/DS``, and one method a part of the table."""

    def __init__(self, archive: Path, subjects: Path | None, out: Path, seeds: int, quick: bool) -> None:
        self.out, self.seeds, self.quick = out, seeds, quick
        folder = out / "DS"
        if not (folder / "dataset.toml").is_file():
            given: dict[str, Any] = {} if subjects is None else {"subjects": subjects}
            done = ps.import_recordings(archive, folder, layout="plush-15", name="the paper's archive", **given)
            for entry in done.rejected:
                say(f"rejected: {entry['file']}: {entry['reason']}")
        else:
            say(f"going on with the data set '{folder}' that an earlier run imported")
        self.dataset = ps.open_dataset(folder)
        if subjects is not None and not self.dataset.subjects:
            raise PlushSenseError(
                f"'{folder}' was imported without people: give another --out to import with --subjects."
            )
        self.simulated = self.dataset.head.simulated

    def data(self) -> list[Row]:
        windows = ps.cut_windows(self.dataset, ps.WindowSpec(context="loop"))
        people = str(len(self.dataset.subjects)) if self.dataset.subjects else "not known"
        return [
            Row("data", "recordings", "1326", str(len(self.dataset.recordings))),
            Row("data", "people", "25", people),
            Row("data", "windows of 2.5 s, step 0.5 s, looped", "5621", str(len(windows))),
        ]

    def search(self) -> list[Row]:
        rows = []
        for symbol, filters, printed in TABLE4:
            if self.quick and (symbol, filters) != CHOSEN:
                continue
            runs = [self._run(symbol, filters, "windows:holdout", "search", seed) for seed in range(self.seeds)]
            ours = percent([r["accuracy"]["mean"] for r in runs])
            name = f"{symbol} {'/'.join(map(str, filters))}, accuracy ({LEAKY})"
            tested = runs[0]["folds"][0]["test_windows"]
            rows.append(Row("search", name, f"{printed:.1f} %", ours, f"{seeds_said(self.seeds)}, {tested} windows"))
        return rows

    def loso(self) -> list[Row]:
        if len(self.dataset.subjects) < 3:
            need = "needs --subjects map.csv"
            return [Row("loso", f"{m}, leave one person out", f"{a:.3f} ± {s:.3f}", need) for m, (a, s) in LOSO.items()]
        runs = [self._run(*CHOSEN, "leave-one-subject-out", "paper", seed) for seed in range(self.seeds)]
        n = f"{seeds_said(self.seeds)}, {len(self.dataset.subjects)} people"
        rows = []
        for measure, (mean, sd) in LOSO.items():
            ours = f"{share([r[measure]['mean'] for r in runs])} ± {share([r[measure]['sd'] for r in runs])}"
            rows.append(Row("loso", f"{MEASURES[measure]}, mean over the people", f"{mean:.3f} ± {sd:.3f}", ours, n))
        for measure, value in POOLED.items():
            ours = share([r["pooled"][measure] for r in runs])
            rows.append(Row("loso", f"{MEASURES[measure]}, all windows together", f"{value:.3f}", ours, n))
        for label, value in F1.items():
            ours_f1 = [c["f1"] for r in runs for c in r["per_class"] if c["label"] == label]
            rows.append(Row("loso", f"F1 of {label}", f"{value:.3f}", share(ours_f1) if ours_f1 else "-", n))
        return rows

    def baselines(self) -> list[Row]:
        return [Row("baselines", f"{n} ({LEAKY})", f"{v:.1f} %", "not in this script") for n, v in BASELINES.items()]

    def _run(self, symbol: str, filters: tuple[int, ...], split: str, preset: str, seed: int) -> dict[str, Any]:
        """One evaluation, in the paper's own form: mirror padding, looped windows, all 18 gestures."""
        more: dict[str, Any] = {"epochs": 2} if self.quick else {}
        if preset == "search":
            more = {"epochs": 250, "batch": 64} | more
        say(f"{symbol} {'/'.join(map(str, filters))}, {split}, seed {seed}")
        result = ps.evaluate(
            self.dataset,
            split=split,
            arch=symbol,
            filters=filters,
            preset=preset,
            padding="mirror",
            context="loop",
            classes="all",
            seed=seed,
            progress=lambda p: say(f"  fold {p.done} of {p.folds} done") if p.epoch == 0 else None,
            **more,
        )
        return result.to_dict()


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def remarks(paper: Paper) -> list[str]:
    out = [UNTESTED]
    if paper.simulated:
        out.insert(0, "SIMULATION: these recordings are of virtual people; the figures say nothing about a real toy.")
    if paper.quick:
        out.append("--quick: two epochs a training; these figures are to try the script, not to compare.")
    out += [
        "Table 4 of the paper holds the best of nine schedules a network; ours is one (250 epochs, batches of 64).",
        "The mean macro-F1 over the people counts all 18 classes, as the paper's; ± is the standard deviation: of the "
        "people where one is left out (mean over the seeds), of the seeds elsewhere.",
        "The mean accuracy and recall over the people leave out nobody's recordings at rest; the paper does not say "
        "where it counts them.",
    ]
    return out


def as_text(rows: list[Row], notes: list[str]) -> str:
    cells = [("section", "what", "paper", "ours", "n")]
    cells += [(SECTIONS[r.section], r.what, r.paper, r.ours, r.n) for r in rows]
    widths = [max(len(row[i]) for row in cells) for i in range(5)]
    lines = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*notes, "", lines[0], "-" * sum(widths), *lines[1:]])


def as_html(rows: list[Row], notes: list[str]) -> str:
    head = "".join(f"<th>{h}</th>" for h in ("Section", "What", "Paper", "Ours", "n"))
    body = "".join(
        "<tr>"
        + "".join(f"<td>{html.escape(c)}</td>" for c in (SECTIONS[r.section], r.what, r.paper, r.ours, r.n))
        + "</tr>\n"
        for r in rows
    )
    said = "".join(f"<p>{html.escape(n)}</p>" for n in notes)
    style = (
        "body{font:15px/1.5 sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
        "td,th{padding:.2em .8em;text-align:left}td:nth-child(n+3){white-space:nowrap}"
    )
    title = "The paper beside ours"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{style}</style>'
        f"<h1>{title}</h1>{said}<table><tr>{head}</tr>\n{body}</table></html>\n"
    )


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="The table of the paper beside ours, from its published archive.")
    parser.add_argument("archive", type=Path, help="the archive's folder: a folder a gesture")
    parser.add_argument("--subjects", type=Path, metavar="CSV", help="who made which file: columns file,subject")
    parser.add_argument("--out", type=Path, default=Path("paper-out"), help="where the data set and the table go")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each network (1)")
    parser.add_argument("--quick", action="store_true", help="two epochs and one network: to try the script")
    args = parser.parse_args(words)
    try:
        paper = Paper(args.archive, args.subjects, args.out, max(1, args.seeds), args.quick)
        rows: list[Row] = []
        parts: list[Callable[[], list[Row]]] = [paper.data, paper.loso, paper.search, paper.baselines]
        for part in parts:
            rows += part()
            # Written after each part: the rest takes hours.
            notes = remarks(paper)
            with (args.out / "paper.csv").open("w", encoding="utf-8", newline="") as file:
                table = csv.writer(file)
                table.writerow(["section", "what", "paper", "ours", "n", "simulated", "quick"])
                marks = ["yes" if flag else "no" for flag in (paper.simulated, paper.quick)]
                table.writerows([SECTIONS[r.section], r.what, r.paper, r.ours, r.n, *marks] for r in rows)
            (args.out / "paper.html").write_text(as_html(rows, notes), encoding="utf-8")
    except PlushSenseError as refusal:
        say(f"paper.py: {refusal}")
        return 2
    print(as_text(rows, notes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
