"""Reading the symbol of a network and its filter counts: parsed once, errors show the text and the place.

Grammar (paper, section 3.6.2): ``symbol = layer ("_" layer){0,3}``, ``layer = kernel ["d" dilation]``, both
whole numbers from 1; ``filters = count ("," count)*``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NoReturn

from plushsense.core.errors import ArchError

MAX_LAYERS = 4
MAX_NUMBER = 4096  # of a kernel, a dilation, a filter count: far above use, far below what would exhaust memory


def parse_symbol(spec: str) -> tuple[tuple[int, int], ...]:
    """The (kernel, dilation) pairs of a symbol.

    Raises:
        ArchError: showing the symbol and a caret under the place that does not fit.
    """
    if not spec:
        fail("nothing is given: write kernel lengths joined by '_', as in 14d1_39d2_41d4", spec, 0)
    layers: list[tuple[int, int]] = []
    at = 0
    while True:
        if len(layers) == MAX_LAYERS:
            fail(f"more than {MAX_LAYERS} layers: take some away", spec, at)
        kernel, at = _number(spec, at, f"the kernel length of layer {len(layers) + 1}")
        dilation = 1
        if spec[at : at + 1] == "d":
            dilation, at = _number(spec, at + 1, f"the dilation of layer {len(layers) + 1}")
        layers.append((kernel, dilation))
        if at == len(spec):
            return tuple(layers)
        if spec[at] != "_":
            known = "'_' or the end" if "d" in spec[max(spec.rfind("_", 0, at), 0) : at] else "'d', '_' or the end"
            fail(f"unknown token {spec[at]!r}: accepted here are {known}", spec, at)
        at += 1


def parse_filters(text: str) -> tuple[int, ...]:
    """Filter counts from ``"8,12,16"``; ArchError with a caret under what is not a whole number from 1."""
    counts: list[int] = []
    at = 0
    while True:
        at += len(text[at:]) - len(text[at:].lstrip(" "))
        count, at = _number(text, at, f"filter count {len(counts) + 1}", symbol=False)
        counts.append(count)
        at += len(text[at:]) - len(text[at:].lstrip(" "))
        if at == len(text):
            return tuple(counts)
        if text[at] != ",":
            fail(
                f"unknown token {text[at]!r}: write counts joined by commas, as in 8,12,16",
                text,
                at,
                symbol=False,
            )
        at += 1


def slashed(filters: Iterable[int]) -> str:
    """Filter counts as tables and names show them: ``8/12/16``."""
    return "/".join(map(str, filters))


def _number(text: str, at: int, what: str, symbol: bool = True) -> tuple[int, int]:
    """The number that starts at ``at``, 1 to MAX_NUMBER, and the place after it."""
    end = at
    while end < len(text) and text[end] in "0123456789":
        end += 1
    if end == at:
        ends = at == len(text) or text[at] in "_,"
        found = "nothing stands here" if ends else f"unknown token {text[at]!r}"
        fail(f"{found}: {what} is expected, a whole number from 1", text, at, symbol)
    if text[at:end].strip("0") == "":
        fail(f"{what} is 0: the smallest is 1", text, at, symbol)
    if end - at > 9 or int(text[at:end]) > MAX_NUMBER:
        fail(f"{what} is too large: the largest is {MAX_NUMBER}", text, at, symbol)
    return int(text[at:end]), end


def layer_start(spec: str, layer: int) -> int:
    """Where a layer (from 0) stands in the symbol."""
    return sum(len(part) + 1 for part in spec.split("_")[:layer])


def fail(why: str, text: str, at: int, symbol: bool = True) -> NoReturn:
    """Raise ArchError: what is wrong, the text, and a caret under place ``at``."""
    shown = "".join(c if c.isprintable() else "?" for c in text)
    what = "Architecture" if symbol else "Filters"
    raise ArchError(f"{what} '{shown}', place {at + 1}: {why}.\n    {shown}\n    {' ' * at}^")
