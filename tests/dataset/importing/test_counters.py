"""A channel that only counts the rows or the time is named by every import."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from plushsense.dataset.importing.counters import CLOCK, COUNTER, no_reading
from plushsense.dataset.importing.importers import import_recordings, preview_import
from plushsense.dataset.importing.pattern import ImportPattern

TIMES = np.arange(300.0) * 20.0
NOISE = np.random.default_rng(5).normal(0, 1, 300)


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (np.arange(300.0), COUNTER),
        (np.arange(300.0) % 256, COUNTER),
        (300.0 - np.arange(300), COUNTER),
        (np.delete(np.arange(310.0), slice(100, 110)), COUNTER),
        (TIMES / 1000 + 1.7e9, CLOCK),
        (TIMES + 4 * np.abs(NOISE), CLOCK),
        (-0.5 * TIMES, CLOCK),
        (np.arange(300) // 2 * 1.0, CLOCK),
        (np.concatenate([TIMES[:150], TIMES[:150]]), CLOCK),
        (np.arange(300.0) % 7, ""),
        (NOISE, ""),
        (np.full(300, 4.0), ""),
        (20 + 0.001 * TIMES + 0.05 * NOISE, ""),
        (np.minimum(np.arange(300.0) / 10, 12), ""),
        (np.where(np.arange(300) % 2, np.nan, 1.0), ""),
    ],
)
def test_clocks_and_counters_by_their_values(values: np.ndarray, kind: str) -> None:
    assert no_reading([(values, TIMES)]) == kind
    assert no_reading([(values, TIMES), (NOISE, TIMES)]) == "", "one reading is enough"
    assert no_reading([(values[:10], TIMES[:10])]) == "", "a few rows prove nothing"


def test_a_drift_has_another_slope_in_each_recording() -> None:
    assert no_reading([(20 + 0.1 * TIMES, TIMES), (20 + 0.2 * TIMES, TIMES)]) == ""


def test_a_pattern_by_hand_that_names_a_counter_is_warned_of(tmp_path: Path) -> None:
    (tmp_path / "src").mkdir()
    for person in ("P1", "P2"):
        rows = [f"{20 * k},{k % 256},{NOISE[k]:.2f}" for k in range(300)]
        (tmp_path / "src" / f"{person}_hug.csv").write_text("\n".join(["time_ms,n,force", *rows]))
    channels = [{"name": name, "unit": "", "kind": "sensor", "step": 0.01} for name in ("n", "force")]
    pattern = ImportPattern(layout={"rate_hz": 50.0, "channels": channels}, paths=("{subject}_{label}.csv",))
    said = "'n' is a number of the row: a network would read from it when a recording was made"
    assert said in preview_import(tmp_path / "src", pattern=pattern).messages[0]
    (note,) = import_recordings(tmp_path / "src", tmp_path / "DS", pattern=pattern).notes
    assert said in note and note.reason == "channel_counts"
