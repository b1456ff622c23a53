"""Object files of the exported C that all tests and workers share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from plushsense.deploy.targets import Program, build
from support.sharing import built_once


@contextmanager
def keeping_objects(factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compile once what is the same, flags included: object files are named by a hash of it."""
    objects = built_once(factory, "objects", lambda draft: None)

    def keeping(*args: Any, **options: Any) -> Program:
        return build(*args, **{**options, "object_folder": objects})

    with pytest.MonkeyPatch.context() as patch:
        for module in ("profile", "proof.verify"):
            patch.setattr(f"plushsense.deploy.{module}.build", keeping)
        patch.setattr("support.virtual_boards.OBJECTS", objects)
        yield
