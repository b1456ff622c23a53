"""The report of a sweep: one page that mirrors the paper's section 4, its tables as CSV, its figures as PNG and SVG."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from plushsense.reports import figures, words
from plushsense.reports import sweep_compared as compared
from plushsense.reports.beside import files_before, put_files
from plushsense.reports.html import check_place, fill, put_page
from plushsense.reports.sweep_paper import PAPER_TRIALS
from plushsense.reports.sweep_results import Sweep, read_sweep
from plushsense.reports.sweep_sections import Section, sections_of

PAGE, FILES = "report.html", "report-files"
_DPI = 120


@dataclass(frozen=True)
class Written:
    """Where a report is: the page, and the tables and figures as files."""

    page: Path
    folder: Path
    files: tuple[Path, ...]
    done: int
    trials: int


def write_sweep_report(folder: str | Path, page: str | Path | None = None, *, title: str | None = None) -> Written:
    """Write the page of a sweep and, in a folder beside it, each table as CSV and each figure as PNG and SVG.

    Args:
        folder: the results folder that ``plushsense sweep`` wrote; it may still be filling.
        page: the .html file (default: ``report.html`` in the folder); an older report there is replaced.

    Raises:
        BadInput: where there is no sweep; ConfigError: where the page or its files would replace something else.
        MissingExtraError: when polars, jinja2 or matplotlib is not installed.
    """
    sweep = read_sweep(folder)
    target = check_place(Path(page) if page is not None else sweep.folder / PAGE)
    beside = target.parent / (FILES if target.name == PAGE else f"{target.stem}-files")
    before = files_before(beside)
    sections = list(sections_of(sweep))
    drawings = [d for section in sections for d in section.drawings]
    for d in drawings:
        # Laid out once for both formats.
        d.figure.draw_without_rendering()
        d.figure.set_layout_engine("none")
    pictures = {d.name: figures.svg(d.figure) for d in drawings}
    made = dict(_contents(sweep, sections, pictures))
    page_text = render(sweep, sections, pictures, title=title, files=beside.name)
    put_files(beside, made, before)
    put_page(target, page_text)
    return Written(target, beside, tuple(beside / name for name in made), len(sweep.done), sweep.total)


def render(
    sweep: Sweep,
    sections: Sequence[Section],
    pictures: Mapping[str, bytes],
    *,
    title: str | None = None,
    files: str = FILES,
) -> str:
    """The page as one HTML text that asks for nothing outside itself; ``pictures`` are the drawings as SVG by name."""
    return fill(
        "sweep.html.j2",
        title=title or f"Sweep {sweep.name}: {len(sweep.done)} of {sweep.total} trials",
        made=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        simulated=sweep.simulated,
        simulated_title=words.SIMULATED_TITLE,
        simulated_words=words.SIMULATED_WORDS,
        leaky=sweep.leaky,
        leaky_words=words.LEAKY_WORDS,
        done=len(sweep.done),
        total=sweep.total,
        over=words.over_words(sweep.trials),
        about=about_rows(sweep),
        sections=[_shown(section, pictures) for section in sections],
        files=files,
    )


def about_rows(sweep: Sweep) -> list[tuple[str, str]]:
    """What was swept, on which data, as (what, value) pairs."""
    head = sweep.head
    how, who = words.split_words(str(head.get("split")))
    schedules = f"epochs {', '.join(map(str, compared.epochs(sweep)))}; batch {', '.join(compared.batches(sweep))}"
    grid = (
        f"{len(sweep.archs)} architecture{'s' * (len(sweep.archs) != 1)}, "
        f"{len(sweep.filter_sets)} filter set{'s' * (len(sweep.filter_sets) != 1)}; {schedules}"
    )
    waiting = sweep.total - len(sweep.done)
    seconds = head.get("seconds")
    tested = {(r.get("seed"), r.get("fold")): int(r["test_windows"]) for r in sweep.runs if r.get("test_windows")}
    scored = sum(tested.values()) // max(1, len({seed for seed, _ in tested}))
    return [
        ("Data set", words.text(head.get("dataset"))),
        ("Hash (SHA-256)", words.text(head.get("dataset_hash"))),
        ("Split", f"{how} (“{head.get('split')}”{', leaky' if sweep.leaky else ''})"),
        ("Who validates", who),
        ("Windows scored", words.count(scored) if scored else words.DASH),
        ("Context", words.CONTEXT_WORDS.get(str(head.get("context")), words.text(head.get("context")))),
        ("Training preset", words.text(head.get("preset"))),
        ("Padding", ", ".join(sorted({str(t.get("padding")) for t in sweep.trials})) or words.DASH),
        ("Grid", f"{grid} (the paper's has {PAPER_TRIALS} trials)"),
        ("Seeds and folds", words.over_words(sweep.trials)),
        (
            "Trials",
            f"{len(sweep.done)} of {sweep.total} done" + (f", {waiting} waiting or partial" if waiting else ""),
        ),
        ("Classes", words.text(sweep.labels)),
        ("Time", f"{words.number(seconds, 0)} s" if words.number(seconds) != words.DASH else words.DASH),
        ("Machine", words.text(head.get("machine"))),
        ("Code version", words.text(head.get("code_version"))),
    ]


def _shown(section: Section, pictures: Mapping[str, bytes]) -> dict[str, Any]:
    """A section as finished text and pictures."""
    return {
        "key": section.key,
        "title": section.title,
        "scores": section.scores and bool(section.tables or section.drawings),
        "dropped": section.dropped,
        "tables": [
            {
                "title": table.title,
                "columns": table.columns,
                "cells": table.cells(),
                "notes": table.notes,
                "left_out": len(table.rows) - len(table.cells()),
                "file": f"{table.name}.csv",
            }
            for table in section.tables
        ],
        "drawings": [
            {
                "src": "data:image/svg+xml;base64," + base64.b64encode(pictures[d.name]).decode("ascii"),
                "alt": d.alt,
                "name": d.name,
            }
            for d in section.drawings
        ],
    }


def _contents(sweep: Sweep, sections: Sequence[Section], pictures: Mapping[str, bytes]) -> Iterator[tuple[str, bytes]]:
    """Each file's name and content."""
    for section in sections:
        for table in section.tables:
            yield f"{table.name}.csv", table.csv(sweep).encode()
        for d in section.drawings:
            yield f"{d.name}.png", figures.png(d.figure, dpi=_DPI)
            yield f"{d.name}.svg", pictures[d.name]
