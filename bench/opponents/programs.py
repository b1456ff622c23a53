"""Programs in C to compare: PlushSense, the plain window, and the output of onnx2c; `running` runs them."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass, field
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from opponents.case import Case

HERE = Path(__file__).resolve().parent
STRICT = ("-std=gnu99", "-Wall", "-Wextra", "-Werror")


class CannotBuild(Exception):
    """A program cannot be built; the message states what is missing, or is that of the compiler."""


@dataclass(frozen=True)
class Entry:
    """A row of the table.

    ``reads`` is the input of a decision: ``frames``, ``stream`` (network only) or ``window``. Sizes are in bytes, None
    where they are not known.
    """

    name: str
    family: str
    reads: str
    command: list[str]
    model_bytes: int | None = None
    code_bytes: int | None = None
    memory_bytes: int | None = None
    versions: dict[str, str] = field(default_factory=dict)


def _call(command: list[str], folder: Path) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    except OSError as cause:
        raise CannotBuild(f"{command[0]}: {cause.strerror}") from None
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise CannotBuild(f"{command[0]}: {lines[0][:200] if lines else done.returncode}")
    return done.stdout


def _sizes(path: Path) -> tuple[int, int]:
    """Return the bytes of code with constants, and of written memory."""
    text, data, bss = _call(["size", path.name], path.parent).splitlines()[1].split()[:3]
    return int(text) + int(data), int(data) + int(bss)


class Workshop:
    """Builds programs in one folder with one compiler."""

    def __init__(self, folder: Path, cc: str = "gcc") -> None:
        self.folder, self.cc = folder, cc
        marks = folder / "marks.o"
        try:
            _call([cc, "-O2", "-fPIC", "-c", str(HERE / "marks.c"), "-o", str(marks)], folder)
            _call([cc, "-shared", str(marks), "-o", str(folder / "marks.so")], folder)
            self.marks: list[str] = [str(marks)]
        except CannotBuild:  # without valgrind's headers
            self.marks = ["-DWITHOUT_MARKS"]

    def version(self) -> str:
        """Return the first line of the compiler's version."""
        return _call([self.cc, "--version"], self.folder).splitlines()[0]

    def program(self, name: str, objects: list[Path]) -> list[str]:
        """Link objects with the loop of `loop.c`."""
        out = self.folder / name
        parts = [str(HERE / "loop.c"), *self.marks, *map(str, objects), "-lm", "-o", str(out)]
        _call([self.cc, "-O2", *STRICT, *parts], self.folder)
        return [str(out), str(self.folder)]

    def compiled(self, source: Path, name: str, *flags: str) -> Path:
        """Compile one object."""
        out = self.folder / f"{name}.o"
        _call([self.cc, *flags, f"-I{self.folder}", "-c", str(source), "-o", str(out)], self.folder)
        return out


def ours(case: Case, shop: Workshop) -> list[Entry]:
    """Return the entries of PlushSense's C: default build, plain C (PLUSH_PLAIN), and the network alone."""
    (shop.folder / "model.bin").write_bytes(case.model.to_bytes())
    model = (shop.folder / "model.bin").stat().st_size
    entries = []
    with as_file(files("plushsense.deploy") / "c") as sources:
        memory = int(_call(_asking(shop, sources), shop.folder))
        include = f"-I{sources}"
        for level in ("-O2", "-O3"):
            for what, reads, extra in (
                ("frames to answer", "frames", ()),
                ("network only", "stream", ("-DNETWORK_ONLY",)),
                ("frames to answer, plain C", "frames", ("-DPLUSH_PLAIN",)),
            ):
                unit = f"ours{len(entries)}"
                library = shop.compiled(sources / "plushsense.c", f"library-{unit}", "-std=c99", level, *extra)
                built = shop.compiled(HERE / "ours.c", unit, "-std=gnu99", level, include, *extra)
                command, code = shop.program(f"run-{unit}", [built]), _sizes(library)[0]
                entries.append(Entry(f"PlushSense C {level}, {what}", "ours", reads, command, model, code, memory))
    return entries


