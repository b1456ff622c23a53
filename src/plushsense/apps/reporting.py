"""Evaluations on disk, and the page that shows them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from plushsense import __version__
from plushsense.apps.config import RunConfig
from plushsense.apps.places import check_folder
from plushsense.apps.preparation import opened
from plushsense.core.errors import BadInput, ConfigError
from plushsense.dataset.store import Dataset, write_atomically
from plushsense.evaluation.crossval import Evaluation
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.runs.journal import job_id

SCORES, PREDICTIONS, PAGE = "evaluation.json", "predictions.parquet", "report.html"


def evaluation_id(config: RunConfig, dataset: Dataset) -> str:
    """The same for the same settings and data: 20 hexadecimal digits."""
    return job_id({"settings": config.outcome(), "data": dataset.hash})


def check_place(out: Path, config: RunConfig, dataset: Dataset, *, replace: bool = False) -> None:
    """Whether an evaluation may be written to a folder: better asked before hours of training than after.

    Raises:
        ConfigError: where ``out`` is no folder and cannot be one, holds a ``report.html`` of something else, or (not
            with ``replace``) an evaluation of other settings or other data.
    """
    from plushsense.reports.html import check_place as check_page

    check_folder(out, "An evaluation")
    check_page(out / PAGE)
    path = out / SCORES
    if replace or not path.exists():
        return
    held = _evaluation_table(path)
    if held.get("id") == evaluation_id(config, dataset):
        return
    kept = held.get("dataset")
    other = isinstance(kept, Mapping) and kept.get("hash") != dataset.hash
    raise ConfigError(
        f"'{out}' holds an evaluation of {'other data' if other else 'other settings'} "
        f"({held.get('split')}, {held.get('title')}): choose another --out, or --force to replace it."
    )


def save_evaluation(result: Evaluation, dataset: Dataset, config: RunConfig, arch: Arch, out: Path) -> Path:
    """Write ``predictions.parquet`` and ``evaluation.json`` (scores, data set, network, settings) to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    result.write_predictions(out / PREDICTIONS)
    content = {
        **result.to_dict(),
        "predictions": PREDICTIONS,
        "id": evaluation_id(config, dataset),
        "simulated": dataset.head.simulated,
        "validation_decides": config.training.patience is not None,
        "title": evaluation_title(result, arch, config),
        "model": card(arch, rate_hz=dataset.layout.rate_hz),
        "dataset": dataset.summary(),
        "config": config.to_dict(),
        "code_version": __version__,
    }
    path = out / SCORES
    write_atomically(path, json.dumps(content, ensure_ascii=False, indent=1))
    return path


def evaluation_title(result: Evaluation, arch: Arch, config: RunConfig) -> str:
    """A line that tells one evaluation from another."""
    context = f"{result.context} context"
    if result.train_context != result.context:
        context += f", trained on {result.train_context}"
    training = f"{config.preset} training, seed {config.training.seed}"
    return f"{arch.title} {arch.padding}, {result.split.text}, {context}, {training}"


def card(arch: Arch, **more: Any) -> dict[str, Any]:
    """The counts of a network, as a model card and the command line show them."""
    return {
        **arch.to_dict(),
        "parameters": arch.parameters,
        "receptive_field": arch.receptive_field,
        "span": arch.span,
        "macs_per_window": arch.macs_per_window,
        "macs_per_step": arch.macs_per_step,
        "state_bytes_int8": arch.state_bytes_int8,
        "table3": arch.table3,
        **more,
    }


