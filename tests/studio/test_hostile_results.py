"""Folders of results from elsewhere: nothing of them runs, ends a page, or leads out of the studio's folders."""

from __future__ import annotations

import copy
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import PlushSenseError
from plushsense.models.arch import Arch
from plushsense.studio.app import stored_results
from plushsense.studio.app.stored_results import EVALUATION, TRIAL, ResultRow, StoredResults, split_text
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.train.result_details import confusion_table, worst_table
from plushsense.studio.pages.train.results_section import comparable_groups, pareto_options, pareto_table
from plushsense.studio.widgets.verdict import figures, headline, limits, people_table
from plushsense.workflow.reporting import LEARNING, SCORES
from support.study import evaluation

pytestmark = pytest.mark.apart("hostile-results")

HOSTILE = "<img src=x onerror='window.ran=1'>"
ARCH = Arch.parse("14d1_19d2_19d4", (8, 12, 16))
SCORED: dict[str, Any] = {
    **evaluation("by-subject:5", "stream", "stream", 0.6, people=4),
    "model": {
        "symbol": ARCH.symbol,
        "filters": [8, 12, 16],
        "padding": "stream",
        "parameters": 6650,
        "macs_per_step": 9,
    },
    "config": {
        "preset": "people",
        "training": {"epochs": 60},
        "windows": {"context": "stream"},
        "evaluation": {"train_context": None},
    },
    "dataset": {"name": "DS", "hash": "ab12"},
    "simulated": True,
    "over": "subjects",
    "pooled": {"accuracy": 0.6},
    "code_version": "0.1.0",
}
ROW = (
    "trial,arch,filters,padding,epochs,batch_asked,status,accuracy,accuracy_sd,macro_f1,macro_f1_sd,split,leaky,"
    "simulated,folds,seeds,parameters,macs_per_step\n"
    "t1,{arch},8/12/16,stream,60,64,done,{accuracy},,0.4,,by-subject:5,false,true,5,1,{parameters},9\n"
)
SWEPT = {
    "grid": {"seeds": [0]}, "dataset": "DS", "preset": "people", "context": "stream", "labels": ["a", "b"],
    "affects": ["positive", None], "confusions": {"t1": [[3, 1], [0, 2]]}, "predictions": {"t1": "predictions.parquet"},
}  # fmt: skip


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "home" / "datasets" / "DS").mkdir(parents=True)
    (tmp_path / "home" / "datasets" / "DS" / "dataset.toml").write_text('name = "DS"\n')
    return tmp_path / "home"


def folder_of(home: Path, name: str = "one") -> Path:
    folder = home / "datasets" / "DS" / "evaluations" / name
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def evaluated(home: Path, change: Callable[[dict[str, Any]], Any] = lambda table: None) -> Path:
    """An evaluation with something changed; what changes return is written in its place, if anything."""
    table = copy.deepcopy(SCORED)
    made = change(table)
    path = folder_of(home) / SCORES
    path.write_text(made if isinstance(made, str) else json.dumps(table), encoding="utf-8")
    return path


def swept(home: Path, table: str, summary: dict[str, Any] = SWEPT) -> Path:
    folder = folder_of(home)
    (folder / "trials.csv").write_text(table, encoding="utf-8")
    (folder / "sweep.json").write_text(json.dumps(summary), encoding="utf-8")
    return folder


def drawn(home: Path) -> tuple[list[ResultRow], str]:
    """The rows of the page Train, and what it draws of them and their details; a refusal is a sentence."""
    stored, w, made = StoredResults(Workspace(home)), Words("en"), ""
    rows = stored.rows()
    for row in rows:
        made += "".join(
            [headline(w, row), *limits(w, row), figures(w, row), people_table(w, row), split_text(w, row.split)]
        )
        try:
            details = stored.details(row)
        except PlushSenseError:
            continue
        for confusion, by_affect in ((details.by_gesture, False), (details.by_affect, True)):
            if confusion is not None:
                made += confusion_table(w, confusion, by_affect, True) + worst_table(w, confusion, by_affect, True)
        if row.kind == TRIAL:
            with pytest.raises(PlushSenseError):
                stored.misread(row, ["a"], ["b"])
    for group in comparable_groups(w, [*rows, *rows]).values():
        made += json.dumps(pareto_options(w, group), allow_nan=False) + pareto_table(w, group)
    return rows, made


def put(*keys: Any) -> Callable[[dict[str, Any]], None]:
    """Set the value at the keys before the last argument, the value."""
    *steps, last, value = keys

    def change(table: Any) -> None:
        for step in steps:
            table = table[step]
        table[last] = value

    return change


def test_a_sound_result_is_read_whole(home: Path) -> None:
    evaluated(home)
    rows, made = drawn(home)
    assert [row.kind for row in rows] == [EVALUATION] and "Back stroke 1" in made
    swept(home, ROW.format(arch=ARCH.symbol, accuracy=0.5, parameters=6650))
    assert sorted(row.kind for row in drawn(home)[0]) == [EVALUATION, TRIAL]


