"""Write the export folder: C library, model, golden vectors, README, packages for build systems, example firmware."""

from __future__ import annotations

import json
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from plushsense.core.errors import BadInput, LayoutError, ToolError
from plushsense.core.files import new_folder, read_bytes
from plushsense.core.layouts import ACCELERATION, DELAY_MS, DEVICE_MS, Channel, Layout
from plushsense.core.sentences import Message
from plushsense.core.templates import c_comment, fill_text
from plushsense.dataset.readings import GravityReading, Readings
from plushsense.deploy.code import (
    BUNDLE,
    FACTS,
    GOLDEN,
    IMAGE,
    LIBRARY,
    TOY_BYTES,
    ConversionFacts,
    ModelFacts,
    c_names,
    check_names,
    code_files,
    facts_of,
    prefixed,
)
from plushsense.deploy.convert import CONVERTERS, convert
from plushsense.deploy.golden import measured, write_golden
from plushsense.deploy.wasm import module
from plushsense.deploy.web import PAGE, large_page, web_files
from plushsense.models.bundle import Bundle
from plushsense.runtime.image import IntegerModel
from plushsense.windows.features import Scaler

ARDUINO = "arduino/PlushSense"
IDF = "esp-idf/plushsense"
IDF_EXAMPLE = f"{IDF}/examples/PlushToy"
IDF_TASKS = f"{IDF}/examples/RtosToy"
SKETCH = f"{ARDUINO}/examples/PlushToy"
LICENCE = "LICENSE"
TWO_SLOTS = "examples/two_slots"
ON_CHIP = "examples/verify_device"
BINDING = "examples/binding"
BUFFERED = "examples/fifo"
# Examples without templates: their folders in `c`, and their files.
_PLAIN = {
    TWO_SLOTS: ("two_slots", ("plush_update.h", "plush_update.c")),
    ON_CHIP: ("device", ("plush_device.h", "plush_device.c", "plush_hooks.c", "verify_device.ino")),
    BINDING: ("binding", ("plush_binding.h", "plush_binding.c", "plush_binding.rs")),
    BUFFERED: ("fifo", ("plush_fifo.h", "plush_fifo.c")),
}
# Manifests must have an address; PlushSense has no page of its own. RFC 6761: nobody can own this one.
NO_PAGE = "https://plushsense.invalid/"
IDF_SINCE = "5.2"  # of ESP-IDF; the examples use its driver of I2C, which is new there
_WIRE = ("plush_wire.h", "plush_wire.c")
_EXAMPLE = tuple(f"plush_{part}.{kind}" for part in ("reaction", "fake", "rest") for kind in "hc")
FIRMWARE = (*_WIRE, *_EXAMPLE, "PlushToy.ino", "main.c")
"""Files of the example firmware, with templates in ``c/toy``."""
_TEMPLATES = {
    "CMakeLists.txt": "CMakeLists.txt",
    "zephyr/module.yml": "zephyr_module.yml",
    "zephyr/CMakeLists.txt": "zephyr_CMakeLists.txt",
    "zephyr/Kconfig": "zephyr_Kconfig",
    f"{ARDUINO}/library.properties": "library.properties",
    f"{ARDUINO}/library.json": "library.json",
    f"{IDF}/CMakeLists.txt": "component_CMakeLists.txt",
    f"{IDF}/idf_component.yml": "idf_component.yml",
    f"{IDF_EXAMPLE}/CMakeLists.txt": "project_CMakeLists.txt",
    f"{IDF_EXAMPLE}/main/CMakeLists.txt": "main_CMakeLists.txt",
    f"{IDF_EXAMPLE}/sdkconfig.defaults": "sdkconfig.defaults",
    f"{IDF_TASKS}/CMakeLists.txt": "project_CMakeLists.txt",
    f"{IDF_TASKS}/main/CMakeLists.txt": "rtos_main_CMakeLists.txt",
    f"{IDF_TASKS}/sdkconfig.defaults": "rtos_sdkconfig.defaults",
}