def write_report(
    path: str | os.PathLike[str],
    dataset: Dataset | str | os.PathLike[str],
    evaluations: Sequence[Evaluation | Mapping[str, Any] | str | os.PathLike[str]] = (),
    models: Sequence[Bundle | str | os.PathLike[str]] = (),
    title: str | None = None,
) -> Path:
    """One self-contained HTML page: data set, protocol in words, scores, confusions, curves, model cards.

    Args:
        evaluations: results of `evaluate`, or folders (or files) where they were saved.
        models: bundles, or their paths.
    """
    from plushsense.reports.html import write_report as write_html

    dataset = opened(dataset)
    summary = dataset.summary()
    bundles = [b if isinstance(b, Bundle) else Bundle.load(Path(b)) for b in models]
    cards = [
        card(
            b.arch,
            rate_hz=b.layout.rate_hz,
            name=str(b.provenance.get("name", f"{b.arch.symbol} trained on {b.provenance.get('dataset', '?')}"))
            + (f", adapted to {b.adapted_to}" if b.personal else ""),
            provenance=dict(b.provenance),
        )
        for b in bundles
    ]
    shown = {
        "name": summary["name"],
        "layout": dataset.layout.title,
        "subjects": summary["subjects"],
        "recordings": summary["recordings"],
        "gestures": [f"{g['label']} ({g['recordings']})" for g in summary["gestures"]],
        "streams": summary["streams"],
        "recordings located in a stream": summary["located_in_stream"],
        "warnings": summary["with_warnings"],
        "excluded": summary["excluded"],
        "licence": summary["licence"],
        "hash": summary["hash"],
    }
    return write_html(
        Path(path),
        title=title or f"PlushSense: {summary['name']}",
        dataset=shown,
        evaluations=[_evaluation_table(e) for e in evaluations],
        models=cards,
        simulated=bool(summary["simulated"]),
    )


def is_sweep(folder: str | os.PathLike[str]) -> bool:
    """Whether this is the results folder of a sweep."""
    from plushsense.reports.sweep_results import HEAD

    return (Path(folder) / HEAD).is_file()


def write_sweep_report(
    folder: str | os.PathLike[str],
    page: str | os.PathLike[str] | None = None,
    *,
    title: str | None = None,
    mlflow: str | os.PathLike[str] | None = None,
) -> dict[str, Any]:
    """The page of a sweep with its tables and figures as files, and on wish its finished trials in MLflow.

    Args:
        folder: what ``plushsense sweep`` wrote; it may still be filling.
        page: the .html file (default: ``report.html`` in the folder); its files go into a folder beside it.
        mlflow: a folder or a tracking URI; trials that are there already are not logged again.

    Returns:
        ``report``, ``files`` (the folder), ``trials``, ``done``, ``mlflow`` ({uri, new, before} or None), and
        ``said``, the same in words.
    """
    from plushsense.reports.sweep import write_sweep_report as write_html

    made = write_html(Path(folder), None if page is None else Path(page), title=title)
    said = [f"{len(made.files)} tables and figures in {made.folder}"]
    exported = None
    if mlflow is not None:
        from plushsense.reports.mlflow import export_trials
        from plushsense.reports.sweep_results import read_sweep

        there = export_trials(read_sweep(Path(folder)), mlflow)
        exported = {"uri": there.uri, "experiment": there.experiment, "new": there.new, "before": there.before}
        said.append(f"MLflow: {there.new} trials logged, {there.before} were there already ({there.uri})")
    return {
        "report": str(made.page),
        "files": str(made.folder),
        "trials": made.trials,
        "done": made.done,
        "mlflow": exported,
        "said": said,
    }


def _evaluation_table(given: Evaluation | Mapping[str, Any] | str | os.PathLike[str]) -> dict[str, Any]:
    if isinstance(given, Evaluation):
        return given.to_dict()
    if isinstance(given, Mapping):
        table = dict(given)
    else:
        path = Path(given)
        path = path / SCORES if path.is_dir() else path
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise BadInput(
                f"There is no evaluation at '{path}': make one with  plushsense evaluate ... --out DIR"
            ) from None
        except (OSError, ValueError) as cause:
            raise BadInput(
                f"'{path}' is not an evaluation ({cause}): give a folder that evaluate --out wrote."
            ) from None
        if not isinstance(table, dict):
            raise BadInput(f"'{path}' is not an evaluation: give a folder that evaluate --out wrote.")
    # The page has its own words for the network; the counts stand on the model card.
    table.pop("model", None)
    return table
