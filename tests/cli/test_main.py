"""The verbs as a user types them: JSON on standard output, sentences on standard error, status 0, 1 or 2."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import pytest

from plushsense.cli.main import load_verb
from plushsense.cli.options import VERBS
from plushsense.cli.settings import report_epochs
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.dataset.store import Dataset
from plushsense.models.bundle import Bundle
from support.bundles import odd_bundle

pytestmark = pytest.mark.apart("trainings")

Cli = Callable[..., Any]

LEAKY = '<span class="leaky">LEAKY</span>'
SMALL = ("--filters", "4,4,4", "--epochs", "2", "--batch", "8", "--workers", "1")


def test_help_names_every_verb(cli: Cli) -> None:
    ran = cli("--help")
    assert ran.status == 0
    assert all(verb in ran.out for verb in VERBS)


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_has_help(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    from plushsense.cli.main import main

    with pytest.raises(SystemExit) as ended:
        main([verb, "--help"])
    assert ended.value.code == 0
    assert "--json" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        ["--help"],
        ["arch", "14d1", "--filters", "8"],
        *([v, "--help"] for v in ("info", "sweep", "baselines")),
    ],
)
def test_light_verbs_load_nothing_heavy(words: list[str]) -> None:
    code = (
        "import sys\n"
        "from plushsense.cli.main import main\n"
        f"try: main({words!r})\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'polars', 'matplotlib', 'serial', 'scipy', 'sklearn', 'ray'} & set(sys.modules)\n"
        "sys.exit(str(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_import_plushsense_loads_not_even_numpy() -> None:
    code = "import sys, plushsense; sys.exit(1 if {'numpy', 'torch'} & set(sys.modules) else 0)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_control_characters_in_files_do_not_reach_the_terminal(cli: Cli, tmp_path: Path) -> None:
    gestures = GestureSet("any", (Gesture("wave\x1b[2J\x9b"), Gesture("tap\nplushsense: all is well")))
    path = odd_bundle(tmp_path / "m.plush", gestures=gestures)
    shown, table = cli("info", path).out, cli("info", path, "--json")
    assert "\x1b" not in shown and r"wave\u001b[2J" in shown and "\nplushsense:" not in shown
    assert "\x9b" not in table.out and table.json["gestures"] == list(gestures.labels)
    (tmp_path / "layout.toml").write_text(
        'name = "a"\nrate_hz = 1\nwire = ["x\\u001b[2J\\nplushsense: fine"]\nchannels = []'
    )
    refused = cli("toy", "--tcp", "0", "--layout", tmp_path / "layout.toml").err
    assert "\x1b" not in refused and refused.count("\n") == 1 and r"\u001b[2J\u000aplushsense: fine" in refused


def test_arch_counts_the_papers_network(cli: Cli) -> None:
    found = cli("arch", "14d1_39d2_41d4", "--filters", "8,12,16", "--padding", "mirror", "--json").json
    assert found["parameters"] == 13262
    assert found["receptive_field"] == found["span"] == 250
    assert found["macs_per_window"] == found["macs_per_step"] == 3_212_000
    assert found["table3"] == "13.2k"
    ours = cli("arch", "14d1_19d2_19d4", "--filters", "8,12,16", "--json").json
    assert (ours["receptive_field"], ours["macs_per_step"], ours["span"] <= 250) == (122, 33520, True)
    slow = ("arch", "14d1_19d2_19d4", "--filters", "8,12,16", "--rate")
    assert "122 samples, 6.10 s at 20 Hz" in cli(*slow, 20).out and "--rate is 0" in cli(*slow, 0).err


def test_import_info_train_evaluate_report(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    ds = tmp_path / "DS"
    found = cli("import", recordings, ds, "--layout", "accel-3", "--json").json
    assert (found["recordings"], found["subjects"], found["streams"]) == (30, 5, 5)
    assert found["rejected"] == found["warnings"] == []
    info = cli("info", ds, "--json").json
    assert (info["located_in_stream"], info["trimmed"], info["offsets"]) == (30, 0, {})
    model = tmp_path / "m.plush"
    trained = cli("train", ds, "--out", model, "--filters", "4,4,4", "--epochs", "8", "--json").json
    assert trained["bundle"] == str(model)
    assert len(trained["history"]) == 8
    assert trained["scores"]["split"] == "validation-subjects"
    held = set(cli("info", model, "--json").json["provenance"]["validation_subjects"])
    assert held
    assert all(person in trained["scores"]["said"] for person in held)
    card = cli("info", model, "--json").json
    assert (card["receptive_field_s"], card["span_s"]) == (1.18, 2.47)
    assert cli("info", model, "--json").json["provenance"]["dataset_hash"] == found["hash"]
    assert "already there" in cli("train", ds, "--out", model).err
    ran = cli("evaluate", ds, *SMALL, "--epochs", "40", "--json")
    result = ran.json
    assert result["split"] == "leave-one-subject-out"
    assert result["context"] == "stream"
    assert not result["leaky"]
    assert [f["subject"] for f in result["folds"]] == ["P1", "P2", "P3", "P4", "P5"]
    assert result["accuracy"]["mean"] > 0.45, "three speeds of waving: above the chance of 1 in 3"
    saved = json.loads((Path(result["out"]) / "evaluation.json").read_text())
    assert saved["accuracy"] == result["accuracy"]
    import polars

    frame = polars.read_parquet(Path(result["out"]) / "predictions.parquet")
    assert set(frame["subject"]) == {"P1", "P2", "P3", "P4", "P5"}
    assert len(frame) == result["by_context"]["stream"]["windows"] + sum(
        result["by_context"].get(k, {"windows": 0})["windows"] for k in ("loop", "inside")
    )
    page = tmp_path / "r.html"
    assert cli("report", page, "--dataset", ds, "--model", model, "--json").json["evaluations"] == 1
    assert LEAKY not in page.read_text(encoding="utf-8")
    assert cli("evaluate", ds, *SMALL, "--split", "windows:2").out.startswith("LEAKY")
    assert cli("report", page, "--dataset", ds, "--model", model, "--json").json["evaluations"] == 2
    text = page.read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith('<tr><td><a href="#E')]
    assert [(LEAKY in row, "5 people" in row, "2 folds" in row) for row in rows] == [
        (False, True, False),
        (True, False, True),
    ]
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


def test_a_learning_curve_stands_beside_the_evaluation(cli: Cli, dataset: Dataset) -> None:
    ran = cli("evaluate", dataset.path, *SMALL, "--people", "1,2,4", "--json")
    curve = ran.json["learning"]
    assert [point["people"] for point in curve["points"]] == [1, 2, 4] and curve["more"] == 3
    # The folds themselves are trained on four people, and not again.
    assert curve["points"][-1]["accuracy"] == pytest.approx(ran.json["accuracy"]["mean"])
    sentence = "Training with 3 more people would change the accuracy by"
    assert sentence in Path(ran.json["report"]).read_text(encoding="utf-8")
    shown = cli("evaluate", dataset.path, *SMALL, "--people", "2").out
    assert "people trained on" in shown and sentence in shown
    # An evaluation of other settings in the same folder does not quote the curve of the first.
    other = cli("evaluate", dataset.path, *SMALL, "--seed", "1", "--out", ran.json["out"], "--force", "--json")
    assert sentence not in Path(other.json["report"]).read_text(encoding="utf-8")
    for wrong, split, why in (
        ("5", "leave-one-subject-out", "is trained on 4"),
        ("4", "leave-one-subject-out", "is trained on 4"),
        ("1", "by-recording:2", "leaves people out"),
    ):
        refused = cli("evaluate", dataset.path, *SMALL, "--people", wrong, "--split", split)
        assert refused.status != 0 and why in refused.err


def test_evaluate_says_what_the_preset_took(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    words = ("--arch", "v4_5", "--filters", "3,4", "--epochs", "1", "--split", "by-subject:2", "--out", tmp_path / "e")
    assert "1 epoch, batches of 32, seed 0" in cli("evaluate", dataset.path, *words).out


def test_trained_on_loops_scored_on_the_stream(cli: Cli, dataset: Dataset) -> None:
    found = cli("evaluate", dataset.path, *SMALL, "--train-context", "loop", "--json").json
    assert (found["train_context"], found["context"]) == ("loop", "stream")


def test_scores_of_a_simulation_say_so(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    from plushsense.dataset.importing.importers import import_recordings

    import_recordings(recordings, tmp_path / "DS", layout="accel-3", simulated=True)
    ran = cli("evaluate", tmp_path / "DS", *SMALL, "--split", "by-subject:2", "--out", tmp_path / "e")
    assert ran.out.startswith("SIMULATION")
    assert "simulation" in (tmp_path / "e" / "report.html").read_text().lower()


def test_a_configuration_file_and_flags_over_it(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    config = tmp_path / "run.toml"
    config.write_text('[model]\nfilters = "4,4,4"\n[training]\nepochs = 3\n[windows]\ncontext = "loop"\n')
    out = tmp_path / "m.plush"
    assert len(cli("train", dataset.path, "--config", config, "--out", out, "--json").json["history"]) == 3
    said = cli("train", dataset.path, "--config", config, "--epochs", "2", "--out", out, "--force").out
    assert "of 2 kept, batches of 32" in said
    assert "reads the last 2.47 s (247 samples at 100 Hz), through kernels of 1.18 s (118)." in said
    assert cli("info", out, "--json").json["filters"] == [4, 4, 4]


BAD = [
    (["arch", "14d1_x9", "--filters", "8,12"], "    14d1_x9\n         ^"),
    (["arch", "14d1", "--filters", "8", "--paddng", "x"], "Did you mean '--padding'?"),
    (["arch", "14d1", "--filtres", "8"], "Unknown option --filtres"),
    (["arch", "14d1", "--filtres=8"], "Did you mean '--filters'?"),
    (["arch", "14d1"], "are required: --filters. See"),
    (["evaluate", "{ds}", "--workers", "-1"], "workers is -1"),
    (["evaluate", "{ds}", "--out", "{half}"], "is a file; give a folder"),
    (["simulate", "{half}/deeper", "--people", "1"], "half.plush"),
    (["import", "{recordings}", "{half}/deeper", "--layout", "accel-3"], "half.plush"),
    (["demo", "--out", "{half}"], "half.plush"),
    (["report", "{half}", "--dataset", "{ds}"], "does not end in .html"),
    (["report", "{thesis}", "--dataset", "{ds}"], "is not a report of PlushSense"),
    (["evaluate", "{ds}", "--out", "{thesis_folder}"], "is not a report of PlushSense"),
    (["train", "{ds}", "--out", "{tmp}", "--force"], "is a folder: give a file"),
    (["stream-eval", "{ds}", "--model", "{bundle}", "--subjects", ",,"], "names nobody"),
    (["merge", "{ds}", "{ds}", "--out", "{tmp}/set.toml"], "give --merges or --groups"),
    (["sweep", "{ds}", "--seeds", "1001", "--dry-run"], "accepted are 1 to 1000"),
    (["trian"], "Did you mean 'train'?"),
    (["import", "{recordings}", "{tmp}/x", "--layout", "plush-15"], "has 5 columns, but a file of layout 'plush-15'"),
    (["import", "{tmp}", "{tmp}-x", "--layout", "accel-3"], "holds no recording"),
    (["evaluate", "{tmp}"], "is not a data set"),
    (["evaluate", "{ds}", "--split", "by-subjct:5"], "Did you mean 'by-subject:5'?"),
    (["evaluate", "{ds}", "--context", "strem"], "Did you mean 'stream'?"),
    (["baselines", "{ds}", "--context", "anywhere", "--models", "quick"], "choose the context stream or loop"),
    (["train", "{ds}", "--classes", "Slwo,Fast"], "Did you mean 'Slow'?"),
    (["live", "--device", "virtual://", "--model", "{half}"], "is damaged"),
    (["live", "--device", "virtual://", "--model", "{tmp}/none.plush"], "none.plush"),
    (["live", "--device", "serial:///dev/ttyUSB77", "--model", "{bundle}"], "there is no port"),
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
    thesis = tmp_path / "thesis" / "report.html"
    thesis.parent.mkdir()
    thesis.write_text("my thesis")
    places = {"recordings": recordings, "tmp": empty, "ds": dataset.path, "half": half, "bundle": bundle}
    places |= {"thesis": thesis, "thesis_folder": thesis.parent}
    ran = cli(*(word.format(**places) for word in words), "--json")
    assert ran.status == 2
    assert said in ran.err
    assert ran.out == ""
    assert "Traceback" not in ran.err
    assert thesis.read_text() == "my thesis"
    assert half.is_file()


@pytest.mark.parametrize(
    ("words", "work", "said"),
    [
        (["train", "DS", "--out", "FILE", "--force"], "workflow.api.train", "is not a bundle"),
        (["adapt", "BUNDLE", "DS", "--out", "FILE", "--force"], "experiments.adaptation.adapt", "is not a bundle"),
        (["check", "DS", "--save-labels", "FILE"], "dataset.labelling.decide_labels", "is not a file of labels"),
        (
            ["stream-eval", "DS", "--model", "BUNDLE", "--events", "FILE"],
            "experiments.streams.benchmark.opened",
            "is not a file of events",
        ),
        (
            ["merge", "DS", "DS", "--merges", "1", "--out", "FILE"],
            "experiments.analysis.merging.load_evaluation",
            "is not a gesture set",
        ),
        (["toy", "--tcp", "0", "--truth", "FILE"], "devices.virtual.server.ToyServer", "is not a file of truth"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_file_of_another_kind_is_refused_before_the_work(
    words: list[str], work: str, said: str, cli: Cli, dataset: Dataset, bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = min(dataset.path.glob("recordings/*/*.csv"))
    before = recording.read_bytes()
    monkeypatch.setattr(f"plushsense.{work}", lambda *_args, **_more: pytest.fail("the work began"))
    places = {"DS": dataset.path, "BUNDLE": bundle, "FILE": recording}
    ran = cli(*(places.get(word, word) for word in words))
    assert ran.status == 2 and said in ran.err
    assert recording.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="needs links and pipes")
def test_links_to_themselves_and_pipes_are_refused(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    for words, said in (
        (("import", recordings, tmp_path / "loop", "--layout", "accel-3"), "link"),
        (("backup", "--restore", tmp_path / "pipe", tmp_path / "DS"), "There is no backup"),
        (("export", tmp_path / "pipe", tmp_path / "C"), "no regular file"),
        (("train", tmp_path, "--config", tmp_path / "pipe"), "no regular file"),
    ):
        ran = cli(*words)
        assert ran.status == 2 and said in ran.err and ran.err.count("\n") == 1


def test_a_name_depends_on_every_setting_and_on_the_data(dataset: Dataset) -> None:
    from plushsense.workflow.config import resolve
    from plushsense.workflow.preparation import prepare

    given: list[dict[str, dict[str, Any]]] = [
        {},
        {"training": {"batch": 16}},
        {"training": {"learning_rate": 0.01}},
        {"training": {"patience": 3}},
        {"training": {"turn_deg": 3.0}},
        {"training": {"seed": 1}},
        {"evaluation": {"seed": 1}},
        {"evaluation": {"classes": ("Slow", "Fast")}},
        {"evaluation": {"classes": ("Slow", "Rest")}},
        {"evaluation": {"train_context": "loop"}},
        {"evaluation": {"train_context": "anywhere"}},
        {"evaluation": {"train_context": "anywhere"}, "anywhere": {"idle_share": 0.4}},
        {"windows": {"context": "anywhere"}},
        {"windows": {"window_s": 2.0}},
        {"windows": {"step_s": 0.25}},
        {"model": {"pool_s": 0.5}},
        {"model": {"step_s": 0.1}},
    ]
    names = [prepare(dataset, resolve(None, **tables)).name for tables in given]
    assert len(set(names)) == len(names)
    same = resolve(None, evaluation={"workers": 2, "train_context": "stream"}, training={"threads": 2})
    assert prepare(dataset, same).name == names[0]
    unused = resolve(None, anywhere={"idle_share": 0.4})
    assert prepare(dataset, unused).name == names[0], "nothing is trained anywhere"
    fewer = Dataset(dataset.path, dataset.head, dataset.recordings[:-1], dataset.streams)
    assert prepare(fewer, resolve(None)).name != names[0]


def test_train_for_work_in_a_stream(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    config, out = tmp_path / "run.toml", tmp_path / "live.plush"
    config.write_text("[anywhere]\nidle_share = 0.5\nevery_s = 0.5\n")
    words = ("--context", "anywhere", "--pool-s", "0.5", "--config", config, "--filters", "4,4,4", "--epochs", "1")
    ran = cli("train", dataset.path, *words, "--out", out, "--json")
    assert ran.status == 0
    assert "added a class for what happens between gestures: Idle" in ran.err
    bundle = Bundle.load(out)
    assert (bundle.arch.pool, bundle.gestures.labels[-1]) == (50, "Idle")
    assert bundle.windowing["anywhere"]["idle_share"] == 0.5


def test_an_evaluation_is_replaced_only_by_its_like_or_by_force(cli: Cli, dataset: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "e"
    words = ("evaluate", dataset.path, *SMALL, "--split", "by-subject:2", "--out", out)
    assert cli(*words).status == 0
    kept = json.loads((out / "evaluation.json").read_text(encoding="utf-8"))
    assert kept["simulated"] is False
    assert cli(*words).status == 0, "the same again"
    ran = cli(*words, "--batch", "9")
    assert ran.status == 2
    assert "evaluation of other settings" in ran.err
    assert "--force" in ran.err
    assert "folds" not in ran.err, "said before anything is trained"
    assert json.loads((out / "evaluation.json").read_text(encoding="utf-8"))["id"] == kept["id"]
    assert cli(*words, "--batch", "9", "--force").status == 0
    assert json.loads((out / "evaluation.json").read_text(encoding="utf-8"))["id"] != kept["id"]


def test_an_evaluation_of_other_data_is_not_replaced_and_is_marked(
    cli: Cli, dataset: Dataset, recordings: Path, tmp_path: Path
) -> None:
    from plushsense.dataset.importing.importers import import_recordings

    import_recordings(recordings, tmp_path / "VIRTUAL", layout="accel-3", simulated=True)
    out = tmp_path / "e"
    words = (*SMALL, "--split", "by-subject:2", "--out", out)
    assert cli("evaluate", tmp_path / "VIRTUAL", *words).status == 0
    path = out / "evaluation.json"
    held = json.loads(path.read_text(encoding="utf-8"))
    assert held["simulated"] is True
    page = tmp_path / "r.html"
    assert cli("report", page, "--dataset", dataset.path, "--evaluation", out).status == 0
    text = page.read_text(encoding="utf-8")
    assert "A part of this page is of a simulation" in text
    assert '<span class="virtual">SIMULATION</span>' in text
    path.write_text(json.dumps(held | {"id": "0", "dataset": held["dataset"] | {"hash": "0" * 64}}), encoding="utf-8")
    ran = cli("evaluate", dataset.path, *words)
    assert ran.status == 2
    assert "evaluation of other data" in ran.err
    assert cli("report", page, "--dataset", dataset.path, "--evaluation", out).status == 0
    assert "OTHER DATA" in page.read_text(encoding="utf-8")


def test_a_data_set_that_cannot_be_written_is_one_sentence(cli: Cli, dataset: Dataset) -> None:
    (dataset.path / "cache").write_text("in the way")
    words = ("--filters", "2,2,2", "--epochs", "1", "--split", "by-subject:2", "--workers", "1")
    ran = cli("evaluate", dataset.path, *words)
    assert ran.status == 2
    assert "cache" in ran.err
    assert "Traceback" not in ran.err


WRONG = [
    ("model", "arch = 5", "text"),
    ("model", "filters = 5", "whole numbers"),
    ("model", "step_s = 0", "above 0"),
    ("model", "pool_s = nan", "a number"),
    ("evaluation", "classes = 5", "text or a list of texts"),
    ("evaluation", "seed = 'a'", "a whole number"),
    ("evaluation", "train_context = 'lop'", "Did you mean 'loop'?"),
    ("training", "epochs = 2.5", "a whole number"),
    ("windows", "context = ['x']", "text"),
    ("windows", "span_s = 3.0", "follows from the network"),
    ("windows", "windows_s = 3.0", "Did you mean 'window_s'?"),
    ("anywhere", "idle_share = 1", "not including, 1"),
]


@pytest.mark.parametrize(("table", "line", "accepted"), WRONG, ids=[line for _, line, _ in WRONG])
def test_a_setting_of_the_wrong_kind(table: str, line: str, accepted: str, cli: Cli, tmp_path: Path) -> None:
    config = tmp_path / "run.toml"
    config.write_text(f"[{table}]\n{line}\n")
    ran = cli("evaluate", tmp_path, "--config", config)
    assert ran.status == 2
    assert line.split(" = ")[0] in ran.err
    assert accepted in ran.err
    assert ran.err.count("\n") == 1


def test_settings_that_fit_are_taken_as_their_type(tmp_path: Path) -> None:
    from plushsense.workflow.config import resolve

    config = tmp_path / "run.toml"
    config.write_text("[model]\nstep_s = 1\nfilters = [4, 4]\npool_s = 2\n[evaluation]\nclasses = ['a', 'b']\n")
    found = resolve(config, training={"patience": None, "seed": 3})
    assert (found.model.filters, found.evaluation.classes) == ((4, 4), ("a", "b"))
    assert isinstance(found.model.step_s, float)
    assert (found.model.pool_s, found.training.seed) == (2.0, 3)
    assert resolve(None, model={"filters": "4,5"}).model.filters == (4, 5)


@pytest.mark.parametrize(
    ("verb", "words", "said"),
    [
        ("evaluate", ["DS"], "finished work is kept"),
        ("train", ["DS"], "no bundle was written"),
        ("import", ["a", "b", "--layout", "accel-3"], "nothing was written"),
        ("simulate", ["a"], "nothing was written"),
        ("info", ["DS"], "plushsense: stopped.\n"),
    ],
)
def test_what_is_left_when_stopped(
    verb: str, words: list[str], said: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("plushsense.cli.main.load_verb", lambda _: stopped)
    ran = cli(verb, *words)
    assert ran.status == 130
    assert said in ran.err


def test_every_table_is_a_verb_or_inserted_in_another() -> None:
    tables = tomllib.loads(resources.files("plushsense.cli").joinpath("verbs.toml").read_text(encoding="utf-8"))
    inserted = {name[1:] for table in tables.values() for name in table if name.startswith("@")}
    assert set(tables) == set(VERBS) | inserted
    assert all(callable(load_verb(verb)) for verb in VERBS)


@pytest.mark.parametrize(
    ("cause", "status", "said"),
    [
        (PermissionError(13, "Permission denied", "/data/x.csv"), 2, "'/data/x.csv' cannot be used: permission denied"),
        (OSError(28, "No space left on device"), 2, "No space left on device"),
        (BrokenPipeError(32, "Broken pipe"), 0, ""),
    ],
)
def test_what_the_system_refuses_is_one_sentence(
    cause: OSError, status: int, said: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    from plushsense.cli import info

    def refused(_: object) -> int:
        raise cause

    monkeypatch.setattr(info, "run", refused)
    ran = cli("info", "x")
    assert ran.status == status
    assert said in ran.err
    assert len(ran.err.splitlines()) <= 1


def test_windows_calls_a_broken_pipe_an_invalid_argument(monkeypatch: pytest.MonkeyPatch) -> None:
    from plushsense.cli import main as room

    gone, named = OSError(22, "Invalid argument"), OSError(22, "Invalid argument", "a:b")
    assert not room._output_closed(gone)
    monkeypatch.setattr(room.sys, "platform", "win32")
    assert room._output_closed(gone)
    assert not room._output_closed(named), "a path that Windows does not like"


def test_output_is_utf8_whatever_the_console(cli: Cli, recordings: Path, tmp_path: Path) -> None:
    ran = cli("import", recordings, tmp_path / "DS", "--layout", "accel-3", "--name", "Plüsch")
    assert ran.status == 0
    words = [sys.executable, "-m", "plushsense", "info", str(tmp_path / "DS"), "--json"]
    done = subprocess.run(words, capture_output=True, check=False, env={**os.environ, "PYTHONIOENCODING": "cp1252"})
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.decode("utf-8"))["name"] == "Plüsch"


def test_the_example_configuration_resolves() -> None:
    from plushsense.workflow.config import resolve

    config = resolve(Path(__file__).resolve().parents[2] / "examples" / "har-phone.toml")
    assert (config.windows.window_s, config.model.filters, config.training.epochs) == (0.5, (16, 24, 32), 20)


def test_simulate_makes_a_data_set_in_one_command(cli: Cli, tmp_path: Path) -> None:
    words = ("simulate", tmp_path / "R", "--people", "1", "--repetitions", "1", "--dataset", tmp_path / "DS")
    found = cli(*words, "--json").json
    assert found["recordings"] == 17 + 3
    info = cli("info", found["dataset"], "--json").json
    assert (info["recordings"], info["subjects"], info["simulated"]) == (20, 1, True)
    refused = cli(*words)
    assert refused.status == 2
    assert "already holds something" in refused.err


def test_each_fold_is_deployed_with_ranges_of_its_own_training_windows(dataset: Dataset, cli: Cli) -> None:
    words = ("evaluate", dataset.path, "--filters", "4,4,4", "--epochs", "3", "--split", "by-subject:2", "--int8")
    found = cli(*words, "--json").json
    int8 = found["int8"]
    assert len(int8["rows"]) == 5 and 0.5 < int8["agreement"] <= 1
    assert abs(int8["loss"]["macro_f1"]["mean"]) < 0.3
    assert int8["probability_difference"] > 0, "these are not the floats"
    shown = cli(*words)
    assert "deployed in 8 bits" in shown.out and "macro-F1 lost" in shown.out
    assert "Deployed in 8 bits" in Path(found["report"]).read_text()
    plain = cli(*words[:-1], "--json").json
    assert "int8" not in plain and plain["accuracy"] == found["accuracy"]
    assert cli(*words, "--padding", "causal").status == 2


def test_fine_tuning_is_told_from_training(capsys: pytest.CaptureFixture[str]) -> None:
    show = report_epochs()
    show(1, 1, {"train_loss": 1.5, "accuracy": 0.5})
    show(1, 1, {"train_loss": 0.0002, "accuracy": None, "what": "fine-tuning for 8 bits"})
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "training: 1 of 1 epochs, 100%, 0 s, loss 1.500, validation accuracy 0.500",
        "fine-tuning for 8 bits: 1 of 1 epochs, 100%, 0 s, loss 2.0e-04",
    ]
