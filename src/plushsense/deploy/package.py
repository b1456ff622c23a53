"""README, Arduino library and ESP-IDF component of an export folder."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from plushsense.deploy.emit import BUNDLE, FACTS, IMAGE, LIBRARY, MODEL, TOY_BYTES, c_names, read_facts
from plushsense.deploy.firmware import firmware
from plushsense.models.bundle import Bundle

_SIMULATION = (
    "> **SIMULATION.** This model was trained on the virtual toy. It knows no real person's touch, and its scores say\n"
    "> nothing about a real toy. Use it to try the tools, not to play with people.\n"
)


def handbook(bundle: Bundle, facts: Mapping[str, Any]) -> str:
    """Render the README in Markdown from the ``facts`` (of ``export.json``) and the bundle."""
    layout = bundle.layout
    second = 1e6 / facts["period_us"]
    simulated = bool(facts["simulated"])
    return "\n".join(
        [
            f"# {facts['title']}: {facts['classes']} gestures, for the toy",
            "",
            *([_SIMULATION] if simulated else []),
            f"Made by PlushSense {facts['code_version']}. A network of {facts['parameters']:,} parameters in whole",
            "numbers, in C99 without heap, floating point or operating system, that gives, bit for bit, the answers of",
            f"`plushsense live --engine int8 --model {BUNDLE}`.",
            "",
            *_table(
                ("", ""),
                [
                    ("network", f"`{facts['symbol']}`, filters {', '.join(map(str, facts['filters']))}"),
                    ("parameters", f"{facts['parameters']:,}"),
                    ("an answer every", f"{facts['step_ms']:g} ms ({facts['step']} samples)"),
                    ("a sample every", f"{facts['period_us'] / 1000:g} ms ({facts['rate_hz']:g} Hz)"),
                    (
                        "warming, from the start and after every gap",
                        f"{facts['span']} samples, {facts['span'] / second:.2f} s",
                    ),
                    ("multiply-accumulates an answer", f"{facts['macs_per_step']:,}"),
                    ("flash: the model's data", f"{facts['model_bytes']:,} bytes; the code comes on top"),
                    (
                        "RAM: a toy",
                        f"{facts['memory_bytes']:,} bytes of memory and {TOY_BYTES} of `plush_toy` "
                        "(pointers of 32 bits); no heap",
                    ),
                ],
            ),
            "",
            "How many instructions, how much code and stack on which chip: `plushsense profile .`",
            "",
            "## What goes in",
            "",
            f"Layout `{layout.name}`: the values of a frame stand in this order, as integers.",
            "",
            *_table(
                ("", "channel", "in C", "unit", "valid from", "to"),
                [
                    (str(i), c.name, f"`PLUSH_CHANNEL_{name}`", _unit(c.unit, c.step), f"{low}", f"{high}")
                    for i, (c, name, low, high) in enumerate(
                        zip(
                            layout.channels,
                            c_names(layout.names),
                            layout.valid_min_int.tolist(),
                            layout.valid_max_int.tolist(),
                            strict=True,
                        )
                    )
                ],
            ),
            "",
            "A value outside its range is no reading: the last valid one stands in, and `toy.invalid` counts it. There",
            "are no answers before every channel has had a valid value. The sensors must be those of the recordings:",
            "same sign, scale, order. `plush_fake.c` of the example shows where the values lay in training.",
            "",
            "## What comes out",
            "",
            *_table(
                ("class", "gesture", "affect", "in C"),
                [
                    (str(i), _cell(g["label"]), g["affect"], f"`PLUSH_GESTURE_{g['c_name']}`")
                    for i, g in enumerate(facts["gestures"])
                ],
            ),
            "",
            *_affect_note(facts),
            "## How good it is",
            "",
            *_scores(bundle.provenance, simulated),
            *_personal(bundle.personal),
            "",
            _USE.format(image=IMAGE, toy_bytes=TOY_BYTES, gap=facts["gap_ms"], channels=len(facts["channels"])),
            "## What this folder holds",
            "",
            *_table(("", ""), [(f"`{name}`", what) for name, what in (_CONTENTS | _converted(facts)).items()]),
            "",
            f"No recording is in it: the golden frames are made up. `{BUNDLE}` and `{FACTS}` say",
            "how many people the model was trained on, not who. A network was made from people's recordings all the",
            "same: the consent they gave, and the licence of the data set, decide to whom it may be given.",
            "",
            "The code is under the MIT licence (`LICENSE`).",
            "",
        ]
    )


_CONTENTS = {
    "plushsense.h`, `plushsense.c": "the library, the same for every model",
    "plush_model.h`, `plush_model.c": "this model as data, and its numbers as macros",
    IMAGE: "the same data as a file, to be loaded from flash",
    "arduino/PlushSense": "an Arduino library with the example PlushToy; with `library.json`, for PlatformIO too",
    "esp-idf/plushsense": "an ESP-IDF component; `esp-idf/example` is a project that uses it",
    "golden": "frames and the answers that must come of them",
    BUNDLE: "the network as it was trained, in floating point",
    FACTS: "the numbers above, for programs",
}

_USE = """\
## Start

