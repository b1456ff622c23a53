"""What the C makes of bytes: a model, or a refusal; never a read or write out of bounds."""

from __future__ import annotations

import ctypes
import os
import re
import struct
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

TESTS = Path(__file__).parents[1]


from plushsense.deploy.golden import EVENT, FAULT, HEAD, HEALTH, ToyRows, answers_of, column
from plushsense.runtime.events import ENDED
from plushsense.runtime.gate import JERK, LEVEL, MOST_SIZE, GateSettings, Rule, Signal, Term
from plushsense.runtime.image import CALIBRATED, DEVIATING, IMAGE_VERSION, IntegerModel, image_head
from support.c_toy import Seat, seat
from support.integers import any_frames, edged_model, models, plain_model, ruled_model, vector_model

OK, NOT_A_MODEL, OTHER_VERSION, DAMAGED, TOO_SMALL, OTHER_LAYOUT = range(6)


def answers_over_swaps(parts: Sequence[tuple[IntegerModel, NDArray[np.int64]]]) -> list[NDArray[np.int32]]:
    """The rows of each model and its frames when models are swapped during a stream.

    A swap ends an open event: its row is the last one of the part and has the index of the next frame.
    """
    rows, tables = ToyRows(parts[0][0]), []
    for n, (_, frames) in enumerate(parts, 1):
        rows.feed(frames)
        following = ToyRows(parts[n][0], rows.frame) if n < len(parts) else rows
        if following is not rows:
            rows.add(following.toy.continue_from(rows.toy))
        tables.append(rows.take())
        rows = following
    return tables


def test_what_plush_begin_says(c_library: Any) -> None:
    image = plain_model().to_bytes()

    def status(bytes_: bytes) -> int:
        output = Seat(c_library, bytes_, 4, 3).status
        assert (c_library.plush_memory_bytes(bytes_, len(bytes_)) == 0) == (output != OK)
        return int(output)

    assert status(image) == OK
    assert status(image + b"what stands behind it in flash") == OK
    assert status(b"") == status(image[:15]) == status(b"PLSX" + image[4:]) == NOT_A_MODEL
    assert status(image[:4] + b"\3" + image[5:]) == OTHER_VERSION == status(image[:4] + b"\5" + image[5:])
    for cut in (16, 17, len(image) // 2, len(image) - 1):
        assert status(image[:cut]) == DAMAGED
    for at in range(16, len(image), 7):
        flipped = bytearray(image)
        flipped[at] ^= 1 << at % 8
        assert status(bytes(flipped)) == DAMAGED
    assert c_library.plush_memory_bytes(None, 100) == 0


def sealed(body: bytes, version: int = IMAGE_VERSION) -> bytes:
    """With a good checksum, as somebody who writes an image by hand would have it."""
    return image_head(body, version=version) + body


def test_a_good_checksum_makes_no_model(c_library: Any) -> None:
    """Every count that could lead a reader astray is refused, one at a time."""
    body = plain_model().to_bytes()[16:]
    layer = 28 + 4 * 12 + (3 + 1) + (3 + 3) + 4 + 2 + 2 * 12
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
        "a gap of 1001 samples": (16, struct.pack("<I", 1001 * 10)),
        "no units a ms": (20, struct.pack("<I", 0)),
        "no smoothing": (24, struct.pack("<H", 0)),
        "smoothing above 1": (24, struct.pack("<H", 32769)),
        "a zero too far from the range": (36, struct.pack("<i", -1)),
        "an unknown input": (76, b"\3"),
        "a channel of two parts": (76, b"\0\2"),
        "an input of no part": (77, b"\0"),
        "a shift without a mean": (78, b"\1"),
        "a part that is no channel": (79, b"\4"),
        "vectors that are not there": (86, b"\1"),
        "kernels of no vector": (87, b"\2"),
        "taps of no vector": (88, b"\1"),
        "a filling that is not 0": (91, b"\1"),
        "bias": (96, struct.pack("<i", 1 << 30)),
        "input multiplier": (100, struct.pack("<H", 32768)),
        "input shift before": (102, b"\x11"),
        "input shift after": (103, b"\x1f"),
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
        "an unknown affect": (body.index(b"gesture 0") - 2, b"\x08"),
        "a label without end": (body.index(b"gesture 0"), b"x" * (len(body) - body.index(b"gesture 0"))),
        "no rules": (len(body) - 2, b"\xff\xff"),
    }
    for what, (at, change) in changes.items():
        wrong = sealed(body[:at] + change + body[at + len(change) :])
        assert Seat(c_library, wrong, 4, 3).status == DAMAGED, what
    assert Seat(c_library, sealed(body + b"\0"), 4, 3).status == DAMAGED
    assert Seat(c_library, sealed(body), 4, 3).status == OK


