"""Tables of comparisons and of merges, for the command line and for pages."""

from __future__ import annotations

from plushsense.experiments.analysis.results import MergeResult, PairedComparisonResult
from plushsense.reports.table import Column, Table, interval, mean_sd, number
from plushsense.scoring.metrics import column_metrics

SCORED = {
    "windows": "",
    "recordings": "The evaluations scored different windows: recordings are compared, each by the vote of its windows.",
    "own": "The splits score different recordings: each person's score is over those of the split.",
}
"""A sentence on what is compared of each person (`PairedComparisonResult.scored`)."""

_AUDIT = {
    "same_person": "person",
    "same_recording": "recording",
    "overlapping": "samples",
    "near_duplicates": "near-copy",
}


def model_table(result: PairedComparisonResult) -> Table:
    """Return one row for each model of a comparison, the best rank first."""
    metrics = column_metrics()
    rows = [
        {
            "name": model.name,
            "title": (model.evaluation.title, str(model.evaluation.folder)),
            "parameters": model.evaluation.parameters,
            "split": model.evaluation.split + " LEAKY" * model.evaluation.leaky,
            **{key: (mean_sd(model.scores[key]), interval(model.scores[key])) for key in metrics},
            **{f"rank {key}": model.rank[key] for key in metrics},
            "calibration_error": model.calibration_error,
        }
        for model in result.models
    ]
    columns = (
        Column("name", ""),
        Column("title", "Evaluation"),
        Column("parameters", "Parameters", "count"),
        Column("split", "Split"),
        *(Column(key, metric.title, "right") for key, metric in metrics.items()),
        *(Column(f"rank {key}", f"Mean rank (1: best),\n{metric.name}", "share") for key, metric in metrics.items()),
        Column("calibration_error", "Calibration\nerror (ECE)", "share"),
    )
    return Table("models", "Models, the best first", columns, tuple(rows))


def split_table(result: PairedComparisonResult) -> Table:
    """Return one row for each model with the size of its split and the leakage audit."""
    rows = []
    for model in sorted(result.models, key=lambda model: model.name):
        e = model.evaluation
        rows.append(
            {
                "name": model.name,
                "split": e.split + " LEAKY" * e.leaky,
                "people": len(e.people),
                "train_windows": e.train_windows,
                "windows": e.leakage.windows,
                "voted": e.by_recording["accuracy"],
                **{kind: e.leakage.share(kind) for kind in _AUDIT},
            }
        )
    columns = (
        Column("name", ""),
        Column("split", "Split"),
        Column("people", "People", "count"),
        Column("train_windows", "Windows to\ntrain, a fold", "count"),
        Column("windows", "Windows\nscored", "count"),
        Column("voted", "Accuracy by\nrecording", "share"),
        *(
            Column(key, head, "percent", group="Scored windows with something known", plain=f"known {head}")
            for key, head in _AUDIT.items()
        ),
    )
    return Table("splits", "Splits, and what they leak", columns, tuple(rows))


def pair_table(result: PairedComparisonResult, key: str) -> Table:
    """Return one row for each pair of models and one metric."""
    rows = [
        {
            **vars(pair),
            "pair": f"{pair.first} − {pair.second}",
            "difference": mean_sd(pair.difference.to_json()),
            "interval": interval(pair.difference.to_json()),
            **{name: "< 0.001" if p < 0.001 else number(p) for name, p in (("p", pair.p), ("p_holm", pair.p_holm))},
        }
        for pair in result.pairs[key]
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


def merge_table(result: MergeResult) -> Table:
    """Return one row for each number of merges."""
    metrics = column_metrics()
    rows, known = [], set[str]()
    for number_of_merges, step in enumerate(result.steps):
        groups = step.grouping.named(" + ")
        rows.append(
            {
                "merges": number_of_merges,
                "classes": step.grouping.classes,
                "largest": step.grouping.largest,
                **{key: step.grouping.scores[key]["mean"] for key in metrics},
                **{f"crossfitted {key}": step.crossfitted[key]["mean"] for key in metrics},
                "confusion": step.confusion,
                "people": None if step.people is None else f"{step.people} of {result.people}",
                "last": "; ".join(group for group in groups if group not in known),
            }
        )
        known = set(groups)
    columns = (
        Column("merges", "merges", "count"),
        Column("classes", "classes", "count"),
        Column("largest", "largest class", "share"),
        *(
            column
            for key, metric in metrics.items()
            for column in (
                Column(key, metric.name, "share"),
                Column(f"crossfitted {key}", "cross-fitted", "share"),
            )
        ),
        Column("confusion", "confused", "share"),
        Column("people", "in people", "right"),
        Column("last", "merged last"),
    )
    return Table("merges", "Merges of gestures that are confused", columns, tuple(rows))


def grouping_table(result: MergeResult) -> Table:
    """Return one row for each merge that was named beforehand."""
    metrics = column_metrics()
    rows = [
        {
            "name": name,
            "classes": grouping.classes,
            "largest": grouping.largest,
            **{key: grouping.scores[key]["mean"] for key in metrics},
            "merged": "; ".join(grouping.named(" + ")),
        }
        for name, grouping in result.groupings.items()
    ]
    columns = (
        Column("name", "named"),
        Column("classes", "classes", "count"),
        Column("largest", "largest class", "share"),
        *(Column(key, metric.name, "share") for key, metric in metrics.items()),
        Column("merged", "merged"),
    )
    return Table("groupings", "Merges named beforehand", columns, tuple(rows))