- Arduino: copy `arduino/PlushSense` into your `libraries` folder, open File > Examples > PlushSense > PlushToy.
- PlatformIO: `lib_deps = symlink://…/arduino/PlushSense` in `platformio.ini`, and the example's files as `src`.
- ESP-IDF 5.2 to 5.x: `idf.py -C esp-idf/example set-target esp32 build flash`.

The example runs without sensors, on made-up readings; `SENSORS` at its top switches to yours. It sends every frame as a
line at 115200 baud, so that `plushsense record` and `plushsense live --device serial://PORT` work while the toy feels.

## In your own program

```c
#include "plushsense.h"
#include "plush_model.h"

static uint32_t memory[PLUSH_MODEL_MEMORY_WORDS];
static plush_toy toy;

void react(plush_affect affect); /* yours */
void calm_down(void);            /* yours */

static void on_event(const plush_toy *of, void *user)
{{
    (void)user;
    if (of->event.what == PLUSH_BEGUN)
        react(of->event.affect);
    else if (of->event.what == PLUSH_ENDED)
        calm_down();
}}

int begin(void)
{{
    plush_status status = plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, memory, sizeof memory);

    toy.on_event = on_event;
    return status == PLUSH_OK;
}}

/* Every frame: `ms` is when it was read, `values` holds {channels} integers. */
void frame(uint32_t ms, const int32_t *values)
{{
    plush_push(&toy, ms, values);
}}
```

**React to events.** There is one for each touch: it *begins* when its affect is sure (a blow within a few samples, by
the gate; else by the network), is *named* when its gesture is sure too, if that comes later, and *ends*. `toy.event` is
the newest thing that happened to one: `what`, `number`, `affect`, `gesture` (`PLUSH_NO_GESTURE` while unnamed),
`source`, `since_ms`, `ms`. `toy.answer`, every step, is what the network makes of it all, sure or not: its `kind` says
whether it is idle, unknown, unsure, sure of an affect or of a gesture.

