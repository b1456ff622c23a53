"""What the export page stands on: tasks, downloads, facts; no browser."""

from __future__ import annotations

import hashlib
import io
import json
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

import plushsense as ps
from exported import bundle_of, flip, sums
from plushsense.apps.studio.downloads import below, pieces
from plushsense.apps.studio.exports import BundleFacts, ExportFacts, digest, exports_of, formats, newest, targets
from plushsense.apps.studio.house import EXPORTS, House
from plushsense.apps.studio.jobs import DONE, Job, Jobs
from plushsense.apps.studio.tasks import export as export_task
from plushsense.apps.studio.tasks import verify as verify_task
from plushsense.apps.studio.worker import Tell
from plushsense.core.errors import BadInput, ConfigError


def told(task: Any, **spec: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a task returned, and what it told on the way."""
    out = io.StringIO()
    result = task.run(spec, Tell(out))
    return result, [json.loads(line) for line in out.getvalue().splitlines()]


@pytest.fixture
def little(tmp_path: Path) -> House:
    bundle_of().save(tmp_path / "home" / "bundles" / "m.plush")
    return House(tmp_path / "home")


def test_the_task_writes_what_the_library_writes(
    little: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without compilers and emulators the export stands, and says what would count.
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    place, bundle = little.new(EXPORTS, "one"), str(little.bundles()[0])
    result, reports = told(export_task, bundle=bundle, place=str(place), also=[], dataset="")
    ps.export(bundle, tmp_path / "two")
    assert sums(place) == sums(tmp_path / "two")
    assert set(result["files"]) == set(sums(place))
    assert [r["progress"]["stage"] for r in reports] == ["export", "profile"]
    found = ExportFacts.of(place)
    assert exports_of(little) == [place]
    assert (found.flash_bytes, found.ram_bytes) == (result["flash_bytes"], result["ram_bytes"])
    assert result["profile"]["digest"] == found.digest == digest(place)
    assert "No emulator to count on" in result["profile"]["refused"]
    assert "qemu-system-arm" in result["profile"]["refused"]
    assert "gcc" in targets()["host"] and "gcc-xtensa-lx106" in targets()["xtensa"]
    with pytest.raises(BadInput, match="overwrites nothing"):
        told(export_task, bundle=bundle, place=str(place), also=[], dataset="")


def test_a_flipped_byte_is_another_export(little: House, tmp_path: Path) -> None:
    ps.export(little.bundles()[0], tmp_path / "one")
    before = digest(tmp_path / "one")
    flip(tmp_path / "one" / "plush_model.c")
    assert digest(tmp_path / "one") != before


def test_a_broken_export_is_found(little: House, target_here: Callable[[str], str], tmp_path: Path) -> None:
    ps.export(little.bundles()[0], tmp_path / "one")
    flip(tmp_path / "one" / "plush_model.c")
    result, reports = told(verify_task, place=str(tmp_path / "one"), targets=[target_here("cortex-m4")])
    assert not result["passed"] and result["mismatches"] > 0 and result["first"]
    assert "arduino/PlushSense/src/plush_model.c" in result["changed_copies"]
    assert reports[-1]["progress"]["done"] == reports[-1]["progress"]["total"]


def test_facts_of_bundles(tmp_path: Path) -> None:
    bundle_of().save(tmp_path / "fine.plush")
    bundle_of(padding="mirror").save(tmp_path / "mirror.plush")
    (tmp_path / "broken.plush").write_bytes((tmp_path / "fine.plush").read_bytes()[:-9])
    fine, mirror, broken = (BundleFacts.of(tmp_path / f"{n}.plush") for n in ("fine", "mirror", "broken"))
    assert (fine.problem, fine.cannot, fine.layout, len(fine.gestures)) == ("", "", "accel-3", 18)
    assert "train 5d1_4d3 with --padding stream" in mirror.cannot and mirror.problem == ""
    assert "bytes are missing at its end" in broken.problem
    assert BundleFacts.of(tmp_path / "none.plush").problem.startswith("There is no bundle")


def test_a_zip_on_the_way(little: House) -> None:
    place = little.new(EXPORTS, "ā one")
    ps.export(little.bundles()[0], place)
    packed = b"".join(pieces(place))
    assert packed == b"".join(pieces(place))
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        assert archive.testzip() is None
        got = {n.removeprefix("ā one/"): hashlib.sha256(archive.read(n)).hexdigest() for n in archive.namelist()}
    assert got == sums(place)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_takes_nothing_along(little: House, tmp_path: Path) -> None:
    place = little.new(EXPORTS, "one")
    ps.export(little.bundles()[0], place)
    (tmp_path / "secret").write_text("secret")
    (place / "golden" / "secret").symlink_to(tmp_path / "secret")
    with zipfile.ZipFile(io.BytesIO(b"".join(pieces(place)))) as archive:
        assert "one/golden/secret" not in archive.namelist()
    (little.folder / EXPORTS / "away").symlink_to(tmp_path)
    for name in ("away", "..", ".", "../bundles"):
        with pytest.raises(ConfigError):
            below(little, EXPORTS, name)


def test_formats_that_lack_something(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plushsense.apps.studio.exports.importlib.util.find_spec", lambda name: None)
    assert formats()["onnx-int8"] == "onnx" and formats()["tflite"] == "tflite" and formats()["espdl-esp32"] == "espdl"


def test_the_newest_work_on_a_place(little: House) -> None:
    work = little.folder / "work"
    work.mkdir()
    for n, (place, state) in enumerate([("a", DONE), ("b", DONE), ("a", "stopped")]):
        job = Job(str(n), "verify", {"place": str(little.folder / place)}, "t", state=state)
        (work / f"{n}.json").write_text(json.dumps(vars(job)))
    jobs = little.part(Jobs)
    found = newest(jobs, "verify", little.folder / "a")
    assert found is not None and found.id == "0"
    assert newest(jobs, "export", little.folder / "a") is None
