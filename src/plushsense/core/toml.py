"""Read TOML files strictly: refuse unknown keys, and values whose type is not that of the dataclass field; read JSON.

`cattrs` creates the dataclasses; this module sets the rules (the only conversion is from whole number to float) and
formats the error messages.
"""

from __future__ import annotations

import functools
import json
import math
import numbers
import re
import tomllib
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from plushsense.core.errors import BadInput, nearest
from plushsense.core.files import read_bytes

if TYPE_CHECKING:
    from cattrs import Converter

T = TypeVar("T")
_MOST_BYTES = 64 << 20
Steps = tuple[str | int, ...]
"""Path from a table to a value in it: keys and indices."""


def builtin_names(folder: str) -> tuple[str, ...]:
    """Return the names of the TOML files in ``core/data/<folder>``."""
    root = resources.files("plushsense.core") / "data" / folder
    return tuple(sorted(p.name.removesuffix(".toml") for p in root.iterdir() if p.name.endswith(".toml")))


def read_named(name_or_path: str | Path, folder: str, kind: str, error: type[BadInput]) -> tuple[dict[str, Any], str]:
    """Read a built-in TOML file by its name, or any other by its path; return its table and its name for messages.

    Raises:
        error: for an unknown name, a missing file, or a file that is not TOML.
    """
    text = str(name_or_path)
    if text in builtin_names(folder):
        source = resources.files("plushsense.core") / "data" / folder / f"{text}.toml"
        return tomllib.loads(source.read_text(encoding="utf-8")), text
    path = Path(text)
    if path.suffix != ".toml" and not path.is_file():
        known = builtin_names(folder)
        raise error(
            f"Unknown {kind} '{text}': the built-in ones are {', '.join(known)}; "
            f"or give the path of a TOML file.{nearest(text, known)}"
        )
    return read_toml(path, kind, error), text


def loads_json(text: str) -> Any:
    """Return the value of a JSON text; half surrogate pairs, which no file in UTF-8 can hold, become U+FFFD.

    Raises:
        ValueError, RecursionError: like `json.loads`.
    """
    value = json.loads(text)
    return _whole_characters(value) if "\\ud" in text.lower() else value


