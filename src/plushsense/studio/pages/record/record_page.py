"""Build the record page: a list of sessions to resume and a form for a new one, or the session being recorded."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.core.errors import AddressError, ConfigError, DeviceError, LayoutError, PlushSenseError
from plushsense.recording.plan import DEFAULT, load_protocol, wordings
from plushsense.recording.session import PROTOCOL, SessionRequest, SessionSummary, check_subject
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.shell import CHILD, Page, address, button, html, named, on_page, query, tag
from plushsense.studio.app.toys import ToyInUseError
from plushsense.studio.app.words import Texts
from plushsense.studio.pages.record.child import show_child
from plushsense.studio.pages.record.choices import PROTOCOLS, ProtocolForm, ToyChoice
from plushsense.studio.pages.record.controller import ActiveSession, RecordController
from plushsense.studio.pages.record.session_page import collect, destination_of, show_session
from plushsense.studio.widgets.elements import ask, change_files, item_menu, open_dialog, summary

_WORDINGS: Texts = {
    "default": "Standard, in the language of the protocol",
    "child": "For children, English",
    "lv": "Latvian",
    "lv-child": "For children, Latvian",
}

_LISTED = 8


async def show(page: Page) -> None:
    """Show the session named in the address, or the only active one; otherwise show the page to start one."""
    controller = page.workspace.part(RecordController)
    chosen = query()
    active = controller.active_sessions()
    session = controller.get(chosen.get("session", ""))
    if chosen.get("view") == CHILD:
        show_child(page, controller, chosen.get("session", ""))
        return
    if session is None and not chosen and len(active) == 1:
        session = active[0]
    if session is not None:
        show_session(page, controller, session)
    else:
        await show_start(page, controller, chosen.get("session", ""), chosen.get("ended", ""))


async def show_start(page: Page, controller: RecordController, requested: str, ended: str) -> None:
    """Build the page shown before a session: sessions to resume, and the form for a new one.

    Args:
        requested: name of the session in the address, which is not open, or "".
        ended: name of a session that was just closed, or "".
    """
    sessions = await run.io_bound(controller.sessions) or []
    mine = {s.name: s for s in sessions}
    if ended in mine:
        session = mine[ended]
        text = page.words(
            "{name} is finished: {done} of {steps} recorded."
            if session.finished
            else "{name}: {done} of {steps} recorded. You can continue at any time.",
            name=ended,
            done=session.done,
            steps=session.steps,
        )
        page.say(text, "good")
        if session.done and session.head is not None:
            _ended(page, session)
    elif requested in mine and not mine[requested].finished:
        page.say(page.words("{name} is not open now. Continue it below.", name=requested), "warning")
    elif requested:
        page.say(page.words("There is no unfinished session {name} here.", name=requested), "warning")
    _SessionLists(page, controller).fill(sessions)
    _Form(page, controller)


def _ended(page: Page, session: SessionSummary) -> None:
    """Add the button that leads from an ended session to its recordings."""

    async def clicked() -> None:
        see.disable()
        with page.show_errors():
            see.set_enabled(not await collect(page, session.folder, destination))

    with tag(ui.row().classes("ps-card ps-next w-full items-center"), "ended-session"):
        text = page.words("Recordings of this session: {n}. They are put into a data set.", n=session.done)
        ui.label(text).classes("flex-grow text-lg")
        assert session.head is not None
        destination = destination_of(page, session.head)
        see = button("collect", page.words("Look at the recordings"), clicked, "unelevated size=lg", about=session.name)


class _SessionLists:
    """The sessions that are open, unfinished and finished, with what can be done with each."""

    def __init__(self, page: Page, controller: RecordController) -> None:
        self._page, self._controller = page, controller
        self._box = ui.column().classes("w-full")

    def fill(self, sessions: list[SessionSummary]) -> None:
        """Show these sessions."""
        words, controller = self._page.words, self._controller
        self._box.clear()
        with self._box:
            for active in controller.active_sessions():
                with tag(ui.row().classes("ps-card w-full items-center"), "open-session"):
                    ui.label(words("{name} is being recorded now", name=active.name)).classes("flex-grow text-bold")
                    there = address("record", session=active.name)
                    button("", words("Show it"), lambda to=there: ui.navigate.to(to), "unelevated", about=active.name)
            closed = [s for s in sessions if controller.get(s.name) is None]
            if left := [s for s in closed if not s.finished]:
                with ui.column().classes("ps-card w-full"):
                    html(words("Unfinished sessions"), "h2")
                    for session in left[:_LISTED]:
                        self._unfinished(session)
                    if len(left) > _LISTED:
                        with ui.element("details").classes("w-full"):
                            summary(words("Older ones: {n}", n=len(left) - _LISTED))
                            for session in left[_LISTED:]:
                                self._unfinished(session)
            if finished := [s for s in closed if s.finished]:
                with tag(ui.element("details").classes("ps-card w-full"), "finished-sessions"):
                    summary(words("Finished sessions: {n}.", n=len(finished)))
                    for session in finished:
                        with ui.row().classes("w-full items-center"):
                            self._describe(session)
                            self._menu(session)

    def _unfinished(self, session: SessionSummary) -> None:
        words, name, controller = self._page.words, session.name, self._controller
        with tag(ui.row().classes("w-full items-center"), f"unfinished-{name}"):
            if session.head is None or session.protocol is None:
                text = words("The session {name} cannot be read. Restore its folder from a copy.", name=name)
                ui.label(text).classes("flex-grow")
                return
            self._describe(session)
            toys = list(dict.fromkeys([session.head.device, *controller.toys()]))
            titles = {u: words.toy(u) for u in toys}
            toy = ui.select(titles, value=toys[0], label=words("Toy")).style("width: 24rem; max-width: 100%")
            named(toy.props("outlined dense"), f"{words('Toy')}: {name}")
            go_on = button("", words("Continue"), None, "unelevated", about=name)

            def refused(error: PlushSenseError) -> bool:
                if _is_of_toy(error):
                    toy.error = words.error(error)
                return bool(toy.error)

            def resume() -> Any:
                toy.error = None
                return _open_session(self._page, go_on, lambda: controller.resume(name, str(toy.value)), refused)

            go_on.on_click(resume)
            self._menu(session)

    def _describe(self, session: SessionSummary) -> None:
        words = self._page.words
        text = words("{name}: {done} of {steps} recorded", name=session.name, done=session.done, steps=session.steps)
        with ui.column().classes("flex-grow ps-no-gap"):
            ui.label(text).classes("text-bold")
            if session.head is not None and session.protocol is not None:
                title = words(PROTOCOLS.get(session.protocol.name, session.protocol.title))
                title += f" · {words('simulation')}" if session.head.simulated else ""
                ui.label(title).classes("ps-dim")

    def _menu(self, session: SessionSummary) -> None:
        """Add a menu: finish or reopen the session, correct the person's code, or discard it; each can be undone."""
        words, name, controller = self._page.words, session.name, self._controller
        subject, finished = session.folder.parent.name, session.finished

        change = partial(change_files, self._page, refresh=self._refresh)

        async def finish() -> None:
            message = words(
                "{name} can be continued again." if finished else "{name} is marked as finished.", name=name
            )
            undo = partial(controller.finish, name, finished)
            await change(partial(controller.finish, name, not finished), message, undo=lambda _: undo())

        async def rename(code: str) -> None:
            message = words("{name} now belongs to {code}.", name=name, code=code)
            work = partial(controller.rename_person, name, code)
            await change(work, message, undo=lambda new: controller.rename_person(new, subject))

        async def settle(code: str) -> None:
            with self._page.show_errors():
                await _settle_code(self._page, code, rename, apart_from=subject)

        async def discard() -> None:
            message = words("“{name}” is discarded. It can be restored on the home page.", name=name)
            await change(partial(controller.discard, name), message, undo=self._page.workspace.restore)

        def ask_code() -> None:
            title = words("The code of the person in {name}", name=name)
            ask(words, title, words("Change the code"), settle, words("Code of the person"), subject)

        actions = {
            words("Not finished yet" if finished else "Finished for this child"): finish,
            words("Correct the person's code"): ask_code,
            words("Discard"): discard,
        }
        item_menu(words, name, actions)

    async def _refresh(self) -> None:
        self.fill(await run.io_bound(self._controller.sessions) or [])


