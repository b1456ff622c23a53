"""Build the publish page, which turns a data set into a validated package on this computer."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.core.errors import ConfigError
from plushsense.core.sentences import Sentence
from plushsense.dataset.store import Dataset
from plushsense.studio.app.jobs import StudioJob
from plushsense.studio.app.shell import Page, address, button, focus, query, tag
from plushsense.studio.app.workspace import DATASETS, PACKAGES, plain_name
from plushsense.studio.pages.publish.packages import KEYS, DatasetFacts, PackagesSection, missing_extras
from plushsense.studio.pages.publish.statements import Field, StatementsForm, beside, watched
from plushsense.studio.widgets.elements import WorkPanel, facts, notice, scroll_to, style, text, titles

_MAX_CODES = 5


class PseudonymsForm:
    """Advice to pseudonymise the data set, and the form that starts it.

    Args:
        start: called with the names of the new data set and the key file, the words to remove, and whether to drop
            notes.
    """

    def __init__(
        self, page: Page, chosen: DatasetFacts, start: Callable[[str, str, list[str], bool], Awaitable[None]]
    ) -> None:
        words, self._start = page.words, start
        simulated = chosen.dataset is not None and chosen.dataset.head.simulated
        if not chosen.own_codes and not chosen.own_dates:
            tag(text(words("publish.renamed_already"), classes="ps-dim"), "renamed-already")
            return
        codes = ", ".join(chosen.own_codes[:_MAX_CODES]) + (" …" if len(chosen.own_codes) > _MAX_CODES else "")
        with tag(ui.column().classes("w-full"), "advice"):
            notice(words("publish.advice", codes=codes or "–"), "info" if simulated else "warning")
        with tag(ui.expansion(words("publish.rename")).classes("w-full"), "rename"):
            text(words("publish.rename_about"))
            name = page.workspace.free_name(DATASETS, f"{chosen.path.name}-shared")
            self.name = tag(ui.input(words("publish.rename_name"), value=name).props("maxlength=64"), "rename-name")
            key = ui.input(words("publish.rename_key"), value=f"{chosen.path.name}-people.csv").props("maxlength=64")
            self.key = tag(key, "rename-key")
            for field in (self.name, self.key):
                watched(field.classes("w-full"))
            text(words("publish.key_place", folder=str(page.workspace.folder / KEYS)), classes="ps-dim")
            self._listed = tag(ui.textarea(words("publish.rename_words")).props("autogrow").classes("w-full"), "words")
            self._drop = tag(ui.checkbox(words("publish.rename_drop")), "drop-notes")
            notice(words("publish.rename_safe"))
            button("rename-do", words("publish.rename_do"), self._go, icon="masks")

    async def _go(self) -> None:
        listed = [line.strip() for line in (self._listed.value or "").splitlines() if line.strip()]
        name, key = (self.name.value or "").strip(), (self.key.value or "").strip()
        await self._start(name, key, listed, bool(self._drop.value))


_TASKS = ("publish", "validate", "pseudonymise")
_STAGES = {"recognising people": "recognising", "writing": "writing", "rewriting": "rewriting"}
_SWITCHES = ("streams", "excluded", "reidentification", "thorough")


async def show(page: Page) -> None:
    """Build the page. ``?dataset=PATH`` chooses a data set, ``?name=NAME`` opens a package."""
    await _Publishing(page).build()


class _Publishing:
    def __init__(self, page: Page) -> None:
        self.page, self.words, self.workspace = page, page.words, page.workspace
        self.query = query()
        self.dataset: DatasetFacts | None = None
        self.lacking: list[str] = missing_extras()

    async def build(self) -> None:
        words = self.words
        style()
        text(words("publish.about"), classes="ps-dim")
        with ui.row().classes("ps-message ps-message-warning w-full items-center no-wrap"):
            ui.icon("lock").props('aria-hidden="true"')
            tag(text(words("publish.danger")), "danger")
        if "publish" in self.lacking:
            tag(notice(words("publish.missing_publish"), "error"), "missing-publish")
        await self._form()
        self.work = WorkPanel(self.page, _TASKS, self._progress_text, self._ended, self._allow)
        self._allow()
        self.packages = PackagesSection(self.page, self.work, self.lacking)
        await self.packages.build(self.query.get("name", ""))

    # A new package --------------------------------------------------------------------------------------------

    async def _form(self) -> None:
        words = self.words
        options = await titles(self.workspace)
        with tag(ui.column().classes("ps-card w-full"), "new"):
            text(words("publish.new"), "h2")
            if not options:
                tag(text(words("publish.no_dataset")), "no-dataset")
                return
            dataset = self.query.get("dataset", "")
            first = dataset if dataset in options else next(iter(options))
            select = ui.select(
                options, value=first, label=words("publish.dataset"), on_change=lambda e: self._choose(e.value)
            )
            tag(select.classes("w-full"), "dataset")
            self._rest = ui.column().classes("w-full")
            await self._choose(first)

    async def _choose(self, path: str) -> None:
        words = self.words
        chosen = await run.io_bound(lambda: DatasetFacts.of(Path(path)))
        assert chosen is not None
        self.dataset = chosen
        self._rest.clear()
        with self._rest:
            if chosen.dataset is None:
                problem = words.error(chosen.problem) if chosen.problem is not None else ""
                tag(notice(problem, "error"), "dataset-problem")
                return
            if chosen.dataset.head.simulated:
                notice(words("shell.simulation"))
            tag(facts(self._facts_of(chosen.dataset)), "dataset-facts")
            self.pseudonyms = PseudonymsForm(self.page, chosen, self._pseudonymise)
            self.statements = StatementsForm(self.page, chosen.path, chosen.dataset.head)
            self._choices(chosen)
            name = ui.input(words("publish.name"), value=self._free_name(chosen.path.name)).props("maxlength=64")
            self._name = watched(tag(name.classes("w-full"), "name"))
            with ui.row().classes("w-full ps-bottom"):
                self._button = button("do", words("publish.do"), self._start, "", icon="inventory_2")
        self._allow()

    def _facts_of(self, dataset: Dataset) -> list[tuple[str, str]]:
        words, recordings = self.words, len(dataset.recordings)
        counts = words("publish.recordings_value", n=recordings, x=recordings - len(dataset.used))
        return [
            (words("publish.dataset_name"), dataset.head.name),
            (words("publish.version"), dataset.head.version),
            (words("publish.people"), str(len(dataset.subjects))),
            (words("publish.recordings"), counts),
            (words("publish.streams_count"), str(len(dataset.streams))),
            (words("publish.place"), str(dataset.path)),
        ]

    def _choices(self, chosen: DatasetFacts) -> None:
        words = self.words
        text(words("publish.choices"), "h3")
        self._switches: dict[str, ui.checkbox] = {}
        for key in _SWITCHES:
            box = ui.checkbox(words(f"publish.with_{key}"), value=key in ("streams", "reidentification"))
            self._switches[key] = tag(box, f"with-{key}")
            text(words(f"publish.with_{key}_about"), classes="ps-dim").style("margin: -12px 0 0 40px")
        if "baselines" in self.lacking:
            self._switches["reidentification"].set_value(False)
            self._switches["reidentification"].set_enabled(False)
            tag(notice(words("publish.missing_baselines")), "missing-baselines")
        self._columns: dict[str, ui.checkbox] = {}
        if chosen.columns:
            text(words("publish.columns"), classes="ps-dim")
            self._columns = {c: tag(ui.checkbox(c), f"column-{c}") for c in chosen.columns}
        self._keep = tag(ui.checkbox(words("publish.with_key")), "with-key")
        text(words("publish.with_key_about"), classes="ps-dim").style("margin: -12px 0 0 40px")
        field = ui.input(words("publish.key"), value=f"{chosen.path.name}.key").props("maxlength=64").classes("w-full")
        self._key = watched(tag(field.bind_visibility_from(self._keep, "value"), "key"))
        where = text(words("publish.key_place", folder=str(self.workspace.folder / KEYS)), classes="ps-dim")
        where.bind_visibility_from(self._keep, "value")

    def _free_name(self, stem: str) -> str:
        return self.workspace.free_name(PACKAGES, plain_name(stem, "package"), "", ".zip")

    def _allow(self) -> None:
        if hasattr(self, "_button") and hasattr(self, "work"):
            self._button.set_enabled("publish" not in self.lacking and not self.work.running("publish"))

    async def _start(self) -> None:
        chosen, words = self.dataset, self.words
        assert chosen is not None
        self.page.say("")
        with self.page.show_errors():
            dataset = self.workspace.inside(chosen.path)
            if not await self.statements.save():
                return
            place, key = Path(), Path()
            with beside(words, self._name):
                place = self.workspace.new(PACKAGES, self._name.value or "")
                if (packed := place.with_name(f"{place.name}.zip")).exists():
                    raise ConfigError(f"'{packed.name}' exists already.", reason="name_exists", name=packed.name)
            with beside(words, self._key):
                key = self._key_path((self._key.value or "").strip()) if self._keep.value else key
            if self._ask_again(self._name, self._key):
                return
            spec = {
                "dataset": str(dataset),
                "place": str(place),
                **{key: bool(box.value) for key, box in self._switches.items()},
                "columns": [name for name, box in self._columns.items() if box.value],
                "key": str(key) if self._keep.value else "",
            }
            await self.work.start("publish", spec)

    def _key_path(self, name: str) -> Path:
        """Return the path of the key file ``name``, which may exist; raise ConfigError for an invalid name."""
        path = self.workspace.folder / KEYS / name
        if name and path.parent == self.workspace.folder / KEYS and path.is_file():
            return self.workspace.inside(path)
        return self.workspace.new(KEYS, name)

    async def _pseudonymise(self, name: str, key: str, words: list[str], drop_notes: bool) -> None:
        chosen, form = self.dataset, self.pseudonyms
        assert chosen is not None
        self.page.say("")
        with self.page.show_errors():
            spec: dict[str, Any] = {"dataset": str(self.workspace.inside(chosen.path))}
            with beside(self.words, form.name):
                spec["place"] = str(self.workspace.new(DATASETS, name))
            with beside(self.words, form.key):
                spec["key"] = str(self._key_path(key))
            if not self._ask_again(form.name, form.key):
                await self.work.start("pseudonymise", spec | {"words": words, "drop_notes": drop_notes})

    def _ask_again(self, *fields: Field) -> bool:
        """Move the focus to the first of ``fields`` with an error; return whether there is one."""
        wrong = [field for field in fields if field.error]
        if wrong:
            focus(wrong[0])
            self.page.say(self.words("publish.see_fields"), "error")
        return bool(wrong)

    # Jobs -----------------------------------------------------------------------------------------------------

    def _progress_text(self, job: StudioJob) -> str:
        words, stage = self.words, str(job.progress.get("stage", ""))
        total = job.progress.get("total") or 0
        of = f" {words('publish.of', done=job.progress.get('done', 0), total=total)}" if total else ""
        if stage.startswith("validating"):
            return f"{words('publish.stage_validating', name=stage.partition(': ')[2])}{of}"
        known = _STAGES.get(stage, "begin")
        return f"{words(f'publish.stage_{known}')}{of}"

    async def _ended(self, job: StudioJob) -> None:
        if job.task == "pseudonymise":
            await self._renamed(job)
            return
        name = Path(job.spec["place"]).name
        if job.task == "publish":
            good = bool(job.result["valid"])
            message = self.words("publish.done" if good else "publish.done_invalid", name=name)
            self.page.say(message, "good" if good else "error")
            if hasattr(self, "_name"):
                self._name.set_value(self._free_name(name))
        await self.packages.show(name.removesuffix(".zip") if job.task == "validate" else name)
        await self.packages.refresh()
        scroll_to("package")

    async def _renamed(self, job: StudioJob) -> None:
        result = job.result
        self.page.say(self.words("publish.renamed", name=Path(job.spec["place"]).name, file=result["key"]), "good")
        with self.page._messages, tag(ui.column().classes("w-full"), "findings"):
            link = ui.link(self.words("publish.renamed_go"), address("publish", dataset=job.spec["place"]))
            tag(link.classes("ps-link"), "go-renamed")
            for finding in result["findings"]:
                where = [str(finding[k]) for k in ("file", "line") if finding[k]]
                times = [f"{finding['times']} ×"] if finding["times"] > 1 else []
                notice(": ".join([*where, *times, self.words.sentence(Sentence.from_dict(finding["sentence"]))]))
