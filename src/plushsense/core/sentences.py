"""Sentences for the user that the library writes in English, and that can be worded in other languages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Self

from plushsense.core.errors import PlushSenseError, single_stops


class Sentence(str):
    """An English sentence, with the key and the values of its text in other languages.

    It is a plain string wherever nothing else is needed. The studio has a text ``sentences.<reason>`` for each.

    Attributes:
        reason: key of the text, "" for none.
        values: values that are filled into the text: numbers (rounded as they are to be displayed), strings, further
            sentences, and lists of these.
    """

    reason: str
    values: dict[str, Any]

    def __new__(cls, message: str = "", /, reason: str = "", **values: Any) -> Self:
        sentence = super().__new__(cls, single_stops(message))
        sentence.reason, sentence.values = reason, values
        return sentence

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).from_dict, (self.to_dict(),)

    @classmethod
    def of(cls, error: PlushSenseError) -> Self:
        """Return the sentence of an error."""
        return cls(str(error), error.reason, **error.values)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, from which `from_dict` restores the sentence."""
        return {"message": str(self), "reason": self.reason, "values": self.values}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        """Return the sentence of which ``table`` is the `to_dict`."""
        return cls(table["message"], table["reason"], **table["values"])


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
