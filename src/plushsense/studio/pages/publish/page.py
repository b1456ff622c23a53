"""Build the publish page, which turns a data set into a validated package on this computer."""

from __future__ import annotations

from pathlib import Path

from nicegui import run, ui

from plushsense.core.errors import ConfigError
from plushsense.dataset.store import Dataset
from plushsense.studio.app.jobs import StudioJob
from plushsense.studio.app.shell import Page, button, focus, query, tag
from plushsense.studio.app.workspace import PACKAGES, plain_name
from plushsense.studio.pages.publish.packages import KEYS, DatasetFacts, PackagesSection, missing_extras
from plushsense.studio.pages.publish.statements import Field, StatementsForm, beside, watched
from plushsense.studio.widgets.elements import WorkPanel, facts, notice, scroll_to, style, text, titles

_MAX_CODES = 5


_TASKS = ("publish", "validate")
_STAGES = {"recognising people": "recognising", "writing": "writing"}
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
        if chosen.own_codes:
            codes = ", ".join(chosen.own_codes[:_MAX_CODES]) + (" …" if len(chosen.own_codes) > _MAX_CODES else "")
            simulated = chosen.dataset is not None and chosen.dataset.head.simulated
            tag(notice(words("publish.advice", codes=codes), "info" if simulated else "warning"), "advice")
        self._pseudonyms = tag(ui.checkbox(words("publish.with_pseudonyms")), "with-pseudonyms")
        self._pseudonyms.on_value_change(self._require_key)
        text(words("publish.with_pseudonyms_about"), classes="ps-dim").style("margin: -12px 0 0 40px")
        self._keep = tag(ui.checkbox(words("publish.with_key")), "with-key")
        text(words("publish.with_key_about"), classes="ps-dim").style("margin: -12px 0 0 40px")
        field = ui.input(words("publish.key"), value=f"{chosen.path.name}.key").props("maxlength=64").classes("w-full")
        self._key = watched(tag(field.bind_visibility_from(self._keep, "value"), "key"))
        where = text(words("publish.key_place", folder=str(self.workspace.folder / KEYS)), classes="ps-dim")
        where.bind_visibility_from(self._keep, "value")

    def _require_key(self) -> None:
        """Keep the key if people get new codes, since it stores who has which code."""
        self._keep.set_value(self._keep.value or self._pseudonyms.value)
        self._keep.set_enabled(not self._pseudonyms.value)

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
                "pseudonyms": bool(self._pseudonyms.value),
            }
            await self.work.start("publish", spec)

    def _key_path(self, name: str) -> Path:
        """Return the path of the key file ``name``, which may exist; raise ConfigError for an invalid name."""
        path = self.workspace.folder / KEYS / name
        if name and path.parent == self.workspace.folder / KEYS and path.is_file():
            return self.workspace.inside(path)
        return self.workspace.new(KEYS, name)

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
