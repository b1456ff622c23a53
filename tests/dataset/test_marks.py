import functools
import json
from dataclasses import asdict
from pathlib import Path

import pytest

from plushsense.core.errors import DatasetError
from plushsense.dataset.marks import (
    MARKS,
    LabelledStretch,
    Mark,
    MarksFollower,
    MarkState,
    append_marks,
    apply_mark,
    inverse_marks,
    read_marks,
)


def test_marks_are_appended_and_undone(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "trim", "x", start=5, stop=50), Mark("a", "exclude", "x", "noise")])
    first = (tmp_path / MARKS).read_text()
    assert read_marks(tmp_path) == {"a": MarkState(True, 5, 50)}
    append_marks(tmp_path, [Mark("a", "include", "y")])
    assert (tmp_path / MARKS).read_text().startswith(first), "append-only"
    assert read_marks(tmp_path) == {"a": MarkState(False, 5, 50)}
    append_marks(tmp_path, [Mark("a", "untrim", "y")])
    assert read_marks(tmp_path) == {"a": MarkState()}


def test_a_torn_line_swallows_nothing_and_locks_nothing(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "exclude", "x")])
    with (tmp_path / MARKS).open("a") as file:
        file.write('{"recording": "b", "act')
    assert set(read_marks(tmp_path)) == {"a"}
    append_marks(tmp_path, [Mark("c", "exclude", "x")])
    assert set(read_marks(tmp_path)) == {"a", "c"}
    with (tmp_path / MARKS).open("ab") as file:
        file.write('{"recording": "ä'.encode()[:-1])
    append_marks(tmp_path, [Mark("d", "exclude", "x")])
    assert set(read_marks(tmp_path)) == {"a", "c", "d"}


def test_only_a_newline_ends_a_mark(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "exclude", "x", "noise\u2028and more\x85\x0b")])
    assert read_marks(tmp_path) == {"a": MarkState(True)}


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("[1]", "accepted is a table"),
        ('{"recording": "a", "action": "trim"}', "the key who is missing"),
        ('{"recording": "a", "action": "trim", "who": "x", "start": -1}', "start is -1"),
        ('{"recording": "a", "action": "trim", "who": "x", "start": "3"}', "start is '3'"),
        ('{"recording": "a", "action": "trim", "who": "x", "stop": 2.5}', "stop is 2.5"),
        ('{"recording": "a", "action": "trim", "who": "x", "start": 9, "stop": 4}', "keep nothing"),
        ('{"recording": 7, "action": "exclude", "who": "x"}', "recording is 7"),
        ('{"recording": "a", "acton": "exclude", "who": "x"}', "Did you mean 'action'"),
    ],
)
def test_json_that_is_no_mark_is_refused_with_its_line(tmp_path: Path, line: str, said: str) -> None:
    (tmp_path / MARKS).write_text("\n" + line + "\n")
    with pytest.raises(DatasetError, match=f"line 2.*{said}"):
        read_marks(tmp_path)


def test_a_mark_that_cannot_be_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="start is -5"):
        append_marks(tmp_path, [Mark("a", "trim", "x", start=-5)])
    assert not (tmp_path / MARKS).exists()


def test_an_unknown_mark_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"'exclud'.*Did you mean 'exclude'"):
        append_marks(tmp_path, [Mark("a", "exclud", "x")])
    assert not (tmp_path / MARKS).exists()


def test_a_finding_is_accepted_and_taken_back(tmp_path: Path) -> None:
    append_marks(
        tmp_path, [Mark("a", "accept", "x", "a bumpy bus", check="gaps"), Mark("a", "accept", "x", check="rate")]
    )
    assert read_marks(tmp_path)["a"].accepted == {"gaps", "rate"}
    append_marks(tmp_path, [Mark("a", "trim", "x", start=3), Mark("a", "unaccept", "y", check="gaps")])
    assert read_marks(tmp_path)["a"] == MarkState(False, 3, -1, frozenset({"rate"}))
    for wrong in (Mark("a", "accept", "x"), Mark("a", "trim", "x", check="gaps")):
        with pytest.raises(DatasetError, match="name a check"):
            append_marks(tmp_path, [wrong])


def test_followed_marks_are_those_read_whole(tmp_path: Path) -> None:
    followed = MarksFollower(tmp_path)
    assert followed.states() == {}
    assert not followed.changed
    for number in range(20):
        append_marks(tmp_path, [Mark(f"r{number % 7}", "trim", "x", start=number), Mark("r3", "exclude", "x")])
        assert followed.changed
        assert followed.states() == read_marks(tmp_path)
        assert followed.states() is followed.states(), "nothing changed"
    with (tmp_path / MARKS).open("a") as file:
        file.write('{"recording": "r9", "action": "exclude", "who": "x"')
    assert "r9" not in followed.states()
    with (tmp_path / MARKS).open("a") as file:
        file.write("}")
    assert followed.states()["r9"].excluded, "a mark without a line's end"
    append_marks(tmp_path, [Mark("r9", "include", "x")])
    assert followed.states() == read_marks(tmp_path)


