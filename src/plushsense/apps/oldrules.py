"""The old heuristic made ready for the protocol: tuned, as somebody would by hand, on people who are not scored."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import GestureSet
from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.importers import import_recordings
from plushsense.dataset.store import Dataset
from plushsense.evaluation.trials import Heuristic
from plushsense.live.heuristic import HeuristicPlan, fit_heuristic, heuristic_updates
from plushsense.live.stream import Event
from plushsense.recording.simulate import simulate

OTHERS = 4
_ELSEWHERE = 1_000_003  # added to the seed: another population


def virtual_rules(seed: int, layout: Layout, gestures: GestureSet, people: int = OTHERS) -> tuple[Heuristic, str]:
    """Tuned on virtual people of another population; with a sentence that says so."""
    with tempfile.TemporaryDirectory() as work:
        raw, folder = Path(work) / "raw", Path(work) / "ds"
        simulate(raw, people, (seed + _ELSEWHERE) % 2**31, 2, at_rest=0, layout=layout)
        dataset = import_recordings(raw, folder, layout=layout, gestures=gestures, name="others").dataset
        plan, _ = fit_heuristic(dataset, gestures, dataset.subjects)
    return _asks(plan, layout), f"Tuned on {people} other virtual people, of another population."


def recorded_rules(dataset: Dataset, gestures: GestureSet, scored: Collection[str]) -> tuple[Heuristic | None, str]:
    """Tuned on the people of a data set who are not scored; None, with the reason, where that cannot be."""
    others: Sequence[str] = [code for code in dataset.subjects if code not in scored]
    if not others:
        return None, "Everybody is scored here, so nobody is left to tune the old rules on: there are no rules only."
    try:
        plan, _ = fit_heuristic(dataset, gestures, others)
    except ConfigError as cause:
        return None, f"The old rules cannot be tuned: {cause}"
    return _asks(plan, dataset.layout), f"Tuned on people who are not scored here: {len(others)}."


def _asks(plan: HeuristicPlan, layout: Layout) -> Heuristic:
    def ask(frames: Frames) -> Sequence[Event]:
        return heuristic_updates(frames, layout, plan)

    return ask
