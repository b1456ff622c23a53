"""Sections of the home page: the data sets, and the sessions that they are made of."""

from __future__ import annotations

import time

from nicegui import ui

from plushsense.studio.app.jobs import DONE, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, address, html, named, tag
from plushsense.studio.app.workspace import DATASETS, WORK
from plushsense.studio.pages.home.overview import DatasetEntry, SessionEntry, WorkspaceSummary

SMALL = 'outline no-caps padding="4px 12px"'
"""Looks of the buttons in rows."""


def size(page: Page, count: float) -> str:
    """Format a number of bytes in the page's language."""
    return f"{page.words.number(count / 1e6, 1)} MB" if count < 1e9 else f"{page.words.number(count / 1e9, 2)} GB"


def section(page: Page, title: str, name: str) -> ui.card:
    """Add a box with a heading that screen readers find as a region."""
    box = tag(ui.card().classes("ps-card w-full").props("flat"), name)
    named(box.props("role=region"), page.words(title))
    with box:
        html(page.words(title), "h2")
    return box


def simulated(page: Page) -> None:
    """Add the mark of a simulation."""
    ui.label(page.words("home.simulated")).classes("ps-simulated")


class DatasetSection:
    """Section that lists the data sets, with links to the pages that use them."""

    def __init__(self, page: Page, jobs: Jobs) -> None:
        self._page, self._jobs = page, jobs
        with section(page, "home.datasets", "datasets"):
            self._rows = ui.column().classes("w-full ps-tight")

    def fill(self, seen: WorkspaceSummary) -> None:
        """Show these data sets."""
        self._rows.clear()
        with self._rows:
            if not seen.datasets:
                ui.label(self._page.words("home.no_datasets")).classes("ps-dim")
            for one in seen.datasets:
                self._row(one)

    def _row(self, one: DatasetEntry) -> None:
        page, words = self._page, self._page.words
        with tag(ui.column().classes("ps-row w-full"), "dataset"):
            with ui.row().classes("items-center w-full ps-tight"):
                ui.label(one.name).classes("text-weight-bold")
                if one.simulated:
                    simulated(page)
            if one.refused:
                ui.label(one.refused).classes("ps-bad")
                return
            facts = [
                words("home.people", n=one.people),
                words("home.recordings", n=one.recordings)
                + (f" ({words('home.excluded', n=one.excluded)})" if one.excluded else ""),
                size(page, one.bytes),
                one.layout,
            ]
            ui.label(" · ".join(facts)).classes("ps-dim")
            ui.label(self._findings(one))
            with ui.row().classes("items-center ps-tight"):
                for to in ("review", "train", "publish"):
                    link = ui.link(words(f"pages.{to}"), address(to, dataset=one.path)).classes("ps-link")
                    named(link, f"{words(f'pages.{to}')}: {one.name}")
                busy = any(
                    j.state == RUNNING and j.spec.get("dataset") == str(one.path) for j in self._jobs.all("check")
                )
                if not busy:
                    check = ui.button(words("home.check"), on_click=lambda: self._check(one))
                    named(check.props(SMALL), f"{words('home.check')}: {one.name}")

    def _findings(self, one: DatasetEntry) -> str:
        done = self._newest(one)
        if done is None:
            return self._page.words("home.unchecked")
        return findings(self._page, done.result)

    def _newest(self, one: DatasetEntry) -> StudioJob | None:
        mine = (j for j in self._jobs.all("check") if j.state == DONE and j.result.get("dataset") == str(one.path))
        return next(mine, None)

    def _check(self, one: DatasetEntry) -> None:
        with self._page.show_errors():
            title = self._page.words("home.check_title", name=one.name)
            self._jobs.start("check", {"dataset": str(one.path)}, title)


def findings(page: Page, result: dict[str, object]) -> str:
    """Summarise the findings of a check in one line."""
    by = result.get("by_severity")
    counts = by if isinstance(by, dict) else {}
    return page.words(
        "home.findings",
        undecided=result.get("undecided", 0),
        warnings=counts.get("warning", 0),
        notes=counts.get("info", 0),
    )


