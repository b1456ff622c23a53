import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.layouts import DEVICE_MS, HOST_MS, load_layout
from plushsense.core.recorder_csv import read_recording, read_stream
from plushsense.dataset.privacy.pseudonyms import (
    FIRST_MS,
    dates_in,
    holds_dates,
    shifted_number,
    shifted_rows,
    shifted_text,
)

ACCEL, PLUSH, PHONE = (load_layout(name) for name in ("accel-3", "plush-15", "phone-6"))
SHIFT = 5_000_000_123_000
NOW = 1_760_000_000_000


def test_a_date_moves_and_what_a_toy_counts_does_not() -> None:
    assert shifted_number(NOW, SHIFT) == NOW + SHIFT
    assert shifted_number(NOW * 1000 + 7, SHIFT) == (NOW + SHIFT) * 1000 + 7, "µs"
    assert shifted_number(NOW * 10**6, SHIFT) == (NOW + SHIFT) * 10**6, "ns"
    for small in (0, 4_294_967_295, 1_234_567, FIRST_MS - 1):
        assert shifted_number(small, SHIFT) == small


def test_dates_in_text_move_in_the_form_they_have() -> None:
    days = 86_400_000 * 400
    assert shifted_text("on 2025-10-09 he", days) == "on 2026-11-13 he"
    assert shifted_text("2025-10-09T10:15:00+02:00", days + 61_000) == "2026-11-13T10:16:01+02:00"
    assert shifted_text("2025-10-09 10:15", days) == "2026-11-13 10:15"
    assert shifted_text("2025-10-09T10:15:00.123Z", days) == "2026-11-13T10:15:00.123Z"
    assert shifted_text("20251009-101500", days + 1000) == "20261113-101501"
    assert shifted_text(f"Wave_{NOW}_60.csv", days) == f"Wave_{NOW + days}_60.csv"
    assert shifted_text("born 1.5.2016, v0.13.2, Tail tap 1, 99-99", days) == "born [date], v0.13.2, Tail tap 1, 99-99"
    assert shifted_text("2025-13-45 is none", days) == "2025-13-45 is none"


@pytest.mark.parametrize("text", [f"x {NOW} y", "2025-10-09", "20251009-101500", "9/10/2025", f"a_{NOW * 10**6}_b"])
def test_real_dates_are_found_and_moved_ones_are_not(text: str) -> None:
    assert dates_in(text)
    assert dates_in(shifted_text(text, 86_400_000 * 365 * 150)) == []


@pytest.mark.parametrize("sep", [", ", ",", "; ", ";", "\t", " "])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("header", [True, False])
def test_only_the_times_change_byte_for_byte(sep: str, end: str, header: bool, tmp_path: Path) -> None:
    rows = [[NOW + 10 * i, 5_000 + 10 * i, i, -i, 7680] for i in range(30)]
    head = sep.join(ACCEL.csv.header) + end if header and sep.strip() else ""
    body = [sep.join(map(str, row)) for row in rows]
    path = tmp_path / "x_1_30.csv"
    data = (head + end.join(body) + end).encode()
    out = shifted_rows(data, ACCEL, (HOST_MS,), SHIFT, path)
    assert out == re.sub(rb"\b17\d{11}\b", lambda m: str(int(m.group()) + SHIFT).encode(), data)
    assert out != data
    path.write_bytes(data)
    before = read_recording(path, ACCEL).frames
    path.write_bytes(out)
    after = read_recording(path, ACCEL).frames
    assert np.array_equal(before.values, after.values)
    assert np.array_equal(before.device_ms, after.device_ms)
    assert before.host_ms is not None
    assert after.host_ms is not None
    assert np.array_equal(before.host_ms + SHIFT, after.host_ms)


