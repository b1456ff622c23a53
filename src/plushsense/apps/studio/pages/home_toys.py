"""On the home page: the toys that can be reached, the one that is chosen, and whether it works."""

from __future__ import annotations

from nicegui import run, ui

from plushsense.apps.studio.pages.home_data import SMALL, section, simulated
from plushsense.apps.studio.shell import Page, named, on_ring, tag
from plushsense.apps.studio.toys import PERSONS, Toys, refusal


def toy_section(page: Page, toys: Toys) -> None:
    """Build the section; looks for toys when nobody has looked yet."""
    words, house = page.words, page.house
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
        with page.refusing():
            choose()  # type: ignore[operator]
            page.say("")

    def show_chosen() -> None:
        chosen.clear()
        with chosen:
            if not house.toy:
                ui.label(words("home.no_toy")).classes("ps-dim")
                return
            with ui.row().classes("items-center ps-tight"):
                tag(ui.label(words("home.chosen", url=house.toy)).classes("ps-break text-weight-bold"), "chosen")
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
        except Exception as cause:  # noqa: BLE001 (a driver may fail in ways of its own)
            page.say(refusal(cause), "error")
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
        given = [(url, "", words("home.given")) for url in house.devices]
        listed = [(d.url, d.name, d.description) for d in toys.listing.devices if d.kind != "virtual"]
        with found:
            for url, name, about in [*given, *listed]:
                with ui.row().classes("ps-row items-center justify-between w-full no-wrap"):
                    with ui.column().classes("ps-close"):
                        ui.label(name or url).classes("ps-break")
                        ui.label(" · ".join(t for t in (url if name else "", about) if t)).classes("ps-dim ps-break")
                    choose = ui.button(words("home.choose"), on_click=lambda url=url: take(lambda: toys.choose(url)))
                    named(choose.props(SMALL), f"{words('home.choose')}: {name or url}")
            if toys.looking:
                with ui.row().classes("items-center ps-tight").props('role="status"'):
                    ui.spinner(size="1.2em").props("aria-hidden=true")
                    ui.label(words("home.looking"))
                return
            if toys.looked and not listed:
                ui.label(words("home.none_found")).classes("ps-dim")
            for note in toys.listing.notes:
                ui.label(note).classes("ps-dim ps-note")
            again = ui.button(words("home.look_again" if toys.looked else "home.look"), on_click=toys.look)
            tag(again.props(SMALL), "look")

    def rung() -> None:
        show_chosen()
        show_found()

    rung()
    on_ring(toys.bell, rung)
    if not toys.looked:
        toys.look()
