"""Tables, figures and pages of the lens and of comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from plushsense.experiments.people.traits import UNUSUAL
from plushsense.reports.figures import data_uri, new_figure
from plushsense.reports.page import render_page
from plushsense.reports.table import DASH, Column, Table, interval, mean_sd, number
from plushsense.scoring.comparison import LEVEL
from plushsense.scoring.metrics import column_metrics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's blue and vermillion; markers show the same difference without colour.
_HONEST, _LEAKY = "#0072b2", "#d55e00"
_GREY = "#999999"
OTHER_WINDOWS = "The evaluations scored different windows: recordings are compared, each by the vote of its windows."
_DIGITS = {"tempo": 2, "strength": 2, "orientation_deg": 0, "rate_hz": 0}


def split_table(result: Mapping[str, Any]) -> Table:
    """Return one row for each split of the lens, with means over people and the leakage audit."""
    rows = []
    for row in result["splits"]:
        audit = row["leakage"]
        shares = {key: audit[key] / max(audit["windows"], 1) for key in audit if key not in ("windows", "pairs")}
        scores = {key: (mean_sd(row[key]), interval(row[key])) for key in column_metrics()}
        marked = row["split"] + (" LEAKY" if row["leaky"] else "")
        voted = row["by_recording"]["accuracy"]
        rows.append({**row, **scores, **shares, "split": marked, "voted": voted, "windows": audit["windows"]})
    columns = (
        Column("split", "Split"),
        Column("people", "People", "count"),
        Column("train_windows", "Windows to\ntrain, a fold", "count"),
        Column("windows", "Windows\nscored", "count"),
        *(Column(key, metric.title, "right") for key, metric in column_metrics().items()),
        Column("voted", "Accuracy by\nrecording", "share"),
        *(
            Column(key, head, "percent", group="Scored windows with something known", plain=f"known {head}")
            for key, head in (
                ("same_person", "person"),
                ("same_recording", "recording"),
                ("overlapping", "samples"),
                ("near_duplicates", "near-copy"),
            )
        ),
    )
    return Table("splits", "The same network under each split", columns, tuple(rows))


def people_table(result: Mapping[str, Any], gestures: int = 3) -> Table:
    """Return one row for each person of the lens, the worst read first, with some of the ``gestures`` read worst."""
    rows = []
    for person in result["people"]:
        traits = person["traits"]
        worst = "; ".join(
            f"{g['gesture']} {g['recall']:.2f} (as {g['read_as']})"
            for g in person["gestures"][:gestures]
            if g["read_as"]
        )
        notes = [*person["unusual"], *(f"{key.replace('_', ' ')}: {value}" for key, value in person["known"].items())]
        measured = {trait: number(traits.get(trait), digits) for trait, digits in _DIGITS.items()}
        rows.append({**person, **measured, "worst": worst, "notes": "; ".join(notes)})
    columns = (
        Column("subject", "Person"),
        Column("windows", "Windows", "count"),
        *(Column(key, metric.title, "share") for key, metric in column_metrics().items()),
        Column("by_recording_accuracy", "Accuracy by\nrecording", "share"),
        Column("tempo", "Duration\nratio", "right"),
        Column("strength", "Strength\nratio", "right"),
        Column("orientation_deg", "Angle\nin degrees", "right"),
        Column("rate_hz", "Frames\na second", "right"),
        Column("worst", "Lowest recall"),
        Column("notes", "Unusual"),
    )
    return Table("people", "Person by person, the worst read first", columns, tuple(rows))


def gesture_table(person: Mapping[str, Any]) -> Table:
    """Return one row for each gesture of a person, the worst read first."""
    columns = (
        Column("gesture", "Gesture"),
        Column("windows", "Windows", "count"),
        Column("recall", "Recall", "share"),
        Column("read_as", "Most often read instead as"),
        Column("share", "Share", "percent"),
    )
    return Table(f"gestures-{person['subject']}", person["subject"], columns, tuple(person["gestures"]))


def trait_table(result: Mapping[str, Any]) -> Table:
    """Return the correlation of each trait with the accuracy."""
    columns = (
        Column("title", "Trait, as its distance from the median"),
        Column("people", "People", "count"),
        Column("rho", "Spearman's ρ\nwith accuracy", "share"),
        Column("chance", "|ρ| of 5 %\nof chance results", "share"),
    )
    return Table("traits", "What goes with a low accuracy", columns, tuple(result["traits"]))


def lens_page(result: Mapping[str, Any]) -> str:
    """Return the page of the lens as HTML."""
    model = result["model"]
    filters = ", ".join(map(str, model["filters"] or ())) or DASH
    return render_page(
        "lens.html.j2",
        title=f"{model['arch']} on {result['dataset']}: one network under several splits",
        simulated=result["simulated"],
        about=f"Network {model['arch']}, filters {filters}; preset {model['preset']}; seed {result['seed']}.",
        splits=split_table(result),
        any_leaky=any(row["leaky"] for row in result["splits"]),
        pairs=[(row["split"], row["leakage"]["pairs"]) for row in result["splits"] if row["leakage"]["pairs"]],
        picture=data_uri(splits_figure(result)),
        by_person=result["by_person"],
        calibration=result["calibration"] and calibration_sentence(result["calibration"]),
        reliability=result["calibration"] and data_uri(reliability_figure([("", result["calibration"])])),
        people=result["people"] and people_table(result),
        persons=[(person["subject"], person["unusual"], gesture_table(person)) for person in result["people"] or ()],
        traits=result["traits"] and trait_table(result),
        unusual=f"{UNUSUAL:g}",
    )


def model_table(result: Mapping[str, Any]) -> Table:
    """Return one row for each model of a comparison, the best rank first."""
    rows = [
        {
            **model,
            "title": (model["title"], model["folder"]),
            **{key: (mean_sd(model[key]), interval(model[key])) for key in column_metrics()},
            **{f"rank {key}": model["rank"][key] for key in column_metrics()},
            "ece": model["calibration"]["before"]["ece"],
            "ece after": model["calibration"]["after"]["ece"],
            "temperature": model["calibration"]["temperature"],
        }
        for model in result["models"]
    ]
    columns = (
        Column("name", ""),
        Column("title", "Evaluation"),
        Column("parameters", "Parameters", "count"),
        *(Column(key, metric.title, "right") for key, metric in column_metrics().items()),
        *(
            Column(f"rank {key}", f"Mean rank (1: best),\n{metric.name}", "share")
            for key, metric in column_metrics().items()
        ),
        Column("ece", "Calibration\nerror (ECE)", "share"),
        Column("temperature", "Temper-\nature", "share"),
        Column("ece after", "ECE after\nscaling", "share"),
    )
    return Table("models", "Models, the best first", columns, tuple(rows), leaky=result["leaky"])


def pair_table(result: Mapping[str, Any], key: str) -> Table:
    """Return one row for each pair of models and one metric."""
    rows = [
        {
            **row,
            "pair": f"{row['first']} − {row['second']}",
            "difference": mean_sd(row["difference"]),
            "interval": interval(row["difference"]),
            **{p: "< 0.001" if row[p] < 0.001 else number(row[p]) for p in ("p", "p_holm")},
        }
        for row in result["pairs"][key]
    ]
    columns = (
        Column("pair", "Pair"),
        Column("difference", "Mean difference\n± sd", "right"),
        Column("interval", "95 % interval\nof the mean", "right"),
        Column("better", "People\nbetter", "count"),
        Column("worse", "People\nworse", "count"),
        Column("effect", "Effect\n(rank-biserial)", "share"),
        Column("p", "p", "right"),
        Column("p_holm", "p, Holm", "right"),
    )
    return Table(f"pairs-{key}", column_metrics()[key].title, columns, tuple(rows))


def comparison_page(result: Mapping[str, Any]) -> str:
    """Return the page of a comparison as HTML."""
    named = [(model["name"], model["calibration"]) for model in result["models"]]
    ranked = [(metric.title, data_uri(rank_figure(result, key))) for key, metric in column_metrics().items()]
    return render_page(
        "comparison.html.j2",
        title=f"{len(result['models'])} models on {result['dataset']}, person by person",
        simulated=result["simulated"],
        leaky=result["leaky"],
        split=result["split"],
        context=result["context"],
        scored=OTHER_WINDOWS if result["scored"] == "recordings" else "",
        n=len(result["people"]),
        models=model_table(result),
        pairs=[pair_table(result, key) for key in column_metrics()],
        ranks=ranked if len(result["models"]) > 2 else [],
        people=data_uri(people_figure(result)),
        reliability=data_uri(reliability_figure(named)),
        level=LEVEL,
    )


def calibration_sentence(calibration: Mapping[str, Any]) -> str:
    """Describe the calibration error before and after scaling by a temperature."""
    before, after = calibration["before"], calibration["after"]
    return (
        f"On people left out, the mean confidence is {number(before['confidence'])} and the accuracy "
        f"{number(before['accuracy'])}; expected calibration error {number(before['ece'])}. With the temperature "
        f"{number(calibration['temperature'], 2)} (median; each person's is fitted on all others), the error is "
        f"{number(after['ece'])}."
    )


def splits_figure(result: Mapping[str, Any]) -> Figure:
    """Draw the mean accuracy and macro-F1 under each split with 95 % intervals over people."""
    rows = result["splits"]
    figure = new_figure(7.6, 1.4 + 0.5 * len(rows))
    axes = figure.add_subplot()
    for place, (key, metric) in enumerate(column_metrics().items()):
        for y, row in enumerate(rows):
            score, colour = row[key], _LEAKY if row["leaky"] else _HONEST
            if score["mean"] is None:
                continue
            at = y + 0.14 * (2 * place - 1)
            low, high = score["ci95"] or (score["mean"],) * 2
            axes.plot([low, high], [at, at], color=colour, linewidth=1.6)
            axes.plot(
                score["mean"],
                at,
                marker="os"[place % 2],
                color=colour,
                markerfacecolor="#ffffff" if row["leaky"] else colour,
                linestyle="none",
                label=metric.name if y == 0 else None,
            )
    axes.set_yticks(range(len(rows)), [row["split"] + (" (leaky)" if row["leaky"] else "") for row in rows])
    axes.set(xlim=(0, 1), ylim=(len(rows) - 0.5, -0.5), xlabel="Mean over people, with its 95 % interval")
    _plain(axes)
    axes.legend(fontsize=8, frameon=False, loc="lower left")
    return figure


def reliability_figure(models: Sequence[tuple[str, Mapping[str, Any]]]) -> Figure:
    """Draw accuracy against confidence before and after scaling, one panel for each model."""
    figure = new_figure(min(3.4 * len(models), 13.6), 3.4 * -(-len(models) // 4))
    columns = min(len(models), 4)
    grid = figure.subplots(-(-len(models) // columns), columns, squeeze=False)
    for axes, (name, calibration) in zip(grid.flat, models, strict=False):
        axes.plot([0, 1], [0, 1], color=_GREY, linewidth=1.0)
        for part, colour, style, label in (
            ("before", _LEAKY, "o-", "as it is"),
            ("after", _HONEST, "s--", "with temperature"),
        ):
            bins = [b for b in calibration[part]["bins"] if b["n"]]
            text = f"{label}, ECE {number(calibration[part]['ece'])}"
            points = [b["confidence"] for b in bins], [b["accuracy"] for b in bins]
            axes.plot(*points, style, color=colour, markersize=4, label=text)
        axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="Confidence", ylabel="Accuracy", aspect="equal")
        axes.set_title(name, fontsize=9)
        axes.legend(fontsize=7, frameon=False, loc="upper left")
        _plain(axes)
    for axes in list(grid.flat)[len(models) :]:
        axes.set_axis_off()
    return figure


def rank_figure(result: Mapping[str, Any], key: str) -> Figure:
    """Draw the mean ranks of the models, with bars below those that do not differ significantly."""
    models = sorted(result["models"], key=lambda model: model["rank"][key])
    runs = result["cliques"][key]
    figure = new_figure(7.6, 1.2 + 0.25 * (len(models) + len(runs)))
    axes = figure.add_subplot()
    at = {model["name"]: model["rank"][key] for model in models}
    for i, model in enumerate(models):
        rank, y = model["rank"][key], -1 - i
        axes.plot([rank, rank], [0, y], color=_GREY, linewidth=0.8)
        axes.plot(rank, 0, "o", color=_HONEST, markersize=5)
        axes.text(rank + 0.03, y, f"{model['name']}  {number(rank, 2)}", va="center", fontsize=8)
    for i, run in enumerate(runs):
        ranks = [at[name] for name in run]
        axes.plot([min(ranks) - 0.03, max(ranks) + 0.03], [0.5 + 0.5 * i] * 2, color="#000000", linewidth=3)
    axes.set(xlim=(0.8, len(models) + 0.6), ylim=(-len(models) - 0.7, 0.8 + 0.5 * len(runs)))
    axes.set_xlabel(f"Mean rank over people by {column_metrics()[key].name} (1 is best)")
    axes.set_yticks([])
    axes.spines[["top", "right", "left"]].set_visible(False)
    return figure


def people_figure(result: Mapping[str, Any]) -> Figure:
    """Draw the accuracy of each person under each model."""
    names = [model["name"] for model in result["models"]]
    people = sorted(result["people"], key=lambda row: row[names[0]]["accuracy"])
    figure = new_figure(max(5.0, 1.2 + 0.3 * len(people)), 3.4)
    axes = figure.add_subplot()
    for i, name in enumerate(names):
        values = [row[name]["accuracy"] for row in people]
        axes.plot(range(len(people)), values, marker="osD^v<>P"[i % 8], linestyle="none", label=name, markersize=5)
    axes.set_xticks(range(len(people)), [row["subject"] for row in people], rotation=90, fontsize=8, parse_math=False)
    axes.set(ylim=(0, 1.02), ylabel="Accuracy", xlabel="Person")
    axes.legend(fontsize=8, frameon=False, loc="lower right")
    _plain(axes)
    return figure


def _plain(axes: Axes) -> None:
    axes.grid(color="#dddddd", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
