"""The C library: bit for bit the answers of ``models/integer``, whatever comes; quiet whatever it is given."""

from __future__ import annotations

import ctypes
import math
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

TESTS = Path(__file__).parents[1]
sys.path.insert(0, str(TESTS))

from c_toy import C_FOLDER, Seat  # noqa: E402
from integers import INT32, any_frames, edged_model, models, plain_model  # noqa: E402
from plushsense.deploy.emit import TOY_BYTES  # noqa: E402
from plushsense.deploy.golden import answers_of  # noqa: E402
from plushsense.models.fixed import exponentials  # noqa: E402
from plushsense.models.image import IntegerModel, head, memory_bytes  # noqa: E402

OK, NOT_A_MODEL, OTHER_VERSION, DAMAGED, TOO_SMALL = range(5)


def seat(library: Any, model: IntegerModel, **how: int) -> Any:
    return Seat(library, model.to_bytes(), len(model.layout.channels), model.network.arch.classes, **how)


# ---- The same answers ------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(models(), st.integers(0, 1 << 30))
def test_any_network_any_stream(c_library: Any, plain_c_library: Any, model: IntegerModel, seed: int) -> None:
    frames = any_frames(model, seed)
    wanted = answers_of(model, frames)
    for library in (c_library, plain_c_library):
        toy = seat(library, model)
        assert toy.status == OK
        assert np.array_equal(toy.push(frames), wanted)
        assert library.seat_answers(toy.toy) == len(wanted)


def test_most_random_streams_are_answered(c_library: Any) -> None:
    """The test above is worth something only while its models get through the warming and decide this and that."""
    tracked, gestures = 0, set()
    for seed in range(6):
        model = plain_model(seed)
        answers = seat(c_library, model).push(any_frames(model, seed, 2000))
        assert np.array_equal(answers, answers_of(model, any_frames(model, seed, 2000)))
        tracked += int((answers[:, 3] == 1).sum())
        gestures |= set(answers[answers[:, 3] == 1, 4].tolist())
    assert tracked > 500
    assert len(gestures) == 3


def test_every_edge(c_library: Any, plain_c_library: Any) -> None:
    model = edged_model()
    for seed in range(4):
        frames = any_frames(model, seed, 700)
        wanted = answers_of(model, frames)
        for library in (c_library, plain_c_library):
            assert np.array_equal(seat(library, model).push(frames), wanted)
        logits, best = wanted[wanted[:, 3] == 1][:, 9:18], wanted[wanted[:, 3] == 1][:, 4]
        # Held within their limits; a tie goes to the first.
        assert (logits.min(), logits.max()) == (-16384, 16384)
        assert np.array_equal(logits[:, 0], logits[:, 1])
        assert 1 not in best


@settings(max_examples=30, deadline=None)
@given(models(longest=200))
def test_memory_is_what_python_says(c_library: Any, model: IntegerModel) -> None:
    image = model.to_bytes()
    assert c_library.plush_memory_bytes(image, len(image)) == memory_bytes(model)
    assert seat(c_library, model, too_few=1).status == TOO_SMALL
    assert seat(c_library, model).status == OK


def test_misaligned_or_no_memory(c_library: Any) -> None:
    for off in (1, 2, 3):
        assert seat(c_library, plain_model(), off=off).status == TOO_SMALL
    image = plain_model().to_bytes()
    toy = (ctypes.c_uint64 * 128)()
    assert c_library.plush_begin(toy, image, len(image), None, 1 << 20) == TOO_SMALL


# ---- Restarts, several toys, other models ----------------------------------------------------------------------------


def test_a_restart_is_a_fresh_toy(c_library: Any) -> None:
    model = plain_model()
    before, after = any_frames(model, 1, 400, start=0), any_frames(model, 2, 400, start=90_000)
    used, fresh = seat(c_library, model), seat(c_library, model)
    used.push(before)
    c_library.seat_restart(used.toy)
    got, wanted = used.push(after), fresh.push(after)
    # The counts of restarts and invalid values, and the frames' numbers, go on.
    for column in (0, 7, 8):
        got[:, column] -= got[0, column] - wanted[0, column]
    assert np.array_equal(got, wanted)
    assert (wanted[:, 3] == 1).any()


