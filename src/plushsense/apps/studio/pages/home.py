"""Home: what to do next, and what is there."""

from __future__ import annotations

from html import escape

from nicegui import context, run, ui

from plushsense.apps.studio.house import DATASETS, WORK, House
from plushsense.apps.studio.jobs import RUNNING, Jobs
from plushsense.apps.studio.overview import Next, Overview, Seen, next_step
from plushsense.apps.studio.pages.home_data import Datasets, Sessions
from plushsense.apps.studio.pages.home_files import bundles, incoming, invitation
from plushsense.apps.studio.pages.home_toys import toy_section
from plushsense.apps.studio.pages.home_work import Work
from plushsense.apps.studio.shell import Page, address, on_ring, tag
from plushsense.apps.studio.toys import Toys

MAKING = ("simulate", "import")
CHANGING = (*MAKING, "check", "train", "sweep", "search", "export", "publish")
# Enough for a network to learn something of, and made in seconds.
_PEOPLE, _REPETITIONS = 6, 2
_TRY_NAME = "virtual toy"


async def show(page: Page) -> None:
    """Build the page."""
    house = page.house
    overview, jobs, toys = house.part(Overview), house.part(Jobs), house.part(Toys)
    seen = await run.io_bound(overview.look)
    step = NextStep(page, jobs, toys)
    with ui.element("div").classes("ps-two w-full"):
        with ui.column().classes("w-full"):
            datasets = Datasets(page, jobs)
            sessions = Sessions(page, jobs)
            networks = bundles(page)
            incoming(page, jobs, lambda: refresh())
        with ui.column().classes("w-full"):
            toy_section(page, toys)
            work = Work(page, jobs)
            invitation(page)

    def fill(now: Seen) -> None:
        step.fill(now)
        datasets.fill(now)
        sessions.fill(now)
        networks(now)

    async def refresh() -> None:
        now = await run.io_bound(overview.look)
        # None: the studio is ending. The page may have been closed meanwhile.
        if now is not None and not context.client.is_deleted:
            fill(now)

    def standing() -> tuple[object, ...]:
        return tuple((j.id, j.state) for j in jobs.all(*CHANGING))

    last = [standing()]

    async def rung() -> None:
        work.update()
        if last[0] != (now := standing()):
            last[0] = now
            await refresh()

    fill(seen or Seen())
    on_ring(jobs.bell, rung)
    on_ring(toys.bell, step.update)


class NextStep:
    """The one thing to do next, in a sentence with a button."""

    def __init__(self, page: Page, jobs: Jobs, toys: Toys) -> None:
        self._page, self._jobs, self._toys = page, jobs, toys
        self._seen = Seen()
        self._step: Next | None = None
        self._box = tag(ui.card().classes("ps-card ps-next w-full").props("flat"), "next")

    def fill(self, seen: Seen) -> None:
        """Work it out for what is there now."""
        self._seen = seen
        self.update()

    def update(self) -> None:
        """Work it out for the toy and the work of now; the box changes only when the step does."""
        making = any(j.state == RUNNING for j in self._jobs.all(*MAKING))
        step = next_step(self._seen, toy=self._page.house.toy, virtual=self._toys.simulated, making=making)
        if step == self._step:
            return
        self._step = step
        words = self._page.words
        self._box.clear()
        with self._box:
            ui.html(escape(words("home.next")), sanitize=False, tag="h2")
            with ui.row().classes("items-center w-full"):
                tag(ui.label(words(f"home.next_{step.key}", **step.about)), "next-sentence").classes("text-lg")
                if words.has(f"home.next_{step.key}_button"):
                    button = ui.button(words(f"home.next_{step.key}_button"), on_click=lambda: self._do(step))
                    tag(button.props("unelevated size=lg color=primary no-caps"), "next-button")
                if step.key == "try":
                    _second(self._page, "home.next_record_button", "record")
                if step.key == "live":
                    _second(self._page, "home.next_export_button", "export")

    def _do(self, step: Next) -> None:
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
    with page.refusing():
        if not page.house.toy:
            toys.person(7)
        spec = {
            "people": _PEOPLE,
            "repetitions": _REPETITIONS,
            "dest": str(page.house.folder / DATASETS / free_name(page.house, _TRY_NAME)),
            "work": str(page.house.folder / WORK),
        }
        jobs.start("simulate", spec, page.words("home.try_title"))


def free_name(house: House, name: str) -> str:
    """The name, or with a number where that is taken."""
    number = 1
    while (house.folder / DATASETS / (name if number == 1 else f"{name} {number}")).exists():
        number += 1
    return name if number == 1 else f"{name} {number}"
