"""The README of an export folder: this model's numbers, and how to use, prove and swap it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from plushsense.deploy.emit import BUNDLE, FACTS, IMAGE, TOY_BYTES, c_names
from plushsense.models.bundle import Bundle

_SIMULATION = (
    "> **SIMULATION.** This model was trained on the virtual toy. It knows no real person's touch, and its scores say\n"
    "> nothing about a real toy. Use it to try the tools, not to play with people.\n"
)


def handbook(bundle: Bundle, facts: Mapping[str, Any]) -> str:
    """The text, in Markdown; all figures are those of ``facts`` (of ``export.json``) and of the bundle."""
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
            *_affect_said(facts),
            "## How good it is",
            "",
            *_scores(bundle.provenance, simulated),
            *_personal(bundle.personal),
            "",
            _USE.format(image=IMAGE, gap=facts["gap_ms"], channels=len(facts["channels"])),
            "## What this folder holds",
            "",
            *_table(("", ""), [(f"`{name}`", what) for name, what in (_HOLDS | _converted(facts)).items()]),
            "",
            f"No recording is in it: the golden frames are made up. `{BUNDLE}` and `{FACTS}` say",
            "how many people the model was trained on, not who. A network was made from people's recordings all the",
            "same: the consent they gave, and the licence of the data set, decide to whom it may be given.",
            "",
            "The code is under the MIT licence (`LICENSE`).",
            "",
        ]
    )


_HOLDS = {
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
partition and `esp_partition_mmap()`). They need no alignment. The checksum is looked at first. The bytes of an earlier
PlushSense, without events, are `PLUSH_OTHER_VERSION`: export that model again.

```c
#include <stddef.h>

#include "plush_model.h"
#include "plushsense.h"

static uint32_t pool[2048]; /* as much as the largest model needs */
static plush_toy toy;

plush_status swap(const uint8_t *model, uint32_t bytes)
{{
    plush_status status = plush_begin(&toy, model, bytes, pool, sizeof pool);

    /* A model for other channels cannot read your frames: begun on nothing, the toy is silent. */
    if (status == PLUSH_OK && toy.layout != PLUSH_MODEL_LAYOUT)
        status = plush_begin(&toy, NULL, 0, NULL, 0); /* PLUSH_NOT_A_MODEL */
    return status;
}}
```

`PLUSH_MODEL_LAYOUT` stands for the names, units, steps and order of the channels; where a sensor is mounted, nobody
checks.
"""


def _converted(facts: Mapping[str, Any]) -> dict[str, str]:
    """The files for other runtimes, with how far from the network they are."""
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


def _affect_said(facts: Mapping[str, Any]) -> list[str]:
    untold = [g["label"] for g in facts["gestures"] if g["affect"] == "none"]
    if not untold:
        return []
    return [
        f"Nobody told an affect for {len(untold)} of {facts['classes']} gestures: the library then says",
        "`PLUSH_AFFECT_NONE`, and the example gives each such gesture a colour of its own. Affect is told in the",
        "gesture set (`plushsense import RECORDINGS DS --gestures FILE`).",
        "",
    ]


def _people(found: object) -> int | None:
    return found if isinstance(found, int) else len(found) if isinstance(found, list) else None


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
    said = [*_table(("", ""), rows), ""]
    if leaky:
        said += [
            "**LEAKY**: windows of the same recordings were trained on. These figures flatter, and say nothing about",
            "people that the toy has not met.",
            "",
        ]
    if simulated:
        said += ["**SIMULATION**: of the virtual toy; no result.", ""]
    return [
        *said,
        "One split of one training, in floating point where nothing else is said: whole numbers may differ in single",
        "answers. For figures over everybody ask `plushsense evaluate --int8`.",
    ]
