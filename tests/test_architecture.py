"""Hold the rules of the code base that no linter knows: see *House rules* in CONTRIBUTING.md."""

from __future__ import annotations

import ast
import re
import tomllib
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SRC = ROOT / "src" / "plushsense"
MODULES = sorted(SRC.rglob("*.py"))

LONGEST = 800
SHORT = 80
BANNED = re.compile(r"(^|_)(said|told|heard|shown|wanted|felt)(_|$)")
NOT_IMPERATIVE = re.compile(r"(What|How|Whether|Who|Whose|Where|Of|One|All|Those|That|The|A|An|Every|Each)\b")

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


@cache
def tree(module: Path) -> ast.Module:
    return ast.parse(module.read_text(encoding="utf-8"))


def name(module: Path) -> str:
    return module.relative_to(SRC).as_posix()


def dotted(module: Path) -> str:
    parts = ("plushsense", *module.relative_to(SRC).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def definitions() -> list[tuple[Path, Definition]]:
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return [(module, node) for module in MODULES for node in ast.walk(tree(module)) if isinstance(node, kinds)]


def test_no_module_is_longer_than_800_lines() -> None:
    lines = {name(module): len(module.read_text(encoding="utf-8").splitlines()) for module in MODULES}
    assert {module: n for module, n in lines.items() if n > LONGEST} == {}


def test_a_test_that_the_security_page_names_is_not_exhaustive() -> None:
    named = set(re.findall(r"\btest_\w+", (ROOT / "docs/security.md").read_text(encoding="utf-8")))
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")]
    mark = re.compile(r"^@pytest\.mark\.exhaustive\n(?:@.*\n)*def (\w+)", re.M)
    marked = {name for text in texts for name in mark.findall(text)}
    assert marked
    assert named & marked == set()


def test_three_modules_with_one_prefix_are_a_package() -> None:
    families = Counter((m.parent, m.stem.split("_")[0]) for m in MODULES if "_" in m.stem.strip("_"))
    assert [f"{name(folder)}/{prefix}_*" for (folder, prefix), n in families.items() if n >= 3] == []


def test_no_two_public_classes_have_one_name() -> None:
    owners: dict[str, list[str]] = defaultdict(list)
    for module, node in definitions():
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            owners[node.name].append(name(module))
    assert {cls: modules for cls, modules in owners.items() if len(modules) > 1} == {}


def test_no_name_uses_a_banned_word() -> None:
    assert [f"{name(module)}: {node.name}" for module, node in definitions() if BANNED.search(node.name)] == []


def test_docstrings_of_functions_begin_with_what_the_function_does() -> None:
    odd = [
        f"{name(module)}: {node.name}: {first}"
        for module, node in definitions()
        if not isinstance(node, ast.ClassDef) and not any("property" in ast.unparse(d) for d in node.decorator_list)
        for first in [(ast.get_docstring(node) or "").partition("\n")[0]]
        if NOT_IMPERATIVE.match(first)
    ]
    assert odd == []


def test_a_short_module_with_a_single_importer_belongs_into_it() -> None:
    # A name in quotes counts, too: a registry loads its modules by name.
    importers: Counter[str] = Counter()
    known = {dotted(module) for module in MODULES}
    for module in MODULES:
        used: set[str] = set()
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.ImportFrom) and node.module:
                used |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                used |= {alias.name for alias in node.names}
        importers.update(used & known)
    short = [
        name(module)
        for module in MODULES
        if module.name != "__init__.py"
        and importers[dotted(module)] == 1
        and len(module.read_text(encoding="utf-8").splitlines()) < SHORT
    ]
    assert short == []


def test_the_table_of_changes_names_what_exists() -> None:
    rows = re.findall(r"^\| .*", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.M)
    named = {code for row in rows for code in re.findall(r"`([\w/.-]+/[\w.-]*)`", row)}

    def exists(code: str) -> bool:
        if (SRC / code).exists() or (ROOT / code).exists() or (SRC / f"{code}.py").exists():
            return True
        module, _, attribute = code.rpartition(".")
        places = [path for path in (SRC / f"{module}.py", SRC / module / "__init__.py") if path.exists()]
        return any(re.search(rf"^(class |def )?{attribute}\b", path.read_text("utf-8"), re.M) for path in places)

    assert len(rows) <= 27, "25 rows and the head"
    assert {code for code in named if not exists(code)} == set()


def test_every_direct_dependency_is_explained() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    groups = {"": project["dependencies"], **project["optional-dependencies"]}
    named = {(re.split(r"[\[<>=;]", need)[0], extra) for extra, needs in groups.items() for need in needs}
    named = {(name, extra) for name, extra in named if name != "plushsense"}
    rows = re.findall(r"^\| ([\w-]+) \|(.*)\|$", (ROOT / "docs" / "dependencies.md").read_text("utf-8"), re.M)
    explained = {name: [cell.strip() for cell in rest.split("|")] for name, rest in rows if name != "package"}
    always = {name for name, extra in named if extra == ""}
    assert set(explained) == {name for name, _ in named}
    for name, cells in explained.items():
        extras = {extra for known, extra in named if known == name}
        # Those that are always installed are named by extras again only for clarity.
        assert name in always or set(cells[0].split(", ")) <= extras, name
        assert cells[-1], name
