"""Build the dialog that forgets a person everywhere in the studio, and write the receipt of it."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nicegui import run, ui

from plushsense.studio.app.jobs import Jobs
from plushsense.studio.app.shell import Page, button, heading, named, on_page, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.app.workspace import DISCARDED, Workspace
from plushsense.studio.widgets.elements import folded_lines, on_enter, open_dialog

if TYPE_CHECKING:
    from plushsense.workflow.forgetting import HomeTraces, PersonTrace

_KINDS: Texts = {
    "dataset": "Data set “{name}”: recordings, marks and evaluations of this person",
    "sessions": "Recorded sessions of {name}",
    "network": "Network “{name}”, which has read this person",
    "export": "Export “{name}” of such a network",
    "package": "Package “{name}”",
    "backup": "Backup “{name}”, with everybody in it",
    "key": "Line of this person in the key “{name}”",
    "folder": "Folder “{name}”",
    "notes": "Notes of the studio in the folder “{name}”",
}


def _trace_text(words: Words, workspace: Workspace, kind: str, path: Path) -> str:
    """Return what a trace is, and whether it is discarded."""
    name = workspace.title(path) if kind == "dataset" else path.name.removesuffix(".plush")
    text = words(_KINDS[kind], name=name)
    return f"{text} ({words('discarded')})" if workspace.folder / DISCARDED in path.parents else text


def _out_of_reach(words: Words, pseudonyms: Iterable[str], published: Iterable[str]) -> list[str]:
    """Return what the studio cannot remove, in sentences."""
    codes = ", ".join(pseudonyms)
    return [
        words(
            "The studio cannot reach copies elsewhere: memory cards, other computers, toys, downloads, published data, "
            "your list on paper. Delete them yourself, and ask whoever has them to do so."
        ),
        *([words("In packages with new codes this person is {codes}.", codes=codes)] if codes else []),
        *(f"https://doi.org/{doi}" for doi in published),
    ]


class ForgetDialog:
    """Dialog that forgets a person: choose the person, see everything with ticks, type the code."""

    def __init__(self, page: Page, jobs: Jobs) -> None:
        self._page, self._words, self._jobs, self._workspace = page, page.words, jobs, page.workspace
        home = self._workspace.folder
        self._given = [path for path in self._workspace.given if home not in path.parents]
        self._person = ""
        self._ticks: list[tuple[PersonTrace, ui.checkbox]] = []

    async def open(self) -> None:
        """Open the dialog with the choice of the person."""
        words = self._words
        title = words("Forget a person everywhere")
        with self._page.show_errors():
            from plushsense.workflow.forgetting import people_of_home

            people = await run.io_bound(people_of_home, self._workspace.folder, self._given) or []
            with open_dialog(title, "forget", "ps-dialog") as self._dialog:
                heading(title, 2)
                choice = ui.select(people, label=words("Code of the person"), on_change=lambda e: self._look(e.value))
                tag(choice.classes("w-full"), "forget-person")
                self._box = ui.column().classes("w-full ps-small-gap").props('aria-live="polite"')
                with ui.row().classes("w-full justify-end"):
                    button("", words("Cancel"), self._dialog.close, "flat")

    async def _look(self, person: str) -> None:
        """Show everything that names the person or has read their recordings."""
        self._person = person
        self._box.clear()
        with self._box:
            ui.spinner(size="1.2em").props("aria-hidden=true")
        found: HomeTraces | None = None
        with self._page.show_errors():
            from plushsense.workflow.forgetting import find_traces

            found = await run.io_bound(find_traces, self._workspace.folder, person, self._given)
        if found is None:
            self._dialog.close()
        if found is None or person != self._person:
            return
        self._box.clear()
        with self._box:
            self._show(found)

    def _show(self, found: HomeTraces) -> None:
        words = self._words
        ui.label(words("What is ticked is removed for good.")).classes("text-bold")
        scroll = ui.column().classes("ps-scroll w-full ps-no-gap").props("tabindex=0 role=group")
        with tag(named(scroll, words("What is known about {person}", person=found.person)), "forget-traces"):
            self._ticks = [(trace, self._tick(trace)) for trace in found.traces]
        if any(trace.kind == "backup" for trace in found.traces):
            about = words("A backup that is not ticked still holds this person, and can bring the recordings back.")
            tag(ui.label(about).classes("ps-note"), "forget-backup")
        home = self._workspace.folder
        rest = [str(path.relative_to(home) if home in path.parents else path) for path in found.mentions]
        folded_lines(words, words("Files that may name this person; look through them: {n}", n=len(rest)), rest)
        for sentence in _out_of_reach(words, found.pseudonyms, found.published):
            ui.label(sentence).classes("ps-note ps-break")
        about = words("The code is remembered, scrambled, so that its recordings are never suggested again.")
        ui.label(about).classes("ps-note")
        text = words("To remove {person} for good, type the code once more.", person=found.person)
        ui.label(text).classes("ps-break")

        def remove() -> None:
            if str(code.value or "").strip() != found.person:
                code.error = words("This is not the code of the chosen person.")
            else:
                self._remove(found.person)

        code = tag(ui.input(words("Code of the person")).classes("w-full"), "forget-code")
        on_enter(code, on_page(remove))
        button("forget-go", words("Remove for good"), on_page(remove), "unelevated color=negative")

    def _tick(self, trace: PersonTrace) -> ui.checkbox:
        words = self._words
        text = _trace_text(words, self._workspace, trace.kind, trace.path)
        text += f" · {words('files: {n}', n=trace.count)}" if trace.count > 1 else ""
        text += "" if trace.certain else f" · {words('perhaps')}"
        return ui.checkbox(text, value=trace.certain)

    def _remove(self, person: str) -> None:
        """Start to remove what is ticked."""
        chosen = [trace for trace, tick in self._ticks if tick.value]
        self._dialog.close()
        with self._page.show_errors():
            for trace in chosen:
                self._jobs.check_unused(trace.path)
            home = self._workspace.folder
            spec = {"home": str(home), "given": [str(p) for p in self._given], "name": home.name, "person": person}
            title = self._words("Forgetting a person everywhere")
            self._jobs.start("forget", spec | {"chosen": [trace.id for trace in chosen]}, title)
            self._page.show_work()


def receipt_text(page: Page, receipt: dict[str, Any], ended_s: float) -> str:
    """Return the receipt of a removal as text, from the JSON of a `RemovalReceipt`."""
    words, workspace = page.words, page.workspace

    def listed(traces: Iterable[list[Any]]) -> list[str]:
        lines = []
        for kind, path, *why in traces:
            text = f"- {_trace_text(words, workspace, kind, Path(path))}: {path}"
            lines.append(text + "".join(f": {words.failure(each)}" for each in why))
        return lines or [f"- {words('nothing')}"]

    return "\n".join(
        [
            words("Receipt: a person was forgotten"),
            f"{words('Code of the person')}: {receipt['person']}",
            time.strftime("%Y-%m-%d %H:%M", time.localtime(ended_s)),
            f"PlushSense: {workspace.folder}",
            "",
            words("Removed for good:"),
            *listed(receipt["removed"]),
            "",
            words("Not removed:"),
            *listed([*receipt["kept"], *receipt["failed"]]),
            *(f"- {path}" for path in receipt["mentions"]),
            "",
            words("Out of reach:"),
            *_out_of_reach(words, receipt["pseudonyms"], receipt["published"]),
            "",
        ]
    )
