"""Layouts and folders of every kind: what leaves is what was recorded."""

from pathlib import Path

import numpy as np
import pytest

from plushsense.core.errors import DatasetError
from plushsense.core.layouts import load_layout
from plushsense.core.recorder_csv import Frames, read_recording, read_stream
from plushsense.dataset.importing.importers import import_recordings
from plushsense.dataset.index import open_dataset
from plushsense.dataset.marks import Mark, append_marks
from plushsense.dataset.publishing.contents import ContentsSpec, public_codes
from plushsense.dataset.publishing.package import PublishResult
from plushsense.dataset.store import Dataset
from support.toys import KEY, made_of

pytestmark = pytest.mark.apart("publishing")

NOW = 1_700_000_000_000


def bring(source: Path, dest: Path, layout: str) -> Dataset:
    dataset = import_recordings(source, dest, layout=layout, licence="CC0-1.0", consent="given").dataset
    text = (dest / "dataset.toml").read_text(encoding="utf-8")
    contact = '[about.contact]\nname = "A"\nemail = "a@example.org"\n\n[layout]'
    (dest / "dataset.toml").write_text(text.replace("[layout]", contact, 1), encoding="utf-8")
    return open_dataset(dataset.path)


def sound(done: PublishResult) -> Dataset:
    assert done.checked.problems == []
    return open_dataset(done.folder / "data")


def test_streams_with_a_label_on_every_row_and_a_wall_clock(tmp_path: Path) -> None:
    """As the phone data: no recording files, decimals, dates in the only clock there is, and in the names.

    A label that others would read as a number is another text in the rows, too.
    """
    for person in ("s01", "s02"):
        folder = tmp_path / "src" / person
        folder.mkdir(parents=True)
        # The second session is the first by its name: time decides.
        for name, began in (("b_20231114", NOW), ("a_20231115", NOW + 86_400_000)):
            rows = ["x_acc,y_acc,z_acc,x_gyro,y_gyro,z_gyro,timestamp,label"]
            for i in range(120):
                label = "SEATED" if i < 50 else "01"
                rows.append(f"{-4.1602 + i / 7},0.5,-9.25,0.0028,-0.0138,{i},{began + 10 * i},{label}")
            (folder / f"{person}_{name}_sp.csv").write_text("\n".join(rows) + "\n")
    dataset = bring(tmp_path / "src", tmp_path / "DS", "phone-6")
    append_marks(dataset.path, [Mark(dataset.recordings[0].id, "exclude", "me")])
    dataset = open_dataset(dataset.path)
    back = sound(made_of(dataset, tmp_path / "out"))
    assert [(r.session, r.gesture, r.rows) for r in back.recordings[:4]] == [
        ("1", "SEATED", 50),
        ("1", "gesture 01", 70),
        ("2", "SEATED", 50),
        ("2", "gesture 01", 70),
    ]
    assert [r.excluded for r in back.recordings] == [False, False, True] + [False] * 5
    assert [p.name for p in sorted((back.path / "streams" / "s01").iterdir())] == ["1.csv", "2.csv"]
    assert set(back.read_stream(back.streams[0].id).labels) == {"SEATED", "gesture 01"}
    in_time = sorted(dataset.recordings, key=lambda r: (r.subject, r.start_ms))
    for old, new in zip(in_time, back.recordings, strict=True):
        before, after = dataset.read(old), back.read(new)
        assert np.array_equal(before.values, after.values)
        assert np.array_equal(np.diff(before.device_ms), np.diff(after.device_ms))
        assert after.device_ms.max() < 10**12
    assert not [p for p in (tmp_path / "out").rglob("*") if "2023" in p.name]
    with pytest.raises(DatasetError, match="cannot be published without streams"):
        made_of(dataset, tmp_path / "other", ContentsSpec(streams=False))


def test_delays_of_old_firmware_become_the_stream_s_clock(tmp_path: Path) -> None:
    layout = load_layout("plush-14")
    rng = np.random.default_rng(1)
    delays = rng.integers(8, 13, 400)
    host = NOW + np.cumsum(delays)
    values = rng.integers(0, 3000, (400, 13))
    folder = tmp_path / "src" / "P1"
    folder.mkdir(parents=True)
    lines = ["; ".join(map(str, [*v, h, d])) for v, h, d in zip(values.tolist(), host, delays, strict=True)]
    (folder / "fulldatastream.csv").write_text("\n".join(lines) + "\n")
    (folder / f"Hold strong_{host[199]}_100.csv").write_text(
        "; ".join(layout.csv.header) + "\n" + "\n".join(lines[100:200]) + "\n"
    )
    dataset = bring(tmp_path / "src", tmp_path / "DS", "plush-14")
    assert "integrated" in dataset.recordings[0].flags[0]
    append_marks(dataset.path, [Mark(dataset.streams[0].id, "label", "me", "seen", start=210, stop=390, label="rest")])
    dataset = open_dataset(dataset.path)
    back = sound(made_of(dataset, tmp_path / "out"))
    assert back.recordings[0].stream_row == dataset.recordings[0].stream_row == 100
    assert np.array_equal(back.read(back.recordings[0]).values, values[100:200])
    assert [(s.stream, s.start, s.stop, s.label) for s in back.stretches] == [(back.streams[0].id, 210, 390, "rest")]
    assert np.array_equal(np.diff(back.read(back.recordings[0]).device_ms), delays[101:200])


