"""Build the home page: the next step, data sets, networks, uploads, the toy and jobs."""

from __future__ import annotations

import uuid
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from nicegui import context, events, run, ui

from plushsense.core.errors import BundleError, ConfigError, PlushSenseError
from plushsense.core.layouts import layout_names
from plushsense.models.bundle import Bundle
from plushsense.studio.app.guard import UPLOAD_BYTES
from plushsense.studio.app.jobs import INCOMING, RUNNING, Jobs
from plushsense.studio.app.shell import Page, address, button, html, on_change, tag
from plushsense.studio.app.toys import PERSONS, Toys
from plushsense.studio.app.workspace import BUNDLES, DATASETS, WORK
from plushsense.studio.pages.home.overview import NextStep, Overview, WorkspaceSummary, next_step
from plushsense.studio.pages.home.sections import (
    SMALL,
    DatasetSection,
    DiscardedSection,
    FileActions,
    JobList,
    SessionSection,
    page_links,
    simulation_badge,
    titled_card,
)


def toy_section(page: Page, toys: Toys) -> None:  # noqa: C901
    """Build the section for choosing a toy, and search for toys unless a search was made before."""
    words, workspace = page.words, page.workspace
    with titled_card(page, "home.toy", "toy"):
        chosen = ui.column().classes("w-full ps-small-gap").props('aria-live="polite"')
        with ui.row().classes("items-end ps-small-gap w-full"):
            options = {n: words("home.person", n=n) for n in range(1, PERSONS + 1)}
            who = ui.select(options, value=7, label=words("home.virtual_person")).classes("ps-wide")
            tag(who, "person")
            button("virtual", words("home.choose_virtual"), lambda: choose(toys.person, int(who.value)), "unelevated")
        others = ui.column().classes("w-full ps-small-gap")
        with ui.row().classes("items-end ps-small-gap w-full"):
            other = ui.input(words("home.address"), placeholder="tcp://192.168.1.20:3333").classes("ps-wide")
            tag(other, "address")
            button("use", words("home.use"), lambda: choose(toys.choose, str(other.value or "")))

    testing = False

    def choose(command: Callable[[Any], object], toy: Any) -> None:
        with page.show_errors():
            command(toy)
            page.say("")

    def show_chosen() -> None:
        chosen.clear()
        with chosen:
            if not workspace.toy:
                ui.label(words("home.no_toy")).classes("ps-dim")
                return
            with ui.row().classes("items-center ps-small-gap"):
                tag(ui.label(words("home.chosen", url=workspace.toy)).classes("ps-break text-bold"), "chosen")
                if toys.simulated:
                    simulation_badge(page)
            button("test", words("home.test"), test)

    async def test() -> None:
        nonlocal testing
        if testing:
            return
        testing = True
        page.say(words("home.testing"))
        try:
            result = await run.io_bound(toys.test)
        except Exception as cause:  # noqa: BLE001, RUF100
            text = " ".join(str(cause).split()) or type(cause).__name__
            text = words.error(cause) if isinstance(cause, PlushSenseError) else words.explain(text)
            page.say(text, "error")
            return
        finally:
            testing = False
        if result is None:
            # The studio is ending.
            return
        values = {
            "frames": result.frames,
            "seconds": words.number(result.seconds, 1),
            "layout": result.layout,
            "malformed": result.malformed,
            "rate": words.number(result.rate_hz),
        }
        key = "good" if result.fits and result.on_time else "slow" if result.fits else "malformed"
        page.say(words(f"home.test_{key}", **values), "good" if key == "good" else "warning")

    def show_others() -> None:
        others.clear()
        given = [(url, "", words("home.given")) for url in workspace.devices]
        listed = [(d.url, d.name, d.description) for d in toys.listing.devices if d.kind != "virtual"]
        with others:
            for url, name, about in [*given, *listed]:
                with ui.row().classes("ps-row items-center justify-between w-full no-wrap"):
                    with ui.column().classes("ps-no-gap"):
                        ui.label(name or url).classes("ps-break")
                        ui.label(" · ".join(t for t in (url if name else "", about) if t)).classes("ps-dim ps-break")
                    button("", words("home.choose"), lambda url=url: choose(toys.choose, url), SMALL, about=name or url)
            if toys.searching:
                with ui.row().classes("items-center ps-small-gap").props('role="status"'):
                    ui.spinner(size="1.2em").props("aria-hidden=true")
                    ui.label(words("home.looking"))
                return
            if toys.searched and not listed:
                ui.label(words("home.none_found")).classes("ps-dim")
            for note in toys.listing.notes:
                ui.label(note).classes("ps-dim ps-note")
            button("look", words("home.look_again" if toys.searched else "home.look"), toys.search, SMALL)

    def update() -> None:
        show_chosen()
        show_others()

    update()
    on_change(toys.changed, update)
    if not toys.searched:
        toys.search()


