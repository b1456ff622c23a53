"""Test vectors for an export: frames from golden vectors, recordings or a generator, and the expected answers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError, nearest
from plushsense.core.files import read_bytes
from plushsense.core.layouts import Layout
from plushsense.dataset.store import Dataset
from plushsense.deploy.code import (
    BUNDLE,
    FACTS,
    GOLDEN,
    IMAGE,
    MOST_FILE_BYTES,
    check_names,
    code_files,
    facts_of,
    prefixed,
    read_facts,
    without_prefix,
)
from plushsense.deploy.golden import COLUMNS, HEAD, Vectors, answers_of, golden_frames, read_golden, samples_of
from plushsense.deploy.package import export_files, foreign_files
from plushsense.deploy.proof.scenarios import exchanges_of, patches_of, scenarios_of
from plushsense.deploy.quantize import integer_model
from plushsense.deploy.web import MODULE
from plushsense.devices.virtual.stream import ToySpec, received
from plushsense.models.bundle import Bundle
from plushsense.runtime.fixed import Ints
from plushsense.runtime.image import IntegerModel

_LOW, _HIGH = -(1 << 31), (1 << 31) - 1
_PAUSE_MS = 1000
_SLOWEST_MACS_S = 2e5  # multiply-accumulates that an emulator does in a second, on a busy computer


def recorded_frames(dataset: Dataset, layout: Layout, *, subjects: Sequence[str] = (), rows: int) -> Ints:
    """Read frames (n, 1 + C) from a data set: at least ``rows``, or all if it has fewer.

    The session streams of each person are read, or the recordings if there are none. Each begins after a pause that
    makes a toy restart, and keeps its own gaps and resets. The same number of rows is taken from the beginning of each,
    if it is long enough. Time stamps wrap at 2^32 as in a toy; values are clipped to 32 bits.

    Raises:
        ConfigError: for another layout than the model's, or an unknown person.
    """
    if not dataset.layout.reads_as(layout):
        raise ConfigError(
            "The data set '{name}' holds layout '{layout}' ({names}), but the model reads '{model_layout}' "
            "({model_names}), "
            "or other units or steps: give recordings of the model's layout.",
            name=dataset.head.name,
            layout=dataset.layout.name,
            names=", ".join(dataset.layout.names),
            model_layout=layout.name,
            model_names=", ".join(layout.names),
        )
    known = sorted({r.subject for r in dataset.recordings} | {s.subject for s in dataset.streams})
    for subject in subjects:
        if subject not in known:
            raise ConfigError(
                f"The data set '{dataset.head.name}' has nobody '{subject}': accepted are {', '.join(known)}."
                f"{nearest(subject, known)}"
            )
    pieces = list(dataset.read_people(subjects or known))
    lengths = np.array([len(p) for p in pieces], dtype=np.int64)
    takes = np.zeros_like(lengths)
    # Shortest first, so that longer pieces supply the rows that shorter ones lack.
    for left, at in zip(range(len(pieces), 0, -1), np.argsort(lengths, kind="stable"), strict=True):
        takes[at] = min(lengths[at], max(0, -(-(rows - int(takes.sum())) // left)))
    parts: list[Ints] = []
    now = _PAUSE_MS
    for piece, take in zip(pieces, takes.tolist(), strict=True):
        if not take:
            continue
        part = piece.slice(0, take)
        ms = part.device_ms.astype(np.int64) - int(part.device_ms[0]) + now
        parts.append(np.column_stack([ms & 0xFFFFFFFF, np.clip(part.values, _LOW, _HIGH)]))
        now = int(ms[-1]) + layout.gap_ms + _PAUSE_MS
    return np.concatenate(parts) if parts else np.empty((0, 1 + len(layout.channels)), dtype=np.int64)


# Fits into the memory of every emulated chip, next to the program.
MOST_FRAME_BYTES = 8 << 20


class Export:
    """Export folder, opened for verification. The C of an export with a name is compiled without its prefix.

    Attributes:
        changed: files that are not what this version writes for the bundle: the library and the model, their copies
            and other files in the packages (links, too), the facts, and further files that a compiler would find there.
        edited: such files of the examples, which are there to be changed.
        facts: those of the model, name and page; never other values that ``export.json`` may hold.

    Raises:
        BadInput: if it is no export, lacks a file, or its golden vectors do not fit its model.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        facts = read_facts(self.folder)
        self.title = facts.title
        self._require_file(BUNDLE)
        self.bundle = Bundle.load(self.folder / BUNDLE)
        model = integer_model(self.bundle)
        self.model: IntegerModel = replace(model, smoothing=facts.smoothing)
        self._code = code_files(self.model, self.bundle)
        name = facts.name
        files = {file: self._read_file(prefixed(file, name)) for file in self._code}
        check_names(url=facts.url)
        self.facts = replace(facts_of(self.model, self.bundle, self._code[IMAGE]), name=name, url=facts.url)
        # A module is of one compiler, and proved by running it; the page must hold this one.
        self.has_module = (self.folder / MODULE).is_file()
        module = self._read_file(MODULE) if self.has_module else None
        written = export_files(self.bundle, self.facts, self._code, module)
        changed, self.edited = foreign_files(self.folder, written, name)
        said = replace(self.facts, conversions=facts.conversions, files=facts.files)
        same = json.dumps(facts.to_json(), sort_keys=True) == json.dumps(said.to_json(), sort_keys=True)
        self.changed = (*changed, *([] if same else [FACTS]))
        compiled = {prefixed(file, name) for file in files} & set(self.changed)
        self._files = {f: c if f == IMAGE else without_prefix(c, name) for f, c in files.items()} if name else None
        self._compiles_changed = bool(compiled)
        self.image = files[IMAGE]
        arch = self.model.network.arch
        frames, answers = read_golden(self.folder / GOLDEN, len(self.model.layout.channels), arch.classes)
        self.golden = Vectors("golden", frames, answers, self._samples(frames))
        # The golden vectors of a model edited by hand may differ: the runs report that.
        self.is_own = IMAGE not in self.changed
        if self.is_own:
            comparison = compare(answers_of(self.model, frames), answers.astype("<i4").tobytes(), self.labels)
            if comparison.first:
                raise BadInput(
                    "The golden vectors in '{path}' are not those of {bundle}: they are damaged, or of another model "
                    "({first}); export the model again.",
                    path=self.folder / GOLDEN,
                    bundle=BUNDLE,
                    first=comparison.first,
                    name=self.folder.name,
                )

    def _require_file(self, name: str) -> Path:
        path = self.folder / name
        if not path.is_file():
            raise BadInput("The export '{path}' lacks {file}: export the model again.", path=self.folder, file=name)
        return path

    def _read_file(self, name: str) -> bytes:
        try:
            return read_bytes(self._require_file(name), MOST_FILE_BYTES)
        except OSError as cause:
            raise BadInput(
                "'{folder}' cannot be read ({why}): export the model again.",
                folder=self.folder / name,
                why=cause.strerror or cause,
                name=self.folder.name,
            ) from None

    def require_unchanged(self) -> None:
        """Raise BadInput if files were changed, as running changed code is not safe, and vouching for it not honest."""
        if self.changed:
            one = len(self.changed) == 1
            raise BadInput(
                "{files} in '{folder}' {more} not what this PlushSense writes for {bundle}, and nothing was "
                "compiled: export the model again, or give --trust to verify the folder all the same, which runs its "
                "C on this computer.",
                files=", ".join(self.changed),
                folder=self.folder,
                more="is" if one else "are",
                bundle=BUNDLE,
            )

    def code(self, room: Path) -> Path:
        """Return the folder to compile from: the new folder ``room``, or the export itself if its C was changed and it
        has no name.

        Unchanged files are written to ``room``, so that the compiler finds no other file of the export, such as a
        ``string.h`` or a precompiled header.
        """
        if self._compiles_changed and self._files is None:
            return self.folder
        room.mkdir(parents=True)
        for name, content in (self._files or self._code).items():
            (room / name).write_bytes(content)
        return room

    def seconds(self, vectors: Sequence[Vectors]) -> float:
        """Return how long the network of the vectors' decisions takes at most on the slowest emulator."""
        return sum(v.decisions for v in vectors) * self.model.network.arch.macs_per_step / _SLOWEST_MACS_S

    @property
    def labels(self) -> tuple[str, ...]:
        return self.model.gestures.labels

    def _samples(self, frames: Ints) -> int:
        return samples_of(frames, self.model.layout)

    def answered(self, name: str, frames: Ints) -> Vectors:
        """Compute the expected answers to frames.

        Raises:
            BadInput: if plush_model.bin differs from what this version makes of the bundle.
        """
        if not self.is_own:
            raise BadInput(
                f"{IMAGE} in '{self.folder}' is not what this PlushSense makes of {BUNDLE} beside it, so that only the "
                "golden vectors can be checked: export the model again."
            )
        return Vectors(name, frames, answers_of(self.model, frames), self._samples(frames))

    def scenarios(self) -> list[Vectors]:
        """Return the test scenarios for the export's network; empty if plush_model.bin is not this version's."""
        return self._scenarios if self.is_own else []

    def patched(self) -> list[Vectors]:
        """Return frames between which patches of the last layer are offered; empty if plush_model.bin differs."""
        return [self._patched] if self.is_own else []

    @cached_property
    def _scenarios(self) -> list[Vectors]:
        exchanges = [exchanges_of(self.model, self.bundle.scaler)] if self.model.layout.self_calibration else []
        return [*scenarios_of(self.model, self.bundle.scaler), *exchanges]

    @cached_property
    def _patched(self) -> Vectors:
        return patches_of(self.model, self.bundle.scaler)

    def made_up(self, samples: int) -> list[Vectors]:
        """Generate further frames like the golden ones, for at least ``samples`` samples."""
        seed, n_samples = 2, 0
        pieces: list[Ints] = []
        while n_samples < samples:
            span, health = self.model.network.arch.span, self.model.rules.health
            pieces.append(golden_frames(self.model.layout, self.bundle.scaler, span, seed, health=health))
            n_samples += self._samples(pieces[-1])
            seed += 1
        return [self.answered("made up", p) for p in in_parts(np.concatenate(pieces))] if pieces else []

    def recorded(self, dataset: Dataset, subjects: Sequence[str], samples: int) -> list[Vectors]:
        """Read recordings for at least ``samples`` samples, or all; raise ConfigError like `recorded_frames`."""
        layout = self.model.layout
        rows = samples
        while True:
            frames = recorded_frames(dataset, layout, subjects=subjects, rows=rows)
            n_samples = self._samples(frames)
            if n_samples >= samples or len(frames) < rows:
                break
            rows += max(samples - n_samples, rows // 4)
        if not len(frames):
            raise ConfigError(
                "The data set '{name}' holds nothing to stream: give another one.", name=dataset.head.name
            )
        name = "simulated recordings" if dataset.head.simulated else "recordings"
        return [self.answered(name, part) for part in in_parts(frames)]

    def played(self, toy: ToySpec) -> list[Vectors]:
        """Play the scenario of a virtual toy: the frames that a reader receives, with the clocks that the toy sends.

        It has nothing to do with the test scenarios of `scenarios`, which are variants of the model.

        Raises:
            ConfigError: for a model whose layout the virtual toy does not support, or if no frame arrives.
        """
        layout = self.model.layout
        numbers = (n for _, frames, _ in received(toy, layout) for f in frames for n in (f.device_ms, *f.values))
        frames = np.fromiter(numbers, dtype=np.int64).reshape(-1, 1 + len(layout.channels))
        if not len(frames):
            raise ConfigError(
                "No frame of the scenario arrives, so nothing can be verified: give its faults an end, or a share "
                "below 1."
            )
        return [self.answered("virtual toy", part) for part in in_parts(frames)]


@dataclass(frozen=True)
class RowComparison:
    """Result of `compare`; ``first`` describes the first difference as part of a sentence.

    ``is_empty``: the program printed nothing.
    """

    vectors: int
    mismatches: int
    max_abs_diff: int
    first: str | None
    is_empty: bool = False


def compare(expected: NDArray[np.int32], got: bytes, labels: Sequence[str]) -> RowComparison:
    """Compare the output of the test program with the expected rows (m, 16 + 2 K)."""
    width = expected.shape[1]
    n_rows = len(got) // (4 * width)
    rows = np.frombuffer(got[: n_rows * 4 * width], dtype="<i4").reshape(n_rows, width).astype(np.int64)
    message = got[n_rows * 4 * width :].decode("utf-8", "replace").strip()
    both = min(len(expected), n_rows)
    differences = np.abs(rows[:both] - expected[:both])
    wrong = np.flatnonzero(differences.any(axis=1))
    mismatches = len(wrong) + max(len(expected), n_rows) - both
    first = None
    if len(wrong):
        at = int(wrong[0])
        field = int(np.flatnonzero(differences[at])[0])
        first = (
            f"row {at} ({_row(expected[at])}): {_column(field, int(expected[at, 0]), labels)} should be "
            f"{int(expected[at, field])} and is {int(rows[at, field])}"
        )
    elif n_rows < len(expected):
        first = f"row {n_rows} ({_row(expected[n_rows])}) is missing"
    elif n_rows > len(expected):
        first = f"row {both} ({_row(rows[both])}) is one too many"
    if message:
        first = f"{message.rstrip('.')}" if first is None else f"{message.rstrip('.')}; {first}"
        mismatches = max(mismatches, 1)
    largest = int(differences.max()) if differences.size else 0
    return RowComparison(len(expected), mismatches, largest, first, is_empty=not got and len(expected) > 0)


def _row(row: NDArray[Any]) -> str:
    """Return the kind and the frame of a row as text."""
    kind = ("answer", "event", "health", "patch")[int(row[0])] if int(row[0]) in COLUMNS else "of no kind"
    return f"{kind}, frame {int(row[1])}"


def _column(field: int, kind: int, labels: Sequence[str]) -> str:
    if field < HEAD:
        return f"'{COLUMNS.get(kind, COLUMNS[0])[field]}'"
    kind, at = divmod(field - HEAD, len(labels))
    return f"{('the logit', 'the smoothed probability')[kind]} of '{labels[at]}'"


def in_parts(frames: Ints) -> list[Ints]:
    """Split frames into parts that fit into every emulator; each part begins a new stream."""
    rows = MOST_FRAME_BYTES // (4 * frames.shape[1])
    return [frames[at : at + rows] for at in range(0, len(frames), rows)]
