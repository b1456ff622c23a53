"""What an export costs in the toy: ``plushsense profile`` on every emulator that is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plushsense.apps.studio.exports import digest
from plushsense.apps.studio.worker import Tell
from plushsense.core.errors import ToolError
from plushsense.deploy.profile import profile


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Count on the export ``spec["place"]``."""
    return {"profile": measured(Path(spec["place"]), tell)}


def measured(folder: Path, tell: Tell) -> dict[str, Any]:
    """The profile in plain values, with the ``digest`` of what was measured; ``said`` alone where nothing can count."""
    before = digest(folder)
    tell.progress(stage="profile")
    try:
        found = profile(folder, progress=lambda done, total: tell.progress(stage="profile", done=done, total=total))
    except ToolError as refusal:
        # The export stands without it.
        return {"digest": before, "refused": str(refusal)}
    return {"digest": before, **found.to_dict()}
