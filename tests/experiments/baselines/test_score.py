"""The comparison: side by side, the gap, the resuming, and who is refused."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BadInput, ConfigError
from plushsense.experiments.baselines.score import Contender, compare
from plushsense.jobs.journal import Journal
from plushsense.jobs.pool import JobsSpec
from plushsense.jobs.progress import JobProgress
from plushsense.windows.cut import WindowSet
from support.fakes import LABELS, study

pytestmark = [pytest.mark.usefixtures("scikit_learn"), pytest.mark.apart("models")]

SPLITS = ("leave-one-subject-out", "windows:4")


@dataclass(frozen=True)
class Known:
    """Knows a recording that it was trained on, and nothing else; leaves a mark for each fit."""

    folder: str

    def __call__(self, train: WindowSet, validation: WindowSet, /) -> KnownReader:
        assert len(validation)
        with Path(self.folder, "fits").open("a") as file:
            file.write("x")
        return KnownReader(tuple(np.unique(train.integers[:, 1, 0]).tolist()))


@dataclass(frozen=True)
class KnownReader:
    seen: tuple[int, ...]

    @property
    def size_bytes(self) -> int:
        return 8 * len(self.seen)

    def __call__(self, windows: WindowSet, /) -> np.ndarray:
        read = np.where(np.isin(windows.integers[:, 1, 0], self.seen), windows.y, (windows.y + 1) % len(LABELS))
        return np.eye(len(LABELS), dtype=np.float32)[read]


@dataclass(frozen=True)
class Misshapen:
    size_bytes: int = 1

    def __call__(self, *sets: WindowSet) -> Any:
        # As a fit it is given two sets, as a reader one.
        return self if len(sets) == 2 else np.zeros((1, 1), dtype=np.float32)


def known(folder: Path, name: str = "known", **key: Any) -> Contender:
    return Contender(name, f"the {name} one", "windows", False, Known(str(folder)), key)


def fits(folder: Path) -> int:
    return len((folder / "fits").read_text()) if (folder / "fits").exists() else 0


def test_side_by_side_with_the_gap(tmp_path: Path) -> None:
    windows = study(windows=4)
    said: list[JobProgress] = []
    table = compare(windows, [known(tmp_path), known(tmp_path, "other")], SPLITS, progress=said.append)
    json.dumps(table.to_json(), allow_nan=False)
    assert [(r.name, r.split) for r in table.models] == [
        (name, split) for name in ("known", "other") for split in SPLITS
    ]
    honest, leaky = table.models[:2]
    assert (honest.leaky, honest.over, honest.folds) == (False, "subjects", 6)
    assert (leaky.leaky, leaky.over, leaky.folds) == (True, "folds", 4)
    assert honest.metrics["accuracy"]["mean"] == 0.0 and leaky.metrics["accuracy"]["mean"] > 0.9
    assert leaky.pooled["accuracy"] > 0.9 and leaky.metrics["macro_f1"]["mean"] > 0.9
    gap = table.gaps[0]
    assert (gap.name, gap.split, gap.leaky_split) == ("known", *SPLITS)
    assert gap.metrics["accuracy"] == pytest.approx(leaky.metrics["accuracy"]["mean"]) and len(table.gaps) == 2
    assert all(r.predict_ms > 0 and r.predict_batch_ms > 0 and r.train_s > 0 for r in table.models)
    assert honest.size_bytes % 8 == 0 and honest.size_bytes > 0
    assert (table.windows, table.subjects, table.recordings) == (len(windows), 6, 30)
    assert [s.done for s in said] == list(range(1, 21)) and fits(tmp_path) == 20 == said[-1].total


def test_finished_fits_are_kept_and_a_changed_key_is_another_job(tmp_path: Path) -> None:
    windows, journal = study(), Journal(tmp_path / "journal")
    first = compare(windows, [known(tmp_path, depth=1)], ["by-subject:3"], spec=JobsSpec(journal=journal))
    again = compare(windows, [known(tmp_path, depth=1)], ["by-subject:3"], spec=JobsSpec(journal=journal))
    assert fits(tmp_path) == 3 and again.resumed == 3
    # Times too are those of the first run: the journal holds what was measured.
    assert replace(again, resumed=0) == first
    compare(windows, [known(tmp_path, depth=2)], ["by-subject:3"], spec=JobsSpec(journal=journal))
    assert fits(tmp_path) == 6
    compare(windows, [known(tmp_path, depth=1)], ["by-subject:3"], spec=JobsSpec(journal=journal), seed=4)
    assert fits(tmp_path) == 9


def test_what_is_refused(tmp_path: Path) -> None:
    windows = study()
    one = known(tmp_path)
    with pytest.raises(ConfigError, match="given twice"):
        compare(windows, [one], ["windows:4", "windows:4"])
    with pytest.raises(ConfigError, match="No split"):
        compare(windows, [one], [])
    with pytest.raises(ConfigError, match="Did you mean"):
        compare(windows, [one], ["by-subjects:3"])
    with pytest.raises(BadInput, match="people"):
        compare(windows, [one], ["by-subject:30"])
    with pytest.raises(ConfigError, match="is given twice"):
        compare(windows, [one, one], ["windows:4"])
    assert fits(tmp_path) == 0
    with pytest.raises(ConfigError, match=r"the odd one, windows gave probabilities of the shape \(1, 1\)"):
        compare(windows, [Contender("odd", "the odd one", "windows", False, Misshapen(), {})], ["windows:4"])
