"""Create a data set from a scanned source, or add to one: copy the files, read the copies, account for every file.

Raw files are copied unchanged. Existing files, marks and class numbers stay as they are.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from filelock import Timeout

from plushsense.core.errors import DatasetError
from plushsense.core.files import new_folder, write_file
from plushsense.core.gestures import NOBODY, GestureSet, alike_labels
from plushsense.core.recorder_csv import STREAM_NAME, parse_name
from plushsense.core.sentences import Message, join_names
from plushsense.dataset.files import CACHE, sha256_of, walk_files
from plushsense.dataset.importing.results import (
    NO_PEOPLE,
    NO_PEOPLE_OF_WINDOWS,
    SIMULATED,
    FileReason,
    ImportResult,
    group_flags,
)
from plushsense.dataset.importing.sources import (
    COMPANIONS,
    LEFT_OUT,
    PATTERN,
    WINDOWS,
    SourceFile,
    SourceScan,
    folder_name,
)
from plushsense.dataset.importing.truncation import IMPORTER, truncation_marks
from plushsense.dataset.index import (
    DUPLICATE_FOLDER,
    IndexBuild,
    apply_marks,
    build_index,
    open_dataset,
    rebuild_index,
    write_index_files,
)
from plushsense.dataset.marks import RECORDER, Mark, MarkState, adding_locked, append_marks, read_marks, write_marks
from plushsense.dataset.privacy.forget import read_removals
from plushsense.dataset.privacy.removed import remembers_removed
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    STREAMS,
    UNKNOWN_SUBJECT,
    Dataset,
    DatasetHead,
    Generation,
    PersonInfo,
    Progress,
    RecordingInfo,
    read_people,
    write_people,
)
from plushsense.recording.writer import SESSION_LOG

TWICE = Message("the same file was already imported")
# Files to which the recorder only appends.
APPENDED = (STREAM_NAME, SESSION_LOG)
_LONGEST = 120


def session_folder(session: str) -> str:
    """Return a folder name for ``session`` that differs from the folders for files of the same name (``again-2``)."""
    name = folder_name(session, "1")
    return f"session-{name}" if name.startswith(DUPLICATE_FOLDER) else name


def refuse_merged(files: Sequence[SourceFile], there: Iterable[str] = ()) -> None:
    """Raise DatasetError if codes of people or sessions are too long, or would get the same folder name.

    ``there`` are the folders of people in the existing data set.
    """
    codes = {(folder.casefold(), ""): folder for folder in there}
    not_met = set(codes)
    folders = [("people", f.subject, folder_name(f.subject), "") for f in files]
    folders += [("sessions", f.session, session_folder(f.session), folder_name(f.subject)) for f in files if f.session]
    for kind, code, folder, within in folders:
        if len(folder.encode("utf-8")) > _LONGEST:
            raise DatasetError(
                "The code '{begin}…' is too long: codes of {kind} have {longest} bytes at most.",
                begin=code[:40],
                kind=kind,
                longest=_LONGEST,
                code=f"{code[:40]}…",
            )
        key = (folder.casefold(), within)
        first = codes.setdefault(key, code)
        if key in not_met and first == folder:
            # The code behind an existing folder is unknown: assume that it is the first one that matches.
            not_met.discard(key)
            codes[key] = code
        elif first != code:
            raise DatasetError(
                "The {kind} '{a}' and '{b}' would share the folder '{folder}': rename one of them.",
                kind=kind,
                a=first,
                b=code,
                folder=folder,
            )


class ImportedFiles:
    """Files of a scan, copied into the folder ``work``, which becomes a data set or part of one, and their status.

    Attributes:
        kept: the copied files by their new path below the data set.
        already: path below the data set of each source that exists already.
        grown: paths of existing streams and logs of which the source has a longer version, which replaces them.
        rejected: files that cannot be used.
        left_out: files that are not needed.
    """

    def __init__(self, scan: SourceScan, work: Path, existing: Dataset | None = None):
        self.scan, self.work = scan, work
        self.kept: dict[str, SourceFile] = {}
        self.already: dict[Path, str] = {}
        self.grown: set[str] = set()
        self.rejected: list[FileReason] = []
        self.left_out: list[FileReason] = []
        self._there = existing.path if existing is not None else None
        self._copied: dict[Path, str] = {}
        # SHA-256 of each file of the data set, by `_key_of`; and paths of existing raw files by kind and SHA-256.
        self._taken: dict[str, str] = {}
        self._contents: dict[tuple[str, str], str] = {}
        if existing is not None:
            self._take(existing)
        # Raw files lie in recordings/<person>/ and streams/<person>/.
        people = {Path(file).parts[1] for file in self._contents.values() if len(Path(file).parts) > 2}
        refuse_merged([f for f in scan.found if f.kind in (RECORDINGS, STREAMS)], people)
        # Companions come last, since they are copied beside their files.
        for found in sorted(scan.found, key=lambda f: f.kind == COMPANIONS):
            if found.kind == LEFT_OUT:
                self.left_out.append(FileReason(found.origin, found.reason))
            elif not found.kind:
                self.reject(found, found.reason)
            elif reason := self._copy(found):
                self.reject(found, reason)

    def _take(self, existing: Dataset) -> None:
        """Note the files of the existing data set, which are not copied again."""
        for kind, infos in ((RECORDINGS, existing.recordings), (STREAMS, existing.streams)):
            for info in infos:
                # Recordings that are parts of a stream have no file of their own.
                if info.file.startswith(f"{kind}/"):
                    self._taken[_key_of(info.file, companion=False)] = info.sha256
                    self._contents[(kind, info.sha256)] = info.file
        for path in (*walk_files(existing.path / RECORDINGS), *walk_files(existing.path / STREAMS)):
            if path.suffix.lower() != ".csv":
                key = _key_of(path.relative_to(existing.path).as_posix(), companion=True)
                self._taken[key] = sha256_of(path)

    def _copy(self, file: SourceFile) -> str:
        """Copy a file and return "", or the reason why not; companions must come after the file they belong to."""
        try:
            raw = file.source.read_bytes()
        except OSError as cause:
            return Message("cannot be read: {why}", why=cause.strerror or cause)
        content = hashlib.sha256(raw).hexdigest()
        existing = self._contents.get((file.kind, content))
        if existing is not None:
            self.already[file.source] = existing
            return ""
        folder = self._folder(file)
        if folder is None:
            return _orphan(file.beside.name if file.beside else "")
        companion = file.kind == COMPANIONS
        name = file.source.name
        place, again = folder, 1
        while (key := _key_of(f"{place}/{name}", companion=companion)) in self._taken:
            target = f"{place}/{name}"
            if self._taken[key] == content and not (companion or self._contents):
                return TWICE
            longer = None if self._taken[key] == content else self._continues(target, raw)
            if longer is False or self._taken[key] == content:
                self.already[file.source] = target
                return ""
            if longer:
                self.grown.add(target)
                break
            again += 1
            place = f"{folder}/{DUPLICATE_FOLDER}{again}"
        self._taken[key] = content
        path = self.work / place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(raw)
        self._copied[file.source] = f"{place}/{name}"
        self.kept[f"{place}/{name}"] = file
        return ""

    def _continues(self, file: str, raw: bytes) -> bool | None:
        """Return True if ``raw`` continues an existing append-only file, False for the reverse, None for neither.

        An incomplete last line is ignored, since the recorder completes it.
        """
        if self._there is None or file.rpartition("/")[2] not in APPENDED or file in self.grown:
            return None
        try:
            old = (self._there / file).read_bytes()
        except OSError:
            return None
        shorter, longer = sorted((old, raw), key=len)
        begins = shorter[: shorter.rfind(b"\n") + 1]
        return longer is raw if begins and longer.startswith(begins) else None

    def _folder(self, file: SourceFile) -> str | None:
        """Return the destination folder of a file; None for a companion whose file was not copied."""
        if file.beside is not None:
            main = self._copied.get(file.beside) or self.already.get(file.beside)
            return None if main is None else main.rpartition("/")[0]
        folder = f"{STREAMS if file.kind == COMPANIONS else file.kind}/{folder_name(file.subject)}"
        return f"{folder}/{session_folder(file.session)}" if file.session else folder

    def reject(self, file: SourceFile, reason: str) -> None:
        self.rejected.append(FileReason(file.origin, reason))

    def read(self, head: DatasetHead, progress: Progress | None) -> IndexBuild:
        """Build the index of the copied files; remove those that cannot be read, with their companions."""
        built = build_index(self.work, head, progress)
        for file, reason in built.unreadable.items():
            main = self.kept[file]
            self._drop(file, reason)
            for companion in [f for f, found in self.kept.items() if found.beside == main.source]:
                self._drop(companion, _orphan(Path(file).name))
        return built

    def _drop(self, file: str, reason: str) -> None:
        found = self.kept.pop(file)
        self.reject(found, reason)
        (self.work / file).unlink()
        del self._copied[found.source]

    @property
    def places(self) -> dict[Path, str]:
        """Path below the data set of each source that was copied or existed already."""
        return self.already | self._copied

    def check(self) -> None:
        """Assert that every file of the scan was copied, exists already, or is rejected or left out."""
        accounted = len(self.kept) + len(self.already) + len(self.rejected) + len(self.left_out)
        assert accounted == len(self.scan.found), "every source file is imported, left out or rejected"

    def marks(
        self, recordings: Sequence[RecordingInfo], gestures: GestureSet, states: Mapping[str, MarkState]
    ) -> tuple[list[Mark], list[Mark], list[str]]:
        """Return the trims of the truncation script, the labels of folders, and notes; decisions in ``states`` stay.

        Args:
            recordings: recordings of the data set.
            gestures: the gesture set of the data set.
        """
        sources = {file: path for path, file in self.places.items()}
        trims, notes = truncation_marks(self.scan.choices, recordings, sources, states)
        folders = {f.source: f.gesture for f in self.scan.found}
        labels = []
        for info in recordings:
            source = sources.get(info.file)
            now = states.get(info.id, MarkState())
            if source is None or source not in folders or now.gesture_by not in ("", IMPORTER):
                continue
            label = folders[source]
            known = gestures.find(label)
            label = known.label if known is not None else label
            if label and label != now.gesture:
                why = f"the file lies in the folder '{label}', though its name says '{info.recorded}'"
                labels.append(Mark(info.id, "relabel", IMPORTER, why, gesture=label))
            elif not label and now.gesture and gestures.find(source.parent.name) is not None:
                why = f"the file lies in the folder '{info.recorded}' again, as its name says"
                labels.append(Mark(info.id, "relabel", IMPORTER, why))
        return trims, labels, notes

    def discarded(self) -> dict[str, str]:
        """Return for each recording id, also of existing files, why the recorder discarded it ("" if it did not)."""
        places = self.places
        mine = (f for f in self.scan.found if f.kind == RECORDINGS and f.source in places)
        return {places[f.source].removeprefix(f"{RECORDINGS}/").rpartition(".")[0]: f.set_aside for f in mine}

    def result(self, dataset: Dataset, notes: Sequence[str], trims: int) -> ImportResult:
        """Return the result of the import, of which ``dataset`` is the data set."""
        # A scan by a pattern, or in streams, has a note on people already.
        noted = self.scan.shape == PATTERN or self.scan.streams_named
        unknown = not noted and any(r.subject == UNKNOWN_SUBJECT for r in dataset.recordings)
        new = [r for r in dataset.recordings if r.file in self.kept]
        flagged = [s for s in dataset.streams if s.file in self.kept] + new
        kinds = Counter(f.kind for f in self.kept.values())
        return ImportResult(
            dataset,
            tuple(self.rejected),
            tuple(self.left_out),
            tuple(group_flags((info.id, flag) for info in flagged for flag in info.flags)),
            (
                *([SIMULATED] if dataset.head.simulated else ()),
                *notes,
                *([_no_people(dataset, self.scan.shape)] if unknown else ()),
            ),
            companions=kinds[COMPANIONS],
            excluded=sum(r.excluded for r in new),
            added_recordings=len(new),
            added_streams=kinds[STREAMS],
            already_there=len(self.already),
            trimmed=trims,
        )


def _orphan(name: str) -> Message:
    """Return the reason to refuse a companion of the file ``name``, which was not imported."""
    return Message("belongs to '{name}', which was not imported", name=name)


def _key_of(path: str, *, companion: bool) -> str:
    """Return a path as it is compared with others: case-folded, that of a raw file without suffix, as its id."""
    folder, _, name = path.casefold().rpartition("/")
    return f"{folder}/{name}/" if companion else f"{folder}/{name.rpartition('.')[0]}"


def label_notes(given: GestureSet | None, labels: Iterable[str]) -> Iterator[Message]:
    """Yield warnings about labels that look idle or alike, and about those that a given set lacks."""
    counts = Counter(labels)
    if given is None:
        for gesture in GestureSet.infer(counts).gestures:
            if gesture.idle:
                yield Message(
                    "'{label}' counts as idle by its name, and never starts an event: if the toy is touched in these "
                    "recordings, rename them, or give --gestures a set that has it",
                    label=gesture.label,
                )
    known = () if given is None or given.inferred else given.labels
    lacks = [label for label in counts if given is not None and known and given.find(label) is None]
    for group in alike_labels((*known, *counts)):
        if known and not set(group) & set(lacks):
            continue
        # A label of the set comes first: the others are spellings of it.
        first, *others = sorted(group, key=lambda label: (label not in known, -counts[label]))
        yield Message(
            "{labels} look like spellings of one gesture, but become {n}: if they are one, rename the files, or give "
            "--gestures a set in which the gesture '{first}' has  labels = {others}",
            labels=", ".join(f"'{label}' ({counts[label]})" for label in group),
            n=len(group),
            first=first,
            others=json.dumps(others, ensure_ascii=False),
        )
    if lacks and given is not None:
        listed = ", ".join(f"'{label}' ({counts[label]})" for label in sorted(lacks, key=lambda k: -counts[k])[:8])
        yield Message(
            "the gesture set '{set}' has no gesture {labels}: such recordings become gestures without affect; give "
            "other spellings as aliases of a pattern, or a gesture set that has them",
            set=given.name,
            labels=listed + (", …" if len(lacks) > 8 else ""),
        )


def _extend_gestures(given: GestureSet | None, dataset: Dataset) -> GestureSet:
    """Return ``given`` with the labels that it lacks, or infer a set from the recordings if it is None."""
    if given is None:
        return GestureSet.infer(r.gesture for r in dataset.recordings)
    unknown = sorted(r.gesture for r in dataset.recordings if given.find(r.gesture) is None)
    if not unknown:
        return given
    return GestureSet(given.name, given.gestures + GestureSet.infer(unknown).gestures, given.inferred)


def _merge_people(
    there: Mapping[str, PersonInfo], sessions: Iterable[PersonInfo], file: Mapping[str, PersonInfo], subjects: set[str]
) -> tuple[list[PersonInfo], list[str]]:
    """Merge the people ``there`` with ``sessions``, which fill gaps, and the user's ``file``, which overrides both."""
    keys = ("age_group", "gender", "consent")
    people = dict(there)
    notes: list[str] = []
    for info in sessions:
        code = folder_name(info.subject)
        if code == NOBODY:
            continue
        known = people.get(code, PersonInfo(code))
        for key in keys:
            new, old = getattr(info, key), getattr(known, key)
            if new and old and new != old:
                notes.append(
                    Message(
                        "the {key} of '{person}' is kept as '{old}'; a session states '{new}'",
                        key=key.replace("_", " "),
                        person=code,
                        old=old,
                        new=new,
                    )
                )
        values = {key: getattr(known, key) or getattr(info, key) for key in keys}
        people[code] = replace(known, **values, more=info.more | known.more)
    strangers = [code for code in file if folder_name(code) not in subjects]
    for info in file.values():
        code = folder_name(info.subject)
        if code in subjects:
            known = people.get(code, PersonInfo(code))
            values = {key: getattr(info, key) or getattr(known, key) for key in keys}
            people[code] = PersonInfo(code, **values, more=known.more | info.more)
    if strangers:
        notes.append(
            f"people of the people's file who are not in the data set were left out ({len(strangers)}): "
            + ", ".join(f"'{s}'" for s in strangers[:5])
            + (", …" if len(strangers) > 5 else "")
        )
    return list(people.values()), notes


