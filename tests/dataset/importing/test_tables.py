"""One table, a row a sample: by its plainest reading, from CSV and Parquet alike."""

from __future__ import annotations

import json
import unicodedata
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import ConfigError, DatasetError, FileFormatError, MissingExtraError
from plushsense.core.layouts import load_layout
from plushsense.dataset.importing import table_files
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.importing.pattern import ImportPattern
from plushsense.dataset.importing.results import ImportResult
from plushsense.windows.anywhere import add_idle_gesture

ACCEL = load_layout("accel-3")


def table(path: Path, rows: list[str], header: str = "subject,session,label,time_ms,x,y,z") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def rows(subject: str, label: str, start: int, count: int, session: str = "1") -> list[str]:
    return [f"{subject},{session},{label},{(start + i) * 10},{i % 7},{i % 7 + 1},{-(i % 7)}" for i in range(count)]


def got(done: ImportResult) -> list[tuple[str, str, str, int]]:
    return [(r.subject, r.session, r.gesture, r.rows) for r in done.dataset.recordings]


def test_runs_of_a_label_are_recordings(tmp_path: Path) -> None:
    lines = rows("ana", "Shake", 0, 50) + rows("ana", "Wave", 50, 40) + rows("ben", "Shake", 0, 30, "2")
    path = table(tmp_path / "all.csv", lines)
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert got(done) == [("ana", "1", "Shake", 50), ("ana", "1", "Wave", 40), ("ben", "2", "Shake", 30)]
    assert [s.subject for s in done.dataset.streams] == ["ana"], "one gesture goes on where the other ends"
    assert done.messages == ()
    wave = done.dataset.read(done.dataset.recordings[1])
    assert wave.values[:2].tolist() == [[0, 1, 0], [1, 2, -1]]
    assert wave.device_ms[:2].tolist() == [500, 510]
    origin = json.loads((tmp_path / "DS/streams/ana/1/origin.json").read_text())
    assert origin["source"] == "all.csv"
    assert origin["columns"]["time"] == "time_ms"
    assert done.dataset.head.source == "table"


def test_labels_that_become_one_are_told(tmp_path: Path) -> None:
    lines = [
        line for n, label in enumerate(("swipe <", "swipe >", "Tap", "tap")) for line in rows("ana", label, 50 * n, 50)
    ]
    done = import_recordings(table(tmp_path / "all.csv", lines), tmp_path / "DS", layout="accel-3")
    assert {gesture for _, _, gesture, _ in got(done)} == {"swipe _", "Tap"}
    composed, apart = "glāsts", unicodedata.normalize("NFD", "glāsts")
    lines = rows("ana", composed, 0, 50) + rows("ana", apart, 50, 50)
    same = import_recordings(table(tmp_path / "accents.csv", lines), tmp_path / "DS2", layout="accel-3")
    assert {gesture for _, _, gesture, _ in got(same)} == {composed} and same.messages == ()
    (said,) = done.messages
    assert "'swipe >' and 'swipe <' become one gesture, 'swipe _'" in said


def test_people_may_take_turns_row_by_row(tmp_path: Path) -> None:
    pairs = zip(rows("ana", "Shake", 0, 50), rows("ben", "Wave", 0, 50), strict=True)
    path = table(tmp_path / "all.csv", [line for pair in pairs for line in pair])
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    assert got(done) == [("ana", "1", "Shake", 50), ("ben", "1", "Wave", 50)]


def test_rows_without_a_label_make_a_stream(tmp_path: Path) -> None:
    lines = rows("ana", "", 0, 30) + rows("ana", "Shake", 30, 50) + rows("ana", "", 80, 20)
    done = import_recordings(table(tmp_path / "all.csv", lines), tmp_path / "DS", layout="accel-3")
    (recording,) = done.dataset.recordings
    (stream,) = done.dataset.streams
    assert (recording.stream_row, recording.rows, stream.rows) == (30, 50, 100)


