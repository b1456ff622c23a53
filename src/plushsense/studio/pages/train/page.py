"""Build the train page and its form."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nicegui import context, run, ui

from plushsense.core.errors import ConfigError, PlushSenseError
from plushsense.models.arch import DEFAULT_FILTERS, DEFAULT_SYMBOL, NORMS, PADDINGS, VECTOR_FILTERS, VECTOR_SYMBOL
from plushsense.scoring.splits import parse_split
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, add_style, button, focus, html, on_change, query_path, section, tag
from plushsense.studio.app.words import Words
from plushsense.studio.pages.train.jobs import JobsSection, warning_texts
from plushsense.studio.pages.train.requests import (
    BUILT_IN,
    EVALUATE,
    KINDS,
    MAKE,
    PAPER,
    SEARCH,
    SPLITS,
    SWEEP,
    TRAIN,
    JobRequest,
    free_name,
    grids,
    job_request,
)
from plushsense.studio.pages.train.results import StoredResults, counted, duration_text, score_labels, whole
from plushsense.studio.pages.train.results_section import ResultsSection
from plushsense.studio.pages.train.verdict import FEW_PEOPLE
from plushsense.studio.widgets.elements import scroll_to
from plushsense.training.spec import DEVICES, PRESETS
from plushsense.windows.cut import ANYWHERE, CONTEXTS, TRAIN_CONTEXTS

# Budget of *Make a network*, if nothing else is given.
_MINUTES = 10
# Fields are as wide as their longest choice, or as the page on a phone.
_FIELD = "ps-train-field"
_ADVANCED: dict[str, tuple[str, ...]] = {
    TRAIN: ("arch", "filters", "padding", "norm", "batch", "classes", "device", "quantize_aware", "fit_decisions"),
    EVALUATE: ("arch", "filters", "padding", "norm", "batch", "classes", "device", "train_context", "int8"),
    SWEEP: ("architectures", "filters", "batches", "padding", "context", "classes", "device"),
    SEARCH: ("architectures", "filters", "batches", "padding", "context", "classes", "device", "share"),
}
_PLACEHOLDERS = {
    "arch": f"{DEFAULT_SYMBOL} / {VECTOR_SYMBOL} (100 Hz)",
    "filters": " / ".join(",".join(map(str, counts)) for counts in (DEFAULT_FILTERS, VECTOR_FILTERS)),
    "classes": "shared",
    "batch": "64",
    "architectures": "14d1_39d2_41d4,14d1_19d2_19d4",
    "batches": "64",
    "quantize_aware": "0",
}
_CHOICES: dict[str, tuple[str, ...]] = {
    "padding": PADDINGS,
    "norm": NORMS,
    "device": DEVICES,
    "context": CONTEXTS,
    "train_context": TRAIN_CONTEXTS,
}
_NUMBERS = (
    "epochs", "seed", "batch", "quantize_aware", "seeds", "max_parameters", "max_state_bytes", "max_macs_per_step",
)  # fmt: skip


class TrainingForm:
    """Form for a new job: one button for the usual one, and all others with their settings folded away.

    It keeps entered values when another kind of job is chosen.
    """

    def __init__(self, page: Page, jobs: Jobs, results: StoredResults) -> None:
        self._page, self._jobs, self._results, self._words = page, jobs, results, page.words
        self._datasets = {str(path): page.workspace.title(path) for path in page.workspace.datasets()}
        self._kind = TRAIN
        self._values: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
        self._dataset = query_path(page.workspace, "dataset", self._datasets)
        self._values[TRAIN] |= {"context": ANYWHERE, "preset": "people", "fit_decisions": True}
        self._values[EVALUATE] |= {"split": SPLITS[0], "preset": "people"}
        for kind, grid in BUILT_IN.items():
            self._values[kind] |= {"grid": grid}
        # The job that computes an estimate, the request it is for, and the key of the displayed estimate.
        self._estimate_job: StudioJob | None = None
        self._estimate_request: JobRequest | None = None
        self._estimated = ""
        # The fields by name; those of ``_usual`` stay when the others are built again.
        self._boxes: dict[str, Any] = {}
        self._usual: dict[str, Any] = {}
        self._minutes: Any = _MINUTES
        w = self._words
        with section(w("train.new")):
            if not self._datasets:
                ui.label(w("train.no_data"))
                return
            self._usual_fields()
            with tag(ui.expansion(w("train.more"), icon="tune").classes("w-full"), "more") as self._more:
                kinds = {kind: w(f"train.kinds.{kind}") for kind in KINDS}
                radio = ui.radio(kinds, value=self._kind, on_change=self._choose_kind).props("inline")
                tag(radio, "kind").props(f'aria-label="{w("train.kind")}"')
                self._kind_about = tag(ui.label().classes("ps-dim"), "kind-about")
                self._fields = ui.column().classes("w-full ps-small-gap")
                self._buttons()
        self._build()

    def _usual_fields(self) -> None:
        w = self._words
        ui.label(w("train.make_about"))
        with ui.row().classes("w-full items-start"):
            box = ui.select(self._datasets, label=w("train.data"), value=self._dataset, on_change=self._choose_dataset)
            self._usual["dataset"] = tag(box.classes(_FIELD), "dataset")
            minutes = ui.input(w("train.minutes"), value=str(_MINUTES), on_change=self._choose_minutes)
            self._usual["minutes"] = tag(minutes.props('inputmode="numeric"').classes("w-36"), "minutes")
            button("make", w("train.make"), self._make, "unelevated", icon="auto_awesome")
        self._facts = tag(ui.row().classes("items-center"), "facts")

    def _buttons(self) -> None:
        w = self._words
        with ui.row().classes("items-center"):
            button("estimate", w("train.estimate"), self._estimate, icon="schedule")
            button("start", w("train.start"), self._start, "unelevated", icon="play_arrow")
        self._plan = tag(ui.column().classes("w-full ps-small-gap").props('role="status"'), "plan")
        with ui.expansion(w("train.command"), icon="terminal").classes("w-full"):
            self._command = tag(ui.label().classes("ps-code"), "command")

    async def read(self) -> None:
        """Read and display the counts of the chosen data set."""
        if not self._dataset:
            return
        self._facts.clear()
        with self._page.show_errors():
            facts = await run.io_bound(self._results.facts, self._page.workspace.inside(self._dataset))
            if facts is None:
                return
            w = self._words
            with self._facts:
                counts = {"people": facts.people, "recordings": facts.recordings, "gestures": len(facts.gestures)}
                ui.label(", ".join(counted(w, kind, n) for kind, n in counts.items()))
                if facts.simulated:
                    html(score_labels(w, False, True))
                    ui.label(w("shell.simulation")).classes("ps-dim")
                if 0 < facts.people < FEW_PEOPLE:
                    ui.label(w("train.few_people")).classes("ps-dim")
            if not facts.streams and self._values[TRAIN]["context"] == ANYWHERE:
                self._values[TRAIN]["context"] = "loop"
                self._build()
                with self._facts:
                    ui.label(w("train.no_streams")).classes("ps-dim")

    async def _choose_dataset(self, event: Any) -> None:
        self._dataset = str(event.value)
        self._values[TRAIN].pop("name", None)
        self._page.say("")
        event.sender.error = None
        self._build()
        await self.read()

    def _choose_minutes(self, event: Any) -> None:
        self._minutes = _integer(event.value)
        event.sender.error = None

    def _choose_kind(self, event: Any) -> None:
        self._kind = str(event.value)
        self._page.say("")
        self._build()

    # The fields -----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Build the fields for the chosen kind of job."""
        self._kind_about.set_text(self._words(f"train.kind_about.{self._kind}"))
        self._fields.clear()
        self._boxes = dict(self._usual)
        with self._fields:
            {TRAIN: self._of_train, EVALUATE: self._of_evaluate}.get(self._kind, self._of_grid)()
            with ui.expansion(self._words("train.advanced"), icon="tune").classes("w-full") as self._advanced:
                tag(self._advanced, "advanced")
                with ui.row().classes("w-full"):
                    for key in _ADVANCED[self._kind]:
                        self._field(key)
        self._changed()

    def _of_train(self) -> None:
        title = self._datasets[self._dataset]
        self._values[TRAIN].setdefault("name", free_name(self._page.workspace, self._jobs, title))
        with ui.row().classes("w-full"):
            self._field("name")
            self._select("context", self._texts("contexts", ("", *TRAIN_CONTEXTS)))
            self._select("preset", self._texts("presets", PRESETS))
            self._field("epochs")
            self._field("seed")

    def _of_evaluate(self) -> None:
        with ui.row().classes("w-full"):
            self._select("split", self._texts("splits", SPLITS))
            self._select("preset", self._texts("presets", PRESETS))
            self._select("context", self._texts("contexts", ("", *TRAIN_CONTEXTS)))
            self._field("epochs")
            self._field("seed")
        self._split_line()

    def _of_grid(self) -> None:
        w = self._words
        options = {BUILT_IN[self._kind]: w("train.grids.paper" if self._kind == SWEEP else "train.grids.search")}
        options |= {str(path): path.name for path in grids(self._page.workspace)}
        with ui.row().classes("w-full"):
            self._select("grid", options)
            self._select("split", self._texts("splits", ("", *SPLITS)))
            if self._kind == SWEEP:
                self._field("grid_epochs", key="epochs")
            else:
                for key in ("max_parameters", "max_state_bytes", "max_macs_per_step"):
                    self._field(key)
            self._field("seeds")
        ui.label(w("train.grids_about", folder=self._page.workspace.folder)).classes("ps-dim")
        self._split_line()

    def _texts(self, table: str, keys: Iterable[str]) -> dict[str, str]:
        """Return the text of each option; the key "" stands for the default."""
        return {key: self._words(f"train.{table}.{key or 'default'}") for key in keys}

    def _split_line(self) -> None:
        self._split_row = tag(ui.row().classes("items-center"), "split-about")
        self._describe_split()

    def _describe_split(self) -> None:
        """Display a warning if scores of the chosen split are optimistic."""
        self._split_row.clear()
        values = self._values[self._kind]
        paper = self._kind == SWEEP and values.get("grid") == PAPER
        split = values.get("split") or ("windows:holdout" if paper else "")
        if not split:
            return
        with self._split_row:
            if parse_split(split).leaky:
                html(score_labels(self._words, True, False))
                ui.label(self._words("train.leaky_about"))
            elif split.startswith("by-recording"):
                ui.label(self._words("train.known_about"))

    def _field(self, text: str, *, key: str = "") -> None:
        """Build the field of a setting: a selection, a number, a checkbox or a text.

        Args:
            text: key of the label.
            key: name of the setting, if it differs from ``text``.
        """
        name = key or text
        label = self._words(f"train.{text}")
        value = self._values[self._kind].get(name)
        if text in _CHOICES:
            self._select(text, {"": self._words("train.as_default"), **{one: one for one in _CHOICES[text]}})
        elif text in ("fit_decisions", "int8"):
            tag(ui.checkbox(label, value=bool(value), on_change=self._store(name)), name)
        else:
            number = text in _NUMBERS
            box = ui.input(label, value="" if value is None else str(value), placeholder=_PLACEHOLDERS.get(text))
            box.on_value_change(self._store(name, _integer if number else _text))
            self._boxes[name] = tag(box.props('inputmode="numeric"' if number else "").classes(_FIELD), name)

    def _select(self, key: str, options: Mapping[str, str]) -> None:
        stored = self._values[self._kind].get(key, "")
        value = stored if stored in options else next(iter(options))
        label = self._words(f"train.{key}")
        box = ui.select(dict(options), label=label, value=value, on_change=self._store(key))
        self._boxes[key] = tag(box.classes(_FIELD), key)

    def _store(self, key: str, read: Callable[[Any], Any] | None = None) -> Callable[[Any], None]:
        """Return an event handler that stores the value of a field, converted by ``read`` if given."""
        kind = self._kind

        def store(event: Any) -> None:
            self._values[kind][key] = read(event.value) if read else event.value
            if key in self._boxes:
                self._boxes[key].error = None
            if key in ("split", "grid") and kind != TRAIN:
                self._describe_split()
            self._changed()

        return store

    def _changed(self) -> None:
        """Update the displayed command, and remove the estimate if it no longer applies."""
        try:
            request = self._request()
        except PlushSenseError:
            self._command.set_text("")
        else:
            self._command.set_text(request.command)
            if self._estimated == request.key:
                return
        if self._estimated:
            self._estimated = ""
            self._plan.clear()

    def _request(self) -> JobRequest:
        form = {**self._values[self._kind], "kind": self._kind, "dataset": self._dataset}
        return job_request(self._page.workspace, self._jobs, form)

    # Estimates and starts -------------------------------------------------------------------------------------

    @contextmanager
    def _show_errors(self) -> Iterator[None]:
        """Show an error beside the field that it belongs to, and any other at the top of the page."""
        with self._page.show_errors():
            try:
                yield
            except ConfigError as error:
                name = str(error.values.get("field"))
                if name not in self._boxes:
                    raise
                self._boxes[name].error = self._words.error(error)
                if name not in self._usual:
                    self._more.open()
                    if name in _ADVANCED[self._kind]:
                        self._advanced.open()
                focus(self._boxes[name])

    def _make(self) -> None:
        self._page.say("")
        with self._show_errors():
            form = {"kind": MAKE, "dataset": self._dataset, "minutes": self._minutes}
            self._begin(job_request(self._page.workspace, self._jobs, form))

    def _begin(self, request: JobRequest) -> None:
        self._jobs.start(request.task, request.spec, request.title)
        self._page.say(self._words("train.begun"), "good")
        scroll_to("job")

    def _estimate(self) -> None:
        self._page.say("")
        self.close()
        with self._show_errors():
            request = self._estimate_request = self._request()
            self._estimate_job = self._jobs.start(request.task, request.dry, request.title)
            self._plan.clear()
            with self._plan, ui.row().classes("items-center"):
                ui.spinner(size="sm")
                ui.label(self._words("train.estimating"))

    def _start(self) -> None:
        self._page.say("")
        with self._show_errors():
            request = self._request()
            if request.task in (SWEEP, SEARCH) and self._estimated != request.key:
                self._page.say(self._words("train.changed" if self._estimated else "train.look_first"), "warning")
                return
            self._begin(request)
            self._estimated = ""
            self._plan.clear()
            self._values[TRAIN].pop("name", None)
            self._build()

    def close(self) -> None:
        """Stop the estimate that is being computed, if any."""
        if self._estimate_job is not None and self._estimate_job.state == RUNNING:
            self._jobs.stop(self._estimate_job.id)
        self._estimate_job = None

    def refresh(self) -> None:
        """Display the estimate when it is ready."""
        job, request = self._estimate_job, self._estimate_request
        if job is None or request is None or job.state == RUNNING:
            return
        self._estimate_job = None
        self._plan.clear()
        if job.state != DONE:
            message = self._words.explain(job.message, job.reason, job.values)
            self._page.say(message, "error" if message else "info")
            return
        try:
            same = self._request().key == request.key
        except PlushSenseError:
            same = False
        with self._plan:
            self._show_plan(job.result, request.task)
            for sentence in warning_texts(self._words, job):
                ui.label(f"• {sentence}").classes("ps-dim")
            if not same:
                ui.label(self._words("train.changed"))
        if same and not job.result.get("problems"):
            self._estimated = request.key

    def _show_plan(self, plan: Mapping[str, Any], task: str) -> None:
        w = self._words
        if plan.get("problems"):
            with ui.element("div").classes("ps-message ps-message-error w-full").props('role="alert"'):
                ui.label(w("train.problems"))
                for problem in plan["problems"]:
                    ui.label(f"• {w.explain(problem)}")
            return
        html(score_labels(w, plan["leaky"], plan["simulated"]))
        if task in (TRAIN, EVALUATE):
            text = w(
                "train.plan_one",
                people=counted(w, "people", plan["people"]),
                gestures=counted(w, "gestures", plan["classes"]),
                trainings=counted(w, "networks", plan["folds"]),
                epochs=counted(w, "epochs", plan["epochs"]),
                **{key: whole(w, plan[key]) for key in ("windows", "parameters")},
                macs=_power(w, plan["macs"]),
            )
        elif task == SWEEP:
            counts = {key: plan[key] for key in ("trials", "trainings", "folds", "seeds", "held", "split")}
            text = w("train.plan_grid", **counts, macs=_power(w, plan["macs"]))
        else:
            text = w(
                "train.plan_search",
                candidates=plan["halving"]["networks"],
                rungs=", ".join(map(str, plan["halving"]["rungs"])),
                left_out=len(plan["left_out"]),
                split=plan["split"],
                share=round(100 * plan["halving"]["bound_share"]),
                macs=_power(w, plan["halving"]["bound_macs"]),
            )
        tag(ui.label(text), "plan-text")
        tag(ui.label(w("train.about", time=duration_text(w, plan["seconds"]))), "plan-time")


