"""The files of the authors' recorder: one recording or one session stream as CSV, read and written.

Recordings are ``<label>_<epoch ms>_<rows>.csv`` with a header line; after the authors' trimming step the header is
gone and the separator is ``;``. A stream (``fulldatastream.csv``) has the same columns and no header.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError
from plushsense.core.rows import LIMIT, LONGEST_LINE, parse_table, separator_of
from plushsense.core.signal import DELAY_MS, DEVICE_MS, HOST_MS, Layout, layout_names, load_layout

STREAM_NAME = "fulldatastream.csv"
# Lies in a folder of simulated recordings, so that no score on them can pass for a result.
SIMULATION_MARK = "SIMULATION.txt"
_NAME = re.compile(r"^(?P<label>.+)_(?P<epoch>\d{1,18})_(?P<rows>\d{1,12})\.csv$", re.IGNORECASE)
# Layouts begin at 1 frame a second: delays over twice that are none.
_SLOWEST_MS = 2000
_PAUSE_MS = 60_000


@dataclass(frozen=True)
class Frames:
    """Rows of one recording or stream.

    ``values`` (T, C) int64, in integer steps, layout order; ``device_ms`` and ``host_ms`` (T,) int64 (``host_ms`` None
    where the file has no such column); ``labels`` (T,) where every row carries one.
    """

    values: NDArray[np.int64]
    device_ms: NDArray[np.int64]
    host_ms: NDArray[np.int64] | None = None
    labels: NDArray[np.str_] | None = None

    def __len__(self) -> int:
        return len(self.device_ms)

    def slice(self, start: int, stop: int) -> Frames:
        """Rows ``start`` to ``stop``, without a copy."""
        part = slice(start, stop)
        return Frames(
            self.values[part],
            self.device_ms[part],
            None if self.host_ms is None else self.host_ms[part],
            None if self.labels is None else self.labels[part],
        )


@dataclass(frozen=True)
class RecordingName:
    """What a recording's file name says."""

    label: str
    epoch_ms: int
    rows: int


@dataclass(frozen=True)
class ReadResult:
    """Frames read, with what was odd about the file; ``malformed`` lines were left out.

    ``integrated``: the file held delays, so ``device_ms`` is their sum and begins at 0 in every file.
    ``cut``: the last line had no end and was left out; it counts as malformed.
    """

    frames: Frames
    warnings: list[str] = field(default_factory=list)
    malformed: int = 0
    had_header: bool = False
    integrated: bool = False
    cut: bool = False


def parse_name(filename: str) -> RecordingName | None:
    """Label, time and rows from a recording's file name, split from the right; None when it is no such name."""
    match = _NAME.match(Path(filename).name)
    if match is None:
        return None
    return RecordingName(match["label"], int(match["epoch"]), int(match["rows"]))


def recording_filename(label: str, epoch_ms: int, rows: int) -> str:
    """The file name of a recording; characters that file systems refuse become ``_``, as in the GestureRecorder."""
    safe = re.sub(r'[\\/:*?"<>|()\x00-\x1f]', "_", label).strip(" .") or "_"
    return f"{safe}_{epoch_ms}_{rows}.csv"


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _suggest_layout(columns: int, layout: Layout) -> str:
    fitting = [n for n in layout_names() if n != layout.name and len(load_layout(n).csv.columns) == columns]
    return f" Layouts with {columns} columns: {', '.join(fitting)}." if fitting else ""