async def _settle_code(page: Page, code: str, use: Callable[[str], Awaitable[None]], apart_from: str = "") -> None:
    """Call ``use`` with a person's code; if it is doubtful, ask first, and call it with the answer.

    Raises:
        DatasetError: for an invalid code.
    """
    words = page.words
    doubt = page.workspace.codes(apart_from).doubt(check_subject(code)) if code else None
    if doubt is None:
        await use(code)
        return

    async def answer(chosen: str) -> None:
        dialog.close()
        await on_page(use)(chosen)

    question = words.sentence(doubt.question)
    with open_dialog(question, "ask") as dialog:
        ui.label(question).classes("text-lg text-bold ps-break")
        with ui.row().classes("w-full justify-end"):
            button("", words("Cancel"), dialog.close, "flat autofocus")
            for number, (text, chosen) in enumerate(doubt.answers):
                button(f"code-{number}", words.sentence(text), partial(answer, chosen))


def _is_of_toy(error: PlushSenseError) -> bool:
    if isinstance(error, ToyInUseError):
        return False
    return isinstance(error, DeviceError | LayoutError | AddressError) or error.message.values.get("field") == "toy"


async def _open_session(
    page: Page, begin: ui.button, work: Callable[[], ActiveSession], refused: Callable[[PlushSenseError], bool]
) -> None:
    """Open the toy, which may take a while, and go to the session.

    Args:
        refused: shows an error beside the field that it is about; if it returns False, the error is shown as a message.
    """
    begin.disable()
    page.say(page.words("Opening the toy …"))
    try:
        with page.show_errors(partial(_open_session, page, begin, work, refused)):
            try:
                session = await run.io_bound(work)
            except PlushSenseError as error:
                page.say("")
                if refused(error):
                    return
                raise
            if session is not None:
                ui.navigate.to(address("record", session=session.name))
    finally:
        begin.enable()