def test_a_good_checksum_makes_no_vector_layer(c_library: Any) -> None:
    """Every number of the layer that could lead a reader or a sum astray is refused, one at a time."""
    model = vector_model()
    body = model.to_bytes()[16:]
    inputs = 28 + 4 * 12
    gravity, layer = inputs + 6 + 4 * 4, inputs + 6 + 7 * 4
    kernel, high = layer + 5, 28 + 12 + 4
    assert body[gravity : gravity + 3] == b"\2\1\6" and body[layer : layer + 4] == b"\1\2\3\0"
    changes = {
        "a mean over too many samples": (gravity + 2, b"\x10"),
        "gravity of two channels": (gravity + 1, b"\2"),
        "gravity whose mean leaves 32 bits": (high, struct.pack("<i", (1 << 19) + 1)),
        "9 vectors": (layer, b"\x09"),
        "more vectors than axes": (layer, b"\2"),
        "one kernel": (layer + 1, b"\1"),
        "65 kernels": (layer + 1, b"\x41"),
        "no taps": (layer + 2, b"\0"),
        "256 taps": (layer + 3, b"\1"),
        "shift of the axes": (layer + 4, b"\x21"),
        "shift of a kernel": (kernel, b"\x1f"),
        "a sum beyond its bits": (kernel, bytes([int(model.network.vectors.down[0, 0]) - 1])),
    }
    for what, (at, change) in changes.items():
        wrong = sealed(body[:at] + change + body[at + len(change) :], model.image_version)
        assert Seat(c_library, wrong, 4, 3).status == DAMAGED, what
    for cut in range(inputs, layer + 200):
        assert Seat(c_library, sealed(body[:cut], model.image_version), 4, 3).status == DAMAGED
    assert Seat(c_library, sealed(body, model.image_version), 4, 3).status == OK
    assert model.image_version == IMAGE_VERSION + DEVIATING
    assert Seat(c_library, sealed(body), 4, 3).status == DAMAGED, "half of the weights of the dense layer are left"


def test_a_good_checksum_makes_no_rules(c_library: Any) -> None:
    """Every setting that the plans refuse, one at a time."""
    model = ruled_model(4)
    one = Signal(JERK, (0, 1), 16, 24, 15, 15, 1 << 20)
    two = Signal(LEVEL, (1,), 1, 0, 1, 1, 1)
    rule = Rule((Term(1, MOST_SIZE, -1, 255), Term(0, 1, 1, 1)), 3, 2, 255, 65535)
    model = replace(model, rules=replace(model.rules, gate=GateSettings((one, two), (rule,))))
    body = model.to_bytes()[16:]
    term = len(body) - 16
    rule_at, level, jerk = term - 6, term - 6 - 11, term - 6 - 11 - 12
    gate = jerk - 2
    health = gate - 8 - 4 * 8
    events = health - 24
    assert body[gate : gate + 2] == b"\2\1" and body[jerk] == 1 and body[level] == 0
    changes: dict[str, tuple[int, bytes]] = {
        **{f"share {n}": (events + 2 * n, struct.pack("<H", 32770)) for n in range(5)},
        "known": (events + 10, struct.pack("<h", 16385)),
        "known below": (events + 10, struct.pack("<h", -16385)),
        **{f"no steps {n}": (events + 2 * n, bytes(2)) for n in (6, 7, 8)},
        **{f"health time {n}": (health + 2 * n, struct.pack("<H", 60001)) for n in range(3)},
        "limits or not": (health + 6, b"\2"),
        "something more": (health + 7, b"\1"),
        "limits the wrong way round": (health + 8, struct.pack("<ii", 5, 4)),
        "33 signals": (gate, b"\x21"),
        "17 rules": (gate + 1, b"\x11"),
        "signals without rules": (gate + 1, b"\0"),
        "kind": (jerk, b"\2"),
        "no inputs": (jerk + 1, b"\0"),
        "a level of two": (jerk, b"\0"),
        "an input that there is not": (jerk + 3, b"\2"),
        "lag 0": (jerk + 4, b"\0"),
        "lag 17": (jerk + 4, b"\x11"),
        "shift": (jerk + 5, b"\x19"),
        "baseline 0": (level + 5, b"\0"),
        "baseline 16": (level + 5, b"\x10"),
        "noise 0": (level + 6, b"\0"),
        "noise 16": (level + 6, b"\x10"),
        "floor 0": (level + 7, bytes(4)),
        "floor": (level + 7, struct.pack("<I", (1 << 20) + 1)),
        "no terms": (rule_at, b"\0"),
        "9 terms": (rule_at, b"\x09"),
        "affect": (rule_at + 1, b"\4"),
        "gesture": (rule_at + 2, b"\3"),
        "a signal that there is not": (term, b"\2"),
        "sign": (term + 1, b"\2"),
        "no times": (term + 2, b"\0"),
        "more of a term": (term + 3, b"\1"),
        "threshold 0": (term + 4, bytes(4)),
        "threshold": (term + 4, struct.pack("<I", MOST_SIZE + 1)),
    }
    for what, (at, change) in changes.items():
        wrong = sealed(body[:at] + change + body[at + len(change) :])
        assert Seat(c_library, wrong, 4, 3).status == DAMAGED, what
    for cut in range(events, len(body)):
        assert Seat(c_library, sealed(body[:cut]), 4, 3).status == DAMAGED
    fine = {"gesture": (rule_at + 2, b"\xff"), "affect": (rule_at + 1, b"\0"), "known": (events + 10, b"\0\xc0")}
    for what, (at, change) in {"as it is": (0, body[:1]), **fine}.items():
        assert Seat(c_library, sealed(body[:at] + change + body[at + len(change) :]), 4, 3).status == OK, what


