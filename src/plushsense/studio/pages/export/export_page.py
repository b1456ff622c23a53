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
from plushsense.deploy.web import PAGE
from plushsense.models.bundle import Bundle
from plushsense.studio.app.guard import download_address, page_address, path_in
from plushsense.studio.app.jobs import Jobs, StudioJob
from plushsense.studio.app.shell import (
    Page,
    address,
    button,
    html,
    moment,
    query,
    query_path,
    reveal,
    set_address,
    tag,
)
from plushsense.studio.app.stored_results import StoredResults, recommended
from plushsense.studio.app.words import Texts, Words, in_context
from plushsense.studio.app.workspace import EXPORTS, plain_name
from plushsense.studio.pages.export.exports import BundleFacts, ExportFacts, exports_of, formats, newest_job, targets
from plushsense.studio.widgets.elements import (
    WorkPanel,
    errors_beside,
    facts,
    link,
    notice,
    size,
    style,
    summary,
    table,
    text,
    titles,
    verdict,
)
from plushsense.studio.widgets.verdict import figures, show_choice

_NEXT_STEPS: Texts = {
    "arduino": "Arduino and PlatformIO: copy the folder {arduino} to the libraries. An example is in {sketch}.",
    "idf": "ESP-IDF: the component is {idf}; {example} is a complete project.",
    "plain": "Any other C99 compiler: compile plushsense.h, plushsense.c, plush_model.h and plush_model.c.",
    "read": "README.md in the export describes how to pass frames, what is returned, and what is required.",
}

_STAGES: Texts = {
    "begin": "Starting …",
    "export": "Writing the C and the golden vectors …",
    "profile": "Measuring the cost of a step …",
    "vectors": "Computing the expected answers …",
    "verify": "Compiling and running …",
}

_FITS_TEXTS: Texts = {"yes": "yes", "no": "no", "unsure": "not sure"}
_FITS = {"yes": True, "no": False, "unsure": None}


def show_cost(page: Page, work: WorkPanel, export: ExportFacts, counted: StudioJob | None) -> None:
    """Build the card with the cost of an export; ``counted`` is the job that measured it, if any."""
    words = page.words
    profile: dict[str, Any] = counted.result.get("profile", {}) if counted else {}
    current = profile.get("digest") == export.digest

    async def start() -> None:
        await work.start("profile", {"place": str(export.folder)})

    with tag(ui.column().classes("ps-card w-full"), "cost"), _folded(words("Cost of a step")):
        if not profile:
            text(words("Not measured yet."))
        elif not current:
            notice(words("The files have changed since the measurement. Measure again."))
        elif "refused" in profile:
            tag(notice(words.sentence(profile["refused"])), "cost-refused")
        else:
            assert counted is not None
            _display_cost(words, profile, moment(counted.ended_s))
        if not current or "refused" in profile:
            button("count", words("Measure"), start)


def _display_cost(words: Words, profile: dict[str, Any], when: str) -> None:
    about = words(
        "An answer is due every {step} ms. Instructions are counted exactly, on emulators. Times are estimated from "
        "them, as a lower and an upper bound: nothing was measured on a real chip.",
        step=words.significant(profile["step_ms"], 3),
    )
    text(about, classes="ps-dim")
    rows = [
        (
            each["chip"],
            f"{each['mhz']}",
            words("{low} to {high}", low=words.significant(each["low"], 2), high=words.significant(each["high"], 2)),
            verdict(_FITS[each["fits"]], words(_FITS_TEXTS[each["fits"]])),
        )
        for each in profile["estimated_ms"].values()
    ]
    if rows:
        head = words.each("Chip", "MHz", "ms per step, estimated", "In time?")
        tag(table(words("Estimated time of a step on real chips, {when}", when=when), head, rows, (1,)), "estimates")
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
        head = words.each(
            "Measured on", "Instructions per step", "Flash with code (bytes)", "RAM (bytes)", "Stack (bytes)"
        )
        caption = words("Measured on emulators, compiled with {optimise}", optimise=profile["optimise"])
        table(caption, head, counted, (1, 2, 3, 4))
    for name, packages in profile["missing"].items():
        text(_missing_target(words, TARGETS[name].title, packages), classes="ps-dim")


