"""Fill Jinja templates that are stored beside the code which uses them; base installs have jinja2."""

from __future__ import annotations

import json
from functools import cache, partial
from importlib import resources
from typing import Any


def fill_text(package: str, template: str, **values: Any) -> str:
    """Fill the template of a text document; values are inserted unchanged.

    Filters: ``cell`` (of a Markdown table), ``c_comment`` (see `c_comment`), ``json``.

    Args:
        package: the package whose folder contains ``template`` and the templates that it includes.
    """
    text: str = _environment(package).get_template(template).render(**values)
    return text


def fill_html(package: str, template: str, **values: Any) -> str:
    """Fill the template of an HTML page as `fill_text` does; values are escaped."""
    page: str = _environment(package, html=True).get_template(template).render(**values)
    return page


@cache
def _environment(package: str, html: bool = False) -> Any:
    import jinja2

    folder = resources.files(package)
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        autoescape=html,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=not html,
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|").replace("\n", " ")
    environment.filters["c_comment"] = c_comment
    environment.filters["json"] = partial(json.dumps, ensure_ascii=False)
    return environment


def c_comment(text: str) -> str:
    """Make a text safe for a C comment: without its delimiters, backslashes and unprintable characters."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain.replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")
