"""Draw overlays of a gesture's recordings, durations, windows of a recording, the places of findings, and trims."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, DatasetError, need
from plushsense.core.layouts import Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.quality.measurements import LEVEL_KINDS
from plushsense.dataset.statistics import DurationBand
from plushsense.dataset.store import Dataset, RecordingInfo
from plushsense.dataset.trimming import Trim
from plushsense.reports.figures import new_figure, png
from plushsense.windows.cut import WindowSpec, from_recording
from plushsense.windows.features import network_inputs
from plushsense.windows.sessions import SessionReader

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Okabe and Ito's colours, which colour-blind readers can distinguish; recordings without findings are grey.
COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY, BAND, MARK = "#9aa0a6", "#e8f0fa", "#d55e00"
_POINTS = 1500
_LINE_POINTS = 160
_CHANNELS = 13
_FEW = 40
_NUMBERED = 40


@dataclass(frozen=True)
class Line:
    """A recording in an overlay: its deviation ``size`` (T,) from rest at ``seconds``; a name if it has findings."""

    seconds: NDArray[np.float64]
    size: NDArray[np.float64]
    lasts: float
    name: str = ""


def from_rest(frames: Frames, layout: Layout, scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the difference of each channel from its rest level in the recording, (T, C), in units of ``scale``.

    The rest level is the 10th percentile of channels of `LEVEL_KINDS`, and the median of others. Values are clipped to
    the valid range.
    """
    values = np.clip(frames.values, layout.valid_min_int, layout.valid_max_int)
    level = np.array([c.kind in LEVEL_KINDS for c in layout.channels])
    low, middle = np.percentile(values, (10, 50), axis=0)
    return np.asarray((values - np.where(level, low, middle)) / scale)


