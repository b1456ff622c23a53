"""The C library as tests drive it: compiled once a session."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from c_toy import C_FOLDER, TOY_C, compiled
from conftest import missing


@pytest.fixture(scope="session")
def needs() -> Callable[..., None]:
    """Says that a test needs these programs."""

    def look(*tools: str) -> None:
        for tool in tools:
            if shutil.which(tool) is None:
                missing("compilers", f"{tool} is not installed")

    return look


@pytest.fixture(scope="session")
def c_library(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The library as a PC compiles it: several multiplications at once."""
    return compiled(c_compiler, tmp_path_factory.mktemp("fast"))


@pytest.fixture(scope="session")
def plain_c_library(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The library as small cores without such instructions compile it."""
    return compiled(c_compiler, tmp_path_factory.mktemp("plain"), "-DPLUSH_PLAIN")


@pytest.fixture(scope="session")
def sanitized(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Programs that read a file of cases under the address and undefined-behaviour sanitizers."""
    folder = tmp_path_factory.mktemp("sanitized")
    # Where sums and differences wrap on purpose: modulo 2^32 they come out right. Anywhere else it is a fault.
    wrapping = ("square", "surplus", "four_sums", "advance", "dense", "interpolate", "read_inputs")
    (folder / "wrapping").write_text("".join(f"fun:{name}\n" for name in wrapping))
    programs = []
    for cc, flags in (
        (c_compiler, ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]),
        (c_compiler, ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DPLUSH_PLAIN"]),
        # Traps, because the runtime of clang's sanitizers is a package of its own.
        (
            "clang",
            [
                "-fsanitize=undefined,implicit-conversion,unsigned-integer-overflow",
                "-fsanitize-trap=all",
                "-DPLUSH_PLAIN",
                f"-fsanitize-ignorelist={folder / 'wrapping'}",
            ],
        ),
    ):
        if shutil.which(cc) is None:
            continue
        out = folder / f"{cc}{len(programs)}"
        subprocess.run(
            [
                cc,
                "-std=c99",
                "-g",
                "-O1",
                "-DALONE",
                *flags,
                f"-I{C_FOLDER}",
                str(TOY_C),
                "-o",
                str(out),
            ],
            check=True,
        )
        programs.append(out)
    return programs
