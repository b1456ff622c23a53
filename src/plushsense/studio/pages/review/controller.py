"""State of one open review page: view, filter, order of recordings and decisions."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol
from urllib.parse import quote, unquote, urlencode

from nicegui import background_tasks, context, run, ui

from plushsense.dataset.quality.findings import SEVERITIES
from plushsense.dataset.quality.registry import CHECKS
from plushsense.studio.app.shell import Page, on_change, tag
from plushsense.studio.pages.review.review import STATES, Review
from plushsense.studio.pages.review.selection import (
    DONE,
    NO_FINDING,
    TO_DO,
    RecordingFilter,
    filter_and_sort,
    resolve_author,
)

TABLE, ONE, OVERLAY = "table", "one", "overlay"
VIEWS = (TABLE, ONE, OVERLAY)
WHO_COOKIE = "plushsense_who"
_AHEAD = 4
_LOOK_S = 1.5


class ListLike(Protocol):
    """The table of recordings, as the controller drives it."""

    first: int

    @property
    def place(self) -> ui.element: ...

    def fill(self) -> None: ...


class RecordingLike(Protocol):
    """The view of one recording, as the controller drives it."""

    @property
    def place(self) -> ui.element: ...

    def draw(self, *, keep: bool = False, low: float | None = None, high: float | None = None) -> None: ...

    def refresh(self, *, moved: bool = True) -> None: ...


class OverlayLike(Protocol):
    """The view of all recordings of a gesture, as the controller drives it."""

    @property
    def place(self) -> ui.element: ...

    def fill(self, anew: bool = True) -> None: ...


class ReviewController:
    """Controls one open review page: which recordings it displays, in which order, and who decides.

    Attributes:
        visit: id of the browser tab; its decisions can be undone one by one, also after a reload.
        current: id of the displayed recording, "" for none.
        order: ids that passed the filter when it was set; `next` skips those that no longer pass.
        ends: whether a suggested stop is accepted, too.
    """

    def __init__(self, page: Page, review: Review, asked: dict[str, str]) -> None:
        self.page, self.review, self.words = page, review, page.words
        self.visit = str(getattr(context.client, "tab_id", None) or context.client.id)
        self.client = context.client
        self.filter = RecordingFilter.of(asked)
        self.by, self.down = "recording", False
        self.view = asked["view"] if asked.get("view") in VIEWS else ONE if asked.get("recording") else TABLE
        self.current = ""
        self.order: list[str] = []
        self.trail: list[str] = []
        self.ends = False
        self.only: dict[str, None] | None = None
        self.title = ""
        self._asked = {k: v for k, v in asked.items() if k in ("dataset", "selection")}
        self._turn = asyncio.Lock()
        self._rows: object = None
        self._said = ""

    def limit(self, title: str, only: list[str]) -> None:
        """Limit the page to a selection of recordings, and report those that do not exist."""
        if not only:
            return
        there = {i: None for i in only if i in self.review.infos}
        self.only, self.title = there, title
        if not self._asked.get("selection"):
            self._asked |= {"title": title}
        if lacking := [i for i in only if i not in there]:
            self.page.say(self.words("review.not_there", n=len(lacking), first=lacking[0]), "warning")

    # Building -----------------------------------------------------------------------------------------------------

    def build(
        self,
        list_view: Callable[[ReviewController], ListLike],
        recording_view: Callable[[ReviewController], RecordingLike],
        overlay_view: Callable[[ReviewController], OverlayLike],
    ) -> None:
        """Build the header, the filters and the three views."""
        words, review = self.words, self.review
        with ui.row().classes("w-full items-center gap-2"):
            tag(ui.label(review.dataset.head.name).classes("text-lg font-bold"), "name")
            if review.dataset.head.simulated:
                tag(ui.label(words("shell.simulation")).classes("ps-said ps-said-warning"), "simulation")
            self.counts = tag(ui.label().props("role=status"), "counts")
            self.making = tag(ui.label().classes("ps-dim").props("role=status"), "making")
            ui.space()
            self.who = ui.input(words("review.who"), value=self._who(), on_change=lambda e: self._keep_who(e.value))
            tag(self.who.props("outlined dense").style("width: 170px"), "who")
            tag(
                ui.link(words("review.to_train"), f"/train?dataset={quote(str(review.path))}").classes("ps-link"),
                "to-train",
            )
        if review.is_labelled:
            tag(ui.label(words("review.labelled")).classes("ps-said ps-said-info w-full"), "labelled")
        with ui.row().classes("w-full items-center gap-2"):
            toggle = ui.toggle({v: words(f"review.view_{v}") for v in VIEWS}, value=self.view)
            toggle.props(f'no-caps unelevated aria-label="{words("review.view")}"').classes("ps-toggle")
            self.views = tag(toggle, "view")
            self.views.on_value_change(lambda e: self.turn_to(str(e.value)))
            self._filters()
        if self.only is not None:
            with tag(ui.row().classes("w-full items-center ps-said ps-said-info"), "selection"):
                ui.label(words("review.selection", n=len(self.only), title=self.title or "")).classes("flex-grow")
                ui.link(words("review.show_all"), f"/review?dataset={quote(str(review.path))}").style("color: inherit")
        self.page_slot = ui.element("div")
        self.list, self.one, self.overlay = list_view(self), recording_view(self), overlay_view(self)
        on_change(review.changed, self.changed)
        ui.timer(_LOOK_S, self._look)

    def _filters(self) -> None:
        words, rows = self.words, self.review.rows.values()
        people = sorted({r.info.subject for r in rows})
        present = {r.info.gesture for r in rows}
        gestures = [g.label for g in self.review.dataset.gestures.gestures if g.label in present]
        gestures += sorted(present - set(gestures))
        states = [TO_DO, DONE, *(s for s in STATES if s != "looking" and (s == "labelled") == self.review.is_labelled)]
        states += ["excluded"] if self.review.is_labelled else []
        options: dict[str, dict[str, str]] = {
            "person": {p: self.person(p) for p in people},
            "gesture": {g: words.gesture(g) for g in gestures},
            "state": {s: words(f"review.state_{s}") for s in dict.fromkeys(states)},
            "severity": {
                **{s: words(f"review.from_{s}") for s in SEVERITIES},
                NO_FINDING: words("review.no_finding"),
            },
            "check": {c: c for c in CHECKS if "recording" in CHECKS[c].scope},
        }
        self._fields: dict[str, Any] = {}
        for key, choices in options.items():
            value = getattr(self.filter, key)
            field = ui.select(choices, value=value if value in choices else None, label=words(f"review.{key}"))
            field.props("outlined dense clearable options-dense").classes("ps-filter")
            self._fields[key] = field
        text = ui.input(words("review.text"), value=self.filter.text).props("outlined dense clearable debounce=250")
        self._fields["text"] = text.classes("ps-filter")
        for key, field in self._fields.items():
            tag(field, f"filter-{key}")
            field.on_value_change(lambda e, key=key: self._filtered(key, e.value))
        self.filter = replace(
            self.filter, **{k: "" for k in options if getattr(self.filter, k) and self._fields[k].value is None}
        )

    async def begin(self, asked: dict[str, str]) -> None:
        """Open the view and the recording that the address names."""
        self.arrange()
        wanted = asked.get("recording", "")
        if wanted and wanted not in self.review.infos:
            with self.page.show_errors():
                self.review.info(wanted)
            wanted = ""
        self.current = wanted or (self.order[0] if self.order else "")
        await self.turn_to(self.view)
        self.changed()

    def person(self, subject: str) -> str:
        """Return the code of a person as the page displays it."""
        return self.words("review.nobody") if subject == "none" else subject

    def _who(self) -> str:
        request = context.client.request
        message = unquote(request.cookies.get(WHO_COOKIE, "")) if request is not None else ""
        try:
            return message or resolve_author("")
        except Exception:  # noqa: BLE001, RUF100
            return ""

    def _keep_who(self, name: str | None) -> None:
        kept = json.dumps(quote(name or ""))
        ui.run_javascript(f"document.cookie = '{WHO_COOKIE}=' + {kept} + '; path=/; max-age=31536000; SameSite=Strict'")

    @property
    def name(self) -> str:
        """Name of the person who decides.

        Raises:
            ConfigError: if neither the field nor the login gives a name.
        """
        return resolve_author(self.who.value or "")

    # What is shown ------------------------------------------------------------------------------------------------

    def arrange(self) -> None:
        """Filter and sort the recordings again."""
        self.order = filter_and_sort(self.review.rows.values(), self.filter, self.only, self.by, self.down)

    async def _filtered(self, key: str, value: Any) -> None:
        self.filter = replace(self.filter, **{key: str(value or "")})
        self.arrange()
        self.list.first = 0
        if self.current not in self.order:
            self.current = self.order[0] if self.order else ""
            self.trail.clear()
        await self.turn_to(self.view)

    async def turn_to(self, view: str) -> None:
        """Switch to the table, the single recording or the overlay."""
        self.view = view
        if self.views.value != view:
            self.views.value = view
            return
        for name, each in ((TABLE, self.list), (ONE, self.one), (OVERLAY, self.overlay)):
            each.place.set_visibility(name == view)
        if view == TABLE:
            self.arrange()
            self.list.fill()
        elif view == ONE:
            await self.go(self.current)
        else:
            self.overlay.fill()
        self._say_address()

    async def open(self, identity: str) -> None:
        """Open the view of one recording."""
        self.current = identity
        await self.turn_to(ONE)

    async def go(self, identity: str, *, remember: bool = False) -> None:
        """Display a recording in the recording view, and read the next ones ahead."""
        with self.page.show_errors():
            if identity and not self.review.is_read(identity):
                await run.io_bound(self.review.signals, identity)
            if remember and self.current and self.current != identity:
                self.trail.append(self.current)
            self.current = identity
            self.one.draw()
        self._say_counts()
        self._say_address()

        ahead = [i for i in self.following(_AHEAD) if not self.review.is_read(i)]
        if ahead:
            background_tasks.create(run.io_bound(self._read_ahead, ahead), name="review: neighbours")

    def _read_ahead(self, identities: list[str]) -> None:
        for identity in identities:
            try:
                self.review.signals(identity)
            except Exception:  # noqa: BLE001, RUF100
                return

    def following(self, many: int = 1) -> list[str]:
        """Return the next recordings of the order that still pass the filter."""
        rows, found = self.review.rows, []
        at = self.order.index(self.current) + 1 if self.current in self.order else 0
        for identity in self.order[at:]:
            if identity in rows and self.filter.fits(rows[identity]):
                found.append(identity)
                if len(found) == many:
                    break
        return found

    async def next(self) -> None:
        """Go to the next recording of the order."""
        async with self._turn:
            await self._next()

    async def _next(self) -> None:
        ahead = self.following()
        if ahead:
            await self.go(ahead[0], remember=True)
        else:
            self.one.draw()
            self.page.say(self.words("review.last"), "good")

    async def back(self) -> None:
        """Go back to the recording displayed before, else to the previous one of the order."""
        async with self._turn:
            while self.trail and self.trail[-1] not in self.review.infos:
                self.trail.pop()
            if self.trail:
                await self.go(self.trail.pop())
            else:
                await self._previous(remember=False)

    async def previous(self) -> None:
        """Go to the previous recording of the order."""
        async with self._turn:
            await self._previous(remember=True)

    async def _previous(self, *, remember: bool) -> None:
        if self.current in self.order and self.order.index(self.current):
            await self.go(self.order[self.order.index(self.current) - 1], remember=remember)

    # Deciding -----------------------------------------------------------------------------------------------------

    async def decide(self, visible: str, decision: Callable[[], Any], *, move: bool = False) -> None:
        """Run a decision about the displayed recording, and go on to the next after success if asked to.

        Do nothing if another recording is displayed by now.
        """
        async with self._turn:
            if visible != self.current:
                return
            done = False
            with self.page.show_errors():
                await run.io_bound(decision)
                done = True
            if done:
                self.page.say("")
            if done and move:
                await self._next()
            else:
                self.one.refresh()

    async def undo(self) -> None:
        """Discard the draft of the displayed recording, else undo the last decision of this browser tab."""
        async with self._turn:
            with self.page.show_errors():
                if self.view == ONE and self.review.drop(self.current):
                    self.page.say("")
                    self.one.refresh()
                    return
                why = self.words("review.taken_back")
                last = await run.io_bound(self.review.undo, self.visit, self.name, why)
                if last is None:
                    self.page.say(self.words("review.nothing_to_undo"))
                    return
                self.page.say(
                    self.words("review.undone", what=self.words(f"review.did_{last.action}"), id=last.recording)
                )
                if self.view == ONE and last.recording in self.review.infos:
                    await self.go(last.recording)

    def changed(self) -> None:
        """Update the page after a change, made here or elsewhere."""
        self._say_making()
        rows = self.review.rows
        if rows is self._rows:
            return
        self._rows = rows
        self._say_counts()
        if self.view == TABLE:
            if not self.order:
                self.arrange()
            self.list.fill()
        elif self.view == ONE:
            self.one.refresh()
        else:
            self.overlay.fill(anew=False)

    async def _look(self) -> None:
        """Read marks that other programs wrote."""
        with self.page.show_errors():
            await run.io_bound(self.review.look)

    def _say_counts(self) -> None:
        rows = self.review.rows.values()
        done = sum(r.done for r in rows)
        self.counts.set_text(self.words("review.counts", done=done, of=len(rows), left=len(rows) - done))

    def _say_making(self) -> None:
        prepared = self.review.prepared
        if prepared.message:
            self.making.set_text(prepared.message)
        elif prepared.progress is not None:
            what, done, of = prepared.progress
            self.making.set_text(self.words(f"review.making_{what}", done=done, of=of))
        else:
            self.making.set_text("")
        self.making.set_visibility(bool(self.making.text))

    def _say_address(self) -> None:
        message = {**self._asked, "dataset": str(self.review.path), **self.filter.query(), "view": self.view}
        if self.view == ONE:
            message["recording"] = self.current
        pairs = list(message.items())
        if self.only is not None and not message.get("selection"):
            pairs += [("recordings", i) for i in self.only]
        address = f"/review?{urlencode(pairs)}"
        if address != self._said:
            self._said = address
            with self.client:
                ui.run_javascript(f"history.replaceState(history.state, '', {json.dumps(address)})")
