"""Provide elements that several pages use: facts, tables, plots, pictures of gestures and a panel of running jobs."""

from __future__ import annotations

import base64
import inspect
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup
from nicegui import context, run, ui
from nicegui.element import Element

from plushsense.core.errors import PlushSenseError
from plushsense.core.gestures import plain_label
from plushsense.dataset.privacy.removed import CONSENT
from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import (
    Kind,
    Page,
    add_style,
    button,
    html,
    icon_button,
    message_row,
    named,
    on_change,
    on_page,
    scroll_region,
    tag,
)
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.app.workspace import Workspace

KINDS_OF_TRAINING: Texts = {
    "train": "Train one network",
    "evaluate": "Evaluate on people left out",
    "sweep": "Compare many networks",
    "search": "Find a small network",
    "make": "Make a network",
}
"""Names of the jobs of the train page."""

JOB_STATES: Texts = {"running": "running", "done": "done", "refused": "failed", "stopped": "stopped"}
_CSS = Path(__file__).with_name("elements.css")
_RECENT_S = 900.0
_TITLES = {
    "simulate": "Trial: a data set of virtual people",
    "import": "Import into the data set “{name}”",
    "check": "Checking “{name}”",
    "backup": "Backup of “{name}”",
    "restore": "Restoring “{name}”",
    "save": "Saving “{name}”",
    "open": "Opening “{name}”",
    "forget": "Forgetting a person everywhere",
    "export": "Export “{name}”",
    "profile": "Cost of “{name}”",
    "verify": "Verify “{name}”",
    "publish": "Package “{name}”",
    "validate": "Check of “{name}”",
}


def style() -> None:
    """Add the style sheet of these elements; call this once per page."""
    add_style(_CSS.read_text(encoding="utf-8"))


def text(message: str, kind: str = "p", classes: str = "") -> ui.html:
    """Add plain text as an HTML element."""
    return html(message, kind).classes(classes)


def notice(message: str, kind: Kind = "warning") -> ui.html:
    """Add a sentence in a coloured box."""
    return text(message, classes=f"ps-message ps-message-{kind} w-full")


def item_menu(words: Words, about: str, actions: Mapping[str, Callable[[], Any]]) -> ui.button:
    """Add a button that opens a menu; ``actions`` maps each text to the function to call.

    Args:
        about: what the actions apply to, for screen readers.
    """
    opener = named(
        ui.button(icon="more_vert").props('flat round dense aria-haspopup="menu"'), f"{words('More')}: {about}"
    )
    with tag(opener, "menu"), ui.menu():
        for label, call in actions.items():
            ui.menu_item(label, on_page(call)).props("role=menuitem")
    return opener


def on_enter(field: Element, call: Callable[[], Any]) -> None:
    """Call ``call`` when Enter goes down in a field.

    The key's coming up is dropped: if ``call`` closes a dialog, it would press the item that has the focus afterwards.
    """
    drop = "(up) => up.stopImmediatePropagation(), { capture: true, once: true }"
    field.on("keydown.enter", call, js_handler=f'() => {{ window.addEventListener("keyup", {drop}); emit(); }}')


@contextmanager
def open_dialog(label: str, name: str, classes: str = "") -> Iterator[ui.dialog]:
    """Open a dialog with the elements that are added in the block; it is deleted when it is closed.

    It has no transition, because the next key press may be a command of the page again.
    """
    with context.client.content, ui.dialog() as dialog:
        named(dialog.props("transition-duration=0"), label)
        with tag(ui.card().classes(classes), name):
            yield dialog
    dialog.on("hide", dialog.delete)
    dialog.open()


def ask(
    words: Words,
    title: str,
    go: str,
    answer: Callable[[str], Any],
    label: str = "",
    value: str = "",
    other: tuple[str, Callable[[], Any]] | None = None,
) -> None:
    """Ask a question in a dialog; if the button with the text ``go`` is clicked, call ``answer``, which may be async.

    Args:
        label, value: name of a text field, whose content ``answer`` gets, and what it holds at first; without a label
            there is no field.
        other: text and effect of a further button.
    """

    async def done() -> None:
        dialog.close()
        await on_page(answer)(str(field.value or "").strip() if field is not None else "")

    async def done_otherwise() -> None:
        dialog.close()
        if other:
            await on_page(other[1])()

    field: ui.input | None = None
    with open_dialog(title, "ask") as dialog:
        ui.label(title).classes("text-lg text-bold ps-break")
        if label:
            field = tag(ui.input(label, value=value).props("autofocus").classes("w-full"), "ask-text")
            on_enter(field, done)
        with ui.row().classes("w-full justify-end"):
            button("", words("Cancel"), dialog.close, "flat" if label else "flat autofocus")
            if other:
                button("ask-other", other[0], done_otherwise, "outline")
            button("ask-go", go, done, "unelevated" if label else "outline")


