"""`verify --device`: chips of QEMU by their UARTs, and one on this computer whose link, or whose C, is broken."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from plushsense.cli.main import main
from plushsense.core.gestures import Gesture, GestureSet
from plushsense.deploy.package import ON_CHIP, emit
from plushsense.deploy.proof import device
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.targets import TARGETS, CompileSpec, build
from support.exports import bundle_of
from support.virtual_boards import run

HOOKS = Path(__file__).parents[1] / "boards" / "chip" / "hooks.c"
STRICT = ("-Wall", "-Wextra", "-Wconversion", "-Werror")
Change = Callable[[bytes], bytes | None]
EACH_WAY: list[tuple[str, str]] = [("cortex-m4", "tcp"), ("riscv32", "pty"), ("xtensa", "tcp")]
COUNTERS = {"riscv32": "mcycle", "xtensa": "CCOUNT"}


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small export with packages, and few golden vectors: a UART is slow."""
    gestures = GestureSet("three", (Gesture("pat", "positive"), Gesture("hit", "negative"), Gesture("rest", "none")))
    bundle = bundle_of("accel-3", window=60, gestures=gestures)
    out = tmp_path_factory.mktemp("chip") / "out"
    emit(integer_model(bundle), bundle, out)
    golden = Export(out).golden
    few = golden.answers[golden.answers[:, 1] < 300]
    (out / "golden" / "frames.bin").write_bytes(golden.frames[:300].astype("<u4").tobytes())
    (out / "golden" / "answers.bin").write_bytes(few.astype("<i4").tobytes())
    return out


@pytest.fixture
def no_scenarios(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Export, "scenarios", lambda export: [])


def chip(target: str, export: Path, out: Path, *flags: str, optimise: str = "-O2") -> Path:
    """Build the export's own program for a chip, with the bytes of the UART written here."""
    on_chip = export / ON_CHIP
    sources = [export / "plushsense.c", export / "plush_model.c", *sorted(on_chip.glob("*.c")), HOOKS]
    flags = ("-DPLUSH_HOOKS_ELSEWHERE", *STRICT, *flags)
    return build(target, sources, out, CompileSpec(None, optimise, flags), include=[export, on_chip]).file


def verified(capsys: pytest.CaptureFixture[str], export: Path, url: str) -> tuple[int, dict[str, Any], str]:
    code = main(["verify", str(export), "--device", url, "--json"])
    output = capsys.readouterr()
    return code, json.loads(output.out) if output.out else {}, output.err


