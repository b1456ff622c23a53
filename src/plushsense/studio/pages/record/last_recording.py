"""Measure the recording that was just made, and show its signal, its length and how usual that is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from nicegui import run, ui

from plushsense.core.errors import PlushSenseError
from plushsense.core.gestures import plain_label
from plushsense.core.recorder_csv import parse_name, read_recording
from plushsense.core.toml import loads_json
from plushsense.dataset.quality.comparisons import usual_seconds
from plushsense.dataset.quality.findings import CheckLimits
from plushsense.recording.status import RecorderStatus
from plushsense.recording.takes import duration_s
from plushsense.recording.writer import SIDECAR, discarded_recordings
from plushsense.reports.quality_figures import line
from plushsense.studio.app.shell import Page, html, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.record.controller import ActiveSession

_LENGTHS: Texts = {
    "usual": "{gesture}, {n}: {s} s, a usual length (mean {usual} s)",
    "short": "{gesture}, {n}: {s} s, TOO SHORT (mean {usual} s)",
    "long": "{gesture}, {n}: {s} s, TOO LONG (mean {usual} s)",
    "first": "{gesture}, {n}: {s} s; there is no earlier recording of this gesture to compare it with",
}

_HEIGHT, _WIDTH = 44, 180


@dataclass(frozen=True)
class RecordingResult:
    """A finished recording: its length, that of earlier ones of its gesture, and its deviation from rest.

    Attributes:
        usual_s: mean length of the earlier recordings of the gesture (the measure of the paper); 0 if there are none.
        size: deviation from rest over the time, as a share of the largest one.
    """

    gesture: str
    repetition: int
    seconds: float
    usual_s: float
    size: tuple[float, ...]

    @property
    def length(self) -> str:
        """Return "usual", "short" or "long" by the paper's rule of ±40 %, or "first" without earlier recordings."""
        if not self.usual_s:
            return "first"
        off = self.seconds / self.usual_s - 1.0
        return "usual" if abs(off) <= CheckLimits().duration else "long" if off > 0 else "short"


def measure_result(session: ActiveSession, file: str, recordings: Path) -> RecordingResult:
    """Measure the recording ``file`` of a session, and the earlier ones of its gesture in the folder ``recordings``.

    Raises:
        PlushSenseError, OSError: if its files cannot be read.
    """
    files = session.recorder.session
    table = loads_json((files.folder / file).with_suffix(SIDECAR).read_text(encoding="utf-8"))
    frames = read_recording(files.folder / file, files.layout).frames
    seconds = _seconds(table)
    # A channel counts by how much it moved in the last minute.
    recent = session.device.buffer.rows()[1].values
    moved = np.ptp(np.percentile(recent if len(recent) else frames.values, (1, 99), axis=0), axis=0)
    size = line(frames, files.layout, np.maximum(moved, 1.0), seconds).size
    earlier = [s for s in _earlier_seconds(recordings, files.folder / file, table) if s > 0]
    usual_s = usual_seconds(earlier) if earlier else 0.0
    shares = tuple(float(v) for v in size / max(float(size.max(initial=0.0)), 1.0))
    return RecordingResult(str(table["gesture"]), int(table["repetition"]), seconds, usual_s, shares)


def _seconds(table: dict[str, Any]) -> float:
    """Return the duration of a recording, from its sidecar."""
    return duration_s(int(table["rows"]), float(table["rate_hz"]))


def _earlier_seconds(recordings: Path, path: Path, table: dict[str, Any]) -> Iterator[float]:
    """Yield the lengths of the other recordings in use of the same gesture, virtual and real ones apart."""
    gesture, discarded = plain_label(str(table["gesture"])), dict[Path, dict[str, str]]()
    for other in recordings.glob(f"*/*/*{SIDECAR}"):
        csv = other.with_suffix(".csv")
        name = parse_name(csv.name)
        if csv == path or name is None or plain_label(name.label) != gesture or not csv.is_file():
            continue
        if csv.name in discarded.setdefault(csv.parent, discarded_recordings(csv.parent)):
            continue
        try:
            its = loads_json(other.read_text(encoding="utf-8"))
            if bool(its["simulated"]) == bool(table["simulated"]):
                yield _seconds(its)
        except (OSError, ValueError, KeyError, TypeError):
            continue


def _drawing(result: RecordingResult, label: str) -> Markup:
    last = max(1, len(result.size) - 1)
    points = " ".join(
        f"{_WIDTH * n / last:.1f},{_HEIGHT - 2 - (_HEIGHT - 4) * share:.1f}" for n, share in enumerate(result.size)
    )
    return Markup(
        '<svg viewBox="0 0 {w} {h}" width="{w}" height="{h}" role="img" aria-label="{label}">'
        '<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.6"/></svg>'
    ).format(w=_WIDTH, h=_HEIGHT, label=label, points=points)


class ResultPanel:
    """The last recording: a small picture of its signal, its length, and whether that is usual."""

    def __init__(self, page: Page, session: ActiveSession) -> None:
        self._page, self._session, self._file = page, session, ""
        with tag(ui.row().classes("ps-card ps-result w-full items-center"), "result") as self._box:
            self._picture = html()
            with ui.column().classes("ps-no-gap ps-result-text"):
                self._text = tag(ui.label(), "result-text").classes("text-bold").props('role="status"')
                ui.label(page.words("r makes it again; the earlier one stays in the folder.")).classes("ps-dim")
                self._last = tag(ui.label(), "last").classes("ps-dim ps-note ps-break")
        self._box.set_visibility(False)

    async def draw(self, s: RecorderStatus) -> None:
        """Show the last recording in use, if it is another one than before."""
        if s.file == self._file:
            return
        self._file = file = s.file
        if not file:
            self._box.set_visibility(False)
            return
        try:
            result = await run.io_bound(measure_result, self._session, file, self._page.workspace.recordings)
        except (PlushSenseError, OSError, ValueError, KeyError):
            result = None
        if result is None or self._file != file:
            return
        words = self._page.words
        self._text.text = _sentence(words, result)
        self._text.props(f'data-length="{result.length}"')
        self._last.text = words("Last: {file}", file=file)
        self._picture.content = _drawing(
            result, words("Signal of the last recording: {gesture}", gesture=words.gesture(result.gesture))
        )
        self._box.set_visibility(True)


def _sentence(words: Words, result: RecordingResult) -> str:
    values = {"gesture": words.gesture(result.gesture), "n": result.repetition, "s": words.number(result.seconds, 1)}
    return words(_LENGTHS[result.length], usual=words.number(result.usual_s, 1), **values)