def _no_people(dataset: Dataset, shape: str) -> str:
    """Return the note that the people of some recordings, or of all, are not known."""
    if shape == WINDOWS:
        return NO_PEOPLE_OF_WINDOWS
    if not dataset.subjects:
        return NO_PEOPLE
    n, of = sum(r.subject == UNKNOWN_SUBJECT for r in dataset.recordings), len(dataset.recordings)
    return Message(
        "the people of {n} of {of:recording} are not known, because their folders are gestures: splits by subject "
        "are not possible; move them to the folders of their people, or import again with --subjects map.csv "
        "(columns file,subject)",
        n=n,
        of=of,
    )


def create_dataset(
    source: Path,
    dest: Path,
    scan: SourceScan,
    head: DatasetHead,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
) -> ImportResult:
    """Create the data set ``dest`` from a scan, completely or not at all.

    Raises:
        DatasetError: if no recording can be read, or ``dest`` is not empty.
    """
    with new_folder(dest, DatasetError, last=HEAD) as work:
        files = ImportedFiles(scan, work)
        if scan.gestures is None:
            names = (parse_name(Path(file).name) for file in files.kept)
            head = replace(head, gestures=GestureSet.infer(n.label for n in names if n is not None))
        built = files.read(head, progress)
        if not built.dataset.recordings:
            raise _nothing_read(source, files, built, head)
        virtual = [] if head.simulated or not built.virtual else [_virtual_note(built)]
        gestures = _extend_gestures(scan.gestures, built.dataset)
        head = replace(head, gestures=gestures, simulated=head.simulated or built.virtual > 0)
        if {r.gesture for r in built.dataset.recordings} - set(gestures.labels):
            # The set merges spellings of labels: build the index again with the complete set.
            built = build_index(work, head)
        listed, notes = _merge_people({}, scan.people, people, {r.subject for r in built.dataset.recordings})
        if listed:
            write_people(work, listed)
        trims, labels, remarks = files.marks(built.dataset.recordings, gestures, {})
        marks = [Mark(i, "exclude", RECORDER, why) for i, why in files.discarded().items() if why]
        append_marks(work, marks + trims + labels)
        (work / HEAD).write_text(head.to_toml(), encoding="utf-8")
        infos = apply_marks(built.dataset.recordings, read_marks(work), gestures)
        write_index_files(Dataset(work, head, infos, built.dataset.streams))
        files.check()
    notes += label_notes(scan.gestures, (r.gesture for r in infos))
    dataset = Dataset(dest, head, infos, built.dataset.streams)
    return files.result(dataset, virtual + scan.notes + notes + remarks, len(trims))


