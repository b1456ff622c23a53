"""Record, during a session: what is to be done, what happens, and the commands; everything as the desk has it."""

from __future__ import annotations

import math
from functools import partial
from html import escape
from typing import Any

from nicegui import run, ui

from plushsense.apps.studio.desk import Desk, Sitting
from plushsense.apps.studio.keys import Keys, on_click
from plushsense.apps.studio.pages.record_signals import Signals
from plushsense.apps.studio.pages.record_start import address, protocol_title
from plushsense.apps.studio.pages.record_steps import Steps
from plushsense.apps.studio.pictures import has_picture, own_picture, picture
from plushsense.apps.studio.shell import Page, focus, on_ring, tag
from plushsense.recording.status import Status

_DRAW_S = 0.1
_REMIND_S = 20.0
_KEYS = " rsbp"
_GREEN, _BLUE, _RED, _AMBER, _GREY = "#00664a", "#0b4f9e", "#9d2b00", "#7a4e00", "#4a5260"


def show_session(page: Page, desk: Desk, sitting: Sitting) -> None:
    """Build the page of a session; it follows the sitting until it is left."""
    view = _View(page, desk, sitting)
    on_ring(desk.bell, view.draw)
    ui.timer(_DRAW_S, view.tick, immediate=False)
    view.draw()


def _told(page: Page, s: Status) -> tuple[str, str, str]:
    """The state as a word of `tag`, the line that says what happens and what to press, and its colour."""
    words = page.words
    if s.state == "idle":
        if s.signal in ("none", "unreadable"):
            return "idle", words("record.waiting" if s.signal == "none" else "record.unreadable"), _RED
        return "idle", words("record.ready"), _BLUE
    if s.state == "recording":
        if s.away:
            return "recording", words("record.recording_away"), _RED
        if s.left_s < _REMIND_S and s.elapsed_s > _REMIND_S:
            return "recording", words("record.recording_long", s=f"{s.left_s:.0f}"), _RED
        return "recording", words("record.recording"), _GREEN
    colours = {"countdown": _AMBER, "saving": _BLUE, "paused": _GREY, "finished": _GREEN, "stopped": _RED}
    return s.state, words(f"record.{s.state}"), colours[s.state]


