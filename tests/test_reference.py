"""The reference of files in docs/reference: generated from the code, complete, and true."""

from __future__ import annotations

import ast
import copy
import re
import runpy
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import pytest
import tomli_w

from plushsense.core.errors import BadInput
from plushsense.dataset.importing.sources import read_mapping
from plushsense.dataset.store import read_people

ROOT = Path(__file__).resolve().parents[1]
DOCS, SRC = ROOT / "docs", ROOT / "src" / "plushsense"
REFERENCE = runpy.run_path(str(DOCS / "reference" / "generate.py"), run_name="reference")
FILES, RANGE = REFERENCE["FILES"], REFERENCE["RANGE"]

# Dataclasses of files that no user writes: those of the package itself, and JSON that a command writes.
OF_THE_PACKAGE = {"Target", "Core", "PackageTable", "_ProtocolFile"}
WRITTEN_BY_COMMANDS = {"Manifest", "Mark", "ModelFacts", "Readings", "_Intent", "SessionHead"}

# Values that other keys need, so that a key can have each of its values: None removes a key.
BESIDE: dict[str, dict[str, Any]] = {
    "shortest_s": {"longest_s": 36_000},
    "settle_s": {"after_s": 0},
    "after_s": {"settle_s": 60},
    "row_rate_hz": {"time_unit": None, "columns": {"left": "Left", "right": "Right"}},
    "turn_deg": {"augment": None},
    "seconds": {"eyes": "off"},
    "valid_min": {"valid_max": 2e6},
    "valid_max": {"valid_min": -2e6},
}
# Whole numbers whose range is that of a list in the same file.
BY_THE_FILE = {"signal"}


def named_keys() -> Iterator[tuple[str, Any]]:
    for name, file in FILES.items():
        for _, keys in REFERENCE["sections"](file):
            yield from ((name, key) for key in keys)


def example(name: str) -> dict[str, Any]:
    return tomllib.loads((REFERENCE["EXAMPLES"] / f"{name}.toml").read_text(encoding="utf-8"))


