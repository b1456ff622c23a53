"""Reading TOML tables: a built-in name or a path, and keys that are known or refused with the nearest known one."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import BadInput, nearest


def builtin_names(folder: str) -> tuple[str, ...]:
    """Names of the TOML files that ship in ``core/data/<folder>``."""
    root = resources.files("plushsense.core") / "data" / folder
    return tuple(sorted(p.name.removesuffix(".toml") for p in root.iterdir() if p.name.endswith(".toml")))


def read_named(name_or_path: str | Path, folder: str, what: str, error: type[BadInput]) -> tuple[dict[str, Any], str]:
    """The table of a built-in name, or of a TOML file by path; with the name to quote in messages.

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
            f"Unknown {what} '{text}': the built-in ones are {', '.join(known)}; "
            f"or give the path of a TOML file.{nearest(text, known)}"
        )
    return read_toml(path, what, error), text


def read_toml(path: Path, what: str, error: type[BadInput]) -> dict[str, Any]:
    """The table in the TOML file at ``path``; ``what`` names its purpose in messages."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise error(f"There is no {what} file '{path}': check the path.") from None
    except (OSError, UnicodeDecodeError) as cause:
        raise error(f"The {what} file '{path}' cannot be read ({cause}): give a UTF-8 TOML file.") from None
    except (tomllib.TOMLDecodeError, RecursionError) as cause:
        raise error(f"The {what} file '{path}' is not valid TOML: {cause}.") from None


def refuse_unknown(table: Mapping[str, Any], known: Iterable[str], where: str, error: type[BadInput]) -> None:
    """Refuse keys that nobody reads, naming the nearest one that is read."""
    known = tuple(known)
    for key in table:
        if key not in known:
            raise error(f"Unknown key '{key}' in {where}: accepted are {', '.join(known)}.{nearest(key, known)}")
