"""On the home page: trained networks, files that are brought in, and letting another device in."""

from __future__ import annotations

import uuid
from collections.abc import Awaitable, Callable
from pathlib import Path

from nicegui import events, run, ui

from plushsense.apps.studio.guard import UPLOAD_BYTES
from plushsense.apps.studio.house import BUNDLES, DATASETS, WORK
from plushsense.apps.studio.jobs import INCOMING, Jobs
from plushsense.apps.studio.overview import Seen
from plushsense.apps.studio.pages.home_data import section, simulated
from plushsense.apps.studio.shell import Page, address, named, tag
from plushsense.core.errors import BundleError, ConfigError
from plushsense.core.signal import layout_names
from plushsense.models.bundle import Bundle

ARCHIVE_BYTES = UPLOAD_BYTES - 1_000_000
"""What a zip may weigh: the request holds a little more than the file."""
BUNDLE_BYTES = 64_000_000


def bundles(page: Page) -> Callable[[Seen], None]:
    """The section of trained networks; returns what fills it."""
    box = section(page, "home.bundles", "bundles")
    with box:
        rows = ui.column().classes("w-full ps-tight")

    def fill(seen: Seen) -> None:
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
    """Recordings as a zip, or a bundle, from the visitor's own machine; ``changed`` is called after a bundle came."""
    words = page.words

    async def take(file: events.UploadEventArguments) -> None:
        """Keep what came, under a name of ours; a bundle is looked at, an archive imported."""
        name = Path(file.file.name.replace("\\", "/")).name
        kind = Path(name).suffix.lower()
        uploader.reset()
        folder = page.house.folder / WORK / INCOMING
        with page.refusing():
            if kind not in (".zip", ".plush"):
                raise ConfigError(f"'{name}' is neither a .zip of recordings nor a .plush bundle: choose one of these.")
            most = BUNDLE_BYTES if kind == ".plush" else ARCHIVE_BYTES
            if file.file.size() > most:
                raise ConfigError(f"'{name}' is larger than the {most / 1e6:g} MB that are accepted.")
            wanted = str(title.value or "").strip() or _plain(Path(name).stem)
            place = page.house.new(DATASETS if kind == ".zip" else BUNDLES, wanted + (kind if kind != ".zip" else ""))
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
        # Its own looks cannot be read by everybody: a button stands for it, and in the browser, where files are chosen.
        tag(uploader.props("accept=.zip,.plush").style("display: none"), "upload")
        choose = ui.button(words("home.choose_file"), icon="upload_file").props("outline no-caps")
        tag(choose, "choose-file").on("click", js_handler=f"() => getElement({uploader.id}).pickFiles()")


def _settle(kept: Path, place: Path, name: str) -> None:
    """Move a bundle that can be read to its place; one that cannot is refused."""
    try:
        Bundle.load(kept)
    except BundleError as cause:
        # The visitor knows it by its own name.
        raise BundleError(str(cause).replace(str(kept), name)) from None
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.exists():
        raise ConfigError(f"'{place.stem}' is there already: give another name, nothing is replaced.")
    kept.rename(place)


def _plain(stem: str) -> str:
    """A file's name as a name that a data set can have."""
    kept = "".join(c if c.isalnum() or c in " _-" else " " for c in stem).strip()
    return " ".join(kept.split())[:60] or "recordings"


def invitation(page: Page) -> None:
    """A one-time address for one more device, where the studio lets any in."""
    invite = page.house.invite
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
