from __future__ import annotations

import os
import shutil
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.files import (
    PART,
    check_output_file,
    new_folder,
    read_bytes,
    replacing_file,
    temporary_folder,
    work_folder,
    write_file,
)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_a_part_file_that_was_created_again_is_not_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two programs delete an abandoned part at once; its writer creates it again between the two."""
    import fcntl

    part, lock = tmp_path / f".index.csv.12ab34cd{PART}", fcntl.flock

    def lock_later(descriptor: int, how: int) -> None:
        monkeypatch.undo()
        part.unlink()
        part.write_text("new")
        lock(descriptor, how)

    part.write_text("abandoned")
    monkeypatch.setattr(fcntl, "flock", lock_later)
    write_file(tmp_path / "index.csv", "text")
    assert part.read_text() == "new"


@pytest.mark.skipif(sys.platform == "win32", reason="Windows refuses to replace a file that is being replaced")
def test_threads_that_write_one_file_at_once_leave_one_of_their_texts(tmp_path: Path) -> None:
    path = tmp_path / "index.csv"
    texts = [letter * 100_000 for letter in "abcd"]
    failed: list[OSError] = []

    def write(text: str) -> None:
        try:
            for _ in range(30):
                write_file(path, text)
        except OSError as cause:
            failed.append(cause)

    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    assert path.read_text(encoding="utf-8") in texts
    assert [p.name for p in tmp_path.iterdir()] == ["index.csv"]


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("content", ["ä\n", b"\x00\r\n"])
def test_a_file_is_replaced_byte_for_byte(tmp_path: Path, content: str | bytes) -> None:
    path = tmp_path / "a.txt"
    for _ in range(2):
        write_file(path, content)
        assert path.read_bytes() == (content if isinstance(content, bytes) else content.encode())
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("failure", [OSError, KeyboardInterrupt])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path, failure: type[BaseException]) -> None:
    path = tmp_path / "a.txt"
    write_file(path, "old")
    with pytest.raises(failure), replacing_file(path) as part:
        part.write_text("new")
        assert names(tmp_path) == [part.name, "a.txt"] and part.name.endswith(PART)
        raise failure
    assert (path.read_text(), names(tmp_path)) == ("old", ["a.txt"])


@pytest.mark.skipif(sys.platform == "win32", reason="part files are not locked there")
def test_the_next_writer_deletes_what_a_killed_one_left_and_nothing_of_a_live_one(tmp_path: Path) -> None:
    path = tmp_path / "a[1].txt"
    for left in (".a[1].txt.0123abcd.part", ".b.txt.0123abcd.part"):
        (tmp_path / left).write_text("of a killed program")
    with replacing_file(path) as mine:
        mine.write_text("mine")
        write_file(path, "another's")
        assert names(tmp_path) == sorted([mine.name, ".b.txt.0123abcd.part", path.name])
    assert path.read_text() == "mine"
    assert names(tmp_path) == [".b.txt.0123abcd.part", path.name]


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX")
def test_modes_follow_the_umask_and_private_files_are_the_owners(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    write_file(tmp_path / "usual", "")
    write_file(tmp_path / "secret", "", private=True)
    modes = {name: (tmp_path / name).stat().st_mode & 0o777 for name in names(tmp_path)}
    assert modes["usual"] == modes["plain"]
    assert modes["secret"] == 0o600


@pytest.mark.parametrize("failure", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_a_failed_folder_does_not_appear(tmp_path: Path, failure: BaseException) -> None:
    expected = DatasetError if isinstance(failure, OSError) else KeyboardInterrupt
    with pytest.raises(expected), new_folder(tmp_path / "out", DatasetError) as work:
        (work / "file").write_text("x")
        raise failure
    assert names(tmp_path) == []


def test_only_files_of_ones_own_kind_are_replaced(tmp_path: Path) -> None:
    def refused(path: Path) -> str:
        with pytest.raises(DatasetError) as said:
            check_output_file(path, "mark", "a letter", DatasetError)
        return str(said.value)

    for name, content in (("new", None), ("empty", ""), ("mine", "a mark of mine")):
        if content is not None:
            (tmp_path / name).write_text(content)
        check_output_file(tmp_path / name, "mark", "a letter", DatasetError)
    (tmp_path / "other").write_text("x" * 5000 + "mark")
    assert "is not a letter" in refused(tmp_path / "other")
    with pytest.raises(DatasetError, match="is not a letter"):
        check_output_file(tmp_path / "other", "mark", "a letter", DatasetError, append=True)
    assert "is a folder" in refused(Path("/"))
    assert "is a folder" in refused(tmp_path)
    assert "is no folder in which you may write" in refused(tmp_path / "other" / "new")


@pytest.mark.skipif(sys.platform == "win32", reason="needs pipes and links")
def test_nothing_is_read_from_a_pipe_or_a_device(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        with pytest.raises(OSError, match="no regular file"):
            read_bytes(tmp_path / name, 100)
        with pytest.raises(DatasetError, match="no regular file"):
            check_output_file(tmp_path / name, "mark", "a letter", DatasetError)
        check_output_file(tmp_path / name, "mark", "a letter", DatasetError, append=True)


def test_a_folder_is_filled_where_it_is_empty_and_refused_where_it_is_not(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with new_folder(tmp_path / "out", DatasetError, last="a") as work:
        (work / "a").write_text("x")
        (work / "b").write_text("y")
    assert names(tmp_path / "out") == ["a", "b"]
    with pytest.raises(DatasetError, match="already holds something"), new_folder(tmp_path / "out", DatasetError):
        pass
    assert names(tmp_path) == ["out"]


def test_what_a_killed_program_left_goes_at_the_next_start_and_nothing_of_a_live_one(tmp_path: Path) -> None:
    with work_folder(tmp_path / "other") as live:
        (live / "raw.csv").write_text("x")
        # A copy of the folder has a lock that nobody holds, as after a kill.
        shutil.copytree(live, tmp_path / ".other-unfinished-killed")
        (tmp_path / ".old-unfinished-1").mkdir()
        with new_folder(tmp_path / "out", DatasetError) as work:
            assert work.parent.parent == tmp_path
        assert names(tmp_path) == sorted([live.name, ".old-unfinished-1", "out"])
        assert names(live) == ["owner.lock", "raw.csv"]
    assert names(tmp_path) == [".old-unfinished-1", "out"]


def test_a_work_folder_with_nothing_in_it_goes_after_an_hour(tmp_path: Path) -> None:
    for left in ("new", "old", "new-locked", "old-locked"):
        (tmp_path / f".out-unfinished-{left}").mkdir()
        if left.endswith("locked"):
            (tmp_path / f".out-unfinished-{left}" / "owner.lock").touch()
        if left.startswith("old"):
            os.utime(tmp_path / f".out-unfinished-{left}", (0, 0))
    with work_folder(tmp_path / "out") as work:
        assert names(tmp_path) == sorted([work.name, ".out-unfinished-new", ".out-unfinished-new-locked"])


def test_temporary_copies_of_a_killed_program_go_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with temporary_folder() as one:
        (one / "raw.csv").write_text("x")
        shutil.copytree(one, tmp_path / ".plushsense-unfinished-killed")
        with temporary_folder() as other:
            assert names(tmp_path) == sorted([one.name, other.name])
    assert names(tmp_path) == []


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX")
def test_a_folder_of_another_user_is_no_obstacle() -> None:
    user = os.geteuid()
    with tempfile.TemporaryDirectory() as shared:
        place = Path(shared)
        theirs = place / ".plushsense-unfinished-theirs"
        theirs.mkdir()
        (theirs / "owner.lock").touch()
        theirs.chmod(0)
        place.chmod(0o777)
        if user == 0:  # who may read everything
            os.seteuid(65534)
        try:
            with work_folder(place / "plushsense") as mine:
                assert mine.parent == place.resolve()
        finally:
            os.seteuid(user)
            theirs.chmod(0o700)
        assert names(place) == [theirs.name]
