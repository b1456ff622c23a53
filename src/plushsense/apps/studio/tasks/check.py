"""Checking a data set: what the checks found, counted."""

from __future__ import annotations

from typing import Any

from plushsense.apps.checking import check_dataset
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Look at every recording of ``spec["dataset"]``."""
    found = check_dataset(spec["dataset"], progress=lambda done, total: tell.progress(done=done, total=total))
    counts = found.counts()
    return {
        "dataset": str(spec["dataset"]),
        "recordings": found.recordings,
        "undecided": len(found.undecided),
        "by_severity": counts["by_severity"],
        "by_check": counts["by_check"],
        "hash": found.dataset.hash,
        "seconds": round(found.seconds, 2),
    }
