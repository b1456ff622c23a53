"""Every command on every page: read by the parser of its verb, and run, on small data and in the order of the page.

What cannot be run here stands in `NOT_RUN`, with the reason and the test that runs such a command.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import plushsense as ps
from plushsense.cli.main import main, parser_of
from plushsense.cli.options import VERBS
from plushsense.deploy.proof.verify import Setting
from plushsense.experiments.baselines.run_baselines import chosen
from plushsense.models.bundle import Bundle
from plushsense.models.reference import DENSE
from plushsense.recording.simulate import SimulationSpec, simulate
from plushsense.studio.app import serve
from plushsense.workflow.api import import_simulation
from support.kept_objects import keeping_answers, keeping_objects

pytestmark = [pytest.mark.apart("pages"), pytest.mark.early]

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {
    page.relative_to(ROOT).as_posix(): page.read_text("utf-8")
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md")))
}
PAPER, OWN = "docs/paper.md", "docs/own-sensor.md"
VERDICTS = ("better", "equal", "not possible here", "weaker")

# Commands that no page runs here, by their beginning: why, and the test that runs such a command ("": none does).
NOT_RUN = {
    "make ": ("CI runs the targets", ""),
    ".venv/bin/python -m pytest": ("it runs tests", ""),
    "python bench/": ("minutes to hours on real recordings; the options are those of the program", ""),
    "plushsense verify OUT --device": (
        "a chip on a serial port",
        "tests/deploy/proof/test_device.py::test_a_chip_of_qemu_answers_over_its_uart",
    ),
    "plushsense import 'Training Data - labelled'": (
        "folders of the authors' scripts",
        "tests/dataset/importing/test_streams.py::test_every_recording_is_found",
    ),
    "plushsense import makeability-gestures": (
        "real recordings",
        "tests/dataset/importing/test_importers.py::test_makeability_imports_whole",
    ),
    "plushsense import ../shared/data/makeability-gestures": (
        "real recordings",
        "tests/dataset/importing/test_importers.py::test_makeability_imports_whole",
    ),
    "plushsense import har-phone": (
        "real recordings",
        "tests/dataset/importing/test_importers.py::test_har_phone_imports_whole",
    ),
    "plushsense evaluate HAR --config": (
        "real recordings",
        "tests/cli/test_main.py::test_the_example_configuration_resolves",
    ),
    "plushsense import plush_train_data_5621.mat": (
        "the file of the authors",
        "tests/dataset/importing/test_saved_windows.py::test_the_recordings_come_back_and_give_the_same_windows",
    ),
    "plushsense protocol ": (
        "a network of all gestures of the paper",
        "tests/cli/test_protocol.py::test_five_strangers_three_systems_one_page",
    ),
    "plushsense report DS/evaluations/sweep": (
        "the folder of a sweep that trained",
        "tests/cli/test_paper_page.py::test_every_command_runs",
    ),
    "plushsense toy --tcp": (
        "it serves until Ctrl-C",
        "tests/cli/test_live.py::test_over_tcp",
    ),
    "plushsense toy --scenario examples/scenarios/rainy-afternoon.toml --tcp": (
        "it serves until Ctrl-C",
        "tests/cli/test_toy.py::test_the_truth_is_written_while_a_scenario_is_read",
    ),
    "plushsense publish ": (
        "the validators of a package take long",
        "tests/cli/test_publish.py::test_from_refusal_to_a_valid_package",
    ),
    "plushsense import table.parquet": (
        "the extra tables",
        "tests/dataset/importing/test_tables.py::test_parquet_reads_like_csv",
    ),
    "plushsense import table.csv": (
        "a table of each layout",
        "tests/dataset/importing/test_tables.py::test_columns_can_be_named",
    ),
}
# Programs that are not ours: they install or connect something.
FOREIGN = (
    "pip", ".venv/bin/pip", "source", "git", "mkdir", "cd", "sudo", "bluetoothctl", "python3.11", "/tmp/peers/bin/pip",
)  # fmt: skip

# 1 is no error: a check has findings, forget without --yes removes nothing, a network of one epoch is too bad to adapt.
STATUS = {"check": (0, 1), "adapt": (0, 1), "forget": (0, 1)}


@cache
def commands(page: str) -> tuple[str, ...]:
    """Return the commands in the blocks of a page, in order, each once, without comments."""
    found = []
    for block in re.findall(r"^```sh\n(.*?)^```", PAGES[page], re.S | re.M):
        for line in block.replace("\\\n", " ").splitlines():
            if words := shlex.split(line, comments=True):
                found.append(shlex.join(words))
    if page == PAPER:  # the commands in the last column of its tables
        verdicts = PAGES[page].split("## The verdicts")[1]
        codes = re.findall(r"`((?:plushsense|python) [^`]*)` \|$", verdicts, re.M)
        found += [shlex.join(shlex.split(code)) for code in codes]
    return tuple(dict.fromkeys(found))


def mentioned(page: str) -> Iterator[list[str]]:
    """Yield the words of each command in the text of a page, such as `plushsense live --smoothing`."""
    text = re.sub(r"^```.*?^```", "", PAGES[page], flags=re.S | re.M)
    for code in re.findall(r"`(?:\.venv/bin/)?plushsense ([^`]*)`", text):
        yield code.split()


def test_every_command_is_accepted_by_its_parser() -> None:
    for page in PAGES:
        for command in commands(page):
            program, *words = shlex.split(command)
            if program.endswith("plushsense"):
                args = parser_of(words[0]).parse_args(words[1:])
                if words[0] == "baselines" and args.models:
                    chosen(args.models)
            elif program.endswith("python") and words[0].endswith(".py"):
                text = (ROOT / words[0]).read_text("utf-8")
                assert all(f'"{word}"' in text for word in words if word.startswith("--")), f"{page}: {command}"
            elif program == "make":
                targets = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text("utf-8"), re.M)
                assert targets is not None
                assert {word for word in words if "=" not in word} <= set(targets[1].split()), f"{page}: {command}"
            else:
                assert program in FOREIGN or words[:2] == ["-m", "pytest"], f"{page}: {command}"


def test_every_option_in_the_text_is_one_of_its_verb() -> None:
    for page in PAGES:
        for verb, *words in mentioned(page):
            if verb in VERBS:
                known = {option for action in parser_of(verb)._actions for option in action.option_strings}
                unknown = {word.strip("[]") for word in words if word.strip("[]").startswith("--")} - known
                assert not unknown, f"{page}: {verb} {unknown}"
            else:
                assert verb.isupper() or verb.startswith("-"), f"{page}: plushsense {verb}"


def test_programs_use_names_that_exist() -> None:
    """Those of questions.md, python.md and streams.md are run by other tests, where the packages are that they need."""
    for page, text in PAGES.items():
        for program in re.findall(r"^```python\n(.*?)^```", text, re.S | re.M):
            for node in ast.walk(ast.parse(program)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("plushsense."):
                    module = importlib.import_module(str(node.module))
                    assert all(hasattr(module, name.name) for name in node.names), f"{page}: {ast.unparse(node)}"
                elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "ps":
                    assert node.attr in ps.__all__, f"{page}: ps.{node.attr}"


def test_commands_stand_in_blocks_of_commands() -> None:
    for page, text in PAGES.items():
        for name, block in re.findall(r"^```(\S*)\n(.*?)^```", text, re.S | re.M):
            if name != "sh":
                assert not re.search(r"^(make|plushsense|python) [a-z-]", block, re.M), f"{page}: {block}"
        assert not re.search(r"^    +(make|plushsense|python) [a-z-]+", text, re.M), page


def test_what_is_not_run_has_a_reason_and_a_test() -> None:
    everything = [command for page in PAGES for command in commands(page)]
    for start, (reason, _) in NOT_RUN.items():
        assert reason and any(command.startswith(start) for command in everything), start
    for test in (*(test for _, test in NOT_RUN.values()), *WHOLE.values()):
        if test:
            path, name = test.split("::")
            assert f"def {name}(" in (ROOT / path).read_text("utf-8"), test


# --- running ---

# What makes a command small, by its verb, and for some only with a word: few networks of few filters, and one process.
# Trainings have one epoch. "!" before a value: it also replaces that of the page.
SMALL = {
    "devices": {"--scan-s": "!0.1"},
    "record": {"--auto": "!1", "--speed": "!200", "--protocol": "quick"},
    "simulate": {"--people": "!3", "--repetitions": "1"},
    "train": {"--filters": "4,4,4", "--force": ""},
    "evaluate": {"--filters": "4,4,4"},
    "baselines": {"--models": "!tree", "--pca": "!no", "--split": "by-subject:2"},
    "trim --plot": {"--only": "P01/*"},
    "stream-eval DS --model": {"--subjects": "P01"},
    "stream-eval --split": {"--systems": "hysteresis"},
    "adapt": {"--force": ""},
    "verify": {"--target": "host"},
    "verify --dataset": {"--samples": "500"},
    "profile": {"--target": "host"},
    "sweep": {
        "--set": "architectures=14d1_39d2_41d4,19d1_19d2_19d4_17d8 --set filters=4/6/8/8 --set batches=64",
    },
    "sweep --halving": {"--epochs": "!1,2", "--share": "1"},
}
# Where a verb writes a new folder or file, which must not be there.
NEW = {
    "import": "dest",
    "simulate": "out dataset",
    "export": "out",
    "publish": "out",
    "backup": "file",
    "merge": "out",
}
# What stands on the pages for something that is not here, and what stands in for it.
STAND_INS = {
    r"^(live .*)--device ['a-z]*(serial|ble|virtual):\S*": r"\1--device virtual://?speed=0&seconds=20",
    r"^(record .*)--device \S*": r"\1--device virtual://",
    r"^(import (RECORDINGS|SRC) ([A-Z]+|--dry-run))$": r"\1 --layout plush-15",
    r"^(adapt \S+) RECORDINGS": r"\1 SESSION",
    r" m\.plush": " model.plush",
    r"by-subject:5": "by-subject:2",
    r"--people 3,6": "--people 1",
    r"/(safe/place|somewhere/safe)/": "",
    r"--samples 100000": "--samples 500",
    r"--merges 2": "--groups plush-13",
    r"--recording ID": "--recording P01/x_1760000000000_1",
    r"Shake": "'Tail pull'",
    r"S07": "P03",
    r"P07": "P03",
    r"P22/Forehand\*_18907": "P03/Tail pull*",
    r"P26": "P02",
}
GESTURES = ("Hold strong", "Tail pull", "Tail scratch 1", "Tail tap 1", "Tail tap 2")


@pytest.fixture(scope="module", autouse=True)
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Share object files and answers with the tests of the C: many pages export and verify the same network."""
    with keeping_objects(tmp_path_factory), keeping_answers(tmp_path_factory):
        yield


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands of the pages need: recordings, a data set, bundles, an export, small files."""
    folder = tmp_path_factory.mktemp("pages")
    simulate(folder / "RECORDINGS", SimulationSpec(people=5, repetitions=3, gestures=GESTURES, at_rest=2))
    with_gap = next((folder / "RECORDINGS" / "P02").glob("Hold strong_*.csv"))
    lines = with_gap.read_bytes().splitlines(keepends=True)
    with_gap.write_bytes(b"".join(lines[:40] + lines[80:]))
    import_simulation(folder / "RECORDINGS", folder / "DS", lambda *_: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in (
            "plushsense train DS --context anywhere --out model.plush",
            "plushsense export model.plush OUT",
            "plushsense evaluate DS --split by-subject:2 --out EVALUATION",
            "python examples/own_sensor.py FILES",
        ):
            status, said = run(command)
            assert status == 0, said
    shutil.copytree(ROOT / "examples", folder / "examples")
    shutil.copytree(folder / "RECORDINGS", folder / "SRC")
    for name in ("SESSION", "visit"):
        shutil.copytree(folder / "RECORDINGS" / "P01", folder / name)
    model = Bundle.load(folder / "model.plush")
    dense = {name: np.asarray(model.weights[name]) for name in DENSE}
    personal = {"subject": "P03", "original": {name: part.tolist() for name, part in dense.items()}}
    mine = replace(model, weights={**model.weights, **{n: part * 1.1 for n, part in dense.items()}}, personal=personal)
    mine.save(folder / "mine.plush")
    (folder / "MODELS").mkdir()
    mine.save(folder / "MODELS" / "mine.plush")
    shutil.copyfile(ROOT / "src/plushsense/core/data/layouts/plush-15.toml", folder / "my-sensor.toml")
    shutil.copyfile(ROOT / "src/plushsense/core/data/reactions/gentle.toml", folder / "ours.toml")
    (folder / "names.txt").write_text("Anna\n")
    (folder / "predictions.csv").write_text("stream,t,stop,label,score\nP01/fulldatastream,2.5,4,Hold strong,0.8\n")
    return folder


def run(command: str) -> tuple[int, str]:
    """Run a command of a page in this process; its exit status, and what it printed."""
    program, *words = shlex.split(command)
    if program == "python":
        examples = runpy.run_path(str(ROOT / words[0]), run_name="example")
        return printed(lambda: examples["main"](words[1:]))
    for pattern, stand_in in STAND_INS.items():
        words = shlex.split(re.sub(pattern, stand_in, shlex.join(words)))
    known = parser_of(words[0])._option_string_actions
    small = {"--epochs": "!1"} if "--epochs" in known and not {"--model", "--undo"} & {*words} else {}
    small |= {"--workers": "!1"} if "--workers" in known else {}
    for verb, *needed in map(str.split, SMALL):
        small |= SMALL[" ".join([verb, *needed])] if verb == words[0] and {*needed} <= {*words} else {}
    first = next(iter(sorted(Path("DS/recordings/P01").glob("*.csv"))), Path("none"))
    words = [re.sub(r"P01/[\w ]+_\d{13}_\d+", f"P01/{first.stem}", word) for word in words]
    for option, value in small.items():
        if option not in words:
            words += [option, *value.removeprefix("!").split()]
        elif value.startswith("!"):
            words[words.index(option) + 1] = value[1:]
    args = vars(parser_of(words[0]).parse_args(words[1:]))
    for made in (args[name] for name in NEW.get(words[0], "").split() if args[name] and not args.get("add")):
        shutil.rmtree(made) if Path(made).is_dir() else Path(made).unlink(missing_ok=True)
    return printed(lambda: main(words))


def printed(work: Callable[[], object]) -> tuple[int, str]:
    """Return what a function returns as an exit status, and what it prints."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        status = work()
    return int(status or 0), said.getvalue()