def test_codes_that_look_like_numbers_and_equal_names(tmp_path: Path) -> None:
    for person in ("01", "P01", "nan", "1e5"):
        folder = tmp_path / "src" / person
        folder.mkdir(parents=True)
        text = "".join(f"{NOW + 10 * i}, {10 * i}, {i}, {len(person)}, 7\n" for i in range(40))
        (folder / f"Shake_{NOW + 400}_40.csv").write_text(text)
    dataset = bring(tmp_path / "src", tmp_path / "DS", "accel-3")
    done = made_of(dataset, tmp_path / "out")
    back = sound(done)
    assert back.subjects == ["P01", "P1e5", "PP01", "Pnan"]
    assert public_codes(dataset) == {"01": "PP01", "P01": "P01", "1e5": "P1e5", "nan": "Pnan"}
    assert any("3 subject codes" in note for note in done.description.notes)


def test_no_wall_clock_but_in_the_name_or_a_random_number_there(tmp_path: Path) -> None:
    """After the authors' anonymising step the number in the name is random, and there may be no host column."""
    own = tmp_path / "own.toml"
    own.write_text(
        'name = "own"\nrate_hz = 100.0\nwire = ["device_ms", "x"]\n'
        'channels = [{ name = "x", unit = "count", kind = "touch", step = 0.5 }]\n'
        '[csv]\ncolumns = ["device_ms", "x"]\nheader = ["t", "x"]\nseparator = ";"\n'
    )
    for person, epoch in (("P1", NOW), ("P2", 4_812_345)):
        folder = tmp_path / "src" / person
        folder.mkdir(parents=True)
        (folder / f"Pat_{epoch}_30.csv").write_text("".join(f"{10 * i};{i / 2 - 3}\n" for i in range(30)))
    dataset = bring(tmp_path / "src", tmp_path / "DS", str(own))
    back = sound(made_of(dataset, tmp_path / "out"))
    assert back.layout.csv.columns == ("device_ms", "x")
    assert [np.array_equal(back.read(r).values[:, 0], np.arange(30) - 6) for r in back.recordings] == [True, True]
    assert all(r.epoch_ms < 10**12 for r in back.recordings)


def test_a_data_set_with_nothing_left(tmp_path: Path) -> None:
    folder = tmp_path / "src" / "P1"
    folder.mkdir(parents=True)
    (folder / f"Pat_{NOW}_30.csv").write_text("".join(f"{NOW + i}, {i}, 1, 2, {i}\n" for i in range(30)))
    dataset = bring(tmp_path / "src", tmp_path / "DS", "accel-3")
    append_marks(dataset.path, [Mark(dataset.recordings[0].id, "exclude", "me")])
    with pytest.raises(DatasetError, match="no recording left"):
        made_of(open_dataset(dataset.path), tmp_path / "out")


def test_the_same_recording_twice_and_labels_that_need_care(tmp_path: Path) -> None:
    folder = tmp_path / "src" / "P 1"
    folder.mkdir(parents=True)
    for number, label in enumerate(["Héart [x]", "Pat, twice", 'Say "a"']):
        rows = "".join(f"{NOW + 9 * i}, {9 * i}, {number}, 2, {i}\n" for i in range(30))
        name = label.replace('"', "'")
        (folder / f"{name}_{NOW}_30.csv").write_text(rows)
        (folder / f"{name}_{NOW + 1}_30.csv").write_text(rows)
    dataset = bring(tmp_path / "src", tmp_path / "DS", "accel-3")
    back = sound(made_of(dataset, tmp_path / "out", ContentsSpec(key=KEY)))
    assert len(back.recordings) == 6
    assert sum("the same content" in " ".join(r.flags) for r in back.recordings) == 3


def test_real_recordings_of_two_people(real_data: Path, tmp_path: Path) -> None:
    """The whole of it takes a minute and is measured in docs/publishing.md; two people are as real."""
    for person in ("P01", "P09"):
        copied = tmp_path / "copy" / person
        copied.mkdir(parents=True)
        for path in sorted((real_data / "makeability-gestures" / person).iterdir()):
            (copied / path.name).write_bytes(path.read_bytes())
    dataset = bring(tmp_path / "copy", tmp_path / "DS", "accel-3")
    back = sound(made_of(dataset, tmp_path / "out"))
    assert len(back.recordings) == len(dataset.recordings) >= 100
    assert sum(r.stream_row >= 0 for r in back.recordings) == sum(r.stream_row >= 0 for r in dataset.recordings)

    def rows(d: Dataset) -> list[Frames]:
        files = [d.path / r.file for r in sorted(d.recordings, key=lambda r: (r.subject, r.start_ms, r.sha256))]
        streams = [d.path / s.file for s in sorted(d.streams, key=lambda s: s.subject)]
        return [read_recording(f, d.layout).frames for f in files] + [read_stream(f, d.layout).frames for f in streams]

    before = sorted((f.values.tobytes(), f.device_ms.tobytes()) for f in rows(dataset))
    assert sorted((f.values.tobytes(), f.device_ms.tobytes()) for f in rows(back)) == before
