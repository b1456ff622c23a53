"""Remove people: from a data set, listing what else knows them, or from a home with everything that names them."""

from __future__ import annotations

import glob
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePath

from filelock import FileLock, Timeout

from plushsense.core.errors import BadInput, BundleError, DatasetError, PlushSenseError
from plushsense.core.gestures import NOBODY
from plushsense.core.sentences import Message
from plushsense.dataset.backup import backup_people, is_backup
from plushsense.dataset.files import CACHE, EVALUATIONS, normalize_code
from plushsense.dataset.index import open_dataset
from plushsense.dataset.privacy.forget import RemovalPlan, find_mentions, mentions, people_of_dataset, plan_removal
from plushsense.dataset.privacy.forget import forget as remove_person
from plushsense.dataset.privacy.removed import home_of, remember_removed
from plushsense.dataset.publishing.description import CHECKSUMS
from plushsense.dataset.publishing.keys import open_key
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, Dataset, DatasetHead
from plushsense.deploy.code import FACTS, read_facts
from plushsense.models.bundle import Bundle, is_training_content, known_people
from plushsense.recording.session import LOCK
from plushsense.recording.writer import SESSION_HEAD
from plushsense.workflow.project import project_people

SUFFIX = ".plush"


@dataclass(frozen=True)
class TrainedOn:
    """A bundle that was, or may have been, trained on a person; ``certain`` if its data set had the same content."""

    bundle: str
    certain: bool
    message: str


@dataclass(frozen=True)
class Forgotten:
    """The files that were removed from a data set (``done``) or would be, and what else holds the person's data.

    ``bundles`` were trained on the person; ``discarded`` are folders of recordings that were discarded in the studio.
    ``elsewhere`` are other files and folders in the same places that contain the code or cannot be read.
    """

    plan: RemovalPlan
    bundles: list[TrainedOn]
    done: bool
    dataset: str
    discarded: list[str] = field(default_factory=list)
    elsewhere: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "dataset": self.dataset,
            "done": self.done,
            **asdict(self.plan),
            "bundles": [vars(b) for b in self.bundles],
            "discarded": self.discarded,
            "elsewhere": self.elsewhere,
        }


def forget(
    dataset: str | os.PathLike[str],
    subject: str,
    *,
    confirm: bool = False,
    bundles: Iterable[str | os.PathLike[str]] = (),
) -> Forgotten:
    """Remove a person from a data set permanently; without ``confirm``, only list what would be removed.

    Args:
        bundles: folders or files to search for models trained on the person, for corrections of the person, for
            recordings discarded in the studio and for anything else that contains the code, besides the data set's
            folder and the studio's folder that it lies in. They are only listed; the user must train the models again,
            and delete the old ones and the rest.

    Raises:
        DatasetError: when the person is not in the data set.
    """
    folder = Path(dataset)
    plan = plan_removal(folder, subject)
    bundles = list(bundles)
    places = [folder, *map(Path, bundles)]
    trained = trained_on(folder, subject, places)
    homes = {place.resolve() for place in [*places, folder.resolve().parent.parent]}
    code = glob.escape(subject)
    patterns = (f"recordings/{code}", f"datasets/*/recordings/{code}")
    discarded = sorted(str(p) for home in homes for pattern in patterns for p in (home / "discarded").glob(pattern))
    inside = folder.resolve()
    studio = [home] if (home := home_of(inside)) is not None else []
    searched = dict.fromkeys(place for p in bundles if (place := Path(p).resolve()).is_dir() and place not in studio)
    listed = {Path(path).resolve() for path in (*discarded, *(b.bundle for b in trained))}
    found = find_mentions([*studio, *searched], subject, inside)
    elsewhere = sorted({str(p) for p in found if not listed & {p.resolve(), *p.resolve().parents}})
    if confirm:
        plan = remove_person(folder, subject)
    return Forgotten(plan, trained, confirm, str(folder), discarded, elsewhere)


