"""A package as those open it who have no PlushSense: each reads every table and the rows of every file."""

from __future__ import annotations

import glob
import importlib
import itertools
import json
import re
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks, read_marks
from plushsense.dataset.publishing.contents import ContentsSpec
from plushsense.dataset.publishing.package import PublishResult
from plushsense.dataset.publishing.texts import changed_text, is_misread, kind_of, label_prefix, public_label
from plushsense.dataset.store import Dataset, PersonInfo, write_people
from support.requirements import missing
from support.toys import KEY, made_of

pytestmark = pytest.mark.apart("readers")

NOW = 1_700_000_000_000
ROWS = 30
LABELS = (
    "null",
    "None",
    "nan",
    "01",
    "1e3",
    "true",
    "2024-05-01",
    "no",
    "'Hi'",
    "Ērģeles [2] ❤",
    "手, touch 50%",
    "Pat #1",
)
PEOPLE = ("Žanis", "007")
TABLES = ("recordings", "subjects", "gestures", "channels", "streams")


def bring(folder: Path, labels: tuple[str, ...] = LABELS, people: tuple[str, ...] = PEOPLE) -> Dataset:
    """A recording of each label by each person, cut from a stream of the first person."""
    for number, person in enumerate(people):
        stream = []
        (folder / "src" / person).mkdir(parents=True)
        for k, label in enumerate(labels):
            began = NOW + 10**6 * number + 20 * ROWS * k
            rows = [f"{began + 10 * i}, {20 * ROWS * k + 10 * i}, {i}, {k - 3}, {7 * number}" for i in range(ROWS)]
            stream += rows
            text = "\n".join(rows) + "\n"
            (folder / "src" / person / f"{label}_{began + 400}_{ROWS}.csv").write_text(text, encoding="utf-8")
        if not number:
            (folder / "src" / person / "fulldatastream.csv").write_text("\n".join(stream) + "\n", encoding="utf-8")
    dataset = import_recordings(
        folder / "src", folder / "DS", layout="accel-3", licence="CC0-1.0", consent="given"
    ).dataset
    text = (dataset.path / "dataset.toml").read_text(encoding="utf-8")
    contact = '[about.contact]\nname = "A"\nemail = "a@example.org"\n\n[layout]'
    (dataset.path / "dataset.toml").write_text(text.replace("[layout]", contact, 1), encoding="utf-8")
    return open_dataset(dataset.path)


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    dataset = bring(tmp_path_factory.mktemp("hostile"))
    append_marks(
        dataset.path,
        [
            Mark(dataset.recordings[0].id, "relabel", "me", gesture="null"),
            Mark(dataset.streams[0].id, "label", "me", start=2, stop=9, label="practice:01"),
        ],
    )
    write_people(dataset.path, [PersonInfo("007", "9", "true"), PersonInfo("Žanis")])
    return open_dataset(dataset.path)


