"""Propose settings that fit the recordings: layout by the header of the files; rate, gap, zeros and window by data."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError
from plushsense.core.layouts import ACCELERATION, DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.recorder_csv import read_recording
from plushsense.dataset.quality.measurements import zeroing_limit
from plushsense.dataset.store import Dataset

DEFAULT_WINDOW_S = 2.5
# A rate is proposed if the measured one differs by this factor, a zero if it is this share of the radius away.
_RATE_FACTOR = 1.25
_ZERO_SHARE = 0.15
# Zeros are fitted to the stillest blocks of some recordings, if their standard error is small.
_RECORDINGS = 400
_BLOCK_S = 0.3
_STILLEST = 0.2
_LEAST_BLOCKS = 12
_STANDARD_ERROR = 0.05

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Proposal:
    """A setting that fits the recordings better: the ``key`` of a layout or of window settings, and the reason."""

    key: str
    value: Any
    reason: str

    def advice(self, adopted: bool) -> str:
        """Say what to do, or what was done if the layout ``adopted`` the proposal."""
        many = isinstance(self.value, dict)
        value = ", ".join(f"{k} {v:g}" for k, v in self.value.items()) if many else format(self.value, "g")
        if self.key == "window_s":
            return f"try  [windows] window_s = {value}  in a --config file"
        setting = f"{self.key}: {value}" if many else f"{self.key} = {value}"
        return f"adopted {setting}" if adopted else f"import with --adopt, or give a layout with {setting}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON."""
        return asdict(self)


def matching_layouts(files: Iterable[Path]) -> list[Layout]:
    """Return the built-in layouts with most channels, all of which the header of the first fitting CSV file names."""
    layouts = [load_layout(name) for name in layout_names()]
    for path in files:
        if path.suffix.lower() == ".csv":
            with path.open(encoding="utf-8-sig", errors="replace") as file:
                texts = {text.strip().strip('"').casefold() for text in re.split("[,;\t]", file.readline(4096))}
            found = [
                layout
                for layout in layouts
                for of in (dict(zip(layout.csv.columns, layout.csv.header, strict=True)),)
                if all({name.casefold(), of.get(name, name).casefold()} & texts for name in layout.names)
            ]
            # A layout of an accelerometer also fits files that have more channels.
            if found:
                most = max(layout.n_channels for layout in found)
                return [layout for layout in found if layout.n_channels == most]
    return []


_SAMPLED_FILES, _SAMPLED_BYTES = 3, 200_000


def readable_layouts(files: Iterable[Path], names: Sequence[str] = ()) -> list[Layout]:
    """Return the built-in layouts (or those in ``names``) that read the first CSV files, the most probable first.

    Layouts that differ only in the firmware's clock read the same files; the files tell a clock from delays.
    """
    samples: list[tuple[Path, bytes]] = []
    for path in files:
        if path.suffix.lower() == ".csv" and len(samples) < _SAMPLED_FILES:
            with path.open("rb") as file:
                data = file.read(_SAMPLED_BYTES)
            samples.append((path, data if len(data) < _SAMPLED_BYTES else data[: data.rfind(b"\n") + 1]))
    ranked: list[tuple[int, int, str]] = []
    for name in names or layout_names():
        layout, read, delays = load_layout(name), 0, 0
        for path, data in samples:
            with contextlib.suppress(FileFormatError):
                delays += read_recording(path, layout, data).integrated
                read += 1
        if read:
            ranked.append((-read, (DEVICE_MS not in layout.wire) != (delays > 0), name))
    return [load_layout(name) for _, _, name in sorted(ranked)]


def propose_settings(dataset: Dataset) -> list[Proposal]:
    """Measure the recordings, and return what fits them better than the layout and the default window."""
    return [*_rate_and_gap(dataset), *_zeros(dataset), *_window(dataset)]


def adopt(layout: Layout, proposals: Sequence[Proposal]) -> Layout:
    """Return the layout with the proposed rate, gap and offsets."""
    values = {p.key: p.value for p in proposals}
    offsets: dict[str, float] = values.get("offset", {})
    channels = tuple(replace(c, offset=offsets.get(c.name, c.offset)) for c in layout.channels)
    same = {key: values[key] for key in ("rate_hz", "gap_ms") if key in values}
    return replace(layout, channels=channels, **same)


def _rate_and_gap(dataset: Dataset) -> Iterator[Proposal]:
    layout = dataset.layout
    rates = [r.rate_hz for r in dataset.used if r.rate_hz > 0]
    if not rates:
        return
    rate = float(np.median(rates))
    if not 1 / _RATE_FACTOR < rate / layout.rate_hz < _RATE_FACTOR:
        yield Proposal(
            "rate_hz",
            float(max(1.0, round(rate))),
            f"the recordings have about {rate:.3g} frames a second (median), the layout says {layout.rate_hz:g}",
        )
    period_ms = 1000 / rate
    if layout.gap_ms < 2 * period_ms:
        yield Proposal(
            "gap_ms",
            round(4 * period_ms),
            f"frames are about {period_ms:.0f} ms apart, and the layout takes more than {layout.gap_ms} ms for a gap",
        )


