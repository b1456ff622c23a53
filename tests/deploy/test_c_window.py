"""Window networks in C: bit for bit the integer model, whatever is reflected; each library takes its own models."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.deploy.emit import LIBRARY, library_text
from plushsense.deploy.golden import answers_of, answers_over_patches
from plushsense.deploy.proof.mutants import source_mutants
from plushsense.deploy.proof.vectors import Export
from plushsense.deploy.proof.verify import Setting, verify
from plushsense.models.arch import ConvLayer
from plushsense.runtime.image import IntegerModel, image_head, memory_bytes, patch_bytes
from plushsense.runtime.integer import IntegerNetwork
from support.c_toy import Seat, answers, seat
from support.exports import bundle_of, exported
from support.integers import any_frames, any_network, models, plain_model, vector_model, window_model

OK, OTHER_VERSION, DAMAGED, TOO_SMALL = 0, 2, 3, 4


@settings(max_examples=25)
@given(models(longest=160, window=True), st.integers(0, 1 << 30))
def test_any_window_network_any_stream(window_libraries: list[Any], model: IntegerModel, seed: int) -> None:
    frames = any_frames(model, seed)
    expected = answers_of(model, frames)
    image = model.to_bytes()
    for library in window_libraries:
        assert library.plush_memory_bytes(image, len(image)) == memory_bytes(model)
        assert seat(library, model, too_few=1).status == TOO_SMALL
        assert np.array_equal(seat(library, model).push(frames), expected)


def plain_answers(network: IntegerNetwork, x: np.ndarray) -> np.ndarray:
    """Logits of one window (T, C), with NumPy's own reflection and a loop over the taps."""
    z = network.inputs.apply(x).astype(np.int64)
    for layer, part in zip(network.arch.layers, network.layers, strict=True):
        padded = np.pad(z, ((layer.reach, 0), (0, 0)), mode="reflect")
        sums = np.zeros((len(z), layer.filters), dtype=np.int64)
        for k in range(layer.kernel):
            sums += padded[k * layer.dilation : k * layer.dilation + len(z)] @ part.weights[:, :, k].T.astype(np.int64)
        z = part.scale.apply(sums + part.bias).astype(np.int64)
    dense = network.dense
    return dense.scale.apply(z.sum(axis=0) @ dense.weights.T.astype(np.int64) + dense.bias)


@pytest.mark.parametrize(
    ("layers", "window"),
    [
        pytest.param((ConvLayer(5, 2, 6), ConvLayer(4, 3, 5)), 40, id="less than the window"),
        pytest.param((ConvLayer(5, 2, 6), ConvLayer(12, 1, 5)), 12, id="nearly the window"),
        pytest.param((ConvLayer(1, 1, 3), ConvLayer(13, 1, 5)), 12, id="just the window"),
        pytest.param((ConvLayer(9, 7, 6), ConvLayer(4, 1, 3), ConvLayer(6, 20, 5)), 12, id="several windows"),
        pytest.param((ConvLayer(3, 40, 6), ConvLayer(2, 1, 5)), 2, id="a window of two samples"),
    ],
)
def test_what_is_reflected(layers: tuple[ConvLayer, ...], window: int, window_libraries: list[Any]) -> None:
    plain = window_model()
    arch = replace(plain.network.arch, layers=layers, window=window, step=min(window, 5))
    network = any_network(arch, plain.layout, np.random.default_rng(3))
    model = replace(plain, network=network)
    frames = any_frames(model, 2, 300, start=0)
    frames[:, 0] = 10 * np.arange(300)  # a sample for each
    frames[:, 1:] = np.clip(frames[:, 1:], -2000, 30_000)
    expected = answers_of(model, frames)
    rows = answers(expected)
    tracking = rows[rows[:, 3] == 1]
    assert len(tracking) > 50
    x = np.column_stack([frames[:, 1], [math.isqrt(256 * int((r * r).sum())) for r in frames[:, 2:]]])
    for row in tracking[::10]:
        assert np.array_equal(row[9:12], plain_answers(network, x[row[2] - window : row[2]]))
    for library in window_libraries:
        assert np.array_equal(seat(library, model).push(frames), expected)


def test_after_a_gap_nothing_of_the_window_is_left(window_libraries: list[Any]) -> None:
    model = window_model()
    before, after = any_frames(model, 1, 400, start=0), any_frames(model, 2, 400, start=90_000)
    for library in window_libraries:
        together = answers(seat(library, model).push(np.concatenate([before, after])))
        alone = answers(seat(library, model).push(after))
        later = together[together[:, 0] >= 400]
        assert np.array_equal(later[:, 1:7], alone[:, 1:7]) and np.array_equal(later[:, 9:], alone[:, 9:])
        assert (alone[:, 3] == 1).any()