def trained_on(folder: Path, subject: str, places: Iterable[Path]) -> list[TrainedOn]:
    """Find the bundles in ``places`` that were trained, validated or adapted on the person.

    Bundles that cannot be read, and exports of this data set, are listed too, because they may depend on the person.
    """
    name = DatasetHead.read(folder).name
    dataset: Dataset | None
    try:
        dataset = open_dataset(folder)
    except DatasetError:
        # After an interrupted removal, only the name can be compared.
        dataset = None
    entries = []
    for path in _bundles(places):
        try:
            message, certain = _training_of(Bundle.load(path), subject, name, dataset)
        except BundleError as error:
            message, certain = f"cannot be read, so its training people are unknown: {error}", False
        if message:
            entries.append(TrainedOn(str(path), certain, message))
    return entries


def _training_of(bundle: Bundle, subject: str, name: str, dataset: Dataset | None) -> tuple[str, bool]:
    """Return how a bundle depends on a person ("" if not), and whether that is certain; ``dataset`` if it opens."""
    provenance = bundle.provenance
    same_content = dataset is not None and is_training_content(bundle, dataset)
    same_name = provenance.get("dataset") == name
    people = [provenance.get(key, ()) for key in ("subjects", "validation_subjects")]
    if any(isinstance(each, int) for each in people):
        # An export states the number of people, not their codes.
        export = "belongs to an export of this data set, which does not name people: check the bundle it was made from"
        return (export if same_content or same_name else ""), False
    if subject not in {code for each in people for code in each}:
        adapted = "adapted to this code: remove it, or undo that with  plushsense adapt BUNDLE --undo"
        return (adapted if bundle.adapted_to == subject else ""), False
    if same_content:
        return "trained on this person: train it again without them, and remove it", True
    if same_name:
        return "trained on this code in an earlier state of this data set: train it again, and remove it", False
    return (
        f"trained on this code in the data set '{provenance.get('dataset', '?')}': check whether it is the same person",
        False,
    )


def _bundles(places: Iterable[Path]) -> list[Path]:
    paths: dict[Path, Path] = {}
    for place in places:
        if not place.exists():
            raise DatasetError(f"There is no folder '{place}' to search for bundles: check the path.")
        found = ((at, name) for at, _, names in os.walk(place) for name in names)
        inside = [Path(at) / name for at, name in found if name.lower().endswith(SUFFIX)]
        files = [place] if place.is_file() else inside
        for path in sorted(files):
            paths.setdefault(path.resolve(), path)
    return list(paths.values())


@dataclass(frozen=True)
class PersonTrace:
    """Something in a home that names a person or was computed from their recordings, and can be removed.

    Attributes:
        kind: a key of `REMOVALS`.
        path: file or folder.
        person: the code as it is spelled there.
        parts: the files or folders to delete; none if the person is taken out of ``path``, which stays.
        count: number of files or recordings that are about the person.
        certain: whether it is about the person; otherwise the code is spelled in another way, or may be in it.
    """

    kind: str
    path: Path
    person: str
    parts: tuple[Path, ...] = ()
    count: int = 1
    certain: bool = True

    @property
    def id(self) -> str:
        """Identifies the trace in a home."""
        return f"{self.kind} {self.person} {self.path}"


