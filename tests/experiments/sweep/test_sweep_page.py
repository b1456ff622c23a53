"""The report of a sweep: what the paper shows, computed from known numbers, and honest about what they are of."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.experiments.sweep import figures as sweep_figures
from plushsense.experiments.sweep import sweep_page as sweep_report
from plushsense.experiments.sweep import tables as sweep_tables
from plushsense.experiments.sweep.grid import CHOSEN, SECOND
from plushsense.experiments.sweep.results import read_sweep
from plushsense.experiments.sweep.sweep_page import confusion_words, sections_of, write_sweep_report
from plushsense.models.arch import PAPER_ARCHITECTURES, PAPER_FILTERS
from plushsense.scoring.metrics import accuracy_complexity_ratio
from support.made_sweep import make_sweep

pytestmark = pytest.mark.apart("cluster")

SMALL = {
    "archs": ("250", "14d1_39d2_41d4"),
    "filter_sets": ((4, 6, 8, 8), (8, 12, 16, 16)),
    "epochs": (20, 60),
    "batches": ("64", "full"),
}
ONE = {
    "archs": ("14d1_39d2_41d4",),
    "filter_sets": ((8, 12, 16, 16),),
    "epochs": (20,),
    "batches": ("64",),
    "labels": ("Rest", "Slow & low", "<script>$\\frac"),
    "channels": 4,
}


ONE_TRIAL: dict[str, Any] = {"archs": ("250",), "filter_sets": ((4, 6, 8, 8),), "epochs": (5,), "batches": ("64",)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_sweep(tmp_path_factory.mktemp("whole") / "S", epochs=(10, 25, 100))


def known(folder: Path, scores: dict[tuple[str, str], list[float | None]], **more: object) -> Path:
    """A made-up sweep with these accuracies for (arch, filters) in the order of its schedules; macro-F1 is 0.1 less."""
    import polars

    make_sweep(folder, **{**SMALL, **more})  # type: ignore[arg-type]
    frame = polars.read_parquet(folder / "trials.parquet")
    left = {key: iter(values) for key, values in scores.items()}
    found = [next(left[(r["arch"], r["filters"])]) for r in frame.to_dicts()]
    f1 = [None if v is None else v - 0.1 for v in found]
    frame = frame.with_columns(
        polars.Series("accuracy", found, dtype=polars.Float64), polars.Series("macro_f1", f1, dtype=polars.Float64)
    )
    frame.write_parquet(folder / "trials.parquet")
    return folder


SCORES: dict[tuple[str, str], list[float | None]] = {
    ("250", "4"): [0.5, 0.6, 0.7, 0.4],
    ("250", "8"): [0.3, 0.3, 0.3, 0.3],
    ("14d1_39d2_41d4", "4/6/8"): [0.70, 0.2, 0.2, 0.1],
    ("14d1_39d2_41d4", "8/12/16"): [0.8, None, 0.6, 0.4],
}


@dataclass
class Written:
    """What a report consists of: the page, the folder beside it, and the files in that."""

    page: Path
    folder: Path
    files: list[Path]
    done: int
    trials: int


def write_report(folder: Path, page: Path | None = None) -> Written:
    made = write_sweep_report(folder, page)
    beside = made.files
    files = sorted(path for path in beside.iterdir() if path.name != "README.txt")
    return Written(made.report, beside, files, made.done, made.trials)


def test_acr_is_the_papers():
    assert accuracy_complexity_ratio(0.75, 13262) == pytest.approx(0.75 / math.log10(13262))
    for (arch, filters), row in sweep_tables.TABLE4.items():
        found = accuracy_complexity_ratio(row.accuracy, sweep_tables.count_parameters(arch, filters))
        assert found is not None and abs(found - row.acr) < 0.0016, (arch, filters)
        assert sweep_tables.printed_parameters(arch, filters) == row.parameters
    assert accuracy_complexity_ratio(None, 100) is None and accuracy_complexity_ratio(0.5, 1) is None


def test_table3_stands_beside_the_papers_and_names_the_misprint(whole):
    table = sweep_tables.table3(read_sweep(whole))
    assert [r["arch"] for r in table.rows] == list(PAPER_ARCHITECTURES)
    row = next(r for r in table.rows if r["arch"] == "14d1_39d2_41d4")
    assert (row["8/12/16/16 ours"], row["8/12/16/16 paper"]) == (13262, "13.2k")
    assert (row["32/48/64/64 ours"], row["32/48/64/64 paper"]) == (192386, "192k")
    odd = next(r for r in table.rows if r["arch"] == "100_151")
    assert odd["32/48/64/64 paper"] == "169k (misprint?)"
    said = " ".join(table.notes)
    assert "Of 52 cells" in said and "36 meet" in said and "15 more" in said
    assert "100_151 at 32/48" in said and "misprint" in said
    assert not any("channels" in c.head for c in table.columns)


@pytest.mark.parametrize(
    ("said", "count", "meets"),
    [
        ("13.2k", 13262, True),
        ("13.3k", 13262, True),
        ("13.1k", 13262, False),
        ("192k", 192386, True),
        ("8k", 8038, True),
    ],
)
def test_a_printed_count_is_met_rounded_or_cut_off(said, count, meets):
    assert sweep_tables.agrees(said, count) is meets


def test_other_data_are_counted_at_the_papers_size_too(tmp_path):
    sweep = read_sweep(make_sweep(tmp_path / "S", **ONE))
    table = sweep_tables.table3(sweep)
    (row,) = table.rows
    assert row["8/12/16/16 ours"] < row["8/12/16/16 at the paper's size"] == 13262
    assert "11 channels and 18 classes" in " ".join(table.notes)
    assert "None of these" in " ".join(
        sweep_tables.table3(read_sweep(make_sweep(tmp_path / "T", **{**ONE, "archs": ("9",)}))).notes
    )


def test_table4_has_maxima_means_and_the_papers_row(tmp_path):
    sweep = read_sweep(known(tmp_path / "S", SCORES))
    table = sweep_tables.table4(sweep)
    assert [(r["arch"], r["filters"]) for r in table.rows] == [
        ("14d1_39d2_41d4", "8/12/16"),
        ("14d1_39d2_41d4", "4/6/8"),
        ("250", "4"),
        ("250", "8"),
    ]
    first = table.rows[0]
    assert (first["accuracy"], first["mean_accuracy"], first["trials"]) == (0.8, pytest.approx(0.6), 3)
    assert first["acr"] == pytest.approx(0.8 / math.log10(13262)) and first["macro_f1"] == pytest.approx(0.7)
    assert (first["paper_accuracy"], first["paper_mean"], first["paper_acr"]) == (0.75, 0.657, 0.182)
    assert (first["paper_parameters"], first["paper_split"]) == ("13.2k", "windows:file-order")
    assert [r["paper_accuracy"] for r in table.rows[1:]] == [None] * 3
    papers = [i for i, c in enumerate(table.columns) if c.key.startswith("paper_")]
    assert [[row[i] for i in papers] for row in table.cells()[1:]] == [["—"] * 5] * 3, "not printed there: a dash"
    assert "windows:file-order" in " ".join(table.notes) and "75.0 %" in " ".join(table.notes)
    assert [r["above"] for r in table.rows] == ["yes", "no", "no", "no"], "0.70 is not above 70 %"
    assert "1 of 4 scored networks" in " ".join(table.notes)


def test_table4_has_every_network_that_the_paper_printed(whole):
    """Also those that are not among the best of their size class; Figure 9 has only the best."""
    sweep = read_sweep(whole)
    table = sweep_tables.table4(sweep)
    printed = {(r["arch"], r["filters"]): r for r in table.rows if r["paper_accuracy"] is not None}
    assert set(printed) == set(sweep_tables.TABLE4)
    assert {key: (r["paper_accuracy"], r["paper_mean"], r["paper_acr"]) for key, r in printed.items()} == {
        key: (row.accuracy, row.mean, row.acr) for key, row in sweep_tables.TABLE4.items()
    }
    best = sweep_tables.top_rows(table)
    assert len(best) == 12 and all(r["rank"] <= 3 or r["paper_accuracy"] for r in table.rows)
    figure = sweep_figures.size_and_accuracy(sweep)
    assert sum(len(line.get_xdata()) for line in figure.axes[0].lines) == 12
    with_split = sweep_tables.table4(replace(sweep, head={**sweep.head, "split": "windows:file-order"}))
    assert "This sweep has that split." in " ".join(with_split.notes)
    assert "This sweep has that split." not in " ".join(table.notes)


def test_architectures_over_all_and_over_one_filter_set(tmp_path):
    sweep = read_sweep(known(tmp_path / "S", SCORES))
    rows = {r.arch: r for r in sweep_tables.architectures(sweep)}
    assert rows["250"].highest == 0.7 and rows["250"].mean == pytest.approx((2.2 + 1.2) / 8)
    assert rows["14d1_39d2_41d4"].trials == 7 and rows["14d1_39d2_41d4"].parameters == 13262
    assert {r.arch: r.mean for r in sweep_tables.architectures(sweep, "4/6/8/8")}["250"] == pytest.approx(0.55)


def test_the_effect_is_over_networks_that_have_every_schedule(tmp_path):
    sweep = read_sweep(known(tmp_path / "S", SCORES))
    table = sweep_tables.effect(sweep)
    first = next(r for r in table.rows if (r["epochs"], r["batch_asked"]) == (20, "64"))
    assert first["networks"] == 3 and first["accuracy"] == pytest.approx(np.mean([0.5, 0.3, 0.7]))
    assert first["accuracy_sd"] == pytest.approx(np.std([0.5, 0.3, 0.7], ddof=1))
    assert "3 networks" in table.notes[0]
    lone = {key: [0.5, None, 0.5, 0.5] for key in SCORES}
    odd = sweep_tables.effect(read_sweep(known(tmp_path / "T", lone)))
    assert "not to be compared" in odd.notes[0] and len(odd.rows) == 3


def test_the_fronts_hold_what_no_network_beats(whole):
    sweep = read_sweep(whole)
    assert sweep_tables.batches(sweep) == ["64", "256", "full"]
    assert sweep.filter_sets == ["/".join(map(str, f)) for f in PAPER_FILTERS]
    points = sweep_tables.pareto_points(sweep, "parameters")
    assert len(points) == 52
    edge = [(p.value, p.macro_f1) for p in points if p.front]
    assert edge == sorted(edge) and [f for _, f in edge] == sorted(f for _, f in edge)
    assert max(p.macro_f1 for p in points) == edge[-1][1] and min(p.value for p in points) == edge[0][0]


def test_labels_of_a_front_cover_neither_each_other_nor_the_edge(whole):
    from matplotlib.text import Text

    figure = sweep_figures.pareto(read_sweep(whole), "parameters")
    axes = figure.axes[0]
    boxes = [Text.get_window_extent(t) for t in axes.texts if t.get_text()]  # without the line to the point
    assert len(boxes) >= 3
    assert not any(box.count_overlaps(boxes[:i]) for i, box in enumerate(boxes))
    inside = axes.get_window_extent()
    assert all(inside.x0 <= b.x0 and b.x1 <= inside.x1 and inside.y0 <= b.y0 and b.y1 <= inside.y1 for b in boxes)


def test_the_confusion_is_by_affect_and_counted(tmp_path):
    folder = make_sweep(
        tmp_path / "S", **{**ONE, "labels": ("Hit", "Rest", "Pat"), "affects": ("negative", "neutral", "positive")}
    )
    head = json.loads((folder / "sweep.json").read_text())
    (trial,) = head["confusions"]
    head["confusions"][trial] = [[8, 1, 1], [0, 9, 1], [0, 0, 10]]
    (folder / "sweep.json").write_text(json.dumps(head))
    sweep = read_sweep(folder)
    row = sweep.best_of(*CHOSEN)
    assert row is not None
    said = confusion_words(sweep, row)
    assert "27 of 30 windows right (90.0 %)" in said and "10.0 % as one of another affect" in said
    figure = sweep_figures.confusion(sweep, row)
    assert figure is not None
    assert [t.get_text() for t in figure.axes[0].get_xticklabels()] == ["Pat", "Rest", "Hit"]
    assert {"positive", "neutral", "negative"} <= {t.get_text() for t in figure.axes[0].texts}


def test_the_confusions_of_every_kept_network_are_files(tmp_path):
    two = {"archs": ("19d1_19d2_19d4_17d8", "14d1_39d2_41d4"), "filter_sets": ((4, 6, 8, 8), (8, 12, 16, 16))}
    folder = make_sweep(tmp_path / "S", **{**ONE, **two})
    head = json.loads((folder / "sweep.json").read_text())
    kept = [t["trial"] for t in read_sweep(folder).rows]
    head["confusions"] = {trial: [[9, 1, 0], [i, 8, 1], [0, 0, 7]] for i, trial in enumerate(kept)}
    head["predictions"] = {trial: f"predictions-{trial}.parquet" for trial in kept}
    (folder / "sweep.json").write_text(json.dumps(head))
    sweep = read_sweep(folder)
    section = sweep_report._confusions(sweep, [t for t in (sweep.best_of(*CHOSEN), sweep.best_of(*SECOND)) if t])
    drawn = [d.name for d in section.drawings]
    assert drawn[0].startswith("figure-10-confusion-14d1_39d2_41d4-8-12-16-")
    assert drawn[1].startswith("figure-11-confusion-19d1_19d2_19d4_17d8-4-6-8-8-")
    assert {name.split("-")[-1] for name in drawn} == set(kept)
    assert "As the paper's Figure 10" in section.drawings[0].alt
    assert section.drawings[0].figure.axes[0].get_title().startswith("As the paper's Figure 10: confusions of\n14d1")
    counts = {t.name: t for t in section.files}
    for name in drawn:
        assert [list(row.values())[1:] for row in counts[name].rows] == head["confusions"][name.split("-")[-1]]
    lone = sweep_report._confusions(read_sweep(make_sweep(tmp_path / "T", **ONE)), [])
    assert "No trial of 19d1_19d2_19d4_17d8 4/6/8/8, the network of Figure 11, is done here." in lone.dropped


def test_a_nested_training_is_cut_at_the_trials_epochs(whole):
    sweep = read_sweep(whole)
    trial = next(t for t in sweep.rows if t["epochs"] == 25)
    (history,) = sweep.histories(trial)
    assert [e["epoch"] for e in history] == list(range(1, 26))


def test_the_page_is_complete_marked_and_beside_its_files(tmp_path):
    made = write_report(make_sweep(tmp_path / "S", **SMALL, simulated=True, waiting=0.2))
    page = made.page.read_text(encoding="utf-8")
    assert made.page == tmp_path / "S" / "report.html"
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)
    assert "<script" not in page and '<meta name="generator" content="PlushSense">' in page
    assert all(f'alt="{start}' in page for start in ("Bars:", "Points:", "Confusion", "Learning", "A panel"))
    assert f"{made.done} of {made.trials} trials done" in page and made.done < made.trials == 16
    assert "This split leaks" in page and "These scores are of a simulation" in page and "one seed, no spread" in page
    heads = re.findall(r"<th[^>]*>(.*?)</th>", page, flags=re.DOTALL)
    scores = [
        h for h in heads if re.match(r"(Highest |Mean )?(accuracy|macro-f1|acr|f1|recall)\b", h, flags=re.IGNORECASE)
    ]
    assert len(scores) > 10 and all("LEAKY" in h and "SIMULATION" in h for h in scores)
    names = {f.name for f in made.files}
    assert {"table-3.csv", "table-4.csv", "effect.csv", "pareto.csv"} <= names
    assert "figure-7-and-8-architectures.csv" in names
    assert {Path(n).suffix for n in names if n.startswith("figure-10-confusion-")} == {".csv", ".png", ".svg"}
    for figure in (
        "figure-7-architectures",
        "figure-8-filter-sets",
        "figure-9-size",
        "pareto-parameters",
    ):
        assert {f"{figure}.png", f"{figure}.svg"} <= names, figure
        assert (made.folder / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
    with (made.folder / "table-4.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert all((r["leaky"], r["simulated"], r["split"]) == ("yes", "yes", "windows:holdout") for r in rows)


@pytest.mark.exhaustive
def test_a_fair_split_of_real_data_bears_no_mark(tmp_path):
    case = {**SMALL, "split": "by-subject:5", "leaky": False, "folds": 5, "seeds": 2, "archs": ("250",)}
    page = write_report(make_sweep(tmp_path / "S", **case)).page.read_text(encoding="utf-8")
    assert "LEAKY" not in page and "SIMULATION" not in page and "trials done." not in page
    assert "mean of 2 seeds × 5 folds" in page and "± sd" in page


def test_the_smallest_sweep_renders_escaped_and_says_what_it_leaves_out(tmp_path):
    made = write_report(make_sweep(tmp_path / "S", **ONE, dataset="<b>$x", name="<i>"))
    page = made.page.read_text(encoding="utf-8")
    assert "<script" not in page and "&lt;script&gt;" in page and "&lt;b&gt;$x" in page and "<i>" not in page
    for said in ("one filter set only", "One network only", "nothing to compare", "have no affect", "No front"):
        assert said in page, said
    names = {f.name for f in made.files}
    assert "figure-7-architectures.png" in names and "figure-8-filter-sets.png" not in names


def test_a_sweep_without_a_score_is_a_page_too(tmp_path):
    made = write_report(make_sweep(tmp_path / "S", **SMALL, waiting=1.1))
    page = made.page.read_text(encoding="utf-8")
    assert "0 of 16 trials done" in page and "No trial is done yet" in page and "13.2k" in page
    assert [f.name for f in made.files] == ["table-3.csv"]


def test_paddings_in_one_grid_are_other_networks(tmp_path):
    import polars

    one = polars.read_parquet(make_sweep(tmp_path / "A", **ONE) / "trials.parquet")
    folder = make_sweep(tmp_path / "B", **ONE, padding="stream", draw=1)
    other = polars.read_parquet(folder / "trials.parquet").with_columns(trial=polars.lit("f" * 20))
    polars.concat([one, other]).write_parquet(folder / "trials.parquet")
    sweep = read_sweep(folder)
    assert [n.label for n in sweep.networks] == ["14d1_39d2_41d4 mirror", "14d1_39d2_41d4 stream"]
    assert len(sweep_tables.pareto_points(sweep, "macs_per_step")) == 2


def test_an_older_report_is_replaced_and_nothing_else_touched(tmp_path):
    folder = make_sweep(tmp_path / "S", **ONE)
    first = write_report(folder)
    own = first.folder / "my notes.txt"
    own.write_text("keep")
    make_sweep(folder, **{**ONE, "archs": ("250",)})
    second = write_report(folder)
    assert own.read_text() == "keep"
    gone = {f.name for f in first.files} - {f.name for f in second.files}
    assert gone and not any((second.folder / name).exists() for name in gone)
    thesis = tmp_path / "elsewhere" / "thesis-files"
    thesis.mkdir(parents=True)
    (thesis / "table-3.csv").write_text("mine")
    with pytest.raises(ConfigError, match="exists and is not the folder of a report"):
        write_report(folder, tmp_path / "elsewhere" / "thesis.html")
    assert (thesis / "table-3.csv").read_text() == "mine" and not (tmp_path / "elsewhere" / "thesis.html").exists()
    (folder / "report.html").write_text("my thesis")
    with pytest.raises(ConfigError, match="not a report"):
        write_report(folder)


def test_a_folder_that_is_no_sweep_is_one_sentence(tmp_path):
    import polars

    with pytest.raises(BadInput, match=r"no sweep at .* plushsense sweep"):
        read_sweep(tmp_path)
    folder = make_sweep(tmp_path / "S", **ONE)
    (folder / "trials.parquet").write_bytes(b"nothing")
    with pytest.raises(BadInput, match=r"cannot be read .* run the sweep again"):
        read_sweep(folder)
    polars.DataFrame({"trial": ["a"]}).write_parquet(folder / "trials.parquet")
    with pytest.raises(BadInput, match="lacks the column 'arch'"):
        read_sweep(folder)
    (folder / "sweep.json").write_text("{")
    with pytest.raises(BadInput, match="is not a sweep"):
        read_sweep(folder)


def test_every_figure_says_what_it_is_of_and_nothing_is_cut_off(tmp_path):
    dataset = "a data set with a long name, which somebody gave it who likes long names"
    sweep = read_sweep(make_sweep(tmp_path / "S", **ONE, simulated=True, dataset=dataset))
    for section in sections_of(sweep):
        for drawing in section.drawings:
            figure = drawing.figure
            figure.draw_without_rendering()
            said = figure.get_supxlabel().replace("\n", " ")
            assert all(part in said for part in ("LEAKY", "SIMULATION", dataset, "one seed, no spread"))
            whole = figure.bbox
            named = [a for axes in figure.axes for a in (axes.title, axes.xaxis.label, axes.yaxis.label)]
            for text in (t for t in (*figure.texts, *named) if t.get_text()):
                box = text.get_window_extent()
                assert whole.x0 - 1 <= box.x0 and box.x1 <= whole.x1 + 1, (drawing.name, text.get_text())
                assert whole.y0 - 1 <= box.y0 and box.y1 <= whole.y1 + 1, (drawing.name, text.get_text())


def test_a_trial_of_some_folds_is_neither_ranked_nor_averaged(tmp_path: Path) -> None:
    """One easy person looks better than all together: what is not done wholly compares with nothing."""
    import polars

    folder = known(tmp_path / "S", SCORES)
    frame = polars.read_parquet(folder / "trials.parquet")
    lucky = (polars.col("arch") == "250") & (polars.col("filters") == "8") & (polars.col("epochs") == 20)
    lucky &= polars.col("batch_asked") == "64"
    changes = {"accuracy": 0.99, "macro_f1": 0.99, "validation_accuracy": 0.99, "status": "partial"}
    frame = frame.with_columns(
        **{key: polars.when(lucky).then(polars.lit(value)).otherwise(polars.col(key)) for key, value in changes.items()}
    )
    frame.write_parquet(folder / "trials.parquet")
    sweep = read_sweep(folder)
    assert sweep.best is not None and sweep.best["accuracy"] == 0.8
    shown = [
        *sweep.best_table().rows,
        *sweep_tables.table4(sweep).rows,
        *sweep_tables.architecture_table(sweep).rows,
        *sweep_tables.pareto(sweep).rows,
        *sweep_tables.effect(sweep).rows,
    ]
    for key in ("accuracy", "highest", "macro_f1", "validated_accuracy"):
        assert max(row.get(key) or 0.0 for row in shown) <= 0.8, key
    (network,) = [n for n in sweep.networks if (n.arch, n.filters) == ("250", "8")]
    assert len(network.done) == 3 and network.mean() == pytest.approx(0.3)


@pytest.mark.exhaustive
def test_a_sweeps_folder_makes_its_page(cli: Any, tmp_path: Path) -> None:
    folder = make_sweep(tmp_path / "S", **ONE_TRIAL)
    done = cli("report", folder, "--json").json
    assert (done["trials"], done["done"]) == (1, 1)
    assert Path(done["report"]) == folder / "report.html" and Path(done["files"], "table-4.csv").is_file()
    page = tmp_path / "other.html"
    ran = cli("report", folder, "--page", page, "--title", "Mine")
    assert ran.status == 0 and f"{page}: 1 of 1 trial" in ran.out
    assert "<h1>Mine</h1>" in page.read_text(encoding="utf-8")
    assert (tmp_path / "other-files" / "table-4.csv").is_file()
