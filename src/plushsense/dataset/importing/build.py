"""Create a data set from the files of a source: copy them, read the copies, and report the result for each file."""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import DatasetError
from plushsense.core.files import new_folder
from plushsense.core.gestures import NOBODY, GestureSet
from plushsense.core.recorder_csv import STREAM_NAME, parse_name
from plushsense.core.sentences import Message
from plushsense.dataset.files import sha256_of
from plushsense.dataset.importing.sources import COMPANIONS, LEFT_OUT, SourceFile, SourceScan
from plushsense.dataset.importing.truncation import IMPORTER, truncation_marks
from plushsense.dataset.index import DUPLICATE_FOLDER, IndexBuild, apply_marks, build_index, write_index_files
from plushsense.dataset.marks import Mark, MarkState, append_marks, read_marks
from plushsense.dataset.store import (
    HEAD,
    RECORDINGS,
    STREAMS,
    UNKNOWN_SUBJECT,
    Dataset,
    DatasetHead,
    PersonInfo,
    Progress,
    RecordingInfo,
    write_people,
)
from plushsense.recording.session_files import SESSION_LOG

TWICE = Message("the same file was already imported")
# Files to which the recorder only appends.
APPENDED = (STREAM_NAME, SESSION_LOG)
_LONGEST = 120
# Names that Windows reserves for devices, with any suffix.
DEVICE_NAME = re.compile(r"^(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³]|conin\$|conout\$)\s*(\.|$)", re.IGNORECASE)


def folder_name(code: str, otherwise: str = UNKNOWN_SUBJECT) -> str:
    """Return a folder name for ``code`` that is valid on any system and inside the data set."""
    name = "".join(c if c.isalnum() or c in "-_. " else "_" for c in code).strip(" .")
    return f"{name}_" if DEVICE_NAME.match(name) else name or otherwise


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
                "The code '{code}' is too long: codes of {kind} have {longest} bytes at most.",
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


def _orphan(name: str) -> Message:
    """Return the reason to refuse a companion of the file ``name``, which was not imported."""
    return Message("belongs to '{name}', which was not imported", name=name)


