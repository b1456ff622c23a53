"""The verbs as a user types them: JSON on standard output, sentences on standard error, status 0, 1 or 2."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.apps.cli.main import VERBS
from plushsense.dataset.store import Dataset

Cli = Callable[..., Any]

SMALL = ("--filters", "4,4,4", "--epochs", "40", "--batch", "8", "--workers", "1")


def test_help_names_every_verb(cli: Cli) -> None:
    ran = cli("--help")
    assert ran.status == 0
    assert all(verb in ran.out for verb in VERBS)


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    from plushsense.apps.cli.main import main

    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--help"], ["arch", "14d1", "--filters", "8"], ["info", "--help"]])
def test_light_verbs_load_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys\n"
        "from plushsense.apps.cli.main import main\n"
        f"try: main({words!r})\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'polars', 'matplotlib', 'serial', 'scipy'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_import_plushsense_loads_not_even_numpy() -> None:
    code = "import sys, plushsense; sys.exit(1 if {'numpy', 'torch'} & set(sys.modules) else 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_arch_counts_the_papers_network(cli: Cli) -> None:
    found = cli("arch", "14d1_39d2_41d4", "--filters", "8,12,16", "--padding", "mirror", "--json").json
    assert found["parameters"] == 13262
    assert found["receptive_field"] == found["span"] == 250
    assert found["macs_per_window"] == found["macs_per_step"] == 3_212_000
    assert found["table3"] == "13.2k"
    ours = cli("arch", "14d1_19d2_19d4", "--filters", "8,12,16", "--json").json
    assert (ours["receptive_field"], ours["macs_per_step"], ours["span"] <= 250) == (122, 33520, True)


def test_import_info_train_evaluate_report(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    ds = tmp_path / "DS"
    found = cli("import", recordings, ds, "--layout", "accel-3", "--json").json
    assert (found["recordings"], found["subjects"], found["streams"]) == (30, 5, 5)
    assert found["rejected"] == found["warnings"] == []
    assert cli("info", ds, "--json").json["located_in_stream"] == 30
    model = tmp_path / "m.plush"
    trained = cli("train", ds, "--out", model, "--filters", "4,4,4", "--epochs", "8", "--json").json
    assert trained["bundle"] == str(model)
    assert len(trained["history"]) == 8
    assert not trained["scores"]["leaky"]
    assert cli("info", model, "--json").json["provenance"]["dataset_hash"] == found["hash"]
    assert "already there" in cli("train", ds, "--out", model).err
    ran = cli("evaluate", ds, *SMALL, "--json")
    result = ran.json
    assert result["split"] == "leave-one-subject-out"
    assert result["context"] == "stream"
    assert not result["leaky"]
    assert [f["subject"] for f in result["folds"]] == ["P1", "P2", "P3", "P4", "P5"]
    assert result["accuracy"]["mean"] > 0.6, "three speeds of waving are not hard"
    saved = json.loads((Path(result["out"]) / "evaluation.json").read_text())
    assert saved["accuracy"] == result["accuracy"]
    import polars

    frame = polars.read_parquet(Path(result["out"]) / "predictions.parquet")
    assert set(frame["subject"]) == {"P1", "P2", "P3", "P4", "P5"}
    assert len(frame) == result["by_context"]["stream"]["windows"] + sum(
        result["by_context"].get(k, {"windows": 0})["windows"] for k in ("loop", "inside")
    )
    cli("evaluate", ds, *SMALL, "--split", "windows:2")
    page = tmp_path / "r.html"
    assert cli("report", page, "--dataset", ds, "--model", model, "--json").json["evaluations"] == 2
    text = page.read_text()
    assert "leaky" in text.lower()
    assert "P5" in text
    assert found["hash"][:8] in text


def test_evaluate_goes_on_where_it_stood(cli: Cli, dataset: Dataset) -> None:
    first = cli("evaluate", dataset.path, *SMALL, "--json")
    again = cli("evaluate", dataset.path, *SMALL, "--json")
    assert "5 of 5 folds (5 from before)" in again.err
    assert again.json["folds"] == first.json["folds"]
    kept = sorted((dataset.path / "cache" / "folds").iterdir())
    kept[0].unlink()
    kept[1].write_bytes(kept[1].read_bytes()[:100])
    healed = cli("evaluate", dataset.path, *SMALL, "--json")
    assert "(3 from before)" in healed.err
    assert healed.json["accuracy"] == first.json["accuracy"], "the same seed gives the same fold"
    other = cli("evaluate", dataset.path, *SMALL, "--seed", "1", "--json")
    assert "from before" not in other.err


def test_trained_on_loops_scored_on_the_stream(cli: Cli, dataset: Dataset) -> None:
    found = cli("evaluate", dataset.path, *SMALL, "--train-context", "loop", "--json").json
    assert (found["train_context"], found["context"]) == ("loop", "stream")


def test_scores_of_a_simulation_say_so(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    from plushsense.dataset.importers import import_recordings

    import_recordings(recordings, tmp_path / "DS", layout="accel-3", simulated=True)
    ran = cli("evaluate", tmp_path / "DS", *SMALL, "--split", "by-subject:2", "--out", tmp_path / "e")
    assert ran.out.startswith("SIMULATION")
    assert "simulation" in (tmp_path / "e" / "report.html").read_text().lower()


def test_a_configuration_file_and_flags_over_it(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    config = tmp_path / "run.toml"
    config.write_text('[model]\nfilters = "4,4,4"\n[training]\nepochs = 3\n[windows]\ncontext = "loop"\n')
    out = tmp_path / "m.plush"
    assert len(cli("train", dataset.path, "--config", config, "--out", out, "--json").json["history"]) == 3
    found = cli("train", dataset.path, "--config", config, "--epochs", "2", "--out", out, "--force", "--json").json
    assert len(found["history"]) == 2
    assert cli("info", out, "--json").json["filters"] == [4, 4, 4]


BAD = [
    (["arch", "14d1_x9", "--filters", "8,12"], "    14d1_x9\n         ^"),
    (["arch", "14d1_39d2", "--filters", "8"], "2 layers but only 1 filter"),
    (["arch", "14d1", "--filters", "8", "--paddng", "x"], "Did you mean '--padding'?"),
    (["trian"], "Did you mean 'train'?"),
    (["import", "{recordings}", "{tmp}/x", "--layout", "plush-15"], "has 5 columns, but a file of layout 'plush-15'"),
    (["import", "{recordings}", "{tmp}/x", "--layout", "accel3"], "Did you mean 'accel-3'?"),
    (["import", "{tmp}", "{tmp}/x", "--layout", "accel-3"], "holds no recording"),
    (["evaluate", "{tmp}"], "is not a data set"),
    (["evaluate", "{ds}", "--split", "by-subjct:5"], "Did you mean 'by-subject:5'?"),
    (["evaluate", "{ds}", "--split", "by-subject:50"], "there are 5"),
    (["evaluate", "{ds}", "--context", "strem"], "Did you mean 'stream'?"),
    (["train", "{ds}", "--classes", "Slwo,Fast"], "Did you mean 'Slow'?"),
    (["train", "{ds}", "--preset", "lso"], "Did you mean 'loso'?"),
    (["live", "--device", "virtual://", "--model", "{half}"], "is damaged"),
    (["live", "--device", "virtual://", "--model", "{tmp}/none.plush"], "none.plush"),
    (["live", "--device", "serial:///dev/ttyUSB77", "--model", "{bundle}"], "there is no port"),
    (["live", "--device", "seriel://x", "--model", "{bundle}"], "Did you mean 'serial'?"),
    (["live", "--device", "virtual://", "--model", "{bundle}", "--engine", "int8"], "not built yet"),
    (["report", "{tmp}/r.html", "--dataset", "{ds}", "--evaluation", "{tmp}/none"], "There is no evaluation"),
    (["toy", "--tcp", "0", "--gestures", "Tail tup 1"], "Did you mean 'Tail tap 1'?"),
]


@pytest.mark.parametrize(("words", "said"), BAD, ids=[" ".join(w[:4]) for w, _ in BAD])
def test_bad_input_is_one_sentence_and_status_2(
    words: list[str], said: str, cli: Cli, recordings: Path, dataset: Dataset, bundle: Path, tmp_path: Path
) -> None:
    half = tmp_path / "half.plush"
    half.write_bytes(bundle.read_bytes()[: bundle.stat().st_size // 2])
    empty = tmp_path / "empty"
    empty.mkdir()
    places = {"recordings": recordings, "tmp": empty, "ds": dataset.path, "half": half, "bundle": bundle}
    ran = cli(*(word.format(**places) for word in words), "--json")
    assert ran.status == 2
    assert said in ran.err
    assert ran.out == ""
    assert "Traceback" not in ran.err


def test_a_layout_key_misspelt(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    layout = tmp_path / "own.toml"
    layout.write_text('name = "own"\nrate_hertz = 100.0\nchannels = []\nwire = []\n')
    ran = cli("import", recordings, tmp_path / "DS", "--layout", layout)
    assert ran.status == 2
    assert "Unknown key 'rate_hertz'" in ran.err
    assert "Did you mean 'rate_hz'?" in ran.err