async def admitting(
    page: Page, work: Callable[[bool], Any], other: tuple[str, Callable[[], Any]] | None = None
) -> bool:
    """Call ``work(False)``; if people would come back who were removed, ask, and then call ``work(True)``.

    Args:
        other: text and effect of a further button of the question.

    Returns:
        Whether the work is done; otherwise it was refused, or the question is open.
    """
    words = page.words
    with page.show_errors():
        try:
            if inspect.isawaitable(done := work(False)):
                await done
            return True
        except PlushSenseError as refusal:
            if refusal.message.values.get("needs") != CONSENT:
                raise
            go_on = words("Take them in anyway")
            ask(words, words.error(refusal), go_on, lambda _: admitting(page, lambda _: work(True)), other=other)
    return False


async def change_files(
    page: Page,
    work: Callable[[], Any],
    message: str,
    refresh: Callable[[], Awaitable[None]],
    undo: Callable[[Any], Any] | None = None,
) -> None:
    """Call ``work`` in a thread, show the files again, and show ``message``, with a button to undo the change.

    Args:
        refresh: shows the files again.
        undo: called with the result of ``work`` if the button is clicked; without it there is no button.
    """
    with page.show_errors():
        result = await run.io_bound(work)
        await refresh()

        async def take_back() -> None:
            assert undo is not None
            back = undo
            await change_files(page, lambda: back(result), page.words("Undone."), refresh)

        page.say(message, "good", None if undo is None else take_back)


@contextmanager
def errors_beside(page: Page, field: Any) -> Iterator[None]:
    """Show an error that is raised in the block beside ``field``, and one of the computer at the top of the page."""
    field.error = None
    with page.show_errors():
        try:
            yield
        except PlushSenseError as refusal:
            field.error = page.words.error(refusal)


def summary(text: str) -> ui.html:
    """Add the heading of a collapsible part of the page, which stays visible when the part is folded."""
    style = "display: list-item; list-style-position: inside; cursor: pointer; font-weight: 600"
    return html(text, "summary").style(style)


MAX_LINES = 40
"""Most lines of a list of notes that a page shows."""


def folded_lines(words: Words, title: str, lines: Sequence[str], name: str = "") -> None:
    """Add a folded list of lines, if there are any; no more than `MAX_LINES` of them are shown."""
    if not lines:
        return
    with tag(ui.element("details").classes("w-full"), name):
        summary(title)
        for line in lines[:MAX_LINES]:
            ui.label(line).classes("ps-break ps-note")
        if len(lines) > MAX_LINES:
            ui.label(words("and {n} more", n=len(lines) - MAX_LINES)).classes("ps-dim")


def verdict(good: bool | None, word: str) -> Markup:
    """Render a verdict as a sign and ``word``, in the colour for ``good``; None means unknown."""
    kind, sign = {True: ("good", "✓"), False: ("bad", "✗"), None: ("none", "–")}[good]
    return Markup('<span class="ps-verdict ps-verdict-{}">{} {}</span>').format(kind, sign, word)


def facts(rows: Sequence[tuple[str, str]]) -> ui.html:
    """Add a list of names and values; skip empty values."""
    line = Markup("<dt>{}</dt><dd>{}</dd>")
    return html(Markup("").join(line.format(*row) for row in rows if row[1]), "dl").classes("ps-facts")


def table_html(
    head: Sequence[str],
    rows: Iterable[Sequence[Any]],
    *,
    caption: str = "",
    numbers: Collection[int] = (),
    row_heads: bool = False,
) -> Markup:
    """Render a table, whose cells are text or Markup.

    Args:
        numbers: indices of the columns to align right.
        row_heads: whether the first cell of each row is a heading.
    """

    def line(cells: Sequence[Any], heads: Collection[int], scope: str) -> Markup:
        parts = []
        for n, cell in enumerate(cells):
            kind = "th" if n in heads else "td"
            attributes = (f' scope="{scope}"' if n in heads else "") + (' class="ps-number"' if n in numbers else "")
            parts.append(Markup(f"<{kind}{attributes}>{{}}</{kind}>").format(cell))
        return Markup("<tr>{}</tr>").format(Markup("").join(parts))

    body = Markup("").join(line(row, (0,) if row_heads else (), "row") for row in rows)
    return Markup('<table class="ps-table">{}<thead>{}</thead><tbody>{}</tbody></table>').format(
        Markup("<caption>{}</caption>").format(caption) if caption else "", line(head, range(len(head)), "col"), body
    )


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> ui.element:
    """Add a table (see `table_html`) with a caption, in a box that scrolls sideways."""
    with scroll_region(caption) as box:
        html(table_html(head, rows, caption=caption, numbers=numbers))
    return box