def column_keys(first: bytes, layout: Layout, path: Path) -> tuple[list[str], bool]:
    """Column keys in file order, and whether the first line is a header."""
    separator = separator_of(first)
    cells = [c.strip() for c in (first.split(separator.encode()) if separator else first.split())]
    columns = list(layout.csv.columns)
    # A last field that is empty is a separator too many, or no label.
    while cells and not cells[-1] and not (columns[-1] == "label" and len(cells) == len(columns)):
        cells.pop()
    header = bool(cells) and not any(_is_number(c) for c in cells)
    if header:
        texts = [c.decode("utf-8", "replace").strip().casefold() for c in cells]
        known = {h.casefold(): k for h, k in zip(layout.csv.header, columns, strict=True)}
        known |= {k.casefold(): k for k in columns}
        known.setdefault("arduino delay (ms)", DELAY_MS)
        if all(t in known for t in texts) and len(texts) >= layout.n_channels + 1:
            return [known[t] for t in texts], True
    if len(cells) == len(columns):
        return columns, header
    if len(cells) == len(columns) - 1 and columns[-1] == "label":
        return columns[:-1], header
    raise FileFormatError(
        f"'{path.name}' has {len(cells)} columns, but a file of layout '{layout.name}' has {len(columns)} "
        f"({', '.join(columns)}): choose another --layout.{_suggest_layout(len(cells), layout)}"
    )


def _looks_like_delay(column: NDArray[np.int64], host_ms: NDArray[np.int64] | None) -> bool:
    """Whether the clock column really holds delays, as recordings of the 14-integer firmware do.

    Delays are small, fall as often as they rise (a clock falls only where it was reset, even one that starts at 0 and
    stamps its rows in pairs), and add up to the time that passed on the host; pauses apart, since a stream that was
    appended to on another day has one.
    """
    if len(column) < 3 or column.min() < 0 or np.median(column) > _SLOWEST_MS:
        return False
    steps = np.diff(column)
    if np.mean(steps <= 0) < 0.3 or np.sum(steps < 0) < 0.3 * np.sum(steps > 0):
        return False
    if host_ms is None:
        return True
    passed = np.diff(host_ms)
    together = (passed <= _PAUSE_MS) & (column[1:] <= _PAUSE_MS)
    on_host = float(passed[together].sum())
    return abs(float(column[1:][together].sum()) - on_host) <= max(200.0, 0.5 * on_host)


def read_bytes(path: Path) -> bytes:
    """What a file holds.

    Raises:
        FileFormatError: when the system refuses.
    """
    try:
        return path.read_bytes()
    except OSError as cause:
        raise FileFormatError(f"'{path}' cannot be read: {cause.strerror or cause}.") from None


def _read(path: Path, layout: Layout, data: bytes | None, *, whole_lines: bool = False) -> ReadResult:
    if data is None:
        data = read_bytes(path)
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\x00" in data[:4096]:
        raise FileFormatError(f"'{path.name}' is not a text file: a recording is CSV in UTF-8.")
    data = data.lstrip()
    cut = whole_lines and b"\n" in data and not data.endswith(b"\n")
    if cut:
        data = data[: data.rfind(b"\n") + 1]
    if not data:
        raise FileFormatError(f"'{path.name}' is empty: a recording has one row a sample.")
    end = data.find(b"\n")
    first = data if end < 0 else data[:end]
    if len(first) > LONGEST_LINE:
        raise FileFormatError(f"'{path.name}' begins with a line of {len(first)} characters: that is no recording.")
    keys, header = column_keys(first, layout, path)
    if header and (end < 0 or not data[end:].strip()):
        raise FileFormatError(f"'{path.name}' holds a header and no row.")
    table, labels, malformed = parse_table(data, keys, 1 if header else 0, path)
    numeric = [k for k in keys if k != "label"]
    warnings: list[str] = ["the last line is cut off: left out"] if cut else []
    if malformed:
        warnings.append(f"{malformed} malformed line{'s' if malformed > 1 else ''} left out")

    def as_whole(numbers: NDArray[Any]) -> NDArray[np.int64]:
        # What no integer holds is outside every valid range all the same.
        if numbers.dtype != np.int64:
            numbers = np.clip(np.round(numbers), -LIMIT, LIMIT)
        return np.ascontiguousarray(numbers, dtype=np.int64)

    def column(name: str) -> NDArray[np.int64] | None:
        return as_whole(table[:, numeric.index(name)]) if name in numeric else None

    steps = np.array([c.step for c in layout.channels])
    missing = [n for n in layout.names if n not in numeric]
    if missing:
        raise FileFormatError(f"'{path.name}' has no column for {', '.join(missing)} of layout '{layout.name}'.")
    values = table[:, [numeric.index(n) for n in layout.names]]
    host = column(HOST_MS)
    clock = column(DEVICE_MS)
    delay = column(DELAY_MS)
    if clock is not None and (delay is None) and _looks_like_delay(clock, host):
        delay, clock = clock, None
        warnings.append("the clock column holds delays (14-integer firmware): integrated")
    integrated = clock is None and delay is not None
    if clock is None:
        if delay is not None:
            clock = np.cumsum(delay) - delay[0]
        elif host is not None:
            clock = host
            warnings.append("no device clock: the host's time is used")
        else:
            raise FileFormatError(f"'{path.name}' has no clock column: {DEVICE_MS}, {DELAY_MS} or {HOST_MS}.")
    frames = Frames(as_whole(values if np.all(steps == 1.0) else values / steps), clock, host, labels)
    return ReadResult(frames, warnings, malformed + cut, header, integrated, cut)


