"""Whatever is imported: done, or refused in a sentence; never a traceback, never a write outside the target."""

from __future__ import annotations

import io
import json
import os
import re
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from plushsense.core.errors import PlushSenseError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, format_rows, read_recording, read_stream
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset

pytestmark = [pytest.mark.apart("import-fuzz"), pytest.mark.slow]

ACCEL = load_layout("accel-3")
PHONE = load_layout("phone-6")
Writer = Callable[..., Path]
LONG = 3_000_000


def some(examples: int) -> Any:
    """So many examples, or PLUSHSENSE_FUZZ times as many for a long look."""
    examples *= int(os.environ.get("PLUSHSENSE_FUZZ", "1"))
    quiet = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]
    return settings(max_examples=examples, suppress_health_check=quiet, print_blob=True)


class Place:
    """A fresh folder a time; what is imported there must stay in it."""

    def __init__(self, root: Path):
        self.root = root
        self.number = 0

    def fresh(self) -> Path:
        self.number += 1
        inside = self.root / str(self.number) / "inside"
        inside.mkdir(parents=True)
        return inside

    def _files(self, inside: Path) -> set[Path]:
        near = set(self.root.iterdir()) | set(self.root.parent.iterdir())
        return near | {p for p in inside.parent.rglob("*") if p.is_symlink() or p.is_file()}

    def imported(self, source: Path, inside: Path, **said: Any) -> bool:
        before = self._files(inside)
        try:
            done = import_recordings(source, inside / "DS", **said)
        except PlushSenseError as refusal:
            assert str(refusal).strip()
            assert said.get("add_to") or not (inside / "DS").exists(), "refused, so nothing is there"
            done = None
        after = self._files(inside)
        assert before <= after
        assert all(inside / "DS" in p.parents for p in after - before)
        if done is None:
            return False
        json.dumps(done.to_json(), ensure_ascii=False, allow_nan=False).encode("utf-8")
        assert not [p for p in (inside / "DS").rglob("*") if p.is_symlink()]
        again = open_dataset(inside / "DS").recordings
        assert [r.to_text() for r in again] == [r.to_text() for r in done.dataset.recordings]
        for recording in done.dataset.recordings:
            assert len(done.dataset.read(recording)) == recording.rows
        return True


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def accel(rows: int = 30, seed: int = 0) -> Frames:
    clock = np.arange(rows, dtype=np.int64) * 10 + seed * 100_000
    return Frames(np.random.default_rng(seed).integers(-900, 900, (rows, 3)), clock, clock + 10**12)


GOOD = format_rows(accel(), ACCEL).encode()
HEADED = b"Processing Timestamp (ms), Arduino Timestamp (ms), X, Y, Z\n" + GOOD
CELL = st.sampled_from(
    [
        b"1",
        b"-7",
        b"",
        b" ",
        b"nan",
        b"-inf",
        b"1e400",
        b"9" * 401,
        b"1_000",
        b"0x1",
        b"\xff",
        b"WALK",
        b'"',
        b"\x00",
        b"1.5",
    ]
)
LINE = st.builds(
    lambda cells, sep, end: sep.join(cells) + end,
    st.lists(CELL, max_size=9),
    st.sampled_from([b", ", b";", b"\t", b" ", b",", b"|"]),
    st.sampled_from([b"\n", b"\r\n", b"\r", b""]),
)
LINES = st.lists(LINE, max_size=12).map(b"".join)


def mutated(whole: bytes) -> st.SearchStrategy[bytes]:
    """The bytes with a few pieces replaced, cut out or doubled."""
    piece = st.tuples(st.integers(0, len(whole)), st.integers(0, 40), st.binary(max_size=12))

    def apply(pieces: list[tuple[int, int, bytes]]) -> bytes:
        data = whole
        for at, cut, new in pieces:
            data = data[:at] + new + data[at + cut :]
        return data

    return st.lists(piece, min_size=1, max_size=4).map(apply)


