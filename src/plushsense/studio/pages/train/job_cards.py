"""Show the jobs of the train page: cards with progress, curves and results, and a list of earlier jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nicegui import ui

from plushsense.studio.app.jobs import DONE, REFUSED, RUNNING, STOPPED, Jobs, StudioJob
from plushsense.studio.app.shell import LINES, Page, address, button, html, moment, named, section, tag
from plushsense.studio.app.stored_results import (
    ResultRow,
    StoredResults,
    counted,
    duration_text,
    score_labels,
)
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.train.job_requests import KINDS, MAKE, SEARCH, SWEEP, TRAIN
from plushsense.studio.widgets.elements import JOB_STATES, KINDS_OF_TRAINING, Plot
from plushsense.studio.widgets.verdict import figures, limits, network_links, people_table, show_verdict

_CURVES_ABOUT: Texts = {
    "make": (
        "The first network, while it was trained without the people held back for validation, who are not those of "
        "the score above. The saved network was then trained on everybody."
    ),
    "train": (
        "The network that was scored, while it was trained. Validation: the people or recordings held back, on whom "
        "the score above was measured."
    ),
    "evaluate": "The mean loss of all trainings.",
    "sweep": "The best score after each training.",
    "search": "The best score after each training.",
}

_METRICS: Texts = {"loss": "Loss", "accuracy": "Accuracy", "best": "Best so far"}
_LINES: Texts = {
    "training": "training data",
    "accuracy": "accuracy",
    "macro_f1": "macro-F1",
    "held_back": "validation",
}

_CUTS: Texts = {
    "epochs": "The trainings were shortened to {epochs} epochs instead of {usual}, so the network may be less good.",
    "folds": "People were left out in {folds} groups, not one by one.",
    "learning": "What more people would add was not measured.",
    "longer": "It took {minutes}, longer than the {budget} that were given.",
}

_STAGES: Texts = {
    "reading": "reading the data",
    "training": "training",
    "refitting": "training again, on everybody",
    "fine-tuning": "fine-tuning for 8 bits",
    "deciding": "fitting the decision settings",
    "export": "writing the export",
    "profile": "measuring the cost of a step",
    "evaluating": "testing on people left out",
    "learning": "measuring what more people would add",
}

LOSS, ACCURACY, BEST = "loss", "accuracy", "best"


class ProgressChart(NamedTuple):
    """Data of one progress plot: ``x`` and a line of y values for each of ``names``, where None is a gap."""

    metric: str
    names: tuple[str, ...]
    x: list[float]
    lines: list[list[float | None]]


def progress_charts(job: StudioJob) -> list[ProgressChart]:
    """Return the progress plots of a job; their number depends only on its task, and they are empty at first."""
    if job.task in ("train", "make"):
        return _of_one(job.reports)
    if job.task == "evaluate":
        return [_over_folds(job.reports)]
    return [_best(job)]


def _of_one(reports: Sequence[dict[str, Any]]) -> list[ProgressChart]:
    rows = {r["epoch"]: r for r in reports if r.get("stage") == "training" and r.get("epoch")}
    x = [float(epoch) for epoch in sorted(rows)]
    return [
        ProgressChart(
            metric,
            ("training", "held_back"),
            x,
            [[rows[int(e)].get(key) for e in x] for key in keys],
        )
        for metric, keys in ((LOSS, ("train_loss", "validation_loss")), (ACCURACY, ("train_accuracy", "accuracy")))
    ]


def _over_folds(reports: Sequence[dict[str, Any]]) -> ProgressChart:
    """Plot the mean loss of the folds; their accuracy is known when people are tested, at the end of each."""
    losses: dict[int, list[float]] = {}
    for r in reports:
        if r.get("epoch") and r.get("train_loss") is not None:
            losses.setdefault(r["epoch"], []).append(r["train_loss"])
    epochs = sorted(losses)
    mean: list[float | None] = [sum(losses[e]) / len(losses[e]) for e in epochs]
    return ProgressChart(LOSS, ("training",), [float(e) for e in epochs], [mean])


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
_BADGES = {RUNNING: "#3a6ea5", DONE: "#00805c", REFUSED: "#b84a00", STOPPED: "#6b6b6b"}


class JobsSection:
    """Section with a card for each running or opened job, and a list of the others.

    ``open_result`` is called with the id of a result to display.
    """

    def __init__(self, page: Page, jobs: Jobs, results: StoredResults, open_result: Callable[[str], Any]) -> None:
        self._page, self.jobs, self.words, self.open_result = page, jobs, page.words, open_result
        self.results = results
        self._open: set[str] = {job.id for job in self._all()[:1]}
        self._closed: set[str] = set()
        self._cards: dict[str, _Card] = {}
        self._built: Any = None
        self._done: set[str] = set()
        with section(self.words("Jobs"), classes=""):
            self._place = ui.column().classes("w-full")
        self.refresh()

    def _all(self) -> list[StudioJob]:
        return [job for job in self.jobs.all(MAKE, *KINDS) if not job.spec.get("dry")]

    def refresh(self) -> bool:
        """Update the section, and return whether a job ended since the last call, which may have saved something."""
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
        done = {job.id for job in jobs if job.state in (DONE, STOPPED)}
        finished, self._done = bool(done - self._done), done
        return finished

    def _build(self, opened: list[StudioJob], rest: list[StudioJob]) -> None:
        self._place.clear()
        self._cards = {}
        w = self.words
        with self._place:
            if not opened and not rest:
                ui.label(w("Nothing has been trained here yet.")).classes("ps-dim")
            for job in opened:
                self._cards[job.id] = _Card(self, job)
            if rest:
                with ui.expansion(w("Earlier jobs"), icon="history").classes("w-full") as earlier:
                    tag(earlier, "earlier")
                    for job in rest:
                        self._line(job)

    def _line(self, job: StudioJob) -> None:
        w = self.words
        with ui.row().classes("w-full items-center"):
            _badge(w, job.state)
            ui.label(f"{w(KINDS_OF_TRAINING[job.task])}: {job.title}").classes("flex-grow")
            ui.label(moment(job.begun_s)).classes("ps-dim")
            button("", w("Show"), lambda: self.open(job.id), "flat dense", about=job.title)

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

    def resume(self, identity: str) -> None:
        """Resume a job."""
        with self._page.show_errors():
            self.jobs.resume(identity)
        self.refresh()


class _Card:
    """Card of one job."""

    def __init__(self, jobs: JobsSection, job: StudioJob) -> None:
        self._section, self._job = jobs, job
        self._words = w = jobs.words
        self._plots: list[tuple[str, Plot, tuple[str, ...]]] = []
        self._bar: ui.linear_progress | None = None
        self._text: ui.label | None = None
        self._warned = -1
        with tag(ui.element("article").classes("ps-card w-full column no-wrap ps-small-gap"), "job") as box:
            named(box.props(f'data-job="{job.id}" data-state="{job.state}"'), job.title)
            with ui.row().classes("w-full items-center"):
                tag(_badge(w, job.state), "state")
                ui.label(f"{w(KINDS_OF_TRAINING[job.task])}: {job.title}").classes("text-bold")
                ui.space()
                ui.label(moment(job.begun_s)).classes("ps-dim")
            if job.state == RUNNING:
                self._bar = ui.linear_progress(0.0, show_value=False, size="14px").classes("w-full")
                named(self._bar.props("instant-feedback"), w("Progress of {title}", title=job.title))
                tag(self._bar, "progress")
                self._text = tag(ui.label(), "at")
            elif job.state == STOPPED:
                ui.label(w("Stopped. What is finished is saved; press “Continue” to go on."))
                self._saved_network()
            elif job.state == REFUSED:
                with ui.element("div").classes("ps-message ps-message-error w-full").props('role="alert"'):
                    tag(ui.label(w.failure(job.refusal)), "refused")
            else:
                self._result()
            charts = progress_charts(job)
            if job.state == RUNNING:
                self._curves(charts)
            elif any(len(chart.x) > 1 for chart in charts):
                with tag(ui.expansion(w("How the training went"), icon="show_chart").classes("w-full"), "curves"):
                    ui.label(w(_CURVES_ABOUT[job.task])).classes("ps-dim")
                    self._curves(charts)
            self._warnings = ui.column().classes("w-full")
            self._buttons()
        self.update()

    def _curves(self, charts: Sequence[ProgressChart]) -> None:
        with ui.row().classes("w-full"):
            for chart in charts:
                with ui.column().classes("col-12 col-md"):
                    self._plot(chart)

    def _plot(self, chart: ProgressChart) -> None:
        w = self._words
        title = w(_METRICS[chart.metric])
        share = chart.metric != LOSS
        x = w("Trainings done") if chart.metric == BEST else w("Epoch")
        drawn = self._lines(chart)
        label, y = f"{title}: {self._job.title}", f"{title} (0–1)" if share else title
        plot = Plot(label, drawn, x=x, y=y, height=220, share=share)
        tag(plot, f"curve-{chart.metric}").begin(chart.x, chart.lines)
        self._plots.append((chart.metric, plot, chart.names))

    def _lines(self, chart: ProgressChart) -> list[dict[str, Any]]:
        return [
            {
                "label": self._words(_LINES[name]),
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
            self._bar.set_value(min(1.0, float(at.get("share", 1.0 if at else 0.0))))
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
            if sentences := warning_texts(w, job):
                with self._warnings, ui.expansion(w("Good to know ({n})", n=len(sentences)), icon="info") as more:
                    tag(more.classes("w-full"), "warnings")
                    for sentence in sentences:
                        ui.label(f"• {sentence}").classes("ps-break")

    def _buttons(self) -> None:
        job, w = self._job, self._words
        with ui.row():
            if job.state == RUNNING:
                button("stop", w("Stop"), lambda: self._section.jobs.stop(job.id), icon="stop")
            else:
                if job.state in (STOPPED, REFUSED):
                    button("resume", w("Continue"), lambda: self._section.resume(job.id), icon="play_arrow")
                button("", w("Hide"), lambda: self._section.close(job.id), "flat", about=job.title)

    def _result(self) -> None:
        job, w = self._job, self._words
        identity = _identity(job)
        row = self._section.results.find(identity)
        if row is None:
            tag(ui.label(w("The result was removed or cannot be read.")).classes("ps-dim"), "result")
        else:
            self._verdict(row)
        cut = [self._cut(one) for one in job.result.get("cut", ())]
        if cut:
            with tag(ui.column().classes("ps-no-gap"), "cut"):
                ui.label(w("What did not fit into the time:")).classes("text-bold")
                for sentence in cut:
                    ui.label(f"• {sentence}")
        with ui.row().classes("items-center"):
            self._links()
            if row is not None:
                show = w("Open in the results")
                button("open-result", show, lambda: self._section.open_result(identity), "flat dense", about=job.title)

    def _verdict(self, row: ResultRow) -> None:
        w = self._words
        marks = score_labels(w, row.leaky, row.simulated)
        if marks:
            tag(html(marks), "marks")
        show_verdict(w, row, "ps-verdict-text")
        for sentence in limits(w, row):
            ui.label(sentence)
        if row.simulated:
            ui.label(w("Simulation: these data say nothing about a real toy."))
        tag(ui.label(figures(w, row)).classes("ps-dim"), "result")
        if row.people:
            bars = ui.expansion(w("Scores of each person"), icon="groups", value=True).classes("w-full")
            with tag(bars, "people-bars"):
                html(people_table(w, row)).classes("ps-scroll-x")

    def _cut(self, cut: dict[str, Any]) -> str:
        w = self._words
        values = {key: value for key, value in cut.items() if key != "kind"}
        if cut["kind"] == "longer":
            values = {key: counted(w, "minutes", n) for key, n in values.items()}
        return w(_CUTS[cut["kind"]], **values)

    def _saved_network(self) -> None:
        """Name the network that a stopped job has saved already."""
        if bundle := _saved_bundle(self._job):
            saved = self._words(
                "The network “{name}” is saved and can be used. Its test on people left out is not finished.",
                name=Path(bundle).stem,
            )
            tag(ui.label(saved), "saved")
            with ui.row():
                self._links()

    def _links(self) -> None:
        job, w = self._job, self._words
        bundle = job.result.get("bundle") or _saved_bundle(job)
        if bundle and Path(bundle).is_file():
            network_links(w, bundle)
        place = Path(job.spec.get("place", ""))
        if "files" in job.result and place.is_dir():
            link = ui.link(w("Export “{name}”", name=place.name), address("export", name=place.name))
            tag(link.classes("ps-link"), "to-exported")


def _saved_bundle(job: StudioJob) -> str:
    return str(next((r["bundle"] for r in reversed(job.reports) if r.get("bundle")), ""))


def _identity(job: StudioJob) -> str:
    """Return the id of the result of a job that is done."""
    r = job.result
    if job.task == TRAIN:
        return str(r["bundle"])
    if job.task == SWEEP and r["best"]:
        return f"{r['out']}#{r['best'][0]['trial']}"
    if job.task == SEARCH:
        return f"{r['out']}#{r['winner']['trial']}"
    return str(r["out"])


def warning_texts(w: Words, job: StudioJob) -> list[str]:
    """Return the warnings of a job in this language, without repetitions."""
    return list(dict.fromkeys(map(w.sentence, job.warnings)))


def _progress_text(w: Words, at: dict[str, Any]) -> str:
    """Describe the progress of a job in words."""
    parts = [w(_STAGES[at.get("stage", "reading")])]
    at = {key: w.count(value) if key in ("networks", "trainings") else value for key, value in at.items()}
    if "rung" in at:
        parts.append(
            w("round {rung} of {rungs}, {networks} networks", **{key: at[key] for key in ("rung", "rungs", "networks")})
        )
    if "folds" in at:
        parts.append(w("groups of people: {done} of {folds}", done=at["done"], folds=at["folds"]))
    if "trainings" in at:
        parts.append(w("trainings: {done} of {trainings}", done=at["done"], trainings=at["trainings"]))
    if at.get("resumed"):
        parts.append(w("{n} done before", n=at["resumed"]))
    if at.get("epoch") and at.get("stage") != "deciding" and "folds" not in at and "trainings" not in at:
        parts.append(w("epoch {epoch} of {epochs}", epoch=at["epoch"], epochs=at["epochs"]))
    if at.get("left_s") is not None:
        parts.append(w("{time} left", time=duration_text(w, at["left_s"])))
    return " · ".join(parts)


def _badge(w: Words, state: str) -> ui.label:
    badge = ui.label(w(JOB_STATES[state])).classes("q-px-sm rounded-borders")
    return badge.style(f"background: {_BADGES[state]}; color: #fff; font-weight: 600")