def _missing_target(words: Words, title: str, packages: Sequence[str]) -> str:
    return words(
        "Not available: {target}. It needs the Debian packages {packages}  (apt-get install {packages}).",
        target=title,
        packages=" ".join(packages),
    )


def show_facts(page: Page, export: ExportFacts, made: StudioJob | None) -> None:
    """Build the card with facts, files and download of an export; ``made`` is the job that wrote it, if known."""
    words, model = page.words, export.facts
    assert model is not None
    with tag(ui.column().classes("ps-card w-full"), "export-facts"):
        if model.simulated:
            notice(words("Simulation: these data say nothing about a real toy."))
        for warning in made.warnings if made else ():
            notice(words.sentence(warning))
        text(words("Give this file to the person who programs the toy."))
        download = ui.link(words("Download as a zip"), download_address(EXPORTS, export.name)).classes("ps-link")
        tag(download.props("download"), "download")
        if PAGE in export.files:
            text(words("This page reads a toy in Chrome or Edge. It needs neither PlushSense nor a network."))
            place = page_address(export.name)
            tag(ui.link(words("Open in the browser"), place, new_tab=True).classes("ps-link"), "open-page")
            saved = ui.link(words("Save the page"), place).classes("ps-link")
            saved.props["download"] = f"{export.name}.html"
            tag(saved, "save-page")
        with _folded(words("Details for the engineer")):
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
            (words("Network structure"), model.title),
            (words("Gestures"), str(model.classes)),
            (words("Sensors"), model.layout),
            *(
                (
                    words("Accelerometer at rest"),
                    words("about {value} {unit}", value=words.count(rest.value), unit=rest.unit),
                )
                for rest in model.rest
                if rest.steps
            ),
            (
                words("Flash for the network"),
                words("{n:,} bytes, without the code; see the cost below", n=model.flash_bytes),
            ),
            (words("RAM"), words("{n:,} bytes for each toy", n=model.ram_bytes)),
            (
                words("A step"),
                words("every {ms} ms, {macs:,} multiplications", ms=step, macs=model.macs_per_step),
            ),
            (words("Created"), moment(export.made_s)),
            (words("Folder"), str(export.folder)),
        ]
    )
    for name, each in model.conversions.items():
        apart = each.largest_difference
        message = words("{name}: {file}, {n:,} bytes.", file=each.file, n=each.bytes, name=name)
        if apart is not None:
            difference = words.significant(apart, 1)
            message += f" {words('Its outputs differ by up to {d} from those of the trained network.', d=difference)}"
        text(message)
    with ui.expansion(
        words("Files: {n}, {size}", n=len(export.files), size=size(sum(export.files.values()), words))
    ) as files:
        rows = [(name, words.count(bytes_)) for name, bytes_ in export.files.items()]
        table(words("Files of the export"), (words("File"), words("Size (bytes)")), rows, (1,))
    tag(files.classes("w-full"), "files")


def show_next(page: Page) -> None:
    """Build the card with the next steps for a firmware engineer."""
    words = page.words
    card = tag(ui.column().classes("ps-card w-full"), "next")
    with card, _folded(words("Next steps for the firmware engineer")), ui.element("ol").classes("ps-steps"):
        for step in _NEXT_STEPS.values():
            message = words(step, arduino=ARDUINO, sketch=SKETCH, idf=IDF, example=IDF_EXAMPLE)
            text(message, "li")


def verification_verdict(words: Words, export: ExportFacts, proof: StudioJob | None) -> Markup:
    """Render the outcome of the last verification: equal, unequal, outdated or never run."""
    if proof is None:
        return verdict(None, words("never verified"))
    if proof.result.get("digest") != export.digest:
        return verdict(None, words("changed since it was verified"))
    good, outcome = _outcome(words, proof.result)
    return verdict(good, f"{outcome}, {moment(proof.ended_s)}")


