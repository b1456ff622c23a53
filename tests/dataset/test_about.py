from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.gestures import GestureSet
from plushsense.core.layouts import load_layout
from plushsense.dataset.about import About, Contact, Creator, Funding
from plushsense.dataset.store import HEAD, DatasetHead

FULL = About(
    title="Touch",
    description="Much\nof it.",
    keywords=("touch", "toy"),
    creators=(Creator("Curie, Marie", "0000-0002-1825-0097", "Paris"), Creator("A Lab")),
    contact=Contact("Desk", "desk@example.org"),
    publisher="A repository",
    doi="10.5281/zenodo.1",
    homepage="https://example.org",
    paper="10.1000/1",
    funding=(Funding("A fund", "17"), Funding("B")),
    collected="in a school",
    limits="none",
    language="de",
)


def head(about: About) -> DatasetHead:
    return DatasetHead("n", load_layout("accel-3"), GestureSet("g", ()), about=about)


@pytest.mark.parametrize("about", [About(), FULL, replace(FULL, creators=(), funding=())])
def test_the_head_keeps_it(tmp_path: Path, about: About) -> None:
    (tmp_path / HEAD).write_text(head(about).to_toml(), encoding="utf-8")
    assert DatasetHead.read(tmp_path).about == about


def test_an_older_head_opens(tmp_path: Path) -> None:
    text = head(About()).to_toml()
    assert "about" not in text
    (tmp_path / HEAD).write_text(text)
    assert DatasetHead.read(tmp_path).about == About()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('titel = "x"', "Unknown key 'titel'.*Did you mean 'title'"),
        ("title = 3", "title is 3: accepted is text"),
        ('keywords = "touch"', "keywords is 'touch': accepted is a list of texts"),
        ('creators = ["Marie"]', "creators.0. is 'Marie': accepted is a table"),
        ('creators = [{ orcid = "x" }]', "creators.0..name is missing"),
        ('creators = [{ name = " " }]', "a creator has no name"),
        ('creators = [{ name = "M", orcid = "0000-0002-1825-0098" }]', "is no ORCID iD"),
        ('creators = [{ name = "M", orchid = "0000-0002-1825-0097" }]', "Did you mean 'orcid'"),
        ('contact = { name = "M", email = "at home" }', "is no e-mail address"),
        ('contact = "M <m@example.org>"', "accepted is a table"),
        ('doi = "https://doi.org/10.5281/1"', "a bare DOI is accepted"),
        ('homepage = "example.org"', "begins with https://"),
        ('funding = [{ award = "1" }]', "funding.0..funder is missing"),
        ('language = "English please"', "a code like en is accepted"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / HEAD).write_text(head(About()).to_toml().replace("[layout]", f"[about]\n{line}\n\n[layout]", 1))
    with pytest.raises(DatasetError, match=said) as refused:
        DatasetHead.read(tmp_path)
    assert "dataset.toml" in str(refused.value)


def test_a_contact_on_the_command_line() -> None:
    assert Contact.parse(" Marie Curie <marie@example.org> ") == Contact("Marie Curie", "marie@example.org")
    for text in ("marie@example.org", "Marie", "Marie <marie>", "<marie@example.org>", ""):
        with pytest.raises(DatasetError, match="write it as"):
            Contact.parse(text)
    assert not Contact("Marie")
