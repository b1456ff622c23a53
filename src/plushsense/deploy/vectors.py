"""What a toy has to answer to which frames: the golden vectors of an export folder, recordings, made-up frames."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import BadInput, ConfigError
from plushsense.core.recfile import Frames
from plushsense.dataset.store import Dataset
from plushsense.deploy.calibration import integer_model
from plushsense.deploy.drill import drills_of
from plushsense.deploy.emit import BUNDLE, FACTS, GOLDEN, IMAGE, LIBRARY, MODEL, read_facts
from plushsense.deploy.golden import COLUMNS, HEAD, TRACKING, answers_of, column, read_golden
from plushsense.deploy.made_frames import golden_frames
from plushsense.deploy.streams import frames_of
from plushsense.models.bundle import Bundle
from plushsense.models.image import IntegerModel, memory_bytes
from plushsense.windows.clock import resample

Ints = NDArray[np.int64]
# What every emulator has room for beside the program.
MOST_FRAME_BYTES = 8 << 20


@dataclass(frozen=True, eq=False)
class Vectors:
    """Frames (n, 1 + C) and the rows (m, 12 + 2 K) that they must get; ``samples`` even ones are made of them.

    ``model``: whose they are, where that is not the export's own; ``silences``: frames after which nothing is heard.
    """

    name: str
    frames: Ints
    answers: NDArray[np.int32]
    samples: int
    model: IntegerModel | None = None
    silences: tuple[int, ...] = ()

    @property
    def decisions(self) -> int:
        """How many answers are not of a warming toy."""
        return int((column(self.answers, "state") == TRACKING).sum())

    @property
    def memory_bytes(self) -> int:
        """What a toy needs for them, if that is not what the export's own needs."""
        return memory_bytes(self.model) if self.model else 0

    def to_bytes(self) -> bytes:
        """A case as the harness reads it: the model's bytes (none: the export's own), silences, frames, each with how
        many there are before them."""
        image = self.model.to_bytes() if self.model else b""
        counts = [struct.pack("<I", n) for n in (len(image), len(self.silences), len(self.frames))]
        frames = (self.frames & 0xFFFFFFFF).astype("<u4").tobytes()
        silences = struct.pack(f"<{len(self.silences)}I", *self.silences)
        return counts[0] + image + bytes(-len(image) % 4) + counts[1] + silences + counts[2] + frames


@dataclass(frozen=True)
class Counts:
    """How much was streamed under one name."""

    name: str
    frames: int
    samples: int
    answers: int


def counted(streams: Sequence[Vectors]) -> tuple[Counts, ...]:
    return tuple(
        Counts(name, sum(len(v.frames) for v in own), sum(v.samples for v in own), sum(len(v.answers) for v in own))
        for name in dict.fromkeys(v.name for v in streams)
        for own in [[v for v in streams if v.name == name]]
    )


