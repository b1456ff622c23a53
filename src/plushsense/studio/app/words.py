"""Translate the texts of the pages, which the source has in English; see ``locale/<language>.po`` of the studio.

A translation names the forms that a word has after a number: ``{n:rinda|rindas}`` becomes *21 rinda*, *12 rindas*, and
``{n:atlikta # rinda|atliktas # rindas}`` has the number within. The English texts count as `Filler` does: ``{n:row}``.
"""

from __future__ import annotations

import gettext
import json
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from plushsense.core.errors import PlushSenseError
from plushsense.core.sentences import Filler, Message, single_stops
from plushsense.devices.opening import parse_url

LANGUAGES = {"en": "English", "lv": "Latviešu"}
"""Maps language code to name.

The file ``locale/<code>.po`` has the translations. That of English only rewords messages of the library that are
written for the command line.
"""

Texts = Mapping[str, str]
"""Annotation of a table of English texts that `Words` translates; a test looks for texts in such tables, too."""

_LOCALE = Path(__file__).parents[1] / "locale"
_NUMBERS = {"en": (".", ","), "lv": (",", "\N{NO-BREAK SPACE}")}
"""The decimal point and the thousands separator of each language."""
_PO_LINE = re.compile(r'(?:(msgctxt|msgid|msgstr) )?(".*")')
# The separator that gettext uses between context and text.
_CONTEXT = "\x04"
UNITS: Texts = {"count": "counts"}
CHANNEL_KINDS: Texts = {
    "all": "All",
    "activity": "Activity",
    "capacitive": "Touch",
    "proximity": "Proximity",
    "acceleration": "Acceleration",
    "angular rate": "Rotation",
}
"""Names of the groups of channels."""
_TOYS: Texts = {
    "virtual": "Virtual toy (simulation), person {place}",
    "serial": "Toy on the cable {place}",
    "ble": "Bluetooth toy {place}",
    "tcp": "Toy in the network {place}",
    "replay": "Recording {place}",
}
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
        self.decimal_point, self._group = _NUMBERS[self.language]

    def __call__(self, text: str, /, **values: Any) -> str:
        translated = self._catalog.get(text) or text.rpartition(_CONTEXT)[2]
        return _FormFiller(self).vformat(translated, (), values) if values else translated

    def each(self, *texts: str) -> list[str]:
        """Return the translations of several texts, such as the headings of a table."""
        return [self(text) for text in texts]

    def form(self, n: float, forms: Sequence[str]) -> str:
        """Return the form that goes with a number: that of 1 (in Latvian also of 21), or that of several."""
        return forms[self._plural_form(int(n))] if n == int(n) else forms[-1]

    def number(self, value: float, digits: int = 0) -> str:
        """Format a number with the decimal separator of this language."""
        return f"{value:.{digits}f}".replace(".", self.decimal_point)

    def significant(self, value: float, digits: int) -> str:
        """Format a number with so many significant digits and the decimal separator of this language."""
        return f"{value:.{digits}g}".replace(".", self.decimal_point)

    def count(self, value: float) -> str:
        """Format a whole number with the thousands separator of this language, and any other with one decimal."""
        if value != int(value):
            return self.number(value, 1)
        return f"{int(value):,}".replace(",", self._group)

    def names(self, kind: str) -> dict[str, str]:
        """Return the translated names of a kind of thing, "gesture" or "channel", by their English names."""
        start = in_context(kind, "")
        return {text.removeprefix(start): s for text, s in self._catalog.items() if text.startswith(start)}

    def gesture(self, label: str) -> str:
        """Return the name of a gesture in this language, or ``label`` itself if it has none."""
        return self(in_context("gesture", label))

    def channel(self, name: str) -> str:
        """Return the name of a sensor channel in this language, or ``name`` itself if it has none."""
        return self(in_context("channel", name))

    def toy(self, url: str) -> str:
        """Return the text for a toy: how it is connected and where, or the URL if that is no valid one."""
        with suppress(PlushSenseError):
            address = parse_url(url)
            place = address.query.get("person", "1") if address.scheme == "virtual" else address.place
            named = address.scheme in ("serial", "replay")
            return self(_TOYS.get(address.scheme, url), place=re.split(r"[/\\]", place)[-1] if named else place)
        return url

    def check(self, name: str) -> str:
        """Return the name of a quality check in this language."""
        return self(in_context("check", name.replace("-", " ")))

    def sentence(self, message: str | Mapping[str, Any]) -> str:
        """Return a `Message` of the library, or its JSON, in this language.

        Any other text is quoted, with a remark that it is in English; "" stays "".
        """
        return self._translated(message, "(In English:) {message}")

    def error(self, error: PlushSenseError | Message) -> str:
        """Return the sentence of an error in this language, see `failure`."""
        return self.failure(error.message if isinstance(error, PlushSenseError) else error)

    def failure(self, message: str | Mapping[str, Any]) -> str:
        """Return a `Message` about something that failed, or its JSON, in this language; "" for none.

        One without a translation is quoted, with a remark that it is in English.
        """
        return self._translated(message, "It did not work. The program says in English: {message}")

    def _translated(self, message: str | Mapping[str, Any], quoted: str) -> str:
        if isinstance(message, str):
            stored: Mapping[str, Any] = message.to_json() if isinstance(message, Message) else {"message": message}
        else:
            stored = message
        template = stored.get("template", "")
        translation = self._catalog.get(template) if template else ""
        if not translation and self.language == next(iter(LANGUAGES)) and _is_worded(stored.get("values", {})):
            translation = template
        if translation:
            # A stored job of another version may lack a value.
            with suppress(KeyError):
                return single_stops(_ValueFiller(self).vformat(translation, (), stored["values"]))
        text = str(stored.get("message", ""))
        return self(quoted, message=text) if text and self.language != next(iter(LANGUAGES)) else text

    def unit(self, unit: str) -> str:
        """Return the name of a unit in this language, or ``unit`` itself if it has none."""
        return self(UNITS.get(unit, unit))

    def affect(self, affect: str | None) -> str:
        """Return the name of an affect in this language; None means the same as "none"."""
        return self(AFFECTS[affect or "none"])


