"""The example firmware: it compiles without a warning, and feels on a made-up board what the computer reads of it."""

from __future__ import annotations

import ctypes
import math
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import LayoutError
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.core.layouts import Channel, Layout, load_layout
from plushsense.dataset.readings import GravityReading, Readings
from plushsense.deploy.code import facts_of
from plushsense.deploy.golden import answers_of, column, read_golden
from plushsense.deploy.package import (
    ARDUINO,
    FIRMWARE,
    IDF,
    IDF_TASKS,
    SKETCH,
    emit,
    firmware,
)
from plushsense.deploy.quantize import integer_model
from plushsense.devices.wire import LineParser
from plushsense.runtime.image import IntegerModel
from plushsense.windows.features import Scaler
from support.exports import LAYOUTS, bundle_of
from support.sent_lines import format_line
from support.virtual_boards import BOARDS, BUILDS, SECONDS, WARNINGS, arduino, compiled, frames_of, idf, play, run, told

Packages = dict[str, tuple[Path, IntegerModel]]
EYES = {"arduino": (18, 19, 23), "idf": (0, 1, 2)}


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_example_feels_what_the_computer_reads_of_its_lines(
    packages: Packages, tmp_path: Path, board: str, layout: str
) -> None:
    """Two runs on the same clock: one sends its frames, one its answers; PlushSense answers the frames alike."""
    out, model = packages[layout]
    sent, pins = play(BUILDS[board](out, tmp_path))
    frames = frames_of(model.layout, sent)
    between = np.diff(frames[:, 0])
    assert len(frames) == pytest.approx(100 * SECONDS, rel=0.05)
    # It held the tick on average, was late twice, and made up for nothing.
    assert np.median(between) == 10
    assert abs((frames[400, 0] - frames[0, 0]) - 4000) <= 2
    assert sorted(between)[-2] == pytest.approx(40, abs=12) and sorted(between)[-1] == pytest.approx(255, abs=12)
    answers = answers_of(model, frames)
    assert set(column(answers, "state")) == {0, 1}
    assert answers[-1, 10] == 1  # the restart of the long gap
    assert answers[-1, 11] == 0  # made-up readings are within the valid ranges
    lines = play(BUILDS[board](out, tmp_path, "TELL_ANSWERS=1"))[0].decode().splitlines()
    # A wire without a clock tells the time since its first frame.
    since = int(lines[0].split()[0]) - int(column(answers, "ms")[0]) if layout == "plush-14" else 0
    assert lines == told(answers, model, -since)
    assert len({pin for _, pin, _ in pins}) >= 3  # the eyes moved


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", ["accel-3", "plush-15", "phone-6"])
def test_lines_that_come_in_are_felt_like_golden_frames(
    packages: Packages, tmp_path: Path, board: str, layout: str
) -> None:
    out, model = packages[layout]
    frames, answers = read_golden(out / "golden", model.layout.n_channels, len(model.gestures))
    frames, answers = frames[:900], answers[answers[:, 1] < 900]
    before = np.concatenate([[0], np.maximum(0, np.diff(frames[:, 0]))])
    lines = [format_line(model.layout, row[1:], row[0], d) for row, d in zip(frames.tolist(), before, strict=True)]
    (tmp_path / "lines").write_bytes(b"7 8 half a line\n" + b"".join(lines))
    sent, _ = play(BUILDS[board](out, tmp_path, "SENSORS=2"), tmp_path / "lines", seconds=40)
    assert sent.decode().splitlines() == told(answers, model)


