"""Finished trials as MLflow runs: each once, in a local store, with what their scores are of."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError, MissingExtraError
from plushsense.experiments.sweep.mlflow import TRIAL, export_trials
from plushsense.experiments.sweep.results import read_sweep
from support.made_sweep import make_sweep

pytestmark = pytest.mark.apart("cluster")

GRID = {"archs": ("250",), "filter_sets": ((4, 6, 8, 8),), "epochs": (5, 9), "batches": ("64", "full")}


def test_each_finished_trial_is_logged_once(tmp_path: Path, mlflow_here: None) -> None:
    import polars

    folder = make_sweep(tmp_path / "S", **GRID, simulated=True)  # type: ignore[arg-type]
    whole = polars.read_parquet(folder / "trials.parquet")
    waiting = polars.when(polars.int_range(polars.len()) == 0)
    whole.with_columns(
        accuracy=waiting.then(None).otherwise("accuracy"),
        status=waiting.then(polars.lit("waiting")).otherwise("status"),
    ).write_parquet(folder / "trials.parquet")
    first = export_trials(read_sweep(folder), tmp_path / "store")
    assert (first.new, first.before) == (3, 0)
    again = export_trials(read_sweep(folder), tmp_path / "store")
    assert (again.new, again.before) == (0, 3)
    whole.write_parquet(folder / "trials.parquet")
    import mlflow

    client = mlflow.MlflowClient(tracking_uri=first.uri)
    experiment = client.get_experiment_by_name(first.experiment)
    last = whole["trial"][0]
    half = client.create_run(experiment.experiment_id, tags={TRIAL: last})
    grown = export_trials(read_sweep(folder), tmp_path / "store")
    assert (grown.new, grown.before) == (1, 3), "a run that was left unfinished is completed, not logged twice"
    runs = client.search_runs([experiment.experiment_id])
    assert sorted(r.data.tags[TRIAL] for r in runs) == sorted(whole["trial"])
    assert client.get_run(half.info.run_id).info.status == "FINISHED"
    for run in runs:
        row = whole.filter(polars.col("trial") == run.data.tags[TRIAL]).to_dicts()[0]
        assert run.data.metrics["accuracy"] == pytest.approx(row["accuracy"])
        assert (run.data.params["epochs"], run.data.params["batch_asked"]) == (str(row["epochs"]), row["batch_asked"])
        assert run.data.params["split"] == "windows:holdout"
        assert (run.data.tags["plushsense.leaky"], run.data.tags["plushsense.simulated"]) == ("yes", "yes")


def test_a_place_that_mlflow_refuses_is_one_sentence(tmp_path: Path, mlflow_here: None) -> None:
    sweep = read_sweep(make_sweep(tmp_path / "S", **GRID))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="MLflow refuses 'nonsense://x'"):
        export_trials(sweep, "nonsense://x")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match="cannot be a folder"):
        export_trials(sweep, tmp_path / "file")


@pytest.mark.skipif(importlib.util.find_spec("mlflow") is not None, reason="MLflow is installed")
def test_without_mlflow_the_command_that_installs_it_is_named(tmp_path: Path) -> None:
    sweep = read_sweep(make_sweep(tmp_path / "S", **GRID))  # type: ignore[arg-type]
    with pytest.raises(MissingExtraError, match=r"plushsense\[mlflow\]"):
        export_trials(sweep, tmp_path / "store")
