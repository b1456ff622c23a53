"""The train page's plain parts: from a form to work, from files to rows, from reports to curves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.cli.main import main
from plushsense.core.errors import BadInput, ConfigError, PlushSenseError
from plushsense.evaluation.scores import Predictions
from plushsense.models.bundle import Bundle
from plushsense.studio.app.jobs import Jobs, StudioJob
from plushsense.studio.app.stored_results import (
    TRAINING,
    Confusion,
    StoredResults,
    over_trainings,
    recordings_of_cell,
    sum_by_affect,
)
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.train.job_cards import progress_charts
from plushsense.studio.pages.train.job_requests import JobRequest, free_name, grids, job_request
from plushsense.studio.pages.train.results_section import comparable_groups, pareto_options, pareto_rows, pareto_table
from plushsense.studio.tasks import Clock
from plushsense.workflow.config import from_settings
from support.results import row


def made(workspace: Workspace, **form: Any) -> JobRequest:
    return job_request(workspace, Jobs(workspace), {"dataset": str(workspace.datasets()[0]), **form})


# From a form to work ------------------------------------------------------------------------------------------


def test_the_command_resolves_to_the_same_settings(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = Workspace(home)
    form = {"kind": "train", "name": "new one", "preset": "loso", "context": "anywhere", "epochs": 7, "seed": 3}
    form |= {"arch": "14d1_19d2", "filters": "8,12", "padding": "", "classes": "all", "batch": 32, "device": "cpu"}
    found = made(workspace, **form, quantize_aware=2, fit_decisions=False)
    seen: list[Any] = []

    def train(dataset: str, config: Any, **more: Any) -> None:
        seen.append((dataset, config, more["quantize_aware"], more["fit_decisions"]))
        raise ConfigError("seen")

    monkeypatch.setattr("plushsense.workflow.api.train", train)
    import shlex

    assert main(shlex.split(found.command)[1:]) == 2
    assert seen == [(found.spec["dataset"], from_settings(**found.spec["settings"]), 2, False)]
    assert found.spec["out"] == str(home / "bundles" / "new one.plush")


def test_find_a_small_network_is_a_sweep_with_halving(home: Path) -> None:
    found = made(Workspace(home), kind="search", max_parameters=1400, share="0,5", seeds=2)
    assert found.command.endswith("--grid people --seeds 2 --halving --max-parameters 1400 --share 0.5")
    assert " sweep " in found.command and found.spec["grid"] == "people"
    assert found.spec["changes"] == {"seeds": [0, 1], "max_parameters": 1400, "share": 0.5, "halving": True}


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ({"kind": "train", "name": "little"}, "“little” exists already"),
        ({"kind": "train", "name": "../x"}, "cannot be a name"),
        ({"kind": "train", "name": "n", "epochs": "many"}, "whole number from 1"),
        ({"kind": "train", "name": "n", "epochs": 0}, "whole number from 1"),
        ({"kind": "train", "name": "n", "arch": "14x"}, "This is no network"),
        ({"kind": "train", "name": "n", "preset": "pepole"}, "people"),
        ({"kind": "train", "name": "n", "quantize_aware": -1}, "whole number from 0"),
        ({"kind": "train", "name": "n", "quantize_aware": "many"}, "whole number from 0"),
        ({"kind": "evaluate", "split": "by-people:5"}, "split"),
        ({"kind": "sweep", "seeds": "many"}, "whole number from 1"),
        ({"kind": "sweep", "seeds": 0}, "whole number from 1"),
        ({"kind": "search", "max_parameters": "few"}, "whole number from 1"),
        ({"kind": "search", "share": "half"}, "above 0 and at most 1"),
        ({"kind": "search", "share": "nan"}, "above 0 and at most 1"),
        ({"kind": "sweep", "grid": "/etc/passwd"}, "not in the studio's folder"),
        ({"kind": "train", "name": "n", "dataset": "/tmp"}, "not in the studio's folder"),
        ({"kind": "train", "name": "n", "dataset": "datasets/gone"}, "does not exist any more"),
        ({"kind": "train", "name": "n", "dataset": ""}, "No data set is chosen"),
        ({"kind": "train", "name": "n", "filters": "8;12"}, "separated by commas"),
        ({"kind": "make", "minutes": "ten"}, "whole number from 1"),
        ({"kind": "make", "minutes": 0}, "whole number from 1"),
    ],
)
def test_what_cannot_be_done_is_a_sentence(home: Path, form: dict[str, Any], said: str) -> None:
    workspace = Workspace(home)
    with pytest.raises(PlushSenseError, match=said) as caught:
        made(workspace, **form)
    if form.get("preset", form.get("split")) is None:
        # Every error that a person can provoke, in their language and beside the field.
        latvian = Words("lv").error(caught.value)
        assert "angliski" not in latvian
        assert "path" in caught.value.message.values or caught.value.message.values["field"] in {*form, "dataset"}


def test_the_same_work_is_not_begun_twice(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = Workspace(home)
    jobs = Jobs(workspace)
    monkeypatch.setattr(jobs, "_run", lambda job: None)
    form = {"dataset": str(workspace.datasets()[0]), "kind": "train", "name": "one"}
    first = job_request(workspace, jobs, form)
    jobs.start(first.task, first.spec, first.title)
    with pytest.raises(ConfigError, match="“one” is being trained now"):
        job_request(workspace, jobs, form)
    again = {"dataset": form["dataset"], "kind": "evaluate", "split": "by-subject:5"}
    proof = job_request(workspace, jobs, again)
    jobs.start(proof.task, proof.spec | {"dry": True}, proof.title)
    job_request(workspace, jobs, again)
    jobs.start(proof.task, proof.spec, proof.title)
    with pytest.raises(ConfigError, match="running already"):
        job_request(workspace, jobs, again)
    usual = {"dataset": form["dataset"], "kind": "make", "minutes": 10}
    network = job_request(workspace, jobs, usual)
    assert network.spec["out"] == str(home / "bundles" / "virtual toy.plush")
    jobs.start(network.task, network.spec, network.title)
    with pytest.raises(ConfigError, match="running already"):
        job_request(workspace, jobs, usual)


def test_names_and_grids(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = Workspace(home)
    jobs = Jobs(workspace)
    monkeypatch.setattr(jobs, "_run", lambda job: None)
    assert free_name(workspace, jobs, "little") == "little 2"
    jobs.start("train", {"out": str(home / "bundles" / "little 2.plush")}, "")
    assert free_name(workspace, jobs, "little") == "little 3"
    assert free_name(workspace, jobs, "a/b: ž") == "ab ž"
    assert free_name(workspace, jobs, "///") == "model"
    (home / "grids").mkdir()
    (home / "grids" / "b.toml").touch()
    (home / "a.toml").touch()
    assert [path.name for path in grids(workspace)] == ["a.toml", "b.toml"]


def test_without_torch_the_task_says_what_to_install(home: Path, tmp_path: Path) -> None:
    blocked = tmp_path / "blocked" / "torch"
    blocked.mkdir(parents=True)
    blocked.joinpath("__init__.py").write_text("raise ModuleNotFoundError('no torch', name='torch')", encoding="utf-8")
    spec = made(Workspace(home), kind="train", name="x").spec
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(blocked.parent), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "plushsense.studio.tasks"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env) as worker:
        assert worker.stdin is not None and worker.stdout is not None
        worker.stdin.write(json.dumps({"task": "train", "spec": spec}) + "\n")
        worker.stdin.flush()
        said = next(
            message["refused"]["message"] for line in worker.stdout if "refused" in (message := json.loads(line))
        )
    assert "'torch', which is not installed: run  pip install 'plushsense[train]'" in said


# Telling ------------------------------------------------------------------------------------------------------


def test_the_clock_does_not_count_what_was_done_before(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("plushsense.studio.tasks.time.monotonic", lambda: now[0])
    clock = Clock()
    # Half of it comes at once from the journal, then a tenth each 10 s.
    assert clock.at(0.1)["left_s"] is None
    for share in (0.2, 0.3, 0.4, 0.5):
        now[0] += 0.001
        clock.at(share)
    now[0] += 10.0
    assert clock.at(0.6) == {"share": 0.6, "left_s": 40.0}
    now[0] += 10.0
    assert clock.at(0.7)["left_s"] == 30.0


def job(task: str, reports: list[dict[str, Any]]) -> StudioJob:
    return StudioJob("1", task, {}, "", reports=reports)


def test_curves_of_a_training() -> None:
    rows = [
        {"stage": "training", "epoch": e, "train_loss": 1 / e, "validation_loss": None, "accuracy": 0.1 * e}
        for e in (1, 2, 3)
    ]
    loss, accuracy = progress_charts(job("train", [{"stage": "reading"}, *rows, {"stage": "deciding", "epoch": 3}]))
    assert (loss.metric, loss.x, loss.lines[0]) == ("loss", [1.0, 2.0, 3.0], [1.0, 0.5, 1 / 3])
    assert loss.lines[1] == [None, None, None]
    # The accuracy of validation is the one that is counted like the score.
    assert accuracy.lines == [[None] * 3, pytest.approx([0.1, 0.2, 0.3])]


def test_curves_of_folds_and_of_a_search() -> None:
    folds = [{"fold": "a", "epoch": 1, "train_loss": 3.0}, {"fold": "b", "epoch": 1, "train_loss": 4.0}]
    folds += [{"fold": "a", "epoch": 2, "train_loss": 2.0}, {"fold": "a", "epoch": 0, "train_loss": None}]
    (loss,) = progress_charts(job("evaluate", folds))
    assert (loss.x, loss.lines) == ([1.0, 2.0], [[3.5, 2.0]])
    at = [{"rung": 1, "done": 4, "best": None}, {"rung": 2, "done": 1, "best": {"macro_f1": 0.3}}]
    at += [{"rung": 2, "done": 2, "best": {"macro_f1": 0.3}}, {"rung": 3, "done": 1, "best": {"macro_f1": 0.5}}]
    (best,) = progress_charts(job("search", at))
    assert (best.x, best.lines) == ([1.0, 2.0, 3.0], [[0.3, 0.3, 0.5]])


# Results ------------------------------------------------------------------------------------------------------


def test_the_front_holds_what_none_beats() -> None:
    rows = [row("a", 100, 0.5), row("b", 200, 0.4), row("c", 300, 0.7), row("d", 300, 0.6), row("e", 50, None)]
    rows += [row("f", 400, 0.7)]
    assert [r.id for r in pareto_rows(rows)] == ["a", "c"]
    # By definition: nobody has at most as many parameters and at least as good a score, and one of them better.
    for r in rows:
        beaten = any(
            o.macro_f1 is not None
            and r.macro_f1 is not None
            and o.parameters <= r.parameters
            and o.macro_f1 >= r.macro_f1
            and (o.parameters, o.macro_f1) != (r.parameters, r.macro_f1)
            for o in rows
        )
        assert (r in pareto_rows(rows)) == (not beaten and r.macro_f1 is not None), r.id


def test_only_the_same_people_and_gestures_are_compared() -> None:
    # Two seeds hold other people back; the data set was changed between the last two.
    rows = [replace(row(f"{i}", 100 + i, 0.5), kind=TRAINING, data="d", apart=("h", "S01")) for i in range(2)]
    rows += [replace(row(f"other {i}", 10, 0.9), kind=TRAINING, data="d", apart=("h", "S02")) for i in range(3)]
    rows += [replace(row("changed", 1, 1.0), kind=TRAINING, data="d", apart=("i", "S01"))]
    found = comparable_groups(Words("en"), rows)
    assert [sorted(r.id for r in several) for several in found.values()] == [
        ["0", "1"],
        ["other 0", "other 1", "other 2"],
    ]
    assert list(found) == ["d · training ·  · ", "d · training ·  ·  (2)"]


def test_what_a_trials_spread_goes_over() -> None:
    assert over_trainings({"folds": "5", "seeds": "1"}) == ("folds", 5)
    assert over_trainings({"folds": 1, "seeds": 3}) == ("trainings", 3)
    assert over_trainings({"folds": 5, "seeds": 3}) == ("trainings", 15)


def test_the_plot_labels_every_point_and_marks_leaky_ones() -> None:
    rows = [replace(row(f"net <{i}> 8/8 stream", 1000 * 3**i, 0.2 + 0.1 * i), leaky=i == 0) for i in range(4)]
    bars, front, points = pareto_options(Words("en"), rows)["series"]
    assert [p["name"] for p in points["data"]] == ["net <0> 8/8,  (leaky)", *(f"net <{i}> 8/8, " for i in range(1, 4))]
    assert [p["symbol"] for p in points["data"]] == ["diamond", "circle", "circle", "circle"]
    assert points["labelLayout"] == {"hideOverlap": True}
    assert front["data"] == [[r.parameters, r.macro_f1] for r in rows]
    assert bars["data"][:2] == [[1000, pytest.approx(0.19)], [1000, pytest.approx(0.21)]]
    # Points on one spot can be plotted as well.
    assert len(pareto_options(Words("lv"), rows[:1] * 3)["series"][2]["data"]) == 3
    # The text alternative holds the same data and escapes it.
    table = pareto_table(Words("en"), rows)
    assert table.count("<tr>") == 5
    assert "net &lt;3&gt; 8/8 stream" in table
    assert "27,000" in table
    assert "0.500 ± 0.010" in table


def test_the_recordings_of_a_cell() -> None:
    labels = ("a", "b")
    probabilities = np.array([[0.9, 0.1], [0.2, 0.8], [0.1, 0.9], [0.3, 0.7], [0.8, 0.2]], dtype=np.float32)
    found = Predictions(
        labels, np.array(["P1", "P1", "P1", "P2", "P2"]), np.array(["r1", "r1", "r1", "r2", "r3"]),
        np.arange(5), np.array(["loop"] * 5), np.array(["f"] * 5), np.array([0, 0, 0, 0, 1]), probabilities,
    )  # fmt: skip
    assert [(m.recording, m.windows, m.of, m.predicted) for m in recordings_of_cell(found, ["a"], ["b"])] == [
        ("r1", 2, 3, ("b",)), ("r2", 1, 1, ("b",)),
    ]  # fmt: skip
    assert [m.recording for m in recordings_of_cell(found, ["b"], ["a", "b"])] == ["r3"]
    assert recordings_of_cell(found, ["b"], ["b"]) == []


def test_affects_are_summed() -> None:
    found = sum_by_affect(
        Confusion(("a", "b", "c"), ((1, 2, 3), (4, 5, 6), (7, 8, 9))), {"a": "x", "b": None, "c": "x"}
    )
    assert found == Confusion(("x", "none"), ((20, 10), (10, 5)))


def test_rows_of_a_house_and_what_is_broken(home: Path) -> None:
    workspace = Workspace(home)
    results = StoredResults(workspace)
    (only,) = results.rows()
    assert (only.kind, only.simulated, only.leaky, only.context) == (TRAINING, True, False, "anywhere → stream")
    assert only.dataset == str(home / "datasets" / "virtual")
    assert results.details(only).facts["fitted"]
    for name, content in (("broken", "{"), ("other", "[1]"), ("older", '{"split": "by-subject:2"}')):
        folder = home / "datasets" / "virtual" / "evaluations" / name
        folder.mkdir(parents=True)
        folder.joinpath("evaluation.json").write_text(content, encoding="utf-8")
    (home / "bundles" / "cut.plush").write_bytes(b"abc")
    assert results.rows() == [only]
    assert (only.spread, only.units) == ("held_back", 1)
    bundle = Bundle.load(only.path)
    same = replace(bundle, provenance={**bundle.provenance, "scores": {"split": "windows:holdout"}})
    same.save(home / "bundles" / "same.plush")
    # Its people were trained on, too: nobody was held back.
    assert [(r.spread, r.units) for r in results.rows() if r.split == "windows:holdout"] == [("trainings", 1)]
    (home / "bundles" / "same.plush").unlink()
    only.path.unlink()
    assert results.rows() == []
    with pytest.raises(BadInput, match="does not exist any more"):
        results.row(only.id)
