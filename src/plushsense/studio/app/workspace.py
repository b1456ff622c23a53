"""Define the workspace of a running studio: its folders, its toys and the services that pages share."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import re
import shutil
import threading
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.core.sentences import Message
from plushsense.dataset.files import DATASETS, change_head, list_package_files, person_folders, sha256_of
from plushsense.dataset.importing.archives import DEVICE_NAME
from plushsense.dataset.privacy.codes import HomeCodes
from plushsense.dataset.privacy.removed import RemovedCodes
from plushsense.dataset.store import DatasetHead
from plushsense.recording.writer import SESSION_HEAD

RECORDINGS, BUNDLES, EXPORTS, PACKAGES = "recordings", "bundles", "exports", "packages"
WORK, DISCARDED, BACKUPS = "work", "discarded", "backups"
PROTOCOLS = "protocols"
"""Folder of the user's own recording protocols."""
PATTERNS = "patterns"
"""Folder of the patterns by which files of other sensors are read."""
VIRTUAL = "virtual://?person=7"
_HEAD = "dataset.toml"
_BUNDLE = "*.plush"
_COPY = "~~"  # before the number of a second discarded file of the same name
_NOT_PLAIN = re.compile(r"[^\w .-]")

T = TypeVar("T")
FileStamps = tuple[tuple[int, int] | None, ...]


def file_stamps(*paths: Path) -> FileStamps:
    """Return the modification time (ns) and size of each file, None for a missing one; compare them to see changes."""
    stamps: list[tuple[int, int] | None] = []
    for path in paths:
        try:
            stat = path.stat()
            stamps.append((stat.st_mtime_ns, stat.st_size))
        except OSError:
            stamps.append(None)
    return tuple(stamps)