def _nothing_read(source: Path, files: ImportedFiles, built: IndexBuild, head: DatasetHead) -> DatasetError:
    """Return the error that no recording of a source can be read."""
    # What is wrong with the recordings, rather than with a stream.
    unreadable = sorted(built.unreadable.items(), key=lambda entry: not entry[0].startswith(f"{RECORDINGS}/"))
    reasons = [
        *(reason for _, reason in unreadable),
        *(entry.reason for entry in files.rejected),
        *files.scan.notes[-1:],
    ]
    if not reasons:
        return DatasetError(
            "'{source}' holds no finished recording yet, only a stream: record some first.", source=source
        )
    return DatasetError(
        "'{source}' holds no recording that layout '{layout}' can read. The first: {first}",
        source=source,
        layout=head.layout.name,
        first=reasons[0],
    )


def _virtual_note(built: IndexBuild) -> Message:
    """Return the note that the times of recordings tell that they are simulated."""
    of = len(built.dataset.recordings)
    return Message(
        "{n} of {of:recording} are of a virtual toy, as the times of their rows tell", n=built.virtual, of=of
    )


@contextmanager
def _locked_work_folder(dest: Path) -> Iterator[Path]:
    """Create a work folder on the disk of the data set for one import at a time; remove those of killed imports."""
    cache = dest / CACHE
    try:
        with adding_locked(dest):
            cache.mkdir(exist_ok=True)
            for left in cache.glob("adding-*"):
                shutil.rmtree(left, ignore_errors=True)
            work = Path(tempfile.mkdtemp(prefix="adding-", dir=cache))
            try:
                yield work
            finally:
                shutil.rmtree(work, ignore_errors=True)
    except Timeout:
        raise DatasetError("Another import is adding to '{dest}' now: wait until it ends.", dest=dest) from None