def export_files(
    bundle: Bundle, facts: ModelFacts, code: Mapping[str, bytes], wasm: bytes | None = None
) -> dict[str, bytes]:
    """Return the contents of the files of an export, by their paths: its code, README, packages for build systems, web.

    The packages are an Arduino library, an ESP-IDF component, a CMake project and a Zephyr module. ``code`` holds the
    library and the model without the name of the export (`plushsense.deploy.code.code_files`), and ``wasm`` is the
    WebAssembly module, without which there is no page.

    Raises:
        LayoutError: for a layout with values that the toy's line format cannot represent.
    """
    rendered = firmware(bundle.layout, bundle.scaler, facts, bundle.readings)
    name = facts.name
    header = prefixed(code[LIBRARY[0]].decode(), name)
    c_folder = files("plushsense.deploy") / "c"
    licence = (c_folder / LICENCE).read_text(encoding="utf-8")
    simulated = " SIMULATION: trained on a virtual toy." if facts.simulated else ""
    paragraph = (
        f"Model {facts.title}: {facts.classes} gestures from {len(facts.channels)} channels "
        f"(layout {facts.layout}), an answer every {facts.step_ms:g} ms.{simulated}"
    )
    values = {
        "version": facts.model_version,
        "url": facts.url or NO_PAGE,
        "idf_versions": f">={IDF_SINCE}",
        **_folders(name),
        "author": "The PlushSense developers",
        "sentence": "What a soft toy feels: a small streaming network in whole numbers.",
        "paragraph": paragraph.replace("\n", " "),
    }
    texts = {
        "README.md": handbook(bundle, facts),
        **{f"{folder}/README.md": _fill("templates/package_README.md", **values) for folder in (ARDUINO, IDF)},
        **{f"{folder}{LICENCE}": licence for folder in ("", f"{ARDUINO}/", f"{IDF}/")},
        **{path: _fill(f"templates/{name}", **values) for path, name in _TEMPLATES.items()},
        f"{ARDUINO}/keywords.txt": _keywords(header + rendered["plush_wire.h"]),
        f"{SKETCH}/PlushToy.ino": rendered["PlushToy.ino"],
        f"{IDF_EXAMPLE}/main/main.c": rendered["main.c"],
        f"{IDF_TASKS}/main/main.c": (c_folder / "rtos" / "main.c").read_text(encoding="utf-8"),
        **{f"{IDF_TASKS}/main/{file}": rendered[file] for file in ("plush_fake.h", "plush_fake.c")},
    }
    for example, (folder, names) in _PLAIN.items():
        texts |= {f"{example}/{f}": (c_folder / folder / f).read_text(encoding="utf-8") for f in names}
    harness = (c_folder / "harness.c").read_text(encoding="utf-8")
    texts[f"{ON_CHIP}/plush_harness.c"] = f"#define PLUSH_HARNESS_DEVICE 1\n{harness}"
    for file in _WIRE:
        texts |= {f"{ARDUINO}/src/{file}": rendered[file], f"{IDF}/{_component_path(file)}": rendered[file]}
    for file in _EXAMPLE:
        texts |= {f"{SKETCH}/{file}": rendered[file], f"{IDF_EXAMPLE}/main/{file}": rendered[file]}
    own = {file: content.decode() for file, content in code.items() if file != IMAGE}
    texts |= {f"{ARDUINO}/src/{file}": text for file, text in own.items()}
    texts |= {f"{IDF}/{_component_path(file)}": text for file, text in own.items()}
    contents = {file: prefixed(text, name).encode() for file, text in (own | {IMAGE: ""} | texts).items()}
    named = {_named_path(file, name): content for file, content in (contents | {IMAGE: code[IMAGE]}).items()}
    return named | web_files(bundle, facts, code[IMAGE], wasm)


def _component_path(name: str) -> str:
    return f"{'include' if name.endswith('.h') else 'src'}/{name}"


def _named_path(path: str, name: str) -> str:
    """Return the path of a file of the packages in an export with a name: also the packages are called by it."""
    folders = _folders(name)
    for plain, named in ((ARDUINO, f"arduino/{folders['library']}"), (IDF, f"esp-idf/{folders['component']}")):
        if path == plain or path.startswith(f"{plain}/"):
            path = path.replace(plain, named, 1)
    return prefixed(path, name)


def _folders(name: str) -> dict[str, str]:
    """Return what the Arduino library and the ESP-IDF component of an export with this name are called."""
    return {
        "library": f"{name}_plush" if name else ARDUINO.split("/")[1],
        "component": f"{name}_plushsense" if name else IDF.split("/")[1],
    }


# What a compiler or a build system may read.
_HEADERS = frozenset((".h", ".hh", ".hpp", ".hxx", ".inc", ".gch", ".pch"))
_SOURCES = _HEADERS | {".c", ".cc", ".cpp", ".cxx", ".s", ".asm", ".ino", ".py", ".cmake", ".a", ".o", ".so"}