CONTENT = st.one_of(
    st.just(GOOD),
    mutated(HEADED),
    LINES,
    LINES.map(lambda lines: HEADED + lines),
    st.binary(max_size=200),
    st.just(b"\xef\xbb\xbf" + HEADED),
    st.just(HEADED.decode().encode("utf-16")),
    st.just(HEADED.replace(b", ", b" | ")),
    st.just(b"\n" * 50 + GOOD),
)
ODD = [
    "..",
    "a b",
    "CON",
    "x" * 60,
    "é",
    "e\u0301",
    "日本",
    "none",
    "again-2",
    "-",
    "P01 ",
    "unknown",
    "a\nb",
    "\u202e",
]
NAME = st.sampled_from(["ana", "ben", "Ana", *ODD[1:]]) | st.text(max_size=12)
FILE = st.sampled_from(
    ["Shake_1_30.csv", "Wave_2_30.CSV", "fulldatastream.csv", "_1_2.csv", "a_b_3_30.csv", "s01.csv", "x.txt"]
) | NAME.map(lambda n: f"{n}_{7}_30.csv")


def put(folder: Path, name: str, content: bytes) -> None:
    """Write a file where the file system lets us."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    except (OSError, ValueError):
        pass


def plain(name: str) -> str:
    """A name that stays in its folder: the source itself must not write outside either."""
    return re.sub(r"[/\\\x00]", "_", name).replace("..", "_") or "_"


@some(70)
@given(
    st.lists(st.tuples(NAME, FILE, CONTENT), max_size=6),
    st.sampled_from([ACCEL, PHONE]),
    st.booleans(),
    st.none() | st.text(max_size=80).map(lambda t: ("file,subject\n" + t).encode()) | st.binary(max_size=60),
)
def test_folders(
    place: Place, files: list[tuple[str, str, bytes]], layout: Any, good: bool, mapping: bytes | None
) -> None:
    inside = place.fresh()
    (inside / "src").mkdir()
    for folder, name, content in files:
        put(inside / "src" / plain(folder), plain(name), content)
    if good:
        put(inside / "src" / "zoe", "Shake_5_30.csv", GOOD)
    said: dict[str, Any] = {}
    if mapping is not None:
        (inside / "map.csv").write_bytes(mapping)
        said = {"subjects": inside / "map.csv", "people": inside / "map.csv"}
    place.imported(inside / "src", inside, layout=layout, **said)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)
HEAD_KEYS = (
    "format", "subject", "session", "started_ms", "layout", "protocol", "age_group", "gender", "consent", "device",
    "software", "simulated", "colour",
)  # fmt: skip


@some(60)
@given(
    st.dictionaries(st.sampled_from(HEAD_KEYS), JSON | st.text(max_size=8), max_size=2),
    st.lists(JSON.map(json.dumps).map(str.encode) | st.binary(max_size=40), max_size=4),
    JSON.map(json.dumps).map(str.encode) | st.binary(max_size=40),
    st.none() | CONTENT,
    st.none() | CONTENT,
)
@example({"subject": "\ud800"}, [b'{"what": "redo", "at_ms": Infinity, "file": "x"}'], b"[" * 50_000, None, None)
@example({"session": "../.."}, [b"[" * 50_000], b"", None, None)
@example({"layout": {"name": "x" * 300, "channels": [[]]}}, [], b"", None, None)
def test_sessions(
    place: Place,
    session_writer: Writer,
    head: dict[str, Any],
    log: list[bytes],
    sidecar: bytes,
    recording: bytes | None,
    stream: bytes | None,
) -> None:
    inside = place.fresh()
    folder = session_writer(inside / "src", layout=ACCEL, redo=[0])
    text = json.loads((folder / "session.json").read_text()) | head
    (folder / "session.json").write_text(json.dumps(text))
    with (folder / "session.jsonl").open("ab") as file:
        file.write(b"\n".join(log))
    next(folder.glob("Tail*.json")).write_bytes(sidecar)
    for name, content in (("Hold*.csv", recording), ("fulldatastream.csv", stream)):
        if content is not None:
            next(folder.glob(name)).write_bytes(content)
    place.imported(inside / "src", inside)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The way to every value in nested lists and dicts."""
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, below in inner:
        yield from places(below, (*path, key))


LAYOUT = json.loads(json.dumps(load_layout("plush-15").to_dict()))
NASTY = JSON | st.sampled_from(
    [float("inf"), float("nan"), 10**400, -(10**30), 1e308, 5e-324, 0, True, "", "x_y", [], {}]
)


@some(120)
@given(st.sampled_from([p for p in places(LAYOUT) if p]), NASTY)
def test_layouts_of_sessions(place: Place, session_writer: Writer, path: tuple[Any, ...], value: Any) -> None:
    inside = place.fresh()
    folder = session_writer(inside / "src", gestures=["Tail pull"], rows=20)
    head = json.loads((folder / "session.json").read_text())
    at = head["layout"]
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    (folder / "session.json").write_text(json.dumps(head))
    place.imported(inside / "src", inside)


