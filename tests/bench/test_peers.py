"""The bench against other runtimes: its own parts, which need a C compiler and no other runtime."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

REPO = Path(__file__).parents[2]

import peers
from opponents import tables
from opponents.case import Case, fold, forward, macs_of, make_case
from opponents.programs import CannotBuild, Workshop, require_cmsis_nn
from opponents.running import Died, Running

from plushsense.models.arch import Arch
from plushsense.models.reference import Network, random_weights
from support.requirements import missing
from support.sharing import built_once

SMALL = ("--arch", "5_4d2", "--filters", "4,6", "--layout", "accel-3", "--window", "40")


@pytest.fixture(autouse=True)
def compiler(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A C compiler, which compiles our own C once for all tests: it reads nothing of the folder of a case."""
    if shutil.which("gcc") is None:
        missing("compilers", "gcc is not installed")
    compiled, kept = Workshop.compiled, built_once(tmp_path_factory, "peers", lambda draft: None)

    def once(shop: Workshop, source: Path, name: str, *flags: str) -> Path:
        if not (kept / f"{name}.o").exists():
            compiled(shop, source, name, *flags).replace(kept / f"{name}.o")
        return kept / f"{name}.o"

    monkeypatch.setattr(Workshop, "compiled", once)


def words(*more: str) -> list[str]:
    return [str(REPO / "bench" / "peers.py"), *SMALL, "--rounds", "2", "--slice-ms", "1", *more]


def main(monkeypatch: pytest.MonkeyPatch, *more: str) -> int:
    monkeypatch.setattr(sys, "argv", words(*more))
    return peers.main()


@pytest.mark.exhaustive
def test_without_any_peer_ours_is_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    code, done = main(monkeypatch, "--only", "none", "--json", "--decisions", "3"), capsys.readouterr()
    assert code == 0, done.err
    report = json.loads(done.out)
    rows = {(row["name"], row["reads"]): row for row in report["rows"]}
    assert len(rows) == 3
    for row in rows.values():
        assert row["us"]["p90"] >= row["us"]["median"] >= row["us"]["p10"] > 0
        assert row["memory_bytes"] > 0 and row["code_bytes"] > 0
    mine, whole = rows[peers.OUR_ROW, "inputs"], rows[tables.WHOLE_ROW, "frames"]
    assert mine["check"] is None and mine["times_slower"] == 1.0
    assert whole["check"]["decisions"] == 200 and whole["check"]["agreement"] > 0.85
    assert 0 < whole["check"]["logit_error"] < 0.2
    if shutil.which("valgrind") is None:
        missing("compilers", "valgrind is not installed")
    assert 1000 < mine["instructions"] < whole["instructions"]


@pytest.mark.exhaustive
def test_a_peer_that_is_not_installed_is_named_with_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    venv.create(tmp_path / "bare", with_pip=False, symlinks=sys.platform != "win32")
    bare = next(p for p in (tmp_path / "bare").glob("*/python*") if p.stem == "python")
    given = ("--only", "litert,onnxruntime", "--python", str(bare), "--decisions", "0")
    code, done = main(monkeypatch, *given), capsys.readouterr()
    assert code == 0, done.err
    lines = done.out.splitlines()
    for title, way in (
        ("LiteRT", "not here: pip install ai-edge-litert ai-edge-quantizer"),
        ("onnxruntime", "not here: pip install onnxruntime onnx"),
    ):
        assert sum(line.startswith(title) and line.endswith(way) for line in lines) == 2, done.out
    with pytest.raises(CannotBuild, match="give --cmsis-nn DIR"):
        require_cmsis_nn(tmp_path)