@dataclass
class Workspace:
    """Folders, toys and shared services of one studio.

    Pages may read and write only inside ``folder`` and the data sets given at start.

    Attributes:
        folder: contains `RECORDINGS`, `DATASETS`, `BUNDLES`, `EXPORTS`, `PACKAGES`, `BACKUPS`, `WORK` and `DISCARDED`,
            created when needed.
        given: data sets given at start, in any folder.
        devices: URLs of the toys given at start; the first is chosen.
        models: bundles (model files) given at start.
        toy: URL of the chosen toy, "" for none.
        speed: speed of a virtual toy, as a multiple of real time.
        invite: returns an address with a new token for one more visitor; None if no token is needed.
    """

    folder: Path
    given: tuple[Path, ...] = ()
    devices: tuple[str, ...] = ()
    models: tuple[Path, ...] = ()
    toy: str = ""
    speed: float = 1.0
    invite: Callable[[], str] | None = None
    _parts: dict[type, Any] = field(default_factory=dict, repr=False)
    _titles: dict[Path, tuple[FileStamps, str]] = field(default_factory=dict, repr=False)
    _lock: Any = field(default_factory=threading.RLock, repr=False)

    def __post_init__(self) -> None:
        self.folder = self.folder.resolve()
        self.given = tuple(p.resolve() for p in self.given)
        self.models = tuple(p.resolve() for p in self.models)
        self.toy = self.toy or (self.devices[0] if self.devices else "")

    def part(self, kind: Callable[[Workspace], T]) -> T:
        """Return the shared object of the class ``kind``, created on first use as ``kind(workspace)``.

        If the object has a method ``close``, it is called when the studio ends.
        """
        with self._lock:
            if kind not in self._parts:
                self._parts[kind] = kind(self)  # type: ignore[index]
            part: T = self._parts[kind]  # type: ignore[index]
            return part

    def close(self) -> None:
        """Close all shared objects, the last created first."""
        with self._lock:
            parts, self._parts = list(self._parts.values()), {}
        for part in reversed(parts):
            if hasattr(part, "close"):
                part.close()

    # Contents -------------------------------------------------------------------------------------------------

    @property
    def recordings(self) -> Path:
        """The folder of recorded sessions, which are at ``<subject>/<session>/`` inside it."""
        return self.folder / RECORDINGS

    def datasets(self) -> list[Path]:
        """Return the folders of all data sets: those given at start, then those in the workspace sorted by name."""
        given = [p for p in self.given if (p / _HEAD).is_file()]
        own = sorted(p.parent for p in (self.folder / DATASETS).glob(f"*/{_HEAD}"))
        return [*given, *(p for p in own if p.resolve() not in self.given)]

    def bundles(self) -> list[Path]:
        """Return all bundles, newest first: those given at start, in the workspace, and in a data set's folder."""
        folders = [self.folder / BUNDLES, *self.datasets()]
        bundles = {p.resolve(): p for p in self.models if p.is_file()}
        bundles |= {p.resolve(): p for folder in folders for p in folder.glob(_BUNDLE)}
        dated = []
        for path in bundles.values():
            # A file may have been removed after it was listed, or be a broken link.
            with contextlib.suppress(OSError):
                dated.append((-path.stat().st_mtime, str(path), path))
        return [path for _, _, path in sorted(dated)]

    def sessions(self) -> list[Path]:
        """Return the folders of all sessions in `recordings`, sorted by subject and name."""
        return sorted(p.parent for p in self.recordings.glob(f"*/*/{SESSION_HEAD}"))

    def codes(self, apart_from: str = "") -> HomeCodes:
        """Return the codes of all people, also in discarded sessions, but for ``apart_from``."""
        recorded = sorted((p for p in self.recordings.glob("*/")), key=lambda p: p.stat().st_mtime)
        others = {p.name for p in (self.folder / DISCARDED / RECORDINGS).glob("*/")}
        others |= {code for dataset in self.datasets() for code in person_folders(dataset)}
        names = tuple(p.name for p in recorded if p.name != apart_from)
        return HomeCodes(names, frozenset(others - {apart_from}), RemovedCodes.read(self.folder))

    def roots(self) -> Iterator[Path]:
        """Yield the folders that pages may access."""
        yield self.folder
        yield from self.given

    def inside(self, path: str | os.PathLike[str]) -> Path:
        """Resolve ``path`` (absolute, or relative to ``folder``); use this to check every path sent by a browser.

        Raises:
            ConfigError: for a path outside the folders of `roots`, also if reached through ``..`` or a link.
        """
        with contextlib.suppress(ValueError, OSError, RuntimeError):
            # These are raised for a NUL, a name that cannot be encoded, or circular links.
            real = (self.folder / path).resolve()
            if real in self.models or any(real == root or root in real.parents for root in self.roots()):
                return real
        raise ConfigError(
            "“{path}” is not in the studio's folder {folder}. Choose something inside it.",
            path=path,
            folder=self.folder,
        )

    def rename(self, path: Path, name: str) -> Path:
        """Change the name of a data set, whose folder keeps its name, or of a bundle; return its path.

        Raises:
            ConfigError: for a name that is not a plain file name, or that another one has.
        """
        real = self.inside(path)
        if real.is_dir():
            if name in [self.title(other) for other in self.datasets() if other != path]:
                raise ConfigError(
                    "“{name}” exists already. Give another name; nothing is replaced.", name=name, field="name"
                )
            self.check_name(name)
            change_head(real, lambda head: replace(head, name=name))
            return real
        place = self.new(BUNDLES, f"{name}{real.suffix}")
        real.rename(place)
        return place

    def discard(self, path: Path) -> Path:
        """Move a session, data set, bundle or protocol of ``folder`` into `DISCARDED`, and return its new path.

        Raises:
            ConfigError: for a path outside ``folder``.
        """
        real = self.inside(path)
        if self.folder not in real.parents:
            raise ConfigError("“{path}” is not in the studio's folder, so the studio does not remove it.", path=path)
        inside = real.relative_to(self.folder)
        place, number = self.folder / DISCARDED / inside, 2
        while place.exists():
            place, number = self.folder / DISCARDED / inside.with_name(f"{inside.name}{_COPY}{number}"), number + 1
        place.parent.mkdir(parents=True, exist_ok=True)
        real.rename(place)
        with contextlib.suppress(OSError):
            real.parent.rmdir()
        return place

    def discarded(self) -> list[Path]:
        """Return the discarded sessions, data sets, bundles, backups and protocols."""
        patterns = (f"{RECORDINGS}/*/*", *(f"{kind}/*" for kind in (DATASETS, BUNDLES, BACKUPS, PROTOCOLS)))
        return [path for pattern in patterns for path in sorted((self.folder / DISCARDED).glob(pattern))]

    def restore(self, path: Path) -> Path:
        """Move something discarded back to where it was, and return its path there.

        Raises:
            ConfigError: if it is not discarded, or there is something else in its place.
        """
        real = self._of_discarded(path)
        inside = real.relative_to(self.folder / DISCARDED)
        place = self.folder / inside.with_name(inside.name.partition(_COPY)[0])
        if place.exists():
            raise ConfigError("There is another “{name}” in its place. Rename or discard that first.", name=place.name)
        place.parent.mkdir(parents=True, exist_ok=True)
        real.rename(place)
        return place

    def delete(self, path: Path) -> None:
        """Delete something discarded for good; raise ConfigError if it is not discarded."""
        real = self._of_discarded(path)
        if real.is_dir():
            shutil.rmtree(real)
        else:
            real.unlink()

    def _of_discarded(self, path: Path) -> Path:
        real = self.inside(path)
        if real not in self.discarded():
            raise ConfigError("“{name}” is not among the discarded files any more.", name=real.name)
        return real

    def new(self, kind: str, name: str) -> Path:
        """Return the path for a new file or folder ``name`` in ``folder / kind``, without creating it.

        Raises:
            ConfigError: if ``name`` is not a plain file name, or exists already.
        """
        plain = self.check_name(name)
        place = self.inside(Path(kind) / plain)
        if place.exists():
            raise ConfigError(
                "“{name}” exists already. Give another name; nothing is replaced.", name=Path(plain).stem, field="name"
            )
        return place

    @staticmethod
    def check_name(name: str) -> str:
        """Return ``name`` without outer spaces; raise ConfigError if it is not a plain file name."""
        plain = name.strip()
        dotted = plain.startswith(".") or plain.endswith(".")
        if DEVICE_NAME.match(plain):
            raise ConfigError("“{name}” is reserved by Windows. Give another name.", name=plain, field="name")
        if not 0 < len(plain) <= 64 or dotted or _NOT_PLAIN.search(plain):
            raise ConfigError(
                "“{name}” cannot be a name. Use at most 64 letters, digits, spaces, points and hyphens.",
                name=name,
                field="name",
            )
        return plain

    def fitting(self, layout: str, simulated: bool) -> list[Path]:
        """Return the data sets to which recordings of a layout can be added.

        Args:
            simulated: whether the toy was a virtual one; real and simulated recordings are never mixed.
        """
        fitting = []
        for path in self.datasets():
            with contextlib.suppress(PlushSenseError, OSError):
                head = DatasetHead.read(path)
                if (head.layout.name, head.simulated) == (layout, simulated):
                    fitting.append(path)
        return fitting

    def free_name(self, kind: str, name: str, *suffixes: str, separator: str = "-", taken: Collection[str] = ()) -> str:
        """Return ``name``, numbered if it is in ``taken`` or exists in ``folder / kind`` with one of ``suffixes``."""
        free, number = name, 2
        while free in taken or any((self.folder / kind / f"{free}{s}").exists() for s in suffixes or ("",)):
            free, number = f"{name}{separator}{number}", number + 1
        return free

    def title(self, dataset: Path) -> str:
        """Return the name of a data set, or the name of its folder if the data set cannot be read."""
        try:
            stamps = file_stamps(dataset / _HEAD)
            # Cached: pages call this in the event loop for every data set.
            cached = self._titles.get(dataset)
            if cached is None or cached[0] != stamps:
                cached = self._titles[dataset] = (stamps, DatasetHead.read(dataset).name)
            return cached[1]
        except Exception:  # noqa: BLE001, RUF100
            return dataset.name


