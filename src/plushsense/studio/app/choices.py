"""Keep the last choices on the pages, which are preselected the next time, also after a restart."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Iterable

from plushsense.core.files import write_file
from plushsense.studio.app.workspace import Workspace

FILE = "choices.json"


class Choices:
    """The last choices in a studio's folder by name, such as ``dataset``, kept in `FILE` there."""

    def __init__(self, workspace: Workspace) -> None:
        self._path = workspace.folder / FILE
        self._lock = threading.Lock()
        self._last: dict[str, str] = {}
        with contextlib.suppress(OSError, ValueError, AttributeError):
            read = json.loads(self._path.read_text(encoding="utf-8")).items()
            self._last = {name: choice for name, choice in read if isinstance(choice, str)}

    def last(self, name: str, possible: Iterable[str] | None = None, otherwise: str | None = None) -> str:
        """Return the last choice, "" for none.

        Args:
            possible: what can be chosen now; if the last choice is not in it, ``otherwise`` is returned, by default the
                first of these.
        """
        choice = self._last.get(name, "")
        if possible is None or choice in (possible := list(possible)):
            return choice
        return otherwise if otherwise is not None else next(iter(possible), "")

    def keep(self, **choices: str) -> None:
        """Keep choices that were just used; on a full or read-only disk only until the studio ends."""
        with self._lock:
            if choices.items() <= self._last.items():
                return
            self._last |= choices
            with contextlib.suppress(OSError):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                write_file(self._path, json.dumps(self._last, ensure_ascii=False, indent=1))
