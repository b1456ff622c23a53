"""Write the reference of all files that a user may write, and of all commands: ``python docs/reference/generate.py``.

``make docs`` runs it. The commands are those of ``cli/verbs.toml``.

Keys, types and defaults are those of the dataclasses that the files are read into; their meaning is in the section
``Attributes`` of the docstrings. An entry there may end in a group in brackets, whose parts are separated by ``;``:

- a range of numbers: ``0 to 60``, ``above 0 to 60``, ``0 to below 1``, ``from 1``, ``above 1``, ``0 or from 1``;
- ``one of `NAME```: the texts in a constant of the module;
- ``default: …``: what happens where the key is missing, if the default itself does not say so.

A description that begins with "Not in a file" is of an attribute that the reader of the file refuses.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from plushsense.cli.main import parser_of
from plushsense.cli.options import VERBS
from plushsense.core.errors import ConfigError
from plushsense.core.gestures import GestureSet, load_gestures
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.toml import describe_type
from plushsense.dataset.about import About, HeadFile
from plushsense.dataset.importing.pattern import ImportPattern, read_pattern
from plushsense.dataset.importing.sources import MAPPING_COLUMNS
from plushsense.dataset.labelling import COLUMNS as LABEL_COLUMNS
from plushsense.dataset.store import PEOPLE_COLUMNS, DatasetHead
from plushsense.devices.virtual.faults import FAULTS
from plushsense.devices.virtual.scenario import ACTIONS, ToyScenario, load_scenario
from plushsense.experiments.streams.predictions import EVENT_COLUMNS
from plushsense.experiments.sweep.grid import GridSpec, load_grid
from plushsense.experiments.sweep.grid import problems as grid_problems
from plushsense.live.reactions import ReactionsFile, load_reactions
from plushsense.recording.plan import ProtocolFile, load_protocol
from plushsense.training.spec import ANYWHERE_EPOCHS, CONTEXT, PADDING, PRESETS
from plushsense.workflow.config import TABLES, resolve

PAGES = Path(__file__).parent
EXAMPLES = PAGES.parents[1] / "examples" / "files"


def _read_grid(path: Path) -> GridSpec:
    """Read a grid file; raise ConfigError for the first problem."""
    grid, problems = load_grid(path)
    for problem in (*problems, *grid_problems(grid)):
        raise ConfigError(problem)
    return grid


def _read_head(path: Path) -> DatasetHead:
    """Read a file that is called ``dataset.toml`` in its folder."""
    return DatasetHead.read(path.parent)


@dataclass(frozen=True)
class FileKind:
    """A kind of file with its page.

    Attributes:
        lead: paragraph at the top of the page, in Markdown.
        tables: dataclass of each table of the file; "" is the file itself.
        read: reads such a file.
        notes: further Markdown after the keys.
    """

    title: str
    lead: str
    tables: dict[str, type[Any]]
    read: Callable[[Path], object]
    notes: Callable[[], str] = str


def _presets() -> str:
    """Return the settings of each preset as a table."""
    keys = ("epochs", "learning_rate", "halve_every", "patience", "augment")
    rows = {key: [_toml(getattr(PRESETS[name], key)) for name in PRESETS] for key in keys}
    for at, name in enumerate(PRESETS):
        if name in ANYWHERE_EPOCHS:
            fewer = _toml(ANYWHERE_EPOCHS[name])
            rows["epochs"][at] += f" (with a vector layer and training windows anywhere: {fewer})"
    rows |= {"padding": [_toml(PADDING[n]) for n in PRESETS], "context": [_toml(CONTEXT[n]) for n in PRESETS]}
    head = _row("key", *(f"`{name}`" for name in PRESETS)) + _row(*["---"] * (len(PRESETS) + 1))
    return "## Presets\n\n" + head + "".join(_row(f"`{key}`", *(v or "none" for v in row)) for key, row in rows.items())


def _actions_and_faults() -> str:
    """Return the actions of parts and the kinds of faults of a scenario as tables."""

    def code(keys: tuple[str, ...]) -> str:
        return ", ".join(f"`{key}`" for key in keys) or "none"

    text = "## What happens in a part\n\n" + _row("`do`", "further keys", "what happens") + _row(*["---"] * 3)
    text += "".join(_row(f"`{name}`", code(keys), what) for name, (keys, what) in ACTIONS.items())
    text += (
        "\n## Kinds of faults\n\nAll have `at_s`, `duration_s` and `every_s`. Those of one moment apply in this order."
    )
    text += "\n\n"
    text += _row("`kind`", "further keys", "what goes wrong", "what a reader sees") + _row(*["---"] * 4)
    return text + "".join(_row(f"`{n}`", code(f.keys), f.what, f.effect) for n, f in FAULTS.items())


FILES = {
    "layout": FileKind(
        "Layout file: the channels of a toy",
        "A layout says what a toy measures, in which order it sends the numbers, and which of them a network reads. "
        "`--layout FILE` of [`import`](../importing.md#a-sensor-of-your-own), [`record`](../record.md) and `live` "
        "takes such a file, or the name of a built-in one.",
        {"": Layout},
        load_layout,
    ),
    "gestures": FileKind(
        "Gesture set file: gestures and their affect",
        "A gesture set lists the gestures in the order of the classes of a model. `--gestures FILE` of "
        "[`import`](../importing.md) takes it, and `--classes FILE` of [`train` and `evaluate`](../commands.md) takes "
        "one in which similar gestures are merged.",
        {"": GestureSet},
        load_gestures,
    ),
    "protocol": FileKind(
        "Protocol file: what a session records",
        "A protocol says which gestures a session records, in which order and with which prompts. `--protocol FILE` of "
        "[`record`](../record.md) takes it, and the studio offers it.",
        {"": ProtocolFile},
        load_protocol,
    ),
    "reactions": FileKind(
        "Reactions file: what the toy does",
        "A profile of reactions says how the toy answers a touch with eyes and sound. `--reactions FILE` of "
        "[`live`](../live.md) takes it.",
        {"": ReactionsFile},
        load_reactions,
    ),
    "scenario": FileKind(
        "Scenario file: an afternoon of the virtual toy",
        "A scenario says what happens to the virtual toy: people, gestures, humidity and faults. `--scenario FILE` of "
        "[`toy`](../virtual-toy.md) and `verify` takes it, and `virtual://?scenario=FILE` is a toy that plays it. "
        "Worked scenarios are in `examples/scenarios/`.",
        {"": ToyScenario},
        load_scenario,
        _actions_and_faults,
    ),
    "import": FileKind(
        "Import pattern: files of other projects",
        "A pattern says where person, session, label, take and channels stand in the files of another project. "
        "`plushsense import SRC --guess FILE` writes one, `--pattern FILE` uses it "
        "([importing](../importing.md#files-of-other-projects)). Patterns of five other forms of folders are in "
        "`examples/import/`.",
        {"": ImportPattern},
        read_pattern,
    ),
    "configuration": FileKind(
        "Configuration file: network, training, evaluation",
        "A configuration holds the settings of a run: `--config FILE` of [`train`, `evaluate` and "
        "`baselines`](../commands.md). Options of the command line override it. Every table and every key may be left "
        "out.",
        dict(TABLES),
        resolve,
        _presets,
    ),
    "grid": FileKind(
        "Grid file: many networks to compare",
        "A grid lists the networks and settings that [`sweep`](../sweep.md) trains and compares: `--grid FILE`. The "
        "table `[grid]` must be there, its keys may be left out; the defaults are those of the paper's sweep.",
        {"grid": GridSpec},
        _read_grid,
    ),
    "dataset": FileKind(
        "Data set head: `dataset.toml`",
        "Each data set has a file `dataset.toml`, which the import writes. Licence, consent and the table `[about]` "
        "may be edited; licence, consent and a contact are needed to [publish](../publishing.md) it. "
        "`format` is always 1.",
        {"": HeadFile, "about": About},
        _read_head,
    ),
}

TABLES_LEAD = """\
These files have one line of column names, and columns separated by `,` or `;`, in UTF-8. The order of the columns is
free, if nothing else is said. The table of samples that `import` reads is described in
[importing](../importing.md#one-table).
"""
# Title and use of each CSV file, and its columns with their meaning; a file may have further columns if "…" is there.
CSV_FILES: dict[str, tuple[str, dict[str, str], str]] = {
    "People": (
        "`--people FILE` of [`import`](../importing.md), and `subjects.csv` in a data set. `stats --by COLUMN` groups "
        "by any column.",
        PEOPLE_COLUMNS | {"…": "further columns of your own"},
        "subject,age_group,gender,consent,handedness\nP01,child,f,C-2026-14,left\n",
    ),
    "Person of each file": (
        "`--subjects FILE` of [`import`](../importing.md#one-folder-for-each-person-or-label).",
        MAPPING_COLUMNS,
        "file,subject\nTail pull_1589594_254.csv,P01\nTail pull/Tail pull_2281003_301.csv,P02\n",
    ),
    "Labels between recordings": (
        "`--import FILE` of [`label`](../streams.md#labels-between-recordings).",
        LABEL_COLUMNS,
        "stream,start_s,stop_s,label\nP01/fulldatastream,12.5,14.1,handling\n",
    ),
    "Predictions of another system": (
        "`--predictions FILE` of [`stream-eval`](../streams.md#score-another-system).",
        EVENT_COLUMNS,
        "stream,t,stop,label,score\nP01/fulldatastream,12.5,14.1,Head stroke 1,0.83\n",
    ),
}

# What a phrase in a description is a link to.
LINKS = {
    "layout file": "layout.md",
    "gesture set file": "gestures.md",
    "configuration file": "configuration.md",
}
_UNITS = {
    "s": "seconds",
    "seconds": "seconds",
    "ms": "milliseconds",
    "hz": "per second",
    "deg": "degrees",
    "bytes": "bytes",
}
_NUMBER = r"-?\d+(?:\.\d+)?"
RANGE = re.compile(
    rf"(?:(?P<off>{_NUMBER}) or )?(?P<bound>above |from )?(?P<low>{_NUMBER})"
    rf"(?: to (?P<below>below )?(?P<high>{_NUMBER}))?"
)
_ONE_OF = re.compile(r"one of `(\w+)`")
_ENTRY = re.compile(r" {4}(\w+): (.*)")


@dataclass(frozen=True)
class Key:
    """A key of a file.

    Attributes:
        path: tables around the key, and the key.
        kind: its type.
        range: range of numbers; "" if there is none.
        choices: accepted texts; () if there is no list.
        default: its default in Markdown; "" if the key must be given.
    """

    path: tuple[str, ...]
    kind: Any
    meaning: str
    range: str
    choices: tuple[str, ...]
    default: str

    @property
    def inner(self) -> type[Any] | None:
        """The dataclass of its tables, if it is a table or a list of tables."""
        kinds = (self.kind, *get_args(self.kind))
        return next((one for one in kinds if isinstance(one, type) and is_dataclass(one)), None)

    @property
    def value(self) -> str:
        """What may be given, in words."""
        if self.choices:
            *others, last = (f'`"{choice}"`' for choice in self.choices)
            return f"{', '.join(others)} or {last}"
        words = re.sub("'(.*?)'", r'`"\1"`', describe_type(self.kind).removeprefix("a "))
        unit = next((u for end, u in _UNITS.items() if re.search(rf"(^|_){end}$", self.path[-1])), "")
        if inner := self.inner:
            return f"{words}, see [below](#{_anchor(_heading(self.path, inner is not self.kind))})"
        return ", ".join(filter(None, (words, unit if "number" in words else "", self.range)))


def descriptions(kind: type[Any]) -> dict[str, str]:
    """Return the text on each attribute in the docstring of a dataclass and of those that it is derived from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        section = re.search(r"^Attributes:\n((?: {4}.*(?:\n|$))+)", text, re.M)
        name = ""
        for line in section[1].splitlines() if section else ():
            if entry := _ENTRY.fullmatch(line):
                name = entry[1]
                found[name] = entry[2]
            else:
                found[name] += f" {line.strip()}"
    return found


def keys(kind: type[Any], path: tuple[str, ...] = ()) -> Iterator[Key]:
    """Yield the keys of a table in the order of its fields, without those of inner tables.

    Raises:
        ValueError: for a field without a description, a description without a field, or an unclear one.
    """
    texts = descriptions(kind)
    if odd := {*texts} ^ {field.name for field in fields(kind)}:
        raise ValueError(f"{kind.__name__}: describe each field under Attributes, and nothing else: {sorted(odd)}")
    kinds = get_type_hints(kind)
    for field in fields(kind):
        text = texts[field.name]
        if text.startswith("Not in a file"):
            continue
        yield _key(kind, field, kinds[field.name], text, path)


def _key(owner: type[Any], field: Field[Any], kind: Any, text: str, path: tuple[str, ...]) -> Key:
    meaning, _, group = text.removesuffix(".").rpartition(" (")
    limits, default, choices = "", "", ()
    others = []
    for part in group.removesuffix(")").split("; ") if text.endswith(").") else ():
        if RANGE.fullmatch(part.partition(", and ")[0]):
            limits = part
        elif match := _ONE_OF.fullmatch(part):
            module = next(m for m in (sys.modules[c.__module__] for c in owner.__mro__) if hasattr(m, match[1]))
            choices = tuple(getattr(module, match[1]))
        elif part.startswith("default: "):
            default = part.removeprefix("default: ")
        else:
            others.append(part)
    if others or not (limits or default or choices):
        meaning, limits, default, choices = text.removesuffix("."), "", "", ()
    where = f"{owner.__name__}.{field.name}"
    if unclear := re.search(r"(?<!`)`(?!`)(\w[^`]*)`(?!`)", meaning):
        raise ValueError(f"{where}: {unclear[0]} is code; write what the reader of the file should know.")
    if get_origin(kind) is Literal:
        choices = tuple(filter(None, get_args(kind)))
    default = default or _default_of(field)
    if default == "None":
        raise ValueError(f"{where}: say what happens without it: (default: …)")
    return Key((*path, field.name), kind, meaning, limits, choices, default)


def _default_of(field: Field[Any]) -> str:
    """Return the default of a field in Markdown; "" if the key must be given, "None" for None."""
    value = field.default if field.default is not MISSING else None
    if field.default_factory is not MISSING:
        value = field.default_factory()
    elif field.default is MISSING:
        return ""
    elif value is None:
        return "None"
    return "as its keys say" if is_dataclass(value) else _toml(value) or "none"


def _toml(value: Any) -> str:
    """Return a value as TOML in Markdown; "" for an empty one and for None."""
    if value is None or value in ("", (), {}):
        return ""
    return f"`{_literal(value)}`"


def _literal(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_literal, value))}]"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"


