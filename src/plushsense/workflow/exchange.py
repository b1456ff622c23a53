"""Convert windows and data sets for other libraries: PyTorch, aeon, sktime, Hugging Face, and readers of XDF.

`import_recordings` reads the files that these functions write.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import tomli_w
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError, need
from plushsense.core.files import new_folder
from plushsense.core.layouts import DEVICE_MS, Layout
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.publishing.description import SIMULATION
from plushsense.dataset.store import Dataset
from plushsense.windows.cut import WindowSet

RECORDINGS_TABLE, STREAMS_TABLE, LAYOUT, CARD = "recordings.parquet", "streams.parquet", "layout.toml", "README.md"
# Samples in one chunk of an XDF file.
_CHUNK = 1000


def to_torch(windows: WindowSet) -> Any:
    """Return a ``torch.utils.data.TensorDataset`` of windows (N, C, T), float32 and `WindowSet.x`, and classes (N,)."""
    torch, data = need("torch", "train"), need("torch.utils.data", "train")
    return data.TensorDataset(torch.from_numpy(windows.x.astype(np.float32)), torch.from_numpy(windows.y))


def to_panel(windows: WindowSet) -> tuple[NDArray[np.float64], NDArray[np.str_]]:
    """Return windows (N, C, T), `WindowSet.x`, and labels (N,), as aeon and sktime (``numpy3D``) read them."""
    return windows.x.astype(np.float64), np.array(windows.labels)[windows.y]


@dataclass(frozen=True)
class _Part:
    """A stream, or a recording that lies in none: its frames, and label, first row and last row (exclusive) of each."""

    id: str
    subject: str
    session: str
    frames: Frames
    cuts: list[tuple[str, int, int]]

    @property
    def time_ms(self) -> NDArray[np.int64]:
        """Device clock (T,) since the first row."""
        return np.asarray(self.frames.device_ms - self.frames.device_ms[0])


def _streams(dataset: Dataset) -> Iterator[_Part]:
    labelled = dataset.layout.is_labelled
    for stream in dataset.streams:
        frames = dataset.read_stream(stream.id)
        mine = [(r, r.first_row if labelled else r.stream_row) for r in dataset.used if r.stream == stream.id]
        cuts = sorted((row + r.start, row + r.stop, r.gesture) for r, row in mine if row >= 0)
        if len(frames):
            # A recording may be longer than its stream, where that was cut off.
            places = [(gesture, first, min(last, len(frames))) for first, last, gesture in cuts if first < len(frames)]
            yield _Part(stream.id, stream.subject, stream.session, frames, places)


def _recordings(dataset: Dataset, located: bool) -> Iterator[_Part]:
    """Yield each used recording that has samples; with ``located`` also those in a stream."""
    for r in dataset.used:
        if located or not (dataset.layout.is_labelled or r.stream_row >= 0):
            frames = dataset.read(r)
            if len(frames):
                yield _Part(r.id, r.subject, r.session, frames, [(r.gesture, 0, len(frames))])


def to_hugging_face(dataset: Dataset, folder: str | os.PathLike[str]) -> list[Path]:
    """Write a folder that ``datasets.load_dataset`` opens; return its files.

    ``recordings.parquet`` has a row for each used recording: recording, subject, session, gesture, and lists: time_ms
    (from 0), and each channel as the toy sends it. If there are streams, ``streams.parquet`` has a row for each, with
    the gesture of every sample ("" between recordings). Either table can be imported with ``layout.toml``.

    The codes of the people are kept, and the time of each recording in its name: use `publish_dataset` for data that is
    given to others.

    Raises:
        DatasetError: if ``folder`` exists and is not empty; ForgottenError: like `Generation.check`.
    """
    polars = need("polars", "tables")
    with new_folder(Path(folder), DatasetError, finishing=dataset.generation.writing) as work:
        tables: dict[str, list[tuple[_Part, str | list[str]]]] = {
            RECORDINGS_TABLE: [(part, part.cuts[0][0]) for part in _recordings(dataset, located=True)],
            STREAMS_TABLE: [(part, _labels(part)) for part in _streams(dataset)],
        }
        tables = {name: rows for name, rows in tables.items() if rows}
        for name, rows in tables.items():
            columns: dict[str, list[Any]] = {
                "recording" if name == RECORDINGS_TABLE else "stream": [part.id for part, _ in rows],
                "subject": [part.subject for part, _ in rows],
                "session": [part.session for part, _ in rows],
                "gesture": [label for _, label in rows],
                "time_ms": [part.time_ms for part, _ in rows],
            }
            values = [_raw(part.frames, dataset.layout) for part, _ in rows]
            columns |= {channel: [v[:, i] for v in values] for i, channel in enumerate(dataset.layout.names)}
            polars.DataFrame(columns).write_parquet(work / name)
        (work / LAYOUT).write_text(tomli_w.dumps(json.loads(json.dumps(dataset.layout.to_dict()))), encoding="utf-8")
        (work / CARD).write_text(_card(dataset, list(tables)), encoding="utf-8")
        names = sorted(path.name for path in work.iterdir() if path.name in (*tables, LAYOUT, CARD))
    return [Path(folder) / name for name in names]


def _labels(part: _Part) -> list[str]:
    labels = [""] * len(part.frames)
    for label, first, last in part.cuts:
        labels[first:last] = [label] * (last - first)
    return labels


def _raw(frames: Frames, layout: Layout) -> NDArray[Any]:
    """Return the values (T, C) as the toy sends them; integers if all steps are 1."""
    steps = np.array([channel.step for channel in layout.channels])
    return frames.values if (steps == 1.0).all() else frames.values * steps


def _card(dataset: Dataset, tables: Sequence[str]) -> str:
    """Return the data set card, whose first lines tell ``datasets`` which tables there are."""
    head = [f"license: {json.dumps(dataset.head.licence.lower())}"] if dataset.head.licence else []
    for number, table in enumerate(tables):
        head += [] if number else ["configs:"]
        head += [f"- config_name: {Path(table).stem}", f"  data_files: {table}"] + (
            [] if number else ["  default: true"]
        )
    channels = [
        f"- `{c.name}`: {c.kind}, (value - {c.offset:g}) * {c.scale:g} {c.unit}" for c in dataset.layout.channels
    ]
    text = [
        f"# {dataset.head.name}",
        *([SIMULATION] if dataset.head.simulated else []),
        f"Layout `{dataset.layout.name}`, nominally {dataset.layout.rate_hz:g} Hz; `time_ms` is the device's clock.",
        "\n".join(channels),
        f"`plushsense import {RECORDINGS_TABLE} DS --layout {LAYOUT}` makes a data set of PlushSense of a table.",
    ]
    return "\n".join(["---", *head, "---", ""]) + "\n\n".join(text) + "\n"


def to_xdf(dataset: Dataset, folder: str | os.PathLike[str]) -> list[Path]:
    """Write an XDF file for each stream, and for each used recording that lies in none; return the files.

    A file ``<person>/….xdf`` has the stream ``toy`` (the channels as the toy sends them, and device_ms) and the stream
    ``markers``: at the first sample of a recording its gesture, after the last one "end". Times are those of the
    device's clock, from 0; where it goes back, the time continues with the next sample. The header of the toy says that
    samples may be lost (``can_drop_samples``), so that readers do not space the times evenly across a gap.

    Raises:
        DatasetError: if ``folder`` exists and is not empty; ForgottenError: like `Generation.check`.
    """
    files = []
    with new_folder(Path(folder), DatasetError, finishing=dataset.generation.writing) as work:
        for part in [*_streams(dataset), *_recordings(dataset, located=False)]:
            stem = part.id.removeprefix(f"{part.subject}/").replace("/", "-")
            name = Path(part.subject) / f"{stem}.xdf"
            (work / name).parent.mkdir(exist_ok=True)
            (work / name).write_bytes(_xdf(part, dataset.layout))
            files.append(Path(folder) / name)
    return files


def _xdf(part: _Part, layout: Layout) -> bytes:
    steps = np.diff(part.time_ms)
    seconds = np.concatenate([[0.0], np.cumsum(np.where(steps < 0, 1000.0 / layout.rate_hz, steps))]) / 1000.0
    values = np.column_stack([_raw(part.frames, layout), part.time_ms]).astype("<f8")
    rows = np.empty(len(values), dtype=[("stamped", "u1"), ("time", "<f8"), ("values", "<f8", values.shape[1])])
    rows["stamped"], rows["time"], rows["values"] = 8, seconds, values
    packed = [(len(rows[at : at + _CHUNK]), rows[at : at + _CHUNK].tobytes()) for at in range(0, len(rows), _CHUNK)]
    # The end of a recording is the begin of the row after it.
    after = np.append(seconds, seconds[-1] + 1.0 / layout.rate_hz)
    marks = sorted(
        [(after[first], 1, gesture) for gesture, first, _ in part.cuts]
        + [(after[last], 0, "end") for _, _, last in part.cuts]
    )
    texts = [b"\x08" + struct.pack("<dBI", time, 4, len(text.encode())) + text.encode() for time, _, text in marks]
    return b"".join(
        [
            b"XDF:",
            _xdf_chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>"),
            _xdf_stream(1, "toy", "double64", layout.rate_hz, [*layout.names, DEVICE_MS], packed),
            _xdf_stream(2, "markers", "string", 0.0, ["marker"], [(1, text) for text in texts]),
        ]
    )


def _xdf_chunk(tag: int, content: bytes) -> bytes:
    return struct.pack("<BIH", 4, len(content) + 2, tag) + content


def _xdf_stream(
    number: int,
    name: str,
    kind: str,
    rate_hz: float,
    channels: Sequence[str],
    packed: Sequence[tuple[int, bytes]],
) -> bytes:
    """Return header, samples and footer of a stream; ``packed`` has number and bytes of the samples of each chunk."""
    listed = "".join(f"<channel><label>{escape(label)}</label></channel>" for label in channels)
    lossy = "<synchronization><can_drop_samples>true</can_drop_samples></synchronization>" if rate_hz else ""
    header = (
        f"<?xml version='1.0'?><info><name>{name}</name><type>{'Touch' if rate_hz else 'Markers'}</type>"
        f"<channel_count>{len(channels)}</channel_count><nominal_srate>{rate_hz:g}</nominal_srate>"
        f"<channel_format>{kind}</channel_format><desc><channels>{listed}</channels>{lossy}</desc></info>"
    )
    which = struct.pack("<I", number)
    samples = [_xdf_chunk(3, which + struct.pack("<BI", 4, count) + content) for count, content in packed]
    clock = _xdf_chunk(4, which + struct.pack("<dd", 0.0, 0.0))
    footer = _xdf_chunk(6, which + b"<?xml version='1.0'?><info></info>")
    return b"".join([_xdf_chunk(2, which + header.encode()), clock, *samples, footer])
