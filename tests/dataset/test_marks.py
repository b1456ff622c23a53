from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.marks import MARKS, Mark, Standing, append_marks, read_marks


def test_marks_are_appended_and_undone(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "trim", "x", start=5, stop=50), Mark("a", "exclude", "x", "noise")])
    first = (tmp_path / MARKS).read_text()
    assert read_marks(tmp_path) == {"a": Standing(True, 5, 50)}
    append_marks(tmp_path, [Mark("a", "include", "y")])
    assert (tmp_path / MARKS).read_text().startswith(first), "append-only"
    assert read_marks(tmp_path) == {"a": Standing(False, 5, 50)}
    append_marks(tmp_path, [Mark("a", "untrim", "y")])
    assert read_marks(tmp_path) == {"a": Standing()}


def test_a_torn_last_line_is_passed_over_and_a_damaged_one_is_not(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "exclude", "x")])
    with (tmp_path / MARKS).open("a") as file:
        file.write('{"recording": "b", "act')
    assert set(read_marks(tmp_path)) == {"a"}
    with (tmp_path / MARKS).open("a") as file:
        file.write("\n")
    append_marks(tmp_path, [Mark("c", "exclude", "x")])
    with pytest.raises(DatasetError, match="line 2 is damaged"):
        read_marks(tmp_path)


def test_an_unknown_mark_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"'exclud'.*Did you mean 'exclude'"):
        append_marks(tmp_path, [Mark("a", "exclud", "x")])
    assert not (tmp_path / MARKS).exists()
