"""Hold the state of one open review page: view, filter, order of recordings and decisions."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol
from urllib.parse import quote, unquote, urlencode

from nicegui import background_tasks, context, run, ui

from plushsense.core.errors import PlushSenseError
from plushsense.dataset.quality.checking import CHECKS, author_name
from plushsense.dataset.quality.findings import SEVERITIES
from plushsense.studio.app.shell import Page, address, button, on_change, set_address, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.pages.review.review import (
    EXCLUDED,
    LABELLED,
    LOOKING,
    STATE_TEXTS,
    STATES,
    Review,
    ReviewedRecording,
)

_VIEWS: Texts = {
    "table": "Table",
    "one": "One by one",
    "overlay": "Overlay",
    "stream": "Streams",
    "durations": "Durations",
}

_SEVERITIES: Texts = {
    "error": "✖ to decide",
    "warning": "▲ to look at, or more urgent",
    "info": "ℹ any finding",
}

_FILTERS: Texts = {
    "person": "Person",
    "gesture": "Gesture",
    "state": "State",
    "severity": "Urgency",
    "check": "Check",
}

_DID: Texts = {
    "trim": "setting start and end",
    "untrim": "removing the trim",
    "exclude": "excluding",
    "include": "including again",
    "accept": "accepting a finding",
    "unaccept": "reopening a finding",
    "label": "labelling a stretch",
    "unlabel": "removing labels",
    "relabel": "setting another gesture",
}

_DONE: Texts = {
    "trim": "Starts accepted: {n}.",
    "exclude": "Excluded: {n}.",
    "include": "Included again: {n}.",
    "relabel": "Set to another gesture: {n}.",
}
"""What was done to several recordings; the keys are kinds of marks."""

_MAKING: Texts = {
    "suggestions": "Looking for starts: {done} of {of}. You can begin already.",
    "checks": "Checking: {done} of {of} files.",
}

TABLE, ONE, OVERLAY, DURATIONS, STREAM = "table", "one", "overlay", "durations", "stream"
VIEWS = (TABLE, ONE, OVERLAY, DURATIONS, STREAM)
WHO_COOKIE = "plushsense_who"
# Logins that are no person's.
_ACCOUNTS = ("root", "administrator", "admin", "user")
_AHEAD = 4
_LOOK_S = 1.5


TO_DO, DONE = "todo", "done"
NO_FINDING = "no-finding"


@dataclass(frozen=True)
class RecordingFilter:
    """Conditions that a recording must meet to be listed; "" means no condition.

    ``state``: one of `STATES`, `TO_DO` or `DONE`. ``severity``: minimum severity of the worst finding not accepted, or
    `NO_FINDING`. ``check``: a check with a finding, accepted or not. ``text``: part of the id or a finding's message.
    """

    person: str = ""
    gesture: str = ""
    state: str = ""
    severity: str = ""
    check: str = ""
    text: str = ""

    def fits(self, row: ReviewedRecording, word: Callable[[str], str] = str) -> bool:
        """Return whether a recording meets all conditions; ``word`` translates the messages of findings."""
        severity = {"": True, NO_FINDING: not row.worst}.get(self.severity)
        if severity is None:
            severity = bool(row.worst) and SEVERITIES.index(row.worst) <= SEVERITIES.index(self.severity)
        text = self.text.strip().casefold()
        return (
            self.person in ("", row.info.subject)
            and self.gesture in ("", row.info.gesture)
            and self.state in ("", row.state, DONE if row.done else TO_DO)
            and severity
            and (not self.check or any(f.check == self.check for f in row.findings))
            and any(text in s.casefold() for s in (row.id, *(word(f.message) for f in row.findings if text)))
        )

    @classmethod
    def of(cls, query: Mapping[str, str]) -> RecordingFilter:
        """Create a filter from the query parameters of an address; ignore unknown values."""
        values = {f.name: query[f.name] for f in fields(cls) if query.get(f.name)}
        for key, allowed in (("state", (TO_DO, DONE, *STATES)), ("severity", (NO_FINDING, *SEVERITIES))):
            if values.get(key) not in allowed:
                values.pop(key, None)
        return cls(**values)

    def query(self) -> dict[str, str]:
        """Return the conditions as query parameters of an address."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name))}


_URGENCY = {s: i for i, s in enumerate((*SEVERITIES, ""))}
SORTS: dict[str, Callable[[ReviewedRecording], Any]] = {
    "recording": lambda r: (),
    "person": lambda r: r.info.subject,
    "gesture": lambda r: r.info.gesture,
    "seconds": lambda r: r.seconds,
    "findings": lambda r: (_URGENCY[r.worst], -len(r.open)),
    "state": lambda r: (STATES.index(r.state), r.confidence),
}
"""Sort key of each column; recordings with equal keys are sorted by id."""


