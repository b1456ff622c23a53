"""A toy from another language: whoever cannot read its struct gets the answers and events of Python."""

from __future__ import annotations

import ctypes
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.deploy.golden import ANSWER, COLUMNS, EVENT
from plushsense.deploy.package import BINDING, emit
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.quantize import integer_model
from support.exports import bundle_of
from support.requirements import missing
from support.virtual_boards import WARNINGS, run

NAME = "ears"
TOO_SMALL, NOT_ALIGNED = 4, 8
ANSWERS = ("ms", "state", "affect", "answer", "gesture", "confidence", "known")
EVENTS = ("what", "number", "affect", "gesture", "source", "since", "ms")
COUNTS = ("answers", "restarts", "invalid", "faults", "bad_stamps", "interpolated", "interval", "sparse")
RUST_MAIN = """
#[path = "PATH"] mod toy;
use std::io::Read;
fn main() {
    let sizes = toy::sizes();
    let (mut place, mut memory) = (vec![0u64; sizes.0], vec![0u32; sizes.1]);
    assert_eq!(toy::Toy::new(&mut place[1..], &mut memory).err(), Some(4));
    let mut toy = toy::Toy::new(&mut place, &mut memory).unwrap();
    let mut bytes = Vec::new();
    std::io::stdin().read_to_end(&mut bytes).unwrap();
    let words: Vec<i32> = bytes.chunks(4).map(|b| i32::from_le_bytes(b.try_into().unwrap())).collect();
    for frame in words.chunks(WIDTH) {
        if toy.push(frame[0] as u32, &frame[1..]) > 0 {
            let a = toy.answer();
            println!("{} {} {} {} {} {} {}", a.ms, a.state, a.affect, a.kind, a.gesture, a.confidence, a.known);
        }
        while let Some(e) = toy.event() {
            println!("{} {} {} {} {} {} {}", e.what, e.number, e.affect, e.gesture, e.source, e.since_ms, e.ms);
        }
    }
    println!("{}", toy.gesture(2).to_str().unwrap());
}
"""


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """An export with a name: also its binding has the prefix."""
    bundle = bundle_of("accel-3", window=60)
    return Export(emit(integer_model(bundle), bundle, tmp_path_factory.mktemp("bound") / "out", name=NAME).folder)


def compiled(export: Export, *words: object) -> None:
    sources = [export.folder / f"{NAME}_{file}.c" for file in ("plushsense", "plush_model")]
    binding = export.folder / BINDING
    includes = (f"-I{export.folder}", f"-I{binding}")
    run("gcc", "-std=c99", "-O1", *WARNINGS, *includes, *sources, binding / f"{NAME}_plush_binding.c", *words)


