"""Train: choose data and what to do, watch it, and compare what came out."""

from __future__ import annotations

from pathlib import Path

from nicegui import context, run, ui

from plushsense.apps.studio.jobs import Jobs
from plushsense.apps.studio.pages.train_form import Form
from plushsense.apps.studio.pages.train_results import ResultsView
from plushsense.apps.studio.pages.train_work import Work
from plushsense.apps.studio.results import Results
from plushsense.apps.studio.shell import Page, on_ring

_CSS = Path(__file__).parents[1] / "train.css"
# So often what runs is drawn anew at most.
_DRAWN_S = 0.4


async def show(page: Page) -> None:
    """Build the page."""
    ui.add_head_html(f"<style>{_CSS.read_text(encoding='utf-8')}</style>")
    jobs, results = page.house.part(Jobs), page.house.part(Results)
    ui.label(page.words("train.intro")).classes("ps-dim")
    rows = await run.io_bound(results.rows)
    form = Form(page, jobs, results)
    work = Work(page, jobs, lambda identity: shown.open(identity))
    shown = ResultsView(page, results, rows or [])
    context.client.on_delete(form.close)

    rung = False

    def ring() -> None:
        nonlocal rung
        rung = True

    async def draw() -> None:
        nonlocal rung
        if not rung:
            return
        rung = False
        form.refresh()
        if work.refresh():
            await shown.reload()

    on_ring(jobs.bell, ring)
    ui.timer(_DRAWN_S, draw)
    await form.read()
