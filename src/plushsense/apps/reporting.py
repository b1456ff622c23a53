"""Evaluations on disk, and the page that shows them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from plushsense import __version__
from plushsense.apps.config import RunConfig
from plushsense.apps.preparation import opened
from plushsense.core.errors import BadInput
from plushsense.dataset.store import Dataset, write_atomically
from plushsense.evaluation.crossval import Evaluation
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle


def save_evaluation(result: Evaluation, dataset: Dataset, config: RunConfig, arch: Arch, out: Path) -> Path:
    """Write ``predictions.parquet`` and ``evaluation.json`` (scores, data set, network, settings) to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    result.write_predictions(out / "predictions.parquet")
    content = {
        **result.to_dict(),
        "predictions": "predictions.parquet",
        "validation_decides": config.training.patience is not None,
        "title": evaluation_title(result, arch),
        "model": card(arch, dataset.layout.rate_hz),
        "dataset": dataset.summary(),
        "config": config.to_dict(),
        "code_version": __version__,
    }
    path = out / "evaluation.json"
    write_atomically(path, json.dumps(content, ensure_ascii=False, indent=1))
    return path


def evaluation_title(result: Evaluation, arch: Arch) -> str:
    """A line that tells one evaluation from another."""
    filters = "/".join(map(str, arch.filters))
    context = f"{result.context} context"
    if result.train_context != result.context:
        context += f", trained on {result.train_context}"
    return f"{arch.symbol} {filters} {arch.padding}, {context}"


def card(arch: Arch, rate_hz: float, **more: Any) -> dict[str, Any]:
    """The counts of a network, as a model card shows them."""
    return {
        **arch.to_dict(),
        "parameters": arch.parameters,
        "receptive_field": arch.receptive_field,
        "span": arch.span,
        "macs_per_window": arch.macs_per_window,
        "macs_per_step": arch.macs_per_step,
        "state_bytes_int8": arch.state_bytes_int8,
        "rate_hz": rate_hz,
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
            b.layout.rate_hz,
            name=str(b.provenance.get("name", f"{b.arch.symbol} trained on {b.provenance.get('dataset', '?')}")),
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
        simulated=bool(summary["simulated"]) or any(b.provenance.get("simulated") for b in bundles),
    )


def _evaluation_table(given: Evaluation | Mapping[str, Any] | str | os.PathLike[str]) -> dict[str, Any]:
    if isinstance(given, Evaluation):
        return given.to_dict()
    if isinstance(given, Mapping):
        table = dict(given)
    else:
        path = Path(given)
        path = path / "evaluation.json" if path.is_dir() else path
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
    # The page has its own words for the network; the counts stand on the model card.
    table.pop("model", None)
    return table
