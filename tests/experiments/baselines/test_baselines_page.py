"""The comparison as rows, figure and page."""

from __future__ import annotations

from typing import Any

import pytest

from plushsense.evaluation.leakage import LeakageResult
from plushsense.experiments.baselines.baselines_page import (
    COUNTS,
    LEAKY,
    figure,
    milliseconds,
    page,
    program_table,
    size,
)
from plushsense.experiments.baselines.score import BaselinesResult, ProgramGap, ProgramScores, SplitFolds

pytestmark = pytest.mark.apart("models")

AUDIT = LeakageResult(1890, 0, 0, 0, 0, 0, 0, ())
SPLITS = (("leave-one-subject-out", False), ("windows:5", True))


def comparison(*splits: tuple[str, bool], simulated: bool = False) -> BaselinesResult:
    models, gaps = [], []
    for program, at in {("tree", "statistics", True): (0.3, 0.7), ("network", "windows", False): (0.6, 0.75)}.items():
        name, features, pca = program
        own: tuple[Any, ...] = (name, f"the {name} <b>", features, pca)
        for split, leaky in splits:
            score = {"mean": at[leaky], "sd": 0.1, "ci95": [0.1, 0.9]}
            scores = {"accuracy": score, "macro_f1": score}, {"accuracy": 0.5, "macro_f1": 0.4}, dict[str, float]()
            models.append(
                ProgramScores(
                    *own, 2.46, split, leaky, not leaky, "subjects", 5, *scores, 12_345, 0.5, 0.01, 12.3, 61.5
                )
            )
        if len(splits) == 2:
            gaps.append(ProgramGap(*own, splits[0][0], splits[1][0], {"accuracy": at[1] - at[0]}))
    return BaselinesResult(
        "stream", tuple(SplitFolds(split, leaky, 5, AUDIT) for split, leaky in splits),
        1890, 300, 9, ("a", "b"), 0, 10, 0,
        tuple(models), tuple(gaps), "study $1", "0", simulated, "ours", {}, 2.5, "1", "a processor", "1",
    )  # fmt: skip


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
    assert "Leakage audit of windows:5" in text
    assert COUNTS in text and "LEAKY" in text and "the tree &lt;b&gt;" in text and "a processor" in text
    assert ("scores are of a simulation" in text) == simulated
    assert LEAKY in page(comparison(SPLITS[1]))
    alone = page(comparison(SPLITS[0]))
    assert "LEAKY" not in alone and COUNTS not in alone and "Gap" not in alone
