from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from plushsense.core.errors import FileFormatError
from plushsense.core.layouts import Layout, load_layout
from plushsense.core.recorder_csv import (
    Frames,
    format_rows,
    parse_name,
    read_recording,
    read_stream,
    recording_filename,
    write_recording,
)

pytestmark = pytest.mark.slow

ACCEL = load_layout("accel-3")
PLUSH = load_layout("plush-15")


def plush_frames(rows: int = 40, period: int = 10) -> Frames:
    rng = np.random.default_rng(0)
    values = rng.integers(-500, 3000, (rows, PLUSH.n_channels))
    clock = np.arange(rows) * period + 5000
    return Frames(values.astype(np.int64), clock.astype(np.int64), (clock + 1_700_000_000_000).astype(np.int64))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("At Rest_1589594049994_192.csv", ("At Rest", 1589594049994, 192)),
        ("Midair Clockwise _O__1589594010196_286.csv", ("Midair Clockwise _O_", 1589594010196, 286)),
        ("a_b_1_2.csv", ("a_b", 1, 2)),
        ("fulldatastream.csv", None),
        ("_1_2.csv", None),
        ("Tail tap_12_x.csv", None),
        ("notes.txt", None),
    ],
)
def test_names_are_split_from_the_right(name: str, expected: tuple[str, int, int] | None) -> None:
    found = parse_name(name)
    assert (None if found is None else (found.label, found.epoch_ms, found.rows)) == expected


def test_a_written_file_name_parses_back() -> None:
    name = parse_name(recording_filename("Midair (O)/x", 17, 3))
    assert name is not None
    assert (name.epoch_ms, name.rows) == (17, 3)
    assert "/" not in name.label


@pytest.mark.parametrize("layout", [PLUSH, load_layout("phone-6"), ACCEL], ids=lambda x: x.name)
def test_what_is_written_is_read_back(tmp_path: Path, layout: Layout) -> None:
    rng = np.random.default_rng(1)
    clock = np.arange(30, dtype=np.int64) * 11
    labels = np.array(["WALK"] * 30) if "label" in layout.csv.columns else None
    frames = Frames(rng.integers(-900, 900, (30, layout.n_channels)), clock, clock + 10**12, labels)
    path = tmp_path / "x_1_30.csv"
    write_recording(path, frames, layout)
    back = read_recording(path, layout)
    assert np.array_equal(back.frames.values, frames.values)
    assert np.array_equal(back.frames.device_ms, frames.device_ms)
    assert not back.warnings
    with pytest.raises(FileFormatError, match="never overwritten"):
        write_recording(path, frames, layout)


@pytest.mark.parametrize("separator", ["; ", ";", ", ", ","])
@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_every_form_of_the_authors_files(tmp_path: Path, separator: str, header: bool, ending: str) -> None:
    frames = plush_frames()
    head = separator.join(PLUSH.csv.header) + "\n" if header else ""
    text = (head + format_rows(frames, PLUSH).replace("; ", separator)).replace("\n", ending)
    path = tmp_path / "x_1_40.csv"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    back = read_recording(path, PLUSH)
    assert np.array_equal(back.frames.values, frames.values)
    assert np.array_equal(back.frames.host_ms, frames.host_ms)


def test_delays_of_the_older_firmware_are_integrated(tmp_path: Path) -> None:
    frames = plush_frames()
    delays = np.tile([9, 11, 10, 10], 10).astype(np.int64)
    text = format_rows(Frames(frames.values, delays, frames.host_ms), PLUSH)
    path = tmp_path / "x_1_40.csv"
    path.write_text(text)
    back = read_recording(path, load_layout("plush-14"))
    assert np.array_equal(np.diff(back.frames.device_ms), delays[1:])
    assert any("integrated" in w for w in back.warnings)
    path.write_text(format_rows(frames, PLUSH))
    assert not read_recording(path, PLUSH).warnings, "a real clock is not mistaken for delays"


def test_malformed_lines_are_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text("1, 0, 1, 2, 3\n2, 11, 1, 2\n3, 22, x, 2, 3\n4, 33, 1, 2, 3, 4\n5, 44, 7, 8, 9\n6, 55, 1, 2, 1")
    read = read_stream(path, ACCEL)
    assert read.frames.device_ms.tolist() == [0, 44], "the last line has no end: its last digit may be missing"
    assert read.malformed == 4
    assert read_recording(path, ACCEL).frames.device_ms.tolist() == [0, 44, 55]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is empty"),
        (b"\n\n", "is empty"),
        (b"1, 2, 3\n", r"has 3 columns, but a file of layout 'accel-3' has 5"),
        (b"1;2;3;4;5;6;7;8;9;10;11;12;13;14;15\n", "plush-15"),
        (b"Processing Timestamp (ms), Arduino Timestamp (ms), X, Y, Z\n", "no row"),
        (b"\x00\x01\x02\x00", "not a text file"),
        (b"a, b, c, d, e\n", "no usable row|columns|no row"),
        (b"1, nan, 3, 4, 5\n", "no usable row"),
    ],
)
def test_unreadable_files_are_refused_in_one_sentence(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=said):
        read_recording(path, ACCEL)


