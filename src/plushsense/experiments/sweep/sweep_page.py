"""Write the report of a sweep, with sections in the paper's order, as a page and as files."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plushsense.dataset.store import writing_around
from plushsense.experiments.sweep import figures as draw
from plushsense.experiments.sweep import tables
from plushsense.experiments.sweep.folder import SUMMARY
from plushsense.experiments.sweep.grid import GRID_TRAINING
from plushsense.experiments.sweep.results import SweepResult, file_name_of, name_of, read_sweep
from plushsense.reports import wording
from plushsense.reports.figures import png, svg, svg_uri
from plushsense.reports.page import check_page_path, earlier_files, render_page, write_files, write_page
from plushsense.reports.table import DASH, Row, Table, count, number, text
from plushsense.scoring.metrics import grouped
from plushsense.training.spec import PRESETS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Drawing:
    """A figure with its file name and ``alt``, a text that describes it to readers who cannot see it."""

    name: str
    figure: Figure
    alt: str


@dataclass(frozen=True)
class Section:
    """A section of the page: tables, figures, and in ``dropped`` sentences on what is left out, and why.

    ``files`` are tables that are written as files only.
    """

    key: str
    title: str
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    dropped: tuple[str, ...] = ()
    scores: bool = True
    files: tuple[Table, ...] = ()


def sections_of(sweep: SweepResult) -> Iterator[Section]:
    """Yield the sections of the report in the paper's order; without any finished trial, only those without scores."""
    if not sweep.done:
        yield Section("best", "The best trials", dropped=("No trial is done yet: there is no score to show.",))
        yield _parameters(sweep)
        return
    best = sweep.best
    assert best is not None
    yield Section("best", "The best trials", (sweep.best_table(),))
    yield _overview(sweep)
    yield _parameters(sweep)
    yield _by_filters(sweep)
    yield _top(sweep)
    yield _effect(sweep)
    trials = _looked_at(sweep, best)
    yield _confusions(sweep, trials)
    yield _curves(sweep, trials)
    yield _fronts(sweep)


def _parameters(sweep: SweepResult) -> Section:
    return Section("table-3", "Parameters (the paper's Table 3)", (tables.table3(sweep),), scores=False)


def _overview(sweep: SweepResult) -> Section:
    rows = tables.architectures(sweep)
    best = max(rows, key=lambda row: row.highest or 0.0)
    alt = (
        f"Bars: highest and mean accuracy of {len(rows)} architectures, the highest of {best.arch}. Diamonds: "
        f"parameters. {draw.LIKE.format(7)}; the table has the numbers."
    )
    drawing = Drawing("figure-7-architectures", draw.by_architecture(sweep), alt)
    title = "Accuracy of each architecture (the paper's Figure 7)"
    return Section("figure-7", title, (tables.architecture_table(sweep),), (drawing,), _only_best(len(rows)))


def _by_filters(sweep: SweepResult) -> Section:
    title = "Accuracy by filter set (the paper's Figure 8)"
    if len(sweep.filter_sets) < 2:
        return Section("figure-8", title, dropped=("There is one filter set only: it would be Figure 7 again.",))
    alt = (
        "A panel of bars a filter set: highest and mean accuracy of each architecture. "
        f"{draw.LIKE.format(8)}; the table above has the numbers."
    )
    drawing = Drawing("figure-8-filter-sets", draw.by_filters(sweep), alt)
    return Section("figure-8", title, drawings=(drawing,), dropped=_only_best(len(sweep.archs)))


def _only_best(architectures: int) -> tuple[str, ...]:
    if architectures <= draw.BARS:
        return ()
    return (f"Drawn are the best {draw.BARS} of {architectures} architectures; the CSV has all.",)


def _top(sweep: SweepResult) -> Section:
    table = tables.table4(sweep)
    title = "The best of each size class (the paper's Table 4 and Figure 9)"
    if len(table.rows) < 2:
        dropped = ("One network only is scored: Figure 9 would be one point.",)
        return Section("table-4", title, (table,), dropped=dropped)
    points = len(tables.top_rows(table))
    alt = f"Points: accuracy against parameters of {points} networks. {draw.LIKE.format(9)}; the table has the numbers."
    return Section("table-4", title, (table,), (Drawing("figure-9-size", draw.size_and_accuracy(sweep), alt),))


