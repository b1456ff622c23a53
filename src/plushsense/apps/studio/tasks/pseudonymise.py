"""A data set under pseudonyms: ``plushsense pseudonymise``."""

from __future__ import annotations

from typing import Any

from plushsense.apps.studio.worker import Tell
from plushsense.core.errors import ConfigError
from plushsense.dataset.pseudonymise import pseudonymise


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Make ``spec["place"]`` of ``dataset`` with the ``key`` file; ``words`` and ``drop_notes`` as the library's.

    Raises:
        ConfigError: without ``words``: a studio that was started again has not kept them, and none is not the same.
    """
    if "words" not in spec:
        raise ConfigError("Words that may not be left anywhere are not kept: give them again on the publish page.")
    done = pseudonymise(
        spec["dataset"],
        spec["place"],
        key=spec["key"],
        words=spec["words"],
        drop_notes=spec.get("drop_notes", False),
        progress=lambda done, total: tell.progress(stage="rewriting", done=done, total=total),
    )
    return done.to_dict()
