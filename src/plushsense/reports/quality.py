"""Write the report of a data check: a summary, plots of findings, and overlays of each gesture's recordings."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.quality.checking import CHECKS, CheckReport
from plushsense.dataset.quality.findings import SEVERITIES, Finding
from plushsense.dataset.quality.measurements import NEVER_STOPPED_FACTOR, summarize
from plushsense.dataset.statistics import DurationBand, duration_bands
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.dataset.trimming import find_recordings
from plushsense.reports import quality_figures as figures
from plushsense.reports.figures import data_uri, png
from plushsense.reports.page import check_page_path, render_page, write_page
from plushsense.reports.table import Column, Table, count
from plushsense.windows.cut import WindowSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[int, int], None]

NAMED = 12
"""Maximum number of recordings that an overlay names."""
PLOTS = 12
"""Maximum number of plots for each check."""
PICTURE_BYTES = 10_000_000
"""Maximum size in bytes of all pictures of a page; base64 makes them a third larger."""
_NAMED_CHECKS = ("never-stopped", "too-short", "duration", "no-onset", "several-gestures", "stuck", "flat")
_CLOCK_CHECKS = (
    *("clock-still", "clock-reset", "clock-value", "out-of-order", "gaps", "lost-frames", "jitter", "resumed", "rate"),
)
_SIGNAL_CHECKS = (
    *("never-stopped", "duration", "no-onset", "several-gestures", "overlap", "clock-reset", "gaps"),
    *("garbage", "blank-rows", "spikes", "flat", "stuck", "saturated"),
)
_DRAWN_ROWS = 3
_DURATIONS = {
    "mean": "Mean",
    "median": "Median",
    "sd": "Standard deviation",
    "min": "Shortest",
    "max": "Longest",
    "low": "Band from",
    "high": "Band to",
}
_SEVERITY = {"error": "to decide", "warning": "to look at", "info": "good to know"}


def scale_of(dataset: Dataset, sample: int = 200) -> NDArray[np.float64]:
    """Return the typical spread of each channel within a recording, (C,), from about ``sample`` recordings."""
    used = dataset.used
    sampled = used[:: max(1, len(used) // sample)]
    spreads = [summarize(r, frames, dataset.layout).spread for r in sampled if len(frames := dataset.read(r))]
    high = np.percentile(spreads, 75, axis=0) if spreads else np.ones(dataset.layout.n_channels)
    return np.asarray(np.where(high > 0, high, 1.0))


def _names(result: CheckReport, gesture: str) -> dict[str, str]:
    """Return texts by recording id that name a gesture's recordings with findings and their checks, at most `NAMED`."""
    checks: dict[str, list[str]] = {}
    for f in result.findings:
        if (
            f.recording
            and f.gesture == gesture
            and f.check in _NAMED_CHECKS
            and f.severity != "info"
            and not f.accepted
        ):
            checks.setdefault(f.recording, []).append(f.check)
    return {name: f"{name}: {', '.join(checks[name])}" for name in list(checks)[:NAMED]}


def gesture_figure(result: CheckReport, gesture: str, scale: NDArray[np.float64] | None = None) -> Figure:
    """Draw all used recordings of a gesture in one plot, and their durations."""
    dataset = result.dataset
    scale = scale_of(dataset) if scale is None else scale
    names = _names(result, gesture)
    lines = []
    for r in dataset.used:
        if r.gesture == gesture and r.stop > r.start:
            frames = dataset.read(r)
            lines.append(figures.line(frames, dataset.layout, scale, r.seconds, names.get(r.id, "")))
    seconds = np.array([one.lasts for one in lines]) if lines else np.ones(1)
    mean = float(seconds[seconds <= NEVER_STOPPED_FACTOR * np.median(seconds)].mean())
    return figures.overlay(gesture, lines, mean, result.limits.duration)


