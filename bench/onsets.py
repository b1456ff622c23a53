"""Measure the error of suggested onsets and offsets against marks made by eye and the truth of the virtual toy.

    python bench/onsets.py RECORDINGS [--marks tests/dataset/onsets.csv] [--simulation] [--json]

RECORDINGS is the folder makeability-gestures, which is imported into a temporary folder. With --simulation, six virtual
people (seed 11) are measured too; for them it is known when the hand comes near, begins to touch, stops, and is away.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.dataset.trimming import Trim, suggest_trims
from plushsense.devices.virtual.motions import APPROACH_S, LEAVE_S
from plushsense.devices.virtual.session import GESTURES, VirtualSession
from plushsense.devices.virtual.world import WORLD, draw_person
from plushsense.recording.simulate import simulate

PEOPLE, SEED, REPETITIONS = 6, 11, 3
NEAR_S = 0.2
SURE = (0.0, 0.5, 0.8, 1.01)


@dataclass(frozen=True)
class Compared:
    """Error of a suggested edge in seconds (above 0: too late), and its confidence."""

    recording: str
    error_s: float
    confidence: float


def share(errors: list[float]) -> dict[str, float | int]:
    """Return the median absolute error, the share within 0.2 s, and the bias (above 0: too late)."""
    e = np.array(errors)
    if not len(e):
        return {"n": 0}
    return {
        "n": len(e),
        "median_s": round(float(np.median(np.abs(e))), 3),
        "within_0.2_s": round(float(np.mean(np.abs(e) <= NEAR_S + 1e-9)), 3),
        "bias_s": round(float(np.median(e)), 3),
    }


def by_confidence(compared: list[Compared]) -> dict[str, dict[str, float | int]]:
    """Return `share` of all edges and of each band of confidence."""
    out = {"all": share([c.error_s for c in compared])}
    for low, high in pairwise(SURE):
        band = [c.error_s for c in compared if low <= c.confidence < high]
        out[f"{low:.1f} to {min(high, 1.0):.1f}"] = share(band)
    return out


def edges(trim: Trim) -> dict[str, tuple[float, float, bool]]:
    """Return seconds, confidence and visibility of both suggested edges, or the recording's own edge without one."""
    s = trim.suggestion
    return {
        "onset": (float(trim.seconds[s.start]), s.onset_confidence, s.onset_visible),
        "offset": (float(trim.seconds[s.stop]), s.offset_confidence, s.offset_visible),
    }


def against_marks(dataset: Dataset, marks: Path) -> dict[str, object]:
    """Compute the figures of docs/trim.md."""
    with marks.open(encoding="utf-8", newline="") as file:
        rows = {row["recording"]: row for row in csv.DictReader(file)}
    found = {t.recording.id: t for t in suggest_trims(dataset, [r for r in dataset.recordings if r.id in rows])}
    result: dict[str, object] = {"recordings": len(found)}
    for edge in ("onset", "offset"):
        seen = [i for i in found if rows[i][f"{edge}_visible"] == "yes"]
        compared = []
        for i in seen:
            at, confidence, _ = edges(found[i])[edge]
            compared.append(Compared(i, at - float(rows[i][f"{edge}_s"]), confidence))
        again = [i for i in seen if rows[i][f"{edge}_again_s"]]
        unseen = [i for i in found if i not in seen and edges(found[i])[edge][2]]
        worst = sorted(compared, key=lambda c: -abs(c.error_s))[:5]
        result[edge] = {
            **by_confidence(compared),
            "sure": share([c.error_s for c in compared if rows[c.recording]["sure"] == "yes"]),
            "suggested": share([c.error_s for c in compared if edges(found[c.recording])[edge][2]]),
            "marker_again": share([float(rows[i][f"{edge}_again_s"]) - float(rows[i][f"{edge}_s"]) for i in again]),
            "suggested_where_the_marker_saw_none": {i: edges(found[i])[edge][1] for i in unseen},
            "worst": {c.recording: [round(c.error_s, 2), c.confidence] for c in worst},
        }
    return result


def against_simulation(work: Path) -> dict[str, object]:
    """Compare suggestions with the known movements of the virtual toy.

    This says nothing about a real toy."""
    simulate(work / "recordings", PEOPLE, SEED, REPETITIONS)
    dataset = import_recordings(work / "recordings", work / "SIM", layout="plush-15").dataset
    mine: dict[tuple[str, str], list[Trim]] = {}
    for t in suggest_trims(dataset):
        mine.setdefault((t.recording.file.split("/")[1], t.recording.gesture), []).append(t)
    errors: dict[str, list[Compared]] = {name: [] for name in ("near", "works", "stops", "away")}
    for who in range(1, PEOPLE + 1):
        session = VirtualSession(draw_person(who, SEED, WORLD), SEED, 0, WORLD)
        session.idle(2.0)
        for label in GESTURES:
            marks = session.perform(label, REPETITIONS).marks
            takes = sorted(mine[f"P{who:02d}", label], key=lambda t: t.recording.epoch_ms)
            # A gesture with both hands comes near and begins to touch at the same time.
            hold = label.startswith("Hold")
            for mark, t in zip(marks, takes, strict=True):
                found, end = edges(t), float(t.seconds[-1])
                works, stops = ((at - mark.record_start) / 100 for at in (mark.start, mark.stop))
                truth = {
                    "near": ("onset", works if hold else works - APPROACH_S),
                    "works": ("onset", works),
                    "stops": ("offset", stops),
                    "away": ("offset", min(end, stops if hold else stops + LEAVE_S)),
                }
                for name, (edge, at) in truth.items():
                    errors[name].append(Compared(t.recording.id, found[edge][0] - at, found[edge][1]))
    return {"simulation": True, **{name: by_confidence(compared) for name, compared in errors.items()}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path)
    parser.add_argument("--marks", type=Path, default=Path("tests/dataset/onsets.csv"))
    parser.add_argument("--simulation", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        dataset = import_recordings(args.recordings, work / "DS", layout="accel-3").dataset
        result = {"marks": against_marks(dataset, args.marks)}
        if args.simulation:
            result["virtual toy, a simulation"] = against_simulation(work)
    print(json.dumps(result, indent=None if args.json else 1, ensure_ascii=False))


if __name__ == "__main__":
    main()
