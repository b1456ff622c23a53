"""Settings of Sphinx: `make docs` builds build/site of these pages, CONTRIBUTING and the CHANGELOG."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from plushsense import __version__

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "PlushSense"
release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 6  # pages link to headings of other pages
autodoc_typehints = "description"
smartquotes_action = "qe"  # no dashes: --option stays as it is
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["pages.css"]
html_title = f"PlushSense {release}"
html_copy_source = False
html_show_copyright = False

ROOT = Path(__file__).parents[1]
PAGES = {"README.md": "/index.md", "CONTRIBUTING.md": "/contributing.md", "CHANGELOG.md": "/changelog.md"}
"""Files of the project's root, and the pages that include them."""
_INCLUDE = re.compile(r"```\{include\} \.\./(\S+)\n```")
_LINK = re.compile(r"\[([^\]]*)\]\(([\w./-]+)(#[\w-]+)?\)")


def as_in_site(folder: Path, text: str) -> str:
    """Return a page's text with the addresses of the site; links to files that are not in it become their names."""

    def link(match: re.Match[str]) -> str:
        title, target, anchor = match.group(1), match.group(2), match.group(3) or ""
        path = (folder / target).resolve()
        if not path.exists() or not path.is_relative_to(ROOT):
            return match.group(0)  # Sphinx reports it
        name = path.relative_to(ROOT).as_posix()
        if name in PAGES or name.startswith("docs/"):
            return f"[{title}]({PAGES.get(name, name.removeprefix('docs'))}{anchor})"
        return f"`{name}`" if name in title else f"{title} (`{name}`)"

    return _LINK.sub(link, text)


def setup(app: Sphinx) -> None:
    """Change the links of every page that Sphinx reads, and include the files of the project's root."""

    def read(_: Sphinx, page: str, source: list[str]) -> None:
        text = as_in_site((ROOT / "docs" / page).parent, source[0])
        source[0] = _INCLUDE.sub(lambda m: as_in_site(ROOT, (ROOT / m.group(1)).read_text(encoding="utf-8")), text)

    app.connect("source-read", read)
