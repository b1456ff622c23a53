"""Copy a data set with random codes of people and shifted dates; the key file stays outside of the copy.

Sensor values stay the same byte for byte. `pseudonyms` shifts the dates in the rows, `redaction` rewrites texts, and
`find_traces` searches the copy for original codes, words and times. Caches, evaluations and unknown files are left out.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from plushsense.core.errors import DatasetError
from plushsense.core.files import new_folder
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import DEVICE_MS, HOST_MS, Layout
from plushsense.core.recorder_csv import ReadResult, parse_name, read_recording, read_stream
from plushsense.core.sentences import Message
from plushsense.dataset.files import STAMP, DatasetFile, list_files, match_code, person_folders
from plushsense.dataset.index import DUPLICATE_FOLDER, build_index, open_dataset, write_index_files
from plushsense.dataset.marks import MARKS
from plushsense.dataset.privacy.pseudonyms import (
    KEPT,
    Pseudonym,
    dates_in,
    extend_key,
    holds_dates,
    read_key,
    shifted_rows,
    write_key,
)
from plushsense.dataset.privacy.redaction import (
    ORIGIN,
    NamePatterns,
    Redactor,
    ReviewNotes,
    logins_in,
    read_lines,
    redact_head,
    redact_json,
    redact_marks,
    redact_people,
    subject_in,
    words_of_rows,
)
from plushsense.dataset.store import (
    HEAD,
    PEOPLE,
    RECORDINGS,
    STREAMS,
    Dataset,
    DatasetHead,
    Progress,
    RecordingInfo,
    read_people,
    write_people,
)

NAME = "[name]"
_SAME = "the same content as "
_SHOWN = 5


@dataclass
class PseudonymisationResult:
    """Result of pseudonymising; ``findings`` {file, line, message}, with new file names, need review by a person."""

    dataset: Dataset
    files: int
    findings: list[dict[str, Any]]
    key: Path

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
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
) -> PseudonymisationResult:
    """Create a pseudonymised copy of a data set at ``out``; the original is not changed.

    Args:
        key: the key file ``original,code,shift_s``, outside of both data sets. An existing one is extended, so that a
            person keeps the code of an earlier run.
        words: additional words to replace everywhere by ``[name]``, such as first names.
        drop_notes: whether to leave out free text (notes, the reasons of marks).
        progress: called with (raw files done, number of raw files).

    Raises:
        DatasetError: if ``key`` or ``out`` is in a data set, or the copy would still contain an original code or time;
            then nothing is left at ``out``.
    """
    folder, dest, key = Path(dataset), Path(out), Path(key)
    _refuse_places(folder, dest, key)
    source = open_dataset(folder)
    try:
        key.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(key.with_name(key.name + ".lock")):
            return _Pseudonymisation(source, key, words, drop_notes, progress).run(dest)
    except OSError as cause:
        raise DatasetError(
            "'{file}' cannot be used ({why}): check the path and the disk.",
            file=cause.filename or folder,
            why=cause.strerror or cause,
            name=folder.name,
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
            f"The key file '{key}' would lie in the data set '{inside}' and leave with it: choose a place outside."
        )


class _Pseudonymisation:
    """One run of `pseudonymise`, with the codes of all people; rewrites the files one by one."""

    def __init__(
        self,
        source: Dataset,
        key: Path,
        words: Iterable[str],
        drop_notes: bool,
        progress: Progress | None,
    ) -> None:
        folder = self.folder = source.path
        self.source, self.key, self.progress = source, key, progress
        self.notes = ReviewNotes()
        files = list_files(folder)
        self.table = read_people(folder)
        self.people = person_folders(folder)
        self.people += [p for p in self.table if not match_code(p, self.people)]
        self.codes = extend_key(read_key(key), [*self.people, *(() if NOBODY in self.people else (NOBODY,))])
        roles: dict[str, str] = {}
        instead = {p.original: p.code for p in self.codes.values() if p.original not in KEPT}
        instead |= {w.strip(): NAME for w in words if w.strip()}
        for content in files:
            if content.kind not in ("words", "marks"):
                continue
            person = self._pseudonym(content.person) if content.person else None
            for _, value in read_lines(folder / content.path):
                alias = subject_in(value)
                if alias and person is not None and alias not in KEPT and person.original not in KEPT:
                    instead.setdefault(alias, person.code)
                for login in logins_in(value):
                    instead.setdefault(login, roles.setdefault(login.casefold(), f"person-{len(roles) + 1}"))
        self.names = NamePatterns(instead)
        self._rewordings = {
            p.original: Redactor(self.names, roles, p.code, p.shift_ms, self.notes, drop_notes)
            for p in self.codes.values()
        }
        # Write in the order of the new codes, so that the times of files do not reveal the old order.
        self.files = sorted(files, key=lambda c: (self._pseudonym(c.person).code if c.person else "", c.path))
        if self.names.too_short:
            listed = _listed(self.names.too_short)
            self.notes.add("", Message("too short to be searched in texts: {listed}; read the notes", listed=listed))

    def _pseudonym(self, person: str) -> Pseudonym:
        return self.codes.get(person) or self.codes[match_code(person, self.people) or NOBODY]

    def _words(self, person: str) -> Redactor:
        return self._rewordings[self._pseudonym(person).original]

    def run(self, dest: Path) -> PseudonymisationResult:
        with new_folder(dest, DatasetError, last=HEAD, finishing=self._finishing) as work:
            self.moved: dict[str, str] = {}
            times = self._raw_files(work)
            self._written_files(work)
            built = build_index(work, DatasetHead.read(work))
            made = built.dataset
            self._compare(made)
            write_index_files(made)
            old = [p for p in self.people if p not in KEPT]
            for file, name in find_traces(work, old, self.names, times):
                raise DatasetError(
                    "'{file}' would still hold '{name}': nothing was written. If that is a gesture or another word "
                    "of the data, rename the person or the gesture first; if the file does not belong there, remove "
                    "it.",
                    file=file,
                    name=name,
                )
            files = len(list_files(work))
        if self.notes.prose:
            self.notes.add(
                "", Message("{n} notes in free text were kept: names are replaced, but read them", n=self.notes.prose)
            )
        words = sorted({s for new in self.moved.values() for s in PurePosixPath(new).parts[2:-1] if _in_words(s)})
        if words:
            listed = _listed(words)
            self.notes.add(
                "",
                Message(
                    "names of sessions that are words stay as they are: {listed}; if one identifies a person, add it "
                    "to --words",
                    listed=listed,
                ),
            )
        result = Dataset(dest, made.head, made.recordings, made.streams)
        return PseudonymisationResult(result, files, self.notes.merged(), self.key)

    @contextmanager
    def _finishing(self) -> Iterator[None]:
        with self.source.generation.writing():
            write_key(self.key, self.codes)
            yield

    def _raw_files(self, work: Path) -> NDArray[np.int64]:
        """Rewrite the raw files and compare each with its original; return every original time in them."""
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
            times += clocks.values()
            if not _same(before, reader(target, self.source.layout), clocks, shift_ms):
                raise DatasetError(
                    "The times in '{file}' cannot be shifted alone, so nothing was written: exclude it.",
                    file=content.path,
                )
            if self.progress is not None:
                self.progress(done, len(raw))
        return np.unique(np.concatenate([t[t >= 10**11] for t in times]))

    def _place(self, content: DatasetFile) -> PurePosixPath:
        """Return the new path of a file in a person's folder."""
        words = self._words(content.person)
        top, _, *between, name = content.path.parts
        inner = [words.text(part) for part in between]
        # The label of a recording is a gesture, which is no personal data.
        named = words.name(name) if parse_name(PurePosixPath(name).stem + ".csv") else words.text(name)
        return PurePosixPath(top, words.code, *inner, named)

    def _written_files(self, work: Path) -> None:
        left: list[str] = []
        for content in self.files:
            path = self.folder / content.path
            if content.path.name == ORIGIN:
                self.notes.add(
                    "",
                    Message(
                        "'{file}' of a converted file was left out: it names the file that it came from", file=ORIGIN
                    ),
                )
            elif content.kind == "words" and content.person:
                new = self._place(content)
                text = redact_json(path, new.as_posix(), self._words(content.person))
                if text is not None:
                    (work / new).parent.mkdir(parents=True, exist_ok=True)
                    (work / new).write_text(text, encoding="utf-8", newline="\n")
            elif content.kind == "marks":
                text = redact_marks(path, self._words_of_id, self._renamed, self.notes)
                (work / MARKS).write_text(text, encoding="utf-8", newline="\n")
            elif content.kind == "people":
                write_people(work, redact_people(self.table.values(), self._words, PEOPLE))
            elif content.kind == "head":
                (work / HEAD).write_text(redact_head(self.folder, self._words(NOBODY)), encoding="utf-8")
            elif content.kind in ("other", "link", "words"):
                left.append(content.path.as_posix())
        if left:
            self.notes.add(
                "", Message("not copied, since their contents are not known: {listed}", listed=_listed(left))
            )

    def _words_of_id(self, identity: str) -> Redactor | None:
        if not identity:
            return self._words(NOBODY)
        person = identity.partition("/")[0]
        return self._words(person) if match_code(person, self.people) else None

    def _renamed(self, identity: str) -> str:
        """Return the new id of a recording, stream or person; "" for the data set."""
        if not identity:
            return ""
        for kind in (RECORDINGS, STREAMS):
            stem, mark, number = identity.partition("#")
            new = self.moved.get(f"{kind}/{stem}.csv")
            if new is not None:
                return PurePosixPath(*PurePosixPath(new).with_suffix("").parts[1:]).as_posix() + mark + number
        person, *rest = identity.split("/")
        words = self._words(person)
        return "/".join([words.code, *map(words.text, rest[:-1]), *map(words.name, rest[-1:])])

    def _compare(self, made: Dataset) -> None:
        """Raise DatasetError unless the new index equals the old one except for names and dates."""
        old = {self._renamed(r.id): r for r in self.source.recordings}
        new = {r.id: r for r in made.recordings}
        wrong = sorted(old.keys() ^ new.keys()) or [i for i in old if not self._agrees(old[i], new[i])]
        if wrong or len(made.streams) != len(self.source.streams):
            raise DatasetError(
                "The new data set would differ from the old one ({listed}): report it.", listed=_listed(wrong)
            )
        across = [r for r in self.source.recordings for f in r.flags if f.startswith(_SAME)]
        lost = [r for r in across if not any(f.startswith(_SAME) for f in new[self._renamed(r.id)].flags)]
        if lost:
            self.notes.add(
                "",
                Message(
                    "{n} recordings have the same content as one of another person, which their different shifts of "
                    "time now hide: check them in the original",
                    n=len(lost),
                ),
            )

    def _agrees(self, old: RecordingInfo, new: RecordingInfo) -> bool:
        def facts(r: RecordingInfo) -> tuple[Any, ...]:
            flags = [re.sub(r"\d{12,}", "", f) for f in r.flags if not f.startswith(_SAME)]
            keys = ("gesture", "first_row", "rows", "start", "stop", "stream_row", "excluded")
            return *(getattr(r, key) for key in keys), round(r.rate_hz, 3), flags

        return facts(old) == facts(new) and new.stream == self._renamed(old.stream)


