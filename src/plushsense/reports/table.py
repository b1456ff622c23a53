"""Tables of raw values that can be written as text, HTML, Markdown and CSV, and the formats of their cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import groupby
from typing import Any, Literal

DASH = "—"

Row = Mapping[str, Any]
Kind = Literal["text", "count", "percent", "share", "right"]
"""How a column is printed; "right" is formatted text that is aligned to the right."""


@dataclass(frozen=True)
class Column:
    """One column of a `Table`.

    Args:
        key: the key of its values in each row, and its name in CSV.
        head: the heading; a line feed breaks it in HTML.
        kind: format and alignment.
        score: whether the values depend on the split, so that the heading shows the table's marks (leaky, simulated).
        group: a heading over this column and its neighbours of the same group.
        leaky: whether the values of this column are of a leaky split, where the table as a whole is not.
        plain: the heading in text and Markdown; by default group and head.
        style: CSS classes of the column's cells in HTML.
    """

    key: str
    head: str
    kind: Kind = "text"
    score: bool = False
    group: str = ""
    leaky: bool = False
    plain: str = ""
    style: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of raw values under columns.

    A missing value is None or absent. A value may be a pair (value, note): HTML shows the note in small type below the
    value, the other formats leave it out. The key ``class`` of a row is its CSS class.

    Args:
        name: a file name without its ending.
        title: heading of the table.
        columns: the columns from left to right.
        rows: mappings from column keys to values.
        notes: sentences to print below the table.
        limit: maximum of rows that are printed; None: all. CSV always has all rows.
        leaky, simulated: marks to show in the headings of columns of scores.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    limit: int | None = None
    leaky: bool = False
    simulated: bool = False

    @classmethod
    def of(cls, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> Table:
        """Return a table of formatted cells, as the command line prints them."""
        columns = tuple(Column(str(i), head) for i, head in enumerate(heads))
        cells = ({str(i): None if cell is None else str(cell) for i, cell in enumerate(row)} for row in rows)
        return cls("", "", columns, tuple(cells))

    @classmethod
    def from_rows(cls, name: str, title: str, rows: Sequence[Row]) -> Table:
        """Return a table with one column for each key of the first row."""
        return cls(name, title, tuple(Column(key, key) for key in rows[0]), tuple(rows))

    @property
    def omitted(self) -> int:
        """Number of rows that are not printed."""
        return len(self.rows) - len(self.rows[: self.limit])

    def cells(self) -> list[list[str]]:
        """Return the printed rows as text, without the notes of pairs."""
        return [[_cell(_value(row, c)[0], FORMATS[c.kind]) for c in self.columns] for row in self.rows[: self.limit]]

    def text(self) -> str:
        """Return the table for a terminal, aligned, with missing values blank.

        So that numbers can be copied, counts are not grouped by thousands, and shares are numbers from 0 to 1.
        """
        heads = [self._heading(c) for c in self.columns]
        rows = ([_value(row, c)[0] for c in self.columns] for row in self.rows[: self.limit])
        cells = [["" if v is None else number(v) if isinstance(v, float) else str(v) for v in row] for row in rows]
        widths = [max(map(len, column)) for column in zip(heads, *cells, strict=True)]
        right = [c.kind != "text" or _numeric(row[i] for row in cells) for i, c in enumerate(self.columns)]

        def line(row: Sequence[str]) -> str:
            parts = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True))
            return "  ".join(parts).rstrip()

        return "\n".join([line(heads), line(["-" * w for w in widths]), *map(line, cells)])

    def markdown(self) -> str:
        """Return the table in GitHub's Markdown."""
        rules = ["---" if c.kind == "text" else "---:" for c in self.columns]
        rows = [[self._heading(c) for c in self.columns], rules, *self.cells()]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows)

    def csv(self, constants: Row | None = None, separator: str = ",") -> str:
        """Return all rows with raw values; ``constants`` are further columns with the same value in each row."""
        constants = constants or {}
        out = io.StringIO()
        writer = csv.writer(out, delimiter=separator, lineterminator="\n")
        writer.writerow([*(c.key for c in self.columns), *constants])
        writer.writerows([*(_value(row, c)[0] for c in self.columns), *constants.values()] for row in self.rows)
        return out.getvalue()

    def html(self) -> str:
        """Return the table as an HTML element; all texts are escaped."""
        body = "\n".join(map(self._html_row, self.rows[: self.limit]))
        return f'<div class="wide"><table>\n<thead>{self._html_head()}</thead>\n<tbody>\n{body}\n</tbody></table></div>'

    __html__ = _repr_html_ = html

    def _heading(self, column: Column) -> str:
        plain = column.plain or f"{column.group}: {column.head}".removeprefix(": ").replace("\n", " ")
        return plain + " (leaky)" * (column.leaky or (self.leaky and column.score))

    def _marks(self, column: Column) -> str:
        leaky, simulated = column.leaky or (self.leaky and column.score), self.simulated and column.score
        marks = ' <span class="leaky">LEAKY</span>' * leaky + ' <span class="virtual">SIMULATION</span>' * simulated
        return f'<span class="marks">{marks}</span>' if marks else ""

    def _html_head(self) -> str:
        grouped = any(c.group for c in self.columns)

        def th(c: Column, attributes: str = "", marks: bool = True) -> str:
            head = escape(c.head).replace("\n", "<br>") + (self._marks(c) if marks else "")
            return f'<th{_class(c)}{attributes} scope="col">{head}</th>'

        if not grouped:
            return f"<tr>{''.join(map(th, self.columns))}</tr>"
        upper, lower = [], []
        for name, members in groupby(self.columns, key=lambda c: c.group):
            mine = list(members)
            if name:
                marks, style = self._marks(mine[0]) if mine[0].leaky else "", f"group {mine[0].style}".strip()
                upper.append(f'<th class="{style}" colspan="{len(mine)}">{escape(name)}{marks}</th>')
                lower += [th(c, marks=not c.leaky) for c in mine]
            else:
                upper += [th(c, ' rowspan="2"') for c in mine]
        return f"<tr>{''.join(upper)}</tr>\n<tr>{''.join(lower)}</tr>"

    def _html_row(self, row: Row) -> str:
        cells = []
        for c in self.columns:
            value, note = _value(row, c)
            small = f'<span class="soft">{escape(note)}</span>' if note else ""
            cells.append(f"<td{_class(c)}>{escape(_cell(value, FORMATS[c.kind]))}{small}</td>")
        style = f' class="{row["class"]}"' if row.get("class") else ""
        return f"<tr{style}>{''.join(cells)}</tr>"


