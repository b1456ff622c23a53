"""The proof of the C: it holds for real exports, and it notices what is wrong with bad ones."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.cli.export import verification_lines
from plushsense.cli.main import main
from plushsense.core.errors import BadInput, ConfigError, ToolError
from plushsense.core.layouts import Layout, load_layout
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.deploy.golden import EVENT, FAULT, HEALTH, PATCH, TRACKING, Vectors, answers_of, column
from plushsense.deploy.package import ARDUINO, IDF, SKETCH
from plushsense.deploy.profile import profile
from plushsense.deploy.proof.scenarios import scenarios_of
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import Setting, verify
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.targets import TARGETS
from plushsense.runtime.decisions import DecideSpec
from plushsense.runtime.events import NO_GESTURE
from plushsense.runtime.gate import JERK, GateSettings, Rule, Signal, Term
from plushsense.runtime.health import HealthSettings
from plushsense.runtime.image import HEAD_BYTES, image_head
from support.exports import bundle_of, exported
from support.outcomes import all_outcomes, outcomes_of
from support.requirements import LONG

pytestmark = pytest.mark.early

EMULATED = [name for name, target in TARGETS.items() if name != "host" and not target.slow]


def eight() -> Layout:
    """Eight channels without a valid range, at a rate whose period is no whole number of milliseconds."""
    names = [f"c{i}" for i in range(8)]
    return Layout.from_dict(
        {
            "name": "eight",
            "rate_hz": 90.0,
            "channels": [{"name": n, "unit": "count", "kind": "capacitive"} for n in names],
            "wire": ["device_ms", *names],
        }
    )


@pytest.fixture(scope="session")
def emulators(target_here: Callable[[str], str]) -> None:
    """Compilers and emulators of every target."""
    for name in TARGETS:
        target_here(name)


def plainly(setting: Setting) -> bool:
    usual = setting.optimise == TARGETS[setting.target].optimise[0]
    return usual and setting.cc in (None, "gcc") and not setting.image and not setting.cpp


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any], str]:
    code = main(["verify", *words, "--json"])
    output = capsys.readouterr()
    return code, json.loads(output.out) if output.out else {}, output.err


@pytest.fixture
def two_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the ten ways to compile on the host two: what the verb says does not need them all."""
    monkeypatch.setattr(
        "plushsense.deploy.proof.verify.settings_of", lambda name: [Setting(name, "gcc", o) for o in ("-O0", "-O2")]
    )


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")


# ---- It holds ------------------------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_every_way_to_compile_on_the_host(all_compilers: None, small: Path) -> None:
    done = verify(Export(small), ["host"])
    assert done.passed and done.mismatches == 0 and done.first is None
    made = {(r.compiler, r.flags) for r in done.runs}
    assert {(cc, o) for cc in ("gcc", "clang") for o in ("-O0", "-O2", "-O3")} <= made
    assert {("gcc", "-O1 sanitizers"), ("gcc", "-O2 called from C++"), ("gcc", "-O2 plush_model.bin")} <= made
    assert all("sanitizers" in what for what, _ in done.not_run), "clang's are a package of their own"
    export = Export(small)
    rows = [len(v.answers) for v in (export.golden, *export.scenarios(), *export.patched())]
    assert min(rows[:-1]) > 500 and {r.vectors for r in done.runs} == {sum(rows)}


@pytest.mark.exhaustive
def test_a_last_layer_that_was_adapted_and_rules_that_were_fitted(c_compiler: str, tmp_path: Path) -> None:
    """As `adapt` and the fitting of settings leave a bundle: other dense weights, re-quantised, and every rule."""
    plain = bundle_of("plush-15", "9d1_5d2", "4,6")
    weights = dict(plain.weights)
    rng = np.random.default_rng(3)
    weights["dense.weight"] = (weights["dense.weight"] * rng.uniform(-3, 3, (18, 1))).astype(np.float32)
    weights["dense.bias"] = (weights["dense.bias"] + rng.normal(size=18)).astype(np.float32)
    blow = Rule((Term(0, 60),), 3, NO_GESTURE)
    spec = DecideSpec(
        enter=0.2,
        leave=0.1,
        known_margin=1.0,
        gate=GateSettings((Signal(JERK, (1, 4, 10), lag=2, floor=20),), (blow,)),
        health=HealthSettings((-1500,) * 13, (30_000,) * 13, still_ms=400),
    )
    bundle = replace(plain, weights=weights, decision=spec.to_dict())
    export = Export(exported(tmp_path / "out", bundle))
    assert export.is_own and not np.array_equal(
        export.model.network.dense.weights, integer_model(plain).network.dense.weights
    )
    kinds = column(export.golden.answers, "what", EVENT), column(export.golden.answers, "source", EVENT)
    assert {1, 3} <= set(kinds[0]) and set(kinds[1]) == {0, 1}, "its own golden vectors tell events, and blows"
    assert FAULT in column(export.golden.answers, "state", HEALTH)
    done = verify(export, ["host"], only=plainly)
    assert done.passed and done.first is None