def _new_marks(states: Mapping[str, MarkState], discarded: Mapping[str, str]) -> list[Mark]:
    """Return marks for recordings that the recorder has discarded or kept since; marks of people take precedence.

    Args:
        discarded: by recording id, the reason why the recorder discarded it, "" if it did not.
    """
    marks = []
    for recording, why in discarded.items():
        now = states.get(recording, MarkState())
        if now.excluded_by in ("", RECORDER) and now.excluded != bool(why):
            marks.append(Mark(recording, "exclude" if why else "include", RECORDER, why or "kept after all"))
    return marks


def add_to_dataset(
    dest: Path,
    scan: SourceScan,
    gestures: GestureSet | None,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
    generation: Generation,
) -> ImportResult:
    """Add the files of a scan to the data set ``dest``; ``gestures`` may describe gestures that it lacks.

    ``generation`` is that of ``dest`` before the source was read.

    Raises:
        ForgottenError: if a person, who may be among the new files, was removed since.
        DatasetError: if the data set cannot be opened, nothing can be added, or another import is running.
    """
    with _locked_work_folder(dest) as work:
        dataset = open_dataset(dest)
        files = ImportedFiles(scan, work, dataset)
        own = dataset.head.gestures
        if new_gestures := tuple(g for g in (gestures.gestures if gestures else ()) if own.find(g.label) is None):
            own = GestureSet(own.name, own.gestures + new_gestures)
        head = replace(dataset.head, gestures=own)
        built = files.read(head, progress)
        _refuse_unfit(dest, dataset, files, built)
        head = replace(head, gestures=_extend_gestures(own, built.dataset))
        both = (*dataset.recordings, *built.dataset.recordings)
        there = read_people(dest)
        listed, notes = _merge_people(there, scan.people, people, {r.subject for r in both})
        files.check()
        # Without the lock, marks and the people's table could restore a person who is removed meanwhile.
        with generation.writing():
            if head.gestures != dataset.head.gestures:
                write_file(dest / HEAD, head.to_toml())
            states = read_marks(dest)
            trims, labels, remarks = files.marks(both, head.gestures, states)
            marks = [*_new_marks(states, files.discarded()), *trims, *labels]
            write_marks(dest, marks)
            if {p.subject: p for p in listed} != there:
                write_people(dest, listed)
            _move_files(files, dest)
        rebuilt = rebuild_index(dest, head).dataset if files.kept or marks else open_dataset(dest)
    come = sorted(set(rebuilt.subjects) - set(dataset.subjects))
    notes += remarks + _returning_people_warning(dest, come)
    notes += label_notes(own, (r.gesture for r in built.dataset.recordings))
    return files.result(rebuilt, scan.notes + notes, len(trims))


