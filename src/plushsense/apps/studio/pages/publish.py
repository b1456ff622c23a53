"""Publish: a data set becomes a package that strangers can use, proved by validators. Nothing leaves by itself."""

from __future__ import annotations

from pathlib import Path

from nicegui import context, run, ui

from plushsense.apps.studio.house import DATASETS, PACKAGES
from plushsense.apps.studio.jobs import Job
from plushsense.apps.studio.packages import KEYS, DatasetFacts, missing_extras
from plushsense.apps.studio.pages.export_shown import WorkShown, facts, scroll_to, style, text, titles
from plushsense.apps.studio.pages.publish_package import Packages
from plushsense.apps.studio.pages.publish_people import Pseudonyms, Statements
from plushsense.apps.studio.shell import Page, tag
from plushsense.core.errors import ConfigError
from plushsense.dataset.publish.package import complete_head
from plushsense.dataset.store import DatasetHead

_TASKS = ("publish", "validate", "pseudonymise")
_STAGES = {"recognising people": "recognising", "writing": "writing", "rewriting": "rewriting"}
_SWITCHES = ("streams", "excluded", "bids", "reidentification", "thorough")


async def show(page: Page) -> None:
    """Build the page. ``?dataset=PATH`` chooses a data set, ``?name=NAME`` opens a package."""
    await _Publishing(page).build()


