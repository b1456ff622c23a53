"""A training that is stopped or killed goes on, and nothing shows in what comes out."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import plushsense as ps
from plushsense.dataset.store import Dataset
from plushsense.workflow.api import unfinished

pytestmark = pytest.mark.apart("trainings")

SMALL: dict[str, Any] = {"filters": (4, 4, 4), "context": "loop", "seed": 3}


class Stopped(Exception):
    """Somebody pressed Ctrl-C."""


@pytest.mark.parametrize("preset", ["people", "loso"])
def test_a_stopped_training_ends_in_the_same_file(
    dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: str
) -> None:
    monkeypatch.setattr("plushsense.workflow.networks._SAVE_EVERY_S", 0.0)
    settings = {**SMALL, "preset": preset, "epochs": 6}
    whole = ps.train(dataset, **settings)
    journal, told = unfinished(dataset), list[int]()

    def until(last: int) -> Callable[[int, int, dict[str, Any]], None]:
        def progress(epoch: int, epochs: int, row: dict[str, Any]) -> None:
            told.append(epoch)
            if len(told) == last:
                raise Stopped

        return progress

    # With the preset "people", first in the training without the people held back, then in the third on everybody.
    trainings = 2 if preset == "people" else 1
    for last in (2, 8) if trainings == 2 else (2, 4):
        told.clear()
        with pytest.raises(Stopped):
            ps.train(dataset, journal=journal, progress=until(last), **settings)
    assert len(list(journal.folder.glob("[!.]*.npz"))) == trainings
    told.clear()
    # Another seed is another training.
    ps.train(dataset, journal=journal, progress=until(0), **{**settings, "seed": 4})
    assert told[0] == 1
    assert len(list(journal.folder.glob("[!.]*.npz"))) == trainings
    told.clear()
    torch.manual_seed(99)
    done = ps.train(dataset, journal=journal, progress=until(0), **settings)
    further = [1, 2] if trainings == 2 else []
    assert told == [*range(1, len(whole.history) + 1), *further], "epochs of before are told, then the others"
    assert done.history == whole.history
    assert done.bundle.to_bytes() == whole.bundle.to_bytes()
    assert done.seconds > 0
    assert not list(journal.folder.glob("[!.]*.npz")), "done is done"


def test_a_bundle_does_not_hold_the_time_it_took(dataset: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ps.train(dataset, epochs=2, **SMALL)
    clock = iter(range(0, 10**9, 1000))
    monkeypatch.setattr("plushsense.training.fit.time.perf_counter", lambda: next(clock))
    slow = ps.train(dataset, epochs=2, **SMALL)
    assert slow.seconds >= 1000 > first.seconds
    assert slow.bundle.to_bytes() == first.bundle.to_bytes()


def test_a_place_that_cannot_be_written_costs_nothing(dataset: Dataset) -> None:
    journal = unfinished(dataset)
    journal.folder.parent.mkdir(parents=True, exist_ok=True)
    journal.folder.write_text("a file", encoding="utf-8")
    assert ps.train(dataset, journal=journal, epochs=2, **SMALL).history


def test_what_was_given_up_long_ago_goes(dataset: Dataset) -> None:
    kept = unfinished(dataset)
    for name in ("old", "new"):
        kept.save(name, {"epoch": 1})
    part = kept.folder / ".torn.0123.part"
    part.touch()
    for path in (kept.path("old"), part):
        os.utime(path, (time.time() - 31 * 24 * 3600,) * 2)
    ps.train(dataset, journal=kept, epochs=1, **SMALL)
    assert [path.name for path in kept.folder.iterdir()] == ["new.npz"]
