"""No f-string of the source shows a value that may be None: the type checker reads a copy in which None has no text."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest

PACKAGE = Path(str(resources.files("plushsense")))
CONFIG = Path(__file__).parents[2] / "pyproject.toml"
TEXT = """
from pathlib import PurePath
from collections.abc import Sized
from typing import TypeVar

T = TypeVar("T", bound="str | int | float | complex | PurePath | Sized | BaseException | type")

def text_of(value: T) -> T:
    return value
"""
# What the type checker cannot know: the surrounding condition, or its caller's, excludes None.
KNOWN = {
    "parser.description", "sentence.get('reason')", "code", "self.adapted_to", "b.adapted_to", "target.address",
    "limit", "merges", "done.bundle.adapted_to", "subject", "total", "c.call_bound", "arch", "bundle.adapted_to",
    "spec.key", "done.zip", "self.total", "self.scores.mean('accuracy')", "best.mean('accuracy')",
}  # fmt: skip


class _Wrapped(ast.NodeTransformer):
    """Passes each value of an f-string through `text_of`."""

    def visit_FormattedValue(self, node: ast.FormattedValue) -> ast.AST:  # noqa: N802, RUF100
        self.generic_visit(node)
        if node.conversion == -1:
            node.value = ast.Call(ast.Name("text_of", ast.Load()), [node.value], [])
        return node


def copied(source: Path, target: Path) -> None:
    for module in source.rglob("*.py"):
        tree = _Wrapped().visit(ast.parse(module.read_text(encoding="utf-8")))
        future = next((n for n, each in enumerate(tree.body) if "__future__" in ast.unparse(each)), -1)
        tree.body.insert(future + 1, ast.parse("from plushsense.core.text_of import text_of").body[0])
        copy = target / "plushsense" / module.relative_to(source)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(ast.unparse(ast.fix_missing_locations(tree)), encoding="utf-8")
    (target / "plushsense/core/text_of.py").write_text(TEXT, encoding="utf-8")


def shown(folder: Path) -> dict[str, set[str]]:
    """Return for each line with a value whose type has None what its f-strings show."""
    command = [sys.executable, "-m", "mypy", "plushsense", "--config-file", str(CONFIG)]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    places = re.findall(r'^(\S+):(\d+): .*"text_of" cannot be ".*\bNone\b', ran.stdout, re.MULTILINE)
    found: dict[str, set[str]] = {}
    for name, line in places:
        # Python before 3.12 does not know the columns of what is inside an f-string.
        for node in ast.walk(ast.parse((folder / name).read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "text_of" and node.lineno == int(line):
                found.setdefault(f"{name}:{line}", set()).add(ast.unparse(node.args[0]))
    return found


@pytest.mark.slow
@pytest.mark.exhaustive
def test_no_sentence_shows_none(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    copied(PACKAGE, tmp_path)
    (tmp_path / "plushsense/core/planted.py").write_text(
        "from plushsense.core.text_of import text_of\n\n\n"
        "def plant(name: str | None) -> str:\n    return f'train {text_of(name)}'\n"
    )
    unknown = {place: values for place, values in shown(tmp_path).items() if not values & KNOWN}
    assert unknown == {"plushsense/core/planted.py:5": {"name"}}
