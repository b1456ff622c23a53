"""The wire parser survives everything and counts it; what it accepts it reads exactly."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.layouts import Channel, CsvFormat, Layout, load_layout
from plushsense.devices.base import Counters, LossCounter
from plushsense.devices.wire import LineParser, ParsedLine
from support.sent_lines import format_line

pytestmark = pytest.mark.slow

PLUSH = load_layout("plush-15")
OLD = load_layout("plush-14")
ACCEL = load_layout("accel-3")
PHONE = load_layout("phone-6")
PRESS = Layout.from_dict(
    {
        "name": "press",
        "rate_hz": 50.0,
        "channels": [{"name": name, "unit": "N", "kind": "force", "step": 0.01} for name in ("left", "right")],
        "wire": ["device_ms", "left", "right"],
    }
)
GOOD = b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n"


def lines(layout: Layout, data: bytes, *, joining: bool = False) -> tuple[list[ParsedLine], Counters]:
    parser = LineParser(layout, joining=joining)
    parsed = parser.feed(data)
    parser.finish()
    return parsed, parser.counters


@pytest.mark.parametrize(
    "line",
    [
        b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n",
        b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\r\n",
        b"  1   2 3\t4 5 6 7 8   9 10 11 12 13 1000 10  \n",
        b"1;2; 3;4;5;6;7;8;9;10;11;12;13;1000;10\n",
        b"+1, 2,3,4,5,6,7,8,9,10,11,12,13,1000,10,\n",
    ],
)
def test_any_spaces_and_line_ends(line: bytes) -> None:
    parsed, counters = lines(PLUSH, line)
    assert parsed == [ParsedLine(1000, tuple(range(1, 14)), False)]
    assert counters.to_dict() == {"frames": 1, "lost": 0, "malformed": 0, "garbage": 0, "reconnects": 0}


@pytest.mark.parametrize(
    "line",
    [
        b"1 2 3",
        b"1 2 3 4 5 6 7 8 9 10 11 12 13 1000 10 5",
        b"1 2 3 4 5 6 7 8 9 10 11 12 x 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 1_3 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 1.5 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 nan 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 inf 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 0x1F 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 13 -1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 99999999999999999999999 1000 10",
        b"1 2 3 4 5 6 7 8 9 10 11 12 \xd9\xa3 1000 10",
        b"\x00\xff\xfe",
        b"hello",
    ],
)
def test_malformed_lines_are_counted_and_the_next_one_is_read(line: bytes) -> None:
    parsed, counters = lines(PLUSH, line + b"\n" + GOOD)
    assert [p.device_ms for p in parsed] == [1000]
    assert counters.malformed == 1


def test_a_half_line_at_the_end_is_counted() -> None:
    parsed, counters = lines(PLUSH, GOOD + GOOD[:12])
    assert len(parsed) == 1
    assert counters.malformed == 1


def test_joining_in_the_middle_never_yields_half_a_number() -> None:
    cut_number = b"234 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n"  # was 1234: looks whole
    parsed, counters = lines(PLUSH, cut_number + GOOD, joining=True)
    assert [p.values[0] for p in parsed] == [1]
    assert counters.malformed == 0
    parsed, counters = lines(PLUSH, b"13 1000 10\n" + GOOD, joining=True)
    assert len(parsed) == 1
    assert counters.malformed == 1


def test_values_out_of_range_are_kept_and_counted() -> None:
    parsed, counters = lines(PLUSH, b"-2001 2 3 4 5 6 7 8 9 10 11 12 13 1000 10\n" + GOOD)
    assert parsed[0].values[0] == -2001
    assert [p.garbage for p in parsed] == [True, False]
    assert (counters.frames, counters.garbage) == (2, 1)


def test_old_firmware_adds_up_its_delays() -> None:
    rows = b"".join(b"1 2 3 4 5 6 7 8 9 10 11 12 13 %d\n" % d for d in (7, 10, 11, 9))
    parsed, _ = lines(OLD, rows)
    assert [p.device_ms for p in parsed] == [0, 10, 21, 30]


def test_lines_of_another_layout_say_which_one_fits() -> None:
    old = b" ".join(b"7" for _ in range(14)) + b"\r\n"
    parser = LineParser(load_layout("plush-15"))
    parser.feed(old * 9)
    assert "it has 14 fields, not 15" in parser.mismatch("serial:///dev/x")
    parser.feed(old)
    assert parser.mismatch("serial:///dev/x?baud=9600&layout=plush-15") == (
        "The toy sends 14 numbers a line, but layout 'plush-15' has 15; 'plush-14' has 14: "
        "open it as serial:///dev/x?baud=9600&layout=plush-14"
    )
    parser.feed(b"1 2 3\n" * 10)
    assert "3 numbers a line" in parser.mismatch("x")
    assert "give a layout file" in parser.mismatch("x")
    parser.feed(b" ".join(b"7" for _ in range(15)) + b"\n")
    assert parser.mismatch("x") == "", "a line that fits is a frame, so that the others were damaged"
    parser.feed(b"ready ok\n" * 20 + b"7 7 7 7 7 7 7 7 7 7 7 7 7 7 x\n" * 20)
    assert "sends 2 numbers" not in parser.mismatch("x"), "words are no numbers, and a damaged frame is no other layout"


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        (b"ms:0,left:0.5,right:0.25", "it has names before the numbers, so send the numbers alone"),
        (b"20 left=0.5 right=0.25", "'left=0.5' for left is no number"),
        (b"20,1.5,nan", "'nan' for right is no number"),
        (b"20 0x1F 2", "'0x1F' for left is no number"),
        (b"0.02 1 2", "'0.02' for device_ms is no whole number"),
        (b"20;1,5;2,25", "a comma separates numbers, so send decimals with a point, as in 1.5"),
        (b'{"ms": 20, "left": 1.5}', "it is JSON, of which only the numbers are to be sent"),
        (b"20 1", "it has 2 fields, not 3"),
        (b"-20 1 2", "a number is too large, or a clock is negative"),
        (b"\x80\xf8\x00\x9c\xe0", "it is no text, perhaps because the toy has another baud rate (?baud=115200)"),
        (b"\x80\xf8\xff" * 200, "it is no text, perhaps because the toy has another baud rate (?baud=115200)"),
        (b"1 2 3 " * 200, "it has more than 256 bytes without a line end"),
    ],
)
def test_the_first_unreadable_line_is_quoted_with_what_is_wrong(line: bytes, fault: str) -> None:
    parser = LineParser(PRESS)
    parser.feed(line + b"\r\n")
    parser.feed(b"another 1 2\n")
    told = parser.mismatch("serial:///dev/x")
    quoted = line.decode("ascii", "backslashreplace").replace("\0", "\\u0000")[:100]
    assert told.startswith(f"The toy sends lines that cannot be read, the first is '{quoted}"), told
    assert f"': {fault}. Layout 'press' expects 3 numbers a line" in told
    assert told.endswith("separated by spaces, tabs, commas or semicolons: device_ms, left, right.")
    parser.feed(b"20 1.5 2.25\n" * 3)
    assert parser.mismatch("x") == "", "it was a message of the start"


def test_no_built_in_layout_is_recommended_to_users_of_their_own() -> None:
    parser = LineParser(PRESS)
    parser.feed(b"20 1.5 2.25 7\n" * 30)
    assert "the first is '20 1.5 2.25 7': it has 4 fields, not 3. Layout 'press' expects" in parser.mismatch("x")


def test_a_few_damaged_lines_are_no_other_format_but_a_quarter_is() -> None:
    parser = LineParser(PRESS)
    parser.feed(b"20 1.5 2.25\n" * 100 + b"20 1.5 1.5.2\n" * 9)
    assert parser.mismatch("x") == ""
    parser.feed(b"20 1.5 1.5.2\n")
    assert parser.mismatch("x").startswith("The toy sends lines that cannot be read")
    parser.feed(b"20 1F 3\n20 15 3\n" * 60)
    assert parser.mismatch("x").startswith(
        "70 of 230 lines of the toy cannot be read, such as '20 1F 3': '1F' for left"
    )


def test_other_layouts() -> None:
    parsed, _ = lines(ACCEL, b"176637 -6992 -3328 -176\n")
    assert parsed == [ParsedLine(176637, (-6992, -3328, -176), False)]
    parsed, counters = lines(PHONE, b"0.1234 -9.81 .5 1e-2 0 -0.0004 1000\n")
    assert parsed == [ParsedLine(1000, (123, -9810, 500, 10, 0, 0), False)]
    assert counters.malformed == 0


def test_wire_order_is_not_layout_order() -> None:
    mixed = Layout(
        name="mixed",
        title="mixed",
        rate_hz=100.0,
        channels=(Channel("a", "", "x"), Channel("b", "", "x")),
        wire=("b", "device_ms", "a"),
        derived=(),
        inputs=("a", "b"),
        csv=CsvFormat(("host_ms", "device_ms", "a", "b"), ("h", "d", "a", "b"), ","),
    )
    assert lines(mixed, b"2 50 1\n")[0] == [ParsedLine(50, (1, 2), False)]
    assert format_line(mixed, (1, 2), 50, 10) == b"2 50 1\n"


@pytest.mark.parametrize("piece", [10_000_000, 65_536, 100])
def test_a_line_without_end_is_counted_once_in_bounded_memory(piece: int) -> None:
    parser = LineParser(PLUSH)
    chunk = b"7" * piece
    tracemalloc.start()
    for _ in range(10_000_000 // piece):
        assert parser.feed(chunk) == []
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < 100_000
    assert len(parser.feed(b"\n" + GOOD)) == 1
    assert (parser.counters.malformed, parser.counters.frames) == (1, 1)


def test_lost_frames_come_from_the_device_clock() -> None:
    clock, t = [], 1000
    for i in range(300):
        t += 10 + (i % 3 - 1)
        if i not in (50, 51, 52, 200):
            clock.append(t)
    meter = LossCounter()
    assert sum(meter.push(c) for c in clock) == 4


def test_a_restarted_or_paused_clock_is_no_loss() -> None:
    meter = LossCounter()
    clock = [*range(0, 1000, 10), *range(5, 500, 10), *range(90_000, 91_000, 10)]
    assert sum(meter.push(c) for c in clock) == 0


def stamps(seed: int, n: int = 301, period_ms: float = 10.0, jitter: float = 0.0) -> np.ndarray:
    """Time stamps of an even clock that are each up to ``jitter`` periods early or late, in order."""
    even = (np.arange(n) + np.random.default_rng(seed).uniform(-jitter, jitter, n)) * period_ms
    return np.maximum.accumulate(np.rint(even + 1000).astype(int))


def lost(clock: Iterable[int]) -> int:
    meter = LossCounter()
    return sum(meter.push(int(ms)) for ms in clock)


@pytest.mark.parametrize("period_ms", [10.0, 9.7, 1000 / 60, 40.0])
@pytest.mark.parametrize("seed", range(12))
def test_jitter_is_no_loss(seed: int, period_ms: float) -> None:
    uneven = stamps(seed, period_ms=period_ms, jitter=0.4)
    assert np.diff(uneven).max() > 1.5 * period_ms
    assert lost(uneven) == 0


def test_late_frames_and_frames_in_bursts_are_no_loss() -> None:
    clock = stamps(1)
    for size in (2, 4, 16):
        assert lost(clock[np.minimum(np.arange(301) // size * size + size, 300)]) == 0, size
    stalled = np.where((clock >= clock[50]) & (clock < clock[80]), clock[80], clock)
    assert lost(stalled) == 0, "thirty frames came at once"
    meter = LossCounter()
    counted = np.cumsum([meter.push(int(ms)) for ms in stalled])
    assert counted.max() == 30, "until they come, they are missing"


@given(st.sets(st.integers(1, 299), max_size=40), st.sampled_from([10.0, 9.7, 1000 / 60, 40.0]))
@settings(max_examples=100)
def test_every_lost_frame_of_an_even_clock_is_counted(missing: set[int], period_ms: float) -> None:
    missing -= {1, 2, 3, 4}  # the period is known after a few frames
    assert lost(np.delete(stamps(0, period_ms=period_ms), sorted(missing))) == len(missing)


@pytest.mark.parametrize("seed", range(8))
def test_loss_is_counted_among_jitter(seed: int) -> None:
    clock = stamps(seed, jitter=0.15)
    assert lost(np.delete(clock, [60, 61, 62, 120, 200, 201, 250])) == 7


def test_loss_follows_the_real_period() -> None:
    meter = LossCounter()
    assert sum(meter.push(c) for c in range(0, 3000, 31)) == 0


@given(st.lists(st.binary(max_size=400), max_size=8))
@settings(max_examples=200)
def test_noise_never_breaks_the_next_frame(pieces: list[bytes]) -> None:
    parser = LineParser(PLUSH)
    for piece in pieces:
        parser.feed(piece)
    parsed = parser.feed(b"\n" + GOOD)
    assert parsed[-1].values == tuple(range(1, 14))
    assert parser.counters.malformed <= sum(p.count(b"\n") + p.count(b"\r") for p in pieces) + 1


@given(st.binary(max_size=3000), st.lists(st.integers(1, 50), min_size=1, max_size=20))
@settings(max_examples=150)
def test_how_bytes_are_cut_into_pieces_does_not_matter(noise: bytes, cuts: list[int]) -> None:
    data = GOOD + noise + b"\n" + GOOD
    whole = LineParser(PLUSH)
    expected = whole.feed(data)
    parser = LineParser(PLUSH)
    parsed, at, turn = [], 0, 0
    while at < len(data):
        size = cuts[turn % len(cuts)]
        parsed += parser.feed(data[at : at + size])
        at, turn = at + size, turn + 1
    assert parsed == expected
    assert parser.counters == whole.counters


@given(
    st.lists(st.integers(-(2**40), 2**40), min_size=13, max_size=13),
    st.integers(0, 2**50),
    st.integers(0, 1000),
)
def test_what_is_written_is_read_back(values: list[int], device_ms: int, delay_ms: int) -> None:
    parsed, counters = lines(PLUSH, format_line(PLUSH, values, device_ms, delay_ms))
    assert [(p.device_ms, p.values) for p in parsed] == [(device_ms, tuple(values))]
    assert counters.malformed == 0


@given(st.lists(st.integers(-200_000, 200_000), min_size=6, max_size=6), st.integers(0, 2**40))
def test_decimal_layouts_round_trip(values: list[int], device_ms: int) -> None:
    parsed, _ = lines(PHONE, format_line(PHONE, values, device_ms, 10))
    assert [p.values for p in parsed] == [tuple(values)]


FIELDS = st.one_of(
    st.integers(-(10**19), 10**19).map(str),
    st.integers(-50, 50).map(lambda n: f"{n:+d}"),
    st.sampled_from(["1_000", "0x1", "1.0", "-", "+", "--3", "٣", "9" * 15, "9" * 16, "9" * 18, "-" + "9" * 15, "007"]),
)


@settings(max_examples=300)
@given(st.sampled_from(["accel-3", "plush-14"]), st.data())
def test_a_plain_line_is_read_at_one_look_as_field_by_field(layout: str, data: st.DataObject) -> None:
    chosen = load_layout(layout)
    n = len(chosen.wire) + data.draw(st.sampled_from([0, 0, 0, 0, -1, 1]))
    fields = data.draw(st.lists(st.one_of(st.integers(0, 999).map(str), FIELDS), min_size=n, max_size=n))
    line = data.draw(st.sampled_from([" ", "  ", ",", "\t", " ; "])).join(fields).encode() + b"\n"
    quick, slow = LineParser(chosen), LineParser(chosen)
    assert quick._plain is not None
    slow._plain = None
    assert quick.feed(line * 2) == slow.feed(line * 2)
    assert quick.counters == slow.counters
