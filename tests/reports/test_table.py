"""Tables in every format, and the formats of their cells."""

from __future__ import annotations

import csv
import io
import math

import pytest

from plushsense.reports import table
from plushsense.reports.table import Column, Table

COLUMNS = (
    Column("name", "Name"),
    Column("n", "Windows", "count"),
    Column("accuracy", "Accuracy", "percent", score=True, group="By person"),
    Column("f1", "Macro\nF1", "share", score=True, group="By person"),
)
ROWS = (
    {"name": "a|b <i>", "n": 13262, "accuracy": (0.5614, "pooled 0.6"), "f1": 0.5, "class": "ours"},
    {"name": "", "n": None, "accuracy": math.nan, "f1": None},
)
TABLE = Table("t", "A table", COLUMNS, ROWS, leaky=True)


def test_text_aligns_numbers_to_the_right_and_leaves_missing_values_blank():
    assert TABLE.text().splitlines() == [
        "Name     Windows  By person: Accuracy (leaky)  By person: Macro F1 (leaky)",
        "-------  -------  ---------------------------  ---------------------------",
        "a|b <i>    13262                        0.561                        0.500",
        "                                            —",
    ]
    assert Table.of(("a", "b"), []).text() == "a  b\n-  -"
    assert Table.of(("x",), [("± 1",), (22,), (None,)]).text() == "  x\n---\n± 1\n 22\n"


def test_csv_holds_every_row_with_raw_values():
    rows = list(csv.DictReader(io.StringIO(Table("t", "", COLUMNS, ROWS, limit=1).csv({"split": "windows:5"}))))
    assert rows[0] == {"name": "a|b <i>", "n": "13262", "accuracy": "0.5614", "f1": "0.5", "split": "windows:5"}
    assert rows[1]["n"] == "" and len(rows) == 2


def test_markdown_escapes_its_own_separator():
    lines = TABLE.markdown().splitlines()
    assert lines[1] == "| --- | ---: | ---: | ---: |"
    assert lines[2].startswith("| a\\|b <i> | 13\u202f262 | 56.1 % |") and lines[3] == "|  | — | — | — |"


def test_html_escapes_texts_and_marks_scores():
    text = TABLE.html()
    assert "a|b &lt;i&gt;" in text and "<i>" not in text
    assert '<th class="group" colspan="2">By person</th>' in text and 'Macro<br>F1<span class="marks">' in text
    assert text.count("LEAKY") == 2 and "SIMULATION" not in text
    assert '<tr class="ours">' in text and '56.1 %<span class="soft">pooled 0.6</span>' in text
    assert Table("t", "", COLUMNS, ROWS, limit=1).omitted == 1


def test_a_column_of_a_leaky_split_marks_its_group():
    columns = (Column("a", "Accuracy", "right", group="windows:5", leaky=True),)
    text = Table("t", "", columns, ({"a": "0.5"},)).html()
    assert text.count("LEAKY") == 1 and text.index("LEAKY") < text.index("Accuracy")


@pytest.mark.parametrize("value", [None, math.nan, math.inf, "0.5", True, [1.0]])
def test_what_is_no_number_is_a_dash(value):
    assert table.number(value) == table.DASH


def test_counts():
    assert table.count(13262).replace("\u202f", " ") == "13 262"
    assert table.count(["a", "b"]) == "2"
    assert table.count(0, "bytes") == "0 bytes"
    assert table.count(None, "bytes") == table.count("many") == table.DASH


def test_mean_and_interval():
    metric = {"mean": 0.5614, "sd": 0.1259, "ci95": [0.512, 0.607]}
    assert table.mean_sd(metric) == "0.561 ± 0.126"
    assert table.interval(metric) == "0.512 to 0.607"
    assert table.mean_sd({"mean": None, "sd": 0.1}) == table.interval({"ci95": [None, 1.0]}) == table.DASH
