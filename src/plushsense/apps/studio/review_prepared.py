"""What a review needs beside the recordings: suggestions, short shapes and findings, made once in the background.

Suggestions and shapes depend on raw files alone. They are kept in the data set's ``cache/`` (which can be deleted, is
in no backup and is emptied when a person is forgotten), so that opening a data set again is fast. Findings depend on
the marks, too: they are made anew when somebody asks.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense import __version__
from plushsense.apps.studio.house import Bell
from plushsense.core.errors import PlushSenseError
from plushsense.dataset.contents import CACHE
from plushsense.dataset.onset import SPEC, Suggestion
from plushsense.dataset.quality.checking import Checked, check
from plushsense.dataset.store import Dataset, RecordingInfo, write_atomically
from plushsense.dataset.trim import seconds_of_rows, trims
from plushsense.reports.quality import scale_of
from plushsense.reports.quality_figures import line

KEPT = "review.json"
FULL = 1000
"""What `Shape.size` counts as the usual height of a deviation."""
_BATCH = 25
_RING_S = 0.3
# Between two recordings, so that a page that waits for the interpreter gets it at once; longer while somebody works.
_BREATH_S = 0.0005
_STEPPED_BACK_S = 0.015
_BUSY_S = 1.5


class _Closed(Exception):
    """The studio ends while something is being made."""


@dataclass(frozen=True)
class Shape:
    """The shape of a whole recording in a few points.

    ``size`` (≤ 160,): how far all channels together are from their rest, `FULL` where it is as usual, at even steps
    over ``seconds``.
    """

    seconds: float
    size: tuple[int, ...]


@dataclass
class Prepared:
    """What was made so far; one thread at a time makes more.

    Attributes:
        scale: what each channel does when something happens, (C,); empty until it is known.
        progress: (what, done, in all), None when nothing is being made; ``what`` is "suggestions" or "checks".
        said: why something could not be made, a sentence.
    """

    bell: Bell
    suggestions: dict[str, Suggestion] = field(default_factory=dict)
    shapes: dict[str, Shape] = field(default_factory=dict)
    scale: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    checked: Checked | None = None
    progress: tuple[str, int, int] | None = None
    said: str = ""
    _thread: threading.Thread | None = field(default=None, repr=False)
    _again: Dataset | None = field(default=None, repr=False)
    _lock: Any = field(default_factory=threading.Lock, repr=False)
    _closed: bool = False
    _rung_s: float = 0.0
    _asked_s: float = 0.0

    def begin(self, dataset: Dataset) -> None:
        """Make what lacks, and check ``dataset`` with the marks that it was opened with; returns at once.

        While that goes on, another call has it done again afterwards.
        """
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                self._again = dataset
                return
            self._thread = threading.Thread(target=self._run, args=(dataset,), daemon=True)
            self._thread.start()

    def step_back(self) -> None:
        """Somebody is at work on the page: let that go first for a while."""
        self._asked_s = time.monotonic()

    def wait(self, seconds: float) -> None:
        """Until all is made, at most so long."""
        if self._thread is not None:
            self._thread.join(seconds)

    def close(self) -> None:
        """Stop making, and wait for that."""
        self._closed = True
        self.wait(5.0)

    def _run(self, dataset: Dataset | None) -> None:
        while dataset is not None:
            try:
                self.said = ""
                self._make(dataset)
                self.progress = ("checks", 0, len(dataset.recordings))
                self.checked = check(dataset, progress=self._steps("checks"))
            except _Closed:
                return
            except PlushSenseError as refusal:
                self.said = str(refusal)
            except OSError as cause:
                self.said = f"'{dataset.path}' cannot be read: {cause.strerror or cause}."
            with self._lock:
                dataset, self._again = self._again, None
                if dataset is None:
                    self.progress, self._thread = None, None
            self.bell.ring()

    def _steps(self, what: str, before: int = 0, total: int = 0) -> Callable[[int, int], None]:
        def step(done: int, of: int) -> None:
            if self._closed:
                raise _Closed
            self.progress = (what, before + done, total or of)
            now = time.monotonic()
            time.sleep(_STEPPED_BACK_S if now - self._asked_s < _BUSY_S else _BREATH_S)
            if time.monotonic() - self._rung_s > _RING_S:
                self._rung_s = time.monotonic()
                self.bell.ring()

        return step

    def _make(self, dataset: Dataset) -> None:
        keys = {r.id: _key(r) for r in dataset.recordings}
        self._take_kept(dataset, keys)
        lacking = [r for r in dataset.recordings if r.id not in self.shapes]
        if not lacking:
            return
        if not len(self.scale):
            self.scale = scale_of(dataset)
        total, before = len(dataset.recordings), len(dataset.recordings) - len(lacking)
        lacking.sort(key=lambda r: (r.stream, r.id))
        for first in range(0, len(lacking), _BATCH):
            part = lacking[first : first + _BATCH]
            if not dataset.layout.is_labelled:
                found = trims(dataset, part, self._steps("suggestions", before + first, total))
                self.suggestions |= {t.recording.id: t.suggestion for t in found}
            self.shapes |= {r.id: shape_of(dataset, r, self.scale) for r in part}
            self._steps("suggestions", before + first, total)(len(part), total)
        self._keep(dataset, keys)

    def _take_kept(self, dataset: Dataset, keys: dict[str, str]) -> None:
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            kept = json.loads((dataset.path / CACHE / KEPT).read_text(encoding="utf-8"))
            if kept["made_by"] != _made_by() or len(kept["scale"]) != dataset.layout.n_channels:
                return
            self.scale = np.array(kept["scale"], dtype=np.float64)
            for identity, (key, suggestion, seconds, size) in kept["recordings"].items():
                if keys.get(identity) != key:
                    continue
                if suggestion is not None:
                    self.suggestions[identity] = Suggestion(*suggestion)
                self.shapes[identity] = Shape(float(seconds), tuple(map(int, size)))

    def _keep(self, dataset: Dataset, keys: dict[str, str]) -> None:
        recordings = {
            identity: (
                key,
                astuple(self.suggestions[identity]) if identity in self.suggestions else None,
                self.shapes[identity].seconds,
                self.shapes[identity].size,
            )
            for identity, key in keys.items()
        }
        kept = {"made_by": _made_by(), "scale": self.scale.tolist(), "recordings": recordings}
        # On a disk that cannot be written, it is made each time.
        with contextlib.suppress(OSError):
            (dataset.path / CACHE).mkdir(exist_ok=True)
            write_atomically(dataset.path / CACHE / KEPT, json.dumps(kept))


def shape_of(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> Shape:
    """The path of one recording, untrimmed."""
    frames = dataset.read(replace(info, start=0, stop=info.rows))
    if not len(frames):
        return Shape(0.0, ())
    found = line(frames, dataset.layout, scale, float(seconds_of_rows(frames)[-1]))
    return Shape(round(found.lasts, 3), tuple(np.minimum(np.rint(found.size * FULL), 1e6).astype(int).tolist()))


def _made_by() -> str:
    return hashlib.sha256(f"1 {__version__} {SPEC}".encode()).hexdigest()[:16]


def _key(r: RecordingInfo) -> str:
    """What a suggestion depends on."""
    said = repr((r.sha256, r.first_row, r.rows, r.gesture, r.stream, r.stream_row))
    return hashlib.sha256(said.encode()).hexdigest()[:16]
