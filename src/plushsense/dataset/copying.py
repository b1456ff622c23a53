"""Copying raw files into a data set: unchanged, each under a name of its own, none twice."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from plushsense.core.errors import DatasetError
from plushsense.core.recfile import STREAM_NAME
from plushsense.dataset.index import AGAIN
from plushsense.dataset.sources import COMPANIONS, Found
from plushsense.dataset.store import STREAMS, UNKNOWN_SUBJECT
from plushsense.recording.sessionfile import SESSION_LOG

TWICE = "the same file was already imported"
ORPHAN = "belongs to '{}', which was not imported"
# What the recorder only ever writes on.
APPENDED = (STREAM_NAME, SESSION_LOG)
_LONGEST = 120
# Names that Windows keeps for devices, with any suffix.
DEVICE_NAME = re.compile(r"^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$)\s*(\.|$)", re.IGNORECASE)


def safe(code: str, otherwise: str = UNKNOWN_SUBJECT) -> str:
    """A code as a folder name that cannot leave the data set, on any system."""
    kept = "".join(c if c.isalnum() or c in "-_. " else "_" for c in code).strip(" .")
    return f"{kept}_" if DEVICE_NAME.match(kept) else kept or otherwise


def session_folder(session: str) -> str:
    """A session as a folder name, which can be none of those that keep files of one name apart."""
    name = safe(session, "1")
    return f"session-{name}" if name.startswith(AGAIN) else name


def refuse_merged(found: Iterable[Found], there: Iterable[str] = ()) -> None:
    """Refuse codes of people or sessions that become one folder name, rather than make one of two.

    ``there`` are the folders of people that a data set has already.
    """
    codes = {(folder.casefold(), ""): folder for folder in there}
    not_met = set(codes)
    said = [(f, "people", f.subject, safe(f.subject), "") for f in found]
    said += [(f, "sessions", f.session, session_folder(f.session), safe(f.subject)) for f, *_ in said if f.session]
    for _, what, code, folder, within in said:
        if len(folder.encode("utf-8")) > _LONGEST:
            raise DatasetError(f"The code '{code[:40]}…' is too long: codes of {what} have {_LONGEST} bytes at most.")
        key = (folder.casefold(), within)
        first = codes.setdefault(key, code)
        if key in not_met and first == folder:
            # What its code was before it became a folder is not known any more.
            not_met.discard(key)
            codes[key] = code
        elif first != code:
            raise DatasetError(
                f"The {what} '{first}' and '{code}' would share the folder '{folder}': rename one of them."
            )


class Copier:
    """Copies files below ``work``, which is or becomes (a part of) a data set.

    ``taken`` holds the SHA-256 by path below the data set, as file systems that ignore case see it: of raw files
    without suffix, for these are ids; of companions with it. ``contents`` are the raw files that are there already, by
    kind and SHA-256: these are not copied again. ``there`` is that data set's folder: a stream or a log in it that went
    on since becomes the longer one.
    """

    def __init__(
        self,
        work: Path,
        taken: Mapping[str, str] | None = None,
        contents: Mapping[tuple[str, str], str] | None = None,
        there: Path | None = None,
    ):
        self.work = work
        self.there = there
        self.grown: set[str] = set()
        """Paths below the data set of files that are there, shorter."""
        self.taken = dict(taken or {})
        self.contents = dict(contents or {})
        self.copied: dict[Path, str] = {}
        """New path below the data set of each source that was copied."""
        self.already: dict[Path, str] = {}
        """Path below the data set of each source that is there already."""
        self.companions: dict[str, list[Path]] = {}
        """Sources of the companions of each copied file."""

    def copy(self, found: Found) -> str:
        """Copy one file; a companion comes after the file that it belongs to. Returns "", or why it was not copied."""
        try:
            raw = found.source.read_bytes()
        except OSError as cause:
            return f"cannot be read: {cause.strerror or cause}"
        content = hashlib.sha256(raw).hexdigest()
        there = self.contents.get((found.kind, content))
        if there is not None:
            self.already[found.source] = there
            return ""
        folder = self._folder(found)
        if folder is None:
            return ORPHAN.format(found.beside.name if found.beside else "")
        companion = found.kind == COMPANIONS
        name = found.source.name
        place, again = folder, 1
        while (key := _key(f"{place}/{name}", companion)) in self.taken:
            if self.taken[key] == content:
                if companion or self.contents:
                    self.already[found.source] = f"{place}/{name}"
                    return ""
                return TWICE
            if (longer := self._goes_on(f"{place}/{name}", raw)) is not None:
                if not longer:
                    self.already[found.source] = f"{place}/{name}"
                    return ""
                self.grown.add(f"{place}/{name}")
                break
            again += 1
            place = f"{folder}/{AGAIN}{again}"
        self.taken[key] = content
        target = self.work / place / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(raw)
        self.copied[found.source] = f"{place}/{name}"
        if companion and found.beside is not None:
            self.companions.setdefault(self.copied.get(found.beside, ""), []).append(found.source)
        return ""

    def _goes_on(self, file: str, raw: bytes) -> bool | None:
        """Whether ``raw`` goes on where an append-only file that is there ends; False when that is the longer one.

        None when neither begins with the other. A last line that a crash tore does not count: the recorder ends it.
        """
        if self.there is None or file.rpartition("/")[2] not in APPENDED or file in self.grown:
            return None
        try:
            old = (self.there / file).read_bytes()
        except OSError:
            return None
        shorter, longer = sorted((old, raw), key=len)
        begins = shorter[: shorter.rfind(b"\n") + 1]
        return longer is raw if begins and longer.startswith(begins) else None

    def _folder(self, found: Found) -> str | None:
        """The folder of the data set that a file goes to; None for a companion whose file did not come."""
        if found.beside is not None:
            main = self.copied.get(found.beside) or self.already.get(found.beside)
            return None if main is None else main.rpartition("/")[0]
        kind = STREAMS if found.kind == COMPANIONS else found.kind
        folder = f"{kind}/{safe(found.subject)}"
        return f"{folder}/{session_folder(found.session)}" if found.session else folder


def _key(path: str, companion: bool) -> str:
    folder, _, name = path.casefold().rpartition("/")
    return f"{folder}/{name}/" if companion else f"{folder}/{name.rpartition('.')[0]}"


def key_of(path: str, *, companion: bool) -> str:
    """The key in `Copier.taken` of a file by its path below the data set."""
    return _key(path, companion)
