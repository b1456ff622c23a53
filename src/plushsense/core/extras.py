"""Optional packages: ask for one here, and a missing one says how to install it."""

from __future__ import annotations

import importlib
from types import ModuleType

from plushsense.core.errors import MissingExtraError


def need(module: str, extra: str) -> ModuleType:
    """Import ``module``, which the optional dependency group ``extra`` provides.

    Raises:
        MissingExtraError: with the exact install command, when the package is not there.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        top = module.split(".")[0]
        if error.name is not None and error.name.split(".")[0] != top:
            raise
        raise MissingExtraError(
            f"This needs the package '{top}', which is not installed: run  pip install 'plushsense[{extra}]'"
        ) from error
