"""Compute the results of the paper from its published archive, and print them beside the paper's.

    python examples/paper.py ARCHIVE [--streams DIR | --subjects map.csv] [--out DIR] [--seeds 3] [--quick]

ARCHIVE is the folder that the authors' scripts write: one folder for each gesture, with files
<label>_<7 digits>_<rows>.csv. The file names do not contain the person, so the results over people need the folders of
people in which the scripts leave their streams ("Training Data"), or a mapping (CSV: file,subject). An interrupted run
is resumed by the same command.

This program is untested on the original, because the archive was not available to this project. It was tested on an
archive of the same form with virtual people.
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

import numpy as np

import plushsense as ps
from plushsense.core.errors import PlushSenseError
from plushsense.experiments.baselines.run_baselines import ComparisonSpec, baselines
from plushsense.experiments.baselines.score import UNSCALED, Pca, reads
from plushsense.experiments.sweep.grid import CHOSEN
from plushsense.experiments.sweep.run_sweep import SweepSpec, sweep
from plushsense.experiments.sweep.sweep_page import training_settings
from plushsense.experiments.sweep.tables import TABLE4
from plushsense.scoring.splits import make_folds, parse_split
from plushsense.windows.cut import WindowSpec

UNTESTED = "Untested on the original archive, which was not available to this project."
LEAKY = "leaky: windows of one recording are in both the training and the test set"

# The grids of the authors' scripts and of the paper's text, each with its split.
GRIDS = {"scripts": "as the authors' scripts train and divide", "paper": f"as the text says: random windows, {LEAKY}"}

# What a later version of the authors' d_data_preparation.m printed on the real data: the recordings of each class in
# class order, those to train, validate and test, and the rows of ten recordings at rest.
COUNTS = (51, 72, 73, 73, 75, 74, 74, 73, 74, 73, 75, 72, 72, 73, 74, 74, 74, 75)
DIVIDED = "912 / 194 / 195"
AT_REST_ROWS = "666, 543, 328, 572, 503, 590, 568, 530, 551, 492"
OUTPUTS = "outputs of their scripts"

# Section 4.4: the chosen network, leave one subject out over 25 people; mean and standard deviation over the folds.
LOSO = {"accuracy": (0.850, 0.072), "macro_recall": (0.717, 0.111), "macro_f1": (0.687, 0.114)}
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
# Section 4.5: 5 random folds over windows, in percent: (model, features, PCA). The paper has one result with PCA.
BASELINES: dict[tuple[str, str, Pca], float | None] = {
    ("forest", "paper-statistics", False): 95.9,
    ("forest", "paper-statistics", UNSCALED): 66.3,
    ("forest", "paper-statistics", True): None,
    ("cubic-svm", "flattened", False): 90.4,
    ("forest", "flattened", False): 89.7,
    ("subspace-knn", "flattened", False): 89.3,
}
SECTIONS = {"data": "3.2", "search": "4.2, Table 4", "loso": "4.4", "baselines": "4.5"}
MEASURES = {
    "accuracy": "accuracy",
    "macro_recall": "macro recall",
    "macro_f1": "macro-F1",
}


@dataclass(frozen=True)
class Row:
    """A row of the table: ``paper`` and ``ours`` are printed results, ``n`` describes the data of ours."""

    section: str
    what: str
    paper: str
    ours: str
    n: str = ""


def share(values: list[float]) -> str:
    return f"{statistics.mean(values):.3f}"


def seeds_text(seeds: int) -> str:
    return f"{seeds} seed{'s' if seeds > 1 else ''}"


class Paper:
    """The data set at ``out/DS``, with one method for each part of the table."""

    def __init__(
        self, archive: Path, subjects: Path | None, out: Path, seeds: int, quick: bool, streams: Path | None = None
    ) -> None:
        self.out, self.seeds, self.quick = out, seeds, quick
        self.settings: dict[str, str] = {}
        folder = out / "DS"
        options = {"subjects": subjects, "streams": streams}
        given: dict[str, Any] = {key: path for key, path in options.items() if path is not None}
        if not (folder / "dataset.toml").is_file():
            done = ps.import_recordings(archive, folder, layout="plush-15", name="the paper's archive", **given)
            for entry in done.rejected:
                say(f"rejected: {entry.file}: {entry.reason}")
        else:
            say(f"using the data set '{folder}' that an earlier run imported")
        self.dataset = ps.open_dataset(folder)
        if given and not self.dataset.subjects:
            raise PlushSenseError(
                f"'{folder}' was imported without people: give another --out to import with --{next(iter(given))}."
            )
        self.simulated = self.dataset.head.simulated

    def data(self) -> list[Row]:
        windows = ps.cut_windows(self.dataset, WindowSpec(context="rows"))
        people = str(len(self.dataset.subjects)) if self.dataset.subjects else "not known"
        recordings = self.dataset.used
        classes = self.dataset.gestures
        label = np.array([classes.index(r.gesture) for r in recordings])
        names, nobody = np.array([r.id for r in recordings]), np.full(len(recordings), "none")
        (fold,) = make_folds(parse_split("recordings:holdout"), nobody, label, names=names)
        at_rest = [str(r.rows) for r in recordings if r.gesture == "At rest"]
        share = float(np.mean(windows.y == windows.labels.index("At rest"))) if at_rest else 0.0
        divided = " / ".join(str(len(part)) for part in (fold.train, fold.validation, fold.test))
        counts = [
            Row("data", f"recordings of {name} ({OUTPUTS})", str(count), str(int((label == at).sum())))
            for at, (name, count) in enumerate(zip(classes.labels, COUNTS, strict=True))
        ]
        return [
            Row("data", "recordings", "1326", str(len(recordings))),
            Row("data", f"recordings ({OUTPUTS})", str(sum(COUNTS)), str(len(recordings))),
            *counts,
            Row("data", f"recordings to train, validate and test ({OUTPUTS})", DIVIDED, divided),
            Row("data", f"rows of ten recordings at rest ({OUTPUTS})", AT_REST_ROWS, ", ".join(at_rest[:10])),
            Row("data", "people", "25", people),
            Row("data", "windows of 2.5 s, step 0.5 s, looped", "5621", str(len(windows))),
            Row("data", f"windows at rest ({OUTPUTS})", "5.6 %", f"{100 * share:.1f} %"),
        ]

    def search(self) -> list[Row]:
        rows = []
        for symbol in (CHOSEN[0],) if self.quick else dict.fromkeys(symbol for symbol, _ in TABLE4):
            filter_sets = [
                filters for other, filters in TABLE4 if other == symbol and (filters == CHOSEN[1] or not self.quick)
            ]
            for grid, about in GRIDS.items():
                rows += self._swept(symbol, filter_sets, grid, about)
        return sorted(rows, key=lambda row: (row.paper, row.what), reverse=True)

    def _swept(self, symbol: str, filter_sets: list[str], grid: str, about: str) -> list[Row]:
        """Train one architecture with some sets of filters as one of the grids says."""
        say(f"{symbol} with {', '.join(filter_sets)}, grid {grid}")
        # Reduced to the trials of the paper's Table 4.
        swept = sweep(
            self.dataset,
            SweepSpec(
                grid,
                {
                    "architectures": (symbol,),
                    "filters": ",".join(filter_sets),
                    "epochs": (2,) if self.quick else (250,),
                    "batches": (64,),
                    "seeds": tuple(range(self.seeds)),
                },
                out=self.out / "sweeps" / f"{symbol}-{self.seeds}-{grid}{'-quick' * self.quick}",
            ),
        )
        described = [("Split", swept.head["split"]), ("Context", swept.head["context"])]
        described += [("Padding", swept.rows[0]["padding"]), *training_settings(swept)]
        self.settings[grid] = "; ".join(f"{key.lower()}: {value}" for key, value in described)
        tested = swept.run_rows[0]["test_windows"]
        rows = []
        for trial in swept.rows:
            spread = f" ± {100 * trial['accuracy_sd']:.1f}" if self.seeds > 1 else ""
            rows.append(
                Row(
                    "search",
                    f"{symbol} {trial['filters']}, accuracy ({about})",
                    f"{100 * TABLE4[symbol, trial['filters']].accuracy:.1f} %",
                    f"{100 * trial['accuracy']:.1f} %{spread}",
                    f"{seeds_text(self.seeds)}, {tested} windows",
                )
            )
        return rows

    def loso(self) -> list[Row]:
        if len(self.dataset.subjects) < 3:
            need = "needs --streams or --subjects"
            return [Row("loso", f"{m}, leave one person out", f"{a:.3f} ± {s:.3f}", need) for m, (a, s) in LOSO.items()]
        runs = [self._one_out(seed) for seed in range(self.seeds)]
        n = f"{seeds_text(self.seeds)}, {len(self.dataset.subjects)} people"
        rows = []
        for rest in ("with", "without") if runs[0].get("with_rest") else ("without",):
            for measure, (mean, sd) in LOSO.items():
                of = [r["with_rest"] if rest == "with" else r for r in runs]
                ours = f"{share([r[measure]['mean'] for r in of])} ± {share([r[measure]['sd'] for r in of])}"
                what = f"{MEASURES[measure]}, mean over the people, {rest} recordings at rest"
                rows.append(Row("loso", what, f"{mean:.3f} ± {sd:.3f}", ours, n))
        for measure, value in POOLED.items():
            ours = share([r["pooled"][measure] for r in runs])
            rows.append(Row("loso", f"{MEASURES[measure]}, all windows together", f"{value:.3f}", ours, n))
        for label, value in F1.items():
            ours_f1 = [c["f1"] for r in runs for c in r["per_class"] if c["label"] == label]
            rows.append(Row("loso", f"F1 of {label}", f"{value:.3f}", share(ours_f1) if ours_f1 else "-", n))
        return rows

    def baselines(self) -> list[Row]:
        ours: dict[tuple[str, str, Pca], Row] = {}
        choices = {"paper-statistics": "no"} if self.quick else {"paper-statistics": "all", "flattened": "no"}
        for features, pca in choices.items():
            result = baselines(
                self.dataset,
                spec=ComparisonSpec(
                    ("windows:5",),
                    list(dict.fromkeys(name for name, read, _ in BASELINES if read == features)),
                    (features,),
                    pca,
                ),
                context="rows",
                classes="all",
            )
            for row in result.models:
                printed = BASELINES[key := (row.name, features, row.pca)]
                accuracy = row.metrics["accuracy"]
                ours[key] = Row(
                    "baselines",
                    f"{row.title} on {reads(features, row.pca)} ({LEAKY})",
                    "-" if printed is None else f"{printed:.1f} %",
                    f"{100 * accuracy['mean']:.1f} % ± {100 * accuracy['sd']:.1f}",
                    f"{row.folds} folds, {result.windows} windows",
                )
        return [ours[key] for key in BASELINES if key in ours]

    def _one_out(self, seed: int) -> dict[str, Any]:
        """Evaluate the chosen network as in the paper: mirror padding, looped rows, all 18 gestures."""
        symbol, filters = CHOSEN
        more: dict[str, Any] = {"epochs": 2} if self.quick else {}
        say(f"{symbol} {filters}, leave one person out, seed {seed}")
        result = ps.evaluate(
            self.dataset,
            split="leave-one-subject-out",
            arch=symbol,
            filters=filters.replace("/", ","),
            preset="paper",
            padding="mirror",
            context="rows",
            classes="all",
            seed=seed,
            progress=lambda p: say(f"  fold {p.done} of {p.total} done") if p.epoch == 0 else None,
            **more,
        )
        return result.to_json()


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def remarks(paper: Paper) -> list[str]:
    out = [UNTESTED]
    if paper.simulated:
        out.insert(0, "SIMULATION: these recordings are of virtual people; the results say nothing about a real toy.")
    out += [f"The grid “{grid}” as resolved: {text}." for grid, text in paper.settings.items()]
    if paper.quick:
        out.append("--quick: two epochs per training, to test the program; do not compare these results.")
    out += [
        "The paper describes a random split of the windows, but the authors' script takes the first 70 % of each "
        "gesture in the order of the files for training, the next 15 % for validation and the last 15 % for the test: "
        "compare the paper's 75.0 % with “as the authors' scripts train and divide”. Random windows would be easier.",
        "Table 4 of the paper shows the best of nine schedules per network; ours is one (250 epochs, batches of 64).",
        "The paper averages recall and F1 of a person over all 18 classes, of which At rest is one that nobody makes: "
        "compare with the rows with recordings at rest, which are divided among the folds, because the paper does not "
        "say in which folds they stand. Those without are over a person's gestures. ± is the standard deviation: "
        "over the people where one is left out (mean over the seeds), over the seeds or folds elsewhere.",
        "The paper does not say whether it scaled before PCA. The names of its classifiers are those of MATLAB's "
        "Classification Learner, which does not, so the paper's 66.3 % is printed beside PCA unscaled.",
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
    paragraphs = "".join(f"<p>{html.escape(n)}</p>" for n in notes)
    style = (
        "body{font:15px/1.5 sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
        "td,th{padding:.2em .8em;text-align:left}td:nth-child(n+3){white-space:nowrap}"
    )
    title = "The paper beside ours"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{style}</style>'
        f"<h1>{title}</h1>{paragraphs}<table><tr>{head}</tr>\n{body}</table></html>\n"
    )


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description="Compute the results of the paper from its published archive, and print them beside the paper's."
    )
    parser.add_argument("archive", type=Path, help="folder of the archive, with one folder for each gesture")
    parser.add_argument("--streams", type=Path, metavar="DIR", help="folders of people with their streams")
    parser.add_argument("--subjects", type=Path, metavar="CSV", help="person of each file: columns file,subject")
    parser.add_argument("--out", type=Path, default=Path("paper-out"), help="folder for the data set and the table")
    parser.add_argument("--seeds", type=int, default=1, help="number of trainings of each network (1)")
    parser.add_argument("--quick", action="store_true", help="two epochs and one network, to test the program")
    args = parser.parse_args(words)
    try:
        paper = Paper(args.archive, args.subjects, args.out, max(1, args.seeds), args.quick, args.streams)
        rows: list[Row] = []
        parts: list[Callable[[], list[Row]]] = [paper.data, paper.loso, paper.search, paper.baselines]
        for part in parts:
            rows += part()
            # Write after each part, because the next one may take hours.
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
