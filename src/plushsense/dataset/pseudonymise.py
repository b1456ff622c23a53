"""A data set under pseudonyms: a new folder with random codes and moved dates; the key stays outside.

What a sensor said is the same byte for byte; see `timeshift` for the rows, `rewording` for what people wrote,
`traces` for the last look. Caches, evaluations and files of no known kind are not taken along.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.folders import whole_folder
from plushsense.core.gestures import NOBODY
from plushsense.core.recfile import ReadResult, parse_name, read_recording, read_stream
from plushsense.core.signal import DEVICE_MS, HOST_MS, Layout
from plushsense.dataset.contents import Content, contents, folders_of_people, same_code
from plushsense.dataset.index import AGAIN, Progress, build, open_dataset, write
from plushsense.dataset.keyfile import KEPT, Pseudonym, extended, read_key, write_key
from plushsense.dataset.marks import MARKS
from plushsense.dataset.people import PEOPLE, read_people, write_people
from plushsense.dataset.rewording import (
    ORIGIN,
    Findings,
    Rewording,
    logins_in,
    read_lines,
    reworded_head,
    reworded_json,
    reworded_marks,
    reworded_people,
    subjects_in,
)
from plushsense.dataset.store import HEAD, RECORDINGS, STREAMS, Dataset, DatasetHead, RecordingInfo
from plushsense.dataset.timeshift import dated, shifted_rows
from plushsense.dataset.traces import traces
from plushsense.dataset.wording import Names

NAME = "[name]"
_SAME = "the same content as "
_SHOWN = 5


@dataclass
class Pseudonymised:
    """What came of it. ``findings`` are for a person to read: {file, line, message}, files by their new names."""

    dataset: Dataset
    files: int
    findings: list[dict[str, Any]]
    key: Path

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {
            "subjects": len(self.dataset.subjects),
            "recordings": len(self.dataset.recordings),
            "streams": len(self.dataset.streams),
            "files": self.files,
            "findings": self.findings,
            "key": str(self.key),
            "out": str(self.dataset.path),
        }

    def __repr__(self) -> str:
        return f"Pseudonymised({self.dataset!r}; {len(self.findings)} findings; the key is '{self.key}')"


def pseudonymise(
    dataset: str | Path,
    out: str | Path,
    *,
    key: str | Path,
    words: Iterable[str] = (),
    drop_notes: bool = False,
    progress: Progress | None = None,
) -> Pseudonymised:
    """Make a data set under pseudonyms at ``out``; the original is not touched.

    Args:
        key: the key file ``original,code,shift_s``, outside of both data sets. One that is there is added to, so that
            a person keeps the code of an earlier run.
        words: more that may not be left anywhere, such as first names; each becomes ``[name]``.
        drop_notes: leave out what people wrote freely (notes, the reasons of marks).
        progress: called with (raw files done, in all).

    Raises:
        DatasetError: for a key or an ``out`` in a wrong place, and when the last look still finds an old code or time;
            then nothing is left at ``out``.
    """
    folder, dest, key = Path(dataset), Path(out), Path(key)
    _refuse_places(folder, dest, key)
    source = open_dataset(folder)
    try:
        key.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(key.with_name(key.name + ".lock")):
            return _Work(folder, source, key, tuple(words), drop_notes, progress).run(dest)
    except OSError as cause:
        raise DatasetError(
            f"'{cause.filename or folder}' cannot be used ({cause.strerror or cause}): check the path and the disk."
        ) from None


def _refuse_places(folder: Path, dest: Path, key: Path) -> None:
    real, target, secret = folder.resolve(), dest.resolve(), key.resolve()
    if target == real or real in target.parents:
        raise DatasetError(f"'{dest}' lies in the data set '{folder}': give a new folder outside of it.")
    if secret.is_dir():
        raise DatasetError(f"'{key}' is a folder: --key names a file, such as {key / 'key.csv'}.")
    inside = next((p for p in secret.parents if p in (real, target) or (p / HEAD).is_file()), None)
    if inside is not None:
        raise DatasetError(
            f"The key file '{key}' would lie in the data set '{inside}': whoever gets the data would get the key too; "
            "keep it elsewhere."
        )


class _Work:
    """One run: who is who, and each file in turn."""

    def __init__(
        self,
        folder: Path,
        source: Dataset,
        key: Path,
        words: tuple[str, ...],
        drop_notes: bool,
        progress: Progress | None,
    ) -> None:
        self.folder, self.source, self.key, self.progress = folder, source, key, progress
        self.found = Findings()
        files = contents(folder)
        self.table = read_people(folder)
        self.people = folders_of_people(folder)
        self.people += [p for p in self.table if not same_code(p, self.people)]
        self.codes = extended(read_key(key), [*self.people, *(() if NOBODY in self.people else (NOBODY,))])
        roles: dict[str, str] = {}
        instead = {p.original: p.code for p in self.codes.values() if p.original not in KEPT}
        instead |= {w.strip(): NAME for w in words if w.strip()}
        for content in files:
            if content.kind not in ("words", "marks"):
                continue
            person = self._pseudonym(content.person) if content.person else None
            for _, value in read_lines(folder / content.path):
                for alias in subjects_in(value):
                    if person is not None and alias not in KEPT and person.original not in KEPT:
                        instead.setdefault(alias, person.code)
                for login in logins_in(value):
                    role = roles.setdefault(login.casefold(), f"person-{len(roles) + 1}")
                    instead.setdefault(login, role)
        self.names = Names(instead)
        self._rewordings = {
            p.original: Rewording(self.names, roles, p.code, p.shift_ms, self.found, drop_notes)
            for p in self.codes.values()
        }
        # Files are written in the order of the codes: their times on the disk must not tell the old order.
        self.files = sorted(files, key=lambda c: (self._pseudonym(c.person).code if c.person else "", c.path))
        if self.names.too_short:
            self.found.add("", f"too short to be looked for in texts: {_listed(self.names.too_short)}; read the notes")

    def _pseudonym(self, person: str) -> Pseudonym:
        return self.codes.get(person) or self.codes[same_code(person, self.people) or NOBODY]

    def _words(self, person: str) -> Rewording:
        return self._rewordings[self._pseudonym(person).original]

    def run(self, dest: Path) -> Pseudonymised:
        with whole_folder(dest, DatasetError, last=HEAD) as work:
            self.moved: dict[str, str] = {}
            times = self._raw_files(work)
            self._written_files(work)
            built = build(work, DatasetHead.read(work))
            made = built.dataset
            self._compare(made)
            write(made)
            old = [p for p in self.people if p not in KEPT]
            for file, what in traces(work, old, self.names, times):
                raise DatasetError(
                    f"'{file}' would still hold '{what}': nothing was made. Where that is a gesture's label or another "
                    "word of the data, rename the person or the gesture first; a file that should not be there, remove."
                )
            files = len(contents(work))
            write_key(self.key, self.codes)
        if self.found.prose:
            self.found.add("", f"{self.found.prose} notes in free words were kept: names are replaced, but read them")
        words = sorted({s for new in self.moved.values() for s in PurePosixPath(new).parts[2:-1] if _in_words(s)})
        if words:
            self.found.add(
                "",
                f"names of sessions that are words stay as they are: {_listed(words)}; where one tells who somebody "
                "is, put that word into --words",
            )
        result = Dataset(dest, made.head, made.recordings, made.streams)
        return Pseudonymised(result, files, self.found.told(), self.key)

    def _raw_files(self, work: Path) -> NDArray[np.int64]:
        """Rewrite the raw files, each checked against its original; returns every time that was in one."""
        raw = [c for c in self.files if c.kind == "raw"]
        times = [np.array([r.epoch_ms for r in self.source.recordings], dtype=np.int64)]
        for done, content in enumerate(raw, 1):
            old = self.folder / content.path
            new = self._place(content)
            self.moved[content.path.as_posix()] = new.as_posix()
            reader = read_stream if content.path.parts[0] == STREAMS else read_recording
            before = reader(old, self.source.layout)
            clocks = _dated_columns(before, self.source.layout)
            shift_ms = self._pseudonym(content.person).shift_ms
            target = work / new
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(shifted_rows(old.read_bytes(), self.source.layout, clocks, shift_ms, old))
            times += _clocks(before, clocks).values()
            if not _same(before, reader(target, self.source.layout), clocks, shift_ms):
                raise DatasetError(
                    f"The times in '{content.path}' cannot be moved without changing something else: nothing was made; "
                    "exclude the file or report it."
                )
            if self.progress is not None:
                self.progress(done, len(raw))
        return np.unique(np.concatenate([t[t >= 10**11] for t in times]))

    def _place(self, content: Content) -> PurePosixPath:
        """The new path of a file in a person's folder."""
        words = self._words(content.person)
        top, _, *between, name = content.path.parts
        inner = [words.text(part) for part in between]
        # A recording's label names a gesture, which is the same for everybody.
        named = words.name(name) if parse_name(PurePosixPath(name).stem + ".csv") else words.text(name)
        return PurePosixPath(top, words.code, *inner, named)

    def _written_files(self, work: Path) -> None:
        left: list[str] = []
        for content in self.files:
            path = self.folder / content.path
            if content.path.name == ORIGIN:
                self.found.add("", f"'{ORIGIN}' of a converted file was left out: it names the file that it came from")
            elif content.kind == "words" and content.person:
                new = self._place(content)
                text = reworded_json(path, new.as_posix(), self._words(content.person))
                if text is not None:
                    (work / new).parent.mkdir(parents=True, exist_ok=True)
                    (work / new).write_text(text, encoding="utf-8", newline="\n")
            elif content.kind == "marks":
                text = reworded_marks(path, self._words_of_id, self._renamed, self.found)
                (work / MARKS).write_text(text, encoding="utf-8", newline="\n")
            elif content.kind == "people":
                write_people(work, reworded_people(self.table.values(), self._words, PEOPLE))
            elif content.kind == "head":
                (work / HEAD).write_text(reworded_head(self.folder, self._words(NOBODY)), encoding="utf-8")
            elif content.kind in ("other", "link", "words"):
                left.append(content.path.as_posix())
        if left:
            self.found.add("", f"not taken along, nobody knows what is in them: {_listed(left)}")

    def _words_of_id(self, identity: str) -> Rewording | None:
        if not identity:
            return self._words(NOBODY)
        person = identity.partition("/")[0]
        return self._words(person) if same_code(person, self.people) else None

    def _renamed(self, identity: str) -> str:
        """The new id of a recording or a stream; "" is the data set."""
        if not identity:
            return ""
        for kind in (RECORDINGS, STREAMS):
            stem, mark, number = identity.partition("#")
            new = self.moved.get(f"{kind}/{stem}.csv")
            if new is not None:
                return PurePosixPath(*PurePosixPath(new).with_suffix("").parts[1:]).as_posix() + mark + number
        person, *between, name = identity.split("/")
        words = self._words(person)
        return "/".join([words.code, *(words.text(part) for part in between), words.name(name)])

    def _compare(self, made: Dataset) -> None:
        """Whether the new index says what the old one says, but for names and dates."""
        old = {self._renamed(r.id): r for r in self.source.recordings}
        new = {r.id: r for r in made.recordings}
        wrong = sorted(old.keys() ^ new.keys()) or [i for i in old if not self._agrees(old[i], new[i])]
        if wrong or len(made.streams) != len(self.source.streams):
            raise DatasetError(f"The new data set would not say the same as the old one ({_listed(wrong)}): report it.")
        across = [r for r in self.source.recordings for f in r.flags if f.startswith(_SAME)]
        lost = [r for r in across if not any(f.startswith(_SAME) for f in new[self._renamed(r.id)].flags)]
        if lost:
            self.found.add(
                "",
                f"{len(lost)} recordings have the same content as one of another person; with their dates moved apart "
                "that can no longer be seen: look into it in the original",
            )

    def _agrees(self, old: RecordingInfo, new: RecordingInfo) -> bool:
        def facts(r: RecordingInfo) -> tuple[Any, ...]:
            flags = [re.sub(r"\d{12,}", "", f) for f in r.flags if not f.startswith(_SAME)]
            return (
                r.gesture,
                r.first_row,
                r.rows,
                r.start,
                r.stop,
                r.stream_row,
                r.excluded,
                round(r.rate_hz, 3),
                flags,
            )

        stream = self._renamed(old.stream)
        return facts(old) == facts(new) and new.stream == stream


