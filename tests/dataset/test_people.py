from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.store import PEOPLE, PersonInfo, read_people, write_people


def test_people_come_back_with_columns_of_one_s_own(tmp_path: Path) -> None:
    people = [PersonInfo("P2", "adult", "", "C-17"), PersonInfo("P1", "child", "f", more={"hand, size": 'l"eft'})]
    write_people(tmp_path, people)
    back = read_people(tmp_path)
    assert list(back) == ["P1", "P2"]
    assert back["P1"] == PersonInfo("P1", "child", "f", more={"hand, size": 'l"eft'})
    assert back["P2"].consent == "C-17"
    assert back["P2"].more == {"hand, size": ""}


def test_a_table_from_a_spreadsheet_reads(tmp_path: Path) -> None:
    (tmp_path / PEOPLE).write_text("\ufeffAge_Group; Subject\nchild; P1\n", encoding="utf-8")
    assert read_people(tmp_path) == {"P1": PersonInfo("P1", "child")}
    assert read_people(tmp_path / "nothing.csv") == {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("person,age\nP1,3\n", "needs 'subject'"),
        ("subject,age_group\nP1,child\nP1,adult\n", "line 3 names 'P1' again"),
        ("subject,age_group\n,child\n", "line 2 names no subject"),
        ("", "needs 'subject'"),
        ("subject,subject\nP1,P2\n", "each once"),
        ('subject\n"P1', "cannot be read"),
    ],
)
def test_what_is_no_table_of_people_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / PEOPLE).write_text(text)
    with pytest.raises(DatasetError, match=said):
        read_people(tmp_path)
