"""Read and write the CSV files of the authors' recorder: single recordings and session streams.

Recordings are named ``<label>_<epoch ms>_<rows>.csv`` and have a header line; the authors' trimming step removes the
header and changes the separator to ``;``. A stream (``fulldatastream.csv``) has the same columns and no header.
"""

from __future__ import annotations

import builtins
import io
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError
from plushsense.core.files import write_file
from plushsense.core.layouts import DELAY_MS, DEVICE_MS, HOST_MS, Layout, layout_names, load_layout

LIMIT = 2.0**53
LONGEST_LINE = 1_000_000
LONGEST_LABEL = 200
_FULL_LINE = re.compile(rb"\S[^\n]*")
_BLOCK = 1000


def separator_of(line: bytes) -> str | None:
    """Return the separator of a line, ``;`` or ``,``; None means white space."""
    return ";" if b";" in line else "," if b"," in line else None


def _cells(line: bytes, separator: str | None, width: int) -> list[bytes]:
    """Split a line into fields, ignoring extra separators at its end; return [] for a line that is too long."""
    if len(line) > LONGEST_LINE:
        return []
    if separator is None:
        return line.split()
    cells = [c.strip() for c in line.split(separator.encode())]
    while len(cells) > width and not cells[-1]:
        cells.pop()
    return cells


def _parse_slowly(
    lines: list[bytes], separator: str | None, width: int, label_at: int | None
) -> tuple[list[list[float]], list[str], int]:
    """Parse lines one by one, after NumPy has failed; return rows, labels and the number of malformed lines."""
    rows, labels, malformed = [], [], 0
    for line in lines:
        if not line.strip():
            continue
        cells = _cells(line, separator, width)
        try:
            if len(cells) != width:
                raise ValueError
            text = cells.pop(label_at).decode("utf-8", "replace") if label_at is not None else ""
            # float() would accept 1_000.
            row = [float(c) if b"_" not in c else np.nan for c in cells]
            if not all(abs(v) < LIMIT for v in row) or len(text) > LONGEST_LABEL:
                raise ValueError
        except ValueError:
            malformed += 1
            continue
        rows.append(row)
        labels.append(text)
    return rows, labels, malformed


def _parse_fast(data: bytes, separator: str | None, skip: int, width: int) -> NDArray[Any] | None:
    """Parse numbers (T, width) as int64 or float64; return None if any line is malformed."""
    begin = data.find(b"\n") + 1 if skip else 0
    # Integers are parsed faster, but some versions of NumPy truncate fractions silently.
    whole = not any(data.find(sign, begin) >= 0 for sign in (b".", b"e", b"E"))
    for dtype in (np.int64, np.float64) if whole else (np.float64,):
        try:
            table = np.loadtxt(
                io.BytesIO(data), dtype=dtype, delimiter=separator, skiprows=skip, ndmin=2, comments=None
            )
        except ValueError:
            continue
        # Two comparisons refuse NaN too; abs() would overflow for the smallest int64.
        fits = table.shape[1] == width and bool(np.all((table > -LIMIT) & (table < LIMIT)))
        return table if fits else None
    return None


def _parse_in_blocks(lines: list[bytes], separator: str | None, width: int) -> tuple[list[NDArray[Any]], int]:
    """Parse lines in blocks, so that a malformed line slows down only its block; return blocks and malformed lines."""
    blocks, malformed = [], 0
    for at in range(0, len(lines), _BLOCK):
        block = lines[at : at + _BLOCK]
        if not any(line.strip() for line in block):
            continue
        table = _parse_fast(b"\n".join(block), separator, 0, width)
        if table is None:
            rows, _, bad = _parse_slowly(block, separator, width, None)
            malformed += bad
            table = np.array(rows).reshape(-1, width)
        blocks.append(table)
    return blocks, malformed


def parse_table(
    data: bytes, keys: list[str], skip: int, path: Path
) -> tuple[NDArray[Any], NDArray[np.str_] | None, int]:
    """Parse rows with the columns ``keys``; return numbers (T, columns), labels or None, and malformed lines."""
    label_at = keys.index("label") if "label" in keys else None
    row = _FULL_LINE.search(data, data.find(b"\n") + 1 if skip else 0)
    separator = separator_of(row[0]) if row else None
    malformed = 0
    if label_at is None:
        table = _parse_fast(data, separator, skip, len(keys))
        if table is not None:
            return table, None, 0
        blocks, malformed = _parse_in_blocks(data.split(b"\n")[skip:], separator, len(keys))
        table = np.concatenate(blocks) if blocks else np.empty((0, len(keys)))
        if len(table):
            return table, None, malformed
    else:
        lines = data.split(b"\n")[skip:]
        if label_at == len(keys) - 1 and separator:
            parts = [line.rsplit(separator.encode(), 1) for line in lines if line.strip()]
            try:
                texts = [p[1].strip().decode() for p in parts]
                table = _parse_fast(b"\n".join(p[0] for p in parts), separator, 0, len(keys) - 1)
                if table is not None and len(table) == len(texts) and max(map(len, texts)) <= LONGEST_LABEL:
                    return table, np.array(texts), 0
            except (ValueError, IndexError):
                pass
        rows, labels, malformed = _parse_slowly(lines, separator, len(keys), label_at)
        if rows:
            return np.array(rows), np.array(labels), malformed
    raise FileFormatError(
        "'{path}' has no usable row: each must hold {n} numbers ({keys}).",
        path=path.name,
        n=len(keys),
        keys=", ".join(keys),
    )