# Pages that are run whole, each from an empty folder, and the test that does it.
WHOLE = {
    "docs/tutorial.md": "tests/test_pages.py::test_the_tutorial_ends_with_the_same_answers_in_c",
    "docs/own-sensor.md": "tests/cli/test_paper_page.py::test_the_tutorial_ends_with_the_same_answers_in_c",
    PAPER: "tests/cli/test_paper_page.py::test_every_command_runs",
}


def once(page: str) -> list[str]:
    """Return the commands of a page that are run here, without those of the pages before it."""
    pages = list(PAGES)
    before = {c for other in pages[: pages.index(page)] if other not in WHOLE for c in commands(other)}
    mine = (c for c in commands(page) if page in WHOLE or c not in before)
    left_out = tuple(start for start, (_, test) in NOT_RUN.items() if not (page in WHOLE and test))
    return [c for c in mine if shlex.split(c)[0] not in FOREIGN and not c.startswith(left_out)]


def check(command: str) -> str:
    """Run a command, which must do what its page says; return what it printed."""
    command = command.replace(".venv/bin/plushsense", "plushsense")
    status, said = run(command)
    assert status in STATUS.get(shlex.split(command)[1], (0,)), f"{command}: exit status {status}\n{said}"
    return said


@pytest.fixture
def few_settings(monkeypatch: pytest.MonkeyPatch, c_compiler: str) -> None:
    """Compile C with one compiler and one optimisation, and start no server."""
    monkeypatch.setattr("plushsense.deploy.proof.verify.settings_of", lambda name: [Setting(name, c_compiler, "-O2")])
    monkeypatch.setattr(serve, "run", lambda *given, **options: None)