@dataclass(frozen=True)
class HomeTraces:
    """Everything that is known about a person in a home.

    ``mentions`` are other files that contain the code, or that cannot be read; ``pseudonyms`` the codes of the person
    in packages, ``published`` the DOIs of the data sets with the person.
    """

    person: str
    traces: tuple[PersonTrace, ...]
    mentions: tuple[Path, ...] = ()
    pseudonyms: tuple[str, ...] = ()
    published: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON."""
        return {
            "person": self.person,
            "traces": [{"kind": t.kind, "path": str(t.path), "certain": t.certain} for t in self.traces],
            "mentions": [str(path) for path in self.mentions],
            "pseudonyms": list(self.pseudonyms),
            "published": list(self.published),
        }


@dataclass(frozen=True)
class RemovalReceipt:
    """Result of `forget_everywhere`: the traces removed, those kept, and those that could not be removed, with why."""

    found: HomeTraces
    removed: tuple[PersonTrace, ...]
    kept: tuple[PersonTrace, ...]
    failed: tuple[tuple[PersonTrace, Message], ...]

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON; each trace is the list of its kind and path."""
        return {
            "person": self.found.person,
            "removed": [[trace.kind, str(trace.path)] for trace in self.removed],
            "kept": [[trace.kind, str(trace.path)] for trace in self.kept],
            "failed": [[trace.kind, str(trace.path), why.to_json()] for trace, why in self.failed],
            "mentions": [str(path) for path in self.found.mentions],
            "pseudonyms": list(self.found.pseudonyms),
            "published": list(self.found.published),
        }


@dataclass
class _HomeFiles:
    """The contents of a home by kind; folders of data sets, packages, exports and of a person are one entry each."""

    datasets: list[Path] = field(default_factory=list)
    packages: list[Path] = field(default_factory=list)
    exports: list[Path] = field(default_factory=list)
    people: list[Path] = field(default_factory=list)
    bundles: list[Path] = field(default_factory=list)
    archives: list[Path] = field(default_factory=list)
    others: list[Path] = field(default_factory=list)

    @classmethod
    def of(cls, home: Path, given: Iterable[Path], person: str = "") -> _HomeFiles:
        """List the files of a home and of data sets elsewhere, with the folders of a person in any spelling."""
        files = cls()
        for place in (home, *given):
            for at, folders, names in os.walk(place):
                here = Path(at)
                if HEAD in names:
                    files.datasets.append(here)
                    inside = sorted(here.rglob(f"*{SUFFIX}"))
                    files.bundles += [p for p in inside if p.relative_to(here).parts[0] not in (CACHE, EVALUATIONS)]
                    folders.clear()
                elif (units := files._units(here, names, person if here != place else "")) is not None:
                    units.append(here)
                    folders.clear()
                folders.sort()
        return files

    def _units(self, here: Path, names: Collection[str], person: str) -> list[Path] | None:
        """Return the list that a folder belongs to as a whole; otherwise add its files, and return None."""
        if CHECKSUMS in names:
            return self.packages
        if FACTS in names:
            return self.exports
        if person and _is_of(here.name, person):
            return self.people
        kinds = {SUFFIX: self.bundles, ".zip": self.archives}
        for path in (here / name for name in sorted(names)):
            kinds.get(path.suffix.lower(), self.others).append(path)
        return None


def _is_of(name: str, person: str) -> bool:
    """Return whether a name is that of a person in any spelling, perhaps with a number, as ``S02-2``."""
    return normalize_code(person) in (normalize_code(name), normalize_code(re.sub(r"-\d+$", "", name)))


def people_of_home(home: Path, given: Iterable[Path] = ()) -> list[str]:
    """Return the codes of the people who are in sessions, data sets, networks or backups, also discarded ones."""
    files = _HomeFiles.of(home, given)
    people = {code for folder in files.datasets for code in people_of_dataset(folder)}
    people |= {path.parent.parent.name for path in files.others if path.name == SESSION_HEAD}
    for path in files.bundles:
        with suppress(BundleError):
            people |= _people_of_bundle(Bundle.load(path))
    for path in files.archives:
        with suppress(DatasetError):
            people |= set(_people_in(path))
    return sorted(people - {NOBODY, UNKNOWN_SUBJECT})


def _people_of_bundle(bundle: Bundle) -> set[str]:
    return known_people(bundle.provenance) | ({bundle.adapted_to} if bundle.adapted_to else set())