@dataclass
class _Pictures:
    """Converts pictures to data URIs up to a total size of ``limit`` bytes; ``left_out`` counts the others."""

    limit: int
    size: int = 0
    left_out: int = 0
    added: int = 0

    def add(self, figure: Figure) -> str | None:
        data = png(figure)
        if self.size + len(data) > self.limit:
            self.left_out += 1
            return None
        self.size += len(data)
        self.added += 1
        return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def duration_rows(bands: Sequence[DurationBand]) -> Table:
    """Return the numbers of `quality_figures.durations`, in seconds."""
    columns = (
        Column("gesture", "Gesture"),
        *(Column(key, head, "count") for key, head in (("recordings", "Recordings"), ("outside", "Outside the band"))),
        *(Column(key, head, "share") for key, head in _DURATIONS.items()),
    )
    rows = tuple(
        {
            "gesture": band.gesture,
            "recordings": len(band.seconds),
            "outside": len(band.outliers),
            "mean": band.mean_s,
            "median": band.statistics.median,
            "sd": None if band.statistics.variance is None else band.statistics.variance**0.5,
            "min": band.statistics.min,
            "max": band.statistics.max,
            "low": band.low_s,
            "high": band.high_s,
        }
        for band in bands
    )
    return Table("durations", "Durations (s)", columns, rows)


def example_recordings(dataset: Dataset, spec: WindowSpec) -> list[RecordingInfo]:
    """Return the first recording that is shorter than a window and the first that gives several windows, if any.

    Recordings at rest are the last choice.
    """
    idle = {g.label for g in dataset.gestures.gestures if g.idle or g.nobody}
    touched_first = sorted(dataset.used, key=lambda r: r.gesture in idle)
    lasting = [(r, r.seconds) for r in touched_first]
    several = (spec.window_s + 2 * spec.step_s, spec.window_s + 20 * spec.step_s)
    short = next((r for r, s in lasting if 0 < s < spec.window_s - 0.1), None)
    long = next((r for r, s in lasting if several[0] < s < several[1]), None)
    return [r for r in (short, long) if r is not None]


@dataclass(frozen=True)
class RecordingPictures:
    """Pictures of a data set's recordings as data URIs, for the template of a report.

    Attributes:
        durations: of the recordings of each gesture; None without a recording.
        table: their numbers.
        windows: for each example of how a recording is cut into windows, the picture and a sentence.
    """

    durations: str | None
    table: Table
    window_s: float
    step_s: float
    windows: tuple[tuple[str, str], ...]


def describe_recordings(dataset: Dataset, recording: str | None = None) -> RecordingPictures:
    """Draw the durations of recordings, and how examples are cut into windows.

    Args:
        recording: id of the recording to show cut into windows (default: `example_recordings`).

    Raises:
        DatasetError: for an unknown recording, or one without a valid sample.
    """
    spec = WindowSpec()
    shown = example_recordings(dataset, spec) if recording is None else find_recordings(dataset, recording)[:1]
    bands = duration_bands(dataset)
    cut = [figures.windows(dataset, info, spec) for info in shown]
    return RecordingPictures(
        durations=data_uri(figures.durations(bands)) if bands else None,
        table=duration_rows(bands),
        window_s=spec.window_s,
        step_s=spec.step_s,
        windows=tuple((data_uri(figure), sentence) for figure, sentence in cut),
    )


def write_report(path: Path, result: CheckReport, progress: Progress | None = None) -> Path:
    """Write the report of ``result`` as a page; of existing files only an earlier report is replaced.

    Raises:
        ConfigError: when ``path`` is a file that is not a report, or cannot be written.
        MissingExtraError: when matplotlib is not installed.
    """
    target = check_page_path(path)
    return write_page(target, render(result, progress))


