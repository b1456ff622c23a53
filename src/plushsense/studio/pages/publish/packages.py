"""Collect facts of data sets and published packages, and build the section that lists and validates packages."""

from __future__ import annotations

import importlib.util
import json
import shutil
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.core.recorder_csv import SIMULATION_MARK
from plushsense.dataset.files import list_package_files
from plushsense.dataset.index import open_dataset
from plushsense.dataset.publishing.checking import VALIDATORS
from plushsense.dataset.publishing.croissant import CROISSANT_FILE
from plushsense.dataset.publishing.description import CHECKSUMS, REIDENTIFICATION_JSON
from plushsense.dataset.publishing.keys import is_drawn
from plushsense.dataset.store import Dataset
from plushsense.studio.app.guard import download_address
from plushsense.studio.app.jobs import DONE, Jobs, StudioJob
from plushsense.studio.app.shell import Page, address, button, html, moment, reveal, set_address, tag
from plushsense.studio.app.words import Texts, Words, in_context
from plushsense.studio.app.workspace import PACKAGES, Workspace
from plushsense.studio.widgets.elements import WorkPanel, ask, change_files, link, notice, size, table, text, verdict

_VALIDATORS: Texts = {
    "checksums": "Every file is there and unchanged, and there is no other file.",
    "data": "The recordings can be read, the tables agree with them, and nothing private is left.",
    "times": "No true time is left.",
    "metadata": "Title, version, licence and date are the same everywhere.",
    "croissant": "mlcroissant accepts the description and loads the same numbers.",
    "frictionless": "frictionless finds the declared type in every cell.",
    "datacite": "The citation conforms to the DataCite schema.",
}

_NAMED: Texts = {
    "unseen": "With a gesture that it was not trained on: {right} of 100.",
    "moved": "From the movement only, without levels and clock: {right} of 100.",
    "clock": "From the sampling clock only, without the touch: {right} of 100.",
    "session": "In a session that it was not trained on: {right} of 100.",
}

MEANINGS: Texts = {
    "personal": (
        "Therefore these recordings must be treated as personal data: whoever has another recording of a person can "
        "find that person here, although the package contains no names."
    ),
    "guessing": "This is no better than guessing. It is no proof of anonymity: treat the recordings with care.",
    "simulated": "These people are virtual: the figures say nothing about real people.",
}

KEYS = "keys"
"""Subfolder of the workspace for secret key files, which are never part of a data set or package."""
_TOOLS = {
    "publish": ("mlcroissant", "frictionless", "datacite"),
    "baselines": ("sklearn",),
}


@dataclass(frozen=True)
class DatasetFacts:
    """Facts of a data set to consider before publication.

    Attributes:
        dataset: the data set, or None if it cannot be read; ``problem`` is then the reason.
        own_codes: codes of people that were not drawn at random.
    """

    path: Path
    dataset: Dataset | None = None
    problem: PlushSenseError | None = None
    own_codes: tuple[str, ...] = ()

    @classmethod
    def of(cls, path: Path) -> DatasetFacts:
        """Read the facts of a data set; store an error as ``problem``."""
        try:
            dataset = open_dataset(path)
        except PlushSenseError as refusal:
            return cls(path, problem=refusal)
        return cls(path, dataset, own_codes=tuple(s for s in dataset.subjects if not is_drawn(s)))


@dataclass(frozen=True)
class PackageFacts:
    """Facts of a published package, which is a folder, a zip, or both.

    Attributes:
        reidentification: results of the re-identification test, {} if it was not run.
        contents: numbers of files and bytes of each folder (its name ends in "/") and top-level file.
    """

    name: str
    folder: Path | None
    zip: Path | None
    citation: str = ""
    title: str = ""
    simulated: bool = False
    reidentification: dict[str, Any] = field(default_factory=dict)
    contents: dict[str, tuple[int, int]] = field(default_factory=dict)
    made_s: float = 0.0

    @property
    def place(self) -> Path:
        """Path to validate: the zip if it exists, because that is what people share."""
        place = self.zip or self.folder
        assert place is not None
        return place

    @classmethod
    def of(cls, workspace: Workspace, name: str) -> PackageFacts:
        """Read the facts of a package; leave out unreadable ones, because the validators report them."""
        folder, packed = workspace.folder / PACKAGES / name, workspace.folder / PACKAGES / f"{name}.zip"
        existing = folder if (folder / CHECKSUMS).is_file() else None
        zipped = packed if packed.is_file() else None
        root = existing or _zip_root(zipped)
        croissant = _load(root, CROISSANT_FILE)
        return cls(
            name,
            existing,
            zipped,
            str(croissant.get("citeAs", "")),
            str(croissant.get("name", "")),
            root is not None and (root / SIMULATION_MARK).is_file(),
            _load(root, REIDENTIFICATION_JSON),
            _contents(existing, zipped),
            max((p.stat().st_mtime for p in (existing, zipped) if p is not None), default=0.0),
        )


