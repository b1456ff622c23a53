"""The jobs of the train page: cards with progress and curves, and a list of earlier jobs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from nicegui import ui

from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, STOPPED, Jobs, StudioJob
from plushsense.studio.app.shell import LINES, Page, html, named, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.train.requests import EVALUATE, KINDS, SEARCH, SWEEP, TRAIN
from plushsense.studio.pages.train.results import (
    averaged_over,
    duration_text,
    figure,
    over_trainings,
    score_labels,
    score_text,
)
from plushsense.studio.widgets.plot import Plot

LOSS, ACCURACY, BEST = "loss", "accuracy", "best"


class ProgressChart(NamedTuple):
    """Data of one progress plot: ``x`` and one line for each of ``names``; None is a gap."""

    what: str
    names: tuple[str, ...]
    x: list[float]
    lines: list[list[float | None]]


def progress_charts(job: StudioJob) -> list[ProgressChart]:
    """Return the plots of a job: always the same ones for a task, empty at first."""
    if job.task == "train":
        return _of_one(job.reports)
    if job.task == "evaluate":
        return [_by_fold(job.reports, LOSS, "train_loss"), _by_fold(job.reports, ACCURACY, "validation_accuracy")]
    return [_best(job)]


def _of_one(reports: Sequence[dict[str, Any]]) -> list[ProgressChart]:
    rows = {r["epoch"]: r for r in reports if r.get("stage") == "training" and r.get("epoch")}
    x = [float(epoch) for epoch in sorted(rows)]
    return [
        ProgressChart(
            what,
            ("training", "held_back"),
            x,
            [[rows[int(e)].get(f"{part}_{what}") for e in x] for part in ("train", "validation")],
        )
        for what in (LOSS, ACCURACY)
    ]


def _by_fold(reports: Sequence[dict[str, Any]], what: str, key: str) -> ProgressChart:
    folds: dict[str, dict[int, float | None]] = {}
    for r in reports:
        if r.get("epoch") and r.get(key) is not None:
            folds.setdefault(r["fold"], {})[r["epoch"]] = r[key]
    epochs = sorted({epoch for rows in folds.values() for epoch in rows})
    return ProgressChart(
        what, tuple(folds), [float(e) for e in epochs], [[rows.get(e) for e in epochs] for rows in folds.values()]
    )


def _best(job: StudioJob) -> ProgressChart:
    """Return the best score over the finished trainings; of a search, after each rung."""
    found: dict[float, float] = {}
    score = "accuracy" if job.task == "sweep" else "macro_f1"
    before = 0
    last = (0, 0)
    for r in job.reports:
        if r.get("best") is None:
            continue
        rung = r.get("rung", 1)
        if rung != last[0]:
            before, last = before + last[1], (rung, 0)
        last = (rung, max(last[1], r.get("done", 0)))
        found[float(before + r.get("done", 0))] = r["best"][score]
    x = sorted(found)
    return ProgressChart(BEST, (score,), x, [[found[at] for at in x]])


_LISTED = 30
_ON = {"validation-subjects": "on_people", "validation-recordings": "on_recordings", "windows:holdout": "on_windows"}
_BADGES = {RUNNING: "#3a6ea5", DONE: "#00805c", REFUSED: "#b84a00", STOPPED: "#6b6b6b"}


class JobsSection:
    """The section with cards of running and opened jobs, and a list of the others."""

    def __init__(self, page: Page, jobs: Jobs, opened: Callable[[str], Any]) -> None:
        self._page, self._jobs, self._words, self.opened = page, jobs, page.words, opened
        self._open: set[str] = set()
        self._closed: set[str] = set()
        self._cards: dict[str, _Card] = {}
        self._built: Any = None
        self._done: set[str] = set()
        with (
            ui.element("section")
            .classes("w-full column no-wrap ps-tight")
            .props(f'aria-label="{self._words("train.work")}"')
        ):
            ui.label(self._words("train.work")).classes("text-lg").props('role="heading" aria-level="2"')
            self._place = ui.column().classes("w-full")
        newest = next(iter(self._all()), None)
        if newest is not None:
            self._open.add(newest.id)
        self.refresh()

    def _all(self) -> list[StudioJob]:
        return [job for job in self._jobs.all(*KINDS) if not job.spec.get("dry")]

    def refresh(self) -> bool:
        """Update the section, and return whether a job finished since the last call."""
        jobs = self._all()
        running = {job.id for job in jobs if job.state == RUNNING}
        self._open |= running - self._closed
        visible = [job for job in jobs if job.id in self._open]
        rest = [job for job in jobs if job.id not in self._open][:_LISTED]
        now = ([(job.id, job.state) for job in visible], [(job.id, job.state) for job in rest])
        if now != self._built:
            self._built = now
            self._build(visible, rest)
        else:
            for card in self._cards.values():
                card.update()
        done = {job.id for job in jobs if job.state == DONE}
        fresh, self._done = bool(done - self._done), done
        return fresh

    def _build(self, visible: list[StudioJob], rest: list[StudioJob]) -> None:
        self._place.clear()
        self._cards = {}
        w = self._words
        with self._place:
            if not visible and not rest:
                ui.label(w("train.no_work")).classes("ps-dim")
            for job in visible:
                self._cards[job.id] = _Card(self, job)
            if rest:
                with ui.expansion(w("train.earlier"), icon="history").classes("w-full") as earlier:
                    tag(earlier, "earlier")
                    for job in rest:
                        self._line(job)

    def _line(self, job: StudioJob) -> None:
        w = self._words
        with ui.row().classes("w-full items-center"):
            _badge(w, job.state)
            ui.label(f"{w(f'train.kinds.{job.task}')}: {job.title}").classes("flex-grow")
            ui.label(_when(job.begun_s)).classes("ps-dim")
            show = ui.button(w("train.show"), on_click=lambda: self.open(job.id)).props("flat dense no-caps")
            named(show, f"{w('train.show')}: {job.title}")

    def open(self, identity: str) -> None:
        """Display the card of a job."""
        self._open.add(identity)
        self._closed.discard(identity)
        self.refresh()

    def close(self, identity: str) -> None:
        """Move a job from its card to the list."""
        self._open.discard(identity)
        self._closed.add(identity)
        self.refresh()

    def stop(self, identity: str) -> None:
        """Stop a job; it can be resumed."""
        self._jobs.stop(identity)

    def resume(self, identity: str) -> None:
        """Resume a job."""
        with self._page.show_errors():
            self._jobs.resume(identity)
        self.refresh()


class _Card:
    """The card of one job."""

    def __init__(self, work: JobsSection, job: StudioJob) -> None:
        self._work, self._job, self._words = work, job, work._words
        w = self._words
        self._plots: list[tuple[str, Plot, tuple[str, ...]]] = []
        self._bar: ui.linear_progress | None = None
        self._text: ui.label | None = None
        self._warned = -1
        with tag(ui.element("article").classes("ps-card w-full column no-wrap ps-tight"), "job") as box:
            named(box.props(f'data-job="{job.id}" data-state="{job.state}"'), job.title)
            with ui.row().classes("w-full items-center"):
                tag(_badge(w, job.state), "state")
                ui.label(f"{w(f'train.kinds.{job.task}')}: {job.title}").classes("text-weight-bold")
                ui.space()
                ui.label(_when(job.begun_s)).classes("ps-dim")
            if job.state == RUNNING:
                self._bar = ui.linear_progress(0.0, show_value=False, size="14px").classes("w-full")
                named(self._bar.props("instant-feedback"), w("train.progress", title=job.title))
                tag(self._bar, "progress")
                self._text = tag(ui.label(), "at")
            elif job.state == STOPPED:
                ui.label(w("train.stopped_told"))
            elif job.state == REFUSED:
                with ui.element("div").classes("ps-said ps-said-error w-full").props('role="alert"'):
                    tag(ui.label(job.message), "refused")
            else:
                self._result()
            found = progress_charts(job)
            if job.state == RUNNING or any(len(chart.x) > 1 for chart in found):
                with ui.row().classes("w-full"):
                    for chart in found:
                        with ui.column().classes("col-12 col-md"):
                            self._plot(chart)
            self._warnings = ui.column().classes("w-full")
            self._buttons()
        self.update()

    def _plot(self, chart: ProgressChart) -> None:
        w = self._words
        title = w(f"train.{chart.what}") if chart.what != BEST else w("train.best")
        unit = {LOSS: "", ACCURACY: " (0–1)", BEST: " (0–1)"}[chart.what]
        x = w("train.trainings") if chart.what == BEST else w("train.epoch")
        drawn = self._lines(chart)
        plot = Plot(f"{title}: {self._job.title}", drawn, x=x, y=title + unit, height=220)
        tag(plot, f"curve-{chart.what}").begin(chart.x, chart.lines)
        self._plots.append((chart.what, plot, chart.names))

    def _lines(self, chart: ProgressChart) -> list[dict[str, Any]]:
        words = {name: self._words(f"train.lines.{name}") for name in ("training", "held_back", "accuracy", "macro_f1")}
        return [
            {
                "label": words.get(name, name),
                "stroke": LINES[i % len(LINES)],
                "width": 2,
                "points": len(chart.x) < 3,
                **({"dash": [6, 4]} if i % 2 else {}),
            }
            for i, name in enumerate(chart.names)
        ]

    def update(self) -> None:
        """Update progress, plots and warnings of a running job."""
        job, w = self._job, self._words
        if self._bar is not None and self._text is not None:
            at = job.progress
            self._bar.set_value(min(1.0, float(at.get("share") or 0.0)))
            text = _standing(w, at)
            if self._text.text != text:
                self._text.set_text(text)
            found = {chart.what: chart for chart in progress_charts(job)}
            for i, (what, plot, names) in enumerate(self._plots):
                chart = found[what]
                # The first epochs are dots; a new fold adds a line.
                form = (*chart.names, str(len(chart.x) < 3))
                plot.show(chart.x, chart.lines, series=self._lines(chart) if form != names else None)
                self._plots[i] = (what, plot, form)
        if len(job.warnings) != self._warned:
            self._warned = len(job.warnings)
            self._warnings.clear()
            if job.warnings:
                with self._warnings, ui.expansion(w("train.warnings", n=len(job.warnings)), icon="info") as more:
                    tag(more.classes("w-full"), "warnings")
                    for sentence in dict.fromkeys(job.warnings):
                        ui.label(f"• {sentence}")

    def _buttons(self) -> None:
        job, w = self._job, self._words
        with ui.row():
            if job.state == RUNNING:
                stop = ui.button(w("train.stop"), icon="stop", on_click=lambda: self._work.stop(job.id))
                tag(stop.props("outline no-caps"), "stop")
            else:
                if job.state in (STOPPED, REFUSED):
                    resume = ui.button(w("train.resume"), icon="play_arrow", on_click=lambda: self._work.resume(job.id))
                    tag(resume.props("outline no-caps"), "resume")
                hide = ui.button(w("train.hide"), on_click=lambda: self._work.close(job.id)).props("flat no-caps")
                named(hide, f"{w('train.hide')}: {job.title}")

    def _result(self) -> None:
        job, r, w = self._job, self._job.result, self._words
        row = ui.row().classes("w-full items-center")
        scored = r["scores"] if job.task == TRAIN else r
        with row:
            if scored["leaky"] or scored["simulated"]:
                html(score_labels(w, scored["leaky"], scored["simulated"]))
            tag(ui.label(result_text(w, job)), "result")
        with ui.row():
            if job.task == TRAIN:
                path = quote(r["bundle"], safe="")
                tag(ui.link(w("train.to_live"), f"/live?model={path}").classes("ps-link"), "to-live")
                tag(ui.link(w("train.to_export"), f"/export?model={path}").classes("ps-link"), "to-export")
            identity = r["bundle"] if job.task == TRAIN else r["out"]
            if job.task == SWEEP and r["best"]:
                identity += f"#{r['best'][0]['trial']}"
            if job.task == SEARCH:
                identity += f"#{r['winner']['trial']}"
            show = ui.button(w("train.open_result"), on_click=lambda: self._work.opened(identity))
            tag(show.props("flat dense no-caps"), "open-result")


def result_text(w: Words, job: StudioJob) -> str:
    """Summarise the result of a job, with the data that it was scored on."""
    r = job.result
    if job.task == TRAIN:
        s = r["scores"]
        return w(
            "train.result_train",
            name=Path(r["bundle"]).stem,
            accuracy=figure(s["accuracy"]),
            macro_f1=figure(s["macro_f1"]),
            windows=s["windows"],
            on=w(f"train.{_ON.get(s['split'], 'on_windows')}"),
            seed=job.spec.get("settings", {}).get("seed", 0),
            epochs=r["epochs"],
        )
    where = {"split": r["split"], "context": r["context"]}
    if job.task == EVALUATE:
        return w(
            "train.result_evaluate",
            accuracy=score_text(r["accuracy"]["mean"], r["accuracy"]["sd"]),
            macro_f1=score_text(r["macro_f1"]["mean"], r["macro_f1"]["sd"]),
            over=averaged_over(w, r["over"], r["units"]),
            seeds=", ".join(map(str, r["seeds"])),
            **where,
        )
    best = (r["best"] or [None])[0] if job.task == SWEEP else r["winner"]
    if best is None:
        return w("train.at_trainings", done=r["done"], trainings=r["trials"])
    found = {"arch": best["arch"], "filters": best["filters"], "parameters": f"{best['parameters']:,}"}
    found |= {"accuracy": score_text(best["accuracy"], best.get("accuracy_sd"))}
    found |= {"macro_f1": score_text(best["macro_f1"], best.get("macro_f1_sd"))}
    found |= {"over": averaged_over(w, *over_trainings(best))}
    counts = {"done": r.get("done"), "trials": r.get("trials", r.get("candidates"))}
    return w(f"train.result_{job.task}", **found, **counts, **where)


def _standing(w: Words, at: dict[str, Any]) -> str:
    """Describe the progress of a job in words."""
    message = [w(f"train.stages.{at.get('stage', 'reading')}")]
    if "rung" in at:
        message.append(w("train.at_rung", **{key: at[key] for key in ("rung", "rungs", "networks")}))
    if "folds" in at:
        message.append(w("train.at_folds", done=at["done"], folds=at["folds"]))
    if "trainings" in at:
        message.append(w("train.at_trainings", done=at["done"], trainings=at["trainings"]))
    if at.get("resumed"):
        message.append(w("train.resumed", n=at["resumed"]))
    if at.get("epoch") and "folds" not in at and "trainings" not in at:
        message.append(w("train.at_epoch", epoch=at["epoch"], epochs=at["epochs"]))
    if at.get("left_s") is not None:
        message.append(w("train.left", time=duration_text(w, at["left_s"])))
    return " · ".join(message)


def _badge(w: Words, state: str) -> ui.label:
    badge = ui.label(w(f"train.states.{state}")).classes("q-px-sm rounded-borders")
    return badge.style(f"background: {_BADGES[state]}; color: #fff; font-weight: 600")


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds)) if seconds else ""