def _effect(sweep: SweepResult) -> Section:
    title, table = "Effect of epochs and batch", tables.effect(sweep)
    if len(table.rows) < 2:
        return Section("effect", title, dropped=("One schedule only is scored: there is nothing to compare.",))
    return Section("effect", title, (table,))


def _looked_at(sweep: SweepResult, best: Row) -> list[Row]:
    """Return the trials to show with confusions and curves: the paper's two networks if in the grid, and the best."""
    candidates = [*(sweep.best_of(*network) for network in draw.PAPER_CONFUSIONS), best]
    return list({t["trial"]: t for t in candidates if t}.values())


def _confusions(sweep: SweepResult, trials: Sequence[Row]) -> Section:
    title = "Confusions (the paper's Figures 10 and 11)"
    if len(sweep.labels) < 2:
        return Section("confusion", title, dropped=("The sweep names no classes: there is nothing to confuse.",))
    drawings, by_gesture, counts, dropped = [], [], [], []
    for network, figure_number in draw.PAPER_CONFUSIONS.items():
        if sweep.best_of(*network) is None:
            dropped.append(f"No trial of {' '.join(network)}, the network of Figure {figure_number}, is done here.")
    for trial in {t["trial"]: t for t in (*trials, *sweep.kept)}.values():
        figure = draw.confusion(sweep, trial)
        if figure is None:
            dropped.append(f"The confusions of {name_of(trial)} were not kept.")
            continue
        number = draw.PAPER_CONFUSIONS.get((trial["arch"], trial["filters"]))
        name = f"{f'figure-{number}-' if number else ''}confusion-{file_name_of(trial)}"
        drawings.append(Drawing(name, figure, confusion_words(sweep, trial)))
        by_gesture += [table for table in (tables.per_class(sweep, trial),) if table]
        counts.append(tables.confusion_table(sweep, trial, name))
    if by_gesture and set(sweep.affects) == {"none"}:
        dropped.append("The gestures of this data set have no affect: there are no blocks.")
    return Section("confusion", title, tuple(by_gesture), tuple(drawings), tuple(dropped), files=tuple(counts))


def confusion_words(sweep: SweepResult, trial: Row) -> str:
    """Describe a confusion matrix in words: shares that are right, wrong within an affect, and wrong across affects."""
    counts = np.asarray(sweep.confusion(str(trial["trial"])), dtype=np.int64)
    total, right = int(counts.sum()), int(np.trace(counts))
    names, by_affect = grouped(counts, sweep.affects)
    share = 100 * right / max(total, 1)
    description = f"Confusion matrix of {name_of(trial)}: {right} of {count(total)} windows right ({share:.1f} %)"
    if len(names) > 1:
        same_affect = int(np.trace(by_affect))
        description += (
            f"; {100 * (same_affect - right) / max(total, 1):.1f} % read as another gesture of the same affect, "
            f"{100 * (total - same_affect) / max(total, 1):.1f} % as one of another affect"
        )
    wrong = counts - np.diag(np.diag(counts))
    if wrong.any():
        i, j = np.unravel_index(wrong.argmax(), wrong.shape)
        description += f". Most often mistaken: {sweep.labels[i]} for {sweep.labels[j]} ({wrong[i, j]} windows)"
    number = draw.PAPER_CONFUSIONS.get((trial["arch"], trial["filters"]))
    return description + (f". {draw.LIKE.format(number)}." if number else ".")


def _curves(sweep: SweepResult, trials: Sequence[Row]) -> Section:
    drawings, dropped = [], []
    for trial in trials:
        figure = draw.curves(sweep, trial)
        if figure is None:
            dropped.append(f"No learning curves of {name_of(trial)} were kept.")
            continue
        alt = f"Learning curves of {name_of(trial)}: loss and accuracy by epoch, training and validation."
        drawings.append(Drawing(f"curves-{file_name_of(trial)}", figure, alt))
    return Section("curves", "Learning curves", drawings=tuple(drawings), dropped=tuple(dropped))