def test_a_gap_is_a_fresh_toy(c_library: Any) -> None:
    model = plain_model()
    before, after = any_frames(model, 1, 400, start=0), any_frames(model, 2, 400, start=90_000)
    together = seat(c_library, model).push(np.concatenate([before, after]))
    alone = seat(c_library, model).push(after)
    later = together[together[:, 0] >= 400]
    assert np.array_equal(later[:, 1:7], alone[:, 1:7])
    assert np.array_equal(later[:, 9:], alone[:, 9:])
    assert later[0, 7] == together[together[:, 0] < 400][-1, 7] + 1


def test_toys_side_by_side(c_library: Any) -> None:
    """Two models and four toys, fed in turns: each as if it were alone."""
    all_models = [plain_model(1), plain_model(2, step=3, pool=9, classes=5)] * 2
    frames = [any_frames(m, 10 + i, 600) for i, m in enumerate(all_models)]
    toys = [seat(c_library, m) for m in all_models]
    got: list[list[np.ndarray]] = [[] for _ in toys]
    for at in range(0, 600, 7):
        for answers, toy, rows in zip(got, toys, frames, strict=True):
            answers.append(toy.push(rows[at : at + 7]))
    for answers, model, rows in zip(got, all_models, frames, strict=True):
        assert np.array_equal(np.concatenate(answers), answers_of(model, rows))


def test_another_model_in_the_same_toy(c_library: Any) -> None:
    """The bytes are swapped while the program runs; nothing is compiled again."""
    first, second = plain_model(1), plain_model(7, classes=6, step=2, pool=14)
    toy = seat(c_library, first)
    toy.push(any_frames(first, 3, 300))
    for model in (second, first):
        image = model.to_bytes()
        assert c_library.seat_begin_again(toy.toy, image, len(image)) == OK
        toy.classes = model.network.arch.classes
        frames = any_frames(model, 4, 500)
        assert np.array_equal(toy.push(frames), answers_of(model, frames))


def test_names(c_library: Any) -> None:
    model = plain_model()
    toy = seat(c_library, model)
    assert [c_library.seat_name(toy.toy, i) for i in range(4)] == [b"gesture 0", b"gesture 1", b"gesture 2", b""]
    assert c_library.seat_title(toy.toy).decode() == model.network.arch.title


# ---- Counts near 2^32 ------------------------------------------------------------------------------------------------


def test_counts_wrap_and_nothing_else_changes(c_library: Any) -> None:
    model = plain_model()
    frames = any_frames(model, 12, 1500, start=5)
    frames[::50, 1] = INT32[0]  # invalid values
    frames[700:, 0] += 5000  # a gap
    young, old = seat(c_library, model), seat(c_library, model)
    by = 2**32 - 40
    c_library.seat_age(old.toy, ctypes.c_uint32(by))
    wanted, got = young.push(frames), old.push(frames)
    assert c_library.seat_answers(old.toy) == (c_library.seat_answers(young.toy) + by) % 2**32
    assert c_library.seat_answers(old.toy) < c_library.seat_answers(young.toy)
    for column in (7, 8):
        assert np.array_equal(got[:, column].view(np.uint32), (wanted[:, column].astype(np.int64) + by) % 2**32)
    # A restart sets the samples to 0, whatever they were.
    since = wanted[:, 2].astype(np.int64) + np.where(wanted[:, 7] == 0, by, 0)
    assert np.array_equal(got[:, 2].view(np.uint32), since % 2**32)
    same = [0, 1, 3, 4, 5, 6, *range(9, wanted.shape[1])]
    assert np.array_equal(got[:, same], wanted[:, same])
    assert (got[:, 2].view(np.uint32) < 1000).any()


def test_late_and_early_times_are_alike(c_library: Any) -> None:
    """The last minute before the clock's wrap gives the answers of the first one."""
    model = plain_model()
    frames = any_frames(model, 5, 1500, start=0)
    early = seat(c_library, model).push(frames)
    shift = 2**32 - 1 - int(frames[:, 0].max())
    frames[:, 0] += shift
    late = seat(c_library, model).push(frames)
    assert np.array_equal(late[:, 1].view(np.uint32), early[:, 1].view(np.uint32) + np.uint32(shift))
    early[:, 1] = late[:, 1]
    assert np.array_equal(late, early)


def test_the_clocks_wrap_is_a_restart(c_library: Any) -> None:
    model = plain_model()
    frames = any_frames(model, 5, 1000, start=0)
    frames[:, 0] = (np.arange(1000) * 10 + 2**32 - 5000) & 0xFFFFFFFF
    answers = seat(c_library, model).push(frames)
    assert np.array_equal(answers, answers_of(model, frames))
    assert answers[0, 7] == 0
    assert answers[-1, 7] == 1
    warming = answers[answers[:, 7] == 1][:, 3]
    assert warming[0] == 0
    assert warming[-1] == 1


