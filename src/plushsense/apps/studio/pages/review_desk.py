"""One open review page: what is shown of a data set, in which order, who decides, and doing it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from urllib.parse import quote, unquote, urlencode

from nicegui import background_tasks, context, run, ui

from plushsense.apps.studio.pages.review_list import ListView
from plushsense.apps.studio.pages.review_one import OneView
from plushsense.apps.studio.pages.review_overlay import OverlayView
from plushsense.apps.studio.review_filter import DONE, NO_FINDING, TO_DO, Filter, chosen
from plushsense.apps.studio.review_row import STATES
from plushsense.apps.studio.reviewing import Review
from plushsense.apps.studio.reviews import signed
from plushsense.apps.studio.shell import Page, on_ring, tag
from plushsense.dataset.quality.finding import SEVERITIES
from plushsense.dataset.quality.table import CHECKS

TABLE, ONE, OVERLAY = "table", "one", "overlay"
VIEWS = (TABLE, ONE, OVERLAY)
WHO_COOKIE = "plushsense_who"
_AHEAD = 4
_LOOK_S = 1.5


class Desk:
    """One open page: what is shown of a review, in which order, and who decides.

    Attributes:
        visit: names this browser tab; its decisions are taken back one by one, also after a reload.
        current: the recording on the desk, "" for none. ``order``: those that were shown when the filter was set;
            the next one is the next of these that still fits.
        ends: whether a suggested end is taken, too.
    """

    def __init__(self, page: Page, review: Review, asked: dict[str, str]) -> None:
        self.page, self.review, self.words = page, review, page.words
        self.visit = str(getattr(context.client, "tab_id", None) or context.client.id)
        self.client = context.client
        self.filter = Filter.of(asked)
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
        """Show only a selection of recordings; those that are not there are named."""
        if not only:
            return
        there = {i: None for i in only if i in self.review.infos}
        self.only, self.title = there, title
        if not self._asked.get("selection"):
            self._asked |= {"title": title}
        if lacking := [i for i in only if i not in there]:
            self.page.say(self.words("review.not_there", n=len(lacking), first=lacking[0]), "warning")

    # Building -----------------------------------------------------------------------------------------------------

    def build(self) -> None:
        """The head, the filters and the three views."""
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
        self.list, self.one, self.overlay = ListView(self), OneView(self), OverlayView(self)
        on_ring(review.bell, self.changed)
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
        """Show what the address asks for."""
        self.arrange()
        wanted = asked.get("recording", "")
        if wanted and wanted not in self.review.infos:
            with self.page.refusing():
                self.review.info(wanted)
            wanted = ""
        self.current = wanted or (self.order[0] if self.order else "")
        await self.turn_to(self.view)
        self.changed()

    def person(self, subject: str) -> str:
        """A person's code as it is said."""
        return self.words("review.nobody") if subject == "none" else subject

    def _who(self) -> str:
        request = context.client.request
        said = unquote(request.cookies.get(WHO_COOKIE, "")) if request is not None else ""
        try:
            return said or signed("")
        except Exception:  # noqa: BLE001 (nobody is logged in by name: the field stays empty and is asked for)
            return ""

    def _keep_who(self, name: str | None) -> None:
        kept = json.dumps(quote(name or ""))
        ui.run_javascript(f"document.cookie = '{WHO_COOKIE}=' + {kept} + '; path=/; max-age=31536000; SameSite=Strict'")

    @property
    def name(self) -> str:
        """Who decides.

        Raises:
            ConfigError: where nobody said.
        """
        return signed(self.who.value or "")

    # What is shown ------------------------------------------------------------------------------------------------

    def arrange(self) -> None:
        """Filter and sort anew."""
        self.order = chosen(self.review.rows.values(), self.filter, self.only, self.by, self.down)

    async def _filtered(self, key: str, value: Any) -> None:
        self.filter = replace(self.filter, **{key: str(value or "")})
        self.arrange()
        self.list.first = 0
        if self.current not in self.order:
            self.current = self.order[0] if self.order else ""
            self.trail.clear()
        await self.turn_to(self.view)

    async def turn_to(self, view: str) -> None:
        """Show the table, one recording or the overlay."""
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
        """Show one recording alone."""
        self.current = identity
        await self.turn_to(ONE)

    async def go(self, identity: str, *, remember: bool = False) -> None:
        """Put a recording on the desk."""
        with self.page.refusing():
            if identity and not self.review.is_read(identity):
                await run.io_bound(self.review.signals, identity)
            if remember and self.current and self.current != identity:
                self.trail.append(self.current)
            self.current = identity
            self.one.draw()
        self._say_counts()
        self._say_address()
        # The neighbours, so that they are there when they are asked for.
        ahead = [i for i in self.following(_AHEAD) if not self.review.is_read(i)]
        if ahead:
            background_tasks.create(run.io_bound(self._read_ahead, ahead), name="review: neighbours")

    def _read_ahead(self, identities: list[str]) -> None:
        for identity in identities:
            try:
                self.review.signals(identity)
            except Exception:  # noqa: BLE001 (it is said when somebody looks at it)
                return

    def following(self, many: int = 1) -> list[str]:
        """The next recordings of the order that still fit the filter."""
        rows, found = self.review.rows, []
        at = self.order.index(self.current) + 1 if self.current in self.order else 0
        for identity in self.order[at:]:
            if identity in rows and self.filter.fits(rows[identity]):
                found.append(identity)
                if len(found) == many:
                    break
        return found

    async def next(self) -> None:
        """The next recording of the order."""
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
        """The recording that was shown before, or the one before in the order."""
        async with self._turn:
            while self.trail and self.trail[-1] not in self.review.infos:
                self.trail.pop()
            if self.trail:
                await self.go(self.trail.pop())
            else:
                await self._previous(remember=False)

    async def previous(self) -> None:
        """The recording before in the order."""
        async with self._turn:
            await self._previous(remember=True)

    async def _previous(self, *, remember: bool) -> None:
        if self.current in self.order and self.order.index(self.current):
            await self.go(self.order[self.order.index(self.current) - 1], remember=remember)

    # Deciding -----------------------------------------------------------------------------------------------------

    async def decide(self, shown: str, decision: Callable[[], Any], *, move: bool = False) -> None:
        """Do something about the recording that was on screen; go on to the next where it was done.

        Nothing is done where another one has come on the desk since.
        """
        async with self._turn:
            if shown != self.current:
                return
            done = False
            with self.page.refusing():
                await run.io_bound(decision)
                done = True
            if done:
                self.page.say("")
            if done and move:
                await self._next()
            else:
                self.one.refresh()

    async def undo(self) -> None:
        """Take the last thing back: what was set and not accepted, else the last decision of this visit."""
        async with self._turn:
            with self.page.refusing():
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
        """Something changed, here or elsewhere."""
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
        """Take in what other programs marked."""
        with self.page.refusing():
            await run.io_bound(self.review.look)

    def _say_counts(self) -> None:
        rows = self.review.rows.values()
        done = sum(r.done for r in rows)
        self.counts.set_text(self.words("review.counts", done=done, of=len(rows), left=len(rows) - done))

    def _say_making(self) -> None:
        prepared = self.review.prepared
        if prepared.said:
            self.making.set_text(prepared.said)
        elif prepared.progress is not None:
            what, done, of = prepared.progress
            self.making.set_text(self.words(f"review.making_{what}", done=done, of=of))
        else:
            self.making.set_text("")
        self.making.set_visibility(bool(self.making.text))

    def _say_address(self) -> None:
        said = {**self._asked, "dataset": str(self.review.path), **self.filter.said(), "view": self.view}
        if self.view == ONE:
            said["recording"] = self.current
        pairs = list(said.items())
        if self.only is not None and not said.get("selection"):
            pairs += [("recordings", i) for i in self.only]
        address = f"/review?{urlencode(pairs)}"
        if address != self._said:
            self._said = address
            with self.client:
                ui.run_javascript(f"history.replaceState(history.state, '', {json.dumps(address)})")