def _fronts(sweep: SweepResult) -> Section:
    drawings, dropped = [], []
    for cost, label in tables.COSTS.items():
        points = tables.pareto_points(sweep, cost)
        values = {p.value for p in points}
        if len(values) < 2:
            same = f": {count(next(iter(values)))} for all" if values else ""
            dropped.append(f"No front of macro-F1 against “{label.lower()}”, which does not differ{same}.")
            continue
        edge = [p for p in points if p.front]
        members = "; ".join(f"{p.arch} {p.filters} ({count(p.value)}, {p.macro_f1:.3f})" for p in edge)
        alt = f"Points: macro-F1 against {label.lower()} of {len(points)} networks, log scale. On the front: {members}."
        drawings.append(Drawing(f"pareto-{cost.replace('_', '-')}", draw.pareto(sweep, cost), alt))
    return Section("pareto", "Pareto fronts", (tables.pareto(sweep),), tuple(drawings), tuple(dropped))


PAGE, FILES = "report.html", "report-files"
_DPI = 120


def is_sweep(folder: str | os.PathLike[str]) -> bool:
    """Return whether ``folder`` is the results folder of a sweep."""
    return (Path(folder) / SUMMARY).is_file()


@dataclass(frozen=True)
class ReportResult:
    """A written report: its page, the folder ``files`` with ``n_files`` tables and figures, and the trials in it."""

    report: Path
    files: Path
    n_files: int
    trials: int
    done: int

    @property
    def summary(self) -> list[str]:
        """Return lines that say how many tables and figures were written, and into which folder."""
        return [f"{self.n_files} tables and figures in {self.files}"]

    def to_json(self) -> dict[str, object]:
        """Return plain values, ready for JSON."""
        return {
            "report": str(self.report),
            "files": str(self.files),
            "trials": self.trials,
            "done": self.done,
            "said": self.summary,
        }


def write_sweep_report(
    folder: str | os.PathLike[str],
    page: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
) -> ReportResult:
    """Write the page of a sweep and, in a folder beside it, each table as CSV and each figure as PNG and SVG.

    Args:
        folder: the results folder of a sweep, which may still be running.
        page: the .html file (default: ``report.html`` in the folder); an older report there is replaced.
        title: heading of the page.

    Raises:
        BadInput: where there is no sweep; ConfigError: where the page or its files would replace something else.
        MissingExtraError: when polars, jinja2 or matplotlib is not installed.
    """
    writing = writing_around(Path(folder))
    sweep = read_sweep(folder)
    target = check_page_path(Path(page) if page is not None else sweep.out / PAGE)
    beside = target.parent / (FILES if target.name == PAGE else f"{target.stem}-files")
    before = earlier_files(beside)
    sections = list(sections_of(sweep))
    drawings = [d for section in sections for d in section.drawings]
    for d in drawings:
        # Compute the layout once for PNG and SVG.
        d.figure.draw_without_rendering()
        d.figure.set_layout_engine("none")
    pictures = {d.name: svg(d.figure) for d in drawings}
    files = dict(_contents(sweep, sections, pictures))
    page_text = render(sweep, sections, pictures, title=title, files=beside.name)
    with writing():
        write_files(beside, files, before)
        write_page(target, page_text)
    return ReportResult(target, beside, len(files), sweep.total, len(sweep.done))


def render(
    sweep: SweepResult,
    sections: Sequence[Section],
    pictures: Mapping[str, bytes],
    *,
    title: str | None = None,
    files: str = FILES,
) -> str:
    """Return the page as one self-contained HTML text; ``pictures`` are the drawings as SVG by name."""
    return render_page(
        "sweep.html.j2",
        title=title or f"Sweep {sweep.name}: {len(sweep.done)} of {sweep.total} trials",
        simulated=sweep.simulated,
        leaky=sweep.leaky,
        done=len(sweep.done),
        total=sweep.total,
        over=wording.describe_runs(sweep.rows),
        about=about_rows(sweep),
        sections=[_template_values(sweep, section, pictures) for section in sections],
        files=files,
    )