class _View:
    """The elements of the page, and how they follow the sitting."""

    def __init__(self, page: Page, desk: Desk, sitting: Sitting) -> None:
        self._page, self._desk, self._sitting = page, desk, sitting
        self._gesture: str | None = None
        self._spoken = ("", "")
        self._left = False
        words, head = page.words, sitting.head
        self._keys = Keys(_KEYS, self._press, {"n": '[name="note"]'})
        with ui.row().classes("w-full items-center").style("gap: 4px 16px"):
            ui.label(words("record.session", subject=head.subject, session=head.session)).classes("text-bold")
            ui.label(protocol_title(words, head.protocol["name"], head.protocol["title"])).classes("ps-dim")
            if head.simulated:
                tag(ui.label(words("shell.simulation")).classes("ps-simulated"), "simulation")
        self._notices(words, sitting)
        with ui.column().classes("w-full").style("gap: 4px"):
            self._progress = tag(ui.label(), "progress").classes("text-bold")
            self._bar = ui.element("progress").classes("w-full").style("height: 14px; accent-color: #00805c")
            self._bar.props(f'aria-label="{escape(words("record.progress", done="", steps=""))}"')
            self._next = tag(ui.label(), "next").classes("ps-dim")
        with ui.row().classes("w-full items-start").style("gap: 12px 24px"):
            self._picture = tag(ui.html("", sanitize=False), "picture").style("flex: 1 1 260px; max-width: 380px")
            with ui.column().style("flex: 3 1 380px; min-width: 0; gap: 10px"):
                self._prompts()
        self._controls()
        self._finished()
        self._signals = Signals(page, sitting)
        self._note_row()
        self._steps = Steps(page, sitting, lambda number, seen: self._press(f"go:{number}", seen))
        self._last = tag(ui.label(), "last").classes("ps-dim").style("overflow-wrap: anywhere")
        ui.label(words("record.keys")).classes("ps-dim")

    def _notices(self, words: Any, sitting: Sitting) -> None:
        said = [words(f"record.{key}") for key in sitting.notices]
        said += [words("record.mended", what=what) for what in sitting.mended]
        for text in said:
            box = ui.row().classes("ps-said ps-said-warning w-full").props('role="status"')
            with tag(box, "notice"):
                ui.label(f"⚠ {text}")

    def _prompts(self) -> None:
        with ui.row().classes("items-baseline w-full").style("gap: 0 20px"):
            self._name = ui.html("", sanitize=False, tag="h2").style("font-size: 2.6rem; line-height: 1.15")
            tag(self._name, "gesture")
            self._repetition = tag(ui.label(), "repetition").style("font-size: 1.5rem")
        self._prompt = tag(ui.label(), "prompt").style("font-size: 2rem; line-height: 1.3; font-weight: 600")
        self._again = tag(ui.label(), "again").classes("ps-dim").style("font-size: 1.1rem")
        self._box = ui.row().classes("w-full items-center no-wrap rounded-borders q-pa-md")
        with tag(self._box, "state-box"):
            self._number = tag(ui.label(), "number").style(
                "font-size: 3.4rem; line-height: 1; font-weight: 700; white-space: nowrap"
            )
            self._state = tag(ui.label(), "state").style("font-size: 1.5rem; line-height: 1.25; font-weight: 700")
        self._message = (
            tag(ui.label(), "message").props('role="status"').style("font-size: 1.15rem; min-height: 1.6rem")
        )
        # For screen readers: what to do, said once, without the running numbers.
        self._aloud = tag(ui.label(), "aloud").props('aria-live="polite"').classes("ps-aloud")
        self._aloud.style("position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%)")

    def _controls(self) -> None:
        words = self._page.words
        with ui.row().classes("w-full items-center").style("gap: 10px"):
            self._main = tag(ui.button(color=None).props("no-caps unelevated"), "main")
            self._main.style("font-size: 1.6rem; min-width: 260px; min-height: 72px")
            on_click(self._main, self._main_clicked, once=True)
            self._small: dict[str, ui.button] = {}
            for key, name, text in (
                ("r", "redo", "redo"),
                ("s", "skip", "skip"),
                ("b", "back", "back"),
                ("p", "pause", "pause"),
            ):
                button = tag(ui.button(words(f"record.{text}")).props("no-caps outline"), name)
                button.style("min-height: 48px")
                on_click(button, partial(self._press, key))
                self._small[key] = button
            ui.space()
            self._end_button = ui.button(words("record.end"), on_click=self._ask_end)
            tag(self._end_button, "end").props("no-caps flat").style("min-height: 48px")
        self._ending = tag(ui.row().classes("ps-said ps-said-warning w-full items-center"), "ending")
        with self._ending:
            self._end_text = ui.label().classes("flex-grow")
            yes = ui.button(words("record.end_yes"), on_click=self._end).props(
                "no-caps unelevated color=deep-orange-10"
            )
            tag(yes, "end-yes")
            no = ui.button(words("record.end_no"), color=None).props("no-caps outline")
            no.on_click(self._stay)
            self._no = tag(no, "end-no")
        self._ending.set_visibility(False)

    def _finished(self) -> None:
        words = self._page.words
        self._done = tag(ui.column().classes("ps-card w-full"), "all-done")
        with self._done:
            self._done_text = ui.label().classes("text-bold").style("overflow-wrap: anywhere")
            ui.label(words("record.what_next"))
            with ui.row():
                ui.link(words("record.to_home"), "/").classes("ps-link")
                ui.link(words("record.to_review"), "/review").classes("ps-link")
        self._done.set_visibility(False)

    def _note_row(self) -> None:
        words = self._page.words
        with ui.row().classes("w-full items-center no-wrap"):
            self._note = tag(
                ui.input(label=words("record.note")).props("outlined dense maxlength=500 name=note"), "note"
            )
            self._note.classes("flex-grow").on("keydown.enter", self._keep_note)
            keep = ui.button(words("record.keep_note"), on_click=self._keep_note).props("no-caps outline")
            tag(keep, "keep-note")

    # Commands -------------------------------------------------------------------------------------------------

    def _press(self, key: str, seen: str) -> None:
        with self._page.refusing():
            if self._sitting.press(key, seen):
                self._page.say("")
            else:
                self._page.say(self._page.words("record.late"), "warning")
        self.draw()

    async def _main_clicked(self, seen: str) -> None:
        state = seen.partition(".")[0]
        if state in ("finished", "stopped"):
            if self._left or self._sitting.status().state == state:
                await (self._end() if state == "finished" else self._reopen())
        else:
            self._press("p" if state == "paused" else " ", seen)

    def _keep_note(self) -> None:
        text = str(self._note.value or "").strip()
        if text:
            self._sitting.recorder.note(text)
            self._note.value = ""
        # The space bar is for the toy again.
        focus(self._main)

    def _ask_end(self) -> None:
        words = self._page.words
        running = self._sitting.status().state == "recording"
        self._end_text.text = words("record.end_running" if running else "record.end_really")
        self._ending.set_visibility(True)
        focus(self._no)

    def _stay(self) -> None:
        self._ending.set_visibility(False)
        focus(self._end_button)

    async def _end(self) -> None:
        self._left = True
        with self._page.refusing():
            await run.io_bound(self._desk.close_sitting, self._sitting.name)
            ui.navigate.to(address(self._sitting.name, "ended"))
            return
        self._left = False

    async def _reopen(self) -> None:
        """Sit down anew; where that is refused, the first page has other toys to choose from."""
        if self._left:
            ui.navigate.to(address(self._sitting.name))
            return
        self._left = True
        with self._page.refusing():
            await run.io_bound(self._desk.close_sitting, self._sitting.name)
            await run.io_bound(self._desk.resume, self._sitting.name, self._sitting.wanted.device)
            ui.navigate.to(address(self._sitting.name))
            return
        self._main.text = self._page.words("record.all_sessions")

    # Following ------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Show this moment and what the toy sent since the last one."""
        self.draw()
        if not self._left:
            self._signals.push()

    def draw(self) -> None:
        """Show this moment."""
        if self._left:
            return
        if self._desk.get(self._sitting.name) is not self._sitting:
            self._left = True
            again = self._desk.get(self._sitting.name) is not None
            ui.navigate.to(address(self._sitting.name, "session" if again else "ended"))
            return
        s = self._sitting.status()
        self._keys.show(s.seen)
        self._draw_plan(s)
        self._draw_state(s)
        self._signals.draw(s)

    def _draw_plan(self, s: Status) -> None:
        words = self._page.words
        counts = [words("record.progress", done=s.done, steps=s.steps)]
        counts += [words("record.skipped_too", n=s.skipped)] if s.skipped else []
        counts += [words("record.redone_too", n=s.redone)] if s.redone else []
        if self._progress.text != (told := ", ".join(counts)):
            self._progress.text = told
            self._bar.props(f'max="{s.steps}" value="{s.done + s.skipped}"')
        f = s.following
        self._next.text = (
            words("record.next", gesture=words.gesture(f.gesture), n=f.repetition, m=s.repetitions)
            if f is not None and s.state not in ("finished", "stopped")
            else ""
        )
        if self._gesture != s.step.gesture:
            self._gesture = s.step.gesture
            self._name.content = escape(words.gesture(s.step.gesture))
            self._picture.content = self._drawn(s.step.gesture)
        self._repetition.text = words("record.repetition", n=s.step.repetition, m=s.repetitions)
        self._prompt.text = s.step.prompt
        for element in (self._picture, self._name, self._repetition, self._prompt):
            element.set_visibility(s.state != "finished")
        self._again.text = words("record.again") if s.already and s.state != "finished" else ""
        self._last.text = words("record.last", file=s.file) if s.file else ""
        self._steps.draw(s)

    def _drawn(self, gesture: str) -> str:
        name = self._page.words("record.picture", gesture=self._page.words.gesture(gesture))
        own = own_picture(self._page.house.folder, gesture)
        if own:
            return f'<img src="{own}" alt="{escape(name)}" style="width: 100%; border-radius: 16px">'
        return picture(gesture if has_picture(gesture) else "", name)

    def _draw_state(self, s: Status) -> None:
        words = self._page.words
        state, told, colour = _told(self._page, s)
        number = ""
        if state == "countdown":
            number = f"{math.ceil(s.countdown_s)}"
        elif state == "recording":
            number = words("record.seconds", s=_one_place(s.elapsed_s, words.language))
        self._number.text, self._state.text = number, told
        self._number.set_visibility(bool(number))
        if self._message.text != s.message:
            self._message.text = s.message
        self._box.style(f"background: {colour}; color: #fff")
        self._box.props(f'data-state="{state}"')
        main = {"idle": "start", "countdown": "cancel", "recording": "stop", "saving": "wait", "paused": "resume"}
        main |= {"finished": "end", "stopped": "reopen"}
        self._main.text = words(f"record.{main[state]}")
        self._main.style(f"background: {colour} !important; color: #fff !important")
        self._small["r"].text = words("record.break_off" if state == "recording" else "record.redo")
        self._small["p"].set_visibility(state not in ("paused", "finished", "stopped"))
        self._small["s"].set_visibility(state not in ("finished", "stopped"))
        for key in "rb":
            self._small[key].set_visibility(state != "stopped")
        # The big button ends it then.
        self._end_button.set_visibility(state != "finished")
        if state == "finished":
            folder = str(self._sitting.recorder.session.folder.relative_to(self._page.house.folder))
            counts = {"done": s.done, "skipped": s.skipped, "redone": s.redone}
            self._done_text.text = words("record.all_done", folder=folder, **counts)
        self._done.set_visibility(state == "finished")
        where = f"{words.gesture(s.step.gesture)}, {self._repetition.text}. {s.step.prompt}. "
        aloud = (where if state == "idle" else "") + told
        # Not at every second of a countdown to the end.
        if self._spoken != (state, aloud) and not (state == self._spoken[0] == "recording" and not s.away):
            self._spoken = (state, aloud)
            self._aloud.text = aloud


def _one_place(value: float, language: str) -> str:
    text = f"{value:.1f}"
    return text.replace(".", ",") if language == "lv" else text
