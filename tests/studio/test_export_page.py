"""The export page in a real browser: the same files as the command's, the verifier's answers, every refusal."""

from __future__ import annotations

import hashlib
import io
import subprocess
import sys
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from plushsense.deploy.targets import TARGETS
from support.browsing import LONG_MS, TABLET, axe, connected, marked
from support.exported import bundle_of, flip, sums
from support.requirements import LONG

Fixture = Callable[..., Any]
USUAL = {name for name, target in TARGETS.items() if not target.slow}


def only(page: Any, target: str) -> None:
    """Of the machines that can be compiled for here, this one."""
    if not marked(page, f"target-{target}").is_visible():
        marked(page, "proof").get_by_text("More settings").click()
        marked(page, f"target-{target}").wait_for()
    for name in USUAL - {target}:
        if marked(page, f"target-{name}").count():
            marked(page, f"target-{name}").click()


def sideways(page: Any) -> int:
    """By how many pixels the page is wider than its window."""
    return int(page.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth"))


@pytest.mark.exhaustive
def test_export_verify_and_break(
    studio: Fixture, look: Fixture, home: Path, target_here: Fixture, tmp_path: Path
) -> None:
    # On the host in ten ways, which take half of a minute, or on a chip in two; `verify` itself is tested on all.
    first, compiler, flags = ("host", "clang", "sanitizers") if LONG else ("riscv32", "riscv64-unknown-elf-gcc", "-Os")
    target_here(first), target_here("cortex-m4")
    url = studio(home=home).url
    browser = look()
    page = browser.open(f"{url}/export")
    assert "Simulation" in marked(page, "new").inner_text()
    marked(page, "name").fill("one")
    marked(page, "do").click()
    marked(page, "export-facts").wait_for(timeout=LONG_MS)
    command = [sys.executable, "-m", "plushsense", "export", str(home / "bundles" / "little.plush")]
    subprocess.run([*command, str(tmp_path / "two")], check=True, capture_output=True)
    assert sums(home / "exports" / "one") == sums(tmp_path / "two")
    size = (home / "exports" / "one" / "plush_model.bin").stat().st_size
    assert 8_000 < size < 9_000 and f"{size:,} bytes" in marked(page, "export-facts").text_content()
    assert "arduino/PlushSense" in marked(page, "next").text_content()
    with page.expect_download() as loaded:
        marked(page, "download").click()
    with zipfile.ZipFile(io.BytesIO(Path(loaded.value.path()).read_bytes())) as archive:
        got = {n.removeprefix("one/"): hashlib.sha256(archive.read(n)).hexdigest() for n in archive.namelist()}
    assert got == sums(tmp_path / "two")
    for name in ("..", "%2e%2e", "bundles", "one%2fgolden", "a" * 300):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"{url}/download/exports/{name}.zip", timeout=20)
        assert refused.value.code == 404

    only(page, first)
    marked(page, "verify").click()
    marked(page, "verdict").wait_for(timeout=300_000)
    assert "✓ equal" in marked(page, "verdict").inner_text()
    assert flags in marked(page, "runs").inner_text() and compiler in marked(page, "runs").inner_text()
    assert "scenario" in marked(page, "streams").inner_text()
    assert "✓ equal" in marked(page, "exports").inner_text()
    assert axe(page) == []

    flip(home / "exports" / "one" / "plush_model.c")
    page.reload()
    connected(page)
    assert "changed since" in marked(page, "exports").inner_text(), "the old verdict is no longer shown as one"
    only(page, "cortex-m4")
    marked(page, "verify").click()
    marked(page, "ended").get_by_text("are not what the studio wrote").wait_for(timeout=300_000)
    assert "plush_model.c" in marked(page, "ended").inner_text()
    marked(page, "trust").click()
    marked(page, "verify").click()
    page.get_by_text("✗ not equal").first.wait_for(timeout=300_000)
    said = marked(page, "verdict").inner_text()
    assert "answers differ" in said and "On cortex-m4" in said and "plush_model.c" in said
    assert axe(page) == []

    # What takes minutes is still there after a reload, for another browser too, and can be stopped.
    marked(page, "proof").get_by_text("More settings").click()
    for name in USUAL - {"cortex-m4"}:
        if marked(page, f"target-{name}").count():
            marked(page, f"target-{name}").click()
    flip(home / "exports" / "one" / "plush_model.c")
    marked(page, "verify").click()
    marked(page, "stop").wait_for()
    page.reload()
    connected(page)
    assert "Verify “one”" in marked(page, "work").inner_text()
    other = look(TABLET, dark=True, language="lv", touch=True)
    tablet = other.open(f"{url}/export?name=one")
    assert "Pārbaude: „one”" in marked(tablet, "work").inner_text()
    assert sideways(tablet) == 0 and axe(tablet) == []
    marked(tablet, "stop").click()
    marked(page, "ended").wait_for(timeout=LONG_MS)
    assert "Stopped: Verify “one”" in marked(page, "ended").inner_text()
    assert browser.complaints == [] and other.complaints == []


@pytest.mark.exhaustive
def test_each_refusal_is_a_sentence(studio: Fixture, look: Fixture, tmp_path: Path) -> None:
    home = tmp_path / "home"
    bundle_of(padding="causal").save(home / "bundles" / "causal.plush")
    bundle_of().save(home / "bundles" / "fine.plush")
    (home / "bundles" / "broken.plush").write_bytes((home / "bundles" / "fine.plush").read_bytes()[:-9])
    (home / "exports" / "taken").mkdir(parents=True)
    url = studio(home=home).url
    browser = look()
    page = browser.open(f"{url}/export?model={home / 'bundles' / 'causal.plush'}")
    assert "padding causal" in marked(page, "bundle-cannot").inner_text()
    marked(page, "name").fill("causal")
    marked(page, "do").click()
    marked(page, "ended").wait_for(timeout=300_000)
    assert "padding causal" in marked(page, "ended").inner_text()
    assert marked(page, "ended").get_attribute("role") == "alert"
    assert not (home / "exports" / "causal").exists()
    assert axe(page) == []

    page.goto(f"{url}/export?model={home / 'bundles' / 'broken.plush'}")
    connected(page)
    assert "“broken” cannot be read" in marked(page, "bundle-problem").inner_text()
    assert marked(page, "do").is_disabled()
    page.goto(f"{url}/export?model={home / 'bundles' / 'fine.plush'}")
    connected(page)
    marked(page, "name").fill("taken")
    marked(page, "do").click()
    marked(page, "new").get_by_role("alert").get_by_text("exists already").wait_for()
    # A home that cannot be written to, for root too.
    (home / "exports" / "taken").rmdir()
    (home / "exports").rmdir()
    (home / "exports").write_text("")
    marked(page, "name").fill("nowhere")
    marked(page, "do").click()
    page.get_by_text("“nowhere” cannot be created").first.wait_for(timeout=300_000)
    page.goto(f"{url}/export?name=nothing")
    connected(page)
    marked(page, "detail").get_by_text("There is no export").wait_for()
    assert browser.complaints == []