def _refuse_unfit(dest: Path, dataset: Dataset, files: ImportedFiles, built: IndexBuild) -> None:
    """Raise DatasetError if real recordings would be mixed with simulated ones, or no file can be read."""
    simulated = files.scan.simulated or built.virtual > 0
    if dataset.head.simulated != simulated and (simulated or files.kept):
        kinds = ("real", "virtual") if simulated else ("virtual", "real")
        raise DatasetError(
            "'{dest}' holds recordings of a {kind} toy, the source those of a {other} one: keep them apart.",
            dest=dest,
            kind=kinds[0],
            other=kinds[1],
        )
    if files.rejected and not files.kept and not files.already:
        first, layout = files.rejected[0], dataset.layout.name
        raise DatasetError(
            "Nothing of the source fits '{dest}', whose layout is '{layout}': rejected are all files ({n}). The "
            "first: '{file}': {reason}.",
            dest=dest,
            layout=layout,
            n=len(files.rejected),
            file=first.file,
            reason=first.reason.rstrip("."),
            first=first.reason,
        )


def _move_files(files: ImportedFiles, dest: Path) -> None:
    """Move the copied files into the data set; companions first, so that a recording there always has its sidecar."""
    for file in sorted(files.kept, key=lambda f: (f.lower().endswith(".csv"), f)):
        target = dest / file
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() and file not in files.grown:
            raise DatasetError(f"'{target}' appeared during the import and is not overwritten: import again.")
        os.replace(files.work / file, target)


def _returning_people_warning(dest: Path, come: list[str]) -> list[str]:
    """Return a warning if ``come`` were added to a data set from which people were removed: they may be the same."""
    gone = read_removals(dest)
    # A home remembers who was removed, so that whoever came now is another person or was asked about.
    if not come or not gone or remembers_removed(dest):
        return []
    days = ", ".join(dict.fromkeys(g.day for g in gone))
    listed = join_names(come, most=5)
    return [
        Message(
            "people were removed from this data set ({n}; {days}), and {listed} were added now: remove a person "
            "again with  plushsense forget {dest} CODE",
            n=len(gone),
            days=days,
            listed=listed,
            dest=dest,
            people=", ".join(come),
        )
    ]