def _class(column: Column) -> str:
    classes = " ".join(filter(None, ("n" if column.kind != "text" else "", column.style)))
    return f' class="{classes}"' if classes else ""


def _value(row: Row, column: Column) -> tuple[Any, str]:
    value = row.get(column.key)
    return value if isinstance(value, tuple) else (value, "")


def _cell(value: Any, form: Callable[[Any], str]) -> str:
    return "" if value == "" else form(value)


def _numeric(cells: Iterable[str]) -> bool:
    cells = list(cells)
    return bool(cells) and all(not cell or cell[0].isdigit() or cell[0] in "-±" for cell in cells)


def number(value: Any, digits: int = 3) -> str:
    """Format a real number with a fixed number of decimals; return a dash for a value that is missing or not finite."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return DASH
    return f"{value:.{digits}f}"


def percent(value: Any, digits: int = 1) -> str:
    """Format a share from 0 to 1 in percent; return a dash as `number` does."""
    return DASH if number(value) == DASH else f"{number(100 * value, digits)} %"


def count(value: Any, unit: str = "") -> str:
    """Format a whole number, or the length of a list, in groups of three with its unit; a dash for a missing value."""
    if isinstance(value, Sequence | Mapping) and not isinstance(value, str):
        value = len(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return DASH
    grouped = f"{round(value):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return f"{grouped} {unit}".rstrip()


def text(value: Any) -> str:
    """Format a value as text, with the items of lists joined by commas; return a dash for a missing value."""
    if value is None or value == "":
        return DASH
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text(item)}" for key, item in value.items()) or DASH
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(text(item) for item in value) or DASH
    return str(value)


def mean_sd(metric: Any) -> str:
    """Return ``0.561 ± 0.126`` for a metric of an evaluation ({mean, sd, ci95})."""
    if not isinstance(metric, Mapping) or number(metric.get("mean")) == DASH:
        return DASH
    return f"{number(metric.get('mean'))} ± {number(metric.get('sd'))}"


def interval(metric: Any) -> str:
    """Return the 95 % interval of a metric of an evaluation, such as ``0.512 to 0.607``."""
    ends = metric.get("ci95") if isinstance(metric, Mapping) else None
    if not isinstance(ends, Sequence) or len(ends) != 2 or DASH in (number(ends[0]), number(ends[1])):
        return DASH
    return f"{number(ends[0])} to {number(ends[1])}"


FORMATS: dict[Kind, Callable[[Any], str]] = {
    "text": text,
    "count": count,
    "percent": percent,
    "share": number,
    "right": text,
}
