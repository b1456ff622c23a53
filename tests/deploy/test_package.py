"""The packages of an export: they compile without a warning, run on a made-up board, and name what exists."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import LayoutError
from plushsense.core.gestures import Gesture, GestureSet, load_gestures
from plushsense.core.signal import Channel, Layout, load_layout
from plushsense.deploy.emit import emit, read_facts
from plushsense.deploy.firmware import TEMPLATES, firmware
from plushsense.deploy.golden import answers_of, read_golden
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE, SKETCH, changed_copies, copies, package
from plushsense.deploy.quantize import calibrate, quantize
from plushsense.devices.wire import LineParser, format_line
from plushsense.models.arch import Arch
from plushsense.models.bundle import Bundle
from plushsense.models.image import IntegerModel
from plushsense.models.reference import Network, random_weights
from plushsense.windows.features import Scaler

REPO = Path(__file__).resolve().parents[2]
Exports = dict[str, tuple[Path, IntegerModel]]
LAYOUTS = ("accel-3", "plush-14", "plush-15", "phone-6")
BOARDS = REPO / "tests" / "deploy" / "boards"
WARNINGS = ("-Wall", "-Wextra", "-Werror")
SECONDS = 14


def made(layout: Layout | str = "accel-3", gestures: GestureSet | None = None) -> tuple[IntegerModel, Bundle]:
    """A small network with weights drawn by lot."""
    read = load_layout(layout) if isinstance(layout, str) else layout
    gestures = gestures or load_gestures("plush-18")
    arch = Arch.parse("9d1_5d2", "4,6", channels=read.n_inputs, classes=len(gestures), window=60)
    weights = random_weights(arch, 3)
    walk = np.cumsum(np.random.default_rng(1).normal(size=(12, arch.channels, arch.span + 40)), axis=2)
    windows = np.rint(60 * walk + 900).astype(np.int64)
    scaler = Scaler.fit(windows)
    network = quantize(arch, weights, scaler, calibrate(Network(arch, weights), scaler.apply(windows)))
    return IntegerModel(network, read, gestures, 5000), Bundle(arch, weights, read, scaler, gestures)


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory, needs: Callable[..., None]) -> Exports:
    """An export with packages for each built-in layout; what builds them is here."""
    needs("gcc", "g++", "clang", "clang++")
    found = {}
    for layout in LAYOUTS:
        model, bundle = made(layout)
        out = tmp_path_factory.mktemp("exports") / layout
        emit(model, bundle, out, extras=[package])
        found[layout] = out, model
    return found


def run(*words: object) -> None:
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def arduino(out: Path, to: Path, *defines: str, compiler: tuple[str, str] = ("gcc", "g++")) -> Path:
    """PlushToy and the library, built for the made-up Arduino."""
    src, sketch, program = out / ARDUINO / "src", out / SKETCH, to / "toy"
    sources = [*sorted(src.glob("*.c")), *sorted(sketch.glob("*.c"))]
    objects = [to / f"{source.stem}.o" for source in sources]
    for source, built in zip(sources, objects, strict=True):
        if not built.exists():
            run(compiler[0], "-std=c99", "-Wpedantic", *WARNINGS, "-O1", f"-I{src}", "-c", source, "-o", built)
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
    words = [compiler, "-std=gnu17", *WARNINGS, "-O1", *(f"-D{d}" for d in defines), *includes]
    run(*words, *sources, BOARDS / "idf" / "run.c", "-o", to / "toy")
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
        for _, ms, _, state, gesture, _, sure, *_ in answers.astype(np.int64).tolist()
    ]


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_example_feels_what_the_computer_reads_of_its_lines(
    exports: Exports, tmp_path: Path, board: str, layout: str
) -> None:
    """Two runs on the same clock: one sends its frames, one its answers; PlushSense answers the frames alike."""
    out, model = exports[layout]
    sent, pins = play(BUILDS[board](out, tmp_path))
    frames = frames_of(model.layout, sent)
    between = np.diff(frames[:, 0])
    assert len(frames) == pytest.approx(100 * SECONDS, rel=0.05)
    # It held the tick on average, was late twice, and made up for nothing.
    assert np.median(between) == 10
    assert abs((frames[400, 0] - frames[0, 0]) - 4000) <= 2
    assert sorted(between)[-2] == pytest.approx(40, abs=12) and sorted(between)[-1] == pytest.approx(255, abs=12)
    answers = answers_of(model, frames)
    assert set(answers[:, 3]) == {0, 1}
    assert answers[-1, 7] == 1  # the restart of the long gap
    assert answers[-1, 8] == 0  # made-up readings are within the valid ranges
    lines = play(BUILDS[board](out, tmp_path, "TELL_ANSWERS=1"))[0].decode().splitlines()
    # A wire without a clock tells the time since its first frame.
    since = int(lines[0].split()[0]) - int(answers[0, 1]) if layout == "plush-14" else 0
    assert lines == told(answers, model, -since)
    assert len({pin for _, pin, _ in pins}) >= 3  # the eyes moved


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", ["accel-3", "plush-15", "phone-6"])
def test_lines_that_come_in_are_felt_like_golden_frames(
    exports: Exports, tmp_path: Path, board: str, layout: str
) -> None:
    out, model = exports[layout]
    frames, answers = read_golden(out / "golden", model.layout.n_channels, len(model.gestures))
    frames, answers = frames[:900], answers[answers[:, 0] < 900]
    before = np.concatenate([[0], np.maximum(0, np.diff(frames[:, 0]))])
    lines = [format_line(model.layout, row[1:], row[0], d) for row, d in zip(frames.tolist(), before, strict=True)]
    (tmp_path / "lines").write_bytes(b"7 8 half a line\n" + b"".join(lines))
    sent, _ = play(BUILDS[board](out, tmp_path, "SENSORS=2"), tmp_path / "lines", seconds=40)
    assert sent.decode().splitlines() == told(answers, model)


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_wired_sensors_arrive_in_their_channels(exports: Exports, tmp_path: Path, board: str, layout: str) -> None:
    out, model = exports[layout]
    frame = frames_of(model.layout, play(BUILDS[board](out, tmp_path, "SENSORS=1"), seconds=1)[0])[-1, 1:].tolist()
    # The made-up sensor's bytes are its registers' numbers: acceleration from 0x3B, rotation from 0x43.
    axes = [(0x3B + 2 * i) * 256 + 0x3C + 2 * i for i in (0, 1, 2, 4, 5, 6)]
    if layout.startswith("plush"):
        gpio = {"arduino": [400, 1500, 1300, 1400, 2700, 3300, 3200, 200, 1200]}
        pads = gpio.get(board, [1000, 1030, 1040, 1060, 1070, 1080, 1090, 1020, 1050])
        assert frame == [sum(pads), *pads, *axes[:3]]
    elif layout == "accel-3":
        assert frame == axes[:3]
    else:
        g, degree = 9.80665e3 / 16384, np.pi / 180 * 1000 / 131
        assert frame == pytest.approx([a * g for a in axes[:3]] + [a * degree for a in axes[3:]], rel=1e-3)
    silent = play(BUILDS[board](out, tmp_path, "SENSORS=1", "NO_MOTION"), seconds=1)[0]
    parser = LineParser(model.layout)
    assert all(f.garbage for f in parser.feed(silent)) and parser.counters.garbage > 50


@pytest.mark.parametrize("board", BUILDS)
def test_a_damaged_model_blinks_and_the_lines_go_on(exports: Exports, tmp_path: Path, board: str) -> None:
    out, model = exports["accel-3"]
    shutil.copytree(out, tmp_path / "out")
    for copy in (c for c, original in copies().items() if original == "plush_model.c"):
        text = (tmp_path / "out" / copy).read_text(encoding="utf-8")
        at = text.rindex("128,")
        (tmp_path / "out" / copy).write_text(text[:at] + "129," + text[at + 4 :], encoding="utf-8")
    assert len(changed_copies(tmp_path / "out")) == 2
    sent, pins = play(BUILDS[board](tmp_path / "out", tmp_path), seconds=3)
    assert len(frames_of(model.layout, sent)) > 280
    red = [value for _, pin, value in pins if value == 255]
    assert len(red) == 3  # PLUSH_DAMAGED is 3; the pattern lasts 10 × 0.3 s
    assert len({pin for _, pin, value in pins if value}) == 1


def test_clang_agrees(exports: Exports, tmp_path: Path) -> None:
    for layout in LAYOUTS:
        (tmp_path / layout).mkdir()
        for sensors in (0, 1, 2):
            arduino(exports[layout][0], tmp_path / layout, f"SENSORS={sensors}", compiler=("clang", "clang++"))
            idf(exports[layout][0], tmp_path, f"SENSORS={sensors}", compiler="clang")


@pytest.mark.parametrize(
    "target",
    [
        ("xtensa-lx106-elf-gcc", "-mlongcalls", "-ffreestanding"),
        ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb"),
    ],
)
def test_the_sources_compile_for_the_chip(
    exports: Exports, needs: Callable[..., None], tmp_path: Path, target: tuple[str, ...]
) -> None:
    needs(target[0])
    # Debian's lx106 compiler comes without a C library: what the sources use of it.
    (tmp_path / "string.h").write_text(
        "#include <stddef.h>\nvoid *memcpy(void *, const void *, size_t);\nvoid *memset(void *, int, size_t);\n"
        "int memcmp(const void *, const void *, size_t);\n"
    )
    own = [f"-I{tmp_path}"] if "xtensa" in target[0] else []
    for layout in LAYOUTS:
        out = exports[layout][0]
        for source in [*(out / ARDUINO / "src").glob("*.c"), *(out / SKETCH).glob("*.c")]:
            words = ["-std=c99", "-Wpedantic", "-Wconversion", *WARNINGS, "-O2", f"-I{out / ARDUINO / 'src'}"]
            run(*target, *own, *words, "-c", source, "-o", tmp_path / "x.o")


def test_noise_is_read_as_the_computer_reads_it(exports: Exports, tmp_path: Path, c_compiler: str) -> None:
    """Frames broken at random: the toy's reader and the computer's find the same ones."""
    for layout in ("accel-3", "plush-14"):
        out, model = exports[layout]
        source, library = out / ARDUINO / "src" / "plush_wire.c", tmp_path / f"{layout}.so"
        run(c_compiler, "-shared", "-fPIC", source, "-o", library)
        wire = ctypes.CDLL(str(library))
        channels = model.layout.n_channels
        state, ms, values = ctypes.create_string_buffer(4096), ctypes.c_uint32(), (ctypes.c_int32 * channels)()
        rng = np.random.default_rng(5)
        lines = []
        for k in range(600):
            row = rng.integers(-3000, 3000, channels)
            line = bytearray(format_line(model.layout, row.tolist(), 10 * k, int(rng.integers(0, 30))))
            for _ in range(rng.integers(0, 3)):
                line[rng.integers(len(line))] = int(rng.choice(list(b" -+.;,\t\r\nx0123456789\xff")))
            lines.append(bytes(line))
        noise = b"".join(lines)
        parser = LineParser(model.layout, joining=True)
        expected = [(f.device_ms, *f.values) for f in parser.feed(noise)]
        found = [
            (ms.value, *values)
            for c in noise
            if wire.plush_wire_read(state, ctypes.c_char(c), ctypes.byref(ms), values)
        ]
        assert found == expected
        assert 100 < len(found) < 590


def test_decimals_of_any_length_are_read_as_the_computer_reads_them(
    exports: Exports, tmp_path: Path, c_compiler: str
) -> None:
    """A phone writes what its floats hold: 16 places, at times a power of ten, and the time since 1970."""
    out, model = exports["phone-6"]
    library = tmp_path / "phone-6.so"
    run(c_compiler, "-shared", "-fPIC", out / ARDUINO / "src" / "plush_wire.c", "-o", library)
    wire = ctypes.CDLL(str(library))
    channels = model.layout.n_channels
    rng = np.random.default_rng(6)
    lines = [b""]
    for k in range(400):
        values = rng.normal(size=channels) * 10.0 ** rng.integers(-7, 3, channels)
        words = [f"{v:.{rng.integers(5, 19)}f}" if rng.random() < 0.7 else f"{v:.7E}" for v in values]
        lines.append(" ".join([*words, str(1657533977813 + 10 * k)]).encode())
    odd = (
        "1e",
        "e1",
        "1e+",
        "1e123",
        "1e1.5",
        "1.5.5",
        "1e-99",
        "5e17",
        "-1E1",
        "1.e1",
        ".5e-1",
        "9e9",
        "1e1e1",
        "0e99",
    )
    lines += [f"{word} 0 0 0 0 0 {k}".encode() for k, word in enumerate(odd)]
    lines += [f"0 0 0 0 0 0 {ms}".encode() for ms in ("7.0", "7e0", 2**32 - 1, 2**32, 2**53, 2**53 + 1, "9" * 30)]
    talk = b"\n".join([*lines, b""])
    state, ms, values = ctypes.create_string_buffer(4096), ctypes.c_uint32(), (ctypes.c_int32 * channels)()
    expected = [
        (f.device_ms % 2**32, *(max(-(2**31), min(v, 2**31 - 1)) for v in f.values))
        for f in LineParser(model.layout, joining=True).feed(talk)
    ]
    found = [
        (ms.value, *values) for c in talk if wire.plush_wire_read(state, ctypes.c_char(c), ctypes.byref(ms), values)
    ]
    assert found == expected
    assert len(found) > 400


def test_a_line_is_as_long_as_promised(exports: Exports, tmp_path: Path, c_compiler: str) -> None:
    """The longest line fills its room exactly, and is the one that the computer would write."""
    for layout in LAYOUTS:
        out, model = exports[layout]
        src, library = out / ARDUINO / "src", tmp_path / f"{layout}.so"
        run(c_compiler, "-shared", "-fPIC", src / "plush_wire.c", "-o", library)
        wire = ctypes.CDLL(str(library))
        room = int(re.findall(r"PLUSH_WIRE_BYTES (\d+)", (src / "plush_wire.h").read_text())[0])
        line = ctypes.create_string_buffer(4096)
        most = 2**32 - 1
        for values, ms in (([-(2**31)] * model.layout.n_channels, most), ([-7] * model.layout.n_channels, 0)):
            n = wire.plush_wire_write(line, ms, ms, (ctypes.c_int32 * len(values))(*values))
            expected = format_line(model.layout, values, ms, ms)
            assert [float(w) for w in line.value.split()] == [float(w) for w in expected.split()]
            assert n == len(line.value) <= room - 1
            if ms:
                assert n == room - 1


def test_what_the_manifests_name_exists(exports: Exports) -> None:
    for out, _ in exports.values():
        library = out / ARDUINO
        properties = dict(row.split("=", 1) for row in (library / "library.properties").read_text().splitlines())
        assert {"name", "version", "author", "maintainer", "sentence", "paragraph", "category"} <= set(properties)
        assert all((library / "src" / name).is_file() for name in properties["includes"].split(","))
        manifest = json.loads((library / "library.json").read_text(encoding="utf-8"))
        assert all((library / "src" / name).is_file() for name in manifest["headers"])
        for example in manifest["examples"]:
            assert all((library / example["base"] / name).is_file() for name in example["files"])
        assert manifest["version"] == properties["version"] == read_facts(out)["code_version"]
        words = [row.split("\t") for row in (library / "keywords.txt").read_text().splitlines()]
        assert all(len(row) == 2 for row in words) and ["plush_push", "KEYWORD2"] in words
        for cmake in (*(out / IDF).rglob("CMakeLists.txt"), *(out / IDF_EXAMPLE).rglob("CMakeLists.txt")):
            for named in re.findall(r'"([^"$]+)"', cmake.read_text()):
                assert (cmake.parent / named).exists(), named
            for named in re.findall(r"CMAKE_CURRENT_LIST_DIR}/([^\"]+)", cmake.read_text()):
                assert (cmake.parent / named).is_dir()
        assert re.fullmatch(
            r'version: "[\d.]+"\ndescription: ".*"\nlicense: MIT\ndependencies:\n  idf: ".*"\n',
            (out / IDF / "idf_component.yml").read_text(encoding="utf-8"),
        )
        held = {p.name for p in out.rglob("*")}
        for source in (p for p in out.rglob("*") if p.suffix in (".c", ".h", ".ino")):
            for included in re.findall(r'#include [<"](plush\w+\.h)[">]', source.read_text(encoding="utf-8")):
                assert included in held
        for path in (p for p in out.rglob("*") if p.is_file() and p.suffix not in (".bin", ".plush")):
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"@\w+@|@if |@end|TODO|(?<!\$)(?<!ENV){\w+}", text), path
        assert changed_copies(out) == []
        assert (out / "LICENSE").read_text() == (REPO / "LICENSE").read_text()


def test_the_programs_in_the_readme_compile(exports: Exports, tmp_path: Path, c_compiler: str) -> None:
    out = exports["plush-15"][0]
    programs = re.findall(r"```c\n(.*?)```", (out / "README.md").read_text(encoding="utf-8"), re.S)
    assert len(programs) == 2
    for text in programs:
        (tmp_path / "x.c").write_text(text)
        run(c_compiler, "-std=c99", *WARNINGS, f"-I{out}", "-c", tmp_path / "x.c", "-o", tmp_path / "x.o")


def with_provenance(tmp_path: Path, **provenance: object) -> str:
    model, bundle = made()
    emit(model, replace(bundle, provenance=provenance), tmp_path / "out", extras=[package])
    return (tmp_path / "out" / "README.md").read_text(encoding="utf-8")


SCORES = {"split": "validation-subjects", "leaky": False, "windows": 321, "accuracy": 0.6789, "macro_f1": 0.5432}


def test_the_readme_tells_this_model(tmp_path: Path) -> None:
    people = ["Anna", "P02", "none"]  # at rest there is nobody
    text = with_provenance(tmp_path, dataset="gestures | of 2", scores=SCORES, subjects=people, simulated=False)
    facts = read_facts(tmp_path / "out")
    for figure in ("parameters", "macs_per_step", "model_bytes", "memory_bytes", "span"):
        assert f"{facts[figure]:,}" in text
    for said in (
        facts["symbol"],
        "50 ms",
        "0.56 s",
        "0.679",
        "0.543",
        "321 windows",
        "`validation-subjects`",
        "2 people",
    ):
        assert said in text
    assert "gestures \\| of 2" in text
    for word in ("SIMULATION", "LEAKY", "Anna", "P02"):
        assert word not in text
    order = [text.index(f"| {i} | {c} | `PLUSH_CHANNEL_{c.upper()}` |") for i, c in enumerate("xyz")]
    assert order == sorted(order)
    assert "Nobody told an affect" not in text


def test_simulation_and_leaks_are_told_loudly(tmp_path: Path) -> None:
    text = with_provenance(tmp_path, dataset="virtual toy", simulated=True, scores=SCORES | {"leaky": True})
    assert text.splitlines()[2].startswith("> **SIMULATION.**")
    assert "virtual toy (SIMULATION)" in text and "**LEAKY**" in text
    assert "SIMULATION" in (tmp_path / "out" / ARDUINO / "library.properties").read_text(encoding="utf-8")


def test_names_of_any_kind_become_legal(tmp_path: Path) -> None:
    """Umlauts, digits first, marks of comments, words of the library itself, and names that clean to the same."""
    plain = load_layout("accel-3")
    odd = ("1st Käfer", "x*/y", "X Y \\")
    channels = tuple(replace(c, name=n) for c, n in zip(plain.channels, odd, strict=True))
    wire = ("device_ms", *odd)
    csv = replace(plain.csv, columns=wire, header=wire)
    layout = replace(plain, name="ö*/ö", channels=channels, wire=wire, inputs=odd, vectors=(odd,), csv=csv)
    labels = ["OK", "One", "Tracking", "2 hands", "Ä", "Ö", "a-b", "a b.", "A_B 2", "*/ int x;", 'say "hi" ??/']
    gestures = GestureSet("odd ones", tuple(Gesture(label) for label in labels))
    out = emit(*made(layout, gestures), tmp_path / "out", extras=[package]).folder
    sent, pins = play(arduino(out, tmp_path, "TELL_ANSWERS=1"), seconds=4)
    assert sent.decode().splitlines()[-1].split(" ", 3)[3] in labels
    # Nobody told an affect: the eyes have a gesture's own colour, and there is no sound.
    assert {pin for _, pin, value in pins if value} & {18, 19} and not any(pin == 5 for _, pin, value in pins if value)
    play(idf(out, tmp_path), seconds=1)
    assert "Nobody told an affect for 11 of 11" in (out / "README.md").read_text(encoding="utf-8")


def test_channels_that_no_pad_measures_are_marked() -> None:
    plain = load_layout("accel-3")
    for kinds, said in (
        ([("capacitive", "count")] * 12, "NO PAD IS LEFT"),
        ([("heat", "K"), ("acceleration", "count")], "see read_other()"),
    ):
        names = tuple(f"c{i}" for i in range(len(kinds)))
        channels = tuple(Channel(n, unit, kind) for n, (kind, unit) in zip(names, kinds, strict=True))
        wire = ("device_ms", *names)
        csv = replace(plain.csv, columns=wire, header=wire)
        layout = replace(plain, channels=channels, wire=wire, inputs=names, vectors=(), csv=csv)
        facts = {"title": "t", "classes": 2, "span": 10}
        files = firmware(layout, Scaler(np.zeros(len(names)), np.ones(len(names))), facts)
        assert set(files) == set(TEMPLATES)
        assert said in files["PlushToy.ino"] and said in files["main.c"]


def test_a_step_that_no_line_carries_is_refused() -> None:
    plain = load_layout("accel-3")
    fine = replace(plain.channels[0], step=1e-12, valid_min=0.0, valid_max=1e-9)
    layout = replace(plain, channels=(fine, *plain.channels[1:]))
    _, bundle = made()
    with pytest.raises(LayoutError, match="another step"):
        firmware(layout, bundle.scaler, {"title": "t", "classes": 2, "span": 10})
