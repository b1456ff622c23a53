"""Install a wheel without extras into an empty environment of every Python found, and take recordings to C there.

Usage: ``python .ci/check_wheel.py dist/plushsense-*.whl``. The network is trained beforehand by the Python that runs
this, which needs the extra ``train``; everything is of the virtual toy. The wheel must hold the WebAssembly modules, as
a compiler here makes them once more, and an export without a compiler must write its page with them.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from plushsense.deploy.wasm import module, module_file

ROOT = Path(__file__).parents[1]
VERSIONS = ("3.11", "3.12", "3.13", "3.14")
BEFORE = (
    "simulate RECORDINGS --people 2 --repetitions 1 --dataset FIRST",
    "train FIRST --epochs 1 --out model.plush",
)
COMMANDS = (
    "import RECORDINGS DS --layout plush-15",
    "check DS",
    "info model.plush",
    "live --device virtual://?speed=0&seconds=10 --model model.plush",
    "export model.plush OUT",
)
FOUND = {"check": 1}  # the status of findings, which two simulated people have


def call(program: Path | str, words: list[str], folder: Path, accepted: tuple[int, ...] = (0,)) -> str:
    """Return what a program prints; end with its messages if its status is not accepted."""
    # Without the system's programs, export has no compiler.
    env = os.environ | ({"PATH": str(Path(program).parent)} if words[0] == "export" else {})
    done = subprocess.run([str(program), *words], cwd=folder, capture_output=True, text=True, env=env)
    if done.returncode not in accepted:
        sys.exit(f"{' '.join([str(program), *words])}: status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def runs(python: str) -> bool:
    """Tell whether this program is a Python and not a shim of one that is not chosen."""
    return subprocess.run([python, "--version"], capture_output=True).returncode == 0


def check_modules(wheel: Path) -> None:
    """End with what is wrong with the WebAssembly modules of the wheel."""
    with zipfile.ZipFile(wheel) as files:
        for calibrate in (False, True):
            name = f"plushsense/deploy/web/{module_file(calibrate=calibrate).name}"
            if name not in files.namelist() or files.read(name) != module(calibrate=calibrate):
                sys.exit(f"{wheel.name}: {name} is missing, or not what the compiler here makes")


def main() -> None:
    """Check the wheel that is named, or end with the command that failed."""
    if len(sys.argv) != 2 or not (wheel := Path(sys.argv[1]).resolve()).is_file():
        sys.exit("Give the wheel: python .ci/check_wheel.py dist/plushsense-VERSION-py3-none-any.whl")
    check_modules(wheel)
    pythons = [path for version in VERSIONS if (path := shutil.which(f"python{version}")) and runs(path)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plushsense = Path(sys.executable).parent / "plushsense"
        for command in BEFORE:
            call(plushsense, command.split(), folder)
        for python in pythons or [sys.executable]:
            for made in ("venv", "DS", "OUT"):
                shutil.rmtree(folder / made, ignore_errors=True)
            call(python, ["-m", "venv", "venv"], folder)
            there = folder / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
            pip = ["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
            call(there / "python", [*pip, "-c", str(ROOT / "constraints.txt"), str(wheel)], folder)
            for command in COMMANDS:
                words = command.split()
                call(there / "plushsense", words, folder, (0, FOUND.get(words[0], 0)))
            if not (folder / "OUT" / "web" / "index.html").is_file():
                sys.exit("export wrote no web/index.html")
            version = call(there / "python", ["--version"], folder).strip()
            print(f"{wheel.name} without extras on {version}: import, check, info, live and export work.")


if __name__ == "__main__":
    main()
