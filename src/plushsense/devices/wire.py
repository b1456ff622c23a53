"""Parse and format the wire format: numbers separated by spaces, one frame per line.

Any input is accepted: noise, incomplete lines and lines without end are counted, and memory stays bounded.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from plushsense.core.errors import printable
from plushsense.core.layouts import DELAY_MS, DEVICE_MS, Layout, layout_names, load_layout
from plushsense.core.sentences import Message
from plushsense.devices.base import Counters, Frame, LossCounter

_INTEGER = re.compile(rb"[+-]?[0-9]{1,18}\Z")
_DECIMAL = re.compile(rb"[+-]?(?:[0-9]{1,18}(?:\.[0-9]{0,18})?|\.[0-9]{1,18})(?:[eE][+-]?[0-9]{1,2})?\Z")
# Other white space, which `bytes.split` would take for a separator, becomes a byte that no number has.
_SEPARATORS = bytes.maketrans(b",;\t\v\f", b"   \0\0")
_LIMIT = 2**53
_LONGEST_DELAY_MS = 2**31
# So many lines of another width in a row are not lines that were cut or joined, and so many unreadable ones no chance.
_SURE = 10
_QUOTED = 100  # characters of an unreadable line
_NAMED = 8  # fields whose names are listed
_NAME = re.compile(rb"\s*[\"']?[A-Za-z_][^\s,;:=]*[\"']?\s*[:=]")
_DECIMAL_COMMA, _OTHER_GAP = re.compile(rb"[0-9],[0-9]"), re.compile(rb"[0-9][ ;\t]+[0-9]")
_UNREADABLE = (
    "The toy sends lines that cannot be read, the first is '{line}': {why}. Layout '{layout}' expects {n} numbers a "
    "line, separated by spaces, tabs, commas or semicolons: {names}."
)
_OTHER_NUMBERS = (
    "The toy sends {n} numbers a line, but layout '{layout}' has {needed}: give a layout file that names them "
    "(?layout=FILE.toml); built-in are {sizes}."
)
_OTHER_LAYOUT = (
    "The toy sends {n} numbers a line, but layout '{layout}' has {needed}; '{fits}' has {n}: open it as {url}"
)
_OFTEN_UNREADABLE = (
    "{bad} of {of} lines of the toy cannot be read, such as '{line}': {why}. Layout '{layout}' expects {n} numbers a "
    "line, separated by spaces, tabs, commas or semicolons: {names}."
)


@dataclass(frozen=True)
class ParsedLine:
    """A parsed frame: ``device_ms``, and ``values`` (C,) in integer steps, in layout order.

    ``garbage`` is whether a value is outside its channel's valid range; such values are kept unchanged.
    """

    device_ms: int
    values: tuple[int, ...]
    garbage: bool = False


class LineParser:
    """Parse a stream of bytes into frames.

    Fields are separated by any number of spaces, tabs, commas or semicolons, lines by ``\\n``, ``\\r`` or both. If the
    layout's wire has no ``device_ms``, the clock is the sum of the delays, so lost lines do not show in it; a line with
    a delay above 2³¹ ms is malformed. Values of channels with a step of 1 must be integers; others may be decimals.
    Numbers have at most 18 digits (before and after a point), and clocks no minus. Empty lines are ignored. The toy's C
    (``plush_wire_read``) reads the same.

    Args:
        layout: the layout of the lines.
        counters: the counters to update; new ones by default.
        joining: whether reading may begin in the middle of a line (a serial port). Then the first line is dropped, and
            counted as malformed unless it is a whole frame.
    """

    def __init__(self, layout: Layout, counters: Counters | None = None, *, joining: bool = False) -> None:
        self.layout = layout
        self.counters = counters if counters is not None else Counters()
        self.max_line = max(256, 40 * len(layout.wire))
        self._joining = joining
        self._pending = bytearray()
        self._skipping = False
        self._clock_ms = 0
        self._begun = False
        self._loss = LossCounter()
        self._fields = len(layout.wire)
        self._channels = [(layout.index(name), layout.wire.index(name)) for name in layout.names]
        self._steps = [c.step for c in layout.channels]
        low, high = layout.valid_min_int.tolist(), layout.valid_max_int.tolist()
        self._valid = list(zip(low, high, strict=True))
        self._clock_at = layout.wire.index(DEVICE_MS) if DEVICE_MS in layout.wire else -1
        # Matches a whole line of small integers at once, which is faster than matching each field.
        self._plain = (
            re.compile(rb" *[+-]?[0-9]{1,15}(?: +[+-]?[0-9]{1,15}){%d} *\Z" % (self._fields - 1))
            if all(step == 1.0 for step in self._steps)
            else None
        )
        self._delay_at = layout.wire.index(DELAY_MS) if DELAY_MS in layout.wire else -1
        self._other_fields = self._others = 0
        # The first unreadable line since the last frame, and how many there were.
        self._unread, self._unreadable = b"", 0
        self._early = 0  # malformed lines before the first frame, as of a board that starts

    def mismatch(self, url: str) -> Message:
        """Return why lines cannot be read, and what to do; "" if they can.

        Ten lines with another number of numbers are of another built-in layout. Before the first frame, one unreadable
        line is enough; afterwards ten without a frame between them, or a quarter of all lines since.
        """
        bad = self.counters.malformed - self._early
        lines = bad + self.counters.frames
        comma = _DECIMAL_COMMA.search(self._unread) and _OTHER_GAP.search(self._unread)
        # To the user of a layout of their own, the built-in ones are of no use.
        if self._others >= _SURE and not comma and self.layout.name in layout_names():
            return self._other_layout(url)
        if self._unreadable >= (_SURE if self._begun else 1):
            template, many = _UNREADABLE, {}
        elif self._begun and bad >= 2 * _SURE and 4 * bad >= lines and self._unread:
            template, many = _OFTEN_UNREADABLE, {"bad": bad, "of": lines}
        else:
            return Message()
        layout, names = self.layout, self.layout.wire
        listed = ", ".join(names if len(names) <= _NAMED else (*names[: _NAMED - 1], "…"))
        line, why = _quoted(self._unread), self._fault(self._unread, url)
        return Message(
            template,
            line=line,
            why=why,
            layout=layout.name,
            n=len(names),
            names=listed,
            **many,
        )

    def _fault(self, line: bytes, url: str) -> Message:
        """Return what is wrong with an unreadable line, without a full stop."""
        fields, needed = line.translate(_SEPARATORS).split(), self._fields
        if sum(not 32 <= byte < 127 and byte != 9 for byte in line) > len(line) // 4:
            baud = ", perhaps because the toy has another baud rate (?baud=115200)" if url.startswith("serial") else ""
            return Message("it is no text{baud}", baud=baud)
        if len(line) > self.max_line:
            return Message("it has more than {n} bytes without a line end", n=self.max_line)
        if line.lstrip().startswith((b"{", b"[")):
            return Message("it is JSON, of which only the numbers are to be sent")
        if _NAME.match(line):
            return Message("it has names before the numbers, so send the numbers alone")
        if len(fields) != needed:
            if _DECIMAL_COMMA.search(line) and _OTHER_GAP.search(line):
                return Message("a comma separates numbers, so send decimals with a point, as in 1.5")
            has = "1 field" if len(fields) == 1 else f"{len(fields)} fields"
            return Message("it has {has}, not {needed}", has=has, needed=needed, n=len(fields))
        for name, field in zip(self.layout.wire, fields, strict=True):
            text = _quoted(field)
            whole = name not in self.layout.names or self._steps[self.layout.index(name)] == 1.0
            if not (_INTEGER if whole else _DECIMAL).match(field):
                if whole and _DECIMAL.match(field):
                    return Message("'{field}' for {channel} is no whole number", field=text, channel=name)
                return Message("'{field}' for {channel} is no number", field=text, channel=name)
        return Message("a number is too large, or a clock is negative")

    def _other_layout(self, url: str) -> Message:
        """Return which layout has the number of numbers of the last lines."""
        number, layout = self._other_fields, self.layout
        known = [load_layout(name) for name in layout_names()]
        fitting = [other for other in known if len(other.wire) == number]
        # A model reads any layout with its channels.
        fitting = [other for other in fitting if other.channels == layout.channels] or fitting
        values = {"n": number, "layout": layout.name, "needed": self._fields}
        if not fitting:
            sizes = ", ".join(f"{other.name} {len(other.wire)}" for other in known)
            return Message(_OTHER_NUMBERS, **values, sizes=sizes)
        place, _, query = url.partition("?")
        kept = [part for part in query.split("&") if part and not part.startswith("layout=")]
        address = f"{place}?{'&'.join([*kept, f'layout={fitting[0].name}'])}"
        return Message(_OTHER_LAYOUT, **values, fits=fitting[0].name, url=address)

    def feed(self, data: bytes) -> list[ParsedLine]:
        """Return the frames that end within these bytes; keep the rest of the last line for the next call."""
        parsed: list[ParsedLine] = []
        # A lone \r also ends a line, so that two lines joined by a lost \n are never read as one frame.
        data = data.replace(b"\r", b"\n")
        start = 0
        while True:
            end = data.find(b"\n", start)
            if end < 0:
                self._keep(data[start:])
                return parsed
            self._keep(data[start:end])
            start = end + 1
            line = self._take()
            if line is not None:
                parsed.append(line)

    def frames(self, data: bytes, host_ms: int) -> list[Frame]:
        """Return the frames that end within these bytes, which arrived at ``host_ms``; see `feed`."""
        return [Frame(host_ms, line.device_ms, line.values) for line in self.feed(data)]

    def finish(self) -> None:
        """Count an incomplete last line as malformed; call this at the end of the source."""
        if self._pending.translate(_SEPARATORS).strip() and not self._skipping:
            self.counters.malformed += 1
        self._pending.clear()
        self._skipping = False

    def _keep(self, piece: bytes) -> None:
        if self._skipping or not piece:
            return
        if len(self._pending) + len(piece) > self.max_line:
            self.counters.malformed += 1
            self._note_unread(bytes(self._pending) + piece)
            self._pending.clear()
            self._skipping = True
        else:
            self._pending += piece

    def _take(self) -> ParsedLine | None:
        line = bytes(self._pending)
        self._pending.clear()
        joined, self._joining = self._joining, False
        if self._skipping:
            self._skipping = False
            return None
        came, line = line, line.translate(_SEPARATORS)
        fields = line.split()
        if not fields:
            return None
        numbers = self._numbers(fields, line)
        if numbers is None:
            self.counters.malformed += 1
            self._note_other(fields)
            if not joined:
                self._note_unread(came)
            return None
        self._others = self._unreadable = 0
        if joined:
            return None
        if self._clock_at >= 0:
            device_ms = numbers[self._clock_at]
        else:
            # The first delay refers to a frame before the first one: the clock starts at 0.
            self._clock_ms += numbers[self._delay_at] if self._begun else 0
            if self._clock_ms > _LIMIT:
                self._clock_ms = 0
            device_ms = self._clock_ms
        if not self._begun:
            self._begun, self._early = True, self.counters.malformed
        values = tuple([numbers[at] for _, at in self._channels])
        garbage = False
        for value, (low, high) in zip(values, self._valid, strict=True):
            if not low <= value <= high:
                garbage = True
                break
        self.counters.frames += 1
        self.counters.garbage += garbage
        self.counters.lost += self._loss.push(device_ms)
        return ParsedLine(device_ms, values, garbage)

    def _note_other(self, fields: list[bytes]) -> None:
        """Count lines in a row that hold the same wrong number of numbers."""
        if len(fields) != self._other_fields or not all(_DECIMAL.match(field) for field in fields):
            self._other_fields, self._others = len(fields), 0
        self._others += len(fields) != self._fields

    def _note_unread(self, line: bytes) -> None:
        """Count a line that cannot be read, and keep it if it is the first since the last frame."""
        if not self._unreadable:
            self._unread = line[: self.max_line + 1]
        self._unreadable += 1

    def _numbers(self, fields: list[bytes], line: bytes) -> list[int] | None:
        """Return all fields as integers (channels in steps, clocks in ms); None if the line is not a frame."""
        if len(fields) != self._fields:
            return None
        if self._plain is not None and self._plain.match(line) is not None:
            at, delay = self._clock_at, self._delay_at
            if (at >= 0 and fields[at].startswith(b"-")) or (delay >= 0 and fields[delay].startswith(b"-")):
                return None
            plain = [int(field) for field in fields]
            return None if at < 0 and plain[delay] > _LONGEST_DELAY_MS else plain
        numbers = [0] * self._fields
        for at in (self._clock_at, self._delay_at):
            if at >= 0:
                number = None if fields[at].startswith(b"-") else _integer(fields[at])
                if number is None:
                    return None
                numbers[at] = number
        if self._clock_at < 0 and numbers[self._delay_at] > _LONGEST_DELAY_MS:
            return None
        for index, at in self._channels:
            step = self._steps[index]
            number = _integer(fields[at]) if step == 1.0 else _steps(fields[at], step)
            if number is None:
                return None
            numbers[at] = number
        return numbers


def _quoted(line: bytes) -> str:
    text = line.decode("ascii", "backslashreplace")
    return printable(text if len(text) <= _QUOTED else f"{text[:_QUOTED]}…")


def _integer(field: bytes) -> int | None:
    if _INTEGER.match(field) is None:
        return None
    number = int(field)
    return number if -_LIMIT <= number <= _LIMIT else None


def _steps(field: bytes, step: float) -> int | None:
    if _DECIMAL.match(field) is None:
        return None
    number = float(field) / step
    return round(number) if -_LIMIT <= number <= _LIMIT else None
