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

import plushsense as ps
from plushsense.core.errors import BadInput, ConfigError
from plushsense.deploy.wasm import module
from plushsense.studio.app.guard import path_in, zip_of
from plushsense.studio.app.jobs import DONE, Jobs, StudioJob
from plushsense.studio.app.workspace import EXPORTS, Workspace, folder_digest
from plushsense.studio.pages.export.exports import (
    BundleFacts,
    ExportFacts,
    exports_of,
    formats,
    newest_job,
    targets,
)
from plushsense.studio.tasks import TASKS, TaskReporter
from support.exported import bundle_of, flip, sums


def run_task(task: Any, **spec: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the result of a task and its progress reports."""
    out = io.StringIO()
    result = task(spec, TaskReporter(out))
    return result, [json.loads(line) for line in out.getvalue().splitlines()]


@pytest.fixture
def little(tmp_path: Path) -> Workspace:
    bundle_of().save(tmp_path / "home" / "bundles" / "m.plush")
    return Workspace(tmp_path / "home")


def test_the_task_writes_what_the_library_writes(
    little: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without compilers and emulators the export stands, and says what would count.
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    module.cache_clear()
    place, bundle = little.new(EXPORTS, "one"), str(little.bundles()[0])
    result, reports = run_task(TASKS["export"], bundle=bundle, place=str(place), also=[], dataset="")
    ps.export(bundle, tmp_path / "two")
    assert sums(place) == sums(tmp_path / "two")
    assert set(result["files"]) == set(sums(place))
    assert [r["progress"]["stage"] for r in reports if "progress" in r] == ["export", "profile"]
    assert "web/index.html" in str(next(r for r in reports if "progress" not in r))
    found = ExportFacts.of(place)
    assert exports_of(little) == [place]
    facts = found.facts
    assert facts and (facts.flash_bytes, facts.ram_bytes) == (result["flash_bytes"], result["ram_bytes"])
    assert result["profile"]["digest"] == found.digest == folder_digest(place)
    assert "No emulator to count on" in result["profile"]["refused"]
    assert "qemu-system-arm" in result["profile"]["refused"]
    assert "gcc" in targets()["host"] and "gcc-xtensa-lx106" in targets()["xtensa"]
    with pytest.raises(BadInput, match="already holds something"):
        run_task(TASKS["export"], bundle=bundle, place=str(place), also=[], dataset="")


def test_a_flipped_byte_is_another_export(little: Workspace, tmp_path: Path) -> None:
    ps.export(little.bundles()[0], tmp_path / "one")
    before = folder_digest(tmp_path / "one")
    flip(tmp_path / "one" / "plush_model.c")
    assert folder_digest(tmp_path / "one") != before


@pytest.mark.exhaustive
def test_a_broken_export_is_found(little: Workspace, target_here: Callable[[str], str], tmp_path: Path) -> None:
    ps.export(little.bundles()[0], tmp_path / "one")
    flip(tmp_path / "one" / "plush_model.c")
    spec = {"place": str(tmp_path / "one"), "targets": [target_here("cortex-m4")]}
    with pytest.raises(BadInput, match=r"plush_model\.c in .* is not what this PlushSense writes"):
        run_task(TASKS["verify"], **spec)
    result, reports = run_task(TASKS["verify"], **spec, trust=True)
    assert not result["own"] and not result["passed"] and result["mismatches"] > 0 and result["first"]
    assert result["changed"] == ["plush_model.c"]
    assert reports[-1]["progress"]["done"] == reports[-1]["progress"]["total"]


def test_facts_of_bundles(tmp_path: Path) -> None:
    bundle_of().save(tmp_path / "fine.plush")
    bundle_of(padding="causal").save(tmp_path / "causal.plush")
    (tmp_path / "broken.plush").write_bytes((tmp_path / "fine.plush").read_bytes()[:-9])
    fine, causal, broken = (BundleFacts.of(tmp_path / f"{n}.plush") for n in ("fine", "causal", "broken"))
    assert (fine.problem, fine.cannot, fine.bundle.layout.name, len(fine.bundle.gestures)) == (
        None,
        None,
        "accel-3",
        18,
    )
    assert "train 5d1_4d3 with --padding stream" in causal.cannot and causal.problem is None
    assert "its file is damaged" in broken.problem
    assert BundleFacts.of(tmp_path / "none.plush").problem.startswith("The network “none” cannot be read")


def test_a_zip_on_the_way(little: Workspace) -> None:
    place = little.new(EXPORTS, "ā one")
    ps.export(little.bundles()[0], place)
    packed = zip_of(place)
    assert packed == zip_of(place)
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        assert archive.testzip() is None
        got = {n.removeprefix("ā one/"): hashlib.sha256(archive.read(n)).hexdigest() for n in archive.namelist()}
    assert got == sums(place)


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_a_link_takes_nothing_along(little: Workspace, tmp_path: Path) -> None:
    place = little.new(EXPORTS, "one")
    ps.export(little.bundles()[0], place)
    (tmp_path / "secret").write_text("secret")
    (place / "golden" / "secret").symlink_to(tmp_path / "secret")
    with zipfile.ZipFile(io.BytesIO(zip_of(place))) as archive:
        assert "one/golden/secret" not in archive.namelist()
    (little.folder / EXPORTS / "away").symlink_to(tmp_path)
    for name in ("away", "..", ".", "../bundles"):
        with pytest.raises(ConfigError):
            path_in(little, EXPORTS, name)


def test_formats_that_lack_something(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("plushsense.studio.pages.export.exports.importlib.util.find_spec", lambda name: None)
    assert formats()["onnx-int8"] == "onnx" and formats()["tflite"] == "tflite"


def test_the_newest_work_on_a_place(little: Workspace) -> None:
    work = little.folder / "work"
    work.mkdir()
    for n, (place, state) in enumerate([("a", DONE), ("b", DONE), ("a", "stopped")]):
        job = StudioJob(str(n), "verify", {"place": str(little.folder / place)}, "t", state=state)
        (work / f"{n}.json").write_text(json.dumps({k: v for k, v in vars(job).items() if k != "message"}))
    jobs = little.part(Jobs)
    found = newest_job(jobs, "verify", little.folder / "a")
    assert found is not None and found.id == "0"
    assert newest_job(jobs, "export", little.folder / "a") is None