def owners(table: Any, path: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return the tables of a file that may have the last key of a path."""
    found = [table]
    for step in path[:-1]:
        inner = [one[step] for one in found if step in one]
        found = [item for value in inner for item in (value if isinstance(value, list) else [value])]
    return found


def problem(name: str, path: tuple[str, ...], value: object, folder: Path) -> str:
    """Return why the example with another value of a key is refused; "" if it is not."""
    table = copy.deepcopy(example(name))
    tables = owners(table, path)
    owner = next((one for one in tables if path[-1] in one), tables[0])
    for key, beside in ({} if value is None else BESIDE.get(path[-1], {})).items():
        owner.pop(key, None) if beside is None else owner.update({key: beside})
    if path == ("reactions", "affect"):
        table["reactions"] = [owner]  # one rule for each affect
    if path == ("derived", "kind"):
        owner["of"] = ["ax"]
    owner[path[-1]] = value
    file = folder / ("dataset.toml" if name == "dataset" else "file.toml")
    file.write_text(tomli_w.dumps(table), encoding="utf-8")
    try:
        FILES[name].read(file)
    except BadInput as cause:
        return str(cause)
    return ""


def test_the_pages_are_those_of_the_code() -> None:
    pages = REFERENCE["pages"]()
    assert {path.name for path in (DOCS / "reference").glob("*.md")} == set(pages)
    for name, text in pages.items():
        assert (DOCS / "reference" / name).read_text(encoding="utf-8") == text, f"{name} is old: run  make docs"


def test_the_examples_of_csv_files_are_read(tmp_path: Path) -> None:
    for title, (_, columns, text) in REFERENCE["CSV_FILES"].items():
        assert set(text.splitlines()[0].split(",")) <= set(columns) or "…" in columns, title
    path = tmp_path / "table.csv"
    path.write_text(REFERENCE["CSV_FILES"]["People"][2])
    assert list(read_people(path)) == ["P01"]
    path.write_text(REFERENCE["CSV_FILES"]["Person of each file"][2])
    assert set(read_mapping(path).values()) == {"P01", "P02"}


def test_a_key_without_a_description_or_a_description_without_a_key_is_refused() -> None:
    @dataclass
    class Table:
        """A table.

        Attributes:
            known: what it is (0 to 1).
        """

        known: float = 0.5

    assert [(k.meaning, k.range, k.default) for k in REFERENCE["keys"](Table)] == [("what it is", "0 to 1", "`0.5`")]

    @dataclass
    class More(Table):
        new: int = 3

    with pytest.raises(ValueError, match="new"):
        list(REFERENCE["keys"](More))

    @dataclass
    class Less:
        """Attributes:
        gone: what it was.
        """

    Less.__doc__ = "A table.\n\nAttributes:\n    gone: what it was.\n"
    with pytest.raises(ValueError, match="gone"):
        list(REFERENCE["keys"](Less))


def test_every_example_is_read_and_has_every_key() -> None:
    for name, key in named_keys():
        text = (REFERENCE["EXAMPLES"] / f"{name}.toml").read_text(encoding="utf-8")
        there = any(key.path[-1] in table for table in owners(example(name), key.path))
        assert there or re.search(rf"^# {key.path[-1]} = ", text, re.M), f"examples/files/{name}.toml lacks {key.path}"


@pytest.mark.parametrize("name", FILES)
def test_what_a_page_says_is_accepted_is_accepted_and_nothing_else(name: str, tmp_path: Path) -> None:
    read = example(name)
    file = tmp_path / ("dataset.toml" if name == "dataset" else "file.toml")
    file.write_text(tomli_w.dumps(read), encoding="utf-8")
    FILES[name].read(file)
    tried = 0
    for key in (key for of, key in named_keys() if of == name):
        kinds = {key.kind, *get_args(key.kind)} - {type(None)}
        good: list[Any] = list(key.choices)
        bad: list[Any] = ["no such choice"] if key.choices else []
        if kinds <= {int, float} and key.path[-1] not in BY_THE_FILE:
            whole = float not in kinds
            good, bad = edges(key.range, 1 if whole else 0.001) if key.range else ([-1_000_000, 1_000_000], [])
        for value in good:
            assert not (why := problem(name, key.path, value, tmp_path)), f"{key.path} = {value!r}: {why}"
        for value in bad:
            assert problem(name, key.path, value, tmp_path), f"{key.path} = {value!r} is accepted"
        tried += len(good) + len(bad)
    assert tried or name == "dataset"


def edges(text: str, little: float) -> tuple[list[float], list[float]]:
    """Return numbers at the ends of a documented range, and others just outside it."""
    match = RANGE.fullmatch(text.partition(", and ")[0])
    low = int(match["low"]) if float(match["low"]).is_integer() else float(match["low"])
    good, bad = ([low + little], [low]) if match["bound"] == "above " else ([low], [low - little])
    if match["off"] is not None:
        good.append(int(match["off"]))
    if match["high"]:
        high = int(match["high"])
        good, bad = ([*good, high - little], [*bad, high]) if match["below"] else ([*good, high], [*bad, high + little])
    return good, bad


def test_every_reader_of_tables_reads_a_documented_one() -> None:
    documented = set()
    for file in FILES.values():
        waiting = list(file.tables.values())
        while waiting:
            kind = waiting.pop()
            documented |= {one.__name__ for one in kind.__mro__}
            waiting += [one for key in REFERENCE["keys"](kind) if (one := key.inner) is not None]
    found = {(path.relative_to(SRC).as_posix(), kind) for path in SRC.rglob("*.py") for kind in kinds_read(path)}
    # Parameters, whose calls are found by themselves, and the tables of a bundle.
    general = {("core/toml.py", "kind"), ("models/bundle.py", "kind")}
    general.add(("workflow/config.py", "TABLES[name]"))
    known = documented | OF_THE_PACKAGE | WRITTEN_BY_COMMANDS
    assert sorted(pair for pair in found if pair[1] not in known and pair not in general) == []
    assert {kind for _, kind in found} >= OF_THE_PACKAGE | WRITTEN_BY_COMMANDS


def kinds_read(path: Path) -> Iterator[str]:
    """Yield the dataclass, as it is written, of each call in a module that reads a table."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text if re.search(r"\b(load_table|check_table)\(", text) else "")
    for holder in (tree, *(node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))):
        for node in ast.walk(holder):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
                continue
            if node.func.id in ("load_table", "check_table"):
                kind = ast.unparse(node.args[1])
                if kind != "cls":
                    yield kind
                elif isinstance(holder, ast.ClassDef):
                    yield holder.name


def test_links_of_the_reference_lead_somewhere_and_the_index_names_every_page() -> None:
    for name, text in REFERENCE["pages"]().items():
        for target in re.findall(r"\]\(([^)#]*)", text):
            assert not target or (DOCS / "reference" / target).is_file(), f"{name}: {target}"
        headings = {REFERENCE["_anchor"](line.lstrip("# ")) for line in text.splitlines() if line.startswith("#")}
        assert set(re.findall(r"\]\(#([^)]*)\)", text)) <= headings, name
    index = (DOCS / "index.md").read_text(encoding="utf-8").split("```{toctree}")[0]
    places = (*DOCS.glob("*.md"), *DOCS.glob("measurements/*.md"))
    pages = {path.relative_to(DOCS).as_posix() for path in places} | {"reference/README.md", "reference/cli.md"}
    assert pages - {"index.md"} == set(re.findall(r"\]\(([^)#]*\.md)", index)), "each page has its reader"
