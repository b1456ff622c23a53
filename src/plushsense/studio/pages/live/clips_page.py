"""The part of the live page that keeps, shows, labels and imports clips."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from plushsense.core.gestures import GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import DatasetHead
from plushsense.studio.app.shell import LINES, Page, html, named, on_change, tag
from plushsense.studio.pages.live.clips import Clip, Clips
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.widgets.plot import Plot

_KEEP_S = (5, 10, 20, 40)
_MOST_POINTS = 3000
_START, _END = "#009E73", "#D55E00"


@dataclass
class _OpenClip:
    """The clip that is open on this page. ``first`` and ``last``: rows, the last not in it."""

    clip: Clip
    frames: Frames
    seconds: Any
    first: int
    last: int
    next_end: bool = False


def show(page: Page, reader: LiveReader) -> None:
    """Build the part of the page below the live view."""
    clips = page.workspace.part(Clips)
    words = page.words
    with ui.element("section").classes("ps-card w-full column no-wrap ps-tight"):
        html(words("live.hard"), "h2")
        ui.label(words("live.hard_about")).classes("ps-dim")
        # What is said of clips is said where they are, not at the top of a long page.
        near = replace(page, _messages=ui.column().classes("w-full ps-sayings"))
        _keeping(near, reader, clips)
        listing = tag(ui.column().classes("w-full ps-close"), "clips")
        desk = tag(ui.column().classes("w-full"), "clip")

    async def refresh() -> None:
        found = await asyncio.to_thread(clips.all)
        listing.clear()
        with listing:
            if not found:
                ui.label(words("live.clips_none")).classes("ps-dim")
            for clip in found:
                _row(page, clips, clip, lambda key=clip.key: opened(key))

    async def opened(key: str) -> None:
        with near.show_errors():
            near.say("")
            clip = await asyncio.to_thread(clips.get, key)
            frames = await asyncio.to_thread(clips.rows, clip)
            desk.clear()
            with desk:
                _ClipEditor(page, clips, clip, frames)

    ui.timer(0.05, refresh, once=True)
    on_change(clips.changed, refresh)


def _keeping(page: Page, reader: LiveReader, clips: Clips) -> None:
    """Build the field for the person and the buttons that keep a clip."""
    words = page.words
    with ui.row().classes("w-full items-end ps-tight"):
        person = ui.input(words("live.person"), placeholder="S01").props("outlined dense maxlength=40")
        tag(person, "person")
        seconds = ui.select({s: words("live.seconds", s=s) for s in _KEEP_S}, value=10, label=words("live.keep_last"))
        tag(seconds.props("outlined dense"), "keep-seconds").classes("w-32")
        keep = tag(ui.button(words("live.keep"), icon="bookmark_add").props("unelevated no-caps"), "keep")
        begin = tag(ui.button(words("live.record"), icon="fiber_manual_record").props("outline no-caps"), "record")
        end = tag(
            ui.button(words("live.record_end"), icon="stop")
            .props("unelevated no-caps")
            .style("background: #a3310a !important; color: #fff !important"),
            "record-end",
        )
        length = tag(ui.label("").props('role="timer"').classes("ps-dim"), "record-length")

    def unnamed() -> bool:
        """Return whether the person's code is missing, and then ask for it."""
        if str(person.value or "").strip():
            return False
        page.say(words("live.person_first"), "warning")
        person.run_method("focus")
        return True

    async def kept() -> None:
        if unnamed():
            return
        with page.show_errors():
            key = await asyncio.to_thread(clips.keep, reader, float(seconds.value), str(person.value or ""))
            page.say(words("live.kept", clip=key), "good")

    async def begun() -> None:
        if unnamed():
            return
        with page.show_errors():
            await asyncio.to_thread(clips.begin, reader, str(person.value or ""))

    async def ended() -> None:
        key = await asyncio.to_thread(clips.end)
        if key and not clips.failed:
            page.say(words("live.kept", clip=key), "good")

    last: list[Any] = [None, 0.0]

    def changed() -> None:
        now = clips.recording
        keep.set_enabled(bool(reader.device is not None and reader.device.buffer.count))
        begin.set_enabled(reader.now.running)
        begin.set_visibility(not now)
        end.set_visibility(bool(now))
        if clips.failed and last[0] != clips.failed:
            page.say(clips.failed, "error")
        last[0] = clips.failed

    def moved() -> None:
        # Twenty times a second: only once in a while is there something to change.
        if time.monotonic() - last[1] < 0.5:
            return
        last[1] = time.monotonic()
        text = words("live.recorded", s=words.number(clips.recorded_s)) if clips.recording else ""
        if length.text != text:
            length.set_text(text)
        if keep.enabled != bool(reader.device is not None and reader.device.buffer.count) or (
            begin.enabled != reader.now.running
        ):
            changed()

    keep.on_click(kept)
    begin.on_click(begun)
    end.on_click(ended)
    person.on("keydown.enter", kept)
    on_change(clips.changed, changed)
    on_change(reader.changed, moved)
    changed()


