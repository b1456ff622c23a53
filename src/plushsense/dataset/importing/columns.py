"""Columns of samples of tables, from which a pattern of an import is guessed."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from plushsense.dataset.importing.counters import Floats
from plushsense.dataset.importing.table_files import date_ms

# Numbers with these names are labels; "touch" may be a sensor.
CODE_NAMES = ("label", "gesture", "activity", "class", "event", "action")
# Labels as numbers: at most so many whole numbers, which change in a smaller share of the rows than this.
MOST_CODES, _SELDOM = 30, 0.05
# Fewer rows that follow another prove nothing about the order of texts.
_LEAST_CHANGES = 20
# Two columns that read 0 and 1, or 1 and 2, may be readings.
_LEAST_NUMBERED = 3
_RATE = re.compile(r"(sampl(e|ing)_?)?(frequency|freq|rate)(_?hz)?|fs|hz|sps", re.IGNORECASE)


@dataclass
class SampledColumn:
    """A column of the samples: its ``key`` for the pattern, and its cells in each file or recording."""

    name: str
    key: str
    parts: list[list[str]]
    decimal: str = "."
    of_recording: bool = False
    """Whether there is one cell for each recording, beside columns with many."""
    numbers: list[Floats] = field(default_factory=list)
    """The number in each cell of each part, NaN where there is none."""
    words: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        for cells in self.parts:
            numbers = np.full(len(cells), np.nan)
            for k, cell in enumerate(cells):
                text = cell.strip().replace(",", ".") if self.decimal == "," else cell.strip()
                if is_number(text) and "," not in text:
                    numbers[k] = float(text)
                elif text:
                    self.words[text] += 1
            self.numbers.append(numbers)

    @property
    def cells(self) -> list[str]:
        return [cell for cells in self.parts for cell in cells]

    @property
    def values(self) -> Floats:
        """The numbers of all parts."""
        joined: Floats = np.concatenate([*self.numbers, np.empty(0)])
        return joined[np.isfinite(joined)]

    @property
    def is_numeric(self) -> bool:
        words, numbers = sum(self.words.values()), len(self.values)
        return numbers > 0.6 * (numbers + words) and len(self.words) <= 3

    @property
    def is_date(self) -> bool:
        return len(self.words) > 3 and self.holds_dates

    @property
    def holds_dates(self) -> bool:
        return not any(map(math.isnan, map(date_ms, self.words)))

    @property
    def moments(self) -> list[Floats]:
        """The times in each part: numbers, or the seconds of dates."""
        if not self.words or not self.holds_dates:
            return self.numbers
        return [np.array([date_ms(cell) / 1000.0 for cell in cells]) for cells in self.parts]

    @property
    def times(self) -> Floats:
        """The times of all parts."""
        joined: Floats = np.concatenate([*self.moments, np.empty(0)])
        return joined[np.isfinite(joined)]

    @property
    def steps(self) -> Floats:
        """The differences of neighbouring numbers, within each part."""
        return np.concatenate([*(np.diff(part[np.isfinite(part)]) for part in self.numbers), np.empty(0)])

    @property
    def rises(self) -> bool:
        return len(self.steps) > 3 and float(np.mean(self.steps > 0)) > 0.8

    @property
    def codes(self) -> list[int]:
        """The values, if they are whole numbers that change rarely, as labels or numbers of takes do; or nothing."""
        distinct = np.unique(self.values)
        whole = len(distinct) > 1 and bool(np.all(distinct == np.round(distinct)))
        cells = set(distinct.tolist()) <= {0.0, 1.0} and not named_column([self], CODE_NAMES)
        if not whole or cells or not len(self.steps) or self.of_recording:
            return []
        seldom = float(np.mean(self.steps != 0)) < _SELDOM
        return [int(value) for value in distinct] if seldom and (len(distinct) <= MOST_CODES or self.counts) else []

    @property
    def alternates(self) -> bool:
        """Whether the cells of a file change in most of its rows, as names of sensors that are read in turn do."""
        changes = [a != b for cells in self.parts for a, b in pairwise(cells)]
        return not self.of_recording and len(changes) >= _LEAST_CHANGES and sum(changes) > 0.5 * len(changes)

    @property
    def counts(self) -> bool:
        """Whether the numbers go up by one, or stay, as those of takes do."""
        return bool(np.all(np.isin(self.steps, (0.0, 1.0)))) and len(np.unique(self.values)) > 2


@dataclass(frozen=True)
class TableForm:
    """Form of a table of text: its column names, "" if it has none, and its first row of data.

    ``head`` is the row of names, None without one.
    """

    names: tuple[str, ...]
    head: int | None
    begin: int


def is_number(text: str) -> bool:
    return bool(re.fullmatch(r"\s*[-+]?(\d{1,30}([.,]\d*)?|[.,]\d+)([eE][-+]?\d{1,2})?\s*", text))


def named_column(columns: Sequence[SampledColumn], names: Iterable[str]) -> SampledColumn | None:
    """Return the first column whose name is, or else contains, one of ``names``."""
    known = tuple(names)
    plain = [(c, c.name.strip().casefold()) for c in columns]
    exact = next((c for c, name in plain if {name, *name.split(".")} & set(known)), None)
    return exact or next((c for c, name in plain if any(k in name for k in known if len(k) > 3)), None)


def find_form(rows: list[list[str]], width: int) -> TableForm:
    """Find the row of names, and the first row of data, of a table with rows of ``width`` cells."""
    begin = next((k for k, row in enumerate(rows) if len(row) == width and any(map(is_number, row))), len(rows))
    heads = [k for k in range(begin) if len(rows[k]) == width and any(cell.strip() for cell in rows[k])]
    if not heads and begin + 1 < len(rows) and _numbers_columns(rows[begin]):
        heads, begin = [begin], begin + 1
    names = tuple(cell.strip() for cell in rows[heads[0]]) if heads else ("",) * width
    return TableForm(names, heads[0] if heads else None, begin)


def _numbers_columns(row: Sequence[str]) -> bool:
    """Return whether a row numbers the columns: 0, 1, 2, … or 1, 2, 3, …, as pandas writes names of an array."""
    numbers = [cell.strip() for cell in row if is_number(cell)]
    return len(numbers) >= _LEAST_NUMBERED and any(
        numbers == [str(first + k) for k in range(len(numbers))] for first in (0, 1)
    )


def stated_rate(columns: Sequence[SampledColumn]) -> tuple[str, float] | None:
    """Return the key and the value of the one rate beside the samples, such as ``emg.frequency``; None without one."""
    stating = [c for c in columns if c.of_recording and c.is_numeric and _RATE.fullmatch(c.key.rpartition(".")[2])]
    rates = {float(value) for c in stating for value in c.values}
    return (stating[0].key, rates.pop()) if len(rates) == 1 and 1.0 <= min(rates) <= 10_000.0 else None
