"""Build the record page during a session: the current step, the state of the recorder, and the commands."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path

from nicegui import run, ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

from plushsense.core.errors import PlushSenseError
from plushsense.recording.status import RecorderStatus
from plushsense.recording.writer import SessionHead
from plushsense.studio.app.shell import CHILD, Keys, Page, address, button, focus, html, named, on_change, on_click, tag
from plushsense.studio.app.toys import ToyInUseError
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.record.child import ConnectionAlert, gesture_picture, style
from plushsense.studio.pages.record.choices import PROTOCOLS, ToyChoice
from plushsense.studio.pages.record.controller import ActiveSession, RecordController
from plushsense.studio.pages.record.last_recording import ResultPanel
from plushsense.studio.pages.record.panels import SignalPanel, StepList
from plushsense.studio.widgets.destination import Destination, review_address

_STATES: Texts = {
    "countdown": "GET READY",
    "saving": "SAVING …",
    "paused": "PAUSED. Press p or the big button to continue",
    "finished": "ALL DONE",
    "stopped": "STOPPED",
}

_MAIN: Texts = {
    "idle": "Start",
    "countdown": "Cancel",
    "recording": "Stop",
    "saving": "Saving …",
    "paused": "Continue",
    "finished": "End the session",
    "stopped": "Open it again",
}
"""Text of the large button in each state."""

_NOTICES: Texts = {
    "no_consent": "There is no consent number. The recordings are marked, and publishing will refuse them.",
    "pseudo": (
        "This port is a pseudo terminal. If a virtual toy is behind it, end the session and begin one that is marked "
        "as a simulation."
    ),
}


def destination_of(page: Page, head: SessionHead) -> Destination:
    """Add the choice of the data set that the recordings of a session go into."""
    return Destination(page, str(head.layout["name"]), head.simulated)


async def collect(page: Page, folder: Path, destination: Destination) -> bool:
    """Import an ended session, and then show its recordings for review; return whether the import has begun."""
    return await destination.put([folder], lambda place: ui.navigate.to(review_address(place, [folder])))


_DRAW_S = 0.1
_REMIND_S = 20.0
_KEYS = " rsbp"
_ALIASES = {"pagedown": " ", "enter": " ", "pageup": "r"}
"""Keys of clickers, pedals and presenters."""
_GREEN, _BLUE, _RED, _AMBER, _GREY = "#00664a", "#0b4f9e", "#9d2b00", "#7a4e00", "#4a5260"


class Sounds(Element, component="sounds.js"):
    """The sounds of countdown and recording, a button that mutes them, and one that marks the moment for a video.

    Args:
        session: the session whose recorder logs the moment.
    """

    def __init__(self, words: Words, session: ActiveSession) -> None:
        super().__init__()
        self._session = session
        texts = {"on": words("Sound: on"), "off": words("Sound: off"), "mark": words("Mark for the video")}
        self._props.update(texts=texts, beat="", mark_first=session.mark_first)
        self.on("mark", self._mark)

    def _mark(self, event: GenericEventArguments) -> None:
        # Of several pages that show the first countdown, one marks it.
        if self._session.mark_first or not event.args["first"]:
            self._session.mark_first = False
            self._session.recorder.mark()

    def play(self, s: RecorderStatus) -> None:
        """Play the sound of a change of the state or of the number of the countdown."""
        beat = f"{s.state}.{math.ceil(s.countdown_s)}"
        if self._props["beat"] != beat:
            self._props["beat"] = beat
            self.update()


def show_session(page: Page, controller: RecordController, session: ActiveSession) -> None:
    """Build the page of a session and update it until it is closed."""
    style()
    view = _View(page, controller, session)
    on_change(controller.changed, view.draw)
    ui.timer(_DRAW_S, view.tick, immediate=False)
    view.draw()


def _state_text(page: Page, s: RecorderStatus) -> tuple[str, str]:
    """Return the text that describes the state and what to press, and its colour."""
    words = page.words
    if s.state == "idle":
        if s.signal in ("none", "unreadable"):
            return words(
                "WAITING FOR THE TOY. Switch it on and bring it near"
                if s.signal == "none"
                else "THE TOY CANNOT BE READ. Check the chosen layout and the cable"
            ), _RED
        return words("READY. Press the space bar or the big button, then wait for the countdown"), _BLUE
    if s.state == "recording":
        if s.away:
            return words("RECORDING, BUT THE TOY IS AWAY. Check the cable and the battery"), _RED
        if s.left_s < _REMIND_S and s.elapsed_s > _REMIND_S:
            return words("STILL RECORDING. Press to stop; it stops by itself in {s} s", s=f"{s.left_s:.0f}"), _RED
        return words("RECORDING. Press again when the gesture is over"), _GREEN
    colours = {"countdown": _AMBER, "saving": _BLUE, "paused": _GREY, "finished": _GREEN, "stopped": _RED}
    return words(_STATES[s.state]), colours[s.state]


class _View:
    """The elements of the page; `draw` updates them to the current state of the session."""

    def __init__(self, page: Page, controller: RecordController, session: ActiveSession) -> None:
        self._page, self._controller, self._session = page, controller, session
        self._device = session.device
        self._gesture: str | None = None
        self._announced = ("", "")
        self._left = False
        words, head = page.words, session.head
        self._keys = Keys(_KEYS, self._key_pressed, {"n": '[name="note"]'}, _ALIASES)
        with ui.row().classes("w-full items-center").style("gap: 2px 16px"):
            text = words("{subject}, session {session}", subject=head.subject, session=head.session)
            ui.label(text).classes("text-bold")
            title = words(PROTOCOLS.get(head.protocol["name"], head.protocol["title"]))
            ui.label(title).classes("ps-dim")
            if head.simulated:
                tag(ui.label(words("simulation")).classes("ps-simulated"), "simulation")
        with ui.element("div").classes("ps-step"):
            self._picture = tag(html().classes("ps-step-picture"), "picture")
            self._prompts()
            with ui.column().classes("ps-step-controls w-full"):
                self._controls()
        self._finished()
        self._result = ResultPanel(page, session)
        self._progress_row()
        self._notices()
        self._signals = SignalPanel(page, session)
        self._note_row()
        self._steps = StepList(page, session, lambda number, seen: self._press(f"go:{number}", seen))
        with ui.row().classes("w-full items-center"):
            self._sounds = Sounds(words, session)
            child = address("record", session=session.name, view=CHILD)
            link = ui.link(words("Screen for the child (new window)"), child, new_tab=True)
            tag(link.classes("ps-link"), "child-link")
        keys = words(
            "Keys: space (or Page Down or Enter: a clicker or a pedal) starts and stops, r (or Page Up) makes the last "
            "one again, s skips, b goes back, p pauses, n writes a note"
        )
        ui.label(keys).classes("ps-dim")

    def _progress_row(self) -> None:
        with ui.column().classes("w-full").style("gap: 4px"):
            self._progress = tag(ui.label(), "progress").classes("text-bold")
            self._bar = ui.element("progress").classes("w-full").style("height: 14px; accent-color: #00805c")
            named(self._bar, self._page.words("{done} of {steps} recorded", done="", steps=""))
            self._next = tag(ui.label(), "next").classes("ps-dim")

    def _notices(self) -> None:
        words = self._page.words
        notices = [words(_NOTICES[key]) for key in self._session.notices]
        repairs = map(words.sentence, self._session.repairs)
        for text in (*notices, *(words("Repaired after a crash: {what}.", what=repair) for repair in repairs)):
            box = ui.row().classes("ps-message ps-message-warning w-full").props('role="status"')
            with tag(box, "notice"):
                ui.label(f"⚠ {text}")

    def _prompts(self) -> None:
        with ui.row().classes("ps-step-name items-baseline w-full"):
            self._name = tag(html("", "h2").classes("ps-gesture"), "gesture")
            self._repetition = tag(ui.label().classes("ps-repetition"), "repetition")
        with ui.column().classes("ps-step-prompt"):
            self._prompt = tag(ui.label().classes("ps-prompt"), "prompt")
            self._again = tag(ui.label(), "again").classes("ps-dim")
        with ui.column().classes("ps-step-state"):
            self._alert = tag(ConnectionAlert(), "connection-lost")
            self._box = ui.row().classes("ps-current ps-state-box w-full items-center no-wrap")
            with tag(self._box, "state-box"):
                self._number = tag(ui.label().classes("ps-number"), "number")
                self._state = tag(ui.label().classes("ps-state"), "state")
            self._message = tag(ui.label(), "recorder-message").classes("ps-current").props('role="status"')
            self._message.style("font-size: 1.1rem; min-height: 1.5rem")
            # For screen readers: announce each instruction once, without the changing numbers.
            hidden = "position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%)"
            announcement = ui.label().props('aria-live="polite"').classes("ps-current").style(hidden)
            self._announcement = tag(announcement, "announcement")

    def _controls(self) -> None:
        words = self._page.words
        with ui.row().classes("ps-current w-full items-center").style("gap: 10px"):
            self._main = button("main", "", look="unelevated", color=None).classes("ps-main-button")
            on_click(self._main, self._main_clicked, once=True)
            self._small: dict[str, ui.button] = {}
            texts = words.each("Record the last one again", "Skip", "Back", "Pause")
            for key, name, text in zip("rsbp", ("redo", "skip", "back", "pause"), texts, strict=True):
                self._small[key] = button(name, text).style("min-height: 48px")
                on_click(self._small[key], partial(self._press, key))
            self._change_toy = button("change-toy", words("Another toy"), self._ask_toy, "flat")
            self._end_button = button("end", words("End the session"), self._ask_end, "flat")
            for late in (self._change_toy, self._end_button):
                late.style("min-height: 48px")
        ending = ui.row().classes("ps-message ps-message-warning w-full items-center")
        with tag(ending, "ending") as self._ending:
            self._end_text = ui.label().classes("flex-grow")
            button("end-yes", words("End it"), lambda: self._end(), "unelevated", color="deep-orange-10")
            self._no = button("end-no", words("Stay"), self._stay, color=None)
        exchange = ui.row().classes("ps-card w-full items-start")
        with tag(exchange, "exchange") as self._exchange:
            about = words(
                "The session goes on with another toy of the same sensor layout. It is tried first. Everything "
                "recorded is kept."
            )
            ui.label(about).classes("w-full")
            urls = list(dict.fromkeys([*self._controller.toys(), self._session.request.device]))
            self._toy = ToyChoice(self._page, urls, "exchange-")
            self._go_on = button("exchange-go", words("Go on with this toy"), self._exchange_toy, "unelevated")
            button("exchange-no", words("Cancel"), lambda: self._exchange.set_visibility(False), "flat")
        for box in (self._ending, self._exchange):
            box.set_visibility(False)

    def _finished(self) -> None:
        words = self._page.words
        self._done = tag(ui.column().classes("ps-card w-full"), "all-done")
        with self._done:
            self._done_text = ui.label().classes("text-bold").style("overflow-wrap: anywhere")
            ui.label(words("Next: look at the recordings. This ends the session and puts them into a data set."))
            self._destination = destination_of(self._page, self._session.head)
            with ui.row().classes("items-center"):
                button("collect", words("Look at the recordings"), self._collect, "unelevated")
                ui.link(words("Go to the home page"), "/").classes("ps-link")
        self._done.set_visibility(False)

    def _note_row(self) -> None:
        words = self._page.words
        with ui.row().classes("w-full items-center no-wrap"):
            self._note = tag(ui.input(label=words("Note")).props("maxlength=500 name=note"), "note")
            self._note.classes("flex-grow").on("keydown.enter", self._store_note)
            button("keep-note", words("Save the note"), self._store_note)

    # Commands -------------------------------------------------------------------------------------------------

    def _key_pressed(self, key: str, seen: str) -> None:
        # While a question is open, keys belong to it.
        if not (self._ending.visible or self._exchange.visible):
            self._press(key, seen)

    def _press(self, key: str, seen: str) -> None:
        with self._page.show_errors():
            late = self._page.words(
                "The press came too late: the state had changed already. Look, and press again if you still want to."
            )
            self._page.say("" if self._session.press(key, seen) else late, "warning")
        self.draw()

    async def _main_clicked(self, seen: str) -> None:
        state = seen.partition(".")[0]
        if state in ("finished", "stopped"):
            if self._left or self._session.recorder.status().state == state:
                await (self._end() if state == "finished" else self._reopen())
        else:
            self._press("p" if state == "paused" else " ", seen)

    def _store_note(self) -> None:
        text = str(self._note.value or "").strip()
        if text:
            self._session.recorder.note(text)
            self._note.value = ""
        # Leave the note field, so that the space bar starts and stops again.
        focus(self._main)

    def _ask_end(self) -> None:
        words = self._page.words
        recording = self._session.recorder.status().state == "recording"
        self._end_text.text = words(
            "A recording is running. Ending the session discards it."
            if recording
            else "End the session? All recordings are saved, and you can continue at any time."
        )
        self._ending.set_visibility(True)
        focus(self._no)

    def _stay(self) -> None:
        self._ending.set_visibility(False)
        focus(self._end_button)

    def _ask_toy(self) -> None:
        self._exchange.set_visibility(True)
        self._toy.show_error("")

    async def _exchange_toy(self) -> None:
        words = self._page.words
        self._go_on.disable()
        self._page.say(words("Opening the toy …"))
        with self._page.show_errors(self._exchange_toy):
            try:
                await run.io_bound(self._controller.exchange, self._session.name, self._toy.url)
            except ToyInUseError:
                raise
            except PlushSenseError as error:
                self._page.say("")
                self._toy.show_error(words.error(error))
            finally:
                self._go_on.enable()

    async def _end(self, then: Callable[[], Awaitable[object]] | None = None) -> None:
        """End the session, and call ``then``, by default to go to the start page."""
        self._left = True
        with self._page.show_errors():
            await run.io_bound(self._controller.close_session, self._session.name)
            if then is None:
                ui.navigate.to(address("record", ended=self._session.name))
            else:
                await then()
            return
        self._left = False

    async def _collect(self) -> None:
        """End the session, and lead to its recordings."""
        await self._end(partial(collect, self._page, self._session.recorder.session.folder, self._destination))

    async def _reopen(self) -> None:
        """Resume the session; if that fails, let the button lead to the start page to choose another toy."""
        if self._left:
            ui.navigate.to(address("record", session=self._session.name))
            return
        self._left = True
        with self._page.show_errors():
            await run.io_bound(self._controller.close_session, self._session.name)
            await run.io_bound(self._controller.resume, self._session.name, self._session.request.device)
            ui.navigate.to(address("record", session=self._session.name))
            return
        self._main.text = self._page.words("All sessions")

    # Drawing --------------------------------------------------------------------------------------------------

    async def tick(self) -> None:
        """Update the page and append new samples."""
        self.draw()
        if not self._left:
            self._signals.push()
            await self._result.draw(self._session.recorder.status())

    def draw(self) -> None:
        """Update the page to the current state of the session."""
        if self._left:
            return
        if self._controller.get(self._session.name) is not self._session:
            self._left = True
            reopened = self._controller.get(self._session.name) is not None
            ui.navigate.to(address("record", **{"session" if reopened else "ended": self._session.name}))
            return
        if self._session.device is not self._device:
            # The plots begin again with another toy.
            self._left = True
            ui.navigate.to(address("record", session=self._session.name))
            return
        s = self._session.recorder.status()
        self._keys.show(s.seen)
        self._sounds.play(s)
        self._draw_plan(s)
        self._draw_state(s)
        self._signals.draw(s)

    def _draw_plan(self, s: RecorderStatus) -> None:
        words = self._page.words
        counts = [words("{done} of {steps} recorded", done=s.done, steps=s.steps)]
        counts += [words("{n} skipped", n=s.skipped)] if s.skipped else []
        counts += [words("{n} recorded again", n=s.redone)] if s.redone else []
        if self._progress.text != (text := ", ".join(counts)):
            self._progress.text = text
            self._bar.props(f'max="{s.steps}" value="{s.done + s.skipped}"')
        text = ""
        if (following := s.next_step) is not None and s.state not in ("finished", "stopped"):
            gesture = words.gesture(following.gesture)
            text = words("Next: {gesture}, {n} of {m}", gesture=gesture, n=following.repetition, m=s.repetitions)
        # Every change of an element renders the whole page again, also one that is taken back.
        self._next.text = text
        if self._gesture != s.step.gesture:
            self._gesture = s.step.gesture
            self._name.content = words.gesture(s.step.gesture)
            self._picture.content = gesture_picture(self._page, s.step.gesture)
        self._repetition.text = words("{n} of {m}", n=s.step.repetition, m=s.repetitions)
        self._prompt.text = s.step.prompt
        for element in (self._picture, self._name, self._repetition, self._prompt):
            element.set_visibility(s.state != "finished")
        self._again.text = (
            words("This gesture is recorded already. A new recording replaces it.")
            if s.existing and s.state != "finished"
            else ""
        )
        self._steps.draw(s)

    def _lost_text(self, s: RecorderStatus) -> str:
        """Return what to display if the connection is lost: what is kept, and what must be made again."""
        words = self._page.words
        kept = {"done": s.done, "steps": s.steps}
        texts = [words("CONNECTION LOST, NOT RECORDING. Kept: {done} of {steps} recordings.", **kept)]
        if s.state in ("countdown", "recording"):
            gesture, repetition = words.gesture(s.step.gesture), self._repetition.text
            texts.append(words("To be made again: {gesture}, {repetition}.", gesture=gesture, repetition=repetition))
        return " ".join([*texts, words("Continue when this page shows the session again.")])

    def _draw_state(self, s: RecorderStatus) -> None:
        words, state = self._page.words, s.state
        text, colour = _state_text(self._page, s)
        number = ""
        if state == "countdown":
            number = f"{math.ceil(s.countdown_s)}"
        elif state == "recording":
            number = words("{s} s", s=words.number(s.elapsed_s, 1))
        self._number.text, self._state.text = number, text
        self._number.set_visibility(bool(number))
        if self._message.text != (message := words.sentence(s.message)):
            self._message.text = message
            look = "ps-message ps-message-warning"
            self._message.classes(**{"add" if s.message.template.startswith("Nobody stopped") else "remove": look})
        self._alert.prepare(self._lost_text(s))
        self._box.style(f"background: {colour}")
        self._box.props(f'data-state="{state}"')
        self._main.text = words(_MAIN[state])
        self._main.style(f"background: {colour} !important; color: #fff !important")
        self._small["r"].text = words(
            "Discard and record again" if state == "recording" else "Record the last one again"
        )
        self._small["p"].text = words("Discard and pause" if state == "recording" else "Pause")
        self._small["p"].set_visibility(state not in ("paused", "finished", "stopped"))
        self._small["s"].set_visibility(state not in ("finished", "stopped"))
        for key in "rb":
            self._small[key].set_visibility(state != "stopped")
        changeable = state in ("idle", "paused", "stopped", "finished") or (state == "recording" and s.away)
        self._change_toy.set_visibility(changeable and not s.failed)
        # When everything is recorded, the main button ends the session.
        self._end_button.set_visibility(state != "finished")
        if state == "finished":
            folder = self._session.recorder.session.folder.relative_to(self._page.workspace.folder)
            self._done_text.text = words(
                "All done: {done} recorded, {skipped} skipped, {redone} recorded again. The recordings are in "
                "{folder}.",
                folder=str(folder),
                done=s.done,
                skipped=s.skipped,
                redone=s.redone,
            )
        self._done.set_visibility(state == "finished")
        step = f"{words.gesture(s.step.gesture)}, {self._repetition.text}. {s.step.prompt}. "
        announcement = (step if state == "idle" else "") + text
        # While recording, announce only a lost connection to the toy, not the remaining seconds.
        still_recording = state == self._announced[0] == "recording" and not s.away
        if self._announced != (state, announcement) and not still_recording:
            self._announced = (state, announcement)
            self._announcement.text = announcement
