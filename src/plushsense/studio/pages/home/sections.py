"""Build sections of the home page: data sets, recorded sessions, and running and earlier jobs."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.dataset.files import person_folders
from plushsense.dataset.privacy.removed import refuse_removed
from plushsense.studio.app.guard import download_address
from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, STOPPED, Jobs, StudioJob
from plushsense.studio.app.shell import Page, address, button, html, moment, named, on_page, page_texts, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BACKUPS, DISCARDED
from plushsense.studio.pages.home.forgetting import receipt_text
from plushsense.studio.pages.home.overview import DatasetEntry, SessionEntry, WorkspaceSummary
from plushsense.studio.widgets.destination import Destination, moved, session_name, take_back
from plushsense.studio.widgets.elements import (
    JOB_STATES,
    admitting,
    ask,
    change_files,
    folded_lines,
    item_menu,
    summary,
    title_of,
)

_KINDS: Texts = {
    "recordings": "Session",
    "datasets": "Data set",
    "bundles": "Network",
    "protocols": "List of gestures",
    "backups": "Backup",
}

_STATES: Texts = {
    "active": "being recorded now",
    "finished": "finished",
    "unfinished": "not finished",
}

SMALL = 'outline padding="4px 12px"'
"""Quasar properties of the buttons inside rows of a list."""
PAGE_OF = {
    "check": "review",
    "import": "review",
    "simulate": "review",
    "train": "train",
    "sweep": "train",
    "search": "train",
    "evaluate": "train",
    "make": "train",
    "export": "export",
    "verify": "export",
    "publish": "publish",
    "restore": "review",
}
"""Maps each task to the page that displays its result."""
_SIGNS = {RUNNING: "▶", DONE: "✓", REFUSED: "✕", STOPPED: "■"}
_MAX_EARLIER = 6


def titled_card(page: Page, title: str, name: str) -> ui.card:
    """Add a card with a heading; screen readers list it as a region."""
    box = tag(ui.card().classes("ps-card w-full").props("flat"), name)
    named(box.props("role=region"), page.words(title))
    with box:
        html(page.words(title), "h2")
    return box


def simulation_badge(page: Page) -> None:
    """Add the label that marks simulated data."""
    ui.label(page.words("Simulation")).classes("ps-simulated")


def page_links(page: Page, pages: tuple[str, ...], name: str, **query: Any) -> None:
    """Add links to pages that open with ``query``; screen readers also read ``name``."""
    for to in pages:
        text = page.words(page_texts(to).name)
        named(ui.link(text, address(to, **query)).classes("ps-link"), f"{text}: {name}")


class FileActions:
    """Actions on data sets and bundles: rename, discard, restore and delete; ``refresh`` shows the files again."""

    def __init__(self, page: Page, jobs: Jobs, refresh: Callable[[], Awaitable[None]]) -> None:
        self._page, self._jobs, self._refresh = page, jobs, refresh

    def menu(self, path: Path, name: str, more: Mapping[str, Callable[[], Any]] | None = None) -> None:
        """Add the menu of a data set or bundle; ``more`` maps the texts of further items to their functions."""
        words, workspace = self._page.words, self._page.workspace

        async def rename(new: str) -> None:
            message = words("“{name}” is now called “{new}”.", name=name, new=new)
            await self.change(lambda: workspace.rename(path, new), message, lambda now: workspace.rename(now, name))

        async def discard() -> None:
            with self._page.show_errors():
                self._jobs.check_unused(path)
                message = words("“{name}” is discarded. It can be restored on the home page.", name=name)
                await self.change(lambda: workspace.discard(path), message, workspace.restore)

        def ask_name() -> None:
            title = words("Rename “{name}”", name=name)
            ask(words, title, words("Rename"), rename, words("New name"), name)

        item_menu(words, name, {words("Rename"): ask_name, **(more or {}), words("Discard"): discard})

    async def change(self, work: Callable[[], Any], message: str, undo: Callable[[Any], Any] | None = None) -> None:
        """Change files as `change_files` does."""
        await change_files(self._page, work, message, self._refresh, undo)


class DiscardedSection:
    """Section that lists the discarded sessions, data sets and bundles; hidden if there are none."""

    def __init__(self, page: Page, actions: FileActions) -> None:
        self._page, self._actions = page, actions
        with tag(ui.element("details").classes("ps-card w-full"), "discarded") as self._box:
            summary(page.words("Discarded"))
            self._rows = ui.column().classes("w-full ps-small-gap")

    def fill(self, contents: WorkspaceSummary) -> None:
        """Replace the displayed files."""
        words, workspace = self._page.words, self._page.workspace
        self._rows.clear()
        self._box.set_visibility(bool(contents.discarded))
        with self._rows:
            for path in contents.discarded:
                kind, _, name = path.relative_to(workspace.folder / DISCARDED).as_posix().partition("/")
                self._row(path, f"{words(_KINDS[kind])}: {name}", name)

    def _row(self, path: Path, text: str, name: str) -> None:
        words, workspace, change = self._page.words, self._page.workspace, self._actions.change

        def restore(readmit: bool) -> Awaitable[None]:
            if not readmit:
                refuse_removed(path, (path.parent.name, *person_folders(path)))
            return change(lambda: workspace.restore(path), words("“{name}” is restored.", name=name))

        async def delete(_: str) -> None:
            await change(lambda: workspace.delete(path), words("“{name}” is deleted.", name=name))

        def ask_delete() -> None:
            title = words("Delete “{name}” for good? Only a copy elsewhere can bring it back.", name=name)
            ask(words, title, words("Delete for good"), delete)

        with ui.row().classes("ps-row items-center w-full ps-small-gap"):
            ui.label(text).classes("flex-grow ps-break")
            button("", words("Restore"), on_page(lambda: admitting(self._page, restore)), SMALL, about=name)
            button("", words("Delete for good"), ask_delete, SMALL, about=name)


def findings_text(page: Page, result: dict[str, Any]) -> str:
    """Summarise the findings of a check in one line."""
    counts = result.get("by_severity") or {}
    return page.words(
        "Checked: {undecided} to decide, {warnings} to look at, {notes} good to know.",
        undecided=result.get("undecided", 0),
        warnings=counts.get("warning", 0),
        notes=counts.get("info", 0),
    )


async def open_project_file(page: Page, jobs: Jobs, path: Path) -> None:
    """Start to open a project; ask before if people would come back who were removed."""
    from plushsense.workflow.project import project_people

    words = page.words

    def begin(readmit: bool) -> None:
        spec = {"file": str(path), "home": str(page.workspace.folder), "name": path.stem, "readmit": readmit}
        with page.show_errors():
            jobs.start("open", spec, words("Opening “{name}”", name=path.stem))
            page.show_work()

    async def check(readmit: bool) -> None:
        if not readmit:
            refuse_removed(path, await run.io_bound(project_people, path) or ())
        begin(readmit)

    await admitting(page, check, (words("Open without them"), lambda: begin(False)))


async def put_away(
    page: Page, destination: Destination, sessions: list[Path], refresh: Callable[[], Awaitable[None]]
) -> None:
    """Put sessions into the chosen data set; then say where they are, with a button to take them out again."""
    names = list(map(session_name, sessions))

    async def undone() -> None:
        await refresh()
        page.say(page.words("Undone."), "good")

    def done(place: Path) -> None:
        text = moved(names, page.workspace.title(place))
        page.say(text, "good", lambda: take_back(page, place, names, undone))

    await destination.put(sessions, done)


class SessionSection:
    """Section that lists the recorded sessions and imports them into data sets; ``refresh`` shows all files again."""

    def __init__(self, page: Page, refresh: Callable[[], Awaitable[None]]) -> None:
        self._page, self._refresh = page, refresh
        self._chosen: set[str] = set()
        self._displayed: tuple[object, ...] = ()
        self._box = titled_card(page, "Recorded sessions", "sessions")
        with self._box:
            self._inner = ui.column().classes("w-full ps-small-gap")
        self._box.set_visibility(False)

    def fill(self, summary: WorkspaceSummary) -> None:
        """Display the sessions; keep the selection if neither they nor the data sets have changed."""
        readable = [d for d in summary.datasets if not d.refused]
        current = (summary.sessions, tuple((d.path, d.name, d.simulated, d.layout) for d in readable))
        if current == self._displayed:
            return
        self._displayed = current
        self._chosen = {str(s.path) for s in summary.sessions if s.waiting}
        self._box.set_visibility(bool(summary.sessions))
        self._inner.clear()
        with self._inner:
            for batch in summary.batches():
                self._batch(batch, readable)
            for entry in summary.sessions:
                if entry.refused or not entry.recordings:
                    ui.label(self._describe(entry)).classes("ps-bad" if entry.refused else "ps-dim")

    def _batch(self, batch: tuple[SessionEntry, ...], datasets: list[DatasetEntry]) -> None:
        page, words = self._page, self._page.words
        with tag(ui.column().classes("ps-row w-full"), "batch"):
            if batch[0].simulated:
                simulation_badge(page)
            scroll = ui.column().classes("ps-scroll w-full ps-no-gap").props("tabindex=0 role=group")
            with named(scroll, words("Recorded sessions")):
                for entry in batch:
                    box = ui.checkbox(self._describe(entry), value=str(entry.path) in self._chosen)
                    box.on_value_change(lambda e, entry=entry: self._choose(entry, bool(e.value)))
                    box.set_enabled(not entry.active)
            destination = Destination(page, batch[0].layout, batch[0].simulated, words("Recorded sessions"))
            button("make", words("Put them into a data set"), partial(self._put, batch, destination), "unelevated")

    def _describe(self, entry: SessionEntry) -> str:
        words = self._page.words
        if entry.refused:
            return f"{entry.subject}/{entry.session}: {words.sentence(entry.refused)}"
        facts = [
            entry.subject,
            words("session {name}", name=entry.session),
            moment(entry.start_s),
            words("recordings: {n}", n=entry.recordings),
            words(_STATES["active" if entry.active else "finished" if entry.finished else "unfinished"]),
        ]
        if entry.removed:
            facts.append(words("this person was removed"))
        if entry.datasets:
            facts.append(words("in the data sets {names}", names=", ".join(f"“{n}”" for n in entry.datasets)))
        return " · ".join(facts)

    def _choose(self, entry: SessionEntry, chosen: bool) -> None:
        (self._chosen.add if chosen else self._chosen.discard)(str(entry.path))

    async def _put(self, batch: tuple[SessionEntry, ...], destination: Destination) -> None:
        chosen = [s.path for s in batch if str(s.path) in self._chosen]
        if not chosen:
            self._page.say(self._page.words("No session is chosen. Tick at least one."), "warning")
            return
        await put_away(self._page, destination, chosen, self._refresh)


class JobList:
    """Section of running and earlier jobs; progress is updated in place, so that a focused button keeps the focus."""

    def __init__(self, page: Page, jobs: Jobs) -> None:
        self._page, self._jobs = page, jobs
        self._displayed: tuple[Any, ...] | None = None
        self._progress_bars: dict[str, tuple[ui.label, ui.linear_progress]] = {}
        page.work = titled_card(page, "Jobs", "work")
        with page.work:
            self._rows = ui.column().classes("w-full ps-small-gap")
        self.update()

    def update(self) -> None:
        """Display the current state of the jobs."""
        jobs = [j for j in self._jobs.all() if not j.spec.get("dry")]
        running = [j for j in jobs if j.state == RUNNING]
        displayed = [*running, *[j for j in jobs if j.state != RUNNING][:_MAX_EARLIER]]
        current = tuple((j.id, j.state) for j in displayed)
        if current != self._displayed:
            self._displayed = current
            self._rows.clear()
            self._progress_bars.clear()
            with self._rows:
                if not current:
                    ui.label(self._page.words("Nothing is running.")).classes("ps-dim")
                for job in displayed:
                    with tag(ui.column().classes("ps-row w-full ps-small-gap"), f"job-{job.state}"):
                        self._row(job)
        for job in running:
            label, bar = self._progress_bars[job.id]
            text, share = self._progress(job)
            label.set_text(text)
            bar.set_value(share or 0.0)
            bar.set_visibility(share is not None)

    def _row(self, job: StudioJob) -> None:
        words, title = self._page.words, title_of(self._page.words, job)
        ui.label(f"{_SIGNS[job.state]} {title}").classes("text-bold ps-break")
        if job.state == RUNNING:
            label = tag(ui.label(), "job-progress")
            bar = ui.linear_progress(0.0, show_value=False, size="10px").props("rounded")
            self._progress_bars[job.id] = (label, named(bar, title))
        else:
            ui.label(f"{words(JOB_STATES[job.state])} · {moment(job.ended_s or job.begun_s)}").classes("ps-dim")
        if job.state == REFUSED:
            ui.label(words.failure(job.refusal)).classes("ps-bad ps-break")
        if job.state == DONE:
            self._result(job)
        with ui.row().classes("items-center ps-small-gap"):
            if job.state == DONE and job.task in PAGE_OF:
                sessions = ",".join(session_name(Path(each)) for each in job.spec.get("sessions", ()))
                place = job.result.get("dataset") or ""
                page_links(self._page, (PAGE_OF[job.task],), title, dataset=place, session=sessions)
            if job.state == RUNNING:
                self._button("stop", words("Stop"), title, lambda: self._jobs.stop(job.id))
                return
            if job.state == STOPPED:
                self._button("again", words("Start again"), title, lambda: self._jobs.resume(job.id))
            self._button("drop", words("Remove from the list"), title, lambda: self._jobs.drop(job.id))

    def _button(self, key: str, label: str, title: str, action: Callable[[], object]) -> None:
        def clicked() -> None:
            with self._page.show_errors():
                action()

        button(f"job-{key}", label, clicked, SMALL, about=title)

    def _progress(self, job: StudioJob) -> tuple[str, float | None]:
        """Return the progress as text, and as a fraction from 0 to 1 (None if unknown)."""
        minutes, seconds = divmod(int(max(0.0, time.time() - job.begun_s)), 60)
        text = f"{self._page.words('running')} · {minutes}:{seconds:02d}"
        done, total = job.progress.get("done"), job.progress.get("total")
        if isinstance(done, int | float) and isinstance(total, int | float) and total > 0:
            share = min(1.0, done / total)
            count = f"{100 * share:.0f} %" if job.task in ("backup", "restore") else f"{done:g} / {total:g}"
            return f"{text} · {count}", share
        return text, None

    def _result(self, job: StudioJob) -> None:
        page, words, result = self._page, self._page.words, job.result
        if job.task == "check":
            ui.label(findings_text(page, result))
        if job.task in ("backup", "save"):
            place = Path(job.spec["place"])
            ui.label(words("Written and read back: {file}", file=str(place))).classes("ps-break")
            link = ui.link(words("Download"), download_address(BACKUPS, place.stem)).classes("ps-link")
            tag(link.props("download"), "download")
        if job.task in ("save", "open"):
            datasets = words("data sets: {n}", n=len(result["datasets"]))
            ui.label(f"{datasets} · {words('networks: {n}', n=len(result['networks']))}")
        if job.task == "forget":
            ui.label(words("Removed for good: {n}. Not removed: {left}.", n=result["removed"], left=result["left"]))
            # The receipt names the person, so that it is not stored.
            if receipt := result.get("receipt"):
                text, file = receipt_text(page, receipt, job.ended_s), f"{words('receipt')}.txt"
                save = words("Save the receipt")
                button("receipt", save, lambda: ui.download.content(text, file), SMALL, icon="download")
        if job.task in ("import", "simulate", "restore"):
            people = result.get("subjects", result.get("people", 0))
            facts = [words("recordings: {n}", n=result["recordings"]), words("people: {n}", n=people)]
            if job.spec.get("add"):
                facts.append(words("new: {n}", n=result["added"]["recordings"]))
            ui.label(" · ".join(facts))
        warnings = [words.sentence(w) for w in (*job.warnings, *result.get("warnings", ()))]
        if n := result.get("flagged"):
            warnings.append(words("Recordings with something to look at: {n}. The page Review shows them.", n=n))
        rejected = [f"{r['file']}: {words.sentence(r['reason'])}" for r in result.get("rejected", ())]
        folded_lines(words, words("Warnings: {n}", n=len(warnings)), warnings)
        folded_lines(words, words("Files that are not imported: {n}", n=len(rejected)), rejected)