def open_at(rows: np.ndarray) -> list[int]:
    """The frames before which an event is going on."""
    found: list[int] = []
    since = -1
    for row in rows[rows[:, 0] == EVENT].tolist():
        if since >= 0:
            found += range(since + 1, row[1] + 1)
        since = -1 if row[4] == ENDED else row[1]
    return found


def test_a_swap_in_the_middle_of_an_event(c_library: Any) -> None:
    """Its end is told once, by the callback that was set before; counts go on, and the new model warms up."""
    rng = np.random.default_rng(1)
    ended = 0
    for seed in range(24):
        old = ruled_model(seed)
        other = ruled_model(seed + 100, classes=int(rng.integers(2, 7)), step=int(rng.integers(1, 6)), pool=60)
        frames = any_frames(old, seed, 900)
        moments = open_at(answers_of(old, frames[:600]))
        at = int(rng.choice(moments)) if moments and seed % 4 else int(rng.integers(1, 600))
        parts = [(old, frames[:at]), (other, frames[at:750]), (old, frames[750:])]
        expected = answers_over_swaps(parts)
        ended += len(expected[0]) > len(answers_of(old, frames[:at]))
        toy = seat(c_library, old)
        for n, (model, piece) in enumerate(parts):
            rows = toy.push(piece)
            if n < 2:
                following = parts[n + 1][0]
                status, more = toy.swap(following.to_bytes(), following.network.arch.classes)
                assert status == OK and len(more) <= 1
                assert [(r[0], r[4]) for r in more.tolist()] in ([], [(EVENT, ENDED)])
                assert c_library.seat_title(toy.toy).decode() == following.network.arch.title
                rows = np.concatenate([rows, more])
            assert np.array_equal(rows, expected[n]), (seed, at, n, model.network.arch.title)
    assert ended >= 12


def test_a_swap_to_what_is_no_model_for_this_toy_changes_nothing(c_library: Any) -> None:
    """Not a byte of the toy and its memory: the event goes on, and every answer is that of a toy left alone."""
    rng = np.random.default_rng(2)
    opened = 0
    for seed in (5, 8, 14):
        model = ruled_model(seed)
        good = ruled_model(seed + 100, classes=5).to_bytes()
        body = good[16:]
        other_layout = sealed(body[:26] + bytes([body[26] ^ 1]) + body[27:])
        refused = {
            NOT_A_MODEL: [b"", good[:15], b"PLSX" + good[4:]],
            OTHER_VERSION: [good[:4] + b"\3" + good[5:], good[:4] + b"\5" + good[5:]],
            DAMAGED: [good[: int(rng.integers(16, len(good)))] for _ in range(20)],
            OTHER_LAYOUT: [other_layout],
        }
        for _ in range(60):
            flipped = bytearray(good)
            flipped[int(rng.integers(16, len(good)))] ^= 1 << int(rng.integers(8))
            refused[DAMAGED].append(bytes(flipped))
        refused[DAMAGED].append(sealed(body[: len(body) - 9]))  # cut off, with a good checksum
        frames = any_frames(model, seed, 900)
        toy, got, at = seat(c_library, model), [], 0
        offers = [(status, image) for status, images in refused.items() for image in images]
        for n in rng.permutation(len(offers)).tolist():
            until = min(at + 8, len(frames))
            got.append(toy.push(frames[at:until]))
            at = until
            assert toy.swap(offers[n][1], 0)[0] == offers[n][0]
            assert toy.swap(good, 0, too_few=1)[0] == TOO_SMALL
        got.append(toy.push(frames[at:]))
        assert np.array_equal(np.concatenate(got), answers_of(model, frames))
        opened += len(open_at(np.concatenate(got)))
    assert opened > 100