_URLS = ("url", "toy")
"""Keys of the values of messages that are addresses of toys."""


def _is_worded(value: object) -> bool:
    """Return whether there is a further message among values, or a toy, which pages word in another way."""
    if isinstance(value, Mapping):
        return not value.keys().isdisjoint(("template", *_URLS)) or any(map(_is_worded, value.values()))
    return isinstance(value, Message) or (isinstance(value, list | tuple) and any(map(_is_worded, value)))


class _FormFiller(Filler):
    """Fill values into a translation, with the form of a word that its language has for a number."""

    def __init__(self, words: Words) -> None:
        self._words = words

    def format_field(self, value: Any, format_spec: str) -> str:
        if "|" not in format_spec:
            return self._words.count(value) if format_spec == "," else super().format_field(value, format_spec)
        forms = format_spec.split("|")
        # A number that is a text already, such as “2–3”, has the form of several.
        number = value if isinstance(value, str) else self._words.count(value)
        form = forms[-1] if isinstance(value, str) else self._words.form(value, forms)
        return form.replace("#", number) if "#" in form else f"{number} {form}"


class _ValueFiller(_FormFiller):
    """Fill values of a `Message` into its translation, as the language has them."""

    def get_value(self, key: int | str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        return self._worded(str(key), kwargs[str(key)])

    def _worded(self, key: str, value: Any) -> Any:
        words = self._words
        if value is None or value == [] or value == ():
            return words("none")
        if isinstance(value, list | tuple):
            return [self._worded(key, each) for each in value]
        if isinstance(value, Message | Mapping):
            return words.sentence(value)
        if isinstance(value, Path):
            return value.name
        if key in _URLS:
            return words.toy(str(value))
        if key in ("channel", "channels"):
            return words.channel(str(value))
        return words.gesture(str(value)) if key in ("gesture", "gestures", "missing") else value

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, float) and "|" not in format_spec:
            return format(value, format_spec or ".10g").replace(".", self._words.decimal_point)
        return super().format_field(value, format_spec)


@cache
def _catalog(language: str) -> tuple[dict[str, str], Callable[[int], int]]:
    """Return the translations, by English text as `in_context` has it, and the function that chooses a plural form."""
    translations: dict[str, str] = {}
    for entry in (_LOCALE / f"{language}.po").read_text(encoding="utf-8").split("\n\n"):
        fields: dict[str, str] = {}
        field = ""
        for name, quoted in (match.groups() for match in map(_PO_LINE.fullmatch, entry.splitlines()) if match):
            field = name or field
            fields[field] = fields.get(field, "") + json.loads(quoted)
        if fields:
            text = fields["msgid"] if "msgctxt" not in fields else in_context(fields["msgctxt"], fields["msgid"])
            translations[text] = fields["msgstr"]
    return translations, gettext.c2py(translations.pop("").partition("plural=")[2].partition(";")[0])
