"""Handle jobs of the train page: requests from the form, cards with progress and curves, a list of earlier jobs."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from nicegui import ui

from plushsense.core.errors import ConfigError
from plushsense.dataset.store import HEAD
from plushsense.models.arch import parse_symbol
from plushsense.scoring.splits import parse_split
from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, STOPPED, Jobs, StudioJob
from plushsense.studio.app.shell import LINES, Page, address, button, html, moment, named, section, tag
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import BUNDLES, Workspace
from plushsense.studio.pages.train.results import (
    averaged_over,
    duration_text,
    figure,
    over_trainings,
    score_labels,
    score_text,
)
from plushsense.studio.widgets.elements import Plot
from plushsense.workflow.config import RunConfig, from_settings

TRAIN, EVALUATE, SWEEP, SEARCH = "train", "evaluate", "sweep", "search"
KINDS = (TRAIN, EVALUATE, SWEEP, SEARCH)
PAPER = "paper"
GRIDS = "grids"
SPLITS = ("leave-one-subject-out", "by-subject:5", "by-recording:5", "windows:5", "windows:holdout")

# Settings of `train` and `evaluate` in the form; the commands have options with the same names.
_SETTINGS = ("preset", "context", "arch", "filters", "padding", "norm", "classes", "epochs", "batch", "seed", "device")
_CHANGES = ("split", "epochs", "batches", "architectures", "filters", "padding", "context", "classes", "device")
_LIMITS = ("max_parameters", "max_state_bytes", "max_macs_per_step")


@dataclass(frozen=True)
class JobRequest:
    """A job to start: the arguments of `Jobs.start` and the equivalent shell command."""

    task: str
    spec: dict[str, Any]
    title: str
    command: str

    @property
    def dry(self) -> dict[str, Any]:
        """The spec of a job that only estimates the cost of this one."""
        return {**self.spec, "dry": True}

    @property
    def key(self) -> str:
        """Text that identifies the job; it is equal for jobs that differ only in the output file."""
        return json.dumps([self.task, {k: v for k, v in self.spec.items() if k != "out"}], sort_keys=True)


def grids(workspace: Workspace) -> list[Path]:
    """List the TOML files of grids in the studio's folder and in its subfolder `GRIDS`."""
    return sorted([*workspace.folder.glob("*.toml"), *(workspace.folder / GRIDS).glob("*.toml")])


def free_name(workspace: Workspace, jobs: Jobs, name: str) -> str:
    """Return a name for a bundle, based on ``name``, that no file and no running job uses."""
    reserved = {Path(job.spec["out"]).stem for job in jobs.all(TRAIN) if job.state == RUNNING and "out" in job.spec}
    plain = "".join(c for c in name if c.isalnum() or c in " _-").strip()[:50] or "model"
    return workspace.free_name(BUNDLES, plain, ".plush", separator=" ", taken=reserved)


def job_request(workspace: Workspace, jobs: Jobs, form: Mapping[str, Any]) -> JobRequest:
    """Convert the fields of the form into a job; leave out empty fields.

    Args:
        form: ``kind``, ``dataset``, and the fields of that kind, named like the command-line options.

    Raises:
        ConfigError: for a folder outside the studio, a name in use, invalid settings, or a job that is already running.
    """
    kind = form["kind"]
    if not form.get("dataset"):
        raise ConfigError("No data set is chosen: record one, or import recordings on the home page.")
    dataset = workspace.inside(form["dataset"])
    if not (dataset / HEAD).is_file():
        raise ConfigError(f"The data set '{dataset}' does not exist any more: put it back, or choose another.")
    given = {key: value for key, value in form.items() if value not in (None, "")}
    if kind == TRAIN:
        request = _train(workspace, dataset, given)
    elif kind == EVALUATE:
        request = _evaluate(dataset, given)
    else:
        request = _of_grid(workspace, kind, dataset, given)
    for job in jobs.all(kind):
        if job.state == RUNNING and not job.spec.get("dry"):
            if job.spec.get("out", 0) == request.spec.get("out"):
                raise ConfigError(f"'{Path(request.spec['out']).stem}' is being trained now: give another name.")
            if job.spec == request.spec:
                raise ConfigError("The same job is running already: see the list of jobs below.")
    return request


def _train(workspace: Workspace, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    settings = {key: given[key] for key in _SETTINGS if key in given}
    config = _checked(settings)
    out = workspace.new(BUNDLES, f"{str(given.get('name', '')).strip()}.plush")
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "out": str(out)}
    command = ["plushsense", "train", str(dataset), "--out", str(out), *_options(settings)]
    tuning = _whole("quantize_aware", given.get("quantize_aware", 0), 0)
    if tuning:
        spec["quantize_aware"] = tuning
        command += ["--quantize-aware", str(tuning)]
    if given.get("fit_decisions") is False:
        spec["fit_decisions"] = False
        command.append("--no-fit-decisions")
    title = f"{out.stem}: {workspace.title(dataset)}, {config.model.arch}, {config.windows.context}"
    return JobRequest(TRAIN, spec, title, shlex.join(command))


