"""The report: one HTML file that asks for nothing outside itself."""

from __future__ import annotations

import base64
import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.extras import need
from plushsense.reports import figures, tables, words

ENDINGS = (".html", ".htm")
# What the template writes; a file that has it is a report, and may be replaced by one.
GENERATOR = '<meta name="generator" content="PlushSense">'
_HEAD = 4096


def check_place(path: str | Path) -> Path:
    """The path, when a report may be written there: a new .html file, or the place of an older report.

    Raises:
        ConfigError: for another ending, a folder, or a file that is not a report of PlushSense.
    """
    target = Path(path)
    if target.suffix.lower() not in ENDINGS:
        raise ConfigError(f"A report is an HTML page, and '{target}' does not end in .html or .htm: name it so.")
    if target.is_dir():
        raise ConfigError(f"'{target}' is a folder: name a file in it for the report.")
    if target.exists():
        try:
            with target.open("rb") as file:
                ours = GENERATOR.encode() in file.read(_HEAD)
        except OSError as cause:
            raise ConfigError(
                f"'{target}' is there and cannot be read ({cause.strerror}): name another file."
            ) from cause
        if not ours:
            raise ConfigError(f"'{target}' is there and is not a report of PlushSense: name another file.")
    return target


def write_report(
    path: str | Path,
    *,
    title: str,
    dataset: Mapping[str, Any],
    evaluations: Sequence[Mapping[str, Any]],
    models: Sequence[Mapping[str, Any]],
    simulated: bool,
) -> Path:
    """Write one self-contained HTML report and return its path; an older report is replaced in one step.

    Args:
        path: the .html file to write; its folder is made.
        title: shown on top.
        dataset: name, subjects, recordings, gestures, streams, layout, licence, hash, warnings (numbers or
            lists).
        evaluations: ``Evaluation.to_dict()`` each; ``title`` and ``model`` may be added to name it, ``simulated``
            and ``dataset`` (name, hash) to say what it was made on.
        models: one model card each (symbol, filters, …, provenance); ``title`` may be added.
        simulated: whether the data set is a simulation. It, or any evaluation or model that says so, puts a
            banner on top; every table of simulated scores is marked.

    Every key may be missing: the report shows a dash. All texts are escaped.

    Raises:
        ConfigError: when the file cannot be written, or is there and is no report.
        MissingExtraError: when jinja2 or matplotlib is not installed.
    """
    target = check_place(path)
    page = render(title=title, dataset=dataset, evaluations=evaluations, models=models, simulated=simulated)
    return put_page(target, page)


def put_page(target: Path, page: str) -> Path:
    """Write a page to a place that `check_place` allowed, in one step.

    Raises:
        ConfigError: when the disk refuses.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        draft = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
        try:
            draft.write_text(page, encoding="utf-8", newline="\n")
            draft.replace(target)
        finally:
            draft.unlink(missing_ok=True)
    except OSError as cause:
        raise ConfigError(
            f"The report '{target}' cannot be written ({cause.strerror}): name a file where you may write."
        ) from cause
    return target


def render(
    *,
    title: str,
    dataset: Mapping[str, Any],
    evaluations: Sequence[Mapping[str, Any]],
    models: Sequence[Mapping[str, Any]],
    simulated: bool,
) -> str:
    """The report as one HTML text; arguments as in ``write_report``."""
    named = [
        {
            **evaluation,
            "title": words.title_of(evaluation),
            "simulated": words.simulated(evaluation, simulated),
            "foreign": words.foreign_words(evaluation, dataset),
        }
        for evaluation in evaluations
    ]
    cards = [_model(model) for model in models]
    # Wholly: tables say it once, on top. Partly: every simulated row bears a mark.
    wholly = simulated and all(evaluation["simulated"] for evaluation in named)
    any_simulated = simulated or any(part["simulated"] for part in (*named, *cards))
    return fill(
        "report.html.j2",
        title=title,
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        simulated=any_simulated,
        wholly_simulated=wholly,
        simulated_title=words.SIMULATED_TITLE if wholly else words.PARTLY_SIMULATED_TITLE,
        simulated_words=words.SIMULATED_WORDS if wholly else words.PARTLY_SIMULATED_WORDS,
        leaky_words=words.LEAKY_WORDS,
        any_leaky=any(evaluation.get("leaky") for evaluation in named),
        dataset=tables.dataset_rows(dataset),
        comparison=tables.comparison_rows(named),
        subjects=tables.subject_rows(named),
        evaluations=[_evaluation(f"E{i}", evaluation) for i, evaluation in enumerate(named, start=1)],
        models=cards,
        contexts=words.CONTEXT_WORDS,
    )


def fill(template: str, **values: Any) -> str:
    """A page from one of the templates beside this file, in the style of all pages; texts are escaped.

    Raises:
        MissingExtraError: when jinja2 is not installed.
    """
    jinja2 = need("jinja2", "reports")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    room = resources.files("plushsense.reports")
    style = need("markupsafe", "reports").Markup(room.joinpath("page.css").read_text(encoding="utf-8"))
    page: str = environment.from_string(room.joinpath(template).read_text(encoding="utf-8")).render(
        style=style, **values
    )
    return page


def _evaluation(key: str, evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """What the page shows of one evaluation, as finished text."""
    nobody = evaluation.get("nobody")
    return {
        "key": key,
        "title": evaluation["title"],
        "leaky": bool(evaluation.get("leaky")),
        "simulated": bool(evaluation["simulated"]),
        "foreign": evaluation["foreign"],
        "protocol": words.protocol(evaluation),
        "spread": words.spread_words(evaluation),
        "metrics": tables.metric_rows(evaluation),
        "contexts": tables.context_rows(evaluation),
        "deployed": tables.deployed_rows(evaluation),
        "nobody": None
        if not nobody
        else {name: words.count(nobody.get(name)) for name in ("recordings", "windows")}
        | {"accuracy": words.number(nobody.get("accuracy"))},
        "classes": tables.class_rows(evaluation),
        "confusions": [
            (name, table)
            for name, table in (
                ("by gesture", tables.confusion_rows(evaluation.get("confusion"))),
                ("by affect", tables.confusion_rows(evaluation.get("confusion_affect"))),
            )
            if table and len(table["labels"]) > 1
        ],
        "curves": _curves(evaluation.get("histories")),
        "predictions": evaluation.get("predictions"),
    }


def _curves(histories: Any) -> str | None:
    """Training curves as a data URI; None when no fold kept its history."""
    kept = [history for history in histories or () if history]
    if not kept:
        return None
    return "data:image/svg+xml;base64," + base64.b64encode(figures.svg(figures.training_curves(kept))).decode("ascii")


def _model(model: Mapping[str, Any]) -> dict[str, Any]:
    symbol, filters = words.text(model.get("symbol")), words.text(model.get("filters"))
    return {
        "title": str(model.get("title") or f"{symbol}, filters {filters}"),
        "rows": tables.model_rows(model),
        "simulated": (model.get("provenance") or {}).get("simulated") is True,
        "streams": model.get("padding") == "stream",
        "padding": words.text(model.get("padding")),
    }
