"""The day of toy time, a minute of it: recorder, live, batch and C agree, and what goes wrong is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import soak as bench

from support.exports import bundle_of


def test_a_minute_of_it(c_compiler: str, tmp_path: Path) -> None:
    model = bundle_of("plush-15", window=60).save(tmp_path / "m.plush")
    hours, found = bench.SHORTEST_H, dict[str, Any](hours=bench.SHORTEST_H)
    for part in ("frames", "record", "live", "batch", "chip"):
        found[part] = bench.PARTS[part](tmp_path, hours, model)
    assert bench.faults_of(found) == []
    assert found["frames"]["frames"] > 3600.0 * hours * 90
    assert found["record"]["recordings"] >= 1 and found["live"]["decisions"] > 1000
    assert (
        found["batch"]["compared"] > 1000 and found["chip"]["rows_compared"] > 1000 and found["chip"]["restarts"] == 1
    )
    found["live"]["frames"] -= 1
    found["record"]["rows_that_differ"] = 3
    found["batch"]["differ"] = 1
    found["chip"]["rows_compared"] = 0
    assert len(bench.faults_of(found)) == 4
