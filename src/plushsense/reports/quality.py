"""The page of a check: a summary, every gesture's recordings over each other, and plots of what was found."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.quality.checking import CHECKS, CheckReport
from plushsense.dataset.quality.findings import SEVERITIES, Finding
from plushsense.dataset.quality.measurements import NEVER_STOPPED_FACTOR, duration_s, summarize
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.reports import quality_figures as figures
from plushsense.reports.figures import png
from plushsense.reports.page import check_page_path, render_page, write_page
from plushsense.reports.table import count
from plushsense.reports.wording import SIMULATED_RECORDINGS_TITLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[int, int], None]

NAMED = 12
"""Odd recordings that an overlay names; more would be a tangle."""
PLOTS = 12
"""Plots a check."""
PICTURE_BYTES = 10_000_000
"""What all pictures of a page may weigh; written as text they take a third more."""
_ODD = ("never-stopped", "duration", "no-onset", "several-gestures", "stuck", "flat")
_CLOCK = ("clock-reset", "gaps", "lost-frames", "jitter", "resumed", "rate")
_SIGNAL = (
    *("never-stopped", "duration", "no-onset", "several-gestures", "overlap", "clock-reset", "gaps"),
    *("garbage", "blank-rows", "spikes", "flat", "stuck", "saturated"),
)
_DRAWN_ROWS = 3
_SEVERITY = {"error": "to decide", "warning": "to look at", "info": "good to know"}


def scale_of(dataset: Dataset, sample: int = 200) -> NDArray[np.float64]:
    """Return the usual spread of each channel within a recording, (C,), from a sample of the recordings."""
    used = dataset.used
    taken = used[:: max(1, len(used) // sample)]
    spreads = [summarize(r, frames, dataset.layout).spread for r in taken if len(frames := dataset.read(r))]
    high = np.percentile(spreads, 75, axis=0) if spreads else np.ones(dataset.layout.n_channels)
    scale: NDArray[np.float64] = np.where(high > 0, high, 1.0)
    return scale


def _names_of_odd(result: CheckReport, gesture: str) -> dict[str, str]:
    """Return the recordings that an overlay names: id and reason; errors and warnings, the most urgent first."""
    odd: dict[str, list[str]] = {}
    for f in result.findings:
        if f.recording and f.gesture == gesture and f.check in _ODD and f.severity != "info" and not f.accepted:
            odd.setdefault(f.recording, []).append(f.check)
    return {name: f"{name}: {', '.join(odd[name])}" for name in list(odd)[:NAMED]}


def gesture_figure(result: CheckReport, gesture: str, scale: NDArray[np.float64] | None = None) -> Figure:
    """Draw all used recordings of a gesture over each other, and how long each lasts."""
    dataset = result.dataset
    scale = scale_of(dataset) if scale is None else scale
    odd = _names_of_odd(result, gesture)
    lines = []
    for r in dataset.used:
        if r.gesture == gesture and r.stop > r.start:
            frames = dataset.read(r)
            lines.append(figures.line(frames, dataset.layout, scale, duration_s(frames), odd.get(r.id, "")))
    seconds = np.array([one.lasts for one in lines]) if lines else np.ones(1)
    mean = float(seconds[seconds <= NEVER_STOPPED_FACTOR * np.median(seconds)].mean())
    return figures.overlay(gesture, lines, mean, result.limits.duration)


@dataclass
class _Pictures:
    """Pictures as data URIs until they weigh too much; ``left_out`` counts the rest."""

    limit: int
    weight: int = 0
    left_out: int = 0
    made: int = 0

    def add(self, figure: Figure) -> str | None:
        data = png(figure)
        if self.weight + len(data) > self.limit:
            self.left_out += 1
            return None
        self.weight += len(data)
        self.made += 1
        return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def write_report(path: Path, result: CheckReport, progress: Progress | None = None) -> Path:
    """Write the page; an older page of PlushSense is replaced in one step, another file never.

    Raises:
        ConfigError: when the place is taken by something else, or cannot be written.
        MissingExtraError: when jinja2 or matplotlib is not installed.
    """
    target = check_page_path(path)
    return write_page(target, render(result, progress))


def render(result: CheckReport, progress: Progress | None = None) -> str:
    """Return the page as one HTML text; files are read again only where they are drawn."""
    dataset = result.dataset
    pictures = _Pictures(PICTURE_BYTES)
    gestures = [g.label for g in dataset.gestures.gestures if any(r.gesture == g.label for r in dataset.used)]
    by_check = {name: result.findings_of(name) for name in CHECKS}
    by_check = {name: found for name, found in by_check.items() if found}
    total, done = len(gestures) + len(by_check), 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, total)

    scale = scale_of(dataset)
    places = _Places(dataset, scale)
    # Findings first: where pictures must be left out, the places of faults matter more.
    sections = []
    for name, found in by_check.items():
        sections.append(_section(name, found, places, pictures))
        step()
    overlays = []
    for gesture in gestures:
        overlays.append({"label": gesture, "picture": pictures.add(gesture_figure(result, gesture, scale))})
        step()
    counts = result.counts()
    return render_page(
        "quality.html.j2",
        title=f"Check of {dataset.head.name}",
        simulated=dataset.head.simulated,
        simulated_title=SIMULATED_RECORDINGS_TITLE,
        summary=[
            ("Recordings looked at", count(result.recordings)),
            ("Excluded by a mark", count(result.excluded)),
            ("People", count(len(dataset.subjects))),
            ("Streams", count(len(dataset.streams))),
            ("Layout", f"{dataset.layout.title}, {dataset.layout.rate_hz:g} Hz"),
            *((f"Findings {_SEVERITY[s]}", count(counts["by_severity"][s])) for s in SEVERITIES),
            ("Findings accepted", count(sum(counts["accepted"].values()))),
        ],
        undecided=[_row(f) for f in result.undecided],
        sections=sections,
        overlays=overlays,
        named=NAMED,
        tolerance=f"{100 * result.limits.duration:.0f}",
        severities=[_SEVERITY[s] for s in SEVERITIES],
        left_out=pictures.left_out,
        plots=PLOTS,
        pictures=pictures.made,
        clean=[name for name in result.checks if name not in by_check],
    )


def _row(f: Finding) -> dict[str, Any]:
    return {
        "about": f.about or "the data set",
        "check": f.check,
        "severity": _SEVERITY[f.severity],
        "message": f.message,
        "action": f.action,
        "accepted": f.accepted,
    }


def _section(name: str, found: list[Finding], places: _Places, pictures: _Pictures) -> dict[str, Any]:
    drawn = []
    wanted = [f for f in _spread(found) if not f.accepted and places.can_draw(f)]
    for f in wanted[:PLOTS]:
        drawn += [uri for figure in places.draw(f) if (uri := pictures.add(figure)) is not None]
    return {
        "name": name,
        "count": len(found),
        "counts": [sum(f.severity == s and not f.accepted for f in found) for s in SEVERITIES],
        "action": CHECKS[name].action,
        "rows": [_row(f) for f in found],
        "pictures": drawn,
        "more": max(0, len(wanted) - PLOTS),
    }


def _spread(found: list[Finding]) -> Iterator[Finding]:
    """Yield the findings in turn over the people, so that the plots differ; the most urgent first."""
    turns: dict[tuple[int, str], int] = {}
    order = []
    for i, f in enumerate(found):
        severity = SEVERITIES.index(f.severity)
        turn = turns[severity, f.subject] = turns.get((severity, f.subject), -1) + 1
        order.append((severity, not f.recording, turn, i, f))
    yield from (entry[4] for entry in sorted(order, key=lambda entry: entry[:4]))


class _Places:
    """Where findings are, drawn; the last file read is kept."""

    def __init__(self, dataset: Dataset, scale: NDArray[np.float64]) -> None:
        self._dataset = dataset
        self._scale = scale
        self._recordings: Mapping[str, RecordingInfo] = {r.id: r for r in dataset.recordings}
        self._last: tuple[str, Frames] | None = None

    @property
    def _layout(self) -> Layout:
        return self._dataset.layout

    def can_draw(self, f: Finding) -> bool:
        """Return whether a plot helps to judge this finding."""
        if f.recording:
            info = self._recordings[f.recording]
            return info.stop - info.start >= _DRAWN_ROWS and (f.check in _SIGNAL or f.check in _CLOCK)
        return bool(f.stream) and f.check in (*_CLOCK, "stuck", "flat", "drift", "garbage")

    def draw(self, f: Finding) -> Iterator[Figure]:
        """Yield one or two figures: the clock for findings about time, the channels with the place marked."""
        frames = self._frames(f)
        if not len(frames):
            return
        title = f"{f.about}: {f.message}"
        title = title if len(title) <= 205 else title[:202] + " …"
        first = self._recordings[f.recording].start if f.recording else 0
        if f.check == "drift":
            info = next(s for s in self._dataset.streams if s.id == f.stream)
            lows = summarize(info, frames, self._layout).lows
            if lows is not None:
                yield figures.baselines(lows, self._layout, f.channels, title=title)
            return
        if f.check in _CLOCK:
            yield figures.clock(frames, f.rows, first_row=first, title=title)
            title = ""
        if f.check in _SIGNAL and (f.recording or f.check not in _CLOCK):
            marked = () if f.check in ("never-stopped", "flat") else f.rows
            yield figures.signals(
                frames, self._layout, marked, f.channels, first_row=first, title=title, scale=self._scale
            )

    def _frames(self, f: Finding) -> Frames:
        if self._last is None or self._last[0] != f.about:
            read = (
                self._dataset.read(self._recordings[f.recording])
                if f.recording
                else self._dataset.read_stream(f.stream)
            )
            self._last = (f.about, read)
        return self._last[1]
