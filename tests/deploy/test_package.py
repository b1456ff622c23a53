"""The packages of an export: what their manifests name exists, and copies are copies."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from plushsense.core.errors import ConfigError
from plushsense.deploy.code import read_facts
from plushsense.deploy.package import ARDUINO, IDF, IDF_EXAMPLE
from plushsense.deploy.proof.vectors import Export
from plushsense.runtime.image import IntegerModel, image_check
from plushsense.workflow.export import PackageNames, export
from support.exports import bundle_of
from support.requirements import missing
from support.virtual_boards import WARNINGS, run

REPO = Path(__file__).resolve().parents[2]
Packages = dict[str, tuple[Path, IntegerModel]]

# The rules of arduino-lint 1.2 for a library in its strictest mode, as far as files can break them
# (https://arduino.github.io/arduino-lint/1.2/rules/library/); patterns after etc/schemas of its
# repository github.com/arduino/arduino-lint.
REQUIRED = ("name", "version", "author", "maintainer", "sentence", "paragraph", "category", "url", "architectures")
OPTIONAL = ("depends", "dot_a_linkage", "includes", "precompiled", "ldflags", "license")
CATEGORIES = (
    *("Display", "Communication", "Signal Input/Output", "Sensors", "Device Control", "Timing", "Data Storage"),
    *("Data Processing", "Other"),
)
NUMBER = r"(0|[1-9][0-9]*)"


def broken_rules(library: Path) -> list[str]:
    """The rules that an Arduino library breaks."""
    rows = (library / "library.properties").read_text(encoding="utf-8").splitlines()
    fields = dict(row.partition("=")[::2] for row in rows)
    name = fields.get("name", "")
    examples = list((library / "examples").iterdir()) if (library / "examples").is_dir() else []
    sketches = [folder for folder in library.rglob("*") if list(folder.glob("*.ino"))]
    text = f"{fields.get('sentence')} {fields.get('paragraph')}"
    rules = {
        "format": all(re.fullmatch(r"[a-z_]+=.*", row) for row in rows) and len(fields) == len(rows),
        "required fields": all(fields.get(field, "").strip() for field in REQUIRED),
        "known fields": set(fields) <= {*REQUIRED, *OPTIONAL},
        "characters of the name": re.fullmatch(r"(?=.*[a-zA-Z])[a-zA-Z0-9][a-zA-Z0-9_.\-]*", name) is not None,
        "length of the name": len(name) <= 16,
        "words in the name": not re.search("arduino|library", name, re.I),
        "maintainer": "arduino" not in fields.get("maintainer", "").lower(),
        "version": re.fullmatch(rf"{NUMBER}(\.{NUMBER}){{2}}(-[0-9A-Za-z.-]+)?", fields.get("version", "")) is not None,
        "paragraph repeats the sentence": fields.get("sentence", "") not in fields.get("paragraph", ""),
        "control characters": text.isprintable(),
        "category": fields.get("category") in CATEGORIES,
        "url": re.fullmatch(r"https?://[^\s/]+\.[^\s/]+(/\S*)?", fields.get("url", "")) is not None,
        "architectures": all(re.fullmatch(r"\*|[a-z0-9_\-]+", a) for a in fields.get("architectures", "").split(",")),
        "includes": all((library / "src" / file).is_file() for file in fields.get("includes", "?").split(",")),
        "folder name": re.fullmatch(r"[a-zA-Z0-9][a-zA-Z0-9_.\-]{0,62}", library.name) is not None,
        "sources only in src": not [*library.glob("*.c"), *library.glob("*.cpp"), *library.glob("*.h")],
        "no utility beside src": not (library / "utility").exists(),
        "examples": bool(examples) and all((e / f"{e.name}.ino").is_file() for e in examples),
        "sketches only in examples": all(folder.parent == library / "examples" for folder in sketches),
        "licence and readme": (library / "LICENSE").is_file() and (library / "README.md").is_file(),
        "no links, no executables, no .git": not any(
            p.is_symlink() or p.suffix in (".exe", ".bat", ".com") or p.name in (".git", ".gitmodules", ".development")
            for p in library.rglob("*")
        ),
        "keywords": all(
            re.fullmatch(r"\w+\t(KEYWORD[123]|LITERAL[12])", row)
            for row in (library / "keywords.txt").read_text(encoding="utf-8").splitlines()
        ),
    }
    return [rule for rule, kept in rules.items() if not kept]


def test_the_arduino_library_keeps_the_rules_of_arduino_lint(packages: Packages, tmp_path: Path) -> None:
    for out, _ in packages.values():
        assert broken_rules(out / ARDUINO) == []
    for n, (old, new, rule) in enumerate(
        (
            ("url=https://plushsense.invalid/\n", "", "required fields"),
            ("name=PlushSense", "name=Plush Sense!", "characters of the name"),
            ("category=Data Processing", "category=Toys", "category"),
            ("license=MIT", "licence=MIT", "known fields"),
            ("version=", "version=v", "version"),
            ("architectures=esp32,", "architectures=ESP 32,", "architectures"),
        )
    ):
        library = Path(shutil.copytree(packages["accel-3"][0] / ARDUINO, tmp_path / str(n) / "PlushSense"))
        text = (library / "library.properties").read_text(encoding="utf-8")
        assert text.count(old) == 1
        (library / "library.properties").write_text(text.replace(old, new), encoding="utf-8")
        assert rule in broken_rules(library), "the test itself can fail"


_USER = """cmake_minimum_required(VERSION 3.13)
project(user LANGUAGES C)
{find}
add_executable(user user.c)
target_link_libraries(user PRIVATE {target})
"""
_ZEPHYR = """macro(zephyr_library_named name)
    add_library(${name} STATIC)
    set(ZEPHYR_CURRENT_LIBRARY ${name})
