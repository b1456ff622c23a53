"""The report is one file, complete in itself, honest about leaks and simulations."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from plushsense.core.errors import ConfigError
from plushsense.reports.evaluation import render, write_evaluation_report

pytestmark = pytest.mark.slow

VOID = {"meta", "img", "br"}


class Reader(HTMLParser):
    """Checks that tags close in order; collects the text and the addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.said: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "data", "action")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.said.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.said))


def read(study, **changes) -> Reader:
    reader = Reader()
    reader.feed(render(**{**study, **changes}))
    assert not reader.open
    return reader


def test_it_asks_for_nothing_outside_itself(tmp_path, study):
    page = write_evaluation_report(tmp_path / "deep" / "report.html", **study).read_text(encoding="utf-8")
    reader = Reader()
    reader.feed(page)
    assert all(a.startswith(("#E", "data:image/svg+xml;base64,")) for a in reader.addresses)
    assert "http" not in re.sub(r"http-equiv", "", page) and "<script" not in page and "@import" not in page
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["report.html"]


def test_it_says_what_a_researcher_looks_for(study):
    text = read(study).text
    for said in (
        "E1",
        "E3",
        "P25",
        "Tail scratch 2",
        "never saw the person",
        "Other whole people validate",
        "trained on loops",
        "Macro-F1, all classes (as the paper)",
        "Confusion by gesture",
        "Confusion by affect",
        "95 % interval",
        "Vote by recording",
        "nobody",
        "33 520",
        "247 samples = 2.47 s",
        "17",
        "not a medical device",
        "convention",
    ):
        assert said.replace(" ", "") in re.sub(r"\s", "", text), said


def test_a_leak_is_marked_only_where_there_is_one(study):
    leaky = read(study).text
    assert leaky.count("This split leaks") == 1 and leaky.count("LEAKY") == 4
    assert "LEAKY" not in read(study, evaluations=study["evaluations"][:2]).text


def test_a_simulation_is_said_on_top_and_at_every_table_of_scores(study):
    simulated, real = read(study).text, read(study, simulated=False).text
    assert simulated.index("These scores are of a simulation") < simulated.index("side by side")
    assert simulated.count("say nothing about a real toy") == 1 + 2 + 3 * 5 + 1, "the curves of one evaluation"
    assert "imulation" not in real and "real toy" not in real


def test_every_text_is_escaped(study):
    evil = "<script>alert('x')</script>&\"$\\frac"
    case = study["evaluations"][0]
    case |= {"model": evil, "split": evil, "predictions": evil}
    case["per_class"][0]["label"] = evil
    case["confusion"]["labels"][0] = evil
    case["subjects"][0]["subject"] = evil
    changed = {
        "title": evil,
        "dataset": {"name": evil, evil: evil},
        "evaluations": [case],
        "models": [{"symbol": evil, "provenance": {evil: evil}}],
    }
    page = render(**{**study, **changed})
    assert "<script" not in page and "&lt;script&gt;" in page
    Reader().feed(page)


def test_missing_keys_are_dashes(study):
    reader = read(
        study,
        title="",
        dataset={},
        evaluations=[{}, {"folds": None, "accuracy": None, "by_context": {}}],
        models=[{}],
    )
    assert "—" in reader.text and "None" not in reader.text and "nan" not in reader.text
    assert read(study, evaluations=[], models=[]).text


def test_one_affect_makes_no_matrix(study):
    case = study["evaluations"][0]
    case["confusion_affect"] = {"labels": ["none"], "counts": [[9]]}
    assert "Confusion by affect" not in read(study, evaluations=[case]).text


def test_a_place_that_cannot_be_written_is_one_sentence(tmp_path, study):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match=r"cannot be written"):
        write_evaluation_report(tmp_path / "file" / "report.html", **study)


def section(page: str, key: str) -> str:
    """The part of a page about one evaluation."""
    return page.split(f'<h2 id="{key}">')[1].split('<h2 id="')[0]


def row(page: str, key: str) -> str:
    """The row of the comparison for one evaluation."""
    return page.split(f'<tr><td><a href="#{key}">')[1].split("</tr>")[0]


def test_a_simulated_evaluation_of_a_real_data_set_is_marked_and_only_it(study):
    cases = study["evaluations"]
    cases[1]["simulated"] = True
    page = render(**{**study, "simulated": False})
    assert "A part of this page is of a simulation" in page
    assert "These scores are of a simulation" not in page
    assert ["SIMULATION" in row(page, key) for key in ("E1", "E2", "E3")] == [False, True, False]
    assert ["nothing about a real toy" in section(page, key) for key in ("E1", "E2")] == [False, True]
    cases[1] |= {"simulated": None, "dataset": {"simulated": True}}
    assert "SIMULATION" in row(render(**{**study, "simulated": False}), "E2"), "its data set says it"
    cases[1]["dataset"]["simulated"] = False
    mixed = render(**study)
    assert ["SIMULATION" in row(mixed, key) for key in ("E1", "E2")] == [True, False], "a real one among virtual ones"


def test_a_model_of_a_simulation_is_marked(study):
    study["models"][0]["provenance"]["simulated"] = True
    page = render(**{**study, "simulated": False})
    assert "A part of this page" in page and "trained on a virtual toy" in page
    assert "SIMULATION" not in row(page, "E1")


def test_an_evaluation_of_other_data_says_so(study):
    same, other = study["evaluations"][:2]
    same["dataset"] = {"name": "virtual-plush", "hash": study["dataset"]["hash"]}
    other["dataset"] = {"name": "an older one", "hash": "0" * 64}
    page = render(**study)
    assert ["OTHER DATA" in row(page, key) for key in ("E1", "E2", "E3")] == [False, True, False]
    assert "an older one" in section(page, "E2") and "are not of the data" in section(page, "E2")
    assert "Other data" not in section(page, "E1") + section(page, "E3")


def test_a_spread_is_said_to_be_over_what_it_is(study):
    people, _, folds = study["evaluations"]
    people["over"], folds["over"] = "subjects", "folds"
    folds["folds"] = folds["folds"][:5]
    page = render(**study)
    assert ">25 people<" in row(page, "E1") and ">5 folds<" in row(page, "E3")
    first, last = section(page, "E1"), section(page, "E3")
    assert "deviation over 25 people" in first and "too narrow" not in first
    assert "deviation over 5 folds" in last and "too narrow" in last and "over 25 people" not in last
    assert "all classes (as the paper), over 25 folds" in first
    assert "all classes (as the paper), over 5 folds" in last
