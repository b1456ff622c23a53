"""Proving a package that is there: ``plushsense publish --check``."""

from __future__ import annotations

from typing import Any

from plushsense.apps.publishing import validate_package
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Prove the package ``spec["place"]``, a folder or a zip; ``thorough``: every row of the streams by everybody."""
    checked = validate_package(
        spec["place"],
        thorough=spec.get("thorough", False),
        tell=lambda stage, done, total: tell.progress(stage=stage, done=done, total=total),
    )
    return checked.to_dict()