def _heading(path: tuple[str, ...], each: bool) -> str:
    return f"Each of `{'.'.join(path)}`" if each else f"Table `[{'.'.join(path)}]`"


def _anchor(heading: str) -> str:
    """Return the anchor that GitHub gives to a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def sections(file: FileKind) -> Iterator[tuple[str, list[Key]]]:
    """Yield the heading and the keys of each table of a kind of file, inner tables after the outer ones."""
    waiting: list[tuple[str, type[Any], tuple[str, ...]]] = []
    for name, kind in file.tables.items():
        path = tuple(filter(None, name.split(".")))
        waiting.append((_heading(path, False) if path else "Keys", kind, path))
    while waiting:
        heading, kind, path = waiting.pop(0)
        found = list(keys(kind, path))
        yield heading, found
        inner = [(key, key.inner) for key in found]
        waiting[:0] = [(_heading(k.path, one is not k.kind), one, k.path) for k, one in inner if one is not None]


def _row(*cells: str) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"


def _table(found: list[Key]) -> str:
    lines = [_row("key", "value", "default", "meaning"), _row("---", "---", "---", "---")]
    for key in found:
        meaning = key.meaning.replace("``", "`")
        for phrase, page in LINKS.items():
            meaning = meaning.replace(phrase, f"[{phrase}]({page})")
        default = key.default.replace("``", "`") or "**must be given**"
        lines.append(_row(f"`{key.path[-1]}`", key.value, default, meaning))
    return "".join(lines)


NOTE = "<!-- Written by docs/reference/generate.py (make docs) from the code: edit the docstrings there. -->\n"
CLI_NOTE = "<!-- Written by docs/reference/generate.py (make docs): edit src/plushsense/cli/verbs.toml. -->\n"


def page(name: str) -> str:
    """Return the page of a kind of file."""
    file = FILES[name]
    text = f"{NOTE}# {file.title}\n\n{file.lead}\n"
    for heading, found in sections(file):
        text += f"\n## {heading}\n\n{_table(found)}"
    if notes := file.notes():
        text += f"\n{notes}"
    example = (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
    return f"{text}\n## Example\n\n`examples/files/{name}.toml`:\n\n```toml\n{example}```\n"


def tables_page() -> str:
    """Return the page of the CSV files."""
    text = f"{NOTE}# CSV files\n\n{TABLES_LEAD}"
    for title, (use, columns, example) in CSV_FILES.items():
        rows = "".join(_row(f"`{name}`" if name != "…" else name, meaning) for name, meaning in columns.items())
        text += f"\n## {title}\n\n{use}\n\n{_row('column', 'meaning')}{_row('---', '---')}{rows}\n```\n{example}```\n"
    return text


def index() -> str:
    """Return the page that lists the others."""
    text = f"{NOTE}# Files that you may write\n\nEvery key of every file, with its default and an example.\n"
    text += f"\n{_row('file', 'page')}{_row('---', '---')}"
    for name, file in FILES.items():
        title, _, what = file.title.partition(": ")
        text += _row(f"{title}: {what}", f"[{name}]({name}.md)")
    text += _row("CSV files: people, labels, predictions", "[tables](tables.md)")
    return text + (
        "\nMost of the files are TOML, in UTF-8: `key = value` on a line, text in quotes, lists in `[ ]`. A table "
        "`[name]` holds the keys below it. An unknown key or an unfit value is refused, with what is accepted.\n"
    )


CLI_LEAD = """\
All options of all commands. [Commands](../commands.md) says which command is for what, and has examples.

