"""A data set under pseudonyms: ``plushsense pseudonymise``."""

from __future__ import annotations

from typing import Any

from plushsense.apps.studio.worker import Tell
from plushsense.dataset.pseudonymise import pseudonymise


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Make ``spec["place"]`` of ``dataset`` with the ``key`` file; ``words`` and ``drop_notes`` as the library's."""
    done = pseudonymise(
        spec["dataset"],
        spec["place"],
        key=spec["key"],
        words=spec.get("words", ()),
        drop_notes=spec.get("drop_notes", False),
        progress=lambda done, total: tell.progress(stage="rewriting", done=done, total=total),
    )
    return done.to_dict()
