"""Home page: the next step, data sets, networks, uploads, the toy, and running work."""

from __future__ import annotations

import uuid
from collections.abc import Awaitable, Callable
from pathlib import Path

from nicegui import context, events, run, ui

from plushsense.core.errors import BundleError, ConfigError
from plushsense.core.layouts import layout_names
from plushsense.models.bundle import Bundle
from plushsense.studio.app.guard import UPLOAD_BYTES
from plushsense.studio.app.jobs import INCOMING, RUNNING, Jobs
from plushsense.studio.app.shell import Page, address, html, named, on_change, tag
from plushsense.studio.app.toys import PERSONS, Toys, error_text
from plushsense.studio.app.workspace import BUNDLES, DATASETS, WORK, Workspace
from plushsense.studio.pages.home.data import SMALL, DatasetSection, SessionSection, section, simulated
from plushsense.studio.pages.home.overview import NextStep, Overview, WorkspaceSummary, next_step
from plushsense.studio.pages.home.work import WorkSection


def toy_section(page: Page, toys: Toys) -> None:  # noqa: C901
    """Build the section; looks for toys when nobody has looked yet."""
    words, workspace = page.words, page.workspace
    with section(page, "home.toy", "toy"):
        chosen = ui.column().classes("w-full ps-tight").props('aria-live="polite"')
        with ui.row().classes("items-end ps-tight w-full"):
            options = {n: words("home.person", n=n) for n in range(1, PERSONS + 1)}
            who = ui.select(options, value=7, label=words("home.virtual_person")).props("dense outlined")
            tag(who.classes("ps-wide"), "person")
            virtual = ui.button(
                words("home.choose_virtual"), on_click=lambda: take(lambda: toys.person(int(who.value)))
            )
            tag(virtual.props("unelevated no-caps"), "virtual")
        found = ui.column().classes("w-full ps-tight")
        with ui.row().classes("items-end ps-tight w-full"):
            other = ui.input(words("home.address"), placeholder="tcp://192.168.1.20:3333").props("dense outlined")
            tag(other.classes("ps-wide"), "address")
            use = ui.button(words("home.use"), on_click=lambda: take(lambda: toys.choose(str(other.value or ""))))
            tag(use.props("outline no-caps"), "use")

    testing = [False]

    def take(choose: object) -> None:
        with page.show_errors():
            choose()  # type: ignore[operator]
            page.say("")

    def show_chosen() -> None:
        chosen.clear()
        with chosen:
            if not workspace.toy:
                ui.label(words("home.no_toy")).classes("ps-dim")
                return
            with ui.row().classes("items-center ps-tight"):
                tag(ui.label(words("home.chosen", url=workspace.toy)).classes("ps-break text-weight-bold"), "chosen")
                if toys.simulated:
                    simulated(page)
            tag(ui.button(words("home.test"), on_click=test).props("outline no-caps"), "test")

    async def test() -> None:
        if testing[0]:
            return
        testing[0] = True
        page.say(words("home.testing"))
        try:
            done = await run.io_bound(toys.test)
        except Exception as cause:  # noqa: BLE001, RUF100
            page.say(error_text(cause), "error")
            return
        finally:
            testing[0] = False
        if done is None:
            # The studio is ending.
            return
        about = {
            "frames": done.frames,
            "seconds": words.number(done.seconds, 1),
            "layout": done.layout,
            "malformed": done.malformed,
            "rate": words.number(done.rate_hz),
        }
        key = "good" if done.fits and done.on_time else "slow" if done.fits else "malformed"
        page.say(words(f"home.test_{key}", **about), "good" if key == "good" else "warning")

    def show_found() -> None:
        found.clear()
        given = [(url, "", words("home.given")) for url in workspace.devices]
        listed = [(d.url, d.name, d.description) for d in toys.listing.devices if d.kind != "virtual"]
        with found:
            for url, name, about in [*given, *listed]:
                with ui.row().classes("ps-row items-center justify-between w-full no-wrap"):
                    with ui.column().classes("ps-close"):
                        ui.label(name or url).classes("ps-break")
                        ui.label(" · ".join(t for t in (url if name else "", about) if t)).classes("ps-dim ps-break")
                    choose = ui.button(words("home.choose"), on_click=lambda url=url: take(lambda: toys.choose(url)))
                    named(choose.props(SMALL), f"{words('home.choose')}: {name or url}")
            if toys.searching:
                with ui.row().classes("items-center ps-tight").props('role="status"'):
                    ui.spinner(size="1.2em").props("aria-hidden=true")
                    ui.label(words("home.looking"))
                return
            if toys.searched and not listed:
                ui.label(words("home.none_found")).classes("ps-dim")
            for note in toys.listing.notes:
                ui.label(note).classes("ps-dim ps-note")
            again = ui.button(words("home.look_again" if toys.searched else "home.look"), on_click=toys.search)
            tag(again.props(SMALL), "look")

    def update() -> None:
        show_chosen()
        show_found()

    update()
    on_change(toys.changed, update)
    if not toys.searched:
        toys.search()


