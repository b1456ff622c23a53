import os
import zipfile
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.publishing.tables import open_package, read_checksums, write_checksums, write_zip


def package(folder: Path) -> Path:
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "b" / "ü.csv").write_text("1\n", encoding="utf-8")
    (folder / "z.txt").write_text("2\n")
    return folder


def test_the_zip_depends_on_nothing_but_the_files(tmp_path: Path) -> None:
    root = package(tmp_path / "P")
    write_zip(root, tmp_path / "1.zip")
    os.utime(root / "z.txt", (1, 1))
    (root / "z.txt").chmod(0o600)
    write_zip(root, tmp_path / "2.zip")
    assert (tmp_path / "1.zip").read_bytes() == (tmp_path / "2.zip").read_bytes()
    write_zip(root, tmp_path / "1.zip")
    with open_package(tmp_path / "1.zip") as folder:
        assert (folder / "a" / "b" / "ü.csv").read_text() == "1\n"
    assert not folder.exists()
    (root / "z.txt").write_text("3\n")
    with pytest.raises(DatasetError, match="already there"):
        write_zip(root, tmp_path / "1.zip")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1.zip", "2.zip", "P"]


def test_a_package_that_was_zipped_again_with_its_folder(tmp_path: Path) -> None:
    package(tmp_path / "out" / "P")
    write_zip(tmp_path / "out", tmp_path / "p.zip")
    with open_package(tmp_path / "p.zip") as folder:
        assert (folder.name, (folder / "z.txt").read_text()) == ("P", "2\n")


def test_checksums_as_sha256sum_reads_them(tmp_path: Path) -> None:
    root = package(tmp_path / "P")
    assert write_checksums(root) == 2
    assert set(read_checksums(root)) == {"a/b/ü.csv", "z.txt"}
    (root / "checksums.sha256").write_text("abc  z.txt\n")
    with pytest.raises(DatasetError, match="line 1 is no checksum"):
        read_checksums(root)


@pytest.mark.parametrize("name", ["../out.txt", "/etc/out.txt", "n/../../out.txt", "C:/out.txt", "n\\..\\..\\out.txt"])
def test_an_entry_that_would_leave_is_refused(tmp_path: Path, name: str) -> None:
    bad = tmp_path / "bad.zip"
    with zipfile.ZipFile(bad, "w") as archive:
        archive.writestr(zipfile.ZipInfo(name), "x")
    with pytest.raises(DatasetError, match="is refused"), open_package(bad):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["bad.zip"]


def test_a_link_and_a_damaged_zip_are_refused(tmp_path: Path) -> None:
    link = zipfile.ZipInfo("n/link")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "link.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(DatasetError, match="is refused"), open_package(tmp_path / "link.zip"):
        pass
    write_zip(package(tmp_path / "P"), tmp_path / "p.zip")
    data = bytearray((tmp_path / "p.zip").read_bytes())
    at = data.find(b"csv") + 5
    data[at] ^= 0xFF
    (tmp_path / "broken.zip").write_bytes(bytes(data))
    with pytest.raises(DatasetError, match="it is damaged"), open_package(tmp_path / "broken.zip"):
        pass


def test_an_entry_that_hides_another_or_swells_is_refused(tmp_path: Path) -> None:
    write_zip(package(tmp_path / "P"), tmp_path / "p.zip")
    with zipfile.ZipFile(tmp_path / "p.zip", "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("z.txt", "another")
    with (
        pytest.raises(DatasetError, match="another member has the same name"),
        open_package(tmp_path / "p.zip"),
    ):
        pass
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("n/z.txt", bytes(20_000_000))
    with pytest.raises(DatasetError, match="would swell"), open_package(tmp_path / "bomb.zip"):
        pass