Whatever begins ends: by itself, when another takes its place (that one's beginning follows at once), in a gap, a fault,
silence or a restart. While it warms, the toy may already tell events, of the gate. In `on_event` do little, for it runs
within `plush_push()`: set a flag, and play the sound in your loop, as the example does.

**Sensors that fail** (out of range, stuck at an end, all frozen; the limits stand in the model) end the event that goes
on. `toy.answer.state` is `PLUSH_FAULT` until they have recovered, then the toy is warming; `toy.faults` counts. When no
frame comes at all, nobody can tell the toy but you: `plush_silence(&toy)` ends what goes on; call it once, when none
came for longer than {gap} ms.

One task or interrupt uses a toy at a time. Several toys may share a model, each with its own `plush_toy` and memory.

**When plush_begin() fails** it says why (`plush_status`), and the toy takes frames without ever having an answer. Show
it, and go on sending frames: the example blinks the status.

**Missed ticks.** Only the time that comes with a frame counts. Who comes late reads once, with the true time, and
does not make up for ticks that went by. Up to {gap} ms are bridged by interpolation, and every answer that fell due is
given; after a longer gap, or when the clock runs backwards, the toy is warming again (`toy.restarts` counts it).

## Prove it, measure it

`plushsense verify .` compiles the library and the model that stand here and compares every answer with those in
`golden`, bit for bit, on this computer and on the emulated chips that are installed (`--target` chooses). The packages
hold copies of these files: whoever edits one edits it here, and copies. `plushsense profile .` counts instructions,
flash, RAM and stack.

## Another model without compiling

Put `{image}` of another export into flash and begin on its bytes, which must stay readable (on an ESP32: a data
partition and `esp_partition_mmap()`). They need no alignment. The bytes of an earlier PlushSense, without events, are
`PLUSH_OTHER_VERSION`: export that model again.

```c
#include "plush_model.h"
#include "plushsense.h"

static uint32_t pool[2048]; /* as much as the largest model needs */
static plush_toy toy;

plush_status begin(void)
{{
    return plush_begin(&toy, plush_model, PLUSH_MODEL_BYTES, pool, sizeof pool);
}}

/* Later, between two frames: `model` lies where the running model does not. */
plush_status swap(const uint8_t *model, uint32_t bytes)
{{
    return plush_swap(&toy, model, bytes, pool, sizeof pool);
}}
```

`plush_swap()` looks through all of the new model before it changes anything. Unless it returns `PLUSH_OK`, the old
model goes on with everything it remembers, and an open event stays open: `PLUSH_NOT_A_MODEL`, `PLUSH_OTHER_VERSION` and
`PLUSH_DAMAGED` are about the bytes, `PLUSH_MEMORY_TOO_SMALL` about `pool`; `PLUSH_OTHER_LAYOUT` is a model for other
channels, or a toy on which `plush_begin()` has not returned `PLUSH_OK`. With `PLUSH_OK` an open event has ended
(`on_event` was called once, as ever), callbacks and counts stay, the toy is warming, and the old model's bytes are no
longer read. It needs a `plush_toy` on the stack ({toy_bytes} bytes where pointers have 32 bits, and some more).

The checksum finds damage, not forgery: check a signature before you swap to bytes that came over the air. The layout
number stands for the names, units, steps and order of the channels; where a sensor is mounted, nobody checks.
"""


def _converted(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return a description of each converted file, with its largest difference of logits."""
    found = {}
    for name, each in facts.get("conversions", {}).items():
        apart = each["largest_difference"]
        far = "" if apart is None else f"; logits differ by up to {apart:.1g} from those it was made of"
        found[str(each["file"])] = f"the network alone for another runtime (`--also {name}`){far}"
    return found


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in (head, tuple("---" for _ in head), *rows)]


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _unit(unit: str, step: float) -> str:
    return unit if step == 1.0 else f"{step:g} {unit}"


def _affect_note(facts: Mapping[str, Any]) -> list[str]:
    without = [g["label"] for g in facts["gestures"] if g["affect"] == "none"]
    if not without:
        return []
    return [
        f"Nobody told an affect for {len(without)} of {facts['classes']} gestures: the library then says",
        "`PLUSH_AFFECT_NONE`, and the example gives each such gesture a colour of its own. Affect is told in the",
        "gesture set (`plushsense import RECORDINGS DS --gestures FILE`).",
        "",
    ]


def _people(value: object) -> int | None:
    return value if isinstance(value, int) else len(value) if isinstance(value, list) else None


def _personal(personal: Mapping[str, Any]) -> list[str]:
    if not personal:
        return []
    found = personal.get("leave_one_recording_out") or {}
    before, after = (found.get(when) or {} for when in ("before", "after"))
    many, right, was = after.get("recordings", "?"), after.get("right", "?"), before.get("right", "?")
    return [
        "",
        "**Adapted to one person**: the last layer was moved by a minute of somebody's gestures, and any figures above",
        f"are of the network before. Of {many} recordings of that person, each read by a layer moved without it,",
        f"{right} are read right, before {was}. For other people it may be worse.",
    ]