def _in_words(session: str) -> bool:
    """Whether a session's name is more than a number or a date; the importer's own names are not counted."""
    return not session.startswith(AGAIN) and re.search(r"[^\W\d_]{2}", session.removeprefix("session")) is not None


def _listed(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(f"'{n}'" for n in listed[:_SHOWN]) + (
        f" and {len(listed) - _SHOWN} more" if len(listed) > _SHOWN else ""
    )


def _clocks(read: ReadResult, columns: Iterable[str]) -> dict[str, NDArray[np.int64]]:
    held = {HOST_MS: read.frames.host_ms, DEVICE_MS: read.frames.device_ms}
    return {c: column for c in columns if (column := held[c]) is not None}


def _dated_columns(read: ReadResult, layout: Layout) -> tuple[str, ...]:
    """The time columns of a file that hold dates."""
    frames = read.frames
    own = DEVICE_MS in layout.csv.columns and not read.integrated
    held = ((HOST_MS, frames.host_ms), (DEVICE_MS, frames.device_ms if own else None))
    return tuple(name for name, column in held if column is not None and dated(column))


def _same(before: ReadResult, after: ReadResult, columns: tuple[str, ...], shift_ms: int) -> bool:
    """Whether two readings differ in nothing but the moved dates."""
    a, b = before.frames, after.frames
    if len(a) != len(b) or before.warnings != after.warnings or not np.array_equal(a.values, b.values):
        return False
    if (a.labels is None) != (b.labels is None) or (a.labels is not None and (a.labels != b.labels).any()):
        return False
    for name, old, new in ((HOST_MS, a.host_ms, b.host_ms), (DEVICE_MS, a.device_ms, b.device_ms)):
        if (old is None) != (new is None):
            return False
        if old is None or new is None:
            continue
        moved = np.where(old >= 10**11, old + shift_ms, old) if name in columns else old
        # What is no date in a column of dates is a piece of one, and became zeros.
        if not np.array_equal(moved[old >= 10**11], new[old >= 10**11]):
            return False
        if name not in columns and not np.array_equal(old, new):
            return False
    return True
