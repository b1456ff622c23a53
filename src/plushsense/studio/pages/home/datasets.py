"""Build the section of the data sets and their backups."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from nicegui import run, ui

from plushsense.dataset.files import DATASETS
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.studio.app.guard import download_address
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs
from plushsense.studio.app.shell import Page, button, named, on_page, tag
from plushsense.studio.app.words import in_context
from plushsense.studio.app.workspace import BACKUPS, plain_name
from plushsense.studio.pages.home.forgetting import ForgetDialog
from plushsense.studio.pages.home.overview import DatasetEntry, WorkspaceSummary
from plushsense.studio.pages.home.sections import (
    SMALL,
    FileActions,
    findings_text,
    open_project_file,
    page_links,
    simulation_badge,
    titled_card,
)
from plushsense.studio.widgets.elements import admitting, size, summary


class DatasetSection:
    """Section that lists the data sets, with links to the pages that use them."""

    def __init__(self, page: Page, jobs: Jobs, actions: FileActions) -> None:
        self._page, self._jobs, self._actions = page, jobs, actions
        with titled_card(page, "Data sets", "datasets"):
            self._rows = ui.column().classes("w-full ps-small-gap")
            self._backups = tag(ui.element("details").classes("w-full"), "backups")
            forget = on_page(ForgetDialog(page, jobs).open)
            button("forget-open", page.words("Forget a person everywhere"), forget, "flat", icon="person_remove")

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
                more = {words("Make a backup"): lambda: self._backup(entry)}
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
            self._page.show_work()

    def _backup(self, entry: DatasetEntry) -> None:
        """Start to write a backup, named after the data set and the day."""
        workspace = self._page.workspace
        with self._page.show_errors():
            stem = f"{plain_name(entry.name, entry.path.name)} {time.strftime('%Y-%m-%d')}"
            place = workspace.folder / BACKUPS / f"{workspace.free_name(BACKUPS, stem, '.zip', separator=' ')}.zip"
            spec = {"dataset": str(entry.path), "place": str(place), "name": entry.name}
            self._jobs.start("backup", spec, self._page.words("Backup of “{name}”", name=entry.name))
            self._page.show_work()

    def _show_backups(self, backups: Sequence[Path]) -> None:
        page, words = self._page, self._page.words
        self._backups.clear()
        self._backups.set_visibility(bool(backups))
        with self._backups:
            summary(words("Backups: {n}", n=len(backups)))
            for path in backups:
                with ui.row().classes("ps-row items-center w-full ps-small-gap"):
                    ui.label(f"{path.stem} · {size(path.stat().st_size, words)}").classes("flex-grow ps-break")
                    link = ui.link(words("Download"), download_address(BACKUPS, path.stem)).classes("ps-link")
                    named(link.props("download"), f"{words('Download')}: {path.stem}")
                    restore = on_page(lambda path=path: admitting(page, partial(self._restore, path)))
                    button("", words("Restore"), restore, SMALL, about=path.stem)
                    discard = on_page(lambda path=path: self._discard(path))
                    button("", words("Discard"), discard, SMALL, about=path.stem)

    async def _restore(self, path: Path, readmit: bool) -> None:
        """Start to restore a backup as a new data set; the present one is not changed."""
        from plushsense.dataset.backup import backup_people
        from plushsense.workflow.project import is_project

        workspace = self._page.workspace
        if is_project(path):
            await open_project_file(self._page, self._jobs, path)
            return
        if not readmit:
            refuse_removed(path, await run.io_bound(backup_people, path) or ())
        name = workspace.free_name(DATASETS, path.stem, separator=" ")
        spec = {"file": str(path), "dest": str(workspace.new(DATASETS, name)), "name": name, "readmit": readmit}
        self._jobs.start("restore", spec, self._page.words("Restoring “{name}”", name=name))
        self._page.show_work()

    async def _discard(self, path: Path) -> None:
        workspace = self._page.workspace
        message = self._page.words("“{name}” is discarded. It can be restored on the home page.", name=path.stem)
        await self._actions.change(lambda: workspace.discard(path), message, workspace.restore)