STREAM_NAME = "fulldatastream.csv"
# A file of this name marks a folder of simulated recordings, so that scores on them can be marked too.
SIMULATION_MARK = "SIMULATION.txt"
# The authors' anonymising step writes " (1)" and so on behind a name that exists already, as file managers do.
_NAME = re.compile(r"^(?P<label>.+)_(?P<epoch>\d{1,18})_(?P<rows>\d{1,12})(?: \(\d{1,4}\))?\.csv$", re.IGNORECASE)
# Layouts have at least 1 frame per second, so a larger median cannot be a delay.
_SLOWEST_MS = 2000
_PAUSE_MS = 60_000


@dataclass(frozen=True)
class Frames:
    """Rows of one recording or stream.

    Attributes:
        values: (T, C) values in integer steps, in layout order.
        device_ms, host_ms: (T,) clocks of toy and computer; ``host_ms`` is None if the file has no such column.
        labels: (T,) label of each row; None if the file has no such column.
    """

    values: NDArray[np.int64]
    device_ms: NDArray[np.int64]
    host_ms: NDArray[np.int64] | None = None
    labels: NDArray[np.str_] | None = None

    def __len__(self) -> int:
        return len(self.device_ms)

    def slice(self, start: int, stop: int) -> Frames:
        """Return rows ``start`` to ``stop`` (exclusive) as a view."""
        return self.take(slice(start, stop))

    def take(self, rows: NDArray[np.int64] | builtins.slice[int]) -> Frames:
        """Return the rows with the indices ``rows``."""
        host, labels = self.host_ms, self.labels
        return Frames(
            self.values[rows],
            self.device_ms[rows],
            None if host is None else host[rows],
            None if labels is None else labels[rows],
        )


class RecordingName(NamedTuple):
    """The parts of a recording's file name."""

    label: str
    epoch_ms: int
    rows: int


@dataclass(frozen=True)
class ReadResult:
    """Frames read from a file, with warnings.

    Attributes:
        malformed: number of lines that were left out.
        integrated: whether ``device_ms`` is a sum of delays, which starts at 0 in every file.
        cut: whether the last line had no line end and was left out; it counts as malformed.
    """

    frames: Frames
    warnings: list[str] = field(default_factory=list)
    malformed: int = 0
    integrated: bool = False
    cut: bool = False


def parse_name(filename: str) -> RecordingName | None:
    """Parse the file name of a recording, which may have a number behind it: ``… (1).csv``; return None for others."""
    match = _NAME.match(Path(filename).name)
    if match is None:
        return None
    return RecordingName(match["label"], int(match["epoch"]), int(match["rows"]))


def recording_filename(label: str, epoch_ms: int, rows: int) -> str:
    """Return the file name of a recording, with ``_`` in place of characters that file systems refuse."""
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
    """Return the column keys in file order, and whether the first line is a header."""
    separator = separator_of(first)
    cells = [c.strip() for c in (first.split(separator.encode()) if separator else first.split())]
    columns = list(layout.csv.columns)
    # An empty last field comes from an extra separator, unless it is an empty label.
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
        "'{path}' has {n} columns, but a file of layout '{layout}' has {expected} ({columns}): choose another "
        "--layout.{suggest_layout}",
        path=path.name,
        n=len(cells),
        layout=layout.name,
        expected=len(columns),
        columns=", ".join(columns),
        suggest_layout=_suggest_layout(len(cells), layout),
    )


def _looks_like_delay(column: NDArray[np.int64], host_ms: NDArray[np.int64] | None) -> bool:
    """Return whether the clock column contains delays between frames, as in recordings of the 14-integer firmware.

    Delays are small, decrease about as often as they increase (a clock decreases only at a reset), and add up to the
    time on the host. Pauses are not counted, since a stream may be continued on another day.
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
    """Read a file; raise FileFormatError if that fails."""
    try:
        return path.read_bytes()
    except OSError as cause:
        raise FileFormatError("'{path}' cannot be read: {why}.", path=path, why=cause.strerror or cause) from None


def _plain_text(path: Path, data: bytes) -> bytes:
    """Return the content of a file with plain line ends, without a byte order mark; refuse one that is not text."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if b"\x00" in data[:4096]:
        raise FileFormatError("'{path}' is not a text file: a recording is a CSV file in UTF-8.", path=path.name)
    return data.lstrip()


