"""One result has one figure in the sentence, the plot, the table, the report and on the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.cli.evaluate import lines
from plushsense.cli.main import main
from plushsense.core.errors import DatasetError
from plushsense.dataset.marks import Mark, append_marks
from plushsense.evaluation.scores import read_predictions
from plushsense.scoring.metrics import accuracy_over_people
from plushsense.studio.app.stored_results import (
    EVALUATION,
    TRAINING,
    TRIAL,
    Confusion,
    ResultRow,
    StoredResults,
    counted,
    figure,
    score_interval,
    trial_settings,
)
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.train.result_details import confusion_table, worst_table
from plushsense.studio.widgets.verdict import figures, headline, limits, of_ten, people_table
from plushsense.workflow.config import from_settings
from support.sweeping import keys

pytestmark = [pytest.mark.apart("train-scores"), pytest.mark.early]


def row_of(home: Path, kind: str) -> ResultRow:
    return next(r for r in StoredResults(Workspace(home)).rows() if r.kind == kind)


# The first of the file: after another one its process would grow beyond 600 MB.
@pytest.mark.exhaustive
def test_a_training_has_the_same_figure_everywhere(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bundle = home / "bundles" / "little.plush"
    words = [
        "train",
        str(home / "datasets" / "virtual"),
        "--context",
        "anywhere",
        "--epochs",
        "2",
        "--out",
        str(bundle),
    ]
    assert main([*words, "--force", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    accuracy = printed["scores"]["accuracy"]
    last = printed["history"][-1]
    # The last point of the curve is the score; that over all windows has another name.
    assert last["accuracy"] == pytest.approx(accuracy) == pytest.approx(last["validation_accuracy_people"])
    assert "validation_accuracy" in last
    results = StoredResults(Workspace(home))
    row = row_of(home, TRAINING)
    assert (row.accuracy, row.units) == (accuracy, 1)
    w = Words("lv")
    assert figure(w, accuracy) in figures(w, row)
    # Its confusions are computed from the recordings of the same person, and agree with the score.
    details = results.details(row)
    assert details.later and details.by_gesture is None
    found = results.with_predictions(details)
    assert found.clickable and found.by_gesture is not None
    counts = np.array(found.by_gesture.counts)
    assert np.trace(counts) / counts.sum() == pytest.approx(accuracy)
    i, j = (int(n) for n in np.argwhere(counts * (1 - np.eye(len(counts), dtype=int)))[0])
    labels = found.by_gesture.labels
    listed = results.misread(row, [labels[i]], [labels[j]])
    assert sum(one.windows for one in listed) == counts[i, j]
    # The recordings were changed since: other ones would be listed.
    append_marks(home / "datasets" / "virtual", [Mark(listed[0].recording, "exclude", "tester", "test")])
    with pytest.raises(DatasetError) as changed:
        StoredResults(Workspace(home)).with_predictions(details)
    assert "was changed since" in str(changed.value)


def test_an_evaluation_has_the_same_figure_everywhere(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("polars")
    folder = home / "datasets" / "virtual"
    assert main(["evaluate", str(folder), "--split", "by-subject:2", "--epochs", "2", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    accuracy, pooled, rest = printed["accuracy"]["mean"], printed["pooled"]["accuracy"], printed["nobody"]["accuracy"]
    # The definition: mean over people, without recordings at rest. The other one is pooled, and is called so.
    predictions = read_predictions(Path(printed["out"]) / "predictions.parquet")
    assert accuracy == pytest.approx(
        accuracy_over_people(predictions.truth, predictions.predicted, predictions.subject)
    )
    assert pooled == pytest.approx((predictions.truth == predictions.predicted).mean())
    assert pooled > accuracy + 0.02, "recordings at rest are easy"
    text = "\n".join(lines(printed))
    assert f"accuracy        {accuracy:.3f} ± " in text
    assert f"pooled windows, with recordings at rest: accuracy {pooled:.3f}" in text
    assert f"without recordings at rest: {printed['nobody']['recordings']} recordings, accuracy {rest:.3f}" in text
    report = Path(printed["report"]).read_text(encoding="utf-8")
    assert f"{accuracy:.3f} ± {printed['accuracy']['sd']:.3f}" in report
    assert "without recordings at rest" in report and "with recordings at rest" in report
    row = row_of(home, EVALUATION)
    assert (row.accuracy, row.rest) == (accuracy, rest)
    assert np.mean([value for _, value in row.people if value is not None]) == pytest.approx(accuracy)
    details = StoredResults(Workspace(home)).details(row)
    assert details.pooled == pooled
    for language, point in (("en", "."), ("lv", ",")):
        w = Words(language)
        shown = f"{accuracy:.3f}".replace(".", point)
        assert figure(w, accuracy) == shown
        assert f"{shown} ± " in figures(w, row) and f"{rest:.3f}".replace(".", point) in figures(w, row)
        assert shown in people_table(w, row)
        assert of_ten(w, accuracy) in headline(w, row) and of_ten(w, 1 / 18) in headline(w, row)
        # Six people: uncertain; and nobody measured what more of them would add.
        assert len(limits(w, row)) == 3
    assert "0.6 of 10" in headline(Words("en"), row) and "0,6 no 10" in headline(Words("lv"), row)
    assert "not measured" in limits(Words("en"), row)[-1]


def test_every_network_whose_predictions_a_sweep_kept_leads_to_its_recordings(
    home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    network = [*keys(architectures="9,5", filters="2", batches="64"), "--epochs", "1", "--workers", "1"]
    folder = home / "datasets" / "virtual"
    assert main(["sweep", str(folder), *network, "--keep-predictions", "all", "--json"]) == 0
    out = Path(json.loads(capsys.readouterr().out)["out"])
    results = StoredResults(Workspace(home))
    rows = [row for row in results.rows() if row.kind == TRIAL and row.path == out]
    assert len(rows) == 2
    for row in rows:
        config = from_settings(**trial_settings(row))
        assert (config.model.arch, config.model.filters, config.training.epochs) == (row.network[0], (2,), 1)
        details = results.details(row)
        assert details.clickable and details.by_gesture is not None
        counts = np.array(details.by_gesture.counts)
        i, j = (int(n) for n in np.argwhere(counts * (1 - np.eye(len(counts), dtype=int)))[0])
        labels = details.by_gesture.labels
        assert sum(r.windows for r in results.misread(row, [labels[i]], [labels[j]])) == counts[i, j]


def test_few_answers_leave_a_wide_interval() -> None:
    # All right, of three people with three recordings each: the mean of the people alone would be certain.
    assert score_interval(1.0, 9, (1.0, 1.0)) == (pytest.approx(0.701, abs=0.001), 1.0)
    assert score_interval(0.0, 9) == (0.0, pytest.approx(0.299, abs=0.001))
    # Of many people, the spread between them decides.
    assert score_interval(0.5, 10_000, (0.4, 0.6)) == (0.4, 0.6)
    assert score_interval(0.5, 0) is None and score_interval(None, 9) is None


def test_a_verdict_names_its_limits(home: Path) -> None:
    row = replace(row_of(home, TRAINING), accuracy=0.42, classes=18)
    w = Words("en")
    assert headline(w, row) == "It reads about 4 of 10 touches of one person it never met; guessing gives 0.6 of 10."
    assert limits(w, row)[0] == "This figure is uncertain: it was measured on only 1 person."
    assert headline(w, replace(row, split="by-recording:5")).startswith(
        "It reads about 4 of 10 moments, with those at rest, of the one person it knows"
    )
    leaky = replace(row, split="windows:5", leaky=True)
    assert "this test is too easy" in headline(w, leaky) and limits(w, leaky) == []
    assert headline(w, replace(row, accuracy=None)).startswith("Nobody has tested this network")
    assert headline(w, replace(row, accuracy=None, kind=TRIAL)) == "This result has no score."
    tested = replace(row, kind=EVALUATION, split="by-subject:5", spread="subjects", units=25, interval=(0.38, 0.46))
    proof = replace(tested, proof=home / "evaluation")
    gain = {"more": 2, "gain": 0.031, "ci95": [0.012, 0.05]}
    assert limits(w, replace(proof, learning=gain)) == [
        "Measured on 25 people. For other people like them, the average is probably between 3.8 and 4.6 of 10 "
        "(95 % interval).",
        "Training with 2 more people would add about 0.3 of 10 (95 % interval: 0.1 to 0.5).",
    ]
    unsure = limits(w, replace(proof, learning=gain | {"ci95": [-0.01, 0.05]}))[-1]
    assert unsure.startswith("Whether training with 2 more people would help cannot be told yet")
    latvian = limits(Words("lv"), replace(proof, learning=gain, units=21))
    assert latvian[0].startswith("Pārbaudē piedalījās 21 cilvēks.") and "vēl 2 cilvēkiem" in latvian[1]
    assert [counted(w, "folds", n) for n in (1, 2)] == ["1 fold", "2 folds"]
    assert [counted(Words("lv"), "folds", n) for n in (1, 2, 11, 21)] == ["1 daļa", "2 daļas", "11 daļas", "21 daļa"]
    assert (w.count(7118), Words("lv").count(7118)) == ("7,118", "7\u00a0118")


def test_the_worst_confusions_come_first() -> None:
    confusion = Confusion(("At rest", "Tail hit 1"), ((8, 2), (5, 5)))
    table = worst_table(Words("en"), confusion, False, clickable=True)
    assert table.index("Tail hit 1 read as At rest") < table.index("At rest read as Tail hit 1")
    assert 'data-cell="1,0"' in table and "50 %" in table
    assert "data-cell" not in worst_table(Words("en"), confusion, False, clickable=False)
    assert 'data-cell="1,0"' in confusion_table(Words("lv"), confusion, False, True)
