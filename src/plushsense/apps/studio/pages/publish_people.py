"""The publish page's forms about people: what must be said before publishing, and pseudonyms."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui

from plushsense.apps.studio.house import DATASETS
from plushsense.apps.studio.jobs import Jobs
from plushsense.apps.studio.packages import KEYS, DatasetFacts
from plushsense.apps.studio.pages.export_shown import text
from plushsense.apps.studio.shell import Page, tag
from plushsense.dataset.publish.licences import LICENCES

_SHOWN = 5


class Statements:
    """Licence, contact and consent: as the data set has them, or as somebody said them last time."""

    def __init__(self, page: Page, found: DatasetFacts) -> None:
        self.page, self.words, self.found = page, page.words, found

    def build(self) -> None:
        words, found = self.words, self.found
        last = next(
            (j.spec for j in self.page.house.part(Jobs).all("publish") if j.spec["dataset"] == str(found.path)), {}
        )
        name, _, mail = str(last.get("contact", "")).rstrip(">").partition(" <")
        text(words("publish.statements"), "h3")
        lacking = [
            words(f"publish.lacks_{key}")
            for key, there in (("licence", found.licence), ("contact", found.contact_mail), ("consent", found.consent))
            if not there
        ]
        said = words("publish.lacks", what=", ".join(lacking)) if lacking else words("publish.lacks_nothing")
        tag(text(said), "lacks")
        known = {s: s if s == each.title else f"{s}: {each.title}" for s, each in LICENCES.items()}
        value = found.licence or last.get("licence") or None
        if value is not None and value not in known:
            # One that the library will refuse stays to be seen.
            known[value] = value
        licence = ui.select(known, value=value, label=words("publish.licence"), with_input=False).classes("w-full")
        self._licence = tag(licence, "licence")
        text(words("publish.licence_about"), classes="ps-dim")
        with ui.row().classes("w-full"):
            who = ui.input(words("publish.contact_name"), value=found.contact_name or name).classes("col-grow")
            self._name = tag(who, "contact-name")
            where = ui.input(words("publish.contact_mail"), value=found.contact_mail or mail).classes("col-grow")
            self._mail = tag(where.props("type=email"), "contact-mail")
        text(words("publish.contact_about"), classes="ps-dim")
        consent = ui.textarea(words("publish.consent"), value=found.consent or last.get("consent", ""))
        self._consent = tag(consent.props("autogrow").classes("w-full"), "consent")
        text(words("publish.consent_about"), classes="ps-dim")
        self._save = tag(ui.checkbox(words("publish.save")), "save")

    def values(self) -> dict[str, Any]:
        """As arguments of `publish_dataset`."""
        name, mail = (self._name.value or "").strip(), (self._mail.value or "").strip()
        return {
            "licence": self._licence.value or "",
            "contact": f"{name} <{mail}>" if name or mail else "",
            "consent": (self._consent.value or "").strip(),
            "save": bool(self._save.value),
        }


class Pseudonyms:
    """The advice to take codes and dates apart from people first, and the form that does it.

    Args:
        start: called with the new data set's name, the key file's, words that may not be left, and whether notes go.
    """

    def __init__(
        self, page: Page, found: DatasetFacts, start: Callable[[str, str, list[str], bool], Awaitable[None]]
    ) -> None:
        self.page, self.words, self.found, self._start = page, page.words, found, start

    def build(self) -> None:
        words, found = self.words, self.found
        if not found.own_codes and not found.own_dates:
            tag(text(words("publish.renamed_already"), classes="ps-dim"), "renamed-already")
            return
        shown = ", ".join(found.own_codes[:_SHOWN]) + (" …" if len(found.own_codes) > _SHOWN else "")
        with tag(ui.column().classes("w-full"), "advice"):
            kind = "info" if found.simulated else "warning"
            said = words("publish.advice", codes=shown or "–")
            text(said, classes=f"ps-said ps-said-{kind} w-full")
        with tag(ui.expansion(words("publish.rename")).classes("w-full"), "rename"):
            text(words("publish.rename_about"))
            name = self._free(f"{found.path.name}-shared")
            self._name = tag(ui.input(words("publish.rename_name"), value=name).props("maxlength=64"), "rename-name")
            key = ui.input(words("publish.rename_key"), value=f"{found.path.name}-people.csv").props("maxlength=64")
            self._key = tag(key, "rename-key")
            for field in (self._name, self._key):
                field.classes("w-full")
            text(words("publish.key_place", folder=str(self.page.house.folder / KEYS)), classes="ps-dim")
            self._listed = tag(ui.textarea(words("publish.rename_words")).props("autogrow").classes("w-full"), "words")
            self._drop = tag(ui.checkbox(words("publish.rename_drop")), "drop-notes")
            text(words("publish.rename_safe"), classes="ps-said ps-said-warning w-full")
            do = ui.button(words("publish.rename_do"), icon="masks", on_click=self._go).props("outline no-caps")
            tag(do, "rename-do")

    def _free(self, name: str) -> str:
        number, free = 2, name
        while (self.page.house.folder / DATASETS / free).exists():
            number, free = number + 1, f"{name}-{number}"
        return free

    async def _go(self) -> None:
        listed = [line.strip() for line in (self._listed.value or "").splitlines() if line.strip()]
        name, key = (self._name.value or "").strip(), (self._key.value or "").strip()
        await self._start(name, key, listed, bool(self._drop.value))