def _zeros(dataset: Dataset) -> Iterator[Proposal]:
    """Propose offsets for the axes of an acceleration: the centre of the sphere on which it lies when held still."""
    layout = dataset.layout
    kinds = {c.name: c.kind for c in layout.channels}
    for vector in layout.vectors:
        if kinds[vector[0]] != ACCELERATION:
            continue
        axes = [layout.index(name) for name in vector]
        still = _still_means(dataset, axes)
        fitted = None if still is None else _sphere(still)
        if fitted is None:
            continue
        centre, radius = fitted
        if np.linalg.norm(centre - layout.zero_int[axes]) > _ZERO_SHARE * radius:
            steps = [layout.channels[axis].step for axis in axes]
            offset = {n: float(f"{c * step:.4g}") for n, c, step in zip(vector, centre, steps, strict=True)}
            text = ", ".join(f"{name} {value:g}" for name, value in offset.items())
            given = ", ".join(f"{layout.channels[axis].offset:g}" for axis in axes)
            unit = layout.channels[axes[0]].unit
            yield Proposal(
                "offset",
                offset,
                f"held still, the acceleration is about {radius * steps[0]:.3g} {unit} away from {text}, which stands "
                f"for zero; the layout says {given}",
            )


def _still_means(dataset: Dataset, axes: list[int]) -> Floats | None:
    """Return the means (n, 3) of the stillest blocks of 0.3 s, in steps of the layout; None for too few."""
    layout, blocks = dataset.layout, []
    replaced = zeroing_limit(layout) is not None
    used = dataset.used
    for recording in used[:: max(1, len(used) // _RECORDINGS)]:
        values = np.clip(dataset.read(recording).values, layout.valid_min_int, layout.valid_max_int)[:, axes]
        rows = max(3, round(_BLOCK_S * (recording.rate_hz or layout.rate_hz)))
        if n := len(values) // rows:
            cut = values[: n * rows].reshape(n, rows, 3).astype(np.float64)
            if replaced:
                # An axis that stays at 0 probably had values that the authors' recorder replaced.
                cut = cut[(cut != 0).any(axis=1).all(axis=1)]
            blocks.append(np.concatenate([cut.mean(axis=1), cut.std(axis=1).max(axis=1)[:, None]], axis=1))
    if not blocks:
        return None
    found = np.concatenate(blocks)
    still = found[found[:, 3] <= np.quantile(found[:, 3], _STILLEST), :3]
    return still if len(still) >= _LEAST_BLOCKS else None


def _sphere(points: Floats) -> tuple[Floats, float] | None:
    """Fit a sphere to points (n, 3) by least squares without outliers; None if they do not determine its centre."""
    keep = np.ones(len(points), dtype=np.bool_)
    centre, radius, error = np.zeros(3), 0.0, np.zeros(len(points))
    for _ in range(10):
        mine = points[keep]
        if len(mine) < _LEAST_BLOCKS:
            return None
        terms = np.concatenate([2 * mine, np.ones((len(mine), 1))], axis=1)
        solution = np.linalg.lstsq(terms, np.square(mine).sum(axis=1), rcond=None)[0]
        centre = solution[:3]
        radius = float(np.sqrt(max(solution[3] + centre @ centre, 0.0)))
        error = np.abs(np.linalg.norm(points - centre, axis=1) - radius)
        # Half a step is the error of a sensor with coarse steps.
        closer = error <= 3 * 1.4826 * np.median(error[keep]) + 0.5
        if np.array_equal(closer, keep):
            break
        keep = closer
    spread = np.linalg.svd(points[keep] - points[keep].mean(axis=0), compute_uv=False)
    # Neighbouring blocks are not independent: count them as if there were a tenth.
    uncertain = float(np.std(error[keep])) * np.sqrt(10)
    if radius <= 0 or spread[-1] <= 0 or uncertain / spread[-1] > _STANDARD_ERROR:
        return None
    return centre, radius


def _window(dataset: Dataset) -> Iterator[Proposal]:
    seconds = median_gesture_s(dataset)
    if seconds is not None and seconds < DEFAULT_WINDOW_S:
        yield Proposal(
            "window_s",
            max(0.5, round(seconds, 1)),
            f"half of the recordings last less than {seconds:.1f} s, so windows of {DEFAULT_WINDOW_S} s, the default, "
            "mostly begin before their gesture",
        )


def median_gesture_s(dataset: Dataset, gestures: Iterable[str] | None = None) -> float | None:
    """Return the median duration of the used recordings in seconds, of all or some gestures; None without any."""
    chosen = None if gestures is None else set(gestures)
    seconds = [
        (r.stop - r.start) / (r.rate_hz or dataset.layout.rate_hz)
        for r in dataset.used
        if chosen is None or r.gesture in chosen
    ]
    return float(np.median(seconds)) if seconds else None
