"""Text documents from Jinja templates that lie beside the code which fills them."""

from __future__ import annotations

from importlib import resources
from typing import Any

from plushsense.core.errors import need


def fill_text(package: str, template: str, **values: Any) -> str:
    """Fill the template of a plain-text or Markdown document; values are inserted as they are.

    Args:
        package: the package whose folder holds ``template``.

    Raises:
        MissingExtraError: when jinja2 is not installed.
    """
    jinja2 = need("jinja2", "publish")
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters["cell"] = lambda text: text.replace("|", "\\|").replace("\n", " ")
    source = resources.files(package).joinpath(template).read_text(encoding="utf-8")
    text: str = environment.from_string(source).render(**values)
    return text