class Bound:
    """A toy whose struct only the library knows."""

    def __init__(self, export: Export, file: Path) -> None:
        self.library = ctypes.CDLL(str(file))
        self.call("plush_name_of").restype = self.call("plush_gesture_name").restype = ctypes.c_char_p
        model_bytes = self.call("plush_model_bytes")()
        self.model = (ctypes.c_uint8 * model_bytes).in_dll(self.library, f"{NAME}_plush_model")
        self.memory = (ctypes.c_uint32 * (self.call("plush_memory_bytes")(self.model, model_bytes) // 4 + 1))()
        self.place = (ctypes.c_uint64 * (self.call("plush_toy_bytes")() // 8 + 2))()

    def call(self, function: str) -> Any:
        return getattr(self.library, f"{NAME}_{function}")

    def bind(self, fewer: int = 0, off: int = 0) -> int:
        place = ctypes.byref(self.place, off)
        bytes_there = self.call("plush_toy_bytes")() - fewer
        memory = (self.memory, ctypes.sizeof(self.memory))
        return int(self.call("plush_bind")(place, bytes_there, self.model, len(self.model), *memory))

    def numbers(self, function: str, n: int) -> tuple[int, list[int]]:
        words = (ctypes.c_int32 * n)()
        return self.call(function)(self.place, words), list(words)

    def push(self, frame: np.ndarray) -> int:
        values = (ctypes.c_int32 * (len(frame) - 1))(*frame[1:].tolist())
        return int(self.call("plush_push")(self.place, ctypes.c_uint32(int(frame[0])), values))


@pytest.fixture(scope="module")
def library(export: Export, c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("library") / "bound.so"
    compiled(export, "-shared", "-fPIC", "-o", file)
    return file


def expected(export: Export) -> list[list[int]]:
    """The newest answer of each frame, then its events."""
    rows = [row for row in export.golden.answers.tolist() if row[0] in (ANSWER, EVENT)]
    newest = {row[1]: n for n, row in enumerate(rows) if row[0] == ANSWER}
    kept = [row for n, row in enumerate(rows) if row[0] == EVENT or newest[row[1]] == n]
    names = {ANSWER: ANSWERS, EVENT: EVENTS}
    kept.sort(key=lambda row: (row[1], row[0]))
    return [[row[COLUMNS[row[0]].index(name)] for name in names[row[0]]] for row in kept]


def test_answers_and_events_are_those_of_python(export: Export, library: Path) -> None:
    toy = Bound(export, library)
    assert toy.bind(fewer=1) == TOO_SMALL and toy.bind(off=1) == NOT_ALIGNED and toy.bind() == 0
    assert toy.call("plush_channels")(toy.place) == 3 and toy.call("plush_classes")(toy.place) == 18
    found, answers, together = [], 0, 0
    for frame in export.golden.frames:
        answers += (due := toy.push(frame))
        if due:
            found.append(toy.numbers("plush_read_answer", len(ANSWERS))[1])
        before = len(found)
        while (event := toy.numbers("plush_read_event", len(EVENTS)))[0]:
            found.append(event[1])
        together = max(together, len(found) - before)
    assert found == expected(export) and together > 1
    rows = export.golden.answers
    last = rows[rows[:, 0] == ANSWER][-1].tolist()
    counts = dict(zip(COUNTS, toy.numbers("plush_read_counts", 11)[1], strict=False))
    assert counts["answers"] == answers == (rows[:, 0] == ANSWER).sum()
    assert counts == counts | {name: last[COLUMNS[ANSWER].index(name)] for name in ("restarts", "interpolated")}
    assert toy.call("plush_gesture_name")(toy.place, 2).decode() == export.model.gestures.labels[2]
    names = [toy.call("plush_name_of")(*what) for what in ((1, 1), (4, 3), (1, 3), (5, 0))]
    assert names == [b"tracking", b"ended", b"", b""]


def test_events_that_nobody_reads_are_dropped_from_the_oldest_and_counted(export: Export, library: Path) -> None:
    toy = Bound(export, library)
    assert toy.bind() == 0
    for frame in export.golden.frames:
        toy.push(frame)
    rows = export.golden.answers
    told = rows[rows[:, 0] == EVENT][:, [COLUMNS[EVENT].index(name) for name in EVENTS]].tolist()
    dropped = toy.numbers("plush_read_counts", 11)[1][-1]
    read = []
    while (event := toy.numbers("plush_read_event", len(EVENTS)))[0]:
        read.append(event[1])
    assert len(read) == 16 and dropped == len(told) - 16 > 0 and read == told[-16:]


def test_a_program_in_rust_gets_the_same(export: Export, c_compiler: str, tmp_path: Path) -> None:
    try:
        subprocess.run(["rustc", "--version"], capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        missing("rust", "rustc is not installed")
    compiled(export, "-r", "-nostdlib", "-o", tmp_path / "toy.o")
    binding = export.folder / BINDING / f"{NAME}_plush_binding.rs"
    text = RUST_MAIN.replace("PATH", str(binding)).replace("WIDTH", str(export.golden.frames.shape[1]))
    (tmp_path / "main.rs").write_text(text)
    words = ("--edition", "2024", "-D", "warnings", f"-Clink-arg={tmp_path / 'toy.o'}")
    run("rustc", *words, tmp_path / "main.rs", "-o", tmp_path / "main")
    stream = (export.golden.frames & 0xFFFFFFFF).astype("<u4").tobytes()
    done = subprocess.run([tmp_path / "main"], input=stream, capture_output=True, check=True)
    *lines, name = done.stdout.decode().splitlines()
    found = np.array([line.split() for line in lines], dtype=np.int64)
    assert np.array_equal(found & 0xFFFFFFFF, np.array(expected(export)) & 0xFFFFFFFF)
    assert name == export.model.gestures.labels[2]
