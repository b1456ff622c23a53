"""XDF files as LabRecorder writes them, with streams of numbers and of texts."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np


@dataclass
class XdfStream:
    """A stream to write into an XDF file: ``samples`` are rows of numbers, or texts."""

    name: str
    times: Sequence[float]
    samples: Sequence[Any]
    format: str = "float32"
    labels: Sequence[str] = ()
    rate: float = 100.0
    offset: float = 0.0
    source: str = ""
    uid: str = ""

    @property
    def width(self) -> int:
        return len(self.samples[0]) if isinstance(self.samples[0], (list, tuple)) else 1

    def header(self) -> str:
        channels = "".join(f"<channel><label>{name}</label></channel>" for name in self.labels)
        return (
            f"<?xml version='1.0'?><info><name>{self.name}</name><type>x</type>"
            f"<channel_count>{self.width}</channel_count><nominal_srate>{self.rate}</nominal_srate>"
            f"<channel_format>{self.format}</channel_format><source_id>{self.source}</source_id><uid>{self.uid}</uid><desc><channels>{channels}</channels></desc></info>"
        )

    def sample(self, row: Any) -> bytes:
        if self.format == "string":
            texts = [str(text).encode() for text in (row if isinstance(row, (list, tuple)) else [row])]
            return b"".join(b"\x04" + struct.pack("<I", len(text)) + text for text in texts)
        return np.asarray(row, dtype={"float32": "<f4", "double64": "<f8", "int32": "<i4"}[self.format]).tobytes()


def xdf_chunk(tag: int, content: bytes) -> bytes:
    """A chunk: its length (of 4 bytes), tag and content."""
    return b"\x04" + struct.pack("<IH", len(content) + 2, tag) + content


def write_xdf(path: Path, streams: Sequence[XdfStream], at_once: int = 64) -> Path:
    """An XDF 1.0 file: header, stream headers, clock offsets, samples in chunks of ``at_once``, footers."""
    out = [b"XDF:", xdf_chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>")]
    for number, stream in enumerate(streams, 1):
        which = struct.pack("<I", number)
        out.append(xdf_chunk(2, which + stream.header().encode()))
        for time in (0.0, 1.0, 2.0):
            out.append(xdf_chunk(4, which + struct.pack("<dd", time, stream.offset)))
        for at in range(0, len(stream.samples), at_once):
            part = list(zip(stream.times, stream.samples, strict=True))[at : at + at_once]
            rows = b"".join(b"\x08" + struct.pack("<d", time) + stream.sample(row) for time, row in part)
            out.append(xdf_chunk(3, which + b"\x04" + struct.pack("<I", len(part)) + rows))
        out.append(xdf_chunk(6, which + b"<?xml version='1.0'?><info></info>"))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(out))
    return path