MEMBER = st.sampled_from(
    [
        "../evil.csv",
        "/evil.csv",
        "C:\\evil.csv",
        "a/../../evil.csv",
        "ana/Shake_1_30.csv",
        "ana/shake_1_30.csv",
        "ana",
        "NUL",
    ]
) | st.text(max_size=15)


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
@some(60)
@given(
    st.lists(st.tuples(MEMBER, CONTENT, st.integers(0, 2**32 - 1), st.integers(0, 0xFFFF)), max_size=5),
    st.booleans(),
)
def test_zips(place: Place, members: list[tuple[str, bytes, int, int]], good: bool) -> None:
    inside = place.fresh()
    with zipfile.ZipFile(inside / "x.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content, attributes, _ in members:
            info = zipfile.ZipInfo("x")
            info.filename = name.encode("utf-8", "replace").decode()
            info.external_attr = attributes
            try:
                archive.writestr(info, content)
            except ValueError:
                continue
        if good:
            archive.writestr("zoe/Shake_5_30.csv", GOOD)
    data = bytearray((inside / "x.zip").read_bytes())
    for at, (_, _, _, flags) in zip(
        (m.start() for m in re.finditer(b"PK\x01\x02", bytes(data))), members, strict=False
    ):
        if flags & 1:
            data[at + 8 : at + 10] = struct.pack("<H", flags)
    (inside / "x.zip").write_bytes(data)
    place.imported(inside / "x.zip", inside, layout=ACCEL)


def zip_bytes() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zoe/Shake_5_30.csv", GOOD)
        archive.writestr("zoe/Wave_6_30.csv", HEADED)
    return out.getvalue()


@some(80)
@given(mutated(zip_bytes()) | st.binary(max_size=100))
def test_bytes_that_may_be_a_zip(place: Place, content: bytes) -> None:
    inside = place.fresh()
    (inside / "x.zip").write_bytes(content)
    place.imported(inside / "x.zip", inside, layout=ACCEL)


@pytest.fixture
def xdf_bytes(tmp_path: Path, xdf_writer: Writer, xdf_stream: Any) -> bytes:
    toy = xdf_stream("toy", [i / 100 for i in range(60)], accel(60).values.tolist(), labels=("x", "y", "z"))
    said = xdf_stream("m", [0.1, 0.3], ["Shake", "end"], format="string", rate=0.0)
    path = xdf_writer(tmp_path / "made.xdf", [toy, said], at_once=20)
    data = path.read_bytes()
    path.unlink()
    return data


@some(100)
@given(st.data())
def test_xdf(place: Place, xdf_bytes: bytes, data: Any) -> None:
    inside = place.fresh()
    content = data.draw(mutated(xdf_bytes) | st.binary(max_size=60).map(lambda b: b"XDF:" + b) | st.binary(max_size=20))
    (inside / "sub-A.xdf").write_bytes(content)
    place.imported(inside / "sub-A.xdf", inside, layout=ACCEL)


TABLE = b"subject,label,time,x,y,z\n" + b"".join(b"ana,Shake,%d,1,2,%d\n" % (10 * i, i) for i in range(30))


@some(80)
@given(
    st.one_of(
        mutated(TABLE),
        st.binary(max_size=80),
        LINES.map(lambda lines: TABLE + lines),
        LINES.map(lambda b: TABLE[:25] + b),
    ),
    st.sampled_from([ACCEL, PHONE]),
)
@example(TABLE.replace(b"ana", b"../../x"), ACCEL)
@example(TABLE.replace(b"Shake", b'"a\nb,;c/../d"'), ACCEL)
@example(TABLE.replace(b"ana", "é".encode() * 100), ACCEL)
@example(TABLE.replace(b"Shake", b"S" * 190), ACCEL)
@example(TABLE.replace(b",x,y,z", b",x_acc,y_acc,z_acc,x_gyro,y_gyro,z_gyro").replace(b",1,2,", b",1,2,3,4,5,"), PHONE)
def test_tables(place: Place, content: bytes, layout: Any) -> None:
    inside = place.fresh()
    (inside / "t.csv").write_bytes(content)
    place.imported(inside / "t.csv", inside, layout=layout)


@pytest.fixture
def parquet_bytes(parquet: None) -> bytes:
    import polars as pl

    out = io.BytesIO()
    pl.read_csv(TABLE).write_parquet(out)
    return out.getvalue()


@some(60)
@given(st.data())
def test_parquet(place: Place, parquet_bytes: bytes, data: Any) -> None:
    inside = place.fresh()
    content = data.draw(mutated(parquet_bytes) | st.binary(max_size=40).map(lambda b: b"PAR1" + b + b"PAR1"))
    (inside / "t.parquet").write_bytes(content)
    place.imported(inside / "t.parquet", inside, layout=ACCEL)


@some(40)
@given(st.lists(st.tuples(NAME, FILE, CONTENT), max_size=4))
def test_adding(place: Place, files: list[tuple[str, str, bytes]]) -> None:
    inside = place.fresh()
    put(inside / "src" / "zoe", "Shake_5_30.csv", GOOD)
    assert place.imported(inside / "src", inside, layout=ACCEL)
    for folder, name, content in files:
        put(inside / "more" / plain(folder), plain(name), content)
    place.imported(inside / "more", inside, add_to=True)
    dataset = open_dataset(inside / "DS")
    assert "zoe/Shake_5_30" in {r.id for r in dataset.recordings}


LONG_ONES: dict[str, Callable[[], bytes]] = {
    "one long number": lambda: b"7" * LONG,
    "many separators": lambda: b";" * LONG,
    "many spaces": lambda: b"1" + b" " * LONG + b"2\n",
    "many numbers": lambda: b"1," * (LONG // 2),
    "a long line among good ones": lambda: HEADED + b"3," * (LONG // 2) + b"\n" + GOOD,
    "a long label": lambda: b"".join(
        b"1,2,3,4,5,6,%d,%s\n" % (i * 10, b"W" * (LONG if i == 3 else 4)) for i in range(40)
    ),
    "many empty lines": lambda: b"\n" * LONG + GOOD,
    "a long quotation": lambda: b'subject,label,time,x,y,z\n"' + b"a" * LONG,
    "long cells of a table": lambda: TABLE + b"ana," + b"S" * LONG + b",1,2,3,4\n",
}


@pytest.mark.parametrize("name", LONG_ONES)
def test_millions_of_characters_in_a_line(place: Place, name: str, session_writer: Writer) -> None:
    content = LONG_ONES[name]()
    inside = place.fresh()
    put(inside / "src" / "zoe", "Shake_5_30.csv", content)
    put(inside / "src" / "zoe", "fulldatastream.csv", content)
    put(inside / "src" / "zoe", "Wave_6_30.csv", GOOD)
    assert place.imported(inside / "src", inside, layout=ACCEL)
    for layout in (ACCEL, PHONE):
        for read in (read_recording, read_stream):
            try:
                read(inside / "src" / "zoe" / "Shake_5_30.csv", layout)
            except PlushSenseError as refusal:
                assert len(str(refusal)) < 1000
    inside = place.fresh()
    put(inside, "t.csv", content)
    place.imported(inside / "t.csv", inside, layout=ACCEL)
    inside = place.fresh()
    folder = session_writer(inside / "src", layout=ACCEL)
    (folder / "session.jsonl").write_bytes(content)
    assert place.imported(inside / "src", inside)
    (folder / "session.json").write_bytes(content)
    inside = place.fresh()
    place.imported(folder.parents[1], inside, people=folder / "session.json", subjects=folder / "session.json")


@pytest.mark.skipif(sys.platform == "win32", reason="names and links of this kind cannot be made there")
def test_names_that_are_no_text_and_links(place: Place, tmp_path: Path) -> None:
    inside = place.fresh()
    put(inside / "src" / "zoe", "Shake_5_30.csv", GOOD)
    for name in (b"Sh\xffake_1_30.csv", b"Shake\n_1_30.csv", b"\x1b[31m_1_30.csv"):
        try:
            (inside / "src" / "zoe" / os.fsdecode(name)).write_bytes(GOOD + b"1,2,3,4,5\n")
        except OSError:
            continue
    (inside / "src" / "bad\udcff").mkdir()
    put(inside / "src" / "bad\udcff", "Shake_9_30.csv", GOOD + b"1,2,3,4,6\n")
    (inside / "src" / "loop").symlink_to(inside / "src")
    (inside / "src" / "zoe" / "Wave_1_30.csv").symlink_to("/etc/passwd")
    (inside / "src" / "zoe" / "gone_1_30.csv").symlink_to(inside / "nowhere")
    os.mkfifo(inside / "src" / "zoe" / "pipe_1_30.csv")
    assert place.imported(inside / "src", inside, layout=ACCEL)