@settings(max_examples=150)
@given(st.binary(max_size=400) | st.text(alphabet="0123456789,; \r\n.-enaif", max_size=400).map(str.encode))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x_1_2.csv"
    path.write_bytes(content)
    for layout in (ACCEL, load_layout("phone-6")):
        try:
            frames = read_recording(path, layout).frames
        except FileFormatError:
            continue
        assert frames.values.shape == (len(frames), layout.n_channels)


def test_a_clock_from_zero_with_paired_stamps_is_no_delay(tmp_path: Path) -> None:
    phone = load_layout("phone-6")
    clock = np.repeat(np.arange(50) * 20, 2).astype(np.int64)
    for device_ms in (clock, np.tile(clock[:50], 2), clock[:4]):
        path = tmp_path / f"x_1_{len(device_ms)}.csv"
        path.unlink(missing_ok=True)
        labels = np.array(["WALK"] * len(device_ms))
        write_recording(path, Frames(np.zeros((len(device_ms), 6), np.int64), device_ms, None, labels), phone)
        read = read_recording(path, phone)
        assert np.array_equal(read.frames.device_ms, device_ms)
        assert not read.integrated


def test_delays_are_known_in_a_stream_that_was_appended_to(tmp_path: Path) -> None:
    delays = np.tile([9, 11, 10, 10], 50).astype(np.int64)
    host = np.cumsum(delays) + 10**12
    host[100:] += 86_400_000
    delays[150] = 400_000
    host[150:] += 400_000
    path = tmp_path / "fulldatastream.csv"
    path.write_text(format_rows(Frames(np.ones((200, 13), np.int64), delays, host), PLUSH))
    read = read_stream(path, load_layout("plush-14"))
    assert read.integrated
    assert np.array_equal(np.diff(read.frames.device_ms), delays[1:])


def test_a_bad_line_costs_only_itself(tmp_path: Path) -> None:
    lines = [f"{10**12 + 10 * i}, {10 * i}, {i}, 2, 3" for i in range(2500)]
    lines[1203] = "garbage"
    lines[1204] = "1, 2, 1_000, 4, 5"
    path = tmp_path / "s.csv"
    path.write_text("\n".join(lines) + "\n")
    read = read_stream(path, ACCEL)
    kept = [i for i in range(2500) if i not in (1203, 1204)]
    assert read.frames.values[:, 0].tolist() == kept
    assert read.malformed == 2


def test_whole_numbers_and_fractions_read_alike(tmp_path: Path) -> None:
    whole, fractions = tmp_path / "a_1_3.csv", tmp_path / "b_1_3.csv"
    whole.write_text("9007199254740991, 0, 1, 2, -3\n5, 10, 4, 5, 6\n")
    fractions.write_text("9007199254740991, 0, 1.0, 2, -3.4\n5, 1e1, 4, 5, 6.4\n")
    for one, other in zip(
        vars(read_recording(whole, ACCEL).frames).values(),
        vars(read_recording(fractions, ACCEL).frames).values(),
        strict=True,
    ):
        assert np.array_equal(one, other)
    whole.write_text(f"{2**53}, 0, 1, 2, 3\n{-(2**63)}, 0, 1, 2, 3\n{10**30}, 0, 1, 2, 3\n5, 10, 4, 5, 6\n")
    assert read_recording(whole, ACCEL).malformed == 3


def test_labels_of_two_words_survive_a_bad_line(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_text("0,0,0,0,0,0,0,\n0,0,0,0,0,0,10,Tail pull\n0,0,0\n0,0,0,0,0,0,30," + "w" * 300 + "\n")
    read = read_recording(path, load_layout("phone-6"))
    assert read.frames.labels is not None
    assert read.frames.labels.tolist() == ["", "Tail pull"]
    assert read.malformed == 2


def test_bytes_that_were_read_before_are_taken(tmp_path: Path) -> None:
    read = read_recording(tmp_path / "nowhere.csv", ACCEL, b"1, 0, 1, 2, 3\n")
    assert read.frames.values.tolist() == [[1, 2, 3]]
    with pytest.raises(FileFormatError, match="begins with a line of 1000002 characters"):
        read_recording(tmp_path / "nowhere.csv", ACCEL, b"7" * 1_000_002)
