"""The packages of an export: what their manifests name exists, and copies are copies."""

from __future__ import annotations

import json
import re
from pathlib import Path

from plushsense.deploy.emit import read_facts
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE, changed_copies
from plushsense.runtime.image import IntegerModel

REPO = Path(__file__).resolve().parents[2]
Packages = dict[str, tuple[Path, IntegerModel]]


def test_what_the_manifests_name_exists(packages: Packages) -> None:
    for out, _ in packages.values():
        library = out / ARDUINO
        properties = dict(row.split("=", 1) for row in (library / "library.properties").read_text().splitlines())
        assert {"name", "version", "author", "maintainer", "sentence", "paragraph", "category"} <= set(properties)
        assert all((library / "src" / name).is_file() for name in properties["includes"].split(","))
        manifest = json.loads((library / "library.json").read_text(encoding="utf-8"))
        assert all((library / "src" / name).is_file() for name in manifest["headers"])
        for example in manifest["examples"]:
            assert all((library / example["base"] / name).is_file() for name in example["files"])
        assert manifest["version"] == properties["version"] == read_facts(out)["code_version"]
        words = [row.split("\t") for row in (library / "keywords.txt").read_text().splitlines()]
        assert all(len(row) == 2 for row in words) and ["plush_push", "KEYWORD2"] in words
        for cmake in (*(out / IDF).rglob("CMakeLists.txt"), *(out / IDF_EXAMPLE).rglob("CMakeLists.txt")):
            for named in re.findall(r'"([^"$]+)"', cmake.read_text()):
                assert (cmake.parent / named).exists(), named
            for named in re.findall(r"CMAKE_CURRENT_LIST_DIR}/([^\"]+)", cmake.read_text()):
                assert (cmake.parent / named).is_dir()
        assert re.fullmatch(
            r'version: "[\d.]+"\ndescription: ".*"\nlicense: MIT\ndependencies:\n  idf: ".*"\n',
            (out / IDF / "idf_component.yml").read_text(encoding="utf-8"),
        )
        held = {p.name for p in out.rglob("*")}
        for source in (p for p in out.rglob("*") if p.suffix in (".c", ".h", ".ino")):
            for included in re.findall(r'#include [<"](plush\w+\.h)[">]', source.read_text(encoding="utf-8")):
                assert included in held
        for path in (p for p in out.rglob("*") if p.is_file() and p.suffix not in (".bin", ".plush")):
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"@\w+@|@if |@end|TODO|(?<!\$)(?<!ENV){\w+}", text), path
        assert changed_copies(out) == []
        assert (out / "LICENSE").read_text() == (REPO / "LICENSE").read_text()
