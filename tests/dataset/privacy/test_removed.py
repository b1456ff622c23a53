"""A person who was removed from a home comes back by no way, unless that is asked for."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.backup import backup, backup_people, restore
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.privacy.removed import CONSENT, REMOVED, RemovedCodes, may_be_suggested


@pytest.fixture
def home(recordings: Path, tmp_path: Path) -> Path:
    """A home with a data set and its backup, from which P2 was removed."""
    dataset = tmp_path / "home" / "datasets" / "DS"
    import_recordings(recordings, dataset, layout="accel-3")
    backup(dataset, tmp_path / "home" / "backups" / "b.zip")
    forget(dataset, "P2")
    return tmp_path / "home"


def test_a_removed_person_is_remembered_by_a_salted_hash(home: Path, tmp_path: Path) -> None:
    stored = json.loads((home / REMOVED).read_text())
    assert len(stored["hashes"]) == 1 and "P2" not in (home / REMOVED).read_text()
    removed = RemovedCodes.read(home)
    assert [code in removed for code in ("P2", "p2", "P-2", "P1", "P22")] == [True, True, True, False, False]
    # Another home has another salt.
    assert RemovedCodes().salt != RemovedCodes().salt and "P2" not in RemovedCodes.read(tmp_path)
    (home / REMOVED).write_text("{}")
    assert not may_be_suggested(home, "P1")
    with pytest.raises(DatasetError, match="remembers who was removed"):
        RemovedCodes.read(home)


def test_nothing_of_them_is_taken_in_unasked(
    home: Path, recordings: Path, tmp_path: Path, cli: Callable[..., Any]
) -> None:
    dataset, packed = home / "datasets" / "DS", home / "backups" / "b.zip"
    shutil.copytree(recordings / "P2", tmp_path / "again" / "P2")
    assert backup_people(packed) == ["P1", "P2", "P3", "P4", "P5"]
    ways: list[Callable[..., Any]] = [
        lambda **more: import_recordings(tmp_path / "again", dataset, add_to=True, **more),
        lambda **more: import_recordings(recordings, home / "datasets" / "new", layout="accel-3", **more),
        lambda **more: restore(packed, home / "work" / "restored", **more),
    ]
    for way in ways:
        with pytest.raises(DatasetError, match="P2 was removed from") as refused:
            way()
        assert refused.value.message.values["needs"] == CONSENT
    assert "P2" not in open_dataset(dataset).subjects and not (home / "datasets" / "new").exists()
    assert cli("import", tmp_path / "again", dataset, "--add").status == 2
    # Elsewhere and for others nothing is asked.
    assert "P2" in restore(packed, tmp_path / "elsewhere").subjects
    shutil.copytree(recordings / "P1", tmp_path / "others" / "P1")
    assert import_recordings(tmp_path / "others", dataset, add_to=True).already_there
    for way in ways:
        way(readmit=True)
    assert "P2" in open_dataset(dataset).subjects
