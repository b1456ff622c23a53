"""Text documents from Jinja templates that lie beside the code which fills them."""

from __future__ import annotations

import json
from functools import cache, partial
from importlib import resources
from typing import Any


def fill_text(package: str, template: str, **values: Any) -> str:
    """Fill the template of a text document; values are inserted as they are.

    Filters: ``cell`` (of a Markdown table), ``c_comment`` (see `c_comment`), ``json``.

    Args:
        package: the package whose folder holds ``template`` and the templates that it includes.
    """
    text: str = _environment(package).get_template(template).render(**values)
    return text


@cache
def _environment(package: str) -> Any:
    import jinja2

    folder = resources.files(package)
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: folder.joinpath(name).read_text(encoding="utf-8")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|").replace("\n", " ")
    environment.filters["c_comment"] = c_comment
    environment.filters["json"] = partial(json.dumps, ensure_ascii=False)
    return environment


def c_comment(text: str) -> str:
    """Make a text safe for a C comment: without its delimiters, backslashes and unprintable characters."""
    plain = "".join(c if c.isprintable() else " " for c in text)
    return plain.replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")
