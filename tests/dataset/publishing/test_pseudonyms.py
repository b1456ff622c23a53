"""New codes for people: the sensors' numbers as they were, the key apart, and no old code left anywhere."""

from __future__ import annotations

import csv
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.dataset.index import open_dataset
from plushsense.dataset.publishing.contents import LATEST_MS, refuse_traces
from plushsense.dataset.publishing.keys import KEY_BYTES, PublicationKey, is_drawn, open_key
from plushsense.dataset.store import Dataset, read_people
from plushsense.workflow.datasets import PublishSpec, publish_dataset, share_copy
from support.toys import SECRETS


@pytest.fixture
def spec(tmp_path: Path) -> PublishSpec:
    return PublishSpec(key=tmp_path / "secret" / "key.csv", pseudonyms=True, reidentification=False)


def codes_of(spec: PublishSpec) -> dict[str, str]:
    assert spec.key is not None
    return dict(open_key(Path(spec.key)).codes)


def test_a_copy_has_the_same_numbers_under_new_codes(source: Dataset, spec: PublishSpec, tmp_path: Path) -> None:
    before = {p: p.read_bytes() for p in source.path.rglob("*") if p.is_file()}
    done = share_copy(source, tmp_path / "OUT", spec)
    assert {p: p.read_bytes() for p in source.path.rglob("*") if p.is_file()} == before, "the original is untouched"
    back, codes = open_dataset(tmp_path / "OUT"), codes_of(spec)
    assert not list(back.path.glob("*.lock")), "opening a copy writes nothing"
    assert set(codes) == {"P1", "P2"} and all(map(is_drawn, codes.values()))
    assert back.subjects == sorted(codes.values())
    old = {(codes.get(r.subject, r.subject), r.start_ms): r for r in source.used}
    assert len(back.recordings) == len(old) == 21
    for r in back.recordings:
        was = old[r.subject, r.start_ms]
        assert np.array_equal(back.read(r).values, source.read(was).values)
        assert np.array_equal(back.read(r).device_ms, source.read(was).device_ms)
        assert (r.stream_row, r.start, r.stop, r.gesture) == (was.stream_row, was.start, was.stop, was.gesture)
        assert r.epoch_ms < LATEST_MS
    people = read_people(back.path)
    assert (people[codes["P1"]].age_group, people[codes["P1"]].consent) == ("child", "")
    assert done.to_dict()["files"] == len([p for p in back.path.rglob("*") if p.name not in _INDEX and p.is_file()])
    for path in back.path.rglob("*"):
        text = path.relative_to(back.path).as_posix() + (path.read_text("utf-8") if path.is_file() else "")
        assert not any(secret in text for secret in (*SECRETS, "P1", "P2")), path


_INDEX = ("index.json", "recordings.csv", "streams.csv")


def test_a_package_under_new_codes_is_valid_and_a_person_keeps_the_code(
    source: Dataset, spec: PublishSpec, tmp_path: Path
) -> None:
    dataset = open_dataset(shutil.copytree(source.path, tmp_path / "DS"))
    share_copy(dataset, tmp_path / "copy", replace(spec, streams=False))
    first = codes_of(spec)
    for kind in ("recordings", "streams"):
        shutil.copytree(dataset.path / kind / "P2", dataset.path / kind / "P77")
    done = publish_dataset(dataset.path, tmp_path / "package", spec)
    assert done.checked.problems == []
    second = codes_of(spec)
    assert {code: second[code] for code in first} == first and set(second) - set(first) == {"P77"}
    with (tmp_path / "package" / "subjects.csv").open(newline="") as file:
        assert {row["subject"] for row in csv.DictReader(file)} == {*second.values(), "none"}
    if os.name == "posix":
        assert Path(spec.key or "").stat().st_mode & 0o777 == 0o600
    # One secret: the same times in both.
    times = [{(r.subject, r.epoch_ms) for r in open_dataset(p).recordings} for p in _places(tmp_path)]
    assert times[0] < times[1]


def _places(home: Path) -> tuple[Path, Path]:
    return home / "copy", home / "package" / "data"


