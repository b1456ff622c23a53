"""Which windows a single training is trained on, and which it is scored on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plushsense.apps.config import RunConfig
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.evaluation.folds import WindowFold, fold_windows
from plushsense.scoring.splits import VALIDATION_SHARE, Split, parse_split
from plushsense.windows.cut import WindowSet

WHOLE_PEOPLE = "validation-subjects"


@dataclass(frozen=True)
class Division:
    """What a single training is trained on and scored on; ``said`` in words."""

    split: Split
    kind: str
    said: str
    fold: WindowFold
    train: NDArray[np.int64]
    watch: NDArray[np.int64]


def divide(windows: WindowSet, config: RunConfig, scored: WindowSet | None = None) -> Division:
    """Hold some people back; of fewer than three, some recordings. Nothing that is scored is trained on.

    ``watch`` and ``test`` are of ``scored``: the same recordings, cut in another way (the same when left out).
    """
    scored = windows if scored is None else scored
    seed = config.evaluation.seed
    stopped = "" if config.training.patience is None else " but decided when to stop"
    if config.preset == "search":
        split = parse_split("windows:holdout")
        fold = fold_windows(windows, scored, split, seed)[0]
        said = "15 % of the windows, drawn at random: leaky, windows of one recording stand on both sides"
        return Division(split, split.text, said, fold, fold.train, fold.validation)
    people = set(windows.subject.tolist()) - {NOBODY, UNKNOWN_SUBJECT}
    if len(people) >= 3:
        split = parse_split(f"by-subject:{min(len(people), round(1 / VALIDATION_SHARE))}")
        kind, said = WHOLE_PEOPLE, f"people who were not trained on{stopped}: "
    else:
        recordings = len(np.unique(windows.recording))
        split = parse_split(f"by-recording:{max(2, min(recordings // 2, round(1 / VALIDATION_SHARE)))}")
        kind = "validation-recordings"
        said = f"recordings that were not trained on{stopped}; of the people who were, so flattering"
    fold = fold_windows(windows, scored, split, seed)[0]
    if split.apart:
        said += ", ".join(fold.subjects)
    rest = np.sort(np.concatenate([fold.train, fold.validation]))
    return Division(split, kind, said, fold, rest, fold.test)
