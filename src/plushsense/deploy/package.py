"""What a firmware engineer needs around an export: an Arduino library, an ESP-IDF component, an example, a README."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from plushsense.deploy.emit import BUNDLE, LIBRARY, MODEL, read_facts
from plushsense.deploy.firmware import firmware
from plushsense.deploy.handbook import handbook
from plushsense.models.bundle import Bundle

ARDUINO = "arduino/PlushSense"
IDF = "esp-idf/plushsense"
IDF_EXAMPLE = "esp-idf/example"
SKETCH = f"{ARDUINO}/examples/PlushToy"
LICENCE = "LICENSE"
_SENTENCE = "What a soft toy feels: a small streaming network in whole numbers."
_AUTHOR = "The PlushSense developers"
_WIRE = ("plush_wire.h", "plush_wire.c")
_EXAMPLE = ("plush_reaction.h", "plush_reaction.c", "plush_fake.h", "plush_fake.c")


def package(out: Path, facts: Mapping[str, Any] | None = None) -> list[Path]:
    """Add the packages to an export folder; ``facts`` are those of its ``export.json``, which by default is read.

    The library and the model are copied from the folder. Files of these names are written over.

    Returns:
        the files that were written.

    Raises:
        BadInput: where the folder is no export.
        LayoutError: for a layout that the toy's lines cannot carry.
    """
    facts = read_facts(out) if facts is None else facts
    bundle = Bundle.load(out / BUNDLE)
    made = firmware(bundle.layout, bundle.scaler, facts)
    header = (out / LIBRARY[0]).read_text(encoding="utf-8")
    texts = {
        "README.md": handbook(bundle, facts),
        **{f"{folder}{LICENCE}": _licence() for folder in ("", f"{ARDUINO}/", f"{IDF}/")},
        f"{ARDUINO}/library.properties": _properties(facts),
        f"{ARDUINO}/library.json": _platformio(facts),
        f"{ARDUINO}/keywords.txt": _keywords(header + made["plush_wire.h"]),
        f"{SKETCH}/PlushToy.ino": made["PlushToy.ino"],
        f"{IDF}/CMakeLists.txt": _component(),
        f"{IDF}/idf_component.yml": _manifest(facts),
        f"{IDF_EXAMPLE}/CMakeLists.txt": _PROJECT,
        f"{IDF_EXAMPLE}/sdkconfig.defaults": _SDKCONFIG,
        f"{IDF_EXAMPLE}/main/CMakeLists.txt": _MAIN,
        f"{IDF_EXAMPLE}/main/main.c": made["main.c"],
    }
    for name in _WIRE:
        texts |= {f"{ARDUINO}/src/{name}": made[name], f"{IDF}/{_place(name)}": made[name]}
    for name in _EXAMPLE:
        texts |= {f"{SKETCH}/{name}": made[name], f"{IDF_EXAMPLE}/main/{name}": made[name]}
    contents = {name: text.encode() for name, text in texts.items()}
    contents |= {copy: (out / original).read_bytes() for copy, original in copies().items()}
    written = []
    for name, content in contents.items():
        path = out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        written.append(path)
    return written


def copies() -> dict[str, str]:
    """The files of the packages that are copies of others of the folder: copy to original, relative to it."""
    names = (*LIBRARY, *MODEL)
    return {f"{ARDUINO}/src/{n}": n for n in names} | {f"{IDF}/{_place(n)}": n for n in names}


def changed_copies(out: Path) -> list[str]:
    """Copies in an export folder that are no longer like their originals: ``verify`` proves the originals only."""
    return [
        copy
        for copy, original in copies().items()
        if (out / copy).is_file() and (out / copy).read_bytes() != (out / original).read_bytes()
    ]


def _place(name: str) -> str:
    return f"{'include' if name.endswith('.h') else 'src'}/{name}"


def _licence() -> str:
    return (files("plushsense.deploy") / "c" / LICENCE).read_text(encoding="utf-8")


def _about(facts: Mapping[str, Any]) -> str:
    simulated = " SIMULATION: trained on a virtual toy." if facts["simulated"] else ""
    return (
        f"Model {facts['title']}: {facts['classes']} gestures from {len(facts['channels'])} channels "
        f"(layout {facts['layout']}), an answer every {facts['step_ms']:g} ms.{simulated}"
    ).replace("\n", " ")


def _properties(facts: Mapping[str, Any]) -> str:
    lines = {
        "name": "PlushSense",
        "version": facts["code_version"],
        "author": _AUTHOR,
        "maintainer": _AUTHOR,
        "sentence": _SENTENCE,
        "paragraph": f"{_about(facts)} For boards with 32 bits.",
        "category": "Data Processing",
        "architectures": "*",
        "includes": f"{LIBRARY[0]},{MODEL[0]}",
        "license": "MIT",
    }
    return "".join(f"{key}={value}\n" for key, value in lines.items())


def _platformio(facts: Mapping[str, Any]) -> str:
    manifest = {
        "name": "PlushSense",
        "version": facts["code_version"],
        "description": f"{_SENTENCE} {_about(facts)}",
        "keywords": ["touch", "gesture recognition", "tinyml"],
        "license": "MIT",
        "authors": [{"name": _AUTHOR}],
        "frameworks": "*",
        "platforms": "*",
        "headers": [LIBRARY[0], MODEL[0]],
        "examples": [
            {
                "name": "PlushToy",
                "base": "examples/PlushToy",
                "files": ["PlushToy.ino", *_EXAMPLE],
            }
        ],
    }
    return json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"


def _keywords(headers: str) -> str:
    """What the Arduino editor colours: types, functions and constants of the headers."""
    code = re.sub(r"/\*.*?\*/", "", headers, flags=re.S)
    kinds = {
        "KEYWORD1": re.findall(r"^} (plush_\w+);", code, re.M),
        "KEYWORD2": re.findall(r"^[a-z].*?\b(plush_\w+)\(", code, re.M),
        "LITERAL1": [n for n in re.findall(r"\b(PLUSH_\w+)\b", code) if not n.endswith("_H")],
    }
    return "".join(f"{word}\t{kind}\n" for kind, words in kinds.items() for word in dict.fromkeys(words))


def _component() -> str:
    sources = " ".join(f'"src/{n}"' for n in (*LIBRARY, *MODEL, *_WIRE) if n.endswith(".c"))
    return f'idf_component_register(SRCS {sources}\n                       INCLUDE_DIRS "include")\n'


def _manifest(facts: Mapping[str, Any]) -> str:
    # JSON strings are YAML strings.
    return (
        f"version: {json.dumps(facts['code_version'])}\n"
        f"description: {json.dumps(f'{_SENTENCE} {_about(facts)}', ensure_ascii=False)}\n"
        "license: MIT\n"
        'dependencies:\n  idf: ">=5.0"\n'
    )


_PROJECT = """\
cmake_minimum_required(VERSION 3.16)
set(EXTRA_COMPONENT_DIRS "${CMAKE_CURRENT_LIST_DIR}/../plushsense")
include($ENV{IDF_PATH}/tools/cmake/project.cmake)
project(plush_toy)
"""
_MAIN = f"""\
idf_component_register(SRCS "main.c" {" ".join(f'"{n}"' for n in _EXAMPLE if n.endswith(".c"))}
                       PRIV_REQUIRES plushsense driver esp_timer)
"""
_SDKCONFIG = """\
# A tick of the scheduler is 1 ms: the readings keep their time.
CONFIG_FREERTOS_HZ=1000
CONFIG_ESP_MAIN_TASK_STACK_SIZE=4096
# The port belongs to the toy's lines; only errors are said there.
CONFIG_LOG_DEFAULT_LEVEL_ERROR=y
CONFIG_BOOTLOADER_LOG_LEVEL_ERROR=y
"""