def packages_of(workspace: Workspace) -> list[str]:
    """List the names of the packages in a workspace, newest first."""
    root = workspace.folder / PACKAGES
    dated = {p.parent.name: p.stat().st_mtime for p in root.glob(f"*/{CHECKSUMS}") if not p.parent.name.startswith(".")}
    dated |= {p.stem: p.stat().st_mtime for p in root.glob("*.zip") if p.is_file()}
    return sorted(dated, key=lambda name: -dated[name])


def missing_extras() -> list[str]:
    """Return the extras not installed: ``publish`` for publication, ``baselines`` for re-identification tests."""
    return [extra for extra, modules in _TOOLS.items() if not all(importlib.util.find_spec(m) for m in modules)]


def _files(folder: Path | None, packed: Path | None) -> dict[str, int]:
    """Return the files of a package and their sizes in bytes."""
    if folder is not None:
        return {p.relative_to(folder).as_posix(): p.stat().st_size for p in list_package_files(folder)}
    if packed is not None:
        try:
            with zipfile.ZipFile(packed) as archive:
                return {i.filename: i.file_size for i in archive.infolist() if not i.is_dir()}
        except (OSError, zipfile.BadZipFile):
            return {}
    return {}


def _contents(folder: Path | None, packed: Path | None) -> dict[str, tuple[int, int]]:
    grouped: dict[str, tuple[int, int]] = {}
    for path, bytes_ in _files(folder, packed).items():
        parts = path.split("/")
        # Group by the first two levels, so that subfolders of the data folder are listed separately.
        depth = min(len(parts) - 1, 2)
        top = "/".join(parts[:depth]) + "/" if depth else path
        files, total = grouped.get(top, (0, 0))
        grouped[top] = (files + 1, total + bytes_)
    return dict(sorted(grouped.items(), key=lambda item: (not item[0].endswith("/"), item[0])))


def _zip_root(packed: Path | None) -> zipfile.Path | None:
    """Return the content of a zip, or None if the zip cannot be read."""
    try:
        return zipfile.Path(packed) if packed is not None else None
    except (OSError, zipfile.BadZipFile):
        return None


def _load(root: Path | zipfile.Path | None, file: str) -> dict[str, Any]:
    try:
        content = json.loads((root / file).read_text(encoding="utf-8")) if root is not None else {}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return {}
    return content if isinstance(content, dict) else {}


_MAX_PROBLEMS = 20


