"""Build the section of the live page that leads through the paper's live validation and shows its results."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from nicegui import ui

from plushsense.experiments.protocol.run_protocol import PAGE, TABLE, TRIALS
from plushsense.experiments.protocol.score import NAMELESS, NOTES
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.shell import Page, button, html, moment, on_change, section, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.live.adapting import PersonFields
from plushsense.studio.pages.live.event_log import SIMULATIONS
from plushsense.studio.pages.live.reader import LiveReader
from plushsense.studio.pages.live.validation import FOLDER, Validation
from plushsense.studio.widgets.elements import notice, picture, scroll_to, summary, table

_HEADS: Texts = {
    "rules_answered": "Rules: answered",
    "rules_time": "Rules: time",
    "toy_answered": "Toy's own rules: answered",
    "toy_time": "Toy's own rules: time",
    "answered": "Network: right affect",
    "answered_time": "Network: time",
    "named": "Right gesture",
    "named_time": "Time to the right gesture",
    "likelihood": "Likelihood",
}

_PHASES: Texts = {
    "countdown": "Get ready: {gesture}",
    "doing": "Now: {gesture}",
    "after": "Thank you. Hand away.",
    "paused": "Pause. Next: {gesture}",
    "scoring": "The trials are being scored …",
}

_NOTES: Texts = {
    "hybrid": (
        "Rules: the paper's old toy, which knows only kind and rough. Network: with its gate. The time counts from "
        "the prompt, so it includes the reaction time of the person."
    ),
    "cnn": (
        "Rules: the paper's old toy, which knows only kind and rough. Network: without a gate, as it has none. The "
        "time counts from the prompt, so it includes the reaction time of the person."
    ),
}


def show(page: Page, reader: LiveReader, people: PersonFields) -> None:
    """Build the section, whose content is folded until it is needed."""
    with section(page.words("Live validation with a new person")) as box:
        _ValidationPanel(page, reader, people)
    tag(box, "validation")


class _ValidationPanel:
    """Form, prompts and results of the validation; every page of the studio shows the same prompts."""

    def __init__(self, page: Page, reader: LiveReader, people: PersonFields) -> None:
        self._reader, self._people, self._words = reader, people, page.words
        self._validation = page.workspace.part(Validation)
        self._workspace = page.workspace
        words = page.words
        about = words(
            "The paper's protocol (section 4.6): the person makes every gesture as prompted, each several times in a "
            "row. The page measures how long the rules and the network need for a right answer, and how sure the "
            "network is. Choose a person on whom the network was not trained. The signals are recorded as a session of "
            "that person."
        )
        ui.label(about).classes("ps-dim")
        # Messages are displayed here, because the top of the page may be out of view.
        self._page = replace(page, _messages=ui.column().classes("w-full ps-messages"))
        self._form = ui.row().classes("w-full items-start ps-small-gap")
        with self._form:
            self._person = people.add("validation-person").classes("w-64")
            times = {n: words("{n} times", n=n) if n > 1 else words("once") for n in (3, 2, 1)}
            self._repetitions = ui.select(times, value=3, label=words("Each gesture")).classes("w-36")
            tag(self._repetitions, "validation-times")
            datasets = {str(p): page.workspace.title(p) for p in page.workspace.datasets()}
            rules = {"": words("nothing: without the rules")} | datasets
            first = page.workspace.part(Choices).last("dataset", datasets)
            self._rules = ui.select(rules, value=first, label=words("Tune the old rules on")).classes("w-64")
            tag(self._rules, "validation-rules")
            noted = ui.checkbox(words("The toy has rules of its own: note its reactions"))
            self._noted = tag(noted, "validation-noted")
            begin = words("Begin the validation")
            self._begin = button("validate", begin, self._start, "unelevated", icon="play_arrow")
        self._add_prompts()
        with tag(ui.element("details").classes("w-full"), "validation-results") as self._past:
            summary(words("Results"))
            self._results = tag(ui.select({}, label=words("Result")).classes("w-64 q-mt-sm"), "validation-result")
            self._result = tag(ui.column().classes("w-full ps-small-gap"), "validation-table")
        self._results.on_value_change(self._show_result)
        self._drawn: tuple[Any, ...] = ()
        on_change(self._validation.changed, self._update)
        on_change(reader.changed, self._update_button)
        self._update()

    def _add_prompts(self) -> None:
        words = self._words
        self._prompts = tag(ui.column().classes("w-full ps-card ps-next ps-small-gap"), "validation-prompts")
        with self._prompts:
            with ui.row().classes("w-full items-center no-wrap"):
                self._picture = html().style("width: clamp(90px, 20vw, 200px); flex: none")
                with ui.column().classes("ps-no-gap").style("min-width: 0"):
                    prompt = ui.label("").style(
                        "font-size: clamp(1.3rem, 3vw, 2rem); line-height: 1.25; font-weight: 600"
                    )
                    self._prompt = tag(prompt, "validation-prompt").props("role=status")
                    self._left = tag(ui.label("").classes("text-lg"), "validation-left")
                    self._trial = tag(ui.label("").classes("ps-dim"), "validation-trial")
            with ui.row().classes("w-full ps-small-gap"):
                self._pause = button("validation-pause", "", self._validation.pause, icon="pause")
                self._skip = button(
                    "validation-skip", words("Skip this trial"), self._validation.skip, icon="skip_next"
                )
                button("validation-stop", words("End and score"), self._validation.stop, icon="stop")
            self._reactions = ui.row().classes("w-full items-center ps-small-gap")
            with self._reactions:
                texts = words.each("The toy is pleased now", "The toy is cross now")
                for affect, text in zip(("positive", "negative"), texts, strict=True):
                    button(f"validation-{affect}", text, partial(self._validation.react, affect))
                self._noted_count = tag(ui.label("").classes("ps-dim"), "validation-noted-count")

    async def _start(self) -> None:
        if not (subject := self._people.checked(self._person)):
            return
        self._page.say("")
        tune_on = Path(self._rules.value) if self._rules.value else None
        with self._page.show_errors():
            await asyncio.to_thread(
                self._validation.begin, subject, int(self._repetitions.value), tune_on, self._noted.value
            )
            scroll_to("validation")

    def _update_button(self) -> None:
        self._begin.set_enabled(self._reader.now.running)

    def _update(self) -> None:
        status, words = self._validation.status, self._words
        led = status.phase != ""
        self._form.set_visibility(not led)
        self._prompts.set_visibility(led)
        self._update_button()
        gesture = words.gesture(status.label)
        self._prompt.set_text(words(_PHASES[status.phase], gesture=gesture) if led else "")
        self._left.set_text(f"{status.left_s} s" if status.left_s else "")
        where = {"n": status.at + 1, "total": status.total, "repetition": status.repetition}
        self._trial.set_text(words("Trial {n} of {total} (repetition {repetition})", **where) if led else "")
        self._pause.set_text(words("Continue" if status.phase == "paused" else "Pause"))
        self._pause.set_enabled(status.can_pause)
        self._skip.set_enabled(status.phase in ("countdown", "doing", "paused"))
        self._reactions.set_visibility(status.reactions is not None)
        if status.reactions is not None:
            self._noted_count.set_text(words("Reactions noted: {n}", n=status.reactions))
        drawn = (status.label, status.result, status.failed)
        if drawn == self._drawn:
            return
        last, self._drawn = self._drawn, drawn
        if status.label:
            self._picture.set_content(picture(status.label, gesture))
        if status.failed is not None:
            self._page.say(words.error(status.failed), "error")
        if not last or status.result != last[1]:
            self._update_results(str(status.result or ""))
            if last and status.result is not None:
                self._past.props("open")
                values = {"n": status.done, "folder": f"{FOLDER}/{status.result.name}"}
                ended = words("The validation has ended. Trials: {n}. Everything is in the folder {folder}.", **values)
                self._page.say(ended, "good")

    def _update_results(self, chosen: str) -> None:
        found = self._validation.results()
        when = {str(p): f"{p.name}, {moment(p.stat().st_mtime)}" for p in found}
        self._past.set_visibility(bool(found))
        self._results.set_options(when, value=chosen or next(iter(when), None))

    async def _show_result(self) -> None:
        self._result.clear()
        if not self._results.value:
            return
        folder = Path(self._results.value)
        with self._page.show_errors():
            result = await asyncio.to_thread(self._validation.read, folder)
            with self._result:
                _result_table(self._words, result)
                with ui.row().classes("ps-small-gap"):
                    self._save("report", self._words("Save the report (in English)"), folder / PAGE)
                    self._save("table", self._words("Save the table (CSV)"), folder / TABLE)
                    self._save("trials", self._words("Save every trial (CSV)"), folder / TRIALS)

    def _save(self, name: str, label: str, file: Path) -> None:
        path = self._workspace.inside(file)

        def download() -> None:
            ui.download.content(path.read_bytes(), f"{path.parent.name}-{path.name}")

        button(f"validation-{name}", label, download, icon="download")


def _result_table(words: Words, result: Mapping[str, Any]) -> None:
    """Add the table of a result: the trials of each gesture, as rules and network answered them."""
    systems = [row["system"] for row in result["systems"]]
    network = "hybrid" if "hybrid" in systems else "cnn"
    nameless = [system for system in systems if system in NAMELESS]
    by = {(row["gesture"], row["system"]): row for row in result["by_gesture"]}
    everything = {row["system"]: row for row in result["rows"] if row["group"] == "all"}
    labels = list(dict.fromkeys(row["gesture"] for row in result["by_gesture"]))
    names = [*map(words.gesture, labels), words("All gestures")]
    chosen = [*({s: by[label, s] for s in systems} for label in labels), everything]

    def seconds(value: float | None) -> str:
        return "–" if value is None else f"{words.number(value, 1)} s"

    rows = []
    for name, row in zip(names, chosen, strict=True):
        one = row[network]
        likelihood = "–" if one["likelihood"] is None else words.number(one["likelihood"], 2)
        cells = [name]
        for system in nameless:
            answers = row[system]
            cells += [f"{answers['activated']}/{answers['trials']}", seconds(answers["reaction_s"]["median"])]
        cells += [f"{one['activated']}/{one['trials']}", seconds(one["reaction_s"]["median"])]
        cells += [f"{one['named']}/{one['trials']}", seconds(one["gesture_s"]["median"]), likelihood]
        rows.append(cells)
    head = [words("Gesture")]
    head += [words(_HEADS[f"{system}_{what}"]) for system in nameless for what in ("answered", "time")]
    head += [words(_HEADS[key]) for key in ("answered", "answered_time", "named", "named_time", "likelihood")]
    by_network = NOTES["trained_virtual"] in result["said"]
    if kind := "toy" if result["simulated"] else "network" if by_network else "":
        notice(words(SIMULATIONS[kind])).style("box-sizing: border-box")
    ui.label(words(_NOTES[network])).classes("ps-dim ps-note")
    caption = words("People: {people}. Times are medians of the answered trials.", people=", ".join(result["people"]))
    table(caption, head, rows, range(1, len(head)))
