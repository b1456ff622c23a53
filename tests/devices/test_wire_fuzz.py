"""Whatever bytes come, cut however: no exception, bounded memory, the same frames, no whole one missed."""

from __future__ import annotations

import re
import tracemalloc

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from plushsense.core.layouts import Layout, load_layout
from plushsense.devices.wire import LineParser, ParsedLine
from support.sent_lines import format_line

pytestmark = pytest.mark.slow

LAYOUTS = {name: load_layout(name) for name in ("plush-15", "plush-14", "accel-3", "phone-6")}
BOM = b"\xef\xbb\xbf"
WORDS = [
    b"nan",
    b"inf",
    b"-inf",
    b"NaN",
    b"1e400",
    b"0x10",
    b"1_0",
    b"\xd9\xa3",
    b"--1",
    b"+",
    b"-",
    b".",
    b"e",
    b"1e",
    b"-0",
]
HUGE = [b"9" * 18, b"9" * 19, b"9" * 400, b"-" + b"9" * 16, b"1e99", b"9" * 18 + b"e99", b"9007199254740993"]
ENDS = [b"\n", b"\r\n", b"\r", b"\n\r", b"\r\r\n", b"\n\n"]
GAPS = [b" ", b"  ", b"\t", b",", b";", b"; ", b", "]
WRONG_GAPS = [b":", b"|", b"/", b"\x00", b"\xc2\xa0", b"_", b"\v", b"\f"]


@st.composite
def whole_frame(draw: st.DrawFn, layout: Layout) -> bytes:
    """A line as this toy sends it, its end left out."""
    values = draw(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=layout.n_channels, max_size=layout.n_channels))
    line = format_line(layout, values, draw(st.integers(0, 2**40)), draw(st.integers(0, 2000)))
    return draw(st.sampled_from(GAPS)).join(line.split())


@st.composite
def damaged(draw: st.DrawFn, layout: Layout) -> bytes:
    """A line in which something is wrong, most often."""
    fields = draw(whole_frame(layout)).replace(b",", b" ").replace(b";", b" ").split()
    kind = draw(st.sampled_from(["word", "huge", "gap", "few", "many", "bom", "bytes"]))
    at = draw(st.integers(0, len(fields) - 1))
    if kind in ("word", "huge"):
        fields[at] = draw(st.sampled_from(WORDS if kind == "word" else HUGE))
    elif kind == "few":
        del fields[at]
    elif kind == "many":
        fields.insert(at, b"7")
    elif kind == "bom":
        fields[0] = BOM + fields[0]
    elif kind == "bytes":
        fields[at] = draw(st.binary(max_size=30))
    return draw(st.sampled_from(WRONG_GAPS if kind == "gap" else [b" "])).join(fields)


@st.composite
def streams(draw: st.DrawFn) -> tuple[Layout, bytes]:
    """A layout and what may come over its wire: frames, damage, noise, long lines and mixed line ends."""
    layout = LAYOUTS[draw(st.sampled_from(sorted(LAYOUTS)))]
    longs = st.builds(
        lambda byte, count: byte * count, st.sampled_from([b"7", b" ", b"1 ", b"\xff"]), st.integers(200, 900)
    )
    line = st.one_of(
        whole_frame(layout), damaged(layout), st.binary(max_size=60), longs, st.sampled_from([b"", BOM, b" "])
    )
    parts = draw(st.lists(st.tuples(line, st.sampled_from(ENDS)), max_size=12))
    return layout, b"".join(a + b for a, b in parts) + draw(st.one_of(st.just(b""), line))


def in_pieces(data: bytes, sizes: list[int]) -> list[bytes]:
    pieces, at, turn = [], 0, 0
    while at < len(data):
        size = sizes[turn % len(sizes)]
        pieces.append(data[at : at + size])
        at, turn = at + size, turn + 1
    return pieces


def parse(layout: Layout, pieces: list[bytes], *, joining: bool = False) -> tuple[list[ParsedLine], LineParser]:
    parser = LineParser(layout, joining=joining)
    parsed = [frame for piece in pieces for frame in parser.feed(piece)]
    parser.finish()
    return parsed, parser


def is_frame(layout: Layout, line: bytes) -> bool:
    """Whether a line is a frame, read off the format's description and not the parser."""
    fields = re.split(rb"[ \t,;]+", line.strip(b" \t,;"))
    if len(fields) != len(layout.wire):
        return False
    for name, field in zip(layout.wire, fields, strict=True):
        step = 1.0 if name in ("device_ms", "delay_ms") else layout.channels[layout.index(name)].step
        number = rb"[+-]?\d{1,18}" if step == 1.0 else rb"[+-]?(\d{1,18}(\.\d{0,18})?|\.\d{1,18})([eE][+-]?\d{1,2})?"
        if not re.fullmatch(number, field) or abs(float(field) / step) > 2**53:
            return False
        if step == 1.0 and abs(int(field)) > 2**53:
            return False
        if name in ("device_ms", "delay_ms") and field.startswith(b"-"):
            return False
        if name == "delay_ms" and "device_ms" not in layout.wire and int(field) > 2**31:
            return False
    return True