def _outcome(words: Words, result: dict[str, Any]) -> tuple[bool | None, str]:
    """Return whether a verification passed, and its text; None means it passed with C code changed by the user."""
    if not result["passed"]:
        return False, words("not equal")
    return (True, words("equal")) if result["own"] else (None, words("equal, but not our own code"))


class VerificationCard:
    """Card that verifies one export."""

    def __init__(self, page: Page, work: WorkPanel, export: ExportFacts) -> None:
        self.page, self.words, self.work, self.export = page, page.words, work, export
        self._chosen: dict[str, ui.checkbox] = {}

    async def build(self) -> ui.element:
        """Build the card, and return the element of its outcome."""
        words = self.words
        missing = await run.io_bound(targets) or {}
        with tag(ui.column().classes("ps-card w-full"), "proof") as card:
            text(words(in_context("heading", "Verify")), "h3")
            about = words(
                "The C code in this folder is compiled and run if it is exactly what this version of PlushSense writes "
                "for the network. Each answer is compared with that of the exact network, also in test scenarios, "
                "which use the same network with other decision rules."
            )
            text(about, classes="ps-dim")
            with ui.expansion(words("More settings")).classes("w-full"):
                with ui.row().classes("w-full"):
                    for name in (n for n, packages in missing.items() if not packages):
                        self._chosen[name] = ui.checkbox(self._title(name), value=not TARGETS[name].slow)
                        tag(self._chosen[name], f"target-{name}")
                for name, packages in missing.items():
                    if packages:
                        message = _missing_target(words, self._title(name), packages)
                        tag(text(message, classes="ps-dim"), f"missing-{name}")
                options = {"": words("No recordings, only the golden vectors and test scenarios")} | await titles(
                    self.page.workspace
                )
                self._dataset = ui.select(options, value="", label=words("Also stream the recordings of")).classes(
                    "w-full"
                )
                trust = words(
                    "Also compile and run C files that were changed or come from elsewhere (they can do anything on "
                    "this computer that you can do)"
                )
                self._trust = tag(ui.checkbox(trust), "trust")
            start = button("verify", words("Verify"), self._start, "", icon="fact_check")
            start.set_enabled(bool(self._chosen))
            proof = newest_job(self.page.workspace.part(Jobs), "verify", self.export.folder)
            return card if proof is None else self._display(proof)

    def _title(self, name: str) -> str:
        return self.words("This computer (gcc, clang, sanitizers)") if name == "host" else TARGETS[name].title

    async def _start(self) -> None:
        words, chosen = self.words, [name for name, box in self._chosen.items() if box.value]
        if not chosen:
            self.page.say(words("Choose at least one target."), "error")
            return
        if self.work.running("verify"):
            self.page.say(words("A verification is running already. Wait for it, or stop it."), "warning")
            return
        self.page.say("")
        with self.page.show_errors():
            dataset = str(self.page.workspace.inside(self._dataset.value)) if self._dataset.value else ""
            spec = {
                "place": str(self.export.folder),
                "targets": chosen,
                "dataset": dataset,
                "trust": bool(self._trust.value),
            }
            await self.work.start("verify", spec)

    def _display(self, proof: StudioJob) -> ui.element:
        words, result = self.words, proof.result
        with tag(ui.column().classes("w-full"), "verdict") as box:
            if result["digest"] != self.export.digest:
                when = moment(proof.ended_s)
                notice(words("The files have changed since this verification of {when}. Verify again.", when=when))
            good, outcome = _outcome(words, result)
            with ui.row().classes("items-center"):
                html(verdict(good, outcome))
                text(self._sum(result), "span")
            for sentence in self._sentences(result):
                notice(sentence, "error" if good is False else "warning")
            rows = [
                (
                    words("This computer") if r["target"] == "host" else self._title(r["target"]),
                    r["compiler"],
                    r["flags"],
                    words.count(r["vectors"]),
                    words.count(r["mismatches"]),
                    words.count(r["max_abs_diff"]),
                    verdict(not r["mismatches"], words("not equal" if r["mismatches"] else "equal")),
                )
                for r in result["runs"]
            ]
            caption = words("Compiled and run programs, {when}", when=moment(proof.ended_s))
            head = words.each("Target", "Compiler", "Flags", "Answers", "Different", "Largest difference", "Verdict")
            tag(table(caption, head, rows, (3, 4, 5)), "runs")
            counts = ("samples", "frames", "answers")
            streams = [(s["name"], *(words.count(s[key]) for key in counts)) for s in result["streams"]]
            caption = words(
                "Inputs of each program (scenario: the network with other rules; golden: the vectors of the export)"
            )
            head = words.each("Input", "Samples", "Frames", "Answers")
            tag(table(caption, head, streams, (1, 2, 3)), "streams")
            for each in result["not_run"]:
                why = words.sentence(each["why"])
                text(words("Not run: {what} ({why}).", what=each["what"], why=why), classes="ps-dim")
        return box

    def _sum(self, result: dict[str, Any]) -> str:
        total, unequal = result["vectors"], result["mismatches"]
        if not unequal:
            return self.words(
                "All {n:,} answers of {settings:program} are equal to the exact network's.",
                n=total,
                settings=len(result["runs"]),
            )
        return self.words("{bad:,} of {n:,} answers differ.", bad=unequal, n=total)

    def _sentences(self, result: dict[str, Any]) -> list[str]:
        words, sentences = self.words, []
        if result["first"]:
            sentences.append(
                words("The answers differ. The first difference, for the engineer: {where}", where=result["first"])
            )
        elif not result["decisions"]:
            sentences.append(
                words("Nothing is verified: in no answer had the toy finished warming up. Export the network again.")
            )
        if not result["own"]:
            sentences += [
                words(
                    "The code in this folder is not what this version of PlushSense writes for the .plush file in "
                    "it. Equal answers say nothing about what else it does. Export again to be sure."
                ),
                words("These files are not what PlushSense writes: {files}", files=", ".join(result["changed"])),
            ]
        return sentences


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
        about = self.words(
            "Put a trained network into a toy: the studio writes a folder for the person who programs the toy. "
            "Everything stays on this computer."
        )
        text(about, classes="ps-dim")
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
            text(words("New export"), "h2")
            if not bundles:
                tag(text(words("There is no network yet. Train one first.")), "no-bundle")
                ui.link(words("Train"), address("train")).classes("ps-link")
                return
            options = {str(p): self._label(p) for p in bundles}
            self._networks = await run.io_bound(self.workspace.part(StoredResults).networks) or {}
            first = query_path(self.workspace, "model", options, recommended(self._networks)) or None
            select = ui.select(options, value=first, label=words("Network"), on_change=lambda e: self._choose(e.value))
            tag(select.classes("w-full"), "bundle")
            self._state = ui.column().classes("w-full")
            self._name = tag(ui.input(words("Name")).props("maxlength=64").classes("w-full"), "name")
            self._button = button("do", words("Export"), self._start, "", icon="memory")
            with _folded(words("About this network")):
                self._about = tag(ui.column().classes("w-full"), "bundle-facts")
            with ui.expansion(words("More settings")).classes("w-full"):
                await self._more()
            await self._choose(first)

    def _label(self, path: Path) -> str:
        inside = self.workspace.folder in path.parents
        return str(path.relative_to(self.workspace.folder)) if inside else f"{path.name} ({path.parent})"

    async def _more(self) -> None:
        words = self.words
        extras = await run.io_bound(formats) or {}
        self._formats: dict[str, ui.checkbox] = {}
        text(words("Also for other runtimes"), "h3")
        about = words(
            "These formats compute a whole window for each answer. Each is tested in its own runtime before it is "
            "written."
        )
        text(about, classes="ps-dim")
        for name in (n for n, extra in extras.items() if not extra):
            self._formats[name] = tag(ui.checkbox(f"{name}: {CONVERTERS[name].holds}"), f"format-{name}")
        for extra in dict.fromkeys(e for e in extras.values() if e):
            missing = ", ".join(n for n, needed in extras.items() if needed == extra)
            about = words(
                "Not installed: {names}. Install with  pip install 'plushsense[{extra}]'", names=missing, extra=extra
            )
            text(about, classes="ps-dim")
        text(words("Calibration for 8 bits"), "h3")
        options = {"": words("From training, as stored in the network")} | await titles(self.workspace)
        self._dataset = ui.select(options, value="", label=words("Data set for the calibration")).classes("w-full")

    async def _choose(self, path: str | None) -> None:
        if path is None:
            with self._state:
                show_choice(self.words, self._networks, path)
            return
        chosen = await run.io_bound(lambda: BundleFacts.of(Path(path)))
        assert chosen is not None
        self.bundle = chosen
        self._state.clear()
        self._about.clear()
        with self._state:
            if chosen.bundle is None:
                tag(notice(self.words.sentence(chosen.problem or ""), "error"), "bundle-problem")
            else:
                show_choice(self.words, self._networks, path, "text-bold")
                if chosen.simulated:
                    notice(self.words("Simulation: these data say nothing about a real toy."))
                if chosen.cannot:
                    tag(notice(self.words.sentence(chosen.cannot), "error"), "bundle-cannot")
        if chosen.bundle is not None:
            with self._about:
                facts(self._facts_of(chosen.path, chosen.bundle, chosen.bytes))
        self._name.set_value(self._free_name(Path(path).stem))
        self._allow()

    def _free_name(self, stem: str) -> str:
        return self.workspace.free_name(EXPORTS, plain_name(stem, "export"))

    def _facts_of(self, path: Path, bundle: Bundle, bytes_: int) -> list[tuple[str, str]]:
        words, origin = self.words, bundle.provenance
        subjects, dataset = origin.get("subjects"), str(origin.get("dataset", ""))
        people = len(set(subjects) - {NOBODY, UNKNOWN_SUBJECT}) if isinstance(subjects, list) else int(subjects or 0)
        trained = words("{dataset}, people: {people}", dataset=dataset, people=people)
        network = words("{title}, padding {padding}", title=bundle.arch.title, padding=bundle.arch.padding)
        rows = [
            (words("Network structure"), network),
            (words("Gestures"), str(len(bundle.gestures.labels))),
            (words("Sensors"), bundle.layout.name),
            (words("Trained on"), trained if dataset else words("unknown")),
            (words("Adapted to"), bundle.adapted_to or ""),
            (words("Size"), size(bytes_, words)),
        ]
        score = self._networks.get(path)
        if score is None or score.accuracy is None:
            return [*rows, (words("Scores"), words("the network has no scores"))]
        return [*rows, (words("Scores"), figures(words, score))]

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
        count = f" {self.words('({done} of {total})', done=job.progress.get('done', 0), total=total)}" if total else ""
        return f"{self.words(_STAGES[stage])}{count}"

    async def _ended(self, job: StudioJob) -> None:
        name = Path(job.spec["place"]).name
        if job.task == "export":
            self.page.say(self.words("“{name}” is exported. Verify it before it goes into a toy.", name=name), "good")
            self._name.set_value(self._free_name(name))
        if job.task == "export" or name == self.open:
            await self._show(name, proof=job.task == "verify")
        await self._refresh_list()

    # One export -----------------------------------------------------------------------------------------------

    async def _show(self, name: str, proof: bool = False) -> None:
        """Show the details of an export, and reveal them or, with ``proof``, the outcome of its verification."""
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
                text(words("Export “{name}”", name=name), "h2")
                if export.problem:
                    notice(words.sentence(export.problem), "error")
                    reveal(self._detail)
                    return
                show_facts(
                    self.page,
                    export,
                    made if made and made.result.get("profile", {}).get("digest") == export.digest else None,
                )
                show_cost(self.page, self.work, export, counted)
                card = await VerificationCard(self.page, self.work, export).build()
                show_next(self.page)
            reveal(card if proof else self._detail)

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
                    words("simulation") if each.facts and each.facts.simulated else "",
                    moment(each.made_s) if each.made_s else "",
                    verification_verdict(words, each, proof),
                )
            )
        self._list.clear()
        with self._list:
            text(words("Exports"), "h2")
            if not rows:
                text(words("There are no exports yet."), classes="ps-dim")
                return
            head = words.each("Name", "Network structure", "Data", "Created", "Last verification")
            table(words("Exports of this studio, the newest first"), head, rows)