def deviation(frames: Frames, layout: Layout, scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the Euclidean norm over the channels of `from_rest`, (T,)."""
    return np.asarray(np.sqrt(np.square(from_rest(frames, layout, scale)).sum(axis=1)))


def line(frames: Frames, layout: Layout, scale: NDArray[np.float64], lasts: float, name: str = "") -> Line:
    """Return a recording as a line of an overlay; a long one is reduced to the maxima of equal sections."""
    size = deviation(frames, layout, scale)
    seconds = np.linspace(0.0, lasts, len(size))
    step = -(-len(size) // _LINE_POINTS)
    if step > 1:
        whole = len(size) // step * step
        size, seconds = size[:whole].reshape(-1, step).max(axis=1), seconds[:whole:step]
    return Line(seconds, size, lasts, name)


def overlay(gesture: str, lines: Sequence[Line], mean_s: float, tolerance: float) -> Figure:
    """Draw all recordings of a gesture in one plot, those with a name in colour, and below it their durations."""
    figure = new_figure(9.2, 4.3)
    top, strip = figure.subplots(2, 1, height_ratios=(3.2, 1), sharex=True)
    named = [one for one in lines if one.name]
    # Ignore the length of a recording that was never stopped, which would compress all others.
    end = max([1.8 * mean_s, *(one.lasts for one in lines if one.lasts < 4 * mean_s)], default=1.0)
    few = len(lines) <= _FEW
    for one in lines:
        if not one.name:
            top.plot(one.seconds, one.size, color=GREY, linewidth=1.0 if few else 0.6, alpha=0.9 if few else 0.35)
    for i, one in enumerate(named):
        style = "-" if i < len(COLOURS) else "--"
        top.plot(one.seconds, one.size, style, color=COLOURS[i % len(COLOURS)], linewidth=1.4, label=one.name)
    heights = [s for one in lines for s in (np.percentile(one.size, 99.5),) if one.size.size]
    # Without height or length, as with recordings of one row, the axes need another limit than 0.
    top.set_ylim(0, (1.25 * float(np.percentile(heights, 98)) if heights else 0.0) or 1.0)
    top.set_ylabel("deviation from rest\n(1 = usual)", fontsize=9)
    top.set_title(f"{gesture}: {len(lines)} recordings", fontsize=10, parse_math=False)
    if named:
        legend = top.legend(fontsize=7.5, frameon=True, framealpha=0.85, loc="upper right")
        for text in legend.get_texts():
            text.set_parse_math(False)
    strip.axvspan((1 - tolerance) * mean_s, (1 + tolerance) * mean_s, color=BAND, zorder=0)
    strip.axvline(mean_s, color=COLOURS[1], linewidth=1.0)
    # Fixed vertical offsets separate the dots and, unlike random ones, always give the same picture.
    rest = [one.lasts for one in lines if not one.name]
    strip.plot(rest, (np.arange(len(rest)) * 0.618) % 1.0, "o", color=GREY, markersize=2.6, alpha=0.7)
    for i, one in enumerate(named):
        marker, colour = ">" if one.lasts > end else "D", COLOURS[i % len(COLOURS)]
        offset = 0.2 + 0.6 * ((i * 0.618) % 1.0)
        strip.plot(min(one.lasts, end), offset, marker, color=colour, markersize=5, zorder=3)
    strip.set_yticks([])
    strip.set_ylim(-0.15, 1.15)
    strip.set_xlim(0, end * 1.01 or 1.0)
    strip.set_xlabel(
        f"seconds; below: how long each lasts, the mean {mean_s:.2f} s, and ±{100 * tolerance:.0f} % of it shaded",
        fontsize=9,
    )
    for axes in (top, strip):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    return figure


def durations(bands: Sequence[DurationBand]) -> Figure:
    """Draw how long the recordings of each gesture last, with mean, median, standard deviation and the band.

    It corresponds to the paper's Figure 3. Recordings outside the band have another shape and colour; those that were
    never stopped may stand as an arrow at the right edge, and widen the standard deviation.
    """
    figure = new_figure(9.2, 1.5 + 0.36 * len(bands))
    axes = figure.add_subplot()
    end = 1.05 * max(min(max(band.high_s, band.statistics.max), 4 * band.mean_s) for band in bands)
    for y, band in enumerate(bands):
        # matplotlib leaves names that begin with "_" out of the legend.
        hidden = "_" if y else ""
        axes.barh(y, band.high_s - band.low_s, 0.8, band.low_s, color=BAND, label=f"{hidden}band around the mean")
        outliers = set(band.outliers)
        inside = [s for i, s in band.seconds.items() if i not in outliers]
        outside = [band.seconds[i] for i in band.outliers]
        for there, marker, colour, name in (
            (inside, "o", GREY, f"{hidden}recording in the band"),
            ([s for s in outside if s <= end], "D", MARK, f"{hidden}recording outside"),
            ([0.992 * end for s in outside if s > end], ">", MARK, "_beyond the edge"),
        ):
            # Fixed vertical offsets separate the dots and always give the same picture.
            at = y + 0.22 * (2 * ((np.arange(len(there)) * 0.618) % 1.0) - 1)
            axes.plot(there, at, marker, color=colour, markersize=3.2, label=name)
        sd = (band.statistics.variance or 0.0) ** 0.5
        spread = f"{hidden}mean ± standard deviation"
        axes.errorbar(band.mean_s, y, xerr=sd, fmt="|", color=COLOURS[1], markersize=16, capsize=3, label=spread)
        median = band.statistics.median
        axes.plot(median, y, "x", color="#000000", markersize=6, zorder=4, label=f"{hidden}median")
    axes.set_yticks(range(len(bands)), [f"{b.gesture} ({len(b.seconds)})" for b in bands], parse_math=False)
    axes.set_ylim(len(bands) - 0.4, -0.6)
    axes.set_xlim(0, end)
    axes.set_xlabel("duration of a recording after trimming (s)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    percent = 100 * (bands[0].high_s / bands[0].mean_s - 1)
    figure.suptitle(f"As the paper's Figure 3: durations, and the band of ±{percent:.0f} %", fontsize=10)
    figure.legend(loc="outside lower center", ncols=5, fontsize=7.5, frameon=False)
    return figure


def windows(dataset: Dataset, info: RecordingInfo, spec: WindowSpec) -> tuple[Figure, str]:
    """Draw how a recording is cut into windows (as the paper's Figure 5); return the figure and a sentence.

    The windows are those that training cuts with the context "loop". The signal is the first measured input of the
    network. Of a recording that a gap divides, the longest part is drawn.

    Raises:
        DatasetError: if the recording has no valid sample.
    """
    layout = dataset.layout
    window, step = layout.samples(spec.window_s), layout.samples(spec.step_s)
    segments = SessionReader(dataset).recording(info)
    if not segments:
        raise DatasetError(f"'{info.id}' has no valid sample, and so gives no window: choose another recording.")
    segment = max(segments, key=len)
    cuts = from_recording([segment], dataset, window, step)
    looped = cuts[0].context == "loop"
    data = cuts[0].x if looped else network_inputs(segment.data, layout)
    name = next((name for name in layout.inputs if name in layout.names), layout.inputs[0])
    y, unit = data[:, layout.inputs.index(name)].astype(np.float64), "as the network reads it"
    if name in layout.names:
        y, unit = y * layout.channels[layout.index(name)].step, layout.channels[layout.index(name)].unit
    seconds = np.arange(len(y)) / layout.rate_hz
    height = min(0.5 + 0.17 * len(cuts), 4.0)
    figure = new_figure(9.2, 3.3 + height)
    top, rows = figure.subplots(2, 1, height_ratios=(2.2, height), sharex=True)
    own = len(segment) if looped else len(y)
    top.plot(seconds[:own], y[:own], color=COLOURS[1], linewidth=1.2, label="recording")
    if looped:
        top.plot(seconds[own - 1 :], y[own - 1 :], "--", color=MARK, linewidth=1.0, label="repeated from its start")
        for again in range(own, len(y), own):
            top.axvline(again / layout.rate_hz, color=GREY, linestyle=":", linewidth=1.2)
    top.set_ylabel(f"{name}\n({unit})", fontsize=9)
    for number, cut in enumerate(cuts, 1):
        begin = cut.begin / layout.rate_hz
        rows.barh(number, len(cut.x) / layout.rate_hz, 0.7, begin, color=BAND, edgecolor=COLOURS[1], linewidth=0.8)
        if len(cuts) <= _NUMBERED:
            rows.text(begin + 0.03, number, str(number), va="center", fontsize=7)
    unused = 0 if looped else len(y) - cuts[-1].begin - window
    if unused:
        after = ((len(y) - unused) / layout.rate_hz, len(y) / layout.rate_hz)
        top.axvspan(*after, color=GREY, alpha=0.25, linewidth=0, label="in no window")
    rows.set_ylim(len(cuts) + 0.6, 0.4)
    rows.set_yticks([])
    rows.set_ylabel("windows", fontsize=9)
    rows.set_xlabel("seconds since the start of the recording", fontsize=9)
    rows.set_xlim(0, len(y) / layout.rate_hz)
    for axes in (top, rows):
        axes.tick_params(labelsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    count = "1 window" if len(cuts) == 1 else f"{len(cuts)} windows"
    said = f"{info.id}: {len(segment)} samples at {layout.rate_hz:g} Hz give {count} of {window} samples"
    said += ", filled by repeating the recording" if looped else f", one every {step} samples"
    said += f"; the last {unused} samples are in none" if unused else ""
    said += f"; drawn is the longest of {len(segments)} parts between gaps" if len(segments) > 1 else ""
    figure.suptitle(textwrap.fill(f"As the paper's Figure 5: {said}", 105), fontsize=9).set_parse_math(False)
    return figure, f"{said}."


def _thinned(rows: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, rows - 1, min(rows, _POINTS)).astype(np.int64))


def signals(
    frames: Frames,
    layout: Layout,
    rows: Sequence[tuple[int, int]] = (),
    channels: Sequence[int] = (),
    *,
    first_row: int = 0,
    title: str = "",
    scale: NDArray[np.float64] | None = None,
) -> Figure:
    """Draw channels of a recording (default: all) by row, and mark ``rows``.

    Channels of several kinds are drawn as differences from their rest level, each divided by its ``scale``.
    """
    figure, axes = _small(title)
    drawn = list(channels) or list(range(layout.n_channels))
    kinds = {layout.channels[c].unit for c in drawn} | {layout.channels[c].kind for c in drawn}
    at = _thinned(len(frames))
    mixed = scale is not None and len(kinds) > 2
    values: NDArray[Any] = np.clip(frames.values, layout.valid_min_int, layout.valid_max_int)
    values = (
        from_rest(frames, layout, scale) if mixed and scale is not None else values * [c.step for c in layout.channels]
    )
    for i, c in enumerate(drawn[:_CHANNELS]):
        style, colour = ("-", "--", ":")[i // len(COLOURS)], COLOURS[(i + 1) % len(COLOURS)]
        axes.plot(at + first_row + 1, values[at, c], style, color=colour, linewidth=0.9, label=layout.names[c])
    _mark(axes, rows)
    axes.set_ylabel("from rest (1 = usual)" if mixed else layout.channels[drawn[0]].unit, fontsize=8)
    axes.legend(
        fontsize=6.5, ncols=1 if len(drawn) < 7 else 2, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5)
    )
    return figure


def clock(frames: Frames, rows: Sequence[tuple[int, int]] = (), *, first_row: int = 0, title: str = "") -> Figure:
    """Draw the differences of the device clock between successive rows, and mark ``rows``."""
    figure, axes = _small(title)
    steps = np.diff(frames.device_ms)
    # Always draw the 200 most deviating steps, whatever else is left out.
    far = np.argsort(np.abs(steps - np.median(steps)))[-200:] if len(steps) else np.empty(0, dtype=np.int64)
    at = np.unique(np.concatenate([_thinned(len(steps)), far])) if len(steps) else far
    axes.plot(at + first_row + 2, steps[at], color=COLOURS[1], linewidth=0.8)
    _mark(axes, rows)
    if len(steps) and (steps.max() > 2000 or steps.min() < -2000):
        axes.set_yscale("symlog", linthresh=100)
        far_power = int(np.log10(np.abs(steps).max()))
        powers = range(2, far_power + 1, 1 + far_power // 5)
        axes.set_yticks([-(10.0**p) for p in powers if steps.min() < -100] + [0.0] + [10.0**p for p in powers])
        axes.minorticks_off()
    axes.set_ylabel("ms since previous row", fontsize=8)
    return figure


def baselines(lows: NDArray[np.float64], layout: Layout, channels: Sequence[int], *, title: str = "") -> Figure:
    """Draw the baselines of channels over a session; ``lows`` has one value for every 10 s."""
    figure, axes = _small(title, "minutes of the session")
    minutes = np.arange(len(lows)) / 6
    for i, c in enumerate(channels[: len(COLOURS)]):
        axes.plot(minutes, lows[:, c], color=COLOURS[i], linewidth=1.2, label=layout.names[c])
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    axes.set_ylabel(f"low level ({layout.channels[channels[0]].unit})", fontsize=8)
    return figure


def _mark(axes: Any, rows: Sequence[tuple[int, int]]) -> None:
    for first, last in rows:
        axes.axvspan(first + 1, max(last, first + 1), color=MARK, alpha=0.25, linewidth=0)
        axes.axvline(first + 1, color=MARK, linewidth=0.8)


def _small(title: str, x_label: str = "row") -> tuple[Figure, Any]:
    """Return a small figure and its axes."""
    figure = new_figure(7.4, 2.2)
    axes = figure.add_subplot()
    axes.set_xlabel(x_label, fontsize=8)
    axes.tick_params(labelsize=7.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
    if title:
        axes.set_title(textwrap.fill(title, 105), fontsize=8, loc="left", parse_math=False)
    return figure, axes


PER_PAGE = 12
_COLUMNS = 3
_MARK, _SUGGESTION = "#d55e00", "#000000"


def trim_page(dataset: Dataset, trims: Sequence[Trim], offset: bool = True) -> Figure:
    """Draw one page of recordings: all channels against the device clock, with suggested and marked trims.

    Suggested edges are dotted, marked edges solid, and trimmed parts shaded. Channels of one kind share a strip of the
    plot, each drawn as the difference from its median, relative to the largest difference of the kind.

    Args:
        trims: at most `PER_PAGE` results of `plushsense.dataset.trimming.suggest_trims`.
        offset: whether to draw the suggested end.
    """
    rows = max(1, -(-len(trims) // _COLUMNS))
    figure = new_figure(5.2 * _COLUMNS, 2.5 * rows + 0.6)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    channels = dataset.layout.channels
    kinds = list(dict.fromkeys(c.kind for c in channels))
    colours = need("matplotlib", "reports").colormaps["tab10" if len(channels) <= 10 else "tab20"]
    for axes, trim in zip(grid.flat, trims, strict=False):
        info, s = trim.recording, trim.suggestion
        frames = dataset.read(replace(info, start=0, stop=info.rows))
        values = _off_median(frames.values, dataset.layout)
        at = trim.seconds[: len(frames)]
        for lane, kind in enumerate(kinds):
            same_kind = [i for i, c in enumerate(channels) if c.kind == kind]
            largest = max(1.0, float(np.nanmax(np.abs(values[:, same_kind]))))
            for i in same_kind:
                y = values[:, i] / largest - 2.1 * lane
                axes.plot(at, y, linewidth=0.8, color=colours(i), label=channels[i].name)
        edges = [(s.start, s.onset_visible), (s.stop, s.offset_visible and offset)]
        for edge in (row for row, visible in edges if visible):
            axes.axvline(trim.seconds[edge], color=_SUGGESTION, linestyle=":", linewidth=1.6)
        if trim.mark_state.trimmed:
            start, stop = trim.current_rows()
            for edge, whole, cut in ((start, 0, (0, start)), (stop, info.rows, (stop, info.rows))):
                if edge != whole:
                    axes.axvline(trim.seconds[edge], color=_MARK, linewidth=1.8)
                    axes.axvspan(trim.seconds[cut[0]], trim.seconds[cut[1]], color=_MARK, alpha=0.12, linewidth=0)
        state = f"{trim.state}, confidence {s.onset_confidence:.2f}" + (f"; {s.why}" if s.why else "")
        axes.set_title(f"{info.id}\n{state}", fontsize=7.5, parse_math=False)
        axes.set_xlim(0.0, float(trim.seconds[-1]) or 1.0)
        axes.set_ylim(-1.08 - 2.1 * (len(kinds) - 1), 1.08)
        axes.set_yticks([-2.1 * lane for lane in range(len(kinds))], kinds, rotation=90, va="center")
        axes.tick_params(labelsize=7)
    for axes in grid.flat[len(trims) :]:
        axes.set_axis_off()
    for axes in grid[-1, : len(trims) - (rows - 1) * _COLUMNS]:
        axes.set_xlabel("Seconds since the first row", fontsize=8)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    line = need("matplotlib.lines", "reports").Line2D
    handles += [line([], [], color=_SUGGESTION, linestyle=":"), line([], [], color=_MARK)]
    figure.legend(
        handles, [*labels, "suggested", "marked"], loc="outside upper center", ncols=min(10, len(handles)), fontsize=8
    )
    return figure


def _off_median(raw: NDArray[np.int64], layout: Layout) -> NDArray[np.float64]:
    """Return the differences (T, C) from each channel's median; invalid values are NaN."""
    valid = (raw >= layout.valid_min_int) & (raw <= layout.valid_max_int)
    values = np.where(valid | ~valid.any(axis=0), raw, np.nan)
    return np.asarray(values - np.nanmedian(values, axis=0))


def check_picture_path(out: Path) -> None:
    """Check that `save_trims` can write to ``out``, before anything is marked.

    Raises:
        ConfigError: for a file that is not a .png, or a folder that cannot be created.
        MissingExtraError: when matplotlib is not installed.
    """
    need("matplotlib", "reports")
    single = out.suffix.lower() == ".png"
    if out.is_dir() if single else out.is_file():
        raise ConfigError(f"'{out}' is a {'folder' if single else 'file'}: give a new .png for one page, or a folder.")
    try:
        (out.parent if single else out).mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise ConfigError(f"'{out}' cannot be written ({cause.strerror or cause}): give another path.") from None


def save_trims(dataset: Dataset, trims: Sequence[Trim], out: Path, offset: bool = True) -> list[Path]:
    """Draw recordings, the first page into a .png file or all pages into a folder; existing pictures are replaced."""
    single = out.suffix.lower() == ".png"
    pages = [trims[at : at + PER_PAGE] for at in range(0, len(trims), PER_PAGE)][: 1 if single else None]
    (out.parent if single else out).mkdir(parents=True, exist_ok=True)
    written = []
    for number, page in enumerate(pages, 1):
        written.append(out if single else out / f"trim-{number:03d}.png")
        written[-1].write_bytes(png(trim_page(dataset, page, offset), dpi=110))
    return written
