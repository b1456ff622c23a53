"""Check folders for results, store evaluations in them, and write reports of evaluations."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, BundleError, ConfigError
from plushsense.core.files import write_file
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.index import as_dataset
from plushsense.dataset.store import Dataset
from plushsense.evaluation.crossval import EvaluationResult
from plushsense.jobs.journal import Journal
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.workflow.preparation import Run


def check_folder(out: Path, name: str) -> None:
    """Raise ConfigError if results cannot be written to the folder ``out``; ``what`` names them, as in "A sweep"."""
    there = next(p for p in (out.absolute(), *out.absolute().parents) if p.exists())
    if not there.is_dir():
        raise ConfigError(
            "{name} cannot be written to '{out}': '{path}' is a file; give a folder.", name=name, out=out, path=there
        )
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(
            "{name} cannot be written to '{out}': you may not write in '{path}'.", name=name, out=out, path=there
        )


def check_results(out: Path, name: str, summary: str, identity: str | None = None, *, replace: bool = False) -> None:
    """Check before the work that its results can be written to the folder ``out``.

    Args:
        name: that of the results in messages, as in "A sweep".
        summary: name of their JSON file, which contains the ``id`` of the results.
        identity: the id of the new results; if None, any earlier results are an error.
        replace: accept a folder with other results.

    Raises:
        ConfigError: if ``out`` cannot be a folder, or has results of other settings or other data.
    """
    check_folder(out, name)
    path = out / summary
    if replace or not path.exists():
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        known = held["id"]
    except (OSError, ValueError, KeyError, TypeError):
        held = known = None
    if identity is None or known != identity:
        details = ", ".join(str(held[key]) for key in ("name", "split") if key in (held or {})) or "unknown"
        other = "already" if identity is None else f"of other settings or other data ({details})"
        raise ConfigError(
            f"'{out}' holds {name[0].lower()}{name[1:]} {other}: choose another --out, or --force to replace it; "
            "finished trainings are kept in the cache of the data set."
        )


def journal_of(dataset: Dataset, kind: str) -> Journal:
    """Return the journal of one kind of results in the data set's cache.

    Writing to it raises ForgottenError if a person was removed since ``dataset`` was opened (`dataset.generation`).
    """
    return Journal(dataset.path / CACHE / kind, dataset.generation.writing)


def keep_bundle(bundle: Bundle, path: Path, dataset: Dataset) -> None:
    """Save a bundle in the cache of its data set; do nothing if that cannot be written, as it can be trained again.

    Raises:
        ForgottenError: like `journal_of`.
    """
    with dataset.generation.writing(), suppress(BundleError):
        bundle.save(path)


def machine(*more: str) -> str:
    """Describe the processor, ``more`` and the operating system, without the host's name."""
    processor = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return ", ".join((processor, *more, platform.system()))


SCORES, PREDICTIONS, PAGE, LEARNING = "evaluation.json", "predictions.parquet", "report.html", "learning.json"


def check_place(out: Path, run: Run, *, replace: bool = False) -> None:
    """Check before the training that an evaluation can be written to a folder.

    Raises:
        ConfigError: if ``out`` is not a folder, has a ``report.html`` that is not a report of PlushSense, or (without
            ``replace``) has an evaluation of other settings or data.
    """
    from plushsense.reports.page import check_page_path

    check_folder(out, "An evaluation")
    check_page_path(out / PAGE)
    path = out / SCORES
    if replace or not path.exists():
        return
    earlier = _evaluation_table(path)
    if earlier.get("id") == run.id:
        return
    data = earlier.get("dataset")
    other = isinstance(data, Mapping) and data.get("hash") != run.dataset.hash
    raise ConfigError(
        "'{out}' contains an evaluation of {more} ({split}, {title}): choose another --out, or --force to replace it.",
        out=out,
        more="other data" if other else "other settings",
        split=earlier.get("split", "no split"),
        title=earlier.get("title", "no title"),
    )


def save_evaluation(result: EvaluationResult, run: Run, out: Path) -> Path:
    """Write ``predictions.parquet`` and ``evaluation.json`` (scores, data set, network, settings) to a folder."""
    out.mkdir(parents=True, exist_ok=True)
    # `forget` finds the people in the scores, so that new predictions must never lie beside scores of other people.
    (out / SCORES).unlink(missing_ok=True)
    result.write_predictions(out / PREDICTIONS)
    content = {
        **result.to_json(),
        "predictions": PREDICTIONS,
        "id": run.id,
        "simulated": run.dataset.head.simulated,
        "validation_decides": run.training.patience is not None,
        "title": evaluation_title(result, run),
        "model": card(run.network, rate_hz=run.dataset.layout.rate_hz),
        "dataset": run.dataset.summary(),
        "config": run.to_json(),
        "code_version": __version__,
    }
    path = out / SCORES
    write_file(path, json.dumps(content, ensure_ascii=False, indent=1))
    return path