class SessionSection:
    """Section that lists the recorded sessions and makes data sets of them."""

    def __init__(self, page: Page, jobs: Jobs) -> None:
        self._page, self._jobs = page, jobs
        self._chosen: set[str] = set()
        self._displayed: tuple[object, ...] = ()
        self._box = section(page, "home.sessions", "sessions")
        with self._box:
            self._inner = ui.column().classes("w-full ps-tight")
        self._box.set_visibility(False)

    def fill(self, seen: WorkspaceSummary) -> None:
        """Show these sessions; the selection is kept while they are the same."""
        current = (
            seen.sessions,
            tuple((d.path, d.name, d.simulated, d.layout) for d in seen.datasets if not d.refused),
        )
        if current == self._displayed:
            return
        self._displayed = current
        self._chosen = {str(s.path) for s in seen.sessions if s.waiting}
        self._box.set_visibility(bool(seen.sessions))
        self._inner.clear()
        with self._inner:
            for batch in seen.batches():
                self._batch(batch, [d for d in seen.datasets if not d.refused])
            for one in seen.sessions:
                if one.refused or not one.recordings:
                    ui.label(self._describe(one)).classes("ps-bad" if one.refused else "ps-dim")

    def _batch(self, batch: tuple[SessionEntry, ...], datasets: list[DatasetEntry]) -> None:
        page, words = self._page, self._page.words
        with tag(ui.column().classes("ps-row w-full"), "batch"):
            if batch[0].simulated:
                simulated(page)
            scroll = ui.column().classes("ps-scroll w-full ps-close").props("tabindex=0 role=group")
            with named(scroll, words("home.sessions")):
                for one in batch:
                    box = ui.checkbox(self._describe(one), value=str(one.path) in self._chosen)
                    box.on_value_change(lambda e, one=one: self._choose(one, bool(e.value)))
            with ui.row().classes("items-end ps-tight w-full"):
                name = tag(ui.input(words("home.name")).props("dense outlined").classes("ps-wide"), "new-name")
                make = ui.button(words("home.make"), on_click=lambda: self._make(batch, str(name.value or "")))
                tag(make.props("unelevated no-caps"), "make")
            fitting = {
                str(d.path): d.name
                for d in datasets
                if d.simulated == batch[0].simulated and d.layout == batch[0].layout
            }
            if fitting:
                with ui.row().classes("items-end ps-tight w-full"):
                    to = ui.select(fitting, value=next(iter(fitting)), label=words("home.add_to"))
                    to.props("dense outlined").classes("ps-wide")
                    add = ui.button(words("home.add"), on_click=lambda: self._add(batch, str(to.value)))
                    tag(add.props("outline no-caps"), "add")

    def _describe(self, one: SessionEntry) -> str:
        words = self._page.words
        if one.refused:
            return f"{one.subject}/{one.session}: {one.refused}"
        facts = [
            one.subject,
            words("home.session", name=one.session),
            time.strftime("%Y-%m-%d %H:%M", time.localtime(one.began_s)),
            words("home.recordings", n=one.recordings),
            words("home.finished" if one.finished else "home.unfinished"),
        ]
        if one.kept:
            facts.append(words("home.kept", names=", ".join(f"“{n}”" for n in one.kept)))
        return " · ".join(facts)

    def _choose(self, one: SessionEntry, chosen: bool) -> None:
        (self._chosen.add if chosen else self._chosen.discard)(str(one.path))

    def _of(self, batch: tuple[SessionEntry, ...]) -> list[str]:
        return [str(s.path) for s in batch if str(s.path) in self._chosen]

    def _make(self, batch: tuple[SessionEntry, ...], name: str) -> None:
        with self._page.show_errors():
            place = self._page.workspace.new(DATASETS, name)
            self._start(batch, {"dest": str(place), "name": place.name}, place.name)

    def _add(self, batch: tuple[SessionEntry, ...], dataset: str) -> None:
        with self._page.show_errors():
            place = self._page.workspace.inside(dataset)
            self._start(batch, {"dest": str(place), "add": True}, self._page.workspace.title(place))

    def _start(self, batch: tuple[SessionEntry, ...], spec: dict[str, object], name: str) -> None:
        workspace = self._page.workspace
        chosen = self._of(batch)
        if not chosen:
            self._page.say(self._page.words("home.none_chosen"), "warning")
            return
        spec |= {"sessions": chosen, "recordings": str(workspace.recordings), "work": str(workspace.folder / WORK)}
        self._page.say("")
        self._jobs.start("import", spec, self._page.words("home.import_title", name=name))