def test_a_patch_of_a_window_network(window_libraries: list[Any]) -> None:
    model = window_model()
    dense = replace(model.network.dense, weights=-model.network.dense.weights // 2)
    adapted = replace(model, network=replace(model.network, dense=dense))
    patch = patch_bytes(model, adapted)
    first, second = any_frames(model, 5, 300, start=0), any_frames(model, 6, 300, start=4000)
    expected = answers_over_patches(model, [(None, first), (dense, second)])
    for library in window_libraries:
        toy = seat(library, model)
        assert np.array_equal(toy.push(first), expected[0])
        assert toy.patch(patch) == OK
        assert np.array_equal(toy.push(second), expected[1])
        streaming = plain_model()
        other = replace(streaming, network=replace(streaming.network, dense=dense))
        assert toy.patch(patch_bytes(streaming, other)) == OTHER_VERSION


def test_each_library_takes_its_own_models_only(c_library: Any, window_libraries: list[Any]) -> None:
    assert struct.unpack_from("<H", plain_model().to_bytes(), 4) == (6,)
    assert struct.unpack_from("<H", window_model().to_bytes(), 4) == (7,)
    assert seat(c_library, window_model()).status == OTHER_VERSION
    for library in window_libraries:
        assert seat(library, plain_model()).status == OTHER_VERSION
        assert seat(library, window_model()).status == OK


def test_a_good_checksum_makes_no_window_model(window_libraries: list[Any]) -> None:
    body = window_model().to_bytes()[16:]
    assert struct.unpack_from("<HHI", body, 4) == (5, 0, 40)
    changes = {
        "pooled steps": (6, struct.pack("<H", 1)),
        "a window of one sample": (8, struct.pack("<I", 1)),
        "a window of too many": (8, struct.pack("<I", 65536)),
        "no layers": (0, b"\0"),
        "step 0": (4, struct.pack("<H", 0)),
    }
    for what, (at, change) in changes.items():
        wrong = body[:at] + change + body[at + len(change) :]
        for library in window_libraries:
            assert Seat(library, image_head(wrong, version=7) + wrong, 4, 3).status == DAMAGED, what
    vectors = vector_model().to_bytes()[16:]
    vectors = vectors[:6] + bytes(2) + vectors[8:]
    for library in window_libraries:
        assert Seat(library, image_head(vectors, version=7) + vectors, 4, 3).status == DAMAGED


def test_neither_library_holds_the_code_of_the_other() -> None:
    """So that a streaming toy pays nothing: ``next_taps`` and ``pair_sums`` stand for the two ways."""
    streaming, window = (library_text(LIBRARY[1], window=w) for w in (False, True))
    for text in (streaming, window, *(library_text(LIBRARY[0], window=w) for w in (False, True))):
        assert "PLUSH_WINDOW" not in text
    assert "next_taps" not in streaming and "next_taps" in window
    assert "pair_sums" in streaming and "pair_sums" not in window
    assert "#define PLUSH_IMAGE_VERSION 6\n" in library_text(LIBRARY[0], window=False)
    assert "#define PLUSH_IMAGE_VERSION 7 " in library_text(LIBRARY[0], window=True)


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A window network whose second layer reaches back further than the window."""
    bundle = bundle_of("accel-3", "3d1_3d7", "3,4", padding="mirror", window=12, step=4)
    return exported(tmp_path_factory.mktemp("window") / "out", bundle)


def test_it_is_verified_here_and_on_a_chip(
    export: Path, target_here: Callable[[str], str], all_compilers: None
) -> None:
    host = verify(Export(export), ["host"], only=lambda s: s.image or s.options == "-O1 sanitizers")
    assert host.passed and host.decisions > 300
    assert {r.flags for r in host.runs} >= {"-O2 plush_model.bin"}
    chip = verify(Export(export), [target_here("xtensa")], only=lambda s: s.optimise == "-O2")
    assert chip.passed and chip.mismatches == 0


def test_mutants_of_the_window_are_caught(export: Path, c_compiler: str) -> None:
    names = {m.name for m in source_mutants() if m.library == "window"}

    def plainly(setting: Setting) -> bool:
        return (setting.compiler, setting.options) == ("gcc", "-O0")

    found = verify(Export(export), ["host"], mutants=lambda m: m.name in names, only=plainly)
    assert {m.name for m in found.mutants} == names
    assert all(m.caught for m in found.mutants)
