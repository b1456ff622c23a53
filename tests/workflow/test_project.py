"""A project: everything of a home in one file, opened in another where nothing is replaced."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.importing.archives import UnpackLimits
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.removed import remember_removed
from plushsense.workflow.api import simulate
from plushsense.workflow.project import MANIFEST, is_project, open_project, project_people, save_project
from support.bundles import odd_bundle


def test_a_project_holds_data_and_networks_and_replaces_nothing(tmp_path: Path) -> None:
    home, other = tmp_path / "home", tmp_path / "other"
    dataset = home / "datasets" / "virtual"
    simulate(tmp_path / "made", people=1, repetitions=1, dataset=dataset)
    network = odd_bundle(tmp_path / "net.plush")
    saved = tmp_path / "project.zip"
    result = save_project(saved, [dataset], [network])
    assert (result.datasets, result.networks) == (("virtual",), ("net",))
    with pytest.raises(DatasetError, match="exists already"):
        save_project(saved, [dataset], [])
    with pytest.raises(DatasetError, match="no data set and no network"):
        save_project(tmp_path / "empty.zip", [], [])
    assert is_project(saved) and not is_project(network)
    assert project_people(saved) == ["P01", "none"] and project_people(network) == []

    # Twice: data sets get a number, the same network is not doubled.
    for names in (("virtual",), ("virtual 2",)):
        opened = open_project(saved, other)
        assert (opened.datasets, opened.networks, opened.refused) == (names, ("net",), ())
    assert (other / "bundles" / "net.plush").read_bytes() == network.read_bytes()
    there = [open_dataset(other / "datasets" / name) for name in ("virtual", "virtual 2")]
    assert {d.hash for d in there} == {open_dataset(dataset).hash}
    assert len({d.head.name for d in there}) == 2
    assert sorted(p.name for p in other.iterdir()) == ["bundles", "datasets"]
    # A person who was removed there does not come back by it.
    remember_removed(other, "P01")
    assert [name for name, _ in open_project(saved, other).refused] == ["virtual.zip"]
    assert open_project(saved, other, readmit=True).datasets == ("virtual 3",)


def test_a_hostile_project_is_refused_part_by_part(tmp_path: Path) -> None:
    hostile = tmp_path / "hostile.zip"
    with zipfile.ZipFile(hostile, "w") as archive:
        archive.writestr(MANIFEST, "{}")
        archive.writestr("../out.plush", b"x")
        archive.writestr("bundles/bad.plush", b"no network")
        archive.writestr("datasets/bad.zip", b"no backup")
        archive.writestr("datasets/deep/er.zip", b"ignored")
    opened = open_project(hostile, tmp_path / "home")
    assert (opened.datasets, opened.networks) == ((), ())
    assert {name for name, _ in opened.refused} == {"../out.plush", "bad.plush", "bad.zip"}
    assert not (tmp_path / "out.plush").exists() and [p.name for p in (tmp_path / "home").rglob("*")] == []
    with pytest.raises(DatasetError, match="2 files"):
        open_project(hostile, tmp_path / "home", limits=UnpackLimits(files=2))
    hostile.write_bytes(b"PK")
    with pytest.raises(DatasetError, match="no project"):
        open_project(hostile, tmp_path / "home")
