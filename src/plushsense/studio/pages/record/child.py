"""Build the child's screen of a session, which has nothing to press, and the elements that it shares with the page."""

from __future__ import annotations

import math
from pathlib import Path

from markupsafe import Markup
from nicegui import ui
from nicegui.element import Element

from plushsense.recording.status import RecorderStatus
from plushsense.studio.app.shell import Page, add_style, html, on_change, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.pages.record.controller import RecordController
from plushsense.studio.widgets.elements import own_picture, picture

_STATES: Texts = {
    "recording": "Now!",
    "saving": "Well done!",
    "paused": "We are taking a break",
    "finished": "All done",
    "stopped": "We are taking a break",
}

_CSS = Path(__file__).with_name("record.css")


def style() -> None:
    """Add the style sheet of a session's page and of the child's screen."""
    add_style(_CSS.read_text(encoding="utf-8"))


class ConnectionAlert(Element, component="connection.js"):
    """An alert that displays a text and hides elements of class ``ps-current`` while the studio does not respond.

    The connection counts as lost when the socket closes, or when there was no response for five seconds. It counts as
    restored only after a response, because the page is up to date then.
    """

    def __init__(self) -> None:
        super().__init__()
        self._props["text"] = ""
        self.classes("w-full")
        self.on("ask", lambda: self.run_method("answer"), args=[])

    def prepare(self, text: str) -> None:
        """Set the text to display when the connection is lost."""
        if self._props["text"] != text:
            self._props["text"] = text
            self.update()


def gesture_picture(page: Page, gesture: str) -> Markup:
    """Return the picture of a gesture, preferably the user's own one; "" is the toy alone."""
    name = page.words("Picture: {gesture}", gesture=page.words.gesture(gesture)) if gesture else page.words("Toy")
    own = own_picture(page.workspace.folder, gesture) if gesture else ""
    if own:
        return Markup('<img src="{}" alt="{}" class="ps-own-picture">').format(own, name)
    return picture(gesture, name)


_DRAW_S = 0.1
_RESTING = ("finished", "stopped")


def show_child(page: Page, controller: RecordController, name: str) -> None:
    """Show the child's screen of the session ``name``; it follows the session live, also when that is continued."""
    style()
    # The alert of the child's screen is calmer than that of NiceGUI.
    add_style("#popup { display: none !important; }")
    view = _ChildView(page, controller, name)
    on_change(controller.changed, view.draw)
    ui.timer(_DRAW_S, view.draw, immediate=False)
    view.draw()


class _ChildView:
    """Elements of the child's screen; `draw` updates them."""

    def __init__(self, page: Page, controller: RecordController, name: str) -> None:
        self._page, self._controller, self._name = page, controller, name
        self._drawn: str | None = None
        with tag(ui.element("div").classes("ps-child").props("role=main"), "child"):
            self._picture = tag(html(), "child-picture")
            self._gesture = tag(html("", "h1"), "child-gesture")
            self._prompt = tag(ui.label().classes("ps-child-prompt ps-current"), "child-prompt")
            self._state = tag(ui.label().classes("ps-child-state ps-current").props("role=status"), "child-state")
            ConnectionAlert().prepare(page.words("One moment …"))

    def draw(self) -> None:
        """Show the current step, or a resting picture if the session is not open."""
        session, words = self._controller.get(self._name), self._page.words
        s = session.recorder.status() if session is not None else None
        rests = s is None or s.state in _RESTING
        gesture = "" if s is None or rests else s.step.gesture
        if gesture != self._drawn:
            self._drawn = gesture
            self._picture.content = gesture_picture(self._page, gesture)
        self._gesture.content = words.gesture(gesture) if gesture else self._resting_text(s)
        self._prompt.text = "" if s is None or rests else s.step.prompt
        self._prompt.set_visibility(bool(self._prompt.text))
        self._state.text = self._state_text(s)
        self._state.set_visibility(bool(self._state.text))
        self._state.props(f'data-state="{s.state if s is not None else "ended"}"')

    def _resting_text(self, s: RecorderStatus | None) -> str:
        if s is None and not self._controller.exists(self._name):
            return self._page.words("The session {name} has not begun.", name=self._name)
        return self._page.words("Thank you!")

    def _state_text(self, s: RecorderStatus | None) -> str:
        if s is None:
            return ""
        if s.state == "countdown":
            return f"{math.ceil(s.countdown_s)}"
        return self._page.words(_STATES[s.state]) if s.state in _STATES else ""