class PackagesSection:
    """Section with the list of packages and the details of one of them."""

    def __init__(self, page: Page, work: WorkPanel, lacking: list[str]) -> None:
        self.page, self.words, self.workspace, self.work, self.lacking = page, page.words, page.workspace, work, lacking
        self._detail = tag(ui.column().classes("w-full"), "package")
        self._list = tag(ui.column().classes("w-full"), "packages")

    async def build(self, name: str) -> None:
        """Build the list and show the package ``name``, unless it is ""."""
        if name:
            await self.show(name)
        await self.refresh()

    async def refresh(self) -> None:
        """Update the list of packages."""
        words, workspace = self.words, self.workspace
        packages = await run.io_bound(lambda: [PackageFacts.of(workspace, n) for n in packages_of(workspace)]) or []
        rows = [
            (
                link(each.name, address("publish", name=each.name)),
                each.title,
                words("simulation") if each.simulated else "",
                Markup('<span class="text-no-wrap">{}</span>').format(moment(each.made_s)),
                self._state(newest_validation(workspace.part(Jobs), each)),
            )
            for each in packages
        ]
        self._list.clear()
        with self._list:
            text(words("Packages"), "h2")
            if not rows:
                text(words("There are no packages yet."), classes="ps-dim")
                return
            head = words.each("Package", "Title", "Data", in_context("package", "Created"), "Last check")
            table(words("Packages of this studio, the newest first"), head, rows)

    def _state(self, job: StudioJob | None) -> Markup:
        if job is None:
            return verdict(None, self.words("not checked"))
        good = bool(job.result["valid"])
        return verdict(good, f"{self.words('valid' if good else 'not valid')}, {moment(job.ended_s)}")

    async def show(self, name: str) -> None:
        """Show the details of a package."""
        words = self.words
        with self.page.show_errors():
            if name not in (await run.io_bound(lambda: packages_of(self.workspace)) or []):
                raise ConfigError("There is no package “{name}” in this studio. Choose one from the list.", name=name)
            package = await run.io_bound(lambda: PackageFacts.of(self.workspace, name))
            assert package is not None
            job = newest_validation(self.workspace.part(Jobs), package)
            set_address(address("publish", name=name))
            self._detail.clear()
            with self._detail:
                text(words("Package “{name}”", name=name), "h2")
                if package.simulated:
                    notice(words("Simulation: these data say nothing about a real toy."))
                self._take(package)
                self._answers(package, job)
                with tag(ui.column().classes("ps-card w-full"), "recognised"):
                    text(words("Can the people be recognised?"), "h3")
                    for sentence in reidentification_text(words, package.reidentification):
                        text(sentence)
                self._contents(package)
            reveal(self._detail)

    def _take(self, package: PackageFacts) -> None:
        words = self.words
        with tag(ui.column().classes("ps-card ps-next w-full"), "take"):
            text(words(in_context("heading", "Download")), "h3")
            if package.zip is not None:
                message = words("Download the zip ({size})", size=size(package.zip.stat().st_size, words))
                download = ui.link(message, download_address(PACKAGES, package.name)).classes("ps-link")
                tag(download.props("download"), "download")
            else:
                notice(words("The zip is only made when all validators accept the package."))
            text(words("Upload the package to a repository yourself if you are allowed to. Its folder:"))
            text(str(package.place), classes="ps-path ps-break")
            delete = words("Delete for good")
            button("delete", delete, lambda: self._ask_delete(package), "outline color=negative", about=package.name)

    def _ask_delete(self, package: PackageFacts) -> None:
        words, places = self.words, [p for p in (package.folder, package.zip) if p is not None]

        def delete() -> None:
            for place in places:
                self.workspace.part(Jobs).check_unused(place)
            for place in places:
                shutil.rmtree(place) if place.is_dir() else place.unlink()

        async def confirmed(_: str) -> None:
            await change_files(self.page, delete, words("“{name}” is deleted.", name=package.name), self.refresh)
            if not any(place.exists() for place in places):
                self._detail.clear()
                set_address(address("publish"))

        title = words("Delete “{name}” for good? Only a copy elsewhere can bring it back.", name=package.name)
        ask(words, title, words("Delete for good"), confirmed)

    def _answers(self, package: PackageFacts, job: StudioJob | None) -> None:
        words = self.words
        with tag(ui.column().classes("ps-card w-full"), "answers"):
            text(words("Results of the validators"), "h3")
            if job is None:
                text(words("This package has not been checked here since it was made."))
            else:
                with ui.row().classes("items-center"):
                    html(self._state(job))
                    good = words("All validators accept it.")
                    bad = words("Do not publish it like this: some validators reject it.")
                    text(good if job.result["valid"] else bad, "span")
                self._validators(job.result)
                for each in job.result.get("sentences", ()):
                    notice(words.sentence(each), "info")
            check = button("check", words("Check again"), lambda: self._check(package), icon="fact_check")
            check.set_enabled("publish" not in self.lacking)

    def _validators(self, result: dict[str, Any]) -> None:
        words = self.words
        rows = []
        for each in result["validators"]:
            good, name = not each["problems"], each["validator"]
            about = words(_VALIDATORS[name]) if name in VALIDATORS else ""
            mark = verdict(good, words("passed") if good else words("problems: {n}", n=each["problems"]))
            rows.append((name, mark, about))
        tag(table(words("Validators"), words.each("Validator", "Result", "What it checks"), rows), "validators")
        if problems := result["problems"]:
            listed = [(p["validator"], p["file"] or words("package"), p["problem"]) for p in problems[:_MAX_PROBLEMS]]
            head = words.each("Validator", "File or folder", "Problem, in the words of the validator")
            tag(table(words("Problems: {n}", n=len(problems)), head, listed), "problems")
            if len(problems) > _MAX_PROBLEMS:
                text(words("… and {n} more.", n=len(problems) - _MAX_PROBLEMS), classes="ps-dim")

    async def _check(self, package: PackageFacts) -> None:
        self.page.say("")
        with self.page.show_errors():
            await self.work.start("validate", {"place": str(self.workspace.inside(package.place))})

    def _contents(self, package: PackageFacts) -> None:
        words = self.words
        with tag(ui.column().classes("ps-card w-full"), "contents"):
            text(words("Contents"), "h3")
            rows = [(name, str(files), size(total, words)) for name, (files, total) in package.contents.items()]
            files, total = (sum(each) for each in zip(*package.contents.values(), strict=True)) if rows else (0, 0)
            with ui.expansion(words("Files: {n}, {size}", n=files, size=size(total, words))).classes("w-full"):
                head = words.each("File or folder", "Files", "Size")
                table(words("Contents of the package"), head, rows, (1, 2))
            if package.citation:
                text(words("How to cite it"), "h3")
                tag(text(package.citation), "citation")
                if "doi.org" not in package.citation:
                    advice = words("There is no DOI yet. Reserve one at a repository, then publish again with it.")
                    text(advice, classes="ps-dim")