def about_rows(sweep: SweepResult) -> list[tuple[str, str]]:
    """Return grid, data and split as (name, value) pairs."""
    head = sweep.head
    how, who = wording.describe_split(str(head.get("split")))
    schedules = f"epochs {', '.join(map(str, tables.epochs(sweep)))}; batch {', '.join(tables.batches(sweep))}"
    grid = (
        f"{len(sweep.archs)} architecture{'s' * (len(sweep.archs) != 1)}, "
        f"{len(sweep.filter_sets)} filter set{'s' * (len(sweep.filter_sets) != 1)}; {schedules}"
    )
    waiting = sweep.total - len(sweep.done)
    seconds = head.get("seconds")
    tested = {(r.get("seed"), r.get("fold")): int(r["test_windows"]) for r in sweep.run_rows if r.get("test_windows")}
    scored = sum(tested.values()) // max(1, len({seed for seed, _ in tested}))
    return [
        ("Data set", text(head.get("dataset"))),
        ("Hash (SHA-256)", text(head.get("dataset_hash"))),
        ("Split", f"{how} (“{head.get('split') or '?'}”{', leaky' if sweep.leaky else ''})"),
        ("Who validates", who),
        *([("Beside the paper", tables.PAPERS_SPLIT)] if str(head.get("split")) in tables.HOLDOUTS else []),
        ("Windows scored", count(scored) if scored else DASH),
        ("Context", wording.CONTEXT_WORDS.get(str(head.get("context")), text(head.get("context")))),
        ("Training preset", text(head.get("preset"))),
        *training_settings(sweep),
        ("Padding", ", ".join(sorted({str(t.get("padding")) for t in sweep.rows})) or DASH),
        ("Grid", f"{grid} (the paper's has {tables.PAPER_TRIALS} trials)"),
        ("Seeds and folds", wording.describe_runs(sweep.rows)),
        (
            "Trials",
            f"{len(sweep.done)} of {sweep.total} done"
            + (f", {waiting} waiting or partial" if waiting else "")
            + (f"; {sweep.dropped} more dropped by halving" if sweep.dropped else ""),
        ),
        ("Classes", text(sweep.labels)),
        ("Time", f"{number(seconds, 0)} s" if number(seconds) != DASH else DASH),
        ("Machine", text(head.get("machine"))),
        ("Code version", text(head.get("code_version"))),
    ]


def training_settings(sweep: SweepResult) -> list[tuple[str, str]]:
    """Return the settings of the networks and their training, with those of the preset filled in."""
    grid = sweep.head.get("grid") or {}
    preset = PRESETS.get(str(sweep.head.get("preset")))
    if preset is None:
        return []
    given = {key: grid[key] for key in GRID_TRAINING if grid.get(key) is not None}
    spec = preset.changed(**given)
    falls = f", halved every {spec.halve_every} epochs" if spec.halve_every else ", constant"
    kept = (
        "the last weights are kept (MATLAB's trainnet, with its own defaults, may return those of the best validation)"
        if spec.patience is None
        else f"the best weights are kept, and training stops after {spec.patience} epochs without a better result"
    )
    return [
        ("Optimiser", f"Adam, learning rate {spec.learning_rate:g}{falls}; weight decay {spec.weight_decay:g}; {kept}"),
        ("Scaling of the inputs", spec.scaling),
        ("Normalisation", text(grid.get("norm"))),
    ]


def _template_values(sweep: SweepResult, section: Section, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    return {
        "key": section.key,
        "title": section.title,
        "scores": section.scores and bool(section.tables or section.drawings),
        "dropped": section.dropped,
        "tables": [replace(table, leaky=sweep.leaky, simulated=sweep.simulated) for table in section.tables],
        "drawings": [
            {
                "src": svg_uri(pictures[d.name]),
                "alt": d.alt,
                "name": d.name,
                "csv": any(table.name == d.name for table in section.files),
            }
            for d in section.drawings
        ],
    }


def _contents(
    sweep: SweepResult, sections: Sequence[Section], pictures: Mapping[str, bytes]
) -> Iterator[tuple[str, bytes]]:
    """Yield the name and content of each file; every table includes the data and split of its scores."""
    source = {"dataset": sweep.head.get("dataset"), "split": sweep.head.get("split")}
    source |= {"leaky": "yes" if sweep.leaky else "no", "simulated": "yes" if sweep.simulated else "no"}
    for section in sections:
        for table in (*section.tables, *section.files):
            yield f"{table.name}.csv", table.csv(source).encode()
        for d in section.drawings:
            yield f"{d.name}.png", png(d.figure, dpi=_DPI)
            yield f"{d.name}.svg", pictures[d.name]