def render(result: CheckReport, progress: Progress | None = None) -> str:
    """Return the report of ``result`` as an HTML page."""
    dataset = result.dataset
    pictures = _Pictures(PICTURE_BYTES)
    gestures = [g.label for g in dataset.gestures.gestures if any(r.gesture == g.label for r in dataset.used)]
    by_check = {name: result.findings_of(name) for name in CHECKS}
    by_check = {name: findings for name, findings in by_check.items() if findings}
    scale = scale_of(dataset)
    plotter = _Plotter(dataset, scale)
    bands = duration_bands(dataset, result.limits.duration)
    report = progress or (lambda done, total: None)
    total = len(by_check) + len(gestures)
    # Add plots of findings first, because overlays are the less important pictures to leave out.
    sections = []
    for name, findings in by_check.items():
        sections.append(_section(name, findings, plotter, pictures))
        report(len(sections), total)
    overlays = []
    for gesture in gestures:
        overlays.append({"label": gesture, "picture": pictures.add(gesture_figure(result, gesture, scale))})
        report(len(sections) + len(overlays), total)
    counts = result.counts()
    return render_page(
        "quality.html.j2",
        title=f"Check of {dataset.head.name}",
        simulated=dataset.head.simulated,
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
        durations=pictures.add(figures.durations(bands)) if bands else None,
        overlays=overlays,
        named=NAMED,
        tolerance=f"{100 * result.limits.duration:.0f}",
        severities=[_SEVERITY[s] for s in SEVERITIES],
        left_out=pictures.left_out,
        plots=PLOTS,
        pictures=pictures.added,
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


def _section(name: str, findings: list[Finding], plotter: _Plotter, pictures: _Pictures) -> dict[str, Any]:
    plottable = [f for f in _spread(findings) if not f.accepted and plotter.can_draw(f)]
    added = [pictures.add(figure) for f in plottable[:PLOTS] for figure in plotter.draw(f)]
    return {
        "name": name,
        "count": len(findings),
        "counts": [sum(f.severity == s and not f.accepted for f in findings) for s in SEVERITIES],
        "action": CHECKS[name].action,
        "rows": [_row(f) for f in findings],
        "pictures": [uri for uri in added if uri is not None],
        "more": max(0, len(plottable) - PLOTS),
    }


def _spread(findings: list[Finding]) -> list[Finding]:
    """Sort findings by severity, then the first of each person before second ones, so that plots show many people."""
    turns: Counter[tuple[str, str]] = Counter()
    order = []
    for f in findings:
        order.append((SEVERITIES.index(f.severity), not f.recording, turns[f.severity, f.subject]))
        turns[f.severity, f.subject] += 1
    return [f for _, f in sorted(zip(order, findings, strict=True), key=lambda pair: pair[0])]


class _Plotter:
    """Draws the places of findings; caches the frames that were read last."""

    def __init__(self, dataset: Dataset, scale: NDArray[np.float64]) -> None:
        self._dataset = dataset
        self._scale = scale
        self._recordings: Mapping[str, RecordingInfo] = {r.id: r for r in dataset.recordings}
        self._last: tuple[str, Frames] | None = None

    @property
    def _layout(self) -> Layout:
        return self._dataset.layout

    def can_draw(self, f: Finding) -> bool:
        """Return whether there is a plot that helps to judge this finding."""
        if f.recording:
            info = self._recordings[f.recording]
            return info.stop - info.start >= _DRAWN_ROWS and (f.check in _SIGNAL_CHECKS or f.check in _CLOCK_CHECKS)
        return bool(f.stream) and f.check in (*_CLOCK_CHECKS, "stuck", "flat", "drift", "garbage")

    def draw(self, f: Finding) -> Iterator[Figure]:
        """Yield up to two figures: the clock for findings about time, and the channels with the place marked."""
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
        if f.check in _CLOCK_CHECKS:
            yield figures.clock(frames, f.rows, first_row=first, title=title)
            title = ""
        if f.check in _SIGNAL_CHECKS and (f.recording or f.check not in _CLOCK_CHECKS):
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