@pytest.fixture(scope="module")
def package(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> PublishResult:
    return made_of(source, tmp_path_factory.mktemp("out") / "package", ContentsSpec(key=KEY))


@pytest.fixture(scope="module")
def expected(package: PublishResult) -> list[tuple[str, str, str]]:
    """The person, gesture and file of each recording, in the order of the table."""
    return [(r.subject, r.gesture, f"data/{r.file}") for r in open_dataset(package.folder / "data").recordings]


def reader(module: str, word: str = "publish") -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        return missing(word, f"{module} is not installed")


def test_every_gesture_and_code_is_a_text_that_nobody_misreads(source: Dataset, package: PublishResult) -> None:
    assert package.checked.problems == []
    back = open_dataset(package.folder / "data")
    renamed = {"null", "None", "nan", "01", "1e3", "true", "2024-05-01", "no", "'Hi'"}
    assert {r.gesture for r in back.recordings} == {f"gesture {x}" if x in renamed else x for x in LABELS}
    assert back.subjects == ["P007", "Žanis"]
    first = next(r for r in back.recordings if r.gesture != r.recorded)
    assert (first.gesture, source.recordings[0].gesture) == ("gesture null", "null")
    assert [mark.stretches[0].label for mark in read_marks(back.path).values() if mark.stretches] == [
        "practice:gesture 01"
    ]
    assert any("'01' is now 'gesture 01'" in note for note in package.description.notes)


def test_mlcroissant_reads_each_table_as_often_as_asked(
    package: PublishResult, expected: list[tuple[str, str, str]]
) -> None:
    loaded = reader("mlcroissant").Dataset(str(package.folder / "croissant.json"))
    for _ in range(2):
        rows = list(loaded.records("recordings"))
        found = [tuple(r[f"recordings/{k}"].decode() for k in ("subject", "gesture", "file")) for r in rows]
        assert found == expected
        assert len(list(loaded.records("streams"))) == 1
        samples = list(loaded.records("samples"))
        assert len(samples) == ROWS * len(expected)
        assert {r["samples/file"].decode() for r in samples} == {file for _, _, file in expected}


def test_frictionless_reads_the_zip_itself(package: PublishResult, expected: list[tuple[str, str, str]]) -> None:
    opened = reader("frictionless").Package(str(package.zip))
    rows = opened.get_resource("recordings").read_rows()
    assert [(r["subject"], r["gesture"], r["file"]) for r in rows] == expected
    assert opened.get_resource("samples-00000").read_rows()[-1]["x"] == ROWS - 1
    people = {r["subject"]: r for r in opened.get_resource("subjects").read_rows()}
    assert (people["P007"]["gender"], people["P007"]["age_group"]) == (True, 9)
    assert people["Žanis"]["gender"] is None


def test_hugging_face_loads_the_folder(
    package: PublishResult, expected: list[tuple[str, str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = reader("datasets")
    datasets.disable_progress_bars()
    root = str(package.folder)

    def load(*config: str, **more: Any) -> Any:
        return datasets.load_dataset(root, *config, split="train", cache_dir=str(tmp_path), **more)

    assert set(datasets.get_dataset_config_names(root)) == {*TABLES, "samples", "stream-samples"}
    recordings = load()
    assert [(r["subject"], r["gesture"], r["file"]) for r in recordings] == expected
    samples = load("samples")
    assert set(samples.column_names) == {"host_ms", "device_ms", "x", "y", "z"}
    # Which file a row is from: the files are in the order of the table, each with all of its rows.
    for number in (0, 7, len(expected) - 1):
        file = recordings[number]["file"]
        alone = load(data_files=glob.escape(file))
        begin = sum(recordings[:number]["rows"])
        assert samples[begin : begin + len(alone)] == alone[:]
        assert len(alone) == recordings[number]["rows"]
    assert len(load("stream-samples")) == ROWS * len(LABELS)
    assert load("streams")[0]["rows"] == ROWS * len(LABELS)


def test_pandas_polars_and_duckdb_guess_the_same(package: PublishResult, expected: list[tuple[str, str, str]]) -> None:
    pandas, polars, duckdb = reader("pandas", "tables"), reader("polars", "tables"), reader("duckdb")
    root = package.folder
    for name in TABLES:
        path = str(root / f"{name}.csv")
        keys = ("subject", "gesture", "family", "channel", "file", "session", "excluded", "gender", "rows")
        frame = pandas.read_csv(path)
        for key in frame.columns.intersection(keys):
            plain = [None if v != v else v for v in frame[key].tolist()]
            assert plain == polars.read_csv(path)[key].to_list(), (name, key)
            assert plain == [row[0] for row in duckdb.sql(f"select \"{key}\" from '{path}'").fetchall()], (name, key)
        if name == "recordings":
            assert list(zip(frame["subject"], frame["gesture"], frame["file"], strict=True)) == expected
            assert set(frame["session"]) == {1}
    files = {str(root / file) for _, _, file in expected}
    every = f"{root}/data/recordings/**/*.csv"
    rows = polars.scan_csv(every, include_file_paths="file").collect()
    assert (set(rows["file"]), len(rows)) == (files, ROWS * len(expected))
    counted = duckdb.sql(f"select filename, count(*) from read_csv('{every}', filename = true) group by all").fetchall()
    assert {(Path(file), n) for file, n in counted} == {(Path(file), ROWS) for file in files}


def test_a_value_of_a_person_that_would_be_changed_is_refused(tmp_path: Path) -> None:
    dataset = bring(tmp_path, ("Pat",), ("P1", "P2"))
    for value, other in (("007", ""), ("N/A", "left"), ("TRUE", "")):
        write_people(dataset.path, [PersonInfo("P1", gender=value), PersonInfo("P2", gender=other)])
        with pytest.raises(DatasetError, match=re.escape(f"the gender '{value}'")) as refused:
            made_of(dataset, tmp_path / "out", ContentsSpec())
        assert "subjects.csv" in str(refused.value)
        assert [p.name for p in sorted(tmp_path.iterdir())] == ["DS", "src"]


def test_texts_that_are_misread() -> None:
    odd = (
        "null",
        "NULL",
        "NaN",
        "#N/A",
        "<NA>",
        "1.#IND",
        "True",
        "1",
        "+1.5",
        "1E-3",
        "inf",
        "0x1F",
        "12:30",
        "T",
        "yes",
    )
    assert [text for text in odd if not is_misread(text)] == []
    assert not any(map(is_misread, ("none", "Pat", "1st", "Tail tap 1", "?", "❤", "手", "e3", "gesture 01")))
    assert (label_prefix(["01", "Pat"]), label_prefix(["01", "gesture_01"])) == ("gesture ", "gesture gesture ")
    assert [public_label(label, "gesture ") for label in ("01", "Pat")] == ["gesture 01", "Pat"]
    assert [kind_of(v) for v in (["7", ""], ["7", "7.5"], ["true"], ["7", "a"], ["07"], [""])] == [
        "integer",
        "number",
        "boolean",
        "string",
        "string",
        "string",
    ]
    assert [changed_text(v) for v in (["1", "2"], ["1", ""], ["01", "a"], ["a", "NA"], ["yes", "no"], [])] == [
        None,
        "1",
        None,
        "NA",
        None,
        None,
    ]


def test_the_head_of_the_readme_lists_every_table(package: PublishResult) -> None:
    head, text = itertools.islice((package.folder / "README.md").read_text("utf-8").split("---\n", 2), 1, 3)
    configs = [json.loads(line[2:]) for line in head.splitlines() if "data_files" in line]
    assert [c["config_name"] for c in configs] == [t.name for t in package.description.tables]
    assert text.startswith("# ")


def test_the_code_in_the_readme_runs(
    package: PublishResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expected: list[tuple[str, str, str]]
) -> None:
    for module in ("mlcroissant", "frictionless", "duckdb", "pandas", "polars"):
        reader(module)
    monkeypatch.setattr(reader("datasets").config, "HF_DATASETS_CACHE", tmp_path)
    monkeypatch.chdir(package.folder)
    blocks = re.findall(r"```python\n(.*?)```", (package.folder / "README.md").read_text("utf-8"), re.DOTALL)
    assert len(blocks) == 5
    found: dict[str, Any] = {}
    # Not the first one: PlushSense may write its index into the folder.
    for block in blocks[1:]:
        exec(block, found)
        if "recordings" in block:
            rows = found["recordings"]
            rows = rows.to_dict("records") if hasattr(rows, "to_dict") and hasattr(rows, "iloc") else list(rows)
            assert [(r["subject"], r["gesture"], r["file"]) for r in rows] == expected
        if "one =" in block:
            assert len(found["one"]) == ROWS
        if "rows =" in block:
            assert found["rows"].shape[0] == ROWS * len(expected)
    assert found["row"]["samples/file"].decode() == expected[-1][2]
