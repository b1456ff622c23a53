"""Real recordings as one stream of frames for a toy: to prove the C on what people did, nothing of it is kept."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import ConfigError, nearest
from plushsense.core.recfile import Frames
from plushsense.core.signal import Layout
from plushsense.dataset.store import Dataset

Ints = NDArray[np.int64]
_LOW, _HIGH = -(1 << 31), (1 << 31) - 1
_PAUSE_MS = 1000


def frames_of(dataset: Dataset, layout: Layout, *, subjects: Sequence[str] = (), rows: int) -> Ints:
    """Frames (n, 1 + C) of a data set, at least ``rows`` of them where there are as many.

    Session streams of each person where there are, else the person's recordings; each is begun after a pause that
    makes a toy start again, with its own gaps and resets kept. Of many streams the same share is taken of each, from
    its beginning. Stamps wrap at 2^32 as a toy's do; values are held within 32 bits.

    Raises:
        ConfigError: for another layout than the model's, or a person who is not there.
    """
    if dataset.layout.channels != layout.channels:
        raise ConfigError(
            f"The data set '{dataset.head.name}' holds layout '{dataset.layout.name}' "
            f"({', '.join(dataset.layout.names)}), but the model reads '{layout.name}' ({', '.join(layout.names)}), "
            "with its own units and valid ranges: give recordings of the model's layout."
        )
    known = sorted({r.subject for r in dataset.recordings} | {s.subject for s in dataset.streams})
    for subject in subjects:
        if subject not in known:
            raise ConfigError(
                f"The data set '{dataset.head.name}' has nobody '{subject}': accepted are {', '.join(known)}."
                f"{nearest(subject, known)}"
            )
    pieces = list(_pieces(dataset, subjects or known))
    lengths = np.array([len(p) for p in pieces], dtype=np.int64)
    takes = np.zeros_like(lengths)
    # The shortest first: what they lack falls to the others.
    for left, at in zip(range(len(pieces), 0, -1), np.argsort(lengths, kind="stable"), strict=True):
        takes[at] = min(lengths[at], max(0, -(-(rows - int(takes.sum())) // left)))
    found: list[Ints] = []
    now = _PAUSE_MS
    for piece, take in zip(pieces, takes.tolist(), strict=True):
        if not take:
            continue
        part = piece.slice(0, take)
        ms = part.device_ms.astype(np.int64) - int(part.device_ms[0]) + now
        found.append(np.column_stack([ms & 0xFFFFFFFF, np.clip(part.values, _LOW, _HIGH)]))
        now = int(ms[-1]) + layout.gap_ms + _PAUSE_MS
    return np.concatenate(found) if found else np.empty((0, 1 + len(layout.channels)), dtype=np.int64)


def _pieces(dataset: Dataset, subjects: Sequence[str]) -> Iterator[Frames]:
    for subject in subjects:
        streams = [s for s in dataset.streams if s.subject == subject]
        if streams:
            yield from (dataset.read_stream(s.id) for s in streams)
        else:
            yield from (dataset.read(r) for r in dataset.used if r.subject == subject)
