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
from opponents.case import fold, forward, macs_of, make_case
from opponents.programs import Workshop, ours, plain_window
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
        if source.name == "window.c":
            return compiled(shop, source, name, *flags)
        if not (kept / f"{name}.o").exists():
            compiled(shop, source, name, *flags).replace(kept / f"{name}.o")
        return kept / f"{name}.o"

    monkeypatch.setattr(Workshop, "compiled", once)


def words(*more: str) -> list[str]:
    return [str(REPO / "bench" / "peers.py"), *SMALL, "--rounds", "2", "--slice-ms", "1", *more]


def main(monkeypatch: pytest.MonkeyPatch, *more: str) -> int:
    monkeypatch.setattr(sys, "argv", words(*more))
    return peers.main()


def test_without_any_peer_ours_and_the_plain_window_are_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, done = main(monkeypatch, "--only", "plain", "--json", "--decisions", "3"), capsys.readouterr()
    assert code == 0, done.err
    report = json.loads(done.out)
    rows = {row["name"]: row for row in report["rows"]}
    assert len(rows) == 8
    for name, row in rows.items():
        assert len(row["seconds"]) == 2 and min(row["seconds"]) > 0, name
        assert row["memory_bytes"] > 0 and row["code_bytes"] > 0, name
    plain, mine = rows["plain float C of this bench -O2"], rows[peers.OUR_ROW]
    assert plain["check"]["agreement"] == 1.0 and plain["check"]["logit_error"] < 1e-5
    assert mine["check"]["decisions"] == 200 and mine["check"]["agreement"] > 0.85
    assert 0 < mine["check"]["logit_error"] < 0.2
    assert mine["times_slower"] == 1.0
    if shutil.which("valgrind") is None:
        missing("compilers", "valgrind is not installed")
    # Five samples against forty, of the same network in the same process, whatever the compiler makes of it.
    assert 2000 < mine["instructions"] < plain["instructions"]
    assert plain["times_instructions"] == plain["instructions"] / mine["instructions"]
    assert mine["instructions"] > rows["PlushSense C -O2, network only"]["instructions"]


def test_a_peer_that_is_not_installed_is_named_with_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    venv.create(tmp_path / "bare", with_pip=False, symlinks=sys.platform != "win32")
    bare = next(p for p in (tmp_path / "bare").glob("*/python*") if p.stem == "python")
    given = ("--only", "litert,executorch,onnx2c", "--python", str(bare), "--onnx2c", "nowhere", "--decisions", "0")
    code, done = main(monkeypatch, *given), capsys.readouterr()
    assert code == 0, done.err
    lines = done.out.splitlines()
    for title, way in (
        ("LiteRT", "not here: pip install ai-edge-litert ai-edge-quantizer"),
        ("ExecuTorch", "not here: pip install executorch"),
        ("onnx2c", "not here: pip install onnxruntime onnx"),
    ):
        assert any(line.startswith(title) and line.endswith(way) for line in lines), done.out
    assert sum("not measured" in line for line in lines) == len(peers.TARGETS)


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


def test_a_plain_window_with_zeros_before_it_gives_the_floats_answer(tmp_path: Path) -> None:
    case = make_case("5_4d2", "4,6", layout="accel-3", window=40, form="window")
    case.save(tmp_path)
    shop = Workshop(tmp_path)
    for entry in (*ours(case, shop), *plain_window(case, shop)):
        with Running(entry.command, tmp_path) as process:
            near = peers.checked(entry, process, case)
        if entry.reads == "window":
            assert near is not None and near["agreement"] == 1.0 and near["logit_error"] < 1e-5
        if entry.reads == "stream":
            assert near is None
    # The two forms are not the same question.
    assert np.abs(case.window_logits - case.stream_logits).max() > 0.01


def test_a_program_that_ends_is_told(tmp_path: Path) -> None:
    with (
        Running([sys.executable, "-c", "raise SystemExit('no model')"], tmp_path) as process,
        pytest.raises(Died) as told,
    ):
        process.ask("run 1")
    assert str(told.value) == "no model"


def row(name: str, family: str, seconds: list[float], instructions: float | None) -> dict[str, Any]:
    return {"name": name, "family": family, "seconds": seconds, "instructions": instructions}


def test_targets_are_judged_on_the_nearest_peer() -> None:
    rows = [
        row(peers.OUR_ROW, "ours", [1e-5, 2e-5], 100.0),
        row(peers.PLAIN_ROW, "ours", [2e-5, 2e-5], 300.0),
        row("big", "portable C", [1e-3, 4e-3], 9000.0),
        row("small", "portable C", [1e-3, 1e-3], 5400.0),
        row("quick", "xnnpack", [1e-5, 1e-5], 600.0),
        row("uncounted", "xnnpack", [1e-5, 1e-5], None),
    ]
    peers.compare(rows)
    assert [r["times_instructions"] for r in rows] == [1.0, 3.0, 90.0, 54.0, 6.0, None]
    assert rows[2]["times_slower"] == pytest.approx(150.0)  # of the rounds 100 and 200
    told = peers.verdicts(rows)
    assert [(t["against"], t["ratio"], t["reached"]) for t in told] == [
        ("small", 18.0, False),
        ("quick", 6.0, True),
        ("quick", 2.0, False),
    ]