def _in_words(session: str) -> bool:
    """Return whether a session's name contains a word and was not made by the importer."""
    return (
        not session.startswith(DUPLICATE_FOLDER)
        and re.search(r"[^\W\d_]{2}", session.removeprefix("session")) is not None
    )


def _listed(names: Iterable[str]) -> str:
    listed = list(names)
    more = f", … (+{len(listed) - _SHOWN})" if len(listed) > _SHOWN else ""
    return ", ".join(f"'{n}'" for n in listed[:_SHOWN]) + more


def _dated_columns(read: ReadResult, layout: Layout) -> dict[str, NDArray[np.int64]]:
    """Return the time columns of a file that contain dates, by name."""
    device_ms = None if read.integrated or DEVICE_MS not in layout.csv.columns else read.frames.device_ms
    columns = {HOST_MS: read.frames.host_ms, DEVICE_MS: device_ms}
    return {name: column for name, column in columns.items() if column is not None and holds_dates(column)}


def _same(before: ReadResult, after: ReadResult, columns: Collection[str], shift_ms: int) -> bool:
    """Return whether two files, as read, differ only in the shifted dates of ``columns``."""
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
        # Other values in a column of dates are fragments of dates, which became zeros.
        if not np.array_equal(moved[old >= 10**11], new[old >= 10**11]):
            return False
        if name not in columns and not np.array_equal(old, new):
            return False
    return True


