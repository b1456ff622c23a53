"""HTML pages that load nothing from outside: templates, and files that replace only what PlushSense wrote."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, need
from plushsense.core.files import write_file
from plushsense.reports import wording

ENDINGS = (".html", ".htm")
# The base template writes it; a file that has it is a report, and may be replaced by one.
GENERATOR = '<meta name="generator" content="PlushSense">'
_HEAD_BYTES = 4096


def render_page(template: str, **values: Any) -> str:
    """Return a page from a template of this package in the style of all pages; texts are escaped.

    Args:
        template: the file name; it extends ``base.html.j2``.
        values: of the template. ``title`` and ``simulated`` are needed; ``made`` and the texts of the simulation's
            banner have defaults.

    Raises:
        MissingExtraError: when jinja2 is not installed.
    """
    jinja2 = need("jinja2", "reports")
    folder = resources.files("plushsense.reports")
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    defaults = {
        "made": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "simulated_title": wording.SIMULATED_TITLE,
        "simulated_words": wording.SIMULATED_WORDS,
        "style": need("markupsafe", "reports").Markup(folder.joinpath("page.css").read_text(encoding="utf-8")),
    }
    page: str = environment.get_template(template).render(defaults | values)
    return page


def check_page_path(path: str | Path) -> Path:
    """Return the path when a report may be written there: a new .html file, or an older report to replace.

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
                ours = GENERATOR.encode() in file.read(_HEAD_BYTES)
        except OSError as cause:
            raise ConfigError(f"'{target}' exists and cannot be read ({cause.strerror}): name another file.") from cause
        if not ours:
            raise ConfigError(f"'{target}' exists and is not a report of PlushSense: name another file.")
    return target


def write_page(target: Path, page: str) -> Path:
    """Write a page to a path that `check_page_path` accepted, in one step.

    Raises:
        ConfigError: when the file cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_file(target, page)
    except OSError as cause:
        raise ConfigError(
            f"The report '{target}' cannot be written ({cause.strerror}): name a file where you may write."
        ) from cause
    return target


_LIST = "README.txt"
_LIST_HEAD = "Tables and figures of a PlushSense sweep report; `plushsense report` replaces the files named here."


def earlier_files(folder: Path) -> list[str]:
    """Return the names of the files that an earlier report left in a folder.

    Raises:
        ConfigError: when the folder holds something else.
    """
    if not folder.exists():
        return []
    try:
        lines = (folder / _LIST).read_text(encoding="utf-8").splitlines() if folder.is_dir() else []
        empty = folder.is_dir() and not any(folder.iterdir())
    except (OSError, ValueError):
        lines, empty = [], False
    if not empty and lines[:1] != [_LIST_HEAD]:
        raise ConfigError(f"'{folder}' exists and is not of a report of PlushSense: name another page.")
    return [name for name in lines[1:] if name and Path(name).name == name and name != _LIST]


def write_files(folder: Path, files: Mapping[str, bytes], earlier: Sequence[str]) -> None:
    """Write files, each in one step, and remove those of an earlier report that are not among them.

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
            f"The report's files cannot be written to '{folder}' ({cause.strerror}): name a page where you may write."
        ) from cause
