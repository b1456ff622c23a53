"""Export: a bundle becomes a folder of C for the toy; what it costs there, and whether it gives the same answers."""

from __future__ import annotations

import json
from pathlib import Path
from urllib.parse import quote

from nicegui import context, run, ui

from plushsense.apps.studio.downloads import below
from plushsense.apps.studio.exports import BundleFacts, ExportFacts, exports_of, formats, newest
from plushsense.apps.studio.house import EXPORTS
from plushsense.apps.studio.jobs import Job, Jobs
from plushsense.apps.studio.pages.export_cost import show_cost
from plushsense.apps.studio.pages.export_one import show_facts, show_next
from plushsense.apps.studio.pages.export_proof import Proof, state_of
from plushsense.apps.studio.pages.export_shown import (
    Cell,
    WorkShown,
    facts,
    link,
    moment,
    scroll_to,
    size,
    style,
    table,
    text,
    titles,
)
from plushsense.apps.studio.shell import Page, tag
from plushsense.deploy.convert import CONVERTERS

_TASKS = ("export", "profile", "verify")


async def show(page: Page) -> None:
    """Build the page. ``?model=PATH`` chooses a bundle, ``?name=NAME`` opens an export."""
    await _Exporting(page).build()


class _Exporting:
    def __init__(self, page: Page) -> None:
        self.page, self.words, self.house = page, page.words, page.house
        request = context.client.request
        self.asked = dict(request.query_params) if request is not None else {}
        self.bundle: BundleFacts | None = None
        self.open = ""

    async def build(self) -> None:
        style()
        text(self.words("export.about"), classes="ps-dim")
        await self._form()
        self.work = WorkShown(self.page, _TASKS, self._said, self._ended, self._allow)
        self._allow()
        self._detail = tag(ui.column().classes("w-full"), "detail")
        self._list = tag(ui.column().classes("w-full"), "exports")
        name = self.asked.get("name", "")
        if name:
            await self._show(name)
        await self._refresh_list()

    # A new export ---------------------------------------------------------------------------------------------

    async def _form(self) -> None:
        words = self.words
        bundles = await run.io_bound(self.house.bundles) or []
        with tag(ui.column().classes("ps-card w-full"), "new"):
            text(words("export.new"), "h2")
            if not bundles:
                tag(text(words("export.no_bundle")), "no-bundle")
                ui.link(words("pages.train"), "/train").classes("ps-link")
                return
            named = {str(p): self._named(p) for p in bundles}
            wanted = self.asked.get("model", "")
            first = wanted if wanted in named else str(bundles[0])
            choice = ui.select(
                named, value=first, label=words("export.bundle"), on_change=lambda e: self._choose(e.value)
            )
            tag(choice.classes("w-full"), "bundle")
            self._about = tag(ui.column().classes("w-full"), "bundle-facts")
            self._name = tag(ui.input(words("export.name")).props("maxlength=64").classes("w-full"), "name")
            with ui.expansion(words("export.more")).classes("w-full"):
                await self._more()
            self._button = ui.button(words("export.do"), icon="memory", on_click=self._start).props("no-caps")
            tag(self._button, "do")
            await self._choose(first)

    def _named(self, path: Path) -> str:
        inside = self.house.folder in path.parents
        return str(path.relative_to(self.house.folder)) if inside else f"{path.name} ({path.parent})"

    async def _more(self) -> None:
        words = self.words
        lacking = await run.io_bound(formats) or {}
        self._formats: dict[str, ui.checkbox] = {}
        text(words("export.formats"), "h3")
        text(words("export.formats_about"), classes="ps-dim")
        for name in (n for n, lacks in lacking.items() if not lacks):
            self._formats[name] = tag(ui.checkbox(f"{name}: {CONVERTERS[name].holds}"), f"format-{name}")
        for extra in dict.fromkeys(e for e in lacking.values() if e):
            missing = ", ".join(n for n, lacks in lacking.items() if lacks == extra)
            text(words("export.format_missing", names=missing, extra=extra), classes="ps-dim")
        text(words("export.calibrate"), "h3")
        options = {"": words("export.calibrate_kept")} | await titles(self.house)
        self._dataset = ui.select(options, value="", label=words("export.calibrate_on")).classes("w-full")

    async def _choose(self, path: str) -> None:
        words = self.words
        found = await run.io_bound(lambda: BundleFacts.of(Path(path)))
        assert found is not None
        self.bundle = found
        self._about.clear()
        with self._about:
            if found.problem:
                tag(text(found.problem, classes="ps-said ps-said-error w-full"), "bundle-problem")
            else:
                if found.simulated:
                    text(words("shell.simulation"), classes="ps-said ps-said-warning w-full")
                facts(self._facts_of(found))
                if found.cannot:
                    tag(text(found.cannot, classes="ps-said ps-said-error w-full"), "bundle-cannot")
        self._name.set_value(self._free(Path(path).stem))
        self._allow()

    def _free(self, stem: str) -> str:
        """A name that is not taken."""
        plain = "".join(c if c.isalnum() or c in " ._-" else "-" for c in stem).strip(" .")[:56] or "export"
        number, name = 2, plain
        while (self.house.folder / EXPORTS / name).exists():
            number, name = number + 1, f"{plain}-{number}"
        return name

    def _facts_of(self, found: BundleFacts) -> list[tuple[str, str]]:
        words, scores = self.words, found.scores
        trained = words("export.trained_value", dataset=found.dataset, people=found.people)
        rows = [
            (words("export.network"), words("export.network_value", title=found.title, padding=found.padding)),
            (words("export.gestures"), str(len(found.gestures))),
            (words("export.layout"), found.layout),
            (words("export.trained_on"), trained if found.dataset else words("export.not_told")),
            (words("export.adapted_to"), found.adapted_to),
            (words("export.size"), size(found.bytes)),
        ]
        if not scores:
            return [*rows, (words("export.scores"), words("export.no_scores"))]
        value = words(
            "export.scores_value",
            accuracy=words.number(scores["accuracy"], 2),
            f1=words.number(scores.get("macro_f1", float("nan")), 2),
            windows=scores.get("windows", "?"),
            split=scores.get("split", "?"),
        )
        leaky = f" {words('export.leaky')}" if scores.get("leaky") else ""
        simulated = f" {words('export.simulated_scores')}" if found.simulated else ""
        return [*rows, (words("export.scores"), f"{value}{leaky}{simulated}")]

    def _allow(self) -> None:
        """The button, while nothing of the kind runs and the bundle is whole."""
        if hasattr(self, "_button") and hasattr(self, "work"):
            whole = self.bundle is not None and not self.bundle.problem
            self._button.set_enabled(whole and not self.work.running("export"))

    async def _start(self) -> None:
        self.page.say("")
        assert self.bundle is not None
        with self.page.refusing():
            bundle = self.house.inside(self.bundle.path)
            place = self.house.new(EXPORTS, self._name.value or "")
            dataset = str(self.house.inside(self._dataset.value)) if self._dataset.value else ""
            also = [name for name, box in self._formats.items() if box.value]
            spec = {"bundle": str(bundle), "place": str(place), "also": also, "dataset": dataset}
            await self.work.start("export", spec)

    # What runs ------------------------------------------------------------------------------------------------

    def _said(self, job: Job) -> str:
        stage, total = str(job.progress.get("stage", "begin")), job.progress.get("total") or 0
        of = f" {self.words('export.of', done=job.progress.get('done', 0), total=total)}" if total else ""
        return f"{self.words(f'export.stage_{stage}')}{of}"

    async def _ended(self, job: Job) -> None:
        name = Path(job.spec["place"]).name
        if job.task == "export":
            self.page.say(self.words("export.done", name=name), "good")
            self._name.set_value(self._free(name))
        if job.task == "export" or name == self.open:
            await self._show(name)
            scroll_to("verdict" if job.task == "verify" else "detail")
        await self._refresh_list()

    # One export -----------------------------------------------------------------------------------------------

    async def _show(self, name: str) -> None:
        words = self.words
        with self.page.refusing():
            folder = below(self.house, EXPORTS, name)
            found = await run.io_bound(lambda: ExportFacts.of(folder))
            assert found is not None
            jobs = self.house.part(Jobs)
            made = newest(jobs, "export", folder)
            counted = max(
                (j for j in (made, newest(jobs, "profile", folder)) if j is not None),
                key=lambda j: j.ended_s,
                default=None,
            )
            self.open = name
            ui.run_javascript(f"history.replaceState(null, '', {json.dumps(f'/export?name={quote(name)}')})")
            self._detail.clear()
            with self._detail:
                text(words("export.one", name=name), "h2")
                if found.problem:
                    text(found.problem, classes="ps-said ps-said-error w-full")
                    return
                show_facts(
                    self.page,
                    found,
                    made if made and made.result.get("profile", {}).get("digest") == found.digest else None,
                )
                show_cost(self.page, self.work, found, counted)
                await Proof(self.page, self.work, found).build()
                show_next(self.page)

    # All of them ----------------------------------------------------------------------------------------------

    async def _refresh_list(self) -> None:
        words = self.words
        folders = await run.io_bound(lambda: exports_of(self.house)) or []
        found = await run.io_bound(lambda: [ExportFacts.of(f) for f in folders]) or []
        jobs = self.house.part(Jobs)
        rows = []
        for each in found:
            proof = newest(jobs, "verify", each.folder)
            rows.append(
                (
                    link(each.name, f"/export?name={quote(each.name)}"),
                    each.problem or str(each.facts["title"]),
                    Cell(f"<span>{words('export.simulation_short')}</span>") if each.facts.get("simulated") else "",
                    moment(each.made_s) if each.made_s else "",
                    Cell(state_of(words, each, proof)),
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
