"""Panels of a session's page: the quality and plots of the signal, and the list of all steps."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from nicegui import ui

from plushsense.recording.status import RecorderStatus
from plushsense.studio.app.shell import LINES, Page, button, named, on_click, tag
from plushsense.studio.app.words import CHANNEL_KINDS, Texts, Words
from plushsense.studio.pages.record.controller import ActiveSession
from plushsense.studio.widgets.elements import Plot, summary

_STEPS: Texts = {"made": "recorded", "skipped": "skipped", "open": "not recorded yet"}

_SIGNALS: Texts = {
    "good": "Good",
    "fair": "Fair: bring the toy nearer",
    "poor": "Poor: bring the toy nearer, check its battery",
    "none": "None: the toy sends nothing",
    "unreadable": "Unreadable: the toy sends lines that are not frames",
}

_WINDOW_S = 10.0
# Figures that change faster cannot be read.
_FIGURES_S = 0.5
# The plots are drawn in every second tick of the page: their lines are most of what the browser draws in a session.
_PLOTS_S = 0.15
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
    return text.removesuffix(f"{words.decimal_point}0")


class SignalPanel:
    """Panel with the signal quality and plots of the last seconds, one plot for each kind of channel."""

    def __init__(self, page: Page, session: ActiveSession) -> None:
        self._page, self._device = page, session.device
        words = page.words
        with ui.column().classes("ps-current ps-card w-full").style("gap: 6px"):
            with ui.row().classes("items-center w-full").style("gap: 4px 16px"):
                ui.label(words("Signal")).classes("text-bold")
                self._quality = tag(ui.label(), "signal").classes("q-px-md q-py-xs rounded-borders text-bold")
                self._lost = tag(ui.label(), "lost")
                self._rate = tag(ui.label(), "rate")
            self._counters = tag(ui.label(), "counters").classes("ps-dim")
            with tag(ui.element("details").props("open").classes("w-full"), "live"):
                summary(words("Sensor signals"))
                self._plots = self._build(max(1.0, session.request.speed))
                tag(ui.switch(words("Enlarge small changes"), on_change=self._enlarge), "enlarge")
        rate = self._device.layout.rate_hz * max(1.0, session.request.speed)
        self._place = max(0, self._device.buffer.count - int(_WINDOW_S * rate))
        self._drawn_signal = ""
        self._figures_s = self._plotted_s = -math.inf

    def _build(self, speed: float) -> list[tuple[Plot, list[int]]]:
        words, kinds = self._page.words, dict[str, list[int]]()
        channels = self._device.layout.channels
        for n, channel in enumerate(channels):
            kinds.setdefault(channel.kind, []).append(n)
        plots = []
        with ui.row().classes("w-full items-start").style("gap: 8px"):
            for kind, indices in kinds.items():
                title = words(CHANNEL_KINDS.get(kind, kind))
                names = [words.channel(channels[n].name) for n in indices]
                label = words(
                    "The last {s} seconds of: {channels}", s=f"{_WINDOW_S * speed:g}", channels=", ".join(names)
                )
                series = [{"label": name, "stroke": LINES[i % len(LINES)]} for i, name in enumerate(names)]
                flex = "2 1 420px" if len(indices) > 5 else "1 1 260px"
                with ui.column().classes("ps-no-gap").style(f"flex: {flex}; min-width: 0"):
                    ui.label(title).classes("text-bold")
                    plot = Plot(
                        label,
                        series,
                        x=words("Time of the toy (s)"),
                        y=words.unit(channels[indices[0]].unit),
                        height=190,
                        window_s=_WINDOW_S * speed,
                    )
                    plots.append((tag(plot, f"plot-{kind}"), indices))
        return plots

    def _enlarge(self, event: Any) -> None:
        for plot, _ in self._plots:
            plot.enlarge(bool(event.value))

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
            self._quality.text = f"{sign} {words(_SIGNALS[s.signal])}"
            self._quality.style(f"background: {colour}; color: #fff").props(f'data-signal="{s.signal}"')
        shares = {"recent": percent(s.bad_share, words), "ever": percent(s.bad_share_total, words)}
        # Without a signal, these figures are meaningless.
        has_signal = s.signal not in ("none", "unreadable")
        lost = words(
            "{recent} % of frames lost or damaged in the last 10 s, {ever} % since the session was opened", **shares
        )
        self._lost.text = lost if has_signal else ""
        self._rate.text = words("{rate} frames a second", rate=f"{s.rate_hz:.0f}") if has_signal else ""
        counts = {k: getattr(s, k) for k in ("lost", "malformed", "garbage", "gaps", "reconnects")}
        self._counters.text = words(
            "lost {lost} · unreadable {malformed} · out of range {garbage} · gaps {gaps} · reconnected {reconnects}",
            **counts,
        )

    def push(self) -> None:
        """Append new samples to the plots, at most every `_PLOTS_S`."""
        now_s = time.monotonic()
        if now_s - self._plotted_s < _PLOTS_S:
            return
        self._plotted_s = now_s
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
            summary(words("All recordings: go to one"))
            if len(steps) > _MAX_STEPS:
                ui.label(words("There are too many recordings to list. Press b to go back and s to skip."))
                return
            signs = {**{key: words(text) for key, text in _STEPS.items()}, "now": words("now")}
            ui.label(" · ".join(f"{_SIGNS[key]} {text}" for key, text in signs.items())).classes("ps-dim")
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
            text = words(_STEPS[state]) + (f", {words('now')}" if now else "")
            step = result.step
            repetition = words("{n} of {m}", n=step.repetition, m=status.repetitions)
            signs = _SIGNS[state] + (f" {_SIGNS['now']}" if now else "")
            self._buttons[n].text = f"{step.repetition} {signs}"
            label = f"{words.gesture(step.gesture)}, {repetition}: {text}"
            named(self._buttons[n].props(f'data-step="{state}"'), label)