class _Form:
    """Form for a new session."""

    def __init__(self, page: Page, controller: RecordController) -> None:
        self._page, self._controller, words = page, controller, page.words
        self._choices = page.workspace.part(Choices)
        with tag(ui.column().classes("ps-card w-full"), "new-session"):
            html(words("New session"), "h2")
            with ui.row().classes("w-full items-start"):
                code, consent = words.each("For example S01, never a name", "Required for publishing")
                age, gender = words.each("For example child, teen, adult", "In the person's own words")
                self._subject = _input("code", words("Code of the person"), code)
                self._free = ""
                with page.show_errors():
                    self._free = page.workspace.codes().next_free()
                self._consent = _input("consent", words("Number of the consent form"), consent)
                self._age = _input("age_group", words("Age group"), age)
                self._gender = _input("gender", words("Gender"), gender)
            with ui.row().classes("w-full items-start"):
                titles = self._titles()
                last = self._choices.last("protocol", titles, PROTOCOL)
                self._protocol = _select(titles, "protocol", words("What to record"), last)
                self._protocol.on_value_change(self._choose_words)
                self._words = _select({DEFAULT: DEFAULT}, "wording", words("Wording"), DEFAULT)
                self._discard = button("discard-protocol", words("Discard this list"), self._discard_protocol)
            ProtocolForm(page, controller, lambda path: self._list_protocols(str(path)))
            with ui.row().classes("w-full items-start"):
                self._toy = ToyChoice(page, controller.toys())
            with ui.element("details").classes("w-full"):
                summary(words("More settings"))
                with ui.column():
                    layouts = {"": words("Default (plush-15)")} | controller.layouts()
                    layout = self._choices.last("layout", layouts)
                    self._layout = _select(layouts, "layout", words("Sensor layout of the toy"), layout)
                    self._simulated = ui.checkbox(words("This is a virtual toy: mark the recordings as a simulation"))
                    self._anew = ui.checkbox(words("Begin a new session even if the person's last one is unfinished"))
                    mark = words("Mark the moment of the first start for the video (white flash and tone)")
                    self._mark = tag(ui.checkbox(mark), "mark-first")
                    lsl = words("Send markers of the recordings by LSL (for LabRecorder)")
                    self._lsl = tag(ui.checkbox(lsl), "lsl")
                    self._lsl.set_visibility(find_spec("pylsl") is not None)
            self._begin = button("begin", words("Begin the session"), self._begin_session, "unelevated size=lg")
        self._choose_words()

    def _titles(self) -> dict[str, str]:
        words = self._page.words
        return {key: words(PROTOCOLS.get(key, name)) for key, name in self._controller.protocols().items()}

    def _list_protocols(self, chosen: str = PROTOCOL) -> None:
        self._protocol.set_options(self._titles(), value=chosen)
        self._choose_words()

    async def _discard_protocol(self) -> None:
        chosen, workspace = Path(str(self._protocol.value)), self._page.workspace

        async def refresh() -> None:
            self._list_protocols(str(chosen) if chosen.is_file() else PROTOCOL)

        message = self._page.words("“{name}” is discarded. It can be restored on the home page.", name=chosen.stem)
        await change_files(self._page, lambda: workspace.discard(chosen), message, refresh, workspace.restore)

    def _choose_words(self) -> None:
        """Update the wordings to those of the chosen protocol; preselect the last one in the page's language."""
        self._protocol.error = None
        self._discard.set_visibility(str(self._protocol.value).endswith(".toml"))
        try:
            known = wordings(str(self._protocol.value))
            # Propose a code, but none where nobody touches the toy.
            if self._subject.value in (None, "", self._free):
                self._subject.value = "" if load_protocol(str(self._protocol.value)).needs_nobody else self._free
        except PlushSenseError as refusal:
            self._protocol.error = self._page.words.error(refusal)
            known = (DEFAULT,)
        language = self._page.words.language
        # Not that of a page in another language.
        value = self._choices.last(f"words-{language}", known, language if language in known else DEFAULT)
        self._words.set_options({w: self._page.words(_WORDINGS.get(w, w)) for w in known}, value=value)

    def _request(self) -> SessionRequest:
        toy = self._toy.url
        simulated = bool(self._simulated.value)
        return SessionRequest(
            device=toy,
            subject=str(self._subject.value or "").strip(),
            protocol=str(self._protocol.value),
            words=str(self._words.value),
            layout=str(self._layout.value or ""),
            age_group=_short(self._age.value),
            gender=_short(self._gender.value),
            consent=_short(self._consent.value),
            speed=self._controller.speed_for(toy, simulated),
            simulated=simulated,
        )

    async def _begin_session(self) -> None:
        with self._page.show_errors():
            for field in (self._subject, self._protocol):
                field.error = None
            self._toy.show_error("")
            try:
                await _settle_code(self._page, str(self._subject.value or "").strip(), self._begin_with)
            except PlushSenseError as error:
                if not self._refused(error):
                    raise

    async def _begin_with(self, code: str) -> None:
        self._subject.value = code
        with self._page.show_errors():
            request = self._request()
            choices = {"protocol": request.protocol, "layout": str(request.layout or "")}
            self._choices.keep(**choices, **{f"words-{self._page.words.language}": request.words})
            anew, mark, lsl = bool(self._anew.value), bool(self._mark.value), bool(self._lsl.value)
            work = partial(self._controller.begin, request, anew, mark, lsl)
            await _open_session(self._page, self._begin, work, self._refused)

    def _refused(self, error: PlushSenseError) -> bool:
        """Show an error beside the field that it is about; return whether there is one."""
        sentence = self._page.words.error(error)
        field = error.message.values.get("field")
        if field == "person":
            self._subject.error = sentence
        elif field == "protocol":
            self._protocol.error = sentence
        elif _is_of_toy(error):
            self._toy.show_error(sentence)
        else:
            return False
        return True


def _input(name: str, label: str, hint: str) -> ui.input:
    return tag(ui.input(label=label).props(f'outlined hint="{hint}"'), name).classes("w-64")


def _select(options: dict[str, str], name: str, label: str, value: str) -> ui.select:
    value = value if value in options else next(iter(options))
    field = named(ui.select(options, value=value, label=label).props("outlined"), label)
    return tag(field, name).style("width: 27rem; max-width: 100%")


def _short(value: Any) -> str:
    text = " ".join(str(value or "").split())
    if len(text) > 100:
        raise ConfigError("“{text}” is too long: at most {most} characters.", text=f"{text[:20]}…", most=100)
    return text
