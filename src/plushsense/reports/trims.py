"""Pictures of recordings with what is suggested (dotted) and what is marked (solid)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError
from plushsense.core.extras import need
from plushsense.core.signal import Layout
from plushsense.dataset.store import Dataset
from plushsense.dataset.trim import Trim
from plushsense.reports.figures import png

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PER_PAGE = 12
_COLUMNS = 3
_MARK, _SUGGESTION = "#d55e00", "#000000"


def trim_page(dataset: Dataset, trims: Sequence[Trim], offset: bool = True) -> Figure:
    """One page of recordings: every channel over the device clock, a dotted line where an edge is suggested, a solid
    one where a mark stands; what a mark cuts off is shaded.

    Channels of one kind share a lane and a scale: each is drawn off its median, in shares of the kind's largest swing.

    Args:
        trims: at most `PER_PAGE` of `plushsense.dataset.trim.trims`.
        offset: whether to draw the suggested end.
    """
    rows = max(1, -(-len(trims) // _COLUMNS))
    figure: Figure = need("matplotlib.figure", "reports").Figure(
        figsize=(5.2 * _COLUMNS, 2.5 * rows + 0.6), layout="constrained"
    )
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
            mine = [i for i, c in enumerate(channels) if c.kind == kind]
            swing = max(1.0, float(np.nanmax(np.abs(values[:, mine]))))
            for i in mine:
                axes.plot(
                    at, values[:, i] / swing - 2.1 * lane, linewidth=0.8, color=colours(i), label=channels[i].name
                )
        edges = [(s.start, s.onset_visible), (s.stop, s.offset_visible and offset)]
        for edge in (row for row, visible in edges if visible):
            axes.axvline(trim.seconds[edge], color=_SUGGESTION, linestyle=":", linewidth=1.6)
        if trim.standing.trimmed:
            start, stop = trim.shown()
            for edge, whole, cut in ((start, 0, (0, start)), (stop, info.rows, (stop, info.rows))):
                if edge != whole:
                    axes.axvline(trim.seconds[edge], color=_MARK, linewidth=1.8)
                    axes.axvspan(trim.seconds[cut[0]], trim.seconds[cut[1]], color=_MARK, alpha=0.12, linewidth=0)
        said = f"{trim.state}, confidence {s.onset_confidence:.2f}" + (f"; {s.why}" if s.why else "")
        axes.set_title(f"{info.id}\n{said}", fontsize=7.5, parse_math=False)
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
    """Values (T, C) less their channel's median; garbage, which would squeeze all else, is a hole in the line."""
    valid = (raw >= layout.valid_min_int) & (raw <= layout.valid_max_int)
    values = np.where(valid | ~valid.any(axis=0), raw, np.nan)
    return np.asarray(values - np.nanmedian(values, axis=0))


def check_place(out: Path) -> None:
    """Refuse a place that `save_trims` could not write to, before anything is marked.

    Raises:
        ConfigError: for a file that is no .png, or a folder that cannot be made.
        MissingExtraError: when matplotlib is not installed.
    """
    need("matplotlib", "reports")
    single = out.suffix.lower() == ".png"
    if out.is_dir() if single else out.is_file():
        raise ConfigError(f"'{out}' is a {'folder' if single else 'file'}: name a new .png for one page, or a folder.")
    try:
        (out.parent if single else out).mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise ConfigError(f"'{out}' cannot be drawn to ({cause.strerror or cause}): name another place.") from None


def save_trims(dataset: Dataset, trims: Sequence[Trim], out: Path, offset: bool = True) -> list[Path]:
    """Draw recordings into ``out``: a file that ends in .png holds the first page, a folder all pages.

    Pictures of that name are replaced.
    """
    single = out.suffix.lower() == ".png"
    pages = [trims[at : at + PER_PAGE] for at in range(0, len(trims), PER_PAGE)][: 1 if single else None]
    (out.parent if single else out).mkdir(parents=True, exist_ok=True)
    written = []
    for number, page in enumerate(pages, 1):
        written.append(out if single else out / f"trim-{number:03d}.png")
        written[-1].write_bytes(png(trim_page(dataset, page, offset), dpi=110))
    return written
