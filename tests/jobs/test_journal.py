"""The journal: results come back as they were, and a damaged file is a job not done."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import PlushSenseError
from plushsense.jobs import journal as room
from plushsense.jobs.journal import Journal, job_id

RESULT = {"probabilities": np.arange(600, dtype=np.float32).reshape(100, 6), "history": [{"epoch": 1}], "s": 0.5}


def test_an_id_depends_on_content_not_on_order() -> None:
    one = job_id({"arch": "14d1", "seed": 1, "nested": {"a": 1, "b": [1, 2]}})
    assert one == job_id({"nested": {"b": [1, 2], "a": 1}, "seed": 1, "arch": "14d1"})
    assert one != job_id({"arch": "14d1", "seed": 2, "nested": {"a": 1, "b": [1, 2]}})
    assert len(one) == 20


def test_a_result_comes_back_as_it_was(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "not" / "there")
    assert not journal.has("a")
    with pytest.raises(KeyError):
        journal.load("a")
    journal.save("a", RESULT)
    found = journal.load("a")
    assert journal.has("a") and found.keys() == RESULT.keys()
    assert np.array_equal(found["probabilities"], RESULT["probabilities"])
    assert found["probabilities"].dtype == np.float32
    assert found["history"] == RESULT["history"] and found["s"] == 0.5
    assert [p.name for p in journal.folder.iterdir()] == ["a.npz"]


def test_a_damaged_file_is_a_job_not_done(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.save("a", RESULT)
    whole = journal.path("a").read_bytes()
    rng = np.random.default_rng(0)
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        journal.path("a").write_bytes(whole[:cut])
        assert not journal.has("a")
    for _ in range(300):
        at = int(rng.integers(len(whole)))
        journal.path("a").write_bytes(whole[:at] + bytes([whole[at] ^ (1 << int(rng.integers(8)))]) + whole[at + 1 :])
        found = journal.find("a")
        # A bit of the archive's own book-keeping may not matter; a changed result is never returned.
        if found is not None:
            assert np.array_equal(found["probabilities"], RESULT["probabilities"])
            assert found["history"] == RESULT["history"]
    journal.save("a", RESULT)
    assert journal.has("a")


def test_a_result_that_cannot_be_kept_leaves_nothing(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    with pytest.raises(TypeError):
        journal.save("a", {"what": object()})
    with pytest.raises(ValueError, match="pickle"):
        journal.save("a", {"what": np.array([object()])})
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_may_be_written_nothing_is(tmp_path: Path) -> None:
    allowed = [True, True]

    @contextmanager
    def writing() -> Iterator[None]:
        if not allowed:
            raise PlushSenseError("not any more")
        allowed.pop()
        yield

    journal = Journal(tmp_path / "j", writing)
    claim = journal.claim("a")
    assert claim is not None
    journal.save("a", RESULT)
    claim.release()
    with pytest.raises(PlushSenseError, match="not any more"):
        journal.claim("b")
    with pytest.raises(PlushSenseError, match="not any more"):
        journal.save("b", RESULT)
    assert [p.name for p in journal.folder.iterdir()] == ["a.npz"]


@pytest.mark.parametrize(("code", "refused"), [(errno.EROFS, False), (errno.EACCES, False), (errno.ENOSPC, True)])
def test_a_read_only_disk_stores_nothing_and_a_full_one_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, refused: bool
) -> None:
    @contextmanager
    def fails(path: Path) -> Iterator[Path]:
        raise OSError(code, "no")
        yield path

    monkeypatch.setattr(room, "replacing_file", fails)
    journal = Journal(tmp_path)
    if refused:
        with pytest.raises(PlushSenseError, match="cannot be kept"):
            journal.save("a", RESULT)
    else:
        journal.save("a", RESULT)
    assert not journal.has("a")
