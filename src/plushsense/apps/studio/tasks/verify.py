"""The studio's proof of an export: what ``plushsense verify`` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from plushsense.apps.studio.exports import digest
from plushsense.apps.studio.worker import Tell
from plushsense.dataset.index import open_dataset
from plushsense.deploy.package import changed_copies
from plushsense.deploy.vectors import Export
from plushsense.deploy.verify import verify

_SAMPLES = 100_000


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Prove the export ``spec["place"]`` on ``targets`` (none: all that are here), also with recordings of
    ``dataset`` ("": none), and with ``faults`` planted."""
    folder = Path(spec["place"])
    before = digest(folder)
    tell.progress(stage="vectors")
    export = Export(folder)
    dataset = spec.get("dataset")
    vectors = export.recorded(open_dataset(dataset), [], _SAMPLES) if dataset else export.made_up(0)
    done = verify(
        export,
        spec.get("targets", ()),
        vectors,
        plant=(lambda fault: True) if spec.get("faults") else None,
        progress=lambda done, total: tell.progress(stage="verify", done=done, total=total),
    )
    return {**done.to_dict(), "digest": before, "changed_copies": changed_copies(folder)}
