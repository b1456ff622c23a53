"""Write MATLAB files (version 5, as ``save(file, '-v7')`` writes without compression) with categorical arrays.

SciPy writes no objects. The properties of all objects are in a file of its own inside, as described in
github.com/foreverallama/matio, docs/subsystem_data_format.md.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_CELL, _STRUCT, _CHAR, _DOUBLE, _UINT8, _UINT32, _OPAQUE = 1, 2, 4, 6, 9, 13, 17
_HEAD = b"MATLAB 5.0 MAT-file, Platform: PCWIN64".ljust(116)


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def _matrix(kind: int, dims: tuple[int, int], *parts: bytes, name: str = "") -> bytes:
    head = _element(6, struct.pack("<II", kind, 0)) + _element(5, struct.pack("<ii", *dims))
    return _element(14, head + _element(1, name.encode()) + b"".join(parts))


def _char(text: str) -> bytes:
    return _matrix(_CHAR, (1, len(text)), _element(4, text.encode("utf-16-le")))


def _uint8(data: bytes) -> bytes:
    return _matrix(_UINT8, (len(data), 1), _element(2, data))


def _cells(parts: Sequence[bytes], name: str = "") -> bytes:
    return _matrix(_CELL, (len(parts), 1), *parts, name=name)


def _double(values: NDArray[np.float64], name: str = "") -> bytes:
    return _matrix(_DOUBLE, values.shape, _element(9, values.astype("<f8").tobytes(order="F")), name=name)


def _object(name: str, kind: str, contents: bytes) -> bytes:
    texts = b"".join(_element(1, text.encode()) for text in (name, "MCOS", kind))
    return _element(14, _element(6, struct.pack("<II", _OPAQUE, 0)) + texts + contents)


def _reference(number: int) -> bytes:
    numbers = (0xDD000000, 2, 1, 1, number, 1)
    return _matrix(_UINT32, (6, 1), _element(6, struct.pack("<6I", *numbers)))


def _workspace(labels: Sequence[Sequence[str]], categories: Sequence[str]) -> bytes:
    """Return the inner file: for each categorical array two properties, each in a cell of its own."""
    names = b"categoryNames\0codes\0categorical\0"
    names += bytes(-len(names) % 8)
    classes = struct.pack("<8I", 0, 0, 0, 0, 0, 3, 0, 0)
    objects = bytes(24) + b"".join(struct.pack("<6I", 1, 0, 0, 0, n, 0) for n in range(1, len(labels) + 1))
    properties = bytes(8)
    contents = []
    for at, mine in enumerate(labels):
        properties += struct.pack("<8I", 2, 1, 1, 2 * at, 2, 1, 2 * at + 1, 0)
        codes = bytes(categories.index(label) + 1 if label else 0 for label in mine)
        contents += [_cells([_char(c) for c in categories]), _uint8(codes)]
    offsets = [40 + len(names)]
    for part in (classes, b"", objects, properties):
        offsets.append(offsets[-1] + len(part))
    offsets += [offsets[-1]] * (8 - len(offsets))
    table = struct.pack("<2I8I", 4, 3, *offsets) + names + classes + objects + properties
    empty = _matrix(_DOUBLE, (0, 0), _element(9, b""))
    cells = _cells([_uint8(table), empty, *contents, empty, empty, empty])
    field = _element(5, struct.pack("<i", 5)) + _element(1, b"MCOS\0")
    inner = _matrix(_STRUCT, (1, 1), field, _object("", "FileWrapper__", cells))
    return struct.pack("<HH", 0x0100, 0x4D49) + bytes(4) + inner


def write_mat(
    path: Path,
    windows: Mapping[str, Sequence[NDArray[np.float64]]],
    labels: Mapping[str, Sequence[str]],
    categories: Sequence[str],
    *,
    categorical: bool = True,
) -> None:
    """Write cell arrays of windows and their labels, as categorical arrays or as cell arrays of texts, and ``c``."""
    data = [_cells([_double(w) for w in mine], name) for name, mine in windows.items()]
    for number, (name, texts) in enumerate(labels.items(), 1):
        data.append(
            _object(name, "categorical", _reference(number)) if categorical else _cells([_char(t) for t in texts], name)
        )
    data.append(_cells([_char(c) for c in categories], "c"))
    offset = 128 + sum(map(len, data))
    if categorical:
        inner = _workspace(list(labels.values()), categories)
        data.append(_matrix(_UINT8, (1, len(inner)), _element(2, inner)))
    path.write_bytes(_HEAD + struct.pack("<Q", offset) + struct.pack("<HH", 0x0100, 0x4D49) + b"".join(data))
