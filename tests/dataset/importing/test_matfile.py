"""MATLAB files: what SciPy writes is read alike, categorical arrays too, and damage ends in one sentence."""

from __future__ import annotations

import random
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import FileFormatError
from plushsense.dataset.importing.matfile import read_mat, texts_of
from support.matlab_files import write_mat

WINDOW = np.arange(22.0).reshape(2, 11)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_mat(tmp_path / "x.mat", {"data": [WINDOW]}, {"labels": ["b", "", "ā"], "more": ["a"]}, ["a", "b", "ā"])
    return tmp_path / "x.mat"


def test_cells_texts_and_categories(path: Path) -> None:
    values = read_mat(path, "x.mat")
    assert set(values) == {"data", "labels", "more", "c"}
    assert np.array_equal(values["data"][0, 0], WINDOW)
    assert (values["labels"], values["more"], texts_of(values["c"])) == (["b", "", "ā"], ["a"], ["a", "b", "ā"])


def test_compressed_arrays(path: Path) -> None:
    raw = path.read_bytes()
    at, packed = 128, raw[:128]
    while at < len(raw):
        size = 8 + struct.unpack_from("<I", raw, at + 4)[0]
        content = zlib.compress(raw[at : at + size])
        packed += struct.pack("<II", 15, len(content)) + content
        at += size
    values = read_mat(path, "x.mat")
    path.write_bytes(packed)
    again = read_mat(path, "x.mat")
    assert values["labels"] == again["labels"]
    assert np.array_equal(values["data"][0, 0], again["data"][0, 0])


def test_what_scipy_writes(tmp_path: Path) -> None:
    scipy = pytest.importorskip("scipy.io")
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = "one", WINDOW.astype(np.int16)
    values = {"a": WINDOW, "b": np.uint8([[1, 2]]), "t": "text", "k": cells, "s": {"x": 3.0}, "z": np.array([[1j]])}
    for compressed in (False, True):
        scipy.savemat(tmp_path / "s.mat", values, do_compression=compressed)
        found = read_mat(tmp_path / "s.mat", "s.mat")
        assert np.array_equal(found["a"], WINDOW)
        assert np.array_equal(found["b"], [[1, 2]])
        assert (found["t"], found["k"][0, 0], found["z"]) == (["text"], ["one"], None)
        assert np.array_equal(found["k"][0, 1], WINDOW)
        assert found["s"]["x"].item() == 3.0


def test_damaged_files(path: Path) -> None:
    raw, drawn = path.read_bytes(), random.Random(1)
    refused = 0
    for _ in range(200):
        damaged = bytearray(raw)
        for _ in range(drawn.randint(1, 5)):
            damaged[drawn.randrange(len(damaged))] = drawn.randrange(256)
        path.write_bytes(damaged[: drawn.randrange(len(damaged))] if drawn.random() < 0.3 else damaged)
        try:
            read_mat(path, "x.mat")
        except FileFormatError as cause:
            refused += 1
            assert "\n" not in str(cause)
            assert "'x.mat' " in str(cause)
    assert refused > 50


@pytest.mark.parametrize(
    "content",
    [
        b"  1.0000000e+00   2.5000000e+00\n  2.0000000e+00   3.5000000e+00\n",
        b"MATLAB MAT-file, by a tool".ljust(124) + b"\x00\x02IM" + bytes(600),
        bytes(512) + b"\x89HDF\r\n\x1a\n" + bytes(600),
        struct.pack("<5i", 0, 2, 2, 0, 2) + b"x\0" + bytes(32),
    ],
    ids=["text", "7.3", "HDF5", "4"],
)
def test_other_formats_of_matlab_are_refused_with_a_way_out(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"another one such as 7.3, 4 or text: load it.*save -v7.*--pattern"):
        read_mat(path, "x.mat")
