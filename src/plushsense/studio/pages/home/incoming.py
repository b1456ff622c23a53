"""Import files from the browser: upload them, show what they contain, and keep them as a data set or network."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from fastapi import HTTPException
from nicegui import context, run, ui
from nicegui.elements.upload import Upload
from nicegui.elements.upload_files import FileUpload

from plushsense.core.errors import BundleError, ConfigError, PlushSenseError
from plushsense.core.files import write_file
from plushsense.core.gestures import NOBODY
from plushsense.core.layouts import layout_names, load_layout
from plushsense.core.recorder_csv import STREAM_NAME, parse_name
from plushsense.core.sentences import Message
from plushsense.dataset.files import DATASETS, person_folders
from plushsense.dataset.importing.archives import UnpackLimits, member_target
from plushsense.dataset.privacy.removed import CONSENT, refuse_removed, removed_of
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, DatasetHead
from plushsense.studio.app.guard import UPLOAD_BYTES
from plushsense.studio.app.jobs import DONE, INCOMING, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, button, heading, on_change, on_page, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BACKUPS, BUNDLES, PATTERNS, WORK, Workspace, plain_name
from plushsense.studio.pages.home.mapping import FileMapping, MappingPanel
from plushsense.studio.pages.home.sections import open_project_file, simulation_badge, titled_card
from plushsense.studio.widgets.elements import MAX_LINES, admitting, errors_beside, facts, folded_lines, notice

_LAYOUTS: Texts = {
    "plush-15": "plush toy",
    "plush-14": "plush toy, older firmware",
    "accel-3": "one accelerometer",
    "phone-6": "phone, acceleration and rotation",
}

ARCHIVE_BYTES = UPLOAD_BYTES - 1_000_000
"""Maximum size of an uploaded file in bytes; the request that carries it is slightly larger."""
BUNDLE_BYTES = 64_000_000
_LIMITS = UnpackLimits(total_bytes=4_000_000_000, files=50_000)
_ACCEPTED = ".zip,.plush,.csv,.xdf,.xdfz,.parquet,.txt,.tsv,.dat,.json,.jsonl"
# Files that desktops leave in folders; nobody chose them.
_OF_DESKTOPS = (".DS_Store", "Thumbs.db", "desktop.ini")


def _about(file: str, note: Message) -> Message:
    return Message("{file}: {note}", file=file, note=note)


def _is_of_preview(note: str | dict[str, Any]) -> bool:
    """Return whether the preview shows a note in another way."""
    from plushsense.dataset.importing.results import NO_PEOPLE_OF_PATTERN, SIMULATED
    from plushsense.dataset.importing.sources import LAYOUT_GUESSED

    hidden = (SIMULATED.template, LAYOUT_GUESSED, NO_PEOPLE_OF_PATTERN.template)
    return isinstance(note, dict) and note["template"] in hidden


class Incoming:
    """Uploaded files of one page, and the data set that is made of them, in a folder of their own.

    Recordings are in ``files``; archives and tables, each of which is imported by itself, are in ``single``.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self.folder = workspace.folder / WORK / INCOMING / uuid.uuid4().hex
        self.dataset = self.folder / "dataset"
        self.pattern = self.folder / "pattern.toml"
        self.refused: list[Message] = []
        self.readmit = False
        """Whether people are taken in who were removed."""
        self.bundles: list[str] = []
        """Names of the networks that were added."""
        self.projects: list[Path] = []
        """Projects that were uploaded, now among the backups."""
        self.returning: list[Path] = []
        """Uploaded networks that know a person who was removed: ask before `add_network`."""
        self._names: list[str] = []
        self._count = self._bytes = self._tries = 0

    @property
    def sources(self) -> list[Path]:
        """The files and the folder to import."""
        single = sorted((self.folder / "single").glob("*"))
        return [*single, *(p for p in (self.folder / "files",) if p.is_dir())]

    @property
    def foreign(self) -> Path:
        """The one source in which files of other sensors are looked for."""
        single = list((self.folder / "single").glob("*"))
        return single[0] if len(single) == 1 else self.folder / ("single" if single else "files")

    @property
    def name(self) -> str:
        """The name of the first archive, file or folder that was uploaded."""
        return self._names[0] if self._names else ""

    def new_dataset(self) -> Path:
        """Return the folder for a new try to make the data set; an earlier one may still be in use by its job."""
        self._tries += 1
        self.dataset = self.folder / f"dataset-{self._tries}"
        return self.dataset

    async def store(self, file: FileUpload) -> None:
        """Store an uploaded file; a network is checked and added to the networks at once.

        Raises:
            ConfigError: for too many files or bytes.
            OSError: for errors of the disk.
        """
        target = member_target(unquote(file.name))
        if isinstance(target, Message):
            self.refused.append(_about(unquote(file.name), target))
            return
        if target.name in _OF_DESKTOPS:
            return
        kind = target.suffix.lower()
        self._count, self._bytes = self._count + 1, self._bytes + file.size()
        if self._count > _LIMITS.files or self._bytes > _LIMITS.total_bytes:
            gb = f"{_LIMITS.total_bytes / 1e9:g}"
            raise ConfigError(
                "These are more than {files} files or {gb} GB. Import them in parts.", files=_LIMITS.files, gb=gb
            )
        table = kind == ".parquet" or (
            kind == ".csv" and parse_name(target.name) is None and target.name.lower() != STREAM_NAME
        )
        alone = kind in (".zip", ".plush") or (table and len(target.parts) == 1)
        place = self.folder / ("single" if alone else "files") / (target.name if alone else target)
        if alone and place.exists():
            # Folders may have archives of one name.
            place = place.with_name(" ".join(target.parts))
        await run.io_bound(lambda: place.parent.mkdir(parents=True, exist_ok=True))
        await file.save(place)
        if kind == ".plush":
            await run.io_bound(self.add_network, place)
        elif kind == ".zip" and await run.io_bound(self._add_project, place):
            return
        else:
            self._names.append(target.parts[0] if len(target.parts) > 1 else target.stem)

    def _add_project(self, stored: Path) -> bool:
        """Move an uploaded file to the backups if it is a project; return whether it is."""
        from plushsense.workflow.project import is_project

        if not is_project(stored):
            return False
        name = self._workspace.free_name(BACKUPS, plain_name(stored.stem, "project"), ".zip", separator=" ")
        place = self._workspace.folder / BACKUPS / f"{name}.zip"
        place.parent.mkdir(parents=True, exist_ok=True)
        stored.rename(place)
        self.projects.append(place)
        return True

    def add_network(self, stored: Path, readmit: bool = False) -> None:
        """Check an uploaded network, and move it to the networks of the studio."""
        from plushsense.models.bundle import Bundle, known_people

        name = plain_name(stored.stem, "network")
        try:
            if stored.stat().st_size > BUNDLE_BYTES:
                raise ConfigError("a network has at most {mb} MB", mb=f"{BUNDLE_BYTES / 1e6:g}")
            people = known_people(Bundle.load(stored).provenance)
            if not readmit and removed_of(stored, people):
                aside = self.folder / "returning" / stored.name
                aside.parent.mkdir(exist_ok=True)
                self.returning.append(stored.rename(aside))
                return
            place = self._workspace.new(BUNDLES, f"{name}.plush")
            place.parent.mkdir(parents=True, exist_ok=True)
            stored.rename(place)
            self.bundles.append(name)
        except BundleError:
            self.refused.append(_about(stored.name, Message("this is no network, or a damaged one")))
        except ConfigError as refusal:
            self.refused.append(_about(stored.name, refusal.message))
        finally:
            stored.unlink(missing_ok=True)

    def keep(self, name: str) -> Path:
        """Move the data set that was made of the files to the data sets of the studio, and remove the files.

        A pattern that a person has confirmed is kept for further files.

        Raises:
            ConfigError: for a name that is not a plain file name, or that exists already.
        """
        if not self.readmit:
            refuse_removed(self.folder, person_folders(self.dataset))
        place = self._workspace.new(DATASETS, name)
        place.parent.mkdir(parents=True, exist_ok=True)
        write_file(self.dataset / HEAD, replace(DatasetHead.read(self.dataset), name=place.name).to_toml())
        self.dataset.rename(place)
        if self.pattern.exists():
            from plushsense.dataset.importing.guessing import reusable

            kept = self._workspace.folder / PATTERNS / f"{DatasetHead.read(place).layout.name}.toml"
            kept.parent.mkdir(exist_ok=True)
            write_file(kept, reusable(self.pattern.read_text(encoding="utf-8")))
        self.clear()
        return place

    def clear(self) -> None:
        """Remove the files."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self.readmit = False
        self._names.clear()
        self._count = self._bytes = 0


class UploadArea(Upload, component="incoming.js"):
    """Area of the page that uploads chosen or dropped files and folders, with their paths, in batches.

    Args:
        store: called with each file; an error ends the upload.
        finish: called at the end with the values ``ok``, ``cancelled`` and ``large``, paths of files over the limit.
    """

    def __init__(
        self,
        store: Callable[[FileUpload], Awaitable[None]],
        finish: Callable[[dict[str, Any]], Awaitable[None]],
        texts: Mapping[str, str],
    ) -> None:
        super().__init__()
        self._store = store
        self._props.update(accept=_ACCEPTED, limit=ARCHIVE_BYTES, texts=dict(texts))
        self.on("finish", lambda event: finish(event.args))

    async def handle_uploads(self, files: list[FileUpload]) -> None:
        """Store the files before the browser gets its answer."""
        for file in files:
            try:
                await self._store(file)
            except (PlushSenseError, OSError):
                raise HTTPException(507) from None


class IncomingSection:
    """Section that imports files: choose or drop them, see what they contain, name the data set, import.

    Args:
        refresh: shows the data sets and networks again.
    """

    def __init__(self, page: Page, jobs: Jobs, refresh: Callable[[], Awaitable[None]]) -> None:
        self._page, self._words, self._jobs, self._refresh = page, page.words, jobs, refresh
        self._incoming = Incoming(page.workspace)
        self._job: StudioJob | None = None
        self._problem: Exception | None = None
        self._layout = ""
        self._mapping = FileMapping()
        self._ended = True
        words = self._words
        with titled_card(page, "Import files", "incoming"):
            about = words(
                "Drop recordings anywhere on this page, or choose them: single files, a whole folder, a .zip, a "
                "backup or a .plush network (at most {mb} MB each). They are copied from this device to the studio "
                "and nowhere else.",
                mb=ARCHIVE_BYTES // 1_000_000,
            )
            texts = {"sending": words("Uploading …"), "cancel": words("Cancel")}
            with UploadArea(self._store, self._finish, texts) as area, ui.column().classes("w-full ps-small-gap"):
                ui.label(about).classes("ps-dim")
                with ui.row().classes("ps-small-gap"):
                    files = button("choose_files", words("Choose files"), icon="upload_file")
                    folder = button("choose_folder", words("Choose a folder"), icon="folder")
                    # In the browser, since it opens its dialog only as the answer to a click.
                    files.on("click", js_handler=f"() => runMethod({area.id}, 'pick', [false])")
                    folder.on("click", js_handler=f"() => runMethod({area.id}, 'pick', [true])")
            self._busy = ui.row().classes("items-center ps-small-gap").props('role="status"')
            with self._busy:
                ui.spinner(size="1.2em").props("aria-hidden=true")
                self._progress = tag(ui.label(), "inspecting")
            self._busy.set_visibility(False)
            self._box = ui.column().classes("w-full ps-small-gap").props('aria-live="polite"')
        on_change(jobs.changed, self._update)
        context.client.on_delete(self._leave)

    # Upload ---------------------------------------------------------------------------------------------------

    async def _store(self, file: FileUpload) -> None:
        try:
            await self._incoming.store(file)
        except (PlushSenseError, OSError) as problem:
            self._problem = problem
            raise

    async def _finish(self, end: dict[str, Any]) -> None:
        words, incoming, page = self._words, self._incoming, self._page
        problem, self._problem = self._problem, None
        refused, incoming.refused = incoming.refused, []
        refused += [_about(path, Message("the file is larger than {mb} MB", mb=_MB)) for path in end["large"]]
        if end["cancelled"] or not end["ok"]:
            await self._cancel()
            with page.show_errors():
                if problem is not None:
                    raise problem
                cancelled = words("The upload was cancelled. Nothing was imported.")
                broken_off = words("The upload broke off. Nothing was imported. Try again.")
                page.say(cancelled if end["cancelled"] else broken_off, "warning")
            return
        await self._say_added()
        if refused:
            page.say(" ".join(words.sentence(note) for note in refused[:MAX_LINES]), "error")
        projects, incoming.projects = incoming.projects, []
        for project in projects:
            await open_project_file(page, self._jobs, project)
        returning, incoming.returning = incoming.returning, []
        for stored in returning:
            await admitting(page, partial(self._add_returning, stored))
        if incoming.sources:
            self._inspect()

    async def _say_added(self) -> None:
        added, self._incoming.bundles = self._incoming.bundles, []
        if added:
            self._page.say(self._words("The network “{name}” is added.", name="”, “".join(added)), "good")
            await self._refresh()

    async def _add_returning(self, stored: Path, readmit: bool) -> None:
        from plushsense.models.bundle import Bundle, known_people

        if not readmit:
            refuse_removed(stored, known_people(Bundle.load(stored).provenance))
        self._incoming.add_network(stored, readmit)
        await self._say_added()

    # Preview --------------------------------------------------------------------------------------------------

    def _inspect(self, task: str = "inspect") -> None:
        """Start the job that makes a data set of the files, or guesses how to read them, with what is stated."""
        if self._job is not None:
            self._jobs.stop(self._job.id)
        incoming, workspace, mapping = self._incoming, self._page.workspace, self._mapping
        patterns = workspace.folder / PATTERNS
        if "name" not in mapping.given:
            plain = plain_name(incoming.name, self._words("recordings"))
            mapping.given["name"] = workspace.free_name(PATTERNS, plain, ".toml", taken=layout_names())
        spec = {
            "sources": [str(path) for path in incoming.sources],
            "foreign": str(incoming.foreign),
            "dest": str(incoming.new_dataset()),
            "layout": self._layout,
            "person": mapping.person,
            "given": mapping.given,
            "pattern": str(incoming.pattern) if incoming.pattern.exists() else "",
            "patterns": [str(path) for path in sorted(patterns.glob("*.toml"))],
            "readmit": incoming.readmit,
            "dry": True,
        }
        self._ended = False
        with self._page.show_errors():
            self._job = self._jobs.start(task, spec, self._words("Looking at the files …"))
        self._update()

    def _update(self) -> None:
        job = self._job
        if job is None or self._ended:
            return
        running = job.state == RUNNING
        self._busy.set_visibility(running)
        self._box.props("inert") if running else self._box.props(remove="inert")
        if running:
            done, total = job.progress.get("done"), job.progress.get("total")
            text = self._words("Looking at the files …") + (f" {done} / {total}" if total else "")
            self._progress.set_text(text)
            return
        self._ended = True
        self._box.clear()
        with self._box, tag(ui.column().classes("ps-row w-full ps-small-gap"), "preview"):
            if "guess" in job.result:
                self._map(job.result)
            else:
                self._show(job)

    def _map(self, result: dict[str, Any]) -> None:
        """Show how the files of a new sensor are read, with the fields that correct it."""
        incoming = self._incoming
        incoming.pattern.unlink(missing_ok=True)

        def accept() -> None:
            write_file(incoming.pattern, result["guess"]["toml"])
            self._inspect()

        MappingPanel(self._words, self._mapping, result, lambda: self._inspect("guess"))
        with ui.row().classes("ps-small-gap"):
            if result.get("preview", {}).get("rows"):
                text = self._words("The rows are right: read all files")
                button("mapping-right", text, on_page(accept), "unelevated color=primary")
            button("import-cancel", self._words("Cancel"), on_page(self._cancel), "flat")
        if field := self._mapping.changed:
            self._mapping.changed = ""
            ui.run_javascript(f"document.querySelector('[data-test=\"map-{field}\"] input')?.focus()")

    def _show(self, job: StudioJob) -> None:
        """Show what the files contain, or why they cannot be imported, with the fields that may mend it."""
        words, result, mapping = self._words, job.result, self._mapping
        reasons = [r["reason"] for r in result.get("rejected", ())]
        needs = {r["values"].get("needs") for r in (job.refusal, *reasons) if isinstance(r, dict) and r}
        unknown_person = "person" in needs or UNKNOWN_SUBJECT in result.get("people", ())
        heading(words("What the files contain"), 3)
        if job.state == DONE:
            if pattern := result["pattern"]:
                mapping.given["name"] = Path(pattern).stem
                ui.label(words("Read as the files of “{name}” were.", name=Path(pattern).stem))
            self._contents(result)
        elif "person" not in needs:
            message = words.failure(job.refusal) or words("stopped")
            tag(notice(message, "error"), "preview-problem")
        if not result.get("restored"):
            self._settings(unknown_person, "layout" in needs)
        if CONSENT in needs:
            button("import-readmit", words("Take them in anyway"), self._readmit)
        if job.state == DONE:
            self._keep_row(result)
        else:
            button("import-cancel", words("Cancel"), on_page(self._cancel), "flat")

    def _readmit(self) -> None:
        self._incoming.readmit = True
        self._inspect()

    def _contents(self, result: dict[str, Any]) -> None:
        words, people = self._words, result["people"]
        names = {NOBODY: words("nobody"), UNKNOWN_SUBJECT: "?"}
        if result["simulated"]:
            simulation_badge(self._page)
        if result["restored"]:
            ui.label(words("This is a backup of the data set “{name}”.", name=result["name"]))
        rows = [
            (words("People (recordings)"), ", ".join(f"{names.get(p, p)} ({n})" for p, n in people.items())),
            (words("Recordings"), str(result["recordings"])),
            (words("Sensors"), result["layout"]),
        ]
        facts(rows)
        gestures = [f"{words.gesture(label)}: {n}" for label, n in sorted(result["gestures"].items())]
        folded_lines(words, words("Gestures: {n}", n=len(gestures)), gestures, "preview_gestures")
        notes = [words.sentence(n) for n in result["notes"] if not _is_of_preview(n)]
        if n := result["flagged"]:
            notes.append(words("Recordings with something to look at: {n}. The page Review shows them.", n=n))
        for note in notes:
            ui.label(note).classes("ps-note ps-break")
        rejected = [f"{r['file']}: {words.sentence(r['reason'])}" for r in result["rejected"]]
        folded_lines(words, words("Files that are not imported: {n}", n=len(rejected)), rejected, "rejected")

    def _settings(self, unknown_person: bool, unknown_layout: bool) -> None:
        """Add the fields of what the files do not state: the layout, and the person where it is not known."""
        words = self._words

        def change_layout(name: str) -> None:
            self._layout = name
            self._inspect()

        def change_person() -> None:
            if (code := str(person.value or "").strip()) != self._mapping.person:
                self._mapping.person = code
                self._inspect()

        if unknown_layout or self._layout:
            options = {name: f"{name}: {words(_LAYOUTS.get(name, load_layout(name).title))}" for name in layout_names()}
            layout = ui.select(options, value=self._layout or None, label=words("Sensors of the toy"))
            tag(layout.classes("w-full"), "layout").on_value_change(lambda e: on_page(change_layout)(str(e.value)))
            if unknown_layout:
                layout.error = words("It is not clear which sensors these files are from. Choose them.")
        if unknown_person or self._mapping.person:
            with ui.row().classes("items-start ps-small-gap w-full"):
                person = ui.input(words("Code of the person (such as S01)"), value=self._mapping.person).classes(
                    "ps-wide"
                )
                tag(person, "person-of-files")
                person.on("keydown.enter", on_page(change_person))
                button("person-use", words("Use this code"), on_page(change_person))
            if unknown_person:
                person.error = words("It is not known whose recordings these are. Enter the code of the person.")

    def _keep_row(self, result: dict[str, Any]) -> None:
        words, workspace = self._words, self._page.workspace
        plain = plain_name(result["name"] or self._incoming.name, words("recordings"))
        free = workspace.free_name(DATASETS, plain, separator=" ")
        name = ui.input(words("Name of the new data set"), value=free).props("maxlength=64")
        tag(name.classes("w-full"), "incoming-name")

        async def keep() -> None:
            with errors_beside(self._page, name):
                place = await run.io_bound(self._incoming.keep, str(name.value or ""))
                if place is not None:
                    self._reset()
                    there = words("The data set “{name}” is there. Review its recordings next.", name=place.name)
                    self._page.say(there, "good")
                    await self._refresh()

        with ui.row().classes("ps-small-gap"):
            text = words("Restore" if result["restored"] else "Import")
            button("import", text, on_page(keep), "unelevated color=primary")
            if not result["restored"]:
                button("map-files", words("Change how they are read"), on_page(lambda: self._inspect("guess")), "flat")
            button("import-cancel", words("Cancel"), on_page(self._cancel), "flat")

    async def _cancel(self) -> None:
        await run.io_bound(self._leave)
        self._reset()

    def _reset(self) -> None:
        self._job, self._layout, self._mapping, self._ended = None, "", FileMapping(), True
        self._busy.set_visibility(False)
        self._box.clear()

    def _leave(self) -> None:
        """Stop the job and remove the files."""
        if self._job is not None:
            self._jobs.stop(self._job.id)
        self._incoming.clear()


_MB = ARCHIVE_BYTES // 1_000_000