Every command also takes `--help`, and `--json`: then it prints one JSON object on standard output and nothing else
there. The exit status is 0 when done, 1 when a check said no, 2 for bad input. Names in capitals stand for what you
give.
"""


def _argument(action: argparse.Action) -> str:
    """Return an argument as it is written on the command line."""
    value = action.metavar or "|".join(map(str, action.choices or ())) or action.dest.upper()
    words = " ".join(value) if isinstance(value, tuple) else value
    names = ", ".join(action.option_strings)
    if not names:
        return f"[{words}]" if action.nargs == "?" else f"{words} …" if action.nargs in ("*", "+") else words
    optional = f"[{words}]" if action.nargs == "?" else words
    return names if action.nargs == 0 else f"{names} {optional}"


def cli_page() -> str:
    """Return the page of all commands, with the texts of ``--help``."""
    text = f"{CLI_NOTE}# Options of all commands\n\n{CLI_LEAD}"
    for verb in VERBS:
        parser = parser_of(verb)
        about, _, more = (parser.description or "").partition("\n\n")
        text += f"\n## {verb}\n\n{about}\n"
        text += "".join(f"\n```text\n{part.strip(chr(10))}\n```\n" for part in (more, parser.epilog or "") if part)
        text += f"\n{_row('argument', 'meaning')}{_row('---', '---')}"
        for action in parser._actions:
            if action.dest not in ("help", "json"):
                meaning = re.sub(r"([*_<\[])", r"\\\1", (action.help or "").replace("%%", "%"))
                needed = " (must be given)" if action.required and action.option_strings else ""
                text += _row(f"`{_argument(action)}`", f"{meaning}{needed}")
    return text


def pages() -> dict[str, str]:
    """Return the text of each page by its file name."""
    files = {f"{name}.md": page(name) for name in FILES}
    return {"README.md": index(), "tables.md": tables_page(), "cli.md": cli_page()} | files


if __name__ == "__main__":
    for name, text in pages().items():
        (PAGES / name).write_text(text, encoding="utf-8", newline="\n")