def _as_whole(numbers: NDArray[Any]) -> NDArray[np.int64]:
    # Clipped values are invalid in any case: LIMIT is outside every valid range.
    if numbers.dtype != np.int64:
        numbers = np.clip(np.round(numbers), -LIMIT, LIMIT)
    return np.ascontiguousarray(numbers, dtype=np.int64)


def _read(path: Path, layout: Layout, data: bytes | None, *, whole_lines: bool = False) -> ReadResult:
    data = _plain_text(path, read_bytes(path) if data is None else data)
    cut = whole_lines and b"\n" in data and not data.endswith(b"\n")
    if cut:
        data = data[: data.rfind(b"\n") + 1]
    if not data:
        raise FileFormatError("'{path}' is empty: a recording has one row a sample.", path=path.name)
    first, _, rest = data.partition(b"\n")
    if len(first) > LONGEST_LINE:
        raise FileFormatError(
            "'{path}' begins with a line of {n} characters: it is not a recording.", path=path.name, n=len(first)
        )
    keys, header = column_keys(first, layout, path)
    if header and not rest.strip():
        raise FileFormatError(
            "'{path}' has a header but no row: the authors' recorder writes such files if the toy sends fewer than "
            "14 integers a line.",
            path=path.name,
        )
    table, labels, malformed = parse_table(data, keys, 1 if header else 0, path)
    columns = dict(zip((k for k in keys if k != "label"), table.T, strict=True))
    if missing := [n for n in layout.names if n not in columns]:
        raise FileFormatError(
            "'{path}' has no column for {missing} of layout '{layout}'.",
            path=path.name,
            missing=", ".join(missing),
            layout=layout.name,
            column=missing[0],
        )
    warnings: list[str] = ["the last line is cut off: left out"] if cut else []
    if malformed:
        warnings.append(f"{malformed} malformed line{'s' if malformed > 1 else ''} left out")
    host, clock, delay = (_as_whole(columns[k]) if k in columns else None for k in (HOST_MS, DEVICE_MS, DELAY_MS))
    if clock is not None and delay is None and _looks_like_delay(clock, host):
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
            raise FileFormatError(
                "'{path}' has no clock column: {column}, {delay_ms} or {host_ms}.",
                path=path.name,
                column=DEVICE_MS,
                delay_ms=DELAY_MS,
                host_ms=HOST_MS,
            )
    values = table[:, [list(columns).index(n) for n in layout.names]]
    steps = np.array([c.step for c in layout.channels])
    frames = Frames(_as_whole(values if np.all(steps == 1.0) else values / steps), clock, host, labels)
    return ReadResult(frames, warnings, malformed + cut, integrated, cut)


def read_recording(path: str | os.PathLike[str], layout: Layout, data: bytes | None = None) -> ReadResult:
    """Read one recording, separated by ``,``, ``;`` or white space, with or without header, with any line ends.

    Malformed lines are left out and counted. Delays in the clock column (14-integer firmware) are detected and summed.

    Args:
        data: the content of the file, if it has already been read.

    Raises:
        FileFormatError: for a file that is empty, not text, or does not have the columns of the layout.
    """
    return _read(Path(path), layout, data)


def read_stream(path: str | os.PathLike[str], layout: Layout, data: bytes | None = None) -> ReadResult:
    """Read a session's stream like `read_recording`, but leave out a last line that has no line end.

    Such a line may have the right number of fields, but the last field may lack digits.
    """
    return _read(Path(path), layout, data, whole_lines=True)


def _columns(frames: Frames, layout: Layout) -> Iterator[list[str]]:
    delays = np.diff(frames.device_ms, prepend=frames.device_ms[:1])
    host = frames.device_ms if frames.host_ms is None else frames.host_ms
    clocks = {HOST_MS: host, DEVICE_MS: frames.device_ms, DELAY_MS: delays}
    for key in layout.csv.columns:
        if key in clocks:
            yield [str(v) for v in clocks[key].tolist()]
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
    """Format rows as the recorder writes them, without the header; each row ends with a newline."""
    join = layout.csv.separator.join
    return "".join(join(cells) + "\n" for cells in zip(*_columns(frames, layout), strict=True))


def format_header(layout: Layout) -> str:
    """Return the header line that the recorder writes."""
    return layout.csv.separator.join(layout.csv.header) + "\n"


def write_recording(path: str | os.PathLike[str], frames: Frames, layout: Layout) -> None:
    """Write one recording with its header, atomically; raise FileFormatError if the file exists."""
    target = Path(path)
    if target.exists():
        raise FileFormatError(f"'{target}' is already there: a recording is never overwritten.")
    write_file(target, format_header(layout) + format_rows(frames, layout))