class Export:
    """An export folder, opened to be checked.

    Raises:
        BadInput: when it is none, lacks a file, or holds golden vectors that are not those of its model.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        facts = read_facts(self.folder)
        for name in (*LIBRARY, *MODEL, IMAGE, BUNDLE):
            if not (self.folder / name).is_file():
                raise BadInput(f"The export '{self.folder}' lacks {name}: export the model again.")
        self.title = str(facts["title"])
        self.bundle = Bundle.load(self.folder / BUNDLE)
        model = integer_model(self.bundle)
        smoothing = facts.get("smoothing", model.smoothing)
        if isinstance(smoothing, bool) or not isinstance(smoothing, int):
            raise BadInput(f"'{self.folder / FACTS}' has the smoothing {smoothing!r}: export the model again.")
        self.model: IntegerModel = replace(model, smoothing=smoothing)
        self.image = (self.folder / IMAGE).read_bytes()
        self._drills: dict[int, list[Vectors]] = {}
        arch = self.model.network.arch
        frames, answers = read_golden(self.folder / GOLDEN, len(self.model.layout.channels), arch.classes)
        self.golden = Vectors("golden", frames, answers, self.samples_of(frames))
        # Of a model edited by hand the golden vectors are not meant to be right: the runs will tell.
        self.is_own = self.image == self.model.to_bytes()
        if self.is_own:
            seen = compare(answers_of(self.model, frames), answers.astype("<i4").tobytes(), self.labels)
            if seen.first:
                raise BadInput(
                    f"The golden vectors in '{self.folder / GOLDEN}' are not those of {BUNDLE}: they are damaged, or "
                    f"of another model ({seen.first}); export the model again."
                )

    @property
    def labels(self) -> tuple[str, ...]:
        return self.model.gestures.labels

    def samples_of(self, frames: Ints) -> int:
        """How many even samples the clock makes of frames."""
        return sum(map(len, resample(Frames(frames[:, 1:], frames[:, 0]), self.model.layout)))

    def answered(self, name: str, frames: Ints) -> Vectors:
        """Frames with the answers of ``models/integer``; refuses as `require_own`."""
        self.require_own()
        return Vectors(name, frames, answers_of(self.model, frames), self.samples_of(frames))

    def require_own(self) -> None:
        """BadInput when plush_model.bin is not what this PlushSense makes of the bundle beside it."""
        if not self.is_own:
            raise BadInput(
                f"{IMAGE} in '{self.folder}' is not what this PlushSense makes of {BUNDLE} beside it, so that only the "
                "golden vectors can be checked: export the model again."
            )

    def drills(self, again: int = 0) -> list[Vectors]:
        """The export's network with rules that speak up on made-up frames, as its own may never do
        (`plushsense.deploy.drill`), others for each ``again``; none for a model that is not that of the bundle beside
        it."""
        if not self.is_own:
            return []
        if again not in self._drills:
            found = drills_of(self.model, self.bundle.scaler, again)
            self._drills[again] = [
                Vectors("drill", d.frames, d.rows, self.samples_of(d.frames), d.model, d.silences) for d in found
            ]
        return self._drills[again]

    def made_up(self, samples: int) -> list[Vectors]:
        """More frames such as the golden ones, until they make this many samples."""
        seed, have = 2, 0
        pieces: list[Ints] = []
        while have < samples:
            span, health = self.model.network.arch.span, self.model.rules.health
            pieces.append(golden_frames(self.model.layout, self.bundle.scaler, span, seed, health=health))
            have += self.samples_of(pieces[-1])
            seed += 1
        return [self.answered("made up", p) for p in in_parts(np.concatenate(pieces))] if pieces else []

    def recorded(self, dataset: Dataset, subjects: Sequence[str], samples: int) -> list[Vectors]:
        """Recordings until they make this many samples, or there are no more; refuses as `frames_of`."""
        layout = self.model.layout
        rows = samples
        while True:
            frames = frames_of(dataset, layout, subjects=subjects, rows=rows)
            have = self.samples_of(frames)
            if have >= samples or len(frames) < rows:
                break
            rows += max(samples - have, rows // 4)
        if not len(frames):
            raise ConfigError(f"The data set '{dataset.head.name}' holds nothing to stream: give another one.")
        name = "simulated recordings" if dataset.head.simulated else "recordings"
        return [self.answered(name, part) for part in in_parts(frames)]


@dataclass(frozen=True)
class Compared:
    """Rows beside those that were expected."""

    vectors: int
    mismatches: int
    max_abs_diff: int
    first: str | None


def compare(expected: NDArray[np.int32], got: bytes, labels: Sequence[str]) -> Compared:
    """What a toy wrote beside the rows (m, 12 + 2 K) that it should give; ``first`` is half a sentence."""
    width = expected.shape[1]
    whole = len(got) // (4 * width)
    rows = np.frombuffer(got[: whole * 4 * width], dtype="<i4").reshape(whole, width).astype(np.int64)
    words = got[whole * 4 * width :].decode("utf-8", "replace").strip()
    both = min(len(expected), whole)
    off = np.abs(rows[:both] - expected[:both])
    wrong = np.flatnonzero(off.any(axis=1))
    mismatches = len(wrong) + max(len(expected), whole) - both
    first = None
    if len(wrong):
        at = int(wrong[0])
        field = int(np.flatnonzero(off[at])[0])
        first = (
            f"row {at} ({_row(expected[at])}): {_column(field, int(expected[at, 0]), labels)} should be "
            f"{int(expected[at, field])} and is {int(rows[at, field])}"
        )
    elif whole < len(expected):
        first = f"row {whole} ({_row(expected[whole])}) never came"
    elif whole > len(expected):
        first = f"row {both} ({_row(rows[both])}) is one too many"
    if words:
        first = f"{words.rstrip('.')}" if first is None else f"{words.rstrip('.')}; {first}"
        mismatches = max(mismatches, 1)
    return Compared(len(expected), mismatches, int(off.max()) if off.size else 0, first)


def _row(row: NDArray[Any]) -> str:
    """Which one it is."""
    kind = ("answer", "event", "health")[int(row[0])] if int(row[0]) in COLUMNS else "of no kind"
    return f"{kind}, frame {int(row[1])}"


def _column(field: int, kind: int, labels: Sequence[str]) -> str:
    if field < HEAD:
        return f"'{COLUMNS.get(kind, COLUMNS[0])[field]}'"
    what, at = divmod(field - HEAD, len(labels))
    return f"{('the logit', 'the smoothed probability')[what]} of '{labels[at]}'"


def in_parts(frames: Ints) -> list[Ints]:
    """Frames in parts for which every emulator has room; each part begins a stream anew."""
    rows = MOST_FRAME_BYTES // (4 * frames.shape[1])
    return [frames[at : at + rows] for at in range(0, len(frames), rows)]
