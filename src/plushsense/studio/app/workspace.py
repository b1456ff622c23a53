"""The workspace of a running studio: its folders, its toys, and the services that pages share."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from plushsense.core.errors import ConfigError
from plushsense.dataset.importing.build import DEVICE_NAME
from plushsense.dataset.store import DatasetHead
from plushsense.recording.session_files import SESSION_HEAD

RECORDINGS, DATASETS, BUNDLES, EXPORTS, PACKAGES = "recordings", "datasets", "bundles", "exports", "packages"
WORK = "work"
VIRTUAL = "virtual://?person=7"
_HEAD = "dataset.toml"
_BUNDLE = "*.plush"

T = TypeVar("T")


@dataclass
class Workspace:
    """Folders, toys and shared services of one studio.

    Pages may read and write inside ``folder`` and the data sets given at start, nowhere else.

    Attributes:
        folder: holds `RECORDINGS`, `DATASETS`, `BUNDLES`, `EXPORTS`, `PACKAGES`, `WORK`, each made when it is needed.
        given: data sets named at start, wherever they lie.
        devices: toys named at start; the first is chosen.
        models: bundles named at start.
        toy: the URL of the toy that is chosen on the home page.
        speed: times real time at which a virtual toy runs.
        invite: gives an address with a new token for one more visitor; None where everybody may come.
    """

    folder: Path
    given: tuple[Path, ...] = ()
    devices: tuple[str, ...] = ()
    models: tuple[Path, ...] = ()
    toy: str = ""
    speed: float = 1.0
    invite: Callable[[], str] | None = None
    _parts: dict[type, Any] = field(default_factory=dict, repr=False)
    _titles: dict[Path, tuple[tuple[int, int], str]] = field(default_factory=dict, repr=False)
    _lock: Any = field(default_factory=threading.RLock, repr=False)

    def __post_init__(self) -> None:
        self.folder = self.folder.resolve()
        self.given = tuple(p.resolve() for p in self.given)
        self.models = tuple(p.resolve() for p in self.models)
        self.toy = self.toy or (self.devices[0] if self.devices else "")

    def part(self, kind: Callable[[Workspace], T]) -> T:
        """Return the shared object of this class; it is created on first use as ``kind(workspace)``.

        One that has a ``close`` is closed when the studio ends.
        """
        with self._lock:
            if kind not in self._parts:
                self._parts[kind] = kind(self)  # type: ignore[index]
            found: T = self._parts[kind]  # type: ignore[index]
            return found

    def close(self) -> None:
        """Close all parts, the last made first."""
        with self._lock:
            parts, self._parts = list(self._parts.values()), {}
        for part in reversed(parts):
            if hasattr(part, "close"):
                part.close()

    # What is there --------------------------------------------------------------------------------------------

    @property
    def recordings(self) -> Path:
        """The folder of recorded sessions: ``recordings/<subject>/<session>/``."""
        return self.folder / RECORDINGS

    def datasets(self) -> list[Path]:
        """Return all data sets: those given at start, then those in the folder by name."""
        found = [p for p in self.given if (p / _HEAD).is_file()]
        below = sorted(p.parent for p in (self.folder / DATASETS).glob(f"*/{_HEAD}"))
        return [*found, *(p for p in below if p.resolve() not in self.given)]

    def bundles(self) -> list[Path]:
        """Return all bundles, the newest first: those given at start, in the folder, and beside a data set."""
        places = [self.folder / BUNDLES, *self.datasets()]
        found = {p.resolve(): p for p in self.models if p.is_file()}
        found |= {p.resolve(): p for place in places for p in place.glob(_BUNDLE)}
        dated = []
        for path in found.values():
            # A file may have been removed since it was listed, or be a broken link.
            with contextlib.suppress(OSError):
                dated.append((-path.stat().st_mtime, str(path), path))
        return [path for _, _, path in sorted(dated)]

    def sessions(self) -> list[Path]:
        """Return the folders of all sessions in `recordings`, by person and name."""
        return sorted(p.parent for p in self.recordings.glob(f"*/*/{SESSION_HEAD}"))

    def roots(self) -> Iterator[Path]:
        """Yield the folders that pages may access."""
        yield self.folder
        yield from self.given

    def inside(self, path: str | os.PathLike[str]) -> Path:
        """Resolve ``path`` (absolute, or relative to ``folder``); every path that a browser sends goes through here.

        Raises:
            ConfigError: for a path outside, also by way of ``..`` or a link.
        """
        with contextlib.suppress(ValueError, OSError, RuntimeError):
            # Raised for a NUL, a name that cannot be encoded, or circular links.
            real = (self.folder / path).resolve()
            if real in self.models or any(real == root or root in real.parents for root in self.roots()):
                return real
        raise ConfigError(
            f"'{path}' lies outside the studio's folders: choose something in '{self.folder}', or start the studio "
            "with --dataset or --home for the other one."
        )

    def new(self, kind: str, name: str) -> Path:
        """Return the path for something new with this name in ``folder / kind``; nothing is created yet.

        Raises:
            ConfigError: for a name that is no plain file name, and one that is taken.
        """
        plain = name.strip()
        odd = plain.startswith(".") or plain.endswith(".") or not all(c.isalnum() or c in " ._-" for c in plain)
        if not plain or len(plain) > 64 or odd or DEVICE_NAME.match(plain):
            raise ConfigError(
                f"'{name}' cannot be a name: give at most 64 letters, digits, spaces, points and hyphens."
            )
        place = self.inside(Path(kind) / plain)
        if place.exists():
            raise ConfigError(
                f"'{plain}' is there already in '{place.parent}': give another name, nothing is replaced."
            )
        return place

    def title(self, dataset: Path) -> str:
        """Return the name of a data set; its folder's name if it cannot be read."""
        try:
            now = (dataset / _HEAD).stat()
            seen = now.st_mtime_ns, now.st_size
            # Cached: pages call this in the event loop for every data set.
            known = self._titles.get(dataset)
            if known is None or known[0] != seen:
                known = self._titles[dataset] = (seen, DatasetHead.read(dataset).name)
            return known[1]
        except Exception:  # noqa: BLE001, RUF100
            return dataset.name


class ChangeSignal:
    """A signal that something changed: notified from any thread, delivered in the event loop of each subscriber."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: dict[object, Callable[[], None]] = {}

    def notify(self) -> None:
        """Schedule the callbacks of all subscribers; never blocks."""
        with self._lock:
            subscribers = list(self._subscribers.values())
        for notify in subscribers:
            notify()

    def subscribe(
        self, callback: Callable[[], Any], loop: asyncio.AbstractEventLoop | None = None
    ) -> Callable[[], None]:
        """Call ``callback`` in ``loop`` after notifications; those before it runs are merged into one call.

        Pages use `plushsense.studio.app.shell.on_change`, which unsubscribes when the page is closed.

        Args:
            loop: the running event loop by default.

        Returns:
            A function that unsubscribes.
        """
        loop = loop or asyncio.get_running_loop()
        key, waiting = object(), threading.Event()

        def call() -> None:
            waiting.clear()
            if key in self._subscribers:
                callback()

        def schedule() -> None:
            if waiting.is_set():
                return
            waiting.set()
            try:
                loop.call_soon_threadsafe(call)
            except RuntimeError:
                # The loop is closed: the studio is ending.
                self._subscribers.pop(key, None)

        def unsubscribe() -> None:
            with self._lock:
                self._subscribers.pop(key, None)

        with self._lock:
            self._subscribers[key] = schedule
        return unsubscribe
