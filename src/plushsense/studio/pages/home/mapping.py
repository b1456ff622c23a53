"""Show how files of a sensor that is new are read: where person, gesture, take, time and channels stand in them."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nicegui import ui

from plushsense.core.gestures import NOBODY
from plushsense.dataset.importing.sources import XDF_ENDINGS
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.studio.app.shell import heading, on_page, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.widgets.elements import folded_lines, notice, summary, table

_PARTS: Texts = {"subject": "Person", "label": "Gesture", "recording": "Take", "time": "Time"}
_NOWHERE: Texts = {
    "subject": "not in the files: all are of one person",
    "recording": "not in the files: one after the other",
    "time": "not in the files: rows come at an even rate",
}
_UNITS: Texts = {
    "s": "seconds",
    "ms": "milliseconds",
    "us": "microseconds",
    "ns": "nanoseconds",
    "d": "days",
    "iso": "date or time of day",
}
_SEPARATORS: Texts = {",": "comma", ";": "semicolon", "\t": "tab", "|": "vertical line", " ": "spaces"}
_DECIMALS: Texts = {".": "point: 0.5", ",": "comma: 0,5"}
_FIELDS = "display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 16rem), 1fr)); gap: 4px 16px"
_MAX_CHANNELS = 6
# Files that are no text.
_BINARY = (".parquet", *XDF_ENDINGS)
_COLUMN = "column"


@dataclass
class FileMapping:
    """Corrections of a guess by the user: values of a `GuessSpec`, and the person's code if the files name none."""

    given: dict[str, Any] = field(default_factory=dict)
    person: str = ""
    changed: str = ""
    """Name of the field that was changed last."""

    def state(self, key: str, value: Any) -> None:
        """State a value, or where a part stands."""
        self.changed = key
        if key == "person":
            self.person = value
        elif key in _PARTS:
            self.given.setdefault("parts", {})[key] = value
        else:
            self.given[key] = value