def test_recordings_that_follow_one_another_make_a_stream(tmp_path: Path) -> None:
    together = rows("ana", "Shake", 0, 30) + rows("ana", "Wave", 30, 40) + rows("ana", "Shake", 80, 50)
    apart = rows("ana", "Shake", 0, 30) + rows("ana", "Wave", 80, 40) + rows("ana", "Shake", 120, 50)
    for name, lines, streams in (("t", [*together, *rows("ana", "Wave", 130, 40)], 1), ("a", apart[:120], 0)):
        path = table(tmp_path / f"{name}.csv", lines)
        one = import_recordings(path, tmp_path / f"{name}-DS", layout="accel-3")
        pattern = ImportPattern(layout="accel-3", paths=("*.csv",))
        other = import_recordings(path, tmp_path / f"{name}-by-pattern", pattern=pattern)
        assert (one.streams, other.streams) == (streams, streams), "one rule with and without a pattern"
        assert [r.stream_row for r in other.dataset.recordings] == [r.stream_row for r in one.dataset.recordings]
    counted = ImportPattern(layout="accel-3", paths=("*.csv",), row_rate_hz=100.0)
    assert import_recordings(path, tmp_path / "no-clock", pattern=counted).streams == 1


def test_rows_with_an_idle_label_belong_to_the_stream_only(tmp_path: Path) -> None:
    lines = rows("ana", "Null class", 0, 30) + rows("ana", "Shake", 30, 50) + rows("ana", "null_class", 80, 20)
    path = table(tmp_path / "all.csv", lines)
    pattern = ImportPattern(layout="accel-3", paths=("*.csv",), idle=("null class",))
    done = import_recordings(path, tmp_path / "DS", pattern=pattern)
    (recording,) = done.dataset.recordings
    assert (done.gestures, done.streams, recording.stream_row, recording.rows) == (["Shake"], 1, 30, 50)
    idle = add_idle_gesture(done.dataset.gestures, done.dataset)
    assert [g.label for g in idle.gestures if g.idle] == ["Idle"]


def test_a_pause_a_clock_that_runs_back_and_a_recording_column(tmp_path: Path) -> None:
    again = rows("ana", "Shake", 0, 50) + rows("ana", "Shake", 0, 50) + rows("ana", "Shake", 500, 50)
    done = import_recordings(table(tmp_path / "a.csv", again), tmp_path / "DS", layout="accel-3")
    assert [n for *_, n in got(done)] == [50, 50, 50]
    assert len({r.file for r in done.dataset.recordings}) == 3
    lines = [f"{number},{line}" for number, line in zip("1" * 50 + "2" * 100, again, strict=True)]
    path = table(tmp_path / "b.csv", lines, "trial,subject,session,label,time_ms,x,y,z")
    done = import_recordings(path, tmp_path / "DS2", layout="accel-3")
    assert sorted(n for *_, n in got(done)) == [50, 100]


@pytest.mark.parametrize(
    ("name", "factor", "said"),
    [
        ("time", 10, "read as ms"),
        ("timestamp", 0.01, "read as s"),
        ("t", 10_000, "read as us"),
        ("time", 10_000_000, "read as ns"),
        ("time_s", 0.01, ""),
        ("Arduino Timestamp (ms)", 10, ""),
    ],
)
def test_the_unit_of_time_is_in_the_name_or_in_the_rate(tmp_path: Path, name: str, factor: float, said: str) -> None:
    lines = [f"ana;Shake;{7 * factor + i * factor};1;2;3" for i in range(50)]
    path = table(tmp_path / "a.csv", lines, f"participant;gesture;{name};X;Y;Z")
    done = import_recordings(path, tmp_path / "DS", layout="accel-3")
    (recording,) = done.dataset.recordings
    assert done.dataset.read(recording).device_ms[:3].tolist() == [70, 80, 90]
    assert (said in "\n".join(done.notes)) if said else not done.notes