def _evaluate(dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    settings = {key: given[key] for key in (*_SETTINGS, "train_context") if key in given}
    config = _checked(settings)
    split = str(given.get("split", config.evaluation.split))
    parse_split(split)
    spec: dict[str, Any] = {"dataset": str(dataset), "settings": settings, "split": split}
    command = ["plushsense", "evaluate", str(dataset), "--split", split, *_options(settings)]
    if given.get("int8"):
        spec["int8"] = True
        command.append("--int8")
    title = f"{dataset.name}: {split}, {config.model.arch}, {config.windows.context}"
    return JobRequest(EVALUATE, spec, title, shlex.join(command))


def _checked(settings: Mapping[str, Any]) -> RunConfig:
    config = from_settings(**settings)
    if config.model.arch is not None:
        parse_symbol(config.model.arch)
    return config


def _of_grid(workspace: Workspace, kind: str, dataset: Path, given: Mapping[str, Any]) -> JobRequest:
    grid = str(given.get("grid", PAPER))
    if grid != PAPER:
        grid = str(workspace.inside(grid))
    changes: dict[str, Any] = {key: str(given[key]) for key in _CHANGES if key in given}
    command = ["plushsense", kind, str(dataset), "--grid", grid, *_options(changes)]
    if "seeds" in given:
        seeds = _whole("seeds", given["seeds"], 1)
        changes["seeds"] = list(range(seeds))
        command += ["--seeds", str(seeds)]
    spec: dict[str, Any] = {"dataset": str(dataset), "grid": grid, "changes": changes}
    if kind == SEARCH:
        limits: dict[str, Any] = {key: _whole(key, given[key], 1) for key in _LIMITS if key in given}
        if "share" in given:
            limits["share"] = _share(given["share"])
        spec["asked"] = limits
        command += _options(limits)
    name = PAPER if grid == PAPER else Path(grid).stem
    title = f"{dataset.name}: {name}" + (f", {given['split']}" if "split" in given else "")
    return JobRequest(kind, spec, title, shlex.join(command))


def _whole(name: str, value: Any, least: int) -> int:
    """Return ``value`` if it is an integer of at least ``least``; otherwise raise ConfigError."""
    if not isinstance(value, int) or value < least:
        raise ConfigError(f"{name} is {value!r}: give a whole number of at least {least}.")
    return value


def _share(value: Any) -> float:
    try:
        share = float(str(value).replace(",", "."))
    except ValueError:
        share = 0.0
    if not 0.0 < share <= 1.0:
        raise ConfigError(f"share is {value!r}: give a number above 0 and at most 1.")
    return share


def _options(settings: Mapping[str, Any]) -> list[str]:
    return [word for key, value in settings.items() for word in (f"--{key.replace('_', '-')}", str(value))]


LOSS, ACCURACY, BEST = "loss", "accuracy", "best"


class ProgressChart(NamedTuple):
    """Data of one progress plot: ``x`` and a line of y values for each of ``names``, where None is a gap."""

    metric: str
    names: tuple[str, ...]
    x: list[float]
    lines: list[list[float | None]]


def progress_charts(job: StudioJob) -> list[ProgressChart]:
    """Return the progress plots of a job; their number depends only on its task, and they are empty at first."""
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
            metric,
            ("training", "held_back"),
            x,
            [[rows[int(e)].get(f"{part}_{metric}") for e in x] for part in ("train", "validation")],
        )
        for metric in (LOSS, ACCURACY)
    ]


def _by_fold(reports: Sequence[dict[str, Any]], metric: str, key: str) -> ProgressChart:
    folds: dict[str, dict[int, float | None]] = {}
    for r in reports:
        if r.get("epoch") and r.get(key) is not None:
            folds.setdefault(r["fold"], {})[r["epoch"]] = r[key]
    epochs = sorted({epoch for rows in folds.values() for epoch in rows})
    return ProgressChart(
        metric, tuple(folds), [float(e) for e in epochs], [[rows.get(e) for e in epochs] for rows in folds.values()]
    )


