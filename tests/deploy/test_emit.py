"""The export folder: what stands in it, that it compiles, that nothing is overwritten and nobody is named."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BadInput
from plushsense.core.gestures import GestureSet
from plushsense.core.templates import c_comment
from plushsense.deploy.code import TOY_BYTES, RestFacts, c_names, read_facts
from plushsense.deploy.golden import answers_of, column, golden_frames, read_golden
from plushsense.deploy.package import emit
from plushsense.deploy.quantize import integer_model
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import IntegerModel, memory_bytes
from support.exports import bundle_of

PEOPLE = {"subjects": ["Anna", "P02"], "validation_subjects": ["Bo"], "scores": {"said": "people: Bo, P02", "f1": 0.5}}


def made(layout: str = "accel-3") -> tuple[IntegerModel, Bundle]:
    bundle = replace(bundle_of(layout, window=60), provenance=dict(PEOPLE))
    return integer_model(bundle), bundle


def test_the_folder(tmp_path: Path) -> None:
    model, bundle = made()
    done = emit(model, bundle, tmp_path / "out")
    assert {
        "plushsense.h",
        "plushsense.c",
        "plush_model.h",
        "plush_model.c",
        "plush_model.bin",
        "model.plush",
        "golden/frames.bin",
        "golden/answers.bin",
        "golden/README.md",
        "export.json",
    } <= set(done.facts.files)
    assert {p.relative_to(tmp_path / "out").as_posix() for p in (tmp_path / "out").rglob("*") if p.is_file()} == set(
        done.facts.files
    )
    facts = read_facts(tmp_path / "out")
    assert facts.memory_bytes == memory_bytes(model)
    assert (tmp_path / "out" / "plush_model.bin").read_bytes() == model.to_bytes()
    assert facts.flash_bytes == len(model.to_bytes()) == facts.model_bytes
    assert json.loads(json.dumps(done.to_json()))["ram_bytes"] == facts.memory_bytes + TOY_BYTES
    frames, answers = read_golden(tmp_path / "out" / "golden", 3, 18)
    assert np.array_equal(answers, answers_of(model, frames))
    assert set(column(answers, "state")) == {0, 1}
    assert answers[-1, 10] >= 4  # restarts: two gaps or resets, a wrap, …
    assert answers[-1, 11] > 25  # invalid values
    with pytest.raises(BadInput, match="already holds something"):
        emit(model, bundle, tmp_path / "out")
    assert not list(tmp_path.glob(".out*"))


def test_a_folder_that_cannot_be_finished_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("no more")

    monkeypatch.setattr("plushsense.deploy.package.write_golden", fail)
    with pytest.raises(BadInput, match="no more"):
        emit(*made(), tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_nobody_is_named(tmp_path: Path) -> None:
    model, bundle = made()
    emit(model, bundle, tmp_path / "out")
    for path in (tmp_path / "out").rglob("*"):
        if path.is_file():
            assert not any(name in path.read_bytes() for name in (b"Anna", b"P02", b"Bo,"))
    export = bundle.without_people()
    assert export.provenance == {
        "subjects": 2,
        "validation_subjects": 1,
        "scores": {"said": "people: …, …", "f1": 0.5},
    }
    assert export.without_people().provenance == export.provenance, "export does it before emit does"


@pytest.mark.parametrize("label", ["*\\", "*/*", "/*/", "\u202eRTL", "a\rb\n", "\u2066x"])
def test_no_label_ends_a_comment_or_turns_it_round(label: str) -> None:
    text = c_comment(label)
    assert "*/" not in text and "/*" not in text and "\\" not in text and text.isprintable()


@pytest.mark.parametrize("layout", ["plush-15", "phone-6"])
def test_golden_frames_reach_what_they_should(layout: str) -> None:
    model, bundle = made(layout)
    read = model.layout
    frames = golden_frames(read, bundle.scaler, model.network.arch.span, inputs=model.network.inputs)
    assert (np.diff(frames[:, 0]) == 20).sum() > model.network.arch.span // 3, "two periods: halves between two frames"
    steps = np.diff(frames[:, 0])
    assert (
        (steps == read.gap_ms).any()
        and (steps > read.gap_ms).any()
        and (steps == 0).any()
        and (steps < -(1 << 31)).any()
    )
    values = frames[:, 1:]
    assert (values == read.valid_min_int).all(axis=1).any() and (values == read.valid_max_int).all(axis=1).any()
    assert ((values < read.valid_min_int) | (values > read.valid_max_int)).any()
    assert values.min() >= -(1 << 31) and values.max() < 1 << 31


def test_the_model_as_c(tmp_path: Path, c_compiler: str) -> None:
    model, bundle = made()
    emit(model, bundle, tmp_path / "out")
    main = tmp_path / "main.c"
    main.write_text(
        '#include <stdio.h>\n#include "plush_model.h"\n#include "plushsense.h"\n'
        "static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];\nstatic plush_toy toy;\n"
        "int main(void) { int wrong; fwrite(plush_model, 1, PLUSH_MODEL_BYTES, stdout);\n"
        "wrong = (int)plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory);\n"
        "return wrong + PLUSH_GESTURE_AT_REST + (toy.layout != PLUSH_MODEL_LAYOUT); }\n"
    )
    out = tmp_path / "out"
    words = [c_compiler, "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", f"-I{out}"]
    sources = [str(main), str(out / "plushsense.c"), str(out / "plush_model.c")]
    subprocess.run([*words, *sources, "-o", str(tmp_path / "run")], check=True)
    ran = subprocess.run([str(tmp_path / "run")], capture_output=True, check=True)
    assert ran.stdout == model.to_bytes()
    placed = [*words, '-DPLUSH_CONST=__attribute__((section(".mine")))', "-S", "-o", "-", str(out / "plush_model.c")]
    done = subprocess.run(placed, capture_output=True, check=True, text=True)
    assert re.search(r"\.section\s+\.mine.*?\bplush_model:", done.stdout, re.S)
    # The flash of an ESP8266 gives only whole words, unless its core is asked to take the exceptions; AVR has others.
    for file in (out / "plush_model.c", out / "plushsense.c"):
        for chip in ("-DESP8266", "-D__AVR__"):
            refused = subprocess.run([*placed[:-1], file, chip], capture_output=True, text=True)
            assert refused.returncode != 0 and "cannot read this chip's flash: leave out PLUSH_CONST" in refused.stderr
        subprocess.run([*placed[:-1], file, "-DESP8266", "-DNON32XFER_HANDLER"], capture_output=True, check=True)


def test_c_names() -> None:
    labels = ("Back stroke 1", "back-stroke 1", "3 taps", "Öhr", "!", "Back stroke 1 2", "Ķepas glāsts", "Fuß")
    assert c_names(labels) == (
        *("BACK_STROKE_1", "BACK_STROKE_1_2", "3_TAPS", "OHR", "GESTURE", "BACK_STROKE_1_2_2", "KEPAS_GLASTS", "FUSS"),
    )


def test_a_program_knows_ranges_gap_and_names(tmp_path: Path, c_compiler: str) -> None:
    """And its author hears of a status that it does not look at."""
    model, bundle = made("plush-15")
    out = tmp_path / "out"
    emit(model, bundle, out)
    low, high = model.layout.valid_min_int.tolist(), model.layout.valid_max_int.tolist()
    names = c_names(model.layout.names)
    values = [f"PLUSH_{end}_{name}" for name in names for end in ("LOWEST", "HIGHEST")]
    header = (out / "plushsense.h").read_text(encoding="utf-8")
    states = {
        "STATUS": "PLUSH_MEMORY_NOT_ALIGNED",
        "STATE": "PLUSH_FAULT",
        "READING": "PLUSH_READING_LEFT_OUT",
        "KIND": "PLUSH_SURE_GESTURE",
        "WHAT": "PLUSH_ENDED",
    }
    main = tmp_path / "main.c"
    main.write_text(
        '#include <stdio.h>\n#include "plush_model.h"\n#include "plushsense.h"\n'
        + "".join(f"static const char *const {name}[] = PLUSH_{name}_NAMES;\n" for name in states)
        + "int main(void) { long n[] = {PLUSH_MODEL_GAP_MS, PLUSH_NO_READING, "
        + f"{', '.join(values)}}}; unsigned i;\n"
        + "".join(
            f'puts({name}[{last}]); printf("%d\\n", (int)(sizeof {name} / sizeof {name}[0] - {last} - 1));\n'
            for name, last in states.items()
        )
        + 'for (i = 0; i < sizeof n / sizeof n[0]; i++) printf("%ld ", n[i]);\nreturn 0; }\n'
    )
    words = [c_compiler, "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{out}", str(main)]
    subprocess.run([*words, "-o", str(tmp_path / "run")], check=True)
    told = subprocess.run([str(tmp_path / "run")], capture_output=True, check=True, text=True).stdout.splitlines()
    newest = ("memory not aligned", "fault", "left out", "sure gesture", "ended")
    last = [line for name in newest for line in (name, "0")]
    assert told[:-1] == last, "the last of each enumeration, and none after it"
    bounds = [bound for both in zip(low, high, strict=True) for bound in both]
    assert list(map(int, told[-1].split())) == [model.layout.gap_ms, -(1 << 31), *bounds]
    for last_one in states.values():
        assert re.search(rf"{last_one} = \d+\s*(/\*.*\*/)?\s*}}", header), "no name is missing"
    main.write_text(main.read_text().replace("unsigned i;", "unsigned i; plush_begin(0, 0, 0, 0, 0);"))
    careless = subprocess.run([*words, "-c", "-o", str(tmp_path / "o")], capture_output=True, text=True)
    assert careless.returncode != 0 and "unused-result" in careless.stderr


def test_labels_cannot_break_out_of_comments(tmp_path: Path) -> None:
    model, bundle = made()
    table = bundle.gestures.to_dict()
    table["gestures"][0]["label"] = "a */ int b; /* \\"
    gestures = GestureSet.from_dict(table, "test")
    changed = IntegerModel(model.network, model.layout, gestures, model.smoothing)
    emit(changed, Bundle(bundle.arch, bundle.weights, bundle.layout, bundle.scaler, gestures), tmp_path / "out")
    assert "a */" not in (tmp_path / "out" / "plush_model.c").read_text()


def test_no_export_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is no export"):
        read_facts(tmp_path)
    (tmp_path / "export.json").write_text("{}")
    with pytest.raises(BadInput, match="lacks channels, classes"):
        read_facts(tmp_path)


def test_what_is_known_of_an_accelerometer_is_a_sentence() -> None:
    axes = ("x", "y", "z")
    found = [
        RestFacts(axes, 7948, 7948.0, "count", (4, -56, 42)),
        RestFacts(axes, 2_000_000, 2_000_000.0, "count", (0, 500_000, 0), is_estimated=True),
        RestFacts(axes, 9807, 9.807, "m/s²"),
        RestFacts(axes),
    ]
    assert [rest.sentence for rest in found] == [
        "at rest |x, y, z| is about 7,948 counts",
        "at rest |x, y, z| around 0, 500000, 0 is about 2,000,000 counts; estimated, as the recordings do not "
        "determine it",
        "at rest |x, y, z| is about 9.807 m/s²",
        "what |x, y, z| reads at rest, so its scale, is not known: the bundle is of an earlier PlushSense or trained "
        "on arrays; export --dataset DS measures it",
    ]
