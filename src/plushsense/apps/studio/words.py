"""What the pages say: one TOML file a language in ``words/``, the same keys in each."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import resources
from typing import Any

LANGUAGES = {"en": "English", "lv": "Latviešu"}
"""Code to name; ``words/<code>.toml`` has the words."""


class Words:
    """One language: ``words("record.start", n=3)`` is the text at ``[record] start`` with ``{n}`` filled in."""

    def __init__(self, language: str) -> None:
        self.language = language if language in LANGUAGES else next(iter(LANGUAGES))
        self._texts = _texts(self.language)

    def __call__(self, key: str, **values: Any) -> str:
        text = self._texts[key]
        return text.format(**values) if values else text

    def number(self, value: float, digits: int = 0) -> str:
        """A number as it is written in this language."""
        text = f"{value:.{digits}f}"
        return text.replace(".", self._texts["shell.decimal_point"])

    def has(self, key: str) -> bool:
        """Whether there is a text of this key."""
        return key in self._texts

    def gesture(self, label: str) -> str:
        """A gesture's name for people; the label itself where the language has no other."""
        return self._texts.get(f"gestures.{label}", label)

    def unit(self, unit: str) -> str:
        """A unit's name for people, such as that of plain counts; others are written alike everywhere."""
        return self._texts.get(f"units.{unit}", unit)

    def affect(self, affect: str | None) -> str:
        """An affect's name; "none" and None read the same."""
        return self._texts[f"affects.{affect or 'none'}"]


@cache
def _texts(language: str) -> dict[str, str]:
    text = resources.files(__package__).joinpath(f"words/{language}.toml").read_text(encoding="utf-8")
    return dict(_flat(tomllib.loads(text)))


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)
