"""Searches as they are written: the table [search] beside a grid's, or options of the command line.

    [grid]
    architectures = ["14d1_39d2_41d4", "100_151"]     # whose networks and batches are tried
    filters = [[4, 6, 8, 8], [8, 12, 16, 16]]

    [search]
    rungs = [4, 15, 60]                               # epochs; they take the place of the grid's
    share = 0.25                                      # of the cost of the whole grid, at most
    max_parameters = 8000
    max_state_bytes = 4096
    max_macs_per_step = 50000

    [search.space]                                    # instead of the grid's architectures
    kernels = [5, 9, 14, 19, 29, 39]
    dilations = [1, 2, 4, 8]
    receptive_field = [100, 260]
    networks = 40

What a file leaves out of [grid] is here as the preset *people* has it: by subject, with streaming networks, on real
context, with the gestures that people share; a search for the toy means people that it has not met.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plushsense.training.grid import GRIDS, GridSpec
from plushsense.training.gridfile import Reader, grid_tables, many, number, over, whole
from plushsense.training.search import LIMITS, SearchSpec
from plushsense.training.space import Space, drawn
from plushsense.training.space import problems as space_problems

DEFAULTS: dict[str, Any] = {
    "split": "by-subject:5",
    "preset": "people",
    "padding": "stream",
    "context": "stream",
    "classes": "shared",
    "batches": (64,),
}


def _text_or_number(value: Any) -> float:
    return float(value) if isinstance(value, str) else number(value)


_READ: dict[str, Reader] = {
    "rungs": ("a list of whole numbers", many(whole)),
    "folds": ("a list of whole numbers", many(whole)),
    "share": ("a number", _text_or_number),
    "eta": ("a number", _text_or_number),
    **dict.fromkeys(LIMITS, ("a whole number", whole)),
}
_READ_SPACE: dict[str, Reader] = {
    **dict.fromkeys(("layers", "kernels", "dilations", "receptive_field"), ("a list of whole numbers", many(whole))),
    **dict.fromkeys(("networks", "seed"), ("a whole number", whole)),
}


def load_search(
    name_or_path: str | Path, changes: Mapping[str, Any] | None = None, search: Mapping[str, Any] | None = None
) -> tuple[GridSpec, SearchSpec, list[str]]:
    """Grid and search by a grid's name or from a TOML file, with ``changes`` and ``search`` over them (None: none).

    The grid's epochs are the rungs.

    Returns:
        both, and one sentence for each key or value that cannot be read; those are as if they were not there.

    Raises:
        ConfigError: for an unknown name, or a file that is missing or not TOML.
    """
    if str(name_or_path) in GRIDS:
        base, table, asked, found = GRIDS[str(name_or_path)], dict[str, Any](), dict[str, Any](), list[str]()
    else:
        tables, found = grid_tables(name_or_path)
        base, table, asked = GridSpec(name=Path(name_or_path).stem), dict(tables["grid"]), dict(tables["search"])
    where = f" of [search] in '{name_or_path}'"
    space = asked.pop("space", None)
    spec, more = over(SearchSpec(), asked, where, _READ)
    found += more
    spec, more = asked_of(spec, search)
    found += more
    if space is not None:
        symbols, more = _symbols(space, f" of [search.space] in '{name_or_path}'")
        found += more
        table |= {"architectures": symbols} if symbols else {}
    grid, more = over(base, DEFAULTS | table, f" of [grid] in '{name_or_path}'")
    found += more
    grid, more = over(grid, _given(changes) | {"epochs": spec.rungs}, "")
    return grid, spec, found + more


def asked_of(spec: SearchSpec, search: Mapping[str, Any] | None) -> tuple[SearchSpec, list[str]]:
    """A search with some keys changed, as in `load_search`."""
    return over(spec, _given(search), " of the search", _READ)


def _symbols(space: Any, where: str) -> tuple[tuple[str, ...], list[str]]:
    if not isinstance(space, Mapping):
        return (), [f"space{where.replace('.space', '')} is a single value; it is a table: write  [search.space]"]
    made, found = over(Space(), space, where, _READ_SPACE)
    found += space_problems(made)
    return (() if found else drawn(made)), found


def _given(changes: Mapping[str, Any] | None) -> dict[str, Any]:
    return {key: value for key, value in (changes or {}).items() if value is not None}
