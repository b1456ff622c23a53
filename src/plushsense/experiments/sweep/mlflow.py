"""Export the finished trials of a sweep as runs to MLflow, for users who keep their experiments there."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, need
from plushsense.experiments.sweep.results import StoredSweep, finite
from plushsense.experiments.sweep.trials import TRIAL_COLUMNS
from plushsense.reports.table import Row

TRIAL = "plushsense.trial"
_PARAMS = ("arch", "filters", "filter_set", "padding", "norm", "epochs", "batch", "batch_asked", "seeds", "folds")
_METRICS = tuple(key for key, c in TRIAL_COLUMNS.items() if c.type in (int, float) and key not in _PARAMS)
_PAGE = 1000


@dataclass(frozen=True)
class MlflowResult:
    """Where trials were logged, and how many now (``new``) and earlier (``before``)."""

    uri: str
    experiment: str
    new: int
    before: int


def export_trials(sweep: StoredSweep, where: str | os.PathLike[str]) -> MlflowResult:
    """Log each complete trial as a run, unless an earlier export has logged it.

    Args:
        where: a tracking URI (``sqlite:///…``, ``http://…``), or a folder, in which ``mlflow.db`` is created.

    Raises:
        ConfigError: when MLflow cannot use ``where``; MissingExtraError: when it is not installed.
    """
    # MLflow must send data nowhere but to ``where``.
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    os.environ.setdefault("DO_NOT_TRACK", "true")
    mlflow = need("mlflow", "mlflow")
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    uri, artifacts = _place(os.fspath(where))
    if uri.startswith("sqlite:"):
        need("sqlalchemy", "mlflow")
        need("alembic", "mlflow")
    title = f"plushsense sweep {sweep.name}"
    try:
        client = mlflow.MlflowClient(tracking_uri=uri)
        existing = client.get_experiment_by_name(title)
        experiment = (
            existing.experiment_id if existing else client.create_experiment(title, artifact_location=artifacts)
        )
        there = _there(client, experiment)
        finished = [t for t in sweep.done if there.get(str(t["trial"]), ("", ""))[1] != "FINISHED"]
        for trial in finished:
            run = there.get(str(trial["trial"]), ("", ""))[0]
            _log(mlflow, client, experiment, run, sweep, trial)
    except (mlflow.exceptions.MlflowException, OSError) as cause:
        reason = str(cause).splitlines()[0].split(". ")[0].rstrip(".") if str(cause) else type(cause).__name__
        raise ConfigError(
            f"MLflow refuses '{where}' ({reason}): give a folder, or a URI such as sqlite:///x.db."
        ) from None
    return MlflowResult(uri, title, len(finished), len(sweep.done) - len(finished))


def _place(where: str) -> tuple[str, str | None]:
    """Return the tracking URI and, for a folder, which is created, the URI of its artifacts."""
    if "://" in where:
        return where, None
    folder = Path(where).absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise ConfigError(
            f"'{where}' cannot be a folder for MLflow ({cause.strerror or cause}): give another."
        ) from None
    return f"sqlite:///{(folder / 'mlflow.db').as_posix()}", (folder / "artifacts").as_uri()


def _there(client: Any, experiment: str) -> dict[str, tuple[str, str]]:
    """Return (run id, status) by trial for the trials that already have a run."""
    runs: dict[str, tuple[str, str]] = {}
    token = None
    while True:
        page = client.search_runs([experiment], max_results=_PAGE, page_token=token)
        for run in page:
            trial = run.data.tags.get(TRIAL)
            if trial and runs.get(trial, ("", ""))[1] != "FINISHED":
                runs[trial] = (run.info.run_id, run.info.status)
        token = page.token
        if not token:
            return runs


def _log(mlflow: Any, client: Any, experiment: str, run: str, sweep: StoredSweep, trial: Row) -> None:
    """Log a trial as one run; ``run`` is the id of an unfinished run of an earlier export to complete, or ""."""
    entities, head = mlflow.entities, sweep.head
    marks = " [leaky]" * sweep.leaky + " [simulation]" * sweep.simulated
    tags = {
        TRIAL: trial["trial"],
        "plushsense.dataset_hash": head.get("dataset_hash"),
        "plushsense.leaky": "yes" if sweep.leaky else "no",
        "plushsense.simulated": "yes" if sweep.simulated else "no",
        "plushsense.code_version": head.get("code_version"),
        "plushsense.machine": head.get("machine"),
    }
    params = {key: trial.get(key) for key in _PARAMS} | {
        key: head.get(key) for key in ("dataset", "split", "context", "preset")
    }
    if not run:
        name = f"{trial['arch']} {trial['filters']} e{trial['epochs']} b{trial['batch_asked']}{marks}"
        made = client.create_run(experiment, run_name=name, tags={TRIAL: str(trial["trial"])})
        run = made.info.run_id
    now = int(time.time() * 1000)
    client.log_batch(
        run,
        metrics=[entities.Metric(key, float(trial[key]), now, 0) for key in _METRICS if finite(trial.get(key))],
        params=[entities.Param(key, str(value)) for key, value in params.items() if value is not None],
        tags=[entities.RunTag(key, str(value)) for key, value in tags.items()],
    )
    client.set_terminated(run, status="FINISHED")
