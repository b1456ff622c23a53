"""Build the publish page, which turns a data set into a validated package on this computer."""

from __future__ import annotations

from pathlib import Path

from nicegui import run, ui

from plushsense.core.errors import ConfigError
from plushsense.dataset.store import Dataset
from plushsense.studio.app.choices import Choices
from plushsense.studio.app.jobs import StudioJob
from plushsense.studio.app.shell import Page, button, query, query_path, tag
from plushsense.studio.app.words import Texts
from plushsense.studio.app.workspace import PACKAGES, plain_name
from plushsense.studio.pages.publish.packages import KEYS, DatasetFacts, PackagesSection, missing_extras
from plushsense.studio.pages.publish.statements import StatementsForm, ask_again, beside, watched
from plushsense.studio.widgets.elements import WorkPanel, facts, notice, scroll_to, style, text, titles

_STAGE_TEXTS: Texts = {
    "begin": "Starting …",
    "recognising": "Testing whether people can be recognised …",
    "writing": "Writing the package …",
}

_SWITCHES: Texts = {
    "streams": "Also publish whole sessions",
    "excluded": "Also publish excluded recordings",
    "reidentification": "Test whether people can be recognised",
}

_SWITCHES_ABOUT: Texts = {
    "streams": "They contain everything between the gestures. Leave them out if the consent does not cover that.",
    "excluded": "They are marked. If whole sessions are published, these contain the rows in any case.",
    "reidentification": (
        "A simple program tries to recognise people by their touch. The package states how often it was right."
    ),
}