def test_columns_can_be_named(tmp_path: Path) -> None:
    lines = [f"ana\tShake\t{i * 10}\t{i}\t2\t3" for i in range(50)]
    path = table(tmp_path / "a.csv", lines, "who\twhat\twhen_ms\tax\tay\taz")
    columns = {"subject": "who", "label": "what", "time": "when_ms", "x": "ax", "y": "ay", "z": "az"}
    done = import_recordings(path, tmp_path / "DS", layout="accel-3", columns=columns)
    assert got(done) == [("ana", "1", "Shake", 50)]
    with pytest.raises(FileFormatError, match="no column 'label'; it has who, what.*--column label=NAME"):
        import_recordings(path, tmp_path / "DS2", layout="accel-3")
    with pytest.raises(FileFormatError, match="no column 'subject'.*--subjects map.csv"):
        import_recordings(path, tmp_path / "DS2", layout="accel-3", columns=dict(list(columns.items())[1:]))
    with pytest.raises(ConfigError, match="--column lable=….*Did you mean 'label'"):
        import_recordings(path, tmp_path / "DS2", layout="accel-3", columns={"lable": "what"})
    del columns["subject"]
    (tmp_path / "map.csv").write_text("file,subject\na.csv,eve\n")
    done = import_recordings(path, tmp_path / "DS2", layout="accel-3", columns=columns, subjects=tmp_path / "map.csv")
    assert done.dataset.subjects == ["eve"]