def test_nothing_is_swapped_where_nothing_runs(c_library: Any) -> None:
    image = plain_model().to_bytes()
    toy = Seat(c_library, b"no model at all.....", 4, 3)
    assert toy.swap(image, 3)[0] == OTHER_LAYOUT
    assert len(toy.push(any_frames(plain_model(), 1, 50))) == 0


def test_a_swap_ends_a_fault_as_a_beginning_does(c_library: Any) -> None:
    """The sensors are judged anew, by the limits of the new model."""
    model = ruled_model(4)
    frames = any_frames(model, 1, 400)
    frames[:, 0] = 10 * np.arange(400)
    frames[200:300, 1:] = frames[200, 1:]  # frozen
    parts = [(model, frames[:230]), (ruled_model(9), frames[230:])]
    expected = answers_over_swaps(parts)
    assert column(expected[0], "state", HEALTH)[-1] == FAULT
    toy = seat(c_library, model)
    first = toy.push(parts[0][1])
    status, more = toy.swap(parts[1][0].to_bytes(), 3)
    assert status == OK and np.array_equal(np.concatenate([first, more]), expected[0])
    assert np.array_equal(toy.push(parts[1][1]), expected[1])


def test_a_toy_that_never_began_is_quiet(c_library: Any) -> None:
    frames = any_frames(plain_model(), 1, 50)
    for toy in (seat(c_library, plain_model(), too_few=1), Seat(c_library, b"no model at all.....", 4, 3)):
        assert toy.status != OK
        assert len(toy.push(frames)) == 0
        c_library.seat_restart(toy.toy)
        assert len(toy.push(frames)) == 0
        assert c_library.seat_name(toy.toy, 0) == c_library.seat_title(toy.toy) == b""
    never = (ctypes.c_uint64 * 256)()
    assert c_library.plush_push(never, 5, (ctypes.c_int32 * 255)()) == 0


def cases(*all_cases: tuple[bytes, np.ndarray]) -> bytes:
    return b"".join(
        struct.pack("<I", len(image))
        + image
        + struct.pack("<II", *frames.shape)
        + (frames & 0xFFFFFFFF).astype("<u4").tobytes()
        for image, frames in all_cases
    )