def _scores(provenance: Mapping[str, Any], simulated: bool) -> list[str]:
    scores = provenance.get("scores")
    if not isinstance(scores, Mapping) or "accuracy" not in scores:
        return [f"`{BUNDLE}` carries no scores: ask `plushsense evaluate` for some."]
    leaky = bool(scores.get("leaky", False))
    trained, others = (_people(provenance.get(key)) for key in ("subjects", "validation_subjects"))
    windows = f"{scores.get('windows', 'an unknown number of')} windows"
    rows = [
        ("data set", _cell(f"{provenance.get('dataset', 'not told')}{' (SIMULATION)' if simulated else ''}")),
        *([("trained on", f"{trained} people")] if trained is not None else []),
        ("scored on", f"{windows}{f' of {others} other people' if others else ''}, split `{scores.get('split', '?')}`"),
        *((name, f"{scores[key]:.3f}") for name, key in (("accuracy", "accuracy"), ("macro-F1", "macro_f1"))),
    ]
    int8 = scores.get("int8")
    if isinstance(int8, Mapping):
        rows += [
            ("accuracy, macro-F1 in 8 bits", f"{int8['accuracy']:.3f}, {int8['macro_f1']:.3f}"),
            ("the same answer in 8 bits", f"{100 * int8['agreement']:.1f} % of the windows"),
        ]
    lines = [*_table(("", ""), rows), ""]
    if leaky:
        lines += [
            "**LEAKY**: windows of the same recordings were trained on. These figures flatter, and say nothing about",
            "people that the toy has not met.",
            "",
        ]
    if simulated:
        lines += ["**SIMULATION**: of the virtual toy; no result.", ""]
    return [
        *lines,
        "One split of one training, in floating point where nothing else is said: whole numbers may differ in single",
        "answers. For figures over everybody ask `plushsense evaluate --int8`.",
    ]


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
    """Add the packages to an export folder; ``facts`` default to those of its ``export.json``.

    The library and the model are copied from the folder. Files of these names are written over.

    Returns:
        the files that were written.

    Raises:
        BadInput: where the folder is no export.
        LayoutError: for a layout that the toy's lines cannot carry.
    """
    facts = read_facts(out) if facts is None else facts
    bundle = Bundle.load(out / BUNDLE)
    rendered = firmware(bundle.layout, bundle.scaler, facts)
    header = (out / LIBRARY[0]).read_text(encoding="utf-8")
    texts = {
        "README.md": handbook(bundle, facts),
        **{f"{folder}{LICENCE}": _licence() for folder in ("", f"{ARDUINO}/", f"{IDF}/")},
        f"{ARDUINO}/library.properties": _properties(facts),
        f"{ARDUINO}/library.json": _platformio(facts),
        f"{ARDUINO}/keywords.txt": _keywords(header + rendered["plush_wire.h"]),
        f"{SKETCH}/PlushToy.ino": rendered["PlushToy.ino"],
        f"{IDF}/CMakeLists.txt": _component(),
        f"{IDF}/idf_component.yml": _manifest(facts),
        f"{IDF_EXAMPLE}/CMakeLists.txt": _PROJECT,
        f"{IDF_EXAMPLE}/sdkconfig.defaults": _SDKCONFIG,
        f"{IDF_EXAMPLE}/main/CMakeLists.txt": _MAIN,
        f"{IDF_EXAMPLE}/main/main.c": rendered["main.c"],
    }
    for name in _WIRE:
        texts |= {f"{ARDUINO}/src/{name}": rendered[name], f"{IDF}/{_component_path(name)}": rendered[name]}
    for name in _EXAMPLE:
        texts |= {f"{SKETCH}/{name}": rendered[name], f"{IDF_EXAMPLE}/main/{name}": rendered[name]}
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
    """Return the files of the packages that are copies: copy to original, relative to the folder."""
    names = (*LIBRARY, *MODEL)
    return {f"{ARDUINO}/src/{n}": n for n in names} | {f"{IDF}/{_component_path(n)}": n for n in names}


def changed_copies(out: Path) -> list[str]:
    """Return the copies in an export folder that differ from their originals: ``verify`` tests only the originals."""
    return [
        copy
        for copy, original in copies().items()
        if (out / copy).is_file() and (out / copy).read_bytes() != (out / original).read_bytes()
    ]


def _component_path(name: str) -> str:
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
    """Return the Arduino editor's keywords: types, functions and constants of the headers."""
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