def test_a_marks_file_that_was_replaced_is_read_anew(tmp_path: Path) -> None:
    followed = MarksFollower(tmp_path)
    append_marks(tmp_path, [Mark("a", "exclude", "x"), Mark("b", "exclude", "x")])
    assert set(followed.states()) == {"a", "b"}
    other = (tmp_path / MARKS).read_text().replace('"a"', '"c"')
    (tmp_path / "other").write_text(other + other)
    (tmp_path / "other").replace(tmp_path / MARKS)
    assert set(followed.states()) == {"b", "c"}
    (tmp_path / MARKS).unlink()
    assert followed.states() == {}


def test_followed_marks_name_the_line_that_is_none(tmp_path: Path) -> None:
    append_marks(tmp_path, [Mark("a", "exclude", "x")])
    followed = MarksFollower(tmp_path)
    followed.states()
    with (tmp_path / MARKS).open("a") as file:
        file.write("[1]\n")
    for _ in range(2):
        with pytest.raises(DatasetError, match="line 2, what was given is"):
            followed.states()


@pytest.mark.parametrize(
    "before",
    [
        MarkState(),
        MarkState(start=3, stop=9, how="hand"),
        MarkState(True, accepted=frozenset({"gaps"})),
        MarkState(stretches=(LabelledStretch("a", 2, 8, "rest"), LabelledStretch("a", 11, 12, "practice:Hug"))),
    ],
)
@pytest.mark.parametrize(
    "mark",
    [
        Mark("a", "trim", "x", start=5, how="suggested"),
        Mark("a", "untrim", "x"),
        Mark("a", "exclude", "x"),
        Mark("a", "include", "x"),
        Mark("a", "accept", "x", check="gaps"),
        Mark("a", "unaccept", "x", check="gaps"),
        Mark("a", "label", "x", start=4, stop=6, label="handling"),
        Mark("a", "label", "x", start=0, stop=20, label="handling"),
        Mark("a", "unlabel", "x", start=3),
    ],
)
def test_a_mark_taken_back_leaves_what_was_before(before: MarkState, mark: Mark) -> None:
    assert functools.reduce(apply_mark, [mark, *inverse_marks(mark, before, "y")], before) == before


def test_labels_replace_earlier_ones_of_the_same_rows(tmp_path: Path) -> None:
    append_marks(
        tmp_path,
        [
            Mark("P1/s", "label", "x", start=10, stop=90, label="rest"),
            Mark("P1/s", "label", "x", "held it", start=40, stop=50, label="practice:Big hug"),
            Mark("P1/s", "label", "x", start=85, stop=100, label="handling"),
            Mark("P1/s", "exclude", "x"),
        ],
    )
    state = read_marks(tmp_path)["P1/s"]
    assert state.excluded
    assert [(s.start, s.stop, s.label, s.gesture) for s in state.stretches] == [
        (10, 40, "rest", ""),
        (40, 50, "practice:Big hug", "Big hug"),
        (50, 85, "rest", ""),
        (85, 100, "handling", ""),
    ]
    append_marks(tmp_path, [Mark("P1/s", "unlabel", "x", start=45)])
    assert [(s.start, s.stop) for s in read_marks(tmp_path)["P1/s"].stretches] == [(10, 40), (40, 45)]


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        (Mark("s", "label", "x", start=1, stop=2), "mark 'label' with label ''"),
        (Mark("s", "label", "x", start=1, stop=2, label="practice:"), "with label 'practice:'"),
        (Mark("s", "label", "x", start=1, stop=2, label="Hug"), "with label 'Hug'.* practice: and a gesture"),
        (Mark("s", "unlabel", "x", label="rest"), "only the action label has one"),
        (Mark("s", "trim", "x", label="Hug"), "only the action label has one"),
        (Mark("s", "label", "x", start=1, label="rest"), "without stop"),
        (Mark("s", "label", "x", start=3, stop=3, label="rest"), "stop must be above start"),
    ],
)
def test_a_label_that_cannot_be_is_one_sentence(tmp_path: Path, mark: Mark, said: str) -> None:
    with pytest.raises(DatasetError, match=said):
        append_marks(tmp_path, [mark])
    (tmp_path / MARKS).write_text(json.dumps(asdict(mark)) + "\n")
    with pytest.raises(DatasetError, match=f"line 1: .*{said}"):
        read_marks(tmp_path)


def test_marks_of_older_versions_are_read(tmp_path: Path) -> None:
    (tmp_path / MARKS).write_text('{"recording": "a", "action": "trim", "who": "x", "start": 3, "stop": -1}\n')
    assert read_marks(tmp_path) == {"a": MarkState(start=3)}
