"""Sentences with an empty list, one value and many; and no source that forgets one of them."""

from __future__ import annotations

import ast
import json
import os
import pickle
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError
from plushsense.core.sentences import Message, join_names, plural, single_stops

PACKAGE = Path(str(resources.files("plushsense")))


def test_a_list_of_names_is_never_blank() -> None:
    assert [join_names(names) for names in ([], ["a"], ["a", 2], ["", " "], iter(()))] == [
        "none", "a", "a, 2", "'', ''", "none",
    ]  # fmt: skip
    assert join_names([], none="nobody") == "nobody"


def test_a_count_agrees_with_its_noun() -> None:
    counts = [plural(n, noun) for noun in ("file", "person", "virtual person", "labelled stretch") for n in (0, 1, 2)]
    assert counts == [
        "0 files", "1 file", "2 files", "0 people", "1 person", "2 people",
        "0 virtual people", "1 virtual person", "2 virtual people",
        "0 labelled stretches", "1 labelled stretch", "2 labelled stretches",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "single"),
    [
        ("'a.zip': it is damaged..", "'a.zip': it is damaged."),
        ("probably “phone-6”.. Choose", "probably “phone-6”. Choose"),
        ("'../a' and '..' and a/.. and wait ... and so on…", "'../a' and '..' and a/.. and wait ... and so on…"),
    ],
)
def test_a_sentence_in_a_sentence_ends_once(text: str, single: str) -> None:
    assert single_stops(text) == single
    assert str(ConfigError(text)) == single
    assert Message(text) == single


def test_a_message_keeps_its_template_and_values() -> None:
    inner = Message("no {what}", what="row")
    message = Message("{file}: {note} ({n:row}; {names})", file=Path("a/b.csv"), note=inner, n=2, names=["x", "y"])
    assert message == "a/b.csv: no row (2 rows; x, y)".replace("/", os.sep)
    assert pickle.loads(pickle.dumps(message)) == message
    stored = message.to_json()
    assert stored["template"] == message.template and stored["values"]["file"] == "b.csv"
    assert json.loads(json.dumps(stored)) == stored and Message.from_json(stored).values["note"]["values"] == {
        "what": "row"
    }
    assert Message("{braces} of a user") == "{braces} of a user"
    error = pickle.loads(pickle.dumps(ConfigError("'{name}' is there\u2028.", name="{a}")))
    assert str(error) == error.message == "'{a}' is there\\u2028." and error.message.values == {"name": "{a}"}


# Names of lists that hold at least one name: those of a valid layout, gesture set, network, data set or registry.
_FILLED = {
    "labels", "names", "inputs", "channels", "axes", "paths", "filters", "seeds", "epochs", "subjects", "people",
    "known", "columns", "keys", "rungs", "folds", "settings", "creators", "costs", "__all__",
    "layout_names()", "merge_names()", "names()", "to_dict()", "get_args(kind)",
}  # fmt: skip
# Joins of which the function itself ensures that there is something to join.
_NEVER_EMPTY = {
    "', '.join(map(str, grid.exceeded(near)))": "networks that exceed a limit",
    "', '.join(map(str, grid.exceeded(a)))": "networks that exceed a limit",
    "', '.join((f'{name} {macs:,}' for name, macs in profile.macs_by_layer.items()))": "a network has layers",
    "', '.join((a for a in vector if a in named))": "after 0 < len(set(vector) & set(named))",
    "', '.join((f'{name} {value:g}' for name, value in self.zero.items()))": "three axes",
    "', '.join((f'{k} {v:g}' for k, v in self.value.items()))": "a proposal has a value",
    "'; '.join(several)": "filled with what the condition asks about",
    "'; '.join(reasons)": "filled with what the condition asks about",
    "', '.join(several)": "made by setdefault and append",
    "', '.join((f'{n} records of {name}' for name, n in records.items()))": "the tables of a package",
    "', '.join(listed)": "the names of `odd`, which the condition asks about",
    "'; '.join((f'{name}: {why}' for name, why in not_run))": "of two lists, the other one is empty",
    "', '.join((c for c in EVENT_COLUMNS if c not in ('t', 'label')))": "a constant",
    "', '.join((label for label in labels if label not in used))": "after len(used) < len(labels)",
    "' and '.join(dict.fromkeys((v.name for v in stream)))": "a stream of the proof has vectors",
    "', '.join(names if len(names) <= _NAMED else (*names[:_NAMED - 1], '…'))": "the columns of a layout",
    "'; '.join(parts)": "one for each of the channels that the condition asks about",
    "', '.join(map(str, column.codes[:6]))": "a column of codes has codes",
    "', '.join((repr(word) for word in list(label.words)[:2]))": "after 1 < len(c.words)",
    "' and '.join(listed)": "the first example is always there",
    "', '.join(texts)": "made by setdefault and append, or of a value with names",
    "'; '.join(dict.fromkeys((f'1 g is about {s.one_g:g}, and the layout says {s.unit}' for s in wrong)))": "as units",
    "', '.join(sorted(set(windows.subject[far.any(axis=1)].tolist())))": "somebody has the readings",
    "' and '.join(advice)": "one of its conditions holds where the function has not returned",
}
_SEPARATORS = (", ", " and ", " or ", "; ")