def test_patches_are_used_refused_and_undone(small: Path) -> None:
    """What every target is asked; that the status and the answers after it are compared is shown by the mutants."""
    export = Export(small)
    (patched,) = export.patched()
    assert column(patched.answers, "status", PATCH).tolist() == [0, 3, 6, 3, 0, 6, 1, 0]
    assert column(patched.answers, "restarts").max() == 1 and export.patched() == [patched]
    at = column(patched.answers, "frame", PATCH)
    own = answers_of(export.model, patched.frames)
    tracked = (own[:, 0] == 0) & (own[:, 4] == TRACKING)
    theirs = patched.answers[patched.answers[:, 0] == 0]
    same = (theirs[:, 12:30] == own[own[:, 0] == 0][:, 12:30]).all(axis=1)[tracked[own[:, 0] == 0]]
    frame = column(own, "frame")[tracked[own[:, 0] == 0]]
    assert same[(frame <= at[0]) | (frame > at[-1])].all() and not same[(frame > at[0]) & (frame <= at[-1])].any()


def test_scenarios_cover_all_outcomes(small: Path) -> None:
    export = Export(small)
    found = scenarios_of(export.model, export.bundle.scaler)
    assert set().union(*map(outcomes_of, found)) == all_outcomes()


MAIN = {
    "paper-11": ("14d1_39d2_41d4", "8,12,16", "plush-15"),
    "default-11": ("14d1_19d2_19d4", "8,12,16", "plush-15"),
    "four-layers-6": ("19d1_19d2_19d4_17d8", "4,6,8,8", "phone-6"),
    "one-layer-8": ("250", "5", "eight"),
    "vectors-3": ("v14_17d2_19d4", "6,16,16", "accel-3"),
    "vectors-13": ("v14_19d2", "4,8", "plush-15"),
}
ON_TWO_CHIPS = {"four-layers-6": (0, 2), "vectors-13": (1, 3)}