def link(message: str, to: str) -> Markup:
    """Render a link for a table cell."""
    return Markup('<a class="ps-link" href="{}">{}</a>').format(to, message)


def size(count: int, words: Words | None = None) -> str:
    """Format a number of bytes with a decimal unit."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{words.number(count / factor, 1) if words else format(count / factor, '.1f')} {unit}"
    return f"{count} B"


def title_of(words: Words, job: StudioJob) -> str:
    """Return the title of a job in this visitor's language; ``job.title`` is in that of the person who started it."""
    spec = job.spec
    if job.task not in _TITLES:
        return f"{words(KINDS_OF_TRAINING[job.task])}: {job.title}"
    name = spec.get("name") or Path(spec.get("place") or spec.get("dest") or spec["dataset"]).name
    return words(_TITLES[job.task], name=name)


async def titles(workspace: Workspace) -> dict[str, str]:
    """Return the data sets to choose from; keys are paths, values are names."""

    def found() -> dict[str, str]:
        named = ((path, workspace.title(path)) for path in workspace.datasets())
        return {str(path): title if title == path.name else f"{title} ({path.name})" for path, title in named}

    return await run.io_bound(found) or {}


_VENDOR = Path(__file__).parent / "vendor" / "uplot"


class Plot(Element, component="plot.js"):
    """Plot of curves over x with one y-axis, drawn by uPlot.

    Args:
        label: name for screen readers.
        series: a dictionary for each curve with ``label``, ``stroke`` (a colour), and optionally ``width``, ``dash``,
            ``points`` (by default False), ``fill`` and ``show``.
        x, y: titles of the axes, with units.
        height: height in pixels; the width is that of the surrounding element.
        window_s: length of the visible part of a live plot in seconds, see `push`.
        share: whether the curves are shares, drawn on an axis from 0 to 1.
    """

    def __init__(
        self,
        label: str,
        series: Sequence[dict[str, Any]],
        *,
        x: str = "",
        y: str = "",
        height: int = 240,
        window_s: float = 0.0,
        share: bool = False,
    ) -> None:
        super().__init__()
        self.add_resource(_VENDOR)
        self._props.update(label=label, series=[dict(s) for s in series], xTitle=x, yTitle=y, height=height)
        self._props.update(windowS=window_s, start=None, share=share)
        self.classes("w-full")

    def begin(self, x: Sequence[float], curves: Sequence[Sequence[float | None]]) -> Plot:
        """Set the curves to display when the page opens; call this while building the page."""
        self._props["start"] = [list(x), *map(list, curves)]
        return self

    def show(
        self,
        x: Sequence[float],
        curves: Sequence[Sequence[float | None]],
        series: Sequence[dict[str, Any]] | None = None,
    ) -> None:
        """Replace all curves and, if given, the series; None in a curve is a gap."""
        self.run_method("show", [list(x), *map(list, curves)], series)

    def enlarge(self, on: bool) -> None:
        """Scale a live plot by what it shows, instead of the range of all samples so far."""
        self.run_method("enlarge", on)

    def push(self, x: Sequence[float], curves: Sequence[Sequence[float]]) -> None:
        """Append samples at the right end of a live plot, and drop those that leave its window."""
        self.run_method("push", list(x), [list(c) for c in curves])


# Pictures ---------------------------------------------------------------------------------------------------------

PICTURES = "pictures"
"""Subfolder of the studio's folder for the user's own pictures: ``pictures/<label>.svg`` or ``.png``."""
MAX_PICTURE = 1_000_000
"""Maximum size of the file of a user's own picture, in bytes."""
_MIME_TYPES = {".svg": "image/svg+xml", ".png": "image/png"}


@cache
def _drawings() -> dict[str, Markup]:
    """Return the SVG elements of the drawings by plain label of the gesture; "" is the toy alone."""
    template = Path(__file__).with_name("pictures.svg.j2").read_text(encoding="utf-8")
    module = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(template).module
    return {plain_label(label): drawing for label, drawing in module.drawings.items()}  # type: ignore[attr-defined]


def picture(label: str, name: str = "") -> Markup:
    """Return the drawing of a gesture as SVG, or that of the toy alone if ``label`` is unknown.

    Args:
        name: name for screen readers, by default ``label``.
    """
    drawing = _drawings().get(plain_label(label), _drawings()[""])
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 320 250" role="img" aria-label="{name}"><title>{name}'
        '</title><rect width="320" height="250" rx="16" fill="#fff7ea"/>{drawing}</svg>'
    ).format(name=name or label, drawing=drawing)


