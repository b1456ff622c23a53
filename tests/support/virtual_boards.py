"""The example firmware on made-up boards: built with the compilers of this machine, and played."""

from __future__ import annotations

import os
import re
import subprocess
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

from plushsense.core.layouts import Layout
from plushsense.deploy.golden import ANSWER
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE, SKETCH
from plushsense.devices.wire import LineParser
from plushsense.runtime.image import IntegerModel

BOARDS = Path(__file__).parents[1] / "deploy" / "boards"
WARNINGS = ("-Wall", "-Wextra", "-Werror")
SECONDS = 14


def run(*words: object) -> None:
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


OBJECTS = Path()  # the folder of object files, which `keeping_objects` sets


@cache
def compiled(source: Path, *words: object) -> Path:
    """Return the object file of a source. Nothing is compiled twice whose texts, own headers included, are the same."""
    command = [str(w) for w in words]
    folders = [source.parent, *(Path(w[2:]) for w in command if w.startswith("-I"))]
    headers = [file for folder in folders for file in sorted(folder.rglob("*.h"))]
    texts, seen = [source.read_bytes()], set[str]()
    for text in texts:
        included = re.findall(rb'#\s*include\s*[<"]([^>"]+)', text)
        names = {Path(name.decode()).name for name in included} - seen
        seen |= names
        texts += [file.read_bytes() for file in headers if file.name in names]

    def matters(word: str) -> bool:
        # A definition matters where its name is.
        name = word[2:].split("=")[0].encode()
        return not word.startswith("-I") and (not word.startswith("-D") or any(name in text for text in texts))

    key = sha256(repr([w for w in command if matters(w)]).encode())
    for text in texts:
        key.update(sha256(text).digest())
    built = OBJECTS / f"{key.hexdigest()}.o"
    if not built.exists():
        draft = built.with_suffix(f".{os.getpid()}")
        run(*words, "-c", source, "-o", draft)
        draft.replace(built)
    return built


def arduino(out: Path, to: Path, *defines: str, compiler: tuple[str, str] = ("gcc", "g++")) -> Path:
    """PlushToy and the library, built for the made-up Arduino."""
    src, sketch, program = out / ARDUINO / "src", out / SKETCH, to / "toy"
    sources = [*sorted(src.glob("*.c")), *sorted(sketch.glob("*.c"))]
    words: list[object] = [compiler[0], "-std=c99", "-Wpedantic", *WARNINGS, "-O1", f"-I{src}"]
    objects = [compiled(source, *words) for source in sources]
    # The Arduino IDE takes a sketch for C++ and puts Arduino.h before it.
    includes = [f"-I{p}" for p in (BOARDS / "arduino", src, sketch)]
    esp32 = ["-DARDUINO_ARCH_ESP32"]
    words = [compiler[1], "-std=c++17", *WARNINGS, "-O1", *esp32, *(f"-D{d}" for d in defines), *includes]
    run(*words, BOARDS / "arduino" / "run.cpp", *objects, "-o", program)
    return program


def idf(out: Path, to: Path, *defines: str, compiler: str = "gcc") -> Path:
    """The ESP-IDF example and the component, built for the made-up ESP-IDF, from the files that CMake is told."""
    sources = []
    for folder in (out / IDF, out / IDF_EXAMPLE / "main"):
        sources += [folder / name for name in re.findall(r'"([^"]+\.c)"', (folder / "CMakeLists.txt").read_text())]
    includes = [f"-I{p}" for p in (BOARDS / "idf", out / IDF / "include")]
    words: list[object] = [compiler, "-std=gnu17", *WARNINGS, "-O1", *(f"-D{d}" for d in defines), *includes]
    run(compiler, *(compiled(source, *words) for source in [*sources, BOARDS / "idf" / "run.c"]), "-o", to / "toy")
    return to / "toy"


BUILDS = {"arduino": arduino, "idf": idf}


def play(program: Path, *words: object, seconds: float = SECONDS) -> tuple[bytes, list[list[int]]]:
    """What the toy sent, and what changed on its pins: rows of ms, pin, value."""
    done = subprocess.run([str(w) for w in (program, seconds, *words)], capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout, [[int(v) for v in row.split()] for row in done.stderr.decode().splitlines()]


def frames_of(layout: Layout, sent: bytes) -> np.ndarray:
    """The frames (n, 1 + C) that the computer reads of what the toy sent."""
    parser = LineParser(layout)
    found = parser.feed(sent)
    parser.finish()
    assert parser.counters.malformed == 0
    return np.array([[f.device_ms, *f.values] for f in found], dtype=np.int64)


def told(answers: np.ndarray, model: IntegerModel, since: int = 0) -> list[str]:
    """Answers as the example tells them."""
    labels = model.gestures.labels
    return [
        f"{(ms - since) & 0xFFFFFFFF} {f'{gesture} {sure}/32768 {labels[gesture]}' if state else 'warming'}"
        for kind, _, ms, _, state, gesture, _, sure, *_ in answers.astype(np.int64).tolist()
        if kind == ANSWER
    ]