ARCHIVE_BYTES = UPLOAD_BYTES - 1_000_000
"""The largest zip; a request is a little larger than its file."""
BUNDLE_BYTES = 64_000_000


def bundles(page: Page) -> Callable[[WorkspaceSummary], None]:
    """Build the section of trained networks; return the function that fills it."""
    box = section(page, "home.bundles", "bundles")
    with box:
        rows = ui.column().classes("w-full ps-tight")

    def fill(seen: WorkspaceSummary) -> None:
        rows.clear()
        box.set_visibility(bool(seen.bundles))
        with rows:
            for one in seen.bundles:
                with tag(ui.column().classes("ps-row w-full"), "bundle"):
                    with ui.row().classes("items-center ps-tight"):
                        ui.label(one.name).classes("text-weight-bold ps-break")
                        if one.simulated:
                            simulated(page)
                    if one.refused:
                        ui.label(one.refused).classes("ps-bad ps-break")
                        continue
                    facts = [page.words("home.gestures", n=one.gestures)]
                    if one.dataset:
                        facts.append(page.words("home.trained_on", name=one.dataset))
                    ui.label(" · ".join(facts)).classes("ps-dim")
                    with ui.row().classes("ps-tight"):
                        for to in ("live", "export"):
                            link = ui.link(page.words(f"pages.{to}"), address(to, model=one.path)).classes("ps-link")
                            named(link, f"{page.words(f'pages.{to}')}: {one.name}")

    return fill