def _power(words: Words, value: float) -> str:
    """Format a number in scientific notation, as in ``2.3·10¹²``."""
    digits, power = f"{value:.1e}".split("e")
    return (
        f"{words.number(float(digits), 1)}·10{str(int(power)).translate(str.maketrans('0123456789-', '⁰¹²³⁴⁵⁶⁷⁸⁹⁻'))}"
    )


def _integer(text: Any) -> Any:
    """Convert digits into an integer; return other text unchanged, which the check of the settings rejects."""
    plain = str(text).strip()
    return int(plain) if plain.removeprefix("-").isdecimal() else plain


def _text(text: Any) -> str:
    return str(text).strip()


_CSS = Path(__file__).with_name("train.css")
# Time between two updates of running jobs, in seconds.
_DRAWN_S = 0.4


async def show(page: Page) -> None:
    """Build the page."""
    add_style(_CSS.read_text(encoding="utf-8"))
    jobs, results = page.workspace.part(Jobs), page.workspace.part(StoredResults)
    ui.label(page.words("train.intro")).classes("ps-dim")
    rows = await run.io_bound(results.rows)
    form = TrainingForm(page, jobs, results)
    job_list = JobsSection(page, jobs, results, lambda identity: table.open(identity))
    table = ResultsSection(page, results, rows or [])
    context.client.on_delete(form.close)

    pending = False

    def mark() -> None:
        nonlocal pending
        pending = True

    async def draw() -> None:
        nonlocal pending
        if not pending:
            return
        pending = False
        form.refresh()
        if job_list.refresh():
            await table.reload()

    on_change(jobs.changed, mark)
    ui.timer(_DRAWN_S, draw)
    await form.read()