_MAX_CODES = 5
# For the explanation below a checkbox.
_BELOW = "margin: -12px 0 0 40px"
_TASKS = ("publish", "validate")
_STAGES = {"recognising people": "recognising", "writing": "writing"}


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
        about = words(
            "Makes a package of a data set that others can use, and checks it with the validators of each format."
        )
        text(about, classes="ps-dim")
        with ui.row().classes("ps-message ps-message-warning w-full items-center no-wrap"):
            ui.icon("lock").props('aria-hidden="true"')
            danger = words(
                "Nothing is uploaded. The package stays on this computer until you give it to somebody, and a copy "
                "that you gave away cannot be called back. Publish only what the consent forms allow."
            )
            tag(text(danger), "danger")
        if "publish" in self.lacking:
            advice = words(
                "The validators are not installed, so nothing can be published or checked. Run  pip install "
                "'plushsense[publish]'  and start the studio again."
            )
            tag(notice(advice, "error"), "missing-publish")
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
            text(words("New package"), "h2")
            if not options:
                none = words("There is no data set yet. Record a session, or import recordings on the home page.")
                tag(text(none), "no-dataset")
                return
            first = query_path(self.workspace, "dataset", options)
            select = ui.select(options, value=first, label=words("Data set"), on_change=lambda e: self._choose(e.value))
            tag(select.classes("w-full"), "dataset")
            self._rest = ui.column().classes("w-full")
            await self._choose(first)

    async def _choose(self, path: str) -> None:
        words = self.words
        chosen = await run.io_bound(lambda: DatasetFacts.of(Path(path)))
        assert chosen is not None
        self.dataset = chosen
        self.workspace.part(Choices).keep(dataset=path)
        self._rest.clear()
        with self._rest:
            if chosen.dataset is None:
                problem = words.error(chosen.problem) if chosen.problem is not None else ""
                tag(notice(problem, "error"), "dataset-problem")
                return
            if chosen.dataset.head.simulated:
                notice(words("Simulation: these data say nothing about a real toy."))
            tag(facts(self._facts_of(chosen.dataset)), "dataset-facts")
            self.statements = StatementsForm(self.page, chosen.path, chosen.dataset.head)
            self._choices(chosen)
            name = ui.input(words("Name of the package"), value=self._free_name(chosen.path.name)).props("maxlength=64")
            self._name = watched(tag(name.classes("w-full"), "name"))
            with ui.row().classes("w-full ps-bottom"):
                self._button = button("do", words("Make the package"), self._start, "", icon="inventory_2")
        self._allow()

    def _facts_of(self, dataset: Dataset) -> list[tuple[str, str]]:
        words, recordings = self.words, len(dataset.recordings)
        counts = words("{n}, {x} of them excluded", n=recordings, x=recordings - len(dataset.used))
        return [
            (words("Name"), dataset.head.name),
            (words("Version"), dataset.head.version),
            (words("People"), str(len(dataset.subjects))),
            (words("Recordings"), counts),
            (words("Whole sessions"), str(len(dataset.streams))),
            (words("Folder"), str(dataset.path)),
        ]

    def _choices(self, chosen: DatasetFacts) -> None:
        words = self.words
        text(words("Choices"), "h3")
        self._switches: dict[str, ui.checkbox] = {}
        for key in _SWITCHES:
            box = ui.checkbox(words(_SWITCHES[key]), value=key in ("streams", "reidentification"))
            self._switches[key] = tag(box, f"with-{key}")
            text(words(_SWITCHES_ABOUT[key]), classes="ps-dim").style(_BELOW)
        if "baselines" in self.lacking:
            self._switches["reidentification"].set_value(False)
            self._switches["reidentification"].set_enabled(False)
            advice = words(
                "Re-identification cannot be tested. Run  pip install 'plushsense[baselines]'  and start the studio "
                "again. Without the test, the package says that it was not made."
            )
            tag(notice(advice), "missing-baselines")
        if chosen.own_codes:
            codes = ", ".join(chosen.own_codes[:_MAX_CODES]) + (" …" if len(chosen.own_codes) > _MAX_CODES else "")
            simulated = chosen.dataset is not None and chosen.dataset.head.simulated
            advice = words(
                "The codes of the people ({codes}) were not drawn at random. If they are names, or if others know "
                "who is who, give the people new codes.",
                codes=codes,
            )
            tag(notice(advice, "info" if simulated else "warning"), "advice")
        self._pseudonyms = tag(ui.checkbox(words("Give the people new random codes")), "with-pseudonyms")
        self._pseudonyms.on_value_change(self._require_key)
        about = words(
            "Who has which code is in the key file. Move it to a safe place apart from the data, and keep a second "
            "copy: it is not part of any backup. Never publish it."
        )
        text(about, classes="ps-dim").style(_BELOW)
        self._keep = tag(ui.checkbox(words("Shift the dates of later versions in the same way")), "with-key")
        about = words(
            "The shifts come from a secret key, which is kept. Otherwise they are drawn again each time and not stored."
        )
        text(about, classes="ps-dim").style(_BELOW)
        field = ui.input(words("Key file"), value=f"{chosen.path.name}.key").props("maxlength=64").classes("w-full")
        self._key = watched(tag(field.bind_visibility_from(self._keep, "value"), "key"))
        where = words(
            "Key files are in {folder}, outside of data sets and packages. An existing key file is used again.",
            folder=str(self.workspace.folder / KEYS),
        )
        text(where, classes="ps-dim").bind_visibility_from(self._keep, "value")

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
                    raise ConfigError(
                        "“{name}” exists already. Give another name; nothing is replaced.", name=packed.name
                    )
            with beside(words, self._key):
                key = self._key_path((self._key.value or "").strip()) if self._keep.value else key
            if ask_again(self.page, (self._name, self._key)):
                return
            spec = {
                "dataset": str(dataset),
                "place": str(place),
                **{key: bool(box.value) for key, box in self._switches.items()},
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

    # Jobs -----------------------------------------------------------------------------------------------------

    def _progress_text(self, job: StudioJob) -> str:
        words, stage = self.words, str(job.progress.get("stage", ""))
        total = job.progress.get("total") or 0
        of = f" {words('({done} of {total})', done=job.progress.get('done', 0), total=total)}" if total else ""
        if stage.startswith("validating"):
            return f"{words('Running the validators … {name}', name=stage.partition(': ')[2])}{of}"
        known = _STAGES.get(stage, "begin")
        return f"{words(_STAGE_TEXTS[known])}{of}"

    async def _ended(self, job: StudioJob) -> None:
        name = Path(job.spec["place"]).name
        if job.task == "publish":
            good = bool(job.result["valid"])
            message = (
                "The package “{name}” is made, and all validators accept it."
                if good
                else "The package “{name}” is made, but some validators reject it: see below. It was not packed as a "
                "zip."
            )
            self.page.say(self.words(message, name=name), "good" if good else "error")
            if hasattr(self, "_name"):
                self._name.set_value(self._free_name(name))
        await self.packages.show(name.removesuffix(".zip") if job.task == "validate" else name)
        await self.packages.refresh()
        scroll_to("package")
