"""Compile the C library to a WebAssembly module, or find the one that the wheel holds.

``hatch_build.py`` imports this where nothing but PlushSense's source is installed.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from plushsense.core.errors import ToolError

WEB = Path(__file__).parent / "web"
_C = WEB.with_name("c")
# SSE2 stands for web/c/emmintrin.h: the library's loops for it, in WebAssembly's own instructions.
_FLAGS = (
    *("-O2", "-ffreestanding", "-nostdlib", "-fvisibility=default", "-mbulk-memory", "-msimd128", "-D__SSE2__"),
    *(f"-Wl,{word}" for word in ("--no-entry", "--export-dynamic", "--export=__heap_base", "-s")),
    *(f"-I{folder}" for folder in (WEB / "c", _C, _C / "binding")),
    str(WEB / "c" / "plush_web.c"),
)


def module_file(*, calibrate: bool) -> Path:
    """Return where the wheel holds the module."""
    return WEB / f"plushsense{'-calibrate' * calibrate}.wasm"


@cache
def module(*, calibrate: bool) -> bytes:
    """Return the module that runs any image, or, with ``calibrate``, any of sensors that calibrate themselves.

    It is compiled here, else it is that of the wheel; the same compiler gives the same bytes.

    Raises:
        ToolError: if there is neither a compiler nor the wheel's module.
    """
    for compiler in compilers():
        if made := compiled(compiler, calibrate=calibrate):
            return made
    if (file := module_file(calibrate=calibrate)).is_file():
        return file.read_bytes()
    raise ToolError(
        "The page web/index.html was not written, because no compiler for WebAssembly is installed here and this "
        "PlushSense was not installed from a wheel that holds the module: install Debian's clang and lld, or the "
        "Python package ziglang, and export again."
    )


def compilers() -> list[tuple[str, ...]]:
    """Return the commands of the compilers for WebAssembly that may be installed here."""
    found: list[tuple[str, ...]] = []
    if (clang := shutil.which("clang")) is not None:
        found.append((clang, "--target=wasm32"))
    if importlib.util.find_spec("ziglang") is not None:
        found.append((sys.executable, "-m", "ziglang", "cc", "--target=wasm32-freestanding"))
    return found


def compiled(compiler: tuple[str, ...], *, calibrate: bool) -> bytes:
    """Return the module as a compiler makes it; empty where it lacks the target or the linker."""
    with tempfile.TemporaryDirectory(prefix="plushsense-wasm-") as work:
        out = Path(work) / "module.wasm"
        command = [*compiler, *_FLAGS, *["-DPLUSH_CALIBRATE"] * calibrate, "-o", str(out)]
        done = subprocess.run(command, cwd=work, stdin=subprocess.DEVNULL, capture_output=True)
        return out.read_bytes() if done.returncode == 0 and out.is_file() else b""
