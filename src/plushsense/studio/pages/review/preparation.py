"""Trim suggestions, deviation shapes and findings of a data set, computed in the background.

Suggestions and shapes depend only on raw files. They are cached in the folder ``cache/`` of the data set, which can be
deleted, is in no backup, and is emptied when a person is forgotten. Findings also depend on the marks and are computed
again on request.
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

from plushsense.core.errors import ForgottenError, PlushSenseError
from plushsense.core.files import write_file
from plushsense.core.version import __version__
from plushsense.dataset.files import CACHE
from plushsense.dataset.onset import SPEC, Suggestion
from plushsense.dataset.quality.checking import CheckReport, check
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.dataset.trimming import row_times_s, suggest_trims
from plushsense.reports.quality import scale_of
from plushsense.reports.quality_figures import line
from plushsense.studio.app.workspace import ChangeSignal

CACHE_FILE = "review.json"
FULL = 1000
"""Value of `Shape.size` at the typical deviation."""
_BATCH = 25
_RING_S = 0.3
# Pauses between two recordings, so that pages get the interpreter; longer while a page is in use.
_BREATH_S = 0.0005
_STEPPED_BACK_S = 0.015
_BUSY_S = 1.5


class _Closed(Exception):
    """Raised in the worker thread when the studio closes."""


@dataclass(frozen=True)
class DeviationShape:
    """The deviation of a whole recording from rest, in a few points.

    ``size`` (≤ 160,): deviation of all channels from rest, `FULL` where it is typical, at even steps over ``seconds``.
    """

    seconds: float
    size: tuple[int, ...]


@dataclass
class ReviewPreparation:
    """Results computed so far by one background thread.

    Attributes:
        scale: (C,) typical deviation of each channel; empty until it is known.
        progress: (step, done, total), or None if nothing runs; ``step`` is "suggestions" or "checks".
        said: error message of the last run, or "".
    """

    changed: ChangeSignal
    suggestions: dict[str, Suggestion] = field(default_factory=dict)
    shapes: dict[str, DeviationShape] = field(default_factory=dict)
    scale: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    checked: CheckReport | None = None
    progress: tuple[str, int, int] | None = None
    message: str = ""
    _thread: threading.Thread | None = field(default=None, repr=False)
    _again: Dataset | None = field(default=None, repr=False)
    _lock: Any = field(default_factory=threading.Lock, repr=False)
    _closed: bool = False
    _rung_s: float = 0.0
    _asked_s: float = 0.0

    def begin(self, dataset: Dataset) -> None:
        """Start computing missing results and checking ``dataset`` with its marks; return at once.

        A call during a run starts another run after it.
        """
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                self._again = dataset
                return
            self._thread = threading.Thread(target=self._run, args=(dataset,), daemon=True)
            self._thread.start()

    def step_back(self) -> None:
        """Slow the background thread for a while, because a page needs the interpreter."""
        self._asked_s = time.monotonic()

    def wait(self, seconds: float) -> None:
        """Wait until the background thread is done, at most ``seconds``."""
        if self._thread is not None:
            self._thread.join(seconds)

    def close(self) -> None:
        """Stop the background thread and wait for it."""
        self._closed = True
        self.wait(5.0)

    def _run(self, dataset: Dataset | None) -> None:
        while dataset is not None:
            try:
                self.message = ""
                self._make(dataset)
                self.progress = ("checks", 0, len(dataset.recordings))
                self.checked = check(dataset, progress=self._steps("checks"))
            except _Closed:
                return
            except PlushSenseError as refusal:
                self.message = str(refusal)
            except OSError as cause:
                self.message = f"'{dataset.path}' cannot be read: {cause.strerror or cause}."
            with self._lock:
                dataset, self._again = self._again, None
                if dataset is None:
                    self.progress, self._thread = None, None
            self.changed.notify()

    def _steps(self, what: str, before: int = 0, total: int = 0) -> Callable[[int, int], None]:
        def step(done: int, of: int) -> None:
            if self._closed:
                raise _Closed
            self.progress = (what, before + done, total or of)
            now = time.monotonic()
            time.sleep(_STEPPED_BACK_S if now - self._asked_s < _BUSY_S else _BREATH_S)
            if time.monotonic() - self._rung_s > _RING_S:
                self._rung_s = time.monotonic()
                self.changed.notify()

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
                found = suggest_trims(dataset, part, self._steps("suggestions", before + first, total))
                self.suggestions |= {t.recording.id: t.suggestion for t in found}
            self.shapes |= {r.id: shape_of(dataset, r, self.scale) for r in part}
            self._steps("suggestions", before + first, total)(len(part), total)
        self._keep(dataset, keys)

    def _take_kept(self, dataset: Dataset, keys: dict[str, str]) -> None:
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError):
            kept = json.loads((dataset.path / CACHE / CACHE_FILE).read_text(encoding="utf-8"))
            if kept["made_by"] != _made_by() or len(kept["scale"]) != dataset.layout.n_channels:
                return
            self.scale = np.array(kept["scale"], dtype=np.float64)
            for identity, (key, suggestion, seconds, size) in kept["recordings"].items():
                if keys.get(identity) != key:
                    continue
                if suggestion is not None:
                    self.suggestions[identity] = Suggestion(*suggestion)
                self.shapes[identity] = DeviationShape(float(seconds), tuple(map(int, size)))

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
        # Without a writable disk, everything is computed again each time.
        with contextlib.suppress(OSError, ForgottenError), dataset.generation.writing():
            (dataset.path / CACHE).mkdir(exist_ok=True)
            write_file(dataset.path / CACHE / CACHE_FILE, json.dumps(kept))


def shape_of(dataset: Dataset, info: RecordingInfo, scale: NDArray[np.float64]) -> DeviationShape:
    """Compute the deviation shape of one untrimmed recording."""
    frames = dataset.read(replace(info, start=0, stop=info.rows))
    if not len(frames):
        return DeviationShape(0.0, ())
    found = line(frames, dataset.layout, scale, float(row_times_s(frames)[-1]))
    return DeviationShape(
        round(found.lasts, 3), tuple(np.minimum(np.rint(found.size * FULL), 1e6).astype(int).tolist())
    )


def _made_by() -> str:
    return hashlib.sha256(f"1 {__version__} {SPEC}".encode()).hexdigest()[:16]


def _key(r: RecordingInfo) -> str:
    """Return a hash of everything that a trim suggestion depends on."""
    message = repr((r.sha256, r.first_row, r.rows, r.gesture, r.stream, r.stream_row))
    return hashlib.sha256(message.encode()).hexdigest()[:16]