def _best(job: StudioJob) -> ProgressChart:
    """Plot the best score so far over the number of finished trainings, counted over all rungs of a search."""
    scores: dict[float, float] = {}
    score = "accuracy" if job.task == "sweep" else "macro_f1"
    before, last = 0, (0, 0)
    for r in job.reports:
        if r.get("best") is None:
            continue
        rung = r.get("rung", 1)
        if rung != last[0]:
            before, last = before + last[1], (rung, 0)
        last = (rung, max(last[1], r.get("done", 0)))
        scores[float(before + r.get("done", 0))] = r["best"][score]
    x = sorted(scores)
    return ProgressChart(BEST, (score,), x, [[scores[at] for at in x]])


_MAX_LISTED = 30
_ON = {"validation-subjects": "on_people", "validation-recordings": "on_recordings", "windows:holdout": "on_windows"}
_BADGES = {RUNNING: "#3a6ea5", DONE: "#00805c", REFUSED: "#b84a00", STOPPED: "#6b6b6b"}


class JobsSection:
    """Section with a card for each running or opened job, and a list of the others.

    ``open_result`` is called with the id of a result to display.
    """

    def __init__(self, page: Page, jobs: Jobs, open_result: Callable[[str], Any]) -> None:
        self._page, self._jobs, self._words, self.open_result = page, jobs, page.words, open_result
        self._open: set[str] = {job.id for job in self._all()[:1]}
        self._closed: set[str] = set()
        self._cards: dict[str, _Card] = {}
        self._built: Any = None
        self._done: set[str] = set()
        with section(self._words("train.work"), classes=""):
            self._place = ui.column().classes("w-full")
        self.refresh()

    def _all(self) -> list[StudioJob]:
        return [job for job in self._jobs.all(*KINDS) if not job.spec.get("dry")]

    def refresh(self) -> bool:
        """Update the section, and return whether a job finished since the last call."""
        jobs = self._all()
        running = {job.id for job in jobs if job.state == RUNNING}
        self._open |= running - self._closed
        opened = [job for job in jobs if job.id in self._open]
        rest = [job for job in jobs if job.id not in self._open][:_MAX_LISTED]
        now = ([(job.id, job.state) for job in opened], [(job.id, job.state) for job in rest])
        if now != self._built:
            self._built = now
            self._build(opened, rest)
        else:
            for card in self._cards.values():
                card.update()
        done = {job.id for job in jobs if job.state == DONE}
        finished, self._done = bool(done - self._done), done
        return finished

    def _build(self, opened: list[StudioJob], rest: list[StudioJob]) -> None:
        self._place.clear()
        self._cards = {}
        w = self._words
        with self._place:
            if not opened and not rest:
                ui.label(w("train.no_work")).classes("ps-dim")
            for job in opened:
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
            ui.label(moment(job.begun_s)).classes("ps-dim")
            button("", w("train.show"), lambda: self.open(job.id), "flat dense", about=job.title)

    def open(self, identity: str) -> None:
        """Move a job from the list to a card."""
        self._open.add(identity)
        self._closed.discard(identity)
        self.refresh()

    def close(self, identity: str) -> None:
        """Move a job from its card to the list."""
        self._open.discard(identity)
        self._closed.add(identity)
        self.refresh()

    def stop(self, identity: str) -> None:
        """Stop a job, which can be resumed later."""
        self._jobs.stop(identity)

    def resume(self, identity: str) -> None:
        """Resume a job."""
        with self._page.show_errors():
            self._jobs.resume(identity)
        self.refresh()


