"""Record: all recordings of the plan with what came of each, and the way to any of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from plushsense.apps.studio.desk import Sitting
from plushsense.apps.studio.keys import on_click
from plushsense.apps.studio.pages.record_start import unfolding
from plushsense.apps.studio.shell import Page, named, tag
from plushsense.recording.status import Status, StepStanding

_MOST = 400
_SIGNS = {"now": "▶", "made": "✓", "skipped": "–", "open": "○"}


class Steps:
    """A button a recording, a row a gesture; ``go(number, seen)`` goes there."""

    def __init__(self, page: Page, sitting: Sitting, go: Callable[[int, str], Any]) -> None:
        self._page, self._sitting = page, sitting
        self._buttons: list[ui.button] = []
        self._shown: list[str] = []
        self._seen = ""
        words = page.words
        steps = sitting.steps()
        with tag(ui.element("details").classes("ps-card w-full"), "steps"):
            unfolding(words("record.steps"))
            if len(steps) > _MOST:
                ui.label(words("record.steps_many"))
                return
            rows: dict[str, list[StepStanding]] = {}
            for step in steps:
                rows.setdefault(step.step.gesture, []).append(step)
            made: dict[int, ui.button] = {}
            for gesture, mine in rows.items():
                with ui.row().classes("items-center w-full q-mt-xs").style("gap: 6px"):
                    ui.label(words.gesture(gesture)).style("min-width: 12rem")
                    for standing in mine:
                        made[standing.step.number] = self._button(standing.step.number, go)
            self._buttons = [made[n] for n in sorted(made)]
            self._shown = [""] * len(steps)

    def _button(self, number: int, go: Callable[[int, str], Any]) -> ui.button:
        button = tag(ui.button().props("no-caps outline dense"), f"step-{number}").style("min-width: 3.2rem")
        on_click(button, lambda seen: go(number, seen))
        return button

    def draw(self, status: Status) -> None:
        """Show what came of each, where anything has changed."""
        if not self._buttons or status.seen == self._seen:
            return
        self._seen = status.seen
        words = self._page.words
        for n, standing in enumerate(self._sitting.steps()):
            state = "made" if standing.file else "skipped" if standing.skipped else "open"
            now = n == status.step.number and status.state not in ("finished", "stopped")
            key = f"{state}{now}"
            if self._shown[n] == key:
                continue
            self._shown[n] = key
            said = words(f"record.step_{state}") + (f", {words('record.step_now')}" if now else "")
            where = words("record.repetition", n=standing.step.repetition, m=status.repetitions)
            signs = _SIGNS[state] + (f" {_SIGNS['now']}" if now else "")
            self._buttons[n].text = f"{standing.step.repetition} {signs}"
            label = f"{words.gesture(standing.step.gesture)}, {where}: {said}"
            named(self._buttons[n].props(f'data-step="{state}"'), label)
