"""The exported C where machines and compilers differ: ints of 16 bits, no GNU extensions, old standards."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from plushsense.deploy.package import ARDUINO, SKETCH
from plushsense.runtime.image import IntegerModel
from support.c_toy import C_FOLDER
from support.exports import bundle_of, exported

Packages = dict[str, tuple[Path, IntegerModel]]

STRICT = (
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Woverflow"),
    *("-Wshift-count-overflow", "-Werror"),
)
SMALL_INTS = {
    "avr-gcc": ("avr-gcc", "-mmcu=atmega1284p"),
    "clang-avr": ("clang", "--target=avr", "-mmcu=atmega1284p", "-Wshift-overflow"),
    "clang-msp430": ("clang", "--target=msp430", "-Wshift-overflow"),
}
STRING_H = (
    "#include <stddef.h>\nvoid *memcpy(void *, const void *, size_t);\nvoid *memset(void *, int, size_t);\n"
    "int memcmp(const void *, const void *, size_t);\nsize_t strlen(const char *);\n"
)


@pytest.mark.parametrize("compiler", SMALL_INTS)
def test_ints_of_16_bits_bring_no_warning(
    packages: Packages, needs: Callable[..., None], tmp_path: Path, compiler: str
) -> None:
    """Library, model, packages and examples; `verify --target avr` says that the numbers are right."""
    words = SMALL_INTS[compiler]
    needs(words[0])
    (tmp_path / "string.h").write_text(STRING_H)
    out = packages["plush-15"][0]
    sources = [out / "plushsense.c", out / "plush_model.c", *(out / "examples").glob("*/*.c")]
    for layout in ("accel-3", "plush-15"):  # whole numbers in the lines, and decimals
        folder = packages[layout][0]
        sources += [folder / ARDUINO / "src" / "plush_wire.c", *(folder / SKETCH).glob("*.c")]
    for source in [*sources, C_FOLDER / "plushsense.c"]:
        defines = ["-DPLUSH_HOOKS_ELSEWHERE", *["-DPLUSH_CALIBRATE"] * (source.parent == C_FOLDER)]
        includes = [f"-I{folder}" for folder in (tmp_path, source.parent, source.parents[2] / "src", out)]
        command = [*words, "-std=c99", "-ffreestanding", "-Os", *STRICT, *defines, *includes, "-S", "-o", "o", source]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_the_times_of_a_buffer_need_32_bits(packages: Packages, needs: Callable[..., None], tmp_path: Path) -> None:
    needs("avr-gcc")
    out = packages["accel-3"][0]
    # 8 x 9615 does not fit an int of 16 bits, and unsigned products wrap without a warning.
    text = '#include "plush_fifo.h"\n_Static_assert(PLUSH_FIFO_MARK * PLUSH_FIFO_PERIOD_US / 1000u == 76, "wraps");\n'
    words = ["avr-gcc", "-mmcu=atmega1284p", f"-I{out}", f"-I{out / 'examples/fifo'}", "-fsyntax-only", "-xc", "-"]
    done = subprocess.run(words, input=text, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_model_is_aligned_without_extensions(
    packages: Packages, needs: Callable[..., None], tmp_path: Path
) -> None:
    """A compiler that only knows C99 puts bytes where it likes; the library takes a model at multiples of 4 only."""
    needs("tcc", "nm")
    (tmp_path / "odd.h").write_text("const char odd[1] = {1};\n")
    source = packages["accel-3"][0] / "plush_model.c"
    subprocess.run(["tcc", "-std=c99", "-include", "odd.h", "-c", source, "-o", "o"], cwd=tmp_path, check=True)
    listed = subprocess.run(["nm", "o"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.split()
    assert int(listed[listed.index("odd") - 2], 16) == 0 and int(listed[listed.index("plush_model") - 2], 16) % 4 == 0


@pytest.mark.parametrize("language", ["c -std=c89", "c -std=c17", "c++ -std=c++98"])
def test_headers_of_any_standard(packages: Packages, c_compiler: str, tmp_path: Path, language: str) -> None:
    for out, _ in packages.values():
        headers = sorted(out.rglob("*.h"))
        assert len(headers) > 5
        text = "".join(f'#include "{file}"\n' for file in headers)
        words = [c_compiler, "-x", *language.split(), "-pedantic-errors", "-Wall", "-Wextra", "-Werror"]
        done = subprocess.run(
            [*words, "-Wno-long-long", f"-I{out}", "-fsyntax-only", "-"], input=text, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr


def test_the_default_network_fits_an_atmega1284(needs: Callable[..., None], tmp_path: Path) -> None:
    """Constants too lie in its 16 KiB of RAM; its stack needs one more."""
    needs("avr-gcc", "avr-size")
    out = exported(tmp_path / "out", bundle_of("plush-15", "14d1_19d2_19d4", "8,12,16"))
    (tmp_path / "main.c").write_text(
        '#include "plush_model.h"\n#include "plushsense.h"\nstatic uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];\n'
        "static plush_toy toy;\nint main(void)\n{\n"
        "    return plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory) != PLUSH_OK\n"
        "           || plush_push(&toy, 0, toy.sample) == 0;\n}\n"
    )
    sources = ["main.c", out / "plushsense.c", out / "plush_model.c"]
    words = ["avr-gcc", "-mmcu=atmega1284p", "-std=c99", "-Os", f"-I{out}", *sources, "-o", "program"]
    subprocess.run(words, cwd=tmp_path, check=True)
    listed = subprocess.run(["avr-size", "program"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    _, data, bss = map(int, listed.splitlines()[1].split()[:3])
    assert 8000 < data + bss < 15 << 10
