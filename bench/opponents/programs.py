"""Programs in C to compare: PlushSense, and CMSIS-NN on an emulated chip."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from opponents.case import Case
from opponents.tables import OUR_ROW, PLAIN_ROW, WHOLE_ROW

from plushsense.deploy import profile
from plushsense.deploy.code import read_facts
from plushsense.deploy.emit import emit
from plushsense.deploy.targets import build

HERE = Path(__file__).resolve().parent
STRICT = ("-std=gnu99", "-Wall", "-Wextra", "-Werror")


class CannotBuild(Exception):
    """A program cannot be built; the message states what is missing, or is that of the compiler."""


@dataclass(frozen=True)
class Entry:
    """A program that decides on this computer.

    ``reads`` is the input of a decision: ``frames``, ``inputs`` (our network only), or that of an algorithm: ``window``
    or ``stream``. Sizes are in bytes, None where they are not known.
    """

    name: str
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
        for name, reads, extra in (
            (OUR_ROW, "inputs", ("-DNETWORK_ONLY",)),
            (WHOLE_ROW, "frames", ()),
            (PLAIN_ROW, "frames", ("-DPLUSH_PLAIN",)),
        ):
            unit = f"ours{len(entries)}"
            library = shop.compiled(sources / "plushsense.c", f"library-{unit}", "-std=c99", "-O2", *extra)
            built = shop.compiled(HERE / "ours.c", unit, "-std=gnu99", "-O2", f"-I{sources}", *extra)
            command, code = shop.program(f"run-{unit}", [built]), _sizes(library)[0]
            entries.append(Entry(name, reads, command, model, code, memory))
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


# ---- An emulated Cortex-M4 --------------------------------------------------------------------------------------

CHIP = "cortex-m4"
CHIP_WINDOWS = 20  # windows to decide on there: each takes millions of instructions
# What arm_convolve_wrapper_s8 and arm_fully_connected_wrapper_s8 may call.
CMSIS_NN = {
    "Convolution": (
        "arm_convolve_wrapper_s8", "arm_convolve_s8", "arm_convolve_1_x_n_s8", "arm_convolve_1x1_s8",
        "arm_convolve_1x1_s8_fast", "arm_nn_mat_mult_kernel_s8_s16", "arm_nn_mat_mult_kernel_row_offset_s8_s16",
    ),
    "FullyConnected": (
        "arm_fully_connected_wrapper_s8", "arm_fully_connected_s8", "arm_fully_connected_per_channel_s8",
    ),
    "NNSupport": (
        "arm_nn_mat_mult_nt_t_s8", "arm_nn_vec_mat_mult_t_s8", "arm_nn_vec_mat_mult_t_per_ch_s8",
        "arm_q7_to_q15_with_offset", "arm_s8_to_s16_unordered_with_offset",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class ChipRow:
    """Instructions of a decision on the emulated chip, and the logits (N, K), None where they are those of the host."""

    name: str
    reads: str
    instructions: float
    logits: NDArray[np.float64] | None = None


def ours_on_chip(case: Case, shop: Workshop) -> list[ChipRow]:
    """Count our C on the chip, as ``plushsense profile`` does."""
    folder = shop.folder / "export"
    emit(case.model, case.bundle, folder)
    cost = profile.count(folder, CHIP, read_facts(folder))
    network = sum(cost.stages[name] for name in ("network", "dense", "pooling"))
    assert cost.step is not None
    return [ChipRow(OUR_ROW, "inputs", network), ChipRow(WHOLE_ROW, "frames", cost.step)]


def require_cmsis_nn(root: Path | None) -> Path:
    """Return the folder of CMSIS-NN if that is what it is."""
    if root is None or not (root / "Include" / "arm_nnfunctions.h").is_file():
        raise CannotBuild("CMSIS-NN was not found: get github.com/ARM-software/CMSIS-NN and give --cmsis-nn DIR")
    return root


def cmsis_nn(
    case: Case, shop: Workshop, algorithm: str, root: Path, header: Path, logits: tuple[float, int]
) -> ChipRow:
    """Count CMSIS-NN with the integers in ``header``; ``logits`` are their scale and zero."""
    parts = [(root / "Source" / f"{kind}Functions", names) for kind, names in CMSIS_NN.items()]
    sources = [HERE / "chip.c", HERE / "cmsis.c", *(folder / f"{name}.c" for folder, names in parts for name in names)]
    each = case.arch.channels * (case.arch.step if algorithm == "stream" else case.length)
    (shop.folder / "integers.h").write_bytes(header.read_bytes())
    held, read = shop.folder / "inputs.bin", header.with_suffix(".bin").read_bytes()
    held.write_bytes(read[: None if algorithm == "stream" else CHIP_WINDOWS * each])
    program = build(
        CHIP, sources, shop.folder / "chip", include=[shop.folder, root / "Include"], optimise="-O3",
        defines={"INPUT_BYTES": each, "LOGIT_BYTES": case.arch.classes}, blobs={"INPUTS": held},
    )  # fmt: skip
    rows = np.frombuffer(program.run(timeout_s=600), dtype=np.uint8).reshape(-1, 4 + case.arch.classes)
    counted, integers = rows[:, :4].copy().view("<u4"), rows[:, 4:].copy().view(np.int8)
    return ChipRow("CMSIS-NN int8 -O3", algorithm, float(counted.mean()), (integers - float(logits[1])) * logits[0])
