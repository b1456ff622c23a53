"""One file that brings a data set back; a damaged one brings back nothing."""

import hashlib
import json
import os
import random
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plushsense.core.errors import DatasetError, ForgottenError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, recording_filename, write_recording
from plushsense.dataset.backup import MANIFEST, backup, check_backup, restore
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.privacy.forget import forget

pytestmark = pytest.mark.slow

ACCEL = load_layout("accel-3")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    for person in ("ana", "ben"):
        (tmp_path / "src" / person).mkdir(parents=True)
        for n in range(3):
            clock = np.arange(50, dtype=np.int64) * 10
            frames = Frames(rng.integers(0, 900, (50, 3)), clock, clock + 10**12 + n)
            write_recording(tmp_path / "src" / person / recording_filename("Wave", 10**12 + n, 50), frames, ACCEL)
    ds = import_recordings(tmp_path / "src", tmp_path / "DS", layout="accel-3").dataset
    append_marks(ds.path, [Mark(ds.recordings[0].id, "exclude", "me", "ç")])
    for place in ("cache/folds", "evaluations/first"):
        (ds.path / place).mkdir(parents=True)
    (ds.path / "cache" / "folds" / "x.npz").write_text("x")
    (ds.path / "evaluations" / "first" / "evaluation.json").write_text("{}")
    (ds.path / "recordings" / "ana" / "session.json").write_text("{}")
    (ds.path / "Ünterlagen.txt").write_text("ours")
    return ds.path


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def kept(folder: Path) -> dict[str, bytes]:
    left_out = ("cache/", "recordings.csv", "streams.csv", "index.json", "marks.jsonl.lock")
    return {name: data for name, data in files(folder).items() if not name.startswith(left_out)}