@pytest.mark.parametrize(
    "change",
    [
        put("accuracy", "mean", float("nan")), put("accuracy", "mean", float("inf")), put("accuracy", "mean", "0.5"),
        put("accuracy", "sd", -1e300), put("accuracy", "ci95", [1]), put("accuracy", "ci95", [None, None]),
        put("macro_f1", []), put("model", "parameters", 0), put("model", "parameters", 1e300),
        put("model", "parameters", "many"), put("model", "filters", 3), put("model", None),
        put("config", "training", 7),
        put("dataset", "name", {}), put("dataset", "name", "x" * 10_000), put("split", 5),
        put("per_class", {"a": 1}), put("subjects", [{"subject": [], "accuracy": 0.5}]), put("over", "nothing"),
        put("subjects", 0, "accuracy", float("nan")), put("nobody", "accuracy", "all"), put("seeds", 3),
        lambda table: "[" * 100_000, lambda table: "[]", lambda table: "\ud800".encode("utf-8", "replace").decode(),
        lambda table: '{"accuracy": ' + "9" * 10_000 + "}",
    ],
)  # fmt: skip
def test_a_result_with_a_wrong_value_is_left_out(home: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    evaluated(home, change)
    assert drawn(home)[0] == []


@pytest.mark.parametrize(
    "change",
    [
        put("confusion", None), put("confusion", "counts", [[1]]), put("confusion", "counts", 0, 0, -5),
        put("confusion", "counts", 0, 0, float("nan")), put("confusion", "counts", 0, 0, float("inf")),
        put("confusion", {"labels": ["x"] * 3000, "counts": [[0] * 3000] * 3000}),
        put("confusion_affect", "labels", ["joy", "b", "c"]), put("per_class", 0, "affect", HOSTILE),
        put("pooled", "accuracy", "all"), put("subjects", 0, "windows", "many"), put("subjects", 0, "macro_f1", "most"),
        put("confusion_affect", "counts", 7),
    ],
)  # fmt: skip
def test_details_with_a_wrong_value_are_a_sentence(home: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    evaluated(home, change)
    stored = StoredResults(Workspace(home))
    (row,) = stored.rows()
    with pytest.raises(PlushSenseError, match="Compute it again"):
        stored.details(row)


def test_names_are_text_and_no_format(home: Path) -> None:
    def hostile(table: dict[str, Any]) -> None:
        table["confusion"]["labels"] = [HOSTILE, *table["confusion"]["labels"][1:]]
        table["per_class"][0]["label"] = table["subjects"][0]["subject"] = table["dataset"]["name"] = HOSTILE
        table["split"] = f"{{k.__class__}}{{k:>99999999999}}{HOSTILE}"

    evaluated(home, hostile)
    rows, made = drawn(home)
    assert rows[0].split.startswith("{k.__class__}") and split_text(Words("en"), rows[0].split) == rows[0].split
    assert "&lt;img" in made and "<img" not in made.replace(rows[0].split, "")


@pytest.mark.parametrize("values", [{"accuracy": "nan"}, {"parameters": "-3"}, {"arch": "x" * 200_000}, {"arch": "\0"}])
def test_a_sweep_with_a_wrong_value_is_left_out(home: Path, values: dict[str, str]) -> None:
    swept(home, ROW.format(**{"arch": ARCH.symbol, "accuracy": 0.5, "parameters": 6650, **values}))
    assert all("\0" in row.network for row in drawn(home)[0])


def test_a_learning_curve_with_wrong_values_hides_the_result_and_ends_no_page(home: Path) -> None:
    path = evaluated(home)
    for text, found in (("[" * 100_000, 1), ('{"ci95": [1, "b"], "more": 2, "gain": 1}', 0), ("{}", 1)):
        path.with_name(LEARNING).write_text(text)
        assert len(drawn(home)[0]) == found


def test_nothing_outside_is_read(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / SCORES).write_text(json.dumps(SCORED), encoding="utf-8")
    inside = swept(home, ROW.format(arch=ARCH.symbol, accuracy=0.5, parameters=6650))
    (elsewhere / "predictions.parquet").write_bytes(b"PAR1")
    stored = StoredResults(Workspace(home))
    (row,) = stored.rows()
    for name in ("../../../../../elsewhere/predictions.parquet", str(elsewhere / "predictions.parquet")):
        (inside / "sweep.json").write_text(json.dumps({**SWEPT, "predictions": {"t1": name}}), encoding="utf-8")
        with pytest.raises(PlushSenseError, match="is not in the studio's folder"):
            stored.misread(row, ["a"], ["b"])
    if sys.platform != "win32":
        (folder_of(home, "linked") / SCORES).symlink_to(elsewhere / SCORES)
        (home / "datasets" / "DS" / "evaluations" / "folder").symlink_to(elsewhere)
        (folder_of(home, "curved") / SCORES).write_text(json.dumps(SCORED), encoding="utf-8")
    assert {Path(found.path).name for found in StoredResults(Workspace(home)).rows()} <= {"one", "curved"}
    monkeypatch.setattr(stored_results, "_MOST_BYTES", 1000)
    assert StoredResults(Workspace(home)).rows() == [row]
