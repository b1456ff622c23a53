"""Zips that somebody sent: unpacked as far as they are safe, and never a byte outside the target."""

from __future__ import annotations

import re
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, write_recording
from plushsense.dataset.importing.archives import UnpackLimits, unpack
from plushsense.dataset.importing.importers import import_recordings

ACCEL = load_layout("accel-3")
Writer = Callable[..., Path]


def recording(tmp_path: Path, seed: int = 0, rows: int = 60) -> bytes:
    clock = np.arange(rows, dtype=np.int64) * 10 + seed * 100_000
    path = tmp_path / f"scratch{seed}_1_{rows}.csv"
    write_recording(path, Frames(np.full((rows, 3), seed), clock, clock + 10**12), ACCEL)
    data = path.read_bytes()
    path.unlink()
    return data


def test_a_zip_of_sessions_or_of_people_imports_like_its_folder(tmp_path: Path, session_writer: Writer) -> None:
    session_writer(tmp_path / "out", "P01", redo=[1])
    session_writer(tmp_path / "out", "P02", seed=1)
    for inside in ("", "study 1/"):
        path = tmp_path / f"upload{len(inside)}.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in (tmp_path / "out").rglob("*"):
                archive.write(file, inside + file.relative_to(tmp_path / "out").as_posix())
        done = import_recordings(path, tmp_path / f"DS{len(inside)}")
        assert (done.recordings, done.subjects, done.streams, done.excluded) == (4, 2, 2, 1)
        assert done.rejected == ()
        assert done.dataset.head.name == path.stem
    assert sorted(p.name for p in tmp_path.iterdir()) == ["DS0", "DS8", "out", "upload0.zip", "upload8.zip"]


def test_recordings_at_the_top_are_of_the_person_that_the_zip_names(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "P05.zip", "w") as archive:
        archive.writestr("Shake_1_60.csv", recording(tmp_path))
    assert import_recordings(tmp_path / "P05.zip", tmp_path / "DS", layout="accel-3").dataset.subjects == ["P05"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../../evil_1_60.csv", r"'\.\.'"),
        ("ana/../../../evil_1_60.csv", r"'\.\.'"),
        ("..\\..\\evil_1_60.csv", r"'\.\.'"),
        ("/tmp/evil_1_60.csv", "absolute"),
        ("C:/evil_1_60.csv", "absolute"),
        ("C:evil_1_60.csv", "absolute"),
        ("\\\\server\\share\\evil_1_60.csv", "absolute"),
        ("ana/CON/evil_1_60.csv", "device"),
        ("ana/aux.csv", "device"),
        ("ana/com1 .txt", "device"),
        ("ana/evil_1_60.csv.", "every file system"),
        ("ana/e:vil_1_60.csv", "every file system"),
        ("ana/e\nvil_1_60.csv", "every file system"),
        ("x/" * 40 + "evil_1_60.csv", "too deep"),
        ("ana/" + "e" * 300 + "_1_60.csv", "every file system"),
        ("ana/shake_1_60.CSV", "but for case"),
        ("ana/Shake_1_60.csv/inner_1_60.csv", "another member stands"),
        ("__MACOSX/ana/._Shake_1_60.csv", "macOS"),
    ],
)
@pytest.mark.slow
def test_a_member_that_must_not_be_written_is_refused(tmp_path: Path, name: str, said: str) -> None:
    (tmp_path / "in").mkdir()
    with zipfile.ZipFile(tmp_path / "in" / "x.zip", "w") as archive:
        archive.writestr("ana/Shake_1_60.csv", recording(tmp_path))
        archive.writestr(name, recording(tmp_path, 1))
    done = import_recordings(tmp_path / "in" / "x.zip", tmp_path / "in" / "DS", layout="accel-3")
    assert done.recordings == 1
    (refused,) = done.rejected
    assert re.search(said, refused.reason), refused
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
    assert sorted(p.name for p in (tmp_path / "in").iterdir()) == ["DS", "x.zip"]
    assert not Path("/tmp/evil_1_60.csv").exists()


def special(kind: int, content: str, mode: int = 0o777) -> tuple[zipfile.ZipInfo, str]:
    info = zipfile.ZipInfo("ana/odd_1_60.csv")
    info.external_attr = (kind | mode) << 16
    return info, content