def test_what_comes_back_is_what_was_saved(folder: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    done = backup(folder, tmp_path / "out" / "a.zip", progress=lambda at, total: told.append((at, total)))
    assert (done.recordings, done.subjects, done.files) == (6, 2, len(kept(folder)))
    assert told[-1][0] == told[-1][1]
    assert check_backup(tmp_path / "out" / "a.zip").hash == open_dataset(folder).hash == done.hash
    again = restore(tmp_path / "out" / "a.zip", tmp_path / "R")
    assert kept(tmp_path / "R") == kept(folder)
    assert again.hash == done.hash
    assert [r.excluded for r in again.recordings].count(True) == 1
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a.zip"]


def test_the_same_data_set_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    backup(folder, tmp_path / "a.zip")
    restore(tmp_path / "a.zip", tmp_path / "R")
    backup(tmp_path / "R", tmp_path / "b.zip")
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_nothing_is_overwritten(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_text("mine")
    with pytest.raises(DatasetError, match="never replaces"):
        backup(folder, tmp_path / "a.zip")
    assert (tmp_path / "a.zip").read_text() == "mine"
    with pytest.raises(DatasetError, match="lies in the data set"):
        backup(folder, folder / "a.zip")
    backup(folder, tmp_path / "b.zip")
    (tmp_path / "R").mkdir()
    (tmp_path / "R" / "mine").write_text("x")
    with pytest.raises(DatasetError, match="already holds something"):
        restore(tmp_path / "b.zip", tmp_path / "R")
    with pytest.raises(DatasetError, match="no backup"):
        restore(tmp_path / "a.zip", tmp_path / "R2")
    with pytest.raises(DatasetError, match="There is no backup"):
        check_backup(tmp_path / "nowhere.zip")


def test_a_flipped_byte_or_a_cut_end_never_restores_something_else(folder: Path, tmp_path: Path) -> None:
    backup(folder, tmp_path / "a.zip")
    data = (tmp_path / "a.zip").read_bytes()
    drawn = random.Random(7)
    bad, refused = tmp_path / "bad.zip", 0
    places = [(at, 1 << drawn.randrange(8)) for at in drawn.sample(range(len(data)), 150)]
    for trial, (at, bit) in enumerate(places):
        bad.write_bytes(data[:at] + bytes([data[at] ^ bit]) + data[at + 1 :])
        try:
            restore(bad, tmp_path / f"R{trial}")
        except DatasetError:
            refused += 1
            assert not (tmp_path / f"R{trial}").exists()
        else:
            # Some bytes are of no consequence, such as a time of a file; then all is as it was.
            assert kept(tmp_path / f"R{trial}") == kept(folder)
    assert refused > 100
    for length in (0, 10, len(data) // 2, len(data) - 1):
        bad.write_bytes(data[:length])
        with pytest.raises(DatasetError):
            check_backup(bad)


Change = Callable[[zipfile.ZipInfo, bytes], list[tuple[object, bytes]]]
ELSEWHERE = ["../evil.txt", "/tmp/evil.txt", "a/../../evil.txt", "C:/evil.txt", "a\\evil.txt", "a//b", "."]


def rewritten(source: Path, target: Path, change: Change) -> Path:
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for info in old.infolist():
            for name, data in change(info, old.read(info)):
                new.writestr(name, data)  # type: ignore[arg-type]
    return target


def renamed(wrong: str) -> Change:
    """A backup whose manifest and member agree on a name that leads elsewhere."""

    def change(info: zipfile.ZipInfo, data: bytes) -> list[tuple[object, bytes]]:
        if info.filename == MANIFEST:
            table = json.loads(data)
            table["files"][-1]["path"] = wrong
            return [(MANIFEST, json.dumps(table).encode())]
        return [(wrong if info.filename == "Ünterlagen.txt" else info.filename, data)]

    return change


@pytest.mark.parametrize("wrong", ELSEWHERE)
def test_paths_that_leave_are_refused(folder: Path, tmp_path: Path, wrong: str) -> None:
    backup(folder, tmp_path / "a.zip")
    bad = rewritten(tmp_path / "a.zip", tmp_path / "bad.zip", renamed(wrong))
    with pytest.raises(DatasetError, match=r"is not used|damaged"):
        restore(bad, tmp_path / "deep" / "R")
    assert not list(tmp_path.rglob("evil*"))
    assert not (tmp_path / "deep" / "R").exists()


def test_links_missing_added_and_changed_members_are_refused(folder: Path, tmp_path: Path) -> None:
    backup(folder, tmp_path / "a.zip")
    link = zipfile.ZipInfo("dataset.toml")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    changes: dict[str, Change] = {
        "a link": lambda i, d: [(link if i.filename == "dataset.toml" else i.filename, d)],
        "is missing": lambda i, d: [] if i.filename == "dataset.toml" else [(i.filename, d)],
        "not in the manifest": lambda i, d: [(i.filename, d), (i.filename + "2", d)],
        "differs from the saved file": lambda i, d: [(i.filename, d + b" " if i.filename != MANIFEST else d)],
        "holds no": lambda i, d: [] if i.filename == MANIFEST else [(i.filename, d)],
    }
    for n, (said, change) in enumerate(changes.items()):
        bad = rewritten(tmp_path / "a.zip", tmp_path / f"bad{n}.zip", change)
        with pytest.raises(DatasetError, match=said):
            check_backup(bad)
        with pytest.raises(DatasetError, match=said):
            restore(bad, tmp_path / "R")
        assert not (tmp_path / "R").exists()


def test_a_data_set_that_lacks_a_file_is_not_saved_as_if_whole(folder: Path, tmp_path: Path) -> None:
    next((folder / "recordings" / "ben").glob("*.csv")).unlink()
    with pytest.raises(DatasetError, match="lacks 1 raw file"):
        backup(folder, tmp_path / "a.zip")
    assert not (tmp_path / "a.zip").exists()


def test_what_comes_while_saving_is_not_in_it(folder: Path, tmp_path: Path) -> None:
    def another(done: int, total: int) -> None:
        (folder / "recordings" / "ben" / "late.json").write_text("x")

    before = len(kept(folder))
    backup(folder, tmp_path / "a.zip", progress=another)
    assert check_backup(tmp_path / "a.zip").files == before == len(kept(folder)) - 1


def test_a_file_that_changes_while_it_is_saved_stops_the_backup(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growing = folder / "recordings" / "ana" / "session.json"
    real = zipfile.ZipFile.open

    def write_meanwhile(archive: zipfile.ZipFile, name: object, *words: object, **more: object) -> object:
        if getattr(name, "filename", "") == "recordings/ana/session.json":
            growing.write_text("{ }")
        return real(archive, name, *words, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(zipfile.ZipFile, "open", write_meanwhile)
    with pytest.raises(DatasetError, match="changed while it was saved"):
        backup(folder, tmp_path / "a.zip")
    assert not list(tmp_path.glob("*a.zip*"))


@pytest.mark.skipif(sys.platform == "win32", reason="needs links")
def test_links_to_folders_are_named(folder: Path, tmp_path: Path) -> None:
    (folder / "elsewhere").symlink_to(tmp_path, target_is_directory=True)
    assert backup(folder, tmp_path / "a.zip").left_out == ("elsewhere",)


def test_a_file_put_in_place_of_another_is_noticed(folder: Path, tmp_path: Path) -> None:
    """The zip's own checksum is right then; the manifest's is not, or (made anew too) the data set's."""
    backup(folder, tmp_path / "a.zip")
    changed = next(name for name in kept(folder) if name.endswith("_50.csv"))
    for careful in (False, True):
        target = tmp_path / f"{careful}.zip"
        with zipfile.ZipFile(tmp_path / "a.zip") as old, zipfile.ZipFile(target, "w") as new:
            manifest = json.loads(old.read(MANIFEST))
            data = old.read(changed).replace(b"1", b"2", 1)
            if careful:
                entry = next(e for e in manifest["files"] if e["path"] == changed)
                entry["sha256"] = hashlib.sha256(data).hexdigest()
            for info in old.infolist():
                if info.filename != MANIFEST:
                    new.writestr(info, data if info.filename == changed else old.read(info))
            new.writestr(MANIFEST, json.dumps(manifest))
        with pytest.raises(DatasetError, match="another data set than" if careful else "differs from the saved file"):
            restore(target, tmp_path / "R")
        assert not (tmp_path / "R").exists()
    with pytest.raises(DatasetError, match="differs from the saved file"):
        check_backup(tmp_path / "False.zip")


@pytest.mark.parametrize("method", [12, 14, 99])
def test_a_member_that_says_another_packing_is_damage(folder: Path, tmp_path: Path, method: int) -> None:
    """Each unpacker fails in its own way on bytes that are not its own."""
    backup(folder, tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        member = next(i for i in archive.infolist() if i.filename.endswith(".csv"))
        central = archive.start_dir
    data = bytearray((tmp_path / "a.zip").read_bytes())
    entry = data.index(member.filename.encode(), central) - 46
    for at in (member.header_offset + 8, entry + 10):
        assert data[at : at + 2] == member.compress_type.to_bytes(2, "little")
        data[at : at + 2] = method.to_bytes(2, "little")
    (tmp_path / "bad.zip").write_bytes(data)
    with pytest.raises(DatasetError, match="damaged"):
        restore(tmp_path / "bad.zip", tmp_path / "R")
    assert not (tmp_path / "R").exists()


KILLED = """
import os, sys
from plushsense.dataset.backup import backup, restore
what, one, other = sys.argv[1:]
(backup if what == "backup" else restore)(one, other, progress=lambda done, total: os._exit(9))
"""


@pytest.mark.parametrize("what", ["backup", "restore"])
def test_what_a_killed_run_left_goes_with_the_next(folder: Path, tmp_path: Path, what: str) -> None:
    place = tmp_path / "out"
    backup(folder, place / "a.zip")
    arguments = [str(folder), str(place / "b.zip")] if what == "backup" else [str(place / "a.zip"), str(place / "b")]
    assert subprocess.run([sys.executable, "-c", KILLED, what, *arguments]).returncode == 9
    (left,) = place.glob(".*")
    assert left.name.startswith(f".{Path(arguments[1]).name}-unfinished-")
    backup(folder, place / "c.zip")
    assert sorted(p.name for p in place.iterdir()) == ["a.zip", "c.zip"]


def test_a_backup_that_needs_more_room_than_there_is_is_not_restored(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    backup(folder, tmp_path / "a.zip")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(DatasetError, match="make room"):
        restore(tmp_path / "a.zip", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_who_is_removed_between_the_last_look_and_the_end_is_in_no_backup(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.fsync

    def slow(descriptor: int) -> None:
        real(descriptor)
        monkeypatch.undo()
        forget(folder, "ana")

    def last(done: int, total: int) -> None:
        if done == total:
            monkeypatch.setattr(os, "fsync", slow)

    with pytest.raises(ForgottenError):
        backup(folder, tmp_path / "b.zip", progress=last)
    assert not list(tmp_path.glob("*.zip"))


def test_who_is_removed_meanwhile_is_in_no_backup(folder: Path, tmp_path: Path) -> None:
    backup(folder, tmp_path / "a.zip")
    forgotten = list[str]()

    def meanwhile(done: int, total: int) -> None:
        if done == total and not forgotten:
            forgotten.append(forget(folder, "ana").subject)

    with pytest.raises(ForgottenError):
        backup(folder, tmp_path / "b.zip", progress=meanwhile)
    assert sorted(p.name for p in tmp_path.glob("*.zip")) == ["a.zip"]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
@pytest.mark.parametrize("name", [b"n\xfcte.txt", b"a:b.txt", b"a\\b.txt"])
def test_a_name_that_could_not_be_restored_is_refused_at_once(folder: Path, tmp_path: Path, name: bytes) -> None:
    (folder / os.fsdecode(name)).touch()
    with pytest.raises(DatasetError, match="rename it") as refused:
        backup(folder, tmp_path / "a.zip")
    str(refused.value).encode()
    assert not (tmp_path / "a.zip").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_a_recording_whose_name_is_no_text_is_named(folder: Path) -> None:
    place = folder / "recordings" / "ana"
    next(place.glob("*.csv")).rename(place / os.fsdecode(b"W\xfcve_1_50.csv"))
    (folder / "index.json").unlink()
    with pytest.raises(DatasetError, match="rename it"):
        open_dataset(folder)


def test_a_backup_larger_than_allowed_is_not_restored(folder: Path, tmp_path: Path) -> None:
    size = backup(folder, tmp_path / "a.zip").bytes
    for limits in (UnpackLimits(total_bytes=size - 1), UnpackLimits(files=3)):
        with pytest.raises(DatasetError, match="are allowed"):
            restore(tmp_path / "a.zip", tmp_path / "b", limits=limits)
    restore(tmp_path / "a.zip", tmp_path / "b", limits=UnpackLimits(total_bytes=size))


def test_a_negative_size_is_damage(folder: Path, tmp_path: Path) -> None:
    backup(folder, tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    manifest = json.loads(members[MANIFEST])
    manifest["files"][0]["bytes"] = -(1 << 40)
    members[MANIFEST] = json.dumps(manifest).encode()
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    with pytest.raises(DatasetError, match="less than 0 bytes"):
        restore(tmp_path / "b.zip", tmp_path / "b")
