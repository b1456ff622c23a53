"""Pages stay inside the folders they were given, whatever a browser sends."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import threading
from pathlib import Path

import pytest

from plushsense.apps.studio.house import BUNDLES, DATASETS, EXPORTS, Bell, House
from plushsense.core.errors import ConfigError

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
def house(tmp_path: Path) -> House:
    (tmp_path / "secret").write_text("s")
    (tmp_path / "home" / DATASETS).mkdir(parents=True)
    return House(tmp_path / "home")


@pytest.mark.parametrize("path", ODD, ids=lambda p: ascii(p)[:30])
def test_what_lies_outside_is_refused(house: House, path: str) -> None:
    with pytest.raises(ConfigError, match="outside"):
        house.inside(path)


@pytest.mark.parametrize("path", ["C:\\Windows\\win.ini", "\\\\server\\share", "C:/x", "..\\..\\secret", "D:x"])
def test_windows_paths_lead_nowhere(house: House, path: str) -> None:
    if sys.platform == "win32":
        with pytest.raises(ConfigError, match="outside"):
            house.inside(path)
    else:
        # Here these are names like any other, of things inside.
        assert house.folder in house.inside(path).parents


def test_links_that_lead_out_are_refused(house: House) -> None:
    try:
        (house.folder / "way").symlink_to(house.folder.parent)
        (house.folder / "round").symlink_to(house.folder / "round")
    except OSError:
        pytest.skip("no links here")
    with pytest.raises(ConfigError, match="outside"):
        house.inside("way/secret")
    with pytest.raises(ConfigError, match="outside"):
        house.inside(house.folder / "way")
    with_link = house.folder / DATASETS / "linked"
    with_link.symlink_to(house.folder.parent)
    with pytest.raises(ConfigError):
        house.new(DATASETS, "linked")


def test_what_lies_inside_or_was_given_passes(house: House, tmp_path: Path) -> None:
    other, bundle = tmp_path / "other", tmp_path / "m.plush"
    other.mkdir()
    bundle.write_bytes(b"x")
    mine = House(house.folder, given=(other,), models=(bundle,))
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
def test_names_that_no_file_can_have_everywhere(house: House, name: str) -> None:
    with pytest.raises(ConfigError, match="cannot be a name"):
        house.new(DATASETS, name)


def test_a_new_name_makes_nothing_and_replaces_nothing(house: House) -> None:
    place = house.new(DATASETS, "  Ķepas 2026.1-a ")
    assert place == house.folder / DATASETS / "Ķepas 2026.1-a"
    assert not place.exists()
    place.mkdir()
    with pytest.raises(ConfigError, match="is there already"):
        house.new(DATASETS, "Ķepas 2026.1-a")
    assert house.new(EXPORTS, "Ķepas 2026.1-a").parent.name == EXPORTS


def test_data_sets_and_bundles_are_found_once(furniture: Path, tmp_path: Path) -> None:
    home = Path(shutil.copytree(furniture, tmp_path / "home"))
    one = home / DATASETS / "virtual"
    bundle = home / BUNDLES / "little.plush"
    house = House(home, given=(one,), models=(bundle,))
    assert house.datasets() == [one.resolve()]
    assert house.bundles() == [bundle.resolve()]
    shutil.copy(bundle, one / "newer.plush")
    os.utime(one / "newer.plush", (2e9, 2e9))
    assert [p.name for p in house.bundles()] == ["newer.plush", "little.plush"]
    assert house.title(one) == "virtual toy"
    (one / "dataset.toml").write_text("not = [toml")
    assert house.title(one) == "virtual"


def test_a_bundle_that_is_a_link_to_nowhere_is_not_listed(house: House) -> None:
    (house.folder / BUNDLES).mkdir()
    try:
        (house.folder / BUNDLES / "gone.plush").symlink_to(house.folder / "nothing")
    except OSError:
        pytest.skip("no links here")
    assert house.bundles() == []


def test_parts_are_made_once_and_closed_in_turn(house: House) -> None:
    closed: list[str] = []

    class First:
        def __init__(self, house: House) -> None:
            self.house = house

        def close(self) -> None:
            closed.append("first")

    class Second(First):
        def close(self) -> None:
            closed.append("second")

    first = house.part(First)
    made = []
    threads = [threading.Thread(target=lambda: made.append(house.part(First))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(one is first for one in made)
    house.part(Second)
    house.close()
    assert closed == ["second", "first"]
    assert house.part(First) is not first


def test_many_rings_are_heard_as_one_and_none_after_the_end() -> None:
    async def listen() -> tuple[int, int]:
        bell, heard = Bell(), []
        end = bell.hear(lambda: heard.append(1))
        thread = threading.Thread(target=lambda: [bell.ring() for _ in range(1000)])
        thread.start()
        thread.join()
        await asyncio.sleep(0.05)
        first = len(heard)
        bell.ring()
        end()
        await asyncio.sleep(0.05)
        end()
        bell.ring()
        return first, len(heard)

    assert asyncio.run(listen()) == (1, 1)


def test_a_ring_after_the_loop_closed_is_harmless() -> None:
    bell = Bell()

    async def listen() -> None:
        bell.hear(lambda: None)

    asyncio.run(listen())
    bell.ring()
    bell.ring()