@pytest.mark.parametrize("board", BUILDS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_wired_sensors_arrive_in_their_channels(packages: Packages, tmp_path: Path, board: str, layout: str) -> None:
    out, model = packages[layout]
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
def test_the_wired_sensor_gets_the_scale_of_the_training_and_another_is_noticed(tmp_path: Path, board: str) -> None:
    """The made-up sensor's readings never change; they are 1.66 times too large."""
    rest = GravityReading(("x", "y", "z"), (4.0, -56.0, 42.0), 7948.0, False)
    bundle = replace(
        bundle_of(window=60), readings=Readings((55.0, -1425.0, 4964.0), (7177.0, 6990.0, 6833.0), (rest,))
    )
    out = emit(integer_model(bundle), bundle, tmp_path / "out").folder
    sent, pins = play(BUILDS[board](out, tmp_path, "SENSORS=1"), seconds=6)
    axes = [(0x3B + 2 * i) * 256 + 0x3C + 2 * i for i in range(3)]
    scaled = [a * (65536 * 7948 // 16384) // 65536 for a in axes]
    assert frames_of(bundle.layout, sent)[-1, 1:].tolist() == [
        a + round(z) for a, z in zip(scaled, rest.zero, strict=True)
    ]
    red, green, blue = ([row[2] for row in pins if row[0] > 3100 and row[1] == pin] for pin in EYES[board])
    assert red == green and max(red) > 200 and not any(blue), "the eyes glow yellow"
    said = play(BUILDS[board](out, tmp_path, "SENSORS=1", "TELL_ANSWERS=1"), seconds=6)[0].decode()
    length = math.isqrt(sum(a * a for a in scaled))
    assert said.count(f"at rest 1 g is {length}, in training it was 7948\n") == 1
    fake = (out / SKETCH / "plush_fake.c").read_text(encoding="utf-8")
    assert "{55, 7177}, /* x */" in fake and "{-1425, 6990}, /* y */" in fake and "{4964, 6833}, /* z */" in fake


def test_another_scale_is_noticed_at_rest_only(tmp_path: Path, c_compiler: str) -> None:
    bundle = bundle_of(window=60)
    for gravity in (7948.0, 2.0**28):
        rest = GravityReading(("x", "y", "z"), (0.0, 100.0, 0.0), gravity, False)
        known = replace(bundle, readings=Readings((0.0,) * 3, (1.0,) * 3, (rest,)))
        out = emit(integer_model(known), known, tmp_path / f"{gravity:g}").folder
        words = [c_compiler, "-std=c99", *WARNINGS, f"-I{out}", "-shared", "-fPIC"]
        run(*words, out / SKETCH / "plush_rest.c", "-o", library := tmp_path / f"{gravity:g}.so")
        check = ctypes.CDLL(str(library)).plush_rest_check
        t = np.arange(500) / 100
        still, moving = np.ones(500), 1 + 0.4 * np.sin(9 * t)
        lengths = [(share * still, None) for share in (1.0, 0.7, 1.4)] + [(share * still, 3) for share in (2.06, 0.49)]
        lengths += [(2.06 * moving, None), (np.where(t < 2, 2.06, 1.0), None)]
        lengths += [(np.where((t < 2) | (t >= 3), 2.06, 2 * moving), 4)]
        for length, seconds in lengths:
            state = ctypes.create_string_buffer(64)
            rows = np.rint(np.outer(length * gravity, [0.6, 0.0, 0.8])).astype(np.int64) + np.array([0, 100, 0])
            found = [n for n, row in enumerate(rows.tolist()) if check(state, 5 + 10 * n, (ctypes.c_int32 * 3)(*row))]
            assert found == ([] if seconds is None else [100 * seconds]), (gravity, length[:5])


NO_GESTURE = r"""
#include <stdio.h>
#include "plush_reaction.h"
#include "plush_model.h"

int main(void)
{
    static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
    static plush_toy toy;
    static plush_reaction reaction;
    const char *label;
    plush_look look;
    int affect;

    if (plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory) != PLUSH_OK)
        return 1;
    toy.event.what = PLUSH_BEGUN;
    toy.event.gesture = PLUSH_NO_GESTURE;
    for (affect = 0; affect < 4; affect++) {
        toy.event.affect = (plush_affect)affect;
        toy.answers++;
        plush_react(&reaction, &toy, 10000u * (uint32_t)(affect + 1), &look);
        printf("%d,%d,%d,%d ", look.red, look.green, look.blue, look.tone_hz);
    }
    label = plush_gesture_name(&toy, toy.event.gesture);
    printf("%d %d\n", *label, plush_probability(&toy, toy.event.gesture));
    toy.event.affect = PLUSH_AFFECT_NONE; /* a colour of its own for a gesture; and then no model runs any more */
    toy.event.gesture = 0;
    toy.answers++;
    plush_react(&reaction, &toy, 50000, &look);
    if (plush_begin(&toy, plush_model, 0, memory, sizeof memory) == PLUSH_OK)
        return 1;
    plush_react(&reaction, &toy, 50010, &look);
    return 0;
}
"""


def test_an_event_without_a_gesture_is_safe_to_show_and_to_name(
    packages: Packages, c_compiler: str, tmp_path: Path
) -> None:
    out = packages["accel-3"][0]
    (tmp_path / "show.c").write_text(NO_GESTURE)
    sources = [out / "plushsense.c", out / "plush_model.c", out / SKETCH / "plush_reaction.c", tmp_path / "show.c"]
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    run(c_compiler, "-std=c99", *checks, *WARNINGS, f"-I{out}", f"-I{out / SKETCH}", *sources, "-o", tmp_path / "show")
    shown = subprocess.run([tmp_path / "show"], check=True, capture_output=True, text=True).stdout
    assert shown == "40,40,40,0 0,255,0,392 40,40,40,0 255,0,0,1400 0 0\n"


def test_a_bundle_of_before_exports_and_says_that_the_scale_is_not_known(packages: Packages) -> None:
    for layout, (out, _) in packages.items():
        text, header = (out / "README.md").read_text(encoding="utf-8"), (out / "plush_model.h").read_text()
        assert "standard deviation" not in (out / SKETCH / "plush_fake.c").read_text(encoding="utf-8")
        assert text.count("export --dataset DS measures it") == 1 and "PLUSH_MODEL_ONE_G" not in header
        assert ("ITS SCALE IS NOT KNOWN" in (out / SKETCH / "PlushToy.ino").read_text()) == (layout != "phone-6")


@pytest.mark.parametrize("board", BUILDS)
def test_a_damaged_model_blinks_and_the_lines_go_on(packages: Packages, tmp_path: Path, board: str) -> None:
    out, model = packages["accel-3"]
    shutil.copytree(out, tmp_path / "out")
    for copy in (tmp_path / "out").glob("*/**/plush_model.c"):
        text = copy.read_text(encoding="utf-8")
        at = text.rindex("128,")
        copy.write_text(text[:at] + "129," + text[at + 4 :], encoding="utf-8")
    sent, pins = play(BUILDS[board](tmp_path / "out", tmp_path), seconds=3)
    assert len(frames_of(model.layout, sent)) > 280
    red = [value for _, pin, value in pins if value == 255]
    assert len(red) == 3  # PLUSH_DAMAGED is 3; the pattern lasts 10 × 0.3 s
    assert len({pin for _, pin, value in pins if value}) == 1


@pytest.mark.exhaustive
def test_clang_agrees(packages: Packages, tmp_path: Path) -> None:
    for layout in LAYOUTS:
        for sensors in (0, 1, 2):
            arduino(packages[layout][0], tmp_path, f"SENSORS={sensors}", compiler=("clang", "clang++"))
            idf(packages[layout][0], tmp_path, f"SENSORS={sensors}", compiler="clang")


@pytest.mark.parametrize(
    "target",
    [
        ("xtensa-lx106-elf-gcc", "-mlongcalls", "-ffreestanding"),
        ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb"),
    ],
)
def test_the_sources_compile_for_the_chip(
    packages: Packages, needs: Callable[..., None], tmp_path: Path, target: tuple[str, ...]
) -> None:
    needs(target[0])
    # Debian's lx106 compiler comes without a C library: what the sources use of it.
    (tmp_path / "string.h").write_text(
        "#include <stddef.h>\nvoid *memcpy(void *, const void *, size_t);\nvoid *memset(void *, int, size_t);\n"
        "int memcmp(const void *, const void *, size_t);\n"
    )
    own = [f"-I{tmp_path}"] if "xtensa" in target[0] else []
    for layout in LAYOUTS:
        out = packages[layout][0]
        for source in [*(out / ARDUINO / "src").glob("*.c"), *(out / SKETCH).glob("*.c")]:
            words = ["-std=c99", "-Wpedantic", "-Wconversion", *WARNINGS, "-O2", f"-I{out / ARDUINO / 'src'}"]
            compiled(source, *target, *own, *words)


def test_the_example_of_tasks_is_c(packages: Packages, c_compiler: str) -> None:
    """A check of the syntax only, with names and types as in ESP-IDF, FreeRTOS and NimBLE: nothing of it ran."""
    out = packages["plush-15"][0]
    includes = (BOARDS / "idf", out / IDF / "include")
    words = (c_compiler, "-std=gnu17", "-fsyntax-only", *WARNINGS, *(f"-I{folder}" for folder in includes))
    run(*words, out / IDF_TASKS / "main" / "main.c")


def test_noise_is_read_as_the_computer_reads_it(packages: Packages, tmp_path: Path, c_compiler: str) -> None:
    """Frames broken at random: the toy's reader and the computer's find the same ones."""
    for layout in ("accel-3", "plush-14"):
        out, model = packages[layout]
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


ODD_NUMBERS = (
    *(b"-0", b"+0", b"-1", b"", b"+", b"-", b"--1", b"0x10", b"1_0", b"\xd9\xa3", b"1.", b".5", b"1e2", b"1E+99"),
    *(b"9" * n for n in (15, 16, 17, 18, 19, 25, 300)),
    *(b"0" * n + b"7" for n in (17, 18, 40)),
    *(b"1." + b"0" * n + b"1" for n in (16, 17, 18, 200)),
    *(b"2147483648", b"4294967296", b"9007199254740992", b"9007199254740993"),
)
ODD_GAPS = (b" ", b"\t", b",;", b" , ", b"\v", b"\f", b"\0", b":", b" " * 250, b" " * 700)


def read_as_python(wire: ctypes.CDLL, layout: Layout, lines: list[bytes]) -> int:
    """Let C and Python read lines, which must give the same frames; their number."""
    talk = b"\n".join([*lines, b""])
    state, ms, values = ctypes.create_string_buffer(4096), ctypes.c_uint32(), (ctypes.c_int32 * layout.n_channels)()
    expected = [
        (f.device_ms % 2**32, *(max(-(2**31), min(v, 2**31 - 1)) for v in f.values))
        for f in LineParser(layout, joining=True).feed(talk)
    ]
    found = [
        (ms.value, *values) for c in talk if wire.plush_wire_read(state, ctypes.c_char(c), ctypes.byref(ms), values)
    ]
    assert found == expected
    return len(found)


def test_computer_and_toy_read_one_grammar(packages: Packages, tmp_path: Path, c_compiler: str) -> None:
    """Odd numbers at every place of a line, odd separators, broken and long lines: both find the same frames.

    The grammar is in docs/record.md. ``PLUSHSENSE_FUZZ=100`` reads 200 000 lines of each layout.
    """
    rng, count = np.random.default_rng(7), 2000 * int(os.environ.get("PLUSHSENSE_FUZZ", "1"))
    for layout in LAYOUTS:
        out, model = packages[layout]
        library = tmp_path / f"{layout}.so"
        run(c_compiler, "-shared", "-fPIC", out / ARDUINO / "src" / "plush_wire.c", "-o", library)
        wire = ctypes.CDLL(str(library))
        channels, lines = model.layout.n_channels, [b""]
        for k in range(count):
            row = [*rng.integers(-3000, 3000, channels).tolist()]
            fields = format_line(model.layout, row, 10 * k, 10).split()
            gaps = [b" "] * (len(fields) - 1)
            if k % 5 == 1:
                fields[rng.integers(len(fields))] = ODD_NUMBERS[rng.integers(len(ODD_NUMBERS))]
            elif k % 5 == 2:
                gaps[rng.integers(len(gaps))] = ODD_GAPS[rng.integers(len(ODD_GAPS))]
            elif k % 5 == 3:
                at = rng.integers(len(fields))
                fields[at] = bytes(rng.choice(list(b"0123456789+-.eE \t\v"), rng.integers(1, 8)).tolist())
            line = bytearray(b"".join(part for pair in zip(fields, [*gaps, b""], strict=True) for part in pair))
            for _ in range(rng.integers(1, 4) if k % 5 == 4 else 0):
                line[rng.integers(len(line))] = int(rng.choice(list(b" -+.;,\t\v\f\r\n\0xe0123456789\xff")))
            lines.append(bytes(line))
        found = read_as_python(wire, model.layout, lines)
        assert 0.3 * count < found < 0.9 * count


def test_decimals_of_any_length_are_read_as_the_computer_reads_them(
    packages: Packages, tmp_path: Path, c_compiler: str
) -> None:
    """A phone writes what its floats hold: 16 places, at times a power of ten, and the time since 1970."""
    out, model = packages["phone-6"]
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
    found = read_as_python(wire, model.layout, lines)
    assert found > 400


def test_a_line_is_as_long_as_promised(packages: Packages, tmp_path: Path, c_compiler: str) -> None:
    """The longest line fills its room exactly, and is the one that the computer would write."""
    for layout in LAYOUTS:
        out, model = packages[layout]
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
    bundle = bundle_of(layout, gestures=gestures, window=60)
    out = emit(integer_model(bundle), bundle, tmp_path / "out").folder
    sent, pins = play(arduino(out, tmp_path, "TELL_ANSWERS=1"), seconds=4)
    assert sent.decode().splitlines()[-1].split(" ", 3)[3] in labels
    # Nobody told an affect: the eyes have a gesture's own colour, and there is no sound.
    assert {pin for _, pin, value in pins if value} & {18, 19} and not any(pin == 5 for _, pin, value in pins if value)
    play(idf(out, tmp_path), seconds=1)
    assert "Nobody told an affect for 11 of 11" in (out / "README.md").read_text(encoding="utf-8")


def test_channels_that_no_pad_measures_are_marked() -> None:
    bundle = bundle_of()
    plain, model = bundle.layout, integer_model(bundle)
    facts = facts_of(model, bundle, model.to_bytes())
    for kinds, note in (
        ([("capacitive", "count")] * 12, "NO PAD IS LEFT"),
        ([("heat", "K"), ("acceleration", "count")], "see read_other()"),
    ):
        names = tuple(f"c{i}" for i in range(len(kinds)))
        channels = tuple(Channel(n, unit, kind) for n, (kind, unit) in zip(names, kinds, strict=True))
        wire = ("device_ms", *names)
        csv = replace(plain.csv, columns=wire, header=wire)
        layout = replace(plain, channels=channels, wire=wire, inputs=names, vectors=(), csv=csv)
        files = firmware(layout, Scaler(np.zeros(len(names)), np.ones(len(names))), facts)
        assert set(files) == set(FIRMWARE)
        assert note in files["PlushToy.ino"] and note in files["main.c"]


def test_a_step_that_no_line_carries_is_refused() -> None:
    plain = load_layout("accel-3")
    fine = replace(plain.channels[0], step=1e-12, valid_min=0.0, valid_max=1e-9)
    layout = replace(plain, channels=(fine, *plain.channels[1:]))
    with pytest.raises(LayoutError, match="another step"):
        firmware(layout, Scaler(np.zeros(3), np.ones(3)), {"title": "t", "classes": 2, "span": 10})
