"""Load the texts of the pages, in each language with the same keys.

The texts of a page are in ``pages/<name>/<language>.toml``, those of several pages in ``app/words/<language>.toml``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module, resources
from pathlib import Path
from typing import Any

from plushsense.core.errors import PlushSenseError, single_stops
from plushsense.core.sentences import Sentence

LANGUAGES = {"en": "English", "lv": "Latviešu"}
"""Maps language code to name; ``<code>.toml`` is the name of the files of texts."""


class Words:
    """Texts in one language: ``words("record.start", n=3)`` is ``start`` of ``[record]``, where ``{n}`` becomes 3."""

    def __init__(self, language: str) -> None:
        self.language = language if language in LANGUAGES else next(iter(LANGUAGES))
        self._texts = _texts(self.language)

    def __call__(self, key: str, **values: Any) -> str:
        text = self._texts[key]
        return text.format(**values) if values else text

    def number(self, value: float, digits: int = 0) -> str:
        """Format a number with the decimal separator of this language."""
        text = f"{value:.{digits}f}"
        return text.replace(".", self._texts["shell.decimal_point"])

    def significant(self, value: float, digits: int) -> str:
        """Format a number with so many significant digits and the decimal separator of this language."""
        return f"{value:.{digits}g}".replace(".", self._texts["shell.decimal_point"])

    def count(self, value: int) -> str:
        """Format a whole number with the thousands separator of this language."""
        return f"{value:,}".replace(",", self._texts["shell.thousand"][1:-3])

    def table(self, name: str) -> dict[str, str]:
        """Return all texts of the table ``name``; the keys do not include that name."""
        return {key.removeprefix(f"{name}."): text for key, text in self._texts.items() if key.startswith(f"{name}.")}

    def get(self, key: str, default: str = "") -> str:
        """Return the text with this key, or ``default`` if there is none."""
        return self._texts.get(key, default)

    def gesture(self, label: str) -> str:
        """Return the name of a gesture in this language, or ``label`` itself if it has none."""
        return self._texts.get(f"gestures.{label}", label)

    def channel(self, name: str) -> str:
        """Return the name of a sensor channel in this language, or ``name`` itself if it has none."""
        return self._texts.get(f"channels.{name}", name)

    def sentence(self, sentence: str | Mapping[str, Any]) -> str:
        """Return a `Sentence` of the library, or the table of its `to_dict`, in this language.

        Any other text is quoted, with a remark that it is in English; "" stays "".
        """
        if isinstance(sentence, Sentence):
            sentence = sentence.to_dict()
        elif isinstance(sentence, str):
            sentence = {"message": sentence}
        text = self._texts.get(f"sentences.{sentence.get('reason')}")
        if text:
            values = {key: self._value(key, value) for key, value in sentence.get("values", {}).items()}
            # A stored job of another version may lack a value.
            with suppress(KeyError):
                return single_stops(text.format(**values))
        return self._texts["sentences.note"].format(message=sentence["message"]) if sentence["message"] else ""

    def _value(self, key: str, value: object) -> str:
        if value is None or value == [] or value == ():
            return self._texts["shell.nothing"]
        if isinstance(value, list | tuple):
            return ", ".join(self._value(key, each) for each in value)
        if isinstance(value, Sentence | Mapping):
            return self.sentence(value)
        if isinstance(value, float):
            return f"{value:.10g}".replace(".", self._texts["shell.decimal_point"])
        if key in ("channel", "channels"):
            return self.channel(str(value))
        return self.gesture(str(value)) if key in ("gesture", "gestures") else str(value)

    def error(self, error: PlushSenseError | Sentence) -> str:
        """Return the sentence of an error, or another one of the library, in this language, see `explain`."""
        return self.explain(str(error), error.reason, error.values)

    def explain(self, message: str, reason: str = "", values: Mapping[str, object] | None = None) -> str:
        """Return the sentence for the user about something that failed.

        Args:
            message: the sentence in English, as the command line prints it.
            reason, values: those of the `PlushSenseError`. Without a text for ``reason``, ``message`` is quoted.
        """
        if f"sentences.{reason}" in self._texts:
            return self.sentence({"message": message, "reason": reason, "values": values or {}})
        return self._texts["sentences.other"].format(message=message) if message else ""

    def unit(self, unit: str) -> str:
        """Return the name of a unit in this language, or ``unit`` itself if it has none."""
        return self._texts.get(f"units.{unit}", unit)

    def affect(self, affect: str | None) -> str:
        """Return the name of an affect in this language; None means the same as "none"."""
        return self._texts[f"affects.{affect or 'none'}"]


@cache
def _texts(language: str) -> dict[str, str]:
    text = resources.files(__package__).joinpath(f"words/{language}.toml").read_text(encoding="utf-8")
    texts = dict(_flat(tomllib.loads(text)))
    for folder in import_module("plushsense.studio.pages").__path__:
        for path in Path(folder).glob(f"*/{language}.toml"):
            texts |= _flat(tomllib.loads(path.read_text(encoding="utf-8")))
    return texts


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)
