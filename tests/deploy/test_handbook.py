"""The README of an export: this model's figures, loud about simulations and leaks, its programs compile."""

from __future__ import annotations

import re
import subprocess
from dataclasses import replace
from pathlib import Path

from plushsense.deploy.code import read_facts
from plushsense.deploy.package import ARDUINO, emit
from plushsense.deploy.quantize import integer_model
from plushsense.runtime.image import IntegerModel
from support.exports import bundle_of
from support.virtual_boards import WARNINGS, run

Packages = dict[str, tuple[Path, IntegerModel]]


def test_the_programs_in_the_readme_compile(packages: Packages, tmp_path: Path, c_compiler: str) -> None:
    out = packages["plush-15"][0]
    programs = re.findall(r"```c\n(.*?)```", (out / "README.md").read_text(encoding="utf-8"), re.S)
    assert len(programs) == 2
    for text in programs:
        (tmp_path / "x.c").write_text(text)
        run(c_compiler, "-std=c99", *WARNINGS, f"-I{out}", "-c", tmp_path / "x.c", "-o", tmp_path / "x.o")


_SWAPPED = """
#include <stdio.h>
#include <string.h>

static uint8_t other[PLUSH_MODEL_BYTES];
static int called;

static void on_event(const plush_toy *of, void *user)
{
    (void)of;
    (void)user;
    called++;
}

int main(void)
{
    int32_t values[PLUSH_MODEL_CHANNELS] = {0};
    uint32_t ms;
    int status;

    begin();
    toy.on_event = on_event;
    for (ms = 0; ms < 3000; ms += 10) {
        values[0] = (int32_t)(ms % 70);
        plush_push(&toy, ms, values);
    }
    toy.event.what = PLUSH_BEGUN; /* one goes on */
    called = 0;
    memcpy(other, plush_model, sizeof other);
    other[sizeof other / 2] ^= 1;
    status = (int)swap(other, sizeof other);
    printf("%d %d %d", status, called, (int)toy.answer.state);
    other[sizeof other / 2] ^= 1;
    status = (int)swap(other, sizeof other);
    printf(" %d %d %d %d", status, called, (int)toy.answer.state, toy.on_event == on_event);
    return 0;
}
"""


def test_the_swap_of_the_readme_keeps_the_old_model_or_all_that_must_stay(
    packages: Packages, tmp_path: Path, c_compiler: str
) -> None:
    out = packages["plush-15"][0]
    text = re.findall(r"```c\n(.*?)```", (out / "README.md").read_text(encoding="utf-8"), re.S)[1]
    (tmp_path / "x.c").write_text(text + _SWAPPED)
    sources = [tmp_path / "x.c", out / "plushsense.c", out / "plush_model.c"]
    run(c_compiler, "-std=c99", *WARNINGS, f"-I{out}", *sources, "-o", tmp_path / "x")
    # Damaged: an error, nothing told, tracking as before. Good: one end, warming, the callback is there.
    assert subprocess.run([tmp_path / "x"], capture_output=True, check=True).stdout == b"3 0 1 0 1 0 1"


def with_provenance(tmp_path: Path, **provenance: object) -> str:
    bundle = replace(bundle_of(window=60), provenance=provenance)
    emit(integer_model(bundle), bundle, tmp_path / "out")
    return (tmp_path / "out" / "README.md").read_text(encoding="utf-8")


SCORES = {"split": "validation-subjects", "leaky": False, "windows": 321, "accuracy": 0.6789, "macro_f1": 0.5432}


def test_the_readme_tells_what_8_bits_cost(tmp_path: Path) -> None:
    int8 = {"accuracy": 0.671, "macro_f1": 0.541, "agreement": 0.985}
    text = with_provenance(tmp_path, dataset="gestures", scores=SCORES | {"int8": int8})
    assert "| accuracy, macro-F1 in 8 bits | 0.671, 0.541 |" in text and "98.5 % of the windows" in text


def test_the_readme_tells_this_model(tmp_path: Path) -> None:
    people = ["Anna", "P02", "none"]  # at rest there is nobody
    text = with_provenance(tmp_path, dataset="gestures | of 2", scores=SCORES, subjects=people, simulated=False)
    facts = read_facts(tmp_path / "out")
    for figure in ("parameters", "macs_per_step", "model_bytes", "memory_bytes", "span"):
        assert f"{getattr(facts, figure):,}" in text
    for sentence in (
        facts.symbol,
        "50 ms",
        "0.56 s",
        "0.679",
        "0.543",
        "321 windows",
        "`validation-subjects`",
        "2 people",
    ):
        assert sentence in text
    assert "gestures \\| of 2" in text
    for word in ("SIMULATION", "LEAKY", "Anna", "P02"):
        assert word not in text
    order = [text.index(f"| {i} | {c} | `PLUSH_CHANNEL_{c.upper()}` |") for i, c in enumerate("xyz")]
    assert order == sorted(order)
    assert "Nobody told an affect" not in text


def test_simulation_and_leaks_are_stated(tmp_path: Path) -> None:
    text = with_provenance(tmp_path, dataset="virtual toy", simulated=True, scores=SCORES | {"leaky": True})
    assert text.splitlines()[2].startswith("> **SIMULATION.**")
    assert "virtual toy (SIMULATION)" in text and "**LEAKY**" in text
    assert "SIMULATION" in (tmp_path / "out" / ARDUINO / "library.properties").read_text(encoding="utf-8")