def filter_and_sort(
    rows: Iterable[ReviewedRecording],
    filter: RecordingFilter,
    only: Collection[str] | None = None,
    by: str = "recording",
    down: bool = False,
    word: Callable[[str], str] = str,
) -> list[str]:
    """Return the sorted ids of the recordings that pass ``filter`` and, unless ``only`` is None, are in ``only``."""
    fitting = [r for r in rows if (only is None or r.id in only) and filter.fits(r, word)]
    fitting.sort(key=lambda r: r.id, reverse=down and by == "recording")
    if by != "recording":
        fitting.sort(key=SORTS[by], reverse=down)
    return [r.id for r in fitting]


class ReviewView(Protocol):
    """Interface of the views of the page: the table, one recording, two of a gesture, and one stream."""

    @property
    def place(self) -> ui.element:
        """Element that contains the view."""

    def draw(self) -> None:
        """Display the current selection of the controller."""

    def refresh(self) -> None:
        """Update the parts that have changed since the view was drawn."""


class ReviewController:
    """Controller of one open review page: which recordings it displays, in which order, and who decides.

    Attributes:
        visit: id of the browser tab, whose decisions can be undone one by one, even after a reload.
        current: id of the displayed recording, "" for none.
        stream: id of the displayed stream, "" for none.
        order: sorted ids that passed the filter when it was set; `next` skips those that no longer pass.
        first_row: index in ``order`` of the first row on the current page of the table.
        selected: ids of the recordings that are selected in the table, for decisions about all of them.
        ends: whether accepting a suggestion also accepts the suggested stop.
    """

    def __init__(self, page: Page, review: Review, query: Mapping[str, str]) -> None:
        self.page, self.review, self.words = page, review, page.words
        self.visit = str(getattr(context.client, "tab_id", None) or context.client.id)
        self.client = context.client
        self.filter = RecordingFilter.of(query)
        self.by, self.down = "recording", False
        self.view = query["view"] if query.get("view") in VIEWS else ONE if query.get("recording") else TABLE
        self.current = ""
        streams = () if review.is_labelled else (s.id for s in review.dataset.streams)
        self.streams = sorted(streams)
        self.stream = query.get("stream", "") if query.get("stream") in self.streams else next(iter(self.streams), "")
        if self.view == STREAM and not self.streams:
            self.view = TABLE
        self.order: list[str] = []
        self.trail: list[str] = []
        self.first_row = 0
        self.selected: dict[str, None] = {}
        self._anchor = ""
        self.ends = False
        self.only: dict[str, None] | None = None
        self.title = ""
        self.take_back: Callable[[], Any] | None = None
        self._query = {k: v for k, v in query.items() if k in ("dataset", "selection", "session")}
        self._turn = asyncio.Lock()
        self._rows: object = None
        self._address = ""

    def limit(self, title: str, only: list[str]) -> None:
        """Limit the page to the recordings ``only``, if any, and report those that do not exist."""
        if not only:
            return
        self.only, self.title = {i: None for i in only if i in self.review.infos}, title
        if not self._is_named:
            self._query |= {"title": title}
        if missing := [i for i in only if i not in self.only]:
            values = {"n": len(missing), "first": missing[0]}
            text = self.words("Linked recordings that are not in this data set: {n}, for example “{first}”.", **values)
            self.page.say(text, "warning")

    @property
    def _is_named(self) -> bool:
        """Whether the address names the recordings by a selection or session, and need not list them."""
        return bool(self._query.get("selection") or self._query.get("session"))

    # Building -----------------------------------------------------------------------------------------------------

    def build(self, views: Mapping[str, Callable[[ReviewController], ReviewView]]) -> None:
        """Build the header, the filters, and the views of `VIEWS`; `STREAM` can only be chosen if there are streams."""
        words, review = self.words, self.review
        with ui.row().classes("w-full items-center ps-small-gap"):
            tag(ui.label(review.dataset.head.name).classes("text-lg text-bold"), "name")
            if review.dataset.head.simulated:
                mark = ui.label(words("Simulation: these data say nothing about a real toy."))
                tag(mark.classes("ps-message ps-message-warning"), "simulation")
            self.counts = tag(ui.label().props("role=status"), "counts")
            self.making = tag(ui.label().classes("ps-dim").props("role=status"), "making")
            ui.space()
            self.who = ui.input(words("Your name"), value=self._who(), on_change=lambda e: self._keep_who(e.value))
            tag(self.who.props("outlined dense").style("width: 170px"), "who")
            to_train = ui.link(words("Next: train →"), address("train", dataset=review.path)).classes("ps-link")
            tag(to_train, "to-train")
        if review.is_labelled:
            about = words(
                "These recordings are cut where the label of the rows changes, so they cannot be trimmed. Findings and "
                "exclusion work as usual."
            )
            tag(ui.label(about).classes("ps-message ps-message-info w-full"), "labelled")
        with ui.row().classes("w-full items-center ps-small-gap"):
            shown = [v for v in VIEWS if v != STREAM or self.streams]
            toggle = ui.toggle({v: words(_VIEWS[v]) for v in shown}, value=self.view)
            toggle.props(f'no-caps unelevated aria-label="{words("View")}"').classes("ps-toggle ps-wrap")
            self.toggle = tag(toggle, "view")
            self.toggle.on_value_change(lambda e: self.turn_to(str(e.value)))
            self._fold = button("filters", "", self._fold_filters, "outline", icon="filter_list")
            self._fold.props("aria-expanded=false")
        self._drawer = tag(ui.row().classes("w-full items-center ps-small-gap"), "filter-drawer")
        with self._drawer:
            self._filters()
        self._drawer.set_visibility(False)
        self._label_fold()
        if self.only is not None:
            with tag(ui.row().classes("w-full items-center ps-message ps-message-info"), "selection"):
                text = words("Only the linked recordings ({n}). {title}", n=len(self.only), title=self.title)
                ui.label(text).classes("flex-grow")
                if self.take_back is not None:
                    button("take-back", words("Undo"), self.take_back, "outline color=inherit", about=self.title)
                ui.link(words("Show all"), address("review", dataset=review.path)).style("color: inherit")
        self.views = {name: view(self) for name, view in views.items()}
        on_change(review.changed, self.changed)
        ui.timer(_LOOK_S, self._look)

    def _filters(self) -> None:
        words, rows = self.words, self.review.rows.values()
        if self.review.is_labelled:
            states = [TO_DO, DONE, LABELLED, EXCLUDED]
        else:
            states = [TO_DO, DONE, *(s for s in STATES if s not in (LOOKING, LABELLED))]
        options: dict[str, dict[str, str]] = {
            "person": {p: self.person(p) for p in sorted({r.info.subject for r in rows})},
            "gesture": {g: words.gesture(g) for g in self.review.gestures()},
            "state": {s: words(STATE_TEXTS[s]) for s in states},
            "severity": {
                **{s: words(_SEVERITIES[s]) for s in SEVERITIES},
                NO_FINDING: words("no finding"),
            },
            "check": {c: words.check(c) for c in CHECKS if "recording" in CHECKS[c].scope},
        }
        self._fields: dict[str, Any] = {}
        for key, choices in options.items():
            value = getattr(self.filter, key)
            field = ui.select(choices, value=value if value in choices else None, label=words(_FILTERS[key]))
            field.props("outlined dense clearable options-dense").classes("ps-filter")
            self._fields[key] = field
        text = ui.input(words("Search"), value=self.filter.text).props("outlined dense clearable debounce=250")
        self._fields["text"] = text.classes("ps-filter")
        for key, field in self._fields.items():
            tag(field, f"filter-{key}")
            field.on_value_change(lambda e, key=key: self._filtered(key, e.value))
        self.filter = replace(
            self.filter, **{k: "" for k in options if getattr(self.filter, k) and self._fields[k].value is None}
        )

    def _fold_filters(self) -> None:
        self._drawer.set_visibility(not self._drawer.visible)
        self._fold.props(f"aria-expanded={str(self._drawer.visible).lower()}")

    def _label_fold(self) -> None:
        active = len(self.filter.query())
        self._fold.set_text(self.words("Filter ({n} active)", n=active) if active else self.words("Filter"))

    async def begin(self, recording: str) -> None:
        """Open the initial view with ``recording``, or the first recording if that is "" or unknown."""
        self.arrange()
        if recording and recording not in self.review.infos:
            with self.page.show_errors():
                self.review.info(recording)
            recording = ""
        self.current = recording or (self.order[0] if self.order else "")
        await self.turn_to(self.view)
        self.changed()

    def person(self, subject: str) -> str:
        """Return the text that the page displays for a person's code."""
        return self.words("nobody") if subject == "none" else subject

    def _who(self) -> str:
        request = context.client.request
        name = unquote(request.cookies.get(WHO_COOKIE, "")) if request is not None else ""
        with contextlib.suppress(PlushSenseError):
            login = author_name(None)
            return name or ("" if login.lower() in _ACCOUNTS else login)
        return name

    def _keep_who(self, name: str | None) -> None:
        cookie = json.dumps(f"{WHO_COOKIE}={quote(name or '')}; path=/; max-age=31536000; SameSite=Strict")
        ui.run_javascript(f"document.cookie = {cookie}")

    @property
    def name(self) -> str:
        """Name of the person who decides; raise ConfigError if neither the field nor the login provides one."""
        return author_name((self.who.value or "").strip() or None)

    # Views and navigation -----------------------------------------------------------------------------------------

    def arrange(self) -> None:
        """Filter and sort the recordings again."""
        rows, word = self.review.rows.values(), self.words.sentence
        self.order = filter_and_sort(rows, self.filter, self.only, self.by, self.down, word)

    async def _filtered(self, key: str, value: Any) -> None:
        self.filter = replace(self.filter, **{key: str(value or "")})
        self._label_fold()
        self.arrange()
        self.first_row = 0
        if self.current not in self.order:
            self.current = self.order[0] if self.order else ""
            self.trail.clear()
        await self.turn_to(self.view)

    async def turn_to(self, view: str) -> None:
        """Switch to ``view``, one of `VIEWS`."""
        self.view = view
        if self.toggle.value != view:
            self.toggle.value = view
            return
        for name, each in self.views.items():
            each.place.set_visibility(name == view)
        if view == ONE:
            await self.go(self.current)
            return
        if view == TABLE:
            self.arrange()
        self.views[view].draw()
        self.update_address()

    async def open(self, identity: str) -> None:
        """Switch to the view of one recording and display ``identity``."""
        self.current = identity
        await self.turn_to(ONE)

    async def go(self, identity: str, *, remember: bool = False) -> None:
        """Display a recording in the recording view, and read the following ones in the background."""
        with self.page.show_errors():
            if identity and not self.review.is_read(identity):
                await run.io_bound(self.review.signals, identity)
            if remember and self.current and self.current != identity:
                self.trail.append(self.current)
            self.current = identity
            self.views[ONE].draw()
        self._update_counts()
        self.update_address()
        ahead = [i for i in self.following(_AHEAD) if not self.review.is_read(i)]
        if ahead:
            background_tasks.create(run.io_bound(self._read_ahead, ahead), name="review: neighbours")

    def _read_ahead(self, identities: list[str]) -> None:
        for identity in identities:
            try:
                self.review.signals(identity)
            except Exception:  # noqa: BLE001, RUF100
                return

    def following(self, count: int = 1) -> list[str]:
        """Return the ids of up to ``count`` recordings that follow in the order and still pass the filter."""
        rows = self.review.rows
        start = self.order.index(self.current) + 1 if self.current in self.order else 0
        fitting = (i for i in self.order[start:] if i in rows and self.filter.fits(rows[i], self.words.sentence))
        return list(itertools.islice(fitting, count))

    async def next(self) -> None:
        """Go to the next recording in the order."""
        async with self._turn:
            await self._next()

    async def _next(self) -> None:
        ahead = self.following()
        if ahead:
            await self.go(ahead[0], remember=True)
        else:
            self.views[ONE].draw()
            self.page.say(self.words("This was the last recording of this list."), "good")

    async def back(self) -> None:
        """Return to the recording displayed before, or if there is none, to the previous one in the order."""
        async with self._turn:
            while self.trail and self.trail[-1] not in self.review.infos:
                self.trail.pop()
            if self.trail:
                await self.go(self.trail.pop())
            else:
                await self._previous(remember=False)

    async def previous(self) -> None:
        """Go to the previous recording in the order."""
        async with self._turn:
            await self._previous(remember=True)

    async def _previous(self, *, remember: bool) -> None:
        if self.current in self.order and self.order.index(self.current):
            await self.go(self.order[self.order.index(self.current) - 1], remember=remember)

    # Deciding -----------------------------------------------------------------------------------------------------

    async def select(self, identities: Iterable[str]) -> None:
        """Select exactly these recordings, and show them in the table."""
        self.selected = dict.fromkeys(identities)
        if not set(self.selected) <= set(self.order):
            for field in self._fields.values():
                field.value = None
            self.filter = RecordingFilter()
            self.arrange()
        if self.selected:
            self.first_row = self.order.index(next(iter(self.selected))) if self.order else 0
        await self.turn_to(TABLE)

    def toggle_selected(self, identity: str, through: bool) -> None:
        """Select a recording, or no longer; ``through``: all from the one that was clicked before to this one."""
        on = identity not in self.selected
        places = [self.order.index(i) for i in (self._anchor, identity) if through and i in self.order]
        for each in self.order[min(places) : max(places) + 1] if len(places) == 2 else [identity]:
            if on:
                self.selected[each] = None
            else:
                self.selected.pop(each, None)
        self._anchor = identity

    async def decide_all(self, decision: Callable[[], int], action: str) -> bool:
        """Call ``decision`` about several recordings; report how many it changed, with a button to undo it.

        Args:
            action: the kind of mark that it makes.
        """
        async with self._turn:
            with self.page.show_errors():
                changed = await run.io_bound(decision)
                text = self.words(_DONE[action], n=changed or 0)
                if action == "trim" and (left := sum(not row.done for row in self.review.rows.values())):
                    rest = "Still to decide: {n}. Choose “{one}” and go through them: Enter accepts, x excludes."
                    text = f"{text} {self.words(rest, n=left, one=self.words(_VIEWS[ONE]))}"
                self.page.say(text, "good" if changed else "info", self.undo if changed else None)
                return True
        return False

    async def decide(self, recording: str, decision: Callable[[], Any], *, move: bool = False) -> None:
        """Call ``decision``, which is about ``recording``; with ``move``, go to the next recording after success.

        Do nothing if another recording has been displayed in the meantime.
        """
        async with self._turn:
            if recording != self.current:
                return
            with self.page.show_errors():
                await run.io_bound(decision)
                self.page.say("")
                if move:
                    await self._next()
                    return
            self.views[ONE].refresh()

    async def mark(self, decision: Callable[[], Any]) -> bool:
        """Call ``decision``, which is about no recording; return whether it succeeded."""
        async with self._turn:
            with self.page.show_errors():
                await run.io_bound(decision)
                self.page.say("")
                return True
        return False

    async def undo(self) -> None:
        """Discard the draft of the displayed recording; if there is none, undo this tab's last decision."""
        async with self._turn:
            with self.page.show_errors():
                if self.view == ONE and self.review.drop(self.current):
                    self.page.say("")
                    self.views[ONE].refresh()
                    return
                why = self.words("undone")
                last = await run.io_bound(self.review.undo, self.visit, self.name, why)
                if last is None:
                    self.page.say(self.words("There is nothing left to undo in this tab."))
                    return
                action, n = self.words(_DID[last.action]), len(last.before)
                if n > 1:
                    self.page.say(self.words("Undone: {what}. Recordings: {n}.", what=action, n=n))
                    return
                self.page.say(self.words("Undone: {what} ({id}).", what=action, id=last.recording))
                if self.view == ONE and last.recording in self.review.infos:
                    await self.go(last.recording)

    def changed(self) -> None:
        """Update the page after a change of the review, made on this page or elsewhere."""
        self._update_progress()
        rows = self.review.rows
        if rows is self._rows:
            return
        self._rows = rows
        self._update_counts()
        if not self.order:
            # A filter by findings fits nothing before the checks have ended.
            self.arrange()
            if self.order and self.view == ONE:
                background_tasks.create(self.go(self.order[0]), name="review: first recording")
                return
        self.views[self.view].refresh()

    async def _look(self) -> None:
        """Read marks written by other programs."""
        with self.page.show_errors():
            await run.io_bound(self.review.look)

    def _update_counts(self) -> None:
        rows = self.review.rows.values()
        done = sum(r.done for r in rows)
        self.counts.set_text(
            self.words("{done} of {of} decided, {left} to do", done=done, of=len(rows), left=len(rows) - done)
        )

    def _update_progress(self) -> None:
        prepared = self.review.prepared
        text = self.words.error(prepared.error) if prepared.error is not None else ""
        if not text and prepared.progress is not None:
            stage, done, total = prepared.progress
            text = self.words(_MAKING[stage], done=done, of=total)
        self.making.set_text(text)
        self.making.set_visibility(bool(text))

    def update_address(self) -> None:
        """Store the state of the page in its address."""
        query = {**self._query, "dataset": str(self.review.path), **self.filter.query(), "view": self.view}
        if self.view == ONE:
            query["recording"] = self.current
        if self.view == STREAM:
            query["stream"] = self.stream
        pairs = list(query.items())
        if self.only is not None and not self._is_named:
            pairs += [("recordings", i) for i in self.only]
        path = f"/review?{urlencode(pairs)}"
        if path != self._address:
            self._address = path
            with self.client:
                set_address(path)
