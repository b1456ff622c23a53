"""Import windows that MATLAB saved, as the authors' ``d_data_preparation.m`` makes them, and join them to recordings.

The file holds a cell array of windows (T, C) for each of training, validation and test, and their labels. Windows of
one recording overlap and follow one another, so that the recording is restored but for its last rows; a window that
was filled by repeating a short recording is cut back to it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plushsense.core.errors import FileFormatError
from plushsense.core.layouts import MAGNITUDE_FRACTION_BITS, Channel, CsvFormat, Layout, load_layout
from plushsense.core.recorder_csv import LONGEST_LABEL, Frames
from plushsense.dataset.importing.matfile import read_mat, texts_of
from plushsense.dataset.importing.sources import SourceFile
from plushsense.dataset.importing.tables import (
    ConvertedSource,
    LabelledSegment,
    SessionTarget,
    usable_rows,
    whole_steps,
    write_session,
)
from plushsense.dataset.store import UNKNOWN_SUBJECT

Windows = NDArray[np.float64]

SETS = (
    ("train", "traindata", "trainlabels"),
    ("validation", "valdata", "vallabels"),
    ("test", "testdata", "testlabels"),
)
_WHOLE = (("", "sigdatapad", "labelspad"), ("", "sigdata", "labels"))
SIMULATED = "simulated"
# Names of the classes, if labels are numbers.
_CATEGORIES = "c"
# A window repeats its beginning if so many rows or more are equal.
_ALIKE = 5
_SHORTEST = 10
# Time between two recordings, of which nothing is known, in ms.
_APART_MS = 10_000


@dataclass(frozen=True)
class LabelledWindows:
    """Windows (T, C) and the label of each, in the order of the file; ``name`` is the set, "" if there is only one.

    ``simulated``: the file says that they are of virtual people (as `plushsense.workflow.export.save_windows` does).
    """

    name: str
    windows: Sequence[Windows]
    labels: Sequence[str]
    simulated: bool = False


@dataclass(frozen=True)
class JoinedRecording:
    """Recording (T, C) restored from windows; ``sets`` has the set of each."""

    label: str
    values: Windows
    sets: tuple[str, ...]


def windows_layout(channels: int, given: Layout | None, display_name: str) -> Layout:
    """Return the layout of windows with so many channels: ``given``, plush-15 for 13, and for 11 one with magnitude.

    Raises:
        FileFormatError: if ``given`` has another number of channels, or there is no layout for the number.
    """
    plush = load_layout("plush-15")
    if given is not None and given.n_channels == channels:
        return given
    if given is not None:
        raise FileFormatError(
            f"the windows of '{display_name}' have {channels} channels, but layout '{given.name}' has "
            f"{given.n_channels}: give another --layout, or none for windows of the paper's scripts"
        )
    if channels == plush.n_channels:
        return plush
    if channels != plush.n_inputs:
        raise FileFormatError(
            f"the windows of '{display_name}' have {channels} channels; those of the paper's scripts have "
            f"{plush.n_inputs} or {plush.n_channels}: name them with --layout FILE"
        )
    magnitude = plush.derived[0].name
    step = 1 / 2**MAGNITUDE_FRACTION_BITS
    most = float(np.ceil(np.sqrt(3) * 32768))
    kept = tuple(c for c in plush.channels if c.name in plush.inputs)
    names = (*(c.name for c in kept), magnitude)
    columns = ("host_ms", "device_ms", *names)
    return replace(
        plush,
        name="plush-windows",
        title="Windows of the paper's scripts: the magnitude of the acceleration instead of its axes",
        channels=(*kept, Channel(magnitude, "count", "magnitude", valid_min=0, valid_max=most, step=step)),
        wire=(*names, "device_ms"),
        derived=(),
        vectors=(),
        inputs=names,
        csv=CsvFormat(columns, columns, ","),
    )


def read_windows(path: Path, display_name: str) -> list[LabelledWindows]:
    """Read the sets of windows of a MATLAB file: training, validation and test, or all windows.

    Raises:
        FileFormatError: for a file that cannot be read, or has no windows with labels.
    """
    values = read_mat(path, display_name)
    sets = [s for s in SETS if s[1] in values] or [s for s in _WHOLE if s[1] in values][:1]
    if not sets:
        raise FileFormatError(
            f"'{display_name}' has no windows: expected are the variables traindata and trainlabels (and of val and "
            f"test), or sigdatapad and labelspad; it has {', '.join(sorted(values)[:10]) or 'none'}"
        )
    found = []
    for name, data, labels in sets:
        if labels not in values:
            raise FileFormatError(f"'{display_name}' has '{data}' but no '{labels}': save both")
        windows = _windows(values[data], data, display_name)
        texts = _labels(values[labels], values.get(_CATEGORIES))
        if texts is None:
            raise FileFormatError(
                f"the labels '{labels}' of '{display_name}' cannot be read: in MATLAB, write  {labels} = "
                f"cellstr({labels})  and save again"
            )
        if len(texts) != len(windows):
            raise FileFormatError(f"'{display_name}' has {len(windows)} windows in '{data}' but {len(texts)} labels")
        found.append(LabelledWindows(name, windows, texts, bool(np.any(values.get(SIMULATED)))))
    widths = {w.shape[1] for s in found for w in s.windows}
    if len(widths) != 1:
        listed = ", ".join(str(w) for w in sorted(widths))
        raise FileFormatError(f"'{display_name}' has " + (f"windows of {listed} channels" if widths else "no window"))
    return found


def _windows(value: Any, name: str, display_name: str) -> list[Windows]:
    """Return the windows of a cell array of numeric arrays (T, C)."""
    cells = value.ravel(order="F").tolist() if isinstance(value, np.ndarray) and value.dtype == object else []
    good = all(isinstance(w, np.ndarray) and w.ndim == 2 and w.dtype.kind in "fiu" and len(w) for w in cells)
    if not cells or not good:
        raise FileFormatError(
            f"'{name}' of '{display_name}' is no cell array of windows, each with a row for a sample and a column for "
            "a channel"
        )
    return [np.asarray(w, dtype=np.float64) for w in cells]


def _labels(value: Any, categories: Any) -> list[str] | None:
    """Return labels as texts, from texts, a cell array of them, or numbers of classes; None for anything else."""
    if isinstance(value, list):
        return [text.strip() for text in value]
    if not isinstance(value, np.ndarray):
        return None
    try:
        if value.dtype == object:
            return texts_of(value)
        names = ["", *texts_of(categories)] if isinstance(categories, np.ndarray) else [""]
    except ValueError:
        return None
    codes = value.ravel(order="F").tolist()
    return [names[int(code)] for code in codes] if all(1 <= code < len(names) for code in codes) else None


def join_windows(sets: Sequence[LabelledWindows]) -> list[JoinedRecording]:
    """Join the windows of each label that follow one another by the step of the file, also from one set to the next.

    Others stay apart, even if they overlap: cut again with this step, each recording gives the windows it is made of.
    """
    by_label: dict[str, list[tuple[Windows, str]]] = {}
    for s in sets:
        for window, label in zip(s.windows, s.labels, strict=True):
            by_label.setdefault(label, []).append((window, s.name))
    joined = []
    shifts_of = {k: [_shift(a, b) for (a, _), (b, _) in itertools.pairwise(found)] for k, found in by_label.items()}
    counts = Counter(shift for shifts in shifts_of.values() for shift in shifts if shift)
    step = max(counts, key=counts.__getitem__, default=0)
    for label, found in by_label.items():
        shifts = [0, *shifts_of[label], 0]
        for first, last in itertools.pairwise([i for i, shift in enumerate(shifts) if not shift or shift != step]):
            pieces = [found[i][0][: shifts[i + 1]] for i in range(first, last - 1)] + [found[last - 1][0]]
            values = np.concatenate(pieces) if len(pieces) > 1 else _without_repetition(pieces[0])
            joined.append(JoinedRecording(label, values, tuple(name for _, name in found[first:last])))
    return joined


def _session(sets: Sequence[str]) -> str:
    """Return the session of a recording with windows of these sets: their name, "train", or "train 5 validation 2"."""
    runs = [(name, len(list(of))) for name, of in itertools.groupby(sets)]
    return runs[0][0] if len(runs) == 1 else " ".join(f"{name} {n}" for name, n in runs)


def _shift(one: Windows, other: Windows) -> int:
    """Return after how many rows of ``one`` the window ``other`` begins; 0 if they do not overlap by half."""
    for row in np.flatnonzero((one == other[0]).all(axis=1)).tolist():
        rows = len(one) - row
        if row and 2 * rows >= len(one) and rows <= len(other) and np.array_equal(one[row:], other[:rows]):
            return int(row)
    return 0


def _without_repetition(window: Windows) -> Windows:
    """Return the rows before a window repeats its beginning up to its end; the whole window if it does not."""
    for row in np.flatnonzero((window == window[0]).all(axis=1)).tolist():
        if row < _SHORTEST or len(window) - row < _ALIKE:
            continue
        if np.array_equal(window[row:], window[:-row]) and not (window[:row] == window[0]).all():
            return window[:row]
    return window


def write_windows(
    path: Path,
    display_name: str,
    folder: Path,
    subject: str | None,
    layout: Layout,
    sets: Sequence[LabelledWindows],
) -> Iterator[SourceFile | str]:
    """Write the recordings that windows are joined to into the new ``folder``; yield the files, and notes as text.

    The session of a recording is the set of its windows (see `_session`). Times are those of the layout's rate.

    Raises:
        FileFormatError: if no window can be used.
    """
    recordings = join_windows(sets)
    total = sum(len(s.windows) for s in sets)
    several = sum(len(set(r.sets)) > 1 for r in recordings)
    yield (
        f"{display_name}: {total} windows joined to {len(recordings)} recordings, by the rows that they share; up to "
        "one step of rows at the end of each is lost"
        + (f"; recordings with windows in two sets, so that the split saved leaks: {several}" if several else "")
    )
    good = [r for r in recordings if r.label and len(r.label) <= LONGEST_LABEL and usable_rows(r.values).all()]
    if not good:
        raise FileFormatError(f"'{display_name}' has no window with a label in which every value is a number")
    if len(good) < len(recordings):
        yield (
            f"{display_name}: {len(recordings) - len(good)} recordings without a label, or with a value that is no "
            "number, left out"
        )
    by_session: dict[str, list[JoinedRecording]] = {}
    for r in good:
        by_session.setdefault(_session(r.sets), []).append(r)
    counts: Mapping[str, int] = {s.name or "all": len(s.windows) for s in sets}
    original = ConvertedSource(path, display_name, {"windows": counts})
    begin = 0
    for number, (name, mine) in enumerate(by_session.items()):
        ends = np.cumsum([len(r.values) for r in mine]).tolist()
        cuts = [LabelledSegment(r.label, end - len(r.values), end) for r, end in zip(mine, ends, strict=True)]
        values, note = whole_steps(np.concatenate([r.values for r in mine]), layout)
        if note:
            yield f"{display_name}: {note}"
        clocks = []
        for r in mine:
            clocks.append(begin + np.round(np.arange(len(r.values)) * 1000.0 / layout.rate_hz).astype(np.int64))
            begin = int(clocks[-1][-1]) + _APART_MS
        frames = Frames(values, np.concatenate(clocks))
        target = SessionTarget(folder / str(number), subject or UNKNOWN_SUBJECT, name, layout)
        yield from write_session(target, original, frames, cuts, with_stream=False)
