"""Build the form for what a data set must state before it can be published, and store it in its ``dataset.toml``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from nicegui import run, ui

from plushsense.core.errors import PlushSenseError
from plushsense.dataset.about import Contact, Creator
from plushsense.dataset.files import change_head
from plushsense.dataset.publishing.description import LICENCES, find_licence
from plushsense.dataset.publishing.package import missing_statements
from plushsense.dataset.store import DatasetHead
from plushsense.studio.app.shell import Page, button, focus, heading, icon_button, tag
from plushsense.studio.app.words import Texts, Words
from plushsense.studio.widgets.elements import text

_ABOUT: Texts = {
    "title": "What others find and cite, such as “Touch on a plush companion”.",
    "description": "What was recorded, with whom and for what. No names of participants.",
    "licence": (
        "What others may do with the data. CC-BY-4.0 allows everything as long as they name you. Ask your "
        "institution which licence is allowed."
    ),
    "contact": "Whom users of the data may write to. Both are published.",
    "consent": "One or two sentences that are published unchanged; for children, what the parents signed. No names.",
}

_LACKS: Texts = {
    "licence": "licence",
    "contact": "contact",
    "consent": "consent statement",
    "title": "title",
    "description": "description",
    "creators": "authors",
}

_NEEDS: Texts = {
    "title": "Give a title.",
    "description": "Describe the data in one or two sentences.",
    "creators": "Name at least one author.",
    "licence": "Choose a licence.",
    "contact": "A name and an e-mail address are needed.",
    "consent": "State what the people consented to.",
}

Field = ui.input | ui.select | ui.textarea


@contextmanager
def beside(words: Words, field: Field) -> Iterator[None]:
    """Show an error that is raised in the block beside a field, until the field changes."""
    try:
        yield
    except PlushSenseError as refusal:
        field.error = words.error(refusal)


def watched(field: Field) -> Field:
    """Remove the error beside a field as soon as its value changes."""
    field.on_value_change(lambda: setattr(field, "error", None))
    return field


class _CreatorRow:
    """Fields of one person who is to be cited."""

    def __init__(self, words: Words, creator: Creator | None, removed: Any) -> None:
        self._words = words
        with ui.row().classes("w-full items-start no-wrap ps-small-gap") as self.box:
            with ui.row().classes("col items-start ps-small-gap"):
                self.name = _field("name", words("Family name, first name"), creator.name if creator else "")
                self.orcid = _field("orcid", words("ORCID iD (optional)"), creator.orcid if creator else "")
                where = creator.affiliation if creator else ""
                self.affiliation = _field("affiliation", words("Institution (optional)"), where)
            remove = icon_button("delete", words("Remove this author"), lambda: removed(self))
            tag(remove, "creator-remove")

    def creator(self) -> Creator | None:
        """Return the person; None if the row is empty or invalid, which the row then shows."""
        name, orcid, where = ((f.value or "").strip() for f in (self.name, self.orcid, self.affiliation))
        with beside(self._words, self.name if not name else self.orcid):
            return Creator(name, orcid.rpartition("/")[2], where) if name or orcid or where else None
        return None


def _field(name: str, label: str, value: str) -> ui.input:
    field = tag(ui.input(label, value=value).classes("ps-wide"), f"creator-{name}")
    watched(field)
    return field


def ask_again(page: Page, fields: Iterable[Field]) -> bool:
    """Move the focus to the first of ``fields`` with an error; return whether there is one."""
    wrong = next((field for field in fields if field.error), None)
    if wrong is not None:
        focus(wrong)
        page.say(page.words("Not yet: see what is missing beside the fields in red."), "error")
    return wrong is not None


class StatementsForm:
    """Fields for title, description, authors, licence, contact and consent of the data set in the folder ``path``."""

    def __init__(self, page: Page, path: Path, head: DatasetHead) -> None:
        words, about = page.words, head.about
        self._page, self._words, self._path = page, words, path
        text(words("About the data"), "h3")
        self._lacks = tag(text(""), "lacks")
        self._title = self._add("data_title", ui.input(words("Title"), value=about.title), "title")
        description = ui.textarea(words("Description"), value=about.description).props("autogrow")
        self._description = self._add("description", description)
        heading(words("Authors, as they are cited"), 4)
        self._list = tag(ui.column().classes("w-full ps-small-gap"), "creators")
        self._creators: list[_CreatorRow] = []
        for creator in about.creators or (None,):
            self._add_creator(creator)
        button("creator-add", words("Add an author"), self._add_creator, "outline dense", icon="add")
        heading(words("Licence"), 4)
        licences = {s: s if s == each.title else f"{s}: {each.title}" for s, each in LICENCES.items()}
        if head.licence:
            # Display a current licence even if it is not in the list and will be rejected.
            licences.setdefault(head.licence, head.licence)
        licence = ui.select(licences, value=head.licence or None, label=words("Licence"), with_input=False)
        self._licence = self._add("licence", licence)
        heading(words("Contact"), 4)
        self._name = self._add("contact_name", ui.input(words("Contact: name"), value=about.contact.name), "")
        mail = ui.input(words("Contact: e-mail"), value=about.contact.email).props("type=email")
        self._mail = self._add("contact_mail", mail, "contact")
        heading(words("Consent"), 4)
        consent = ui.textarea(words("What the people consented to"), value=head.consent).props("autogrow")
        self._consent = self._add("consent", consent)
        button("save", words("Save these statements"), self._save_part, icon="save")
        self._show_missing(missing_statements(head))

    def _add(self, name: str, field: Any, about: str | None = None) -> Any:
        """Add a field with its explanation, the text ``<about>_about``; "" for none, None for that of ``name``."""
        key = name if about is None else about
        watched(tag(field.classes("w-full"), name.replace("_", "-")))
        if key:
            text(self._words(_ABOUT[key]), classes="ps-dim ps-note")
        return field

    def _add_creator(self, creator: Any = None) -> None:
        with self._list:
            self._creators.append(
                _CreatorRow(self._words, creator if isinstance(creator, Creator) else None, self._drop)
            )

    def _drop(self, row: _CreatorRow) -> None:
        self._creators.remove(row)
        self._list.remove(row.box)
        if not self._creators:
            self._add_creator()

    @property
    def _fields(self) -> list[Field]:
        rows = [field for row in self._creators for field in (row.name, row.orcid)]
        return [self._title, self._description, *rows, self._licence, self._name, self._mail, self._consent]

    def _show_missing(self, missing: list[str]) -> None:
        listed = ", ".join(self._words(_LACKS[key]) for key in missing)
        self._lacks.set_content(
            self._words("The data set does not state yet: {what}.", what=listed)
            if missing
            else self._words("The data set states everything that is required.")
        )

    async def save(self, *, complete: bool = True) -> bool:
        """Store the fields in the data set; return False, with the reasons beside the fields, if one is invalid.

        Args:
            complete: whether missing statements are errors, too.
        """
        words = self._words
        for field in self._fields:
            field.error = None
        licence, contact = "", Contact()
        creators = tuple(c for row in self._creators if (c := row.creator()) is not None)
        with beside(words, self._licence):
            licence = find_licence(self._licence.value).spdx if self._licence.value else ""
        with beside(words, self._mail):
            contact = Contact((self._name.value or "").strip(), (self._mail.value or "").strip())
        title, description = (self._title.value or "").strip(), (self._description.value or "").strip()
        consent = (self._consent.value or "").strip()
        if ask_again(self._page, self._fields):
            return False

        def change(head: DatasetHead) -> DatasetHead:
            about = replace(head.about, title=title, description=description, creators=creators, contact=contact)
            return replace(head, about=about, licence=licence, consent=consent)

        head = await run.io_bound(change_head, self._page.workspace.inside(self._path), change)
        if head is None:
            return False  # the studio is ending
        missing = missing_statements(head)
        self._show_missing(missing)
        if complete:
            self._mark_missing(missing)
        return not complete or not ask_again(self._page, self._fields)

    def _mark_missing(self, missing: list[str]) -> None:
        places: dict[str, Field] = {
            "title": self._title,
            "description": self._description,
            "creators": self._creators[0].name,
            "licence": self._licence,
            "contact": self._mail if (self._name.value or "").strip() else self._name,
            "consent": self._consent,
        }
        for key in missing:
            places[key].error = self._words(_NEEDS[key])

    async def _save_part(self) -> None:
        with self._page.show_errors():
            if await self.save(complete=False):
                self._page.say(self._words("Saved in the data set. You can change it at any time."), "good")
