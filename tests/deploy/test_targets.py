"""Programs on the host and on the emulators: what goes in and comes out, counts, stack, and every refusal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import BuildError, ConfigError, ProgramError, ToolError
from plushsense.deploy.targets import TARGETS, CompileSpec, build, missing_tools, require, target_named

BARE = [name for name, target in TARGETS.items() if target.counts]  # with start-up code of our own
WITH_BLOBS = [name for name, target in TARGETS.items() if target.runtime and not target.emulator]
Here = Callable[[str], str]

ECHO = """
#include "target.h"
extern const uint8_t BLOB[], BLOB_end[];
int main(void) {
    target_write(BLOB, (uint32_t)(BLOB_end - BLOB));
    return STATUS;
}
"""

COUNT = """
#include "target.h"
__attribute__((noinline)) static void turn(uint32_t n) { while (n-- > 0) __asm__ volatile(""); }
__attribute__((noinline)) static void deep(void) {
    volatile uint8_t bytes[1024];
    uint32_t i;
    for (i = 0; i < sizeof bytes; i++) bytes[i] = 1;
}
static volatile uint32_t thousand = 1000;
int main(void) {
    uint32_t values[4], then, i;
    for (i = 0; i < 3; i++) {
        uint32_t n = i * thousand;
        then = target_instructions();
        turn(n);
        values[i] = target_instructions() - then;
    }
    target_stack_paint();
    deep();
    values[3] = target_stack_used();
    target_write(values, sizeof values);
    return 0;
}
"""

ARITHMETIC = """
#include "target.h"
#include <string.h>
extern const uint8_t PAIRS[], PAIRS_end[];
int main(void) {
    const uint32_t *p = (const uint32_t *)(const void *)PAIRS, *end = (const uint32_t *)(const void *)PAIRS_end;
    uint8_t moved[16];
    for (; p != end; p += 2) {
        uint32_t a = p[0], b = p[1];
        int32_t sa, sb;
        uint64_t product = (uint64_t)a * b, square;
        uint32_t values[8];
        memcpy(&sa, p, 4);
        memcpy(&sb, p + 1, 4);
        square = product * product;
        values[0] = a / b;
        values[1] = a % b;
        values[2] = (uint32_t)(sa / sb);
        values[3] = (uint32_t)(sa % sb);
        values[4] = (uint32_t)product;
        values[5] = (uint32_t)(product >> 32);
        values[6] = (uint32_t)square;
        values[7] = (uint32_t)(square >> 32);
        target_write(values, sizeof values);
    }
    memset(moved, 7, sizeof moved);
    memcpy(moved + 1, "abcdefg", 7);
    memmove(moved + 3, moved + 1, 7);
    target_write(moved, sizeof moved);
    moved[0] = (uint8_t)(memcmp("abc", "abd", 3) < 0 && memcmp("abc", "abc", 3) == 0 && memcmp("b", "a", 1) > 0);
    target_write(moved, 1);
    return 0;
}
"""

TRAP = """
#include "target.h"
int main(void) { target_write("x", 1); *(volatile uint32_t *)0x90000001u = 1; return 0; }
"""


def written(folder: Path, text: str) -> Path:
    file = folder / "main.c"
    file.write_text(text)
    return file


@pytest.mark.parametrize("target", WITH_BLOBS)
def test_bytes_go_in_and_come_out_as_they_are(target: str, tmp_path: Path, target_here: Here) -> None:
    target_here(target)
    folder = tmp_path / 'with "marks" and blanks' if sys.platform != "win32" else tmp_path / "with blanks"
    folder.mkdir()
    blob = folder / "blob"
    blob.write_bytes(np.random.default_rng(1).integers(0, 256, 6_000_001, dtype=np.uint8).tobytes())
    source = written(folder, ECHO)
    program = build(target, [source], folder / "out", CompileSpec(flags=("-DSTATUS=0",)), blobs={"BLOB": blob})
    assert program.run(timeout_s=60) == blob.read_bytes()
    assert [o.is_file() for o in program.objects] == [True]
    blob.write_bytes(b"")
    assert (
        build(target, [source], folder / "out", CompileSpec(flags=("-DSTATUS=0",)), blobs={"BLOB": blob}).run() == b""
    )
    with pytest.raises(ProgramError, match="ended with status 5 instead of 0"):
        build(target, [source], folder / "out", CompileSpec(flags=("-DSTATUS=5",)), blobs={"BLOB": blob}).run()


@pytest.mark.parametrize("target", BARE)
def test_instructions_and_stack(target: str, tmp_path: Path, target_here: Here) -> None:
    program = build(target_here(target), [written(tmp_path, COUNT)], tmp_path)
    output = program.run()
    none, some, twice, stack = np.frombuffer(output, "<u4").tolist()
    assert program.run() == output
    each = (twice - some) / 1000
    # The clock's ticks are no whole instructions: a count may be one off.
    assert 2 <= round(each) <= 4 and abs(each - round(each)) <= 0.002
    assert abs((some - none) - round(each) * 1000) <= 4
    assert 1024 <= stack < 1024 + 96


@pytest.mark.parametrize("target", ["host", *BARE])
def test_division_products_and_memory_functions(target: str, tmp_path: Path, target_here: Here) -> None:
    rng = np.random.default_rng(2)
    pairs = rng.integers(0, 1 << 32, (300, 2), dtype=np.uint64) >> rng.integers(0, 32, (300, 2), dtype=np.uint64)
    edges = [0, 1, 2, 3, 0x7FFFFFFF, 0x80000000, 0x80000001, 0xFFFFFFFF]
    numbers = [*pairs.tolist(), *([a, b] for a in edges for b in edges)]
    numbers = [[a, b] for a, b in numbers if b and (a, b) != (0x80000000, 0xFFFFFFFF)]
    file = tmp_path / "pairs"
    file.write_bytes(np.array(numbers, "<u4").tobytes())
    source = written(tmp_path, ARITHMETIC)
    output = build(
        target_here(target), [source], tmp_path, CompileSpec(flags=("-fno-builtin",)), blobs={"PAIRS": file}
    ).run()
    values = np.frombuffer(output[:-17], "<u4").reshape(-1, 8).tolist()
    assert output[-17:] == b"\x07aaabcdefg\x07\x07\x07\x07\x07\x07\x01".replace(b"\x07aaabc", b"\x07ababc")
    mask = 0xFFFFFFFF
    for (a, b), row in zip(numbers, values, strict=True):
        sa, sb = (v - (1 << 32) if v >> 31 else v for v in (a, b))
        quotient = abs(sa) // abs(sb) * (1 if (sa < 0) == (sb < 0) else -1)
        square = (a * b) ** 2
        assert row == [
            *(a // b, a % b, quotient & mask, (sa - quotient * sb) & mask),
            *(a * b & mask, a * b >> 32, square & mask, square >> 32 & mask),
        ]


@pytest.mark.parametrize("target", BARE)
def test_a_crash_ends_the_program(target: str, tmp_path: Path, target_here: Here) -> None:
    with pytest.raises(ProgramError, match="status 98"):
        build(target_here(target), [written(tmp_path, TRAP)], tmp_path).run(timeout_s=20)


@pytest.mark.parametrize("target", ["host", "xtensa"])
def test_a_program_that_hangs_is_stopped(target: str, tmp_path: Path, target_here: Here) -> None:
    source = written(tmp_path, 'int main(void) { for (;;) __asm__ volatile(""); }')
    with pytest.raises(ProgramError, match=r"did not end within 0\.3 s"):
        build(target_here(target), [source], tmp_path).run(timeout_s=0.3)


COMPILED = [name for name, target in TARGETS.items() if target.runtime and name != "tcc"]  # it has words of its own


@pytest.mark.parametrize("target", COMPILED)
def test_what_a_compiler_refuses(target: str, tmp_path: Path, target_here: Here) -> None:
    target_here(target)
    with pytest.raises(BuildError, match="refused main.c: .*error: expected expression") as refusal:
        build(target, [written(tmp_path, "int main(void) { return f(; }")], tmp_path)
    assert "main.c:1" in refusal.value.output
    with pytest.raises(BuildError, match="refused the program: .*undefined reference to .f'"):
        build(target, [written(tmp_path, "int f(void); int main(void) { return f(); }")], tmp_path)
    with pytest.raises(BuildError, match="unused"):
        build(
            target,
            [written(tmp_path, "int main(void) { int u; return 0; }")],
            tmp_path,
            CompileSpec(flags=("-Wall", "-Werror")),
        )


def test_another_compiler_on_the_host(tmp_path: Path, needs: Callable[..., None]) -> None:
    needs("gcc", "clang")
    source = written(tmp_path, '#include "target.h"\nint main(void) { target_write(__VERSION__, 5); return 0; }')
    assert (
        build("host", [source], tmp_path / "a", CompileSpec("clang")).run()
        != build("host", [source], tmp_path / "b").run()
    )


def test_missing_tools_are_named_by_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert missing_tools("xtensa") == ["gcc-xtensa-lx106", "qemu-system-misc"]
    assert missing_tools("cortex-m4") == ["gcc-arm-none-eabi", "qemu-system-arm", "libnewlib-arm-none-eabi"]
    assert missing_tools("riscv32") == [
        "gcc-riscv64-unknown-elf",
        "qemu-system-misc",
        "picolibc-riscv64-unknown-elf",
    ]
    assert missing_tools("host", cc="clang") == ["clang"]
    with pytest.raises(ToolError, match="install Debian's gcc-xtensa-lx106 qemu-system-misc .*, or leave this target"):
        require("xtensa")
    with pytest.raises(ToolError):
        build("host", [], tmp_path)
    with pytest.raises(ConfigError, match=r"accepted are host, xtensa.*Did you mean 'xtensa'\?"):
        target_named("xtens")


def test_a_changed_header_is_compiled_again_wherever_it_lies(tmp_path: Path, c_compiler: str) -> None:
    sources, first, second = (tmp_path / name for name in ("sources", "first", "second"))
    for folder in (sources, first, second):
        folder.mkdir()
    (first / "value.h").write_text("#define VALUE 1\n")
    (second / "value.h").write_text("#define VALUE 1\n")
    main = sources / "main.c"
    main.write_text('#include "value.h"\nint main(void) { return VALUE; }\n')

    def objects() -> tuple[Path, ...]:
        return build("host", [main], tmp_path / "out", include=[first, second], object_folder=tmp_path).objects

    one = objects()
    assert objects() == one
    (first / "value.h").write_text("#define VALUE 2\n")
    two = objects()
    (sources / "value.h").write_text("#define VALUE 3\n")
    assert len({one, two, objects()}) == 3