def own_picture(home: Path, label: str) -> str:
    """Return the user's own picture of a gesture as a ``data:`` URL for an ``<img>``, or "" if there is none.

    Browsers do not run scripts of an SVG in an ``<img>``. Files larger than `MAX_PICTURE` and links are ignored.
    """
    folder = home / PICTURES
    if not folder.is_dir():
        return ""
    for path in sorted(folder.iterdir()):
        mime_type = _MIME_TYPES.get(path.suffix.lower())
        if mime_type is None or plain_label(path.stem) != plain_label(label) or path.is_symlink() or not path.is_file():
            continue
        if path.stat().st_size <= MAX_PICTURE:
            return f"data:{mime_type};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"
    return ""


# Running jobs -----------------------------------------------------------------------------------------------------


class WorkPanel:
    """Panel of the running jobs of some tasks, with stop buttons, and of the last job if it failed or was stopped.

    Args:
        tasks: the tasks whose jobs are displayed.
        progress_text: function that describes the progress of a running job.
        ended: called when a job succeeds that was started on this page or was running when the page was opened.
        changed: called when a job starts or ends.
    """

    def __init__(
        self,
        page: Page,
        tasks: Sequence[str],
        progress_text: Callable[[StudioJob], str],
        ended: Callable[[StudioJob], Awaitable[None]],
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._page, self._tasks, self._progress_text = page, tasks, progress_text
        self._ended, self._changed = ended, changed
        self._jobs = page.workspace.part(Jobs)
        self._watched = {j.id for j in self._jobs.all(*tasks) if j.state == RUNNING}
        self._closed: set[str] = set()
        self._state: tuple[Any, ...] | None = None
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}
        self._box = page.work = tag(ui.column().classes("ps-work w-full"), "work")
        # Parent element for timers, because the box is cleared.
        self._after = ui.element("div").classes("hidden")
        on_change(self._jobs.changed, self.refresh)
        self.refresh()

    def running(self, *tasks: str) -> bool:
        """Return whether a job of these tasks is running."""
        return any(j.state == RUNNING for j in self._jobs.all(*tasks))

    async def start(self, task: str, spec: dict[str, Any]) -> StudioJob:
        """Start a job."""
        self._closed |= {j.id for j in self._jobs.all(*self._tasks) if j.state != RUNNING}
        title = self._page.words(_TITLES[task], name=Path(spec["place"]).name)
        job = await run.io_bound(lambda: self._jobs.start(task, spec, title))
        assert job is not None
        self._watched.add(job.id)
        self.refresh()
        self._page.show_work()
        return job

    def refresh(self) -> None:
        """Display the current state of the jobs."""
        jobs = self._jobs.all(*self._tasks)
        running = [j for j in jobs if j.state == RUNNING]
        last = next((j for j in jobs if j.state != RUNNING), None)
        if last and (last.state == DONE or last.id in self._closed or time.time() - last.ended_s > _RECENT_S):
            last = None
        state = (tuple(j.id for j in running), last and (last.id, last.state))
        if state != self._state:
            self._state = state
            self._build(running, last)
            self._changed()
        for job in running:
            self._update(job)
        for job in jobs:
            if job.id in self._watched and job.state != RUNNING:
                self._watched.discard(job.id)
                if job.state == DONE:
                    with self._after:
                        ui.timer(0.0, lambda job=job: self._ended(job), once=True)

    def _build(self, running: Sequence[StudioJob], last: StudioJob | None) -> None:
        words = self._page.words
        self._box.clear()
        self._bars = {}
        with self._box:
            for job in running:
                with ui.column().classes("ps-card w-full"):
                    with ui.row().classes("w-full items-center"):
                        text(title_of(words, job), "h2", "col-grow")
                        button("stop", words("Stop"), lambda job=job: self._jobs.stop(job.id), icon="stop")
                    # Not a status element, because screen readers would read out every step.
                    where = ui.label("").classes("ps-dim")
                    bar = ui.linear_progress(0.0, show_value=False, size="12px")
                    named(bar, title_of(words, job))
                    self._bars[job.id] = (bar, tag(where, "where"))
            if last is not None:
                bad = last.state == REFUSED
                stopped = words("Stopped: {title}. Finished parts are kept.", title=title_of(words, last))
                with tag(message_row("error" if bad else "warning"), "ended"):
                    ui.label(words.failure(last.refusal) if bad else stopped).classes("flex-grow ps-break")
                    look = "flat round dense color=inherit"
                    icon_button("close", words("Close this message"), lambda: self._close(last.id), look)

    def _update(self, job: StudioJob) -> None:
        bar, where = self._bars[job.id]
        total = job.progress.get("total") or 0
        bar.set_value(job.progress.get("done", 0) / total if total else 0.0)
        bar.props["indeterminate"] = not total
        where.set_text(self._progress_text(job))

    def _close(self, identity: str) -> None:
        self._closed.add(identity)
        self.refresh()