def test_malformed_lines_hide_their_dates_too(tmp_path: Path) -> None:
    good = f"{NOW}, 5000, 1, 2, 3\n".encode()
    data = (
        good
        + f"{NOW}, 50\n".encode()  # cut
        + b"17600000, 5020, 1, 2, 3\n"  # a digit was lost
        + f"1, 2, {NOW + 40}, 5040, 1, 2, 3\n".encode()  # two lines in one
        + f"{NOW}{NOW}, 5, 1, 2, 3\n".encode()
        + b"\n  \n"
        + good
        + b"17600000"  # the stream's end
    )
    out = shifted_rows(data, ACCEL, (HOST_MS,), SHIFT, tmp_path / "fulldatastream.csv")
    assert b"176" not in out
    assert out.count(str(NOW + SHIFT).encode()) == 3
    assert b"00000000, 5020, 1, 2, 3\n" in out
    assert f"1, 2, {NOW + 40 + SHIFT}, 5040, 1, 2, 3\n".encode() in out
    assert len(out.split(b"\n")) == len(data.split(b"\n"))


def test_dates_as_matlab_writes_them(tmp_path: Path) -> None:
    row = ";".join(["1"] * 13)
    data = f"{row};1.76e+12;5000\n{row};{NOW}.5;5010\n".encode()
    out = shifted_rows(data, PLUSH, (HOST_MS,), SHIFT, tmp_path / "a_1_2.csv")
    assert out == f"{row};{NOW + SHIFT};5000\n{row};{NOW + SHIFT}.5;5010\n".encode()


def test_the_clock_of_labelled_rows_is_a_date(tmp_path: Path) -> None:
    lines = [f"-4.1602{i},-1.18,-8.99,0.002,-0.013,-0.03,{NOW + 10 * i},STANDING UP\r\n" for i in range(9)]
    data = (",".join(PHONE.csv.header) + "\r\n" + "".join(lines)).encode()
    path = tmp_path / "s.csv"
    path.write_bytes(data)
    before = read_stream(path, PHONE).frames
    assert holds_dates(before.device_ms)
    out = shifted_rows(data, PHONE, (DEVICE_MS,), SHIFT, path)
    path.write_bytes(out)
    after = read_stream(path, PHONE).frames
    assert np.array_equal(before.device_ms + SHIFT, after.device_ms)
    assert np.array_equal(before.values, after.values)
    assert out.replace(str(NOW + SHIFT)[:7].encode(), b"") != out
    assert re.sub(rb"\d{13}", b"", out) == re.sub(rb"\d{13}", b"", data)


def test_nothing_to_move_leaves_the_bytes_alone(tmp_path: Path) -> None:
    data = b"1, 2, 3, 4, 5\n"
    assert shifted_rows(data, ACCEL, (), SHIFT, tmp_path / "x.csv") is data
    assert shifted_rows(b"", ACCEL, (HOST_MS,), SHIFT, tmp_path / "x.csv") == b""


_CELLS = [str(NOW), str(NOW + 10), f"{NOW}.25", "1.76e+12", "nan", "-", "", "0", "5000", "1e999999999", "x"]
_PIECES = st.one_of(st.sampled_from(_CELLS), st.text("0123456789eE.-+", max_size=20))


@st.composite
def malformed(draw: st.DrawFn) -> str:
    """A line of the wrong number of cells: in one of the right number, other columns hold values, which stay."""
    line = draw(st.sampled_from([", ", ",", ";", "\t"])).join(draw(st.lists(_PIECES, max_size=8)))
    return line if len(re.findall(r"[^;,\s]+", line)) != 5 else line + ",1"


@settings(max_examples=200)
@given(lines=st.lists(malformed(), max_size=6), end=st.sampled_from(["\n", "\r\n"]))
def test_whatever_a_line_holds_no_date_is_left_and_no_line_lost(lines: list[str], end: str) -> None:
    first = f"{NOW}, 5000, 1, 2, 3"
    data = end.join([first, *lines, ""]).encode()
    out = shifted_rows(data, ACCEL, (HOST_MS,), SHIFT, Path("x_1_1.csv"))
    assert str(NOW).encode() not in out
    assert str(NOW + 10).encode() not in out
    assert out.count(b"\n") == data.count(b"\n")
    kept = [line for line in lines if not re.search(r"\d{5}|[eE]", line)]
    assert set(kept) <= set(out.decode().split(end)), "a line without a date or a piece of one is left alone"


def test_a_line_without_end_takes_no_time() -> None:
    for line in (b"9" * 10**6, b"1," * 10**5, b"1;" * 10**5 + b"x"):
        assert shifted_rows(f"{NOW}, 5000, 1, 2, 3\n".encode() + line, ACCEL, (HOST_MS,), SHIFT, Path("x_1_1.csv"))