class MappingPanel:
    """Fields that say where everything stands, what is uncertain beside them, and ten rows as they are understood.

    Args:
        result: result of the task ``guess``.
        changed: called when a person has corrected something.
    """

    def __init__(
        self,
        words: Words,
        mapping: FileMapping,
        result: Mapping[str, Any],
        changed: Callable[[], None],
    ) -> None:
        self._words, self._mapping, self._changed = words, mapping, on_page(changed)
        self._guess = guess = result["guess"]
        self._pattern = tomllib.loads(guess["toml"])
        self._names = {c["key"]: self._name(c) for c in guess["candidates"]}
        self._roles = {c["role"]: c["key"] for c in guess["candidates"]}
        heading(words("How the files are read"), 3)
        about = words(
            "These files are of sensors that are new here. Look whether the rows below are right, and choose what is "
            "not. It is remembered for further files of this kind."
        )
        ui.label(about).classes("ps-dim")
        with ui.element("div").classes("w-full").style(_FIELDS):
            for part in _PARTS:
                self._part(part)
            self._channels()
            if self._roles.get("label", "").startswith(_COLUMN):
                self._several("idle", words("Nothing happens in"), {x: x for x in guess["labels"]}, self._pattern)
        self._doubts("files")
        if not self._pattern["paths"][0].endswith(_BINARY):
            with tag(ui.element("details").classes("w-full"), "map-more"):
                summary(words("Form of the tables"))
                with ui.element("div").classes("w-full").style(_FIELDS):
                    separator, decimal = (self._pattern.get(k, v) for k, v in (("separator", ","), ("decimal", ".")))
                    self._choice("separator", words("Between columns"), _SEPARATORS, separator)
                    self._choice("decimal", words("Before the decimals"), _DECIMALS, decimal)
        self._rows(result)

    def _state(self, key: str, value: Any) -> Any:
        self._mapping.state(key, value)
        return self._changed()

    # Fields ---------------------------------------------------------------------------------------------------

    def _name(self, candidate: Mapping[str, Any]) -> str:
        """Return what a piece of the paths or a column is called, with examples."""
        words, examples = self._words, ", ".join(candidate["examples"])
        place, _, name = candidate["key"].partition(":")
        if place == _COLUMN:
            return words("column “{name}”: {examples}", name=name, examples=examples)
        if candidate["in_folder"]:
            return words("name of the folder: {examples}", examples=examples)
        return words("name of the file: {examples}", examples=examples)

    def _part(self, part: str) -> None:
        """Add the choice of the place of a part, and what belongs to it."""
        words, roles = self._words, self._roles
        places = {c["key"]: c for c in self._guess["candidates"]}
        fitting = [k for k in places if part != "time" or (k.startswith(_COLUMN) and places[k]["role"] != "label")]
        options = {key: self._names[key] for key in fitting}
        if part in _NOWHERE:
            options[""] = words(_NOWHERE[part])
        value = roles.get(part, "" if part in _NOWHERE else None)
        with ui.column().classes("ps-no-gap w-full"):
            select = ui.select(options, value=value, label=words(_PARTS[part]))
            tag(select.classes("w-full"), f"map-{part}")
            select.on_value_change(lambda e: self._state(part, e.value))
            if value is None:
                select.error = words("It is not clear what the gestures are called. Choose where it stands.")
            if part == "subject" and not value:
                self._entry("person", words("Code of the person (such as S01)"), self._mapping.person)
            if part == "time" and value:
                self._choice("time_unit", words("Unit of time"), _UNITS, self._guess["time_unit"])
            elif part == "time":
                self._entry("rate_hz", words("Rows a second"), f"{self._guess['rate_hz']:g}")
            self._doubts(part)

    def _choice(self, key: str, label: str, options: Texts, value: str) -> None:
        names = {name: self._words(text) for name, text in options.items()}
        select = tag(ui.select(names, value=value, label=label).classes("w-full"), f"map-{key}")
        select.on_value_change(lambda e: self._state(key, e.value))

    def _entry(self, key: str, label: str, value: str) -> None:
        entry = tag(ui.input(label, value=value).classes("w-full"), f"map-{key}")

        async def use() -> None:
            text = str(entry.value or "").strip()
            if text == value:
                return
            if key == "person":
                await self._state(key, text)
                return
            try:
                rate = float(text.replace(",", "."))
            except ValueError:
                rate = 0.0
            if 0.1 <= rate <= 10_000:
                await self._state(key, rate)
            else:
                entry.error = self._words("Enter a number from 0.1 to 10000.")

        entry.on("keydown.enter", use).on("blur", use)

    def _channels(self) -> None:
        found = self._guess["candidates"]
        chosen = [c["key"] for c in found if c["role"] == "channel"]
        options = {c["key"]: c["key"].partition(":")[2] for c in found if c["numeric"]}
        self._several("channels", self._words("Sensors (channels)"), options, {"channels": chosen})

    def _several(self, key: str, label: str, options: dict[str, str], current: Mapping[str, Any]) -> None:
        """Add a choice of several things, which counts when its list is closed."""
        value = [each for each in current.get(key, ()) if each in options]
        with ui.column().classes("ps-no-gap w-full"):
            select = ui.select(options, value=list(value), label=label, multiple=True)
            tag(select.classes("w-full"), f"map-{key}")

            async def use() -> None:
                if sorted(select.value) != sorted(value):
                    await self._state(key, [each for each in options if each in select.value])

            select.on("popup-hide", use)
            self._doubts(key)

    def _doubts(self, about: str) -> None:
        for doubt in self._guess["doubts"]:
            if doubt["values"]["about"] == about:
                tag(notice(self._words.sentence(doubt)), "doubt").classes("ps-note")

    # Rows -----------------------------------------------------------------------------------------------------

    def _rows(self, result: Mapping[str, Any]) -> None:
        """Show some rows as they are understood, or why there are none."""
        from plushsense.dataset.importing.results import NO_PEOPLE_OF_PATTERN

        words = self._words
        if "problem" in result:
            tag(notice(words.failure(result["problem"]), "error"), "mapping-problem")
            return
        seen = result["preview"]
        names = {NOBODY: words("nobody"), UNKNOWN_SUBJECT: "?"}
        channels = list(seen["rows"][0]["values"])[:_MAX_CHANNELS] if seen["rows"] else []
        rows = [
            [
                row["file"].partition(": ")[0],
                names.get(row["subject"], row["subject"]),
                words.gesture(row["gesture"]),
                words.count(row["time_ms"]),
                *("–" if (v := row["values"][c]) is None else words.significant(v, 6) for c in channels),
            ]
            for row in seen["rows"]
        ]
        head = [*words.each("File", "Person", "Gesture", "Time in ms"), *channels]
        caption = words("Ten rows as they are understood")
        tag(table(caption, head, rows, range(3, len(head))), "mapping-rows").classes("w-full")
        for note in seen["warnings"]:
            if not (isinstance(note, dict) and note["template"] == NO_PEOPLE_OF_PATTERN.template):
                ui.label(words.sentence(note)).classes("ps-note ps-break")
        if seen["left_out"]:
            ui.label(words("Files that do not fit and are left out: {n}", n=seen["left_out"])).classes("ps-note")
        rejected = [f"{r['file']}: {words.sentence(r['reason'])}" for r in seen["rejected"]]
        folded_lines(words, words("Files that are not imported: {n}", n=len(rejected)), rejected, "rejected")