class _Card:
    """Card of one job."""

    def __init__(self, jobs: JobsSection, job: StudioJob) -> None:
        self._jobs, self._job, self._words = jobs, job, jobs._words
        w = self._words
        self._plots: list[tuple[str, Plot, tuple[str, ...]]] = []
        self._bar: ui.linear_progress | None = None
        self._text: ui.label | None = None
        self._warned = -1
        with tag(ui.element("article").classes("ps-card w-full column no-wrap ps-small-gap"), "job") as box:
            named(box.props(f'data-job="{job.id}" data-state="{job.state}"'), job.title)
            with ui.row().classes("w-full items-center"):
                tag(_badge(w, job.state), "state")
                ui.label(f"{w(f'train.kinds.{job.task}')}: {job.title}").classes("text-bold")
                ui.space()
                ui.label(moment(job.begun_s)).classes("ps-dim")
            if job.state == RUNNING:
                self._bar = ui.linear_progress(0.0, show_value=False, size="14px").classes("w-full")
                named(self._bar.props("instant-feedback"), w("train.progress", title=job.title))
                tag(self._bar, "progress")
                self._text = tag(ui.label(), "at")
            elif job.state == STOPPED:
                ui.label(w("train.stopped_about"))
            elif job.state == REFUSED:
                with ui.element("div").classes("ps-message ps-message-error w-full").props('role="alert"'):
                    tag(ui.label(w.explain(job.message, job.reason, job.values)), "refused")
            else:
                self._result()
            charts = progress_charts(job)
            if job.state == RUNNING or any(len(chart.x) > 1 for chart in charts):
                with ui.row().classes("w-full"):
                    for chart in charts:
                        with ui.column().classes("col-12 col-md"):
                            self._plot(chart)
            self._warnings = ui.column().classes("w-full")
            self._buttons()
        self.update()

    def _plot(self, chart: ProgressChart) -> None:
        w = self._words
        title = w(f"train.{chart.metric}") if chart.metric != BEST else w("train.best")
        unit = {LOSS: "", ACCURACY: " (0–1)", BEST: " (0–1)"}[chart.metric]
        x = w("train.trainings") if chart.metric == BEST else w("train.epoch")
        drawn = self._lines(chart)
        plot = Plot(f"{title}: {self._job.title}", drawn, x=x, y=title + unit, height=220)
        tag(plot, f"curve-{chart.metric}").begin(chart.x, chart.lines)
        self._plots.append((chart.metric, plot, chart.names))

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
            text = _progress_text(w, at)
            if self._text.text != text:
                self._text.set_text(text)
            charts = {chart.metric: chart for chart in progress_charts(job)}
            for i, (metric, plot, names) in enumerate(self._plots):
                chart = charts[metric]
                # The series change when a new fold adds a line, and after the first epochs, which are drawn as dots.
                form = (*chart.names, str(len(chart.x) < 3))
                plot.show(chart.x, chart.lines, series=self._lines(chart) if form != names else None)
                self._plots[i] = (metric, plot, form)
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
                button("stop", w("train.stop"), lambda: self._jobs.stop(job.id), icon="stop")
            else:
                if job.state in (STOPPED, REFUSED):
                    button("resume", w("train.resume"), lambda: self._jobs.resume(job.id), icon="play_arrow")
                button("", w("train.hide"), lambda: self._jobs.close(job.id), "flat", about=job.title)

    def _result(self) -> None:
        job, r, w = self._job, self._job.result, self._words
        scored = r["scores"] if job.task == TRAIN else r
        with ui.row().classes("w-full items-center"):
            if scored["leaky"] or scored["simulated"]:
                html(score_labels(w, scored["leaky"], scored["simulated"]))
            tag(ui.label(result_text(w, job)), "result")
        with ui.row():
            if job.task == TRAIN:
                for to in ("live", "export"):
                    link = ui.link(w(f"train.to_{to}"), address(to, model=r["bundle"])).classes("ps-link")
                    tag(link, f"to-{to}")
            identity = r["bundle"] if job.task == TRAIN else r["out"]
            if job.task == SWEEP and r["best"]:
                identity += f"#{r['best'][0]['trial']}"
            if job.task == SEARCH:
                identity += f"#{r['winner']['trial']}"
            show = w("train.open_result")
            button("open-result", show, lambda: self._jobs.open_result(identity), "flat dense")


def result_text(w: Words, job: StudioJob) -> str:
    """Summarise the result of a job: its scores and the data on which they were computed."""
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
    return w(
        f"train.result_{job.task}",
        arch=best["arch"],
        filters=best["filters"],
        parameters=f"{best['parameters']:,}",
        accuracy=score_text(best["accuracy"], best.get("accuracy_sd")),
        macro_f1=score_text(best["macro_f1"], best.get("macro_f1_sd")),
        over=averaged_over(w, *over_trainings(best)),
        done=r.get("done"),
        trials=r.get("trials", r.get("candidates")),
        **where,
    )


def _progress_text(w: Words, at: dict[str, Any]) -> str:
    """Describe the progress of a job in words."""
    parts = [w(f"train.stages.{at.get('stage', 'reading')}")]
    if "rung" in at:
        parts.append(w("train.at_rung", **{key: at[key] for key in ("rung", "rungs", "networks")}))
    if "folds" in at:
        parts.append(w("train.at_folds", done=at["done"], folds=at["folds"]))
    if "trainings" in at:
        parts.append(w("train.at_trainings", done=at["done"], trainings=at["trainings"]))
    if at.get("resumed"):
        parts.append(w("train.resumed", n=at["resumed"]))
    if at.get("epoch") and "folds" not in at and "trainings" not in at:
        parts.append(w("train.at_epoch", epoch=at["epoch"], epochs=at["epochs"]))
    if at.get("left_s") is not None:
        parts.append(w("train.left", time=duration_text(w, at["left_s"])))
    return " · ".join(parts)


def _badge(w: Words, state: str) -> ui.label:
    badge = ui.label(w(f"train.states.{state}")).classes("q-px-sm rounded-borders")
    return badge.style(f"background: {_BADGES[state]}; color: #fff; font-weight: 600")
