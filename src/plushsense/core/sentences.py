"""Sentences for the user that the library writes in English, and that can be worded in other languages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from plushsense.core.errors import PlushSenseError


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
        sentence = super().__new__(cls, message)
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
