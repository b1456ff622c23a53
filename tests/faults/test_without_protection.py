"""Checks of the drills that fail when the protection which they are about is taken out.

Each promise is checked twice by the same function: as the code is, and with its protection removed by hand.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plushsense.core import files
from plushsense.core.errors import BundleError, ForgottenError, PlushSenseError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import STREAM_NAME, read_stream
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark
from plushsense.dataset.privacy.forget import forget
from plushsense.dataset.store import Dataset, Generation
from plushsense.devices.base import Frame
from plushsense.models import bundle as bundles
from plushsense.models.bundle import Bundle
from plushsense.recording import session as sessions
from plushsense.recording.plan import load_protocol
from plushsense.recording.session import OpenSession
from plushsense.recording.writer import SessionHead, StreamFile
from support.bundles import odd_bundle
from support.c_toy import C_FOLDER, TOY_C, Seat, library_of
from support.integers import plain_model

ACCEL = load_layout("accel-3")
PERSON = "P2"
Patch = pytest.MonkeyPatch


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << at % 8]) + data[at + 1 :]


# A file is written whole or not at all.
class Interruption(BaseException):
    pass


def an_interrupted_writer_leaves_a_whole_bundle(place: Path) -> None:
    def interrupt(_: int) -> None:
        raise Interruption

    path = odd_bundle(place / "m.plush")
    before, other = path.read_bytes(), replace(Bundle.load(path), provenance={"made": "again"})
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Interruption):
        patch.setattr(os, "fsync", interrupt)
        other.save(path)
    assert path.read_bytes() == before


def write_in_place(patch: Patch, place: Path) -> None:
    @contextlib.contextmanager
    def in_place(path: Path, **_: Any) -> Iterator[Path]:
        part = path.with_suffix(".new")
        yield part
        content = part.read_bytes()
        with path.open("wb", buffering=0) as file:
            for half in (content[:1000], content[1000:]):
                file.write(half)
                os.fsync(file.fileno())

    patch.setattr(files, "replacing_file", in_place)


# Nothing of a person is written after `forget`, by a program that opened the data set before.
def nobody_comes_back(place: Path) -> None:
    dataset = open_dataset(place / "DS")
    forget(dataset.path, PERSON)
    with contextlib.suppress(ForgottenError):
        dataset.append_marks([Mark(f"{PERSON}/Slow_1_200", "exclude", "x")])
    found = [p for p in dataset.path.rglob("*") if p.is_file() and PERSON.encode() in p.read_bytes()]
    assert found == []


def no_look_before_writing(patch: Patch, place: Path) -> None:
    patch.setattr(Generation, "check", lambda self: None)


# A damaged bundle is refused.
def no_flipped_bundle_is_read(place: Path) -> None:
    path = odd_bundle(place / "m.plush")
    data = path.read_bytes()
    read = []
    for at in range(8 + int.from_bytes(data[:8], "little"), len(data), 41):
        with contextlib.suppress(BundleError):
            read.append(Bundle.from_bytes(flipped(data, at)))
    assert read == []


def no_checksum_of_bundles(patch: Patch, place: Path) -> None:
    patch.setattr(bundles, "_digest", lambda *_: "none")


# A row that a crash cut off does not run into the next one.
def no_row_is_mixed_of_two(place: Path) -> None:
    folder = place / "S01" / "1"
    head = SessionHead("S01", "1", 5, ACCEL.to_dict(), load_protocol("quick").to_dict(), consent="C-1")
    OpenSession(folder, head).close()
    for start in (0, 1000):
        OpenSession(folder).close()
        stream = StreamFile(folder / STREAM_NAME, ACCEL)
        stream.write([Frame(1000 + n, start + 10 * n, (n, 7, 3)) for n in range(9)])
        stream.close()
        with (folder / STREAM_NAME).open("ab") as file:
            file.write(b"1009, 90, 12")
    OpenSession(folder).close()
    read = read_stream(folder / STREAM_NAME, ACCEL)
    assert read.malformed == 0
    assert read.frames.device_ms.tolist() == [start + 10 * n for start in (0, 1000) for n in range(9)]


def no_repair(patch: Patch, place: Path) -> None:
    patch.setattr(sessions, "_repair_stream", lambda *_: None)


# A toy never runs a damaged model.
def no_flipped_image_runs(place: Path, source: Path = C_FOLDER) -> None:
    words = ["gcc", "-std=c99", "-O0", "-w", "-shared", "-fPIC", f"-I{source}", str(TOY_C)]
    subprocess.run([*words, "-o", str(place / "toy.so")], check=True)
    library, image = library_of(place / "toy.so"), plain_model().to_bytes()
    assert Seat(library, image, 4, 3).status == 0
    assert all(Seat(library, flipped(image, at), 4, 3).status != 0 for at in range(16, len(image)))


def no_checksum_in_c(patch: Patch, place: Path) -> None:
    source = Path(shutil.copytree(C_FOLDER, place / "c"))
    text = (source / "plushsense.c").read_text()
    compared = "checksum(model + HEAD_BYTES, word_at(model + 8) - HEAD_BYTES) != word_at(model + 12))"
    assert text.count(compared) == 1
    (source / "plushsense.c").write_text(text.replace(compared, "0)"))
    patch.setattr(no_flipped_image_runs, "__defaults__", (source,))


# What was imported is what is read.
def no_changed_recording_is_read(place: Path) -> None:
    dataset = open_dataset(place / "DS")
    path = place / "DS" / dataset.recordings[0].file
    whole, before = path.read_bytes(), path.stat()
    kept = dataset.read(dataset.recordings[0]).values
    read = []
    for at in [n for n in range(len(whole) // 2, len(whole)) if whole[n : n + 1].isdigit()][:40]:
        path.write_bytes(flipped(whole, at))
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        with contextlib.suppress(PlushSenseError):
            again = open_dataset(place / "DS")
            read.append(again.read(again.recordings[0]).values)
    path.write_bytes(whole)
    assert all(np.array_equal(values, kept) for values in read)


def no_hash_of_recordings(patch: Patch, place: Path) -> None:
    patch.setattr(Dataset, "_frames", lambda self, read, info: read(self.path / info.file, self.layout).frames)


PROMISES: dict[str, tuple[Callable[[Path], None], Callable[[Patch, Path], None]]] = {
    "atomic files": (an_interrupted_writer_leaves_a_whole_bundle, write_in_place),
    "generation of a data set": (nobody_comes_back, no_look_before_writing),
    "checksum of a bundle": (no_flipped_bundle_is_read, no_checksum_of_bundles),
    "repair of a half row": (no_row_is_mixed_of_two, no_repair),
    "checksum of the model in C": (no_flipped_image_runs, no_checksum_in_c),
    "hash of a recording": (no_changed_recording_is_read, no_hash_of_recordings),
}


@pytest.mark.parametrize("promise", PROMISES)
def test_the_check_fails_without_the_protection(
    promise: str, imported: Path, c_compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check, take_out = PROMISES[promise]
    for name in ("with", "without"):
        shutil.copytree(imported, tmp_path / name / "DS")
    check(tmp_path / "with")
    with monkeypatch.context() as patch:
        take_out(patch, tmp_path / "without")
        with pytest.raises(AssertionError):
            check(tmp_path / "without")
