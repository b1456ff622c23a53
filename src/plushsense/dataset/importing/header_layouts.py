"""Find the built-in layout of files that state none: by their header, their columns, and what their rows hold."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from plushsense.core.errors import ConfigError, FileFormatError
from plushsense.core.layouts import DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.recorder_csv import parse_name, read_recording
from plushsense.core.sentences import Sentence

_SAMPLED_FILES, _SAMPLED_BYTES = 3, 200_000
_SINCE_2001_MS = 978_307_200_000


def find_layout(files: Sequence[Path], guess: bool) -> tuple[Layout, Sentence]:
    """Return the built-in layout of ``files``, and a note that says by what it was found.

    Args:
        guess: whether to take the most probable layout that can read the files if their header names none or several.

    Raises:
        ConfigError: if there is none, or several fit.
    """
    found, why = _named_in_header(files), "the header of the files has its channels"
    if not found and (found := _without_header(files)):
        why = f"the files have its {len(found[0].csv.columns)} columns"
    if len({layout.csv.columns for layout in found}) == 1 < len(found):
        # They differ in the clock that the toy sends. Files without rows tell nothing, and are refused later.
        found = (readable_layouts(files, [layout.name for layout in found]) or found[::-1])[:1]
        why += f", the last one a {'clock' if DEVICE_MS in found[0].wire else 'delay'}"
    elif guess and len(found) != 1:
        found = readable_layouts(files, [layout.name for layout in found])[:1]
    if len(found) == 1:
        name = found[0].name
        return found[0], Sentence(f"the layout is '{name}', as {why}", reason="layout_guessed", layout=name)
    fit = f"The header of the files fits {' and '.join(layout.name for layout in found)}. " if found else ""
    raise ConfigError(
        f"--layout is needed: accepted are {', '.join(layout_names())}, or a TOML file of your own, which "
        f"names the channels (see docs/importing.md). {fit}For files of another form, let --guess FILE.toml write "
        "a pattern.",
        reason="layout_unknown",
    )


def _named_in_header(files: Iterable[Path]) -> list[Layout]:
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


def _without_header(files: Iterable[Path]) -> list[Layout]:
    """Return the built-in layouts that read the first recordings of the authors' recorder which have no header.

    Their truncation script leaves such files. The column of the computer's time must hold times since 2001.
    """
    named = [path for path in files if parse_name(path.name) is not None][:_SAMPLED_FILES]

    def reads(layout: Layout, path: Path) -> bool:
        with contextlib.suppress(FileFormatError):
            host = read_recording(path, layout).frames.host_ms
            return host is not None and float(np.median(host)) > _SINCE_2001_MS
        return False

    return [layout for layout in map(load_layout, layout_names()) if named and all(reads(layout, f) for f in named)]
