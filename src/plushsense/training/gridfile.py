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

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from plushsense.core.errors import ArchError, ConfigError, nearest
from plushsense.core.tomlfile import read_toml
from plushsense.models.symbol import parse_filters
from plushsense.training.grid import FULL, GRIDS, GridSpec, first_line


def load_grid(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> tuple[GridSpec, list[str]]:
    """A grid by its name or from a TOML file, with ``changes`` over it (values, or text as on the command line).

    Returns:
        the grid, and one sentence for each key or value that cannot be read; those are as in the paper's grid.

    Raises:
        ConfigError: for an unknown name, or a file that is missing or not TOML.
    """
    text, found = str(name_or_path), list[str]()
    if text in GRIDS:
        grid = GRIDS[text]
    else:
        path = Path(text)
        if path.suffix != ".toml" and not path.is_file():
            raise ConfigError(
                f"Unknown grid '{text}': accepted are {', '.join(GRIDS)} and the path of a TOML file."
                f"{nearest(text, GRIDS)}"
            )
        content = read_toml(path, "grid", ConfigError)
        table = content.pop("grid", None)
        found += [_unknown(key, ("grid",), f"'{path}'") for key in content]
        if not isinstance(table, Mapping):
            found.append(f"'{path}' has no table [grid]: write  [grid]  and its keys below.")
            table = {}
        grid, more = _over(GridSpec(name=path.stem), table, f" of [grid] in '{path}'")
        found += more
    grid, more = changed(grid, changes or {})
    return grid, found + more


def changed(grid: GridSpec, changes: Mapping[str, Any]) -> tuple[GridSpec, list[str]]:
    """A grid with some keys changed, as in `load_grid`; a change of None is none."""
    return _over(grid, {key: value for key, value in changes.items() if value is not None}, "")


def _over(grid: GridSpec, table: Mapping[str, Any], where: str) -> tuple[GridSpec, list[str]]:
    values, found = dict[str, Any](), list[str]()
    for key, value in table.items():
        if key not in _READ:
            found.append(_unknown(key, _READ, where.removeprefix(" of ") or "the grid"))
            continue
        accepted, read = _READ[key]
        try:
            values[key] = read(value)
        except ArchError as cause:
            found.append(f"{first_line(cause)[:-1]}, in {key}{where}.")
        except (TypeError, ValueError):
            found.append(f"{key}{where} is {value!r}: accepted is {accepted}.")
    return replace(grid, **values), found


def _unknown(key: str, known: Iterable[str], where: str) -> str:
    known = tuple(known)
    return f"Unknown key '{key}' in {where}: accepted are {', '.join(known)}.{nearest(key, known)}"


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _whole(value: Any) -> int:
    if isinstance(value, str):
        return int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(value)
    return value


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(value)
    return float(value)


def _many(read: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    """A list of what ``read`` reads; text is split at its commas."""

    def of(value: Any) -> tuple[Any, ...]:
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",")]
        if not isinstance(value, list | tuple):
            raise TypeError(value)
        return tuple(read(item) for item in value)

    return of


def _batch(value: Any) -> int | str:
    return FULL if value == FULL else _whole(value)


def _filters(value: Any) -> tuple[int, ...]:
    return parse_filters(value.replace("/", ",")) if isinstance(value, str) else _many(_whole)(value)


def _filter_sets(value: Any) -> tuple[tuple[int, ...], ...]:
    """``[[4, 6], [8, 12]]``, or text: ``4,6,8,8`` is one set, ``4/6/8/8,8/12/16/16`` are two."""
    if isinstance(value, str):
        value = [part.strip() for part in value.split(",")] if "/" in value else [value]
    if not isinstance(value, list | tuple):
        raise TypeError(value)
    return tuple(_filters(item) for item in value)


def _labels(value: Any) -> str:
    return value if isinstance(value, str) else ",".join(_many(_text)(value))


_READ: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "name": ("text", _text),
    "architectures": ("a list of symbols, as ['14d1_39d2_41d4']", _many(_text)),
    "filters": ("a list of filter sets, as [[4, 6, 8, 8], [8, 12, 16, 16]]", _filter_sets),
    "epochs": ("a list of whole numbers", _many(_whole)),
    "batches": (f"a list of whole numbers and '{FULL}'", _many(_batch)),
    "seeds": ("a list of whole numbers", _many(_whole)),
    "split": ("text", _text),
    "split_seed": ("a whole number", _whole),
    "preset": ("text", _text),
    "padding": ("text", _text),
    "norm": ("text", _text),
    "context": ("text", _text),
    "classes": ("text, or a list of labels", _labels),
    "window_s": ("a number", _number),
    "step_s": ("a number", _number),
    "learning_rate": ("a number", _number),
    "halve_every": ("a whole number", _whole),
    "patience": ("a whole number", _whole),
    "turn_deg": ("a number", _number),
    "device": ("text", _text),
    "threads": ("a whole number", _whole),
}
