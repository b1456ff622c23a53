"""Import files from the browser: upload them, show what they contain, and keep them as a data set or network."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
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
from plushsense.dataset.files import person_folders
from plushsense.dataset.importing.archives import UnpackLimits, member_target
from plushsense.dataset.privacy.removed import CONSENT, refuse_removed
from plushsense.dataset.store import HEAD, UNKNOWN_SUBJECT, DatasetHead
from plushsense.studio.app.guard import UPLOAD_BYTES
from plushsense.studio.app.jobs import DONE, INCOMING, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, button, heading, on_change, on_page, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BUNDLES, DATASETS, WORK, Workspace, plain_name
from plushsense.studio.pages.home.sections import simulation_badge, titled_card
from plushsense.studio.widgets.elements import MAX_LINES, errors_beside, facts, folded_lines, notice

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
_ACCEPTED = ".zip,.plush,.csv,.xdf,.xdfz,.parquet"
# Files that desktops leave in folders; nobody chose them.
_OF_DESKTOPS = (".DS_Store", "Thumbs.db", "desktop.ini")


def _about(file: str, note: Message) -> Message:
    return Message("{file}: {note}", file=file, note=note)


def _is_of_preview(note: str | dict[str, Any]) -> bool:
    """Return whether the preview shows a note in another way."""
    from plushsense.dataset.importing.results import SIMULATED
    from plushsense.dataset.importing.sources import LAYOUT_GUESSED

    return isinstance(note, dict) and note["template"] in (SIMULATED.template, LAYOUT_GUESSED)


class Incoming:
    """Uploaded files of one page, and the data set that is made of them, in a folder of their own.

    Recordings are in ``files``; archives and tables, each of which is imported by itself, are in ``single``.
    """

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self.folder = workspace.folder / WORK / INCOMING / uuid.uuid4().hex
        self.dataset = self.folder / "dataset"
        self.refused: list[Message] = []
        self.readmit = False
        """Whether people are taken in who were removed."""
        self.bundles: list[str] = []
        """Names of the networks that were added."""
        self._names: list[str] = []
        self._count = self._bytes = self._tries = 0

    @property
    def sources(self) -> list[Path]:
        """The files and the folder to import."""
        single = sorted((self.folder / "single").glob("*"))
        return [*single, *(p for p in (self.folder / "files",) if p.is_dir())]

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
        table = kind == ".csv" and parse_name(target.name) is None and target.name.lower() != STREAM_NAME
        alone = kind in (".zip", ".parquet", ".plush") or (table and len(target.parts) == 1)
        place = self.folder / ("single" if alone else "files") / (target.name if alone else target)
        await run.io_bound(lambda: place.parent.mkdir(parents=True, exist_ok=True))
        await file.save(place)
        if kind == ".plush":
            await run.io_bound(self._add_bundle, place)
        else:
            self._names.append(target.parts[0] if len(target.parts) > 1 else target.stem)

    def _add_bundle(self, stored: Path) -> None:
        """Check an uploaded network, and move it to the networks of the studio."""
        from plushsense.models.bundle import Bundle

        name = plain_name(stored.stem, "network")
        try:
            if stored.stat().st_size > BUNDLE_BYTES:
                raise ConfigError("a network has at most {mb} MB", mb=f"{BUNDLE_BYTES / 1e6:g}")
            Bundle.load(stored)
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

        Raises:
            ConfigError: for a name that is not a plain file name, or that exists already.
        """
        if not self.readmit:
            refuse_removed(self.folder, person_folders(self.dataset))
        place = self._workspace.new(DATASETS, name)
        place.parent.mkdir(parents=True, exist_ok=True)
        write_file(self.dataset / HEAD, replace(DatasetHead.read(self.dataset), name=place.name).to_toml())
        self.dataset.rename(place)
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
        self._progress: ui.label | None = None
        self._layout = self._person = ""
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
        added, incoming.bundles = incoming.bundles, []
        if added:
            page.say(words("The network “{name}” is added.", name="”, “".join(added)), "good")
            await self._refresh()
        if refused:
            page.say(" ".join(words.sentence(note) for note in refused[:MAX_LINES]), "error")
        if incoming.sources:
            self._inspect()

    # Preview --------------------------------------------------------------------------------------------------

    def _inspect(self) -> None:
        """Start the job that makes a data set of the files, with the current layout and person."""
        if self._job is not None:
            self._jobs.stop(self._job.id)
        spec = {
            "sources": [str(path) for path in self._incoming.sources],
            "dest": str(self._incoming.new_dataset()),
            "layout": self._layout,
            "person": self._person,
            "readmit": self._incoming.readmit,
            "dry": True,
        }
        self._ended = False
        with self._page.show_errors():
            self._job = self._jobs.start("inspect", spec, self._words("Looking at the files …"))
        self._update()

    def _update(self) -> None:
        job = self._job
        if job is None or self._ended:
            return
        if job.state == RUNNING:
            done, total = job.progress.get("done"), job.progress.get("total")
            text = self._words("Looking at the files …") + (f" {done} / {total}" if total else "")
            if self._progress is None:
                self._box.clear()
                with self._box, ui.row().classes("items-center ps-small-gap").props('role="status"'):
                    ui.spinner(size="1.2em").props("aria-hidden=true")
                    self._progress = tag(ui.label(text), "inspecting")
            self._progress.set_text(text)
            return
        self._ended = True
        self._show(job)

    def _show(self, job: StudioJob) -> None:
        """Show what the files contain, or why they cannot be imported, with the fields that may mend it."""
        words, result = self._words, job.result
        self._progress = None
        self._box.clear()
        with self._box, tag(ui.column().classes("ps-row w-full ps-small-gap"), "preview"):
            reasons = [r["reason"] for r in result.get("rejected", ())]
            needs = {r["values"].get("needs") for r in (job.refusal, *reasons) if isinstance(r, dict) and r}
            unknown_person = "person" in needs or UNKNOWN_SUBJECT in result.get("people", ())
            heading(words("What the files contain"), 3)
            if job.state == DONE:
                self._contents(result)
            elif "person" not in needs:
                message = words.failure(job.refusal) or words("stopped")
                tag(notice(message, "error"), "preview-problem")
            if not result.get("restored"):
                self._settings(str(result.get("layout", self._layout)), unknown_person, "layout" in needs)
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

    def _settings(self, current: str, unknown_person: bool, unknown_layout: bool) -> None:
        """Add the fields of what the files do not state: the layout, and the person where it is not known."""
        words = self._words

        def change_layout(name: str) -> None:
            self._layout = name
            self._inspect()

        def change_person() -> None:
            if (code := str(person.value or "").strip()) != self._person:
                self._person = code
                self._inspect()

        options = {name: f"{name}: {words(_LAYOUTS.get(name, load_layout(name).title))}" for name in layout_names()}
        layout = ui.select(options, value=current if current in options else None, label=words("Sensors of the toy"))
        tag(layout.classes("w-full"), "layout").on_value_change(lambda e: on_page(change_layout)(str(e.value)))
        layout.props(
            f'hint="{words("Guessed from the files. Change it if it is wrong.")}"'
            if current and not self._layout
            else ""
        )
        if unknown_layout:
            layout.error = words("It is not clear which sensors these files are from. Choose them.")
        if unknown_person or self._person:
            with ui.row().classes("items-start ps-small-gap w-full"):
                person = ui.input(words("Code of the person (such as S01)"), value=self._person).classes("ps-wide")
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
            button("import-cancel", words("Cancel"), on_page(self._cancel), "flat")

    async def _cancel(self) -> None:
        await run.io_bound(self._leave)
        self._reset()

    def _reset(self) -> None:
        self._job, self._progress, self._layout, self._person, self._ended = None, None, "", "", True
        self._box.clear()

    def _leave(self) -> None:
        """Stop the job and remove the files."""
        if self._job is not None:
            self._jobs.stop(self._job.id)
        self._incoming.clear()


_MB = ARCHIVE_BYTES // 1_000_000