endmacro()
macro(zephyr_library_sources)
    target_sources(${ZEPHYR_CURRENT_LIBRARY} PRIVATE ${ARGN})
endmacro()
macro(zephyr_library_compile_options)
    target_compile_options(${ZEPHYR_CURRENT_LIBRARY} PRIVATE ${ARGN})
endmacro()
macro(zephyr_include_directories)
    target_include_directories(${ZEPHYR_CURRENT_LIBRARY} PUBLIC ${ARGN})
endmacro()
set(CONFIG_OWL_PLUSHSENSE y)
"""
_USE = """#include "owl_plush_model.h"
#include "owl_plushsense.h"

static uint32_t memory[OWL_PLUSH_MODEL_MEMORY_WORDS];
static owl_plush_toy toy;

int main(void)
{
    return (int)owl_plush_begin(&toy, owl_plush_model, OWL_PLUSH_MODEL_BYTES, memory, sizeof memory);
}
"""


def test_cmake_builds_it_as_a_folder_as_a_package_and_as_a_zephyr_module(
    needs: Callable[..., None], tmp_path: Path
) -> None:
    needs("cmake", "gcc")
    out = export(bundle_of(window=60), tmp_path / "out", package=PackageNames("owl", "1.2.3-beta.1")).folder
    module = dict(
        row.strip().split(": ") for row in (out / "zephyr/module.yml").read_text().splitlines() if ": " in row
    )
    assert module == {"name": "owl_plushsense", "cmake": "zephyr", "kconfig": "zephyr/Kconfig"}
    assert (out / module["kconfig"]).read_text().startswith("config OWL_PLUSHSENSE\n\tbool ")
    known = "-DCMAKE_C_COMPILER_WORKS=1"  # saves time
    run("cmake", known, "-S", out, "-B", tmp_path / "own")
    run("cmake", "--build", tmp_path / "own")
    run("cmake", "--install", tmp_path / "own", "--prefix", tmp_path / "installed")
    imported = "owl_plushsense::owl_plushsense"
    for kind, find, target in (
        ("folder", f'add_subdirectory("{out}" owl)', imported),
        ("package", "find_package(owl_plushsense 1.2 REQUIRED)", imported),
        ("zephyr", f'{_ZEPHYR}add_subdirectory("{out / module["cmake"]}" owl)', "owl_plushsense"),
    ):
        user = tmp_path / kind
        user.mkdir()
        (user / "CMakeLists.txt").write_text(_USER.format(find=find, target=target))
        (user / "user.c").write_text(_USE)
        run("cmake", known, "-S", user, "-B", user / "build", f"-DCMAKE_PREFIX_PATH={tmp_path / 'installed'}")
        run("cmake", "--build", user / "build")
        run(user / "build" / "user")


_PARENT = """cmake_minimum_required(VERSION 3.13)
project(parent LANGUAGES C)
{before}
add_subdirectory("{out}" one)
add_library(parent STATIC user.c)
target_link_libraries(parent PUBLIC plushsense::plushsense)
install(TARGETS parent EXPORT parent ARCHIVE DESTINATION lib)
install(EXPORT parent FILE parent-targets.cmake DESTINATION lib/cmake/parent)
{after}
"""


def test_cmake_optimises_unless_it_is_asked_otherwise_and_a_parent_installs_it(
    packages: Packages, needs: Callable[..., None], tmp_path: Path
) -> None:
    needs("cmake", "gcc")
    out = packages["accel-3"][0]
    (tmp_path / "user.c").write_text('#include "plushsense.h"\nint user(void);\nint user(void)\n{\n    return 0;\n}\n')

    def configured(*words: str, before: str = "", after: str = "") -> subprocess.CompletedProcess[str]:
        shutil.rmtree(tmp_path / "build", ignore_errors=True)
        text = _PARENT.format(out=out, before=before, after=after)
        (tmp_path / "CMakeLists.txt").write_text(text)
        known = ("-DCMAKE_C_COMPILER_WORKS=1", "-DCMAKE_EXPORT_COMPILE_COMMANDS=1")  # the first saves time
        command = ["cmake", *known, *words, "-S", str(tmp_path), "-B", str(tmp_path / "build")]
        return subprocess.run(command, capture_output=True, text=True)

    def optimised(*words: str, before: str = "") -> list[str]:
        done = configured(*words, before=before)
        assert done.returncode == 0, done.stderr
        rows = json.loads((tmp_path / "build" / "compile_commands.json").read_text(encoding="utf-8"))
        (command,) = (row["command"] for row in rows if row["file"].endswith("plushsense.c"))
        return re.findall(r" (-O\w+)", command)

    assert optimised() == ["-O2"]
    assert optimised("-DCMAKE_BUILD_TYPE=Debug") == [] and optimised("-DCMAKE_BUILD_TYPE=MinSizeRel") == ["-Os"]
    assert optimised("-DCMAKE_C_FLAGS=-Og") == ["-Og"]
    assert optimised(before="add_compile_options(-Os)")[-1] == "-Os"
    twice = configured(after=f'add_subdirectory("{out}" two)')
    assert twice.returncode and "--name ears" in twice.stderr


def test_the_component_is_found_whatever_its_folder_is_called(packages: Packages, tmp_path: Path) -> None:
    """Field names are those that idf-component-manager 3.1.2 knows: its `compote` lets misspelt ones through."""
    known = {"name", "version", "targets", "maintainers", "description", "license", "tags", "dependencies", "overrides"}
    known |= {"files", "examples", "sbom", "url", "repository", "documentation", "issues", "discussion", "changelog"}
    known |= {"repository_info"}
    component = Path(shutil.copytree(packages["plush-15"][0] / IDF, tmp_path / "acme__ears"))
    manifest = (component / "idf_component.yml").read_text(encoding="utf-8")
    fields = re.findall(r"^(\w+):", manifest, re.M)
    assert set(fields) <= known and len(set(fields)) == len(fields)
    # A list of chips would refuse each newer one, and linux.
    assert "targets" not in fields and re.findall(r"^  (\w+): \"(.*)\"$", manifest, re.M) == [("idf", ">=5.2")]
    readme = (packages["plush-15"][0] / "README.md").read_text(encoding="utf-8")
    assert "ESP-IDF 5.2 and newer" in readme and "5.x" not in readme
    stub = 'function(idf_component_register)\n    message(STATUS "${ARGN}")\nendfunction()\n'
    for example in ("PlushToy", "RtosToy"):
        for major in (5, 6):
            script = tmp_path / "script.cmake"
            lists = component / "examples" / example / "main" / "CMakeLists.txt"
            script.write_text(f'set(IDF_VERSION_MAJOR {major})\n{stub}include("{lists}")\n')
            done = subprocess.run(["cmake", "-P", script], capture_output=True, text=True)
            words = done.stdout.split("PRIV_REQUIRES;")[1].strip().split(";")
            assert words[0] == "acme__ears"
            drivers = ["esp_driver_i2c", "esp_driver_ledc", "esp_driver_uart"] if major > 5 else ["driver"]
            assert example == "RtosToy" or words[1:] == [*drivers, "esp_timer"]


def test_the_component_manager_checks_and_packs_it(packages: Packages, tmp_path: Path) -> None:
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    if (compote := shutil.which("compote", path=places)) is None:
        missing("readers", "idf-component-manager is not installed")
    component = Path(shutil.copytree(packages["plush-15"][0] / IDF, tmp_path / "component"))
    run(compote, "manifest", "lint", component)
    run(compote, "component", "pack", "--name", "ears", "--project-dir", component, "--dest-dir", tmp_path / "dist")
    assert [p.suffix for p in (tmp_path / "dist").iterdir() if p.is_file()] == [".tgz"]


def test_the_model_s_own_version_and_page_stand_in_every_manifest_and_in_c(tmp_path: Path, c_compiler: str) -> None:
    """A toy tells which model it runs, also after a swap; the header tells version and training."""
    hashed = "0123456789abcdef" * 4
    bundle = replace(bundle_of(window=60), provenance={"dataset_hash": hashed})
    page = "https://example.org/toy"
    out = export(bundle, tmp_path / "out", package=PackageNames("owl", "2.10.0-beta.1", page)).folder
    library = out / "arduino" / "owl_plush"
    assert broken_rules(library) == [] and Export(out).changed == ()
    properties = (library / "library.properties").read_text(encoding="utf-8")
    assert (
        f"url={page}\n" in properties and "version=2.10.0-beta.1\n" in properties and "name=owl_plush\n" in properties
    )
    manifest = json.loads((library / "library.json").read_text(encoding="utf-8"))
    assert (manifest["name"], manifest["version"], manifest["homepage"]) == ("owl_plush", "2.10.0-beta.1", page)
    component = (out / "esp-idf" / "owl_plushsense" / "idf_component.yml").read_text(encoding="utf-8")
    assert f'url: "{page}"' in component and 'version: "2.10.0-beta.1"' in component
    assert Export(out).changed == (), "the bundle in the export carries the version"
    again = export(out / "model.plush", tmp_path / "again").folder
    assert read_facts(again).model_version == "2.10.0-beta.1"
    main = tmp_path / "main.c"
    main.write_text(
        '#include <stdio.h>\n#include <string.h>\n#include "owl_plush_model.h"\n#include "owl_plushsense.h"\n'
        "static uint32_t memory[OWL_PLUSH_MODEL_MEMORY_WORDS];\nstatic owl_plush_toy toy;\n"
        "int main(void)\n{\n    static uint32_t other[OWL_PLUSH_MODEL_BYTES / 4u + 1u];\n"
        "    memcpy(other, owl_plush_model, OWL_PLUSH_MODEL_BYTES);\n"
        '    printf("%lx", (unsigned long)owl_plush_model_id(&toy));\n'
        "    if (owl_plush_begin(&toy, (const uint8_t *)other, OWL_PLUSH_MODEL_BYTES, memory, sizeof memory))\n"
        "        return 1;\n"
        '    printf(" %lx %lx", (unsigned long)owl_plush_model_id(&toy), (unsigned long)OWL_PLUSH_MODEL_ID);\n'
        '    printf(" %s %s", OWL_PLUSH_MODEL_VERSION, OWL_PLUSH_MODEL_TRAINING);\n    return 0;\n}\n'
    )
    sources = [main, out / "owl_plushsense.c", out / "owl_plush_model.c"]
    run(c_compiler, "-std=c99", "-Wconversion", *WARNINGS, f"-I{out}", *sources, "-o", tmp_path / "main")
    told = subprocess.run([tmp_path / "main"], capture_output=True, check=True).stdout.decode()
    number = f"{image_check((out / 'plush_model.bin').read_bytes()):x}"
    assert told == f"0 {number} {number} 2.10.0-beta.1 {hashed}"


def test_what_a_bundle_from_elsewhere_says_of_itself_cannot_break_out(tmp_path: Path) -> None:
    odd = {"dataset_hash": '"; int x; "', "model_version": '1.0.0"\nint y;'}
    out = export(replace(bundle_of(window=60), provenance=odd), tmp_path / "out").folder
    header = (out / "plush_model.h").read_text(encoding="utf-8")
    assert 'PLUSH_MODEL_TRAINING ""' in header and "int x" not in header and "int y" not in header
    assert read_facts(out).model_version == read_facts(out).code_version


@pytest.mark.parametrize(
    "given",
    [{"model_version": v} for v in ("1.0", "v1.0.0", "1.0.0 ", "01.0.0", "1.0.0+a")]
    + [{"url": u} for u in ("example.org", "https://a b", "ftp://a.b", 'https://a"b')],
)
def test_versions_and_pages_that_no_manifest_takes_are_refused(tmp_path: Path, given: dict[str, str]) -> None:
    with pytest.raises(ConfigError, match="is no .* accepted"):
        export(bundle_of(window=60), tmp_path / "out", package=PackageNames(**given))


def test_what_the_manifests_name_exists(packages: Packages) -> None:
    for out, _ in packages.values():
        library = out / ARDUINO
        properties = dict(row.split("=", 1) for row in (library / "library.properties").read_text().splitlines())
        assert all((library / "src" / name).is_file() for name in properties["includes"].split(","))
        manifest = json.loads((library / "library.json").read_text(encoding="utf-8"))
        assert all((library / "src" / name).is_file() for name in manifest["headers"])
        boards = {*properties["architectures"].split(","), *manifest["platforms"]}
        assert {"esp32", "rp2040", "espressif32", "raspberrypi"} <= boards and not boards & {"*", "avr", "atmelavr"}
        for example in manifest["examples"]:
            assert all((library / example["base"] / name).is_file() for name in example["files"])
        assert manifest["version"] == properties["version"] == read_facts(out).model_version
        words = [row.split("\t") for row in (library / "keywords.txt").read_text().splitlines()]
        assert all(len(row) == 2 for row in words) and ["plush_push", "KEYWORD2"] in words
        for cmake in (*(out / IDF).rglob("CMakeLists.txt"), *(out / IDF_EXAMPLE).rglob("CMakeLists.txt")):
            for named in re.findall(r'"([^"$\s]+)"', cmake.read_text()):
                assert (cmake.parent / named).exists(), named
            for named in re.findall(r"CMAKE_CURRENT_LIST_DIR}/([^\"]+)", cmake.read_text()):
                assert (cmake.parent / named / "CMakeLists.txt").is_file()
        assert re.fullmatch(
            r'version: "[\d.]+"\ndescription: ".*"\nlicense: MIT\nurl: "https?://\S+"\n'
            r'dependencies:\n  idf: ">=5.2"\n',
            (out / IDF / "idf_component.yml").read_text(encoding="utf-8"),
        )
        component = (out / IDF / "CMakeLists.txt").read_text()
        assert "target_compile_options(${COMPONENT_LIB} PRIVATE -O2)" in component
        assert (out / IDF_EXAMPLE / "../../CMakeLists.txt").samefile(out / IDF / "CMakeLists.txt")
        held = {p.name for p in out.rglob("*")} | {"plush_calibrate.h"}  # which is taken in where it is there
        for source in (p for p in out.rglob("*") if p.suffix in (".c", ".h", ".ino")):
            for included in re.findall(r'#include [<"](plush\w+\.h)[">]', source.read_text(encoding="utf-8")):
                assert included in held
        for path in (
            p for p in out.rglob("*") if p.is_file() and p.suffix not in (".bin", ".plush", ".wasm", ".html", ".js")
        ):
            text = path.read_text(encoding="utf-8")
            assert not re.search(r"@\w+@|@if |@end|TODO|(?<!\$)(?<!ENV){\w+}", text), path
        assert Export(out).changed == Export(out).edited == ()
        assert (out / "LICENSE").read_text() == (REPO / "LICENSE").read_text()