def foreign_files(out: Path, expected: Mapping[str, bytes], name: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the files of an export folder that are not those in ``expected`` (contents by path).

    These are other contents, links, and further files where compilers look for those of the library: headers beside
    it, and code in the folders of its packages. Documents are left out.

    Returns:
        Files that are compiled with the library, and files of the examples, which are there to be changed.
    """
    names = [path for path in expected if not path.endswith(".md") and (out / path).exists()]
    found = [path for path in names if (out / path).is_symlink() or not _holds(out / path, expected[path])]
    library = f"{_named_path(ARDUINO, name)}/src"
    component = _named_path(IDF, name)
    places = {"": _HEADERS, "zephyr": _SOURCES, f"{component}/include": _SOURCES, f"{component}/src": _SOURCES}
    inside = [(out / place, kinds, (out / place).glob("*")) for place, kinds in places.items()]
    inside.append((out / library, _SOURCES, (out / library).rglob("*")))
    for _, kinds, entries in inside:
        paths = (entry for entry in entries if entry.suffix.lower() in kinds)
        found += [path for entry in paths if (path := entry.relative_to(out).as_posix()) not in expected]
    examples = tuple(path for path in found if "examples" in path.split("/"))
    return tuple(path for path in found if path not in examples), examples


def _holds(path: Path, content: bytes) -> bool:
    try:
        return read_bytes(path, len(content)) == content
    except OSError:
        return False


def handbook(bundle: Bundle, facts: ModelFacts) -> str:
    """Render the README in Markdown from the ``facts`` (of ``export.json``) and the bundle, not yet `prefixed`."""
    layout = bundle.layout
    ranges = layout.valid_min_int.tolist(), layout.valid_max_int.tolist()
    samples_of_gap = -(-layout.gap_ms * 1000 // layout.period_us)
    return _fill(
        "templates/README.md",
        facts=facts,
        idf=IDF_SINCE,
        measured=bundle.readings is not None,
        **_folders(facts.name),
        channels=list(zip(layout.channels, c_names(layout.names), *ranges, strict=True)),
        provenance=bundle.provenance,
        personal=bundle.personal,
        toy_bytes=TOY_BYTES,
        samples_of_gap=samples_of_gap,
        answers_of_gap=-(-samples_of_gap // facts.step),
        bundle=BUNDLE,
        calibrate=bool(layout.self_calibration),
        image=IMAGE,
        facts_file=FACTS,
    )


def _fill(template: str, **values: Any) -> str:
    return fill_text("plushsense.deploy", f"{template}.j2", **values)


def _keywords(headers: str) -> str:
    """Return the keywords for the Arduino editor: types, functions and constants in ``headers``."""
    code = re.sub(r"/\*.*?\*/", "", headers, flags=re.S)
    kinds = {
        "KEYWORD1": re.findall(r"^} (plush_\w+);", code, re.M),
        "KEYWORD2": re.findall(r"^[a-z].*?\b(plush_\w+)\(", code, re.M),
        "LITERAL1": [n for n in re.findall(r"\b(PLUSH_\w+)\b", code) if not n.endswith("_H")],
    }
    return "".join(f"{word}\t{kind}\n" for kind, words in kinds.items() for word in dict.fromkeys(words))


# Touch pads of the ESP32 as (pad, GPIO); the last ones are strapping pins, which also decide how the chip boots.
_PADS = ((0, 4), (3, 15), (4, 13), (6, 14), (7, 27), (8, 33), (9, 32), (2, 2), (5, 12), (1, 0))
_NO_PAD = 255
# 1 g in several units, and one count of the MPU-6050's gyroscope.
_MOTION = {
    ACCELERATION: {"g": 1.0, "mg": 1000.0, "m/s²": 9.80665, "m/s2": 9.80665},
    "angular rate": {"°/s": 1 / 131, "deg/s": 1 / 131, "rad/s": math.radians(1 / 131)},
}
_MPU_ONE_G = 16384
_FIRST_AXIS = {"acceleration": 0, "angular rate": 3}
_PADDED = ("capacitive", "proximity")
# Channels that are sums of others (the paper's Table 1: "cumulative signal, based on all the capacitive sensors").
_TOTALS = ("cap_all",)
_MOST_DECIMALS = 9


@dataclass(frozen=True)
class _ChannelSource:
    """Source of a channel: ``kind`` of the C enum, touch pad and GPIO (or the axis twice), factor as C code, zero."""

    kind: str
    pad: int = 0
    pin: int = 0
    factor: str = "0"
    zero: int = 0
    note: str = ""


def firmware(layout: Layout, scaler: Scaler, facts: ModelFacts, readings: Readings | None = None) -> dict[str, str]:
    """Render the files of `FIRMWARE` for a model with these ``facts`` (of ``export.json``), by name.

    ``readings`` are those of the training, if they are known.

    Raises:
        LayoutError: for a channel whose step the toy's line format cannot represent.
    """
    sources = _sources(layout, readings)
    formats = [_decimal_format(c) for c in layout.channels]
    names = {c.name: f"PLUSH_CHANNEL_{n}" for c, n in zip(layout.channels, c_names(layout.names), strict=True)}
    indent = " *     "
    values = {
        "title": c_comment(facts.title),
        "idf": IDF_SINCE,
        "layout": c_comment(layout.name),
        "classes": facts.classes,
        "period_ms": f"{layout.period_us / 1000:g}",
        "gap_ms": layout.gap_ms,
        "warming_s": f"{facts.span * layout.period_us / 1e6:.2g}",
        "decimal": any(f != (1, 0) for f in formats),
        "delay_only": DEVICE_MS not in layout.wire,
        "fields": textwrap.fill(c_comment(" ".join(layout.wire)), 110, initial_indent=indent, subsequent_indent=indent),
        "line_bytes": _line_bytes(layout, formats),
        "wire": [names.get(field, field.upper()) for field in layout.wire],
        "kinds": {s.kind for s in sources},
        "one_g": _MPU_ONE_G,
        "is_measured": readings is not None,
        "rest": [layout.index(name) for rest in facts.rest[:1] if rest.steps for name in rest.channels],
        "channels": [
            {
                "name": c_comment(channel.name),
                "unit": c_comment(channel.unit),
                "source": source,
                "written": f"{{{times}, {decimals}}}",
                "usual": f"{{{mean}, {spread}}}",
            }
            for channel, source, (times, decimals), (mean, spread) in zip(
                layout.channels, sources, formats, _statistics(layout, scaler, readings), strict=True
            )
        ],
    }
    return {name: _fill(f"c/toy/{name}", **values) for name in FIRMWARE}


def _sources(layout: Layout, readings: Readings | None) -> list[_ChannelSource]:
    sources: list[_ChannelSource] = []
    pads = iter(_PADS)
    axes = dict(_FIRST_AXIS)
    others = 0
    known = {name: rest for rest in (readings.rest if readings else ()) for name in rest.axes}
    for channel in layout.channels:
        factor, zero, note = _motion_factor(channel, known.get(channel.name))
        if channel.kind in _PADDED and channel.step == 1.0:
            if channel.name in _TOTALS:
                sources.append(_ChannelSource("TOTAL", note=": the sum of all pads"))
            elif pad := next(pads, None):
                sources.append(_ChannelSource("TOUCH", *pad))
            else:
                sources.append(_ChannelSource("TOUCH", _NO_PAD, _NO_PAD, note=": NO PAD IS LEFT for it"))
        elif factor and axes[channel.kind] < _FIRST_AXIS[channel.kind] + 3:
            sources.append(_ChannelSource("MOTION", axes[channel.kind], axes[channel.kind], factor, zero, note))
            axes[channel.kind] += 1
        else:
            sources.append(_ChannelSource("OTHER", others, others, note=": see read_other()"))
            others += 1
    return sources


def _motion_factor(channel: Channel, rest: GravityReading | None) -> tuple[str, int, str]:
    """Return C code of the factor from sensor counts to steps of the channel, in 1/65536, the zero, and a note.

    The factor is "" if it cannot be computed. 1 g in steps is what was measured, else what the unit says, else what was
    estimated.
    """
    zero, unit = round(channel.offset / channel.step), _MOTION.get(channel.kind, {}).get(channel.unit, 0.0)
    steps = unit / (channel.scale * channel.step)
    if rest is not None and not (rest.is_estimated and steps):
        steps, zero = math.copysign(rest.one_g, channel.scale), round(rest.zero[rest.axes.index(channel.name)])
    if channel.kind == ACCELERATION and steps:
        one_g = round(steps) or int(math.copysign(1, steps))
        return (f"ONE_G({one_g})" if abs(one_g) < _MPU_ONE_G << 15 else ""), zero, ""
    note = ""
    if channel.kind in _MOTION and channel.unit == "count":
        steps, note = 1.0 / channel.step, ": ITS SCALE IS NOT KNOWN"
    factor = round(65536 * steps)
    return (str(factor) if 0 < abs(factor) < 1 << 31 else ""), zero, note


def _decimal_format(channel: Channel) -> tuple[int, int]:
    """Return by what a channel's integer is multiplied for the toy's lines, and the number of decimals there."""
    decimals = 0
    while decimals < _MOST_DECIMALS and round(channel.step * 10**decimals, 6) != round(channel.step * 10**decimals):
        decimals += 1
    times = round(channel.step * 10**decimals)
    if not 1 <= times < 1 << 29:
        raise LayoutError(
            f"Channel '{channel.name}': a step of {channel.step:g} cannot be written on the toy's lines, which have up "
            f"to {_MOST_DECIMALS} decimals: choose another step."
        )
    return times, decimals


def _line_bytes(layout: Layout, formats: list[tuple[int, int]]) -> int:
    clocks = sum(10 for field in layout.wire if field in (DEVICE_MS, DELAY_MS))
    values = sum(1 + max(len(str((1 << 31) * times)), 1 + decimals) + (decimals > 0) for times, decimals in formats)
    return clocks + values + len(layout.wire) + 1


def _statistics(layout: Layout, scaler: Scaler, readings: Readings | None) -> list[tuple[int, int]]:
    """Return mean and spread of each channel in training, else by `measured`, limited to the valid range."""
    mean, spread = measured(layout, scaler) if readings is None else (readings.mean, readings.spread)
    rows = []
    for at, wide, low, high in zip(
        mean, spread, layout.valid_min_int.tolist(), layout.valid_max_int.tolist(), strict=True
    ):
        middle = min(max(round(at), low), high)
        rows.append((middle, min(round(wide), (high - middle) // 2, (middle - low) // 2)))
    return rows


@dataclass(frozen=True)
class ExportResult:
    """Result of an export; ``files`` are relative to ``folder``, the sizes as in `ModelFacts`.

    ``page_note``: a sentence, if there is no page, or a larger one than is meant; else empty.
    """

    folder: Path
    facts: ModelFacts
    page_note: str = ""

    @property
    def files(self) -> tuple[str, ...]:
        return self.facts.files

    @property
    def flash_bytes(self) -> int:
        return self.facts.flash_bytes

    @property
    def ram_bytes(self) -> int:
        return self.facts.ram_bytes

    def to_json(self) -> dict[str, object]:
        """Return the object that ``plushsense export --json`` prints."""
        facts = self.facts.to_json()
        del facts["files"]
        sizes = {"flash_bytes": self.flash_bytes, "ram_bytes": self.ram_bytes}
        return {**facts, "folder": str(self.folder), "files": list(self.files), **sizes}


def emit(
    model: IntegerModel,
    bundle: Bundle,
    out: Path,
    *,
    name: str = "",
    url: str = "",
    also: Sequence[str] = (),
    windows: NDArray[Any] | None = None,
) -> ExportResult:
    """Write an export folder atomically.

    Args:
        model: model for the toy, made from ``bundle``.
        bundle: also written to the folder (names, scores, float network), without the codes of the training people.
        out: a folder that does not exist yet, or is empty.
        name: prefix of all C names and C files (`plushsense.deploy.code.prefixed`), so that several exports link into
            one program.
        url: web page of the model, for the manifests.
        also: formats for other runtimes (`plushsense.deploy.convert.CONVERTERS`).
        windows: integer windows (N, C, T) to test the converted files with.

    Raises:
        BadInput: if the folder is not empty, or cannot be written.
        ConfigError: for a name or address that is not accepted.
        ArchError, BundleError, MissingExtraError: as `plushsense.deploy.convert.convert`.
        LayoutError: for a layout with values that the toy's line format cannot represent.
    """
    check_names(name, url=url)
    bundle = bundle.without_people()
    code, web, note = code_files(model, bundle), None, Message()
    try:
        web = module(calibrate=bool(model.layout.self_calibration))
    except ToolError as cause:
        note = cause.message
    with new_folder(out, BadInput) as part:
        conversions = {}
        for other in dict.fromkeys(also):
            done = convert(bundle, part / CONVERTERS[other].file_name, other, windows=windows)
            conversions[other] = ConversionFacts(done.path.name, done.bytes, done.largest_difference, done.notes)
        facts = replace(facts_of(model, bundle, code[IMAGE]), name=name, url=url, conversions=conversions)
        contents = export_files(bundle, facts, code, web)
        note = note or large_page(len(contents.get(PAGE, b"")))
        for file, content in contents.items():
            (part / file).parent.mkdir(parents=True, exist_ok=True)
            (part / file).write_bytes(content)
        bundle.save(part / BUNDLE)
        write_golden(model, bundle.scaler, part / GOLDEN)
        files = {p.relative_to(part).as_posix() for p in part.rglob("*") if p.is_file()}
        facts = replace(facts, files=tuple(sorted({*files, FACTS})))
        text = json.dumps(facts.to_json(), indent=1, ensure_ascii=False)
        (part / FACTS).write_text(text + "\n", "utf-8", newline="\n")
    return ExportResult(out, facts, note)