@pytest.mark.parametrize(
    ("kind", "said"),
    [(stat.S_IFLNK, "symbolic link"), (stat.S_IFIFO, "not a regular"), (stat.S_IFCHR, "not a regular")],
)
def test_links_and_devices_are_refused(tmp_path: Path, kind: int, said: str) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as archive:
        archive.writestr(*special(kind, "/etc/passwd"))
    (tmp_path / "to").mkdir()
    ((name, reason),) = unpack(tmp_path / "x.zip", tmp_path / "to")
    assert name == "ana/odd_1_60.csv"
    assert said in reason
    assert list((tmp_path / "to").iterdir()) == []


def test_bombs_are_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ana/zeros_1_60.csv", b"0" * 20_000_000)
        archive.writestr("ana/Shake_1_60.csv", recording(tmp_path))
    (tmp_path / "to").mkdir()
    ((name, reason),) = unpack(tmp_path / "x.zip", tmp_path / "to")
    assert name == "ana/zeros_1_60.csv"
    assert "would swell" in reason
    for limits in (UnpackLimits(total_bytes=10_000_000), UnpackLimits(files=1)):
        with pytest.raises(DatasetError, match="are allowed"):
            unpack(tmp_path / "x.zip", tmp_path / "to", limits)
    with pytest.raises(ConfigError, match="above 0"):
        UnpackLimits(ratio=0)


def test_a_member_that_lies_about_its_size_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ana/zeros_1_60.csv", b"0" * 3_000_000)
    data = path.read_bytes()
    lie = data.replace((3_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    assert lie != data
    path.write_bytes(lie)
    (tmp_path / "to").mkdir()
    ((_, reason),) = unpack(path, tmp_path / "to")
    assert "damaged" in reason
    assert not [p for p in (tmp_path / "to").rglob("*") if p.is_file()]


def test_encrypted_damaged_and_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("ana/Shake_1_60.csv", recording(tmp_path))
        archive.writestr("ana/Wave_1_60.csv", recording(tmp_path, 1))
    data = bytearray(path.read_bytes())
    whole = bytes(data)
    at = data.index(b"PK\x01\x02")
    data[at + 8] |= 1
    path.write_bytes(data)
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert "encrypted" in done.rejected[0].reason
    data = bytearray(whole)
    data[whole.index(b"Processing") + 3] ^= 1
    path.write_bytes(data)
    done = import_recordings(path, tmp_path / "DS2", layout="accel-3")
    assert "CRC" in done.rejected[0].reason
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetError, match="no zip, or a damaged one"):
        import_recordings(path, tmp_path / "DS3", layout="accel-3")


def test_what_is_no_archive_of_recordings(tmp_path: Path, session_writer: Writer) -> None:
    (tmp_path / "x.rar").write_bytes(b"Rar!")
    with pytest.raises(DatasetError, match=r"ends in \.zip, \.xdf, \.xdfz, \.xdf\.gz, \.parquet"):
        import_recordings(tmp_path / "x.rar", tmp_path / "DS", layout="accel-3")
    session_writer(tmp_path / "out")
    import_recordings(tmp_path / "out", tmp_path / "DS")
    with zipfile.ZipFile(tmp_path / "ds.zip", "w") as archive:
        archive.write(tmp_path / "DS" / "dataset.toml", "DS/dataset.toml")
    with pytest.raises(DatasetError, match="holds a data set: unpack it"):
        import_recordings(tmp_path / "ds.zip", tmp_path / "DS2")


def test_bytes_that_no_unpacker_knows_are_one_damaged_member(tmp_path: Path) -> None:
    """bzip2 raises an OSError of its own, which is no fault of the disk."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("bad.csv", b"1,2\n" * 100)
        archive.writestr("good.csv", b"3,4\n")
        at = archive.infolist()[0].header_offset + 30 + len("bad.csv")
    data = bytearray((tmp_path / "a.zip").read_bytes())
    data[at : at + 4] = b"none"
    (tmp_path / "a.zip").write_bytes(data)
    (tmp_path / "out").mkdir()
    refused = unpack(tmp_path / "a.zip", tmp_path / "out")
    assert [name for name, _ in refused] == ["bad.csv"]
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["good.csv"]
