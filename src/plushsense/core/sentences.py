"""Sentences for the user in English, with named values, so that they can be shown in other languages."""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Self

# Not that of a path, as in '../a', or of an ellipsis.
_DOUBLED_STOP = re.compile(r"(?<=[\w)\]}'\"”’»])\.\.(?=\s|$)")
_NOUN = re.compile(r"[a-z][a-z -]{2,}")


def single_stops(text: str) -> str:
    """Return a text with one full stop where a part that ends with one, such as a further sentence, left two."""
    return _DOUBLED_STOP.sub(".", text)


class Filler(string.Formatter):
    """Fill values into a template as `str.format` does; lists are joined, and a noun as format counts: ``{n:row}``."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, list | tuple):
            return ", ".join(self.format_field(each, format_spec) for each in value)
        return plural(value, format_spec) if _NOUN.fullmatch(format_spec) else format(value, format_spec)


_FILLER = Filler()


class Message(str):
    """An English sentence, with the template and the values that it was made of.

    It is a plain string wherever nothing else is needed. The studio looks up the translation of the template and fills
    in the values.

    Attributes:
        template: the sentence with ``{name}`` in place of each value, see `Filler`. Without values, it is the sentence
            itself, in which braces mean nothing.
        values: numbers, strings, paths, further messages, and lists of these. A translation may use only some of them.
    """

    template: str
    values: dict[str, Any]

    def __new__(cls, template: str = "", /, **values: Any) -> Self:
        return cls.restored(_FILLER.vformat(template, (), values) if values else template, template, values)

    @classmethod
    def restored(cls, text: str, template: str, values: dict[str, Any]) -> Self:
        """Return a message with the given text, which is not made anew."""
        message = super().__new__(cls, single_stops(text))
        message.template, message.values = template, values
        return message

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).restored, (str(self), self.template, self.values)

    def to_json(self) -> dict[str, object]:
        """Return plain values for JSON, from which `from_json` restores the message."""
        return {"message": str(self), "template": self.template, "values": plain(self.values)}

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> Self:
        """Return the message of which ``table`` is the `to_json`."""
        return cls.restored(table["message"], table["template"], dict(table["values"]))


def plain(value: object) -> Any:
    """Return a value for JSON: the table of each message in it, and of each path the name."""
    if isinstance(value, Message):
        return value.to_json()
    if isinstance(value, Path):
        return value.name
    if isinstance(value, Mapping):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def join_names(names: Iterable[object], none: str = "none", most: int | None = None) -> str:
    """Join names for a sentence, as in ``a, b``; ``none`` stands for no names, and '' for one that is blank.

    Of more than ``most`` names, the first are followed by the number of the others.
    """
    texts = [text if (text := str(name)).strip() else "''" for name in names]
    more = f" and {len(texts) - most} more" if most is not None and len(texts) > most else ""
    return (", ".join(texts[:most]) or none) + more


def plural(n: int, noun: str) -> str:
    """Format a count with its noun, as in ``1 fold``, ``2 folds``, ``0 people`` (of "person") or ``2 stretches``."""
    if n == 1:
        return f"1 {noun}"
    if noun.endswith("person"):
        return f"{n} {noun.removesuffix('person')}people"
    return f"{n} {noun}{'es' if noun.endswith('ch') else 's'}"
