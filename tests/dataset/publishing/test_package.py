import csv
import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError, ForgottenError, MissingExtraError
from plushsense.core.recorder_csv import read_recording, read_stream
from plushsense.dataset.about import Funding
from plushsense.dataset.files import list_package_files
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.publishing.checking import validate_package
from plushsense.dataset.publishing.contents import ContentsSpec
from plushsense.dataset.publishing.keys import PublicationKey
from plushsense.dataset.publishing.package import PublishResult, complete_head, publish
from plushsense.dataset.store import Dataset
from support.toys import KEY, SECRETS, made_of, make

pytestmark = pytest.mark.apart("publishing")


def test_every_validator_agrees(package: PublishResult) -> None:
    assert package.checked.problems == []
    assert [v.validator for v in package.checked.validators] == [
        "checksums",
        "data",
        "times",
        "metadata",
        "croissant",
        "frictionless",
        "datacite",
    ]
    assert package.zip is not None
    assert package.to_dict()["valid"] is True


def test_the_zip_holds_the_same_and_is_valid_too(package: PublishResult) -> None:
    assert package.zip is not None
    with zipfile.ZipFile(package.zip) as archive:
        names = archive.namelist()
        assert names == sorted(names)
        assert "datapackage.json" in names, "frictionless looks for it there"
        assert len(names) == package.files
    assert validate_package(package.zip).problems == []


