"""Store selections of recordings, which other pages let the review page show."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlencode

from plushsense.core.errors import ConfigError
from plushsense.core.files import write_file
from plushsense.studio.app.workspace import Workspace

_MAX_ADDRESS = 1500


class Selections:
    """Service that makes addresses of the review page for selections of recordings."""

    def __init__(self, workspace: Workspace) -> None:
        self._folder = workspace.folder / "selections"

    def address(self, dataset: Path, recordings: Sequence[str], title: str = "") -> str:
        """Return the address of the review page for a selection of recordings; the page displays ``title``.

        A long list is stored in ``<home>/selections/`` under its hash, so that the address stays short and valid.
        """
        query = urlencode([("dataset", str(dataset)), ("title", title), *(("recordings", r) for r in recordings)])
        if len(query) <= _MAX_ADDRESS:
            return f"/review?{query}"
        selection = {"dataset": str(dataset), "recordings": list(recordings), "title": title}
        text = json.dumps(selection, ensure_ascii=False)
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._folder.mkdir(parents=True, exist_ok=True)
        write_file(self._folder / f"{key}.json", text)
        return f"/review?{urlencode({'dataset': str(dataset), 'selection': key})}"

    def read(self, key: str) -> tuple[str, list[str]]:
        """Return the title and the recording ids of a stored selection; raise ConfigError for an unknown key."""
        try:
            if not key.isalnum():
                raise ValueError
            selection = json.loads((self._folder / f"{key}.json").read_text(encoding="utf-8"))
            return str(selection["title"]), [str(r) for r in selection["recordings"]]
        except (OSError, ValueError, KeyError, TypeError):
            raise ConfigError("The selection “{key}” does not exist. Follow the link again.", key=key) from None
