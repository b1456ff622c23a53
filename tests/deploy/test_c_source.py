"""The C as a text: no warning, no finding, nothing needed but three functions."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]

from plushsense.deploy.code import TOY_BYTES
from support.c_toy import C_FOLDER
from support.requirements import LONG

STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror"]


# As IRAM_ATTR and DRAM_ATTR of Espressif place them.
PLACED = [
    f'-DPLUSH_{what}=__attribute__((section(".{ram}.plush")))' for what, ram in (("CODE", "iram1"), ("CONST", "dram1"))
]


def assert_a_step_is_placed(file: Path) -> None:
    """Assert that the code of a step needs from other sections only what a gap or a fault does, and functions of C."""
    listed = subprocess.run(["xtensa-lx106-elf-objdump", "-t", "-r", file], check=True, capture_output=True, text=True)
    assert re.search(r"\.iram1\.plush\s+[0-9a-f]+ plush_push$", listed.stdout, re.M)
    assert re.search(r"\.text\S*\s+[0-9a-f]+ plush_begin$", listed.stdout, re.M)
    needed = set[str]()
    for records in listed.stdout.split("RELOCATION RECORDS FOR ")[1:]:
        if records.startswith("[.iram1"):
            needed |= {line.split()[2].split("+")[0] for line in records.splitlines()[2:] if len(line.split()) == 3}
    assert {".iram1.plush", ".dram1.plush"} <= needed
    rare = {".text.unlikely.forget", ".text.unlikely.lose"}
    own = {".iram1.plush", ".iram1.plush.literal", ".dram1.plush"}
    assert needed <= own | rare | {"memcpy", "memset", "__udivsi3", "__umodsi3"}


@pytest.mark.parametrize("cc", ["gcc", "clang"])
@pytest.mark.parametrize("plain", [[], ["-DPLUSH_PLAIN"], ["-DPLUSH_CALIBRATE"]], ids=["fast", "plain", "calibrate"])
@pytest.mark.exhaustive_for("calibrate-clang", "plain-clang", "plain-gcc")
def test_no_warning_and_three_functions_of_the_c_library(
    cc: str, plain: list[str], needs: Callable[..., None], tmp_path: Path
) -> None:
    """No floats, no heap; on a core of 32 bits no 64-bit division either."""
    needs(cc, "nm")
    allowed = {"memcpy", "memset", "memcmp"}
    for language, levels in ((["-std=c99"], ("-O0", "-O2", "-O3")), (["-x", "c++", "-std=c++11"], ("-O2",))):
        for level in levels:
            flags = [*language, level, *STRICT, *plain, "-fno-pic", "-fno-stack-protector"]
            subprocess.run([cc, *flags, "-c", C_FOLDER / "plushsense.c", "-o", tmp_path / "o"], check=True)
            listed = subprocess.run(["nm", "-u", tmp_path / "o"], check=True, capture_output=True, text=True)
            assert set(re.findall(r"U (\w+)", listed.stdout)) <= allowed


@pytest.mark.parametrize(
    ("cc", "flags", "also"),
    [
        ("arm-none-eabi-gcc", ["-mcpu=cortex-m4", "-mthumb"], set()),
        ("arm-none-eabi-gcc", ["-mcpu=cortex-m0", "-mthumb"], {"__aeabi_uidiv", "__aeabi_uidivmod", "__aeabi_llsl"}),
        ("xtensa-lx106-elf-gcc", ["-mlongcalls", "-ffunction-sections", *PLACED], {"__udivsi3", "__umodsi3"}),
    ],
    ids=["cortex-m4", "cortex-m0", "lx106"],
)
@pytest.mark.exhaustive_for("cortex-m4", "lx106")
def test_small_cores_need_no_long_division(
    cc: str, flags: list[str], also: set[str], needs: Callable[..., None], tmp_path: Path
) -> None:
    needs(cc)
    (tmp_path / "string.h").write_text(
        "#include <stddef.h>\nvoid *memcpy(void *, const void *, size_t);\nvoid *memset(void *, int, size_t);\n"
        "int memcmp(const void *, const void *, size_t);\n"
    )
    common = [cc, *flags, "-std=c99", "-ffreestanding", f"-I{tmp_path}", f"-I{C_FOLDER}"]
    for level in ("-O2", "-Os"):
        words = [*common, level, *STRICT, "-c", C_FOLDER / "plushsense.c", "-o", "plushsense.o"]
        subprocess.run(words, check=True, cwd=tmp_path)
        listed = subprocess.run(
            [cc.replace("gcc", "nm"), "-u", "plushsense.o"], check=True, cwd=tmp_path, capture_output=True, text=True
        )
        assert set(re.findall(r"U (\w+)", listed.stdout)) <= {"memcpy", "memset", "memcmp"} | also
        if PLACED[0] in flags:
            assert_a_step_is_placed(tmp_path / "plushsense.o")
    # No data that would have to be set up, and the size of a toy that exports speak of.
    sizes = subprocess.run(
        [cc.replace("gcc", "size"), "plushsense.o"], check=True, cwd=tmp_path, capture_output=True, text=True
    )
    assert sizes.stdout.splitlines()[1].split()[1:3] == ["0", "0"]
    (tmp_path / "size.c").write_text(
        f'#include "plushsense.h"\nchar fits[sizeof(plush_toy) <= {TOY_BYTES} ? 1 : -1];\n'
    )
    subprocess.run([*common, "-c", "size.c"], check=True, cwd=tmp_path)


@pytest.mark.exhaustive
def test_cppcheck(needs: Callable[..., None]) -> None:
    needs("cppcheck")
    for define in ("-UPLUSH_PLAIN", "-DPLUSH_PLAIN", "-DPLUSH_CALIBRATE"):
        done = subprocess.run(
            [
                "cppcheck",
                "--enable=all",
                "--inconclusive",
                "--std=c99",
                "--error-exitcode=1",
                "--quiet",
                define,
                # What a library is: its functions are called by others; its headers are the system's.
                "--suppress=unusedFunction",
                "--suppress=missingIncludeSystem",
                "--suppress=unusedStructMember",
                "-UPLUSH_CONST",  # an attribute of the build
                C_FOLDER / "plushsense.c",
            ],
            capture_output=True,
            text=True,
        )
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.exhaustive
def test_clang_tidy(needs: Callable[..., None]) -> None:
    needs("clang-tidy")
    checks = [
        "-*",
        "bugprone-*",
        "cert-*",
        "clang-analyzer-*",
        "misc-*",
        "performance-*",
        "portability-*",
        "readability-*",
        # Short names of arithmetic, the numbers of a format, braces of one-line bodies: a matter of taste.
        "-readability-identifier-length",
        "-readability-magic-numbers",
        "-readability-braces-around-statements",
        "-readability-isolate-declaration",
        "-readability-function-cognitive-complexity",
        "-readability-uppercase-literal-suffix",
        "-bugprone-easily-swappable-parameters",
        # Every size and offset fits 32 bits: read_model() sees to that.
        "-bugprone-implicit-widening-of-multiplication-result",
        # Asks for memcpy_s, which nobody has.
        "-clang-analyzer-security.insecureAPI.DeprecatedOrUnsafeBufferHandling",
        # That the best class has a probability is beyond the analyzer.
        "-clang-analyzer-core.DivideZero",
    ]
    # The analyzer follows the paths of a program for 8 s: two of the four have all but two lines.
    follow = [["-UPLUSH_PLAIN"], ["-DPLUSH_CALIBRATE", "-DPLUSH_PLAIN"]]
    for defines in (*follow, ["-DPLUSH_PLAIN"], ["-DPLUSH_CALIBRATE"]):
        chosen = checks if LONG or defines in follow else [*checks, "-clang-analyzer-*"]
        done = subprocess.run(
            [
                "clang-tidy",
                "--quiet",
                "--warnings-as-errors=*",
                f"--checks={','.join(chosen)}",
                C_FOLDER / "plushsense.c",
                "--",
                "-std=c99",
                *defines,
            ],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-4000:]
