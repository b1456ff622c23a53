"""The data sets under review, one for all pages, and selections of recordings that other pages link to."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections import OrderedDict
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from urllib.parse import urlencode

from plushsense.apps.studio.house import House
from plushsense.apps.studio.reviewing import Review
from plushsense.core.errors import ConfigError
from plushsense.dataset.quality import deciding
from plushsense.dataset.store import write_atomically

_REVIEWS_KEPT = 3
_LONGEST_ADDRESS = 1500


class Reviews:
    """The data sets under review, and selections of recordings that other pages link to."""

    def __init__(self, house: House) -> None:
        self._house = house
        self._lock = threading.Lock()
        self._opened: OrderedDict[Path, Review] = OrderedDict()

    def open(self, path: str | os.PathLike[str]) -> Review:
        """The review of a data set, which lies inside the studio's folders; takes its time.

        Raises:
            ConfigError: for a place outside. DatasetError: for what is no data set, or a broken one.
        """
        place = self._house.inside(path)
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
        """Stop all that goes on in the background."""
        for review in self._opened.values():
            review.close()

    @cached_property
    def _selections(self) -> Path:
        return self._house.folder / "selections"

    def address(self, dataset: Path, recordings: Sequence[str], title: str = "") -> str:
        """Where the review page shows just these recordings, for a link.

        A long list is kept in ``<home>/selections/`` by its hash, so that the address stays short and lasts.

        Args:
            title: what they have in common, said above the table.
        """
        said = {"dataset": str(dataset), "recordings": list(recordings), "title": title}
        short = urlencode([("dataset", str(dataset)), ("title", title), *(("recordings", r) for r in recordings)])
        if len(short) <= _LONGEST_ADDRESS:
            return f"/review?{short}"
        text = json.dumps(said, ensure_ascii=False)
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._selections.mkdir(parents=True, exist_ok=True)
        write_atomically(self._selections / f"{key}.json", text)
        return f"/review?{urlencode({'dataset': str(dataset), 'selection': key})}"

    def selection(self, key: str) -> tuple[str, list[str]]:
        """A kept selection: its title and the ids.

        Raises:
            ConfigError: for a key that is none.
        """
        try:
            if not key.isalnum():
                raise ValueError
            said = json.loads((self._selections / f"{key}.json").read_text(encoding="utf-8"))
            return str(said["title"]), [str(r) for r in said["recordings"]]
        except (OSError, ValueError, KeyError, TypeError):
            raise ConfigError(f"There is no selection '{key}' any more: go back to where the link was.") from None


def signed(who: str) -> str:
    """Who decides: the name given, else the login name; ConfigError where there is neither."""
    return deciding.signed(who.strip() or None)