def _items(node: ast.expr) -> ast.expr | None:
    """The collection that a join goes through; None if a condition decides what is joined."""
    while True:
        if isinstance(node, ast.GeneratorExp | ast.ListComp | ast.SetComp):
            if node.generators[0].ifs:
                return None
            node = node.generators[0].iter
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.args:
            node = node.args[node.func.id in ("map", "filter")]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr != "join":
            if node.func.attr == "fromkeys":
                node = node.args[0]
            elif node.func.attr in ("items", "values", "keys", "most_common"):
                node = node.func.value
            else:
                return node
        elif (isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice)) or isinstance(node, ast.Starred):
            node = node.value
        else:
            return node


def _begins(node: ast.expr) -> bool:
    """Whether a collection is written with at least one element."""
    if isinstance(node, ast.BinOp):
        return _begins(node.left) or _begins(node.right)
    return isinstance(node, ast.List | ast.Tuple) and not all(isinstance(each, ast.Starred) for each in node.elts)


def unguarded(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each list that is joined into a sentence without words for an empty one.

    Accepted are ``or "none"`` behind it, `join_names`, constants, and a function that asks about the list.
    """
    tree = ast.parse(source)
    parent = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for node in ast.walk(tree):
        if not (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Attribute)
            and node.func.attr == "join"
            and isinstance(node.func.value, ast.Constant)
            and node.func.value.value in _SEPARATORS
        ):
            continue
        around: list[ast.AST] = [node]
        while not isinstance(around[-1], ast.FunctionDef | ast.AsyncFunctionDef | ast.Module):
            around.append(parent[around[-1]])
        if any(isinstance(each, ast.BoolOp) and isinstance(each.op, ast.Or) for each in around):
            continue
        if not any(isinstance(each, ast.JoinedStr | ast.Assign) for each in around):
            continue
        assigned = [each for each in ast.walk(around[-1]) if isinstance(each, ast.Assign)]
        made = [each.value for each in assigned if ast.unparse(each.targets[0]) == ast.unparse(node.args[0])]
        items = _items(next((value for value in made if _begins(value)), node.args[0]))
        name = ast.unparse(items) if items is not None else ast.unparse(node.args[0])
        last = name.split(".")[-1].split("['")[-1].removesuffix("']")
        if items is not None and (_begins(items) or last.isupper() or last in _FILLED):
            continue
        joined = {
            t.id for each in around if isinstance(each, ast.Assign) for t in each.targets if isinstance(t, ast.Name)
        }
        tests = [t.test for t in ast.walk(around[-1]) if isinstance(t, ast.If | ast.IfExp | ast.While)]
        tests += [v for t in ast.walk(around[-1]) if isinstance(t, ast.BoolOp) for v in t.values[:-1]]
        tests += [i for t in ast.walk(around[-1]) if isinstance(t, ast.comprehension) for i in t.ifs]
        asked = {ast.unparse(each) for test in tests for each in ast.walk(test)}
        if name not in asked and not joined & asked and ast.unparse(node) not in _NEVER_EMPTY:
            yield node.lineno, ast.unparse(node)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("def f(a):\n    raise E(f'it has {\", \".join(a)}.')", 1),
        ("def f(a):\n    there = ', '.join(x.name for x in a)\n    raise E(f'it has {there}.')", 1),
        ('def f(a):\n    raise E(f\'it has {", ".join(a) or "none"}.\')', 0),
        ("def f(a):\n    if a:\n        raise E(f'it has {\", \".join(a)}.')", 0),
        ("def f(a):\n    there = ', '.join(a)\n    raise E(f'it has {there}.' if there else 'It is empty.')", 0),
        ("def f(a):\n    raise E(f'it has {\", \".join(FORMATS)}.')", 0),
    ],
)
def test_what_the_test_of_the_source_finds(source: str, found: int) -> None:
    assert len(list(unguarded(source))) == found


# Modules that fill tables and pictures, where an empty cell is empty.
_TABLES = ("reports/", "_page.py", "/figures.py", "/tables.py", "studio/pages/")


def test_every_list_in_a_sentence_has_words_for_an_empty_one() -> None:
    found = [
        f"{path}:{line}: {text}"
        for module in sorted(PACKAGE.rglob("*.py"))
        if not any(part in (path := module.relative_to(PACKAGE).as_posix()) for part in _TABLES)
        for line, text in unguarded(module.read_text(encoding="utf-8"))
    ]
    assert not found, "use plushsense.core.sentences.join_names, or add  or 'none':\n" + "\n".join(found)


def test_of_many_names_the_first_are_listed() -> None:
    assert [join_names("abc"[:n], most=2) for n in range(4)] == ["none", "a", "a, b", "a, b and 1 more"]
