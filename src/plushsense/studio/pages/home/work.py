"""Section of the home page that shows running and earlier work."""

from __future__ import annotations

import time
from typing import Any

from nicegui import ui

from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, STOPPED, Jobs, StudioJob
from plushsense.studio.app.shell import Page, address, named, tag
from plushsense.studio.pages.home.data import SMALL, findings, section

PAGE_OF = {
    "check": "review",
    "import": "review",
    "simulate": "review",
    "train": "train",
    "sweep": "train",
    "search": "train",
    "evaluate": "train",
    "export": "export",
    "verify": "export",
    "publish": "publish",
}
_SIGNS = {RUNNING: "▶", DONE: "✓", REFUSED: "✕", STOPPED: "■"}
_EARLIER = 6
_LINES = 40


class WorkSection:
    """Section of running and earlier work; rows change in place, so that a focused button keeps the focus."""

    def __init__(self, page: Page, jobs: Jobs) -> None:
        self._page, self._jobs = page, jobs
        self._displayed: tuple[Any, ...] | None = None
        self._progress_bars: dict[str, tuple[ui.label, ui.linear_progress]] = {}
        with section(page, "home.work", "work"):
            self._rows = ui.column().classes("w-full ps-tight")
        self.update()

    def update(self) -> None:
        """Show how the work stands now."""
        running = self._jobs.all()
        earlier = [j for j in running if j.state != RUNNING][:_EARLIER]
        running = [j for j in running if j.state == RUNNING]
        current = tuple((j.id, j.state) for j in (*running, *earlier))
        if current != self._displayed:
            self._displayed = current
            self._rows.clear()
            self._progress_bars.clear()
            with self._rows:
                if not current:
                    ui.label(self._page.words("home.no_work")).classes("ps-dim")
                for job in (*running, *earlier):
                    with tag(ui.column().classes("ps-row w-full ps-tight"), f"job-{job.state}"):
                        self._row(job)
        for job in running:
            label, bar = self._progress_bars[job.id]
            text, share = self._progress(job)
            label.set_text(text)
            bar.set_value(share or 0.0)
            bar.set_visibility(share is not None)

    def _row(self, job: StudioJob) -> None:
        words = self._page.words
        state = words(f"home.{job.state}")
        when = time.strftime("%Y-%m-%d %H:%M", time.localtime(job.ended_s or job.begun_s))
        ui.label(f"{_SIGNS[job.state]} {job.title}").classes("text-weight-bold ps-break")
        if job.state == RUNNING:
            label = tag(ui.label(), "job-progress")
            bar = ui.linear_progress(0.0, show_value=False, size="10px").props("rounded")
            self._progress_bars[job.id] = (label, named(bar, job.title))
        else:
            ui.label(f"{state} · {when}").classes("ps-dim")
        if job.state == REFUSED:
            ui.label(job.message).classes("ps-bad ps-break")
        if job.state == DONE:
            self._result(job)
        with ui.row().classes("items-center ps-tight"):
            if job.state == DONE:
                query = {"dataset": str(job.result.get("dataset") or "")}
                name = words(f"pages.{PAGE_OF.get(job.task, 'home')}")
                link = ui.link(name, address(PAGE_OF.get(job.task, "home"), **query)).classes("ps-link")
                named(link, f"{name}: {job.title}")
            if job.state == RUNNING:
                self._button("stop", job, lambda: self._jobs.stop(job.id))
                return
            if job.state == STOPPED and not job.spec.get("archive"):
                self._button("again", job, lambda: self._jobs.resume(job.id))
            self._button("drop", job, lambda: self._jobs.drop(job.id))

    def _button(self, key: str, job: StudioJob, do: Any) -> None:
        def clicked() -> None:
            with self._page.show_errors():
                do()

        label = self._page.words(f"home.{key}")
        button = ui.button(label, on_click=clicked).props(SMALL)
        tag(named(button, f"{label}: {job.title}"), f"job-{key}")

    def _progress(self, job: StudioJob) -> tuple[str, float | None]:
        """Return the progress as text, and as a share if it is known."""
        words = self._page.words
        passed = max(0.0, time.time() - job.begun_s)
        minutes, seconds = divmod(int(passed), 60)
        text = f"{words('home.running')} · {minutes}:{seconds:02d}"
        done, total = job.progress.get("done"), job.progress.get("total")
        if isinstance(done, int | float) and isinstance(total, int | float) and total > 0:
            return f"{text} · {done:g} / {total:g}", min(1.0, done / total)
        return text, None

    def _result(self, job: StudioJob) -> None:
        page, words, result = self._page, self._page.words, job.result
        if job.task == "check":
            ui.label(findings(page, result))
        if job.task in ("import", "simulate"):
            people = result.get("subjects", result.get("people", 0))
            facts = [words("home.recordings", n=result["recordings"]), words("home.people", n=people)]
            if job.spec.get("add"):
                facts.append(words("home.new", n=result["added"]["recordings"]))
            ui.label(" · ".join(facts))
        lines = [str(w) for w in (*job.warnings, *result.get("warnings", ()))]
        rejected = [f"{r['file']}: {r['reason']}" for r in result.get("rejected", ())]
        for key, text in (("warnings", lines), ("rejected", rejected)):
            if text:
                with ui.expansion(words(f"home.{key}", n=len(text))).classes("w-full").props("dense"):
                    for line in text[:_LINES]:
                        ui.label(line).classes("ps-break ps-note")
                    if len(text) > _LINES:
                        ui.label(words("home.more", n=len(text) - _LINES)).classes("ps-dim")