def find_traces(home: Path, person: str, given: Iterable[Path] = ()) -> HomeTraces:
    """Find everything in a home, and in the data sets ``given`` elsewhere, that names a person or has read them."""
    files = _HomeFiles.of(home, given, person)
    keys = {path: code for path in files.others if (code := _codes_of_key(path).get(person))}
    codes = (person, *sorted(set(keys.values())))
    traces, named, published = _traces_of_datasets(files.datasets, codes)
    traces += _traces_of_sessions(files.people, person)
    traces += _traces_of_models(files, person, traces)
    traces += _traces_of_archives(files, codes)
    traces += [PersonTrace("key", path, person) for path in keys]
    listed = {path for trace in traces for path in (trace.path, *trace.parts)}
    files_left = [path for path in (*files.others, *files.archives) if path not in listed]
    naming = [path for path in files_left if mentions(path, person)]
    for folder in (home / name for name in NOTES):
        if notes := tuple(path for path in naming if path.parent == folder):
            traces.append(PersonTrace("notes", folder, person, notes, len(notes)))
            listed.update(notes)
    order = list(REMOVALS)
    traces.sort(key=lambda t: (order.index(t.kind), t.path))
    named += [path for path in naming if path not in listed]
    return HomeTraces(person, tuple(traces), tuple(named), codes[1:], tuple(published))


def _traces_of_datasets(
    folders: Iterable[Path], codes: tuple[str, ...]
) -> tuple[list[PersonTrace], list[Path], list[str]]:
    """Return the data sets with a person, the files in them that stay and contain the code, and the DOIs."""
    traces, named, published = list[PersonTrace](), list[Path](), list[str]()
    for folder in folders:
        there = people_of_dataset(folder)
        others = [c for c in there if c not in codes and normalize_code(c) == normalize_code(codes[0])]
        for code in (codes[0], *(c for c in codes[1:] if c in there), *others):
            try:
                plan = plan_removal(folder, code)
            except DatasetError:
                continue
            if not plan.absent or plan.evaluations:
                count = len(plan.files) + len(plan.evaluations)
                traces.append(PersonTrace("dataset", folder, code, count=count, certain=code in codes))
                published += [plan.published] if plan.published else []
                named += [folder / path for path in plan.mentions]
    return traces, named, published


def _traces_of_sessions(folders: Iterable[Path], person: str) -> Iterator[PersonTrace]:
    """Yield the folders of a person, which hold sessions or other files."""
    for folder in folders:
        kind = "sessions" if any(folder.glob(f"*/{SESSION_HEAD}")) else "folder"
        count = sum(1 for path in folder.rglob("*") if path.is_file())
        yield PersonTrace(kind, folder, person, (folder,), count, folder.name == person or kind == "folder")


def _traces_of_models(files: _HomeFiles, person: str, known: Iterable[PersonTrace]) -> list[PersonTrace]:
    """Return the networks that read a person, and what was exported from them, or may have been."""
    traces, hashes = list[PersonTrace](), set[object]()
    for path in files.bundles:
        try:
            bundle = Bundle.load(path)
        except BundleError:
            traces.append(PersonTrace("network", path, person, (path,), certain=False))
            continue
        if people := [code for code in _people_of_bundle(bundle) if _is_of(code, person)]:
            hashes.add(bundle.provenance.get("dataset_hash"))
            traces.append(PersonTrace("network", path, person, (path,), certain=person in people))
    names = {DatasetHead.read(t.path).name for t in known if t.kind == "dataset"}
    for folder in files.exports:
        try:
            origin: Mapping[str, object] = read_facts(folder).provenance
        except BadInput:
            origin = {}
        certain = origin.get("dataset_hash") in hashes
        if certain or not origin or origin.get("dataset") in names:
            traces.append(PersonTrace("export", folder, person, (folder,), certain=certain))
    return traces


def _people_in(archive: Path) -> list[str]:
    """Return the people in a backup or a project."""
    return backup_people(archive) if is_backup(archive) else project_people(archive)


