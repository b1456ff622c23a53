"""Filters and sorting of recordings, open reviews, and selections that other pages link to."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from plushsense.core.errors import ConfigError
from plushsense.core.files import write_file
from plushsense.dataset.quality import checking
from plushsense.dataset.quality.findings import SEVERITIES
from plushsense.studio.app.workspace import Workspace
from plushsense.studio.pages.review.review import STATES, Review, ReviewedRecording

TO_DO, DONE = "todo", "done"
NO_FINDING = "no-finding"


@dataclass(frozen=True)
class RecordingFilter:
    """Conditions that a recording must meet to be listed; "" accepts all.

    ``state``: one of `STATES`, or `TO_DO` or `DONE`. ``severity``: least severity of the most urgent open finding, or
    `NO_FINDING`. ``check``: a check with a finding, accepted or not. ``text``: part of the id or of a finding.
    """

    person: str = ""
    gesture: str = ""
    state: str = ""
    severity: str = ""
    check: str = ""
    text: str = ""

    def fits(self, row: ReviewedRecording) -> bool:
        """Return whether a recording passes the filter."""
        return (
            self.person in ("", row.info.subject)
            and self.gesture in ("", row.info.gesture)
            and self._state_fits(row)
            and self._severity_fits(row)
            and (not self.check or any(f.check == self.check for f in row.findings))
            and self._text_fits(row)
        )

    def _state_fits(self, row: ReviewedRecording) -> bool:
        if self.state in (TO_DO, DONE):
            return row.done == (self.state == DONE)
        return self.state in ("", row.state)

    def _severity_fits(self, row: ReviewedRecording) -> bool:
        if self.severity == NO_FINDING:
            return not row.worst
        if not self.severity:
            return True
        return bool(row.worst) and SEVERITIES.index(row.worst) <= SEVERITIES.index(self.severity)

    def _text_fits(self, row: ReviewedRecording) -> bool:
        wanted = self.text.strip().casefold()
        return not wanted or any(wanted in s.casefold() for s in (row.id, *(f.message for f in row.findings)))

    @classmethod
    def of(cls, message: dict[str, str]) -> RecordingFilter:
        """Read a filter from the query of an address; ignore unknown values."""
        known = {f.name: message[f.name] for f in fields(cls) if message.get(f.name)}
        if known.get("state", "") not in ("", TO_DO, DONE, *STATES):
            del known["state"]
        if known.get("severity", "") not in ("", NO_FINDING, *SEVERITIES):
            del known["severity"]
        return cls(**known)

    def query(self) -> dict[str, str]:
        """Return the conditions as query parameters of an address."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name))}


_URGENCY = {s: i for i, s in enumerate((*SEVERITIES, ""))}
SORTS: dict[str, Callable[[ReviewedRecording], Any]] = {
    "recording": lambda r: (),
    "person": lambda r: r.info.subject,
    "gesture": lambda r: r.info.gesture,
    "seconds": lambda r: r.seconds,
    "findings": lambda r: (_URGENCY[r.worst], -len(r.open)),
    "state": lambda r: (STATES.index(r.state), r.confidence),
}
"""Sort keys of the columns; equal recordings are sorted by id."""


def filter_and_sort(
    rows: Iterable[ReviewedRecording],
    wanted: RecordingFilter,
    only: Collection[str] | None = None,
    by: str = "recording",
    down: bool = False,
) -> list[str]:
    """Return the ids of the recordings that pass a filter, sorted."""
    fitting = [r for r in rows if (only is None or r.id in only) and wanted.fits(r)]
    fitting.sort(key=lambda r: r.id, reverse=down and by == "recording")
    if by != "recording":
        fitting.sort(key=SORTS[by], reverse=down)
    return [r.id for r in fitting]


_REVIEWS_KEPT = 3
_LONGEST_ADDRESS = 1500


class Reviews:
    """The reviews of the studio, one for each data set, and stored selections of recordings."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._lock = threading.Lock()
        self._opened: OrderedDict[Path, Review] = OrderedDict()

    def open(self, path: str | os.PathLike[str]) -> Review:
        """Open the review of a data set inside the folders of the studio; may take seconds.

        Raises:
            ConfigError: for a folder outside the studio. DatasetError: for a folder that is no valid data set.
        """
        place = self._workspace.inside(path)
        with self._lock:
            review = self._opened.get(place)
            if review is None:
                review = self._opened[place] = Review(place)
            else:
                review.renew()
            self._opened.move_to_end(place)
            gone = [self._opened.popitem(last=False)[1] for _ in range(len(self._opened) - _REVIEWS_KEPT)]
        for each in gone:
            each.close()
        return review

    def close(self) -> None:
        """Stop the background threads of all reviews."""
        for review in self._opened.values():
            review.close()

    @cached_property
    def _selections(self) -> Path:
        return self._workspace.folder / "selections"

    def address(self, dataset: Path, recordings: Sequence[str], title: str = "") -> str:
        """Return the address of the review page for a selection of recordings.

        A long list is stored in ``<home>/selections/`` under its hash, so that the address stays short and valid.

        Args:
            title: what the recordings have in common, displayed above the table.
        """
        message = {"dataset": str(dataset), "recordings": list(recordings), "title": title}
        short = urlencode([("dataset", str(dataset)), ("title", title), *(("recordings", r) for r in recordings)])
        if len(short) <= _LONGEST_ADDRESS:
            return f"/review?{short}"
        text = json.dumps(message, ensure_ascii=False)
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._selections.mkdir(parents=True, exist_ok=True)
        write_file(self._selections / f"{key}.json", text)
        return f"/review?{urlencode({'dataset': str(dataset), 'selection': key})}"

    def selection(self, key: str) -> tuple[str, list[str]]:
        """Read a stored selection: its title and the ids.

        Raises:
            ConfigError: for an unknown key.
        """
        try:
            if not key.isalnum():
                raise ValueError
            message = json.loads((self._selections / f"{key}.json").read_text(encoding="utf-8"))
            return str(message["title"]), [str(r) for r in message["recordings"]]
        except (OSError, ValueError, KeyError, TypeError):
            raise ConfigError(f"There is no selection '{key}' any more: go back to where the link was.") from None


def resolve_author(who: str) -> str:
    """Return the given name, else the login name; raise ConfigError if there is neither."""
    return checking.author_name(who.strip() or None)