@dataclass
class Copier:
    """Copier of files into ``work``, which becomes a data set or part of one.

    ``taken`` maps the files of the data set, by `key_of`, to SHA-256. ``contents`` maps kind and SHA-256 of existing
    raw files, which are not copied again, to their paths. ``there`` is the folder of the existing data set, in which a
    stream or log is replaced if the source has a longer version of it.
    """

    work: Path
    taken: dict[str, str] = field(default_factory=dict)
    contents: dict[tuple[str, str], str] = field(default_factory=dict)
    there: Path | None = None
    grown: set[str] = field(default_factory=set)
    """Paths below the data set of existing files that are replaced by longer ones."""
    copied: dict[Path, str] = field(default_factory=dict)
    """New path below the data set of each source that was copied."""
    already: dict[Path, str] = field(default_factory=dict)
    """Path below the data set of each source that exists already."""
    companions: dict[str, list[Path]] = field(default_factory=dict)
    """Sources of the companions of each copied file, by its new path."""

    def copy(self, file: SourceFile) -> str:
        """Copy a file and return "", or the reason why not; companions must come after the file they belong to."""
        try:
            raw = file.source.read_bytes()
        except OSError as cause:
            return Message("cannot be read: {why}", why=cause.strerror or cause)
        content = hashlib.sha256(raw).hexdigest()
        existing = self.contents.get((file.kind, content))
        if existing is None and self.contents and file.cut is not None:
            existing = self.contents.get((file.kind, sha256_of(file.cut)))
        if existing is not None:
            self.already[file.source] = existing
            return ""
        folder = self._folder(file)
        if folder is None:
            return _orphan(file.beside.name if file.beside else "")
        companion = file.kind == COMPANIONS
        name = file.source.name
        place, again = folder, 1
        while (key := key_of(f"{place}/{name}", companion=companion)) in self.taken:
            if self.taken[key] == content:
                if companion or self.contents:
                    self.already[file.source] = f"{place}/{name}"
                    return ""
                return TWICE
            if (longer := self._continues(f"{place}/{name}", raw)) is False:
                self.already[file.source] = f"{place}/{name}"
                return ""
            if longer:
                self.grown.add(f"{place}/{name}")
                break
            again += 1
            place = f"{folder}/{DUPLICATE_FOLDER}{again}"
        self.taken[key] = content
        target = self.work / place / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(raw)
        self.copied[file.source] = f"{place}/{name}"
        if companion and file.beside is not None:
            self.companions.setdefault(self.copied.get(file.beside, ""), []).append(file.source)
        return ""

    def _continues(self, file: str, raw: bytes) -> bool | None:
        """Return True if ``raw`` continues an existing append-only file, False for the reverse, None for neither.

        An incomplete last line is ignored, since the recorder completes it.
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

    def _folder(self, file: SourceFile) -> str | None:
        """Return the destination folder of a file; None for a companion whose file was not copied."""
        if file.beside is not None:
            main = self.copied.get(file.beside) or self.already.get(file.beside)
            return None if main is None else main.rpartition("/")[0]
        folder = f"{STREAMS if file.kind == COMPANIONS else file.kind}/{folder_name(file.subject)}"
        return f"{folder}/{session_folder(file.session)}" if file.session else folder


def key_of(path: str, *, companion: bool) -> str:
    """Return the key of a path in `Copier.taken`: case-folded, for raw files without suffix, as their ids."""
    folder, _, name = path.casefold().rpartition("/")
    return f"{folder}/{name}/" if companion else f"{folder}/{name.rpartition('.')[0]}"


RECORDER = "recorder"
SIMULATED = Message("these recordings are a simulation: scores on them say nothing about a real toy")
NO_PEOPLE = Message(
    "the folders are gestures, so the people are not known: splits by subject are not possible; import again with "
    "--streams DIR if the fulldatastream.csv of each person is there, or with --subjects map.csv (columns "
    "file,subject) if a mapping is"
)


PATTERN = "pattern"
WINDOWS = "windows"
NO_PEOPLE_OF_WINDOWS = (
    "the windows do not name the people, so splits by subject are not possible: import the recordings, if they exist"
)


@dataclass
class ImportSummary:
    """Result of an import; ``rejected`` and ``left_out`` have an entry for each file, ``warnings`` for each kind.

    ``recordings``, ``subjects``, ``gestures`` and ``streams`` describe the data set after the import; ``added`` counts
    new recordings and streams, ``already_there`` the files that existed already, ``companions`` the copied sidecars,
    session heads and logs, ``excluded`` the new recordings that are excluded, ``trimmed`` the trims by the choices of
    the authors' truncation script. Each recording's own warnings are its flags in the index.
    """

    dataset: Dataset
    recordings: int
    subjects: int
    gestures: list[str]
    streams: int
    rejected: list[dict[str, str]]
    warnings: list[str]
    seconds: float
    notes: list[str] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    companions: int = 0
    excluded: int = 0
    added: dict[str, int] = field(default_factory=dict)
    already_there: int = 0
    proposals: list[dict[str, Any]] = field(default_factory=list)
    sensors: list[dict[str, Any]] = field(default_factory=list)
    trimmed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        hidden = ("dataset", "notes", "warnings", "seconds")
        return {key: value for key, value in vars(self).items() if key not in hidden} | {
            "warnings": self.notes + self.warnings,
            "seconds": round(self.seconds, 2),
            "hash": self.dataset.hash,
        }


class ImportedFiles:
    """Files of a search, copied into the work folder of ``copier``, with the result for each."""

    def __init__(self, search: SourceScan, copier: Copier):
        self.search = search
        self.copier = copier
        self.rejected: list[dict[str, str]] = []
        self.left_out: list[dict[str, str]] = []
        self._origin: dict[str, SourceFile] = {}
        # Raw files lie in recordings/<person>/ and streams/<person>/.
        people = {Path(file).parts[1] for file in copier.contents.values() if len(Path(file).parts) > 2}
        refuse_merged([f for f in search.found if f.kind in (RECORDINGS, STREAMS)], people)
        # Companions come last, since they are copied beside their files.
        for found in sorted(search.found, key=lambda f: f.kind == COMPANIONS):
            if found.kind == LEFT_OUT:
                self.left_out.append({"file": found.origin, "reason": found.reason})
            elif not found.kind:
                self.reject(found, found.reason)
            elif reason := copier.copy(found):
                self.reject(found, reason)
            elif found.source in copier.copied:
                self._origin[copier.copied[found.source]] = found

    def reject(self, file: SourceFile, reason: str) -> None:
        self.rejected.append({"file": file.origin, "reason": reason})

    def drop(self, unreadable: Mapping[str, str]) -> None:
        """Remove unreadable files and their companions from the work folder, and reject them."""
        for file, reason in unreadable.items():
            self.reject(self._origin[file], reason)
            self._remove(file)
            for source in self.copier.companions.pop(file, ()):
                if (companion := self.copier.copied.get(source)) is not None:
                    self.reject(self._origin[companion], _orphan(Path(file).name))
                    self._remove(companion)

    def _remove(self, file: str) -> None:
        (self.copier.work / file).unlink()
        del self.copier.copied[self._origin.pop(file).source]

    @property
    def kept(self) -> dict[str, SourceFile]:
        """Copied files by their path below the data set."""
        return dict(self._origin)

    @property
    def sources(self) -> dict[str, Path]:
        """Sources of copied files, and of those that existed already, by their path below the data set."""
        return {file: path for path, file in (self.copier.already | self.copier.copied).items()}

    def count(self, kind: str) -> int:
        """Count the copied files of a kind."""
        return sum(f.kind == kind for f in self._origin.values())

    def check(self) -> None:
        """Assert that every file of the search was copied, exists already, or is rejected or left out."""
        accounted = len(self._origin) + len(self.copier.already) + len(self.rejected) + len(self.left_out)
        assert accounted == len(self.search.found), "every source file is imported, left out or rejected"

    def marks(
        self, recordings: Iterable[RecordingInfo], gestures: GestureSet, states: Mapping[str, MarkState] | None = None
    ) -> tuple[list[Mark], list[Mark], list[str]]:
        """Return the trims of the truncation script, the labels of folders, and notes; decisions in ``states`` stay.

        Args:
            recordings: recordings of the data set.
            gestures: the gesture set of the data set.
        """
        recordings = list(recordings)
        trims, notes = truncation_marks(self.search.choices, recordings, self.sources, states)
        folders = {f.source: f.gesture for f in self.search.found}
        labels = []
        for info in recordings:
            source = self.sources.get(info.file)
            now = (states or {}).get(info.id, MarkState())
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

    def set_aside_reasons(self) -> dict[str, str]:
        """Return for each recording id, also of existing files, why the recorder discarded it ("" if it did not)."""
        places = self.copier.copied | self.copier.already
        mine = (f for f in self.search.found if f.kind == RECORDINGS and f.source in places)
        return {recording_id(places[f.source]): f.set_aside for f in mine}


def recording_id(file: str) -> str:
    """Return the id of a recording from its path below the data set."""
    return file.removeprefix(f"{RECORDINGS}/").rpartition(".")[0]


def unknown_labels(given: GestureSet, labels: Iterable[str]) -> str:
    """Return a warning about labels that a gesture set, which was not inferred, has not; "" if it has all."""
    counts = Counter(label for label in labels if given.find(label) is None)
    if given.inferred or not counts:
        return ""
    listed = ", ".join(f"'{label}' ({n})" for label, n in counts.most_common(8)) + (", …" if len(counts) > 8 else "")
    return Message(
        "the gesture set '{set}' has no gesture {labels}: such recordings become gestures without affect; give other "
        "spellings as aliases of a pattern, or a gesture set that has them",
        set=given.name,
        labels=listed,
    )


def extend_gestures(given: GestureSet | None, dataset: Dataset) -> GestureSet:
    """Return ``given`` with the labels that it lacks, or infer a set from the recordings if it is None."""
    if given is None:
        return GestureSet.infer(r.gesture for r in dataset.recordings)
    unknown = sorted(r.gesture for r in dataset.recordings if given.find(r.gesture) is None)
    if not unknown:
        return given
    return GestureSet(given.name, given.gestures + GestureSet.infer(unknown).gestures, given.inferred)


def merge_people(
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


def create_dataset(
    source: Path,
    dest: Path,
    search: SourceScan,
    head: DatasetHead,
    people: Mapping[str, PersonInfo],
    progress: Progress | None,
) -> ImportSummary:
    """Create the data set ``dest`` from a search, completely or not at all.

    Raises:
        DatasetError: if no recording can be read, or ``dest`` is not empty.
    """
    with new_folder(dest, DatasetError, last=HEAD) as work:
        account = ImportedFiles(search, Copier(work))
        if search.gestures is None:
            names = (parse_name(Path(file).name) for file in account.kept)
            head = replace(head, gestures=GestureSet.infer(n.label for n in names if n is not None))
        built = read_copied(account, head, progress)
        if not built.dataset.recordings:
            # What is wrong with the recordings, rather than with a stream.
            unreadable = sorted(built.unreadable.items(), key=lambda entry: not entry[0].startswith(f"{RECORDINGS}/"))
            reasons = [
                *(reason for _, reason in unreadable),
                *(r["reason"] for r in account.rejected),
                *search.notes[-1:],
            ]
            if not reasons:
                raise DatasetError(
                    "'{source}' holds no finished recording yet, only a stream: record some first.", source=source
                )
            raise DatasetError(
                "'{source}' holds no recording that layout '{layout}' can read. The first: {first}",
                source=source,
                layout=head.layout.name,
                first=reasons[0],
            )
        virtual = [] if head.simulated or not built.virtual else [virtual_note(built)]
        head = replace(
            head,
            gestures=extend_gestures(search.gestures, built.dataset),
            simulated=head.simulated or built.virtual > 0,
        )
        if {r.gesture for r in built.dataset.recordings} - set(head.gestures.labels):
            # The set merges spellings of labels: build the index again with the complete set.
            built = build_index(work, head)
        listed, notes = merge_people({}, search.people, people, {r.subject for r in built.dataset.recordings})
        if listed:
            write_people(work, listed)
        trims, labels, remarks = account.marks(built.dataset.recordings, head.gestures)
        marks = [Mark(i, "exclude", RECORDER, why) for i, why in account.set_aside_reasons().items() if why]
        append_marks(work, marks + trims + labels)
        (work / HEAD).write_text(head.to_toml(), encoding="utf-8")
        infos = apply_marks(built.dataset.recordings, read_marks(work), head.gestures)
        write_index_files(Dataset(work, head, infos, built.dataset.streams))
        account.check()
    dataset = Dataset(dest, head, infos, built.dataset.streams)
    if search.gestures is not None and (note := unknown_labels(search.gestures, (r.gesture for r in infos))):
        notes.append(note)
    return summarize_import(dataset, account, virtual + search.notes + notes + remarks, set(account.kept), len(trims))


def virtual_note(built: IndexBuild) -> Message:
    """Return the note that the times of recordings tell that they are simulated."""
    of = len(built.dataset.recordings)
    return Message(
        "{n} of {of:recording} are of a virtual toy, as the times of their rows tell", n=built.virtual, of=of
    )


def read_copied(account: ImportedFiles, head: DatasetHead, progress: Progress | None) -> IndexBuild:
    """Build the index of the copied files, and remove those that cannot be read."""
    built = build_index(account.copier.work, head, progress)
    account.drop(built.unreadable)
    return built


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


def summarize_import(
    dataset: Dataset, account: ImportedFiles, notes: list[str], new: set[str], trims: int = 0
) -> ImportSummary:
    """Return the summary of an import that added the files ``new``, and ``trims`` of recordings."""
    # A search by a pattern, or in streams, has said so.
    said = account.search.shape == PATTERN or account.search.streams_named
    unknown = not said and any(r.subject == UNKNOWN_SUBJECT for r in dataset.recordings)
    mine = [r for r in dataset.recordings if r.file in new]
    flagged = [s for s in dataset.streams if s.file in new] + mine
    return ImportSummary(
        dataset,
        len(dataset.recordings),
        len(dataset.subjects),
        sorted({r.gesture for r in dataset.recordings}),
        len(dataset.streams),
        account.rejected,
        group_flags((info.id, flag) for info in flagged for flag in info.flags),
        0.0,
        [
            *([SIMULATED] if dataset.head.simulated else ()),
            *notes,
            *([_no_people(dataset, account.search.shape)] if unknown else ()),
        ],
        left_out=account.left_out,
        companions=account.count(COMPANIONS),
        excluded=sum(r.excluded for r in mine),
        added={"recordings": len(mine), "streams": account.count(STREAMS)},
        already_there=len(account.copier.already),
        trimmed=trims,
    )


_PARTS = re.compile(r"\([^()]*\)|'[^']*'|(?<= as ).+|[+-]?\d+(?:\.\d+)?( \w+?)?s?\b")


def group_flags(flags: Iterable[tuple[str, str]], noun: str = "recordings or streams") -> list[str]:
    """Return one warning for each kind of flag.

    Args:
        flags: the id of a recording or stream, and the message of a check. Messages are of one kind if they differ
            only in numbers, names in quotes or at the end behind "as", and remarks in brackets.
        noun: what the ids are of.
    """
    kinds: dict[str, list[tuple[str, str]]] = {}
    for identity, flag in flags:
        kinds.setdefault(_PARTS.sub(lambda part: f"#{part[1] or ''}", flag), []).append((identity, flag))
    return [
        (f"{len(found)} {noun}, for instance " if len(found) > 1 else "") + ": ".join(found[0])
        for found in kinds.values()
    ]
