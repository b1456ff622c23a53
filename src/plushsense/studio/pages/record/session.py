"""Build the record page during a session: the current step, the state of the recorder, and the commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import run, ui
from nicegui.element import Element

from plushsense.core.errors import DatasetError
from plushsense.recording.session_files import SessionHead
from plushsense.recording.states import RecorderStatus
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs
from plushsense.studio.app.shell import LINES, Keys, Page, address, button, focus, html, named, on_change, on_click, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.record.controller import ActiveSession, RecordController
from plushsense.studio.widgets.elements import Plot, own_picture, picture, summary

_WINDOW_S = 10.0
# Figures that change faster cannot be read.
_FIGURES_S = 0.5
# Approximate maximum number of points to send to a plot at once.
_MAX_POINTS = 12
_SIGNAL_STYLES = {
    "good": ("✔", "#00664a"),
    "fair": ("◑", "#7a4e00"),
    "poor": ("▲", "#9d2b00"),
    "none": ("✖", "#6b1d1d"),
    "unreadable": ("?", "#6b1d1d"),
}
"""Sign and colour of each signal quality in `plushsense.recording.takes.SIGNAL`."""


def percent(share: float, words: Words) -> str:
    """Format a share (0 to 1) in per cent, with one decimal place if it is below ten per cent."""
    text = words.number(100 * share, 1 if share < 0.1 else 0)
    return text.removesuffix(f"{words('shell.decimal_point')}0")


class SignalPanel:
    """Panel with the signal quality and plots of the last seconds, one plot for each kind of channel."""

    def __init__(self, page: Page, session: ActiveSession) -> None:
        self._page, self._device = page, session.device
        words = page.words
        with ui.column().classes("ps-current ps-card w-full").style("gap: 6px"):
            with ui.row().classes("items-center w-full").style("gap: 4px 16px"):
                ui.label(words("record.signal")).classes("text-bold")
                self._quality = tag(ui.label(), "signal").classes("q-px-md q-py-xs rounded-borders text-bold")
                self._lost = tag(ui.label(), "lost")
                self._rate = tag(ui.label(), "rate")
            self._counters = tag(ui.label(), "counters").classes("ps-dim")
            with tag(ui.element("details").props("open").classes("w-full"), "live"):
                summary(words("record.live"))
                self._plots = self._build(max(1.0, session.request.speed))
        rate = self._device.layout.rate_hz * max(1.0, session.request.speed)
        self._place = max(0, self._device.buffer.count - int(_WINDOW_S * rate))
        self._drawn_signal = ""
        self._figures_s = -math.inf

    def _build(self, speed: float) -> list[tuple[Plot, list[int]]]:
        words, kinds = self._page.words, dict[str, list[int]]()
        channels = self._device.layout.channels
        for n, channel in enumerate(channels):
            kinds.setdefault(channel.kind, []).append(n)
        plots = []
        with ui.row().classes("w-full items-start").style("gap: 8px"):
            for kind, indices in kinds.items():
                title = words.get(f"record.kind_{kind}", kind)
                names = [channels[n].name for n in indices]
                label = words("record.live_label", s=f"{_WINDOW_S * speed:g}", channels=", ".join(names))
                series = [{"label": name, "stroke": LINES[i % len(LINES)]} for i, name in enumerate(names)]
                flex = "2 1 420px" if len(indices) > 5 else "1 1 260px"
                with ui.column().classes("ps-no-gap").style(f"flex: {flex}; min-width: 0"):
                    ui.label(title).classes("text-bold")
                    plot = Plot(
                        label,
                        series,
                        x=words("record.live_x"),
                        y=words.unit(channels[indices[0]].unit),
                        height=190,
                        window_s=_WINDOW_S * speed,
                    )
                    plots.append((tag(plot, f"plot-{kind}"), indices))
        return plots

    def draw(self, s: RecorderStatus) -> None:
        """Display the current signal quality."""
        words = self._page.words
        now_s, changed = time.monotonic(), self._drawn_signal != s.signal
        if not changed and now_s - self._figures_s < _FIGURES_S:
            return
        self._figures_s = now_s
        if changed:
            self._drawn_signal = s.signal
            sign, colour = _SIGNAL_STYLES[s.signal]
            self._quality.text = f"{sign} {words(f'record.signal_{s.signal}')}"
            self._quality.style(f"background: {colour}; color: #fff").props(f'data-signal="{s.signal}"')
        shares = {"recent": percent(s.bad_share, words), "ever": percent(s.bad_share_total, words)}
        # Without a signal, these figures are meaningless.
        has_signal = s.signal not in ("none", "unreadable")
        self._lost.text = words("record.signal_lost", **shares) if has_signal else ""
        self._rate.text = words("record.signal_rate", rate=f"{s.rate_hz:.0f}") if has_signal else ""
        counts = {k: getattr(s, k) for k in ("lost", "malformed", "garbage", "gaps", "reconnects")}
        self._counters.text = words("record.signal_more", **counts)

    def push(self) -> None:
        """Append new samples to the plots."""
        samples = self._device.buffer.since(self._place)
        self._place = samples.end
        if not len(samples.seconds):
            return
        # At high speed, a virtual toy sends more samples than are visible in the plot.
        step = max(1, len(samples.seconds) // _MAX_POINTS)
        seconds, values = samples.seconds[::step].tolist(), samples.values[::step]
        channels = self._device.layout.channels
        for plot, indices in self._plots:
            curves = [
                ((values[:, n] * channels[n].step - channels[n].offset) * channels[n].scale).tolist() for n in indices
            ]
            plot.push(seconds, curves)


def collect(page: Page, folder: Path) -> None:
    """Import an ended session into a data set that fits, or into a new one; then show its recordings for review."""
    jobs, words = page.workspace.part(Jobs), page.words
    head = SessionHead.read(folder)
    if head is None:
        raise DatasetError(f"'{folder}' holds no session.")
    place = page.workspace.dataset_for(str(head.layout["name"]), head.simulated)
    name = page.workspace.title(place)
    job = jobs.import_sessions([folder], place, words("home.import_title", name=name))
    page.say(words("record.collecting", name=name))

    def follow() -> None:
        if job.state == DONE:
            ui.navigate.to(address("review", dataset=place))
        elif job.state != RUNNING:
            page.say(job.message or words("record.not_collected"), "error")

    on_change(jobs.changed, follow)


_MAX_STEPS = 400
_SIGNS = {"now": "▶", "made": "✓", "skipped": "–", "open": "○"}


class StepList:
    """List of all steps, with a row per gesture and a button per recording that calls ``go(number, seen)``."""

    def __init__(self, page: Page, session: ActiveSession, go: Callable[[int, str], Any]) -> None:
        self._page, self._session = page, session
        self._buttons: list[ui.button] = []
        self._states: list[str] = []
        self._seen = ""
        words = page.words
        steps = session.recorder.steps()
        with tag(ui.element("details").classes("ps-card w-full"), "steps"):
            summary(words("record.steps"))
            if len(steps) > _MAX_STEPS:
                ui.label(words("record.steps_many"))
                return
            rows: dict[str, list[int]] = {}
            for result in steps:
                rows.setdefault(result.step.gesture, []).append(result.step.number)
            buttons: dict[int, ui.button] = {}
            for gesture, numbers in rows.items():
                with ui.row().classes("items-center w-full q-mt-xs").style("gap: 6px"):
                    ui.label(words.gesture(gesture)).style("min-width: 12rem")
                    buttons |= {number: self._button(number, go) for number in numbers}
            self._buttons = [buttons[n] for n in sorted(buttons)]
            self._states = [""] * len(steps)

    def _button(self, number: int, go: Callable[[int, str], Any]) -> ui.button:
        step = button(f"step-{number}", "", look="outline dense").style("min-width: 3.2rem")
        on_click(step, lambda seen: go(number, seen))
        return step

    def draw(self, status: RecorderStatus) -> None:
        """Update the displayed state of the steps if the status has changed."""
        if not self._buttons or status.seen == self._seen:
            return
        self._seen = status.seen
        words = self._page.words
        for n, result in enumerate(self._session.recorder.steps()):
            state = "made" if result.file else "skipped" if result.skipped else "open"
            now = n == status.step.number and status.state not in ("finished", "stopped")
            key = f"{state}{now}"
            if self._states[n] == key:
                continue
            self._states[n] = key
            text = words(f"record.step_{state}") + (f", {words('record.step_now')}" if now else "")
            step = result.step
            repetition = words("record.repetition", n=step.repetition, m=status.repetitions)
            signs = _SIGNS[state] + (f" {_SIGNS['now']}" if now else "")
            self._buttons[n].text = f"{step.repetition} {signs}"
            label = f"{words.gesture(step.gesture)}, {repetition}: {text}"
            named(self._buttons[n].props(f'data-step="{state}"'), label)


_DRAW_S = 0.1
_REMIND_S = 20.0
_KEYS = " rsbp"
_GREEN, _BLUE, _RED, _AMBER, _GREY = "#00664a", "#0b4f9e", "#9d2b00", "#7a4e00", "#4a5260"


class ConnectionAlert(Element, component="connection.js"):
    """An alert that displays ``text`` and hides elements of class ``ps-current`` while the studio does not respond.

    The connection counts as lost when the socket closes, or when there was no response for five seconds. It counts as
    restored only after a response, because the page is up to date then.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self._props["text"] = text
        self.classes("w-full")
        self.on("ask", lambda: self.run_method("answer"), args=[])


