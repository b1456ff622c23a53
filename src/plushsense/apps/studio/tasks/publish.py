"""The studio's packages: the same call as ``plushsense publish``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plushsense.apps.publishing import publish_dataset
from plushsense.apps.studio.worker import Tell
from plushsense.core.errors import DatasetError


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Publish ``spec["dataset"]`` as the package ``spec["place"]``; the other keys are arguments of
    `publish_dataset`."""
    key = spec.get("key") or None
    if key is not None:
        try:
            Path(key).parent.mkdir(parents=True, exist_ok=True)
        except OSError as cause:
            raise DatasetError(f"The key '{key}' cannot be kept: {cause.strerror or cause}.") from None
    done = publish_dataset(
        spec["dataset"],
        spec["place"],
        licence=spec.get("licence", ""),
        contact=spec.get("contact", ""),
        consent=spec.get("consent", ""),
        save=spec.get("save", False),
        streams=spec.get("streams", True),
        excluded=spec.get("excluded", False),
        columns=tuple(spec.get("columns", ())),
        key=key,
        bids=spec.get("bids", False),
        reidentification=spec.get("reidentification", True),
        thorough=spec.get("thorough", False),
        tell=lambda stage, done, total: tell.progress(stage=stage, done=done, total=total),
    )
    return done.to_dict()
