"""What mlcroissant loads from a package, compared with what its files hold: every value, bit for bit.

Tables are compared with their text, rows of recordings and streams with what PlushSense's own reader reads.
"""

from __future__ import annotations

import csv
import glob
import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from plushsense.core.recfile import Frames, read_stream
from plushsense.core.signal import DEVICE_MS, HOST_MS
from plushsense.dataset.publish import as_croissant
from plushsense.dataset.publish.as_croissant import FILE_FIELD
from plushsense.dataset.publish.description import DATA
from plushsense.dataset.store import Dataset

Say = Callable[[str, str], None]


def compare_records(
    mlcroissant: ModuleType, root: Path, dataset: Dataset, stream_rows: int | None, say: Say
) -> dict[str, int]:
    """Load every record set and compare; returns how many records of each were compared.

    Args:
        stream_rows: of each stream only so many rows, from its beginning; None: all.
        say: called with a file and what is wrong there.
    """
    path = str(root / as_croissant.FILE)
    loaded = mlcroissant.Dataset(path)
    by_id = {node.uuid: node for node in loaded.metadata.distribution}
    compared = {}
    seen: set[str] = set()
    for record_set in loaded.metadata.record_sets:
        name = record_set.uuid
        source = by_id[next(f.source.uuid for f in record_set.fields)]
        if type(source).__name__ == "FileObject":
            compared[name] = _table(name, loaded.records(name), root / source.content_url, say)
            seen.add(source.content_url)
            continue
        files = _files(dataset, name)
        seen |= {file for file, _ in files}
        if stream_rows is None or name == "samples":
            compared[name] = _rows(name, loaded.records(name), files, dataset, None, say)
            continue
        compared[name] = 0
        for file in files:
            # One file at a time, so that no more than its beginning has to be turned into records.
            source.includes = [glob.escape(file[0])]
            records = itertools.islice(iter(loaded.records(name)), stream_rows)
            compared[name] += _rows(name, records, [file], dataset, stream_rows, say)
    expected = {f for name in ("samples", "stream-samples") for f, _ in _files(dataset, name)}
    for absent in sorted(expected - seen):
        say(absent, "is in no record set of croissant.json")
    return compared


def _files(dataset: Dataset, name: str) -> list[tuple[str, Path]]:
    if name == "samples":
        files = {r.file for r in dataset.recordings} - {s.file for s in dataset.streams}
    else:
        files = {s.file for s in dataset.streams}
    return [(f"{DATA}/{file}", dataset.path / file) for file in sorted(files)]


def _table(name: str, records: Iterable[dict[str, Any]], path: Path, say: Say) -> int:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    number = 0
    for number, record in enumerate(records, 1):
        if number > len(rows):
            continue
        for key, value in record.items():
            column = key.rpartition("/")[2]
            text = rows[number - 1].get(column)
            if text is None or not _same(value, text):
                say(path.name, f"row {number} has {column} {text!r}; as a record of '{name}' it is {_plain(value)!r}")
                return number
        if len(record) != len(rows[0]):
            say(path.name, f"has {len(rows[0])} columns; a record of '{name}' has {len(record)}")
            return number
    if number != len(rows):
        say(path.name, f"holds {len(rows)} rows; '{name}' loads {number} records")
    return number


def _plain(value: Any) -> Any:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def _same(value: Any, text: str) -> bool:
    value = _plain(value)
    if value is None:
        return text == ""
    if isinstance(value, bool | np.bool_):
        return text == ("true" if value else "false")
    if isinstance(value, str):
        return value == text
    try:
        return bool(value == (int(text) if isinstance(value, int | np.integer) else float(text)))
    except ValueError:
        return False


def _rows(
    name: str,
    records: Iterable[dict[str, Any]],
    files: list[tuple[str, Path]],
    dataset: Dataset,
    limit: int | None,
    say: Say,
) -> int:
    """Compare the rows of recordings or streams, file by file, in whatever order the files come."""
    waiting = dict(files)
    compared = 0
    key = f"{name}/{FILE_FIELD}"
    for value, group in itertools.groupby(records, key=lambda record: record[key]):
        file = str(_plain(value))
        place = waiting.pop(file, None)
        rows = list(group)
        compared += len(rows)
        if place is None:
            say(file, f"'{name}' loads it, but it is not in the data")
            continue
        problem = _difference(rows, name, read_stream(place, dataset.layout).frames, dataset, limit)
        if problem:
            say(file, problem)
    for file in waiting:
        say(file, f"'{name}' does not load it")
    return compared


def _difference(
    rows: list[dict[str, Any]], name: str, frames: Frames, dataset: Dataset, limit: int | None
) -> str | None:
    """What differs between records and frames; None when nothing does."""
    layout = dataset.layout
    n = len(frames) if limit is None else min(limit, len(frames))
    if len(rows) != n:
        return f"'{name}' loads {len(rows)} of its {n} rows"
    expected: dict[str, Any] = {DEVICE_MS: frames.device_ms}
    if frames.host_ms is not None:
        expected[HOST_MS] = frames.host_ms
    if frames.labels is not None:
        expected["label"] = frames.labels
    for at, channel in enumerate(layout.channels):
        expected[channel.name] = frames.values[:, at]
    steps = {c.name: c.step for c in layout.channels}
    for column, values in expected.items():
        key = f"{name}/{column}"
        if key not in rows[0]:
            return f"'{name}' has no field '{column}'"
        loaded = [row[key] for row in rows]
        if column == "label":
            same = [_plain(v) for v in loaded] == values[:n].tolist()
        elif any(v is None for v in loaded):
            same = False
        elif steps.get(column, 1.0) == 1.0:
            same = np.array_equal(np.array(loaded, dtype=np.int64), values[:n])
        else:
            same = np.array_equal(np.round(np.array(loaded) / steps[column]).astype(np.int64), values[:n])
        if not same:
            return f"'{name}' loads other values of {column} than the file holds"
    return None
