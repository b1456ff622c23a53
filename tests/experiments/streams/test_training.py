"""Nothing of a stream that is heard as a whole is trained on, whoever made it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import Dataset
from plushsense.experiments.streams.benchmark import TrainStreams, recipes_for
from plushsense.experiments.streams.score import PeopleFold
from plushsense.experiments.streams.systems import ANYWHERE, WINDOWS
from plushsense.training import fit as fitting
from plushsense.windows.cut import WindowSet
from plushsense.workflow.config import from_settings
from plushsense.workflow.preparation import outside_streams, prepare

pytestmark = pytest.mark.apart("trainings")


@pytest.fixture
def rested(dataset: Dataset) -> Dataset:
    """Everybody recorded the toy at rest within their own session; as `dataset.index` has it, that is nobody's."""
    recordings = [replace(r, subject=NOBODY) if r.gesture == "Rest" else r for r in dataset.recordings]
    assert all(r.stream_row >= 0 for r in recordings)
    return Dataset(dataset.path, dataset.head, recordings, dataset.streams)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[WindowSet]:
    """The windows that networks were trained on, as it went."""
    seen: list[WindowSet] = []
    real = fitting.fit

    def note(train: WindowSet, *rest: object, **more: object) -> object:
        seen.append(train)
        return real(train, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(fitting, "fit", note)
    return seen


def owners(dataset: Dataset, windows: WindowSet) -> set[str]:
    """In whose streams windows lie."""
    owner = {s.id: s.subject for s in dataset.streams}
    return {owner[name] for name in windows.stream.tolist() if name}


def test_a_fold_of_the_benchmark(rested: Dataset, trained: list[WindowSet], tmp_path: Path) -> None:
    config = from_settings(filters=(4, 4, 4), epochs=2, classes="all")
    run = prepare(rested, config)
    fold = PeopleFold("fold 1", ("P1", "P2", "P3"), ("P4",), ("P5",))
    recipes = recipes_for(run.dataset, config, run, {WINDOWS, ANYWHERE})
    assert [recipe.training.epochs for recipe in recipes.values()] == [2, 2], "as given"
    TrainStreams(recipes, False, tmp_path)(run.dataset, fold, lambda *_: None)
    # Gestures, and anywhere.
    assert len(trained) == 2
    for windows in trained:
        assert owners(rested, windows) == {"P1", "P2", "P3"}
        assert NOBODY in windows.subject and "Rest" in np.array(windows.labels)[windows.y]


@pytest.mark.parametrize("context", ["stream", "anywhere"])
def test_each_network_of_the_benchmark_is_trained_as_by_train(dataset: Dataset, context: str) -> None:
    config = from_settings(context=context, device="cpu")
    recipes = recipes_for(dataset, config, prepare(dataset, config), {WINDOWS, ANYWHERE})
    for name, windows in ((WINDOWS, "stream"), (ANYWHERE, "anywhere")):
        assert recipes[name].windows.context == windows
        assert recipes[name].training == prepare(dataset, from_settings(context=windows, device="cpu")).training


def test_a_training_that_fits_decisions(rested: Dataset, trained: list[WindowSet]) -> None:
    bundle = ps.train(rested, filters=(4, 4, 4), epochs=2, classes="all").bundle
    (held,) = set(bundle.provenance["validation_subjects"]) - {NOBODY}
    everybody = {"P1", "P2", "P3", "P4", "P5"}
    assert [owners(rested, windows) for windows in trained] == [everybody - {held}, everybody]


def test_what_lies_in_no_stream_of_theirs(dataset: Dataset) -> None:
    windows = prepare(dataset, from_settings(classes="all")).scored_windows()
    assert (outside_streams(windows, dataset, {"P1", "P3"}) == ~np.isin(windows.subject, ["P1", "P3"])).all()
    assert outside_streams(windows, dataset, set()).all()
