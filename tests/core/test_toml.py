"""Strict loading of tables into dataclasses: what fits, and the message for what does not."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import BadInput, ConfigError, LayoutError, printable
from plushsense.core.gestures import GestureSet, gesture_set_names, load_gestures
from plushsense.core.layouts import Layout, layout_names, load_layout
from plushsense.core.toml import check_table, load_table, loads_json, read_toml
from support.bundles import mutated


@dataclass(frozen=True)
class Part:
    name: str
    size: float = 1.0

    def __post_init__(self) -> None:
        if self.size <= 0:
            raise ConfigError(f"size is {self.size}: accepted is above 0.")


@dataclass(frozen=True)
class Whole:
    name: str
    parts: tuple[Part, ...]
    count: int = 3
    on: bool = False
    batches: tuple[int | Literal["full"], ...] = ()
    labels: str | tuple[str, ...] = "all"
    texts: dict[str, str | dict[str, str]] = field(default_factory=dict)
    free: Mapping[str, Any] = field(default_factory=dict)
    limit: float | None = None
    first: Part | None = None
    sets: tuple[tuple[int, ...], ...] = ()


GIVEN = {"name": "w", "parts": [{"name": "p"}]}


def loaded(**changes: Any) -> Whole:
    return load_table({**GIVEN, **changes}, Whole, "'w.toml'", LayoutError)


def test_defaults_lists_tables_and_unions() -> None:
    assert loaded() == Whole("w", (Part("p"),))
    assert loaded(
        parts=[{"name": "p", "size": 2}], batches=[8, "full"], labels=["a"], texts={"a": "b", "c": {"d": "e"}},
        free={"a": [1, {}]}, limit=1, first={"name": "q"}, sets=[[1], []],
    ) == Whole(
        "w", (Part("p", 2.0),), batches=(8, "full"), labels=("a",), texts={"a": "b", "c": {"d": "e"}},
        free={"a": [1, {}]}, limit=1.0, first=Part("q"), sets=((1,), ()),
    )  # fmt: skip
    assert isinstance(loaded(limit=1).limit, float)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nam": 1}, "Unknown key 'nam' in 'w.toml': accepted are name, parts, count.* Did you mean 'name'?"),
        ({"name": 3}, "In 'w.toml', name is 3: accepted is text."),
        ({"count": 3.0}, "count is 3.0: accepted is a whole number."),
        ({"count": True}, "count is True: accepted is a whole number."),
        ({"count": "3"}, "count is '3': accepted is a whole number."),
        ({"on": 1}, "on is 1: accepted is true or false."),
        ({"limit": float("nan")}, "limit is nan: accepted is a number."),
        ({"limit": 10**400}, "accepted is a number."),
        ({"batches": [8, "ful"]}, "batches[1] is 'ful': accepted is a whole number or 'full'."),
        ({"batches": "8"}, "batches is '8': accepted is a list of whole numbers or 'full'."),
        ({"labels": ["a", 1]}, "labels is ['a', 1]: accepted is text or a list of texts."),
        ({"texts": {"a b": 3}}, "texts.\"a b\" is 3: accepted is text or a table."),
        ({"free": 3}, "free is 3: accepted is a table."),
        ({"first": {"nam": 1}}, "Unknown key 'nam' in 'w.toml', first: accepted are name, size. Did you mean 'name'?"),
        ({"parts": {}}, "parts is {}: accepted is a list of tables."),
        ({"parts": [3]}, "parts[0] is 3: accepted is a table."),
        ({"parts": [{}]}, "In 'w.toml', the key parts[0].name is missing: add it."),
        ({"parts": [{"name": "p", "size": 0}]}, "In 'w.toml', parts[0]: size is 0.0: accepted is above 0."),
        ({"sets": [[1], [2, "x"]]}, "sets[1][1] is 'x': accepted is a whole number."),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_with_its_path(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(LayoutError) as refused:
        loaded(**changes)
    start, _, end = message.partition(".*")
    assert start in str(refused.value) and str(refused.value).endswith(end or start)


@pytest.mark.parametrize(("table", "message"), [(3, "is 3: accepted is a table"), ({}, "the key name is missing")])
def test_a_table_is_needed(table: object, message: str) -> None:
    with pytest.raises(LayoutError, match=message):
        load_table(table, Whole, "'w.toml'", LayoutError)


def test_a_partial_table_gives_what_fits_and_all_problems() -> None:
    values, problems = check_table(
        {"count": 5, "batches": [8, "x", 16], "sets": "12", "nme": 1, "on": 0, "labels": "b"}, Whole, "[w]"
    )
    assert values == {"count": 5, "batches": (8, 16), "labels": "b"}
    assert [line.split(":")[0] for line in problems] == [
        "In [w], batches[1] is 'x'", "In [w], sets is '12'", "Unknown key 'nme' in [w]", "In [w], on is 0"
    ]  # fmt: skip


def test_the_library_is_imported_when_it_is_needed() -> None:
    code = "import sys, plushsense.core.layouts as m; assert 'cattrs' not in sys.modules; m.load_layout('accel-3')"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('"a \\ud800 b"', "a \ufffd b"),
        ('{"\\uDC00": ["\\uD83D\\uDE00", {"x": "\\ud800\\ud800"}]}', {"\ufffd": ["😀", {"x": "\ufffd\ufffd"}]}),
        ('"\\\\ud800"', "\\ud800"),
        ("[1, null, true, 1.5]", [1, None, True, 1.5]),
    ],
)
def test_half_characters_of_json_are_replaced(text: str, value: object) -> None:
    assert loads_json(text) == value


FUZZ = int(os.environ.get("PLUSHSENSE_FUZZ", "1"))
TABLES: list[tuple[type[Any], dict[str, Any]]] = [
    *((Layout, json.loads(json.dumps(load_layout(name).to_dict()))) for name in layout_names()),
    *((GestureSet, json.loads(json.dumps(load_gestures(name).to_dict()))) for name in gesture_set_names()),
]


@settings(max_examples=100 * FUZZ, database=None)
@given(st.sampled_from(TABLES), st.randoms(use_true_random=False))
@pytest.mark.slow
def test_any_layout_and_gesture_set_is_read_or_refused(
    given_table: tuple[type[Any], dict[str, Any]], rng: random.Random
) -> None:
    kind, table = given_table
    try:
        made = kind.from_dict(mutated(table, rng))
    except BadInput as error:
        assert str(error) == printable(str(error))
    else:
        assert kind.from_dict(made.to_dict()) == made
        if isinstance(made, Layout):
            assert made.period_us >= 100 and (made.valid_min_int <= made.valid_max_int).all()
            assert made.input_kinds and made.gravity_shift < 32


@settings(max_examples=100 * FUZZ, database=None)
@given(st.sampled_from(TABLES), st.lists(st.tuples(st.integers(0, 1 << 20), st.binary(max_size=4)), max_size=4))
@pytest.mark.slow
def test_any_file_is_toml_or_refused(
    tmp_path_factory: pytest.TempPathFactory, table: tuple[type[Any], dict[str, Any]], cuts: list[tuple[int, bytes]]
) -> None:
    data = tomli_w.dumps({"table": table[1]}).encode()
    for at, new in cuts:
        data = data[: at % len(data)] + new + data[at % len(data) + len(new) :]
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(data)
    try:
        assert read_toml(path, "any", BadInput) == tomllib.loads(data.decode("utf-8-sig"))
    except BadInput as error:
        assert str(error) == printable(str(error)) and path.name in str(error)