class _Publishing:
    def __init__(self, page: Page) -> None:
        self.page, self.words, self.house = page, page.words, page.house
        request = context.client.request
        self.asked = dict(request.query_params) if request is not None else {}
        self.dataset: DatasetFacts | None = None
        self.lacking: list[str] = missing_extras()

    async def build(self) -> None:
        words = self.words
        style()
        text(words("publish.about"), classes="ps-dim")
        with ui.row().classes("ps-said ps-said-warning w-full items-center no-wrap"):
            ui.icon("lock").props('aria-hidden="true"')
            tag(text(words("publish.danger")), "danger")
        if "publish" in self.lacking:
            tag(text(words("publish.missing_publish"), classes="ps-said ps-said-error w-full"), "missing-publish")
        await self._form()
        self.work = WorkShown(self.page, _TASKS, self._said, self._ended, self._allow)
        self._allow()
        self.packages = Packages(self.page, self.work, self.lacking)
        await self.packages.build(self.asked.get("name", ""))

    # A new package --------------------------------------------------------------------------------------------

    async def _form(self) -> None:
        words = self.words
        found = await titles(self.house)
        with tag(ui.column().classes("ps-card w-full"), "new"):
            text(words("publish.new"), "h2")
            if not found:
                tag(text(words("publish.no_dataset")), "no-dataset")
                return
            wanted = self.asked.get("dataset", "")
            first = wanted if wanted in found else next(iter(found))
            chosen = ui.select(
                found, value=first, label=words("publish.dataset"), on_change=lambda e: self._choose(e.value)
            )
            tag(chosen.classes("w-full"), "dataset")
            self._rest = ui.column().classes("w-full")
            await self._choose(first)

    async def _choose(self, path: str) -> None:
        words = self.words
        found = await run.io_bound(lambda: DatasetFacts.of(Path(path)))
        assert found is not None
        self.dataset = found
        self._rest.clear()
        with self._rest:
            if found.problem:
                tag(text(found.problem, classes="ps-said ps-said-error w-full"), "dataset-problem")
                return
            if found.simulated:
                text(words("shell.simulation"), classes="ps-said ps-said-warning w-full")
            tag(facts(self._facts_of(found)), "dataset-facts")
            Pseudonyms(self.page, found, self._pseudonymise).build()
            self.said = Statements(self.page, found)
            self.said.build()
            self._choices(found)
            name = ui.input(words("publish.name"), value=self._free(found.path.name)).props("maxlength=64")
            self._name = tag(name.classes("w-full"), "name")
            button = ui.button(words("publish.do"), icon="inventory_2", on_click=self._start).props("no-caps")
            self._button = tag(button, "do")
        self._allow()

    def _facts_of(self, found: DatasetFacts) -> list[tuple[str, str]]:
        words = self.words
        return [
            (words("publish.dataset_name"), found.name),
            (words("publish.version"), found.version),
            (words("publish.people"), str(found.people)),
            (words("publish.recordings"), words("publish.recordings_value", n=found.recordings, x=found.excluded)),
            (words("publish.streams_count"), str(found.streams)),
            (words("publish.place"), str(found.path)),
        ]

    def _choices(self, found: DatasetFacts) -> None:
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
            tag(text(words("publish.missing_baselines"), classes="ps-said ps-said-warning w-full"), "missing-baselines")
        self._columns: dict[str, ui.checkbox] = {}
        if found.columns:
            text(words("publish.columns"), classes="ps-dim")
            self._columns = {c: tag(ui.checkbox(c), f"column-{c}") for c in found.columns}
        self._keep = tag(ui.checkbox(words("publish.with_key")), "with-key")
        text(words("publish.with_key_about"), classes="ps-dim").style("margin: -12px 0 0 40px")
        field = ui.input(words("publish.key"), value=f"{found.path.name}.key").props("maxlength=64").classes("w-full")
        self._key = tag(field.bind_visibility_from(self._keep, "value"), "key")
        where = text(words("publish.key_place", folder=str(self.house.folder / KEYS)), classes="ps-dim")
        where.bind_visibility_from(self._keep, "value")

    def _free(self, stem: str) -> str:
        """A name that is not taken, neither by a folder nor by a zip."""
        plain = "".join(c if c.isalnum() or c in " ._-" else "-" for c in stem).strip(" .")[:56] or "package"
        number, name, root = 2, plain, self.house.folder / PACKAGES
        while (root / name).exists() or (root / f"{name}.zip").exists():
            number, name = number + 1, f"{plain}-{number}"
        return name

    def _allow(self) -> None:
        if hasattr(self, "_button") and hasattr(self, "work"):
            self._button.set_enabled("publish" not in self.lacking and not self.work.running("publish"))

    async def _start(self) -> None:
        found = self.dataset
        assert found is not None
        self.page.say("")
        with self.page.refusing():
            dataset = self.house.inside(found.path)
            place = self.house.new(PACKAGES, self._name.value or "")
            if place.with_name(f"{place.name}.zip").exists():
                raise ConfigError(f"'{place.name}.zip' is there already: give another name, nothing is replaced.")
            said = self.said.values()
            # Refused here and not only in the work, while the form is in sight.
            head = await run.io_bound(lambda: DatasetHead.read(dataset))
            assert head is not None
            complete_head(head, dataset, said["licence"], said["contact"], said["consent"])
            spec = {
                "dataset": str(dataset),
                "place": str(place),
                **said,
                **{key: bool(box.value) for key, box in self._switches.items()},
                "columns": [name for name, box in self._columns.items() if box.value],
                "key": str(self._key_place()) if self._keep.value else "",
            }
            await self.work.start("publish", spec)

    def _key_place(self) -> Path:
        """The key's file: a new one, or one of before."""
        name = (self._key.value or "").strip()
        there = self.house.folder / KEYS / name
        if name and there.parent == self.house.folder / KEYS and there.is_file():
            return self.house.inside(there)
        return self.house.new(KEYS, name)

    async def _pseudonymise(self, name: str, key: str, words: list[str], drop_notes: bool) -> None:
        found = self.dataset
        assert found is not None
        self.page.say("")
        with self.page.refusing():
            place, there = self.house.new(DATASETS, name), self.house.folder / KEYS / key
            one_of_before = key and there.parent == self.house.folder / KEYS and there.is_file()
            kept = self.house.inside(there) if one_of_before else self.house.new(KEYS, key)
            spec = {"dataset": str(self.house.inside(found.path)), "place": str(place), "key": str(kept)}
            spec |= {"words": words, "drop_notes": drop_notes}  # type: ignore[dict-item]
            await self.work.start("pseudonymise", spec)

    # What runs ------------------------------------------------------------------------------------------------

    def _said(self, job: Job) -> str:
        words, stage = self.words, str(job.progress.get("stage", ""))
        total = job.progress.get("total") or 0
        of = f" {words('publish.of', done=job.progress.get('done', 0), total=total)}" if total else ""
        if stage.startswith("validating"):
            return f"{words('publish.stage_validating', name=stage.partition(': ')[2])}{of}"
        known = _STAGES.get(stage, "begin")
        return f"{words(f'publish.stage_{known}')}{of}"

    async def _ended(self, job: Job) -> None:
        if job.task == "pseudonymise":
            await self._renamed(job)
            return
        name = Path(job.spec["place"]).name
        if job.task == "publish":
            good = bool(job.result["valid"])
            said = self.words("publish.done" if good else "publish.done_invalid", name=name)
            self.page.say(said, "good" if good else "error")
            if hasattr(self, "_name"):
                self._name.set_value(self._free(name))
        await self.packages.show(name.removesuffix(".zip") if job.task == "validate" else name)
        await self.packages.refresh()
        scroll_to("package")

    async def _renamed(self, job: Job) -> None:
        result = job.result
        self.page.say(self.words("publish.renamed", name=Path(job.spec["place"]).name, file=result["key"]), "good")
        with self.page._said, tag(ui.column().classes("w-full"), "findings"):
            link = ui.link(self.words("publish.renamed_go"), f"/publish?dataset={job.spec['place']}").classes("ps-link")
            tag(link, "go-renamed")
            for found in result["findings"]:
                where = [str(found[k]) for k in ("file", "line") if found[k]]
                text(": ".join([*where, found["message"]]), classes="ps-said ps-said-warning w-full")
