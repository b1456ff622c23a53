"""The C library as tests drive it, compiled once a session; an export, and recordings for it."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.dataset.importing.importers import import_recordings
from plushsense.deploy.package import emit
from plushsense.deploy.quantize import integer_model
from plushsense.runtime.image import IntegerModel
from support.c_toy import C_FOLDER, TOY_C, compiled
from support.exports import LAYOUTS, bundle_of, exported
from support.kept_objects import keeping_answers, keeping_objects
from support.requirements import missing
from support.sharing import built_once

Packages = dict[str, tuple[Path, IntegerModel]]


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
    return compiled(c_compiler, tmp_path_factory)


@pytest.fixture(scope="session")
def plain_c_library(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The library as small cores without such instructions compile it."""
    return compiled(c_compiler, tmp_path_factory, "-DPLUSH_PLAIN")


@pytest.fixture(scope="session")
def calibrated_library(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The library for models whose sensors calibrate themselves."""
    return compiled(c_compiler, tmp_path_factory, "-DPLUSH_CALIBRATE")


@pytest.fixture(scope="session")
def sanitized(c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Programs that read a file of cases under the address and undefined-behaviour sanitizers."""
    folder = built_once(tmp_path_factory, "sanitized", lambda draft: _sanitize(c_compiler, draft))
    return sorted(folder.glob("program*"))


def _sanitize(c_compiler: str, folder: Path) -> None:
    # Where sums and differences wrap on purpose: modulo 2^32 they come out right. Anywhere else it is a fault.
    wrapping = (
        *("square", "surplus", "alone", "pair", "activations", "dense", "interpolate"),
        *("bits_of", "distance_of", "from_zero", "convolve", "invariants"),
    )
    (folder / "wrapping").write_text("".join(f"fun:{name}\n" for name in wrapping))
    for n, (cc, flags) in enumerate(
        (
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
        )
    ):
        if shutil.which(cc) is None:
            continue
        out = folder / f"program-{n}-{cc}"
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


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small export, not to be changed."""
    made = built_once(tmp_path_factory, "small", lambda draft: exported(draft / "out", bundle_of("plush-15")))
    return made / "out"


@pytest.fixture
def own(small: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(small, tmp_path / "out"))


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people: one with a session stream whose clock starts again, one with two recordings only."""
    raw = tmp_path_factory.mktemp("raw")
    rng = np.random.default_rng(0)

    def rows(n: int, first: int, ms: int) -> list[str]:
        walk = np.rint(np.cumsum(rng.normal(size=(n, 3)), axis=0) * 100).astype(int)
        return [f"{first + 10 * i}, {ms + 10 * i}, {x}, {y}, {z}" for i, (x, y, z) in enumerate(walk.tolist())]

    (raw / "A").mkdir()
    (raw / "B").mkdir()
    header = "Processing Timestamp (ms), Arduino Timestamp (ms), X, Y, Z"
    stream = [*rows(300, 1_600_000_000_000, 5000), *rows(300, 1_600_000_010_000, 40)]
    (raw / "A" / "fulldatastream.csv").write_text("\n".join(stream) + "\n")
    (raw / "A" / "Tap_1600000000100_80.csv").write_text("\n".join([header, *stream[10:90]]) + "\n")
    for n, label in ((120, "Tap"), (60, "Hit")):
        lines = [header, *rows(n, 1_600_000_100_000 + n, 4_294_967_000 if n == 60 else 70)]
        (raw / "B" / f"{label}_{1_600_000_100_000 + n}_{n}.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path_factory.mktemp("recorded") / "ds"
    import_recordings(raw, out, layout="accel-3")
    return out


@pytest.fixture(scope="session")
def packages(tmp_path_factory: pytest.TempPathFactory, needs: Callable[..., None]) -> Packages:
    """An export with packages for each built-in layout, and its model; what builds them is here."""
    needs("gcc", "g++", "clang", "clang++")
    found = {}
    for layout in LAYOUTS:
        bundle = bundle_of(layout, window=60)
        model = integer_model(bundle)
        write = partial(emit, model, bundle)
        made = built_once(tmp_path_factory, f"packages-{layout}", lambda draft, write=write: write(draft / "out"))
        found[layout] = made / "out", model
    return found


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Compile once for all tests what is the same, flags included: object files are named by a hash of it."""
    with keeping_objects(tmp_path_factory):
        yield


@pytest.fixture(scope="session", autouse=True)
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Make the scenarios of a model, and its answers to frames, once for all tests: they follow from these alone."""
    with keeping_answers(tmp_path_factory):
        yield
