"""The train page's work: what runs, with its curves, and what ran."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import ui

from plushsense.apps.studio.curves import ACCURACY, BEST, LOSS, Chart, charts
from plushsense.apps.studio.jobs import DONE, REFUSED, RUNNING, STOPPED, Job, Jobs
from plushsense.apps.studio.orders import EVALUATE, KINDS, SEARCH, SWEEP, TRAIN
from plushsense.apps.studio.pages.train_words import figure, lasting, marks, over, spread
from plushsense.apps.studio.plot import Plot
from plushsense.apps.studio.result_rows import over_trainings
from plushsense.apps.studio.shell import LINES, Page, named, tag
from plushsense.apps.studio.words import Words

_LISTED = 30
_ON = {"validation-subjects": "on_people", "validation-recordings": "on_recordings", "windows:holdout": "on_windows"}
_BADGES = {RUNNING: "#3a6ea5", DONE: "#00805c", REFUSED: "#b84a00", STOPPED: "#6b6b6b"}


class Work:
    """Cards of what runs (and of what somebody opened), and a list of the rest."""

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

    def _all(self) -> list[Job]:
        return [job for job in self._jobs.all(*KINDS) if not job.spec.get("dry")]

    def refresh(self) -> bool:
        """Show how it stands; whether something was finished since."""
        jobs = self._all()
        running = {job.id for job in jobs if job.state == RUNNING}
        self._open |= running - self._closed
        shown = [job for job in jobs if job.id in self._open]
        rest = [job for job in jobs if job.id not in self._open][:_LISTED]
        now = ([(job.id, job.state) for job in shown], [(job.id, job.state) for job in rest])
        if now != self._built:
            self._built = now
            self._build(shown, rest)
        else:
            for card in self._cards.values():
                card.update()
        done = {job.id for job in jobs if job.state == DONE}
        fresh, self._done = bool(done - self._done), done
        return fresh

    def _build(self, shown: list[Job], rest: list[Job]) -> None:
        self._place.clear()
        self._cards = {}
        w = self._words
        with self._place:
            if not shown and not rest:
                ui.label(w("train.no_work")).classes("ps-dim")
            for job in shown:
                self._cards[job.id] = _Card(self, job)
            if rest:
                with ui.expansion(w("train.earlier"), icon="history").classes("w-full") as earlier:
                    tag(earlier, "earlier")
                    for job in rest:
                        self._line(job)

    def _line(self, job: Job) -> None:
        w = self._words
        with ui.row().classes("w-full items-center"):
            _badge(w, job.state)
            ui.label(f"{w(f'train.kinds.{job.task}')}: {job.title}").classes("flex-grow")
            ui.label(_when(job.begun_s)).classes("ps-dim")
            show = ui.button(w("train.show"), on_click=lambda: self.open(job.id)).props("flat dense no-caps")
            named(show, f"{w('train.show')}: {job.title}")

    def open(self, identity: str) -> None:
        """Show a job's card."""
        self._open.add(identity)
        self._closed.discard(identity)
        self.refresh()

    def close(self, identity: str) -> None:
        """Back into the list."""
        self._open.discard(identity)
        self._closed.add(identity)
        self.refresh()

    def stop(self, identity: str) -> None:
        """End a job; it can go on later."""
        self._jobs.stop(identity)

    def resume(self, identity: str) -> None:
        """Go on with a job."""
        with self._page.refusing():
            self._jobs.resume(identity)
        self.refresh()


class _Card:
    """One piece of work."""

    def __init__(self, work: Work, job: Job) -> None:
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
                    tag(ui.label(job.said), "refused")
            else:
                self._result()
            found = charts(job)
            if job.state == RUNNING or any(len(chart.x) > 1 for chart in found):
                with ui.row().classes("w-full"):
                    for chart in found:
                        with ui.column().classes("col-12 col-md"):
                            self._plot(chart)
            self._warnings = ui.column().classes("w-full")
            self._buttons()
        self.update()

    def _plot(self, chart: Chart) -> None:
        w = self._words
        title = w(f"train.{chart.what}") if chart.what != BEST else w("train.best")
        unit = {LOSS: "", ACCURACY: " (0–1)", BEST: " (0–1)"}[chart.what]
        x = w("train.trainings") if chart.what == BEST else w("train.epoch")
        drawn = self._lines(chart)
        plot = Plot(f"{title}: {self._job.title}", drawn, x=x, y=title + unit, height=220)
        tag(plot, f"curve-{chart.what}").begin(chart.x, chart.lines)
        self._plots.append((chart.what, plot, chart.names))

    def _lines(self, chart: Chart) -> list[dict[str, Any]]:
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
        """What changes while it runs."""
        job, w = self._job, self._words
        if self._bar is not None and self._text is not None:
            at = job.progress
            self._bar.set_value(min(1.0, float(at.get("share") or 0.0)))
            text = _standing(w, at)
            if self._text.text != text:
                self._text.set_text(text)
            found = {chart.what: chart for chart in charts(job)}
            for i, (what, plot, names) in enumerate(self._plots):
                chart = found[what]
                # Points of a line's first epochs are dots; a new fold is a new line.
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
                ui.html(marks(w, scored["leaky"], scored["simulated"]), sanitize=False)
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


def result_text(w: Words, job: Job) -> str:
    """What came out, with what it was scored on."""
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
            accuracy=spread(r["accuracy"]["mean"], r["accuracy"]["sd"]),
            macro_f1=spread(r["macro_f1"]["mean"], r["macro_f1"]["sd"]),
            over=over(w, r["over"], r["units"]),
            seeds=", ".join(map(str, r["seeds"])),
            **where,
        )
    best = (r["best"] or [None])[0] if job.task == SWEEP else r["winner"]
    if best is None:
        return w("train.at_trainings", done=r["done"], trainings=r["trials"])
    found = {"arch": best["arch"], "filters": best["filters"], "parameters": f"{best['parameters']:,}"}
    found |= {"accuracy": spread(best["accuracy"], best.get("accuracy_sd"))}
    found |= {"macro_f1": spread(best["macro_f1"], best.get("macro_f1_sd"))}
    found |= {"over": over(w, *over_trainings(best))}
    counts = {"done": r.get("done"), "trials": r.get("trials", r.get("candidates"))}
    return w(f"train.result_{job.task}", **found, **counts, **where)


def _standing(w: Words, at: dict[str, Any]) -> str:
    """Where it stands, in words."""
    said = [w(f"train.stages.{at.get('stage', 'reading')}")]
    if "rung" in at:
        said.append(w("train.at_rung", **{key: at[key] for key in ("rung", "rungs", "networks")}))
    if "folds" in at:
        said.append(w("train.at_folds", done=at["done"], folds=at["folds"]))
    if "trainings" in at:
        said.append(w("train.at_trainings", done=at["done"], trainings=at["trainings"]))
    if at.get("resumed"):
        said.append(w("train.resumed", n=at["resumed"]))
    if at.get("epoch") and "folds" not in at and "trainings" not in at:
        said.append(w("train.at_epoch", epoch=at["epoch"], epochs=at["epochs"]))
    if at.get("left_s") is not None:
        said.append(w("train.left", time=lasting(w, at["left_s"])))
    return " · ".join(said)


def _badge(w: Words, state: str) -> ui.label:
    badge = ui.label(w(f"train.states.{state}")).classes("q-px-sm rounded-borders")
    return badge.style(f"background: {_BADGES[state]}; color: #fff; font-weight: 600")


def _when(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds)) if seconds else ""
