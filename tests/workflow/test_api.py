from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.errors import ConfigError, DatasetError, PlushSenseWarning
from plushsense.dataset.store import Dataset
from plushsense.models.bundle import trained_people
from plushsense.workflow.api import simulate, validation_predictions
from plushsense.workflow.forgetting import trained_on
from plushsense.workflow.networks import REFIT
from plushsense.workflow.preparation import count_people
from support.small_dataset import Cli

pytestmark = pytest.mark.apart("trainings")


def test_the_public_api_is_small_and_all_of_its_names_load() -> None:
    assert len(ps.__all__) <= 14
    for name in ps.__all__:
        assert getattr(ps, name) is not None
    with pytest.raises(AttributeError, match="its names are"):
        _ = ps.trian


def test_every_function_that_the_documentation_lists_is_in_its_module() -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "python.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| [^|`]+ \| `(plushsense\.[\w.]+)` \| (.+) \|$", page, re.MULTILINE)
    listed = {name: module for module, names in rows for name in re.findall(r"`(\w+)`", names)}
    assert {"share_copy", "backup", "check_backup", "restore", "forget", "sweep"} <= set(listed)
    assert [f"{module}.{name}" for name, module in listed.items() if not hasattr(import_module(module), name)] == []


def test_train_learns_from_everybody_once_scores_and_decisions_are_found(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[dict[str, Any]] = []
    trained = ps.train(dataset, epochs=2, filters=(4, 4, 4), progress=lambda *at: rows.append(at[2]))
    monkeypatch.setattr("plushsense.workflow.preparation.refit_epochs", lambda *_: 0)
    held_back = ps.train(dataset, epochs=2, filters=(4, 4, 4))
    origin, before = trained.bundle.provenance, held_back.bundle.provenance
    assert (origin["subjects"], origin["refit"], before["refit"]) == (sorted(dataset.subjects), True, False)
    assert origin["validation_subjects"] == before["validation_subjects"] != []
    assert [row.get("what") for row in rows] == [None, None, REFIT]
    assert trained.scores.accuracy == held_back.scores.accuracy
    assert trained.bundle.decision == held_back.bundle.decision and trained.history == held_back.history
    assert any(not np.array_equal(w, held_back.bundle.weights[k]) for k, w in trained.bundle.weights.items())
    # The answers on the people who were held back are those of the network that did not know them.
    answers = validation_predictions(trained.bundle, dataset)
    assert set(answers.subject.tolist()) == set(origin["validation_subjects"])
    assert np.array_equal(answers.predicted, validation_predictions(held_back.bundle, dataset).predicted)
    shutil.rmtree(dataset.path / "cache")
    with pytest.raises(DatasetError, match=r"no longer stored .* kept for 30 days"):
        validation_predictions(trained.bundle, dataset)
    others = replace(trained.bundle, provenance={**origin, "split": ""})
    with pytest.raises(DatasetError, match="no validation people"):
        validation_predictions(others, dataset)


def test_a_network_of_merged_gestures_knows_its_data_set(dataset: Dataset, tmp_path: Path) -> None:
    merged = tmp_path / "merged.toml"
    merged.write_text('name = "m"\ngestures = [{label = "Rest"}, {label = "Move", labels = ["Slow", "Fast"]}]\n')
    bundle = ps.train(dataset, epochs=1, filters=(2, 2, 2), classes=str(merged), fit_decisions=False).bundle
    assert validation_predictions(bundle, dataset).labels == bundle.gestures.labels == ("Rest", "Move")
    bundle.save(tmp_path / "m.plush")
    assert [found.certain for found in trained_on(dataset.path, dataset.subjects[0], [tmp_path])] == [True]
    # Under another name, the data set is still the one of the training.
    renamed = Dataset(dataset.path, replace(dataset.head, name="other"), dataset.recordings, dataset.streams)
    assert trained_people(bundle, renamed) == set(dataset.subjects)


def test_people_whose_recordings_are_all_excluded_do_not_count(dataset: Dataset) -> None:
    assert count_people(dataset) == len(dataset.subjects) == 5
    left = [replace(r, excluded=r.subject in ("P1", "P2", "P3")) for r in dataset.recordings]
    assert count_people(Dataset(dataset.path, dataset.head, left, dataset.streams)) == 2


def test_early_stopping_keeps_whole_people_apart_and_says_on_whom(dataset: Dataset) -> None:
    trained = ps.train(dataset, epochs=2, filters=(4, 4, 4), patience=5)
    inside, watching = (set(trained.bundle.provenance[k]) for k in ("subjects", "validation_subjects"))
    assert inside & watching == set()
    assert inside | watching == set(dataset.subjects)
    assert trained.scores.split == "validation-subjects"
    assert next(iter(watching)) in trained.scores.description
    assert trained.bundle.provenance["dataset_hash"] == dataset.hash
    assert trained.figure().axes


def test_the_search_preset_is_leaky_and_says_so(dataset: Dataset) -> None:
    trained = ps.train(dataset, preset="search", epochs=1, filters=(4, 4, 4))
    assert trained.scores.leaky
    assert "leaky" in trained.scores.description


def test_same_seed_same_weights(dataset: Dataset) -> None:
    one, two, other = (ps.train(dataset, epochs=2, filters=(4, 4, 4), seed=s).bundle.weights for s in (3, 3, 4))
    assert all(np.array_equal(one[k], two[k]) for k in one)
    assert any(not np.array_equal(one[k], other[k]) for k in one)


def test_the_papers_preset_is_mirrored_rows(dataset: Dataset) -> None:
    bundle = ps.train(dataset, preset="paper", epochs=1, filters=(4, 4, 4)).bundle
    assert bundle.arch.padding == "mirror"
    assert bundle.windowing["context"] == "rows"


def test_trained_anywhere_knows_idleness_and_is_scored_on_gestures(dataset: Dataset) -> None:
    said: list[str] = []
    kwargs = {"epochs": 1, "filters": (4, 4, 4), "pool_s": 0.5, "patience": 9}
    trained = ps.train(dataset, context="anywhere", every_s=0.5, idle_share=0.25, warn=said.append, **kwargs)
    bundle = trained.bundle
    assert bundle.gestures.labels == ("Fast", "Rest", "Slow", "Idle")
    assert bundle.gestures.get("Idle").idle
    assert "added a class for what happens between gestures: Idle" in said
    assert any("recordings are not trimmed" in line for line in said)
    assert bundle.arch.pool == 50
    assert bundle.provenance["context"]["anywhere"] > 50
    assert (bundle.windowing["context"], bundle.windowing["anywhere"]["idle_share"]) == ("anywhere", 0.25)
    ordinary = ps.train(dataset, **kwargs)
    assert trained.scores.windows == ordinary.scores.windows, "gestures with their real past, nothing else"


def test_a_script_gets_the_warnings_of_the_command_line(dataset: Dataset) -> None:
    said: list[str] = []
    kwargs: dict[str, Any] = {"context": "anywhere", "epochs": 1, "filters": (4, 4, 4), "every_s": 1.0}
    ps.train(dataset, fit_decisions=False, warn=said.append, **kwargs)
    with pytest.warns(PlushSenseWarning) as issued:
        ps.train(dataset, fit_decisions=False, **kwargs)
    ours = [each for each in issued if each.category is PlushSenseWarning]
    assert [str(each.message) for each in ours] == said != []
    assert {each.filename for each in ours} == {__file__}


def test_training_anywhere_does_not_warn_of_trimmed_recordings(dataset: Dataset) -> None:
    from plushsense.workflow.preparation import warn_of_untrimmed

    lines: list[str] = []
    used = list(dataset.used)
    for start, expected in ((20, 0), (0, 1)):
        half = [replace(r, start=start) for r in used[::2]]
        warn_of_untrimmed(Dataset(dataset.path, dataset.head, half, dataset.streams), dataset.gestures, lines.append)
        assert len(lines) == expected
    assert f"{len(used[::2])} of {len(used[::2])} recordings" in lines[0]


def test_evaluated_anywhere_is_scored_on_the_real_past(dataset: Dataset) -> None:
    kwargs = {"split": "by-subject:2", "epochs": 1, "filters": (4, 4, 4), "workers": 1}
    one = ps.evaluate(dataset, context="anywhere", **kwargs)
    assert (one.train_context, one.context) == ("anywhere", "stream")
    other = ps.evaluate(dataset, train_context="anywhere", **kwargs)
    assert other.scores.means == one.scores.means
    with pytest.raises(ConfigError, match="divides windows"):
        ps.evaluate(dataset, context="anywhere", **{**kwargs, "split": "windows:2"})


def test_the_ranges_of_a_network_trained_anywhere_come_from_its_own_windows(dataset: Dataset) -> None:
    from plushsense.windows.anywhere import AnywhereSpec, cut_anywhere
    from plushsense.windows.cut import WindowSpec
    from plushsense.workflow.export import training_windows

    bundle = ps.train(dataset, context="anywhere", every_s=0.5, epochs=1, filters=(4, 4, 4)).bundle
    read = dataset.with_inputs(bundle.layout)
    cut = cut_anywhere(read, WindowSpec(context="anywhere"), bundle.gestures, AnywhereSpec(every_s=0.5))
    mine = cut.integers[np.isin(cut.subject, bundle.provenance["subjects"])]
    assert np.array_equal(training_windows(bundle, dataset), mine)


def test_unknown_settings_and_too_few_classes_are_refused(dataset: Dataset) -> None:
    with pytest.raises(ConfigError, match="Did you mean 'epochs'"):
        ps.train(dataset, epoch=2)
    with pytest.raises(DatasetError, match="At least 2 gestures are needed, not 1"):
        ps.train(dataset, classes="Slow")


@pytest.mark.parametrize("scaling", ["z-score", "none"])
@pytest.mark.parametrize("padding", ["mirror", "causal", "stream"])
@pytest.mark.parametrize("norm", ["batch", "layer", "none"])
def test_a_network_of_any_kind_is_written_and_read(
    norm: str, padding: str, scaling: str, dataset: Dataset, tmp_path: Path, cli: Cli
) -> None:
    kind: dict[str, Any] = {"arch": "9", "filters": "4", "norm": norm, "padding": padding, "scaling": scaling}
    trained = ps.train(dataset, epochs=1, patience=9, **kind)
    path = trained.save(tmp_path / "m.plush")
    assert np.array_equal(ps.load(path).weights["dense.weight"], trained.bundle.weights["dense.weight"])
    assert cli("info", path, "--json").json["provenance"]["scores"]["accuracy"] == trained.scores.accuracy
    stream = next(iter(dataset.path.glob("streams/*/*.csv")))
    live = cli("live", "--device", f"replay:{stream}?speed=0", "--model", path)
    assert live.status == 0, live.err
    assert '"cnn"' in live.out
    options = [word for key, value in kind.items() for word in (f"--{key}", value)]
    found = cli("evaluate", dataset.path, "--split", "by-subject:2", "--epochs", 1, "--workers", 1, "--json", *options)
    assert found.status == 0, found.err


def long_recordings(folder: Path, people: int, recordings: int) -> Dataset:
    """Recordings of several windows each, without a stream."""
    from plushsense.core.layouts import load_layout
    from plushsense.core.recorder_csv import Frames, write_recording
    from plushsense.dataset.importing.importers import import_recordings

    layout, rng = load_layout("accel-3"), np.random.default_rng(0)
    for person in range(people):
        (folder / "src" / f"P{person}").mkdir(parents=True)
        for number in range(recordings):
            for label in ("Slow", "Fast"):
                clock = np.arange(500, dtype=np.int64) * 10
                name = f"{label}_{1000 * person + number}_500.csv"
                frames = Frames(rng.integers(-900, 900, (500, 3)), clock, clock)
                write_recording(folder / "src" / f"P{person}" / name, frames, layout)
    return import_recordings(folder / "src", folder / "DS", layout="accel-3").dataset


@pytest.mark.parametrize(
    ("people", "kind"), [(1, "validation-recordings"), (2, "validation-recordings"), (3, "validation-subjects")]
)
def test_nothing_that_is_scored_was_trained_on(people: int, kind: str, tmp_path: Path) -> None:
    from plushsense.workflow.config import resolve
    from plushsense.workflow.preparation import prepare_training

    dataset = long_recordings(tmp_path, people, 4)
    made = prepare_training(dataset, resolve(None))
    assert len(made.windows) == 6 * len(dataset.recordings), "several windows a recording"
    trained, scored = (set(made.windows.recording[i].tolist()) for i in (made.train, made.fold.test))
    assert trained
    assert scored
    assert not trained & scored
    trained = ps.train(dataset, epochs=1, filters=(2, 2, 2), patience=9)
    assert trained.scores.split == kind
    assert not trained.scores.leaky
    if people < 3:
        assert "too high" in trained.scores.description


def test_the_toy_at_rest_does_not_flatter_a_training(tmp_path: Path) -> None:
    simulate(tmp_path / "raw", people=3, repetitions=1)
    dataset = ps.import_recordings(tmp_path / "raw", tmp_path / "DS", layout="plush-15").dataset
    scores = ps.train(dataset, epochs=1, filters=(2, 2, 2), patience=9).scores
    assert scores.simulated
    assert scores.nobody is not None and scores.nobody.windows > 0
    assert scores.accuracy is not None and scores.accuracy < 0.6, (
        "after one epoch only rest is known, and rest is nobody's"
    )


def test_a_file_under_two_labels_and_a_long_window_are_named(
    dataset: Dataset, make_session: Callable[[Path, int], None], tmp_path: Path
) -> None:
    from plushsense.dataset.statistics import fitting_window_s, median_gesture_s
    from plushsense.models.arch import Arch
    from plushsense.windows.cut import WindowSpec
    from plushsense.workflow.preparation import warn_of_files_twice, warn_of_long_windows

    said: list[str] = []
    warn_of_files_twice(dataset, dataset.gestures, said.append)
    assert said == []
    make_session(tmp_path / "R" / "P1", 1)
    slow = next((tmp_path / "R" / "P1").glob("Slow_*.csv"))
    (slow.parent / slow.name.replace("Slow", "Fast")).write_bytes(slow.read_bytes())
    twice = ps.import_recordings(tmp_path / "R", tmp_path / "TWICE", layout="accel-3").dataset
    warn_of_files_twice(twice, twice.gestures, said.append)
    assert len(said) == 1 and "as two gestures" in said[0] and "P1/Slow_" in said[0] and "P1/Fast_" in said[0]
    # Many copies are one line more.
    for name in sorted((tmp_path / "R" / "P1").glob("Slow_*.csv")):
        (tmp_path / "R" / "P2").mkdir(exist_ok=True)
        (tmp_path / "R" / "P2" / name.name).write_bytes(name.read_bytes())
    copies = ps.import_recordings(tmp_path / "R", tmp_path / "COPIES", layout="accel-3").dataset
    said.clear()
    warn_of_files_twice(copies, copies.gestures, said.append)
    assert len(said) == 2 and "more recordings have the same file" in said[1]

    def of(symbol: str, window_s: float, context: str = "stream", padding: str = "stream") -> str:
        spec, found = WindowSpec(window_s=window_s, context=context), list[str]()
        window = dataset.layout.samples(window_s)
        arch = Arch.parse(symbol, (4,) * 3, channels=3, classes=3, window=window, padding=padding)
        warn_of_long_windows(dataset, arch, spec, dataset.gestures, found.append)
        return "".join(found)

    usual_s = median_gesture_s(dataset)
    assert usual_s == 2.325
    assert of("14d1", 1.0) == ""
    window = of("14d1", 2.5)
    assert "window 2.5 s" in window and "begin before" in window and "try --window-s 2.3" in window
    assert "--arch" not in window and "repeat their gesture" in of("14d1", 2.5, "loop")
    kernels = of("14d1_39d2_41d4", 1.0, padding="mirror")
    assert "kernels 2.5 s, window 1 s" in kernels and "try --arch " in kernels and "--window-s" not in kernels
    assert of(kernels.rpartition(" ")[2], 1.0) == ""
    # Whoever follows an advice gets no other one.
    assert of("14d1", 2.3) == of("14d1_19d2_19d4", 2.3) == of("14d1_19d2_19d4", 1.3) == ""
    assert "a decision then reads" in of("79d1_39d2_19d4", 2.5) and of("79d1_39d2_19d4", 2.3) == ""
    assert [fitting_window_s(s) for s in (2.325, 0.8, 0.75, 0.3)] == [2.3, 0.8, 0.7, 0.5]


def test_a_gesture_of_one_person_is_named(dataset: Dataset) -> None:
    from plushsense.windows.cut import cut_windows
    from plushsense.workflow.preparation import warn_of_single_people

    windows = cut_windows(dataset)
    said: list[str] = []
    warn_of_single_people(windows, said.append)
    assert said == []
    person, label = str(windows.subject[0]), windows.labels[0]
    warn_of_single_people(windows.take(np.flatnonzero((windows.y != 0) | (windows.subject == person))), said.append)
    assert len(said) == 1 and said[0].startswith(f"only {person} made '{label}'")