def show_session(page: Page, controller: RecordController, session: ActiveSession) -> None:
    """Build the page of a session and update it until it is closed."""
    view = _View(page, controller, session)
    on_change(controller.changed, view.draw)
    ui.timer(_DRAW_S, view.tick, immediate=False)
    view.draw()


def _state_text(page: Page, s: RecorderStatus) -> tuple[str, str]:
    """Return the text that describes the state and what to press, and its colour."""
    words = page.words
    if s.state == "idle":
        if s.signal in ("none", "unreadable"):
            return words("record.waiting" if s.signal == "none" else "record.unreadable"), _RED
        return words("record.ready"), _BLUE
    if s.state == "recording":
        if s.away:
            return words("record.recording_away"), _RED
        if s.left_s < _REMIND_S and s.elapsed_s > _REMIND_S:
            return words("record.recording_long", s=f"{s.left_s:.0f}"), _RED
        return words("record.recording"), _GREEN
    colours = {"countdown": _AMBER, "saving": _BLUE, "paused": _GREY, "finished": _GREEN, "stopped": _RED}
    return words(f"record.{s.state}"), colours[s.state]


class _View:
    """The elements of the page; `draw` updates them to the current state of the session."""

    def __init__(self, page: Page, controller: RecordController, session: ActiveSession) -> None:
        self._page, self._controller, self._session = page, controller, session
        self._gesture: str | None = None
        self._announced = ("", "")
        self._left = False
        words, head = page.words, session.head
        self._keys = Keys(_KEYS, self._press, {"n": '[name="note"]'})
        with ui.row().classes("w-full items-center").style("gap: 4px 16px"):
            ui.label(words("record.session", subject=head.subject, session=head.session)).classes("text-bold")
            title = words.get(f"record.protocol_{head.protocol['name']}", head.protocol["title"])
            ui.label(title).classes("ps-dim")
            if head.simulated:
                tag(ui.label(words("shell.simulation")).classes("ps-simulated"), "simulation")
        self._notices()
        with ui.column().classes("w-full").style("gap: 4px"):
            self._progress = tag(ui.label(), "progress").classes("text-bold")
            self._bar = ui.element("progress").classes("w-full").style("height: 14px; accent-color: #00805c")
            named(self._bar, words("record.progress", done="", steps=""))
            self._next = tag(ui.label(), "next").classes("ps-dim")
        with ui.row().classes("w-full items-start").style("gap: 12px 24px"):
            self._picture = tag(html(), "picture").style("flex: 1 1 260px; max-width: 380px")
            with ui.column().style("flex: 3 1 380px; min-width: 0; gap: 10px"):
                self._prompts()
        self._controls()
        self._finished()
        self._signals = SignalPanel(page, session)
        self._note_row()
        self._steps = StepList(page, session, lambda number, seen: self._press(f"go:{number}", seen))
        self._last = tag(ui.label(), "last").classes("ps-dim").style("overflow-wrap: anywhere")
        ui.label(words("record.keys")).classes("ps-dim")

    def _notices(self) -> None:
        words = self._page.words
        notices = [words(f"record.{key}") for key in self._session.notices]
        notices += [words("record.mended", what=repair) for repair in self._session.repairs]
        for text in notices:
            box = ui.row().classes("ps-message ps-message-warning w-full").props('role="status"')
            with tag(box, "notice"):
                ui.label(f"⚠ {text}")

    def _prompts(self) -> None:
        with ui.row().classes("items-baseline w-full").style("gap: 0 20px"):
            self._name = html("", "h2").style("font-size: 2.6rem; line-height: 1.15")
            tag(self._name, "gesture")
            self._repetition = tag(ui.label(), "repetition").style("font-size: 1.5rem")
        self._prompt = tag(ui.label(), "prompt").style("font-size: 2rem; line-height: 1.3; font-weight: 600")
        self._again = tag(ui.label(), "again").classes("ps-dim").style("font-size: 1.1rem")
        tag(ConnectionAlert(self._page.words("record.lost")), "connection-lost")
        self._box = ui.row().classes("ps-current w-full items-center no-wrap rounded-borders q-pa-md")
        with tag(self._box, "state-box"):
            self._number = tag(ui.label(), "number").style(
                "font-size: 3.4rem; line-height: 1; font-weight: 700; white-space: nowrap"
            )
            self._state = tag(ui.label(), "state").style("font-size: 1.5rem; line-height: 1.25; font-weight: 700")
        self._message = tag(ui.label(), "recorder-message").classes("ps-current").props('role="status"')
        self._message.style("font-size: 1.15rem; min-height: 1.6rem")
        # For screen readers: announce each instruction once, without the changing numbers.
        self._announcement = tag(ui.label(), "announcement").props('aria-live="polite"').classes("ps-current")
        self._announcement.style("position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%)")

    def _controls(self) -> None:
        words = self._page.words
        with ui.row().classes("ps-current w-full items-center").style("gap: 10px"):
            self._main = button("main", "", look="unelevated", color=None)
            self._main.style("font-size: 1.6rem; min-width: 260px; min-height: 72px")
            on_click(self._main, self._main_clicked, once=True)
            self._small: dict[str, ui.button] = {}
            for key, name in {"r": "redo", "s": "skip", "b": "back", "p": "pause"}.items():
                self._small[key] = button(name, words(f"record.{name}")).style("min-height: 48px")
                on_click(self._small[key], partial(self._press, key))
            ui.space()
            self._end_button = button("end", words("record.end"), self._ask_end, "flat").style("min-height: 48px")
        self._ending = tag(ui.row().classes("ps-message ps-message-warning w-full items-center"), "ending")
        with self._ending:
            self._end_text = ui.label().classes("flex-grow")
            button("end-yes", words("record.end_yes"), self._end, "unelevated", color="deep-orange-10")
            self._no = button("end-no", words("record.end_no"), self._stay, color=None)
        self._ending.set_visibility(False)

    def _finished(self) -> None:
        words = self._page.words
        self._done = tag(ui.column().classes("ps-card w-full"), "all-done")
        with self._done:
            self._done_text = ui.label().classes("text-bold").style("overflow-wrap: anywhere")
            ui.label(words("record.what_next"))
            with ui.row().classes("items-center"):
                button("collect", words("record.collect"), self._collect, "unelevated")
                ui.link(words("record.to_home"), "/").classes("ps-link")
        self._done.set_visibility(False)

    def _note_row(self) -> None:
        words = self._page.words
        with ui.row().classes("w-full items-center no-wrap"):
            self._note = tag(ui.input(label=words("record.note")).props("maxlength=500 name=note"), "note")
            self._note.classes("flex-grow").on("keydown.enter", self._store_note)
            button("keep-note", words("record.keep_note"), self._store_note)

    # Commands -------------------------------------------------------------------------------------------------

    def _press(self, key: str, seen: str) -> None:
        with self._page.show_errors():
            if self._session.press(key, seen):
                self._page.say("")
            else:
                self._page.say(self._page.words("record.late"), "warning")
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
        # Leave the note field, so that the space bar is a command again.
        focus(self._main)

    def _ask_end(self) -> None:
        words = self._page.words
        recording = self._session.recorder.status().state == "recording"
        self._end_text.text = words("record.end_running" if recording else "record.end_really")
        self._ending.set_visibility(True)
        focus(self._no)

    def _stay(self) -> None:
        self._ending.set_visibility(False)
        focus(self._end_button)

    async def _end(self) -> None:
        self._left = True
        with self._page.show_errors():
            await run.io_bound(self._controller.close_session, self._session.name)
            ui.navigate.to(address("record", ended=self._session.name))
            return
        self._left = False

    async def _collect(self) -> None:
        """End the session, and lead to its recordings."""
        self._left = True
        with self._page.show_errors():
            await run.io_bound(self._controller.close_session, self._session.name)
            collect(self._page, self._session.recorder.session.folder)
            return
        self._left = False

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
        self._main.text = self._page.words("record.all_sessions")

    # Drawing --------------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Update the page and append new samples."""
        self.draw()
        if not self._left:
            self._signals.push()

    def draw(self) -> None:
        """Update the page to the current state of the session."""
        if self._left:
            return
        if self._controller.get(self._session.name) is not self._session:
            self._left = True
            reopened = self._controller.get(self._session.name) is not None
            ui.navigate.to(address("record", **{"session" if reopened else "ended": self._session.name}))
            return
        s = self._session.recorder.status()
        self._keys.show(s.seen)
        self._draw_plan(s)
        self._draw_state(s)
        self._signals.draw(s)

    def _draw_plan(self, s: RecorderStatus) -> None:
        words = self._page.words
        counts = [words("record.progress", done=s.done, steps=s.steps)]
        counts += [words("record.skipped_too", n=s.skipped)] if s.skipped else []
        counts += [words("record.redone_too", n=s.redone)] if s.redone else []
        if self._progress.text != (text := ", ".join(counts)):
            self._progress.text = text
            self._bar.props(f'max="{s.steps}" value="{s.done + s.skipped}"')
        text = ""
        if (following := s.next_step) is not None and s.state not in ("finished", "stopped"):
            gesture = words.gesture(following.gesture)
            text = words("record.next", gesture=gesture, n=following.repetition, m=s.repetitions)
        # Every change of an element renders the whole page again, also one that is taken back.
        self._next.text = text
        if self._gesture != s.step.gesture:
            self._gesture = s.step.gesture
            self._name.content = words.gesture(s.step.gesture)
            self._picture.content = self._drawn(s.step.gesture)
        self._repetition.text = words("record.repetition", n=s.step.repetition, m=s.repetitions)
        self._prompt.text = s.step.prompt
        for element in (self._picture, self._name, self._repetition, self._prompt):
            element.set_visibility(s.state != "finished")
        self._again.text = words("record.again") if s.existing and s.state != "finished" else ""
        self._last.text = words("record.last", file=s.file) if s.file else ""
        self._steps.draw(s)

    def _drawn(self, gesture: str) -> Markup:
        name = self._page.words("record.picture", gesture=self._page.words.gesture(gesture))
        own = own_picture(self._page.workspace.folder, gesture)
        if own:
            return Markup('<img src="{}" alt="{}" style="width: 100%; border-radius: 16px">').format(own, name)
        return picture(gesture, name)

    def _draw_state(self, s: RecorderStatus) -> None:
        words, state = self._page.words, s.state
        text, colour = _state_text(self._page, s)
        number = ""
        if state == "countdown":
            number = f"{math.ceil(s.countdown_s)}"
        elif state == "recording":
            number = words("record.seconds", s=words.number(s.elapsed_s, 1))
        self._number.text, self._state.text = number, text
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
        self._small["p"].text = words("record.break_off_pause" if state == "recording" else "record.pause")
        self._small["p"].set_visibility(state not in ("paused", "finished", "stopped"))
        self._small["s"].set_visibility(state not in ("finished", "stopped"))
        for key in "rb":
            self._small[key].set_visibility(state != "stopped")
        # When everything is recorded, the main button ends the session.
        self._end_button.set_visibility(state != "finished")
        if state == "finished":
            folder = str(self._session.recorder.session.folder.relative_to(self._page.workspace.folder))
            counts = {"done": s.done, "skipped": s.skipped, "redone": s.redone}
            self._done_text.text = words("record.all_done", folder=folder, **counts)
        self._done.set_visibility(state == "finished")
        step = f"{words.gesture(s.step.gesture)}, {self._repetition.text}. {s.step.prompt}. "
        announcement = (step if state == "idle" else "") + text
        # While recording, announce only a lost connection to the toy, not the remaining seconds.
        still_recording = state == self._announced[0] == "recording" and not s.away
        if self._announced != (state, announcement) and not still_recording:
            self._announced = (state, announcement)
            self._announcement.text = announcement
