"""Elements of the export and publish pages: facts, tables, verdicts, and the panel of running work."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, html, named, on_change, tag
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import Workspace

_STYLE = """
.ps-main h3 { font-size: 1.05rem; line-height: 1.5rem; font-weight: 600; margin: 8px 0 0 0; }
.ps-facts { display: grid; grid-template-columns: minmax(9rem, max-content) 1fr; gap: 2px 16px; margin: 0; }
.ps-facts dt { color: var(--ps-dim); } .ps-facts dd { margin: 0; overflow-wrap: anywhere; }
.ps-table { border-collapse: collapse; }
.ps-table caption { text-align: left; color: var(--ps-dim); padding-bottom: 4px; }
.ps-table th, .ps-table td { text-align: left; padding: 4px 12px 4px 0; border-bottom: 1px solid var(--ps-line);
  vertical-align: top; overflow-wrap: break-word; }
.ps-table th { font-weight: 600; } .ps-table .ps-number { text-align: right; font-variant-numeric: tabular-nums; }
.ps-verdict { border-radius: 6px; padding: 1px 8px; font-weight: 600; white-space: nowrap; }
.ps-verdict-good { background: #dff3ea; color: #0b3d2c; } .ps-verdict-bad { background: #fbe3da; color: #5c1d00; }
.ps-verdict-none { background: #e3e6eb; color: #2b2f36; }
.ps-steps { margin: 0; padding-left: 1.4rem; list-style: decimal; } .ps-steps li { margin-bottom: 4px; }
.ps-work { position: sticky; top: 84px; z-index: 10; background: #fff; }
body.body--dark .ps-work { background: #121212; }
@media (max-width: 1023px) { .ps-work { top: 140px; } }
[data-test] { scroll-margin-top: 100px; }
"""
_RECENT_S = 900.0
_TITLES = {
    "export": "export.doing",
    "profile": "export.counting",
    "verify": "export.verifying",
    "publish": "publish.doing",
    "validate": "publish.checking",
    "pseudonymise": "publish.renaming",
}


def style() -> None:
    """Add the style sheet; call it once a page."""
    ui.add_css(_STYLE)


def scroll_to(name: str) -> None:
    """Bring what is tagged so into view."""
    ui.run_javascript(f"document.querySelector('[data-test=\"{name}\"]')?.scrollIntoView()")


def text(message: str, kind: str = "p", classes: str = "") -> ui.html:
    """Add plain text as an HTML element."""
    return html(message, kind).classes(classes)


def verdict(good: bool | None, word: str) -> Markup:
    """Return a verdict as sign, word and colour; None: unknown."""
    kind, sign = {True: ("good", "✓"), False: ("bad", "✗"), None: ("none", "–")}[good]
    return Markup('<span class="ps-verdict ps-verdict-{}">{} {}</span>').format(kind, sign, word)


def facts(rows: Sequence[tuple[str, str]]) -> ui.html:
    """Add a list of names and values; empty values are left out."""
    line = Markup("<dt>{}</dt><dd>{}</dd>")
    return html(Markup("").join(line.format(*row) for row in rows if row[1]), "dl").classes("ps-facts")


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> ui.element:
    """Add a table with a caption, its cells text or Markup; columns in ``numbers`` are aligned right."""

    def cells(row: Sequence[str], kind: str) -> Markup:
        html_cells = []
        for n, value in enumerate(row):
            side = ' class="ps-number"' if n in numbers else ""
            scope = ' scope="col"' if kind == "th" else ""
            html_cells.append(Markup(f"<{kind}{side}{scope}>{{}}</{kind}>").format(value))
        return Markup("<tr>{}</tr>").format(Markup("").join(html_cells))

    body = Markup("").join(cells(row, "td") for row in rows)
    whole = Markup("<caption>{}</caption><thead>{}</thead><tbody>{}</tbody>").format(caption, cells(head, "th"), body)
    # What scrolls sideways must be reachable by keyboard.
    with named(ui.element("div").classes("ps-sideways").props('tabindex="0" role="region"'), caption) as box:
        html(whole, "table").classes("ps-table")
    return box


def link(message: str, to: str) -> Markup:
    """Return a link for a table cell."""
    return Markup('<a class="ps-link" href="{}">{}</a>').format(to, message)


def moment(seconds: float) -> str:
    """Format a time in this computer's time zone."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def size(count: int) -> str:
    """Format a number of bytes."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def title_of(words: Words, job: StudioJob) -> str:
    """Return a job's title in this visitor's language, not in that of who started it."""
    return words(_TITLES[job.task], name=Path(job.spec["place"]).name)


async def titles(workspace: Workspace) -> dict[str, str]:
    """Return the data sets to choose from: path to name."""
    return await run.io_bound(lambda: {str(p): f"{workspace.title(p)} ({p.name})" for p in workspace.datasets()}) or {}


class WorkPanel:
    """The running work of some tasks with its progress and a button that stops it, and how the last one ended.

    Args:
        tasks: whose work.
        progress_text: returns the progress of a running job as text.
        ended: called in the page when work that was begun here, or was running when the page was opened, is done.
        changed: called in the page when work began or ended, as for buttons.
    """

    def __init__(
        self,
        page: Page,
        tasks: Sequence[str],
        progress_text: Callable[[StudioJob], str],
        ended: Callable[[StudioJob], Awaitable[None]],
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._page, self._tasks, self._progress_text, self._ended, self._changed = (
            page,
            tasks,
            progress_text,
            ended,
            changed,
        )
        self._jobs = page.workspace.part(Jobs)
        self._watched = {j.id for j in self._jobs.all(*tasks) if j.state == RUNNING}
        self._closed: set[str] = set()
        self._state: tuple[Any, ...] | None = None
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}
        self._box = tag(ui.column().classes("ps-work w-full"), "work")
        # Whose children are not cleared with the box.
        self._after = ui.element("div").classes("hidden")
        on_change(self._jobs.changed, self.refresh)
        self.refresh()

    def running(self, *tasks: str) -> bool:
        """Return whether a job of these tasks is running."""
        return any(j.state == RUNNING for j in self._jobs.all(*tasks))

    async def start(self, task: str, spec: dict[str, Any]) -> StudioJob:
        """Begin work."""
        self._closed |= {j.id for j in self._jobs.all(*self._tasks) if j.state != RUNNING}
        title = self._page.words(_TITLES[task], name=Path(spec["place"]).name)
        job = await run.io_bound(lambda: self._jobs.start(task, spec, title))
        assert job is not None
        self._watched.add(job.id)
        self.refresh()
        return job

    def refresh(self) -> None:
        """Show how things stand."""
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
            self._move(job)
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
                        stop = ui.button(words("export.stop"), icon="stop", on_click=lambda job=job: self._stop(job))
                        tag(stop.props("outline no-caps"), "stop")
                    # Not read out at every step.
                    where = ui.label("").classes("ps-dim")
                    bar = ui.linear_progress(0.0, show_value=False, size="12px")
                    named(bar, title_of(words, job))
                    self._bars[job.id] = (bar, tag(where, "where"))
            if last is not None:
                bad = last.state == REFUSED
                message = last.message if bad else words("export.stopped", title=title_of(words, last))
                row = ui.row().classes(f"ps-said ps-said-{'error' if bad else 'warning'} w-full items-center no-wrap")
                with tag(row.props(f'role="{"alert" if bad else "status"}"'), "ended"):
                    ui.label(message).classes("flex-grow").style("overflow-wrap: anywhere")
                    gone = ui.button(icon="close", on_click=lambda: self._close(last.id))
                    gone.props(f'flat round dense color=inherit aria-label="{words("shell.close")}"')

    def _move(self, job: StudioJob) -> None:
        bar, where = self._bars[job.id]
        total = job.progress.get("total") or 0
        bar.set_value(job.progress.get("done", 0) / total if total else 0.0)
        if bar.props.get("indeterminate", False) != (not total):
            bar.props(add="indeterminate") if not total else bar.props(remove="indeterminate")
        where.set_text(self._progress_text(job))

    def _close(self, identity: str) -> None:
        self._closed.add(identity)
        self.refresh()

    def _stop(self, job: StudioJob) -> None:
        self._jobs.stop(job.id)
