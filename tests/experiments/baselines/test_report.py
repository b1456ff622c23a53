"""The comparison as rows, figure and page."""

from __future__ import annotations

from typing import Any

import pytest

from plushsense.experiments.baselines.report import COUNTS, LEAKY, figure, milliseconds, page, program_table, size

SPLITS = (("leave-one-subject-out", False), ("windows:5", True))


def comparison(*splits: tuple[str, bool], simulated: bool = False) -> dict[str, Any]:
    programs = {("tree", "statistics", True): (0.3, 0.7), ("network", "windows", False): (0.6, 0.75)}
    models, gaps = [], []
    for (name, features, pca), at in programs.items():
        own = {"name": name, "title": f"the {name} <b>", "features": features, "pca": pca, "span_s": 2.46}
        for split, leaky in splits:
            score = {"mean": at[leaky], "sd": 0.1, "ci95": [0.1, 0.9]}
            costs = {"size_bytes": 12_345, "predict_ms": 0.5, "predict_batch_ms": 0.01, "train_s": 12.3}
            models.append(
                {**own, "split": split, "leaky": leaky, "apart": not leaky, "over": "subjects", "folds": 5}
                | {"accuracy": score, "macro_f1": score, "pooled": {"accuracy": 0.5, "macro_f1": 0.4}, **costs}
            )
        if len(splits) == 2:
            gaps.append({**own, "split": splits[0][0], "leaky_split": splits[1][0], "accuracy": at[1] - at[0]})
    return {
        "dataset": "study $1", "simulated": simulated,
        "splits": [{"split": split, "leaky": leaky, "folds": 5} for split, leaky in splits],
        "models": models, "gaps": gaps, "windows": 1890, "recordings": 300, "subjects": 9, "labels": ["a", "b"],
        "window_s": 2.5, "context": "stream", "seed": 0, "machine": "a processor",
    }  # fmt: skip


def test_rows_are_sorted_by_the_first_split_and_hold_the_gap() -> None:
    best, other = program_table(comparison(*SPLITS)).rows
    assert (best["class"], best["gap"], other["gap"]) == ("ours", "+0.150", "+0.400")
    assert other["reads"] == "statistics, PCA" and other["span"] == "2.46"
    assert other["accuracy windows:5"] == ("0.700 ± 0.100", "pooled 0.500 / 0.400")
    assert (best["size"], best["predict"], best["batch"], best["train"]) == ("12.3 kB", "0.500", "0.010", "12")
    assert program_table(comparison(SPLITS[1])).rows[0]["gap"] == ""
    assert size(27_000_000) == "27.0 MB" and milliseconds(31.44) == "31.4" and milliseconds(314.2) == "314"


def test_the_figure_marks_both_splits_and_joins_them() -> None:
    (axes,) = figure(comparison(*SPLITS)).axes
    honest, leaky = axes.collections
    assert honest.get_label() == "leave-one-subject-out" and leaky.get_label() == "windows:5 (leaky)"
    assert honest.get_offsets().tolist() == [[0.3, 0.0], [0.6, 1.0]]
    assert leaky.get_offsets().tolist() == [[0.7, 0.0], [0.75, 1.0]]
    assert [line.get_xdata().tolist() for line in axes.lines] == [[0.3, 0.7], [0.6, 0.75]]  # type: ignore[union-attr]
    assert "SIMULATION" in figure(comparison(*SPLITS, simulated=True)).axes[0].get_title(loc="left")
    for one in SPLITS:
        assert len(figure(comparison(one)).axes[0].collections) == 1


@pytest.mark.parametrize("simulated", [False, True])
def test_the_page_says_what_counts_and_what_is_simulated(simulated: bool) -> None:
    text = page(comparison(*SPLITS, simulated=simulated))
    assert COUNTS in text and "LEAKY" in text and "the tree &lt;b&gt;" in text and "a processor" in text
    assert ("scores are of a simulation" in text) == simulated
    assert LEAKY in page(comparison(SPLITS[1]))
    alone = page(comparison(SPLITS[0]))
    assert "LEAKY" not in alone and COUNTS not in alone and "Gap" not in alone
