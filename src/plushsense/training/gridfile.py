"""Grids as they are written: a name, a TOML file, or options of the command line.

    [grid]
    name = "small"
    architectures = ["14d1_39d2_41d4", "100_151"]
    filters = [[4, 6, 8, 8], [8, 12, 16, 16]]      # a network takes as many as it has layers
    epochs = [20]
    batches = [64, "full"]                         # "full": all windows that a fold trains on
    seeds = [0, 1, 2]
    split = "by-subject:5"

The keys are the fields of `GridSpec`; what a file leaves out is as in the paper's grid.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from plushsense.core.errors import ArchError, ConfigError, nearest
from plushsense.core.tomlfile import read_toml
from plushsense.models.symbol import parse_filters
from plushsense.training.grid import FULL, GRIDS, GridSpec, first_line

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


# A search of the grid's networks stands beside it in the file: see `training.searchfile`.
TABLES = ("grid", "search")

# What is accepted, in words, and what reads it; TypeError or ValueError for all else.
Reader = tuple[str, Callable[[Any], Any]]
Spec = TypeVar("Spec", bound="DataclassInstance")


def load_grid(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> tuple[GridSpec, list[str]]:
    """A grid by its name or from a TOML file, with ``changes`` over it (values, or text as on the command line).

    Returns:
        the grid, and one sentence for each key or value that cannot be read; those are as in the paper's grid.

    Raises:
        ConfigError: for an unknown name, or a file that is missing or not TOML.
    """
    if str(name_or_path) in GRIDS:
        grid, found = GRIDS[str(name_or_path)], list[str]()
    else:
        tables, found = grid_tables(name_or_path)
        grid, more = over(GridSpec(name=Path(name_or_path).stem), tables["grid"], f" of [grid] in '{name_or_path}'")
        found += more
    grid, more = changed(grid, changes or {})
    return grid, found + more


def changed(grid: GridSpec, changes: Mapping[str, Any]) -> tuple[GridSpec, list[str]]:
    """A grid with some keys changed, as in `load_grid`; a change of None is none."""
    return over(grid, {key: value for key, value in changes.items() if value is not None}, "")


def grid_tables(path: str | Path) -> tuple[dict[str, Mapping[str, Any]], list[str]]:
    """The tables of a grid's file by name, and one sentence for each that cannot be read; those are empty.

    Raises:
        ConfigError: for a file that is missing or not TOML.
    """
    if Path(path).suffix != ".toml" and not Path(path).is_file():
        raise ConfigError(
            f"Unknown grid '{path}': accepted are {', '.join(GRIDS)} and the path of a TOML file."
            f"{nearest(str(path), GRIDS)}"
        )
    content = read_toml(Path(path), "grid", ConfigError)
    found = [unknown(key, TABLES, f"'{path}'") for key in content if key not in TABLES]
    tables: dict[str, Mapping[str, Any]] = {name: {} for name in TABLES}
    for name in tables:
        if isinstance(content.get(name), Mapping):
            tables[name] = content[name]
        elif name in content or name == "grid":
            found.append(f"'{path}' has no table [{name}]: write  [{name}]  and its keys below.")
    return tables, found


def over(
    spec: Spec, table: Mapping[str, Any], where: str, read_as: Mapping[str, Reader] | None = None
) -> tuple[Spec, list[str]]:
    """A grid (or with ``read_as`` another spec) with the values of a table, and a sentence for each that is wrong."""
    values, found, known = dict[str, Any](), list[str](), _READ if read_as is None else read_as
    for key, value in table.items():
        if key not in known:
            found.append(unknown(key, known, where.removeprefix(" of ") or "the grid"))
            continue
        accepted, read = known[key]
        try:
            values[key] = read(value)
        except ArchError as cause:
            found.append(f"{first_line(cause)[:-1]}, in {key}{where}.")
            values |= _readable(key, value, read)
        except (TypeError, ValueError):
            found.append(f"{key}{where} is {value!r}: accepted is {accepted}.")
            values |= _readable(key, value, read)
    return replace(spec, **values), found


def _readable(key: str, value: Any, read: Callable[[Any], Any]) -> dict[str, Any]:
    """What can be read of a list, so that what else is wrong with the grid is said of it and not of the default."""
    kept: list[Any] = []
    for item in value if isinstance(value, list | tuple) else ():
        with contextlib.suppress(ArchError, TypeError, ValueError):
            kept += read([item])
    return {key: tuple(kept)} if kept else {}


def unknown(key: str, known: Iterable[str], where: str) -> str:
    """The sentence for a key that nobody reads."""
    known = tuple(known)
    return f"Unknown key '{key}' in {where}: accepted are {', '.join(known)}.{nearest(key, known)}"


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def whole(value: Any) -> int:
    """A whole number, or its text."""
    if isinstance(value, str):
        return int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(value)
    return value


def number(value: Any) -> float:
    """A number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(value)
    return float(value)


def many(read: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    """A list of what ``read`` reads; text is split at its commas."""

    def of(value: Any) -> tuple[Any, ...]:
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",")]
        if not isinstance(value, list | tuple):
            raise TypeError(value)
        return tuple(read(item) for item in value)

    return of


def _batch(value: Any) -> int | str:
    return FULL if value == FULL else whole(value)


def _filters(value: Any) -> tuple[int, ...]:
    return parse_filters(value.replace("/", ",")) if isinstance(value, str) else many(whole)(value)


def _filter_sets(value: Any) -> tuple[tuple[int, ...], ...]:
    """``[[4, 6], [8, 12]]``, or text: ``4,6,8,8`` is one set, ``4/6/8/8,8/12/16/16`` are two."""
    if isinstance(value, str):
        value = [part.strip() for part in value.split(",")] if "/" in value else [value]
    if not isinstance(value, list | tuple):
        raise TypeError(value)
    return tuple(_filters(item) for item in value)


def _labels(value: Any) -> str:
    return value if isinstance(value, str) else ",".join(many(_text)(value))


_READ: dict[str, Reader] = {
    "name": ("text", _text),
    "architectures": ("a list of symbols, as ['14d1_39d2_41d4']", many(_text)),
    "filters": ("a list of filter sets, as [[4, 6, 8, 8], [8, 12, 16, 16]]", _filter_sets),
    "epochs": ("a list of whole numbers", many(whole)),
    "batches": (f"a list of whole numbers and '{FULL}'", many(_batch)),
    "seeds": ("a list of whole numbers", many(whole)),
    "split": ("text", _text),
    "split_seed": ("a whole number", whole),
    "preset": ("text", _text),
    "padding": ("text", _text),
    "norm": ("text", _text),
    "context": ("text", _text),
    "classes": ("text, or a list of labels", _labels),
    "window_s": ("a number", number),
    "step_s": ("a number", number),
    "learning_rate": ("a number", number),
    "halve_every": ("a whole number", whole),
    "patience": ("a whole number", whole),
    "turn_deg": ("a number", number),
    "device": ("text", _text),
    "threads": ("a whole number", whole),
}
