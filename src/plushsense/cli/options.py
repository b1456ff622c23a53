"""Read the verbs from ``verbs.toml``, add their options to a parser, and pass option values to library functions."""

from __future__ import annotations

import argparse
import importlib
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from plushsense.core.errors import ConfigError, check_seed

# Placeholders for lists of names in help texts: each maps to a module and a collection (or function returning one).
_LISTS = {
    "checks": ("plushsense.dataset.quality.checking", "CHECKS"),
    "layouts": ("plushsense.core.layouts", "layout_names"),
    "gesture_sets": ("plushsense.core.gestures", "gesture_set_names"),
    "merges": ("plushsense.core.gestures", "merge_names"),
    "targets": ("plushsense.deploy.targets", "TARGETS"),
}


def seed(text: str) -> int:
    """Convert the text of a seed; raise ValueError or ArgumentTypeError if it is none."""
    value = int(text)
    try:
        check_seed(value)
    except ConfigError as cause:
        raise argparse.ArgumentTypeError(str(cause).rstrip(".")) from None
    return value


def numbers(text: str) -> tuple[int, ...]:
    """Convert whole numbers with commas between them; raise ValueError for others."""
    return tuple(map(int, text.split(",")))


_TYPES = {"int": int, "float": float, "numbers": numbers, "seed": seed}


class _Words(dict[str, str]):
    """Texts that replace placeholders in help texts; lists of names are imported only when needed."""

    def __missing__(self, placeholder: str) -> str:
        module, name = _LISTS[placeholder]
        names = getattr(importlib.import_module(module), name)
        return ", ".join(names() if callable(names) else names)


_TABLES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("verbs.toml").read_text(encoding="utf-8"))
VERBS = {name: table for name, table in _TABLES.items() if "summary" in table}
"""Maps the name of each verb to its table."""


def add_options(parser: argparse.ArgumentParser, table: str, words: Mapping[str, str] | None = None) -> None:
    """Add the options of a table in ``verbs.toml``, in the same order; ``words`` replace placeholders in help texts."""
    texts = _Words(words or {})
    groups: dict[str, Any] = {}
    for name, entry in (VERBS if table in VERBS else _TABLES)[table].items():
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
    """Convert the entries of an option in ``verbs.toml`` into keyword arguments of ``add_argument``."""
    keywords["help"] = keywords["help"].format_map(words)
    if "type" in keywords:
        keywords["type"] = _TYPES[keywords["type"]]
    if keywords.get("action") == "boolean":
        keywords["action"] = argparse.BooleanOptionalAction
    if isinstance(keywords.get("metavar"), list):
        keywords["metavar"] = tuple(keywords["metavar"])
    return keywords


def options(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the values of the options ``names``, as keyword arguments for a library function."""
    return {name: getattr(args, name) for name in names}