def evaluation_title(result: EvaluationResult, run: Run) -> str:
    """Return a title with network, split, contexts, preset, seed, and the settings that differ from the preset's."""
    context = f"{result.context} context"
    if result.train_context != result.context:
        context += f", trained on {result.train_context}"
    parts = (f"{run.network.title} {run.network.padding}", result.split.text, context, f"{run.preset} training")
    return ", ".join(filter(None, (*parts, f"seed {run.training.seed}", run.changes)))


def card(arch: Arch, **more: Any) -> dict[str, object]:
    """Return the symbol and the counts of a network for a model card and the command line.

    With ``rate_hz`` among ``more``, receptive field and span are also given in seconds.
    """
    rate = more.get("rate_hz")
    seconds = {"receptive_field_s": arch.receptive_field / rate, "span_s": arch.span / rate} if rate else {}
    return {
        **arch.to_dict(),
        "pooling": arch.pooling,
        "parameters": arch.parameters,
        "receptive_field": arch.receptive_field,
        "span": arch.span,
        **seconds,
        "macs_per_window": arch.macs_per_window,
        "macs_per_step": arch.macs_per_step,
        "state_bytes_int8": arch.state_bytes_int8,
        "table3": arch.table3,
        **more,
    }


def write_report(
    path: str | os.PathLike[str],
    dataset: Dataset | str | os.PathLike[str],
    evaluations: Sequence[EvaluationResult | Mapping[str, Any] | str | os.PathLike[str]] = (),
    models: Sequence[Bundle | str | os.PathLike[str]] = (),
    title: str | None = None,
    *,
    recordings: bool = False,
    recording: str | None = None,
) -> Path:
    """Write one self-contained HTML page: data set, protocol, scores, confusions, curves, model cards.

    Args:
        evaluations: results of `evaluate`, or the folders or files of saved ones.
        models: bundles, or their paths.
        recordings: also draw the durations of the gestures, and how a recording is cut into windows.
        recording: id of the recording that is shown cut (default: the first short one, and one with several windows).

    Raises:
        DatasetError: for an unknown recording.
    """
    from plushsense.reports.evaluation import write_evaluation_report
    from plushsense.reports.quality import describe_recordings

    dataset = as_dataset(dataset)
    summary = dataset.summary()
    bundles = [b if isinstance(b, Bundle) else Bundle.load(Path(b)) for b in models]
    pictures = describe_recordings(dataset, recording) if recordings else None
    with dataset.generation.writing():
        return write_evaluation_report(
            Path(path),
            title=title or f"PlushSense: {summary['name']}",
            dataset=_properties(summary, dataset.layout.title),
            evaluations=[_evaluation_table(e) for e in evaluations],
            models=[_bundle_card(b) for b in bundles],
            simulated=bool(summary["simulated"]),
            recordings=pictures,
        )


def _bundle_card(bundle: Bundle) -> dict[str, Any]:
    provenance = dict(bundle.provenance)
    name = str(provenance.get("name", f"{bundle.arch.symbol} trained on {provenance.get('dataset', '?')}"))
    adapted = f", adapted to {bundle.adapted_to}" if bundle.personal else ""
    return card(bundle.arch, rate_hz=bundle.layout.rate_hz, name=name + adapted, provenance=provenance)


def _properties(summary: Mapping[str, Any], layout: str) -> dict[str, Any]:
    """Return the facts of a data set that a report lists."""
    return {
        "name": summary["name"],
        "layout": layout,
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


def load_evaluation(source: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a saved evaluation: its folder, or the ``evaluation.json`` in it; ``learning`` is its curve or None.

    Raises:
        BadInput: if there is none.
    """
    path = Path(source)
    path = path / SCORES if path.is_dir() else path
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(table, dict):
            raise ValueError("no JSON object")
    except FileNotFoundError:
        raise BadInput(
            f"There is no evaluation at '{path}': create one with  plushsense evaluate ... --out DIR"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"'{path}' is not an evaluation ({error}): give a folder written by evaluate.") from None
    return table | {"learning": _learning(path.with_name(LEARNING), table.get("id"))}


def _learning(path: Path, identity: object) -> dict[str, Any] | None:
    """Read the curve beside an evaluation (`plushsense.workflow.learning`); None if there is none, or another's."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return table if isinstance(table, dict) and table.pop("id", None) == identity else None


def _evaluation_table(source: EvaluationResult | Mapping[str, Any] | str | os.PathLike[str]) -> dict[str, Any]:
    if isinstance(source, EvaluationResult):
        return source.to_json()
    table = dict(source) if isinstance(source, Mapping) else load_evaluation(source)
    # The title names the network, and the model card shows its numbers.
    table.pop("model", None)
    return table