_TIMES = re.compile(rb"(?<![0-9A-Za-z.])\d{12,14}(?![0-9A-Za-z])")


def find_traces(
    folder: Path, originals: Iterable[str], names: NamePatterns, times: NDArray[np.int64]
) -> Iterator[tuple[str, str]]:
    """Find original codes, words, times and dates that are still in ``folder``; yield (file, text) for each.

    Args:
        originals: the original codes, which must not be folders of people.
        names: patterns of the words that no file may contain.
        times: every time in the original files, in ms since 1970.
    """
    old = set(originals)
    known = np.unique(times)
    for content in list_files(folder):
        path = content.path.as_posix()
        # The title of a layout may resemble a code, so compare codes with folders only.
        if content.person in old:
            yield path, content.person
        for trace in (*names.find_in(path), *dates_in(path)):
            yield path, trace
        data = (folder / path).read_bytes()
        stamps = np.array(_TIMES.findall(data), dtype="S14").astype(np.int64)
        at = np.searchsorted(known, stamps).clip(max=max(len(known) - 1, 0))
        for stamp in sorted(set(stamps[known[at] == stamps].tolist())) if len(known) else ():
            yield path, str(stamp)
        if content.kind == "raw":
            found_in = names.find_in(words_of_rows(data))
        else:
            text = data.decode("utf-8", "replace")
            # The stamp of the index contains the times at which the new files were written.
            found_in = [*names.find_in(text), *(() if content.path.name == STAMP else dates_in(text))]
        for trace in dict.fromkeys(found_in):
            yield path, trace