def read_recording(path: str | os.PathLike[str], layout: Layout, data: bytes | None = None) -> ReadResult:
    """Read one recording: ``,`` or ``;``, with or without header, any line ends.

    ``data`` is what the file holds, where it was read before.

    Malformed lines are left out and counted. The clock column of the 14-integer firmware holds delays; that is
    detected and integrated.

    Raises:
        FileFormatError: for a file that is empty, not text, or of another width than the layout's.
    """
    return _read(Path(path), layout, data)


def read_stream(path: str | os.PathLike[str], layout: Layout, data: bytes | None = None) -> ReadResult:
    """Read a session's stream: as `read_recording`, but a last line without its end was cut off and is left out.

    A cut line can still have the right number of fields, with a digit of the last one missing.
    """
    return _read(Path(path), layout, data, whole_lines=True)


def _columns(frames: Frames, layout: Layout) -> Iterator[list[str]]:
    host = frames.device_ms if frames.host_ms is None else frames.host_ms
    for key in layout.csv.columns:
        if key == HOST_MS:
            yield [str(v) for v in host.tolist()]
        elif key == DEVICE_MS:
            yield [str(v) for v in frames.device_ms.tolist()]
        elif key == DELAY_MS:
            yield [str(v) for v in np.diff(frames.device_ms, prepend=frames.device_ms[:1]).tolist()]
        elif key == "label":
            yield [""] * len(frames) if frames.labels is None else [str(v) for v in frames.labels]
        else:
            at = layout.index(key)
            step = layout.channels[at].step
            column = frames.values[:, at]
            if step == 1.0:
                yield [str(v) for v in column.tolist()]
            else:
                digits = max(0, -int(np.floor(np.log10(step))))
                yield [f"{v * step:.{digits}f}" for v in column.tolist()]


def format_rows(frames: Frames, layout: Layout) -> str:
    """Rows as the recorder writes them, without header, each ended by a newline."""
    join = layout.csv.separator.join
    return "".join(join(cells) + "\n" for cells in zip(*_columns(frames, layout), strict=True))


def format_header(layout: Layout) -> str:
    """The recorder's header line."""
    return layout.csv.separator.join(layout.csv.header) + "\n"


def write_recording(path: str | os.PathLike[str], frames: Frames, layout: Layout) -> None:
    """Write one recording with its header; the file appears whole or not at all, and never replaces another.

    Raises:
        FileFormatError: when a file of that name is already there.
    """
    target = Path(path)
    if target.exists():
        raise FileFormatError(f"'{target}' is already there: a recording is never overwritten.")
    part = target.with_name(target.name + ".part")
    part.write_text(format_header(layout) + format_rows(frames, layout), encoding="utf-8", newline="\n")
    os.replace(part, target)