def _traces_of_archives(files: _HomeFiles, codes: tuple[str, ...]) -> Iterator[PersonTrace]:
    """Yield the packages and backups that hold a person; ``codes`` are the person's own one, then those in packages."""
    for path in files.archives:
        held = [c for c in _people_in(path) if _is_of(c, codes[0])]
        if held:
            yield PersonTrace("backup", path, codes[0], (path,), certain=codes[0] in held)
    packed = [path for path in files.archives if not is_backup(path) and CHECKSUMS in _members(path)]
    for path in (*files.packages, *packed):
        parts = {part for member in _members(path) for part in PurePath(member).parts}
        certain = bool(parts & set(codes))
        if certain or any(_is_of(part, codes[0]) for part in parts):
            yield PersonTrace("package", path, codes[0], (path,), certain=certain)


def _codes_of_key(path: Path) -> Mapping[str, str]:
    """Return the codes of the key of a publication by the original ones; none for another file."""
    try:
        if path.stat().st_size < _LARGEST_KEY and re.match(r"[0-9a-f]{32,}\s", path.read_text(encoding="utf-8")):
            return open_key(path).codes
    except (OSError, ValueError, DatasetError):
        pass
    return {}


def _members(package: Path) -> list[str]:
    """Return the paths in a folder or zip; none if it cannot be read."""
    if package.is_dir():
        return [path.relative_to(package).as_posix() for path in package.rglob("*")]
    try:
        with zipfile.ZipFile(package) as archive:
            return archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return []


def forget_everywhere(home: Path, person: str, chosen: Collection[str], given: Iterable[Path] = ()) -> RemovalReceipt:
    """Remove what is chosen of the traces of a person in a home; this cannot be undone. The home remembers the code.

    Args:
        chosen: the `PersonTrace.id` of what to remove.
        given: data sets elsewhere, in which to look as well.

    Returns:
        What was removed, and what was not.
    """
    found = find_traces(home, person, given)
    remember_removed(home, person)
    removed, failed = list[PersonTrace](), list[tuple[PersonTrace, Message]]()
    for trace in (t for t in found.traces if t.id in chosen):
        try:
            REMOVALS[trace.kind](trace)
            removed.append(trace)
        except PlushSenseError as refusal:
            failed.append((trace, refusal.message))
        except OSError as cause:
            why = Message("The computer refused: {why}{where}.", why=cause.strerror or str(cause), where="")
            failed.append((trace, why))
    kept = tuple(t for t in found.traces if t.id not in chosen)
    found = replace(found, mentions=tuple(path for path in found.mentions if path.exists()))
    return RemovalReceipt(found, tuple(removed), kept, tuple(failed))


def _delete(trace: PersonTrace) -> None:
    for path in trace.parts:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _delete_sessions(trace: PersonTrace) -> None:
    """Delete the sessions of a person; raise DatasetError if one is being recorded."""
    for head in trace.path.glob(f"*/{SESSION_HEAD}"):
        try:
            FileLock(str(head.parent / LOCK), timeout=0).acquire().lock.release()
        except Timeout:
            raise DatasetError("The session {name} is being recorded. End it first.", name=head.parent.name) from None
    _delete(trace)


def _remove_from_dataset(trace: PersonTrace) -> None:
    remove_person(trace.path, trace.person)


def _remove_from_key(trace: PersonTrace) -> None:
    """Remove the line of a person from the key of a publication."""
    with FileLock(trace.path.with_name(f"{trace.path.name}.lock")):
        key = open_key(trace.path)
        codes = {original: code for original, code in key.codes.items() if original != trace.person}
        replace(key, codes=codes).write(trace.path)


NOTES = ("work", "selections")
"""Folders of a home with notes of the studio, which may be deleted: records of jobs, selections of recordings."""
_LARGEST_KEY = 1 << 20
REMOVALS: dict[str, Callable[[PersonTrace], None]] = {
    "dataset": _remove_from_dataset,
    "sessions": _delete_sessions,
    "network": _delete,
    "export": _delete,
    "package": _delete,
    "backup": _delete,
    "key": _remove_from_key,
    "folder": _delete,
    "notes": _delete,
}
"""How each kind of trace is removed."""
