"""Build the home page: the next step, data sets, networks, uploads, the toy and jobs."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from markupsafe import Markup
from nicegui import context, run, ui

from plushsense.core.errors import need
from plushsense.core.sentences import join_names
from plushsense.dataset.files import DATASETS
from plushsense.studio.app.jobs import RUNNING, Jobs
from plushsense.studio.app.shell import Page, address, button, html, named, on_change, on_page, tag
from plushsense.studio.app.toys import Toys
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import BACKUPS, VIRTUAL, WORK
from plushsense.studio.pages.home.datasets import DatasetSection
from plushsense.studio.pages.home.incoming import IncomingSection
from plushsense.studio.pages.home.overview import NextStep, Overview, SessionEntry, WorkspaceSummary, next_step
from plushsense.studio.pages.home.sections import (
    DiscardedSection,
    FileActions,
    JobList,
    SessionSection,
    page_links,
    put_away,
    simulation_badge,
    titled_card,
)
from plushsense.studio.pages.home.toy import ToySection
from plushsense.studio.widgets.destination import Destination
from plushsense.studio.widgets.elements import ask, style

_NEXT: Texts = {
    "try": (
        "There is nothing here yet. Try everything with a virtual toy, without hardware: recordings take a minute, a "
        "network at most ten."
    ),
    "record": "A toy is chosen: record the first person.",
    "go_on": "Session {session} of {subject} is not finished.",
    "recording": "Session {session} of {subject} is being recorded.",
    "making": "A data set is being made.",
    "collect": "Some sessions are not in a data set yet: {n} (recordings: {recordings}).",
    "review": "Review the recordings of “{name}” before you train a network on them.",
    "more": "“{name}” holds one person only. Record more people, so that the network also works for new people.",
    "train": "“{name}” is ready: train a network on it.",
    "improve": (
        "The network “{name}” is not usable yet, because it may be guessing. Record two more people, or each gesture "
        "two more times, then train again."
    ),
    "test": "Nobody has tested the network “{name}” yet, so it may be guessing. Try it live, or evaluate it.",
    "live": "The network “{name}” is trained. Watch it live, or export it for the toy.",
}

_NEXT_BUTTONS: Texts = {
    "try": "Try everything with a virtual toy",
    "record": "Record",
    "go_on": "Continue recording",
    "recording": "Show the recording",
    "making": "Show the progress",
    "collect": "Put them into a data set",
    "review": "Review",
    "more": "Record",
    "train": "Train",
    "improve": "Record",
    "test": "Watch it live",
    "live": "Watch it live",
    "export": "Export",
}


def bundles(page: Page, actions: FileActions) -> Callable[[WorkspaceSummary], None]:
    """Build the section that lists trained networks; return the function that fills it."""
    box = titled_card(page, "Trained networks", "bundles")
    with box:
        rows = ui.column().classes("w-full ps-small-gap")

    def fill(summary: WorkspaceSummary) -> None:
        rows.clear()
        box.set_visibility(bool(summary.bundles))
        with rows:
            for entry in summary.bundles:
                with tag(ui.column().classes("ps-row w-full"), "bundle"):
                    with ui.row().classes("items-center w-full ps-small-gap"):
                        ui.label(entry.name).classes("text-bold ps-break")
                        if entry.simulated:
                            simulation_badge(page)
                        ui.space()
                        actions.menu(entry.path, entry.name)
                    if entry.refused:
                        ui.label(page.words.sentence(entry.refused)).classes("ps-bad ps-break")
                        continue
                    facts = [page.words("gestures: {n}", n=entry.gestures)]
                    if entry.dataset:
                        facts.append(page.words("trained on “{name}”", name=entry.dataset))
                    ui.label(" · ".join(facts)).classes("ps-dim")
                    from plushsense.studio.widgets.verdict import show_verdict

                    show_verdict(page.words, entry.score)
                    with ui.row().classes("ps-small-gap"):
                        page_links(page, ("live", "export"), entry.name, model=entry.path)

    return fill


def invitation(page: Page) -> None:
    """Build the section that creates one-time addresses for further devices, if visitors need a token."""
    invite = page.workspace.invite
    if invite is None:
        return
    words = page.words
    with titled_card(page, "Connect another device", "invite"):
        about = words(
            "A tablet or another computer needs its own address, which can be opened once. Scan the code with its "
            "camera, or type the address."
        )
        ui.label(about).classes("ps-dim")
        place = ui.column().classes("w-full").props('aria-live="polite"')

        def show() -> None:
            place.clear()
            with place:
                address_of_device = invite()
                text = ui.textarea(words("Address for one device"), value=address_of_device).props("readonly autogrow")
                tag(text.classes("w-full ps-mono"), "invitation")
                with page.show_errors():
                    code = need("segno", "studio").make(address_of_device, error="m")
                    # Light in the dark scheme, too: cameras do not read an inverted code.
                    drawing = Markup(code.svg_inline(scale=5, border=3, light="#ffffff", dark="#000000"))
                    image = html(drawing).props("role=img")
                    tag(named(image, words("QR code of the address")), "invitation-code")

        button("invite-new", words("New address"), show)


def project_section(page: Page, jobs: Jobs, overview: Overview) -> None:
    """Build the section; the file is among the backups, and is opened as one, or where files are imported."""
    words, workspace = page.words, page.workspace

    def save() -> None:
        stem = words("Everything {date}", date=time.strftime("%Y-%m-%d"))
        name = workspace.free_name(BACKUPS, stem, ".zip", separator=" ")
        spec = {
            "place": str(workspace.folder / BACKUPS / f"{name}.zip"),
            "datasets": [str(path) for path in workspace.datasets()],
            "networks": [str(path) for path in workspace.bundles()],
            "name": name,
        }
        with page.show_errors():
            jobs.start("save", spec, words("Saving “{name}”", name=name))

    async def check() -> None:
        """Start to save; ask before if there are sessions that are in no data set, so that they are not saved."""
        found = await run.io_bound(overview.look)
        waiting = [f"{s.subject}/{s.session}" for s in found.sessions if s.waiting] if found else []
        if not waiting:
            save()
            return
        title = words(
            "Not in a data set yet, so not saved: {sessions}. Put them into a data set first.",
            sessions=join_names(waiting, most=_NAMED),
        )
        ask(words, title, words("Save without them"), lambda _: save())

    with titled_card(page, "Everything in one file", "project"):
        about = words(
            "One file holds all data sets and networks, for another computer or a safe place. Opening it adds them and "
            "replaces nothing. Sessions are saved once they are in a data set."
        )
        ui.label(about).classes("ps-dim")
        with ui.row().classes("ps-small-gap"):
            button("save-everything", words("Save everything"), on_page(check), icon="save")
            opener = button("open-everything", words("Open"), icon="folder_open")
            # In the browser, since it opens its dialog only as the answer to a click.
            opener.on("click", js_handler="""() => document.querySelector('[data-test="choose_files"]').click()""")


_NAMED = 5
MAKING = ("simulate", "import", "restore", "open")
CHANGING = (*MAKING, "backup", "save", "forget", "check", "train", "sweep", "search", "export", "publish")
# Enough data to train a network, but simulated within seconds.
_PEOPLE, _REPETITIONS = 6, 2


async def show(page: Page) -> None:
    """Build the page."""
    workspace = page.workspace
    overview, jobs, toys = workspace.part(Overview), workspace.part(Jobs), workspace.part(Toys)
    style()
    summary = await run.io_bound(overview.look)
    step = NextStepCard(page, jobs, toys, lambda: refresh())
    with ui.element("div").classes("ps-two w-full"):
        with ui.column().classes("w-full"):
            actions = FileActions(page, jobs, lambda: refresh())
            datasets = DatasetSection(page, jobs, actions)
            sessions = SessionSection(page, lambda: refresh())
            networks = bundles(page, actions)
            IncomingSection(page, jobs, lambda: refresh())
            discarded = DiscardedSection(page, actions)
        with ui.column().classes("w-full"):
            ToySection(page, toys)
            project_section(page, jobs, overview)
            job_list = JobList(page, jobs)
            invitation(page)

    def fill(now: WorkspaceSummary) -> None:
        for part in (step.fill, datasets.fill, sessions.fill, networks, discarded.fill):
            part(now)

    async def refresh() -> None:
        now = await run.io_bound(overview.look)
        # None means that the studio is ending. The page may also have been closed in the meantime.
        if now is not None and not context.client.is_deleted:
            fill(now)

    def job_states() -> tuple[object, ...]:
        return tuple((j.id, j.state) for j in jobs.all(*CHANGING))

    last = job_states()

    async def update() -> None:
        nonlocal last
        job_list.update()
        if last != (now := job_states()):
            last = now
            await refresh()

    fill(summary or WorkspaceSummary())
    on_change(jobs.changed, update)
    on_change(toys.changed, step.update)
    on_change(toys.in_use_changed, refresh)


class NextStepCard:
    """Card with the suggested next step and its button."""

    def __init__(self, page: Page, jobs: Jobs, toys: Toys, refresh: Callable[[], Awaitable[None]]) -> None:
        self._page, self._jobs, self._toys, self._refresh = page, jobs, toys, refresh
        self._summary = WorkspaceSummary()
        self._step: NextStep | None = None
        self._box = tag(ui.card().classes("ps-card ps-next w-full").props("flat"), "next")

    def fill(self, summary: WorkspaceSummary) -> None:
        """Display the step that suits new contents of the workspace."""
        self._summary = summary
        self.update()

    def update(self) -> None:
        """Display the step that suits the current toy and jobs; rebuild the card only if the step changes."""
        making = any(j.state == RUNNING for j in self._jobs.all(*MAKING))
        step = next_step(self._summary, toy=self._page.workspace.toy, virtual=self._toys.simulated, making=making)
        if step == self._step:
            return
        self._step = step
        words = self._page.words
        self._box.clear()
        with self._box:
            html(words("Next step"), "h2")
            with ui.row().classes("items-center w-full"):
                tag(ui.label(words(_NEXT[step.key], **step.values)), "next-sentence").classes("text-lg")
                call: Callable[[], Any] = lambda: self._do(step)  # noqa: E731
                if step.key == "collect":
                    waiting = self._waiting()
                    destination = Destination(self._page, waiting[0].layout, waiting[0].simulated)
                    call = partial(put_away, self._page, destination, [s.path for s in waiting], self._refresh)
                if text := _NEXT_BUTTONS.get(step.key):
                    button("next-button", words(text), call, "unelevated size=lg color=primary")
                trial = words("Try it with three gestures of your own")
                button("try-three", trial, lambda: ui.navigate.to(address("live", trial="1")))
                if second := {"try": "record", "test": "train", "live": "export"}.get(step.key):
                    button("", words(_NEXT_BUTTONS[second]), lambda: self._go(second, step))

    def _do(self, step: NextStep) -> None:
        if step.key == "try":
            self._try()
        elif step.key == "making":
            self._page.show_work()
        else:
            self._go(step.page, step)

    @staticmethod
    def _go(page: str, step: NextStep) -> None:
        ui.navigate.to(address(page, model=step.values.get("model", "")))

    def _waiting(self) -> list[SessionEntry]:
        """Return the sessions that are in no data set and can go into one together."""
        batches = ([s for s in batch if s.waiting] for batch in self._summary.batches())
        return next(batch for batch in batches if batch)

    def _try(self) -> None:
        """Start to simulate a small data set, and choose the virtual toy if no toy is chosen."""
        workspace = self._page.workspace
        with self._page.show_errors():
            if not workspace.toy:
                self._toys.choose(VIRTUAL)
            name = workspace.free_name(DATASETS, self._page.words("virtual toy"), separator=" ")
            spec = {
                "people": _PEOPLE,
                "repetitions": _REPETITIONS,
                "dest": str(workspace.folder / DATASETS / name),
                "work": str(workspace.folder / WORK),
            }
            self._jobs.start("simulate", spec, self._page.words("Trial: a data set of virtual people"))
            self._page.show_work()