def incoming(page: Page, jobs: Jobs, changed: Callable[[], Awaitable[None]]) -> None:
    """Build the section for uploads, a zip of recordings or a bundle; ``changed`` is called after a bundle came."""
    words = page.words

    async def take(file: events.UploadEventArguments) -> None:
        """Keep what came, under a name of ours; a bundle is looked at, an archive imported."""
        name = Path(file.file.name.replace("\\", "/")).name
        kind = Path(name).suffix.lower()
        uploader.reset()
        folder = page.workspace.folder / WORK / INCOMING
        with page.show_errors():
            if kind not in (".zip", ".plush"):
                raise ConfigError(f"'{name}' is neither a .zip of recordings nor a .plush bundle: choose one of these.")
            most = BUNDLE_BYTES if kind == ".plush" else ARCHIVE_BYTES
            if file.file.size() > most:
                raise ConfigError(f"'{name}' is larger than the {most / 1e6:g} MB that are accepted.")
            name_or_stem = str(title.value or "").strip() or _plain(Path(name).stem)
            place = page.workspace.new(
                DATASETS if kind == ".zip" else BUNDLES, name_or_stem + (kind if kind != ".zip" else "")
            )
            kept = folder / f"{uuid.uuid4().hex}{kind}"
            await run.io_bound(lambda: folder.mkdir(parents=True, exist_ok=True))
            try:
                await file.file.save(kept)
                if kind == ".plush":
                    await run.io_bound(_settle, kept, place, name)
                    page.say(words("home.bundle_came", name=place.stem), "good")
                    await changed()
                    return
            except BaseException:
                kept.unlink(missing_ok=True)
                raise
            spec = {"archive": str(kept), "dest": str(place), "name": place.name}
            if layout.value:
                spec["layout"] = str(layout.value)
            jobs.start("import", spec, words("home.import_title", name=place.name))
            title.set_value("")
            page.say("")

    def rejected() -> None:
        page.say(words("home.upload_rejected", mb=ARCHIVE_BYTES // 1_000_000), "error")

    with section(page, "home.incoming", "incoming"):
        ui.label(words("home.incoming_about", mb=ARCHIVE_BYTES // 1_000_000, bundle=BUNDLE_BYTES // 1_000_000)).classes(
            "ps-dim"
        )
        with ui.row().classes("items-end ps-tight w-full"):
            title = tag(
                ui.input(words("home.incoming_name")).props("dense outlined").classes("ps-wide"), "incoming-name"
            )
            options = {"": words("home.layout_of_sessions"), **{n: n for n in layout_names()}}
            layout = ui.select(options, value="", label=words("home.layout")).props("dense outlined").classes("ps-wide")
        uploader = ui.upload(
            max_file_size=ARCHIVE_BYTES,
            on_begin_upload=lambda: page.say(words("home.receiving")),
            on_upload=take,
            on_rejected=rejected,
            auto_upload=True,
        )
        # Quasar's uploader is not accessible: a button of ours opens its file dialog.
        tag(uploader.props("accept=.zip,.plush").style("display: none"), "upload")
        choose = ui.button(words("home.choose_file"), icon="upload_file").props("outline no-caps")
        tag(choose, "choose-file").on("click", js_handler=f"() => runMethod({uploader.id}, 'pickFiles', [])")


def _settle(kept: Path, place: Path, name: str) -> None:
    """Move a bundle that can be read to its place; one that cannot is refused."""
    try:
        Bundle.load(kept)
    except BundleError as cause:
        # Name the file as the visitor knows it.
        raise BundleError(str(cause).replace(str(kept), name)) from None
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.exists():
        raise ConfigError(f"'{place.stem}' is there already: give another name, nothing is replaced.")
    kept.rename(place)


def _plain(stem: str) -> str:
    """Return a file's name as a valid name of a data set."""
    kept = "".join(c if c.isalnum() or c in " _-" else " " for c in stem).strip()
    return " ".join(kept.split())[:60] or "recordings"


def invitation(page: Page) -> None:
    """Build the section that gives one-time addresses to further devices, if the studio accepts any."""
    invite = page.workspace.invite
    if invite is None:
        return
    words = page.words
    with section(page, "home.invite", "invite"):
        ui.label(words("home.invite_about")).classes("ps-dim")
        place = ui.column().classes("w-full").props('aria-live="polite"')

        def show() -> None:
            place.clear()
            with place:
                text = ui.input(words("home.invite_address"), value=invite()).props("readonly outlined dense")
                tag(text.classes("w-full ps-mono"), "invitation")

        tag(ui.button(words("home.invite_new"), on_click=show).props("outline no-caps"), "invite-new")


MAKING = ("simulate", "import")
CHANGING = (*MAKING, "check", "train", "sweep", "search", "export", "publish")
# Enough to train a network on, and simulated in seconds.
_PEOPLE, _REPETITIONS = 6, 2
_TRY_NAME = "virtual toy"


async def show(page: Page) -> None:
    """Build the page."""
    workspace = page.workspace
    overview, jobs, toys = workspace.part(Overview), workspace.part(Jobs), workspace.part(Toys)
    seen = await run.io_bound(overview.look)
    step = NextStepCard(page, jobs, toys)
    with ui.element("div").classes("ps-two w-full"):
        with ui.column().classes("w-full"):
            datasets = DatasetSection(page, jobs)
            sessions = SessionSection(page, jobs)
            networks = bundles(page)
            incoming(page, jobs, lambda: refresh())
        with ui.column().classes("w-full"):
            toy_section(page, toys)
            work = WorkSection(page, jobs)
            invitation(page)

    def fill(now: WorkspaceSummary) -> None:
        step.fill(now)
        datasets.fill(now)
        sessions.fill(now)
        networks(now)

    async def refresh() -> None:
        now = await run.io_bound(overview.look)
        # None: the studio is ending. The page may have been closed meanwhile.
        if now is not None and not context.client.is_deleted:
            fill(now)

    def job_states() -> tuple[object, ...]:
        return tuple((j.id, j.state) for j in jobs.all(*CHANGING))

    last = [job_states()]

    async def update() -> None:
        work.update()
        if last[0] != (now := job_states()):
            last[0] = now
            await refresh()

    fill(seen or WorkspaceSummary())
    on_change(jobs.changed, update)
    on_change(toys.changed, step.update)


class NextStepCard:
    """Card with the suggested next step and its button."""

    def __init__(self, page: Page, jobs: Jobs, toys: Toys) -> None:
        self._page, self._jobs, self._toys = page, jobs, toys
        self._seen = WorkspaceSummary()
        self._step: NextStep | None = None
        self._box = tag(ui.card().classes("ps-card ps-next w-full").props("flat"), "next")

    def fill(self, seen: WorkspaceSummary) -> None:
        """Update the step for these contents."""
        self._seen = seen
        self.update()

    def update(self) -> None:
        """Update the step for the current toy and work; the card changes only when the step does."""
        making = any(j.state == RUNNING for j in self._jobs.all(*MAKING))
        step = next_step(self._seen, toy=self._page.workspace.toy, virtual=self._toys.simulated, making=making)
        if step == self._step:
            return
        self._step = step
        words = self._page.words
        self._box.clear()
        with self._box:
            html(words("home.next"), "h2")
            with ui.row().classes("items-center w-full"):
                tag(ui.label(words(f"home.next_{step.key}", **step.about)), "next-sentence").classes("text-lg")
                if words.has(f"home.next_{step.key}_button"):
                    button = ui.button(words(f"home.next_{step.key}_button"), on_click=lambda: self._do(step))
                    tag(button.props("unelevated size=lg color=primary no-caps"), "next-button")
                if step.key == "try":
                    _second(self._page, "home.next_record_button", "record")
                if step.key == "live":
                    _second(self._page, "home.next_export_button", "export")

    def _do(self, step: NextStep) -> None:
        if step.key == "try":
            _try(self._page, self._jobs, self._toys)
        elif step.key == "collect":
            ui.run_javascript(
                "const box = document.querySelector('[data-test=sessions]');"
                "box.scrollIntoView({block: 'center'}); box.querySelector('[data-test=new-name]')?.focus()"
            )
        else:
            ui.navigate.to(address(step.page))


def _second(page: Page, key: str, to: str) -> None:
    ui.button(page.words(key), on_click=lambda: ui.navigate.to(address(to))).props("outline no-caps")


def _try(page: Page, jobs: Jobs, toys: Toys) -> None:
    """Make the small simulated data set, and choose the virtual toy."""
    with page.show_errors():
        if not page.workspace.toy:
            toys.person(7)
        spec = {
            "people": _PEOPLE,
            "repetitions": _REPETITIONS,
            "dest": str(page.workspace.folder / DATASETS / free_name(page.workspace, _TRY_NAME)),
            "work": str(page.workspace.folder / WORK),
        }
        jobs.start("simulate", spec, page.words("home.try_title"))


def free_name(workspace: Workspace, name: str) -> str:
    """Return the name, with a number appended if it is taken."""
    number = 1
    while (workspace.folder / DATASETS / (name if number == 1 else f"{name} {number}")).exists():
        number += 1
    return name if number == 1 else f"{name} {number}"
