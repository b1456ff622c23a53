"""Find texts that other programs read from a CSV file as something else, such as the gesture ``null`` or ``01``.

pandas, Polars and DuckDB guess the type of a column from its cells, some only from the first ones: ``null`` becomes no
value, ``01`` the number 1, ``no`` false and ``2024-05-01`` a day.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from plushsense.core.gestures import NOBODY, plain_label
from plushsense.dataset.publishing.description import INTEGER, NUMBER, TEXT, YES_NO

_NO_VALUE = re.compile(r"[-+#<]*(n/?a|null|none|nan)>?|#n/a n/a|[-+]?1\.#(ind|qnan)", re.IGNORECASE)
_CHANGED = re.compile(r"[-+]?(\d+\.?|\d*\.\d+)(e[-+]?\d+)?|[-+]?inf(inity)?|true|false", re.IGNORECASE)
_OTHER_TYPE = re.compile(
    # Days and times too: digits and signs without letters, in any script. DuckDB takes single quotes away.
    r"[\W\d_]*\d[\W\d_]*|'.*'|0[xb][\da-f]+|\d{4}-\d\d?-\d\d?t[\d:.,]+(z|[-+][\d:]+)?|epoch|[tf]|yes|no",
    re.IGNORECASE,
)
_KINDS = {
    INTEGER: re.compile(r"-?(0|[1-9]\d{0,14})"),
    NUMBER: re.compile(r"-?(0|[1-9]\d{0,14})(\.\d{1,15})?"),
    YES_NO: re.compile("true|false"),
}


def _is_no_value(text: str) -> bool:
    return text != NOBODY and _NO_VALUE.fullmatch(text.strip()) is not None


def is_misread(text: str) -> bool:
    """Return whether another program may read ``text`` as no value, or a column of such texts as another type."""
    plain = text.strip()
    return _is_no_value(text) or any(pattern.fullmatch(plain) for pattern in (_CHANGED, _OTHER_TYPE))


def label_prefix(labels: Iterable[str]) -> str:
    """Return what `public_label` puts in front: ``gesture ``, more often where a label would then be there twice."""
    labels = set(labels)
    prefix, plain = "gesture ", {plain_label(label) for label in labels}
    while any(plain_label(prefix + label) in plain for label in labels if is_misread(label)):
        prefix += "gesture "
    return prefix


def public_label(label: str, prefix: str) -> str:
    """Return the public label of a gesture: ``gesture 01`` for ``01``, and one that nobody misreads as it is."""
    return prefix + label if is_misread(label) else label


def kind_of(values: Iterable[str]) -> str:
    """Return the kind of a column that people filled in; `TEXT` if it is empty."""
    given = [v for v in values if v]
    return next((k for k, pattern in _KINDS.items() if given and all(map(pattern.fullmatch, given))), TEXT)


def changed_text(values: Iterable[str]) -> str | None:
    """Return a value of a column of texts that other programs would change; None if there is none.

    Where one text is no number, the others are kept as texts, too, but not words that mean no value.
    """
    values = list(values)
    given = [v for v in values if v]
    # Whole numbers stay what they are, unless an empty cell makes them 1.0.
    if not all(map(_KINDS[INTEGER].fullmatch, values)) and all(_CHANGED.fullmatch(v.strip()) for v in given):
        return next(iter(given), None)
    return next(filter(_is_no_value, given), None)