@pytest.mark.usefixtures("few_settings")
@pytest.mark.parametrize("page", [page for page in PAGES if page not in WHOLE and once(page)])
@pytest.mark.exhaustive_for(
    "docs/baselines.md",
    "docs/checks.md",
    "docs/commands.md",
    "docs/firmware.md",
    "docs/importing.md",
    "docs/live.md",
    "docs/measurements/results.md",
    "docs/pairing.md",
    "docs/people.md",
    "docs/personal.md",
    "docs/questions.md",
    "docs/record.md",
    "docs/streams.md",
    "docs/sweep.md",
    "docs/trim.md",
    "docs/virtual-toy.md",
)
def test_every_command_of_the_page_runs(
    page: str, prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(prepared, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    for command in once(page):
        check(command)


def test_what_the_tutorial_makes_is_in_a_folder_that_git_ignores() -> None:
    words = [shlex.split(command) for command in commands("docs/tutorial.md")]
    at = words.index(["cd", "tutorial"])
    assert {w[0] for w in words[:at]} == {"git", "cd", "make", "source", "mkdir"}
    assert ["mkdir", "tutorial"] in words[:at]
    assert all(w[0] == "plushsense" for w in words[at + 1 :])
    assert "/tutorial/" in (ROOT / ".gitignore").read_text("utf-8").splitlines()


@pytest.mark.usefixtures("few_settings")
def test_the_tutorial_ends_with_the_same_answers_in_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said, url = "", ""
    with contextlib.ExitStack() as ended:
        for command in once("docs/tutorial.md"):
            if command.startswith("plushsense toy --tcp 7000"):
                words = shlex.split(command.replace("7000", "0"))[1:]
                toy = subprocess.Popen(
                    [sys.executable, "-m", "plushsense", *words, "--speed", "20"], stdout=subprocess.PIPE, text=True
                )
                ended.enter_context(toy)
                ended.callback(toy.terminate)
                assert toy.stdout is not None
                url = toy.stdout.readline().strip()
            else:
                said = check(command.replace("tcp://127.0.0.1:7000", url))
    assert "Every number of every answer is equal" in said
