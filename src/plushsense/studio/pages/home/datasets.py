"""Build the section of the data sets and their backups, and the dialog that removes a person."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from nicegui import run, ui

from plushsense.studio.app.guard import download_address
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs
from plushsense.studio.app.shell import Page, button, heading, named, on_page, tag
from plushsense.studio.app.words import in_context
from plushsense.studio.app.workspace import BACKUPS, BUNDLES, DATASETS, plain_name
from plushsense.studio.pages.home.overview import DatasetEntry, WorkspaceSummary
from plushsense.studio.pages.home.sections import (
    SMALL,
    FileActions,
    findings_text,
    page_links,
    simulation_badge,
    titled_card,
)
from plushsense.studio.widgets.elements import on_enter, open_dialog, size, summary

_MAX_PATHS = 5


class DatasetSection:
    """Section that lists the data sets, with links to the pages that use them."""

    def __init__(self, page: Page, jobs: Jobs, actions: FileActions) -> None:
        self._page, self._jobs, self._actions = page, jobs, actions
        with titled_card(page, "Data sets", "datasets"):
            self._rows = ui.column().classes("w-full ps-small-gap")
            self._backups = tag(ui.element("details").classes("w-full"), "backups")

    def fill(self, contents: WorkspaceSummary) -> None:
        """Replace the displayed data sets by those of ``contents``."""
        self._rows.clear()
        with self._rows:
            if not contents.datasets:
                ui.label(self._page.words("There are no data sets yet.")).classes("ps-dim")
            for entry in contents.datasets:
                self._row(entry)
        self._show_backups(contents.backups)

    def _row(self, entry: DatasetEntry) -> None:
        page, words = self._page, self._page.words
        with tag(ui.column().classes("ps-row w-full"), "dataset"):
            with ui.row().classes("items-center w-full ps-small-gap"):
                ui.label(entry.name).classes("text-bold ps-break")
                if entry.simulated:
                    simulation_badge(page)
                ui.space()
                more = {
                    words("Make a backup"): lambda: self._backup(entry),
                    words("Remove a person"): lambda: ForgetDialog(page, self._jobs, entry).open(),
                }
                self._actions.menu(entry.path, entry.name, {} if entry.refused else more)
            if entry.refused:
                ui.label(words.sentence(entry.refused)).classes("ps-bad ps-break")
                return
            excluded = f" ({words('excluded: {n}', n=entry.excluded)})" if entry.excluded else ""
            facts = [
                words("people: {n}", n=entry.people),
                words("recordings: {n}", n=entry.recordings) + excluded,
                size(entry.bytes, words),
                entry.layout,
            ]
            ui.label(" · ".join(facts)).classes("ps-dim")
            checks = [j for j in self._jobs.all("check") if j.spec.get("dataset") == str(entry.path)]
            last = next((j for j in checks if j.state == DONE and j.result.get("dataset") == str(entry.path)), None)
            unchecked = words(in_context("data set", "Not checked yet."))
            ui.label(unchecked if last is None else findings_text(page, last.result))
            with ui.row().classes("items-center ps-small-gap"):
                page_links(page, ("review", "train", "publish"), entry.name, dataset=entry.path)
                if not any(j.state == RUNNING for j in checks):
                    text = words(in_context("button", "Check"))
                    button("check", text, lambda: self._check(entry), SMALL, about=entry.name)

    def _check(self, entry: DatasetEntry) -> None:
        with self._page.show_errors():
            title = self._page.words("Checking “{name}”", name=entry.name)
            self._jobs.start("check", {"dataset": str(entry.path), "name": entry.name}, title)

    def _backup(self, entry: DatasetEntry) -> None:
        """Start to write a backup, named after the data set and the day."""
        workspace = self._page.workspace
        with self._page.show_errors():
            stem = f"{plain_name(entry.name, entry.path.name)} {time.strftime('%Y-%m-%d')}"
            place = workspace.folder / BACKUPS / f"{workspace.free_name(BACKUPS, stem, '.zip', separator=' ')}.zip"
            spec = {"dataset": str(entry.path), "place": str(place), "name": entry.name}
            self._jobs.start("backup", spec, self._page.words("Backup of “{name}”", name=entry.name))

    def _show_backups(self, backups: Sequence[Path]) -> None:
        words = self._page.words
        self._backups.clear()
        self._backups.set_visibility(bool(backups))
        with self._backups:
            summary(words("Backups: {n}", n=len(backups)))
            for path in backups:
                with ui.row().classes("ps-row items-center w-full ps-small-gap"):
                    ui.label(f"{path.stem} · {size(path.stat().st_size, words)}").classes("flex-grow ps-break")
                    link = ui.link(words("Download"), download_address(BACKUPS, path.stem)).classes("ps-link")
                    named(link.props("download"), f"{words('Download')}: {path.stem}")
                    restore = on_page(lambda path=path: self._restore(path))
                    button("", words("Restore"), restore, SMALL, about=path.stem)
                    discard = on_page(lambda path=path: self._discard(path))
                    button("", words("Discard"), discard, SMALL, about=path.stem)

    def _restore(self, path: Path) -> None:
        """Start to restore a backup as a new data set; the present one is not changed."""
        from plushsense.workflow.project import is_project

        workspace = self._page.workspace
        with self._page.show_errors():
            if is_project(path):
                spec = {"file": str(path), "home": str(workspace.folder), "name": path.stem}
                self._jobs.start("open", spec, self._page.words("Opening “{name}”", name=path.stem))
                return
            name = workspace.free_name(DATASETS, path.stem, separator=" ")
            spec = {"file": str(path), "dest": str(workspace.new(DATASETS, name)), "name": name}
            self._jobs.start("restore", spec, self._page.words("Restoring “{name}”", name=name))

    async def _discard(self, path: Path) -> None:
        workspace = self._page.workspace
        message = self._page.words("“{name}” is discarded. It can be restored on the home page.", name=path.stem)
        await self._actions.change(lambda: workspace.discard(path), message, workspace.restore)


class ForgetDialog:
    """Dialog that removes a person from a data set: choose the person, see everything, then type the code."""

    def __init__(self, page: Page, jobs: Jobs, entry: DatasetEntry) -> None:
        self._page, self._words, self._jobs, self._entry = page, page.words, jobs, entry
        self._person = ""

    async def open(self) -> None:
        """Open the dialog with the choice of the person."""
        from plushsense.dataset.privacy.forget import people_of_dataset

        words = self._words
        with self._page.show_errors():
            self._jobs.check_unused(self._entry.path)
            people = await run.io_bound(people_of_dataset, self._entry.path) or []
            title = words("Removing a person from “{name}”", name=self._entry.name)
            with open_dialog(title, "forget", "ps-dialog") as self._dialog:
                heading(title, 2)
                choice = ui.select(
                    people, label=words("Code of the person"), on_change=lambda e: self._preview(e.value)
                )
                tag(choice.classes("w-full"), "forget-person")
                self._box = ui.column().classes("w-full ps-small-gap").props('aria-live="polite"')
                with ui.row().classes("w-full justify-end"):
                    button("", words("Cancel"), self._dialog.close, "flat")

    async def _preview(self, person: str) -> None:
        """Show what would be removed and what would be left."""
        from plushsense.workflow.datasets import Forgotten, forget

        words, workspace = self._words, self._page.workspace
        self._person = person
        found: Forgotten | None = None
        with self._page.show_errors():
            path = self._entry.path
            found = await run.io_bound(lambda: forget(path, person, bundles=[workspace.folder / BUNDLES]))
        self._box.clear()
        if found is None:
            self._dialog.close()
            return
        plan = found.plan
        with self._box:
            text = words(
                "This is removed and cannot be restored: {files} files, of which {raw} are recordings or streams; "
                "{marks} marks.",
                files=len(plan.files),
                raw=plan.raw,
                marks=plan.marks,
            )
            ui.label(text).classes("text-bold")
            self._paths(plan.files)
            if derived := [*plan.caches, *plan.evaluations, *plan.leftovers]:
                ui.label(words("Everything that may be derived from the person is removed, too:"))
                self._paths(derived)
            sessions = workspace.recordings / person
            rest = [
                *([str(sessions)] if sessions.is_dir() else ()),
                *(b.bundle for b in found.bundles),
                *found.discarded,
                *found.elsewhere,
                *(str(p) for p in sorted((workspace.folder / BACKUPS).glob("*.zip"))),
                *(str(self._entry.path / mention) for mention in plan.mentions),
                *([f"https://doi.org/{plan.published}"] if plan.published else ()),
            ]
            ui.label(words("This remains. Look through it and delete it yourself:")).classes("text-bold")
            self._paths(dict.fromkeys(rest))
            text = words(
                "The studio cannot reach copies elsewhere: memory cards, other computers, toys, published data, keys "
                "of pseudonyms."
            )
            ui.label(text).classes("ps-note")
            button("forget-next", words("Go on"), self._confirm, "outline color=negative")

    @staticmethod
    def _paths(paths: Iterable[str]) -> None:
        listed = list(paths)
        with ui.column().classes("ps-no-gap w-full"):
            for path in listed[:_MAX_PATHS]:
                ui.label(path).classes("ps-break ps-note ps-dim")
            if len(listed) > _MAX_PATHS:
                ui.label(f"… + {len(listed) - _MAX_PATHS}").classes("ps-note ps-dim")

    def _confirm(self) -> None:
        """Ask for the code, and start to remove the person if it is right."""
        words = self._words
        self._box.clear()

        def remove() -> None:
            if str(code.value or "").strip() != self._person:
                code.error = words("This is not the code of the chosen person.")
                return
            self._dialog.close()
            spec = {"dataset": str(self._entry.path), "person": self._person, "name": self._entry.name}
            with self._page.show_errors():
                self._jobs.start("forget", spec, words("Removing a person from “{name}”", name=self._entry.name))

        with self._box:
            person = self._person
            text = words(
                "{person} will be removed from this data set for good. Type the code once more.", person=person
            )
            ui.label(text).classes("text-bold ps-break")
            code = tag(ui.input(words("Code of the person")).props("autofocus").classes("w-full"), "forget-code")
            on_enter(code, on_page(remove))
            button("forget-go", words("Remove for good"), on_page(remove), "unelevated color=negative")