def _whole_characters(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    if isinstance(value, list):
        return [_whole_characters(item) for item in value]
    if isinstance(value, dict):
        return {_whole_characters(key): _whole_characters(item) for key, item in value.items()}
    return value


def read_toml(path: Path, kind: str, error: type[BadInput]) -> dict[str, Any]:
    """Read the TOML file at ``path``; ``kind`` names its content in messages. Raise ``error`` if that fails."""
    try:
        return tomllib.loads(read_bytes(path, _MOST_BYTES).decode("utf-8-sig"))
    except FileNotFoundError:
        raise error("There is no {kind} file '{path}': check the path.", kind=kind, path=path) from None
    except (OSError, UnicodeDecodeError) as cause:
        raise error(
            "The {kind} file '{path}' cannot be read ({cause}): give a UTF-8 TOML file.",
            kind=kind,
            path=path,
            cause=cause,
        ) from None
    except (tomllib.TOMLDecodeError, RecursionError) as cause:
        raise error("The {kind} file '{path}' is not valid TOML: {cause}.", kind=kind, path=path, cause=cause) from None


def load_table(
    table: object, kind: type[T], where: str, error: type[BadInput], template: str = "", text: str = ""
) -> T:
    """Create an instance of the dataclass ``kind`` from a table.

    Args:
        table: its keys are the fields of ``kind``; inner tables become dataclasses, and lists become tuples.
        where: name of the table in messages, such as "layout 'plush-15'".
        template: sentence of the error with ``{problem}`` in it, "" for the problem alone.
        text: the TOML that ``table`` was read from, so that messages name the line.

    Raises:
        error: for the first unknown or missing key or unfit value; the message has its path.
    """
    try:
        made: T = _converter().structure(table, kind)
    except Exception as cause:  # noqa: BLE001
        steps, leaf, expected = next(_leaves(cause, (), kind))
        line = line_of(text, (*steps, *_wrong_key(leaf, table, steps)))
        named = f"{where}, line {line}" if line else where
        problem = _message(table, steps, leaf, expected, named)
        raise (error(template, problem=problem, where=where) if template else error(problem)) from None
    return made


_TOML_KEYS = re.compile(r"""\s*(?:\[\[?\s*(?P<header>[^\]\n]+?)\s*\]|(?P<key>[\w.\s"'-]+?)\s*=)""")


def line_of(text: str, steps: Steps) -> int:
    """Return the line, from 1, of a TOML text that sets the value at ``steps`` or a table around it; 0 if none does."""
    wanted = [step for step in steps if isinstance(step, str)]
    table: list[str] = []
    best, line = 0, 0
    for number, row in enumerate(text.splitlines(), 1):
        match = _TOML_KEYS.match(row)
        if match is None:
            continue
        keys = [key.strip(" \t\"'") for key in (match["header"] or match["key"]).split(".")]
        if match["header"]:
            table = keys
        there = table if match["header"] else [*table, *keys]
        if best < len(there) <= len(wanted) and wanted[: len(there)] == there:
            best, line = len(there), number
    return line


def _wrong_key(cause: Exception, table: object, steps: Steps) -> Steps:
    """Return the key, below ``steps``, that an error is about, as far as the error says so."""
    from cattrs.errors import ForbiddenExtraKeysError

    if isinstance(cause, ForbiddenExtraKeysError):
        return (next(key for key in _value(table, steps) if key in cause.extra_fields),)
    key = cause.message.values.get("key") if isinstance(cause, BadInput) else None
    return (key,) if isinstance(key, str) else ()


def check_table(table: Mapping[str, Any], kind: type[Any], where: str) -> tuple[dict[str, Any], list[str]]:
    """Check a table that sets some fields of the dataclass ``kind``; return its valid values and the error messages.

    Keys may be missing, since the values override other settings. Of a list, the valid items are kept.
    """
    known = get_type_hints(kind)
    values: dict[str, Any] = {}
    problems = []
    for key, value in table.items():
        if key not in known:
            problems.append(unknown_key(key, known, where))
            continue
        try:
            values[key] = _converter().structure(value, known[key])
        except Exception as cause:  # noqa: BLE001
            leaves = list(_leaves(cause, (key,), known[key]))
            problems += [_message(table, steps, leaf, expected, where) for steps, leaf, expected in leaves]
            wrong = {steps[1] for steps, _, _ in leaves if len(steps) > 1}
            if wrong and get_origin(known[key]) is tuple and len(wrong) < len(value):
                fitting = [item for index, item in enumerate(value) if index not in wrong]
                values[key] = _converter().structure(fitting, known[key])
    return values, problems


def unknown_key(key: str, known: Iterable[str], where: str) -> str:
    """Return the error message for an unknown key, with the nearest known one."""
    known = tuple(known)
    return f"Unknown key '{key}' in {where}: accepted are {', '.join(known)}.{nearest(key, known)}"


def refuse_unknown(table: Mapping[str, Any], known: Iterable[str], where: str, error: type[BadInput]) -> None:
    """Raise ``error`` for the first key of a table that is not in ``known``."""
    known = tuple(known)
    for key in table:
        if key not in known:
            raise error(unknown_key(key, known, where))


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_UNIONS = (Union, types.UnionType)
_ONE = {int: "a whole number", float: "a number", str: "text", bool: "true or false", type(None): ""}
_MANY = {int: "whole numbers", float: "numbers", str: "texts", bool: "true and false"}


def describe_type(kind: Any, many: bool = False) -> str:
    """Describe a type in words, such as "a list of whole numbers"; ``many`` asks for the plural."""
    origin = get_origin(kind)
    if origin in _UNIONS:
        return " or ".join(filter(None, (describe_type(one, many) for one in get_args(kind))))
    if origin is Literal:
        return " or ".join(f"'{value}'" for value in get_args(kind))
    if origin is tuple:
        return f"{'lists' if many else 'a list'} of {describe_type(get_args(kind)[0], many=True)}"
    return (_MANY if many else _ONE).get(kind, "tables" if many else "a table")


def _message(table: object, steps: Steps, cause: Exception, expected: Any, where: str) -> str:
    from cattrs.errors import ForbiddenExtraKeysError

    path = "".join(
        f"[{step}]" if isinstance(step, int) else f".{step}" if _BARE_KEY.fullmatch(step) else f'."{step}"'
        for step in steps
    ).removeprefix(".")
    inner = f"{where}, {path}" if path else where
    if isinstance(cause, ForbiddenExtraKeysError):
        key = next(key for key in _value(table, steps) if key in cause.extra_fields)
        return unknown_key(key, get_type_hints(cause.cl), inner)
    if isinstance(cause, BadInput | ValueError):
        return f"In {inner}: {cause}"
    try:
        value = _value(table, steps)
    except LookupError:
        return f"In {where}, the key {path} is missing: add it."
    subject = path or "what was given"
    return f"In {where}, {subject} is {value!r}: accepted is {describe_type(expected)}."


def _value(table: object, steps: Steps) -> Any:
    for step in steps:
        table = table[step]  # type: ignore[index]
    return table


def _leaves(cause: Exception, steps: Steps, expected: Any) -> Iterator[tuple[Steps, Exception, Any]]:
    """Yield every single error in an exception of cattrs: its path, the exception and the expected type."""
    from cattrs.errors import ClassValidationError, IterableValidationError

    if isinstance(cause, ClassValidationError):
        named, others = cause.group_exceptions()
        errors = [(inner, (*steps, note.name), note.type) for inner, note in named]
    elif isinstance(cause, IterableValidationError):
        indexed, others = cause.group_exceptions()
        errors = [(inner, (*steps, note.index), note.type) for inner, note in indexed]
    else:
        yield steps, cause, expected
        return
    for inner, at, kind in [*((one, steps, expected) for one in others), *errors]:
        yield from _leaves(inner, at, kind)


def _structure_number(value: Any, kind: type[Any]) -> Any:
    if isinstance(value, bool) or not isinstance(value, numbers.Integral if kind is int else numbers.Real):
        raise TypeError(kind)
    number = kind(value)
    if not math.isfinite(number):
        raise TypeError(kind)
    return number


def _structure_exact(value: Any, kind: type[T]) -> T:
    if not isinstance(value, kind):
        raise TypeError(kind)
    return value


def _is_tuple(kind: Any) -> bool:
    return get_origin(kind) is tuple


def _is_union(kind: Any) -> bool:
    return get_origin(kind) in _UNIONS


@functools.cache
def _converter() -> Converter:
    """Return a converter that coerces nothing. cattrs is imported here because importing it is slow."""
    from cattrs import Converter
    from cattrs.gen import make_dict_structure_fn

    converter = Converter()

    def tuples_of(kind: Any) -> Any:
        listed: Any = list[get_args(kind)[0]]  # type: ignore[misc]
        structure = converter.get_structure_hook(listed)

        def structure_tuple(value: Any, _: Any) -> tuple[Any, ...]:
            if not isinstance(value, Iterable) or isinstance(value, str | bytes | Mapping):
                raise TypeError(kind)
            return tuple(structure(value, listed))

        return structure_tuple

    def one_of(kind: Any) -> Any:
        options = [(one, converter.get_structure_hook(one)) for one in get_args(kind) if one is not type(None)]

        def structure_union(value: Any, _: Any) -> Any:
            if value is None and type(None) in get_args(kind):
                return None
            for one, structure in options:
                try:
                    return structure(value, one)
                except Exception as cause:  # noqa: BLE001
                    failed = cause
            # Of several options, it is unknown which one was meant.
            raise failed if len(options) == 1 else TypeError(kind)

        return structure_union

    def tables_of(kind: Any) -> Any:
        structure = make_dict_structure_fn(kind, converter, _cattrs_forbid_extra_keys=True)

        def structure_table(value: Any, _: Any) -> Any:
            if not isinstance(value, Mapping):
                raise TypeError(kind)
            return structure(value, kind)

        return structure_table

    for kind, hook in {
        int: _structure_number,
        float: _structure_number,
        str: _structure_exact,
        bool: _structure_exact,
    }.items():
        converter.register_structure_hook(kind, hook)
    converter.register_structure_hook_factory(_is_tuple, tuples_of)
    converter.register_structure_hook_factory(_is_union, one_of)
    converter.register_structure_hook_factory(is_dataclass, tables_of)
    return converter
