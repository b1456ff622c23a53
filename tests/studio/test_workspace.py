"""Pages stay inside the folders they were given, whatever a browser sends."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import threading
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.gestures import load_gestures
from plushsense.core.layouts import load_layout
from plushsense.dataset.store import DatasetHead
from plushsense.studio.app.workspace import BUNDLES, DATASETS, EXPORTS, ChangeSignal, Workspace
from support.browsing import alone

ODD = [
    "../secret",
    "datasets/../../secret",
    "/etc/passwd",
    "..",
    "datasets/../..",
    "a\0b",
    "/",
    "~root/../../etc",
    "\ud800",
    "x/" * 2000 + "../" * 2001 + "etc",
]


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    (tmp_path / "secret").write_text("s")
    (tmp_path / "home" / DATASETS).mkdir(parents=True)
    return Workspace(tmp_path / "home")


@pytest.mark.parametrize("path", ODD, ids=lambda p: ascii(p)[:30])
def test_what_lies_outside_is_refused(workspace: Workspace, path: str) -> None:
    with pytest.raises(ConfigError, match="not in the studio's folder"):
        workspace.inside(path)


@pytest.mark.parametrize("path", ["C:\\Windows\\win.ini", "\\\\server\\share", "C:/x", "..\\..\\secret", "D:x"])
def test_windows_paths_lead_nowhere(workspace: Workspace, path: str) -> None:
    if sys.platform == "win32":
        with pytest.raises(ConfigError, match="not in the studio's folder"):
            workspace.inside(path)
    else:
        # Here these are names like any other, of things inside.
        assert workspace.folder in workspace.inside(path).parents


def test_links_that_lead_out_are_refused(workspace: Workspace) -> None:
    try:
        (workspace.folder / "way").symlink_to(workspace.folder.parent)
        (workspace.folder / "round").symlink_to(workspace.folder / "round")
    except OSError:
        pytest.skip("no links here")
    with pytest.raises(ConfigError, match="not in the studio's folder"):
        workspace.inside("way/secret")
    with pytest.raises(ConfigError, match="not in the studio's folder"):
        workspace.inside(workspace.folder / "way")
    with_link = workspace.folder / DATASETS / "linked"
    with_link.symlink_to(workspace.folder.parent)
    with pytest.raises(ConfigError):
        workspace.new(DATASETS, "linked")


def test_what_lies_inside_or_was_given_passes(workspace: Workspace, tmp_path: Path) -> None:
    other, bundle = tmp_path / "other", tmp_path / "m.plush"
    other.mkdir()
    bundle.write_bytes(b"x")
    mine = Workspace(workspace.folder, given=(other,), models=(bundle,))
    assert mine.inside("datasets/a") == mine.folder / DATASETS / "a"
    assert mine.inside(str(mine.folder)) == mine.folder
    assert mine.inside(other / "recordings" / "x.csv") == other / "recordings" / "x.csv"
    assert mine.inside(bundle) == bundle
    for path in (tmp_path / "n.plush", tmp_path / "others", f"{bundle}/x"):
        with pytest.raises(ConfigError):
            mine.inside(path)


@pytest.mark.parametrize(
    "name",
    ["", "  ", ".", "..", ".hidden", "a/b", "a\\b", "a\0", "x" * 65, "con", "NUL.txt", "C:", "a:b", "dot.", "<b>"],
    ids=lambda n: ascii(n)[:12],
)
def test_names_that_no_file_can_have_everywhere(workspace: Workspace, name: str) -> None:
    reserved = name in ("con", "NUL.txt")
    with pytest.raises(ConfigError, match="is reserved by Windows" if reserved else "cannot be a name"):
        workspace.new(DATASETS, name)


def test_a_new_name_makes_nothing_and_replaces_nothing(workspace: Workspace) -> None:
    place = workspace.new(DATASETS, "  Ķepas 2026.1-a ")
    assert place == workspace.folder / DATASETS / "Ķepas 2026.1-a"
    assert not place.exists()
    place.mkdir()
    with pytest.raises(ConfigError, match="exists already"):
        workspace.new(DATASETS, "Ķepas 2026.1-a")
    assert workspace.new(EXPORTS, "Ķepas 2026.1-a").parent.name == EXPORTS


def test_data_sets_and_bundles_are_found_once(furniture: Path, tmp_path: Path) -> None:
    home = Path(shutil.copytree(furniture, tmp_path / "home"))
    one = home / DATASETS / "virtual"
    bundle = home / BUNDLES / "little.plush"
    workspace = Workspace(home, given=(one,), models=(bundle,))
    assert workspace.datasets() == [one.resolve()]
    assert workspace.bundles() == [bundle.resolve()]
    shutil.copy(bundle, one / "newer.plush")
    os.utime(one / "newer.plush", (2e9, 2e9))
    assert [p.name for p in workspace.bundles()] == ["newer.plush", "little.plush"]
    assert workspace.title(one) == "virtual toy"
    (one / "dataset.toml").write_text("not = [toml")
    assert workspace.title(one) == "virtual"


def test_a_bundle_that_is_a_link_to_nowhere_is_not_listed(workspace: Workspace) -> None:
    (workspace.folder / BUNDLES).mkdir()
    try:
        (workspace.folder / BUNDLES / "gone.plush").symlink_to(workspace.folder / "nothing")
    except OSError:
        pytest.skip("no links here")
    assert workspace.bundles() == []


def test_parts_are_made_once_and_closed_in_turn(workspace: Workspace) -> None:
    closed: list[str] = []

    class First:
        def __init__(self, workspace: Workspace) -> None:
            self.workspace = workspace

        def close(self) -> None:
            closed.append("first")

    class Second(First):
        def close(self) -> None:
            closed.append("second")

    first = workspace.part(First)
    made = []
    threads = [threading.Thread(target=lambda: made.append(workspace.part(First))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(one is first for one in made)
    workspace.part(Second)
    workspace.close()
    assert closed == ["second", "first"]
    assert workspace.part(First) is not first


def made_dataset(workspace: Workspace, name: str, layout: str = "accel-3", simulated: bool = False) -> Path:
    """A data set without recordings."""
    path = workspace.folder / "datasets" / name
    path.mkdir(parents=True)
    head = DatasetHead(name, load_layout(layout), load_gestures("plush-18"), simulated=simulated)
    (path / "dataset.toml").write_text(head.to_toml(), encoding="utf-8")
    (path / "recordings.csv").write_text("", encoding="utf-8")
    return path


def test_what_is_discarded_can_be_restored_or_deleted(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    first = made_dataset(workspace, "spring")
    discarded = workspace.discard(first)
    assert not first.exists() and workspace.discarded() == [discarded] and workspace.datasets() == []
    # Another one of this name: neither replaces the other.
    again = workspace.discard(made_dataset(workspace, "spring", simulated=True))
    assert sorted(workspace.discarded()) == sorted([discarded, again])
    assert workspace.restore(again) == first and DatasetHead.read(first).simulated
    with pytest.raises(ConfigError, match="There is another"):
        workspace.restore(discarded)
    with pytest.raises(ConfigError, match="is not among the discarded"):
        workspace.delete(first)
    with pytest.raises(ConfigError, match="is not among the discarded"):
        workspace.restore(tmp_path / "discarded" / "datasets" / ".." / ".." / "datasets" / "spring")
    workspace.delete(discarded)
    assert workspace.discarded() == []
    given = Workspace(tmp_path / "other", given=(first,))
    with pytest.raises(ConfigError, match="is not in the studio's folder"):
        given.discard(first)


def test_a_data_set_changes_its_name_and_keeps_its_folder(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    path, other = made_dataset(workspace, "spring"), made_dataset(workspace, "autumn")
    assert workspace.rename(path, "Spring 2026") == path
    assert workspace.title(path) == "Spring 2026"
    with pytest.raises(ConfigError, match="“autumn” exists already"):
        workspace.rename(path, "autumn")
    for name in ("", "a/b", "..", "x" * 65):
        with pytest.raises(ConfigError, match="cannot be a name"):
            workspace.rename(other, name)


def test_recordings_fit_into_data_sets_of_their_layout(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    assert workspace.fitting("accel-3", False) == []
    made = [made_dataset(workspace, name) for name in ("new", "old")]
    virtual = made_dataset(workspace, "simulated", simulated=True)
    assert workspace.fitting("accel-3", False) == made and workspace.fitting("accel-3", True) == [virtual]
    assert workspace.fitting("plush-15", False) == []


def test_many_rings_are_heard_as_one_and_none_after_the_end() -> None:
    async def listen() -> tuple[int, int]:
        signal, calls = ChangeSignal(), []
        end = signal.subscribe(lambda: calls.append(1))
        thread = threading.Thread(target=lambda: [signal.notify() for _ in range(1000)])
        thread.start()
        thread.join()
        await asyncio.sleep(0.05)
        first = len(calls)
        signal.notify()
        end()
        await asyncio.sleep(0.05)
        end()
        signal.notify()
        return first, len(calls)

    assert alone(listen()) == (1, 1)


def test_a_ring_after_the_loop_closed_is_harmless() -> None:
    signal = ChangeSignal()

    async def listen() -> None:
        signal.subscribe(lambda: None)

    alone(listen())
    signal.notify()
    signal.notify()