@given(streams(), st.lists(st.integers(1, 70), min_size=1, max_size=12), st.booleans())
@settings(max_examples=150)
def test_the_cuts_do_not_matter(stream: tuple[Layout, bytes], sizes: list[int], joining: bool) -> None:
    layout, data = stream
    expected, whole = parse(layout, [data], joining=joining)
    for pieces in (in_pieces(data, sizes), in_pieces(data, [1]), [b"", data, b""]):
        parsed, parser = parse(layout, pieces, joining=joining)
        assert parsed == expected
        assert parser.counters == whole.counters


@given(streams())
@settings(max_examples=150)
@example((LAYOUTS["plush-14"], b"1 2 3 4 5 6 7 8 9 10 11 12 13 9007199254740992\n" * 3))
@example((LAYOUTS["accel-3"], b"1 2\r3 4\n5 6 7 8\r"))
def test_every_whole_frame_is_found_and_all_lines_are_accounted_for(stream: tuple[Layout, bytes]) -> None:
    layout, data = stream
    parsed, parser = parse(layout, [data])
    *lines, _rest = re.split(rb"[\r\n]", data)
    short = [line for line in lines if len(line) <= parser.max_line]
    frames = [line for line in short if is_frame(layout, line)]
    empty = sum(not line.strip(b" \t,;") for line in short)
    assert len(parsed) == len(frames)
    assert parser.counters.frames == len(parsed)
    unfinished = bool(_rest.strip(b" \t,;")) or len(_rest) > parser.max_line
    assert parser.counters.frames + parser.counters.malformed == len(lines) - empty + unfinished
    assert parser.counters.garbage == sum(frame.garbage for frame in parsed)
    for frame in parsed:
        assert 0 <= frame.device_ms <= 2**53
        assert len(frame.values) == layout.n_channels
        assert all(abs(value) <= 2**53 for value in frame.values)


@given(st.sampled_from(sorted(LAYOUTS)), st.lists(st.binary(max_size=300), max_size=10), st.booleans())
@settings(max_examples=150)
def test_any_bytes_at_all(name: str, pieces: list[bytes], joining: bool) -> None:
    layout = LAYOUTS[name]
    parser = LineParser(layout, joining=joining)
    for piece in pieces:
        parser.feed(piece)
        assert len(parser._pending) <= parser.max_line
    line = format_line(layout, range(layout.n_channels), 1000, 10)
    parsed = parser.feed(b"\n\n" + line)
    assert parsed[-1].values == tuple(range(layout.n_channels))


@pytest.mark.parametrize("byte", [b"7", b" ", b"1 ", b"\x00", b"-"])
@pytest.mark.parametrize("size", [10_000_000, 4096])
def test_ten_million_characters_without_an_end(byte: bytes, size: int) -> None:
    layout = LAYOUTS["plush-15"]
    parser = LineParser(layout)
    chunk = byte * (size // len(byte))
    tracemalloc.start()
    for _ in range(10_000_000 // size):
        assert parser.feed(chunk) == []
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 50_000
    assert peak < 11_000_000 if size > 4096 else peak < 100_000
    good = format_line(layout, range(13), 1000, 10)
    assert len(parser.feed(b"\r\n" + good)) == 1
    assert (parser.counters.malformed, parser.counters.frames) == (1, 1)


def test_a_mark_of_byte_order_costs_at_most_its_own_line() -> None:
    good = format_line(LAYOUTS["plush-15"], range(13), 1000, 10)
    for mark in (BOM, b"\xff\xfe", b"\xfe\xff"):
        parsed, parser = parse(LAYOUTS["plush-15"], [mark + good + good])
        assert len(parsed) == 1 and parser.counters.malformed == 1
    wide = (good * 3).decode().encode("utf-16")
    parsed, parser = parse(LAYOUTS["plush-15"], [wide, b"\n" + good])
    assert len(parsed) == 1 and parser.counters.malformed >= 3


@pytest.mark.parametrize("end", ENDS)
def test_every_line_end_ends_a_line(end: bytes) -> None:
    layout = LAYOUTS["plush-15"]
    rows = [format_line(layout, range(13), 1000 + t, 10).strip() for t in range(0, 50, 10)]
    parsed, parser = parse(layout, [end.join(rows) + end])
    assert [frame.device_ms for frame in parsed] == [1000, 1010, 1020, 1030, 1040]
    assert parser.counters.malformed == 0


def test_two_halves_joined_by_a_lost_newline_are_no_frame() -> None:
    parsed, parser = parse(LAYOUTS["accel-3"], [b"1 2\r3 4\r\n"])
    assert parsed == [] and parser.counters.malformed == 2


def test_one_huge_delay_does_not_spoil_the_clock() -> None:
    rows = b"".join(b"1 2 3 4 5 6 7 8 9 10 11 12 13 %d\n" % d for d in (0, 10, 2**53, 2**31 + 1, 10))
    parsed, parser = parse(LAYOUTS["plush-14"], [rows])
    assert [frame.device_ms for frame in parsed] == [0, 10, 20]
    assert parser.counters.malformed == 2


def test_a_clock_of_added_delays_stays_within_what_a_number_holds() -> None:
    parser = LineParser(LAYOUTS["plush-14"])
    parser._clock_ms = 2**53 - 5
    row = b"1 2 3 4 5 6 7 8 9 10 11 12 13 10\n"
    assert [frame.device_ms for frame in parser.feed(row * 3)] == [2**53 - 5, 0, 10]
