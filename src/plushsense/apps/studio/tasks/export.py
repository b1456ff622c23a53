"""The studio's exports: the same call as ``plushsense export``, then what a step costs where that can be counted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plushsense.apps.exporting import export
from plushsense.apps.studio.tasks.profile import measured
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Export ``spec["bundle"]`` to ``spec["place"]``; ``also`` are formats, ``dataset`` ("": none) calibrates anew."""
    tell.progress(stage="export")
    done = export(
        spec["bundle"], spec["place"], dataset=spec.get("dataset") or None, also=spec.get("also", ()), warn=tell.warn
    )
    return {**done.to_dict(), "profile": measured(Path(spec["place"]), tell)}
