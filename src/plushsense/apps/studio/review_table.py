"""A table of recordings with findings, states and short paths; sorting and pages are the server's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from nicegui.element import Element


class ReviewTable(Element, component="review_table.js"):
    """Rows of recordings.

    Args:
        columns: ``key``, ``label``, ``sorts`` (whether a click on it sorts), in the order in which they are drawn.
        on_sort: called with a column's key. ``on_open``: called with a recording's id.
        spark: what a screen reader says of the small curves.
    """

    def __init__(
        self,
        caption: str,
        columns: Sequence[dict[str, Any]],
        *,
        spark: str,
        on_sort: Callable[[str], Any],
        on_open: Callable[[str], Any],
    ) -> None:
        super().__init__()
        self._props["caption"] = caption
        self._props["columns"] = list(columns)
        self._props["rows"] = []
        self._props["spark"] = spark
        self.classes("w-full")
        self.on("sort", lambda event: on_sort(str(event.args)))
        self.on("open", lambda event: on_open(str(event.args)))

    def show(self, rows: Sequence[dict[str, Any]], *, sort: str, down: bool, current: str, caption: str) -> None:
        """Draw these rows: ``id, person, gesture, seconds, findings [{severity, text}], state, said, points, kept``."""
        self._props["rows"] = list(rows)
        self._props["sort"], self._props["down"] = sort, down
        self._props["current"], self._props["caption"] = current, caption
        self.update()
