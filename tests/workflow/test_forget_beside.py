"""A person is taken out of a data set while something runs on it: nothing of theirs is written afterwards."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import plushsense as ps
from plushsense.core.errors import ForgottenError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.privacy.removed import RemovedCodes
from plushsense.dataset.store import Dataset
from plushsense.experiments.adaptation import evaluate_adapting
from plushsense.experiments.baselines.run_baselines import ComparisonSpec, baselines
from plushsense.experiments.streams.benchmark import BenchmarkSpec, stream_benchmark
from plushsense.workflow.api import unfinished
from plushsense.workflow.datasets import PublishSpec, share_copy
from plushsense.workflow.forgetting import find_traces, forget_everywhere, people_of_home
from support.sweeping import sweep

pytestmark = pytest.mark.apart("trainings")

PERSON = "Yv0nne-77"
SMALL: dict[str, Any] = {"filters": (2, 3, 3), "context": "loop", "epochs": 2, "workers": 1}
GRID: dict[str, Any] = {
    "architectures": ("5", "9"), "filters": ((2, 3, 3, 3),), "batches": ("full",), "classes": "shared", "workers": 1,
}  # fmt: skip
Cli = Callable[..., Any]
# Called wherever a program says how far it is.
Hook = Callable[..., None]


def traces(folder: Path) -> list[str]:
    """Where the person stands in a data set folder: in a name, in any byte, in any row; and every result kept."""
    import polars

    found = []
    for path in folder.rglob("*"):
        where = path.relative_to(folder).as_posix()
        if PERSON in where or path.suffix in (".npz", ".plush", ".part", ".png"):
            # What holds weights and probabilities does not say whose they are.
            found.append(where)
        elif path.suffix == ".parquet":
            rows = polars.read_parquet(path)
            said = rows.select(polars.any_horizontal(polars.col(polars.String).str.contains(PERSON).any()))
            found += [where] if said.item() else []
        elif path.is_file() and PERSON.encode() in path.read_bytes():
            found.append(where)
    return found


def run_evaluate(ds: Dataset, out: Path, hook: Hook) -> None:
    ps.evaluate(ds, split="leave-one-subject-out", out=out, progress=hook, **SMALL)


def run_evaluate_in_processes(ds: Dataset, out: Path, hook: Hook) -> None:
    ps.evaluate(ds, split="by-subject:3", out=out, progress=hook, **{**SMALL, "workers": 2})


def run_baselines(ds: Dataset, out: Path, hook: Hook) -> None:
    spec = ComparisonSpec(("by-subject:2",), "knn,tree", pca="no")
    baselines(ds, spec=spec, out=out, progress=hook, context="loop", workers=1)


def run_sweep(ds: Dataset, out: Path, hook: Hook) -> None:
    sweep(ds, epochs=(1, 2), split="by-subject:2", out=out, progress=hook, **GRID)


def run_halving(ds: Dataset, out: Path, hook: Hook) -> None:
    sweep(ds, halving=True, epochs=(1, 2), share=1.0, split="by-subject:2", out=out, progress=hook, **GRID)


def run_streams(ds: Dataset, out: Path, hook: Hook) -> None:
    spec = BenchmarkSpec("by-subject:2", ("argmax", "hysteresis"))
    stream_benchmark(ds, spec=spec, out=out, progress=hook, **SMALL)


def run_adapting(ds: Dataset, out: Path, hook: Hook) -> None:
    evaluate_adapting(ds, split="by-subject:2", progress=hook, **SMALL)


def run_train(ds: Dataset, out: Path, hook: Hook) -> None:
    out.mkdir(parents=True)
    ps.train(ds, journal=unfinished(ds.path), progress=hook, **SMALL).save(out / "model.plush")


RUNS = (
    run_evaluate, run_evaluate_in_processes, run_baselines, run_sweep, run_halving, run_streams,
)  # fmt: skip


def ended(*at: Any) -> bool:
    """Whether all trainings are done, so that only tables are left to be written."""
    if len(at) > 1:
        return bool(at[0] == at[1])
    (now,) = at
    if getattr(now, "rung", 0) < getattr(now, "rungs", 0):
        return False
    return bool(now.done == now.total)


@pytest.fixture
def folder(recordings: Path, tmp_path: Path) -> Path:
    """A data set with a person whose code stands nowhere by chance."""
    shutil.copytree(recordings, tmp_path / "src")
    (tmp_path / "src" / "P2").rename(tmp_path / "src" / PERSON)
    return import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset.path


def forgetting(folder: Path, when: Callable[..., bool]) -> Hook:
    """A hook that takes the person out when it is time, once."""
    done = list[bool]()

    def hook(*at: Any) -> None:
        if not done and when(*at):
            done.append(True)
            forget(folder, PERSON)

    return hook


REFUSED = r"removed from '.*' \(plushsense forget\) while this ran.*run it again"


@pytest.mark.parametrize("when", [lambda *_: True, ended], ids=["early", "late"])
@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.__name__.removeprefix("run_"))
@pytest.mark.exhaustive_for(
    "baselines-early",
    "baselines-late",
    "evaluate_in_processes-early",
    "evaluate_in_processes-late",
    "halving-early",
    "streams-early",
    "streams-late",
    "sweep-early",
)
def test_who_is_forgotten_meanwhile_does_not_come_back(
    folder: Path, run: Callable[[Dataset, Path, Hook], None], when: Callable[..., bool]
) -> None:
    assert traces(folder) != []
    with pytest.raises(ForgottenError, match=REFUSED):
        run(open_dataset(folder), folder / "evaluations" / "mine", forgetting(folder, when))
    assert traces(folder) == []
    assert not (folder / "evaluations" / "mine").exists()


@pytest.mark.parametrize("run", [run_adapting, run_train], ids=lambda run: run.__name__.removeprefix("run_"))
def test_nor_in_the_state_of_a_training(
    folder: Path, run: Callable[[Dataset, Path, Hook], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plushsense.workflow.networks._SAVE_EVERY_S", 0.0)
    hook = forgetting(folder, lambda *_: True)
    with pytest.raises(ForgottenError, match=REFUSED):
        run(open_dataset(folder), folder / "evaluations" / "mine", hook)
    assert traces(folder) == []


def test_a_training_that_ends_after_it_gives_no_bundle(folder: Path) -> None:
    last = forgetting(folder, lambda epoch, epochs, _: epoch == epochs)
    with pytest.raises(ForgottenError, match=REFUSED):
        ps.train(folder, progress=last, fit_decisions=False, **SMALL)


def test_done_again_it_is_without_the_person(folder: Path) -> None:
    import polars

    out = folder / "evaluations" / "mine"
    with pytest.raises(ForgottenError):
        run_evaluate(open_dataset(folder), out, forgetting(folder, ended))
    run_evaluate(open_dataset(folder), out, lambda *_: None)
    people = polars.read_parquet(out / "predictions.parquet")["subject"].unique().to_list()
    assert sorted(people) == ["P1", "P3", "P4", "P5"]
    assert not [t for t in traces(folder) if not t.endswith(".npz")]


def test_the_command_says_so_and_forget_can_be_given_again(
    folder: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plushsense.cli.evaluate.report_jobs", lambda *_: forgetting(folder, ended))
    ran = cli("evaluate", folder, "--filters", "2,3,3", "--context", "loop", "--epochs", 1, "--workers", 1)
    assert ran.status == 2
    assert [line for line in ran.err.splitlines() if "while this ran" in line]
    assert traces(folder) == []
    stones = (folder / "forgotten.jsonl").read_bytes()
    ran = cli("forget", folder, PERSON, "--yes")
    assert ran.status == 0, ran.err
    assert f"'{PERSON}' is not in the data set" in ran.out and "0 evaluations" in ran.out
    (folder / "evaluations" / "old").mkdir(parents=True)
    left = folder.parent / ".DS-unfinished-abc"
    left.mkdir()
    found = cli("forget", folder, PERSON, "--json")
    assert found.status == 1 and left.exists()
    found = cli("forget", folder, PERSON, "--yes", "--json").json
    assert (found["evaluations"], found["leftovers"]) == (["evaluations/old"], ["../.DS-unfinished-abc"])
    assert found["absent"] and found["done"] and not left.exists()
    assert (folder / "forgotten.jsonl").read_bytes() == stones


def test_no_byte_of_the_person_is_left_that_is_not_listed(
    folder: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A studio's folder in use: everything that was made of the data is removed by `forget`, or listed by it."""
    home, scratch = folder.parent / "home", folder.parent / "tmp"
    dataset = home / "datasets" / "DS"
    shutil.copytree(folder, dataset)
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    net = {"filters": (2, 3, 3), "context": "loop", "epochs": 1}
    (home / "bundles").mkdir()
    trained = ps.train(dataset, journal=unfinished(dataset), fit_decisions=False, **net)
    trained.save(home / "bundles" / "m.plush")
    ps.evaluate(dataset, split="by-subject:2", out=dataset / "results" / "mine", workers=1, **net)
    shutil.copytree(dataset / "results" / "mine", dataset / "evaluations" / "mine")
    assert cli("backup", dataset, home / "backups" / "b.zip").status == 0
    assert share_copy(dataset, home / "copy", PublishSpec(key=home / "key.csv", pseudonyms=True)).files > 0
    shutil.copytree(folder.parent / "src" / PERSON, home / "recordings" / PERSON)
    shutil.copytree(folder.parent / "src" / PERSON, home / "discarded" / "recordings" / PERSON)
    for place, text in {
        "work/job.json": json.dumps({"sessions": [f"recordings/{PERSON}/1"]}),
        "selections/a.json": json.dumps([f"{PERSON}/Slow_1"]),
        "studio.log": f"12:00 recording {PERSON}",
        "datasets/DS/notes.yaml": f"late: {PERSON}",
        "datasets/.DS-unfinished-1/raw.csv": PERSON,
        "datasets/.DS-unfinished-1/owner.lock": "",
        "datasets/DS/cache/adding-1/raw.csv": PERSON,
        "datasets/DS/.marks.jsonl.1.part": PERSON,
    }.items():
        (home / place).parent.mkdir(parents=True, exist_ok=True)
        (home / place).write_text(text)
    shutil.copytree(home / "datasets" / ".DS-unfinished-1", scratch / ".plushsense-unfinished-1")
    before = {where.split("/")[0] for where in bytes_of(home)}
    assert {"backups", "bundles", "copy", "datasets", "discarded", "key.csv", "work"} - before == {"copy"}
    copied = Path(shutil.copytree(home, home.with_name("everywhere")))
    found = find_traces(copied, PERSON)
    kinds = ["dataset", "dataset", "network", "backup", "key", "folder", "folder", "notes", "notes"]
    assert [trace.kind for trace in found.traces] == kinds
    assert people_of_home(copied) == sorted({"P1", "P3", "P4", "P5", PERSON, *open_dataset(copied / "copy").subjects})
    by_command = Path(shutil.copytree(copied, home.with_name("command")))
    receipt = forget_everywhere(copied, PERSON, [trace.id for trace in found.traces])
    assert receipt.removed == found.traces and (receipt.kept, receipt.failed) == ((), ())
    left = {copied / where for where in bytes_of(copied)}
    assert left == set(receipt.found.mentions) and PERSON in json.dumps(receipt.to_json())
    check_command(cli, by_command, kinds, bytes_of(copied))
    assert len(open_dataset(copied / "copy").subjects) == 4 and found.pseudonyms
    assert PERSON in RemovedCodes.read(copied) and not find_traces(copied, PERSON).traces
    done = cli("forget", dataset, PERSON, "--yes", "--json").json
    listed = [dataset / at for at in done["mentions"]] + [Path(b["bundle"]) for b in done["bundles"]]
    listed += map(Path, (*done["discarded"], *done["elsewhere"]))
    left = [home / where for where in bytes_of(home)]
    assert [path for path in left if not {path, *path.parents} & set(listed)] == []
    assert not bytes_of(scratch) and not list(scratch.iterdir())
    results = [f"results/mine/{name}" for name in ("evaluation.json", "predictions.parquet")]
    assert sorted(bytes_of(dataset)) == ["notes.yaml", *results]
    for path in listed:
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    assert bytes_of(home) == []
    assert open_dataset(dataset).subjects == ["P1", "P3", "P4", "P5"]


