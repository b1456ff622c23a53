"""Figures stand alone: they are returned, complete, and unharmed by odd labels."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from plushsense.core.errors import ConfigError
from plushsense.reports import figures

pytestmark = pytest.mark.slow


def test_confusion_shows_every_count_and_label_inside_the_picture(study):
    case = study["evaluations"][0]["confusion"]
    figure = figures.confusion(case["labels"], case["counts"], title="By gesture")
    axes = figure.axes[0]
    assert [t.get_text() for t in axes.get_xticklabels()] == case["labels"]
    assert {t.get_text() for t in axes.texts} == {str(n) for row in case["counts"] for n in row if n}
    figure.draw_without_rendering()
    whole = figure.bbox
    for label in [
        *axes.get_xticklabels(),
        *axes.get_yticklabels(),
        axes.title,
        axes.xaxis.label,
        axes.yaxis.label,
    ]:
        box = label.get_window_extent()
        assert whole.x0 <= box.x0 and box.x1 <= whole.x1 and whole.y0 <= box.y0 and box.y1 <= whole.y1


def test_a_dollar_in_a_label_is_no_formula():
    figure = figures.confusion(["a$\\frac$", "b_$^"], [[1, 2], [3, 4]], title="$\\bad$")
    assert figures.svg(figure).startswith(b"<?xml")


@pytest.mark.parametrize(("labels", "counts"), [(["a"], [[1, 2]]), ([], np.zeros((0, 0))), (["a", "b"], [1, 2])])
def test_counts_that_do_not_fit_the_labels_are_refused(labels, counts):
    with pytest.raises(ConfigError, match="needs"):
        figures.confusion(labels, counts)


def test_the_mean_curve_stops_where_fewer_than_half_of_the_folds_train():
    short = [{"epoch": e, "train_loss": 1.0} for e in (1, 2)]
    long = [{"epoch": e, "train_loss": 3.0} for e in (1, 2, 3, 4)]
    left = figures.training_curves([short, short, long]).axes[0]
    thick = [line for line in left.lines if line.get_linewidth() > 1]
    assert len(left.lines) == 4 and len(thick) == 1
    assert thick[0].get_xdata().tolist() == [1, 2]
    assert thick[0].get_ydata() == pytest.approx([5 / 3, 5 / 3])


def test_curves_stand_with_no_validation_and_with_nothing_at_all():
    one = figures.training_curves([[{"epoch": 1, "train_loss": 1.0, "validation_loss": None}]])
    assert len(one.axes[0].lines) == 1
    assert not figures.training_curves([]).axes[0].lines


def test_the_same_figure_gives_the_same_bytes_and_no_window(study):
    case = study["evaluations"][1]["histories"][:3]
    first, second = (figures.svg(figures.training_curves(case)) for _ in range(2))
    assert first == second
    pyplot = sys.modules.get("matplotlib.pyplot")
    assert pyplot is None or not pyplot.get_fignums()


@pytest.mark.filterwarnings("error")
def test_a_letter_that_the_font_lacks_is_no_warning() -> None:
    figure = figures.training_curves([])
    figure.axes[0].set_title("Streicheln \U0001f9f8")
    assert figures.png(figure).startswith(b"\x89PNG")
    assert figures.svg(figure)