def test_nothing_leaves_that_should_not(source: Dataset, package: PublishResult) -> None:
    """Every byte of every file and name, looked through for the days, the names, the notes and the places."""
    layout = source.layout
    times = {r.epoch_ms for r in source.recordings}
    for r in source.recordings:
        frames = read_recording(source.path / r.file, layout).frames
        assert frames.host_ms is not None
        times |= set(frames.host_ms.tolist())
        times.add(int(Path(r.file).stem.split("_")[-2]))
    for s in source.streams:
        host = read_stream(source.path / s.file, layout).frames.host_ms
        assert host is not None
        times |= set(host.tolist())
    assert len(times) > 2000
    assert package.zip is not None
    with zipfile.ZipFile(package.zip) as archive:
        inside = {name: archive.read(name) for name in archive.namelist()}
    on_disk = {str(p.relative_to(package.folder)): p.read_bytes() for p in list_package_files(package.folder)}
    for name, data in [*inside.items(), *on_disk.items()]:
        text = name + "\n" + data.decode("utf-8")
        for secret in (*SECRETS, str(source.path), source.path.parent.name):
            assert secret not in text, f"{secret!r} in {name}"
        found = {int(n) for n in re.findall(r"(?<![0-9a-f])\d{12,14}(?![0-9a-f])", text)}
        assert not found & times, name
        # Seconds, and dates written out.
        assert not {t // 1000 for t in found} & {t // 1000 for t in times}
        assert "20231" not in re.sub(r"[0-9a-f]{64}|\d{12,}", "", text), name


def test_names_of_what_is_left_out_are_told(package: PublishResult) -> None:
    text = (package.folder / "README.md").read_text(encoding="utf-8")
    assert "Left out: 1 excluded recording. Their rows are still in the session's stream." in text
    assert "Trimmed: 1 recording;" in text
    assert "Left out: 3 columns of the people's table." in text
    assert "**not looked at**" in text
    assert "Curie, Marie; A Lab (2026): Touch of two people, version 1.0.0 [data set]. https://doi.org/10." in text


def test_every_value_comes_back_and_times_keep_their_distances(source: Dataset, package: PublishResult) -> None:
    back = open_dataset(package.folder / "data")
    assert len(back.recordings) == len(source.recordings) - 1
    assert (back.subjects, back.layout.names) == (source.subjects, source.layout.names)
    raw = {r.sha256: r for r in source.used}
    before = {(r.subject, r.start_ms): r for r in raw.values()}
    shifts: dict[str, set[int]] = {}
    for r in back.recordings:
        old = before[r.subject, r.start_ms]
        then, now = source.read(old), back.read(r)
        assert np.array_equal(then.values, now.values)
        assert np.array_equal(then.device_ms, now.device_ms)
        assert then.host_ms is not None
        assert now.host_ms is not None
        shifts.setdefault(r.subject, set()).update((then.host_ms - now.host_ms).tolist())
        assert (r.gesture, r.start, r.stop, r.rows) == (old.gesture, old.start, old.stop, old.rows)
        assert r.stream_row == old.stream_row >= 0
    assert all(len(of_one) == 1 for of_one in shifts.values()), "one shift for all files of a person"
    assert len({next(iter(of_one)) for of_one in shifts.values()}) == 3, "and another for each person"
    assert {r.session for r in back.recordings if r.subject == "P1"} == {"1", "2"}
    # Opening it left an index there, which is no damage.
    assert validate_package(package.folder).problems == []


def test_the_tables_say_what_there_is(package: PublishResult) -> None:
    with (package.folder / "recordings.csv").open(encoding="utf-8", newline="") as file:
        recordings = list(csv.DictReader(file))
    assert {r["affect"] for r in recordings if r["gesture"] == "Ear_tug"} == {"positive"}
    assert [r["subject"] for r in recordings if r["gesture"] == "Lie"] == ["none", "none"]
    assert all((package.folder / r["file"]).is_file() and (package.folder / r["stream"]).is_file() for r in recordings)
    trimmed = [r for r in recordings if (r["start"], r["stop"]) == ("5", "50")]
    assert len(trimmed) == 1
    with (package.folder / "subjects.csv").open(encoding="utf-8", newline="") as file:
        people = {r["subject"]: r for r in csv.DictReader(file)}
    read = (package.folder / "README.md").read_text("utf-8")
    assert "| gestures | 3, of 4 in the set |" in read
    assert "21 recordings of 3 gestures by 2 people" in read
    assert "of 3 gestures by 2 people" in (package.folder / "croissant.json").read_text("utf-8")
    assert set(people["P1"]) == {"subject", "age_group", "gender", "recordings", "sessions"}
    assert any("2 people have an age group and gender that fewer than 3" in w for w in package.warnings)
    assert (people["P1"]["age_group"], people["P1"]["sessions"], people["none"]["age_group"]) == ("child", "2", "")


def test_the_same_key_and_day_make_the_same_bytes(source: Dataset, package: PublishResult, tmp_path: Path) -> None:
    again = made_of(source, tmp_path / "again")
    assert again.zip is not None
    assert package.zip is not None
    assert again.zip.read_bytes() == package.zip.read_bytes()
    other = made_of(source, tmp_path / "other", ContentsSpec(key=PublicationKey(KEY.secret[::-1])))
    mine = {r.start_ms: r.epoch_ms for r in again.description.dataset.recordings}
    assert all(mine[r.start_ms] != r.epoch_ms for r in other.description.dataset.recordings)


def test_excluded_and_no_streams_on_request(source: Dataset, tmp_path: Path) -> None:
    done = made_of(source, tmp_path / "out", ContentsSpec(streams=False, excluded=True, key=KEY))
    assert done.checked.problems == []
    assert not (done.folder / "data" / "streams").exists()
    assert not (done.folder / "streams.csv").exists()
    back = open_dataset(done.folder / "data")
    assert sum(r.excluded for r in back.recordings) == 1
    assert "Left out: 5 session streams." in done.description.notes


def test_a_simulation_says_so_everywhere(tmp_path: Path) -> None:
    done = made_of(make(tmp_path / "DS", simulated=True), tmp_path / "out")
    assert done.valid
    for name in (
        "README.md",
        "SIMULATION.txt",
        "croissant.json",
        "datapackage.json",
        "datacite.json",
        "LICENSE.txt",
    ):
        assert "SIMULATION" in (done.folder / name).read_text(encoding="utf-8"), name
    assert "simulated = true" in (done.folder / "data" / "dataset.toml").read_text()


def test_a_licence_text_of_one_s_own_is_taken_along(tmp_path: Path) -> None:
    dataset = make(tmp_path / "DS")
    (tmp_path / "DS" / "LICENSE").write_text("Do what you like.\n")
    dataset.head = replace(dataset.head, licence="MIT")
    done = made_of(dataset, tmp_path / "out")
    assert (done.folder / "LICENSE.txt").read_text() == "Do what you like.\n"
    assert not [w for w in done.warnings if "MIT" in w]


def test_what_is_missing_is_asked_for_in_one_sentence(source: Dataset) -> None:
    bare = replace(
        source.head,
        licence="",
        consent=" ",
        about=replace(source.head.about, contact=type(source.head.about.contact)()),
    )
    with pytest.raises(DatasetError) as refused:
        complete_head(bare, Path("DS"))
    said = str(refused.value)
    assert "dataset.toml'" in said
    for line in ('licence = "', 'consent = "', "contact = {", "--licence", "--consent", "--contact"):
        assert line in said
    assert "\n" not in said
    with pytest.raises(DatasetError) as refused:
        complete_head(bare, Path("DS"), licence="MIT", consent="yes")
    assert "licence = " not in str(refused.value)
    full = complete_head(bare, Path("DS"), licence="mit", consent="yes", contact="Ada <ada@example.org>")
    assert (full.licence, full.consent, full.about.contact.email) == ("MIT", "yes", "ada@example.org")
    with pytest.raises(DatasetError, match="Did you mean 'CC-BY-4.0'"):
        complete_head(full, Path("DS"), licence="CC BY 4.0")
    with pytest.raises(DatasetError, match="three numbers"):
        complete_head(replace(full, version="1.0"), Path("DS"))


def test_a_place_that_is_taken_is_refused(source: Dataset, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    with pytest.raises(DatasetError, match="already holds something"):
        made_of(source, tmp_path / "out")
    (tmp_path / "new.zip").write_text("mine")
    with pytest.raises(DatasetError, match="already there"):
        made_of(source, tmp_path / "new")
    with pytest.raises(DatasetError, match="lies in the data set itself"):
        made_of(source, source.path / "package")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new.zip", "out"]


def test_without_the_validators_the_install_command_is_told(
    source: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "mlcroissant", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'plushsense\[publish\]'"):
        made_of(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_who_is_removed_during_the_validation_is_in_no_package(source: Dataset, tmp_path: Path) -> None:
    dataset = open_dataset(shutil.copytree(source.path, tmp_path / "DS"))
    person = dataset.subjects[0]

    def meanwhile(stage: str, done: int, total: int) -> None:
        if stage == "validating" and person in open_dataset(dataset.path).subjects:
            (written,) = tmp_path.glob(".out-unfinished-*/out/recordings.csv")
            assert person in written.read_text()
            forget(dataset.path, person)

    with pytest.raises(ForgottenError):
        publish(dataset, tmp_path / "out", dataset.head, progress=meanwhile)
    assert [p.name for p in tmp_path.iterdir()] == ["DS"]


def test_without_its_folder_there_is_no_zip(source: Dataset, tmp_path: Path) -> None:
    def meanwhile(stage: str, done: int, total: int) -> None:
        if stage == "validating":
            (tmp_path / "out").write_text("mine")

    with pytest.raises(DatasetError, match="cannot be created"):
        publish(source, tmp_path / "out", source.head, progress=meanwhile)
    assert [p.name for p in tmp_path.iterdir()] == ["out"] and (tmp_path / "out").read_text() == "mine"


def test_a_control_character_in_the_description_is_refused_in_one_sentence(source: Dataset) -> None:
    about = replace(source.head.about, keywords=("touch", "a\0"))
    with pytest.raises(DatasetError, match=r"'about.keywords\[1\]' .* U\+0000"):
        replace(source.head, about=about)
    with pytest.raises(DatasetError, match="no funder"):
        Funding(" ")
