"""Render self-contained HTML pages, and write them without replacing files that are not reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError
from plushsense.core.files import check_output_file, write_file
from plushsense.core.templates import fill_html

ENDINGS = (".html", ".htm")
_PACKAGE = "plushsense.reports"
# Tag that the base template contains; an existing file is replaced only if it has this tag.
GENERATOR = '<meta name="generator" content="PlushSense">'


def render_page(template: str, **values: Any) -> str:
    """Render a page in the common style; texts are escaped.

    Args:
        template: file name of a template of this package, which extends ``base.html.j2``.
        values: for the template; ``title`` and ``simulated`` are required, ``made`` defaults to the current time.
    """
    from markupsafe import Markup

    style = resources.files(_PACKAGE).joinpath("page.css").read_text(encoding="utf-8")
    made = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    return fill_html(_PACKAGE, template, **{"made": made, "style": Markup(style)} | values)


def check_page_path(path: str | Path) -> Path:
    """Check that a report can be written to a path, as a new .html or .htm file or over an earlier report; return it.

    Raises:
        ConfigError: for another ending, a folder, or a file that is not a report of PlushSense.
    """
    target = Path(path)
    if target.suffix.lower() not in ENDINGS:
        raise ConfigError(f"'{target}' does not end in .html or .htm, and a report is an HTML page: change the name.")
    check_output_file(target, GENERATOR, "a report of PlushSense", ConfigError)
    return target


def write_page(target: Path, page: str) -> Path:
    """Write a page in one step to a path that `check_page_path` has accepted.

    Raises:
        ConfigError: when the file cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_file(target, page)
    except OSError as cause:
        raise ConfigError(
            f"The report '{target}' cannot be written ({cause.strerror or cause}): give a file in a folder "
            f"where you may write."
        ) from cause
    return target


_LIST = "README.txt"
_LIST_HEAD = "Tables and figures of a PlushSense sweep report; `plushsense report` replaces the files named here."


def earlier_files(folder: Path) -> list[str]:
    """Return the names of the files that an earlier report wrote to a folder.

    Raises:
        ConfigError: when the folder contains other files.
    """
    if not folder.exists():
        return []
    try:
        lines = (folder / _LIST).read_text(encoding="utf-8").splitlines() if folder.is_dir() else []
        empty = folder.is_dir() and not any(folder.iterdir())
    except (OSError, ValueError):
        lines, empty = [], False
    if not empty and lines[:1] != [_LIST_HEAD]:
        raise ConfigError(f"'{folder}' exists and is not the folder of a report: give another page.")
    return [name for name in lines[1:] if name and Path(name).name == name and name != _LIST]


def write_files(folder: Path, files: Mapping[str, bytes], earlier: Sequence[str]) -> None:
    """Write files, each in one step, and remove files of an earlier report that have other names.

    Raises:
        ConfigError: when a file cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_file(folder / _LIST, "\n".join([_LIST_HEAD, *sorted({*files, *earlier}), ""]).encode())
        for name, content in files.items():
            write_file(folder / name, content)
        for name in earlier:
            if name not in files:
                (folder / name).unlink(missing_ok=True)
        write_file(folder / _LIST, "\n".join([_LIST_HEAD, *files, ""]).encode())
    except OSError as cause:
        raise ConfigError(
            f"The report's files cannot be written to '{folder}' ({cause.strerror or cause}): give another page."
        ) from cause
