"""Build the export page, which exports a bundle as C code, estimates its cost and verifies it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup
from nicegui import run, ui

from plushsense.core.gestures import NOBODY
from plushsense.dataset.store import UNKNOWN_SUBJECT
from plushsense.deploy.code import ModelFacts
from plushsense.deploy.convert import CONVERTERS
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE, SKETCH
from plushsense.deploy.targets import TARGETS
from plushsense.models.bundle import Bundle
from plushsense.studio.app.guard import download_address, path_in
from plushsense.studio.app.jobs import Jobs, StudioJob
from plushsense.studio.app.shell import Page, address, button, html, moment, query, set_address, tag
from plushsense.studio.app.words import Words
from plushsense.studio.app.workspace import EXPORTS, plain_name
from plushsense.studio.pages.export.exports import BundleFacts, ExportFacts, exports_of, formats, newest_job, targets
from plushsense.studio.widgets.elements import (
    WorkPanel,
    errors_beside,
    facts,
    link,
    notice,
    scroll_to,
    size,
    style,
    summary,
    table,
    text,
    titles,
    verdict,
)

_FITS = {"yes": True, "no": False, "unsure": None}


def show_cost(page: Page, work: WorkPanel, export: ExportFacts, counted: StudioJob | None) -> None:
    """Build the card with the cost of an export; ``counted`` is the job that measured it, if any."""
    words = page.words
    profile: dict[str, Any] = counted.result.get("profile", {}) if counted else {}
    current = profile.get("digest") == export.digest

    async def start() -> None:
        await work.start("profile", {"place": str(export.folder)})

    with tag(ui.column().classes("ps-card w-full"), "cost"), _folded(words("export.cost")):
        if not profile:
            text(words("export.not_counted"))
        elif not current:
            notice(words("export.counted_before"))
        elif "refused" in profile:
            tag(notice(words.sentence(profile["refused"])), "cost-refused")
        else:
            assert counted is not None
            _display_cost(words, profile, moment(counted.ended_s))
        if not current or "refused" in profile:
            button("count", words("export.count"), start)


def _display_cost(words: Words, profile: dict[str, Any], when: str) -> None:
    text(words("export.cost_about", step=words.significant(profile["step_ms"], 3)), classes="ps-dim")
    rows = [
        (
            each["chip"],
            f"{each['mhz']}",
            words("export.between", low=words.significant(each["low"], 2), high=words.significant(each["high"], 2)),
            verdict(_FITS[each["fits"]], words(f"export.fits_{each['fits']}")),
        )
        for each in profile["estimated_ms"].values()
    ]
    if rows:
        head = [words(f"export.{k}") for k in ("chip", "mhz", "estimate", "fits")]
        tag(table(words("export.estimate_caption", when=when), head, rows, (1,)), "estimates")
    counted = [
        (
            TARGETS[name].title,
            *(words.count(each[key]) for key in ("instructions_per_step", "flash_bytes", "ram_bytes")),
            words.count(each["stack_push_bytes"]) if each["stack_push_bytes"] is not None else "–",
        )
        for name, each in profile["targets"].items()
        if each["instructions_per_step"] is not None
    ]
    if counted:
        head = [words(f"export.{k}") for k in ("counted_on", "instructions", "flash_all", "ram_all", "stack")]
        table(words("export.counted_caption", optimise=profile["optimise"]), head, counted, (1, 2, 3, 4))
    for name, packages in profile["missing"].items():
        text(_missing_target(words, TARGETS[name].title, packages), classes="ps-dim")


def _missing_target(words: Words, title: str, packages: Sequence[str]) -> str:
    return words("export.target_missing", target=title, packages=" ".join(packages))


def show_facts(page: Page, export: ExportFacts, made: StudioJob | None) -> None:
    """Build the card with facts, files and download of an export; ``made`` is the job that wrote it, if known."""
    words, model = page.words, export.facts
    assert model is not None
    with tag(ui.column().classes("ps-card w-full"), "export-facts"):
        if model.simulated:
            notice(words("shell.simulation"))
        for warning in made.warnings if made else ():
            notice(words.sentence(warning))
        text(words("export.hand_over"))
        download = ui.link(words("export.download"), download_address(EXPORTS, export.name)).classes("ps-link")
        tag(download.props("download"), "download")
        with _folded(words("export.details")):
            _list_facts(words, export, model)


def _folded(title: str) -> ui.element:
    """Add a part of the page that is folded at first, with its heading."""
    box = ui.element("details").classes("w-full")
    with box:
        summary(title)
    return box


def _list_facts(words: Words, export: ExportFacts, model: ModelFacts) -> None:
    """List the facts and the files of an export."""
    step = words.significant(model.step_ms, 3)
    facts(
        [
            (words("export.network"), model.title),
            (words("export.gestures"), str(model.classes)),
            (words("export.layout"), model.layout),
            (words("export.flash"), words("export.flash_value", n=words.count(model.flash_bytes))),
            (words("export.ram"), words("export.ram_value", n=words.count(model.ram_bytes))),
            (
                words("export.step"),
                words("export.step_value", ms=step, macs=words.count(model.macs_per_step)),
            ),
            (words("export.made"), moment(export.made_s)),
            (words("export.place"), str(export.folder)),
        ]
    )
    for name, each in model.conversions.items():
        apart = each.largest_difference
        message = words("export.converted", file=each.file, n=words.count(each.bytes), name=name)
        text(message if apart is None else f"{message} {words('export.apart', d=words.significant(apart, 1))}")
    with ui.expansion(
        words("export.files", n=len(export.files), size=size(sum(export.files.values()), words))
    ) as files:
        rows = [(name, words.count(bytes_)) for name, bytes_ in export.files.items()]
        table(words("export.files_caption"), (words("export.file"), words("export.bytes")), rows, (1,))
    tag(files.classes("w-full"), "files")


def show_next(page: Page) -> None:
    """Build the card with the next steps for a firmware engineer."""
    words = page.words
    card = tag(ui.column().classes("ps-card w-full"), "next")
    with card, _folded(words("export.next")), ui.element("ol").classes("ps-steps"):
        for key in ("arduino", "idf", "plain", "read"):
            message = words(f"export.next_{key}", arduino=ARDUINO, sketch=SKETCH, idf=IDF, example=IDF_EXAMPLE)
            text(message, "li")


def verification_verdict(words: Words, export: ExportFacts, proof: StudioJob | None) -> Markup:
    """Render the outcome of the last verification: equal, unequal, outdated or never run."""
    if proof is None:
        return verdict(None, words("export.never_proved"))
    if proof.result.get("digest") != export.digest:
        return verdict(None, words("export.proved_before"))
    good, outcome = _outcome(words, proof.result)
    return verdict(good, f"{outcome}, {moment(proof.ended_s)}")


def _outcome(words: Words, result: dict[str, Any]) -> tuple[bool | None, str]:
    """Return whether a verification passed, and its text; None means it passed with C code changed by the user."""
    if not result["passed"]:
        return False, words("export.unequal")
    return (True, words("export.equal")) if result["own"] else (None, words("export.equal_not_own"))


class VerificationCard:
    """Card that verifies one export."""

    def __init__(self, page: Page, work: WorkPanel, export: ExportFacts) -> None:
        self.page, self.words, self.work, self.export = page, page.words, work, export
        self._chosen: dict[str, ui.checkbox] = {}

    async def build(self) -> None:
        words = self.words
        missing = await run.io_bound(targets) or {}
        with tag(ui.column().classes("ps-card w-full"), "proof"):
            text(words("export.prove"), "h3")
            text(words("export.prove_about"), classes="ps-dim")
            with ui.expansion(words("export.more")).classes("w-full"):
                with ui.row().classes("w-full"):
                    for name in (n for n, packages in missing.items() if not packages):
                        self._chosen[name] = ui.checkbox(self._title(name), value=True)
                        tag(self._chosen[name], f"target-{name}")
                for name, packages in missing.items():
                    if packages:
                        message = _missing_target(words, self._title(name), packages)
                        tag(text(message, classes="ps-dim"), f"missing-{name}")
                options = {"": words("export.recorded_none")} | await titles(self.page.workspace)
                self._dataset = ui.select(options, value="", label=words("export.recorded")).classes("w-full")
                self._faults = tag(ui.checkbox(words("export.faults")), "faults")
                self._trust = tag(ui.checkbox(words("export.trust")), "trust")
            start = button("verify", words("export.verify"), self._start, "", icon="fact_check")
            start.set_enabled(bool(self._chosen))
            proof = newest_job(self.page.workspace.part(Jobs), "verify", self.export.folder)
            if proof is not None:
                self._display(proof)

    def _title(self, name: str) -> str:
        return self.words("export.host") if name == "host" else TARGETS[name].title

    async def _start(self) -> None:
        words, chosen = self.words, [name for name, box in self._chosen.items() if box.value]
        if not chosen:
            self.page.say(words("export.no_target"), "error")
            return
        if self.work.running("verify"):
            self.page.say(words("export.verify_runs"), "warning")
            return
        self.page.say("")
        with self.page.show_errors():
            dataset = str(self.page.workspace.inside(self._dataset.value)) if self._dataset.value else ""
            spec = {
                "place": str(self.export.folder),
                "targets": chosen,
                "dataset": dataset,
                "faults": bool(self._faults.value),
                "trust": bool(self._trust.value),
            }
            await self.work.start("verify", spec)

    def _display(self, proof: StudioJob) -> None:
        words, result = self.words, proof.result
        with tag(ui.column().classes("w-full"), "verdict"):
            if result["digest"] != self.export.digest:
                text(
                    words("export.changed_since", when=moment(proof.ended_s)),
                    classes="ps-message ps-message-warning w-full",
                )
            good, outcome = _outcome(words, result)
            with ui.row().classes("items-center"):
                html(verdict(good, outcome))
                text(self._sum(result), "span")
            for sentence in self._sentences(result):
                notice(sentence, "error" if good is False else "warning")
            rows = [
                (
                    words("export.host_short") if r["target"] == "host" else self._title(r["target"]),
                    r["compiler"],
                    r["flags"],
                    words.count(r["vectors"]),
                    words.count(r["mismatches"]),
                    words.count(r["max_abs_diff"]),
                    verdict(not r["mismatches"], words("export.unequal" if r["mismatches"] else "export.equal")),
                )
                for r in result["runs"]
            ]
            keys = ("target", "compiler", "flags", "answers", "mismatches", "difference", "verdict")
            caption = words("export.runs_caption", when=moment(proof.ended_s))
            tag(table(caption, [words(f"export.{k}") for k in keys], rows, (3, 4, 5)), "runs")
            counts = ("samples", "frames", "answers")
            streams = [(s["name"], *(words.count(s[key]) for key in counts)) for s in result["streams"]]
            head = [words(f"export.{k}") for k in ("stream", *counts)]
            tag(table(words("export.streams_caption"), head, streams, (1, 2, 3)), "streams")
            for each in result["not_run"]:
                text(words("export.not_run", what=each["what"], why=words.sentence(each["why"])), classes="ps-dim")
            if result["faults"]:
                self._mutants(result["faults"])

    def _sum(self, result: dict[str, Any]) -> str:
        total, unequal = self.words.count(result["vectors"]), self.words.count(result["mismatches"])
        if not result["mismatches"]:
            return self.words("export.all_equal", n=total, settings=len(result["runs"]))
        return self.words("export.some_unequal", bad=unequal, n=total)

    def _sentences(self, result: dict[str, Any]) -> list[str]:
        words, sentences = self.words, []
        if result["first"]:
            sentences.append(words("export.first_difference", where=result["first"]))
        elif not result["decisions"]:
            sentences.append(words("export.nothing_proved"))
        elif not result["passed"]:
            sentences.append(words("export.fault_missed"))
        if not result["own"]:
            sentences.append(words("export.not_own"))
            sentences.append(words("export.changed_files", files=", ".join(result["changed"])))
        return sentences

    def _mutants(self, faults: Sequence[dict[str, Any]]) -> None:
        words = self.words
        kinds = {True: "caught", None: "not_shown", False: "not_caught"}
        rows = []
        for each in faults:
            state = True if each["caught"] else None if each["silent"] else False
            cell = verdict(state, words(f"export.{kinds[state]}"))
            rows.append((each["kind"], each["fault"], self._title(each["target"]), cell))
        with ui.expansion(words("export.faults_found", n=len(rows))).classes("w-full"):
            head = [words(f"export.{k}") for k in ("fault_kind", "fault", "target", "verdict")]
            table(words("export.faults_caption"), head, rows)
            if any(f["silent"] for f in faults):
                text(words("export.not_shown_about"), classes="ps-dim")


_TASKS = ("export", "profile", "verify")


async def show(page: Page) -> None:
    """Build the page. ``?model=PATH`` chooses a bundle, ``?name=NAME`` opens an export."""
    await _Exporting(page).build()


class _Exporting:
    def __init__(self, page: Page) -> None:
        self.page, self.words, self.workspace = page, page.words, page.workspace
        self.query = query()
        self.bundle: BundleFacts | None = None
        self.open = ""

    async def build(self) -> None:
        style()
        text(self.words("export.about"), classes="ps-dim")
        await self._form()
        self.work = WorkPanel(self.page, _TASKS, self._progress_text, self._ended, self._allow)
        self._allow()
        self._detail = tag(ui.column().classes("w-full"), "detail")
        self._list = tag(ui.column().classes("w-full"), "exports")
        if name := self.query.get("name", ""):
            await self._show(name)
        await self._refresh_list()

    # A new export ---------------------------------------------------------------------------------------------

    async def _form(self) -> None:
        words = self.words
        bundles = await run.io_bound(self.workspace.bundles) or []
        with tag(ui.column().classes("ps-card w-full"), "new"):
            text(words("export.new"), "h2")
            if not bundles:
                tag(text(words("export.no_bundle")), "no-bundle")
                ui.link(words("pages.train"), address("train")).classes("ps-link")
                return
            options = {str(p): self._label(p) for p in bundles}
            model = self.query.get("model", "")
            first = model if model in options else str(bundles[0])
            select = ui.select(
                options, value=first, label=words("export.bundle"), on_change=lambda e: self._choose(e.value)
            )
            tag(select.classes("w-full"), "bundle")
            self._state = ui.column().classes("w-full")
            self._name = tag(ui.input(words("export.name")).props("maxlength=64").classes("w-full"), "name")
            self._button = button("do", words("export.do"), self._start, "", icon="memory")
            with _folded(words("export.about_network")):
                self._about = tag(ui.column().classes("w-full"), "bundle-facts")
            with ui.expansion(words("export.more")).classes("w-full"):
                await self._more()
            await self._choose(first)

    def _label(self, path: Path) -> str:
        inside = self.workspace.folder in path.parents
        return str(path.relative_to(self.workspace.folder)) if inside else f"{path.name} ({path.parent})"

    async def _more(self) -> None:
        words = self.words
        extras = await run.io_bound(formats) or {}
        self._formats: dict[str, ui.checkbox] = {}
        text(words("export.formats"), "h3")
        text(words("export.formats_about"), classes="ps-dim")
        for name in (n for n, extra in extras.items() if not extra):
            self._formats[name] = tag(ui.checkbox(f"{name}: {CONVERTERS[name].holds}"), f"format-{name}")
        for extra in dict.fromkeys(e for e in extras.values() if e):
            missing = ", ".join(n for n, needed in extras.items() if needed == extra)
            text(words("export.format_missing", names=missing, extra=extra), classes="ps-dim")
        text(words("export.calibrate"), "h3")
        options = {"": words("export.calibrate_kept")} | await titles(self.workspace)
        self._dataset = ui.select(options, value="", label=words("export.calibrate_on")).classes("w-full")

    async def _choose(self, path: str) -> None:
        chosen = await run.io_bound(lambda: BundleFacts.of(Path(path)))
        assert chosen is not None
        self.bundle = chosen
        self._state.clear()
        self._about.clear()
        with self._state:
            if chosen.bundle is None:
                tag(notice(self.words.sentence(chosen.problem or ""), "error"), "bundle-problem")
            else:
                if chosen.simulated:
                    notice(self.words("shell.simulation"))
                if chosen.cannot:
                    tag(notice(self.words.sentence(chosen.cannot), "error"), "bundle-cannot")
        if chosen.bundle is not None:
            with self._about:
                facts(self._facts_of(chosen.bundle, chosen.bytes))
        self._name.set_value(self._free_name(Path(path).stem))
        self._allow()

    def _free_name(self, stem: str) -> str:
        return self.workspace.free_name(EXPORTS, plain_name(stem, "export"))

    def _facts_of(self, bundle: Bundle, bytes_: int) -> list[tuple[str, str]]:
        words, origin = self.words, bundle.provenance
        subjects, dataset = origin.get("subjects"), str(origin.get("dataset", ""))
        people = len(set(subjects) - {NOBODY, UNKNOWN_SUBJECT}) if isinstance(subjects, list) else int(subjects or 0)
        trained = words("export.trained_value", dataset=dataset, people=people)
        network = words("export.network_value", title=bundle.arch.title, padding=bundle.arch.padding)
        rows = [
            (words("export.network"), network),
            (words("export.gestures"), str(len(bundle.gestures.labels))),
            (words("export.layout"), bundle.layout.name),
            (words("export.trained_on"), trained if dataset else words("export.unknown_dataset")),
            (words("export.adapted_to"), bundle.adapted_to or ""),
            (words("export.size"), size(bytes_, words)),
        ]
        scores = origin.get("scores")
        if not isinstance(scores, dict) or scores.get("accuracy") is None:
            return [*rows, (words("export.scores"), words("export.no_scores"))]
        value = words(
            "export.scores_value",
            accuracy=words.number(scores["accuracy"], 2),
            f1=words.number(scores.get("macro_f1") or float("nan"), 2),
            windows=scores.get("windows", "?"),
            split=scores.get("split", "?"),
        )
        leaky = f" {words('export.leaky')}" if scores.get("leaky") else ""
        simulated = f" {words('export.simulated_scores')}" if origin.get("simulated") else ""
        return [*rows, (words("export.scores"), f"{value}{leaky}{simulated}")]

    def _allow(self) -> None:
        """Enable the button while no export runs and the bundle can be read."""
        if hasattr(self, "_button") and hasattr(self, "work"):
            readable = self.bundle is not None and not self.bundle.problem
            self._button.set_enabled(readable and not self.work.running("export"))

    async def _start(self) -> None:
        self.page.say("")
        assert self.bundle is not None
        with errors_beside(self.page, self._name):
            bundle = self.workspace.inside(self.bundle.path)
            place = self.workspace.new(EXPORTS, self._name.value or "")
            dataset = str(self.workspace.inside(self._dataset.value)) if self._dataset.value else ""
            also = [name for name, box in self._formats.items() if box.value]
            spec = {"bundle": str(bundle), "place": str(place), "also": also, "dataset": dataset}
            await self.work.start("export", spec)

    # Jobs -----------------------------------------------------------------------------------------------------

    def _progress_text(self, job: StudioJob) -> str:
        stage, total = str(job.progress.get("stage", "begin")), job.progress.get("total") or 0
        count = f" {self.words('export.of', done=job.progress.get('done', 0), total=total)}" if total else ""
        return f"{self.words(f'export.stage_{stage}')}{count}"

    async def _ended(self, job: StudioJob) -> None:
        name = Path(job.spec["place"]).name
        if job.task == "export":
            self.page.say(self.words("export.done", name=name), "good")
            self._name.set_value(self._free_name(name))
        if job.task == "export" or name == self.open:
            await self._show(name)
            scroll_to("verdict" if job.task == "verify" else "detail")
        await self._refresh_list()

    # One export -----------------------------------------------------------------------------------------------

    async def _show(self, name: str) -> None:
        words = self.words
        with self.page.show_errors():
            folder = path_in(self.workspace, EXPORTS, name)
            export = await run.io_bound(lambda: ExportFacts.of(folder))
            assert export is not None
            jobs = self.workspace.part(Jobs)
            made = newest_job(jobs, "export", folder)
            counted = max(
                (j for j in (made, newest_job(jobs, "profile", folder)) if j is not None),
                key=lambda j: j.ended_s,
                default=None,
            )
            self.open = name
            set_address(address("export", name=name))
            self._detail.clear()
            with self._detail:
                text(words("export.one", name=name), "h2")
                if export.problem:
                    notice(words.sentence(export.problem), "error")
                    return
                show_facts(
                    self.page,
                    export,
                    made if made and made.result.get("profile", {}).get("digest") == export.digest else None,
                )
                show_cost(self.page, self.work, export, counted)
                await VerificationCard(self.page, self.work, export).build()
                show_next(self.page)

    # All exports ----------------------------------------------------------------------------------------------

    async def _refresh_list(self) -> None:
        words = self.words
        exports = await run.io_bound(lambda: [ExportFacts.of(f) for f in exports_of(self.workspace)]) or []
        jobs = self.workspace.part(Jobs)
        rows = []
        for each in exports:
            proof = newest_job(jobs, "verify", each.folder)
            rows.append(
                (
                    link(each.name, address("export", name=each.name)),
                    each.facts.title if each.facts else words.sentence(each.problem) if each.problem else "",
                    words("export.simulation_short") if each.facts and each.facts.simulated else "",
                    moment(each.made_s) if each.made_s else "",
                    verification_verdict(words, each, proof),
                )
            )
        self._list.clear()
        with self._list:
            text(words("export.earlier"), "h2")
            if not rows:
                text(words("export.none"), classes="ps-dim")
                return
            keys = ("name", "network", "data", "made", "last_proof")
            table(words("export.earlier_caption"), [words(f"export.{k}") for k in keys], rows)