def newest_validation(jobs: Jobs, package: PackageFacts) -> StudioJob | None:
    """Return the newest job that validated this package after it was written, or None."""
    places = {str(p) for p in (package.folder, package.zip) if p is not None}
    return next(
        (
            j
            for j in jobs.all("publish", "validate")
            if j.state == DONE and j.spec.get("place") in places and j.ended_s >= package.made_s - 1.0
        ),
        None,
    )


def reidentification_text(words: Words, figures: dict[str, Any]) -> list[str]:
    """Summarise the results ``figures`` of a re-identification test in sentences; {} means none was run."""
    trials = {(t["design"], t["sees"]): t for t in figures.get("trials", ())}
    head = trials.get(("recordings", "everything"))
    if head is None:
        return [words("It was not tested whether people can be recognised, and the package states this.")]
    top, low, chance = head["top1"], (head["top1"].get("ci95") or [head["top1"]["mean"]])[0], head["chance"]
    interval = [_of_100(words, limit) for limit in top["ci95"] or ()]
    between = words(" (95 % interval {low} to {high})", low=interval[0], high=interval[1]) if interval else ""
    sentences = [
        words(
            "Given one more recording of the same day and of a known gesture, a simple program recognises the right "
            "one of {people} people in {right} of 100 cases{between}; guessing would be right in {chance}. It was "
            "tested on {recordings} recordings.",
            right=_of_100(words, top["mean"]),
            people=head["people"],
            recordings=head["recordings"],
            between=between,
            chance=_of_100(words, chance),
        )
    ]
    for key, trial in (
        ("unseen", trials.get(("gestures", "everything"))),
        ("moved", trials.get(("recordings", "movement"))),
        ("clock", trials.get(("recordings", "clock"))),
        ("session", trials.get(("sessions", "everything"))),
    ):
        if trial is not None:
            sentences.append(words(_NAMED[key], right=_of_100(words, trial["top1"]["mean"])))
    if ("sessions", "everything") not in trials:
        sentences.append(
            words(
                "Nothing is known about other sessions, because nobody was recorded twice. Part of the result may be "
                "due to the day and not to the person."
            )
        )
    meaning = "simulated" if figures.get("simulated") else "guessing" if low <= chance else "personal"
    return [
        *sentences,
        words(MEANINGS[meaning]),
        words(
            "A program made for this purpose may be better. The full report is reidentification.md in the package. "
            "Ask your data protection officer."
        ),
    ]


def _of_100(words: Words, share: float) -> str:
    return words.number(100 * share, 0 if share >= 0.095 or share == 0 else 1)
