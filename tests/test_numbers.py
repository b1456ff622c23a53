"""The numbers page, and the figures that the README and other pages quote: those of docs/measurements/numbers.json."""

from __future__ import annotations

import copy
import re
from pathlib import Path

import measure
import pytest
from headlines import QUESTIONS, ROWS, Figures, Row, line, peer_ratios

NUMBERS = measure.known()
# Numbers in the README that are no measurement: a version of Python, the kind of network.
NAMES = {"3.11", "1D"}
DISTINCT = 5  # a number of so many digits is not that of a figure by chance
ANYWHERE = re.compile(rf"{measure.NUMBER}(?P<mark><!-- = )?")


def prose(text: str) -> str:
    """Return Markdown without code and without the targets of links."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.S | re.M)
    return re.sub(r"`[^`\n]*`|\]\([^)\n]*\)|^ {4}.*", "", text, flags=re.M)


def test_the_file_has_every_figure_of_every_row_and_where_it_is_from() -> None:
    assert list(NUMBERS) == list(ROWS)
    for name, row in ROWS.items():
        found = NUMBERS[name]
        assert row.question in QUESTIONS
        assert set(found["figures"]) == {key for line in row.lines for key in line.keys}, name
        assert re.fullmatch(r"[0-9a-f]{8}", found["commit"]), f"{name}: commit the changes of src, and measure it again"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", found["date"]) and found["machine"]
        assert set(found["seeds"]) <= set(row.seeds)
    peers = {key: figure["value"] for key, figure in NUMBERS["peers"]["figures"].items()}
    assert peers == pytest.approx(peer_ratios()), "run  make bench ROWS=peers"


def test_the_page_is_that_of_the_file() -> None:
    assert measure.PAGE.read_text("utf-8") == measure.page(NUMBERS), "run  python bench/measure.py --page"


def test_quotes_are_those_of_the_file() -> None:
    texts = {
        measure.bare(measure.text_of(value, line)): f"{name}.{key}"
        for name, row in ROWS.items()
        for line in row.lines
        for key in line.keys
        if (value := NUMBERS[name]["figures"][key]["value"]) is not None
    }
    for path in measure.quoting():
        text = path.read_text("utf-8")
        assert measure.requoted(text, NUMBERS) == text, f"{path.name}: run  python bench/measure.py --page"
        for match in ANYWHERE.finditer(prose(text)):
            number = measure.bare(match[0].removesuffix("<!-- = "))
            if match["mark"] is None and sum(map(str.isdigit, number)) >= DISTINCT:
                assert number not in texts, f"{path.name}: write {match[0]}<!-- = {texts[number]} -->, to keep it true"


def test_the_readme_has_no_other_figures() -> None:
    text = prose((measure.ROOT / "README.md").read_text("utf-8"))
    assert "<!-- = " in text
    left = measure.QUOTE.sub("", text)
    assert set(re.findall(r"(?<![\w.])\d[\w.,%]*(?<![.,])", left)) <= NAMES


def test_a_quote_follows_its_figure() -> None:
    numbers = copy.deepcopy(NUMBERS)
    numbers["chip-default"]["figures"]["flash.xtensa"]["value"] = 22_512
    numbers["strangers"]["figures"]["accuracy"]["value"] = 0.7504
    same = "It takes 22,512<!-- = chip-default.flash.xtensa --> bytes, or 22 512<!-- = chip-default.flash.xtensa -->."
    assert measure.requoted(same, numbers) == same
    old = "All 27 people: 0.61<!-- = strangers.accuracy -->, not 0.61."
    assert measure.requoted(old, numbers) == "All 27 people: 0.750<!-- = strangers.accuracy -->, not 0.61."
    for bad, why in (
        ("0.1<!-- = strangers.height -->", "names no figure"),
        ("it <!-- = strangers.accuracy -->", "follow"),
    ):
        with pytest.raises(ValueError, match=why):
            measure.requoted(bad, numbers)


def test_a_stopped_run_goes_on_and_seeds_are_joined(tmp_path: Path) -> None:
    measured: list[int | None] = []

    def measure_one(place: measure.Workplace, seed: int | None) -> Figures:
        measured.append(seed)
        return {
            "plain": 4,
            "other": 5,
            "scored": {"value": 0.5 + 0.1 * (seed or 0), "people_sd": 0.2, "ci95": [0.4, 0.6]},
        }

    row = Row(QUESTIONS[0], "data", measure_one, (line("both", "plain scored", ".2f"),), 1, (0, 1))
    for seeds in ((0,), (0, 1)):
        place = measure.Workplace(tmp_path, "abcdef01")
        results = [place.measured("row", row, seed, again=False) for seed in seeds]
    assert measured == [0, 1]
    found = measure.record(row, results, [0, 1], place.commit)
    assert set(found["figures"]) == {"plain", "scored"}
    scored = found["figures"]["scored"]
    assert scored["value"] == pytest.approx(0.55) and scored["seeds_sd"] == pytest.approx(0.1 / 2**0.5)
    assert measure.spread_of([scored], row.lines[0]) == "± 0.20 over people, ± 0.07 over seeds"
    assert measure.spread_of([{"value": 4}, {"value": 5, "range": [3, 6]}], row.lines[0]) == "— / 3.00 to 6.00"
    assert measure.spread_of([{"value": 4}], row.lines[0]) == ""
    assert found["commit"] == "abcdef01" and found["note"] == ""
    place.measured("row", row, 1, again=True)
    measure.Workplace(tmp_path, "another1").measured("row", row, 1, again=False)
    assert measured == [0, 1, 1, 1]
