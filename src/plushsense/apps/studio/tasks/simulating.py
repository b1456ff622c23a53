"""A small data set of virtual people, so that everything can be tried."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from plushsense.apps.api import simulate
from plushsense.apps.studio.jobs import UNFINISHED
from plushsense.apps.studio.worker import Tell


def run(spec: dict[str, Any], tell: Tell) -> dict[str, Any]:
    """Simulate ``people`` with ``repetitions`` each as the new data set ``dest``, which says that it
    is a simulation. ``work`` is a folder for what is made on the way."""
    work = Path(spec["work"])
    work.mkdir(parents=True, exist_ok=True)
    # The recordings are of no more use once the data set holds them.
    with tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=work) as place:
        done = simulate(
            Path(place) / "sessions",
            people=int(spec["people"]),
            repetitions=int(spec["repetitions"]),
            seed=int(spec.get("seed", 1)),
            dataset=spec["dest"],
            progress=lambda what, at, total: tell.progress(what=what, done=at, total=total),
        )
    return {"dataset": str(spec["dest"]), "recordings": done["recordings"], "people": done["people"]}
