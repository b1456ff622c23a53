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
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.jobs import DONE, RUNNING, Jobs, StudioJob
from plushsense.studio.app.shell import Page, add_style, button, focus, html, on_change, query_path, section, tag
from plushsense.studio.app.stored_results import (
    StoredResults,
    counted,
    duration_text,
    leaky_warning,
    score_labels,
)
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.pages.train.job_cards import JobsSection, warning_texts
from plushsense.studio.pages.train.job_requests import (
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
from plushsense.studio.pages.train.results_section import ResultsSection
from plushsense.studio.widgets.elements import KINDS_OF_TRAINING, ask, notice
from plushsense.studio.widgets.verdict import FEW_PEOPLE
from plushsense.training.spec import DEVICES, PRESETS
from plushsense.windows.cut import ANYWHERE, CONTEXTS, TRAIN_CONTEXTS

_KINDS_ABOUT: Texts = {
    "sweep": (
        "Every network of a list is trained and scored. This can take hours, so look at the cost first. You can stop "
        "and continue at any time."
    ),
    "search": (
        "Finds the best network within your size limits without training all networks to the end. Look at the cost "
        "first."
    ),
    "train": (
        "One network is trained on all people except a few, who are used to check it. It is ready for the live page "
        "and for the toy."
    ),
    "evaluate": (
        "The network is trained several times, each time without some of the people, and tested on exactly those. "
        "Report this score."
    ),
}

_LABELS: Texts = {
    "name": "Name of the result",
    "context": "What comes before a gesture",
    "preset": "Schedule",
    "epochs": "Epochs (empty: as in the schedule)",
    "seed": "Seed",
    "split": "Who is left out",
    "grid": "List of networks",
    "grid_epochs": "Epochs, separated by commas",
    "max_parameters": "Maximum number of parameters",
    "max_state_bytes": "Maximum bytes of state",
    "max_macs_per_step": "Maximum MAC per step of 50 ms",
    "seeds": "Seeds (number of trainings of each)",
    "arch": "Network (kernel lengths)",
    "architectures": "Only these networks",
    "filters": "Filters",
    "padding": "Padding",
    "norm": "Normalisation",
    "batch": "Windows per batch",
    "batches": "Windows per batch, separated by commas",
    "classes": "Gestures (shared, all, or names separated by commas)",
    "device": "Train on",
    "quantize_aware": "Epochs of fine-tuning for 8 bits",
    "fit_decisions": "Fit the decision settings",
    "int8": "Also score in 8 bits",
    "train_context": "Context to train on",
    "share": "Share of the full cost (0 to 1)",
}

_CONTEXTS: Texts = {
    "default": "as in the schedule",
    "anywhere": "anywhere: for live use, also learns idleness",
    "stream": "stream: the real past in the session",
    "rest": "rest: as if nobody had touched the toy before",
    "loop": "loop: the gesture repeated",
    "rows": "rows: the same, as the authors' scripts cut it",
}

_PRESETS: Texts = {
    "people": "people: best for new people (30 or 60 epochs)",
    "loso": "loso: as in the paper, stops by itself",
    "paper": "paper: network and windows as in the paper",
    "search": "search: 250 epochs, random windows (leaky)",
}

_SPLITS: Texts = {
    "leave-one-subject-out": "each person once (leave-one-subject-out)",
    "by-subject:5": "people in 5 groups (by-subject:5)",
    "by-recording:5": "recordings in 5 groups, known people (by-recording:5)",
    "windows:5": "windows in 5 groups (windows:5), leaky",
    "windows:holdout": "15 % of the windows (windows:holdout), leaky",
    "default": "as in the list",
}

# Gestures with a single recording that are named.
_LISTED = 5
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
    "batch": "64 / 32",
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

    It keeps entered values when another kind of job is chosen. ``begun`` is called with the id of a job that it has
    started.
    """

    def __init__(self, page: Page, jobs: Jobs, results: StoredResults, begun: Callable[[str], None]) -> None:
        self._page, self._jobs, self._results, self._words = page, jobs, results, page.words
        self._begun = begun
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
        with section(w("Make a network")):
            if not self._datasets:
                ui.label(w("There is no data set yet. Record a session, or import recordings on the home page."))
                return
            self._usual_fields()
            self._more = ui.expansion(w("More settings and other jobs"), icon="tune").classes("w-full")
            with tag(self._more, "more"):
                kinds = {kind: w(KINDS_OF_TRAINING[kind]) for kind in KINDS}
                radio = ui.radio(kinds, value=self._kind, on_change=self._choose_kind).props("inline")
                tag(radio, "kind").props(f'aria-label="{w("What to do")}"')
                self._kind_about = tag(ui.label().classes("ps-dim"), "kind-about")
                self._fields = ui.column().classes("w-full ps-small-gap")
                self._buttons()
        self._build()

    def _usual_fields(self) -> None:
        w = self._words
        about = w(
            "Choose the data set and press the button. The network is trained for live use, then tested: on people "
            "that it never met, if there are at least three."
        )
        ui.label(about)
        with ui.row().classes("w-full items-start"):
            box = ui.select(self._datasets, label=w("Data set"), value=self._dataset, on_change=self._choose_dataset)
            self._usual["dataset"] = tag(box.classes(_FIELD), "dataset")
            minutes = ui.input(w("Minutes, at most"), value=str(_MINUTES), on_change=self._choose_minutes)
            self._usual["minutes"] = tag(minutes.props('inputmode="numeric"').classes("w-36"), "minutes")
            button("make", w("Make a network"), self._make, "unelevated", icon="auto_awesome")
        self._facts = tag(ui.row().classes("items-center"), "facts")

    def _buttons(self) -> None:
        w = self._words
        with ui.row().classes("items-center"):
            button("estimate", w("How long will it take?"), self._estimate, icon="schedule")
            button("start", w("Start"), self._start, "unelevated", icon="play_arrow")
        self._plan = tag(ui.column().classes("w-full ps-small-gap").props('role="status"'), "plan")
        with ui.expansion(w("The same job on the command line"), icon="terminal").classes("w-full"):
            self._command = tag(ui.label().classes("ps-code"), "command")

    async def read(self) -> None:
        """Read and display the counts of the chosen data set."""
        if not self._dataset:
            return
        self._page.workspace.part(Choices).keep(dataset=self._dataset)
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
                    ui.label(w("Simulation: these data say nothing about a real toy.")).classes("ps-dim")
                if 0 < facts.people < FEW_PEOPLE:
                    ui.label(w("With so few people, every score is uncertain.")).classes("ps-dim")
            if facts.once:
                names = [*map(w.gesture, facts.once[:_LISTED]), *["…"] * (len(facts.once) > _LISTED)]
                text = w(
                    "There is only one recording of: {gestures}. A network cannot learn from one recording and be "
                    "tested on another: record each gesture at least two more times before you train.",
                    gestures=", ".join(names),
                )
                with self._facts:
                    tag(notice(text), "recorded-once")
            if not facts.streams and self._values[TRAIN]["context"] == ANYWHERE:
                self._values[TRAIN]["context"] = "rest"
                self._build()
                none = w(
                    "This data set has no continuous sessions, so the network learns gestures as if"
                    " the toy had been still before."
                )
                with self._facts:
                    ui.label(none).classes("ps-dim")

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
        self._kind_about.set_text(self._words(_KINDS_ABOUT[self._kind]))
        self._fields.clear()
        self._boxes = dict(self._usual)
        with self._fields:
            {TRAIN: self._of_train, EVALUATE: self._of_evaluate}.get(self._kind, self._of_grid)()
            with ui.expansion(self._words("Advanced settings"), icon="tune").classes("w-full") as self._advanced:
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
            self._select("context", self._texts(_CONTEXTS, ("", *TRAIN_CONTEXTS)))
            self._select("preset", self._texts(_PRESETS, PRESETS))
            self._field("epochs")
            self._field("seed")

    def _of_evaluate(self) -> None:
        with ui.row().classes("w-full"):
            self._select("split", self._texts(_SPLITS, SPLITS))
            self._select("preset", self._texts(_PRESETS, PRESETS))
            self._select("context", self._texts(_CONTEXTS, ("", *TRAIN_CONTEXTS)))
            self._field("epochs")
            self._field("seed")
        self._split_line()

    def _of_grid(self) -> None:
        w = self._words
        options = {
            BUILT_IN[self._kind]: w(
                "of the paper: 13 networks × 4 sizes × 3 epochs × 3 batches = 468 trials"
                if self._kind == SWEEP
                else "of the paper: 52 networks"
            )
        }
        options |= {str(path): path.name for path in grids(self._page.workspace)}
        with ui.row().classes("w-full"):
            self._select("grid", options)
            self._select("split", self._texts(_SPLITS, ("", *SPLITS)))
            if self._kind == SWEEP:
                self._field("grid_epochs", key="epochs")
            else:
                for key in ("max_parameters", "max_state_bytes", "max_macs_per_step"):
                    self._field(key)
            self._field("seeds")
        ui.label(w("Your own lists: TOML files in {folder}.", folder=self._page.workspace.folder)).classes("ps-dim")
        self._split_line()

    def _texts(self, table: Texts, keys: Iterable[str]) -> dict[str, str]:
        """Return the text of each option; the key "" stands for the default."""
        return {key: self._words(table[key or "default"]) for key in keys}

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
                ui.label(leaky_warning(self._words))
            elif split.startswith("by-recording"):
                ui.label(self._words("The network knows these people: expect lower scores for new people."))

    def _field(self, text: str, *, key: str = "") -> None:
        """Build the field of a setting: a selection, a number, a checkbox or a text.

        Args:
            text: key of the label.
            key: name of the setting, if it differs from ``text``.
        """
        name = key or text
        label = self._words(_LABELS[text])
        value = self._values[self._kind].get(name)
        if text in _CHOICES:
            self._select(text, {"": self._words("default"), **{one: one for one in _CHOICES[text]}})
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
        label = self._words(_LABELS[key])
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
                name = str(error.message.values.get("field"))
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
        """Start a job, but ask first while another one trains: two at once take longer each."""
        jobs, w = self._jobs, self._words

        def start(_: str = "") -> None:
            self._begun(jobs.start(request.task, request.spec, request.title).id)

        running = [job for job in jobs.all(MAKE, *KINDS) if job.state == RUNNING and not job.spec.get("dry")]
        if not running:
            start()
            return
        text = "“{title}” is still being worked on, and two jobs at once take about twice as long each."
        ask(w, w(text, title=running[0].title), w("Start both"), start)

    def _estimate(self) -> None:
        self._page.say("")
        self.close()
        with self._show_errors():
            request = self._estimate_request = self._request()
            self._estimate_job = self._jobs.start(request.task, request.spec | {"dry": True}, request.title)
            self._plan.clear()
            with self._plan, ui.row().classes("items-center"):
                ui.spinner(size="sm")
                ui.label(self._words("Reading the data and measuring the speed of this computer …"))

    def _start(self) -> None:
        self._page.say("")
        with self._show_errors():
            request = self._request()
            if request.task in (SWEEP, SEARCH) and self._estimated != request.key:
                changed = self._words("The settings have changed since then. Estimate again.")
                first = self._words("Look at the cost first: press “How long will it take?”, then start.")
                self._page.say(changed if self._estimated else first, "warning")
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
            message = self._words.failure(job.refusal)
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
                ui.label(self._words("The settings have changed since then. Estimate again."))
        if same and not job.result.get("problems"):
            self._estimated = request.key

    def _show_plan(self, plan: Mapping[str, Any], task: str) -> None:
        w = self._words
        if plan.get("problems"):
            with ui.element("div").classes("ps-message ps-message-error w-full").props('role="alert"'):
                ui.label(w("This cannot be trained:"))
                for problem in plan["problems"]:
                    ui.label(f"• {w.failure(problem)}")
            return
        html(score_labels(w, plan["leaky"], plan["simulated"]))
        if task in (TRAIN, EVALUATE):
            text = w(
                "{people}, {gestures}, {windows} windows; {trainings} of at most {epochs}; {parameters} parameters, "
                "{macs} multiply-accumulates.",
                people=counted(w, "people", plan["people"]),
                gestures=counted(w, "gestures", plan["classes"]),
                trainings=counted(w, "networks", plan["folds"]),
                epochs=counted(w, "epochs", plan["epochs"]),
                **{key: w.count(plan[key]) for key in ("windows", "parameters")},
                macs=_power(w, plan["macs"]),
            )
        elif task == SWEEP:
            counts = {key: plan[key] for key in ("trials", "trainings", "folds", "seeds", "held", "split")}
            text = w(
                "{trials} trials in {trainings} trainings (folds: {folds}, seeds: {seeds}), {held} done before; "
                "split {split}; {macs} multiply-accumulates.",
                **counts,
                macs=_power(w, plan["macs"]),
            )
        else:
            text = w(
                "{candidates} networks compared after {rungs} epochs, {left_out} beyond the limits; split {split}; "
                "at most {share} % of the whole list’s cost, {macs} multiply-accumulates.",
                candidates=plan["halving"]["networks"],
                rungs=", ".join(map(str, plan["halving"]["rungs"])),
                left_out=len(plan["left_out"]),
                split=plan["split"],
                share=round(100 * plan["halving"]["bound_share"]),
                macs=_power(w, plan["halving"]["bound_macs"]),
            )
        tag(ui.label(text), "plan-text")
        text = w(
            "This takes {time} on this computer, as measured just now. Reading the data and fitting decisions take "
            "additional time.",
            time=duration_text(w, plan["seconds"]),
        )
        tag(ui.label(text), "plan-time")


def _power(words: Words, value: float) -> str:
    """Format a number in scientific notation, as in ``2.3·10¹²``."""
    digits, power = f"{value:.1e}".split("e")
    raised = str(int(power)).translate(str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"))
    return f"{words.number(float(digits), 1)}·10{raised}"


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
    about = page.words(
        "A network learns from recordings to tell gestures apart. Here you train networks, test them on new people, "
        "and compare them."
    )
    ui.label(about).classes("ps-dim")
    # PyTorch is loaded while the settings are chosen.
    await run.io_bound(jobs.warm_up)
    rows = await run.io_bound(results.rows)
    form = TrainingForm(page, jobs, results, lambda identity: job_list.open(identity))
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