def test_rows_that_cannot_be_used_are_counted(tmp_path: Path) -> None:
    lines = rows("ana", "Shake", 0, 50)
    lines[3] = lines[3].replace("ana", "")
    lines[5] = "ana,1,Shake,50,nan,1,2"
    lines[6] = "ana,1,Shake,60," + "9" * 400 + ",1,2"
    lines[8] = "ana,1,Shake"
    done = import_recordings(table(tmp_path / "a.csv", lines), tmp_path / "DS", layout="accel-3")
    assert done.recordings == 1
    assert done.dataset.recordings[0].rows == 46
    assert list(done.notes) == [
        "a.csv: 1 row of another width than the header left out (the first: line 10: 'ana,1,Shake')",
        "a.csv: 2 rows without a number in every column left out (the first: line 7)",
        "a.csv: 1 row without a subject left out (the first: line 5)",
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "begins with no line of column names"),
        (b"a,b\n1,2\n", "no column"),
        (b"label,time,x,y,z\n", "no column 'subject'"),
        (b"subject,label,time,x,y,z\n", "no usable row"),
        (b"subject,label,time,x,y,z,x\na,b,1,2,3,4,5\n", "two columns 'x'"),
        (b"\xff\xfe\x00", "not UTF-8"),
        # How long a cell may be is a setting of the process, which other packages raise.
        (b'subject,label,time,x,y,z\n"' + b"a" * 200_000, "no CSV table|no usable row"),
    ],
)
def test_tables_that_cannot_be_read(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    with pytest.raises(FileFormatError, match=said):
        import_recordings(tmp_path / "a.csv", tmp_path / "DS", layout="accel-3")
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_a_recording_is_no_table(tmp_path: Path) -> None:
    (tmp_path / "Shake_1_60.csv").write_text("1, 2, 3, 4, 5\n")
    with pytest.raises(DatasetError, match="is one recording"):
        import_recordings(tmp_path / "Shake_1_60.csv", tmp_path / "DS", layout="accel-3")


def test_sessions_that_would_share_a_folder_are_refused(tmp_path: Path) -> None:
    lines = rows("ana", "Shake", 0, 50, "a/b") + rows("ana", "Shake", 90, 50, "a:b")
    with pytest.raises(DatasetError, match="sessions 'a/b' and 'a:b' would share"):
        import_recordings(table(tmp_path / "a.csv", lines), tmp_path / "DS", layout="accel-3")


def test_parquet_reads_like_csv(tmp_path: Path, parquet: None) -> None:
    import polars as pl

    lines = rows("ana", "Shake", 0, 50) + rows("ana", "", 50, 40) + rows("ben", "Wave", 0, 30, "2")
    path = table(tmp_path / "t.csv", lines)
    pl.read_csv(path).with_columns(pl.col("x").cast(pl.Float32)).write_parquet(tmp_path / "t.parquet")
    a = import_recordings(path, tmp_path / "A", layout="accel-3")
    b = import_recordings(tmp_path / "t.parquet", tmp_path / "B", layout="accel-3")
    assert a.dataset.recordings == b.dataset.recordings
    assert a.dataset.streams == b.dataset.streams


def test_parquet_dates_and_gaps(tmp_path: Path, parquet: None) -> None:
    import polars as pl

    begin = datetime(2026, 1, 1)
    frame = pl.DataFrame(
        {
            "subject": [3] * 40,
            "label": ["Shake"] * 40,
            "time": [begin + timedelta(milliseconds=10 * i) for i in range(40)],
            "x": [None, *list(range(39))],
            "y": list(range(40)),
            "z": [0.0] * 40,
        }
    )
    frame.write_parquet(tmp_path / "t.parquet")
    done = import_recordings(tmp_path / "t.parquet", tmp_path / "DS", layout="accel-3")
    (recording,) = done.dataset.recordings
    assert (recording.subject, recording.rows) == ("3", 39)
    assert np.diff(done.dataset.read(recording).device_ms).tolist() == [10] * 38
    frame.with_columns(pl.struct("x", "y").alias("z")).write_parquet(tmp_path / "u.parquet")
    with pytest.raises(FileFormatError, match="more than one value in a cell of column 'z'"):
        import_recordings(tmp_path / "u.parquet", tmp_path / "DS2", layout="accel-3")


def test_a_row_of_lists_is_a_recording(tmp_path: Path, parquet: None) -> None:
    import polars as pl

    frame = pl.DataFrame(
        {
            "subject": ["ana", "ana", "ben"],
            "label": ["Shake", "Shake", "Wave"],
            "time_ms": [list(range(0, 10 * n, 10)) for n in (50, 40, 30)],
            "x": [[i] * n for i, n in enumerate((50, 40, 30))],
            "y": [[0] * n for n in (50, 40, 30)],
            "z": 1,
        }
    )
    frame.write_parquet(tmp_path / "t.parquet")
    done = import_recordings(tmp_path / "t.parquet", tmp_path / "DS", layout="accel-3")
    assert got(done) == [("ana", "1", "Shake", 40), ("ana", "1", "Shake", 50), ("ben", "1", "Wave", 30)]
    assert [done.dataset.read(r).values[-1].tolist() for r in done.dataset.recordings] == [[i, 0, 1] for i in (1, 0, 2)]
    frame.with_columns(y=pl.lit([1, 2])).write_parquet(tmp_path / "u.parquet")
    with pytest.raises(FileFormatError, match="cannot be read as Parquet"):
        import_recordings(tmp_path / "u.parquet", tmp_path / "DS2", layout="accel-3")


def test_parquet_without_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def need(module: str, extra: str) -> None:
        raise MissingExtraError(f"{module} {extra}")

    monkeypatch.setattr(table_files, "need", need)
    (tmp_path / "t.parquet").write_bytes(b"PAR1")
    with pytest.raises(MissingExtraError, match="polars tables"):
        import_recordings(tmp_path / "t.parquet", tmp_path / "DS", layout="accel-3")
    (tmp_path / "t.parquet").write_bytes(b"PAR")
    with pytest.raises(FileFormatError, match="no Parquet file"):
        import_recordings(tmp_path / "t.parquet", tmp_path / "DS", layout="accel-3")


def test_a_table_that_grew_is_added(tmp_path: Path) -> None:
    path = table(tmp_path / "all.csv", rows("ana", "Shake", 0, 50))
    import_recordings(path, tmp_path / "DS", layout="accel-3")
    table(path, rows("ana", "Shake", 0, 50) + rows("ana", "Wave", 200, 40) + rows("ben", "Wave", 0, 40))
    done = import_recordings(path, tmp_path / "DS", add_to=True)
    assert got(done) == [("ana", "1", "Shake", 50), ("ana", "1", "Wave", 40), ("ben", "1", "Wave", 40)]
    assert (done.added_recordings, done.already_there) == (2, 1)
    assert done.rejected == ()