def refusal_of(cause: OSError) -> Message:
    """Return the sentence about an error of the operating system."""
    where = f" ('{cause.filename}')" if cause.filename else ""
    return Message("The computer refused: {why}{where}.", why=cause.strerror or str(cause), where=where)


def plain_name(text: str, default: str) -> str:
    """Turn a text into a name for `Workspace.new`: replace other characters by hyphens; if empty, use ``default``."""
    return _NOT_PLAIN.sub("-", text).strip(" .")[:56] or default


class ChangeSignal:
    """A signal that something changed: sent from any thread, delivered in the event loop of each subscriber."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._subscribers: dict[object, Callable[[], None]] = {}

    def notify(self) -> None:
        """Schedule the callbacks of all subscribers, without blocking."""
        with self._lock:
            subscribers = list(self._subscribers.values())
        for notify in subscribers:
            notify()

    def subscribe(
        self, callback: Callable[[], Any], loop: asyncio.AbstractEventLoop | None = None
    ) -> Callable[[], None]:
        """Call ``callback`` in ``loop`` (by default the running one) after each `notify`; return the unsubscriber.

        Notifications that arrive before the callback runs are merged into one call. Pages use
        `plushsense.studio.app.shell.on_change`, which unsubscribes when the page is closed.
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


def folder_digest(folder: Path) -> str:
    """Return a SHA-256 hash over the names and contents of all files in a folder."""
    total = hashlib.sha256()
    for path in list_package_files(folder):
        total.update(f"{path.relative_to(folder).as_posix()}\0{sha256_of(path)}\n".encode())
    return total.hexdigest()
