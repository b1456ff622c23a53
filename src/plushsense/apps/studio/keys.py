"""Keys that are commands anywhere on a page, whatever has the focus; what is typed into a field is none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments

_CLICKED = "(e) => emit({seen: document.querySelector('[data-seen]').dataset.seen, times: e.detail})"


class Keys(Element, component="keys.js"):
    """One press of a key is one call of ``on_press(key, seen)``; a key that is held counts once.

    Args:
        keys: the characters that are commands.
        on_press: gets the key and what `show` had last brought to this very browser when it was pressed.
        fields: keys that go to a field to be typed into, and its CSS selector.
    """

    def __init__(self, keys: str, on_press: Callable[[str, str], Any], fields: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self._props["keys"] = keys
        self._props["seen"] = ""
        self._props["fields"] = dict(fields or {})

        def pressed(event: GenericEventArguments) -> Any:
            return on_press(str(event.args["key"]), str(event.args["seen"]))

        self.on("press", pressed)

    def show(self, seen: str) -> None:
        """What the page shows now: goes with every press from here on."""
        if self._props["seen"] != seen:
            self._props["seen"] = seen
            self.update()


def on_click(button: ui.button, call: Callable[[str], Any], once: bool = False) -> None:
    """Call ``call(seen)`` at a click, with what the `Keys` of the page showed; ``once``: a double click is one."""

    def clicked(event: GenericEventArguments) -> Any:
        if not (once and int(event.args["times"] or 0) > 1):
            return call(str(event.args["seen"]))
        return None

    button.on("click", clicked, js_handler=_CLICKED)