def _row(page: Page, clips: Clips, clip: Clip, opened: Any) -> None:
    words = page.words
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(clip.head.started_ms / 1000.0))
    if clip.key == clips.recording:
        state = words("live.clip_recording")
    elif not clip.labels:
        state = words("live.clip_unlabelled")
    else:
        state = ", ".join(words.gesture(label.gesture) for label in clip.labels)
        state += f"; {words('live.clip_added', names=', '.join(clip.added))}" if clip.added else ""
    with ui.row().classes("w-full items-center ps-tight").style("border-bottom: 1px solid var(--ps-line)") as row:
        tag(row, f"clip-{clip.key}")
        ui.label(clip.key).classes("font-bold")
        ui.label(f"{when}, {words.number(clip.seconds, 1)} s").classes("ps-dim")
        ui.label(state).classes("flex-grow")
        if clip.head.simulated:
            ui.label(words("live.simulated_short")).classes("ps-simulated")
        look = ui.button(words("live.clip_open"), on_click=opened).props("flat dense no-caps")
        named(look, f"{words('live.clip_open')} {clip.key}").set_enabled(clip.key != clips.recording)


class _ClipEditor:
    """An open clip: its signals, the chosen part, its label, and the data set that it is added to."""

    def __init__(self, page: Page, clips: Clips, clip: Clip, frames: Frames) -> None:
        self._page, self._clips = page, clips
        seconds = np.maximum.accumulate(frames.device_ms - frames.device_ms[:1]) / 1000.0
        self._open = _OpenClip(clip, frames, seconds, 0, len(frames))
        self._setting = False
        words = page.words
        html(words("live.clip_title", clip=clip.key), "h2")
        ui.label(words("live.clip_about")).classes("ps-dim")
        names = clip.layout.names
        series = [{"label": name, "stroke": LINES[i % len(LINES)]} for i, name in enumerate(names)]
        self._plot = Plot(
            words("live.clip_plot", clip=clip.key),
            series,
            x=words("live.clip_time"),
            height=340,
            range_y=(-0.1, len(names) + 0.1),
            values_y=False,
            on_pick=self._picked,
        )
        tag(self._plot, "clip-plot").begin(*self._lanes(), self._marks())
        with ui.row().classes("w-full items-end ps-tight"):
            self._from = self._number(words("live.clip_from"), "clip-from")
            self._to = self._number(words("live.clip_to"), "clip-to")
            self._summary = tag(ui.label("").classes("ps-dim"), "clip-rows")
        with ui.row().classes("w-full items-end ps-tight"):
            self._datasets = {str(p): page.workspace.title(p) for p in page.workspace.datasets()}
            self._dataset = ui.select(
                self._datasets,
                value=next(iter(self._datasets), None),
                label=words("live.clip_dataset"),
                on_change=self._offer,
            ).classes("col-12 col-sm-4")
            tag(self._dataset.props("outlined dense"), "clip-dataset")
            self._gesture = ui.select(
                [], label=words("live.clip_gesture"), with_input=True, new_value_mode="add-unique"
            ).classes("col-12 col-sm-4")
            tag(self._gesture.props("outlined dense"), "clip-gesture")
            self._button = tag(
                ui.button(words("live.clip_label"), icon="label", on_click=self._label).props("unelevated no-caps"),
                "clip-label",
            )
            self._adding = tag(
                ui.button(words("live.clip_add"), icon="playlist_add", on_click=self._add).props("outline no-caps"),
                "clip-add",
            )
        self._page = replace(page, _messages=ui.column().classes("w-full ps-sayings"))
        self._adding.set_enabled(bool(clip.labels))
        self._offer()
        self._show()

    def _number(self, label: str, name: str) -> ui.number:
        field = ui.number(label, step=0.01, format="%.2f", suffix="s", on_change=self._typed)
        return tag(field.props("outlined dense").classes("w-36"), name)

    def _lanes(self) -> tuple[list[float], list[list[float]]]:
        """Return the curves with every channel in a lane of its own, the first on top."""
        opened = self._open
        every = max(1, -(-len(opened.frames) // _MOST_POINTS))
        values = opened.frames.values[::every].astype(float)
        low, high = values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf)
        lanes = 0.05 + 0.9 * (values - low) / np.maximum(high - low, 8.0) + np.arange(values.shape[1])[::-1]
        return (
            [round(s, 3) for s in opened.seconds[::every].tolist()],
            [[round(v, 3) for v in column] for column in lanes.T.tolist()],
        )

    def _marks(self) -> list[dict[str, Any]]:
        opened, words = self._open, self._page.words
        begin, end = self._at(opened.first), self._at(opened.last - 1)
        marks: list[dict[str, Any]] = [
            {"x": begin, "label": words("live.mark_start"), "stroke": _START, "to": end},
            {"x": end, "label": words("live.mark_end"), "stroke": _END, "dash": [6, 4]},
        ]
        marks += [
            {
                "x": self._at(label.first),
                "label": words.gesture(label.gesture),
                "stroke": "#808080",
                "dash": [2, 4],
                "row": 1,
            }
            for label in opened.clip.labels
        ]
        return marks

    def _at(self, row: int) -> float:
        seconds = self._open.seconds
        return float(seconds[min(max(row, 0), len(seconds) - 1)]) if len(seconds) else 0.0

    def _row(self, seconds: float) -> int:
        """Return the row nearest to a time."""
        return int(np.abs(self._open.seconds - seconds).argmin()) if len(self._open.seconds) else 0

    def _picked(self, x: float, button: str, shift: bool) -> None:
        """Set the start, then the end, at a click; the right button or shift sets the end."""
        opened = self._open
        row = self._row(x)
        if button == "right" or shift or (opened.next_end and row > opened.first):
            opened.last, opened.next_end = row + 1, False
        else:
            opened.first, opened.next_end = row, True
            if opened.last <= row + 1:
                opened.last = len(opened.frames)
        self._show()

    def _typed(self) -> None:
        if self._setting or self._from.value is None or self._to.value is None:
            return
        self._open.first = self._row(float(self._from.value))
        self._open.last = self._row(float(self._to.value)) + 1
        self._show(fields=False)

    def _show(self, fields: bool = True) -> None:
        opened = self._open
        if fields:
            self._setting = True
            self._from.set_value(round(self._at(opened.first), 2))
            self._to.set_value(round(self._at(opened.last - 1), 2))
            self._setting = False
        length = self._at(opened.last - 1) - self._at(opened.first)
        text = self._page.words(
            "live.clip_rows",
            rows=max(0, opened.last - opened.first),
            s=self._page.words.number(max(0.0, length), 2),
        )
        self._summary.set_text(text)
        self._plot.lines(self._marks())

    def _offer(self) -> None:
        """Offer the gestures of the chosen data set, named in the page's language."""
        words = self._page.words
        labels: tuple[str, ...] = ()
        if self._dataset.value:
            with self._page.show_errors():
                gestures: GestureSet = DatasetHead.read(Path(self._dataset.value)).gestures
                labels = gestures.labels
        value = self._gesture.value if self._gesture.value in labels else None
        self._gesture.set_options({label: words.gesture(label) for label in labels}, value=value)

    async def _label(self) -> None:
        page, opened = self._page, self._open
        with page.show_errors():
            gesture = str(self._gesture.value or "")
            if not gesture:
                page.say(page.words("live.clip_which"), "error")
                return
            label = await asyncio.to_thread(self._clips.label, opened.clip.key, gesture, opened.first, opened.last)
            opened.clip = await asyncio.to_thread(self._clips.get, opened.clip.key)
            self._adding.set_enabled(True)
            self._show()
            page.say(page.words("live.clip_labelled", gesture=page.words.gesture(gesture), file=label.file), "good")

    async def _add(self) -> None:
        page, opened = self._page, self._open
        with page.show_errors():
            if not self._dataset.value:
                page.say(page.words("live.clip_no_dataset"), "error")
                return
            done = await asyncio.to_thread(self._clips.add, opened.clip.key, Path(self._dataset.value))
            name = self._datasets[self._dataset.value]
            page.say(page.words("live.clip_in", n=done.added["recordings"], name=name), "good")