ARCHIVE_BYTES = UPLOAD_BYTES - 1_000_000
"""Maximum size of an uploaded zip in bytes; the request that carries it is slightly larger."""
BUNDLE_BYTES = 64_000_000


def bundles(page: Page, actions: FileActions) -> Callable[[WorkspaceSummary], None]:
    """Build the section that lists trained networks; return the function that fills it."""
    box = titled_card(page, "home.bundles", "bundles")
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
                        ui.label(entry.refused).classes("ps-bad ps-break")
                        continue
                    facts = [page.words("home.gestures", n=entry.gestures)]
                    if entry.dataset:
                        facts.append(page.words("home.trained_on", name=entry.dataset))
                    ui.label(" · ".join(facts)).classes("ps-dim")
                    with ui.row().classes("ps-small-gap"):
                        page_links(page, ("live", "export"), entry.name, model=entry.path)

    return fill


def uploads(page: Page, jobs: Jobs, on_bundle: Callable[[], Awaitable[None]]) -> None:
    """Build the section for uploads of a zip of recordings or a bundle; call ``on_bundle`` after storing a bundle."""
    words = page.words

    async def take(file: events.UploadEventArguments) -> None:
        """Store the uploaded file under a random name; then check and move a bundle, or start to import a zip."""
        name = Path(file.file.name.replace("\\", "/")).name
        kind = Path(name).suffix.lower()
        uploader.reset()
        folder = page.workspace.folder / WORK / INCOMING
        with page.show_errors():
            if kind not in (".zip", ".plush"):
                raise ConfigError(f"'{name}' is neither a .zip of recordings nor a .plush bundle: choose one of these.")
            limit = BUNDLE_BYTES if kind == ".plush" else ARCHIVE_BYTES
            if file.file.size() > limit:
                raise ConfigError(f"'{name}' is larger than the {limit / 1e6:g} MB that are accepted.")
            title = str(name_field.value or "").strip() or _plain(Path(name).stem)
            place = page.workspace.new(*((BUNDLES, f"{title}.plush") if kind == ".plush" else (DATASETS, title)))
            stored = folder / f"{uuid.uuid4().hex}{kind}"
            await run.io_bound(lambda: folder.mkdir(parents=True, exist_ok=True))
            try:
                await file.file.save(stored)
                if kind == ".plush":
                    await run.io_bound(_move_bundle, stored, place, name)
                    page.say(words("home.bundle_came", name=place.stem), "good")
                    await on_bundle()
                    return
            except BaseException:
                stored.unlink(missing_ok=True)
                raise
            spec = {"archive": str(stored), "dest": str(place), "name": place.name}
            if layout.value:
                spec["layout"] = str(layout.value)
            jobs.start("import", spec, words("home.import_title", name=place.name))
            name_field.set_value("")
            page.say("")

    archive_mb, bundle_mb = ARCHIVE_BYTES // 1_000_000, BUNDLE_BYTES // 1_000_000
    with titled_card(page, "home.incoming", "incoming"):
        ui.label(words("home.incoming_about", mb=archive_mb, bundle=bundle_mb)).classes("ps-dim")
        with ui.row().classes("items-end ps-small-gap w-full"):
            name_field = tag(ui.input(words("home.incoming_name")).classes("ps-wide"), "incoming-name")
            options = {"": words("home.layout_of_sessions"), **{n: n for n in layout_names()}}
            layout = ui.select(options, value="", label=words("home.layout")).classes("ps-wide")
        uploader = ui.upload(
            max_file_size=ARCHIVE_BYTES,
            on_begin_upload=lambda: page.say(words("home.receiving")),
            on_upload=take,
            on_rejected=lambda: page.say(words("home.upload_rejected", mb=archive_mb), "error"),
            auto_upload=True,
        )
        # Quasar's uploader is not accessible: a separate button opens its file dialog.
        tag(uploader.props("accept=.zip,.plush").style("display: none"), "upload")
        choose = button("choose-file", words("home.choose_file"), icon="upload_file")
        choose.on("click", js_handler=f"() => runMethod({uploader.id}, 'pickFiles', [])")