# ---- Bytes that are no model -----------------------------------------------------------------------------------------


def test_what_plush_begin_says(c_library: Any) -> None:
    image = plain_model().to_bytes()

    def status(bytes_: bytes) -> int:
        said = Seat(c_library, bytes_, 4, 3).status
        assert (c_library.plush_memory_bytes(bytes_, len(bytes_)) == 0) == (said != OK)
        return int(said)

    assert status(image) == OK
    assert status(image + b"what stands behind it in flash") == OK
    assert status(b"") == status(image[:15]) == status(b"PLSX" + image[4:]) == NOT_A_MODEL
    assert status(image[:4] + b"\2" + image[5:]) == OTHER_VERSION
    for cut in (16, 17, len(image) // 2, len(image) - 1):
        assert status(image[:cut]) == DAMAGED
    for at in range(16, len(image), 7):
        flipped = bytearray(image)
        flipped[at] ^= 1 << at % 8
        assert status(bytes(flipped)) == DAMAGED
    assert c_library.plush_memory_bytes(None, 100) == 0


def sealed(body: bytes) -> bytes:
    """With a good checksum, as somebody who writes an image by hand would have it."""
    return head(body) + body


def test_a_good_checksum_makes_no_model(c_library: Any) -> None:
    """Every count that could lead a reader astray is refused, one at a time."""
    body = plain_model().to_bytes()[16:]
    layer = 28 + 4 * 8 + (2 + 1 + 12) + (2 + 3 + 12)
    assert struct.unpack_from("<HHHH", body, layer) == (5, 2, 2, 6)
    changes = {
        "no layers": (0, b"\0"),
        "five layers": (0, b"\5"),
        "no channels": (1, b"\0"),
        "more channels than follow": (1, b"\xff"),
        "no inputs": (2, b"\0"),
        "other inputs than the first layer reads": (2, b"\1"),
        "no classes": (3, b"\0"),
        "more classes than follow": (3, b"\xff"),
        "step 0": (4, struct.pack("<H", 0)),
        "step 258": (4, struct.pack("<H", 258)),
        "no blocks": (6, struct.pack("<H", 0)),
        "another span": (8, struct.pack("<I", 38)),
        "period 0": (12, struct.pack("<I", 0)),
        "a giant period": (12, struct.pack("<I", 1 << 31)),
        "gap 0": (16, struct.pack("<I", 0)),
        "a gap beyond 32 bits of interpolation": (16, struct.pack("<I", (1 << 22) + 1)),
        "no units a ms": (20, struct.pack("<I", 0)),
        "no smoothing": (24, struct.pack("<H", 0)),
        "smoothing above 1": (24, struct.pack("<H", 32769)),
        "an unknown input": (60, b"\2"),
        "a channel of two parts": (60, b"\0\2"),
        "an input of no part": (61, b"\0"),
        "a part that is no channel": (62, b"\4"),
        "bias": (67, struct.pack("<i", 1 << 30)),
        "input multiplier": (71, struct.pack("<H", 32768)),
        "input shift before": (73, b"\x11"),
        "input shift after": (74, b"\x1f"),
        "kernel 0": (layer, struct.pack("<H", 0)),
        "kernel beyond the end": (layer, struct.pack("<H", 65535)),
        "dilation 0": (layer + 2, struct.pack("<H", 0)),
        "more rows than 16 bits": (layer + 2, struct.pack("<H", 65535)),
        "reads other channels": (layer + 4, struct.pack("<H", 3)),
        "no filters": (layer + 6, struct.pack("<H", 0)),
        "more filters than follow": (layer + 6, struct.pack("<H", 65535)),
        "multiplier": (layer + 12, struct.pack("<H", 32768)),
        "shift before": (layer + 14, b"\x1f"),
        "shift after": (layer + 15, b"\xff"),
        "an unknown affect": (body.index(b"gesture 1") - 1, b"\4"),
        "a label without end": (body.index(b"gesture 2") + 9, b"x"),
        "a title without end": (len(body) - 1, b"x"),
    }
    for what, (at, change) in changes.items():
        wrong = sealed(body[:at] + change + body[at + len(change) :])
        assert Seat(c_library, wrong, 4, 3).status == DAMAGED, what
    assert Seat(c_library, sealed(body + b"\0"), 4, 3).status == DAMAGED
    assert Seat(c_library, sealed(body), 4, 3).status == OK


def test_a_toy_that_never_began_is_quiet(c_library: Any) -> None:
    frames = any_frames(plain_model(), 1, 50)
    for toy in (seat(c_library, plain_model(), too_few=1), Seat(c_library, b"no model at all.....", 4, 3)):
        assert toy.status != OK
        assert len(toy.push(frames)) == 0
        c_library.seat_restart(toy.toy)
        assert len(toy.push(frames)) == 0
        assert c_library.seat_name(toy.toy, 0) == c_library.seat_title(toy.toy) == b""
    never = (ctypes.c_uint64 * 128)()
    assert c_library.plush_push(never, 5, (ctypes.c_int32 * 255)()) == 0


def cases(*all_cases: tuple[bytes, np.ndarray]) -> bytes:
    return b"".join(
        struct.pack("<I", len(image))
        + image
        + struct.pack("<II", *frames.shape)
        + (frames & 0xFFFFFFFF).astype("<u4").tobytes()
        for image, frames in all_cases
    )


def run(program: Path, file: Path) -> bytes:
    done = subprocess.run([program, file], capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr.decode()[-3000:]
    return done.stdout


def test_sanitizers_find_nothing_in_good_models(sanitized: list[Path], tmp_path: Path) -> None:
    """Extremes on purpose: full ranges, garbage, gaps, saturated scales."""
    found = []

    @settings(max_examples=25, deadline=None, database=None)
    @given(models(longest=200), st.integers(0, 1 << 30))
    def collect(model: IntegerModel, seed: int) -> None:
        frames = any_frames(model, seed, 450)
        wanted = answers_of(model, frames)
        found.append((model.to_bytes(), frames, struct.pack("<iI", 0, len(wanted)) + wanted.astype("<i4").tobytes()))

    collect()
    (tmp_path / "cases").write_bytes(cases(*((image, frames) for image, frames, _ in found)))
    for program in sanitized:
        assert run(program, tmp_path / "cases") == b"".join(wanted for *_, wanted in found)


def test_sanitizers_find_nothing_in_any_bytes(sanitized: list[Path], tmp_path: Path) -> None:
    """Thousands of damaged images, most with a good checksum: refused or used, never read or written out of bounds."""
    rng = np.random.default_rng(5)
    frames = any_frames(plain_model(), 3, 60)
    wide = np.zeros((60, 40), dtype=np.int64)
    wide[:, : frames.shape[1]] = frames
    base = plain_model().to_bytes()[16:]
    layers = [m.start() for m in re.finditer(re.escape(struct.pack("<HHHH", 4, 3, 6, 5)), base)] + [92]
    spots = [
        *range(28),
        *range(60, 92),
        *(at + i for at in layers for i in range(24)),
        *range(len(base) - 60, len(base)),
    ]
    edges = [0, 1, 2, 3, 4, 5, 127, 128, 254, 255]
    images = []
    for _ in range(4000):
        body = bytearray(base)
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.choice(spots)) if rng.random() < 0.8 else int(rng.integers(len(body)))
            body[at] = int(rng.choice(edges)) if rng.random() < 0.6 else int(rng.integers(256))
        kind = rng.random()
        if kind < 0.1:
            body = body[: int(rng.integers(len(body)))]
        elif kind < 0.15:
            body += bytes(rng.integers(0, 256, 40, dtype=np.uint8))
        # A span that fits the changed layers lets more of them through.
        if kind > 0.4 and len(body) > 130:
            rows = 0
            at = 92
            kernel, dilation = struct.unpack_from("<HH", body, at)
            rows += (kernel - 1) * dilation
            rows += sum((struct.unpack_from("<H", base, at)[0] - 1) * 3 for at in layers[:1])
            step, blocks = struct.unpack_from("<HH", body, 4)
            struct.pack_into("<I", body, 8, (rows + step * blocks) & 0xFFFFFFFF)
        image = sealed(bytes(body))
        if rng.random() < 0.05:
            image = bytes(rng.integers(0, 256, int(rng.integers(0, 60)), dtype=np.uint8))
        images.append((image, wide))
    (tmp_path / "cases").write_bytes(cases(*images))
    said = {run(program, tmp_path / "cases") for program in sanitized}
    assert len(said) == 1
    out, at, statuses = said.pop(), 0, []
    for image, _ in images:
        status, made = struct.unpack_from("<iI", out, at)
        statuses.append(status)
        classes = image[16 + 3] if status == OK else 0
        at += 8 + 4 * made * (9 + 2 * classes)
    assert at == len(out)
    assert statuses.count(OK) > 200
    assert statuses.count(DAMAGED) > 1000


# ---- The small functions ---------------------------------------------------------------------------------------------

int32s = st.integers(*INT32) | st.sampled_from((*INT32, 0, -1, 1))


@settings(max_examples=300, deadline=None)
@given(int32s, st.integers(0, 30))
def test_shift_down(c_library: Any, v: int, n: int) -> None:
    assert c_library.try_shift_down(v, n) == v >> n
    assert c_library.try_as_signed(ctypes.c_uint32(v)) == v


@settings(max_examples=300, deadline=None)
@given(
    st.integers(0, 2**64 - 1)
    | st.integers(0, 2**32 - 1).map(lambda r: r * r)
    | st.integers(1, 2**32 - 1).map(lambda r: r * r - 1)
)
def test_square_root(c_library: Any, v: int) -> None:
    assert c_library.try_root(v) == math.isqrt(v)


@settings(max_examples=200, deadline=None)
@given(int32s)
def test_square(c_library: Any, v: int) -> None:
    assert c_library.try_square(v) == v * v


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_interpolation_in_32_bits(c_library: Any, data: st.DataObject) -> None:
    """Of any distance and any gap that a model may have; ``add`` is at most half of ``by``."""
    gap = data.draw(st.sampled_from((1, 30, 20_000, 1 << 22)) | st.integers(1, 1 << 22))
    between = data.draw(st.integers(1, gap) | st.just(gap))
    into = data.draw(st.integers(0, between) | st.just(between))
    distance = data.draw(st.integers(0, 2**32 - 1) | st.just(2**32 - 1))
    add = data.draw(st.sampled_from((between, between - 1)))
    narrow = (2**32 - 1 - gap) // (2 * gap)
    got = c_library.try_part_of(ctypes.c_uint32(distance), 2 * into, 2 * between, add, ctypes.c_uint32(narrow))
    assert got == (distance * 2 * into + add) // (2 * between)


def test_exponentials(c_library: Any) -> None:
    coarse, fine = exponentials()
    for d in range(4200):
        assert c_library.try_exponential(d) == (int(coarse[d >> 6] * fine[d & 63]) >> 16 if d < 4096 else 0)
    assert c_library.try_exponential(2 * (1 << 14)) == 0


def test_the_checksum_is_the_one_of_zip(c_library: Any) -> None:
    image = plain_model().to_bytes()
    assert struct.unpack_from("<I", image, 12)[0] == zlib.crc32(image[16:])


# ---- The source ------------------------------------------------------------------------------------------------------

STRICT = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow", "-Werror"]


@pytest.mark.parametrize("cc", ["gcc", "clang"])
@pytest.mark.parametrize("plain", [[], ["-DPLUSH_PLAIN"]], ids=["fast", "plain"])
def test_no_warning(cc: str, plain: list[str], needs: Callable[..., None], tmp_path: Path) -> None:
    needs(cc)
    for language, levels in ((["-std=c99"], ("-O0", "-O2", "-O3")), (["-x", "c++", "-std=c++11"], ("-O2",))):
        for level in levels:
            subprocess.run(
                [cc, *language, level, *STRICT, *plain, "-c", C_FOLDER / "plushsense.c", "-o", tmp_path / "o"],
                check=True,
            )


@pytest.mark.parametrize("cc", ["gcc", "clang"])
def test_it_needs_three_functions_of_the_c_library(cc: str, needs: Callable[..., None], tmp_path: Path) -> None:
    """No floats, no heap; on a core of 32 bits no 64-bit division either."""
    needs(cc, "nm")
    allowed = {"memcpy", "memset", "memcmp"}
    for flags in (["-O2"], ["-O0"], ["-O2", "-DPLUSH_PLAIN"]):
        subprocess.run(
            [cc, "-std=c99", *flags, "-fno-pic", "-fno-stack-protector", "-c", C_FOLDER / "plushsense.c"],
            check=True,
            cwd=tmp_path,
        )
        listed = subprocess.run(["nm", "-u", "plushsense.o"], check=True, cwd=tmp_path, capture_output=True, text=True)
        assert set(re.findall(r"U (\w+)", listed.stdout)) <= allowed


@pytest.mark.parametrize(
    ("cc", "flags", "also"),
    [
        ("arm-none-eabi-gcc", ["-mcpu=cortex-m4", "-mthumb"], set()),
        ("arm-none-eabi-gcc", ["-mcpu=cortex-m0", "-mthumb"], {"__aeabi_uidiv", "__aeabi_uidivmod", "__aeabi_llsl"}),
        ("xtensa-lx106-elf-gcc", ["-mlongcalls"], {"__udivsi3", "__umodsi3"}),
    ],
    ids=["cortex-m4", "cortex-m0", "lx106"],
)
def test_small_cores_need_no_long_division(
    cc: str, flags: list[str], also: set[str], needs: Callable[..., None], tmp_path: Path
) -> None:
    needs(cc)
    (tmp_path / "string.h").write_text(
        "#include <stddef.h>\nvoid *memcpy(void *, const void *, size_t);\nvoid *memset(void *, int, size_t);\n"
        "int memcmp(const void *, const void *, size_t);\n"
    )
    common = [cc, *flags, "-std=c99", "-ffreestanding", f"-I{tmp_path}", f"-I{C_FOLDER}"]
    for level in ("-O2", "-Os"):
        subprocess.run(
            [*common, level, *STRICT, "-c", C_FOLDER / "plushsense.c", "-o", "plushsense.o"], check=True, cwd=tmp_path
        )
        listed = subprocess.run(
            [cc.replace("gcc", "nm"), "-u", "plushsense.o"], check=True, cwd=tmp_path, capture_output=True, text=True
        )
        assert set(re.findall(r"U (\w+)", listed.stdout)) <= {"memcpy", "memset", "memcmp"} | also
    # No data that would have to be set up, and the size of a toy that exports speak of.
    sizes = subprocess.run(
        [cc.replace("gcc", "size"), "plushsense.o"], check=True, cwd=tmp_path, capture_output=True, text=True
    )
    assert sizes.stdout.splitlines()[1].split()[1:3] == ["0", "0"]
    (tmp_path / "size.c").write_text(
        f'#include "plushsense.h"\nchar fits[sizeof(plush_toy) <= {TOY_BYTES} ? 1 : -1];\n'
    )
    subprocess.run([*common, "-c", "size.c"], check=True, cwd=tmp_path)


def test_cppcheck(needs: Callable[..., None]) -> None:
    needs("cppcheck")
    for define in ("-UPLUSH_PLAIN", "-DPLUSH_PLAIN"):
        done = subprocess.run(
            [
                "cppcheck",
                "--enable=all",
                "--inconclusive",
                "--std=c99",
                "--error-exitcode=1",
                "--quiet",
                define,
                # What a library is: its functions are called by others; its headers are the system's.
                "--suppress=unusedFunction",
                "--suppress=missingIncludeSystem",
                "--suppress=unusedStructMember",
                C_FOLDER / "plushsense.c",
            ],
            capture_output=True,
            text=True,
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_clang_tidy(needs: Callable[..., None]) -> None:
    needs("clang-tidy")
    checks = [
        "-*",
        "bugprone-*",
        "cert-*",
        "clang-analyzer-*",
        "misc-*",
        "performance-*",
        "portability-*",
        "readability-*",
        # Short names of arithmetic, the numbers of a format, braces of one-line bodies: a matter of taste.
        "-readability-identifier-length",
        "-readability-magic-numbers",
        "-readability-braces-around-statements",
        "-readability-isolate-declaration",
        "-readability-function-cognitive-complexity",
        "-readability-uppercase-literal-suffix",
        "-bugprone-easily-swappable-parameters",
        # Every size and offset fits 32 bits: read_model() sees to that.
        "-bugprone-implicit-widening-of-multiplication-result",
        # Asks for memcpy_s, which nobody has.
        "-clang-analyzer-security.insecureAPI.DeprecatedOrUnsafeBufferHandling",
    ]
    for define in ("-UPLUSH_PLAIN", "-DPLUSH_PLAIN"):
        done = subprocess.run(
            [
                "clang-tidy",
                "--quiet",
                "--warnings-as-errors=*",
                f"--checks={','.join(checks)}",
                C_FOLDER / "plushsense.c",
                "--",
                "-std=c99",
                define,
            ],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-4000:]
