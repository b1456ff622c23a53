"""Finding people's names and codes in free text, whatever their spelling, and putting something else in their place."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping

from plushsense.dataset.contents import squashed

_BEFORE, _AFTER = r"(?<![^\W_])", r"(?![^\W_])"
_PIECES = re.compile(r"[^\W\d_]+|\d+")

# What points at one computer or one toy rather than at a kind: an address, a port, somebody's folder.
_ADDRESSES = re.compile(
    r"(?P<scheme>\b(?:serial|ble|tcp|lsl|replay|file)://)[^\s\"']*"
    r"|\b[0-9A-Fa-f]{2}(?:[:-][0-9A-Fa-f]{2}){5}\b"
    r"|\b[0-9A-Fa-f]{8}-(?:[0-9A-Fa-f]{4}-){3}[0-9A-Fa-f]{12}\b"
    r"|\bCOM\d+\b"
    r"|(?<![\w/.:])/(?:dev|home|Users|tmp|media|mnt|root|var|private)/[^\s\"']*"
    r"|\b[A-Za-z]:\\[^\s\"']*"
)
NO_ADDRESS = "[address]"


def searchable(word: str) -> bool:
    """Whether a word is long enough to be told from others in a text: ``P1`` is, ``7`` and ``a`` are not."""
    key = squashed(word)
    return len(key) >= (5 if key.isdigit() else 2)


def _pattern(word: str) -> str:
    pieces = _PIECES.findall(unicodedata.normalize("NFC", word))
    if any(len(p) == 1 and p.isalpha() for p in pieces):
        # A letter alone is easily part of something else: "it's 1 o'clock" is not S1.
        return "(?<!['’])" + r"[\s_-]?".join(map(re.escape, pieces))
    return r"[\s_.'-]*".join(map(re.escape, pieces))


class Names:
    """Words to look for and what stands in their place; whole words, in any case, with ``_``, ``-`` or blanks in them.

    Words that are too short to be looked for (`searchable`) are in ``too_short``.
    """

    def __init__(self, instead: Mapping[str, str]) -> None:
        self.too_short = sorted(word for word in instead if not searchable(word))
        wanted = sorted((w for w in instead if searchable(w)), key=len, reverse=True)
        self._instead = {squashed(unicodedata.normalize("NFC", word)): instead[word] for word in reversed(wanted)}
        alternatives = "|".join(_pattern(word) for word in wanted)
        self._any = re.compile(f"{_BEFORE}(?:{alternatives}){_AFTER}", re.IGNORECASE) if wanted else None

    def replace(self, text: str) -> tuple[str, list[str]]:
        """The text without the words, and what was put in their place, once for each place."""
        if self._any is None:
            return text, []
        put: list[str] = []

        def one(match: re.Match[str]) -> str:
            put.append(self._instead.get(squashed(match.group()), "[name]"))
            return put[-1]

        plain = unicodedata.normalize("NFC", text)
        changed = self._any.sub(one, plain)
        return (changed, put) if put else (text, put)

    def found(self, text: str) -> list[str]:
        """The words as they stand in a text."""
        if self._any is None:
            return []
        return [m.group() for m in self._any.finditer(unicodedata.normalize("NFC", text))]


def without_addresses(text: str) -> str:
    """The text without ports, radio addresses, unique ids and somebody's folders; of a device URL the scheme stays."""
    return _ADDRESSES.sub(lambda m: m["scheme"] or NO_ADDRESS, text)