def _asking(shop: Workshop, sources: Path) -> list[str]:
    """Return a program that prints the memory of the model, including its struct."""
    out = shop.folder / "memory"
    if not out.exists():
        source = shop.folder / "memory.c"
        source.write_text(
            '#include "plushsense.h"\n#include <stdio.h>\nint main(void)\n{\n    static uint8_t model[1 << 20];\n'
            '    FILE *f = fopen("model.bin", "rb");\n'
            "    uint32_t n = f == NULL ? 0 : (uint32_t)fread(model, 1, sizeof model, f);\n"
            '    printf("%u\\n", (unsigned)(plush_memory_bytes(model, n) + sizeof(plush_toy)));\n    return 0;\n}\n'
        )
        parts = [str(source), str(sources / "plushsense.c"), f"-I{sources}", "-o", str(out)]
        _call([shop.cc, "-O1", *parts], shop.folder)
    return [str(out)]


def _table(name: str, values: NDArray[np.float32]) -> str:
    numbers = ", ".join(f"{float(v):.9g}f" if "." in f"{float(v):.9g}" else f"{float(v):.9e}f" for v in values.ravel())
    return f"static const float {name}[{values.size}] = {{{numbers}}};\n"


def _header(case: Case) -> str:
    arch, w = case.arch, case.weights
    padded = case.form == "window"
    text, calls, length, room = "", [], case.length, case.length * arch.channels
    for i, (layer, read) in enumerate(zip(arch.layers, arch.inputs, strict=True)):
        text += _table(f"w{i}", np.ascontiguousarray(w[f"w{i}"].transpose(2, 1, 0))) + _table(f"b{i}", w[f"b{i}"])
        rows = layer.reach if padded else 0
        room = max(room, (rows + length) * read)
        calls.append(f"pad({rows}, {length}, {read});")
        length = length if padded else length - layer.reach
        room = max(room, length * layer.filters)
        calls.append(f"layer({length}, {read}, {layer.filters}, {layer.kernel}, {layer.dilation}, w{i}, b{i});")
    text += _table("dense_w", w["dense_w"]) + _table("dense_b", w["dense_b"])
    numbers = {
        "CHANNELS": arch.channels, "WINDOW": case.length, "CLASSES": arch.classes, "FEATURES": arch.filters[-1],
        "POSITIONS": length, "ROOM": room, "MOST_FILTERS": max(arch.filters), "LAYERS": " ".join(calls),
    }  # fmt: skip
    return "".join(f"#define {name} {value}\n" for name, value in numbers.items()) + text


def plain_window(case: Case, shop: Workshop) -> list[Entry]:
    """Build the float C of this bench: simple loops over the whole window."""
    (shop.folder / "network.h").write_text(_header(case))
    entries = []
    for level in ("-O2", "-O3"):
        built = shop.compiled(HERE / "window.c", f"window{level}", level, *STRICT, "-Wno-unused-variable")
        flash, memory = _sizes(built)
        name = f"plain float C of this bench {level}"
        entries.append(
            Entry(name, "plain C", "window", shop.program(f"run-window{level}", [built]), None, flash, memory)
        )
    return entries


def onnx2c(case: Case, shop: Workshop, tool: str, model: Path) -> list[Entry]:
    """Build what onnx2c generates from ``model``."""
    found = shutil.which(tool)
    if found is None:
        raise CannotBuild("onnx2c was not found: build github.com/kraiskil/onnx2c and give --onnx2c PATH")
    source = shop.folder / "onnx2c.c"
    source.write_text(_call([found, str(model)], shop.folder))
    (shop.folder / "network.h").write_text(_header(case))
    entries = []
    for level in ("-O2", "-O3"):
        network = shop.compiled(source, f"onnx2c{level}", level)
        caller = shop.compiled(HERE / "window.c", f"call-onnx2c{level}", level, "-DONNX2C")
        flash, memory = _sizes(network)
        command = shop.program(f"run-onnx2c{level}", [network, caller])
        entries.append(Entry(f"onnx2c float C {level}", "portable C", "window", command, None, flash, memory))
    return entries
