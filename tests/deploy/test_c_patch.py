"""A patch of the dense layer: in the middle of a stream, bit for bit; a refused one changes nothing."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core.errors import BundleError
from plushsense.deploy.golden import ANSWER, EVENT, HEAD, TRACKING, answers_of, answers_over_patches, column
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.targets import CompileSpec, build
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import HEAD_BYTES, PATCH_MAGIC, IntegerModel, image_check, image_head, patch_bytes
from support.c_toy import C_FOLDER, Seat, seat
from support.exports import bundle_of
from support.integers import any_frames, plain_model, ruled_model

OK, NOT_A_MODEL, OTHER_VERSION, DAMAGED = range(4)
OTHER_MODEL = 6


def adapted(model: IntegerModel, seed: int = 99) -> IntegerModel:
    """The model with the dense layer of another one, as an adaptation gives it."""
    dense = ruled_model(seed, classes=model.network.arch.classes).network.dense
    return replace(model, network=replace(model.network, dense=dense))


def sealed(body: bytes) -> bytes:
    """A patch with a good checksum."""
    return image_head(body, PATCH_MAGIC) + body


def test_a_patch_in_the_middle_of_a_stream(c_library: Any) -> None:
    """The next step uses it, without warming; afterwards the original layer is back, also over gaps and faults."""
    rng = np.random.default_rng(1)
    events = tracked = 0
    for seed in range(16):
        model = ruled_model(seed, step=int(rng.integers(1, 6)), pool=60)
        other, third = adapted(model), adapted(model, 300 + seed)
        frames = any_frames(model, seed, 1000)
        cuts = np.sort(rng.integers(1, 1000, 3))
        pieces = np.split(frames, cuts)
        layers = [None, other.network.dense, third.network.dense, None]
        expected = answers_over_patches(model, list(zip(layers, pieces, strict=True)))
        toy, patches = seat(c_library, model), [None, patch_bytes(model, other), patch_bytes(model, third), None]
        for patch, piece, rows in zip(patches, pieces, expected, strict=True):
            assert toy.patch(patch) == OK
            assert np.array_equal(toy.push(piece), rows), seed
        whole = answers_of(model, frames)
        assert not np.array_equal(np.concatenate(expected), whole)
        # The own layer gives the logits of a toy that was never patched.
        for rows in (expected[0], expected[3]):
            late = rows[rows[:, 0] == ANSWER]
            same = whole[(whole[:, 0] == ANSWER) & np.isin(whole[:, 1], late[:, 1])]
            assert np.array_equal(late[:, HEAD : HEAD + 3], same[:, HEAD : HEAD + 3])
        events += sum((rows[:, 0] == EVENT).sum() for rows in expected[1:])
        tracked += sum((column(rows, "state") == TRACKING).sum() for rows in expected[1:])
    assert events > 50 and tracked > 500


def test_restarts_keep_a_patch_and_a_new_beginning_does_not(c_library: Any) -> None:
    model = plain_model()
    patch, frames = patch_bytes(model, adapted(model)), any_frames(model, 3, 300)
    patched = answers_of(adapted(model), frames)
    toy = seat(c_library, model)
    assert toy.patch(patch) == OK
    assert np.array_equal(toy.push(frames), patched)
    assert toy.swap(model.to_bytes(), 3)[0] == OK
    own = toy.push(frames[:100] + np.array([100_000, 0, 0, 0, 0]))
    start = answers_of(model, frames[:100])
    assert np.array_equal(own[own[:, 0] == ANSWER][:, HEAD:], start[start[:, 0] == ANSWER][:, HEAD:])


def test_what_is_no_patch_for_this_toy_changes_nothing(c_library: Any) -> None:
    """Not a byte of the toy and its memory, whatever the patch: every answer is that of a toy left alone."""
    rng = np.random.default_rng(2)
    model = ruled_model(5)
    good = patch_bytes(model, adapted(model))
    body = good[HEAD_BYTES:]
    fewer, more = ruled_model(5, classes=2), ruled_model(5, classes=4)
    refused = {
        NOT_A_MODEL: [b"", good[:15], b"PLSH" + good[4:], model.to_bytes()],
        OTHER_VERSION: [good[:4] + b"\3" + good[5:], good[:4] + b"\5" + good[5:]],
        DAMAGED: [
            *(good[: int(rng.integers(HEAD_BYTES, len(good)))] for _ in range(20)),
            sealed(body[:8] + struct.pack("<H", 32768) + body[10:]),
            sealed(body[:10] + b"\x1f" + body[11:]),
            sealed(body[: 4 + 2 * 8 + 7] + b"\xff" + body[4 + 2 * 8 + 8 :]),
        ],
        OTHER_MODEL: [
            *(sealed(body[:n]) for n in (1, 3, 4, 5, len(body) - 1)),
            sealed(body + b"\0"),
            sealed(bytes([body[0] ^ 1]) + body[1:]),
            *(patch_bytes(m, adapted(m)) for m in (ruled_model(6), fewer, more)),
        ],
    }
    for _ in range(300):
        flipped = bytearray(good)
        flipped[int(rng.integers(8, len(good)))] ^= 1 << int(rng.integers(8))
        refused[DAMAGED].append(bytes(flipped))
    offers = [(status, patch) for status, patches in refused.items() for patch in patches]
    frames, at, got = any_frames(model, 5, 900), 0, []
    toy = seat(c_library, model)
    for n in rng.permutation(len(offers)).tolist():
        assert toy.patch(offers[n][1]) == offers[n][0], offers[n]
        got.append(toy.push(frames[at : at + 2]))
        at += 2
    got.append(toy.push(frames[at:]))
    assert np.array_equal(np.concatenate(got), answers_of(model, frames))
    assert toy.patch(good + b"what stands behind it in flash") == OK


def test_nothing_is_patched_where_nothing_runs(c_library: Any) -> None:
    model = plain_model()
    toy = Seat(c_library, b"no model at all.....", 4, 3)
    assert toy.patch(patch_bytes(model, adapted(model))) == toy.patch(None) == OTHER_MODEL


def test_sanitizers_find_nothing_in_patches(sanitized: list[Path], tmp_path: Path) -> None:
    """One toy, offered good and damaged patches between its frames, most with a good checksum."""
    rng = np.random.default_rng(6)
    model = ruled_model(4)
    good = patch_bytes(model, adapted(model))[HEAD_BYTES:]
    offered = [model.to_bytes()]
    for _ in range(600):
        body = bytearray(good)
        for _ in range(int(rng.integers(0, 3))):
            body[int(rng.integers(4 if rng.random() < 0.9 else 0, len(body)))] = int(rng.integers(256))
        cut = int(rng.integers(len(body))) if rng.random() < 0.1 else len(body)
        patch = sealed(bytes(body[:cut]))
        offered.append(patch[: int(rng.integers(len(patch)))] if rng.random() < 0.1 else patch)
    frames = any_frames(model, 7, 5 * len(offered))
    words = (frames & 0xFFFFFFFF).astype("<u4")
    pieces = np.split(words, len(offered))
    (tmp_path / "cases").write_bytes(
        b"".join(
            struct.pack("<I", len(given)) + given + struct.pack("<II", *piece.shape) + piece.tobytes()
            for given, piece in zip(offered, pieces, strict=True)
        )
    )
    output = set()
    for program in sanitized:
        done = subprocess.run([program, tmp_path / "cases", "patch"], capture_output=True, timeout=300)
        assert done.returncode == 0, done.stderr.decode()[-3000:]
        output.add(done.stdout)
    assert len(output) == 1
    out, at, statuses = output.pop(), 0, []
    for _ in offered:
        status, made = struct.unpack_from("<iI", out, at)
        statuses.append(status)
        at += 8 + 4 * made * (HEAD + 2 * 3)
    assert at == len(out)
    assert statuses.count(OK) > 200 and statuses.count(DAMAGED) > 50 and statuses.count(OTHER_MODEL) > 30


PROGRAM = """
#include "plushsense.h"
#include "target.h"
extern const uint8_t IMAGE[], IMAGE_end[], PATCH[], PATCH_end[], FRAMES[], FRAMES_end[];
static uint32_t memory[2048];
static plush_toy toy;
static void note(const plush_toy *of, void *user) {
    (void)user;
    if (of->answer.state == PLUSH_TRACKING) target_write(of->logits, 4u * of->classes);
}
int main(void) {
    const int32_t *p = (const int32_t *)(const void *)FRAMES, *end = (const int32_t *)(const void *)FRAMES_end;
    uint32_t third = (uint32_t)(end - p) / (1u + CHANNELS) / 3u, n;
    if (plush_begin(&toy, IMAGE, (uint32_t)(IMAGE_end - IMAGE), memory, sizeof memory) != PLUSH_OK) return 1;
    toy.on_answer = note;
    for (n = 0; p != end; p += 1 + CHANNELS, n++) {
        if (n == third && plush_patch(&toy, PATCH, (uint32_t)(PATCH_end - PATCH)) != PLUSH_OK) return 2;
        if (n == 2 * third && plush_patch(&toy, NULL_PATCH, 0) != PLUSH_OK) return 3;
        plush_push(&toy, (uint32_t)p[0], p + 1);
    }
    return 0;
}
"""


@pytest.mark.parametrize("target", ["xtensa"])
def test_on_an_emulated_chip(target: str, tmp_path: Path, target_here: Callable[[str], str]) -> None:
    model = plain_model()
    other, frames = adapted(model), any_frames(model, 3, 600)
    pieces = np.split(frames, [200, 400])
    rows = np.concatenate(
        answers_over_patches(model, [(None, pieces[0]), (other.network.dense, pieces[1]), (None, pieces[2])])
    )
    rows = rows[(rows[:, 0] == ANSWER) & (rows[:, 4] == TRACKING)]
    blobs = {
        "IMAGE": model.to_bytes(),
        "PATCH": patch_bytes(model, other),
        "FRAMES": (frames & 0xFFFFFFFF).astype("<u4").tobytes(),
    }
    for name, content in blobs.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "main.c").write_text(PROGRAM)
    program = build(
        target_here(target),
        [tmp_path / "main.c", C_FOLDER / "plushsense.c"],
        tmp_path / "out",
        CompileSpec(flags=("-DCHANNELS=4", "-DNULL_PATCH=(const uint8_t*)0")),
        include=[C_FOLDER],
        blobs={name: tmp_path / name for name in blobs},
    )
    logits = np.frombuffer(program.run(timeout_s=60), "<i4").reshape(-1, 3)
    assert len(logits) > 50 and np.array_equal(logits, rows[:, HEAD : HEAD + 3])


def test_the_bytes() -> None:
    model = plain_model()
    image, patch = model.to_bytes(), patch_bytes(model, adapted(model))
    assert patch == patch_bytes(image, adapted(model))
    assert patch[:4] == b"PLPT" and patch[4:HEAD_BYTES] == image_head(patch[HEAD_BYTES:])[4:]
    assert struct.unpack_from("<I", patch, HEAD_BYTES) == (image_check(image),) == struct.unpack_from("<I", image, 12)
    assert len(patch) == 16 + 4 + 3 * (8 + model.network.arch.features)
    assert patch[20:] in adapted(model).to_bytes() and patch_bytes(image, model)[20:] in image


def personal(bundle: Bundle) -> Bundle:
    rng = np.random.default_rng(4)
    dense = {n: bundle.weights[n] + rng.normal(size=bundle.weights[n].shape) for n in ("dense.weight", "dense.bias")}
    weights = {**bundle.weights, **{name: part.astype(np.float32) for name, part in dense.items()}}
    return replace(bundle, weights=weights, personal={"subject": "P01"})


@pytest.mark.parametrize(("layout", "symbol", "read"), [("plush-15", "9d1_5d2", 6), ("accel-3", "v9_5d2", 12)])
def test_an_adaptation_changes_only_the_dense_layer(layout: str, symbol: str, read: int) -> None:
    bundle = bundle_of(layout, symbol)
    patch = patch_bytes(integer_model(bundle), integer_model(personal(bundle)))
    assert len(patch) == 20 + 18 * (8 + read)


def test_more_than_the_dense_layer_is_refused() -> None:
    bundle = bundle_of("plush-15")
    model, other = integer_model(bundle), integer_model(personal(bundle))
    with pytest.raises(BundleError, match=r"more than the dense layer, first in 'channel 1 of.*adapt the bundle from"):
        patch_bytes(model, integer_model(personal(bundle_of("plush-15", seed=4))))
    with pytest.raises(BundleError, match="first in 'layers, channels"):
        patch_bytes(model, replace(other, smoothing=other.smoothing - 1))
    with pytest.raises(BundleError, match="first in 'layer 2: kernel 5"):
        patch_bytes(model, integer_model(personal(bundle_of("plush-15", filters="4,8"))))
    image = model.to_bytes()
    for wrong in (b"", image[:-1], image + b"\0", b"PLPT" + image[4:], image[:4] + b"\2" + image[5:]):
        with pytest.raises(BundleError, match="damaged, or of another version"):
            patch_bytes(wrong, other)
