"""One toy in C, called through ctypes."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import plushsense.deploy
from plushsense.deploy.golden import ANSWER, HEAD
from plushsense.runtime.image import IntegerModel
from support.sharing import built_once

C_FOLDER = Path(plushsense.deploy.__file__).parent / "c"
TOY_C = Path(__file__).parents[1] / "deploy" / "toy.c"


class Seat:
    """One toy in C."""

    def __init__(self, library: Any, image: bytes, channels: int, classes: int, too_few: int = 0, off: int = 0) -> None:
        self.library, self.channels, self.classes = library, channels, classes
        status = ctypes.c_int()
        self.toy = ctypes.c_void_p(library.seat_new(image, len(image), ctypes.byref(status), too_few, off))
        self.status = status.value

    def push(self, frames: NDArray[np.int64], silences: Sequence[int] = ()) -> NDArray[np.int32]:
        """The rows (n, 16 + 2 K), as `answers_of` gives them, that these frames bring about."""
        words = np.ascontiguousarray(frames & 0xFFFFFFFF).astype(np.uint32)
        # A frame completes one sample, and more after a gap: the rows hold them all.
        rows = np.empty((40 * len(frames) + 1000, HEAD + 2 * self.classes), dtype=np.int32)
        silent = np.array(sorted(silences), dtype=np.uint32)
        made = self.library.seat_push(
            self.toy,
            ctypes.c_void_p(words.ctypes.data),
            len(frames),
            self.channels,
            ctypes.c_void_p(rows.ctypes.data),
            len(rows),
            ctypes.c_void_p(silent.ctypes.data),
            len(silent),
        )
        assert made < len(rows), "every answer is counted, and every row has room"
        return rows[:made]

    def swap(self, image: bytes, classes: int, too_few: int = 0) -> tuple[int, NDArray[np.int32]]:
        """Offer another model: the status, and the rows of the events that the swap ends. A refusal must not have
        changed a byte."""
        status = ctypes.c_int()
        rows = np.empty((4, HEAD + 2 * self.classes), dtype=np.int32)
        pointer = ctypes.c_void_p(rows.ctypes.data)
        made = self.library.seat_swap(self.toy, image, len(image), too_few, ctypes.byref(status), pointer, len(rows))
        assert made <= len(rows), "a refusal changes nothing"
        if status.value == 0:
            self.classes = classes
        return status.value, rows[:made]

    def push_many(self, values: NDArray[np.int64], last_ms: int, period_us: int) -> NDArray[np.int32]:
        """The rows that a burst of readings (n, C) brings about."""
        words = np.ascontiguousarray(values).astype(np.int32)
        rows = np.empty((40 * len(values) + 40, HEAD + 2 * self.classes), dtype=np.int32)
        pointer = ctypes.c_void_p(rows.ctypes.data)
        at = ctypes.c_void_p(words.ctypes.data)
        made = self.library.seat_push_many(self.toy, at, len(words), last_ms, period_us, pointer, len(rows))
        return rows[:made]

    def prime(self, ms: int, values: NDArray[np.int32]) -> int:
        """Prime the toy with a reading (C,); whether it took it."""
        return int(
            self.library.seat_prime(self.toy, ctypes.c_uint32(ms & 0xFFFFFFFF), ctypes.c_void_p(values.ctypes.data))
        )

    def patch(self, patch: bytes | None) -> int:
        """Offer a patch, or None for the model's own layer: the status. Nothing but the layer may have changed."""
        status = self.library.seat_patch(self.toy, patch, len(patch or b""))
        assert status >= 0, "nothing but the layer changes"
        return int(status)

    def __del__(self) -> None:
        self.library.seat_free(self.toy)


def answers(rows: NDArray[np.int32]) -> NDArray[np.int32]:
    """Only the answers among the rows, without their kind: frame, ms, sample, state, gesture, affect, confidence,
    restarts, invalid, then logits and probabilities."""
    own = rows[rows[:, 0] == ANSWER]
    return own[:, [1, 2, 3, 4, 5, 6, 7, 10, 11, *range(HEAD, own.shape[1])]]


def seat(library: Any, model: IntegerModel, **how: int) -> Seat:
    """A toy with this model."""
    return Seat(library, model.to_bytes(), len(model.layout.channels), model.network.arch.classes, **how)


def compiled(cc: str, factory: pytest.TempPathFactory, *flags: str) -> Any:
    """The library and ``deploy/toy.c`` as a shared library, compiled once for all workers."""

    def compile_into(draft: Path) -> None:
        words = [cc, "-std=c99", "-O2", "-shared", "-fPIC", *flags, f"-I{C_FOLDER}", str(TOY_C)]
        subprocess.run([*words, "-o", str(draft / "toy.so")], check=True)

    return library_of(built_once(factory, f"toy{''.join(flags)}", compile_into) / "toy.so")


def library_of(path: Path) -> Any:
    """The compiled library at ``path``, with the types of its functions."""
    library = ctypes.CDLL(str(path))
    library.seat_new.restype = ctypes.c_void_p
    for name in ("seat_name", "seat_title"):
        getattr(library, name).restype = ctypes.c_char_p
    for name in (
        "seat_push",
        "seat_push_many",
        "seat_made",
        "seat_probability",
        "seat_swap",
        "seat_answers",
        "seat_reading",
        "plush_memory_bytes",
        "try_checksum",
        "try_root",
        "try_exponential",
        "try_requantize",
    ):
        getattr(library, name).restype = ctypes.c_uint32
    library.try_part_of.restype = ctypes.c_uint32
    library.try_square.restype = ctypes.c_uint64
    library.try_root.argtypes = [ctypes.c_uint64]
    for name in ("try_shift_down", "try_as_signed"):
        getattr(library, name).restype = ctypes.c_int32
    return library
