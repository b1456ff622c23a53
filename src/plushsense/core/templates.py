"""Fill Jinja templates that are stored beside the code that uses them."""

from __future__ import annotations

import json
from functools import cache, partial
from importlib import resources
from typing import Any


def fill_text(package: str, template: str, **values: Any) -> str:
    """Fill the template of a text document with ``values``, unchanged.

    Templates can use the filters ``cell`` (escape for a Markdown table), ``c_comment`` (see `c_comment`) and ``json``.

    Args:
        package: the package whose folder contains ``template`` and the templates that it includes.
    """
    text: str = _environment(package).get_template(template).render(**values)
    return text


def fill_html(package: str, template: str, **values: Any) -> str:
    """Fill the template of an HTML page like `fill_text`, with values escaped."""
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
    """Make a text safe for a C comment: replace comment delimiters, backslashes and unprintable characters."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain.replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")
