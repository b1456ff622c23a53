"""The last look at a pseudonymised data set: does any file still hold an old code, a name or a real date?"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plushsense.dataset.contents import contents
from plushsense.dataset.freshness import STAMP
from plushsense.dataset.timeshift import dates_in
from plushsense.dataset.wording import Names

_TIMES = re.compile(rb"(?<![0-9A-Za-z.])\d{12,14}(?![0-9A-Za-z])")
_PLAIN = b"0123456789;,.+- \t\r\n"


def _words(data: bytes) -> str:
    """The cells of a raw file that hold more than numbers, each once: a header, labels, garbled pieces."""
    cells: set[bytes] = set()
    if data.translate(None, _PLAIN):
        for line in data.splitlines():
            if line.translate(None, _PLAIN):
                cells.update(cell for cell in re.split(rb"[;,\t]", line) if cell.translate(None, _PLAIN))
    return "\n".join(sorted(cell.decode("utf-8", "replace").strip() for cell in cells))


def traces(folder: Path, originals: Iterable[str], names: Names, times: NDArray[np.int64]) -> Iterator[tuple[str, str]]:
    """What is left of the originals, each as (file, what).

    Args:
        originals: the old codes, which no folder of a person may bear; names: what no file may hold.
        times: every time of the original files, in ms since 1970.
    """
    old = set(originals)
    known = np.unique(times)
    for content in contents(folder):
        path = content.path.as_posix()
        # A title such as the layout's can hold what looks like a code; names and ids cannot.
        if content.person in old:
            yield path, content.person
        for found in (*names.found(path), *dates_in(path)):
            yield path, found
        data = (folder / path).read_bytes()
        stamps = np.array(_TIMES.findall(data), dtype="S14").astype(np.int64)
        at = np.searchsorted(known, stamps).clip(max=max(len(known) - 1, 0))
        for stamp in sorted(set(stamps[known[at] == stamps].tolist())) if len(known) else ():
            yield path, str(stamp)
        if content.kind == "raw":
            found_in = names.found(_words(data))
        else:
            text = data.decode("utf-8", "replace")
            # The index's stamp holds when the new files were written: just now.
            found_in = [*names.found(text), *(() if content.path.name == STAMP else dates_in(text))]
        for found in dict.fromkeys(found_in):
            yield path, found
