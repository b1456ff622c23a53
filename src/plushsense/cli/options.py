"""The verbs of ``verbs.toml``: their options for a parser, and the given values for library functions."""

from __future__ import annotations

import argparse
import importlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# Lists of names in help texts, by placeholder: module, and a collection or a function that returns one.
_LISTS = {
    "checks": ("plushsense.dataset.quality.checking", "CHECKS"),
    "layouts": ("plushsense.core.layouts", "layout_names"),
    "gesture_sets": ("plushsense.core.gestures", "gesture_set_names"),
    "targets": ("plushsense.deploy.targets", "TARGETS"),
}
_TYPES = {"int": int, "float": float}


class _Words(dict[str, str]):
    """Texts for the placeholders of help texts; a list of names is imported when a help text has it."""

    def __missing__(self, placeholder: str) -> str:
        module, name = _LISTS[placeholder]
        names = getattr(importlib.import_module(module), name)
        return ", ".join(names() if callable(names) else names)


_TABLES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("verbs.toml").read_text(encoding="utf-8"))
VERBS = {name: table for name, table in _TABLES.items() if "summary" in table}
"""The table of every verb, by name."""


def add_options(parser: argparse.ArgumentParser, table: str, words: Mapping[str, str] | None = None) -> None:
    """Add the options of a table of ``verbs.toml``, in its order; ``words`` fill placeholders in help texts."""
    texts = _Words(words or {})
    groups: dict[str, Any] = {}
    for name, entry in {**_TABLES, **VERBS}[table].items():
        if name in ("summary", "module", "stopped"):
            continue
        if name == "description":
            parser.formatter_class = argparse.RawDescriptionHelpFormatter
            parser.description = f"{parser.description}\n\n{entry}"
        elif name == "epilog":
            parser.formatter_class = argparse.RawDescriptionHelpFormatter
            parser.epilog = entry
        elif name.startswith("@"):
            add_options(parser, name[1:], {**texts, **entry})
        else:
            keywords = dict(entry)
            group, required = keywords.pop("one_of", None), keywords.pop("one_required", False)
            if group is not None and group not in groups:
                groups[group] = parser.add_mutually_exclusive_group(required=required)
            groups.get(group, parser).add_argument(name, **_arguments(keywords, texts))


def _arguments(keywords: dict[str, Any], words: _Words) -> dict[str, Any]:
    """Return an option's keywords as ``add_argument`` takes them."""
    keywords["help"] = keywords["help"].format_map(words)
    if "type" in keywords:
        keywords["type"] = _TYPES[keywords["type"]]
    if keywords.get("action") == "boolean":
        keywords["action"] = argparse.BooleanOptionalAction
    if isinstance(keywords.get("metavar"), list):
        keywords["metavar"] = tuple(keywords["metavar"])
    return keywords


def options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of some options by name, for a library function that has parameters of these names."""
    return {name: getattr(args, name) for name in names}
