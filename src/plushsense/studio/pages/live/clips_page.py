"""Build the section of the live page that records, lists, labels and imports clips."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui

from plushsense.core.gestures import GestureSet
from plushsense.core.recorder_csv import Frames
from plushsense.dataset.store import DatasetHead
from plushsense.studio.app.shell import LINES, Page, button, html, moment, named, on_change, section, tag
from plushsense.studio.pages.live.adapting_page import PersonFields
from plushsense.studio.pages.live.clips import Clip, Clips
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.widgets.elements import Plot

_KEEP_S = (5, 10, 20, 40)
_MAX_POINTS = 3000
_MAX_NAMES = 4
_START, _END = "#009E73", "#D55E00"


def show(page: Page, reader: LiveReader, people: PersonFields) -> None:
    """Build the section for clips, which is below the live view."""
    clips = page.workspace.part(Clips)
    words = page.words
    with section(words("live.hard")):
        ui.label(words("live.hard_about")).classes("ps-dim")
        # Display messages about clips here instead of at the top of the page, which may be out of view.
        near = replace(page, _messages=ui.column().classes("w-full ps-messages"))
        _recording_controls(near, reader, clips, people)
        listing = tag(ui.column().classes("w-full ps-no-gap"), "clips")
        editor = tag(ui.column().classes("w-full"), "clip")

    async def refresh() -> None:
        all_clips = await asyncio.to_thread(clips.all)
        listing.clear()
        with listing:
            if not all_clips:
                ui.label(words("live.clips_none")).classes("ps-dim")
            for clip in all_clips:
                _row(page, clips, clip, partial(edit, clip.key))

    async def edit(key: str) -> None:
        with near.show_errors():
            near.say("")
            clip = await asyncio.to_thread(clips.get, key)
            frames = await asyncio.to_thread(clips.rows, clip)
            editor.clear()
            with editor:
                _ClipEditor(page, clips, clip, frames)

    ui.timer(0.05, refresh, once=True)
    on_change(clips.changed, refresh)


def _recording_controls(page: Page, reader: LiveReader, clips: Clips, people: PersonFields) -> None:
    """Build the field for the person and the buttons that record a clip."""
    words = page.words
    with ui.row().classes("w-full items-end ps-small-gap"):
        person = people.add("person").classes("w-64")
        seconds = ui.select({s: words("live.seconds", s=s) for s in _KEEP_S}, value=10, label=words("live.keep_last"))
        tag(seconds, "keep-seconds").classes("w-32")
        keep = button("keep", words("live.keep"), None, "unelevated", icon="bookmark_add")
        begin = button("record", words("live.record"), icon="fiber_manual_record")
        end = button("record-end", words("live.record_end"), None, "unelevated", icon="stop")
        end.style("background: #a3310a !important; color: #fff !important")
        length = tag(ui.label("").props('role="timer"').classes("ps-dim"), "record-length")

    async def keep_last() -> None:
        if not (subject := people.checked(person)):
            return
        with page.show_errors():
            key = await asyncio.to_thread(clips.keep, reader, float(seconds.value), subject)
            page.say(words("live.kept", clip=key), "good")

    async def start() -> None:
        if not (subject := people.checked(person)):
            return
        with page.show_errors():
            await asyncio.to_thread(clips.begin, reader, subject)

    async def stop() -> None:
        key = await asyncio.to_thread(clips.end)
        if key and not clips.failed:
            page.say(words("live.kept", clip=key), "good")

    failed, updated_s = clips.failed, 0.0

    def update() -> None:
        nonlocal failed
        keep.set_enabled(reader.device is not None and reader.device.buffer.count > 0)
        begin.set_enabled(reader.now.running)
        begin.set_visibility(not clips.recording)
        end.set_visibility(bool(clips.recording))
        if clips.failed is not None and failed is not clips.failed:
            page.say(words.error(clips.failed), "error")
        failed = clips.failed

    def update_sometimes() -> None:
        # The reader notifies about twenty times a second; update only twice.
        nonlocal updated_s
        if time.monotonic() - updated_s < 0.5:
            return
        updated_s = time.monotonic()
        length.set_text(words("live.recorded", s=words.number(clips.recorded_s)) if clips.recording else "")
        update()

    keep.on_click(keep_last)
    begin.on_click(start)
    end.on_click(stop)
    person.on("keydown.enter", keep_last)
    on_change(clips.changed, update)
    on_change(reader.changed, update_sometimes)
    update()


def _row(page: Page, clips: Clips, clip: Clip, edit: Callable[[], Awaitable[None]]) -> None:
    words = page.words
    if clip.key == clips.recording:
        state = words("live.clip_recording")
    elif not clip.labels:
        state = words("live.clip_unlabelled")
    else:
        state = ", ".join(dict.fromkeys(words.gesture(label.gesture) for label in clip.labels[:_MAX_NAMES]))
        if (more := len(clip.labels) - _MAX_NAMES) > 0:
            state = words("live.clip_more", names=state, n=more)
        state += f"; {words('live.clip_added', names=', '.join(clip.added))}" if clip.added else ""
    with ui.row().classes("w-full items-center ps-small-gap").style("border-bottom: 1px solid var(--ps-line)") as row:
        tag(row, f"clip-{clip.key}")
        ui.label(clip.key).classes("text-bold")
        when = moment(clip.head.started_ms / 1000.0)
        ui.label(f"{when}, {words.number(clip.seconds, 1)} s").classes("ps-dim")
        ui.label(state).classes("flex-grow")
        if clip.head.simulated:
            ui.label(words("live.simulated_short")).classes("ps-simulated")
        opener = button("", words("live.clip_open"), edit, "flat dense")
        named(opener, f"{words('live.clip_open')} {clip.key}").set_enabled(clip.key != clips.recording)


class _ClipEditor:
    """Editor of one clip: displays its signals, labels the selected part and adds the clip to a data set.

    The selected part consists of the rows ``_first`` (inclusive) to ``_last`` (exclusive).
    """

    def __init__(self, page: Page, clips: Clips, clip: Clip, frames: Frames) -> None:
        self._page, self._clips, self._clip, self._frames = page, clips, clip, frames
        self._seconds = np.maximum.accumulate(frames.device_ms - frames.device_ms[:1]) / 1000.0
        self._first, self._last = 0, len(frames)
        # Whether the next click sets the end of the selected part.
        self._next_end = False
        self._setting = False
        words = page.words
        html(words("live.clip_title", clip=clip.key), "h2")
        ui.label(words("live.clip_about")).classes("ps-dim")
        names = [words.channel(name) for name in clip.layout.names]
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
        with ui.row().classes("w-full items-end ps-small-gap"):
            self._from = self._number(words("live.clip_from"), "clip-from")
            self._to = self._number(words("live.clip_to"), "clip-to")
            self._summary = tag(ui.label("").classes("ps-dim"), "clip-rows")
        with ui.row().classes("w-full items-end ps-small-gap"):
            self._datasets = {str(p): page.workspace.title(p) for p in page.workspace.datasets()}
            self._dataset = ui.select(
                self._datasets,
                value=next(iter(self._datasets), None),
                label=words("live.clip_dataset"),
                on_change=self._update_gestures,
            ).classes("col-12 col-sm-4")
            tag(self._dataset, "clip-dataset")
            self._gesture = ui.select(
                [], label=words("live.clip_gesture"), with_input=True, new_value_mode="add-unique"
            ).classes("col-12 col-sm-4")
            tag(self._gesture, "clip-gesture")
            button("clip-label", words("live.clip_label"), self._label, "unelevated", icon="label")
            self._add_button = button("clip-add", words("live.clip_add"), self._add, icon="playlist_add")
        self._page = replace(page, _messages=ui.column().classes("w-full ps-messages"))
        self._add_button.set_enabled(bool(clip.labels))
        self._update_gestures()
        self._draw()

    def _number(self, label: str, name: str) -> ui.number:
        field = ui.number(label, step=0.01, format="%.2f", suffix="s", on_change=self._typed)
        return tag(field.classes("w-36"), name)

    def _lanes(self) -> tuple[list[float], list[list[float]]]:
        """Return the times and the curves, scaled so that each channel has its own lane, with the first on top."""
        step = max(1, -(-len(self._frames) // _MAX_POINTS))
        values = self._frames.values[::step].astype(float)
        low, high = values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf)
        lanes = 0.05 + 0.9 * (values - low) / np.maximum(high - low, 8.0) + np.arange(values.shape[1])[::-1]
        return (
            [round(s, 3) for s in self._seconds[::step].tolist()],
            [[round(v, 3) for v in column] for column in lanes.T.tolist()],
        )

    def _marks(self) -> list[dict[str, Any]]:
        words = self._page.words
        begin, end = self._at(self._first), self._at(self._last - 1)
        label_style = {"stroke": "#808080", "dash": [2, 4], "row": 1}
        return [
            {"x": begin, "label": words("live.mark_start"), "stroke": _START, "to": end},
            {"x": end, "label": words("live.mark_end"), "stroke": _END, "dash": [6, 4]},
            *({"x": self._at(n.first), "label": words.gesture(n.gesture), **label_style} for n in self._clip.labels),
        ]

    def _at(self, row: int) -> float:
        seconds = self._seconds
        return float(seconds[min(max(row, 0), len(seconds) - 1)]) if len(seconds) else 0.0

    def _row(self, second: float) -> int:
        """Return the row nearest to the time ``second``."""
        return int(np.abs(self._seconds - second).argmin()) if len(self._seconds) else 0

    def _picked(self, x: float, pressed: str, shift: bool) -> None:
        """Set the start with the first click; set the end with the next click, the right button or shift."""
        row = self._row(x)
        if pressed == "right" or shift or (self._next_end and row > self._first):
            self._last, self._next_end = row + 1, False
        else:
            self._first, self._next_end = row, True
            if self._last <= row + 1:
                self._last = len(self._frames)
        self._draw()

    def _typed(self) -> None:
        if self._setting or self._from.value is None or self._to.value is None:
            return
        self._first = self._row(float(self._from.value))
        self._last = self._row(float(self._to.value)) + 1
        self._draw(fields=False)

    def _draw(self, fields: bool = True) -> None:
        begin, end = self._at(self._first), self._at(self._last - 1)
        if fields:
            self._setting = True
            self._from.set_value(round(begin, 2))
            self._to.set_value(round(end, 2))
            self._setting = False
        words, rows = self._page.words, max(0, self._last - self._first)
        self._summary.set_text(words("live.clip_rows", rows=rows, s=words.number(max(0.0, end - begin), 2)))
        self._plot.lines(self._marks())

    def _update_gestures(self) -> None:
        """Update the selectable gestures to those of the chosen data set."""
        words = self._page.words
        labels: tuple[str, ...] = ()
        if self._dataset.value:
            with self._page.show_errors():
                gestures: GestureSet = DatasetHead.read(Path(self._dataset.value)).gestures
                labels = gestures.labels
        value = self._gesture.value if self._gesture.value in labels else None
        self._gesture.set_options({label: words.gesture(label) for label in labels}, value=value)

    async def _label(self) -> None:
        page, key = self._page, self._clip.key
        with page.show_errors():
            gesture = str(self._gesture.value or "")
            if not gesture:
                page.say(page.words("live.clip_which"), "error")
                return
            label = await asyncio.to_thread(self._clips.label, key, gesture, self._first, self._last)
            self._clip = await asyncio.to_thread(self._clips.get, key)
            self._add_button.set_enabled(True)
            self._draw()
            page.say(page.words("live.clip_labelled", gesture=page.words.gesture(gesture), file=label.file), "good")

    async def _add(self) -> None:
        page = self._page
        with page.show_errors():
            if not self._dataset.value:
                page.say(page.words("live.clip_no_dataset"), "error")
                return
            done = await asyncio.to_thread(self._clips.add, self._clip.key, Path(self._dataset.value))
            name = self._datasets[self._dataset.value]
            page.say(page.words("live.clip_in", n=done.added["recordings"], name=name), "good")