def run(program: Path, file: Path, *swaps: str) -> bytes:
    done = subprocess.run([program, file, *swaps], capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr.decode()[-3000:]
    return done.stdout


@pytest.mark.exhaustive
def test_sanitizers_find_nothing_in_good_models(sanitized: list[Path], tmp_path: Path) -> None:
    """Extremes on purpose: full ranges, garbage, gaps, saturated scales."""
    found = []

    @settings(max_examples=25, database=None)
    @given(models(longest=200), st.integers(0, 1 << 30))
    def collect(model: IntegerModel, seed: int) -> None:
        frames = any_frames(model, seed, 450)
        expected = answers_of(model, frames)
        found.append(
            (model.to_bytes(), frames, struct.pack("<iI", 0, len(expected)) + expected.astype("<i4").tobytes())
        )

    collect()
    (tmp_path / "cases").write_bytes(cases(*((image, frames) for image, frames, _ in found)))
    for program in sanitized:
        assert run(program, tmp_path / "cases") == b"".join(expected for *_, expected in found)


def test_sanitizers_find_nothing_in_any_bytes(sanitized: list[Path], tmp_path: Path) -> None:
    """Thousands of damaged images, most with a good checksum: refused or used, never read or written out of bounds."""
    rng = np.random.default_rng(5)
    frames = any_frames(plain_model(), 3, 60)
    wide = np.zeros((60, 40), dtype=np.int64)
    wide[:, : frames.shape[1]] = frames
    base = ruled_model(4).to_bytes()[16:]
    layers = [m.start() for m in re.finditer(re.escape(struct.pack("<HHHH", 4, 3, 6, 5)), base)] + [116]
    spots = [
        *range(28),
        *range(60, 116),
        *(at + i for at in layers for i in range(24)),
        *range(base.index(b"gesture 0") - 3, len(base)),
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
            at = 116
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
    output = {run(program, tmp_path / "cases") for program in sanitized}
    assert len(output) == 1
    out, at, statuses = output.pop(), 0, []
    for image, _ in images:
        status, made = struct.unpack_from("<iI", out, at)
        statuses.append(status)
        classes = image[16 + 3] if status == OK else 0
        at += 8 + 4 * made * (HEAD + 2 * classes)
    assert at == len(out)
    assert statuses.count(OK) > 200
    assert statuses.count(DAMAGED) > 1000


def test_sanitizers_find_nothing_in_swaps(sanitized: list[Path], tmp_path: Path) -> None:
    """One toy, offered good models of many sizes and damaged ones between its frames: all or nothing of each."""
    rng = np.random.default_rng(6)
    offered, good = [], []
    for n in range(400):
        shape = {"classes": int(rng.integers(2, 9)), "step": int(rng.integers(1, 6)), "pool": 60}
        body = bytearray(ruled_model(int(rng.integers(40)), **shape).to_bytes()[16:])
        fine = n == 0 or rng.random() < 0.3
        if not fine:
            body[int(rng.integers(len(body)))] ^= 1 << int(rng.integers(8))
        image = sealed(bytes(body))
        if not fine and rng.random() < 0.3:
            image = image[: int(rng.integers(len(image)))]
        offered.append((image, any_frames(ruled_model(), n, int(rng.integers(1, 120)))))
        good.append(fine)
    (tmp_path / "cases").write_bytes(cases(*offered))
    output = {run(program, tmp_path / "cases", "swap") for program in sanitized}
    assert len(output) == 1
    out, at, statuses, classes = output.pop(), 0, [], 0
    for image, _ in offered:
        status, made = struct.unpack_from("<iI", out, at)
        statuses.append(status)
        classes = image[16 + 3] if status == OK else classes
        at += 8 + 4 * made * (HEAD + 2 * classes)
    assert at == len(out)
    assert all(status == OK for status, fine in zip(statuses, good, strict=True) if fine)
    assert sum(status != OK for status in statuses) > 100


def test_a_drill_of_bad_updates(sanitized: list[Path], tmp_path: Path) -> None:
    """Damaged, truncated, foreign, older and newer images at random moments of a stream with events, and now and then a
    sound one: see ``drill`` in toy.c. ``PLUSHSENSE_FUZZ=100`` offers a million to each program.
    """
    offers = 10_000 * int(os.environ.get("PLUSHSENSE_FUZZ", "1"))
    models = [ruled_model(seed, classes=3 + seed % 4, step=1 + seed % 5, pool=60) for seed in (5, 8, 14, 21)]
    body = models[1].to_bytes()[16:]
    other_layout = sealed(body[:26] + bytes([body[26] ^ 1]) + body[27:])
    foreign = [(other_layout, OTHER_LAYOUT), (edged_model().to_bytes(), OTHER_LAYOUT)]
    foreign.append((image_head(body, version=IMAGE_VERSION + CALIBRATED) + body, OTHER_VERSION))
    sound = [*models[1:], vector_model()]
    offered = [*((model.to_bytes(), OK) for model in sound), *2 * foreign]
    (tmp_path / "cases").write_bytes(
        cases(
            (models[0].to_bytes(), any_frames(models[0], 5, 4000)),
            *((image, np.zeros((status, 0), dtype=np.int64)) for image, status in offered),
        )
    )
    output = {run(program, tmp_path / "cases", "drill", f"{offers}") for program in sanitized}
    assert len(output) == 1
    read, events, ended, *by_status = struct.unpack("<10I", output.pop())
    assert sum(by_status) >= offers and read > offers / 4 and events > offers / 200
    assert ended > 0 and by_status[OK] > offers / 1000
    assert min(by_status[status] for status in (NOT_A_MODEL, OTHER_VERSION, DAMAGED, TOO_SMALL)) > offers / 40
    assert by_status[OTHER_LAYOUT] > offers / 1000 and by_status[6] == 0
