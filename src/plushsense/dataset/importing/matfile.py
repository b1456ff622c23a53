"""Read MATLAB files of version 5, as ``save`` writes them by default: numbers, texts, cells and categorical arrays.

The format is that of MathWorks' *MAT-File Format*; it says nothing about objects such as categorical arrays, whose
properties are in a file of its own inside. That part is described in github.com/foreverallama/matio,
docs/subsystem_data_format.md. SciPy 1.17 drops the names of objects, and damaged files make it crash the interpreter.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError

_HEAD = 128
_DEEPEST = 20
_LARGEST = 2**31
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_TEXTS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _CHAR, _OPAQUE = 1, 2, 4, 17
_NUMBERS = range(6, 16)
_COMPLEX = 0x0800


@dataclass(frozen=True)
class MatObject:
    """Object of the class ``kind``; ``value`` refers to its properties."""

    kind: str
    value: Any


class _Reader:
    """Reader of the data elements in the bytes of a file; ``order`` is < or >."""

    def __init__(self, order: str) -> None:
        self._order = order
        self._decoding = "le" if order == "<" else "be"

    def elements(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """Yield type and content of each element."""
        at = 0
        while at + 8 <= len(data):
            kind, size = struct.unpack_from(f"{self._order}II", data, at)
            begin = at + 8
            if kind >> 16:
                # Contents of up to 4 bytes are in the head itself.
                kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
                at += 8
                if size > 4:
                    raise ValueError("an element has a wrong size")
            else:
                at = begin + size + (0 if kind == _COMPRESSED else -size % 8)
            if begin + size > len(data):
                raise ValueError("it ends within an element")
            yield kind, data[begin : begin + size]

    def variables(self, data: memoryview) -> Iterator[tuple[str, Any]]:
        """Yield name and value of each array at the top."""
        for kind, content in self.elements(data):
            if kind == _COMPRESSED:
                unpacker = zlib.decompressobj()
                unpacked = unpacker.decompress(content, _LARGEST)
                if unpacker.unconsumed_tail:
                    raise ValueError("an array is larger than 2 GB")
                yield from self.variables(memoryview(unpacked))
            elif kind == _MATRIX:
                yield self._array(content, 0)

    def _array(self, data: memoryview, depth: int) -> tuple[str, Any]:
        """Return name and value of an array; None for kinds that are not read."""
        if depth > _DEEPEST:
            raise ValueError("cells are nested too deeply")
        if not len(data):
            return "", None
        parts = self.elements(data)
        flags = struct.unpack_from(f"{self._order}I", _next(parts)[1])[0]
        kind = flags & 0xFF
        if kind == _OPAQUE:
            name, _, class_name = (bytes(_next(parts)[1]).decode("utf-8", "replace") for _ in range(3))
            return name, MatObject(class_name, self._array(_next(parts)[1], depth + 1)[1])
        raw = _next(parts)[1]
        dims = struct.unpack(f"{self._order}{len(raw) // 4}i", raw[: len(raw) // 4 * 4])
        if len(dims) < 2 or min(dims) < 0:
            raise ValueError("an array has no dimensions")
        name = bytes(_next(parts)[1]).decode("utf-8", "replace")
        if kind == _CELL:
            cells = np.empty(_count(dims, len(data)), dtype=object)
            for at in range(len(cells)):
                cells[at] = self._array(_next(parts)[1], depth + 1)[1]
            return name, cells.reshape(dims, order="F")
        if kind == _STRUCT:
            length = struct.unpack_from(f"{self._order}i", _next(parts)[1])[0]
            text = bytes(_next(parts)[1])
            if length < 1:
                raise ValueError("a structure has no names of fields")
            names = [text[at : at + length].split(b"\0")[0].decode() for at in range(0, len(text), length)]
            return name, {key: self._array(_next(parts)[1], depth + 1)[1] for key in names} if prod(dims) == 1 else None
        if kind == _CHAR:
            return name, self._text(*_next(parts), dims)
        if kind in _NUMBERS and not flags & _COMPLEX:
            return name, self._numbers(*_next(parts), dims)
        return name, None

    def _numbers(self, kind: int, data: memoryview, dims: tuple[int, ...]) -> NDArray[Any]:
        if kind not in _TYPES:
            raise ValueError(f"numbers have the unknown type {kind}")
        return np.frombuffer(data, f"{self._order}{_TYPES[kind]}").reshape(dims, order="F")

    def _text(self, kind: int, data: memoryview, dims: tuple[int, ...]) -> list[str]:
        """Return the rows of a character array."""
        coding = _TEXTS.get(kind, "latin-1")
        text = bytes(data).decode(f"{coding}-{self._decoding}" if coding in ("utf-16", "utf-32") else coding, "replace")
        rows = dims[0] if prod(dims) == len(text) else 1
        return [text[at::rows] for at in range(rows)]


def _next(parts: Iterator[tuple[int, memoryview]]) -> tuple[int, memoryview]:
    part = next(parts, None)
    if part is None:
        raise ValueError("an array is incomplete")
    return part


def _count(dims: tuple[int, ...], most: int) -> int:
    """Return the number of cells; raise ValueError if there is no room for them."""
    count = prod(dims)
    if 8 * count > most:
        raise ValueError("an array is incomplete")
    return count


def _open(data: bytes, head: int) -> tuple[_Reader, memoryview]:
    """Return a reader and the bytes behind the head, whose last 4 bytes state version and byte order."""
    mark = data[head - 2 : head]
    if mark not in (b"IM", b"MI"):
        raise ValueError("its head is not that of a MATLAB file")
    return _Reader("<" if mark == b"IM" else ">"), memoryview(data)[head:]


class _Properties:
    """Properties of the objects of a file, from the file inside.

    The first cell holds, in 32-bit integers, a version, the number of names, offsets of tables, and the names; the
    table of objects refers to the table of properties, and that to the other cells.
    """

    def __init__(self, inside: bytes) -> None:
        # Version and byte order are in the first 4 of 8 bytes.
        reader, _ = _open(inside, 4)
        content = next((value for _, value in reader.variables(memoryview(inside)[8:])), None)
        if not isinstance(content, dict) or not isinstance(content.get("MCOS"), MatObject):
            raise ValueError("the properties of its objects cannot be read")
        self._cells = content["MCOS"].value.ravel(order="F")
        table = self._cells[0].tobytes()
        numbers = np.frombuffer(table[: len(table) // 4 * 4], f"{'<' if inside[2:4] == b'IM' else '>'}u4").tolist()
        offsets = numbers[2:10]
        self._names = ["", *(name.decode() for name in table[40 : offsets[0]].split(b"\0")[: numbers[1]])]
        self._objects = [numbers[at : at + 6] for at in range(offsets[2] // 4, offsets[3] // 4, 6)]
        self._properties = list(_blocks(numbers[offsets[3] // 4 : offsets[4] // 4]))

    def of(self, value: NDArray[Any]) -> dict[str, Any]:
        """Return the properties of the object that ``value`` refers to: the last but one of its numbers."""
        mine = self._objects[int(value.ravel()[-2])][4]
        return {self._names[name]: self._cells[2 + cell] for name, kind, cell in self._properties[mine] if kind == 1}


def _blocks(numbers: list[int]) -> Iterator[list[tuple[int, int, int]]]:
    """Yield blocks of (name, kind, cell); each begins with their number and is padded to 8 bytes."""
    at = 0
    while at < len(numbers):
        end = at + 1 + 3 * numbers[at]
        mine = numbers[at + 1 : end]
        yield list(zip(mine[0::3], mine[1::3], mine[2::3], strict=True))
        at = end + end % 2


def _categories(properties: dict[str, Any]) -> list[str]:
    """Return the texts of a categorical array in column order, "" where it is undefined."""
    if "codes" not in properties:
        return []
    names = ["", *texts_of(properties["categoryNames"])]
    return [names[code] for code in properties["codes"].ravel(order="F").tolist()]


def texts_of(cells: NDArray[Any]) -> list[str]:
    """Return the texts of a cell array of texts in column order; raise ValueError for other contents."""
    found = cells.ravel(order="F").tolist()
    if not all(isinstance(cell, list) for cell in found):
        raise ValueError("a cell array of texts has other contents")
    return ["".join(cell) for cell in found]


def read_mat(path: Path, display_name: str) -> dict[str, Any]:
    """Read the variables of a MATLAB file.

    Returns:
        By name: arrays of numbers, cell arrays (of objects), the rows of a character array as a list, structures as a
        dictionary, the texts of a categorical array as a list, and None for anything else.

    Raises:
        FileFormatError: for a file that is damaged, or of another format.
    """
    try:
        data = path.read_bytes()
        # The head of version 5 ends in its version and byte order; 7.3 is HDF5 behind such a head.
        if data[_HEAD - 4 : _HEAD] not in (b"\x00\x01IM", b"\x01\x00MI") or data.startswith(b"MATLAB 7.3"):
            raise FileFormatError(
                f"'{display_name}' does not have the MATLAB format that  save(file, '-v7')  writes, but another one "
                "such as 7.3, 4 or text: load it and save it so, in Octave with  save -v7 file; a text table can also "
                "be described with --pattern"
            )
        reader, rest = _open(data, _HEAD)
        variables = list(reader.variables(rest))
        # The file inside is an array without a name.
        inside = next((v for name, v in variables if not name and isinstance(v, np.ndarray)), None)
        properties = None if inside is None else _Properties(inside.tobytes())
        values = {name: value for name, value in variables if name}
        for name, value in values.items():
            if isinstance(value, MatObject):
                known = properties is not None and value.kind == "categorical"
                values[name] = _categories(properties.of(value.value)) if known and properties else None
    except MemoryError:
        raise FileFormatError(f"'{display_name}' is too large for the memory of this computer") from None
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, struct.error, zlib.error) as cause:
        if isinstance(cause, FileFormatError):
            raise
        message = " ".join(str(cause).split())[:120] or type(cause).__name__
        raise FileFormatError(f"'{display_name}' cannot be read as a MATLAB file: {message}") from None
    return values