def _move_bundle(stored: Path, place: Path, name: str) -> None:
    """Check an uploaded bundle and move it from ``stored`` to ``place``; ``name`` is the name of the uploaded file.

    Raises:
        BundleError: if the bundle cannot be read.
        ConfigError: if ``place`` exists.
    """
    try:
        Bundle.load(stored)
    except BundleError as cause:
        # The visitor knows the name of the uploaded file, not the path where it is stored.
        raise BundleError(str(cause).replace(str(stored), name)) from None
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.exists():
        raise ConfigError(f"'{place.stem}' exists already: give another name, nothing is replaced.")
    stored.rename(place)


def _plain(stem: str) -> str:
    """Turn the stem of a file name into a valid name for a data set."""
    plain = "".join(c if c.isalnum() or c in " _-" else " " for c in stem)
    return " ".join(plain.split())[:60] or "recordings"


def invitation(page: Page) -> None:
    """Build the section that creates one-time addresses for further devices, if visitors need a token."""
    invite = page.workspace.invite
    if invite is None:
        return
    words = page.words
    with titled_card(page, "home.invite", "invite"):
        ui.label(words("home.invite_about")).classes("ps-dim")
        place = ui.column().classes("w-full").props('aria-live="polite"')

        def show() -> None:
            place.clear()
            with place:
                text = ui.input(words("home.invite_address"), value=invite()).props("readonly")
                tag(text.classes("w-full ps-mono"), "invitation")

        button("invite-new", words("home.invite_new"), show)


MAKING = ("simulate", "import")
CHANGING = (*MAKING, "check", "train", "sweep", "search", "export", "publish")
# Enough data to train a network, but simulated within seconds.
_PEOPLE, _REPETITIONS = 6, 2
_TRY_NAME = "virtual toy"


async def show(page: Page) -> None:
    """Build the page."""
    workspace = page.workspace
    overview, jobs, toys = workspace.part(Overview), workspace.part(Jobs), workspace.part(Toys)
    summary = await run.io_bound(overview.look)
    step = NextStepCard(page, jobs, toys)
    with ui.element("div").classes("ps-two w-full"):
        with ui.column().classes("w-full"):
            actions = FileActions(page, jobs, lambda: refresh())
            datasets = DatasetSection(page, jobs, actions)
            sessions = SessionSection(page, jobs)
            networks = bundles(page, actions)
            uploads(page, jobs, lambda: refresh())
            discarded = DiscardedSection(page, actions)
        with ui.column().classes("w-full"):
            toy_section(page, toys)
            job_list = JobList(page, jobs)
            invitation(page)

    def fill(now: WorkspaceSummary) -> None:
        step.fill(now)
        datasets.fill(now)
        sessions.fill(now)
        networks(now)
        discarded.fill(now.discarded)

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
    on_change(workspace.recording_changed, refresh)


class NextStepCard:
    """Card with the suggested next step and its button."""

    def __init__(self, page: Page, jobs: Jobs, toys: Toys) -> None:
        self._page, self._jobs, self._toys = page, jobs, toys
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
            html(words("home.next"), "h2")
            with ui.row().classes("items-center w-full"):
                tag(ui.label(words(f"home.next_{step.key}", **step.values)), "next-sentence").classes("text-lg")
                if text := words.get(f"home.next_{step.key}_button"):
                    button("next-button", text, lambda: self._do(step), "unelevated size=lg color=primary")
                if second := {"try": "record", "live": "export"}.get(step.key):
                    button("", words(f"home.next_{second}_button"), lambda: ui.navigate.to(address(second)))

    def _do(self, step: NextStep) -> None:
        if step.key == "try":
            self._try()
        elif step.key == "collect":
            self._collect()
        else:
            ui.navigate.to(address(step.page))

    def _collect(self) -> None:
        """Import the sessions that are in no data set; add them to one that fits, if there is one."""
        workspace = self._page.workspace
        batch = next(b for b in self._summary.batches() if any(s.waiting for s in b))
        with self._page.show_errors():
            place = workspace.dataset_for(batch[0].layout, batch[0].simulated)
            title = self._page.words("home.import_title", name=workspace.title(place))
            self._jobs.import_sessions([s.path for s in batch if s.waiting], place, title)

    def _try(self) -> None:
        """Start to simulate a small data set, and choose the virtual toy if no toy is chosen."""
        workspace = self._page.workspace
        with self._page.show_errors():
            if not workspace.toy:
                self._toys.person(7)
            spec = {
                "people": _PEOPLE,
                "repetitions": _REPETITIONS,
                "dest": str(workspace.folder / DATASETS / workspace.free_name(DATASETS, _TRY_NAME, separator=" ")),
                "work": str(workspace.folder / WORK),
            }
            self._jobs.start("simulate", spec, self._page.words("home.try_title"))