@pytest.mark.parametrize(("target", "way"), EACH_WAY)
@pytest.mark.exhaustive_for("cortex-m4-tcp", "riscv32-pty")
def test_a_chip_of_qemu_answers_over_its_uart(
    target: str,
    way: str,
    target_here: Callable[[str], str],
    no_scenarios: None,
    export: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = list(TARGETS[target_here(target)].run)
    command[command.index("-serial") + 1] = "tcp:127.0.0.1:0,server=on" if way == "tcp" else "pty"
    if target == "xtensa":
        # It has a UART. The console of "sim" can lose bytes: QEMU's two threads change its buffer without a lock.
        command[command.index("sim")] = "lx60-nommu"
    program = chip(target, export, tmp_path)
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen([*command, str(program)], text=True, **streams) as qemu:
        try:
            told = qemu.stdout.readline()
            place = re.search(r"disconnected:tcp:(\S+:\d+)|redirected to (/dev/\S+)", told)
            assert place is not None, told
            url = f"tcp://{place[1]}" if place[1] else f"serial://{place[2]}"
            code, report, error = verified(capsys, export, url)
        finally:
            qemu.kill()
    assert code == 0, error
    assert report["passed"] and report["mismatches"] == 0 == report["max_abs_diff"]
    assert report["own"] is None, "what the chip runs is not known"
    assert [s["name"] for s in report["streams"]] == ["golden", "patch"] and report["decisions"] > 30
    (run,) = report["runs"]
    assert run["vectors"] == sum(s["answers"] for s in report["streams"])
    if target in COUNTERS:
        # They follow the emulator's instructions: some for each multiplication.
        macs = Export(export).model.network.arch.macs_per_step
        assert run["cycles"]["counter"] == COUNTERS[target] and run["cycles"]["steps"] > 30
        assert 5 * macs < run["cycles"]["per_step"] < 60 * macs and run["cycles"]["longest"] < run["cycles"]["per_step"]
    else:
        assert run["cycles"] is None, "QEMU's M4 has the registers of the counter, but it stands still"


def test_the_hooks_for_esp_idf_and_for_arm(export: Path, c_compiler: str, target_here: Callable[[str], str]) -> None:
    """A check of the syntax only, and of what stands in the object: neither ran on a chip."""

    def compiled(*words: object) -> subprocess.CompletedProcess[str]:
        hooks = export / ON_CHIP / "plush_hooks.c"
        command = [str(w) for w in (*words, *STRICT, f"-I{export}", f"-I{hooks.parent}", hooks)]
        return subprocess.run(command, capture_output=True, text=True)

    stubs = HOOKS.parents[1] / "idf"
    done = compiled(c_compiler, "-std=gnu17", "-fsyntax-only", "-DESP_PLATFORM", f"-I{stubs}")
    assert done.returncode == 0, done.stderr
    assert "Write plush_hook_begin(), plush_hook_read()" in compiled(c_compiler, "-fsyntax-only").stderr
    arm = TARGETS[target_here("cortex-m4")].compiler
    for core, counts in (("cortex-m4", True), ("cortex-m33", True), ("cortex-m0plus", False)):
        done = compiled(arm, "-mthumb", f"-mcpu={core}", "-O2", "-DPLUSH_HOOKS_ELSEWHERE", "-S", "-o", "-")
        assert done.returncode == 0 and ("DWT CYCCNT" in done.stdout) == counts, done.stderr


@pytest.fixture(scope="module")
def here(export: Path, c_compiler: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same program for this computer, with sanitizers, and with room for the models of half of the scenarios."""
    room = sorted(v.kept_bytes for v in Export(export).scenarios())[1]
    flags = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"-DPLUSH_DEVICE_ROOM_BYTES={room}")
    return chip("host", export, tmp_path_factory.mktemp("here"), *flags, optimise="-O0")


@contextmanager
def served(program: Path | None, sent: Change = bytes, received: Change = bytes) -> Iterator[str]:
    """Serve a chip's program at a TCP address; None: nothing answers.

    ``sent`` and ``received`` change what the chip sends and receives, a piece at a time; None closes the connection.
    """
    with socket.create_server(("127.0.0.1", 0)) as server:
        ended: list[subprocess.Popen[bytes]] = []

        def copy(read: Callable[[], bytes], write: Callable[[bytes], object], change: Change, done: Any) -> None:
            try:
                while (data := read()) and (changed := change(data)) is not None:
                    write(changed)
            except OSError:
                pass
            done()

        def serve() -> None:
            line, _ = server.accept()
            if program is None:
                copy(lambda: line.recv(4096), len, bytes, line.close)
                return
            done = subprocess.Popen([program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
            ended.append(done)
            answering = Thread(
                target=copy,
                args=(lambda: done.stdout.read(4096), line.sendall, sent, lambda: line.shutdown(socket.SHUT_RDWR)),
            )
            answering.start()
            copy(lambda: line.recv(4096), done.stdin.write, received, done.stdin.close)
            answering.join()
            line.close()

        thread = Thread(target=serve)
        thread.start()
        yield "tcp://{}:{}".format(*server.getsockname())
        thread.join(10)
        assert not thread.is_alive()
        for process in ended:
            assert process.wait(10) == 0, "a sanitizer complained"


@pytest.mark.parametrize("board", ["arduino", "pico"])
def test_the_hooks_of_arduino_and_of_the_pico_sdk(
    board: str,
    no_scenarios: None,
    export: Path,
    needs: Callable[..., None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With stand-ins for both, on standard input and output: neither ran on a board."""
    needs("gcc", "g++")
    on_chip, stubs, program = export / ON_CHIP, HOOKS.parents[1] / board, tmp_path / "program"
    includes = [f"-I{folder}" for folder in (export, on_chip, stubs)]
    define = "-DARDUINO=10819" if board == "arduino" else "-DLIB_PICO_STDIO=1"
    objects = []
    for source in (export / "plushsense.c", export / "plush_model.c", *sorted(on_chip.glob("*.c"))):
        objects.append(tmp_path / f"{source.stem}.o")
        run("gcc", "-std=c99", define, *STRICT, *includes, "-c", source, "-o", objects[-1])
    run("g++", "-std=c++17", *STRICT, *includes, stubs / "verify.cpp", *objects, "-o", program)
    with served(program) as url:
        code, report, error = verified(capsys, export, url)
    assert code == 0 and report["passed"] and report["decisions"] > 30, error


@pytest.mark.exhaustive
def test_scenarios_go_over_the_link_too(export: Path, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With models of their own. The messages of a boot loader come first."""
    first = [b"ets Jul 29 2019 12:21:46\r\nrst:0x1 (POWERON_RESET) PV\x00PVPP"]

    def booting(data: bytes) -> bytes:
        return (first.pop() if first else b"") + data

    with served(here, sent=booting) as url:
        code, report, _ = verified(capsys, export, url)
    assert code == 0 and report["passed"]
    assert [s["name"] for s in report["streams"]] == ["golden", "patch", "scenario"]
    assert report["vectors"] == sum(s["answers"] for s in report["streams"]) > 1000
    (left_out,) = report["not_run"]
    assert left_out["what"] == "scenario" and "of room, of which 2 need more" in left_out["why"]


def test_wrong_answers_and_words_of_a_chip(
    no_scenarios: None, export: Path, c_compiler: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for n, (old, new, words) in enumerate(
        (
            ("((2u * t * times >> after) + 1u) >> 1;", "(2u * t * times >> after) >> 1;", "should be"),
            ("#define HEAD_BYTES 16u", "#define HEAD_BYTES 20u", "plush_begin() says PLUSH_DAMAGED"),
        )
    ):
        copy = Path(shutil.copytree(export, tmp_path / f"out{n}"))
        text = (copy / "plushsense.c").read_text(encoding="utf-8")
        assert text.count(old) == 1
        (copy / "plushsense.c").write_text(text.replace(old, new), encoding="utf-8")
        with served(chip("host", copy, tmp_path / f"chip{n}", optimise="-O0")) as url:
            code, report, _ = verified(capsys, export, url)
        assert code == 1 and not report["passed"] and report["mismatches"] > 0
        assert words in report["first"] and report["first"].startswith("On tcp://") and report["first"].count("\n") == 0


def after(n: int, change: Change) -> Change:
    """Leave so many bytes alone, then change one piece."""
    passed = 0

    def changed(data: bytes) -> bytes | None:
        nonlocal passed
        before, passed = passed, passed + len(data)
        return change(data) if before <= n < passed else data

    return changed


def flipped(data: bytes) -> bytes:
    return data[:-1] + bytes([data[-1] ^ 4])


LOG = b"I (312) wifi: connected\r\n"
BROKEN: dict[str, tuple[Change, Change, str]] = {
    "damaged": (after(3000, flipped), bytes, "sent (a packet with a wrong checksum|bytes that are no packet)"),
    "a log": (
        after(3000, lambda data: LOG + data),
        bytes,
        "and that nothing else, such as a log",
    ),
    "gone": (after(3000, lambda data: None), bytes, "closed the connection before all results had come"),
    "damaged on the way": (bytes, after(3000, flipped), "gave up, because a packet of the computer came damaged"),
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_link_is_one_sentence(
    how: str, no_scenarios: None, export: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sent, received, words = BROKEN[how]
    with served(here, sent, received) as url:
        code, report, err = verified(capsys, export, url)
    assert (code, report) == (2, {}) and re.search(words, err) and url in err
    assert len([line for line in err.splitlines() if line.startswith("plushsense")]) == 1


def test_silence_is_one_sentence(
    no_scenarios: None, export: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(device, "HELLO_S", 0.2)
    with served(None) as url:
        code, report, err = verified(capsys, export, url)
    assert (code, report) == (2, {}) and "did not answer for 0.2 s" in err
    monkeypatch.setattr(device, "HELLO_S", 10.0)
    monkeypatch.setattr(device, "SILENT_S", 0.5)
    with served(here, received=after(3000, lambda data: b"")) as url:
        code, report, err = verified(capsys, export, url)
    assert (code, report) == (2, {}) and "fell silent for 0.5 s in golden, after" in err


def test_a_chip_that_was_left_alone_begins_again(
    no_scenarios: None, export: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The computer was stopped in the middle of a packet, and comes back."""
    packet = b"S\x00\x00"
    begin = b"PV" + packet + zlib.crc32(packet).to_bytes(4, "little")
    before = [begin + b"PVD\x00\x01" + bytes(40)]

    def late(data: bytes) -> bytes:
        return (before.pop() if before else b"") + data

    with served(here, received=late) as url:
        code, report, _ = verified(capsys, export, url)
    assert code == 0 and report["passed"]


def test_another_model_and_wrong_words(
    no_scenarios: None, export: Path, here: Path, own: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with served(here) as url:
        code, report, err = verified(capsys, own, url)
    assert (code, report) == (2, {}) and "flash the harness of this export" in err
    code, _, err = verified(capsys, own, "virtual://?person=7")
    assert code == 2 and "carries no bytes both ways: accepted are serial:///dev/ttyUSB0 and tcp://host:port" in err
    code, _, err = verified(capsys, own, "serial:///dev/no-such-port")
    assert code == 2 and "no port" in err
    for words in (["--target", "host"], ["--trust"]):
        assert main(["verify", str(own), "--device", "tcp://127.0.0.1:1", *words]) == 2
        assert "leave out --device" in capsys.readouterr().err