@pytest.mark.parametrize("bad", [("--arch", "5_x"), ("--bundle", "nowhere.plush"), ("--cc", "no-such-compiler")])
def test_bad_input_is_refused_in_a_sentence(bad: tuple[str, str]) -> None:
    command = [sys.executable, *words(*bad, "--only", "none")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert "Traceback" not in done.stderr and done.stderr.startswith("bench/peers.py: ")


def test_folding_leaves_the_streams_answers() -> None:
    arch = Arch.parse("6d1_5d3_4d2", "4,6,8", channels=3, classes=5)
    weights = random_weights(arch, 4)
    weights["norm1.gain"] *= -1
    x = np.random.default_rng(0).normal(size=(5, 3, arch.span)).astype(np.float32)
    np.testing.assert_allclose(
        forward(arch, fold(arch, weights), x, padded=False), Network(arch, weights).forward(x), atol=1e-4
    )


def test_the_others_read_the_form_that_costs_them_less() -> None:
    paper, default = (make_case(symbol, "8,12,16") for symbol in ("14d1_39d2_41d4", "14d1_19d2_19d4"))
    assert (paper.form, paper.length, paper.macs) == ("window", 250, 3_212_000)
    assert (default.form, default.length) == ("span", default.arch.span)
    for case in (paper, default):
        assert case.macs == min(macs_of(case.arch, "window"), macs_of(case.arch, "span"))


@pytest.fixture(scope="module")
def small() -> Case:
    return make_case("5_4d2", "4,6", layout="accel-3", window=40, form="window")


def test_a_runtime_with_the_state_as_inputs_and_outputs_gives_the_streams_answer(small: Case, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    small.save(tmp_path)
    entry = peers.python_entry("onnxruntime", "stream", sys.executable, Workshop(tmp_path))
    with Running(entry.command, tmp_path) as process:
        near = peers.checked(entry, process, small)
    assert near is not None and near["agreement"] == 1.0 and near["logit_error"] < 1e-5


def test_a_program_that_ends_is_told(tmp_path: Path) -> None:
    with (
        Running([sys.executable, "-c", "raise SystemExit('no model')"], tmp_path) as process,
        pytest.raises(Died) as told,
    ):
        process.ask("run 1")
    assert str(told.value) == "no model"


def row(name: str, reads: str, instructions: float | None, times: float) -> dict[str, Any]:
    near = {"decisions": 200, "agreement": 0.95, "logit_error": 0.05}
    sizes = {"model_bytes": 1000, "code_bytes": None, "memory_bytes": None}
    us = {"median": 10 * times, "p10": 9.0, "p90": 99.0}
    return {
        "name": name,
        "reads": reads,
        "instructions": instructions,
        "times_slower": times,
        "us": us,
        "check": near,
    } | sizes


def test_the_tables_separate_kernels_from_algorithms_and_name_who_is_below_the_aim() -> None:
    rows = [
        row(peers.OUR_ROW, "inputs", 1000.0, 1.0), row(tables.PLAIN_ROW, "frames", 2500.0, 2.5),
        row("slow", "stream", 4000.0, 4.0), row("slow", "window", 200_000.0, 400.0),
        row("quick", "stream", 1400.0, 0.5), row("uncounted", "stream", None, 3.0),
    ]  # fmt: skip
    chip = [row(peers.OUR_ROW, "inputs", 2000.0, 9.0), row("CMSIS-NN", "stream", 2480.0, 9.0)]
    kernels = tables.same_algorithm(rows).markdown().splitlines()
    assert [line.split(" | ")[:3] for line in kernels[2:]] == [
        [f"| {peers.OUR_ROW}", "1 000", "1.00"], [f"| {tables.PLAIN_ROW}", "2 500", "2.50"], ["| uncounted", "—", "—"],
        ["| quick", "1 400", "1.40"], ["| slow", "4 000", "4.00"],
    ]  # fmt: skip
    (algorithm,) = tables.both_algorithms(rows).markdown().splitlines()[2:]
    assert algorithm.split(" | ")[:5] == ["| slow", "200 000", "50.00", "4000.0 (9.0–99.0)", "100.00"]
    assert "| CMSIS-NN | stream | 2 480 | 1.24 | 2.48 |" in tables.on_chip(chip, 1000).markdown()
    told = tables.verdict({"rows": rows, "chip": chip})
    assert "instructions: quick (1.40), CMSIS-NN on the Cortex-M4 (1.24); by time: quick (0.50)." in told


def test_the_page_has_the_tables_of_the_results_of_the_bench() -> None:
    """After a change of what the bench prints, measure again with --save (see the page)."""
    results, text = json.loads(peers.RESULTS.read_text("utf-8")), peers.PAGE.read_text("utf-8")
    assert peers.page_of(text, results) == text
    for name, symbol in peers.NETWORKS.items():
        report = results[name]
        assert report["case"]["symbol"] == symbol and report["absent"] == {}
        measured = {(row["name"].split(", ")[0], row["reads"]) for row in report["rows"]}
        named = [title.split(", ")[0] for title, _ in peers.PEERS.values()]
        for title in named:
            assert {(title, "stream"), (title, "window")} <= measured
        assert {row["name"] for row in report["chip"]} >= {peers.OUR_ROW, "CMSIS-NN int8 -O3"}
        ours = next(row["instructions"] for row in report["rows"] if row["name"] == peers.OUR_ROW)
        assert report["case"]["macs_ours"] / 8 < ours < report["case"]["macs"]
    with pytest.raises(ValueError, match="no place for the network paper"):
        peers.page_of("", results)
