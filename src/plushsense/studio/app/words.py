"""Translate the texts of the pages, which the source has in English; see ``locale/<language>.po`` of the studio."""

from __future__ import annotations

import gettext
import tomllib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from babel import Locale
from babel.messages.catalog import Catalog
from babel.messages.pofile import read_po

from plushsense.core.errors import PlushSenseError, single_stops
from plushsense.core.sentences import Sentence

LANGUAGES = {"en": "English", "lv": "Latviešu"}
"""Maps language code to name. Each language but English has a file ``locale/<code>.po`` of translations."""

Texts = Mapping[str, str]
"""Annotation of a table of English texts that `Words` translates; a test looks for texts in such tables, too."""

_LOCALE = Path(__file__).parents[1] / "locale"
# The separator that gettext uses between context and text.
_CONTEXT = "\x04"
UNITS: Texts = {"count": "counts"}
AFFECTS: Texts = {"positive": "positive", "neutral": "neutral", "negative": "negative", "none": "none"}


def in_context(context: str, text: str) -> str:
    """Return an English text that has another translation in this context than elsewhere."""
    return f"{context}{_CONTEXT}{text}"


@dataclass(frozen=True)
class PageTexts:
    """Texts of a page.

    Attributes:
        name: name in the navigation bar.
        help: paragraphs of the help, one per line; "" for none.
        tour: what the tour tells about the page; "" for none.
    """

    name: str
    title: str
    help: str = ""
    tour: str = ""


class Words:
    """Texts in one language: ``words("{n} of {m}", n=1, m=3)`` translates the English text and fills in the values.

    A text without a translation stays English.
    """

    def __init__(self, language: str) -> None:
        self.language = language if language in LANGUAGES else next(iter(LANGUAGES))
        self._catalog, self._plural_form = _catalog(self.language)
        self._texts = _sentences(self.language)
        symbols = Locale(self.language).number_symbols["latn"]
        self.decimal_point, self._group = symbols["decimal"], symbols["group"]

    def __call__(self, text: str, /, **values: Any) -> str:
        translated = str(self._translation(text) or text.rpartition(_CONTEXT)[2])
        return translated.format(**values) if values else translated

    def plural(self, one: str, many: str, n: int) -> str:
        """Return the text for a number, which replaces ``{n}``, in the form that the language has for it."""
        forms = self._translation(one)
        form = forms[self._plural_form(n)] if isinstance(forms, tuple) else many if n != 1 else one
        return form.rpartition(_CONTEXT)[2].format(n=n)

    def _translation(self, text: str) -> str | tuple[str, ...]:
        context, _, text = text.rpartition(_CONTEXT)
        message = self._catalog.get(text, context or None)
        return message.string if message is not None else ""  # type: ignore[return-value]

    def number(self, value: float, digits: int = 0) -> str:
        """Format a number with the decimal separator of this language."""
        return f"{value:.{digits}f}".replace(".", self.decimal_point)

    def significant(self, value: float, digits: int) -> str:
        """Format a number with so many significant digits and the decimal separator of this language."""
        return f"{value:.{digits}g}".replace(".", self.decimal_point)

    def count(self, value: int) -> str:
        """Format a whole number with the thousands separator of this language."""
        return f"{value:,}".replace(",", self._group)

    def names(self, kind: str) -> dict[str, str]:
        """Return the translated names of a kind of thing, "gesture" or "channel", by their English names."""
        return {str(m.id): str(m.string) for m in self._catalog if m.context == kind}

    def gesture(self, label: str) -> str:
        """Return the name of a gesture in this language, or ``label`` itself if it has none."""
        return self(in_context("gesture", label))

    def channel(self, name: str) -> str:
        """Return the name of a sensor channel in this language, or ``name`` itself if it has none."""
        return self(in_context("channel", name))

    def sentence(self, sentence: str | Mapping[str, Any]) -> str:
        """Return a `Sentence` of the library, or the table of its `to_dict`, in this language.

        Any other text is quoted, with a remark that it is in English; "" stays "".
        """
        if isinstance(sentence, Sentence):
            sentence = sentence.to_dict()
        elif isinstance(sentence, str):
            sentence = {"message": sentence}
        text = self._texts.get(f"{sentence.get('reason')}")
        if text:
            values = {key: self._value(key, value) for key, value in sentence.get("values", {}).items()}
            # A stored job of another version may lack a value.
            with suppress(KeyError):
                return single_stops(text.format(**values))
        return self._texts["note"].format(message=sentence["message"]) if sentence["message"] else ""

    def _value(self, key: str, value: object) -> str:
        if value is None or value == [] or value == ():
            return self("none")
        if isinstance(value, list | tuple):
            return ", ".join(self._value(key, each) for each in value)
        if isinstance(value, Sentence | Mapping):
            return self.sentence(value)
        if isinstance(value, float):
            return f"{value:.10g}".replace(".", self.decimal_point)
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
        if f"{reason}" in self._texts:
            return self.sentence({"message": message, "reason": reason, "values": values or {}})
        return self._texts["other"].format(message=message) if message else ""

    def unit(self, unit: str) -> str:
        """Return the name of a unit in this language, or ``unit`` itself if it has none."""
        return self(UNITS.get(unit, unit))

    def affect(self, affect: str | None) -> str:
        """Return the name of an affect in this language; None means the same as "none"."""
        return self(AFFECTS[affect or "none"])


@cache
def _catalog(language: str) -> tuple[Catalog, Callable[[int], int]]:
    """Return the translations, and the function that maps a number to the index of its plural form."""
    path = _LOCALE / f"{language}.po"
    if not path.is_file():
        return Catalog(), lambda n: int(n != 1)
    with path.open("rb") as file:
        catalog = read_po(file)
    return catalog, gettext.c2py(catalog.plural_expr)


@cache
def _sentences(language: str) -> dict[str, str]:
    text = resources.files(__package__).joinpath(f"words/{language}.toml").read_text(encoding="utf-8")
    return dict(tomllib.loads(text)["sentences"])
