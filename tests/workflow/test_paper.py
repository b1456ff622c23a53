"""The paper's archive as its scripts leave it: imported, and the paper's table beside ours."""

import csv
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import plushsense as ps
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import parse_name, read_recording
from plushsense.dataset.store import Dataset
from plushsense.experiments.baselines.models import BASELINES
from plushsense.experiments.baselines.run_baselines import BaselinesResult, ComparisonSpec, baselines

TESTS = Path(__file__).resolve().parents[1]

from support.archive import DELAYS, make_archive

pytestmark = pytest.mark.apart("paper")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    make_archive(folder)
    return folder


@pytest.fixture(scope="module")
def script() -> ModuleType:
    path = TESTS.parent / "examples" / "paper.py"
    spec = importlib.util.spec_from_file_location("paper", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["paper"] = module
    spec.loader.exec_module(module)
    return module


def test_the_archive_has_the_form_of_the_papers(made: Path) -> None:
    files = list((made / "archive").rglob("*.csv"))
    assert len(files) == 21
    assert {p.parent.name for p in files} == {"At rest", "Back stroke 1", "Tail pull", "Tail tap 2"}
    for path in files:
        name = parse_name(path.name)
        assert name is not None
        assert (len(str(name.epoch_ms)), name.label) == (7, path.parent.name)
        assert all(len(line.split(b";")) == 15 and b" " not in line for line in path.read_bytes().splitlines())
        assert path.read_bytes().count(b"\n") == name.rows
    ends = {b"\r\n" in p.read_bytes() for p in files}
    assert ends == {True, False}


@pytest.mark.parametrize(("top", "underscores"), [("", False), ("Plush data", True)])
@pytest.mark.parametrize("mapped", [False, True])
def test_it_imports_whole(tmp_path: Path, top: str, underscores: bool, mapped: bool) -> None:
    archive = make_archive(tmp_path, top=top, underscores=underscores)
    subjects = {"subjects": tmp_path / "map.csv"} if mapped else {}
    done = ps.import_recordings(archive, tmp_path / "DS", layout="plush-15", **subjects)  # type: ignore[arg-type]
    assert (done.recordings, done.rejected) == (21, ())
    assert done.gestures == ["At rest", "Back stroke 1", "Tail pull", "Tail tap 2"]
    assert done.subjects == (3 if mapped else 0)
    assert {r.subject for r in done.dataset.recordings if r.gesture == "At rest"} == {"none"}
    assert done.dataset.head.simulated
    asked = any("--subjects map.csv" in w for w in done.messages)
    assert asked is not mapped
    delays = [r for r in done.dataset.recordings if any("holds delays" in f for f in r.flags)]
    assert {r.gesture for r in delays} == {DELAYS}
    assert len(delays) == 6
    assert all(f.endswith("integrated") for r in done.dataset.recordings for f in r.flags), "no other warning"
    # The numbers are those of the sessions that the archive was made from.
    layout = load_layout("plush-15")
    rest = next(r for r in done.dataset.recordings if r.gesture == "At rest")
    frames = done.dataset.read(rest)
    sources = [read_recording(p, layout).frames for p in (tmp_path / "sessions" / "none").glob("At*.csv")]
    assert any(np.array_equal(frames.values, s.values[-len(frames) :]) for s in sources)


def test_the_table_is_made_and_goes_on_where_it_stood(
    made: Path, script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(made / "archive"), "--subjects", str(made / "map.csv"), "--out", str(tmp_path), "--quick"]
    assert script.main(words) == 0
    said = capsys.readouterr().out
    assert said.startswith("SIMULATION")
    assert "Untested on the original" in said
    with (tmp_path / "paper.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {(row["simulated"], row["quick"]) for row in rows} == {("yes", "yes")}
    by_what = {row["what"]: row for row in rows}
    assert (by_what["recordings"]["paper"], by_what["recordings"]["ours"]) == ("1326", "21")
    assert by_what["recordings of Tail tap 2 (outputs of their scripts)"]["paper"] == "75"
    assert by_what["recordings to train, validate and test (outputs of their scripts)"]["ours"] == "14 / 4 / 3"
    resolved = [line for line in said.splitlines() if line.startswith("The grid “scripts” as resolved")]
    assert len(resolved) == 1
    for setting in (
        "split: windows:file-order",
        "padding: mirror",
        "weight decay 0.0001",
        "scaling of the inputs: none",
    ):
        assert setting in resolved[0]
    mean = by_what["macro-F1, mean over the people, with recordings at rest"]
    without = by_what["macro-F1, mean over the people, without recordings at rest"]
    assert mean["paper"] == without["paper"] and mean["ours"] != without["ours"]
    assert (mean["section"], mean["paper"], mean["n"]) == ("4.4", "0.687 ± 0.114", "1 seed, 3 people")
    assert 0.0 <= float(mean["ours"].split()[0]) <= 1.0
    chosen = {what: row for what, row in by_what.items() if what.startswith("14d1_39d2_41d4 8/12/16")}
    assert [row["paper"] for row in chosen.values()] == ["75.0 %", "75.0 %"]
    assert sorted("leaky" in what for what in chosen) == [False, True]
    assert "compare the paper's 75.0 %" in said
    forest = next(row for what, row in by_what.items() if what.startswith("random forest (200) on paper-statistics ("))
    assert forest["paper"] == "95.9 %" and "leaky" in forest["what"] and forest["n"].startswith("5 folds, ")
    page = (tmp_path / "paper.html").read_text(encoding="utf-8")
    assert "SIMULATION" in page
    assert "0.687 ± 0.114" in page
    folds = {p: p.stat().st_mtime_ns for p in (tmp_path / "DS" / "cache" / "folds").iterdir()}
    assert len(folds) == 3
    assert script.main(words) == 0
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "DS" / "cache" / "folds").iterdir()} == folds
    assert capsys.readouterr().out == said


@pytest.mark.exhaustive
def test_the_papers_result_with_pca_stands_beside_pca_without_scaling(
    made: Path, script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Any, ...]] = []

    def small(dataset: Dataset, *, spec: ComparisonSpec, **settings: Any) -> BaselinesResult:
        asked.append((*spec.models, spec.features, spec.pca, spec.splits))
        return baselines(dataset, spec=replace(spec, splits=("windows:2",), models="forest"), workers=1, **settings)

    monkeypatch.setattr(script, "baselines", small)
    monkeypatch.setitem(BASELINES, "forest", BASELINES["tree"])
    rows = script.Paper(made / "archive", None, tmp_path, seeds=1, quick=False).baselines()
    assert asked == [
        ("forest", ("paper-statistics",), "all", ("windows:5",)),
        ("cubic-svm", "forest", "subspace-knn", ("flattened",), "no", ("windows:5",)),
    ]
    assert [(row.what.partition(" (leaky")[0], row.paper) for row in rows] == [
        ("decision tree on paper-statistics", "95.9 %"),
        ("decision tree on paper-statistics, PCA unscaled", "66.3 %"),
        ("decision tree on paper-statistics, PCA", "-"),
        ("decision tree on flattened", "89.7 %"),
    ]


@pytest.mark.exhaustive
def test_without_a_mapping_the_people_are_asked_for(
    made: Path, script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main([str(made / "archive"), "--out", str(tmp_path), "--quick"]) == 0
    assert "needs --streams or --subjects" in capsys.readouterr().out
    assert script.main([str(made / "nowhere"), "--out", str(tmp_path / "x")]) == 2
    assert "There is no " in capsys.readouterr().err