def check_command(cli: Cli, home: Path, kinds: list[str], left: list[str]) -> None:
    """Forget by ``plushsense forget HOME PERSON --everywhere``, which leaves the same as the studio."""
    before = bytes_of(home)
    forget_them: tuple[Any, ...] = ("forget", home, PERSON, "--everywhere", "--json")
    planned = cli(*forget_them, "--dry-run")
    assert (planned.status, planned.json["done"]) == (0, False) and bytes_of(home) == before
    assert [trace["kind"] for trace in planned.json["traces"]] == kinds
    assert cli(*forget_them).status == 1 and bytes_of(home) == before
    done = cli(*forget_them, "--yes")
    assert (done.status, done.json["done"], done.json["kept"], done.json["failed"]) == (0, True, [], [])
    assert [kind for kind, _ in done.json["removed"]] == kinds
    assert bytes_of(home) == left and PERSON in RemovedCodes.read(home)
    assert cli("forget", home / "nowhere", PERSON, "--everywhere").status == 2
    assert cli("forget", home, PERSON, "--everywhere", "--bundles", home).status == 2


def bytes_of(folder: Path) -> list[str]:
    """Files below a folder with the person in their path or in any byte, also of what zips and Parquet files hold."""
    import polars

    found = []
    for path in (p for p in folder.rglob("*") if p.is_file()):
        where, data = path.relative_to(folder).as_posix(), [path.read_bytes()]
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                data += [member.encode() + archive.read(member) for member in archive.namelist()]
        elif path.suffix == ".parquet":
            data.append(polars.read_parquet(path).write_csv().encode())
        if PERSON in where or any(PERSON.encode() in each for each in data):
            found.append(where)
    return found