@pytest.mark.parametrize("name", MAIN)
@pytest.mark.exhaustive_for("four-layers-6", "one-layer-8", "paper-11", "vectors-13", "vectors-3")
def test_the_same_on_every_chip(emulators: None, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Golden vectors of all networks; test scenarios of three, with and without valid ranges, as all have the rules.

    Two of the networks run on the host and two of the chips; all on all with PLUSHSENSE_SOAK.
    """
    chips = EMULATED if LONG or name not in ON_TWO_CHIPS else [EMULATED[at] for at in ON_TWO_CHIPS[name]]
    symbol, filters, layout = MAIN[name]
    if name not in ("paper-11", "one-layer-8", "vectors-3"):
        monkeypatch.setattr(Export, "scenarios", lambda export: [])
    read = eight() if layout == "eight" else load_layout(layout)
    export = Export(exported(tmp_path / "out", bundle_of(read, symbol, filters)))
    more = export.made_up(5000 - export.golden.samples) if export.golden.samples < 5000 else []
    done = verify(export, ["host", *chips], more, only=plainly)
    assert done.first is None and done.passed
    assert [r.target for r in done.runs] == ["host", *chips]
    assert sum(c.samples for c in done.counts) >= 5000
    tracking = column(export.golden.answers, "state")
    assert tracking.sum() > 100 and (tracking == 0).sum() > 100
    assert {r.vectors for r in done.runs} == {sum(c.answers for c in done.counts)}


def begun(vectors: Vectors, frames: int) -> Vectors:
    """The first frames of vectors, and their answers."""
    few = vectors.answers[vectors.answers[:, 1] < frames]
    calls = tuple(call for call in vectors.calls if call.frame < frames)
    return replace(vectors, frames=vectors.frames[:frames], answers=few, calls=calls)


def test_ints_of_16_bits(target_here: Callable[[str], str], small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The beginnings of the golden vectors and of a scenario, on AVR; all of them when somebody names it."""
    export = Export(small)
    export.golden, scenario = begun(export.golden, 800), begun(export.scenarios()[0], 600)
    monkeypatch.setattr(Export, "scenarios", lambda export: [scenario])
    done = verify(export, [target_here("avr")])
    assert done.passed and done.first is None and done.decisions > 50
    assert [r.vectors for r in done.runs] == [sum(c.answers for c in done.counts)]
    assert [c.name for c in done.counts] == ["golden", "scenario", "patch"]


# ---- It notices ----------------------------------------------------------------------------------------------------


def test_scenarios_have_sensors_that_are_stuck_where_they_may_be(small: Path) -> None:
    """Also where six spreads are wider than the valid range, as of a lively accelerometer."""
    export = Export(small)
    wide = replace(export.bundle.scaler, scale=export.bundle.scaler.scale / 1e6)
    low, high = export.model.layout.valid_min_int, export.model.layout.valid_max_int
    for scenario in scenarios_of(export.model, wide):
        limits = scenario.model.rules.health
        assert (np.array(limits.low) > low).any() and (np.array(limits.high) < high).any()
        assert "fault" in outcomes_of(scenario)


def test_golden_vectors_in_which_the_toy_only_warms_up_prove_nothing(c_compiler: str, own: Path) -> None:
    golden = Export(own).golden
    (own / "golden" / "frames.bin").write_bytes(golden.frames[:40].astype("<u4").tobytes())
    few = golden.answers[golden.answers[:, 1] < 40]
    (own / "golden" / "answers.bin").write_bytes(few.astype("<i4").tobytes())
    done = verify(Export(own), ["host"], only=plainly)
    assert len(few) and (done.mismatches, done.decisions, done.passed) == (0, 0, False)
    assert "Nothing is proven" in "\n".join(verification_lines(done))


def test_a_file_edited_by_hand_is_what_is_tested(
    c_compiler: str, two_settings: None, own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(own / "plushsense.c", "(int32_t)(((e << 15)", "(int32_t)(((e << 14)")
    code, report, _ = run(capsys, str(own), "--target", "host", "--trust")
    assert code == 1 and not report["passed"] and not report["own"] and report["changed"] == ["plushsense.c"]
    assert report["mismatches"] == sum(r["mismatches"] for r in report["runs"]) > 0
    assert report["max_abs_diff"] >= 1
    assert report["first"].startswith("On host (gcc -O0), golden: row ")
    assert "'confidence' should be " in report["first"] and report["first"].count(".") == 1


@pytest.mark.parametrize(
    ("path", "content"),
    [
        (f"{ARDUINO}/src/plushsense.c", None),
        (f"{ARDUINO}/src/plush_wire.h", None),
        (f"{ARDUINO}/src/deep/evil.cpp", "int x;"),
        (f"{ARDUINO}/library.json", '{"build": {"extraScript": "evil.py"}}'),
        (f"{IDF}/CMakeLists.txt", "execute_process(COMMAND evil)"),
        (f"{IDF}/include/string.h", ""),
        ("CMakeLists.txt", None),
        ("zephyr/Kconfig", None),
        ("string.h", ""),
        ("plushsense.h.gch", ""),
        ("export.json", None),
    ],
)
def test_code_that_nobody_compiles_here_is_refused_too(own: Path, path: str, content: str | None) -> None:
    """A folder is vouched for, and so is what others compile of it."""
    assert Export(own).changed == Export(own).edited == ()
    (own / path).parent.mkdir(exist_ok=True)
    before = (own / path).read_text(encoding="utf-8") if content is None else content
    (own / path).write_text(before.replace('"model_id": ', '"model_id": 1') + "\n", encoding="utf-8")
    export = Export(own)
    assert path in export.changed and not export.edited
    with pytest.raises(BadInput, match=re.escape(path)):
        export.require_unchanged()


def test_links_are_not_vouched_for_and_examples_are_there_to_be_edited(
    c_compiler: str, two_settings: None, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    original = (own / f"{SKETCH}/plush_reaction.c").read_bytes()
    reaction = f"{SKETCH}/plush_reaction.c"
    (own / reaction).write_text("/* mine */", encoding="utf-8")
    code, report, _ = run(capsys, str(own), "--target", "host")
    assert (code, report["passed"], report["own"], report["changed"]) == (0, True, False, [reaction])
    (own / reaction).write_bytes(original)
    shutil.move(own / "plushsense.c", tmp_path / "elsewhere.c")
    (own / "plushsense.c").symlink_to(tmp_path / "elsewhere.c")
    (own / "main.c").write_text("int main(void) { return 0; }", encoding="utf-8")  # no build file names it
    code, report, err = run(capsys, str(own), "--target", "host")
    assert code == 2 and "plushsense.c in " in err and "main.c" not in err


def test_facts_of_an_export_are_those_of_its_model(own: Path) -> None:
    """Also where `profile` reads them, which once took any that stood there."""
    facts = json.loads((own / "export.json").read_text(encoding="utf-8"))
    (own / "export.json").write_text(json.dumps({**facts, "step_ms": 1.0, "span": -1}), encoding="utf-8")
    export = Export(own)
    assert export.changed == ("export.json",) and export.facts.step_ms == facts["step_ms"]
    for text, why in (
        (json.dumps({**facts, "step_ms": "soon"}), "step_ms is 'soon'"),
        ("[]", "holds no table"),
        ("[" * 100_000, "cannot be read"),
        ('"x"', "holds no table"),
    ):
        (own / "export.json").write_text(text, encoding="utf-8")
        with pytest.raises(BadInput, match=why):
            Export(own)
    (own / "export.json").write_text(json.dumps({**facts, "url": 'https://x"\n'}), encoding="utf-8")
    with pytest.raises(ConfigError, match="no address"):
        Export(own)
    with (own / "plush_model.bin").open("r+b") as file:
        file.truncate(1 << 40)
    (own / "export.json").write_text(json.dumps(facts), encoding="utf-8")
    with pytest.raises(BadInput, match="has more than"):
        Export(own)


def test_the_folders_own_header_is_what_the_caller_reads(c_compiler: str, own: Path) -> None:
    edit(own / "plushsense.h", "typedef struct plush_toy {", "typedef struct plush_toy {\n    uint32_t mine[5];")
    done = verify(Export(own), ["host"], only=lambda s: s.optimise == "-O2" and s.cc == "gcc", trust=True)
    assert done.passed and not done.own


def test_an_image_that_was_edited(c_compiler: str, own: Path) -> None:
    image = bytearray((own / "plush_model.bin").read_bytes())
    image[200] ^= 1
    (own / "plush_model.bin").write_bytes(bytes(image))
    done = verify(Export(own), ["host"], only=lambda s: (s.cc, s.optimise) == ("gcc", "-O2"), trust=True)
    assert len(done.runs) == 3
    bad = [r for r in done.runs if r.mismatches]
    assert [r.flags for r in bad] == ["-O2 plush_model.bin"]
    assert bad[0].mismatches == bad[0].vectors and "PLUSH_DAMAGED" in (bad[0].first or "")
    with pytest.raises(BadInput, match="is not what this PlushSense makes of model.plush"):
        Export(own).made_up(10)


def test_an_edited_model_that_agrees_with_its_golden_vectors_is_not_vouched_for(
    c_compiler: str, own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The title, which no answer shows; in plush_model.c it is the old one."""
    whole = (own / "plush_model.bin").read_bytes()
    body = bytearray(whole[HEAD_BYTES:])
    body[-3] ^= 1
    (own / "plush_model.bin").write_bytes(image_head(bytes(body)) + body)
    done = verify(Export(own), ["host"], only=lambda s: s.image, trust=True)
    assert not done.passed and "plush_model.c does not hold the bytes of plush_model.bin" in (done.first or "")
    assert not verify(Export(own), ["host"], only=plainly, trust=True).own
    (own / "plush_model.bin").write_bytes(whole)
    edit(own / "export.json", '"smoothing": ', '"smoothing": 1')
    assert main(["verify", str(own), "--target", "host"]) == 2
    assert "plush_model.bin, " in capsys.readouterr().err
    assert main(["verify", str(own), "--target", "host", "--trust"]) == 0
    # The header holds the checksum of the image.
    out = capsys.readouterr().out
    assert "NOT OURS: plush_model.h, plush_model.c, plush_model.bin, " in out
    assert "plush_model.c, web/index.html, export.json are not what this PlushSense writes" in out
    edit(own / "export.json", '"smoothing": ', '"smoothing": true, "was": ')
    assert main(["verify", str(own), "--target", "host"]) == 2
    assert "smoothing is True" in capsys.readouterr().err


def test_c_that_warns_or_writes_past_its_memory(c_compiler: str, own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(own / "plushsense.c", "toy->heard = 1;", "toy->heard = 1; int unused;")
    done = verify(Export(own), ["host"], only=plainly, trust=True)
    assert done.mismatches == sum(r.vectors for r in done.runs) and "unused" in (done.first or "")
    edit(own / "plushsense.c", "toy->heard = 1; int unused;", "((uint32_t *)toy->held)[-1] = 0; toy->heard = 1;")
    done = verify(Export(own), ["host"], only=plainly, trust=True)
    assert "before the toy's memory" in (done.first or "") and done.mismatches >= 1


def test_a_program_that_prints_nothing_ends_the_verification_at_once(
    c_compiler: str, two_settings: None, own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = own / "plushsense.c"
    early = "\n#include <unistd.h>\n__attribute__((constructor)) static void early(void)\n{\n    _exit(0);\n}\n"
    path.write_text(path.read_text(encoding="utf-8") + early, encoding="utf-8")
    code, report, err = run(capsys, str(own), "--target", "host", "--trust")
    assert code == 2 and report == {} and "On host (gcc -O0), the program ended without an error" in err
    assert err.count("\n") == 1


# ---- Code from elsewhere -------------------------------------------------------------------------------------------

PLANTED = """
#include <stdlib.h>
__attribute__((constructor)) static void planted(void)
{
    if (system("touch '%s'") != 0)
        exit(3);
}
"""


@pytest.mark.parametrize("name", ["plushsense.h", "plushsense.c", "plush_model.h", "plush_model.c"])
def test_code_that_is_not_ours_is_not_run(
    c_compiler: str, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    ran = tmp_path / "ran"
    text = (own / name).read_text(encoding="utf-8")
    (own / name).write_text(text + PLANTED % ran, encoding="utf-8")
    code, report, err = run(capsys, str(own), "--target", "host")
    assert code == 2 and report == {} and not ran.exists()
    assert f"{name} in '{own}' is not what this PlushSense writes" in err and "--trust" in err and err.count("\n") == 1
    with pytest.raises(BadInput, match=name.replace(".", r"\.")):
        profile(own, ["host"])
    assert not ran.exists()


def test_code_that_is_trusted_is_run_and_not_called_ours(
    c_compiler: str, two_settings: None, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name, ran = "plushsense.c", tmp_path / "ran"
    text = (own / name).read_text(encoding="utf-8")
    (own / name).write_text(text + PLANTED % ran, encoding="utf-8")
    code, report, _ = run(capsys, str(own), "--target", "host", "--trust")
    assert ran.exists() and (code, report["passed"], report["own"], report["changed"]) == (0, True, False, [name])


def test_a_header_beside_the_export_is_not_compiled(
    c_compiler: str, two_settings: None, own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The folder would stand before the system's on the search path."""
    ran = tmp_path / "ran"
    header = f"#pragma once\n#pragma GCC system_header\n#include_next <string.h>\n{PLANTED % ran}"
    (own / "string.h").write_text(header, encoding="utf-8")
    code, report, _ = run(capsys, str(own), "--target", "host", "--trust")
    assert not ran.exists()
    assert (code, report["own"], report["changed"]) == (0, False, ["string.h"])
    profile(own, ["host"], trust=True)
    assert not ran.exists()


# ---- Recordings, long streams ---------------------------------------------------------------------------------------


@pytest.mark.exhaustive
def test_recordings_go_through_the_c(
    c_compiler: str, two_settings: None, recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = exported(tmp_path / "out", bundle_of("accel-3", "5d1_4d3", "3,5"))
    code, report, err = run(capsys, str(out), "--target", "host", "--dataset", str(recorded), "--samples", "5000")
    assert code == 0 and report["mismatches"] == 0
    assert [s["name"] for s in report["streams"]] == ["golden", "scenario", "patch", "recordings"]
    assert report["streams"][3]["frames"] == 780 and "these recordings make" in err
    assert all(r["vectors"] == sum(s["answers"] for s in report["streams"]) for r in report["runs"])
    assert sorted(p.name for p in out.iterdir()) == sorted(
        p.name for p in exported(tmp_path / "b", Export(out).bundle).iterdir()
    )


def test_real_recordings_go_through_the_c(c_compiler: str, real_data: Path, tmp_path: Path) -> None:
    some = tmp_path / "raw"
    for person in ("P01", "P10"):
        shutil.copytree(real_data / "makeability-gestures" / person, some / person)
    import_recordings(some, tmp_path / "ds", layout="accel-3")
    export = Export(exported(tmp_path / "out", bundle_of("accel-3", "14d1_19d2_19d4", "8,12,16")))
    vectors = export.recorded(open_dataset(tmp_path / "ds"), [], 6000)
    assert sum(v.samples for v in vectors) >= 6000
    done = verify(export, ["host"], vectors, only=plainly)
    assert done.passed and done.runs[0].vectors >= 6000 // 5


def test_long_streams_are_cut_where_an_emulator_has_no_more_room(
    c_compiler: str, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("plushsense.deploy.proof.vectors.MOST_FRAME_BYTES", 56 * 2000)
    export = Export(small)
    vectors = export.made_up(5000)
    assert len(vectors) >= 3 and {len(v.frames) for v in vectors[:-1]} == {2000}
    done = verify(export, ["host"], vectors, only=plainly)
    assert done.passed and [c.name for c in done.counts] == ["golden", "scenario", "patch", "made up"]
    assert done.counts[3].samples >= 4900 and done.runs[0].vectors == sum(c.answers for c in done.counts)


def test_a_model_of_another_layout_among_the_files_is_named(c_compiler: str, own: Path, tmp_path: Path) -> None:
    other = exported(tmp_path / "other", bundle_of("accel-3", "9d1_5d2", "4,6"))
    for name in ("plush_model.h", "plush_model.c"):
        shutil.copyfile(other / name, own / name)
    done = verify(Export(own), ["host"], only=plainly, trust=True)
    assert not done.passed
    assert "other channels or classes than model.plush" in str(done.first)


@pytest.mark.skipif(sys.platform == "win32", reason="the compilers are shell scripts")
def test_a_compiler_without_sanitizers_is_named(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gcc", "clang"):
        (tmp_path / name).write_text("#!/bin/sh\nexit 1\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for name, also in (("gcc", ""), ("clang", r" \(Debian's libclang-rt-dev\)")):
        with pytest.raises(ToolError, match=f"Nothing can.*{name} makes no program with sanitizers here{also}[)]"):
            verify(Export(small), ["host"], only=lambda s, name=name: s.cc == name and s.optimise == "-O1")


def test_what_is_requested_must_be_there(
    c_compiler: str, own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, report, err = run(capsys, str(tmp_path))
    assert code == 2 and report == {} and "is no export" in err and err.count("\n") == 1
    code, _, err = run(capsys, str(own), "--target", "xtesna")
    assert code == 2 and "Did you mean 'xtensa'?" in err
    code, _, err = run(capsys, str(own), "--subject", "A")
    assert code == 2 and "--dataset" in err
    code, _, err = run(capsys, str(own), "--samples", "0")
    assert code == 2 and "--samples is 0" in err
    tools = tmp_path / "bin"
    tools.mkdir()
    for tool in ("gcc", "as", "ld"):
        (tools / tool).symlink_to(shutil.which(tool) or "")
    monkeypatch.setenv("PATH", str(tools))
    code, _, err = run(capsys, str(own), "--target", "xtensa")
    assert code == 2 and "gcc-xtensa-lx106" in err and "qemu-system-misc" in err and err.count("\n") == 1
    code, report, _ = run(capsys, str(own))
    assert code == 0 and {r["target"] for r in report["runs"]} == {"host"}
    why = {n["what"]: n["why"] for n in report["not_run"]}
    assert "gcc-xtensa-lx106" in why["xtensa"] and set(EMULATED) <= set(why)
    assert "clang" in why["host, clang -O2"]
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ToolError, match="Nothing can be checked here"):
        verify(Export(own))
