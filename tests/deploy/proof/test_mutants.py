"""The vectors of an export detect each mutant of its model and its C."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.gestures import Gesture, GestureSet
from plushsense.deploy.code import library_files
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import Setting
from plushsense.deploy.targets import TARGETS
from support import mutants
from support.exports import bundle_of, exported
from support.mutants import RULES, Mutant, found_by, mutants_of, source_mutants

pytestmark = pytest.mark.early

SOURCE = library_files()["plushsense.c"]
EMULATED = [name for name, target in TARGETS.items() if target.counts]
# A hundred mutants are compiled without optimisation, for which clang takes half as long as gcc.
QUICK = Setting("host", "clang" if shutil.which("clang") else "gcc", "-O0", ("-std=c99",))


@pytest.fixture(autouse=True)
def one_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "plushsense.deploy.proof.verify.settings_of",
        lambda target: [QUICK if target == "host" else Setting(target, flags=("-std=c99",))],
    )


def not_found(export: Export, chosen: list[Mutant], folder: Path) -> list[str]:
    """Names of the mutants that no answer shows; a toy that would not begin or crashed shows none."""
    shown = {m.name: found_by(export, m, QUICK, folder / f"{n}") or "" for n, m in enumerate(chosen)}
    return [name for name, first in shown.items() if "should be" not in first or "plush_begin" in first]


@pytest.mark.parametrize("each", ["kind", "all"])
@pytest.mark.exhaustive_for("all")
def test_every_mutant_is_found_on_the_host(each: str, c_compiler: str, small: Path, tmp_path: Path) -> None:
    export = Export(small)
    found = mutants_of(export.model, SOURCE)
    assert len({m.name for m in found}) == len(found)
    assert len(found) == len([m for m in source_mutants() if m.when != "vectors"]) + 10
    of_kind = {m.kind: m for m in reversed(found)}
    assert set(of_kind) == {*RULES, "weight", "shift", "index", "rounding", "clamp", "rule", "constant", "patch"}
    assert not_found(export, found if each == "all" else list(of_kind.values()), tmp_path) == []


@pytest.mark.exhaustive
def test_every_mutant_of_a_vector_layer_is_found(c_compiler: str, tmp_path: Path) -> None:
    export = Export(exported(tmp_path / "out", bundle_of("accel-3", "v14_19d2", "4,8")))
    names = {"one weight of the vector layer by one", *(m.name for m in source_mutants() if m.when == "vectors")}
    chosen = [m for m in mutants_of(export.model, SOURCE) if m.name in names]
    assert len(chosen) == len(names) and not_found(export, chosen, tmp_path) == []


@pytest.mark.exhaustive
def test_two_classes_need_more_scenarios(c_compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of them is idle in the scenarios: few sequences of steps show some mutants of the rules."""
    two = GestureSet("two", (Gesture("pat", "positive"), Gesture("rest", "none")))
    export = Export(exported(tmp_path / "out", bundle_of("accel-3", gestures=two, seed=5)))
    seldom = "an affect stays at the share at which it begins"
    names = {seldom, "an event begins a step too soon"}
    chosen = [m for m in mutants_of(export.model, SOURCE) if m.name in names]
    assert not_found(export, chosen, tmp_path / "more") == []
    monkeypatch.setattr(mutants, "MORE_SCENARIOS", 0)
    assert not_found(export, chosen, tmp_path / "few") == [seldom]


@pytest.mark.exhaustive
def test_without_smoothing_no_mutant_is_made_that_cannot_show(c_compiler: str, tmp_path: Path) -> None:
    """Nor one that the toy would only refuse. Those of the rules show in scenarios, which have models of their own."""
    bundle = replace(bundle_of("plush-15", "9d1_5d2", "4,6"), decision={"smoothing_s": 0})
    export = Export(exported(tmp_path / "out", bundle))
    found = mutants_of(export.model, SOURCE)
    assert len(found) == len([m for m in source_mutants() if m.when != "vectors"]) + 9
    numbers = [m for m in found if m.kind in ("rounding", "clamp", "constant", "shift")]
    assert not_found(export, numbers, tmp_path) == []


@pytest.mark.parametrize(
    ("target", "second"),
    list(zip(EMULATED, ("shift", "index", "rounding", "index", "clamp"), strict=True)),
    ids=EMULATED,
)
@pytest.mark.exhaustive_for("cortex-m0", "cortex-m33", "cortex-m4", "riscv32")
def test_mutants_are_found_on_every_chip(
    target_here: Callable[[str], str], small: Path, target: str, second: str, tmp_path: Path
) -> None:
    """A weight on each of them, and another kind: on the host each kind is found."""
    target_here(target)
    export = Export(small)
    found = {m.kind: m for m in reversed(mutants_of(export.model, SOURCE))}
    for kind in ("weight", second):
        first = found_by(export, found[kind], Setting(target, flags=("-std=c99",)), tmp_path / kind)
        assert first is not None and first.startswith(f"On {target} ") and "should be" in first