@pytest.mark.parametrize("where", ["title", "gesture", "column"])
def test_an_old_code_anywhere_stops_it_and_nothing_is_left(
    source: Dataset, spec: PublishSpec, tmp_path: Path, where: str
) -> None:
    dataset = open_dataset(shutil.copytree(source.path, tmp_path / "DS"))
    if where == "title":
        dataset.head = replace(dataset.head, about=replace(dataset.head.about, title="Touch of p-1"))
    elif where == "gesture":
        file = next((dataset.path / "recordings" / "P2").rglob("Pat*.csv"))
        file.rename(file.with_name(file.name.replace("Pat", "Wave of P1")))
        dataset = _opened_again(dataset)
    else:
        table = dataset.path / "subjects.csv"
        table.write_text(re.sub("^(P1,)[^,]*", r"\1as P2", table.read_text(), flags=re.MULTILINE))
    with pytest.raises(DatasetError, match=r"would still hold 'P1|p-1|P2'"):
        share_copy(dataset, tmp_path / "OUT", spec)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["DS", "secret"]


def _opened_again(dataset: Dataset) -> Dataset:
    (dataset.path / "index.json").unlink()
    return open_dataset(dataset.path)


def test_traces_are_found_in_names_and_texts(tmp_path: Path) -> None:
    (tmp_path / "recordings" / "S2222").mkdir(parents=True)
    (tmp_path / "recordings" / "S2222" / "Rub_1_1.csv").write_text("host; x\n1; 7\n")
    refuse_traces(tmp_path, ["ana", "none", "7"])
    (tmp_path / "recordings" / "7").mkdir()
    (tmp_path / "recordings" / "7" / "Rub_1_1.csv").write_text("host; x\n1; 7\n")
    with pytest.raises(DatasetError, match=r"recordings/7/Rub_1_1.csv' would still hold '7'"):
        refuse_traces(tmp_path, ["ana", "7"])


def test_a_key_beside_the_data_or_missing_is_refused(source: Dataset, spec: PublishSpec, tmp_path: Path) -> None:
    for place in (source.path / "key", tmp_path / "OUT" / "key", source.path / "cache" / "k" / "key"):
        with pytest.raises(DatasetError, match="store it elsewhere"):
            share_copy(source, tmp_path / "OUT", replace(spec, key=place))
    with pytest.raises(DatasetError, match="lies in the data set itself"):
        share_copy(source, source.path / "OUT", spec)
    with pytest.raises(ConfigError, match="need a key"):
        share_copy(source, tmp_path / "OUT", replace(spec, key=None))
    (tmp_path / "OUT").mkdir()
    (tmp_path / "OUT" / "mine.txt").write_text("x")
    with pytest.raises(DatasetError, match="already holds something"):
        share_copy(source, tmp_path / "OUT", spec)


def test_codes_are_new_each_time(tmp_path: Path) -> None:
    people = [f"P{n}" for n in range(300)]
    a, b = PublicationKey().with_people(people), PublicationKey().with_people(people)
    assert len(set(a.codes.values())) == 300 and not set(a.codes.values()) & set(people)
    assert sum(a.codes[p] == b.codes[p] for p in people) < 5, "nothing of a code comes from the name"
    assert PublicationKey().with_people(["none", "unknown"]).codes == {}
    path = tmp_path / "key"
    a.write(path)
    assert open_key(path) == a
    longer = a.with_people(["new, one"])
    longer.write(path)
    assert open_key(path) == longer and dict(a.codes).items() <= dict(longer.codes).items()
    assert [p.name for p in tmp_path.iterdir()] == ["key"]
    assert not any(is_drawn(code) for code in ("P01", "Anna", "S7K2", "S7K2Q1", "s7k2q", "S0K2Q"))


SECRET = "ab" * KEY_BYTES


@pytest.mark.parametrize(
    "text",
    [
        "",
        "x",
        "abcd",
        f"{SECRET}\na,b\n",
        f"{SECRET}\noriginal,code\n,S1\n",
        f"{SECRET}\noriginal,code\nP1,SA\nP2,sa\n",
        f"{SECRET}\noriginal,code\nP1,SA,1\n",
        "\u0100",
    ],
)
def test_what_is_no_key_is_refused_and_kept(tmp_path: Path, text: str) -> None:
    path = tmp_path / "key"
    path.write_bytes(text.encode("utf-16" if text == "\u0100" else "utf-8"))
    before = path.read_bytes()
    with pytest.raises(DatasetError, match="is not a key of plushsense publish"):
        open_key(path)
    assert path.read_bytes() == before
