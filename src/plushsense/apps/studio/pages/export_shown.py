"""What the export and publish pages are built of: facts, tables, verdicts, and the work that runs for them."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.apps.studio.house import House
from plushsense.apps.studio.jobs import DONE, REFUSED, RUNNING, Job, Jobs
from plushsense.apps.studio.shell import Page, named, on_ring, tag
from plushsense.apps.studio.words import Words

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
    """Once a page."""
    ui.add_css(_STYLE)


def scroll_to(name: str) -> None:
    """Bring what is tagged so into view."""
    ui.run_javascript(f"document.querySelector('[data-test=\"{name}\"]')?.scrollIntoView()")


def text(said: str, kind: str = "p", classes: str = "") -> ui.html:
    """Plain text as an element of HTML."""
    return ui.html(escape(said), sanitize=False, tag=kind).classes(classes)


def verdict(good: bool | None, word: str) -> str:
    """A verdict as sign, word and colour, HTML; None: nobody knows."""
    kind, sign = {True: ("good", "✓"), False: ("bad", "✗"), None: ("none", "–")}[good]
    return f'<span class="ps-verdict ps-verdict-{kind}">{sign} {escape(word)}</span>'


def facts(rows: Sequence[tuple[str, str]]) -> ui.html:
    """What something is, a name and a value a line; empty values are left out."""
    lines = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows if value)
    return ui.html(lines, sanitize=False, tag="dl").classes("ps-facts")


class Cell(str):
    """A cell of `table` that is HTML already."""


def table(caption: str, head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = ()) -> ui.element:
    """A table for eyes and screen readers; ``numbers`` are the columns that stand on the right."""

    def cells(row: Sequence[str], kind: str) -> str:
        made = []
        for n, value in enumerate(row):
            inner = value if isinstance(value, Cell) else escape(value)
            side = ' class="ps-number"' if n in numbers else ""
            scope = ' scope="col"' if kind == "th" else ""
            made.append(f"<{kind}{side}{scope}>{inner}</{kind}>")
        return f"<tr>{''.join(made)}</tr>"

    body = "".join(cells(row, "td") for row in rows)
    inner = f"<caption>{escape(caption)}</caption><thead>{cells(head, 'th')}</thead><tbody>{body}</tbody>"
    # What scrolls sideways must be reachable by keyboard.
    with named(ui.element("div").classes("ps-sideways").props('tabindex="0" role="region"'), caption) as box:
        ui.html(inner, sanitize=False, tag="table").classes("ps-table")
    return box


def link(said: str, to: str) -> Cell:
    """A link as a cell."""
    return Cell(f'<a class="ps-link" href="{escape(to)}">{escape(said)}</a>')


def moment(seconds: float) -> str:
    """A moment in this computer's time."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def size(count: int) -> str:
    """Bytes for people."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"


def title_of(words: Words, job: Job) -> str:
    """What a job does, in the language of whoever looks, which need not be that of who began it."""
    return words(_TITLES[job.task], name=Path(job.spec["place"]).name)


async def titles(house: House) -> dict[str, str]:
    """The data sets to choose from: path to name."""
    return await run.io_bound(lambda: {str(p): f"{house.title(p)} ({p.name})" for p in house.datasets()}) or {}


class WorkShown:
    """The running work of some tasks with its progress and a button that stops it, and how the last one ended.

    Args:
        tasks: whose work.
        said: where a running job stands, in words.
        ended: called in the page when work that was begun here, or was running when the page was opened, is done.
        changed: called in the page when work began or ended, as for buttons.
    """

    def __init__(
        self,
        page: Page,
        tasks: Sequence[str],
        said: Callable[[Job], str],
        ended: Callable[[Job], Awaitable[None]],
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self._page, self._tasks, self._said, self._ended, self._changed = page, tasks, said, ended, changed
        self._jobs = page.house.part(Jobs)
        self._watched = {j.id for j in self._jobs.all(*tasks) if j.state == RUNNING}
        self._closed: set[str] = set()
        self._shown: tuple[Any, ...] | None = None
        self._bars: dict[str, tuple[ui.linear_progress, ui.label]] = {}
        self._box = tag(ui.column().classes("ps-work w-full"), "work")
        # Whose children are not cleared with the box.
        self._after = ui.element("div").classes("hidden")
        on_ring(self._jobs.bell, self.refresh)
        self.refresh()

    def running(self, *tasks: str) -> bool:
        """Whether work of these tasks runs."""
        return any(j.state == RUNNING for j in self._jobs.all(*tasks))

    async def start(self, task: str, spec: dict[str, Any]) -> Job:
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
        shown = (tuple(j.id for j in running), last and (last.id, last.state))
        if shown != self._shown:
            self._shown = shown
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

    def _build(self, running: Sequence[Job], last: Job | None) -> None:
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
                said = last.said if bad else words("export.stopped", title=title_of(words, last))
                row = ui.row().classes(f"ps-said ps-said-{'error' if bad else 'warning'} w-full items-center no-wrap")
                with tag(row.props(f'role="{"alert" if bad else "status"}"'), "ended"):
                    ui.label(said).classes("flex-grow").style("overflow-wrap: anywhere")
                    gone = ui.button(icon="close", on_click=lambda: self._close(last.id))
                    gone.props(f'flat round dense color=inherit aria-label="{words("shell.close")}"')

    def _move(self, job: Job) -> None:
        bar, where = self._bars[job.id]
        total = job.progress.get("total") or 0
        bar.set_value(job.progress.get("done", 0) / total if total else 0.0)
        if bar.props.get("indeterminate", False) != (not total):
            bar.props(add="indeterminate") if not total else bar.props(remove="indeterminate")
        where.set_text(self._said(job))

    def _close(self, identity: str) -> None:
        self._closed.add(identity)
        self.refresh()

    def _stop(self, job: Job) -> None:
        self._jobs.stop(job.id)
